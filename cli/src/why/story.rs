//! What is known of a torque, and what follows from it for a person: what it is, why, and what to
//! do. Without input and output.

use proprio_bridge::Level;
use proprio_topics::{
    Agreement, BudgetPart, Candidate, DriveEstimate, Reason, Source, TorqueBudget,
};
use std::collections::BTreeSet;

/// A channel of the system.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ChannelState {
    pub(super) name: String,
    /// Its board, and the bus of that; empty if they are not known.
    pub(super) device: String,
    pub(super) bus: String,
    /// Time since its last sample \[s\]; none if it has sent none.
    pub(super) age: Option<f64>,
    /// Whether this is longer than it should be.
    pub(super) is_silent: bool,
}

/// A board, or a bus.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct HardwareState {
    pub(super) name: String,
    /// The bus of a board.
    pub(super) bus: String,
    /// How it is.
    pub(super) state: String,
    /// How bad that is.
    pub(super) level: Level,
}

/// The system that a torque comes from, as far as it is known.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct System {
    /// What is wrong with gateway or estimator.
    pub(super) trouble: Option<String>,
    pub(super) channels: Vec<ChannelState>,
    pub(super) devices: Vec<HardwareState>,
    pub(super) buses: Vec<HardwareState>,
}

/// What is known of a torque.
#[derive(Debug, Clone)]
pub(super) struct TorqueCase {
    pub(super) joint: String,
    /// None if there is no estimate.
    pub(super) budget: Option<TorqueBudget>,
    /// The channel that causes it to be withheld.
    pub(super) cause: Option<String>,
    /// What the drive says of it, in a sentence; empty if its drive is not known.
    pub(super) opinion: String,
    pub(super) system: System,
    /// Whether the estimator identifies.
    pub(super) identifies: bool,
}

/// What follows.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Story {
    /// The first line.
    pub(super) head: String,
    /// The chain of causes, the nearest first.
    pub(super) because: Vec<String>,
    /// What to do.
    pub(super) advice: String,
}

impl Story {
    fn new(head: impl Into<String>, because: &[&str], advice: impl Into<String>) -> Self {
        Self {
            head: head.into(),
            because: because.iter().map(|text| (*text).to_owned()).collect(),
            advice: advice.into(),
        }
    }
}

/// A part of a budget, as it is shown.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct VarianceShare {
    pub(super) name: String,
    pub(super) variance: f64,
    /// What it is, or the first of several.
    pub(super) source: Source,
}

/// What the drive of a joint says of its torque, in a sentence; `None` if its drive is not known.
pub(super) fn opinion(estimate: &DriveEstimate, joint: u32, unit: &str) -> Option<String> {
    let drive = estimate.of_joint(joint)?;
    let torque = match drive.torque.is_finite() {
        true => format!(
            "{} +- {} {unit}",
            digits(drive.torque),
            digits(drive.standard_deviation)
        ),
        false => "nothing".to_owned(),
    };
    let verdict = match drive.agreement.get().unwrap_or_default() {
        Agreement::Unknown => return Some(format!("its drive says {torque}")),
        Agreement::Agrees => "within both deviations".to_owned(),
        Agreement::Disagrees => {
            let candidates = estimate.candidates().iter();
            let candidates = candidates.filter(|other| other.joint == drive.group);
            let candidates = candidates.map(|candidate| {
                let name = candidate.name.as_str();
                match candidate.kind.get() {
                    Some(Candidate::Contact) => format!("a contact on {name}"),
                    Some(Candidate::Sensor) => format!("{name}, turned or with another gain"),
                    _ => format!("the drive of {name}, in other units or with another friction"),
                }
            });
            let candidates: Vec<String> = candidates.collect();
            let it_may_be = match candidates.is_empty() {
                true => String::new(),
                false => format!("; it may be {}", candidates.join("; or ")),
            };
            format!("{:.0} deviations away{it_may_be}", drive.deviate.abs())
        }
    };
    Some(format!("its drive says {torque}, {verdict}"))
}

