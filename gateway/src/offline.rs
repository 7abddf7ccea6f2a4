//! Converts a recorded log to a table of samples and back: `proprio decode` and `proprio encode`.
//! No daemon, no clock.

use crate::devices::BusDevices;
use crate::joints::Inverse;
use crate::link::replay::{self, Matching};
use crate::log::{self, LogFormat, Stamps, candump};
use crate::plan::{BusPlan, ChannelPlan, DevicePlan, Plan};
use crate::status::BusStatus;
use proprio_drivers::{Board, Format, Frame, Frames, Mode};
use proprio_topics::csv::{self, Columns, Series, SeriesKind, SeriesValue, Value};
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading, Refusal, Sample, StampKind};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt::Display;
use std::io::{self, BufRead, Write};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// Maximum delay of a sample that is still sorted into its place in the table. Samples can be late
/// because a wrench has the stamp of its first frame but is complete only with its second.
const REORDER: Nanos = log::REORDER;

/// Why a log or table cannot be converted at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConversionError {
    /// A file could not be read or written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The table cannot be read.
    #[error(transparent)]
    Table(#[from] csv::TableError),
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
    /// What a person should be told if the one bus takes the frames of several interfaces.
    pub several: Option<String>,
    /// What a person should be told if the clock of the log was set back.
    pub step_back: Option<String>,
    /// Of these, frames of an interface that is no bus of the configuration.
    pub other_interfaces: u64,
    /// The names of those interfaces, at most eight.
    pub other_names: Vec<String>,
    /// Of these, frames that no device claims.
    pub unclaimed: u64,
    /// Of these, error frames of the interface.
    pub error_frames: u64,
    /// Frames that were lost while recording, as the log says.
    pub dropped: u64,
    /// Samples written.
    pub samples: u64,
    /// Samples that were too late to be sorted: the table is out of order there.
    pub out_of_order: u64,
    /// The log's format.
    pub format: Option<LogFormat>,
    /// Lines (or objects of a BLF file) that cannot be read.
    pub bad_lines: u64,
    /// The first of them, with number and error.
    pub bad: Vec<String>,
    /// The meaning of relative stamps; [`Stamps::Detect`] if there are none.
    pub stamps: Stamps,
    /// What a person should be told if that is a guess: it can be stated with `--stamps`.
    pub doubt: Option<String>,
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
    /// Why its readings lack a value that it sends, if they do.
    pub lack: Option<String>,
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
        write: impl FnMut(Nanos, &T) -> io::Result<()>,
    ) -> io::Result<()> {
        self.out_of_order += u64::from(t < self.passed_on);
        self.newest = self.newest.max(t);
        let place = self.waiting.iter().rposition(|(other, _)| *other <= t);
        self.waiting.insert(place.map_or(0, |i| i + 1), (t, item));
        self.advance(self.newest, write)
    }

    /// Calls `write` for the items that are due at `now`, in order: nothing earlier comes any more.
    ///
    /// # Errors
    /// The first of `write`.
    pub fn advance(
        &mut self,
        now: Nanos,
        mut write: impl FnMut(Nanos, &T) -> io::Result<()>,
    ) -> io::Result<()> {
        while let Some((first, item)) = self.waiting.front()
            && now - *first > self.window
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
        for (t, item) in self.waiting.drain(..) {
            self.passed_on = self.passed_on.max(t);
            write(t, &item)?;
        }
        Ok(())
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
/// Each bus takes the frames of its own interface; if the plan has one bus, whose interface is not
/// in the log, it takes those of all.
///
/// # Errors
/// [`ConversionError`]: a file that cannot be read or written, or a log without a frame.
pub fn decode(
    plan: &Plan,
    log: impl BufRead,
    table: impl Write,
    columns: Columns,
) -> Result<DecodeReport, ConversionError> {
    decode_with(plan, log, Stamps::Detect, table, columns)
}

/// As [`decode`], with the meaning of relative stamps stated.
///
/// # Errors
/// As [`decode`].
pub fn decode_with(
    plan: &Plan,
    log: impl BufRead,
    stamps: Stamps,
    table: impl Write,
    columns: Columns,
) -> Result<DecodeReport, ConversionError> {
    let series: Vec<Series> = (plan.channels.iter())
        .map(|c| Series {
            kind: SeriesKind::Channel(c.kind),
            name: c.name.clone(),
        })
        .collect();
    let mut writer = csv::TableWriter::new(table, &series, columns)?;
    let mut reader = log::LogReader::with_stamps(log, stamps);
    let mut buses = LogBuses::open(plan, &mut reader)?;
    let mut report = DecodeReport::default();
    let mut order = InOrder::new(REORDER);
    let mut failure = None;
    while let Some(record) = reader.next_record()? {
        report.frames += 1;
        if record.frame.format == Format::Error {
            report.error_frames += 1;
            continue;
        }
        let Some(devices) = buses.devices(record.interface) else {
            report.other_interface(record.interface);
            continue;
        };
        // As live: the devices see the time pass, so that silences are seen.
        if record.frame.stamp != StampKind::None {
            devices.poll_transmit(record.frame.t, |_, _| {});
        }
        devices.on_frame(&record.frame, |sample| {
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
    if report.frames == 0 {
        return Err(ConversionError::NoFrame(reader.why_empty()));
    }
    report.out_of_order = order.out_of_order();
    (report.bad_lines, report.dropped) = (reader.report().bad, reader.report().dropped);
    report.format = reader.format();
    report.step_back = reader.step_back();
    report.bad = reader.bad().collect();
    (report.stamps, report.doubt) = (reader.stamps(), reader.doubt(log::STAMPS_OPTION));
    if buses.all.iter().any(|bus| bus.matching.is_none()) {
        report.several = replay::several(reader.interfaces());
    }
    for (bus, plan) in buses.all.iter().zip(&plan.buses) {
        report.unclaimed += bus.status.unclaimed.load(Relaxed);
        report.devices.extend(bus.reports(plan));
    }
    Ok(report)
}

/// A bus of the plan, and which frames of the log are its.
struct LogBus {
    /// `None`: all.
    matching: Option<Matching>,
    devices: BusDevices,
    status: Arc<BusStatus>,
}

impl LogBus {
    fn takes(&self, interface: &str) -> bool {
        self.matching.as_ref().is_none_or(|m| m.takes(interface))
    }

    /// The results per device.
    fn reports(&self, plan: &BusPlan) -> impl Iterator<Item = DeviceReport> {
        let devices = plan.devices.iter().zip(self.status.devices());
        devices
            .zip(self.devices.states())
            .map(|((device, health), state)| {
                let counters = Counter::ALL.into_iter();
                let others = counters.skip(2).map(|c| (c, health.count(c)));
                DeviceReport {
                    name: device.name.clone(),
                    frames: health.count(Counter::Frames),
                    readings: health.count(Counter::Readings),
                    counts: others.filter(|(_, n)| *n > 0).collect(),
                    refusal: state.refusal().map(|refusal| refusal.to_string()),
                    lack: Refusal::from_code(health.refusal)
                        .filter(|_| state.refusal().is_none())
                        .map(|lack| lack.to_string()),
                }
            })
    }
}

/// The buses that share a log.
struct LogBuses {
    all: Vec<LogBus>,
    /// That of the last frame: frames of one interface come in series.
    last: usize,
}

impl LogBuses {
    fn open(
        plan: &Plan,
        reader: &mut log::LogReader<impl BufRead>,
    ) -> Result<Self, ConversionError> {
        let mut all = Vec::new();
        for (bus, number) in plan.buses.iter().zip(0..) {
            let status = Arc::new(BusStatus::new(number, bus));
            let devices = BusDevices::new(number, bus, Some(Mode::Listen), Arc::clone(&status));
            let devices = devices.map_err(|cause| ConversionError::Device {
                device: bus.name.clone(),
                cause,
            })?;
            let matching = plan.matching(number as usize);
            let matching = matching.map_or(Ok(None), |matching| matching.in_log(reader))?;
            all.push(LogBus {
                matching,
                devices,
                status,
            });
        }
        Ok(Self { all, last: 0 })
    }

    /// The devices of the bus that takes the frames of this interface.
    fn devices(&mut self, interface: &str) -> Option<&mut BusDevices> {
        let takes = |bus: &LogBus| bus.takes(interface);
        if !self.all.get(self.last).is_some_and(takes) {
            self.last = self.all.iter().position(takes)?;
        }
        self.all.get_mut(self.last).map(|bus| &mut bus.devices)
    }
}

impl DecodeReport {
    fn other_interface(&mut self, name: &str) {
        self.other_interfaces += 1;
        let names = &mut self.other_names;
        if names.len() < 8 && names.iter().all(|known| known != name) {
            names.push(name.to_owned());
        }
    }
}

fn write_sample<W: Write>(writer: &mut csv::TableWriter<W>, sample: &Sample) -> io::Result<()> {
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
    pub table: csv::TableReport,
}

impl EncodeReport {
    /// Notes why a sample of this line is refused, if it is the first one.
    fn reason(&mut self, line: u64, error: &dyn Display) {
        self.first_refusal
            .get_or_insert_with(|| format!("line {line}: {error}"));
    }
}

/// The frames of an encoded log, sorted by their stamps.
struct EncodedLog<'p, W> {
    /// Per bus.
    interfaces: Vec<&'p str>,
    waiting: VecDeque<(Nanos, usize, Frame)>,
    frames: u64,
    out: W,
}

impl<W: Write> EncodedLog<'_, W> {
    /// Adds the frames of a reading of instant `t`, at intervals of `spacing`.
    fn push(
        &mut self,
        t: Option<Nanos>,
        bus: usize,
        frames: &Frames,
        spacing: Nanos,
    ) -> io::Result<()> {
        let interface = self.interfaces.get(bus).unwrap_or(&"can0");
        let mut next = t.unwrap_or(Nanos::ZERO);
        for frame in frames {
            self.frames += 1;
            if t.is_none() {
                // The log format without a stamp: only the order is known.
                writeln!(self.out, "{interface} {frame}")?;
                continue;
            }
            let last = self.waiting.iter().rposition(|(other, ..)| *other <= next);
            self.waiting
                .insert(last.map_or(0, |i| i + 1), (next, bus, *frame));
            next += spacing;
        }
        Ok(())
    }

    /// Writes the frames before `t`.
    fn write_before(&mut self, t: Option<Nanos>) -> io::Result<()> {
        while let Some((stamp, bus, frame)) = self.waiting.front()
            && t.is_some_and(|t| *stamp < t)
        {
            let interface = self.interfaces.get(*bus).unwrap_or(&"can0");
            candump::write_log_line(&mut self.out, *stamp, interface, frame)?;
            self.waiting.pop_front();
        }
        Ok(())
    }
}

/// Approximate duration of a frame on the bus: the interval between the frames of one reading in an
/// encoded log.
const FRAME_TIME: Nanos = Nanos::from_micros(130);

/// Where a joint's state goes in a log: to an output of a device, which measures it.
struct JointOutput {
    bus: usize,
    device: usize,
    number: u8,
    inverse: Inverse,
    /// Its reading completes a sample, and follows those that do not.
    completes: bool,
}

/// The outputs that measure the plan's joints, in the order in which a row's readings are encoded.
fn joint_outputs(plan: &Plan) -> Vec<JointOutput> {
    let mut all = Vec::new();
    for (bus, bus_plan) in plan.buses.iter().enumerate() {
        for (device, device_plan) in bus_plan.devices.iter().enumerate() {
            for output in &device_plan.outputs {
                let Some(input) = &output.input else { continue };
                let inverse = bus_plan.joints.inverse(input, output.map);
                all.extend(inverse.map(|inverse| JointOutput {
                    bus,
                    device,
                    number: output.number,
                    inverse,
                    completes: bus_plan.joints.completes(input),
                }));
            }
        }
    }
    all.sort_by_key(|output| output.completes);
    all
}

/// The joints of a row: state and quality by channel.
type RowJoints = BTreeMap<u32, (JointState, Quality)>;

impl JointOutput {
    /// What the device reports of the joints of a row. `None`: it measures none of them. An error:
    /// not all of them are there.
    fn reading(&self, joints: &RowJoints) -> Option<Result<(Reading, Quality), &'static str>> {
        let channels = self.inverse.channels.iter();
        let states: Vec<_> = channels
            .filter_map(|channel| joints.get(channel).copied())
            .collect();
        if states.is_empty() {
            return None;
        }
        if states.len() < self.inverse.channels.len() {
            return Some(Err("the joints of a coupling must be in one row"));
        }
        let of_joints: Vec<JointState> = states.iter().map(|(state, _)| *state).collect();
        // A flag of all joints that it moves may be its own. Those of an encoder are of the device
        // that gives the position.
        let moved = states
            .iter()
            .enumerate()
            .filter(|(place, _)| self.inverse.moves(*place));
        let common = moved.fold(u32::MAX, |common, (_, (_, quality))| common & quality.0);
        let quality = match self.completes {
            true => common,
            false => common & Quality::DRIVE_FAULT.0,
        };
        let state = self.inverse.device(self.inverse.shaft(&of_joints));
        Some(Ok((Reading::Joint(state), Quality(quality))))
    }
}

/// Encodes a table of samples as a CAN log, through the drivers' own encoders: the inverse of
/// [`decode`].
///
/// A reading's first frame has the row's stamp; the others follow at the duration of a frame. Where
/// several devices measure one joint, the readings that its sample carries along come before the
/// one that makes it, all with the row's stamp.
///
/// # Errors
/// [`ConversionError`]: a file that cannot be read or written, or a device that cannot be built.
pub fn encode(
    plan: &Plan,
    table: impl io::Read,
    mut log: impl Write,
) -> Result<EncodeReport, ConversionError> {
    let mut reader = csv::TableReader::new(table)?;
    let mut encoder = TableEncoder::new(plan, &mut log)?;
    // Per series, its channel.
    let channels: Vec<_> = (reader.series().iter())
        .map(|series| encoder.channel(series))
        .collect();
    let mut row = csv::Row::default();
    let mut joints = RowJoints::new();
    while reader.next_row(&mut row)? {
        joints.clear();
        for SeriesValue { series, value } in &row.items {
            let (Some(Some((number, channel))), Value::Reading(reading, quality)) =
                (channels.get(*series), value)
            else {
                continue;
            };
            match reading {
                Reading::Joint(state) => drop(joints.insert(*number, (*state, *quality))),
                _ => encoder.sensor(&row, (*number, channel), reading, *quality)?,
            }
        }
        encoder.joints(&row, &joints)?;
        encoder.log.write_before(row.t.map(|now| now - REORDER))?;
    }
    encoder.log.write_before(Some(Nanos::MAX))?;
    let TableEncoder {
        mut report,
        log: written,
        ..
    } = encoder;
    report.frames = written.frames;
    log.flush()?;
    report.table = reader.report().clone();
    Ok(report)
}

/// Encodes the rows of a table.
struct TableEncoder<'p, W> {
    plan: &'p Plan,
    /// Per bus and device.
    boards: Vec<Vec<Box<dyn Board>>>,
    joint_outputs: Vec<JointOutput>,
    frames: Frames,
    log: EncodedLog<'p, W>,
    report: EncodeReport,
}

