//! Joints that follow others (`<mimic>`): everything is that of the robot without `<mimic>` under
//! the linear map of coordinates `q = S q_own + s`, on random robots; and Pinocchio's numbers.

mod common;

use std::collections::HashMap;

use common::{
    Random, RandomRobot, State, contact, external, gap, mass_matrix, motion, parameters, size,
};
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::model::{JointKind, Model, ModelError};
use proprio_dynamics::regressor::{EstimateRows, Regressor};
use proprio_dynamics::spatial::{Motion, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, InverseDynamics, JointState, Kinematics,
    SensorCut, Solver, Structure,
};
use proptest::prelude::*;

const EXACT: f64 = 1e-10;

/// The same robot with and without `<mimic>`, and the map: `q_free = S q + s`.
struct Pair {
    free: Model,
    own: Model,
    matrix: DMatrix<f64>,
    shift: DVector<f64>,
    cuts: Vec<String>,
}

impl Pair {
    fn new((links, seed): (usize, u64)) -> (Self, Random) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let keep: Vec<&str> = robot.cuts.iter().map(String::as_str).collect();
        let free = Model::from_urdf(&robot.urdf(), &keep).unwrap();
        // In random order, about half of the joints follow one that comes earlier in this order.
        let mut names: Vec<&str> = (0..free.dof_count())
            .map(|dof| free.dof_name(dof))
            .collect();
        random.shuffle(&mut names);
        let mut follows: HashMap<&str, (&str, f64, f64)> = HashMap::new();
        for place in 1..names.len() {
            if random.chance(50) {
                let leader = names[random.below(place)];
                let rule = (leader, random.real(2.0), random.real(0.5));
                follows.insert(names[place], rule);
            }
        }
        let mut text = robot.urdf();
        for (name, (leader, multiplier, offset)) in &follows {
            let start = text.find(&format!("<joint name=\"{name}\"")).unwrap();
            let end = start + text[start..].find("</joint>").unwrap();
            let mimic = format!(
                "<mimic joint=\"{leader}\" multiplier=\"{multiplier:e}\" offset=\"{offset:e}\"/>"
            );
            text.insert_str(end, &mimic);
        }
        let own = Model::from_urdf(&text, &keep).unwrap();
        let mut matrix = DMatrix::zeros(free.dof_count(), own.dof_count());
        let mut shift = DVector::zeros(free.dof_count());
        for name in names.iter().copied() {
            let (mut leader, mut ratio, mut offset) = (name, 1.0, 0.0);
            while let Some((next, multiplier, more)) = follows.get(leader) {
                offset += ratio * more;
                ratio *= multiplier;
                leader = next;
            }
            let (row, column) = (free.dof(name).unwrap(), own.dof(leader).unwrap());
            matrix[(row, column)] = ratio;
            shift[row] = offset;
            assert_eq!(own.dof(name).is_none(), follows.contains_key(name));
            assert_eq!(own.follows(name), (leader != name).then_some(leader));
        }
        let cuts = robot.cuts;
        let pair = Self {
            free,
            own,
            matrix,
            shift,
            cuts,
        };
        (pair, random)
    }

    /// A state of the robot with `<mimic>`, and that of the other one.
    fn states(&self, random: &mut Random) -> (State, State) {
        let own = State::new(&self.own, random);
        let vectors = own
            .0
            .clone()
            .map(|values| &self.matrix * DVector::from_vec(values));
        let [q, dq, ddq] = vectors;
        let free = [q + &self.shift, dq, ddq].map(|values| values.as_slice().to_vec());
        (own, State(free))
    }

    /// `S^T tau` of the other robot's torques.
    fn torque(&self, free: &[f64]) -> DVector<f64> {
        self.matrix.tr_mul(&DVector::from_column_slice(free))
    }
}

