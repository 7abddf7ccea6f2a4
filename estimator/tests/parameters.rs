//! Identified parameters, from the file to the standard deviations of torques: propagation of the
//! covariance, against another method and against random draws; parameters.toml read, written,
//! truncated, and of another robot; URDFs with other inertias.

#[path = "../dynamics/tests/common/mod.rs"]
mod common;

use common::{Random, RandomRobot, State, contact, gap, humanoid, motion, size};
use nalgebra::{DMatrix, DVector, Matrix4, Matrix6, SMatrix};
use proprio_dynamics::calibration::{Calibration, Gain, Kind, Unknown};
use proprio_dynamics::model::{Frame, Model, ModelError};
use proprio_dynamics::regressor::{EstimateRows, link_rows};
use proprio_dynamics::spatial::{Mat3, Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, DynamicsError, FrameMotion, Kinematics, Noise, SensorCut,
    Solver, Structure,
};
use proprio_estimator::config::Config;
use proprio_estimator::inertial::PosteriorBlock;
use proprio_estimator::offline;
use proprio_estimator::parameters::{
    Calibrated, Friction, Offset, Parameters, ParametersError, Provenance, Rotor, Span,
};
use proprio_estimator::propagation::{Covariance, Propagation};
use proprio_estimator::setup::Setup;
use proprio_identification::prior::cad_root;
use proprio_topics::{Nanos, Source};
use proptest::prelude::*;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

// ---------------------------------------------------------------- covariance to deviations

/// A covariance of some links and sensors: one large block, blocks of single links, and exact
/// parameters.
fn covariance(structure: &Structure, random: &mut Random) -> Covariance {
    let (links, sensors) = (structure.link_count(), structure.sensors().len());
    let mut covariance = Covariance::exact(links, sensors);
    let mut root =
        |rows: usize, columns: usize| DMatrix::from_fn(rows, columns, |_, _| random.real(0.1));
    let (mut correlated, mut with) = (Vec::new(), Vec::new());
    for link in 0..links {
        match link % 4 {
            0 | 1 => correlated.push(link),
            2 => covariance.add(&[link], &[], root(10, 10)).unwrap(),
            _ => {}
        }
    }
    for sensor in 0..sensors {
        match sensor % 3 {
            0 => with.push(sensor),
            1 => covariance.add(&[], &[sensor], root(6, 6)).unwrap(),
            _ => {}
        }
    }
    // In any order; sometimes the rank is lower than the number of columns.
    correlated.reverse();
    let columns = 10 * correlated.len() + 6 * with.len();
    let rows = if links.is_multiple_of(3) {
        columns.div_ceil(2)
    } else {
        columns
    };
    covariance
        .add(&correlated, &with, root(rows, columns))
        .unwrap();
    covariance
}

