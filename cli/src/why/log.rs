//! What a log says of a torque: the estimator runs on it, up to the instant in question.

use super::story::{ChannelState, System, TorqueCase, opinion};
use crate::convert::{Configured, input, unfit};
use crate::names::find;
use crate::samples;
use anyhow::{Context, anyhow, bail};
use proprio_estimator::offline::{EstimationError, run_on_log};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_gateway::plan::Plan;
use proprio_topics::{NO_CAUSE, Nanos, Reason};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

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
pub(super) struct LogCase {
    pub(super) known: TorqueCase,
    /// The instant in question; none in a log without stamps.
    pub(super) t: Option<Nanos>,
    /// All times of the log, up to that instant if it was given.
    pub(super) spells: Vec<Spell>,
}

/// A log, and the estimator's configuration for it.
struct Log<'a> {
    file: &'a Path,
    config: PathBuf,
    joint: usize,
}

/// The estimator when it has followed a log.
struct Followed {
    pipeline: Pipeline,
    /// The instant of the last estimate.
    t: Nanos,
    is_stamped: bool,
    spells: Vec<Spell>,
}

impl Log<'_> {
    /// Runs the estimator on the log, up to an instant if there is one.
    fn follow(&self, setup: Setup, until: Option<Nanos>) -> anyhow::Result<Followed> {
        let (mut spells, mut t, mut is_stamped) = (Vec::new(), Nanos::MIN, true);
        let table = samples::table(input(self.file)?, self.file)?;
        let followed = run_on_log(setup, table, |pipeline, has_stamps| {
            (t, is_stamped) = (pipeline.last_estimate().t, has_stamps);
            tell(pipeline, self.joint, is_stamped, &mut spells);
            Ok(match until.is_some_and(|until| t >= until) {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            })
        });
        match followed {
            Ok((_, pipeline)) => Ok(Followed {
                pipeline,
                t,
                is_stamped,
                spells,
            }),
            Err(error @ EstimationError::MissingChannels(_)) => {
                Err(unfit(&self.config, self.file, &error).into())
            }
            Err(error) => Err(error).with_context(|| self.file.display().to_string()),
        }
    }

    /// Checks that the log is of the instant in question; it ends at `end`.
    fn check(&self, at: Option<Nanos>, end: Nanos, followed: &Followed) -> anyhow::Result<()> {
        let (Some(at), Some(first)) = (at, followed.spells.first()) else {
            return Ok(());
        };
        let log = self.file.display();
        if !followed.is_stamped {
            bail!("{log}: it has no stamps, so --at says nothing");
        }
        let begin = first.begin;
        if at > end || begin - at > followed.pipeline.setup().robot.max_silence {
            bail!("--at {at}: {log} is from {begin} s to {end} s");
        }
        Ok(())
    }
}

impl Followed {
    /// Adds the time after the last estimate; returns the end of the log, if it has samples.
    fn add_end(&mut self) -> Option<Nanos> {
        let channels = 0..self.pipeline.setup().channels().count();
        let newest = channels.filter_map(|channel| self.pipeline.newest(channel));
        let end = newest.max()?;
        let robot = &self.pipeline.setup().robot;
        let begin = self.t.max(Nanos::ZERO);
        if self.is_stamped && (self.t == Nanos::MIN || end - begin > robot.max_silence) {
            let trigger = name_of(&self.pipeline, robot.trigger);
            (self.spells).push(Spell::without_estimates(trigger, begin, end));
        }
        Some(end)
    }
}

/// What is known of a joint's torque at an instant of a log; without one, late in the time that
/// [`in_question`] chooses.
pub(super) fn know(
    configured: Configured,
    file: &Path,
    joint: &str,
    at: Option<Nanos>,
) -> anyhow::Result<LogCase> {
    let Configured {
        config,
        setup,
        folder,
    } = configured;
    let number = find(joint, || setup.robot.joint_names().zip(0..));
    let number = number
        .map_err(|hint| anyhow!("{}: there is no joint {joint:?}{hint}", config.display()))?;
    let log = Log {
        file,
        config,
        joint: number,
    };
    let mut followed = log.follow(setup.clone(), at)?;
    let Some(end) = followed.add_end() else {
        bail!("{}: there are no samples", file.display());
    };
    log.check(at, end, &followed)?;
    let chosen = match at {
        None => in_question(&followed.spells),
        // Without an estimate there, the time without estimates is in question.
        Some(at) => (followed.spells.iter())
            .find(|spell| spell.is_gap && spell.end >= at && spell.begin < at),
    };
    let chosen = chosen.cloned();
    let identifies = setup.identifies;
    if let Some(spell) = chosen.as_ref()
        && at.is_none()
        && spell.looked_at() < followed.t
    {
        let again = log.follow(setup, Some(spell.looked_at()))?;
        (followed.pipeline, followed.t) = (again.pipeline, again.t);
    }
    let Followed {
        mut pipeline,
        t,
        is_stamped,
        spells,
    } = followed;
    let gap = chosen.filter(|spell| spell.is_gap);
    let t = gap.as_ref().map_or(t, Spell::looked_at);
    let gateway = folder.as_ref();
    let gateway = gateway.map(|folder| folder.path().join("gateway.toml"));
    let plan = gateway.filter(|file| file.is_file());
    let plan = plan.map(|file| Plan::load(&file));
    let system = system(&pipeline, plan.and_then(Result::ok).as_ref(), t);
    let budget = match gap {
        Some(_) => None,
        None => pipeline.budget(number).copied(),
    };
    let said = pipeline.drives().zip(budget);
    let said = said.and_then(|(drives, budget)| opinion(drives, budget.joint, budget.unit()));
    let cause = match gap {
        Some(gap) => gap.cause,
        None => cause(
            &pipeline,
            budget.map_or(NO_CAUSE, |budget| budget.torque.cause),
        ),
    };
    let known = TorqueCase {
        joint: joint.to_owned(),
        opinion: said.unwrap_or_default(),
        budget,
        cause,
        system,
        identifies,
    };
    Ok(LogCase {
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
        ChannelState {
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
