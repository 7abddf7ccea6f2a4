//! Readings that repeat or jump: [`proprio_topics::sanity`].
#![allow(missing_docs)]

use proprio_topics::sanity::{Jumps, Repeats};
use proprio_topics::{Nanos, Quality};
use std::f64::consts::TAU;

/// As the gateway has it.
const LEAST_RUN: u32 = 16;

/// Normal numbers, the same in every run (xorshift, sum of twelve).
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        let mut uniform = || {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
            (self.0 >> 11) as f64 / (1_u64 << 53) as f64
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }
}

/// A sensor with one step for all axes, in whose readings an axis can be frozen.
struct Sensor {
    sanity: Repeats<6>,
    noise: Noise,
    /// \[steps\]
    deviation: f64,
    step: f64,
    held: [Option<f64>; 6],
}

impl Sensor {
    fn new(deviation: f64) -> Self {
        Self {
            sanity: Repeats::default(),
            noise: Noise(0x9E37_79B9_7F4A_7C15),
            deviation,
            step: 1804.0 / 32768.0,
            held: [None; 6],
        }
    }

    /// The mask after a reading of `load` \[steps\] on every axis; `frozen` axes keep theirs.
    fn read(&mut self, load: f64, frozen: u16) -> u16 {
        let mut values = [0.0; 6];
        for (axis, (value, held)) in values.iter_mut().zip(&mut self.held).enumerate() {
            let fresh = (load + self.deviation * self.noise.next()).round() * self.step;
            *value = match frozen >> axis & 1 {
                1 => *held.get_or_insert(fresh),
                _ => *held.insert(fresh),
            };
        }
        self.sanity.judge(&values, Quality::GOOD, LEAST_RUN)
    }

    /// Number of equal readings until the mask is `wanted`. (By chance an axis has been equal
    /// once or twice before.)
    fn until(&mut self, wanted: u16, frozen: u16) -> Option<u32> {
        (1..200).find(|_| self.read(0.0, frozen) == wanted)
    }
}

/// Rest and motion by turns of 40 s at 100 Hz: joints move a hundred steps at 0.5 Hz, or a
/// thousand.
fn work(k: u32) -> f64 {
    let swing = [0.0, 100.0, 0.0, 1000.0][k as usize / 4000 % 4];
    let t = f64::from(k % 4000) / 4000.0;
    // It begins and ends smoothly.
    swing * (0.5 - 0.5 * (t * TAU).cos()) * (t * 20.0 * TAU).sin()
}

#[test]
fn no_noise_and_no_resolution_raises_an_alarm() {
    for deviation in [0.0, 0.02, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0, 50.0] {
        let mut sensor = Sensor::new(deviation);
        for k in 0..100_000 {
            assert_eq!(sensor.read(work(k), 0), 0, "{deviation} steps, reading {k}");
        }
    }
}

/// A coarse sensor at an edge between two codes, which drifts to the middle of one; and with
/// single wrong readings.
#[test]
fn a_coarse_sensor_at_rest_raises_no_alarm() {
    for deviation in [0.05, 0.1, 0.2] {
        let mut sensor = Sensor::new(deviation);
        for k in 0..200_000 {
            let spike = if k % 5000 == 4999 { 4000.0 } else { 0.0 };
            let load = 0.5 + f64::from(k) / 40_000.0 + spike;
            assert_eq!(sensor.read(load, 0), 0, "{deviation} steps, reading {k}");
        }
    }
}

#[test]
fn a_sensor_that_freezes_is_found_within_a_few_readings() {
    for (deviation, most) in [(2.0, 32), (4.0, 20), (50.0, 16)] {
        let mut sensor = Sensor::new(deviation);
        for k in 0..3000 {
            sensor.read(work(k), 0);
        }
        for _ in 0..3 {
            let found = sensor.until(0x3F, 0x3F);
            assert!(
                found.is_some_and(|n| (14..=most).contains(&n)),
                "{deviation}: {found:?}"
            );
            // For as long as it lasts, and no longer.
            assert!((0..10_000).all(|_| sensor.read(0.0, 0x3F) == 0x3F));
            assert!((0..500).all(|_| sensor.read(0.0, 0) == 0));
        }
    }
    // What cannot be told from a coarse sensor at rest.
    let mut coarse = Sensor::new(0.3);
    assert!((0..3000).all(|_| coarse.read(0.0, 0) == 0));
    assert_eq!(coarse.until(0x3F, 0x3F), None);
}

