//! Reads a table row by row. Unusable rows are skipped, counted and reported with the reason.

use super::columns::{
    Cells, ColumnQuantity, Series, SeriesKind, Value, items_of, parse_column, parse_field, word,
};
use crate::Nanos;
use std::borrow::ToOwned;
use std::collections::HashMap;
use std::format;
use std::io;
use std::string::{String, ToString};
use std::vec::Vec;

/// One entry of a row: the value of one series at that instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeriesValue {
    /// The number of its [`Series`] in [`TableReader::series`].
    pub series: usize,
    /// Its value.
    pub value: Value,
}

/// Why a log cannot be read at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TableError {
    /// The file could not be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It is not a table.
    #[error("it is not a CSV table")]
    Csv(#[from] ::csv::Error),
    /// It has no column `t`.
    #[error(
        "its first row must name the columns, `t` among them; it begins with {0:?} \
         (`proprio decode` makes such a table of a recorded bus)"
    )]
    NoHeader(String),
    /// Two columns have one name.
    #[error("two columns are named {0:?}")]
    TwoColumns(String),
    /// It has no column with a known name.
    #[error("it has no column joint/..., wrench/..., imu/... or contact/...; its columns: {0}")]
    NothingKnown(String),
    /// No row could be used.
    #[error("none of its {rows} rows can be used; the first is line {line}: {reason}")]
    NoRow {
        /// Number of rows.
        rows: u64,
        /// Line of the first row.
        line: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// It has no rows.
    #[error("it has a header but no rows")]
    Empty,
}

/// A row that was skipped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BadRow {
    /// Its line in the file, from 1.
    pub line: u64,
    /// What is wrong with it.
    pub reason: String,
}

/// Counts of the rows used and skipped, with reasons.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TableReport {
    /// Rows used.
    pub rows: u64,
    /// Rows skipped.
    pub bad_rows: u64,
    /// The first skipped rows (at most [`TableReport::NAMED`]).
    pub bad: Vec<BadRow>,
    /// Columns with unknown names.
    pub unknown_columns: Vec<String>,
}

impl TableReport {
    /// Maximum number of entries in [`TableReport::bad`].
    pub const NAMED: usize = 10;

    /// Adds the report of the rows that follow after `lines` lines.
    pub fn add(&mut self, next: Self, lines: u64) {
        self.rows += next.rows;
        self.bad_rows += next.bad_rows;
        let room = Self::NAMED.saturating_sub(self.bad.len());
        let bad = next.bad.into_iter().take(room);
        self.bad.extend(bad.map(|bad| BadRow {
            line: lines + bad.line,
            ..bad
        }));
    }

    /// Tests whether a table with this complete report is usable.
    ///
    /// # Errors
    /// [`TableError::NoRow`], [`TableError::Empty`].
    pub fn usable(&self) -> Result<(), TableError> {
        match (self.rows, self.bad.first()) {
            (0, Some(first)) => Err(TableError::NoRow {
                rows: self.bad_rows,
                line: first.line,
                reason: first.reason.clone(),
            }),
            (0, None) => Err(TableError::Empty),
            _ => Ok(()),
        }
    }
}

/// One row.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Row {
    /// Its stamp \[ns\]; `None` if the cell is empty.
    pub t: Option<Nanos>,
    /// Its line in the file.
    pub line: u64,
    /// The values, each channel's main reading first.
    pub items: Vec<SeriesValue>,
}

#[derive(Clone)]
struct TableColumn {
    series: usize,
    field: ColumnQuantity,
}

/// Reads a log row by row.
pub struct TableReader<R> {
    csv: ::csv::Reader<R>,
    record: ::csv::ByteRecord,
    /// Whether it reads a whole table, including the header.
    is_whole: bool,
    series: Vec<Series>,
    names: ::csv::StringRecord,
    /// Per column: series and field; `None` if unknown. The stamp is in column `t_column`.
    columns: Vec<Option<TableColumn>>,
    t_column: usize,
    cells: Vec<Cells>,
    report: TableReport,
}

