//! What acted on the robot in the logs though nobody declared it, as far as fits have told: asked anew after each ([`super::gate`] finds it), marked in the logs so that the next fit leaves it
//! out, and told at the end.

use super::assess;
use super::batch::{Identified, Prepared, Settled, used, used_mut};
use super::gate::{self, Load, UnitSet};
use super::instants::Break;
use super::outcome::{Finding, LeftOut, Role, Severity};
use super::passes::NoiseModel;
use super::rows::RowMaker;
use crate::setup::Setup;
use nalgebra::DVector;
use proprio_topics::Nanos;
use std::ops::Range;

/// A jump's moment is known to half the gap between the lines that show it, and what stands out there has a margin: what seems to act on a part of the robot for no longer than this, at a jump of a
/// sensor there, is the jump \[s\].
const MOMENT: f64 = 1.2;

/// ... and what begins or ends so near to it \[s\].
const SETTLING: f64 = 0.3;

/// A touch that comes so near to a change of load is of the hand that gives or takes it \[s\] ...
const HANDING: f64 = 1.0;
/// ... if it lasts no longer than this; and a change so soon before or after another one is the same one \[s\]. Or than the moment of the change is known, if that is longer.
const HANDED: f64 = 3.0;

/// Rounds in which what acts undeclared, and which breaks are real, are asked of a fit that stays as it is.
const ROUNDS: usize = 4;

/// What acts undeclared in some logs, and which of their breaks are real.
pub(super) struct Undeclared {
    pub loads: Vec<Load>,
    /// Per log and instant.
    contacts: Vec<Vec<UnitSet>>,
    /// All breaks that readings show, per log.
    jumps: Vec<Vec<Break>>,
}

