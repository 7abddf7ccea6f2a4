//! A second opinion on torques: drives are identified from the torques of the F/T sensors, on a
//! simulated arm and on a real leg, and disagree when something acts that no sensor sees.
#![allow(missing_docs)]

use proprio_estimator::config::Config;
use proprio_estimator::drive::{self, DriveModel, DriveSignal, Unfit};
use proprio_estimator::offline::{drive_rows, run_on_log};
use proprio_estimator::parameters::Parameters;
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_gateway::offline;
use proprio_simulator::drive::DriveTruth;
use proprio_simulator::record::record;
use proprio_simulator::{SimulatedRobot, Simulation, SimulationSettings};
use proprio_tests::watch::open;
use proprio_tests::{PATIENCE, Rig, until};
use proprio_topics::csv::Columns;
use proprio_topics::{Agreement, Candidate, DriveEstimate, Nanos, TorqueEstimate};
use serde_json::Value as Json;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// When the logs begin.
const T0: Nanos = Nanos::from_millis(100_000);

/// An arm whose motor boards report currents, and its logs.
struct Arm {
    rig: Rig,
    robot: SimulatedRobot,
}

impl Arm {
    fn new() -> Self {
        let rig = Rig::new();
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        let folder = &robot.folder;
        for file in ["model.urdf", "gateway.toml"] {
            fs::copy(folder.join(file), rig.path(file)).unwrap();
        }
        let config = fs::read_to_string(folder.join("estimator.toml")).unwrap();
        let hand = "link = \"l_hand\"";
        assert!(config.contains(hand));
        fs::write(rig.path("touched.toml"), &config).unwrap();
        let possible = format!("{hand}\npresence = \"possible\"");
        let config = config.replace(hand, &possible);
        fs::write(rig.path("estimator.toml"), config).unwrap();
        Self { rig, robot }
    }

    fn path(&self, name: &str) -> String {
        self.rig.path(name).display().to_string()
    }

    /// A session as a table of samples.
    fn session(&self, seed: u64, seconds: f64, faults: &[&str]) -> Vec<u8> {
        let settings = settings(seed, faults);
        let (mut log, mut table) = (Vec::new(), Vec::new());
        record(&self.robot, &settings, seconds, T0, &mut log).unwrap();
        offline::decode(&self.robot.plan, &log[..], &mut table, Columns::All).unwrap();
        table
    }

    /// What was identified from two sessions, and the summary of it.
    fn identify(&self) -> (Parameters, Json) {
        let mut arguments = vec!["identify".to_owned(), "--config".into()];
        arguments.push(self.path("estimator.toml"));
        for seed in [1, 2] {
            let file = self.path(&format!("{seed}.csv"));
            fs::write(&file, self.session(seed, 30.0, &[])).unwrap();
            arguments.extend(["--samples".into(), file]);
        }
        arguments.extend(["--out".into(), self.path("out")]);
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let ran = self.rig.run(&arguments);
        let said = String::from_utf8_lossy(&ran.stderr);
        assert!(ran.status.success() && !said.contains("drive"), "{said}");
        let summary = fs::read(self.rig.path("out/summary.json")).unwrap();
        let file = self.rig.path("out/parameters.toml");
        (
            Parameters::load(&file).unwrap(),
            serde_json::from_slice(&summary).unwrap(),
        )
    }

    fn setup(&self, config: &str, parameters: &Parameters) -> Setup {
        let config = Config::load(&self.rig.path(config)).unwrap();
        let mut setup = Setup::new(&config).unwrap();
        setup.apply(parameters).unwrap();
        setup
    }
}

fn settings(seed: u64, faults: &[&str]) -> SimulationSettings {
    SimulationSettings {
        seed,
        push: false,
        faults: faults.iter().map(|fault| fault.parse().unwrap()).collect(),
        ..SimulationSettings::default()
    }
}

/// What the estimator says of a log, in seconds from its beginning.
fn each(setup: Setup, log: &[u8], mut take: impl FnMut(f64, &Pipeline)) {
    run_on_log(setup, log, |pipeline, _| {
        take((pipeline.last_estimate().t - T0).seconds(), pipeline);
        Ok(ControlFlow::Continue(()))
    })
    .unwrap();
}

/// The joints that disagree, and the candidates.
fn disagreement(setup: &Setup, said: &DriveEstimate) -> (Vec<String>, Vec<(Candidate, String)>) {
    let joints: Vec<&str> = setup.robot.joint_names().collect();
    let drives = said.drives().iter();
    let disagreeing = drives.filter(|own| own.agreement == Agreement::Disagrees);
    let candidates = said.candidates().iter();
    (
        disagreeing
            .map(|own| joints[own.joint as usize].to_owned())
            .collect(),
        candidates
            .map(|own| (own.kind.get().unwrap(), own.name.as_str().to_owned()))
            .collect(),
    )
}

