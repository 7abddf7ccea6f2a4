//! Curves of readings and predictions for a report, and the low-pass filter of raw torques.

use crate::dataset::observation::Annotated;
use crate::fit::Identified;
use crate::measurement::channels::{channel_of, sensor_name};
use crate::measurement::model::MeasurementModel;
use crate::report::comparison::{Compared, TorqueSeries, predicted_deviations};
use crate::report::outcome::Curve;
use crate::robot::AXES;
use nalgebra::DMatrix;

/// Most points of a curve.
pub(crate) const POINTS: usize = 2000;

/// Time at both ends of a log that is not used to compare torques, because of filters and
/// derivatives \[s\].
pub(crate) const EDGE: f64 = 0.3;

/// Torques sampled faster than this are raw \[Hz\]: they are compared below [`CUT_OFF`].
pub(crate) const RAW_RATE: f64 = 400.0;

/// Cut-off of the fourth-order Butterworth filter, run forwards and backwards, for raw torques
/// \[Hz\].
pub(crate) const CUT_OFF: f64 = 5.0;

/// Longest gap that is interpolated \[s\]: it has no effect below [`CUT_OFF`].
pub(crate) const INTERPOLATED: f64 = 0.02;

pub(crate) fn mean(values: &[f64]) -> f64 {
    let finite = values.iter().filter(|x| x.is_finite());
    let (sum, count) = finite.fold((0.0, 0.0), |(s, n), x| (s + x, n + 1.0));
    sum / count
}

pub(crate) fn curves(
    measurement: &mut MeasurementModel<'_>,
    instants: &[Annotated],
    times: &[f64],
    compared: &Compared,
    identified: &Identified,
    root: &DMatrix<f64>,
    torques: &[TorqueSeries],
) -> Vec<Curve> {
    let robot = measurement.robot();
    let unknowns = measurement.unknowns().clone();
    let wrenches = 6 * unknowns.sensors.len();
    let points: Vec<usize> = (0..instants.len())
        .step_by(instants.len().div_ceil(POINTS).max(1))
        .collect();
    // The standard deviation changes slowly: it is computed at a tenth of the points and held
    // between them.
    let mut deviations: Vec<Vec<f64>> = Vec::new();
    for (number, &i) in points.iter().enumerate() {
        if number % 10 == 0 {
            deviations.push(predicted_deviations(
                measurement,
                &instants[i],
                identified,
                root,
            ));
        }
    }
    let sigma = |channel: usize| -> Vec<f64> {
        (0..points.len())
            .map(|number| deviations[number / 10][channel])
            .collect()
    };
    let t: Vec<f64> = points.iter().map(|&i| times[i]).collect();
    let pick =
        |values: &dyn Fn(usize) -> f64| points.iter().map(|&i| values(i)).collect::<Vec<f64>>();
    let mut out = Vec::new();
    for (dof, errors, measured) in torques {
        let place = unknowns.joints.binary_search(dof).ok();
        out.push(Curve {
            name: robot.model.dof_name(*dof).to_owned(),
            unit: "Nm",
            t: t.clone(),
            measured: pick(&|i| measured[i]),
            cad_fitted: pick(&|i| measured[i] - errors[1][i]),
            identified: pick(&|i| measured[i] - errors[2][i]),
            sigma: place.map_or_else(
                || vec![f64::NAN; points.len()],
                |place| sigma(wrenches + place),
            ),
        });
    }
    for (place, &sensor) in unknowns.sensors.iter().enumerate() {
        for (axis, word) in AXES.into_iter().enumerate() {
            let channel = channel_of(place, axis);
            let load = &compared.load[channel];
            out.push(Curve {
                name: format!("{} {word}", sensor_name(robot, sensor)),
                unit: if axis < 3 { "N" } else { "Nm" },
                t: t.clone(),
                measured: pick(&|i| load[i]),
                cad_fitted: pick(&|i| load[i] - compared.errors[1][channel][i]),
                identified: pick(&|i| load[i] - compared.errors[2][channel][i]),
                sigma: sigma(channel),
            });
        }
    }
    out
}

