//! The covariance of parameters as standard deviations of torques and contact wrenches: against
//! another method, and against random draws.

use super::{KNOWN, arm, identified, root};
use crate::common::{Random, RandomRobot, State, contact, humanoid, motion};
use nalgebra::{DMatrix, DVector, Matrix4, SMatrix};
use proprio_dynamics::calibration::{Gain, Kind, Unknown};
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::regressor::{EstimateRows, link_rows};
use proprio_dynamics::spatial::{Mat3, Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, DynamicsError, Kinematics, Noise, SensorCut, Solver,
    Structure,
};
use proprio_estimator::propagation::{Covariance, Propagation};
use proprio_identification::prior::link_cad_root;
use proprio_topics::{Nanos, Source};
use proptest::prelude::*;

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
                let scaled = root.column(column) * factor;
                let mut sum = together.column_mut(10 * all.len() + 6 * sensor + unknown.channel());
                sum += scaled;
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

#[test]
fn parameters_drawn_from_the_covariance_spread_the_torques_as_stated() {
    let mut random = Random::new(2015);
    // The arm as configured, with the uncertainty of the URDF; and with identified parameters.
    let mut setup = arm();
    let active = setup.robot.always;
    spread(
        &setup.initial.model,
        &setup.robot.structure,
        &active,
        &setup.initial.covariance,
        &mut random,
        4000,
    );
    setup.apply(&identified(&setup, &mut random)).unwrap();
    spread(
        &setup.initial.model,
        &setup.robot.structure,
        &active,
        &setup.initial.covariance,
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
        let root = link_cad_root(body, relative);
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
