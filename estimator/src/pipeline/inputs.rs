//! What every channel says at an instant: measured, interpolated, differentiated or extrapolated;
//! of an F/T sensor, corrected for calibration, temperature and offset.

use super::buffers::{ChannelBuffer, stale, temperature_at};
use super::prediction::{Extrapolated, Predictor};
use crate::differentiate::{Grid, Unavailable, Window};
use crate::history::{ChannelValue, History};
use crate::inertial::InertialState;
use crate::setup::Setup;
use crate::uncertainty::{JointStd, Uncertainty};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{FrameMotion, JointState};
use proprio_identification::robot::{BaseMotion, ChannelRole};
use proprio_topics::{Nanos, Quality, Reason};

/// What the channels say at one instant.
pub(super) struct Inputs {
    position: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    /// Per degree of freedom, the least and the greatest position so far.
    pub(super) travel: Vec<[f64; 2]>,
    /// Motion of the base link, and of the IMU that measures it with its pose in that link.
    pub(super) base: FrameMotion,
    pub(super) imu: Option<(FrameMotion, Pose)>,
    /// Per F/T sensor, the corrected reading less the offset.
    pub(super) readings: Vec<Wrench>,
    /// Per F/T sensor, whether its calibration needs a temperature that is missing or too old.
    pub(super) missing_temperature: Vec<bool>,
    /// Per channel, why its value is not valid.
    pub(super) faults: Vec<Reason>,
    /// The stamp-dependent part of differentiation, shared by channels with equal stamps.
    grid: Box<Grid>,
}

/// The instant that the channels are evaluated at, and what is known besides the samples.
pub(super) struct EvaluationPoint<'a> {
    pub(super) t: Nanos,
    /// The last stamp whose samples may be used.
    pub(super) until: Nanos,
    pub(super) setup: &'a Setup,
    /// The parameters in use.
    pub(super) parameters: &'a InertialState,
    /// Per F/T sensor, since when its zero is another one than that of the offset in use.
    pub(super) new_zeros: &'a [Option<Nanos>],
    pub(super) uncertainty: &'a mut Uncertainty,
}

impl Inputs {
    pub(super) fn new(setup: &Setup) -> Self {
        let (robot, dofs) = (&setup.robot, setup.initial.model.dof_count());
        let sensors = robot.structure.sensors().len();
        Self {
            position: robot.position_without_samples(),
            velocity: vec![0.0; dofs],
            acceleration: vec![0.0; dofs],
            travel: vec![[f64::INFINITY, f64::NEG_INFINITY]; dofs],
            base: FrameMotion::standing(&Vec3::zeros()),
            imu: None,
            readings: vec![Wrench::zero(); sensors],
            missing_temperature: vec![false; sensors],
            faults: vec![Reason::NeverSeen; robot.channels.len()],
            grid: Box::default(),
        }
    }

