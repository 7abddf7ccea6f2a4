//! On-line identification inside the pipeline: evaluates every channel at an instant in the past,
//! passes the observation to [`Online`], and puts the solutions in use.
//!
//! Torques need the newest instant. Parameters can be identified later, but need accurate
//! accelerations. So an identification instant lies [`DELAY`] before the estimate that triggers it,
//! with samples on both sides, and positions are differentiated by polynomials centred on it
//! ([`Centred`]). F/T readings are averaged over one period about the instant.
//!
//! Time is divided into slots of one `period`; at most one estimate in each slot triggers an
//! identification instant. So these instants depend on the stamps alone, as estimates do.
//!
//! A solution goes to this pipeline's parameters ([`InertialState`]), to readers
//! ([`InertiaEstimate`]) and, from time to time, as text to the file `identification.state`
//! ([`Job::state`]). It never goes to parameters.toml, which `proprio identify` alone writes. At
//! the start identification begins with parameters.toml if the configuration names one, and the
//! file of an earlier run replaces that ([`super::Pipeline::resume`]).

mod centred;

use crate::pipeline::identification::centred::{Centred, DELAY, Estimated, SignalStatistics};
use proprio_topics::{InertiaEstimate, LinkInertia, Name, Nanos, Quality, Reason, SensorOffset};

use super::buffers::{ChannelBuffer, temperature_at};
use crate::differentiate::Window;
use crate::history::History;
use crate::inertial::{InertialState, PosteriorBlock, excess};
use crate::setup::Setup;
use crate::uncertainty::propagation::{Covariance, Propagation};
use proprio_dynamics::spatial::{RigidInertia, Vec3, Wrench};
use proprio_dynamics::{ContactSet, DofSet, FrameMotion, JointState, Kinematics, SensorSet};
use proprio_identification::online::state::{SensorFingerprint, StateError};
use proprio_identification::online::{
    Online, OnlineError, OnlineObservation, Solution, SolutionJob,
};
use proprio_identification::prior::PriorError;
use proprio_identification::robot::{BaseMotion, ChannelRole};

/// On-line identification in a pipeline.
pub(super) struct OnlineIdentification {
    pub(super) online: Online,
    kinematics: Kinematics,
    period: Nanos,
    /// The slot of the last instant.
    slot: i64,
    /// The motion that observations use, and the one measured at the present instant.
    held: Motion,
    current: Motion,
    /// Statistics of each joint's samples, then of nine numbers of the IMU.
    statistics: Vec<SignalStatistics>,
    /// The same for each joint's position and velocity, where measured values are used.
    measured_statistics: Vec<SignalStatistics>,
    /// Per F/T sensor, the mean corrected reading, offset included.
    readings: Vec<Wrench>,
    /// Per degree of freedom, why its motion is not valid.
    joints: Vec<Reason>,
    /// Joints that move at the present instant.
    moved: DofSet,
    /// Per F/T sensor, why its reading is not valid.
    sensors: Vec<Reason>,
    /// Per F/T sensor, when it got a new zero, if the observations have not come there.
    new_zeros: Vec<Option<Nanos>>,
    differentiator: Box<Centred>,
    /// The workspace of a job; none while a job runs.
    workspace: Option<Box<Workspace>>,
    /// The parameters in use, and whether they have been published.
    inertia: Box<InertiaEstimate>,
    is_published: bool,
}

/// The setup that a job uses, and its results for the pipeline.
struct Workspace {
    setup: Setup,
    propagation: Propagation,
    inertia: Box<InertiaEstimate>,
}

/// A job of on-line identification: solves for the parameters and prepares the propagation of their
/// covariance. [`Job::run`] it in any thread, then [`super::Pipeline::give_back`].
pub struct Job {
    solver_job: Box<SolutionJob>,
    workspace: Box<Workspace>,
}

