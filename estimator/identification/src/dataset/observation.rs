//! Observations: the values of all channels at one time, and annotations by fits.

use crate::readings::{MotionReading, SeenMotion};
use crate::robot::{Channel, ChannelRole};
use proprio_dynamics::spatial::Wrench;
use proprio_dynamics::{BitSet, ContactSet, FrameMotion};
use proprio_topics::{Nanos, Reason};

/// Numbers of sub-trees, whose equations each hold or fail together. Measured joint torques count
/// as one more sub-tree, [`Observation::TORQUES`].
pub type SubtreeSet = BitSet<2>;

/// The values of all channels at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Time by the log's clock.
    pub t: Nanos,
    /// Per degree of freedom \[rad or m\]; for a faulty channel the nearest known value, or 0.
    pub position: Vec<f64>,
    /// \[rad/s or m/s\]; 0 for a faulty channel.
    pub velocity: Vec<f64>,
    /// \[rad/s^2 or m/s^2\]; 0 for a faulty channel.
    pub acceleration: Vec<f64>,
    /// Measured joint torques \[Nm or N\], by the parent on the child along the axis; NaN where
    /// there is none.
    pub torque: Vec<f64>,
    /// The link where kinematics start.
    pub base_link: usize,
    /// Its motion.
    pub base: FrameMotion,
    /// Per F/T sensor its reading, corrected as configured, offset included, in its measurement
    /// frame; NaN where there is none.
    pub readings: Vec<Wrench>,
    /// The present contacts, as declared.
    pub active: ContactSet,
    /// Per channel, in the order of [`crate::Robot::channels`]: its fault. A missing torque is no
    /// fault.
    pub faults: Vec<Reason>,
    /// Fault of the base motion, if no channel measures it.
    pub base_fault: Reason,
    /// Per F/T sensor the temperature of its board \[degrees Celsius\], interpolated linearly; the
    /// first and the last sample are extrapolated as constants. NaN where none was recorded.
    pub temperatures: Vec<f64>,
}

impl Observation {
    /// What stands for all measured joint torques among the numbers of sub-trees.
    pub const TORQUES: usize = SubtreeSet::CAPACITY - 1;

    /// Whether the motion of every joint and of the base is known.
    #[must_use]
    pub fn knows_motion(&self, channels: &[Channel]) -> bool {
        let known = |(c, fault): (&Channel, &Reason)| {
            matches!(c.role, ChannelRole::Sensor(_)) || *fault == Reason::None
        };
        self.base_fault == Reason::None && channels.iter().zip(&self.faults).all(known)
    }
}

impl Observation {
    /// Removes the reading of an F/T sensor.
    #[must_use]
    pub(crate) fn without_reading(mut self, sensor: usize) -> Self {
        self.readings[sensor] = Wrench::from_parts([f64::NAN; 3], [f64::NAN; 3]);
        self
    }

    /// Removes the torque of a joint.
    #[must_use]
    pub(crate) fn without_torque(mut self, dof: usize) -> Self {
        self.torque[dof] = f64::NAN;
        self
    }

    /// As a hypothesis takes the readings of joints and base.
    #[must_use]
    pub(crate) fn read_as(self, motion_reading: MotionReading) -> Self {
        let mut motion = SeenMotion {
            position: self.position,
            velocity: self.velocity,
            acceleration: self.acceleration,
            base: self.base,
        };
        motion.see(motion_reading);
        Self {
            position: motion.position,
            velocity: motion.velocity,
            acceleration: motion.acceleration,
            base: motion.base,
            ..self
        }
    }
}

/// An observation with the annotations of fits. Dereferences to the observation, which never
/// changes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Annotated {
    observation: Observation,
    /// Per F/T sensor its noise-free reading by an earlier fit, as [`Observation::readings`]; not
    /// finite where the fit has none. Empty before a fit.
    pub fitted: Vec<Wrench>,
    /// Sub-trees on which an undeclared disturbance (contact or load) was found to act.
    pub disturbed: SubtreeSet,
}

impl From<Observation> for Annotated {
    /// No annotations yet.
    fn from(observation: Observation) -> Self {
        Self {
            observation,
            fitted: Vec::new(),
            disturbed: SubtreeSet::default(),
        }
    }
}

impl Annotated {
    /// The observation alone.
    pub(crate) fn observation(&self) -> &Observation {
        &self.observation
    }

    /// Removes the fitted readings.
    #[must_use]
    pub(crate) fn without_fitted(mut self) -> Self {
        self.fitted.clear();
        self
    }

    /// Changes the observation and keeps the annotations.
    #[must_use]
    pub(crate) fn map(self, change: impl FnOnce(Observation) -> Observation) -> Self {
        Self {
            observation: change(self.observation),
            ..self
        }
    }
}

/// Tests build their own observations.
#[cfg(test)]
impl std::ops::DerefMut for Annotated {
    fn deref_mut(&mut self) -> &mut Observation {
        &mut self.observation
    }
}

impl std::ops::Deref for Annotated {
    type Target = Observation;

    fn deref(&self) -> &Observation {
        &self.observation
    }
}
