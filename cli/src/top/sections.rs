//! What `proprio top` says of each part of a robot, as tables.

use super::snapshot::RobotState;
use crate::echo::{of_contacts, of_joints};
use crate::status::{counts, load};
use proprio_topics::ipc::{Presence, Unavailable};
use proprio_topics::{
    Controller, Counter, Description, DeviceState, LinkState, Nanos, Reason, Refusal, Role, axes,
};
use ratatui::style::Style;
use ratatui::text::Span;

/// Health and estimates come ten times a second or more: without any for so long, the last ones are
/// old.
pub(super) const SILENCE: Nanos = Nanos::from_millis(1000);
/// The width of a bar \[columns\]; its middle is zero.
const BAR: u16 = 21;

/// One thing and what is said of it. The last cell may be longer than its column, and stand in an
/// earlier one.
pub(super) struct SectionRow {
    pub(super) name: String,
    pub(super) cells: Vec<Span<'static>>,
}

/// A part of the robot.
#[derive(Default)]
pub(super) struct TableSection {
    pub(super) title: &'static str,
    /// It at a glance.
    pub(super) summary: Span<'static>,
    /// The columns' names, between bars; `>`: on the right.
    pub(super) head: &'static str,
    pub(super) rows: Vec<SectionRow>,
}

pub(super) fn good() -> Style {
    Style::new().green()
}

pub(super) fn doubtful() -> Style {
    Style::new().yellow()
}

pub(super) fn bad() -> Style {
    Style::new().red()
}

fn faint() -> Style {
    Style::new().dim()
}

/// A duration for a person.
pub(super) fn duration(t: Nanos) -> String {
    let seconds = t.seconds();
    match seconds {
        ..0.9995 => format!("{:.1} ms", seconds * 1e3),
        ..99.95 => format!("{seconds:.1} s"),
        _ => {
            let whole = seconds as u64;
            format!("{}:{:02}:{:02}", whole / 3600, whole / 60 % 60, whole % 60)
        }
    }
}

/// The parts of the robot, as they are at `now`.
pub(super) fn of(snapshot: &RobotState, now: Nanos) -> [TableSection; 6] {
    [
        torques(snapshot, now),
        contacts(snapshot, now),
        channels(snapshot, now),
        devices(snapshot, now),
        buses(snapshot, now),
        identification(snapshot, now),
    ]
}

/// `some` of `all` are well.
fn share(some: usize, all: usize, well: &str) -> Span<'static> {
    let style = if some == all { good() } else { doubtful() };
    Span::styled(format!("{some} of {all} {well}"), style)
}

/// Why an estimate is withheld.
fn why(withheld: &Unavailable) -> Span<'static> {
    let style = match withheld {
        Unavailable::Withheld { reason, .. } => match reason {
            Reason::Absent => faint(),
            Reason::NeverSeen
            | Reason::Starting
            | Reason::Uncertain
            | Reason::Undetermined
            | Reason::NoStance => doubtful(),
            _ => bad(),
        },
        _ => bad(),
    };
    Span::styled(withheld.to_string(), style)
}

/// What is said of what a daemon sent at `t`, if it may no longer hold at `now`.
fn old(what: &str, presence: Presence, t: Nanos, now: Nanos) -> Option<Span<'static>> {
    let age = now.saturating_sub(t);
    let text = || format!("{what} {} ago", duration(age));
    let is_old = age > SILENCE || presence != Presence::Running;
    is_old.then(|| Span::styled(text(), bad()))
}

/// The same of an estimate.
fn old_estimate(snapshot: &RobotState, t: Nanos, now: Nanos) -> Option<Span<'static>> {
    old("the last estimate was", snapshot.estimator.0, t, now)
}

/// `value` with two standard deviations, in a range of twice `scale` around zero.
fn bar(value: f64, deviation: f64, scale: f64) -> Span<'static> {
    let half = f64::from(BAR / 2);
    let unit = if scale > 0.0 { scale / half } else { 1.0 };
    let cells = (0..BAR).map(|cell| {
        let x = f64::from(cell) - half;
        match value / unit {
            _ if x == 0.0 => '│',
            v if (x - v).abs() <= (2.0 * deviation / unit).max(0.5) => '▒',
            v if x * v > 0.0 && x.abs() < v.abs() => '█',
            _ => ' ',
        }
    });
    Span::raw(cells.collect::<String>())
}

