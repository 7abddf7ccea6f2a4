//! Whether the values of a force/torque sensor can be true: a value that stops to change, although
//! its noise made that impossible, is frozen. Boards freeze without saying so: after a temperature
//! error, or while a gauge of which they do not tell is saturated.
//!
//! Each axis is judged by its own past alone, in steps of its own resolution (the smallest change
//! seen). Its noise is the mean absolute second difference of successive readings: motion leaves it
//! small, because smooth values bend little between two readings. What counts is the noise of the
//! quietest recent stretch: after a motion with vibration the noise at rest may be far smaller.
//!
//! Of white noise with a mean second difference of n steps, at most the share 0.55 / n of the
//! readings equals the one before (Gaussian: the deviation is n / 1.95 steps, and the density of a
//! first difference at zero is 0.28 / deviation). So a run of r equal readings has the probability
//! (0.55 / n)^r, and that of all axes together is the product. Three times that share is allowed,
//! because stretches differ; then the limit of 1e-12 is one false alarm in 30 years at 1 kHz. A
//! coarse sensor at rest, whose noise is below its resolution, is expected to repeat itself and
//! raises no alarm; nor does one that has never changed.
//!
//! What this does not see: a value that was constant from the start, and one that is wrong but
//! goes on changing. The first [`LEAST_RUN`] - 1 repeated readings of a run are not marked.

use proprio_topics::{Quality, Wrench};

/// The shortest run that counts, however improbable: some boards send one measurement several
/// times, if they send faster than they measure.
const LEAST_RUN: u32 = 16;

/// Minus the logarithm of the probability of a false alarm per reading: 1e-12.
const CERTAINTY: f64 = 27.6;

/// The share of equal readings at a noise of one step: three times that of white noise.
const SHARE: f64 = 3.0 * 0.55;

/// Readings over which noise is averaged: few, so that it follows a vibration that fades away.
const AVERAGE: f64 = 16.0;

/// Readings over which the noise of a quiet stretch is forgotten.
const FORGET: f64 = 256.0;

/// A second difference counts as at most so many times the noise so far, so that a single wrong
/// reading, or a stop at once, is no noise.
const OUTLIER: f64 = 4.0;

/// The past of one axis. NaN: not known.
#[derive(Debug, Clone, Copy)]
struct Axis {
    last: f64,
    /// The last change.
    change: f64,
    /// The smallest change seen.
    step: f64,
    /// The mean absolute second difference at present, and of the quietest recent stretch.
    noise: f64,
    quiet: f64,
    /// Number of readings in a row that equal the one before.
    run: u32,
    frozen: bool,
}

impl Axis {
    const NEW: Self = Self {
        last: f64::NAN,
        change: f64::NAN,
        step: f64::INFINITY,
        noise: 0.0,
        quiet: 0.0,
        run: 0,
        frozen: false,
    };

    fn take(&mut self, value: f64) {
        let change = value - self.last;
        let bend = (change - self.change).abs();
        (self.last, self.change) = (value, change);
        if change == 0.0 {
            self.run = self.run.saturating_add(1);
        } else {
            self.run = 0;
            if change.is_finite() {
                self.step = self.step.min(change.abs());
            }
        }
        if self.step.is_finite() && bend.is_finite() {
            let most = OUTLIER * self.noise.max(self.step);
            self.noise += (bend.min(most) - self.noise) / AVERAGE;
        }
        if self.run > 0 {
            return;
        }
        if std::mem::take(&mut self.frozen) && change.abs() > 2.0 * self.step {
            // What was no measurement tells nothing of the noise. But a value that goes on by a
            // step was measured all the time: its noise at rest is below the resolution.
            self.noise = self.quiet;
        }
        let risen = self.quiet + (self.noise - self.quiet) / FORGET;
        self.quiet = risen.min(self.noise);
    }

    /// It was frozen with the others, which are no longer: its value is the same by chance.
    const fn release(&mut self) {
        self.run = 0;
        self.frozen = false;
        self.noise = self.quiet;
    }

    /// What follows has no connection with what came before; its noise has.
    const fn interrupt(&mut self) {
        self.last = f64::NAN;
        self.change = f64::NAN;
        self.run = 0;
        self.frozen = false;
    }

    /// Minus the logarithm of the probability that a reading equals the one before.
    fn surprise(&self) -> f64 {
        (self.quiet / (SHARE * self.step)).ln().max(0.0)
    }
}

/// The past of one sensor.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sanity {
    axes: [Axis; 6],
    /// All axes together are frozen.
    all: bool,
}

impl Sanity {
    pub(crate) const fn new() -> Self {
        Self {
            axes: [Axis::NEW; 6],
            all: false,
        }
    }