/// The row of a component of a contact's wrench over `[10 N_B | 6 per sensor]`: the power along
/// `motion` of every link's wrench, and of every offset's on the contact's sub-tree.
fn contact_row(
    structure: &Structure,
    kinematics: &Kinematics,
    solver: &Solver,
    contact: usize,
    motion: &Motion,
) -> Vec<f64> {
    let number = structure
        .subtree_of(structure.contacts()[contact].frame.link)
        .unwrap();
    let offsets = 10 * structure.link_count();
    let mut row = vec![0.0; offsets + 6 * structure.sensors().len()];
    for link in structure.links_of(number) {
        let rows = link_rows(kinematics.pose(link), kinematics.motion(link));
        for column in 0..10 {
            let wrench = Wrench::from_torque_first(rows.map(|row| row[column]));
            row[10 * link + column] = motion.dot(&wrench);
        }
    }
    for sensor in structure.subtrees()[number].sensors.iter() {
        let cut = &structure.sensors()[sensor];
        let is_above = structure.subtree_of(cut.joint() + 1) == Some(number);
        let side = cut.sign() * if is_above { 1.0 } else { -1.0 };
        for component in 0..6 {
            let mut unit = [0.0; 6];
            unit[component] = side;
            let wrench = solver
                .sensor_pose(sensor)
                .wrench(&Wrench::from_torque_first(unit));
            row[offsets + 6 * sensor + component] = motion.dot(&wrench);
        }
    }
    row
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// The result equals `T P T^T`, computed row by row, with any contacts present.
    #[test]
    fn deviations_are_those_of_the_estimates_rows(links in 1..=24_usize, seed in any::<u64>()) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let sensors = robot.sensors(&model, &mut random);
        let contacts: Vec<ContactSpec> =
            (0..random.below(5)).map(|_| contact(&model, &mut random).0).collect();
        let structure = Structure::new(&model, &sensors, &contacts, 0.1).unwrap();
        let mut kinematics = Kinematics::new(&model, random.below(model.link_count())).unwrap();
        kinematics
            .update(&model, State::new(&model, &mut random).get(), &motion(&mut random))
            .unwrap();
        let readings: Vec<Wrench> = sensors.iter().map(|_| random.wrench()).collect();
        let active: ContactSet = (0..contacts.len()).filter(|_| random.chance(60)).collect();
        let mut solver = Solver::new(&structure);
        solver.solve(&model, &structure, &kinematics, &readings, &active, &[]).unwrap();

        let mut covariance = covariance(&structure, &mut random);
        let mut all = covariance.dense();
        // The first sensor's offset has drifted for four seconds.
        if !sensors.is_empty() {
            let rate = [0.1, 0.2, 0.3, 1.0, 2.0, 3.0];
            covariance.set_drift(0, rate, Nanos::from_seconds(7.0)).unwrap();
            for (channel, rate) in rate.iter().enumerate() {
                let column = 10 * model.link_count() + channel;
                all[(column, column)] += 4.0 * rate * rate;
            }
        }
        let mut propagation = Propagation::new(&structure, &covariance).unwrap();
        propagation.update(&structure, &solver, &kinematics, Nanos::from_seconds(3.0)).unwrap();

        let rows = EstimateRows::new(&structure, &solver, &kinematics).unwrap();
        let deviation = |row: &[f64]| {
            let row = DVector::from_column_slice(row);
            // The rounding error of a sum that vanishes.
            let scale = row.abs().dot(&(all.abs() * row.abs()));
            (row.dot(&(&all * &row)), scale)
        };
        for dof in 0..model.dof_count() {
            let mut row = vec![0.0; rows.column_count()];
            rows.torque_row(dof, &mut row).unwrap();
            let (variance, scale) = deviation(&row);
            let got = propagation.torque_std()[dof].powi(2);
            // The deviation has single precision.
            prop_assert!(
                (got - variance).abs() < 1e-5 * variance + 1e-10 * (1.0 + scale),
                "dof {}: {} not {}", dof, got, variance
            );
            // The share of an input is the covariance of its error with that of the torque.
            let with_all = &all * DVector::from_column_slice(&row);
            let links = 10 * model.link_count();
            let mut shares = vec![0.0; model.link_count() + sensors.len()];
            let solution = (&solver, &kinematics);
            propagation.torque_shares(&structure, solution, dof, |source, number, own| {
                let place = number + if source == Source::Link { 0 } else { model.link_count() };
                shares[place] += own;
            });
            for (place, got) in shares.into_iter().enumerate() {
                let columns = match place.checked_sub(model.link_count()) {
                    None => 10 * place..10 * place + 10,
                    Some(sensor) => links + 6 * sensor..links + 6 * sensor + 6,
                };
                let want: f64 = columns.map(|column| row[column] * with_all[column]).sum();
                prop_assert!(
                    (got - want).abs() < 1e-4 * (variance + want.abs()) + 1e-8 * (1.0 + scale),
                    "dof {}, part {}: {} not {} of {}", dof, place, got, want, variance
                );
            }
        }
        for contact in 0..contacts.len() {
            let motions = solver.contact_rows(contact).iter().enumerate();
            for ((component, motion), got) in motions.zip(propagation.contact_std()[contact]) {
                let row = contact_row(&structure, &kinematics, &solver, contact, motion);
                let (variance, scale) = deviation(&row);
                let square = got.powi(2);
                prop_assert!(
                    (square - variance).abs() < 1e-5 * variance + 1e-10 * (1.0 + scale),
                    "{}: {} not {}", component, square, variance
                );
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// An unknown of a calibration acts like an offset with a factor that depends on the reading:
    /// the result is the same as with its columns added to those of the offset.
    #[test]
    fn an_uncertain_calibration_acts_like_an_offset(links in 2..=16_usize, seed in any::<u64>()) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let sensors = robot.sensors(&model, &mut random);
        let contacts: Vec<ContactSpec> =
            (0..random.below(4)).map(|_| contact(&model, &mut random).0).collect();
        let structure = Structure::new(&model, &sensors, &contacts, 0.1).unwrap();
        let mut kinematics = Kinematics::new(&model, random.below(model.link_count())).unwrap();
        kinematics
            .update(&model, State::new(&model, &mut random).get(), &motion(&mut random))
            .unwrap();
        let readings: Vec<Wrench> = sensors.iter().map(|_| random.wrench()).collect();
        let mut solver = Solver::new(&structure);
        let present = (0..contacts.len()).collect();
        solver.solve(&model, &structure, &kinematics, &readings, &present, &[]).unwrap();

        let all: Vec<usize> = (0..model.link_count()).filter(|_| random.chance(70)).collect();
        let with: Vec<usize> = (0..sensors.len()).collect();
        let gains = [Gain::None, Gain::Diagonal, Gain::Full];
        let kinds: Vec<(usize, Kind)> = with
            .iter()
            .rev()
            .map(|&sensor| {
                (sensor, Kind { gain: gains[random.below(3)], temperature: random.chance(50) })
            })
            .collect();
        let plain = 10 * all.len() + 6 * with.len();
        let columns = plain + kinds.iter().map(|(_, kind)| kind.count()).sum::<usize>();
        let root = DMatrix::from_fn(columns, columns, |_, _| random.real(0.1));
        let kelvin = random.real(20.0);
        let mut together = root.columns(0, plain).into_owned();
        let mut column = plain;
        for (sensor, kind) in &kinds {
            for unknown in kind.unknowns() {
                let read = readings[*sensor].torque_first();
                // true = (1 + E) r - k (T - T0) - o.
                let factor = match unknown {
                    Unknown::Gain { of, .. } => -read[of],
                    Unknown::Temperature { .. } => kelvin,
                };
                let own = root.column(column) * factor;
                let mut sum = together.column_mut(10 * all.len() + 6 * sensor + unknown.channel());
                sum += own;
                column += 1;
            }
        }
        let exact = || Covariance::exact(model.link_count(), sensors.len());
        let (mut calibrated, mut expected) = (exact(), exact());
        calibrated.add_calibrated(&all, &with, &kinds, root).unwrap();
        expected.add(&all, &with, together).unwrap();
        let mut got = Propagation::new(&structure, &calibrated).unwrap();
        let mut want = Propagation::new(&structure, &expected).unwrap();
        // Earlier readings have no effect.
        for (sensor, _) in readings.iter().enumerate() {
            got.set_calibration_point(sensor, &random.wrench(), 3.0);
        }
        got.update(&structure, &solver, &kinematics, Nanos::ZERO).unwrap();
        for (sensor, reading) in readings.iter().enumerate() {
            got.set_calibration_point(sensor, reading, kelvin);
        }
        for propagation in [&mut got, &mut want] {
            propagation.update(&structure, &solver, &kinematics, Nanos::ZERO).unwrap();
        }
        let most = want.torque_std().iter().fold(0.0, |most: f64, x| most.max(*x));
        for dof in 0..model.dof_count() {
            let shares = |propagation: &mut Propagation| {
                let mut sums = [0.0; 3];
                let solution = (&solver, &kinematics);
                propagation.torque_shares(&structure, solution, dof, |source, _, own| {
                    let sources = [Source::Link, Source::Offset, Source::Gain];
                    let place = sources.iter().position(|other| *other == source);
                    sums[place.unwrap_or(0)] += own;
                });
                sums
            };
            let [of_links, of_offsets, of_gains] = shares(&mut got);
            let [links, offsets, none] = shares(&mut want);
            prop_assert_eq!(none, 0.0);
            let bound = 1e-3 * (links.abs() + offsets.abs() + most * most);
            prop_assert!((of_links - links).abs() <= bound, "{} not {}", of_links, links);
            let together = of_offsets + of_gains;
            prop_assert!((together - offsets).abs() <= bound, "{} not {}", together, offsets);
        }
        for (got, want) in got.torque_std().iter().zip(want.torque_std()) {
            prop_assert!((got - want).abs() <= 1e-4 * want + 1e-5 * most, "{} not {}", got, want);
        }
        let (got, want) = (got.contact_std().as_flattened(), want.contact_std().as_flattened());
        for (got, want) in got.iter().zip(want) {
            prop_assert!((got - want).abs() < 1e-3 * (want + 1e-3), "{} not {}", got, want);
        }
    }
}

#[test]
fn wrong_sizes_and_indices_are_refused() {
    let (text, sensors) = humanoid();
    let keep: Vec<&str> = sensors.iter().map(String::as_str).collect();
    let model = Model::from_urdf(&text, &keep).unwrap();
    let structure = Structure::new(&model, &[], &[], 0.1).unwrap();
    let mut covariance = Covariance::exact(model.link_count(), 0);
    let root = |columns| DMatrix::from_element(3, columns, 0.1);
    assert!(covariance.add(&[0], &[], root(9)).is_err(), "another width");
    assert!(
        covariance.add(&[39], &[], root(10)).is_err(),
        "no such link"
    );
    assert!(covariance.add(&[1, 1], &[], root(20)).is_err(), "twice");
    assert!(
        covariance.add(&[], &[0], root(6)).is_err(),
        "no such sensor"
    );
    assert!(
        covariance.add(&[0], &[], root(10) * f64::NAN).is_err(),
        "not a number"
    );
    assert_eq!(
        covariance,
        Covariance::exact(model.link_count(), 0),
        "and nothing is changed"
    );
    covariance.add(&[1], &[], root(10)).unwrap();
    assert!(
        covariance.add(&[1], &[], root(10)).is_err(),
        "has one already"
    );
    let kind = Kind {
        gain: Gain::Diagonal,
        temperature: false,
    };
    assert!(
        covariance
            .add_calibrated(&[2], &[], &[(0, kind)], root(16))
            .is_err(),
        "a calibration without an offset"
    );
    assert!(covariance.has_link(1) && !covariance.has_link(0));
    assert!(covariance.set_drift(0, [0.0; 6], Nanos::ZERO).is_err());
    assert!(Propagation::new(&structure, &Covariance::exact(5, 0)).is_err());
    let mut propagation = Propagation::new(&structure, &covariance).unwrap();
    let (solver, kinematics) = (Solver::new(&structure), Kinematics::new(&model, 0).unwrap());
    assert_eq!(
        propagation.update(&structure, &solver, &kinematics, Nanos::ZERO),
        Err(DynamicsError::NotSolved)
    );
}

/// The spread of the solver's results with [phi; o] drawn from `P`: it must equal the stated
/// standard deviations.
fn spread(
    model: &Model,
    structure: &Structure,
    active: &ContactSet,
    covariance: &Covariance,
    random: &mut Random,
    draws: usize,
) {
    let mut kinematics = Kinematics::new(model, 0).unwrap();
    let (state, base) = (State::new(model, random), motion(random));
    kinematics.update(model, state.get(), &base).unwrap();
    let readings: Vec<Wrench> = structure
        .sensors()
        .iter()
        .map(|_| random.wrench())
        .collect();
    let mut solver = Solver::new(structure);
    solver
        .solve(model, structure, &kinematics, &readings, active, &[])
        .unwrap();
    let mut propagation = Propagation::new(structure, covariance).unwrap();
    // At the instant of the offsets: no drift.
    propagation
        .update(structure, &solver, &kinematics, KNOWN)
        .unwrap();
    let stated: Vec<f64> = propagation
        .torque_std()
        .iter()
        .copied()
        .chain(propagation.contact_std().iter().flatten().copied())
        .collect();

    let results = |solver: &Solver| -> Vec<f64> {
        let contacts = solver
            .contacts()
            .iter()
            .flat_map(|contact| contact.wrench.force_first());
        solver.torque().iter().copied().chain(contacts).collect()
    };
    let mean = results(&solver);
    // Any root can be used for drawing; this one differs from the one that was propagated.
    let eigen = covariance.dense().symmetric_eigen();
    let root = &eigen.eigenvectors
        * DMatrix::from_diagonal(&eigen.eigenvalues.map(|value| value.max(0.0).sqrt()));
    let mut squares = vec![0.0; mean.len()];
    for _ in 0..draws {
        // Nearly normal: the sum of twelve uniform numbers.
        let z = DVector::from_fn(root.ncols(), |_, _| {
            (0..12).map(|_| random.real(0.5)).sum::<f64>()
        });
        let error = &root * z;
        let mut other = model.clone();
        for (link, inertia) in model.inertias().iter().enumerate() {
            let mut phi = inertia.parameters();
            phi.iter_mut()
                .enumerate()
                .for_each(|(i, p)| *p += error[10 * link + i]);
            other
                .set_inertia(link, RigidInertia::from_parameters(&phi))
                .unwrap();
        }
        let first = 10 * model.link_count();
        let shifted: Vec<Wrench> = readings
            .iter()
            .enumerate()
            .map(|(sensor, reading)| {
                let o = |i: usize| error[first + 6 * sensor + i];
                *reading - Wrench::from_parts([o(3), o(4), o(5)], [o(0), o(1), o(2)])
            })
            .collect();
        kinematics.update(&other, state.get(), &base).unwrap();
        solver
            .solve(&other, structure, &kinematics, &shifted, active, &[])
            .unwrap();
        let errors = results(&solver).into_iter().zip(&mean).map(|(a, b)| a - b);
        squares
            .iter_mut()
            .zip(errors)
            .for_each(|(sum, error)| *sum += error * error);
    }
    let mut compared = 0;
    for (number, (sum, stated)) in squares.iter().zip(&stated).enumerate() {
        let spread = (sum / draws as f64).sqrt();
        assert!(
            (spread - stated).abs() < 0.05 * stated + 1e-9,
            "{number}: {spread}, stated {stated}"
        );
        compared += usize::from(*stated > 1e-6);
    }
    assert!(compared > mean.len() / 2, "{compared} of {}", mean.len());
}

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

#[test]
fn parameters_drawn_from_the_covariance_spread_the_torques_as_stated() {
    let mut random = Random::new(2015);
    // The arm as configured, with the uncertainty of the URDF; and with identified parameters.
    let mut setup = arm();
    let active = setup.robot.always;
    spread(
        &setup.state.model,
        &setup.robot.structure,
        &active,
        &setup.state.covariance,
        &mut random,
        4000,
    );
    setup.apply(&identified(&setup, &mut random)).unwrap();
    spread(
        &setup.state.model,
        &setup.robot.structure,
        &active,
        &setup.state.covariance,
        &mut random,
        4000,
    );
    // The walker, whose torques come from both sides of a joint, in the air and on a foot.
    let text = std::fs::read_to_string(root().join("tests/oracle/walker.urdf")).unwrap();
    let elements = Model::from_urdf(&text, &[]).unwrap().sensors().to_vec();
    let keep: Vec<&str> = elements
        .iter()
        .map(|element| element.joint.as_str())
        .collect();
    let model = Model::from_urdf(&text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let sensors: Vec<SensorCut> = elements
        .iter()
        .map(|s| SensorCut::new(&model, &s.joint, s.frame, s.direction, &s.pose, &noise).unwrap())
        .collect();
    let stand = ContactSpec {
        frame: Frame {
            link: model.link_count() - 1,
            pose: Pose::identity(),
        },
        kind: ContactKind::Wrench,
        position: Vec3::zeros(),
    };
    let structure = Structure::new(&model, &sensors, &[stand], 0.1).unwrap();
    let covariance = covariance(&structure, &mut random);
    for active in [ContactSet::EMPTY, ContactSet::first(1)] {
        spread(&model, &structure, &active, &covariance, &mut random, 4000);
    }
}

/// The prior covariance of CAD: its definition, and its invariance to the frame.
#[test]
fn the_uncertainty_of_a_urdf_is_relative_and_does_not_depend_on_the_frame() {
    let relative = 0.2;
    let body = RigidInertia::from_centroidal(
        3.0,
        &Vec3::new(0.1, -0.2, 0.3),
        &Mat3::from_diagonal(&Vec3::new(0.02, 0.03, 0.04)),
    );
    let covariance = |body: &RigidInertia| {
        let root = cad_root(body, relative);
        root.transpose() * root
    };
    let p = covariance(&body);
    assert!(
        (p[(0, 0)].sqrt() - relative * 3.0).abs() < 1e-12,
        "the mass"
    );
    // Its quadratic form is that of the log-det divergence at CAD: d^T P^-1 d = tr((J^-1 dJ)^2) /
    // relative^2.
    let mut random = Random::new(4);
    let inverse = body.pseudo_inertia().try_inverse().unwrap();
    let form = p.try_inverse().unwrap();
    for _ in 0..10 {
        let d: [f64; 10] = std::array::from_fn(|_| random.real(1.0));
        let change: Matrix4<f64> = inverse * RigidInertia::from_parameters(&d).pseudo_inertia();
        let expected = (change * change).trace() / relative.powi(2);
        let d = SMatrix::<f64, 10, 1>::from_row_slice(&d);
        let got = d.dot(&(form * d));
        assert!((got - expected).abs() < 1e-9 * expected, "{got} {expected}");
    }
    // A change of frame transforms the parameters by a matrix, and the covariance accordingly.
    let pose = Pose::from_xyz_rpy([0.5, -0.4, 0.2], [0.3, 1.0, -2.0]);
    let unit = |i: usize| {
        RigidInertia::from_parameters(&std::array::from_fn(|j| f64::from(u8::from(i == j))))
    };
    let columns: Vec<_> = (0..10)
        .map(|i| SMatrix::<f64, 10, 1>::from_row_slice(&unit(i).transformed(&pose).parameters()))
        .collect();
    let change = SMatrix::<f64, 10, 10>::from_columns(&columns);
    let (moved, expected) = (
        covariance(&body.transformed(&pose)),
        change * p * change.transpose(),
    );
    assert!((moved - expected).amax() < 1e-12 * expected.amax());
    // A point mass, a frame without mass, an inconsistent body: the root is finite and not zero.
    for odd in [
        RigidInertia::from_centroidal(1.0, &Vec3::new(0.1, 0.0, 0.0), &Mat3::zeros()),
        RigidInertia::zero(),
        RigidInertia::from_centroidal(
            1.0,
            &Vec3::zeros(),
            &Mat3::from_diagonal(&Vec3::new(0.1, 0.01, 0.01)),
        ),
    ] {
        let p = covariance(&odd);
        assert!(p.iter().all(|x| x.is_finite()) && p.diagonal().iter().all(|x| *x > 0.0));
        assert!(p.symmetric_eigenvalues().min() > -1e-15);
    }
}

// ---------------------------------------------------------------- the setup and the pipeline

/// Identified parameters of the links beyond the arm's sensor, each 10 % heavier, and offsets.
fn identified(setup: &Setup, random: &mut Random) -> Parameters {
    let provenance = Provenance {
        program: "proprio 0.0.0 \"test\"".into(),
        tau: Some(0.58),
        logs: vec![Span {
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
            coulomb: 0.4,
            viscous: 1e-3,
            offset: -0.25,
            rotor: Some(Rotor {
                inertia: 0.07,
                deviation: 2e-3,
            }),
        }])
        .unwrap();
    parameters
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

#[test]
fn identified_parameters_replace_those_of_the_urdf() {
    let plain = arm();
    let parameters = identified(&plain, &mut Random::new(3));
    let mut setup = arm();
    setup.apply(&parameters).unwrap();
    let top = setup.robot.structure.subtrees().last().unwrap().top;
    for (link, (cad, now)) in setup
        .robot
        .model
        .inertias()
        .iter()
        .zip(setup.state.model.inertias())
        .enumerate()
    {
        let factor = if link < top { 1.0 } else { 1.1 };
        assert!((now.mass - factor * cad.mass).abs() < 1e-12, "{link}");
        assert_eq!(parameters.inertia(link).is_some(), link >= top);
    }
    assert_eq!(
        setup.state.offsets,
        [Wrench::from_parts([1.0, 2.0, 3.0], [0.1, 0.2, 0.3])],
        "the file wins"
    );
    let text = setup.to_string();
    for expected in [
        "identified by proprio 0.0.0 \"test\" from a log.csv (scale of the prior: tau = 0.58): 5 \
         of 9 links",
        "the URDF's, taken as known to 20 %: chest",
        "offset of l_arm_ft_sensor",
    ] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
    let text = plain.to_string();
    let expected = "inertial parameters: the URDF's, taken as known to 20 % \
                    (identification.urdf_relative_std)";
    assert!(text.contains(expected), "{text}");

    // Torques change where they depend on the links, and are more certain. Applying the parameters
    // twice gives the same as once.
    setup.apply(&parameters).unwrap();
    let (before, after) = (estimates(plain), estimates(setup));
    let mean =
        |table: &Table, name: &str| table[name].iter().sum::<f64>() / table[name].len() as f64;
    for joint in ["l_elbow", "l_wrist_pitch", "l_shoulder_pitch"] {
        let moved = gap(
            &before[&format!("torque/{joint}")],
            &after[&format!("torque/{joint}")],
        );
        assert!(moved > 1e-3, "{joint}");
    }
    let deviation = format!("torque_std/{}", "l_wrist_pitch");
    assert!(mean(&after, &deviation) < 0.5 * mean(&before, &deviation));
}

/// A torque that depends on no F/T sensor has the standard deviation of the URDF's parameters.
#[test]
fn a_torque_without_a_sensor_is_as_uncertain_as_the_model() {
    let contact_free = |urdf_relative_std: f64| {
        arm_with(|config| {
            config.identification.urdf_relative_std = urdf_relative_std;
            config.contact.retain(|c| c.name() != "hand");
            // The log's sensors have none; a residual would withhold what is compared here.
            config.force_torque[0].offset_n = Some([0.0; 3]);
            config.force_torque[0].offset_nm = Some([0.0; 3]);
        })
    };
    let (loose, tight, exact) = (
        estimates(contact_free(0.2)),
        estimates(contact_free(0.1)),
        estimates(contact_free(0.0)),
    );
    // Beyond the elbow the arm has a free end: the wrist's torques depend on its links alone.
    let name = "torque_std/l_wrist_yaw";
    for row in 0..loose[name].len() {
        // Beside the model's uncertainty, all three contain that of the motion.
        let [loose, tight, exact] = [&loose, &tight, &exact].map(|of| of[name][row].powi(2));
        let (twice, once) = (loose - exact, tight - exact);
        assert!(
            once > 0.0 && exact > 0.0,
            "a model that is exact leaves the motion's errors"
        );
        assert!((twice - 4.0 * once).abs() < 1e-9 * loose, "proportional");
    }
    assert_eq!(loose["torque/l_wrist_yaw"], exact["torque/l_wrist_yaw"]);
    // A torque that depends on a sensor is more certain with exact parameters.
    let shoulder = "torque_std/l_shoulder_pitch";
    assert!(
        loose[shoulder]
            .iter()
            .zip(&exact[shoulder])
            .all(|(loose, exact)| loose > exact && *exact > 0.0)
    );
}

#[test]
fn an_uncertain_offset_makes_torques_uncertain_and_drift_makes_them_more_so() {
    let known = estimates(arm());
    let unsure = estimates(arm_with(|config| {
        config.force_torque[0].offset_std_nm = Some([3.0; 3]);
    }));
    let shoulder = "torque_std/l_shoulder_pitch";
    assert!(
        known[shoulder]
            .iter()
            .zip(&unsure[shoulder])
            .all(|(a, b)| b * b > a * a + 8.0)
    );
    // Offsets that drift, identified from a log with this first and last stamp.
    let of_log = |drift: f64, first: f64, last: f64| {
        let mut setup = arm();
        let from = identified(&setup, &mut Random::new(3));
        let mut offset = from.offsets()[0].clone();
        offset.drift = Wrench::from_parts([drift; 3], [drift; 3]);
        offset.known = Nanos::from_seconds(last);
        let links: Vec<_> = from
            .identified()
            .map(|link| (link, from.inertia(link).unwrap()))
            .collect();
        let span = Span {
            file: "a log.csv".into(),
            start: Nanos::from_seconds(first),
            end: offset.known,
        };
        let provenance = Provenance {
            logs: vec![span],
            ..from.provenance().clone()
        };
        let mut parameters = Parameters::new(&setup.robot, provenance);
        parameters
            .set_identified(&links, &[offset], &from.root())
            .unwrap();
        setup.apply(&parameters).unwrap();
        estimates(setup)
    };
    let still = of_log(0.0, -30.0, -20.0);
    let begun = still["t"][0];
    let table = of_log(1.0, -30.0, -20.0);
    for (first, last, elapsed) in [
        // A clock before the log is another clock: the time since the run began counts.
        (
            1e6,
            1e6 + 30.0,
            &(|t: f64| t - begun) as &dyn Fn(f64) -> f64,
        ),
        // A clock with similar stamps may be the same, or another one.
        (begun - 10.0, begun + 1.0, &|t| {
            (t - begun - 1.0).abs().max(t - begun)
        }),
    ] {
        let other = of_log(1.0, first, last);
        for (row, t) in still["t"].iter().enumerate() {
            let grown = |table: &Table| table[shoulder][row].powi(2) - still[shoulder][row].powi(2);
            let (found, expected) = (grown(&other) / grown(&table), elapsed(*t) / (t + 20.0));
            assert!(
                (found - expected).abs() < 1e-4,
                "{last} at {t}: {found} {expected}"
            );
        }
    }
}

// ---------------------------------------------------------------- the file

#[test]
fn a_file_reads_back_as_what_was_written() {
    let setup = arm();
    let parameters = identified(&setup, &mut Random::new(3));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("parameters.toml");
    parameters.save(&file).unwrap();
    let read = Parameters::load(&file).unwrap();
    assert_eq!(read, parameters);
    let text = std::fs::read_to_string(&file).unwrap();
    assert_eq!(read.to_string(), text, "and again");
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "nothing else is left there"
    );
    // A file from before rotors were identified.
    let older: String = text
        .lines()
        .filter(|line| !line.starts_with("rotor_inertia"))
        .flat_map(|line| [line, "\n"])
        .collect();
    assert!(older.len() < text.len());
    let older = Parameters::parse(&older).unwrap();
    assert_eq!(
        (older.friction()[0].rotor, older.friction()[0].coulomb),
        (None, 0.4)
    );
    // A file with nothing identified is valid, too.
    let nothing = Parameters::new(&setup.robot, Provenance::default());
    assert_eq!(Parameters::parse(&nothing.to_string()).unwrap(), nothing);
    // The given numbers are reproduced: deviations to rounding, the covariance to a billionth of
    // them.
    let mut random = Random::new(3);
    let columns = 10 * setup.robot.model.inertias().len();
    let root = DMatrix::from_fn(columns, columns, |_, j| {
        random.real(if j % 10 < 4 { 1e-2 } else { 1e-6 })
    });
    let links: Vec<_> = setup
        .robot
        .model
        .inertias()
        .iter()
        .copied()
        .enumerate()
        .collect();
    let mut parameters = nothing;
    parameters.set_identified(&links, &[], &root).unwrap();
    let (expected, got) = (
        root.transpose() * &root,
        parameters.root().transpose() * parameters.root(),
    );
    for i in 0..columns {
        let deviation = parameters.deviation(i / 10).unwrap()[i % 10];
        assert!((deviation * deviation - expected[(i, i)]).abs() < 1e-12 * expected[(i, i)]);
        for j in 0..columns {
            let scale = (expected[(i, i)] * expected[(j, j)]).sqrt();
            assert!((got[(i, j)] - expected[(i, j)]).abs() < 2e-8 * scale);
        }
    }
}

/// The same with a calibration of the sensor, known to per cents.
fn with_calibration(setup: &Setup, kind: Kind) -> Parameters {
    let plain = identified(setup, &mut Random::new(3));
    let gain = Matrix6::from_fn(|i, j| {
        if i == j {
            1.05
        } else {
            0.01 * i as f64 - 0.02 * j as f64
        }
    });
    let per_kelvin = Wrench::from_parts([0.05, -0.02, 0.1], [1e-3, 2e-3, -3e-3]);
    let per_kelvin = if kind.temperature {
        per_kelvin
    } else {
        Wrench::zero()
    };
    let mut offset = plain.offsets()[0].clone();
    offset.calibrated = Some(Calibrated {
        calibration: Calibration::new(gain, per_kelvin, kind.temperature.then_some(31.5)),
        kind,
    });
    let links: Vec<_> = plain
        .identified()
        .map(|link| (link, plain.inertia(link).unwrap()))
        .collect();
    let (before, mut random) = (plain.root(), Random::new(4));
    let columns = before.ncols() + kind.count();
    let root = DMatrix::from_fn(columns, columns, |i, j| {
        if i < before.nrows() && j < before.ncols() {
            before[(i, j)]
        } else if j >= before.ncols() {
            0.01 * (1.0 + j as f64) * random.real(0.1)
        } else {
            0.0
        }
    });
    let mut parameters = Parameters::new(&setup.robot, plain.provenance().clone());
    parameters.set_identified(&links, &[offset], &root).unwrap();
    parameters
}

#[test]
fn a_calibration_reads_back_and_is_used() {
    for (gain, temperature) in [
        (Gain::None, true),
        (Gain::Diagonal, false),
        (Gain::Diagonal, true),
        (Gain::Full, true),
    ] {
        let mut setup = arm_with(|config| {
            config.force_torque[0].gain = Some(vec![2.0; 6]);
        });
        let kind = Kind { gain, temperature };
        let parameters = with_calibration(&setup, kind);
        let text = parameters.to_string();
        let read = Parameters::parse(&text).unwrap();
        assert_eq!(read, parameters);
        assert_eq!(read.to_string(), text);
        let deviations = read.calibration_deviation(0);
        assert_eq!(deviations.len(), kind.count());
        // In the file channels are in the order of logs: the gain of the z force on itself is the
        // last of the first three.
        let table: toml::Table = text.parse().unwrap();
        let sensor = &table["sensor"][0];
        let number = |key: &str, at: usize| sensor[key][at].as_float().unwrap();
        assert!((number("gain", 14) - 1.05).abs() < 1e-15);
        assert_eq!(
            number("gain", 3),
            -0.0 + 0.03,
            "fx of tx: internal row 3, column 0"
        );
        match gain {
            Gain::Auto | Gain::None => assert!(sensor.get("gain_std").is_none()),
            Gain::Diagonal => assert_eq!(number("gain_std", 2), deviations[5]),
            Gain::Full => assert_eq!(number("gain_std", 3), deviations[6 * 3]),
        }
        if temperature {
            assert_eq!(
                number("temperature_std_n_per_k", 0),
                deviations[deviations.len() - 3]
            );
            assert_eq!(sensor["reference_celsius"].as_float(), Some(31.5));
        }
        // It replaces the one of the configuration.
        let calibration = parameters.offsets()[0].calibrated.unwrap().calibration;
        assert_ne!(setup.state.calibrations[0], calibration);
        setup.apply(&parameters).unwrap();
        assert_eq!(setup.state.calibrations[0], calibration);
        assert_eq!(setup.robot.calibrations[0].gain_force_first()[0], 2.0);
        // Its uncertainty is part of the torques' standard deviations.
        let certain = {
            let plain = identified(&setup, &mut Random::new(3));
            let mut certain = arm();
            certain.apply(&plain).unwrap();
            certain.state.calibrations[0] = calibration;
            estimates(certain)
        };
        let unsure = estimates(setup);
        let shoulder = "torque_std/l_shoulder_pitch";
        let grown = certain[shoulder]
            .iter()
            .zip(&unsure[shoulder])
            .filter(|(a, b)| **b > 1.01 * **a);
        let expected = if gain == Gain::None {
            0
        } else {
            certain[shoulder].len()
        };
        assert_eq!(
            grown.count(),
            expected,
            "{kind:?}: without a temperature there is nothing to be unsure of"
        );
        assert_eq!(
            certain["torque/l_shoulder_pitch"],
            unsure["torque/l_shoulder_pitch"]
        );
    }
}

/// On-line identification does not determine the calibration, which keeps its covariance.
#[test]
fn an_uncertain_calibration_stays_uncertain_during_on_line_identification() {
    let mut setup = arm_with(|config| config.identification.enabled = true);
    let plain = identified(&setup, &mut Random::new(3));
    let kind = Kind {
        gain: Gain::Diagonal,
        temperature: false,
    };
    let mut known = plain.offsets()[0].clone();
    known.calibrated = Some(Calibrated {
        calibration: Calibration::default(),
        kind,
    });
    let links: Vec<_> = plain
        .identified()
        .map(|link| (link, plain.inertia(link).unwrap()))
        .collect();
    let before = plain.root();
    let columns = before.ncols() + kind.count();
    let root = DMatrix::from_fn(columns, columns, |i, j| {
        match (i < before.nrows(), j < before.ncols()) {
            (true, true) => before[(i, j)],
            _ if i == j => 0.03,
            _ => 0.0,
        }
    });
    let mut parameters = Parameters::new(&setup.robot, plain.provenance().clone());
    parameters.set_identified(&links, &[known], &root).unwrap();
    setup.apply(&parameters).unwrap();
    // A group with a solution and one without, with an offset as large as an iCub's.
    let offset = [Wrench::from_parts([200.0, -100.0, 50.0], [3.0, 2.0, 1.0])];
    let load = Wrench::from_parts([10.0, 20.0, -30.0], [1.0, 2.0, -0.5]);
    let root = DMatrix::from_diagonal_element(6, 6, 1e-3);
    let mut kinematics = Kinematics::new(&setup.robot.model, setup.robot.base_link).unwrap();
    let zeros = vec![0.0; setup.robot.model.dof_count()];
    let state = proprio_dynamics::JointState {
        position: &zeros,
        velocity: &zeros,
        acceleration: &zeros,
    };
    kinematics
        .update(
            &setup.robot.model,
            state,
            &FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81)),
        )
        .unwrap();
    let mut solver = Solver::new(&setup.robot.structure);
    solver
        .solve(
            &setup.state.model,
            &setup.robot.structure,
            &kinematics,
            &[load],
            &setup.robot.always,
            &[],
        )
        .unwrap();
    let torques = |covariance: &Covariance| {
        let mut propagation = Propagation::new(&setup.robot.structure, covariance).unwrap();
        propagation.set_calibration_point(0, &(load + offset[0]), 0.0);
        propagation
            .update(&setup.robot.structure, &solver, &kinematics, Nanos::ZERO)
            .unwrap();
        propagation.torque_std().to_vec()
    };
    let group = PosteriorBlock {
        links: &[],
        bodies: &[],
        sensors: &[0],
        root: Some(&root),
        offsets: &offset,
        drift: &[[0.0; 6]],
        known: Nanos::ZERO,
    };
    let links: Vec<usize> = (0..setup.robot.model.inertias().len()).collect();
    let exact = DMatrix::zeros(1, 10 * links.len());
    let expected = |of: &dyn Fn(usize) -> f64| {
        let mut covariance = Covariance::exact(links.len(), 1);
        covariance.add(&links, &[], exact.clone()).unwrap();
        covariance
            .add(
                &[],
                &[0],
                DMatrix::from_fn(6, 6, |i, j| if i == j { of(i) } else { 0.0 }),
            )
            .unwrap();
        torques(&covariance)
    };
    // Beside a group of exact links, so that only the sensor matters.
    let got = |group: PosteriorBlock<'_>| {
        let others = PosteriorBlock {
            links: &links,
            bodies: setup.robot.model.inertias(),
            sensors: &[],
            root: Some(&exact),
            offsets: &[],
            drift: &[],
            known: Nanos::ZERO,
        };
        torques(
            &setup
                .state
                .covariance_with(&setup.robot, [others, group].into_iter()),
        )
    };
    let of_load = |i: usize| (0.03 * load.torque_first()[i]).hypot(1e-3);
    let raw = (load + offset[0]).torque_first();
    let of_nothing = |i: usize| (0.03 * raw[i]).hypot(if i < 3 { 100.0 } else { 1000.0 });
    for (got, expected) in [
        (got(group), expected(&of_load)),
        (
            got(PosteriorBlock {
                root: None,
                ..group
            }),
            expected(&of_nothing),
        ),
    ] {
        assert!(expected.iter().any(|deviation| *deviation > 0.05));
        for (got, expected) in got.iter().zip(&expected) {
            assert!(
                (got - expected).abs() <= 1e-4 * expected,
                "{got} {expected}"
            );
        }
    }
}

