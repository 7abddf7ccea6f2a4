//! A log's text to its channels, on all cores: blocks of text are cut between lines, the pieces read each by itself, and what they hold is put together in order.
//!
//! What is cut does not depend on how many cores there are. Where a line's end need not be that of a row (a quoted cell may hold one), and where rows have no stamps and so are counted, the
//! rest of a log is read row by row.

use super::defects::{self, Repeats};
use super::{Recording, RecordingError, Stream};
use crate::identify::parallel;
use crate::setup::{Setup, Use};
use proprio_topics::Nanos;
use proprio_topics::csv::{self, Item, Reader, Row, Value, What};
use std::io::Read;
use std::ops::Range;

/// Text that is read at a time, and of it what one thread takes, about [bytes].
const BLOCK: usize = 4 << 20;
const PIECE: usize = 256 << 10;

#[derive(Clone, Copy)]
enum Target {
    Channel(usize),
    Contact(usize),
}

/// What rows hold.
#[derive(Clone)]
struct Part {
    recording: Recording,
    repeats: Repeats,
    /// How far rows without stamps are apart.
    apart: Nanos,
}

/// Reads a log ([`Recording::read`]).
pub(super) fn read(setup: &Setup, log: impl Read) -> Result<Recording, RecordingError> {
    read_cut(setup, log, BLOCK, PIECE)
}

