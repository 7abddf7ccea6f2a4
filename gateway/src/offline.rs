//! Converts a recorded log to a table of samples and back: `proprio decode` and `proprio encode`.
//! No daemon, no clock.

use crate::candump;
use crate::config::Source;
use crate::decoder::Decoder;
use crate::link::adapter::Adapter;
use crate::link::replay::Matching;
use crate::plan::{BusPlan, Plan};
use crate::status::BusStatus;
use proprio_drivers::{Board, Format, Frame, Frames, Mode, Spec};
use proprio_topics::csv::{self, Columns, Item, Series, Value, What};
use proprio_topics::{Counter, Nanos, Reading, Sample, StampKind};
use std::collections::VecDeque;
use std::io::{self, BufRead, Write};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// Maximum delay of a sample that is still sorted into its place in the table. Samples can be late
/// because a wrench has the stamp of its first frame but is complete only with its second.
const REORDER: Nanos = candump::REORDER;

/// Why a log or table cannot be converted at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OfflineError {
    /// A file could not be read or written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The table cannot be read.
    #[error(transparent)]
    Table(#[from] csv::Error),
    /// A device cannot be built.
    #[error("{device}: {cause}")]
    Device {
        /// Its name.
        device: String,
        /// Why.
        cause: proprio_drivers::SpecError,
    },
    /// The log holds no frame.
    #[error("the log holds no frame; {0}")]
    NoFrame(String),
}

/// The result of decoding a log.
#[derive(Debug, Clone, Default)]
pub struct DecodeReport {
    /// Frames in the log.
    pub frames: u64,
    /// Of these, frames of an interface that is no bus of the configuration.
    pub other_interfaces: u64,
    /// Of these, frames that no device claims.
    pub unclaimed: u64,
    /// Of these, error frames of the interface.
    pub error_frames: u64,
    /// Frames that candump reports as lost while recording.
    pub dropped: u64,
    /// Samples written.
    pub samples: u64,
    /// Samples that were too late to be sorted: the table is out of order there.
    pub out_of_order: u64,
    /// Lines that are not frames.
    pub bad_lines: u64,
    /// The first bad lines, with line number and error.
    pub bad: Vec<String>,
    /// The result per device.
    pub devices: Vec<DeviceReport>,
}

/// The result of decoding one device's frames.
#[derive(Debug, Clone)]
pub struct DeviceReport {
    /// Its name.
    pub name: String,
    /// Frames with its identifiers.
    pub frames: u64,
    /// Its readings.
    pub readings: u64,
    /// The other counters.
    pub counts: Vec<(Counter, u64)>,
    /// Why it was refused, if it was.
    pub refusal: Option<String>,
}

/// Delays items until no earlier one can come, so that a table is sorted by time.
#[derive(Debug)]
pub struct InOrder<T> {
    waiting: VecDeque<(Nanos, T)>,
    window: Nanos,
    newest: Nanos,
    passed_on: Nanos,
    out_of_order: u64,
}

impl<T> InOrder<T> {
    /// Delays items until others are later by `window` \[ns\].
    #[must_use]
    pub const fn new(window: Nanos) -> Self {
        Self {
            waiting: VecDeque::new(),
            window,
            newest: Nanos::MIN,
            passed_on: Nanos::MIN,
            out_of_order: 0,
        }
    }

    /// Adds an item of instant `t`; calls `write` for those that are due, in order.
    ///
    /// # Errors
    /// The first of `write`.
    pub fn push(
        &mut self,
        t: Nanos,
        item: T,
        mut write: impl FnMut(Nanos, &T) -> io::Result<()>,
    ) -> io::Result<()> {
        self.out_of_order += u64::from(t < self.passed_on);
        self.newest = self.newest.max(t);
        let place = self.waiting.iter().rposition(|(other, _)| *other <= t);
        self.waiting.insert(place.map_or(0, |i| i + 1), (t, item));
        while let Some((first, item)) = self.waiting.front()
            && self.newest - *first > self.window
        {
            self.passed_on = self.passed_on.max(*first);
            write(*first, item)?;
            self.waiting.pop_front();
        }
        Ok(())
    }

    /// Writes what still waits, in order.
    ///
    /// # Errors
    /// The first of `write`.
    pub fn finish(&mut self, mut write: impl FnMut(Nanos, &T) -> io::Result<()>) -> io::Result<()> {
        self.waiting
            .drain(..)
            .try_for_each(|(t, item)| write(t, &item))
    }

    /// The instant of the last item written: an earlier one would be out of order.
    #[must_use]
    pub const fn passed_on(&self) -> Nanos {
        self.passed_on
    }

    /// Number of items that came too late to be sorted.
    #[must_use]
    pub const fn out_of_order(&self) -> u64 {
        self.out_of_order
    }
}

