//! Propagation of the covariance of parameters and offsets to the solver's results: a standard
//! deviation for every torque and every component of a contact wrench, at every instant.
//!
//! A result is `t . x` with a row `t` of coefficients
//! ([`EstimateRows`](proprio_dynamics::regressor::EstimateRows)), and its variance is `t P t^T`.
//! Row by row this would be one product with a large triangular root per result. Here the root is
//! multiplied once per sub-tree, with the six rows of wrenches, in base coordinates:
//!
//! ```text
//! P = U^T U                 U: root of the covariance in the sub-tree's columns, upper triangular
//! G_l = U_l A_l^T           rows x 6, of each link; A_l is its regressor
//! G_s = U_s A_s^T           rows x 6, of each sensor; A_s maps its offset to a wrench
//! W_l = sum of G below l    rows x 6; F_l is the sum of wrenches below l,
//!                           so Cov(F_l, F_k) = W_l^T W_k
//! var(tau_j) = |W_j s_j - W_b h_j|^2      tau_j = s_j . F_j - h_j . b  (proprio_dynamics, solver)
//! var(x_i)   = |W_b k_i|^2                x_i = k_i . b
//! ```
//!
//! A link whose parameters are correlated with nothing else in its sub-tree needs no rows:
//! `C_l = G_l^T G_l` is six by six, and independent covariances add. Then `var(tau_j) =
//! s_j^T C s_j - 2 s_j^T C h_j + h_j^T C_b h_j`, with `C` summed over the links below `j` and `C_b`
//! over all links. So links that are known from the URDF alone cost little. What an offset has
//! drifted, and what else is uncertain in a reading, is such a covariance of the link it acts on.
//!
//! If a sensor's calibration is uncertain, too ([`proprio_dynamics::calibration`]), its columns act
//! like additional columns of the offset that depend on the reading `r` and the board temperature
//! `T`: `U_s` becomes `U_s - U_E r + U_k (T - T0)` at each instant
//! ([`Propagation::set_calibration_point`]).
//!
//! `W` is most of the work, and changes as the motion does: it is computed with the first estimate
//! of each 5 ms, of the stamps, and when base, covariance or the reading of a sensor with uncertain
//! calibration change, and held in between. All else is of the instant.
//!
//! Loops over rows use the widest vector instructions of the processor, in a portable build too.
//!
//! Columns are ordered sensors first, then links from the tips to the top, so that the links below
//! a joint have short columns in the triangle. `U` and `W` are single precision. A standard
//! deviation needs three digits, and has them even where the contributions of parameters cancel to
//! a hundred-thousandth.
//!
//! Measured on iCub V2.5 (39 bodies, 426 columns): kinematics, solution and all standard deviations
//! of 32 torques and seven full contact wrenches. One core of a two-core virtual machine (AMD EPYC
//! with AVX-512), plain x86-64 build, fastest of 100 (`cargo bench -p proprio-estimator --bench
//! propagation`):
//!
//! | covariance | with contacts \[us\] | without \[us\] |
//! |---|---|---|
//! | each link independent | 9.4 | 12.0 |
//! | limbs beyond the sensors and all offsets correlated | 14.2 | 14.9 |
//! | all 426 columns correlated | 15.6 | 17.1 |

mod covariance;
mod shares;
mod subtree;
mod vectors;

pub use covariance::Covariance;

use self::covariance::Drift;
use self::subtree::SubtreeRoot;
use self::vectors::{LANES, Member};
use nalgebra::Matrix6;
use proprio_dynamics::spatial::Wrench;
use proprio_dynamics::{DynamicsError, Kinematics, Solver, Structure, check_size};
use proprio_topics::Nanos;
use pulp::{Arch, Simd, WithSimd};

/// How long the wrenches of the links' uncertain parameters are used. In that time an acceleration
/// that grows as fast as a robot's joint can, by 1000 rad/s^3, changes by 5 rad/s^2.
const HELD: Nanos = Nanos::from_millis(5);

/// The standard deviations of the solver's results that a [`Covariance`] causes, with all the
/// memory needed to compute them.
#[derive(Clone, Debug)]
pub struct Propagation {
    subtrees: Vec<SubtreeRoot>,
    drifts: Vec<Drift>,
    /// Per sensor, the additional variance of each channel [torque; force] at present.
    extra: Vec<[f64; 6]>,
    /// Per sensor, the variance of what is uncertain in its reading, of each channel.
    readings: Vec<[f64; 6]>,
    /// Memory for the shares of a torque: one number per row.
    sum: Vec<f32>,
    /// The first instant of this run.
    run_start: Option<Nanos>,
    /// The period, and the base, that the wrenches are of.
    held: Option<(i64, usize)>,
    /// Standard deviations of the torques.
    torque: Vec<f64>,
    /// Standard deviations of the contact wrenches.
    contacts: Vec<[f64; 6]>,
    /// Per sub-tree with a sensor, the covariance of its imbalance.
    imbalances: Vec<Matrix6<f64>>,
}

impl Propagation {
    /// A propagation for a structure and a covariance of its parameters.
    ///
    /// # Errors
    /// The covariance has another number of links or sensors.
    pub fn new(structure: &Structure, covariance: &Covariance) -> Result<Self, DynamicsError> {
        check_size(
            "links of the covariance",
            covariance.links.len(),
            structure.link_count(),
        )?;
        check_size(
            "sensors of the covariance",
            covariance.sensors.len(),
            structure.sensors().len(),
        )?;
        let subtrees = 0..structure.subtrees().len();
        let subtrees: Vec<SubtreeRoot> = subtrees
            .map(|number| SubtreeRoot::new(structure, number, covariance))
            .collect();
        let rows = subtrees.iter().map(|part| part.rows).max().unwrap_or(0);
        Ok(Self {
            subtrees,
            readings: vec![[0.0; 6]; covariance.drifts.len()],
            sum: vec![0.0; LANES * rows],
            drifts: covariance.drifts.clone(),
            extra: vec![[0.0; 6]; covariance.drifts.len()],
            run_start: None,
            held: None,
            torque: vec![0.0; structure.dof_count()],
            contacts: vec![[0.0; 6]; structure.contacts().len()],
            imbalances: vec![Matrix6::zeros(); structure.subtrees().len()],
        })
    }

