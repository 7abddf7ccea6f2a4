//! Undeclared disturbances of the robot in a recorded log: contacts.
//!
//! The test follows a fit: a fit to all of the log absorbs most of CAD's errors, which therefore do
//! not look like contacts. The scale is the log's own usual residual: model errors and structural
//! vibration are present all the time and grow with motion; a contact is a temporary, large
//! residual.
//!
//! Per part of the robot (a sub-tree between F/T sensors, or all measured joint torques) and block
//! of 0.1 s, the whitened square of the mean residual is compared with that of blocks in
//! which the robot moves as much. Outlying blocks are excluded with a margin, and the fit is
//! repeated ([`crate::identify`]) until the excluded set does not change.
//!
//! See also [`crate::diagnose::load`] (a body that is picked up or put down). A sensor's offset
//! that jumps is excluded as a contact is, from the jump on: to start the offset afresh there
//! instead predicted another log with an error of .32, against .06, where a jump of 10 N was
//! simulated.

use crate::dataset::observation::{Annotated, Observation, SubtreeSet};
use crate::diagnose::load::LoadChange;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{LogSegment, residuals};
use crate::prepared_log::{PreparedLog, SEGMENT_INSTANTS};
use crate::statistics::chi_square;
use crate::statistics::quantile;
use nalgebra::DVector;

/// Normal deviate beyond which a block's square is outlying: one block in three million by chance.
///
/// With the two constants below, the threshold for six channels is 39 times the usual square. Real
/// logs without contacts, a leg of cables and a torque-controlled arm, reach 12 to 24 times; pushes
/// of 5 N at a hand with the arm's board 80 and more.
const OUTLYING: f64 = 5.0;

/// Factor by which the variance of model errors varies among blocks with the same motion.
const VARIES: f64 = 3.5;

/// Most degrees of freedom of a block's square, those of a wrench.
const FREE: usize = 6;

/// The quantile that is called usual, three in ten, so that contacts may last most of the time; and
/// the normal deviate with this probability below it.
const USUAL: f64 = 0.3;
const USUAL_DEVIATE: f64 = -0.524_400_5;

/// Blocks before and after an outlying one that are excluded, too: a contact begins and ends
/// gradually.
const MARGIN: usize = 2;

/// Most rounds of level, scale and outlying blocks.
const ROUNDS: usize = 20;

/// Where a larger fraction of the blocks is outlying, no contact is reported: model and log are
/// then not of the same robot.
const MAX_OUTLYING_FRACTION: f64 = 0.7;

/// Half of the window whose median is the level of a channel [blocks]: an offset drifts more
/// slowly, a contact is shorter.
const WINDOW: usize = 150;

/// Per log and instant, the sub-trees on which an undeclared contact acts. The spans of `loads` are
/// not tested.
pub(crate) fn contacts(
    measurement: &MeasurementModel<'_>,
    all: &[&PreparedLog],
    loads: &[LoadChange],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<Vec<SubtreeSet>> {
    // Long logs in parts, so that all cores have work; of at least a minute, so that a contact does
    // not last for most of it.
    let mut segments = Vec::new();
    for (number, log) in all.iter().enumerate() {
        let minutes = ((log.span.1 - log.span.0).seconds() / 60.0) as usize;
        let count = log.instants.len().div_ceil(SEGMENT_INSTANTS);
        let count = count.min(minutes).max(1);
        let at = |part: usize| log.instants.len() * part / count;
        for part in 0..count {
            let instants = &log.instants[at(part)..at(part + 1)];
            segments.push((number, LogSegment::alone(instants)));
        }
    }
    let found = measurement.map(&segments, |measurement, (log, segment)| {
        let log_loads: Vec<&LoadChange> = loads.iter().filter(|load| load.log == *log).collect();
        of_segment(measurement, *segment, &log_loads, noise, d)
    });
    let mut out = vec![Vec::new(); all.len()];
    for ((log, _), found) in segments.iter().zip(found) {
        out[*log].extend(found);
    }
    out
}

fn of_segment(
    measurement: &mut MeasurementModel<'_>,
    segment: LogSegment<'_>,
    loads: &[&LoadChange],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<SubtreeSet> {
    let unknowns = measurement.unknowns();
    let residuals = residuals(measurement, segment, noise, std::slice::from_ref(d));
    let subtrees = 0..measurement.robot().structure.subtrees().len();
    let pass = SubtreePass {
        subtrees: subtrees.chain([Observation::TORQUES]).collect(),
        loads,
        variances: noise.offset_tracking_variances(),
        d,
        // The median of each offset: the offset itself may have followed a contact, and would hide
        // it.
        nuisance: DVector::from_fn(unknowns.nuisance(), |unknown, _| {
            let blocks = residuals.nuisance.iter();
            quantile(blocks.map(|block| block.x[(unknown, 0)]).collect(), 0.5)
        }),
    };
    measurement.include_disturbed(true);
    let (mut means, mut motion) = (Vec::new(), Vec::new());
    for range in &residuals.ranges {
        let instants = &segment.instants[range.clone()];
        let square = |instant: &Annotated| instant.velocity.iter().map(|v| v * v).sum::<f64>();
        let all = instants.iter().map(square);
        motion.push(all.fold(0.0, |sum, own| sum + own / instants.len() as f64));
        means.push(pass.means(measurement, instants));
    }
    measurement.include_disturbed(false);
    let mut out = vec![SubtreeSet::default(); segment.instants.len()];
    for (number, &subtree) in pass.subtrees.iter().enumerate() {
        let (mut series, mut least) = (Vec::new(), Vec::new());
        for (channel, channel_least) in noise.least.iter().enumerate() {
            let channel_means: Vec<f64> = means.iter().map(|mean| mean[number][channel]).collect();
            if channel_means.iter().any(|x| x.is_finite()) {
                series.push(channel_means);
                least.push(*channel_least);
            }
        }
        let outlier = outlying(&series, &motion, &least);
        let count = outlier.iter().filter(|outlier| **outlier).count();
        if count as f64 / outlier.len().max(1) as f64 > MAX_OUTLYING_FRACTION {
            continue;
        }
        let blocks = residuals.ranges.iter().zip(&outlier);
        for (range, _) in blocks.filter(|(_, outlier)| **outlier) {
            (out[range.clone()].iter_mut()).for_each(|set| set.insert(subtree));
        }
    }
    out
}

/// The pass over a segment for the residuals of each sub-tree.
struct SubtreePass<'a> {
    subtrees: Vec<usize>,
    loads: &'a [&'a LoadChange],
    variances: Vec<f64>,
    d: &'a DVector<f64>,
    nuisance: DVector<f64>,
}

