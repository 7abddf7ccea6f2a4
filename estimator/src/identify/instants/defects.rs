//! What is wrong with a log: each defect found, told in a sentence, and as far as possible taken out.
//!
//! Two looks at a log. [`inspect`] looks at channels one by one while they are as recorded: stamps, repeated readings, silence, flat extremes, units, motion.
//! [`inspect_readings`] looks at what an F/T sensor reads beyond what the model says at the same instant (CAD parameters, no contact but the base), which is why it can
//! tell a blow or a slipping cable from motion:
//!
//! - outliers: further from the running median over +-0.12 s than 8 times the usual distance (1.4826 x median, along the log and around the place),
//!   and than 1.5 times what the model's own prediction is, or bends, within +-0.24 s;
//! - jumps: lines fitted on 0.2 s before and after a place, 0.1 s apart, miss one another by more than 6 times that scatter, by more than 6 times what they usually do, and
//!   by more than 1.5 times what the model's own prediction does (a model that is wrong, however much, must not look like a jump);
//! - slides: the same with lines on 0.5 s, 0.6 s apart.

use super::smooth::{median, quantum};
use super::{Instants, JointTrack, Recording, Stream};
use crate::dynamics::{InverseDynamics, JointState, Kinematics, Structure};
use crate::identify::{AXES, Severity, parallel};
use crate::setup::{Setup, Use};
use crate::spatial::Wrench;
use proprio_topics::{Nanos, Reading, Reason};
use std::fmt;
use std::ops::Range;

/// What units a channel seems to have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Units {
    /// Positions in degrees.
    Degrees,
    /// Forces or torques far beyond the robot's weight: counts of a converter, or thousandths.
    Counts,
    /// Proper acceleration not near that of gravity.
    NotMetresPerSecondSquared,
}

/// Where the offset of an F/T sensor became another one at once, by what its readings look like.
#[derive(Debug, Clone, PartialEq)]
pub struct Break {
    /// The sensor.
    pub sensor: usize,
    /// When.
    pub t: Nanos,
    /// How it shows: a [`Defect::Jump`].
    pub jump: Defect,
}

/// Something wrong with a log. [`fmt::Display`] says what, where, how much, and what to do.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Defect {
    /// Rows that could not be read.
    SkippedRows {
        /// How many.
        rows: u64,
        /// The line of the first.
        line: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// A sensor that the configuration names and the log lacks.
    NeverSeen {
        /// Its channel.
        channel: String,
    },
    /// Rows that repeat the row before.
    RepeatedRows {
        /// How many.
        rows: usize,
        /// The first.
        first: Nanos,
    },
    /// Readings that repeat the one before to the last digit.
    Repeated {
        /// The channel.
        channel: String,
        /// How many.
        samples: usize,
        /// Of how many.
        of: usize,
    },
    /// Stamps that are not later than the one before.
    Stamps {
        /// The channel.
        channel: String,
        /// Samples left out because another has the same stamp.
        repeated: usize,
        /// Samples left out because their stamps go backward.
        backward: usize,
        /// The first of them.
        first: Nanos,
    },
    /// Times without samples.
    Gaps {
        /// The channel.
        channel: String,
        /// How many.
        gaps: usize,
        /// All of them together.
        total: Nanos,
        /// The longest.
        longest: Nanos,
        /// Where that begins.
        at: Nanos,
    },
    /// A channel that repeats its reading while the robot moves.
    Frozen {
        /// The channel.
        channel: String,
        /// From when.
        from: Nanos,
        /// Until when.
        to: Nanos,
    },
    /// A joint whose position is the same throughout.
    Still {
        /// The channel.
        channel: String,
    },
    /// A quantity that lies flat at its extreme while others change.
    Saturated {
        /// The channel.
        channel: String,
        /// Which of its quantities; empty where the device says so itself.
        axis: &'static str,
        /// Samples.
        samples: usize,
        /// The first of them.
        first: Nanos,
        /// At what value; NaN where the device says so itself.
        value: f64,
    },
    /// A channel in other units than SI.
    WrongUnits {
        /// The channels.
        channels: Vec<String>,
        /// What it looks like.
        units: Units,
        /// The magnitude that shows it, in the unit it should have.
        magnitude: f64,
    },
    /// A given derivative that does not fit what it is the derivative of.
    Derivative {
        /// The joint.
        joint: String,
        /// `velocity` or `acceleration`.
        given: &'static str,
        /// How many times the given one the derivative is.
        factor: f64,
    },
    /// Nothing moves.
    NoMotion {
        /// The most that any joint moves \[rad or m\].
        most: f64,
    },
    /// Too little to identify anything from.
    TooShort {
        /// How much there is \[s\]; of a log without stamps 0.
        seconds: f64,
        /// Rows.
        rows: u64,
    },
    /// A reading that changes at once and stays, though the motion does not explain it.
    Jump {
        /// The channel.
        channel: String,
        /// Which of its quantities changes the most.
        axis: &'static str,
        /// When.
        t: Nanos,
        /// By how much \[N or Nm\].
        size: f64,
    },
    /// Samples far off their neighbours.
    Outliers {
        /// The channel.
        channel: String,
        /// Which of its quantities.
        axis: &'static str,
        /// How many.
        samples: usize,
        /// How far off the worst is, in its unit.
        largest: f64,
        /// When that is.
        t: Nanos,
    },
    /// An F/T sensor whose readings fit the model only with their sign turned.
    WrongSign {
        /// The channel.
        sensor: String,
    },
    /// An F/T sensor whose readings fit the model only in another frame.
    WrongFrame {
        /// The channel.
        sensor: String,
        /// What the configuration should say.
        instead: String,
    },
}

impl Defect {
    /// How much it matters.
    #[must_use]
    pub fn severity(&self) -> Severity {
        match self {
            Self::Still { .. } => Severity::Note,
            Self::NoMotion { .. } | Self::TooShort { .. } | Self::WrongUnits { .. } => Severity::Refusal,
            _ => Severity::Warning,
        }
    }
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SkippedRows { rows, line, reason } => write!(
                f,
                "{rows} rows can not be read and were skipped; the first: line {line}: {reason}"
            ),
            Self::NeverSeen { channel } => write!(
                f,
                "{channel} is in the configuration but has no sample in the log: what rests on it is left out; record it, or take it out of the configuration"
            ),
            Self::RepeatedRows { rows, first } => write!(
                f,
                "{rows} rows repeat the row before, the first at {first} s: they were left out; the recorder wrote what it had instead of waiting for new samples"
            ),
            Self::Repeated { channel, samples, of } => write!(
                f,
                "{channel} repeats its last reading in {samples} of {of} samples: these were left out; it measures more slowly than it is recorded"
            ),
            Self::Stamps {
                channel,
                repeated,
                backward,
                first,
            } => write!(
                f,
                "{channel}: {repeated} stamps occur twice and {backward} go backward, the first at {first} s: these samples were left out; check the recorder's clock"
            ),
            Self::Gaps {
                channel,
                gaps,
                total,
                longest,
                at,
            } => write!(
                f,
                "{channel} has no samples for {:.3} s in {gaps} gaps, the longest of {:.3} s from {at} s on: nothing is identified there",
                total.seconds(),
                longest.seconds()
            ),
            Self::Frozen { channel, from, to } => write!(
                f,
                "{channel} does not change from {from} s to {to} s while the robot moves: that is no measurement; check its cable and its board"
            ),
            Self::Still { channel } => write!(
                f,
                "{channel} never changes: the joint stands still, or its encoder is dead; what only its motion would show stays as in the URDF"
            ),
            Self::Saturated {
                channel,
                samples,
                first,
                value,
                ..
            } if value.is_nan() => write!(
                f,
                "{channel} says that it is saturated in {samples} samples, the first at {first} s: these are no measurement; move more gently or use a larger range"
            ),
            Self::Saturated {
                channel,
                axis,
                samples,
                first,
                value,
            } => write!(
                f,
                "{channel}: {axis} lies flat at {value} in {samples} samples, the first at {first} s: it is saturated there, which is no measurement; move more gently or use a larger range"
            ),
            Self::WrongUnits {
                channels,
                units,
                magnitude,
            } => {
                let names = channels.join(", ");
                match units {
                    Units::Degrees => write!(
                        f,
                        "{names}: positions up to {magnitude:.4} are far beyond the URDF's limits, which they would keep as degrees: convert all joints to radians"
                    ),
                    Units::Counts => write!(
                        f,
                        "{names}: a typical magnitude of {magnitude:.4} is more than 100 times what the robot weighs: it is in counts or thousandths; convert it to N and Nm"
                    ),
                    Units::NotMetresPerSecondSquared => write!(
                        f,
                        "{names}: a typical proper acceleration of {magnitude:.4} is not near 9.8: convert it to m/s^2"
                    ),
                }
            }
            Self::Derivative { joint, given, factor } => write!(
                f,
                "joint/{joint}: what the log gives as {given} must be multiplied by {factor:.4} to be the derivative that it should be: check its unit and sign, or leave the column out"
            ),
            Self::NoMotion { most } => write!(
                f,
                "no joint moves by more than {most:.4} rad: a robot that stands still tells weights and offsets only as a sum; record motion"
            ),
            Self::TooShort { seconds, rows } if *seconds > 0.0 => {
                write!(
                    f,
                    "it lasts {seconds:.2} s ({rows} rows): too short; record at least {LEAST_SECONDS} s of motion, better 30 s"
                )
            }
            Self::TooShort { rows, .. } => write!(f, "it has {rows} rows: too few; record at least {LEAST_ROWS}"),
            Self::Jump { channel, axis, t, size } => write!(
                f,
                "{channel}: {axis} changes by {size:.4} at {t} s and stays there, which no motion explains (a cable, stress inside, a touch that nobody declared): its offset is determined anew from there on"
            ),
            Self::Outliers {
                channel,
                axis,
                samples,
                largest,
                t,
            } => write!(
                f,
                "{channel}: {samples} samples of {axis} lie far off their neighbours, the worst by {largest:.4} at {t} s: they are left out"
            ),
            Self::WrongSign { sensor } => write!(
                f,
                "wrench/{sensor} fits only with its sign turned (masses come out negative): check `direction` and `frame` in the configuration and, if an IMU tells gravity, that it is not upside down"
            ),
            Self::WrongFrame { sensor, instead } => write!(
                f,
                "wrench/{sensor} does not fit the links beyond it in the frame that the configuration says, but would with {instead}: check how it is mounted, and `frame` and `direction` in its [[force_torque]]"
            ),
        }
    }
}

