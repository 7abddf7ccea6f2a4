//! The motion of the robot: every joint stands still, then follows a sum of sines. All derivatives
//! are analytic.

use crate::noise::Random;
use proprio_dynamics::model::Limits;
use std::f64::consts::TAU;

/// The joints' motion: `q(t) = rest + w(t) * sum_k a_k sin(omega_k t + phi_k)`.
///
/// `w` is 0 while the robot stands still, 1 when it moves, and in between a polynomial with three
/// continuous derivatives, so that acceleration and jerk begin at zero. The amplitudes are chosen
/// so that no joint leaves its range (with a margin of a tenth) or exceeds
/// [`Trajectory::MOST_SPEED`].
#[derive(Debug, Clone)]
pub struct Trajectory {
    joints: Vec<JointSines>,
    still: f64,
}

#[derive(Debug, Clone)]
struct JointSines {
    rest: f64,
    sines: [Sine; 3],
}

#[derive(Debug, Clone, Copy)]
struct Sine {
    amplitude: f64,
    omega: f64,
    phase: f64,
}

/// Position, velocity and acceleration of a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// \[rad or m\].
    pub position: f64,
    /// \[rad/s or m/s\].
    pub velocity: f64,
    /// \[rad/s^2 or m/s^2\].
    pub acceleration: f64,
}

impl Trajectory {
    /// Maximum speed of a joint \[rad/s or m/s\].
    pub const MOST_SPEED: f64 = 1.2;
    /// Maximum distance of a joint from its rest position \[rad or m\].
    pub(crate) const MOST_EXCURSION: f64 = 0.4;
    /// Duration of the transition from rest to full motion \[s\].
    pub(crate) const BLEND: f64 = 2.0;
    /// Ranges of the three sines' frequencies \[Hz\].
    const BANDS: [(f64, f64); 3] = [(0.1, 0.25), (0.25, 0.5), (0.5, 0.9)];

    /// Draws the motion of joints with these ranges (`None`: unlimited) from `seed`; it begins
    /// after `still` seconds.
    ///
    /// Every joint rests in the middle of its range, one without a range at 0.
    #[must_use]
    pub fn new(ranges: &[Option<Limits>], seed: u64, still: f64) -> Self {
        let joints = ranges.iter().enumerate().map(|(number, range)| {
            let mut random = Random::new(seed, "trajectory", number);
            let (rest, half) = match range {
                Some(limits) => (
                    0.5 * (limits.lower + limits.upper),
                    0.5 * (limits.upper - limits.lower),
                ),
                None => (0.0, f64::INFINITY),
            };
            let mut sines = Self::BANDS.map(|(from, to)| {
                let frequency = random.uniform(from, to);
                // Smaller amplitudes for higher frequencies: each sine has about the same speed.
                let amplitude = random.uniform(0.5, 1.0) / frequency;
                Sine {
                    amplitude,
                    omega: TAU * frequency,
                    phase: random.uniform(0.0, TAU),
                }
            });
            let excursion: f64 = sines.iter().map(|s| s.amplitude).sum();
            let speed: f64 = sines.iter().map(|s| s.amplitude * s.omega).sum::<f64>()
                + excursion * window_steepest() / Self::BLEND;
            let most = (0.9 * half).clamp(0.0, Self::MOST_EXCURSION);
            let scale = (most / excursion).min(Self::MOST_SPEED / speed);
            for sine in &mut sines {
                sine.amplitude *= scale;
            }
            JointSines { rest, sines }
        });
        Self {
            joints: joints.collect(),
            still,
        }
    }

    /// Lets joint `joint` rest for good, at this position \[rad or m\] or where it rests anyway.
    pub fn rest(&mut self, joint: usize, at: Option<f64>) {
        if let Some(motion) = self.joints.get_mut(joint) {
            motion.rest = at.unwrap_or(motion.rest);
            motion
                .sines
                .iter_mut()
                .for_each(|sine| sine.amplitude = 0.0);
        }
    }

