//! `proprio estimator`: runs the daemon, or checks its configuration against the gateway's.

mod running;

use proprio_estimator::check::Posture;
use proprio_estimator::config::InvalidConfig;
use proprio_estimator::daemon;
use proprio_estimator::setup::{Setup, nearest};
use proprio_gateway::plan::Plan;
use proprio_topics::ipc::DomainConfig;
use std::path::{Path, PathBuf};

/// `proprio estimator`.
#[derive(clap::Args)]
pub(crate) struct EstimatorArgs {
    /// The configuration file
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Check the configuration, print the plan, masses, F/T readings to expect at rest and torques
    /// that will be withheld, and exit
    #[arg(long)]
    check: bool,
    /// With --check: the position of a joint [rad or m]; may be repeated; default: that of the
    /// robot if its gateway runs, else zero
    #[arg(long, value_name = "JOINT=RAD", requires = "check")]
    at: Vec<String>,
    /// With --check: also check that this gateway.toml publishes all channels that the estimator
    /// reads
    #[arg(long, value_name = "FILE", requires = "check")]
    gateway: Option<PathBuf>,
}

/// Runs the daemon, or checks the configuration.
pub(crate) fn run(args: &EstimatorArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    if !args.check {
        return daemon::run(&args.config, domain);
    }
    let setup = daemon::check(&args.config, |setup| posture(setup, &args.at, domain))?;
    match &args.gateway {
        Some(gateway) => fits(&args.config, &setup, gateway),
        None => Ok(()),
    }
}

/// The posture that is given; without any, that of the robot if its gateway runs.
fn posture(setup: &Setup, at: &[String], domain: &DomainConfig) -> Result<Posture, String> {
    if at.is_empty() {
        match running::posture(setup, domain) {
            Ok(Some(posture)) => return Ok(posture),
            Ok(None) => {}
            Err(why) => tracing::warn!("the posture of the running robot is not known: {why}"),
        }
    }
    Posture::parse(setup, at)
}

/// Checks that the gateway publishes all channels that the estimator reads; prints the result.
fn fits(config: &Path, setup: &Setup, gateway: &Path) -> anyhow::Result<()> {
    let plan = Plan::load(gateway)?;
    let invalid = |problem: String| InvalidConfig {
        file: config.to_owned(),
        problem,
    };
    if plan.robot != setup.robot.name {
        let (own, other) = (&setup.robot.name, &plan.robot);
        let file = gateway.display();
        return Err(invalid(format!(
            "robot = {own:?}, but robot = {other:?} in {file}: they would not find each other"
        ))
        .into());
    }
    let missing = missing(setup, &plan);
    if !missing.is_empty() {
        let file = gateway.display();
        return Err(invalid(format!("{file} publishes no {}", missing.join(", no "))).into());
    }
    let reads = |name: &str| setup.channels().any(|(_, own)| own == name);
    let unread: Vec<&str> = plan
        .channels
        .iter()
        .map(|c| c.name.as_str())
        .filter(|name| !reads(name))
        .collect();
    let more = match unread.as_slice() {
        [] => String::new(),
        names => format!("; it does not read {}", names.join(", ")),
    };
    print_line!(
        "{} publishes all channels that the estimator reads{more}",
        gateway.display()
    );
    Ok(())
}

/// The channels that the estimator reads and the gateway does not publish, as text.
fn missing(setup: &Setup, plan: &Plan) -> Vec<String> {
    let absent = setup.channels().filter_map(|(kind, name)| {
        let published = plan.channels.iter().find(|other| other.name == name);
        match published {
            Some(other) if other.kind == kind => None,
            Some(other) => Some(format!(
                "{}/{name} (it is {} there)",
                kind.word(),
                other.kind.word()
            )),
            None => {
                let alike = plan.channels.iter().filter(|other| other.kind == kind);
                let hint = nearest(name, alike.map(|other| other.name.as_str()));
                Some(format!(
                    "{}/{name} ({})",
                    kind.word(),
                    hint.trim_start_matches("; ")
                ))
            }
        }
    });
    absent.collect()
}