/// Least duration of a log \[s\], and least number of rows of one without stamps.
const LEAST_SECONDS: f64 = 2.0;
const LEAST_ROWS: u64 = 20;
/// A sensor that repeats itself for longer is frozen, or the robot is as quiet as the sensor.
const FREEZE: Nanos = Nanos::from_millis(200);
/// Motion that counts as such, beside a few steps of the encoder \[rad or m\].
const MOTION: f64 = 0.01;

fn label(channel: &crate::setup::Channel) -> String {
    format!("{}/{}", channel.kind.word(), channel.name)
}

/// Finds readings that repeat the one before, as they are read.
#[derive(Clone)]
pub(super) struct Repeats {
    channels: Vec<Repeat>,
}

#[derive(Clone, Default)]
struct Repeat {
    first: Option<Look>,
    last: Option<Look>,
    readings: usize,
    /// The same again with a later stamp, of channels whose noise would not allow it.
    again: Vec<Nanos>,
    /// The same again with the same stamp.
    twice: Vec<Nanos>,
}

/// What a reading looks like.
#[derive(Clone, Copy)]
struct Look {
    t: Nanos,
    bits: [u64; 9],
    /// Whether the noise of what it reads would not allow the same again.
    telling: bool,
}

impl Repeat {
    /// Looks at a reading beside the last one.
    fn compare(&mut self, look: Look) {
        if let Some(last) = self.last
            && last.bits == look.bits
        {
            if last.t == look.t {
                self.twice.push(look.t);
            } else if look.telling {
                self.again.push(look.t);
            }
        }
    }
}

impl Repeats {
    pub(super) fn new(channels: usize) -> Self {
        Self {
            channels: vec![Repeat::default(); channels],
        }
    }

    pub(super) fn see(&mut self, channel: usize, t: Nanos, reading: &Reading) {
        let Some(repeat) = self.channels.get_mut(channel) else {
            return;
        };
        let mut numbers = [0.0; 9];
        // A position alone may well stay the same: encoders are coarse.
        let telling = match reading {
            Reading::Joint(j) => {
                numbers[..4].copy_from_slice(&[j.position, j.velocity, j.acceleration, j.torque]);
                !j.velocity.is_nan() || !j.torque.is_nan()
            }
            Reading::Wrench(w) => {
                numbers[..3].copy_from_slice(&w.force);
                numbers[3..6].copy_from_slice(&w.torque);
                true
            }
            Reading::Imu(i) => {
                numbers[..3].copy_from_slice(&i.proper_acceleration);
                numbers[3..6].copy_from_slice(&i.angular_velocity);
                numbers[6..].copy_from_slice(&i.angular_acceleration);
                true
            }
            _ => return,
        };
        let look = Look {
            t,
            bits: numbers.map(f64::to_bits),
            telling,
        };
        repeat.readings += 1;
        repeat.compare(look);
        repeat.first.get_or_insert(look);
        repeat.last = Some(look);
    }

    /// Adds what was seen after this.
    pub(super) fn append(&mut self, next: Self) {
        for (own, mut next) in self.channels.iter_mut().zip(next.channels) {
            if let Some(first) = next.first {
                own.compare(first);
            }
            own.readings += next.readings;
            own.again.append(&mut next.again);
            own.twice.append(&mut next.twice);
            own.first = own.first.or(next.first);
            own.last = next.last.or(own.last);
        }
    }
}

/// What was left out of a stream to make its stamps increase.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Disorder {
    repeated: usize,
    backward: usize,
    first: Option<Nanos>,
}

impl<const D: usize> Stream<D> {
    /// Leaves out as few samples as possible so that every stamp is later than the one before: keeps a longest increasing subsequence.
    fn order(&mut self) -> Disorder {
        let mut disorder = Disorder::default();
        if self.t.windows(2).all(|w| w[0] < w[1]) {
            return disorder;
        }
        // Per length, the sample that ends the subsequence with the earliest stamp; per sample, the one before it.
        let (mut ends, mut before): (Vec<usize>, Vec<Option<usize>>) = (Vec::new(), Vec::new());
        for (i, t) in self.t.iter().enumerate() {
            let place = ends.partition_point(|&e| self.t[e] < *t);
            before.push(place.checked_sub(1).map(|p| ends[p]));
            match ends.get_mut(place) {
                // The first of equal ones stays.
                Some(end) if self.t[*end] > *t => *end = i,
                Some(_) => {}
                None => ends.push(i),
            }
        }
        let mut keep = vec![false; self.t.len()];
        let mut at = ends.last().copied();
        while let Some(i) = at {
            keep[i] = true;
            at = before[i];
        }
        let mut kept: Vec<Nanos> = self
            .t
            .iter()
            .zip(&keep)
            .filter(|(_, keep)| **keep)
            .map(|(t, _)| *t)
            .collect();
        kept.sort_unstable();
        for (t, _) in self.t.iter().zip(&keep).filter(|(_, keep)| !**keep) {
            disorder.first.get_or_insert(*t);
            if kept.binary_search(t).is_ok() {
                disorder.repeated += 1;
            } else {
                disorder.backward += 1;
            }
        }
        self.retain(|i| keep[i]);
        disorder
    }

    /// Leaves out the samples with these (sorted) stamps.
    fn leave_out(&mut self, stamps: &[Nanos]) {
        if !stamps.is_empty() {
            let drop: Vec<bool> = self.t.iter().map(|t| stamps.binary_search(t).is_ok()).collect();
            self.retain(|i| !drop[i]);
        }
    }

