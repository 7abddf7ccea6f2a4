//! Sample logs as CSV: one row per instant, one column per quantity, SI units, an empty cell where there is no sample.
//!
//! | column | meaning |
//! |---|---|
//! | `t` | stamp \[s\], decimal, read as integer nanoseconds; empty where a log has no stamps |
//! | `joint/<joint>/position` `velocity` `acceleration` `torque` `current` | \[rad, rad/s, rad/s^2, Nm, A\] |
//! | `wrench/<sensor>/fx` `fy` `fz` `tx` `ty` `tz` | \[N, Nm\], sensor axes |
//! | `wrench/<sensor>/temperature` | \[degrees Celsius\] |
//! | `wrench/<sensor>/g0` to `g5` | uncalibrated gauge counts |
//! | `imu/<sensor>/ax` `ay` `az` | proper acceleration \[m/s^2\], IMU axes |
//! | `imu/<sensor>/gx` `gy` `gz`, `alx` `aly` `alz` | angular velocity \[rad/s\], angular acceleration \[rad/s^2\] |
//! | `imu/<sensor>/mx` `my` `mz`, `qw` `qx` `qy` `qz` | magnetic field \[T\], orientation |
//! | `joint/<joint>/duty` `mode` `encoder` `faults` | the motor board's own state |
//! | `<channel>/quality` | the bits of [`Quality`], as a number |
//! | `contact/<name>/active` | 0 or 1: whether a contact is present from this instant on |
//!
//! The parts of one vector (`fx` to `tz`; `ax` to `az`; ...) are all there or all empty. A row that breaks this, or holds
//! something that is not a finite number, is skipped, counted and named: [`Reader::report`].

use crate::{Actuator, Gauges, Imu, JointState, Kind, Nanos, Quality, Reading, Temperature, Wrench};
use std::borrow::ToOwned;
use std::collections::HashMap;
use std::format;
use std::io;
use std::string::{String, ToString};
use std::vec::Vec;

/// What can stand in one column of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Field {
    Joint(u8),
    Wrench(u8),
    Imu(u8),
    Gauge(u8),
    Temperature,
    Actuator(u8),
    Quality,
    Active,
}

const JOINT: [&str; 5] = ["position", "velocity", "acceleration", "torque", "current"];
const WRENCH: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];
const IMU: [&str; 16] = [
    "ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz", "mx", "my", "mz", "qw", "qx", "qy", "qz",
];
const GAUGES: [&str; 6] = ["g0", "g1", "g2", "g3", "g4", "g5"];
const ACTUATOR: [&str; 4] = ["duty", "mode", "encoder", "faults"];
/// The parts of an IMU's reading that are there together or not at all.
const IMU_GROUPS: [core::ops::Range<usize>; 5] = [0..3, 3..6, 6..9, 9..12, 12..16];

fn position(names: &[&str], name: &str) -> Option<u8> {
    names.iter().position(|n| *n == name).and_then(|i| u8::try_from(i).ok())
}

/// What a named thing in a log is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum What {
    /// A channel of the gateway.
    Channel(Kind),
    /// A contact that is declared present or absent.
    Contact,
}

/// A named thing in a log.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Series {
    /// What it is.
    pub what: What,
    /// Its name.
    pub name: String,
}

/// One entry of a row: what one channel holds at that instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Item {
    /// The number of its [`Series`] in [`Reader::series`].
    pub series: usize,
    /// What it holds.
    pub value: Value,
}

/// What a channel holds in one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// A reading and what is known against it.
    Reading(Reading, Quality),
    /// Whether a contact is present from here on.
    Active(bool),
}

