//! `proprio why` on planted causes, of a running system and of its recording: the first line names
//! the cause.
#![allow(missing_docs)]

use proprio_tests::watch::open;
use proprio_tests::{Arm, PATIENCE, Process, Rig, Written, until};
use proprio_topics::{Sample, TorqueEstimate};
use serde_json::Value as Json;
use std::time::Duration;
use toml::{Table, Value};

/// The arm at a slow pace. A contact at its hand is always present.
fn touched() -> Arm {
    Arm::slow()
        .patience(100.0, 40.0)
        .on_virtual(["sensors", "motors"])
}

/// The same without a contact.
fn arm() -> Arm {
    let mut arm = touched();
    let contacts = arm
        .estimator
        .get_mut("contact")
        .and_then(Value::as_array_mut);
    let is_hand = |contact: &Value| contact.get("name").and_then(Value::as_str) == Some("hand");
    contacts
        .expect("contacts")
        .retain(|contact| !is_hand(contact));
    arm
}

/// The same with on-line identification.
fn identifying() -> Arm {
    let mut arm = arm();
    let on = Table::from_iter([("enabled".to_owned(), true.into())]);
    arm.estimator.insert("identification".into(), on.into());
    arm
}

/// A running arm and its recorder; in the order in which they end.
struct System {
    recorder: Process,
    _estimator: Process,
    _gateway: Process,
    _simulator: Process,
    recording: String,
    rig: Rig,
}

impl System {
    /// `robot` is simulated, with these faults; gateway and estimator have the configuration `arm`.
    fn start(robot: &Arm, arm: &Arm, faults: &[String]) -> Self {
        let rig = Rig::new();
        let robot: Written = robot.write(&rig.path("robot"));
        let arm = arm.write(&rig.path("configured"));
        let mut arguments = vec!["simulate", "--robot", &robot.folder, "--no-push"];
        faults
            .iter()
            .for_each(|fault| arguments.extend(["--fault", fault.as_str()]));
        let simulator = rig.start(&arguments);
        let gateway = rig.start(&["gateway", "--config", &arm.gateway]);
        let estimator = rig.start(&["estimator", "--config", &arm.estimator]);
        let domain = rig.open();
        drop(open::<TorqueEstimate>(&domain, "icub_left_arm"));
        drop(open::<Sample>(&domain, "icub_left_arm"));
        let recording = rig.path("run.mcap").display().to_string();
        let (gateway_toml, estimator_toml) = (&arm.gateway, &arm.estimator);
        let recorder = rig.start(&[
            "record",
            "--out",
            &recording,
            "--config",
            gateway_toml,
            "--config",
            estimator_toml,
        ]);
        Self {
            recorder,
            _estimator: estimator,
            _gateway: gateway,
            _simulator: simulator,
            recording,
            rig,
        }
    }

    fn ask(&self, arguments: &[&str]) -> Json {
        let output = self.rig.run(&[&["why", "--json"], arguments].concat());
        serde_json::from_slice(&output.stdout).expect("JSON")
    }

    /// Waits until the first line about `joint` contains all of `words`.
    fn is_answered(&self, joint: &str, words: &[&str]) -> Json {
        let mut last = Json::Null;
        let found = until(PATIENCE, || {
            last = self.ask(&[joint]);
            let line = last["why"].as_str().expect("a first line");
            words.iter().all(|word| line.contains(word)).then_some(())
        });
        assert!(found.is_some(), "{words:?} are not in the answer: {last:#}");
        last
    }

    /// Ends the recorder; what its recording answers.
    fn ask_recording(&mut self, joint: &str, at: Option<f64>) -> Json {
        if self.recorder.ended().is_none() {
            self.recorder.end();
        }
        let at = at.map(|at| at.to_string());
        let mut arguments = vec![joint, "--samples", &self.recording];
        arguments.extend(at.iter().flat_map(|at| ["--at", at.as_str()]));
        self.ask(&arguments)
    }
}

fn assert_has(answer: &Json, words: &[&str]) {
    let line = answer["why"].as_str().expect("a first line");
    for word in words {
        assert!(
            line.contains(word),
            "{word:?} is not in the answer: {answer:#}"
        );
    }
}

