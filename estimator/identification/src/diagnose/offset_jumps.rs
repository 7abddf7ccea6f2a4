//! Offset jumps of F/T sensors: whether the residuals of a fit confirm them.

use crate::dataset::defects::OffsetJump;
use crate::hypothesis::needed;
use crate::linear::nuisance::{Block, smooth_with};
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{Segment, filter_nuisance};
use crate::training::TrainingLog;
use nalgebra::{DMatrix, DVector, Matrix6, Vector6};
use proprio_topics::Nanos;
use std::collections::BTreeMap;

/// A level is known better than another one if its variances are smaller by this factor.
const BETTER: f64 = 100.0;

/// Longest time between two jumps that may be a contact \[s\].
const LONGEST_CONTACT: f64 = 10.0;

/// The jumps of each log that a fit confirms. A jump is dropped if the offset is the same before
/// and after it, within its drift and its uncertainty for these parameters. (A contact changes the
/// readings of every sensor that transmits it, as offset jumps would; the rows of the links between
/// the sensors separate the two.) Jumps of sensors without rows are all kept.
pub(crate) fn confirmed(
    measurement: &MeasurementModel<'_>,
    all: &[&TrainingLog],
    jumps: &[Vec<OffsetJump>],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<Vec<OffsetJump>> {
    let unknowns = measurement.unknowns();
    let confirmed_jumps = |(log, jumps): (&&TrainingLog, &Vec<OffsetJump>)| {
        let place = |b: &OffsetJump| unknowns.sensors.binary_search(&b.sensor).ok();
        if jumps.iter().all(|b| place(b).is_none()) {
            return jumps.clone();
        }
        let segment = Segment {
            instants: &log.instants,
            offset_jumps: jumps,
        };
        let (blocks, mut states) =
            filter_nuisance(measurement, segment, noise, std::slice::from_ref(d));
        let reset_sensors = |block: usize| &blocks[block].1;
        let t = |block: usize| log.instants[blocks[block].0.start].t;
        // Offsets are correlated where rows contain several: the covariance of the level after each
        // jump with the levels before it, and before the jumps up to `LONGEST_CONTACT` earlier.
        let mut carried: Vec<(usize, usize, DMatrix<f64>)> = Vec::new();
        let mut covariances = BTreeMap::new();
        smooth_with(&mut states, |block, state, gain, continues| {
            for &place in reset_sensors(block) {
                carried.push((place, block, state.p.columns(6 * place, 6).into_owned()));
            }
            carried.retain(|(_, later, _)| (t(*later) - t(block)).seconds() <= LONGEST_CONTACT);
            for (place, later, covariance) in &mut carried {
                *covariance = gain * covariance.select_rows(continues);
                if reset_sensors(block).contains(place) {
                    let own: Matrix6<f64> =
                        covariance.fixed_view::<6, 6>(6 * *place, 0).into_owned();
                    covariances.insert((*place, block, *later), own);
                }
            }
        });
        let mut is_kept: Vec<bool> = jumps.iter().map(|b| place(b).is_none()).collect();
        for place in 0..unknowns.sensors.len() {
            let begins: Vec<usize> = (0..blocks.len())
                .filter(|&k| reset_sensors(k).contains(&place))
                .collect();
            let level = |block: usize| {
                let Block { x, p, .. } = &states[block];
                Level {
                    t: t(block),
                    value: x.fixed_view::<6, 1>(6 * place, 0).into_owned(),
                    covariance: p.fixed_view::<6, 6>(6 * place, 6 * place).into_owned(),
                }
            };
            let walk = Vector6::from_fn(|axis, _| noise.drift[6 * place + axis]);
            // The last level before each jump, and the first after it.
            let levels: Vec<(Level, Level)> =
                begins.iter().map(|&k| (level(k - 1), level(k))).collect();
            let shared = |before: usize, after: usize| {
                let key = (place, begins[before], begins[after]);
                covariances.get(&key).copied().unwrap_or_default()
            };
            let is_new = new_levels(&levels, &shared, &walk);
            let own = jumps.iter().zip(&mut is_kept);
            for (b, is_kept) in own.filter(|(b, _)| b.sensor == unknowns.sensors[place]) {
                let number = begins.partition_point(|&k| t(k) < b.t);
                *is_kept = is_new.get(number).is_some_and(|is| *is);
            }
        }
        let is_kept = jumps.iter().zip(is_kept).filter(|(_, is_kept)| *is_kept);
        is_kept.map(|(b, _)| b.clone()).collect()
    };
    all.iter().zip(jumps).map(confirmed_jumps).collect()
}

/// A sensor's offset at some time.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    pub(crate) t: Nanos,
    pub(crate) value: Vector6<f64>,
    pub(crate) covariance: Matrix6<f64>,
}