    /// The state of all joints.
    pub(super) fn joints(&self) -> JointState<'_> {
        JointState {
            position: &self.position,
            velocity: &self.velocity,
            acceleration: &self.acceleration,
        }
    }

    /// Evaluates every channel, and tells [`Uncertainty`] how well its value is known. `base` is
    /// the motion of the base link unless an IMU measures it.
    pub(super) fn evaluate(
        &mut self,
        mut at: EvaluationPoint<'_>,
        buffers: &[ChannelBuffer],
        base: FrameMotion,
    ) {
        (self.base, self.imu) = (base, None);
        let channels = &at.setup.robot.channels;
        for (number, (buffer, channel)) in buffers.iter().zip(channels).enumerate() {
            let fault = match (buffer, channel.role) {
                (ChannelBuffer::Joint(history, window), ChannelRole::Joint(dof)) => {
                    self.joint(&mut at, dof, history, window)
                }
                (
                    ChannelBuffer::Sensor(history, temperatures, predictor),
                    ChannelRole::Sensor(sensor),
                ) => self.wrench(&mut at, sensor, history, temperatures, predictor),
                (ChannelBuffer::Imu(history, window, predictor), ChannelRole::Base) => {
                    self.imu(&mut at, history, window, predictor)
                }
                // Not reached: buffers were made from the channels' roles.
                _ => None,
            };
            if let Some(place) = self.faults.get_mut(number) {
                *place = fault.unwrap_or(Reason::NeverSeen);
            }
        }
    }

    /// Evaluates a joint. Returns why its state is not valid; none without a sample.
    fn joint(
        &mut self,
        at: &mut EvaluationPoint<'_>,
        dof: usize,
        history: &History<3>,
        window: &Window<1>,
    ) -> Option<Reason> {
        let sample = history.at(at.t, at.until)?;
        let (state, [acceleration, extrapolation], reason) =
            joint_at(at, &sample, window, &mut self.grid);
        let [noise] = window.noise(at.t);
        let deviations = JointStd {
            acceleration,
            noise,
            extrapolation,
        };
        at.uncertainty.set_joint(dof, deviations);
        for (all, own) in [
            &mut self.position,
            &mut self.velocity,
            &mut self.acceleration,
        ]
        .into_iter()
        .zip(state)
        {
            if let Some(place) = all.get_mut(dof) {
                *place = own;
            }
        }
        if let Some([least, most]) = self.travel.get_mut(dof) {
            (*least, *most) = (least.min(state[0]), most.max(state[0]));
        }
        Some(Reason::of_quality(sample.quality, Quality::UNTRUSTED_ENCODER).or(reason))
    }

    /// Evaluates F/T sensor number `sensor`. Returns why its reading is not valid; none without a
    /// sample.
    fn wrench(
        &mut self,
        at: &mut EvaluationPoint<'_>,
        sensor: usize,
        history: &History<6>,
        temperatures: &History<1>,
        predictor: &Option<Predictor<6>>,
    ) -> Option<Reason> {
        let sample = history.at(at.t, at.until)?;
        let (celsius, age) = temperature_at(temperatures, at.t, at.setup.max_wait);
        let (predicted, starting) = predicted(at.t, &sample, predictor, &mut self.grid);
        let raw = predicted.unwrap_or(Extrapolated {
            value: sample.value,
            std: [0.0; 6],
        });
        let wrench =
            |[fx, fy, fz, tx, ty, tz]: [f64; 6]| Wrench::from_parts([fx, fy, fz], [tx, ty, tz]);
        let state = &at.parameters;
        if let (Some(reading), Some(missing), Some(calibration), Some(offset)) = (
            self.readings.get_mut(sensor),
            self.missing_temperature.get_mut(sensor),
            state.calibrations.get(sensor),
            state.offsets.get(sensor),
        ) {
            let excess = (state.excess_variance.get(sensor).copied()).unwrap_or_default();
            let by_temperature = calibration.temperature_variance(age.map(Nanos::seconds));
            let extrapolation = calibration.variance_of(&wrench(raw.std));
            let extra = std::array::from_fn(|i| by_temperature[i] + excess[i] + extrapolation[i]);
            let corrected = calibration.apply(&wrench(raw.value), celsius);
            // The effect of an uncertain calibration depends on the reading.
            let kelvin = calibration.temperature_rise(celsius);
            let parameters = &mut at.uncertainty.propagation;
            parameters.set_extra_variance(sensor, extra);
            parameters.set_calibration_point(sensor, &corrected, kelvin);
            (*reading, *missing) = (corrected - *offset, by_temperature != [0.0; 6]);
        }
        let since = at.new_zeros.get(sensor).copied().flatten();
        let zero = match since {
            Some(since) if at.t > since => Reason::Uncertain,
            _ => Reason::None,
        };
        Some(
            stale(&sample, at.setup.robot.max_silence)
                .or(Reason::of_quality(sample.quality, Quality::DEVICE_FAULT))
                .or(starting)
                .or(zero),
        )
    }

    /// Evaluates the IMU. Returns why its motion is not valid; none without a sample.
    fn imu(
        &mut self,
        at: &mut EvaluationPoint<'_>,
        history: &History<9>,
        window: &Window<3>,
        predictor: &Option<Predictor<3>>,
    ) -> Option<Reason> {
        let sample = history.at(at.t, at.until)?;
        let (mut measured, angular_std, reason) = imu_at(at, &sample, window, &mut self.grid);
        let (predicted, starting) = predicted(at.t, &sample, predictor, &mut self.grid);
        let mut extrapolation = [0.0; 3];
        if let Some(predicted) = predicted {
            measured.proper_acceleration = Vec3::from(predicted.value);
            extrapolation = predicted.std;
        }
        at.uncertainty.set_imu(&angular_std, &extrapolation);
        if let BaseMotion::Imu(pose) = &at.setup.robot.base {
            self.base = FrameMotion::of_link_from_imu(&measured, pose);
            self.imu = Some((measured, *pose));
        }
        Some(
            Reason::of_quality(sample.quality, Quality::DEVICE_FAULT)
                .or(reason)
                .or(starting),
        )
    }
}

