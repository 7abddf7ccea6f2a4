//! Conversion of an identification result ([`Outcome`]) to the parameters that the estimator reads
//! ([`Parameters`]).

use crate::parameters::{
    Friction, Offset, Parameters, ParametersError, Provenance, Rotor, SensorCalibration, UsedLog,
};
use nalgebra::DMatrix;
use proprio_dynamics::calibration::Unknown;
use proprio_dynamics::regressor::identifiable::ParameterColumn;
use proprio_dynamics::spatial::Wrench;
use proprio_identification::Robot;
use proprio_identification::robot::{AXES, ChannelRole};
use proprio_identification::{KnownParameters, LogOutcome, LogRole, Outcome};

/// The identified parameters of `robot`: inertial parameters of the links in the covariance,
/// offsets, calibrations, friction, rotor inertias. Offsets and friction are those at the end of
/// the last training log that contains the sensor, or the joint's torque. `program` is the name and
/// version of the identifying program.
///
/// # Errors
/// The outcome belongs to another robot, has a physically inconsistent body, or has numbers that
/// are not finite.
pub fn parameters(
    outcome: &Outcome,
    robot: &Robot,
    program: &str,
) -> Result<Parameters, ParametersError> {
    let logs = trained(outcome).map(|log| UsedLog {
        file: log.file.clone(),
        start: log.span.0,
        end: log.span.1,
    });
    let provenance = Provenance {
        program: program.to_owned(),
        tau: outcome.tau.is_finite().then_some(outcome.tau),
        logs: logs.collect(),
    };
    // What was identified, and where the covariance of the outcome has it.
    let (mut inertias, mut offsets) = (Vec::new(), Vec::new());
    let (mut rows, mut of_calibrations) = (Vec::new(), Vec::new());
    for link in &outcome.links {
        let number = link.link;
        let unknowns = (0..10).map(|parameter| ParameterColumn::Inertial {
            link: number,
            parameter,
        });
        if let Some(own) = rows_of(outcome, unknowns) {
            inertias.push((number, link.identified));
            rows.extend(own);
        }
    }
    for channel in &robot.channels {
        let ChannelRole::Sensor(sensor) = channel.role else {
            continue;
        };
        let unknowns = (0..6).map(|component| ParameterColumn::Offset { sensor, component });
        let own = rows_of(outcome, unknowns);
        if let (Some(offset), Some(own)) = (last_offset(outcome, &channel.name), own) {
            offsets.push(offset);
            rows.extend(own);
            let calibrations = outcome.covariance.calibrations.iter();
            let calibrations = calibrations.zip(outcome.covariance.columns.len()..);
            let calibrated = calibrations.filter(|((other, _), _)| *other == sensor);
            of_calibrations.extend(calibrated.map(|(_, row)| row));
        }
    }
    rows.extend(of_calibrations);
    // The outcome has U U^T, where rows of U are unknowns; here root^T root, where columns are.
    let upper = &outcome.covariance.root;
    let root = DMatrix::from_fn(upper.ncols(), rows.len(), |i, j| {
        let number = rows.get(j).and_then(|row| upper.get((*row, i)));
        number.copied().unwrap_or(f64::NAN)
    });
    let mut parameters = Parameters::new(robot, provenance);
    parameters.set_identified(&inertias, &offsets, &root)?;
    parameters.set_friction(&frictions(outcome))?;
    Ok(parameters)
}

/// For each joint, the friction of the last log that has it, and the joint's rotor.
fn frictions(outcome: &Outcome) -> Vec<Friction> {
    let mut frictions: Vec<Friction> = Vec::new();
    for found in trained(outcome).rev().flat_map(|log| &log.friction) {
        if frictions.iter().any(|own| own.joint == found.joint) {
            continue;
        }
        let rotor = (outcome.rotors.iter()).find(|rotor| rotor.joint == found.joint);
        frictions.push(Friction {
            joint: found.joint.clone(),
            coulomb: found.coulomb_nm,
            viscous: found.viscous,
            offset: found.offset_nm,
            rotor: rotor.map(|rotor| Rotor {
                inertia: rotor.inertia,
                deviation: rotor.deviation,
            }),
        });
    }
    frictions
}

