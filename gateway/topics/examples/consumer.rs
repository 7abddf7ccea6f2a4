//! An example control loop: reads the torques of a robot at 1 kHz and prints them once a second.
//! Depends only on proprio-topics.
//!
//! `cargo run -p proprio-topics --features ipc --example consumer -- icub [seconds]`
//!
//! PROPRIO_RUNTIME_DIR and PROPRIO_DOMAIN select the domain.
use proprio_topics::Nanos;
use proprio_topics::ipc::{Domain, DomainConfig, Freshness, TorqueReader, monotonic};
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

    let domain = Domain::open(&DomainConfig::from_env())?;
    let mut torques = TorqueReader::new(&domain, &robot, Nanos::from_millis(50));
    let (mut cycles, mut fresh) = (0, 0);
    for _ in 0..seconds {
        for _ in 0..1000 {
            // In every cycle: take new payloads without waiting, then use a torque only if it is
            // valid.
            cycles += 1;
            if torques.update(monotonic()).is_fresh() {
                fresh += 1;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        match torques.freshness() {
            Freshness::NeverSeen => println!("no estimate yet"),
            Freshness::Stale { age } => {
                println!("stale: the last estimate is {:.3} s old", age.seconds());
            }
            Freshness::Fresh { age } => println!(
                "{fresh} of {cycles} cycles fresh, age {:.2} ms",
                age.seconds() * 1e3
            ),
        }
        if let Some(problem) = torques.problem() {
            println!("  {problem}");
        }
        for joint in torques.joints() {
            match torques.torque(joint) {
                Ok(t) => println!(
                    "  {joint:<20} {:>10.4} Nm  +- {:.4}",
                    t.torque, t.standard_deviation
                ),
                Err(why) => println!("  {joint:<20} {why}"),
            }
        }
    }
    Ok(())
}
