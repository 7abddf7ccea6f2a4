//! A robot with a full unknown wrench in each sub-tree, and states used in turn. The benchmarks of
//! regressors and of propagation share it.

#![allow(dead_code, reason = "each benchmark uses its own part")]

#[path = "../../tests/common/mod.rs"]
pub(crate) mod common;

use common::{Random, State};
use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, Kinematics, Noise, SensorCut, Structure,
};
use std::path::Path;

pub(crate) fn robot() -> (String, Vec<String>) {
    let Some(folder) = std::env::var_os("PROPRIO_ICUB_MODELS") else {
        return common::humanoid();
    };
    let text = std::fs::read_to_string(Path::new(&folder).join("iCubGazeboV2_5.urdf"))
        .expect("the robot's file");
    let sensors = Model::from_urdf(&text, &[])
        .expect("the robot")
        .sensors()
        .to_vec();
    (
        text,
        sensors.into_iter().map(|sensor| sensor.joint).collect(),
    )
}

/// A robot, and states used in turn.
pub(crate) struct Bench {
    pub(crate) model: Model,
    pub(crate) structure: Structure,
    pub(crate) kinematics: Kinematics,
    pub(crate) motion: FrameMotion,
    pub(crate) states: Vec<State>,
    pub(crate) turn: usize,
}

impl Bench {
    /// With the sensor joints kept or folded.
    pub(crate) fn new(keep: bool) -> Self {
        let (text, joints) = robot();
        Self::of(&text, if keep { &joints } else { &[] })
    }

    /// With sensors in these joints. A full unknown wrench acts on the last link of each sub-tree.
    pub(crate) fn of(text: &str, joints: &[String]) -> Self {
        let kept: Vec<&str> = joints.iter().map(String::as_str).collect();
        let model = Model::from_urdf(text, &kept).expect("the robot");
        let noise = Noise {
            force: [0.1; 3],
            torque: [0.003; 3],
        };
        let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
        let cut = |joint: &&str| {
            SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise)
        };
        let sensors: Vec<_> = kept
            .iter()
            .map(|joint| cut(joint).expect("a sensor"))
            .collect();
        let bare =
            Structure::new(&model, &sensors, &[], Structure::LENGTH_SCALE).expect("a structure");
        let mut contacts = Vec::new();
        for number in 0..bare.subtrees().len() {
            let link = (0..model.link_count()).rfind(|&link| bare.subtree_of(link) == Some(number));
            contacts.push(ContactSpec {
                frame: Frame {
                    link: link.expect("a link of the sub-tree"),
                    pose: Pose::identity(),
                },
                kind: ContactKind::Wrench,
                position: Vec3::zeros(),
            });
        }
        let mut random = Random::new(64);
        let mut bench = Self {
            structure: Structure::new(&model, &sensors, &contacts, Structure::LENGTH_SCALE)
                .expect("a structure"),
            kinematics: Kinematics::new(&model, 0).expect("the root"),
            motion: FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81)),
            states: (0..64).map(|_| State::new(&model, &mut random)).collect(),
            turn: 0,
            model,
        };
        bench.next();
        bench
    }

    pub(crate) fn next(&mut self) {
        self.turn = (self.turn + 1) % self.states.len();
        let state = self.states[self.turn].get();
        self.kinematics
            .update(&self.model, state, &self.motion)
            .expect("a finite state");
    }

    pub(crate) fn readings(&self) -> Vec<Wrench> {
        vec![Wrench::from_parts([1.0, 2.0, 30.0], [0.1, 0.2, 0.3]); self.structure.sensors().len()]
    }

    pub(crate) fn contacts(&self) -> ContactSet {
        ContactSet::first(self.structure.contacts().len())
    }
}