/// A log that can not be read at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file could not be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It is not a table.
    #[error("it is not a CSV table")]
    Csv(#[from] ::csv::Error),
    /// It has no column `t`.
    #[error("its first row must name the columns, `t` among them; it begins with {0:?}")]
    NoHeader(String),
    /// Two columns have one name.
    #[error("two columns are named {0:?}")]
    TwoColumns(String),
    /// It has no column that means anything.
    #[error("no column is a joint, wrench, imu or contact; there is: {0}")]
    NothingKnown(String),
    /// No row could be used.
    #[error("none of its {rows} rows can be used; the first: line {line}: {reason}")]
    NoRow {
        /// How many rows there are.
        rows: u64,
        /// The line of the first.
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

/// What was read and what was not.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// Rows used.
    pub rows: u64,
    /// Rows skipped.
    pub bad_rows: u64,
    /// The first of them (at most [`Report::NAMED`]).
    pub bad: Vec<BadRow>,
    /// Columns whose names mean nothing here.
    pub unknown_columns: Vec<String>,
}

impl Report {
    /// How many bad rows are named.
    pub const NAMED: usize = 10;

    /// Adds what there is to say of the rows that follow these, after `lines` lines.
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

    /// Whether a table of which this is all there is to say can be used.
    ///
    /// # Errors
    /// [`Error::NoRow`], [`Error::Empty`].
    pub fn usable(&self) -> Result<(), Error> {
        match (self.rows, self.bad.first()) {
            (0, Some(first)) => Err(Error::NoRow {
                rows: self.bad_rows,
                line: first.line,
                reason: first.reason.clone(),
            }),
            (0, None) => Err(Error::Empty),
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
    /// What the channels hold, each channel's main reading first.
    pub items: Vec<Item>,
}

#[derive(Clone)]
struct Column {
    series: usize,
    field: Field,
}

/// The values of one series while a row is put together.
#[derive(Clone)]
struct Cells {
    joint: [f64; 5],
    wrench: [f64; 6],
    imu: [f64; 16],
    gauges: [f64; 6],
    actuator: [f64; 4],
    temperature: f64,
    quality: f64,
    active: f64,
}

impl Cells {
    const EMPTY: Self = Self {
        joint: [f64::NAN; 5],
        wrench: [f64::NAN; 6],
        imu: [f64::NAN; 16],
        gauges: [f64::NAN; 6],
        actuator: [f64::NAN; 4],
        temperature: f64::NAN,
        quality: f64::NAN,
        active: f64::NAN,
    };

    fn slot(&mut self, field: Field) -> Option<&mut f64> {
        match field {
            Field::Joint(i) => self.joint.get_mut(usize::from(i)),
            Field::Wrench(i) => self.wrench.get_mut(usize::from(i)),
            Field::Imu(i) => self.imu.get_mut(usize::from(i)),
            Field::Gauge(i) => self.gauges.get_mut(usize::from(i)),
            Field::Actuator(i) => self.actuator.get_mut(usize::from(i)),
            Field::Temperature => Some(&mut self.temperature),
            Field::Quality => Some(&mut self.quality),
            Field::Active => Some(&mut self.active),
        }
    }
}

/// Whether all of `values` are there, none is, or neither.
fn all_or_none(values: &[f64]) -> Option<bool> {
    let there = values.iter().filter(|v| !v.is_nan()).count();
    if there == values.len() {
        Some(true)
    } else if there == 0 {
        Some(false)
    } else {
        None
    }
}

/// Reads a log row by row.
pub struct Reader<R> {
    csv: ::csv::Reader<R>,
    record: ::csv::ByteRecord,
    /// Whether it reads a whole table, from its header on.
    is_whole: bool,
    series: Vec<Series>,
    names: ::csv::StringRecord,
    /// Per column: what it is, or nothing if unknown; the stamp's column is `t_column`.
    columns: Vec<Option<Column>>,
    t_column: usize,
    cells: Vec<Cells>,
    report: Report,
}

impl<R: io::Read> Reader<R> {
    /// Reads the header.
    ///
    /// # Errors
    /// [`Error`]: not a table, no column `t`, two columns of one name, or no column that means anything.
    pub fn new(input: R) -> Result<Self, Error> {
        let mut csv = ::csv::ReaderBuilder::new()
            .flexible(true)
            .trim(::csv::Trim::Headers)
            .from_reader(input);
        let header = csv.headers()?.clone();
        let Some(t_column) = header.iter().position(|name| name == "t") else {
            let begin: String = header.iter().collect::<Vec<_>>().join(",").chars().take(60).collect();
            return Err(Error::NoHeader(begin));
        };
        let mut seen = HashMap::new();
        let (mut series, mut numbers) = (Vec::new(), HashMap::new());
        let mut columns = Vec::new();
        let mut report = Report::default();
        // `<channel>/quality` names no kind: it belongs to the channel of that name, whichever comes.
        let mut qualities = Vec::new();
        for (at, name) in header.iter().enumerate() {
            if seen.insert(name.to_owned(), at).is_some() {
                return Err(Error::TwoColumns(name.to_owned()));
            }
            let column = parse_column(name).and_then(|(what, channel, field)| {
                let Some(what) = what else {
                    qualities.push((at, channel.to_owned()));
                    return None;
                };
                let key = Series {
                    what,
                    name: channel.to_owned(),
                };
                let number = *numbers.entry(key.clone()).or_insert_with(|| {
                    series.push(key);
                    series.len() - 1
                });
                Some(Column { series: number, field })
            });
            if column.is_none() && at != t_column && qualities.last().is_none_or(|(q, _)| *q != at) {
                report.unknown_columns.push(name.to_owned());
            }
            columns.push(column);
        }
        for (at, channel) in qualities {
            let found = series
                .iter()
                .position(|s: &Series| s.name == channel && s.what != What::Contact);
            match (found, columns.get_mut(at)) {
                (Some(number), Some(column)) => {
                    *column = Some(Column {
                        series: number,
                        field: Field::Quality,
                    });
                }
                _ => report.unknown_columns.push(format!("{channel}/quality")),
            }
        }
        if series.is_empty() {
            let names: Vec<_> = header.iter().take(8).collect();
            return Err(Error::NothingKnown(names.join(", ")));
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

    /// A reader of further rows of this table, lines counted from the first of them: for whoever takes a table apart, and puts it together with [`Report::add`] and [`Report::usable`].
    #[must_use]
    pub fn further<S: io::Read>(&self, rows: S) -> Reader<S> {
        Reader {
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
            report: Report::default(),
        }
    }

    /// The channels and contacts of this log; an item's number counts these.
    #[must_use]
    pub fn series(&self) -> &[Series] {
        &self.series
    }

    /// Whether the log has column `field` (such as `velocity`) of `series`.
    #[must_use]
    pub fn has(&self, series: usize, field: &str) -> bool {
        let Some(wanted) = self.series.get(series).and_then(|s| parse_field(s.what, field)) else {
            return false;
        };
        self.columns
            .iter()
            .flatten()
            .any(|c| c.series == series && c.field == wanted)
    }

    /// What was read and skipped so far.
    #[must_use]
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// The next usable row into `row`; `false` at the end.
    ///
    /// # Errors
    /// [`Error`]: the file can not be read further, or at its end not a single row was usable (of a whole table).
    pub fn next_row(&mut self, row: &mut Row) -> Result<bool, Error> {
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
        if self.report.bad.len() < Report::NAMED {
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
            // (The table's reader would copy every record to do this.)
            let cell = cell.trim_ascii();
            if cell.is_empty() {
                continue;
            }
            let text = core::str::from_utf8(cell).map_err(|_| String::from("it is not text"))?;
            if at == self.t_column {
                row.t =
                    Some(Nanos::parse_seconds(text).ok_or_else(|| format!("t is {text:?}, not a number of seconds"))?);
            } else if let Some(Some(column)) = self.columns.get(at) {
                let value: f64 = text.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| {
                    let name = self.names.get(at).unwrap_or_default();
                    format!("{name} is {text:?}, not a finite number")
                })?;
                if let Some(slot) = self.cells.get_mut(column.series).and_then(|c| c.slot(column.field)) {
                    *slot = value;
                }
            }
        }
        for (number, (series, cells)) in self.series.iter().zip(&self.cells).enumerate() {
            items_of(series, cells, |value| row.items.push(Item { series: number, value })).map_err(|part| {
                format!(
                    "{}/{} holds some of {part}, but not all",
                    word(series.what),
                    series.name
                )
            })?;
        }
        Ok(())
    }
}

const fn word(what: What) -> &'static str {
    match what {
        What::Channel(kind) => kind.word(),
        What::Contact => "contact",
    }
}

/// A column's name taken apart: what it belongs to (`None`: a channel's quality), its name, its field.
fn parse_column(column: &str) -> Option<(Option<What>, &str, Field)> {
    let (front, field) = column.rsplit_once('/')?;
    if let Some((head, name)) = front.split_once('/') {
        let what = match head {
            "joint" => Some(What::Channel(Kind::Joint)),
            "wrench" => Some(What::Channel(Kind::Wrench)),
            "imu" => Some(What::Channel(Kind::Imu)),
            "contact" => Some(What::Contact),
            _ => None,
        };
        if let Some(what) = what
            && !name.is_empty()
        {
            return parse_field(what, field).map(|f| (Some(what), name, f));
        }
    }
    (field == "quality" && !front.is_empty()).then_some((None, front, Field::Quality))
}

fn parse_field(what: What, field: &str) -> Option<Field> {
    if field == "quality" && what != What::Contact {
        return Some(Field::Quality);
    }
    match what {
        What::Channel(Kind::Joint) => position(&JOINT, field)
            .map(Field::Joint)
            .or_else(|| position(&ACTUATOR, field).map(Field::Actuator)),
        What::Channel(Kind::Wrench) => position(&WRENCH, field)
            .map(Field::Wrench)
            .or_else(|| position(&GAUGES, field).map(Field::Gauge))
            .or_else(|| (field == "temperature").then_some(Field::Temperature)),
        What::Channel(Kind::Imu) => position(&IMU, field).map(Field::Imu),
        What::Contact => (field == "active").then_some(Field::Active),
    }
}

/// The readings that `cells` hold; `Err` names the part that is incomplete.
fn items_of(series: &Series, cells: &Cells, mut push: impl FnMut(Value)) -> Result<(), &'static str> {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let quality = if cells.quality.is_nan() {
        Quality::GOOD
    } else {
        Quality(cells.quality as u32)
    };
    match series.what {
        What::Contact => {
            if !cells.active.is_nan() {
                push(Value::Active(cells.active != 0.0));
            }
        }
        What::Channel(Kind::Joint) => {
            let [position, velocity, acceleration, torque, current] = cells.joint;
            if cells.joint.iter().any(|v| !v.is_nan()) {
                let state = JointState {
                    position,
                    velocity,
                    acceleration,
                    torque,
                    current,
                };
                push(Value::Reading(Reading::Joint(state), quality));
            }
            if all_or_none(&cells.actuator).ok_or("duty, mode, encoder, faults")? {
                let [duty, mode, encoder, faults] = cells.actuator;
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let state = Actuator {
                    duty,
                    mode: mode as u32,
                    encoder: encoder as u32,
                    faults: faults as u32,
                    reserved: 0,
                };
                push(Value::Reading(Reading::Actuator(state), quality));
            }
        }
        What::Channel(Kind::Wrench) => {
            let [fx, fy, fz, tx, ty, tz] = cells.wrench;
            if all_or_none(&cells.wrench).ok_or("fx fy fz tx ty tz")? {
                let wrench = Wrench {
                    force: [fx, fy, fz],
                    torque: [tx, ty, tz],
                };
                push(Value::Reading(Reading::Wrench(wrench), quality));
            }
            if all_or_none(&cells.gauges).ok_or("g0 to g5")? {
                #[allow(clippy::cast_possible_truncation)]
                let counts = cells.gauges.map(|g| g as i32);
                push(Value::Reading(Reading::Gauges(Gauges { counts }), quality));
            }
            if !cells.temperature.is_nan() {
                push(Value::Reading(
                    Reading::Temperature(Temperature {
                        celsius: cells.temperature,
                    }),
                    quality,
                ));
            }
        }
        What::Channel(Kind::Imu) => {
            for (group, part) in
                IMU_GROUPS
                    .into_iter()
                    .zip(["ax ay az", "gx gy gz", "alx aly alz", "mx my mz", "qw qx qy qz"])
            {
                all_or_none(cells.imu.get(group).unwrap_or_default()).ok_or(part)?;
            }
            if cells.imu.iter().any(|v| !v.is_nan()) {
                let [ax, ay, az, gx, gy, gz, alx, aly, alz, mx, my, mz, qw, qx, qy, qz] = cells.imu;
                let imu = Imu {
                    proper_acceleration: [ax, ay, az],
                    angular_velocity: [gx, gy, gz],
                    angular_acceleration: [alx, aly, alz],
                    magnetic_field: [mx, my, mz],
                    orientation: [qw, qx, qy, qz],
                };
                push(Value::Reading(Reading::Imu(imu), quality));
            }
        }
    }
    Ok(())
}

/// Which columns of a channel a [`Writer`] has, beside its quality.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Columns {
    /// What an estimator reads: position and velocity; the wrench; accelerations and rates.
    Main,
    /// Everything that the channel's kind can hold.
    All,
}

