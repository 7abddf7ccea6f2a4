//! Delays: time offsets between the stamps of F/T readings or joint torques and those of the
//! encoders.
//!
//! What happens at `t` is stamped `t + delay`. The delay of each stream is an extra parameter,
//! whose column is the negative rate of change of the stream. A fit with all of them gives the
//! delays and their standard deviations, and [`crate::hypothesis`] decides whether they are
//! significant. They are reported, not corrected: a model error may look like a delay.
//!
//! An error of the friction model makes each joint torque seem late by a different time (a real arm
//! with joint torque sensors: 10 to 95 ms, but no delay of all together); and friction and masses
//! that were fitted to late torques absorb most of a delay. So joint torques are one stream. A
//! single torque is reported only if its delay differs from the common one of the others by far
//! more than any of theirs does, and the others together have no delay: the reference is the
//! encoders, not the majority.

use crate::finding::{Finding, FindingCode, Severity};
use crate::fit::{Identified, added};
use crate::hypothesis::deviations;
use crate::measurement::channels::sensor_name;
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::{Residuals, reduce_with, residuals};
use crate::measurement::rows::Rows;
use crate::prior::Posterior;
use crate::report::outcome::TimeOffset;
use crate::training::{TrainingLog, map_segments, sample};

/// Prior standard deviation of a delay \[s\].
const DELAY_STD: f64 = 0.05;

/// Smallest delay that matters \[s\].
const MIN_REPORTED: f64 = 2e-3;

/// A single torque is reported if its delay exceeds that of any other by this factor. (A real arm
/// with joint torque sensors, whose friction makes them seem late, reaches 3.7.)
const SINGLE: f64 = 8.0;

/// Rates are computed over this time before and after an instant \[s\], because friction changes
/// its sign suddenly.
const REACH: f64 = 0.03;

/// Delay and its standard deviation \[s\].
type Delay = (f64, f64);

/// Delays of the streams that parameters were identified from, and findings about them.
pub(crate) fn delays(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    identified: &Identified,
) -> (Vec<TimeOffset>, Vec<Finding>) {
    let (robot, unknowns) = (measurement.robot(), &identified.unknowns);
    let sensors = unknowns.sensors.len();
    let significance = deviations(sensors + unknowns.joints.len() + 1);
    let is_long =
        |(seconds, deviation): Delay| seconds.abs() > MIN_REPORTED.max(significance * deviation);
    let common_streams = fit(measurement, training, identified, false).unwrap_or_default();
    let names = unknowns
        .sensors
        .iter()
        .map(|&sensor| format!("wrench/{}", sensor_name(robot, sensor)));
    let names = names.chain(["joint torques".to_owned()]);
    let offsets: Vec<TimeOffset> = (names.zip(&common_streams))
        // Those about which the logs contain information.
        .filter(|(_, (_, deviation))| *deviation < 0.5 * DELAY_STD)
        .map(|(channel, &(seconds, deviation))| TimeOffset {
            channel,
            seconds,
            deviation,
            significant: is_long((seconds, deviation)),
        })
        .collect();
    let alone = (unknowns.joints.len() > 2)
        .then(|| fit(measurement, training, identified, true))
        .flatten()
        .and_then(|each| alone(&each[sensors..], is_long));
    let mut findings = Vec::new();
    for offset in offsets.iter().filter(|offset| offset.significant) {
        let seem = if offset.channel == "joint torques" {
            "seem"
        } else {
            "seems"
        };
        let seem = format!("{} {seem}", offset.channel);
        findings.push(finding(
            offset.channel.clone(),
            &seem,
            (offset.seconds, offset.deviation),
        ));
    }
    findings.extend(alone.map(|(place, delay)| {
        let joint = format!(
            "joint/{}/torque",
            robot.model.dof_name(unknowns.joints[place])
        );
        let seems = format!("{joint}, unlike the other torques, seems");
        finding(joint, &seems, delay)
    }));
    (offsets, findings)
}

fn finding(subject: String, seem: &str, (seconds, deviation): Delay) -> Finding {
    Finding {
        severity: Severity::Warning,
        code: FindingCode::TimeOffset,
        text: format!(
            "{seem} to be stamped {:.1} ms {} the encoders (+- {:.1} ms). This was not corrected, \
             and friction and parameters have absorbed a part of it: compare the clocks and the \
             filters of the sensors, and correct the stamps",
            1e3 * seconds.abs(),
            if seconds > 0.0 { "behind" } else { "ahead of" },
            1e3 * deviation
        ),
        subject,
    }
}

