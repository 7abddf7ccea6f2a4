//! The results of a demonstration: `estimates.csv`, `summary.json` and `report.html`.
//!
//! `summary.json` contains the counts of frames, samples and estimates, the latencies, and:
//!
//! | key | meaning |
//! |---|---|
//! | `verdict`, `worked` | one sentence, and true, false, or null if it cannot be told |
//! | `torque_rms_error_nm` | per joint, RMS of estimated minus true torque \[Nm\] (1, 4) |
//! | `valid_estimates` | per joint, the number of estimates in that figure: the valid ones (1) |
//! | `untrue_estimates` | per joint, how many valid torques of the run break the promise (6) |
//! | `valid_share` | fraction of the torques that were not withheld (1) |
//! | `identification.cad_error` | relative error of masses and first moments of `cad.urdf` (2) |
//! | `identification.refused` | why nothing was identified; null if something was |
//! | `identification.max_torque_std_nm` | torques with a larger std are withheld \[Nm\] |
//! | `identification.moving_since_s` | start of the motion (3) |
//! | `identification.settled_since_s` | 10 s after the start of the motion (3) |
//! | `identification.before` | phase: standstill, from 1 s after the first estimate on (4) |
//! | `identification.learning` | phase: the first 10 s of motion (4) |
//! | `identification.after` | phase: from 10 s of motion on (4) |
//! | `identification.solutions` | number of solutions that were put in use |
//! | `identification.parameters_within_2_sigma` | fraction of identified link parameters (5) |
//! | `rate_hz` | estimates per second |
//! | `late` | samples too late for their estimate |
//! | `lost_estimates` | estimates that this program missed |
//! | `foreign` | frames received in addition to those that the simulated robot sent |
//! | `simulator` | the output of `proprio simulate --json` |
//!
//! (1) From 10 s of motion on; in a shorter run, from 1 s after the first estimate on.
//! (2) Moments of inertia have about the same relative error.
//! (3) \[s\] after the first estimate; null if the run ended before.
//! (4) Null if nothing can be computed: withheld torques enter no figure.
//! (5) Those whose true value is within twice the stated standard deviation of the last solution;
//! null without a solution.
//! (6) They are more than four stated deviations, and 1 % of the joint's range, off the truth.
//!
//! Each of the three phases contains, over the valid estimates, `cad` and `identified`: per joint
//! the RMS error \[Nm\] with the CAD's inertial parameters and with those identified on-line, both
//! with the offsets that identification found; `valid_estimates`: per joint, their number;
//! `valid_share`; and `within_2_sigma`, the fraction of these torques whose error is within twice
//! the stated standard deviation.

mod compared;
mod evaluation;
mod learnt;
mod page;
mod torques;
mod verdict;

use super::experiment::{DemoArgs, Experiment};
use super::watching::ReceivedRun;
use anyhow::Context;
use compared::TrueTorques;
use evaluation::Evaluation;
use proprio_estimator::offline::EstimateTable;
use proprio_estimator::pipeline::Estimate;
use proprio_estimator::setup::Setup;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;

/// Writes estimates.csv, summary.json and report.html to `out`, and prints the result. `truth` is
/// the file with the simulator's truth.
pub(super) fn finish(
    args: &DemoArgs,
    experiment: &Experiment,
    out: &Path,
    watched: &ReceivedRun,
    truth: &Path,
) -> anyhow::Result<()> {
    let truth = TrueTorques::read(truth, &watched.joints).context("the simulator's truth")?;
    write_estimates(&out.join("estimates.csv"), &experiment.setup, watched)?;
    let evaluation = Evaluation::new(args, experiment, watched, &truth)?;
    let mut summary = serde_json::to_string_pretty(&evaluation.summary())?;
    summary.push('\n');
    fs::write(out.join("summary.json"), summary)?;
    fs::write(out.join("report.html"), page::page(&evaluation))?;
    page::print(&evaluation);
    Ok(())
}

/// Writes all estimates in the form of `proprio estimate`.
fn write_estimates(file: &Path, setup: &Setup, watched: &ReceivedRun) -> anyhow::Result<()> {
    /// Copies values to the first places; returns their number.
    fn fill<T: Copy>(places: &mut [T], values: &[T]) -> anyhow::Result<u32> {
        places
            .iter_mut()
            .zip(values)
            .for_each(|(to, from)| *to = *from);
        Ok(u32::try_from(values.len())?)
    }
    let out = File::create(file).with_context(|| file.display().to_string())?;
    let mut table = EstimateTable::new(BufWriter::new(out), setup)?;
    for seen in &watched.estimates {
        let mut estimate = Estimate::absent(seen.t);
        let (torques, contacts) = (&mut estimate.torques, &mut estimate.contacts);
        torques.count = fill(&mut torques.joints, &seen.joints)?;
        contacts.count = fill(&mut contacts.contacts, &seen.contacts)?;
        contacts.residual_count = fill(&mut contacts.residuals, &seen.residuals)?;
        table.write(&estimate, None, true)?;
    }
    table.into_inner().flush()?;
    Ok(())
}
