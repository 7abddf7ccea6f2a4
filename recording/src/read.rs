//! Turns a recording back into a table of samples.

use crate::cdr::Parsed;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, parse_record};
use proprio_topics::csv::{Columns, Series, Value, What, Writer};
use proprio_topics::{ContactState, Kind, Nanos, Quality, Reading, VALUES};
use std::collections::BTreeMap;
use std::io::{self, Read, Write};

/// Why a recording cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// It cannot be read at all.
    #[error("it cannot be read as MCAP")]
    Mcap(#[from] McapError),
    /// The file itself cannot be read, or the table not be written.
    #[error("it cannot be read, or the table cannot be written")]
    Io(#[from] io::Error),
    /// It has no samples of Proprio.
    #[error(
        "it is an MCAP file without samples of Proprio (topics /samples/...): record one with \
         `proprio record --out FILE.mcap`"
    )]
    Foreign,
}

/// What was in a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Summary {
    /// Samples and declarations in the table.
    pub values: u64,
    /// Messages of the table's topics that could not be understood.
    pub damaged: u64,
    /// The end of the file is missing, because its recorder was killed or the file was cut, or
    /// cannot be read.
    pub is_cut: bool,
}

/// Whether a file begins as an MCAP file does.
pub fn is_mcap(beginning: &[u8]) -> bool {
    beginning.starts_with(mcap::MAGIC)
}

/// The table that is being made.
struct Table<W: Write> {
    /// Of each channel: its place among the series, and its kind.
    channels: BTreeMap<u16, (usize, What)>,
    /// By their number in the recording.
    series: BTreeMap<usize, Series>,
    output: Option<W>,
    writer: Option<Writer<W>>,
    summary: Summary,
}

/// Writes the samples and declarations of a recording as a table, all columns.
///
/// # Errors
/// [`ReadError`]. A file that is cut is none: see [`Summary::is_cut`].
pub fn to_table<W: Write>(mut recording: impl Read, output: W) -> Result<Summary, ReadError> {
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(1 << 30);
    let mut reader = LinearReader::new_with_options(options);
    let mut table = Table {
        channels: BTreeMap::new(),
        series: BTreeMap::new(),
        output: Some(output),
        writer: None,
        summary: Summary::default(),
    };
    let mut is_ended = false;
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let read = recording.read(reader.insert(wanted))?;
                is_ended = read == 0;
                reader.notify_read(read);
            }
            Ok(LinearReadEvent::Record { data, opcode }) => match parse_record(opcode, data)? {
                Record::Channel(channel) => {
                    let number = channel.metadata.get("series");
                    let number = number.and_then(|number| number.parse().ok());
                    if let Some((number, series)) = number.zip(series_of(&channel.topic)) {
                        table.channels.insert(channel.id, (number, series.what));
                        // A channel's main reading comes first.
                        table.series.entry(number).or_insert(series);
                    }
                }
                Record::Message { header, data } => {
                    if let Some((series, what)) = table.channels.get(&header.channel_id).copied() {
                        table.take(series, what, &data)?;
                    }
                }
                Record::DataEnd(_) => is_ended = false,
                _ => {}
            },
            // A chunk that was not written to its end, or is damaged: where the next one begins is
            // not known.
            Err(_) if is_ended || !table.series.is_empty() => {
                table.summary.is_cut = true;
                break;
            }
            Err(error) => return Err(error.into()),
        }
    }
    table.summary.is_cut |= is_ended;
    table.finish()
}

impl<W: Write> Table<W> {
    /// All series are known before the first message.
    fn writer(&mut self) -> Result<Option<&mut Writer<W>>, ReadError> {
        if let Some(output) = self.output.take() {
            let series: Vec<Series> = self.series.values().cloned().collect();
            self.writer = Some(Writer::new(output, &series, Columns::All)?);
        }
        Ok(self.writer.as_mut())
    }

    fn take(&mut self, number: usize, what: What, message: &[u8]) -> Result<(), ReadError> {
        let Some((t, value)) = value(what, message) else {
            self.summary.damaged += 1;
            return Ok(());
        };
        let place = self.series.keys().position(|known| *known == number);
        if let Some((writer, place)) = self.writer()?.zip(place) {
            writer.push(Some(t), place, &value)?;
            self.summary.values += 1;
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Summary, ReadError> {
        if self.series.is_empty() {
            return Err(ReadError::Foreign);
        }
        self.writer()?;
        if let Some(writer) = self.writer {
            writer.finish()?;
        }
        Ok(self.summary)
    }
}

/// The series that has this topic.
fn series_of(topic: &str) -> Option<Series> {
    let (what, name) = if let Some(name) = topic.strip_prefix("/declared/") {
        (What::Contact, name)
    } else {
        let (kind, name) = topic.strip_prefix("/samples/")?.split_once('/')?;
        let kind = Kind::ALL.into_iter().find(|known| known.word() == kind)?;
        (What::Channel(kind), name)
    };
    Some(Series {
        what,
        name: name.to_owned(),
    })
}

/// A message's stamp and value; `None` if it is none of its kind.
fn value(what: What, message: &[u8]) -> Option<(Nanos, Value)> {
    let mut parsed = Parsed::new(message)?;
    let t = Nanos(parsed.i64()?);
    let three = |parsed: &mut Parsed<'_>| Some([parsed.f64()?, parsed.f64()?, parsed.f64()?]);
    let value = match what {
        What::Channel(kind) => {
            let quality = Quality(parsed.u32()?);
            let mut values = [0.0; VALUES];
            for value in values.iter_mut().take(kind.fields().len()) {
                *value = parsed.f64()?;
            }
            Value::Reading(Reading::from_values(kind, &values)?, quality)
        }
        What::Contact => Value::Contact(ContactState {
            active: parsed.bool()?,
            position: three(&mut parsed)?,
            position_std: parsed.f64()?,
            direction: three(&mut parsed)?,
        }),
    };
    t.is_instant().then_some((t, value))
}
