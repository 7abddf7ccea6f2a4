//! What a running system says of a torque: its budget, and the state of boards and buses.

use super::story::{ChannelState, HardwareState, System, TorqueCase, opinion};
use crate::names::find;
use crate::status::newest;
use anyhow::anyhow;
use proprio_bridge::{DescriptionReader, Level, bus_state, device_state, next, one_robot, open};
use proprio_topics::ipc::{Domain, DomainConfig, PortError, Presence, Reader, monotonic};
use proprio_topics::{
    Description, DriveEstimate, EstimatorHealth, GatewayHealth, Nanos, Publisher, Reason, Role,
    TRIGGER, TorqueBudget, TorqueEstimate,
};

/// For how long budgets are listened to: the last one that tells of a withheld torque counts.
const LISTEN: Nanos = Nanos::from_millis(500);
/// How long to wait for the first one: a robot with many joints has one of each in a second.
const PATIENCE: Nanos = Nanos::from_millis(3000);
/// A channel without a maximum silence is silent after this time.
const SILENCE: f64 = 1.0;

/// What is known of a joint's torque now.
pub(super) fn know(
    config: &DomainConfig,
    robot: Option<&str>,
    joint: &str,
) -> anyhow::Result<TorqueCase> {
    let domain = open(config)?;
    let robot = one_robot(&domain, robot)?;
    // The estimator computes budgets while somebody reads them: from now on.
    let mut budgets = match Reader::<TorqueBudget>::open(&domain, &robot) {
        Ok(reader) => Some(reader),
        Err(PortError::NotYet { .. }) => None,
        Err(error) => return Err(error.into()),
    };
    // There are none if no drive is known.
    let mut drives = Reader::<DriveEstimate>::open(&domain, &robot).ok();
    let presence = domain.robots().into_iter().find(|own| own.name == robot);
    let presence = presence.ok_or_else(|| anyhow!("robot {robot} has ended meanwhile"))?;
    let names = DescriptionReader::by(&domain, &robot, Publisher::Estimator)?;
    let names = names.map(|described| *described.newest());
    let number = match &names {
        Some(names) => {
            let entries = || names.entries().iter().filter(|own| own.role == Role::Joint);
            let joints = || entries().map(|own| (own.name.as_str(), own.index));
            let number = find(joint, joints);
            Some(number.map_err(|hint| anyhow!("the estimator has no joint {joint:?}{hint}"))?)
        }
        None => None,
    };
    let trouble = [
        ("estimator", presence.estimator),
        ("gateway", presence.gateway),
    ]
    .into_iter()
    .find(|(_, own)| *own != Presence::Running)
    .map(|(daemon, own)| format!("the {daemon} {own}"));
    let budget = match number {
        Some(number) if presence.estimator == Presence::Running => {
            let heard = budgets.as_mut();
            let heard = heard.and_then(|budgets| listen(budgets, drives.as_mut(), number));
            heard.or_else(|| Some((torque(&domain, &robot, number)?, None)))
        }
        _ => None,
    };
    let (budget, opinions) = budget.unzip();
    let opinions = opinions.flatten();
    let mut channels = names.iter().flat_map(Description::entries);
    let cause = channels.find(|entry| {
        let is_cause = match &budget {
            Some(budget) => entry.index == budget.torque.cause,
            // Without estimates it is the channel of their instants.
            None => entry.origin.as_str() == TRIGGER,
        };
        entry.role == Role::Channel && is_cause
    });
    let cause = cause.map(|entry| entry.name.as_str().to_owned());
    let health = newest::<EstimatorHealth>(&domain, &robot)?;
    let opinion = budget
        .as_ref()
        .and_then(|budget| opinion(opinions.as_ref()?, budget.joint, budget.unit()));
    Ok(TorqueCase {
        joint: joint.to_owned(),
        opinion: opinion.unwrap_or_default(),
        budget,
        cause,
        identifies: health.is_some_and(|health| health.identification.groups > 0),
        system: System {
            trouble,
            ..system(&domain, &robot, names.as_ref())?
        },
    })
}

