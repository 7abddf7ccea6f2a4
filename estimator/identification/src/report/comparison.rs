//! Residuals of a log's readings with CAD, with CAD and fitted offsets, and with the identified
//! parameters.

use crate::dataset::observation::Annotated;
use crate::fit::Identified;
use crate::linear::nuisance::NuisanceEstimate;
use crate::measurement::channels::{attribute_to, channel_of};
use crate::measurement::reduction::{OFFSET_VARIANCE, Residuals};
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::Unknowns;
use crate::prepared_log::{PreparedLog, training_instants};
use crate::report::outcome::ModelComparison;
use crate::report::prediction::{self, JudgedParameters};
use crate::robot::Robot;
use nalgebra::{DMatrix, DVector};

/// A joint that moves by less is still \[rad\].
pub(crate) const STILL: f64 = 0.01;

/// What a log is compared with: two sets of parameters.
pub(crate) struct Judged<'a> {
    pub identified: &'a Identified<'a>,
    /// CAD, the identified parameters.
    pub sets: [DVector<f64>; 2],
    /// The same with the friction of the training logs.
    pub candidates: [JudgedParameters; 2],
    /// A root of the identified parameters' covariance.
    pub root: &'a DMatrix<f64>,
}

impl<'a> Judged<'a> {
    pub(crate) fn new(
        logs: &[PreparedLog],
        identified: &'a Identified<'a>,
        root: &'a DMatrix<f64>,
    ) -> Self {
        let sets = [identified.cad.clone(), identified.d.clone()];
        let all = training_instants(logs);
        let friction = prediction::friction(&identified.measurement, all, &sets);
        let candidates =
            [0, 1].map(|set| JudgedParameters::constant(&sets[set], friction[set].clone()));
        Self {
            identified,
            sets,
            candidates,
            root,
        }
    }
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

pub(crate) fn three<T: Copy>(values: [T; 3]) -> ModelComparison<T> {
    ModelComparison {
        cad: values[0],
        cad_fitted: values[1],
        identified: values[2],
    }
}

/// Parameters and nuisance parameters, for each comparison.
type ComparedCases<'a> = [(&'a DVector<f64>, &'a [f64]); 3];

/// Parameters and nuisance parameters that are compared in a block: CAD with the configured
/// offsets, CAD with the fitted ones, the identified parameters with the fitted ones.
pub(crate) fn cases<'a>(
    sets: &'a [DVector<f64>; 2],
    configured: &'a [f64],
    block: &'a NuisanceEstimate,
) -> ComparedCases<'a> {
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
    /// Per sensor (index in the layout) and instant, the number of rows with its reading: six of
    /// each sub-tree that it bounds, unless the sub-tree is disturbed.
    pub rows: Vec<Vec<usize>>,
}

/// What is compared of a channel at an instant: its load, its errors, and the number of rows.
#[derive(Clone, Copy)]
struct ComparedReading {
    load: f64,
    errors: [f64; 3],
    rows: usize,
}

impl ComparedReading {
    /// Where there is no prediction.
    const NONE: Self = Self {
        load: f64::NAN,
        errors: [f64::NAN; 3],
        rows: 0,
    };
}

impl SensorComparison {
    /// `residuals`: of CAD and the identified parameters.
    pub(crate) fn new(judged: &Judged<'_>, instants: &[Annotated], residuals: &Residuals) -> Self {
        let identified = judged.identified;
        let unknowns = identified.unknowns();
        let configured = configured_nuisance(identified.robot(), unknowns);
        let variances = identified.noise.offset_tracking_variances();
        let (sensors, ranges) = (unknowns.sensors.len(), &residuals.ranges);
        let blocks = ranges.iter().zip(&residuals.nuisance);
        let parts = (identified.measurement).map(blocks, |measurement, (range, block)| {
            let cases = cases(&judged.sets, &configured, block);
            let mut out = Vec::new();
            for instant in &instants[range.clone()] {
                let start = out.len();
                out.resize(start + 6 * sensors, ComparedReading::NONE);
                if sensors > 0 {
                    let (sensors, rows) = (&unknowns.sensors, measurement.rows(instant));
                    compare(
                        instant,
                        sensors,
                        &rows,
                        &variances,
                        &cases,
                        &mut out[start..],
                    );
                }
            }
            out
        });
        let empty = || vec![vec![f64::NAN; instants.len()]; 6 * sensors];
        let mut comparison = Self {
            load: empty(),
            errors: [empty(), empty(), empty()],
            rows: vec![vec![0; instants.len()]; sensors],
        };
        let each = parts
            .iter()
            .flat_map(|part| part.chunks_exact((6 * sensors).max(1)));
        for (i, values) in ranges.iter().cloned().flatten().zip(each) {
            for (channel, value) in values.iter().enumerate() {
                comparison.load[channel][i] = value.load;
                let rows = &mut comparison.rows[channel / 6][i];
                *rows = value.rows.max(*rows);
                for (errors, error) in comparison.errors.iter_mut().zip(value.errors) {
                    errors[channel][i] = error;
                }
            }
        }
        comparison
    }
}

