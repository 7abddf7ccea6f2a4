//! Standard deviations of torques and contact wrenches from errors of the motion, by first-order
//! error propagation.
//!
//! ```text
//! x = [joint accelerations; joint positions;
//!      proper acceleration of the base; angular acceleration of the IMU]
//! variance_i = sum over j of S_ij^2 sigma_j^2,    S = d(torques and wrenches) / dx
//! ```
//!
//! The sigma of differentiated accelerations comes from [`crate::differentiate`]. Errors of
//! different channels are independent. The error of a position is its noise, which includes the
//! jitter of stamps, and the encoder offset, [`ENCODER_OFFSET_STD`]. The error of the base's proper
//! acceleration is [`BASE_ACCELERATION_STD`]: bias and mounting of an IMU, or a fixed base that is
//! not level; both errors grow where an immediate estimate extrapolates. These two are typical
//! calibration accuracies, not properties of one robot.
//!
//! A column of S is a finite difference. S is computed with the first estimate of each tenth of a
//! second and when contacts or base change or a contact jumps, and held in between. The tenths are
//! those of the stamps, so that a replay which begins elsewhere gives the same. Errors of
//! velocities are smaller by an order of magnitude and are neglected.

use nalgebra::{Matrix6, Vector6};
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{Pose, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, DynamicsError, FrameMotion, JointState, Kinematics,
    Solver, Structure,
};
use proprio_topics::{Nanos, Source};
use pulp::{Arch, Simd, WithSimd};

/// How long sensitivities are used before they are computed again.
const POSTURE_PERIOD: Nanos = Nanos::from_millis(100);

/// Standard deviation of an encoder's offset: revolute joint \[rad\], a third of a degree;
/// prismatic joint \[m\].
const ENCODER_OFFSET_STD: [f64; 2] = [0.005, 0.001];

/// Standard deviation of the base's proper acceleration, each axis \[m/s^2\]: a hundredth of
/// gravity, or a tilt of 0.6 degrees.
const BASE_ACCELERATION_STD: f64 = 0.1;

/// Step of positions for finite differences \[rad, m\].
const STEP: f64 = 1e-4;

/// A contact that moves less than this \[m\], or turns less \[rad\], within a tenth of a second
/// does not change S more than the motion of the robot does in that time.
const JUMP: [f64; 2] = [0.01, 0.1];

/// The point of linearisation: a solution, with all that it was computed from.
pub(crate) struct OperatingPoint<'a> {
    pub(crate) t: Nanos,
    pub(crate) model: &'a Model,
    pub(crate) structure: &'a Structure,
    pub(crate) state: JointState<'a>,
    /// Motion of the base link; if an IMU measures it, the IMU's motion and its pose in the link.
    pub(crate) base: &'a FrameMotion,
    pub(crate) imu: Option<&'a (FrameMotion, Pose)>,
    pub(crate) readings: &'a [Wrench],
    pub(crate) active: &'a ContactSet,
    pub(crate) kinematics: &'a Kinematics,
    pub(crate) solver: &'a Solver,
}

/// Standard deviations of a joint's measured state beside its encoder's offset.
#[derive(Clone, Copy, Debug)]
pub(crate) struct JointStd {
    /// Of the acceleration \[rad/s^2 or m/s^2\].
    pub(crate) acceleration: f64,
    /// Of a sample of the position \[rad or m\].
    pub(crate) noise: f64,
    /// What extrapolation adds to that.
    pub(crate) extrapolation: f64,
}

/// Adds the squares of each column's first numbers, times its sigma.
struct AddSquares<'a> {
    columns: &'a [f64],
    rows: usize,
    sigma: &'a [f64],
    sums: &'a mut [f64],
}

impl WithSimd for AddSquares<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (column, sigma) in self.columns.chunks_exact(self.rows).zip(self.sigma) {
            if *sigma > 0.0 {
                for (sum, s) in self.sums.iter_mut().zip(column) {
                    *sum += (s * sigma) * (s * sigma);
                }
            }
        }
    }
}

fn has_jumped(before: &ContactSpec, now: &ContactSpec) -> bool {
    let [jump, turn] = JUMP;
    let is_turned = match (before.kind, now.kind) {
        (ContactKind::ForceAlong(before), ContactKind::ForceAlong(now)) => {
            (now - before).norm() > turn
        }
        _ => false,
    };
    is_turned || (now.position - before.position).norm() > jump
}