fn torques(snapshot: &RobotState, now: Nanos) -> TableSection {
    let mut section =
        TableSection::new("TORQUES", "joint|>torque [Nm]|>± 2σ|-peak     0     +peak");
    section.summary = Span::styled("no estimate yet", doubtful());
    let Some((torques, names)) = snapshot.torques() else {
        return section;
    };
    let old = old_estimate(snapshot, torques.header.acquired, now);
    let mut valid = 0;
    let scales = snapshot.scales.iter().chain(std::iter::repeat(&0.0));
    for ((name, torque, deviation, withheld), scale) in of_joints(names, torques).zip(scales) {
        let two_sigma = format!("± {:.3}", 2.0 * deviation);
        let cells = match (&old, withheld) {
            (Some(_), _) => vec![Span::styled("gone", faint())],
            (None, None) => {
                valid += 1;
                vec![
                    Span::raw(format!("{torque:.3}")),
                    Span::raw(two_sigma),
                    bar(torque, deviation, *scale),
                ]
            }
            (None, Some(withheld)) if deviation.is_finite() => {
                let text = format!("{withheld}, {two_sigma}");
                vec![Span::styled(text, why(&withheld).style)]
            }
            (None, Some(withheld)) => vec![why(&withheld)],
        };
        section.push(name, cells);
    }
    section.summary = old.unwrap_or_else(|| share(valid, section.rows.len(), "valid"));
    section
}

/// Three numbers beside each other, and their largest deviation, twice.
fn vector(values: [f64; 3], deviations: &[f64], digits: usize) -> [Span<'static>; 2] {
    let [x, y, z] = values;
    let largest = deviations.iter().copied().fold(0.0, f64::max);
    let values = format!("{x:>6.digits$} {y:>6.digits$} {z:>6.digits$}");
    [values, format!("± {:.digits$}", 2.0 * largest)].map(Span::raw)
}

fn contacts(snapshot: &RobotState, now: Nanos) -> TableSection {
    let mut section = TableSection::new(
        "CONTACTS",
        "contact|is|>force x, y, z [N]|>± 2σ|>torque x, y, z [Nm]|>± 2σ|at [m]",
    );
    let Some((contacts, names)) = snapshot.contacts() else {
        return section;
    };
    let old = old_estimate(snapshot, contacts.header.acquired, now);
    let mut present = 0;
    for (entry, contact, withheld) in of_contacts(names, contacts) {
        let cells = match (&old, withheld) {
            (Some(_), _) => vec![Span::styled("gone", faint())],
            (None, Some(withheld)) => vec![why(&withheld)],
            (None, None) => {
                present += 1;
                let is = match contact.detected {
                    1 => Span::styled("detected", doubtful()),
                    _ => Span::styled("present", good()),
                };
                let (of_force, of_torque) = contact.standard_deviation.split_at(3);
                let mut cells = vec![is];
                cells.extend(vector(contact.force, of_force, 1));
                cells.extend(vector(contact.torque, of_torque, 2));
                let [x, y, z] = contact.position;
                cells.push(match contact.located {
                    1 => Span::raw(format!("{x:.3} {y:.3} {z:.3} in {}", entry.origin)),
                    _ => Span::styled(format!("as configured, in {}", entry.origin), faint()),
                });
                cells
            }
        };
        section.push(entry.name, cells);
    }
    let all = section.rows.len();
    section.summary = match old {
        _ if all == 0 => Span::styled("none configured", faint()),
        Some(old) => old,
        None => Span::raw(format!("{present} of {all} present")),
    };
    section
}

