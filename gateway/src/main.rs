//! The gateway daemon: `proprio gateway` without the rest of the command.

use clap::Parser;
use proprio_gateway::daemon;
use proprio_topics::ipc::DomainConfig;
use std::path::PathBuf;
use std::process::ExitCode;

/// CAN buses in, SI samples in shared memory out.
#[derive(Parser)]
#[command(version, about)]
struct Args {
    /// The configuration: gateway.toml.
    #[arg(long)]
    config: PathBuf,
    /// Print the plan and end.
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
            ExitCode::from(if daemon::is_configuration(&error) { 2 } else { 1 })
        }
    }
}