/// Decodes a log to a table of samples.
///
/// If the plan has one bus, it takes the frames of all interfaces; with several, each takes the
/// frames of its own interface.
///
/// # Errors
/// [`OfflineError`]: a file that cannot be read or written, or a log without a frame.
pub fn decode(
    plan: &Plan,
    log: impl BufRead,
    table: impl Write,
    columns: Columns,
) -> Result<DecodeReport, OfflineError> {
    let series: Vec<Series> = plan
        .channels
        .iter()
        .map(|c| Series {
            what: What::Channel(c.kind),
            name: c.name.clone(),
        })
        .collect();
    let mut writer = csv::Writer::new(table, &series, columns)?;
    let mut buses = Vec::new();
    for (bus, number) in plan.buses.iter().zip(0..) {
        let status = Arc::new(BusStatus::new(number, bus));
        let decoder = Decoder::new(number, bus, Some(Mode::Listen), Arc::clone(&status)).map_err(
            |cause| OfflineError::Device {
                device: bus.name.clone(),
                cause,
            },
        )?;
        buses.push((plan.matching(number as usize), decoder, status));
    }
    let mut report = DecodeReport::default();
    let mut order = InOrder::new(REORDER);
    let mut failure = None;
    let mut reader = candump::Reader::new(log);
    let mut last_bus = 0;
    let takes = |matching: &Option<Matching>, interface: &str| {
        matching.as_ref().is_none_or(|m| m.takes(interface))
    };
    while let Some(record) = reader.next_record()? {
        report.frames += 1;
        if record.frame.format == Format::Error {
            report.error_frames += 1;
            continue;
        }
        // Frames of one interface come in series: try the bus of the last frame first.
        if buses
            .get(last_bus)
            .is_none_or(|(matching, ..)| !takes(matching, record.interface))
        {
            match buses
                .iter()
                .position(|(matching, ..)| takes(matching, record.interface))
            {
                Some(bus) => last_bus = bus,
                None => {
                    report.other_interfaces += 1;
                    continue;
                }
            }
        }
        let Some((_, decoder, _)) = buses.get_mut(last_bus) else {
            continue;
        };
        // As live: the devices see the time pass, so that silences are seen.
        if record.frame.stamp != StampKind::None {
            decoder.poll_transmit(record.frame.t, |_, _| {});
        }
        decoder.on_frame(&record.frame, |sample| {
            let (t, mut write) = (sample.header.acquired, |s: &Sample| {
                write_sample(&mut writer, s)
            });
            let written = match sample.header.stamp == StampKind::None {
                true => write(sample),
                false => order.push(t, *sample, |_, s| write(s)),
            };
            if let Err(error) = written {
                failure.get_or_insert(error);
            }
            report.samples += 1;
        });
        if let Some(error) = failure.take() {
            return Err(error.into());
        }
    }
    order.finish(|_, sample| write_sample(&mut writer, sample))?;
    writer.finish()?;
    report.out_of_order = order.out_of_order();
    (report.bad_lines, report.dropped) = (reader.report().bad, reader.report().dropped);
    report.bad = reader
        .report()
        .first_bad
        .iter()
        .map(|(line, error)| format!("line {line}: {error}"))
        .collect();
    if report.frames == 0 {
        let why = report.bad.first().map_or_else(
            || "it is empty".to_owned(),
            |bad| format!("the first bad line: {bad}"),
        );
        return Err(OfflineError::NoFrame(why));
    }
    for ((_, decoder, status), bus) in buses.iter().zip(&plan.buses) {
        report.unclaimed += status.unclaimed.load(Relaxed);
        for ((device, health), state) in bus
            .devices
            .iter()
            .zip(status.devices())
            .zip(decoder.states())
        {
            let count = |c: Counter| health.counters.get(c as usize).copied().unwrap_or(0);
            report.devices.push(DeviceReport {
                name: device.name.clone(),
                frames: count(Counter::Frames),
                readings: count(Counter::Readings),
                counts: Counter::ALL
                    .into_iter()
                    .skip(2)
                    .map(|c| (c, count(c)))
                    .filter(|(_, n)| *n > 0)
                    .collect(),
                refusal: state.refusal().map(|refusal| refusal.to_string()),
            });
        }
    }
    Ok(report)
}

fn write_sample<W: Write>(writer: &mut csv::Writer<W>, sample: &Sample) -> io::Result<()> {
    let t = (sample.header.stamp != StampKind::None).then_some(sample.header.acquired);
    let Some(reading) = sample.reading() else {
        return Ok(());
    };
    let value = Value::Reading(reading, sample.header.quality);
    writer.push(t, sample.channel as usize, &value)
}

