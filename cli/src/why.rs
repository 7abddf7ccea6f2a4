//! `proprio why`: why a torque is what it is: what it rests on, what its deviation is made of, and,
//! if it is withheld, why and what to do.
//!
//! A running estimator publishes the budgets of its torques while somebody reads them
//! (`<robot>/estimate/budget`); for a log or a recording, the estimator runs on it up to the
//! instant in question.

mod live;
mod log;
mod story;

use crate::convert::Configured;
use anyhow::bail;
use log::Spell;
use proprio_topics::ipc::DomainConfig;
use proprio_topics::{Nanos, Reason, Source, TorqueBudget};
use serde_json::json;
use std::path::PathBuf;
use story::{Story, TorqueCase, digits, names, percent, shares};

/// `proprio why`.
#[derive(clap::Args)]
pub(crate) struct WhyArgs {
    /// The joint
    joint: String,
    /// The robot; default: the only one in the domain
    #[arg(long, value_name = "NAME", conflicts_with = "samples")]
    robot: Option<String>,
    /// Ask a table of samples or a recording (a black box) instead of a running system
    #[arg(long, alias = "log", value_name = "FILE")]
    samples: Option<PathBuf>,
    /// With --samples: estimator.toml; default: the one that a recording has taken along
    #[arg(long, value_name = "FILE", requires = "samples")]
    config: Option<PathBuf>,
    /// With --samples: identified parameters (parameters.toml) to use
    #[arg(long, value_name = "FILE", requires = "samples")]
    parameters: Option<PathBuf>,
    /// With --samples: the instant to look at, as in the log [s]; default: late in what caused the
    /// longest outage after the torque had been valid
    #[arg(
        long,
        value_name = "SECONDS",
        requires = "samples",
        value_parser = seconds,
        allow_negative_numbers = true
    )]
    at: Option<f64>,
    /// Print everything as JSON, one object
    #[arg(long)]
    json: bool,
}

/// The most lines of a budget, and of the times of a log.
const MOST: usize = 10;

/// The least share that has a line of its own [%].
const LEAST: f64 = 0.1;

/// An instant of a log [s].
fn seconds(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|t: &f64| t.is_finite());
    number.ok_or_else(|| "write seconds, as in the log".to_owned())
}

/// Says why.
pub(crate) fn run(args: &WhyArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let (known, at, spells) = match &args.samples {
        None => (
            live::know(domain, args.robot.as_deref(), &args.joint)?,
            None,
            Vec::new(),
        ),
        Some(samples) => {
            let (config, parameters) = (args.config.as_deref(), args.parameters.as_deref());
            let configured = Configured::new(config, parameters, samples)?;
            if samples.as_os_str() == "-" {
                bail!("--samples -: give a file, which is read twice");
            }
            let at = args.at.map(Nanos::from_seconds);
            let found = log::know(configured, samples, &args.joint, at)?;
            (found.known, found.t, found.spells)
        }
    };
    let story = known.story();
    if args.json {
        print_line!("{}", in_json(&known, &story, at, &spells));
        return Ok(());
    }
    let when = at.map_or(String::new(), |t| format!("at {t} s, "));
    print_line!("{when}{}", story.head);
    for cause in &story.because {
        print_line!("  because: {cause}");
    }
    if !story.advice.is_empty() {
        print_line!("  what to do: {}", story.advice);
    }
    if !known.opinion.is_empty() {
        print_line!("  second opinion: {}", known.opinion);
    }
    if let Some(budget) = &known.budget {
        print_budget(budget);
    }
    if args.samples.is_some() && known.identifies {
        print_line!(
            "\nthe estimator ran on this log anew: without what the robot had learnt before it"
        );
    }
    print_spells(&spells);
    Ok(())
}

