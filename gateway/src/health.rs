//! The health message, and what of it becomes a line of the log: changes of state and the first of
//! a run of problems, never every frame.

use crate::clock::realtime_offset;
use crate::link::error_frame::ErrorFrame;
use crate::load::{BitRates, BusLoad, Meter};
use crate::plan::{BusPlan, Plan};
use crate::status::BusStatus;
use proprio_topics::{
    BusError, BusHealth, Controller, Counter, DeviceHealth, DeviceState, GatewayHealth,
    InterfaceHealth, LinkState, MAX_CHANNELS, Nanos, Refusal, axes,
};

/// Fills the health message from the counters of the buses and what is known of their interfaces.
pub(crate) fn fill_health(
    health: &mut GatewayHealth,
    buses: &[&BusStatus],
    interfaces: &[InterfaceHealth],
) {
    health.realtime_offset = realtime_offset();
    (health.bus_count, health.device_count) = (0, 0);
    for (i, (slot, status)) in health.buses.iter_mut().zip(buses).enumerate() {
        *slot = BusHealth {
            // As they were measured last: see `Loads`.
            load: slot.load,
            frame_rate: slot.frame_rate,
            interface: interfaces.get(i).copied().unwrap_or_default(),
            ..status.bus()
        };
        // A gateway that is started on a bus-off controller receives no error frame that says so.
        if slot.link == LinkState::NoCarrier && slot.interface.controller == Controller::BusOff {
            slot.link = LinkState::BusOff.in_memory();
        }
        health.bus_count += 1;
    }
    for (slot, device) in health
        .devices
        .iter_mut()
        .zip(buses.iter().flat_map(|b| b.devices()))
    {
        *slot = device;
        health.device_count += 1;
    }
    health.newest = [Nanos::MIN; MAX_CHANNELS];
    for status in buses {
        for (slot, newest) in health.newest.iter_mut().zip(status.newest()) {
            *slot = newest.max(*slot);
        }
    }
}

/// Measures the loads of all buses.
pub(crate) struct Loads(Vec<(Meter, Option<BitRates>)>);

impl Loads {
    /// For the buses of `plan`, with the bit rates that it states.
    pub(crate) fn new(plan: &Plan) -> Self {
        let stated = |bus: &BusPlan| (!bus.rates_assumed).then_some(bus.rates);
        let buses = plan.buses.iter();
        Self(buses.map(|bus| (Meter::new(), stated(bus))).collect())
    }

    /// Writes the loads until `now` into `health`, which has been filled from `buses`.
    pub(crate) fn measure(&mut self, health: &mut GatewayHealth, buses: &[&BusStatus], now: Nanos) {
        let slots = health.buses.iter_mut().zip(buses);
        for ((slot, status), (meter, stated)) in slots.zip(&mut self.0) {
            let interface = &slot.interface;
            let mut totals = status.totals();
            // A virtual interface has no bit rate, and counts what it sends as received, too. How
            // many bits of CAN FD are sent at which rate, its totals do not tell.
            if interface.bit_rate > 0 && interface.fd == 0 {
                totals.all_frames = interface.rx_frames + interface.tx_frames;
                totals.all_bytes = interface.rx_bytes + interface.tx_bytes;
            }
            let known = |rate: u32, other: Option<u32>| match rate {
                0 => other,
                rate => Some(rate),
            };
            let nominal = known(interface.bit_rate, stated.map(|rates| rates.nominal));
            let data = known(interface.data_bit_rate, stated.map(|rates| rates.data));
            let rates = nominal.map(|nominal| BitRates {
                nominal,
                data: data.unwrap_or(nominal),
            });
            let load = meter.measure(now, totals, rates);
            (slot.load, slot.frame_rate) = (load.share, load.frames);
        }
    }
}

/// The ticks since something last happened, which tell the first of a run from its others.
#[derive(Clone, Copy)]
struct Run(u32);

impl Run {
    /// After this many ticks without it, the next one begins a new run: 5 s.
    const REST: u32 = 50;
    /// No run yet.
    const NONE: Self = Self(Self::REST);

    /// To be called at every tick with whether it happened; returns whether a run begins.
    fn begins(&mut self, happened: bool) -> bool {
        let begins = happened && self.0 >= Self::REST;
        self.0 = if happened {
            0
        } else {
            (self.0 + 1).min(Self::REST)
        };
        begins
    }

