//! What regressors cost per sample on one core: the whole tree's, with the kinematics it needs; sub-tree by sub-tree; and those of the estimates.
//!
//! `taskset -c 1 cargo bench -p proprio-estimator --bench regressor`
//!
//! The robot is iCub V2.5 where `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of the PyPI package icub-models 3.2.0), else a
//! generated one of the same shape: 32 joints, six F/T sensors. Folded completely it has 33 bodies (38 x 330), with the sensors' joints kept 39 (38 x
//! 390).
//!
//! The joints' state changes with every call: 64 states, in turn. So the kinematics are in every line; `a_kinematics` is what to take off. `scaling`
//! has one call on a robot of the named number of links.

#[path = "../tests/common/mod.rs"]
mod common;

use std::path::Path;

use common::{Random, State};
use divan::{Bencher, black_box};
use nalgebra::DMatrix;
use proprio_estimator::dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, Kinematics, Noise, SensorCut, Solver, Structure,
};
use proprio_estimator::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_estimator::regressor::{
    Actuator, Covariance, EstimateRows, MotorRegressor, Propagation, Regressor, StackedRegressor, Transmission,
    Weighting,
};
use proprio_estimator::spatial::{Pose, Vec3, Wrench};
use proprio_topics::Nanos;

fn main() {
    divan::main();
}

const KEPT: [bool; 2] = [false, true];

fn robot() -> (String, Vec<String>) {
    let Some(folder) = std::env::var_os("PROPRIO_ICUB_MODELS") else {
        return common::humanoid();
    };
    let text = std::fs::read_to_string(Path::new(&folder).join("iCubGazeboV2_5.urdf")).expect("the robot's file");
    let sensors = Model::from_urdf(&text, &[]).expect("the robot").sensors().to_vec();
    (text, sensors.into_iter().map(|sensor| sensor.joint).collect())
}

/// A robot, and states to go round.
struct Bench {
    model: Model,
    structure: Structure,
    kinematics: Kinematics,
    motion: FrameMotion,
    states: Vec<State>,
    turn: usize,
}

impl Bench {
    /// With the sensors' joints kept or folded.
    fn new(keep: bool) -> Self {
        let (text, joints) = robot();
        Self::of(&text, if keep { &joints } else { &[] })
    }

    /// With sensors in these joints. A full unknown wrench acts on the last link of each sub-tree.
    fn of(text: &str, joints: &[String]) -> Self {
        let kept: Vec<&str> = joints.iter().map(String::as_str).collect();
        let model = Model::from_urdf(text, &kept).expect("the robot");
        let noise = Noise {
            force: [0.1; 3],
            torque: [0.003; 3],
        };
        let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
        let cut = |joint: &&str| SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise);
        let sensors: Vec<_> = kept.iter().map(|joint| cut(joint).expect("a sensor")).collect();
        let bare = Structure::new(&model, &sensors, &[], Structure::LENGTH_SCALE).expect("a structure");
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
            structure: Structure::new(&model, &sensors, &contacts, Structure::LENGTH_SCALE).expect("a structure"),
            kinematics: Kinematics::new(&model, 0).expect("the root"),
            motion: FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81)),
            states: (0..64).map(|_| State::new(&model, &mut random)).collect(),
            turn: 0,
            model,
        };
        bench.next();
        bench
    }

    fn next(&mut self) {
        self.turn = (self.turn + 1) % self.states.len();
        let state = self.states[self.turn].get();
        self.kinematics
            .update(&self.model, state, &self.motion)
            .expect("a finite state");
    }

    fn readings(&self) -> Vec<Wrench> {
        vec![Wrench::from_parts([1.0, 2.0, 30.0], [0.1, 0.2, 0.3]); self.structure.sensors().len()]
    }

    fn contacts(&self) -> ContactSet {
        ContactSet::first(self.structure.contacts().len())
    }
}

/// For comparison: what the next line contains.
#[divan::bench(args = KEPT)]
fn a_kinematics(bencher: Bencher<'_, '_>, kept: bool) {
    let mut bench = Bench::new(kept);
    bencher.bench_local(|| {
        bench.next();
        black_box(&bench.kinematics);
    });
}

/// Kinematics and the whole tree's regressor: the call that Pinocchio and iDynTree are compared with.
#[divan::bench(args = KEPT)]
fn b_kinematics_and_regressor(bencher: Bencher<'_, '_>, kept: bool) {
    let mut bench = Bench::new(kept);
    let mut regressor = Regressor::new(&bench.model);
    bencher.bench_local(|| {
        bench.next();
        regressor
            .update(&bench.model, &bench.kinematics)
            .expect("the same model");
        black_box(&regressor);
    });
}

