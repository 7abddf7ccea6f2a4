//! Checks the recorded channels one by one: gaps, saturation, units, derivatives, motion.

use crate::dataset::cleaning::{FREEZE, STEEP, label, merged, runs, steep};
use crate::dataset::recording::{Recording, SkippedRows};
use crate::dataset::smooth::{Scratch, quantum};
use crate::dataset::stream::{MOTION, SampleStream, range};
use crate::finding::{Finding, FindingCode};
use crate::robot::{AXES, Channel, ChannelRole, Robot};
use crate::statistics::median;
use proprio_topics::{Nanos, Reason};
use std::ops::Range;

/// Least duration of a log \[s\], and least number of rows of a log without stamps.
const LEAST_SECONDS: f64 = 2.0;
const LEAST_ROWS: u64 = 20;

/// Least number of samples of a derivative that is compared.
const LEAST_COMPARED: usize = 100;

/// Checks all channels.
pub(crate) fn inspect(recording: &mut Recording, robot: &Robot) {
    let mut found = std::mem::take(&mut recording.findings);
    if let Some(SkippedRows { rows, line, reason }) = recording.skipped.clone() {
        let text = format!(
            "{rows} rows cannot be read and were skipped; the first: line {line}: {reason}"
        );
        found.insert(0, Finding::warning(FindingCode::SkippedRows, "", text));
    }
    let channels = recording.channels.clone();
    gaps(recording, &channels, &mut found);
    for channel in &channels {
        match channel.role {
            ChannelRole::Joint(dof) => inspect_joint(recording, dof, channel, &mut found),
            ChannelRole::Sensor(number) => inspect_sensor(recording, number, channel, &mut found),
            ChannelRole::Base => {}
        }
    }
    units(recording, robot, &mut found);
    motion(recording, &mut found);
    recording.findings = found;
}

fn inspect_joint(
    recording: &mut Recording,
    dof: usize,
    channel: &Channel,
    found: &mut Vec<Finding>,
) {
    let (track, joint) = (&mut recording.joints[dof], &channel.name);
    if recording.stamped && range(track.position.value.iter().map(|[v]| *v)) == 0.0 {
        let channel = label(channel);
        let text = format!(
            "{channel} never changes: the joint stands still, or its encoder is dead; parameters \
             that need its motion keep their URDF values"
        );
        found.push(Finding::note(FindingCode::JointStill, channel, text));
    }
    // The velocity is the better reference for the acceleration, if it is a good one.
    let mut reference = (track.position.clone(), 0);
    let derivatives = [
        ("velocity", "rad/s", 1, &mut track.velocity),
        ("acceleration", "rad/s^2", 2, &mut track.acceleration),
    ];
    for (given, unit, order, stream) in derivatives {
        let text = match wrong_derivative(&reference.0, stream, order - reference.1) {
            None => {
                if order == 1 && stream.t.len() >= LEAST_COMPARED {
                    reference = (stream.clone(), 1);
                }
                continue;
            }
            Some(Wrong::Factor(factor)) => format!(
                "joint/{joint}: the logged {given} must be multiplied by {factor:.4} to match the \
                 derivative of the position: check its unit and sign, or remove the column"
            ),
            Some(Wrong::Noise(off)) => {
                *stream = SampleStream::default();
                format!(
                    "joint/{joint}: the logged {given} is not that of the {}: {off:.3} {unit} off, \
                     most of it noise; it is not used",
                    ["positions", "velocities"][reference.1]
                )
            }
        };
        found.push(Finding::warning(FindingCode::Derivative, joint, text));
    }
    let track = &recording.joints[dof];
    let cut = cut_off(&track.torque, 0, |from, to| recording.moves(from, to, None));
    let torque = &mut recording.joints[dof].torque;
    found.extend(cut.and_then(|cut| saturated(torque, cut, label(channel), "torque")));
}

