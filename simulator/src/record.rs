//! Records the simulated robot without any link: writes a whole session, including the host's
//! commands, to a CAN log as fast as possible, and its truth as a table.

use crate::robot::SimulatedRobot;
use crate::settings::SimulationSettings;
use crate::simulator::{BusCounts, BusSimulator, Simulator, SimulatorError};
use crate::truth::Simulation;
use proprio_drivers::{Frame, State};
use proprio_gateway::devices::BusDevices;
use proprio_gateway::log::candump::write_log_line;
use proprio_gateway::plan::BusPlan;
use proprio_gateway::status::BusStatus;
use proprio_topics::{Nanos, StampKind};
use std::collections::VecDeque;
use std::io::{self, Write};
use std::sync::Arc;

/// Approximate duration of a frame on a bus at 1 Mbit/s: the minimum interval between frames of one
/// bus in a log.
const FRAME_TIME: Nanos = Nanos::from_micros(130);

/// Why a session cannot be recorded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The robot cannot be simulated with these settings.
    #[error(transparent)]
    Simulator(#[from] SimulatorError),
    /// A device cannot be built.
    #[error("bus {bus:?}: {cause}")]
    Device {
        /// Its bus.
        bus: String,
        /// Why.
        cause: proprio_drivers::SpecError,
    },
    /// The log could not be written.
    #[error("the log cannot be written")]
    Io(#[from] io::Error),
}

/// The counts of a recorded session, per bus.
#[derive(Debug, Clone)]
pub struct Recorded {
    /// Frames that the boards sent.
    pub sent: u64,
    /// Frames that the host sent to them.
    pub commands: u64,
    /// The boards' counters.
    pub counts: BusCounts,
    /// The states of the host's devices at the end.
    pub states: Vec<State>,
}

/// Records `seconds` of the robot from `t0` on as a candump log: its boards, and a gateway's host
/// side that starts them.
///
/// The interface in the log is the bus's configured one, or the bus's name for a replayed one.
///
/// # Errors
/// [`RecordError`].
pub fn record(
    robot: &SimulatedRobot,
    settings: &SimulationSettings,
    seconds: f64,
    t0: Nanos,
    mut log: impl Write,
) -> Result<Vec<Recorded>, RecordError> {
    let mut simulator = Simulator::new(robot, settings, t0)?;
    let end = t0 + Nanos::from_seconds(seconds);
    let mut hosts = Vec::new();
    for (plan, number) in robot.plan.buses.iter().zip(0..) {
        hosts.push(Host::new(plan, number)?);
    }
    let mut waiting = FrameQueue::default();
    let mut now = t0;
    while now < end {
        for (bus, host) in hosts.iter_mut().enumerate() {
            let mut commands = Vec::new();
            host.devices
                .poll_transmit(now, |device, t| commands.push((device, t.frame)));
            for (device, command) in commands {
                host.devices.on_sent(device, &command, Ok(now));
                let command = host.transfer(command, now);
                host.commands += 1;
                simulator.on_frame(bus, &command, now);
                waiting.push(bus, command);
            }
        }
        while let Some((bus, frame)) = simulator.poll(now) {
            let Some(host) = hosts.get_mut(bus) else {
                continue;
            };
            let frame = host.transfer(frame, now);
            host.sent += 1;
            host.devices.on_frame(&frame, |_| {});
            waiting.push(bus, frame);
        }
        waiting.write_until(now, &hosts, &mut log)?;
        let wakes = hosts
            .iter()
            .filter_map(|h| h.devices.next_wake())
            .chain(simulator.next_wake());
        // A device that must be called at once is answering an event: the next nanosecond is early
        // enough.
        now = wakes.min().unwrap_or(end).max(now + Nanos(1));
    }
    waiting.write_until(Nanos::MAX, &hosts, &mut log)?;
    log.flush()?;
    let counts = simulator.buses().iter().map(BusSimulator::counts);
    Ok(hosts
        .iter()
        .zip(counts)
        .map(|(host, counts)| Recorded {
            sent: host.sent,
            commands: host.commands,
            counts,
            states: host.devices.states().collect(),
        })
        .collect())
}

/// Frames with the numbers of their buses, sorted by stamp: a frame that waits for its bus may be
/// later than the next one of another bus.
#[derive(Default)]
struct FrameQueue(VecDeque<(usize, Frame)>);

impl FrameQueue {
    fn push(&mut self, bus: usize, frame: Frame) {
        let before = self.0.iter().rposition(|(_, other)| other.t <= frame.t);
        self.0.insert(before.map_or(0, |i| i + 1), (bus, frame));
    }

    /// Writes the frames that are stamped until `now` to the log.
    fn write_until(
        &mut self,
        now: Nanos,
        hosts: &[Host<'_>],
        log: &mut impl Write,
    ) -> io::Result<()> {
        while let Some((bus, frame)) = self.0.front()
            && frame.t <= now
        {
            let interface = hosts.get(*bus).map_or("can0", |h| h.interface);
            write_log_line(&mut *log, frame.t, interface, frame)?;
            self.0.pop_front();
        }
        Ok(())
    }
}

/// The gateway's side of a bus.
struct Host<'a> {
    devices: BusDevices,
    interface: &'a str,
    /// Time when the bus is free again.
    free: Nanos,
    sent: u64,
    commands: u64,
}

impl<'a> Host<'a> {
    fn new(plan: &'a BusPlan, number: u32) -> Result<Self, RecordError> {
        let status = Arc::new(BusStatus::new(number, plan));
        let devices = BusDevices::new(number, plan, None, status);
        Ok(Self {
            devices: devices.map_err(|cause| RecordError::Device {
                bus: plan.name.clone(),
                cause,
            })?,
            interface: plan.interface(),
            free: Nanos::MIN,
            sent: 0,
            commands: 0,
        })
    }

    /// The frame with its time of arrival, after the earlier frames.
    fn transfer(&mut self, frame: Frame, now: Nanos) -> Frame {
        // Whole microseconds, as candump writes them: some versions of canplayer read only these.
        let t = now.max(self.free);
        let t = Nanos(t.0 + (1000 - t.0.rem_euclid(1000)) % 1000);
        self.free = t + FRAME_TIME;
        frame.at(t, StampKind::Log)
    }
}

/// Writes the truth as a table, one row every `period` from `t0` to `until`; returns the number of
/// rows.
///
/// The columns are those of a sample log, velocities, accelerations and torques included, and the
/// wrench of every contact: `contact/<name>/fx fy fz tx ty tz` \[N, Nm\], exerted by the
/// environment on the link, in the contact's frame. F/T readings contain their offset; there is no
/// noise.
///
/// # Errors
/// If `out` cannot be written.
pub fn write_truth(
    simulation: &mut Simulation,
    t0: Nanos,
    until: Nanos,
    period: Nanos,
    mut out: impl Write,
) -> io::Result<u64> {
    let mut line = Vec::with_capacity(2048);
    line.push(b't');
    for name in simulation.joint_names() {
        for part in ["position", "velocity", "acceleration", "torque"] {
            write!(line, ",joint/{name}/{part}")?;
        }
    }
    const WRENCH: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];
    for name in simulation.wrench_names() {
        for part in WRENCH {
            write!(line, ",wrench/{name}/{part}")?;
        }
    }
    for name in simulation.imu_names() {
        for part in ["ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz"] {
            write!(line, ",imu/{name}/{part}")?;
        }
    }
    for name in simulation.contact_names() {
        for part in WRENCH {
            write!(line, ",contact/{name}/{part}")?;
        }
    }
    let (mut now, mut rows) = (t0, 0);
    let mut number = zmij::Buffer::new();
    while now <= until {
        line.push(b'\n');
        out.write_all(&line)?;
        line.clear();
        write!(line, "{now}")?;
        let mut cell = |value: f64| {
            line.push(b',');
            line.extend_from_slice(number.format(value).as_bytes());
        };
        let truth = simulation.at((now - t0).seconds());
        for joint in &truth.joints {
            [
                joint.position,
                joint.velocity,
                joint.acceleration,
                joint.torque,
            ]
            .into_iter()
            .for_each(&mut cell);
        }
        truth.wrenches.iter().flatten().copied().for_each(&mut cell);
        for imu in &truth.imus {
            let parts = [
                imu.proper_acceleration,
                imu.angular_velocity,
                imu.angular_acceleration,
            ];
            parts.into_iter().flatten().for_each(&mut cell);
        }
        truth.contacts.iter().flatten().copied().for_each(&mut cell);
        rows += 1;
        now += period;
    }
    line.push(b'\n');
    out.write_all(&line)?;
    out.flush()?;
    Ok(rows)
}
