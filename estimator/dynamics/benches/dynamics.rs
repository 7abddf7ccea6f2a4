//! Cost of one sample on one core: kinematics, inverse dynamics, the reordered recursion with its
//! deviations; and the growth of the cost with the size of the robot.
//!
//! `taskset -c 1 cargo bench -p proprio-dynamics --bench dynamics`
//!
//! The robot is iCub V2.5 if `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of
//! the PyPI package icub-models 3.2.0). Otherwise it is a generated robot of the same shape: 32
//! joints, six F/T sensors, 33 bodies with all fixed joints folded, 39 with those of the sensors
//! kept. The joint state changes with every call, so that caching of sines gives no advantage.
//!
//! In `scaling`, every line is the work for [`LINKS`] = 1024 links, in several calls: a time of 41
//! us is 40 ns per link, and the cost is linear where the column is constant. Only `load_urdf`
//! reads one robot of the named size.

use std::fmt::Write as _;
use std::path::Path;

use divan::Bencher;
use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, InverseDynamics, JointState, Kinematics,
    Noise, SensorCut, Solver, Structure,
};

fn main() {
    divan::main();
}

// ---------------------------------------------------------------- robots

/// A robot as text: `parents[i]` is the parent of link `i + 1`, whose joint is fixed if `is_fixed`
/// and otherwise revolute about its own x, y or z axis, as nearly all joints of real robots are.
fn urdf(parents: &[usize], is_fixed: impl Fn(usize) -> bool) -> String {
    let mut text = String::from("<robot name=\"generated\">");
    for link in 0..=parents.len() {
        let size = 1.0 + 0.5 * (link as f64).sin();
        let _ = write!(
            text,
            "<link name=\"link{link}\"><inertial>\
             <origin xyz=\"{} -0.02 0.05\" rpy=\"0.1 0.2 {}\"/><mass value=\"{size}\"/>\
             <inertia ixx=\"{}\" ixy=\"0\" ixz=\"0\" iyy=\"0.003\" iyz=\"0\" izz=\"0.0035\"/>\
             </inertial></link>",
            0.01 * size,
            0.3 * size,
            0.002 * size,
        );
    }
    for (link, parent) in (1..).zip(parents) {
        let axis = ["1 0 0", "0 1 0", "0 0 -1"][link % 3];
        let kind = if is_fixed(link) { "fixed" } else { "revolute" };
        let turn = (3 * link) as f64;
        let _ = write!(
            text,
            "<joint name=\"joint{link}\" type=\"{kind}\"><parent link=\"link{parent}\"/>\
             <child link=\"link{link}\"/>\
             <origin xyz=\"{} 0.03 -0.1\" rpy=\"{} {} 0.4\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-3\" upper=\"3\" effort=\"1\" velocity=\"1\"/></joint>",
            0.05 * turn.cos(),
            turn.sin(),
            turn.cos(),
        );
    }
    text + "</robot>"
}

fn chain(links: usize) -> Vec<usize> {
    (0..links - 1).collect()
}

/// Every link except the leaves has two children.
fn tree(links: usize) -> Vec<usize> {
    (1..links).map(|link| (link - 1) / 2).collect()
}

/// Limbs of eight links on one root, each with a sensor in its fourth joint. The number of sensors
/// is limited so that every sub-tree can have a contact; only the last limb of 512 links has no
/// sensor.
fn limbs(links: usize) -> (Vec<usize>, Vec<usize>) {
    let parents = (1..links).map(|link| if link % 8 == 1 { 0 } else { link - 1 });
    let below = (1..links).filter(|link| link % 8 == 4);
    (
        parents.collect(),
        below.take(ContactSet::CAPACITY - 1).collect(),
    )
}

/// A humanoid's parents and the links below its F/T sensors: torso and head of three joints, arms
/// of seven with a sensor after three, legs of six with sensors after three and at the foot.
fn humanoid() -> (Vec<usize>, Vec<usize>) {
    let (mut parents, mut below) = (vec![0, 1, 2], Vec::new());
    for (from, joints, sensors) in [
        (3, 3, &[] as &[usize]),
        (3, 7, &[3]),
        (3, 7, &[3]),
        (0, 6, &[3, 6]),
        (0, 6, &[3, 6]),
    ] {
        let mut parent = from;
        let mut next = |parents: &mut Vec<usize>| {
            parents.push(parent);
            parent = parents.len();
            parent
        };
        for joint in 1..=joints {
            next(&mut parents);
            if sensors.contains(&joint) {
                below.push(next(&mut parents));
            }
        }
    }
    (parents, below)
}