/// Position, velocity and acceleration of a joint, the standard deviations of the acceleration and
/// of an extrapolated position, and why they are not valid.
fn joint_at(
    at: &EvaluationPoint<'_>,
    held: &ChannelValue<3>,
    window: &Window<1>,
    grid: &mut Grid,
) -> ([f64; 3], [f64; 2], Reason) {
    let [position, velocity, acceleration] = held.value;
    if held.exact && velocity.is_finite() && acceleration.is_finite() {
        return ([position, velocity, acceleration], [0.0; 2], Reason::None);
    }
    let max_silence = at.setup.robot.max_silence;
    // A channel stamped exactly t needs no later sample.
    let until = if held.exact { at.t } else { at.until };
    let estimate = match window.at_sharing(at.t, until, grid) {
        Ok(estimate) => estimate,
        Err(unavailable) => {
            let reason = reason_of(unavailable, held, max_silence);
            return ([position, 0.0, 0.0], [0.0; 2], reason);
        }
    };
    let ([value], [first], [second]) = (estimate.value, estimate.first, estimate.second);
    let is_measured = |x: f64| held.exact && x.is_finite();
    let measured_or = |x: f64, estimated: f64| if is_measured(x) { x } else { estimated };
    let acceleration_std = match is_measured(acceleration) {
        true => 0.0,
        false => finite_or_zero(estimate.second_std[0]),
    };
    let position_std = match estimate.ahead < Nanos::ZERO {
        true => finite_or_zero(estimate.value_std[0]),
        false => 0.0,
    };
    (
        [
            measured_or(position, value),
            measured_or(velocity, first),
            measured_or(acceleration, second),
        ],
        [acceleration_std, position_std],
        stale(held, max_silence),
    )
}

/// Motion of the IMU, standard deviations of its angular acceleration, and why the motion is not
/// valid.
fn imu_at(
    at: &EvaluationPoint<'_>,
    held: &ChannelValue<9>,
    window: &Window<3>,
    grid: &mut Grid,
) -> (FrameMotion, [f64; 3], Reason) {
    let [ax, ay, az, gx, gy, gz, bx, by, bz] = held.value;
    let mut motion = FrameMotion {
        angular_velocity: Vec3::new(gx, gy, gz),
        angular_acceleration: Vec3::new(bx, by, bz),
        proper_acceleration: Vec3::new(ax, ay, az),
    };
    if held.exact && motion.angular_acceleration.iter().all(|x| x.is_finite()) {
        return (motion, [0.0; 3], Reason::None);
    }
    let max_silence = at.setup.robot.max_silence;
    let until = if held.exact { at.t } else { at.until };
    match window.at_sharing(at.t, until, grid) {
        Ok(estimate) => {
            if !held.exact {
                motion.angular_velocity = Vec3::from(estimate.value);
            }
            motion.angular_acceleration = Vec3::from(estimate.first);
            let deviation = estimate.first_std.map(finite_or_zero);
            (motion, deviation, stale(held, max_silence))
        }
        Err(unavailable) => {
            motion.angular_acceleration = Vec3::zeros();
            (motion, [0.0; 3], reason_of(unavailable, held, max_silence))
        }
    }
}

/// The values of a channel whose last sample is earlier than `t`, extrapolated to `t`, and their
/// standard deviations. None if a sample was measured at `t` or later, or there is no predictor; or
/// with [`Reason::Starting`], if too few good samples are at hand.
fn predicted<const N: usize, const D: usize>(
    t: Nanos,
    sample: &ChannelValue<N>,
    predictor: &Option<Predictor<D>>,
    grid: &mut Grid,
) -> (Option<Extrapolated<D>>, Reason) {
    match predictor {
        Some(predictor) if !(sample.exact || sample.interpolated) => {
            let predicted = predictor.at(t, grid);
            let reason = match predicted {
                Some(_) => Reason::None,
                None => Reason::Starting,
            };
            (predicted, reason)
        }
        _ => (None, Reason::None),
    }
}

/// The standard deviation, or zero if it is not finite.
fn finite_or_zero(deviation: f64) -> f64 {
    if deviation.is_finite() {
        deviation
    } else {
        0.0
    }
}

/// Why a channel has no derivative at the instant.
fn reason_of<const D: usize>(
    unavailable: Unavailable,
    held: &ChannelValue<D>,
    max_silence: Nanos,
) -> Reason {
    match (stale(held, max_silence), unavailable) {
        (Reason::Stale, _) | (_, Unavailable::Stale { .. }) => Reason::Stale,
        (_, Unavailable::Overflow) => Reason::NotFinite,
        _ => Reason::Starting,
    }
}