/// What to do if a daemon does not run.
const RESTART: &str = "its log tells more (journalctl -u proprio-gateway -u proprio-estimator): \
                       start it, or, if it is stopped or stuck, let it go on (kill -CONT) or \
                       restart it";

/// What to do if a whole bus is silent.
const CHECK_BUS: &str = "check its interface (ip -details link show), cable, power of the boards, \
                         termination and bit rate";

/// A joint that has moved through less of its range since the estimator's start shows little of
/// what it moves.
const UNMOVED: f64 = 0.05;

impl TorqueCase {
    pub(super) fn story(&self) -> Story {
        let Self { joint, budget, .. } = self;
        let Some(budget) = budget else {
            let mut story = self.no_estimate();
            story.head = format!("{joint} has no torque: {}", story.head);
            return story;
        };
        let reason = budget.torque.reason.get().unwrap_or_default();
        if reason == Reason::None {
            let largest = shares(budget).into_iter().next();
            let because = largest.map(|own| {
                format!(
                    "the largest part of its variance, {:.0} %, is {}",
                    percent(&own, budget),
                    own.name
                )
            });
            let head = format!(
                "{joint} is valid: {} +- {} {}",
                digits(budget.torque.torque),
                digits(budget.deviation),
                budget.unit()
            );
            return Story::new(head, because.as_deref().as_slice(), "");
        }
        let mut story = self.withheld(budget, reason);
        story.head = format!("{joint} is withheld: {}", story.head);
        story
    }

