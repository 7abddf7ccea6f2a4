//! The gateway daemon alone: the same as `proprio gateway`.

use clap::Parser;
use proprio_gateway::daemon;
use proprio_topics::ipc::DomainConfig;
use std::path::PathBuf;
use std::process::ExitCode;

/// Reads CAN buses and publishes SI samples in shared memory.
#[derive(Parser)]
#[command(version, about)]
struct Args {
    /// The configuration file, gateway.toml.
    #[arg(long)]
    config: PathBuf,
    /// Check the configuration, print the resulting plan and exit.
    #[arg(long)]
    check: bool,
}

fn main() -> ExitCode {
    let args = Args::parse();
    daemon::start_logging();
    match daemon::run(&args.config, &DomainConfig::from_env(), args.check) {
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