impl SubtreePass<'_> {
    /// Per sub-tree and channel, the mean over a block of the channel's most likely noise, offset
    /// drift included, from the sub-tree's rows alone; NaN where it has none.
    fn means(
        &self,
        measurement: &mut MeasurementModel<'_>,
        instants: &[Annotated],
    ) -> Vec<Vec<f64>> {
        let channels = self.variances.len();
        let mut sums = vec![vec![(0.0, 0.0); channels]; self.subtrees.len()];
        for instant in instants {
            let rows = measurement.rows(instant);
            for (&subtree, sums) in self.subtrees.iter().zip(&mut sums) {
                let carries =
                    |load: &&LoadChange| load.subtrees.contains(subtree) && load.has(instant.t);
                if self.loads.iter().any(carries) {
                    continue;
                }
                let mut rows = rows.of_unit(subtree);
                let (d, nuisance) = (self.d.as_slice(), self.nuisance.as_slice());
                let residuals = (0..rows.count).map(|row| rows.residual(row, d, nuisance));
                let mut white: Vec<f64> = residuals.collect();
                rows.whiten_with(&self.variances, &mut white, 1);
                let noise = rows.channel_noise(&self.variances, white);
                for channel in (0..channels).filter(|&channel| rows.has(channel)) {
                    sums[channel].0 += noise[channel];
                    sums[channel].1 += 1.0;
                }
            }
        }
        let mean = |(sum, count): &(f64, f64)| sum / count;
        (sums.iter())
            .map(|channels| channels.iter().map(mean).collect())
            .collect()
    }
}

/// Whether each block of some channels' means is outlying from a slowly drifting level.
/// `motion`: mean square velocity in each block. `least`: lower bounds of the channels' variances.
fn outlying(series: &[Vec<f64>], motion: &[f64], least: &[f64]) -> Vec<bool> {
    let count = motion.len();
    let mut outlier = vec![false; count];
    if series.is_empty() || count == 0 {
        return outlier;
    }
    let mut levels: Vec<Vec<f64>> = series.iter().map(|series| medians(series)).collect();
    let of_channels = |deviate: f64| chi_square(series.len().min(FREE), deviate);
    let most = VARIES * of_channels(OUTLYING) / of_channels(USUAL_DEVIATE);
    for _ in 0..ROUNDS {
        let mut squares = vec![0.0; count];
        let mut seen = vec![false; count];
        for ((series, level), least) in series.iter().zip(&levels).zip(least) {
            let errors: Vec<f64> = series
                .iter()
                .zip(level)
                .map(|(x, level)| (x - level).powi(2))
                .collect();
            let usual = errors
                .iter()
                .zip(&outlier)
                .filter(|(x, outlier)| x.is_finite() && !**outlier);
            // The median of the square of a normal deviate is 0.455.
            let scale = (quantile(usual.map(|(x, _)| *x).collect(), 0.5) / 0.455).max(*least);
            for (block, error) in errors
                .iter()
                .enumerate()
                .filter(|(_, error)| error.is_finite())
            {
                squares[block] += error / scale;
                seen[block] = true;
            }
        }
        let usual = usual(&squares, &seen, motion);
        let fails: Vec<bool> = (0..count)
            .map(|k| seen[k] && squares[k] > most * usual[k])
            .collect();
        let mut next = vec![false; count];
        for k in (0..count).filter(|&k| fails[k]) {
            next[k.saturating_sub(MARGIN)..(k + MARGIN + 1).min(count)].fill(true);
        }
        if next == outlier {
            break;
        }
        outlier = next;
        for (series, level) in series.iter().zip(&mut levels) {
            let clean: Vec<f64> = series
                .iter()
                .zip(&outlier)
                .map(|(x, outlier)| if *outlier { f64::NAN } else { *x })
                .collect();
            // A level that follows faster would also follow a contact.
            for (level, next) in level.iter_mut().zip(medians(&clean)) {
                if next.is_finite() {
                    *level = next;
                }
            }
        }
    }
    outlier
}

