//! `proprio scan`: which devices are on a bus, or were when a log was recorded.

use crate::convert::StatedStamps;
use anyhow::Context as _;
use proprio_drivers::recognise::Stream;
use proprio_drivers::{Finding, Traffic};
use proprio_gateway::clock::Monotonic;
use proprio_gateway::config::FrameSource;
use proprio_gateway::link::adapter;
use proprio_gateway::link::interface::{Interfaces as _, Netlink};
use proprio_gateway::link::socketcan::SocketCan;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, ListenOnly};
use proprio_gateway::scan::{self, FoundDevice};
use proprio_simulator::parse_bus;
use proprio_topics::Nanos;
use proprio_topics::ipc::DomainConfig;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// What a person must know before a scan.
pub(crate) const WARNING: &str = "\
Without --active and --ask nothing is sent. (A controller acknowledges the frames of others as any
does; `ip link set can0 type can listen-only on` prevents that too.)

iCub boards that are switched on wait 5 s in their bootloader, and stay in it if they hear any
frame meanwhile: switch them on at least 6 s before a scan that asks.";

/// `proprio scan`.
#[derive(clap::Args)]
#[command(after_help = WARNING)]
pub(crate) struct ScanArgs {
    /// The bus: can0 or virtual:NAME
    #[arg(
        long,
        value_name = "BUS",
        required_unless_present = "log",
        conflicts_with = "log"
    )]
    bus: Option<String>,
    /// Scan a recorded log (any format that decode reads) instead of a bus
    #[arg(long, value_name = "FILE", conflicts_with_all = ["active", "ask", "seconds"])]
    log: Option<PathBuf>,
    #[command(flatten)]
    stamps: StatedStamps,
    #[command(flatten)]
    how: How,
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// How buses are scanned.
#[derive(clap::Args)]
pub(crate) struct How {
    /// How long to listen [s]
    #[arg(long, value_name = "N", default_value_t = 5.0, value_parser = seconds)]
    seconds: f64,
    /// Also ask: iCub boards (DISCOVER), CANopen nodes (SDO reads of 1000, 1018 and 1800 to 1803),
    /// ODrives that are heard (Get_Version), Damiao motors 1 to 32 (state and a register, on 7FF),
    /// and on CAN FD moteus controllers (a query). These questions start, move and change nothing,
    /// but for ODrives numbered 48 to 51 or 56 that send no heartbeat
    #[arg(long)]
    active: bool,
    /// As --active, and also ask devices of this driver: ati_netcanoem, robotous_rft, jr3_can,
    /// robstride or myactuator; may be repeated. Other devices take their questions for commands,
    /// and motors may move: only on a bus without CANopen nodes, and without CubeMars motors
    #[arg(long, value_name = "DRIVER", value_parser = asked_by_name)]
    ask: Vec<String>,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (0.1..=3600.0).contains(&s) => Ok(s),
        _ => Err("must be 0.1 to 3600".into()),
    }
}

fn asked_by_name(text: &str) -> Result<String, String> {
    let names: Vec<&str> = proprio_drivers::asked_by_name().collect();
    match names.contains(&text) {
        true => Ok(text.to_owned()),
        false => Err(format!("must be {}", names.join(" or "))),
    }
}

/// Opens a bus; also returns the interface, of a bus of the kernel.
pub(crate) fn open_bus(
    source: &FrameSource,
    domain: &DomainConfig,
) -> anyhow::Result<(Box<dyn Link>, Option<String>)> {
    Ok(match source {
        FrameSource::SocketCan(named) => {
            let link = SocketCan::open_adapter(named, Path::new(adapter::SYS), &[])?;
            let interface = link.interface().to_owned();
            (Box::new(link), Some(interface))
        }
        FrameSource::Virtual { name } => {
            (Box::new(VirtualBus::open(&domain.name, name, &[])?), None)
        }
        FrameSource::Replay { log, .. } => anyhow::bail!("{} is a log", log.display()),
    })
}

/// What was heard on a bus.
pub(crate) struct ScanResult {
    pub(crate) traffic: Traffic,
    /// How many questions were sent.
    pub(crate) asked: usize,
}

