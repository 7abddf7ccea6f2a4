//! Times this project's estimator. Usage: peers-ours robot.urdf states.txt (protocol:
//! ../../server.rs)

#[path = "../../server.rs"]
#[allow(dead_code, unreachable_pub, reason = "each program uses its own part")]
mod server;

use std::fmt::Display;
use std::rc::Rc;

use proprio_dynamics::model::Model;
use proprio_dynamics::regressor::Regressor;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, InverseDynamics, JointState, Kinematics,
    Noise, SensorCut, Solver, Structure,
};
use proprio_identification::linear::information::{Information, Panel};
use server::{Bench, Output, States, fail};

/// The result, or the end of the program.
fn must<T, E: Display>(result: Result<T, E>) -> T {
    result.unwrap_or_else(|error| fail(&error.to_string()))
}

/// A model, and the states in its order of joints.
struct Robot {
    model: Model,
    states: States,
    /// Motion of body 0 at each state: standing, or moving.
    bases: Vec<FrameMotion>,
}

impl Robot {
    fn new(urdf: &str, keep: &[&str], states: &str, floating: bool) -> Rc<Self> {
        let model = must(Model::from_urdf(urdf, keep));
        let names: Vec<&str> = (0..model.dof_count())
            .map(|dof| model.dof_name(dof))
            .collect();
        let states = States::read(states).in_order_of(&names);
        let gravity = Vec3::from(states.gravity);
        let bases = states
            .states
            .iter()
            .map(|state| {
                if !floating {
                    return FrameMotion::standing(&gravity);
                }
                FrameMotion {
                    angular_velocity: Vec3::from(state.base.angular_velocity),
                    angular_acceleration: Vec3::from(state.base.angular_acceleration),
                    proper_acceleration: Vec3::from(state.base.acceleration) - gravity,
                }
            })
            .collect();
        Rc::new(Self {
            model,
            states,
            bases,
        })
    }

    fn update(&self, kinematics: &mut Kinematics, state: usize) {
        let s = &self.states.states[state];
        must(kinematics.update(
            &self.model,
            JointState {
                position: &s.position,
                velocity: &s.velocity,
                acceleration: &s.acceleration,
            },
            &self.bases[state],
        ));
    }

    /// Random numbers, ten per link, so that every column of a regressor counts.
    fn parameters(&self) -> Vec<f64> {
        let states = &self.states;
        (0..self.model.link_count())
            .flat_map(|link| match link {
                0 => states.parameters[0],
                _ => states.parameters[server::place(&states.bodies, self.model.link_name(link))],
            })
            .collect()
    }

    fn show_torque(&self, torque: &[f64], output: &mut Output) {
        for (name, torque) in self.states.joints.iter().zip(torque) {
            output.add("torque", name, *torque);
        }
    }
}

fn show_wrench(name: &str, wrench: &Wrench, output: &mut Output) {
    output.add3("force", name, wrench.force.iter().copied());
    output.add3("moment", name, wrench.torque.iter().copied());
}

/// Pose and motion of every link; net wrenches too, which the peers leave to their second pass.
struct Pass {
    robot: Rc<Robot>,
    kinematics: Kinematics,
}

impl Bench for Pass {
    fn run(&mut self, state: usize) {
        self.robot.update(&mut self.kinematics, state);
    }

    fn show(&self, output: &mut Output) {
        for link in 1..self.robot.model.link_count() {
            let name = self.robot.model.link_name(link);
            let motion = self.kinematics.motion(link);
            output.add3(
                "position",
                name,
                self.kinematics.pose(link).translation.iter().copied(),
            );
            output.add3("omega", name, motion.angular_velocity.iter().copied());
            output.add3("alpha", name, motion.angular_acceleration.iter().copied());
            output.add3(
                "acceleration",
                name,
                motion.proper_acceleration.iter().copied(),
            );
        }
    }
}

/// Inverse dynamics without external wrenches.
struct Inverse {
    robot: Rc<Robot>,
    kinematics: Kinematics,
    inverse: InverseDynamics,
    floating: bool,
}

