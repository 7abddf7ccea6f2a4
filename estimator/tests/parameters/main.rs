//! Identified parameters, from the file to the standard deviations of torques: propagation of the
//! covariance, against another method and against random draws; parameters.toml read, written,
//! truncated, and of another robot; URDFs with other inertias.

#[path = "../../dynamics/tests/common/mod.rs"]
mod common;
mod deviations;
mod file;
mod in_use;
mod urdf;

use crate::common::Random;
use nalgebra::{DMatrix, Matrix6};
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_estimator::config::Config;
use proprio_estimator::drive::{DriveModel, DriveSignal};
use proprio_estimator::offline;
use proprio_estimator::parameters::{Friction, Offset, Parameters, Provenance, Rotor, UsedLog};
use proprio_estimator::setup::Setup;
use proprio_topics::Nanos;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The instant of the identified offsets.
const KNOWN: Nanos = Nanos::from_millis(1500);

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

fn arm_with(change: impl FnOnce(&mut Config)) -> Setup {
    let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    change(&mut config);
    Setup::new(&config).unwrap()
}

fn arm() -> Setup {
    arm_with(|_| {})
}

/// Identified parameters of the links beyond the arm's sensor, each 10 % heavier, and offsets.
fn identified(setup: &Setup, random: &mut Random) -> Parameters {
    let provenance = Provenance {
        program: "proprio 0.0.0 \"test\"".into(),
        tau: Some(0.58),
        logs: vec![UsedLog {
            file: "a log.csv".into(),
            start: Nanos(123_456_789_012_345),
            end: Nanos(123_456_789_999_999),
        }],
    };
    let mut parameters = Parameters::new(&setup.robot, provenance);
    let top = setup.robot.structure.subtrees().last().unwrap().top;
    let links: Vec<(usize, RigidInertia)> = (top..setup.robot.model.inertias().len())
        .rev()
        .map(|link| {
            let numbers = setup.robot.model.inertias()[link]
                .parameters()
                .map(|p| 1.1 * p);
            (link, RigidInertia::from_parameters(&numbers))
        })
        .collect();
    let offset = Offset {
        sensor: "l_arm_ft_sensor".into(),
        reading: Wrench::from_parts([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]),
        drift: Wrench::from_parts([0.01, 0.02, 0.03], [1e-3, 2e-3, 3e-3]),
        known: KNOWN,
        noise: Wrench::from_parts([0.3, 0.2, 0.1], [0.03, 0.02, 0.01]),
        calibrated: None,
    };
    let columns = 10 * links.len() + 6;
    // Masses known to grams, moments of inertia to a thousandth of that, offsets to centinewtons;
    // all correlated.
    let scale = |column: usize| match column % 10 {
        _ if column >= 10 * links.len() => 0.02,
        0 => 5e-3,
        1..=3 => 1e-3,
        _ => 1e-5,
    };
    let root = DMatrix::from_fn(columns, columns, |i, j| {
        scale(j) * (random.real(0.3) + if i == j { 1.0 } else { 0.0 })
    });
    parameters.set_identified(&links, &[offset], &root).unwrap();
    parameters
        .set_friction(&[Friction {
            joint: "l_elbow".into(),
            coulomb: 0.5,
            viscous: 1e-3,
            offset: -0.25,
            rotor: Some(Rotor {
                inertia: 0.08,
                deviation: 2e-3,
            }),
        }])
        .unwrap();
    parameters.set_drives(&[drive()]).unwrap();
    parameters
}

/// The drive of the elbow.
fn drive() -> DriveModel {
    DriveModel {
        joint: "l_elbow".into(),
        signal: DriveSignal::Current,
        parameters: [2.5, 0.4, 1e-3, 0.06, 0.07, -0.25],
        covariance: Matrix6::from_diagonal_element(0.0625),
        inherited: [0.01, 0.02],
        noise: 0.1,
    }
}

type Table = HashMap<String, Vec<f64>>;

fn estimates(setup: Setup) -> Table {
    let log =
        std::fs::read_to_string(root().join("tests/oracle/icub_left_arm_mujoco.csv")).unwrap();
    let mut out = Vec::new();
    offline::estimate(setup, log.as_bytes(), &mut out, None).unwrap();
    let mut reader = csv::Reader::from_reader(out.as_slice());
    let names: Vec<String> = reader
        .headers()
        .unwrap()
        .iter()
        .map(str::to_owned)
        .collect();
    let mut columns: Table = names.iter().map(|n| (n.clone(), vec![])).collect();
    for record in reader.records() {
        for (name, cell) in names.iter().zip(record.unwrap().iter()) {
            columns
                .get_mut(name)
                .unwrap()
                .push(cell.parse().unwrap_or(f64::NAN));
        }
    }
    columns
}