/// The budget of a joint: the last one that tells of a withheld torque, else the last one; and what
/// the drives said then.
fn listen(
    budgets: &mut Reader<TorqueBudget>,
    mut drives: Option<&mut Reader<DriveEstimate>>,
    joint: u32,
) -> Option<(TorqueBudget, Option<DriveEstimate>)> {
    let (mut found, begin) = (None::<(TorqueBudget, _)>, monotonic());
    let mut opinions = None;
    loop {
        while let Some(Ok(Some(newest))) = drives.as_mut().map(|drives| next(drives)) {
            opinions = Some(newest);
        }
        while let Ok(Some(budget)) = next(budgets) {
            let tells = |(found, _): &(TorqueBudget, _)| {
                budget.torque.valid != 1 || found.torque.reason == Reason::None
            };
            if budget.joint == joint && found.as_ref().is_none_or(tells) {
                found = Some((budget, opinions));
            }
        }
        let now = monotonic();
        let deadline = match found {
            Some(_) => begin + LISTEN,
            None => begin + PATIENCE,
        };
        if now >= deadline {
            return found;
        }
        budgets.wait(deadline);
    }
}

/// The torque of a joint without a budget: an estimator of an earlier version publishes none.
fn torque(domain: &Domain, robot: &str, joint: u32) -> Option<TorqueBudget> {
    let mut reader = Reader::<TorqueEstimate>::open(domain, robot).ok()?;
    let deadline = monotonic() + LISTEN;
    let estimate = loop {
        match next(&mut reader).ok()? {
            Some(estimate) => break estimate,
            None if monotonic() >= deadline => return None,
            None => reader.wait(deadline),
        };
    };
    let torque = *estimate.joints().get(joint as usize)?;
    Some(TorqueBudget {
        header: estimate.header,
        deviation: torque.standard_deviation,
        torque,
        joint,
        ..TorqueBudget::new()
    })
}

/// The state of channels, boards and buses; those first that the estimator reads.
fn system(domain: &Domain, robot: &str, read: Option<&Description>) -> anyhow::Result<System> {
    let health = newest::<GatewayHealth>(domain, robot)?;
    let names = DescriptionReader::by(domain, robot, Publisher::Gateway)?;
    let (Some(health), Some(names)) = (health, names) else {
        return Ok(System::default());
    };
    let bus = |number: u32| {
        let bus = health.buses().get(number as usize);
        bus.map_or("", |bus| bus.name.as_str()).to_owned()
    };
    let entries = names.newest().entries().iter();
    let mut channels: Vec<ChannelState> = entries
        .filter(|entry| entry.role == Role::Channel)
        .map(|entry| {
            let newest = health.newest.get(entry.index as usize);
            let newest = newest.filter(|newest| **newest > Nanos::MIN);
            let age = newest.map(|newest| {
                let age = health.header.published.saturating_sub(*newest);
                age.seconds().max(0.0)
            });
            let most = entry.max_silence.seconds();
            ChannelState {
                name: entry.name.as_str().to_owned(),
                device: entry.origin.as_str().to_owned(),
                bus: bus(entry.bus),
                age,
                is_silent: age.is_none_or(|age| age > if most > 0.0 { most } else { SILENCE }),
            }
        })
        .collect();
    let is_read = |channel: &ChannelState| {
        read.is_none_or(|read| read.index(Role::Channel, &channel.name).is_some())
    };
    channels.sort_by_key(|channel| !is_read(channel));
    let part = |name: &str, bus: String, (level, state): (Level, String)| HardwareState {
        name: name.to_owned(),
        bus,
        state,
        level,
    };
    let devices = health.devices().iter();
    let devices = devices.map(|own| part(own.name.as_str(), bus(own.bus), device_state(own)));
    let buses = health.buses().iter();
    let buses = buses.map(|own| part(own.name.as_str(), String::new(), bus_state(own)));
    Ok(System {
        trouble: None,
        channels,
        devices: devices.collect(),
        buses: buses.collect(),
    })
}
