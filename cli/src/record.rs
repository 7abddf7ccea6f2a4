//! `proprio record`: what a running robot measures and feels, as the table that `identify` reads or
//! as a recording (MCAP) that viewers read, too.

mod gaps;
mod output;

use crate::running::interrupted;
use anyhow::{Context, bail};
use gaps::Gaps;
use output::Output;
use proprio_bridge::{Event, Heard, Listener};
use proprio_gateway::offline::InOrder;
use proprio_topics::Nanos;
use proprio_topics::csv::{Columns, Value};
use proprio_topics::ipc::{DomainConfig, monotonic};
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

/// How late a sample is still sorted into its place in a recording: a gateway that starts publishes
/// the frames that arrived meanwhile.
const REORDER: Nanos = Nanos::from_millis(2000);
/// How often what was recorded is written to the file: a killed recorder loses no more.
const FLUSH: Nanos = Nanos::from_millis(500);

/// `proprio record`.
#[derive(clap::Args)]
pub(crate) struct Record {
    /// The table of samples: a new file. One that ends with .mcap is a recording of samples,
    /// torques, contacts and health, which Foxglove, PlotJuggler and `identify` read
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
    /// Write all columns of a table, such as gauges and temperatures, not only those that the
    /// estimator reads
    #[arg(long)]
    all: bool,
}

/// Creates the file of a recording. An existing one is overwritten only if that is asked for; what
/// is no file, such as a pipe, has nothing to lose.
fn create(path: &Path, force: bool) -> anyhow::Result<File> {
    let special = std::fs::metadata(path).is_ok_and(|m| !m.is_file());
    let created = match force || special {
        true => File::create(path),
        false => File::create_new(path),
    };
    match created {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => bail!(
            "{} exists: name another file, or overwrite it with --force",
            path.display()
        ),
        created => created.with_context(|| path.display().to_string()),
    }
}

/// What was recorded.
#[derive(Default)]
struct Counts {
    samples: u64,
    torques: u64,
}

/// Records what a robot sends.
pub(crate) fn run(args: &Record, config: &DomainConfig) -> anyhow::Result<()> {
    let stop = interrupted()?;
    let mut listener = Listener::open(config, args.robot.as_deref())?;
    let columns = match args.all {
        true => Columns::All,
        false => Columns::Main,
    };
    let file = create(&args.out, args.force)?;
    let mut gaps = Gaps::new(listener.description());
    let is_recording = args.out.extension().is_some_and(|it| it == "mcap");
    let series = listener.series().to_vec();
    let mut out = match is_recording {
        true => Output::recording(file, listener.robot(), &series)?,
        false => Output::table(file, &series, columns)?,
    };
    let mut order = InOrder::<Heard>::new(REORDER);
    let mut counts = Counts::default();
    let began = monotonic();
    let end = args
        .seconds
        .map(|seconds| began + Nanos::from_seconds(seconds));
    let mut next_flush = began;
    while !stop.load(Relaxed) && end.is_none_or(|end| monotonic() < end) {
        let now = monotonic();
        listener.poll(now, |listener, event| -> anyhow::Result<()> {
            out.know(listener.series())?;
            let Event {
                mut t,
                epoch,
                heard,
            } = event;
            match &heard {
                Heard::Value(_, Value::Reading(..)) => {
                    counts.samples += 1;
                    gaps.see(epoch, t);
                }
                // What was declared long before arrives with the next declaration.
                Heard::Value(_, Value::Contact(_)) => t = t.max(order.passed_on()),
                Heard::Torques(..) => counts.torques += 1,
                _ => {}
            }
            Ok(order.push(t, heard, |t, heard| out.push(t, heard))?)
        })?;
        if now >= next_flush {
            next_flush = now + FLUSH;
            out.flush(now)?;
        }
        gaps.wait(now);
        listener.wait((now + Nanos::from_millis(100)).min(end.unwrap_or(Nanos::MAX)));
    }
    order.finish(|t, heard| out.push(t, heard))?;
    let without_column = out.without_column();
    out.finish()?;
    print_line!(
        "{}: {} samples in {:.1} s, {} lost, {} out of order",
        args.out.display(),
        counts.samples - without_column,
        (monotonic() - began).seconds(),
        listener.lost(),
        order.out_of_order()
    );
    if is_recording {
        print_line!("{} estimates of torques", counts.torques);
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
