//! Tactile skin: from the values of a patch's taxels to the touch that they show, and where it is.
//! No input or output, no clock.
//!
//! ```text
//! value -> less the taxel's rest -> pressed, if above the threshold twice in a row
//! pressed taxels -> centroid of their positions and mean of their normals, weighted by pressure
//! ```
//!
//! - **Rest.** What an untouched taxel reads: the mean of its first second, which must be without a
//!   touch; then it follows slowly (`REST_TIME`) while the taxel is not pressed. A taxel that
//!   reads less than its rest by the threshold, twice in a row, was touched in its first second: it
//!   begins anew. So does a triangle that was silent for `REST_TIME`: its rest may have drifted.
//!   What touched it before, and touches it still, is then not seen.
//! - **Pressed.** Two readings in a row change a taxel's state: above the threshold it becomes
//!   pressed, below half of it, or not measured, released. So one wrong reading changes nothing.
//! - **Threshold.** From the noise of an untouched taxel and the false alarms that are accepted
//!   ([`threshold`]).
//! - **Silence.** A triangle of twelve taxels that has not been heard for `max_silence` shows no
//!   touch; readings with a fault do not count. If it showed one when it was last heard, the touch
//!   is lost: nobody knows whether it is still there (`TouchSum::lost`).
//!
//! Several touches on one link are one contact, at their common centroid. The centroid of a touch
//! on a curved surface lies below the surface: by 1.7 mm for a touch 2 cm wide on a forearm of 3 cm
//! radius.
//!
//! A skin shows touches, never that there are none: it covers a part of a link only.

mod taxels;

pub use taxels::{Taxel, TaxelMap};

use crate::history::History;
use proprio_dynamics::PlaceStd;
use proprio_dynamics::spatial::Vec3;
use proprio_identification::statistics::exceeded;
use proprio_topics::{Nanos, Quality, Reason, Skin};

/// Taxels of a triangle, as a reading has them.
pub const TRIANGLE: usize = 12;
/// Triangles of a patch: what one iCub board has.
pub const TRIANGLES: usize = 16;
/// Time constant with which the rest follows the drift of a taxel: slower than a touch, faster than
/// the temperature of a robot's cover.
const REST_TIME: Nanos = Nanos::from_millis(60_000);
/// The time at the start in which the rest is measured: 20 readings of the slowest usual board.
const START: Nanos = Nanos::from_millis(1_000);
/// Readings per second that the false alarms are counted for: more than any skin board sends, so
/// that the stated rate is not exceeded.
const READINGS_PER_SECOND: f64 = 100.0;
/// No taxel measures as much: such a value, or NaN, is not one.
const MEASURED: f64 = 1e9;
/// Touches of a triangle that are kept: 0.6 s at 200 readings a second, further back than any
/// instant that is still estimated or identified.
const KEPT: usize = 128;

/// A patch of skin: its channel, the contact that it belongs to, and its taxels.
#[derive(Debug, Clone, PartialEq)]
pub struct PatchSetup {
    /// The channel.
    pub channel: String,
    /// The number of the contact.
    pub contact: usize,
    /// The taxels in the contact's frame, twelve per triangle; none where there is no taxel.
    pub taxels: Vec<Option<Taxel>>,
    /// The pressure above which a taxel counts as pressed, in the unit of its values.
    pub threshold: f64,
    /// Standard deviation of a touch's position, each axis \[m\].
    pub position_std: f64,
    /// The longest time between two readings of a triangle.
    pub max_silence: Nanos,
}

/// The threshold of a patch of `taxels` taxels whose untouched values have this standard deviation,
/// for the accepted rate of false alarms of the patch.
///
/// Two readings of a taxel in a row must be above it. If their noise is normal and independent, the
/// patch shows `taxels * readings per hour * P^2` false touches an hour, `P` being the probability
/// of one reading.
#[must_use]
pub fn threshold(noise: f64, taxels: usize, false_alarms_per_hour: f64) -> f64 {
    let per_hour = 3600.0 * READINGS_PER_SECOND * taxels.max(1) as f64;
    noise * exceeded((false_alarms_per_hour / per_hour).sqrt().clamp(1e-300, 0.5))
}

