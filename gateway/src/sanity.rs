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
//! goes on changing. The first [`LEAST_RUN`] readings of a run are not marked.

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
        if std::mem::take(&mut self.frozen) {
            // What was no measurement tells nothing of the noise.
            self.noise = self.quiet;
        }
        let risen = self.quiet + (self.noise - self.quiet) / FORGET;
        self.quiet = risen.min(self.noise);
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
pub(crate) struct Sanity([Axis; 6]);

impl Sanity {
    pub(crate) const fn new() -> Self {
        Self([Axis::NEW; 6])
    }

    /// Takes a reading; returns the axes that are frozen, bit k for axis k of fx fy fz tx ty tz.
    ///
    /// A reading of which the device itself says that it is not a measurement is not judged.
    pub(crate) fn look(&mut self, wrench: &Wrench, quality: Quality) -> u16 {
        let axes = &mut self.0;
        if quality.intersects(Quality::FROZEN | Quality::SATURATED) {
            axes.iter_mut().for_each(Axis::interrupt);
            return 0;
        }
        let values = wrench.force.into_iter().chain(wrench.torque);
        axes.iter_mut().zip(values).for_each(|(axis, v)| axis.take(v));
        // Axes that the sensor does not measure are not part of it.
        let measured = || axes.iter().filter(|axis| !axis.last.is_nan());
        let longest = measured().map(|axis| axis.run).max().unwrap_or(0);
        if longest < LEAST_RUN {
            return 0;
        }
        let together = measured().map(|axis| axis.run).min().unwrap_or(0);
        let certain = |run: u32, surprise: f64| {
            run >= LEAST_RUN && f64::from(run) * surprise >= CERTAINTY
        };
        let all = certain(together, measured().map(Axis::surprise).sum());
        let mut mask = 0;
        for (number, axis) in (0..).zip(axes.iter_mut()).filter(|(_, a)| !a.last.is_nan()) {
            axis.frozen |= all || certain(axis.run, axis.surprise());
            mask |= u16::from(axis.frozen) << number;
        }
        mask
    }
}