    /// Takes a reading; returns the axes that are frozen, bit k for axis k of fx fy fz tx ty tz.
    ///
    /// A reading of which the device itself says that it is not a measurement is not judged.
    pub(crate) fn look(&mut self, wrench: &Wrench, quality: Quality) -> u16 {
        let axes = &mut self.axes;
        if quality.intersects(Quality::FROZEN | Quality::SATURATED) {
            axes.iter_mut().for_each(Axis::interrupt);
            self.all = false;
            return 0;
        }
        let values = wrench.force.into_iter().chain(wrench.torque);
        axes.iter_mut()
            .zip(values)
            .for_each(|(axis, value)| axis.take(value));
        // Axes that the sensor does not measure are not part of it.
        let measured = || axes.iter().filter(|axis| !axis.last.is_nan());
        let longest = measured().map(|axis| axis.run).max().unwrap_or(0);
        let together = measured().map(|axis| axis.run).min().unwrap_or(0);
        if self.all && together == 0 {
            self.all = false;
            let same = axes.iter_mut().filter(|axis| axis.run > 0);
            same.for_each(Axis::release);
            return 0;
        }
        if longest < LEAST_RUN {
            return 0;
        }
        let certain =
            |run: u32, surprise: f64| run >= LEAST_RUN && f64::from(run) * surprise >= CERTAINTY;
        self.all |= certain(together, measured().map(Axis::surprise).sum());
        let mut mask = 0;
        let numbered = (0..).zip(axes.iter_mut());
        for (number, axis) in numbered.filter(|(_, axis)| !axis.last.is_nan()) {
            axis.frozen |= self.all || certain(axis.run, axis.surprise());
            mask |= u16::from(axis.frozen) << number;
        }
        mask
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

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
        sanity: Sanity,
        noise: Noise,
        /// \[steps\]
        deviation: f64,
        step: f64,
        held: [Option<f64>; 6],
    }

    impl Sensor {
        fn new(deviation: f64) -> Self {
            Self {
                sanity: Sanity::new(),
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
            let [fx, fy, fz, tx, ty, tz] = values;
            let (force, torque) = ([fx, fy, fz], [tx, ty, tz]);
            self.sanity.look(&Wrench { force, torque }, Quality::GOOD)
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
        let mut sensor = Sensor::new(30.0);
        for k in 0..50_000 {
            let frozen = if k % 16 == 0 { 0 } else { 0x3F };
            assert_eq!(sensor.read(work(k), frozen), 0, "{k}");
        }
        for (twice, k) in (0..3000).flat_map(|k| [(false, k), (true, k)]) {
            assert_eq!(sensor.read(work(k), if twice { 0x3F } else { 0 }), 0, "{k}");
        }
        assert!(sensor.until(0x3F, 0x3F).is_some());
    }

    #[test]
    fn what_the_device_says_itself_is_not_judged() {
        let mut sanity = Sanity::new();
        let mut noise = Noise(7);
        let wrench = |x: f64| Wrench {
            force: [x; 3],
            torque: [f64::NAN; 3],
        };
        for _ in 0..3000 {
            assert_eq!(
                sanity.look(&wrench((30.0 * noise.next()).round()), Quality::GOOD),
                0
            );
        }
        for flag in [Quality::FROZEN, Quality::SATURATED] {
            assert!((0..100).all(|_| sanity.look(&wrench(5.0), flag) == 0));
        }
        // Without a word it is; the axes that it does not measure are not named.
        let found = (0..20)
            .map(|_| sanity.look(&wrench(5.0), Quality::GOOD))
            .last();
        assert_eq!(found, Some(0b111));
        assert_eq!(sanity.look(&wrench(f64::NAN), Quality::GOOD), 0);
    }

    /// Three axes, of which none alone is noisy enough; then also one that never changes.
    #[test]
    fn axes_are_judged_together() {
        for constant in [f64::NAN, 1.0] {
            let (mut sanity, mut noise) = (Sanity::new(), Noise(11));
            let mut fresh = || Wrench {
                force: [(); 3].map(|()| (3.0 * noise.next()).round()),
                torque: [constant; 3],
            };
            for _ in 0..3000 {
                assert_eq!(sanity.look(&fresh(), Quality::GOOD), 0);
            }
            let last = fresh();
            let masks: Vec<u16> = (0..60).map(|_| sanity.look(&last, Quality::GOOD)).collect();
            let all = if constant.is_nan() { 0b111 } else { 0x3F };
            let first = masks.iter().position(|mask| *mask != 0).expect("found");
            assert!((15..40).contains(&first), "{first}");
            assert!(masks[first..].iter().all(|mask| *mask == all), "{masks:?}");
            // What the device says itself parts two runs.
            for _ in 0..3000 {
                sanity.look(&fresh(), Quality::GOOD);
            }
            let last = fresh();
            for k in 0..200 {
                let quality = match k % 12 {
                    0 => Quality::SATURATED,
                    _ => Quality::GOOD,
                };
                assert_eq!(sanity.look(&last, quality), 0, "{k}");
            }
        }
    }

    #[test]
    fn what_was_never_different_is_not_frozen() {
        let mut sanity = Sanity::new();
        let wrench = Wrench {
            force: [1.0; 3],
            torque: [0.0; 3],
        };
        assert!((0..100_000).all(|_| sanity.look(&wrench, Quality::GOOD) == 0));
    }
}
