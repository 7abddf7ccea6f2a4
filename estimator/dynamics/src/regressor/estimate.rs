//! Sensitivity of the solver's estimates to each inertial parameter and each offset: the rows that
//! carry a parameter covariance to joint torques and contact wrenches.
//!
//! The estimates are linear in the sum of net wrenches: `tau_j = s_j . F_j - h_j . b` and
//! `x_i = k_i . b` (derivation at the top of `solver.rs`). `s`, `h` and `k` depend on neither the
//! parameters nor the readings. So link `l` of the sub-tree enters a torque with the motion
//! `m_l = [l below j] s_j - h_j`, and a contact with `m_l = k_i`. Its ten coefficients are
//! `m_l^T X* A_l`. Those of the offset of an F/T sensor above link `l` (or, with the other sign,
//! below it) are `m_l` expressed in the sensor's measurement frame.

use super::link::{LINK_PARAMETERS, in_link_axes, row_along};
use super::subtree::spread;
use crate::error::{DynamicsError, check_size};
use crate::kinematics::{ExternalWrench, Kinematics, check_external, check_readings};
use crate::solver::Solver;
use crate::spatial::{Motion, Wrench};
use crate::structure::Structure;

/// Rows `T` of the estimates:
/// `estimate = T [phi; o] + part of the raw readings and of the known wrenches`, exactly.
///
/// With a covariance `P` of `[phi; o]`, the covariance of the estimates is `T P T^T`, to which F/T
/// noise adds that of [`Solver::update_deviations`]. `T` is also the sensitivity: the change of an
/// estimate per unit of a parameter or an offset [N or Nm per unit].
///
/// It borrows a solver with its last solution and the kinematics of that solution. The solution
/// also has the contacts that were present.
///
/// An estimate depends on one sub-tree ([`EstimateRows::torque_subtree`],
/// [`EstimateRows::contact_subtree`]). Its row has that sub-tree's columns only, in the order of
/// [`super::SubTreeRegressor`]: ten per link, ascending, then six per sensor at its ends,
/// ascending, [torque; force] in its measurement frame. [`EstimateRows::expand`] writes it over the
/// columns of all sub-trees.
#[derive(Clone, Copy, Debug)]
pub struct EstimateRows<'a> {
    structure: &'a Structure,
    solver: &'a Solver,
    kinematics: &'a Kinematics,
}

impl<'a> EstimateRows<'a> {
    /// The rows of a solution.
    ///
    /// # Errors
    /// The three are made for different models or structures (detected by their sizes). The solver
    /// has not solved yet, or its last solution is for another base or other joint positions
    /// (detected by the poses of the F/T sensors).
    pub fn new(
        structure: &'a Structure,
        solver: &'a Solver,
        kinematics: &'a Kinematics,
    ) -> Result<Self, DynamicsError> {
        solver.check_structure(structure)?;
        check_size(
            "links of the kinematics",
            kinematics.link_count(),
            structure.link_count(),
        )?;
        if !solver.is_solved(structure, kinematics) {
            return Err(DynamicsError::NotSolved);
        }
        Ok(Self {
            structure,
            solver,
            kinematics,
        })
    }

    /// The sub-tree on which a joint's torque depends; `None` if there is no such degree of
    /// freedom, or if its joints are in several sub-trees.
    pub fn torque_subtree(&self, dof: usize) -> Option<usize> {
        let links = self.structure.moved_by(dof).iter();
        let mut subtrees = links.map(|&link| self.structure.subtree_of(link));
        let first = subtrees.next()??;
        subtrees.all(|other| other == Some(first)).then_some(first)
    }

    /// The sub-tree on which a contact's wrench depends; `None` if there is no such contact.
    pub fn contact_subtree(&self, contact: usize) -> Option<usize> {
        self.structure
            .subtree_of(self.structure.contacts().get(contact)?.frame.link)
    }