fn channels(snapshot: &RobotState, now: Nanos) -> TableSection {
    let mut section = TableSection::new("CHANNELS", "channel|kind|>rate [Hz]|>age|quality");
    let names = snapshot.channel_names.as_deref();
    let newest = snapshot.gateway.1.as_deref();
    let mut alive = 0;
    for entry in names.map(Description::entries).unwrap_or_default() {
        let number = entry.index as usize;
        let (Some(kind), Some(channel)) = (entry.kind.get(), snapshot.channels.get(number)) else {
            continue;
        };
        if entry.role != Role::Channel {
            continue;
        }
        let before = newest.and_then(|health| health.newest.get(number).copied());
        let last = channel.last.or(before.filter(|t| *t > Nanos::MIN));
        let age = last.map(|last| now.saturating_sub(last));
        let limit = SILENCE.max(entry.max_silence);
        let is_alive = age.is_some_and(|age| age <= limit);
        alive += usize::from(is_alive);
        let quality = match (channel.quality, is_alive) {
            (_, false) if age.is_none() => Span::styled("never seen", bad()),
            (_, false) => Span::styled("silent", bad()),
            (None, true) => Span::raw(""),
            (Some(quality), true) => {
                // That a device counts its readings says nothing about them.
                let flags = proprio_topics::Quality::DEVICE_COUNTER.0;
                let is_good = quality.0 & !flags == 0;
                let style = if is_good { good() } else { doubtful() };
                Span::styled(quality.to_string(), style)
            }
        };
        let cells = vec![
            Span::raw(kind.word()),
            Span::raw(match is_alive {
                true => format!("{:.1}", channel.rate),
                false => "0.0".to_owned(),
            }),
            Span::raw(age.map_or_else(|| "-".to_owned(), duration)),
            quality,
        ];
        section.push(entry.name, cells);
    }
    section.summary = share(alive, section.rows.len(), "alive");
    section
}

impl TableSection {
    fn new(title: &'static str, head: &'static str) -> Self {
        Self {
            title,
            head,
            ..Self::default()
        }
    }

    fn push(&mut self, name: impl ToString, cells: Vec<Span<'static>>) {
        let name = name.to_string();
        self.rows.push(SectionRow { name, cells });
    }

    /// With `summary`, unless what the gateway said last is old.
    fn of_gateway(mut self, snapshot: &RobotState, now: Nanos, summary: Span<'static>) -> Self {
        let said = snapshot.gateway.1.as_deref().map(|it| it.header.published);
        let old = said.and_then(|said| old("as of", snapshot.gateway.0, said, now));
        if old.is_some() {
            let cells = self.rows.iter_mut().flat_map(|row| &mut row.cells);
            cells.for_each(|cell| cell.style = faint());
        }
        self.summary = old.unwrap_or(summary);
        self
    }
}

fn devices(snapshot: &RobotState, now: Nanos) -> TableSection {
    let mut section = TableSection::new("DEVICES", "device|bus|state|>rate [Hz]|notes, counters");
    let Some(health) = snapshot.gateway.1.as_deref() else {
        return section;
    };
    let rates = snapshot.readings.iter().chain(std::iter::repeat(&0.0));
    let mut streaming = 0;
    for (device, rate) in health.devices().iter().zip(rates) {
        let state = device.state.get();
        let style = match state {
            Some(DeviceState::Streaming) => good(),
            Some(DeviceState::Silent | DeviceState::Refused) | None => bad(),
            Some(_) => doubtful(),
        };
        streaming += usize::from(state == Some(DeviceState::Streaming));
        let mut notes = Vec::new();
        notes.extend(Refusal::from_code(device.refusal).map(|it| it.to_string()));
        for (mask, what) in [
            (device.frozen_axes, "frozen"),
            (device.beyond_axes, "out of range"),
        ] {
            if mask != 0 {
                notes.push(format!("{} {what}", axes(mask)));
            }
        }
        let style_of_notes = if notes.is_empty() { faint() } else { bad() };
        // The rate tells of these.
        let others = counts(device, &[Counter::Frames, Counter::Readings]);
        notes.extend((!others.is_empty()).then_some(others));
        let bus = health.buses().get(device.bus as usize);
        let cells = vec![
            Span::raw(bus.map_or_else(String::new, |bus| bus.name.to_string())),
            Span::styled(state.map_or("unknown", DeviceState::word), style),
            Span::raw(format!("{rate:.1}")),
            Span::styled(notes.join("; "), style_of_notes),
        ];
        section.push(device.name, cells);
    }
    let summary = share(streaming, section.rows.len(), "streaming");
    section.of_gateway(snapshot, now, summary)
}

