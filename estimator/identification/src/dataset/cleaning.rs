//! Cleans every channel of a recording: orders the stamps, and removes repeated readings, frozen
//! stretches, and spikes of encoders, joint torques and gyroscopes. Everything removed is reported
//! as a finding.

use crate::dataset::recording::Recording;
use crate::dataset::repeats::{ChannelRepeats, RepeatedReadings};
use crate::dataset::smooth::quantum;
use crate::dataset::stream::{JointTrack, MOTION, SampleStream};
use crate::finding::{Finding, FindingCode};
use crate::robot::{ChannelRole, Robot};
use crate::statistics::robust_std;
use proprio_topics::Nanos;
use std::ops::Range;

/// A sensor whose reading repeats for longer is frozen, unless the robot rests.
pub(crate) const FREEZE: Nanos = Nanos::from_millis(200);

pub(crate) fn label(channel: &crate::robot::Channel) -> String {
    format!("{}/{}", channel.kind.word(), channel.name)
}

/// Samples that were removed from a stream to make its stamps increase.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Disorder {
    repeated: usize,
    backward: usize,
    first: Option<Nanos>,
}

/// A stream of any number of axes.
trait AnyStream {
    fn order(&mut self) -> Disorder;
    fn remove(&mut self, stamps: &[Nanos]);
    fn measure(&mut self, max_silence: Nanos);
}

impl Recording {
    /// Every stream of a channel.
    fn streams(&mut self, role: ChannelRole) -> Vec<&mut dyn AnyStream> {
        match role {
            ChannelRole::Joint(dof) => {
                let track = &mut self.joints[dof];
                vec![
                    &mut track.position,
                    &mut track.velocity,
                    &mut track.acceleration,
                    &mut track.torque,
                ]
            }
            ChannelRole::Sensor(number) => vec![&mut self.sensors[number]],
            ChannelRole::Base => vec![
                &mut self.imu.proper_acceleration,
                &mut self.imu.angular_velocity,
                &mut self.imu.angular_acceleration,
            ],
        }
    }
}