    /// Number of columns of a sub-tree's rows: `10 links + 6 sensors`; `None` if there is no such
    /// sub-tree.
    pub fn column_count(&self, subtree: usize) -> Option<usize> {
        let tree = self.structure.subtrees().get(subtree)?;
        Some(LINK_PARAMETERS * self.structure.links_of(subtree).count() + 6 * tree.sensors.len())
    }

    /// Number of columns of all sub-trees: `10 N_B + 6 per sensor`.
    pub fn stacked_column_count(&self) -> usize {
        LINK_PARAMETERS * self.structure.link_count() + 6 * self.structure.sensors().len()
    }

    /// Writes a sub-tree's row over the columns of all sub-trees, zeros included: those of
    /// [`super::StackedRegressor`] without the contacts'.
    ///
    /// # Errors
    /// There is no such sub-tree, or the length of `row` or `stacked` is not the number of columns.
    /// Nothing is changed in that case.
    pub fn expand(
        &self,
        subtree: usize,
        row: &[f64],
        stacked: &mut [f64],
    ) -> Result<(), DynamicsError> {
        let columns = self.column_count(subtree).ok_or(DynamicsError::Index {
            what: "sub-trees",
            index: subtree,
            count: self.structure.subtrees().len(),
        })?;
        check_size("numbers of an estimate's row", row.len(), columns)?;
        check_size(
            "numbers of a stacked row",
            stacked.len(),
            self.stacked_column_count(),
        )?;
        stacked.fill(0.0);
        spread(self.structure, subtree, row, stacked);
        Ok(())
    }

    /// Writes the row of a joint's torque [Nm or N].
    ///
    /// # Errors
    /// There is no such degree of freedom, or the length of `row` is not the number of columns of
    /// its sub-tree. Nothing is changed in that case.
    pub fn torque_row(&self, dof: usize, row: &mut [f64]) -> Result<(), DynamicsError> {
        let subtree = self.place_of(dof)?;
        self.write(subtree, |other| self.torque_motion(dof, other), row)
    }

    /// Writes the row of a component of a contact's wrench, [torque; force] at the origin and in
    /// the axes of the contact's frame [Nm, N].
    ///
    /// # Errors
    /// There is no such contact or component, or the length of `row` is not the number of columns
    /// of its sub-tree. Nothing is changed in that case.
    pub fn contact_row(
        &self,
        contact: usize,
        component: usize,
        row: &mut [f64],
    ) -> Result<(), DynamicsError> {
        let (motion, subtree) = self.contact_motion(contact, component)?;
        self.write(subtree, |_| motion, row)
    }

    /// Contribution of the raw readings and known wrenches to a torque: the other part of the
    /// estimate.
    ///
    /// # Errors
    /// There is no such degree of freedom, the sizes do not fit, a reading is not finite, or a
    /// known wrench is on no link or not finite.
    pub fn torque_measured(
        &self,
        dof: usize,
        readings: &[Wrench],
        external: &[ExternalWrench],
    ) -> Result<f64, DynamicsError> {
        let subtree = self.place_of(dof)?;
        let motion = |other| self.torque_motion(dof, other);
        self.measured(subtree, motion, readings, external)
    }

    /// Contribution of the raw readings and known wrenches to a component of a contact's wrench
    /// [torque; force]: the other part of the estimate.
    ///
    /// # Errors
    /// There is no such contact or component, the sizes do not fit, a reading is not finite, or a
    /// known wrench is on no link or not finite.
    pub fn contact_measured(
        &self,
        contact: usize,
        component: usize,
        readings: &[Wrench],
        external: &[ExternalWrench],
    ) -> Result<f64, DynamicsError> {
        let (motion, subtree) = self.contact_motion(contact, component)?;
        self.measured(subtree, |_| motion, readings, external)
    }

    /// The sub-tree of the links that a degree of freedom moves.
    fn place_of(&self, dof: usize) -> Result<usize, DynamicsError> {
        self.torque_subtree(dof).ok_or(DynamicsError::Index {
            what: "degrees of freedom",
            index: dof,
            count: self.structure.dof_count(),
        })
    }

