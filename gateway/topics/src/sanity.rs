//! Whether the readings of a channel can be true: each is judged by those before it.
//!
//! # Repeats
//! A value that stops to change, although its noise made that impossible, is frozen. Boards freeze
//! without saying so: after a temperature error, or while a gauge of which they do not tell is
//! saturated.
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
//! raises no alarm; nor does one that has never changed. Boards that send faster than they measure
//! send one measurement several times: the caller says from how many on a run counts.
//!
//! What this does not see: a value that was constant from the start, and one that is wrong but
//! goes on changing; and what becomes of a board that sends each measurement eight times or more.
//! The two bends of a measurement raise the noise by 3/16 each at most, and each copy between them
//! takes 1/16 away: (19/16)^2 (15/16)^6 < 1, so that no noise is left. Of little noise, fewer
//! copies leave less than a step.
//!
//! It is not for encoders: the jitter of a joint that moves ends when it stands, at one count.
//!
//! # Jumps
//! A value that is far from where those before it lead is doubtful until the next one confirms it:
//! one wrong reading is no motion and no load. A value that stops at once, in the midst of a
//! motion, is not confirmed by its repeats. A joint does not jump at all: an encoder that does is
//! off until it jumps back. See [`Jumps`].

use crate::{Nanos, Quality};
use core::f64::consts::TAU;

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
struct AxisHistory {
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

impl AxisHistory {
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
        if core::mem::take(&mut self.frozen) && change.abs() > 2.0 * self.step {
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
        libm::log(self.quiet / (SHARE * self.step)).max(0.0)
    }
}

/// The repeats of a channel of `N` axes.
#[derive(Debug, Clone, Copy)]
pub struct Repeats<const N: usize> {
    axes: [AxisHistory; N],
    /// All axes together are frozen.
    all: bool,
}

impl<const N: usize> Default for Repeats<N> {
    fn default() -> Self {
        Self {
            axes: [AxisHistory::NEW; N],
            all: false,
        }
    }
}

impl<const N: usize> Repeats<N> {
    /// Takes a reading, NaN where it has none; returns the axes that are frozen, bit k for axis k.
    /// A run of fewer than `least` readings that equal the one before does not count, however
    /// improbable it is.
    ///
    /// A reading of which the device itself says that it is not a measurement is not judged.
    pub fn judge(&mut self, values: &[f64; N], quality: Quality, least: u32) -> u16 {
        let axes = &mut self.axes;
        if quality.intersects(Quality::FROZEN | Quality::SATURATED) {
            axes.iter_mut().for_each(AxisHistory::interrupt);
            self.all = false;
            return 0;
        }
        for (axis, value) in axes.iter_mut().zip(values) {
            // One that is not measured, now or before, shows nothing.
            if !(value.is_nan() && axis.last.is_nan()) {
                axis.take(*value);
            }
        }
        // Axes that the sensor does not measure are not part of it.
        let measured = || axes.iter().filter(|axis| !axis.last.is_nan());
        let longest = measured().map(|axis| axis.run).max().unwrap_or(0);
        let together = measured().map(|axis| axis.run).min().unwrap_or(0);
        if self.all && together == 0 {
            self.all = false;
            let same = axes.iter_mut().filter(|axis| axis.run > 0);
            same.for_each(AxisHistory::release);
            return 0;
        }
        if longest < least {
            return 0;
        }
        let certain =
            |run: u32, surprise: f64| run >= least && f64::from(run) * surprise >= CERTAINTY;
        self.all |= certain(together, measured().map(AxisHistory::surprise).sum());
        let mut mask = 0;
        let numbered = (0..).zip(axes.iter_mut());
        for (number, axis) in numbered.filter(|(_, axis)| !axis.last.is_nan()) {
            axis.frozen |= self.all || certain(axis.run, axis.surprise());
            mask |= u16::from(axis.frozen) << number;
        }
        mask
    }
}

/// The longest run of equal readings that may be one measurement, sent several times: some boards
/// send faster than they measure.
pub const LONGEST_COPIES: u32 = 16;

/// How far a reading may be from where those before it lead: so many times the largest such
/// distance of about the last [`MEMORY`] readings. That of white noise exceeds it never: the
/// largest of 32 is two deviations, and ten are left.
const FAR: f64 = 5.0;
/// A gap, in periods.
const GAP: f64 = 5.0;
/// Readings over which a large distance is forgotten.
const MEMORY: f64 = 32.0;
/// So many readings are taken as they come, to see how they are.
const FIRST: u32 = 16;
/// No brake stops a joint in less time \[s\].
const BRAKING: f64 = 0.02;
/// A stop counts as at once from so many times the largest recent distance on.
const STOP: f64 = 2.0;
/// No joint of a robot moves faster \[rad/s, m/s\]: eight turns a second.
const FASTEST: f64 = 50.0;
/// A reading that comes later than this is of no use \[s\].
const LATE: f64 = 0.1;
/// How much larger the expected distance becomes by one reading, at most: two wrong readings that
/// confirm each other by chance shall not make the third a usual one.
const GROWTH: f64 = 2.0;

/// The path of one axis.
#[derive(Debug, Clone, Copy)]
struct AxisPath {
    /// The last reading that is not doubtful.
    t: Nanos,
    value: f64,
    /// Its change \[1/s\].
    rate: f64,
    /// The usual time between two readings \[s\].
    period: f64,
    /// The largest recent distance from where the path led.
    most: f64,
    /// The smallest change seen: the resolution.
    step: f64,
    /// What its stated noise makes of the distance.
    least: f64,
    /// Readings so far.
    count: u32,
    /// The last reading follows a gap: where it leads is not known.
    resumes: bool,
    /// A doubtful reading, and its distance.
    doubtful: Option<(Nanos, f64, f64)>,
    /// It has stopped at once, and its value has been the same since then.
    has_stopped: bool,
    /// The last reading confirmed that the value is another one, without a motion.
    has_stepped: bool,
    /// The greatest speed of an encoder's joint; infinite if this is none.
    fastest: f64,
    /// Its last speed, were the stamps in step.
    speed: f64,
    /// Where the joint is by all smooth changes, and when it was last known to be there.
    joint: (Nanos, f64),
    /// The readings can not be where the joint is.
    is_off: bool,
}

impl AxisPath {
    const NEW: Self = Self {
        t: Nanos::ZERO,
        value: f64::NAN,
        least: 0.0,
        rate: 0.0,
        period: 0.0,
        most: 0.0,
        step: f64::INFINITY,
        count: 0,
        resumes: false,
        doubtful: None,
        has_stopped: false,
        has_stepped: false,
        fastest: f64::INFINITY,
        speed: 0.0,
        joint: (Nanos::ZERO, 0.0),
        is_off: false,
    };