fn trained(outcome: &Outcome) -> impl DoubleEndedIterator<Item = &LogOutcome> {
    outcome.logs.iter().filter(|log| log.role == LogRole::Train)
}

/// The rows of unknowns in the root of the outcome's covariance; none if it lacks one.
fn rows_of(
    outcome: &Outcome,
    unknowns: impl Iterator<Item = ParameterColumn>,
) -> Option<Vec<usize>> {
    let columns = &outcome.covariance.columns;
    unknowns
        .map(|unknown| columns.iter().position(|column| *column == unknown))
        .collect()
}

/// A sensor's offset at the end of the last training log that contains it, and its calibration.
fn last_offset(outcome: &Outcome, sensor: &str) -> Option<Offset> {
    let (log, offset) = trained(outcome).rev().find_map(|log| {
        let offset = log.offsets.iter().find(|offset| offset.sensor == sensor)?;
        Some((log, offset))
    })?;
    let calibrations = &outcome.calibrations;
    let calibration = calibrations.iter().find(|found| found.sensor == sensor);
    let noise = AXES.map(|axis| {
        let name = format!("wrench/{sensor}/{axis}");
        let channel = outcome.channels.iter().find(|channel| channel.name == name);
        channel.map_or(0.0, |channel| channel.deviation)
    });
    Some(Offset {
        sensor: sensor.to_owned(),
        reading: wrench(&offset.end),
        drift: wrench(&offset.rate),
        known: log.span.1,
        noise: wrench(&noise),
        calibrated: calibration.map(|found| SensorCalibration {
            calibration: found.identified,
            kind: found.kind,
        }),
    })
}

/// A wrench from `[fx fy fz tx ty tz]`.
fn wrench([fx, fy, fz, tx, ty, tz]: &[f64; 6]) -> Wrench {
    Wrench::from_parts([*fx, *fy, *fz], [*tx, *ty, *tz])
}

