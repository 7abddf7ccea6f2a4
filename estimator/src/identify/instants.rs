//! A recorded log, as instants: what every channel held at one common time, with velocities and accelerations; and what is wrong with the log, in words.
//!
//! [`Recording::read`] takes a log as it is into memory; [`Recording::instants`] brings its channels together. What the pipeline does sample by sample with
//! nothing but the past, is done here with the samples on both sides of an instant:
//!
//! - The instants are the stamps of the trigger channel; where that is faster than the rate asked for, the middles of equal blocks.
//! - Wrenches, torques, proper accelerations and whatever else is given: a channel faster than the rate is averaged over the block (the integral of the straight lines
//!   between its samples, so that stamps may jitter); another is used as it is where it is stamped with the instant, and lies on the cubic through four
//!   neighbours elsewhere (a straight line is off by an eighth of the period's square times the curvature: at 100 Hz, more than the noise of a sensor that carries a robot). A log whose rows hold everything is therefore used row by row.
//! - Positions, velocities and accelerations that are not given come from polynomials around the instant, whose window and
//!   degree are chosen along the log (`instants/smooth.rs`).
//! - What speaks against a channel at an instant is told beside it: silent for too long, saturated, at fault, too close to the log's end for a derivative.
//!   An F/T reading that lies far off what the model and its own neighbours say is marked as an outlier.
//!
//! Readings are corrected as configured ([`crate::calibration`]), but configured offsets are not taken off, since identification determines what a sensor reads with no load.

mod defects;
mod reading;
mod smooth;

pub use defects::{Break, Defect, Units};

use super::gate::UnitSet;
use super::{add_multiple, parallel};
use crate::dynamics::{ContactSet, FrameMotion, SensorSet};
use crate::pipeline::{UNTRUSTED_ENCODER, quality_reason};
use crate::setup::{BaseMotion, Channel, Setup, Use};
use crate::spatial::{Vec3, Wrench};
use proprio_topics::csv::{Reader, Report, What};
use proprio_topics::{Kind, Nanos, Quality, Reading, Reason};
use smooth::{Scratch, Smoother};
use std::io::Read;

/// Why a log can not be used at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The log can not be read.
    #[error(transparent)]
    Log(#[from] proprio_topics::csv::Error),
    /// Without these channels there are no kinematics.
    #[error("the log has no column for {}", .0.join(", "))]
    MissingChannels(Vec<String>),
    /// A channel has columns, but not a single sample.
    #[error("{0} has columns in the log, but not one usable sample in them")]
    NoSamples(String),
}

/// How a log becomes instants.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Instants per second at the most \[Hz\]. A log that is slower keeps its own stamps.
    pub rate: f64,
    /// How much of a signal is wanted on either side of an instant for its derivatives, unless the window is narrower \[ns\].
    pub edge: Nanos,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            rate: 100.0,
            edge: Nanos::from_millis(300),
        }
    }
}

/// One channel's samples of `D` numbers, strictly later one after the other.
#[derive(Debug, Clone, Default)]
struct Stream<const D: usize> {
    t: Vec<Nanos>,
    value: Vec<Values<D>>,
    /// Samples that their device or its quality bits disown: left out of the above.
    disowned: Vec<(Nanos, Reason)>,
    /// Samples further apart than this do not belong together.
    max_gap: Nanos,
    /// Median time between samples.
    spacing: Nanos,
}

type Values<const D: usize> = [f64; D];

#[derive(Debug, Clone, Default)]
struct JointTrack {
    position: Stream<1>,
    velocity: Stream<1>,
    acceleration: Stream<1>,
    torque: Stream<1>,
}

#[derive(Debug, Clone, Default)]
struct ImuTrack {
    proper_acceleration: Stream<3>,
    angular_velocity: Stream<3>,
    angular_acceleration: Stream<3>,
}