/// A sensor that reads 2 % too much, and bodies behind it that are as much heavier: the residual
/// does not show it, and all torques behind the sensor are off by 2 %.
#[test]
fn the_gain_of_a_sensor_is_as_uncertain_as_usual() {
    let setup = arm_with(|config| config.identification.enabled = true);
    let (model, structure) = (&setup.robot.model, &setup.robot.structure);
    let mut kinematics = Kinematics::new(model, setup.robot.base_link).unwrap();
    let dofs = model.dof_count();
    let position: Vec<f64> = (0..dofs).map(|dof| 0.3 - 0.1 * dof as f64).collect();
    let zeros = vec![0.0; dofs];
    let state = proprio_dynamics::JointState {
        position: &position,
        velocity: &zeros,
        acceleration: &zeros,
    };
    let gravity = FrameMotion::standing(&Vec3::new(0.0, 0.0, 9.81));
    kinematics.update(model, state, &gravity).unwrap();
    let solve = |reading: Wrench| {
        let mut solver = Solver::new(structure);
        let always = &setup.robot.always;
        solver
            .solve(model, structure, &kinematics, &[reading], always, &[])
            .unwrap();
        solver
    };
    // The reading that makes the residual behind the sensor zero.
    let cut = &structure.sensors()[0];
    let behind = structure.subtree_of(cut.joint() + 1).unwrap();
    let unloaded = solve(Wrench::zero());
    let residual = unloaded.imbalance(structure, behind);
    let load = unloaded.sensor_pose(0).wrench_back(&residual) * cut.sign();
    let solver = solve(load);
    let links: Vec<usize> = (0..model.inertias().len())
        .filter(|&link| structure.subtree_of(link) == Some(behind))
        .collect();
    let bodies: Vec<_> = links.iter().map(|&link| model.inertias()[link]).collect();
    let exact = DMatrix::zeros(1, 10 * links.len() + 6);
    let offset = [Wrench::from_parts([20.0, -10.0, 5.0], [0.3, 0.2, 0.1])];
    let group = PosteriorBlock {
        links: &links,
        bodies: &bodies,
        sensors: &[0],
        root: Some(&exact),
        offsets: &offset,
        drift: &[[0.0; 6]],
        known: Nanos::ZERO,
    };
    let covariance = (setup.state).covariance_with(&setup.robot, std::iter::once(group));
    let mut propagation = Propagation::new(structure, &covariance).unwrap();
    propagation.set_calibration_point(0, &(load + offset[0]), 0.0);
    propagation
        .update(structure, &solver, &kinematics, Nanos::ZERO)
        .unwrap();
    let moves_all_behind = |dof: usize| structure.moved_by(dof).iter().all(|l| links.contains(l));
    let all = solver.torque().iter().zip(propagation.torque_std());
    let mut compared = 0;
    for (dof, (torque, deviation)) in all.enumerate().filter(|(dof, _)| moves_all_behind(*dof)) {
        let expected = 0.02 * torque.abs();
        assert!(
            (deviation - expected).abs() < 1e-4 * expected,
            "{dof}: {deviation} {expected}"
        );
        compared += 1;
    }
    assert!(compared >= 3);
    let imbalance = propagation.imbalance_covariances()[behind];
    let of_load = 0.02 * load.force.norm();
    assert!(
        imbalance.trace().sqrt() < 1e-3 * of_load,
        "{imbalance} {of_load}"
    );
}

