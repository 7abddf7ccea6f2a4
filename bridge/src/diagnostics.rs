//! How a robot's daemons, buses and devices are, as `diagnostic_msgs` say it.

use crate::cdr::CdrMessage;
use proprio_topics::{
    BusHealth, Controller, Counter, DeviceHealth, DeviceState, EstimatorHealth, GatewayHealth,
    LinkState, Nanos, Refusal, axes,
};

/// Health is published ten times a second: without it for so long, its sender has ended or hangs.
const SILENCE: Nanos = Nanos::from_millis(1000);

/// How bad something is; the number is that of `DiagnosticStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// All is well.
    Ok = 0,
    /// It works, but something is not as it should be.
    Warn = 1,
    /// It does not work.
    Error = 2,
    /// How it is now is not known.
    Stale = 3,
}

/// How one thing is.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DiagnosticStatus {
    pub(crate) level: Level,
    pub(crate) name: String,
    pub(crate) message: String,
    pub(crate) values: Vec<(&'static str, String)>,
}

/// How everything of a robot is at `now`.
pub(crate) fn of(
    robot: &str,
    gateway: Option<&GatewayHealth>,
    estimator: Option<&EstimatorHealth>,
    now: Nanos,
) -> Vec<DiagnosticStatus> {
    let published = gateway.map(|it| it.header.published);
    let mut all = vec![daemon(robot, "gateway", published, now)];
    if let Some(health) = gateway {
        all.extend(health.buses().iter().map(|it| bus(robot, it)));
        all.extend(health.devices().iter().map(|it| device(robot, it)));
    }
    let published = estimator.map(|it| it.header.published);
    let mut status = daemon(robot, "estimator", published, now);
    if let Some(health) = estimator {
        if status.level == Level::Ok {
            let since = now.saturating_sub(health.last_estimate);
            (status.level, status.message) = match health.last_estimate > Nanos::ZERO {
                true if since <= SILENCE => (Level::Ok, "estimates".to_owned()),
                true => {
                    let text = format!("the last estimate was {:.0} s ago", since.seconds());
                    (Level::Error, text)
                }
                false => (Level::Warn, "no estimate yet".to_owned()),
            };
        }
        status.values = vec![
            ("estimates", health.estimates.to_string()),
            ("withheld", health.withheld.to_string()),
            ("samples", health.samples.to_string()),
            ("lost", health.lost.to_string()),
            ("late", health.late.to_string()),
        ];
        if health.identification.groups > 0 {
            let identification = health.identification.to_string();
            status.values.push(("identification", identification));
        }
    }
    all.push(status);
    // What a silent daemon said last may no longer hold.
    if let [gateway, parts @ .., _] = all.as_mut_slice()
        && gateway.level == Level::Stale
    {
        parts.iter_mut().for_each(|part| part.level = Level::Stale);
    }
    all
}

fn daemon(robot: &str, what: &str, published: Option<Nanos>, now: Nanos) -> DiagnosticStatus {
    let age = published.map(|published| now.saturating_sub(published));
    let (level, message) = match age {
        None => (Level::Stale, "not running".to_owned()),
        Some(age) if age > SILENCE => {
            let text = format!("no word for {:.0} s: it has ended or hangs", age.seconds());
            (Level::Stale, text)
        }
        Some(_) => (Level::Ok, "running".to_owned()),
    };
    DiagnosticStatus {
        level,
        name: format!("{robot}: {what}"),
        message,
        values: Vec::new(),
    }
}

/// How a bus is, and that in words.
#[must_use]
pub fn bus_state(bus: &BusHealth) -> (Level, String) {
    let link = bus.link.get();
    let controller = bus.interface.controller.get().unwrap_or_default();
    let level = match (link, controller) {
        (Some(LinkState::Up), Controller::Warning | Controller::Passive) => Level::Warn,
        (Some(LinkState::Up), _) => Level::Ok,
        _ => Level::Error,
    };
    let mut message = link.map_or("unknown", LinkState::word).to_owned();
    if controller != Controller::Unknown {
        message = format!("{message}, controller {}", controller.word());
    }
    (level, message)
}

fn bus(robot: &str, bus: &BusHealth) -> DiagnosticStatus {
    let (level, message) = bus_state(bus);
    let load = match bus.load.is_nan() {
        true => "unknown".to_owned(),
        false => format!("{:.1} %", bus.load * 100.0),
    };
    DiagnosticStatus {
        level,
        name: format!("{robot}: bus {}", bus.name.as_str()),
        message,
        values: vec![
            ("load", load),
            ("frames_per_second", format!("{:.0}", bus.frame_rate)),
            ("frames", bus.frames.to_string()),
            ("dropped", bus.dropped.to_string()),
            ("error_frames", bus.error_frames.to_string()),
            ("not_sent", bus.send_failures.to_string()),
            ("link_losses", bus.link_losses.to_string()),
        ],
    }
}

