//! Reads a log into its channels, on all cores: the text is cut between lines into segments, each
//! segment is parsed on its own, and the results are joined in order.
//!
//! The cuts do not depend on the number of cores. The rest of a log is read row by row where the
//! end of a line may not be the end of a row (a quoted cell can contain one), and where rows have
//! no stamps and are counted instead.

use crate::setup::{Setup, similar_name};
use proprio_identification::dataset::DatasetError;
use proprio_identification::dataset::recording::SkippedRows;
use proprio_identification::robot::Channel;
use proprio_identification::{Dataset, LogRole, Recording, Robot, parallel};
use proprio_topics::csv::{
    self, Row, Series, SeriesKind, SeriesValue, TableReader, TableReport, Value,
};
use proprio_topics::{Kind, Nanos};
use std::io::Read;
use std::ops::Range;

/// Why a log cannot be read at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SampleLogError {
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] csv::TableError),
    /// Without these channels there are no kinematics.
    #[error(transparent)]
    MissingChannels(#[from] MissingChannels),
    /// A channel has columns, but no sample.
    #[error("{0} in its columns of the log")]
    Dataset(#[from] DatasetError),
}

/// A log lacks channels that the configuration names.
#[derive(Debug, thiserror::Error)]
#[error(
    "the log has no column for {}{hint}; use a log of {robot:?} with these channels, or name \
     joints that are not measured in [locked] of the configuration", .missing.join(", ")
)]
pub struct MissingChannels {
    robot: String,
    missing: Vec<String>,
    /// A similar column, if there is one.
    hint: String,
}

impl SampleLogError {
    /// Whether it is a log without content.
    fn is_empty(&self) -> bool {
        matches!(
            self,
            Self::Dataset(_) | Self::Log(csv::TableError::Empty | csv::TableError::NoRow { .. })
        )
    }
}

/// Reads a sample log (columns: [`proprio_topics::csv`]) and aligns its channels.
///
/// Rows that cannot be read are skipped. Samples whose stamps go backward are excluded, as few as
/// possible. [`Dataset::findings`] lists both.
///
/// # Errors
/// [`SampleLogError`]: it is no log, or lacks a joint that is not locked, or the IMU of the base.
/// A missing F/T sensor is a finding here; `proprio identify` refuses the log before.
pub fn dataset(
    robot: &Robot,
    name: &str,
    role: LogRole,
    log: impl Read,
) -> Result<Dataset, SampleLogError> {
    let recording = recording(robot, log)?;
    Ok(Dataset::new(robot, name, role, recording)?)
}

/// The same, but a log with columns and without samples gives a [`Dataset`] that is marked as
/// unreadable instead of an error.
///
/// # Errors
/// [`SampleLogError`]: it is no log of this robot.
pub fn dataset_or_unreadable(
    robot: &Robot,
    name: &str,
    role: LogRole,
    log: impl Read,
) -> Result<Dataset, SampleLogError> {
    match dataset(robot, name, role, log) {
        Err(problem) if problem.is_empty() => {
            Ok(Dataset::unreadable(name, role, problem.to_string()))
        }
        result => result,
    }
}

/// Reads a sample log, channel by channel.
///
/// # Errors
/// [`SampleLogError`]: it is no log, or lacks columns of a channel.
pub fn recording(robot: &Robot, log: impl Read) -> Result<Recording, SampleLogError> {
    read_in_segments(robot, log, BLOCK, SEGMENT)
}

/// Size of the text that is read at a time \[bytes\].
const BLOCK: usize = 4 << 20;
/// Approximate size of the text that one thread parses at a time \[bytes\].
const SEGMENT: usize = 256 << 10;

/// The channel or contact that a column belongs to.
#[derive(Clone, Copy)]
pub(crate) enum ColumnOwner {
    Channel(usize),
    Contact(usize),
}

/// Per series of a log its channel or contact; none if the robot has no such.
pub(crate) fn column_owners(robot: &Robot, series: &[Series]) -> Vec<Option<ColumnOwner>> {
    let target = |series: &Series| match series.kind {
        SeriesKind::Channel(kind) => robot.channel(kind, &series.name).map(ColumnOwner::Channel),
        SeriesKind::Contact => robot.contact(&series.name).map(ColumnOwner::Contact),
    };
    series.iter().map(target).collect()
}

