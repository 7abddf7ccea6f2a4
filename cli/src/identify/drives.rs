//! The drives of the joints: what they report beside the torques of the F/T sensors
//! ([`proprio_estimator::drive`]). They are identified last, with the parameters that were found.

use super::logs::open;
use crate::convert::is_file;
use crate::samples;
use anyhow::Context;
use proprio_dynamics::spatial::Wrench;
use proprio_estimator::drive::{self, DriveModel, DriveRow, DriveSignal, Unfit};
use proprio_estimator::offline::drive_rows;
use proprio_estimator::parameters::Parameters;
use proprio_estimator::setup::Setup;
use proprio_identification::{LogOutcome, LogRole, Outcome};
use serde_json::{Value as Json, json};
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// A drive that reports the torque of its joint in Nm has a constant of one, but for the error of
/// its own torque constant (10 to 20 %) and what the gear loses (10 to 20 %): by as much together.
const SAME_UNIT: f64 = 0.3;

/// A joint, and its drive or why there is none.
pub(super) type Found = (String, Result<DriveModel, Unfit>);

/// The drives of all joints whose drives report something, from the training logs `files`.
pub(super) fn identify(
    setup: &Setup,
    parameters: &Parameters,
    outcome: &Outcome,
    files: &[(&PathBuf, LogRole)],
    config: &Path,
) -> anyhow::Result<Vec<Found>> {
    let mut setup = setup.clone();
    setup.apply(parameters)?;
    let mut logs: Vec<Vec<Vec<DriveRow>>> = Vec::new();
    for ((file, role), log) in files.iter().zip(&outcome.logs) {
        if *role == LogRole::Train && reports(file)? {
            let mut setup = setup.clone();
            set_offsets(&mut setup, log);
            let table = open(file, config, &setup)?;
            let rows = drive_rows(&setup, table);
            logs.push(rows.with_context(|| file.display().to_string())?);
        }
    }
    let robot = &setup.robot;
    let of_joint = |dof: usize| {
        let rows: Vec<Vec<DriveRow>> = (logs.iter_mut())
            .filter_map(|log| log.get_mut(dof).map(std::mem::take))
            .collect();
        let joint = robot.model.dof_name(dof);
        Some((joint.to_owned(), drive::fit(joint, &rows)?))
    };
    Ok(robot.published().filter_map(of_joint).collect())
}

/// Whether a log has columns of what drives report. A pipe has been read already.
fn reports(file: &Path) -> anyhow::Result<bool> {
    if !is_file(file) {
        return Ok(false);
    }
    let log = File::open(file).with_context(|| format!("{}: cannot be read", file.display()))?;
    let mut header = String::new();
    let mut table = BufReader::new(samples::table(log, file)?);
    while header.trim().is_empty() && table.read_line(&mut header)? > 0 {}
    let mut columns = header.split(',').map(str::trim);
    Ok(columns.any(|name| name.ends_with("/torque") || name.ends_with("/current")))
}

/// The offsets of the F/T sensors in a log: half-way between those at its start and at its end.
fn set_offsets(setup: &mut Setup, log: &LogOutcome) {
    for offset in &log.offsets {
        let sensor = setup.robot.sensor(&offset.sensor);
        if let Some(place) = sensor.and_then(|sensor| setup.initial.offsets.get_mut(sensor)) {
            let middle = |i: usize| f64::midpoint(offset.start[i], offset.end[i]);
            let [fx, fy, fz, tx, ty, tz] = std::array::from_fn(middle);
            *place = Wrench::from_parts([fx, fy, fz], [tx, ty, tz]);
        }
    }
}

/// For summary.json.
pub(super) fn in_json(found: &[Found]) -> Json {
    let one = |result: &Result<DriveModel, Unfit>| match result {
        Err(unfit) => json!({ "reason": unfit.to_string() }),
        Ok(drive) => {
            let [constant, coulomb, viscous, load, rotor, offset] = drive.parameters;
            json!({
                "signal": drive.signal, "constant": constant, "coulomb_nm": coulomb,
                "viscous_nms": viscous, "load": load, "rotor_inertia_kgm2": rotor,
                "offset_nm": offset, "std": drive.deviations(), "noise_nm": drive.noise,
            })
        }
    };
    let all = found
        .iter()
        .map(|(joint, result)| (joint.clone(), one(result)));
    Json::Object(all.collect())
}

/// The drives that were identified, in a line; `None` if there is none.
pub(super) fn line(found: &[Found]) -> Option<String> {
    let joints = found.iter().filter(|(_, drive)| drive.is_ok());
    let joints: Vec<&str> = joints.map(|(joint, _)| joint.as_str()).collect();
    (!joints.is_empty())
        .then(|| format!("second opinions from the drives of {}", joints.join(", ")))
}

/// What is odd about the drives, one sentence each.
pub(super) fn warnings(found: &[Found]) -> Vec<String> {
    let odd = |(joint, result): &Found| match result {
        Err(unfit) => Some(format!(
            "the drive of {joint} gives no second opinion: {unfit}"
        )),
        Ok(drive) => {
            let (constant, deviation) = (drive.parameters[0], drive.deviations()[0]);
            let is_off = (constant - 1.0).abs() > SAME_UNIT + 3.0 * deviation;
            (drive.signal == DriveSignal::Torque && is_off).then(|| {
                format!(
                    "the torque of {joint} is {constant:.3} +- {deviation:.3} times what its drive \
                     reports: it reports in another unit, on the motor's side of the gear, or with \
                     the other sign"
                )
            })
        }
    };
    found.iter().filter_map(odd).collect()
}
