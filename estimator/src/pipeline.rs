//! Samples in, estimates out: all channels are aligned to the stamps of the trigger channel, and
//! each of these stamps gives one estimate.
//!
//! # The path of a reading
//! 1. [`Pipeline::push`] (`arrival`) judges a sample by those before it
//!    ([`proprio_topics::sanity`]: one that repeats or jumps is flagged) and stores it in its
//!    channel's buffer (`buffers`, [`crate::history`], [`crate::differentiate`]). A sample of the
//!    trigger channel also queues its stamp.
//! 2. [`Pipeline::poll`] releases the oldest queued stamp `t` when all its samples are there.
//! 3. Every channel is evaluated at `t` (`inputs`). F/T readings are corrected for calibration,
//!    temperature and offset.
//! 4. The contacts that are present are put where declarations or skins say (`contacts`,
//!    [`crate::skin`]). Kinematics and solver give torques and contact wrenches; standard
//!    deviations are propagated (`solution`, `uncertainty`).
//! 5. The F/T residual of each sub-tree is tested (`residuals`). A possible contact that explains a
//!    significant residual is taken as present. Without such a contact, the torques of the sub-tree
//!    are not valid.
//!    Where it can not be tested because of a fault, what rests on the absence of a possible
//!    contact is not valid either.
//! 6. Every torque and contact wrench is written with its validity and reason (`validity`,
//!    `estimate`). Who asks, hears what a torque rests on, and how much of its variance each of
//!    these inputs causes (`budget`).
//! 7. Where a joint's drive reports a torque or a current, the two are compared (`drives`,
//!    [`crate::drive`]).
//!
//! # Alignment
//! Each stamp `t` of the trigger channel gives exactly one estimate, in order. What follows holds
//! if `max_wait_ms` is given; see below for estimates that do not wait. One is released once
//! every channel has a sample stamped `t` or later, or once the newest stamp of any channel is
//! later than `t + max_wait`, or once 256 instants wait (a trigger above 1 kHz). The estimate uses
//! the samples stamped `t` or earlier and, of each channel, the first later one if its stamp is at
//! most `t + max_wait / 2`. A sample that arrives after its instant was released is dropped and
//! counted. So the estimates depend on the stamps alone: not on the time of day, and not on the
//! order of arrival, provided that no sample arrives more than `max_wait / 2` behind a later one. A
//! replay gives the live estimates bit for bit.
//!
//! A sample stamped exactly `t` is used as it is, with its velocity and acceleration if it has
//! credible ones. Otherwise the adaptive window differentiates ([`crate::differentiate`]). Wrenches
//! and proper accelerations are interpolated linearly. Wrenches are corrected first
//! ([`proprio_dynamics::calibration`]), by the last temperature of their board stamped before
//! `t - max_wait / 2`, however old: temperature changes slowly. Before the first temperature, the
//! board is taken to be at its reference temperature. While there is none, or it is older than a
//! minute, the variance of the offset is increased ([`temperature_variance`]).
//!
//! [`temperature_variance`]: proprio_dynamics::calibration::Calibration::temperature_variance
//!
//! # Immediate estimates
//! By default nothing waits: the trigger's sample releases its estimate. Every
//! other channel is evaluated from the samples that have arrived. Where none is stamped `t` or
//! later, the adaptive window extrapolates: positions and angular velocities with the windows that
//! differentiate them, wrenches and proper accelerations with one of their own (`prediction`). The
//! standard deviations include that of the extrapolated value: its noise, and its change with a
//! polynomial of one degree more. (As elsewhere, errors of velocities are neglected.) No sample is
//! late then, and the estimates depend on the order of arrival: a replay in that order gives them
//! bit for bit.
//!
//! # Identification
//! With identification on ([`proprio_identification::online`]), the inertial parameters, offsets
//! and their covariance are those of the last solution put in use. The owner of the pipeline runs
//! its jobs ([`Pipeline::take_job`]), immediately or in another thread. A sensor whose device tells
//! of a new zero has an unknown offset until a solution has it; without identification for good.
//!
//! # Uncertainty
//! Standard deviations contain F/T noise, the uncertainty of inertial parameters and F/T offsets,
//! that of differentiated accelerations, encoder offsets and the base's proper acceleration, and
//! that of the places of declared and touched contacts (`uncertainty`). They do not contain the
//! errors of velocities.