/// The samples of consecutive rows.
#[derive(Clone)]
struct PartialRecording {
    recording: Recording,
    is_stamped: bool,
    report: TableReport,
}

/// [`recording`] with given sizes of blocks and segments.
fn read_in_segments(
    robot: &Robot,
    mut log: impl Read,
    block: usize,
    segment: usize,
) -> Result<Recording, SampleLogError> {
    let mut text = Vec::new();
    let mut ended = fill(&mut text, &mut log, block)?;
    let Some((header, mut before)) = header(&text) else {
        let mut rows = TableReader::new(text.chain(log))?;
        let (mut part, owners) = PartialRecording::new(robot, &rows)?;
        part.take(&mut rows, &owners)?;
        return Ok(part.finish());
    };
    let header: Vec<u8> = text.drain(..header).collect();
    let table = TableReader::new(header.as_slice())?;
    let (mut all, owners) = PartialRecording::new(robot, &table)?;
    let empty = all.clone();
    all.report = table.report().clone();
    loop {
        let end = if ended {
            text.len()
        } else {
            whole_lines(&text)
        };
        let segments = segments(&text[..end], segment);
        let parts = parallel::map(
            segments.len(),
            |number| -> Result<Option<(PartialRecording, u64)>, csv::TableError> {
                let segment = &text[segments[number].clone()];
                // None where the log cannot be cut.
                if segment.contains(&b'"') {
                    return Ok(None);
                }
                let mut part = empty.clone();
                part.take(&mut table.further(segment), &owners)?;
                Ok(part.is_stamped.then(|| (part, lines(segment))))
            },
        );
        let parts: Option<Vec<(PartialRecording, u64)>> =
            parts.into_iter().collect::<Result<_, _>>()?;
        let Some(parts) = parts.filter(|_| end > 0 || ended) else {
            let mut rest = empty;
            rest.take(&mut table.further(text.chain(log)), &owners)?;
            all.append(rest, before);
            break;
        };
        for (part, lines) in parts {
            all.append(part, before);
            before += lines;
        }
        if ended {
            break;
        }
        text.drain(..end);
        ended = fill(&mut text, &mut log, block)?;
    }
    all.report.usable()?;
    Ok(all.finish())
}

/// Reads until there is a block of text. True if the log ended.
fn fill(text: &mut Vec<u8>, log: &mut impl Read, block: usize) -> Result<bool, csv::TableError> {
    let missing = block.saturating_sub(text.len()) as u64;
    let read = log.by_ref().take(missing).read_to_end(text)?;
    Ok((read as u64) < missing)
}

/// The end of the header, and its number of lines; none if the text cannot be cut there.
fn header(text: &[u8]) -> Option<(usize, u64)> {
    let mut end = 0;
    for (lines, own) in (1..).zip(text.split_inclusive(|byte| *byte == b'\n')) {
        end += own.len();
        if !own.iter().all(|byte| b"\r\n".contains(byte)) {
            // Other line ends, or names in quotes, are left to the parser.
            let is_line = own
                .strip_suffix(b"\n")
                .map(|own| own.strip_suffix(b"\r").unwrap_or(own));
            let is_whole = is_line.is_some_and(|own| !own.contains(&b'\r') && !own.contains(&b'"'));
            return is_whole.then_some((end, lines));
        }
    }
    None
}

fn lines(text: &[u8]) -> u64 {
    text.iter().filter(|byte| **byte == b'\n').count() as u64
}

fn whole_lines(text: &[u8]) -> usize {
    text.iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |last| last + 1)
}

/// Segments of whole lines, of at least `size`.
fn segments(text: &[u8], size: usize) -> Vec<Range<usize>> {
    let mut segments = Vec::new();
    let mut start = 0;
    while start < text.len() {
        let least = text.len().min(start + size);
        let rest = text[least..].iter().position(|byte| *byte == b'\n');
        let end = rest.map_or(text.len(), |rest| least + rest + 1);
        segments.push(start..end);
        start = end;
    }
    segments
}

impl PartialRecording {
    /// A recording without rows; and per series of the log its channel or contact, if it has one.
    fn new(
        robot: &Robot,
        table: &TableReader<impl Read>,
    ) -> Result<(Self, Vec<Option<ColumnOwner>>), SampleLogError> {
        // A log may lack an F/T sensor, but no joint and no IMU.
        check_columns(robot, table.series(), |c| c.kind != Kind::Wrench)?;
        let owners = column_owners(robot, table.series());
        let part = Self {
            recording: Recording::new(robot),
            is_stamped: true,
            report: TableReport::default(),
        };
        Ok((part, owners))
    }