impl Undeclared {
    /// Nothing, yet, in these logs.
    pub(super) fn none<'a>(logs: impl Iterator<Item = &'a mut Prepared>) -> Self {
        let (mut contacts, mut jumps) = (Vec::new(), Vec::new());
        for log in logs {
            contacts.push(vec![UnitSet::default(); log.instants.len()]);
            jumps.push(log.breaks.clone());
        }
        Self {
            loads: Vec::new(),
            contacts,
            jumps,
        }
    }

    /// Adds a load. Of what only makes another one come a little sooner or go a little later, that other one is told: the moment of its change is found but to a piece of the log.
    pub(super) fn carry(&mut self, load: Load) {
        let edge = |load: &Load| if load.is_after { load.span.0 } else { load.span.1 };
        let is_same = |other: &&mut Load| {
            let apart = (edge(other) - edge(&load)).seconds().abs();
            (other.log, other.place, other.is_after) == (load.log, load.place, load.is_after)
                && apart <= HANDED.max(1.5 * load.within)
        };
        match self.loads.iter_mut().find(is_same) {
            Some(other) => {
                other.span = (other.span.0.min(load.span.0), other.span.1.max(load.span.1));
                other.clear = (other.clear.0.max(load.clear.0), other.clear.1.min(load.clear.1));
            }
            None => self.loads.push(load),
        }
    }

    /// Asks a fit what acts besides the loads, and marks the logs; whether that is what was known before.
    pub(super) fn ask<'a>(
        &mut self,
        maker: &RowMaker<'_>,
        logs: impl Iterator<Item = &'a mut Prepared>,
        noise: &NoiseModel,
        d: &DVector<f64>,
    ) -> bool {
        let logs: Vec<&mut Prepared> = logs.collect();
        let seen: Vec<&Prepared> = logs.iter().map(|log| &**log).collect();
        let contacts = gate::contacts(maker, &seen, &self.loads, noise, d);
        // Of all that there were: what was no jump beside the noise of a touch may be one when that is left out.
        let breaks = gate::breaks(maker, &seen, &self.jumps, noise, d);
        let stays = contacts == self.contacts && seen.iter().zip(&breaks).all(|(log, breaks)| log.breaks == *breaks);
        if !stays {
            self.contacts = contacts;
            let marked = logs.into_iter().zip(breaks).map(|(log, breaks)| {
                log.breaks = breaks;
                log
            });
            self.mark(marked);
        }
        stays
    }

    /// Marks the instants of the logs.
    pub(super) fn mark<'a>(&self, logs: impl Iterator<Item = &'a mut Prepared>) {
        for (number, (log, contacts)) in logs.zip(&self.contacts).enumerate() {
            for (instant, contact) in log.instants.iter_mut().zip(contacts) {
                let carries = |load: &&Load| load.log == number && load.has(instant.t);
                let loads = self.loads.iter().filter(carries);
                instant.suspected = loads.fold(*contact, |set, load| set.union(&load.units));
            }
        }
    }

    /// Says what was left out because of something undeclared.
    pub(super) fn tell(&self, maker: &RowMaker<'_>, prepared: &mut [Prepared], settled: &Settled) {
        let Self { loads, contacts, .. } = self;
        let setup = maker.setup();
        let training = used(prepared);
        let body = |load: &Load| {
            let Settled {
                prior,
                noise,
                information,
                fit,
                ..
            } = settled;
            gate::added(maker, prior, &training, load, noise, information, fit.tau)
        };
        let bodies: Vec<Option<gate::Added>> = loads.iter().map(body).collect();
        let training = used_mut(prepared);
        for (number, (log, contacts)) in training.zip(contacts).enumerate() {
            let own: Vec<(&Load, &Option<gate::Added>)> = loads
                .iter()
                .zip(&bodies)
                .filter(|(load, _)| load.log == number)
                .collect();
            let loads: Vec<&Load> = own.iter().map(|(load, _)| *load).collect();
            let touches = touches(setup, log, contacts, &loads);
            for unit in units(contacts).iter() {
                let of = |cause| Tally::of(log, touches.iter().filter(|touch| touch.is(unit, cause)));
                let (jumps, contacts) = (of(Cause::Jump), of(Cause::Contact));
                if let Some(jumps) = jumps {
                    let reason = format!("moment of a jump: {}", part(setup, unit));
                    log.left_out.push(jumps.left_out(reason));
                }
                let Some(contacts) = contacts else {
                    continue;
                };
                let reason = format!("contact suspected: {}", part(setup, unit));
                log.left_out.push(contacts.left_out(reason));
                log.findings.push(Finding {
                    severity: Severity::Warning,
                    code: "contact_suspected",
                    subject: part(setup, unit),
                    text: format!(
                        "something that nobody declared acted on {}, {} {} left out there",
                        part(setup, unit),
                        contacts.describe(log),
                        if contacts.times == 1 { "was" } else { "were" }
                    ),
                });
            }
            for (place, (load, body)) in own.into_iter().enumerate() {
                let hands = touches.iter().filter(|touch| touch.cause == Cause::Load(place));
                tell_load(maker, log, load, body.as_ref(), hands);
            }
        }
    }
}

/// Says that a load was another one in a part of a log, which was left out, and what body that is, if it is known; `hands`: what else was left out because of those that gave or took it.
fn tell_load<'a>(
    maker: &RowMaker<'_>,
    log: &mut Prepared,
    load: &Load,
    body: Option<&gate::Added>,
    hands: impl Iterator<Item = &'a Touch>,
) {
    let (setup, layout) = (maker.setup(), maker.layout());
    let link = setup.model.link_name(layout.links[load.place]);
    let since = |t: Nanos| (t - log.span.0).seconds();
    let mut out: Vec<bool> = log.instants.iter().map(|instant| load.has(instant.t)).collect();
    for touch in hands {
        out[touch.instants.clone()].fill(true);
    }
    let out: Vec<Nanos> = (log.instants.iter().zip(out))
        .filter(|(_, out)| *out)
        .map(|(instant, _)| instant.t)
        .collect();
    let (Some(&first), Some(&last)) = (out.first(), out.last()) else {
        return;
    };
    log.left_out.push(LeftOut {
        reason: format!("another load: {link}"),
        instants: out.len() as u64,
        first,
        last,
    });
    let (when, at) = if load.is_after {
        ("From", first)
    } else {
        ("Up to", last)
    };
    let what = body.map_or(String::new(), |body| {
        let p = &body.parameters;
        let sigma = |i: usize| body.covariance[(i, i)].sqrt();
        format!(
            ": {:+.3} +- {:.3} kg, first moment {:+.4}, {:+.4}, {:+.4} +- {:.4} kg m in the axes and about the origin of {link}",
            p[0],
            sigma(0),
            p[1],
            p[2],
            p[3],
            (1..4).map(sigma).fold(0.0, f64::max)
        )
    });
    log.findings.push(Finding {
        severity: Severity::Warning,
        code: "load_changed",
        subject: link.to_owned(),
        text: format!(
            "{when} about {:.1} s after the log's start, {link} carried another load than in the rest of what was used{what}. That part was left out: parameters are those without it",
            since(at)
        ),
    });
}