/// Places of a log's instants on an equally spaced time grid: filters must take gaps of the log
/// into account.
pub(crate) struct Places {
    pub(crate) at: Vec<usize>,
    /// \[Hz\].
    pub(crate) rate: f64,
}

impl Places {
    /// From ascending times \[s\] that are spaced by about their median distance; none if that
    /// distance is not positive. A long gap is shortened to a few places.
    pub(crate) fn new(times: &[f64]) -> Option<Self> {
        let steps: Vec<f64> = times.windows(2).map(|two| two[1] - two[0]).collect();
        let mut sorted = steps.clone();
        sorted.sort_by(f64::total_cmp);
        let median = *sorted
            .get(sorted.len() / 2)
            .filter(|period| **period > 0.0)?;
        // Stamps may be as coarse as a tenth of their distance: the mean of all distances near the
        // median is more precise than the median.
        let near = || {
            steps
                .iter()
                .filter(|step| (0.5..1.5).contains(&(**step / median)))
        };
        let rate = near().count() as f64 / near().sum::<f64>();
        let longest = samples(INTERPOLATED, rate) + 2;
        let mut at = vec![0];
        for step in &steps {
            // From the previous place, so that stamps may drift against the clock.
            let places = ((step * rate).round() as usize).clamp(1, longest);
            at.push(at[at.len() - 1] + places);
        }
        Some(Self { at, rate })
    }

    /// The values on the grid, NaN where there is no instant.
    pub(crate) fn spread(&self, values: &[f64]) -> Vec<f64> {
        let mut series = vec![f64::NAN; self.at.last().map_or(0, |last| last + 1)];
        for (&place, &value) in self.at.iter().zip(values) {
            series[place] = value;
        }
        series
    }

    pub(crate) fn low_passed(&self, values: &[f64]) -> Vec<f64> {
        let smooth = low_passed(&self.spread(values), self.rate);
        self.at.iter().map(|&place| smooth[place]).collect()
    }
}

/// Number of samples in a time \[s\].
pub(crate) fn samples(seconds: f64, rate: f64) -> usize {
    (seconds * rate).round() as usize
}

/// [`zero_phase`] of a series with missing values (NaN). Gaps of up to [`INTERPOLATED`] are
/// interpolated linearly. Longer gaps are ends of the series: as at the ends of the log, values
/// within [`EDGE`] of them become NaN. Missing values stay missing.
pub(crate) fn low_passed(values: &[f64], rate: f64) -> Vec<f64> {
    let samples = |seconds: f64| samples(seconds, rate);
    let there: Vec<usize> = (0..values.len())
        .filter(|&i| values[i].is_finite())
        .collect();
    let mut out = vec![f64::NAN; values.len()];
    let mut rest = there.as_slice();
    while let (Some(&first), false) = (rest.first(), rest.is_empty()) {
        let end = rest
            .windows(2)
            .position(|w| w[1] - w[0] > samples(INTERPOLATED) + 1);
        let (run, behind) = rest.split_at(end.map_or(rest.len(), |i| i + 1));
        rest = behind;
        let last = run[run.len() - 1];
        let mut line = Vec::with_capacity(last + 1 - first);
        for pair in run.windows(2) {
            let (a, b) = (values[pair[0]], values[pair[1]]);
            let steps = (pair[1] - pair[0]) as f64;
            line.extend((0..pair[1] - pair[0]).map(|k| a + (b - a) * k as f64 / steps));
        }
        line.push(values[last]);
        let smooth = zero_phase(&line, rate);
        let low = if first > 0 { first + samples(EDGE) } else { 0 };
        let high = if last + 1 < values.len() {
            last.saturating_sub(samples(EDGE))
        } else {
            last
        };
        for &i in run.iter().filter(|i| (low..=high).contains(i)) {
            out[i] = smooth[i - first];
        }
    }
    out
}