    fn take<R: Read>(
        &mut self,
        rows: &mut TableReader<R>,
        owners: &[Option<ColumnOwner>],
    ) -> Result<(), csv::TableError> {
        let (mut row, mut pseudo) = (Row::default(), Nanos::ZERO);
        while rows.next_row(&mut row)? {
            let t = row.t.unwrap_or_else(|| {
                self.is_stamped = false;
                pseudo += self.recording.unstamped_spacing();
                pseudo
            });
            for SeriesValue { series, value } in &row.items {
                match (owners.get(*series).copied().flatten(), value) {
                    (Some(ColumnOwner::Channel(channel)), Value::Reading(reading, quality)) => {
                        self.recording.push(channel, t, reading, *quality);
                    }
                    (Some(ColumnOwner::Contact(contact)), Value::Contact(state)) => {
                        self.recording.declare(contact, t, state.active);
                    }
                    _ => {}
                }
            }
        }
        self.report = rows.report().clone();
        Ok(())
    }

    /// Adds the rows that follow, which begin after this number of lines.
    fn append(&mut self, next: Self, lines: u64) {
        self.recording.append(next.recording);
        self.is_stamped &= next.is_stamped;
        self.report.add(next.report, lines);
    }

    fn finish(mut self) -> Recording {
        if !self.is_stamped {
            self.recording.set_unstamped();
        }
        let skipped = self.report.bad.first().map(|first| SkippedRows {
            rows: self.report.bad_rows,
            line: first.line,
            reason: first.reason.clone(),
        });
        self.recording.set_rows(self.report.rows, skipped);
        self.recording
    }
}

/// Checks that a log with these columns has every channel of the robot of which `needed` is true.
///
/// # Errors
/// The channels that it lacks.
pub fn check_columns(
    robot: &Robot,
    series: &[Series],
    needed: impl Fn(&Channel) -> bool,
) -> Result<(), MissingChannels> {
    let column = |kind: Kind, name: &str| format!("{}/{name}", kind.word());
    let columns: Vec<String> = series
        .iter()
        .filter_map(|series| match series.kind {
            SeriesKind::Channel(kind) => Some(column(kind, &series.name)),
            SeriesKind::Contact => None,
        })
        .collect();
    let missing: Vec<String> = robot
        .channels
        .iter()
        .filter(|channel| needed(channel))
        .map(|channel| column(channel.kind, &channel.name))
        .filter(|channel| !columns.contains(channel))
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    // A misspelt column is one that the robot does not have.
    let of_robot = |name: &&str| {
        let mut channels = robot.channels.iter();
        channels.any(|channel| column(channel.kind, &channel.name) == **name)
    };
    let others = columns.iter().map(String::as_str).filter(|c| !of_robot(c));
    let hint = similar_name(&missing[0], others).unwrap_or_default();
    Err(MissingChannels {
        robot: robot.name.clone(),
        missing,
        hint,
    })
}

