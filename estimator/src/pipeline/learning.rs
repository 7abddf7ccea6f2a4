//! Identification inside the pipeline: every channel brought to an instant in the past, where samples lie on both sides of it, and handed to
//! [`Online`]; its solutions put in force.
//!
//! Torques want the newest instant; parameters do not care when they were learnt, but do about accelerations. So an identification instant lies [`DELAY`] behind the
//! estimate that calls for it, and positions are differentiated by polynomials centred on it ([`Centred`]). F/T readings are averaged over the instant's share of time.
//!
//! A share is a cell of a grid of `period`; at most one estimate in each calls for an instant. So instants depend on stamps alone, as estimates do.

use proprio_topics::{InertiaEstimate, LinkInertia, Name, Nanos, Quality, Reason, SensorOffset};

use super::{OrReason, Track, UNTRUSTED_ENCODER, quality_reason, temperature_at};
use crate::dynamics::{ContactSet, DofSet, FrameMotion, JointState, Kinematics};
use crate::history::{History, KEPT};
use crate::identify::online::state::{Measuring, StateError};
use crate::identify::online::{Job as Solving, Observation, Online, OnlineError, Solution};
use crate::identify::prior::PriorError;
use crate::regressor::{Covariance, Propagation};
use crate::setup::{BaseMotion, Learnt, Setup, Use, set_noise};
use crate::spatial::{RigidInertia, Vec3, Wrench};

/// How far behind an estimate an identification instant lies, and how far the samples reach that it is differentiated from.
pub(super) const DELAY: Nanos = Nanos::from_millis(250);

/// Identification in a pipeline.
pub(super) struct Learning {
    pub(super) online: Online,
    kinematics: Kinematics,
    period: Nanos,
    /// The grid's cell of the last instant.
    cell: i64,
    /// What is held, and what is found at the present instant.
    held: Motion,
    found: Motion,
    /// What has shown of each joint's samples, then of nine numbers of the IMU.
    shown: Vec<Shown>,
    /// Likewise of each joint's position and velocity, where they are used as they are measured.
    raw: Vec<Shown>,
    readings: Vec<Wrench>,
    joints: Vec<Reason>,
    /// Joints that move at the present instant.
    moved: DofSet,
    sensors: Vec<Reason>,
    scratch: Box<Centred>,
    /// What a job needs beside its own; at home while the job is.
    room: Option<Box<Room>>,
    /// What is in force, and whether that has been told.
    inertia: Box<InertiaEstimate>,
    is_told: bool,
}

/// What a job works with beside the data, and where it puts what the pipeline wants.
struct Room {
    setup: Setup,
    propagation: Propagation,
    inertia: Box<InertiaEstimate>,
}

/// A job of the pipeline: solve, and carry the covariance to where torques can use it. [`Job::run`] it in any thread, then [`super::Pipeline::give_back`].
pub struct Job {
    solving: Box<Solving>,
    room: Box<Room>,
}

impl Job {
    /// Takes a millisecond or two for each limb by itself, a tenth of a second where all of a large robot hangs together, and allocates. What it finds depends on the samples alone.
    pub fn run(&mut self) {
        self.solving.run();
        let Room {
            setup,
            propagation,
            inertia,
        } = &mut *self.room;
        let covariance = covariance(setup, self.solving.solution());
        // Of the same structure: it can not be refused.
        if let Ok(new) = Propagation::new(&setup.structure, &covariance) {
            *propagation = new;
        }
        tell(setup, self.solving.solution(), inertia);
    }

    /// For each component why it was not solved, if it was not: what was known before stays in force.
    pub fn failures(&self) -> impl Iterator<Item = Option<&PriorError>> {
        self.solving.failures()
    }

    /// What was known when it began, as text: for [`super::Pipeline::resume`].
    #[must_use]
    pub fn state(&self) -> String {
        let setup = &self.room.setup;
        self.solving.state(&setup.robot, &measuring(setup))
    }
}

/// How the sensors measure that it learns from.
fn measuring(setup: &Setup) -> Measuring {
    Measuring::new(&setup.structure, &setup.calibrations)
}

