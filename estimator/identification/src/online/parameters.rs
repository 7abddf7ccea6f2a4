//! Sets of parameters for use on-line, and mixtures of two sets.

use crate::linear::information::{Information, InformationError, Panel};
use crate::prior::link_cad_root;
use nalgebra::DMatrix;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::spatial::RigidInertia;

/// A set of parameters: in use, or a candidate.
#[derive(Clone, Debug, Default)]
pub(crate) struct ParameterEstimate {
    /// `d = phi - phi_CAD`.
    pub(crate) change: Vec<f64>,
    /// A root `U` of their covariance `U^T U`.
    pub(crate) root: DMatrix<f64>,
    pub(crate) bodies: Vec<RigidInertia>,
    pub(crate) tau: f64,
    pub(crate) effective: f64,
}

impl ParameterEstimate {
    /// CAD's parameters, with this relative standard deviation.
    pub(crate) fn of_cad(bodies: &[RigidInertia], relative: f64) -> Self {
        let count = LINK_PARAMETERS * bodies.len();
        let mut root = DMatrix::zeros(count, count);
        for (place, body) in bodies.iter().enumerate() {
            let at = LINK_PARAMETERS * place;
            root.view_mut((at, at), (LINK_PARAMETERS, LINK_PARAMETERS))
                .copy_from(&link_cad_root(body, relative));
        }
        Self {
            change: vec![0.0; count],
            root,
            bodies: bodies.to_vec(),
            tau: f64::NAN,
            effective: 0.0,
        }
    }
}

impl ParameterEstimate {
    /// The mixture of both sets with the weights `1 - k` and `k`, `k = share`: its mean and
    /// covariance.
    ///
    /// ```text
    /// P = (1 - k) P_1 + k P_2 + k (1 - k) (d_2 - d_1) (d_2 - d_1)^T
    /// ```
    pub(crate) fn between(
        first: &Self,
        second: &Self,
        share: f64,
    ) -> Result<Self, InformationError> {
        let mixed = |a: f64, b: f64| a + share * (b - a);
        let bodies: Vec<RigidInertia> = (first.bodies.iter().zip(&second.bodies))
            .map(|(a, b)| {
                let (a, b) = (a.parameters(), b.parameters());
                RigidInertia::from_parameters(&std::array::from_fn(|i| mixed(a[i], b[i])))
            })
            .collect();
        // The triangle of the three stacked roots. Absorbing rows of measurements is several times
        // as fast as a portable QR decomposition.
        let apart = DMatrix::from_iterator(
            1,
            first.change.len(),
            second.change.iter().zip(&first.change).map(|(b, a)| b - a),
        );
        let mut all = Information::new(first.change.len());
        for (root, weight) in [
            (&first.root, 1.0 - share),
            (&second.root, share),
            (&apart, share * (1.0 - share)),
        ] {
            let mut panel = Panel::new(root.ncols(), root.nrows());
            for row in (root * weight.sqrt()).row_iter() {
                panel.push_row(row.transpose().as_slice(), 0.0)?;
            }
            all.absorb(&mut panel)?;
        }
        Ok(Self {
            change: first
                .change
                .iter()
                .zip(&second.change)
                .map(|(a, b)| mixed(*a, *b))
                .collect(),
            root: all.to_triangle().0,
            bodies,
            tau: second.tau,
            effective: second.effective,
        })
    }
}
