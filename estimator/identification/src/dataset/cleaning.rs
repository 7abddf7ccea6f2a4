//! Cleans every channel of a recording: orders the stamps, and removes repeated readings, frozen
//! stretches, and spikes of encoders, measured derivatives, joint torques and gyroscopes.
//! Everything removed is reported as a finding.

use crate::dataset::recording::Recording;
use crate::dataset::repeats::ChannelRepeats;
use crate::dataset::smooth::quantum;
use crate::dataset::stream::{JointTrack, MOTION, SampleStream};
use crate::finding::{Finding, FindingCode};
use crate::robot::{Channel, ChannelRole, Robot};
use crate::statistics::robust_std;
use proprio_topics::Nanos;
use std::ops::Range;

/// A sensor whose reading repeats for longer is frozen, unless the robot rests.
pub(crate) const FREEZE: Nanos = Nanos::from_millis(200);

pub(crate) fn label(channel: &Channel) -> String {
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
    fn stamps(&self) -> &[Nanos];
    fn order(&mut self) -> Disorder;
    fn remove(&mut self, stamps: &[Nanos]);
    fn measure(&mut self, max_silence: Nanos);
}

impl Recording {
    /// Sets the stamps of the first and the last sample.
    pub(crate) fn set_span(&mut self) {
        let (mut first, mut last) = (Nanos::MAX, Nanos::MIN);
        for channel in self.channels.clone() {
            for stream in self.streams(channel.role) {
                first = first.min(stream.stamps().first().copied().unwrap_or(Nanos::MAX));
                last = last.max(stream.stamps().last().copied().unwrap_or(Nanos::MIN));
            }
        }
        (self.first, self.last) = (first, last);
    }

    /// Every stream of a channel.
    fn streams(&mut self, role: ChannelRole) -> Vec<&mut dyn AnyStream> {
        match role {
            ChannelRole::Joint(dof) => {
                let streams = self.joints[dof].all();
                streams.map(|own| own as &mut dyn AnyStream).into()
            }
            ChannelRole::Sensor(number) => vec![&mut self.sensors[number]],
            ChannelRole::Base => {
                let streams = self.imu.all();
                streams.map(|own| own as &mut dyn AnyStream).into()
            }
        }
    }
}

impl<const D: usize> AnyStream for SampleStream<D> {
    fn stamps(&self) -> &[Nanos] {
        &self.t
    }

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
        let before = self.t.clone();
        self.retain(|i, _| keep[i]);
        for (t, _) in before.iter().zip(&keep).filter(|(_, keep)| !**keep) {
            disorder.first.get_or_insert(*t);
            if self.t.binary_search(t).is_ok() {
                disorder.repeated += 1;
            } else {
                disorder.backward += 1;
            }
        }
        disorder
    }

    /// Removes the samples with these (sorted) stamps.
    fn remove(&mut self, stamps: &[Nanos]) {
        if !stamps.is_empty() {
            self.retain(|_, t| stamps.binary_search(&t).is_err());
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
        // Per sample: its deviation from the neighbours' median, and their range without the two
        // outermost, which may be another spike.
        let together = Nanos(self.spacing.0.saturating_mul(6)).saturating_add(self.max_gap);
        let off: Vec<(f64, f64)> = (0..values.len())
            .map(|i| {
                if i < 3 || i + 3 >= values.len() || self.t[i + 3] - self.t[i - 3] > together {
                    return (0.0, f64::INFINITY);
                }
                let around = [i - 3, i - 2, i - 1, i + 1, i + 2, i + 3];
                let mut neighbours = around.map(|k| values[k]);
                neighbours.sort_by(f64::total_cmp);
                let middle = 0.5 * (neighbours[2] + neighbours[3]);
                (values[i] - middle, neighbours[4] - neighbours[1])
            })
            .collect();
        let known = off.iter().filter(|(_, spread)| spread.is_finite());
        let usual = robust_std(known.map(|(d, _)| *d));
        let floor = 8.0 * usual + 3.0 * quantum(&values);
        let far = |(d, spread): (f64, f64)| d.abs() > floor + spread && d.abs() > least;
        let count = off.iter().filter(|o| far(**o)).count();
        let worst = (0..off.len())
            .filter(|i| far(off[*i]))
            .max_by(|a, b| off[*a].0.abs().total_cmp(&off[*b].0.abs()))?;
        let found = (count, off[worst].0, self.t[worst]);
        self.retain(|i, _| !far(off[i]));
        Some(found)
    }
}