    /// Leaves out what is far from three neighbours on each side, of one axis, and tells how many, the worst, and when. Nothing within `least` is far.
    fn despike(&mut self, axis: usize, least: f64) -> Option<(usize, f64, Nanos)> {
        let values = self.column(axis);
        let mut neighbours = [0.0; 6];
        // How far off, and how far the neighbours lie apart but for the two outermost, which may be another spike.
        let together = Nanos(self.spacing.0.saturating_mul(6)).saturating_add(self.max_gap);
        let off: Vec<(f64, f64)> = (0..values.len())
            .map(|i| {
                if i < 3 || i + 3 >= values.len() || self.t[i + 3] - self.t[i - 3] > together {
                    return (0.0, f64::INFINITY);
                }
                neighbours.copy_from_slice(&[
                    values[i - 3],
                    values[i - 2],
                    values[i - 1],
                    values[i + 1],
                    values[i + 2],
                    values[i + 3],
                ]);
                neighbours.sort_by(f64::total_cmp);
                let middle = 0.5 * (neighbours[2] + neighbours[3]);
                (values[i] - middle, neighbours[4] - neighbours[1])
            })
            .collect();
        let usual = 1.4826
            * median(
                off.iter()
                    .filter(|(_, spread)| spread.is_finite())
                    .map(|(d, _)| d.abs())
                    .collect(),
            );
        let floor = 8.0 * usual + 3.0 * quantum(&values);
        let far = |(d, spread): (f64, f64)| d.abs() > floor + spread && d.abs() > least;
        let count = off.iter().filter(|o| far(**o)).count();
        let worst = (0..off.len())
            .filter(|i| far(off[*i]))
            .max_by(|a, b| off[*a].0.abs().total_cmp(&off[*b].0.abs()))?;
        let found = (count, off[worst].0, self.t[worst]);
        self.retain(|i| !far(off[i]));
        Some(found)
    }
}

fn range(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    (high - low).max(0.0)
}

impl JointTrack {
    fn each(&mut self, mut f: impl FnMut(&mut Stream<1>)) {
        [
            &mut self.position,
            &mut self.velocity,
            &mut self.acceleration,
            &mut self.torque,
        ]
        .into_iter()
        .for_each(&mut f);
    }

    /// How far it moves from `from` to `to`.
    fn range(&self, from: Nanos, to: Nanos) -> f64 {
        let stream = &self.position;
        let (begin, end) = (
            stream.t.partition_point(|t| *t < from),
            stream.t.partition_point(|t| *t <= to),
        );
        range(stream.value[begin..end.max(begin)].iter().map(|[v]| *v))
    }
}

impl Recording {
    /// Applies `f` to every stream of a channel.
    fn streams(
        &mut self,
        role: Use,
        one: &mut dyn FnMut(&mut Stream<1>),
        three: &mut dyn FnMut(&mut Stream<3>),
        six: &mut dyn FnMut(&mut Stream<6>),
    ) {
        match role {
            Use::Joint(dof) => self.joints[dof].each(one),
            Use::Sensor(number) => six(&mut self.sensors[number]),
            Use::Base => [
                &mut self.imu.proper_acceleration,
                &mut self.imu.angular_velocity,
                &mut self.imu.angular_acceleration,
            ]
            .into_iter()
            .for_each(three),
        }
    }

    /// The stamps of a channel's main stream.
    fn stamps(&self, role: Use) -> (&[Nanos], Nanos, Nanos) {
        fn of<const D: usize>(s: &Stream<D>) -> (&[Nanos], Nanos, Nanos) {
            (&s.t, s.max_gap, s.spacing)
        }
        match role {
            Use::Joint(dof) => of(&self.joints[dof].position),
            Use::Sensor(number) => of(&self.sensors[number]),
            Use::Base => of(&self.imu.angular_velocity),
        }
    }

    /// Whether samples of a channel were left out in between because their device disowns them.
    fn is_disowned(&self, role: Use, from: Nanos, to: Nanos) -> bool {
        match role {
            Use::Joint(dof) => self.joints[dof].position.disowned(from, to).is_some(),
            Use::Sensor(number) => self.sensors[number].disowned(from, to).is_some(),
            Use::Base => self.imu.angular_velocity.disowned(from, to).is_some(),
        }
    }

    /// Whether a joint other than `but` moves, or the base turns.
    fn moves(&self, from: Nanos, to: Nanos, but: Option<usize>) -> bool {
        let joint = self
            .joints
            .iter()
            .enumerate()
            .any(|(dof, j)| Some(dof) != but && j.range(from, to) > MOTION);
        let gyro = &self.imu.angular_velocity;
        let (begin, end) = (
            gyro.t.partition_point(|t| *t < from),
            gyro.t.partition_point(|t| *t <= to),
        );
        joint
            || gyro.value[begin..end.max(begin)]
                .iter()
                .any(|w| w.iter().map(|x| x * x).sum::<f64>() > 0.01)
    }
}

/// Puts every stream in order: stamps, repeated readings, frozen stretches, spikes of encoders, joint torques and gyroscopes.
pub(super) fn settle(recording: &mut Recording, setup: &Setup, mut repeats: Repeats) {
    let channels = recording.channels.clone();
    let max_silence = setup.max_silence;
    let mut found = Vec::new();
    let mut disorders = Vec::new();
    for (channel, repeat) in channels.iter().zip(&repeats.channels) {
        let mut worst = Disorder::default();
        let mut note = |d: Disorder| {
            if d.repeated + d.backward > worst.repeated + worst.backward {
                worst = d;
            }
        };
        let note = std::cell::RefCell::new(&mut note);
        recording.streams(
            channel.role,
            &mut |s| (note.borrow_mut())(s.order()),
            &mut |s| (note.borrow_mut())(s.order()),
            &mut |s| (note.borrow_mut())(s.order()),
        );
        worst.repeated = worst.repeated.saturating_sub(repeat.twice.len());
        disorders.push((label(channel), worst));
        recording.streams(
            channel.role,
            &mut |s| s.measure(max_silence),
            &mut |s| s.measure(max_silence),
            &mut |s| s.measure(max_silence),
        );
    }
    for (names, disorder) in merged(disorders, |a, b| a == b) {
        if let (Some(first), true) = (disorder.first, disorder.repeated + disorder.backward > 0) {
            found.push(Defect::Stamps {
                channel: names,
                repeated: disorder.repeated,
                backward: disorder.backward,
                first,
            });
        }
    }
    repeated(recording, &channels, &mut repeats, &mut found);
    for channel in &channels {
        // Left out are samples, so what is a gap is found anew; the spacing stays that of the channel.
        if let Use::Joint(dof) = channel.role {
            let name = label(channel);
            if let Some((from, to)) = stopped(&recording.joints[dof].position) {
                found.push(Defect::Frozen {
                    channel: name.clone(),
                    from,
                    to,
                });
                recording.joints[dof].each(|s| s.retain_outside(from, to));
            }
            for (from, to) in dead(&recording.joints[dof]) {
                found.push(Defect::Frozen {
                    channel: format!("{name}/torque"),
                    from,
                    to,
                });
                // All of it, the first sample too: nobody knows when it was measured.
                let stamps = &recording.joints[dof].torque.t;
                let drop: Vec<bool> = stamps.iter().map(|t| (from..=to).contains(t)).collect();
                recording.joints[dof].torque.retain(|i| !drop[i]);
            }
            let track = &mut recording.joints[dof];
            // What a position may be off by as configured is no spike of it.
            let noise = setup.joint_settings.noise;
            for (axis, stream, least) in [
                ("position", &mut track.position, noise),
                ("torque", &mut track.torque, 1e-9),
            ] {
                if let Some((samples, largest, t)) = stream.despike(0, least) {
                    found.push(Defect::Outliers {
                        channel: name.clone(),
                        axis,
                        samples,
                        largest,
                        t,
                    });
                }
            }
        }
        if channel.role == Use::Base {
            for (axis, word) in ["gx", "gy", "gz"].into_iter().enumerate() {
                if let Some((samples, largest, t)) = recording.imu.angular_velocity.despike(axis, 1e-9) {
                    found.push(Defect::Outliers {
                        channel: label(channel),
                        axis: word,
                        samples,
                        largest,
                        t,
                    });
                }
            }
        }
    }
    recording.defects = found;
}