    /// Whether it has not happened for long enough to begin anew.
    const fn is_over(self) -> bool {
        self.0 >= Self::REST
    }
}

/// The ticks for which a device has been silent or refused, and when that is told again.
#[derive(Clone, Copy)]
struct Trouble {
    ticks: u32,
    again: u32,
}

impl Trouble {
    /// It is told again after one minute, two, four and so on, ...
    const FIRST: u32 = 600;
    /// ... and at last once an hour: a person who looks at the end of a log must find it.
    const MOST: u32 = 36_000;

    const BEGUN: Self = Self {
        ticks: 0,
        again: Self::FIRST,
    };

    /// To be called at every tick; returns whether it is to be told again.
    fn goes_on(&mut self) -> bool {
        self.ticks = self.ticks.saturating_add(1);
        let due = self.ticks >= self.again;
        if due {
            self.again = self.ticks.saturating_add(self.ticks.min(Self::MOST));
        }
        due
    }

    fn seconds(self) -> u32 {
        self.ticks / 10
    }
}

/// What has been told of a device.
#[derive(Clone, Copy)]
struct DeviceRuns {
    faults: [Run; Counter::ALL.len()],
    trouble: Option<Trouble>,
    /// It was told that axes are frozen, or beyond the full scale.
    doubted: [bool; 2],
}

/// Turns health into log lines.
#[derive(Default)]
pub(crate) struct HealthLog {
    last: Option<Box<GatewayHealth>>,
    devices: Vec<DeviceRuns>,
    buses: Vec<BusRuns>,
}

/// The runs of problems of one bus.
#[derive(Clone, Copy)]
struct BusRuns {
    dropped: Run,
    /// It was told that the bus is nearly full.
    full: bool,
    errors: [Run; BusError::ALL.len()],
    /// Ticks for which nothing could be sent because the link's queue was full.
    blocked: u32,
}

/// The increase of a counter that starts again at zero with its program.
const fn increase(now: u64, before: Option<u64>) -> u64 {
    match before {
        Some(before) if before <= now => now - before,
        _ => now,
    }
}

impl HealthLog {
    /// Logs what has changed since the last call; `statuses` are those of the health's buses.
    pub(crate) fn log_changes(&mut self, health: &GatewayHealth, statuses: &[&BusStatus]) {
        let last = self.last.replace(Box::new(*health));
        self.log_buses(health, last.as_deref(), statuses);
        self.log_devices(health, last.as_deref());
    }

    fn log_buses(
        &mut self,
        health: &GatewayHealth,
        last: Option<&GatewayHealth>,
        statuses: &[&BusStatus],
    ) {
        let none = BusRuns {
            dropped: Run::NONE,
            full: false,
            errors: [Run::NONE; BusError::ALL.len()],
            blocked: 0,
        };
        self.buses.resize(health.buses().len(), none);
        for (i, (bus, runs)) in health.buses().iter().zip(&mut self.buses).enumerate() {
            let before = last.and_then(|l| l.buses().get(i));
            let name = bus.name.as_str();
            let was = before.map_or(LinkState::Up.in_memory(), |b| b.link);
            if bus.link != was {
                match bus.link.get().unwrap_or_default() {
                    LinkState::Up => tracing::info!(bus = name, "the link is up again"),
                    LinkState::Ended => {
                        tracing::info!(bus = name, frames = bus.frames, "the log has ended");
                    }
                    LinkState::BusOff
                        if bus.interface.controller != Controller::Unknown
                            && bus.interface.restart_ms == 0 =>
                    {
                        tracing::error!(
                            bus = name,
                            "the link is bus_off, until a person restarts the controller (`ip link \
                             set INTERFACE type can restart`): it has no restart-ms"
                        );
                    }
                    state => tracing::error!(
                        bus = name,
                        "the link is {}; waiting for it to come back",
                        state.word()
                    ),
                }
            }
            log_controller(bus, before);
            log_load(bus, &mut runs.full);
            log_blocked(bus, before, &mut runs.blocked);
            // One frame may report several causes: it is told once.
            let mut reported: Vec<ErrorFrame> = Vec::new();
            for (cause, run) in BusError::ALL.into_iter().zip(&mut runs.errors) {
                let total = |b: &BusHealth| b.errors.get(cause as usize).copied();
                let count = total(bus).unwrap_or(0);
                if run.begins(increase(count, before.and_then(total)) > 0)
                    && let Some(frame) = statuses.get(i).and_then(|s| s.newest_error(cause))
                    && !reported.contains(&frame)
                {
                    reported.push(frame);
                    tracing::warn!(
                        bus = name,
                        "error frame: {frame} (further ones are only counted, in health)"
                    );
                }
            }
            let dropped = increase(bus.dropped, before.map(|b| b.dropped));
            if runs.dropped.begins(dropped > 0) {
                tracing::warn!(
                    bus = name,
                    dropped,
                    "frames were lost: the receive buffer of the kernel or of the controller was \
                     full"
                );
            }
        }
    }

