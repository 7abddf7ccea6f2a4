//! Turns a recording back into a table of samples, frames, and files.

use crate::write::{About, PROPRIO};
use mcap::records::op;
use mcap::records::{Channel, Record};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, parse_record};
use proprio_bridge::cdr::CdrReader;
use proprio_drivers::{Format, Frame, Id};
use proprio_topics::csv::{Columns, Series, SeriesKind, TableWriter, Value};
use proprio_topics::{ContactState, Kind, Nanos, Quality, Reading, StampKind, VALUES};
use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::ops::ControlFlow;

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
    /// It has no raw frames.
    #[error(
        "it is an MCAP file without raw frames (topics /can/...): record them with `proprio \
         record --out FILE.mcap --frames BUS`"
    )]
    NoFrames,
    /// It has no estimates.
    #[error("it is an MCAP file without estimates (topic /torques): no estimator ran")]
    NoEstimates,
}

/// What was in a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RecordingSummary {
    /// Samples and declarations in the table; frames.
    pub values: u64,
    /// Samples and declarations of channels that came to be known after the first message: the
    /// table has no column for them.
    pub without_column: u64,
    /// Messages of these topics that could not be understood.
    pub damaged: u64,
    /// The end of the file is missing, because its recorder was killed or the file was cut, or
    /// cannot be read.
    pub is_cut: bool,
}

/// Whether a file begins as an MCAP file does.
pub fn is_mcap(beginning: &[u8]) -> bool {
    beginning.starts_with(mcap::MAGIC)
}

/// Walks through the records of a recording, and whatever of it can be read. Returns whether its
/// end is missing. `is_known` says whether enough was found that damage is no more than that;
/// `take` may end the walk.
pub(crate) fn walk<S>(
    mut recording: impl Read,
    state: &mut S,
    is_known: impl Fn(&S) -> bool,
    mut take: impl FnMut(&mut S, Record<'_>) -> Result<ControlFlow<()>, ReadError>,
) -> Result<bool, ReadError> {
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(1 << 30);
    let mut reader = LinearReader::new_with_options(options);
    let mut is_ended = false;
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let read = recording.read(reader.insert(wanted))?;
                is_ended = read == 0;
                reader.notify_read(read);
            }
            Ok(LinearReadEvent::Record { data, opcode }) => {
                if opcode == op::ATTACHMENT && !is_whole_attachment(data) {
                    return Err(McapError::UnexpectedEof.into());
                }
                let record = parse_record(opcode, data)?;
                if matches!(record, Record::DataEnd(_)) {
                    is_ended = false;
                }
                if take(state, record)?.is_break() {
                    return Ok(false);
                }
            }
            // A chunk that was not written to its end, or is damaged: where the next one begins is
            // not known.
            Err(_) if is_ended || is_known(state) => return Ok(true),
            Err(error) => return Err(error.into()),
        }
    }
    Ok(is_ended)
}

/// Whether a record has all that goes around an attachment's data, for [`parse_record`] takes that
/// for granted: two times, name and media type with their lengths, the data's length; then, behind
/// the data, a checksum.
fn is_whole_attachment(record: &[u8]) -> bool {
    let after_text = |from: usize| {
        let length = record.get(from..)?.first_chunk::<4>()?;
        from.checked_add(4 + u32::from_le_bytes(*length) as usize)
    };
    let around = after_text(16).and_then(after_text);
    around.is_some_and(|end| end.saturating_add(8 + 4) <= record.len())
}

/// The table that is being made.
struct SampleTable<W: Write> {
    /// Of each channel: the number of its series in the recording, its column once the columns are
    /// known, and its kind.
    channels: BTreeMap<u16, (usize, Option<usize>, SeriesKind)>,
    /// By their number in the recording.
    series: BTreeMap<usize, Series>,
    output: Option<W>,
    writer: Option<TableWriter<W>>,
    summary: RecordingSummary,
}