/// A log with the values of a column multiplied.
fn multiplied(log: &[u8], column: &str, factor: f64) -> Vec<u8> {
    let text = std::str::from_utf8(log).unwrap();
    let place = text.lines().next().unwrap().split(',');
    let place = place.into_iter().position(|name| name == column).unwrap();
    let lines = text.lines().map(|line| {
        let cells = line.split(',').enumerate().map(|(number, cell)| {
            let value = cell.parse::<f64>().ok().filter(|_| number == place);
            value.map_or(cell.to_owned(), |value| (factor * value).to_string())
        });
        cells.collect::<Vec<_>>().join(",")
    });
    lines.collect::<Vec<_>>().join("\n").into_bytes()
}

const SENSOR: &str = "l_arm_ft_sensor";

#[test]
fn a_drive_is_found_and_disagrees_with_what_no_sensor_sees() {
    let arm = Arm::new();
    let (parameters, summary) = arm.identify();
    found(&arm, &parameters, &summary);
    quiet(&arm, &parameters);
    pushed(&arm, &parameters);
    in_other_units(&arm, &parameters);
    turned(&arm, &parameters);
    live(&arm);
}

/// Each drive is the simulated one, within its deviations.
fn found(arm: &Arm, parameters: &Parameters, summary: &Json) {
    let joints: Vec<String> = (parameters.drives().iter())
        .map(|own| own.joint.clone())
        .collect();
    let config = Config::load(&arm.rig.path("estimator.toml")).unwrap();
    let all = Setup::new(&config).unwrap();
    assert!(
        all.robot
            .joint_names()
            .eq(joints.iter().map(String::as_str))
    );
    for own in parameters.drives() {
        assert_eq!(own.signal, DriveSignal::Current);
        let truth = DriveTruth::new(&arm.robot.model, &own.joint);
        let expected = [
            truth.per_ampere,
            truth.coulomb,
            truth.viscous,
            truth.load,
            truth.rotor,
            0.0,
        ];
        for (number, found) in own.parameters.into_iter().enumerate() {
            let deviation = own.deviations()[number];
            let what = format!(
                "{} {number}: {found} +- {deviation}, {expected:?}",
                own.joint
            );
            // Load-dependent friction may be left out, and is then part of the other two.
            assert!(
                (found - expected[number]).abs() < 4.0 * deviation
                    || own.parameters[3] == 0.0 && (1..5).contains(&number),
                "{what}"
            );
        }
        let relative = |i: usize| own.parameters[i] / expected[i] - 1.0;
        println!(
            "{}: constant {:+.3}, Coulomb {:+.3}, viscous {:+.3}",
            own.joint,
            relative(0),
            relative(1),
            relative(2)
        );
        assert!(relative(0).abs() < 0.06 && relative(1).abs() < 0.1 && relative(2).abs() < 0.15);
        let ripple = truth.ripple / f64::sqrt(2.0);
        assert!(
            (0.7..1.5).contains(&(own.noise / ripple)),
            "{} {} {ripple}",
            own.joint,
            own.noise
        );
        let listed = &summary["drives"][&own.joint];
        assert_eq!(listed["constant"].as_f64(), Some(own.parameters[0]));
        assert_eq!(listed["signal"], "current");
    }
    let file = arm.rig.path("again.toml");
    parameters.save(&file).unwrap();
    let text = fs::read_to_string(&file).unwrap();
    let again = Parameters::load(&file).unwrap();
    again.save(&file).unwrap();
    assert_eq!(text, fs::read_to_string(&file).unwrap());
}

/// Drives agree with a motion that they were not identified from, and no torque depends on them.
fn quiet(arm: &Arm, parameters: &Parameters) {
    let log = arm.session(3, 30.0, &[]);
    let mut without = Vec::new();
    let mut setup = arm.setup("estimator.toml", parameters);
    setup.drives.clear();
    each(setup, &log, |_, pipeline| {
        assert!(pipeline.drives().is_none());
        without.push(pipeline.last_estimate().clone());
    });
    let mut without = without.into_iter();
    let mut compared = 0;
    each(
        arm.setup("estimator.toml", parameters),
        &log,
        |t, pipeline| {
            let text = format!("{:?}", pipeline.last_estimate());
            assert_eq!(Some(text), without.next().map(|other| format!("{other:?}")));
            let said = pipeline.drives().unwrap();
            for text in said.drives() {
                assert_ne!(text.agreement, Agreement::Disagrees, "{t} {text:?}");
                compared += usize::from(text.agreement == Agreement::Agrees);
            }
            assert!(said.candidates().is_empty());
        },
    );
    assert!(compared > 7 * 25_000, "{compared}");
}