mod arrival;
mod budget;
mod buffers;
mod contacts;
mod drives;
mod estimate;
mod identification;
mod inputs;
mod offset_steps;
mod prediction;
mod residuals;
mod significance;
mod solution;
mod validity;

pub use estimate::{Counts, Estimate};
pub use identification::Job;

use crate::differentiate::Window;
use crate::drive::DriveRow;
use crate::history::History;
use crate::inertial::InertialState;
use crate::setup::Setup;
use crate::uncertainty::Uncertainty;
use buffers::{ChannelBuffer, Sanity};
use contacts::Contacts;
use drives::{DriveInstant, Drives};
use identification::OnlineIdentification;
use inputs::Inputs;
use offset_steps::OffsetStepCover;
use prediction::Predictor;
use proprio_dynamics::spatial::Wrench;
use proprio_dynamics::{
    ContactSet, Dependence, FrameMotion, Kinematics, Noise, SensorCut, Solver, Structure,
};
use proprio_identification::online::state::StateError;
use proprio_identification::online::{Online, OnlineError};
use proprio_identification::robot::ChannelRole;
use proprio_topics::{DriveEstimate, InertiaEstimate, Nanos, Reason, TorqueBudget};
use residuals::ResidualMonitor;
use std::collections::VecDeque;
use validity::Dependences;

/// The estimator's core: no input, no output, no clock.
pub struct Pipeline {
    setup: Setup,
    /// The parameters in use.
    parameters: InertialState,
    /// The robot's parts and contacts, with the contacts where they are now.
    structure: Structure,
    buffers: Vec<ChannelBuffer>,
    /// The same channels: whether their readings can be true.
    sanity: Vec<Sanity>,
    /// What they say at the present instant.
    inputs: Inputs,
    /// Why the motion of the base is not valid, if no channel measures it.
    base_fault: Reason,
    /// Which contacts are present, and where.
    contacts: Contacts,
    /// Stamps of the trigger channel that have no estimate yet, oldest first.
    waiting: VecDeque<Nanos>,
    /// The newest stamp of any channel.
    newest: Nanos,
    /// The stamp of the last estimate.
    released: Nanos,
    finished: bool,
    counts: Counts,
    kinematics: Kinematics,
    solver: Solver,
    /// Standard deviations of the results.
    uncertainty: Box<Uncertainty>,
    /// Tests the F/T residual of each sub-tree.
    residuals: ResidualMonitor,
    /// What else the residuals may be.
    steps: OffsetStepCover,
    /// See [`validity::ValidityCheck`].
    unwatched: Vec<(ContactSet, Reason, u32)>,
    /// Per F/T sensor, since when its zero is another one than that of the offset in use.
    new_zeros: Vec<Option<Nanos>>,
    /// The channels that each output depends on.
    dependences: Dependences,
    identification: Option<Box<OnlineIdentification>>,
    /// Why on-line identification was requested but is not available.
    refusal: Option<OnlineError>,
    estimate: Box<Estimate>,
    budget: Box<TorqueBudget>,
    /// What the drives say of the torques.
    drives: Option<Box<Drives>>,
}

impl Pipeline {
    /// Largest number of waiting instants; when it is reached, the oldest is released.
    const MAX_WAITING: usize = 256;