impl<R: io::Read> TableReader<R> {
    /// Reads the header.
    ///
    /// # Errors
    /// [`TableError`]: not a table, no column `t`, two columns of one name, or no column with a
    /// known name.
    pub fn new(input: R) -> Result<Self, TableError> {
        let mut csv = ::csv::ReaderBuilder::new()
            .flexible(true)
            .trim(::csv::Trim::Headers)
            .from_reader(input);
        let header = csv.headers()?.clone();
        let Some(t_column) = header.iter().position(|name| name == "t") else {
            let names = header.iter().collect::<Vec<_>>().join(",");
            return Err(TableError::NoHeader(names.chars().take(60).collect()));
        };
        let mut seen = HashMap::new();
        let (mut series, mut numbers) = (Vec::new(), HashMap::new());
        let mut columns = Vec::new();
        let mut report = TableReport::default();
        // `<channel>/quality` names no kind: it belongs to the first channel of that name.
        let mut qualities = Vec::new();
        for (at, name) in header.iter().enumerate() {
            if seen.insert(name.to_owned(), at).is_some() {
                return Err(TableError::TwoColumns(name.to_owned()));
            }
            let column = parse_column(name).and_then(|(kind, channel, field)| {
                let Some(kind) = kind else {
                    qualities.push((at, channel.to_owned()));
                    return None;
                };
                let key = Series {
                    kind,
                    name: channel.to_owned(),
                };
                let number = *numbers.entry(key.clone()).or_insert_with(|| {
                    series.push(key);
                    series.len() - 1
                });
                Some(TableColumn {
                    series: number,
                    field,
                })
            });
            if column.is_none() && at != t_column && qualities.last().is_none_or(|(q, _)| *q != at)
            {
                report.unknown_columns.push(name.to_owned());
            }
            columns.push(column);
        }
        for (at, channel) in qualities {
            let found = series
                .iter()
                .position(|s: &Series| s.name == channel && s.kind != SeriesKind::Contact);
            match (found, columns.get_mut(at)) {
                (Some(number), Some(column)) => {
                    *column = Some(TableColumn {
                        series: number,
                        field: ColumnQuantity::Quality,
                    });
                }
                _ => report.unknown_columns.push(format!("{channel}/quality")),
            }
        }
        if series.is_empty() {
            let names: Vec<_> = header.iter().take(8).collect();
            return Err(TableError::NothingKnown(names.join(", ")));
        }
        let cells = std::vec![Cells::EMPTY; series.len()];
        Ok(Self {
            csv,
            record: ::csv::ByteRecord::new(),
            is_whole: true,
            series,
            names: header,
            columns,
            t_column,
            cells,
            report,
        })
    }

    /// A reader of further rows of this table, with lines counted from the first of them. For
    /// reading a table in parts: combine the parts' reports with [`TableReport::add`] and
    /// [`TableReport::usable`].
    #[must_use]
    pub fn further<S: io::Read>(&self, rows: S) -> TableReader<S> {
        TableReader {
            csv: ::csv::ReaderBuilder::new()
                .flexible(true)
                .has_headers(false)
                .from_reader(rows),
            record: ::csv::ByteRecord::new(),
            is_whole: false,
            series: self.series.clone(),
            names: self.names.clone(),
            columns: self.columns.clone(),
            t_column: self.t_column,
            cells: self.cells.clone(),
            report: TableReport::default(),
        }
    }

    /// The channels and contacts of this log; [`SeriesValue::series`] is an index of it.
    #[must_use]
    pub fn series(&self) -> &[Series] {
        &self.series
    }

    /// Whether the log has column `field` (such as `velocity`) of `series`.
    #[must_use]
    pub fn has(&self, series: usize, field: &str) -> bool {
        let Some(wanted) = self
            .series
            .get(series)
            .and_then(|s| parse_field(s.kind, field))
        else {
            return false;
        };
        self.columns
            .iter()
            .flatten()
            .any(|c| c.series == series && c.field == wanted)
    }

    /// Counts of rows read and skipped so far.
    #[must_use]
    pub fn report(&self) -> &TableReport {
        &self.report
    }

    /// Reads the next usable row into `row`; returns `false` at the end.
    ///
    /// # Errors
    /// [`TableError`]: the file cannot be read further; or a whole table is at its end and no row
    /// was usable.
    pub fn next_row(&mut self, row: &mut Row) -> Result<bool, TableError> {
        loop {
            match self.csv.read_byte_record(&mut self.record) {
                Ok(true) => {}
                Ok(false) => break,
                Err(e) if matches!(e.kind(), ::csv::ErrorKind::Io(_)) => return Err(e.into()),
                Err(e) => {
                    self.skip(e.position().map_or(0, ::csv::Position::line), e.to_string());
                    continue;
                }
            }
            let line = self.record.position().map_or(0, ::csv::Position::line);
            match self.fill(row) {
                Ok(()) => {
                    row.line = line;
                    self.report.rows += 1;
                    return Ok(true);
                }
                Err(reason) => self.skip(line, reason),
            }
        }
        if self.is_whole {
            self.report.usable()?;
        }
        Ok(false)
    }

