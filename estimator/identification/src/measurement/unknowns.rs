//! The unknowns: the meaning of the columns of all rows.

use crate::robot::{Robot, stated_noise};
use proprio_dynamics::Structure;
use proprio_dynamics::calibration::Unknown;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::spatial::Vec3;

/// Speed over which the sign of Coulomb friction is smoothed [rad/s or m/s].
pub const COULOMB_SPEED: f64 = 0.02;

/// Number of friction columns of a joint.
pub(crate) const FRICTION: usize = 3;

/// Precision of the prior of a rotor's inertia about zero [1/(kg m^2)^2]: its standard deviation of
/// 100 kg m^2 exceeds every known rotor.
pub(crate) const ROTOR_PRECISION: f64 = 1e-4;

/// A parameter of the robot other than its links' parameters: one column of `A`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ExtraParameter {
    /// Inertia of the rotor that drives a degree of freedom, reflected to the joint: rotor inertia
    /// times the square of the gear ratio [kg m^2, kg].
    RotorInertia(usize),
    /// Error of the calibration of an F/T sensor, given by its number.
    Calibration(usize, Unknown),
}

/// Precision of the prior of a reading's change per kelvin about zero [1/(N/K)^2, 1/(Nm/K)^2]: its
/// standard deviation of 10 exceeds every known sensor.
pub(crate) const TEMPERATURE_PRECISION: f64 = 1e-2;

impl ExtraParameter {
    /// Precision of its Gaussian prior about zero. For a gain: `Robot::gain_std`, converted to the
    /// units of the entry.
    pub(crate) fn precision(self, robot: &Robot) -> f64 {
        match self {
            Self::RotorInertia(_) => ROTOR_PRECISION,
            Self::Calibration(_, Unknown::Temperature { .. }) => TEMPERATURE_PRECISION,
            Self::Calibration(sensor, Unknown::Gain { channel, of }) => {
                let noise = robot.structure.sensors()[sensor].noise();
                let norm = |three: [f64; 3]| Vec3::from(three).norm();
                let length = norm(noise.torque) / norm(noise.force);
                let unit = match (channel < 3, of < 3) {
                    (true, false) => length,
                    (false, true) => 1.0 / length,
                    _ => 1.0,
                };
                (robot.gain_std * unit).powi(-2)
            }
        }
    }

    /// Whether CAD has no value for it (rather than zero). CAD is then compared with the value that
    /// fits best with its bodies.
    pub(crate) fn lacks_cad(self) -> bool {
        match self {
            Self::RotorInertia(_) => true,
            // CAD assumes that the factory calibration is right.
            Self::Calibration(..) => false,
        }
    }
}

/// The meaning of the columns of all rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Unknowns {
    /// Links that appear in at least one row, ascending; ten columns of `A` each.
    pub links: Vec<usize>,
    /// Extra parameters that appear in at least one row: one column of `A` each, after those of the
    /// links.
    pub extra: Vec<ExtraParameter>,
    /// Precision of the prior of each extra parameter, for [`crate::prior::Posterior`].
    pub precision: Vec<f64>,
    /// F/T sensors that appear, ascending; six columns of `G` and of `N` each, [torque; force].
    pub sensors: Vec<usize>,
    /// Degrees of freedom whose measured torque is used, ascending; three columns of `G` after
    /// those of the sensors, and one of `N`.
    pub joints: Vec<usize>,
}

impl Unknowns {
    /// Number of unknown inertial parameters: the first columns of `A`.
    pub(crate) fn inertial(&self) -> usize {
        LINK_PARAMETERS * self.links.len()
    }

    /// Number of the robot's unknowns: the columns of `A`.
    pub(crate) fn parameters(&self) -> usize {
        self.inertial() + self.extra.len()
    }

    /// The column of an extra parameter, if it appears.
    pub(crate) fn column(&self, extra: ExtraParameter) -> Option<usize> {
        let place = self.extra.iter().position(|own| *own == extra)?;
        Some(self.inertial() + place)
    }

    /// Columns of the unknowns for which CAD has no value.
    pub(crate) fn parameters_without_cad(&self) -> Vec<usize> {
        let each = self.extra.iter().zip(self.inertial()..);
        each.filter(|(extra, _)| extra.lacks_cad())
            .map(|(_, column)| column)
            .collect()
    }

    /// Number of channels of F/T sensors, and of their offsets: they come before those of joints.
    pub(crate) fn wrenches(&self) -> usize {
        6 * self.sensors.len()
    }

    /// Number of nuisance parameters.
    pub(crate) fn nuisance(&self) -> usize {
        self.wrenches() + FRICTION * self.joints.len()
    }

    /// Number of channels.
    pub(crate) fn channels(&self) -> usize {
        self.wrenches() + self.joints.len()
    }

    /// The factor that converts a channel's unit to Nm.
    pub(crate) fn scale(&self, channel: usize) -> f64 {
        if channel < self.wrenches() && channel % 6 >= 3 {
            Structure::LENGTH_SCALE
        } else {
            1.0
        }
    }

    /// Noise deviations of the channels of F/T sensors, as stated in the configuration.
    pub(crate) fn stated<'a>(&'a self, robot: &'a Robot) -> impl Iterator<Item = f64> + 'a {
        let cuts = robot.structure.sensors();
        (self.sensors.iter()).flat_map(|&sensor| stated_noise(&cuts[sensor]))
    }

    /// The nuisance parameter that is the offset of a channel.
    pub(crate) fn offset_of(&self, channel: usize) -> usize {
        match channel.checked_sub(self.wrenches()) {
            None => channel,
            Some(joint) => self.wrenches() + FRICTION * joint + 2,
        }
    }
}

/// Coefficients of Coulomb friction, viscous friction and offset in a joint's torque.
pub(crate) fn friction_row(velocity: f64) -> [f64; FRICTION] {
    [(velocity / COULOMB_SPEED).tanh(), velocity, 1.0]
}
