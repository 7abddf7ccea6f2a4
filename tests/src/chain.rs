//! Frames to torques, under fault, from a seed: the gateway's half of [`crate::truth`].
//!
//! ```text
//! seed -> ChainRig: a robot at random, its boards of families at random (gateway.toml,
//!              estimator.toml)
//! boards <-> Wire (faults) <-> Bus (devices) -> shared memory -> Pipeline -> judged
//! ```
//!
//! Everything between the wire and the judge is the program itself: the gateway's loop with its
//! devices, ports in shared memory, the estimator's pipeline with identification. Time is
//! simulated, so that one seed is one run.
//!
//! What must hold under every fault: valid torques are true ([`crate::promise`]); nothing stale is
//! fresh: a good reading is the truth at its stamp; all frames and samples are accounted for.
//!
//! The short set of `tests/chain.rs` runs with the other tests; the long one is `cargo run
//! --release -p proprio-tests --bin chain`.

mod rig;
mod wire;

pub use crate::promise::Outcome;
pub use rig::{FAMILIES, Family};
pub use wire::Fault;

use crate::promise::Judge;
use crate::truth::random::Random;
use proprio_estimator::pipeline::Pipeline;
use proprio_gateway::bus::Bus;
use proprio_gateway::clock::Clock;
use proprio_gateway::devices::{BusDevices, build};
use proprio_gateway::plan::{ChannelPlan, DevicePlan, Plan};
use proprio_gateway::publish::SharedMemory;
use proprio_gateway::status::BusStatus;
use proprio_simulator::fault::{InjectedFault, TimeWindow};
use proprio_simulator::{Simulation, SimulationSettings};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Renewal, Writer};
use proprio_topics::{
    Counter, DeviceHealth, DeviceState, Kind, NO_CAUSE, Nanos, Quality, Reading, Sample,
};
use rig::{ChainRig, REST};
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};
use wire::{End, Planned, SimulatedClock, Wire};

/// Duration of a run \[s\].
pub const DURATION: f64 = 40.0;
/// When a fault is present \[s\].
const PRESENT: (f64, f64) = (20.0, 30.0);
/// When the boards are powered: not at zero, which a stamp would be by mistake.
const START: Nanos = Nanos::from_millis(5_000);
/// Samples are passed to the estimator so often: as fast as a thread is woken.
const SLICE: Nanos = Nanos::from_millis(1);
/// How long a killed gateway is away \[s\].
const AWAY: f64 = 0.5;
/// Of a long run: a fault begins so often, and is present for half of the time \[s\].
const EVERY: f64 = 20.0;
/// So many of them are a stage of it.
const MANY: usize = 50;

/// Old frames of a device that is asked for each reading: the most of those that are taken for the
/// answer, because they come between a request and it. A device that streams gives no sign.
const TAKEN: f64 = 0.5;

/// How far a good reading may be off the truth at its stamp: resolution and noise of the coarsest
/// family \[rad\], \[N\], \[Nm\], \[m/s^2\], \[rad/s\].
const OFF: [f64; 5] = [2.5e-3, 1.2, 0.06, 0.3, 0.05];
/// How much earlier than its stamp it may have been measured \[s\]: frames wait for each other on
/// the bus.
const BEFORE: f64 = 4e-3;

/// What a run showed.
#[derive(Debug, Clone)]
pub struct Shown {
    /// The judge of torques.
    pub outcome: Outcome,
    /// Good readings: compared with the truth; off.
    pub readings: [u64; 2],
    /// The first reading that is off.
    pub first: Option<String>,
    /// Whatever is not accounted for.
    pub missing: Vec<String>,
    /// Frames that the gateway got.
    pub frames: u64,
    /// Good readings that may be off: old frames that nothing tells from new ones.
    pub excused: u64,
    /// Devices that do not stream at the end.
    pub silent: Vec<String>,
    /// The share of valid torques: before the fault, while it is present, and in the last five
    /// seconds.
    pub valid: [f64; 3],
    /// Torques that are withheld because of a channel, while the fault is present: all; because of
    /// one that the fault concerns.
    pub named: [u64; 2],
}