impl Job {
    /// Solves. Takes a millisecond or two for each limb that is a component of its own, a tenth of
    /// a second if a large robot is one component; allocates. The result depends on the samples
    /// alone.
    pub fn run(&mut self) {
        self.solver_job.run();
        let Workspace {
            setup,
            propagation,
            inertia,
        } = &mut *self.workspace;
        let covariance = covariance(setup, self.solver_job.solution());
        // The covariance is of the same structure, so there is no error.
        if let Ok(new) = Propagation::new(&setup.robot.structure, &covariance) {
            *propagation = new;
        }
        write_inertia(setup, self.solver_job.solution(), inertia);
    }

    /// For each component, why it was not solved, if it was not: then its earlier parameters stay
    /// in use.
    pub fn failures(&self) -> impl Iterator<Item = Option<&PriorError>> {
        self.solver_job.failures()
    }

    /// The state of identification when the job began, as text for [`super::Pipeline::resume`].
    #[must_use]
    pub fn state(&self) -> String {
        let setup = &self.workspace.setup;
        self.solver_job
            .state(&setup.robot.name, &measurement_setup(setup))
    }
}

/// Structure and calibrations of the sensors: a saved state is valid for these alone.
fn measurement_setup(setup: &Setup) -> SensorFingerprint {
    SensorFingerprint::new(&setup.robot.structure, &setup.initial.calibrations)
}

/// The covariance of all parameters and offsets: the solution's posterior, and the prior of
/// everything else.
fn covariance(setup: &Setup, solution: &Solution) -> Covariance {
    let blocks = solution.components.iter().map(|component| PosteriorBlock {
        links: &component.links,
        bodies: &component.bodies,
        sensors: &component.sensors,
        root: (component.root.nrows() > 0).then_some(&component.root),
        offsets: &component.offsets,
        drift_std: &component.drift_std,
        known: component.data_until,
    });
    setup.initial.covariance_with(&setup.robot, blocks)
}

/// Writes a solution as the message that is published.
fn write_inertia(setup: &Setup, solution: &Solution, out: &mut InertiaEstimate) {
    let name = |text: &str| Name::new(text).unwrap_or(Name::EMPTY);
    out.header.acquired = solution.data_until;
    let (mut links, mut offsets) = (0, 0);
    for (component, group) in solution.components.iter().zip(0..) {
        let parameters = 10 * component.links.len();
        // P = U^T U over [ten per link | torque, force of each offset].
        let root = &component.root;
        let deviation = |column: usize| match root.nrows() {
            0 => f64::NAN,
            _ => root.column(column).norm(),
        };
        let accepted = u32::from(component.is_accepted);
        for (index, (&link, body)) in component.links.iter().zip(&component.bodies).enumerate() {
            let Some(to) = out.links.get_mut(links) else {
                break;
            };
            links += 1;
            *to = LinkInertia {
                name: name(setup.robot.model.link_name(link)),
                parameters: body.parameters(),
                standard_deviation: std::array::from_fn(|i| deviation(10 * index + i)),
                motion: component.seconds_in_motion,
                rows: component.rows,
                group,
                accepted,
            };
        }
        for (index, (&sensor, offset)) in
            component.sensors.iter().zip(&component.offsets).enumerate()
        {
            let Some(to) = out.offsets.get_mut(offsets) else {
                break;
            };
            offsets += 1;
            let channel = setup
                .robot
                .channels
                .iter()
                .find(|c| c.role == ChannelRole::Sensor(sensor));
            let six = |i: usize| deviation(parameters + 6 * index + i);
            *to = SensorOffset {
                name: channel.map_or(Name::EMPTY, |channel| name(&channel.name)),
                force: offset.force.into(),
                torque: offset.torque.into(),
                standard_deviation: [3, 4, 5, 0, 1, 2].map(six),
                group,
                accepted,
            };
        }
    }
    (out.link_count, out.offset_count) = (to_u32(links), to_u32(offsets));
}

fn to_u32(number: usize) -> u32 {
    u32::try_from(number).unwrap_or(0)
}