fn buses(snapshot: &RobotState, now: Nanos) -> TableSection {
    let mut section = TableSection::new(
        "BUSES",
        "bus|link|controller|load|>dropped|>error frames|>not sent",
    );
    let Some(health) = snapshot.gateway.1.as_deref() else {
        return section;
    };
    let mut up = 0;
    for bus in health.buses() {
        let link = bus.link.get();
        let is_up = matches!(link, Some(LinkState::Up));
        up += usize::from(is_up);
        let controller = match bus.interface.controller.get().unwrap_or_default() {
            Controller::Unknown => Span::styled("unknown", faint()),
            state => {
                let style = match state {
                    Controller::Active => good(),
                    Controller::Warning | Controller::Passive => doubtful(),
                    _ => bad(),
                };
                let (tx, rx) = (
                    bus.interface.tx_error_counter,
                    bus.interface.rx_error_counter,
                );
                Span::styled(format!("{}, errors tx {tx} rx {rx}", state.word()), style)
            }
        };
        let count = |count: u64| {
            let style = if count > 0 { doubtful() } else { faint() };
            Span::styled(count.to_string(), style)
        };
        let cells = vec![
            Span::styled(
                link.map_or("unknown", LinkState::word),
                if is_up { good() } else { bad() },
            ),
            controller,
            Span::raw(load(bus.load, bus.frame_rate)),
            count(bus.dropped),
            count(bus.error_frames),
            count(bus.send_failures),
        ];
        section.push(bus.name, cells);
    }
    let summary = share(up, section.rows.len(), "up");
    section.of_gateway(snapshot, now, summary)
}

fn identification(snapshot: &RobotState, now: Nanos) -> TableSection {
    let mut section = TableSection::new(
        "IDENTIFICATION",
        "link, sensor|mass, or offset known to|from motion of|",
    );
    let Some(estimator) = snapshot.estimator.1.as_deref() else {
        return section;
    };
    let health = &estimator.identification;
    let said = estimator.header.published;
    section.summary = match health.groups {
        0 => Span::styled("not enabled ([identification] of estimator.toml)", faint()),
        groups => {
            let style = if health.paused > 0 {
                doubtful()
            } else {
                good()
            };
            let text = format!("groups: {groups}, paused: {}", health.paused);
            let old = old("as of", snapshot.estimator.0, said, now);
            old.unwrap_or(Span::styled(text, style))
        }
    };
    if health.groups > 0 {
        section.push("instants", vec![Span::raw(health.to_string())]);
    }
    let Some(inertia) = snapshot.inertia() else {
        return section;
    };
    let known = |accepted: u32, deviations: &[f64], what: &str| {
        let unknown = deviations.iter().filter(|it| it.is_nan()).count();
        match (accepted, unknown) {
            (0, _) => Span::styled("nothing accepted yet", doubtful()),
            (_, 0) => Span::raw(""),
            (_, unknown) => {
                let text = format!("{unknown} of {} {what} unknown", deviations.len());
                Span::styled(text, doubtful())
            }
        }
    };
    for link in inertia.links() {
        let [mass, ..] = link.parameters;
        let [deviation, ..] = link.standard_deviation;
        let two_sigma = match deviation.is_nan() {
            true => "not known".to_owned(),
            false => format!("± {:.3} kg", 2.0 * deviation),
        };
        let cells = vec![
            Span::raw(format!("{mass:.3} {two_sigma}")),
            Span::raw(format!("{:.1} s", link.motion)),
            known(link.accepted, &link.standard_deviation, "parameters"),
        ];
        section.push(link.name, cells);
    }
    for offset in inertia.offsets() {
        let (force, torque) = offset.standard_deviation.split_at(3);
        let largest = |axes: &[f64]| 2.0 * axes.iter().copied().fold(0.0, f64::max);
        let text = format!("± {:.3} N, ± {:.4} Nm", largest(force), largest(torque));
        let cells = vec![
            Span::raw(text),
            Span::raw(""),
            known(offset.accepted, &offset.standard_deviation, "axes"),
        ];
        section.push(offset.name, cells);
    }
    section
}

/// How a daemon is, in words.
pub(super) fn presence(presence: Presence, started: Option<Nanos>, now: Nanos) -> Span<'static> {
    let style = match presence {
        Presence::Running => good(),
        Presence::NotStarted | Presence::Ended => doubtful(),
        Presence::Stuck { .. } | Presence::Killed => bad(),
    };
    let up = match (presence, started) {
        (Presence::Running, Some(started)) => {
            format!(", up {}", duration(now.saturating_sub(started)))
        }
        _ => String::new(),
    };
    Span::styled(format!("{presence}{up}"), style)
}
