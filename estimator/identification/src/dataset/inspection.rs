//! Checks the recorded channels one by one: gaps, saturation, units, derivatives, motion.

use crate::dataset::cleaning::{FREEZE, STEEP, label, merged, steep};
use crate::dataset::defects::{Defect, LEAST_ROWS, LEAST_SECONDS, Units};
use crate::dataset::recording::{Recording, SkippedRows};
use crate::dataset::smooth::{Scratch, quantum};
use crate::dataset::stream::{MOTION, Stream, range};
use crate::robot::{AXES, ChannelRole, Robot};
use crate::statistics::median;
use proprio_dynamics::spatial::Wrench;
use proprio_topics::{Nanos, Reason};
use std::ops::Range;

/// Checks all channels.
pub(crate) fn inspect(recording: &mut Recording, robot: &Robot) {
    let mut found = std::mem::take(&mut recording.defects);
    if let Some(SkippedRows { rows, line, reason }) = recording.skipped.clone() {
        found.insert(0, Defect::SkippedRows { rows, line, reason });
    }
    let channels = recording.channels.clone();
    gaps(recording, &channels, &mut found);
    for channel in &channels {
        match channel.role {
            ChannelRole::Joint(dof) => {
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
                let track = &mut recording.joints[dof];
                let derivatives = [
                    ("velocity", 1, &mut track.velocity),
                    ("acceleration", 2, &mut track.acceleration),
                ];
                for (given, order, stream) in derivatives {
                    if let Some(off) = noisy(&track.position, stream, order) {
                        found.push(Defect::NoisyDerivative {
                            joint: joint.clone(),
                            given,
                            off,
                        });
                        *stream = Stream::default();
                    }
                }
                let track = &recording.joints[dof];
                let cut = cut_off(&track.torque, 0, |from, to| recording.moves(from, to, None));
                let torque = &mut recording.joints[dof].torque;
                found.extend(cut.and_then(|cut| saturated(torque, cut, label(channel), "torque")));
            }
            ChannelRole::Sensor(number) => {
                let stream = &recording.sensors[number];
                if stream.t.is_empty() && stream.faulty.is_empty() {
                    found.push(Defect::NeverSeen {
                        channel: label(channel),
                    });
                    continue;
                }
                let marked = |reason| {
                    let of = stream.faulty.iter().filter(|(_, r)| *r == reason);
                    let mut stamps = of.map(|(t, _)| *t);
                    let first = stamps.next()?;
                    Some((first, 1 + stamps.count()))
                };
                if let Some((first, samples)) = marked(Reason::Saturated) {
                    found.push(Defect::Saturated {
                        channel: label(channel),
                        axis: "",
                        samples,
                        first,
                        value: f64::NAN,
                    });
                }
                if let Some((first, samples)) = marked(Reason::Frozen) {
                    found.push(Defect::MarkedFrozen {
                        channel: label(channel),
                        samples,
                        first,
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
            ChannelRole::Base => {}
        }
    }
    units(recording, robot, &mut found);
    motion(recording, &mut found);
    recording.defects = found;
}

fn gaps(recording: &Recording, channels: &[crate::robot::Channel], found: &mut Vec<Defect>) {
    if !recording.stamped {
        return;
    }
    let of_channel = |channel: &crate::robot::Channel| {
        let (stamps, max_gap, spacing) = recording.stamps(channel.role);
        let mut gaps = Vec::new();
        // A log of single postures has no gaps.
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
        // Gaps by exclusion are reported with the reason for the exclusion.
        let is_reported = |(from, to): &(Nanos, Nanos)| {
            let frozen = found.iter().any(|d| match d {
                Defect::Frozen {
                    channel: name,
                    from: f,
                    to: t,
                } => *name == label(channel) && from <= t && to >= f,
                _ => false,
            });
            frozen || recording.has_faulty(channel.role, *from, *to)
        };
        gaps.retain(|gap| !is_reported(gap));
        (label(channel), gaps)
    };
    // Channels with their own rows do not end and begin again at the very same stamps.
    let near = |a: Nanos, b: Nanos| (a - b).0.abs() <= 30_000_000;
    let same = |a: &Vec<(Nanos, Nanos)>, b: &Vec<(Nanos, Nanos)>| {
        a.len() == b.len()
            && a.iter()
                .zip(b)
                .all(|(a, b)| near(a.0, b.0) && near(a.1, b.1))
    };
    let seen = channels
        .iter()
        .filter(|c| !recording.stamps(c.role).0.is_empty());
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

/// Where one quantity is saturated: the value, and the samples. These are stretches of five or more
/// equal samples at the quantity's extreme while the sensor's other quantities change (or, for a
/// single quantity, two such stretches at least).
///
/// A quantity that turns round slowly is flat as well. So at least one stretch must be steeper than
/// that on both sides ([`steep`]). Saturation that escapes this test hides two or three steps,
/// which does no harm. `moves`: whether the robot moves from the one stamp to the other.
fn cut_off<const D: usize>(
    stream: &Stream<D>,
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
    let mut runs: Vec<Range<usize>> = Vec::new();
    for i in 0..values.len() {
        match runs.last_mut() {
            Some(run) if values[run.start].to_bits() == values[i].to_bits() => run.end = i + 1,
            _ => runs.push(i..i + 1),
        }
    }
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
        // A single saturated torque returns to the extreme.
        let enough = if D == 1 { 2 } else { 1 };
        let samples: Vec<usize> = flat.iter().flat_map(|run| (*run).clone()).collect();
        let is_cut = flat.len() >= enough
            && flat
                .iter()
                .any(|run| steep(&values, run, step) == [true; 2]);
        if is_cut && samples.len() > worst.as_ref().map_or(0, |(_, worst)| worst.len()) {
            worst = Some((extreme, samples));
        }
    }
    worst
}

/// Excludes these samples of one quantity as saturated, and reports them.
fn saturated<const D: usize>(
    stream: &mut Stream<D>,
    (value, samples): (f64, Vec<usize>),
    channel: String,
    axis: &'static str,
) -> Option<Defect> {
    let first = stream.t[*samples.first()?];
    stream
        .faulty
        .extend(samples.iter().map(|i| (stream.t[*i], Reason::Saturated)));
    stream.faulty.sort_by_key(|(t, _)| *t);
    stream.retain(|i| samples.binary_search(&i).is_err());
    Some(Defect::Saturated {
        channel,
        axis,
        samples: samples.len(),
        first,
        value,
    })
}

/// The factor by which the given derivative must be multiplied to be that of `of`; None if it fits,
/// or if there is too little motion.
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
        // Mean of the given derivative over the same time.
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

/// The RMS difference of a given derivative from that of the positions, if the positions tell it
/// better: at least half of the difference's square is noise of the given one (its scatter about
/// its own smooth course), and the difference is a tenth of the motion or more. A smaller one
/// changes no torque by more than a tenth of its inertial part.
///
/// Without it, accelerations that a controller differenced raise the error on held-out torques from
/// .7 to 30 %.
fn noisy(position: &Stream<1>, given: &Stream<1>, order: usize) -> Option<f64> {
    const EDGE: f64 = 0.3;
    const MOST: usize = 2000;
    const NOTICEABLE: f64 = 0.1;
    if given.t.len() < 100 || range(position.value.iter().map(|[v]| *v)) < 0.05 {
        return None;
    }
    let (smooth, noise) = (position.smoother(0), given.smoother(0).sigma());
    let mut scratch = Scratch::default();
    let (mut off, mut motion, mut count) = (0.0, 0.0, 0.0);
    for i in (0..given.t.len()).step_by(given.t.len().div_ceil(MOST)) {
        if let Some(own) = smooth.at(given.t[i], order..=order, EDGE, &mut scratch) {
            off += (given.value[i][0] - own[order]).powi(2);
            motion += own[order].powi(2);
            count += 1.0;
        }
    }
    let is_noise = 2.0 * noise * noise * count > off;
    (is_noise && off > NOTICEABLE.powi(2) * motion).then(|| (off / count).sqrt())
}

fn units(recording: &Recording, robot: &Robot, found: &mut Vec<Defect>) {
    let mut degrees = (Vec::new(), 0.0_f64);
    let weight = 9.80665
        * robot
            .model
            .inertias()
            .iter()
            .map(|i| i.parameters()[0])
            .sum::<f64>();
    for channel in &recording.channels {
        match channel.role {
            ChannelRole::Joint(dof) => {
                let limits = robot
                    .model
                    .dof_joint(dof)
                    .and_then(|j| robot.model.limits(j));
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
                    if most(1.0) > 2.0 * reach
                        && most(1.0) > 6.3
                        && most(1.0_f64.to_radians()) <= 1.1 * reach
                    {
                        degrees.0.push(label(channel));
                        degrees.1 = degrees.1.max(most(1.0));
                    }
                }
            }
            ChannelRole::Sensor(number) => {
                let norm = |from: usize| {
                    // A configured gain may convert counts to newtons.
                    let corrected = |[fx, fy, fz, tx, ty, tz]: &[f64; 6]| {
                        let raw = Wrench::from_parts([*fx, *fy, *fz], [*tx, *ty, *tz]);
                        robot.calibrations[number]
                            .apply(&raw, f64::NAN)
                            .force_first()
                    };
                    let of = |v: &[f64; 6]| {
                        corrected(v)[from..from + 3]
                            .iter()
                            .map(|x| x * x)
                            .sum::<f64>()
                            .sqrt()
                    };
                    median(recording.sensors[number].value.iter().map(of).collect())
                };
                let (force, torque) = (norm(0), norm(3));
                let magnitude = if force > 100.0 * weight {
                    force
                } else {
                    torque
                };
                if magnitude > 100.0 * weight {
                    found.push(Defect::WrongUnits {
                        channels: vec![label(channel)],
                        units: Units::Counts,
                        magnitude,
                    });
                }
            }
            ChannelRole::Base => {
                let of = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
                let magnitude = median(
                    recording
                        .imu
                        .proper_acceleration
                        .value
                        .iter()
                        .map(of)
                        .collect(),
                );
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
    let rows = recording.rows;
    // The last row lasts as long as the others: 200 rows at 100 Hz are 2 s, from 0 to 1.99.
    let seconds =
        recording.duration().seconds() * (1.0 + 1.0 / rows.max(2).saturating_sub(1) as f64) + 1e-9;
    if (recording.stamped && seconds < LEAST_SECONDS) || (!recording.stamped && rows < LEAST_ROWS) {
        let kept = recording.longest_stream();
        let backward = found.iter().find_map(|defect| match defect {
            Defect::Stamps {
                backward, first, ..
            } if *backward > kept => Some(*first),
            _ => None,
        });
        found.push(Defect::TooShort {
            seconds,
            rows,
            backward,
        });
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
    let changes = |stream: &Stream<3>, by: f64| {
        (0..3).any(|axis| range(stream.value.iter().map(|value| value[axis])) > by)
    };
    let rotates = changes(&imu.angular_velocity, 0.1) || changes(&imu.proper_acceleration, 1.0);
    if !rotates {
        found.push(Defect::NoMotion { most });
    }
}