impl OnlineIdentification {
    pub(super) fn new(setup: &Setup) -> Result<Self, OnlineError> {
        let period = setup.identification_period;
        let mut online = Online::new(&setup.robot, &setup.initial.offsets, period)?;
        if let Some(parameters) = setup.initial.identified() {
            let links: Vec<(usize, RigidInertia)> = parameters
                .identified()
                .filter_map(|link| Some((link, parameters.inertia(link)?)))
                .collect();
            let root = parameters.root();
            let of_links = root.columns(0, 10 * links.len()).into_owned();
            online.begin_with(&links, &of_links)?;
        }
        let dofs = setup.robot.model.dof_count();
        let held = Motion {
            position: setup.robot.position_without_samples(),
            velocity: vec![0.0; dofs],
            acceleration: vec![0.0; dofs],
            imu: FrameMotion::standing(&Vec3::zeros()),
            errors: vec![0.0; 3 * dofs + 9],
        };
        let propagation = Propagation::new(
            &setup.robot.structure,
            &covariance(setup, online.solution()),
        )?;
        Ok(Self {
            kinematics: Kinematics::new(&setup.robot.model, setup.robot.base_link)?,
            period,
            slot: i64::MIN,
            current: held.clone(),
            statistics: vec![SignalStatistics::default(); dofs + 9],
            measured_statistics: vec![SignalStatistics::default(); 2 * dofs],
            held,
            readings: vec![Wrench::zero(); setup.robot.structure.sensors().len()],
            joints: vec![Reason::None; dofs],
            moved: DofSet::default(),
            sensors: vec![Reason::None; setup.robot.structure.sensors().len()],
            new_zeros: vec![None; setup.robot.structure.sensors().len()],
            differentiator: Box::default(),
            workspace: Some(Box::new(Workspace {
                setup: setup.clone(),
                propagation,
                inertia: Box::default(),
            })),
            inertia: Box::default(),
            is_published: true,
            online,
        })
    }

    /// Puts the covariance before the first solution in use.
    pub(super) fn install_initial_covariance(&mut self, propagation: &mut Propagation) {
        if let Some(workspace) = &mut self.workspace {
            std::mem::swap(propagation, &mut workspace.propagation);
        }
    }

    /// F/T sensor number `sensor` has a new zero from `t` on.
    pub(super) fn begin_zero(&mut self, sensor: usize, t: Nanos) {
        if let Some(zero) = self.new_zeros.get_mut(sensor) {
            *zero = Some(t);
        }
    }

    /// Whether the offset in use of F/T sensor number `sensor` is that of its present zero.
    pub(super) fn knows_zero(&self, sensor: usize) -> bool {
        self.new_zeros.get(sensor).is_none_or(Option::is_none) && self.online.knows_zero(sensor)
    }

    /// The identification instant that an estimate at `t` triggers, if it does.
    pub(super) fn next_instant(&mut self, t: Nanos) -> Option<Nanos> {
        // The slot is that of the identification instant, not of the estimate.
        let t = t - DELAY;
        let slot = t.0.div_euclid(self.period.0);
        (slot != std::mem::replace(&mut self.slot, slot)).then_some(t)
    }

    /// Observes instant `t`. The last argument is the base: its link, its motion if no IMU measures
    /// it, and why that motion is not valid.
    pub(super) fn observe(
        &mut self,
        t: Nanos,
        setup: &Setup,
        buffers: &[ChannelBuffer],
        active: &ContactSet,
        (base_link, mut base, mut base_fault): (usize, FrameMotion, Reason),
    ) {
        let mut is_base_moved = false;
        self.moved = DofSet::default();
        self.current.copy_from(&self.held);
        for (buffer, channel) in buffers.iter().zip(&setup.robot.channels) {
            match (buffer, channel.role) {
                (ChannelBuffer::Joint(history, window), ChannelRole::Joint(dof)) => {
                    self.observe_joint(t, setup, dof, (history, window));
                }
                (ChannelBuffer::Sensor(history, temperatures, _), ChannelRole::Sensor(number)) => {
                    let (celsius, _) = temperature_at(temperatures, t, setup.max_wait);
                    self.observe_sensor(t, setup, number, (history, celsius));
                }
                (ChannelBuffer::Imu(history, window, _), ChannelRole::Base) => {
                    (is_base_moved, base_fault) = self.observe_imu(t, setup, (history, window));
                }
                _ => {}
            }
        }
        if is_base_moved || !self.moved.is_empty() {
            self.held.copy_from(&self.current);
        }
        if let BaseMotion::Imu(pose) = &setup.robot.base {
            base = FrameMotion::of_link_from_imu(&self.held.imu, pose);
        }
        if self
            .kinematics
            .set_base(&setup.robot.model, base_link)
            .is_err()
        {
            return;
        }
        let state = JointState {
            position: &self.held.position,
            velocity: &self.held.velocity,
            acceleration: &self.held.acceleration,
        };
        if self
            .kinematics
            .update(&setup.robot.model, state, &base)
            .is_err()
        {
            return;
        }
        // No error: sizes are those of the setup, and all values are finite.
        let _ = self.online.observe(&OnlineObservation {
            t,
            kinematics: &self.kinematics,
            readings: &self.readings,
            active,
            base: base_fault,
            joints: &self.joints,
            moved: &self.moved,
            is_base_moved,
            state,
            base_motion: base,
            sensors: &self.sensors,
        });
    }