fn kinematics(model: &Model, base: usize, state: &State, motion: &FrameMotion) -> Kinematics {
    let mut kinematics = Kinematics::new(model, base).unwrap();
    kinematics.update(model, state.get(), motion).unwrap();
    kinematics
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 300,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn dynamics_are_those_of_the_free_robot_under_the_map(
        sizes in (1..=25_usize, any::<u64>()),
    ) {
        let (pair, mut random) = Pair::new(sizes);
        let Pair { free, own, matrix, .. } = &pair;
        let (state, free_state) = pair.states(&mut random);
        let (base, motion) = (random.below(free.link_count()), motion(&mut random));
        let [of_free, of_own] = [(free, &free_state), (own, &state)]
            .map(|(model, state)| kinematics(model, base, state, &motion));
        for link in 0..free.link_count() {
            let (one, other) = (of_free.pose(link), of_own.pose(link));
            prop_assert!((one.translation - other.translation).amax() < EXACT);
            prop_assert!((one.rotation - other.rotation).amax() < EXACT);
        }
        let (spec, wrench) = contact(free, &mut random);
        let external = [external(&spec, wrench)];
        let [free_torque, torque] = [(free, &of_free), (own, &of_own)].map(|(model, kinematics)| {
            let mut dynamics = InverseDynamics::new(model);
            dynamics.update(model, kinematics, &external).unwrap();
            dynamics.torque().to_vec()
        });
        let expected = pair.torque(&free_torque);
        prop_assert!(gap(&torque, expected.as_slice()) < EXACT * size(&free_torque));

        let [mut of_all, mut rows] = [free, own].map(Regressor::new);
        // From two bases: the pattern of zeros changes.
        let other = random.below(free.link_count());
        for base in [other, base] {
            let [a, b] = [(free, &free_state), (own, &state)]
                .map(|(model, state)| kinematics(model, base, state, &motion));
            of_all.update(free, &a).unwrap();
            rows.update(own, &b).unwrap();
        }
        for dof in 0..own.dof_count() {
            let mut sum = vec![0.0; 10 * own.link_count()];
            for free_dof in 0..free.dof_count() {
                let ratio = matrix[(free_dof, dof)];
                let row = of_all.joint_row(free_dof).unwrap();
                sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += ratio * x);
            }
            prop_assert!(gap(rows.joint_row(dof).unwrap(), &sum) < EXACT * size(&sum));
        }
    }

    /// The estimates: torques, what they depend on, their deviation, and their rows.
    #[test]
    fn estimates_are_those_of_the_free_robot_under_the_map(
        sizes in (1..=25_usize, any::<u64>()),
    ) {
        let (pair, mut random) = Pair::new(sizes);
        let Pair { free, own, matrix, cuts, .. } = &pair;
        let (state, free_state) = pair.states(&mut random);
        let (base, motion) = (random.below(free.link_count()), motion(&mut random));
        let [of_free, of_own] = [(free, &free_state), (own, &state)]
            .map(|(model, state)| kinematics(model, base, state, &motion));
        let robot = RandomRobot { links: vec![], joints: vec![], cuts: cuts.clone() };
        let sensors: Vec<SensorCut> = robot.sensors(free, &mut random);
        let contacts: Vec<ContactSpec> = (0..random.below(4))
            .map(|_| contact(free, &mut random).0)
            .collect();
        let support = ContactSpec {
            frame: random.frame(free),
            kind: ContactKind::Wrench,
            position: Vec3::zeros(),
        };
        let contacts = [contacts, vec![support]].concat();
        let readings: Vec<Wrench> = sensors.iter().map(|_| random.wrench()).collect();
        let active = ContactSet::first(contacts.len());
        let [(free_structure, free_solver), (structure, solver)] =
            [(free, &of_free), (own, &of_own)].map(|(model, kinematics)| {
                let structure = Structure::new(model, &sensors, &contacts, 0.1).unwrap();
                let mut solver = Solver::new(&structure);
                solver
                    .solve(model, &structure, kinematics, &readings, &active, &[])
                    .unwrap();
                solver.update_deviations(&structure).unwrap();
                (structure, solver)
            });
        let expected = pair.torque(free_solver.torque());
        // With contacts that cannot be distinguished, small differences of the poses are enlarged.
        let scale = 1.0 + size(free_solver.torque());
        prop_assert!(gap(solver.torque(), expected.as_slice()) < 1e-6 * scale);
        let rows = EstimateRows::new(&structure, &solver, &of_own).unwrap();
        for dof in 0..own.dof_count() {
            let joints: Vec<usize> =
                (0..free.dof_count()).filter(|&row| matrix[(row, dof)] != 0.0).collect();
            let dependence = structure.torque_dependence(dof, &of_own, &active).unwrap();
            for &joint in &joints {
                let each = free_structure.torque_dependence(joint, &of_free, &active).unwrap();
                prop_assert_eq!(each.sensors.difference(&dependence.sensors).len(), 0);
                prop_assert_eq!(each.links.difference(&dependence.links).len(), 0);
            }
            // The deviation by finite differences: the torque is linear in the readings.
            let mut variance = 0.0;
            for (number, sensor) in sensors.iter().enumerate() {
                let noise = sensor.noise();
                for axis in 0..6 {
                    let mut pushed = readings.clone();
                    let reading = &mut pushed[number];
                    if axis < 3 {
                        reading.force[axis] += noise.force[axis];
                    } else {
                        reading.torque[axis - 3] += noise.torque[axis - 3];
                    }
                    let mut other = Solver::new(&structure);
                    other.solve(own, &structure, &of_own, &pushed, &active, &[]).unwrap();
                    variance += (other.torque()[dof] - solver.torque()[dof]).powi(2);
                }
            }
            let deviation = solver.torque_deviation()[dof];
            prop_assert!((deviation - variance.sqrt()).abs() < 1e-6 * (1.0 + scale), "{deviation}");
            if rows.torque_subtree(dof).is_some() {
                let mut row = vec![0.0; rows.column_count()];
                rows.torque_row(dof, &mut row).unwrap();
                let parameters = parameters(own);
                let sum: f64 = row.iter().zip(&parameters).map(|(a, b)| a * b).sum();
                let measured = rows.torque_measured(dof, &readings, &[]).unwrap();
                prop_assert!((sum + measured - solver.torque()[dof]).abs() < 1e-6 * scale);
            }
        }
    }
}

