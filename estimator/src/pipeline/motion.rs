//! What errors of the motion do to torques and contact wrenches.
//!
//! ```text
//! x = [joint accelerations; joint positions; proper acceleration of the base; angular acceleration of the IMU]
//! variance = sum over x of S_ij^2 sigma_j^2,    S = d(torques and wrenches) / dx
//! ```
//!
//! with the sigma of differentiated accelerations as [`crate::differentiate`] states it, and errors
//! of different channels being independent. Positions are off by their noise, late stamps included,
//! and by an encoder's zero, [`ENCODER_ZERO`]; the base's proper acceleration by
//! [`BASE_ACCELERATION`], which is an IMU's bias and mounting, or that a fixed base is not level.
//! These are what robots are calibrated to, not what one robot has.
//!
//! A column of S is the difference that a little of x makes. S follows the posture alone: it is
//! found anew with the first estimate of each tenth of a second, and when contacts or base change.
//! By stamps, so that a replay which begins elsewhere finds the same. Errors of velocities are
//! smaller by an order of magnitude, and left out.

use crate::dynamics::{ContactSet, DynamicsError, FrameMotion, JointState, Kinematics, Solver, Structure};
use crate::model::Model;
use crate::spatial::{Pose, Wrench};
use nalgebra::{Matrix6, Vector6};
use proprio_topics::Nanos;

/// How long a posture counts as the same.
const CELL: Nanos = Nanos::from_millis(100);

/// Standard deviation of an encoder's zero \[rad\], a third of a degree; of a prismatic joint's
/// \[m\].
pub(super) const ENCODER_ZERO: [f64; 2] = [0.005, 0.001];

/// Standard deviation of the base's proper acceleration, each axis \[m/s^2\]: a hundredth of
/// gravity, or 0.6 degrees of level.
const BASE_ACCELERATION: f64 = 0.1;

/// How far positions are moved to see what that does \[rad, m\].
const STEP: f64 = 1e-4;

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
    /// Standard deviations of x. Zero where it is exact.
    sigma: Vec<f64>,
    /// Column by column: torques, then six numbers per contact, then the imbalance of each
    /// sub-tree.
    sensitivity: Vec<f64>,
    is_known: Vec<bool>,
    /// What the columns belong to.
    of: Option<(ContactSet, usize, i64)>,
    perturbed: Vec<f64>,
    /// Of each torque, then of `[fx fy fz tx ty tz]` of each contact.
    deviation: Vec<f64>,
    dofs: usize,
    /// How many numbers a column has.
    rows: usize,
}

impl MotionErrors {
    pub(super) fn new(model: &Model, structure: &Structure, base_link: usize) -> Result<Self, DynamicsError> {
        let dofs = model.dof_count();
        let contacts = structure.contacts().len();
        let (columns, rows) = (2 * dofs + 6, dofs + 6 * (contacts + structure.subtrees().len()));
        let mut sigma = vec![0.0; columns];
        sigma[2 * dofs..2 * dofs + 3].fill(BASE_ACCELERATION);
        Ok(Self {
            kinematics: Kinematics::new(model, base_link)?,
            solver: Solver::new(structure),
            sigma,
            sensitivity: vec![0.0; columns * rows],
            is_known: vec![false; columns],
            of: None,
            perturbed: vec![0.0; 2 * dofs],
            deviation: vec![0.0; dofs + 6 * contacts],
            dofs,
            rows,
        })
    }

    /// Says what a joint's acceleration and position are uncertain by.
    pub(super) fn set_joint(&mut self, dof: usize, acceleration: f64, position: f64) {
        if let [of_accelerations, of_positions] = self.halves()
            && let (Some(a), Some(q)) = (of_accelerations.get_mut(dof), of_positions.get_mut(dof))
        {
            (*a, *q) = (acceleration, position);
        }
    }

    fn halves(&mut self) -> [&mut [f64]; 2] {
        let (accelerations, rest) = self.sigma.split_at_mut(self.dofs);
        [accelerations, rest.get_mut(..self.dofs).unwrap_or_default()]
    }

    /// Says what the IMU's angular acceleration is uncertain by.
    pub(super) fn set_angular(&mut self, deviation: &[f64; 3]) {
        let places = self.sigma.iter_mut().rev();
        places.zip(deviation.iter().rev()).for_each(|(to, from)| *to = *from);
    }

