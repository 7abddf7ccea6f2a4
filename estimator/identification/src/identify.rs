//! Several recorded logs to one set of parameters: the stages of [`identify`].
//!
//! 1. [`prepare_logs`]: observations whose motion is not known are dropped, repeated logs are
//!    refused.
//! 2. [`plausible_model`]: what contradicts the configuration is refused: units and signs of
//!    readings, frames of F/T sensors, gravity ([`crate::diagnose::configuration`]). The
//!    measurement model makes rows of observations ([`crate::measurement::model`]).
//! 3. [`exclude_disturbed`]: noise and MAP estimate in turn, until the noise converges
//!    ([`crate::fit::alternate_noise_and_map`]). After each such fit, undeclared contacts
//!    ([`crate::diagnose::undeclared`]) and loads ([`crate::diagnose::load`]) are excluded; then
//!    the next fit, until they do not change.
//! 4. [`with_gains`]: all gains of the F/T sensors, unless the configuration says otherwise; then 3
//!    again.
//! 5. [`cross_validated_fit`]: fifths of the logs are predicted from the others. That share of the
//!    change from CAD is retained which predicts best ([`crate::cross_validation`]).
//! 6. Disturbances in validation logs, errors of encoders and delays ([`crate::diagnose::search`])
//!    are reported, not corrected.
//! 7. [`assemble::outcome`]: figures for every log and the parameters' uncertainty.

mod gains;

use crate::cross_validation;
use crate::dataset::{Dataset, LogRole};
use crate::diagnose::load::LoadChange;
use crate::diagnose::search::{Search, wrong_signs};
use crate::diagnose::undeclared;
use crate::diagnose::{configuration, load};
use crate::finding::{Finding, FindingCode};
use crate::fit::{
    Identified, IdentifyError, NoiseAndMap, OffsetDrift, added, alternate_noise_and_map,
    negative_rotors, parameters_without_cad, per_column, posterior, unsettled,
    without_negative_rotors,
};
use crate::identify::gains::fit_gains;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::{NoiseModel, Seconds};
use crate::prepared_log::{
    PreparedLog, SEGMENT_INSTANTS, no_log, prepare, reduced_segments, refuse_repeated, sample,
    segment_residuals, segments_of, training_instants, training_logs, training_logs_mut,
};
use crate::report::assemble;
use crate::report::outcome::Outcome;
use crate::robot::{IdentificationInput, Robot, TorqueSide};
use proprio_dynamics::calibration::{Gain, Kind};
use std::ops::ControlFlow;

/// Progress of [`identify`].
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// The current step, in a few words: `cross-validation`, `figures`.
    pub step: String,
    /// Fraction done, 0 to 1.
    pub done: f64,
}

/// A load is accepted if, without its side of the log, the noise variances of its part of the robot
/// are smaller by this factor (geometric mean over the channels there).
const LOAD_VARIANCE_RATIO: f64 = 2.0;

/// Most fits after which the excluded disturbances may still change.
const EXCLUSION_ROUNDS: usize = 12;

/// Most loads that are looked for.
const MAX_LOADS: usize = 4;

/// After this many candidate loads were rejected, no more are looked for.
const MAX_REJECTED_LOADS: usize = 2;

/// Most rounds of contacts and gains.
const GAIN_ROUNDS: usize = 4;