impl Shown {
    /// Whether more good readings are off than may be.
    #[must_use]
    pub const fn is_off(&self) -> bool {
        self.readings[1] > self.excused
    }

    /// Whether something that must hold does not.
    #[must_use]
    pub fn is_broken(&self) -> bool {
        self.outcome.is_broken()
            || self.is_off()
            || !self.missing.is_empty()
            || !self.silent.is_empty()
    }
}

/// Runs the robot of `seed`, with a `fault` in a device of `family` or on its bus; `None` if the
/// robot has no such device.
///
/// # Panics
/// If the robot cannot be simulated.
#[must_use]
pub fn run(seed: u64, family: Family, fault: Fault) -> Option<Shown> {
    let (from, until) = PRESENT;
    let troubles = vec![PlannedFault { fault, from, until }];
    let folder = tempfile::tempdir().expect("a folder");
    Some(Chain::open(seed, family, troubles, DURATION, folder.path())?.run(&mut |_| {}))
}

/// The same for a run of `duration` \[s\], with one fault after the other from the tenth second on:
/// all of the list in turn, each time in an order at random. After each stage `during` is told the
/// time \[s\].
///
/// # Panics
/// If the robot cannot be simulated.
#[must_use]
pub fn soak(
    seed: u64,
    family: Family,
    duration: f64,
    during: &mut dyn FnMut(f64),
) -> Option<Shown> {
    let random = &mut Random::new(seed, "troubles");
    // The last one ends long before the run does.
    let count = (duration / EVERY) as usize - 1;
    let mut left: Vec<Fault> = Vec::new();
    let troubles = (0..count).map(|number| {
        if left.is_empty() {
            left.extend(Fault::ALL.iter().map(|(_, fault)| *fault));
        }
        let from = EVERY * (number as f64 + 0.5);
        PlannedFault {
            fault: left.swap_remove(random.below(left.len())),
            from,
            until: from + 0.5 * EVERY,
        }
    });
    let (troubles, folder) = (troubles.collect(), tempfile::tempdir().expect("a folder"));
    Some(Chain::open(seed, family, troubles, duration, folder.path())?.run(during))
}

/// A fault, and when it is present \[s\].
#[derive(Debug, Clone, Copy)]
struct PlannedFault {
    fault: Fault,
    from: f64,
    until: f64,
}

/// A device that measures `kind`: its bus and number.
fn device_of(plan: &Plan, kind: Kind, random: &mut Random) -> Option<(usize, usize)> {
    let all: Vec<(usize, usize)> = (plan.channels.iter())
        .filter(|channel| channel.kind == kind)
        .map(|channel| (channel.bus, channel.device))
        .collect();
    (!all.is_empty()).then(|| all[random.below(all.len())])
}

/// The fault that the board itself has.
fn board_fault(trouble: &PlannedFault, device: String) -> Option<InjectedFault> {
    let (from, until) = (trouble.from, trouble.until);
    match trouble.fault {
        Fault::Stuck => Some(InjectedFault::Freeze {
            device,
            window: TimeWindow { from, until },
        }),
        Fault::Reboot => Some(InjectedFault::Reboot { device, at: from }),
        _ => None,
    }
}

fn at(t: f64) -> Nanos {
    START + Nanos::from_seconds(t)
}

/// The gateway's side of one bus.
struct Running {
    bus: Bus<SharedMemory>,
    status: Arc<BusStatus>,
    clock: SimulatedClock,
    /// What the wire had delivered when it was started.
    before: u64,
}

/// All processes of the robot.
struct Chain {
    plan: Plan,
    simulation: Simulation,
    /// In the order of time.
    troubles: Vec<PlannedFault>,
    duration: f64,
    family: Family,
    /// Bus and number of the device that has the faults.
    target: (usize, usize),
    wires: Vec<End>,
    /// None while the gateway is killed.
    buses: Vec<Running>,
    /// Samples of gateways that have ended.
    published: u64,
    domain: Domain,
    reader: Reader<Sample>,
    inbox: Vec<Sample>,
    /// Per channel of the gateway, the pipeline's.
    map: Vec<Option<usize>>,
    pipeline: Pipeline,
    judge: Judge,
    name: String,
    /// Torques before, during and after the fault: all, valid.
    phases: [[u64; 2]; 3],
    named: [u64; 2],
    /// Per channel of the pipeline, whether the fault concerns it.
    concerned: Vec<bool>,
    /// Per channel of the gateway, a wrench sensor's zero, and how well it is known.
    zeros: Vec<Option<[[f64; 2]; 6]>>,
    readings: [u64; 2],
    first: Option<String>,
    missing: Vec<String>,
}

