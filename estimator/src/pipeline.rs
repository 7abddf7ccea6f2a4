//! Samples in, estimates out: alignment of all channels to the trigger's stamps, and the estimate at each.
//!
//! Each stamp T of the trigger channel gives exactly one estimate, in order. It is released once every channel has passed
//! T, or the newest stamp of any channel is later than T + wait. It rests on the samples stamped T or earlier and, of each
//! channel, the first later one if that is stamped T + wait/2 or earlier. A sample that comes after its instant was released
//! is dropped and counted. So the estimates depend on stamps alone, not on the time of day, and not on the order of arrival
//! either as long as no sample comes more than wait/2 behind a later one; what runs live is, bit for bit, what a replay gives.
//!
//! A channel stamped exactly T is used as it is, its velocity and acceleration too where it has them; otherwise they come
//! from its adaptive window ([`crate::differentiate`]). Wrenches and proper accelerations lie on straight lines between samples.
//! Wrenches are corrected first ([`crate::calibration`]), by the last temperature of their board stamped before T - wait/2, however old: it changes slowly. Before the first one the
//! board is taken to be at its reference temperature. While there is none, or it is older than a minute, the offset is as much less certain ([`Calibration::temperature_variance`]).
//!
//! With identification on ([`crate::identify::online`]), inertial parameters, offsets and their covariance are those of the last solution in force; who owns the pipeline runs its
//! jobs ([`Pipeline::take_job`]), at once or in another thread.
//!
//! Standard deviations hold F/T noise, what is uncertain of inertial parameters and F/T offsets ([`crate::regressor::Propagation`]), of accelerations that are
//! differentiated, of encoders' zeros and of the base's proper acceleration (`motion`); not the errors of velocities.
//!
//! What F/T readings contradict is found at each instant (`watch`): a possible contact that explains them is taken as present, else the sub-tree's torques are withheld.

mod learning;
mod motion;
mod watch;

pub use learning::Job;

use crate::differentiate::{Grid, Unavailable, Window};
use crate::dynamics::{Certainty, ContactSet, Dependence, FrameMotion, JointState, Kinematics, Solver, Structure};
use crate::history::{Held, History};
use crate::identify::online::state::StateError;
use crate::identify::online::{Online, OnlineError};
use crate::model::{JointKind, Model};
use crate::regressor::Propagation;
use crate::setup::{BaseMotion, Setup, Use};
use crate::spatial::{Pose, Vec3, Wrench};
use learning::Learning;
use motion::{ENCODER_ZERO, Instant, MotionErrors};
use proprio_topics::{
    ContactEstimate, ContactWrench, Header, InertiaEstimate, JointTorque, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES,
    NO_CAUSE, NO_CONTACT, Nanos, Quality, Reading, Reason, Residual, TorqueEstimate,
};
use std::collections::VecDeque;
use watch::Watch;

/// The most instants that wait at one time; beyond it the oldest is released at once.
const MOST_WAITING: usize = 256;
/// How many declarations of a contact are remembered: what may come while an instant waits.
const DECLARATIONS: usize = 16;

/// The torques and contact wrenches of one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// The instant.
    pub t: Nanos,
    /// The torques; only `acquired` of the header is set.
    pub torques: TorqueEstimate,
    /// The contacts; likewise.
    pub contacts: ContactEstimate,
}

impl Estimate {
    /// Nothing estimated, at `t`.
    #[must_use]
    pub fn absent(t: Nanos) -> Self {
        let header = Header {
            acquired: t,
            ..Header::default()
        };
        Self {
            t,
            torques: TorqueEstimate {
                header,
                count: 0,
                reserved: 0,
                joints: [JointTorque::ABSENT; MAX_JOINTS],
            },
            contacts: ContactEstimate {
                header,
                count: 0,
                residual_count: 0,
                contacts: [ContactWrench::ABSENT; MAX_CONTACTS],
                residuals: [Residual::ABSENT; MAX_SUBTREES],
            },
        }
    }
}

/// What became of the samples.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Taken.
    pub taken: u64,
    /// Too late: dropped because their instant had been released, or taken after an instant that would have used them.
    pub late: u64,
    /// Dropped: not later than the last of their channel.
    pub backward: u64,
    /// Dropped: a number in them is not finite.
    pub not_finite: u64,
}

/// One channel: what it held, and for what is differentiated a window.
enum Track {
    /// Position, velocity, acceleration; the latter two NaN if not measured.
    Joint(History<3>, Box<Window<1>>),
    /// Force and torque; temperature of the board.
    Sensor(History<6>, History<1>),
    /// Proper acceleration, angular velocity, angular acceleration (NaN if not measured).
    Imu(History<9>, Box<Window<3>>),
}