    /// A pipeline without samples.
    ///
    /// # Panics
    /// Never with a [`Setup`] from its own constructors, which check everything that could fail
    /// here.
    #[must_use]
    #[allow(
        clippy::expect_used,
        reason = "the setup was checked when it was built"
    )]
    pub fn new(setup: Setup) -> Self {
        let kinematics = Kinematics::new(&setup.initial.model, setup.robot.base_link)
            .expect("the base is a link of the model");
        let (dofs, contacts) = (
            setup.initial.model.dof_count(),
            setup.robot.structure.contacts().len(),
        );
        let mut estimate = Box::new(Estimate::absent(Nanos::ZERO));
        estimate.torques.count = u32::try_from(setup.robot.published().count()).unwrap_or(0);
        estimate.contacts.count = u32::try_from(setup.robot.contacts.len()).unwrap_or(0);
        estimate.contacts.residual_count =
            u32::try_from(setup.robot.subtree_names().count()).unwrap_or(0);
        let mut uncertainty = Uncertainty::new(
            &setup.robot.structure,
            &setup.initial,
            setup.robot.base_link,
        )
        .expect("the covariance is of the model, and the base its link");
        let (identification, refusal) = match setup
            .identifies
            .then(|| OnlineIdentification::new(&setup))
            .transpose()
        {
            Ok(identification) => (identification.map(Box::new), None),
            Err(error) => (None, Some(error)),
        };
        let mut identification = identification;
        if let Some(identification) = &mut identification {
            identification.install_initial_covariance(&mut uncertainty.propagation);
        }
        Self {
            buffers: setup
                .robot
                .channels
                .iter()
                .map(|own| buffer(&setup, own.role))
                .collect(),
            sanity: setup
                .robot
                .channels
                .iter()
                .map(|own| sanity(&setup, own.role))
                .collect(),
            inputs: Inputs::new(&setup),
            base_fault: Reason::None,
            contacts: Contacts::new(&setup),
            waiting: VecDeque::with_capacity(Self::MAX_WAITING),
            newest: Nanos::MIN,
            released: Nanos::MIN,
            finished: false,
            counts: Counts::default(),
            kinematics,
            solver: Solver::new(&setup.robot.structure),
            uncertainty: Box::new(uncertainty),
            residuals: ResidualMonitor::new(&setup.robot.structure),
            steps: OffsetStepCover::new(&setup.robot.structure, dofs),
            unwatched: Vec::with_capacity(setup.robot.structure.subtrees().len()),
            new_zeros: vec![None; setup.robot.structure.sensors().len()],
            dependences: Dependences {
                active: None,
                torques: vec![Dependence::default(); dofs],
                contacts: vec![Dependence::default(); contacts],
                subtrees: vec![Dependence::default(); setup.robot.structure.subtrees().len()],
            },
            identification,
            refusal,
            estimate,
            budget: Box::default(),
            drives: Drives::new(&setup),
            parameters: setup.initial.clone(),
            structure: setup.robot.structure.clone(),
            setup,
        }
    }

    /// On-line identification, if it is on.
    #[must_use]
    pub fn identification(&self) -> Option<&Online> {
        self.identification
            .as_ref()
            .map(|identification| &identification.online)
    }

    /// Why on-line identification was requested by the configuration but is not available.
    #[must_use]
    pub fn identification_refused(&self) -> Option<&OnlineError> {
        self.refusal.as_ref()
    }

    /// Resumes identification from the state of an earlier run ([`Job::state`]). Call it before the
    /// first sample. Does nothing if identification is off.
    ///
    /// # Errors
    /// The state is damaged, or belongs to another robot; then nothing is changed.
    pub fn resume(&mut self, state: &str) -> Result<(), StateError> {
        let Some(identification) = &mut self.identification else {
            return Ok(());
        };
        identification.resume(
            state,
            &self.setup,
            &mut self.parameters,
            &mut self.uncertainty.propagation,
        )
    }

    /// The next job of identification, if one is due: about once a second of stamps. Call it after
    /// each estimate, run the job and return it with [`Pipeline::give_back`]. If the job returns
    /// before a second of stamps has passed, the estimates depend on the samples alone. Otherwise
    /// its solution is used later, which is counted.
    pub fn take_job(&mut self) -> Option<Job> {
        self.identification.as_mut()?.take_job()
    }

    /// The parameters and offsets identified on-line, once after each change of the parameters in
    /// use: about once a second, and after [`Pipeline::resume`]. Call it after each estimate, which
    /// is the first one that uses them. Only `acquired` of the header is set.
    pub fn inertia(&mut self) -> Option<&InertiaEstimate> {
        self.identification.as_mut()?.inertia()
    }

    /// Returns a job that was run.
    pub fn give_back(&mut self, job: Job) {
        if let Some(identification) = &mut self.identification {
            identification.give_back(job);
        }
    }

    /// Replaces the offset in use of F/T sensor number `sensor`; its standard deviation stays. Does
    /// nothing if there is no such sensor. With identification on, its next solution replaces the
    /// offset again.
    pub fn set_offset(&mut self, sensor: usize, offset: Wrench) {
        if let Some(place) = self.parameters.offsets.get_mut(sensor) {
            *place = offset;
            self.residuals.restart_means();
            if let Some(zero) = self.new_zeros.get_mut(sensor) {
                *zero = None;
            }
        }
    }

    /// The configuration.
    #[must_use]
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// The inertial parameters, offsets and calibrations in use.
    #[must_use]
    pub fn parameters(&self) -> &InertialState {
        &self.parameters
    }

    /// How many samples were taken and dropped so far.
    #[must_use]
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// The F/T sensors whose calibration needs a board temperature that was missing at the last
    /// estimate: none was received, or the last one was more than a minute old.
    pub fn without_temperature(&self) -> impl Iterator<Item = &str> {
        let channels = self.setup.robot.channels.iter();
        let missing = &self.inputs.missing_temperature;
        channels.filter_map(|channel| match channel.role {
            ChannelRole::Sensor(number) if missing.get(number) == Some(&true) => {
                Some(channel.name.as_str())
            }
            _ => None,
        })
    }

    /// Ends the input: no more samples come, and every waiting instant is released.
    pub fn finish(&mut self) {
        self.finished = true;
    }

    /// The next estimate, if one can be made now.
    pub fn poll(&mut self) -> Option<&Estimate> {
        let t = *self.waiting.front()?;
        let passed = || {
            self.buffers
                .iter()
                .all(|buffer| buffer.newest().is_some_and(|newest| newest >= t))
        };
        let waited = self.newest > t + self.setup.max_wait;
        let is_immediate = !self.setup.waits;
        if !(is_immediate
            || self.finished
            || waited
            || self.waiting.len() == Self::MAX_WAITING
            || passed())
        {
            return None;
        }
        self.waiting.pop_front();
        self.released = t;
        self.identify(t);
        self.compute_estimate(t);
        if let Some(mut drives) = self.drives.take() {
            drives.compare(&self.instant(), &self.dependences.torques);
            self.drives = Some(drives);
        }
        Some(&self.estimate)
    }

    /// The last estimate.
    #[must_use]
    pub fn last_estimate(&self) -> &Estimate {
        &self.estimate
    }

    /// The torques of the drives at the last estimate, and whether they agree with it; none if no
    /// drive is known.
    #[must_use]
    pub fn drives(&self) -> Option<&DriveEstimate> {
        let drives = self.drives.as_ref()?;
        (!self.setup.drives.is_empty()).then_some(drives.estimate())
    }

    /// What joints and drives do at the last estimate, per degree of freedom whose torque is valid
    /// and whose drive reports something: what a drive is identified from. Of all joints, with
    /// [`Setup::learns_drives`].
    pub fn drive_rows(&self) -> impl Iterator<Item = (usize, DriveRow)> {
        let drives = self.drives.iter();
        drives.flat_map(|drives| drives.rows(self.instant()))
    }

    /// The last estimate, as drives are compared with it.
    fn instant(&self) -> DriveInstant<'_> {
        DriveInstant {
            t: self.estimate.t,
            until: self.until(self.estimate.t),
            robot: &self.setup.robot,
            torques: self.estimate.torques.joints(),
            state: self.inputs.joints(),
            faults: &self.inputs.faults,
        }
    }

    /// Feeds identification, and puts a new solution in use when it is due.
    fn identify(&mut self, t: Nanos) {
        let Some(mut identification) = self.identification.take() else {
            return;
        };
        if let Some(instant) = identification.next_instant(t) {
            let active = self.active_contacts(instant);
            let base = self.setup.robot.base_motion(&active);
            // The rows of identification have the contacts at their configured places.
            if !(self.contacts).is_elsewhere(&self.setup.robot, &active, instant) {
                identification.observe(instant, &self.setup, &self.buffers, &active, base);
            }
            let touched = self.residuals.touched(&self.structure);
            let (parameters, propagation) =
                (&mut self.parameters, &mut self.uncertainty.propagation);
            if identification.apply(&self.setup, parameters, propagation, &touched) {
                self.residuals.restart_means();
                for (sensor, since) in self.new_zeros.iter_mut().enumerate() {
                    since.take_if(|_| identification.knows_zero(sensor));
                }
            }
        }
        self.identification = Some(identification);
    }

    /// The contacts known to be present at `t`, by configuration, declaration or touch.
    fn active_contacts(&self, t: Nanos) -> ContactSet {
        self.contacts.active(&self.setup.robot, t)
    }

    /// Makes the base link the start of the kinematics. Returns its motion, which the IMU replaces
    /// if there is one.
    fn place_base(&mut self, active: &ContactSet) -> FrameMotion {
        let (link, motion, fault) = self.setup.robot.base_motion(active);
        self.base_fault = fault;
        if self
            .kinematics
            .set_base(&self.parameters.model, link)
            .is_err()
        {
            self.base_fault = Reason::NotFinite;
        }
        motion
    }

    /// The last stamp whose samples may be used for an estimate at `t`.
    fn until(&self, t: Nanos) -> Nanos {
        match self.setup.waits {
            // Half of the wait: a sample that may be used can then arrive late by the other half.
            true => t + Nanos(self.setup.max_wait.0 / 2),
            // What has arrived, and never more is known.
            false => Nanos::MAX,
        }
    }
}