#[test]
fn an_incomplete_calibration_is_refused() {
    let text = with_calibration(
        &arm(),
        Kind {
            gain: Gain::Diagonal,
            temperature: true,
        },
    )
    .to_string();
    for (key, expected) in [
        ("gain", "gain is missing"),
        ("reference_celsius", "the temperature keys are incomplete"),
        (
            "temperature_nm_per_k",
            "the temperature keys are incomplete",
        ),
        (
            "temperature_std_n_per_k",
            "the temperature keys are incomplete",
        ),
        ("gain_std", "correlation.root must have"),
    ] {
        let cut: String = text
            .lines()
            .filter(|line| !line.starts_with(&format!("{key} = ")))
            .map(|line| format!("{line}\n"))
            .collect();
        assert_ne!(cut, text, "{key}");
        let error = Parameters::parse(&cut).unwrap_err().to_string();
        assert!(error.contains(expected), "{key}: {error}");
    }
}

/// Nine digits are enough for the hardest case: a combination known a million times better than its
/// parameters.
#[test]
fn the_file_keeps_the_variance_of_combinations() {
    let setup = arm();
    let links: Vec<_> = setup
        .robot
        .model
        .inertias()
        .iter()
        .copied()
        .enumerate()
        .collect();
    let columns = 10 * links.len();
    let mut random = Random::new(8);
    let direction = DVector::from_fn(columns, |_, _| random.real(1.0)).normalize();
    let all = DMatrix::from_fn(columns, columns, |_, _| random.real(1.0));
    let narrow =
        DMatrix::identity(columns, columns) - &direction * direction.transpose() * (1.0 - 1e-6);
    let root = all.clone() * narrow;
    let mut parameters = Parameters::new(&setup.robot, Provenance::default());
    parameters.set_identified(&links, &[], &root).unwrap();
    let (got, expected) = (
        (parameters.root() * &direction).norm(),
        (root * &direction).norm(),
    );
    assert!(expected < 2e-6 * (all * &direction).norm());
    assert!((got - expected).abs() < 5e-3 * expected, "{got} {expected}");
}