impl Bench for Inverse {
    fn run(&mut self, state: usize) {
        self.robot.update(&mut self.kinematics, state);
        must(
            self.inverse
                .update(&self.robot.model, &self.kinematics, &[]),
        );
    }

    fn show(&self, output: &mut Output) {
        self.robot.show_torque(self.inverse.torque(), output);
        if self.floating {
            show_wrench("base", &self.inverse.base_wrench(), output);
        }
    }
}

/// The regressor of the wrench on the base and of all torques.
struct Regression {
    robot: Rc<Robot>,
    kinematics: Kinematics,
    regressor: Regressor,
}

impl Regression {
    fn new(robot: &Rc<Robot>) -> Self {
        Self {
            robot: Rc::clone(robot),
            kinematics: must(Kinematics::new(&robot.model, 0)),
            regressor: Regressor::new(&robot.model),
        }
    }
}

impl Bench for Regression {
    fn run(&mut self, state: usize) {
        self.robot.update(&mut self.kinematics, state);
        must(self.regressor.update(&self.robot.model, &self.kinematics));
    }

    /// Times the parameters.
    fn show(&self, output: &mut Output) {
        let (model, parameters) = (&self.robot.model, self.robot.parameters());
        let times = |row: &[f64]| row.iter().zip(&parameters).map(|(a, b)| a * b).sum::<f64>();
        let three = |rows: [usize; 3]| rows.map(|row| times(self.regressor.row(row)));
        output.add3("moment", "base", three([0, 1, 2]));
        output.add3("force", "base", three([3, 4, 5]));
        let rows = (0..model.dof_count()).filter_map(|dof| self.regressor.joint_row(dof));
        self.robot
            .show_torque(&rows.map(times).collect::<Vec<_>>(), output);
    }
}

/// A pass of least squares over a log: the regressor of each sample, some samples' rows at once
/// into `[R z]`. What was measured does not matter here: the velocities stand for it.
struct Identification {
    regression: Regression,
    information: Information,
    panel: Panel,
    last: usize,
}

/// As in ../../pinocchio.cpp. Fewer would make the peer slower: it computes with the zeros of `R`
/// too, once per panel.
const SAMPLES_IN_PASS: usize = 16;

impl Identification {
    fn new(robot: &Rc<Robot>) -> Self {
        let regression = Regression::new(robot);
        let model = &robot.model;
        let (rows, columns) = (6 + model.dof_count(), 10 * model.link_count());
        Self {
            regression,
            information: Information::new(columns),
            panel: Panel::new(columns, rows * SAMPLES_IN_PASS),
            last: 0,
        }
    }
}

impl Bench for Identification {
    fn run(&mut self, state: usize) {
        self.regression.run(state);
        let s = &self.regression.robot.states.states[state];
        let measured = s
            .base
            .angular_velocity
            .iter()
            .chain(&s.base.velocity)
            .chain(&s.velocity);
        for (row, right) in measured.enumerate() {
            must(
                self.panel
                    .push_row(self.regression.regressor.row(row), *right),
            );
        }
        if self.panel.rows() == self.panel.capacity() {
            must(self.information.absorb(&mut self.panel));
        }
        self.last = state;
    }

    /// Of the log up to this state's panel, afresh: `|A x - y|^2` at the parameters and half its
    /// gradient, `A^T (A x - y)`. The signs of rows and what rounding leaves where nothing is
    /// identifiable do not show in them.
    fn show(&self, output: &mut Output) {
        let robot = &self.regression.robot;
        let mut fresh = Self::new(robot);
        (0..(self.last / SAMPLES_IN_PASS + 1) * SAMPLES_IN_PASS).for_each(|state| fresh.run(state));
        let parameters = robot.parameters();
        let (mut square, mut gradient) = (
            fresh.information.residual_square(),
            vec![0.0; parameters.len()],
        );
        for k in 0..parameters.len() {
            let row = fresh.information.row(k);
            let with_right = parameters[k..].iter().chain([&-1.0]);
            let misfit = row.iter().zip(with_right).map(|(a, b)| a * b).sum::<f64>();
            square += misfit * misfit;
            for (to, value) in gradient[k..].iter_mut().zip(row) {
                *to += misfit * value;
            }
        }
        output.add("square", "sum", square);
        for (link, gradient) in gradient.chunks(10).enumerate() {
            let name = if link == 0 {
                "base"
            } else {
                robot.model.link_name(link)
            };
            output.add("mass", name, gradient[0]);
            output.add3("moment", name, gradient[1..4].iter().copied());
            for (number, value) in gradient[4..].iter().enumerate() {
                output.add("inertia", &format!("{name}.{number}"), *value);
            }
        }
    }
}