#[test]
fn one_axis_that_freezes_is_named() {
    for axis in 0..6 {
        let mut sensor = Sensor::new(20.0);
        for _ in 0..3000 {
            assert_eq!(sensor.read(0.0, 0), 0);
        }
        let found = sensor.until(1 << axis, 1 << axis);
        assert!(
            found.is_some_and(|n| (14..=24).contains(&n)),
            "{axis}: {found:?}"
        );
    }
    // It is over at its first change, and found again.
    let mut sensor = Sensor::new(20.0);
    assert!((0..3000).all(|_| sensor.read(0.0, 0) == 0));
    for axis in [2, 4, 1] {
        assert!(sensor.until(1 << axis, 1 << axis).is_some(), "{axis}");
        // (By chance the first reading is the same.)
        sensor.read(0.0, 0);
        assert!((0..40).all(|_| sensor.read(0.0, 0) == 0));
    }
    // With little noise alone it may be chance: all axes together are needed.
    let mut sensor = Sensor::new(1.5);
    for _ in 0..3000 {
        sensor.read(0.0, 0);
    }
    assert!(sensor.until(1, 1).is_none_or(|n| n > 50));
}

/// A run of fifteen is not judged: a board may send a measurement several times.
#[test]
fn a_measurement_that_is_sent_several_times_is_not_frozen() {
    // (With less noise the next one is equal by chance.)
    let mut sensor = Sensor::new(3000.0);
    for k in 0..50_000 {
        // Enough fresh ones that the noise is known, before each fifty runs.
        let is_fresh = k % 3800 < 3000 || k % 3800 % 16 == 8;
        assert_eq!(
            sensor.read(work(k), if is_fresh { 0 } else { 0x3F }),
            0,
            "{k}"
        );
    }
    let mut sensor = Sensor::new(30.0);
    for (twice, k) in (0..3000).flat_map(|k| [(false, k), (true, k)]) {
        assert_eq!(sensor.read(work(k), if twice { 0x3F } else { 0 }), 0, "{k}");
    }
    assert!(sensor.until(0x3F, 0x3F).is_some());
}

/// What the copies of a measurement leave of its noise: little, and from eight on nothing.
#[test]
fn what_is_sent_too_often_is_never_found_frozen() {
    for (times, is_found) in [(2, true), (4, true), (7, true), (8, false), (16, false)] {
        let mut sensor = Sensor::new(3000.0);
        for k in 0..20_000 {
            let frozen = if k % times == 0 { 0 } else { 0x3F };
            assert_eq!(sensor.read(work(k), frozen), 0, "{times} {k}");
        }
        assert_eq!(sensor.until(0x3F, 0x3F).is_some(), is_found, "{times}");
    }
}

#[test]
fn what_the_device_says_itself_is_not_judged() {
    let mut sanity = Repeats::default();
    let mut noise = Noise(7);
    let wrench = |x: f64| [x, x, x, f64::NAN, f64::NAN, f64::NAN];
    for _ in 0..3000 {
        assert_eq!(
            sanity.judge(
                &wrench((30.0 * noise.next()).round()),
                Quality::GOOD,
                LEAST_RUN
            ),
            0
        );
    }
    for flag in [Quality::FROZEN, Quality::SATURATED] {
        assert!((0..100).all(|_| sanity.judge(&wrench(5.0), flag, LEAST_RUN) == 0));
    }
    // Without a word it is; the axes that it does not measure are not named.
    let found = (0..20)
        .map(|_| sanity.judge(&wrench(5.0), Quality::GOOD, LEAST_RUN))
        .last();
    assert_eq!(found, Some(0b111));
    assert_eq!(sanity.judge(&wrench(f64::NAN), Quality::GOOD, LEAST_RUN), 0);
}