/// All channels of one log.
#[derive(Debug, Clone)]
pub struct Recording {
    /// What the pipeline would read, in its order.
    channels: Vec<Channel>,
    /// By degree of freedom; empty where it is locked.
    joints: Vec<JointTrack>,
    sensors: Vec<Stream<6>>,
    /// Per F/T sensor, of its board [degrees Celsius]: as they came, until they are put in order.
    temperatures: Vec<Vec<(Nanos, f64)>>,
    imu: ImuTrack,
    /// Per contact, from when on it is said to be present or not.
    declared: Vec<Vec<(Nanos, bool)>>,
    stamped: bool,
    max_silence: Nanos,
    first: Nanos,
    last: Nanos,
    report: Report,
    unused: Vec<String>,
    defects: Vec<Defect>,
}

/// What every channel held at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Instant {
    /// The instant, by the log's clock.
    pub t: Nanos,
    /// Per degree of freedom \[rad or m\]; of a channel at fault the nearest that is known, or 0.
    pub position: Vec<f64>,
    /// \[rad/s or m/s\]; 0 of a channel at fault.
    pub velocity: Vec<f64>,
    /// \[rad/s^2 or m/s^2\]; 0 of a channel at fault.
    pub acceleration: Vec<f64>,
    /// Measured joint torques \[Nm or N\], by the parent on the child along the axis; NaN where there is none.
    pub torque: Vec<f64>,
    /// The link where kinematics start.
    pub base_link: usize,
    /// Its motion.
    pub base: FrameMotion,
    /// Per F/T sensor what it reads, corrected as configured, offset included, in its measurement frame; NaN where there is nothing.
    pub readings: Vec<Wrench>,
    /// The contacts that are present, as declared.
    pub active: ContactSet,
    /// Per channel, in the order of [`Setup::channels`]: what speaks against it. (A missing torque does not.)
    pub faults: Vec<Reason>,
    /// What speaks against the motion of the base, where no channel tells it.
    pub base_fault: Reason,
    /// Per F/T sensor, how warm its board is \[degrees Celsius\], on the straight line between two samples, the first and the last one held; NaN where none was recorded.
    pub temperatures: Vec<f64>,
    /// Per F/T sensor what it would have read without noise, as [`Instant::readings`], by a fit that there was before; not finite where that says nothing. As read from a log: empty.
    pub fitted: Vec<Wrench>,
    /// F/T sensors whose reading no motion explains, and that is not the beginning of another level either: a blow, a glitch.
    pub outliers: SensorSet,
    /// Sub-trees, by number, and measured joint torques, by [`Instant::TORQUES`], that something undeclared was found to act on: a contact, another load. None before a fit.
    pub suspected: UnitSet,
    /// What sub-trees need for a motion that their encoders do not show, where that is known: the sub-tree's number in the structure, and the wrench by all that it is attached to, about its
    /// top link's origin and in that link's axes. As read from a log: nothing.
    pub shaking: Vec<(usize, Wrench)>,
}

/// A log's instants.
#[derive(Debug, Clone)]
pub struct Instants {
    /// In time.
    pub instants: Vec<Instant>,
    /// Where an F/T sensor's offset seems to have become another one at once, by its readings alone: from there on it is to be determined anew. (A fit may say otherwise.)
    pub breaks: Vec<Break>,
    /// What else is wrong with the log: what [`Recording::defects`] holds, and what only shows at the instants.
    pub defects: Vec<Defect>,
}

impl Recording {
    /// Reads a sample log (columns: [`proprio_topics::csv`]) and looks for what is wrong with it.
    ///
    /// Rows that can not be read are skipped, samples whose stamps go backward are left out, so that as few as possible are; [`Recording::defects`] says which.
    ///
    /// # Errors
    /// [`RecordingError`]: it is no log, or lacks a joint that is not locked, or the IMU of the base. A missing F/T sensor is a defect.
    pub fn read(setup: &Setup, log: impl Read) -> Result<Self, RecordingError> {
        reading::read(setup, log)
    }