impl Chain {
    /// The robot of `seed` with its processes.
    fn open(
        seed: u64,
        family: Family,
        troubles: Vec<PlannedFault>,
        duration: f64,
        folder: &Path,
    ) -> Option<Self> {
        let random = Random::new(seed, "fault");
        let settings = |plan: &Plan| {
            let target = device_of(plan, family.kind, &mut random.clone());
            let name = |(bus, device): (usize, usize)| plan.buses[bus].devices[device].name.clone();
            let faults = target.map(name).into_iter().flat_map(|device| {
                let fault = |trouble| board_fault(trouble, device.clone());
                troubles.iter().filter_map(fault).collect::<Vec<_>>()
            });
            SimulationSettings {
                seed,
                still: REST,
                push: seed.is_multiple_of(2),
                cycle: DURATION,
                noise: true,
                faults: faults.collect(),
            }
        };
        let rig = ChainRig::new(seed, family, settings, START, folder)?;
        Some(Self::new(rig, seed, troubles, duration, family, folder))
    }

    fn new(
        rig: ChainRig,
        seed: u64,
        troubles: Vec<PlannedFault>,
        duration: f64,
        family: Family,
        folder: &Path,
    ) -> Self {
        let kind = family.kind;
        let target = device_of(&rig.plan, kind, &mut Random::new(seed, "fault")).expect("one");
        let ChainRig {
            name,
            setup,
            plan,
            mut simulation,
            boards,
        } = rig;
        let domain = Domain::open(&DomainConfig::new(folder, "chain")).expect("a domain");
        let device = &plan.buses[target.0].devices[target.1];
        let claims = build(device, None).expect("a device").claims().to_vec();
        let wires = boards
            .into_buses()
            .into_iter()
            .enumerate()
            .map(|(bus, boards)| {
                let of_bus = troubles.iter().filter(|_| bus == target.0);
                let planned = of_bus.map(|trouble| Planned {
                    fault: trouble.fault,
                    from: at(trouble.from),
                    until: at(trouble.until),
                    claims: claims.clone(),
                });
                let planned = planned.collect();
                let random = Random::new(seed, &format!("wire {bus}"));
                let wire = Wire::new(boards, planned, SimulatedClock::at(START), random);
                End(Arc::new(Mutex::new(wire)))
            });
        let wires = wires.collect();
        let joints = setup.robot.joint_names().map(Into::into).collect();
        let names = setup.channels().map(|(_, name)| name.into()).collect();
        let mut truth = |t: f64| torques(&mut simulation, t);
        let judge = Judge::new(joints, names, &mut truth, duration, REST + 10.0);
        let map: Vec<Option<usize>> = plan
            .channels
            .iter()
            .map(|c| setup.channel(c.kind, &c.name))
            .collect();
        let is_concerned = |name: &str| {
            let mut channels = plan.channels.iter().filter(|c| c.name == name);
            let is_of_device = troubles.iter().all(|trouble| trouble.fault.is_of_device());
            channels.any(|c| c.bus == target.0 && (!is_of_device || c.device == target.1))
        };
        let concerned = setup
            .channels()
            .map(|(_, name)| is_concerned(name))
            .collect();
        // The topic is there as long as it has a port.
        let first = Writer::<Sample>::create(&domain, &plan.robot, 0).expect("a port");
        let reader = Reader::open(&domain, &plan.robot).expect("a port");
        drop(first);
        let mut this = Self {
            plan,
            simulation,
            troubles,
            duration,
            family,
            target,
            wires,
            buses: Vec::new(),
            published: 0,
            domain,
            reader,
            inbox: Vec::new(),
            pipeline: Pipeline::new(setup),
            judge,
            name,
            phases: [[0; 2]; 3],
            named: [0; 2],
            concerned,
            zeros: vec![None; map.len()],
            map,
            readings: [0; 2],
            first: None,
            missing: Vec::new(),
        };
        this.start(1);
        this
    }

