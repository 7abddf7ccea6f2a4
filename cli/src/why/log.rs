//! What a log says of a torque: the estimator runs on it, up to the instant in question.

use super::story::{Channel, Known, System, opinion};
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
    /// The instant to look at: late, but before boards come back one after another.
    fn looked_at(&self) -> Nanos {
        self.end - Nanos((self.end - self.begin).0 / 10)
    }

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

/// What is known of a log.
pub(super) struct Found {
    pub(super) known: Known,
    /// The instant in question; none in a log without stamps.
    pub(super) t: Option<Nanos>,
    /// All times of the log, up to that instant if it was given.
    pub(super) spells: Vec<Spell>,
}

/// What is known of a joint's torque at an instant of a log; without one, late in the time that
/// [`in_question`] chooses.
pub(super) fn know(
    configured: Configured,
    log: &Path,
    joint: &str,
    at: Option<Nanos>,
) -> anyhow::Result<Found> {
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
    let run = |setup: Setup, until: Option<Nanos>| {
        let (mut spells, mut last, mut has_stamps) = (Vec::new(), Nanos::MIN, true);
        let followed = follow(
            setup,
            samples::table(input(log)?, log)?,
            |pipeline, is_stamped| {
                (last, has_stamps) = (pipeline.last_estimate().t, is_stamped);
                tell(pipeline, number, is_stamped, &mut spells);
                Ok(match until.is_some_and(|until| last >= until) {
                    true => ControlFlow::Break(()),
                    false => ControlFlow::Continue(()),
                })
            },
        );
        match followed {
            Ok((_, pipeline)) => Ok((pipeline, last, has_stamps, spells)),
            Err(error @ OfflineError::MissingChannels(_)) => {
                Err(unfit(&config, log, &error).into())
            }
            Err(error) => Err(error).with_context(|| log.display().to_string()),
        }
    };
    let (mut pipeline, mut t, is_stamped, mut spells) = run(setup.clone(), at)?;
    // What came after the last estimate.
    let channels = 0..pipeline.setup().channels().count();
    let newest = channels
        .filter_map(|channel| pipeline.newest(channel))
        .max();
    let trigger = || name_of(&pipeline, pipeline.setup().robot.trigger);
    let Some(end) = newest else {
        bail!("{}: there are no samples", log.display());
    };
    let (begin, most) = (t.max(Nanos::ZERO), pipeline.setup().robot.max_silence);
    if is_stamped && (t == Nanos::MIN || end - begin > most) {
        spells.push(Spell::without_estimates(trigger(), begin, end));
    }
    if let (Some(at), Some(first)) = (at, spells.first()) {
        if !is_stamped {
            bail!("{}: it has no stamps, so --at says nothing", log.display());
        }
        if at > end || first.begin - at > most {
            let (begin, end) = (first.begin, end);
            bail!("--at {at}: {} is from {begin} s to {end} s", log.display());
        }
    }
    let chosen = match at {
        None => in_question(&spells),
        // Without an estimate there, the time without estimates is in question.
        Some(at) => spells
            .iter()
            .find(|spell| spell.is_gap && spell.end >= at && spell.begin < at),
    };
    if let Some(spell) = chosen.filter(|spell| at.is_none() && spell.looked_at() < t) {
        (pipeline, t, ..) = run(setup, Some(spell.looked_at()))?;
    }
    let gap = chosen.filter(|spell| spell.is_gap);
    t = gap.map_or(t, Spell::looked_at);
    let gateway = folder.as_ref();
    let gateway = gateway.map(|folder| folder.path().join("gateway.toml"));
    let plan = gateway.filter(|file| file.is_file());
    let plan = plan.map(|file| Plan::load(&file));
    let system = system(&pipeline, plan.and_then(Result::ok).as_ref(), t);
    let (budget, cause) = match gap {
        Some(gap) => (None, gap.cause.clone()),
        None => {
            let budget = pipeline.budget(number).copied();
            let number = budget.map_or(NO_CAUSE, |budget| budget.torque.cause);
            (budget, cause(&pipeline, number))
        }
    };
    let known = Known {
        joint: joint.to_owned(),
        opinion: match (gap, pipeline.drives(), budget) {
            (None, Some(drives), Some(budget)) => {
                opinion(drives, budget.joint, budget.unit()).unwrap_or_default()
            }
            _ => String::new(),
        },
        budget,
        cause,
        system,
        identifies,
    };
    Ok(Found {
        known,
        t: is_stamped.then_some(t),
        spells: if is_stamped { spells } else { Vec::new() },
    })
}

