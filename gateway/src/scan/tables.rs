//! The tables of gateway.toml for the devices found, with comments about what a person has to fill
//! in.

use super::found::FoundDevice;
use crate::config::FrameSource;
use crate::link::adapter::Adapter;
use proprio_drivers::{Certainty, Finding};
use std::fmt::Write as _;

/// A bus that was scanned.
#[derive(Debug, Clone)]
pub struct ScannedBus {
    /// Its name in the configuration.
    pub name: String,
    /// The source of its frames.
    pub source: FrameSource,
    /// The name of its interface when it was scanned, if the source does not say it; empty if it
    /// has none.
    pub interface: String,
    /// Its bit rate, and that of the data phase of CAN FD \[bit/s\]; 0 if not known.
    pub bit_rates: (u32, u32),
    /// Its devices.
    pub devices: Vec<FoundDevice>,
}

/// A device that sends more seldom than this \[ms\] needs a longer maximum silence than the usual
/// 100 ms: four periods.
const USUAL_PERIOD_MS: u32 = 25;

/// What the comment behind a placeholder begins with.
pub(crate) const FILL_IN: &str = "fill in";

/// The lines of a gateway.toml whose placeholders are not filled in, with their numbers. Nobody
/// can tell a placeholder from a value that is right: the comment is the mark.
#[must_use]
pub fn placeholders(text: &str) -> Vec<String> {
    let mark = format!("# {FILL_IN}:");
    let lines = text.lines().zip(1..);
    let marked = lines.filter_map(|(line, number)| {
        let (key, note) = line.split_once(&mark)?;
        let key = key.trim();
        (!key.is_empty() && !key.starts_with('#'))
            .then(|| format!("  line {number}: {key} ({})", note.trim()))
    });
    marked.collect()
}

/// A text as TOML writes it.
fn quoted(text: &str) -> String {
    toml::Value::from(text).to_string()
}

/// `[[bus.device]]` for each device; `joints` counts their joints. Possible ones are comments.
#[must_use]
pub fn tables(devices: &[FoundDevice], joints: &mut usize) -> String {
    let mut text = String::new();
    for device in devices {
        let finding = &device.finding;
        let certainty = finding.certainty().unwrap_or(Certainty::Possible);
        let mut table = String::new();
        let _ = writeln!(table, "# {}: {}", sure(finding), line(&finding.what));
        for rival in &device.rivals {
            let _ = writeln!(table, "# or: {}", said(rival));
        }
        if finding.unusable.is_empty() {
            let mut keys = String::new();
            keys_of(device, joints, &mut keys);
            for line in keys.lines() {
                // Whoever is sure of it takes the comment signs away.
                let comment = if certainty == Certainty::Possible {
                    "# "
                } else {
                    ""
                };
                let _ = writeln!(table, "{comment}{line}");
            }
        } else {
            let _ = writeln!(table, "# {}", finding.unusable);
        }
        text.push('\n');
        for line in table.lines() {
            let _ = writeln!(text, "  {line}");
        }
    }
    text
}

/// How sure it is, in a word and as a probability.
fn sure(finding: &Finding) -> String {
    let certainty = finding.certainty().unwrap_or(Certainty::Possible);
    format!("{} ({})", certainty.word(), finding.percent())
}

/// A finding in a line.
fn said(finding: &Finding) -> String {
    let (driver, address) = (finding.driver, finding.address);
    let what = line(&finding.what);
    format!("{driver} at address {address}: {}, {what}", sure(finding))
}