    /// Starts the gateway.
    fn start(&mut self, epoch: u64) {
        for (number, plan) in (0..).zip(&self.plan.buses) {
            let status = Arc::new(BusStatus::new(number, plan));
            let devices =
                BusDevices::new(number, plan, None, Arc::clone(&status)).expect("devices");
            let writer = Writer::create(&self.domain, &self.plan.robot, epoch).expect("a port");
            let sink = SharedMemory::new(writer, &self.plan.robot, Arc::new(Renewal::default()));
            let end = self.wires[number as usize].clone();
            self.buses.push(Running {
                before: end.with(|wire| wire.passed.delivered),
                clock: end.with(|wire| wire.clock.clone()),
                bus: Bus::new(Box::new(end), devices, sink, Arc::clone(&status)),
                status,
            });
        }
    }

    /// Ends it; all that it has taken must be accounted for.
    fn kill(&mut self) {
        for (running, end) in self.buses.drain(..).zip(&self.wires) {
            let status = running.status;
            let delivered = end.with(|wire| wire.passed.delivered) - running.before;
            let frames = status.frames.load(Relaxed);
            let unclaimed = status.unclaimed.load(Relaxed);
            let claimed = status
                .devices()
                .map(|d| d.counters[Counter::Frames as usize]);
            let claimed: u64 = claimed.sum();
            if frames != delivered || claimed + unclaimed < frames {
                self.missing.push(format!(
                    "{delivered} frames delivered, {frames} counted, {claimed} for devices, \
                     {unclaimed} for none"
                ));
            }
            let failures = status.publish_failures.load(Relaxed);
            if failures > 0 {
                self.missing
                    .push(format!("{failures} samples not published"));
            }
            self.published += status.published.load(Relaxed);
        }
    }

    /// The fault that is present, or was until `tail` ago \[s\].
    fn trouble(&self, t: f64, tail: f64) -> Option<PlannedFault> {
        let begun = self.troubles.partition_point(|trouble| trouble.from <= t);
        let last = begun
            .checked_sub(1)
            .and_then(|last| self.troubles.get(last));
        last.filter(|trouble| t < trouble.until + tail).copied()
    }

    fn run(mut self, during: &mut dyn FnMut(f64)) -> Shown {
        let mut t = START;
        let (mut begun, mut epoch) = (0, 1);
        while t < at(self.duration) {
            t += SLICE;
            while self
                .troubles
                .get(begun)
                .is_some_and(|trouble| at(trouble.until) < t)
            {
                begun += 1;
                if begun % MANY == 0 {
                    self.judge.forget();
                    during((t - START).seconds());
                }
            }
            let present = self.troubles.get(begun).filter(|last| at(last.from) < t);
            let restart = present.filter(|last| last.fault == Fault::Restart);
            let back = restart.map_or(Nanos::MIN, |restart| at(restart.from + AWAY));
            if t <= back {
                if !self.buses.is_empty() {
                    self.kill();
                }
                self.wires
                    .iter()
                    .for_each(|end| end.with(|wire| wire.pass_unheard(t)));
                if t == back {
                    epoch += 1;
                    self.start(epoch);
                }
                continue;
            }
            for (Running { bus, clock, .. }, end) in self.buses.iter_mut().zip(&self.wires) {
                end.with(|wire| wire.horizon = t);
                let mut turns = 0;
                while clock.now() < t {
                    bus.turn(clock);
                    turns += 1;
                    assert!(turns < 10_000, "a loop without an end: {}", self.name);
                }
            }
            self.take();
        }
        self.finish()
    }