/// Entries that say the same of several channels, told once.
fn merged<T>(entries: Vec<(String, T)>, same: impl Fn(&T, &T) -> bool) -> Vec<(String, T)> {
    let count = entries.len();
    let mut groups: Vec<(Vec<String>, T)> = Vec::new();
    for (name, entry) in entries {
        match groups.iter_mut().find(|(_, other)| same(other, &entry)) {
            Some((names, _)) => names.push(name),
            None => groups.push((vec![name], entry)),
        }
    }
    let name = |names: Vec<String>| {
        if names.len() == count && count > 1 {
            "every channel".into()
        } else {
            names.join(", ")
        }
    };
    groups.into_iter().map(|(names, entry)| (name(names), entry)).collect()
}

/// Leaves out repeated readings, and tells what they are: repeated rows, a slow sensor, a frozen one.
fn repeated(
    recording: &mut Recording,
    channels: &[crate::setup::Channel],
    repeats: &mut Repeats,
    found: &mut Vec<Defect>,
) {
    for (channel, repeat) in channels.iter().zip(&mut repeats.channels) {
        repeat.again.sort_unstable();
        let (stamps, ..) = recording.stamps(channel.role);
        let (mut drop, mut held, all) = (Vec::new(), 0, stamps.len());
        // Runs of repeats: each follows the sample that it repeats.
        let mut i = 1;
        while i < stamps.len() {
            let begin = i;
            while i < stamps.len() && repeat.again.binary_search(&stamps[i]).is_ok() {
                i += 1;
            }
            if i > begin {
                let (from, to) = (stamps[begin - 1], stamps[i - 1]);
                let but = if let Use::Joint(dof) = channel.role {
                    Some(dof)
                } else {
                    None
                };
                let run = &stamps[begin..i];
                if to - from < FREEZE {
                    drop.extend_from_slice(run);
                    held += run.len();
                } else if recording.moves(from, to, but) {
                    drop.extend_from_slice(run);
                    found.push(Defect::Frozen {
                        channel: label(channel),
                        from,
                        to,
                    });
                }
            }
            i += 1;
        }
        repeat.again = drop;
        let again = repeat.again.clone();
        recording.streams(
            channel.role,
            &mut |s| s.leave_out(&again),
            &mut |s| s.leave_out(&again),
            &mut |s| s.leave_out(&again),
        );
        // Most of what was recorded is the last reading again: its own pace is that of the others.
        if held * 2 > all {
            let max_silence = recording.max_silence;
            recording.streams(
                channel.role,
                &mut |s| s.measure(max_silence),
                &mut |s| s.measure(max_silence),
                &mut |s| s.measure(max_silence),
            );
        }
    }
    let of_rows = |r: &Repeat| {
        let mut all: Vec<Nanos> = r.again.iter().chain(&r.twice).copied().collect();
        all.sort_unstable();
        all
    };
    let seen: Vec<&Repeat> = repeats.channels.iter().filter(|r| r.readings > 0).collect();
    let rows = seen.first().map(|r| of_rows(r)).unwrap_or_default();
    if let (Some(first), true) = (rows.first(), seen.len() > 1 && seen.iter().all(|r| of_rows(r) == rows)) {
        // As long as it is not the same frozen stretch of all channels that was told already.
        if !found.iter().any(|d| matches!(d, Defect::Frozen { .. })) {
            found.push(Defect::RepeatedRows {
                rows: rows.len(),
                first: *first,
            });
        }
        return;
    }
    let mut told = Vec::new();
    for (channel, repeat) in channels.iter().zip(&repeats.channels) {
        let frozen: usize = found
            .iter()
            .filter_map(|d| match d {
                Defect::Frozen {
                    channel: name,
                    from,
                    to,
                } if *name == label(channel) => Some((*from, *to)),
                _ => None,
            })
            .map(|(from, to)| repeat.again.iter().filter(|t| **t > from && **t <= to).count())
            .sum();
        let samples = repeat.again.len() - frozen;
        // Now and then six coarse numbers repeat themselves by chance.
        let often = samples >= 10 && samples * 50 >= repeat.readings;
        let samples = if often { samples } else { 0 } + repeat.twice.len();
        if samples > 0 {
            told.push((label(channel), (samples, repeat.readings)));
        }
    }
    let told = merged(told, |a, b| a == b).into_iter();
    found.extend(told.map(|(channel, (samples, of))| Defect::Repeated { channel, samples, of }));
}

impl<const D: usize> Stream<D> {
    /// Leaves out the samples after `from` up to `to`.
    fn retain_outside(&mut self, from: Nanos, to: Nanos) {
        let outside: Vec<bool> = self.t.iter().map(|t| *t <= from || *t > to).collect();
        self.retain(|i| outside[i]);
    }
}

/// Where an encoder stops from one sample to the next out of fast motion and stays for at least half a second: no joint can.
fn stopped(position: &Stream<1>) -> Option<(Nanos, Nanos)> {
    let (t, x) = (&position.t, position.column(0));
    let mut i = 1;
    while i < t.len() {
        let begin = i - 1;
        while i < t.len() && x[i].to_bits() == x[begin].to_bits() {
            i += 1;
        }
        let end = i - 1;
        if t[end] - t[begin] >= Nanos::from_millis(500) {
            let before = t
                .partition_point(|s| *s < t[begin] - Nanos::from_millis(50))
                .min(begin.saturating_sub(2));
            let span = (t[begin] - t[before]).seconds();
            let speed = if begin >= 3 && span < 0.2 {
                (x[begin] - x[before]).abs() / span
            } else {
                0.0
            };
            let brake = speed / position.spacing.seconds();
            if speed > 0.5 && brake > 50.0 {
                return Some((t[begin], t[end]));
            }
        }
        i += 1;
    }
    None
}

/// Steps by which a quantity falls within half as many samples as it lay flat if it did not turn round there: a parabola that is within one step for `n` samples is four steps or less away `n / 2` samples
/// before and after.
const STEEP: f64 = 10.0;

/// Whether a quantity that is counted in these steps comes to a flat stretch, and leaves it, more steeply than what turns round there ([`STEEP`]). Where a log begins or ends, nobody knows: it may.
fn steep(values: &[f64], flat: &Range<usize>, step: f64) -> [bool; 2] {
    let reach = flat.len().div_ceil(2);
    let falls = |j: usize| {
        values
            .get(j)
            .is_none_or(|v| (v - values[flat.start]).abs() > STEEP * step)
    };
    [
        flat.start.checked_sub(reach).is_none_or(falls),
        falls(flat.end - 1 + reach),
    ]
}

/// Where a joint's torque repeats itself for longer than chance, coarse steps, turning round or a standstill make it do, while the joint moves.
fn dead(track: &JointTrack) -> Vec<(Nanos, Nanos)> {
    /// How likely a stretch that is called dead may be in a torque whose repeats are chance.
    const CHANCE: f64 = 1e-9;
    let (t, x) = (&track.torque.t, track.torque.column(0));
    // Stretches of equal samples, from the first to the last.
    let mut stretches: Vec<(usize, usize)> = Vec::new();
    for i in 0..x.len() {
        match stretches.last_mut() {
            Some((begin, end)) if x[*begin].to_bits() == x[i].to_bits() => *end = i,
            _ => stretches.push((i, i)),
        }
    }
    let is_long = |(begin, end): &(usize, usize)| t[*end] - t[*begin] >= FREEZE;
    let steps = |some: &mut dyn Iterator<Item = &(usize, usize)>| some.map(|(begin, end)| end - begin).sum::<usize>();
    // Of two samples after each other that are not in a long stretch, how often they are equal.
    let (all, long) = (
        x.len().saturating_sub(1),
        steps(&mut stretches.iter().filter(|s| is_long(s))),
    );
    let equal = steps(&mut stretches.iter()) - long;
    let often = (equal as f64 + 1.0) / ((all - long) as f64 + 2.0);
    let step = quantum(&x);
    let dead = |stretch: &&(usize, usize)| {
        let (begin, end) = **stretch;
        is_long(stretch)
            && often.powf((end - begin) as f64) < CHANCE
            && steep(&x, &(begin..end + 1), step).contains(&true)
            && track.range(t[begin], t[end]) > MOTION
    };
    // One value from beginning to end leaves nothing to compare with.
    let all_equal = stretches.len() == 1 && stretches.iter().any(is_long);
    stretches
        .iter()
        .filter(|stretch| dead(stretch) || all_equal && track.range(t[stretch.0], t[stretch.1]) > MOTION)
        .map(|(begin, end)| (t[*begin], t[*end]))
        .collect()
}