/// How a device is, and that in words.
#[must_use]
pub fn device_state(device: &DeviceHealth) -> (Level, String) {
    let state = device.state.get();
    let level = match state {
        Some(DeviceState::Streaming) if device.frozen_axes != 0 => Level::Warn,
        Some(DeviceState::Streaming) => Level::Ok,
        Some(DeviceState::Silent | DeviceState::Refused) | None => Level::Error,
        Some(_) => Level::Warn,
    };
    let mut message = state.map_or("unknown", DeviceState::word).to_owned();
    if let Some(refusal) = Refusal::from_code(device.refusal) {
        message = format!("{message}: {refusal}");
    }
    if device.frozen_axes != 0 {
        message = format!("{message}; {} frozen", axes(device.frozen_axes));
    }
    (level, message)
}

fn device(robot: &str, device: &DeviceHealth) -> DiagnosticStatus {
    let (level, message) = device_state(device);
    let counts = Counter::ALL.into_iter().zip(device.counters);
    DiagnosticStatus {
        level,
        name: format!("{robot}: device {}", device.name.as_str()),
        message,
        values: (counts.filter(|(_, count)| *count > 0))
            .map(|(counter, count)| (counter.word(), count.to_string()))
            .collect(),
    }
}

/// The `DiagnosticArray`.
pub(crate) fn message(wall: u64, robot: &str, all: &[DiagnosticStatus]) -> CdrMessage {
    let mut message = CdrMessage::stamped(wall, "");
    message.count(all.len());
    for status in all {
        message.u8(status.level as u8);
        message.text(&status.name);
        message.text(&status.message);
        message.text(robot);
        message.count(status.values.len());
        for (key, value) in &status.values {
            message.text(key);
            message.text(value);
        }
    }
    message
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::Name;

    const NOW: Nanos = Nanos::from_millis(10_000);

    fn gateway(published: Nanos) -> GatewayHealth {
        let mut health = GatewayHealth::new(Nanos::ZERO);
        health.header.published = published;
        (health.bus_count, health.device_count) = (1, 1);
        health.buses[0].name = Name::new("can0").unwrap_or(Name::EMPTY);
        health.devices[0].name = Name::new("ft").unwrap_or(Name::EMPTY);
        health.devices[0].state = DeviceState::Streaming.in_memory();
        health
    }

    fn levels(all: &[DiagnosticStatus]) -> Vec<(&str, Level)> {
        all.iter()
            .map(|one| (one.name.as_str(), one.level))
            .collect()
    }

    #[test]
    fn each_part_has_its_level() {
        let mut health = gateway(NOW);
        let estimator = EstimatorHealth {
            last_estimate: NOW,
            ..EstimatorHealth::default()
        };
        let mut estimator = estimator;
        estimator.header.published = NOW;
        let levels = |health: &GatewayHealth, estimator: &EstimatorHealth| {
            let all = of("arm", Some(health), Some(estimator), NOW);
            all.into_iter().map(|one| one.level).collect::<Vec<_>>()
        };
        assert_eq!(levels(&health, &estimator), [Level::Ok; 4]);
        health.buses[0].interface.controller = Controller::Passive.in_memory();
        health.devices[0].state = DeviceState::Silent.in_memory();
        estimator.last_estimate = Nanos::from_millis(8_000);
        assert_eq!(
            levels(&health, &estimator),
            [Level::Ok, Level::Warn, Level::Error, Level::Error]
        );
        health.buses[0].link = LinkState::BusOff.in_memory();
        health.devices[0].state = DeviceState::Streaming.in_memory();
        health.devices[0].frozen_axes = 1;
        estimator.last_estimate = Nanos::ZERO;
        assert_eq!(
            levels(&health, &estimator),
            [Level::Ok, Level::Error, Level::Warn, Level::Warn]
        );
    }

    #[test]
    fn what_a_killed_gateway_said_last_is_stale() {
        let all = of("arm", Some(&gateway(Nanos::from_millis(7_000))), None, NOW);
        assert_eq!(
            levels(&all),
            [
                ("arm: gateway", Level::Stale),
                ("arm: bus can0", Level::Stale),
                ("arm: device ft", Level::Stale),
                ("arm: estimator", Level::Stale),
            ]
        );
        assert_eq!(all[0].message, "no word for 3 s: it has ended or hangs");
        assert_eq!(all[3].message, "not running");
    }
}