#[test]
fn an_icubs_file_is_less_than_a_megabyte() {
    let (text, sensors) = humanoid();
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("model.urdf"), text).unwrap();
    let mut config = String::from(
        "schema = 1\nrobot = \"r\"\nmodel = \"model.urdf\"\n[base]\nkind = \"fixed\"\nlink = \
         \"link0\"\n",
    );
    for joint in &sensors {
        config += &format!("[[force_torque]]\nsensor = \"{joint}\"\njoint = \"{joint}\"\n");
    }
    let file = folder.path().join("estimator.toml");
    std::fs::write(&file, config).unwrap();
    let mut config = Config::load(&file).unwrap();
    let setup = Setup::new(&config).unwrap();
    let mut parameters = Parameters::new(&setup.robot, Provenance::default());
    let links: Vec<_> = setup
        .robot
        .model
        .inertias()
        .iter()
        .copied()
        .enumerate()
        .collect();
    let offsets: Vec<Offset> = sensors
        .iter()
        .map(|sensor| Offset {
            sensor: sensor.clone(),
            reading: Wrench::from_parts([1.0 / 3.0; 3], [1.0 / 7.0; 3]),
            drift: Wrench::zero(),
            known: Nanos::ZERO,
            noise: Wrench::zero(),
            calibrated: None,
        })
        .collect();
    let (columns, mut random) = (10 * links.len() + 6 * offsets.len(), Random::new(5));
    assert_eq!(columns, 426);
    let root = DMatrix::from_fn(columns, columns, |_, _| random.real(1e-3));
    parameters.set_identified(&links, &offsets, &root).unwrap();
    let written = folder.path().join("parameters.toml");
    parameters.save(&written).unwrap();
    let bytes = std::fs::metadata(&written).unwrap().len();
    assert!(bytes < 1_000_000, "{bytes}");
    config.parameters = Some(written);
    assert_eq!(
        Setup::new(&config).unwrap().state.identified(),
        Some(&parameters)
    );
}