    /// What the estimator does with the samples that wait.
    fn take(&mut self) {
        self.inbox.clear();
        while let Some(sample) = self.reader.try_take().expect("a port") {
            self.inbox.push(sample);
        }
        self.inbox
            .sort_unstable_by_key(|s| (s.header.acquired, s.header.bus, s.header.sequence));
        for at in 0..self.inbox.len() {
            let sample = self.inbox[at];
            self.compare(&sample);
            if let (Some(channel), Some(reading)) =
                (self.map[sample.channel as usize], sample.reading())
            {
                let header = &sample.header;
                self.pipeline
                    .push(channel, header.acquired, &reading, header.quality);
            }
            self.judge();
        }
    }

    fn judge(&mut self) {
        while let Some(estimate) = self.pipeline.poll() {
            let t = (estimate.t - START).seconds();
            let simulation = &mut self.simulation;
            let joints = estimate.torques.joints();
            self.judge
                .on_estimate(t, joints, &mut |t| torques(simulation, t));
            let (from, until) = PRESENT;
            let phases = [
                (REST + 10.0, from),
                (from + 0.5, until),
                (DURATION - 5.0, DURATION),
            ];
            for (phase, (from, until)) in self.phases.iter_mut().zip(phases) {
                if from <= t && t < until {
                    phase[0] += joints.len() as u64;
                    phase[1] += joints.iter().filter(|joint| joint.valid == 1).count() as u64;
                }
            }
            if from + 0.5 <= t && t < until {
                for cause in joints
                    .iter()
                    .map(|joint| joint.cause)
                    .filter(|c| *c != NO_CAUSE)
                {
                    self.named[0] += 1;
                    self.named[1] += u64::from(self.concerned[cause as usize]);
                }
            }
            if let Some(mut job) = self.pipeline.take_job() {
                job.run();
                self.pipeline.give_back(job);
            }
        }
    }

    /// Compares a good reading with the truth at its stamp.
    fn compare(&mut self, sample: &Sample) {
        let noted = Quality::GAP_BEFORE.0 | Quality::DEVICE_COUNTER.0 | Quality::ZERO_CHANGED.0;
        let channel = &self.plan.channels[sample.channel as usize];
        let t = (sample.header.acquired - START).seconds();
        // A fault's last frames arrive later.
        let present = (self.trouble(t, 0.3)).filter(|_| channel.bus == self.target.0);
        // Some motors share an identifier: the frames of one may become those of another.
        let is_bad = present.is_some_and(|trouble| trouble.fault.is_of_values());
        let Some(reading) = sample.reading() else {
            return;
        };
        if sample.header.quality.0 & !noted != 0 || is_bad {
            if sample.header.quality.contains(Quality::ZERO_CHANGED) {
                self.zeros[sample.channel as usize] = None;
            }
            return;
        }
        let lag = BEFORE + present.map_or(0.0, |trouble| trouble.fault.delay());
        let name = channel.name.clone();
        let mut least = [f64::INFINITY; 6];
        let mut most = [f64::NEG_INFINITY; 6];
        let mut cover = |values: [f64; 6]| {
            for ((least, most), value) in least.iter_mut().zip(&mut most).zip(values) {
                (*least, *most) = (least.min(value), most.max(value));
            }
        };
        let (values, off, count) = match reading {
            Reading::Joint(joint) => {
                let number = self.simulation.joint(&name).expect("a joint");
                for k in 0..6 {
                    let before = lag * f64::from(k) / 4.0 - 0.25 * lag;
                    let point = self.simulation.motion(number, t - before).expect("a joint");
                    cover([point.position; 6]);
                }
                ([joint.position; 6], [OFF[0]; 6], 1)
            }
            Reading::Wrench(wrench) => {
                let number = self.simulation.wrench(&name).expect("a sensor");
                for before in [-1e-3, 0.5 * lag, lag] {
                    cover(self.simulation.at(t - before).wrenches[number]);
                }
                let ([fx, fy, fz], [tx, ty, tz]) = (wrench.force, wrench.torque);
                let (force, torque) = (OFF[1], OFF[2]);
                let mut values = [fx, fy, fz, tx, ty, tz];
                let mut off = [force, force, force, torque, torque, torque];
                // Some sensors take the load at their start for zero, and the gateway knows.
                let zero = &mut self.zeros[sample.channel as usize];
                let device = &self.plan.buses[channel.bus].devices[channel.device];
                let is_first = zero.is_none() && device.driver == "jr3_can";
                if is_first || sample.header.quality.contains(Quality::ZERO_CHANGED) {
                    *zero = Some(std::array::from_fn(|axis| {
                        let (least, most) = (least[axis], most[axis]);
                        [values[axis] - 0.5 * (least + most), 0.5 * (most - least)]
                    }));
                }
                for (axis, [zero, doubt]) in zero.unwrap_or_default().into_iter().enumerate() {
                    values[axis] -= zero;
                    off[axis] += doubt;
                }
                (values, off, 6)
            }
            Reading::Imu(imu) => {
                let number = self.simulation.imu(&name).expect("an IMU");
                for before in [-1e-3, 0.5 * lag, lag] {
                    let truth = self.simulation.at(t - before).imus[number];
                    let ([ax, ay, az], [gx, gy, gz]) =
                        (truth.proper_acceleration, truth.angular_velocity);
                    cover([ax, ay, az, gx, gy, gz]);
                }
                let ([ax, ay, az], [gx, gy, gz]) = (imu.proper_acceleration, imu.angular_velocity);
                let (along, about) = (OFF[3], OFF[4]);
                (
                    [ax, ay, az, gx, gy, gz],
                    [along, along, along, about, about, about],
                    6,
                )
            }
            _ => return,
        };
        self.readings[0] += 1;
        for axis in 0..count {
            let (value, off) = (values[axis], off[axis]);
            // An absent value is none.
            if value < least[axis] - off || value > most[axis] + off {
                self.readings[1] += 1;
                self.first.get_or_insert_with(|| {
                    let fault = present.map(|trouble| trouble.fault);
                    format!(
                        "{name}, t = {t:.4}, {fault:?}: axis {axis} is {value}, and was {} to {}",
                        least[axis], most[axis]
                    )
                });
                return;
            }
        }
    }

