//! Residuals of a log's readings with CAD, with CAD and fitted offsets, and with the identified
//! parameters.

use crate::dataset::observation::Annotated;
use crate::fit::Identified;
use crate::linear::nuisance::NuisanceEstimate;
use crate::measurement::channels::{attribute_to, channel_of};
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::{OFFSET_VARIANCE, Residuals};
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::Unknowns;
use crate::parallel;
use crate::report::outcome::ModelComparison;
use crate::report::prediction::JudgedParameters;
use crate::robot::Robot;
use nalgebra::{DMatrix, DVector};

/// A joint that moves by less is still \[rad\].
pub(crate) const STILL: f64 = 0.01;

/// What a log is compared with: two sets of parameters.
pub(crate) struct Judged<'a> {
    pub identified: &'a Identified,
    /// CAD, the identified parameters.
    pub sets: [DVector<f64>; 2],
    /// The same with the friction of the training logs.
    pub candidates: [JudgedParameters; 2],
    /// A root of the identified parameters' covariance.
    pub root: &'a DMatrix<f64>,
}

/// A measured torque and its residuals.
pub(crate) struct TorqueSeries {
    /// The degree of freedom.
    pub dof: usize,
    /// The residuals with CAD, with CAD and friction fitted to the log, with identified parameters
    /// and friction fitted, with CAD and the training logs' friction, with identified parameters
    /// and the training logs' friction.
    pub errors: [Vec<f64>; 5],
    pub measured: Vec<f64>,
}

/// An offset with this variance or more has not been observed.
pub(crate) const UNREAD: f64 = 0.9 * OFFSET_VARIANCE;

/// Blocks of instants that one thread takes at a time.
pub(crate) const BLOCKS_PER_TASK: usize = 64;

pub(crate) fn three<T: Copy>(values: [T; 3]) -> ModelComparison<T> {
    ModelComparison {
        cad: values[0],
        cad_fitted: values[1],
        identified: values[2],
    }
}

/// Parameters and nuisance parameters that are compared in a block: CAD with the configured
/// offsets, CAD with the fitted ones, the identified parameters with the fitted ones.
pub(crate) fn cases<'a>(
    sets: &'a [DVector<f64>; 2],
    configured: &'a [f64],
    block: &'a NuisanceEstimate,
) -> [(&'a DVector<f64>, &'a [f64]); 3] {
    let (fitted, own) = block.x.as_slice().split_at(block.x.nrows());
    [(&sets[0], configured), (&sets[0], fitted), (&sets[1], own)]
}

/// Readings of each F/T sensor and their predictions from everything else: the links on its
/// contact-free side and the readings of their other sensors.
///
/// Noise is estimated from residuals that are divided among the sensors of a sub-tree
/// ([`Residuals`]). For a comparison, no part of a sensor's error may be attributed to another one:
/// the whole residual is attributed to the compared sensor ([`attribute_to`]). Of two sensors with
/// a link between them, each is compared with the other.
pub(crate) struct SensorComparison {
    /// Per channel and instant: the reading less its fitted offset; NaN where there is no
    /// prediction.
    pub load: Vec<Vec<f64>>,
    /// The same less the prediction: by CAD with the configured offsets, by CAD with fitted ones,
    /// by the identified parameters with fitted ones.
    pub errors: [Vec<Vec<f64>>; 3],
    /// Per sensor (place in the layout) and instant, the number of rows with its reading: six of
    /// each sub-tree that it bounds, unless the sub-tree is disturbed.
    pub rows: Vec<Vec<usize>>,
}