    /// Why a torque is withheld.
    #[cfg_attr(
        not(test),
        expect(
            clippy::too_many_lines,
            reason = "a table of what is said of each reason"
        )
    )]
    fn withheld(&self, budget: &TorqueBudget, reason: Reason) -> Story {
        let channel = self.cause.as_deref().unwrap_or("a channel");
        let (likelier, residual) = (budget.likelier.as_str(), budget.unexplained.as_str());
        let story = match reason {
            Reason::NeverSeen | Reason::Stale => return self.silent(channel),
            Reason::Saturated => Story::new(
                format!("{channel} is saturated"),
                &["a reading at the end of its range says only that the load is at least that"],
                "lessen the load; if this load is usual, use a larger range of the sensor",
            ),
            Reason::DeviceFault => Story::new(
                format!("the board of {channel} reports a fault"),
                &[],
                "its manual tells what its fault means and how to clear it; `proprio status` has \
                 its counters",
            ),
            Reason::Frozen => Story::new(
                format!("{channel} is frozen: it repeats its readings instead of measuring"),
                &[],
                "switch its board off and on; if it freezes again, its firmware or its amplifier \
                 is at fault",
            ),
            Reason::Implausible => Story::new(
                format!("{channel} sends readings that contradict the ones before and after"),
                &[],
                "look for loose connectors at the sensor, and for error frames on its bus \
                 (`proprio status`)",
            ),
            Reason::Starting => Story::new(
                format!(
                    "{channel} has too few samples without a gap for velocity and acceleration"
                ),
                &[],
                "wait for some tens of samples; if it lasts, the channel loses samples or is slow",
            ),
            Reason::NoStance => Story::new(
                "no link is known to stand still",
                &["the base moves, and no IMU measures how"],
                "declare the foot that stands (<robot>/contact/declared), or configure an IMU",
            ),
            Reason::NotFinite => Story::new(
                "the result is no finite number",
                &[],
                "look for readings or parameters without sense: `proprio echo`, `proprio \
                 estimator --check`",
            ),
            Reason::Undetermined => Story::new(
                format!(
                    "the contacts that are present have more unknowns than the F/T sensors have \
                     equations: {}",
                    list(&names(budget, Source::Present))
                ),
                &[],
                "give presence = \"possible\" to those that are not always there, so that a \
                 program, a skin or the F/T readings say when they are; or kind = \"force\" to \
                 those that can not exert a torque",
            ),
            Reason::Uncertain => self.uncertain(budget),
            Reason::Unexplained => Story::new(
                format!(
                    "an undeclared contact or load, another F/T offset, or F/T readings that are \
                     late: {residual}"
                ),
                &["neither the model nor a configured contact explains these F/T readings"],
                "let go of the robot; if something may touch it there, configure a [[contact]]; \
                 if nothing does, tare the sensor or identify again",
            ),
            Reason::Contradicted if !likelier.is_empty() => Story::new(
                format!("the readings contradict the configuration: {likelier}"),
                &["this explains them far better than what is configured"],
                "correct the configuration or the wiring, and restart the estimator",
            ),
            Reason::Contradicted => Story::new(
                format!(
                    "the readings have contradicted the configuration since the start: {residual}"
                ),
                &[
                    "a contact since the start, a wrong F/T offset, another mounting, or another \
                   direction of gravity",
                ],
                "move the robot without a contact for some seconds; if it stays, check the F/T \
                 offset, then base and mounting in estimator.toml",
            ),
            Reason::Absent | Reason::None => Story::new(reason.word(), &[], ""),
        };
        self.with_board(story)
    }

    /// The same, with the board and bus of the channel at fault.
    fn with_board(&self, mut story: Story) -> Story {
        let channel = self
            .cause
            .as_deref()
            .and_then(|name| self.system.channel(name));
        if let Some(channel) = channel.filter(|channel| !channel.device.is_empty()) {
            story.because.insert(0, channel.comes_from());
            story.because.extend(self.system.conspicuous(channel));
        }
        story
    }

    fn uncertain(&self, budget: &TorqueBudget) -> Story {
        let unmoved: Vec<&str> = (budget.parts().iter())
            .filter(|part| part.source == Source::Position && part.travel < UNMOVED)
            .map(|part| part.name.as_str())
            .collect();
        if let Some(channel) = &self.cause {
            return Story::new(
                format!("the zero of {channel} is a new one, so that its offset is unknown"),
                &["its board was restarted or tared"],
                self.moving(&unmoved),
            );
        }
        if budget.deviation.is_infinite() {
            let unmoved_too = match unmoved.as_slice() {
                [] => String::new(),
                all => format!(": {} hardly moved", list_has(all)),
            };
            return Story::new(
                format!("it is not known yet whether the setup is as configured{unmoved_too}"),
                &[
                    "identification compares the configured setup with others, such as a reversed \
                     encoder or a turned sensor; that takes some seconds of motion",
                ],
                self.moving(&unmoved),
            );
        }
        let largest = shares(budget).into_iter().next();
        let advice = self.lessening(largest.as_ref().map(|share| share.source), &unmoved);
        let mut part = largest.map_or(String::new(), |own| {
            format!(
                "; {:.0} % of the variance is {}",
                percent(&own, budget),
                own.name
            )
        });
        if !unmoved.is_empty() && self.identifies {
            part += &format!("; {} hardly moved", list_has(&unmoved));
        }
        let still = format!(
            "hardly moved since the estimator's start: {}",
            list(&unmoved)
        );
        let head = format!(
            "its deviation of {} {unit} exceeds the bound of {} {unit} \
             (output.max_torque_std_nm){part}",
            digits(budget.deviation),
            digits(budget.bound),
            unit = budget.unit()
        );
        let because: &[&str] = if unmoved.is_empty() { &[] } else { &[&still] };
        Story::new(head, because, advice)
    }

    /// What to move, so that identification learns; `unmoved` are the joints that hardly did.
    fn moving(&self, unmoved: &[&str]) -> String {
        match unmoved {
            _ if !self.identifies => "identify the robot: `proprio identify` on a log of motion, \
                                      or [identification] enabled = true"
                .to_owned(),
            [] => "move all joints that it rests on for some seconds, without a contact".to_owned(),
            all => format!("move {}, without a contact", list(all)),
        }
    }

    /// What lessens a variance of which most has this source.
    fn lessening(&self, source: Option<Source>, unmoved: &[&str]) -> String {
        let advice = match source {
            Some(Source::Offset | Source::Drift) if self.identifies => return self.moving(unmoved),
            Some(Source::Offset | Source::Drift) => {
                "let the estimator identify the offset ([identification] enabled = true) and move \
                 the robot without a contact; or state it (offset_n, offset_nm), or tare"
            }
            Some(Source::Link | Source::Gain | Source::Alternative | Source::Step) => {
                return self.moving(unmoved);
            }
            Some(Source::Acceleration | Source::Position | Source::Rotation) => {
                "move more slowly; or give the channel more samples, or an encoder with finer steps"
            }
            Some(Source::Base) => "level the base, or calibrate its IMU; or raise the bound",
            Some(Source::Place) => {
                "declare the contact's place better, or give it a skin; or raise the bound"
            }
            _ => "if so large a deviation does no harm, raise the bound",
        };
        advice.to_owned()
    }

    /// Why a channel is silent.
    fn silent(&self, name: &str) -> Story {
        let system = &self.system;
        let channel = system.channel(name);
        let since = match channel.and_then(|channel| channel.age) {
            Some(age) => format!("no sample of {name} for {age:.1} s"),
            None => format!("no sample of {name}"),
        };
        let Some(channel) = channel else {
            let advice = "compare the two configurations: `proprio estimator --check --gateway`";
            return Story::new(since, &[], advice);
        };
        if !channel.is_silent && channel.age.is_some() {
            return Story::new(
                format!("samples of {name} come too rarely"),
                &["between two of them was more than input.max_silence_ms allows"],
                "compare its rate in `proprio status` with max_silence_ms: three periods are a \
                 good maximum; a bus that is full, or lost frames, make gaps",
            );
        }
        let mut because = vec![since.clone()];
        if !channel.device.is_empty() {
            because.push(channel.comes_from());
        }
        let story = |head: String, advice: &str| Story {
            head,
            because: because.clone(),
            advice: advice.to_owned(),
        };
        if let Some(trouble) = &system.trouble {
            return story(trouble.clone(), RESTART);
        }
        let bus = system.buses.iter().find(|bus| bus.name == channel.bus);
        let on_bus = || {
            system
                .channels
                .iter()
                .filter(|other| other.bus == channel.bus)
        };
        let boards: BTreeSet<&str> = on_bus().map(|other| other.device.as_str()).collect();
        let all_silent = !channel.bus.is_empty() && on_bus().all(|other| other.is_silent);
        if let Some(bus) = bus.filter(|bus| bus.level == Level::Error) {
            return story(format!("bus {} is {}", bus.name, bus.state), CHECK_BUS);
        }
        if all_silent && boards.len() > 1 {
            let head = format!(
                "all {} boards of bus {} are silent",
                boards.len(),
                channel.bus
            );
            return story(head, CHECK_BUS);
        }
        let advice = match boards.len() > 1 && !all_silent {
            true => "check its power, cable and address; other boards of the bus are heard",
            false => "check its power, cable and address",
        };
        let device = system.device(channel);
        match device.filter(|device| device.level == Level::Error) {
            Some(HardwareState { name, state, .. }) => story(
                format!("board {name} on bus {} is {state}", channel.bus),
                advice,
            ),
            None if channel.device.is_empty() => Story {
                because: Vec::new(),
                ..story(since, advice)
            },
            None => {
                let head = format!("board {} on bus {} is silent", channel.device, channel.bus);
                story(head, advice)
            }
        }
    }

    /// Why there is no estimate.
    fn no_estimate(&self) -> Story {
        let system = &self.system;
        if let Some(trouble) = &system.trouble {
            return Story::new(trouble, &[], RESTART);
        }
        let trigger = self.cause.as_deref().and_then(|name| system.channel(name));
        match trigger.filter(|trigger| trigger.is_silent) {
            Some(trigger) => {
                let mut story = self.silent(&trigger.name);
                story.because.push(format!(
                    "an estimate is made for each sample of {} (output.trigger)",
                    trigger.name
                ));
                story
            }
            None => Story::new(
                "the estimator makes no estimate",
                &[],
                "its log tells which channels it lacks; `proprio estimator --check --gateway` \
                 compares the two configurations",
            ),
        }
    }
}

