//! What a robot sends, as messages for a [`MessageSink`].

use crate::cdr::CdrMessage;
use crate::definitions::{self, Definition};
use crate::diagnostics;
use crate::listener::Heard;
use proprio_topics::csv::{Series, SeriesKind, Value};
use proprio_topics::{
    Agreement, Candidate, ContactEstimate, ContactState, Description, DriveEstimate, Entry,
    EstimatorHealth, GatewayHealth, Imu, JointState, JointTorque, Kind, Nanos, Quality, Reading,
    Role, TorqueEstimate, Wrench,
};
use std::collections::BTreeMap;

/// A joint's position whose reading has one of these flags is none.
const UNTRUSTED: Quality = Quality(Quality::UNTRUSTED_ENCODER.0 | Quality::IMPLAUSIBLE.0);
/// The newest state of a joint holds for four of its periods, but no shorter and no longer than
/// this.
const SHORTEST: Nanos = Nanos::from_millis(50);
const LONGEST: Nanos = Nanos::from_millis(1000);
/// How often it is said how everything is.
const SECOND: Nanos = Nanos::from_millis(1000);

/// Where messages go: a file, a viewer, a network.
pub trait MessageSink {
    /// A topic of it.
    type Channel: Clone;
    /// Why it cannot take a message.
    type Error;

    /// Adds a topic. `series` is the number of the table's series whose values it has. `None`: this
    /// sink does not carry such messages.
    ///
    /// # Errors
    /// It cannot be added.
    fn add(
        &mut self,
        topic: &str,
        definition: &Definition,
        series: Option<usize>,
    ) -> Result<Option<Self::Channel>, Self::Error>;

    /// Sends a message that is of the instant `wall` \[ns since 1970, UTC\].
    ///
    /// # Errors
    /// It cannot be sent.
    fn send(
        &mut self,
        channel: &Self::Channel,
        wall: u64,
        message: &CdrMessage,
    ) -> Result<(), Self::Error>;
}

/// A series of the table: its own topic, and the one of a standard message.
struct KnownSeries<C> {
    series: Series,
    own: Option<C>,
    /// Of readings of other kinds than the main one, as temperatures.
    others: BTreeMap<&'static str, Option<C>>,
    standard: Option<C>,
    /// The newest state of a joint, its instant, and until when it holds.
    state: JointState,
    newest: Nanos,
    holds_until: Nanos,
}

/// The topics of everything that is not a series, as they come to be needed.
struct TopicCache<C> {
    known: BTreeMap<String, Option<C>>,
}

impl<C: Clone> TopicCache<C> {
    fn get<S: MessageSink<Channel = C>>(
        &mut self,
        sink: &mut S,
        topic: String,
        definition: fn() -> Definition,
    ) -> Result<Option<C>, S::Error> {
        if let Some(known) = self.known.get(&topic) {
            return Ok(known.clone());
        }
        let added = sink.add(&topic, &definition(), None)?;
        self.known.insert(topic, added.clone());
        Ok(added)
    }
}

/// Says what a robot sends.
pub struct Messages<S: MessageSink> {
    sink: S,
    robot: String,
    /// The wall clock minus CLOCK_MONOTONIC.
    offset: Nanos,
    known: Vec<KnownSeries<S::Channel>>,
    topics: TopicCache<S::Channel>,
    gateway: Option<Box<GatewayHealth>>,
    estimator: Option<Box<EstimatorHealth>>,
    /// When it is said next how everything is.
    second: Nanos,
}

impl<S: MessageSink> Messages<S> {
    /// For this robot; `offset` is the wall clock minus CLOCK_MONOTONIC.
    pub fn new(sink: S, robot: &str, offset: Nanos) -> Self {
        Self {
            sink,
            robot: robot.to_owned(),
            offset,
            known: Vec::new(),
            topics: TopicCache {
                known: BTreeMap::new(),
            },
            gateway: None,
            estimator: None,
            second: Nanos::MIN,
        }
    }

    /// Where they go.
    pub const fn sink(&mut self) -> &mut S {
        &mut self.sink
    }

