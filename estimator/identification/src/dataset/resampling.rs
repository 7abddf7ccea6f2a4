//! Resamples a log to observations: the values of all channels at common times, with velocities and
//! accelerations, and the faults of each channel.
//!
//! The pipeline does this sample by sample from the past alone. Here the samples on both sides are
//! available:
//!
//! - The times are the stamps of the trigger channel, or, if that is faster than the requested
//!   rate, the middles of equal blocks.
//! - Wrenches, torques, proper accelerations and given derivatives: a channel faster than the rate
//!   is averaged over the block (the integral of the straight lines between its samples, so that
//!   stamps may jitter). A slower channel is used directly if it has a sample at that time, and
//!   interpolated by the cubic through four neighbours otherwise. (The error of a straight line is
//!   an eighth of the squared period times the curvature: at 100 Hz more than the noise of a sensor
//!   that carries a robot.) A log whose rows hold all channels is therefore used row by row.
//! - Positions, and velocities and accelerations that are not given, come from polynomials around
//!   the time. Their window and degree are chosen along the log ([`crate::dataset::smooth`]).
//! - Each observation has the fault of each channel: silent for too long, saturated, faulty, too
//!   close to the log's end for a derivative. An F/T reading far from the model and from its
//!   neighbours is marked as an outlier.
//!
//! Readings are corrected as configured ([`proprio_dynamics::calibration`]). Configured offsets are
//! not subtracted, since identification determines the reading without load.

use crate::dataset::observation::Observation;
use crate::dataset::recording::Recording;
use crate::dataset::smooth::{Scratch, Smoother};
use crate::dataset::stream::{ImuTrack, PERIOD, is_dense};
use crate::parallel;
use crate::robot::{BaseMotion, Channel, ChannelRole, Robot};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{ContactSet, FrameMotion};
use proprio_topics::{Nanos, Reason};

/// Greatest number of observations per second \[Hz\], one each [`PERIOD`]. A slower log keeps its
/// own stamps.
pub(crate) const RATE: f64 = 100.0;

impl Recording {
    /// The observations of the log.
    pub(crate) fn observations(&self, robot: &Robot) -> Vec<Observation> {
        let times = self.times(robot);
        // Joints are independent, so they run on all cores.
        let joints = parallel::map(self.joints.len(), |dof| self.joints[dof].at_all(&times));
        let imu = self.imu_column(robot, &times);
        let dofs = robot.model.dof_count();
        let at_rest = robot.position_without_samples();
        let at = |number: usize| {
            let t = times[number];
            let active = self.active(robot, t);
            let (base_link, base, base_fault) = robot.base_motion(&active);
            let mut observation = Observation {
                t,
                position: at_rest.clone(),
                velocity: vec![0.0; dofs],
                acceleration: vec![0.0; dofs],
                torque: vec![f64::NAN; dofs],
                base_link,
                base,
                readings: vec![
                    Wrench::from_parts([f64::NAN; 3], [f64::NAN; 3]);
                    self.sensors.len()
                ],
                active,
                faults: vec![Reason::None; self.channels.len()],
                base_fault,
                temperatures: self
                    .temperatures
                    .iter()
                    .map(|own| temperature_at(own, t))
                    .collect(),
            };
            for (channel, fault) in self.channels.iter().zip(&mut observation.faults) {
                *fault = match channel.role {
                    ChannelRole::Joint(dof) => {
                        let state = &joints[dof][number];
                        [
                            observation.position[dof],
                            observation.velocity[dof],
                            observation.acceleration[dof],
                        ] = state.motion;
                        observation.torque[dof] = state.torque;
                        state.fault
                    }
                    ChannelRole::Sensor(sensor) => match self.sensors[sensor].mean(t) {
                        Ok([fx, fy, fz, tx, ty, tz]) => {
                            observation.readings[sensor] = robot.calibrations[sensor].apply(
                                &Wrench::from_parts([fx, fy, fz], [tx, ty, tz]),
                                observation.temperatures[sensor],
                            );
                            Reason::None
                        }
                        Err(reason) => reason,
                    },
                    ChannelRole::Base => {
                        observation.base = imu[number].0;
                        imu[number].1
                    }
                };
            }
            observation
        };
        parallel::map(times.len(), at)
    }

