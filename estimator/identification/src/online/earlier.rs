//! The start from an earlier identification: its parameters are in use from the beginning, and its
//! covariance is information beside the prior.

use crate::linear::information::{InformationError, Panel, check_size};
use crate::online::component::ComponentLayout;
use crate::online::parameters::ParameterEstimate;
use crate::online::{Online, OnlineError};
use nalgebra::DMatrix;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::spatial::RigidInertia;

/// What an earlier identification says about a component.
struct EarlierParameters {
    /// Places of its links among those of the component, and their inertias.
    bodies: Vec<(usize, RigidInertia)>,
    /// Columns of these parameters in `[s | d]`, and their values relative to CAD.
    values: Vec<(usize, f64)>,
    deviations: Vec<f64>,
    /// `U` of these columns alone, scaled by their deviations `S`: `P = S U^T U S`.
    upper: DMatrix<f64>,
}

impl EarlierParameters {
    /// None if the component has none of these links.
    fn new(
        layout: &ComponentLayout,
        links: &[(usize, RigidInertia)],
        root: &DMatrix<f64>,
    ) -> Option<Self> {
        let (mut bodies, mut values, mut of_root) = (Vec::new(), Vec::new(), Vec::new());
        for (place, link) in layout.links.iter().enumerate() {
            let Some(at) = links.iter().position(|(number, _)| number == link) else {
                continue;
            };
            let first = layout.offset_count() + LINK_PARAMETERS * place;
            let found = links[at].1.parameters().into_iter().zip(first..);
            values.extend(found.map(|(found, i)| (i, found - layout.reference[i])));
            of_root.extend(LINK_PARAMETERS * at..LINK_PARAMETERS * (at + 1));
            bodies.push((place, links[at].1));
        }
        if values.is_empty() {
            return None;
        }
        let mut own = root.select_columns(&of_root);
        let deviations: Vec<f64> = own.column_iter().map(|column| column.norm()).collect();
        for (mut column, deviation) in own.column_iter_mut().zip(&deviations) {
            column /= *deviation;
        }
        Some(Self {
            bodies,
            values,
            deviations,
            upper: own.qr().r(),
        })
    }

    /// The whitened error `U^-T S^-1 (d - d_0)` as rows.
    fn rows(&self, unknowns: usize) -> Result<Panel, InformationError> {
        let inverse = self.upper.transpose().try_inverse();
        let inverse = inverse.filter(|inverse| inverse.iter().all(|x| x.is_finite()));
        let count = self.values.len();
        let Some(inverse) = inverse.filter(|_| self.upper.nrows() == count) else {
            let unknown = self.values[0].0;
            return Err(InformationError::Undetermined { unknown });
        };
        let mut panel = Panel::new(unknowns, count);
        for whitened in inverse.row_iter() {
            let (mut row, mut right) = (vec![0.0; unknowns], 0.0);
            let scaled = whitened.iter().zip(&self.deviations);
            for (&(column, value), (weight, deviation)) in self.values.iter().zip(scaled) {
                row[column] = weight / deviation;
                right += row[column] * value;
            }
            panel.push_row(&row, right)?;
        }
        Ok(panel)
    }

    /// These parameters in place of those before; other links keep theirs.
    fn replace(&self, mut begun: ParameterEstimate, offset_count: usize) -> ParameterEstimate {
        let (rows, parameters) = begun.root.shape();
        let count = self.values.len();
        begun.root = begun.root.resize_vertically(rows + count, 0.0);
        for (j, (&(column, value), deviation)) in
            self.values.iter().zip(&self.deviations).enumerate()
        {
            begun.change[column - offset_count] = value;
            begun.root.column_mut(column - offset_count).fill(0.0);
            for i in 0..=j {
                begun.root[(rows + i, column - offset_count)] = self.upper[(i, j)] * deviation;
            }
        }
        begun.root = begun.root.qr().r();
        begun.tau = f64::NAN;
        debug_assert_eq!(begun.root.ncols(), parameters);
        begun
    }
}

impl Online {
    /// Starts from an earlier identification: these links have these inertias, with `root^T root`
    /// the covariance of their ten parameters each, in this order. Their errors are taken as
    /// Gaussian. The prior about CAD remains. It is already in these parameters, so that it counts
    /// twice, but little beside them.
    ///
    /// # Errors
    /// The root has another width, or a covariance that is not positive definite in some component.
    /// Then that component and those after it are unchanged.
    pub fn begin_with(
        &mut self,
        links: &[(usize, RigidInertia)],
        root: &DMatrix<f64>,
    ) -> Result<(), OnlineError> {
        let width = LINK_PARAMETERS * links.len();
        check_size("columns of the covariance's root", root.ncols(), width)?;
        let known = &mut self.solution.components;
        for (number, (component, known)) in self.components.iter_mut().zip(known).enumerate() {
            let layout = &component.layout;
            let Some(earlier) = EarlierParameters::new(layout, links, root) else {
                continue;
            };
            let mut rows = earlier.rows(layout.reference.len())?;
            component.information.absorb(&mut rows)?;
            for (place, body) in &earlier.bodies {
                known.bodies[*place] = *body;
            }
            // In use from the beginning.
            let job = self.job.as_mut();
            let Some(part) = job.and_then(|job| job.components.get_mut(number)) else {
                continue;
            };
            let before = part.selection.in_use().clone();
            let mut begun = earlier.replace(before, component.layout.offset_count());
            begun.bodies.clone_from(&known.bodies);
            part.selection.replace_all(begun);
            part.write_solution(known);
            part.last_valid.clone_from(known);
        }
        Ok(())
    }
}