impl Track {
    fn newest(&self) -> Option<Nanos> {
        match self {
            Self::Joint(h, _) => h.newest(),
            Self::Sensor(h, _) => h.newest(),
            Self::Imu(h, _) => h.newest(),
        }
    }
}

/// Who says when a contact is present.
#[derive(Clone, Default)]
struct Declarations {
    /// The last changes, oldest first: from when, present or not.
    said: arrayvec::ArrayVec<(Nanos, bool), DECLARATIONS>,
    /// What was said before these.
    before: Option<bool>,
}

impl Declarations {
    fn say(&mut self, t: Nanos, active: bool) {
        let place = |said: &[(Nanos, bool)]| said.iter().rposition(|(other, _)| *other <= t).map_or(0, |i| i + 1);
        let previous = place(&self.said)
            .checked_sub(1)
            .and_then(|i| self.said.get(i))
            .map_or(self.before, |(_, a)| Some(*a));
        // Whoever repeats himself says nothing new, unless somebody contradicts him from a later instant on.
        if previous == Some(active) {
            return;
        }
        if self.said.is_full() {
            self.before = Some(self.said.remove(0).1);
        }
        self.said.insert(place(&self.said), (t, active));
    }

    fn at(&self, t: Nanos) -> Option<bool> {
        self.said
            .iter()
            .rev()
            .find(|(from, _)| *from <= t)
            .map_or(self.before, |(_, active)| Some(*active))
    }
}

/// The estimator's core: no input, no output, no clock.
pub struct Pipeline {
    setup: Setup,
    tracks: Vec<Track>,
    /// What channels of the same stamps share, from one to the next.
    grid: Box<Grid>,
    /// Per channel at the present instant: what speaks against it.
    faults: Vec<Reason>,
    /// What speaks against the motion of the base, if no channel tells it.
    base_fault: Reason,
    declarations: Vec<Declarations>,
    waiting: VecDeque<Nanos>,
    newest: Nanos,
    released: Nanos,
    finished: bool,
    counts: Counts,
    kinematics: Kinematics,
    solver: Solver,
    /// What is uncertain of the parameters, carried to the estimates.
    propagation: Propagation,
    /// What is uncertain of accelerations, likewise.
    motion: Box<MotionErrors>,
    /// What readings contradict.
    watch: Watch,
    position: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    /// How far each encoder's zero may be off.
    zeros: Vec<f64>,
    readings: Vec<Wrench>,
    /// Per F/T sensor, whether its calibration wants a temperature that was not told lately.
    without_temperature: Vec<bool>,
    dependences: Dependences,
    learning: Option<Box<Learning>>,
    /// Why there is none although it was asked for.
    refusal: Option<OnlineError>,
    estimate: Box<Estimate>,
}

/// What each torque, contact and sub-tree's balance depends on; it changes only with the set of contacts present.
struct Dependences {
    active: Option<ContactSet>,
    torques: Vec<Dependence>,
    contacts: Vec<Dependence>,
    subtrees: Vec<Dependence>,
}

impl Dependences {
    /// Brings them to the contacts in `active`.
    fn update(&mut self, structure: &Structure, kinematics: &Kinematics, active: &ContactSet) {
        if self.active.replace(*active) == Some(*active) {
            return;
        }
        for (dof, place) in self.torques.iter_mut().enumerate() {
            *place = structure.torque_dependence(dof, kinematics, active).unwrap_or_default();
        }
        for (contact, place) in self.contacts.iter_mut().enumerate() {
            *place = structure
                .contact_dependence(contact, kinematics, active)
                .unwrap_or_default();
        }
        for (number, place) in self.subtrees.iter_mut().enumerate() {
            *place = structure.subtree_dependence(number, kinematics, active);
        }
    }
}