/// Looks at the channels one by one.
pub(super) fn inspect(recording: &mut Recording, setup: &Setup) {
    let mut found = std::mem::take(&mut recording.defects);
    if let Some(first) = recording.report.bad.first() {
        let (rows, line, reason) = (recording.report.bad_rows, first.line, first.reason.clone());
        found.insert(0, Defect::SkippedRows { rows, line, reason });
    }
    let channels = recording.channels.clone();
    gaps(recording, &channels, &mut found);
    for channel in &channels {
        match channel.role {
            Use::Joint(dof) => {
                let (track, joint) = (&recording.joints[dof], &channel.name);
                if recording.stamped && range(track.position.value.iter().map(|[v]| *v)) == 0.0 {
                    found.push(Defect::Still {
                        channel: label(channel),
                    });
                }
                for (given, of, stream) in [
                    ("velocity", &track.position, &track.velocity),
                    ("acceleration", &track.velocity, &track.acceleration),
                ] {
                    if let Some(factor) = factor(of, stream, given == "velocity") {
                        found.push(Defect::Derivative {
                            joint: joint.clone(),
                            given,
                            factor,
                        });
                    }
                }
                let cut = cut_off(&track.torque, 0, |from, to| recording.moves(from, to, None));
                let torque = &mut recording.joints[dof].torque;
                found.extend(cut.and_then(|cut| saturated(torque, cut, label(channel), "torque")));
            }
            Use::Sensor(number) => {
                let stream = &recording.sensors[number];
                if stream.t.is_empty() && stream.disowned.is_empty() {
                    found.push(Defect::NeverSeen {
                        channel: label(channel),
                    });
                    continue;
                }
                let disowned: Vec<Nanos> = stream
                    .disowned
                    .iter()
                    .filter(|(_, r)| *r == Reason::Saturated)
                    .map(|(t, _)| *t)
                    .collect();
                if let Some(first) = disowned.first() {
                    found.push(Defect::Saturated {
                        channel: label(channel),
                        axis: "",
                        samples: disowned.len(),
                        first: *first,
                        value: f64::NAN,
                    });
                }
                for (axis, word) in AXES.into_iter().enumerate() {
                    let cut = cut_off(&recording.sensors[number], axis, |from, to| {
                        recording.moves(from, to, None)
                    });
                    let stream = &mut recording.sensors[number];
                    found.extend(cut.and_then(|cut| saturated(stream, cut, label(channel), word)));
                }
            }
            Use::Base => {}
        }
    }
    units(recording, setup, &mut found);
    motion(recording, &mut found);
    recording.defects = found;
}

fn gaps(recording: &Recording, channels: &[crate::setup::Channel], found: &mut Vec<Defect>) {
    if !recording.stamped {
        return;
    }
    let of_channel = |channel: &crate::setup::Channel| {
        let (stamps, max_gap, spacing) = recording.stamps(channel.role);
        let mut gaps = Vec::new();
        // A log of single postures is no log with gaps.
        if spacing <= max_gap
            && let (Some(first), Some(last)) = (stamps.first(), stamps.last())
        {
            let late = max_gap.max(recording.max_silence);
            gaps.extend((*first - recording.first > late).then_some((recording.first, *first)));
            gaps.extend(
                stamps
                    .windows(2)
                    .filter(|w| w[1] - w[0] > max_gap)
                    .map(|w| (w[0], w[1])),
            );
            gaps.extend((recording.last - *last > late).then_some((*last, recording.last)));
        }
        // What was left out for a reason of its own is told with that.
        let told = |(from, to): &(Nanos, Nanos)| {
            let frozen = found.iter().any(|d| match d {
                Defect::Frozen {
                    channel: name,
                    from: f,
                    to: t,
                } => *name == label(channel) && from <= t && to >= f,
                _ => false,
            });
            frozen || recording.is_disowned(channel.role, *from, *to)
        };
        gaps.retain(|gap| !told(gap));
        (label(channel), gaps)
    };
    // Channels that have rows of their own do not end and begin again at the very same stamps.
    let near = |a: Nanos, b: Nanos| (a - b).0.abs() <= 30_000_000;
    let same = |a: &Vec<(Nanos, Nanos)>, b: &Vec<(Nanos, Nanos)>| {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| near(a.0, b.0) && near(a.1, b.1))
    };
    let seen = channels.iter().filter(|c| !recording.stamps(c.role).0.is_empty());
    let all = merged(seen.map(of_channel).collect(), same);
    for (channel, gaps) in all {
        if let Some(longest) = gaps.iter().max_by_key(|(from, to)| *to - *from) {
            found.push(Defect::Gaps {
                channel,
                gaps: gaps.len(),
                total: Nanos(gaps.iter().map(|(from, to)| (*to - *from).0).sum()),
                longest: longest.1 - longest.0,
                at: longest.0,
            });
        }
    }
}

/// Where one quantity is cut off: at which value, and which samples, stretches of five and more that lie at the quantity's extreme while the sensor's others change (or, of a single
/// one, comes back to it).
///
/// What turns round slowly lies flat as well. At least one stretch must be steeper than that on both sides ([`steep`]); what might be hidden otherwise is two or three steps, and harms nothing.
/// `moves`: whether the robot moves from the one stamp to the other.
fn cut_off<const D: usize>(
    stream: &Stream<D>,
    axis: usize,
    moves: impl Fn(Nanos, Nanos) -> bool,
) -> Option<(f64, Vec<usize>)> {
    /// Samples that lie flat at least.
    const FLAT: usize = 5;
    let values = stream.column(axis);
    let step = quantum(&values);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    if values.len() < 20 || high - low <= 50.0 * step {
        return None;
    }
    // A torque that is measured more slowly than it is recorded repeats itself everywhere.
    let mut runs: Vec<Range<usize>> = Vec::new();
    for i in 0..values.len() {
        match runs.last_mut() {
            Some(run) if values[run.start].to_bits() == values[i].to_bits() => run.end = i + 1,
            _ => runs.push(i..i + 1),
        }
    }
    let usual = median(runs.iter().map(|run| run.len() as f64).collect());
    let is_long = |run: &&Range<usize>| run.len() >= FLAT && run.len() as f64 >= FLAT as f64 * usual;
    let others_change = |run: &&Range<usize>| {
        let changes =
            |j: &usize| (0..D).any(|k| k != axis && stream.value[*j][k].to_bits() != stream.value[*j - 1][k].to_bits());
        D == 1 || (run.start + 1..run.end).filter(changes).count() * 2 > run.len() - 1
    };
    // A robot at rest lies still at an extreme too, and its other quantities but for noise, unless something leans on it.
    let rests = |run: &&Range<usize>| {
        let (from, to) = (stream.t[run.start], stream.t[run.end - 1]);
        let loaded = |k: usize| {
            let own = || stream.value[run.start..run.end].iter().map(|v| v[k]);
            let changes = own().zip(own().skip(1)).map(|(a, b)| (b - a).abs());
            let changes: Vec<f64> = changes.filter(|change| *change > 0.0).collect();
            let usual = changes.iter().sum::<f64>() / changes.len().max(1) as f64;
            k != axis && range(own()) > STEEP * usual
        };
        to - from >= FREEZE && !moves(from, to) && !(0..D).any(loaded)
    };
    let mut worst: Option<(f64, Vec<usize>)> = None;
    for extreme in [low, high] {
        let at_it = runs
            .iter()
            .filter(|run| values[run.start].to_bits() == extreme.to_bits());
        let flat: Vec<&Range<usize>> = at_it
            .filter(is_long)
            .filter(others_change)
            .filter(|run| !rests(run))
            .collect();
        // A single torque that is cut off comes back to it.
        let enough = if D == 1 { 2 } else { 1 };
        let samples: Vec<usize> = flat.iter().flat_map(|run| (*run).clone()).collect();
        let is_cut = flat.len() >= enough && flat.iter().any(|run| steep(&values, run, step) == [true; 2]);
        if is_cut && samples.len() > worst.as_ref().map_or(0, |(_, worst)| worst.len()) {
            worst = Some((extreme, samples));
        }
    }
    worst
}