impl System {
    fn channel(&self, name: &str) -> Option<&ChannelState> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    fn device(&self, channel: &ChannelState) -> Option<&HardwareState> {
        let mut devices = self.devices.iter();
        devices.find(|device| device.name == channel.device && device.bus == channel.bus)
    }

    /// What is not as it should be with a channel's board and bus.
    fn conspicuous(&self, channel: &ChannelState) -> impl Iterator<Item = String> {
        let device = self.device(channel);
        let device = device.filter(|device| device.level != Level::Ok);
        let bus = self.buses.iter().find(|bus| bus.name == channel.bus);
        let of_device = device.map(|device| format!("board {} is {}", device.name, device.state));
        let bus = bus.filter(|bus| bus.level != Level::Ok);
        let of_bus = bus.map(|bus| format!("bus {} is {}", bus.name, bus.state));
        of_device.into_iter().chain(of_bus)
    }
}

impl ChannelState {
    fn comes_from(&self) -> String {
        format!(
            "{} comes from board {} on bus {}",
            self.name, self.device, self.bus
        )
    }
}

/// The parts of a budget, the largest first; without those of no or of infinite variance. Parts
/// that were identified together, of which one cancels a part of another, are one.
pub(super) fn shares(budget: &TorqueBudget) -> Vec<VarianceShare> {
    let matters = |part: &&BudgetPart| part.variance != 0.0 && part.variance.is_finite();
    let parts = budget.parts().iter().filter(matters);
    let mut all: Vec<(Vec<String>, f64, Source)> = parts
        .map(|part| {
            let source = part.source.get().unwrap_or(Source::Others);
            (vec![name(part)], part.variance, source)
        })
        .collect();
    // Only these are ever correlated.
    let is_identified =
        |source: Source| matches!(source, Source::Offset | Source::Gain | Source::Link);
    while let Some(negative) = all
        .iter()
        .position(|own| own.1 < 0.0 && is_identified(own.2))
    {
        let (names, variance, source) = all.swap_remove(negative);
        let others = all
            .iter_mut()
            .filter(|own| is_identified(own.2) && own.1 >= 0.0);
        match others.max_by(|a, b| a.1.total_cmp(&b.1)) {
            Some(largest) => {
                largest.0.extend(names);
                largest.1 += variance;
            }
            None => {
                all.push((names, variance, source));
                break;
            }
        }
    }
    all.sort_by(|a, b| b.1.total_cmp(&a.1));
    let together = |(names, variance, source): (Vec<String>, f64, Source)| VarianceShare {
        name: match names.as_slice() {
            [one] => one.clone(),
            all => format!("{}, correlated", all.join(", ")),
        },
        variance,
        source,
    };
    all.into_iter().map(together).collect()
}