    /// Joint `joint` at `t` seconds; `None` if there is no such joint.
    #[must_use]
    pub fn at(&self, joint: usize, t: f64) -> Option<Point> {
        let JointSines { rest, sines } = self.joints.get(joint)?;
        let (w, dw, ddw) = window((t - self.still) / Self::BLEND);
        let (dw, ddw) = (dw / Self::BLEND, ddw / (Self::BLEND * Self::BLEND));
        let (mut s, mut ds, mut dds) = (0.0, 0.0, 0.0);
        for Sine {
            amplitude,
            omega,
            phase,
        } in sines
        {
            let (sin, cos) = (omega * t + phase).sin_cos();
            s += amplitude * sin;
            ds += amplitude * omega * cos;
            dds -= amplitude * omega * omega * sin;
        }
        Some(Point {
            position: rest + w * s,
            velocity: dw * s + w * ds,
            acceleration: ddw * s + 2.0 * dw * ds + w * dds,
        })
    }
}

/// From 0 to 1 while x goes from 0 to 1, with its first two derivatives; three derivatives are
/// continuous at both ends.
pub(crate) fn window(x: f64) -> (f64, f64, f64) {
    if x <= 0.0 {
        return (0.0, 0.0, 0.0);
    }
    if x >= 1.0 {
        return (1.0, 0.0, 0.0);
    }
    let y = 1.0 - x;
    let value = x.powi(4) * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)));
    (
        value,
        140.0 * (x * y).powi(3),
        420.0 * (x * y).powi(2) * (y - x),
    )
}

/// The window's steepest slope, at 1/2.
const fn window_steepest() -> f64 {
    140.0 / 64.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ranges() -> Vec<Option<Limits>> {
        vec![
            Some(Limits {
                lower: -1.7,
                upper: 0.2,
            }),
            Some(Limits {
                lower: -0.35,
                upper: 0.45,
            }),
            None,
            Some(Limits {
                lower: 0.1,
                upper: 0.1,
            }),
        ]
    }

    proptest! {
        #[test]
        fn every_joint_stays_within_its_limits(seed: u64, t in 0.0..300.0_f64) {
            let trajectory = Trajectory::new(&ranges(), seed, 1.0);
            for (joint, range) in ranges().iter().enumerate() {
                let point = trajectory.at(joint, t).unwrap();
                if let Some(limits) = range {
                    prop_assert!(point.position >= limits.lower && point.position <= limits.upper);
                }
                prop_assert!(point.velocity.abs() <= Trajectory::MOST_SPEED);
            }
        }

        #[test]
        fn derivatives_agree_with_finite_differences(seed: u64, t in 0.0..20.0_f64) {
            let trajectory = Trajectory::new(&ranges(), seed, 1.0);
            let h = 1e-5;
            for joint in 0..ranges().len() {
                let states = [t - h, t, t + h].map(|t| trajectory.at(joint, t).unwrap());
                let [before, at, after] = states;
                // Truncation error: h^2 / 6 times the third derivative, which is well below 1e3
                // here.
                let velocity = (after.position - before.position) / (2.0 * h);
                prop_assert!((velocity - at.velocity).abs() < 1e-7);
                let acceleration = (after.velocity - before.velocity) / (2.0 * h);
                prop_assert!((acceleration - at.acceleration).abs() < 1e-7);
            }
        }
    }

    #[test]
    fn it_stands_still_first_and_then_every_joint_moves() {
        let trajectory = Trajectory::new(&ranges(), 7, 1.5);
        for joint in [0, 1, 2] {
            let rest = trajectory.at(joint, 0.0).unwrap();
            assert_eq!((rest.velocity, rest.acceleration), (0.0, 0.0));
            assert_eq!(trajectory.at(joint, 1.5), Some(rest));
            let furthest = (0..600).map(|k| {
                (trajectory.at(joint, f64::from(k) * 0.05).unwrap().position - rest.position).abs()
            });
            assert!(furthest.fold(0.0, f64::max) > 0.05);
        }
        assert_eq!(trajectory.at(4, 0.0), None);
        assert_ne!(
            trajectory.at(0, 5.0),
            Trajectory::new(&ranges(), 8, 1.5).at(0, 5.0),
            "another seed gives another motion"
        );
    }

    #[test]
    fn the_window_is_smooth_at_its_ends() {
        let e = 1e-3;
        for (x, value) in [(e, 0.0), (1.0 - e, 1.0)] {
            let (w, dw, ddw) = window(x);
            assert!((w - value).abs() < 1e-10 && dw < 1e-6 && ddw.abs() < 1e-3);
        }
        assert!((window(0.5).1 - window_steepest()).abs() < 1e-12);
    }
}
