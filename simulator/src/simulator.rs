//! The robot's boards on its buses, without links and without a clock: takes and returns frames;
//! time is an argument.
//!
//! ```text
//! commands --> on_frame --> Board (drivers) --> answers --\
//!                             ^ encode                     >--> lost? --> poll --> the bus
//! Simulation::at(now) --> measure: noise, faults --> frames /
//! ```
//!
//! Every board has its own clock: it starts at a random phase, runs up to 30 ppm fast or slow, and
//! each emission is up to 2 % of the period (at most 0.1 ms) late. A reading is the truth *at the
//! instant it is sent*: if the simulating machine was delayed, readings are missing, as if the
//! board had skipped them, but none is old.

use crate::drive::DriveTruth;
use crate::fault::{FaultError, InjectedFault, TimeWindow};
use crate::noise::Random;
use crate::robot::{SimulatedRobot, SimulatedRobotError};
use crate::settings::SimulationSettings;
use crate::truth::Simulation;
use proprio_drivers::{Board, Frame, Frames, Options, Spec};
use proprio_gateway::joints::{Inverse, JointsPlan};
use proprio_gateway::plan::DevicePlan;
use proprio_topics::{
    Actuator, Imu, JointState, Kind, Nanos, Quality, Reading, Saturation, StampKind, Wrench,
};
use std::collections::VecDeque;

/// Standard deviation of a simulated position, of a joint or of a motor's shaft behind its gear:
/// the error of gears and bearings in addition to the encoder's steps \[rad or m\].
pub const JOINT_NOISE: f64 = 2e-5;
/// Standard deviation of a simulated IMU's acceleration \[m/s^2\].
pub const ACCELERATION_NOISE: f64 = 0.03;
/// Standard deviation of a simulated IMU's angular velocity \[rad/s\].
pub const ANGULAR_VELOCITY_NOISE: f64 = 0.002;
/// Standard deviation of a simulated taxel \[counts\].
pub(crate) const TAXEL_NOISE: f64 = 0.8;

/// Error of a spike on every axis: \[N\] and \[Nm\].
const SPIKE: (f64, f64) = (200.0, 5.0);
/// Duration of a reboot \[s\].
const REBOOT: f64 = 0.5;
/// Fraction of late second halves during `late_half`.
const LATE_SHARE: f64 = 0.1;
/// Period of a motor board's status. (A real board sends it with every reading, which would double
/// the number of frames without benefit.)
const STATUS_PERIOD: Nanos = Nanos::from_millis(100);
/// The mode that a simulated motor board reports: current control.
const CURRENT_CONTROL: u32 = 6;
/// Maximum relative error of a board's clock.
const DRIFT: f64 = 30e-6;
/// Maximum delay of an emission: as a fraction of the period, and absolute \[ns\].
const JITTER: (f64, f64) = (0.02, 100_000.0);

/// Why a robot cannot be simulated with these settings.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulatorError {
    /// Its files are wrong or do not match each other.
    #[error(transparent)]
    Robot(#[from] SimulatedRobotError),
    /// A fault is not possible for it.
    #[error(transparent)]
    Fault(#[from] FaultError),
}

/// The counters of one bus.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct BusCounts {
    /// Frames lost by a `lost` fault before they reached the bus.
    pub lost_on_request: u64,
    /// Readings not sent because the boards were polled too late for them.
    pub skipped: u64,
    /// Readings that a board could not encode.
    pub refused: u64,
    /// The largest delay of an emission \[ns\].
    pub latest: Nanos,
}

/// All boards of a robot.
#[derive(Debug)]
pub struct Simulator {
    buses: Vec<BusSimulator>,
}

