//! A node of ROS 2: a participant of DDS that publishes messages and says which of its writers
//! belong to the node, so that `ros2 node` and `ros2 topic` show them.

use crate::names::{TopicNames, dds_topic, dds_type};
use proprio_bridge::MessageSink;
use proprio_bridge::cdr::CdrMessage;
use proprio_bridge::definitions::Definition;
use proprio_topics::Nanos;
use rustdds::bytes::Bytes;
use rustdds::dds::{CreateError, WriteError};
use rustdds::no_key::{DataWriter, SerializerAdapter};
use rustdds::policy::{Durability, History, Reliability, ResourceLimits};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, Duration, GUID, Publisher, QosPolicies,
    QosPolicyBuilder, RTPSEntity, RepresentationIdentifier, Timestamp, TopicKind,
};
use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::IpAddr;

/// The packages whose messages every installation of ROS 2 knows.
const PACKAGES: [&str; 3] = ["sensor_msgs/", "geometry_msgs/", "diagnostic_msgs/"];
/// The node's name.
const NAME: &str = "proprio_ros2";
/// How many messages of a topic wait for a reader.
const DEPTH: i32 = 5;
/// How many messages a reader may owe acknowledgements of, and how many are kept meanwhile. A
/// reader that hangs is given up by DDS after 10 to 20 s.
const WINDOW: i32 = 16_384;
/// How many messages wait while a reader owes too many acknowledgements. Each reader that is new
/// does at first, for some milliseconds.
const QUEUE: usize = 100;
/// How long they wait. Then a writer that is owed nothing takes the old one's place, so that
/// a reader without acknowledgements does not stop the others for ever.
const PATIENCE: Nanos = Nanos::from_millis(1000);

/// Why the node cannot work.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NodeError {
    /// Something of DDS cannot be created.
    #[error("cannot create {what} in DDS domain {domain}: {error}")]
    Create {
        /// What.
        what: String,
        /// The domain's number.
        domain: u16,
        /// Why.
        error: CreateError,
    },
    /// A message cannot be sent.
    #[error("cannot publish on {topic}: {why}")]
    Write {
        /// The topic.
        topic: String,
        /// Why.
        why: String,
    },
}

/// What a node is.
#[derive(Debug, Clone)]
pub(crate) struct NodeOptions {
    /// Of all topics and the node, as [`crate::names::namespace`] gives it.
    pub(crate) namespace: String,
    /// The domain of DDS.
    pub(crate) domain: u16,
    /// The addresses to be seen at; `None`: all.
    pub(crate) addresses: Option<Vec<IpAddr>>,
    /// Whether lost messages are not sent again.
    pub(crate) is_best_effort: bool,
    /// Most messages of a topic per second.
    pub(crate) rate: Option<f64>,
    /// The bytes of an identifier: 24 up to ROS 2 Humble, 16 since.
    pub(crate) identifier: usize,
}

/// Messages come encoded: [`CdrMessage`] without the four bytes that
/// [`CdrAdapter::output_encoding`] stands for.
struct CdrAdapter;

impl SerializerAdapter<Bytes> for CdrAdapter {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(message: &Bytes) -> Result<Bytes, Infallible> {
        Ok(message.clone())
    }
}

fn body(message: &CdrMessage) -> Bytes {
    Bytes::copy_from_slice(message.bytes().get(4..).unwrap_or_default())
}

/// DDS counts fractions of a second in 2^-32; `wall` is in \[ns since 1970, UTC\].
fn timestamp(wall: u64) -> Timestamp {
    let (seconds, rest) = (wall / 1_000_000_000, wall % 1_000_000_000);
    Timestamp::from_ticks((seconds << 32) | ((rest << 32) / 1_000_000_000))
}

/// Lets messages of a topic pass at most at a rate, evenly.
#[derive(Debug, Clone, Copy)]
struct RateLimit {
    /// Between two messages \[ns\].
    period: u64,
    /// The next one is due \[ns since 1970, UTC\].
    due: u64,
}

impl RateLimit {
    fn new(rate: f64) -> Self {
        Self {
            period: (1e9 / rate) as u64,
            due: 0,
        }
    }

    /// Whether a message of the instant `wall` passes.
    fn passes(&mut self, wall: u64) -> bool {
        // The wall clock may have been set back.
        let is_due = wall >= self.due || self.due - wall > self.period;
        if is_due {
            // A little late is not later for ever; after a silence none are made up for.
            let next = self.due.saturating_add(self.period);
            self.due = match next > wall && next - wall <= self.period {
                true => next,
                false => wall.saturating_add(self.period),
            };
        }
        is_due
    }
}

