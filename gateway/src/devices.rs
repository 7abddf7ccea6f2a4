//! All devices of one bus: turns received frames into samples and collects the frames to send. It
//! has no link, clock or sink, so it serves the live gateway and the offline tools alike.

use crate::dispatch::Dispatch;
use crate::inbox::{Replacement, Reply, Request};
use crate::joints::{Joints, ShaftState};
use crate::plan::{BusPlan, DevicePlan, OutputPlan};
use crate::status::BusStatus;
use proprio_drivers::{
    Claim, CommandFailed, Decoded, Device, Frame, Mode, NotSent, SpecError, StampedReading, State,
    Transmit,
};
use proprio_topics::sanity::{LONGEST_COPIES, Repeats};
use proprio_topics::{
    Counter, Header, MAX_CHANNELS, Nanos, Quality, Reading, Sample, StampKind, Wrench,
};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// The devices of one bus, their outputs and counters.
pub struct BusDevices {
    devices: Vec<Running>,
    dispatch: Dispatch,
    channels: Channels,
    /// Number of devices with a request open.
    open: usize,
    decoded: Decoded,
    status: Arc<BusStatus>,
}

struct Running {
    device: Box<dyn Device>,
    outputs: Vec<OutputPlan>,
    request: OpenRequest,
    /// The past of its wrenches, per output.
    repeats: Vec<Repeats<6>>,
}

/// The channels of one bus: from readings to samples.
struct Channels {
    bus: u32,
    joints: Joints,
    /// Stamp of the last main reading per channel that is no joint's.
    last: [Nanos; MAX_CHANNELS],
    /// Channels, no joint's, whose next main reading has ZERO_CHANGED, because their device was
    /// replaced.
    replaced: [bool; MAX_CHANNELS],
    status: Arc<BusStatus>,
}

/// The request of a device that has not been replied to.
enum OpenRequest {
    None,
    /// The command's outcome is waited for.
    Command,
    /// The device stops; this one takes over then.
    Replacement(Replacement),
}

/// The host's side of `device`; `mode`, if given, overrides its mode.
///
/// # Errors
/// [`SpecError`]: a device that its driver cannot build.
pub fn build(device: &DevicePlan, mode: Option<Mode>) -> Result<Box<dyn Device>, SpecError> {
    let mode = mode.unwrap_or(device.spec.mode);
    device.options.device(&device.spec.in_mode(mode))
}

/// The axes whose value is beyond the sensor's full scale, if that is known: bit k for axis k.
fn beyond(wrench: &Wrench, full_scale: Option<[f64; 6]>) -> u16 {
    let values = wrench.force.iter().chain(&wrench.torque);
    let all = values.zip(full_scale.unwrap_or([f64::INFINITY; 6]));
    // Half a step of 16 bits: a value at the end of its range is not beyond it.
    let is_beyond = |(value, most): (&f64, f64)| value.abs() > most * (1.0 + 0.5 / 32768.0);
    (0..).zip(all).fold(0, |mask, (axis, pair)| {
        mask | u16::from(is_beyond(pair)) << axis
    })
}

fn count_faults(status: &BusStatus, number: u16, decoded: &Decoded) {
    for fault in &decoded.faults {
        status.count(number, fault.counter, u64::from(fault.count));
    }
}

impl Channels {
    fn new(bus: u32, joints: Joints, status: Arc<BusStatus>) -> Self {
        Self {
            bus,
            joints,
            last: [Nanos::MIN; MAX_CHANNELS],
            replaced: [false; MAX_CHANNELS],
            status,
        }
    }

