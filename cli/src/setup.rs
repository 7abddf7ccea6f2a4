//! `proprio setup`: scans buses and writes a gateway.toml for what is on them. It asks nothing that
//! it can find out; the rest has a placeholder and the comment `fill in`.

use crate::scan::{How, WARNING};
use anyhow::{Context as _, bail};
use proprio_gateway::config::FrameSource;
use proprio_gateway::link::adapter::{self, Adapter, Present};
use proprio_gateway::link::interface::{Interfaces as _, Netlink};
use proprio_gateway::plan::Plan;
use proprio_gateway::scan::{ScannedBus, devices, file};
use proprio_simulator::parse_bus;
use proprio_topics::ipc::DomainConfig;
use std::fs::{self, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// `proprio setup`.
#[derive(clap::Args)]
#[command(after_help = WARNING)]
pub(crate) struct SetupArgs {
    /// The folder of the configuration; it is made if it is not there
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// A bus: can0 or virtual:NAME; may be repeated; default: all CAN interfaces
    #[arg(long, value_name = "BUS")]
    bus: Vec<String>,
    /// The robot's name
    #[arg(long, value_name = "NAME", default_value = "robot")]
    robot: String,
    #[command(flatten)]
    how: How,
    /// Overwrite a gateway.toml that is there
    #[arg(long)]
    force: bool,
}

/// Scans and writes.
pub(crate) fn run(args: &SetupArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let target = args.out.join("gateway.toml");
    // Before the scan, which takes its time.
    if target.exists() && !args.force {
        bail!(
            "{} is there already; --force overwrites it",
            target.display()
        );
    }
    let present = adapter::present(Path::new(adapter::SYS));
    let sources = sources(&args.bus, &present)?;
    if sources.is_empty() {
        bail!(
            "this machine has no CAN interface (`proprio doctor` says why); --bus virtual:NAME \
             scans a virtual bus"
        );
    }
    let mut buses = Vec::new();
    for source in &sources {
        match scanned(args, source, sources.len() > 1, &present, domain) {
            Ok(bus) => buses.extend(bus),
            // Of all interfaces, one that is down is no reason to leave out the others.
            Err((name, error)) if args.bus.is_empty() => {
                eprintln!("bus {name}: left out: {error:#}");
            }
            Err((name, error)) => return Err(error.context(format!("bus {name}"))),
        }
    }
    if buses.is_empty() {
        bail!("no bus could be scanned: nothing was written");
    }
    let text = file(&args.robot, &buses);
    if let Err(problem) = Plan::parse(&text, &args.out) {
        bail!("no configuration can be made of this: {problem}\n\n{text}");
    }
    fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    let write = || -> std::io::Result<()> {
        let mut options = OpenOptions::new();
        let options = options.write(true).create_new(!args.force);
        let mut out = options
            .create(args.force)
            .truncate(args.force)
            .open(&target)?;
        out.write_all(text.as_bytes())
    };
    write().with_context(|| format!("cannot write {}", target.display()))?;
    print_line!(
        "{} is written: fill in what is marked, then",
        target.display()
    );
    print_line!("    proprio gateway --config {} --check", target.display());
    Ok(())
}

/// The buses that are named, else all CAN interfaces.
fn sources(named: &[String], present: &[Present]) -> anyhow::Result<Vec<FrameSource>> {
    let mut sources = Vec::new();
    for bus in named {
        let source = parse_bus(bus)?;
        if sources.contains(&source) {
            bail!("--bus {bus} is given twice");
        }
        sources.push(source);
    }
    if named.is_empty() {
        let interfaces = present.iter().map(|present| present.interface.clone());
        sources.extend(interfaces.map(|name| FrameSource::SocketCan(Adapter::Interface(name))));
    }
    Ok(sources)
}

/// What is on a bus. If there are several, devices have its name before theirs.
///
/// # Errors
/// The bus's name, and why it cannot be scanned.
fn scanned(
    args: &SetupArgs,
    source: &FrameSource,
    is_one_of_several: bool,
    present: &[Present],
    domain: &DomainConfig,
) -> Result<Option<ScannedBus>, (String, anyhow::Error)> {
    let (interface, name) = match source {
        FrameSource::SocketCan(Adapter::Interface(name)) => (Some(name), name.clone()),
        FrameSource::Virtual { name } => (None, name.clone()),
        FrameSource::SocketCan(_) | FrameSource::Replay { .. } => return Ok(None),
    };
    let heard = args.how.scan(source, domain);
    let heard = heard.map_err(|error| (name.clone(), error))?;
    let health = interface.map(|name| Netlink::default().ask(name));
    let health = health.and_then(Result::ok).unwrap_or_default();
    let prefix = match is_one_of_several {
        false => String::new(),
        true => format!("{name}_"),
    };
    let lasting = match interface {
        Some(name) => FrameSource::SocketCan(Adapter::lasting(name, present)),
        None => source.clone(),
    };
    let bus = ScannedBus {
        interface: (interface.filter(|_| lasting != *source).cloned()).unwrap_or_default(),
        source: lasting,
        bit_rates: (health.bit_rate, health.data_bit_rate),
        devices: devices(&heard.traffic, &prefix),
        name,
    };
    match bus.devices.len() {
        0 => eprintln!(
            "bus {}: no device was recognised; `proprio scan` says what was heard",
            bus.name
        ),
        count => eprintln!("bus {}: {count} devices", bus.name),
    }
    Ok(Some(bus))
}