/// Standard deviation of the direction of a force on a touched skin \[rad\]: friction, which is a
/// fifth of the pressure for a sliding finger, turns it from the normal.
const NORMAL_STD: f64 = 0.2;
/// The same where the normals of the touched taxels cancel out, so that the configured direction is
/// a guess: about that of any direction.
const NO_NORMAL_STD: f64 = 1.0;

/// What patches show at an instant: sums over their pressed taxels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct TouchSum {
    /// Sum of pressures; 0 without a touch.
    pressure: f64,
    /// Sum of pressure times position.
    moment: Vec3,
    /// Sum of pressure times outward normal.
    normal: Vec3,
    /// The largest standard deviation of position of the touched patches \[m\].
    position_std: f64,
    /// A patch was touched when it was last heard, and is silent now: its number.
    pub(crate) lost: Option<usize>,
}

impl TouchSum {
    /// Whether anything is touched.
    pub(crate) fn is_there(&self) -> bool {
        self.pressure > 0.0
    }

    /// The position of the touch, and the direction of a force into the skin; the latter `None` if
    /// the normals cancel each other, as on two opposite sides. With their standard deviations.
    pub(crate) fn place(&self) -> (Vec3, Option<Vec3>, PlaceStd) {
        let normal = self.normal / self.pressure;
        // A mean of unit vectors: shorter than half, they are more than 120 degrees apart.
        let direction = (normal.norm() > 0.5).then_some(-normal);
        let std = PlaceStd {
            position: self.position_std,
            direction: direction.map_or(NO_NORMAL_STD, |_| NORMAL_STD),
        };
        (self.moment / self.pressure, direction, std)
    }
}

/// What became of a reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Taken {
    /// It was taken.
    Yes,
    /// Stamped no later than the last one of its triangle.
    Backward,
    /// Marked as faulty, or of a triangle without taxels.
    No,
}

/// The state of a patch.
#[derive(Debug, Clone)]
pub(crate) struct TactilePatch {
    setup: PatchSetup,
    triangles: Vec<TaxelTriangle>,
    newest: Option<Nanos>,
}

#[derive(Debug, Clone)]
struct TaxelTriangle {
    taxels: [TaxelState; TRIANGLE],
    /// Its touch at each reading: pressure, moment, normal.
    touches: History<7, KEPT>,
}

/// What is known of a taxel.
#[derive(Debug, Clone, Copy, Default)]
struct TaxelState {
    rest: f64,
    /// The stamp of its first reading, and how many there were.
    first: Option<Nanos>,
    readings: u32,
    is_pressed: bool,
    /// The last pressure, if it is pressed.
    pressure: f64,
    /// The last reading said that `is_pressed` should change.
    wants_change: bool,
    /// The last reading was far below the rest.
    is_below: bool,
}

impl TaxelState {
    /// Takes a value; returns the pressure if it is pressed, else 0. `gain` is the share by which
    /// the rest follows.
    fn update(&mut self, t: Nanos, value: f64, threshold: f64, gain: f64) -> f64 {
        if value.is_nan() || value.abs() >= MEASURED {
            self.is_pressed &= !self.wants_change;
            (self.wants_change, self.is_below) = (self.is_pressed, false);
            return if self.is_pressed { self.pressure } else { 0.0 };
        }
        let pressure = value - self.rest;
        let wants_change = match self.is_pressed {
            false => pressure > threshold,
            true => pressure < 0.5 * threshold,
        };
        let is_below = pressure < -threshold;
        if is_below && self.is_below {
            *self = Self {
                rest: value,
                first: Some(t),
                readings: 1,
                ..Self::default()
            };
            return 0.0;
        }
        self.readings = self.readings.saturating_add(1);
        if t - *self.first.get_or_insert(t) < START {
            self.rest += pressure / f64::from(self.readings);
            self.is_below = is_below && self.readings > 1;
            return 0.0;
        }
        if wants_change && self.wants_change {
            self.is_pressed = !self.is_pressed;
            self.wants_change = false;
        } else {
            self.wants_change = wants_change;
        }
        if !self.is_pressed && pressure <= threshold {
            self.rest += gain * pressure;
        }
        self.is_below = is_below;
        self.pressure = if self.is_pressed {
            pressure.max(0.0)
        } else {
            0.0
        };
        self.pressure
    }
}

