//! Streams that are stamped otherwise than the encoders: those of F/T sensors, and joint torques.
//!
//! What happens at `t` is stamped `t + delay`. Of each stream that is one more unknown beside the
//! parameters, whose column is the rate at which the stream changes, less; the fit with all of them
//! says how long delays are and how sure that is, and [`super::hypothesis`] whether they are there.
//! They are told, not removed: what looks like a delay may be a model that is wrong.
//!
//! Friction that is not as the model has it makes each joint's torque seem late by a time of its own (a
//! real arm with joint torque sensors: 10 to 95 ms, where together they say none); and friction and
//! masses that were fitted to late torques hide most of it. So torques are taken together, as one
//! stream; and one is named only if it seems later (or earlier) than the others have in common by far
//! more than any of these, and these others, together, are on time: who is late is told by the encoders,
//! and not by a majority.

use super::assess::sensor_name;
use super::batch::{Identified, Prepared, added, over, sample};
use super::hypothesis::deviations;
use super::outcome::{Finding, Severity, TimeOffset};
use super::passes::{Residuals, leave, tell_with};
use super::prior::Posterior;
use super::rows::{RowMaker, Rows};

/// Expected of a delay before anything is measured, one standard deviation \[s\].
const SPREAD: f64 = 0.05;

/// Less does no harm \[s\].
const LEAST: f64 = 2e-3;

/// One torque is named if its delay is so many times as long as that of any other (of a real arm with
/// joint torque sensors, whose friction makes them seem late, up to 3.7 times).
const ALONE: f64 = 8.0;

/// Rates are taken over this time before and after \[s\]: friction changes its sign at once.
const REACH: f64 = 0.03;

/// How long, and how sure that is \[s\].
type Delay = (f64, f64);

/// How late the streams are that parameters were identified from; and what there is to say of it.
pub(super) fn delays(
    maker: &RowMaker<'_>,
    training: &[&Prepared],
    identified: &Identified,
) -> (Vec<TimeOffset>, Vec<Finding>) {
    let (setup, layout) = (maker.setup(), &identified.layout);
    let sensors = layout.sensors.len();
    let farther = deviations(sensors + layout.joints.len() + 1);
    let is_long = |(seconds, deviation): Delay| seconds.abs() > LEAST.max(farther * deviation);
    let together = fit(maker, training, identified, false).unwrap_or_default();
    let names = layout
        .sensors
        .iter()
        .map(|&sensor| format!("wrench/{}", sensor_name(setup, sensor)));
    let names = names.chain(["joint torques".to_owned()]);
    let offsets: Vec<TimeOffset> = (names.zip(&together))
        // Of which the logs tell more than was known before.
        .filter(|(_, (_, deviation))| *deviation < 0.5 * SPREAD)
        .map(|(channel, &(seconds, deviation))| TimeOffset {
            channel,
            seconds,
            deviation,
            significant: is_long((seconds, deviation)),
        })
        .collect();
    let alone = (layout.joints.len() > 2)
        .then(|| fit(maker, training, identified, true))
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
        let joint = format!("joint/{}/torque", setup.model.dof_name(layout.joints[place]));
        let seems = format!("{joint}, unlike the other torques, seems");
        finding(joint, &seems, delay)
    }));
    (offsets, findings)
}

fn finding(subject: String, seem: &str, (seconds, deviation): Delay) -> Finding {
    Finding {
        severity: Severity::Warning,
        code: "time_offset",
        text: format!(
            "{seem} to be stamped {:.1} ms {} the encoders (+- {:.1} ms); nothing was corrected, and \
             friction and parameters have taken up a part of it: compare the clocks, or the filters of \
             the sensors, and correct the stamps",
            1e3 * seconds.abs(),
            if seconds > 0.0 { "behind" } else { "ahead of" },
            1e3 * deviation
        ),
        subject,
    }
}

