//! `proprio ctl`: asks a running gateway over its control socket.

use crate::status::load;
use anyhow::{Context, anyhow, bail};
use proprio_gateway::control::{Server, ask, running};
use proprio_gateway::plan::PlanError;
use proprio_topics::ipc::DomainConfig;
use serde_json::{Value as Json, json};
use std::io;

/// `proprio ctl`.
#[derive(clap::Args)]
pub(crate) struct CtlArgs {
    #[command(subcommand)]
    verb: CtlVerb,
    /// The robot; default: the only one whose gateway runs
    #[arg(long, global = true, value_name = "NAME")]
    robot: Option<String>,
    /// Print the gateway's answer as JSON, one object
    #[arg(long, global = true)]
    json: bool,
}

#[derive(clap::Subcommand)]
enum CtlVerb {
    /// The gateway and its buses
    Status,
    /// The devices: state, driver, bus, channels
    Devices,
    /// Make the present load of an F/T sensor its zero, until its board is switched off
    ///
    /// Gravity and contacts of this moment count, too. Offsets that were identified before no
    /// longer hold.
    Tare {
        /// The device's name, or BUS/NAME
        device: String,
    },
    /// The calibration in the memory of an F/T sensor, and what is wrong with it
    ///
    /// Full scales and matrix; the sensor goes on to measure. Exit code 1 if something is wrong:
    /// a full scale of zero, entries of FFFF (erased memory), a row or column of zeros, a matrix
    /// that is nearly singular.
    Calibration {
        /// The device's name, or BUS/NAME
        device: String,
    },
    /// Read the gateway's configuration file again
    ///
    /// Takes over the keys of devices, max_silence_ms, listen_only, and ratio, sign and offset of
    /// joints; the other devices do not notice. If anything else has changed, nothing is taken
    /// over, and the message names what needs a restart of the gateway.
    Reload,
    /// Have a black box (`proprio record --ring`) write the last seconds to a file
    Snapshot,
}

impl CtlVerb {
    const fn server(&self) -> Server {
        match self {
            Self::Snapshot => Server::Recorder,
            _ => Server::Gateway,
        }
    }
}

/// Asks the gateway, or a recorder.
pub(crate) fn run(args: &CtlArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let server = args.verb.server();
    let robot = robot(args.robot.as_deref(), domain, server)?;
    let line = match &args.verb {
        CtlVerb::Status => json!({ "do": "status" }),
        CtlVerb::Devices => json!({ "do": "devices" }),
        CtlVerb::Tare { device } => json!({ "do": "tare", "device": device }),
        CtlVerb::Calibration { device } => json!({ "do": "calibration", "device": device }),
        CtlVerb::Reload => json!({ "do": "reload" }),
        CtlVerb::Snapshot => json!({ "do": "snapshot" }),
    };
    let text = ask(domain, server, &robot, &line.to_string())
        .map_err(|error| match error.kind() {
            io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => {
                let seconds = server.patience().as_secs();
                anyhow!("no answer within {seconds} s: `proprio status` shows whether it is stuck")
            }
            io::ErrorKind::UnexpectedEof => anyhow!("it has ended meanwhile"),
            _ => anyhow!(error),
        })
        .with_context(|| format!("the {} of {robot} does not answer", server.word()))?;
    let answer: Json = serde_json::from_str(&text).context("the answer is not JSON")?;
    if args.json {
        print_line!("{text}");
    }
    if answer["ok"] != true {
        let word = |key: &str| answer[key].as_str().map(str::to_owned);
        return Err(match (word("file"), word("problem")) {
            (Some(file), Some(problem)) => PlanError {
                file: file.into(),
                problem,
            }
            .into(),
            _ => anyhow!(word("error").unwrap_or_else(|| "refused".into())),
        });
    }
    if !args.json {
        match args.verb {
            CtlVerb::Status => status(&answer),
            CtlVerb::Devices => devices(&answer),
            CtlVerb::Tare { .. } => tared(&answer),
            CtlVerb::Calibration { .. } => calibration(&answer),
            CtlVerb::Reload => reloaded(&answer),
            CtlVerb::Snapshot => print_line!("{} is written", word(&answer, "file")),
        }
    }
    let problems: Vec<_> = list(&answer, "problems")
        .iter()
        .filter_map(Json::as_str)
        .collect();
    if !problems.is_empty() {
        let device = word(&answer, "device");
        bail!(
            "the calibration of {device} is wrong: {}; write it again with the maker's tool",
            problems.join("; ")
        );
    }
    Ok(())
}