#[test]
fn a_file_that_is_truncated_or_changed_is_refused_with_a_sentence() {
    let setup = arm();
    let text = identified(&setup, &mut Random::new(3)).to_string();
    // Truncated at any place, down to the last bracket.
    let mut lengths: Vec<usize> = text
        .match_indices('\n')
        .map(|(at, _)| at + 1)
        .filter(|&at| at < text.len())
        .collect();
    lengths.extend((0..text.len() - 2).step_by(997));
    lengths.push(text.len() - 2);
    for length in lengths {
        let error = Parameters::parse(&text[..length]).unwrap_err();
        let sentence = error.to_string();
        assert!(
            matches!(error, ParametersError::Damaged(_)),
            "{length}: {sentence}"
        );
        assert!(
            sentence.contains("identify again") && !sentence.contains('\n'),
            "{sentence}"
        );
    }
    let first_column = text.find("[1000000000]").unwrap();
    let mut half = text.clone();
    half.replace_range(
        first_column.."[1000000000]".len() + first_column,
        "[500000000]",
    );
    for (changed, expected) in [
        (half, "correlation.root: column 0 has length 0.5, not 1"),
        (
            text.replace("program =", "programme ="),
            "unknown field `programme`",
        ),
        (
            text.replacen("identified = [", "identified = [nan, ", 1),
            "11 numbers where 10 are needed",
        ),
        (
            text.replacen("std_n = [", "std_n = [-", 1),
            "correlation.root: column",
        ),
        (
            text.replacen("coulomb_nm = 0.4", "coulomb_nm = inf", 1),
            "joint l_elbow: a number is not finite",
        ),
        (
            text.replacen("rotor_inertia_std_kgm2 = 0.002", "", 1),
            "joint l_elbow: only one of rotor_inertia_kgm2 and rotor_inertia_std_kgm2 is given",
        ),
        (
            text.replacen("identified = [", "identified = [-", 1),
            "no rigid body has these ten parameters: its mass is -",
        ),
        (
            text.replacen("name = \"l_elbow_1\"", "name = \"l_forearm\"", 1),
            "link l_forearm is given twice",
        ),
        ("\u{0}\u{1}garbage".into(), "line 1"),
        (String::new(), "missing field `schema`"),
    ] {
        match Parameters::parse(&changed) {
            Err(error) => assert!(error.to_string().contains(expected), "{expected}: {error}"),
            Ok(_) => assert!(changed == text, "nothing changed for {expected}"),
        }
    }
    let schema = Parameters::parse("schema = 2\nnew = true\n").unwrap_err();
    assert_eq!(
        schema.to_string(),
        "has schema = 2; this version reads schema = 1: identify again, or use the version that \
         wrote it"
    );
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("p.toml");
    assert!(matches!(
        Parameters::load(&file),
        Err(ParametersError::Read(_))
    ));
    std::fs::write(&file, [0xff, 0xfe, 0x00]).unwrap();
    assert!(matches!(
        Parameters::load(&file),
        Err(ParametersError::Damaged(_))
    ));
}

