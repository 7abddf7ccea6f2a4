//! `proprio setup`: scans buses and writes a gateway.toml for what is on them. It asks nothing that
//! it can find out; the rest has a placeholder and the comment `fill in`.

use crate::scan::{How, WARNING};
use anyhow::{Context as _, bail};
use proprio_gateway::config::FrameSource;
use proprio_gateway::link::adapter::{self, Adapter};
use proprio_gateway::link::interface::{Interfaces as _, Netlink};
use proprio_gateway::plan::Plan;
use proprio_gateway::scan::{ScannedBus, devices, file};
use proprio_simulator::parse_bus;
use proprio_topics::InterfaceHealth;
use proprio_topics::ipc::DomainConfig;
use std::fs::{self, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// `proprio setup`.
#[derive(clap::Args)]
#[command(after_help = WARNING)]
pub(crate) struct Args {
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
pub(crate) fn run(args: &Args, domain: &DomainConfig) -> anyhow::Result<()> {
    let target = args.out.join("gateway.toml");
    // Before the scan, which takes its time.
    if target.exists() && !args.force {
        bail!(
            "{} is there already; --force overwrites it",
            target.display()
        );
    }
    let present = adapter::present(Path::new(adapter::SYS));
    let mut sources = Vec::new();
    for bus in &args.bus {
        let source = parse_bus(bus)?;
        if sources.contains(&source) {
            bail!("--bus {bus} is given twice");
        }
        sources.push(source);
    }
    if args.bus.is_empty() {
        let all = present.iter().map(|present| present.interface.clone());
        sources.extend(all.map(|name| FrameSource::SocketCan(Adapter::Interface(name))));
    }
    if sources.is_empty() {
        bail!(
            "this machine has no CAN interface (`proprio doctor` says why); --bus virtual:NAME \
             scans a virtual bus"
        );
    }
    let mut buses = Vec::new();
    for source in &sources {
        let (interface, name) = match source {
            FrameSource::SocketCan(Adapter::Interface(name)) => (Some(name), name.clone()),
            FrameSource::Virtual { name } => (None, name.clone()),
            FrameSource::SocketCan(_) | FrameSource::Replay { .. } => continue,
        };
        let heard = match (args.how.scan(source, domain), args.bus.is_empty()) {
            (Ok(heard), _) => heard,
            // Of all interfaces, one that is down is no reason to leave out the others.
            (Err(error), true) => {
                eprintln!("bus {name}: left out: {error:#}");
                continue;
            }
            (Err(error), false) => return Err(error.context(format!("bus {name}"))),
        };
        let health = interface.map(|name| Netlink::default().ask(name));
        let health = health
            .and_then(Result::ok)
            .unwrap_or(InterfaceHealth::default());
        let prefix = match sources.len() {
            1 => String::new(),
            _ => format!("{name}_"),
        };
        let lasting = match (interface, source) {
            (Some(name), _) => FrameSource::SocketCan(Adapter::lasting(name, &present)),
            (None, source) => source.clone(),
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
        buses.push(bus);
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