/// Writes a log row by row.
pub struct Writer<W> {
    output: W,
    /// Per series: its first column and its fields.
    series: Vec<(What, usize, Vec<Field>)>,
    /// The row being put together, one cell per column after `t`; NaN is empty.
    cells: Vec<f64>,
    /// The text of that row.
    text: Vec<u8>,
    pending: Option<Option<Nanos>>,
}

impl<W: io::Write> Writer<W> {
    /// Writes the header for `series`, each with `columns`.
    ///
    /// # Errors
    /// If `output` can not be written.
    pub fn new(mut output: W, series: &[Series], columns: Columns) -> io::Result<Self> {
        let mut header = String::from("t");
        let (mut layout, mut count) = (Vec::new(), 0);
        for one in series {
            let fields = fields_of(one.what, columns);
            for field in &fields {
                header.push(',');
                match field {
                    Field::Quality => header.push_str(&one.name),
                    _ => header.push_str(&format!("{}/{}", word(one.what), one.name)),
                }
                header.push('/');
                header.push_str(field_word(*field));
            }
            let first = count;
            count += fields.len();
            layout.push((one.what, first, fields));
        }
        header.push('\n');
        output.write_all(header.as_bytes())?;
        Ok(Self {
            output,
            series: layout,
            cells: std::vec![f64::NAN; count],
            text: Vec::with_capacity(512),
            pending: None,
        })
    }