/// Cleans every stream: stamps, repeated readings, frozen stretches, and spikes of encoders,
/// measured derivatives, joint torques and gyroscopes.
pub(crate) fn clean(recording: &mut Recording, robot: &Robot) {
    let channels = recording.channels.clone();
    let repeats = std::mem::take(&mut recording.repeats);
    let max_silence = robot.max_silence;
    let mut found = Vec::new();
    let mut disorders = Vec::new();
    for (channel, repeat) in channels.iter().zip(&repeats) {
        let mut worst = Disorder::default();
        for stream in recording.streams(channel.role) {
            let order = stream.order();
            if order.repeated + order.backward > worst.repeated + worst.backward {
                worst = order;
            }
            stream.measure(max_silence);
        }
        worst.repeated = worst.repeated.saturating_sub(repeat.same_stamp.len());
        disorders.push((label(channel), worst));
    }
    for (names, disorder) in merged(disorders, |a, b| a == b) {
        if let (Some(first), true) = (disorder.first, disorder.repeated + disorder.backward > 0) {
            let (repeated, backward) = (disorder.repeated, disorder.backward);
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
    repeated(recording, &channels, repeats, &mut found);
    for channel in &channels {
        // Removed samples can leave gaps. The spacing of the channel is not measured again.
        if let ChannelRole::Joint(dof) = channel.role {
            let name = label(channel);
            if let Some((from, to)) = stopped(&recording.joints[dof].position) {
                recording.frozen.push((name.clone(), from, to));
                for stream in recording.joints[dof].all() {
                    stream.retain(|_, t| t <= from || t > to);
                }
            }
            for (from, to) in dead(&recording.joints[dof]) {
                recording.frozen.push((format!("{name}/torque"), from, to));
                // The first sample is removed too: its time of measurement is unknown.
                let torque = &mut recording.joints[dof].torque;
                torque.retain(|_, t| !(from..=to).contains(&t));
            }
            // A deviation within the configured position noise is no spike.
            let least = [robot.position_noise, 1e-9, 1e-9, 1e-9];
            let axes = ["position", "velocity", "acceleration", "torque"].into_iter();
            let streams = recording.joints[dof].all().into_iter().zip(least);
            for (axis, (stream, least)) in axes.zip(streams) {
                let spikes = stream.despike(0, least);
                found.extend(spikes.map(|own| outliers(&name, axis, own)));
            }
        }
        if channel.role == ChannelRole::Base {
            for (axis, word) in ["gx", "gy", "gz"].into_iter().enumerate() {
                let spikes = recording.imu.angular_velocity.despike(axis, 1e-9);
                found.extend(spikes.map(|own| outliers(&label(channel), word, own)));
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
        "acceleration" => "rad/s^2",
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
    let name = |names: Vec<String>| match names.len() == count && count > 1 {
        true => "every channel".into(),
        false => names.join(", "),
    };
    let groups = groups.into_iter();
    groups.map(|(names, entry)| (name(names), entry)).collect()
}

/// Removes the repeated readings of a channel, and notes where it is frozen.
fn remove_repeats(recording: &mut Recording, channel: &Channel, repeat: &mut ChannelRepeats) {
    repeat.later.sort_unstable();
    let (stamps, ..) = recording.stamps(channel.role);
    let (mut drop, mut held_samples, all) = (Vec::new(), 0, stamps.len());
    let mut frozen = Vec::new();
    let but = match channel.role {
        ChannelRole::Joint(dof) => Some(dof),
        _ => None,
    };
    // Runs of repeats. Each run follows the sample that it repeats.
    let mut i = 1;
    while i < stamps.len() {
        let begin = i;
        while i < stamps.len() && repeat.later.binary_search(&stamps[i]).is_ok() {
            i += 1;
        }
        if i > begin {
            let (from, to) = (stamps[begin - 1], stamps[i - 1]);
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

/// Removes repeated readings, and reports their kind: repeated rows, a slow sensor, a frozen one.
fn repeated(
    recording: &mut Recording,
    channels: &[Channel],
    mut repeats: Vec<ChannelRepeats>,
    found: &mut Vec<Finding>,
) {
    for (channel, repeat) in channels.iter().zip(&mut repeats) {
        remove_repeats(recording, channel, repeat);
    }
    let of_rows = |r: &ChannelRepeats| {
        let mut all: Vec<Nanos> = r.later.iter().chain(&r.same_stamp).copied().collect();
        all.sort_unstable();
        all
    };
    let seen: Vec<&ChannelRepeats> = repeats.iter().filter(|r| r.readings > 0).collect();
    let rows = seen.first().map(|r| of_rows(r)).unwrap_or_default();
    let is_of_all = seen.len() > 1 && seen.iter().all(|r| of_rows(r) == rows);
    if let (Some(first), true) = (rows.first(), is_of_all) {
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
    for (channel, repeat) in channels.iter().zip(&repeats) {
        let name = label(channel);
        let in_frozen = |(other, from, to): &(String, Nanos, Nanos)| {
            let is_within = |t: &&Nanos| *other == name && *t > from && *t <= to;
            repeat.later.iter().filter(is_within).count()
        };
        let frozen: usize = recording.frozen.iter().map(in_frozen).sum();
        let samples = repeat.later.len() - frozen;
        // Six coarse numbers may repeat by chance now and then.
        let often = samples >= 10 && samples * 50 >= repeat.readings;
        let samples = if often { samples } else { 0 } + repeat.same_stamp.len();
        if samples > 0 {
            found_repeats.push((name, (samples, repeat.readings)));
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

/// The runs of equal values.
pub(crate) fn runs(values: &[f64]) -> Vec<Range<usize>> {
    let mut end = 0;
    let equal = values.chunk_by(|a, b| a.to_bits() == b.to_bits());
    let run = |own: &[f64]| {
        end += own.len();
        end - own.len()..end
    };
    equal.map(run).collect()
}

/// Stretches in which a joint's torque repeats for longer than chance, coarse quantisation, a
/// turning point or a standstill explain, while the joint moves.
fn dead(track: &JointTrack) -> Vec<(Nanos, Nanos)> {
    /// Greatest probability of a dead stretch in a torque that repeats by chance.
    const CHANCE: f64 = 1e-9;
    let (t, x) = (&track.torque.t, track.torque.column(0));
    let stretches = runs(&x);
    let is_long = |run: &&Range<usize>| t[run.end - 1] - t[run.start] >= FREEZE;
    // The probability that two consecutive samples outside long stretches are equal.
    let repeats = |run: &Range<usize>| run.len() - 1;
    let long: usize = stretches.iter().filter(is_long).map(repeats).sum();
    let equal = stretches.iter().map(repeats).sum::<usize>() - long;
    let others = x.len().saturating_sub(1) - long;
    let often = (equal as f64 + 1.0) / (others as f64 + 2.0);
    let step = quantum(&x);
    let is_dead = |run: &Range<usize>| {
        is_long(&run)
            && often.powf(repeats(run) as f64) < CHANCE
            && steep(&x, run, step).contains(&true)
    };
    // A torque that never changes has no other samples to compare with.
    let all_equal = stretches.len() == 1 && stretches.iter().any(|run| is_long(&run));
    let spans = stretches.iter().filter(|run| is_dead(run) || all_equal);
    spans
        .map(|run| (t[run.start], t[run.end - 1]))
        .filter(|(from, to)| track.range(*from, *to) > MOTION)
        .collect()
}