    fn empty(setup: &Setup) -> Self {
        Self {
            channels: setup.channels().to_vec(),
            joints: vec![JointTrack::default(); setup.model.dof_count()],
            sensors: vec![Stream::default(); setup.structure.sensors().len()],
            temperatures: vec![Vec::new(); setup.structure.sensors().len()],
            imu: ImuTrack::default(),
            declared: vec![Vec::new(); setup.contacts.len()],
            stamped: true,
            max_silence: setup.max_silence,
            first: Nanos::MAX,
            last: Nanos::MIN,
            report: Report::default(),
            unused: Vec::new(),
            defects: Vec::new(),
        }
    }

    fn check_columns(&self, reader: &Reader<impl Read>) -> Result<(), RecordingError> {
        let there = |channel: &&Channel| {
            let same =
                |s: &proprio_topics::csv::Series| s.what == What::Channel(channel.kind) && s.name == channel.name;
            reader.series().iter().any(same)
        };
        let needed = self.channels.iter().filter(|c| c.kind != Kind::Wrench);
        let missing = needed.filter(|c| !there(c)).map(|c| {
            let hint = if c.kind == Kind::Joint {
                " (measure it, or lock it in [locked])"
            } else {
                ""
            };
            format!("{}/{}{hint}", c.kind.word(), c.name)
        });
        let missing: Vec<String> = missing.collect();
        if missing.is_empty() {
            Ok(())
        } else {
            Err(RecordingError::MissingChannels(missing))
        }
    }

    fn take(&mut self, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        let Some(role) = self.channels.get(channel).map(|c| c.role) else {
            return;
        };
        match (role, reading) {
            (Use::Joint(dof), Reading::Joint(j)) => {
                let Some(track) = self.joints.get_mut(dof) else { return };
                let fault = quality_reason(quality, UNTRUSTED_ENCODER);
                track.position.push(t, [j.position], fault);
                track.velocity.push(t, [j.velocity], fault);
                track.acceleration.push(t, [j.acceleration], fault);
                track
                    .torque
                    .push(t, [j.torque], quality_reason(quality, Quality::DEVICE_FAULT));
            }
            (Use::Sensor(number), Reading::Wrench(w)) => {
                let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
                if let Some(stream) = self.sensors.get_mut(number) {
                    stream.push(
                        t,
                        [fx, fy, fz, tx, ty, tz],
                        quality_reason(quality, Quality::DEVICE_FAULT),
                    );
                }
            }
            (Use::Sensor(number), Reading::Temperature(temperature)) => {
                let is_good = temperature.celsius.is_finite() && !quality.intersects(Quality::DEVICE_FAULT);
                if let Some(own) = self.temperatures.get_mut(number).filter(|_| is_good) {
                    own.push((t, temperature.celsius));
                }
            }
            (Use::Base, Reading::Imu(i)) => {
                let fault = quality_reason(quality, Quality::DEVICE_FAULT);
                self.imu.proper_acceleration.push(t, i.proper_acceleration, fault);
                self.imu.angular_velocity.push(t, i.angular_velocity, fault);
                self.imu.angular_acceleration.push(t, i.angular_acceleration, fault);
            }
            _ => {}
        }
    }

    /// From the first sample to the last.
    fn span(&mut self) {
        (self.first, self.last) = (Nanos::MAX, Nanos::MIN);
        let (mut first, mut last) = (Nanos::MAX, Nanos::MIN);
        self.each_stream(|t| {
            first = first.min(t.first().copied().unwrap_or(Nanos::MAX));
            last = last.max(t.last().copied().unwrap_or(Nanos::MIN));
        });
        (self.first, self.last) = (first, last);
    }

    fn each_stream(&self, mut f: impl FnMut(&[Nanos])) {
        for j in &self.joints {
            [&j.position, &j.velocity, &j.acceleration, &j.torque]
                .iter()
                .for_each(|s| f(&s.t));
        }
        self.sensors.iter().for_each(|s| f(&s.t));
        [
            &self.imu.proper_acceleration,
            &self.imu.angular_velocity,
            &self.imu.angular_acceleration,
        ]
        .iter()
        .for_each(|s| f(&s.t));
    }

