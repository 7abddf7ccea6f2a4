//! `proprio echo`: the samples of a channel, the torques or the contacts of a running system, as
//! they come.

use crate::names::find;
use crate::running::interrupted;
use anyhow::{Context, anyhow, bail};
use proprio_bridge::{DescriptionReader, next, one_robot, open};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Topic, Unavailable, monotonic};
use proprio_topics::{
    Code, ContactEstimate, ContactWrench, Description, Entry, Name, Nanos, Publisher, Reason, Role,
    Sample, TorqueEstimate,
};
use serde_json::{Map, Value as Json, json};
use std::io::{self, BufWriter, ErrorKind, StdoutLock, Write};
use std::sync::atomic::Ordering::Relaxed;

/// `proprio echo`.
#[derive(clap::Args)]
pub(crate) struct EchoArgs {
    /// The channel: the name of a joint or sensor
    #[arg(
        required_unless_present_any = ["torques", "contacts"],
        conflicts_with_all = ["torques", "contacts"]
    )]
    channel: Option<String>,
    /// Print the estimated torques of these joints (default: of all) [Nm; N of a prismatic joint]:
    /// value and standard deviation, or why it is withheld
    #[arg(long, value_name = "JOINT", num_args = 0.., conflicts_with = "contacts")]
    torques: Option<Vec<String>>,
    /// Print the estimated wrenches at these contacts (default: at all) [N, Nm]: values and
    /// standard deviations, or why it is withheld
    #[arg(long, value_name = "CONTACT", num_args = 0..)]
    contacts: Option<Vec<String>>,
    /// The robot; default: the only one
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// End after so many samples or estimates
    #[arg(long, value_name = "N")]
    count: Option<u64>,
    /// Print each sample or estimate as a JSON object
    #[arg(long)]
    json: bool,
}

type Out = BufWriter<StdoutLock<'static>>;

/// Without a line for so long, it says that it waits.
const PATIENCE: Nanos = Nanos::from_millis(2000);
/// How often it looks whether the domain is intact.
const LOOK: Nanos = Nanos::from_millis(500);

/// Prints what is asked for.
pub(crate) fn run(args: &EchoArgs, config: &DomainConfig) -> anyhow::Result<()> {
    let domain = open(config)?;
    let robot = one_robot(&domain, args.robot.as_deref())?;
    let printed = match (&args.channel, &args.torques, &args.contacts) {
        (Some(channel), ..) => channels(args, domain, &robot, channel),
        (None, Some(joints), _) => torques(args, domain, &robot, joints),
        (None, None, contacts) => contacts_of(
            args,
            domain,
            &robot,
            contacts.as_deref().unwrap_or_default(),
        ),
    };
    // Whoever read the output has closed it: as if the last line had been printed.
    let closed = |error: &anyhow::Error| {
        let io = error.downcast_ref::<io::Error>();
        io.is_some_and(|error| error.kind() == ErrorKind::BrokenPipe)
    };
    match printed {
        Err(error) if closed(&error) => Ok(()),
        printed => printed,
    }
}

/// An error for the first of `wanted` that is no name of this role.
fn check(
    description: &Description,
    role: Role,
    what: &str,
    wanted: &[String],
) -> anyhow::Result<()> {
    let names = || {
        let entries = description.entries().iter().filter(|e| e.role == role);
        entries.map(|entry| (entry.name.as_str(), ()))
    };
    wanted.iter().try_for_each(|name| {
        find(name, names).map_err(|hint| anyhow!("there is no {what} {name:?}{hint}"))
    })
}

/// Prints each payload of a topic with `print`, which returns whether it printed a line, until
/// interrupted or `args.count` is reached. What has come is printed at once, a line a payload.
/// Gateway and estimator make a damaged domain again: then it goes on in that.
fn follow<T: Topic>(
    args: &EchoArgs,
    mut domain: Domain,
    robot: &str,
    mut described: DescriptionReader,
    mut print: impl FnMut(&mut Out, &Description, &T) -> io::Result<bool>,
) -> anyhow::Result<()> {
    let stop = interrupted()?;
    let mut payloads = Reader::<T>::open(&domain, robot)?;
    let mut out = BufWriter::new(io::stdout().lock());
    let is_enough = |printed| args.count.is_some_and(|count| printed >= count);
    let mut printed = 0_u64;
    let (mut newest, mut is_told) = (monotonic(), false);
    let mut next_look = newest + LOOK;
    while !stop.load(Relaxed) && !is_enough(printed) {
        let before = printed;
        while !is_enough(printed)
            && let Some(payload) = next(&mut payloads)?
        {
            if let Some(description) = described.of(payload.header().epoch) {
                printed += u64::from(print(&mut out, description, &payload)?);
            }
        }
        out.flush()?;
        if printed > before {
            (newest, is_told) = (monotonic(), false);
        } else if !is_told && monotonic() - newest > PATIENCE {
            eprintln!("waiting: nothing is published; `proprio status` says what is missing");
            is_told = true;
        }
        if monotonic() > next_look {
            next_look = monotonic() + LOOK;
            if let Some(Ok(new)) = domain.reopened()
                && let Some(publisher) = described.newest().publisher.get()
                && let Ok(names) = DescriptionReader::to_come(&new, robot, publisher)
                && let Ok(reader) = Reader::open(&new, robot)
            {
                (payloads, described, domain) = (reader, names, new);
            }
        }
        if !is_enough(printed) {
            payloads.wait(monotonic() + Nanos::from_millis(100));
        }
    }
    Ok(())
}