/// The same with the base going from foot to foot at every call.
#[divan::bench]
fn c_with_another_base_each_time(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut regressor = Regressor::new(&bench.model);
    let feet = [bench.model.link_count() - 1, bench.model.link_count() / 2];
    bencher.bench_local(|| {
        let base = feet[bench.turn % 2];
        bench
            .kinematics
            .set_base(&bench.model, base)
            .expect("a link of the model");
        bench.next();
        regressor
            .update(&bench.model, &bench.kinematics)
            .expect("the same model");
        black_box(&regressor);
    });
}

/// Kinematics and all sub-trees' equations, a full wrench in each.
#[divan::bench]
fn d_stacked(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut stacked = StackedRegressor::new(&bench.structure);
    let (readings, contacts) = (bench.readings(), bench.contacts());
    bencher.bench_local(|| {
        bench.next();
        stacked
            .update(&bench.kinematics, &readings, &contacts, &[])
            .expect("the same structure");
        black_box(&stacked);
    });
}

/// Kinematics and the equations without contacts, whitened.
#[divan::bench]
fn e_stacked_and_whitened(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut stacked = StackedRegressor::new(&bench.structure);
    let readings = bench.readings();
    bencher.bench_local(|| {
        bench.next();
        stacked
            .update(&bench.kinematics, &readings, &ContactSet::EMPTY, &[])
            .expect("the same structure");
        stacked.eliminate_contacts(Weighting::Noise);
        black_box(&stacked);
    });
}

/// Kinematics, solution and the rows of all torques.
#[divan::bench]
fn f_rows_of_all_torques(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut solver = Solver::new(&bench.structure);
    let (readings, contacts) = (bench.readings(), bench.contacts());
    let mut row = vec![0.0; 10 * bench.model.link_count() + 6 * readings.len()];
    let dofs = bench.model.dof_count();
    bencher.bench_local(|| {
        bench.next();
        let (structure, kinematics) = (&bench.structure, &bench.kinematics);
        solver
            .solve(&bench.model, structure, kinematics, &readings, &contacts, &[])
            .expect("finite input");
        let rows = EstimateRows::new(structure, &solver, kinematics).expect("the same structure");
        for dof in 0..dofs {
            let columns = rows.torque_subtree(dof).and_then(|subtree| rows.column_count(subtree));
            let row = &mut row[..columns.expect("a joint's sub-tree")];
            rows.torque_row(dof, row).expect("a row");
            black_box(row);
        }
    });
}

/// What is uncertain: every link by itself, as in a URDF; parameters of the limbs beyond the sensors, and offsets, together, the others by themselves; or
/// all together, as once all were identified.
const UNCERTAIN: [&str; 3] = ["urdf", "limbs", "all"];

/// Kinematics, solution, and the standard deviations of all torques and of seven full contact wrenches.
#[divan::bench(args = UNCERTAIN)]
fn h_deviations(bencher: Bencher<'_, '_>, uncertain: &str) {
    let contacts = Bench::new(true).contacts();
    deviations(bencher, uncertain, &contacts);
}

/// The same without contacts: torques from both sides of a joint rest on all of their sub-tree.
#[divan::bench(args = UNCERTAIN)]
fn i_deviations_without_contacts(bencher: Bencher<'_, '_>, uncertain: &str) {
    deviations(bencher, uncertain, &ContactSet::EMPTY);
}

fn deviations(bencher: Bencher<'_, '_>, uncertain: &str, contacts: &ContactSet) {
    let mut bench = Bench::new(true);
    let mut solver = Solver::new(&bench.structure);
    let readings = bench.readings();
    let (links, sensors) = (bench.model.link_count(), readings.len());
    let mut covariance = Covariance::exact(links, sensors);
    let mut random = Random::new(426);
    let mut root = |columns| DMatrix::from_fn(columns, columns, |_, _| random.real(0.01));
    let (together, alone): (Vec<usize>, Vec<usize>) = (0..links).partition(|&link| match uncertain {
        "urdf" => false,
        "limbs" => bench.structure.subtree_of(link) != Some(0),
        _ => true,
    });
    let offsets: Vec<usize> = (0..if uncertain == "urdf" { 0 } else { sensors }).collect();
    let columns = 10 * together.len() + 6 * offsets.len();
    covariance
        .add(&together, &offsets, root(columns))
        .expect("a covariance");
    for link in alone {
        covariance.add(&[link], &[], root(10)).expect("a covariance");
    }
    let mut propagation = Propagation::new(&bench.structure, &covariance).expect("the same structure");
    bencher.bench_local(|| {
        bench.next();
        let (structure, kinematics) = (&bench.structure, &bench.kinematics);
        solver
            .solve(&bench.model, structure, kinematics, &readings, contacts, &[])
            .expect("finite input");
        solver.update_deviations(structure).expect("the same structure");
        propagation
            .update(structure, &solver, kinematics, Nanos::ZERO)
            .expect("the same structure");
        black_box(&propagation);
    });
}