    /// Takes a reading of device number `number`; calls `publish` for every sample that it
    /// completes.
    fn take(
        &mut self,
        number: u16,
        running: &mut Running,
        reading: &StampedReading,
        publish: &mut impl FnMut(&mut Sample),
    ) {
        let mut outputs = running.outputs.iter().zip(&mut running.repeats);
        let Some((output, repeats)) = outputs.find(|(o, _)| o.number == reading.output) else {
            return;
        };
        let header = Header {
            acquired: reading.acquired,
            device_time: reading.device_time,
            device_counter: reading.device_counter,
            quality: reading.quality,
            stamp: reading.stamp.in_memory(),
            bus: self.bus,
            ..Header::default()
        };
        if let (Reading::Joint(state), Some(input)) = (reading.reading, &output.input) {
            let complete = |channel, whole: &ShaftState| {
                let header = Header {
                    acquired: whole.acquired,
                    device_time: whole.device_time,
                    device_counter: whole.device_counter,
                    quality: whole.quality,
                    stamp: whole.stamp.in_memory(),
                    ..header
                };
                let state = Reading::Joint(whole.state);
                publish(&mut Sample::new(header, channel, &state));
            };
            let joints = &mut self.joints;
            let taken = joints.push(input, &output.map, reading, state, complete);
            let counter = [Counter::Backward, Counter::Readings][usize::from(taken)];
            self.status.count(number, counter, 1);
            return;
        }
        let Some(mut quality) = self.quality(output, reading) else {
            self.status.count(number, Counter::Backward, 1);
            return;
        };
        if let Reading::Wrench(wrench) = &reading.reading {
            let ([fx, fy, fz], [tx, ty, tz]) = (wrench.force, wrench.torque);
            let frozen = repeats.judge(&[fx, fy, fz, tx, ty, tz], quality, LONGEST_COPIES);
            let beyond = beyond(wrench, running.device.full_scale());
            if frozen != 0 {
                quality |= Quality::FROZEN;
                self.status.count(number, Counter::Frozen, 1);
            }
            if beyond != 0 {
                self.status.count(number, Counter::OutOfRange, 1);
            }
            self.status.set_axes(number, frozen, beyond);
        }
        let header = Header { quality, ..header };
        self.status.count(number, Counter::Readings, 1);
        publish(&mut Sample::new(header, output.channel, &reading.reading));
    }

    /// The flags of a reading that is no joint's state; `None`: it is a main reading whose stamp
    /// runs backward.
    fn quality(&mut self, output: &OutputPlan, reading: &StampedReading) -> Option<Quality> {
        let mut quality = match &output.input {
            Some(input) => self.joints.flags(input, reading.quality),
            None => reading.quality,
        };
        let is_main = reading.reading.kind() == output.kind;
        if is_main && let Some(last) = self.last.get_mut(output.channel as usize) {
            if reading.acquired < *last {
                return None;
            }
            *last = reading.acquired;
            if let Some(replaced) = self.replaced.get_mut(output.channel as usize)
                && std::mem::take(replaced)
            {
                quality |= Quality::GAP_BEFORE | Quality::ZERO_CHANGED;
            }
        }
        Some(quality)
    }

    /// The device of these outputs, or a conversion of theirs, was replaced: the zero may have
    /// changed.
    fn replaced(&mut self, outputs: &[OutputPlan]) {
        for output in outputs {
            if let Some(input) = &output.input {
                self.joints.replaced(input);
            } else if let Some(replaced) = self.replaced.get_mut(output.channel as usize) {
                *replaced = true;
            }
        }
    }
}

impl BusDevices {
    /// Builds the devices of bus number `bus`; `mode`, if given, overrides their mode (with logs,
    /// devices only listen).
    ///
    /// # Errors
    /// [`SpecError`]: a device that its driver cannot build.
    pub fn new(
        bus: u32,
        plan: &BusPlan,
        mode: Option<Mode>,
        status: Arc<BusStatus>,
    ) -> Result<Self, SpecError> {
        let devices = plan
            .devices
            .iter()
            .map(|device| {
                Ok(Running {
                    device: build(device, mode)?,
                    outputs: device.outputs.clone(),
                    request: OpenRequest::None,
                    repeats: vec![Repeats::default(); device.outputs.len()],
                })
            })
            .collect::<Result<Vec<_>, SpecError>>()?;
        let joints = Joints::new(&plan.joints);
        Ok(Self::of(bus, devices, joints, status))
    }

