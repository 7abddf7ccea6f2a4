//! The health message, and what of it becomes a line of the log: changes of state and the first of
//! a run of problems, never every frame.

use crate::clock::realtime_offset;
use crate::link::error_frame::ErrorFrame;
use crate::status::BusStatus;
use proprio_topics::{BusError, Counter, DeviceState, GatewayHealth, LinkState, Refusal};

/// Fills the health message from the counters of the buses.
pub(crate) fn fill_health(health: &mut GatewayHealth, buses: &[&BusStatus]) {
    health.realtime_offset = realtime_offset();
    (health.bus_count, health.device_count) = (0, 0);
    for (slot, status) in health.buses.iter_mut().zip(buses) {
        *slot = status.bus();
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
}

/// Turns health into log lines.
#[derive(Default)]
pub(crate) struct HealthLog {
    last: Option<Box<GatewayHealth>>,
    devices: Vec<[Run; Counter::ALL.len()]>,
    buses: Vec<BusRuns>,
}

/// The runs of problems of one bus.
#[derive(Clone, Copy)]
struct BusRuns {
    dropped: Run,
    errors: [Run; BusError::ALL.len()],
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
            errors: [Run::NONE; BusError::ALL.len()],
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
                    state => tracing::error!(
                        bus = name,
                        "the link is {}; waiting for it to come back",
                        state.word()
                    ),
                }
            }
            // One frame may report several causes: it is told once.
            let mut told: Vec<ErrorFrame> = Vec::new();
            for (cause, run) in BusError::ALL.into_iter().zip(&mut runs.errors) {
                let of = |b: &proprio_topics::BusHealth| b.errors.get(cause as usize).copied();
                let count = of(bus).unwrap_or(0);
                if run.begins(increase(count, before.and_then(of)) > 0)
                    && let Some(frame) = statuses.get(i).and_then(|s| s.newest_error(cause))
                    && !told.contains(&frame)
                {
                    told.push(frame);
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
        self.devices
            .resize(health.devices().len(), [Run::NONE; Counter::ALL.len()]);
        for (i, (device, runs)) in health.devices().iter().zip(&mut self.devices).enumerate() {
            let before = last.and_then(|l| l.devices().get(i));
            let name = device.name.as_str();
            if before.is_none_or(|b| (b.state, b.refusal) != (device.state, device.refusal)) {
                match Refusal::from_code(device.refusal) {
                    Some(refusal) => tracing::error!(device = name, "refused: {refusal}"),
                    None => {
                        let state = device.state.get().map_or("unknown", DeviceState::word);
                        tracing::info!(device = name, "{state}");
                    }
                }
            }
            for (counter, run) in Counter::ALL.into_iter().zip(runs).filter(|(c, _)| {
                !matches!(c, Counter::Frames | Counter::Readings | Counter::Starts)
            }) {
                let of =
                    |d: &proprio_topics::DeviceHealth| d.counters.get(counter as usize).copied();
                let count = of(device).unwrap_or(0);
                let new = increase(count, before.and_then(of));
                if run.begins(new > 0) {
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
}
