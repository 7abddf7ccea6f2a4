//! Regressors as identities between two computations, on random robots of 1 to 40 links with all
//! joint types, cuts, bases and serializations; and comparison with golden files.
//!
//! The other computation never uses the regressor: `RigidInertia::net_wrench`, `InverseDynamics`,
//! `Solver`, differences of these, eigenvalues of Gram matrices.

mod common;

use common::{Random, RandomRobot, State, contact, external, gap, motion, size, wrench_gap};
use nalgebra::{DMatrix, DVector, Matrix6};
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::regressor::{
    Actuator, Coupling, EstimateRows, MotorError, MotorRegressor, MotorTerm, Regressor,
    Serialization, SerializationError, StackedRegressor, Transmission, Weighting, link_regressor,
};
use proprio_dynamics::spatial::{Pose, RigidInertia, Wrench};
use proprio_dynamics::{
    Certainty, ContactKind, ContactSet, ContactSpec, DynamicsError, ExternalWrench,
    InverseDynamics, JointState, Kinematics, SensorCut, Solver, Structure,
};
use proptest::prelude::*;

const EXACT: f64 = 1e-10;

fn robots() -> impl Strategy<Value = (usize, u64)> {
    (1..=40_usize, any::<u64>())
}

fn torque_first(wrench: &Wrench) -> [f64; 6] {
    let f = wrench.force_first();
    [f[3], f[4], f[5], f[0], f[1], f[2]]
}