    /// Evaluates a joint at `t`. Measured velocities and accelerations are used. Derivatives that
    /// are not measured come from the highest one that is.
    fn observe_joint(
        &mut self,
        t: Nanos,
        setup: &Setup,
        dof: usize,
        (history, window): (&History<3>, &Window<1>),
    ) {
        let (from, to) = (t - DELAY, t + DELAY);
        let (Some(q), Some(dq), Some(ddq), Some(fault), Some(statistics)) = (
            self.current.position.get_mut(dof),
            self.current.velocity.get_mut(dof),
            self.current.acceleration.get_mut(dof),
            self.joints.get_mut(dof),
            self.statistics.get_mut(dof),
        ) else {
            return;
        };
        let bad = Quality::UNTRUSTED_ENCODER | Quality::ZERO_CHANGED;
        let max_silence = setup.robot.max_silence;
        let gathered = self
            .differentiator
            .gather(history, from, to, max_silence, bad);
        *fault = gathered.err().unwrap_or(Reason::None);
        let mut orders = (0..3).rev();
        let highest = orders.find(|&order| self.differentiator.is_complete(order));
        let highest = highest.unwrap_or(0);
        // For positions the noise during motion is known, too.
        let [sigma] = match highest {
            0 => window.noise(to),
            _ => [f64::NAN],
        };
        let fit = self.differentiator.fit(highest, statistics, sigma, 2);
        let measured = (highest > 0).then(|| history.at(t, to)).flatten();
        let mut measured_statistics = self.measured_statistics.iter_mut().skip(2 * dof);
        let mut exact = |order: usize| {
            let error = measured_statistics.next().map_or(0.0, |statistics| {
                self.differentiator.sample_std(order, statistics)
            });
            let value = measured.and_then(|measured| measured.value.get(order).copied());
            Estimated {
                value: value.unwrap_or(f64::NAN),
                error,
            }
        };
        let values = match highest {
            0 => fit,
            1 => [exact(0), fit[0], fit[1]],
            _ => [exact(0), exact(1), fit[0]],
        };
        let errors = self.current.errors.chunks_exact_mut(3).nth(dof);
        if replace([&mut *q, dq, ddq], errors.into_iter().flatten(), values) {
            self.moved.insert(dof);
        }
        if !(q.is_finite() && dq.is_finite() && ddq.is_finite()) {
            [*q, *dq, *ddq] = [0.0; 3];
            *fault = (*fault).or(Reason::NotFinite);
        }
    }