/// Compares the readings of these sensors at an instant, given the variances of the channels and
/// [`cases`].
fn compare(
    instant: &Annotated,
    sensors: &[usize],
    rows: &MeasurementRows,
    variances: &[f64],
    cases: &ComparedCases<'_>,
    out: &mut [ComparedReading],
) {
    let residuals = cases
        .map(|(d, s)| DVector::from_fn(rows.count, |row, _| rows.residual(row, d.as_slice(), s)));
    let (_, offsets) = cases[2];
    for (index, &sensor) in sensors.iter().enumerate() {
        let channels = 6 * index..6 * index + 6;
        let Some(map) = attribute_to(rows, variances, channels.clone()) else {
            continue;
        };
        let has = |row: &usize| rows.g(*row)[channels.clone()].iter().any(|g| *g != 0.0);
        let count = (0..rows.count).filter(has).count();
        let errors = residuals.each_ref().map(|residual| &map * residual);
        let reading = instant.readings[sensor].torque_first();
        for (k, channel) in channels.clone().enumerate() {
            if rows.has(channel) {
                out[channel] = ComparedReading {
                    load: reading[k] - offsets[channel],
                    errors: errors.each_ref().map(|error| error[k]),
                    rows: count,
                };
            }
        }
    }
}

/// The configured offsets, in the columns of the nuisance parameters.
pub(crate) fn configured_nuisance(robot: &Robot, unknowns: &Unknowns) -> Vec<f64> {
    let mut configured = vec![0.0; unknowns.nuisance()];
    for (index, &sensor) in unknowns.sensors.iter().enumerate() {
        let (offset, _) = robot.offsets[sensor];
        for (axis, value) in offset.force_first().into_iter().enumerate() {
            configured[channel_of(index, axis)] = value;
        }
    }
    configured
}

impl Judged<'_> {
    /// Predicted standard deviation of each channel's residual at each of these instants, from the
    /// parameters' covariance and the noise of all channels that the prediction uses.
    pub(crate) fn deviations<'b>(
        &self,
        instants: impl Iterator<Item = &'b Annotated>,
    ) -> Vec<Vec<f64>> {
        let measurement = &self.identified.measurement;
        measurement.map(instants, |own, instant| {
            self.deviations_of(&own.rows(instant))
        })
    }

    fn deviations_of(&self, rows: &MeasurementRows) -> Vec<f64> {
        let (unknowns, noise) = (self.identified.unknowns(), &self.identified.noise);
        let mut out = vec![f64::NAN; unknowns.channels()];
        let a = DMatrix::from_fn(rows.count, unknowns.parameters(), |i, j| rows.a(i)[j]);
        let a = a * self.root;
        let deviations = DMatrix::from_fn(rows.count, unknowns.channels(), |i, c| {
            rows.n(i)[c] * noise.square[c].sqrt()
        });
        let variances = noise.offset_tracking_variances();
        let sensors = (0..unknowns.sensors.len()).map(|index| 6 * index..6 * index + 6);
        let joints = unknowns.wrenches()..unknowns.channels();
        for channels in sensors.chain(joints.map(|c| c..c + 1)) {
            let Some(map) = attribute_to(rows, &variances, channels.clone()) else {
                continue;
            };
            let (parameters, noise) = (&map * &a, &map * &deviations);
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
    pub(crate) fn covered(&self, instants: &[Annotated], errors: &[&[f64]]) -> Vec<f64> {
        let some = (0..instants.len()).step_by((instants.len() / 200).max(1));
        let is_compared = |i: &usize| errors.iter().any(|errors| errors[*i].is_finite());
        let some: Vec<usize> = some.filter(is_compared).collect();
        let deviations = self.deviations(some.iter().map(|&i| &instants[i]));
        let of_channel = |(channel, errors): (usize, &&[f64])| {
            let pairs = some.iter().zip(&deviations);
            let pairs = pairs.filter(|(i, _)| errors[**i].is_finite());
            let (mut inside, mut count) = (0.0, 0.0);
            for (i, deviations) in pairs {
                let is_inside = errors[*i].abs() <= 1.96 * deviations[channel];
                inside += f64::from(u8::from(is_inside));
                count += 1.0;
            }
            inside / count
        };
        errors.iter().enumerate().map(of_channel).collect()
    }
}