fn inspect_sensor(
    recording: &mut Recording,
    number: usize,
    channel: &Channel,
    found: &mut Vec<Finding>,
) {
    let (stream, name) = (&recording.sensors[number], label(channel));
    if stream.t.is_empty() && stream.faulty.is_empty() {
        let text = format!(
            "{name} is in the configuration but has no sample: everything that needs it is \
             excluded; record it, or remove it from the configuration"
        );
        found.push(Finding::warning(FindingCode::NeverSeen, name, text));
        return;
    }
    let marked = |reason| {
        let samples = stream.faulty.iter().filter(|(_, r)| *r == reason);
        let mut stamps = samples.map(|(t, _)| *t);
        let first = stamps.next()?;
        Some((first, 1 + stamps.count()))
    };
    if let Some((first, samples)) = marked(Reason::Saturated) {
        let text = format!("{name} reports saturation {}", at(samples, first));
        found.push(Finding::warning(FindingCode::Saturated, &name, text));
    }
    if let Some((first, samples)) = marked(Reason::Frozen) {
        let text = format!(
            "{name} is frozen in {samples} samples, the first at {first} s: its board repeats its \
             readings instead of measuring; they are excluded; check the board, its cable and its \
             temperature, and switch it off and on"
        );
        found.push(Finding::warning(FindingCode::Frozen, &name, text));
    }
    for (axis, word) in AXES.into_iter().enumerate() {
        let stream = &recording.sensors[number];
        let cut = cut_off(stream, axis, |from, to| recording.moves(from, to, None));
        let stream = &mut recording.sensors[number];
        found.extend(cut.and_then(|cut| saturated(stream, cut, name.clone(), word)));
    }
}

fn gaps(recording: &Recording, channels: &[Channel], found: &mut Vec<Finding>) {
    if !recording.stamped {
        return;
    }
    let of_channel = |channel: &Channel| {
        let (stamps, max_gap, spacing) = recording.stamps(channel.role);
        let mut gaps = Vec::new();
        // A log of single postures has no gaps.
        if spacing <= max_gap
            && let (Some(first), Some(last)) = (stamps.first(), stamps.last())
        {
            let late = max_gap.max(recording.max_silence);
            gaps.extend((*first - recording.first > late).then_some((recording.first, *first)));
            let apart = stamps.windows(2).filter(|w| w[1] - w[0] > max_gap);
            gaps.extend(apart.map(|w| (w[0], w[1])));
            gaps.extend((recording.last - *last > late).then_some((*last, recording.last)));
        }
        // Gaps by exclusion are reported with the reason for the exclusion.
        let is_reported = |(from, to): &(Nanos, Nanos)| {
            let mut frozen = recording.frozen.iter();
            frozen.any(|(name, f, t)| *name == label(channel) && from <= t && to >= f)
                || recording.has_faulty(channel.role, *from, *to)
        };
        gaps.retain(|gap| !is_reported(gap));
        (label(channel), gaps)
    };
    // Channels with their own rows do not end and begin again at the very same stamps.
    let near = |a: Nanos, b: Nanos| (a - b).0.abs() <= 30_000_000;
    let same = |a: &Vec<(Nanos, Nanos)>, b: &Vec<(Nanos, Nanos)>| {
        let mut pairs = a.iter().zip(b);
        a.len() == b.len() && pairs.all(|(a, b)| near(a.0, b.0) && near(a.1, b.1))
    };
    let seen = (channels.iter()).filter(|c| !recording.stamps(c.role).0.is_empty());
    let all = merged(seen.map(of_channel).collect(), same);
    for (channel, gaps) in all {
        if let Some(longest) = gaps.iter().max_by_key(|(from, to)| *to - *from) {
            let total = Nanos(gaps.iter().map(|(from, to)| (*to - *from).0).sum());
            let text = format!(
                "{channel} has no samples for {:.3} s in {} gaps, the longest of {:.3} s from {} s \
                 on: these times are excluded",
                total.seconds(),
                gaps.len(),
                (longest.1 - longest.0).seconds(),
                longest.0
            );
            found.push(Finding::warning(FindingCode::Gap, channel, text));
        }
    }
}

