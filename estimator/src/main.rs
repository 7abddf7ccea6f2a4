//! The estimator daemon as a program of its own; the same as `proprio estimator`.

use clap::Parser;
use proprio_estimator::daemon;
use proprio_topics::ipc::DomainConfig;
use std::path::PathBuf;
use std::process::ExitCode;

/// Estimates joint torques and contact wrenches from the samples of a robot's sensors.
#[derive(Parser)]
#[command(version, about)]
struct Args {
    /// The configuration: estimator.toml.
    #[arg(long)]
    config: PathBuf,
    /// Check the configuration, print what is read and estimated, and exit.
    #[arg(long)]
    check: bool,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_writer(std::io::stderr)
        .init();
    let done = if args.check {
        daemon::check(&args.config).map(|_| ())
    } else {
        daemon::run(&args.config, &DomainConfig::from_env())
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(if daemon::is_configuration(&error) {
                2
            } else {
                1
            })
        }
    }
}