/// Identifies the robot's parameters from logs. `inputs`: the measurements to use; none: the F/T
/// sensors if the robot has any, else the measured joint torques.
///
/// # Errors
/// [`IdentifyError`]: no log to train on, observations of another robot, numbers that no parameters
/// can be fitted to.
pub fn identify(
    robot: &Robot,
    datasets: Vec<Dataset>,
    inputs: &[IdentificationInput],
    progress: &mut dyn FnMut(&Progress),
) -> Result<Outcome, IdentifyError> {
    if !datasets.iter().any(|log| log.role == LogRole::Train) {
        return Err(IdentifyError::NoLogs);
    }
    let mut progress = |step: String, done: f64| progress(&Progress { step, done });
    let inputs = chosen_inputs(robot, inputs);

    // 1. Logs.
    let mut logs = prepare_logs(robot, datasets);

    // 2. Measurement model, plausibility of units and frames.
    let mut measurement = match plausible_model(robot, &inputs, &mut logs)? {
        ControlFlow::Continue(measurement) => measurement,
        ControlFlow::Break((reason, findings)) => {
            return Ok(assemble::nothing(robot, &logs, reason, findings));
        }
    };
    let temperature_only = Kind {
        gain: Gain::None,
        ..robot.calibrated
    };
    measurement.set_calibration_unknowns(temperature_only, training_instants(&logs));

    // 3. Noise and MAP estimate, without undeclared disturbances.
    let mut clean = exclude_disturbed(&measurement, &mut logs, &mut progress)?;

    let signs = wrong_signs(&measurement, &training_logs(&logs), &clean.estimate);

    // 4. Gains of the F/T sensors.
    let calibrated = calibrated(&measurement);
    if calibrated.gain != Gain::None {
        clean = with_gains(
            &mut measurement,
            &mut logs,
            calibrated,
            clean,
            &mut progress,
        )?;
    }
    undeclared::report(&measurement, &mut logs, &clean.loads, &clean.estimate);

    // 5. Cross-validation.
    let mut identified = cross_validated_fit(
        measurement,
        &training_logs(&logs),
        inputs,
        calibrated,
        clean.estimate,
        &mut progress,
    )?;
    identified.findings.extend(clean.not_converged);
    let notes = not_available(robot, &identified.inputs);
    identified.findings.extend(notes);

    // 6. Disturbances in validation logs, encoder errors, delays.
    undeclared::report_validation(&mut logs, &identified);
    progress("figures".into(), 0.88);
    let (found, time_offsets) = if signs.is_empty() {
        Search::new(&training_logs(&logs), &identified).findings()
    } else {
        (signs, Vec::new())
    };

    // 7. Figures.
    let outcome = assemble::outcome(&logs, &identified, (found, time_offsets));
    progress("done".into(), 1.0);
    Ok(outcome)
}

/// The parameters of the sensors' calibrations that are identified.
fn calibrated(measurement: &MeasurementModel<'_>) -> Kind {
    let wanted = measurement.robot().calibrated;
    let gain = match wanted.gain {
        Gain::Auto if measurement.unknowns().sensors.is_empty() => Gain::None,
        Gain::Auto => Gain::Full,
        gain => gain,
    };
    Kind { gain, ..wanted }
}

/// The inputs that are configured, or else those that the robot has.
pub(crate) fn chosen_inputs(
    robot: &Robot,
    inputs: &[IdentificationInput],
) -> Vec<IdentificationInput> {
    if inputs.is_empty() {
        vec![if robot.structure.sensors().is_empty() {
            IdentificationInput::Torque
        } else {
            IdentificationInput::Wrench
        }]
    } else {
        inputs.to_vec()
    }
}

/// Logs of observations with known motion; repeated ones are refused.
pub(crate) fn prepare_logs(robot: &Robot, datasets: Vec<Dataset>) -> Vec<PreparedLog> {
    let each = datasets.into_iter().map(|dataset| prepare(robot, dataset));
    let mut logs: Vec<PreparedLog> = each.collect();
    refuse_repeated(&mut logs);
    logs
}

/// The measurement model of the training logs that do not contradict the configuration. Breaks off
/// with a reason and findings if all of them together do, or no row contains a link.
pub(crate) fn plausible_model<'a>(
    robot: &'a Robot,
    inputs: &[IdentificationInput],
    logs: &mut [PreparedLog],
) -> Result<ControlFlow<(String, Vec<Finding>), MeasurementModel<'a>>, IdentifyError> {
    if let ControlFlow::Break(found) = configuration::check(robot, inputs, logs)? {
        return Ok(ControlFlow::Break(found));
    }
    let training = training_logs(logs);
    if training.is_empty() {
        return Ok(ControlFlow::Break((no_log(logs), Vec::new())));
    }
    let all = training.iter().flat_map(|log| log.instants.iter());
    let measurement = MeasurementModel::for_observations(robot, inputs, all)?;
    if measurement.unknowns().links.is_empty() {
        let what = match inputs {
            [IdentificationInput::Torque] => {
                "no joint torque was measured while the links beyond the joint were free of \
                 contacts"
            }
            [IdentificationInput::Wrench] => {
                "no part of the robot beyond or between F/T sensors was measured while it was \
                 free of unknown contacts"
            }
            _ => {
                "no joint torque and no F/T sensor was measured while its part of the robot was \
                 free of unknown contacts"
            }
        };
        let reason = format!("no measurement contains the links' parameters: {what}");
        return Ok(ControlFlow::Break((reason, Vec::new())));
    }
    Ok(ControlFlow::Continue(measurement))
}