fn print_budget(budget: &TorqueBudget) {
    let bound = match budget.bound.is_finite() {
        true => format!(", the bound {} {}", digits(budget.bound), budget.unit()),
        false => String::new(),
    };
    if budget.parts().is_empty() {
        return print_line!(
            "\nits estimator, of another version, does not say what the deviation is made of"
        );
    }
    match budget.deviation.is_finite() {
        true => print_line!(
            "\nits deviation is {} {}{bound}; the variance is made of",
            digits(budget.deviation),
            budget.unit()
        ),
        false => print_line!(
            "\nits deviation is not known, because of what identification has not refuted{bound}; \
             the rest of the variance is made of"
        ),
    }
    let shares = shares(budget);
    let matters = |share: &&story::VarianceShare| percent(share, budget) >= LEAST;
    let count = shares.iter().take(MOST).take_while(matters).count();
    let (shown, rest) = shares.split_at(count.max(1).min(shares.len()));
    for share in shown {
        let deviation = digits(share.variance.max(0.0).sqrt());
        print_line!(
            "  {:>5.1} %  {deviation:>8} {:<2}  {}",
            percent(share, budget),
            budget.unit(),
            share.name
        );
    }
    if !rest.is_empty() {
        let sum: f64 = rest.iter().map(|share| percent(share, budget)).sum();
        print_line!("  {sum:>5.1} %               {} further inputs", rest.len());
    }
    print_line!("\nit rests on");
    for (what, source) in [
        ("F/T sensors", Source::Noise),
        ("encoders", Source::Position),
        ("links", Source::Link),
        ("contacts", Source::Present),
        ("no contact at", Source::Absent),
    ] {
        let names = names(budget, source);
        if !names.is_empty() {
            print_line!("  {:<14} {}", format!("{what}:"), names.join(", "));
        }
    }
    if !names(budget, Source::Base).is_empty() {
        print_line!("  the motion of the base");
    }
}

fn print_spells(spells: &[Spell]) {
    if spells.is_empty() {
        return;
    }
    print_line!("\nin this log");
    // Short times between others are left out first.
    let mut longest: Vec<usize> = (0..spells.len()).collect();
    longest.sort_by_key(|&place| {
        let spell = spells.get(place);
        std::cmp::Reverse(spell.map(|spell| spell.end - spell.begin))
    });
    longest.truncate(MOST);
    longest.sort_unstable();
    for spell in longest.iter().filter_map(|&place| spells.get(place)) {
        let cause = spell
            .cause
            .as_ref()
            .map_or(String::new(), |name| format!(" ({name})"));
        let what = match spell.reason {
            Reason::None => "valid",
            _ if spell.is_gap => "no estimates",
            reason => reason.word(),
        };
        print_line!(
            "  {:>10.3} s to {:>10.3} s: {what}{cause}",
            spell.begin.seconds(),
            spell.end.seconds()
        );
    }
    if longest.len() < spells.len() {
        print_line!("  and {} shorter times", spells.len() - longest.len());
    }
}

fn in_json(
    known: &TorqueCase,
    story: &Story,
    at: Option<Nanos>,
    spells: &[Spell],
) -> serde_json::Value {
    let times = spells.iter().map(|spell| {
        json!({
            "from": spell.begin.seconds(), "to": spell.end.seconds(),
            "reason": spell.reason.word(), "cause": spell.cause, "no_estimates": spell.is_gap,
        })
    });
    let finite = |value: f64| value.is_finite().then_some(value);
    let at = at.or_else(|| Some(known.budget.as_ref()?.header.acquired));
    let budget = known.budget.as_ref().map(|budget| {
        let parts = budget.parts().iter().map(|part| {
            json!({
                "source": part.source.get().map(Source::word), "name": part.name.as_str(),
                "variance": finite(part.variance),
                "travel": (part.source == Source::Position).then_some(part.travel),
            })
        });
        json!({
            "valid": budget.torque.valid == 1,
            "torque": finite(budget.torque.torque),
            "unit": budget.unit(),
            "deviation": finite(budget.deviation),
            "bound": finite(budget.bound),
            "reason": budget.torque.reason.get().map(Reason::word),
            "likelier": budget.likelier.as_str(),
            "unexplained": budget.unexplained.as_str(),
            "parts": parts.collect::<Vec<_>>(),
        })
    });
    json!({
        "joint": known.joint, "t": at.map(Nanos::seconds), "why": story.head,
        "because": story.because, "advice": story.advice, "cause": known.cause, "budget": budget,
        "opinion": (!known.opinion.is_empty()).then_some(&known.opinion),
        "times": times.collect::<Vec<_>>(),
    })
}