/// Three axes, of which none alone is noisy enough; then also one that never changes.
#[test]
fn axes_are_judged_together() {
    for constant in [f64::NAN, 1.0] {
        let (mut sanity, mut noise) = (Repeats::default(), Noise(11));
        let mut fresh = || {
            let [x, y, z] = [(); 3].map(|()| (3.0 * noise.next()).round());
            [x, y, z, constant, constant, constant]
        };
        for _ in 0..3000 {
            assert_eq!(sanity.judge(&fresh(), Quality::GOOD, LEAST_RUN), 0);
        }
        let last = fresh();
        let masks: Vec<u16> = (0..60)
            .map(|_| sanity.judge(&last, Quality::GOOD, LEAST_RUN))
            .collect();
        let all = if constant.is_nan() { 0b111 } else { 0x3F };
        let first = masks.iter().position(|mask| *mask != 0).expect("found");
        assert!((15..40).contains(&first), "{first}");
        assert!(masks[first..].iter().all(|mask| *mask == all), "{masks:?}");
        // What the device says itself parts two runs.
        for _ in 0..3000 {
            sanity.judge(&fresh(), Quality::GOOD, LEAST_RUN);
        }
        let last = fresh();
        for k in 0..200 {
            let quality = match k % 12 {
                0 => Quality::SATURATED,
                _ => Quality::GOOD,
            };
            assert_eq!(sanity.judge(&last, quality, LEAST_RUN), 0, "{k}");
        }
    }
}

#[test]
fn what_was_never_different_is_not_frozen() {
    let mut sanity = Repeats::default();
    let wrench = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0];
    assert!((0..100_000).all(|_| sanity.judge(&wrench, Quality::GOOD, LEAST_RUN) == 0));
}

/// A channel of one axis, read every 10 ms.
#[derive(Default)]
struct Channel {
    jumps: Jumps<1>,
    t: i64,
}

impl Channel {
    fn read(&mut self, value: f64) -> bool {
        self.t += 10;
        (self.jumps).judge(Nanos::from_millis(self.t), &[value], Quality::GOOD)
    }

    fn doubtful(&mut self, values: &[f64]) -> Vec<bool> {
        values.iter().map(|value| self.read(*value)).collect()
    }
}

/// A channel that has read noise of this deviation, rounded to whole numbers.
fn noisy(deviation: f64) -> Channel {
    let (mut channel, mut noise) = (Channel::default(), Noise(5));
    for _ in 0..500 {
        channel.read((deviation * noise.next()).round());
    }
    channel
}

#[test]
fn noise_and_motion_are_not_doubtful() {
    for deviation in [0.0, 0.1, 0.3, 1.0, 3.0, 50.0] {
        let (mut channel, mut noise) = (Channel::default(), Noise(3));
        let doubtful =
            (0..200_000).filter(|k| channel.read((work(*k) + deviation * noise.next()).round()));
        let doubtful = doubtful.count();
        assert!(doubtful <= 2, "{deviation}: {doubtful}");
    }
}

#[test]
fn one_wrong_reading_is_doubtful_alone() {
    for deviation in [0.3, 1.0, 20.0_f64] {
        let far = 40.0 * deviation.max(1.0);
        for wrong in [far, -far, 1e9] {
            let mut channel = noisy(deviation);
            assert_eq!(channel.doubtful(&[0.0, wrong, 0.0]), [false, true, false]);
            // A hundred readings later it is as far off as before.
            assert!((0..100).all(|_| !channel.read(0.0)));
            assert!(channel.read(wrong) && !channel.read(0.0));
        }
    }
}

