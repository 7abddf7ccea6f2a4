//! How uncertain a solution is: one standard deviation for each torque and each component of a
//! contact wrench, and who causes it.
//!
//! Four independent errors of the inputs go through the same solution, each with its own
//! sensitivity:
//!
//! | error | covariance | through |
//! |---|---|---|
//! | F/T noise | of the sensor's data sheet | [`Solver::update_deviations`] |
//! | parameters, offsets, gains, drift | of identification, or of the URDF | [`Propagation`] |
//! | accelerations, positions, motion of the base | of differentiation, and typical | `motion` |
//! | places of declared and touched contacts | as declared | [`PlaceErrors`] |
//!
//! The variance of a result is the sum of the four ([`Uncertainty::torque_variance`]), and so is
//! the covariance of the imbalance that residuals are tested against
//! ([`Uncertainty::imbalance_covariance`]). [`Uncertainty::torque_shares`] says which input causes
//! which part.

mod motion;
pub mod propagation;

pub(crate) use motion::{JointStd, OperatingPoint};

use crate::inertial::InertialState;
use motion::{MotionErrors, sum_of_squares};
use nalgebra::Matrix6;
use propagation::Propagation;
use proprio_dynamics::{DynamicsError, Kinematics, PlaceErrors, PlaceStd, Solver, Structure};
use proprio_topics::Source;

/// The standard deviations of the last solution, with all the memory to compute them.
pub(crate) struct Uncertainty {
    /// Of inertial parameters, offsets, gains and what else is uncertain in an F/T reading.
    pub(crate) propagation: Propagation,
    motion: MotionErrors,
    places: PlaceErrors,
}

impl Uncertainty {
    /// For a structure whose kinematics begin at `base_link`.
    ///
    /// # Errors
    /// The covariance is of another model, or there is no such link.
    pub(crate) fn new(
        structure: &Structure,
        state: &InertialState,
        base_link: usize,
    ) -> Result<Self, DynamicsError> {
        Ok(Self {
            propagation: Propagation::new(structure, &state.covariance)?,
            motion: MotionErrors::new(&state.model, structure, base_link)?,
            places: PlaceErrors::new(structure),
        })
    }

    /// Sets how uncertain a joint's measured state is.
    pub(crate) fn set_joint(&mut self, dof: usize, deviations: JointStd) {
        self.motion.set_joint(dof, deviations);
    }

    /// Sets the standard deviations of an IMU's angular acceleration, and what extrapolation adds
    /// to those of its proper acceleration.
    pub(crate) fn set_imu(&mut self, angular: &[f64; 3], extrapolation: &[f64; 3]) {
        self.motion.set_imu(angular, extrapolation);
    }

    /// Computes all deviations. The solver has its own, of F/T noise, already. Does not allocate.
    ///
    /// # Errors
    /// Sizes differ, or a number is not finite.
    pub(crate) fn update(
        &mut self,
        point: &OperatingPoint<'_>,
        place_std: impl Fn(usize) -> PlaceStd,
    ) -> Result<(), DynamicsError> {
        let OperatingPoint {
            t,
            structure,
            solver,
            kinematics,
            ..
        } = *point;
        self.propagation.update(structure, solver, kinematics, t)?;
        self.motion.update(point)?;
        self.places.update(structure, solver, kinematics, place_std)
    }

    /// The variance of a torque [Nm^2 or N^2]; not a number if an input's is not.
    pub(crate) fn torque_variance(&self, solver: &Solver, dof: usize) -> f64 {
        let independent = [
            solver.torque_deviation(),
            self.propagation.torque_std(),
            self.motion.torque_std(),
            self.places.torque_std(),
        ];
        sum_of_squares(independent.map(|of| of.get(dof).copied().unwrap_or(0.0)))
    }

    /// The standard deviation of a torque [Nm or N].
    pub(crate) fn torque_std(&self, solver: &Solver, dof: usize) -> f64 {
        self.torque_variance(solver, dof).sqrt()
    }

    /// The standard deviations of a contact's wrench, `[fx fy fz tx ty tz]` [N, Nm].
    pub(crate) fn contact_std(&self, solver: &Solver, contact: usize) -> [f64; 6] {
        let noise = solver.contacts().get(contact).map(|own| own.deviation);
        let independent = [
            noise,
            self.propagation.contact_std().get(contact).copied(),
            self.motion.contact_std(contact),
            self.places.contact_std().get(contact).copied(),
        ];
        let independent = independent.map(Option::unwrap_or_default);
        std::array::from_fn(|axis| sum_of_squares(independent.map(|of| of[axis])).sqrt())
    }

    /// The covariance of a sub-tree's imbalance without F/T noise [torque; force], at the origin of
    /// base coordinates [Nm, N].
    pub(crate) fn imbalance_covariance(&self, subtree: usize) -> Option<Matrix6<f64>> {
        let parameters = self.propagation.imbalance_covariances().get(subtree)?;
        let places = self.places.imbalance_covariances().get(subtree)?;
        Some(parameters + places + self.motion.imbalance_covariance(subtree))
    }

    /// Gives the parts of a torque's variance beside F/T noise [Nm^2 or N^2]: the source, and the
    /// number of the link, sensor, joint or contact. Some come in several parts, and a negative one
    /// cancels a part of others. The arguments are those of the last update. Does not allocate.
    pub(crate) fn torque_shares(
        &mut self,
        structure: &Structure,
        (solver, kinematics): (&Solver, &Kinematics),
        place_std: impl Iterator<Item = PlaceStd>,
        dof: usize,
        mut share: impl FnMut(Source, usize, f64),
    ) {
        let solution = (solver, kinematics);
        self.propagation
            .torque_shares(structure, solution, dof, &mut share);
        self.motion.torque_shares(dof, &mut share);
        for at in place_std.enumerate() {
            let variance = PlaceErrors::torque_variance(structure, solver, kinematics, dof, at);
            share(Source::Place, at.0, variance);
        }
    }
}