    /// Takes a reading; returns whether it is doubtful.
    fn take(&mut self, t: Nanos, value: f64) -> bool {
        let after = (t - self.t).seconds();
        if !value.is_finite() || after <= 0.0 && self.count > 0 {
            return false;
        }
        self.has_stepped = false;
        let had_stopped = core::mem::take(&mut self.has_stopped);
        if self.value.is_finite() && value != self.value {
            self.step = self.step.min((value - self.value).abs());
        }
        let distance = (value - self.value - self.rate * after).abs();
        if self.count < FIRST || self.value.is_nan() {
            self.count += 1;
            self.period = if self.period > 0.0 {
                self.period.min(after)
            } else {
                after
            };
            (self.joint, self.is_off) = ((t, value), false);
            return self.accept(t, value, if self.count > 2 { distance } else { 0.0 });
        }
        if self.resumes {
            self.has_stopped = had_stopped && value == self.value;
            self.move_on(t, value);
            return self.accept(t, value, 0.0);
        }
        let most = self.most.max(self.step).max(self.least);
        // A joint that moves steadily never shows its resolution, so that does not count here.
        let is_at_once = distance > STOP * self.most * (after / self.period).max(1.0);
        self.has_stopped = value == self.value && (had_stopped || is_at_once);
        // The last good value again and again, without time to brake: it is stuck.
        if let Some((then, before, _)) = self.doubtful
            && value == before
            && value == self.value
            && (then - self.t).seconds() < BRAKING
        {
            return true;
        }
        let usual = FAR * most;
        // Smooth values bend with the square of the time.
        let longer = (after / self.period).max(1.0);
        if distance <= usual * longer * longer {
            self.move_on(t, value);
            return self.accept(t, value, distance / (longer * longer));
        }
        if let Some((then, before, off)) = self.doubtful {
            let (since, between) = ((then - self.t).seconds(), (t - then).seconds());
            let rate = (before - self.value) / since;
            // As it was before, or going on as before.
            let is_near = (value - before).abs() <= usual
                || (value - before - self.rate * between).abs() <= usual;
            if is_near || (value - before - rate * between).abs() <= off {
                // A step; or a motion, whose readings bend so much.
                let most = match is_near {
                    true => 0.0,
                    false => off.min(GROWTH * most),
                };
                let step = (before - self.value).abs();
                self.has_stepped = is_near && step > self.rate.abs() * since + usual;
                self.judge_place(then, before);
                if is_near {
                    self.joint.1 += value - before;
                } else if !self.is_off {
                    self.judge_place(t, value);
                }
                (self.t, self.value) = (then, before);
                return self.accept(t, value, most);
            }
        }
        self.doubtful = Some((t, value, distance));
        true
    }