impl<'p, W: Write> TableEncoder<'p, W> {
    fn new(plan: &'p Plan, log: W) -> Result<Self, ConversionError> {
        let board = |device: &DevicePlan| {
            // Nobody has started it: it encodes what the table holds, not a stream.
            let board = device.options.board(&device.spec.in_mode(Mode::Supervise));
            board.map_err(|cause| ConversionError::Device {
                device: device.name.clone(),
                cause,
            })
        };
        let boards = (plan.buses.iter())
            .map(|bus| bus.devices.iter().map(board).collect())
            .collect::<Result<_, _>>()?;
        Ok(Self {
            plan,
            boards,
            joint_outputs: joint_outputs(plan),
            frames: Frames::new(),
            log: EncodedLog {
                interfaces: plan.buses.iter().map(BusPlan::interface).collect(),
                waiting: VecDeque::new(),
                frames: 0,
                out: log,
            },
            report: EncodeReport::default(),
        })
    }

    /// The channel of a series, with its number.
    fn channel(&mut self, series: &Series) -> Option<(u32, &'p ChannelPlan)> {
        let is_it =
            |c: &&ChannelPlan| SeriesKind::Channel(c.kind) == series.kind && c.name == series.name;
        let channel = self.plan.channels.iter().find(is_it);
        if channel.is_none() && series.kind != SeriesKind::Contact {
            self.report.unknown_channels.push(series.name.clone());
        }
        let channel = channel?;
        Some((self.plan.channel(&channel.name)?, channel))
    }