    /// Averages the readings of an F/T sensor about `t`, whose board has this temperature
    /// \[degrees Celsius\].
    fn observe_sensor(
        &mut self,
        t: Nanos,
        setup: &Setup,
        number: usize,
        (history, celsius): (&History<6>, f64),
    ) {
        let (Some(reading), Some(fault)) =
            (self.readings.get_mut(number), self.sensors.get_mut(number))
        else {
            return;
        };
        let (mean, reason) = mean_reading(history, t, self.period, setup.robot.max_silence);
        let calibration = setup.initial.calibrations.get(number);
        *reading = calibration.map_or(mean, |calibration| calibration.apply(&mean, celsius));
        *fault = reason;
        // A mean of readings before and after is of neither zero.
        if let Some(zero) = self.new_zeros.get_mut(number)
            && let Some(from) = *zero
        {
            if t > from + self.period {
                *zero = None;
                self.online.forget_offset(number);
            } else if t + self.period >= from {
                *fault = (*fault).or(Reason::Uncertain);
            }
        }
    }

    /// Evaluates the IMU at `t`. Returns whether the base moves, and why its motion is not valid.
    fn observe_imu(
        &mut self,
        t: Nanos,
        setup: &Setup,
        (history, window): (&History<9>, &Window<3>),
    ) -> (bool, Reason) {
        let (from, to) = (t - DELAY, t + DELAY);
        let max_silence = setup.robot.max_silence;
        let gathered =
            self.differentiator
                .gather(history, from, to, max_silence, Quality::DEVICE_FAULT);
        let mut fault = gathered.err().unwrap_or(Reason::None);
        let mut has_base_moved = false;
        let measured = &mut self.current.imu;
        let first = self.statistics.len().saturating_sub(9);
        for (axis, sigma) in window.noise(to).into_iter().enumerate() {
            // Separate statistics: angular acceleration may be absent at times.
            let mut none = [SignalStatistics::default(); 3];
            let of_axis = first + 3 * axis..first + 3 * axis + 3;
            let statistics = self.statistics.get_mut(of_axis);
            let [of_rate, of_angular, of_linear]: &mut [SignalStatistics; 3] = statistics
                .and_then(|own| own.try_into().ok())
                .unwrap_or(&mut none);
            let gyro = self.differentiator.fit(3 + axis, of_rate, sigma, 1);
            let alpha = match self.differentiator.is_complete(6 + axis) {
                true => self.differentiator.fit(6 + axis, of_angular, f64::NAN, 0)[0],
                false => gyro[1],
            };
            let acceleration = self.differentiator.fit(axis, of_linear, f64::NAN, 0)[0];
            let errors = self.current.errors.iter_mut().rev().skip(3 * axis);
            let held = [
                &mut measured.proper_acceleration[axis],
                &mut measured.angular_velocity[axis],
                &mut measured.angular_acceleration[axis],
            ];
            has_base_moved |= replace(held, errors, [acceleration, gyro[0], alpha]);
        }
        let numbers = [
            &measured.proper_acceleration,
            &measured.angular_velocity,
            &measured.angular_acceleration,
        ];
        if numbers.iter().any(|v| v.iter().any(|x| !x.is_finite())) {
            fault = fault.or(Reason::NotFinite);
            *measured = FrameMotion::standing(&Vec3::zeros());
        }
        (has_base_moved, fault)
    }

    /// Puts a solution in use if its stamp has been reached; whether it did. The noise of the
    /// sensors that are `touched` does not grow: a push that lasts would look like noise, and end
    /// for the residual test. But it is that of the worst undisturbed second of late: a sensor that
    /// turns worse (late, vibrating) looks like a contact that comes and goes.
    pub(super) fn apply(
        &mut self,
        setup: &Setup,
        parameters: &mut InertialState,
        propagation: &mut Propagation,
        touched: &SensorSet,
    ) -> bool {
        // A solution to apply implies that its job, and so the workspace, was given back.
        if !self.online.apply() {
            return false;
        }
        self.put_in_use(setup, parameters, propagation, touched);
        true
    }

    /// Resumes from the state of an earlier run.
    pub(super) fn resume(
        &mut self,
        text: &str,
        setup: &Setup,
        parameters: &mut InertialState,
        propagation: &mut Propagation,
    ) -> Result<(), StateError> {
        self.online
            .resume(&setup.robot.name, &measurement_setup(setup), text)?;
        if let Some(workspace) = &mut self.workspace
            && let Ok(new) = Propagation::new(
                &setup.robot.structure,
                &covariance(setup, self.online.solution()),
            )
        {
            workspace.propagation = new;
            write_inertia(setup, self.online.solution(), &mut workspace.inertia);
        }
        self.put_in_use(setup, parameters, propagation, &SensorSet::EMPTY);
        Ok(())
    }