    /// Adds a value at `t` to the row of that instant, or begins a new row.
    ///
    /// Values of one instant that follow one another share a row as long as no cell is needed twice.
    ///
    /// # Errors
    /// If the row before can not be written.
    pub fn push(&mut self, t: Option<Nanos>, series: usize, value: &Value) -> io::Result<()> {
        let mut cells = Cells::EMPTY;
        spread(value, &mut cells);
        let Some((_, first, fields)) = self.series.get(series) else {
            return Ok(());
        };
        let (first, count) = (*first, fields.len());
        let mut incoming = [f64::NAN; 24];
        for (field, slot) in fields.iter().zip(&mut incoming) {
            *slot = cells.slot(*field).map_or(f64::NAN, |v| *v);
        }
        let range = first..first + count;
        // The quality cell may be written twice in one row (a temperature beside a wrench); the bits add up.
        let taken = self
            .cells
            .get(range.clone())
            .unwrap_or_default()
            .iter()
            .zip(&incoming)
            .zip(fields);
        let clash = taken
            .into_iter()
            .any(|((old, new), f)| *f != Field::Quality && !old.is_nan() && !new.is_nan());
        if self.pending.is_some_and(|p| p != t || t.is_none()) || clash {
            self.flush_row()?;
        }
        self.pending = Some(t);
        let fields = self.series.get(series).map_or(&[][..], |s| s.2.as_slice());
        for ((cell, new), field) in self
            .cells
            .get_mut(range)
            .unwrap_or_default()
            .iter_mut()
            .zip(incoming)
            .zip(fields)
        {
            if *field == Field::Quality && !cell.is_nan() && !new.is_nan() {
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let both = *cell as u32 | new as u32;
                *cell = f64::from(both);
            } else if !new.is_nan() {
                *cell = new;
            }
        }
        Ok(())
    }