/// The share of the sum of all that are finite [%].
pub(super) fn percent(share: &VarianceShare, budget: &TorqueBudget) -> f64 {
    let all = budget.parts().iter().map(|part| part.variance);
    let sum: f64 = all.filter(|variance| variance.is_finite()).sum();
    100.0 * share.variance / sum
}

/// A number with three digits.
pub(super) fn digits(number: f64) -> String {
    crate::report::number(number).replace('−', "-")
}

/// An input, for a person.
pub(super) fn name(part: &BudgetPart) -> String {
    let name = part.name.as_str();
    match part.source.get().unwrap_or(Source::Others) {
        Source::Noise => format!("the noise of {name}"),
        Source::Offset => format!("the offset of {name}"),
        Source::Gain => format!("the calibration of {name}"),
        Source::Drift => format!("the drift of {name}"),
        Source::Link => format!("the inertial parameters of {name}"),
        Source::Position => format!("the encoder of {name} (zero and noise)"),
        Source::Acceleration => format!("the acceleration of {name}"),
        Source::Base => "the acceleration of the base".to_owned(),
        Source::Rotation => "the angular acceleration of the base".to_owned(),
        Source::Place => format!("the place of contact {name}"),
        Source::Alternative => "what identification has not refuted".to_owned(),
        Source::Step => "a jump of an offset, or a contact, that may have begun".to_owned(),
        Source::Others => "further inputs".to_owned(),
        Source::Present => format!("contact {name}"),
        Source::Absent => format!("no contact at {name}"),
    }
}