impl How {
    /// Listens to `source`, and asks if that is wanted.
    pub(crate) fn scan(
        &self,
        source: &FrameSource,
        domain: &DomainConfig,
    ) -> anyhow::Result<ScanResult> {
        let (mut link, interface) = open_bus(source, domain)?;
        let fd = interface.is_none_or(|interface| {
            let health = Netlink::default().ask(&interface);
            health.is_ok_and(|health| health.fd == 1)
        });
        let asks = self.active || !self.ask.is_empty();
        if !asks {
            link = Box::new(ListenOnly(link));
        }
        let time = Nanos::from_seconds(self.seconds);
        let mut traffic = scan::hear(&mut *link, &Monotonic, time)?;
        let mut asked = 0;
        if asks {
            let named: Vec<&str> = self.ask.iter().map(String::as_str).collect();
            asked = scan::ask(&mut *link, &Monotonic, &named, fd, &mut traffic)?;
        }
        Ok(ScanResult { traffic, asked })
    }
}

/// Scans a bus or a log, and prints what is found.
pub(crate) fn run(args: &ScanArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let mut buses = Vec::new();
    let mut notes = Vec::new();
    match (&args.bus, &args.log) {
        (Some(bus), _) => {
            let source = parse_bus(bus)?;
            let heard = (args.how.scan(&source, domain)).with_context(|| format!("bus {bus}"))?;
            let how = match heard.asked {
                0 => "nothing was sent".to_owned(),
                asked => format!("{asked} questions were sent"),
            };
            buses.push((bus.clone(), how, heard.traffic));
        }
        (None, Some(log)) => {
            let open = || -> std::io::Result<_> {
                scan::log(
                    std::io::BufReader::new(proprio_gateway::log::open(log)?),
                    args.stamps.meaning(),
                )
            };
            let (found, told) = open().with_context(|| log.display().to_string())?;
            notes = told;
            let found = found.into_iter();
            buses.extend(found.map(|(name, heard)| (name, "a recorded log".to_owned(), heard)));
        }
        (None, None) => {}
    }
    let mut rows = Vec::new();
    let mut joints = 0;
    for (name, how, heard) in &buses {
        let devices = scan::devices(heard, "");
        if args.json {
            rows.push(as_json(name, heard, &devices));
        } else {
            print_part!("{}", as_text(name, how, heard, &devices));
            print_part!("{}", blocks(&devices, &mut joints));
        }
    }
    if args.json {
        print_line!("{}", Value::from(rows));
    }
    for note in notes {
        tracing::warn!("{note}");
    }
    Ok(())
}

/// The tables of devices, to be copied.
fn blocks(devices: &[FoundDevice], joints: &mut usize) -> String {
    match scan::tables(devices, joints).as_str() {
        "" => String::new(),
        text => format!("\nfor gateway.toml:\n{text}\n"),
    }
}

/// The formats of a stream's frames.
fn formats(stream: &Stream) -> String {
    let all = [
        ("classic", stream.frames - stream.fd),
        ("FD", stream.fd),
        ("remote", stream.remote),
    ];
    let present = all.iter().filter(|(_, count)| *count > 0);
    let words: Vec<&str> = present.map(|(word, _)| *word).collect();
    words.join("+")
}

/// The bits that change, as hexadecimal digits; two dots for a byte of which none does.
fn changing(stream: &Stream) -> String {
    let mut text = String::new();
    for mask in stream.changing() {
        let _ = match mask {
            0 => write!(text, ".."),
            mask => write!(text, "{mask:02X}"),
        };
    }
    text
}

/// The names of the devices that explain a stream.
fn explained<'d>(devices: &'d [FoundDevice], stream: &Stream) -> Vec<&'d str> {
    let devices = devices.iter().filter(|device| device.explains(stream.id));
    devices.map(|device| device.name.as_str()).collect()
}

fn certainty(finding: &Finding) -> &'static str {
    finding.certainty().map_or("", |certainty| certainty.word())
}

/// The word and the probability.
fn sure(finding: &Finding) -> String {
    format!("{} ({})", certainty(finding), finding.percent())
}

