//! The value of a channel at an instant: measured, interpolated or differentiated; of an F/T
//! sensor, corrected for calibration, temperature and offset.

use super::buffers::stale;
use super::prediction::Extrapolated;
use crate::differentiate::{Grid, Unavailable, Window};
use crate::history::ChannelValue;
use crate::inertial::InertialState;
use crate::propagation::Propagation;
use proprio_dynamics::FrameMotion;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_topics::{Nanos, Reason};

/// Position, velocity and acceleration of a joint at `t`, the standard deviations of the
/// acceleration and of an extrapolated position, and why they are not valid.
pub(crate) fn joint_at(
    t: Nanos,
    until: Nanos,
    held: &ChannelValue<3>,
    (window, grid): (&Window<1>, &mut Grid),
    max_silence: Nanos,
) -> ([f64; 3], [f64; 2], Reason) {
    let [position, velocity, acceleration] = held.value;
    if held.exact && velocity.is_finite() && acceleration.is_finite() {
        return ([position, velocity, acceleration], [0.0; 2], Reason::None);
    }
    // A channel stamped exactly t needs no later sample.
    let until = if held.exact { t } else { until };
    match window.at_sharing(t, until, grid) {
        Ok(estimate) => {
            let ([value], [first], [second]) = (estimate.value, estimate.first, estimate.second);
            let given = |measured: f64, estimated: f64| {
                if held.exact && measured.is_finite() {
                    measured
                } else {
                    estimated
                }
            };
            let deviation = if given(acceleration, f64::NAN).is_nan() {
                finite_or_zero(estimate.second_std[0])
            } else {
                0.0
            };
            let extrapolated = match estimate.ahead < Nanos::ZERO {
                true => finite_or_zero(estimate.value_std[0]),
                false => 0.0,
            };
            (
                [
                    given(position, value),
                    given(velocity, first),
                    given(acceleration, second),
                ],
                [deviation, extrapolated],
                stale(held, max_silence),
            )
        }
        Err(unavailable) => (
            [position, 0.0, 0.0],
            [0.0; 2],
            reason_of(unavailable, held, max_silence),
        ),
    }
}

/// The standard deviation, or zero if it is not finite.
pub(crate) fn finite_or_zero(deviation: f64) -> f64 {
    if deviation.is_finite() {
        deviation
    } else {
        0.0
    }
}

/// Motion of the IMU at `t`, standard deviations of its angular acceleration, and why the motion is
/// not valid.
pub(crate) fn imu_at(
    t: Nanos,
    until: Nanos,
    held: &ChannelValue<9>,
    (window, grid): (&Window<3>, &mut Grid),
    max_silence: Nanos,
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
    let until = if held.exact { t } else { until };
    match window.at_sharing(t, until, grid) {
        Ok(estimate) => {
            if !held.exact {
                motion.angular_velocity = Vec3::from(estimate.value);
            }
            motion.angular_acceleration = Vec3::from(estimate.first);
            (
                motion,
                estimate.first_std.map(finite_or_zero),
                stale(held, max_silence),
            )
        }
        Err(unavailable) => {
            motion.angular_acceleration = Vec3::zeros();
            (motion, [0.0; 3], reason_of(unavailable, held, max_silence))
        }
    }
}

/// The corrected reading of F/T sensor `number` less its offset, and whether the calibration needs
/// a temperature that is missing or too old. `raw` is the reading and its standard deviation, if it
/// was extrapolated; `temperature` is that of the board \[degrees Celsius\] and its age. What is
/// uncertain in reading and correction goes to `propagation`.
pub(crate) fn wrench_at(
    state: &InertialState,
    number: usize,
    raw: Extrapolated<6>,
    (celsius, age): (f64, Option<Nanos>),
    propagation: &mut Propagation,
) -> Option<(Wrench, bool)> {
    let calibration = state.calibrations.get(number)?;
    let offset = state.offsets.get(number)?;
    let excess = (state.excess_variance.get(number).copied()).unwrap_or_default();
    let by_temperature = calibration.temperature_variance(age.map(Nanos::seconds));
    let [fx, fy, fz, tx, ty, tz] = raw.std;
    let extrapolation = calibration.variance_of(&Wrench::from_parts([fx, fy, fz], [tx, ty, tz]));
    let extra = std::array::from_fn(|i| by_temperature[i] + excess[i] + extrapolation[i]);
    propagation.set_extra_variance(number, extra);
    let [fx, fy, fz, tx, ty, tz] = raw.value;
    let corrected = calibration.apply(&Wrench::from_parts([fx, fy, fz], [tx, ty, tz]), celsius);
    // The effect of an uncertain calibration depends on the reading.
    let kelvin = calibration.temperature_rise(celsius);
    propagation.set_calibration_point(number, &corrected, kelvin);
    Some((corrected - *offset, by_temperature != [0.0; 6]))
}

/// Why a channel has no derivative at the instant.
pub(crate) fn reason_of<const D: usize>(
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
