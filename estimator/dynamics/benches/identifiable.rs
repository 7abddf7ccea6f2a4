//! Cost of the identifiable subspace of a whole robot, computed once per structure and regime of
//! motion, and its growth with the size of the robot.
//!
//! `taskset -c 1 cargo bench -p proprio-dynamics --bench identifiable`
//!
//! The humanoid is iCub V2.5 if `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of
//! the PyPI package icub-models 3.2.0). Otherwise it is a generated robot with the same tree: 39
//! links, 32 joints, six F/T sensors.

#[path = "../tests/common/mod.rs"]
mod common;

use std::path::Path;

use common::humanoid;
use divan::{Bencher, black_box};
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::regressor::identifiable::{
    Identifiable, Measurement, Offsets, Regime, Scope,
};
use proprio_dynamics::spatial::{Pose, Vec3};
use proprio_dynamics::{Noise, SensorCut, Structure};

fn main() {
    divan::main();
}

fn robot() -> (Model, Structure) {
    let (text, joints) = match std::env::var_os("PROPRIO_ICUB_MODELS") {
        None => humanoid(),
        Some(folder) => {
            let file = Path::new(&folder).join("iCubGazeboV2_5.urdf");
            let text = std::fs::read_to_string(file).expect("the robot's file");
            let sensors = Model::from_urdf(&text, &[])
                .expect("the robot")
                .sensors()
                .to_vec();
            (
                text,
                sensors.into_iter().map(|sensor| sensor.joint).collect(),
            )
        }
    };
    let kept: Vec<&str> = joints.iter().map(String::as_str).collect();
    let model = Model::from_urdf(&text, &kept).expect("the robot");
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
    let cut =
        |joint: &&str| SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise);
    let sensors: Vec<_> = kept
        .iter()
        .map(|joint| cut(joint).expect("a sensor"))
        .collect();
    let structure =
        Structure::new(&model, &sensors, &[], Structure::LENGTH_SCALE).expect("a structure");
    (model, structure)
}

#[divan::bench(args = [false, true])]
fn whole_tree(bencher: Bencher<'_, '_>, is_fixed: bool) {
    let (model, _) = robot();
    let regime = if is_fixed {
        Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -9.81))
    } else {
        Regime::free(&model)
    };
    bencher.bench(|| {
        Identifiable::new(
            black_box(&model),
            Scope::Tree,
            &regime,
            Measurement::Wrench,
            Offsets::Known,
        )
    });
}

#[divan::bench(args = [Offsets::Known, Offsets::Unknown])]
fn all_subtrees(bencher: Bencher<'_, '_>, offsets: Offsets) {
    let (model, structure) = robot();
    let (regime, scope) = (Regime::free(&model), Scope::SubTrees(&structure));
    bencher.bench(|| {
        Identifiable::new(
            black_box(&model),
            scope,
            &regime,
            Measurement::Wrench,
            offsets,
        )
    });
}

fn generated(bencher: Bencher<'_, '_>, links: usize, parent: impl Fn(usize) -> usize) {
    let mut text = String::from("<robot name=\"generated\">");
    for link in 0..links {
        let at = [1.0, 2.0, 3.0].map(|factor| 0.1 * (factor * link as f64).sin());
        let parent = link.checked_sub(1).map(&parent);
        common::write_link(&mut text, link, parent, "revolute", at);
    }
    let model = Model::from_urdf(&(text + "</robot>"), &[]).expect("a robot");
    let regime = Regime::free(&model);
    let (scope, measured) = (Scope::Tree, Measurement::Wrench);
    bencher
        .bench(|| Identifiable::new(black_box(&model), scope, &regime, measured, Offsets::Known));
}

/// Every link is a child of the base.
#[divan::bench(args = [39, 78, 156])]
fn star(bencher: Bencher<'_, '_>, links: usize) {
    generated(bencher, links, |_| 0);
}

/// Every link is the child of the previous one.
#[divan::bench(args = [39, 78, 156])]
fn chain(bencher: Bencher<'_, '_>, links: usize) {
    generated(bencher, links, |before| before);
}