#[test]
fn parameters_of_another_robot_are_refused_with_the_first_difference() {
    let setup = arm();
    let parameters = identified(&setup, &mut Random::new(3));
    let text = parameters.to_string();
    let refused = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        let other = Parameters::parse(&text.replacen(from, to, 1)).unwrap();
        let mut setup = setup.clone();
        let error = setup.apply(&other).unwrap_err().to_string();
        assert_eq!(
            (setup.state.identified(), &setup.state.offsets),
            (None, &arm().state.offsets),
            "nothing is changed"
        );
        error
    };
    assert_eq!(
        refused("robot = \"icub_left_arm\"", "robot = \"icub_right_arm\""),
        "belongs to robot \"icub_right_arm\", not to \"icub_left_arm\"; use the parameters of \
         \"icub_left_arm\", or identify again"
    );
    let sensor = refused("name = \"l_arm_ft_sensor\"", "name = \"r_arm_ft_sensor\"");
    assert!(
        sensor.contains(
            "has force/torque sensor \"r_arm_ft_sensor\", which the configuration does not have"
        ),
        "{sensor}"
    );
    let joint = refused(
        "[[joint]]\nname = \"l_elbow\"",
        "[[joint]]\nname = \"l_elbw\"",
    );
    assert!(joint.contains("has joint \"l_elbw\""), "{joint}");

    // Another URDF: a heavier hand, a longer arm, a link more.
    let urdf = std::fs::read_to_string(root().join("config/icub_left_arm/model.urdf")).unwrap();
    let hand = setup
        .robot
        .model
        .link_name(setup.robot.model.inertias().len() - 1)
        .to_owned();
    let mut inertias = setup.robot.model.inertias().to_vec();
    inertias.last_mut().unwrap().mass *= 1.01;
    let keep = ["l_arm_ft_sensor"];
    let heavier = Model::rewrite_urdf(&urdf, &keep, &inertias).unwrap();
    let joint = urdf.find("<joint name=\"l_elbow\"").unwrap();
    let origin = joint + urdf[joint..].find("xyz=\"").unwrap() + 5;
    let mut longer = urdf.clone();
    longer.insert(origin, '1');
    let more = urdf.replace(
        "</robot>",
        &format!(
            "<link name=\"tip\"><inertial><mass value=\"1\"/><inertia ixx=\"1\" ixy=\"0\" \
             ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial></link>\
             <joint name=\"j\" type=\"continuous\"><parent link=\"{hand}\"/><child link=\"tip\"/>\
             <axis xyz=\"0 0 1\"/></joint></robot>"
        ),
    );
    for (urdf, expected) in [
        (
            heavier,
            format!("link {hand} has other inertial parameters in that URDF"),
        ),
        (longer, "has another frame or axis there".into()),
        (more, "the URDF has link tip, which it does not have".into()),
        (
            urdf.replace("\"l_shoulder_2\"", "\"l_shoulder_two\""),
            "it has link l_shoulder_2 where the URDF has l_shoulder_two".into(),
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("model.urdf");
        std::fs::write(&file, urdf).unwrap();
        let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
        config.model = file;
        if expected.contains("tip") {
            config.locked.insert("j".into(), 0.0);
        }
        let mut other = Setup::new(&config).unwrap();
        let error = other.apply(&parameters).unwrap_err().to_string();
        assert!(
            error.contains(&expected) && error.contains("use the URDF"),
            "{expected}: {error}"
        );
    }
}

#[test]
fn a_setup_names_the_file_that_it_could_not_use() {
    let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    config.parameters = Some("nowhere/p.toml".into());
    let problem = Setup::new(&config).unwrap_err();
    assert!(
        problem.starts_with("parameters: nowhere/p.toml cannot be read: "),
        "{problem}"
    );
}

#[test]
fn inconsistent_or_infinite_parameters_are_refused() {
    let setup = arm();
    let mut parameters = identified(&setup, &mut Random::new(3));
    let before = parameters.clone();
    let (good, root) = (setup.robot.model.inertias()[3], DMatrix::identity(10, 10));
    let mut negative = good;
    negative.mass = -1.0;
    let mut no_number = root.clone();
    no_number[(3, 3)] = f64::NAN;
    let twice = DMatrix::identity(20, 20);
    for (links, root, expected) in [
        (vec![(3, negative)], &root, "no rigid body has these"),
        (
            vec![(3, good)],
            &twice,
            "columns of the covariance's root: 20 given, 10 needed",
        ),
        (vec![(3, good), (3, good)], &twice, "link 3 is given twice"),
        (
            vec![(99, good)],
            &root,
            "link 99 is given twice, or is not one of the 9 links",
        ),
        (
            vec![(3, good)],
            &no_number,
            "the covariance: a number is not finite",
        ),
    ] {
        let error = parameters
            .set_identified(&links, &[], root)
            .unwrap_err()
            .to_string();
        assert!(error.contains(expected), "{expected}: {error}");
    }
    let friction = Friction {
        joint: "l_elbow".into(),
        coulomb: f64::NAN,
        ..Friction::default()
    };
    assert!(parameters.set_friction(&[friction]).is_err());
    let rotor = Rotor {
        inertia: 0.1,
        deviation: -1.0,
    };
    let friction = Friction {
        joint: "l_elbow".into(),
        rotor: Some(rotor),
        ..Friction::default()
    };
    assert!(parameters.set_friction(&[friction]).is_err());
    assert_eq!(parameters, before);
}

// ---------------------------------------------------------------- URDFs

/// A physically consistent body near another one.
fn near(inertia: &RigidInertia, random: &mut Random) -> RigidInertia {
    let stretch = Matrix4::identity() + Matrix4::from_fn(|_, _| random.real(0.15));
    let pseudo = stretch * inertia.pseudo_inertia() * stretch.transpose();
    let sigma: Mat3 = pseudo.fixed_view::<3, 3>(0, 0).into_owned();
    let sigma = (sigma + sigma.transpose()) / 2.0;
    RigidInertia {
        mass: pseudo[(3, 3)],
        first_moment: pseudo.fixed_view::<3, 1>(0, 3).into_owned(),
        inertia: Mat3::from_diagonal_element(sigma.trace()) - sigma,
    }
}

fn check_same(urdf: &str, keep: &[&str], expected: &[RigidInertia]) {
    let model = Model::from_urdf(urdf, keep).unwrap();
    for (link, (got, expected)) in model.inertias().iter().zip(expected).enumerate() {
        let (got, expected) = (got.parameters(), expected.parameters());
        let gap = gap(&got, &expected);
        assert!(
            gap < 1e-12 * size(&expected),
            "{}: {gap:e}",
            model.link_name(link)
        );
    }
}

