//! A demonstration compared with the simulator's truth: counts, errors, latencies, parameters.

use super::compared::{Accuracy, AlignedRun, PhaseAccuracy, TrueTorques, ratio};
use super::learnt::{Convergence, courses};
use super::verdict::{DemoVerdict, Findings};
use crate::demo::experiment::{DemoArgs, Experiment};
use crate::demo::watching::ReceivedRun;
use anyhow::{Context, bail};
use proprio_topics::Nanos;
use serde_json::{Value as Json, json};

/// Errors are evaluated from this time after the first estimate on.
const START: Nanos = Nanos::from_millis(1000);

/// Counts of frames, samples and estimates.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct TransportCounts {
    pub(super) frames: u64,
    pub(super) samples: u64,
    /// Frames and samples lost on the way from the simulator to the estimator.
    pub(super) lost: u64,
    pub(super) foreign: u64,
    pub(super) late: u64,
    pub(super) estimates: usize,
    pub(super) lost_estimates: u64,
}

impl TransportCounts {
    /// # Errors
    /// The simulator did not count a bus.
    fn of(watched: &ReceivedRun) -> anyhow::Result<Self> {
        let mut this = Self {
            frames: 0,
            samples: 0,
            lost: watched.estimator.lost,
            foreign: 0,
            late: watched.estimator.late,
            estimates: watched.estimates.len(),
            lost_estimates: watched.lost_estimates,
        };
        for bus in watched.gateway.buses() {
            let of_simulator = watched.simulator["buses"]
                .as_array()
                .into_iter()
                .flatten()
                .find(|b| b["name"] == bus.name.as_str());
            let sent = of_simulator
                .and_then(|b| b["sent"].as_u64())
                .with_context(|| format!("the simulator's count of bus {}", bus.name))?;
            this.frames += bus.frames;
            this.samples += bus.published;
            // Per bus, so that surplus frames on one bus do not hide losses on another.
            this.lost += sent.saturating_sub(bus.frames);
            this.foreign += bus.frames.saturating_sub(sent);
        }
        Ok(this)
    }
}

/// A demonstration compared with the simulator's truth.
pub(super) struct Evaluation<'a> {
    pub(super) args: &'a DemoArgs,
    pub(super) experiment: &'a Experiment,
    pub(super) watched: &'a ReceivedRun,
    pub(super) counts: TransportCounts,
    pub(super) compared: AlignedRun,
    pub(super) before: Option<PhaseAccuracy>,
    pub(super) learning: Option<PhaseAccuracy>,
    pub(super) after: Option<PhaseAccuracy>,
    /// The phase after learning, or the whole run if that is too short; and its begin in words.
    pub(super) judged: PhaseAccuracy,
    pub(super) since: &'static str,
    pub(super) verdict: DemoVerdict,
    /// Stamp of the last estimate.
    pub(super) last: Nanos,
    pub(super) rate_hz: f64,
    /// From the stamp of the frame to the published torque \[us\], sorted.
    pub(super) latency: Vec<f64>,
    pub(super) parameters: Vec<Convergence>,
    pub(super) offsets: Vec<Convergence>,
}