/// F/T readings in; one full contact wrench per sub-tree and all torques out.
struct Cycle {
    robot: Rc<Robot>,
    structure: Structure,
    readings: Vec<Vec<Wrench>>,
    active: ContactSet,
    kinematics: Kinematics,
    solver: Solver,
}

impl Cycle {
    fn new(robot: &Rc<Robot>) -> Self {
        let (model, states) = (&robot.model, &robot.states);
        let (mut cuts, mut columns) = (Vec::new(), Vec::new());
        for sensor in model.sensors() {
            // Their size does not matter here: with one full wrench per sub-tree nothing is left to
            // weigh.
            let noise = Noise {
                force: [0.1; 3],
                torque: [0.003; 3],
            };
            cuts.push(must(SensorCut::new(
                model,
                &sensor.joint,
                sensor.frame,
                sensor.direction,
                &sensor.pose,
                &noise,
            )));
            columns.push(server::place(&states.sensors, &sensor.name));
        }
        let contacts: Vec<ContactSpec> = states
            .contacts
            .iter()
            .map(|name| ContactSpec {
                frame: model
                    .frame(name)
                    .unwrap_or_else(|| fail(&format!("no link {name}"))),
                kind: ContactKind::Wrench,
                position: Vec3::zeros(),
            })
            .collect();
        let structure = must(Structure::new(
            model,
            &cuts,
            &contacts,
            Structure::LENGTH_SCALE,
        ));
        if structure
            .subtrees()
            .iter()
            .any(|subtree| subtree.contacts.len() != 1)
        {
            fail("not one contact in every sub-tree");
        }
        let readings = states
            .states
            .iter()
            .map(|state| {
                let wrench = |&column: &usize| {
                    let [force, torque] = state.readings[column];
                    Wrench::from_parts(force, torque)
                };
                columns.iter().map(wrench).collect()
            })
            .collect();
        Self {
            robot: Rc::clone(robot),
            readings,
            active: ContactSet::first(contacts.len()),
            kinematics: must(Kinematics::new(model, 0)),
            solver: Solver::new(&structure),
            structure,
        }
    }
}

impl Bench for Cycle {
    fn run(&mut self, state: usize) {
        self.robot.update(&mut self.kinematics, state);
        must(self.solver.solve(
            &self.robot.model,
            &self.structure,
            &self.kinematics,
            &self.readings[state],
            &self.active,
            &[],
        ));
    }

    fn show(&self, output: &mut Output) {
        self.robot.show_torque(self.solver.torque(), output);
        for (name, contact) in self
            .robot
            .states
            .contacts
            .iter()
            .zip(self.solver.contacts())
        {
            show_wrench(name, &contact.wrench, output);
        }
    }
}

/// Random rows of least squares, six per sample; as in ../../eigen.cpp.
struct Samples {
    rows: Vec<([f64; UNKNOWNS], f64)>,
}

const UNKNOWNS: usize = 44;
const ROWS: usize = 6;
const SAMPLES: usize = 8;
const STATES: usize = 64;

impl Samples {
    fn new() -> Rc<Self> {
        // SplitMix64, between -1 and 1.
        let mut word = 44_u64;
        let mut next = || {
            word = word.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = word;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^= z >> 31;
            (z >> 11) as f64 / 9_007_199_254_740_992.0 * 2.0 - 1.0
        };
        let mut row = || (std::array::from_fn(|_| next()), next());
        Rc::new(Self {
            rows: (0..STATES * ROWS).map(|_| row()).collect(),
        })
    }
}

