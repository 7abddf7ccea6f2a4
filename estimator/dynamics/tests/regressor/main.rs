//! Regressors as identities between two computations, on random robots of 1 to 40 links with all
//! joint types, cuts and bases; and comparison with golden files.
//!
//! The other computation never uses the regressor: `RigidInertia::net_wrench`, `InverseDynamics`,
//! `Solver`, differences of these, eigenvalues of Gram matrices.

#[path = "../common/mod.rs"]
mod common;
mod particular;

use common::{
    Random, RandomRobot, State, contact, external, gap, motion, parameters, size, wrench_gap,
};
use nalgebra::{DMatrix, DVector, Matrix6};
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::regressor::{
    EstimateRows, Regressor, StackedRegressor, SubTreeRegressor, link_regressor,
};
use proprio_dynamics::spatial::{Pose, RigidInertia, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, DynamicsError, ExternalWrench, InverseDynamics,
    Kinematics, SensorCut, Solver, Structure,
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

/// Every row, one after the other.
fn all_rows(regressor: &Regressor, model: &Model) -> Vec<f64> {
    (0..6 + model.dof_count())
        .flat_map(|row| regressor.row(row).to_vec())
        .collect()
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
        let rows = link_regressor(&motion);
        let regressor = nalgebra::SMatrix::<f64, 6, 10>::from_fn(|row, column| rows[row][column]);
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

    /// `Y phi` equals the recursive algorithm, for any base.
    #[test]
    fn regressor_times_parameters_is_inverse_dynamics((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let moving = Moving::new(links, &mut random);
        let truth = moving.truth(&moving.kinematics);
        let model = &moving.model;
        let mut regressor = Regressor::new(model);
        regressor.update(model, &moving.kinematics).unwrap();
        let phi = parameters(model);
        prop_assert_eq!(truth.len(), 6 + model.dof_count());
        for (i, &expected) in truth.iter().enumerate() {
            let row = regressor.row(i);
            prop_assert!((dot(row, &phi) - expected).abs() < EXACT * weight(row, &phi), "row {i}");
            if let Some(dof) = i.checked_sub(6) {
                prop_assert_eq!(regressor.joint_row(dof).unwrap(), row);
            }
        }
    }

    /// Paper, proof of Lemma 1: `Y_beta,n = X* Y_b,n`. And a joint's row is zero for the links on
    /// the side of the base, eq. (12).
    #[test]
    fn another_base_carries_the_wrench_rows((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let moving = Moving::new(links, &mut random);
        let model = &moving.model;
        let mut here = Regressor::new(model);
        here.update(model, &moving.kinematics).unwrap();
        let beta = random.below(model.link_count());
        let mut there = Regressor::new(model);
        there.update(model, &moving.seen_from(beta)).unwrap();
        let x_b_beta = moving.kinematics.pose(beta);
        for column in 0..10 * model.link_count() {
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
                    let block = &regressor.joint_row(dof).unwrap()[10 * link..10 * link + 10];
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
        let mut regressor = Regressor::new(model);
        let mut kinematics = Kinematics::new(model, 0).unwrap();
        let (one, other) = (random.below(model.link_count()), random.below(model.link_count()));
        for base in [0, one, other, one, 0, other] {
            kinematics.set_base(model, base).unwrap();
            let state = State::new(model, &mut random);
            kinematics.update(model, state.get(), &motion(&mut random)).unwrap();
            regressor.update(model, &kinematics).unwrap();
            let mut fresh = Regressor::new(model);
            fresh.update(model, &kinematics).unwrap();
            prop_assert_eq!(all_rows(&regressor, model), all_rows(&fresh, model));
        }
    }

    /// A column is the difference that one parameter of one link makes in the recursive algorithm.
    #[test]
    fn columns_are_differences_of_inverse_dynamics((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut moving = Moving::new(links, &mut random);
        let base = moving.kinematics.base();
        let mut regressor = Regressor::new(&moving.model);
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
        let column = 10 * link + parameter;
        for i in 0..before.len() {
            let difference = (after[i] - before[i]) / step;
            let got = regressor.row(i)[column];
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

    /// `[phi; o]` of all sub-trees.
    fn phi_and_offsets(&self) -> Vec<f64> {
        let links: Vec<usize> = (0..self.model.link_count()).collect();
        self.known_of(&links, 0..self.sensors.len())
    }
}

/// `width` columns of a sub-tree's six rows.
fn columns_of(tree: &SubTreeRegressor, first: usize, width: usize) -> DMatrix<f64> {
    DMatrix::from_fn(6, width, |row, column| tree.row(row)[first + column])
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

    /// Transformed to the base and added, the equations of all sub-trees are those of the whole
    /// robot; internal offsets cancel.
    #[test]
    fn subtrees_add_up_to_the_robot((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        let stacked = scene.stacked(&active);
        let (model, offset_column) = (&scene.model, 10 * scene.model.link_count());
        let mut whole = Regressor::new(model);
        whole.update(model, &scene.kinematics).unwrap();
        for column in 0..offset_column + 6 * scene.sensors.len() {
            let (mut sum, mut scale) = (Wrench::zero(), 1.0);
            for tree in stacked.subtrees() {
                let own = match column.checked_sub(offset_column) {
                    None => tree.links().iter().position(|&link| link == column / 10)
                        .map(|place| 10 * place + column % 10),
                    Some(offset) => tree.sensors().position(|sensor| sensor == offset / 6)
                        .map(|place| tree.offset_column() + 6 * place + offset % 6),
                };
                let Some(own) = own else { continue };
                let part = wrench_of(&[0, 1, 2, 3, 4, 5].map(|row| tree.row(row)[own]));
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
    }

    /// The right side changes with the readings as with the offsets, and its covariance follows
    /// from the same columns.
    #[test]
    fn readings_act_as_offsets_do((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let active = scene.some(&mut random);
        let stacked = scene.stacked(&active);
        let changes: Vec<Wrench> = scene.sensors.iter().map(|_| random.wrench()).collect();
        let changed: Vec<Wrench> =
            scene.raw.iter().zip(&changes).map(|(raw, change)| *raw + *change).collect();
        let mut other = StackedRegressor::new(&scene.structure);
        other.update(&scene.kinematics, &changed, &active, &scene.known).unwrap();
        for (tree, after) in stacked.subtrees().iter().zip(other.subtrees()) {
            let sensors: Vec<usize> = tree.sensors().collect();
            let offsets = columns_of(tree, tree.offset_column(), 6 * sensors.len());
            let variances = sensors.iter().flat_map(|&sensor| {
                let noise = scene.sensors[sensor].noise();
                noise.torque.into_iter().chain(noise.force).map(|deviation| deviation * deviation)
            });
            let variances = DVector::from_iterator(6 * sensors.len(), variances);
            let expected = &offsets * DMatrix::from_diagonal(&variances) * offsets.transpose();
            prop_assert!(
                (expected.clone() - tree.covariance()).amax() < 1e-13 * (1.0 + expected.amax())
            );
            let change = sensors.iter().flat_map(|&sensor| torque_first(&changes[sensor]));
            let expected = offsets * DVector::from_iterator(6 * sensors.len(), change);
            let difference: Vec<f64> =
                after.measured().iter().zip(tree.measured()).map(|(x, y)| x - y).collect();
            prop_assert!(
                gap(&difference, expected.as_slice())
                    < EXACT * (size(tree.measured()) + size(after.measured()))
            );
        }
    }

    /// The rows that remain without contact columns: their number is maximal, no contact
    /// contributes to them, and they are whitened with noise weighting.
    #[test]
    fn projected_rows_do_not_feel_the_contacts((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let scene = Scene::new(links, &mut random);
        let active = scene.all();
        let stacked = scene.stacked(&active);
        let solver = scene.solve(&scene.kinematics, &scene.offsets, &active);
        for (tree, balance) in stacked.subtrees().iter().zip(solver.balances()) {
            let first = tree.contact_column();
            let columns = columns_of(tree, first, tree.column_count() - first);
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
                    let offset = columns_of(tree, first, 6);
                    let p = offset
                        .transpose()
                        .lu()
                        .solve(&DVector::from_row_slice(&projected[first..first + 6]))
                        .unwrap();
                    prop_assert!(
                        gap(p.as_slice(), tree.projection(row)) < 1e-9 * size(p.as_slice())
                    );
                    let rebuilt = columns_of(tree, 0, tree.contact_column()).tr_mul(&p);
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
                }
                let p = DVector::from_row_slice(tree.projection(row));
                basis.row_mut(row).copy_from(&p.transpose());
            }
            // Without a sensor the rows are weighted by a length.
            let length = scene.structure.length_scale();
            let metric = match tree.sensors().count() {
                0 => Matrix6::from_diagonal(&nalgebra::Vector6::from_fn(|i, _| {
                    if i < 3 { length * length } else { 1.0 }
                })),
                _ => *tree.covariance(),
            };
            let metric = DMatrix::from_fn(6, 6, |i, j| metric[(i, j)]);
            let unit = &basis * metric * basis.transpose();
            let identity = DMatrix::identity(tree.remaining(), tree.remaining());
            prop_assert!((unit - identity).amax() < 1e-7);
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
        prop_assert_eq!(rows.column_count(), unknowns.len());
        let mut row = vec![f64::NAN; unknowns.len()];
        for dof in 0..scene.model.dof_count() {
            rows.torque_row(dof, &mut row).unwrap();
            let subtree = rows.torque_subtree(dof);
            for (link, block) in row.chunks(10).take(scene.model.link_count()).enumerate() {
                let is_within = scene.structure.subtree_of(link) == subtree;
                prop_assert!(is_within || block.iter().all(|&x| x == 0.0));
            }
            let measured = rows.torque_measured(dof, &scene.raw, &scene.known).unwrap();
            let scale = weight(&row, &unknowns) + measured.abs() + scene.raw_weight(&row);
            prop_assert!(
                (dot(&row, &unknowns) + measured - solver.torque()[dof]).abs() < EXACT * scale,
                "dof {dof}"
            );
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
        let mut row = vec![f64::NAN; rows.column_count()];
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
                rows.torque_row(dof, &mut row).unwrap();
                let difference = (after.torque()[dof] - before.torque()[dof]) / step;
                let scale = scene.raw_weight(&row) + size(before.torque()) + size(&row);
                prop_assert!(
                    (row[column] - difference).abs() < EXACT * scale,
                    "dof {dof} column {column}: {} {difference}",
                    row[column]
                );
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
        let mut row = vec![f64::NAN; rows.column_count()];
        let deviation = |row: &[f64]| {
            let offsets = &row[10 * scene.model.link_count()..];
            offsets.iter()
                .zip(&deviations)
                .map(|(a, b)| (a * b).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        for dof in 0..scene.model.dof_count() {
            rows.torque_row(dof, &mut row).unwrap();
            let expected = solver.torque_deviation()[dof];
            prop_assert!((deviation(&row) - expected).abs() < 1e-9 * (1.0 + expected));
        }
    }
}

impl Scene {
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
