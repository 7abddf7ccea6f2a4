//! Identified parameters and calibrations in use: the setup, the pipeline and on-line
//! identification with them.

use super::{Table, arm, arm_with, estimates, identified};
use crate::common::{Random, gap};
use nalgebra::{DMatrix, Matrix6};
use proprio_dynamics::calibration::{Calibration, Gain, Kind};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{FrameMotion, Kinematics, Solver};
use proprio_estimator::inertial::PosteriorBlock;
use proprio_estimator::parameters::{Parameters, Provenance, SensorCalibration, UsedLog};
use proprio_estimator::propagation::{Covariance, Propagation};
use proprio_estimator::setup::Setup;
use proprio_topics::Nanos;

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
        .zip(setup.initial.model.inertias())
        .enumerate()
    {
        let factor = if link < top { 1.0 } else { 1.1 };
        assert!((now.mass - factor * cad.mass).abs() < 1e-12, "{link}");
        assert_eq!(parameters.inertia(link).is_some(), link >= top);
    }
    assert_eq!(
        setup.initial.offsets,
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
        let span = UsedLog {
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

/// The same with a calibration of the sensor, known to per cents.
pub(super) fn with_calibration(setup: &Setup, kind: Kind) -> Parameters {
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
    offset.calibrated = Some(SensorCalibration {
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
        assert_ne!(setup.initial.calibrations[0], calibration);
        setup.apply(&parameters).unwrap();
        assert_eq!(setup.initial.calibrations[0], calibration);
        assert_eq!(setup.robot.calibrations[0].gain_force_first()[0], 2.0);
        // Its uncertainty is part of the torques' standard deviations.
        let certain = {
            let plain = identified(&setup, &mut Random::new(3));
            let mut certain = arm();
            certain.apply(&plain).unwrap();
            certain.initial.calibrations[0] = calibration;
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
    known.calibrated = Some(SensorCalibration {
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
            &setup.initial.model,
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
        drift_std: &[[0.0; 6]],
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
            drift_std: &[],
            known: Nanos::ZERO,
        };
        torques(
            &setup
                .initial
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
        drift_std: &[[0.0; 6]],
        known: Nanos::ZERO,
    };
    let covariance = (setup.initial).covariance_with(&setup.robot, std::iter::once(group));
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