    /// Sum of `[other below j] s_j - h_j` over the joints of the degree of freedom.
    fn torque_motion(&self, dof: usize, other: usize) -> Motion {
        let links = self.structure.moved_by(dof).iter();
        links.fold(Motion::zero(), |sum, &link| {
            let (axis, response) = self.solver.torque_rows(link);
            if self.structure.below(link).contains(&other) {
                sum + *axis - *response
            } else {
                sum - *response
            }
        })
    }

    fn contact_motion(
        &self,
        contact: usize,
        component: usize,
    ) -> Result<(Motion, usize), DynamicsError> {
        let subtree = self.contact_subtree(contact).ok_or(DynamicsError::Index {
            what: "contacts",
            index: contact,
            count: self.structure.contacts().len(),
        })?;
        // The solver's order is force first.
        let motions = self.solver.contact_rows(contact);
        let motion = [3, 4, 5, 0, 1, 2]
            .get(component)
            .map(|&i: &usize| motions[i])
            .ok_or(DynamicsError::Index {
                what: "components of a wrench",
                index: component,
                count: 6,
            })?;
        Ok((motion, subtree))
    }

    fn write(
        &self,
        subtree: usize,
        motion: impl Fn(usize) -> Motion,
        row: &mut [f64],
    ) -> Result<(), DynamicsError> {
        let columns = self.column_count(subtree).unwrap_or(0);
        check_size("numbers of an estimate's row", row.len(), columns)?;
        let (links, offsets) =
            row.split_at_mut(columns - 6 * self.structure.subtrees()[subtree].sensors.len());
        for (out, link) in links
            .chunks_exact_mut(LINK_PARAMETERS)
            .zip(self.structure.links_of(subtree))
        {
            // The motion is transformed to the link, so that the ten columns need no transform to
            // the base.
            let in_link = self.kinematics.pose(link).twist_back(&motion(link));
            out.copy_from_slice(&row_along(
                &in_link,
                &in_link_axes(self.kinematics.motion(link)),
            ));
        }
        let sensors = self.structure.subtrees()[subtree].sensors;
        for (out, sensor) in offsets.chunks_exact_mut(6).zip(sensors.iter()) {
            out.copy_from_slice(&self.offset_row(subtree, sensor, &motion));
        }
        Ok(())
    }

    /// Coefficients of a sensor's offset [torque; force]. For a given raw reading an offset reduces
    /// the wrench that is subtracted from the net wrenches.
    fn offset_row(
        &self,
        subtree: usize,
        sensor: usize,
        motion: &impl Fn(usize) -> Motion,
    ) -> [f64; 6] {
        let cut = &self.structure.sensors()[sensor];
        let child = cut.joint() + 1;
        let (link, side) = if self.structure.subtree_of(child) == Some(subtree) {
            (child, 1.0)
        } else {
            (self.structure.parent_of(child), -1.0)
        };
        let in_sensor = self.solver.sensor_pose(sensor).twist_back(&motion(link));
        let factor = side * cut.sign();
        let (n, f) = (in_sensor.angular * factor, in_sensor.linear * factor);
        [n.x, n.y, n.z, f.x, f.y, f.z]
    }

    fn measured(
        &self,
        subtree: usize,
        motion: impl Fn(usize) -> Motion,
        readings: &[Wrench],
        external: &[ExternalWrench],
    ) -> Result<f64, DynamicsError> {
        check_readings(readings, self.structure.sensors().len())?;
        check_external(external, self.structure.link_count())?;
        let mut sum = 0.0;
        for sensor in self.structure.subtrees()[subtree].sensors.iter() {
            let row = self.offset_row(subtree, sensor, &motion);
            let reading = readings[sensor].torque_first();
            sum -= row.iter().zip(&reading).map(|(a, b)| a * b).sum::<f64>();
        }
        for known in external {
            let link = known.frame.link;
            if self.structure.subtree_of(link) == Some(subtree) {
                sum -= motion(link).dot(&known.in_base(self.kinematics));
            }
        }
        Ok(sum)
    }
}
