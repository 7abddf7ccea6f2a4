//! The fits with gains of the F/T sensors as parameters.

use crate::fit::{IdentifyError, NoiseAndMap, OffsetDrift, alternate_noise_and_map};
use crate::measurement::model::MeasurementModel;
use crate::prepared_log::{
    PreparedLog, SEGMENT_INSTANTS, segment_residuals, segments_of, training_instants,
    training_logs, training_logs_mut,
};
use proprio_dynamics::calibration::Kind;
use proprio_dynamics::spatial::Wrench;

/// Fits gains, too, until they converge. A gain's column is the noise-free reading, as the previous
/// fit predicts it ([`crate::measurement::model`]).
pub(crate) fn fit_gains(
    measurement: &mut MeasurementModel<'_>,
    logs: &mut [PreparedLog],
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
    measurement.set_calibration_unknowns(calibrated, training_instants(logs));
    let mut last: Option<Vec<f64>> = None;
    for _ in 0..MAX_FITS {
        estimate = alternate_noise_and_map(
            measurement,
            &training_logs(logs),
            OffsetDrift::AsStated,
            Some(estimate.noise),
            &mut progress,
        )?;
        measurement.set_precision(estimate.precision.clone());
        set_fitted_readings(measurement, logs, &estimate);
        let unknowns = measurement.unknowns();
        let extra = unknowns.precision.iter().zip(unknowns.inertial()..);
        let now: Vec<f64> = extra
            .map(|(precision, column)| estimate.fit.x[column] * precision.sqrt())
            .collect();
        let has_converged = |last: &Vec<f64>| {
            let mut pairs = last.iter().zip(&now);
            pairs.all(|(a, b)| (a - b).abs() < CONVERGED)
        };
        if last.as_ref().is_some_and(has_converged) {
            break;
        }
        last = Some(now);
    }
    Ok(estimate)
}

/// Stores in the training logs the noise-free readings that this fit predicts.
fn set_fitted_readings(
    measurement: &MeasurementModel<'_>,
    logs: &mut [PreparedLog],
    estimate: &NoiseAndMap,
) {
    let unknowns = measurement.unknowns();
    let training = training_logs(logs);
    let segments = segments_of(&training, SEGMENT_INSTANTS);
    let (noise, x) = (&estimate.noise, &estimate.fit.x);
    let residuals = segment_residuals(measurement, &segments, noise, x);
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