    /// Finds the deviations at an instant. Does not allocate.
    ///
    /// # Errors
    /// Sizes that differ, or a number that is not finite.
    pub(super) fn update(&mut self, instant: &Instant<'_>) -> Result<(), DynamicsError> {
        self.deviation.fill(0.0);
        let of = Some((*instant.active, instant.base_link, instant.t.0.div_euclid(CELL.0)));
        if self.of != of {
            self.is_known.fill(false);
            if self.kinematics.base() != instant.base_link {
                self.kinematics.set_base(instant.model, instant.base_link)?;
            }
            self.of = of;
        }
        for column in 0..self.is_known.len() {
            let matters = self.sigma.get(column).is_some_and(|sigma| *sigma > 0.0);
            let is_known = self.is_known.get(column).is_some_and(|known| *known);
            if matters && !is_known {
                self.probe(column, instant)?;
            }
        }
        for (column, sigma) in self.sensitivity.chunks_exact(self.rows).zip(&self.sigma) {
            if *sigma > 0.0 {
                for (sum, s) in self.deviation.iter_mut().zip(column) {
                    *sum += (s * sigma).powi(2);
                }
            }
        }
        self.deviation.iter_mut().for_each(|sum| *sum = sum.sqrt());
        Ok(())
    }

    /// What a unit of x changes.
    fn probe(&mut self, column: usize, instant: &Instant<'_>) -> Result<(), DynamicsError> {
        let dofs = self.dofs;
        let (accelerations, positions) = self.perturbed.split_at_mut(dofs);
        accelerations.copy_from_slice(instant.state.acceleration);
        positions.copy_from_slice(instant.state.position);
        let mut base = *instant.base;
        let step = if (dofs..2 * dofs).contains(&column) { STEP } else { 1.0 };
        if let Some(value) = self.perturbed.get_mut(column) {
            *value += step;
        } else {
            // Of the IMU, where there is one: its axes are those of its errors.
            let mut motion = instant.imu.map_or(base, |(measured, _)| *measured);
            let axis = column - 2 * dofs;
            let place = match axis.checked_sub(3) {
                None => motion.proper_acceleration.get_mut(axis),
                Some(axis) => motion.angular_acceleration.get_mut(axis),
            };
            place.into_iter().for_each(|x| *x += 1.0);
            base = instant
                .imu
                .map_or(motion, |(_, pose)| FrameMotion::of_link_from_imu(&motion, pose));
        }
        let (acceleration, position) = self.perturbed.split_at(dofs);
        let state = JointState {
            acceleration,
            position,
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
        let Some(to) = self.sensitivity.chunks_exact_mut(self.rows).nth(column) else {
            return Ok(());
        };
        let (torques, contacts) = to.split_at_mut(self.dofs);
        for ((to, with), without) in torques
            .iter_mut()
            .zip(self.solver.torque())
            .zip(instant.solver.torque())
        {
            *to = (with - without) / step;
        }
        let mut sixes = contacts.chunks_exact_mut(6);
        let results = self.solver.contacts().iter().zip(instant.solver.contacts());
        for ((with, without), six) in results.zip(&mut sixes) {
            let difference = (with.wrench - without.wrench).force_first();
            six.iter_mut().zip(difference).for_each(|(to, x)| *to = x / step);
        }
        for (number, six) in sixes.enumerate() {
            let [with, without] = [&self.solver, instant.solver].map(|s| s.imbalance(instant.structure, number));
            let difference = (with - without).torque_first();
            six.iter_mut().zip(difference).for_each(|(to, x)| *to = x / step);
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

    /// Covariance of a sub-tree's imbalance [torque; force], at the origin of base coordinates.
    pub(super) fn imbalance(&self, number: usize) -> Matrix6<f64> {
        let first = self.deviation.len() + 6 * number;
        let mut covariance = Matrix6::zeros();
        for (column, sigma) in self.sensitivity.chunks_exact(self.rows).zip(&self.sigma) {
            if *sigma > 0.0
                && let Some(six) = column.get(first..first + 6)
            {
                let six = Vector6::from_column_slice(six) * *sigma;
                covariance += six * six.transpose();
            }
        }
        covariance
    }
}
