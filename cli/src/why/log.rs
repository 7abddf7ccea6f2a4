//! What a log says of a torque: the estimator runs on it, up to the instant in question.

use super::story::{Channel, Known, System};
use crate::convert::{Configured, input, unfit};
use crate::samples;
use anyhow::{Context, bail};
use proprio_estimator::offline::{OfflineError, follow};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::{Setup, nearest};
use proprio_gateway::plan::Plan;
use proprio_topics::{NO_CAUSE, Nanos, Reason};
use std::ops::ControlFlow;
use std::path::Path;

/// A time for which a torque was valid, or was withheld for one reason.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Spell {
    pub(super) reason: Reason,
    pub(super) cause: Option<String>,
    pub(super) begin: Nanos,
    pub(super) end: Nanos,
    /// Whether there were no estimates at all.
    pub(super) is_gap: bool,
}

impl Spell {
    fn without_estimates(trigger: Option<String>, begin: Nanos, end: Nanos) -> Self {
        Self {
            reason: Reason::Stale,
            cause: trigger,
            begin,
            end,
            is_gap: true,
        }
    }
}

/// What is known of a joint's torque at an instant of a log; without one, at the end of the longest
/// time for which it was withheld after it had been valid; and all times of the log.
pub(super) fn know(
    configured: Configured,
    log: &Path,
    joint: &str,
    at: Option<Nanos>,
) -> anyhow::Result<(Known, Nanos, Vec<Spell>)> {
    let Configured {
        config,
        setup,
        folder,
    } = configured;
    let Some(number) = setup.robot.joint_names().position(|own| own == joint) else {
        let hint = nearest(joint, setup.robot.joint_names());
        bail!("{}: there is no joint {joint:?}{hint}", config.display());
    };
    let identifies = setup.identifies;
    let mut spells: Vec<Spell> = Vec::new();
    let run = |setup: Setup, until: Option<Nanos>, spells: Option<&mut Vec<Spell>>| {
        let (mut spells, mut last) = (spells, Nanos::MIN);
        let followed = follow(setup, samples::table(input(log)?, log)?, |pipeline, _| {
            last = pipeline.last_estimate().t;
            if let Some(spells) = &mut spells {
                tell(pipeline, number, spells);
            }
            Ok(match until.is_some_and(|until| last >= until) {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            })
        });
        match followed {
            Ok((_, pipeline)) if last > Nanos::MIN => Ok((pipeline, last)),
            Ok(_) => bail!("{}: there is no estimate", log.display()),
            Err(error @ OfflineError::MissingChannels(_)) => {
                Err(unfit(&config, log, &error).into())
            }
            Err(error) => Err(error).with_context(|| log.display().to_string()),
        }
    };
    let (mut pipeline, mut t) = run(setup.clone(), at, Some(&mut spells))?;
    // What came after the last estimate.
    let channels = 0..pipeline.setup().channels().count();
    let newest = channels
        .filter_map(|channel| pipeline.newest(channel))
        .max();
    let (end, most) = (newest.unwrap_or(t), pipeline.setup().robot.max_silence);
    if at.is_none_or(|at| at > t) && end - t > most {
        let trigger = name_of(&pipeline, pipeline.setup().robot.trigger);
        spells.push(Spell::without_estimates(trigger, t, end));
    }
    let chosen = match at {
        None => in_question(&spells),
        // Without an estimate there, the time without estimates is in question.
        Some(at) => spells
            .iter()
            .find(|spell| spell.is_gap && spell.end >= at && spell.begin < at),
    };
    if let Some(spell) = chosen.filter(|spell| spell.end < t) {
        (pipeline, t) = run(setup, Some(spell.end), None)?;
    }
    let gap = chosen.filter(|spell| spell.is_gap);
    t = gap.map_or(t, |gap| gap.end);
    let gateway = folder
        .as_ref()
        .map(|folder| folder.path().join("gateway.toml"));
    let plan = gateway
        .filter(|file| file.is_file())
        .map(|file| Plan::load(&file));
    let mut system = system(&pipeline, plan.and_then(Result::ok).as_ref(), t);
    let (mut budget, mut cause) = (None, None);
    if let Some(gap) = gap {
        let mut channels = system.channels.iter_mut();
        let trigger = channels.find(|channel| Some(&channel.name) == gap.cause.as_ref());
        if let Some(channel) = trigger {
            channel.age = Some((gap.end - gap.begin).seconds());
            channel.is_silent = true;
        }
        cause.clone_from(&gap.cause);
    } else {
        budget = pipeline.budget(number).copied();
        cause = budget.and_then(|budget| self::cause(&pipeline, budget.torque.cause));
    }
    let known = Known {
        joint: joint.to_owned(),
        budget,
        cause,
        system,
        identifies,
    };
    Ok((known, t, spells))
}

/// Adds the last estimate to the times.
fn tell(pipeline: &Pipeline, joint: usize, spells: &mut Vec<Spell>) {
    let estimate = pipeline.last_estimate();
    let Some(torque) = estimate.torques.joints().get(joint) else {
        return;
    };
    let reason = torque.reason.get().unwrap_or_default();
    let cause = cause(pipeline, torque.cause);
    let robot = &pipeline.setup().robot;
    if let Some(last) = spells.last()
        && estimate.t - last.end > robot.max_silence
    {
        let trigger = name_of(pipeline, robot.trigger);
        spells.push(Spell::without_estimates(trigger, last.end, estimate.t));
    }
    match spells.last_mut() {
        Some(last) if !last.is_gap && last.reason == reason && last.cause == cause => {
            last.end = estimate.t;
        }
        _ => spells.push(Spell {
            reason,
            cause,
            begin: estimate.t,
            end: estimate.t,
            is_gap: false,
        }),
    }
}

fn cause(pipeline: &Pipeline, number: u32) -> Option<String> {
    name_of(pipeline, (number != NO_CAUSE).then_some(number as usize)?)
}

/// The name of a channel.
fn name_of(pipeline: &Pipeline, channel: usize) -> Option<String> {
    let mut channels = pipeline.setup().channels();
    Some(channels.nth(channel)?.1.to_owned())
}

/// The time to look at the end of: the longest one for which it was withheld after it had been
/// valid, or of all if it never was.
fn in_question(spells: &[Spell]) -> Option<&Spell> {
    let is_valid = |spell: &Spell| spell.reason == Reason::None;
    let first = spells.iter().position(is_valid).unwrap_or(0);
    let withheld = spells.iter().skip(first).filter(|spell| !is_valid(spell));
    withheld.max_by_key(|spell| spell.end - spell.begin)
}

/// How the channels are at `t`; `plan` knows their boards.
fn system(pipeline: &Pipeline, plan: Option<&Plan>, t: Nanos) -> System {
    let most = pipeline.setup().robot.max_silence;
    let channels = pipeline.setup().channels().enumerate();
    let channels = channels.map(|(number, (kind, name))| {
        let age = pipeline
            .newest(number)
            .map(|newest| t.saturating_sub(newest));
        let planned = plan.and_then(|plan| {
            let mut channels = plan.channels.iter();
            let own = channels.find(|own| own.name == name && own.kind == kind)?;
            let bus = plan.buses.get(own.bus)?;
            Some((bus.devices.get(own.device)?.name.clone(), bus.name.clone()))
        });
        let (device, bus) = planned.unwrap_or_default();
        Channel {
            name: name.to_owned(),
            device,
            bus,
            age: age.map(|age| age.seconds().max(0.0)),
            is_silent: age.is_none_or(|age| age > most),
        }
    });
    System {
        channels: channels.collect(),
        ..System::default()
    }
}