fn as_text(name: &str, how: &str, heard: &Traffic, devices: &[FoundDevice]) -> String {
    let mut text = String::new();
    let frames: u64 = heard.streams().map(|s| s.frames + s.remote).sum();
    let count = heard.streams().count();
    let _ = writeln!(
        text,
        "bus {name}: {frames} frames, {count} identifiers; {how}\n"
    );
    for device in devices {
        let finding = &device.finding;
        let _ = writeln!(
            text,
            "{:<22} {}: {}",
            sure(finding),
            device.name,
            finding.what
        );
        if !finding.unusable.is_empty() {
            let _ = writeln!(text, "{:<22} {}", "", finding.unusable);
        }
        for rival in &device.rivals {
            let _ = writeln!(
                text,
                "{:<22} or {} at address {}: {}",
                "",
                rival.driver,
                rival.address,
                sure(rival)
            );
        }
    }
    if devices.is_empty() {
        text.push_str(match frames {
            0 => {
                "nothing was heard: are the boards on, is the bit rate right, do they wait to be \
                 asked (--active; --ask DRIVER for a driver that its help names)?\n"
            }
            _ => {
                "no device was recognised; some answer only if they are asked (--active, --ask \
                 DRIVER), and driver \"dbc\" reads what a .dbc file describes\n"
            }
        });
    }
    if count > 0 {
        text += &streams(heard, devices);
    }
    text
}

/// The table of the identifiers that were heard.
fn streams(heard: &Traffic, devices: &[FoundDevice]) -> String {
    let mut text = String::new();
    let _ = writeln!(
        text,
        "\n{:<10} {:>9} {:>8} {:>5}  {:<8} {:<16} device",
        "id", "frames", "1/s", "bytes", "format", "changing bits"
    );
    let mut unknown = false;
    for stream in heard.streams() {
        let (least, most) = stream.lengths;
        let bytes = match least == most {
            true => least.to_string(),
            false => format!("{least}-{most}"),
        };
        let names = explained(devices, stream);
        unknown |= names.is_empty();
        let device = match names.is_empty() {
            true => "unknown".to_owned(),
            false => names.join(", "),
        };
        let _ = writeln!(
            text,
            "{:<10} {:>9} {:>8.1} {:>5}  {:<8} {:<16} {device}",
            stream.id.to_string(),
            stream.frames + stream.remote,
            stream.rate(),
            bytes,
            formats(stream),
            changing(stream),
        );
    }
    if unknown {
        text.push_str(
            "\nA device that no driver knows can be described by a .dbc file: driver = \"dbc\".\n",
        );
    }
    text
}

fn as_json(name: &str, heard: &Traffic, devices: &[FoundDevice]) -> Value {
    let keys = |finding: &Finding| -> Value {
        let keys = finding.keys.iter().map(|key| {
            let value = (key.value.parse::<toml::Value>().ok())
                .and_then(|value| serde_json::to_value(value).ok());
            (key.name.to_owned(), value.unwrap_or(Value::Null))
        });
        Value::Object(keys.collect())
    };
    let row = |finding: &Finding| {
        json!({
            "driver": finding.driver,
            "address": finding.address,
            "certainty": certainty(finding),
            "probability": finding.probability(),
            "bits": (finding.bits * 10.0).round() / 10.0,
            "what": finding.what,
            "keys": keys(finding),
            "fill_in": (finding.keys.iter().filter(|key| !key.note.is_empty()))
                .map(|key| key.name).collect::<Vec<_>>(),
            "joints": finding.joints,
            "unusable": finding.unusable,
        })
    };
    let found = devices.iter().map(|device| {
        let mut found = row(&device.finding);
        if let Some(object) = found.as_object_mut() {
            let rivals: Vec<Value> = device.rivals.iter().map(row).collect();
            object.insert("name".into(), device.name.clone().into());
            object.insert("rivals".into(), rivals.into());
        }
        found
    });
    let streams = heard.streams().map(|stream| {
        json!({
            "id": stream.id.to_string(),
            "frames": stream.frames,
            "remote_frames": stream.remote,
            "fd_frames": stream.fd,
            "frames_per_s": stream.rate(),
            "bytes": [stream.lengths.0, stream.lengths.1],
            "changing": changing(stream),
            "devices": explained(devices, stream),
        })
    });
    json!({
        "bus": name,
        "devices": found.collect::<Vec<_>>(),
        "identifiers": streams.collect::<Vec<_>>(),
    })
}