    /// What the log's reader took and skipped.
    #[must_use]
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// Channels and contacts of the log that the configuration does not name.
    #[must_use]
    pub fn unused(&self) -> &[String] {
        &self.unused
    }

    /// What is wrong with the log, as far as its channels tell one by one.
    #[must_use]
    pub fn defects(&self) -> &[Defect] {
        &self.defects
    }

    /// From the first to the last sample; nothing if the log has no stamps.
    #[must_use]
    pub fn duration(&self) -> Nanos {
        if self.stamped {
            self.last - self.first
        } else {
            Nanos::ZERO
        }
    }

    /// Median time between samples of the joint or base that is measured the fastest.
    #[must_use]
    pub fn spacing(&self) -> Nanos {
        let joints = self.joints.iter().map(|joint| joint.position.spacing);
        let all = joints.chain([self.imu.angular_velocity.spacing]);
        all.filter(|spacing| *spacing > Nanos::ZERO)
            .min()
            .unwrap_or(Nanos::ZERO)
    }

    /// Whether the log has stamps.
    #[must_use]
    pub fn is_stamped(&self) -> bool {
        self.stamped
    }

    /// Whether any joint's torque was measured.
    #[must_use]
    pub fn has_torque(&self, dof: usize) -> bool {
        self.joints.get(dof).is_some_and(|j| !j.torque.t.is_empty())
    }

    /// Samples of joint torques per second while there are any, by the median distance of their stamps: the fastest joint's \[Hz\]; 0 if there is none. Gaps do not count.
    #[must_use]
    pub fn torque_rate(&self) -> f64 {
        let spacings = self.joints.iter().map(|joint| joint.torque.spacing.seconds());
        spacings.filter(|s| *s > 0.0).map(f64::recip).fold(0.0, f64::max)
    }

    /// The instants of the log.
    #[must_use]
    pub fn instants(&self, setup: &Setup, settings: &Settings) -> Instants {
        let period = Nanos::from_seconds(1.0 / settings.rate);
        let times = self.times(setup, period);
        let joints = self.joint_columns(&times, period, settings);
        let imu = self.imu_column(setup, &times, period, settings);
        let dofs = setup.model.dof_count();
        let at_rest: Vec<f64> = setup.locked.iter().map(|q| if q.is_nan() { 0.0 } else { *q }).collect();
        let at = |number: usize| {
            let t = times[number];
            let mut instant = Instant {
                t,
                position: at_rest.clone(),
                velocity: vec![0.0; dofs],
                acceleration: vec![0.0; dofs],
                torque: vec![f64::NAN; dofs],
                base_link: setup.base_link,
                base: FrameMotion::standing(&Vec3::zeros()),
                readings: vec![Wrench::from_parts([f64::NAN; 3], [f64::NAN; 3]); self.sensors.len()],
                active: self.active(setup, t),
                faults: vec![Reason::None; self.channels.len()],
                base_fault: Reason::None,
                temperatures: self.temperatures.iter().map(|own| temperature_at(own, t)).collect(),
                fitted: Vec::new(),
                outliers: SensorSet::default(),
                suspected: UnitSet::default(),
                shaking: Vec::new(),
            };
            instant.stand(setup);
            for (channel, fault) in self.channels.iter().zip(&mut instant.faults) {
                *fault = match channel.role {
                    Use::Joint(dof) => {
                        let state = &joints[dof][number];
                        [instant.position[dof], instant.velocity[dof], instant.acceleration[dof]] = state.motion;
                        instant.torque[dof] = state.torque;
                        state.fault
                    }
                    Use::Sensor(sensor) => match self.sensors[sensor].mean(t, period) {
                        Ok([fx, fy, fz, tx, ty, tz]) => {
                            instant.readings[sensor] = setup.calibrations[sensor].apply(
                                &Wrench::from_parts([fx, fy, fz], [tx, ty, tz]),
                                instant.temperatures[sensor],
                            );
                            Reason::None
                        }
                        Err(reason) => reason,
                    },
                    Use::Base => {
                        instant.base = imu[number].0;
                        imu[number].1
                    }
                };
            }
            instant
        };
        let mut instants = Instants {
            instants: parallel::in_pieces(times.len(), |range| range.map(at).collect()),
            breaks: Vec::new(),
            defects: self.defects.clone(),
        };
        defects::inspect_readings(self, setup, &mut instants);
        instants
    }