/// Writes the samples and declarations of a recording as a table, all columns.
///
/// # Errors
/// [`ReadError`]. A file that is cut is none: see [`RecordingSummary::is_cut`].
pub fn to_table<W: Write>(recording: impl Read, output: W) -> Result<RecordingSummary, ReadError> {
    let mut table = SampleTable {
        channels: BTreeMap::new(),
        series: BTreeMap::new(),
        output: Some(output),
        writer: None,
        summary: RecordingSummary::default(),
    };
    let is_known = |table: &SampleTable<W>| !table.series.is_empty();
    let is_cut = walk(recording, &mut table, is_known, |table, record| {
        match record {
            Record::Channel(channel) => table.know(&channel),
            Record::Message { header, data } => {
                if let Some((_, column, what)) = table.channels.get(&header.channel_id).copied() {
                    table.take(header.channel_id, column, what, &data)?;
                }
            }
            _ => {}
        }
        Ok(ControlFlow::Continue(()))
    })?;
    table.summary.is_cut = is_cut;
    table.finish()
}

impl<W: Write> SampleTable<W> {
    fn know(&mut self, channel: &Channel) {
        let number = channel.metadata.get("series");
        let number = number.and_then(|number| number.parse().ok());
        if let Some((number, series)) = number.zip(series_of(&channel.topic))
            && !self.channels.contains_key(&channel.id)
        {
            let column = self.column(number);
            self.channels
                .insert(channel.id, (number, column, series.kind));
            if self.writer.is_none() {
                // A channel's main reading comes first.
                self.series.entry(number).or_insert(series);
            }
        }
    }

    /// The column of a series, once the columns are known.
    fn column(&self, number: usize) -> Option<usize> {
        let is_known = self.writer.is_some();
        (self.series.keys().position(|known| *known == number)).filter(|_| is_known)
    }

    /// Begins the table: its columns are those of the series before the first message.
    fn begin(&mut self) -> Result<(), ReadError> {
        if let Some(output) = self.output.take() {
            let series: Vec<Series> = self.series.values().cloned().collect();
            self.writer = Some(TableWriter::new(output, &series, Columns::All)?);
            for (number, column, _) in self.channels.values_mut() {
                *column = self.series.keys().position(|known| known == number);
            }
        }
        Ok(())
    }

    fn take(
        &mut self,
        channel: u16,
        column: Option<usize>,
        what: SeriesKind,
        message: &[u8],
    ) -> Result<(), ReadError> {
        let Some((t, value)) = value(what, message) else {
            self.summary.damaged += 1;
            return Ok(());
        };
        self.begin()?;
        let column = column.or_else(|| self.channels.get(&channel)?.1);
        match (&mut self.writer, column) {
            (Some(writer), Some(column)) => {
                writer.push(Some(t), column, &value)?;
                self.summary.values += 1;
            }
            _ => self.summary.without_column += 1,
        }
        Ok(())
    }

    fn finish(mut self) -> Result<RecordingSummary, ReadError> {
        if self.series.is_empty() {
            return Err(ReadError::Foreign);
        }
        self.begin()?;
        if let Some(writer) = self.writer {
            writer.finish()?;
        }
        Ok(self.summary)
    }
}

/// Gives the raw frames of a recording, with their buses, to `take`. Their stamps are the wall
/// clock's.
///
/// # Errors
/// [`ReadError`]; [`ReadError::NoFrames`] if there are none; those of `take`.
pub fn frames(
    recording: impl Read,
    mut take: impl FnMut(&str, &Frame) -> io::Result<()>,
) -> Result<RecordingSummary, ReadError> {
    let mut state = (
        BTreeMap::<u16, (String, bool)>::new(),
        RecordingSummary::default(),
    );
    let is_known = |(channels, _): &(BTreeMap<u16, (String, bool)>, _)| !channels.is_empty();
    let is_cut = walk(
        recording,
        &mut state,
        is_known,
        |(channels, summary), record| {
            match record {
                Record::Channel(channel) => {
                    let classic = channel.topic.strip_prefix("/can/").map(|bus| (bus, false));
                    let fd = channel
                        .topic
                        .strip_prefix("/can_fd/")
                        .map(|bus| (bus, true));
                    if let Some((bus, is_fd)) = classic.or(fd) {
                        channels.insert(channel.id, (bus.to_owned(), is_fd));
                    }
                }
                Record::Message { header, data } => {
                    if let Some((bus, is_fd)) = channels.get(&header.channel_id) {
                        match frame(*is_fd, &data) {
                            Some(frame) => {
                                take(bus, &frame)?;
                                summary.values += 1;
                            }
                            None => summary.damaged += 1,
                        }
                    }
                }
                _ => {}
            }
            Ok(ControlFlow::Continue(()))
        },
    )?;
    let (channels, mut summary) = state;
    if channels.is_empty() {
        return Err(ReadError::NoFrames);
    }
    summary.is_cut = is_cut;
    Ok(summary)
}