/// The usual square of each block: that of blocks with about the same motion, but not less than
/// that of all blocks.
fn usual(squares: &[f64], seen: &[bool], motion: &[f64]) -> Vec<f64> {
    const STATIONS: usize = 40;
    let mut order: Vec<usize> = (0..squares.len()).filter(|&k| seen[k]).collect();
    order.sort_by(|&a, &b| motion[a].total_cmp(&motion[b]).then(a.cmp(&b)));
    let usual = |some: &[usize]| quantile(some.iter().map(|&k| squares[k]).collect(), USUAL);
    let all = usual(&order);
    let mut out = vec![all; squares.len()];
    // A third of the blocks at a time, so that a contact is not most of any. Among all thirds that
    // contain a block the largest value counts: the residual may change at once where motion
    // begins.
    let width = order.len().div_ceil(3).max(25).min(order.len());
    let stride = order.len().div_ceil(STATIONS).max(1);
    let last = order.len() - width;
    for start in (0..last).step_by(stride).chain([last]) {
        let window = &order[start..start + width];
        let near = usual(window);
        window.iter().for_each(|&k| out[k] = out[k].max(near));
    }
    out
}

/// Moving medians of a series.
fn medians(series: &[f64]) -> Vec<f64> {
    const STRIDE: usize = 10;
    let mut out = Vec::with_capacity(series.len());
    for start in (0..series.len()).step_by(STRIDE) {
        let end = (start + STRIDE).min(series.len());
        let around = &series[start.saturating_sub(WINDOW)..(end + WINDOW).min(series.len())];
        let values = around.iter().copied().filter(|x| x.is_finite()).collect();
        out.resize(end, quantile(values, 0.5));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// Six channels of a robot that stands, moves slowly, moves fast, by turns, with a residual
    /// that grows with the speed; offsets that drift.
    fn usual_log(seed: u64) -> (Vec<Vec<f64>>, Vec<f64>) {
        let count = 600;
        let motion: Vec<f64> = (0..count).map(|k| [0.0, 0.3, 2.0][k / 40 % 3]).collect();
        let series = (0..6)
            .map(|channel| {
                let noise = normals(10 * seed + channel, count);
                let slope = 1e-3 * channel as f64;
                let value = |k: usize| 7.0 + slope * k as f64;
                (0..count)
                    .map(|k| value(k) + (0.1 + motion[k]) * noise[k])
                    .collect()
            })
            .collect();
        (series, motion)
    }

    fn found(series: &[Vec<f64>], motion: &[f64]) -> Vec<bool> {
        outlying(series, motion, &vec![1e-6; series.len()])
    }

    #[test]
    fn errors_that_grow_with_motion_and_drift_are_no_contact() {
        for seed in 0..20 {
            let (series, motion) = usual_log(seed);
            assert_eq!(
                found(&series, &motion)
                    .iter()
                    .filter(|outlier| **outlier)
                    .count(),
                0,
                "seed {seed}"
            );
        }
    }

    /// With few channels, squares of many times the usual one occur by chance.
    #[test]
    fn noise_of_few_channels_is_no_contact() {
        for channels in 1..=3 {
            for seed in 0..20 {
                let (mut series, motion) = usual_log(seed);
                series.truncate(channels);
                let outlier = found(&series, &motion);
                assert_eq!(
                    outlier.iter().filter(|outlier| **outlier).count(),
                    0,
                    "{channels}, seed {seed}"
                );
                series[0][90..140].iter_mut().for_each(|x| *x += 60.0);
                let outlier = found(&series, &motion);
                assert!(
                    outlier[90..140].iter().all(|outlier| *outlier),
                    "{channels}, seed {seed}"
                );
            }
        }
    }

    #[test]
    fn temporary_forces_are_contacts_while_they_last() {
        for seed in 0..20 {
            let (mut series, motion) = usual_log(seed);
            // A third of the time, in two directions, while the robot moves fast and while it
            // stands.
            let spans = [90..140, 200..260, 400..470, 540..555];
            for (number, span) in spans.iter().enumerate() {
                for (channel, size) in [(number, 60.0), (number + 1, -40.0)] {
                    series[channel][span.clone()]
                        .iter_mut()
                        .for_each(|x| *x += size);
                }
            }
            let outlier = found(&series, &motion);
            for (k, outlier) in outlier.iter().enumerate() {
                let in_contact = spans.iter().any(|span| span.contains(&k));
                let near = spans
                    .iter()
                    .any(|span| k + MARGIN >= span.start && k < span.end + MARGIN);
                assert!(*outlier || !in_contact, "seed {seed}: block {k} is touched");
                assert!(!*outlier || near, "seed {seed}: block {k} is free");
            }
        }
    }
}