impl SensorComparison {
    /// `sets`: CAD, the identified parameters; `left`: of these two.
    pub(crate) fn new(
        measurement: &MeasurementModel<'_>,
        instants: &[Annotated],
        residuals: &Residuals,
        identified: &Identified,
        sets: &[DVector<f64>; 2],
    ) -> Self {
        let unknowns = measurement.unknowns().clone();
        let configured = configured_nuisance(measurement.robot(), &unknowns);
        let empty = || vec![vec![f64::NAN; instants.len()]; 6 * unknowns.sensors.len()];
        let (mut load, mut errors) = (empty(), [empty(), empty(), empty()]);
        let variances = identified.noise.offset_tracking_variances();
        let channels = 6 * unknowns.sensors.len();
        let mut held = vec![vec![0; instants.len()]; unknowns.sensors.len()];
        let parts = parallel::map_with(
            residuals.ranges.len().div_ceil(BLOCKS_PER_TASK),
            || (measurement.clone(), MeasurementRows::new(&unknowns)),
            |(measurement, rows), part| {
                let blocks = part * BLOCKS_PER_TASK
                    ..residuals.ranges.len().min((part + 1) * BLOCKS_PER_TASK);
                let mut out = Vec::new();
                for (range, block) in residuals.ranges[blocks.clone()]
                    .iter()
                    .zip(&residuals.nuisance[blocks])
                {
                    let cases = cases(sets, &configured, block);
                    let (_, own) = cases[2];
                    for instant in &instants[range.clone()] {
                        let start = out.len();
                        out.resize(start + channels, ([f64::NAN; 4], 0));
                        if channels == 0 || measurement.make(instant, rows).is_err() {
                            continue;
                        }
                        let residuals = cases.map(|(d, s)| {
                            DVector::from_fn(rows.count, |row, _| {
                                rows.residual(row, d.as_slice(), s)
                            })
                        });
                        for (place, &sensor) in unknowns.sensors.iter().enumerate() {
                            let Some(map) =
                                attribute_to(rows, &variances, 6 * place..6 * place + 6)
                            else {
                                continue;
                            };
                            let has = |row: &usize| {
                                rows.g(*row)[6 * place..6 * place + 6]
                                    .iter()
                                    .any(|g| *g != 0.0)
                            };
                            let count = (0..rows.count).filter(has).count();
                            let reading = instant.readings[sensor];
                            let [cad, cad_fitted, identified] =
                                residuals.each_ref().map(|residual| &map * residual);
                            for (k, value) in
                                reading.torque.iter().chain(&reading.force).enumerate()
                            {
                                let channel = 6 * place + k;
                                if rows.has(channel) {
                                    let values = [
                                        value - own[channel],
                                        cad[k],
                                        cad_fitted[k],
                                        identified[k],
                                    ];
                                    out[start + channel] = (values, count);
                                }
                            }
                        }
                    }
                }
                out
            },
        );
        let places = residuals.ranges.iter().cloned().flatten();
        let each = parts
            .iter()
            .flat_map(|part| part.chunks_exact(channels.max(1)));
        for (i, values) in places.zip(each) {
            for (channel, ([own, off @ ..], count)) in values.iter().enumerate() {
                load[channel][i] = *own;
                held[channel / 6][i] = held[channel / 6][i].max(*count);
                errors
                    .iter_mut()
                    .zip(off)
                    .for_each(|(errors, off)| errors[channel][i] = *off);
            }
        }
        Self {
            load,
            errors,
            rows: held,
        }
    }
}

/// The configured offsets, in the columns of the nuisance parameters.
pub(crate) fn configured_nuisance(robot: &Robot, unknowns: &Unknowns) -> Vec<f64> {
    let mut configured = vec![0.0; unknowns.nuisance()];
    for (place, &sensor) in unknowns.sensors.iter().enumerate() {
        for (axis, value) in robot.offsets[sensor]
            .0
            .force_first()
            .into_iter()
            .enumerate()
        {
            configured[channel_of(place, axis)] = value;
        }
    }
    configured
}

/// Predicted standard deviation of each channel's residual at an instant, from the parameters'
/// covariance and the noise of all channels that the prediction uses.
pub(crate) fn predicted_deviations(
    measurement: &mut MeasurementModel<'_>,
    instant: &Annotated,
    identified: &Identified,
    root: &DMatrix<f64>,
) -> Vec<f64> {
    let unknowns = measurement.unknowns().clone();
    let mut rows = MeasurementRows::new(&unknowns);
    let mut out = vec![f64::NAN; unknowns.channels()];
    if measurement.make(instant, &mut rows).is_err() {
        return out;
    }
    let a = DMatrix::from_fn(rows.count, unknowns.parameters(), |i, j| rows.a(i)[j]) * root;
    let noise = DMatrix::from_fn(rows.count, unknowns.channels(), |i, c| {
        rows.n(i)[c] * identified.noise.square[c].sqrt()
    });
    let wrenches = 6 * unknowns.sensors.len();
    let sensors = (0..unknowns.sensors.len()).map(|place| 6 * place..6 * place + 6);
    for channels in sensors.chain((wrenches..unknowns.channels()).map(|c| c..c + 1)) {
        let Some(map) = attribute_to(
            &rows,
            &identified.noise.offset_tracking_variances(),
            channels.clone(),
        ) else {
            continue;
        };
        let (parameters, noise) = (&map * &a, &map * &noise);
        for (k, channel) in channels
            .enumerate()
            .filter(|(_, channel)| rows.has(*channel))
        {
            out[channel] = parameters.row(k).norm().hypot(noise.row(k).norm());
        }
    }
    out
}

/// Per channel, the fraction of its errors within 1.96 standard deviations, at some of the
/// instants.
pub(crate) fn covered(
    measurement: &mut MeasurementModel<'_>,
    instants: &[Annotated],
    errors: &[&[f64]],
    identified: &Identified,
    root: &DMatrix<f64>,
) -> Vec<f64> {
    let mut counts = vec![(0.0, 0.0); errors.len()];
    for i in (0..instants.len()).step_by((instants.len() / 200).max(1)) {
        if errors.iter().all(|errors| !errors[i].is_finite()) {
            continue;
        }
        let deviations = predicted_deviations(measurement, &instants[i], identified, root);
        for ((errors, deviation), (inside, count)) in errors.iter().zip(deviations).zip(&mut counts)
        {
            if errors[i].is_finite() {
                *inside += f64::from(u8::from(errors[i].abs() <= 1.96 * deviation));
                *count += 1.0;
            }
        }
    }
    counts
        .into_iter()
        .map(|(inside, count)| inside / count)
        .collect()
}
