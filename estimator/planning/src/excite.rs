//! The motion that lessens the deviations of some torques the most.
//!
//! Criterion: the sum of the logarithms of the deviations, over the states of a [`Workspace`],
//! after the motion ([`Forecast`]). Its numbers ([`FourierSeries::within`]) are found by an
//! evolution strategy: from the best of some random motions, with the mean of the best of each
//! generation and a step that the path of the mean adapts (Hansen, Ostermeier, "Completely
//! derandomized self-adaptation in evolution strategies", 2001, without its covariance matrix). It
//! needs no derivatives, which limits and boxes do not have.

use crate::knowledge::at_rest;
use crate::motion::{Fence, FourierSeries, JointLimits, harmonics, reach, within};
use crate::workspace::{Deviation, MotionState, Puppet, TorqueRows, Workspace};
use fastrand::Rng;
use nalgebra::DVector;
use proprio_dynamics::DynamicsError;
use proprio_identification::dataset::observation::Observation;
use proprio_identification::forecast::{Forecast, ForecastError, SensorNoise};
use proprio_identification::parallel;
use proprio_identification::{CovarianceRoot, Robot};
use proprio_topics::Nanos;
use std::f64::consts::TAU;

/// Time between two observations of a planned motion [s]: nothing in it is faster.
const PERIOD: f64 = 0.05;

/// Random motions from which the best is improved.
const FIRST: usize = 48;

/// Motions of a generation.
const GENERATION: usize = 16;

/// Number of generations.
const GENERATIONS: usize = 100;

/// Random postures among which those within the boxes are looked for.
const POSTURES: usize = 4000;

/// Number of states of the workspace.
const STATES: usize = 40;

/// What is wanted.
pub struct Task<'a> {
    /// The robot.
    pub robot: &'a Robot,
    /// Per degree of freedom its limits; none if it stays where it is.
    pub limits: Vec<Option<JointLimits>>,
    /// Where points of links stay.
    pub fences: Vec<Fence>,
    /// The duration of the motion \[s\].
    pub seconds: f64,
    /// The degrees of freedom of which the torques matter.
    pub wanted: Vec<usize>,
    /// The noise of each sensor.
    pub noise: Vec<SensorNoise>,
    /// The covariance of an earlier identification; without it that of CAD.
    pub known: Option<CovarianceRoot>,
    /// Another seed gives another motion, as good.
    pub seed: u64,
}

/// The motion, and what it is good for.
pub struct PlannedMotion {
    /// The motion.
    pub series: FourierSeries,
    /// The deviations of all torques before it.
    pub before: Vec<Deviation>,
    /// The deviations after it.
    pub after: Vec<Deviation>,
}

/// Why there is no motion.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ExciteError {
    /// Nothing can be forecast.
    #[error(transparent)]
    Forecast(#[from] ForecastError),
    /// The robot's parts do not fit together.
    #[error(transparent)]
    Dynamics(#[from] DynamicsError),
    /// No posture is within a box.
    #[error("no posture within the joints' limits has {link} in its box: it gets to {reach}")]
    Box {
        /// The link.
        link: String,
        /// Where its points get.
        reach: String,
    },
    /// Each box alone has postures.
    #[error("no posture within the joints' limits was found in which all boxes hold together")]
    Boxes,
    /// No joint may move.
    #[error("no joint moves: all are locked, or have no room between their limits")]
    NoJoint,
    /// None of the wanted torques depends on what a motion tells.
    #[error(
        "no motion lessens the deviation of {0}: these torques rest on CAD alone (`proprio \
         identifiable` tells why, and which sensor would help)"
    )]
    NoTorque(String),
}

/// A task with everything that is computed once.
pub struct Planner<'a> {
    task: Task<'a>,
    forecast: Forecast<'a>,
    workspace: Workspace,
    /// The wanted torques in the columns of the forecasts.
    rows: TorqueRows,
    /// Postures within all boxes, of the moving joints.
    starts: Vec<Vec<f64>>,
}

