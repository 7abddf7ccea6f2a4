//! Identifies a robot's inertial parameters, and the offsets of its F/T sensors, from what they measure while it moves.
//!
//! # The way of the data
//! ```text
//! log -> Recording, Instants: all channels at common instants, derivatives, what is wrong      instants
//!     -> joint torques that are none (sign, units, dead) taken out                             torques
//!     -> F/T readings that are none refused, or those of a sensor mounted otherwise                     mounting, wrenches
//!     -> rows of each instant: A d + G s = r + N e                                             rows
//!     -> offsets and friction s eliminated, by a filter on all columns at once                 session, passes
//!     -> [R | z], what all logs tell of d = phi - phi_CAD                                      information
//!     -> the most probable bodies under CAD's prior, and its weight                            prior
//!     -> what is left -> noise of each channel -> again, until it stays                        noise, passes
//!     -> undeclared contacts, another load: left out, and again, until it stays                gate, undeclared
//!     -> held-out data: what gains nothing is shrunk to CAD                                    guard
//!     -> motion that only other F/T sensors feel, taken off; all of the fit again              shaking
//!     -> Outcome: parameters, covariance, figures per log, encoders turned or with another zero  assess, zeros, delay, export
//! ```
//! [`identify`] does all of it. Parameters belong to the robot and are common to all logs; offsets and friction belong to a log.
//!
//! Whether something more than noise and parameters is in the data (a load, a jump of an offset, an
//! encoder's zero or direction, a delay), one test says: `hypothesis`.
//!
//! The same while the robot works, once a second: [`online`], which the pipeline feeds.
//!
//! # What is known when
//! Nothing is fitted to a validation log but its offsets and friction, for CAD and for the identified parameters alike. No weight is chosen by hand: noise comes from residuals, the
//! prior's weight from the evidence ([`prior`]), and both are the same rules for every robot. What motion does not show stays as in CAD, and its uncertainty says so.
//!
//! # Noise
//! What is left of a channel is mostly model error, not noise of the sensor: correlated in time, and larger when the robot moves. As white noise it would be believed far too much, and the
//! evidence would let the data overrule CAD where they know nothing. So its variance is multiplied by its integrated autocorrelation time, or taken from the scatter of block means,
//! whichever is more. An F/T sensor's offset walks besides; how fast is found by the likelihood of the block means, within bounds: it follows nothing faster than a second, or it would swallow
//! motion and touch; and beside bodies it walks no faster than sensors do by themselves, by their stated noise per square root of a second, or it would take up what the model has wrong. Where a contact is declared, or found though nobody declared it, the rows that it reaches are gone, and with them all influence on parameters and offsets.

mod assess;
mod batch;
pub mod consistent;
mod delay;
mod export;
mod gate;
mod guard;
mod hypothesis;
pub mod information;
pub mod instants;
mod lanes;
mod mounting;
mod noise;
pub mod online;
mod outcome;
mod parallel;
mod passes;
mod plausible;
pub mod prior;
mod rows;
mod session;
mod shaking;
mod torques;
mod undeclared;
mod wrenches;
mod yardstick;
mod zeros;

pub(crate) use batch::judged_instants;
pub use batch::{IdentifyError, Log, Options, Progress, identify};
pub use export::parameters;
pub use gate::UnitSet;
pub use outcome::{
    BaseParameterOutcome, Both, CalibrationOutcome, ChannelNoise, Consistency, CovarianceRoot, Curve, Finding,
    FrictionOutcome, InForce, JointOutcome, LeftOut, LinkOutcome, LogOutcome, OffsetOutcome, Outcome, Predicted, Role,
    RotorOutcome, SensorOutcome, Severity, Spectrum, Three, TimeOffset, TwoRouteOutcome, Verdict, WeakDirection,
};
pub use plausible::implausible;
pub(crate) use yardstick::predicted;

/// The axes of a wrench as samples have them, in words.
const AXES: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];

/// Lanes that inner products work in: one sum would wait for itself at every step.
const LANES: usize = 4;

/// The inner product of two slices of one length.
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    debug_assert_eq!(a.len(), b.len());
    let ((a8, a), (b8, b)) = (a.as_chunks::<{ 2 * LANES }>(), b.as_chunks::<{ 2 * LANES }>());
    let mut sum = [0.0; 2 * LANES];
    for (x, y) in a8.iter().zip(b8) {
        for lane in 0..2 * LANES {
            sum[lane] += x[lane] * y[lane];
        }
    }
    let mut four = [0.0; LANES];
    for lane in 0..LANES {
        four[lane] = sum[lane] + sum[lane + LANES];
    }
    let ((a4, a), (b4, b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (x, y) in a4.iter().zip(b4) {
        for lane in 0..LANES {
            four[lane] += x[lane] * y[lane];
        }
    }
    let rest: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    (four[0] + four[2]) + (four[1] + four[3]) + rest
}

/// `to += factor * from`.
#[inline(always)]
fn add_multiple(to: &mut [f64], factor: f64, from: &[f64]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += factor * from;
    }
}

/// Lower factor of a covariance, row by row in place; combinations without noise get 1e-9 of the greatest variance.
fn factorise(covariance: &mut [f64], count: usize) {
    let greatest = (0..count).map(|i| covariance[i * count + i]).fold(0.0, f64::max);
    let floor = 1e-9 * greatest.max(f64::MIN_POSITIVE);
    for i in 0..count {
        for j in 0..=i {
            let (above, own) = covariance.split_at(i * count);
            let other = if j == i { own } else { &above[j * count..] };
            let rest = own[j] - dot(&own[..j], &other[..j]);
            covariance[i * count + j] = if i == j {
                rest.max(floor).sqrt()
            } else {
                rest / covariance[j * count + j]
            };
        }
    }
}

/// `L^-1` from the left, `count` rows of `width` numbers.
fn forward(factor: &[f64], count: usize, values: &mut [f64], width: usize) {
    for i in 0..count {
        let (above, own) = values.split_at_mut(i * width);
        let own = &mut own[..width];
        for j in 0..i {
            let weight = factor[i * count + j];
            if weight != 0.0 {
                for (x, y) in own.iter_mut().zip(&above[j * width..][..width]) {
                    *x -= weight * y;
                }
            }
        }
        let scale = 1.0 / factor[i * count + i];
        own.iter_mut().for_each(|x| *x *= scale);
    }
}

/// Normal deviates: splitmix64 and Box, Muller.
#[cfg(test)]
fn normals(seed: u64, count: usize) -> Vec<f64> {
    let mut state = seed;
    let mut uniform = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    (0..count)
        .map(|_| (-2.0 * uniform().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos())
        .collect()
}
