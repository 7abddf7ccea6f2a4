#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

mod names;
mod network;
mod node;

use anyhow::Context;
use clap::Parser;
use node::{NodeError, NodeOptions, RosNode};
use proprio_bridge::{ListenError, Listener, Messages};
use proprio_gateway::clock::{realtime_offset, sleep_until};
use proprio_topics::Nanos;
use proprio_topics::ipc::{DomainConfig, monotonic};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;

/// How often diagnostics are published, and the wall clock is looked at.
const SECOND: Nanos = Nanos::from_millis(1000);
/// What comes within this time is sent together: half of the processor's time, and late by this.
const GATHER: Nanos = Nanos::from_millis(2);
/// The longest wait: then signals are looked at.
const WAIT: Nanos = Nanos::from_millis(100);

/// Publish a running robot to ROS 2: joint states with torques, IMUs, F/T sensors, contacts,
/// external wrenches, diagnostics.
///
/// Exit codes: 0 success, 2 wrong command line or variable, 1 any other failure.
#[derive(Parser)]
#[command(name = "proprio-ros2", version, about)]
struct Ros2Args {
    /// The robot; default: the only one
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// The namespace of all topics and of the node
    #[arg(long, value_name = "NAME", default_value = "", value_parser = names::namespace)]
    namespace: String,
    /// The domain of ROS 2's nodes
    #[arg(long, value_name = "N", env = "ROS_DOMAIN_ID", default_value_t = 0,
        value_parser = clap::value_parser!(u16).range(0..=232))]
    domain_id: u16,
    /// A network interface, by name or IPv4 address, to be seen at; lo: on this machine alone.
    /// May be given several times. Default: what ROS_LOCALHOST_ONLY or
    /// ROS_AUTOMATIC_DISCOVERY_RANGE say, else all
    #[arg(long, value_name = "NAME")]
    interface: Vec<String>,
    /// Most messages of each topic per second; default: all
    #[arg(long, value_name = "N", value_parser = rate)]
    rate: Option<f64>,
    /// Do not send lost messages again. Subscriptions that ask for reliable ones, as they do by
    /// default, then get nothing
    #[arg(long)]
    best_effort: bool,
    /// The release of ROS 2 that lists the node: up to humble, identifiers are longer
    #[arg(long, value_name = "NAME", env = "ROS_DISTRO")]
    ros_distro: Option<String>,
    /// The shared-memory domain of gateway and estimator [env: PROPRIO_DOMAIN] [default: default]
    #[arg(long, value_name = "NAME")]
    domain: Option<String>,
}

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate| (1e-3..=1e6).contains(rate));
    rate.ok_or_else(|| "a number of messages per second, from 0.001 on".to_owned())
}

/// The bytes of an identifier in `ros_discovery_info`.
fn identifier(distro: Option<&str>) -> usize {
    let old = ["dashing", "eloquent", "foxy", "galactic", "humble"];
    match distro.is_some_and(|distro| old.contains(&distro)) {
        true => 24,
        false => 16,
    }
}

fn main() -> ExitCode {
    let args = Ros2Args::parse();
    let variable = |name: &str| std::env::var(name).ok();
    let addresses = match network::addresses(&args.interface, variable) {
        Ok(addresses) => addresses,
        Err(error) => {
            eprintln!("error: {error:#}");
            return ExitCode::from(2);
        }
    };
    if variable("ROS_STATIC_PEERS").is_some_and(|peers| !peers.is_empty()) {
        eprintln!("ROS_STATIC_PEERS is not supported: nodes are found by multicast");
    }
    let options = NodeOptions {
        namespace: args.namespace.clone(),
        domain: args.domain_id,
        addresses,
        is_best_effort: args.best_effort,
        rate: args.rate,
        identifier: identifier(args.ros_distro.as_deref()),
    };
    match run(&args, options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let is_wrong = error.downcast_ref::<ListenError>();
            let is_wrong = is_wrong.is_some_and(|it| matches!(it, ListenError::Several { .. }));
            ExitCode::from(if is_wrong { 2 } else { 1 })
        }
    }
}

/// Why a round of listening and publishing ended.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error(transparent)]
    Listen(#[from] ListenError),
    #[error(transparent)]
    Node(#[from] NodeError),
}

/// Follows the robot until a signal comes.
fn run(args: &Ros2Args, options: NodeOptions) -> anyhow::Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [
        signal_hook::consts::SIGINT,
        signal_hook::consts::SIGTERM,
        signal_hook::consts::SIGHUP,
    ] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    let mut config = DomainConfig::from_env();
    if let Some(name) = &args.domain {
        config.name.clone_from(name);
    }
    let node = RosNode::new(options)?;
    let say = |why: &str| eprintln!("waiting: {why}");
    let opened = Listener::wait_open(&config, args.robot.as_deref(), &stop, say)?;
    let Some(mut listener) = opened else {
        return Ok(());
    };
    let robot = listener.robot().to_owned();
    eprintln!("publishing {robot} in domain {}", args.domain_id);
    let mut messages = Messages::new(node, &robot, realtime_offset());
    messages.know(listener.series())?;
    messages.announce()?;
    let mut next = monotonic();
    let mut last_text = String::new();
    while !stop.load(Relaxed) {
        let now = monotonic();
        messages.sink().turn(now)?;
        let heard = listener.poll(now, |listener, event| {
            messages.know(listener.series())?;
            Ok(messages.say(event.t, &event.heard)?)
        });
        match heard {
            Ok(()) => {}
            Err(Failure::Node(error)) => return Err(error.into()),
            // The listener mends itself, or goes on when the robot's daemons do.
            Err(Failure::Listen(error)) => {
                let text = error.to_string();
                if text != last_text {
                    eprintln!("{text}");
                    last_text = text;
                }
                sleep_until(now + WAIT);
            }
        }
        if now >= next {
            next = now + SECOND;
            messages.set_offset(realtime_offset());
            messages.diagnostics(now)?;
        }
        listener.wait(now + WAIT);
        sleep_until(monotonic() + GATHER);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Ros2Args::command().debug_assert();
    }

    #[test]
    fn identifiers_are_longer_up_to_humble() {
        assert_eq!(identifier(Some("humble")), 24);
        assert_eq!(identifier(Some("jazzy")), 16);
        assert_eq!(identifier(None), 16);
    }
}