/// Leaves these samples of one quantity out as saturated, and says so.
fn saturated<const D: usize>(
    stream: &mut Stream<D>,
    (value, samples): (f64, Vec<usize>),
    channel: String,
    axis: &'static str,
) -> Option<Defect> {
    let first = stream.t[*samples.first()?];
    stream
        .disowned
        .extend(samples.iter().map(|i| (stream.t[*i], Reason::Saturated)));
    stream.disowned.sort_by_key(|(t, _)| *t);
    stream.retain(|i| samples.binary_search(&i).is_err());
    Some(Defect::Saturated {
        channel,
        axis,
        samples: samples.len(),
        first,
        value,
    })
}

/// By what the given derivative must be multiplied to be that of `of`; none if it fits, or if there is too little motion to tell.
fn factor(of: &Stream<1>, given: &Stream<1>, position: bool) -> Option<f64> {
    if given.t.len() < 100 {
        return None;
    }
    let (mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0);
    let mut motion = (f64::INFINITY, f64::NEG_INFINITY);
    for i in (5..of.t.len().saturating_sub(5)).step_by(3) {
        let (a, b) = (of.t[i - 5], of.t[i + 5]);
        if b - a > Nanos(of.max_gap.0.saturating_mul(3)) || (b - a).0 > 200_000_000 {
            continue;
        }
        motion = (motion.0.min(of.value[i][0]), motion.1.max(of.value[i][0]));
        let (begin, end) = (
            given.t.partition_point(|t| *t < a),
            given.t.partition_point(|t| *t <= b),
        );
        if end <= begin {
            continue;
        }
        // Mean of the given one over the same time.
        let mean = given.value[begin..end].iter().map(|[v]| v).sum::<f64>() / (end - begin) as f64;
        let slope = (of.value[i + 5][0] - of.value[i - 5][0]) / (b - a).seconds();
        uu += mean * mean;
        uv += mean * slope;
        vv += slope * slope;
    }
    let enough = motion.1 - motion.0 > if position { 0.05 } else { 0.1 };
    let correlation = uv / (uu * vv).sqrt();
    let factor = uv / uu;
    (enough && correlation.abs() > 0.8 && !(0.8..=1.25).contains(&factor)).then_some(factor)
}

fn units(recording: &Recording, setup: &Setup, found: &mut Vec<Defect>) {
    let mut degrees = (Vec::new(), 0.0_f64);
    let weight = 9.80665 * setup.model.inertias().iter().map(|i| i.parameters()[0]).sum::<f64>();
    for channel in &recording.channels {
        match channel.role {
            Use::Joint(dof) => {
                let limits = setup.model.dof_joint(dof).and_then(|j| setup.model.limits(j));
                let most = |v: f64| {
                    recording.joints[dof]
                        .position
                        .value
                        .iter()
                        .map(|[q]| (q * v).abs())
                        .fold(0.0, f64::max)
                };
                if let Some(limits) = limits {
                    let reach = limits.lower.abs().max(limits.upper.abs());
                    if most(1.0) > 2.0 * reach && most(1.0) > 6.3 && most(1.0_f64.to_radians()) <= 1.1 * reach {
                        degrees.0.push(label(channel));
                        degrees.1 = degrees.1.max(most(1.0));
                    }
                }
            }
            Use::Sensor(number) => {
                let norm = |from: usize| {
                    // A configured gain may be what makes newtons of counts.
                    let corrected = |[fx, fy, fz, tx, ty, tz]: &[f64; 6]| {
                        let raw = Wrench::from_parts([*fx, *fy, *fz], [*tx, *ty, *tz]);
                        setup.calibrations[number].apply(&raw, f64::NAN).force_first()
                    };
                    let of = |v: &[f64; 6]| corrected(v)[from..from + 3].iter().map(|x| x * x).sum::<f64>().sqrt();
                    median(recording.sensors[number].value.iter().map(of).collect())
                };
                let (force, torque) = (norm(0), norm(3));
                let magnitude = if force > 100.0 * weight { force } else { torque };
                if magnitude > 100.0 * weight {
                    found.push(Defect::WrongUnits {
                        channels: vec![label(channel)],
                        units: Units::Counts,
                        magnitude,
                    });
                }
            }
            Use::Base => {
                let of = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
                let magnitude = median(recording.imu.proper_acceleration.value.iter().map(of).collect());
                if !(3.0..=30.0).contains(&magnitude) {
                    let units = Units::NotMetresPerSecondSquared;
                    found.push(Defect::WrongUnits {
                        channels: vec![label(channel)],
                        units,
                        magnitude,
                    });
                }
            }
        }
    }
    if !degrees.0.is_empty() {
        found.push(Defect::WrongUnits {
            channels: degrees.0,
            units: Units::Degrees,
            magnitude: degrees.1,
        });
    }
}

fn motion(recording: &Recording, found: &mut Vec<Defect>) {
    let rows = recording.report.rows;
    // The last row lasts as long as the others: 200 of them at 100 Hz are 2 s, from 0 to 1.99.
    let seconds = recording.duration().seconds() * (1.0 + 1.0 / rows.max(2).saturating_sub(1) as f64) + 1e-9;
    if (recording.stamped && seconds < LEAST_SECONDS) || (!recording.stamped && rows < LEAST_ROWS) {
        found.push(Defect::TooShort { seconds, rows });
        return;
    }
    let mut most: f64 = 0.0;
    for joint in &recording.joints {
        let moved = range(joint.position.value.iter().map(|[v]| *v));
        if moved > MOTION.max(4.0 * quantum(&joint.position.column(0))) {
            return;
        }
        most = most.max(moved);
    }
    let turned = (0..3).any(|axis| range(recording.imu.angular_velocity.value.iter().map(|w| w[axis])) > 0.1);
    if !turned {
        found.push(Defect::NoMotion { most });
    }
}

/// Half of the running median's window, of its surroundings, and the two tests for jumps: lines, and what lies between them \[s\].
const MEDIAN: f64 = 0.12;
const SURROUNDINGS: f64 = 2.0;
const SHARP: (f64, f64) = (0.2, 0.1);
const SLIDE: (f64, f64) = (0.5, 0.6);
/// An outlier is this many times further from the median than usual; its neighbours go with it down to half of that.
const OUTLIER: f64 = 8.0;
/// A jump is this many times larger than scatter, and than what the same test usually gives.
const JUMP: f64 = 6.0;
/// ... and than what the test gives on the model's prediction: 1 is what a prediction of motion that the sensor does not feel at all would give.
const MODEL: f64 = 1.5;
/// How far a centre of mass may be from the model's \[m\].
const LEVER: f64 = Structure::LENGTH_SCALE;