/// The robot of the first four benchmarks as text, and the joints of its F/T sensors.
fn robot() -> (String, Vec<String>) {
    if let Some(folder) = std::env::var_os("PROPRIO_ICUB_MODELS") {
        let text = std::fs::read_to_string(Path::new(&folder).join("iCubGazeboV2_5.urdf"))
            .expect("the robot's file");
        let sensors = Model::from_urdf(&text, &[])
            .expect("the robot")
            .sensors()
            .to_vec();
        return (
            text,
            sensors.into_iter().map(|sensor| sensor.joint).collect(),
        );
    }
    let (parents, below) = humanoid();
    let sensors = below.iter().map(|link| format!("joint{link}")).collect();
    (urdf(&parents, |link| below.contains(&link)), sensors)
}

// ---------------------------------------------------------------- what is measured

/// Model, objects that work on it, and states used in turn.
struct Bench {
    model: Model,
    states: Vec<[Vec<f64>; 3]>,
    turn: usize,
    base: FrameMotion,
    kinematics: Kinematics,
    inverse: InverseDynamics,
}

impl Bench {
    fn new(text: &str, keep: &[&str]) -> Self {
        let model = Model::from_urdf(text, keep).expect("the robot");
        let count = model.dof_count();
        let list = |seed: f64, size: f64| {
            (0..count)
                .map(|dof| size * (seed + 1.7 * dof as f64).sin())
                .collect()
        };
        let states = (0..64)
            .map(f64::from)
            .map(|i| [list(i, 0.5), list(2.3 * i, 1.0), list(3.1 * i, 1.0)]);
        Self {
            states: states.collect(),
            turn: 0,
            base: FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81)),
            kinematics: Kinematics::new(&model, 0).expect("the root"),
            inverse: InverseDynamics::new(&model),
            model,
        }
    }

    fn kinematics(&mut self) {
        self.turn = (self.turn + 1) % self.states.len();
        let [position, velocity, acceleration] = &self.states[self.turn];
        let state = JointState {
            position,
            velocity,
            acceleration,
        };
        self.kinematics
            .update(&self.model, state, &self.base)
            .expect("numbers that are finite");
        divan::black_box(self.kinematics.net_wrenches());
    }

    fn rnea(&mut self) {
        self.kinematics();
        self.inverse
            .update(&self.model, &self.kinematics, &[])
            .expect("objects of one model");
        divan::black_box(self.inverse.torque());
    }
}

/// The same with the tree cut at its sensors and one full unknown wrench in each sub-tree, at its
/// last link.
struct CutBench {
    bench: Bench,
    structure: Structure,
    solver: Solver,
    readings: Vec<Wrench>,
    active: ContactSet,
}

impl CutBench {
    fn new(text: &str, joints: &[&str]) -> Self {
        let bench = Bench::new(text, joints);
        let model = &bench.model;
        let noise = Noise {
            force: [0.1; 3],
            torque: [0.003; 3],
        };
        let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
        let cut = |joint| SensorCut::new(model, joint, frame, direction, &Pose::identity(), &noise);
        let sensors: Vec<_> = joints
            .iter()
            .map(|joint| cut(joint).expect("a fixed joint"))
            .collect();
        let bare = Structure::new(model, &sensors, &[], Structure::LENGTH_SCALE)
            .expect("few enough sensors");
        let mut last = vec![0; sensors.len() + 1];
        (0..model.link_count())
            .for_each(|link| last[bare.subtree_of(link).expect("a link")] = link);
        let contacts: Vec<_> = last
            .iter()
            .map(|&link| ContactSpec {
                frame: Frame {
                    link,
                    pose: Pose::from_xyz_rpy([0.02, -0.01, 0.05], [0.1, -0.2, 0.3]),
                },
                kind: ContactKind::Wrench,
                position: Vec3::zeros(),
            })
            .collect();
        let structure = Structure::new(model, &sensors, &contacts, Structure::LENGTH_SCALE)
            .expect("few contacts");
        Self {
            solver: Solver::new(&structure),
            structure,
            readings: vec![Wrench::from_parts([10.0, -5.0, 40.0], [1.0, 0.5, -0.3]); sensors.len()],
            active: ContactSet::first(contacts.len()),
            bench,
        }
    }