/// The robot to ask: the named one, or the only one whose server runs.
fn robot(name: Option<&str>, domain: &DomainConfig, server: Server) -> anyhow::Result<String> {
    let which = format!("domain {} in {}", domain.name, domain.base.display());
    let (what, start) = match server {
        Server::Gateway => ("gateway", "proprio gateway --config FILE"),
        Server::Recorder => (
            "recorder with --ring",
            "proprio record --ring SECONDS --out FOLDER",
        ),
    };
    let running = running(domain, server).map_err(|error| match error.kind() {
        io::ErrorKind::PermissionDenied => anyhow!(
            "the {which} belongs to another user: run this as the user of the {what}, for example \
             `sudo -u proprio proprio ctl ...`"
        ),
        _ => anyhow!(error).context(format!("the {which} cannot be read")),
    })?;
    match (name, running.as_slice()) {
        (Some(name), _) if running.iter().any(|robot| robot == name) => Ok(name.to_owned()),
        (None, [only]) => Ok(only.clone()),
        (_, []) => {
            let others: Vec<_> = domain.siblings();
            let others = match others.iter().any(|other| *other != domain.name) {
                true => format!("; the domains here are {}", others.join(", ")),
                false => String::new(),
            };
            bail!("no {what} runs in the {which}; start one with `{start}`{others}")
        }
        (Some(name), _) => bail!(
            "no {what} of robot {name:?} runs in the {which}; there is {}",
            running.join(", ")
        ),
        (None, _) => bail!(
            "several run: name a robot with --robot: {}",
            running.join(", ")
        ),
    }
}

/// A text of the answer, without quotes.
fn word<'a>(object: &'a Json, key: &str) -> &'a str {
    object[key].as_str().unwrap_or("unknown")
}

/// The elements of a list of the answer.
fn list<'a>(object: &'a Json, key: &str) -> &'a [Json] {
    object[key].as_array().map_or(&[], Vec::as_slice)
}

fn status(answer: &Json) {
    print_line!("robot {}", word(answer, "robot"));
    print_line!(
        "  gateway is process {}, up {:.1} s, with {}",
        answer["process"],
        answer["up_s"].as_f64().unwrap_or(f64::NAN),
        word(answer, "config")
    );
    for bus in list(answer, "buses") {
        print_line!(
            "  bus {:<24} {:<10} {}, {} frames, {} dropped, {} error frames, {} not sent",
            word(bus, "name"),
            word(bus, "link"),
            load(
                bus["load"].as_f64().unwrap_or(f64::NAN),
                bus["frame_rate_hz"].as_f64().unwrap_or(f64::NAN)
            ),
            bus["frames"],
            bus["dropped"],
            bus["error_frames"],
            bus["send_failures"]
        );
    }
    print_line!(
        "  {} of {} devices stream",
        answer["streaming"],
        answer["devices"]
    );
}

fn devices(answer: &Json) {
    for device in list(answer, "devices") {
        let channels: Vec<_> = list(device, "channels")
            .iter()
            .filter_map(Json::as_str)
            .collect();
        let listens = match device["listen_only"] == true {
            true => ", listens only",
            false => "",
        };
        let refusal = device["refusal"].as_str().map(|why| format!(": {why}"));
        let frozen = match word(device, "frozen") {
            "" => String::new(),
            axes => format!("; {axes} frozen"),
        };
        print_line!(
            "{:<24} {:<10} {}, address {} on {}{listens}; channels: {}{frozen}{}",
            word(device, "name"),
            word(device, "state"),
            word(device, "driver"),
            device["address"],
            word(device, "bus"),
            channels.join(", "),
            refusal.unwrap_or_default()
        );
    }
}

fn tared(answer: &Json) {
    let three = |key: &str| numbers(list(&answer["added"], key), |axis| format!("{axis:.3}"));
    let device = word(answer, "device");
    match answer["added"].is_null() {
        true => print_line!("{device} is tared, until it is tared again or switched off"),
        false => print_line!(
            "{device} is tared: its board adds {} N, {} Nm until it is tared again or switched off",
            three("force_n"),
            three("torque_nm")
        ),
    }
    print_line!("offsets that were identified before no longer hold");
}

/// Numbers in one line.
fn numbers(list: &[Json], form: impl Fn(f64) -> String) -> String {
    let all = list.iter().map(|x| form(x.as_f64().unwrap_or(f64::NAN)));
    all.collect::<Vec<_>>().join(" ")
}

fn calibration(answer: &Json) {
    print_line!("{}", word(answer, "device"));
    let plain = |key: &str| numbers(list(answer, key), |x| x.to_string());
    if !answer["full_scale_n"].is_null() {
        let (force, torque) = (plain("full_scale_n"), plain("full_scale_nm"));
        print_line!("  full scale: {force} N, {torque} Nm");
    }
    if !answer["counts_per_unit"].is_null() {
        print_line!(
            "  counts per unit of force and torque: {}; units: {} N, {} Nm",
            plain("counts_per_unit"),
            answer["unit_n"],
            answer["unit_nm"]
        );
    }
    let rows = list(answer, "matrix");
    if !rows.is_empty() {
        print_line!("  matrix, by gauge:");
    }
    for (axis, row) in ["fx", "fy", "fz", "tx", "ty", "tz"].into_iter().zip(rows) {
        let row = row.as_array().map_or(&[][..], Vec::as_slice);
        print_line!("    {axis} {}", numbers(row, |x| format!("{x:>13.6}")));
    }
}

fn reloaded(answer: &Json) {
    let changed = list(answer, "changed");
    if changed.is_empty() {
        print_line!("nothing has changed");
    }
    for device in changed {
        let what: Vec<_> = list(device, "what")
            .iter()
            .filter_map(Json::as_str)
            .collect();
        let restarted = match device["restarted"] == true {
            true => "; it was restarted",
            false => "",
        };
        print_line!("{}: {}{restarted}", word(device, "device"), what.join(", "));
    }
}
