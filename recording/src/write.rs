//! Writes a recording.

use crate::cdr::Message;
use crate::definitions::{self, Definition, MESSAGE, SCHEMA};
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions, Writer};
use proprio_topics::csv::{Series, Value, What};
use proprio_topics::{
    ContactEstimate, ContactState, Description, Imu, JointState, JointTorque, Kind, Nanos, Quality,
    Reading, Role, TorqueEstimate, Wrench,
};
use std::collections::BTreeMap;
use std::io::{Seek, Write};

/// Why a recording cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("the recording cannot be written")]
pub struct WriteError(#[from] McapError);

/// A channel of the file.
type Channel = u16;

/// A series of the table: its own channel, and the one for viewers.
#[derive(Debug)]
struct Known {
    own: Channel,
    /// Of readings of other kinds than the main one, as temperatures.
    others: BTreeMap<&'static str, Channel>,
    viewers: Option<Channel>,
}

/// Writes samples, declarations and estimates of one robot into one file.
pub struct Recorder<W: Write + Seek> {
    file: Writer<W>,
    /// The wall clock minus CLOCK_MONOTONIC.
    offset: Nanos,
    series: Vec<Series>,
    known: Vec<Known>,
    torques: Channel,
    joint_states: Channel,
    contacts: BTreeMap<String, Channel>,
    /// The newest state of each joint that has an encoder.
    joints: BTreeMap<String, JointState>,
    sequence: u32,
}

impl<W: Write + Seek> Recorder<W> {
    /// Begins a recording of `robot` by this version of `program`. `series` are the channels and
    /// contacts of which values will be pushed; `offset` is the wall clock minus CLOCK_MONOTONIC.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn new(
        output: W,
        robot: &str,
        program: &str,
        series: &[Series],
        offset: Nanos,
    ) -> Result<Self, WriteError> {
        let mut file = WriteOptions::new()
            .profile("ros2")
            .library(program)
            .compression(Some(Compression::Zstd))
            .chunk_size(Some(1 << 20))
            // A chunk is written when it is complete: a killed program leaves no half of one.
            .disable_seeking(true)
            .create(output)?;
        let metadata = [("robot", robot), ("program", program)]
            .map(|(key, value)| (key.to_owned(), value.to_owned()));
        file.write_metadata(&Metadata {
            name: "proprio".to_owned(),
            metadata: metadata.into(),
        })?;
        let mut known = Vec::with_capacity(series.len());
        for (number, one) in series.iter().enumerate() {
            // Their order is that of the table's columns.
            let order = BTreeMap::from([("series".to_owned(), number.to_string())]);
            let name = &one.name;
            let (topic, definition, viewers) = match one.what {
                What::Channel(kind) => (
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
                What::Contact => (format!("/declared/{name}"), definitions::declared(), None),
            };
            let own = channel(&mut file, &topic, &definition, &order)?;
            let viewers = viewers
                .map(|(topic, definition)| {
                    channel(&mut file, &topic, &definition, &BTreeMap::new())
                })
                .transpose()?;
            known.push(Known {
                own,
                others: BTreeMap::new(),
                viewers,
            });
        }
        let none = BTreeMap::new();
        let torques = channel(&mut file, "/torques", &definitions::torques(), &none)?;
        let joint_state = definitions::joint_state();
        let joint_states = channel(&mut file, "/joint_states", &joint_state, &none)?;
        Ok(Self {
            file,
            offset,
            series: series.to_vec(),
            known,
            torques,
            joint_states,
            contacts: BTreeMap::new(),
            joints: BTreeMap::new(),
            sequence: 0,
        })
    }

    /// A value of the series with this number, at `t`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn push(&mut self, t: Nanos, series: usize, value: &Value) -> Result<(), WriteError> {
        let Some(one) = self.series.get(series) else {
            return Ok(());
        };
        match (one.what, value) {
            (What::Channel(main), Value::Reading(reading, quality)) => {
                if let Reading::Joint(state) = reading {
                    self.joints.insert(one.name.clone(), *state);
                }
                self.reading(t, series, main, reading, *quality)
            }
            (What::Contact, Value::Contact(state)) => {
                let message = declared(t, state);
                match self.known.get(series).map(|known| known.own) {
                    Some(own) => self.write(own, t, &message),
                    None => Ok(()),
                }
            }
            _ => Ok(()),
        }
    }

    fn reading(
        &mut self,
        t: Nanos,
        series: usize,
        main: Kind,
        reading: &Reading,
        quality: Quality,
    ) -> Result<(), WriteError> {
        let Some((known, one)) = self.known.get_mut(series).zip(self.series.get(series)) else {
            return Ok(());
        };
        let kind = reading.kind();
        let own = match kind == main {
            true => known.own,
            false => match known.others.get(kind.word()) {
                Some(other) => *other,
                None => {
                    let topic = format!("/samples/{kind}/{}", one.name);
                    let order = BTreeMap::from([("series".to_owned(), series.to_string())]);
                    let other =
                        channel(&mut self.file, &topic, &definitions::sample(kind), &order)?;
                    known.others.insert(kind.word(), other);
                    other
                }
            },
        };
        let (viewers, frame) = (known.viewers, one.name.clone());
        self.write(own, t, &sample(t, reading, quality))?;
        let wall = self.wall(t);
        match (viewers, reading) {
            (Some(channel), Reading::Wrench(wrench)) => {
                self.write(channel, t, &wrench_stamped(wall, &frame, wrench))
            }
            (Some(channel), Reading::Imu(reading)) => {
                self.write(channel, t, &imu(wall, &frame, reading))
            }
            _ => Ok(()),
        }
    }

    /// The torques of an instant, of the estimator that sent `names`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn torques(
        &mut self,
        names: &Description,
        estimate: &TorqueEstimate,
    ) -> Result<(), WriteError> {
        let t = estimate.header.acquired;
        let name = |role, number| {
            names
                .find(role, number)
                .map_or("", |entry| entry.name.as_str())
        };
        let joints: Vec<(&str, &JointTorque)> = (estimate.joints().iter().zip(0..))
            .map(|(joint, number)| (name(Role::Joint, number), joint))
            .collect();
        let mut message = Message::new();
        message.i64(t.0);
        message.count(joints.len());
        joints.iter().for_each(|(name, _)| message.text(name));
        message.count(joints.len());
        (joints.iter()).for_each(|(_, joint)| message.f64s(&[joint.torque]));
        message.count(joints.len());
        (joints.iter()).for_each(|(_, joint)| message.f64s(&[joint.standard_deviation]));
        message.count(joints.len());
        (joints.iter()).for_each(|(_, joint)| message.bool(joint.valid == 1));
        message.count(joints.len());
        for (_, joint) in &joints {
            message.text(joint.reason.get().map_or("?", |reason| reason.word()));
        }
        message.count(joints.len());
        (joints.iter()).for_each(|(_, joint)| message.text(name(Role::Channel, joint.cause)));
        self.write(self.torques, t, &message)?;

        let mut message = stamped(self.wall(t), "");
        message.count(joints.len());
        joints.iter().for_each(|(name, _)| message.text(name));
        let states: Vec<JointState> = (joints.iter())
            .map(|(name, _)| {
                self.joints
                    .get(*name)
                    .copied()
                    .unwrap_or(JointState::ABSENT)
            })
            .collect();
        message.count(states.len());
        (states.iter()).for_each(|state| message.f64s(&[state.position]));
        message.count(states.len());
        (states.iter()).for_each(|state| message.f64s(&[state.velocity]));
        message.count(joints.len());
        for (_, joint) in &joints {
            message.f64s(&[if joint.valid == 1 {
                joint.torque
            } else {
                f64::NAN
            }]);
        }
        self.write(self.joint_states, t, &message)
    }

    /// The valid contact wrenches of an instant, of the estimator that sent `names`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn contacts(
        &mut self,
        names: &Description,
        estimate: &ContactEstimate,
    ) -> Result<(), WriteError> {
        let t = estimate.header.acquired;
        for (contact, number) in estimate.contacts().iter().zip(0..) {
            let Some(entry) = names
                .find(Role::Contact, number)
                .filter(|_| contact.valid == 1)
            else {
                continue;
            };
            let name = entry.name.as_str();
            let own = match self.contacts.get(name) {
                Some(own) => *own,
                None => {
                    let (topic, none) = (format!("/contact/{name}"), BTreeMap::new());
                    let definition = definitions::wrench_stamped();
                    let own = channel(&mut self.file, &topic, &definition, &none)?;
                    self.contacts.insert(name.to_owned(), own);
                    own
                }
            };
            let wrench = Wrench {
                force: contact.force,
                torque: contact.torque,
            };
            let message = wrench_stamped(self.wall(t), entry.frame.as_str(), &wrench);
            self.write(own, t, &message)?;
        }
        Ok(())
    }

    /// The wall clock's time of an instant [ns since 1970, UTC], for log times and ROS's stamps.
    fn wall(&self, t: Nanos) -> u64 {
        u64::try_from(t.saturating_add(self.offset).0).unwrap_or(0)
    }

    fn write(&mut self, channel: Channel, t: Nanos, message: &Message) -> Result<(), WriteError> {
        let time = self.wall(t);
        let header = MessageHeader {
            channel_id: channel,
            sequence: self.sequence,
            log_time: time,
            publish_time: time,
        };
        self.sequence = self.sequence.wrapping_add(1);
        Ok(self.file.write_to_known_channel(&header, message.bytes())?)
    }

    /// Ends the chunk: what was recorded so far outlives a crash of this program.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        Ok(self.file.flush()?)
    }

    /// Ends the recording with its index.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<W, WriteError> {
        self.file.finish()?;
        Ok(self.file.into_inner())
    }
}

