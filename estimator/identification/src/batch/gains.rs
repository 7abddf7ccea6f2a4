//! Gains of the F/T sensors: whether they are identified, and the fits with gains as parameters.

use crate::cross_validation::{self, Retention};
use crate::finding::{Finding, FindingCode, Severity};
use crate::fit::{IdentifyError, NoiseAndMap, OffsetDrift, alternate_noise_and_map};
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::residuals;
use crate::robot::Robot;
use crate::training::{
    SEGMENT_INSTANTS, TrainingLog, map_segments, sample, segments_of, training_logs,
    training_logs_mut,
};
use proprio_dynamics::calibration::{Gain, Kind};
use proprio_dynamics::spatial::Wrench;

/// The gains to identify.
pub(crate) struct GainChoice {
    pub(crate) gain: Gain,
    /// A note that gains were chosen by cross-validation.
    pub(crate) finding: Option<Finding>,
    /// The cross-validation without gains, if it was done and no gains were chosen.
    pub(crate) retention: Option<Retention>,
}

impl GainChoice {
    pub(crate) const fn of(gain: Gain) -> Self {
        Self {
            gain,
            finding: None,
            retention: None,
        }
    }
}

/// Chooses the gains to identify: those requested; or, with [`Gain::Auto`], from none to diagonal
/// to full, as long as the prediction of held-out data improves by more than a standard error and,
/// at some sensor, by more than the cost.
///
/// The cost: a gain common to all channels is not separable from a mass common to all links. So it
/// stays as uncertain as the factory calibration, and affects every torque. The cost is the square
/// of that relative uncertainty, compared with the squared error relative to the squared readings.
/// Noise and parameters are those estimated without gains, from which a gain's error is a small
/// change.
pub(crate) fn choose_gain(
    measurement: &mut MeasurementModel<'_>,
    logs: &mut [TrainingLog],
    estimate: &NoiseAndMap,
) -> Result<GainChoice, IdentifyError> {
    let wanted = measurement.robot().calibrated;
    if wanted.gain != Gain::Auto {
        return Ok(GainChoice::of(wanted.gain));
    }
    if measurement.unknowns().sensors.is_empty() {
        return Ok(GainChoice::of(Gain::None));
    }
    let cost = measurement.robot().gain_std.powi(2);
    set_fitted_readings(measurement, logs, estimate);
    let mut checked = |gain: Gain| -> Result<Retention, IdentifyError> {
        let training = training_logs(logs);
        let instants = training.iter().flat_map(|log| log.instants.iter());
        measurement.set_calibration_unknowns(Kind { gain, ..wanted }, instants);
        let sampled = sample(measurement, &training);
        let NoiseAndMap {
            prior, noise, fit, ..
        } = estimate;
        cross_validation::held_out(measurement, prior, &sampled, noise, fit.tau)
    };
    let retention = checked(Gain::None)?;
    let none = &retention.held;
    let (mut chosen, mut best) = (Gain::None, none.clone());
    for gain in [Gain::Diagonal, Gain::Full] {
        let before = best.relative_squares();
        if !before.iter().any(|square| *square > cost) {
            break;
        }
        let other = checked(gain)?.held;
        let after = other.relative_squares();
        let exceeds_cost = before
            .iter()
            .zip(after)
            .any(|(before, after)| before - after > cost);
        let (gained, error) = other.gain_over(&best);
        if !(exceeds_cost && gained > error) {
            break;
        }
        (chosen, best) = (gain, other);
    }
    // The layout of the estimate at hand.
    let training = training_logs(logs);
    let instants = training.iter().flat_map(|log| log.instants.iter());
    let gain = Gain::None;
    measurement.set_calibration_unknowns(Kind { gain, ..wanted }, instants);
    let what = match chosen {
        Gain::Full => "all entries of the F/T sensors' gains are identified",
        Gain::Diagonal => "a gain of each channel of the F/T sensors is identified",
        Gain::Auto | Gain::None => {
            for instant in training_logs_mut(logs).flat_map(|log| &mut log.instants) {
                instant.fitted = Vec::new();
            }
            return Ok(GainChoice {
                retention: Some(retention),
                ..GainChoice::of(Gain::None)
            });
        }
    };
    let text = format!(
        "{what}: the error of predicting held-out readings is {:.0} % smaller than without \
         (identification.gain = \"none\" keeps the gains of the factory calibration)",
        100.0 * (1.0 - best.relative_to(none))
    );
    let finding = Some(Finding {
        severity: Severity::Note,
        code: FindingCode::GainChosen,
        subject: "identification.gain".into(),
        text,
    });
    Ok(GainChoice {
        finding,
        ..GainChoice::of(chosen)
    })
}

