//! One fit: noise of every channel and maximum a posteriori (MAP) parameters in turn, until both
//! converge.

use crate::finding::{Finding, FindingCode};
use crate::linear::information::Information;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_estimate::estimate_noise;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::noise_model::Seconds;
use crate::measurement::reduction::ReducedLog;
use crate::measurement::unknowns::{ExtraParameter, Unknowns};
use crate::nested_test;
use crate::prepared_log::{PreparedLog, reduced_segments, sample, segment_residuals};
use crate::prior::{MapEstimate, Posterior, Prior, PriorError};
use crate::robot::{IdentificationInput, Robot};
use nalgebra::DVector;
use proprio_dynamics::DynamicsError;
use proprio_dynamics::calibration::{Kind, Unknown};
use proprio_dynamics::spatial::RigidInertia;

/// Why there is no outcome at all. (Logs without information about the parameters do give one,
/// which states the reason.)
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IdentifyError {
    /// No log to train on.
    #[error("no log to identify from: give at least one training log")]
    NoLogs,
    /// The recorded motion does not fit the robot's model.
    #[error("the logs do not fit the robot's model: {0}")]
    Dynamics(#[from] DynamicsError),
    /// The MAP parameters cannot be computed.
    #[error("no parameters can be fitted to the logs: {0}")]
    MapEstimate(#[from] PriorError),
}

/// Most rounds of noise and MAP estimate.
const ROUNDS: usize = 14;

/// Rounds end when no variance's logarithm changes by more than this in a round, or over a limit
/// cycle of rounds: a standard deviation by a twentieth.
const CONVERGED: f64 = 0.1;

/// The identified parameters, noise and information, from which the report is made.
pub(crate) struct Identified<'a> {
    pub measurement: MeasurementModel<'a>,
    pub inputs: Vec<IdentificationInput>,
    /// The calibration parameters that were identified, too.
    pub calibrated: Kind,
    pub prior: Prior,
    pub noise: NoiseModel,
    pub information: Information,
    pub fit: MapEstimate,
    /// Identified parameters less CAD, after shrinking.
    pub d: DVector<f64>,
    /// CAD's parameters in the same columns: zero, except for parameters that CAD does not contain,
    /// which have the values that best fit the data together with CAD ([`parameters_without_cad`]).
    pub cad: DVector<f64>,
    /// Retained fraction of the change from CAD, per link of the layout, then per extra parameter.
    pub retained: Vec<f64>,
    pub findings: Vec<Finding>,
    /// Per segment of the training logs, in order.
    pub reduced: Vec<ReducedLog>,
}

impl<'a> Identified<'a> {
    pub(crate) fn robot(&self) -> &'a Robot {
        self.measurement.robot()
    }

    /// The meaning of all columns.
    pub(crate) fn unknowns(&self) -> &Unknowns {
        self.measurement.unknowns()
    }
}

/// Lower bounds of the variances. Standard deviations: a hundredth of the configured one for an F/T
/// channel, 1e-4 Nm for a joint torque.
pub(crate) fn least_variances(robot: &Robot, unknowns: &Unknowns) -> Vec<f64> {
    let mut least: Vec<f64> = unknowns.stated(robot).map(|x| (0.01 * x).powi(2)).collect();
    least.resize(unknowns.channels(), 1e-8);
    least
}

/// The information of all segments together.
pub(crate) fn added(reduced: &[ReducedLog], unknowns: usize) -> Information {
    let columns: Vec<usize> = (0..unknowns).collect();
    let mut sum = Information::new(unknowns);
    for part in reduced {
        let _ = sum.merge(&part.information, &columns);
    }
    sum
}

pub(crate) fn posterior(
    prior: &Prior,
    unknowns: &Unknowns,
    information: &Information,
) -> Result<Posterior, IdentifyError> {
    let (r, z) = information.to_triangle();
    Ok(Posterior::new(
        prior,
        &unknowns.links,
        &r,
        &z,
        &unknowns.precision,
    )?)
}