    /// Goes on with another sink, whose topics are added as to a new one; returns the one before.
    /// `offset` as in [`Messages::new`].
    ///
    /// # Errors
    /// Those of the new sink.
    pub fn turn_to(&mut self, sink: S, offset: Nanos) -> Result<S, S::Error> {
        let before = std::mem::replace(&mut self.sink, sink);
        self.offset = offset;
        self.topics.known.clear();
        let known = std::mem::take(&mut self.known);
        let series: Vec<Series> = known.iter().map(|one| one.series.clone()).collect();
        self.know(&series)?;
        for (now, before) in self.known.iter_mut().zip(known) {
            now.state = before.state;
            (now.newest, now.holds_until) = (before.newest, before.holds_until);
        }
        self.announce()?;
        Ok(before)
    }

    /// Where they went.
    pub fn into_sink(self) -> S {
        self.sink
    }

    /// Follows the wall clock when it is set.
    pub const fn set_offset(&mut self, offset: Nanos) {
        self.offset = offset;
    }

    /// The wall clock's time of an instant \[ns since 1970, UTC\].
    #[must_use]
    pub fn wall(&self, t: Nanos) -> u64 {
        u64::try_from(t.saturating_add(self.offset).0).unwrap_or(0)
    }

    /// Adds the topics of the series that are new in `series`; the others are as before.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn know(&mut self, series: &[Series]) -> Result<(), S::Error> {
        for (number, one) in series.iter().enumerate().skip(self.known.len()) {
            let name = &one.name;
            let (topic, definition, standard) = match one.kind {
                SeriesKind::Channel(kind) => (
                    format!("/samples/{kind}/{name}"),
                    definitions::sample(kind),
                    match kind {
                        Kind::Wrench => {
                            Some((format!("/ft/{name}"), definitions::wrench_stamped()))
                        }
                        Kind::Imu => Some((format!("/imu/{name}"), definitions::imu())),
                        _ => None,
                    },
                ),
                SeriesKind::Contact => (format!("/declared/{name}"), definitions::declared(), None),
            };
            let own = self.sink.add(&topic, &definition, Some(number))?;
            let standard = match standard {
                Some((topic, definition)) => self.sink.add(&topic, &definition, None)?,
                None => None,
            };
            self.known.push(KnownSeries {
                series: one.clone(),
                own,
                others: BTreeMap::new(),
                standard,
                state: JointState::ABSENT,
                newest: Nanos::MIN,
                holds_until: Nanos::MIN,
            });
        }
        Ok(())
    }

    /// Adds the topics of torques, joint states and contacts, which else come to be with the first
    /// message: for those who look what there is.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn announce(&mut self) -> Result<(), S::Error> {
        self.topic("/torques", definitions::torques)?;
        self.topic("/joint_states", definitions::joint_state)?;
        self.topic("/contacts", definitions::contacts)?;
        self.topic("/diagnostics", definitions::diagnostics)?;
        Ok(())
    }

    fn topic(
        &mut self,
        topic: &str,
        definition: fn() -> Definition,
    ) -> Result<Option<S::Channel>, S::Error> {
        self.topics
            .get(&mut self.sink, topic.to_owned(), definition)
    }

    /// A message of a standard or own type on any topic, at `t`; `message` is given the wall
    /// clock's time.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn send(
        &mut self,
        topic: &str,
        definition: fn() -> Definition,
        t: Nanos,
        message: impl FnOnce(u64) -> CdrMessage,
    ) -> Result<(), S::Error> {
        let wall = self.wall(t);
        match self.topic(topic, definition)? {
            Some(channel) => self.sink.send(&channel, wall, &message(wall)),
            None => Ok(()),
        }
    }

    /// What was heard, at `t`.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn say(&mut self, t: Nanos, heard: &Heard) -> Result<(), S::Error> {
        match heard {
            Heard::Value(series, value) => self.value(t, *series, value),
            Heard::Torques(torques, names) => self.torques(names, torques),
            Heard::Contacts(contacts, names) => self.contacts(names, contacts),
            Heard::Drives(drives, names) => self.drives(names, drives),
            Heard::Gateway(health) => {
                self.gateway = Some(health.clone());
                Ok(())
            }
            Heard::Estimator(health) => {
                self.estimator = Some(health.clone());
                Ok(())
            }
        }
    }

    /// A value of the series with this number, at `t`.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn value(&mut self, t: Nanos, series: usize, value: &Value) -> Result<(), S::Error> {
        let wall = self.wall(t);
        let (sink, Some(known)) = (&mut self.sink, self.known.get_mut(series)) else {
            return Ok(());
        };
        match (known.series.kind, value) {
            (SeriesKind::Channel(main), Value::Reading(reading, quality)) => {
                let kind = reading.kind();
                let name = known.series.name.as_str();
                let own = match known.others.get(kind.word()) {
                    _ if kind == main => known.own.clone(),
                    Some(other) => other.clone(),
                    None => {
                        let topic = format!("/samples/{kind}/{name}");
                        let other = sink.add(&topic, &definitions::sample(kind), Some(series))?;
                        known.others.insert(kind.word(), other.clone());
                        other
                    }
                };
                if let Some(own) = own {
                    sink.send(&own, wall, &sample(t, reading, *quality))?;
                }
                match (reading, &known.standard) {
                    (Reading::Joint(state), _) => {
                        let is_believed = !quality.intersects(UNTRUSTED);
                        known.state = if is_believed {
                            *state
                        } else {
                            JointState::ABSENT
                        };
                        let period = t.saturating_sub(known.newest);
                        let longest = (period + period + period + period).min(LONGEST);
                        known.holds_until = t + longest.max(SHORTEST);
                        known.newest = t;
                        Ok(())
                    }
                    (Reading::Wrench(wrench), Some(channel)) => {
                        sink.send(channel, wall, &wrench_stamped(wall, name, wrench))
                    }
                    (Reading::Imu(reading), Some(channel)) => {
                        sink.send(channel, wall, &imu(wall, name, reading))
                    }
                    _ => Ok(()),
                }
            }
            (SeriesKind::Contact, Value::Contact(state)) => match &known.own {
                Some(own) => sink.send(own, wall, &declared(t, state)),
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    /// The torques of an instant, of the estimator that sent `names`.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn torques(
        &mut self,
        names: &Description,
        estimate: &TorqueEstimate,
    ) -> Result<(), S::Error> {
        let t = estimate.header.acquired;
        let joints: Vec<(&str, &JointTorque)> = joints(names, estimate).collect();
        self.send("/torques", definitions::torques, t, |_| {
            let mut message = CdrMessage::new();
            message.i64(t.0);
            message.texts(&joints, |(name, _)| name);
            message.numbers(&joints, |(_, joint)| joint.torque);
            message.numbers(&joints, |(_, joint)| joint.standard_deviation);
            message.sequence(&joints, |message, (_, joint)| {
                message.bool(joint.valid == 1);
            });
            message.texts(&joints, |(_, joint)| reason(joint));
            message.texts(&joints, |(_, joint)| {
                name(names, Role::Channel, joint.cause)
            });
            message
        })?;
        let states = joints.iter().map(|(name, _)| self.state(name, t));
        let states: Vec<JointState> = states.collect();
        self.send("/joint_states", definitions::joint_state, t, |wall| {
            let mut message = CdrMessage::stamped(wall, "");
            message.texts(&joints, |(name, _)| name);
            message.numbers(&states, |state| state.position);
            message.numbers(&states, |state| state.velocity);
            message.numbers(&joints, |(_, joint)| usable(joint));
            message
        })
    }

    /// The torques of an instant, each joint's on a topic of its own, with a band of two standard
    /// deviations: for plots.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn torque_bands(
        &mut self,
        names: &Description,
        estimate: &TorqueEstimate,
    ) -> Result<(), S::Error> {
        let t = estimate.header.acquired;
        for (joint_name, joint) in joints(names, estimate) {
            let topic = format!("/torque/{joint_name}");
            self.send(&topic, definitions::joint_torque, t, |_| {
                let torque = usable(joint);
                let half = 2.0 * joint.standard_deviation;
                let mut message = CdrMessage::new();
                message.i64(t.0);
                message.f64s(&[torque, torque - half, torque + half]);
                message.bool(joint.valid == 1);
                message.text(reason(joint));
                message.text(name(names, Role::Channel, joint.cause));
                message
            })?;
        }
        Ok(())
    }

    /// The newest state of a joint at `t`; NaN before the first, after its board has fallen silent,
    /// and while its encoder is not to be trusted.
    #[must_use]
    pub fn state(&self, joint: &str, t: Nanos) -> JointState {
        let is_joint = |known: &&KnownSeries<S::Channel>| {
            known.series.kind == SeriesKind::Channel(Kind::Joint) && known.series.name == joint
        };
        let known = self.known.iter().find(is_joint);
        let known = known.filter(|known| t <= known.holds_until);
        known.map_or(JointState::ABSENT, |known| known.state)
    }

    /// The contact wrenches of an instant and what they leave unexplained of each sub-tree's F/T
    /// readings, of the estimator that sent `names`.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn contacts(
        &mut self,
        names: &Description,
        estimate: &ContactEstimate,
    ) -> Result<(), S::Error> {
        let t = estimate.header.acquired;
        let entry = |number| names.find(Role::Contact, number);
        self.send("/contacts", definitions::contacts, t, |_| {
            let mut message = CdrMessage::new();
            message.i64(t.0);
            message.count(estimate.contacts().len());
            for (contact, number) in estimate.contacts().iter().zip(0..) {
                message.text(name(names, Role::Contact, number));
                message.text(entry(number).map_or("", |entry| entry.origin.as_str()));
                message.f64s(&contact.force);
                message.f64s(&contact.torque);
                message.f64s(&contact.standard_deviation);
                message.bool(contact.valid == 1);
                message.text(contact.reason.get().map_or("?", |reason| reason.word()));
                message.text(name(names, Role::Channel, contact.cause));
                message.bool(contact.detected == 1);
                message.bool(contact.located == 1);
                message.f64s(&contact.position);
            }
            message
        })?;
        for (contact, number) in estimate.contacts().iter().zip(0..) {
            let Some(entry) = entry(number).filter(|_| contact.valid == 1) else {
                continue;
            };
            self.wrench("contact", entry, t, contact.force, contact.torque)?;
        }
        for (residual, number) in estimate.residuals().iter().zip(0..) {
            // Zeros without a significance are no measurement: a contact that may be anything
            // takes all, or a sensor fails.
            let is_known = !residual.significance.is_nan();
            let values = residual.force.iter().chain(&residual.torque);
            let is_known = is_known && values.into_iter().all(|value| value.is_finite());
            let entry = names.find(Role::SubTree, number).filter(|_| is_known);
            let Some(entry) = entry else { continue };
            self.wrench("external", entry, t, residual.force, residual.torque)?;
        }
        Ok(())
    }

    /// What the drives say of the torques of an instant, of the estimator that sent `names`.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn drives(
        &mut self,
        names: &Description,
        estimate: &DriveEstimate,
    ) -> Result<(), S::Error> {
        let t = estimate.header.acquired;
        let (drives, candidates) = (estimate.drives(), estimate.candidates());
        self.send("/drives", definitions::drives, t, |_| {
            let mut message = CdrMessage::new();
            message.i64(t.0);
            message.texts(drives, |own| name(names, Role::Joint, own.joint));
            message.numbers(drives, |own| own.torque);
            message.numbers(drives, |own| own.standard_deviation);
            message.texts(drives, |own| {
                own.agreement.get().map_or("?", Agreement::word)
            });
            message.numbers(drives, |own| own.deviate);
            message.texts(drives, |own| name(names, Role::Joint, own.group));
            message.texts(candidates, |own| {
                own.kind.get().map_or("?", Candidate::word)
            });
            message.texts(candidates, |own| own.name.as_str());
            message.texts(candidates, |own| name(names, Role::Joint, own.joint));
            message
        })
    }

    /// A wrench \[N, Nm\] on the topic `/<what>/<name>`, in the frame of its entry.
    fn wrench(
        &mut self,
        what: &str,
        entry: &Entry,
        t: Nanos,
        force: [f64; 3],
        torque: [f64; 3],
    ) -> Result<(), S::Error> {
        let topic = format!("/{what}/{}", entry.name.as_str());
        self.send(&topic, definitions::wrench_stamped, t, |wall| {
            wrench_stamped(wall, entry.origin.as_str(), &Wrench { force, torque })
        })
    }

    /// [`Messages::diagnostics`], if the last ones were a second before `t`; the first ones come a
    /// second after the first call, when health has come.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn each_second(&mut self, t: Nanos) -> Result<(), S::Error> {
        if t < self.second {
            return Ok(());
        }
        let is_first = self.second == Nanos::MIN;
        self.second = t + SECOND;
        match is_first {
            true => Ok(()),
            false => self.diagnostics(t),
        }
    }

    /// How gateway and estimator are at `now`, of what was heard of them last.
    ///
    /// # Errors
    /// Those of the sink.
    pub fn diagnostics(&mut self, now: Nanos) -> Result<(), S::Error> {
        let all = diagnostics::of(
            &self.robot,
            self.gateway.as_deref(),
            self.estimator.as_deref(),
            now,
        );
        let robot = self.robot.clone();
        self.send("/diagnostics", definitions::diagnostics, now, |wall| {
            diagnostics::message(wall, &robot, &all)
        })
    }
}