    /// When the instants are.
    fn times(&self, setup: &Setup, period: Nanos) -> Vec<Nanos> {
        let stamps = |channel: &Channel| match channel.role {
            Use::Joint(dof) => (&self.joints[dof].position.t, self.joints[dof].position.spacing),
            Use::Sensor(number) => (&self.sensors[number].t, self.sensors[number].spacing),
            Use::Base => (&self.imu.angular_velocity.t, self.imu.angular_velocity.spacing),
        };
        let trigger = self.channels.get(setup.trigger).map(stamps);
        let there = trigger.filter(|(t, _)| !t.is_empty());
        let Some((stamps, spacing)) = there.or_else(|| self.channels.iter().map(stamps).find(|(t, _)| !t.is_empty()))
        else {
            return Vec::new();
        };
        if !is_dense(spacing, period) {
            return stamps.clone();
        }
        let (first, mut times) = (stamps.first().copied().unwrap_or_default(), Vec::new());
        let mut block = -1;
        for t in stamps {
            let number = (*t - first).0 / period.0;
            if number > block {
                block = number;
                times.push(first + Nanos(number * period.0 + period.0 / 2));
            }
        }
        times
    }

    fn active(&self, setup: &Setup, t: Nanos) -> ContactSet {
        let mut active = setup.always;
        for (contact, declared) in self.declared.iter().enumerate() {
            match declared
                .partition_point(|(from, _)| *from <= t)
                .checked_sub(1)
                .and_then(|i| declared.get(i))
            {
                Some((_, true)) => active.insert(contact),
                Some((_, false)) if setup.support != Some(contact) => active.remove(contact),
                _ => {}
            }
        }
        active
    }

    /// Per degree of freedom and instant; on all cores, since each joint is by itself.
    fn joint_columns(&self, times: &[Nanos], period: Nanos, settings: &Settings) -> Vec<Vec<JointAt>> {
        parallel::map(self.joints.len(), |dof| {
            self.joints[dof].at_all(times, period, settings)
        })
    }

    fn imu_column(
        &self,
        setup: &Setup,
        times: &[Nanos],
        period: Nanos,
        settings: &Settings,
    ) -> Vec<(FrameMotion, Reason)> {
        let BaseMotion::Imu(pose) = &setup.base else {
            return Vec::new();
        };
        let ImuTrack {
            proper_acceleration,
            angular_velocity,
            angular_acceleration,
        } = &self.imu;
        let smoothers: Vec<Smoother> = if angular_acceleration.t.is_empty() {
            (0..3).map(|axis| angular_velocity.smoother(axis)).collect()
        } else {
            Vec::new()
        };
        let mut scratch = Scratch::default();
        let mut at = |t: Nanos| -> Result<FrameMotion, Reason> {
            let (omega, alpha) = if smoothers.is_empty() {
                (angular_velocity.mean(t, period)?, angular_acceleration.mean(t, period)?)
            } else {
                angular_velocity.mean(t, period)?;
                let (mut omega, mut alpha) = ([0.0; 3], [0.0; 3]);
                for (axis, smoother) in smoothers.iter().enumerate() {
                    let both = smoother.at(t, 0..=1, settings.edge.seconds(), &mut scratch);
                    [omega[axis], alpha[axis], _] = both.ok_or(Reason::Starting)?;
                }
                (omega, alpha)
            };
            let measured = FrameMotion {
                angular_velocity: Vec3::from(omega),
                angular_acceleration: Vec3::from(alpha),
                proper_acceleration: Vec3::from(proper_acceleration.mean(t, period)?),
            };
            Ok(FrameMotion::of_link_from_imu(&measured, pose))
        };
        let standing = FrameMotion::standing(&Vec3::zeros());
        times
            .iter()
            .map(|t| at(*t).map_or_else(|fault| (standing, fault), |m| (m, Reason::None)))
            .collect()
    }
}