impl Simulator {
    /// The boards of `robot`, powered at `t0`. Boards that need a start command stay silent until
    /// they get one.
    ///
    /// # Errors
    /// [`SimulatorError`]: files that do not match each other, or a fault that is not possible for
    /// this robot.
    pub fn new(
        robot: &SimulatedRobot,
        settings: &SimulationSettings,
        t0: Nanos,
    ) -> Result<Self, SimulatorError> {
        let simulation = Simulation::new(robot, settings)?;
        let mut buses = Vec::new();
        for (number, bus) in robot.plan.buses.iter().enumerate() {
            let mut nodes = Vec::new();
            for device in &bus.devices {
                let stream = nodes.len() + 1000 * number;
                let sources = sources(robot, &simulation, device, &bus.joints)?;
                nodes.push(SimulatedBoard::new(
                    robot, device, sources, settings, stream, t0,
                )?);
            }
            buses.push(BusSimulator {
                name: bus.name.clone(),
                simulation: simulation.clone(),
                t0,
                nodes,
                outbox: VecDeque::with_capacity(64),
                losses: Vec::new(),
                random: Random::new(settings.seed, "bus", number),
                counts: BusCounts::default(),
            });
        }
        let mut this = Self { buses };
        for fault in &settings.faults {
            this.arrange(robot, fault)?;
        }
        Ok(this)
    }

    /// The buses, in the order of the plan.
    #[must_use]
    pub fn buses(&self) -> &[BusSimulator] {
        &self.buses
    }

    /// The buses, for running each in its own thread.
    #[must_use]
    pub fn into_buses(self) -> Vec<BusSimulator> {
        self.buses
    }

    /// Takes a frame from bus number `bus` at `now`.
    pub fn on_frame(&mut self, bus: usize, frame: &Frame, now: Nanos) {
        if let Some(bus) = self.buses.get_mut(bus) {
            bus.on_frame(frame, now);
        }
    }

    /// The next frame that is due at `now`, with the number of its bus; call until `None`.
    pub fn poll(&mut self, now: Nanos) -> Option<(usize, Frame)> {
        self.buses
            .iter_mut()
            .enumerate()
            .find_map(|(number, bus)| bus.poll(now).map(|frame| (number, frame)))
    }

    /// When to poll again; `None`: nothing will be due until a frame comes.
    #[must_use]
    pub fn next_wake(&self) -> Option<Nanos> {
        self.buses.iter().filter_map(BusSimulator::next_wake).min()
    }

    fn arrange(&mut self, robot: &SimulatedRobot, fault: &InjectedFault) -> Result<(), FaultError> {
        let Some(name) = fault.device() else {
            if let InjectedFault::Lost {
                probability,
                window,
            } = fault
            {
                self.buses
                    .iter_mut()
                    .for_each(|bus| bus.losses.push((*probability, *window)));
            }
            return Ok(());
        };
        // Search by the board's name, then by the names of its channels.
        let channel = robot.plan.channels.iter().find(|c| c.name == name);
        let place = robot.plan.buses.iter().enumerate().find_map(|(bus, plan)| {
            plan.devices
                .iter()
                .position(|d| d.name == name)
                .map(|device| (bus, device))
        });
        let place = place.or(channel.map(|c| (c.bus, c.device)));
        let node = place.and_then(|(bus, device)| self.buses.get_mut(bus)?.nodes.get_mut(device));
        let Some(node) = node else {
            let known = robot
                .plan
                .buses
                .iter()
                .flat_map(|b| &b.devices)
                .map(|d| d.name.clone())
                .collect();
            return Err(FaultError::Device {
                fault: fault.to_string(),
                device: name.to_owned(),
                known,
            });
        };
        let possible = |holds: bool, needed| {
            if holds {
                return Ok(());
            }
            Err(FaultError::NotPossible {
                fault: fault.to_string(),
                device: name.to_owned(),
                needed,
            })
        };
        match fault {
            InjectedFault::Lost { .. }
            | InjectedFault::Push { .. }
            | InjectedFault::Still { .. } => {}
            InjectedFault::Silent { window, .. } => node.silences.push(*window),
            InjectedFault::Reboot { at, .. } => {
                node.silences.push(TimeWindow {
                    from: *at,
                    until: at + REBOOT,
                });
                node.reboots.push(Nanos::from_seconds(*at));
            }
            InjectedFault::Saturate { window, .. } => {
                possible(node.measures(Kind::Wrench), "an F/T sensor")?;
                node.saturations.push(*window);
            }
            InjectedFault::Freeze { window, .. } => node.freezes.push(*window),
            InjectedFault::Spike { at, .. } => {
                possible(node.measures(Kind::Wrench), "an F/T sensor")?;
                node.spikes.push(*at);
            }
            InjectedFault::Late { age, window, .. } => node.ages.push((*window, *age)),
            InjectedFault::LateHalf { window, once, .. } => {
                possible(
                    node.measures(Kind::Wrench) || node.measures(Kind::Imu),
                    "a board that sends a reading in several frames",
                )?;
                node.late.push((*window, *once));
            }
        }
        Ok(())
    }
}