/// What is uncertain under a solution, and of what it does not tell.
fn covariance(setup: &Setup, solution: &Solution) -> Covariance {
    let blocks = solution.components.iter().map(|component| Learnt {
        links: &component.links,
        sensors: &component.sensors,
        root: (component.root.nrows() > 0).then_some(&component.root),
        offsets: &component.offsets,
        drift: &component.drift,
        known: component.data,
    });
    setup.covariance_with(blocks)
}

/// A solution in the words of who reads it.
fn tell(setup: &Setup, solution: &Solution, told: &mut InertiaEstimate) {
    let name = |text: &str| Name::new(text).unwrap_or(Name::EMPTY);
    told.header.acquired = solution.data;
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
        for (place, (&link, body)) in component.links.iter().zip(&component.bodies).enumerate() {
            let Some(to) = told.links.get_mut(links) else { break };
            links += 1;
            *to = LinkInertia {
                name: name(setup.model.link_name(link)),
                parameters: body.parameters(),
                standard_deviation: std::array::from_fn(|i| deviation(10 * place + i)),
                motion: component.motion,
                rows: component.rows,
                group,
                accepted,
            };
        }
        for (place, (&sensor, offset)) in component.sensors.iter().zip(&component.offsets).enumerate() {
            let Some(to) = told.offsets.get_mut(offsets) else { break };
            offsets += 1;
            let channel = setup.channels().iter().find(|c| c.role == Use::Sensor(sensor));
            let six = |i: usize| deviation(parameters + 6 * place + i);
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
    (told.link_count, told.offset_count) = (count(links), count(offsets));
}

fn count(number: usize) -> u32 {
    u32::try_from(number).unwrap_or(0)
}

impl Learning {
    pub(super) fn new(setup: &Setup) -> Result<Self, OnlineError> {
        let period = setup.identification_period;
        let mut online = Online::new(
            &setup.model,
            &setup.structure,
            setup.cad(),
            &setup.offsets,
            &setup.always,
            setup.base_link,
            period,
            setup.model_deviation(),
        )?;
        if let Some(parameters) = setup.identified() {
            let links: Vec<(usize, RigidInertia)> = parameters
                .identified()
                .filter_map(|link| Some((link, parameters.inertia(link)?)))
                .collect();
            let root = parameters.root();
            let of_links = root.columns(0, 10 * links.len()).into_owned();
            online.begin_with(setup.cad(), &links, &of_links)?;
        }
        let dofs = setup.model.dof_count();
        let held = Motion {
            position: setup.locked.iter().map(|q| if q.is_nan() { 0.0 } else { *q }).collect(),
            velocity: vec![0.0; dofs],
            acceleration: vec![0.0; dofs],
            imu: FrameMotion::standing(&Vec3::zeros()),
            errors: vec![0.0; 3 * dofs + 9],
        };
        let propagation = Propagation::new(&setup.structure, &covariance(setup, online.solution()))?;
        Ok(Self {
            kinematics: Kinematics::new(&setup.model, setup.base_link)?,
            period,
            cell: i64::MIN,
            found: held.clone(),
            shown: vec![Shown::default(); dofs + 9],
            raw: vec![Shown::default(); 2 * dofs],
            held,
            readings: vec![Wrench::zero(); setup.structure.sensors().len()],
            joints: vec![Reason::None; dofs],
            moved: DofSet::default(),
            sensors: vec![Reason::None; setup.structure.sensors().len()],
            scratch: Box::default(),
            room: Some(Box::new(Room {
                setup: setup.clone(),
                propagation,
                inertia: Box::default(),
            })),
            inertia: Box::default(),
            is_told: true,
            online,
        })
    }

    /// Puts the deviations of before the first solution in force.
    pub(super) fn begin(&mut self, propagation: &mut Propagation) {
        if let Some(room) = &mut self.room {
            std::mem::swap(propagation, &mut room.propagation);
        }
    }

    /// The instant that an estimate at `t` calls for, if it does.
    pub(super) fn instant(&mut self, t: Nanos) -> Option<Nanos> {
        // One in each slot of its own time, not of the estimate's.
        let t = t - DELAY;
        let cell = t.0.div_euclid(self.period.0);
        (cell != std::mem::replace(&mut self.cell, cell)).then_some(t)
    }

    /// Observes instant `t`. `base` is how its link moves, if that does not come from an IMU, and what speaks against it.
    pub(super) fn observe(
        &mut self,
        t: Nanos,
        setup: &Setup,
        tracks: &[Track],
        active: &ContactSet,
        (base_link, mut base, mut base_fault): (usize, FrameMotion, Reason),
    ) {
        let (from, to) = (t - DELAY, t + DELAY);
        let mut is_base_moved = false;
        self.moved = DofSet::default();
        self.found.copy_from(&self.held);
        for (track, channel) in tracks.iter().zip(setup.channels()) {
            match (track, channel.role) {
                (Track::Joint(history, window), Use::Joint(dof)) => {
                    let places = (
                        self.found.position.get_mut(dof),
                        self.found.velocity.get_mut(dof),
                        self.found.acceleration.get_mut(dof),
                        self.joints.get_mut(dof),
                    );
                    let (Some(q), Some(dq), Some(ddq), Some(fault)) = places else {
                        continue;
                    };
                    // Measured velocities and accelerations are used, and what is not measured is made of the highest that is.
                    let gathered = self
                        .scratch
                        .gather(history, from, to, setup.max_silence, UNTRUSTED_ENCODER);
                    *fault = gathered.err().unwrap_or(Reason::None);
                    let highest = (0..3).rev().find(|&order| self.scratch.is_complete(order)).unwrap_or(0);
                    let Some(shown) = self.shown.get_mut(dof) else { continue };
                    // Of positions the noise in motion is known, too.
                    let [sigma] = if highest == 0 { window.noise(to) } else { [f64::NAN] };
                    let fit = self.scratch.fit(highest, t, shown, (sigma, 2));
                    let mut raw = self.raw.iter_mut().skip(2 * dof);
                    let mut exact = |order: usize| {
                        let deviation = raw.next().map_or(0.0, |shown| self.scratch.deviation(order, t, shown));
                        (self.scratch.value(order, t), deviation)
                    };
                    let values = match highest {
                        0 => fit,
                        1 => [exact(0), fit[0], fit[1]],
                        _ => [exact(0), exact(1), fit[0]],
                    };
                    let errors = self.found.errors.chunks_exact_mut(3).nth(dof).unwrap_or_default();
                    for ((place, (value, error)), old) in [&mut *q, dq, ddq].into_iter().zip(values).zip(errors) {
                        if differs((*place, *old), (value, error)) {
                            self.moved.insert(dof);
                        }
                        (*place, *old) = (value, error);
                    }
                    if !(q.is_finite() && dq.is_finite() && ddq.is_finite()) {
                        [*q, *dq, *ddq] = [0.0; 3];
                        *fault = (*fault).or(Reason::NotFinite);
                    }
                }
                (Track::Sensor(history, temperatures), Use::Sensor(number)) => {
                    let (Some(reading), Some(fault)) = (self.readings.get_mut(number), self.sensors.get_mut(number))
                    else {
                        continue;
                    };
                    let (mean, reason) = mean_reading(history, t, self.period, setup.max_silence);
                    let (celsius, _) = temperature_at(temperatures, t, setup.max_wait);
                    let calibration = setup.calibrations.get(number);
                    *reading = calibration.map_or(mean, |calibration| calibration.apply(&mean, celsius));
                    *fault = reason;
                }
                (Track::Imu(history, window), Use::Base) => {
                    let gathered = self
                        .scratch
                        .gather(history, from, to, setup.max_silence, Quality::DEVICE_FAULT);
                    base_fault = gathered.err().unwrap_or(Reason::None);
                    let measured = &mut self.found.imu;
                    let first = self.shown.len().saturating_sub(9);
                    let sigma = window.noise(to);
                    for (axis, sigma) in sigma.into_iter().enumerate() {
                        // Places of their own: angular acceleration may come and go.
                        let mut none = [Shown::default(); 3];
                        let own = self.shown.get_mut(first + 3 * axis..first + 3 * axis + 3);
                        let [of_rate, of_angular, of_linear]: &mut [Shown; 3] =
                            own.and_then(|own| own.try_into().ok()).unwrap_or(&mut none);
                        let gyro = self.scratch.fit(3 + axis, t, of_rate, (sigma, 1));
                        let alpha = if self.scratch.is_complete(6 + axis) {
                            self.scratch.fit(6 + axis, t, of_angular, (f64::NAN, 0))[0]
                        } else {
                            gyro[1]
                        };
                        let acceleration = self.scratch.fit(axis, t, of_linear, (f64::NAN, 0))[0];
                        let errors = self.found.errors.iter_mut().rev().skip(3 * axis);
                        for ((place, (value, error)), old) in [
                            (&mut measured.proper_acceleration[axis], acceleration),
                            (&mut measured.angular_velocity[axis], gyro[0]),
                            (&mut measured.angular_acceleration[axis], alpha),
                        ]
                        .into_iter()
                        .zip(errors)
                        {
                            is_base_moved |= differs((*place, *old), (value, error));
                            (*place, *old) = (value, error);
                        }
                    }
                    let numbers = [
                        &measured.proper_acceleration,
                        &measured.angular_velocity,
                        &measured.angular_acceleration,
                    ];
                    if numbers.iter().any(|v| v.iter().any(|x| !x.is_finite())) {
                        base_fault = base_fault.or(Reason::NotFinite);
                        *measured = FrameMotion::standing(&Vec3::zeros());
                    }
                }
                _ => {}
            }
        }
        if is_base_moved || !self.moved.is_empty() {
            self.held.copy_from(&self.found);
        }
        if let BaseMotion::Imu(pose) = &setup.base {
            base = FrameMotion::of_link_from_imu(&self.held.imu, pose);
        }
        if base_link != self.kinematics.base() && self.kinematics.set_base(&setup.model, base_link).is_err() {
            return;
        }
        let state = JointState {
            position: &self.held.position,
            velocity: &self.held.velocity,
            acceleration: &self.held.acceleration,
        };
        if self.kinematics.update(&setup.model, state, &base).is_err() {
            return;
        }
        // Sizes are those of the setup, numbers were looked at.
        let _ = self.online.observe(&Observation {
            t,
            kinematics: &self.kinematics,
            readings: &self.readings,
            active,
            base: base_fault,
            joints: &self.joints,
            moved: &self.moved,
            is_base_moved,
            sensors: &self.sensors,
        });
    }

    /// Puts a solution in force whose stamp has come.
    pub(super) fn apply(&mut self, setup: &mut Setup, propagation: &mut Propagation) -> bool {
        // Where the job is, the room is.
        if !self.online.apply() {
            return false;
        }
        self.enforce(setup, propagation);
        true
    }

    /// Goes on from an earlier state.
    pub(super) fn resume(
        &mut self,
        text: &str,
        setup: &mut Setup,
        propagation: &mut Propagation,
    ) -> Result<(), StateError> {
        self.online.resume(&setup.robot, &measuring(setup), text)?;
        if let Some(room) = &mut self.room
            && let Ok(new) = Propagation::new(&setup.structure, &covariance(setup, self.online.solution()))
        {
            room.propagation = new;
            tell(setup, self.online.solution(), &mut room.inertia);
        }
        self.enforce(setup, propagation);
        Ok(())
    }

    /// Puts the last solution where the pipeline reads it.
    fn enforce(&mut self, setup: &mut Setup, propagation: &mut Propagation) {
        for component in &self.online.solution().components {
            for (&link, body) in component.links.iter().zip(&component.bodies) {
                // A link of the model, and finite: it is not refused.
                let _ = setup.model.set_inertia(link, *body);
            }
            for (&sensor, offset) in component.sensors.iter().zip(&component.offsets) {
                if let Some(place) = setup.offsets.get_mut(sensor) {
                    *place = *offset;
                }
            }
            for (&sensor, found) in component.sensors.iter().zip(&component.noise) {
                set_noise(&mut setup.excess, &setup.structure, sensor, *found);
            }
        }
        if let Some(room) = &mut self.room {
            std::mem::swap(propagation, &mut room.propagation);
            std::mem::swap(&mut self.inertia, &mut room.inertia);
            self.is_told = false;
        }
    }

    /// What is in force, if it has not been told yet.
    pub(super) fn inertia(&mut self) -> Option<&InertiaEstimate> {
        (!std::mem::replace(&mut self.is_told, true)).then_some(&*self.inertia)
    }

    pub(super) fn take_job(&mut self) -> Option<Job> {
        self.room.as_ref()?;
        let solving = self.online.take_job()?;
        Some(Job {
            solving,
            room: self.room.take()?,
        })
    }

    pub(super) fn give_back(&mut self, job: Job) {
        self.online.give_back(job.solving);
        self.room = Some(job.room);
    }
}

/// By so many standard errors a number must differ from what it was held to be.
const MOVED: f64 = 6.0;

fn differs((held, error): (f64, f64), (value, new_error): (f64, f64)) -> bool {
    let apart = (value - held).abs();
    apart.is_nan() || apart > MOVED * error.hypot(new_error)
}

/// The motion that rows are made of: it stays what it was until some number of it differs from that by more than its own noise.
///
/// A robot that stands still has one state then, and all its rows are the same but for their right sides. Noise in the others would be motion that no force answers, of which
/// some hundred rows would prove that the robot has no mass.
#[derive(Clone)]
struct Motion {
    position: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    imu: FrameMotion,
    /// Standard errors: three per joint, then nine of the IMU, its first axis' last.
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

/// The mean of a sensor's readings in the share of time about `t`; between two samples if there are none.
fn mean_reading(history: &History<6>, t: Nanos, period: Nanos, max_silence: Nanos) -> (Wrench, Reason) {
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
    let reason = quality_reason(quality, Quality::DEVICE_FAULT).or(stale);
    (Wrench::from_parts([fx, fy, fz], [tx, ty, tz]), reason)
}

/// Most points that a polynomial is fitted to: of more samples, neighbours are averaged.
const POINTS: usize = 80;

/// Windows: how far samples reach to both sides of the instant, as a share of [`DELAY`], and the polynomial's degree.
const REST: (f64, usize) = (1.0, 2);
const WINDOWS: [(f64, usize); 3] = [(0.32, 4), (0.6, 4), (1.0, 4)];

/// Least-squares polynomials about an instant, on the samples' own stamps, by polynomials orthogonal over these (Forsythe 1957): value and two derivatives.
///
/// Where a parabola over the whole window leaves no more than a quartic over its middle does, nothing much moves, and the parabola's derivatives are hardly noisy.
///
/// Else a quartic follows. Over a window of `+-h` its error, for a sine of angular frequency `w`, goes with the fourth power of `w h`. That is a bias `b`, proportional to the
/// derivative `s` itself, and makes the parameters that rest on it wrong by `b / s`. Noise of variance `n` in the derivative makes them wrong, too, for it is motion that no force
/// answers (errors in variables): by `n / s^2`. So the wider window is taken where `b s` and its own noise together are less than the noise of the narrower one. `b` is what
/// is between the two beyond their noise, in the root mean square of the last second ([`Shown`]). Where the samples' noise is not known, the narrowest window is taken.
pub(super) struct Centred {
    count: usize,
    width: usize,
    stamps: [Nanos; KEPT],
    values: [[f64; KEPT]; 9],
    points: usize,
    times: [f64; POINTS],
    signal: [f64; POINTS],
    current: [f64; POINTS],
    previous: [f64; POINTS],
}

impl Default for Centred {
    fn default() -> Self {
        Self {
            count: 0,
            width: 0,
            stamps: [Nanos::ZERO; KEPT],
            values: [[0.0; KEPT]; 9],
            points: 0,
            times: [0.0; POINTS],
            signal: [0.0; POINTS],
            current: [0.0; POINTS],
            previous: [0.0; POINTS],
        }
    }
}

/// Fewest samples for a derivative.
const FEWEST: usize = 5;
/// Fewest samples more than a polynomial has coefficients, for what it leaves to tell of their noise.
const SPARE: usize = 10;
/// What one quiet instant adds to what is known of a number's noise, and any instant to what is known of windows.
const LEARNT: f64 = 0.05;
const SEEN: f64 = 0.01;

/// What has shown of a number so far.
#[derive(Clone, Copy, Debug)]
struct Shown {
    /// Variance of its samples where nothing moved; NaN where it has not shown.
    rest: f64,
    /// Of the last second: mean square of the derivative; of what is between windows, less the noise that this has.
    square: f64,
    apart: [f64; WINDOWS.len() - 1],
}

impl Default for Shown {
    fn default() -> Self {
        Self {
            rest: f64::NAN,
            square: f64::NAN,
            apart: [f64::NAN; WINDOWS.len() - 1],
        }
    }
}

impl Shown {
    /// Of quartics of growing windows the one that makes parameters least wrong by the derivative of this order, the samples' deviation being `sigma`.
    fn choose(&mut self, fits: [Option<Fitted>; WINDOWS.len()], (sigma, order): (f64, usize)) -> Option<Fitted> {
        let learn = |mean: &mut f64, value: f64| {
            *mean = if mean.is_nan() {
                value
            } else {
                *mean + SEEN * (value - *mean)
            }
        };
        let mut chosen: Option<Fitted> = None;
        let mut noise = f64::NAN;
        for (number, fit) in fits.into_iter().enumerate() {
            let Some(fit) = fit else { continue };
            let (Some(value), Some(error)) = (fit.at.get(order), fit.errors.get(order)) else {
                continue;
            };
            let own = (sigma * error).powi(2);
            let Some(narrower) = chosen else {
                learn(&mut self.square, value * value);
                (chosen, noise) = (Some(fit), own);
                continue;
            };
            let Some(apart) = number.checked_sub(1).and_then(|place| self.apart.get_mut(place)) else {
                continue;
            };
            // What the wider one has of noise the narrower has, too.
            learn(
                apart,
                (value - narrower.at.get(order).unwrap_or(value)).powi(2) - (noise - own).max(0.0),
            );
            let is_better = apart.max(0.0).sqrt() * self.square.sqrt() + own < noise;
            if !is_better {
                break;
            }
            (chosen, noise) = (Some(fit), own);
        }
        chosen
    }
}

impl Centred {
    /// Takes the samples of a channel between two instants.
    ///
    /// # Errors
    /// Why they do not do.
    fn gather<const D: usize>(
        &mut self,
        history: &History<D>,
        from: Nanos,
        to: Nanos,
        max_silence: Nanos,
        untrusted: Quality,
    ) -> Result<(), Reason> {
        (self.count, self.width) = (0, D);
        let mut quality = Quality::GOOD;
        let mut newest = to;
        let mut gap = Nanos::ZERO;
        for (t, value, q) in history.within(from, to) {
            gap = gap.max(newest - t);
            newest = t;
            quality |= q;
            if let Some(place) = self.stamps.get_mut(self.count) {
                *place = t;
            }
            for (column, x) in self.values.iter_mut().zip(value) {
                if let Some(place) = column.get_mut(self.count) {
                    *place = *x;
                }
            }
            self.count += 1;
        }
        gap = gap.max(newest - from);
        match quality_reason(quality, untrusted) {
            Reason::None if history.newest().is_none() => Err(Reason::NeverSeen),
            Reason::None if self.count < FEWEST => Err(Reason::Starting),
            // Both ends are near, and no hole is between.
            Reason::None if gap > max_silence || gap.0 > (to - from).0 / 3 => Err(Reason::Stale),
            Reason::None => Ok(()),
            reason => Err(reason),
        }
    }

    /// Whether a number is in every sample.
    fn is_complete(&self, number: usize) -> bool {
        let column = self.values.get(number).filter(|_| number < self.width);
        let column = column.and_then(|column| column.get(..self.count));
        column.is_some_and(|column| !column.is_empty() && column.iter().all(|x| x.is_finite()))
    }

    /// A number at an instant, on a straight line between its neighbours.
    fn value(&self, number: usize, t: Nanos) -> f64 {
        let (Some(column), stamps) = (self.values.get(number), &self.stamps) else {
            return f64::NAN;
        };
        // Newest first.
        let pairs = stamps.iter().zip(column).take(self.count);
        let mut later: Option<(Nanos, f64)> = None;
        for (&stamp, &value) in pairs {
            if stamp <= t {
                return later.map_or(value, |(after, next)| {
                    value + (t - stamp).seconds() / (after - stamp).seconds() * (next - value)
                });
            }
            later = Some((stamp, value));
        }
        f64::NAN
    }

    /// A number at `t`: value, first and second derivative, each with its standard error.
    ///
    /// `shown` is what has shown of the number, and `by` what a window is chosen by: the deviation of its samples, NaN if it is not known, and the derivative that
    /// matters. The standard errors are by the noise that has shown where nothing moved: what a motion leaves of a polynomial is no noise. Before it has: zero.
    fn fit(&mut self, number: usize, t: Nanos, shown: &mut Shown, by: (f64, usize)) -> [(f64, f64); 3] {
        const NONE: (f64, f64) = (f64::NAN, 0.0);
        if self.count < FEWEST || number >= self.values.len() {
            return [NONE; 3];
        }
        let sigma = by.0 / (self.condense(number, t) as f64).sqrt();
        let rest = self.polynomial(REST.0, REST.1);
        let [short, middle, wide] = WINDOWS.map(|(reach, degree)| self.polynomial(reach, degree));
        // What leaves few samples over seems exact by chance.
        let middle = middle.filter(|fit| fit.points > WINDOWS[1].1 + SPARE);
        let short = short.filter(|fit| fit.points > WINDOWS[0].1 + 3);
        let is_quiet = match (&rest, &middle) {
            // Two standard deviations of the middle's variance.
            (Some(rest), Some(middle)) => {
                rest.variance <= middle.variance * (1.0 + 2.0 * (2.0 / middle.freedom).sqrt())
            }
            _ => false,
        };
        let moving = shown.choose([short, middle, wide.filter(|_| short.is_some())], (sigma, by.1));
        let chosen = if is_quiet { rest } else { moving.or(rest) };
        if let (true, Some(rest)) = (is_quiet, &rest) {
            let learnt = if shown.rest.is_nan() { 1.0 } else { LEARNT };
            shown.rest = if shown.rest.is_nan() { 0.0 } else { shown.rest };
            shown.rest += learnt * (rest.variance - shown.rest);
        }
        let deviation = if shown.rest.is_nan() { 0.0 } else { shown.rest.sqrt() };
        chosen.map_or([NONE; 3], |fit| {
            std::array::from_fn(|i| (fit.at[i], fit.errors[i] * deviation))
        })
    }

    /// Standard deviation of a number's samples about `t`, as far as it has shown where nothing moved; `shown` as for [`Centred::fit`].
    fn deviation(&mut self, number: usize, t: Nanos, shown: &mut Shown) -> f64 {
        self.fit(number, t, shown, (f64::NAN, 0));
        // What was fitted to are means of so many samples.
        let share = self.count.div_ceil(POINTS).max(1);
        if shown.rest.is_nan() {
            0.0
        } else {
            (shown.rest * share as f64).sqrt()
        }
    }

    /// Times relative to `t` in units of [`DELAY`], and values relative to the newest; how many samples each point is the mean of.
    #[allow(
        clippy::indexing_slicing,
        reason = "count is at most the arrays' length, and so many points fit"
    )]
    fn condense(&mut self, number: usize, t: Nanos) -> usize {
        let n = self.count.min(KEPT);
        let share = n.div_ceil(POINTS).max(1);
        self.points = 0;
        let groups = self.stamps[..n]
            .chunks(share)
            .zip(self.values[number][..n].chunks(share));
        for (stamps, values) in groups {
            let of = 1.0 / stamps.len() as f64;
            let time: f64 = stamps.iter().map(|stamp| (*stamp - t).seconds()).sum();
            self.times[self.points] = time * of / DELAY.seconds();
            self.signal[self.points] = values.iter().sum::<f64>() * of;
            self.points += 1;
        }
        share
    }

    #[allow(clippy::indexing_slicing, reason = "as many points as were condensed")]
    fn polynomial(&mut self, reach: f64, degree: usize) -> Option<Fitted> {
        // Newest first.
        let first = self.times[..self.points].iter().position(|u| *u <= reach)?;
        let last = self.times[..self.points].iter().rposition(|u| *u >= -reach)?;
        if last < first + degree {
            return None;
        }
        let (times, values) = (&self.times[first..=last], &self.signal[first..=last]);
        let n = times.len();
        let (current, previous) = (&mut self.current[..n], &mut self.previous[..n]);
        current.fill(1.0);
        previous.fill(0.0);
        // The polynomial and its first two derivatives at the instant, of this degree and of the one below.
        let (mut at, mut below) = ([1.0, 0.0, 0.0], [0.0; 3]);
        let (mut result, mut squares, mut norm_below) = ([0.0; 3], [0.0; 3], 1.0);
        let level = values[0];
        let mut left: f64 = values.iter().map(|x| (x - level) * (x - level)).sum();
        for k in 0..=degree {
            let (mut norm, mut moment, mut product) = (0.0, 0.0, 0.0);
            for ((p, u), x) in current.iter().zip(times).zip(values) {
                norm += p * p;
                moment += u * p * p;
                product += (x - level) * p;
            }
            if norm < 1e-14 * n as f64 {
                return None;
            }
            left -= product * product / norm;
            for ((sum, square), value) in result.iter_mut().zip(&mut squares).zip(at) {
                *sum += product / norm * value;
                *square += value * value / norm;
            }
            let (a, b) = (moment / norm, if k == 0 { 0.0 } else { norm / norm_below });
            for ((p, old), u) in current.iter_mut().zip(previous.iter_mut()).zip(times) {
                let next = (u - a) * *p - b * *old;
                *old = std::mem::replace(p, next);
            }
            let next = [
                -a * at[0] - b * below[0],
                at[0] - a * at[1] - b * below[1],
                2.0 * at[1] - a * at[2] - b * below[2],
            ];
            below = std::mem::replace(&mut at, next);
            norm_below = norm;
        }
        let scale = DELAY.seconds();
        let freedom = (n - degree - 1) as f64;
        Some(Fitted {
            at: [result[0] + level, result[1] / scale, result[2] / (scale * scale)],
            errors: [
                squares[0].sqrt(),
                squares[1].sqrt() / scale,
                squares[2].sqrt() / (scale * scale),
            ],
            // Rounding leaves something even of what fits exactly.
            variance: left.max(1e-20 * n as f64) / freedom.max(1.0),
            freedom: freedom.max(1.0),
            points: n,
        })
    }
}

