//! Carries out the orders of the control socket: passes them to the devices by the inboxes of their
//! buses, and answers when the devices have replied.

use crate::control::{Asked, ControlOrder, refusal};
use crate::devices::build;
use crate::inbox::{Busy, Replacement, Reply, Request};
use crate::plan::{Plan, did_you_mean};
use crate::reload::{DeviceChange, changes};
use crate::thread::BusThread;
use anyhow::{Context as _, ensure};
use proprio_drivers::{COMMAND_TIME, Calibration, Command, CommandOutcome, Mode};
use proprio_topics::{
    Counter, DeviceHealth, DeviceState, GatewayHealth, LinkState, Nanos, Refusal, Wrench, axes,
};
use serde_json::{Value as Json, json};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use tokio::sync::oneshot;

/// How long the devices may take to reply: a command, and a few turns of a bus without frames.
const REPLY_TIME: Nanos = Nanos(COMMAND_TIME.0 * 3 / 2);

/// A command that a bus has not taken by then is not begun any more.
const TAKE_TIME: Nanos = Nanos(REPLY_TIME.0 - COMMAND_TIME.0);

/// The devices that will reply and the answer when they have, or the answer at once.
type Begun = Result<(Vec<(usize, u16)>, Json), Json>;

/// The thread of the bus of `device`, if it can be asked something of this device.
fn free(threads: &mut [BusThread], device: (usize, u16)) -> anyhow::Result<&mut BusThread> {
    let thread = threads.get_mut(device.0).context("its bus does not run")?;
    ensure!(!thread.has_ended(), "the log of its bus has ended");
    ensure!(!thread.requests.is_open(device.1), Busy);
    Ok(thread)
}

/// What is being carried out, and on what.
pub(crate) struct Operator {
    config: PathBuf,
    plan: Plan,
    waiting: Vec<PendingOrder>,
    /// Whether the plan has changed and nobody was told.
    reloaded: bool,
}

/// An order whose devices have not all replied.
struct PendingOrder {
    /// The number of the bus, and of the device on it.
    open: Vec<(usize, u16)>,
    /// Given up after this.
    limit: Nanos,
    answer: oneshot::Sender<Json>,
    /// The answer when all devices have taken over what is new.
    done: Json,
}

impl Operator {
    /// For a gateway that runs `plan`, which it has read from `config`.
    pub(crate) fn new(config: &Path, plan: Plan) -> Self {
        Self {
            config: config.to_owned(),
            plan,
            waiting: Vec::new(),
            reloaded: false,
        }
    }

    /// What the gateway runs.
    pub(crate) fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Whether the plan has changed since the last call.
    pub(crate) fn has_reloaded(&mut self) -> bool {
        std::mem::take(&mut self.reloaded)
    }