/// The result of encoding a table.
#[derive(Debug, Clone, Default)]
pub struct EncodeReport {
    /// Frames written.
    pub frames: u64,
    /// Samples in these frames.
    pub samples: u64,
    /// Samples that their device cannot send.
    pub refused: u64,
    /// Line and reason of the first of them.
    pub first_refusal: Option<String>,
    /// Channels of the table that are not in the configuration.
    pub unknown_channels: Vec<String>,
    /// The report of the table's reader.
    pub table: csv::Report,
}

/// Approximate duration of a frame on the bus: the interval between the frames of one reading in an
/// encoded log.
const FRAME_TIME: Nanos = Nanos::from_micros(130);

/// Encodes a table of samples as a CAN log, through the drivers' own encoders: the inverse of
/// [`decode`].
///
/// A reading's first frame has the row's stamp; the others follow at the duration of a frame.
///
/// # Errors
/// [`OfflineError`]: a file that cannot be read or written, or a device that cannot be built.
pub fn encode(
    plan: &Plan,
    table: impl io::Read,
    mut log: impl Write,
) -> Result<EncodeReport, OfflineError> {
    let mut reader = csv::Reader::new(table)?;
    let mut report = EncodeReport::default();
    // Per series: bus, device number and route.
    let mut targets = Vec::new();
    for series in reader.series() {
        let channel = plan
            .channels
            .iter()
            .find(|c| What::Channel(c.kind) == series.what && c.name == series.name);
        if channel.is_none() && series.what != What::Contact {
            report.unknown_channels.push(series.name.clone());
        }
        targets.push(channel.and_then(|channel| {
            let number = plan.channel(&channel.name)?;
            let device = plan.buses.get(channel.bus)?.devices.get(channel.device)?;
            let route = *device.routes.iter().find(|r| r.channel == number)?;
            Some((channel.bus, channel.device, route))
        }));
    }
    let mut boards: Vec<Vec<Box<dyn Board>>> = Vec::new();
    for bus in &plan.buses {
        let mut of_bus = Vec::new();
        for device in &bus.devices {
            let spec = Spec {
                // Nobody has started it: it encodes what the table holds, not a stream.
                mode: Mode::Supervise,
                ..device.spec.clone()
            };
            let board = device.options.board(&spec);
            of_bus.push(board.map_err(|cause| OfflineError::Device {
                device: device.name.clone(),
                cause,
            })?);
        }
        boards.push(of_bus);
    }
    let interfaces: Vec<&str> = plan.buses.iter().map(interface).collect();
    let mut waiting: VecDeque<(Nanos, usize, Frame)> = VecDeque::new();
    let mut row = csv::Row::default();
    let mut frames = Frames::new();
    while reader.next_row(&mut row)? {
        for Item { series, value } in &row.items {
            let (Some(Some((bus, device, route))), Value::Reading(reading, quality)) =
                (targets.get(*series), value)
            else {
                continue;
            };
            let Some(board) = boards.get_mut(*bus).and_then(|b| b.get_mut(*device)) else {
                continue;
            };
            let reading = match reading {
                Reading::Joint(state) => Reading::Joint(route.map.device(*state)),
                other => *other,
            };
            frames.clear();
            if let Err(error) = board.encode(route.output, &reading, *quality, &mut frames) {
                report.refused += 1;
                report
                    .first_refusal
                    .get_or_insert_with(|| format!("line {}: {error}", row.line));
                continue;
            }
            report.samples += 1;
            let mut t = row.t.unwrap_or(Nanos::ZERO);
            for frame in &frames {
                report.frames += 1;
                if row.t.is_none() {
                    // The log format without a stamp: only the order is known.
                    writeln!(log, "{} {frame}", interfaces.get(*bus).unwrap_or(&"can0"))?;
                    continue;
                }
                let at = waiting
                    .iter()
                    .rposition(|(other, ..)| *other <= t)
                    .map_or(0, |i| i + 1);
                waiting.insert(at, (t, *bus, *frame));
                t += FRAME_TIME;
            }
        }
        while let Some((t, bus, frame)) = waiting.front()
            && row.t.is_some_and(|now| now - *t > REORDER)
        {
            candump::write_log_line(&mut log, *t, interfaces.get(*bus).unwrap_or(&"can0"), frame)?;
            waiting.pop_front();
        }
    }
    for (t, bus, frame) in waiting {
        candump::write_log_line(&mut log, t, interfaces.get(bus).unwrap_or(&"can0"), &frame)?;
    }
    log.flush()?;
    report.table = reader.report().clone();
    Ok(report)
}

/// The interface name of `bus` in a log.
fn interface(bus: &BusPlan) -> &str {
    match &bus.source {
        Source::SocketCan(Adapter::Interface(name)) | Source::Virtual { name } => name,
        Source::SocketCan(_) | Source::Replay { .. } => &bus.name,
    }
}