/// After so many fits, what is left out changes still.
pub(super) fn restless(fits: usize) -> Finding {
    Finding {
        severity: Severity::Warning,
        code: "contact_unsettled",
        subject: String::new(),
        text: format!(
            "after {fits} fits, what is left out because something undeclared acted there, and which jumps of offsets are real, had not come to stay: look at what the logs leave out, and declare contacts where they were"
        ),
    }
}

/// The links of a unit, in words.
fn part(setup: &Setup, unit: usize) -> String {
    match setup.structure.subtrees().get(unit) {
        Some(subtree) => {
            let sensors: Vec<String> = subtree.sensors.iter().map(|s| assess::sensor_name(setup, s)).collect();
            format!("the links at {}", sensors.join(", "))
        }
        None => "the links whose joint torques are measured".to_owned(),
    }
}

/// What seems to act on a part of the robot at some instants on end, and what that is.
struct Touch {
    unit: usize,
    instants: Range<usize>,
    cause: Cause,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Cause {
    Contact,
    /// A sensor's offset becomes another one.
    Jump,
    /// The hand that gives or takes the load of this number.
    Load(usize),
}

impl Touch {
    fn is(&self, unit: usize, cause: Cause) -> bool {
        (self.unit, self.cause) == (unit, cause)
    }
}

/// All units that there are in these.
fn units(contacts: &[UnitSet]) -> UnitSet {
    contacts.iter().fold(UnitSet::default(), |units, set| units.union(set))
}

/// What seems to act on the robot in a log, and of that what the hands do that give and take these loads.
fn touches(setup: &Setup, log: &Prepared, contacts: &[UnitSet], loads: &[&Load]) -> Vec<Touch> {
    let mut touches = Vec::new();
    for unit in units(contacts).iter() {
        let sensors = setup.structure.subtrees().get(unit).map(|subtree| &subtree.sensors);
        let is_own = |b: &Break| sensors.is_some_and(|sensors| sensors.contains(b.sensor));
        let mut begin = 0;
        for instants in contacts.chunk_by(|a, b| a.contains(unit) == b.contains(unit)) {
            let range = begin..begin + instants.len();
            begin = range.end;
            if !instants[0].contains(unit) {
                continue;
            }
            let (first, last) = (log.instants[range.start].t, log.instants[range.end - 1].t);
            let lasts = (last - first).seconds();
            let is_near = |(from, to): (Nanos, Nanos), seconds: f64| {
                (from - last).seconds() <= seconds && (first - to).seconds() <= seconds
            };
            let is_handed = |load: &&Load| load.units.contains(unit) && is_near(load.span, HANDING);
            let is_jump = |b: &Break| is_own(b) && is_near((b.t, b.t), SETTLING);
            let load = loads.iter().position(is_handed);
            let load = load.filter(|&load| lasts <= HANDED.max(loads[load].within));
            let cause = match load {
                Some(number) => Cause::Load(number),
                None if lasts <= MOMENT && log.breaks.iter().any(is_jump) => Cause::Jump,
                None => Cause::Contact,
            };
            touches.push(Touch {
                unit,
                instants: range,
                cause,
            });
        }
    }
    touches
}

/// How often, how long and when something acted on a part of the robot.
struct Tally {
    times: usize,
    instants: usize,
    first: Nanos,
    last: Nanos,
}

impl Tally {
    /// Of these, in the order of time; none if there are none.
    fn of<'a>(log: &Prepared, touches: impl Iterator<Item = &'a Touch>) -> Option<Self> {
        let touches: Vec<&Touch> = touches.collect();
        Some(Self {
            times: touches.len(),
            instants: touches.iter().map(|touch| touch.instants.len()).sum(),
            first: log.instants[touches.first()?.instants.start].t,
            last: log.instants[touches.last()?.instants.end - 1].t,
        })
    }