    fn finish(mut self) -> Shown {
        let is_silent = |(health, plan): &(DeviceHealth, &DevicePlan)| {
            !plan.outputs.is_empty() && health.state.get() != Some(DeviceState::Streaming)
        };
        let mut silent = Vec::new();
        for (running, plan) in self.buses.iter().zip(&self.plan.buses) {
            let devices = running.status.devices().zip(&plan.devices);
            silent.extend(devices.filter(is_silent).map(|(_, plan)| plan.name.clone()));
        }
        self.kill();
        let (taken, lost) = (self.reader.taken(), self.reader.lost());
        if taken + lost != self.published {
            let published = self.published;
            self.missing.push(format!(
                "{published} samples published, {taken} taken, {lost} lost"
            ));
        }
        let (mut frames, mut added) = (0, 0);
        for end in &self.wires {
            let (passed, under_way) = end.with(|wire| (wire.passed, wire.under_way()));
            frames += passed.delivered;
            added += passed.added;
            if passed.sent + passed.added != passed.lost + passed.delivered + under_way {
                self.missing
                    .push(format!("{passed:?}, {under_way} under way"));
            }
        }
        let has_old = self
            .troubles
            .iter()
            .any(|trouble| trouble.fault == Fault::Old);
        let excused = match (has_old, self.family.drops_old) {
            (true, true) => (TAKEN * added as f64) as u64,
            (true, false) => added,
            (false, _) => 0,
        };
        self.pipeline.finish();
        self.judge();
        let (bus, device) = self.target;
        let channels = &self.plan.channels;
        let is_it = |c: &&ChannelPlan| (c.bus, c.device, c.kind) == (bus, device, self.family.kind);
        let channel = channels.iter().find(is_it);
        let channel = channel.map(|channel| channel.name.clone());
        Shown {
            outcome: self.judge.outcome(self.name, channel),
            readings: self.readings,
            first: self.first,
            missing: self.missing,
            excused,
            frames,
            silent,
            named: self.named,
            valid: self
                .phases
                .map(|[all, valid]| valid as f64 / all.max(1) as f64),
        }
    }
}

fn torques(simulation: &mut Simulation, t: f64) -> Vec<f64> {
    simulation
        .at(t)
        .joints
        .iter()
        .map(|joint| joint.torque)
        .collect()
}