/// A polynomial at its instant, and what it leaves.
#[derive(Clone, Copy, Debug)]
struct Fitted {
    at: [f64; 3],
    /// Standard errors for points of unit variance.
    errors: [f64; 3],
    variance: f64,
    freedom: f64,
    points: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_of_degree_four_is_found_at_any_stamps() {
        let mut history = History::<3>::default();
        let signal = |t: f64| 0.3 - 0.5 * t + 2.0 * t * t - 3.0 * t.powi(3) + 4.0 * t.powi(4);
        let centre = Nanos::from_seconds(0.7);
        for k in 0..70 {
            let t = Nanos::from_seconds(0.4 + 0.01 * f64::from(k) + 0.0003 * f64::from(k * k % 7));
            history.push(t, [signal((t - centre).seconds()), f64::NAN, f64::NAN], Quality::GOOD);
        }
        let mut centred = Centred::default();
        let mut shown = Shown::default();
        let silence = Nanos::from_millis(50);
        centred
            .gather(&history, centre - DELAY, centre + DELAY, silence, UNTRUSTED_ENCODER)
            .unwrap();
        assert!(centred.is_complete(0) && !centred.is_complete(1));
        let found = centred.fit(0, centre, &mut shown, (f64::NAN, 2));
        for (found, expected) in found.iter().zip([0.3, -0.5, 4.0]) {
            assert!((found.0 - expected).abs() < 1e-9, "{found:?}, not {expected}");
        }
    }

