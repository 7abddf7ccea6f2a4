//! `proprio estimator`: the daemon, and the check of its configuration beside the gateway's.

use proprio_estimator::config::ConfigError;
use proprio_estimator::daemon;
use proprio_estimator::setup::{Setup, nearest};
use proprio_gateway::plan::Plan;
use proprio_topics::ipc::DomainConfig;
use std::path::{Path, PathBuf};

/// `proprio estimator`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The configuration file
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print the plan, masses and what F/T sensors should read at rest, and end
    #[arg(long)]
    check: bool,
    /// With --check: whether this gateway.toml publishes all that the estimator reads
    #[arg(long, value_name = "FILE", requires = "check")]
    gateway: Option<PathBuf>,
}

/// Runs it, or checks.
pub(crate) fn run(args: &Args, domain: &DomainConfig) -> anyhow::Result<()> {
    if !args.check {
        return daemon::run(&args.config, domain);
    }
    let setup = daemon::check(&args.config)?;
    match &args.gateway {
        Some(gateway) => fits(&args.config, &setup, gateway),
        None => Ok(()),
    }
}

/// Says what the gateway publishes that the estimator reads, and what it does not.
fn fits(config: &Path, setup: &Setup, gateway: &Path) -> anyhow::Result<()> {
    let plan = Plan::load(gateway)?;
    let wrong = |problem: String| ConfigError {
        file: config.to_owned(),
        problem,
    };
    if plan.robot != setup.robot {
        let (own, other) = (&setup.robot, &plan.robot);
        let file = gateway.display();
        return Err(wrong(format!(
            "robot = {own:?}, but {other:?} in {file}: they would not find each other"
        ))
        .into());
    }
    let missing = missing(setup, &plan);
    if !missing.is_empty() {
        let file = gateway.display();
        return Err(wrong(format!("{file} publishes no {}", missing.join(", no "))).into());
    }
    let reads = |name: &str| setup.channels().iter().any(|channel| channel.name == name);
    let unread: Vec<&str> = plan
        .channels
        .iter()
        .map(|c| c.name.as_str())
        .filter(|name| !reads(name))
        .collect();
    let more = match unread.as_slice() {
        [] => String::new(),
        names => format!("; it reads nothing of {}", names.join(", ")),
    };
    say!("{} publishes all that the estimator reads{more}", gateway.display());
    Ok(())
}

/// What the estimator reads and the gateway does not publish, in words.
fn missing(setup: &Setup, plan: &Plan) -> Vec<String> {
    let absent = setup.channels().iter().filter_map(|channel| {
        let (kind, name) = (channel.kind, &channel.name);
        let published = plan.channels.iter().find(|other| other.name == *name);
        match published {
            Some(other) if other.kind == kind => None,
            Some(other) => Some(format!("{}/{name} (it is {} there)", kind.word(), other.kind.word())),
            None => {
                let alike = plan.channels.iter().filter(|other| other.kind == kind);
                let hint = nearest(name, alike.map(|other| other.name.as_str()));
                Some(format!("{}/{name} ({})", kind.word(), hint.trim_start_matches("; ")))
            }
        }
    });
    absent.collect()
}
