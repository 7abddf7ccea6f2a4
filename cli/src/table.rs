//! `proprio table`: makes a table of a recording (MCAP).

use crate::convert::{OutputFile, input};
use crate::samples::of_recording;
use anyhow::Context;
use std::io;
use std::path::PathBuf;

/// `proprio table`.
#[derive(clap::Args)]
pub(crate) struct TableArgs {
    /// The recording (MCAP)
    #[arg(long, value_name = "FILE")]
    recording: PathBuf,
    /// The table to write; - for standard output
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// The estimates, not the samples: torques and contacts with deviations and reasons
    #[arg(long)]
    estimates: bool,
}

/// Makes a table of a recording.
pub(crate) fn run(args: &TableArgs) -> anyhow::Result<()> {
    let path = &args.recording;
    let mut table = of_recording(input(path)?, path, args.estimates)?;
    let mut out = OutputFile::new(&args.out)?;
    io::copy(&mut table, &mut out.writer()).with_context(|| path.display().to_string())?;
    out.finish().with_context(|| args.out.display().to_string())
}