/// Standard deviations of an estimate from errors of the motion.
pub(super) struct MotionErrors {
    kinematics: Kinematics,
    solver: Solver,
    /// Standard deviations of x; zero where it is exact.
    sigma: Vec<f64>,
    /// Of the encoders' offsets, by degree of freedom.
    encoder_offset: Vec<f64>,
    /// S, column by column: torques, then six numbers per contact, then the imbalance of each
    /// sub-tree.
    sensitivity: Vec<f64>,
    /// Which columns of S are computed.
    is_known: Vec<bool>,
    /// The contacts, base link and tenth of a second that S is valid for.
    valid_for: Option<(ContactSet, usize, i64)>,
    /// The contacts that S is valid for.
    contacts: Vec<ContactSpec>,
    perturbed: Vec<f64>,
    /// Standard deviation of each torque, then of `[fx fy fz tx ty tz]` of each contact.
    deviation: Vec<f64>,
    dofs: usize,
    /// Rows of S.
    rows: usize,
}

impl MotionErrors {
    pub(super) fn new(
        model: &Model,
        structure: &Structure,
        base_link: usize,
    ) -> Result<Self, DynamicsError> {
        let dofs = model.dof_count();
        let contacts = structure.contacts().len();
        let (columns, rows) = (
            2 * dofs + 6,
            dofs + 6 * (contacts + structure.subtrees().len()),
        );
        let mut sigma = vec![0.0; columns];
        sigma[2 * dofs..2 * dofs + 3].fill(BASE_ACCELERATION_STD);
        Ok(Self {
            kinematics: Kinematics::new(model, base_link)?,
            solver: Solver::new(structure),
            sigma,
            encoder_offset: (0..dofs)
                .map(|dof| ENCODER_OFFSET_STD[usize::from(model.is_prismatic(dof))])
                .collect(),
            sensitivity: vec![0.0; columns * rows],
            is_known: vec![false; columns],
            valid_for: None,
            contacts: structure.contacts().to_vec(),
            perturbed: vec![0.0; 2 * dofs],
            deviation: vec![0.0; dofs + 6 * contacts],
            dofs,
            rows,
        })
    }

    /// Sets how uncertain a joint's measured state is.
    pub(super) fn set_joint(&mut self, dof: usize, deviations: JointStd) {
        let JointStd {
            acceleration,
            noise,
            extrapolation,
        } = deviations;
        let (accelerations, rest) = self.sigma.split_at_mut(self.dofs);
        if let (Some(to), Some(position), Some(offset)) = (
            accelerations.get_mut(dof),
            rest.get_mut(dof),
            self.encoder_offset.get(dof),
        ) {
            *to = acceleration;
            *position = sum_of_squares([*offset, noise, extrapolation]).sqrt();
        }
    }

    /// Sets the standard deviations of an IMU's angular acceleration, and what extrapolation adds
    /// to those of its proper acceleration.
    pub(super) fn set_imu(&mut self, angular: &[f64; 3], extrapolation: &[f64; 3]) {
        let base = self.sigma.get_mut(2 * self.dofs..).unwrap_or_default();
        if let [px, py, pz, turn @ ..] = base {
            for (to, from) in [px, py, pz].into_iter().zip(extrapolation) {
                *to = BASE_ACCELERATION_STD.hypot(*from);
            }
            for (to, from) in turn.iter_mut().zip(angular) {
                *to = *from;
            }
        }
    }

    /// Computes the standard deviations at an instant. Does not allocate.
    ///
    /// # Errors
    /// Sizes differ, or a number is not finite.
    pub(super) fn update(&mut self, point: &OperatingPoint<'_>) -> Result<(), DynamicsError> {
        self.deviation.fill(0.0);
        let key = Some((
            *point.active,
            point.kinematics.base(),
            point.t.0.div_euclid(POSTURE_PERIOD.0),
        ));
        let contacts = point.structure.contacts();
        let mut pairs = self.contacts.iter().zip(contacts);
        if self.valid_for != key || pairs.any(|(before, now)| has_jumped(before, now)) {
            self.contacts.clone_from_slice(contacts);
            self.is_known.fill(false);
            self.kinematics
                .set_base(point.model, point.kinematics.base())?;
            self.valid_for = key;
        }
        for column in 0..self.is_known.len() {
            let matters = self.sigma.get(column).is_some_and(|sigma| *sigma > 0.0);
            let is_known = self.is_known.get(column).is_some_and(|known| *known);
            if matters && !is_known {
                self.compute_sensitivity(column, point)?;
            }
        }
        Arch::new().dispatch(AddSquares {
            columns: &self.sensitivity,
            rows: self.rows,
            sigma: &self.sigma,
            sums: &mut self.deviation,
        });
        self.deviation.iter_mut().for_each(|sum| *sum = sum.sqrt());
        Ok(())
    }