impl<'a> Planner<'a> {
    /// Prepares a task. `at_work` is the robot with the contacts that it has while its torques are
    /// wanted, which may be others than during the motion.
    ///
    /// # Errors
    /// [`ExciteError`].
    pub fn new(task: Task<'a>, at_work: &Robot) -> Result<Self, ExciteError> {
        let robot = task.robot;
        let mut rng = Rng::with_seed(task.seed);
        let moves = |limits: &Option<JointLimits>| {
            limits.is_some_and(|own| own.range.upper > own.range.lower)
        };
        if !task.limits.iter().any(moves) {
            return Err(ExciteError::NoJoint);
        }
        let mut postures = vec![robot.position_without_samples(); POSTURES];
        for posture in &mut postures {
            for (position, limits) in posture.iter_mut().zip(&task.limits) {
                if let Some(limits) = limits {
                    // Where a motion may start: see `FourierSeries::within`.
                    let place = 0.8 * (2.0 * rng.f64() - 1.0);
                    *position = limits.range.middle() + limits.range.half() * place;
                }
            }
        }
        for fence in &task.fences {
            if within(robot, std::slice::from_ref(fence), &postures)?.is_empty() {
                let [least, greatest] = reach(robot, fence, &postures)?;
                let axes = ["x", "y", "z"].into_iter().zip(least).zip(greatest);
                let axes: Vec<String> = axes
                    .map(|((axis, from), to)| format!("{axis} {from:.3} to {to:.3}"))
                    .collect();
                return Err(ExciteError::Box {
                    link: fence.name.clone(),
                    reach: format!("{} m", axes.join(", ")),
                });
            }
        }
        let starts = within(robot, &task.fences, &postures)?;
        if starts.is_empty() {
            return Err(ExciteError::Boxes);
        }
        let mut puppet = Puppet::new(robot)?;
        let examples = starts.iter().take(10);
        let states = examples.map(|position| MotionState::at_rest(position.clone()));
        let examples = states.map(|state| puppet.observe(Nanos::ZERO, &state));
        let examples: Vec<Observation> = examples.collect::<Result<_, _>>()?;
        let forecast = Forecast::new(robot, &examples, PERIOD, &task.noise, task.known.as_ref())?;
        let workspace = Workspace::new(at_work, STATES)?;
        let layout = forecast.after(examples)?;
        let mut rows = workspace.in_columns(robot, &layout.columns, &layout.calibrations);
        rows.keep(&task.wanted);
        if rows.is_empty() {
            let names = task.wanted.iter().map(|&dof| robot.model.dof_name(dof));
            let names: Vec<&str> = names.collect();
            return Err(ExciteError::NoTorque(names.join(", ")));
        }
        Ok(Self {
            task,
            forecast,
            workspace,
            rows,
            starts,
        })
    }

    /// Looks for the motion; `progress` is told the fraction done.
    ///
    /// # Errors
    /// [`ExciteError`].
    pub fn plan(&self, progress: &mut dyn FnMut(f64)) -> Result<PlannedMotion, ExciteError> {
        let mut rng = Rng::with_seed(self.task.seed.wrapping_add(1));
        let first: Vec<Vec<f64>> = (0..FIRST).map(|_| self.random(&mut rng)).collect();
        let costs = parallel::map(FIRST, |k| self.cost(&first[k]));
        let best = (0..FIRST).min_by(|a, b| costs[*a].total_cmp(&costs[*b]));
        let best = best.unwrap_or_default();
        let mut found = (costs[best], first[best].clone());
        let mut mean = DVector::from_vec(found.1.clone());
        let n = mean.len() as f64;
        let parents = GENERATION / 4;
        let weights: Vec<f64> = (0..parents)
            .map(|k| (parents as f64 + 0.5).ln() - ((k + 1) as f64).ln())
            .collect();
        let sum: f64 = weights.iter().sum();
        let weights: Vec<f64> = weights.iter().map(|weight| weight / sum).collect();
        let effective = 1.0 / weights.iter().map(|weight| weight * weight).sum::<f64>();
        let memory = (effective + 2.0) / (n + effective + 5.0);
        let damping = 1.0 + memory;
        let expected = n.sqrt() * (1.0 - 0.25 / n);
        let (mut step, mut path) = (0.3, DVector::zeros(mean.len()));
        for generation in 0..GENERATIONS {
            progress(generation as f64 / GENERATIONS as f64);
            let draws: Vec<DVector<f64>> = (0..GENERATION)
                .map(|_| DVector::from_fn(mean.len(), |_, _| normal(&mut rng)))
                .collect();
            let children: Vec<DVector<f64>> = draws.iter().map(|z| &mean + z * step).collect();
            let costs = parallel::map(GENERATION, |k| self.cost(children[k].as_slice()));
            let mut order: Vec<usize> = (0..GENERATION).collect();
            order.sort_by(|a, b| costs[*a].total_cmp(&costs[*b]));
            if costs[order[0]] < found.0 {
                found = (costs[order[0]], children[order[0]].as_slice().to_vec());
            }
            let pairs = order.iter().zip(&weights);
            let drawn = pairs.fold(DVector::zeros(mean.len()), |sum, (&k, weight)| {
                sum + &draws[k] * *weight
            });
            mean += &drawn * step;
            path = path * (1.0 - memory) + drawn * (memory * (2.0 - memory) * effective).sqrt();
            step *= ((memory / damping) * (path.norm() / expected - 1.0)).exp();
        }
        let series = self.series(&found.1)?.ok_or(ExciteError::Boxes)?;
        let before = self.before()?;
        let after = self.deviations(&series)?;
        Ok(PlannedMotion {
            series,
            before,
            after,
        })
    }

