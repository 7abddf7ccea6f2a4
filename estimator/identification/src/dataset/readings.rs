//! Checks the residuals of F/T readings for outliers and offset jumps. The residual is the reading
//! minus the prediction of the model (CAD parameters, no contact but the base), so that motion does
//! not look like a blow or a slipping cable.
//!
//! - Outliers: the distance from the running median over +-0.12 s exceeds 8 times the usual
//!   distance (1.4826 x median, along the log and nearby), and 1.5 times the deviation or the bend
//!   of the model's own prediction within +-0.24 s.
//! - Jumps: lines fitted on 0.2 s before and after a place, 0.1 s apart, differ there by more than
//!   6 times that scatter, by more than 6 times their usual difference, and by more than 1.5 times
//!   the difference of the model's own prediction (a wrong model must not look like a jump).
//! - Slides: the same test with lines on 0.5 s, 0.6 s apart.

use crate::dataset::cleaning::label;
use crate::dataset::defects::{Defect, OffsetJump};
use crate::dataset::recording::Recording;
use crate::dataset::resampling::Observations;
use crate::finding::Severity;
use crate::parallel;
use crate::robot::{AXES, ChannelRole, Robot};
use crate::statistics::{median, robust_std};
use proprio_dynamics::{InverseDynamics, JointState, Kinematics, Structure};
use proprio_topics::{Nanos, Reason};
use std::ops::Range;

/// Half-widths of the running median's window and of its surroundings, and the two tests for jumps:
/// length of the lines, and of the gap between them \[s\].
const MEDIAN: f64 = 0.12;
const SURROUNDINGS: f64 = 2.0;
const SHARP: (f64, f64) = (0.2, 0.1);
const SLIDE: (f64, f64) = (0.5, 0.6);
/// Threshold of an outlier, in units of the usual distance from the median. Its neighbours above
/// half of it are marked too.
const OUTLIER: f64 = 8.0;
/// Threshold of a jump, in units of the scatter and of the usual result of the test.
const JUMP: f64 = 6.0;
/// Threshold in units of the same test's result on the model's prediction. A prediction of motion
/// that the sensor does not feel at all would give 1.
const MODEL: f64 = 1.5;
/// Greatest assumed error of a centre of mass in the model \[m\].
const LEVER: f64 = Structure::LENGTH_SCALE;