    fn log_devices(&mut self, health: &GatewayHealth, last: Option<&GatewayHealth>) {
        let none = DeviceRuns {
            faults: [Run::NONE; Counter::ALL.len()],
            trouble: None,
            doubted: [false; 2],
        };
        self.devices.resize(health.devices().len(), none);
        for (i, (device, runs)) in health.devices().iter().zip(&mut self.devices).enumerate() {
            let before = last.and_then(|l| l.devices().get(i));
            let name = device.name.as_str();
            log_state(device, before, &mut runs.trouble);
            log_doubts(device, before, runs);
            let runs = &mut runs.faults;
            for (counter, run) in Counter::ALL.into_iter().zip(runs).filter(|(c, _)| {
                use Counter::{Frames, Frozen, OutOfRange, Readings, Starts};
                !matches!(c, Frames | Frozen | OutOfRange | Readings | Starts)
            }) {
                let count = device.count(counter);
                let new = increase(count, before.map(|b| b.count(counter)));
                // Who joins a stream hears parts of groups that began before.
                let joins = before.is_none_or(|b| b.state != DeviceState::Streaming);
                if joins && counter == Counter::Unpaired {
                    continue;
                }
                // A silence that goes on has been told by the state.
                let is_told = counter == Counter::Silences && device.state == DeviceState::Silent;
                if run.begins(new > 0) && !is_told {
                    tracing::warn!(
                        device = name,
                        total = count,
                        "{}: {new} (further ones are only counted, in health)",
                        counter.word()
                    );
                }
            }
        }
    }
}

/// Logs a device that begins to stream, falls silent, is refused or stops, and from time to time
/// one that is still silent or refused. The steps of its bring-up are told only at first.
fn log_state(device: &DeviceHealth, before: Option<&DeviceHealth>, trouble: &mut Option<Trouble>) {
    let name = device.name.as_str();
    let state = device.state.get().unwrap_or_default();
    let changed = before.is_none_or(|b| (b.state, b.refusal) != (device.state, device.refusal));
    let again = trouble.as_mut().is_some_and(Trouble::goes_on);
    let since = trouble.map_or_else(String::new, |t| format!(" for {} s", t.seconds()));
    match (Refusal::from_code(device.refusal), state) {
        (Some(lack), DeviceState::Streaming) => {
            *trouble = None;
            if changed {
                tracing::warn!(device = name, "streaming, but without a value: {lack}");
            }
        }
        (Some(refusal), _) => {
            if changed {
                tracing::error!(device = name, "refused: {refusal}");
            } else if again {
                tracing::warn!(device = name, "still refused{since}: {refusal}");
            }
            trouble.get_or_insert(Trouble::BEGUN);
        }
        (None, DeviceState::Silent) => {
            if changed || again {
                let still = if changed { "" } else { "still " };
                tracing::warn!(device = name, "{still}silent{since}: {}", remedy(device));
            }
            trouble.get_or_insert(Trouble::BEGUN);
        }
        (None, DeviceState::Streaming) if changed => {
            let after = trouble
                .take()
                .map_or_else(String::new, |t| format!(", after {} s", t.seconds()));
            tracing::info!(device = name, "streaming{after}");
        }
        (None, state) => {
            if changed && (before.is_none() || state == DeviceState::Stopped) {
                tracing::info!(device = name, "{}", state.word());
            }
        }
    }
}

