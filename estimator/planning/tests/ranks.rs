//! What the closed form says of real robots, against the rank of their equations at random states.
//!
//! The shipped robots, and, if `PROPRIO_ROBOTS` names a folder of URDFs (that which
//! `tests/oracle/generate.py --robots` makes, or any other), up to twenty of those.

use fastrand::Rng;
use nalgebra::DMatrix;
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::regressor::StackedRegressor;
use proprio_dynamics::regressor::identifiable::{
    BaseRegime, Identifiable, Measurement, Offsets, Regime, Scope,
};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactSet, FrameMotion, JointState, Kinematics, Noise, SensorCut, Structure,
};
use std::path::{Path, PathBuf};

/// A robot of at most so many unknowns: the time of a singular value decomposition grows with the
/// third power.
const MOST: usize = 700;

fn random(rng: &mut Rng) -> f64 {
    2.0 * rng.f64() - 1.0
}

/// The rank of the equations at random states, a base at rest or in any motion; and the gap between
/// the singular values that count and those that do not.
fn sampled(model: &Model, structure: &Structure, is_free: bool, rng: &mut Rng) -> (usize, f64) {
    let dofs = model.dof_count();
    let columns = 10 * model.link_count() + 6 * structure.sensors().len();
    let mut kinematics = Kinematics::new(model, 0).unwrap();
    let mut regressor = StackedRegressor::new(structure);
    let readings = vec![Wrench::zero(); structure.sensors().len()];
    let per_state = 6 * structure.subtrees().len();
    let states = 3 * columns / per_state + 20;
    let mut rows = DMatrix::zeros(states * per_state, columns);
    for state in 0..states {
        let mut vector =
            |size: f64| -> Vec<f64> { (0..dofs).map(|_| size * random(rng)).collect() };
        let [position, velocity, acceleration] = [vector(3.0), vector(2.0), vector(5.0)];
        let mut three = |size: f64| Vec3::from_fn(|_, _| size * random(rng));
        let base = match is_free {
            true => FrameMotion {
                angular_velocity: three(2.0),
                angular_acceleration: three(5.0),
                proper_acceleration: three(10.0),
            },
            false => FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81)),
        };
        let joints = JointState {
            position: &position,
            velocity: &velocity,
            acceleration: &acceleration,
        };
        kinematics.update(model, joints, &base).unwrap();
        regressor
            .update(&kinematics, &readings, &ContactSet::EMPTY, &[])
            .unwrap();
        for (number, subtree) in regressor.subtrees().iter().enumerate() {
            for row in 0..6 {
                let mut at = rows.row_mut(state * per_state + 6 * number + row);
                let values = subtree.row(row);
                let (links, offsets) = values.split_at(subtree.offset_column());
                for (values, link) in links.chunks_exact(10).zip(subtree.links()) {
                    (0..10).for_each(|k| at[10 * link + k] = values[k]);
                }
                for (values, sensor) in offsets.chunks_exact(6).zip(subtree.sensors()) {
                    let first = 10 * model.link_count() + 6 * sensor;
                    (0..6).for_each(|k| at[first + k] = values[k]);
                }
            }
        }
    }
    // Columns are in SI units, not of one length: axes that differ from parallel ones by the
    // digits of an angle count as parallel, for the closed form too.
    let mut values: Vec<f64> = rows.qr().r().singular_values().iter().copied().collect();
    values.sort_by(|a, b| b.total_cmp(a));
    let rank = values
        .iter()
        .filter(|value| **value > 1e-8 * values[0])
        .count();
    let next = values.get(rank).map_or(0.0, |next| next / values[0]);
    (rank, values[rank - 1] / values[0] / next.max(1e-17))
}

/// Compares the ranks of a robot with F/T sensors in these joints, with both kinds of base.
fn compare(urdf: &Path, sensors: &[&str], rng: &mut Rng) -> Option<String> {
    let model = Model::from_file(urdf, sensors).ok()?;
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.01; 3],
    };
    let cuts: Vec<SensorCut> = (sensors.iter())
        .map(|joint| {
            let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
            SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise).unwrap()
        })
        .collect();
    let structure = Structure::new(&model, &cuts, &[], Structure::LENGTH_SCALE).unwrap();
    let columns = 10 * model.link_count() + 6 * cuts.len();
    if columns > MOST {
        return None;
    }
    let mut said = format!("{columns} unknowns");
    for is_free in [false, true] {
        let mut regime = Regime::free(&model);
        if !is_free {
            regime.motion = BaseRegime::Fixed(Vec3::new(0.0, 0.0, -9.81));
        }
        let scope = Scope::SubTrees(&structure);
        let closed = Identifiable::new(
            &model,
            scope,
            &regime,
            Measurement::Wrench,
            Offsets::Unknown,
        )
        .unwrap();
        let (rank, gap) = sampled(&model, &structure, is_free, rng);
        assert_eq!(
            closed.rank(),
            rank,
            "{}, sensors {sensors:?}, free base: {is_free}, gap {gap:.1e}",
            urdf.display()
        );
        said += &format!(", rank {rank} (gap {gap:.0e})");
    }
    Some(said)
}

#[test]
fn ranks_of_the_shipped_robots_are_those_of_their_equations() {
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
    let mut rng = Rng::with_seed(1);
    for (robot, sets) in [
        (
            "icub_left_arm",
            &[
                &["l_arm_ft_sensor"][..],
                &["l_shoulder_roll", "l_arm_ft_sensor"],
            ][..],
        ),
        ("six_axis_arm", &[&["base_ft"][..], &["joint_4"]]),
        ("moteus_leg", &[&["hip_ft"][..], &["knee", "hip_ft"], &[]]),
    ] {
        for sensors in sets {
            let urdf = config.join(robot).join("model.urdf");
            let said = compare(&urdf, sensors, &mut rng).expect("it loads and is small");
            println!("{robot} {sensors:?}: {said}");
        }
    }
}

#[test]
fn ranks_of_other_robots_are_those_of_their_equations() {
    let Some(folder) = std::env::var_os("PROPRIO_ROBOTS").map(PathBuf::from) else {
        println!("skipped: PROPRIO_ROBOTS (a folder of URDFs) is not set");
        return;
    };
    let files = std::fs::read_dir(folder).unwrap().flatten();
    let mut files: Vec<PathBuf> = files.map(|entry| entry.path()).collect();
    files.retain(|file| file.extension().is_some_and(|end| end == "urdf"));
    files.sort_unstable();
    let mut rng = Rng::with_seed(2);
    let mut count = 0;
    for urdf in &files {
        let Ok(model) = Model::from_file(urdf, &[]) else {
            continue;
        };
        // The closed form takes joints that follow others as moving for themselves, which differs
        // for a ratio of 1 or -1, as of two fingers.
        let mut names = (0..model.joint_count()).map(|joint| model.joint_name(joint));
        let has_followers = names.any(|name| model.follows(name).is_some());
        if model.dof_count() < 3 || has_followers || count >= 20 {
            continue;
        }
        // A sensor in some moving joint, and at times one in another.
        let mut dofs: Vec<usize> = (0..model.dof_count()).collect();
        rng.shuffle(&mut dofs);
        let sensors: Vec<&str> = (dofs.iter().take(1 + count % 2))
            .map(|&dof| model.dof_name(dof))
            .collect();
        if let Some(said) = compare(urdf, &sensors, &mut rng) {
            count += 1;
            println!(
                "{}: {sensors:?}: {said}",
                urdf.file_name().unwrap().to_string_lossy()
            );
        }
    }
    println!("{count} robots");
    assert!(count > 0, "no URDF of a robot of moderate size is there");
}
