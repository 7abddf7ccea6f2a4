//! Motions: per joint a Fourier series about the posture where it starts and stops, faded in and
//! out.
//!
//! ```text
//! q(t) = c + w(t) sum_k (a_k sin(k o t) + b_k cos(k o t))      o = 2 (2 pi / T)
//! ```
//!
//! The period is half of the duration: all is done twice. Identification judges its parameters,
//! and the noise, by parts of a log that it predicts from the others; what happens only once
//! cannot be predicted, and would be taken for noise: on an arm, up to twice the deviations.
//!
//! The fade `w` rises from 0 to 1 within [`FADE`] and falls in the same way at the end, with three
//! continuous derivatives: the motion starts and stops at rest at `c`, without a jump of its
//! acceleration. (Swevers et al., "Optimal robot excitation and identification", T-RA 1997, use
//! the series without a fade.)
//!
//! Limits hold between the checked instants too: these are `GRID` apart, and what a harmonic can
//! rise in between is within the [`MARGIN`] that is kept.

use crate::workspace::MotionState;
use proprio_dynamics::model::{Frame, Limits};
use proprio_dynamics::spatial::Vec3;
use proprio_dynamics::{DynamicsError, FrameMotion, Kinematics};
use proprio_identification::Robot;
use std::f64::consts::TAU;

/// Time in which a motion is faded in, and out \[s\]; a quarter of a short one.
pub const FADE: f64 = 1.5;

/// The fastest harmonic \[Hz\]: the slowest joints and the derivatives of encoders follow it.
pub const FASTEST: f64 = 0.7;

/// Number of periods of a motion.
const CYCLES: f64 = 2.0;

/// Time between the instants at which limits are checked [s].
const GRID: f64 = 0.01;

/// Share of every limit that is left free.
pub const MARGIN: f64 = 0.005;

/// Distance from the walls of a box that is left free [m].
const WALL: f64 = 1e-3;

/// What a joint may do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Positions [rad or m].
    pub range: Limits,
    /// Greatest velocity [rad/s or m/s].
    pub velocity: f64,
    /// Greatest acceleration [rad/s^2 or m/s^2].
    pub acceleration: f64,
}

/// A box that points of a link do not leave.
#[derive(Clone, Debug, PartialEq)]
pub struct Fence {
    /// The name of the link, for messages.
    pub name: String,
    /// The points, each a frame of which the origin counts.
    pub points: Vec<Frame>,
    /// The frame in whose axes the walls are.
    pub base: Frame,
    /// The walls: least x, y, z \[m\].
    pub least: [f64; 3],
    /// The greatest.
    pub greatest: [f64; 3],
}

/// How far points may be from where they should: positive if outside [m].
struct Outside<'a> {
    robot: &'a Robot,
    kinematics: Kinematics,
}

impl<'a> Outside<'a> {
    fn new(robot: &'a Robot) -> Result<Self, DynamicsError> {
        let kinematics = Kinematics::new(&robot.model, robot.base_link)?;
        Ok(Self { robot, kinematics })
    }

    /// The positions of a box's points in its axes.
    fn points(&mut self, fence: &Fence, position: &[f64]) -> Result<Vec<Vec3>, DynamicsError> {
        let state = MotionState::at_rest(position.to_vec());
        let motion = FrameMotion::standing(&Vec3::zeros());
        (self.kinematics).update(&self.robot.model, state.joints(), &motion)?;
        let base = self.kinematics.frame_pose(&fence.base).inverse();
        let points = fence.points.iter();
        Ok(points
            .map(|point| (base * self.kinematics.frame_pose(point)).translation)
            .collect())
    }

    fn is_within(&mut self, fence: &Fence, position: &[f64]) -> bool {
        let Ok(points) = self.points(fence, position) else {
            return false;
        };
        points.iter().all(|point| {
            (0..3)
                .all(|k| point[k] >= fence.least[k] + WALL && point[k] <= fence.greatest[k] - WALL)
        })
    }
}