    /// The reading goes on smoothly, and the joint with it. One that has stopped at once may be
    /// stuck, and the joint elsewhere when it goes on.
    fn move_on(&mut self, t: Nanos, value: f64) {
        if !self.has_stopped {
            self.joint = (t, self.joint.1 + value - self.value);
        }
    }

    /// The path goes on from elsewhere: judges whether the joint can be there. It may have moved
    /// while readings were on their way, and stamps may be closer together than the readings were.
    fn judge_place(&mut self, t: Nanos, value: f64) {
        let (then, before) = self.joint;
        let apart = (value - before).abs();
        // A position within a turn begins anew after each.
        let apart = apart.min((apart - TAU).abs());
        let moved = self.fastest * (t - then).seconds().max(self.period);
        self.is_off = apart > moved + self.speed.min(self.fastest) * LATE;
        if !self.is_off {
            self.joint = (t, value);
        }
    }

    /// Goes on from this reading. Returns whether the encoder is off.
    fn accept(&mut self, t: Nanos, value: f64, distance: f64) -> bool {
        let after = (t - self.t).seconds();
        self.resumes = after > GAP * self.period;
        if self.resumes && after > LATE {
            (self.joint, self.is_off) = ((t, value), false);
        }
        self.speed = match self.value.is_finite() {
            true => (value - self.value).abs() / after.max(self.period),
            false => 0.0,
        };
        self.rate = match self.value.is_finite() && after > 0.0 {
            true => (value - self.value) / after,
            false => 0.0,
        };
        self.period += (after.min(2.0 * self.period) - self.period) / MEMORY;
        self.most = (self.most * (1.0 - 1.0 / MEMORY)).max(distance);
        (self.t, self.value, self.doubtful) = (t, value, None);
        self.is_off
    }
}

/// The jumps of a channel of `N` axes. A reading is doubtful that is further from the line through
/// the two before it than five times the largest such distance of late (of white noise: ten
/// deviations), on any axis; but never one that is no further than its stated noise may be. The
/// next reading decides: if it is where the doubtful one leads, or near it, the value has really
/// changed; if it is where those before lead, one reading was wrong. A load or motion that sets in
/// at once costs a reading, or a few while it grows.
#[derive(Debug, Clone, Copy)]
pub struct Jumps<const N: usize>([AxisPath; N]);

impl<const N: usize> Default for Jumps<N> {
    fn default() -> Self {
        Self([AxisPath::NEW; N])
    }
}

impl<const N: usize> Jumps<N> {
    /// For axes whose error is stated to be at most `peaks`; 0 where it is not known.
    #[must_use]
    pub fn new(peaks: [f64; N]) -> Self {
        // The line through two readings is off by three errors, and the reading by one.
        Self(peaks.map(|peak| AxisPath {
            least: 4.0 * peak,
            ..AxisPath::NEW
        }))
    }

    /// For encoders, in rad or m: a joint is never at once elsewhere. One that has jumped by more
    /// than a joint can move reads another zero from then on; all its readings are doubtful until
    /// it jumps back to where the joint has moved meanwhile, or until a new zero, or a gap in which
    /// the joint can have moved there. A jump by a turn is none.
    #[must_use]
    pub fn of_encoders(peaks: [f64; N]) -> Self {
        let paths = Self::new(peaks).0;
        Self(paths.map(|path| AxisPath {
            fastest: FASTEST,
            ..path
        }))
    }

    /// The usual time between two readings \[s\]: one that comes early or late hardly changes it.
    /// Not known before the second reading.
    #[must_use]
    pub fn period(&self) -> f64 {
        self.0.first().map_or(0.0, |path| path.period)
    }

    /// Whether an axis has stopped at once, and has had the same value since then: it is stuck, or
    /// something stopped it.
    #[must_use]
    pub fn has_stopped(&self) -> bool {
        self.0.iter().any(|path| path.has_stopped)
    }

    /// Whether an axis has another value since the reading before the last one, to which no motion
    /// leads: what came before and what follows are not one smooth motion.
    #[must_use]
    pub fn has_stepped(&self) -> bool {
        self.0.iter().any(|path| path.has_stepped)
    }

    /// Takes a reading at `t`, NaN where it has none; returns whether it is doubtful.
    pub fn judge(&mut self, t: Nanos, values: &[f64; N], quality: Quality) -> bool {
        // An encoder that does not know its zero yet will jump.
        let has_no_zero =
            |path: &AxisPath| quality.contains(Quality::NOT_CALIBRATED) && path.fastest.is_finite();
        for path in &mut self.0 {
            if quality.contains(Quality::ZERO_CHANGED) || has_no_zero(path) {
                path.count = 0;
            }
        }
        let all = self.0.iter_mut().zip(values);
        all.fold(false, |any, (path, value)| path.take(t, *value) || any)
    }
}