    fn cycle(&mut self) {
        self.bench.kinematics();
        self.solver
            .solve(
                &self.bench.model,
                &self.structure,
                &self.bench.kinematics,
                &self.readings,
                &self.active,
                &[],
            )
            .expect("objects of one model");
        divan::black_box(self.solver.torque());
    }

    fn deviations(&mut self) {
        self.solver
            .update_deviations(&self.structure)
            .expect("one structure");
        divan::black_box(self.solver.torque_deviation());
    }
}

fn cut_robot() -> CutBench {
    let (text, joints) = robot();
    let joints: Vec<&str> = joints.iter().map(String::as_str).collect();
    CutBench::new(&text, &joints)
}

/// Poses, motions and net wrenches of all bodies.
#[divan::bench(sample_size = 640)]
fn kinematics(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(&robot().0, &[]);
    bencher.bench_local(|| bench.kinematics());
}

/// Joint torques from the joints' motion: kinematics and inverse dynamics.
#[divan::bench(sample_size = 640)]
fn rnea(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(&robot().0, &[]);
    bencher.bench_local(|| bench.rnea());
}

/// Joint torques and one full contact wrench per sub-tree from F/T readings: kinematics and solver.
#[divan::bench(sample_size = 640)]
fn cycle(bencher: Bencher<'_, '_>) {
    let mut bench = cut_robot();
    bencher.bench_local(|| bench.cycle());
}

/// The same, and the standard deviations of all torques and wrenches.
#[divan::bench(sample_size = 640)]
fn cycle_with_deviations(bencher: Bencher<'_, '_>) {
    let mut bench = cut_robot();
    bencher.bench_local(|| {
        bench.cycle();
        bench.deviations();
    });
}

/// Links per iteration: nanoseconds per link are microseconds per iteration, minus 2.3 %.
const LINKS: usize = 1024;

/// Numbers of links, each of which divides [`LINKS`].
const SIZES: [usize; 7] = [8, 16, 32, 64, 128, 256, 512];

/// Cost against the size of the robot.
mod scaling {
    use super::{Bench, Bencher, CutBench, LINKS, Model, SIZES, chain, limbs, tree, urdf};

    fn rnea(bencher: Bencher<'_, '_>, parents: &[usize]) {
        let mut bench = Bench::new(&urdf(parents, |_| false), &[]);
        let calls = LINKS / bench.model.link_count();
        bencher.bench_local(|| (0..calls).for_each(|_| bench.rnea()));
    }

    /// Kinematics and inverse dynamics of serial chains.
    #[divan::bench(args = SIZES, sample_size = 8)]
    fn rnea_of_chain(bencher: Bencher<'_, '_>, links: usize) {
        rnea(bencher, &chain(links));
    }

    /// Kinematics and inverse dynamics of binary trees.
    #[divan::bench(args = SIZES, sample_size = 8)]
    fn rnea_of_tree(bencher: Bencher<'_, '_>, links: usize) {
        rnea(bencher, &tree(links));
    }

    /// Kinematics and solver, with a sensor and a full unknown wrench for every eight links.
    #[divan::bench(args = SIZES, sample_size = 8)]
    fn cycle_of_limbs(bencher: Bencher<'_, '_>, links: usize) {
        let (parents, below) = limbs(links);
        let joints: Vec<String> = below.iter().map(|link| format!("joint{link}")).collect();
        let joints: Vec<&str> = joints.iter().map(String::as_str).collect();
        let mut bench = CutBench::new(&urdf(&parents, |link| below.contains(&link)), &joints);
        let calls = LINKS / bench.bench.model.link_count();
        bencher.bench_local(|| (0..calls).for_each(|_| bench.cycle()));
    }

    /// Reading of a model from a URDF text: one robot of this size.
    #[divan::bench(args = SIZES)]
    fn load_urdf(bencher: Bencher<'_, '_>, links: usize) {
        let text = urdf(&tree(links), |_| false);
        bencher.bench_local(|| Model::from_urdf(&text, &[]).expect("a valid robot"));
    }
}