    fn of(bus: u32, devices: Vec<Running>, joints: Joints, status: Arc<BusStatus>) -> Self {
        let dispatch = Dispatch::new(devices.iter().map(|d| d.device.claims()));
        let this = Self {
            devices,
            dispatch,
            channels: Channels::new(bus, joints, Arc::clone(&status)),
            open: 0,
            decoded: Decoded::new(),
            status,
        };
        this.store_states();
        this
    }

    /// The identifiers that the devices claim: the link's filters.
    #[must_use]
    pub fn claims(&self) -> Vec<Claim> {
        let mut claims: Vec<Claim> = self
            .devices
            .iter()
            .flat_map(|d| d.device.claims().iter().copied())
            .collect();
        claims.dedup();
        claims
    }

    /// Processes a frame; calls `publish` for every sample that it completes.
    pub fn on_frame(&mut self, frame: &Frame, mut publish: impl FnMut(&mut Sample)) {
        self.status.frames.fetch_add(1, Relaxed);
        self.status.on_wire(frame);
        self.status.last_frame.store(frame.t.0, Relaxed);
        let mut claimed = false;
        for number in self.dispatch.find(frame.id) {
            claimed = true;
            let Some(running) = self.devices.get_mut(usize::from(number)) else {
                continue;
            };
            self.decoded.clear();
            running.device.on_frame(frame, &mut self.decoded);
            self.status.count(number, Counter::Frames, 1);
            count_faults(&self.status, number, &self.decoded);
            for reading in &self.decoded.readings {
                self.channels.take(number, running, reading, &mut publish);
            }
            self.status.set_state(number, &*running.device);
        }
        if !claimed {
            self.status.unclaimed.fetch_add(1, Relaxed);
        }
    }

    /// Calls `send` for every frame that a device wants to send at `now`, with the device's number
    /// in the plan. [`BusDevices::on_sent`] must follow for each; until then that device sends
    /// nothing else.
    pub fn poll_transmit(&mut self, now: Nanos, mut send: impl FnMut(u16, &Transmit)) {
        for (running, number) in self.devices.iter_mut().zip(0_u16..) {
            if running.device.next_wake().is_none_or(|wake| wake > now) {
                continue;
            }
            self.decoded.clear();
            if let Some(transmit) = running.device.poll_transmit(now, &mut self.decoded) {
                send(number, &transmit);
            }
            count_faults(&self.status, number, &self.decoded);
            self.status.set_state(number, &*running.device);
        }
    }

    /// What became of `frame` of device number `device`: when the interface took it \[ns\], or why
    /// it did not.
    pub fn on_sent(&mut self, device: u16, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        let Some(running) = self.devices.get_mut(usize::from(device)) else {
            return;
        };
        running.device.on_sent(frame, outcome);
        if let Ok(t) = outcome {
            let sent = frame.at(t, StampKind::Software);
            let others = self.devices.iter_mut().zip(0_u16..);
            for (other, number) in others.filter(|(_, number)| *number != device) {
                self.decoded.clear();
                other.device.overhear(&sent, &mut self.decoded);
                count_faults(&self.status, number, &self.decoded);
            }
        }
        if outcome.is_err() {
            self.status.count(device, Counter::Unsent, 1);
        }
        if let Some(running) = self.devices.get(usize::from(device)) {
            self.status.set_state(device, &*running.device);
        }
    }

    /// The earliest instant at which a device must be polled.
    #[must_use]
    pub fn next_wake(&self) -> Option<Nanos> {
        self.devices
            .iter()
            .filter_map(|d| d.device.next_wake())
            .min()
    }

    /// Restarts every device after a link loss.
    pub fn restart(&mut self, now: Nanos) {
        for running in &mut self.devices {
            running.device.restart(now);
        }
        self.store_states();
    }

