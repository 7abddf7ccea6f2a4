//! An example control loop: reads the torques of a robot at 1 kHz and prints them once a second.
//! Depends only on proprio-topics.
//!
//! `cargo run -p proprio-topics --features ipc --example consumer -- icub [seconds]`
//!
//! PROPRIO_RUNTIME_DIR and PROPRIO_DOMAIN select the domain.
use proprio_topics::Nanos;
use proprio_topics::ipc::{DomainConfig, RobotReader, TorqueHandle, monotonic};
use std::process::ExitCode;
use std::time::Duration;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("consumer: {e}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let robot = std::env::args().nth(1).unwrap_or_else(|| "icub".to_owned());
    let seconds: u32 = std::env::args()
        .nth(2)
        .map_or(Ok(u32::MAX), |text| text.parse())?;

    // An estimate that is older than 50 ms is stale. The reader may start before the robot does.
    let max_age = Nanos::from_millis(50);
    let mut reader = RobotReader::new(&DomainConfig::from_env(), &robot, max_age)?;
    let mut joints: Vec<(String, TorqueHandle)> = Vec::new();
    for _ in 0..seconds {
        for _ in 0..1000 {
            // Each cycle: take what has arrived, without waiting.
            reader.update(monotonic());
            std::thread::sleep(Duration::from_millis(1));
        }
        // Once a second, for a person: not part of a cycle.
        if joints.is_empty() {
            let names: Vec<String> = reader.torque_names().map(ToOwned::to_owned).collect();
            joints = names
                .into_iter()
                .map(|name| (name.clone(), reader.torque_handle(&name)))
                .collect();
        }
        let missing = reader.who_is_missing();
        if !missing.is_nobody() {
            println!("{missing}");
        }
        for (name, joint) in &joints {
            match reader.torque(*joint) {
                Ok(t) => println!(
                    "  {name:<20} {:>10.4} Nm  +- {:.4}, {:.2} ms old",
                    t.torque,
                    t.standard_deviation,
                    t.age.seconds() * 1e3
                ),
                Err(why) => println!("  {name:<20} {why}"),
            }
        }
    }
    Ok(())
}