    /// Whether a device has not replied.
    pub(crate) fn waits(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Begins to carry out what was asked, at `now`; `health` is that of now.
    pub(crate) fn begin(
        &mut self,
        asked: Asked,
        threads: &mut [BusThread],
        health: &GatewayHealth,
        now: Nanos,
    ) {
        let Asked { order, answer } = asked;
        let begun = match &order {
            ControlOrder::Status => {
                // An operator who has gone needs no answer; nor below.
                let _ = answer.send(self.status(health, now));
                return;
            }
            ControlOrder::Devices => {
                let _ = answer.send(self.devices(threads, health));
                return;
            }
            ControlOrder::Tare { device } => self.command(device, Command::Tare, threads, now),
            ControlOrder::Calibration { device } => {
                self.command(device, Command::Calibration, threads, now)
            }
            ControlOrder::Reload => self.reload(threads),
        };
        match begun {
            Ok((open, done)) if open.is_empty() => drop(answer.send(done)),
            Ok((open, done)) => self.waiting.push(PendingOrder {
                open,
                limit: now + REPLY_TIME,
                answer,
                done,
            }),
            Err(refused) => drop(answer.send(refused)),
        }
    }

    /// Takes the replies of the devices until `now`, and answers.
    pub(crate) fn take_replies(&mut self, threads: &mut [BusThread], now: Nanos) {
        for (thread, bus) in threads.iter_mut().zip(0..) {
            while let Some((device, reply)) = thread.requests.take() {
                self.replied(bus, device, reply);
            }
        }
        let late = |waiting: &mut PendingOrder| now > waiting.limit;
        let late: Vec<_> = self.waiting.extract_if(.., late).collect();
        for PendingOrder { open, answer, .. } in late {
            let names = open.into_iter().map(|(bus, device)| self.name(bus, device));
            let names: Vec<_> = names.collect();
            let _ = answer.send(refusal(&format!(
                "no reply of {}: its bus may be stuck. What was asked is carried out as soon as it \
                 goes on; if it does not, restart the gateway",
                names.join(", ")
            )));
        }
    }

    /// A device has replied.
    fn replied(&mut self, bus: usize, device: u16, reply: Reply) {
        let name = self.name(bus, device);
        let outcome = match reply {
            Reply::Ended(Ok(CommandOutcome::Tared(added))) => Ok(tared(&name, added)),
            Reply::Ended(Ok(CommandOutcome::Calibration(calibration))) => {
                Ok(calibrated(&name, &calibration))
            }
            Reply::Ended(Ok(other)) => Ok(json!({ "ok": true, "outcome": format!("{other:?}") })),
            Reply::Ended(Err(failed)) => Err(failed.to_string()),
            Reply::Refused(refused) => Err(refused.to_string()),
            // What was replaced is freed here.
            Reply::Replaced(_) => return self.replaced(bus, device),
        };
        let answer = outcome.unwrap_or_else(|error| {
            tracing::warn!(device = name, "not done: {error}");
            refusal(&format!("device {name:?}: {error}"))
        });
        let waits_for_it = |waiting: &PendingOrder| waiting.open.contains(&(bus, device));
        if let Some(at) = self.waiting.iter().position(waits_for_it) {
            let _ = self.waiting.swap_remove(at).answer.send(answer);
        }
    }

    /// A device has taken over what is new.
    fn replaced(&mut self, bus: usize, device: u16) {
        for waiting in &mut self.waiting {
            waiting.open.retain(|open| *open != (bus, device));
        }
        let done = self
            .waiting
            .extract_if(.., |waiting| waiting.open.is_empty());
        for PendingOrder { answer, done, .. } in done {
            let _ = answer.send(done);
        }
    }

    fn name(&self, bus: usize, device: u16) -> String {
        let devices = self.plan.buses.get(bus).map(|bus| &bus.devices);
        let device = devices.and_then(|devices| devices.get(usize::from(device)));
        device.map_or_else(String::new, |device| device.name.clone())
    }

    /// The numbers of the device `name`, or `bus/name`.
    fn find(&self, name: &str) -> Result<(usize, u16), String> {
        let all = || {
            self.plan.buses.iter().zip(0..).flat_map(|(bus, number)| {
                let devices = bus.devices.iter().zip(0..);
                devices.map(move |(device, at)| ((number, at), &bus.name, &device.name))
            })
        };
        let found: Vec<_> = all()
            .filter(|(_, bus, device)| {
                *device == name || name.split_once('/') == Some((bus.as_str(), device.as_str()))
            })
            .collect();
        match found[..] {
            [(numbers, ..)] => Ok(numbers),
            [] => {
                let names: Vec<_> = all().map(|(_, _, device)| device.as_str()).collect();
                Err(format!(
                    "there is no device {name:?}{}; there is {}",
                    did_you_mean(name, names.iter().copied()),
                    names.join(", ")
                ))
            }
            [..] => {
                let names: Vec<_> = found
                    .iter()
                    .map(|(_, bus, _)| format!("{bus}/{name}"))
                    .collect();
                Err(format!(
                    "several devices are named {name:?}: {}",
                    names.join(", ")
                ))
            }
        }
    }

    fn command(
        &self,
        name: &str,
        command: Command,
        threads: &mut [BusThread],
        now: Nanos,
    ) -> Begun {
        let device = self.find(name).map_err(|e| refusal(&e))?;
        let command = Request::Command {
            command,
            until: now + TAKE_TIME,
        };
        free(threads, device)
            .and_then(|thread| Ok(thread.requests.send(device.1, command)?))
            .map_err(|why| refusal(&format!("device {name:?}: {why}")))?;
        Ok((vec![device], Json::Null))
    }

    fn reload(&mut self, threads: &mut [BusThread]) -> Begun {
        let new = Plan::load_live(&self.config).map_err(|e| {
            let error = e.to_string();
            json!({ "ok": false, "error": error, "file": e.file, "problem": e.problem })
        })?;
        let changes = changes(&self.plan, &new).map_err(|places| {
            let error = format!(
                "nothing was changed, because this needs a restart of the gateway: {}",
                places.join("; ")
            );
            json!({ "ok": false, "error": error, "restart": places })
        })?;
        // Everything that can fail comes before the first change.
        let mut requests = Vec::new();
        for DeviceChange {
            device, restarts, ..
        } in &changes
        {
            let failed = |why: &dyn Display| {
                let name = self.name(device.0, device.1);
                refusal(&format!("nothing was changed: device {name:?}: {why}"))
            };
            let thread = free(threads, *device).map_err(|why| failed(&why))?;
            let devices = new.buses.get(device.0).map(|bus| &bus.devices);
            let plan = devices.and_then(|devices| devices.get(usize::from(device.1)));
            let plan = plan.ok_or_else(|| failed(&"it is not in the file"))?;
            let built = restarts.then(|| build(plan, thread.mode)).transpose();
            let replacement = Replacement {
                device: built.map_err(|why| failed(&why))?,
                max_silence: plan.spec.max_silence,
                outputs: plan.outputs.clone(),
            };
            requests.push((*device, Request::Replace(replacement)));
        }
        for ((bus, device), request) in requests {
            if let Some(thread) = threads.get_mut(bus) {
                // It is free, as was seen above.
                let _ = thread.requests.send(device, request);
            }
        }
        self.plan = new;
        self.reloaded = !changes.is_empty();
        let mut changed = Vec::new();
        for DeviceChange {
            device,
            what,
            restarts,
        } in &changes
        {
            let name = self.name(device.0, device.1);
            tracing::info!(device = name, restarts, "reloaded: {}", what.join(", "));
            changed.push(json!({ "device": name, "what": what, "restarted": restarts }));
        }
        let open = changes.into_iter().map(|change| change.device).collect();
        Ok((open, json!({ "ok": true, "changed": changed })))
    }

    fn status(&self, health: &GatewayHealth, now: Nanos) -> Json {
        let buses: Vec<_> = (health.buses().iter())
            .map(|bus| {
                json!({
                    "name": bus.name.as_str(),
                    "link": bus.link.get().map(LinkState::word),
                    "frames": bus.frames, "dropped": bus.dropped,
                    "error_frames": bus.error_frames,
                    "sent": bus.sent, "send_failures": bus.send_failures,
                    "load": bus.load, "frame_rate_hz": bus.frame_rate,
                })
            })
            .collect();
        let streams = |device: &&DeviceHealth| device.state == DeviceState::Streaming;
        json!({
            "ok": true,
            "robot": self.plan.robot,
            "process": std::process::id(),
            "config": self.config,
            "up_s": (now - health.started).seconds(),
            "buses": buses,
            "devices": health.devices().len(),
            "streaming": health.devices().iter().filter(streams).count(),
        })
    }

    fn devices(&self, threads: &[BusThread], health: &GatewayHealth) -> Json {
        let buses = self.plan.buses.iter().zip(threads);
        let devices = buses.flat_map(|(bus, thread)| {
            let devices = bus.devices.iter();
            devices.map(move |device| (bus, device, thread.mode.unwrap_or(device.spec.mode)))
        });
        let devices: Vec<_> = devices
            .zip(health.devices())
            .map(|((bus, device, mode), health)| {
                let channels: Vec<_> = (device.outputs.iter())
                    .filter_map(|output| self.plan.channels.get(output.channel as usize))
                    .map(|channel| channel.name.as_str())
                    .collect();
                json!({
                    "name": device.name, "bus": bus.name, "driver": device.driver,
                    "address": device.spec.address,
                    "listen_only": mode == Mode::Listen,
                    "state": health.state.get().map(DeviceState::word),
                    "refusal": Refusal::from_code(health.refusal).map(|r| r.to_string()),
                    "frames": health.count(Counter::Frames),
                    "readings": health.count(Counter::Readings),
                    "frozen": axes(health.frozen_axes).to_string(),
                    "out_of_range": axes(health.beyond_axes).to_string(),
                    "channels": channels,
                })
            })
            .collect();
        json!({ "ok": true, "robot": self.plan.robot, "devices": devices })
    }
}

/// The answer to a tare, which is told in the log.
fn tared(name: &str, added: Option<Wrench>) -> Json {
    let text = match added {
        Some(Wrench { force, torque }) => format!("the board adds {force:?} N, {torque:?} Nm"),
        None => "the present load is its zero".to_owned(),
    };
    tracing::warn!(
        device = name,
        "tared: {text} from now on; offsets identified before no longer hold"
    );
    let added = added.map(|added| json!({ "force_n": added.force, "torque_nm": added.torque }));
    json!({ "ok": true, "device": name, "added": added })
}

/// The answer to a question about a calibration; what is wrong with it is told in the log.
fn calibrated(name: &str, calibration: &Calibration) -> Json {
    let problems: Vec<_> = calibration
        .defects()
        .iter()
        .map(ToString::to_string)
        .collect();
    if !problems.is_empty() {
        tracing::warn!(
            device = name,
            "its calibration is wrong: {}; write it again with the maker's tool",
            problems.join("; ")
        );
    }
    let mut answer = json!({
        "ok": true, "device": name,
        "per_count": calibration.per_count(), "problems": problems,
    });
    if let Some([fx, fy, fz, tx, ty, tz]) = calibration.full_scale() {
        answer["full_scale_n"] = json!([fx, fy, fz]);
        answer["full_scale_nm"] = json!([tx, ty, tz]);
    }
    match calibration {
        Calibration::Fractions { matrix, .. } => {
            answer["matrix"] = json!(matrix.map(|row| row.map(|x| f64::from(x) / 32768.0)));
        }
        Calibration::Counts {
            matrix,
            counts,
            units: [newton, newton_metre],
        } => {
            answer["matrix"] = json!(matrix);
            answer["counts_per_unit"] = json!(counts);
            answer["unit_n"] = json!(newton);
            answer["unit_nm"] = json!(newton_metre);
        }
        Calibration::FullScale(_) => {}
    }
    answer
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inbox::Inbox;
    use proprio_drivers::Decoded;

    const FILE: &str = r#"
schema = 1
robot = "r"
[[bus]]
name = "b"
source = { kind = "virtual", name = "b" }
[[bus.device]]
driver = "icub_strain"
name = "ft"
address = 1
full_scale_n = [1804.0, 1804.0, 1804.0]
full_scale_nm = [31.0, 31.0, 31.0]
"#;

    /// An operator of a gateway whose bus makes no turn.
    struct Rig {
        _folder: tempfile::TempDir,
        config: PathBuf,
        operator: Operator,
        threads: [BusThread; 1],
        inbox: Inbox,
        health: Box<GatewayHealth>,
    }

    impl Rig {
        fn new(text: &str) -> Self {
            let folder = tempfile::tempdir().unwrap();
            let config = folder.path().join("gateway.toml");
            std::fs::write(&config, text).unwrap();
            let plan = Plan::load_live(&config).unwrap();
            let (thread, inbox) = BusThread::still(&plan.buses[0]);
            Self {
                operator: Operator::new(&config, plan),
                threads: [thread],
                inbox,
                health: Box::new(GatewayHealth::new(Nanos::ZERO)),
                config,
                _folder: folder,
            }
        }

        fn begin(&mut self, order: ControlOrder, now: Nanos) -> oneshot::Receiver<Json> {
            let (answer, answered) = oneshot::channel();
            let (asked, health) = (Asked { order, answer }, &self.health);
            self.operator.begin(asked, &mut self.threads, health, now);
            answered
        }
    }

    #[test]
    fn who_asks_a_bus_that_is_stuck_is_told_so() {
        let mut rig = Rig::new(FILE);
        let now = Nanos::from_millis(1000);
        let tare = || ControlOrder::Tare {
            device: "ft".to_owned(),
        };
        let mut answered = rig.begin(tare(), now);
        rig.operator
            .take_replies(&mut rig.threads, now + REPLY_TIME);
        assert!(answered.try_recv().is_err() && rig.operator.waits());
        let late = now + REPLY_TIME + Nanos(1);
        rig.operator.take_replies(&mut rig.threads, late);
        let error = answered.try_recv().unwrap()["error"].to_string();
        assert!(error.contains("no reply of ft"), "{error}");
        assert!(!rig.operator.waits());
        // It has not forgotten that the bus may still take the first one.
        let error = rig.begin(tare(), late).try_recv().unwrap()["error"].to_string();
        assert!(error.contains("still open"), "{error}");
    }

    /// A log does not answer: what takes over there only listens, as what it replaces.
    #[test]
    fn a_reload_beside_a_log_asks_it_nothing() {
        let live = "{ kind = \"virtual\", name = \"b\" }";
        let replay = "{ kind = \"replay\", log = \"b.log\" }";
        for (source, asks) in [(live, true), (replay, false)] {
            let file = FILE.replace(live, source);
            let mut rig = Rig::new(&file);
            let changed = file.replace("address = 1", "address = 1\nperiod_ms = 2");
            std::fs::write(&rig.config, changed).unwrap();
            let _answered = rig.begin(ControlOrder::Reload, Nanos::ZERO);
            let Some((0, Request::Replace(new))) = rig.inbox.take() else {
                panic!("nothing is replaced")
            };
            let mut device = new.device.expect("a device");
            let first = device.poll_transmit(Nanos::ZERO, &mut Decoded::new());
            assert_eq!(first.is_some(), asks, "{source}");
        }
    }
}