/// Where one quantity is saturated: the value, and the samples. These are stretches of five or more
/// equal samples at the quantity's extreme while the sensor's other quantities change (or, for a
/// single quantity, two such stretches at least).
///
/// A quantity that turns round slowly is flat as well. So at least one stretch must be steeper than
/// that on both sides ([`steep`]). Saturation that escapes this test hides two or three steps,
/// which does no harm. `moves`: whether the robot moves from the one stamp to the other.
fn cut_off<const D: usize>(
    stream: &SampleStream<D>,
    axis: usize,
    moves: impl Fn(Nanos, Nanos) -> bool,
) -> Option<(f64, Vec<usize>)> {
    /// Least number of samples of a flat stretch.
    const FLAT: usize = 5;
    let values = stream.column(axis);
    let step = quantum(&values);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    if values.len() < 20 || high - low <= 50.0 * step {
        return None;
    }
    // A torque that is recorded faster than it is measured repeats everywhere.
    let runs = runs(&values);
    let usual = median(runs.iter().map(|run| run.len() as f64).collect());
    let is_long =
        |run: &&Range<usize>| run.len() >= FLAT && run.len() as f64 >= FLAT as f64 * usual;
    let others_change = |run: &&Range<usize>| {
        let changes = |j: &usize| {
            (0..D).any(|k| {
                k != axis && stream.value[*j][k].to_bits() != stream.value[*j - 1][k].to_bits()
            })
        };
        D == 1 || (run.start + 1..run.end).filter(changes).count() * 2 > run.len() - 1
    };
    // A robot at rest also has readings at an extreme, and its other quantities change by noise
    // only, unless something leans on it.
    let rests = |run: &&Range<usize>| {
        let (from, to) = (stream.t[run.start], stream.t[run.end - 1]);
        let loaded = |k: usize| {
            let values = || stream.value[run.start..run.end].iter().map(|v| v[k]);
            let changes = values().zip(values().skip(1)).map(|(a, b)| (b - a).abs());
            let changes: Vec<f64> = changes.filter(|change| *change > 0.0).collect();
            let usual = changes.iter().sum::<f64>() / changes.len().max(1) as f64;
            k != axis && range(values()) > STEEP * usual
        };
        to - from >= FREEZE && !moves(from, to) && !(0..D).any(loaded)
    };
    let mut worst: Option<(f64, Vec<usize>)> = None;
    for extreme in [low, high] {
        let is_at = |run: &&Range<usize>| values[run.start].to_bits() == extreme.to_bits();
        let flat = runs.iter().filter(is_at).filter(is_long);
        let flat = flat.filter(others_change).filter(|run| !rests(run));
        let flat: Vec<&Range<usize>> = flat.collect();
        // A single saturated torque returns to the extreme.
        let enough = if D == 1 { 2 } else { 1 };
        let samples: Vec<usize> = flat.iter().flat_map(|run| (*run).clone()).collect();
        let is_steep = |run: &&Range<usize>| steep(&values, run, step) == [true; 2];
        let is_cut = flat.len() >= enough && flat.iter().any(is_steep);
        if is_cut && samples.len() > worst.as_ref().map_or(0, |(_, worst)| worst.len()) {
            worst = Some((extreme, samples));
        }
    }
    worst
}

/// Excludes these samples of one quantity as saturated, and reports them.
fn saturated<const D: usize>(
    stream: &mut SampleStream<D>,
    (value, samples): (f64, Vec<usize>),
    channel: String,
    axis: &'static str,
) -> Option<Finding> {
    let first = stream.t[*samples.first()?];
    let faulty = samples.iter().map(|i| (stream.t[*i], Reason::Saturated));
    stream.faulty.extend(faulty);
    stream.faulty.sort_by_key(|(t, _)| *t);
    stream.retain(|i, _| samples.binary_search(&i).is_err());
    let text = format!(
        "{channel}: {axis} is saturated at {value} {}",
        at(samples.len(), first)
    );
    Some(Finding::warning(FindingCode::Saturated, channel, text))
}

/// Which samples are saturated, and what to do.
fn at(samples: usize, first: Nanos) -> String {
    format!(
        "in {samples} samples, the first at {first} s: they are excluded; move more gently or use \
         a larger range"
    )
}

/// What is wrong with a recorded derivative.
enum Wrong {
    /// It must be multiplied by this.
    Factor(f64),
    /// It is mostly noise: RMS of its difference from the derivative of the positions.
    Noise(f64),
}

/// Compares a recorded derivative with that of a reference; none if it fits, or if there is too
/// little motion. It has another unit or sign if it follows the reference's by another factor. The
/// reference tells it better if at least half of the square of the difference is noise of the
/// given one (its scatter about its own smooth course), and the difference is a tenth of the motion
/// or more. A smaller one changes no torque by more than a tenth of its inertial part.
///
/// Without it, accelerations that a controller differenced raise the error on held-out torques from
/// .7 to 30 %.
fn wrong_derivative(
    reference: &SampleStream<1>,
    given: &SampleStream<1>,
    order: usize,
) -> Option<Wrong> {
    const MOST: usize = 2000;
    const NOTICEABLE: f64 = 0.1;
    if given.t.len() < LEAST_COMPARED || range(reference.value.iter().map(|[v]| *v)) < 0.05 {
        return None;
    }
    let (smooth, noise) = (reference.smoother(0), given.smoother(0).sigma());
    let mut scratch = Scratch::default();
    // Squares and product of the given one and that of the positions.
    let (mut uu, mut uv, mut vv, mut count) = (0.0, 0.0, 0.0, 0.0);
    for i in (0..given.t.len()).step_by(given.t.len().div_ceil(MOST)) {
        if let Some(own) = smooth.at(given.t[i], order..=order, &mut scratch) {
            let (u, v) = (given.value[i][0], own[order]);
            (uu, uv, vv, count) = (uu + u * u, uv + u * v, vv + v * v, count + 1.0);
        }
    }
    let (factor, off) = (uv / uu, uu - 2.0 * uv + vv);
    if uv.abs() > 0.8 * (uu * vv).sqrt() && !(0.8..=1.25).contains(&factor) {
        return Some(Wrong::Factor(factor));
    }
    let is_noise = 2.0 * noise * noise * count > off;
    (is_noise && off > NOTICEABLE.powi(2) * vv).then(|| Wrong::Noise((off / count).sqrt()))
}