impl Level {
    /// Whether it differs from `before` by more than drift and uncertainty explain. `shared`: the
    /// covariance of `before` with this level; `walk`: variance rate of the drift.
    pub(crate) fn is_other(
        &self,
        before: &Self,
        shared: &Matrix6<f64>,
        walk: &Vector6<f64>,
        needed: f64,
    ) -> bool {
        let step = self.value - before.value;
        let walked = Matrix6::from_diagonal(&(walk * (self.t - before.t).seconds().max(0.0)));
        let covariance = self.covariance + before.covariance - shared - shared.transpose() + walked;
        covariance
            .cholesky()
            .is_none_or(|factor| step.dot(&factor.solve(&step)) > needed)
    }

    /// Whether it is known clearly better than another level.
    pub(crate) fn is_known_better(&self, than: &Self) -> bool {
        let known = |level: &Self| {
            level
                .covariance
                .diagonal()
                .iter()
                .map(|v| v.ln())
                .sum::<f64>()
        };
        known(self) < known(than) - 6.0 * BETTER.ln()
    }
}

/// Whether the level really changes at each jump of a sensor, given the levels before and after it
/// (`levels`) and the covariance of the level before one jump with the level after the same or a
/// later one (`shared`). A level that soon returns is a contact between two jumps.
pub(crate) fn new_levels(
    levels: &[(Level, Level)],
    shared: &dyn Fn(usize, usize) -> Matrix6<f64>,
    walk: &Vector6<f64>,
) -> Vec<bool> {
    let mut is_new = vec![true; levels.len()];
    let needed = needed(6, levels.len());
    let mut number = 0;
    let mut known: Option<usize> = None;
    while number < levels.len() {
        let own = &levels[number].0;
        let is_better = |known: &usize| levels[*known].0.is_known_better(own);
        let before = known.filter(is_better).unwrap_or(number);
        // The last jump after which the level is the same again.
        let last = (number..levels.len())
            .take_while(|&k| k == number || (levels[k].1.t - own.t).seconds() < LONGEST_CONTACT)
            .filter(|&k| {
                !levels[k]
                    .1
                    .is_other(&levels[before].0, &shared(before, k), walk, needed)
            })
            .last();
        known = last.map(|_| before);
        if let Some(last) = last {
            is_new[number..=last].fill(false);
            number = last;
        }
        number += 1;
    }
    is_new
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sensor's level, known to `deviation` in each channel.
    fn level(seconds: f64, value: f64, deviation: f64) -> Level {
        Level {
            t: Nanos::from_seconds(seconds),
            value: Vector6::repeat(value),
            covariance: Matrix6::identity() * deviation * deviation,
        }
    }

    fn uncorrelated(_: usize, _: usize) -> Matrix6<f64> {
        Matrix6::zeros()
    }

    #[test]
    fn an_offset_that_is_the_same_before_and_after_did_not_jump() {
        // Per case: the time of each jump, the levels before the first and after each, and which
        // jumps are real.
        for (what, jumps, values, expected) in [
            ("nothing", &[3.0][..], &[7.0, 7.1][..], &[false][..]),
            ("a jump", &[3.0], &[7.0, 9.0], &[true]),
            (
                "there and back soon",
                &[3.0, 5.0],
                &[7.0, 9.0, 7.1],
                &[false, false],
            ),
            (
                "there and back late",
                &[3.0, 25.0],
                &[7.0, 9.0, 7.1],
                &[true, true],
            ),
            (
                "a jump, then a touch",
                &[3.0, 15.0, 17.0],
                &[7.0, 9.0, 5.0, 9.0],
                &[true, false, false],
            ),
        ] {
            let at = |number: usize, t: f64| level(t, values[number], 0.1);
            let levels: Vec<(Level, Level)> = (jumps.iter().enumerate())
                .map(|(number, &t)| (at(number, t - 0.1), at(number + 1, t)))
                .collect();
            assert_eq!(
                new_levels(&levels, &uncorrelated, &Vector6::zeros()),
                expected,
                "{what}"
            );
            // With a drift that is as fast as the jump, no jump can be confirmed.
            let walk = Vector6::repeat(100.0);
            assert!(
                new_levels(&levels, &uncorrelated, &walk)
                    .iter()
                    .all(|is_new| !is_new),
                "{what}"
            );
        }
    }

    /// Instants between two jumps are excluded and carry no information: the levels before and
    /// after both decide whether the offset jumped.
    #[test]
    fn a_jump_is_found_across_excluded_instants() {
        for (after, expected) in [(7.1, [false, false]), (9.0, [false, true])] {
            let between = |t: f64| level(t, 40.0, 1e3);
            let levels = [
                (level(3.0, 7.0, 0.1), between(3.1)),
                (between(8.0), level(8.1, after, 0.1)),
            ];
            assert_eq!(
                new_levels(&levels, &uncorrelated, &Vector6::zeros()),
                expected,
                "{after}"
            );
        }
    }
}