struct NodeTopic {
    name: String,
    kind: String,
    writer: DataWriter<Bytes, CdrAdapter>,
    pace: Option<RateLimit>,
    /// What could not be written yet, with its stamp.
    waiting: VecDeque<(Bytes, Timestamp)>,
    /// Since when (CLOCK_MONOTONIC).
    since: Nanos,
    /// A reader that does not acknowledge has been told of.
    is_told: bool,
}

impl NodeTopic {
    /// Writes what waits, as far as readers acknowledge.
    fn write(&mut self) -> Result<(), NodeError> {
        while let Some((message, stamp)) = self.waiting.front() {
            match self.writer.write(message.clone(), Some(*stamp)) {
                Ok(()) => drop(self.waiting.pop_front()),
                Err(WriteError::WouldBlock { .. }) => break,
                Err(error) => {
                    return Err(NodeError::Write {
                        topic: self.name.clone(),
                        why: error.to_string(),
                    });
                }
            }
        }
        Ok(())
    }
}

/// The node.
pub(crate) struct RosNode {
    options: NodeOptions,
    participant: DomainParticipant,
    publisher: Publisher,
    names: TopicNames,
    topics: Vec<NodeTopic>,
    /// The time (CLOCK_MONOTONIC).
    now: Nanos,
    /// Says which nodes are in this participant.
    graph: DataWriter<Bytes, CdrAdapter>,
}

impl RosNode {
    /// Joins the network.
    ///
    /// # Errors
    /// DDS cannot be used here.
    pub(crate) fn new(options: NodeOptions) -> Result<Self, NodeError> {
        let failed = |what: &str| {
            let (what, domain) = (what.to_owned(), options.domain);
            move |error: CreateError| NodeError::Create {
                what,
                domain,
                error,
            }
        };
        let builder = DomainParticipantBuilder::new(options.domain);
        let builder = match &options.addresses {
            Some(addresses) => builder.with_only_networks(addresses.iter().copied()),
            None => builder,
        };
        let participant = builder.build().map_err(failed("a participant"))?;
        // As all of ROS 2's nodes say it.
        let qos = QosPolicyBuilder::new()
            .durability(Durability::TransientLocal)
            .reliable(Duration::ZERO)
            .history(History::KeepLast { depth: 1 })
            .build();
        let publisher = (participant.create_publisher(&qos)).map_err(failed("a publisher"))?;
        let graph = writer(
            &participant,
            &publisher,
            "ros_discovery_info",
            "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
            &qos,
        );
        let node = Self {
            graph: graph.map_err(failed("ros_discovery_info"))?,
            names: TopicNames::new(&options.namespace),
            topics: Vec::new(),
            now: Nanos::ZERO,
            participant,
            publisher,
            options,
        };
        node.say_who_it_is()?;
        Ok(node)
    }

    fn qos(&self) -> QosPolicies {
        let qos = QosPolicyBuilder::new()
            .durability(Durability::Volatile)
            .history(History::KeepLast { depth: DEPTH })
            .resource_limits(ResourceLimits {
                max_samples: WINDOW,
                max_instances: 1,
                max_samples_per_instance: WINDOW,
            });
        let reliability = match self.options.is_best_effort {
            true => Reliability::BestEffort,
            // Without blocking: a robot does not wait for a reader.
            false => Reliability::Reliable {
                max_blocking_time: Duration::ZERO,
            },
        };
        qos.reliability(reliability).build()
    }

    /// Writes what still waits, at `now` (CLOCK_MONOTONIC): a topic may have no further message for
    /// long. A writer to which a reader owes acknowledgements for too long is replaced.
    ///
    /// # Errors
    /// DDS refuses something.
    pub(crate) fn turn(&mut self, now: Nanos) -> Result<(), NodeError> {
        self.now = now;
        for place in 0..self.topics.len() {
            let Some(topic) = self.topics.get_mut(place) else {
                break;
            };
            topic.write()?;
            if topic.waiting.is_empty() || now.saturating_sub(topic.since) < PATIENCE {
                continue;
            }
            if !std::mem::replace(&mut topic.is_told, true) {
                eprintln!(
                    "{}: a reliable reader does not acknowledge (a firewall?), which others notice \
                     as gaps; --best-effort asks for no acknowledgements",
                    topic.name
                );
            }
            topic.waiting.clear();
            let (name, kind) = (topic.name.clone(), topic.kind.clone());
            let writer = self.writer(&name, &kind)?;
            if let Some(topic) = self.topics.get_mut(place) {
                topic.writer = writer;
            }
            self.say_who_it_is()?;
        }
        Ok(())
    }