impl<const D: usize> AnyStream for SampleStream<D> {
    /// Removes as few samples as possible so that every stamp is later than the previous one: keeps
    /// a longest increasing subsequence.
    fn order(&mut self) -> Disorder {
        let mut disorder = Disorder::default();
        if self.t.windows(2).all(|w| w[0] < w[1]) {
            return disorder;
        }
        // Per length, the last sample of the subsequence that ends earliest; per sample, its
        // predecessor.
        let (mut ends, mut before): (Vec<usize>, Vec<Option<usize>>) = (Vec::new(), Vec::new());
        for (i, t) in self.t.iter().enumerate() {
            let place = ends.partition_point(|&e| self.t[e] < *t);
            before.push(place.checked_sub(1).map(|p| ends[p]));
            match ends.get_mut(place) {
                // Of equal stamps the first is kept.
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

    /// Removes the samples with these (sorted) stamps.
    fn remove(&mut self, stamps: &[Nanos]) {
        if !stamps.is_empty() {
            let drop: Vec<bool> = self
                .t
                .iter()
                .map(|t| stamps.binary_search(t).is_ok())
                .collect();
            self.retain(|i| !drop[i]);
        }
    }

    fn measure(&mut self, max_silence: Nanos) {
        Self::measure(self, max_silence);
    }
}

impl<const D: usize> SampleStream<D> {
    /// Removes samples of one axis that lie far from three neighbours on each side. Returns their
    /// number, the largest deviation, and its time. Deviations up to `least` are accepted.
    fn despike(&mut self, axis: usize, least: f64) -> Option<(usize, f64, Nanos)> {
        let values = self.column(axis);
        let mut neighbours = [0.0; 6];
        // Per sample: its deviation from the neighbours' median, and their range without the two
        // outermost, which may be another spike.
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
        let usual = robust_std(
            off.iter()
                .filter(|(_, spread)| spread.is_finite())
                .map(|(d, _)| *d),
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

/// Cleans every stream: stamps, repeated readings, frozen stretches, and spikes of encoders, joint
/// torques and gyroscopes.
pub(crate) fn clean(recording: &mut Recording, robot: &Robot) {
    let channels = recording.channels.clone();
    let mut repeats = std::mem::replace(&mut recording.repeats, RepeatedReadings::new(0));
    let max_silence = robot.max_silence;
    let mut found = Vec::new();
    let mut disorders = Vec::new();
    for (channel, repeat) in channels.iter().zip(&repeats.channels) {
        let mut worst = Disorder::default();
        for stream in recording.streams(channel.role) {
            let own = stream.order();
            if own.repeated + own.backward > worst.repeated + worst.backward {
                worst = own;
            }
            stream.measure(max_silence);
        }
        worst.repeated = worst.repeated.saturating_sub(repeat.same_stamp.len());
        disorders.push((label(channel), worst));
    }
    for (names, disorder) in merged(disorders, |a, b| a == b) {
        if let (Some(first), true) = (disorder.first, disorder.repeated + disorder.backward > 0) {
            let Disorder {
                repeated, backward, ..
            } = disorder;
            let text = format!(
                "{names}: {repeated} stamps occur twice and {backward} go backward, the first at \
                 {first} s: these samples were excluded; check the recorder's clock"
            );
            found.push(Finding::warning(FindingCode::Timestamps, names, text));
            if recording.backward.is_none_or(|(most, _)| backward > most) {
                recording.backward = Some((backward, first));
            }
        }
    }
    repeated(recording, &channels, &mut repeats, &mut found);
    for channel in &channels {
        // Removed samples can leave gaps. The spacing of the channel is not measured again.
        if let ChannelRole::Joint(dof) = channel.role {
            let name = label(channel);
            if let Some((from, to)) = stopped(&recording.joints[dof].position) {
                recording.frozen.push((name.clone(), from, to));
                recording.joints[dof].each(|s| s.retain_outside(from, to));
            }
            for (from, to) in dead(&recording.joints[dof]) {
                recording.frozen.push((format!("{name}/torque"), from, to));
                // The first sample is removed too: its time of measurement is unknown.
                let stamps = &recording.joints[dof].torque.t;
                let drop: Vec<bool> = stamps.iter().map(|t| (from..=to).contains(t)).collect();
                recording.joints[dof].torque.retain(|i| !drop[i]);
            }
            let track = &mut recording.joints[dof];
            // A deviation within the configured position noise is no spike.
            let noise = robot.position_noise;
            for (axis, stream, least) in [
                ("position", &mut track.position, noise),
                ("torque", &mut track.torque, 1e-9),
            ] {
                found.extend(
                    stream
                        .despike(0, least)
                        .map(|own| outliers(&name, axis, own)),
                );
            }
        }
        if channel.role == ChannelRole::Base {
            for (axis, word) in ["gx", "gy", "gz"].into_iter().enumerate() {
                let own = recording.imu.angular_velocity.despike(axis, 1e-9);
                found.extend(own.map(|own| outliers(&label(channel), word, own)));
            }
        }
    }
    found.extend(recording.frozen.iter().map(|(channel, from, to)| {
        let text = format!(
            "{channel} does not change from {from} s to {to} s while the robot moves: this time is \
             excluded; check the cable and the board"
        );
        Finding::warning(FindingCode::Frozen, channel, text)
    }));
    recording.findings = found;
}

/// Samples far from their neighbours: their number, the largest deviation, its time.
fn outliers(channel: &str, axis: &str, (samples, largest, t): (usize, f64, Nanos)) -> Finding {
    let unit = match axis {
        "torque" => "Nm",
        "position" => "rad (or m)",
        _ => "rad/s",
    };
    let text = format!(
        "{channel}: {samples} outlier{} of {axis}, the largest by {largest:.4} {unit} at {t} s: \
         excluded",
        if samples == 1 { "" } else { "s" }
    );
    Finding::warning(FindingCode::Outliers, channel, text)
}

/// Merges equal entries of several channels to one.
pub(crate) fn merged<T>(
    entries: Vec<(String, T)>,
    same: impl Fn(&T, &T) -> bool,
) -> Vec<(String, T)> {
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
    groups
        .into_iter()
        .map(|(names, entry)| (name(names), entry))
        .collect()
}

/// Removes repeated readings, and reports their kind: repeated rows, a slow sensor, a frozen one.
fn repeated(
    recording: &mut Recording,
    channels: &[crate::robot::Channel],
    repeats: &mut RepeatedReadings,
    found: &mut Vec<Finding>,
) {
    for (channel, repeat) in channels.iter().zip(&mut repeats.channels) {
        repeat.later.sort_unstable();
        let (stamps, ..) = recording.stamps(channel.role);
        let (mut drop, mut held_samples, all) = (Vec::new(), 0, stamps.len());
        let mut frozen = Vec::new();
        // Runs of repeats. Each run follows the sample that it repeats.
        let mut i = 1;
        while i < stamps.len() {
            let begin = i;
            while i < stamps.len() && repeat.later.binary_search(&stamps[i]).is_ok() {
                i += 1;
            }
            if i > begin {
                let (from, to) = (stamps[begin - 1], stamps[i - 1]);
                let but = if let ChannelRole::Joint(dof) = channel.role {
                    Some(dof)
                } else {
                    None
                };
                let run = &stamps[begin..i];
                if to - from < FREEZE {
                    drop.extend_from_slice(run);
                    held_samples += run.len();
                } else if recording.moves(from, to, but) {
                    drop.extend_from_slice(run);
                    frozen.push((label(channel), from, to));
                }
            }
            i += 1;
        }
        repeat.later = drop;
        recording.frozen.append(&mut frozen);
        let max_silence = recording.max_silence;
        for stream in recording.streams(channel.role) {
            stream.remove(&repeat.later);
            // Mostly repeats: the sensor's own rate is that of the remaining samples.
            if held_samples * 2 > all {
                stream.measure(max_silence);
            }
        }
    }
    let of_rows = |r: &ChannelRepeats| {
        let mut all: Vec<Nanos> = r.later.iter().chain(&r.same_stamp).copied().collect();
        all.sort_unstable();
        all
    };
    let seen: Vec<&ChannelRepeats> = repeats.channels.iter().filter(|r| r.readings > 0).collect();
    let rows = seen.first().map(|r| of_rows(r)).unwrap_or_default();
    if let (Some(first), true) = (
        rows.first(),
        seen.len() > 1 && seen.iter().all(|r| of_rows(r) == rows),
    ) {
        // Skipped if a frozen stretch of all channels was already reported.
        if recording.frozen.is_empty() {
            let text = format!(
                "{} rows repeat the previous row, the first at {first} s: they were excluded; let \
                 the recorder wait for new samples",
                rows.len()
            );
            found.push(Finding::warning(FindingCode::RepeatedRows, "", text));
        }
        return;
    }
    let mut found_repeats = Vec::new();
    for (channel, repeat) in channels.iter().zip(&repeats.channels) {
        let frozen = recording.frozen.iter();
        let frozen: usize = frozen
            .filter(|(name, ..)| *name == label(channel))
            .map(|(_, from, to)| {
                repeat
                    .later
                    .iter()
                    .filter(|t| *t > from && *t <= to)
                    .count()
            })
            .sum();
        let samples = repeat.later.len() - frozen;
        // Six coarse numbers may repeat by chance now and then.
        let often = samples >= 10 && samples * 50 >= repeat.readings;
        let samples = if often { samples } else { 0 } + repeat.same_stamp.len();
        if samples > 0 {
            found_repeats.push((label(channel), (samples, repeat.readings)));
        }
    }
    let found_repeats = merged(found_repeats, |a, b| a == b).into_iter();
    found.extend(found_repeats.map(|(channel, (samples, of))| {
        let text = format!(
            "{channel} repeats its last reading in {samples} of {of} samples: these were excluded; \
             the sensor is slower than the recording"
        );
        Finding::warning(FindingCode::Repeated, channel, text)
    }));
}

impl<const D: usize> SampleStream<D> {
    /// Removes the samples after `from` up to `to`.
    fn retain_outside(&mut self, from: Nanos, to: Nanos) {
        let outside: Vec<bool> = self.t.iter().map(|t| *t <= from || *t > to).collect();
        self.retain(|i| outside[i]);
    }
}

/// Where an encoder stops from one sample to the next out of fast motion and then stays for at
/// least half a second, which is physically impossible.
fn stopped(position: &SampleStream<1>) -> Option<(Nanos, Nanos)> {
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

/// Least number of steps by which a quantity must change within half the length of a flat stretch
/// on its sides, if the stretch is no turning point: a parabola that stays within one step for `n`
/// samples is at most four steps away `n / 2` samples before and after.
pub(crate) const STEEP: f64 = 10.0;

/// Whether a quantity with these quantisation steps enters a flat stretch, and leaves it, more
/// steeply than at a turning point ([`STEEP`]). At the ends of the log the answer is yes.
pub(crate) fn steep(values: &[f64], flat: &Range<usize>, step: f64) -> [bool; 2] {
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

/// Stretches in which a joint's torque repeats for longer than chance, coarse quantisation, a
/// turning point or a standstill explain, while the joint moves.
fn dead(track: &JointTrack) -> Vec<(Nanos, Nanos)> {
    /// Greatest probability of a dead stretch in a torque that repeats by chance.
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
    let steps = |some: &mut dyn Iterator<Item = &(usize, usize)>| {
        some.map(|(begin, end)| end - begin).sum::<usize>()
    };
    // The probability that two consecutive samples outside long stretches are equal.
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
    // A torque that never changes has no other samples to compare with.
    let all_equal = stretches.len() == 1 && stretches.iter().any(is_long);
    stretches
        .iter()
        .filter(|stretch| {
            dead(stretch) || all_equal && track.range(t[stretch.0], t[stretch.1]) > MOTION
        })
        .map(|(begin, end)| (t[*begin], t[*end]))
        .collect()
}