const HAND: &str = r#"<robot name="hand"><link name="base"/>
<link name="palm"><inertial><origin xyz="0.02 0 0.05"/><mass value="1.2"/>
  <inertia ixx="0.01" ixy="0.001" ixz="0" iyy="0.02" iyz="-0.001" izz="0.025"/></inertial></link>
<link name="finger"><inertial><origin xyz="0.06 0.01 0"/><mass value="0.3"/>
  <inertia ixx="0.004" ixy="0.001" ixz="0" iyy="0.008" iyz="-0.001" izz="0.01"/></inertial></link>
<link name="thumb"><inertial><origin xyz="0.05 0 -0.01"/><mass value="0.2"/>
  <inertia ixx="0.003" ixy="0.001" ixz="0" iyy="0.006" iyz="-0.001" izz="0.0075"/></inertial></link>
<link name="slider"><inertial><origin xyz="0 0.02 0.03"/><mass value="0.4"/>
  <inertia ixx="0.005" ixy="0.001" ixz="0" iyy="0.01" iyz="-0.001" izz="0.0125"/></inertial></link>
<joint name="wrist" type="continuous"><parent link="base"/><child link="palm"/>
  <origin xyz="0 0 0.4" rpy="0.3 0 0"/><axis xyz="0 1 0"/></joint>
<joint name="cable" type="prismatic"><parent link="finger"/><child link="slider"/>
  <origin xyz="0.1 0 0" rpy="0 0.2 0"/><axis xyz="1 0 1"/>
  <mimic joint="close" multiplier="0.05" offset="-0.01"/></joint>
<joint name="lead" type="revolute"><parent link="palm"/><child link="finger"/>
  <origin xyz="0 0.03 0.1" rpy="0 0 0.4"/><axis xyz="0 0 1"/></joint>
<joint name="close" type="revolute"><parent link="palm"/><child link="thumb"/>
  <origin xyz="0 -0.03 0.1" rpy="0 0.5 0"/><axis xyz="0 1 1"/>
  <mimic joint="lead" multiplier="-1.5" offset="0.2"/></joint>
</robot>"#;