/// The name of this number, if it has one.
fn name(names: &Description, role: Role, number: u32) -> &str {
    (names.find(role, number)).map_or("", |entry| entry.name.as_str())
}

/// The joints of an estimate, with their names.
fn joints<'a>(
    names: &'a Description,
    estimate: &'a TorqueEstimate,
) -> impl Iterator<Item = (&'a str, &'a JointTorque)> {
    (estimate.joints().iter().zip(0..))
        .map(|(joint, number)| (name(names, Role::Joint, number), joint))
}

/// A torque; NaN if it is withheld.
fn usable(joint: &JointTorque) -> f64 {
    match joint.valid {
        1 => joint.torque,
        _ => f64::NAN,
    }
}

/// Why a torque is withheld.
fn reason(joint: &JointTorque) -> &'static str {
    joint.reason.get().map_or("?", |reason| reason.word())
}

fn sample(t: Nanos, reading: &Reading, quality: Quality) -> CdrMessage {
    let mut message = CdrMessage::new();
    message.i64(t.0);
    message.u32(quality.0);
    let count = reading.kind().fields().len();
    message.f64s(reading.values().get(..count).unwrap_or_default());
    message
}

fn declared(t: Nanos, state: &ContactState) -> CdrMessage {
    let mut message = CdrMessage::new();
    message.i64(t.0);
    message.bool(state.active);
    message.f64s(&state.position);
    message.f64s(&[state.position_std]);
    message.f64s(&state.direction);
    message
}