    /// Passes a request to device number `number` at `now`. Returns the reply, unless
    /// [`BusDevices::settle`] gives it later.
    #[must_use]
    pub fn request(&mut self, number: u16, request: Request, now: Nanos) -> Option<Reply> {
        let running = self.devices.get_mut(usize::from(number))?;
        match request {
            Request::Command { until, .. } if now > until => {
                return Some(Reply::Ended(Err(CommandFailed::NotSent)));
            }
            Request::Command { command, .. } => match running.device.command(command, now) {
                Ok(()) => running.request = OpenRequest::Command,
                Err(refused) => return Some(Reply::Refused(refused)),
            },
            Request::Replace(replacement) if replacement.device.is_some() => {
                running.device.stop(now);
                running.request = OpenRequest::Replacement(replacement);
            }
            Request::Replace(replacement) => {
                running.device.set_max_silence(replacement.max_silence);
                return Some(self.replace(number, replacement));
            }
        }
        self.open += 1;
        None
    }

    /// Calls `reply` for every request that has ended, with the number of its device. `up` says
    /// whether the link is up: over a link that is not, no device can stop its board.
    pub fn settle(&mut self, up: bool, mut reply: impl FnMut(u16, Reply)) {
        if self.open == 0 {
            return;
        }
        for number in 0_u16.. {
            let Some(running) = self.devices.get_mut(usize::from(number)) else {
                return;
            };
            let ended = match std::mem::replace(&mut running.request, OpenRequest::None) {
                OpenRequest::None => continue,
                OpenRequest::Command => running
                    .device
                    .outcome()
                    .map(Reply::Ended)
                    .ok_or(OpenRequest::Command),
                OpenRequest::Replacement(new) if up && running.device.state() != State::Stopped => {
                    Err(OpenRequest::Replacement(new))
                }
                OpenRequest::Replacement(new) => Ok(self.replace(number, new)),
            };
            match ended {
                Ok(ended) => {
                    self.open -= 1;
                    reply(number, ended);
                }
                Err(open) => {
                    if let Some(running) = self.devices.get_mut(usize::from(number)) {
                        running.request = open;
                    }
                }
            }
        }
    }

    /// Puts `new` in the place of what device number `number` has.
    fn replace(&mut self, number: u16, mut new: Replacement) -> Reply {
        if let Some(running) = self.devices.get_mut(usize::from(number)) {
            if new.device.is_some() || new.outputs != running.outputs {
                self.channels.replaced(&new.outputs);
            }
            for input in new
                .outputs
                .iter()
                .filter_map(|output| output.input.as_ref())
            {
                self.channels.joints.set_max_silence(input, new.max_silence);
            }
            if let Some(device) = &mut new.device {
                std::mem::swap(device, &mut running.device);
                running.repeats.fill(Repeats::default());
            }
            std::mem::swap(&mut new.outputs, &mut running.outputs);
            self.status.set_state(number, &*running.device);
        }
        Reply::Replaced(new)
    }

    /// Begins to stop all devices.
    pub fn stop(&mut self, now: Nanos) {
        for running in &mut self.devices {
            running.device.stop(now);
        }
        self.store_states();
    }

    /// Whether every device has stopped.
    #[must_use]
    pub fn stopped(&self) -> bool {
        self.devices
            .iter()
            .all(|d| d.device.state() == State::Stopped)
    }