/// What the configuration requests but the inputs do not contain.
fn not_available(robot: &Robot, inputs: &[IdentificationInput]) -> Vec<Finding> {
    let mut notes = Vec::new();
    if !robot.calibrated.is_empty() && !inputs.contains(&IdentificationInput::Wrench) {
        let mut requested = Vec::new();
        if !matches!(robot.calibrated.gain, Gain::None | Gain::Auto) {
            requested.push("identification.gain");
        }
        if robot.calibrated.temperature {
            requested.push("identification.temperature");
        }
        let requested = requested.join(" and ");
        let text = format!(
            "{requested} requested but not available: F/T sensors are not among the inputs of \
             identification, so none is calibrated; add \"wrench\" to the inputs"
        );
        let code = FindingCode::CalibrationNotAvailable;
        notes.push(Finding::note(code, requested, text));
    }
    if robot.torque_side == TorqueSide::Motor && !inputs.contains(&IdentificationInput::Torque) {
        let key = "identification.torque_side";
        let text = format!(
            "{key} = \"motor\" requested but not available: joint torques are not among the \
             inputs of identification, so no rotor inertia is identified; add \"torque\" to the \
             inputs"
        );
        notes.push(Finding::note(FindingCode::RotorsNotAvailable, key, text));
    }
    notes
}

/// An estimate from which undeclared disturbances are excluded.
pub(crate) struct CleanFit {
    pub(crate) estimate: NoiseAndMap,
    pub(crate) loads: Vec<LoadChange>,
    /// Present if the excluded disturbances did not converge.
    not_converged: Option<Finding>,
}

/// The rounds of fits and exclusions.
struct Exclusion<'a, 'r> {
    measurement: &'a MeasurementModel<'r>,
    logs: &'a mut [PreparedLog],
    loads: Vec<LoadChange>,
    drift: OffsetDrift,
    progress: &'a mut dyn FnMut(String, f64),
}

impl Exclusion<'_, '_> {
    /// A fit without what is excluded by now, with this initial noise.
    fn fit(&mut self, from: Option<NoiseModel>) -> Result<NoiseAndMap, IdentifyError> {
        let training = training_logs(self.logs);
        alternate_noise_and_map(self.measurement, &training, self.drift, from, self.progress)
    }

    /// Excludes a load. The fit without it, if the noise is so much less then that the load is
    /// accepted; otherwise it is not excluded.
    fn fit_without(
        &mut self,
        load: LoadChange,
        estimate: &NoiseAndMap,
    ) -> Result<Option<NoiseAndMap>, IdentifyError> {
        let before = self.loads.clone();
        let channels = self.measurement.channels_of(&load.subtrees);
        undeclared::add_load(&mut self.loads, load);
        undeclared::mark(training_logs_mut(self.logs), &self.loads);
        let without = self.fit(Some(estimate.noise.clone()))?;
        let unknowns = self.measurement.unknowns();
        let (with, noise) = (&estimate.noise, &without.noise);
        let ratio = noise.variance_ratio(with, unknowns, &channels);
        if ratio > LOAD_VARIANCE_RATIO {
            return Ok(Some(without));
        }
        self.loads = before;
        undeclared::mark(training_logs_mut(self.logs), &self.loads);
        Ok(None)
    }

    /// Limits the drift of the offsets from now on. Returns whether that changes the fit: where no
    /// offset drifts faster than the limit, it does not.
    fn limit_drift(&mut self, noise: &NoiseModel) -> bool {
        self.drift = OffsetDrift::AsStated;
        let fastest = self.drift.fastest(self.measurement);
        let mut pairs = noise.drift_variance.iter().zip(&fastest);
        pairs.any(|(found, most)| found > most)
    }
}

/// Fits, excludes what an undeclared disturbance acted on, and fits again, until the excluded set
/// does not change.
pub(crate) fn exclude_disturbed(
    measurement: &MeasurementModel<'_>,
    logs: &mut [PreparedLog],
    progress: &mut dyn FnMut(String, f64),
) -> Result<CleanFit, IdentifyError> {
    // Offsets drift freely at first: with the limited drift, a load that comes or goes would look
    // like noise of every channel.
    let drift = OffsetDrift::Free;
    let training = training_logs(logs);
    let mut estimate = alternate_noise_and_map(measurement, &training, drift, None, progress)?;
    let mut exclusion = Exclusion {
        measurement,
        loads: Vec::new(),
        logs,
        drift,
        // Rounds start again with each fit: their fraction done is not shown.
        progress: &mut |step: String, _| progress(step, 0.62),
    };
    let mut rejected_loads = 0;
    let mut converged = false;
    for _ in 0..EXCLUSION_ROUNDS {
        (exclusion.progress)("undeclared contacts".into(), 0.62);
        let may_be_more = rejected_loads < MAX_REJECTED_LOADS && exclusion.loads.len() < MAX_LOADS;
        if may_be_more
            && let Some(load) = load::find(measurement, &training_logs(exclusion.logs), &estimate)
        {
            if let Some(without) = exclusion.fit_without(load, &estimate)? {
                estimate = without;
                continue;
            }
            rejected_loads += 1;
        }
        if let OffsetDrift::Free = exclusion.drift
            && exclusion.limit_drift(&estimate.noise)
        {
            // Without an initial noise model: with freely drifting offsets, noise is divided
            // differently among the channels.
            estimate = exclusion.fit(None)?;
        }
        let NoiseAndMap { noise, fit, .. } = &estimate;
        let training = training_logs_mut(exclusion.logs);
        converged = undeclared::update(measurement, training, &exclusion.loads, noise, &fit.x);
        if converged {
            break;
        }
        estimate = exclusion.fit(Some(estimate.noise))?;
    }
    Ok(CleanFit {
        estimate,
        loads: exclusion.loads,
        not_converged: (!converged).then(|| undeclared::not_converged(EXCLUSION_ROUNDS)),
    })
}