/// Absorbs and solves whenever the panel is full.
struct Recursion {
    samples: Rc<Samples>,
    information: Information,
    panel: Panel,
    estimate: Vec<f64>,
    last: usize,
}

impl Recursion {
    /// Starts from the row x = 0 of every unknown.
    fn new(samples: &Rc<Samples>, per_panel: usize) -> Self {
        let (mut information, mut start) =
            (Information::new(UNKNOWNS), Panel::new(UNKNOWNS, UNKNOWNS));
        for k in 0..UNKNOWNS {
            let unit: [f64; UNKNOWNS] = std::array::from_fn(|i| f64::from(u8::from(i == k)));
            must(start.push_row(&unit, 0.0));
        }
        must(information.absorb(&mut start));
        Self {
            samples: Rc::clone(samples),
            information,
            panel: Panel::new(UNKNOWNS, ROWS * per_panel),
            estimate: vec![0.0; UNKNOWNS],
            last: 0,
        }
    }
}

impl Bench for Recursion {
    fn run(&mut self, state: usize) {
        for (row, right) in &self.samples.rows[ROWS * state..ROWS * (state + 1)] {
            must(self.panel.push_row(row, *right));
        }
        if self.panel.rows() == self.panel.capacity() {
            must(self.information.absorb(&mut self.panel));
            let (r, z) = self.information.to_triangle();
            match r.solve_upper_triangular(&z) {
                Some(estimate) => self.estimate.copy_from_slice(estimate.as_slice()),
                None => fail("the samples do not determine the unknowns"),
            }
        }
        self.last = state;
    }

    /// What timing has taken in differs from program to program: the state's panels afresh.
    fn show(&self, output: &mut Output) {
        let mut fresh = Self::new(&self.samples, self.panel.capacity() / ROWS);
        (0..(self.last / SAMPLES + 1) * SAMPLES).for_each(|state| fresh.run(state));
        for (k, value) in fresh.estimate.iter().enumerate() {
            output.add("unknown", &k.to_string(), *value);
        }
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [urdf, states] = &arguments[..] else {
        fail("usage: peers-ours robot.urdf states.txt");
    };
    let text = must(std::fs::read_to_string(urdf));
    let folded = Robot::new(&text, &[], states, false);
    let folded_floating = Robot::new(&text, &[], states, true);
    let sensors = folded.model.sensors().to_vec();
    let cuts: Vec<&str> = sensors.iter().map(|sensor| sensor.joint.as_str()).collect();
    let kept = Robot::new(&text, &cuts, states, false);
    let kept_floating = Robot::new(&text, &cuts, states, true);

    let inverse = |robot: &Rc<Robot>, floating| Inverse {
        robot: Rc::clone(robot),
        kinematics: must(Kinematics::new(&robot.model, 0)),
        inverse: InverseDynamics::new(&robot.model),
        floating,
    };
    let pass = Pass {
        robot: Rc::clone(&folded),
        kinematics: must(Kinematics::new(&folded.model, 0)),
    };
    let samples = Samples::new();
    let count = folded.states.states.len();
    if count != STATES {
        fail("states.txt does not hold as many states as the recursions have samples");
    }
    server::serve(
        count,
        &mut [
            ("kinematics", Box::new(pass)),
            ("rnea", Box::new(inverse(&folded, false))),
            ("rnea_floating", Box::new(inverse(&folded_floating, true))),
            ("regressor_33", Box::new(Regression::new(&folded_floating))),
            ("regressor_39", Box::new(Regression::new(&kept_floating))),
            ("pass_33", Box::new(Identification::new(&folded_floating))),
            ("cycle", Box::new(Cycle::new(&kept))),
            ("recursion_44", Box::new(Recursion::new(&samples, 1))),
            ("panels_44", Box::new(Recursion::new(&samples, SAMPLES))),
        ],
    );
}