impl TactilePatch {
    pub(crate) fn new(setup: PatchSetup) -> Self {
        let triangle = || TaxelTriangle {
            taxels: [TaxelState::default(); TRIANGLE],
            touches: History::default(),
        };
        let count = setup.taxels.len().div_ceil(TRIANGLE);
        Self {
            triangles: std::iter::repeat_with(triangle).take(count).collect(),
            newest: None,
            setup,
        }
    }

    /// The contact that it belongs to.
    pub(crate) fn contact(&self) -> usize {
        self.setup.contact
    }

    /// The stamp of its newest reading.
    pub(crate) fn newest(&self) -> Option<Nanos> {
        self.newest
    }

    /// Takes a reading. Does not allocate.
    pub(crate) fn push(&mut self, t: Nanos, skin: &Skin, quality: Quality) -> Taken {
        let number = usize::try_from(skin.triangle).unwrap_or(usize::MAX);
        let Some(triangle) = self.triangles.get_mut(number) else {
            return Taken::No;
        };
        if Reason::of_quality(quality, Quality::DEVICE_FAULT) != Reason::None {
            return Taken::No;
        }
        let before = triangle.touches.newest();
        if before.is_some_and(|before| t <= before) {
            return Taken::Backward;
        }
        let since = before.map_or(Nanos::ZERO, |before| t - before);
        if since > REST_TIME {
            triangle.taxels = Default::default();
        }
        let gain = 1.0 - (-since.seconds() / REST_TIME.seconds()).exp();
        let places = self.setup.taxels.iter().skip(TRIANGLE * number);
        let mut sums = [0.0; 7];
        for ((state, value), place) in triangle.taxels.iter_mut().zip(skin.taxels).zip(places) {
            let Some(Taxel { position, normal }) = place else {
                continue;
            };
            let pressure = state.update(t, value, self.setup.threshold, gain);
            let parts = std::iter::once(&1.0)
                .chain(position.iter())
                .chain(normal.iter());
            for (sum, part) in sums.iter_mut().zip(parts) {
                *sum += pressure * part;
            }
        }
        triangle.touches.push(t, sums, Quality::GOOD);
        self.newest = self.newest.max(Some(t));
        Taken::Yes
    }