/// Fits gains of the F/T sensors, too. An error of a gain, where the robot carries much, may have
/// been taken for a contact: with the gains known, contacts are looked for again, and if they
/// differ, gains are fitted again, [`GAIN_ROUNDS`] times at most. (Each time some of the excluded
/// instants come back, and add information about the gains.)
fn with_gains(
    measurement: &mut MeasurementModel<'_>,
    logs: &mut [PreparedLog],
    calibrated: Kind,
    mut clean: CleanFit,
    progress: &mut dyn FnMut(String, f64),
) -> Result<CleanFit, IdentifyError> {
    clean.estimate = fit_gains(measurement, logs, calibrated, clean.estimate, progress)?;
    clean.not_converged = Some(undeclared::not_converged(GAIN_ROUNDS));
    for _ in 0..GAIN_ROUNDS {
        let NoiseAndMap { noise, fit, .. } = &clean.estimate;
        let training = training_logs_mut(logs);
        if undeclared::update(measurement, training, &clean.loads, noise, &fit.x) {
            clean.not_converged = None;
            break;
        }
        clean.estimate = fit_gains(measurement, logs, calibrated, clean.estimate, progress)?;
    }
    Ok(clean)
}

/// Cross-validates an estimate and fits all instants with the noise that this shows; the change
/// from CAD is shrunk to the retained fraction.
fn cross_validated_fit<'a>(
    measurement: MeasurementModel<'a>,
    training: &[&PreparedLog],
    inputs: Vec<IdentificationInput>,
    calibrated: Kind,
    estimate: NoiseAndMap,
    progress: &mut dyn FnMut(String, f64),
) -> Result<Identified<'a>, IdentifyError> {
    let unknowns = measurement.unknowns();
    let segments = segments_of(training, SEGMENT_INSTANTS);
    let (prior, noise) = (estimate.prior, estimate.noise);
    progress("cross-validation".into(), 0.69);
    let sampled = sample(&measurement, training);
    let tau = estimate.fit.tau;
    let mut retention = cross_validation::held_out(&measurement, &prior, &sampled, &noise, tau)?;
    retention.findings.extend(unsettled(estimate.change));
    // The fit has absorbed a part of the noise of its own data, most of all noise that is as slow
    // as the motion.
    let fastest = OffsetDrift::AsStated.fastest(&measurement);
    let mut noise = retention.noise(&measurement, &sampled, noise, &fastest);
    // Of the seconds that were not sampled, too.
    let left = segment_residuals(&measurement, &segments, &noise, &estimate.fit.x);
    noise.seconds = Seconds::of(unknowns, &segments, &left);
    let reduced = reduced_segments(&measurement, &segments, &noise);
    let information = added(&reduced, unknowns.parameters());
    let fit = posterior(&prior, unknowns, &information)?.maximise_evidence()?;
    let rotors = negative_rotors(measurement.robot(), unknowns, &fit);
    retention.findings.extend(rotors);
    let cad = parameters_without_cad(unknowns, &information);
    let mut d = without_negative_rotors(&prior, unknowns, &information, &fit)?;
    let shares = per_column(unknowns, &retention.share);
    for (column, share) in shares.into_iter().enumerate() {
        d[column] = cad[column] + share * (d[column] - cad[column]);
    }
    Ok(Identified {
        measurement,
        inputs,
        calibrated,
        prior,
        noise,
        information,
        d,
        cad,
        retained: retention.share,
        findings: retention.findings,
        fit,
        reduced,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::observation::{Annotated, Observation, SubtreeSet};
    use crate::measurement::noise_model::NoiseModel;
    use crate::measurement::reduction::tests::{between_two_sensors, readings};
    use crate::prepared_log::SAMPLE_INSTANTS;
    use proprio_dynamics::ContactSet;

    /// A training log of these instants.
    fn log(instants: &[Annotated]) -> PreparedLog {
        PreparedLog {
            file: String::new(),
            role: LogRole::Train,
            span: (instants[0].t, instants[instants.len() - 1].t),
            instants: instants.to_vec(),
            excluded: Vec::new(),
            findings: Vec::new(),
            refused: false,
            contacts: vec![SubtreeSet::default(); instants.len()],
        }
    }

    /// Stretches must be longer than the correlation time of the noise, a few seconds, for any
    /// number of logs.
    #[test]
    fn stretches_of_many_logs_are_not_short() {
        let robot = between_two_sensors();
        let all = readings(&robot, 15_000, &[0.1; 12], &[0.0; 12]);
        for (count, instants) in [(1, 15_000), (4, 12_000), (60, 1000), (100, 300)] {
            let logs: Vec<PreparedLog> = (0..count).map(|_| log(&all[..instants])).collect();
            let logs: Vec<&PreparedLog> = logs.iter().collect();
            let wrench = [IdentificationInput::Wrench];
            let all = logs.iter().flat_map(|log| &log.instants);
            let measurement =
                MeasurementModel::for_observations(&robot, &wrench, all).expect("rows");
            let lengths: Vec<usize> = sample(&measurement, &logs)
                .iter()
                .map(|segment| segment.instants.len())
                .collect();
            let sum: usize = lengths.iter().sum();
            assert!(
                (SAMPLE_INSTANTS / 2..=SAMPLE_INSTANTS).contains(&sum),
                "{count} logs: {sum} instants"
            );
            let least = lengths.iter().min().copied().unwrap_or(0);
            assert!(
                least >= if instants < 1000 { 290 } else { 700 },
                "{count} logs: {least} at once"
            );
        }
    }

    /// The noise without a load is compared on the limb's own sensors.
    #[test]
    fn a_load_is_tested_on_its_own_channels() {
        let robot = between_two_sensors();
        let mut instants = readings(&robot, 200, &[0.1; 12], &[0.0; 12]);
        for instant in &mut instants {
            (instant.torque, instant.active) = (vec![0.1; 2], ContactSet::default());
        }
        let both = [IdentificationInput::Wrench, IdentificationInput::Torque];
        let measurement =
            MeasurementModel::for_observations(&robot, &both, instants.iter()).expect("rows");
        let of_link = |link: &str| {
            let link =
                (0..robot.model.link_count()).find(|&number| robot.model.link_name(number) == link);
            let mut subtrees = SubtreeSet::default();
            subtrees.insert(
                robot
                    .structure
                    .subtree_of(link.expect("a link"))
                    .expect("its sub-tree"),
            );
            subtrees
        };
        let channels_of = |link: &str| measurement.channels_of(&of_link(link));
        let thigh = channels_of("thigh");
        assert_eq!(thigh, (0..12).collect::<Vec<_>>());
        let foot = channels_of("foot");
        assert_eq!(foot.len(), 6);
        let mut with_torques = of_link("foot");
        with_torques.insert(Observation::TORQUES);
        assert_eq!(
            measurement.channels_of(&with_torques),
            [foot.clone(), vec![12, 13]].concat()
        );
        let noise = NoiseModel::unknown(vec![1e-6; 14]);
        let mut less_noise = noise.clone();
        less_noise.square.fill(100.0);
        for &channel in &foot {
            (less_noise.square[channel], less_noise.block[channel]) = (0.25, 0.25);
        }
        let unknowns = measurement.unknowns();
        let ratio = |channels: &[usize]| less_noise.variance_ratio(&noise, unknowns, channels);
        assert!((ratio(&foot) - 4.0).abs() < 1e-9);
        assert!((ratio(&thigh) - 0.2).abs() < 1e-9);
        // Half of the seconds have nineteen times the variance.
        let mut varying = noise.clone();
        varying.seconds.0 = [((0, 0), 1.0), ((0, 1), 19.0)].into_iter().collect();
        let ratio = |channels: &[usize]| less_noise.variance_ratio(&varying, unknowns, channels);
        assert!((ratio(&foot) - 40.0).abs() < 1e-9);
        assert!((ratio(&[12]) - 0.01).abs() < 1e-9, "{}", ratio(&[12]));
    }
}