/// The boards of one bus.
#[derive(Debug)]
pub struct BusSimulator {
    name: String,
    simulation: Simulation,
    t0: Nanos,
    nodes: Vec<SimulatedBoard>,
    /// Frames that are due.
    outbox: VecDeque<Frame>,
    losses: Vec<(f64, TimeWindow)>,
    random: Random,
    counts: BusCounts,
}

impl BusSimulator {
    /// The bus's name in the plan.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its counters.
    #[must_use]
    pub const fn counts(&self) -> BusCounts {
        self.counts
    }

    /// Takes a frame from the bus at `now`; [`BusSimulator::poll`] gives the answers.
    pub fn on_frame(&mut self, frame: &Frame, now: Nanos) {
        let t = (now - self.t0).seconds();
        let arrival = match frame.stamp {
            StampKind::None => now,
            _ => frame.t.min(now),
        };
        for number in 0..self.nodes.len() {
            let Some(node) = self.nodes.get_mut(number) else {
                return;
            };
            if node.is_silent(t) {
                continue;
            }
            if node.board.period().is_none() {
                // It may be a request for a reading.
                let measured = match node.board.measures_at(frame) {
                    true => (arrival - self.t0).seconds(),
                    false => t,
                };
                node.present(&mut self.simulation, measured);
            }
            let mut answers = Frames::new();
            node.board.on_frame(frame, &mut answers);
            node.follow(now);
            self.post(&answers, t);
        }
    }

    /// The next frame that is due at `now`, with that stamp; call until `None`.
    pub fn poll(&mut self, now: Nanos) -> Option<Frame> {
        loop {
            if let Some(frame) = self.outbox.pop_front() {
                return Some(frame.at(now, StampKind::None));
            }
            let t0 = self.t0;
            for node in &mut self.nodes {
                node.reboot_if_due(now - t0, now);
            }
            let due = |node: &SimulatedBoard| {
                node.slots.as_ref().map(|s| s.due).filter(|due| *due <= now)
            };
            let (index, _) = self
                .nodes
                .iter()
                .enumerate()
                .filter_map(|(i, n)| Some((i, due(n)?)))
                .min_by_key(|(_, due)| *due)?;
            self.emit(index, now);
        }
    }

    /// When to poll again; `None`: nothing will be due until a frame comes.
    #[must_use]
    pub fn next_wake(&self) -> Option<Nanos> {
        if !self.outbox.is_empty() {
            return Some(Nanos::MIN);
        }
        let slots = self
            .nodes
            .iter()
            .filter_map(|n| n.slots.as_ref().map(|s| s.due));
        let reboots = self
            .nodes
            .iter()
            .flat_map(|n| n.reboots.iter().map(|at| self.t0 + *at));
        slots.chain(reboots).min()
    }

    /// Board `index` sends its reading of `now`.
    fn emit(&mut self, index: usize, now: Nanos) {
        let Some(node) = self.nodes.get_mut(index) else {
            return;
        };
        let Some(slots) = &mut node.slots else { return };
        self.counts.latest = self.counts.latest.max(now - slots.due);
        self.counts.skipped += slots.advance(now, &mut node.random);
        let t = (now - self.t0).seconds();
        let mut frames = Frames::new();
        let refused = node.read(&mut self.simulation, t, now, &mut frames);
        self.counts.refused += refused;
        if node.is_silent(t) {
            // Readings during the silence are lost, and so is a half that was held back.
            node.held.clear();
            return;
        }
        node.delay_second_half(t, &mut frames);
        self.post(&frames, t);
    }

    /// Puts frames on the bus, except those lost by a fault.
    fn post(&mut self, frames: &Frames, t: f64) {
        for frame in frames {
            let lost = self
                .losses
                .iter()
                .any(|(p, window)| window.contains(t) && self.random.happens(*p));
            if lost {
                self.counts.lost_on_request += 1;
            } else {
                self.outbox.push_back(*frame);
            }
        }
    }
}

