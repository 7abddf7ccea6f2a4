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

/// The file with its clock.
struct File<W: Write + Seek> {
    mcap: Writer<W>,
    /// The wall clock minus CLOCK_MONOTONIC.
    offset: Nanos,
    sequence: u32,
}

impl<W: Write + Seek> File<W> {
    /// Adds a channel; of values of a table, with the number of their series.
    fn channel(
        &mut self,
        topic: &str,
        (name, text): &Definition,
        series: Option<usize>,
    ) -> Result<Channel, WriteError> {
        let schema = self.mcap.add_schema(name, SCHEMA, text.as_bytes())?;
        let metadata = series.map(|number| ("series".to_owned(), number.to_string()));
        let metadata = metadata.into_iter().collect();
        Ok(self.mcap.add_channel(schema, topic, MESSAGE, &metadata)?)
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
        Ok(self.mcap.write_to_known_channel(&header, message.bytes())?)
    }
}

/// A series of the table: its own channel, and the one for viewers.
#[derive(Debug)]
struct Known {
    series: Series,
    own: Channel,
    /// Of readings of other kinds than the main one, as temperatures.
    others: BTreeMap<&'static str, Channel>,
    viewers: Option<Channel>,
    /// The newest state of a joint.
    state: JointState,
}

/// Writes samples, declarations and estimates of one robot into one file.
pub struct Recorder<W: Write + Seek> {
    file: File<W>,
    known: Vec<Known>,
    torques: Channel,
    joint_states: Channel,
    contacts: BTreeMap<String, Channel>,
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
        let mcap = WriteOptions::new()
            .profile("ros2")
            .library(program)
            .compression(Some(Compression::Zstd))
            .chunk_size(Some(1 << 20))
            // A chunk is written when it is complete: a killed program leaves no half of one.
            .disable_seeking(true)
            .create(output)?;
        let mut file = File {
            mcap,
            offset,
            sequence: 0,
        };
        let metadata = [("robot", robot), ("program", program)]
            .map(|(key, value)| (key.to_owned(), value.to_owned()));
        file.mcap.write_metadata(&Metadata {
            name: "proprio".to_owned(),
            metadata: metadata.into(),
        })?;
        let mut known = Vec::with_capacity(series.len());
        for (number, one) in series.iter().enumerate() {
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
            // Their order is that of the table's columns.
            let own = file.channel(&topic, &definition, Some(number))?;
            let viewers = viewers
                .map(|(topic, definition)| file.channel(&topic, &definition, None))
                .transpose()?;
            known.push(Known {
                series: one.clone(),
                own,
                others: BTreeMap::new(),
                viewers,
                state: JointState::ABSENT,
            });
        }
        let torques = file.channel("/torques", &definitions::torques(), None)?;
        let joint_states = file.channel("/joint_states", &definitions::joint_state(), None)?;
        Ok(Self {
            file,
            known,
            torques,
            joint_states,
            contacts: BTreeMap::new(),
        })
    }

    /// A value of the series with this number, at `t`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn push(&mut self, t: Nanos, series: usize, value: &Value) -> Result<(), WriteError> {
        let (file, Some(known)) = (&mut self.file, self.known.get_mut(series)) else {
            return Ok(());
        };
        match (known.series.what, value) {
            (What::Channel(main), Value::Reading(reading, quality)) => {
                let kind = reading.kind();
                let name = known.series.name.as_str();
                let own = match known.others.get(kind.word()) {
                    _ if kind == main => known.own,
                    Some(other) => *other,
                    None => {
                        let topic = format!("/samples/{kind}/{name}");
                        let other =
                            file.channel(&topic, &definitions::sample(kind), Some(series))?;
                        known.others.insert(kind.word(), other);
                        other
                    }
                };
                file.write(own, t, &sample(t, reading, *quality))?;
                let wall = file.wall(t);
                match (reading, known.viewers) {
                    (Reading::Joint(state), _) => {
                        known.state = *state;
                        Ok(())
                    }
                    (Reading::Wrench(wrench), Some(channel)) => {
                        file.write(channel, t, &wrench_stamped(wall, name, wrench))
                    }
                    (Reading::Imu(reading), Some(channel)) => {
                        file.write(channel, t, &imu(wall, name, reading))
                    }
                    _ => Ok(()),
                }
            }
            (What::Contact, Value::Contact(state)) => file.write(known.own, t, &declared(t, state)),
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
        self.file.write(self.torques, t, &message)?;

        let mut message = stamped(self.file.wall(t), "");
        message.count(joints.len());
        joints.iter().for_each(|(name, _)| message.text(name));
        let of = |name: &str| {
            let is_joint = |known: &&Known| {
                known.series.what == What::Channel(Kind::Joint) && known.series.name == name
            };
            let known = self.known.iter().find(is_joint);
            known.map_or(JointState::ABSENT, |known| known.state)
        };
        let states: Vec<JointState> = joints.iter().map(|(name, _)| of(name)).collect();
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
        self.file.write(self.joint_states, t, &message)
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
                    let definition = definitions::wrench_stamped();
                    let topic = format!("/contact/{name}");
                    let own = self.file.channel(&topic, &definition, None)?;
                    self.contacts.insert(name.to_owned(), own);
                    own
                }
            };
            let wrench = Wrench {
                force: contact.force,
                torque: contact.torque,
            };
            let message = wrench_stamped(self.file.wall(t), entry.frame.as_str(), &wrench);
            self.file.write(own, t, &message)?;
        }
        Ok(())
    }

    /// Ends the chunk: what was recorded so far outlives a crash of this program.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        Ok(self.file.mcap.flush()?)
    }

    /// Ends the recording with its index.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<W, WriteError> {
        self.file.mcap.finish()?;
        Ok(self.file.mcap.into_inner())
    }
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