impl Instant {
    /// Stands for all measured joint torques among numbers of sub-trees.
    pub const TORQUES: usize = UnitSet::CAPACITY - 1;

    /// Starts kinematics at the link that stands still, unless an IMU tells how the base moves.
    fn stand(&mut self, setup: &Setup) {
        match &setup.base {
            BaseMotion::Standing(motion) => self.base = *motion,
            BaseMotion::Imu(_) => {}
            BaseMotion::Stance(stances) => {
                let standing = stances.iter().find(|s| self.active.contains(s.contact));
                if standing.is_none() {
                    self.base_fault = Reason::NoStance;
                }
                if let Some(stance) = standing.or(stances.first()) {
                    (self.base_link, self.base) = (stance.link, stance.motion);
                }
            }
        }
    }

    /// Whether every joint, and the base, is known at this instant.
    #[must_use]
    pub fn has_motion(&self, channels: &[Channel]) -> bool {
        let known = |(c, fault): (&Channel, &Reason)| matches!(c.role, Use::Sensor(_)) || *fault == Reason::None;
        self.base_fault == Reason::None && channels.iter().zip(&self.faults).all(known)
    }
}

/// A temperature at `t`, of samples in the order of their stamps.
fn temperature_at(samples: &[(Nanos, f64)], t: Nanos) -> f64 {
    let after = samples.partition_point(|(stamp, _)| *stamp <= t);
    match (after.checked_sub(1).and_then(|i| samples.get(i)), samples.get(after)) {
        (Some((from, before)), Some((to, next))) => {
            before + (t - *from).seconds() / (*to - *from).seconds() * (next - before)
        }
        (Some((_, only)), None) | (None, Some((_, only))) => *only,
        (None, None) => f64::NAN,
    }
}

/// A joint at an instant.
#[derive(Debug, Clone, Copy)]
struct JointAt {
    motion: [f64; 3],
    torque: f64,
    fault: Reason,
}

impl JointTrack {
    fn at_all(&self, times: &[Nanos], period: Nanos, settings: &Settings) -> Vec<JointAt> {
        if self.position.t.is_empty() {
            return Vec::new();
        }
        let edge = settings.edge.seconds();
        let of_position = self.velocity.t.is_empty().then(|| self.position.smoother(0));
        let of_velocity =
            (!self.velocity.t.is_empty() && self.acceleration.t.is_empty()).then(|| self.velocity.smoother(0));
        let mut scratch = Scratch::default();
        let mut derivatives =
            |smoother: &Smoother, t, orders| smoother.at(t, orders, edge, &mut scratch).ok_or(Reason::Starting);
        let mut motion = |t: Nanos| -> Result<[f64; 3], Reason> {
            let [mut position] = self.position.mean(t, period)?;
            let is_given = !self.acceleration.t.is_empty();
            let (velocity, mut acceleration) = if let Some(smoother) = &of_position {
                let orders = if is_given || of_velocity.is_some() {
                    0..=1
                } else {
                    0..=2
                };
                let [of_0, of_1, of_2] = derivatives(smoother, t, orders)?;
                position = of_0;
                (of_1, of_2)
            } else {
                (self.velocity.mean(t, period)?[0], 0.0)
            };
            if is_given {
                acceleration = self.acceleration.mean(t, period)?[0];
            } else if let Some(smoother) = &of_velocity {
                acceleration = derivatives(smoother, t, 1..=1)?[1];
            }
            Ok([position, velocity, acceleration])
        };
        let mut at = |&t: &Nanos| {
            let torque = self.torque.mean(t, period).map_or(f64::NAN, |[torque]| torque);
            match motion(t) {
                Ok(motion) => JointAt {
                    motion,
                    torque,
                    fault: Reason::None,
                },
                Err(fault) => JointAt {
                    motion: [self.position.nearest(t)[0], 0.0, 0.0],
                    torque,
                    fault,
                },
            }
        };
        times.iter().map(&mut at).collect()
    }
}