#[test]
fn wrong_readings_in_turn_are_doubtful() {
    let (mut channel, mut noise) = (noisy(1.0), Noise(9));
    let mut wrong = 0;
    for k in 0..3000 {
        let is_wrong = k % 10 < 2;
        let value = if is_wrong {
            5000.0 * noise.next()
        } else {
            noise.next()
        };
        let doubtful = channel.read(value);
        wrong += usize::from(is_wrong && !doubtful && value.abs() > 100.0);
    }
    // The second of two confirms the first by chance, once in three times.
    assert!(wrong < 150, "{wrong}");
}

#[test]
fn what_has_changed_is_confirmed_by_the_next_reading() {
    let mut channel = noisy(1.0);
    assert_eq!(
        channel.doubtful(&[400.0, 401.0, 400.0]),
        [true, false, false]
    );
    let mut channel = noisy(1.0);
    // A motion sets in: 20, 60, 120, ..
    let motion: Vec<f64> = (1..20).map(|k| 10.0 * f64::from(k * (k + 1))).collect();
    let doubtful = channel.doubtful(&motion);
    assert!(
        doubtful.iter().filter(|doubtful| **doubtful).count() <= 2,
        "{doubtful:?}"
    );
    assert!(!doubtful[1]);
    // A tare is no jump.
    let mut channel = noisy(1.0);
    let t = Nanos::from_millis(channel.t + 10);
    assert!(!channel.jumps.judge(t, &[700.0], Quality::ZERO_CHANGED));
    channel.t += 10;
    assert!(!channel.read(700.0));
}

/// An encoder whose readings are another bit off, at times, in another direction; then one that was
/// stuck, and goes on from where the joint is meanwhile.
#[test]
fn an_encoder_that_jumps_is_off_until_it_jumps_back() {
    let mut channel = Channel {
        jumps: Jumps::of_encoders([1e-4]),
        t: 0,
    };
    let swing = |t: i64| 0.8 * (t as f64 * 2e-3).sin();
    let mut run = |count: usize, off: f64| {
        let mut last = (0, 0.0);
        for _ in 0..count {
            let value = swing(channel.t + 10) + off;
            last = (last.0 + usize::from(channel.read(value)), value);
        }
        last
    };
    assert_eq!(run(500, 0.0).0, 0);
    for off in [0.7, -46850.8, 46850.8, -0.7] {
        assert_eq!(run(300, off).0, 300, "{off}");
    }
    let back = run(300, 0.0).0;
    assert!(back <= 2, "{back}");
    // One reading, and two, are off.
    assert!(run(1, 3.0).0 == 1 && run(300, 0.0).0 == 0);
    assert!(run(2, 3.0).0 == 2 && run(300, 0.0).0 <= 2);
    let (_, stuck) = run(1, 0.0);
    for _ in 0..100 {
        channel.read(stuck);
    }
    let mut run = |count: usize| {
        (0..count)
            .filter(|_| channel.read(swing(channel.t + 10)))
            .count()
    };
    assert!(run(100) <= 1);
}

/// One that stood is not elsewhere, however long it stood.
#[test]
fn an_encoder_that_jumps_while_it_stands_is_off() {
    let mut channel = Channel {
        jumps: Jumps::of_encoders([1e-4]),
        t: 0,
    };
    let mut run = |value: f64| {
        let counts = (0..500).map(|k| f64::from(u8::from(k % 100 == 50)));
        counts.filter(|k| channel.read(value + 1e-3 * k)).count()
    };
    assert_eq!(run(0.4), 0);
    assert_eq!(run(3.4), 500);
    assert!(run(0.4) <= 2);
}

/// A gap in its readings does not show that a stopped encoder goes on.
#[test]
fn what_stops_at_once_has_stopped_after_a_gap_too() {
    let mut channel = noisy(0.5);
    let mut last = 0.0;
    for k in 0..100 {
        last = f64::from(50 * k + k % 2);
        channel.read(last);
    }
    for _ in 0..10 {
        channel.read(last);
    }
    assert!(channel.jumps.has_stopped());
    channel.t += 300;
    for _ in 0..10 {
        channel.read(last);
        assert!(channel.jumps.has_stopped());
    }
    channel.t += 300;
    channel.read(last + 60.0);
    assert!(!channel.jumps.has_stopped());
}