    fn skip(&mut self, line: u64, reason: String) {
        self.report.bad_rows += 1;
        if self.report.bad.len() < TableReport::NAMED {
            self.report.bad.push(BadRow { line, reason });
        }
    }

    fn fill(&mut self, row: &mut Row) -> Result<(), String> {
        row.items.clear();
        row.t = None;
        self.cells.fill(Cells::EMPTY);
        if self.record.len() != self.columns.len() {
            return Err(format!(
                "it has {} cells instead of {}",
                self.record.len(),
                self.columns.len()
            ));
        }
        for (at, cell) in self.record.iter().enumerate() {
            // Trimmed here because the `csv` reader would copy every record to do it.
            let cell = cell.trim_ascii();
            if cell.is_empty() {
                continue;
            }
            let text = core::str::from_utf8(cell).map_err(|_| String::from("it is not text"))?;
            if at == self.t_column {
                row.t = Some(
                    Nanos::parse_seconds(text)
                        .filter(|t| t.is_instant())
                        .ok_or_else(|| format!("t is {text:?}, not a number of seconds"))?,
                );
            } else if let Some(Some(column)) = self.columns.get(at) {
                let value: f64 = text
                    .parse()
                    .ok()
                    .filter(|v: &f64| v.is_finite())
                    .ok_or_else(|| {
                        let name = self.names.get(at).unwrap_or_default();
                        format!("{name} is {text:?}, not a finite number")
                    })?;
                if let Some(slot) = self
                    .cells
                    .get_mut(column.series)
                    .and_then(|c| c.slot(column.field))
                {
                    *slot = value;
                }
            }
        }
        for (number, (series, cells)) in self.series.iter().zip(&self.cells).enumerate() {
            items_of(series, cells, |value| {
                row.items.push(SeriesValue {
                    series: number,
                    value,
                });
            })
            .map_err(|problem| format!("{}/{} {problem}", word(series.kind), series.name))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<(Vec<Row>, TableReport, Vec<Series>), TableError> {
        let mut reader = TableReader::new(text.as_bytes())?;
        let (mut rows, mut row) = (Vec::new(), Row::default());
        while reader.next_row(&mut row)? {
            rows.push(row.clone());
        }
        Ok((rows, reader.report().clone(), reader.series().to_vec()))
    }

    #[test]
    fn bad_rows_are_skipped_counted_and_named() {
        let text = "t,joint/a/position,wrench/s/fx,wrench/s/fy,wrench/s/fz,wrench/s/tx,\
                    wrench/s/ty,wrench/s/tz,note/x\n\
                    0.5,1,,,,,,,\n\
                    0.6,nan,,,,,,,\n\
                    x,1,,,,,,,\n\
                    0.8,,1,2,3,,,,\n\
                    0.9 , ,1 ,2, 3,4,5,\t6,7\n\
                    1.0,2\n\
                    9223372036.8,1,,,,,,,\n";
        let Ok((rows, report, series)) = read(text) else {
            panic!("readable")
        };
        assert_eq!((rows.len(), report.bad_rows), (2, 5));
        assert_eq!(report.unknown_columns, ["note/x"]);
        assert_eq!(series.len(), 2);
        let reasons: Vec<_> = report
            .bad
            .iter()
            .map(|b| (b.line, b.reason.as_str()))
            .collect();
        assert_eq!(
            reasons,
            [
                (3, "joint/a/position is \"nan\", not a finite number"),
                (4, "t is \"x\", not a number of seconds"),
                (5, "wrench/s holds some of fx fy fz tx ty tz, but not all"),
                (7, "it has 2 cells instead of 9"),
                (8, "t is \"9223372036.8\", not a number of seconds"),
            ]
        );
    }

    #[test]
    fn a_log_without_a_usable_row_is_an_error() {
        assert!(matches!(
            read("t,joint/a/position\n1,x\n"),
            Err(TableError::NoRow { line: 2, .. })
        ));
        assert!(matches!(
            read("t,joint/a/position\n"),
            Err(TableError::Empty)
        ));
        assert!(matches!(
            read("time,joint/a/position\n"),
            Err(TableError::NoHeader(_))
        ));
        assert!(matches!(read("t,t\n"), Err(TableError::TwoColumns(_))));
        assert!(matches!(read("t,x\n"), Err(TableError::NothingKnown(_))));
    }
}