/// Looks at what the sensors read beyond what the model says: marks outliers, finds jumps.
pub(super) fn inspect_readings(recording: &Recording, setup: &Setup, instants: &mut Instants) {
    // Of a log in other units, or without motion, the model says nothing.
    if !recording.stamped || instants.defects.iter().any(|d| d.severity() == Severity::Refusal) {
        return;
    }
    let spacings: Vec<f64> = instants
        .instants
        .windows(2)
        .map(|w| (w[1].t - w[0].t).seconds())
        .collect();
    let period = median(spacings);
    // With less than 20 instants a second blows and motion look alike.
    if period <= 0.0 || period > 0.05 {
        return;
    }
    let predicted = predict(setup, instants);
    let mut outliers = Vec::new();
    for (sensor, cut) in setup.structure.sensors().iter().enumerate() {
        let Some(channel) = recording.channels.iter().find(|c| c.role == Use::Sensor(sensor)) else {
            continue;
        };
        let noise = cut.noise();
        let floors = [noise.force, noise.torque].concat();
        let mut jumps: Vec<(f64, Nanos, &'static str, f64)> = Vec::new();
        let free = free_of_contact(setup, instants, sensor, &predicted);
        let runs = runs(instants, &free, period);
        let expected = Expected::new(&runs, |i| predicted[i][sensor], period);
        let found = parallel::map(AXES.len(), |axis| {
            let series = |range: &Range<usize>| -> Vec<f64> {
                range
                    .clone()
                    .map(|i| instants.instants[i].readings[sensor].force_first()[axis] - predicted[i][sensor][axis])
                    .collect()
            };
            let runs = runs.iter().zip(&expected[axis / 3]);
            let runs: Vec<_> = runs
                .map(|(r, e)| Residual::new(r.clone(), series(r), e, period))
                .collect();
            let usual = median(runs.iter().flat_map(|r| r.off.iter().map(|d| d.abs())).collect()) * 1.4826;
            let (mut outliers, mut jumps) = (Vec::new(), Vec::new());
            for mut run in runs {
                let scatter: Vec<f64> = run
                    .around(&run.off, period)
                    .into_iter()
                    .map(|s| s.max(usual).max(floors[axis]))
                    .collect();
                for i in run.outliers(&scatter) {
                    outliers.push((run.range.start + i, run.off[i]));
                    // What is found out about is not asked again.
                    run.values[i] -= run.off[i];
                }
                for test in [SHARP, SLIDE] {
                    let found = run.jumps(test, &scatter, period).into_iter();
                    jumps.extend(found.map(|(at, size, excess)| (run.range.start + at, size, excess)));
                }
            }
            (outliers, jumps)
        });
        for (word, (of_axis, found)) in AXES.into_iter().zip(found) {
            let mut worst = (0.0_f64, Nanos::ZERO);
            for &(i, off) in &of_axis {
                if off.abs() > worst.0.abs() {
                    worst = (off, instants.instants[i].t);
                }
                outliers.push((i, sensor));
            }
            if !of_axis.is_empty() {
                instants.defects.push(Defect::Outliers {
                    channel: label(channel),
                    axis: word,
                    samples: of_axis.len(),
                    largest: worst.0,
                    t: worst.1,
                });
            }
            let found = found.into_iter();
            jumps.extend(found.map(|(i, size, excess)| (excess, instants.instants[i].t, word, size)));
        }
        // Of what several axes and both tests say within a second, the clearest.
        jumps.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut kept: Vec<(Nanos, &'static str, f64)> = Vec::new();
        for (_, t, axis, size) in jumps {
            if kept.iter().all(|(other, ..)| (t - *other).0.abs() > 1_000_000_000) {
                kept.push((t, axis, size));
            }
        }
        kept.sort_by_key(|(t, ..)| *t);
        for (t, axis, size) in kept {
            let jump = Defect::Jump {
                channel: label(channel),
                axis,
                t,
                size,
            };
            instants.breaks.push(Break { sensor, t, jump });
        }
    }
    for (instant, sensor) in outliers {
        instants.instants[instant].outliers.insert(sensor);
    }
    instants.breaks.sort_by_key(|b| (b.t, b.sensor));
}

/// What each sensor would read with the model's parameters and no contact but at the base; NaN where the motion is not known.
fn predict(setup: &Setup, instants: &Instants) -> Vec<Vec<[f64; 6]>> {
    let sensors = setup.structure.sensors();
    let nothing = vec![[f64::NAN; 6]; sensors.len()];
    parallel::in_pieces(instants.instants.len(), |range| {
        let Ok(mut kinematics) = Kinematics::new(&setup.model, setup.base_link) else {
            return vec![nothing.clone(); range.len()];
        };
        let mut dynamics = InverseDynamics::new(&setup.model);
        let of_instant = instants.instants[range].iter().map(|instant| {
            let state = JointState {
                position: &instant.position,
                velocity: &instant.velocity,
                acceleration: &instant.acceleration,
            };
            let based =
                instant.base_link == kinematics.base() || kinematics.set_base(&setup.model, instant.base_link).is_ok();
            let done = instant.has_motion(setup.channels())
                && based
                && kinematics.update(&setup.model, state, &instant.base).is_ok()
                && dynamics.update(&setup.model, &kinematics, &[]).is_ok();
            if !done {
                return nothing.clone();
            }
            let reading = |cut: &crate::dynamics::SensorCut| {
                cut.reading(&dynamics.transmitted(&kinematics, cut.joint()))
                    .force_first()
            };
            sensors.iter().map(reading).collect()
        });
        of_instant.collect()
    })
}

/// Per instant, whether the sensor's reading is there and nothing but the model's links pulls at it on the side away from the base.
fn free_of_contact(setup: &Setup, instants: &Instants, sensor: usize, predicted: &[Vec<[f64; 6]>]) -> Vec<bool> {
    let Some(cut) = setup.structure.sensors().get(sensor) else {
        return Vec::new();
    };
    let beyond = |mut link: usize| {
        while link != 0 && link != cut.joint() + 1 {
            link = setup.model.joints().get(link - 1).map_or(0, |j| j.parent);
        }
        link == cut.joint() + 1
    };
    let touching = |instant: &super::Instant| {
        let far = |c: &usize| {
            let link = setup.structure.contacts().get(*c).map(|spec| spec.frame.link);
            link.is_some_and(|link| beyond(link) != beyond(instant.base_link))
        };
        instant.active.iter().any(|c| far(&c))
    };
    let number = setup.channels().iter().position(|c| c.role == Use::Sensor(sensor));
    let mut free: Vec<bool> = instants
        .instants
        .iter()
        .zip(predicted)
        .map(|(i, p)| {
            let there = number.is_some_and(|n| i.faults.get(n) == Some(&Reason::None));
            there && p.get(sensor).is_some_and(|p| p[0].is_finite())
        })
        .collect();
    // A contact begins and ends a little before and after somebody says so.
    let near = Nanos::from_millis(300);
    let touched: Vec<Nanos> = instants.instants.iter().filter(|i| touching(i)).map(|i| i.t).collect();
    for (free, instant) in free.iter_mut().zip(&instants.instants) {
        let at = touched.partition_point(|t| *t < instant.t - near);
        *free &= touched.get(at).is_none_or(|t| *t > instant.t + near);
    }
    free
}

/// Stretches of instants, none missing.
fn runs(instants: &Instants, free: &[bool], period: f64) -> Vec<Range<usize>> {
    let mut runs = Vec::new();
    let mut begin = 0;
    for i in 0..=free.len() {
        let ends = i == free.len() || !free[i];
        let apart =
            !ends && i > begin && (instants.instants[i].t - instants.instants[i - 1].t).seconds() > 5.0 * period;
        if ends || apart {
            if i > begin {
                runs.push(begin..i);
            }
            begin = if ends { i + 1 } else { i };
        }
    }
    runs
}

fn samples(seconds: f64, period: f64) -> usize {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let count = (seconds / period).round() as usize;
    count.max(1)
}

/// How far to either side of an instant medians are taken, in instants.
fn median_reach(period: f64) -> usize {
    samples(MEDIAN, period).max(3)
}

/// Numbers less their running median, which takes as much on either side.
fn off_median(values: &[f64], half: usize) -> Vec<f64> {
    let (count, mut window) = (values.len(), Vec::new());
    (0..count)
        .map(|i| {
            let half = half.min(i).min(count - 1 - i);
            window.clear();
            window.extend_from_slice(&values[i - half..=i + half]);
            values[i] - *window.select_nth_unstable_by(half, f64::total_cmp).1
        })
        .collect()
}

/// How far off its running median a parabola is at its vertex that bends as much as numbers do here: with a summand of another sign what rises steadily has its peak here.
fn bend(values: &[f64], i: usize, half: usize) -> f64 {
    let half = half.min(i).min(values.len() - 1 - i);
    (values[i - half] - 2.0 * values[i] + values[i + half]).abs() / 8.0
}

/// What the model predicts over one stretch, as far as it matters to an axis.
struct Expected {
    values: Vec<[f64; 6]>,
    /// How far it is off its running median, or would be if it did not rise or fall steadily, at the most nearby.
    off: Vec<f64>,
}

impl Expected {
    /// For forces and for torques, of each stretch, given the prediction at an instant.
    fn new(runs: &[Range<usize>], predicted: impl Fn(usize) -> [f64; 6] + Sync, period: f64) -> [Vec<Self>; 2] {
        let half = median_reach(period);
        let off: Vec<Vec<Vec<f64>>> = parallel::map(AXES.len(), |k| {
            let of_run = |run: &Range<usize>| {
                let values: Vec<f64> = run.clone().map(|i| predicted(i)[k]).collect();
                let off = off_median(&values, half);
                (0..values.len())
                    .map(|i| off[i].abs().max(bend(&values, i, half)))
                    .collect()
            };
            runs.iter().map(of_run).collect()
        });
        // A centre of mass that is elsewhere makes torques of forces, not forces of torques.
        [[1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [LEVER, LEVER, LEVER, 1.0, 1.0, 1.0]].map(|shares| {
            let of_run = |(number, run): (usize, &Range<usize>)| {
                let share_of = |value: &dyn Fn(usize) -> f64| std::array::from_fn(|k| shares[k] * value(k));
                let norm = |i: usize| {
                    let off: [f64; 6] = share_of(&|k| off[k][number][i]);
                    off.iter().map(|off| off * off).sum::<f64>().sqrt()
                };
                // The most nearby: what a wrong model leaves over need not be in phase with what it predicts.
                let norms: Vec<f64> = (0..run.len()).map(norm).collect();
                let near = |i: usize| &norms[i.saturating_sub(2 * half)..(i + 2 * half + 1).min(norms.len())];
                let most = |i: usize| near(i).iter().copied().fold(0.0, f64::max);
                Self {
                    values: run.clone().map(|i| share_of(&|k| predicted(i)[k])).collect(),
                    off: (0..run.len()).map(most).collect(),
                }
            };
            runs.iter().enumerate().map(of_run).collect()
        })
    }
}

/// One axis of what a sensor reads beyond the model's prediction, over one stretch.
struct Residual<'a> {
    range: Range<usize>,
    values: Vec<f64>,
    /// Off the running median.
    off: Vec<f64>,
    expected: &'a Expected,
}

impl<'a> Residual<'a> {
    fn new(range: Range<usize>, values: Vec<f64>, expected: &'a Expected, period: f64) -> Self {
        let off = off_median(&values, median_reach(period));
        Self {
            range,
            values,
            off,
            expected,
        }
    }

    /// The usual magnitude of `values` around each place, as a standard deviation.
    fn around(&self, values: &[f64], period: f64) -> Vec<f64> {
        let (half, step) = (samples(SURROUNDINGS, period), samples(0.25, period));
        let at = |i: usize| {
            let window = &values[i.saturating_sub(half)..(i + half).min(values.len())];
            1.4826 * median(window.iter().map(|v| v.abs()).collect())
        };
        let knots: Vec<f64> = (0..values.len()).step_by(step).map(at).collect();
        (0..values.len()).map(|i| knots[i / step]).collect()
    }

    fn outliers(&self, scatter: &[f64]) -> Vec<usize> {
        let far = |i: usize, times: f64| self.off[i].abs() > (times * scatter[i]).max(MODEL * self.expected.off[i]);
        let mut marked = vec![false; self.off.len()];
        for i in (0..self.off.len()).filter(|i| far(*i, OUTLIER)) {
            marked[i] = true;
            let before = (0..i).rev().take_while(|j| far(*j, 0.5 * OUTLIER));
            let after = (i + 1..self.off.len()).take_while(|j| far(*j, 0.5 * OUTLIER));
            before.chain(after).for_each(|j| marked[j] = true);
        }
        (0..marked.len()).filter(|i| marked[*i]).collect()
    }

    /// Places where lines before and after miss one another: the first value after, by how much, and how many times more than needed.
    fn jumps(&self, (line, gap): (f64, f64), scatter: &[f64], period: f64) -> Vec<(usize, f64, f64)> {
        let (line, gap) = (samples(line, period).max(5), samples(0.5 * gap, period));
        let (reach, count) = (line + gap, self.values.len());
        if count <= 2 * reach {
            return Vec::new();
        }
        // The weights that a line fitted to samples gap + 1/2, gap + 3/2, ... away gives them at 0.
        let (n, middle) = (line as f64, gap as f64 + 0.5 * line as f64);
        let spread = n * (n * n - 1.0) / 12.0;
        let weights: Vec<f64> = (0..line)
            .map(|k| 1.0 / n - middle * (k as f64 - 0.5 * (n - 1.0)) / spread)
            .collect();
        let ends = |value: &dyn Fn(usize) -> f64, i: usize| {
            let line = |at: &dyn Fn(usize) -> usize| -> f64 {
                weights.iter().enumerate().map(|(k, w)| w * value(at(k))).sum()
            };
            [line(&|k| i - gap - 1 - k), line(&|k| i + gap + k)]
        };
        let miss = |value: &dyn Fn(usize) -> f64, i: usize| {
            let [before, after] = ends(value, i);
            after - before
        };
        let misses: Vec<f64> = (0..count)
            .map(|i| {
                if i < reach || i + reach > count {
                    0.0
                } else {
                    miss(&|j| self.values[j], i)
                }
            })
            .collect();
        let inside = &misses[reach..count - reach];
        let usual = 1.4826 * median(inside.iter().map(|m| m.abs()).collect());
        // What the test gives nearby, from lines that have no sample in common with those at the place itself.
        let surroundings = samples(SURROUNDINGS, period);
        let around = |i: usize| {
            let before =
                misses[(i.saturating_sub(reach + surroundings)).max(reach)..i.saturating_sub(reach).max(reach)].iter();
            let last = count - reach;
            let after = misses[(i + reach).min(last)..(i + reach + surroundings).min(last)].iter();
            1.4826 * median(before.chain(after).map(|m| m.abs()).collect())
        };
        let excess = |i: usize| {
            let size = misses[i].abs();
            let mut excess = (size / (JUMP * scatter[i])).min(size / (JUMP * usual.max(f64::MIN_POSITIVE)));
            if excess >= 1.0 {
                excess = excess.min(size / (JUMP * around(i).max(f64::MIN_POSITIVE)));
            }
            if excess >= 1.0 {
                let of_model: f64 = (0..6).map(|k| miss(&|j| self.expected.values[j][k], i).powi(2)).sum();
                excess = excess.min(size / (MODEL * of_model.sqrt()).max(f64::MIN_POSITIVE));
            }
            excess
        };
        let excesses: Vec<f64> = (0..count).map(excess).collect();
        // A blow, or one swing of the robot, goes back to where it was.
        let level = samples(SLIDE.0, period);
        let stays = |i: usize| {
            let after = median(self.values[i + gap..(i + gap + level).min(count)].to_vec());
            let before = median(self.values[(i - gap).saturating_sub(level)..i - gap].to_vec());
            (after - before) * misses[i].signum() > 0.5 * misses[i].abs()
        };
        // Anywhere between the lines gives the same miss. Where values are nearest to the level on their side:
        let moment = |i: usize| {
            let ends = ends(&|j| self.values[j], i);
            let off = |j: usize, side: usize| (self.values[j] - ends[side]).powi(2);
            let all = i - gap..i + gap;
            let cost = |at: usize| -> f64 { all.clone().map(|j| off(j, usize::from(j >= at))).sum() };
            let places = i - gap..=i + gap;
            places.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(i)
        };
        // The peak of each stretch above 1.
        let mut found = Vec::new();
        let mut i = 0;
        while i < count {
            if excesses[i] < 1.0 {
                i += 1;
                continue;
            }
            let begin = i;
            while i < count && excesses[i] >= 1.0 {
                i += 1;
            }
            let peak = (begin..i)
                .max_by(|a, b| misses[*a].abs().total_cmp(&misses[*b].abs()))
                .unwrap_or(begin);
            if stays(peak) {
                found.push((moment(peak), misses[peak], excesses[peak]));
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Where the prediction rises steadily, and is never off its median, what a wrong model leaves over may have its peak: that is no blow, and one beside it is.
    #[test]
    fn a_wrong_models_peak_is_no_outlier() {
        let period = 0.01;
        let run = 0..400;
        let time = |i: usize| period * i as f64;
        let expected = |steepness: f64| {
            let predicted = move |i: usize| [0.0, 0.0, 0.0, steepness * time(i).powi(2), 0.0, 0.0];
            let [_, torques] = Expected::new(std::slice::from_ref(&run), predicted, period);
            torques
        };
        let mut values: Vec<f64> = run.clone().map(|i| -(time(i) - 2.0).powi(2)).collect();
        values[100] += 0.1;
        let outliers = |steepness: f64| {
            let expected = expected(steepness);
            let residual = Residual::new(run.clone(), values.clone(), &expected[0], period);
            residual.outliers(&vec![3e-4; run.len()])
        };
        assert_eq!(outliers(4.0), [100]);
        assert!(outliers(0.0).contains(&200), "no prediction explains it");
    }
}