/// Positions of the points of a box at random postures: least and greatest x, y, z \[m\].
///
/// # Errors
/// A posture is of another robot.
pub fn reach(
    robot: &Robot,
    fence: &Fence,
    postures: &[Vec<f64>],
) -> Result<[[f64; 3]; 2], DynamicsError> {
    let mut outside = Outside::new(robot)?;
    let mut reach = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for posture in postures {
        for point in outside.points(fence, posture)? {
            for k in 0..3 {
                reach[0][k] = reach[0][k].min(point[k]);
                reach[1][k] = reach[1][k].max(point[k]);
            }
        }
    }
    Ok(reach)
}

/// Those of these postures in which all points are within their boxes.
///
/// # Errors
/// The base link does not exist.
pub fn within(
    robot: &Robot,
    fences: &[Fence],
    postures: &[Vec<f64>],
) -> Result<Vec<Vec<f64>>, DynamicsError> {
    let mut outside = Outside::new(robot)?;
    let is_within = |posture: &&Vec<f64>| {
        let mut fences = fences.iter();
        fences.all(|fence| outside.is_within(fence, posture))
    };
    Ok(postures.iter().filter(is_within).cloned().collect())
}

/// A motion of some joints.
#[derive(Clone, Debug, PartialEq)]
pub struct FourierSeries {
    /// Its duration [s].
    seconds: f64,
    /// Per degree of freedom, the position where it starts and stops, and `[a_k, b_k]`.
    joints: Vec<(f64, Vec<[f64; 2]>)>,
}

/// Number of harmonics of a motion of this duration \[s\].
pub(crate) fn harmonics(seconds: f64) -> usize {
    (FASTEST * seconds / CYCLES).round().clamp(2.0, 10.0) as usize
}

/// The fade and its two derivatives: `35 s^4 - 84 s^5 + 70 s^6 - 20 s^7` of the time `s` in it.
fn fade(t: f64, seconds: f64) -> [f64; 3] {
    let length = FADE.min(0.25 * seconds);
    let at = |time: f64| {
        let s = (time / length).clamp(0.0, 1.0);
        let (u, s2) = (1.0 - s, s * s);
        [
            s2 * s2 * (35.0 - 84.0 * s + 70.0 * s2 - 20.0 * s2 * s),
            140.0 * s2 * s * u.powi(3) / length,
            420.0 * s2 * u * u * (1.0 - 2.0 * s) / (length * length),
        ]
    };
    if 2.0 * t < seconds {
        at(t)
    } else {
        let [value, rate, change] = at(seconds - t);
        [value, -rate, change]
    }
}

impl FourierSeries {
    /// From free numbers: per moving joint (of these limits) the place of its start, and `[a, b]`
    /// of each harmonic in units of the greatest that its limits allow. Everything is scaled down
    /// until all limits and boxes hold. None if the start is outside a box.
    ///
    /// # Errors
    /// The boxes are of another robot.
    pub fn within(
        robot: &Robot,
        limits: &[Option<JointLimits>],
        fences: &[Fence],
        seconds: f64,
        numbers: &[f64],
    ) -> Result<Option<Self>, DynamicsError> {
        let count = harmonics(seconds);
        let mut chunks = numbers.chunks_exact(1 + 2 * count);
        let still = robot.position_without_samples();
        let joints = limits.iter().zip(still).map(|(limits, still)| {
            let Some(limits) = limits else {
                return (still, Vec::new());
            };
            let (middle, half) = (limits.range.middle(), limits.range.half());
            let [place, series @ ..] = chunks.next().unwrap_or_default() else {
                return (middle, Vec::new());
            };
            let start = middle + 0.8 * half * place.tanh();
            let pairs = series.chunks_exact(2).zip(1..);
            let pairs = pairs.map(|(pair, k)| {
                let rate = TAU * CYCLES * f64::from(k) / seconds;
                let most = half
                    .min(limits.velocity / rate)
                    .min(limits.acceleration / (rate * rate));
                [0, 1].map(|i| pair.get(i).copied().unwrap_or_default() * most)
            });
            (start, pairs.collect::<Vec<_>>())
        });
        let mut series = Self {
            seconds,
            joints: joints.collect(),
        };
        series.scale_to(limits);
        let mut outside = Outside::new(robot)?;
        if fences.is_empty() {
            return Ok(Some(series));
        }
        let mut is_within = |series: &Self, step: usize| {
            series.instants(GRID).step_by(step).all(|t| {
                let position = series.at(t).position;
                fences
                    .iter()
                    .all(|fence| outside.is_within(fence, &position))
            })
        };
        // Coarse first: most attempts fail at once.
        for _ in 0..24 {
            if [16, 4, 1].into_iter().all(|step| is_within(&series, step)) {
                return Ok(Some(series));
            }
            series.scale(|_| 0.8);
        }
        Ok(None)
    }