/// The quantity that an output of a board measures.
#[derive(Debug, Clone)]
enum Measurand {
    /// A shaft, which the joints of these numbers in the simulation turn, and its drives.
    Shaft(Inverse, Vec<(usize, DriveTruth)>),
    /// F/T sensor of this number, with its noise.
    Wrench(usize, [f64; 3], [f64; 3]),
    /// IMU of this number.
    Imu(usize),
    /// Skin of this number.
    Skin(usize),
}

/// One board with its measured quantities and its faults.
struct SimulatedBoard {
    kinds: Vec<Kind>,
    options: Options,
    spec: Spec,
    board: Box<dyn Board>,
    outputs: Vec<(u8, Measurand)>,
    noise: bool,
    random: Random,
    /// The noise of presented readings, so that requests do not change what it streams later.
    presented: Random,
    /// Its phase within the period, 0 to 1.
    phase: f64,
    /// The relative error of its clock.
    drift: f64,
    /// Its sending times; `None` while it does not stream.
    slots: Option<Slots>,
    /// Time of a motor board's next status.
    status: Option<Nanos>,
    silences: Vec<TimeWindow>,
    saturations: Vec<TimeWindow>,
    freezes: Vec<TimeWindow>,
    /// The readings that it repeats while it is frozen.
    frozen: Option<Vec<(u8, Reading)>>,
    spikes: Vec<f64>,
    reboots: Vec<Nanos>,
    /// When it sends old readings, and how old they are \[s\].
    ages: Vec<(TimeWindow, f64)>,
    late: Vec<(TimeWindow, bool)>,
    /// The half that is held back.
    held: Frames,
}

impl std::fmt::Debug for SimulatedBoard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SimulatedBoard")
            .field("kinds", &self.kinds)
            .field("spec", &self.spec)
            .finish_non_exhaustive()
    }
}

impl SimulatedBoard {
    fn new(
        robot: &SimulatedRobot,
        device: &DevicePlan,
        outputs: Vec<(u8, Measurand)>,
        settings: &SimulationSettings,
        stream: usize,
        t0: Nanos,
    ) -> Result<Self, SimulatedRobotError> {
        let mut random = Random::new(settings.seed, "board", stream);
        let mut node = Self {
            kinds: device.outputs.iter().map(|output| output.kind).collect(),
            board: power_on(robot, device)?,
            options: device.options.clone(),
            spec: device.spec.clone(),
            outputs,
            noise: settings.noise,
            phase: random.uniform(0.0, 1.0),
            drift: random.uniform(-DRIFT, DRIFT),
            random,
            presented: Random::new(settings.seed, "presented", stream),
            slots: None,
            status: matches!(device.options, Options::IcubMotor(_)).then_some(t0),
            silences: Vec::new(),
            saturations: Vec::new(),
            freezes: Vec::new(),
            frozen: None,
            spikes: Vec::new(),
            reboots: Vec::new(),
            ages: Vec::new(),
            late: Vec::new(),
            held: Frames::new(),
        };
        node.follow(t0);
        Ok(node)
    }

    fn measures(&self, kind: Kind) -> bool {
        self.kinds.contains(&kind)
    }

    fn is_silent(&self, t: f64) -> bool {
        self.silences.iter().any(|w| w.contains(t))
    }

    /// Applies the board's current streaming period from `now` on.
    fn follow(&mut self, now: Nanos) {
        match self.board.period() {
            None => self.slots = None,
            Some(period) if self.slots.as_ref().is_some_and(|s| s.period == period) => {}
            Some(period) => {
                let origin = now + scaled(period, self.phase);
                self.slots = Some(Slots::new(period, origin, self.drift, &mut self.random));
            }
        }
    }

    fn reboot_if_due(&mut self, since_t0: Nanos, now: Nanos) {
        let before = self.reboots.len();
        self.reboots.retain(|at| *at > since_t0);
        if self.reboots.len() < before
            && let Ok(board) = self.options.board(&self.spec)
        {
            self.board = board;
            self.slots = None;
            self.held.clear();
            self.follow(now);
        }
    }

    fn quality(&self, t: f64) -> Quality {
        if self.saturations.iter().any(|w| w.contains(t)) {
            Quality::GOOD.with_saturation(2, Saturation::High)
        } else {
            Quality::GOOD
        }
    }