    /// Computes one column of S by a finite difference.
    fn compute_sensitivity(
        &mut self,
        column: usize,
        point: &OperatingPoint<'_>,
    ) -> Result<(), DynamicsError> {
        let dofs = self.dofs;
        let (accelerations, positions) = self.perturbed.split_at_mut(dofs);
        accelerations.copy_from_slice(point.state.acceleration);
        positions.copy_from_slice(point.state.position);
        let mut base = *point.base;
        let step = if (dofs..2 * dofs).contains(&column) {
            STEP
        } else {
            1.0
        };
        if let Some(value) = self.perturbed.get_mut(column) {
            *value += step;
        } else {
            // If there is an IMU, perturb its motion: the errors are along the IMU's axes.
            let mut motion = point.imu.map_or(base, |(measured, _)| *measured);
            let axis = column - 2 * dofs;
            let place = match axis.checked_sub(3) {
                None => motion.proper_acceleration.get_mut(axis),
                Some(axis) => motion.angular_acceleration.get_mut(axis),
            };
            place.into_iter().for_each(|x| *x += 1.0);
            base = point.imu.map_or(motion, |(_, pose)| {
                FrameMotion::of_link_from_imu(&motion, pose)
            });
        }
        let (acceleration, position) = self.perturbed.split_at(dofs);
        let state = JointState {
            acceleration,
            position,
            ..point.state
        };
        self.kinematics.update(point.model, state, &base)?;
        self.solver.solve(
            point.model,
            point.structure,
            &self.kinematics,
            point.readings,
            point.active,
            &[],
        )?;
        let Some(to) = self.sensitivity.chunks_exact_mut(self.rows).nth(column) else {
            return Ok(());
        };
        let (torques, contacts) = to.split_at_mut(self.dofs);
        for ((to, with), without) in torques
            .iter_mut()
            .zip(self.solver.torque())
            .zip(point.solver.torque())
        {
            *to = (with - without) / step;
        }
        let mut sixes = contacts.chunks_exact_mut(6);
        let results = self.solver.contacts().iter().zip(point.solver.contacts());
        for ((with, without), six) in results.zip(&mut sixes) {
            let difference = (with.wrench - without.wrench).force_first();
            six.iter_mut()
                .zip(difference)
                .for_each(|(to, x)| *to = x / step);
        }
        for (number, six) in sixes.enumerate() {
            let [with, without] =
                [&self.solver, point.solver].map(|s| s.imbalance(point.structure, number));
            let difference = (with - without).torque_first();
            six.iter_mut()
                .zip(difference)
                .for_each(|(to, x)| *to = x / step);
        }
        if let Some(known) = self.is_known.get_mut(column) {
            *known = true;
        }
        Ok(())
    }

    /// Gives the shares of joints and base in the variance of a torque at the last instant: the
    /// number of the joint, zero for the base.
    pub(super) fn torque_shares(&self, dof: usize, mut share: impl FnMut(Source, usize, f64)) {
        let columns = self.sensitivity.chunks_exact(self.rows).zip(&self.sigma);
        for (number, (column, sigma)) in columns.enumerate() {
            let error = column.get(dof).map_or(0.0, |s| s * sigma);
            let (source, number) = match number.checked_sub(2 * self.dofs) {
                None if number < self.dofs => (Source::Acceleration, number),
                None => (Source::Position, number - self.dofs),
                Some(0..3) => (Source::Base, 0),
                Some(_) => (Source::Rotation, 0),
            };
            if *sigma > 0.0 {
                share(source, number, error * error);
            }
        }
    }

    /// Standard deviation of each torque [Nm or N].
    pub(super) fn torque_std(&self) -> &[f64] {
        self.deviation.get(..self.dofs).unwrap_or_default()
    }

    /// Standard deviations of a contact's wrench, `[fx fy fz tx ty tz]` [N, Nm].
    pub(super) fn contact_std(&self, contact: usize) -> Option<[f64; 6]> {
        let (sixes, _) = self.deviation.get(self.dofs..)?.as_chunks();
        sixes.get(contact).copied()
    }

    /// Covariance of a sub-tree's imbalance [torque; force], at the origin of base coordinates.
    pub(super) fn imbalance_covariance(&self, number: usize) -> Matrix6<f64> {
        let first = self.deviation.len() + 6 * number;
        let mut covariance = Matrix6::zeros();
        for (column, sigma) in self.sensitivity.chunks_exact(self.rows).zip(&self.sigma) {
            // Most joints do not move a sub-tree.
            if *sigma > 0.0
                && let Some(six) = column.get(first..first + 6)
                && *six != [0.0; 6]
            {
                let six = Vector6::from_column_slice(six) * *sigma;
                covariance += six * six.transpose();
            }
        }
        covariance
    }
}

/// The variance of a sum of independent errors.
pub(super) fn sum_of_squares<const N: usize>(deviations: [f64; N]) -> f64 {
    deviations.iter().map(|x| x * x).sum()
}