/// Whether a channel sampled every `spacing` is averaged over blocks of `period`.
fn is_dense(spacing: Nanos, period: Nanos) -> bool {
    spacing > Nanos::ZERO && spacing.0 < period.0 / 4 * 3
}

impl<const D: usize> Stream<D> {
    fn push(&mut self, t: Nanos, value: Values<D>, fault: Reason) {
        if value.iter().any(|v| v.is_nan()) {
            return;
        }
        if fault == Reason::None {
            self.t.push(t);
            self.value.push(value);
        } else {
            self.disowned.push((t, fault));
        }
    }

    /// Finds out what a gap is, once the stamps are in order: silence for longer than `max_silence`, or several samples missing.
    fn measure(&mut self, max_silence: Nanos) {
        self.disowned.sort_by_key(|(t, _)| *t);
        let mut spacings: Vec<i64> = self.t.windows(2).map(|w| (w[1] - w[0]).0).collect();
        let middle = spacings.len() / 2;
        self.spacing = if spacings.is_empty() {
            Nanos::ZERO
        } else {
            Nanos(*spacings.select_nth_unstable(middle).1)
        };
        self.max_gap = max_silence.min(Nanos(self.spacing.0.saturating_mul(5)).max(Nanos::from_millis(30)));
    }

    fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) {
        let kept: Vec<bool> = (0..self.t.len()).map(&mut keep).collect();
        let mut flags = kept.iter();
        self.t.retain(|_| *flags.next().unwrap_or(&true));
        let mut flags = kept.iter();
        self.value.retain(|_| *flags.next().unwrap_or(&true));
    }

    fn column(&self, axis: usize) -> Vec<f64> {
        self.value.iter().map(|v| v[axis]).collect()
    }

    fn smoother(&self, axis: usize) -> Smoother {
        Smoother::new(&self.t, &self.column(axis), self.max_gap)
    }

    fn nearest(&self, t: Nanos) -> Values<D> {
        let after = self.t.partition_point(|s| *s <= t).min(self.t.len().saturating_sub(1));
        let before = after.saturating_sub(1);
        match (self.t.get(before), self.t.get(after)) {
            (Some(a), Some(b)) => self.value[if t - *a < *b - t { before } else { after }],
            _ => [0.0; D],
        }
    }

    /// What speaks against the time from `from` to `to`.
    fn disowned(&self, from: Nanos, to: Nanos) -> Option<Reason> {
        let at = self.disowned.partition_point(|(t, _)| *t < from);
        self.disowned
            .get(at)
            .filter(|(t, _)| *t <= to)
            .map(|(_, reason)| *reason)
    }

    /// The value at `t`: the mean over `period` of a channel that is faster, else measured or between its neighbours.
    fn mean(&self, t: Nanos, period: Nanos) -> Result<Values<D>, Reason> {
        let (Some(first), Some(last)) = (self.t.first(), self.t.last()) else {
            return Err(self.disowned.first().map_or(Reason::NeverSeen, |(_, reason)| *reason));
        };
        let after = self.t.partition_point(|s| *s <= t);
        let fault = || self.disowned(t - self.max_gap, t + self.max_gap);
        if t < *first || t > *last {
            return Err(fault().unwrap_or(Reason::Stale));
        }
        // Not 0: the first sample is not later than t.
        let before = after - 1;
        let half = if is_dense(self.spacing, period) {
            Nanos(period.0 / 2).min(t - *first).min(*last - t)
        } else {
            Nanos::ZERO
        };
        let (low, high) = (t - half, t + half);
        let begin = self.t.partition_point(|s| *s <= low) - 1;
        let end = self.t.partition_point(|s| *s < high).min(self.t.len() - 1);
        let apart = self.t[begin..=end].windows(2).any(|w| w[1] - w[0] > self.max_gap);
        if let Some(reason) = self.disowned(self.t[begin], self.t[end]) {
            return Err(reason);
        }
        if apart {
            return Err(Reason::Stale);
        }
        if half == Nanos::ZERO {
            return Ok(if self.t[before] == t {
                self.value[before]
            } else {
                self.between(before, t)
            });
        }
        // Trapezoids under the straight lines between low, the samples in between, and high.
        let (mut sum, mut from, mut value) = ([0.0; D], low, self.line(begin, low));
        for i in begin + 1..=end {
            let to = self.t[i].min(high);
            let next = if to == self.t[i] {
                self.value[i]
            } else {
                self.line(i - 1, high)
            };
            let weight = 0.5 * (to - from).seconds();
            for (sum, (a, b)) in sum.iter_mut().zip(value.iter().zip(&next)) {
                *sum += weight * (a + b);
            }
            (from, value) = (to, next);
        }
        Ok(sum.map(|sum| sum / (high - low).seconds()))
    }

    /// The cubic through sample `i`, the next, and their neighbours, at `t`; the straight line where these are missing, do not belong together, or are so unevenly spaced that the cubic would be
    /// noisier than a sample.
    fn between(&self, i: usize, t: Nanos) -> Values<D> {
        /// How unevenly, as a ratio.
        const UNEVEN: f64 = 2.0;
        let (Some(a), Some(b)) = (self.t.get(i), self.t.get(i + 1)) else {
            return self.value[i];
        };
        let own = (*b - *a).seconds();
        let even = |from: Nanos, to: Nanos| {
            to - from <= self.max_gap && (own / UNEVEN..=own * UNEVEN).contains(&(to - from).seconds())
        };
        let around = i
            .checked_sub(1)
            .and_then(|before| Some((self.t.get(before..i + 3)?, self.value.get(before..i + 3)?)));
        let (stamps, values) = match around {
            Some((stamps, values))
                if even(stamps[0], *a) && even(*b, stamps[3]) && self.disowned(stamps[0], stamps[3]).is_none() =>
            {
                (stamps, values)
            }
            _ => return self.line(i, t),
        };
        let x = [0, 1, 2, 3].map(|k| (stamps[k] - t).seconds());
        let mut sum = [0.0; D];
        for (weight, value) in cubic(x, 0.0).iter().zip(values) {
            add_multiple(&mut sum, *weight, value);
        }
        sum
    }

    /// The straight line from sample `i` to the next, at `t`.
    fn line(&self, i: usize, t: Nanos) -> Values<D> {
        let (Some(a), Some(b)) = (self.t.get(i), self.t.get(i + 1)) else {
            return self.value[i];
        };
        let share = (t - *a).seconds() / (*b - *a).seconds();
        std::array::from_fn(|k| self.value[i][k] + share * (self.value[i + 1][k] - self.value[i][k]))
    }
}

/// Weights of four samples, at `x`, in the cubic through them (Lagrange), at `t`.
fn cubic(x: [f64; 4], t: f64) -> [f64; 4] {
    let d = x.map(|x| t - x);
    [
        d[1] * d[2] * d[3] / ((x[0] - x[1]) * (x[0] - x[2]) * (x[0] - x[3])),
        d[0] * d[2] * d[3] / ((x[1] - x[0]) * (x[1] - x[2]) * (x[1] - x[3])),
        d[0] * d[1] * d[3] / ((x[2] - x[0]) * (x[2] - x[1]) * (x[2] - x[3])),
        d[0] * d[1] * d[2] / ((x[3] - x[0]) * (x[3] - x[1]) * (x[3] - x[2])),
    ]
}

#[cfg(test)]
mod tests;