    fn flush_row(&mut self) -> io::Result<()> {
        use io::Write as _;
        let Some(t) = self.pending.take() else { return Ok(()) };
        self.text.clear();
        if let Some(t) = t {
            write!(self.text, "{t}")?;
        }
        for cell in &mut self.cells {
            self.text.push(b',');
            if !cell.is_nan() {
                #[allow(clippy::float_cmp, clippy::cast_possible_truncation)]
                if *cell == f64::from(*cell as i32) && (*cell != 0.0 || cell.is_sign_positive()) {
                    write_integer(&mut self.text, *cell as i32);
                } else {
                    self.text
                        .extend_from_slice(zmij::Buffer::new().format(*cell).as_bytes());
                }
                *cell = f64::NAN;
            }
        }
        self.text.push(b'\n');
        self.output.write_all(&self.text)
    }

    /// Writes what is left and gives the output back.
    ///
    /// # Errors
    /// If it can not be written.
    pub fn finish(mut self) -> io::Result<W> {
        self.flush_row()?;
        self.output.flush()?;
        Ok(self.output)
    }
}

fn write_integer(text: &mut Vec<u8>, value: i32) {
    let mut digits = [0_u8; 10];
    let mut rest = value.unsigned_abs();
    let mut at = digits.len();
    loop {
        at -= 1;
        if let Some(d) = digits.get_mut(at) {
            *d = b'0' + u8::try_from(rest % 10).unwrap_or(0);
        }
        rest /= 10;
        if rest == 0 {
            break;
        }
    }
    if value < 0 {
        text.push(b'-');
    }
    text.extend_from_slice(digits.get(at..).unwrap_or_default());
}