/// A position from 0 to a turn begins anew.
#[test]
fn a_joint_that_turns_on_does_not_jump() {
    let mut channel = Channel {
        jumps: Jumps::of_encoders([1e-4]),
        t: 0,
    };
    let turn = TAU;
    let doubtful = (0..6000).filter(|k| channel.read((0.02 * f64::from(*k)).rem_euclid(turn)));
    // The first reading of each of the turns.
    assert_eq!(doubtful.count(), 19);
}

/// An encoder that is stuck stops at once; a joint that stops has to brake.
#[test]
fn what_stops_at_once_has_stopped() {
    // Half a count of noise, rounded; 50 counts a reading, and two less with each when it brakes.
    for brakes in [false, true] {
        let (mut channel, mut noise) = (Channel::default(), Noise(3));
        let mut value = 0.0;
        let mut last = 0.0;
        let braking = (0..25).map(|k| 48.0 - 2.0 * f64::from(k));
        let steps = std::iter::repeat_n(50.0, 100).chain(braking.filter(|_| brakes));
        for step in steps {
            value += step;
            last = (value + 0.5 * noise.next()).round();
            channel.read(last);
            assert!(!channel.jumps.has_stopped());
        }
        for _ in 0..200 {
            channel.read(last);
            assert_eq!(channel.jumps.has_stopped(), !brakes);
        }
        channel.read(last + 3.0);
        assert!(!channel.jumps.has_stopped());
    }
}

#[test]
fn after_a_gap_it_may_be_anywhere_near() {
    let swing = |t: i64| 1000.0 * (t as f64 * 1e-3 * 3.0).sin();
    for gap in [20, 100, 700] {
        let mut channel = Channel::default();
        for _ in 0..1000 {
            assert!(!channel.read(swing(channel.t + 10)));
        }
        channel.t += gap;
        assert!(!channel.read(swing(channel.t + 10)), "{gap}");
        assert!(!channel.read(swing(channel.t + 10)), "{gap}");
    }
    // Without a value, or in the past, nothing is judged.
    let mut channel = noisy(1.0);
    assert!(!channel.read(f64::NAN) && channel.read(1e6));
    channel.t -= 100;
    assert!(!channel.read(-1e6));
}

#[test]
fn an_encoder_that_stops_at_once_is_stuck_and_one_that_brakes_is_not() {
    let mut noise = Noise(11);
    let mut read = |value: f64| value + 1e-4 * noise.next();
    let (mut channel, period) = (Channel::default(), 0.01);
    let mut position = 0.0;
    let mut run = |channel: &mut Channel, speed: f64, count: usize| {
        let (mut doubtful, mut last) = (0, 0.0);
        for _ in 0..count {
            position += speed * period;
            last = read(position);
            doubtful += usize::from(channel.read(last));
        }
        (doubtful, last)
    };
    // At rest its noise shows; then it moves.
    run(&mut channel, 0.0, 100);
    let (doubtful, last) = run(&mut channel, 0.5, 100);
    assert!(doubtful <= 2, "{doubtful}");
    // Stuck for ten seconds; then it goes on from elsewhere.
    assert!((0..1000).all(|_| channel.read(last)));
    assert!(run(&mut channel, 0.5, 100).0 <= 2);
    // In steps of a milliradian, it brakes within 50 ms, and stands.
    let mut channel = Channel::default();
    let (mut position, mut speed) = (0.0_f64, 0.5_f64);
    let mut doubtful = 0;
    for k in 0..1000 {
        if k > 500 {
            speed = (speed - 0.1).max(0.0);
        }
        position += speed * period;
        doubtful += usize::from(channel.read((1e3 * position).round() * 1e-3));
    }
    assert!(doubtful <= 2, "{doubtful}");
}