/// Logs when a sensor begins to send values that cannot be true, and when it has ended for 5 s.
fn log_doubts(device: &DeviceHealth, before: Option<&DeviceHealth>, runs: &mut DeviceRuns) {
    let name = device.name.as_str();
    let doubts = [
        (
            Counter::Frozen,
            device.frozen_axes,
            "repeats itself, although its noise made that impossible: its readings are marked \
             frozen. Check the sensor's cable, its temperature, and whether a gauge is saturated \
             (too much load, an offset far from zero); switch its board off and on",
        ),
        (
            Counter::OutOfRange,
            device.beyond_axes,
            "is beyond the sensor's full scale: the value is doubtful. Check the load, the offset \
             (`proprio ctl calibration` shows the full scale), and full_scale_n and full_scale_nm \
             in gateway.toml",
        ),
    ];
    for ((counter, mask, what), doubted) in doubts.into_iter().zip(&mut runs.doubted) {
        let new = increase(device.count(counter), before.map(|b| b.count(counter)));
        let Some(run) = runs.faults.get_mut(counter as usize) else {
            continue;
        };
        if run.begins(mask != 0 || new > 0) {
            *doubted = true;
            // It may have ended before this look at it.
            let which = match mask {
                0 => "a value".to_owned(),
                mask => axes(mask).to_string(),
            };
            tracing::warn!(device = name, "{which} {what}");
        } else if *doubted && run.is_over() {
            *doubted = false;
            tracing::info!(device = name, "no longer {}", counter.word());
        }
    }
}

/// Logs a bus on which nothing can be sent, and when something can be again. Half a thousand frames
/// leave a queue in half a second at 125 kbit/s; the kernel's default is a queue of ten.
fn log_blocked(bus: &BusHealth, before: Option<&BusHealth>, blocked: &mut u32) {
    /// \[ticks\], 1 s.
    const BLOCKED: u32 = 10;
    let since = |of: fn(&BusHealth) -> u64| increase(of(bus), before.map(of));
    let name = bus.name.as_str();
    if since(|b| b.sent) > 0 {
        if std::mem::take(blocked) >= BLOCKED {
            tracing::info!(bus = name, "frames are sent again");
        }
    } else if since(|b| b.queue_full) > 0 {
        *blocked += 1;
        if *blocked == BLOCKED {
            match since(|b| b.frames) {
                0 => tracing::error!(
                    bus = name,
                    "nothing can be sent, and nothing is received: no other node acknowledges \
                     (cable, power of the boards, bit rate, termination)"
                ),
                _ => tracing::error!(
                    bus = name,
                    "nothing can be sent, although frames are received: the queue of the interface \
                     is full and does not empty. The adapter or its driver hangs: `ip link set \
                     INTERFACE down` and `up`, or plug the adapter in again"
                ),
            }
        }
    }
}

/// Logs a bus that is nearly full, and when it is no longer.
fn log_load(bus: &BusHealth, full: &mut bool) {
    let (name, was) = (bus.name.as_str(), *full);
    *full = BusLoad::stays_high(bus.load, was);
    match (was, *full) {
        (false, true) => tracing::warn!(
            bus = name,
            "its frames need up to {:.0} % of the bus ({:.0} frames/s): frames of low priority \
             come late; make periods longer, or move devices to another bus",
            bus.load * 100.0,
            bus.frame_rate
        ),
        (true, false) => {
            tracing::info!(bus = name, "its load is {:.0} % again", bus.load * 100.0);
        }
        _ => {}
    }
}

/// What to check of a silent board.
fn remedy(device: &DeviceHealth) -> String {
    let (starts, readings) = (
        device.count(Counter::Starts),
        device.count(Counter::Readings),
    );
    let what = match (starts, readings) {
        (0, 0) => "nothing is received from it".to_owned(),
        (_, 0) => format!("no reading after {starts} starts"),
        _ => "no more readings".to_owned(),
    };
    let other = match starts {
        0 => "whether the program that starts it runs",
        _ => "whether another program commands it",
    };
    format!(
        "{what}; check its power and cable, its bus and address in gateway.toml, the bit rate, the \
         termination of the bus (120 Ohm at both ends), and {other}"
    )
}