fn wrench_stamped(wall: u64, frame: &str, wrench: &Wrench) -> CdrMessage {
    let mut message = CdrMessage::stamped(wall, frame);
    message.f64s(&wrench.force);
    message.f64s(&wrench.torque);
    message
}

fn imu(wall: u64, frame: &str, imu: &Imu) -> CdrMessage {
    let mut message = CdrMessage::stamped(wall, frame);
    let [w, x, y, z] = imu.orientation;
    // Of a covariance, -1 first says that there is no value, 0 that the covariance is not known.
    let is_known = !w.is_nan();
    message.f64s(&if is_known {
        [x, y, z, w]
    } else {
        [0.0, 0.0, 0.0, 1.0]
    });
    let first = if is_known { 0.0 } else { -1.0 };
    let covariance = [first, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    message.f64s(&covariance);
    message.f64s(&imu.angular_velocity);
    message.f64s(&[0.0; 9]);
    message.f64s(&imu.proper_acceleration);
    message.f64s(&[0.0; 9]);
    message
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::CdrReader;
    use proprio_topics::{
        ContactWrench, Entry, Header, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name, Publisher,
        Reason, Residual,
    };

    /// Keeps what it is sent.
    #[derive(Default)]
    struct Kept {
        topics: Vec<(String, String)>,
        sent: Vec<(String, u64, Vec<u8>)>,
    }

    impl MessageSink for Kept {
        type Channel = String;
        type Error = std::convert::Infallible;

        fn add(
            &mut self,
            topic: &str,
            definition: &Definition,
            _: Option<usize>,
        ) -> Result<Option<String>, Self::Error> {
            self.topics
                .push((topic.to_owned(), definition.name.clone()));
            Ok(Some(topic.to_owned()))
        }

        fn send(
            &mut self,
            topic: &String,
            wall: u64,
            message: &CdrMessage,
        ) -> Result<(), Self::Error> {
            let bytes = message.bytes().to_vec();
            self.sent.push((topic.clone(), wall, bytes));
            Ok(())
        }
    }

    fn entry(role: Role, index: u32, name: &str) -> Entry {
        Entry {
            name: Name::new(name).unwrap_or(Name::EMPTY),
            origin: Name::new(name).unwrap_or(Name::EMPTY),
            role: role.in_memory(),
            index,
            ..Entry::NONE
        }
    }

    #[test]
    fn each_torque_has_a_band_of_two_deviations() {
        let entries = [
            entry(Role::Joint, 0, "elbow"),
            entry(Role::Joint, 1, "wrist"),
            entry(Role::Channel, 3, "ft"),
        ];
        let names = Description::new(Publisher::Estimator, entries);
        let good = JointTorque {
            torque: 5.0,
            standard_deviation: 0.25,
            valid: 1,
            reason: Reason::None.in_memory(),
            ..JointTorque::ABSENT
        };
        // Too uncertain: the deviation is there, but no torque.
        let withheld = JointTorque {
            standard_deviation: 9.0,
            reason: Reason::Uncertain.in_memory(),
            cause: 3,
            ..JointTorque::ABSENT
        };
        let mut joints = [JointTorque::ABSENT; MAX_JOINTS];
        (joints[0], joints[1]) = (good, withheld);
        let header = Header {
            acquired: Nanos(7),
            ..Default::default()
        };
        let estimate = TorqueEstimate {
            header,
            count: 2,
            reserved: 0,
            joints,
        };
        let mut messages = Messages::new(Kept::default(), "arm", Nanos(100));
        let Ok(()) = messages.torque_bands(&names, &estimate);
        let kept = messages.into_sink();
        let type_name = "proprio_msgs/msg/JointTorque".to_owned();
        let expected = ["/torque/elbow", "/torque/wrist"];
        assert_eq!(
            kept.topics,
            expected.map(|topic| (topic.to_owned(), type_name.clone()))
        );
        let mut read = kept.sent.iter().map(|(topic, wall, bytes)| {
            let mut parsed = CdrReader::new(bytes).expect("CDR");
            assert_eq!((parsed.i64(), *wall), (Some(7), 107));
            let band = [0; 3].map(|_| parsed.f64().expect("a number"));
            let valid = parsed.bool();
            let (reason, cause) = (parsed.text(), parsed.text());
            assert_eq!(parsed.u8(), None, "the message ends");
            (topic.as_str(), band, valid, reason, cause)
        });
        assert_eq!(
            read.next(),
            Some((
                "/torque/elbow",
                [5.0, 4.5, 5.5],
                Some(true),
                Some(""),
                Some("")
            ))
        );
        let (_, band, valid, reason, cause) = read.next().expect("the wrist's");
        assert!(band.iter().all(|number| number.is_nan()), "{band:?}");
        assert_eq!(
            (valid, reason, cause),
            (Some(false), Some("uncertain"), Some("ft"))
        );
    }

    #[test]
    fn an_external_wrench_is_sent_where_it_is_known() {
        let names = Description::new(
            Publisher::Estimator,
            [
                entry(Role::Contact, 0, "hand"),
                entry(Role::SubTree, 0, "chest"),
                entry(Role::SubTree, 1, "l_upper_arm"),
                entry(Role::SubTree, 2, "r_upper_arm"),
            ],
        );
        let mut residuals = [Residual::ABSENT; MAX_SUBTREES];
        // Zeros that nobody measured, as of a sub-tree with a contact that may be anything.
        (residuals[0].force, residuals[0].torque) = ([0.0; 3], [0.0; 3]);
        residuals[1] = Residual {
            force: [1.0, 2.0, 3.0],
            torque: [4.0, 5.0, 6.0],
            significance: 7.0,
            ..Residual::ABSENT
        };
        residuals[2].significance = 0.0;
        let acquired = Nanos::from_millis(2_000);
        let estimate = ContactEstimate {
            header: Header {
                acquired,
                ..Header::default()
            },
            count: 1,
            residual_count: 3,
            contacts: [ContactWrench::ABSENT; MAX_CONTACTS],
            residuals,
        };
        let mut messages = Messages::new(Kept::default(), "arm", Nanos::from_millis(500));
        assert_eq!(messages.contacts(&names, &estimate), Ok(()));
        let mut sent = messages.into_sink().sent;
        sent.retain(|(topic, ..)| topic.starts_with("/external"));
        let topics: Vec<&str> = sent.iter().map(|(topic, ..)| topic.as_str()).collect();
        assert_eq!(topics, ["/external/l_upper_arm"]);
        let mut message = CdrReader::new(&sent[0].2).expect("CDR");
        assert_eq!(message.time(), Some(Nanos::from_millis(2_500)));
        assert_eq!(message.text(), Some("l_upper_arm"));
        let values = [(); 6].map(|()| message.f64().expect("a number"));
        assert_eq!(values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }
}