/// Fits gains, too, until they converge. A gain's column is the noise-free reading, as the previous
/// fit predicts it ([`crate::measurement::model`]).
pub(crate) fn fit_gains(
    robot: &Robot,
    measurement: &mut MeasurementModel<'_>,
    logs: &mut [TrainingLog],
    calibrated: Kind,
    mut estimate: NoiseAndMap,
    progress: &mut dyn FnMut(String, f64),
) -> Result<NoiseAndMap, IdentifyError> {
    /// Most fits. Each divides the error of a gain by about the inverse of that error, say twenty.
    const MAX_FITS: usize = 6;
    /// Gains have converged if they change by less, in standard deviations of the prior.
    const CONVERGED: f64 = 1e-3;
    let mut progress = |step: String, _| progress(format!("{step}, with gains"), 0.62);
    set_fitted_readings(measurement, logs, &estimate);
    let instants = training_logs(logs);
    measurement.set_calibration_unknowns(
        calibrated,
        instants.iter().flat_map(|log| log.instants.iter()),
    );
    let mut last: Option<Vec<f64>> = None;
    for _ in 0..MAX_FITS {
        estimate = alternate_noise_and_map(
            robot,
            measurement,
            &training_logs(logs),
            OffsetDrift::AsStated,
            Some(estimate.noise),
            &mut progress,
        )?;
        set_fitted_readings(measurement, logs, &estimate);
        let unknowns = measurement.unknowns();
        let own = unknowns
            .precision
            .iter()
            .copied()
            .zip(unknowns.inertial()..);
        let now: Vec<f64> = own
            .map(|(precision, column)| estimate.fit.x[column] * precision.sqrt())
            .collect();
        let has_converged = |last: &Vec<f64>| {
            last.iter()
                .zip(&now)
                .all(|(a, b)| (a - b).abs() < CONVERGED)
        };
        if last.as_ref().is_some_and(has_converged) {
            break;
        }
        last = Some(now);
    }
    Ok(estimate)
}

/// Stores in the training logs the noise-free readings that this fit predicts.
pub(crate) fn set_fitted_readings(
    measurement: &MeasurementModel<'_>,
    logs: &mut [TrainingLog],
    estimate: &NoiseAndMap,
) {
    let unknowns = measurement.unknowns();
    let training = training_logs(logs);
    let segments = segments_of(&training, SEGMENT_INSTANTS);
    let residuals = map_segments(measurement, &segments, |measurement, _, segment| {
        residuals(
            measurement,
            segment,
            &estimate.noise,
            std::slice::from_ref(&estimate.fit.x),
        )
    });
    let mut fitted = Vec::new();
    for (segment, residuals) in segments.iter().zip(&residuals) {
        for (i, instant) in segment.instants.iter().enumerate() {
            let mut readings =
                vec![Wrench::from_parts([f64::NAN; 3], [f64::NAN; 3]); instant.readings.len()];
            for (place, &sensor) in unknowns.sensors.iter().enumerate() {
                let noise = std::array::from_fn(|axis| residuals.noise[0][6 * place + axis][i]);
                readings[sensor] = instant.readings[sensor] - Wrench::from_torque_first(noise);
            }
            fitted.push(readings);
        }
    }
    // In the order of the segments, which is that of the logs.
    let mut fitted = fitted.into_iter();
    let training = training_logs_mut(logs);
    for instant in training.flat_map(|log| &mut log.instants) {
        instant.fitted = fitted.next().unwrap_or_default();
    }
}