fn channels(args: &EchoArgs, domain: Domain, robot: &str, channel: &str) -> anyhow::Result<()> {
    let described = DescriptionReader::by(&domain, robot, Publisher::Gateway)?
        .context("the robot's gateway is not running")?;
    let wanted = [channel.to_owned()];
    check(described.newest(), Role::Channel, "channel", &wanted)?;
    follow(
        args,
        domain,
        robot,
        described,
        |out, description, sample: &Sample| {
            // A gateway that was started again may number its channels otherwise.
            let number = description.index(Role::Channel, channel);
            let Some(kind) = sample.kind.get().filter(|_| number == Some(sample.channel)) else {
                return Ok(false);
            };
            let (t, quality) = (sample.header.acquired, sample.header.quality);
            let values = kind.fields().iter().zip(sample.values);
            if args.json {
                let values: Map<_, _> = values
                    .map(|(field, value)| ((*field).to_owned(), json!(value)))
                    .collect();
                let line = json!({
                    "t_ns": t.0, "kind": kind.word(), "values": values,
                    "quality": quality.to_string(),
                });
                writeln!(out, "{line}")?;
            } else {
                write!(out, "{t} {}", kind.word())?;
                for (field, value) in values.filter(|(_, value)| !value.is_nan()) {
                    write!(out, " {field} {value:.6}")?;
                }
                writeln!(out, "  {quality}")?;
            }
            Ok(true)
        },
    )
}

/// The estimator's names, of which `wanted` must all be names of `role`.
fn estimator(
    domain: &Domain,
    robot: &str,
    (role, what): (Role, &str),
    wanted: &[String],
) -> anyhow::Result<DescriptionReader> {
    let described = DescriptionReader::by(domain, robot, Publisher::Estimator)?
        .context("the robot's estimator is not running")?;
    check(described.newest(), role, what, wanted)?;
    Ok(described)
}

/// Why an estimate is withheld, and the channel that causes it; `None` if it is not.
pub(crate) fn withheld(
    description: &Description,
    valid: u32,
    reason: Code<Reason>,
    cause: u32,
) -> Option<Unavailable> {
    let entry = description.find(Role::Channel, cause);
    (valid == 0).then(|| Unavailable::Withheld {
        reason: reason.get().unwrap_or_default(),
        channel: entry.map_or(Name::EMPTY, |entry| entry.name),
    })
}

/// The keys that tell in JSON why an estimate is withheld.
pub(crate) fn why(withheld: Option<&Unavailable>) -> [(&'static str, Json); 3] {
    let (reason, cause) = match withheld {
        Some(Unavailable::Withheld { reason, channel }) => (
            json!(reason.word()),
            match channel.as_str() {
                "" => Json::Null,
                name => json!(name),
            },
        ),
        _ => (Json::Null, Json::Null),
    };
    let valid = json!(withheld.is_none());
    [("valid", valid), ("reason", reason), ("cause", cause)]
}

/// An object with `keys` and those of [`why`].
pub(crate) fn object(
    keys: impl IntoIterator<Item = (&'static str, Json)>,
    withheld: Option<&Unavailable>,
) -> Json {
    let keys = keys.into_iter().chain(why(withheld));
    Json::Object(keys.map(|(key, value)| (key.to_owned(), value)).collect())
}

/// The torques of an estimate: name, value, standard deviation, and why it is withheld.
pub(crate) fn of_joints<'a>(
    description: &'a Description,
    estimate: &'a TorqueEstimate,
) -> impl Iterator<Item = (&'a str, f64, f64, Option<Unavailable>)> {
    (0..).zip(estimate.joints()).filter_map(|(index, joint)| {
        let name = description.find(Role::Joint, index)?.name.as_str();
        let withheld = withheld(description, joint.valid, joint.reason, joint.cause);
        Some((name, joint.torque, joint.standard_deviation, withheld))
    })
}

/// The contacts of an estimate: name and frame, wrench, and why it is withheld.
pub(crate) fn of_contacts<'a>(
    description: &'a Description,
    estimate: &'a ContactEstimate,
) -> impl Iterator<Item = (&'a Entry, &'a ContactWrench, Option<Unavailable>)> {
    let numbered = (0..).zip(estimate.contacts());
    numbered.filter_map(|(index, contact)| {
        let entry = description.find(Role::Contact, index)?;
        let withheld = withheld(description, contact.valid, contact.reason, contact.cause);
        Some((entry, contact, withheld))
    })
}