impl Pipeline {
    /// Ready for samples.
    ///
    /// # Panics
    /// Not with a [`Setup`] that was built by its own constructors: they check what could fail here.
    #[must_use]
    #[allow(clippy::expect_used, reason = "the setup was checked when it was built")]
    pub fn new(setup: Setup) -> Self {
        let tracks = setup.channels().iter().map(|c| match c.role {
            Use::Joint(_) => Track::Joint(
                History::default(),
                Box::new(Window::new(setup.joint_settings).expect("settings were checked")),
            ),
            Use::Sensor(_) => Track::Sensor(History::default(), History::default()),
            Use::Base => Track::Imu(
                History::default(),
                Box::new(Window::new(setup.gyro_settings).expect("settings were checked")),
            ),
        });
        let kinematics = Kinematics::new(&setup.model, setup.base_link).expect("the base is a link of the model");
        let (dofs, contacts) = (setup.model.dof_count(), setup.structure.contacts().len());
        let motion = MotionErrors::new(&setup.model, &setup.structure, setup.base_link);
        let mut estimate = Box::new(Estimate::absent(Nanos::ZERO));
        estimate.torques.count = u32::try_from(dofs).unwrap_or(0);
        estimate.contacts.count = u32::try_from(setup.contacts.len()).unwrap_or(0);
        estimate.contacts.residual_count = u32::try_from(setup.subtree_names().count()).unwrap_or(0);
        let mut propagation =
            Propagation::new(&setup.structure, &setup.covariance).expect("the covariance is of the model");
        let (learning, refusal) = match setup.identifies.then(|| Learning::new(&setup)).transpose() {
            Ok(learning) => (learning.map(Box::new), None),
            Err(error) => (None, Some(error)),
        };
        let mut learning = learning;
        if let Some(learning) = &mut learning {
            learning.begin(&mut propagation);
        }
        Self {
            tracks: tracks.collect(),
            grid: Box::default(),
            faults: vec![Reason::NeverSeen; setup.channels().len()],
            base_fault: Reason::None,
            declarations: vec![Declarations::default(); setup.contacts.len()],
            waiting: VecDeque::with_capacity(MOST_WAITING),
            newest: Nanos::MIN,
            released: Nanos::MIN,
            finished: false,
            counts: Counts::default(),
            kinematics,
            solver: Solver::new(&setup.structure),
            propagation,
            motion: Box::new(motion.expect("the base is a link of the model")),
            watch: Watch::new(&setup.structure),
            position: setup.locked.iter().map(|q| if q.is_nan() { 0.0 } else { *q }).collect(),
            velocity: vec![0.0; dofs],
            acceleration: vec![0.0; dofs],
            zeros: zeros(&setup.model),
            readings: vec![Wrench::zero(); setup.structure.sensors().len()],
            without_temperature: vec![false; setup.structure.sensors().len()],
            dependences: Dependences {
                active: None,
                torques: vec![Dependence::default(); dofs],
                contacts: vec![Dependence::default(); contacts],
                subtrees: vec![Dependence::default(); setup.structure.subtrees().len()],
            },
            learning,
            refusal,
            estimate,
            setup,
        }
    }

    /// On-line identification, if it is on.
    #[must_use]
    pub fn identification(&self) -> Option<&Online> {
        self.learning.as_ref().map(|learning| &learning.online)
    }

    /// Why nothing is identified on-line although the configuration wants it.
    #[must_use]
    pub fn identification_refused(&self) -> Option<&OnlineError> {
        self.refusal.as_ref()
    }

    /// Goes on with what an earlier run had identified ([`Job::state`]), before the first sample. Nothing happens where nothing is identified.
    ///
    /// # Errors
    /// The state is damaged, or another robot's; then nothing is changed.
    pub fn resume(&mut self, state: &str) -> Result<(), StateError> {
        let Some(learning) = &mut self.learning else {
            return Ok(());
        };
        learning.resume(state, &mut self.setup, &mut self.propagation)
    }

    /// What identification has to compute, about once a second of stamps: run it and [`Pipeline::give_back`]. Ask after each estimate. If it is back before a
    /// second of stamps has passed, estimates depend on samples alone; else they use it later, which is counted.
    pub fn take_job(&mut self) -> Option<Job> {
        self.learning.as_mut()?.take_job()
    }

    /// What is identified on-line, once after each change of what is in force: about once a second, and where an earlier run's state was resumed. Ask after each
    /// estimate, which is the first that rests on it. Only `acquired` of the header is set.
    pub fn inertia(&mut self) -> Option<&InertiaEstimate> {
        self.learning.as_mut()?.inertia()
    }

    /// Gives back a job that was run.
    pub fn give_back(&mut self, job: Job) {
        if let Some(learning) = &mut self.learning {
            learning.give_back(job);
        }
    }

    /// What it works with.
    #[must_use]
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// What became of the samples so far.
    #[must_use]
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// The F/T sensors whose readings can not be corrected for the temperature of their boards as they should be, at the last estimate: none was told, or the last more than a minute before.
    pub fn without_temperature(&self) -> impl Iterator<Item = &str> {
        let channels = self.setup.channels().iter();
        channels.filter_map(|channel| match channel.role {
            Use::Sensor(number) if self.without_temperature.get(number) == Some(&true) => Some(channel.name.as_str()),
            _ => None,
        })
    }