/// Pinocchio 4.1.0: `S^T rnea` and `S^T crba S`, where S follows the chain of two.
#[test]
fn a_chain_of_followers_has_pinocchios_torque_and_inertia() {
    let model = Model::from_urdf(HAND, &[]).unwrap();
    assert_eq!((model.dof_count(), model.joint_count()), (2, 4));
    let (wrist, lead) = (model.dof("wrist").unwrap(), model.dof("lead").unwrap());
    let ordered = |values: [f64; 2]| {
        let mut ordered = vec![0.0; 2];
        (ordered[wrist], ordered[lead]) = (values[0], values[1]);
        ordered
    };
    let [position, velocity, acceleration] = [[0.7, 0.3], [-1.1, 2.0], [3.0, -4.0]].map(ordered);
    let state = JointState {
        position: &position,
        velocity: &velocity,
        acceleration: &acceleration,
    };
    let mut kinematics = Kinematics::new(&model, 0).unwrap();
    let standing = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81));
    kinematics.update(&model, state, &standing).unwrap();
    let mut dynamics = InverseDynamics::new(&model);
    dynamics.update(&model, &kinematics, &[]).unwrap();
    let torque = ordered([-1.122_310_526_528_422_6, 0.114_306_056_023_131_51]);
    assert!(
        gap(dynamics.torque(), &torque) < 1e-12,
        "{:?}",
        dynamics.torque()
    );
    let inertia = mass_matrix(&model, 0, &position)
        .view((6, 6), (2, 2))
        .into_owned();
    for (row, column, value) in [
        (wrist, wrist, 0.056_757_780_307_845_42),
        (wrist, lead, -0.012_113_859_218_134_274),
        (lead, lead, 0.043_851_159_219_730_81),
    ] {
        assert!((inertia[(row, column)] - value).abs() < 1e-14);
    }
    // A follower that is held for itself.
    let mut held = model.clone();
    assert!(held.hold("cable", 0.3) && !held.hold("lead", 0.1) && !held.hold("none", 0.1));
    let mut kinematics = Kinematics::new(&held, 0).unwrap();
    kinematics.update(&held, state, &standing).unwrap();
    let cable = held.joints()[held.joint("cable").unwrap()];
    assert_eq!((cable.ratio, cable.offset), (0.0, 0.3));
    let slid = kinematics.pose(cable.parent).inverse() * *kinematics.pose(cable.child);
    assert!((slid.translation - cable.pose(0.3).translation).amax() < 1e-12);
    assert_eq!(
        kinematics.joint_axis(&cable),
        Some(Motion::translation(&Vec3::zeros()))
    );
    // Who follows a held joint is held, too, where that puts it: 0.05 x 0.7 - 0.01.
    let mut held = model;
    assert!(held.hold("close", 0.7));
    let cable = held.joints()[held.joint("cable").unwrap()];
    assert!(cable.ratio == 0.0 && (cable.offset - 0.025).abs() < 1e-15);
    // In either order, each has the position that it was given.
    for order in [["close", "cable"], ["cable", "close"]] {
        let mut held = Model::from_urdf(HAND, &[]).unwrap();
        assert!(order.iter().all(|joint| held.hold(joint, 0.2)));
        let all = order.map(|joint| held.joints()[held.joint(joint).unwrap()]);
        assert!(
            all.iter()
                .all(|joint| (joint.ratio, joint.offset) == (0.0, 0.2))
        );
    }
}

#[test]
fn a_joint_that_cannot_follow_says_where_and_why() {
    let error = |from: &str, to: &str| {
        assert!(HAND.contains(from));
        Model::from_urdf(&HAND.replacen(from, to, 1), &[])
            .expect_err("broken")
            .to_string()
    };
    // Other programs read it: it is a joint of its own, and so is not held by a mistake.
    let misspelt = HAND.replacen("<mimic joint=\"lead\"", "<mimic joint=\"led\"", 1);
    let model = Model::from_urdf(&misspelt, &[]).unwrap();
    assert!(model.dof("close").is_some());
    assert_eq!(model.follows("cable"), Some("close"));
    assert_eq!(
        model.warnings()[0],
        "line 19: joint close: its <mimic> joint=\"led\" is not a joint of the URDF: it is taken \
         as a joint of its own, which is measured or in [locked]"
    );
    assert_eq!(
        error("<mimic joint=\"lead\"", "<mimic joint=\"cable\""),
        "line 14: joint cable: its <mimic> joint=\"close\" leads back to the joint itself; one of \
         these joints must follow none"
    );
    assert!(
        error("<mimic joint=\"lead\"", "<mimic joint=\"close\"")
            .starts_with("line 19: joint close: its <mimic> joint=\"close\" leads back")
    );
    assert_eq!(
        error("multiplier=\"-1.5\"", "multiplier=\"-1,5\""),
        "line 19: joint close: <mimic> multiplier=\"-1,5\" is not a number"
    );
    assert!(
        error("<mimic joint=\"lead\"", "<mimic jiont=\"lead\"").starts_with(
            "line 19: joint close: its <mimic> has no joint (it has jiont, multiplier, offset); "
        )
    );
}

/// Its position is that at zero of the fixed joint.
#[test]
fn a_follower_of_a_fixed_joint_is_fixed() -> Result<(), ModelError> {
    let text = HAND.replacen(
        "name=\"lead\" type=\"revolute\"",
        "name=\"lead\" type=\"fixed\"",
        1,
    );
    let model = Model::from_urdf(&text, &["close"])?;
    assert_eq!(model.dof_count(), 1);
    let free = Model::from_urdf(&HAND.replace("<mimic", "<ignored"), &[])?;
    let (held, moving) = (model.cut("close").unwrap(), free.joint("close").unwrap());
    assert_eq!(model.joints()[held].kind, JointKind::Fixed);
    let expected = free.joints()[moving].pose(0.2);
    assert_eq!(model.joints()[held].placement, expected);
    assert!(model.warnings().iter().any(|warning| {
        warning == "joint close: it follows the fixed joint lead (<mimic>), so it is held at 0.2"
    }));
    // Also through another one.
    let holders = ["close", "cable", "lead"].map(|joint| model.held_by(joint));
    assert_eq!(holders, [Some("lead"), Some("lead"), None]);
    Ok(())
}