/// Checks the residuals of all F/T sensors: marks outliers, finds offset jumps.
pub(crate) fn inspect(recording: &Recording, robot: &Robot, observations: &mut Observations) {
    // The model's prediction is useless for logs with wrong units or without motion.
    if !recording.stamped
        || observations
            .defects
            .iter()
            .any(|d| d.severity() == Severity::Refusal)
    {
        return;
    }
    let spacings: Vec<f64> = observations
        .instants
        .windows(2)
        .map(|w| (w[1].t - w[0].t).seconds())
        .collect();
    let period = median(spacings);
    // Below 20 observations per second, blows are not separable from motion.
    if period <= 0.0 || period > 0.05 {
        return;
    }
    let predicted = predict(robot, observations);
    let mut outliers = Vec::new();
    for (sensor, cut) in robot.structure.sensors().iter().enumerate() {
        let Some(channel) = recording
            .channels
            .iter()
            .find(|c| c.role == ChannelRole::Sensor(sensor))
        else {
            continue;
        };
        let noise = cut.noise();
        let floors = [noise.force, noise.torque].concat();
        let mut jumps: Vec<(f64, Nanos, &'static str, f64)> = Vec::new();
        let free = free_of_contact(robot, observations, sensor, &predicted);
        let runs = runs(observations, &free, period);
        let expected = Expected::new(&runs, |i| predicted[i][sensor], period);
        let found = parallel::map(AXES.len(), |axis| {
            let series = |range: &Range<usize>| -> Vec<f64> {
                range
                    .clone()
                    .map(|i| {
                        observations.instants[i].readings[sensor].force_first()[axis]
                            - predicted[i][sensor][axis]
                    })
                    .collect()
            };
            let runs = runs.iter().zip(&expected[axis / 3]);
            let runs: Vec<_> = runs
                .map(|(r, e)| Residual::new(r.clone(), series(r), e, period))
                .collect();
            let usual = robust_std(runs.iter().flat_map(|r| r.off.iter().copied()));
            let (mut outliers, mut jumps) = (Vec::new(), Vec::new());
            for mut run in runs {
                let scatter: Vec<f64> = run
                    .around(&run.off, period)
                    .into_iter()
                    .map(|s| s.max(usual).max(floors[axis]))
                    .collect();
                for i in run.outliers(&scatter) {
                    outliers.push((run.range.start + i, run.off[i]));
                    // Later tests see the value without the outlier.
                    run.values[i] -= run.off[i];
                }
                for test in [SHARP, SLIDE] {
                    let found = run.jumps(test, &scatter, period).into_iter();
                    jumps.extend(
                        found.map(|(at, size, excess)| (run.range.start + at, size, excess)),
                    );
                }
            }
            (outliers, jumps)
        });
        for (word, (of_axis, found)) in AXES.into_iter().zip(found) {
            let mut worst = (0.0_f64, Nanos::ZERO);
            for &(i, off) in &of_axis {
                if off.abs() > worst.0.abs() {
                    worst = (off, observations.instants[i].t);
                }
                outliers.push((i, sensor));
            }
            if !of_axis.is_empty() {
                observations.defects.push(Defect::Outliers {
                    channel: label(channel),
                    axis: word,
                    samples: of_axis.len(),
                    largest: worst.0,
                    t: worst.1,
                });
            }
            let found = found.into_iter();
            jumps.extend(
                found.map(|(i, size, excess)| (excess, observations.instants[i].t, word, size)),
            );
        }
        // Of the results of all axes and both tests within a second, the clearest.
        jumps.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut kept: Vec<(Nanos, &'static str, f64)> = Vec::new();
        for (_, t, axis, size) in jumps {
            if kept
                .iter()
                .all(|(other, ..)| (t - *other).0.abs() > 1_000_000_000)
            {
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
            observations
                .offset_jumps
                .push(OffsetJump { sensor, t, jump });
        }
    }
    for (observation, sensor) in outliers {
        observations.instants[observation].outliers.insert(sensor);
    }
    observations.offset_jumps.sort_by_key(|b| (b.t, b.sensor));
}

/// The predicted readings of all sensors with the model's parameters and no contact but at the
/// base; NaN where the motion is unknown.
fn predict(robot: &Robot, observations: &Observations) -> Vec<Vec<[f64; 6]>> {
    let sensors = robot.structure.sensors();
    let nothing = vec![[f64::NAN; 6]; sensors.len()];
    parallel::in_chunks(observations.instants.len(), |range| {
        let Ok(mut kinematics) = Kinematics::new(&robot.model, robot.base_link) else {
            return vec![nothing.clone(); range.len()];
        };
        let mut dynamics = InverseDynamics::new(&robot.model);
        let of_observation = observations.instants[range].iter().map(|observation| {
            let state = JointState {
                position: &observation.position,
                velocity: &observation.velocity,
                acceleration: &observation.acceleration,
            };
            let based = kinematics
                .set_base(&robot.model, observation.base_link)
                .is_ok();
            let done = observation.has_motion(&robot.channels)
                && based
                && kinematics
                    .update(&robot.model, state, &observation.base)
                    .is_ok()
                && dynamics.update(&robot.model, &kinematics, &[]).is_ok();
            if !done {
                return nothing.clone();
            }
            let reading = |cut: &proprio_dynamics::SensorCut| {
                cut.reading(&dynamics.transmitted(&kinematics, cut.joint()))
                    .force_first()
            };
            sensors.iter().map(reading).collect()
        });
        of_observation.collect()
    })
}

/// Per observation, whether the sensor has a reading, and no contact acts on its side away from the
/// base.
fn free_of_contact(
    robot: &Robot,
    observations: &Observations,
    sensor: usize,
    predicted: &[Vec<[f64; 6]>],
) -> Vec<bool> {
    let Some(cut) = robot.structure.sensors().get(sensor) else {
        return Vec::new();
    };
    let beyond = |mut link: usize| {
        while link != 0 && link != cut.joint() + 1 {
            link = robot.model.joints().get(link - 1).map_or(0, |j| j.parent);
        }
        link == cut.joint() + 1
    };
    let touching = |observation: &crate::dataset::observation::Observation| {
        let far = |c: &usize| {
            let link = robot
                .structure
                .contacts()
                .get(*c)
                .map(|spec| spec.frame.link);
            link.is_some_and(|link| beyond(link) != beyond(observation.base_link))
        };
        observation.active.iter().any(|c| far(&c))
    };
    let number = robot
        .channels
        .iter()
        .position(|c| c.role == ChannelRole::Sensor(sensor));
    let mut free: Vec<bool> = observations
        .instants
        .iter()
        .zip(predicted)
        .map(|(i, p)| {
            let there = number.is_some_and(|n| i.faults.get(n) == Some(&Reason::None));
            there && p.get(sensor).is_some_and(|p| p[0].is_finite())
        })
        .collect();
    // A contact may begin and end a little before and after its declaration.
    let near = Nanos::from_millis(300);
    let touched: Vec<Nanos> = observations
        .instants
        .iter()
        .filter(|i| touching(i))
        .map(|i| i.t)
        .collect();
    for (free, observation) in free.iter_mut().zip(&observations.instants) {
        let at = touched.partition_point(|t| *t < observation.t - near);
        *free &= touched.get(at).is_none_or(|t| *t > observation.t + near);
    }
    free
}

/// Stretches of consecutive observations without gaps.
fn runs(observations: &Observations, free: &[bool], period: f64) -> Vec<Range<usize>> {
    let mut runs = Vec::new();
    let mut begin = 0;
    for i in 0..=free.len() {
        let ends = i == free.len() || !free[i];
        let apart = !ends
            && i > begin
            && (observations.instants[i].t - observations.instants[i - 1].t).seconds()
                > 5.0 * period;
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

/// Half-width of the window of the running median, in observations.
fn median_reach(period: f64) -> usize {
    samples(MEDIAN, period).max(3)
}

/// Values minus their running median, whose window is symmetric.
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

/// The deviation from its running median of a parabola at its vertex, with the local curvature of
/// the values. A wrong model's residual may have its peak where the prediction rises steadily.
fn bend(values: &[f64], i: usize, half: usize) -> f64 {
    let half = half.min(i).min(values.len() - 1 - i);
    (values[i - half] - 2.0 * values[i] + values[i + half]).abs() / 8.0
}

/// The model's prediction over one stretch, as far as it matters to an axis.
struct Expected {
    values: Vec<[f64; 6]>,
    /// Greatest deviation of the prediction nearby: from its running median, or by its curvature
    /// ([`bend`]).
    off: Vec<f64>,
}

impl Expected {
    /// For forces and for torques: one per stretch, given the prediction of each observation.
    fn new(
        runs: &[Range<usize>],
        predicted: impl Fn(usize) -> [f64; 6] + Sync,
        period: f64,
    ) -> [Vec<Self>; 2] {
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
        // An error of the centre of mass turns forces into torques, but not torques into forces.
        [
            [1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
            [LEVER, LEVER, LEVER, 1.0, 1.0, 1.0],
        ]
        .map(|shares| {
            let of_run = |(number, run): (usize, &Range<usize>)| {
                let share_of =
                    |value: &dyn Fn(usize) -> f64| std::array::from_fn(|k| shares[k] * value(k));
                let norm = |i: usize| {
                    let off: [f64; 6] = share_of(&|k| off[k][number][i]);
                    off.iter().map(|off| off * off).sum::<f64>().sqrt()
                };
                // The maximum nearby, since the residual of a wrong model need not be in phase with
                // the prediction.
                let norms: Vec<f64> = (0..run.len()).map(norm).collect();
                let near = |i: usize| {
                    &norms[i.saturating_sub(2 * half)..(i + 2 * half + 1).min(norms.len())]
                };
                let most = |i: usize| near(i).iter().copied().fold(0.0, f64::max);
                Self {
                    values: run
                        .clone()
                        .map(|i| share_of(&|k| predicted(i)[k]))
                        .collect(),
                    off: (0..run.len()).map(most).collect(),
                }
            };
            runs.iter().enumerate().map(of_run).collect()
        })
    }
}

/// The residual of one axis of a sensor over one stretch.
struct Residual<'a> {
    range: Range<usize>,
    values: Vec<f64>,
    /// Deviation from the running median.
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

    /// The usual magnitude of `values` near each place, as a standard deviation.
    fn around(&self, values: &[f64], period: f64) -> Vec<f64> {
        let (half, step) = (samples(SURROUNDINGS, period), samples(0.25, period));
        let at = |i: usize| {
            let window = &values[i.saturating_sub(half)..(i + half).min(values.len())];
            robust_std(window.iter().copied())
        };
        let knots: Vec<f64> = (0..values.len()).step_by(step).map(at).collect();
        (0..values.len()).map(|i| knots[i / step]).collect()
    }

    fn outliers(&self, scatter: &[f64]) -> Vec<usize> {
        let far = |i: usize, times: f64| {
            self.off[i].abs() > (times * scatter[i]).max(MODEL * self.expected.off[i])
        };
        let mut marked = vec![false; self.off.len()];
        for i in (0..self.off.len()).filter(|i| far(*i, OUTLIER)) {
            marked[i] = true;
            let before = (0..i).rev().take_while(|j| far(*j, 0.5 * OUTLIER));
            let after = (i + 1..self.off.len()).take_while(|j| far(*j, 0.5 * OUTLIER));
            before.chain(after).for_each(|j| marked[j] = true);
        }
        (0..marked.len()).filter(|i| marked[*i]).collect()
    }

    /// Places where the lines before and after differ: the first observation after, the difference,
    /// and its ratio to the threshold.
    fn jumps(
        &self,
        (line, gap): (f64, f64),
        scatter: &[f64],
        period: f64,
    ) -> Vec<(usize, f64, f64)> {
        let (line, gap) = (samples(line, period).max(5), samples(0.5 * gap, period));
        let (reach, count) = (line + gap, self.values.len());
        if count <= 2 * reach {
            return Vec::new();
        }
        // Weights of samples at distances gap + 1/2, gap + 3/2, ... in their fitted line at 0.
        let (n, middle) = (line as f64, gap as f64 + 0.5 * line as f64);
        let spread = n * (n * n - 1.0) / 12.0;
        let weights: Vec<f64> = (0..line)
            .map(|k| 1.0 / n - middle * (k as f64 - 0.5 * (n - 1.0)) / spread)
            .collect();
        let ends = |value: &dyn Fn(usize) -> f64, i: usize| {
            let line = |at: &dyn Fn(usize) -> usize| -> f64 {
                weights
                    .iter()
                    .enumerate()
                    .map(|(k, w)| w * value(at(k)))
                    .sum()
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
        let usual = robust_std(inside.iter().copied());
        // The usual result of the test nearby, from lines that share no sample with those at the
        // place itself.
        let surroundings = samples(SURROUNDINGS, period);
        let around = |i: usize| {
            let before = misses[(i.saturating_sub(reach + surroundings)).max(reach)
                ..i.saturating_sub(reach).max(reach)]
                .iter();
            let last = count - reach;
            let after = misses[(i + reach).min(last)..(i + reach + surroundings).min(last)].iter();
            robust_std(before.chain(after).copied())
        };
        let excess = |i: usize| {
            let size = misses[i].abs();
            let mut excess =
                (size / (JUMP * scatter[i])).min(size / (JUMP * usual.max(f64::MIN_POSITIVE)));
            if excess >= 1.0 {
                excess = excess.min(size / (JUMP * around(i).max(f64::MIN_POSITIVE)));
            }
            if excess >= 1.0 {
                let of_model: f64 = (0..6)
                    .map(|k| miss(&|j| self.expected.values[j][k], i).powi(2))
                    .sum();
                excess = excess.min(size / (MODEL * of_model.sqrt()).max(f64::MIN_POSITIVE));
            }
            excess
        };
        let excesses: Vec<f64> = (0..count).map(excess).collect();
        // After a blow, or one swing of the robot, the values return.
        let level = samples(SLIDE.0, period);
        let stays = |i: usize| {
            let after = median(self.values[i + gap..(i + gap + level).min(count)].to_vec());
            let before = median(self.values[(i - gap).saturating_sub(level)..i - gap].to_vec());
            (after - before) * misses[i].signum() > 0.5 * misses[i].abs()
        };
        // The difference is the same anywhere between the lines. The jump is placed where the
        // values on each side fit their level best.
        let moment = |i: usize| {
            let ends = ends(&|j| self.values[j], i);
            let off = |j: usize, side: usize| (self.values[j] - ends[side]).powi(2);
            let all = i - gap..i + gap;
            let cost =
                |at: usize| -> f64 { all.clone().map(|j| off(j, usize::from(j >= at))).sum() };
            let places = i - gap..=i + gap;
            places
                .min_by(|a, b| cost(*a).total_cmp(&cost(*b)))
                .unwrap_or(i)
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

    /// Where the prediction rises steadily and never leaves its median, the residual of a wrong
    /// model may have its peak. That is no outlier; a blow beside it is.
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