    /// Takes a sample of channel number `channel` (see [`Setup::channel`]), acquired at `t`. Of an F/T sensor the temperature of
    /// its board is taken, too, where its calibration depends on it and the board does not distrust it; other readings that are not the channel's main one are ignored. Call [`Pipeline::poll`] until it gives nothing before the next.
    pub fn push(&mut self, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        let Some(track) = self.tracks.get_mut(channel) else {
            return;
        };
        let newest = track.newest().unwrap_or(Nanos::MIN);
        let all_finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        let finite_or_absent = |values: &[f64]| values.iter().all(|v| !v.is_infinite());
        // First whether it may be taken, then the window, then the history.
        let (mut late, mut backward) = (false, false);
        let mut admit = |whole: bool| {
            late = whole && t <= self.released;
            backward = whole && !late && t <= newest;
            whole && !late && !backward
        };
        let whole = match (track, reading) {
            (Track::Joint(history, window), Reading::Joint(j)) => {
                let whole = j.position.is_finite() && finite_or_absent(&[j.velocity, j.acceleration]);
                if j.position.is_nan() {
                    // A row with a torque alone, say: nothing to differentiate.
                    return;
                }
                if admit(whole) {
                    // What an encoder says of itself that it can not be trusted is told on, but not differentiated.
                    if quality_reason(quality, UNTRUSTED_ENCODER) == Reason::None {
                        let _ = window.push(t, [j.position]);
                    } else {
                        window.interrupt();
                    }
                    history.push(t, [j.position, j.velocity, j.acceleration], quality);
                }
                whole
            }
            (Track::Sensor(_, temperatures), Reading::Temperature(temperature)) => {
                if !self.setup.depends_on_temperature(channel) || quality.intersects(Quality::DEVICE_FAULT) {
                    return;
                }
                let late = t < self.released.saturating_sub(Nanos(self.setup.max_wait.0 / 2));
                match temperature.celsius.is_finite() {
                    false => self.counts.not_finite += 1,
                    true if temperatures.newest().is_some_and(|newest| t <= newest) => self.counts.backward += 1,
                    true => {
                        temperatures.push(t, [temperature.celsius], quality);
                        self.counts.taken += 1;
                        // Taken, but an instant was told without it that a replay tells with it.
                        self.counts.late += u64::from(late);
                    }
                }
                return;
            }
            (Track::Sensor(history, _), Reading::Wrench(w)) => {
                let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
                let value = [fx, fy, fz, tx, ty, tz];
                let whole = all_finite(&value);
                if admit(whole) {
                    history.push(t, value, quality);
                }
                whole
            }
            (Track::Imu(history, window), Reading::Imu(i)) => {
                let whole = all_finite(&i.proper_acceleration)
                    && all_finite(&i.angular_velocity)
                    && finite_or_absent(&i.angular_acceleration);
                if admit(whole) {
                    if quality_reason(quality, Quality::DEVICE_FAULT) == Reason::None {
                        let _ = window.push(t, i.angular_velocity);
                    } else {
                        window.interrupt();
                    }
                    let ([ax, ay, az], [gx, gy, gz], [bx, by, bz]) =
                        (i.proper_acceleration, i.angular_velocity, i.angular_acceleration);
                    history.push(t, [ax, ay, az, gx, gy, gz, bx, by, bz], quality);
                }
                whole
            }
            _ => return,
        };
        self.counts.not_finite += u64::from(!whole);
        self.counts.late += u64::from(late);
        self.counts.backward += u64::from(backward);
        if !whole || late || backward {
            return;
        }
        self.counts.taken += 1;
        // Taken, but an instant was told without it that a replay tells with it.
        let until = self.released.saturating_add(Nanos(self.setup.max_wait.0 / 2));
        self.counts.late += u64::from(newest > Nanos::MIN && newest < self.released && t <= until);
        self.newest = self.newest.max(t);
        if channel == self.setup.trigger {
            if self.waiting.len() < MOST_WAITING {
                self.waiting.push_back(t);
            } else {
                self.counts.late += 1;
            }
        }
    }

    /// Says that contact number `contact` (see [`Setup::contact`]) is present, or not, from `t` on.
    pub fn declare(&mut self, contact: usize, t: Nanos, active: bool) {
        if let Some(declarations) = self.declarations.get_mut(contact) {
            // For instants that are already told it comes too late; from the next one on it holds.
            self.counts.late += u64::from(t <= self.released);
            declarations.say(t, active);
        }
    }

    /// No sample will come any more: what still waits is released.
    pub fn finish(&mut self) {
        self.finished = true;
    }

    /// The next estimate, if one can be made now.
    pub fn poll(&mut self) -> Option<&Estimate> {
        let t = *self.waiting.front()?;
        let passed = || {
            self.tracks
                .iter()
                .all(|track| track.newest().is_some_and(|newest| newest >= t))
        };
        let waited = self.newest > t + self.setup.max_wait;
        if !(self.finished || waited || self.waiting.len() == MOST_WAITING || passed()) {
            return None;
        }
        self.waiting.pop_front();
        self.released = t;
        self.learn(t);
        self.compute(t);
        Some(&self.estimate)
    }