    /// A writer of the topic `name` of messages of `kind`.
    fn writer(&self, name: &str, kind: &str) -> Result<DataWriter<Bytes, CdrAdapter>, NodeError> {
        let (topic, kind) = (dds_topic(name), dds_type(kind));
        let made = writer(
            &self.participant,
            &self.publisher,
            &topic,
            &kind,
            &self.qos(),
        );
        made.map_err(|error| NodeError::Create {
            what: format!("the topic {name}"),
            domain: self.options.domain,
            error,
        })
    }

    /// Publishes `rmw_dds_common/ParticipantEntitiesInfo` with this node.
    fn say_who_it_is(&self) -> Result<(), NodeError> {
        let identifier = |message: &mut CdrMessage, guid: GUID| {
            let bytes = guid.to_bytes().into_iter().chain(std::iter::repeat(0));
            (bytes.take(self.options.identifier)).for_each(|byte| message.u8(byte));
        };
        let mut message = CdrMessage::new();
        identifier(&mut message, self.participant.guid());
        message.count(1);
        message.text(match self.options.namespace.as_str() {
            "" => "/",
            namespace => namespace,
        });
        message.text(NAME);
        message.count(0);
        message.count(self.topics.len());
        for topic in &self.topics {
            identifier(&mut message, topic.writer.guid());
        }
        let written = self.graph.write(body(&message), None);
        written.map_err(|error| NodeError::Write {
            topic: "ros_discovery_info".to_owned(),
            why: error.to_string(),
        })
    }
}

fn writer(
    participant: &DomainParticipant,
    publisher: &Publisher,
    topic: &str,
    kind: &str,
    qos: &QosPolicies,
) -> Result<DataWriter<Bytes, CdrAdapter>, CreateError> {
    let kind = kind.to_owned();
    let topic = participant.create_topic(topic.to_owned(), kind, qos, TopicKind::NoKey)?;
    publisher.create_datawriter_no_key(&topic, None)
}

impl MessageSink for RosNode {
    type Channel = usize;
    type Error = NodeError;

    fn add(
        &mut self,
        topic: &str,
        definition: &Definition,
        _series: Option<usize>,
    ) -> Result<Option<usize>, NodeError> {
        let kind = definition.name.as_str();
        if !PACKAGES.iter().any(|package| kind.starts_with(package)) {
            return Ok(None);
        }
        let name = self.names.of(topic);
        let writer = self.writer(&name, kind)?;
        self.topics.push(NodeTopic {
            name,
            kind: kind.to_owned(),
            writer,
            pace: self.options.rate.map(RateLimit::new),
            waiting: VecDeque::new(),
            since: Nanos::ZERO,
            is_told: false,
        });
        self.say_who_it_is()?;
        Ok(Some(self.topics.len() - 1))
    }

    fn send(&mut self, channel: &usize, wall: u64, message: &CdrMessage) -> Result<(), NodeError> {
        let Some(topic) = self.topics.get_mut(*channel) else {
            return Ok(());
        };
        if !topic.pace.as_mut().is_none_or(|pace| pace.passes(wall)) {
            return Ok(());
        }
        if topic.waiting.is_empty() {
            topic.since = self.now;
        } else if topic.waiting.len() == QUEUE {
            topic.waiting.pop_front();
        }
        topic.waiting.push_back((body(message), timestamp(wall)));
        topic.write()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fractions_of_a_second_are_binary() {
        assert_eq!(timestamp(3_500_000_000).to_ticks(), (3 << 32) | (1 << 31));
    }

    /// How many of the messages of `seconds` pass, which come every `period` ns.
    fn passed(rate: f64, period: u64, seconds: u64) -> u64 {
        let mut pace = RateLimit::new(rate);
        let instants = (0..seconds * 1_000_000_000 / period).map(|i| 1 << 60 | (i * period));
        instants.filter(|wall| pace.passes(*wall)).count() as u64
    }

    #[test]
    fn a_rate_is_kept_evenly() {
        assert_eq!(passed(100.0, 1_000_000, 10), 1_000);
        // Neither divides the other.
        let passed_300 = passed(300.0, 1_000_000, 10);
        assert!((2_990..=3_010).contains(&passed_300), "{passed_300}");
        assert_eq!(passed(1_000.0, 10_000_000, 10), 1_000);
        assert_eq!(passed(0.5, 1_000_000_000, 10), 5);
    }

    #[test]
    fn a_clock_that_is_set_back_stops_nothing() {
        let mut pace = RateLimit::new(10.0);
        let hour = 3_600_000_000_000;
        assert!(pace.passes(5 * hour));
        assert!(pace.passes(4 * hour));
        assert!(!pace.passes(4 * hour + 50_000_000));
        assert!(pace.passes(4 * hour + 100_000_000));
        assert!(pace.passes(6 * hour));
    }
}