    fn left_out(&self, reason: String) -> LeftOut {
        LeftOut {
            reason,
            instants: self.instants as u64,
            first: self.first,
            last: self.last,
        }
    }

    /// `2 times between 3.1 and 7.4 s after the log's start: 5.0 % of the log`.
    fn describe(&self, log: &Prepared) -> String {
        let since = |t: Nanos| (t - log.span.0).seconds();
        format!(
            "{} time{} between {:.1} and {:.1} s after the log's start: {:.1} % of the log",
            self.times,
            if self.times == 1 { "" } else { "s" },
            since(self.first),
            since(self.last),
            100.0 * self.instants as f64 / log.instants.len() as f64
        )
    }
}

/// Says, and keeps in [`Prepared::touched`], what acted on the robot in the logs to validate with though nobody declared it, and which of their breaks are real. Their figures stay those of all
/// rows: what is held out must not be picked by what it is to check.
pub(super) fn tell_of_checks(maker: &RowMaker<'_>, prepared: &mut [Prepared], identified: &Identified) {
    let is_checked = |log: &&mut Prepared| log.role == Role::Validate && !log.refused;
    let setup = maker.setup();
    let mut undeclared = Undeclared::none(prepared.iter_mut().filter(is_checked));
    let settles = (0..ROUNDS).any(|_| {
        let checked = prepared.iter_mut().filter(is_checked);
        undeclared.ask(maker, checked, &identified.noise, &identified.d)
    });
    let checked = prepared.iter_mut().filter(is_checked);
    for (log, contacts) in checked.zip(undeclared.contacts) {
        let touches = touches(setup, log, &contacts, &[]);
        for unit in units(&contacts).iter() {
            let own = touches.iter().filter(|touch| touch.is(unit, Cause::Contact));
            let Some(sum) = Tally::of(log, own) else {
                continue;
            };
            let part = part(setup, unit);
            log.findings.push(Finding {
                severity: Severity::Note,
                code: "contact_suspected",
                text: format!(
                    "as if something that nobody declared acted on {part}, what was identified does not hold there {}. This log's figures are of all of it, these times too",
                    sum.describe(log)
                ),
                subject: part,
            });
        }
        if !settles {
            log.findings.push(Finding {
                severity: Severity::Note,
                code: "contact_unsettled",
                subject: String::new(),
                text: format!("after {ROUNDS} rounds, when something undeclared acted in this log, and which jumps of offsets are real, had not come to stay: take what is said of both with care"),
            });
        }
        log.instants
            .iter_mut()
            .for_each(|instant| instant.suspected = UnitSet::default());
        log.touched = contacts;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A load that comes at `from` \[s\], known to `within`, of a log of 100 s.
    fn load(log: usize, place: usize, from: i64, within: f64) -> Load {
        let at = |seconds: i64| Nanos::from_millis(1000 * seconds);
        Load {
            log,
            place,
            span: (at(from), at(100)),
            clear: (at(from + 1), at(100)),
            within,
            is_after: true,
            units: UnitSet::default(),
        }
    }

    #[test]
    fn a_change_that_is_found_twice_is_one() {
        let of = |loads: &[Load]| {
            let mut undeclared = Undeclared::none(std::iter::empty());
            loads.iter().cloned().for_each(|load| undeclared.carry(load));
            undeclared.loads
        };
        let first = load(0, 3, 23, 1.0);
        for sooner in [22, 24] {
            let [one] = of(&[first.clone(), load(0, 3, sooner, 1.0)]).try_into().unwrap();
            // All that it may be in is left out; what surely has it tells of it.
            assert_eq!(one.span, load(0, 3, sooner.min(23), 1.0).span);
            assert_eq!(one.clear, load(0, 3, sooner.max(23), 1.0).clear);
        }
        // Of a long log a change is known to a piece of it.
        assert_eq!(of(&[load(0, 3, 40, 9.4), load(0, 3, 31, 9.4)]).len(), 1);
        for other in [load(1, 3, 22, 1.0), load(0, 4, 22, 1.0), load(0, 3, 18, 1.0)] {
            assert_eq!(of(&[first.clone(), other.clone()]), [first.clone(), other]);
        }
    }
}