/// CAD's inertial parameters (`d = 0`); parameters that CAD does not contain
/// ([`ExtraParameter::lacks_cad`]) have the values that best fit these data and their priors
/// together with CAD. No rotor's inertia is negative. (These parameters belong to the robot, so
/// they are not fitted to the log on which CAD is compared.)
pub(crate) fn parameters_without_cad(
    unknowns: &Unknowns,
    information: &Information,
) -> DVector<f64> {
    let mut x = DVector::zeros(unknowns.parameters());
    let mut columns = unknowns.parameters_without_cad();
    let (r, z) = information.to_triangle();
    let (rows, precision) = (r.nrows(), &unknowns.precision);
    while !columns.is_empty() {
        let mut system = r
            .select_columns(&columns)
            .resize_vertically(rows + columns.len(), 0.0);
        for (index, &column) in columns.iter().enumerate() {
            system[(rows + index, index)] = precision[column - unknowns.inertial()].sqrt();
        }
        let qr = system.qr();
        let right = qr
            .q()
            .tr_mul(&z.clone().resize_vertically(rows + columns.len(), 0.0));
        let Some(values) = qr.r().solve_upper_triangular(&right) else {
            break;
        };
        let is_negative = |column: usize, value: f64| value < 0.0 && is_rotor(unknowns, column);
        let found = columns.iter().copied().zip(values.iter().copied());
        let not_negative: Vec<usize> = found
            .clone()
            .filter(|(column, value)| !is_negative(*column, *value))
            .map(|(column, _)| column)
            .collect();
        if not_negative.len() == columns.len() {
            found.for_each(|(column, value)| x[column] = value);
            break;
        }
        columns = not_negative;
    }
    x
}

fn is_rotor(unknowns: &Unknowns, column: usize) -> bool {
    let index = column.checked_sub(unknowns.inertial());
    let extra = index.and_then(|index| unknowns.extra.get(index));
    matches!(extra, Some(ExtraParameter::RotorInertia(_)))
}

/// The MAP parameters without negative rotor inertias: a negative one is fixed at zero, and the
/// rest is fitted again.
pub(crate) fn without_negative_rotors(
    prior: &Prior,
    unknowns: &Unknowns,
    information: &Information,
    fit: &MapEstimate,
) -> Result<DVector<f64>, IdentifyError> {
    let mut x = fit.x.clone();
    let mut keep: Vec<usize> = (0..unknowns.parameters()).collect();
    let (r, z) = information.to_triangle();
    let is_negative =
        |x: &DVector<f64>, column: usize| x[column] < 0.0 && is_rotor(unknowns, column);
    while keep.iter().any(|&column| is_negative(&x, column)) {
        keep.retain(|&column| !is_negative(&x, column));
        let precision = &unknowns.precision;
        let of_kept = keep.iter().filter(|column| **column >= unknowns.inertial());
        let precision: Vec<f64> = of_kept
            .map(|column| precision[column - unknowns.inertial()])
            .collect();
        let refit = Posterior::new(
            prior,
            &unknowns.links,
            &r.select_columns(&keep),
            &z,
            &precision,
        )?
        .fit(fit.tau)?;
        x = DVector::zeros(unknowns.parameters());
        for (&column, value) in keep.iter().zip(&refit.x) {
            x[column] = *value;
        }
    }
    Ok(x)
}

/// Rotors whose estimated inertia is significantly negative.
pub(crate) fn negative_rotors(
    robot: &Robot,
    unknowns: &Unknowns,
    fit: &MapEstimate,
) -> Vec<Finding> {
    if unknowns.extra.is_empty() {
        return Vec::new();
    }
    let root = fit.covariance_root();
    let mut findings = Vec::new();
    let significant = nested_test::threshold(unknowns.extra.len());
    for (extra, column) in unknowns.extra.iter().zip(unknowns.inertial()..) {
        let ExtraParameter::RotorInertia(dof) = *extra else {
            continue;
        };
        let (value, deviation) = (fit.x[column], root.row(column).norm());
        if value < -significant * deviation {
            let joint = robot.model.dof_name(dof).to_owned();
            findings.push(Finding::warning(
                FindingCode::NegativeRotorInertia,
                &joint,
                format!(
                    "{joint}: its estimated rotor inertia is negative, {value:.4} +- \
                     {deviation:.4}, and was set to 0. Check the sign of its torque, velocity and \
                     acceleration, the time offset between its torque and its encoder, and \
                     whether torques are measured at the motors (identification.torque_side)"
                ),
            ));
        }
    }
    findings
}