    /// Identification's turn.
    fn learn(&mut self, t: Nanos) {
        let Some(mut learning) = self.learning.take() else {
            return;
        };
        if let Some(instant) = learning.instant(t) {
            let active = self.active(instant);
            let base = self.standing(&active);
            learning.observe(instant, &self.setup, &self.tracks, &active, base);
            if learning.apply(&mut self.setup, &mut self.propagation) {
                self.watch.begin_anew();
            }
        }
        self.learning = Some(learning);
    }

    /// The link where kinematics start, how it moves if no IMU tells, and what speaks against that.
    fn standing(&self, active: &ContactSet) -> (usize, FrameMotion, Reason) {
        let stances = match &self.setup.base {
            BaseMotion::Standing(motion) => return (self.setup.base_link, *motion, Reason::None),
            BaseMotion::Imu(_) => {
                return (
                    self.setup.base_link,
                    FrameMotion::standing(&Vec3::zeros()),
                    Reason::None,
                );
            }
            BaseMotion::Stance(stances) => stances,
        };
        let standing = stances.iter().find(|stance| active.contains(stance.contact));
        let fault = if standing.is_none() {
            Reason::NoStance
        } else {
            Reason::None
        };
        standing.or(stances.first()).map_or_else(
            || {
                (
                    self.setup.base_link,
                    FrameMotion::standing(&Vec3::zeros()),
                    Reason::NoStance,
                )
            },
            |stance| (stance.link, stance.motion, fault),
        )
    }

    /// The contacts present at `t`.
    fn active(&self, t: Nanos) -> ContactSet {
        let mut active = self.setup.always;
        for (contact, declarations) in self.declarations.iter().enumerate() {
            match declarations.at(t) {
                Some(true) => active.insert(contact),
                Some(false) if self.setup.support != Some(contact) => active.remove(contact),
                Some(false) => {}
                None => {}
            }
        }
        active
    }

    /// Starts kinematics at the link that stands still, if it is not an IMU that tells, and says how it moves: not at all.
    fn base_standing(&mut self, active: &ContactSet) -> FrameMotion {
        let (link, motion, fault) = self.standing(active);
        self.base_fault = fault;
        if link != self.kinematics.base() && self.kinematics.set_base(&self.setup.model, link).is_err() {
            self.base_fault = Reason::NotFinite;
        }
        motion
    }

    /// Brings every channel to `t` and estimates.
    fn compute(&mut self, t: Nanos) {
        // Half of the wait, so that a sample which counts can be as late as the other half and still be there.
        let until = t + Nanos(self.setup.max_wait.0 / 2);
        let active = self.active(t);
        let mut base = self.base_standing(&active);
        let mut imu = None;
        for ((track, channel), fault) in self.tracks.iter().zip(self.setup.channels()).zip(&mut self.faults) {
            *fault = match (track, channel.role) {
                (Track::Joint(history, window), Use::Joint(dof)) => match history.at(t, until) {
                    None => Reason::NeverSeen,
                    Some(held) => {
                        let (state, deviation, reason) =
                            joint_at(t, until, &held, (window, &mut self.grid), self.setup.max_silence);
                        let [noise] = window.noise(t);
                        let zero = self.zeros.get(dof).copied().unwrap_or(0.0);
                        self.motion.set_joint(dof, deviation, zero.hypot(noise));
                        let places = (
                            self.position.get_mut(dof),
                            self.velocity.get_mut(dof),
                            self.acceleration.get_mut(dof),
                        );
                        if let (Some(q), Some(dq), Some(ddq)) = places {
                            [*q, *dq, *ddq] = state;
                        }
                        quality_reason(held.quality, UNTRUSTED_ENCODER).or(reason)
                    }
                },
                (Track::Sensor(history, temperatures), Use::Sensor(number)) => match history.at(t, until) {
                    None => Reason::NeverSeen,
                    Some(held) => {
                        let [fx, fy, fz, tx, ty, tz] = held.value;
                        if let (Some(place), Some(offset), Some(calibration)) = (
                            self.readings.get_mut(number),
                            self.setup.offsets.get(number),
                            self.setup.calibrations.get(number),
                        ) {
                            let (celsius, age) = temperature_at(temperatures, t, self.setup.max_wait);
                            let unknown = calibration.temperature_variance(age);
                            if let Some(place) = self.without_temperature.get_mut(number) {
                                *place = unknown != [0.0; 6];
                            }
                            let excess = self.setup.excess.get(number).copied().unwrap_or_default();
                            let widened = std::array::from_fn(|i| unknown[i] + excess[i]);
                            self.propagation.set_widened(number, widened);
                            let corrected = calibration.apply(&Wrench::from_parts([fx, fy, fz], [tx, ty, tz]), celsius);
                            self.propagation
                                .set_reading(number, &corrected, calibration.warmth(celsius));
                            *place = corrected - *offset;
                        }
                        stale(&held, self.setup.max_silence).or(quality_reason(held.quality, Quality::DEVICE_FAULT))
                    }
                },
                (Track::Imu(history, window), Use::Base) => match history.at(t, until) {
                    None => Reason::NeverSeen,
                    Some(held) => {
                        let (measured, deviation, reason) =
                            imu_at(t, until, &held, (window, &mut self.grid), self.setup.max_silence);
                        if let BaseMotion::Imu(pose) = &self.setup.base {
                            base = FrameMotion::of_link_from_imu(&measured, pose);
                            imu = Some((measured, *pose));
                        }
                        self.motion.set_angular(&deviation);
                        quality_reason(held.quality, Quality::DEVICE_FAULT).or(reason)
                    }
                },
                // Tracks were made from the channels' roles.
                _ => Reason::NeverSeen,
            };
        }
        // What was detected at the last instant most likely is still there.
        let detected = self.watch.detected().difference(&active);
        let mut solved = self.solve(t, &base, imu.as_ref(), &active.union(&detected));
        self.watch(t, &active, solved);
        if solved && self.watch.detected() != detected {
            solved = self.solve(t, &base, imu.as_ref(), &active.union(&self.watch.detected()));
        }
        self.tell(t, solved);
    }