    /// The times of the observations.
    fn times(&self, robot: &Robot) -> Vec<Nanos> {
        let stamps = |channel: &Channel| self.stamps(channel.role);
        let trigger = self.channels.get(robot.trigger).map(stamps);
        let mut all = trigger.into_iter().chain(self.channels.iter().map(stamps));
        let Some((stamps, _, spacing)) = all.find(|(t, ..)| !t.is_empty()) else {
            return Vec::new();
        };
        if !is_dense(spacing) {
            return stamps.to_vec();
        }
        let (first, mut times) = (stamps.first().copied().unwrap_or_default(), Vec::new());
        let mut block = -1;
        for t in stamps {
            let number = (*t - first).0 / PERIOD.0;
            if number > block {
                block = number;
                times.push(first + Nanos(number * PERIOD.0 + PERIOD.0 / 2));
            }
        }
        times
    }

    /// The contacts that are present at `t`, as declared.
    fn active(&self, robot: &Robot, t: Nanos) -> ContactSet {
        robot.active_contacts(|contact| {
            let declared = self.declared.get(contact)?;
            let next = declared.partition_point(|(from, _)| *from <= t);
            Some(declared.get(next.checked_sub(1)?)?.1)
        })
    }

    fn imu_column(&self, robot: &Robot, times: &[Nanos]) -> Vec<(FrameMotion, Reason)> {
        let BaseMotion::Imu(pose) = &robot.base else {
            return Vec::new();
        };
        let ImuTrack {
            proper_acceleration,
            angular_velocity,
            angular_acceleration,
        } = &self.imu;
        let smoothers: Vec<Smoother> = if angular_acceleration.t.is_empty() {
            (0..3).map(|axis| angular_velocity.smoother(axis)).collect()
        } else {
            Vec::new()
        };
        let mut scratch = Scratch::default();
        let mut at = |t: Nanos| -> Result<FrameMotion, Reason> {
            let (omega, alpha) = if smoothers.is_empty() {
                (angular_velocity.mean(t)?, angular_acceleration.mean(t)?)
            } else {
                angular_velocity.mean(t)?;
                let (mut omega, mut alpha) = ([0.0; 3], [0.0; 3]);
                for (axis, smoother) in smoothers.iter().enumerate() {
                    let both = smoother.at(t, 0..=1, &mut scratch);
                    [omega[axis], alpha[axis], _] = both.ok_or(Reason::Starting)?;
                }
                (omega, alpha)
            };
            let measured = FrameMotion {
                angular_velocity: Vec3::from(omega),
                angular_acceleration: Vec3::from(alpha),
                proper_acceleration: Vec3::from(proper_acceleration.mean(t)?),
            };
            Ok(FrameMotion::of_link_from_imu(&measured, pose))
        };
        let standing = FrameMotion::standing(&Vec3::zeros());
        times
            .iter()
            .map(|t| at(*t).map_or_else(|fault| (standing, fault), |m| (m, Reason::None)))
            .collect()
    }
}

/// The temperature at `t`, from samples sorted by stamp.
fn temperature_at(samples: &[(Nanos, f64)], t: Nanos) -> f64 {
    let after = samples.partition_point(|(stamp, _)| *stamp <= t);
    match (
        after.checked_sub(1).and_then(|i| samples.get(i)),
        samples.get(after),
    ) {
        (Some((from, before)), Some((to, next))) => {
            before + (t - *from).seconds() / (*to - *from).seconds() * (next - before)
        }
        (Some((_, only)), None) | (None, Some((_, only))) => *only,
        (None, None) => f64::NAN,
    }
}
