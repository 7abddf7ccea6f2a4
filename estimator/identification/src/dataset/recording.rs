//! Samples of a log, channel by channel, as they were recorded. What the other steps do with a
//! recording stands with them: `cleaning` (which also finds its span), `inspection`, `resampling`.

use crate::dataset::repeats::ChannelRepeats;
use crate::dataset::stream::{ImuTrack, JointTrack, MOTION, SampleStream};
use crate::finding::Finding;
use crate::robot::{Channel, ChannelRole, Robot};
use proprio_topics::{Nanos, Quality, Reading, Reason};

/// Samples of one log, channel by channel, as they were recorded.
///
/// [`Recording::push`] and [`Recording::declare`] fill it, in any order of channels. Samples of one
/// channel come in the order in which they were recorded. [`crate::Dataset::new`] converts it for
/// identification.
#[derive(Debug, Clone)]
pub struct Recording {
    /// The channels that the pipeline reads, in its order.
    pub(crate) channels: Vec<Channel>,
    /// By degree of freedom; empty for locked joints.
    pub(crate) joints: Vec<JointTrack>,
    pub(crate) sensors: Vec<SampleStream<6>>,
    /// Per F/T sensor the temperature of its board [degrees Celsius], in the order of arrival until
    /// sorted.
    pub(crate) temperatures: Vec<Vec<(Nanos, f64)>>,
    pub(crate) imu: ImuTrack,
    /// Per contact, from which time on it is declared present or absent.
    pub(crate) declared: Vec<Vec<(Nanos, bool)>>,
    /// Whether the log has stamps.
    pub(crate) stamped: bool,
    pub(crate) max_silence: Nanos,
    pub(crate) first: Nanos,
    pub(crate) last: Nanos,
    pub(crate) rows: u64,
    pub(crate) skipped: Option<SkippedRows>,
    /// Per channel.
    pub(crate) repeats: Vec<ChannelRepeats>,
    /// Channels that do not change while the robot moves, from and to when.
    pub(crate) frozen: Vec<(String, Nanos, Nanos)>,
    /// The most samples of a channel whose stamps go backward, and when first.
    pub(crate) backward: Option<(usize, Nanos)>,
    pub(crate) findings: Vec<Finding>,
}

/// Rows of a table that could not be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SkippedRows {
    /// Number of rows.
    pub rows: u64,
    /// Line of the first.
    pub line: u64,
    /// The error in it.
    pub reason: String,
}

impl Recording {
    /// An empty recording.
    #[must_use]
    pub fn new(robot: &Robot) -> Self {
        let sensors = robot.structure.sensors().len();
        Self {
            joints: vec![JointTrack::default(); robot.model.dof_count()],
            sensors: vec![SampleStream::default(); sensors],
            temperatures: vec![Vec::new(); sensors],
            imu: ImuTrack::default(),
            declared: vec![Vec::new(); robot.contacts.len()],
            stamped: true,
            max_silence: robot.max_silence,
            first: Nanos::MAX,
            last: Nanos::MIN,
            rows: 0,
            skipped: None,
            repeats: vec![ChannelRepeats::default(); robot.channels.len()],
            frozen: Vec::new(),
            backward: None,
            findings: Vec::new(),
            channels: robot.channels.clone(),
        }
    }

    /// Adds a sample of channel number `channel` (see [`Robot::channel`]), acquired at `t`. Samples
    /// that their device or quality bits mark as faulty are excluded and reported. Readings of
    /// another channel's kind are ignored.
    pub fn push(&mut self, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        if let Some(repeats) = self.repeats.get_mut(channel) {
            repeats.see(t, reading);
        }
        let Some(role) = self.channels.get(channel).map(|c| c.role) else {
            return;
        };
        let device_fault = Reason::of_quality(quality, Quality::DEVICE_FAULT);
        match (role, reading) {
            (ChannelRole::Joint(dof), Reading::Joint(j)) => {
                let Some(track) = self.joints.get_mut(dof) else {
                    return;
                };
                let fault = Reason::of_quality(quality, Quality::UNTRUSTED_ENCODER);
                track.position.push(t, [j.position], fault);
                track.velocity.push(t, [j.velocity], fault);
                track.acceleration.push(t, [j.acceleration], fault);
                track.torque.push(t, [j.torque], device_fault);
            }
            (ChannelRole::Sensor(number), Reading::Wrench(w)) => {
                let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
                if let Some(stream) = self.sensors.get_mut(number) {
                    stream.push(t, [fx, fy, fz, tx, ty, tz], device_fault);
                }
            }
            (ChannelRole::Sensor(number), Reading::Temperature(temperature)) => {
                let celsius = temperature.celsius;
                let is_good = celsius.is_finite() && !quality.intersects(Quality::DEVICE_FAULT);
                if let Some(own) = self.temperatures.get_mut(number).filter(|_| is_good) {
                    own.push((t, celsius));
                }
            }
            (ChannelRole::Base, Reading::Imu(i)) => {
                let imu = &mut self.imu;
                (imu.proper_acceleration).push(t, i.proper_acceleration, device_fault);
                (imu.angular_velocity).push(t, i.angular_velocity, device_fault);
                (imu.angular_acceleration).push(t, i.angular_acceleration, device_fault);
            }
            _ => {}
        }
    }