    /// Adds to `touch` what this patch, which has number `number`, shows at `t`.
    pub(crate) fn add_touch(&self, number: usize, t: Nanos, touch: &mut TouchSum) {
        for triangle in &self.triangles {
            let Some(held) = triangle.touches.at(t, t) else {
                continue;
            };
            let [pressure, x, y, z, nx, ny, nz] = held.value;
            if pressure == 0.0 {
                continue;
            }
            if held.age > self.setup.max_silence {
                touch.lost = touch.lost.or(Some(number));
                continue;
            }
            touch.pressure += pressure;
            touch.moment += Vec3::new(x, y, z);
            touch.normal += Vec3::new(nx, ny, nz);
            touch.position_std = touch.position_std.max(self.setup.position_std);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const MS: fn(i64) -> Nanos = Nanos::from_millis;

    /// Two triangles of taxels 1 cm apart in a row along x, whose normals point up.
    fn patch() -> TactilePatch {
        let taxel = |k: usize| {
            (k % 12 != 6).then(|| Taxel {
                position: Vec3::new(0.01 * k as f64, 0.0, 0.03),
                normal: Vec3::z(),
            })
        };
        TactilePatch::new(PatchSetup {
            channel: "skin".into(),
            contact: 0,
            taxels: (0..24).map(taxel).collect(),
            threshold: 4.0,
            position_std: 0.003,
            max_silence: MS(200),
        })
    }

    fn touch(patch: &TactilePatch, t: Nanos) -> TouchSum {
        let mut touch = TouchSum::default();
        patch.add_touch(7, t, &mut touch);
        touch
    }

    /// Pushes a reading every 20 ms until `to` \[ms\] in which the taxels named have these values.
    fn run(patch: &mut TactilePatch, from: i64, to: i64, rest: f64, pressed: &[(usize, f64)]) {
        for t in (from..to).step_by(20) {
            for triangle in 0..2_u32 {
                let mut taxels = [rest; 12];
                for (number, value) in pressed {
                    if *number / 12 == triangle as usize {
                        taxels[number % 12] = *value;
                    }
                }
                let skin = Skin { triangle, taxels };
                assert_eq!(patch.push(MS(t), &skin, Quality::GOOD), Taken::Yes);
            }
        }
    }

    #[test]
    fn a_touch_is_where_the_pressed_taxels_are() {
        let mut patch = patch();
        // Untouched taxels do not read zero.
        run(&mut patch, 0, 1500, -3.0, &[]);
        assert!(!touch(&patch, MS(1500)).is_there());
        // Over both triangles, weighted by the pressure above the rest.
        run(
            &mut patch,
            1500,
            1600,
            -3.0,
            &[(10, 17.0), (13, 57.0), (2, -1.0)],
        );
        let now = touch(&patch, MS(1600));
        let (position, direction, std) = now.place();
        let expected = (20.0 * 0.10 + 60.0 * 0.13) / 80.0;
        assert!(
            (position - Vec3::new(expected, 0.0, 0.03)).norm() < 1e-3,
            "{position}"
        );
        assert_eq!((direction, now.lost), (Some(-Vec3::z()), None));
        assert_eq!((std.position, std.direction), (0.003, NORMAL_STD));
        // What was before is still known.
        assert!(!touch(&patch, MS(1500)).is_there());
        assert!(touch(&patch, MS(1520)).is_there());
        run(&mut patch, 1600, 1700, -3.0, &[]);
        assert!(!touch(&patch, MS(1700)).is_there());
    }

    #[test]
    fn one_reading_changes_nothing_and_half_the_threshold_holds() {
        let mut patch = patch();
        run(&mut patch, 0, 1500, 0.0, &[]);
        run(&mut patch, 1500, 1520, 0.0, &[(3, 100.0)]);
        assert!(!touch(&patch, MS(1500)).is_there());
        run(&mut patch, 1520, 1540, 0.0, &[]);
        run(&mut patch, 1540, 1560, 0.0, &[(3, 100.0)]);
        assert!(!touch(&patch, MS(1540)).is_there(), "not in a row");
        run(&mut patch, 1560, 1580, 0.0, &[(3, 4.5)]);
        assert!(touch(&patch, MS(1560)).is_there());
        // Below the threshold, but not below half of it; then one reading without pressure.
        run(&mut patch, 1580, 1700, 0.0, &[(3, 2.5)]);
        run(&mut patch, 1700, 1720, 0.0, &[(3, 0.0)]);
        run(&mut patch, 1720, 1740, 0.0, &[(3, 2.5)]);
        assert!(touch(&patch, MS(1720)).is_there());
        run(&mut patch, 1740, 1780, 0.0, &[(3, 1.5)]);
        assert!(!touch(&patch, MS(1760)).is_there());
    }

    #[test]
    fn the_rest_follows_drift_but_not_a_touch() {
        let mut patch = patch();
        run(&mut patch, 0, 1500, 0.0, &[]);
        // 10 counts in 10 minutes, above the threshold of 4.
        for minute in 0..40 {
            let t = 1500 + minute * 15_000;
            run(&mut patch, t, t + 15_000, 0.25 * minute as f64, &[]);
            assert!(!touch(&patch, MS(t + 15_000)).is_there(), "{minute}");
        }
        let t = 601_500;
        // A touch of ten minutes.
        run(&mut patch, t, t + 600_000, 9.75, &[(5, 20.0)]);
        assert!(touch(&patch, MS(t + 600_000)).is_there());
    }

    #[test]
    fn a_skin_that_was_touched_at_the_start_recovers() {
        let mut patch = patch();
        run(&mut patch, 0, 1500, 0.0, &[(5, 50.0)]);
        assert!(!touch(&patch, MS(1500)).is_there(), "taken for its rest");
        run(&mut patch, 1500, 2700, 0.0, &[]);
        run(&mut patch, 2700, 2800, 0.0, &[(5, 50.0)]);
        assert!(touch(&patch, MS(2800)).is_there());
        // The others never stopped.
        run(&mut patch, 2800, 2900, 0.0, &[(4, 50.0), (5, 50.0)]);
        assert!((touch(&patch, MS(2900)).place().0.x - 0.045).abs() < 1e-3);
    }

    /// After a pause in which the rest has risen by more than the threshold.
    #[test]
    fn a_rest_that_rose_in_a_long_pause_is_no_touch() {
        let mut patch = patch();
        run(&mut patch, 0, 1500, 0.0, &[]);
        for (start, is_touch) in [(1480 + 60_000, true), (1480 + 600_000, false)] {
            let mut after = patch.clone();
            run(&mut after, start, start + 1500, 6.0, &[]);
            assert_eq!(touch(&after, MS(start + 1500)).is_there(), is_touch);
            run(&mut after, start + 1500, start + 1600, 6.0, &[(5, 50.0)]);
            assert!(touch(&after, MS(start + 1600)).is_there());
        }
    }

    #[test]
    fn a_value_that_was_not_measured_counts_as_one_reading() {
        let mut patch = patch();
        run(&mut patch, 0, 1500, 0.0, &[]);
        run(&mut patch, 1500, 1600, 0.0, &[(5, 50.0)]);
        let held = touch(&patch, MS(1600));
        run(&mut patch, 1600, 1620, 0.0, &[(5, f64::NAN)]);
        assert!(held.is_there());
        assert_eq!(touch(&patch, MS(1600)), held, "the last pressure");
        run(&mut patch, 1620, 1640, 0.0, &[(5, f64::INFINITY)]);
        assert!(!touch(&patch, MS(1620)).is_there());
        // Of an untouched one it is no pressure: the next one is the first.
        run(&mut patch, 1640, 1660, 0.0, &[(5, 50.0)]);
        run(&mut patch, 1660, 1680, 0.0, &[(5, f64::NAN)]);
        run(&mut patch, 1680, 1700, 0.0, &[(5, 50.0)]);
        assert!(!touch(&patch, MS(1680)).is_there());
    }

    #[test]
    fn a_touch_of_a_silent_triangle_is_lost_until_it_speaks_again() {
        let mut patch = patch();
        run(&mut patch, 0, 1500, 0.0, &[]);
        run(&mut patch, 1500, 1600, 0.0, &[(5, 50.0)]);
        let lost = |patch: &TactilePatch, t| touch(patch, MS(t)).lost;
        // The last reading was at 1580.
        assert_eq!((lost(&patch, 1780), lost(&patch, 1781)), (None, Some(7)));
        assert!(!touch(&patch, MS(1781)).is_there());
        // The other triangle speaks, and this one with a fault only.
        let fault = Quality::DEVICE_FAULT;
        for (triangle, quality) in [(1, Quality::GOOD), (0, fault)] {
            let skin = Skin {
                triangle,
                taxels: [0.0; 12],
            };
            patch.push(MS(1900), &skin, quality);
        }
        assert_eq!(lost(&patch, 1901), Some(7));
        let mut again = [0.0; 12];
        again[5] = f64::NAN;
        let skin = Skin {
            triangle: 0,
            taxels: again,
        };
        for t in [1930, 1950] {
            assert_eq!(patch.push(MS(t), &skin, Quality::GOOD), Taken::Yes);
        }
        assert_eq!(lost(&patch, 1951), None);
        // Untouched, silence loses nothing.
        assert_eq!(lost(&patch, 9000), None);
    }

    #[test]
    fn readings_that_do_not_fit_are_not_taken() {
        let mut patch = patch();
        let skin = |triangle| Skin {
            triangle,
            taxels: [0.0; 12],
        };
        assert_eq!(patch.push(MS(5), &skin(2), Quality::GOOD), Taken::No);
        assert_eq!(patch.push(MS(5), &skin(u32::MAX), Quality::GOOD), Taken::No);
        assert_eq!(patch.push(MS(5), &skin(1), Quality::GOOD), Taken::Yes);
        assert_eq!(patch.push(MS(5), &skin(1), Quality::GOOD), Taken::Backward);
        assert_eq!(patch.push(MS(4), &skin(1), Quality::GOOD), Taken::Backward);
        // Triangles have their own time.
        assert_eq!(patch.push(MS(4), &skin(0), Quality::GOOD), Taken::Yes);
        assert_eq!(patch.newest(), Some(MS(5)));
    }

    #[test]
    fn opposite_sides_have_no_direction() {
        let mut patch = patch();
        patch.setup.taxels[20] = Some(Taxel {
            position: Vec3::zeros(),
            normal: -Vec3::z(),
        });
        run(&mut patch, 0, 1500, 0.0, &[]);
        run(&mut patch, 1500, 1600, 0.0, &[(5, 50.0), (20, 50.0)]);
        let (_, direction, std) = touch(&patch, MS(1600)).place();
        assert_eq!((direction, std.direction), (None, NO_NORMAL_STD));
    }

    /// The stated rate of false alarms is the one that comes: normal noise on all taxels of a
    /// patch, at the rate of readings that the threshold is made for.
    #[test]
    fn false_alarms_are_as_rare_as_stated() {
        let mut taxels = vec![None; TRIANGLE * TRIANGLES];
        for taxel in taxels.iter_mut().take(96) {
            *taxel = Some(Taxel {
                position: Vec3::zeros(),
                normal: Vec3::z(),
            });
        }
        let (noise, per_hour) = (1.3, 2000.0);
        let mut patch = TactilePatch::new(PatchSetup {
            taxels,
            threshold: threshold(noise, 96, per_hour),
            ..patch().setup
        });
        // Normal numbers from a linear congruential generator, by the sum of twelve.
        let mut state = 1_u64;
        let mut uniform = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        let mut normal = || {
            let (u, v) = (1.0 - uniform(), uniform());
            noise * (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
        };
        let (mut alarms, mut was_pressed) = (0, [[false; TRIANGLE]; 8]);
        let seconds = 360;
        for t in 0..100 * seconds {
            for triangle in 0..8_u32 {
                let skin = Skin {
                    triangle,
                    taxels: std::array::from_fn(|_| normal()),
                };
                patch.push(MS(10 * t), &skin, Quality::GOOD);
                let states = &patch.triangles[triangle as usize].taxels;
                for (was, state) in was_pressed[triangle as usize].iter_mut().zip(states) {
                    alarms += u32::from(state.is_pressed && !*was);
                    *was = state.is_pressed;
                }
            }
        }
        // 200 are expected in six minutes; their number has a standard deviation of 14.
        assert!((140..260).contains(&alarms), "{alarms}");
    }

    #[test]
    fn a_threshold_is_higher_for_more_taxels_and_fewer_alarms() {
        // By hand: P^2 = 1 / (3600 * 100 * 160), P = 1.318e-4, 3.649 standard deviations.
        assert!(
            (threshold(2.0, 160, 1.0) - 7.298).abs() < 0.01,
            "{}",
            threshold(2.0, 160, 1.0)
        );
        assert!(threshold(1.0, 160, 1.0) > threshold(1.0, 10, 1.0));
        assert!(threshold(1.0, 160, 0.01) > threshold(1.0, 160, 1.0));
        assert!(threshold(1.0, 1, 1e30).abs() < 1e-6);
    }

    proptest! {
        #[test]
        fn any_values_of_any_triangle_give_finite_touches(
            readings in prop::collection::vec(
                (0..3_u32, any::<[f64; 12]>(), -50..500_i64, any::<u32>()), 0..60),
            typical in prop::collection::vec(prop::array::uniform12(-20.0..200.0_f64), 0..60),
        ) {
            let mut patch = patch();
            for (t, (triangle, taxels, step, quality)) in (0..).zip(readings) {
                let skin = Skin { triangle, taxels };
                patch.push(MS(40 * t + step), &skin, Quality(quality & 0xF));
            }
            for (t, taxels) in (0..).zip(typical) {
                patch.push(MS(5000 + 100 * t), &Skin { triangle: 0, taxels }, Quality::GOOD);
                let now = touch(&patch, MS(5000 + 100 * t));
                if now.is_there() {
                    let (position, direction, _) = now.place();
                    // Within the patch.
                    prop_assert!(position.x >= -1e-9 && position.x <= 0.24, "{}", position);
                    prop_assert!(direction.is_none_or(|d| d.iter().all(|x| x.is_finite())));
                }
            }
        }
    }
}
