//! `proprio identify` from the user's side: error messages for arguments and logs; output files,
//! complete or absent; the accuracy of the result, on a simulated arm with a wrong CAD and on
//! recorded robots; and the report in a browser.

use proprio_gateway::offline;
use proprio_gateway::plan::Plan;
use proprio_simulator::record::record;
use proprio_simulator::{SimulatedRobot, SimulationSettings};
use proprio_tests::{Rig, browse};
use proprio_topics::Nanos;
use proprio_topics::csv::Columns;
use serde_json::Value as Json;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

const FILES: [&str; 4] = [
    "identified.urdf",
    "parameters.toml",
    "report.html",
    "summary.json",
];
const THREE: [&str; 3] = ["cad", "cad_fitted", "identified"];

/// A folder with a configuration in it.
struct Place(Rig);

impl Place {
    /// A configuration of the simulated arm in which only the F/T sensor's noise separates it from
    /// the truth: the hand is touched only if declared.
    fn arm() -> Self {
        let this = Self(Rig::new());
        let robot = SimulatedRobot::find("icub_left_arm").expect("the robot of this repository");
        fs::copy(robot.join("model.urdf"), this.path("model.urdf")).unwrap();
        let config = fs::read_to_string(robot.join("estimator.toml")).unwrap();
        let hand = "link = \"l_hand\"";
        assert!(config.contains(hand));
        this.write("always.toml", &config);
        this.write(
            "estimator.toml",
            &config.replace(hand, &format!("{hand}\npresence = \"possible\"")),
        );
        this
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path(name)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    fn run(&self, arguments: &[&str]) -> Output {
        let mut command = self.0.command(arguments);
        command.current_dir(self.path(""));
        command.output().unwrap()
    }

    /// Runs `proprio identify` with these arguments and `--out out`; returns its standard error.
    fn identify(&self, code: i32, arguments: &[&str]) -> String {
        let ran = self.run(&[&["identify", "--out", "out"], arguments].concat());
        let said = String::from_utf8_lossy(&ran.stderr).into_owned();
        assert_eq!(ran.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(!said.contains("panicked"), "{said}");
        let errors = said
            .lines()
            .filter(|line| line.starts_with("error: "))
            .count();
        assert_eq!(errors, usize::from(code != 0), "{said}");
        said
    }

    fn summary(&self) -> Json {
        serde_json::from_str(&self.read("out/summary.json")).expect("JSON")
    }

    /// Everything in the result's folder.
    fn results(&self) -> BTreeSet<String> {
        match fs::read_dir(self.path("out")) {
            Ok(folder) => folder
                .flatten()
                .map(|e| e.file_name().to_string_lossy().into_owned())
                .collect(),
            Err(_) => BTreeSet::new(),
        }
    }

    /// A recorded session of the simulated arm as a table of samples.
    fn session(&self, name: &str, seconds: f64, settings: &SimulationSettings) {
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        let mut log = Vec::new();
        record(
            &robot,
            settings,
            seconds,
            Nanos::from_millis(100_000),
            &mut log,
        )
        .unwrap();
        let plan = Plan::load(
            &SimulatedRobot::find("icub_left_arm")
                .unwrap()
                .join("gateway.toml"),
        )
        .unwrap();
        let mut table = Vec::new();
        offline::decode(&plan, &log[..], &mut table, Columns::Main).unwrap();
        self.write(name, &String::from_utf8(table).unwrap());
    }
}

fn free(seed: u64) -> SimulationSettings {
    SimulationSettings {
        seed,
        push: false,
        ..SimulationSettings::default()
    }
}

/// A table with all numbers of the columns with this prefix multiplied.
fn change_all(table: &str, columns: &str, by: f64) -> String {
    let mut rows = table.lines();
    let header = rows.next().expect("a header");
    let places: Vec<bool> = header
        .split(',')
        .map(|name| name.starts_with(columns))
        .collect();
    let row = |row: &str| {
        let cells = row
            .split(',')
            .zip(&places)
            .map(|(cell, is_one)| match cell.parse::<f64>() {
                Ok(value) if *is_one => (by * value).to_string(),
                _ => cell.to_owned(),
            });
        cells.collect::<Vec<_>>().join(",") + "\n"
    };
    header.to_owned() + "\n" + &rows.map(row).collect::<String>()
}

/// The URDF with masses and moments of inertia beyond the sensor multiplied by `factor`.
fn heavier(urdf: &str, links: &[&str], factor: f64) -> String {
    let mut text = String::new();
    let mut inside = false;
    for line in urdf.lines() {
        if line.contains("<link ") {
            inside = links
                .iter()
                .any(|link| line.contains(&format!("name=\"{link}\"")));
        }
        let mut line = line.to_owned();
        if inside && (line.contains("<mass ") || line.contains("<inertia ")) {
            let parts: Vec<&str> = line.split('"').collect();
            // Every second part is an attribute's value.
            let scaled: Vec<String> = parts
                .iter()
                .enumerate()
                .map(|(i, part)| match (i % 2, part.parse::<f64>()) {
                    (1, Ok(value)) => format!("{:e}", value * factor),
                    _ => (*part).to_owned(),
                })
                .collect();
            line = scaled.join("\"");
        }
        text.push_str(&line);
        text.push('\n');
    }
    assert_ne!(text, urdf, "nothing was made heavier");
    text
}

fn number(json: &Json, path: &[&str]) -> f64 {
    let found = path.iter().fold(json, |json, key| &json[*key]);
    found
        .as_f64()
        .unwrap_or_else(|| panic!("{path:?} is {found}"))
}

/// Asserts the structure that programs depend on.
fn check_shape(summary: &Json, logs: &[(&str, &str)]) {
    let entries = summary["logs"].as_array().expect("a list of logs");
    assert_eq!(entries.len(), logs.len());
    let three = |json: &Json, numbers: usize, what: &str| {
        for key in THREE {
            let value = json
                .get(key)
                .unwrap_or_else(|| panic!("{what} has no {key}: {json}"));
            match numbers {
                1 => assert!(
                    value.is_f64() || value.is_null() || value.is_u64(),
                    "{what} {key}: {value}"
                ),
                n => assert_eq!(
                    value.as_array().map(Vec::len),
                    Some(n),
                    "{what} {key}: {value}"
                ),
            }
        }
        assert_eq!(
            json.as_object().map(serde_json::Map::len),
            Some(3),
            "{what}: {json}"
        );
    };
    for (entry, (file, role)) in entries.iter().zip(logs) {
        assert_eq!(
            (entry["file"].as_str(), entry["role"].as_str()),
            (Some(*file), Some(*role))
        );
        for (name, joint) in entry["joints"].as_object().expect("joints by name") {
            three(&joint["rms_nm"], 1, name);
        }
        for (name, sensor) in entry["sensors"].as_object().expect("sensors by name") {
            three(&sensor["rms"], 6, name);
            assert_eq!(
                sensor["coverage"].as_array().map(Vec::len),
                Some(6),
                "{name}: {sensor}"
            );
        }
        for key in ["two_route_rms_nm", "two_route_rms_mean_removed_nm"] {
            for (joint, torque) in entry[key].as_object().expect("joints by name") {
                three(torque, 1, joint);
            }
        }
    }
    assert!(
        matches!(
            summary["verdict"].as_str(),
            Some("identified" | "no_better_than_cad" | "nothing")
        ),
        "{}",
        summary["verdict"]
    );
    for key in [
        "weakest",
        "not_separable",
        "time_offsets",
        "findings",
        "links",
    ] {
        assert!(summary[key].is_array(), "{key}: {}", summary[key]);
    }
    for key in ["tau", "rank", "condition"] {
        assert!(
            summary
                .get(key)
                .is_some_and(|v| v.is_number() || v.is_null()),
            "{key}"
        );
    }
}

// ---------------------------------------------------------------- what is wrong, in words

#[test]
fn wrong_arguments_and_configurations_end_with_2_and_touch_nothing() {
    let place = Place::arm();
    place.session("walk.csv", 3.0, &free(1));
    fs::create_dir(place.path("out")).unwrap();
    place.write("out/parameters.toml", "of an earlier run");

    let config = place.read("estimator.toml");
    place.write("misspelt.toml", &config.replace("noise_nm", "niose_nm"));
    let said = place.identify(2, &["--config", "misspelt.toml", "--log", "walk.csv"]);
    assert!(
        said.contains("misspelt.toml") && said.contains("niose_nm"),
        "{said}"
    );

    let said = place.identify(2, &["--config", "none.toml", "--log", "walk.csv"]);
    assert!(said.contains("none.toml: cannot be read"), "{said}");

    // A renamed column means that the joint is not in the log.
    place.write(
        "short.csv",
        &place
            .read("walk.csv")
            .replace("joint/l_elbow/", "joint/r_elbow/")
            .replace("l_elbow/quality", "r_elbow/quality"),
    );
    let said = place.identify(
        2,
        &[
            "--config",
            "estimator.toml",
            "--log",
            "walk.csv",
            "--validate",
            "short.csv",
        ],
    );
    assert!(
        said.contains("short.csv")
            && said.contains("no column for joint/l_elbow")
            && said.contains("[locked]"),
        "{said}"
    );

    let said = place.identify(2, &["--config", "estimator.toml"]);
    assert!(said.contains("--samples <FILE>"), "{said}");
    let said = place.identify(
        2,
        &[
            "--config",
            "estimator.toml",
            "--log",
            "walk.csv",
            "--valdate",
            "x",
        ],
    );
    assert!(said.contains("--validate"), "{said}");

    let said = place.identify(
        1,
        &[
            "--config",
            "estimator.toml",
            "--log",
            "walk.csv",
            "--log",
            "gone.csv",
        ],
    );
    assert!(said.contains("gone.csv: cannot be read"), "{said}");
    assert_eq!(
        place.results(),
        BTreeSet::from(["parameters.toml".to_owned()])
    );
    assert_eq!(place.read("out/parameters.toml"), "of an earlier run");

    place.write("file", "");
    let ran = place.run(&[
        "identify",
        "--config",
        "estimator.toml",
        "--log",
        "walk.csv",
        "--out",
        "file",
    ]);
    let said = String::from_utf8_lossy(&ran.stderr);
    assert!(
        ran.status.code() == Some(1) && said.contains("file: cannot be created"),
        "{said}"
    );
}

#[test]
fn nothing_to_identify_is_a_verdict_and_leaves_no_parameters() {
    let place = Place::arm();
    place.session(
        "still.csv",
        4.0,
        &SimulationSettings {
            still: 100.0,
            ..free(2)
        },
    );
    place.session("moving.csv", 6.0, &free(2));
    for (config, log) in [
        ("estimator.toml", "still.csv"),
        ("always.toml", "moving.csv"),
    ] {
        fs::create_dir_all(place.path("out")).unwrap();
        for name in FILES {
            place.write(&format!("out/{name}"), "of an earlier run");
        }
        let said = place.identify(1, &["--config", config, "--log", log]);
        assert!(said.contains("error: nothing was identified: "), "{said}");
        assert_eq!(
            place.results(),
            BTreeSet::from(["report.html", "summary.json"].map(str::to_owned)),
            "{config}"
        );
        let summary = place.summary();
        check_shape(&summary, &[(log, "train")]);
        assert_eq!(summary["verdict"], "nothing");
        assert_eq!(summary["advice"]["grade"], "reject");
        let reason = summary["reason"].as_str().expect("a reason in words");
        assert!(
            reason.len() > 10 && said.contains(reason.trim_end_matches('.')),
            "{reason}: {said}"
        );
        assert!(
            place
                .read("out/report.html")
                .contains("Nothing was identified")
        );
    }
    browse(&place.path("out/report.html"));
}

// ---------------------------------------------------------------- a simulated arm

#[test]
fn a_wrong_cad_is_put_right_from_logs_of_the_simulated_arm() {
    let place = Place::arm();
    let beyond = ["l_elbow_1", "l_forearm", "l_wrist_1", "l_hand"];
    place.write(
        "model.urdf",
        &heavier(&place.read("model.urdf"), &beyond, 1.25),
    );
    for (name, seed) in [("one.csv", 1), ("two.csv", 2), ("three.csv", 3)] {
        place.session(name, 12.0, &free(seed));
    }
    let arguments = [
        "--config",
        "estimator.toml",
        "--log",
        "one.csv",
        "--log",
        "two.csv",
        "--validate",
        "three.csv",
    ];
    place.identify(0, &arguments);
    assert_eq!(place.results(), FILES.map(str::to_owned).into());
    let summary = place.summary();
    check_shape(
        &summary,
        &[
            ("one.csv", "train"),
            ("two.csv", "train"),
            ("three.csv", "validate"),
        ],
    );
    assert_eq!(summary["verdict"], "identified");
    let validated = &summary["logs"][2];
    let [fitted, identified] =
        ["cad", "identified"].map(|key| number(validated, &["predicted", "relative_error", key]));
    assert!(identified < fitted / 3.0, "{identified} against {fitted}");
    let report = place.read("out/report.html");
    assert!(report.len() < 2_000_000 && report.contains("three.csv"));
    for from_elsewhere in ["src=\"http", "href=\"http", "<script", "@import", "url("] {
        assert!(!report.contains(from_elsewhere), "{from_elsewhere}");
    }
    browse(&place.path("out/report.html"));

    // The hand carries nothing, neither beside the parameters nor beside a log.
    let payload = |link: &str, more: &[&str]| {
        let base = [
            "identify",
            "--config",
            "estimator.toml",
            "--samples",
            "three.csv",
        ];
        let ran = place.run(&[&base[..], &["--json", "--payload", link], more].concat());
        let said = String::from_utf8_lossy(&ran.stderr).into_owned();
        (ran.status.code(), ran.stdout, said)
    };
    for reference in ["out/parameters.toml", "one.csv"] {
        let (code, found, said) = payload("l_hand", &["--reference", reference]);
        assert_eq!(code, Some(0), "{said}");
        let found: Json = serde_json::from_slice(&found).expect("JSON");
        assert_eq!(found["is_significant"], false, "{found}");
        assert!(number(&found, &["mass_std_kg"]) < 0.05, "{found}");
    }
    let (code, _, said) = payload("l_hnd", &["--reference", "one.csv"]);
    assert!(
        code == Some(2) && said.contains("did you mean \"l_hand\""),
        "{said}"
    );
    let (code, _, said) = payload("l_hand", &[]);
    assert!(code == Some(2) && said.contains("--reference"), "{said}");

    // The output is readable: by the next program, and instead of the URDF.
    let estimate = |more: &[&str]| {
        let base = [
            "estimate",
            "--config",
            "estimator.toml",
            "--log",
            "three.csv",
            "--out",
        ];
        let ran = place.run(&[&base[..], more].concat());
        assert!(
            ran.status.success(),
            "{}",
            String::from_utf8_lossy(&ran.stderr)
        );
        [ran.stdout, ran.stderr].map(|bytes| String::from_utf8(bytes).unwrap())
    };
    estimate(&["cad.csv"]);
    let with = ["identified.csv", "--parameters", "out/parameters.toml"];
    estimate(&with);
    let plain = place.read("identified.csv");
    // The assessment equals that of the identification.
    let [printed, _] = estimate(&[&with[..], &["--assess", "--json"]].concat());
    assert_eq!(
        place.read("identified.csv"),
        plain,
        "figures change no estimate"
    );
    let assessment = &serde_json::from_str::<Json>(&printed).unwrap()["assessment"];
    for set in ["cad", "identified"] {
        let rms = |of: &Json| {
            of["predicted"]["sensors_rms"]["l_arm_ft_sensor"][set]
                .as_array()
                .unwrap()
                .clone()
        };
        for (own, other) in rms(assessment).iter().zip(rms(validated)) {
            let [own, other] = [own, &other].map(|x| x.as_f64().unwrap());
            assert!((own / other - 1.0).abs() < 1e-6, "{own} {other}");
        }
    }
    let [_, told] = estimate(&[&with[..], &["--assess"]].concat());
    for what in [
        "F/T prediction error: ",
        "residual of the sub-tree at l_upper_arm: ",
    ] {
        assert!(told.contains(what), "{told}");
    }
    assert_ne!(place.read("cad.csv"), place.read("identified.csv"));
    let config = place.read("estimator.toml");
    place.write(
        "identified.toml",
        &config.replace("model = \"model.urdf\"", "model = \"out/identified.urdf\""),
    );
    let ran = place.run(&["estimator", "--config", "identified.toml", "--check"]);
    assert!(
        ran.status.success(),
        "{}",
        String::from_utf8_lossy(&ran.stderr)
    );

    // Implausible channels are also reported for a log that is only used for estimation.
    let turned = change_all(&place.read("three.csv"), "wrench/", -1.0);
    place.write("turned.csv", &turned);
    let args = [
        "estimate",
        "--config",
        "estimator.toml",
        "--log",
        "turned.csv",
        "--out",
        "t.csv",
    ];
    let text = String::from_utf8(place.run(&args).stderr).unwrap();
    assert!(
        text.contains(
            "warning: turned.csv: wrench/l_arm_ft_sensor fits only with the opposite sign"
        ),
        "{text}"
    );

    // A second run gives the same result, and --json prints the contents of the file.
    let before = place.read("out/summary.json");
    let ran = place.run(&[&["identify", "--out", "out", "--json"], &arguments[..]].concat());
    assert_eq!(ran.status.code(), Some(0));
    let printed: Json = serde_json::from_slice(&ran.stdout).expect("JSON alone on standard output");
    assert_eq!(printed, serde_json::from_str::<Json>(&before).unwrap());
    assert_eq!(before, place.read("out/summary.json"));
    // The next run does not start from identified parameters named in the configuration.
    place.write(
        "named.toml",
        &config.replace(
            "model = \"model.urdf\"",
            "model = \"model.urdf\"\nparameters = \"out/parameters.toml\"",
        ),
    );
    place.identify(0, &[&["--config", "named.toml"], &arguments[2..]].concat());
    assert_eq!(before, place.read("out/summary.json"));
}

// ---------------------------------------------------------------- recorded robots

/// The folder of recorded logs, if it is at hand.
fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("PROPRIO_DATA").map(PathBuf::from);
    if folder.is_none() {
        println!("skipped: PROPRIO_DATA (recorded logs) is not set");
    }
    folder
}

#[test]
fn an_arm_with_joint_torque_sensors() {
    let Some(data) = data() else { return };
    let place = Place(Rig::new());
    let config = format!(
        "schema = 1\nrobot = \"kuka_lwr4\"\nmodel = {:?}\n[base]\nkind = \"fixed\"\n\
         link = \"box\"\ngravity_mps2 = [0.0, 0.0, -9.80665]\n\
         [input]\nmax_silence_ms = 100.0\n[identification]\ninputs = [\"torque\"]\n",
        data.join("kuka_lwr4.urdf")
    );
    place.write("estimator.toml", &config);
    let (one, two) = (data.join("kuka_lwr4_1.csv"), data.join("kuka_lwr4_2.csv"));
    let (one, two) = (one.to_str().unwrap(), two.to_str().unwrap());
    for (train, validate) in [(one, two), (two, one)] {
        place.identify(
            0,
            &[
                "--config",
                "estimator.toml",
                "--log",
                train,
                "--validate",
                validate,
            ],
        );
        let summary = place.summary();
        let name = |file: &str| file.rsplit('/').next().unwrap().to_owned();
        check_shape(
            &summary,
            &[(&name(train), "train"), (&name(validate), "validate")],
        );
        let error = |key| number(&summary["logs"][1], &["predicted", "relative_error", key]);
        println!(
            "{train} to {validate}: {} with the CAD, {} identified",
            error("cad"),
            error("identified")
        );
        assert!(error("identified") < 0.025, "{}", error("identified"));
        assert_eq!(summary["logs"][1]["joints"].as_object().unwrap().len(), 7);
        assert!(number(&summary, &["tau"]) <= 1.0);
    }
    browse(&place.path("out/report.html"));
}

#[test]
fn a_leg_between_two_sensors() {
    let (Some(data), Some(models)) = (
        data(),
        std::env::var_os("PROPRIO_ICUB_MODELS").map(PathBuf::from),
    ) else {
        return println!("skipped: PROPRIO_ICUB_MODELS (robots of icub-models) is not set");
    };
    let place = Place(Rig::new());
    let config =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("real_leg/estimator.toml"))
            .unwrap();
    // The right leg swings: nothing touches it.
    let [start, end] = ["[[contact]]\nname = \"right_leg\"", "# Stamps jitter"]
        .map(|text| config.find(text).expect("as in the file"));
    let config = format!("{}{}", &config[..start], &config[end..]);
    let model = models.join("iCubGenova02.urdf");
    place.write(
        "estimator.toml",
        &config.replace("\"model.urdf\"", &format!("{model:?}")),
    );
    // Trained on the first half, tested on the second.
    let log = fs::read_to_string(data.join("icub_leg_24_44s.csv")).unwrap();
    let (header, rows) = log.split_once('\n').unwrap();
    let rows: Vec<&str> = rows.lines().collect();
    let (first, second) = rows.split_at(rows.len() / 2);
    place.write("first.csv", &format!("{header}\n{}\n", first.join("\n")));
    place.write("second.csv", &format!("{header}\n{}\n", second.join("\n")));
    place.identify(
        0,
        &[
            "--config",
            "estimator.toml",
            "--log",
            "first.csv",
            "--validate",
            "second.csv",
        ],
    );
    let summary = place.summary();
    check_shape(
        &summary,
        &[("first.csv", "train"), ("second.csv", "validate")],
    );
    let routes = &summary["logs"][1]["two_route_rms_nm"];
    println!("{routes}");
    // The estimator's own tests check their size; here they must be better than with the CAD.
    let total = |key: &str| {
        let joints = ["r_hip_yaw", "r_knee", "r_ankle_pitch", "r_ankle_roll"];
        let squares = joints.map(|joint| number(routes, &[joint, key]).powi(2));
        squares.iter().sum::<f64>().sqrt()
    };
    let [fitted, identified] = ["cad_fitted", "identified"].map(total);
    assert!(
        identified < 0.75 * fitted,
        "{identified}, with the CAD {fitted}"
    );
    browse(&place.path("out/report.html"));
}