fn fields_of(what: What, columns: Columns) -> Vec<Field> {
    let all = columns == Columns::All;
    let mut fields = Vec::new();
    match what {
        What::Channel(Kind::Joint) if all => fields.extend((0..5).map(Field::Joint).chain((0..4).map(Field::Actuator))),
        What::Channel(Kind::Joint) => fields.extend((0..2).map(Field::Joint)),
        What::Channel(Kind::Wrench) => {
            fields.extend((0..6).map(Field::Wrench));
            if all {
                fields.extend((0..6).map(Field::Gauge));
                fields.push(Field::Temperature);
            }
        }
        What::Channel(Kind::Imu) => fields.extend((0..if all { 16 } else { 6 }).map(Field::Imu)),
        What::Contact => fields.push(Field::Active),
    }
    if what != What::Contact {
        fields.push(Field::Quality);
    }
    fields
}

fn field_word(field: Field) -> &'static str {
    let of = |names: &[&'static str], i: u8| names.get(usize::from(i)).copied().unwrap_or_default();
    match field {
        Field::Joint(i) => of(&JOINT, i),
        Field::Wrench(i) => of(&WRENCH, i),
        Field::Imu(i) => of(&IMU, i),
        Field::Gauge(i) => of(&GAUGES, i),
        Field::Actuator(i) => of(&ACTUATOR, i),
        Field::Temperature => "temperature",
        Field::Quality => "quality",
        Field::Active => "active",
    }
}

