//! The value of a joint or IMU channel at an instant: measured, interpolated or differentiated.

use super::buffers::stale;
use crate::differentiate::{Grid, Unavailable, Window};
use crate::history::ChannelValue;
use proprio_dynamics::FrameMotion;
use proprio_dynamics::spatial::Vec3;
use proprio_topics::{Nanos, Reason};

/// Position, velocity and acceleration of a joint at `t`, the standard deviation of the
/// acceleration, and why they are not valid.
pub(crate) fn joint_at(
    t: Nanos,
    until: Nanos,
    held: &ChannelValue<3>,
    (window, grid): (&Window<1>, &mut Grid),
    max_silence: Nanos,
) -> ([f64; 3], f64, Reason) {
    let [position, velocity, acceleration] = held.value;
    if held.exact && velocity.is_finite() && acceleration.is_finite() {
        return ([position, velocity, acceleration], 0.0, Reason::None);
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
            (
                [
                    given(position, value),
                    given(velocity, first),
                    given(acceleration, second),
                ],
                deviation,
                stale(held, max_silence),
            )
        }
        Err(unavailable) => (
            [position, 0.0, 0.0],
            0.0,
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