/// A push before the sensor that changes the torque by twelve of its deviations is found within
/// half a second. Nothing else tells of it: the torque, which is wrong, stays valid.
fn pushed(arm: &Arm, parameters: &Parameters) {
    const FROM: f64 = 12.0;
    let setup = arm.setup("estimator.toml", parameters);
    let push = "push:l_shoulder_3=12:0.02,0.05,-0.1:1,0,0@12..16";
    let log = arm.session(3, 18.0, &[push]);
    let mut truth = Simulation::new(&arm.robot, &settings(3, &[push])).unwrap();
    let (mut first, mut last, mut error) = (f64::INFINITY, 0.0, 0.0);
    each(setup.clone(), &log, |t, pipeline| {
        let torque = pipeline.last_estimate().torques.joints()[0];
        assert!(t < FROM || torque.valid == 1, "{t} {torque:?}");
        let (joints, candidates) = disagreement(&setup, pipeline.drives().unwrap());
        let is_on = joints.iter().any(|joint| joint == "l_shoulder_pitch");
        if first.is_infinite() && (is_on || t > FROM + 0.5) {
            first = t;
            let off = torque.torque - truth.at(t).joints[0].torque;
            error = off.abs() / torque.standard_deviation;
        }
        if joints.is_empty() {
            return;
        }
        last = t;
        assert!(t > FROM, "{t} {joints:?}");
        assert!(
            joints.iter().all(|own| own.starts_with("l_shoulder")),
            "{joints:?}"
        );
        let link = (Candidate::Contact, "l_shoulder_3".to_owned());
        assert!(candidates.contains(&link), "{t} {joints:?} {candidates:?}");
        let sensor = (Candidate::Sensor, SENSOR.to_owned());
        assert!(candidates.contains(&sensor), "{t} {candidates:?}");
    });
    let after = first - FROM;
    println!("an error of {error:.1} deviations is found after {after:.3} s");
    assert!(
        after < 0.5 && (10.0..12.5).contains(&error),
        "{after} {error}"
    );
    assert!((13.0..16.7).contains(&last), "{last}");
}

/// A drive that reports twice its current is a candidate, and its factor is told.
fn in_other_units(arm: &Arm, parameters: &Parameters) {
    let setup = arm.setup("estimator.toml", parameters);
    let log = multiplied(&arm.session(3, 12.0, &[]), "joint/l_elbow/current", 2.0);
    let (mut count, mut ratio) = (0, f64::NAN);
    each(setup.clone(), &log, |t, pipeline| {
        let said = pipeline.drives().unwrap();
        let (joints, candidates) = disagreement(&setup, said);
        // After the first seconds of motion.
        if t < 4.0 || joints.is_empty() {
            return;
        }
        assert_eq!(joints, ["l_elbow"], "{t}");
        let drive = (Candidate::Drive, "l_elbow".to_owned());
        assert!(candidates.contains(&drive), "{t} {candidates:?}");
        count += 1;
        ratio = said.drives()[3].ratio;
    });
    println!("in other units: {ratio:.2}");
    assert!(
        count > 4000 && (1.7..2.4).contains(&ratio),
        "{count} {ratio}"
    );
}

/// A sensor that was turned since: of several joints, it is the common cause.
fn turned(arm: &Arm, parameters: &Parameters) {
    let text = fs::read_to_string(arm.rig.path("touched.toml")).unwrap();
    let text = text.replace(
        "frame = \"child\"",
        "frame = \"sensor\"\nxyz_m = [0.0, 0.0, 0.0]\nrpy_rad = [0.0, 0.0, 0.5]",
    );
    fs::write(arm.rig.path("turned.toml"), text).unwrap();
    let setup = arm.setup("turned.toml", parameters);
    let log = arm.session(3, 20.0, &[]);
    let mut most = 0;
    each(setup.clone(), &log, |t, pipeline| {
        let (joints, candidates) = disagreement(&setup, pipeline.drives().unwrap());
        most = most.max(joints.len());
        let sensor = (Candidate::Sensor, SENSOR.to_owned());
        assert!(
            joints.is_empty() || candidates.contains(&sensor),
            "{t} {candidates:?}"
        );
    });
    assert!(most >= 2, "{most}");
}

