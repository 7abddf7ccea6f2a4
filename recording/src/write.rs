//! Writes a recording.

use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};
use proprio_bridge::cdr::CdrMessage;
use proprio_bridge::definitions::{self, Definition, MESSAGE, SCHEMA};
use proprio_bridge::{MessageSink, Messages};
use proprio_drivers::{Format, Frame, Id};
use proprio_topics::Nanos;
use proprio_topics::csv::Series;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::ops::{Deref, DerefMut};

/// The name of this program's metadata.
pub(crate) const PROPRIO: &str = "proprio";

/// Why a recording cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("the recording cannot be written")]
pub struct WriteError(#[from] McapError);

/// What a recording says of itself.
#[derive(Debug, Clone, Default)]
pub struct About {
    /// The robot.
    pub robot: String,
    /// The program that records, with its version.
    pub program: String,
    /// The wall clock minus CLOCK_MONOTONIC.
    pub offset: Nanos,
    /// Files to take along, such as the configuration: their names and contents.
    pub files: Vec<(String, Vec<u8>)>,
}

/// The file.
pub struct McapFile<W: Write + Seek> {
    mcap: Writer<W>,
    sequence: u32,
    /// Of topics that were copied: their channel here.
    copied: BTreeMap<String, u16>,
}

impl<W: Write + Seek> McapFile<W> {
    fn begin(output: W, about: &About) -> Result<Self, WriteError> {
        let mut mcap = WriteOptions::new()
            .profile("ros2")
            .library(about.program.clone())
            .compression(Some(Compression::Zstd))
            // In this thread: others are the daemons'.
            .compression_threads(0)
            .chunk_size(Some(1 << 20))
            // A chunk is written when it is complete: a killed program leaves no half of one.
            .disable_seeking(true)
            .create(output)?;
        let offset = about.offset.0.to_string();
        let metadata = [
            ("robot", about.robot.as_str()),
            ("program", about.program.as_str()),
            ("wall_clock_minus_monotonic_ns", offset.as_str()),
        ]
        .map(|(key, value)| (key.to_owned(), value.to_owned()));
        mcap.write_metadata(&Metadata {
            name: PROPRIO.to_owned(),
            metadata: metadata.into(),
        })?;
        for (name, data) in &about.files {
            mcap.attach(&Attachment {
                log_time: 0,
                create_time: 0,
                name: name.clone(),
                media_type: "application/octet-stream".to_owned(),
                data: Cow::Borrowed(data),
            })?;
        }
        Ok(Self {
            mcap,
            sequence: 0,
            copied: BTreeMap::new(),
        })
    }
}

impl<W: Write + Seek> MessageSink for McapFile<W> {
    type Channel = u16;
    type Error = WriteError;

    fn add(
        &mut self,
        topic: &str,
        definition: &Definition,
        series: Option<usize>,
    ) -> Result<Option<u16>, WriteError> {
        let text = definition.text.as_bytes();
        let schema = self.mcap.add_schema(&definition.name, SCHEMA, text)?;
        let metadata = series.map(|number| ("series".to_owned(), number.to_string()));
        let metadata = metadata.into_iter().collect();
        let channel = self.mcap.add_channel(schema, topic, MESSAGE, &metadata)?;
        Ok(Some(channel))
    }

    fn send(&mut self, channel: &u16, wall: u64, message: &CdrMessage) -> Result<(), WriteError> {
        let header = MessageHeader {
            channel_id: *channel,
            sequence: self.sequence,
            log_time: wall,
            publish_time: wall,
        };
        self.sequence = self.sequence.wrapping_add(1);
        Ok(self.mcap.write_to_known_channel(&header, message.bytes())?)
    }
}

/// Writes what one robot sends into one file.
pub struct Recorder<W: Write + Seek> {
    messages: Messages<McapFile<W>>,
}

impl<W: Write + Seek> Recorder<W> {
    /// Begins a recording. `series` are the channels and contacts that a table made of it will
    /// have; those that come to be known later are in the recording alone.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn new(output: W, about: &About, series: &[Series]) -> Result<Self, WriteError> {
        let file = McapFile::begin(output, about)?;
        let mut messages = Messages::new(file, &about.robot, about.offset);
        messages.know(series)?;
        messages.announce()?;
        Ok(Self { messages })
    }

    /// Goes on in a new file, which knows what this one does; ends this one, and returns it.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn turn_to(&mut self, output: W, about: &About) -> Result<W, WriteError> {
        let file = McapFile::begin(output, about)?;
        let mut ended = self.messages.turn_to(file, about.offset)?;
        ended.mcap.finish()?;
        Ok(ended.mcap.into_inner())
    }

    /// A frame on `bus`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn frame(&mut self, bus: &str, frame: &Frame) -> Result<(), WriteError> {
        let is_fd = matches!(frame.format, Format::Fd { .. });
        let (topic, definition): (_, fn() -> Definition) = match is_fd {
            true => (format!("/can_fd/{bus}"), definitions::fd_frame),
            false => (format!("/can/{bus}"), definitions::classic_frame),
        };
        self.messages.send(&topic, definition, frame.t, |wall| {
            let mut message = CdrMessage::stamped(wall, bus);
            message.u32(frame.id.raw());
            if !is_fd {
                message.bool(frame.format == Format::Remote);
            }
            message.bool(matches!(frame.id, Id::Extended(_)));
            message.bool(frame.format == Format::Error);
            let data = frame.data();
            message.u8(u8::try_from(frame.len()).unwrap_or_default());
            if is_fd {
                message.count(data.len());
            }
            let rest = if is_fd { 0 } else { 8 - data.len().min(8) };
            data.iter().for_each(|byte| message.u8(*byte));
            (0..rest).for_each(|_| message.u8(0));
            message
        })
    }

    /// A message of another recording of this program.
    pub(crate) fn copy(&mut self, message: &mcap::Message<'_>) -> Result<(), WriteError> {
        let file = self.messages.sink();
        let topic = &message.channel.topic;
        let channel = match (file.copied.get(topic), &message.channel.schema) {
            (Some(known), _) => *known,
            (None, Some(schema)) => {
                // The same as an existing one, if there is one.
                let schema = file.mcap.add_schema(&schema.name, SCHEMA, &schema.data)?;
                let metadata = &message.channel.metadata;
                let channel = file.mcap.add_channel(schema, topic, MESSAGE, metadata)?;
                file.copied.insert(topic.clone(), channel);
                channel
            }
            (None, None) => return Ok(()),
        };
        let header = MessageHeader {
            channel_id: channel,
            sequence: message.sequence,
            log_time: message.log_time,
            publish_time: message.publish_time,
        };
        Ok(file.mcap.write_to_known_channel(&header, &message.data)?)
    }

    /// Ends the chunk: what was recorded so far outlives a crash of this program.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        Ok(self.messages.sink().mcap.flush()?)
    }

    /// Ends the recording with its index.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(self) -> Result<W, WriteError> {
        let mut file = self.messages.into_sink();
        file.mcap.finish()?;
        Ok(file.mcap.into_inner())
    }
}

impl<W: Write + Seek> Deref for Recorder<W> {
    type Target = Messages<McapFile<W>>;

    fn deref(&self) -> &Self::Target {
        &self.messages
    }
}

impl<W: Write + Seek> DerefMut for Recorder<W> {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut self.messages
    }
}