/// The inverse of [`items_of`].
fn spread(value: &Value, cells: &mut Cells) {
    match value {
        Value::Active(active) => cells.active = f64::from(u8::from(*active)),
        Value::Reading(reading, quality) => {
            cells.quality = f64::from(quality.0);
            match reading {
                Reading::Joint(j) => cells.joint = [j.position, j.velocity, j.acceleration, j.torque, j.current],
                Reading::Wrench(w) => {
                    let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
                    cells.wrench = [fx, fy, fz, tx, ty, tz];
                }
                Reading::Imu(i) => {
                    let parts = i
                        .proper_acceleration
                        .iter()
                        .chain(&i.angular_velocity)
                        .chain(&i.angular_acceleration);
                    let parts = parts.chain(&i.magnetic_field).chain(&i.orientation);
                    cells.imu.iter_mut().zip(parts).for_each(|(cell, v)| *cell = *v);
                }
                Reading::Gauges(g) => cells.gauges = g.counts.map(f64::from),
                Reading::Temperature(t) => cells.temperature = t.celsius,
                Reading::Actuator(a) => {
                    cells.actuator = [a.duty, f64::from(a.mode), f64::from(a.encoder), f64::from(a.faults)];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;

    fn read(text: &str) -> Result<(Vec<Row>, Report, Vec<Series>), Error> {
        let mut reader = Reader::new(text.as_bytes())?;
        let (mut rows, mut row) = (Vec::new(), Row::default());
        while reader.next_row(&mut row)? {
            rows.push(row.clone());
        }
        Ok((rows, reader.report().clone(), reader.series().to_vec()))
    }

    #[test]
    fn bad_rows_are_skipped_counted_and_named() {
        let text = "t,joint/a/position,wrench/s/fx,wrench/s/fy,wrench/s/fz,wrench/s/tx,wrench/s/ty,wrench/s/tz,note/x\n\
                    0.5,1,,,,,,,\n\
                    0.6,nan,,,,,,,\n\
                    x,1,,,,,,,\n\
                    0.8,,1,2,3,,,,\n\
                    0.9 , ,1 ,2, 3,4,5,\t6,7\n\
                    1.0,2";
        let Ok((rows, report, series)) = read(text) else {
            panic!("readable")
        };
        assert_eq!((rows.len(), report.bad_rows), (2, 4));
        assert_eq!(report.unknown_columns, ["note/x"]);
        assert_eq!(series.len(), 2);
        let reasons: Vec<_> = report.bad.iter().map(|b| (b.line, b.reason.as_str())).collect();
        assert_eq!(
            reasons,
            [
                (3, "joint/a/position is \"nan\", not a finite number"),
                (4, "t is \"x\", not a number of seconds"),
                (5, "wrench/s holds some of fx fy fz tx ty tz, but not all"),
                (7, "it has 2 cells instead of 9"),
            ]
        );
    }

    #[test]
    fn a_log_without_a_usable_row_is_an_error() {
        assert!(matches!(
            read("t,joint/a/position\n1,x\n"),
            Err(Error::NoRow { line: 2, .. })
        ));
        assert!(matches!(read("t,joint/a/position\n"), Err(Error::Empty)));
        assert!(matches!(read("time,joint/a/position\n"), Err(Error::NoHeader(_))));
        assert!(matches!(read("t,t\n"), Err(Error::TwoColumns(_))));
        assert!(matches!(read("t,x\n"), Err(Error::NothingKnown(_))));
    }

    #[test]
    fn what_is_written_is_read_back_bit_for_bit() {
        let series = [
            Series {
                what: What::Channel(Kind::Joint),
                name: "elbow".into(),
            },
            Series {
                what: What::Channel(Kind::Wrench),
                name: "ft".into(),
            },
            Series {
                what: What::Channel(Kind::Imu),
                name: "chest".into(),
            },
            Series {
                what: What::Contact,
                name: "hand".into(),
            },
        ];
        let imu = Imu {
            proper_acceleration: [-0.0, 1e-300, 9.80665],
            angular_velocity: [0.1, -2.0, 3e10],
            ..Imu::ABSENT
        };
        let values = vec![
            (
                0,
                Value::Reading(
                    Reading::Joint(JointState {
                        position: 1.0 / 3.0,
                        ..JointState::ABSENT
                    }),
                    Quality::GOOD,
                ),
            ),
            (
                1,
                Value::Reading(
                    Reading::Wrench(Wrench {
                        force: [1.5, -2.0, 0.0],
                        torque: [0.1; 3],
                    }),
                    Quality::SATURATED,
                ),
            ),
            (
                1,
                Value::Reading(Reading::Temperature(Temperature { celsius: 31.4 }), Quality::FROZEN),
            ),
            (2, Value::Reading(Reading::Imu(imu), Quality::GOOD)),
            (3, Value::Active(true)),
        ];
        let mut writer = Writer::new(Vec::new(), &series, Columns::All).unwrap();
        for (number, value) in &values {
            writer.push(Some(Nanos(123_456_789)), *number, value).unwrap();
        }
        // A second sample of one channel can not share the row.
        writer
            .push(Some(Nanos(123_456_789)), values[0].0, &values[0].1)
            .unwrap();
        let text = String::from_utf8(writer.finish().unwrap()).unwrap();
        let (rows, report, read_series) = read(&text).unwrap();
        assert_eq!(
            (rows.len(), report.bad_rows, report.unknown_columns.len()),
            (2, 0, 0),
            "{text}"
        );
        assert_eq!(read_series, series);
        let bits = |v: &Value| {
            let mut cells = Cells::EMPTY;
            spread(v, &mut cells);
            let all = cells
                .joint
                .iter()
                .chain(&cells.wrench)
                .chain(&cells.imu)
                .chain([&cells.temperature, &cells.active]);
            all.map(|x| if x.is_nan() { 0 } else { x.to_bits() })
                .collect::<Vec<_>>()
        };
        let got: Vec<_> = rows[0].items.iter().map(|i| (i.series, bits(&i.value))).collect();
        let want: Vec<_> = values.iter().map(|(n, v)| (*n, bits(v))).collect();
        assert_eq!(got, want);
        assert_eq!(rows[0].t, Some(Nanos(123_456_789)));
        let Value::Reading(_, quality) = rows[0].items[1].value else {
            panic!("a wrench")
        };
        assert_eq!(quality, Quality::SATURATED | Quality::FROZEN);
    }
}
