//! `proprio record`: what a running robot measures and feels, as the table that `identify` reads or
//! as a recording (MCAP) that viewers read, too.

mod black_box;
mod files;
mod frames;
mod gaps;
mod output;

use crate::running::interrupted;
use anyhow::bail;
use black_box::BlackBox;
use frames::RawFrames;
use gaps::Gaps;
use output::{Destination, Split, create};
use proprio_bridge::{Event, Heard, Listener};
use proprio_drivers::Frame;
use proprio_gateway::clock::realtime_offset;
use proprio_gateway::offline::InOrder;
use proprio_recording::About;
use proprio_topics::Nanos;
use proprio_topics::csv::{Columns, Series, Value};
use proprio_topics::ipc::{DomainConfig, monotonic};
use std::io;
use std::path::PathBuf;
use std::sync::atomic::Ordering::Relaxed;

/// This program, with its version.
const PROGRAM: &str = concat!("proprio ", env!("CARGO_PKG_VERSION"));
/// How late a sample is still sorted into its place in a recording: a gateway that starts publishes
/// the frames that arrived meanwhile.
const REORDER: Nanos = Nanos::from_millis(2000);
/// How often what was recorded is written to the file: a killed recorder loses no more.
const FLUSH: Nanos = Nanos::from_millis(500);
/// So many frames are taken before samples are looked at again.
const FRAMES: usize = 4096;

/// `proprio record`.
#[derive(clap::Args)]
pub(crate) struct RecordArgs {
    /// The table of samples: a new file. One that ends with .mcap is a recording of samples,
    /// torques, contacts and health, which Foxglove, PlotJuggler and `identify` read. With --ring,
    /// a folder
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite the file if it exists
    #[arg(long)]
    force: bool,
    /// The robot; default: the only one
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// End after so many seconds; default: at Ctrl-C
    #[arg(long, value_name = "N")]
    seconds: Option<f64>,
    /// Write all columns of a table, such as gauges, temperatures and what drives report, not only
    /// those of motion and load
    #[arg(long)]
    all: bool,
    /// Record the raw frames of this bus, too: can0 or virtual:NAME. Can be given several times
    #[arg(long, value_name = "BUS")]
    frames: Vec<String>,
    /// Take along this configuration (estimator.toml, gateway.toml) with the files that it names.
    /// Can be given several times. `estimate` then needs the recording alone
    #[arg(long, value_name = "FILE")]
    config: Vec<PathBuf>,
    /// Begin a new file after so many seconds: FILE_0001.mcap, FILE_0002.mcap, ...
    #[arg(long, value_name = "SECONDS", conflicts_with = "ring")]
    split: Option<f64>,
    /// Be a black box: hold the last seconds in memory, and write them to a new file in the folder
    /// --out when a torque that was valid is withheld, a device or sensor reports a fault, a bus is
    /// lost, or `proprio ctl snapshot` asks for it
    #[arg(long, value_name = "SECONDS", conflicts_with_all = ["all", "force"])]
    ring: Option<f64>,
}

impl RecordArgs {
    /// What is written; `series` are the channels and contacts that are there.
    fn output(
        &self,
        robot: &str,
        series: &[Series],
        config: &DomainConfig,
        now: Nanos,
    ) -> anyhow::Result<Destination> {
        let is_table = self.out.extension().is_none_or(|it| it != "mcap");
        if self.ring.is_none() && is_table {
            if !self.frames.is_empty() || !self.config.is_empty() || self.split.is_some() {
                bail!("--frames, --config and --split need a recording: --out FILE.mcap");
            }
            let columns = match self.all {
                true => Columns::All,
                false => Columns::Main,
            };
            let file = create(&self.out, self.force)?;
            return Ok(Destination::table(file, series, columns)?);
        }
        let about = About {
            robot: robot.to_owned(),
            program: PROGRAM.to_owned(),
            offset: realtime_offset(),
            files: files::of(&self.config)?,
        };
        let span = |seconds: f64| match seconds > 0.0 && seconds < 1e6 {
            true => Ok(Nanos::from_seconds(seconds)),
            false => bail!("{seconds} s: more than 0 and less than 1e6 s are possible"),
        };
        match (self.ring, self.split) {
            (Some(seconds), _) => Ok(Destination::BlackBox(Box::new(BlackBox::new(
                about,
                series,
                span(seconds)?,
                &self.out,
                config,
            )?))),
            (None, Some(seconds)) => {
                let split = Split::new(&self.out, self.force, span(seconds)?);
                Destination::split(split, about, series, now)
            }
            (None, None) => Destination::recording(create(&self.out, self.force)?, about, series),
        }
    }
}

/// What is recorded, in the order of time.
enum RecordItem {
    Heard(Heard),
    /// On the bus with this number.
    Frame(usize, Frame),
}

/// What was recorded.
#[derive(Default)]
struct RecordedCounts {
    samples: u64,
    torques: u64,
    frames: u64,
}

/// A recording in progress: what is heard is sorted, and written.
struct RecordingSession {
    /// The names of the buses whose frames are recorded.
    buses: Vec<String>,
    order: InOrder<RecordItem>,
    gaps: Gaps,
    counts: RecordedCounts,
    out: Destination,
}

impl RecordingSession {
    /// Something heard or a frame of `t`; `series` are all that are known by now.
    fn push(&mut self, t: Nanos, item: RecordItem, series: &[Series]) -> io::Result<()> {
        let Self {
            buses, order, out, ..
        } = self;
        order.push(t, item, |t, item| write(buses, out, t, item, series))
    }