/// Adds the last estimate to the times.
fn tell(pipeline: &Pipeline, joint: usize, is_stamped: bool, spells: &mut Vec<Spell>) {
    let estimate = pipeline.last_estimate();
    let Some(torque) = estimate.torques.joints().get(joint) else {
        return;
    };
    let reason = torque.reason.get().unwrap_or_default();
    let cause = cause(pipeline, torque.cause);
    let robot = &pipeline.setup().robot;
    // Rows without stamps are far apart, so that none affects the next.
    if let Some(last) = spells.last()
        && is_stamped
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

/// The time to look at. Times without a valid torque that follow each other are one
/// outage. Of the longest outage after the torque was valid (of all, if it never was) it is the
/// longest time but those of a restart: a channel that is back has too few samples at first.
fn in_question(spells: &[Spell]) -> Option<&Spell> {
    let is_valid = |spell: &Spell| spell.reason == Reason::None;
    let first = spells.iter().position(is_valid).unwrap_or(0);
    let duration = |spell: &Spell| spell.end - spell.begin;
    let outages = spells.get(first..)?.split(is_valid);
    let whole = |outage: &&[Spell]| {
        let ends = outage.first().zip(outage.last());
        ends.map(|(first, last)| last.end - first.begin)
    };
    let outage = outages
        .filter(|outage| !outage.is_empty())
        .max_by_key(whole)?;
    let is_cause = |spell: &&Spell| spell.reason != Reason::Starting;
    let cause = outage
        .iter()
        .filter(is_cause)
        .max_by_key(|own| duration(own));
    cause.or_else(|| outage.first())
}

/// How the channels are at `t`; `plan` knows their boards.
fn system(pipeline: &Pipeline, plan: Option<&Plan>, t: Nanos) -> System {
    let most = pipeline.setup().robot.max_silence;
    let channels = pipeline.setup().channels().enumerate();
    let channels = channels.map(|(number, (kind, name))| {
        let age = pipeline
            .newest_at(number, t)
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

#[cfg(test)]
mod tests {
    use super::*;

    fn spell(reason: Reason, begin: i64, end: i64) -> Spell {
        Spell {
            reason,
            cause: None,
            begin: Nanos::from_millis(begin),
            end: Nanos::from_millis(end),
            is_gap: false,
        }
    }

    #[test]
    fn the_cause_of_the_longest_outage_is_in_question() {
        let spells = [
            spell(Reason::Uncertain, 0, 9000),
            spell(Reason::None, 9000, 10_000),
            spell(Reason::Saturated, 10_000, 10_300),
            spell(Reason::None, 10_300, 11_000),
            spell(Reason::Stale, 11_000, 11_200),
            spell(Reason::Starting, 11_200, 11_600),
            spell(Reason::None, 11_600, 12_000),
        ];
        let chosen = in_question(&spells).map(|own| own.reason);
        assert_eq!(
            chosen,
            Some(Reason::Stale),
            "not what came of it, nor the start"
        );
        let chosen = in_question(&spells[..1]).map(|own| own.reason);
        assert_eq!(chosen, Some(Reason::Uncertain), "it never was valid");
        assert_eq!(in_question(&spells[1..2]), None);
    }
}
