//! The estimates of a recording as a table: the columns of `proprio estimate`'s that tell torques
//! and contacts.

use crate::read::{ReadError, RecordingSummary, walk};
use mcap::records::Record;
use proprio_bridge::cdr::CdrReader;
use proprio_topics::Nanos;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Read, Write};
use std::ops::ControlFlow;

/// What is estimated at one instant: column and cell.
type Row = Vec<(String, String)>;
/// Reads a message: its instant, and what it tells.
type ReadMessage = fn(&[u8]) -> Option<(i64, Row)>;

/// So many instants are looked at for columns, if not all are found before.
const LOOK: usize = 1000;

/// The table that is being made.
struct EstimateTable<W: Write> {
    channels: BTreeMap<u16, ReadMessage>,
    output: csv::Writer<W>,
    /// The place of each column; none before the first row is written.
    columns: BTreeMap<String, usize>,
    /// The first instants, until torques and contacts have come, and the newest.
    rows: Vec<(i64, Row)>,
    /// How many of the topics have had a message.
    seen: BTreeSet<u16>,
    summary: RecordingSummary,
}

/// Writes the torques and contacts of a recording as a table: a row per instant, an empty cell
/// where something is withheld. Its columns are those of the first instants.
///
/// # Errors
/// [`ReadError`]; [`ReadError::NoEstimates`] if it has none.
pub fn to_estimates<W: Write>(
    recording: impl Read,
    output: W,
) -> Result<RecordingSummary, ReadError> {
    let mut table = EstimateTable {
        channels: BTreeMap::new(),
        output: csv::Writer::from_writer(output),
        columns: BTreeMap::new(),
        rows: Vec::new(),
        seen: BTreeSet::new(),
        summary: RecordingSummary::default(),
    };
    let is_known = |table: &EstimateTable<W>| !table.channels.is_empty();
    table.summary.is_cut = walk(recording, &mut table, is_known, |table, record| {
        match record {
            Record::Channel(channel) => {
                let read: ReadMessage = match channel.topic.as_str() {
                    "/torques" => torques,
                    "/contacts" => contacts,
                    _ => return Ok(ControlFlow::Continue(())),
                };
                table.channels.insert(channel.id, read);
            }
            Record::Message { header, data } => {
                if let Some(read) = table.channels.get(&header.channel_id) {
                    match read(&data) {
                        Some((t, cells)) => {
                            table.seen.insert(header.channel_id);
                            table.take(t, cells)?;
                        }
                        None => table.summary.damaged += 1,
                    }
                }
            }
            _ => {}
        }
        Ok(ControlFlow::Continue(()))
    })?;
    table.write_rows(0)?;
    if table.summary.values == 0 {
        return Err(ReadError::NoEstimates);
    }
    table.output.flush()?;
    Ok(table.summary)
}

impl<W: Write> EstimateTable<W> {
    /// Cells of the instant `t`.
    fn take(&mut self, t: i64, cells: Row) -> Result<(), ReadError> {
        match self.rows.last_mut() {
            Some((of, row)) if *of == t => row.extend(cells),
            _ => self.rows.push((t, cells)),
        }
        let is_known = !self.columns.is_empty() || self.seen.len() == 2;
        match is_known || self.rows.len() > LOOK {
            // The newest instant may not be complete.
            true => self.write_rows(1),
            false => Ok(()),
        }
    }

    /// Writes all rows but the newest `keep`.
    fn write_rows(&mut self, keep: usize) -> Result<(), ReadError> {
        let kept = self.rows.split_off(self.rows.len().saturating_sub(keep));
        let rows = std::mem::replace(&mut self.rows, kept);
        if self.columns.is_empty() && !rows.is_empty() {
            let mut header = vec!["t"];
            for (column, _) in rows.iter().chain(&self.rows).flat_map(|(_, row)| row) {
                if !self.columns.contains_key(column) {
                    self.columns.insert(column.clone(), header.len());
                    header.push(column);
                }
            }
            self.output.write_record(header).map_err(io::Error::other)?;
        }
        for (t, row) in rows {
            let mut cells = vec![String::new(); self.columns.len() + 1];
            for (column, cell) in row {
                match self
                    .columns
                    .get(&column)
                    .and_then(|place| cells.get_mut(*place))
                {
                    Some(place) => *place = cell,
                    None => self.summary.without_column += 1,
                }
            }
            if let Some(first) = cells.first_mut() {
                *first = Nanos(t).to_string();
            }
            self.summary.values += 1;
            self.output.write_record(cells).map_err(io::Error::other)?;
        }
        Ok(())
    }
}

/// A cell: the shortest text that reads back as the same number; empty for NaN.
fn number(value: f64) -> String {
    match value.is_nan() {
        true => String::new(),
        false => zmij::Buffer::new().format(value).to_owned(),
    }
}

/// A cell: a reason, and the channel at fault after a colon.
fn why(reason: &str, cause: &str) -> String {
    match cause.is_empty() {
        true => reason.to_owned(),
        false => format!("{reason}:{cause}"),
    }
}

/// The instant and the cells of a message of torques.
fn torques(message: &[u8]) -> Option<(i64, Row)> {
    let mut parsed = CdrReader::new(message)?;
    let t = parsed.i64()?;
    let names = parsed.list(CdrReader::text)?;
    let torques = parsed.list(CdrReader::f64)?;
    let deviations = parsed.list(CdrReader::f64)?;
    let valid = parsed.list(CdrReader::bool)?;
    let reasons = parsed.list(CdrReader::text)?;
    let causes = parsed.list(CdrReader::text)?;
    let mut row = Row::new();
    let mut add = |what: &str, cells: Vec<String>| {
        let columns = names.iter().map(|name| format!("{what}/{name}"));
        row.extend(columns.zip(cells));
    };
    add("torque", torques.into_iter().map(number).collect());
    add("torque_std", deviations.into_iter().map(number).collect());
    add(
        "valid",
        valid
            .into_iter()
            .map(|it| u8::from(it).to_string())
            .collect(),
    );
    let reasons = reasons.into_iter().zip(causes);
    add(
        "reason",
        reasons.map(|(reason, cause)| why(reason, cause)).collect(),
    );
    Some((t, row))
}

/// The instant and the cells of a message of contacts.
fn contacts(message: &[u8]) -> Option<(i64, Row)> {
    let mut parsed = CdrReader::new(message)?;
    let t = parsed.i64()?;
    let mut row = Row::new();
    for _ in 0..parsed.u32()? {
        let name = parsed.text()?;
        let _frame = parsed.text()?;
        let mut add = |what: &str, cell| row.push((format!("contact/{name}/{what}"), cell));
        let axes = ["fx", "fy", "fz", "tx", "ty", "tz"];
        for axis in axes {
            add(axis, number(parsed.f64()?));
        }
        for axis in axes {
            add(&format!("{axis}_std"), number(parsed.f64()?));
        }
        let flag = |parsed: &mut CdrReader<'_>| Some(u8::from(parsed.bool()?).to_string());
        add("valid", flag(&mut parsed)?);
        let (reason, cause) = (parsed.text()?, parsed.text()?);
        add("reason", why(reason, cause));
        add("detected", flag(&mut parsed)?);
        let located = flag(&mut parsed)?;
        for axis in ["px", "py", "pz"] {
            add(axis, number(parsed.f64()?));
        }
        add("located", located);
    }
    Some((t, row))
}