    fn hear(&mut self, event: Event, series: &[Series]) -> io::Result<()> {
        let Event {
            mut t,
            epoch,
            heard,
        } = event;
        match &heard {
            Heard::Value(_, Value::Reading(..)) => {
                self.counts.samples += 1;
                self.gaps.see(epoch, t);
            }
            // What was declared long before arrives with the next declaration.
            Heard::Value(_, Value::Contact(_)) => t = t.max(self.order.passed_on()),
            Heard::Torques(..) => self.counts.torques += 1,
            _ => {}
        }
        self.push(t, RecordItem::Heard(heard), series)
    }

    /// Writes what no longer waits at `now` to be sorted.
    fn advance(&mut self, now: Nanos, series: &[Series]) -> io::Result<()> {
        let Self {
            buses, order, out, ..
        } = self;
        order.advance(now, |t, item| write(buses, out, t, item, series))
    }

    /// Writes all that waits.
    fn write_all(&mut self, series: &[Series]) -> io::Result<()> {
        let Self {
            buses, order, out, ..
        } = self;
        order.finish(|t, item| write(buses, out, t, item, series))
    }

    /// Tells a black box what has happened; returns whether a file of it is asked for.
    fn watch(&mut self, now: Nanos, series: &[Series]) -> io::Result<bool> {
        let is_silent = self.gaps.wait(now);
        let Destination::BlackBox(black_box) = &mut self.out else {
            return Ok(false);
        };
        if is_silent {
            black_box.happened(now, "no_samples".to_owned());
        }
        let is_asked = black_box.is_asked();
        if is_asked {
            self.write_all(series)?;
        }
        Ok(is_asked)
    }
}

fn write(
    buses: &[String],
    out: &mut Destination,
    t: Nanos,
    item: &RecordItem,
    series: &[Series],
) -> io::Result<()> {
    match item {
        RecordItem::Heard(heard) => out.push(t, heard, series),
        RecordItem::Frame(bus, frame) => {
            let bus = buses.get(*bus).map_or("", String::as_str);
            out.frame(bus, frame)
        }
    }
}

/// Records what a robot sends.
pub(crate) fn run(args: &RecordArgs, config: &DomainConfig) -> anyhow::Result<()> {
    let stop = interrupted()?;
    // Before the listener's: they come first, and wait.
    let frames = match args.frames.is_empty() {
        true => None,
        false => Some(RawFrames::open(&args.frames, config)?),
    };
    let robot = args.robot.as_deref();
    // A black box is started with the machine, perhaps before the daemons.
    let mut listener = match args.ring {
        None => Listener::open(config, robot)?,
        Some(_) => {
            let say = |why: &str| tracing::info!("waiting: {why}");
            match Listener::wait_open(config, robot, &stop, say)? {
                Some(listener) => listener,
                None => return Ok(()),
            }
        }
    };
    let began = monotonic();
    let mut session = RecordingSession {
        buses: (frames.as_ref()).map_or(Vec::new(), |frames| frames.buses.clone()),
        order: InOrder::new(REORDER),
        gaps: Gaps::new(listener.description()),
        counts: RecordedCounts::default(),
        out: args.output(listener.robot(), listener.series(), config, began)?,
    };
    let end = (args.seconds).map(|seconds| began + Nanos::from_seconds(seconds));
    let mut next_flush = began;
    while !stop.load(Relaxed) && end.is_none_or(|end| monotonic() < end) {
        let now = monotonic();
        for _ in 0..FRAMES {
            let Some((bus, frame)) = frames.as_ref().and_then(RawFrames::next) else {
                break;
            };
            session.counts.frames += 1;
            let item = RecordItem::Frame(bus, frame);
            session.push(frame.t, item, listener.series())?;
        }
        listener.poll(now, |listener, event| -> anyhow::Result<()> {
            Ok(session.hear(event, listener.series())?)
        })?;
        session.advance(now, listener.series())?;
        if session.watch(now, listener.series())? {
            next_flush = now;
        }
        if now >= next_flush {
            next_flush = now + FLUSH;
            session.out.flush(now, listener.series())?;
        }
        listener.wait((now + Nanos::from_millis(100)).min(end.unwrap_or(Nanos::MAX)));
    }
    session.write_all(listener.series())?;
    finish(args, session, &listener, began, frames.as_ref())
}

/// Ends the recording, and says what it has.
fn finish(
    args: &RecordArgs,
    session: RecordingSession,
    listener: &Listener,
    began: Nanos,
    frames: Option<&RawFrames>,
) -> anyhow::Result<()> {
    let RecordingSession {
        order,
        gaps,
        counts,
        out,
        ..
    } = session;
    let without_column = out.without_column();
    let is_table = matches!(out, Destination::Table(_));
    let note = out.finish(monotonic(), listener.series())?;
    print_line!(
        "{}: {} samples in {:.1} s, {} lost, {} out of order",
        args.out.display(),
        counts.samples.saturating_sub(without_column),
        (monotonic() - began).seconds(),
        listener.lost(),
        order.out_of_order()
    );
    if !is_table {
        let lost = listener.lost_estimates();
        print_line!(
            "{} estimates of torques, {lost} estimates lost",
            counts.torques
        );
    }
    if let Some(frames) = frames {
        print_line!("{} frames, {} lost", counts.frames, frames.lost());
    }
    if let Some(note) = note {
        print_line!("{note}");
    }
    let without = gaps.summary(monotonic());
    if !without.is_empty() {
        print_line!("{without}");
    }
    let others = without_column + listener.unknown();
    if others > 0 {
        print_line!(
            "{others} samples and declarations are not in the table: they are of channels or \
             contacts that were not there when the recording began"
        );
    }
    Ok(())
}