    /// Solves with these contacts present, and says how uncertain that is; whether it could.
    fn solve(&mut self, t: Nanos, base: &FrameMotion, imu: Option<&(FrameMotion, Pose)>, active: &ContactSet) -> bool {
        let Setup { model, structure, .. } = &self.setup;
        let state = JointState {
            position: &self.position,
            velocity: &self.velocity,
            acceleration: &self.acceleration,
        };
        self.dependences.update(structure, &self.kinematics, active);
        self.kinematics
            .update(model, state, base)
            .and_then(|()| {
                self.solver
                    .solve(model, structure, &self.kinematics, &self.readings, active, &[])
            })
            .and_then(|()| self.solver.update_deviations(structure))
            .and_then(|()| self.propagation.update(structure, &self.solver, &self.kinematics, t))
            .and_then(|()| {
                self.motion.update(&Instant {
                    t,
                    model,
                    structure,
                    state,
                    base,
                    imu: imu.map(|(measured, pose)| (measured, pose)),
                    readings: &self.readings,
                    active,
                    solver: &self.solver,
                    base_link: self.kinematics.base(),
                })
            })
            .is_ok()
    }

    /// Looks for what contradicts the solution, when the contacts in `declared` are known to be present.
    fn watch(&mut self, t: Nanos, declared: &ContactSet, solved: bool) {
        if !solved {
            return self.watch.forget();
        }
        let judge = Judge {
            channels: self.setup.channels(),
            faults: &self.faults,
            base_fault: self.base_fault,
        };
        let instant = watch::Instant {
            t,
            structure: &self.setup.structure,
            kinematics: &self.kinematics,
            solver: &self.solver,
            declared,
        };
        let covariance = |number: usize| {
            let dependence = self.dependences.subtrees.get(number)?;
            let (reason, _) = judge.verdict(dependence);
            let learnt = self.propagation.imbalances().get(number)?;
            (reason == Reason::None).then(|| learnt + self.motion.imbalance(number))
        };
        self.watch.update(&instant, covariance);
    }