impl<'a> Evaluation<'a> {
    pub(super) fn new(
        args: &'a DemoArgs,
        experiment: &'a Experiment,
        watched: &'a ReceivedRun,
        truth: &TrueTorques,
    ) -> anyhow::Result<Self> {
        let compared = AlignedRun::new(watched, truth, args.still())?;
        let last = watched.estimates.last().map_or(Nanos::ZERO, |seen| seen.t);
        let mut latency: Vec<f64> = watched
            .estimates
            .iter()
            .map(|s| (s.published - s.t).seconds() * 1e6)
            .collect();
        latency.sort_by(f64::total_cmp);
        let start = compared.first + START;
        let after = compared.phase(compared.settled, Nanos::MAX);
        let since = if after.is_some() {
            "from 10 s of motion on"
        } else {
            "from one second on"
        };
        let Some(judged) = after.clone().or_else(|| compared.phase(start, Nanos::MAX)) else {
            bail!(
                "no estimate can be compared with the truth: the motion was too short, or no \
                 estimate came after its first second"
            );
        };
        let (parameters, offsets) = courses(experiment, watched, &compared);
        let counts = TransportCounts::of(watched)?;
        let (order, beyond) = (&experiment.order, experiment.beyond);
        let first = match beyond {
            0 => &order[..],
            _ => order.get(..beyond).unwrap_or_default(),
        };
        let [cad, identified] = [
            |joint: &Accuracy| joint.cad,
            |joint: &Accuracy| joint.identified,
        ]
        .map(|error| combined(first.iter().filter_map(|i| judged.joints.get(*i)), error));
        let skipped = |bus: &Json| bus["skipped"].as_u64();
        let buses = watched.simulator["buses"].as_array();
        let verdict = DemoVerdict::of(&Findings {
            since,
            moved: compared.time(last) - compared.time(compared.moving),
            has_settled: after.is_some(),
            refused: experiment.refused.as_deref(),
            solutions: watched.learnt.len(),
            cad_error: args.cad_error,
            joints: first.len(),
            sensors: experiment.offsets.len(),
            is_beyond: beyond > 0,
            cad,
            identified,
            valid: judged.joints.iter().map(|joint| joint.valid).sum(),
            valid_share: judged.valid_share,
            within_2_sigma: judged.within_2_sigma,
            lost: counts.lost,
            skipped: buses.into_iter().flatten().filter_map(skipped).sum(),
        });
        Ok(Self {
            args,
            experiment,
            watched,
            counts,
            verdict,
            before: compared.phase(start, compared.moving),
            learning: compared.phase(compared.moving, compared.settled),
            after,
            judged,
            since,
            last,
            rate_hz: (watched.estimates.len() as f64 - 1.0) / compared.time(last),
            latency,
            parameters,
            offsets,
            compared,
        })
    }

    /// The q-quantile of the latency \[us\].
    pub(super) fn latency(&self, q: f64) -> f64 {
        quantile(&self.latency, q)
    }

    /// The content of `summary.json`.
    pub(super) fn summary(&self) -> Json {
        let (args, watched, counts) = (self.args, self.watched, &self.counts);
        let seconds = |t: Nanos| (t <= self.last).then(|| self.compared.time(t));
        let errors = (self.judged).each(&watched.joints, |joint| joint.identified.into());
        let valid = (self.judged).each(&watched.joints, |joint| joint.valid.into());
        let untrue = watched.joints.iter().zip(self.compared.untrue());
        let untrue: Json = untrue
            .map(|(joint, count)| (joint.clone(), count))
            .collect();
        json!({
            "verdict": self.verdict.sentence(),
            "worked": self.verdict.worked,
            "robot": self.experiment.setup.robot.name,
            "seconds": args.seconds,
            "seed": args.seed,
            "frames": counts.frames,
            "samples": counts.samples,
            "lost": counts.lost,
            "foreign": counts.foreign,
            "estimates": counts.estimates,
            "lost_estimates": counts.lost_estimates,
            "late": counts.late,
            "rate_hz": self.rate_hz,
            "valid_share": self.judged.valid_share,
            "latency_us": {
                "p50": self.latency(0.5),
                "p99": self.latency(0.99),
                "p999": self.latency(0.999),
            },
            "torque_rms_error_nm": errors,
            "valid_estimates": valid,
            "untrue_estimates": untrue,
            "identification": {
                "cad_error": args.cad_error,
                "refused": self.experiment.refused,
                "max_torque_std_nm": self.experiment.most_std,
                "moving_since_s": seconds(self.compared.moving),
                "settled_since_s": seconds(self.compared.settled),
                "solutions": watched.learnt.len(),
                "parameters_within_2_sigma": within_2_sigma(&self.parameters),
                "before": PhaseAccuracy::json(self.before.as_ref(), &watched.joints),
                "learning": PhaseAccuracy::json(self.learning.as_ref(), &watched.joints),
                "after": PhaseAccuracy::json(self.after.as_ref(), &watched.joints),
            },
            "simulator": watched.simulator,
        })
    }
}