    /// The devices' states, in the order of the plan.
    pub fn states(&self) -> impl Iterator<Item = State> + '_ {
        self.devices.iter().map(|d| d.device.state())
    }

    fn store_states(&self) {
        for (running, number) in self.devices.iter().zip(0..) {
            self.status.set_state(number, &*running.device);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;
    use proprio_drivers::Id;
    use std::path::Path;

    /// A participant of the bus without an output: it sends one frame every 10 ms, and counts the
    /// answers.
    struct Master {
        claims: [Claim; 1],
        next: Nanos,
        under_way: bool,
        answers: u32,
        stopped: bool,
    }

    impl Device for Master {
        fn claims(&self) -> &[Claim] {
            &self.claims
        }

        fn on_frame(&mut self, frame: &Frame, out: &mut Decoded) {
            self.answers += 1;
            out.fault(Counter::Unexpected, self.answers - 1, frame.id);
        }

        fn poll_transmit(&mut self, now: Nanos, _out: &mut Decoded) -> Option<Transmit> {
            if self.under_way || self.stopped || now < self.next {
                return None;
            }
            self.under_way = true;
            Some(Transmit {
                frame: Frame::new(Id::standard(0x80), &[]),
                deadline: now + Nanos::from_millis(10),
            })
        }

        fn on_sent(&mut self, _frame: &Frame, outcome: Result<Nanos, NotSent>) {
            self.under_way = false;
            if let Ok(t) = outcome {
                self.next = t + Nanos::from_millis(10);
            }
        }

        fn next_wake(&self) -> Option<Nanos> {
            (!self.under_way && !self.stopped).then_some(self.next)
        }

        fn state(&self) -> State {
            if self.stopped {
                State::Stopped
            } else {
                State::Streaming
            }
        }

        fn stop(&mut self, _now: Nanos) {
            self.stopped = true;
        }

        fn restart(&mut self, now: Nanos) {
            self.next = now;
        }

        fn set_max_silence(&mut self, _max_silence: Nanos) {}
    }

    #[test]
    fn a_device_without_an_output_takes_part_in_the_bus() {
        let plan = Plan::parse(
            "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
             source = { kind = \"virtual\", name = \"b\" }\n[[bus.device]]\nname = \"master\"\n\
             driver = \"icub_imu\"\naddress = 1",
            Path::new("."),
        )
        .unwrap();
        let status = Arc::new(BusStatus::new(0, &plan.buses[0]));
        let answer = Id::standard(0x701);
        let running = Running {
            device: Box::new(Master {
                claims: [Claim::exclusive(answer)],
                next: Nanos::ZERO,
                under_way: false,
                answers: 0,
                stopped: false,
            }),
            outputs: Vec::new(),
            request: OpenRequest::None,
            repeats: Vec::new(),
        };
        let mut devices = BusDevices::of(0, vec![running], Joints::default(), Arc::clone(&status));
        assert_eq!(devices.claims(), [Claim::exclusive(answer)]);
        let count = |counter: Counter| status.devices().next().unwrap().counters[counter as usize];
        let sent = |devices: &mut BusDevices, now| {
            let mut sent = Vec::new();
            devices.poll_transmit(now, |device, t| sent.push((device, t.frame)));
            sent
        };
        let sync = Frame::new(Id::standard(0x80), &[]);
        assert_eq!(sent(&mut devices, Nanos::ZERO), [(0, sync)]);
        assert_eq!(sent(&mut devices, Nanos::ZERO), [], "it is under way");
        assert_eq!(devices.next_wake(), None);
        devices.on_sent(0, &sync, Err(NotSent::Refused));
        assert_eq!(count(Counter::Unsent), 1);
        assert_eq!(sent(&mut devices, Nanos::ZERO), [(0, sync)]);
        devices.on_sent(0, &sync, Ok(Nanos(5)));
        assert_eq!(count(Counter::Unsent), 1);
        assert_eq!(devices.next_wake(), Some(Nanos(5) + Nanos::from_millis(10)));
        for _ in 0..2 {
            let heartbeat = Frame::new(answer, &[5]);
            devices.on_frame(&heartbeat, |sample| panic!("{sample:?}"));
        }
        assert_eq!((count(Counter::Frames), count(Counter::Readings)), (2, 0));
        assert_eq!(count(Counter::Unexpected), 1);
        devices.stop(Nanos::ZERO);
        assert!(devices.stopped());
        // Its plan can be shown, and its health has a name.
        let mut plan = plan;
        plan.channels.clear();
        plan.buses[0].devices[0].outputs.clear();
        assert!(plan.to_string().contains("master"), "{plan}");
        assert_eq!(status.devices().next().unwrap().name.as_str(), "master");
    }
}