fn units(recording: &Recording, robot: &Robot, found: &mut Vec<Finding>) {
    let mut degrees = (Vec::new(), 0.0_f64);
    let mut refuse = |channels: String, text: &str| {
        let text = format!("{channels}: {text}");
        found.push(Finding::refusal(FindingCode::WrongUnits, channels, text));
    };
    for channel in &recording.channels {
        match channel.role {
            ChannelRole::Joint(dof) => {
                let joint = robot.model.dof_joint(dof);
                let positions = recording.joints[dof].position.value.iter();
                let most = positions.map(|[q]| q.abs()).fold(0.0, f64::max);
                if let Some(limits) = joint.and_then(|joint| robot.model.limits(joint)) {
                    let reach = limits.lower.abs().max(limits.upper.abs());
                    if most > 2.0 * reach && most > 6.3 && most.to_radians() <= 1.1 * reach {
                        degrees.0.push(label(channel));
                        degrees.1 = degrees.1.max(most);
                    }
                }
            }
            // Their units are compared with what CAD predicts.
            ChannelRole::Sensor(_) => {}
            ChannelRole::Base => {
                let norm = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
                let accelerations = recording.imu.proper_acceleration.value.iter();
                let magnitude = median(accelerations.map(norm).collect());
                if !(3.0..=30.0).contains(&magnitude) {
                    let text = format!(
                        "a typical proper acceleration of {magnitude:.4} m/s^2 is not near 9.8: \
                         convert it to m/s^2"
                    );
                    refuse(label(channel), &text);
                }
            }
        }
    }
    if !degrees.0.is_empty() {
        let text = format!(
            "positions up to {:.4} rad are far beyond the URDF's limits, but within them as \
             degrees: convert all joints to radians",
            degrees.1
        );
        refuse(degrees.0.join(", "), &text);
    }
}

fn motion(recording: &Recording, found: &mut Vec<Finding>) {
    let rows = recording.rows;
    // The last row lasts as long as the others: 200 rows at 100 Hz are 2 s, from 0 to 1.99.
    let seconds =
        recording.duration().seconds() * (1.0 + 1.0 / rows.max(2).saturating_sub(1) as f64) + 1e-9;
    if (recording.stamped && seconds < LEAST_SECONDS) || (!recording.stamped && rows < LEAST_ROWS) {
        let kept = recording.longest_stream();
        let backward = recording.backward.filter(|(samples, _)| *samples > kept);
        let text = if let Some((_, at)) = backward {
            format!(
                "its time runs backward, first at {at} s: in order are only {seconds:.2} s of its \
                 {rows} rows; t must grow from row to row: sort the rows, or correct the \
                 recorder's clock"
            )
        } else if seconds > 0.0 && recording.stamped {
            format!(
                "the log of {seconds:.2} s ({rows} rows) is too short: record at least \
                 {LEAST_SECONDS} s of motion, better 30 s"
            )
        } else {
            format!("the log of {rows} rows is too short: record at least {LEAST_ROWS}")
        };
        found.push(Finding::refusal(FindingCode::TooShort, "", text));
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
    // The gyroscope shows motion, the accelerometer that gravity turns from pose to pose.
    let imu = &recording.imu;
    let changes = |stream: &SampleStream<3>, by: f64| {
        (0..3).any(|axis| range(stream.value.iter().map(|value| value[axis])) > by)
    };
    let rotates = changes(&imu.angular_velocity, 0.1) || changes(&imu.proper_acceleration, 1.0);
    if !rotates {
        let text = format!(
            "no joint moves by more than {most:.4} rad: without motion, weights are not separable \
             from offsets; record motion"
        );
        found.push(Finding::refusal(FindingCode::NoMotion, "", text));
    }
}