    /// Encodes a sensor's reading.
    fn sensor(
        &mut self,
        row: &csv::Row,
        (number, channel): (u32, &ChannelPlan),
        reading: &Reading,
        quality: Quality,
    ) -> io::Result<()> {
        let device =
            (self.plan.buses.get(channel.bus)).and_then(|bus| bus.devices.get(channel.device));
        let output = device.and_then(|d| d.outputs.iter().find(|o| o.channel == number));
        let board =
            (self.boards.get_mut(channel.bus)).and_then(|boards| boards.get_mut(channel.device));
        let (Some(output), Some(board)) = (output, board) else {
            return Ok(());
        };
        self.frames.clear();
        if let Err(error) = board.encode(output.number, reading, quality, &mut self.frames) {
            self.report.refused += 1;
            self.report.reason(row.line, &error);
            return Ok(());
        }
        self.report.samples += 1;
        (self.log).push(row.t, channel.bus, &self.frames, FRAME_TIME)
    }

    /// Encodes the readings of all devices that measure the joints of a row.
    fn joints(&mut self, row: &csv::Row, joints: &RowJoints) -> io::Result<()> {
        let mut refused = BTreeSet::new();
        for output in &self.joint_outputs {
            let Some(reading) = output.reading(joints) else {
                continue;
            };
            let board =
                (self.boards.get_mut(output.bus)).and_then(|boards| boards.get_mut(output.device));
            let Some(board) = board else { continue };
            self.frames.clear();
            let encoded = (reading.map_err(str::to_owned)).and_then(|(reading, quality)| {
                let encoded = board.encode(output.number, &reading, quality, &mut self.frames);
                encoded.map_err(|error| error.to_string())
            });
            if let Err(error) = encoded {
                let channels = output.inverse.channels.iter().copied();
                refused.extend(channels.filter(|channel| joints.contains_key(channel)));
                self.report.reason(row.line, &error);
                continue;
            }
            let spacing = match output.completes {
                true => FRAME_TIME,
                false => Nanos::ZERO,
            };
            (self.log).push(row.t, output.bus, &self.frames, spacing)?;
        }
        self.report.refused += refused.len() as u64;
        self.report.samples += (joints.len() - refused.len()) as u64;
        Ok(())
    }
}