/// What a device says of itself, for a comment.
fn line(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

fn keys_of(device: &FoundDevice, joints: &mut usize, text: &mut String) {
    let finding = &device.finding;
    let _ = writeln!(text, "[[bus.device]]");
    let _ = writeln!(text, "driver = {}", quoted(finding.driver));
    let _ = writeln!(text, "name = {}", quoted(&device.name));
    let _ = writeln!(text, "address = {}", finding.address);
    for key in &finding.keys {
        let note = match key.note {
            "" => String::new(),
            note => format!("  # {FILL_IN}: {note}"),
        };
        let _ = writeln!(text, "{} = {}{note}", key.name, key.value);
    }
    let period = finding.keys.iter().find(|key| key.name == "period_ms");
    if let Some(period) = period.and_then(|key| key.value.parse::<u32>().ok())
        && period > USUAL_PERIOD_MS
    {
        let _ = writeln!(text, "max_silence_ms = {}", 4 * period);
    }
    for channel in &finding.joints {
        *joints += 1;
        let _ = writeln!(text, "  [[bus.device.joint]]");
        let _ = writeln!(
            text,
            "  name = \"joint_{joints}\"  # {FILL_IN}: its name in the URDF"
        );
        if *channel != 0 {
            let _ = writeln!(text, "  channel = {channel}");
        }
        let _ = writeln!(
            text,
            "  ratio = 1.0  # {FILL_IN}: gear ratio, and sign, offset_rad"
        );
    }
}

/// The sender of the SYNC, if a device waits for one.
fn sync(devices: &[FoundDevice]) -> String {
    let waits = |device: &&FoundDevice| {
        let finding = &device.finding;
        finding.needs_sync && finding.certainty() > Some(Certainty::Possible)
    };
    let Some(first) = devices.iter().find(waits) else {
        return String::new();
    };
    let usual_name = format!("{}_{}", first.finding.driver, first.finding.address);
    let prefix = first.name.strip_suffix(&usual_name).unwrap_or_default();
    let name = quoted(&format!("{prefix}canopen_sync"));
    let who = line(&first.name);
    format!(
        "\n  # {who} sends when a SYNC comes, and nobody sends one.\n  [[bus.device]]\n  \
         driver = \"canopen_sync\"\n  name = {name}\n  period_ms = 10.0\n"
    )
}

/// A whole gateway.toml for robot `robot`.
#[must_use]
pub fn file(robot: &str, buses: &[ScannedBus]) -> String {
    let mut text = format!(
        "# Written by `proprio setup`. `fill in` marks what nobody but a person knows; devices in\n\
         # comments are possible, and not sure enough to be used. To check it (which refuses what\n\
         # is still marked):\n\
         #\n\
         #     proprio gateway --config gateway.toml --check\n\
         #\n\
         # If another program commands the boards of a bus, add `listen_only = true` to the bus:\n\
         # then nothing is sent to it.\n\
         schema = 1\nrobot = {}\n",
        quoted(robot)
    );
    let mut joints = 0;
    for bus in buses {
        let source = match &bus.source {
            FrameSource::SocketCan(Adapter::Interface(name)) => {
                format!("kind = \"socketcan\", interface = {}", quoted(name))
            }
            FrameSource::SocketCan(adapter) => format!("kind = \"socketcan\", {adapter}"),
            FrameSource::Virtual { name } => format!("kind = \"virtual\", name = {}", quoted(name)),
            FrameSource::Replay { log, .. } => {
                let log = log.display().to_string();
                format!("kind = \"replay\", log = {}", quoted(&log))
            }
        };
        let was = match bus.interface.as_str() {
            "" => String::new(),
            interface => format!("  # {interface} when it was scanned"),
        };
        let _ = writeln!(text, "\n[[bus]]\nname = {}", quoted(&bus.name));
        let _ = writeln!(text, "source = {{ {source} }}{was}");
        let (nominal, data) = bus.bit_rates;
        for (key, rate) in [("bit_rate", nominal), ("data_bit_rate", data)] {
            if rate > 0 {
                let _ = writeln!(text, "{key} = {rate}");
            }
        }
        if bus.devices.is_empty() {
            text.push_str("# No device was recognised on it.\n");
        }
        text.push_str(&tables(&bus.devices, &mut joints));
        text.push_str(&sync(&bus.devices));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::found::devices;
    use super::*;
    use crate::plan::Plan;
    use proprio_drivers::recognise::Key;
    use proprio_drivers::{Frame, Id, Traffic};
    use proprio_topics::Kind;
    use std::path::Path;

    fn bus(name: &str, devices: Vec<FoundDevice>) -> ScannedBus {
        ScannedBus {
            name: name.to_owned(),
            source: FrameSource::SocketCan(Adapter::Serial {
                serial: "00\"42".into(),
                channel: Some(1),
            }),
            interface: "can3".into(),
            bit_rates: (500_000, 0),
            devices,
        }
    }

    fn device(driver: &'static str, address: u32, bits: f64) -> FoundDevice {
        FoundDevice {
            name: format!("{driver}_{address}"),
            finding: Finding {
                driver,
                address,
                bits,
                what: "a board\nwith \"a text\"".into(),
                ..Finding::default()
            },
            rivals: vec![],
            claims: vec![],
        }
    }

    #[test]
    fn the_file_is_a_legal_plan_and_says_what_is_missing() {
        let mut strain = device("icub_strain", 13, 40.0);
        strain.finding.keys = vec![Key::new("period_ms", 30)];
        let mut hand = device("icub_pos", 2, 10.0);
        hand.finding.joints = vec![0, 3];
        let mut motor = device("cubemars", 7, 10.0);
        motor.finding.keys = vec![Key::fill_in("model", "\"AK80-9\"", "its ranges")];
        motor.finding.joints = vec![0];
        motor.rivals = vec![device("odrive", 3, 0.0).finding];
        let possible = device("aidin_aft200", 1, 3.0);
        let mut drive = device("canopen_drive", 4, 60.0);
        drive.finding.joints = vec![0];
        drive.finding.needs_sync = true;
        let mut foreign = device("canopen_drive", 5, 60.0);
        foreign.finding.unusable = "no driver";
        let text = file(
            "new-robot",
            &[
                bus("arm", vec![strain, hand, motor, drive, possible, foreign]),
                ScannedBus {
                    source: FrameSource::Virtual { name: "v".into() },
                    interface: String::new(),
                    bit_rates: (0, 0),
                    ..bus("empty", vec![])
                },
            ],
        );
        let plan = Plan::parse(&text, Path::new(".")).unwrap_or_else(|e| panic!("{e}\n{text}"));
        assert_eq!(plan.robot, "new-robot");
        let [arm, empty] = &plan.buses[..] else {
            panic!("{text}")
        };
        assert_eq!((arm.rates.nominal, arm.rates_assumed), (500_000, false));
        assert!(empty.devices.is_empty() && empty.rates_assumed);
        let names: Vec<&str> = arm.devices.iter().map(|d| d.name.as_str()).collect();
        assert_eq!(
            names,
            [
                "icub_strain_13",
                "icub_pos_2",
                "cubemars_7",
                "canopen_drive_4",
                "canopen_sync"
            ]
        );
        let joints = plan.channels.iter().filter(|c| c.kind == Kind::Joint);
        let joints: Vec<&str> = joints.map(|c| c.name.as_str()).collect();
        assert_eq!(joints, ["joint_1", "joint_2", "joint_3", "joint_4"]);
        assert_eq!(arm.devices[0].spec.max_silence.0, 120_000_000);
        assert_eq!(arm.devices[1].spec.outputs.0[..], [0, 3]);
        for part in [
            "serial = \"00\\\"42\", channel = 1 }  # can3 when it was scanned",
            "# or: odrive at address 3: possible (50 %)",
            "model = \"AK80-9\"  # fill in: its ranges",
            "  # driver = \"aidin_aft200\"",
            "# no driver\n",
            "# certain (>99.9999 %): a board with \"a text\"",
            "# No device was recognised on it.",
        ] {
            assert!(text.contains(part), "{part}:\n{text}");
        }
        assert!(text.lines().all(|line| line.trim_end() == line), "{text}");
        // Each mark is told, but for those in comments; without its comment a value is filled in.
        let left = placeholders(&text);
        assert_eq!(left.len(), text.matches("# fill in:").count(), "{left:#?}");
        let model = "model = \"AK80-9\" (its ranges)";
        assert!(left.iter().any(|line| line.ends_with(model)), "{left:#?}");
        let filled: Vec<&str> = (text.lines())
            .map(|line| line.split("  # fill in").next().unwrap_or_default())
            .collect();
        assert_eq!(placeholders(&filled.join("\n")), [""; 0]);
        assert_eq!(placeholders("  # model = 1  # fill in: what"), [""; 0]);
    }

    /// Whatever a bus of arbitrary frames is taken for, its configuration is legal.
    #[test]
    fn found_devices_fit_into_one_plan() {
        let mut heard = Traffic::new();
        for raw in 0..0x800_u16 {
            let data = [raw.to_le_bytes()[0]; 8];
            let len = usize::from(raw % 9);
            heard.on_frame(&Frame::new(Id::standard(raw), &data[..len]));
        }
        for raw in [0x7A0, 0x730] {
            let mut traffic = Traffic::new();
            traffic.on_frame(&Frame::new(Id::standard(raw), &[0xFF, 0x0C, 2, 0, 8]));
            let text = file("r", &[bus("b", devices(&traffic, "b_"))]);
            let plan = Plan::parse(&text, Path::new("."));
            let plan = plan.unwrap_or_else(|e| panic!("{e}\n{text}"));
            let drivers: Vec<&str> = plan.buses[0].devices.iter().map(|d| &*d.driver).collect();
            assert_eq!(drivers, ["icub_imu", "icub_strain"]);
        }
        let text = file("r", &[bus("b", devices(&heard, ""))]);
        Plan::parse(&text, Path::new(".")).unwrap_or_else(|e| panic!("{e}\n{text}"));
    }
}