    /// Writes the estimate: numbers, validity, reasons.
    fn tell(&mut self, t: Nanos, solved: bool) {
        self.estimate.t = t;
        self.estimate.torques.header.acquired = t;
        self.estimate.contacts.header.acquired = t;
        let judge = Judge {
            channels: self.setup.channels(),
            faults: &self.faults,
            base_fault: self.base_fault,
        };
        let results = self
            .solver
            .torque()
            .iter()
            .zip(self.solver.torque_deviation())
            .zip(self.propagation.torque())
            .zip(self.solver.torque_certainty())
            .zip(self.motion.torques());
        let structure = &self.setup.structure;
        let is_unexplained = |link: usize| {
            let seen = structure
                .subtree_of(link)
                .and_then(|number| self.watch.seen().nth(number));
            seen.is_some_and(|seen| seen.is_unexplained)
        };
        let unexplained = |dof: usize| structure.link_of(dof).is_some_and(is_unexplained);
        let detected = self.watch.detected();
        let places = self.estimate.torques.joints.iter_mut().zip(&self.dependences.torques);
        for (dof, ((place, dependence), ((((torque, noise), model), certainty), motion))) in
            places.zip(results).enumerate()
        {
            let (mut reason, mut cause) = judge.verdict(dependence);
            let deviation = noise.hypot(*model).hypot(*motion);
            if reason == Reason::None && *certainty == Certainty::Assumed {
                reason = Reason::Undetermined;
            }
            if reason == Reason::None && unexplained(dof) {
                reason = Reason::Unexplained;
            }
            if reason == Reason::None && self.setup.max_deviation.get(dof).is_some_and(|most| deviation > *most) {
                reason = Reason::Uncertain;
            }
            if !solved || !torque.is_finite() || !deviation.is_finite() {
                (reason, cause) = (Reason::NotFinite, NO_CAUSE);
            }
            // A number that rests on a channel nobody has seen is no number.
            let known = solved && reason != Reason::NeverSeen;
            *place = JointTorque {
                torque: if known { *torque } else { f64::NAN },
                standard_deviation: if known { deviation } else { f64::NAN },
                valid: u32::from(reason == Reason::None),
                reason,
                cause,
                reserved: 0,
            };
        }
        let places = self
            .estimate
            .contacts
            .contacts
            .iter_mut()
            .zip(&self.dependences.contacts);
        let results = self.solver.contacts().iter().zip(self.propagation.contacts());
        let results = results.zip(self.motion.contacts());
        let contacts = places.zip(results).take(self.setup.contacts.len());
        for (number, ((place, dependence), ((result, model), motion))) in contacts.enumerate() {
            let (mut reason, mut cause) = judge.verdict(dependence);
            let link = structure.contacts().get(number).map(|spec| spec.frame.link);
            if reason == Reason::None && link.is_some_and(is_unexplained) {
                reason = Reason::Unexplained;
            }
            match result.certainty {
                Certainty::Absent => (reason, cause) = (Reason::Absent, NO_CAUSE),
                Certainty::Assumed if reason == Reason::None => reason = Reason::Undetermined,
                _ => {}
            }
            if !solved || !result.wrench.is_finite() {
                (reason, cause) = (Reason::NotFinite, NO_CAUSE);
            }
            let known = solved && reason != Reason::NeverSeen;
            let [fx, fy, fz, tx, ty, tz] = if known {
                result.wrench.force_first()
            } else {
                [f64::NAN; 6]
            };
            *place = ContactWrench {
                force: [fx, fy, fz],
                torque: [tx, ty, tz],
                standard_deviation: std::array::from_fn(|i| {
                    if known {
                        let motion = motion.get(i).copied().unwrap_or(0.0);
                        result.deviation[i].hypot(model[i]).hypot(motion)
                    } else {
                        f64::NAN
                    }
                }),
                valid: u32::from(reason == Reason::None),
                reason,
                cause,
                detected: u32::from(detected.contains(number)),
            };
        }
        let places = self.estimate.contacts.residuals.iter_mut();
        for (place, seen) in places.zip(self.watch.seen()) {
            let [fx, fy, fz, tx, ty, tz] = seen.residual.force_first();
            *place = Residual {
                force: [fx, fy, fz],
                torque: [tx, ty, tz],
                significance: seen.significance,
                contact: seen
                    .contact
                    .and_then(|contact| u32::try_from(contact).ok())
                    .unwrap_or(NO_CONTACT),
                unexplained: u32::from(seen.is_unexplained),
            };
        }
    }
}

/// How far each joint's zero may be off.
fn zeros(model: &Model) -> Vec<f64> {
    let of_dof = |dof: usize| {
        let kind = model
            .joints()
            .iter()
            .find(|joint| joint.dof == Some(dof))
            .map(|joint| &joint.kind);
        ENCODER_ZERO[usize::from(matches!(kind, Some(JointKind::Prismatic(_))))]
    };
    (0..model.dof_count()).map(of_dof).collect()
}

/// Finds what speaks against a value: the first channel it depends on that is at fault.
struct Judge<'a> {
    channels: &'a [crate::setup::Channel],
    faults: &'a [Reason],
    base_fault: Reason,
}

impl Judge<'_> {
    fn verdict(&self, dependence: &Dependence) -> (Reason, u32) {
        let needed = |role: Use| match role {
            Use::Joint(dof) => dependence.dofs.contains(dof),
            Use::Sensor(number) => dependence.sensors.contains(number),
            Use::Base => dependence.base,
        };
        // What was never seen comes first: then there is not even a number.
        let mut found = (Reason::None, NO_CAUSE);
        for ((channel, fault), number) in self.channels.iter().zip(self.faults).zip(0..) {
            if *fault == Reason::None || !needed(channel.role) {
                continue;
            }
            if *fault == Reason::NeverSeen {
                return (*fault, number);
            }
            if found.0 == Reason::None {
                found = (*fault, number);
            }
        }
        if found.0 == Reason::None && dependence.base {
            found.0 = self.base_fault;
        }
        found
    }
}

trait OrReason {
    /// This reason, or `other` if there is none.
    fn or(self, other: Self) -> Self;
}

impl OrReason for Reason {
    fn or(self, other: Self) -> Self {
        if self == Self::None { other } else { self }
    }
}