/// A torque in JSON; null if it is withheld.
pub(crate) fn torque_json(torque: f64, deviation: f64, withheld: Option<&Unavailable>) -> Json {
    let given = |value: f64| withheld.is_none().then_some(value);
    let keys = [
        ("torque", json!(given(torque))),
        ("std", json!(given(deviation))),
    ];
    object(keys, withheld)
}

fn torques(args: &EchoArgs, domain: Domain, robot: &str, joints: &[String]) -> anyhow::Result<()> {
    let described = estimator(&domain, robot, (Role::Joint, "joint"), joints)?;
    let is_wanted = |name: &str| joints.is_empty() || joints.iter().any(|joint| joint == name);
    follow(
        args,
        domain,
        robot,
        described,
        |out, description, estimate: &TorqueEstimate| {
            let t = estimate.header.acquired;
            let wanted = of_joints(description, estimate).filter(|(name, ..)| is_wanted(name));
            if args.json {
                let torques: Map<_, _> = wanted
                    .map(|(name, torque, deviation, withheld)| {
                        let value = torque_json(torque, deviation, withheld.as_ref());
                        (name.to_owned(), value)
                    })
                    .collect();
                writeln!(out, "{}", json!({ "t_ns": t.0, "torques": torques }))?;
                return Ok(true);
            }
            write!(out, "{t}")?;
            for (number, (name, torque, deviation, withheld)) in wanted.enumerate() {
                let gap = if number == 0 { " " } else { "; " };
                match withheld {
                    Some(why) => write!(out, "{gap}{name} {why}")?,
                    None => write!(out, "{gap}{name} {torque:.6} +- {deviation:.6}")?,
                }
            }
            writeln!(out)?;
            Ok(true)
        },
    )
}

fn contacts_of(
    args: &EchoArgs,
    domain: Domain,
    robot: &str,
    contacts: &[String],
) -> anyhow::Result<()> {
    let described = estimator(&domain, robot, (Role::Contact, "contact"), contacts)?;
    if !described
        .newest()
        .entries()
        .iter()
        .any(|e| e.role == Role::Contact)
    {
        bail!("the estimator has no contacts: estimator.toml has no [[contact]]");
    }
    let is_wanted = |name: &str| contacts.is_empty() || contacts.iter().any(|one| one == name);
    follow(
        args,
        domain,
        robot,
        described,
        |out, description, estimate: &ContactEstimate| {
            let t = estimate.header.acquired;
            let named = of_contacts(description, estimate)
                .map(|(entry, contact, withheld)| (entry.name.as_str(), contact, withheld));
            let wanted = named.filter(|(name, ..)| is_wanted(name));
            if args.json {
                let of_contacts: Map<_, _> = wanted
                    .map(|(name, contact, withheld)| {
                        let given = withheld.is_none();
                        let keys = [
                            ("force", json!(given.then_some(contact.force))),
                            ("torque", json!(given.then_some(contact.torque))),
                            ("std", json!(given.then_some(contact.standard_deviation))),
                            ("position", json!(given.then_some(contact.position))),
                            ("located", json!(contact.located == 1)),
                            ("detected", json!(contact.detected == 1)),
                        ];
                        (name.to_owned(), object(keys, withheld.as_ref()))
                    })
                    .collect();
                writeln!(out, "{}", json!({ "t_ns": t.0, "contacts": of_contacts }))?;
                return Ok(true);
            }
            write!(out, "{t}")?;
            for (number, (name, contact, withheld)) in wanted.enumerate() {
                let gap = if number == 0 { " " } else { "; " };
                if let Some(why) = withheld {
                    write!(out, "{gap}{name} {why}")?;
                    continue;
                }
                write!(out, "{gap}{name}")?;
                let axes = ["fx", "fy", "fz", "tx", "ty", "tz"];
                let values = contact.force.iter().chain(&contact.torque);
                for ((axis, value), deviation) in
                    axes.iter().zip(values).zip(contact.standard_deviation)
                {
                    write!(out, " {axis} {value:.6} +- {deviation:.6}")?;
                }
                if contact.detected == 1 {
                    write!(out, " (detected)")?;
                }
            }
            writeln!(out)?;
            Ok(true)
        },
    )
}