/// Logs a change of the controller's error state.
fn log_controller(bus: &BusHealth, before: Option<&BusHealth>) {
    let was = before.map_or(Controller::Unknown.in_memory(), |b| b.interface.controller);
    let now = bus.interface.controller;
    if now == was || now == Controller::Unknown {
        return;
    }
    let name = bus.name.as_str();
    let (tx, rx) = (
        bus.interface.tx_error_counter,
        bus.interface.rx_error_counter,
    );
    match now.get().unwrap_or_default() {
        // Not what is normal at the start.
        Controller::Active if was == Controller::Unknown => {}
        Controller::Active => tracing::info!(bus = name, "the controller is error active again"),
        state => tracing::warn!(
            bus = name,
            "the controller is {}; error counters: tx={tx}, rx={rx}",
            match state {
                Controller::Warning => "at the warning limit",
                Controller::Passive => "error passive",
                Controller::BusOff => "bus-off",
                Controller::Stopped => "stopped",
                Controller::Sleeping => "asleep",
                Controller::Active | Controller::Unknown => "in an unknown state",
            }
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;
    use proprio_topics::{BusHealth, Nanos};
    use std::io;
    use std::path::Path;
    use std::sync::{Arc, Mutex};

    /// Collects log lines.
    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl io::Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// The lines that `run` logs.
    fn logged(run: impl FnOnce()) -> Vec<String> {
        let lines = Lines::default();
        let writer = lines.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_writer(move || writer.clone())
            .with_ansi(false)
            .without_time()
            .with_target(false)
            .finish();
        tracing::subscriber::with_default(subscriber, run);
        let bytes = lines.0.lock().unwrap().clone();
        let text = String::from_utf8(bytes).unwrap();
        text.lines().map(|l| l.trim().to_owned()).collect()
    }

    fn status() -> BusStatus {
        let text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                    source = { kind = \"virtual\", name = \"b\" }\n";
        let plan = Plan::parse(text, Path::new(".")).unwrap();
        BusStatus::new(0, &plan.buses[0])
    }

    fn health(bus: BusHealth) -> GatewayHealth {
        let mut health = GatewayHealth::new(Nanos::ZERO);
        health.bus_count = 1;
        health.buses[0] = bus;
        health
    }

    /// A controller in `state`, with its counters.
    fn controller(state: Controller, restart_ms: u32) -> InterfaceHealth {
        InterfaceHealth {
            controller: state.in_memory(),
            tx_error_counter: 96,
            rx_error_counter: 5,
            restart_ms,
            ..InterfaceHealth::default()
        }
    }

    #[test]
    fn a_bus_without_carrier_whose_controller_is_bus_off_is_bus_off() {
        let status = status();
        let link = |state, interface| {
            status.set_link(state, &crate::link::LinkCounters::default());
            let mut health = Box::new(GatewayHealth::new(Nanos::ZERO));
            fill_health(&mut health, &[&status], &[interface]);
            assert_eq!(health.buses()[0].interface, interface);
            assert!(health.realtime_offset > Nanos::ZERO);
            health.buses()[0].link.get()
        };
        let (off, active) = (
            controller(Controller::BusOff, 0),
            controller(Controller::Active, 0),
        );
        assert_eq!(link(LinkState::NoCarrier, off), Some(LinkState::BusOff));
        assert_eq!(
            link(LinkState::NoCarrier, active),
            Some(LinkState::NoCarrier)
        );
        assert_eq!(link(LinkState::Up, off), Some(LinkState::Up));
        assert_eq!(link(LinkState::Down, off), Some(LinkState::Down));
    }

    #[test]
    fn every_change_of_a_controller_and_its_link_is_one_line() {
        let status = status();
        let mut log = HealthLog::default();
        let mut tick = |link, interface| {
            status.set_link(link, &crate::link::LinkCounters::default());
            let mut health = Box::new(GatewayHealth::new(Nanos::ZERO));
            fill_health(&mut health, &[&status], &[interface]);
            logged(|| log.log_changes(&health, &[&status]))
        };
        use Controller::{Active, BusOff, Passive, Unknown, Warning};
        use LinkState::{NoCarrier, Up};
        for (link, state, restart_ms, told) in [
            (Up, Unknown, 0, &[][..]),
            (Up, Active, 0, &[]),
            (
                Up,
                Warning,
                0,
                &["the controller is at the warning limit; error counters: tx=96, rx=5"],
            ),
            (Up, Warning, 0, &[]),
            (Up, Passive, 0, &["the controller is error passive"]),
            (
                NoCarrier,
                BusOff,
                0,
                &[
                    "the link is bus_off, until a person restarts",
                    "the controller is bus-off",
                ],
            ),
            (NoCarrier, BusOff, 0, &[]),
            (
                Up,
                Active,
                0,
                &[
                    "the link is up again",
                    "the controller is error active again",
                ],
            ),
            (
                NoCarrier,
                BusOff,
                100,
                &["the link is bus_off; waiting", "the controller is bus-off"],
            ),
            (NoCarrier, Unknown, 0, &["the link is no_carrier; waiting"]),
        ] {
            let lines = tick(link, controller(state, restart_ms));
            assert_eq!(lines.len(), told.len(), "{state:?}: {lines:?}");
            for (line, told) in lines.iter().zip(told) {
                assert!(line.contains(told), "{line}, not {told}");
            }
        }
    }

    /// A full queue that does not empty is told with what else the bus does, once.
    #[test]
    fn a_bus_that_does_not_send_is_told_from_one_without_nodes() {
        let mut log = HealthLog::default();
        let mut health = health(BusHealth::EMPTY);
        let mut run = |sent: u64, full: u64, frames: u64, ticks: u32| {
            logged(|| {
                for _ in 0..ticks {
                    let bus = &mut health.buses[0];
                    bus.sent += sent;
                    bus.queue_full += full;
                    bus.frames += frames;
                    log.log_changes(&health, &[]);
                }
            })
        };
        assert_eq!(run(5, 0, 50, 20), [""; 0]);
        assert_eq!(run(0, 0, 50, 50), [""; 0], "nothing is to be sent");
        assert_eq!(run(1, 90, 50, 50), [""; 0], "slow, but it sends");
        assert_eq!(run(0, 90, 50, 9), [""; 0]);
        let lines = run(0, 90, 50, 100);
        assert_eq!(lines.len(), 1, "{lines:?}");
        assert!(
            lines[0].contains("although frames are received"),
            "{lines:?}"
        );
        let lines = run(1, 0, 50, 5);
        assert!(
            lines.len() == 1 && lines[0].contains("sent again"),
            "{lines:?}"
        );
        let lines = run(0, 90, 0, 100);
        assert!(
            lines.len() == 1 && lines[0].contains("acknowledges"),
            "{lines:?}"
        );
    }

    /// One line when it falls silent, one after each doubled time, one when it comes.
    #[test]
    fn a_silent_board_is_told_with_what_to_check_then_rarely() {
        let mut log = HealthLog::default();
        let mut tick = |state: DeviceState, starts: u64, minutes: u32| {
            let mut health = health(BusHealth::EMPTY);
            health.device_count = 1;
            health.devices[0].state = state.in_memory();
            health.devices[0].counters[Counter::Starts as usize] = starts;
            logged(|| {
                for _ in 0..minutes * 600 {
                    log.log_changes(&health, &[]);
                }
            })
        };
        assert_eq!(tick(DeviceState::Starting, 1, 1).len(), 1);
        assert_eq!(
            tick(DeviceState::Asking, 2, 1),
            [""; 0],
            "the bring-up goes on"
        );
        let lines = tick(DeviceState::Silent, 15, 10);
        assert_eq!(
            lines.len(),
            5,
            "at once, after 1, 2, 4 and 8 minutes: {lines:?}"
        );
        for line in &lines {
            assert!(line.starts_with("WARN"), "{line}");
            for word in [
                "15 starts",
                "power",
                "bus",
                "address",
                "bit rate",
                "termination",
            ] {
                assert!(line.contains(word), "{line}");
            }
        }
        assert!(lines[1].contains("still silent for 60 s"), "{lines:?}");
        let hours = tick(DeviceState::Silent, 999, 600);
        assert!((10..16).contains(&hours.len()), "{hours:?}");
        let [line] = &tick(DeviceState::Streaming, 999, 1)[..] else {
            panic!()
        };
        assert!(line.starts_with("INFO streaming, after 366"), "{line}");
        assert_eq!(tick(DeviceState::Streaming, 999, 10), [""; 0]);
        // One that is only listened to.
        assert_eq!(tick(DeviceState::Silent, 0, 1).len(), 1);
        let lines = tick(DeviceState::Silent, 0, 1);
        assert!(lines[0].contains("the program that starts it"), "{lines:?}");
    }

    /// Once: nothing is wrong with what it does send.
    #[test]
    fn a_value_that_is_left_out_is_told_with_the_reason() {
        let mut log = HealthLog::default();
        let mut health = health(BusHealth::EMPTY);
        health.device_count = 1;
        health.devices[0].state = DeviceState::Streaming.in_memory();
        health.devices[0].refusal = Refusal::Untold { object: 0x6076 }.code();
        let lines = logged(|| (0..600).for_each(|_| log.log_changes(&health, &[])));
        let [line] = &lines[..] else {
            panic!("{lines:?}")
        };
        assert!(
            line.starts_with("WARN streaming, but without a value: object 6076"),
            "{line}"
        );
        assert!(line.contains("set rated_torque"), "{line}");
    }

    /// As a silent one: whoever looks at the end of a log must find it.
    #[test]
    fn a_refused_board_is_told_with_the_reason_then_rarely() {
        let mut log = HealthLog::default();
        let mut health = health(BusHealth::EMPTY);
        health.device_count = 1;
        health.devices[0].state = DeviceState::Refused.in_memory();
        health.devices[0].refusal = Refusal::Changed.code();
        let lines = logged(|| {
            for _ in 0..10 * 600 {
                log.log_changes(&health, &[]);
            }
        });
        assert_eq!(
            lines.len(),
            5,
            "at once, after 1, 2, 4 and 8 minutes: {lines:?}"
        );
        assert!(
            lines[0].starts_with("ERROR refused: it reports"),
            "{lines:?}"
        );
        for (line, seconds) in lines.iter().skip(1).zip([60, 120, 240, 480]) {
            let expected = format!("WARN still refused for {seconds} s: it reports");
            assert!(line.starts_with(&expected), "{line}, not {expected}");
        }
    }

    #[test]
    fn the_first_error_frame_of_a_run_is_told_in_words() {
        let status = status();
        let mut log = HealthLog::default();
        let mut tick = |error: Option<ErrorFrame>| {
            if let Some(error) = error {
                status.record_error(error);
            }
            logged(|| log.log_changes(&health(status.bus()), &[&status]))
        };
        // A form error at the end of the frame, which is a bus error too, with its counters.
        let error = ErrorFrame {
            classes: 0x288,
            data: [0, 0, 2, 0x1A, 0, 0, 17, 4],
        };
        assert_eq!(tick(None), [""; 0]);
        let first = tick(Some(error));
        assert_eq!(first.len(), 1, "{first:?}");
        for word in ["protocol violation", "bus error", "tx=17", "rx=4"] {
            assert!(first[0].contains(word), "{first:?}");
        }
        for _ in 0..100 {
            assert_eq!(tick(Some(error)), [""; 0], "the same run");
        }
        for _ in 0..Run::REST {
            assert_eq!(tick(None), [""; 0]);
        }
        assert_eq!(tick(Some(error)).len(), 1, "a new run");
        let overflow = tick(Some(ErrorFrame {
            classes: 4,
            data: [0, 1, 0, 0, 0, 0, 0, 0],
        }));
        assert_eq!(overflow.len(), 2, "{overflow:?}");
        assert!(
            overflow[0].contains("receive buffer overflow"),
            "{overflow:?}"
        );
        assert!(overflow[1].contains("frames were lost"), "{overflow:?}");
    }

    /// Who joins a stream hears halves of groups: that is no warning. Later ones are.
    #[test]
    fn an_ordinary_start_is_quiet() {
        let mut log = HealthLog::default();
        let mut health = health(BusHealth::EMPTY);
        health.device_count = 1;
        let mut tick = |state: DeviceState, unpaired: u64, lost: u64| {
            health.devices[0].state = state.in_memory();
            health.devices[0].counters[Counter::Unpaired as usize] += unpaired;
            health.devices[0].counters[Counter::Lost as usize] += lost;
            let lines = logged(|| log.log_changes(&health, &[]));
            lines.iter().filter(|line| line.contains("WARN")).count()
        };
        assert_eq!(tick(DeviceState::Waiting, 0, 0), 0);
        assert_eq!(tick(DeviceState::Starting, 1, 0), 0);
        assert_eq!(tick(DeviceState::Streaming, 2, 0), 0);
        assert_eq!(tick(DeviceState::Streaming, 1, 0), 1, "the first of a run");
        assert_eq!(tick(DeviceState::Streaming, 1, 0), 0);
        assert_eq!(tick(DeviceState::Silent, 0, 0), 1);
        assert_eq!(
            tick(DeviceState::Streaming, 1, 1),
            1,
            "what is no matter of joining"
        );
    }

    #[test]
    fn a_frozen_axis_is_one_line_with_what_to_check() {
        let mut log = HealthLog::default();
        let mut health = health(BusHealth::EMPTY);
        health.device_count = 1;
        health.devices[0].state = DeviceState::Streaming.in_memory();
        let mut tick = |frozen: u16, beyond: u16, count: u64| {
            health.devices[0].frozen_axes = frozen;
            health.devices[0].beyond_axes = beyond;
            health.devices[0].counters[Counter::Frozen as usize] += count;
            logged(|| log.log_changes(&health, &[]))
        };
        assert_eq!(tick(0, 0, 0).len(), 1, "it streams");
        let lines = tick(0b10_0001, 0, 5);
        let [line] = &lines[..] else {
            panic!("{lines:?}")
        };
        for part in ["WARN fx, tz repeats itself", "cable", "saturated"] {
            assert!(line.contains(part), "{line}");
        }
        // It comes and goes: one line.
        for k in 0..100 {
            assert_eq!(tick(if k % 2 == 0 { 0x3F } else { 0 }, 0, 0), [""; 0]);
        }
        let after: Vec<_> = (0..Run::REST + 5).flat_map(|_| tick(0, 0, 0)).collect();
        assert_eq!(after.len(), 1, "{after:?}");
        assert!(after[0].contains("INFO no longer frozen"), "{after:?}");
        // One that has ended before anybody looked.
        let lines = tick(0, 0, 3);
        assert!(
            lines.len() == 1 && lines[0].contains("a value repeats"),
            "{lines:?}"
        );
        let lines = tick(0, 0b100, 0);
        assert!(
            lines.len() == 1 && lines[0].contains("fz is beyond"),
            "{lines:?}"
        );
    }

    #[test]
    fn a_full_bus_is_told_once_and_its_end_too() {
        let mut log = HealthLog::default();
        let mut tick = |load| {
            let bus = BusHealth {
                load,
                frame_rate: 5800.0,
                ..status().bus()
            };
            logged(|| log.log_changes(&health(bus), &[]))
        };
        assert_eq!(tick(f64::NAN), [""; 0]);
        assert_eq!(tick(0.7), [""; 0]);
        let lines = tick(0.75);
        assert!(lines.len() == 1 && lines[0].contains("up to 75 % of the bus (5800 frames/s)"));
        for load in [0.72, 0.65, 0.9, 0.61] {
            assert_eq!(tick(load), [""; 0]);
        }
        let lines = tick(0.3);
        assert!(
            lines.len() == 1 && lines[0].contains("its load is 30 % again"),
            "{lines:?}"
        );
    }

    /// A controller tells its bit rate and all frames on the bus; a virtual interface does not, and
    /// without a stated bit rate there is no share.
    #[test]
    fn the_load_is_measured_with_what_is_known() {
        let text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\nRATE\n\
                    source = { kind = \"virtual\", name = \"b\" }\n";
        let measured = |rate: &str, bit_rate: u32, fd: u32| {
            let plan = Plan::parse(&text.replace("RATE", rate), Path::new(".")).unwrap();
            let status = BusStatus::new(0, &plan.buses[0]);
            let mut loads = Loads::new(&plan);
            let mut health = Box::new(GatewayHealth::new(Nanos::ZERO));
            let frame = proprio_drivers::Frame::new(proprio_drivers::Id::standard(1), &[0; 8]);
            for second in 0..3 {
                let interface = InterfaceHealth {
                    rx_frames: 2000 * second,
                    tx_frames: 1000 * second,
                    rx_bytes: 16_000 * second,
                    tx_bytes: 8000 * second,
                    bit_rate,
                    fd,
                    ..InterfaceHealth::default()
                };
                fill_health(&mut health, &[&status], &[interface]);
                loads.measure(&mut health, &[&status], Nanos::from_seconds(second as f64));
                for _ in 0..1000 {
                    status
                        .frames
                        .fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    status.on_wire(&frame);
                }
            }
            // What is asked between two measurements shows the last one.
            fill_health(&mut health, &[&status], &[]);
            let bus = health.buses()[0];
            (bus.frame_rate.round(), bus.load)
        };
        let (frames, share) = measured("", 0, 0);
        assert!(frames == 1000.0 && share.is_nan(), "{frames} {share}");
        let close = |(frames, share): (f64, f64), f: f64, s: f64| {
            assert!(frames == f && (share - s).abs() < 1e-3, "{frames} {share}");
        };
        close(measured("bit_rate = 500000", 0, 0), 1000.0, 0.27);
        close(measured("bit_rate = 500000", 1_000_000, 0), 3000.0, 0.405);
        close(measured("", 1_000_000, 0), 3000.0, 0.405);
        close(measured("", 1_000_000, 1), 1000.0, 0.135);
    }
}