    /// Copies the last solution to the parameters and the propagation of the pipeline.
    fn put_in_use(
        &mut self,
        setup: &Setup,
        parameters: &mut InertialState,
        propagation: &mut Propagation,
        touched: &SensorSet,
    ) {
        for component in &self.online.solution().components {
            for (&link, body) in component.links.iter().zip(&component.bodies) {
                // No error: a link of the model, and finite.
                let _ = parameters.model.set_inertia(link, *body);
            }
            for (&sensor, offset) in component.sensors.iter().zip(&component.offsets) {
                if let Some(slot) = parameters.offsets.get_mut(sensor) {
                    *slot = *offset;
                }
            }
            let found = component.noise.iter().zip(&component.worst);
            for (&sensor, (found, worst)) in component.sensors.iter().zip(found) {
                let structure = &setup.robot.structure;
                let [found, worst] = [found, worst].map(|v| excess(structure, sensor, v));
                if let Some(slot) = parameters.excess_variance.get_mut(sensor) {
                    let most = match touched.contains(sensor) {
                        true => *slot,
                        false => [f64::INFINITY; 6],
                    };
                    *slot = std::array::from_fn(|i| found[i].min(most[i]).max(worst[i]));
                }
            }
        }
        if let Some(workspace) = &mut self.workspace {
            std::mem::swap(propagation, &mut workspace.propagation);
            std::mem::swap(&mut self.inertia, &mut workspace.inertia);
            self.is_published = false;
        }
    }

    /// The parameters in use, if they have not been published yet.
    pub(super) fn inertia(&mut self) -> Option<&InertiaEstimate> {
        (!std::mem::replace(&mut self.is_published, true)).then_some(&*self.inertia)
    }

    pub(super) fn take_job(&mut self) -> Option<Job> {
        self.workspace.as_ref()?;
        let solver_job = self.online.take_job()?;
        Some(Job {
            solver_job,
            workspace: self.workspace.take()?,
        })
    }

    pub(super) fn give_back(&mut self, job: Job) {
        self.online.give_back(job.solver_job);
        self.workspace = Some(job.workspace);
    }
}

/// Standard errors by which a value must differ from the held one to count as motion.
const SIGNIFICANT_CHANGE: f64 = 6.0;

/// Replaces values and their standard errors by new ones, in pairs. Returns whether one differs
/// from its new one by more than both errors explain: motion.
fn replace<'a>(
    held: [&mut f64; 3],
    errors: impl Iterator<Item = &'a mut f64>,
    new: [Estimated; 3],
) -> bool {
    let mut has_moved = false;
    for ((held, held_error), Estimated { value, error }) in held.into_iter().zip(errors).zip(new) {
        let apart = (value - *held).abs();
        has_moved |= apart.is_nan() || apart > SIGNIFICANT_CHANGE * held_error.hypot(error);
        (*held, *held_error) = (value, error);
    }
    has_moved
}

/// The motion used in observations. It is held until one of its values differs from the held one by
/// more than its noise.
///
/// So a robot at rest has one state, and its regressor rows differ in their right-hand sides alone.
/// Noise in the regressor would be motion without a force (errors in variables): some hundred such
/// rows would show that the robot has no mass.
#[derive(Clone)]
struct Motion {
    position: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    imu: FrameMotion,
    /// Standard errors: three per joint, then nine of the IMU, its first axis last.
    errors: Vec<f64>,
}

impl Motion {
    fn copy_from(&mut self, other: &Self) {
        self.position.copy_from_slice(&other.position);
        self.velocity.copy_from_slice(&other.velocity);
        self.acceleration.copy_from_slice(&other.acceleration);
        self.imu = other.imu;
        self.errors.copy_from_slice(&other.errors);
    }
}