/// Kinematics, the whole tree's regressor, and all motors' rows with all their terms.
#[divan::bench]
fn g_motors(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut regressor = Regressor::new(&bench.model);
    let dofs = bench.model.dof_count();
    let actuator = Actuator {
        rotor_inertia: true,
        coulomb: Some(0.05),
        viscous: true,
        offset: true,
    };
    let mut motors = MotorRegressor::new(
        regressor.column_count(),
        Transmission::direct(dofs),
        &vec![actuator; dofs],
    )
    .expect("positive speeds");
    bencher.bench_local(|| {
        bench.next();
        regressor
            .update(&bench.model, &bench.kinematics)
            .expect("the same model");
        motors
            .update(|dof| regressor.joint_row(dof), bench.states[bench.turn].get())
            .expect("the same model");
        black_box(&motors);
    });
}

/// Kinematics and the whole tree's regressor against the size of the robot. The dense regressor is `(6 + n) x 10 N_B`, of which an update writes six
/// rows and one for each joint on the way to the base, per link: links times mean depth.
mod scaling {
    use super::common::write_link;
    use super::{Bench, Bencher, Regressor, StackedRegressor, black_box};

    const SIZES: [usize; 4] = [8, 32, 128, 500];

    /// A robot in which `parent` says where link `i > 0` hangs, with an F/T sensor where `is_cut` says so.
    fn robot(links: usize, parent: impl Fn(usize) -> usize, is_cut: impl Fn(usize) -> bool) -> Bench {
        let (mut text, mut cuts) = (String::from("<robot name=\"generated\">"), Vec::new());
        for link in 0..links {
            let [x, y, z] = [1.0, 2.0, 3.0].map(|factor| 0.1 * (factor * link as f64).sin());
            let kind = if is_cut(link) { "fixed" } else { "revolute" };
            let parent = (link > 0).then(|| parent(link));
            write_link(&mut text, link, parent, kind, [x, y, z]);
            if is_cut(link) {
                cuts.push(format!("joint{link}"));
            }
        }
        Bench::of(&(text + "</robot>"), &cuts)
    }

    fn regressor(bencher: Bencher<'_, '_>, mut bench: Bench) {
        let mut regressor = Regressor::new(&bench.model);
        bencher.bench_local(|| {
            bench.next();
            regressor
                .update(&bench.model, &bench.kinematics)
                .expect("the same model");
            black_box(&regressor);
        });
    }

    /// Serial: mean depth is half the number of links.
    #[divan::bench(args = SIZES)]
    fn of_chain(bencher: Bencher<'_, '_>, links: usize) {
        regressor(bencher, robot(links, |link| link - 1, |_| false));
    }

    /// Limbs of eight links on one root: mean depth stays below five.
    #[divan::bench(args = SIZES)]
    fn of_limbs(bencher: Bencher<'_, '_>, links: usize) {
        let parent = |link| if link % 8 == 1 { 0 } else { link - 1 };
        regressor(bencher, robot(links, parent, |_| false));
    }

    /// Kinematics and all sub-trees' equations, a sensor and a full wrench in each of these limbs.
    #[divan::bench(args = SIZES)]
    fn stacked_of_limbs(bencher: Bencher<'_, '_>, links: usize) {
        let parent = |link| if link % 8 == 1 { 0 } else { link - 1 };
        let mut bench = robot(links, parent, |link| link % 8 == 4);
        let mut stacked = StackedRegressor::new(&bench.structure);
        let (readings, contacts) = (bench.readings(), bench.contacts());
        bencher.bench_local(|| {
            bench.next();
            stacked
                .update(&bench.kinematics, &readings, &contacts, &[])
                .expect("the same structure");
            black_box(&stacked);
        });
    }
}