/// A running system says so, too.
fn live(arm: &Arm) {
    let (rig, estimator) = (&arm.rig, arm.rig.path("estimator.toml"));
    let text = fs::read_to_string(&estimator).unwrap();
    let (first, rest) = text.split_once("\nmodel =").unwrap();
    let text = format!("{first}\nparameters = \"out/parameters.toml\"\nmodel ={rest}");
    fs::write(&estimator, text).unwrap();
    let folder = arm.path("");
    let push = "push:l_shoulder_3=60:0.02,0.05,-0.1:1,0,0@6..";
    let _simulator = rig.start(&[
        "simulate",
        "--robot",
        &folder,
        "--no-push",
        "--seed",
        "3",
        "--fault",
        push,
    ]);
    let _gateway = rig.start(&["gateway", "--config", &arm.path("gateway.toml")]);
    let _estimator = rig.start(&["estimator", "--config", &arm.path("estimator.toml")]);
    drop(open::<TorqueEstimate>(&rig.open(), "icub_left_arm"));
    let mut heard = Vec::new();
    let found = until(PATIENCE, || {
        let ran = rig.run(&["why", "l_shoulder_pitch"]);
        let said = String::from_utf8_lossy(&ran.stdout).into_owned();
        let line = said.lines().find(|line| line.contains("second opinion"));
        heard.extend(line.map(str::to_owned));
        heard
            .last()
            .is_some_and(|line| line.contains("a contact on l_shoulder_3"))
            .then_some(())
    });
    assert!(found.is_some(), "{heard:#?}");
    assert!(
        heard
            .iter()
            .any(|line| line.contains("within both deviations")),
        "{heard:#?}"
    );
}

/// A leg of the Open Dynamic Robot Initiative on a force/torque sensor in the ground, real: squats
/// of 23 s (`tests/data/hopper`). Its drives report torques.
#[test]
fn the_drive_of_a_real_leg_is_found() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/hopper");
    let config = Config::load(&folder.join("estimator.toml")).unwrap();
    let setup = Setup::new(&config).unwrap();
    let log: PathBuf = folder.join("squats.csv");
    let log = fs::read(log).unwrap();
    let rows = drive_rows(&setup, &log[..]).unwrap();
    let part = |joint: &str, from: f64, to: f64| {
        let rows = &rows[setup.robot.model.dof(joint).unwrap()];
        let part = rows.iter().copied();
        let part = part.filter(|row| (from..to).contains(&row.t.seconds()));
        drive::fit(joint, &[part.collect()])
    };
    // The hip bears no more than its friction.
    assert!(matches!(
        part("hip", 0.0, 24.0),
        Some(Err(Unfit::Unrelated))
    ));
    assert!(part("ankle", 0.0, 24.0).is_none(), "it has no drive");
    // Constants of two halves are equal within their deviations, and near one: the torque constant
    // of the motors is known to some 20 %.
    let halves = [(0.0, 12.0), (12.0, 24.0)];
    let halves = halves.map(|(from, to)| part("knee", from, to).unwrap().unwrap());
    let [first, second] = [0, 1].map(|half: usize| {
        let model: &DriveModel = &halves[half];
        println!(
            "knee, half {half}: constant {:.3} +- {:.3}, noise {:.3} Nm",
            model.parameters[0],
            model.deviations()[0],
            model.noise
        );
        (model.parameters[0], model.deviations()[0])
    });
    assert!((first.0 - second.0).abs() < 2.0 * first.1.hypot(second.1));
    assert!((0.8..1.2).contains(&first.0) && first.1 < 0.05);
    // Each half agrees with the other's drive.
    for (own, other) in [(&halves[0], 12.0..24.0), (&halves[1], 0.5..12.0)] {
        let mut setup = setup.clone();
        setup.drives = vec![own.clone()];
        let (mut count, mut covered) = (0.0, 0.0);
        run_on_log(setup, &log[..], |pipeline, _| {
            let t = pipeline.last_estimate().t.seconds();
            let said = pipeline.drives().unwrap().drives()[0];
            if other.contains(&t) {
                let torque = pipeline.last_estimate().torques.joints()[1];
                assert_eq!(said.agreement, Agreement::Agrees, "{t} {said:?}");
                let both = said.standard_deviation.hypot(torque.standard_deviation);
                count += 1.0;
                covered += f64::from((said.torque - torque.torque).abs() < 2.0 * both);
            }
            Ok(ControlFlow::Continue(()))
        })
        .unwrap();
        println!("within two deviations: {:.3}", covered / count);
        assert!(covered / count > 0.9, "{}", covered / count);
    }
}