/// Noise, prior and MAP estimate after the last round.
pub(crate) struct NoiseAndMap {
    pub(crate) prior: Prior,
    pub(crate) noise: NoiseModel,
    pub(crate) fit: MapEstimate,
    pub(crate) information: Information,
    /// Precision of the prior of each extra parameter ([`gain_precision`]).
    pub(crate) precision: Vec<f64>,
    /// Largest change of a variance's logarithm in the last round if the rounds did not converge;
    /// else 0.
    pub(crate) change: f64,
}

/// Estimates noise and MAP parameters in turn until both converge. `from`: the initial noise, of a
/// fit to nearly the same data; without it, the residuals of CAD give it.
pub(crate) fn alternate_noise_and_map(
    measurement: &MeasurementModel<'_>,
    training: &[&PreparedLog],
    drift: OffsetDrift,
    from: Option<NoiseModel>,
    progress: &mut dyn FnMut(String, f64),
) -> Result<NoiseAndMap, IdentifyError> {
    let (robot, mut unknowns) = (measurement.robot(), measurement.unknowns().clone());
    let prior = Prior::new(robot.model.inertias())?.with_roughly(robot.urdf_relative_std);
    let least = least_variances(robot, &unknowns);
    let fastest = drift.fastest(measurement);
    let sampled = sample(measurement, training);
    let noise_of_residuals = |noise: &NoiseModel, d: &DVector<f64>| {
        let mut residuals = segment_residuals(measurement, &sampled, noise, d);
        let unknowns = measurement.unknowns();
        let seconds = Seconds::of(unknowns, &sampled, &residuals);
        seconds.standardise(unknowns, &sampled, &mut residuals);
        NoiseModel {
            seconds,
            ..estimate_noise(unknowns, &residuals, &fastest, &least)
        }
    };
    let has_cad = unknowns.parameters_without_cad().is_empty();
    let noise = from.unwrap_or_else(|| {
        let unknown = NoiseModel::unknown(least.clone());
        (0..3).fold(unknown, |noise, _| {
            let cad = if has_cad {
                DVector::zeros(unknowns.parameters())
            } else {
                let reduced = reduced_segments(measurement, &sampled, &noise);
                parameters_without_cad(&unknowns, &added(&reduced, unknowns.parameters()))
            };
            noise_of_residuals(&noise, &cad)
        })
    });
    let mut rounds = vec![noise];
    loop {
        let round = rounds.len();
        progress(
            format!("round {round}"),
            0.62 * (round - 1) as f64 / ROUNDS as f64,
        );
        let last = &rounds[round - 1];
        let reduced = reduced_segments(measurement, &sampled, last);
        let information = added(&reduced, unknowns.parameters());
        let fit = posterior(&prior, &unknowns, &information)?.maximise_evidence()?;
        unknowns.precision = gain_precision(robot, &unknowns, &fit);
        let next = noise_of_residuals(last, &fit.x);
        let change = next.change(last);
        rounds.push(next);
        let (noise, change) = match NoiseModel::end_limit_cycle(&rounds, CONVERGED) {
            Some(noise) => (noise, 0.0),
            None if round == ROUNDS => (rounds.swap_remove(round), change),
            None => continue,
        };
        return Ok(NoiseAndMap {
            prior,
            noise,
            fit,
            information,
            precision: unknowns.precision,
            change,
        });
    }
}