/// The same with other sizes of blocks and pieces.
fn read_cut(setup: &Setup, mut log: impl Read, block: usize, piece: usize) -> Result<Recording, RecordingError> {
    let mut text = Vec::new();
    let mut ended = fill(&mut text, &mut log, block)?;
    let Some((header, mut before)) = header(&text) else {
        let mut rows = Reader::new(text.chain(log))?;
        let (mut part, targets) = Part::new(setup, &rows)?;
        part.take(&mut rows, &targets)?;
        return part.settled(setup);
    };
    let header: Vec<u8> = text.drain(..header).collect();
    let table = Reader::new(header.as_slice())?;
    let (mut all, targets) = Part::new(setup, &table)?;
    let empty = all.clone();
    all.recording.report = table.report().clone();
    loop {
        let end = if ended { text.len() } else { whole_lines(&text) };
        let pieces = pieces(&text[..end], piece);
        let parts = parallel::map(pieces.len(), |number| -> Result<Option<(Part, u64)>, csv::Error> {
            let piece = &text[pieces[number].clone()];
            // Nothing where the log can not be cut.
            if piece.contains(&b'"') {
                return Ok(None);
            }
            let mut part = empty.clone();
            part.take(&mut table.further(piece), &targets)?;
            Ok(part.recording.stamped.then(|| (part, lines(piece))))
        });
        let parts: Option<Vec<(Part, u64)>> = parts.into_iter().collect::<Result<_, _>>()?;
        let Some(parts) = parts.filter(|_| end > 0 || ended) else {
            let mut rest = empty;
            rest.take(&mut table.further(text.chain(log)), &targets)?;
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
    all.recording.report.usable()?;
    all.settled(setup)
}

/// Reads until there is a block of text; whether the log ended.
fn fill(text: &mut Vec<u8>, log: &mut impl Read, block: usize) -> Result<bool, csv::Error> {
    let missing = block.saturating_sub(text.len()) as u64;
    let read = log.by_ref().take(missing).read_to_end(text)?;
    Ok((read as u64) < missing)
}

/// Where the header ends, and how many lines that are; nothing if the text can not be cut there.
fn header(text: &[u8]) -> Option<(usize, u64)> {
    let mut end = 0;
    for (lines, own) in (1..).zip(text.split_inclusive(|byte| *byte == b'\n')) {
        end += own.len();
        if !own.iter().all(|byte| b"\r\n".contains(byte)) {
            // Other ends of lines than these, or names in quotes, are the parser's business.
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
    text.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1)
}

/// Pieces of whole lines, of at least `size`.
fn pieces(text: &[u8], size: usize) -> Vec<Range<usize>> {
    let mut pieces = Vec::new();
    let mut start = 0;
    while start < text.len() {
        let least = text.len().min(start + size);
        let rest = text[least..].iter().position(|byte| *byte == b'\n');
        let end = rest.map_or(text.len(), |rest| least + rest + 1);
        pieces.push(start..end);
        start = end;
    }
    pieces
}

impl Part {
    /// Of no rows; what each series of the log is, if it is anything.
    fn new(setup: &Setup, table: &Reader<impl Read>) -> Result<(Self, Vec<Option<Target>>), RecordingError> {
        let mut recording = Recording::empty(setup);
        recording.check_columns(table)?;
        let mut targets = Vec::new();
        for series in table.series() {
            let target = match series.what {
                What::Channel(kind) => setup.channel(kind, &series.name).map(Target::Channel),
                What::Contact => setup.contact(&series.name).map(Target::Contact),
            };
            if target.is_none() {
                recording.unused.push(series.name.clone());
            }
            targets.push(target);
        }
        let repeats = Repeats::new(recording.channels.len());
        // Rows of a log without stamps are so far apart that nothing is carried from one to the next.
        let apart = setup.max_silence + setup.max_silence + Nanos(1);
        let part = Self {
            recording,
            repeats,
            apart,
        };
        Ok((part, targets))
    }

    fn take<R: Read>(&mut self, rows: &mut Reader<R>, targets: &[Option<Target>]) -> Result<(), csv::Error> {
        let (mut row, mut pseudo) = (Row::default(), Nanos::ZERO);
        while rows.next_row(&mut row)? {
            let t = row.t.unwrap_or_else(|| {
                self.recording.stamped = false;
                pseudo += self.apart;
                pseudo
            });
            for Item { series, value } in &row.items {
                match (targets.get(*series).copied().flatten(), value) {
                    (Some(Target::Channel(channel)), Value::Reading(reading, quality)) => {
                        self.repeats.see(channel, t, reading);
                        self.recording.take(channel, t, reading, *quality);
                    }
                    (Some(Target::Contact(contact)), Value::Active(active)) => {
                        if let Some(declared) = self.recording.declared.get_mut(contact) {
                            declared.push((t, *active));
                        }
                    }
                    _ => {}
                }
            }
        }
        self.recording.report = rows.report().clone();
        Ok(())
    }

    /// Adds the rows that follow these, after so many lines.
    fn append(&mut self, next: Self, lines: u64) {
        self.repeats.append(next.repeats);
        let (own, next) = (&mut self.recording, next.recording);
        for (own, next) in own.joints.iter_mut().zip(next.joints) {
            own.position.append(next.position);
            own.velocity.append(next.velocity);
            own.acceleration.append(next.acceleration);
            own.torque.append(next.torque);
        }
        let sensors = own.sensors.iter_mut().zip(next.sensors);
        sensors.for_each(|(own, next)| own.append(next));
        let temperatures = own.temperatures.iter_mut().zip(next.temperatures);
        temperatures.for_each(|(own, next)| own.extend(next));
        own.imu.proper_acceleration.append(next.imu.proper_acceleration);
        own.imu.angular_velocity.append(next.imu.angular_velocity);
        own.imu.angular_acceleration.append(next.imu.angular_acceleration);
        let declared = own.declared.iter_mut().zip(next.declared);
        declared.for_each(|(own, next)| own.extend(next));
        own.stamped &= next.stamped;
        own.report.add(next.report, lines);
    }

    /// Puts the channels in order, and looks for what is wrong with them.
    fn settled(self, setup: &Setup) -> Result<Recording, RecordingError> {
        let mut recording = self.recording;
        recording.declared.iter_mut().for_each(|d| d.sort_by_key(|(t, _)| *t));
        let temperatures = recording.temperatures.iter_mut();
        temperatures.for_each(|own| own.sort_by_key(|(t, _)| *t));
        defects::settle(&mut recording, setup, self.repeats);
        recording.span();
        for channel in &recording.channels {
            let empty = match channel.role {
                Use::Joint(dof) => recording.joints.get(dof).is_none_or(|j| j.position.t.is_empty()),
                Use::Base => {
                    recording.imu.proper_acceleration.t.is_empty() || recording.imu.angular_velocity.t.is_empty()
                }
                Use::Sensor(_) => false,
            };
            if empty {
                return Err(RecordingError::NoSamples(format!(
                    "{}/{}",
                    channel.kind.word(),
                    channel.name
                )));
            }
        }
        defects::inspect(&mut recording, setup);
        Ok(recording)
    }
}

impl<const D: usize> Stream<D> {
    fn append(&mut self, mut next: Self) {
        self.t.append(&mut next.t);
        self.value.append(&mut next.value);
        self.disowned.append(&mut next.disowned);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identify::instants::tests::{log, setup};

    /// What comes of a log that is not cut.
    fn at_once(setup: &Setup, log: &str) -> Result<Recording, RecordingError> {
        let mut rows = Reader::new(log.as_bytes())?;
        let (mut part, targets) = Part::new(setup, &rows)?;
        part.take(&mut rows, &targets)?;
        part.settled(setup)
    }

    #[test]
    fn a_log_that_is_cut_says_the_same() {
        let setup = setup("[[contact]]\nname = \"touch\"\nlink = \"hand\"\npresence = \"possible\"\n");
        let mut table = log(&setup, 3.0, 50.0, 0.1, 0.0, 1);
        // Rows that repeat the one before, some with its stamp; stamps that go backward.
        for row in (7..300).step_by(11) {
            table.rows[row] = table.rows[row - 1].clone();
            table.rows[row + 1].1 = table.rows[row].1.clone();
            table.rows[row + 3].0 -= 25_000_000;
        }
        let text = table.text();
        let change = |what: &dyn Fn(usize, &str) -> String| -> String {
            text.lines()
                .enumerate()
                .map(|(number, line)| what(number, line) + "\n")
                .collect()
        };
        let without_stamp = |line: &str| line.find(',').map_or(String::new(), |comma| line[comma..].to_owned());
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
                    0 => format!("{line},contact/touch/active,ft/quality,elbow/quality,what/is/this"),
                    _ if number % 17 == 3 => "no row".into(),
                    _ if number % 9 == 4 => format!("{line},{},0,{},", number % 2, 2 * (number % 3)),
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
                change(&|number, line| if number == 0 { line.into() } else { without_stamp(line) }),
            ),
            (
                "stamps that end",
                change(&|number, line| if number < 250 { line.into() } else { without_stamp(line) }),
            ),
            ("no rows", text.lines().take(1).collect()),
            (
                "no good row",
                change(&|number, line| if number == 0 { line.into() } else { "x".into() }),
            ),
            ("nothing", String::new()),
        ];
        for (what, log) in cases {
            let told = |read: Result<Recording, RecordingError>| match read {
                Ok(recording) => format!("{recording:?}"),
                Err(error) => error.to_string(),
            };
            let expected = told(at_once(&setup, &log));
            for (block, piece) in [(700, 300), (5000, 1), (5000, 900), (BLOCK, PIECE)] {
                let own = told(read_cut(&setup, log.as_bytes(), block, piece));
                assert!(
                    own == expected,
                    "{what}, {block}, {piece}: {own:.300} instead of {expected:.300}"
                );
            }
        }
    }
}