/// The mean of a sensor's readings within one period about `t`; interpolated if there are none.
fn mean_reading(
    history: &History<6>,
    t: Nanos,
    period: Nanos,
    max_silence: Nanos,
) -> (Wrench, Reason) {
    let half = Nanos(period.0 / 2);
    let (mut sum, mut count, mut quality) = ([0.0; 6], 0.0, Quality::GOOD);
    for (_, value, q) in history.within(t - half, t + half) {
        sum.iter_mut().zip(value).for_each(|(sum, x)| *sum += x);
        count += 1.0;
        quality |= q;
    }
    let mut stale = Reason::None;
    if count == 0.0 {
        let Some(held) = history.at(t, t + DELAY) else {
            return (Wrench::zero(), Reason::NeverSeen);
        };
        (sum, count, quality) = (held.value, 1.0, held.quality);
        if !held.interpolated || held.age > max_silence {
            stale = Reason::Stale;
        }
    }
    let [fx, fy, fz, tx, ty, tz] = sum.map(|x| x / count);
    let reason = Reason::of_quality(quality, Quality::DEVICE_FAULT).or(stale);
    (Wrench::from_parts([fx, fy, fz], [tx, ty, tz]), reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_of_degree_four_is_exact_at_irregular_stamps() {
        let mut history = History::<3>::default();
        let signal = |t: f64| 0.3 - 0.5 * t + 2.0 * t * t - 3.0 * t.powi(3) + 4.0 * t.powi(4);
        let centre = Nanos::from_seconds(0.7);
        for k in 0..70 {
            let t = Nanos::from_seconds(0.4 + 0.01 * f64::from(k) + 0.0003 * f64::from(k * k % 7));
            history.push(
                t,
                [signal((t - centre).seconds()), f64::NAN, f64::NAN],
                Quality::GOOD,
            );
        }
        let mut centred = Centred::default();
        let mut statistics = SignalStatistics::default();
        let silence = Nanos::from_millis(50);
        centred
            .gather(
                &history,
                centre - DELAY,
                centre + DELAY,
                silence,
                Quality::UNTRUSTED_ENCODER,
            )
            .unwrap();
        assert!(centred.is_complete(0) && !centred.is_complete(1));
        let found = centred.fit(0, &mut statistics, f64::NAN, 2);
        for (found, expected) in found.iter().zip([0.3, -0.5, 4.0]) {
            assert!(
                (found.value - expected).abs() < 1e-9,
                "{found:?}, not {expected}"
            );
        }
    }

    #[test]
    fn a_sine_is_followed_rest_has_little_noise_and_a_gap_is_reported() {
        let silence = Nanos::from_millis(100);
        let (w, centre) = (2.0 * std::f64::consts::PI, Nanos::from_seconds(1.25));
        let mut random = 1u32;
        let mut noise = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (f64::from(random) / f64::from(u32::MAX) - 0.5) * 2e-4
        };
        let mut centred = Centred::default();
        let mut statistics = SignalStatistics::default();
        for (size, bound) in [(1.0, 0.5), (0.0, 0.02)] {
            let mut history = History::<3>::default();
            for k in 0..250 {
                let t = Nanos::from_millis(10 * k);
                let value = size * (w * t.seconds()).sin() + noise();
                history.push(t, [value, f64::NAN, f64::NAN], Quality::GOOD);
            }
            centred
                .gather(
                    &history,
                    centre - DELAY,
                    centre + DELAY,
                    silence,
                    Quality::UNTRUSTED_ENCODER,
                )
                .unwrap();
            let [_, _, acceleration] = centred.fit(0, &mut statistics, f64::NAN, 2);
            let error = (acceleration.value + size * w * w).abs();
            // The peak is 39.5 rad/s^2; a quadratic over the whole window would be off by 7.
            assert!(error < bound, "{error}");
            // At the end of the samples there is no centred window.
            let end = Nanos::from_millis(2490);
            let refused = centred.gather(
                &history,
                end - DELAY,
                end + DELAY,
                silence,
                Quality::UNTRUSTED_ENCODER,
            );
            assert_eq!(refused, Err(Reason::Stale));
        }
    }
}