    /// A random motion that keeps limits and boxes: what the planned one is compared with.
    ///
    /// # Errors
    /// [`ExciteError`].
    pub fn random_motion(&self, seed: u64) -> Result<FourierSeries, ExciteError> {
        let mut rng = Rng::with_seed(seed);
        for _ in 0..100 {
            if let Some(series) = self.series(&self.random(&mut rng))? {
                return Ok(series);
            }
        }
        Err(ExciteError::Boxes)
    }

    /// The deviations of all torques before any motion, with the robot at rest.
    ///
    /// # Errors
    /// [`ExciteError`].
    pub fn before(&self) -> Result<Vec<Deviation>, ExciteError> {
        let Task {
            robot,
            noise,
            known,
            ..
        } = &self.task;
        let covariance = match known {
            Some(known) => known.clone(),
            None => at_rest(robot, noise, None)?,
        };
        Ok(self.workspace.deviations(robot, &covariance))
    }

    /// The deviations of all torques after a motion.
    ///
    /// # Errors
    /// [`ExciteError`].
    pub fn deviations(&self, series: &FourierSeries) -> Result<Vec<Deviation>, ExciteError> {
        let covariance = self.forecast.after(self.observations(series)?)?;
        Ok(self.workspace.deviations(self.task.robot, &covariance))
    }

    /// The states in which torques are wanted.
    pub fn workspace(&self) -> &Workspace {
        &self.workspace
    }

    fn observations(&self, series: &FourierSeries) -> Result<Vec<Observation>, DynamicsError> {
        let mut puppet = Puppet::new(self.task.robot)?;
        let instants = series.instants(PERIOD);
        instants
            .map(|t| puppet.observe(Nanos::from_seconds(t), &series.at(t)))
            .collect()
    }

    fn series(&self, numbers: &[f64]) -> Result<Option<FourierSeries>, DynamicsError> {
        let Task {
            robot,
            limits,
            fences,
            seconds,
            ..
        } = &self.task;
        FourierSeries::within(robot, limits, fences, *seconds, numbers)
    }

    /// The numbers of a random motion from a posture within all boxes.
    fn random(&self, rng: &mut Rng) -> Vec<f64> {
        let count = harmonics(self.task.seconds);
        let start = &self.starts[rng.usize(0..self.starts.len())];
        let mut numbers = Vec::new();
        for (limits, position) in self.task.limits.iter().zip(start) {
            if let Some(limits) = limits {
                let half = limits.range.half().max(f64::MIN_POSITIVE);
                let place = (position - limits.range.middle()) / (0.8 * half);
                numbers.push(place.clamp(-0.99, 0.99).atanh());
                numbers.extend((0..2 * count).map(|_| normal(rng)));
            }
        }
        numbers
    }

    /// The criterion; infinite if the start is outside a box.
    fn cost(&self, numbers: &[f64]) -> f64 {
        let covariance = || {
            let series = self.series(numbers).ok()??;
            let observations = self.observations(&series).ok()?;
            self.forecast.after(observations).ok()
        };
        let Some(covariance) = covariance() else {
            return f64::INFINITY;
        };
        let deviations = self.rows.deviations(&covariance.root);
        let torques = deviations.iter().filter_map(|own| own.torque);
        torques.map(f64::ln).sum()
    }
}

/// A normal deviate (Box, Muller).
fn normal(rng: &mut Rng) -> f64 {
    (-2.0 * (1.0 - rng.f64()).ln()).sqrt() * (TAU * rng.f64()).cos()
}