/// The names of the parts from a source, in the order of their names.
pub(super) fn names(budget: &TorqueBudget, source: Source) -> Vec<&str> {
    let parts = budget.parts().iter().filter(|part| part.source == source);
    let mut names: Vec<&str> = parts.map(|part| part.name.as_str()).collect();
    names.sort_unstable();
    names
}

fn list(names: &[&str]) -> String {
    names.join(", ")
}

fn list_has(names: &[&str]) -> String {
    let verb = if names.len() == 1 { "has" } else { "have" };
    format!("{} {verb}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::{JointTorque, Name};

    fn budget(parts: &[(Source, &str, f64)]) -> TorqueBudget {
        let mut budget = TorqueBudget::new();
        for (source, name, variance) in parts {
            budget.add(BudgetPart {
                source: source.in_memory(),
                name: Name::new(name).unwrap_or(Name::EMPTY),
                variance: *variance,
                ..BudgetPart::NONE
            });
        }
        budget.sort();
        budget.deviation = parts.iter().map(|own| own.2).sum::<f64>().sqrt();
        budget
    }

    fn known(budget: Option<TorqueBudget>, cause: Option<&str>, system: System) -> TorqueCase {
        TorqueCase {
            joint: "elbow".to_owned(),
            opinion: String::new(),
            budget,
            cause: cause.map(str::to_owned),
            system,
            identifies: true,
        }
    }

    fn withheld(reason: Reason, mut budget: TorqueBudget) -> TorqueBudget {
        budget.torque = JointTorque {
            reason: reason.in_memory(),
            ..JointTorque::ABSENT
        };
        budget
    }

    fn channel(name: &str, device: &str, bus: &str, is_silent: bool) -> ChannelState {
        ChannelState {
            name: name.to_owned(),
            device: device.to_owned(),
            bus: bus.to_owned(),
            age: is_silent.then_some(2.0),
            is_silent,
        }
    }

    #[test]
    fn parts_that_cancel_each_other_are_one() {
        let budget = budget(&[
            (Source::Offset, "ft", 5.0),
            (Source::Link, "hand", 4.0),
            (Source::Gain, "ft", -7.0),
            (Source::Noise, "ft", 1.0),
            (Source::Base, "", 0.0),
            (Source::Position, "elbow", 7.0),
        ]);
        let shares = shares(&budget);
        let parts: Vec<(&str, f64)> = (shares.iter())
            .map(|own| (own.name.as_str(), own.variance))
            .collect();
        let together = "the inertial parameters of hand, the offset of ft, the calibration of ft, \
                        correlated";
        let encoder = "the encoder of elbow (zero and noise)";
        assert_eq!(
            parts,
            [(encoder, 7.0), (together, 2.0), ("the noise of ft", 1.0)]
        );
        assert!((percent(&shares[0], &budget) - 70.0).abs() < 1e-9);
    }

    #[test]
    fn a_silent_channel_is_traced_to_what_is_silent_as_a_whole() {
        let one = channel("elbow", "motor_a", "can0", true);
        let other = |is_silent| channel("wrist", "motor_b", "can0", is_silent);
        let part = |name: &str, bus: &str, state: &str| HardwareState {
            name: name.to_owned(),
            bus: bus.to_owned(),
            state: state.to_owned(),
            level: Level::Error,
        };
        let head = |system: System| {
            let stale = withheld(Reason::Stale, TorqueBudget::new());
            known(Some(stale), Some("elbow"), system).story().head
        };
        let channels = |others_silent| vec![one.clone(), other(others_silent)];
        for (system, expected) in [
            (
                System {
                    channels: channels(false),
                    ..System::default()
                },
                "board motor_a on bus can0 is silent",
            ),
            (
                System {
                    channels: channels(false),
                    devices: vec![part("motor_a", "can0", "refused: it does not answer")],
                    ..System::default()
                },
                "board motor_a on bus can0 is refused: it does not answer",
            ),
            (
                System {
                    channels: channels(true),
                    ..System::default()
                },
                "all 2 boards of bus can0 are silent",
            ),
            (
                System {
                    channels: channels(true),
                    buses: vec![part("can0", "", "down")],
                    ..System::default()
                },
                "bus can0 is down",
            ),
            (
                System {
                    channels: channels(true),
                    trouble: Some("the gateway has ended".to_owned()),
                    ..System::default()
                },
                "the gateway has ended",
            ),
            (
                System {
                    channels: vec![channel("elbow", "", "", true)],
                    ..System::default()
                },
                "no sample of elbow for 2.0 s",
            ),
        ] {
            assert_eq!(head(system), format!("elbow is withheld: {expected}"));
        }
    }

    #[test]
    fn every_reason_has_its_words() {
        let heads: BTreeSet<String> = Reason::ALL
            .into_iter()
            .map(|reason| {
                let case = withheld(reason, budget(&[(Source::Offset, "ft", 4.0)]));
                let story = known(Some(case), Some("ft"), System::default()).story();
                let needs_none = matches!(reason, Reason::None | Reason::Absent);
                assert!(needs_none || !story.advice.is_empty(), "{reason}");
                story.head
            })
            .collect();
        // What has never come is silent, as what comes no longer.
        assert_eq!(heads.len(), Reason::ALL.len() - 1, "{heads:#?}");
    }

    #[test]
    fn what_is_uncertain_names_what_to_move() {
        let mut case = withheld(Reason::Uncertain, budget(&[(Source::Link, "hand", 4.0)]));
        case.bound = 1.0;
        for (name, travel) in [("wrist", 0.01), ("elbow", 1.0)] {
            case.add(BudgetPart {
                source: Source::Position.in_memory(),
                name: Name::new(name).unwrap_or(Name::EMPTY),
                travel,
                ..BudgetPart::NONE
            });
        }
        let story = known(Some(case), None, System::default()).story();
        assert!(
            story.head.contains("2.00 Nm exceeds the bound of 1.00 Nm"),
            "{story:?}"
        );
        assert!(
            story.head.ends_with(
                "100 % of the variance is the inertial parameters of hand; wrist has hardly moved"
            ),
            "{story:?}"
        );
        assert_eq!(story.advice, "move wrist, without a contact");
        case.deviation = f64::INFINITY;
        let story = known(Some(case), None, System::default()).story();
        assert!(
            story
                .head
                .ends_with("as configured: wrist has hardly moved"),
            "{story:?}"
        );
    }

    #[test]
    fn without_estimates_the_trigger_counts() {
        let channels = vec![
            channel("wrist", "motor_b", "can1", true),
            channel("ft", "strain", "can0", true),
            channel("imu", "imu", "can0", false),
        ];
        let system = System {
            channels,
            ..System::default()
        };
        let story = known(None, Some("ft"), system.clone()).story();
        assert_eq!(
            story.head,
            "elbow has no torque: board strain on bus can0 is silent"
        );
        let story = known(None, Some("imu"), system).story();
        assert_eq!(
            story.head,
            "elbow has no torque: the estimator makes no estimate"
        );
    }

    #[test]
    fn what_is_stale_but_not_silent_comes_too_rarely() {
        let mut slow = channel("elbow", "motor_a", "can0", false);
        slow.age = Some(0.02);
        let system = System {
            channels: vec![slow],
            ..System::default()
        };
        let stale = withheld(Reason::Stale, TorqueBudget::new());
        let story = known(Some(stale), Some("elbow"), system).story();
        assert_eq!(
            story.head,
            "elbow is withheld: samples of elbow come too rarely"
        );
    }
}