    #[test]
    fn a_sine_is_followed_rest_is_quiet_and_a_hole_is_seen() {
        let silence = Nanos::from_millis(100);
        let (w, centre) = (2.0 * std::f64::consts::PI, Nanos::from_seconds(1.25));
        let mut random = 1u32;
        let mut noise = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (f64::from(random) / f64::from(u32::MAX) - 0.5) * 2e-4
        };
        let mut centred = Centred::default();
        let mut shown = Shown::default();
        for (size, bound) in [(1.0, 0.5), (0.0, 0.02)] {
            let mut history = History::<3>::default();
            for k in 0..250 {
                let t = Nanos::from_millis(10 * k);
                let value = size * (w * t.seconds()).sin() + noise();
                history.push(t, [value, f64::NAN, f64::NAN], Quality::GOOD);
            }
            centred
                .gather(&history, centre - DELAY, centre + DELAY, silence, UNTRUSTED_ENCODER)
                .unwrap();
            let [_, _, (acceleration, _)] = centred.fit(0, centre, &mut shown, (f64::NAN, 2));
            let error = (acceleration + size * w * w).abs();
            // Of 39.5 rad/s^2: a quadratic over all of the window would lose 7.
            assert!(error < bound, "{error}");
            // The end of the samples is no middle.
            let end = Nanos::from_millis(2490);
            let refused = centred.gather(&history, end - DELAY, end + DELAY, silence, UNTRUSTED_ENCODER);
            assert_eq!(refused, Err(Reason::Stale));
        }
    }
}