    /// What it measures, or the readings with which it froze.
    fn frozen_at(&mut self, t: f64, readings: Vec<(u8, Reading)>) -> Vec<(u8, Reading)> {
        if !self.freezes.iter().any(|w| w.contains(t)) {
            self.frozen = None;
            return readings;
        }
        self.frozen.get_or_insert(readings).clone()
    }

    /// Gives a board that does not stream its readings at `t`.
    fn present(&mut self, simulation: &mut Simulation, t: f64) {
        let quality = self.quality(t);
        let noise = self.noise.then_some(&mut self.presented);
        let readings = measure(&self.outputs, simulation, t, false, noise);
        for (output, reading) in self.frozen_at(t, readings) {
            self.board.present(output, &reading, quality);
        }
    }

    /// Encodes its readings at `t`; returns the number of readings that the board refused.
    fn read(
        &mut self,
        simulation: &mut Simulation,
        t: f64,
        now: Nanos,
        frames: &mut Frames,
    ) -> u64 {
        let mut refused = 0;
        let quality = self.quality(t);
        let spikes = self.spikes.len();
        self.spikes.retain(|at| *at > t);
        let spike = self.spikes.len() < spikes;
        let noise = self.noise.then_some(&mut self.random);
        let age = self.ages.iter().find(|(window, _)| window.contains(t));
        let measured = t - age.map_or(0.0, |(_, age)| *age);
        let readings = measure(&self.outputs, simulation, measured, spike, noise);
        for (output, reading) in self.frozen_at(t, readings) {
            refused += u64::from(
                self.board
                    .encode(output, &reading, quality, frames)
                    .is_err(),
            );
        }
        if let Some(status) = self.status
            && status <= now
        {
            self.status = Some(now + STATUS_PERIOD);
            let actuator = Actuator {
                duty: 0.0,
                mode: CURRENT_CONTROL,
                encoder: 0,
                faults: 0,
            };
            refused += u64::from(
                self.board
                    .encode(0, &Reading::Actuator(actuator), quality, frames)
                    .is_err(),
            );
        }
        refused
    }

    /// Sends the half that was held back after the first half of this reading, and may hold back
    /// this reading's second half.
    fn delay_second_half(&mut self, t: f64, frames: &mut Frames) {
        let mut together = Frames::new();
        let mut own = std::mem::take(frames).into_iter();
        together.extend(own.next());
        let nothing_held = self.held.is_empty();
        together.extend(self.held.drain(..));
        let random = &mut self.random;
        let late = nothing_held
            && self
                .late
                .iter()
                .any(|(w, once)| w.contains(t) && (*once || random.happens(LATE_SHARE)));
        if late {
            self.late.retain(|(w, once)| !(*once && w.contains(t)));
            self.held.extend(own);
        } else {
            together.extend(own);
        }
        *frames = together;
    }
}

/// What each output of a board measures.
fn sources(
    robot: &SimulatedRobot,
    simulation: &Simulation,
    device: &DevicePlan,
    joints: &JointsPlan,
) -> Result<Vec<(u8, Measurand)>, SimulatedRobotError> {
    let mut outputs = Vec::new();
    for output in &device.outputs {
        let name = |channel: u32| {
            let channel = robot.plan.channels.get(channel as usize);
            channel.map_or("", |channel| channel.name.as_str())
        };
        let channel_name = name(output.channel);
        let missing = |name: &str, problem: &str| {
            robot.mismatch(format!("gateway.toml has {name:?}: {problem}"))
        };
        let source = match output.kind {
            Kind::Joint => {
                let inverse = output
                    .input
                    .as_ref()
                    .and_then(|f| joints.inverse(f, output.map));
                let Some(inverse) = inverse else { continue };
                let number = |channel: &u32| {
                    let no_joint = "the URDF has no moving joint of that name";
                    let joint = simulation.joint(name(*channel));
                    let joint = joint.ok_or_else(|| missing(name(*channel), no_joint))?;
                    Ok((joint, DriveTruth::new(&robot.model, name(*channel))))
                };
                let joints = inverse.channels.iter().map(number);
                let joints = joints.collect::<Result<_, SimulatedRobotError>>()?;
                Measurand::Shaft(inverse, joints)
            }
            Kind::Wrench => {
                let number = simulation.wrench(channel_name);
                let number = number.ok_or_else(|| {
                    missing(
                        channel_name,
                        "estimator.toml has no [[force_torque]] with that sensor",
                    )
                })?;
                let ft = robot.config.force_torque.get(number);
                let ft = ft.ok_or_else(|| missing(channel_name, "it is not configured"))?;
                Measurand::Wrench(number, ft.noise_n, ft.noise_nm)
            }
            Kind::Imu => Measurand::Imu(simulation.imu(channel_name).ok_or_else(|| {
                missing(
                    channel_name,
                    "its place is not known: it is not the [base] of estimator.toml, and no link \
                     of the URDF has its name",
                )
            })?),
            // A skin that estimator.toml does not place feels nothing.
            Kind::Skin => match simulation.skin(channel_name) {
                Some(skin) => Measurand::Skin(skin),
                None => continue,
            },
            // What is not simulated is silent.
            Kind::Gauges | Kind::Temperature | Kind::Actuator => continue,
        };
        outputs.push((output.number, source));
    }
    Ok(outputs)
}