/// Fourth-order Butterworth low-pass filter, forwards and backwards; `rate` samples per second. The
/// ends are continued by point reflection.
pub(crate) fn zero_phase(values: &[f64], rate: f64) -> Vec<f64> {
    let pad = ((rate / CUT_OFF) as usize * 3).min(values.len().saturating_sub(1));
    if pad == 0 || rate < 4.0 * CUT_OFF {
        return values.to_vec();
    }
    let (first, last) = (values[0], values[values.len() - 1]);
    let mut x: Vec<f64> = (1..=pad).rev().map(|i| 2.0 * first - values[i]).collect();
    x.extend_from_slice(values);
    x.extend((1..=pad).map(|i| 2.0 * last - values[values.len() - 1 - i]));
    let k = (std::f64::consts::PI * CUT_OFF / rate).tan();
    for _ in 0..2 {
        for angle in [1.0, 3.0].map(|m| m * std::f64::consts::PI / 8.0) {
            let q = 1.0 / (2.0 * f64::cos(angle));
            let norm = 1.0 / (1.0 + k / q + k * k);
            let (b, a1, a2) = (
                k * k * norm,
                2.0 * (k * k - 1.0) * norm,
                (1.0 - k / q + k * k) * norm,
            );
            // Initial state: steady state of the first value.
            let (mut s1, mut s2) = (x[0] * (1.0 - b), x[0] * (b - a2));
            for value in &mut x {
                let y = b * *value + s1;
                s1 = 2.0 * b * *value - a1 * y + s2;
                s2 = b * *value - a2 * y;
                *value = y;
            }
        }
        x.reverse();
    }
    x[pad..pad + values.len()].to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gap of days takes as little memory as one of a second, and is still a gap.
    #[test]
    fn places_of_a_gap_of_days_are_few() {
        let times = |gap: f64| -> Vec<f64> {
            let after = |i: u32| if i < 500 { 0.0 } else { gap };
            (0..1000).map(|i| 0.01 * f64::from(i) + after(i)).collect()
        };
        let places = |gap| Places::new(&times(gap)).expect("a period");
        let days = places(1e6);
        assert!(days.at[999] < 1010, "{}", days.at[999]);
        let values: Vec<f64> = (0..1000).map(|i| (0.02 * f64::from(i)).sin()).collect();
        let (days, second) = (days.low_passed(&values), places(1.0).low_passed(&values));
        for (days, second) in days.iter().zip(&second) {
            let same = (days - second).abs() < 1e-6 || days.is_nan() && second.is_nan();
            assert!(same, "{days} {second}");
        }
        assert!(days[499].is_nan() && days[500].is_nan() && days[400].is_finite());
    }

    #[test]
    fn missing_samples_affect_only_nearby_filtered_values() {
        let rate = 1000.0;
        let clean: Vec<f64> = (0..6000)
            .map(|i| (6.0 * f64::from(i) / rate).sin())
            .collect();
        let whole = zero_phase(&clean, rate);
        let mut holed = clean.clone();
        holed[1500] = f64::NAN;
        holed[3000..3400].fill(f64::NAN);
        let found = low_passed(&holed, rate);
        let near =
            |i: usize, gap: std::ops::Range<usize>| i + 300 >= gap.start && i < gap.end + 300;
        for (i, (found, whole)) in found.iter().zip(&whole).enumerate() {
            if i == 1500 || near(i, 3000..3400) {
                assert!(found.is_nan(), "{i}");
            } else {
                assert!((found - whole).abs() < 2e-3, "{i}: {found} {whole}");
            }
        }
        assert_eq!(low_passed(&clean, rate), whole);
        // A log without these rows gives the same result elsewhere.
        let there: Vec<usize> = (0..6000).filter(|i| !(3000..3400).contains(i)).collect();
        let times: Vec<f64> = there.iter().map(|&i| i as f64 / rate).collect();
        let values: Vec<f64> = there.iter().map(|&i| holed[i]).collect();
        let closed = Places::new(&times).expect("a period").low_passed(&values);
        for (&i, value) in there.iter().zip(closed) {
            let same = (value - found[i]).abs() < 1e-5 || value.is_nan() && found[i].is_nan();
            assert!(same, "{i}: {value} {}", found[i]);
        }
        assert!(low_passed(&[f64::NAN; 10], rate).iter().all(|x| x.is_nan()));
    }
}