/// The one of these torques that is late while all others are on time.
fn alone(each: &[Delay], is_long: impl Fn(Delay) -> bool) -> Option<(usize, Delay)> {
    // Those of which the logs tell more than was known before.
    let known: Vec<usize> = (0..each.len()).filter(|&k| each[k].1 < 0.5 * SPREAD).collect();
    known.iter().filter(|_| known.len() > 2).find_map(|&place| {
        let others = || known.iter().filter(|&&k| k != place).map(|&k| each[k]);
        let weight: f64 = others().map(|(_, deviation)| deviation.powi(-2)).sum();
        let sum: f64 = others().map(|(seconds, deviation)| seconds * deviation.powi(-2)).sum();
        let common = (sum / weight, weight.sqrt().recip());
        let farthest = others()
            .map(|(seconds, _)| (seconds - common.0).abs())
            .fold(0.0, f64::max);
        let own = each[place];
        let apart = (own.0 - common.0, own.1.hypot(common.1));
        let is_alone = is_long(apart) && apart.0.abs() > ALONE * farthest;
        (is_alone && is_long(own) && !is_long(common)).then_some((place, own))
    })
}

/// How long after the encoders each F/T sensor is stamped, then all joint torques, or each one's if they
/// are taken `apart`.
fn fit(maker: &RowMaker<'_>, training: &[&Prepared], identified: &Identified, apart: bool) -> Option<Vec<Delay>> {
    let layout = &identified.layout;
    let (sensors, p) = (layout.sensors.len(), layout.unknowns());
    let torques = layout.joints.len().min(if apart { usize::MAX } else { 1 });
    let width = sensors + torques;
    let pieces = sample(maker, training);
    let told = over(maker, &pieces, |maker, _, piece| {
        let left: Residuals = leave(maker, piece, &identified.noise, std::slice::from_ref(&identified.d));
        let instants = piece.instants;
        // What each channel would have read without noise.
        let exact = |channel: usize, i: usize| {
            let measured = match layout.sensors.get(channel / 6) {
                Some(&sensor) => instants[i].readings[sensor].torque_first()[channel % 6],
                None => instants[i].torque[layout.joints[channel - 6 * sensors]],
            };
            measured - left.noise[0][channel][i]
        };
        let around = |number: usize| {
            let t = |i: usize| (instants[i].t - instants[number].t).seconds();
            let before = (0..number).rev().take_while(|&i| t(i) >= -REACH).last();
            let after = (number + 1..instants.len()).take_while(|&i| t(i) <= REACH).last();
            // Of a log with rows farther apart the next ones.
            let low = before.unwrap_or(number.saturating_sub(1));
            let high = after.unwrap_or((number + 1).min(instants.len() - 1));
            (low, high, t(high) - t(low))
        };
        let mut columns = |_: &mut RowMaker<'_>, number: usize, rows: &Rows, slopes: &mut [f64]| {
            let (low, high, span) = around(number);
            let rate = |channel: usize| -> f64 {
                let rate = (exact(channel, high) - exact(channel, low)) / span;
                if rate.is_finite() && span < 0.2 { rate } else { 0.0 }
            };
            let rates: Vec<f64> = (0..layout.channels()).map(rate).collect();
            for (row, slopes) in slopes.chunks_exact_mut(width).enumerate() {
                // A reading is in a row as its offset is.
                let of_sensors = rows.g(row).chunks_exact(6).zip(rates.chunks_exact(6));
                for (slope, (g, rates)) in slopes.iter_mut().zip(of_sensors).take(sensors) {
                    *slope = -super::dot(g, rates);
                }
                let joint = rows.n(row)[6 * sensors..].iter().position(|x| *x != 0.0);
                if let Some(joint) = joint {
                    slopes[sensors + joint % torques] = -rates[6 * sensors + joint];
                }
            }
        };
        tell_with(maker, piece, &identified.noise, &[], width, &mut columns)
    });
    let (r, z) = added(&told, p + width).to_triangle();
    let mut precision = layout.precision.clone();
    precision.resize(layout.further.len() + width, SPREAD.powi(-2));
    let posterior = Posterior::new(&identified.prior, &layout.links, &r, &z, &precision);
    let fit = posterior.ok()?.fit(identified.fit.tau).ok()?;
    let root = fit.covariance_root();
    Some((p..p + width).map(|k| (fit.x[k], root.row(k).norm())).collect())
}