/// The RMS error over all valid estimates of several joints; NaN without any.
fn combined<'a>(
    joints: impl Iterator<Item = &'a Accuracy>,
    error: impl Fn(&Accuracy) -> f64,
) -> f64 {
    let (mut squares, mut count) = (0.0, 0.0);
    for joint in joints.filter(|joint| error(joint).is_finite()) {
        squares += error(joint).powi(2) * joint.valid as f64;
        count += joint.valid as f64;
    }
    (squares / count).sqrt()
}

/// The q-quantile of sorted numbers; NaN of nothing.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = ((sorted.len() as f64 - 1.0) * q).round().max(0.0) as usize;
    sorted.get(at).copied().unwrap_or(f64::NAN)
}

/// The fraction of parameters whose last value is within two standard deviations of the truth.
fn within_2_sigma(parameters: &[Convergence]) -> Option<f64> {
    let within = parameters
        .iter()
        .filter(|course| course.is_within_2_sigma())
        .count();
    (!parameters.is_empty()).then(|| ratio(within, parameters.len()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::{BusHealth, EstimatorHealth, GatewayHealth, Name};

    /// Surplus frames on one bus do not hide losses on another; what the estimator missed counts,
    /// too.
    #[test]
    fn losses_add_up_over_buses_and_estimator() {
        let mut gateway = Box::new(GatewayHealth::new(Nanos::ZERO));
        gateway.bus_count = 2;
        for (bus, (name, frames)) in gateway.buses.iter_mut().zip([("a", 90), ("b", 107)]) {
            *bus = BusHealth {
                name: Name::new(name).unwrap(),
                frames,
                published: 20,
                ..BusHealth::EMPTY
            };
        }
        let watched = ReceivedRun {
            joints: vec![],
            estimates: vec![],
            baseline: vec![],
            learnt: vec![],
            lost_estimates: 5,
            gateway,
            estimator: EstimatorHealth {
                lost: 3,
                late: 4,
                ..EstimatorHealth::default()
            },
            simulator: json!({ "buses": [
                { "name": "b", "sent": 100 },
                { "name": "a", "sent": 100 },
            ] }),
        };
        let expected = TransportCounts {
            frames: 197,
            samples: 40,
            lost: 10 + 3,
            foreign: 7,
            late: 4,
            estimates: 0,
            lost_estimates: 5,
        };
        assert_eq!(TransportCounts::of(&watched).unwrap(), expected);
    }

    /// The last solution counts: here three of four are within twice what it states.
    #[test]
    fn parameters_are_compared_with_the_truth_in_their_last_solution() {
        assert_eq!(within_2_sigma(&[]), None);
        let courses = [
            Convergence::ending(1.0, 0.1, 1.19),
            Convergence::ending(-1.0, 0.1, -1.19),
            Convergence::ending(1.0, 0.1, 1.21),
            Convergence::ending(0.0, 1.0, 1.5),
        ];
        assert_eq!(within_2_sigma(&courses), Some(0.75));
    }

    #[test]
    fn errors_of_joints_combine_by_their_counts() {
        let joint = |identified, valid| Accuracy {
            cad: f64::NAN,
            identified,
            size: 1.0,
            valid,
        };
        let joints = [joint(1.0, 3), joint(3.0, 1), joint(f64::NAN, 0)];
        assert_eq!(
            combined(joints.iter(), |j| j.identified),
            f64::sqrt(12.0 / 4.0)
        );
        assert!(combined(joints.iter(), |j| j.cad).is_nan());
    }

    #[test]
    fn quantiles_are_those_of_sorted_numbers() {
        let numbers: Vec<f64> = (0..=1000).map(f64::from).collect();
        let found = [0.0, 0.5, 0.99, 0.999, 1.0].map(|q| quantile(&numbers, q));
        assert_eq!(found, [0.0, 500.0, 990.0, 999.0, 1000.0]);
        assert!(quantile(&[], 0.5).is_nan());
    }
}