/// The precisions of the extra parameters' priors for the next round: the scale of the gains'
/// errors, relative to the stated one (`identification.gain_std`), maximises the evidence.
///
/// ```text
/// scale^2 = (sum x^2 / sigma^2 + nu) / (gamma + nu),   gamma = sum (1 - var x / (scale sigma)^2)
/// ```
///
/// (MacKay, Neural Computation 1992.) The stated scale counts as one (`nu`) determined gain, so it
/// stands where the logs determine none. A tenth of the stated error at least, or a gain would be
/// known exactly; and no more than stated: two sensors that disagree about a large load between
/// them agree best with gains of zero, and would leave none of CAD's change (the real leg, with its
/// foot on the ground).
///
/// Cross-talk is the greater part of the real leg's error: without gains, its parameters are 27 %
/// worse on other spans.
fn gain_precision(robot: &Robot, unknowns: &Unknowns, fit: &MapEstimate) -> Vec<f64> {
    const SCALE: (f64, f64) = (0.1, 1.0);
    let is_gain = |extra: &ExtraParameter| {
        matches!(extra, ExtraParameter::Calibration(_, Unknown::Gain { .. }))
    };
    let mut precision = unknowns.precision.clone();
    if !unknowns.extra.iter().any(is_gain) {
        return precision;
    }
    let root = fit.covariance_root();
    let (mut square, mut gamma) = (1.0, 1.0);
    let extra = unknowns.extra.iter().enumerate();
    for (index, extra) in extra.filter(|(_, own)| is_gain(own)) {
        let column = unknowns.inertial() + index;
        square += fit.x[column].powi(2) * extra.precision(robot);
        gamma += (1.0 - root.row(column).norm_squared() * precision[index]).max(0.0);
    }
    let scale = (square / gamma).sqrt().clamp(SCALE.0, SCALE.1);
    for (precision, extra) in precision.iter_mut().zip(&unknowns.extra) {
        if is_gain(extra) {
            *precision = extra.precision(robot) / (scale * scale);
        }
    }
    precision
}

/// How fast an offset may drift (random walk).
#[derive(Clone, Copy, Debug)]
pub(crate) enum OffsetDrift {
    /// As fast as the time constant of a walk allows ([`estimate_noise`]): the residual then shows
    /// undeclared disturbances.
    Free,
    /// At most by the sensor's stated noise per square root of a second. Other slow changes are
    /// model error and count as noise: parameters that are fitted together with offsets that follow
    /// model error predict other logs less well.
    AsStated,
}

impl OffsetDrift {
    /// Per channel of F/T sensors, the greatest rate [unit^2/s].
    pub(crate) fn fastest(self, measurement: &MeasurementModel<'_>) -> Vec<f64> {
        let stated = measurement.unknowns().stated(measurement.robot());
        match self {
            Self::Free => stated.map(|_| f64::INFINITY).collect(),
            Self::AsStated => stated.map(|x| x * x).collect(),
        }
    }
}

/// Values per link and per extra parameter, repeated for each column.
pub(crate) fn per_column(unknowns: &Unknowns, values: &[f64]) -> Vec<f64> {
    let (links, extra) = values.split_at(unknowns.links.len());
    let of_links = links.iter().flat_map(|value| [*value; 10]);
    of_links.chain(extra.iter().copied()).collect()
}

/// A warning that the rounds ended before noise and prior scale converged.
pub(crate) fn unsettled(change: f64) -> Option<Finding> {
    (change > 0.0).then(|| {
        Finding::warning(
            FindingCode::NotConverged,
            "",
            format!(
                "noise and the prior's scale did not converge in {ROUNDS} rounds: the last round \
             changed a variance by {:.0} %, and the standard deviations are uncertain by as much; \
             record longer logs",
                100.0 * change.exp_m1()
            ),
        )
    })
}

/// Inertias of all links: CAD plus `d`, given in the columns of `unknowns`.
pub(crate) fn link_inertias(
    robot: &Robot,
    unknowns: &Unknowns,
    d: &DVector<f64>,
) -> Vec<RigidInertia> {
    let mut inertias = robot.model.inertias().to_vec();
    for (index, &link) in unknowns.links.iter().enumerate() {
        let mut phi = inertias[link].parameters();
        for (value, change) in phi.iter_mut().zip(d.rows(10 * index, 10).iter()) {
            *value += change;
        }
        inertias[link] = RigidInertia::from_parameters(&phi);
    }
    inertias
}