    /// Declares contact number `contact` (see [`Robot::contact`]) present or absent from `t` on.
    pub fn declare(&mut self, contact: usize, t: Nanos, present: bool) {
        if let Some(declared) = self.declared.get_mut(contact) {
            declared.push((t, present));
        }
    }

    /// States that rows have no stamps of their own: each row stands alone, and no value is carried
    /// to the next. Stamp them [`Recording::unstamped_spacing`] apart.
    pub fn set_unstamped(&mut self) {
        self.stamped = false;
    }

    /// The spacing of rows without stamps for which no value is carried to the next row.
    #[must_use]
    pub fn unstamped_spacing(&self) -> Nanos {
        self.max_silence + self.max_silence + Nanos(1)
    }

    /// Sets the number of rows of the table that this was read from, and its unreadable rows.
    pub fn set_rows(&mut self, rows: u64, skipped: Option<SkippedRows>) {
        (self.rows, self.skipped) = (rows, skipped);
    }

    /// Appends the samples that follow these.
    pub fn append(&mut self, mut next: Self) {
        let repeats = self.repeats.iter_mut().zip(next.repeats);
        repeats.for_each(|(own, next)| own.append(next));
        for (own, next) in self.joints.iter_mut().zip(&mut next.joints) {
            let streams = own.all().into_iter().zip(next.all());
            streams.for_each(|(own, next)| own.append(next));
        }
        let sensors = self.sensors.iter_mut().zip(&mut next.sensors);
        sensors.for_each(|(own, next)| own.append(next));
        let temperatures = self.temperatures.iter_mut().zip(next.temperatures);
        temperatures.for_each(|(own, next)| own.extend(next));
        let imu = self.imu.all().into_iter().zip(next.imu.all());
        imu.for_each(|(own, next)| own.append(next));
        let declared = self.declared.iter_mut().zip(next.declared);
        declared.for_each(|(own, next)| own.extend(next));
        self.stamped &= next.stamped;
    }

    /// Time from the first to the last sample; zero if the log has no stamps.
    pub(crate) fn duration(&self) -> Nanos {
        if self.stamped {
            self.last - self.first
        } else {
            Nanos::ZERO
        }
    }

    /// The number of samples of the joint or sensor that has the most.
    pub(crate) fn longest_stream(&self) -> usize {
        let joints = self.joints.iter().map(|joint| joint.position.t.len());
        let sensors = self.sensors.iter().map(|sensor| sensor.t.len());
        joints.chain(sensors).max().unwrap_or(0)
    }

    /// Median sample spacing of the joint or base that is sampled the fastest.
    pub(crate) fn spacing(&self) -> Nanos {
        let joints = self.joints.iter().map(|joint| joint.position.spacing);
        let all = joints.chain([self.imu.angular_velocity.spacing]);
        let least = all.filter(|spacing| *spacing > Nanos::ZERO).min();
        least.unwrap_or(Nanos::ZERO)
    }
}

impl Recording {
    /// The stamps of a channel's main stream.
    pub(crate) fn stamps(&self, role: ChannelRole) -> (&[Nanos], Nanos, Nanos) {
        fn of<const D: usize>(s: &SampleStream<D>) -> (&[Nanos], Nanos, Nanos) {
            (&s.t, s.max_gap, s.spacing)
        }
        match role {
            ChannelRole::Joint(dof) => of(&self.joints[dof].position),
            ChannelRole::Sensor(number) => of(&self.sensors[number]),
            ChannelRole::Base => of(&self.imu.angular_velocity),
        }
    }

    /// Whether samples of a channel in between were excluded as faulty by their device.
    pub(crate) fn has_faulty(&self, role: ChannelRole, from: Nanos, to: Nanos) -> bool {
        match role {
            ChannelRole::Joint(dof) => self.joints[dof].position.faulty(from, to).is_some(),
            ChannelRole::Sensor(number) => self.sensors[number].faulty(from, to).is_some(),
            ChannelRole::Base => self.imu.angular_velocity.faulty(from, to).is_some(),
        }
    }

    /// Whether a joint other than `but` moves, or the base rotates.
    pub(crate) fn moves(&self, from: Nanos, to: Nanos, but: Option<usize>) -> bool {
        let mut joints = self.joints.iter().enumerate();
        let mut rates = self.imu.angular_velocity.within(from, to).iter();
        joints.any(|(dof, j)| Some(dof) != but && j.range(from, to) > MOTION)
            || rates.any(|w| w.iter().map(|x| x * x).sum::<f64>() > 0.01)
    }
}