/// The readings of a board's outputs at `t`, with noise if there is a source of it.
fn measure(
    outputs: &[(u8, Measurand)],
    simulation: &mut Simulation,
    t: f64,
    spike: bool,
    mut random: Option<&mut Random>,
) -> Vec<(u8, Reading)> {
    let mut readings = Vec::with_capacity(outputs.len());
    for (output, measurand) in outputs {
        if let Measurand::Skin(number) = *measurand {
            for mut skin in simulation.taxels(number, t) {
                if let Some(random) = &mut random {
                    random.disturb(&mut skin.taxels, [TAXEL_NOISE; 12]);
                }
                readings.push((*output, Reading::Skin(skin)));
            }
        }
        let reading = measurand.reading(simulation, t, spike, random.as_deref_mut());
        readings.extend(reading.map(|reading| (*output, reading)));
    }
    readings
}

impl Measurand {
    /// Its reading at `t`; `None` of what is not there, and of a skin, which has several.
    fn reading(
        &self,
        simulation: &mut Simulation,
        t: f64,
        spike: bool,
        mut random: Option<&mut Random>,
    ) -> Option<Reading> {
        match *self {
            Self::Skin(_) => None,
            Self::Shaft(ref inverse, ref joints) => {
                let states = joints.iter().map(|(joint, drive)| {
                    let truth = simulation.at(t).joints.get(*joint)?;
                    let torque = drive.torque(truth);
                    Some(JointState {
                        position: truth.position,
                        velocity: truth.velocity,
                        acceleration: truth.acceleration,
                        torque,
                        current: torque / drive.per_ampere,
                    })
                });
                let states: Vec<JointState> = states.collect::<Option<_>>()?;
                let mut shaft = inverse.shaft(&states);
                shaft.position += random.map_or(0.0, |random| JOINT_NOISE * random.normal());
                Some(Reading::Joint(inverse.device(shaft)))
            }
            Self::Wrench(number, noise_n, noise_nm) => {
                let &[fx, fy, fz, tx, ty, tz] = simulation.at(t).wrenches.get(number)?;
                let mut wrench = Wrench {
                    force: [fx, fy, fz],
                    torque: [tx, ty, tz],
                };
                if let Some(random) = &mut random {
                    random.disturb(&mut wrench.force, noise_n);
                    random.disturb(&mut wrench.torque, noise_nm);
                }
                if spike {
                    wrench.force = wrench.force.map(|f| f + SPIKE.0);
                    wrench.torque = wrench.torque.map(|n| n + SPIKE.1);
                }
                Some(Reading::Wrench(wrench))
            }
            Self::Imu(number) => {
                let truth = simulation.at(t).imus.get(number)?;
                let mut imu = Imu {
                    proper_acceleration: truth.proper_acceleration,
                    angular_velocity: truth.angular_velocity,
                    // Not simulated: constants, for boards configured to send them.
                    magnetic_field: [2e-5, 0.0, -4e-5],
                    orientation: [1.0, 0.0, 0.0, 0.0],
                    ..Imu::ABSENT
                };
                if let Some(random) = &mut random {
                    random.disturb(&mut imu.proper_acceleration, [ACCELERATION_NOISE; 3]);
                    random.disturb(&mut imu.angular_velocity, [ANGULAR_VELOCITY_NOISE; 3]);
                }
                Some(Reading::Imu(imu))
            }
        }
    }
}