/// The text without its inertias, to compare the rest.
fn without_inertials(text: &str) -> String {
    let mut rest = text;
    let mut kept = String::new();
    while let Some(from) = rest.find("<inertial>") {
        kept += &rest[..from];
        rest = &rest[from + rest[from..].find("</inertial>").unwrap() + "</inertial>".len()..];
    }
    kept + rest
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn a_urdf_with_other_inertias_says_just_these((links, seed) in (1..=20_usize, any::<u64>())) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let (text, model) = (robot.urdf(), robot.model());
        let keep: Vec<&str> = robot.cuts.iter().map(String::as_str).collect();
        let mut wanted = model.inertias().to_vec();
        for inertia in &mut wanted {
            if random.chance(70) {
                *inertia = near(inertia, &mut random);
            }
        }
        let new = Model::rewrite_urdf(&text, &keep, &wanted).unwrap();
        check_same(&new, &keep, &wanted);
        prop_assert_eq!(without_inertials(&new), without_inertials(&text));
        // Every share is physically consistent.
        let read = urdf_rs::read_from_string(&new).unwrap();
        for link in &read.links {
            let (i, m) = (&link.inertial.inertia, link.inertial.mass.value);
            let tensor = Mat3::new(i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz);
            let share = RigidInertia::from_centroidal(m, &Vec3::zeros(), &tensor);
            prop_assert!(share.check(1e-9).is_ok(), "{}", link.name);
        }
        let same = Model::rewrite_urdf(&text, &keep, model.inertias()).unwrap();
        prop_assert_eq!(same, text, "nothing to change");
    }
}

/// The forms of an inertial element, and of a link without one.
#[test]
fn everything_but_the_inertials_stays_byte_for_byte() {
    let urdf = r#"<?xml version="1.0"?>
<!-- a comment -->
<robot name="r" xmlns:xacro="http://x">
	<link name="base"/>
  <joint name="fixed0" type="fixed"><parent link="base"/><child link="body"/></joint>
    <link name="body">
      <visual><geometry><box size="1 1 1"/></geometry></visual> <!-- stays -->
      <inertial>
        <origin xyz="0.1 0 0" rpy="0 0 1.5"/> <mass value="2"/>
        <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/>
      </inertial>
    </link>
  <joint name="swing" type="continuous">
    <parent link="body"/><child link="frame"/><axis xyz="0 1 0"/>
  </joint>
  <link name="frame"> <!-- nothing --> </link>
  <joint name="fixed1" type="fixed">
    <parent link="frame"/><child link="a"/><origin xyz="0 0 0.3" rpy="0.1 0 0"/>
  </joint>
  <link name="a"><inertial>
    <mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>
  </inertial></link>
  <joint name="fixed2" type="fixed">
    <parent link="a"/><child link="b"/><origin xyz="0.2 0 0"/>
  </joint>
  <link name="b"><inertial>
    <mass value="0.5"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/>
  </inertial></link>
  <transmission name="t"><type>x</type></transmission>
  <gazebo reference="b"><sensor type="camera" name="c"/></gazebo>
</robot>
"#;
    let model = Model::from_urdf(urdf, &[]).unwrap();
    let mut random = Random::new(1);
    let wanted: Vec<RigidInertia> = model
        .inertias()
        .iter()
        .map(|i| near(i, &mut random))
        .collect();
    let new = Model::rewrite_urdf(urdf, &[], &wanted).unwrap();
    check_same(&new, &[], &wanted);
    assert_eq!(without_inertials(&new), without_inertials(urdf));
    assert_eq!(
        new.matches("<inertial>").count(),
        3,
        "frames without mass stay what they are:\n{new}"
    );
    // In the style of the old element.
    assert!(
        new.contains("\n      <inertial>\n        <origin xyz=\""),
        "{new}"
    );
    // Masses change by one factor within a body.
    let read = urdf_rs::read_from_string(&new).unwrap();
    let mass = |name: &str| {
        read.links
            .iter()
            .find(|l| l.name == name)
            .unwrap()
            .inertial
            .mass
            .value
    };
    assert!((mass("a") / mass("b") - 2.0).abs() < 1e-12);

    // A body without mass, on a link that is written as one tag, as two, or with content.
    for link in [
        "<link name=\"tip\"/>",
        "<link name=\"tip\"></link>",
        "<link name=\"tip\"><visual/></link>",
    ] {
        let joint =
            "<joint name=\"j\" type=\"fixed\"><parent link=\"b\"/><child link=\"tip\"/></joint>";
        let text = urdf.replace("</robot>", &format!("{joint}{link}</robot>"));
        // If its joint is kept, it is a separate body without an inertial element. If it is folded,
        // it does not need one.
        let text = text.replace(
            "type=\"fixed\"><parent link=\"b\"/><child link=\"tip\"",
            "type=\"fixed\"><parent link=\"b\"/><child link=\"tip2\"",
        );
        let text = text.replace(
            "</robot>",
            "<link name=\"tip2\"><inertial><mass value=\"0\"/><inertia ixx=\"0\" ixy=\"0\" \
             ixz=\"0\" iyy=\"0\" iyz=\"0\" izz=\"0\"/></inertial></link>\
             <joint name=\"k\" type=\"fixed\"><parent link=\"tip2\"/><child link=\"tip\"/></joint>\
             </robot>",
        );
        let model = Model::from_urdf(&text, &["j"]).unwrap();
        let mut wanted = model.inertias().to_vec();
        let body = model.frame("tip").unwrap().link;
        wanted[body] = RigidInertia::from_centroidal(
            0.3,
            &Vec3::new(0.0, 0.1, 0.0),
            &(Mat3::identity() * 1e-3),
        );
        check_same(
            &Model::rewrite_urdf(&text, &["j"], &wanted).unwrap(),
            &["j"],
            &wanted,
        );
    }
    // The root, without an inertial element on any of its links, in each form.
    for link in [
        "<link name=\"world\"/>",
        "<link name=\"world\"></link>",
        "<link name=\"world\"> <visual/></link>",
    ] {
        let text = urdf.replace(
            "<link name=\"base\"/>",
            &format!(
                "<link name=\"base\"/>{link}<joint \
                name=\"up\" type=\"continuous\"><parent link=\"world\"/><child link=\"base\"/>\
                </joint>"
            ),
        );
        let model = Model::from_urdf(&text, &[]).unwrap();
        let mut wanted = model.inertias().to_vec();
        wanted[0] = wanted[1];
        let new = Model::rewrite_urdf(&text, &[], &wanted).unwrap();
        check_same(&new, &[], &wanted);
        // A self-closing tag is opened for it.
        let plain = |text: &str| {
            without_inertials(text)
                .replace("<link name=\"world\"></link>", "<link name=\"world\"/>")
        };
        assert_eq!(plain(&new), plain(&text));
    }
    // A body with inconsistent shares: the top link with mass gets all of it, and the other links
    // lose theirs.
    let broken = urdf.replace("ixx=\"0.001\"", "ixx=\"0.1\"");
    let new = Model::rewrite_urdf(&broken, &[], &wanted).unwrap();
    check_same(&new, &[], &wanted);
    assert_eq!(
        (
            new.matches("<inertial>").count(),
            new.contains("<link name=\"b\"></link>")
        ),
        (2, true),
        "{new}"
    );

    let model = Model::from_urdf(urdf, &[]).unwrap();
    assert_eq!(
        Model::rewrite_urdf(urdf, &[], &model.inertias()[..1]),
        Err(ModelError::InertiaCount {
            given: 1,
            needed: 2
        })
    );
    let mut infinite = model.inertias().to_vec();
    infinite[1].mass = f64::INFINITY;
    assert!(Model::rewrite_urdf(urdf, &[], &infinite).is_err());
    assert!(matches!(
        Model::rewrite_urdf("<robot", &[], &[]),
        Err(ModelError::Syntax { .. })
    ));
}

#[test]
fn the_urdf_of_identified_parameters_can_be_loaded() {
    let setup = arm();
    let parameters = identified(&setup, &mut Random::new(3));
    let text = std::fs::read_to_string(root().join("config/icub_left_arm/model.urdf")).unwrap();
    let new = parameters.urdf(&text, &setup.robot).unwrap();
    let mut applied = arm();
    applied.apply(&parameters).unwrap();
    check_same(&new, &["l_arm_ft_sensor"], applied.state.model.inertias());
    assert_eq!(without_inertials(&new), without_inertials(&text));
    let base = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81));
    let model = Model::from_urdf(&new, &["l_arm_ft_sensor"]).unwrap();
    let still = vec![0.0; model.dof_count()];
    let weigh = |model: &Model| {
        let mut kinematics = Kinematics::new(model, 0).unwrap();
        let state = proprio_dynamics::JointState {
            position: &still,
            velocity: &still,
            acceleration: &still,
        };
        kinematics.update(model, state, &base).unwrap();
        kinematics
            .net_wrenches()
            .iter()
            .map(|w| w.force.norm())
            .sum::<f64>()
    };
    assert!((weigh(&model) - weigh(&applied.state.model)).abs() < 1e-12 * weigh(&model));
}