/// Peak noise of an accelerometer \[m/s^2\]: three times the noise of a BNO055 at a bandwidth of
/// 62 Hz; the samples may show more.
const ACCELEROMETER_NOISE: f64 = 0.035;

/// An empty buffer for the samples of a channel.
#[allow(
    clippy::expect_used,
    reason = "the setup was checked when it was built"
)]
fn buffer(setup: &Setup, role: ChannelRole) -> ChannelBuffer {
    let checked = "settings were checked";
    match role {
        ChannelRole::Joint(_) => ChannelBuffer::Joint(
            History::default(),
            Box::new(Window::new(setup.joint_settings).expect(checked)),
        ),
        ChannelRole::Sensor(number) => ChannelBuffer::Sensor(
            History::default(),
            History::default(),
            sensor_predictor(setup, number),
        ),
        ChannelRole::Base => ChannelBuffer::Imu(
            History::default(),
            Box::new(Window::new(setup.gyro_settings).expect(checked)),
            (!setup.waits)
                .then(|| Predictor::new([ACCELEROMETER_NOISE; 3], setup.gyro_settings))
                .flatten(),
        ),
    }
}

/// What tells impossible values of a channel.
fn sanity(setup: &Setup, role: ChannelRole) -> Sanity {
    match role {
        ChannelRole::Joint(_) => Sanity::of_encoder(setup.joint_settings.noise),
        ChannelRole::Sensor(number) => Sanity::of_noisy(sensor_peaks(setup, number)),
        ChannelRole::Base => {
            let (a, g) = (ACCELEROMETER_NOISE, setup.gyro_settings.noise);
            Sanity::of_noisy([a, a, a, g, g, g])
        }
    }
}

/// The predictor of F/T sensor `number`, if estimates do not wait.
fn sensor_predictor(setup: &Setup, number: usize) -> Option<Predictor<6>> {
    if setup.waits {
        return None;
    }
    Predictor::new(sensor_peaks(setup, number), setup.joint_settings)
}

/// Peak noise of F/T sensor `number`.
fn sensor_peaks(setup: &Setup, number: usize) -> [f64; 6] {
    let cut = setup.robot.structure.sensors().get(number);
    let Some(Noise { force, torque }) = cut.map(SensorCut::noise) else {
        return [0.0; 6];
    };
    let ([fx, fy, fz], [tx, ty, tz]) = (force, torque);
    // A uniformly distributed error of this peak has this standard deviation.
    [fx, fy, fz, tx, ty, tz].map(|std| std * f64::sqrt(3.0))
}
