//! The estimates of a recording as a table: the columns of `proprio estimate`'s that tell torques
//! and contacts.

use crate::read::{ReadError, Summary, walk};
use mcap::records::Record;
use proprio_bridge::cdr::Parsed;
use std::collections::BTreeMap;
use std::io::{Read, Write};

/// What is estimated at one instant: column and cell.
type Row = Vec<(String, String)>;
/// Reads a message: its instant, and what it tells.
type ReadMessage = fn(&[u8]) -> Option<(i64, Row)>;

/// The table that is being made.
struct Table<W: Write> {
    channels: BTreeMap<u16, ReadMessage>,
    output: csv::Writer<W>,
    columns: Vec<String>,
    /// The instant whose torques have come.
    row: Option<(i64, Row)>,
    summary: Summary,
}

/// Writes the torques and contacts of a recording as a table: a row per instant, an empty cell
/// where something is withheld. Its columns are those of the first instant.
///
/// # Errors
/// [`ReadError`]; [`ReadError::NoEstimates`] if it has none.
pub fn to_estimates<W: Write>(recording: impl Read, output: W) -> Result<Summary, ReadError> {
    let mut table = Table {
        channels: BTreeMap::new(),
        output: csv::Writer::from_writer(output),
        columns: Vec::new(),
        row: None,
        summary: Summary::default(),
    };
    let is_known = |table: &Table<W>| !table.channels.is_empty();
    table.summary.is_cut = walk(recording, &mut table, is_known, |table, record| {
        match record {
            Record::Channel(channel) => {
                let read: ReadMessage = match channel.topic.as_str() {
                    "/torques" => torques,
                    "/contacts" => contacts,
                    _ => return Ok(()),
                };
                table.channels.insert(channel.id, read);
            }
            Record::Message { header, data } => {
                if let Some(read) = table.channels.get(&header.channel_id) {
                    match read(&data) {
                        Some((t, cells)) => table.take(t, cells)?,
                        None => table.summary.damaged += 1,
                    }
                }
            }
            _ => {}
        }
        Ok(())
    })?;
    table.end_row()?;
    if table.summary.values == 0 {
        return Err(ReadError::NoEstimates);
    }
    table.output.flush()?;
    Ok(table.summary)
}

impl<W: Write> Table<W> {
    /// Cells of the instant `t`.
    fn take(&mut self, t: i64, cells: Row) -> Result<(), ReadError> {
        match &mut self.row {
            Some((of, row)) if *of == t => row.extend(cells),
            _ => {
                self.end_row()?;
                self.row = Some((t, cells));
            }
        }
        Ok(())
    }

    fn end_row(&mut self) -> Result<(), ReadError> {
        let Some((t, row)) = self.row.take() else {
            return Ok(());
        };
        if self.columns.is_empty() {
            self.columns = row.iter().map(|(column, _)| column.clone()).collect();
            let columns = self.columns.clone();
            self.write(["t"].into_iter().chain(columns.iter().map(String::as_str)))?;
        }
        let cells: BTreeMap<&str, &str> = (row
            .iter()
            .map(|(column, cell)| (column.as_str(), cell.as_str())))
        .collect();
        let others = cells
            .keys()
            .filter(|key| !self.columns.iter().any(|it| it == *key));
        self.summary.without_column += others.count() as u64;
        self.summary.values += 1;
        let t = proprio_topics::Nanos(t).to_string();
        let columns = self.columns.clone();
        let cells = columns
            .iter()
            .map(|column| cells.get(column.as_str()).copied());
        let cells: Vec<&str> = cells.map(Option::unwrap_or_default).collect();
        self.write([t.as_str()].into_iter().chain(cells))
    }

    fn write<'a>(&mut self, cells: impl Iterator<Item = &'a str>) -> Result<(), ReadError> {
        Ok((self.output.write_record(cells)).map_err(std::io::Error::other)?)
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
    let mut parsed = Parsed::new(message)?;
    let t = parsed.i64()?;
    let names = parsed.list(Parsed::text)?;
    let torques = parsed.list(Parsed::f64)?;
    let deviations = parsed.list(Parsed::f64)?;
    let valid = parsed.list(Parsed::bool)?;
    let reasons = parsed.list(Parsed::text)?;
    let causes = parsed.list(Parsed::text)?;
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
    let mut parsed = Parsed::new(message)?;
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
        let flag = |parsed: &mut Parsed<'_>| Some(u8::from(parsed.bool()?).to_string());
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