/// What is known with these parameters about `robot` before it takes a payload up.
#[must_use]
pub fn known(parameters: &Parameters, robot: &Robot) -> KnownParameters {
    let links: Vec<usize> = parameters.identified().collect();
    let root = parameters.root();
    // The deviation of each channel's gain with itself, the largest.
    let mut gains = vec![0.0; robot.offsets.len()];
    for (index, offset) in parameters.offsets().iter().enumerate() {
        let Some(sensor) = robot.sensor(&offset.sensor) else {
            continue;
        };
        let unknowns = offset.calibrated.iter().flat_map(|own| own.kind.unknowns());
        let deviations = parameters.calibration_deviation(index);
        for (unknown, deviation) in unknowns.zip(deviations) {
            if matches!(unknown, Unknown::Gain { channel, of } if channel == of) {
                gains[sensor] = deviation.max(gains[sensor]);
            }
        }
    }
    KnownParameters {
        root: root.columns(0, 10 * links.len()).into_owned(),
        links,
        gains,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::setup::Setup;
    use proprio_dynamics::spatial::RigidInertia;
    use proprio_identification::{
        ChannelNoise, CovarianceRoot, FrictionOutcome, LinkOutcome, OffsetOutcome, Predicted,
        RotorOutcome, Verdict,
    };
    use proprio_topics::Nanos;
    use std::collections::BTreeMap;
    use std::path::Path;

    fn robot() -> Robot {
        let file =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/icub_left_arm/estimator.toml");
        Setup::new(&Config::load(&file).unwrap()).unwrap().robot
    }

    /// Two links and the sensor of the arm, with any covariance.
    fn outcome(robot: &Robot) -> Outcome {
        let links = robot
            .model
            .inertias()
            .iter()
            .enumerate()
            .map(|(link, cad)| LinkOutcome {
                link,
                name: robot.model.link_name(link).to_owned(),
                cad: *cad,
                floored: None,
                identified: RigidInertia::from_parameters(&cad.parameters().map(|p| 1.1 * p)),
                deviation: [0.0; 10],
                retained_fraction: 1.0,
                significance: 0.0,
                seen: link == 3 || link == 5,
            });
        // Offsets before links, and the later link before the earlier one: only the columns
        // determine the places.
        let mut columns: Vec<ParameterColumn> = (0..6)
            .map(|component| ParameterColumn::Offset {
                sensor: 0,
                component,
            })
            .collect();
        for link in [5, 3] {
            columns.extend((0..10).map(|parameter| ParameterColumn::Inertial { link, parameter }));
        }
        let root = DMatrix::from_fn(26, 26, |i, j| {
            if i <= j {
                ((i * 31 + j * 17) as f64).sin() * 1e-3
            } else {
                0.0
            }
        });
        let log = |file: &str, role, end| LogOutcome {
            file: file.into(),
            role,
            span: (Nanos(1), Nanos(1_000_000_001)),
            used: 1,
            excluded: vec![],
            onset: None,
            predicted: Predicted::default(),
            joints: vec![],
            sensors: vec![],
            two_route: vec![],
            offsets: vec![OffsetOutcome {
                sensor: "l_arm_ft_sensor".into(),
                start: [0.0; 6],
                end,
                deviation: [0.0; 6],
                rate: [0.1, 0.2, 0.3, 0.01, 0.02, 0.03],
            }],
            friction: vec![FrictionOutcome {
                joint: "l_elbow".into(),
                coulomb_nm: 0.4,
                viscous: 0.08,
                offset_nm: -0.02,
                deviation: [0.01; 3],
            }],
            findings: vec![],
            curves: vec![],
        };
        Outcome {
            robot: robot.name.clone(),
            verdict: Verdict::Identified,
            links: links.collect(),
            covariance: CovarianceRoot {
                columns,
                calibrations: vec![],
                root,
            },
            rotors: vec![],
            calibrations: vec![],
            tau: 0.5,
            least_retained_fraction: 1.0,
            unknowns: 20,
            rank: 9,
            structural_rank: 9,
            effective: 9.0,
            condition: 1.0,
            singular_values: vec![],
            weakest: vec![],
            not_separable: vec![],
            base_parameters: vec![],
            channels: ["fz", "fx", "fy", "tx", "ty", "tz"]
                .iter()
                .zip([0.3, 0.1, 0.2, 0.01, 0.02, 0.03])
                .map(|(axis, deviation)| ChannelNoise {
                    name: format!("wrench/l_arm_ft_sensor/{axis}"),
                    unit: "",
                    deviation,
                    autocorrelation_seconds: 0.0,
                    drift: 0.0,
                })
                .collect(),
            time_offsets: vec![],
            logs: vec![
                log("train.csv", LogRole::Train, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
                log("validate.csv", LogRole::Validate, [9.0; 6]),
            ],
            findings: vec![],
        }
    }

    #[test]
    fn identified_parameters_are_exported_with_their_covariance() {
        let robot = robot();
        let outcome = outcome(&robot);
        let given = parameters(&outcome, &robot, "a program 1").unwrap();
        assert_eq!(given.identified().collect::<Vec<_>>(), [3, 5]);
        assert_eq!(given.inertia(5), Some(outcome.links[5].identified));
        let covariance = &outcome.covariance.root * outcome.covariance.root.transpose();
        let close = |a: f64, b: f64| (a - b).abs() <= 1e-8 * b.abs();
        for (link, first) in [(5, 6), (3, 16)] {
            let deviation = given.deviation(link).expect("an identified link's");
            for (i, d) in deviation.iter().enumerate() {
                assert!(
                    close(*d, covariance[(first + i, first + i)].sqrt()),
                    "link {link}, {i}: {d}"
                );
            }
        }
        // Also the covariances between the two links and with the offset.
        let root = given.root();
        let got = root.transpose() * &root;
        let place = |i: usize| {
            if i < 10 {
                16 + i
            } else if i < 20 {
                i - 4
            } else {
                i - 20
            }
        };
        for i in 0..26 {
            for j in 0..26 {
                let scale =
                    (covariance[(place(i), place(i))] * covariance[(place(j), place(j))]).sqrt();
                assert!(
                    (got[(i, j)] - covariance[(place(i), place(j))]).abs() < 1e-7 * scale,
                    "{i}, {j}"
                );
            }
        }
        // The offset of the training log; the outcome has force first.
        let [offset] = given.offsets() else {
            panic!("one sensor")
        };
        assert_eq!(
            offset.reading,
            Wrench::from_parts([1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
        );
        assert_eq!(
            offset.drift,
            Wrench::from_parts([0.1, 0.2, 0.3], [0.01, 0.02, 0.03])
        );
        assert_eq!(
            (offset.sensor.as_str(), offset.known),
            ("l_arm_ft_sensor", Nanos(1_000_000_001))
        );
        assert_eq!(
            offset.noise,
            Wrench::from_parts([0.1, 0.2, 0.3], [0.01, 0.02, 0.03])
        );
        let friction = Friction {
            joint: "l_elbow".into(),
            coulomb: 0.4,
            viscous: 0.08,
            offset: -0.02,
            rotor: None,
        };
        assert_eq!(given.friction(), [friction]);
        let provenance = given.provenance();
        assert_eq!((provenance.logs.len(), provenance.tau), (1, Some(0.5)));
        assert_eq!(provenance.logs[0].file, "train.csv");
        // The text of the file reads back as the same parameters.
        given.check_robot(&robot).unwrap();
        assert_eq!(Parameters::parse(&given.to_string()).unwrap(), given);
    }

    /// A sensor was dead in the last log, and a joint's torque was not measured there: their values
    /// come from the log before.
    #[test]
    fn each_offset_and_friction_is_from_the_last_log_that_has_it() {
        let robot = robot();
        let mut outcome = outcome(&robot);
        let mut later = outcome.logs[0].clone();
        later.offsets.clear();
        later.span = (Nanos(5_000_000_000), Nanos(6_000_000_000));
        let friction = |joint: &str, coulomb_nm| FrictionOutcome {
            joint: joint.into(),
            coulomb_nm,
            ..FrictionOutcome::default()
        };
        outcome.logs[0].friction = vec![friction("l_elbow", 0.1), friction("l_wrist_yaw", 0.2)];
        later.friction = vec![friction("l_elbow", 0.3)];
        outcome.rotors = vec![RotorOutcome {
            joint: "l_elbow".into(),
            inertia: 0.25,
            deviation: 0.01,
        }];
        outcome.logs.push(later);
        let given = parameters(&outcome, &robot, "a program 1").unwrap();
        let [offset] = given.offsets() else {
            panic!("one sensor")
        };
        assert_eq!(
            offset.reading,
            Wrench::from_parts([1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
        );
        assert_eq!(offset.known, Nanos(1_000_000_001));
        let rotors: Vec<Option<Rotor>> = given.friction().iter().map(|f| f.rotor).collect();
        let rotor = Rotor {
            inertia: 0.25,
            deviation: 0.01,
        };
        assert!(
            rotors.contains(&Some(rotor)) && rotors.contains(&None),
            "each joint its own: {rotors:?}"
        );
        let coulomb: BTreeMap<&str, f64> = given
            .friction()
            .iter()
            .map(|f| (f.joint.as_str(), f.coulomb))
            .collect();
        assert_eq!(
            coulomb,
            BTreeMap::from([("l_elbow", 0.3), ("l_wrist_yaw", 0.2)])
        );
    }

    #[test]
    fn numbers_that_are_not_finite_are_refused() {
        let robot = robot();
        let mut outcome = outcome(&robot);
        outcome.covariance.root[(2, 2)] = f64::NAN;
        assert!(parameters(&outcome, &robot, "").is_err());
    }
}