    /// Sets a sensor's corrected reading, offset included, and the temperature of its board above
    /// the reference \[K\]. The effect of an uncertain calibration depends on both. Initially an
    /// uncertain calibration has no effect.
    pub fn set_calibration_point(&mut self, sensor: usize, corrected: &Wrench, kelvin: f64) {
        let corrected = corrected.torque_first();
        for column_block in self
            .subtrees
            .iter_mut()
            .flat_map(|part| &mut part.column_blocks)
        {
            if matches!(column_block.what, Member::Sensor(own, _) if own == sensor) {
                column_block.set_calibration_point(&corrected, kelvin);
                // A reading may change at once.
                if column_block.calibration.is_some() {
                    self.held = None;
                }
            }
        }
    }

    /// Sets the variance that a sensor's offset has at present in addition to the covariance: of
    /// each channel [torque; force] [Nm^2, N^2], independent of all else. Initially zero.
    pub fn set_extra_variance(&mut self, sensor: usize, variance: [f64; 6]) {
        if let Some(slot) = self.extra.get_mut(sensor) {
            *slot = variance;
        }
    }

    /// Computes all standard deviations, for the solver's last solution at instant `t`.
    ///
    /// # Errors
    /// Sizes differ, or the solver has no solution for these kinematics. Nothing is changed then.
    pub fn update(
        &mut self,
        structure: &Structure,
        solver: &Solver,
        kinematics: &Kinematics,
        t: Nanos,
    ) -> Result<(), DynamicsError> {
        solver.check_structure(structure)?;
        let links = structure.link_count();
        check_size("links of the kinematics", kinematics.link_count(), links)?;
        check_size("sub-trees", self.subtrees.len(), structure.subtrees().len())?;
        check_size(
            "degrees of freedom",
            self.torque.len(),
            structure.dof_count(),
        )?;
        check_size("contacts", self.contacts.len(), structure.contacts().len())?;
        check_size("sensors", self.drifts.len(), structure.sensors().len())?;
        if !solver.is_solved(structure, kinematics) {
            return Err(DynamicsError::NotSolved);
        }
        let run_start = *self.run_start.get_or_insert(t);
        let key = Some((t.0.div_euclid(HELD.0), kinematics.base()));
        let is_due = self.held != key;
        self.held = key;
        Arch::new().dispatch(Update {
            propagation: self,
            structure,
            solver,
            kinematics,
            times: (t, run_start),
            is_due,
        });
        Ok(())
    }

    /// Standard deviations of the torques [Nm or N], by degree of freedom. Zero where all
    /// parameters that matter are exact.
    pub fn torque_std(&self) -> &[f64] {
        &self.torque
    }

    /// Covariance of each sub-tree's imbalance `b` [torque; force], at the origin of base
    /// coordinates [Nm, N]; zero where no sensor measures it.
    pub fn imbalance_covariances(&self) -> &[Matrix6<f64>] {
        &self.imbalances
    }

    /// Standard deviations of the contacts' wrenches, `[fx fy fz tx ty tz]` [N, Nm], in the order
    /// of the structure's.
    pub fn contact_std(&self) -> &[[f64; 6]] {
        &self.contacts
    }
}

/// The computation of [`Propagation::update`] after its checks, compiled for each level of vector
/// instructions.
struct Update<'a> {
    propagation: &'a mut Propagation,
    structure: &'a Structure,
    solver: &'a Solver,
    kinematics: &'a Kinematics,
    times: (Nanos, Nanos),
    /// Whether the wrenches are to be computed.
    is_due: bool,
}

impl WithSimd for Update<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            propagation,
            structure,
            solver,
            kinematics,
            times,
            is_due,
        } = self;
        let Propagation {
            subtrees,
            drifts,
            extra,
            readings,
            torque,
            contacts,
            imbalances,
            ..
        } = propagation;
        torque.fill(0.0);
        for (variance, (drift, extra)) in readings.iter_mut().zip(drifts.iter().zip(extra)) {
            let seconds = drift.known.elapsed(times.0, times.1);
            *variance = std::array::from_fn(|i| seconds * drift.rate[i] + extra[i]);
        }
        for ((part, subtree), imbalance) in subtrees
            .iter_mut()
            .zip(structure.subtrees())
            .zip(imbalances)
        {
            if is_due {
                part.update(simd, solver, kinematics);
            }
            part.add_readings(solver, readings);
            if !part.ends.is_empty() {
                *imbalance = part.covariance_of_all(simd);
            }
            for (index, link) in part.links.iter().enumerate().skip(1) {
                let Some(dof) = structure.dof_of(link.link) else {
                    continue;
                };
                let (axis, response) = solver.torque_rows(link.link);
                // The deviation of a sum is at most the sum of the deviations.
                torque[dof] += part.variance(simd, index, axis, response).sqrt();
            }
            for contact in subtree.contacts.iter() {
                let motions = solver.contact_rows(contact);
                for (deviation, motion) in contacts[contact].iter_mut().zip(motions) {
                    *deviation = part.variance_of_all(simd, motion).sqrt();
                }
            }
        }
    }
}
