//! The last seconds of a recording, in memory: a black box.
//!
//! The memory holds compressed parts, each a whole recording of an eighth of the time. A snapshot
//! copies their messages into one file.

use crate::write::{About, Recorder, WriteError};
use mcap::MessageStream;
use proprio_topics::Nanos;
use proprio_topics::csv::Series;
use std::collections::VecDeque;
use std::io::{Cursor, Seek, Write};
use std::sync::Arc;

/// So many parts make up the time.
const PARTS: i64 = 8;

/// The last seconds.
pub struct Ring {
    about: About,
    /// They are needed in a snapshot alone.
    files: Vec<(String, Vec<u8>)>,
    duration: Nanos,
    /// Each with its end.
    parts: VecDeque<(Nanos, Arc<[u8]>)>,
    newest: Recorder<Cursor<Vec<u8>>>,
    /// When the newest part began, and the newest instant in it.
    began: Option<Nanos>,
    last: Nanos,
}

impl Ring {
    /// Holds at least the last `duration`. `series` as in [`Recorder::new`].
    ///
    /// # Errors
    /// A part cannot be begun.
    pub fn new(mut about: About, series: &[Series], duration: Nanos) -> Result<Self, WriteError> {
        let files = std::mem::take(&mut about.files);
        let newest = Recorder::new(Cursor::new(Vec::new()), &about, series)?;
        Ok(Self {
            about,
            files,
            duration,
            parts: VecDeque::new(),
            newest,
            began: None,
            last: Nanos::MIN,
        })
    }

    /// The wall clock minus CLOCK_MONOTONIC, from the next part on.
    pub const fn set_offset(&mut self, offset: Nanos) {
        self.about.offset = offset;
    }

    /// The recorder of the present part, for something of the instant `t`.
    ///
    /// # Errors
    /// A part cannot be ended or begun.
    pub fn at(&mut self, t: Nanos) -> Result<&mut Recorder<Cursor<Vec<u8>>>, WriteError> {
        let began = *self.began.get_or_insert(t);
        if t.saturating_sub(began).0 >= self.duration.0 / PARTS {
            self.turn()?;
            self.began = Some(t);
        }
        self.last = self.last.max(t);
        Ok(&mut self.newest)
    }

    /// Ends the newest part, and forgets those that are too old.
    fn turn(&mut self) -> Result<(), WriteError> {
        let ended = self.newest.turn_to(Cursor::new(Vec::new()), &self.about)?;
        let ended = ended.into_inner();
        self.parts.push_back((self.last, ended.into()));
        self.began = None;
        let from = self.last.saturating_sub(self.duration);
        while self.parts.front().is_some_and(|(end, _)| *end < from) {
            self.parts.pop_front();
        }
        Ok(())
    }

    /// The memory that the parts take \[bytes\], without the newest.
    #[must_use]
    pub fn memory(&self) -> usize {
        self.parts.iter().map(|(_, part)| part.len()).sum()
    }

    /// What is held. `series` are all that are known.
    ///
    /// # Errors
    /// A part cannot be ended or begun.
    pub fn snapshot(&mut self, series: &[Series]) -> Result<RingSnapshot, WriteError> {
        self.turn()?;
        let files = self.files.clone();
        Ok(RingSnapshot {
            about: About {
                files,
                ..self.about.clone()
            },
            series: series.to_vec(),
            parts: self
                .parts
                .iter()
                .map(|(_, part)| Arc::clone(part))
                .collect(),
        })
    }
}

/// What a ring held at an instant. To write it takes a while: another thread can do that.
pub struct RingSnapshot {
    about: About,
    series: Vec<Series>,
    parts: Vec<Arc<[u8]>>,
}

impl RingSnapshot {
    /// Writes it as one recording, with its files.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write<W: Write + Seek>(&self, output: W) -> Result<W, WriteError> {
        // All channels come first: a table's columns are known before its first row.
        let mut recorder = Recorder::new(output, &self.about, &self.series)?;
        for part in &self.parts {
            for message in MessageStream::new(part).map_err(WriteError::from)? {
                recorder.copy(&message.map_err(WriteError::from)?)?;
            }
        }
        recorder.finish()
    }
}
