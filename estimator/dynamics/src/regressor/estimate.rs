//! Sensitivity of the solver's estimates to each inertial parameter and each offset: the rows that
//! carry a parameter covariance to joint torques.
//!
//! A torque is linear in the sum of net wrenches: `tau_j = s_j . F_j - h_j . b` (derivation at the
//! top of `solver.rs`). `s` and `h` depend on neither the parameters nor the readings. So link `l`
//! of the sub-tree enters a torque with the motion `m_l = [l below j] s_j - h_j`. Its ten
//! coefficients are `m_l^T X* A_l`. Those of the offset of an F/T sensor above link `l` (or, with
//! the other sign, below it) are `m_l` expressed in the sensor's measurement frame.

use super::link::{LINK_PARAMETERS, link_regressor, row_along};
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
/// A row has the columns of all sub-trees: ten per link, ascending, then six per sensor, ascending,
/// [torque; force] in its measurement frame. An estimate depends on one sub-tree
/// ([`EstimateRows::torque_subtree`]): the row is zero in the columns of the others.
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

    /// Number of columns, `10 N_B + 6 per sensor`.
    pub fn column_count(&self) -> usize {
        LINK_PARAMETERS * self.structure.link_count() + 6 * self.structure.sensors().len()
    }

    /// Writes the row of a joint's torque [Nm or N], zeros included.
    ///
    /// # Errors
    /// There is no such degree of freedom, its joints are in several sub-trees, or the length of
    /// `row` is not the number of columns. Nothing is changed in that case.
    pub fn torque_row(&self, dof: usize, row: &mut [f64]) -> Result<(), DynamicsError> {
        let subtree = self.one_subtree(dof)?;
        check_size(
            "numbers of an estimate's row",
            row.len(),
            self.column_count(),
        )?;
        row.fill(0.0);
        let (links, offsets) = row.split_at_mut(LINK_PARAMETERS * self.structure.link_count());
        let links = links.as_chunks_mut::<LINK_PARAMETERS>().0;
        for link in self.structure.links_of(subtree) {
            // The motion is transformed to the link, so that the ten columns need no transform to
            // the base.
            let in_link = self
                .kinematics
                .pose(link)
                .twist_back(&self.torque_motion(dof, link));
            links[link] = row_along(&in_link, &link_regressor(self.kinematics.motion(link)));
        }
        let offsets = offsets.as_chunks_mut::<6>().0;
        for sensor in self.structure.subtrees()[subtree].sensors.iter() {
            offsets[sensor] = self.offset_row(dof, subtree, sensor);
        }
        Ok(())
    }

    /// Contribution of the raw readings and known wrenches to a torque: the other part of the
    /// estimate.
    ///
    /// # Errors
    /// There is no such degree of freedom, its joints are in several sub-trees, the sizes do not
    /// fit, a reading is not finite, or a known wrench is on no link or not finite.
    pub fn torque_measured(
        &self,
        dof: usize,
        readings: &[Wrench],
        external: &[ExternalWrench],
    ) -> Result<f64, DynamicsError> {
        let subtree = self.one_subtree(dof)?;
        check_readings(readings, self.structure.sensors().len())?;
        check_external(external, self.structure.link_count())?;
        let mut sum = 0.0;
        for sensor in self.structure.subtrees()[subtree].sensors.iter() {
            let row = self.offset_row(dof, subtree, sensor);
            let reading = readings[sensor].torque_first();
            sum -= row.iter().zip(&reading).map(|(a, b)| a * b).sum::<f64>();
        }
        for known in external {
            let link = known.frame.link;
            if self.structure.subtree_of(link) == Some(subtree) {
                let wrench = known.in_base(self.kinematics);
                sum -= self.torque_motion(dof, link).dot(&wrench);
            }
        }
        Ok(sum)
    }

    /// The sub-tree of the links that a degree of freedom moves.
    fn one_subtree(&self, dof: usize) -> Result<usize, DynamicsError> {
        self.torque_subtree(dof).ok_or(DynamicsError::Index {
            what: "degrees of freedom",
            index: dof,
            count: self.structure.dof_count(),
        })
    }

    /// Sum of `[link below j] s_j - h_j` over the joints of the degree of freedom.
    fn torque_motion(&self, dof: usize, link: usize) -> Motion {
        let moved = self.structure.moved_by(dof).iter();
        moved.fold(Motion::zero(), |sum, &top| {
            let (axis, response) = self.solver.torque_rows(top);
            if self.structure.below(top).contains(&link) {
                sum + *axis - *response
            } else {
                sum - *response
            }
        })
    }

    /// Coefficients of a sensor's offset [torque; force]. For a given raw reading an offset reduces
    /// the wrench that is subtracted from the net wrenches.
    fn offset_row(&self, dof: usize, subtree: usize, sensor: usize) -> [f64; 6] {
        let cut = &self.structure.sensors()[sensor];
        let child = cut.joint() + 1;
        let (link, side) = if self.structure.subtree_of(child) == Some(subtree) {
            (child, 1.0)
        } else {
            (self.structure.parent_of(child), -1.0)
        };
        let motion = self.torque_motion(dof, link);
        let in_sensor = self.solver.sensor_pose(sensor).twist_back(&motion);
        let factor = side * cut.sign();
        let (n, f) = (in_sensor.angular * factor, in_sensor.linear * factor);
        [n.x, n.y, n.z, f.x, f.y, f.z]
    }
}