/// The sending times of a board.
#[derive(Debug)]
struct Slots {
    period: Nanos,
    origin: Nanos,
    drift: f64,
    next: i64,
    due: Nanos,
}

impl Slots {
    fn new(period: Nanos, origin: Nanos, drift: f64, random: &mut Random) -> Self {
        let mut this = Self {
            period,
            origin,
            drift,
            next: 0,
            due: origin,
        };
        this.due = this.nominal(0) + this.jitter(random);
        this
    }

    #[allow(clippy::cast_precision_loss)] // a slot number is far below 2^52
    fn nominal(&self, slot: i64) -> Nanos {
        let elapsed = Nanos(self.period.0.saturating_mul(slot));
        self.origin + elapsed + scaled(elapsed, self.drift)
    }

    fn jitter(&self, random: &mut Random) -> Nanos {
        let most = scaled(self.period, JITTER.0).seconds().min(JITTER.1 * 1e-9);
        Nanos::from_seconds(random.uniform(0.0, most))
    }

    /// Advances to the first slot after `now`; returns the number of slots skipped.
    fn advance(&mut self, now: Nanos, random: &mut Random) -> u64 {
        let mut skipped = 0;
        self.next += 1;
        while self.nominal(self.next) <= now {
            self.next += 1;
            skipped += 1;
        }
        self.due = self.nominal(self.next) + self.jitter(random);
        skipped
    }
}

#[allow(clippy::cast_precision_loss)] // a difference of instants, far below 2^52 ns
fn scaled(duration: Nanos, factor: f64) -> Nanos {
    Nanos::from_seconds(duration.0 as f64 * factor * 1e-9)
}

/// A board after power-on.
fn power_on(
    robot: &SimulatedRobot,
    device: &DevicePlan,
) -> Result<Box<dyn Board>, SimulatedRobotError> {
    device
        .options
        .board(&device.spec)
        .map_err(|e| robot.mismatch(format!("gateway.toml, {:?}: {e}", device.name)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_drivers::{EncodeError, Id};

    /// A board that answers a request with the force along z \[N\].
    struct Polled(Option<f64>);

    impl Board for Polled {
        fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
            if frame.id == Id::standard(1)
                && let Some(force) = self.0
            {
                out.push(Frame::new(Id::standard(2), &force.to_le_bytes()));
            }
        }

        fn period(&self) -> Option<Nanos> {
            None
        }

        fn present(&mut self, output: u8, reading: &Reading, _quality: Quality) {
            if let (0, Reading::Wrench(wrench)) = (output, reading) {
                self.0 = Some(wrench.force[2]);
            }
        }

        fn encode(
            &mut self,
            _: u8,
            _: &Reading,
            _: Quality,
            _: &mut Frames,
        ) -> Result<(), EncodeError> {
            Err(EncodeError::Kind)
        }
    }

    #[test]
    fn a_polled_board_answers_with_the_reading_of_the_request() {
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        let settings = SimulationSettings {
            noise: false,
            ..SimulationSettings::default()
        };
        let t0 = Nanos::from_millis(5);
        let mut simulator = Simulator::new(&robot, &settings, t0).unwrap();
        let bus = &mut simulator.buses[0];
        let node = bus
            .nodes
            .iter_mut()
            .find(|node| node.measures(Kind::Wrench))
            .unwrap();
        node.board = Box::new(Polled(None));
        let mut truth = Simulation::new(&robot, &settings).unwrap();
        for ms in [300, 900] {
            let now = t0 + Nanos::from_millis(ms);
            bus.on_frame(&Frame::new(Id::standard(1), &[]), now);
            let answer = std::iter::from_fn(|| bus.poll(now))
                .find(|frame| frame.id == Id::standard(2))
                .unwrap();
            let force = f64::from_le_bytes(answer.data().try_into().unwrap());
            let seconds = Nanos::from_millis(ms).seconds();
            assert_eq!(force, truth.at(seconds).wrenches[0][2]);
        }
    }
}
