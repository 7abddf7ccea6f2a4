//! What errors of differentiated motion do to torques and contact wrenches.
//!
//! ```text
//! torques and wrenches = S a + what positions, velocities and readings give,    a = [joint accelerations; angular acceleration of the IMU]
//! variance = sum over a of S_ij^2 sigma_j^2
//! ```
//!
//! with sigma as [`crate::differentiate`] states it, errors of different channels being independent. Forces are linear in accelerations, so a column of S is the difference
//! that one unit of acceleration makes. S follows the posture alone: it is found anew with the first estimate of each tenth of a second, and when contacts or base
//! change. By stamps, so that a replay which begins elsewhere finds the same. Errors of positions and velocities are smaller by orders of magnitude, and left out; so is the noise of the IMU's proper acceleration.

use crate::dynamics::{ContactSet, DynamicsError, FrameMotion, JointState, Kinematics, Solver, Structure};
use crate::model::Model;
use crate::spatial::{Pose, Wrench};
use proprio_topics::Nanos;

/// How long a posture counts as the same.
const CELL: Nanos = Nanos::from_millis(100);

/// All that an estimate is made of.
pub(super) struct Instant<'a> {
    pub(super) t: Nanos,
    pub(super) model: &'a Model,
    pub(super) structure: &'a Structure,
    pub(super) state: JointState<'a>,
    /// How the base's link moves; where an IMU tells, how that moves, and its pose in the link.
    pub(super) base: &'a FrameMotion,
    pub(super) imu: Option<(&'a FrameMotion, &'a Pose)>,
    pub(super) readings: &'a [Wrench],
    pub(super) active: &'a ContactSet,
    /// What these give, and from which link on.
    pub(super) solver: &'a Solver,
    pub(super) base_link: usize,
}

/// The errors of an estimate that come from accelerations.
pub(super) struct MotionErrors {
    kinematics: Kinematics,
    solver: Solver,
    /// Standard deviations: of each joint's acceleration, then of the IMU's angular acceleration. Zero where it is measured, or exact.
    pub(super) acceleration: Vec<f64>,
    /// Column by column: torques, then six numbers per contact.
    sensitivity: Vec<f64>,
    is_known: Vec<bool>,
    /// What the columns belong to.
    of: Option<(ContactSet, usize, i64)>,
    perturbed: Vec<f64>,
    /// Of each torque, then of `[fx fy fz tx ty tz]` of each contact.
    deviation: Vec<f64>,
    dofs: usize,
}

impl MotionErrors {
    pub(super) fn new(model: &Model, structure: &Structure, base_link: usize) -> Result<Self, DynamicsError> {
        let dofs = model.dof_count();
        let (columns, rows) = (dofs + 3, dofs + 6 * structure.contacts().len());
        Ok(Self {
            kinematics: Kinematics::new(model, base_link)?,
            solver: Solver::new(structure),
            acceleration: vec![0.0; columns],
            sensitivity: vec![0.0; columns * rows],
            is_known: vec![false; columns],
            of: None,
            perturbed: vec![0.0; dofs],
            deviation: vec![0.0; rows],
            dofs,
        })
    }

    /// Finds the deviations at an instant. Does not allocate.
    ///
    /// # Errors
    /// Sizes that differ, or a number that is not finite.
    pub(super) fn update(&mut self, instant: &Instant<'_>) -> Result<(), DynamicsError> {
        self.deviation.fill(0.0);
        if self.acceleration.iter().all(|sigma| *sigma == 0.0) {
            return Ok(());
        }
        let of = Some((*instant.active, instant.base_link, instant.t.0.div_euclid(CELL.0)));
        if self.of != of {
            self.is_known.fill(false);
            if self.kinematics.base() != instant.base_link {
                self.kinematics.set_base(instant.model, instant.base_link)?;
            }
            self.of = of;
        }
        for column in 0..self.is_known.len() {
            let matters = self.acceleration.get(column).is_some_and(|sigma| *sigma > 0.0);
            let is_known = self.is_known.get(column).is_some_and(|known| *known);
            if matters && !is_known {
                self.probe(column, instant)?;
            }
        }
        let rows = self.deviation.len();
        for (column, sigma) in self.sensitivity.chunks_exact(rows).zip(&self.acceleration) {
            if *sigma > 0.0 {
                for (sum, s) in self.deviation.iter_mut().zip(column) {
                    *sum += (s * sigma).powi(2);
                }
            }
        }
        self.deviation.iter_mut().for_each(|sum| *sum = sum.sqrt());
        Ok(())
    }

    /// What one unit of an acceleration changes.
    fn probe(&mut self, column: usize, instant: &Instant<'_>) -> Result<(), DynamicsError> {
        self.perturbed.copy_from_slice(instant.state.acceleration);
        let mut base = *instant.base;
        match (self.perturbed.get_mut(column), instant.imu) {
            (Some(acceleration), _) => *acceleration += 1.0,
            (None, Some((measured, pose))) => {
                let mut measured = *measured;
                if let Some(axis) = measured.angular_acceleration.get_mut(column - self.dofs) {
                    *axis += 1.0;
                }
                base = FrameMotion::of_link_from_imu(&measured, pose);
            }
            // No IMU: nothing changes.
            (None, None) => {}
        }
        let state = JointState {
            acceleration: &self.perturbed,
            ..instant.state
        };
        self.kinematics.update(instant.model, state, &base)?;
        self.solver.solve(
            instant.model,
            instant.structure,
            &self.kinematics,
            instant.readings,
            instant.active,
            &[],
        )?;
        let rows = self.deviation.len();
        let Some(to) = self.sensitivity.chunks_exact_mut(rows).nth(column) else {
            return Ok(());
        };
        let (torques, contacts) = to.split_at_mut(self.dofs);
        for ((to, with), without) in torques
            .iter_mut()
            .zip(self.solver.torque())
            .zip(instant.solver.torque())
        {
            *to = with - without;
        }
        let results = self.solver.contacts().iter().zip(instant.solver.contacts());
        for (six, (with, without)) in contacts.chunks_exact_mut(6).zip(results) {
            let difference = (with.wrench - without.wrench).force_first();
            six.copy_from_slice(&difference);
        }
        if let Some(known) = self.is_known.get_mut(column) {
            *known = true;
        }
        Ok(())
    }

    /// Of each torque [Nm or N].
    pub(super) fn torques(&self) -> &[f64] {
        self.deviation.get(..self.dofs).unwrap_or_default()
    }

    /// Of each contact's wrench, `[fx fy fz tx ty tz]` [N, Nm].
    pub(super) fn contacts(&self) -> impl Iterator<Item = &[f64]> {
        self.deviation.get(self.dofs..).unwrap_or_default().chunks_exact(6)
    }
}
