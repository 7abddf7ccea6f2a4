//! All devices of one bus: turns received frames into samples and collects the frames to send. It
//! has no link, clock or sink, so it serves the live gateway and the offline tools alike.

use crate::plan::{BusPlan, Route};
use crate::status::BusStatus;
use proprio_drivers::{
    Claim, Decoded, Device, Frame, Id, Mode, NotSent, SpecError, State, Transmit,
};
use proprio_topics::{Counter, Header, MAX_CHANNELS, Nanos, Reading, Sample};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// The devices of one bus, their routes and counters.
pub struct Decoder {
    bus: u32,
    devices: Vec<Running>,
    dispatch: Dispatch,
    /// Stamp of the last main reading per channel.
    last: [Nanos; MAX_CHANNELS],
    decoded: Decoded,
    status: Arc<BusStatus>,
}

struct Running {
    device: Box<dyn Device>,
    routes: Vec<Route>,
}

impl Decoder {
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
                let mut spec = device.spec.clone();
                spec.mode = mode.unwrap_or(spec.mode);
                Ok(Running {
                    device: device.options.device(&spec)?,
                    routes: device.routes.clone(),
                })
            })
            .collect::<Result<Vec<_>, SpecError>>()?;
        let dispatch = Dispatch::new(devices.iter().map(|d| d.device.claims()));
        let last = [Nanos::MIN; MAX_CHANNELS];
        let this = Self {
            bus,
            devices,
            dispatch,
            last,
            decoded: Decoded::new(),
            status,
        };
        this.store_states();
        Ok(this)
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
        self.status.last_frame.store(frame.t.0, Relaxed);
        let mut claimed = false;
        // Iterates over a copy of the device numbers (at most four), so that the dispatch table is
        // not borrowed while a device runs.
        for number in self.dispatch.find(frame.id) {
            claimed = true;
            let Some(running) = self.devices.get_mut(usize::from(number)) else {
                continue;
            };
            self.decoded.clear();
            running.device.on_frame(frame, &mut self.decoded);
            self.status.count(number, Counter::Frames, 1);
            for fault in &self.decoded.faults {
                self.status
                    .count(number, fault.counter, u64::from(fault.count));
            }
            for output in &self.decoded.readings {
                let Some(route) = running.routes.iter().find(|r| r.output == output.output) else {
                    continue;
                };
                let main = output.reading.kind() == route.kind;
                if main && let Some(last) = self.last.get_mut(route.channel as usize) {
                    if output.acquired < *last {
                        self.status.count(number, Counter::Backward, 1);
                        continue;
                    }
                    *last = output.acquired;
                }
                let reading = match output.reading {
                    Reading::Joint(state) => Reading::Joint(route.map.joint(state)),
                    other => other,
                };
                let header = Header {
                    acquired: output.acquired,
                    device_time: output.device_time,
                    device_counter: output.device_counter,
                    quality: output.quality,
                    stamp: output.stamp.in_memory(),
                    bus: self.bus,
                    ..Header::default()
                };
                self.status.count(number, Counter::Readings, 1);
                publish(&mut Sample::new(header, route.channel, &reading));
            }
            self.status.set_state(number, running.device.state());
        }
        if !claimed {
            self.status.unclaimed.fetch_add(1, Relaxed);
        }
    }

    /// Calls `send` for every frame that a device wants to send at `now`, with the device's number.
    pub fn poll_transmit(&mut self, now: Nanos, mut send: impl FnMut(u16, &Transmit)) {
        for (running, number) in self.devices.iter_mut().zip(0_u16..) {
            if running.device.next_wake().is_none_or(|wake| wake > now) {
                continue;
            }
            self.decoded.clear();
            // A device sends a few frames at once; the limit keeps a faulty one from blocking the
            // loop.
            for _ in 0..64 {
                let Some(transmit) = running.device.poll_transmit(now, &mut self.decoded) else {
                    break;
                };
                send(number, &transmit);
            }
            for fault in &self.decoded.faults {
                self.status
                    .count(number, fault.counter, u64::from(fault.count));
            }
            self.status.set_state(number, running.device.state());
        }
    }

    /// Tells device number `device` what became of a frame of it: when it was sent \[ns\], or why
    /// it was not.
    pub fn on_sent(&mut self, device: u16, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        if outcome.is_err() {
            self.status.count(device, Counter::Unsent, 1);
        }
        if let Some(running) = self.devices.get_mut(usize::from(device)) {
            running.device.on_sent(frame, outcome);
            self.status.set_state(device, running.device.state());
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
            self.status.set_state(number, running.device.state());
        }
    }
}

/// The devices that receive each identifier: a table for the 2048 standard identifiers, a list for
/// the extended ones.
struct Dispatch {
    /// Per standard identifier, at most [`SHARERS`] device numbers.
    standard: Vec<arrayvec::ArrayVec<u16, SHARERS>>,
    extended: Vec<(Claim, u16)>,
}

/// Maximum number of devices that receive one identifier: those of one board.
const SHARERS: usize = 4;

impl Dispatch {
    fn new<'a>(claims: impl Iterator<Item = &'a [Claim]>) -> Self {
        let mut this = Self {
            standard: vec![arrayvec::ArrayVec::new(); 2048],
            extended: Vec::new(),
        };
        for (claims, device) in claims.zip(0_u16..) {
            for claim in claims {
                match claim.id {
                    Id::Extended(_) => this.extended.push((*claim, device)),
                    Id::Standard(_) => {
                        for (devices, id) in this.standard.iter_mut().zip(0_u16..) {
                            if claim.matches(Id::Standard(id)) && !devices.contains(&device) {
                                // A fifth listener of one board is not served; no supported board
                                // has more than four.
                                let _ = devices.try_push(device);
                            }
                        }
                    }
                }
            }
        }
        this
    }

    fn find(&self, id: Id) -> arrayvec::ArrayVec<u16, SHARERS> {
        match id {
            Id::Standard(id) => self
                .standard
                .get(usize::from(id))
                .cloned()
                .unwrap_or_default(),
            Id::Extended(_) => {
                let mut found = arrayvec::ArrayVec::new();
                for (claim, device) in &self.extended {
                    if claim.matches(id) && !found.contains(device) {
                        let _ = found.try_push(*device);
                    }
                }
                found
            }
        }
    }
}