/// Checks that a log with columns of skins has those that the configuration names: its channel may
/// be misspelt. A log without any skin is a log of before there was one.
///
/// # Errors
/// The channels that it lacks.
pub(crate) fn check_skins(setup: &Setup, series: &[Series]) -> Result<(), MissingChannels> {
    let is_skin = |series: &&Series| series.kind == SeriesKind::Channel(Kind::Skin);
    let logged: Vec<&str> = series
        .iter()
        .filter(is_skin)
        .map(|one| one.name.as_str())
        .collect();
    let skins = setup.skins.iter().map(|skin| skin.channel.as_str());
    let missing: Vec<&str> = skins.filter(|name| !logged.contains(name)).collect();
    let Some(first) = missing.first().filter(|_| !logged.is_empty()) else {
        return Ok(());
    };
    let configured = |name: &str| setup.skins.iter().any(|skin| skin.channel == name);
    let others = logged.iter().copied().filter(|name| !configured(name));
    Err(MissingChannels {
        robot: setup.robot.name.clone(),
        hint: similar_name(first, others).unwrap_or_default(),
        missing: missing.iter().map(|name| format!("skin/{name}")).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use std::path::Path;

    /// The recording of a log that is not cut.
    fn read_whole(robot: &Robot, log: &str) -> Result<Recording, SampleLogError> {
        let mut rows = TableReader::new(log.as_bytes())?;
        let (mut part, owners) = PartialRecording::new(robot, &rows)?;
        part.take(&mut rows, &owners)?;
        Ok(part.finish())
    }

    #[test]
    fn a_log_read_in_segments_gives_the_same_recording() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/oracle/sessions");
        let config = Config::load(&folder.join("estimator.toml")).expect("a configuration");
        let robot = Setup::new(&config).expect("a setup").robot;
        let log = std::fs::read_to_string(folder.join("train.csv")).expect("a session");
        let mut rows: Vec<String> = log.lines().take(300).map(str::to_owned).collect();
        // Rows that repeat the one before, some with its stamp, and stamps that go backward.
        for row in (7..290).step_by(11) {
            let numbers = |row: &str| {
                row.split_once(',')
                    .map_or(String::new(), |(_, rest)| rest.to_owned())
            };
            let stamp = |row: &str| row.split(',').next().unwrap_or_default().to_owned();
            rows[row] = rows[row - 1].clone();
            rows[row + 1] = format!("{},{}", stamp(&rows[row + 1]), numbers(&rows[row]));
            let earlier = stamp(&rows[row + 3]).parse::<f64>().expect("a stamp") - 0.025;
            rows[row + 3] = format!("{earlier:.9},{}", numbers(&rows[row + 3]));
        }
        let text = rows.join("\n") + "\n";
        let change = |what: &dyn Fn(usize, &str) -> String| -> String {
            text.lines()
                .enumerate()
                .map(|(number, line)| what(number, line) + "\n")
                .collect()
        };
        let without_stamp = |line: &str| {
            line.find(',')
                .map_or(String::new(), |comma| line[comma..].to_owned())
        };
        let cases = [
            ("as it is", text.clone()),
            ("no end of line at its end", text.trim_end().to_owned()),
            (
                "carriage returns, blank lines",
                format!("\n\r\n{}", text.replace('\n', "\r\n\n")),
            ),
            ("old ends of lines", text.replace('\n', "\r")),
            (
                "old ends of lines but the last",
                text.trim_end().replace('\n', "\r") + "\n",
            ),
            (
                "contacts, bad rows and quality",
                change(&|number, line| match number {
                    0 => format!(
                        "{line},contact/hand/active,l_arm_ft_sensor/quality,l_elbow/quality,\
                         what/is/this"
                    ),
                    _ if number % 17 == 3 => "no row".into(),
                    _ if number % 9 == 4 => {
                        format!("{line},{},0,{},", number % 2, 2 * (number % 3))
                    }
                    _ => format!("{line},,,,1"),
                }),
            ),
            (
                "a quoted cell of two lines",
                change(&|number, line| match number {
                    0 => format!("{line},note"),
                    200 => format!("{line},\"one\n1,2,3\""),
                    _ => format!("{line},"),
                }),
            ),
            ("quoted names", text.replacen('t', "\"t\"", 1)),
            (
                "no stamps",
                change(&|number, line| {
                    if number == 0 {
                        line.into()
                    } else {
                        without_stamp(line)
                    }
                }),
            ),
            (
                "stamps that end",
                change(&|number, line| {
                    if number < 250 {
                        line.into()
                    } else {
                        without_stamp(line)
                    }
                }),
            ),
            ("no rows", text.lines().take(1).collect()),
            (
                "no good row",
                change(&|number, line| if number == 0 { line.into() } else { "x".into() }),
            ),
            ("nothing", String::new()),
        ];
        for (what, log) in cases {
            let outcome = |read: Result<Recording, SampleLogError>| match read {
                Ok(recording) => format!("{recording:?}"),
                Err(error) => error.to_string(),
            };
            let expected = outcome(read_whole(&robot, &log));
            for (block, segment) in [(700, 300), (5000, 1), (5000, 900), (BLOCK, SEGMENT)] {
                let found = outcome(read_in_segments(&robot, log.as_bytes(), block, segment));
                assert!(
                    found == expected,
                    "{what}, {block}, {segment}: {found:.300} instead of {expected:.300}"
                );
            }
        }
    }
}