fn channel<W: Write + Seek>(
    file: &mut Writer<W>,
    topic: &str,
    (name, text): &Definition,
    metadata: &BTreeMap<String, String>,
) -> Result<Channel, McapError> {
    let schema = file.add_schema(name, SCHEMA, text.as_bytes())?;
    file.add_channel(schema, topic, MESSAGE, metadata)
}

fn sample(t: Nanos, reading: &Reading, quality: Quality) -> Message {
    let mut message = Message::new();
    message.i64(t.0);
    message.u32(quality.0);
    let count = reading.kind().fields().len();
    message.f64s(reading.values().get(..count).unwrap_or_default());
    message
}

fn declared(t: Nanos, state: &ContactState) -> Message {
    let mut message = Message::new();
    message.i64(t.0);
    message.bool(state.active);
    message.f64s(&state.position);
    message.f64s(&[state.position_std]);
    message.f64s(&state.direction);
    message
}

/// A message that begins with a `std_msgs/Header`.
fn stamped(wall: u64, frame: &str) -> Message {
    let mut message = Message::new();
    let (seconds, nanoseconds) = (wall / 1_000_000_000, wall % 1_000_000_000);
    message.i32(i32::try_from(seconds).unwrap_or(i32::MAX));
    message.u32(u32::try_from(nanoseconds).unwrap_or_default());
    message.text(frame);
    message
}

fn wrench_stamped(wall: u64, frame: &str, wrench: &Wrench) -> Message {
    let mut message = stamped(wall, frame);
    message.f64s(&wrench.force);
    message.f64s(&wrench.torque);
    message
}

fn imu(wall: u64, frame: &str, imu: &Imu) -> Message {
    let mut message = stamped(wall, frame);
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