    fn scale(&mut self, factor: impl Fn(usize) -> f64) {
        for (dof, (_, series)) in self.joints.iter_mut().enumerate() {
            let factor = factor(dof);
            series.iter_mut().flatten().for_each(|x| *x *= factor);
        }
    }

    /// Scales each joint down to its limits.
    fn scale_to(&mut self, limits: &[Option<JointLimits>]) {
        let mut most = vec![0.0_f64; limits.len()];
        for t in self.instants(GRID) {
            let state = self.at(t);
            for (dof, limits) in limits.iter().enumerate() {
                let Some(limits) = limits else { continue };
                let start = self.joints[dof].0;
                let moved = state.position[dof] - start;
                let room = match moved > 0.0 {
                    true => limits.range.upper - start,
                    false => limits.range.lower - start,
                };
                let shares = [
                    moved / room,
                    state.velocity[dof].abs() / limits.velocity,
                    state.acceleration[dof].abs() / limits.acceleration,
                ];
                let shares = shares.into_iter().filter(|share| share.is_finite());
                most[dof] = shares.fold(most[dof], f64::max);
            }
        }
        self.scale(|dof| 1.0 / (most[dof] / (1.0 - MARGIN)).max(1.0));
    }

    /// Its duration \[s\].
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.seconds
    }

    /// Its instants, this far apart, with both ends \[s\].
    pub fn instants(&self, period: f64) -> impl Iterator<Item = f64> + use<> {
        let seconds = self.seconds;
        let count = (seconds / period).round().max(1.0);
        (0..=count as usize).map(move |k| seconds * k as f64 / count)
    }

    /// The state at a time since the start \[s\].
    #[must_use]
    pub fn at(&self, t: f64) -> MotionState {
        let t = t.clamp(0.0, self.seconds);
        let [w, w1, w2] = fade(t, self.seconds);
        let rate = TAU * CYCLES / self.seconds;
        let waves: Vec<[f64; 3]> = (1..=harmonics(self.seconds))
            .map(|k| {
                let rate = rate * k as f64;
                let (sin, cos) = (rate * t).sin_cos();
                [sin, cos, rate]
            })
            .collect();
        let mut state = MotionState::default();
        for (start, series) in &self.joints {
            let mut value = [0.0; 3];
            for ([a, b], [sin, cos, rate]) in series.iter().zip(&waves) {
                let (x, y) = (a * sin + b * cos, a * cos - b * sin);
                value[0] += x;
                value[1] += rate * y;
                value[2] -= rate * rate * x;
            }
            let [x, x1, x2] = value;
            state.position.push(start + w * x);
            state.velocity.push(w * x1 + w1 * x);
            state.acceleration.push(w * x2 + 2.0 * w1 * x1 + w2 * x);
        }
        state
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_are_those_of_the_positions_and_the_ends_are_at_rest() {
        let series = FourierSeries {
            seconds: 9.0,
            joints: vec![(0.4, vec![[0.3, -0.2], [0.1, 0.5]]), (1.0, Vec::new())],
        };
        for end in [0.0, 9.0] {
            let state = series.at(end);
            assert_eq!(state.position, [0.4, 1.0]);
            assert_eq!((state.velocity[0], state.acceleration[0]), (0.0, 0.0));
        }
        let h = 1e-5;
        for t in [0.2, 0.9, 4.0, 8.1, 8.9] {
            let [before, now, after] = [t - h, t, t + h].map(|t| series.at(t));
            let rate = (after.position[0] - before.position[0]) / (2.0 * h);
            let change = (after.velocity[0] - before.velocity[0]) / (2.0 * h);
            assert!((rate - now.velocity[0]).abs() < 1e-6, "{t}");
            assert!((change - now.acceleration[0]).abs() < 1e-6, "{t}");
        }
    }
}