/// What a recording says of itself, with the files that it took along.
///
/// # Errors
/// [`ReadError`]; [`ReadError::Foreign`] if it is none of this program.
pub fn about(recording: impl Read) -> Result<About, ReadError> {
    let mut found: Option<About> = None;
    let mut files = Vec::new();
    walk(recording, &mut found, Option::is_some, |found, record| {
        match record {
            Record::Metadata(metadata) if metadata.name == PROPRIO => {
                let get = |key: &str| metadata.metadata.get(key).cloned().unwrap_or_default();
                let offset = get("wall_clock_minus_monotonic_ns").parse();
                *found = Some(About {
                    robot: get("robot"),
                    program: get("program"),
                    offset: Nanos(offset.unwrap_or_default()),
                    files: Vec::new(),
                });
            }
            Record::Attachment { header, data, .. } => {
                files.push((header.name, data.into_owned()));
            }
            // They come first.
            Record::Message { .. } => return Ok(ControlFlow::Break(())),
            _ => {}
        }
        Ok(ControlFlow::Continue(()))
    })?;
    let found = found.ok_or(ReadError::Foreign)?;
    Ok(About { files, ..found })
}

/// The frame in a message of `can_msgs` or `ros2_socketcan_msgs`; `None` if it has none.
fn frame(is_fd: bool, message: &[u8]) -> Option<Frame> {
    let mut parsed = CdrReader::new(message)?;
    let t = parsed.time()?;
    let _frame_id = parsed.text()?;
    let id = parsed.u32()?;
    let is_remote = !is_fd && parsed.bool()?;
    let is_extended = parsed.bool()?;
    let is_error = parsed.bool()?;
    let length = parsed.u8()?;
    let length = usize::from(match is_fd {
        true => u8::try_from(parsed.u32()?).ok()?,
        false => length,
    });
    let id = match is_extended {
        true => Id::extended(id),
        false => Id::standard(u16::try_from(id).ok()?),
    };
    let frame = match (is_error, is_remote) {
        (true, _) => Frame::with_format(id, Format::Error, parsed.bytes(length)?)?,
        (_, true) => Frame::remote(id, u8::try_from(length).ok()?),
        _ => {
            let format = match is_fd {
                true => Format::Fd {
                    bit_rate_switch: false,
                    error_state: false,
                },
                false => Format::Classic,
            };
            Frame::with_format(id, format, parsed.bytes(length)?)?
        }
    };
    Some(frame.at(t, StampKind::Log))
}

/// The series that has this topic.
fn series_of(topic: &str) -> Option<Series> {
    let (kind, name) = if let Some(name) = topic.strip_prefix("/declared/") {
        (SeriesKind::Contact, name)
    } else {
        let (word, name) = topic.strip_prefix("/samples/")?.split_once('/')?;
        let kind = Kind::ALL.into_iter().find(|known| known.word() == word)?;
        (SeriesKind::Channel(kind), name)
    };
    Some(Series {
        kind,
        name: name.to_owned(),
    })
}

/// A message's stamp and value; `None` if it is none of its kind.
fn value(what: SeriesKind, message: &[u8]) -> Option<(Nanos, Value)> {
    let mut parsed = CdrReader::new(message)?;
    let t = Nanos(parsed.i64()?);
    let three = |parsed: &mut CdrReader<'_>| Some([parsed.f64()?, parsed.f64()?, parsed.f64()?]);
    let value = match what {
        SeriesKind::Channel(kind) => {
            let quality = Quality(parsed.u32()?);
            let mut values = [0.0; VALUES];
            for value in values.iter_mut().take(kind.fields().len()) {
                *value = parsed.f64()?;
            }
            Value::Reading(Reading::from_values(kind, &values)?, quality)
        }
        SeriesKind::Contact => Value::Contact(ContactState {
            active: parsed.bool()?,
            position: three(&mut parsed)?,
            position_std: parsed.f64()?,
            direction: three(&mut parsed)?,
        }),
    };
    t.is_instant().then_some((t, value))
}