/// The inverse of [`torque_first`].
fn wrench_of(v: &[f64]) -> Wrench {
    Wrench::from_parts([v[3], v[4], v[5]], [v[0], v[1], v[2]])
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Sum of magnitudes to which the rounding of a product is relative.
fn weight(a: &[f64], b: &[f64]) -> f64 {
    1.0 + a.iter().zip(b).map(|(x, y)| (x * y).abs()).sum::<f64>()
}

fn permutation(count: usize, random: &mut Random) -> Vec<usize> {
    let mut order: Vec<usize> = (0..count).collect();
    random.shuffle(&mut order);
    order
}

fn serialization(model: &Model, random: &mut Random) -> Serialization {
    let links = permutation(model.link_count(), random);
    Serialization::new(model, &links, &permutation(model.dof_count(), random)).unwrap()
}

/// Arbitrary parameters, also physically inconsistent ones: everything here is linear.
fn scramble(model: &mut Model, random: &mut Random) {
    for link in 0..model.link_count() {
        let parameters = [0; 10].map(|_| random.real(3.0));
        model
            .set_inertia(link, RigidInertia::from_parameters(&parameters))
            .unwrap();
    }
}

struct Moving {
    model: Model,
    state: State,
    kinematics: Kinematics,
}

impl Moving {
    fn new(links: usize, random: &mut Random) -> Self {
        Self::of(RandomRobot::new(links, random).model(), random)
    }

    fn of(mut model: Model, random: &mut Random) -> Self {
        if random.chance(50) {
            scramble(&mut model, random);
        }
        let state = State::new(&model, random);
        let mut kinematics = Kinematics::new(&model, random.below(model.link_count())).unwrap();
        kinematics
            .update(&model, state.get(), &motion(random))
            .unwrap();
        Self {
            model,
            state,
            kinematics,
        }
    }

    /// The same motion of the whole robot, from another base.
    fn seen_from(&self, base: usize) -> Kinematics {
        let mut kinematics = Kinematics::new(&self.model, base).unwrap();
        kinematics
            .update(&self.model, self.state.get(), self.kinematics.motion(base))
            .unwrap();
        kinematics
    }

    /// The wrench on the base [torque; force], then the torques by degree of freedom.
    fn truth(&self, kinematics: &Kinematics) -> Vec<f64> {
        let mut inverse = InverseDynamics::new(&self.model);
        inverse.update(&self.model, kinematics, &[]).unwrap();
        let mut all = torque_first(&inverse.base_wrench()).to_vec();
        all.extend(inverse.torque());
        all
    }
}

/// Row `i` of wrench on the base or of the joint with degree of freedom `i - 6`, through the named
/// accessors.
fn named_row(regressor: &Regressor, i: usize) -> &[f64] {
    match i {
        0..=2 => regressor.base_torque_rows()[i],
        3..=5 => regressor.base_force_rows()[i - 3],
        _ => regressor.joint_row(i - 6).unwrap(),
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 120,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// `A_l phi = ` the net wrench, column by column and for any ten numbers.
    #[test]
    fn link_regressor_times_parameters_is_the_net_wrench(seed in any::<u64>()) {
        let mut random = Random::new(seed);
        let motion = motion(&mut random);
        let regressor = link_regressor(&motion);
        let wrench = |p: &[f64; 10]| {
            torque_first(&RigidInertia::from_parameters(p).net_wrench(
                &motion.angular_velocity,
                &motion.angular_acceleration,
                &motion.proper_acceleration,
            ))
        };
        let p = [0; 10].map(|_| random.real(3.0));
        let got = regressor * nalgebra::SVector::<f64, 10>::from(p);
        prop_assert!(gap(got.as_slice(), &wrench(&p)) < 1e-13 * 1000.0);
        for column in 0..10 {
            let mut unit = [0.0; 10];
            unit[column] = 1.0;
            prop_assert!(
                gap(regressor.column(column).as_slice(), &wrench(&unit)) < 1e-13 * 10.0,
                "column {column}"
            );
        }
    }

    /// `Y phi` equals the recursive algorithm, for any base and any serialization; and every named
    /// accessor returns its row.
    #[test]
    fn regressor_times_parameters_is_inverse_dynamics((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let moving = Moving::new(links, &mut random);
        let truth = moving.truth(&moving.kinematics);
        let model = &moving.model;
        for order in [
            Serialization::of_model(model),
            serialization(model, &mut random),
        ] {
            let mut regressor = Regressor::with_serialization(model, order.clone()).unwrap();
            regressor.update(model, &moving.kinematics).unwrap();
            let phi = order.parameters(model);
            let product = regressor.transposed().tr_mul(&phi);
            prop_assert_eq!(product.len(), 6 + model.dof_count());
            for (i, &expected) in truth.iter().enumerate() {
                let row = named_row(&regressor, i);
                let scale = weight(row, phi.as_slice());
                prop_assert!(
                    (dot(row, phi.as_slice()) - expected).abs() < EXACT * scale,
                    "row {i}"
                );
                let place = if i < 6 {
                    i
                } else {
                    6 + order.dof_place(i - 6).unwrap()
                };
                prop_assert_eq!(regressor.row(place), row);
                prop_assert!((product[place] - expected).abs() < EXACT * scale);
            }
        }
        // The default is the model's order.
        let mut regressor = Regressor::new(model);
        regressor.update(model, &moving.kinematics).unwrap();
        let phi: Vec<f64> = model
            .inertias()
            .iter()
            .flat_map(RigidInertia::parameters)
            .collect();
        let row = regressor.row(5);
        prop_assert!((dot(row, &phi) - truth[5]).abs() < EXACT * weight(row, &phi));
    }

    /// Paper, proof of Lemma 1: `Y_beta,n = X* Y_b,n`. And a joint's row is zero for the links on
    /// the side of the base, eq. (12).
    #[test]
    fn another_base_carries_the_wrench_rows((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let moving = Moving::new(links, &mut random);
        let model = &moving.model;
        let order = serialization(model, &mut random);
        let mut here = Regressor::with_serialization(model, order.clone()).unwrap();
        here.update(model, &moving.kinematics).unwrap();
        let beta = random.below(model.link_count());
        let mut there = Regressor::with_serialization(model, order.clone()).unwrap();
        there.update(model, &moving.seen_from(beta)).unwrap();
        let x_b_beta = moving.kinematics.pose(beta);
        for column in 0..here.column_count() {
            let at = |regressor: &Regressor| {
                wrench_of(&[0, 1, 2, 3, 4, 5].map(|row| regressor.row(row)[column]))
            };
            let (old, new) = (at(&here), at(&there));
            let moved = x_b_beta.wrench_back(&old);
            prop_assert!(
                wrench_gap(&moved, &new) < EXACT * size(&old.force_first()),
                "column {column}"
            );
        }
        for (regressor, base) in [(&here, moving.kinematics.base()), (&there, beta)] {
            for joint in model.joints() {
                let Some(dof) = joint.dof else { continue };
                let below = |mut link: usize| {
                    while link > joint.child {
                        link = model.joints()[link - 1].parent;
                    }
                    link == joint.child
                };
                for link in 0..model.link_count() {
                    let column = order.link_column(link).unwrap();
                    let block = &regressor.joint_row(dof).unwrap()[column..column + 10];
                    prop_assert_eq!(
                        block.iter().all(|&x| x == 0.0),
                        below(link) == below(base),
                        "joint {} link {}",
                        dof,
                        link
                    );
                }
            }
        }
    }

    /// The base may change at run time without a trace of the old one.
    #[test]
    fn a_changed_base_leaves_no_trace((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let moving = Moving::new(links, &mut random);
        let model = &moving.model;
        let order = serialization(model, &mut random);
        let mut regressor = Regressor::with_serialization(model, order.clone()).unwrap();
        let mut kinematics = Kinematics::new(model, 0).unwrap();
        let (one, other) = (random.below(model.link_count()), random.below(model.link_count()));
        for base in [0, one, other, one, 0, other] {
            kinematics.set_base(model, base).unwrap();
            let state = State::new(model, &mut random);
            kinematics.update(model, state.get(), &motion(&mut random)).unwrap();
            regressor.update(model, &kinematics).unwrap();
            let mut fresh = Regressor::with_serialization(model, order.clone()).unwrap();
            fresh.update(model, &kinematics).unwrap();
            prop_assert_eq!(regressor.transposed(), fresh.transposed());
        }
    }

    /// A column is the difference that one parameter of one link makes in the recursive algorithm.
    #[test]
    fn columns_are_differences_of_inverse_dynamics((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut moving = Moving::new(links, &mut random);
        let base = moving.kinematics.base();
        let order = serialization(&moving.model, &mut random);
        let mut regressor = Regressor::with_serialization(&moving.model, order.clone()).unwrap();
        regressor.update(&moving.model, &moving.kinematics).unwrap();
        let (link, parameter) = (
            random.below(links.min(moving.model.link_count())),
            random.below(10),
        );
        let mut parameters = moving.model.inertias()[link].parameters();
        // Large steps: the function is linear, and small steps have larger rounding errors.
        let step = 4.0;
        parameters[parameter] += step;
        let before = moving.truth(&moving.seen_from(base));
        moving
            .model
            .set_inertia(link, RigidInertia::from_parameters(&parameters))
            .unwrap();
        let after = moving.truth(&moving.seen_from(base));
        let column = order.link_column(link).unwrap() + parameter;
        for i in 0..before.len() {
            let difference = (after[i] - before[i]) / step;
            let got = named_row(&regressor, i)[column];
            let scale = 1.0 + before[i].abs() + after[i].abs() + size(&before);
            prop_assert!(
                (got - difference).abs() < EXACT * scale,
                "row {i}: {got} {difference}"
            );
        }
    }
}

/// A robot in motion: known wrenches, contacts of all kinds, sensors with offsets.
struct Scene {
    model: Model,
    structure: Structure,
    sensors: Vec<SensorCut>,
    truth: Vec<Wrench>,
    known: Vec<ExternalWrench>,
    offsets: Vec<Wrench>,
    raw: Vec<Wrench>,
    state: State,
    kinematics: Kinematics,
    torque: Vec<f64>,
}

impl Scene {
    fn new(links: usize, random: &mut Random) -> Self {
        let robot = RandomRobot::new(links, random);
        let mut model = robot.model();
        let sensors = robot.sensors(&model, random);
        let (contacts, truth): (Vec<_>, Vec<_>) = (0..random.below(6))
            .map(|_| contact(&model, random))
            .unzip();
        if random.chance(50) {
            scramble(&mut model, random);
        }
        Self::with(model, sensors, contacts, truth, random)
    }

    fn with(
        model: Model,
        sensors: Vec<SensorCut>,
        contacts: Vec<ContactSpec>,
        truth: Vec<Wrench>,
        random: &mut Random,
    ) -> Self {
        let structure = Structure::new(&model, &sensors, &contacts, 0.1).unwrap();
        let state = State::new(&model, random);
        let mut kinematics = Kinematics::new(&model, random.below(model.link_count())).unwrap();
        kinematics
            .update(&model, state.get(), &motion(random))
            .unwrap();
        let mut known: Vec<ExternalWrench> = (0..random.below(4))
            .map(|_| ExternalWrench {
                frame: random.frame(&model),
                wrench: random.wrench(),
            })
            .collect();
        let mut acting = known.clone();
        acting.extend(
            contacts
                .iter()
                .zip(&truth)
                .map(|(spec, wrench)| external(spec, *wrench)),
        );
        let mut inverse = InverseDynamics::new(&model);
        inverse.update(&model, &kinematics, &acting).unwrap();
        // The remaining wrench that the motion of the base needs is a known wrench.
        let base = Frame {
            link: kinematics.base(),
            pose: Pose::identity(),
        };
        known.push(ExternalWrench {
            frame: base,
            wrench: inverse.base_wrench(),
        });
        let offsets: Vec<Wrench> = sensors.iter().map(|_| random.wrench() * 3.0).collect();
        let raw = sensors
            .iter()
            .zip(&offsets)
            .map(|(cut, offset)| {
                cut.reading(&inverse.transmitted(&kinematics, cut.joint())) + *offset
            })
            .collect();
        let torque = inverse.torque().to_vec();
        Self {
            model,
            structure,
            sensors,
            truth,
            known,
            offsets,
            raw,
            state,
            kinematics,
            torque,
        }
    }

    fn all(&self) -> ContactSet {
        ContactSet::first(self.truth.len())
    }

    fn some(&self, random: &mut Random) -> ContactSet {
        (0..self.truth.len())
            .filter(|_| random.chance(60))
            .collect()
    }

    fn stacked(&self, active: &ContactSet) -> StackedRegressor {
        let mut stacked = StackedRegressor::new(&self.structure);
        stacked
            .update(&self.kinematics, &self.raw, active, &self.known)
            .unwrap();
        stacked
    }

    fn solve(&self, kinematics: &Kinematics, offsets: &[Wrench], active: &ContactSet) -> Solver {
        let mut solver = Solver::new(&self.structure);
        let readings: Vec<_> = self
            .raw
            .iter()
            .zip(offsets)
            .map(|(raw, offset)| *raw - *offset)
            .collect();
        solver
            .solve(
                &self.model,
                &self.structure,
                kinematics,
                &readings,
                active,
                &self.known,
            )
            .unwrap();
        solver
    }

    /// A contact's true unknowns, in the order of its columns.
    fn unknowns(&self, contact: usize) -> Vec<f64> {
        let wrench = &self.truth[contact];
        match self.structure.contacts()[contact].kind {
            ContactKind::Wrench => torque_first(wrench).to_vec(),
            ContactKind::Force => wrench.force.as_slice().to_vec(),
            ContactKind::ForceAlong(direction) => vec![wrench.force.dot(&direction)],
        }
    }

    fn parameters(&self, link: usize) -> [f64; 10] {
        self.model.inertias()[link].parameters()
    }

    /// `[phi; o]` of one sub-tree, in the order of its columns.
    fn known_of(&self, links: &[usize], sensors: impl Iterator<Item = usize>) -> Vec<f64> {
        let offsets = sensors.flat_map(|sensor| torque_first(&self.offsets[sensor]));
        links
            .iter()
            .flat_map(|&link| self.parameters(link))
            .chain(offsets)
            .collect()
    }

    /// `[phi; o; x]` of all sub-trees.
    fn stacked_unknowns(&self, active: &ContactSet) -> Vec<f64> {
        let links: Vec<usize> = (0..self.model.link_count()).collect();
        let mut all = self.known_of(&links, 0..self.sensors.len());
        all.extend(active.iter().flat_map(|contact| self.unknowns(contact)));
        all
    }

    fn phi_and_offsets(&self) -> Vec<f64> {
        self.stacked_unknowns(&ContactSet::EMPTY)
    }
}

/// Rank of six rows by the eigenvalues of their Gram matrix, columns scaled to the same size.
fn rank(columns: &DMatrix<f64>) -> usize {
    let mut scaled = columns.clone();
    for mut column in scaled.column_iter_mut() {
        let norm = column.norm();
        column /= norm;
    }
    let gram = Matrix6::from_fn(|i, j| scaled.row(i).dot(&scaled.row(j)));
    let values = gram.symmetric_eigenvalues();
    values
        .iter()
        .filter(|&&value| value > 1e-9 * values.max())
        .count()
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 120,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// `Y phi + O o - C x = measured` in every sub-tree, with the truth of `InverseDynamics`.
    #[test]
    fn subtrees_balance_with_offsets_and_contacts((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let stacked = scene.stacked(&scene.all());
        prop_assert_eq!(stacked.subtrees().len(), scene.sensors.len() + 1);
        for (tree, facts) in stacked.subtrees().iter().zip(scene.structure.subtrees()) {
            prop_assert_eq!(tree.top(), facts.top);
            prop_assert!(tree.sensors().eq(facts.sensors.iter()));
            prop_assert!(
                tree.contacts()
                    .iter()
                    .map(|present| present.contact)
                    .eq(facts.contacts.iter())
            );
            let mut unknowns = scene.known_of(tree.links(), tree.sensors());
            prop_assert_eq!(tree.offset_column(), 10 * tree.links().len());
            prop_assert_eq!(tree.contact_column(), unknowns.len());
            for present in tree.contacts() {
                prop_assert_eq!(present.column, unknowns.len());
                unknowns.extend(scene.unknowns(present.contact));
                prop_assert_eq!(present.column + present.unknowns, unknowns.len());
            }
            prop_assert_eq!(tree.column_count(), unknowns.len());
            for row in 0..6 {
                let scale = weight(tree.row(row), &unknowns) + size(tree.measured());
                prop_assert!(
                    (dot(tree.row(row), &unknowns) - tree.measured()[row]).abs() < EXACT * scale,
                    "row {row}"
                );
                let as_matrix: Vec<f64> = tree.transposed().column(row).iter().copied().collect();
                prop_assert_eq!(as_matrix, tree.row(row).to_vec());
            }
        }
        // Every link is in one sub-tree.
        let mut members: Vec<usize> = stacked
            .subtrees()
            .iter()
            .flat_map(|tree| tree.links().to_vec())
            .collect();
        members.sort_unstable();
        prop_assert!(members.into_iter().eq(0..scene.model.link_count()));
    }

    /// Without contacts, and with wrong parameters, the imbalance equals the solver's residual:
    /// same rows, axes and point.
    #[test]
    fn imbalance_is_the_solvers_residual((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut scene = Scene::new(links, &mut random);
        scene.raw.iter_mut().for_each(|raw| *raw += random.wrench());
        scramble(&mut scene.model, &mut random);
        scene.kinematics = {
            let (base, mut kinematics) = (scene.kinematics.base(), scene.kinematics.clone());
            kinematics
                .update(
                    &scene.model,
                    scene.state.get(),
                    scene.kinematics.motion(base),
                )
                .unwrap();
            kinematics
        };
        let none = ContactSet::EMPTY;
        let solver = scene.solve(&scene.kinematics, &scene.offsets, &none);
        for (tree, balance) in scene
            .stacked(&none)
            .subtrees()
            .iter()
            .zip(solver.balances())
        {
            let unknowns = scene.known_of(tree.links(), tree.sensors());
            prop_assert_eq!(tree.column_count(), unknowns.len());
            let residual = torque_first(&balance.residual);
            for (row, expected) in residual.iter().enumerate() {
                let scale = weight(tree.row(row), &unknowns) + size(tree.measured());
                prop_assert!(
                    (dot(tree.row(row), &unknowns) - tree.measured()[row] - expected).abs()
                        < EXACT * scale
                );
            }
        }
    }

    /// The rows are about the sub-tree's top link and do not depend on the base of the kinematics.
    #[test]
    fn subtrees_do_not_depend_on_the_base((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        let before = scene.stacked(&active);
        let beta = random.below(scene.model.link_count());
        let mut kinematics = Kinematics::new(&scene.model, beta).unwrap();
        kinematics
            .update(
                &scene.model,
                scene.state.get(),
                scene.kinematics.motion(beta),
            )
            .unwrap();
        scene.kinematics = kinematics;
        let after = scene.stacked(&active);
        for (a, b) in before.subtrees().iter().zip(after.subtrees()) {
            for row in 0..6 {
                prop_assert!(gap(a.row(row), b.row(row)) < EXACT * size(a.row(row)));
            }
            prop_assert!(gap(a.measured(), b.measured()) < EXACT * size(a.measured()));
            prop_assert!(
                (a.covariance() - b.covariance()).amax() < EXACT * (1.0 + a.covariance().amax())
            );
        }
    }

    /// The stack consists of its blocks at the columns of links, sensors and contacts; all
    /// sub-trees together are the whole robot.
    #[test]
    fn stacked_is_the_sum_of_its_blocks((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        let stacked = scene.stacked(&active);
        let (rows, columns) = (stacked.row_count(), stacked.column_count());
        let mut dense = vec![f64::NAN; rows * columns];
        stacked.write_stacked(&mut dense).unwrap();
        let unknowns = scene.stacked_unknowns(&active);
        prop_assert_eq!(unknowns.len(), columns);
        let row = |number: usize| &dense[columns * number..columns * (number + 1)];
        let (model, offset_column) = (&scene.model, 10 * scene.model.link_count());

        // Zeros except the blocks, all of which are present.
        let mut expected = DMatrix::zeros(rows, columns);
        for (number, tree) in stacked.subtrees().iter().enumerate() {
            let mut put = |from: usize, to: usize, width: usize| {
                expected
                    .view_mut((6 * number, to), (6, width))
                    .copy_from(&tree.transposed().rows(from, width).transpose());
            };
            tree.links()
                .iter()
                .enumerate()
                .for_each(|(place, link)| put(10 * place, 10 * link, 10));
            tree.sensors().enumerate().for_each(|(place, sensor)| {
                put(
                    tree.offset_column() + 6 * place,
                    offset_column + 6 * sensor,
                    6,
                );
            });
            for present in tree.contacts() {
                let before: usize = active
                    .iter()
                    .filter(|&other| other < present.contact)
                    .map(|other| scene.structure.contacts()[other].kind.unknowns())
                    .sum();
                let start = offset_column + 6 * scene.sensors.len() + before;
                put(present.column, start, present.unknowns);
                prop_assert!(stacked.contacts().any(|one| one.contact == present.contact
                    && one.column == start
                    && one.unknowns == present.unknowns));
            }
        }
        prop_assert_eq!(stacked.contacts().count(), active.len());
        prop_assert_eq!(DMatrix::from_row_slice(rows, columns, &dense), expected);

        // Transformed to the base and added, they give the rows of the whole robot; internal
        // offsets cancel.
        let mut whole = Regressor::new(model);
        whole.update(model, &scene.kinematics).unwrap();
        for column in 0..offset_column + 6 * scene.sensors.len() {
            let (mut sum, mut scale) = (Wrench::zero(), 1.0);
            for (number, tree) in stacked.subtrees().iter().enumerate() {
                let part = wrench_of(&[0, 1, 2, 3, 4, 5].map(|i| row(6 * number + i)[column]));
                let part = scene.kinematics.pose(tree.top()).wrench(&part);
                scale += size(&part.force_first());
                sum += part;
            }
            let expected = if column < offset_column {
                wrench_of(&[0, 1, 2, 3, 4, 5].map(|i| whole.row(i)[column]))
            } else {
                Wrench::zero()
            };
            prop_assert!(wrench_gap(&sum, &expected) < EXACT * scale);
        }

        // The right side is the product of the offset columns with the readings; its covariance
        // follows from the same columns.
        let mut covariance = vec![f64::NAN; rows * rows];
        stacked.write_covariance(&mut covariance).unwrap();
        let covariance = DMatrix::from_row_slice(rows, rows, &covariance);
        let offsets = DMatrix::from_row_slice(rows, columns, &dense)
            .columns(offset_column, 6 * scene.sensors.len())
            .into_owned();
        let variances: Vec<f64> = scene
            .sensors
            .iter()
            .flat_map(|cut| {
                let noise = cut.noise();
                noise.torque.into_iter().chain(noise.force)
            })
            .map(|deviation| deviation * deviation)
            .collect();
        let expected =
            &offsets * DMatrix::from_diagonal(&DVector::from(variances)) * offsets.transpose();
        prop_assert!((&covariance - &expected).amax() < 1e-13 * (1.0 + expected.amax()));
        for (number, tree) in stacked.subtrees().iter().enumerate() {
            let block = covariance.fixed_view::<6, 6>(6 * number, 6 * number);
            prop_assert!((block - tree.covariance()).amax() < 1e-13 * (1.0 + expected.amax()));
        }
        // ... found by changing one reading.
        if let Some(sensor) = (!scene.sensors.is_empty()).then(|| random.below(scene.sensors.len()))
        {
            let mut changed = scene.raw.clone();
            let delta = random.wrench();
            changed[sensor] += delta;
            let mut other = StackedRegressor::new(&scene.structure);
            other
                .update(&scene.kinematics, &changed, &active, &scene.known)
                .unwrap();
            let expected =
                offsets.columns(6 * sensor, 6) * DVector::from_row_slice(&torque_first(&delta));
            for (number, (a, b)) in stacked.subtrees().iter().zip(other.subtrees()).enumerate() {
                let difference: Vec<f64> = b
                    .measured()
                    .iter()
                    .zip(a.measured())
                    .map(|(x, y)| x - y)
                    .collect();
                prop_assert!(
                    gap(
                        &difference,
                        &expected.as_slice()[6 * number..6 * number + 6]
                    ) < EXACT * (size(a.measured()) + size(b.measured()))
                );
            }
        }
    }

    /// The rows that remain without contact columns: their number is maximal, no contact
    /// contributes to them, and they are whitened with noise weighting.
    #[test]
    fn projected_rows_do_not_feel_the_contacts((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let active = scene.all();
        let mut stacked = scene.stacked(&active);
        prop_assert!(
            stacked.subtrees().iter().all(|tree| tree.remaining() == 0),
            "nothing is projected yet"
        );
        let solver = scene.solve(&scene.kinematics, &scene.offsets, &active);
        for weighting in [Weighting::Noise, Weighting::LengthScale] {
            stacked.eliminate_contacts(weighting);
            for (tree, balance) in stacked.subtrees().iter().zip(solver.balances()) {
                let columns = tree
                    .transposed()
                    .rows(
                        tree.contact_column(),
                        tree.column_count() - tree.contact_column(),
                    )
                    .transpose();
                let reached = if columns.ncols() == 0 {
                    0
                } else {
                    rank(&columns)
                };
                prop_assert_eq!(tree.remaining(), 6 - reached);
                prop_assert_eq!(tree.remaining(), balance.degrees);
                prop_assert_eq!(tree.projected_measured().len(), tree.remaining());
                let unknowns = scene.known_of(tree.links(), tree.sensors());
                let mut basis = DMatrix::zeros(tree.remaining(), 6);
                for row in 0..tree.remaining() {
                    // The equation holds for the true parameters and offsets with any contact
                    // wrenches.
                    let projected = tree.projected_row(row);
                    let scale = weight(projected, &unknowns) + size(tree.projected_measured());
                    prop_assert!(
                        (dot(projected, &unknowns) - tree.projected_measured()[row]).abs()
                            < 100.0 * EXACT * scale
                    );
                    // It is a combination p of the six rows; the columns of an offset, if any,
                    // determine p.
                    if tree.sensors().count() > 0 {
                        let first = tree.offset_column();
                        let own = tree.transposed().rows(first, 6).transpose();
                        let p = own
                            .transpose()
                            .lu()
                            .solve(&DVector::from_row_slice(&projected[first..first + 6]))
                            .unwrap();
                        prop_assert!(
                            gap(p.as_slice(), tree.projection(row)) < 1e-9 * size(p.as_slice())
                        );
                        let rebuilt = tree.transposed().rows(0, tree.contact_column()) * &p;
                        prop_assert!(gap(rebuilt.as_slice(), projected) < 1e-9 * size(projected));
                        let right: f64 = dot(p.as_slice(), tree.measured());
                        prop_assert!(
                            (right - tree.projected_measured()[row]).abs()
                                < 1e-9 * weight(p.as_slice(), tree.measured())
                        );
                        for column in columns.column_iter() {
                            prop_assert!(
                                p.dot(&column).abs() < 1e-8 * (1.0 + p.norm() * column.norm()),
                                "a contact reaches it"
                            );
                        }
                        basis.row_mut(row).copy_from(&p.transpose());
                    }
                }
                if tree.sensors().count() > 0 {
                    let metric = match weighting {
                        Weighting::Noise => *tree.covariance(),
                        Weighting::LengthScale => {
                            Matrix6::from_diagonal(&[0.01, 0.01, 0.01, 1.0, 1.0, 1.0].into())
                        }
                    };
                    let metric = DMatrix::from_fn(6, 6, |i, j| metric[(i, j)]);
                    let unit = &basis * metric * basis.transpose();
                    prop_assert!(
                        (unit - DMatrix::identity(tree.remaining(), tree.remaining())).amax()
                            < 1e-7
                    );
                }
            }
        }
    }

    /// All rows that remain without contacts, stacked: the true parameters and offsets satisfy
    /// them, and their covariance is that of the right side from the sensors' noise, propagated
    /// channel by channel. Its rank deficiency is that of the contacts on the robot as a whole.
    #[test]
    fn noise_goes_through_the_projected_stack((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        // The wrenches of the other contacts are known.
        for contact in scene.all().difference(&active).iter() {
            scene.known.push(external(
                &scene.structure.contacts()[contact],
                scene.truth[contact],
            ));
        }
        let unknowns = scene.phi_and_offsets();
        for weighting in [Weighting::Noise, Weighting::LengthScale] {
            let projected = |raw: &[Wrench]| {
                let mut stacked = StackedRegressor::new(&scene.structure);
                stacked
                    .update(&scene.kinematics, raw, &active, &scene.known)
                    .unwrap();
                assert_eq!(stacked.projected_row_count(), 0, "nothing is projected yet");
                stacked.eliminate_contacts(weighting);
                let (count, columns) = (stacked.projected_row_count(), stacked.contact_column());
                let (mut rows, mut measured) =
                    (vec![f64::NAN; count * columns], vec![f64::NAN; count]);
                stacked.write_projected(&mut rows, &mut measured).unwrap();
                (
                    stacked,
                    DMatrix::from_row_slice(count, columns, &rows),
                    DVector::from_vec(measured),
                )
            };
            let (stacked, rows, measured) = projected(&scene.raw);
            let count = rows.nrows();
            prop_assert_eq!(rows.ncols(), unknowns.len());
            for i in 0..count {
                let row: Vec<f64> = rows.row(i).iter().copied().collect();
                let scale = weight(&row, &unknowns) + size(measured.as_slice());
                prop_assert!((dot(&row, &unknowns) - measured[i]).abs() < 100.0 * EXACT * scale);
            }
            let mut covariance = vec![f64::NAN; count * count];
            stacked.write_projected_covariance(&mut covariance).unwrap();
            let covariance = DMatrix::from_row_slice(count, count, &covariance);

            // One deviation of one channel at a time; they are independent.
            let mut expected = DMatrix::zeros(count, count);
            for (sensor, cut) in scene.sensors.iter().enumerate() {
                let noise = cut.noise();
                for (channel, deviation) in noise.torque.into_iter().chain(noise.force).enumerate()
                {
                    let mut disturbed = scene.raw.clone();
                    let mut change = [0.0; 6];
                    // A large step reduces rounding; the right side is linear in the readings.
                    change[channel] = 1e4 * deviation;
                    disturbed[sensor] += wrench_of(&change);
                    let effect = (projected(&disturbed).2 - &measured) / 1e4;
                    expected += &effect * effect.transpose();
                }
            }
            let scale = 1.0 + expected.amax();
            prop_assert!(
                (&covariance - &expected).amax() < 1e-7 * scale,
                "{}",
                (&covariance - &expected).amax()
            );

            // Block by block.
            let starts: Vec<usize> = stacked
                .subtrees()
                .iter()
                .scan(0, |next, tree| {
                    *next += tree.remaining();
                    Some(*next - tree.remaining())
                })
                .collect();
            for (a, &from) in stacked.subtrees().iter().zip(&starts) {
                for (b, &to) in stacked.subtrees().iter().zip(&starts) {
                    let block = covariance.view((from, to), (a.remaining(), b.remaining()));
                    if from == to
                        && a.top() == b.top()
                        && weighting == Weighting::Noise
                        && a.sensors().count() > 0
                    {
                        let unit = DMatrix::identity(a.remaining(), a.remaining());
                        prop_assert!((block - unit).amax() < 1e-7, "whitened by itself");
                    } else if !a
                        .sensors()
                        .any(|sensor| b.sensors().any(|other| other == sensor))
                    {
                        prop_assert!(block.iter().all(|&x| x == 0.0), "no sensor in common");
                    } else if a.top() != b.top() && a.remaining() == 6 && b.remaining() == 6 {
                        prop_assert!(block.amax() > 0.0, "neighbours are correlated");
                    }
                }
            }

            // Its rank deficiency is six minus the rank of all contacts together on the robot as a
            // rigid body.
            if count > 0 && weighting == Weighting::Noise {
                let mut columns = Vec::new();
                for tree in stacked.subtrees() {
                    for column in tree.contact_column()..tree.column_count() {
                        let own = wrench_of(&[0, 1, 2, 3, 4, 5].map(|row| tree.row(row)[column]));
                        columns.push(DVector::from_row_slice(&torque_first(
                            &scene.kinematics.pose(tree.top()).wrench(&own),
                        )));
                    }
                }
                let held = if columns.is_empty() {
                    0
                } else {
                    rank(&DMatrix::from_columns(&columns))
                };
                let silent = covariance
                    .symmetric_eigenvalues()
                    .iter()
                    .filter(|&&value| value < 1e-10)
                    .count();
                prop_assert_eq!(silent, 6 - held, "{} rows", count);
            }
        }
    }

    /// The rows of the estimates, the part of the raw readings and that of the known wrenches add
    /// up to the solver's results, for any set of contacts and any certainty, with true and with
    /// wrong offsets.
    #[test]
    fn estimate_rows_make_up_the_solvers_results((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut scene = Scene::new(links, &mut random);
        if random.chance(50) {
            scene
                .offsets
                .iter_mut()
                .for_each(|offset| *offset = random.wrench());
        }
        let active = scene.some(&mut random);
        let solver = scene.solve(&scene.kinematics, &scene.offsets, &active);
        let rows = EstimateRows::new(&scene.structure, &solver, &scene.kinematics).unwrap();
        let unknowns = scene.phi_and_offsets();
        prop_assert_eq!(rows.stacked_column_count(), unknowns.len());
        let stacked = scene.stacked(&active);
        let mut row = vec![f64::NAN; unknowns.len()];
        for dof in 0..scene.model.dof_count() {
            scene.torque_row(&rows, dof, &mut row);
            // Over the columns of the sub-tree's equations.
            let tree = &stacked.subtrees()[rows.torque_subtree(dof).unwrap()];
            let mut own = vec![f64::NAN; tree.contact_column()];
            rows.torque_row(dof, &mut own).unwrap();
            let of_tree = scene.known_of(tree.links(), tree.sensors());
            prop_assert!(
                (dot(&own, &of_tree) - dot(&row, &unknowns)).abs()
                    < EXACT * weight(&row, &unknowns)
            );
            let measured = rows.torque_measured(dof, &scene.raw, &scene.known).unwrap();
            let scale = weight(&row, &unknowns) + measured.abs() + scene.raw_weight(&row);
            prop_assert!(
                (dot(&row, &unknowns) + measured - solver.torque()[dof]).abs() < EXACT * scale,
                "dof {dof}"
            );
        }
        for contact in 0..scene.truth.len() {
            for component in 0..6 {
                scene.contact_row(&rows, contact, component, &mut row);
                let measured = rows
                    .contact_measured(contact, component, &scene.raw, &scene.known)
                    .unwrap();
                let expected = torque_first(&solver.contacts()[contact].wrench)[component];
                let scale = weight(&row, &unknowns) + measured.abs() + scene.raw_weight(&row);
                prop_assert!(
                    (dot(&row, &unknowns) + measured - expected).abs() < EXACT * scale,
                    "contact {contact}.{component}"
                );
                if solver.contacts()[contact].certainty == Certainty::Absent {
                    prop_assert!(row.iter().all(|&x| x == 0.0));
                }
            }
        }
    }

    /// Each entry of the rows is the change of the solver's result by one parameter or one offset.
    #[test]
    fn estimate_rows_are_differences_of_the_solver((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        let before = scene.solve(&scene.kinematics, &scene.offsets, &active);
        let at_first = scene.kinematics.clone();
        let structure = scene.structure.clone();
        let rows = EstimateRows::new(&structure, &before, &at_first).unwrap();
        let mut row = vec![f64::NAN; rows.stacked_column_count()];
        let step = 4.0;

        let (link, parameter) = (random.below(scene.model.link_count()), random.below(10));
        let mut parameters = scene.parameters(link);
        parameters[parameter] += step;
        scene
            .model
            .set_inertia(link, RigidInertia::from_parameters(&parameters))
            .unwrap();
        let mut kinematics = scene.kinematics.clone();
        let base = kinematics.base();
        kinematics
            .update(
                &scene.model,
                scene.state.get(),
                scene.kinematics.motion(base),
            )
            .unwrap();
        let mut changes = vec![(
            10 * link + parameter,
            scene.solve(&kinematics, &scene.offsets, &active),
        )];
        if !scene.sensors.is_empty() {
            let (sensor, channel) = (random.below(scene.sensors.len()), random.below(6));
            let mut offsets = scene.offsets.clone();
            let mut numbers = torque_first(&offsets[sensor]);
            numbers[channel] += step;
            offsets[sensor] = wrench_of(&numbers);
            let column = 10 * scene.model.link_count() + 6 * sensor + channel;
            changes.push((column, scene.solve(&scene.kinematics, &offsets, &active)));
        }
        for (column, after) in changes {
            for dof in 0..scene.model.dof_count() {
                scene.torque_row(&rows, dof, &mut row);
                let difference = (after.torque()[dof] - before.torque()[dof]) / step;
                let scale = scene.raw_weight(&row) + size(before.torque()) + size(&row);
                prop_assert!(
                    (row[column] - difference).abs() < EXACT * scale,
                    "dof {dof} column {column}: {} {difference}",
                    row[column]
                );
            }
            for contact in 0..scene.truth.len() {
                for component in 0..6 {
                    scene.contact_row(&rows, contact, component, &mut row);
                    let of = |solver: &Solver| {
                        torque_first(&solver.contacts()[contact].wrench)[component]
                    };
                    let difference = (of(&after) - of(&before)) / step;
                    let scale = scene.raw_weight(&row) + of(&before).abs() + size(&row);
                    prop_assert!(
                        (row[column] - difference).abs() < EXACT * scale,
                        "contact {contact}.{component} column {column}"
                    );
                }
            }
        }
    }

    /// `T P T^T`: with the sensors' noise as the covariance of their offsets it equals the solver's
    /// variance for that noise.
    #[test]
    fn covariance_of_offsets_acts_as_noise_does((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        let mut solver = scene.solve(&scene.kinematics, &scene.offsets, &active);
        solver.update_deviations(&scene.structure).unwrap();
        let rows = EstimateRows::new(&scene.structure, &solver, &scene.kinematics).unwrap();
        let deviations: Vec<f64> = scene
            .sensors
            .iter()
            .flat_map(|cut| {
                let noise = cut.noise();
                noise.torque.into_iter().chain(noise.force)
            })
            .collect();
        let mut row = vec![f64::NAN; rows.stacked_column_count()];
        let deviation = |row: &[f64]| {
            let own = &row[10 * scene.model.link_count()..];
            own.iter()
                .zip(&deviations)
                .map(|(a, b)| (a * b).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        for dof in 0..scene.model.dof_count() {
            scene.torque_row(&rows, dof, &mut row);
            let expected = solver.torque_deviation()[dof];
            prop_assert!((deviation(&row) - expected).abs() < 1e-9 * (1.0 + expected));
        }
        for contact in 0..scene.truth.len() {
            for component in 0..6 {
                scene.contact_row(&rows, contact, component, &mut row);
                let expected = solver.contacts()[contact].deviation[(component + 3) % 6];
                prop_assert!((deviation(&row) - expected).abs() < 1e-9 * (1.0 + expected));
            }
        }
    }
}

impl Scene {
    /// A torque's row over the columns of all sub-trees.
    fn torque_row(&self, rows: &EstimateRows<'_>, dof: usize, stacked: &mut [f64]) {
        let subtree = rows.torque_subtree(dof).unwrap();
        let mut own = vec![f64::NAN; rows.column_count(subtree).unwrap()];
        rows.torque_row(dof, &mut own).unwrap();
        stacked.fill(f64::NAN);
        rows.expand(subtree, &own, stacked).unwrap();
    }

    /// Likewise of a contact's component.
    fn contact_row(
        &self,
        rows: &EstimateRows<'_>,
        contact: usize,
        component: usize,
        stacked: &mut [f64],
    ) {
        let subtree = rows.contact_subtree(contact).unwrap();
        assert_eq!(
            Some(subtree),
            self.structure
                .subtree_of(self.structure.contacts()[contact].frame.link)
        );
        let mut own = vec![f64::NAN; rows.column_count(subtree).unwrap()];
        rows.contact_row(contact, component, &mut own).unwrap();
        stacked.fill(f64::NAN);
        rows.expand(subtree, &own, stacked).unwrap();
    }

    /// Magnitude to which the rounding of the readings' part of a row is relative.
    fn raw_weight(&self, row: &[f64]) -> f64 {
        let first = 10 * self.model.link_count();
        let raw: Vec<f64> = self.raw.iter().flat_map(torque_first).collect();
        let known: f64 = self
            .known
            .iter()
            .map(|known| size(&known.wrench.force_first()))
            .sum();
        weight(&row[first..], &raw) + known + size(&raw) + size(&self.torque)
    }
}

// ---------------------------------------------------------------- motors

/// Groups of two and three joints, coupled at random, as long as joints remain.
fn couplings(dofs: usize, random: &mut Random) -> Vec<Coupling> {
    let order = permutation(dofs, random);
    let mut groups = Vec::new();
    let mut rest = order.as_slice();
    while rest.len() >= 3 && groups.len() < 3 {
        let (own, others) = rest.split_at(2 + random.below(2));
        rest = others;
        let gear = 1.0 + 100.0 * random.real(1.0).abs();
        let n = own.len();
        // Diagonally dominant, so never singular.
        let matrix = DMatrix::from_fn(n, n, |i, j| {
            gear * (random.real(0.4) + if i == j { 1.5 } else { 0.0 })
        });
        groups.push(Coupling {
            name: format!("group {}", groups.len()),
            dofs: own.to_vec(),
            matrix,
        });
    }
    groups
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 120,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// Power is preserved, and the three maps are consistent.
    #[test]
    fn transmission_keeps_power(dofs in 0..30_usize, seed in any::<u64>()) {
        let mut random = Random::new(seed);
        let transmission = Transmission::new(dofs, &couplings(dofs, &mut random)).unwrap();
        let (rates, torques) = (random.reals(dofs, 2.0), random.reals(dofs, 50.0));
        let (mut motor_rates, mut motor_torques, mut back) =
            (vec![0.0; dofs], vec![0.0; dofs], vec![0.0; dofs]);
        transmission.motor_rates(&rates, &mut motor_rates).unwrap();
        transmission
            .motor_torques(&torques, &mut motor_torques)
            .unwrap();
        transmission
            .joint_torques(&motor_torques, &mut back)
            .unwrap();
        let power = dot(&rates, &torques);
        prop_assert!(
            (dot(&motor_rates, &motor_torques) - power).abs() < EXACT * weight(&rates, &torques)
        );
        prop_assert!(gap(&back, &torques) < EXACT * 50.0);
    }

    /// Motor rows: `M^T tau_m` of the part of the links is the joint torque; the other terms are
    /// those of each motor, as in the formula.
    #[test]
    fn motor_rows_are_joint_rows_and_what_the_motor_adds((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let moving = Moving::new(links, &mut random);
        let (model, dofs) = (&moving.model, moving.model.dof_count());
        let order = serialization(model, &mut random);
        let mut regressor = Regressor::with_serialization(model, order.clone()).unwrap();
        regressor.update(model, &moving.kinematics).unwrap();
        let coupled = couplings(dofs, &mut random);
        let actuators: Vec<Actuator> = (0..dofs)
            .map(|_| Actuator {
                rotor_inertia: random.chance(50),
                coulomb: random.chance(50).then(|| 0.01 + random.real(0.1).abs()),
                viscous: random.chance(50),
                offset: random.chance(50),
            })
            .collect();
        let transmission = Transmission::new(dofs, &coupled).unwrap();
        let mut motors =
            MotorRegressor::new(regressor.column_count(), transmission.clone(), &actuators)
                .unwrap();
        motors
            .update(|dof| regressor.joint_row(dof), moving.state.get())
            .unwrap();

        // Parameters of the motors, by motor and term.
        let terms = [
            MotorTerm::RotorInertia,
            MotorTerm::Coulomb,
            MotorTerm::Viscous,
            MotorTerm::Offset,
        ];
        let own: Vec<[f64; 4]> = (0..dofs)
            .map(|_| [0; 4].map(|_| random.real(2.0)))
            .collect();
        let mut unknowns = order.parameters(model).as_slice().to_vec();
        unknowns.resize(motors.column_count(), f64::NAN);
        for motor in 0..dofs {
            let has = [
                actuators[motor].rotor_inertia,
                actuators[motor].coulomb.is_some(),
                actuators[motor].viscous,
                actuators[motor].offset,
            ];
            for term in 0..4 {
                let column = motors.column(motor, terms[term]);
                prop_assert_eq!(column.is_some(), has[term]);
                if let Some(column) = column {
                    prop_assert!(unknowns[column].is_nan(), "no column twice");
                    unknowns[column] = own[motor][term];
                }
            }
        }
        prop_assert!(
            unknowns.iter().all(|x| x.is_finite()),
            "every column is some term's"
        );
        prop_assert_eq!(motors.column(dofs, MotorTerm::Offset), None);

        // By hand: rates M dq, torques by solving M^T tau_m = tau_j.
        let (mut rates, mut accelerations, mut torques) = (
            moving.state.0[1].clone(),
            moving.state.0[2].clone(),
            moving.truth(&moving.kinematics)[6..].to_vec(),
        );
        for group in &coupled {
            let pick = |values: &[f64]| {
                DVector::from_iterator(group.dofs.len(), group.dofs.iter().map(|&dof| values[dof]))
            };
            let (dq, ddq) = (
                &group.matrix * pick(&moving.state.0[1]),
                &group.matrix * pick(&moving.state.0[2]),
            );
            let tau = group
                .matrix
                .transpose()
                .lu()
                .solve(&pick(&torques))
                .unwrap();
            for (i, &dof) in group.dofs.iter().enumerate() {
                (rates[dof], accelerations[dof], torques[dof]) = (dq[i], ddq[i], tau[i]);
            }
        }
        let product = motors
            .transposed()
            .tr_mul(&DVector::from_row_slice(&unknowns));
        for motor in 0..dofs {
            let [inertia, coulomb, viscous, offset] = own[motor];
            let actuator = &actuators[motor];
            let mut expected = torques[motor];
            if actuator.rotor_inertia {
                expected += inertia * accelerations[motor];
            }
            if let Some(speed) = actuator.coulomb {
                let e = (2.0 * rates[motor].abs() / speed).exp();
                let smooth = if e.is_finite() {
                    (e - 1.0) / (e + 1.0)
                } else {
                    1.0
                };
                expected += coulomb * smooth.copysign(rates[motor]);
            }
            if actuator.viscous {
                expected += viscous * rates[motor];
            }
            if actuator.offset {
                expected += offset;
            }
            let scale = weight(motors.row(motor), &unknowns);
            prop_assert!(
                (dot(motors.row(motor), &unknowns) - expected).abs() < EXACT * scale,
                "motor {motor}"
            );
            prop_assert!((product[motor] - expected).abs() < EXACT * scale);
        }

        // The identity is the joint side.
        let mut direct = MotorRegressor::new(
            regressor.column_count(),
            Transmission::direct(dofs),
            &vec![Actuator::default(); dofs],
        )
        .unwrap();
        direct
            .update(|dof| regressor.joint_row(dof), moving.state.get())
            .unwrap();
        prop_assert_eq!(direct.column_count(), regressor.column_count());
        for dof in 0..dofs {
            prop_assert_eq!(direct.row(dof), regressor.joint_row(dof).unwrap());
        }
    }
}

/// The shoulder of the iCub: three motors move three joints through tendons. Numbers by hand.
#[test]
fn coupled_shoulder() {
    let matrix = DMatrix::from_row_slice(3, 3, &[1.0, 0.0, 0.0, 1.0, -2.0, 0.0, 0.0, 2.0, 2.0]);
    let shoulder = Coupling {
        name: "shoulder".to_owned(),
        dofs: vec![3, 0, 2],
        matrix,
    };
    let transmission = Transmission::new(5, &[shoulder]).unwrap();
    let mut rates = [0.0; 5];
    // Joints 3, 0, 2 rotate at 1, 10, 100.
    transmission
        .motor_rates(&[10.0, 7.0, 100.0, 1.0, 8.0], &mut rates)
        .unwrap();
    assert_eq!(rates, [-19.0, 7.0, 220.0, 1.0, 8.0]);
    let mut torques = [0.0; 5];
    transmission
        .motor_torques(&[10.0, 7.0, 100.0, 1.0, 8.0], &mut torques)
        .unwrap();
    // M^T tau_m = tau_j: tau_m2 = 50, tau_m1 = (2 * 50 - 10) / 2 = 45, tau_m0 = 1 - 45.
    assert_eq!(torques, [45.0, 7.0, 50.0, -44.0, 8.0]);
    assert_eq!(transmission.motor_count(), 5);
}

#[test]
fn invalid_motors_are_refused_with_their_group() {
    let group = |name: &str, dofs: &[usize], values: &[f64]| Coupling {
        name: name.to_owned(),
        dofs: dofs.to_vec(),
        matrix: DMatrix::from_row_slice(values.len() / dofs.len(), dofs.len(), values),
    };
    let refused = |couplings: &[Coupling]| Transmission::new(4, couplings).unwrap_err();
    let singular = |name: &str| MotorError::Singular {
        group: name.to_owned(),
    };
    let good = group("torso", &[0, 1], &[1.0, 0.0, 0.0, 1.0]);
    for values in [
        [1.0, 2.0, 2.0, 4.0],
        [0.1, 0.3, 0.2, 0.6],
        [1.0, 2.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 1.0],
        [0.0; 4],
        [f64::NAN, 0.0, 0.0, 1.0],
        [1.0, f64::INFINITY, 0.0, 1.0],
    ] {
        assert_eq!(
            refused(&[good.clone(), group("wrist", &[2, 3], &values)]),
            singular("wrist"),
            "{values:?}"
        );
    }
    let three = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];
    assert_eq!(
        refused(&[group("shoulder", &[1, 2, 3], &three)]),
        singular("shoulder")
    );
    // Units do not make a matrix singular: 1e6 motor turns per metre beside one per turn.
    assert!(Transmission::new(4, &[group("mixed", &[2, 3], &[1e6, 0.5, 1e-6, 1e-12])]).is_ok());
    assert_eq!(
        refused(&[good.clone(), group("wrist", &[2, 1], &[1.0, 0.0, 0.0, 1.0])]),
        MotorError::Twice {
            group: "wrist".to_owned(),
            dof: 1
        }
    );
    assert_eq!(
        refused(&[group("wrist", &[2, 2], &[1.0, 0.0, 0.0, 1.0])]),
        MotorError::Twice {
            group: "wrist".to_owned(),
            dof: 2
        }
    );
    assert_eq!(
        refused(&[group("wrist", &[2, 4], &[1.0, 0.0, 0.0, 1.0])]),
        MotorError::NoDof {
            group: "wrist".to_owned(),
            dof: 4
        }
    );
    assert_eq!(
        refused(&[group("wrist", &[2, 3], &[1.0, 0.0])]),
        MotorError::Shape {
            group: "wrist".to_owned(),
            rows: 1,
            columns: 2,
            dofs: 2
        }
    );
    assert!(
        refused(&[group("wrist", &[2, 3], &[1.0, 1.0, 1.0, 1.0])])
            .to_string()
            .contains("wrist")
    );

    let mut random = Random::new(3);
    let moving = Moving::new(20, &mut random);
    let dofs = moving.model.dof_count();
    assert!(dofs > 3);
    let mut regressor = Regressor::new(&moving.model);
    regressor.update(&moving.model, &moving.kinematics).unwrap();
    let build = |dofs: usize, actuators: &[Actuator]| {
        MotorRegressor::new(
            regressor.column_count(),
            Transmission::direct(dofs),
            actuators,
        )
        .map(|motors| motors.column_count())
    };
    assert_eq!(
        build(dofs, &[]),
        Err(MotorError::Actuators {
            got: 0,
            expected: dofs
        })
    );
    for speed in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let mut actuators = vec![Actuator::default(); dofs];
        actuators[2].coulomb = Some(speed);
        assert!(
            matches!(
                build(dofs, &actuators),
                Err(MotorError::Speed { motor: 2, .. })
            ),
            "{speed}"
        );
    }

    // At run time: refused input changes nothing.
    let actuators = vec![
        Actuator {
            viscous: true,
            rotor_inertia: true,
            ..Actuator::default()
        };
        dofs
    ];
    let mut motors = MotorRegressor::new(
        regressor.column_count(),
        Transmission::direct(dofs),
        &actuators,
    )
    .unwrap();
    motors
        .update(|dof| regressor.joint_row(dof), moving.state.get())
        .unwrap();
    let before = motors.transposed().into_owned();
    let good = vec![1.0; dofs];
    let mut bad = good.clone();
    bad[1] = f64::NAN;
    for (velocity, acceleration) in [
        (&bad, &good),
        (&good, &bad),
        (&vec![1.0; dofs - 1], &good),
        (&good, &vec![]),
    ] {
        let state = JointState {
            position: &good,
            velocity,
            acceleration,
        };
        assert!(
            motors
                .update(|dof| regressor.joint_row(dof), state)
                .is_err()
        );
        assert_eq!(motors.transposed(), before);
    }
    let other = Regressor::new(&Moving::new(7, &mut random).model);
    assert!(
        motors
            .update(|dof| other.joint_row(dof), moving.state.get())
            .is_err()
    );
    assert_eq!(motors.transposed(), before);
    let last = |dof| (dof + 1 < dofs).then(|| regressor.row(6 + dof));
    assert_eq!(
        motors.update(last, moving.state.get()),
        Err(DynamicsError::Index {
            what: "joints with a row",
            index: dofs - 1,
            count: dofs
        })
    );
    assert_eq!(motors.transposed(), before);
    assert!(
        motors
            .transmission()
            .motor_rates(&good, &mut [0.0])
            .is_err()
    );
}

// ---------------------------------------------------------------- refusals

#[test]
fn serializations_name_every_number_once() {
    let mut random = Random::new(11);
    let model = Moving::new(9, &mut random).model;
    let (links, dofs): (Vec<usize>, Vec<usize>) = (
        (0..model.link_count()).collect(),
        (0..model.dof_count()).collect(),
    );
    let refused =
        |links: &[usize], dofs: &[usize]| Serialization::new(&model, links, dofs).unwrap_err();
    let what = "links";
    let (mut twice, mut unknown) = (links.clone(), links.clone());
    twice[3] = 2;
    unknown[3] = 100;
    assert_eq!(
        refused(&twice, &dofs),
        SerializationError::Twice { what, number: 2 }
    );
    assert_eq!(
        refused(&unknown, &dofs),
        SerializationError::Unknown { what, number: 100 }
    );
    let expected = links.len();
    assert_eq!(
        refused(&links[1..], &dofs),
        SerializationError::Count {
            what,
            got: expected - 1,
            expected
        }
    );
    let error = refused(&links, &[]);
    assert!(
        matches!(error, SerializationError::Count { what, got: 0, .. }
            if what == "degrees of freedom")
    );
    assert_eq!(
        Serialization::new(&model, &links, &dofs),
        Ok(Serialization::of_model(&model))
    );
    let order = Serialization::of_model(&model);
    assert_eq!((order.link_column(100), order.dof_place(100)), (None, None));
}

#[test]
fn what_does_not_fit_is_refused_and_changes_nothing() {
    let mut random = Random::new(29);
    let scene = loop {
        let scene = Scene::new(24, &mut random);
        if scene.sensors.len() > 1 && scene.truth.len() > 2 && scene.model.dof_count() > 4 {
            break scene;
        }
    };
    let other = Scene::new(7, &mut random);
    let active = scene.all();

    let mut regressor = Regressor::new(&scene.model);
    regressor.update(&scene.model, &scene.kinematics).unwrap();
    let before = regressor.transposed().into_owned();
    assert!(matches!(
        regressor.update(&other.model, &scene.kinematics),
        Err(DynamicsError::Size { .. })
    ));
    assert!(matches!(
        regressor.update(&scene.model, &other.kinematics),
        Err(DynamicsError::Size { .. })
    ));
    assert_eq!(regressor.transposed(), before);
    let order = Serialization::of_model(&other.model);
    assert!(matches!(
        Regressor::with_serialization(&scene.model, order),
        Err(DynamicsError::Size { .. })
    ));
    assert_eq!(regressor.joint_row(1000), None);

    let mut stacked = scene.stacked(&active);
    stacked.eliminate_contacts(Weighting::Noise);
    let read = |stacked: &StackedRegressor| {
        let trees = stacked.subtrees().iter();
        trees
            .map(|tree| {
                (
                    tree.transposed().into_owned(),
                    *tree.measured(),
                    *tree.covariance(),
                    tree.projected_measured().to_vec(),
                )
            })
            .collect::<Vec<_>>()
    };
    let before = read(&stacked);
    let mut not_finite = scene.raw.clone();
    not_finite[1].force.y = f64::NAN;
    let mut infinite = scene.known.clone();
    infinite[0].wrench.torque.z = f64::INFINITY;
    let mut nowhere = scene.known.clone();
    nowhere[0].frame.link = 1000;
    let mut try_with = |kinematics, readings, external| {
        let got = stacked.update(kinematics, readings, &active, external);
        assert_eq!(read(&stacked), before);
        got.unwrap_err()
    };
    let s = &scene;
    assert!(matches!(
        try_with(&other.kinematics, &s.raw, &s.known),
        DynamicsError::Size { .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &s.raw[1..], &s.known),
        DynamicsError::Size { .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &not_finite, &s.known),
        DynamicsError::NotFinite { index: 1, .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &s.raw, &infinite),
        DynamicsError::NotFinite { index: 0, .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &s.raw, &nowhere),
        DynamicsError::NoLink(1000)
    ));
    let mut small = vec![3.0; 5];
    assert!(
        stacked.write_stacked(&mut small).is_err() && stacked.write_covariance(&mut small).is_err()
    );
    assert!(stacked.write_projected(&mut small, &mut []).is_err());
    let (rows, columns) = (stacked.projected_row_count(), stacked.contact_column());
    let mut right_side = vec![3.0; rows + 1];
    let mut wide = vec![3.0; rows * columns];
    assert!(
        stacked.write_projected(&mut wide, &mut right_side).is_err()
            && right_side == vec![3.0; rows + 1]
    );
    assert!(wide.iter().all(|&x| x == 3.0));
    assert!(
        stacked
            .write_projected_covariance(&mut vec![3.0; rows * rows + 1])
            .is_err()
    );
    assert_eq!(small, vec![3.0; 5]);

    let solver = scene.solve(&scene.kinematics, &scene.offsets, &active);
    assert!(EstimateRows::new(&scene.structure, &solver, &other.kinematics).is_err());
    assert!(EstimateRows::new(&other.structure, &solver, &scene.kinematics).is_err());
    // Before a solution, or after one of another base or other positions, there are no rows.
    let refused = |solver: &Solver, kinematics: &Kinematics| {
        EstimateRows::new(&scene.structure, solver, kinematics).map(|_| ())
            == Err(DynamicsError::NotSolved)
    };
    assert!(refused(&Solver::new(&scene.structure), &scene.kinematics));
    let (state, mut moved) = (
        State::new(&scene.model, &mut random),
        scene.kinematics.clone(),
    );
    moved
        .update(&scene.model, state.get(), &motion(&mut random))
        .unwrap();
    assert!(refused(&solver, &moved));
    let beta = (scene.kinematics.base() + 1) % scene.model.link_count();
    let mut elsewhere = Kinematics::new(&scene.model, beta).unwrap();
    elsewhere
        .update(
            &scene.model,
            scene.state.get(),
            scene.kinematics.motion(beta),
        )
        .unwrap();
    assert!(refused(&solver, &elsewhere));
    let rows = EstimateRows::new(&scene.structure, &solver, &scene.kinematics).unwrap();
    assert!(rows.torque_row(0, &mut small).is_err() && rows.contact_row(0, 0, &mut small).is_err());
    assert_eq!(small, vec![3.0; 5]);
    let dof_tree = rows.torque_subtree(0).unwrap();
    let mut row = vec![3.0; rows.column_count(dof_tree).unwrap()];
    let mut expanded = vec![3.0; rows.stacked_column_count()];
    assert!(
        rows.expand(dof_tree, &row, &mut small).is_err()
            && rows.expand(dof_tree, &small, &mut expanded).is_err()
    );
    assert!(matches!(
        rows.expand(1000, &row, &mut expanded),
        Err(DynamicsError::Index { index: 1000, .. })
    ));
    assert!(expanded.iter().all(|&x| x == 3.0));
    assert_eq!(small, vec![3.0; 5]);
    let none = (
        rows.torque_subtree(1000),
        rows.contact_subtree(1000),
        rows.column_count(1000),
    );
    assert_eq!(none, (None, None, None));
    assert!(matches!(
        rows.torque_row(1000, &mut row),
        Err(DynamicsError::Index { index: 1000, .. })
    ));
    assert!(matches!(
        rows.contact_row(1000, 0, &mut row),
        Err(DynamicsError::Index { index: 1000, .. })
    ));
    assert!(matches!(
        rows.contact_row(0, 6, &mut row),
        Err(DynamicsError::Index {
            index: 6,
            count: 6,
            ..
        })
    ));
    assert!(row.iter().all(|&x| x == 3.0));
    assert!(rows.torque_measured(0, &scene.raw[1..], &[]).is_err());
    assert!(rows.torque_measured(0, &scene.raw, &nowhere).is_err());
    assert!(rows.torque_measured(0, &not_finite, &[]).is_err());
}

/// Degenerate sets of contacts: repeated, collinear, more than six unknowns. The number of
/// remaining rows is correct, and no result is NaN.
#[test]
fn degenerate_contacts_leave_the_right_number_of_rows() {
    let mut random = Random::new(41);
    let robot = loop {
        let robot = RandomRobot::new(12, &mut random);
        if !robot.cuts.is_empty() {
            break robot;
        }
    };
    let model = robot.model();
    let frame = Frame {
        link: model.link_count() - 1,
        pose: random.pose(),
    };
    let (a, b) = (random.vector(0.2), random.vector(0.2));
    let spec = |kind, position| ContactSpec {
        frame,
        kind,
        position,
    };
    let along = random.vector(1.0);
    use ContactKind::{Force, ForceAlong, Wrench as Full};
    for (contacts, remaining) in [
        (vec![], 6),
        (vec![spec(Full, a)], 0),
        (vec![spec(Force, a)], 3),
        (vec![spec(ForceAlong(along), a)], 5),
        // The same contact twice; two on one line; three forces at three points. The force along
        // the line between two points stays undetermined.
        (vec![spec(Force, a), spec(Force, a)], 3),
        (
            vec![
                spec(ForceAlong(along), a),
                spec(ForceAlong(-along), a + along),
            ],
            5,
        ),
        (vec![spec(Force, a), spec(Force, b)], 1),
        (vec![spec(Full, a), spec(Full, b), spec(Force, b)], 0),
    ] {
        let sensors = robot.sensors(&model, &mut random);
        let truth = contacts
            .iter()
            .map(|spec| {
                let force = match spec.kind {
                    ForceAlong(direction) => direction.normalize() * random.real(50.0),
                    _ => random.vector(50.0),
                };
                Wrench {
                    torque: spec.position.cross(&force),
                    force,
                }
            })
            .collect();
        let scene = Scene::with(model.clone(), sensors, contacts, truth, &mut random);
        let number = scene.structure.subtree_of(frame.link).unwrap();
        let mut stacked = scene.stacked(&scene.all());
        for weighting in [Weighting::Noise, Weighting::LengthScale] {
            stacked.eliminate_contacts(weighting);
            let tree = &stacked.subtrees()[number];
            assert_eq!(tree.remaining(), remaining);
            let unknowns = scene.known_of(tree.links(), tree.sensors());
            for row in 0..remaining {
                let scale =
                    weight(tree.projected_row(row), &unknowns) + size(tree.projected_measured());
                let left = dot(tree.projected_row(row), &unknowns) - tree.projected_measured()[row];
                assert!(left.abs() < 1e-9 * scale, "{left}");
            }
        }
    }
}

#[test]
#[should_panic(expected = "0 rows remain")]
fn projected_rows_need_projecting() {
    let mut random = Random::new(5);
    let scene = Scene::new(3, &mut random);
    scene.stacked(&scene.all()).subtrees()[0].projected_row(0);
}

// ---------------------------------------------------------------- golden files

/// 30 random states of an arm on a moving chest, by Pinocchio: `Y phi` gives its base wrench and
/// torques, the arm's six rows its F/T reading.
#[test]
fn arm_on_a_moving_chest() {
    let folder = std::path::PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..");
    let model = Model::from_file(
        &folder.join("config/icub_left_arm/model.urdf"),
        &["l_arm_ft_sensor"],
    )
    .unwrap();
    let element = model.sensors()[0].clone();
    let noise = proprio_dynamics::Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let cut = SensorCut::new(
        &model,
        &element.joint,
        element.frame,
        element.direction,
        &element.pose,
        &noise,
    )
    .unwrap();
    let chest = model.frame("chest").unwrap();
    assert_eq!(chest.pose, Pose::identity());
    let base = ContactSpec {
        frame: chest,
        kind: ContactKind::Wrench,
        position: nalgebra::zero(),
    };
    let structure = Structure::new(&model, &[cut], &[base], Structure::LENGTH_SCALE).unwrap();
    let text = std::fs::read_to_string(folder.join("tests/oracle/icub_left_arm_moving_base.json"))
        .unwrap();
    let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
    let list = |value: &serde_json::Value| -> Vec<f64> {
        value
            .as_array()
            .unwrap()
            .iter()
            .map(|x| x.as_f64().unwrap())
            .collect()
    };
    let cases = golden["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 30);
    let mut regressor = Regressor::new(&model);
    let phi = regressor.serialization().parameters(&model);
    let mut stacked = StackedRegressor::new(&structure);
    let mut kinematics = Kinematics::new(&model, chest.link).unwrap();
    for case in cases {
        let state = State(["position", "velocity", "acceleration"].map(|what| list(&case[what])));
        let vector = |name: &str| nalgebra::Vector3::from_row_slice(&list(&case[name]));
        let motion = proprio_dynamics::FrameMotion {
            angular_velocity: vector("base_angular_velocity"),
            angular_acceleration: vector("base_angular_acceleration"),
            proper_acceleration: vector("base_proper_acceleration"),
        };
        kinematics.update(&model, state.get(), &motion).unwrap();
        regressor.update(&model, &kinematics).unwrap();
        let got = regressor.transposed().tr_mul(&phi);
        let (wrench, torque) = (list(&case["base_wrench"]), list(&case["torque"]));
        // The golden file has force first.
        assert!(gap(&got.as_slice()[..3], &wrench[3..]) < 1e-9 * size(&wrench));
        assert!(gap(&got.as_slice()[3..6], &wrench[..3]) < 1e-9 * size(&wrench));
        assert!(gap(&got.as_slice()[6..], &torque) < 1e-9 * size(&torque));

        let ft = list(&case["ft"]);
        let reading = Wrench::from_parts([ft[0], ft[1], ft[2]], [ft[3], ft[4], ft[5]]);
        stacked
            .update(&kinematics, &[reading], &ContactSet::first(1), &[])
            .unwrap();
        let arm = &stacked.subtrees()[structure.subtree_of(cut.joint() + 1).unwrap()];
        let mut unknowns: Vec<f64> = arm
            .links()
            .iter()
            .flat_map(|&link| model.inertias()[link].parameters())
            .collect();
        assert_eq!(unknowns.len(), 50);
        unknowns.extend([0.0; 6]);
        for row in 0..6 {
            assert!((dot(arm.row(row), &unknowns) - arm.measured()[row]).abs() < 1e-9 * size(&ft));
        }
        // The reading is the wrench by the child on the parent, in the child: the right side is its
        // negative.
        assert!(gap(arm.measured(), &torque_first(&-reading)) < 1e-12 * size(&ft));
    }
}