/// The single torque that has a delay while all others have none.
fn alone(each: &[Delay], is_long: impl Fn(Delay) -> bool) -> Option<(usize, Delay)> {
    // Those about which the logs contain information.
    let known: Vec<usize> = (0..each.len())
        .filter(|&k| each[k].1 < 0.5 * DELAY_STD)
        .collect();
    known.iter().filter(|_| known.len() > 2).find_map(|&place| {
        let others = || known.iter().filter(|&&k| k != place).map(|&k| each[k]);
        let weight: f64 = others().map(|(_, deviation)| deviation.powi(-2)).sum();
        let sum: f64 = others()
            .map(|(seconds, deviation)| seconds * deviation.powi(-2))
            .sum();
        let common = (sum / weight, weight.sqrt().recip());
        let farthest = others()
            .map(|(seconds, _)| (seconds - common.0).abs())
            .fold(0.0, f64::max);
        let own = each[place];
        let apart = (own.0 - common.0, own.1.hypot(common.1));
        let is_alone = is_long(apart) && apart.0.abs() > SINGLE * farthest;
        (is_alone && is_long(own) && !is_long(common)).then_some((place, own))
    })
}

/// The delay of each F/T sensor, then that of all joint torques, or of each one if `apart`.
fn fit(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    identified: &Identified,
    apart: bool,
) -> Option<Vec<Delay>> {
    let unknowns = &identified.unknowns;
    let (sensors, p) = (unknowns.sensors.len(), unknowns.parameters());
    let torques = unknowns
        .joints
        .len()
        .min(if apart { usize::MAX } else { 1 });
    let width = sensors + torques;
    let segments = sample(measurement, training);
    let reduced = map_segments(measurement, &segments, |measurement, _, segment| {
        let residuals: Residuals = residuals(
            measurement,
            segment,
            &identified.noise,
            std::slice::from_ref(&identified.d),
        );
        let instants = segment.instants;
        // The noise-free value of each channel.
        let exact = |channel: usize, i: usize| {
            let measured = match unknowns.sensors.get(channel / 6) {
                Some(&sensor) => instants[i].readings[sensor].torque_first()[channel % 6],
                None => instants[i].torque[unknowns.joints[channel - 6 * sensors]],
            };
            measured - residuals.noise[0][channel][i]
        };
        let around = |number: usize| {
            let t = |i: usize| (instants[i].t - instants[number].t).seconds();
            let before = (0..number).rev().take_while(|&i| t(i) >= -REACH).last();
            let after = (number + 1..instants.len())
                .take_while(|&i| t(i) <= REACH)
                .last();
            // The adjacent ones if instants are farther apart.
            let low = before.unwrap_or(number.saturating_sub(1));
            let high = after.unwrap_or((number + 1).min(instants.len() - 1));
            (low, high, t(high) - t(low))
        };
        let mut columns =
            |_: &mut MeasurementModel<'_>, number: usize, rows: &Rows, slopes: &mut [f64]| {
                let (low, high, span) = around(number);
                let rate = |channel: usize| -> f64 {
                    let rate = (exact(channel, high) - exact(channel, low)) / span;
                    if rate.is_finite() && span < 0.2 {
                        rate
                    } else {
                        0.0
                    }
                };
                let rates: Vec<f64> = (0..unknowns.channels()).map(rate).collect();
                for (row, slopes) in slopes.chunks_exact_mut(width).enumerate() {
                    // A reading enters a row as its offset does.
                    let of_sensors = rows.g(row).chunks_exact(6).zip(rates.chunks_exact(6));
                    for (slope, (g, rates)) in slopes.iter_mut().zip(of_sensors).take(sensors) {
                        *slope = -crate::arithmetic::dot(g, rates);
                    }
                    let joint = rows.n(row)[6 * sensors..].iter().position(|x| *x != 0.0);
                    if let Some(joint) = joint {
                        slopes[sensors + joint % torques] = -rates[6 * sensors + joint];
                    }
                }
            };
        reduce_with(
            measurement,
            segment,
            &identified.noise,
            &[],
            width,
            &mut columns,
        )
    });
    let (r, z) = added(&reduced, p + width).to_triangle();
    let mut precision = unknowns.precision.clone();
    precision.resize(unknowns.extra.len() + width, DELAY_STD.powi(-2));
    let posterior = Posterior::new(&identified.prior, &unknowns.links, &r, &z, &precision);
    let fit = posterior.ok()?.fit(identified.fit.tau).ok()?;
    let root = fit.covariance_root();
    Some(
        (p..p + width)
            .map(|k| (fit.x[k], root.row(k).norm()))
            .collect(),
    )
}