/// What disqualifies a joint's position: one that is not calibrated tells no position.
pub(crate) const UNTRUSTED_ENCODER: Quality = Quality(Quality::DEVICE_FAULT.0 | Quality::NOT_CALIBRATED.0);

/// What a quality says against a value, given which faults disqualify it.
pub(crate) fn quality_reason(quality: Quality, faults: Quality) -> Reason {
    if quality.intersects(Quality::SATURATED | Quality::FROZEN) {
        Reason::Saturated
    } else if quality.intersects(faults) {
        Reason::DeviceFault
    } else {
        Reason::None
    }
}

/// The temperature of a sensor's board at `t` \[degrees Celsius\], and how long ago it was told: the last one stamped before `t` less half of what an estimate waits, however old; NaN if there is none. So old that
/// whatever counts has come when `t` is released, though nobody waits for it.
fn temperature_at(temperatures: &History<1>, t: Nanos, max_wait: Nanos) -> (f64, Option<Nanos>) {
    let before = t.saturating_sub(Nanos(max_wait.0 / 2 + 1));
    let held = temperatures.at(before, before);
    held.map_or((f64::NAN, None), |held| (held.value[0], Some(held.age)))
}

fn stale<const D: usize>(held: &Held<D>, max_silence: Nanos) -> Reason {
    // Between two samples that are too far apart it was silent too long all the same.
    if held.age > max_silence {
        Reason::Stale
    } else {
        Reason::None
    }
}

/// Position, velocity and acceleration of a joint at `t`, the standard deviation of the last, and what speaks against them.
fn joint_at(
    t: Nanos,
    until: Nanos,
    held: &Held<3>,
    (window, grid): (&Window<1>, &mut Grid),
    max_silence: Nanos,
) -> ([f64; 3], f64, Reason) {
    let [position, velocity, acceleration] = held.value;
    if held.exact && velocity.is_finite() && acceleration.is_finite() {
        return ([position, velocity, acceleration], 0.0, Reason::None);
    }
    // A channel stamped exactly t needs no later sample.
    let until = if held.exact { t } else { until };
    match window.at_sharing(t, until, grid) {
        Ok(estimate) => {
            let ([value], [first], [second]) = (estimate.value, estimate.first, estimate.second);
            let given = |measured: f64, estimated: f64| {
                if held.exact && measured.is_finite() {
                    measured
                } else {
                    estimated
                }
            };
            let deviation = if given(acceleration, f64::NAN).is_nan() {
                uncertainty(estimate.second_std[0])
            } else {
                0.0
            };
            (
                [
                    given(position, value),
                    given(velocity, first),
                    given(acceleration, second),
                ],
                deviation,
                stale(held, max_silence),
            )
        }
        Err(unavailable) => ([position, 0.0, 0.0], 0.0, why(unavailable, held, max_silence)),
    }
}

/// A standard deviation that can be reckoned with.
fn uncertainty(deviation: f64) -> f64 {
    if deviation.is_finite() { deviation } else { 0.0 }
}

/// Motion of the IMU at `t`, standard deviations of its angular acceleration, and what speaks against it.
fn imu_at(
    t: Nanos,
    until: Nanos,
    held: &Held<9>,
    (window, grid): (&Window<3>, &mut Grid),
    max_silence: Nanos,
) -> (FrameMotion, [f64; 3], Reason) {
    let [ax, ay, az, gx, gy, gz, bx, by, bz] = held.value;
    let mut motion = FrameMotion {
        angular_velocity: Vec3::new(gx, gy, gz),
        angular_acceleration: Vec3::new(bx, by, bz),
        proper_acceleration: Vec3::new(ax, ay, az),
    };
    if held.exact && motion.angular_acceleration.iter().all(|x| x.is_finite()) {
        return (motion, [0.0; 3], Reason::None);
    }
    let until = if held.exact { t } else { until };
    match window.at_sharing(t, until, grid) {
        Ok(estimate) => {
            if !held.exact {
                motion.angular_velocity = Vec3::from(estimate.value);
            }
            motion.angular_acceleration = Vec3::from(estimate.first);
            (motion, estimate.first_std.map(uncertainty), stale(held, max_silence))
        }
        Err(unavailable) => {
            motion.angular_acceleration = Vec3::zeros();
            (motion, [0.0; 3], why(unavailable, held, max_silence))
        }
    }
}

fn why<const D: usize>(unavailable: Unavailable, held: &Held<D>, max_silence: Nanos) -> Reason {
    match (stale(held, max_silence), unavailable) {
        (Reason::Stale, _) | (_, Unavailable::Stale { .. }) => Reason::Stale,
        (_, Unavailable::Overflow) => Reason::NotFinite,
        _ => Reason::Starting,
    }
}