/// The parts of the answer sum to the square of the deviation.
fn assert_sums(answer: &Json) {
    let budget = &answer["budget"];
    let parts = budget["parts"].as_array().expect("parts").iter();
    let sum: f64 = parts.filter_map(|part| part["variance"].as_f64()).sum();
    let deviation = budget["deviation"].as_f64().expect("a deviation");
    assert!(
        (sum / deviation.powi(2) - 1.0).abs() < 0.01,
        "{sum} {answer:#}"
    );
}

const FT: &str = "l_arm_ft_sensor";

/// What the arm is, what is configured, what fails, the joint, and words of its first line.
type Case<'a> = (Arm, Arm, &'a [String], &'a str, &'a [&'a str]);

/// Each case at once: live, then from its recording, at an instant that is so much later \[s\].
/// There identification begins with the recorder, and has seen less.
fn assert_named(cases: &[Case<'_>], later: f64) {
    std::thread::scope(|scope| {
        for (robot, arm, faults, joint, words) in cases {
            scope.spawn(move || {
                let mut system = System::start(robot, arm, faults);
                let live = system.is_answered(joint, words);
                std::thread::sleep(Duration::from_secs_f64(later + 0.5));
                let at = live["t"].as_f64().map(|t| t + later);
                let recorded = system.ask_recording(joint, at);
                assert_has(&recorded, words);
                for answer in [live, recorded] {
                    if answer["budget"]["deviation"].is_number() {
                        assert_sums(&answer);
                    }
                }
            });
        }
    });
}

#[test]
fn boards_buses_saturation_and_contacts_are_named() {
    let motors = [
        "shoulder_pitch",
        "shoulder_roll",
        "shoulder_yaw",
        "elbow",
        "wrist_prosup",
        "wrist_pitch",
        "wrist_yaw",
    ];
    let all_motors: Vec<String> = motors
        .iter()
        .map(|motor| format!("silent:l_{motor}_motor@4.."))
        .collect();
    let board = [format!("silent:{FT}@4..")];
    let saturation = [format!("saturate:{FT}@4..")];
    let push = ["push:l_forearm=40@4..".to_owned()];
    // What is late is only seen by who knows the masses.
    let late = [format!("late:{FT}=0.5@4..")];
    let mut exact = arm();
    let known = Table::from_iter([("urdf_relative_std".to_owned(), 0.01.into())]);
    exact
        .estimator
        .insert("identification".into(), known.into());
    assert_named(
        &[
            (
                touched(),
                touched(),
                &board,
                "l_elbow",
                &["board l_arm_ft_sensor on bus left_arm is silent"],
            ),
            (
                arm(),
                arm(),
                &all_motors,
                "l_wrist_yaw",
                &["all 7 boards of bus left_arm_motors are silent"],
            ),
            (
                touched(),
                touched(),
                &saturation,
                "l_elbow",
                &["l_arm_ft_sensor is saturated"],
            ),
            (
                arm(),
                arm(),
                &push,
                "l_elbow",
                &["undeclared contact", "on the links from l_upper_arm on"],
            ),
            (
                arm(),
                exact,
                &late,
                "l_elbow",
                &["F/T readings that are late"],
            ),
        ],
        0.0,
    );
}

/// What has ended is found in the recording, without an instant.
#[test]
fn an_outage_that_is_over_is_named() {
    let motors = ["shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"];
    let motors = motors
        .iter()
        .chain(&["wrist_prosup", "wrist_pitch", "wrist_yaw"]);
    let bus: Vec<String> = motors
        .map(|motor| format!("silent:l_{motor}_motor@4..7"))
        .collect();
    let board = [format!("silent:{FT}@4..7")];
    let cases: [(&[String], &str, &str); 2] = [
        (
            &bus,
            "l_wrist_yaw",
            "all 7 boards of bus left_arm_motors are silent",
        ),
        (
            &board,
            "l_elbow",
            "board l_arm_ft_sensor on bus left_arm is silent",
        ),
    ];
    std::thread::scope(|scope| {
        for (faults, joint, words) in cases {
            scope.spawn(move || {
                let mut system = System::start(&touched(), &touched(), faults);
                std::thread::sleep(Duration::from_secs(8));
                system.is_answered(joint, &["is valid"]);
                std::thread::sleep(Duration::from_millis(500));
                assert_has(&system.ask_recording(joint, None), &[words]);
            });
        }
    });
}

#[test]
fn what_is_not_configured_well_is_named() {
    let mut tight = touched();
    let output = tight
        .estimator
        .get_mut("output")
        .and_then(Value::as_table_mut);
    let bound = ("max_torque_std_nm".to_owned(), 0.01.into());
    output.expect("a table").extend([bound]);
    let mut unknown = touched();
    let sensors = unknown
        .estimator
        .get_mut("force_torque")
        .and_then(Value::as_array_mut);
    for sensor in sensors.expect("sensors") {
        let sensor = sensor.as_table_mut().expect("a table");
        sensor.remove("offset_n");
        sensor.remove("offset_nm");
    }
    assert_named(
        &[
            (
                touched(),
                tight,
                &[],
                "l_elbow",
                &["exceeds the bound of 0.0100 Nm", "output.max_torque_std_nm"],
            ),
            (
                touched(),
                unknown,
                &[],
                "l_elbow",
                &[
                    "exceeds the bound",
                    "100 % of the variance is the offset of l_arm_ft_sensor",
                ],
            ),
        ],
        0.0,
    );
}

#[test]
fn what_contradicts_the_configuration_is_named() {
    let reverse = |device: &mut Table| {
        let joints = device.get_mut("joint").and_then(Value::as_array_mut)?;
        let joint = joints.first_mut()?.as_table_mut()?;
        (joint.get("name")?.as_str()? == "l_elbow")
            .then(|| joint.insert("sign".into(), (-1).into()))
    };
    let reversed = identifying().each_device(|_, device| {
        let _ = reverse(device);
    });
    let mut sideways = identifying();
    let base: Table = "kind = \"fixed\"\nlink = \"chest\"\ngravity_mps2 = [0.0, 9.80665, 0.0]"
        .parse()
        .expect("TOML");
    sideways.estimator.insert("base".into(), base.into());
    let mut uncertain = identifying();
    let bound = ("max_torque_std_nm".to_owned(), 0.01.into());
    let output = uncertain.estimator.get_mut("output");
    let output = output.and_then(Value::as_table_mut);
    output.expect("a table").extend([bound]);
    let still = ["still:l_elbow".to_owned()];
    assert_named(
        &[
            (
                arm(),
                reversed,
                &[],
                "l_elbow",
                &["the encoder of l_elbow is reversed"],
            ),
            (
                arm(),
                sideways,
                &[],
                "l_elbow",
                &["gravity has another direction"],
            ),
            (
                arm(),
                uncertain,
                &still,
                "l_elbow",
                &["l_elbow has hardly moved"],
            ),
        ],
        8.0,
    );
}

#[test]
fn what_is_asked_wrongly_is_answered() {
    let rig = Rig::new();
    let fails = |arguments: &[&str]| {
        let output = rig.command(arguments).output().expect("it runs");
        assert!(!output.status.success(), "{arguments:?}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let text = fails(&["why", "l_elbow"]);
    assert!(text.contains("no gateway or estimator runs"), "{text}");
    assert!(fails(&["why", "l_elbow", "--config", "x"]).contains("--samples"));
    let arm = arm().write(&rig.path("robot"));
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let _estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    drop(open::<TorqueEstimate>(&rig.open(), "icub_left_arm"));
    assert!(
        fails(&["why", "l_elbo"]).contains("l_elbow"),
        "the nearest name"
    );
    // No board: there are no estimates.
    let answer = rig.run(&["why", "l_elbow"]);
    let text = String::from_utf8_lossy(&answer.stdout);
    assert!(
        text.starts_with("l_elbow has no torque: all 2 boards of bus left_arm are silent\n"),
        "{text}"
    );
    // Without the gateway.
    gateway.end();
    let answer = rig.run(&["why", "l_elbow"]);
    let text = String::from_utf8_lossy(&answer.stdout);
    assert!(
        text.starts_with("l_elbow has no torque: the gateway "),
        "{text}"
    );
}
