//! The `proprio` command from the user's side: help, exit codes, one clear message per error,
//! output files that are complete or absent, and the demonstration.

use nix::sys::statfs::{TMPFS_MAGIC, statfs};
use proprio_dynamics::model::Model;
use proprio_gateway::offline;
use proprio_simulator::record::record;
use proprio_simulator::{SimulatedRobot, Simulation, SimulationSettings};
use proprio_tests::{PATIENCE, Process, Rig, browse, until};
use proprio_topics::{Nanos, Quality};
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::{fs, thread};

const VERBS: [&str; 9] = [
    "demo",
    "gateway",
    "estimator",
    "simulate",
    "decode",
    "encode",
    "estimate",
    "identify",
    "doctor",
];

// ---------------------------------------------------------------- running it

/// The result of a run.
struct Ran {
    code: Option<i32>,
    out: String,
    err: String,
    what: String,
}

impl Ran {
    /// Asserts success.
    fn good(self) -> Self {
        assert_eq!(self.code, Some(0), "{}: {}", self.what, self.err);
        self
    }

    /// Asserts that it failed with `code` and one message on one line that contains all of `parts`,
    /// has no repetition and shows no internals of the program.
    fn fails(&self, code: i32, parts: &[&str]) {
        let Self { what, err, .. } = self;
        assert_eq!(self.code, Some(code), "{what}: {err}");
        let messages: Vec<&str> = err.lines().filter(|l| l.starts_with("error: ")).collect();
        let [message] = messages[..] else {
            panic!("{what}: not one message: {err}")
        };
        for part in parts {
            assert!(
                err.contains(part),
                "{what}: the message lacks {part:?}: {err}"
            );
        }
        let mut said = BTreeSet::new();
        for phrase in message.split(": ").filter(|p| p.len() > 12) {
            assert!(
                said.insert(phrase),
                "{what}: the message repeats {phrase:?}: {message}"
            );
        }
        for inside in [
            "panicked",
            "RUST_BACKTRACE",
            "Os {",
            "Err(",
            "Some(",
            ".tmp",
        ] {
            assert!(
                !err.contains(inside),
                "{what}: the message contains {inside:?}: {err}"
            );
        }
    }

    fn json(&self) -> Json {
        serde_json::from_str(self.out.trim())
            .unwrap_or_else(|e| panic!("{}: {e}: {}", self.what, self.out))
    }
}

/// A folder with a copy of the robot's configuration, with a separate shared-memory domain.
struct Place {
    rig: Rig,
}

impl Place {
    fn new() -> Self {
        let this = Self { rig: Rig::new() };
        let robot = SimulatedRobot::find("icub_left_arm").expect("the robot of this repository");
        for name in ["gateway.toml", "estimator.toml", "model.urdf"] {
            this.write(name, &fs::read_to_string(robot.join(name)).unwrap());
        }
        this
    }

    fn path(&self, name: &str) -> PathBuf {
        self.rig.path(name)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    /// Writes `to`: the file `from` with each pair's first text replaced by its second.
    fn change(&self, from: &str, to: &str, pairs: &[(&str, &str)]) {
        let mut text = self.read(from);
        for (old, new) in pairs {
            assert!(text.contains(old), "{from} has no {old:?}");
            text = text.replacen(old, new, 1);
        }
        self.write(to, &text);
    }

    fn exists(&self, name: &str) -> bool {
        self.path(name).exists()
    }

    /// Everything in the folder, temporary files included.
    fn names(&self) -> BTreeSet<String> {
        fs::read_dir(self.path(""))
            .unwrap()
            .flatten()
            .map(|e| e.file_name().to_string_lossy().into_owned())
            .collect()
    }

    /// `proprio` in this folder and its domain; a run's own temporary files go to its folder `tmp`.
    fn command(&self, args: &[&str]) -> Command {
        let mut command = self.rig.command(args);
        fs::create_dir_all(self.path("tmp")).unwrap();
        command
            .current_dir(self.path(""))
            .env("TMPDIR", self.path("tmp"));
        command
    }

    /// Runs `proprio` until it ends.
    fn run(&self, args: &[&str]) -> Ran {
        finish(self.command(args), b"", &args.join(" "))
    }

    /// Runs `proprio` until it ends, with `input` as its standard input.
    fn run_with(&self, args: &[&str], input: &[u8]) -> Ran {
        finish(self.command(args), input, &args.join(" "))
    }

    fn start(&self, args: &[&str]) -> Process {
        self.rig.spawn(self.command(args), args[0])
    }
}

fn finish(mut command: Command, input: &[u8], what: &str) -> Ran {
    command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().unwrap_or_else(|e| panic!("{what}: {e}"));
    let (mut stdin, mut stdout, mut stderr) = (
        child.stdin.take().unwrap(),
        child.stdout.take().unwrap(),
        child.stderr.take().unwrap(),
    );
    thread::scope(|scope| {
        // A program that ends early does not read it all.
        scope.spawn(move || drop(stdin.write_all(input)));
        let out = scope.spawn(move || {
            let mut bytes = Vec::new();
            let _ = stdout.read_to_end(&mut bytes);
            String::from_utf8_lossy(&bytes).into_owned()
        });
        let err = scope.spawn(move || {
            let mut bytes = Vec::new();
            let _ = stderr.read_to_end(&mut bytes);
            String::from_utf8_lossy(&bytes).into_owned()
        });
        let status = until(PATIENCE + PATIENCE, || child.try_wait().unwrap());
        if status.is_none() {
            let _ = child.kill();
            let _ = child.wait();
        }
        let (out, err) = (out.join().unwrap(), err.join().unwrap());
        let Some(status) = status else {
            panic!("{what}: it does not end: {err}")
        };
        Ran {
            code: status.code(),
            out,
            err,
            what: what.to_owned(),
        }
    })
}

/// A table of numbers by column; an empty cell is NaN.
fn table(text: &str) -> BTreeMap<String, Vec<f64>> {
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let mut columns: BTreeMap<String, Vec<f64>> =
        names.iter().map(|n| ((*n).to_owned(), vec![])).collect();
    for line in lines {
        let cells: Vec<&str> = line.split(',').collect();
        assert_eq!(cells.len(), names.len(), "{line}");
        for (name, cell) in names.iter().zip(cells) {
            let value = cell.parse().unwrap_or_else(|_| {
                if cell.is_empty() || name.contains("reason") {
                    f64::NAN
                } else {
                    panic!("{cell}")
                }
            });
            columns.get_mut(*name).unwrap().push(value);
        }
    }
    columns
}

/// Asserts that two long texts are equal; prints the first line that differs.
fn assert_same(one: &str, other: &str, what: &str) {
    if one != other {
        let at = one
            .lines()
            .zip(other.lines())
            .position(|(a, b)| a != b)
            .unwrap_or(one.lines().count().min(other.lines().count()));
        let line = |text: &str| text.lines().nth(at).unwrap_or("(the end)").to_owned();
        panic!(
            "{what}: line {} is\n{}\nand\n{}",
            at + 1,
            line(one),
            line(other)
        );
    }
}

fn oracle(name: &str) -> String {
    let file = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("oracle")
        .join(name);
    fs::read_to_string(&file).unwrap_or_else(|e| panic!("{}: {e}", file.display()))
}

const T0: Nanos = Nanos::from_millis(100_000);

/// A recorded session of the simulated robot in candump's log format.
fn session(seconds: f64, settings: &SimulationSettings) -> String {
    let robot = SimulatedRobot::open("icub_left_arm").unwrap();
    let mut log = Vec::new();
    record(&robot, settings, seconds, T0, &mut log).unwrap();
    String::from_utf8(log).unwrap()
}

// ---------------------------------------------------------------- help and typing mistakes

#[test]
fn every_verb_has_help() {
    let place = Place::new();
    let help = place.run(&["--help"]).good();
    let listed: Vec<&str> = help
        .out
        .lines()
        .skip_while(|l| !l.starts_with("Commands:"))
        .skip(1)
        .take_while(|l| l.starts_with("  "))
        .filter_map(|l| l.split_whitespace().next())
        .filter(|verb| *verb != "help")
        .collect();
    for verb in VERBS {
        assert!(
            listed.contains(&verb),
            "{verb} is not in the help: {}",
            help.out
        );
    }
    for verb in listed {
        // Programs of their own, whose help is their own. On most machines they are not installed.
        if ["view", "ros2"].contains(&verb) {
            let places = std::env::var_os("PATH").unwrap_or_default();
            let program = format!("proprio-{verb}");
            if std::env::split_paths(&places).any(|place| place.join(&program).exists()) {
                continue;
            }
            let told = [
                "is not installed",
                &format!("cargo install --path bridge/{verb}"),
            ];
            place.run(&[verb, "--help"]).fails(1, &told);
            continue;
        }
        let help = place.run(&[verb, "--help"]).good();
        assert!(
            help.out.contains(&format!("Usage: proprio {verb}")),
            "{}",
            help.out
        );
        assert!(help.err.is_empty(), "{}", help.err);
        assert!(
            place
                .run(&["help", verb])
                .good()
                .out
                .contains("Usage: proprio")
        );
        // Every option has a description.
        for option in help
            .out
            .lines()
            .filter(|l| l.trim_start().starts_with("--"))
        {
            let told = option
                .trim_start()
                .split("  ")
                .filter(|part| !part.trim().is_empty())
                .count();
            assert!(told >= 2, "{verb}: {option:?} says nothing");
        }
    }
    assert!(place.run(&["--version"]).good().out.starts_with("proprio "));
    let page = place.run(&["help", "unexplained"]).good();
    assert!(page.out.starts_with("## `unexplained`\n"), "{}", page.out);
    let script = place.run(&["completions", "bash"]).good();
    assert!(script.out.contains("identify"));
}

#[test]
fn typing_mistakes_end_with_2_and_say_what_was_meant() {
    let place = Place::new();
    for (args, expected) in [
        (&["decod"][..], "decode"),
        (&["gateway", "--confg", "x"], "--config"),
        (&["gateway"], "--config <FILE>"),
        (&["help", "unexplaned"], "did you mean \"unexplained\"?"),
        (&["help", "ctl", "tar"], "`proprio help ctl`"),
        (
            &["estimate", "--config", "estimator.toml"],
            "--samples <FILE>",
        ),
        (&["demo", "--seconds", "0"], "must be 2 to 600"),
        (&["demo", "--seconds", "nan"], "must be 2 to 600"),
        (&["demo", "--cad-error", "0.7"], "must be 0 to 0.5"),
        (&["simulate", "--still", "nan"], "must be 0 to 3600"),
        (&["simulate", "--seed", "x"], "--seed"),
        (&["simulate", "--seconds", "-1"], "-1"),
        (&["doctor", "extra"], "extra"),
    ] {
        let ran = place.run(args);
        assert_eq!(ran.code, Some(2), "{args:?}: {}", ran.err);
        assert!(
            ran.err.starts_with("error: ") && ran.err.contains(expected),
            "{args:?}: {}",
            ran.err
        );
    }
    assert_eq!(place.run(&[]).code, Some(2));
    place
        .run(&["simulate", "--robot", "nobody"])
        .fails(2, &["there is no robot \"nobody\"", "no gateway.toml in"]);
    place
        .run(&["simulate", "--seconds", "0"])
        .fails(2, &["seconds = 0 must be above 0"]);
    place
        .run(&["simulate", "--bus", "udp:x"])
        .fails(2, &["\"udp:x\"", "virtual:left_arm"]);
    for verb in ["simulate", "demo"] {
        place
            .run(&[verb, "--fault", "lots"])
            .fails(2, &["fault \"lots\"", "lost", "for example"]);
        place
            .run(&[verb, "--fault", "silent:nose@1..2"])
            .fails(2, &["no board or channel \"nose\"", "l_arm_ft_sensor"]);
    }
    place
        .run(&["demo", "--seconds", "3", "--fault", "push:l_hand=20@4..5"])
        .fails(2, &["push:l_hand=20@4..5", "after the end", "3 s"]);
    place
        .run(&["demo", "--robot", "nobody"])
        .fails(2, &["there is no robot \"nobody\""]);
    assert!(
        !place.exists("proprio-demo"),
        "nothing is made before the arguments are right"
    );
    // Errors of the domain's name and folder.
    let gateway = ["gateway", "--config", "gateway.toml", "--domain"];
    place
        .run(&[&gateway[..], &["a b"]].concat())
        .fails(2, &["\"a b\"", "1 to 32 letters"]);
    let mut command = place.command(&["estimator", "--config", "estimator.toml"]);
    command.env("PROPRIO_RUNTIME_DIR", "relative");
    finish(command, b"", "estimator in a relative folder")
        .fails(2, &["relative must be absolute", "PROPRIO_RUNTIME_DIR"]);
}

// ---------------------------------------------------------------- wrong configurations

#[test]
fn a_wrong_gateway_toml_is_told_with_file_place_and_what_would_be_legal() {
    let place = Place::new();
    for (from, to, expected) in [
        (
            "driver = \"icub_strain\"",
            "driver = \"icub_strian\"",
            &[
                "left_arm",
                "line",
                "\"icub_strian\" is not known",
                "icub_strain, icub_imu",
            ][..],
        ),
        (
            "address = 2\n",
            "address = 1\n",
            &[
                "l_shoulder_roll_motor",
                "l_shoulder_pitch_motor",
                "both claim identifier 0x110",
            ],
        ),
        (
            "address = 13",
            "address = 99",
            &["l_arm_ft_sensor", "address = 99", "1 to 14"],
        ),
        (
            "max_silence_ms",
            "max_silence",
            &["l_arm_ft_sensor", "max_silence"],
        ),
        ("schema = 1", "schema = 9", &["schema = 9", "schema = 1"]),
        (
            "kind = \"virtual\"",
            "kind = \"usb\"",
            &["`usb`", "socketcan"],
        ),
        (
            "ratio = 100.0",
            "ratio = nan",
            &["l_shoulder_pitch", "ratio = NaN"],
        ),
        (
            "ratio = 100.0",
            "ratio = 0.0",
            &["l_shoulder_pitch", "ratio = 0"],
        ),
        (
            "name = \"l_elbow\"",
            "name = \"l_wrist_yaw\"",
            &["joint \"l_wrist_yaw\"", "give them different names"],
        ),
        ("schema = 1", "schema = 1 = 2", &["line ", "schema = 1 = 2"]),
        (
            "robot = \"icub_left_arm\"",
            "robot = \"icub/left\"",
            &["robot = \"icub/left\""],
        ),
        (
            "source = { kind = \"virtual\", name = \"left_arm\" }",
            "source = { kind = \"replay\", log = \"x.log\", pace = \"fast\" }",
            &["pace", "recorded"],
        ),
    ] {
        place.change("gateway.toml", "wrong.toml", &[(from, to)]);
        place
            .run(&["gateway", "--config", "wrong.toml"])
            .fails_in("wrong.toml", expected);
        if !to.contains("fast") {
            place
                .run(&["gateway", "--config", "wrong.toml", "--check"])
                .fails_in("wrong.toml", expected);
            place
                .run(&[
                    "decode",
                    "--config",
                    "wrong.toml",
                    "--log",
                    "-",
                    "--out",
                    "o.csv",
                ])
                .fails_in("wrong.toml", expected);
        }
    }
    place
        .run(&["gateway", "--config", "none.toml"])
        .fails(2, &["none.toml: cannot be read", "No such file"]);
    assert!(
        place
            .run(&["gateway", "--config", "gateway.toml", "--check"])
            .good()
            .out
            .contains("l_elbow")
    );
}

impl Ran {
    /// As [`Ran::fails`] with 2, and the file is named first.
    fn fails_in(&self, file: &str, parts: &[&str]) {
        // A message of the TOML parser shows the place in additional lines.
        self.fails(2, parts);
        assert!(
            self.err
                .lines()
                .any(|l| l.starts_with(&format!("error: {file}: "))),
            "{}: {}",
            self.what,
            self.err
        );
    }
}

#[test]
fn a_wrong_estimator_toml_is_told_with_file_place_and_what_would_be_legal() {
    let place = Place::new();
    for (from, to, expected) in [
        (
            "link = \"l_hand\"",
            "link = \"l_hnd\"",
            &[
                "contact \"hand\"",
                "\"l_hnd\" is not a link",
                "did you mean \"l_hand\"?",
            ][..],
        ),
        (
            "link = \"chest_imu_frame\"",
            "link = \"chest_imu\"",
            &["base.link", "\"chest_imu\" is not a link", "did you mean"],
        ),
        (
            "joint = \"l_arm_ft_sensor\"",
            "joint = \"l_arm_ft\"",
            &["l_arm_ft", "is not in the URDF", "l_arm_ft_sensor"],
        ),
        (
            "joint = \"l_arm_ft_sensor\"\nframe = \"child\"",
            "joint = \"l_elbow\"\nframe = \"parent\"",
            &["l_elbow", "the joint moves"],
        ),
        (
            "[differentiation]",
            "[locked]\nl_elbo = 0.0\n[differentiation]",
            &["locked.l_elbo", "did you mean \"l_elbow\"?"],
        ),
        (
            "[differentiation]",
            "[locked]\nl_elbow = nan\n[differentiation]",
            &["locked.l_elbow", "NaN"],
        ),
        (
            "trigger = \"l_arm_ft_sensor\"",
            "trigger = \"ft\"",
            &["output.trigger = \"ft\"", "l_arm_ft_sensor"],
        ),
        (
            "position_noise_rad = 1.5e-4",
            "position_noise_rad = -1.0",
            &["position_noise_rad = -1"],
        ),
        (
            "model = \"model.urdf\"",
            "model = \"none.urdf\"",
            &["none.urdf", "No such file"],
        ),
        (
            "model = \"model.urdf\"",
            "modle = \"model.urdf\"",
            &["`modle`", "`model`"],
        ),
        ("noise_n = [0.08", "noise_n = [0.0", &["noise_n", "above 0"]),
    ] {
        place.change("estimator.toml", "wrong.toml", &[(from, to)]);
        for args in [
            &["estimator", "--config", "wrong.toml"][..],
            &["estimator", "--config", "wrong.toml", "--check"],
        ] {
            place.run(args).fails_in("wrong.toml", expected);
        }
        place
            .run(&[
                "estimate",
                "--config",
                "wrong.toml",
                "--log",
                "-",
                "--out",
                "o.csv",
            ])
            .fails_in("wrong.toml", expected);
    }
    assert!(!place.exists("o.csv"));
    let check = place
        .run(&["estimator", "--config", "estimator.toml", "--check"])
        .good()
        .out;
    assert!(
        check.contains("reads joint l_elbow") && check.contains("sub-tree"),
        "{check}"
    );
    assert!(
        check.contains("beyond l_shoulder_pitch"),
        "which torques also depend on the URDF: {check}"
    );
    for what in [
        "mass of all links: ",
        "readings of the F/T sensors in it, without offsets",
        "withheld at rest in this posture: nothing",
        "  l_arm_ft_sensor: force [",
    ] {
        assert!(check.contains(what), "{check}");
    }
    // A torque that can never be determined is an error, reported after the plan.
    let stand =
        "[[contact]]\nname = \"forearm\"\nlink = \"l_forearm\"\n\n[[contact]]\nname = \"stand\"";
    place.change(
        "estimator.toml",
        "hidden.toml",
        &[("[[contact]]\nname = \"stand\"", stand)],
    );
    let ran = place.run(&["estimator", "--config", "hidden.toml", "--check"]);
    assert!(ran.out.contains("mass of all links: "), "{}", ran.out);
    ran.fails_in(
        "hidden.toml",
        &[
            "l_wrist_yaw",
            "can never be determined",
            "forearm, hand",
            "possible",
        ],
    );
}

/// The two configurations of a robot are checked together.
#[test]
fn what_the_gateway_does_not_publish_is_told() {
    let place = Place::new();
    let check = |gateway: &str| {
        let args = [
            "estimator",
            "--config",
            "estimator.toml",
            "--check",
            "--gateway",
            gateway,
        ];
        place.run(&args)
    };
    let told = check("gateway.toml").good().out;
    assert!(
        told.contains("gateway.toml publishes all channels that the estimator reads\n"),
        "{told}"
    );
    let gateway = place.read("gateway.toml");
    place.write("other.toml", &gateway.replace("l_elbow", "l_elbov"));
    check("other.toml").fails_in(
        "estimator.toml",
        &["other.toml publishes no joint/l_elbow (did you mean \"l_elbov\"?)"],
    );
    place.write(
        "other.toml",
        &gateway.replace("robot = \"icub_left_arm\"", "robot = \"another\""),
    );
    check("other.toml").fails_in(
        "estimator.toml",
        &["\"another\"", "would not find each other"],
    );
    place.write(
        "locked.toml",
        &(place.read("estimator.toml") + "\n[locked]\nl_wrist_yaw = 0.0\n"),
    );
    let args = [
        "estimator",
        "--config",
        "locked.toml",
        "--check",
        "--gateway",
        "gateway.toml",
    ];
    assert!(
        place
            .run(&args)
            .good()
            .out
            .contains("it does not read l_wrist_yaw\n")
    );
    check("none.toml").fails_in("none.toml", &["cannot be read"]);
    // --gateway requires --check.
    place
        .run(&[
            "estimator",
            "--config",
            "estimator.toml",
            "--gateway",
            "gateway.toml",
        ])
        .fails(2, &["--check"]);
}

#[test]
fn a_malformed_urdf_is_told_with_its_place() {
    let place = Place::new();
    let urdf = place.read("model.urdf");
    place.change(
        "estimator.toml",
        "wrong.toml",
        &[("model.urdf", "wrong.urdf")],
    );
    // The first moving link with a mass, and the first joint.
    let elbow = |from: &str, to: &str| {
        let at = urdf
            .find("<link name=\"l_forearm\"")
            .unwrap_or_else(|| urdf.find("<link name=\"l_hand\"").unwrap());
        let (before, after) = urdf.split_at(at);
        assert!(after.contains(from), "{from}");
        format!("{before}{}", after.replacen(from, to, 1))
    };
    let mass = urdf
        .split("<mass value=\"")
        .nth(1)
        .and_then(|t| t.split('"').next())
        .unwrap();
    let inertial = {
        let at = urdf.rfind("<inertial>").unwrap();
        let end = at + urdf[at..].find("</inertial>").unwrap() + "</inertial>".len();
        format!("{}{}", &urdf[..at], &urdf[end..])
    };
    for (text, expected) in [
        (
            urdf.replacen("<parent link=\"chest\"", "<parent link=\"chset\"", 1),
            &["chset", "is not in the URDF"][..],
        ),
        (
            urdf.replacen("<child link=\"l_hand\"", "<child link=\"l_finger\"", 1),
            &["l_finger", "is not in the URDF"],
        ),
        (
            urdf.replacen(&format!("<mass value=\"{mass}\""), "<mass value=\"NaN\"", 1),
            &["line ", "mass", "NaN", "not finite"],
        ),
        (
            urdf.replacen(&format!("<mass value=\"{mass}\""), "<mass value=\"1,5\"", 1),
            &["line ", "1,5"],
        ),
        (
            urdf.replacen(
                &format!("<mass value=\"{mass}\""),
                "<mass value=\"-1.0\"",
                1,
            ),
            &["cannot be negative"],
        ),
        (
            elbow("ixx=\"", "ixx=\"inf\" was=\""),
            &["line ", "ixx", "not finite"],
        ),
        (elbow("ixx=\"", "ixx=\"-"), &["not positive semidefinite"]),
        (inertial, &["no <inertial>"]),
        (
            elbow("</link>", "</link><link name=\"lonely\"/>"),
            &["lonely", "have no parent"],
        ),
        (
            urdf.replacen("<axis xyz=\"", "<axis xyz=\"0 0 0\" was=\"", 1),
            &["line ", "xyz is zero"],
        ),
        (urdf[..urdf.len() / 2].to_owned(), &["is not XML: line "]),
        (String::new(), &["wrong.urdf"]),
        ("<sdf><model/></sdf>".to_owned(), &["<sdf>, not <robot>"]),
    ] {
        assert!(text != urdf, "{expected:?}: the URDF was not changed");
        place.write("wrong.urdf", &text);
        let ran = place.run(&["estimator", "--config", "wrong.toml", "--check"]);
        ran.fails_in("wrong.toml", expected);
        assert!(ran.err.contains("wrong.urdf"), "{}", ran.err);
        place
            .run(&["estimator", "--config", "wrong.toml"])
            .fails_in("wrong.toml", expected);
    }
    assert!(Model::from_urdf(&urdf, &[]).is_ok());
}

#[test]
fn a_joint_that_is_neither_measured_nor_locked_is_told() {
    let place = Place::new();
    let log = oracle("icub_left_arm_mujoco.csv");
    let names: Vec<&str> = log.lines().next().unwrap().split(',').collect();
    let keep: Vec<usize> = (0..names.len())
        .filter(|i| !names[*i].starts_with("joint/l_wrist_yaw/"))
        .collect();
    let cut: String = log.lines().fold(String::new(), |mut text, line| {
        let cells: Vec<&str> = line.split(',').collect();
        let _ = writeln!(
            text,
            "{}",
            keep.iter().map(|i| cells[*i]).collect::<Vec<_>>().join(",")
        );
        text
    });
    place.write("cut.csv", &cut);
    let args = [
        "estimate",
        "--config",
        "estimator.toml",
        "--log",
        "cut.csv",
        "--out",
        "o.csv",
    ];
    place.run(&args).fails_in(
        "estimator.toml",
        &["cut.csv", "joint/l_wrist_yaw", "in [locked]"],
    );
    assert!(!place.exists("o.csv"));
    // The remedy in the message works.
    place.change(
        "estimator.toml",
        "locked.toml",
        &[(
            "[differentiation]",
            "[locked]\nl_wrist_yaw = 0.1\n[differentiation]",
        )],
    );
    place
        .run(&[
            "estimate",
            "--config",
            "locked.toml",
            "--log",
            "cut.csv",
            "--out",
            "o.csv",
        ])
        .good();
    // Two missing channels give one message.
    place.write(
        "cut.csv",
        &cut.replacen("wrench/l_arm_ft_sensor/", "wrench/other/", 6),
    );
    place.run(&args).fails_in(
        "estimator.toml",
        &["wrench/l_arm_ft_sensor", "joint/l_wrist_yaw"],
    );
}

// ---------------------------------------------------------------- a machine that lacks something

/// A configuration with one bus on a kernel interface.
fn on_interface(place: &Place, name: &str) {
    let source = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\nsource = {{ kind = \"socketcan\", \
         interface = \"{name}\" }}\n"
    );
    place.write("can.toml", &source);
}

#[test]
fn an_interface_that_is_not_there_is_told_and_so_is_a_kernel_without_can() {
    let place = Place::new();
    on_interface(&place, "nocan7");
    let ran = place.run(&["gateway", "--config", "can.toml"]);
    let simulate = place.run(&[
        "simulate",
        "--bus",
        "nocan7",
        "--bus",
        "nocan8",
        "--seconds",
        "1",
    ]);
    // The message recommends the virtual bus and its configuration.
    let expected = if has_can() {
        "there is no interface nocan7"
    } else {
        "this kernel has no CAN"
    };
    for ran in [&ran, &simulate] {
        ran.fails(
            1,
            &[
                expected,
                "virtual",
                "source = { kind = \"virtual\", name = \"...\" }",
            ],
        );
    }
    assert!(ran.err.contains("bus \"b\""), "{}", ran.err);
    // The remedy in the message works.
    place.change(
        "can.toml",
        "virtual.toml",
        &[(
            "kind = \"socketcan\", interface = \"nocan7\"",
            "kind = \"virtual\", name = \"b\"",
        )],
    );
    let mut gateway = place.start(&["gateway", "--config", "virtual.toml"]);
    until(PATIENCE, || gateway.log().contains("running").then_some(()))
        .expect("the gateway runs on a virtual bus");
    gateway.end();
    let demo = place.run(&["demo", "--bus", "nocan7", "--seconds", "2", "--out", "d"]);
    demo.fails(1, &[expected, "gateway"]);
    if has_can() {
        on_interface(&place, "lo");
        place
            .run(&["gateway", "--config", "can.toml"])
            .fails(1, &["lo is not a CAN interface"]);
    }
}

fn has_can() -> bool {
    use nix::sys::socket::{AddressFamily, SockFlag, SockType, socket};
    !matches!(
        socket(AddressFamily::Can, SockType::Raw, SockFlag::empty(), None),
        Err(nix::Error::EAFNOSUPPORT)
    )
}

#[test]
fn what_may_not_be_done_is_told() {
    let place = Place::new();
    // As root, run as user nobody, because root has all permissions.
    let nobody = nix::unistd::geteuid().is_root().then_some(65534);
    let everybody = |path: &Path, mode: u32| {
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    };
    everybody(&place.path(""), 0o755);
    // The program's own folder may not be readable for others.
    let program = place.path("proprio");
    fs::copy(Rig::program(), &program).unwrap();
    everybody(&program, 0o755);
    for name in ["gateway.toml", "estimator.toml", "model.urdf"] {
        everybody(&place.path(name), 0o644);
    }
    for folder in ["closed", "closed/domain", "open"] {
        fs::create_dir(place.path(folder)).unwrap();
    }
    place.write("closed/secret.toml", "schema = 1");
    everybody(&place.path("closed/secret.toml"), 0o000);
    everybody(&place.path("open"), 0o777);
    place.write("log.log", &session(0.1, &SimulationSettings::default()));
    everybody(&place.path("log.log"), 0o644);
    for folder in ["closed/domain", "closed"] {
        everybody(&place.path(folder), 0o555);
    }
    let run = |args: &[&str], domain: &str| {
        let mut command = Command::new(&program);
        command
            .args(args)
            .current_dir(place.path(""))
            .env("PROPRIO_DOMAIN", "test");
        command
            .env("PROPRIO_RUNTIME_DIR", place.path(domain))
            .env_remove("RUST_LOG");
        if let Some(nobody) = nobody {
            command.uid(nobody).gid(nobody);
        }
        finish(command, b"", &args.join(" "))
    };
    let gateway = ["gateway", "--config", "gateway.toml"];
    let estimator = ["estimator", "--config", "estimator.toml"];
    for args in [gateway, estimator] {
        run(&args, "closed/domain/sub").fails(
            1,
            &[
                "cannot create directory",
                "Permission denied",
                "PROPRIO_RUNTIME_DIR",
            ],
        );
        run(&args, "closed/domain").fails(1, &["closed/domain"]);
    }
    run(&["gateway", "--config", "closed/secret.toml"], "open").fails(
        2,
        &["closed/secret.toml: cannot be read", "Permission denied"],
    );
    let decode = [
        "decode",
        "--config",
        "gateway.toml",
        "--log",
        "log.log",
        "--out",
    ];
    run(&[&decode[..], &["closed/o.csv"]].concat(), "open")
        .fails(1, &["closed/o.csv: cannot be written", "ermission denied"]);
    run(
        &["simulate", "--seconds", "1", "--truth", "closed/t.csv"],
        "open",
    )
    .fails(1, &["closed/t.csv", "Permission denied"]);
    run(&["demo", "--out", "closed/d"], "open")
        .fails(1, &["closed/d: cannot be created", "Permission denied"]);
    assert_eq!(fs::read_dir(place.path("closed")).unwrap().count(), 2);
    run(&[&decode[..], &["open/o.csv"]].concat(), "open").good();
    // Another user's domain, if there are two users.
    if nobody.is_some() {
        let mut ours = place.start(&gateway);
        until(PATIENCE, || ours.log().contains("running").then_some(())).expect("the gateway runs");
        everybody(&place.rig.domain.base, 0o777);
        let mut command = Command::new(&program);
        command
            .args(gateway)
            .current_dir(place.path(""))
            .env("PROPRIO_DOMAIN", &place.rig.domain.name);
        command
            .env("PROPRIO_RUNTIME_DIR", &place.rig.domain.base)
            .uid(65534)
            .gid(65534);
        finish(command, b"", "another user's domain")
            .fails(1, &["belongs to user id 0", "must run as the same user"]);
        ours.assert_runs();
        ours.end();
    }
}

#[test]
fn the_doctor_looks_at_everything() {
    let place = Place::new();
    let told = place.run(&["doctor", "--json"]).good().json();
    let checks: Vec<&str> = told
        .as_array()
        .unwrap()
        .iter()
        .map(|f| f["check"].as_str().unwrap())
        .collect();
    for check in [
        "kernel CAN",
        "CAN interfaces",
        "virtual bus",
        "shared memory",
        "receive buffers",
        "open files",
        "real-time",
        "locked memory",
    ] {
        assert!(checks.contains(&check), "{checks:?}");
    }
    for finding in told.as_array().unwrap() {
        let verdict = finding["verdict"].as_str().unwrap();
        assert!(["ok", "lacking", "failed"].contains(&verdict), "{finding}");
        assert_eq!(
            verdict == "ok",
            finding["hint"].as_str().unwrap().is_empty(),
            "what lacks has a remedy: {finding}"
        );
    }
    let can = told
        .as_array()
        .unwrap()
        .iter()
        .find(|f| f["check"] == "kernel CAN")
        .unwrap();
    assert_eq!(can["verdict"] == "ok", has_can(), "{can}");
    let words = place.run(&["doctor"]).good().out;
    assert!(checks.iter().all(|c| words.contains(c)), "{words}");
    // The folder of a domain belongs in memory.
    let verdict = |base: &Path| {
        let mut command = place.command(&["doctor", "--json"]);
        command.env("PROPRIO_RUNTIME_DIR", base);
        let told = finish(command, b"", "doctor").good().json();
        let mut of_memory = told.as_array().unwrap().iter();
        of_memory.find(|f| f["check"] == "shared memory").unwrap()["verdict"].clone()
    };
    assert_eq!(verdict(&place.rig.domain.base), "ok");
    let on_disk = statfs(&place.path("")).unwrap().filesystem_type() != TMPFS_MAGIC;
    assert_eq!(verdict(&place.path("folder")) == "lacking", on_disk);
    // Without shared memory nothing runs: this is a failure.
    let mut command = place.command(&["doctor"]);
    command.env("PROPRIO_RUNTIME_DIR", "/proc/nowhere");
    finish(command, b"", "doctor without a place")
        .fails(1, &["this machine cannot run proprio", "shared memory"]);
}

// ---------------------------------------------------------------- bad samples and half-written
// logs

/// The numbered lines of a text (from 1), without those in `drop`.
fn without(text: &str, drop: &[usize]) -> String {
    text.lines()
        .zip(1..)
        .filter(|(_, n)| !drop.contains(n))
        .fold(String::new(), |t, (line, _)| t + line + "\n")
}

#[test]
fn bad_rows_are_named_and_take_nothing_else_with_them() {
    let place = Place::new();
    let log = oracle("icub_left_arm_mujoco.csv");
    let names: Vec<&str> = log.lines().next().unwrap().split(',').collect();
    let column = |name: &str| names.iter().position(|n| *n == name).unwrap();
    let (elbow, fx) = (
        column("joint/l_elbow/position"),
        column("wrench/l_arm_ft_sensor/fx"),
    );
    let mut lines: Vec<String> = log.lines().map(ToOwned::to_owned).collect();
    let set = |lines: &mut Vec<String>, line: usize, column: usize, to: &str| {
        let mut cells: Vec<&str> = lines[line - 1].split(',').collect();
        cells[column] = to;
        lines[line - 1] = cells.join(",");
    };
    set(&mut lines, 10, elbow, "NaN");
    set(&mut lines, 20, elbow, "inf");
    set(&mut lines, 30, fx, "12,5");
    set(&mut lines, 40, fx, "");
    set(&mut lines, 50, 0, "soon");
    place.write("good.csv", &without(&log, &[10, 20, 30, 40, 50]));
    place.write("bad.csv", &(lines.join("\n") + "\n"));
    let estimate = |log: &str, out: &str| {
        place
            .run(&[
                "estimate",
                "--config",
                "estimator.toml",
                "--log",
                log,
                "--out",
                out,
                "--json",
            ])
            .good()
    };
    let assess = [
        "estimate",
        "--config",
        "estimator.toml",
        "--log",
        "good.csv",
        "--assess",
    ];
    let told = place
        .run(&[&assess[..], &["--out", "a.out"]].concat())
        .good();
    // In that configuration the hand may always be touched.
    assert!(
        told.err.contains("no F/T reading can be predicted"),
        "{}",
        told.err
    );
    let told = place
        .run(&[&assess[..], &["--out", "a.out", "--json"]].concat())
        .good()
        .json();
    let assessment = &told["assessment"];
    assert!(
        assessment["changes"] == 0 && assessment["torques"].is_object(),
        "{told}"
    );
    assert!(
        assessment["predicted"]["relative_error"]["cad"].is_null(),
        "{told}"
    );
    let clean = estimate("good.csv", "good.out");
    assert_eq!(
        place.read("a.out"),
        place.read("good.out"),
        "figures change no estimate"
    );
    assert!(clean.err.is_empty(), "{}", clean.err);
    let dirty = estimate("bad.csv", "bad.out");
    assert_eq!(
        place.read("good.out"),
        place.read("bad.out"),
        "good rows give the same result, bit for bit"
    );
    assert_eq!(
        (&dirty.json()["bad_rows"], &dirty.json()["rows"]),
        (&5.into(), &196.into()),
        "{}",
        dirty.out
    );
    for (line, what) in [
        (10, "joint/l_elbow/position is \"NaN\""),
        (20, "\"inf\""),
        (30, "45 cells instead of 44"),
        (40, "some of fx fy fz"),
        (50, "t is \"soon\""),
    ] {
        let told = dirty
            .err
            .lines()
            .filter(|l| l.starts_with(&format!("bad.csv: line {line}: skipped: ")));
        let told: Vec<_> = told.collect();
        assert!(
            told.len() == 1 && told[0].contains(what),
            "line {line}: {}",
            dirty.err
        );
    }
}

/// A board that reports an encoder fault for half a second, and a lost half of a wrench: the table
/// of samples has both, and the estimator withholds the torques beyond the joint meanwhile.
#[test]
fn faults_and_gaps_of_a_log_are_in_its_table_of_samples() {
    let place = Place::new();
    let during = |line: &str, from: f64, to: f64| {
        let stamp = line[1..].split(')').next().unwrap().parse::<f64>().unwrap();
        (from..to).contains(&(stamp - T0.seconds()))
    };
    let (mut faults, mut gaps) = (0, 0);
    let mut lines: Vec<String> = Vec::new();
    for line in session(4.0, &SimulationSettings::default()).lines() {
        // STATUS of the board of the elbow; its second byte is the state of the encoder: stuck.
        if let Some((front, data)) = line.split_once(" 143#")
            && during(line, 2.0, 2.5)
        {
            lines.push(format!("{front} 143#{}02{}", &data[..2], &data[4..]));
            faults += 1;
        } else if line.contains(" 3DB#") && during(line, 3.0, 4.0) && gaps == 0 {
            gaps += 1;
        } else {
            lines.push(line.to_owned());
        }
    }
    assert!(faults > 3 && gaps == 1, "{faults} faults, {gaps} gaps");
    place.write("faults.log", &(lines.join("\n") + "\n"));
    place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "faults.log",
            "--out",
            "samples.csv",
        ])
        .good();
    let samples = table(&place.read("samples.csv"));
    let since = |row: usize| samples["t"][row] - T0.seconds();
    let flagged = |channel: &str, flag: Quality| -> Vec<f64> {
        let quality = &samples[&format!("{channel}/quality")];
        let rows = (0..quality.len()).filter(|row| {
            quality[*row].is_finite() && Quality(quality[*row] as u32).contains(flag)
        });
        rows.map(since).collect()
    };
    let faulty = flagged("l_elbow", Quality::DEVICE_FAULT);
    // From the first such status to the next one without: they come every tenth of a second.
    assert!(
        faulty.len() > 100 && faulty[0] >= 2.0 && faulty.iter().all(|t| *t < 2.6),
        "{faulty:?}"
    );
    assert!(flagged("l_shoulder_yaw", Quality::DEVICE_FAULT).is_empty());
    let gap = flagged("l_arm_ft_sensor", Quality::GAP_BEFORE);
    assert!(
        gap.len() == 1 && (3.0..3.1).contains(&gap[0]),
        "one reading after the lost half: {gap:?}"
    );
    let told = place
        .run(&[
            "estimate",
            "--config",
            "estimator.toml",
            "--log",
            "samples.csv",
            "--out",
            "estimates.csv",
            "--json",
        ])
        .good()
        .json();
    let withheld = told["withheld_by_reason"].as_object().unwrap();
    let sum: u64 = withheld.values().map(|count| count.as_u64().unwrap()).sum();
    assert!(withheld["device_fault"].as_u64().unwrap() > 1000, "{told}");
    assert_eq!(told["torques_withheld"], sum, "{told}");
    let text = place.read("estimates.csv");
    let mut rows = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = rows.next().unwrap();
    let column = |name: &str| header.iter().position(|own| *own == name).unwrap();
    let (t, reason) = (column("t"), column("reason/l_wrist_prosup"));
    for row in rows {
        let at = row[t].parse::<f64>().unwrap() - T0.seconds();
        if (2.2..2.5).contains(&at) {
            assert!(
                row[reason].starts_with("device_fault"),
                "{at}: {}",
                row[reason]
            );
        } else if (1.5..2.0).contains(&at) || at > 3.2 {
            assert!(
                !row[reason].starts_with("device_fault"),
                "{at}: {}",
                row[reason]
            );
        }
    }
}

#[test]
fn stamps_that_go_backwards_are_counted_and_take_nothing_else_with_them() {
    let place = Place::new();
    let log = oracle("icub_left_arm_mujoco.csv");
    let lines: Vec<&str> = log.lines().collect();
    // Line 100 is repeated after line 120, and line 150 occurs twice.
    let mut worse: Vec<&str> = lines.clone();
    worse.insert(150, lines[149]);
    worse.insert(120, lines[99]);
    place.write("good.csv", &log);
    place.write("bad.csv", &(worse.join("\n") + "\n"));
    let estimate = |log: &str, out: &str| {
        place
            .run(&[
                "estimate",
                "--config",
                "estimator.toml",
                "--log",
                log,
                "--out",
                out,
                "--json",
            ])
            .good()
    };
    estimate("good.csv", "good.out");
    let dirty = estimate("bad.csv", "bad.out");
    assert_same(&place.read("good.out"), &place.read("bad.out"), "estimates");
    let json = dirty.json();
    assert_eq!(
        json["late"].as_u64().unwrap() + json["backward"].as_u64().unwrap(),
        18,
        "two rows of nine channels: {json}"
    );
    assert_eq!(dirty.err.lines().count(), 2, "{}", dirty.err);
    assert!(
        dirty
            .err
            .starts_with("bad.csv: samples dropped, the first in line 121: ")
            && dirty
                .err
                .contains("\nbad.csv: at line 121 the time steps back by "),
        "{}",
        dirty.err
    );
    // In a CAN log: the same frame with an earlier stamp.
    let log = session(0.5, &SimulationSettings::default());
    let mut lines: Vec<&str> = log.lines().collect();
    let motor = lines
        .iter()
        .rposition(|l| l.contains("left_arm_motors 140#"))
        .unwrap();
    let earlier = format!(
        "({}) {}",
        (T0 + Nanos::from_millis(100)).to_string().trim(),
        lines[motor].split_once(") ").unwrap().1
    );
    lines.insert(motor + 1, &earlier);
    place.write("good.log", &log);
    place.write("bad.log", &(lines.join("\n") + "\n"));
    let decode = |log: &str, out: &str| {
        place
            .run(&[
                "decode",
                "--config",
                "gateway.toml",
                "--log",
                log,
                "--out",
                out,
            ])
            .good()
    };
    decode("good.log", "good.csv");
    let dirty = decode("bad.log", "bad.csv");
    assert_same(&place.read("good.csv"), &place.read("bad.csv"), "samples");
    assert!(
        dirty.err.contains("l_elbow_motor: backward_stamp: 1"),
        "{}",
        dirty.err
    );
    let told = format!("bad.log: at line {} the time steps back by ", motor + 2);
    assert!(dirty.err.contains(&told), "{}", dirty.err);
}

#[test]
fn a_log_cut_off_anywhere_gives_everything_before_the_cut() {
    let place = Place::new();
    let log = session(0.3, &SimulationSettings::default());
    let whole = log.len();
    let args = [
        "decode",
        "--config",
        "gateway.toml",
        "--log",
        "-",
        "--out",
        "-",
    ];
    let last = log[..whole - 1].rfind('\n').unwrap() + 1;
    let before = place.run_with(&args, &log.as_bytes()[..last]).good().out;
    for cut in last + 1..whole {
        let ran = place.run_with(&args, &log.as_bytes()[..cut]).good();
        // All samples before the cut are decoded; half a line gives no sample.
        assert_same(
            &ran.out,
            &before,
            &format!("cut after {:?}", &log[last..cut]),
        );
        assert!(
            ran.err
                .contains(&format!("-: skipped: line {}: ", log.lines().count())),
            "cut after {:?}: {}",
            &log[last..cut],
            ran.err
        );
    }
    // The same for a table.
    let table = oracle("icub_left_arm_mujoco.csv");
    let cut = &table[..table.len() / 2];
    let whole_lines = cut.lines().count() - 2;
    let args = [
        "estimate",
        "--config",
        "estimator.toml",
        "--log",
        "-",
        "--out",
        "-",
    ];
    let ran = place.run_with(&args, cut.as_bytes()).good();
    assert_eq!(ran.out.lines().count(), whole_lines + 1);
    assert!(
        ran.err
            .contains(&format!("-: line {}: skipped: it has", whole_lines + 2)),
        "{}",
        ran.err
    );
}

#[test]
fn what_is_no_log_at_all_is_told_and_leaves_no_file() {
    let place = Place::new();
    place.write("empty", "");
    place.write("header.csv", "t,joint/l_elbow/position\n");
    // All columns, and no reading of the channel by which estimates are made.
    let table = oracle("icub_left_arm_mujoco.csv");
    let names = table.lines().next().unwrap();
    let cells = names.split(',').map(|name| match name {
        "t" => "1.0",
        name if name.starts_with("wrench/") => "",
        _ => "0.1",
    });
    let row = cells.collect::<Vec<_>>().join(",");
    place.write("rest.csv", &format!("{names}\n{row}\n"));
    place.write("text", "Once upon a time\nthere was a robot.\n");
    fs::write(
        place.path("noise"),
        (0..=255_u8).cycle().take(5000).collect::<Vec<u8>>(),
    )
    .unwrap();
    place.write("other.log", "(1.0) can7 123#00\n(1.1) can7 124#00\n");
    place.write("keep.csv", "precious");
    let names = |place: &Place| {
        let mut names = place.names();
        names.remove("tmp");
        names
    };
    let there = names(&place);
    for out in ["new.csv", "keep.csv"] {
        let decode = |log: &str| {
            place.run(&[
                "decode",
                "--config",
                "gateway.toml",
                "--log",
                log,
                "--out",
                out,
            ])
        };
        decode("none").fails(1, &["none: cannot be read", "No such file"]);
        decode("empty").fails(1, &["empty: the log holds no frame", "it is empty"]);
        decode("text").fails(1, &["text: the log holds no frame", "line 1"]);
        decode("noise").fails(1, &["noise: the log holds no frame"]);
        let estimate = |log: &str| {
            place.run(&[
                "estimate",
                "--config",
                "estimator.toml",
                "--log",
                log,
                "--out",
                out,
            ])
        };
        estimate("none").fails(1, &["none: cannot be read", "No such file"]);
        estimate("empty").fails(1, &["empty: ", "must name the columns"]);
        estimate("text").fails(1, &["text: ", "must name the columns"]);
        estimate("noise").fails(1, &["noise: "]);
        let assess = [
            "estimate",
            "--config",
            "estimator.toml",
            "--assess",
            "--out",
            out,
        ];
        let assess = |log: &str| place.run(&[&assess[..], &["--log", log]].concat());
        assess("none").fails(1, &["none: cannot be read", "No such file"]);
        assess("text").fails(1, &["text: ", "must name the columns"]);
        assess("-").fails(1, &["--assess reads the table twice", "--samples"]);
        assess("header.csv").fails(2, &["header.csv", "no column for"]);
        estimate("header.csv").fails(2, &["header.csv", "no column for"]);
        estimate("rest.csv").fails(1, &["rest.csv: the trigger channel", "no estimate"]);
        let encode = |log: &str| {
            place.run(&[
                "encode",
                "--config",
                "gateway.toml",
                "--samples",
                log,
                "--out",
                out,
            ])
        };
        encode("none").fails(1, &["none: cannot be read", "No such file"]);
        encode("empty").fails(1, &["empty: ", "must name the columns"]);
        encode("header.csv").fails(1, &["header.csv: ", "no rows"]);
        encode("noise").fails(1, &["noise: "]);
        assert_eq!(names(&place), there, "no half-written file");
        assert_eq!(place.read("keep.csv"), "precious");
    }
    place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "other.log",
            "--out",
            "new.csv",
        ])
        .fails(1, &["other.log: no sample in 2 frames", "interfaces"]);
    place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "text",
            "--out",
            "no/such/folder.csv",
        ])
        .fails(
            1,
            &["no/such/folder.csv: cannot be written", "No such file"],
        );
    let parameters = [
        "--parameters",
        "p.toml",
        "--log",
        "empty",
        "--out",
        "new.csv",
    ];
    let with_parameters = [&["estimate", "--config", "estimator.toml"], &parameters[..]].concat();
    place.run(&with_parameters).fails(
        2,
        &["estimator.toml: parameters: p.toml cannot be read: No such file"],
    );
    place.write("p.toml", "schema = 1\nrobot = \"icub_left_arm\"\n");
    place
        .run(&with_parameters)
        .fails(2, &["p.toml is damaged", "missing field `provenance`"]);
    place.write(
        "p.toml",
        &parameters_file().replacen("icub_left_arm", "icub_right_arm", 1),
    );
    place.run(&with_parameters).fails(
        2,
        &["p.toml belongs to robot \"icub_right_arm\", not to \"icub_left_arm\""],
    );
    // An output without free space.
    if Path::new("/dev/full").exists() {
        place.write("good.csv", &oracle("icub_left_arm_mujoco.csv"));
        place.write("good.log", &session(0.2, &SimulationSettings::default()));
        for input in [
            [
                "estimate",
                "--config",
                "estimator.toml",
                "--log",
                "good.csv",
            ],
            [
                "encode",
                "--config",
                "gateway.toml",
                "--samples",
                "good.csv",
            ],
            ["decode", "--config", "gateway.toml", "--log", "good.log"],
        ] {
            let args = [&input[..], &["--out", "/dev/full"]].concat();
            place
                .run(&args)
                .fails(1, &["/dev/full: cannot be written", "No space left"]);
        }
    }
}

// ---------------------------------------------------------------- files in, files out

const HALF_JOINT: f64 = std::f64::consts::TAU / 65536.0 / 100.0 / 2.0;

/// Half a step of each column: the maximum change by encoding and decoding.
fn half_step(column: &str) -> f64 {
    let degree = std::f64::consts::PI / 180.0;
    let part = column.rsplit('/').next().unwrap();
    match (column.split('/').next().unwrap(), part) {
        ("joint", "position") => HALF_JOINT,
        ("joint", "velocity") => HALF_JOINT * 1000.0,
        ("wrench", "fx" | "fy" | "fz") => 1804.0 / 32768.0 / 2.0,
        ("wrench", _) => 31.0 / 32768.0 / 2.0,
        ("imu", "ax" | "ay" | "az") => 0.005,
        ("imu", _) => degree / 32.0,
        _ => 0.0,
    }
}

#[test]
fn encode_and_decode_are_inverses_within_half_a_step() {
    let place = Place::new();
    let samples = oracle("icub_left_arm_mujoco.csv");
    place.write("samples.csv", &samples);
    let told = place
        .run(&[
            "encode",
            "--config",
            "gateway.toml",
            "--samples",
            "samples.csv",
            "--out",
            "session.log",
            "--json",
        ])
        .good()
        .json();
    assert_eq!(
        (&told["rows"], &told["samples"], &told["refused"]),
        (&201.into(), &(201 * 9).into(), &0.into()),
        "{told}"
    );
    let told = place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "session.log",
            "--out",
            "again.csv",
            "--json",
        ])
        .good()
        .json();
    assert_eq!(
        (&told["samples"], &told["bad_lines"], &told["unclaimed"]),
        (&(201 * 9).into(), &0.into(), &0.into()),
        "{told}"
    );
    let (before, after) = (table(&samples), table(&place.read("again.csv")));
    let mut compared = 0;
    for (name, values) in &after {
        let Some(expected) = before.get(name) else {
            assert!(name.ends_with("/quality"), "{name}");
            continue;
        };
        assert_eq!(values.len(), expected.len());
        for (row, (value, expected)) in values.iter().zip(expected).enumerate() {
            let bound = half_step(name) * (1.0 + 1e-9);
            assert!(
                (value - expected).abs() <= bound,
                "{name}, row {row}: {expected} became {value}, more than {bound} off"
            );
            compared += 1;
        }
    }
    assert_eq!(compared, 201 * (1 + 14 + 6 + 6));
    // Quantised values do not change any more: the log is equal bit for bit.
    place
        .run(&[
            "encode",
            "--config",
            "gateway.toml",
            "--samples",
            "again.csv",
            "--out",
            "again.log",
        ])
        .good();
    // (Frames of one instant are in the order of the table's columns.)
    let sorted = |name: &str| {
        let text = place.read(name);
        let mut lines: Vec<&str> = text.lines().collect();
        lines.sort_unstable();
        lines.join("\n")
    };
    assert_same(
        &sorted("again.log"),
        &sorted("session.log"),
        "the log again",
    );
    // Input and output may be the same file, and the output is readable for all users.
    place.write("same", &samples);
    place
        .run(&[
            "encode",
            "--config",
            "gateway.toml",
            "--samples",
            "same",
            "--out",
            "same",
        ])
        .good();
    assert_same(&place.read("same"), &place.read("session.log"), "in place");
    assert_eq!(
        fs::metadata(place.path("same"))
            .unwrap()
            .permissions()
            .mode()
            & 0o444,
        0o444
    );
}

#[test]
fn standard_input_and_output_serve_as_files() {
    let place = Place::new();
    let samples = oracle("icub_left_arm_mujoco.csv");
    let encoded = place
        .run_with(
            &[
                "encode",
                "--config",
                "gateway.toml",
                "--samples",
                "-",
                "--out",
                "-",
            ],
            samples.as_bytes(),
        )
        .good();
    assert!(
        encoded.out.starts_with('('),
        "the log and nothing else: {}",
        encoded.out.lines().next().unwrap_or_default()
    );
    let decoded = place
        .run_with(
            &[
                "decode",
                "--config",
                "gateway.toml",
                "--log",
                "-",
                "--out",
                "-",
                "--json",
            ],
            encoded.out.as_bytes(),
        )
        .good();
    assert_eq!(decoded.out.lines().count(), 202);
    let told = decoded.err.lines().last().unwrap();
    assert_eq!(
        serde_json::from_str::<Json>(told).unwrap()["samples"],
        201 * 9,
        "{told}"
    );
    let estimated = place
        .run_with(
            &[
                "estimate",
                "--config",
                "estimator.toml",
                "--log",
                "-",
                "--out",
                "-",
            ],
            decoded.out.as_bytes(),
        )
        .good();
    assert_eq!(estimated.out.lines().count(), 202);
    // The same result as with files.
    place.write("samples.csv", &samples);
    place
        .run(&[
            "encode",
            "--config",
            "gateway.toml",
            "--samples",
            "samples.csv",
            "--out",
            "a.log",
        ])
        .good();
    place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "a.log",
            "--out",
            "a.csv",
        ])
        .good();
    place
        .run(&[
            "estimate",
            "--config",
            "estimator.toml",
            "--log",
            "a.csv",
            "--out",
            "e.csv",
        ])
        .good();
    assert_eq!(
        (
            place.read("a.log"),
            place.read("a.csv"),
            place.read("e.csv")
        ),
        (encoded.out, decoded.out, estimated.out)
    );
    let before = place.names();
    place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "a.log",
            "--out",
            "/dev/null",
        ])
        .good();
    assert_eq!(place.names(), before);
    assert!(
        !fs::metadata("/dev/null").unwrap().is_file(),
        "a device is not replaced by a file"
    );
}

#[test]
fn a_decoded_session_is_the_simulators_truth() {
    let place = Place::new();
    let settings = SimulationSettings {
        noise: false,
        seed: 5,
        ..SimulationSettings::default()
    };
    place.write("session.log", &session(4.0, &settings));
    let told = place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "session.log",
            "--out",
            "s.csv",
            "--json",
        ])
        .good()
        .json();
    for device in told["devices"].as_array().unwrap() {
        assert!(
            device["refusal"].is_null() && device["counts"].as_object().unwrap().is_empty(),
            "{device}"
        );
    }
    let mut simulation =
        Simulation::new(&SimulatedRobot::open("icub_left_arm").unwrap(), &settings).unwrap();
    let samples = table(&place.read("s.csv"));
    let (mut compared, mut moving) = (0_u32, 0_u32);
    for (row, t) in samples["t"].iter().enumerate() {
        let since = t - T0.seconds();
        // Frames wait for their bus, so values are up to a few frame durations older than their
        // stamp.
        let late = (since - 1.5e-3).max(0.0);
        let (now, then) = (simulation.at(since).clone(), simulation.at(late).clone());
        let mut check = |name: &str, truth: f64, older: f64| {
            let Some(value) = samples.get(name).map(|c| c[row]).filter(|v| !v.is_nan()) else {
                return;
            };
            let bound = half_step(name) * 1.000_001 + (truth - older).abs() * 1.5 + 1e-9;
            assert!(
                (value - truth).abs() <= bound,
                "{name} at {since:.4} s: {value}, truth {truth}, may be {bound} off"
            );
            compared += 1;
            moving += u32::from(truth != older);
        };
        for name in [
            "l_shoulder_pitch",
            "l_shoulder_roll",
            "l_shoulder_yaw",
            "l_elbow",
            "l_wrist_prosup",
            "l_wrist_pitch",
            "l_wrist_yaw",
        ] {
            let joint = simulation.joint(name).unwrap();
            let (now, then) = (now.joints[joint], then.joints[joint]);
            check(
                &format!("joint/{name}/position"),
                now.position,
                then.position,
            );
            check(
                &format!("joint/{name}/velocity"),
                now.velocity,
                then.velocity,
            );
        }
        for (part, axis) in ["fx", "fy", "fz", "tx", "ty", "tz"].into_iter().zip(0..) {
            check(
                &format!("wrench/l_arm_ft_sensor/{part}"),
                now.wrenches[0][axis],
                then.wrenches[0][axis],
            );
        }
        let (now, then) = (&now.imus[0], &then.imus[0]);
        for (part, axis) in ["ax", "ay", "az"].into_iter().zip(0..) {
            check(
                &format!("imu/chest_imu/{part}"),
                now.proper_acceleration[axis],
                then.proper_acceleration[axis],
            );
        }
    }
    assert!(
        compared > 30_000 && moving > 15_000,
        "{compared} values, {moving} of them in motion"
    );
}

/// The frames of two sessions that other implementations made, and lines of `who` among them.
fn sessions() -> (Vec<&'static str>, Vec<&'static str>) {
    let ati = include_str!("../../drivers/tests/drivers/ati.txt");
    let canopen = include_str!("../../drivers/tests/drivers/canopen.txt");
    (ati.lines().collect(), canopen.lines().collect())
}

/// What people paste from a terminal: one bus with a force/torque sensor that another program asks,
/// CANopen nodes that a master starts, boards of an iCub and frames of nobody; no stamps at all.
#[test]
fn a_mixed_bus_on_the_screen_of_candump_decodes() {
    let (ati, canopen) = sessions();
    let is_frame = |line: &&&str| !line.contains(' ');
    let mut left = ati.iter().filter(is_frame).peekable();
    let mut right = canopen.iter().filter(is_frame).peekable();
    let mut log = String::new();
    for turn in 0.. {
        // In steps of different lengths.
        let next = if turn % 5 < 2 {
            left.next()
        } else {
            right.next()
        };
        let Some(frame) = next.or_else(|| left.next()).or_else(|| right.next()) else {
            break;
        };
        let mut line = |frame: &str| {
            let (id, data) = frame.split_once('#').unwrap();
            let bytes: Vec<&str> = (0..data.len() / 2)
                .map(|i| &data[2 * i..2 * i + 2])
                .collect();
            writeln!(log, "  can0  {id}   [{}]  {}", bytes.len(), bytes.join(" ")).unwrap();
        };
        line(frame);
        if turn % 9 == 0 {
            line("31A#E380B76A1887");
            line("31B#2184BE770881");
            line("7FF#00");
        }
    }
    let place = Place::new();
    place.write("screen.log", &log);
    let device = |driver: &str, name: &str, address: u32, keys: &str| {
        format!(
            "[[bus.device]]\ndriver = {driver:?}\nname = {name:?}\naddress = {address}\n{keys}\n"
        )
    };
    let joint = |name: &str| format!("[[bus.device.joint]]\nname = {name:?}");
    let scales = "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]";
    let drive = format!("velocity_unit = \"0.1 rpm\"\n{}", joint("elbow"));
    let config = [
        "schema = 1\nrobot = \"mixed\"\n[[bus]]\nname = \"can0\"\n\
         source = { kind = \"socketcan\", interface = \"can0\" }\n"
            .to_owned(),
        device("ati_netcanoem", "wrist", 0x3F, ""),
        device("canopen_drive", "drive", 5, &drive),
        device("canopen_encoder", "encoder", 9, &joint("shoulder")),
        device("icub_strain", "ankle", 1, scales),
    ]
    .concat();
    place.write("gateway.toml", &config);
    let told = place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "screen.log",
            "--out",
            "s.csv",
            "--all",
            "--json",
        ])
        .good()
        .json();
    for device in told["devices"].as_array().unwrap() {
        assert!(device["refusal"].is_null(), "{device}");
    }
    let samples = table(&place.read("s.csv"));
    let column = |name: &str| {
        let values = samples[name].iter().copied().filter(|v| !v.is_nan());
        values.collect::<Vec<_>>()
    };
    let truth = |lines: &[&str], who: &str, at: usize, unit: f64| {
        let rows = lines.iter().filter_map(|line| line.strip_prefix(who));
        let number = |row: &str| row.split(' ').nth(at).unwrap().parse::<f64>().unwrap();
        rows.map(|row| number(row) * unit).collect::<Vec<_>>()
    };
    let turn = std::f64::consts::TAU;
    for (name, right) in [
        ("wrench/wrist/fx", truth(&ati, "wrench ", 0, 1.0)),
        ("wrench/wrist/tz", truth(&ati, "wrench ", 5, 1.0)),
        (
            "joint/elbow/position",
            truth(&canopen, "drive ", 0, turn / 10_000.0),
        ),
        ("joint/elbow/torque", truth(&canopen, "drive ", 2, 0.88e-3)),
        (
            "joint/shoulder/position",
            truth(&canopen, "encoder ", 0, turn / 3600.0),
        ),
    ] {
        let read = column(name);
        assert_eq!(read.len(), right.len(), "{name}");
        for (a, b) in read.iter().zip(&right) {
            assert!((a - b).abs() <= 1e-9 * b.abs().max(1.0), "{name}: {a} {b}");
        }
    }
    let ankle = column("wrench/ankle/fx");
    assert!(
        ankle.len() > 10 && (ankle[0] - 12.498).abs() < 1e-3,
        "{ankle:?}"
    );
}

/// A candump log in its other formats.
fn formats(log: &str) -> Vec<(&'static str, bool, String)> {
    let parsed: Vec<(&str, &str, &str, &str)> = log
        .lines()
        .map(|line| {
            let (stamp, rest) = line.strip_prefix('(').unwrap().split_once(") ").unwrap();
            let (interface, frame) = rest.split_once(' ').unwrap();
            let (id, data) = frame.split_once('#').unwrap();
            (stamp, interface, id, data)
        })
        .collect();
    let screen = |data: &str| {
        let bytes: Vec<&str> = (0..data.len() / 2)
            .map(|i| &data[2 * i..2 * i + 2])
            .collect();
        format!("  [{}]  {}", bytes.len(), bytes.join(" "))
    };
    let text = |line: &dyn Fn(usize, &str, &str, &str, &str) -> String| {
        parsed
            .iter()
            .enumerate()
            .fold(String::new(), |text, (i, (t, interface, id, data))| {
                text + &line(i, t, interface, id, data) + "\n"
            })
    };
    let nanos = |stamp: &str| Nanos::parse_seconds(stamp).unwrap();
    let first = nanos(parsed[0].0);
    vec![
        ("log", true, log.to_owned()),
        (
            "log with directions (-x)",
            true,
            text(&|i, t, n, id, d| {
                format!("({t}) {n} {id}#{d} {}", if i % 7 == 0 { "T" } else { "R" })
            }),
        ),
        (
            "screen, absolute (-t a)",
            true,
            text(&|_, t, n, id, d| format!(" ({t})  {n}  {id} {}", screen(d))),
        ),
        (
            "screen, date (-t A)",
            true,
            text(&|_, t, n, id, d| format!(" ({})  {n}  {id} {}", date(t), screen(d))),
        ),
        (
            "screen, since the first (-t z)",
            false,
            text(&|_, t, n, id, d| {
                format!(" ({})  {n}  {id} {}", short(nanos(t) - first), screen(d))
            }),
        ),
        (
            "screen, since the line before (-t d)",
            false,
            text(&|i, t, n, id, d| {
                let before = nanos(parsed[i.saturating_sub(1)].0);
                format!(" ({})  {n}  {id} {}", short(nanos(t) - before), screen(d))
            }),
        ),
        (
            "screen, without stamps",
            false,
            text(&|_, _, n, id, d| format!("  {n}  {id} {}", screen(d))),
        ),
        (
            "screen, with text (-a)",
            false,
            text(&|_, _, n, id, d| {
                format!("  {n}  {id} {}   '{}'", screen(d), ".".repeat(d.len() / 2))
            }),
        ),
        (
            "with comments and blank lines",
            true,
            format!("# recorded by hand\n\n{log}\n"),
        ),
        ("lines of another system", true, log.replace('\n', "\r\n")),
    ]
}

/// Short stamps as candump writes them: three digits of seconds.
fn short(t: Nanos) -> String {
    format!("{:03}.{:09}", t.0 / 1_000_000_000, t.0 % 1_000_000_000)
}

/// A stamp of the first days of 1970 in candump's date format.
fn date(stamp: &str) -> String {
    let t = Nanos::parse_seconds(stamp).unwrap();
    let (s, ns) = (t.0 / 1_000_000_000, t.0 % 1_000_000_000);
    assert!(s < 28 * 86400);
    format!(
        "1970-01-{:02} {:02}:{:02}:{:02}.{ns:09}",
        1 + s / 86400,
        s / 3600 % 24,
        s / 60 % 60,
        s % 60
    )
}

#[test]
fn every_candump_format_gives_the_same_samples() {
    let place = Place::new();
    let log = session(1.0, &SimulationSettings::default());
    let decode = |text: &str| {
        place
            .run_with(
                &[
                    "decode",
                    "--config",
                    "gateway.toml",
                    "--log",
                    "-",
                    "--out",
                    "-",
                    "--json",
                ],
                text.as_bytes(),
            )
            .good()
    };
    let reference = decode(&log).out;
    assert!(reference.lines().count() > 1000);
    // Per column, its values in order: every format must give these, apart from the stamps.
    let values = |csv: &str| {
        let mut columns = table(csv);
        columns.remove("t");
        columns
            .into_values()
            .map(|c| {
                c.into_iter()
                    .filter(|v| !v.is_nan())
                    .map(f64::to_bits)
                    .collect()
            })
            .collect::<Vec<Vec<u64>>>()
    };
    let wanted = values(&reference);
    for (name, absolute, text) in formats(&log) {
        let ran = decode(&text);
        let told: Json = serde_json::from_str(ran.err.lines().last().unwrap()).unwrap();
        assert_eq!(told["bad_lines"], 0, "{name}: {}", ran.err);
        if absolute {
            assert!(ran.out == reference, "{name}: not the same table");
        } else {
            assert!(values(&ran.out) == wanted, "{name}: not the same values");
        }
        let stamps = &table(&ran.out)["t"];
        assert_eq!(
            name.contains("since"),
            !absolute && stamps.iter().all(|t| !t.is_nan()),
            "{name}: stamps"
        );
        if name.contains("since") {
            let whole = table(&reference);
            assert!(
                stamps
                    .iter()
                    .zip(&whole["t"])
                    .all(|(a, b)| ((a - stamps[0]) - (b - whole["t"][0])).abs() < 1e-9),
                "{name}: the same times between samples"
            );
        }
    }
}

#[test]
fn estimates_from_files_are_those_of_other_libraries() {
    let place = Place::new();
    let no_offsets = [
        ("offset_n = [6.0, -4.0, 11.0]", "offset_n = [0.0, 0.0, 0.0]"),
        (
            "offset_nm = [0.2, -0.35, 0.1]",
            "offset_nm = [0.0, 0.0, 0.0]",
        ),
    ];
    place.change("estimator.toml", "imu.toml", &no_offsets);
    let fixed = [
        (
            "kind = \"imu\"\nsensor = \"chest_imu\"\nlink = \"chest_imu_frame\"",
            "kind = \"fixed\"\nlink = \"chest\"\ngravity_mps2 = [0.0, 0.0, -9.80665]",
        ),
        (
            "[[contact]]\nname = \"stand\"        # the ground reaction\nlink = \"chest\"\n",
            "",
        ),
    ];
    place.change("imu.toml", "fixed.toml", &fixed);
    for log in [
        "icub_left_arm_mujoco.csv",
        "icub_left_arm_mujoco_contact.csv",
    ] {
        let text = oracle(log);
        let truth = table(&text);
        for config in ["imu.toml", "fixed.toml"] {
            place.write("log.csv", &text);
            let told = place
                .run(&[
                    "estimate", "--config", config, "--log", "log.csv", "--out", "e.csv", "--json",
                ])
                .good()
                .json();
            assert_eq!(
                (&told["estimates"], &told["torques_withheld"]),
                (&201.into(), &0.into()),
                "{told}"
            );
            let estimates = table(&place.read("e.csv"));
            assert_eq!(estimates["t"], truth["t"]);
            let mut compared = 0;
            let mut check = |estimated: &str, expected: Option<&Vec<f64>>| {
                for (row, value) in estimates[estimated].iter().enumerate() {
                    let expected = expected.map_or(0.0, |e| e[row]);
                    assert!(
                        (value - expected).abs() < 1e-9 * (1.0 + expected.abs()),
                        "{log}, {config}, {estimated}, row {row}: {value}, not {expected}"
                    );
                    compared += 1;
                }
            };
            for name in truth
                .keys()
                .filter_map(|n| n.strip_prefix("joint/")?.strip_suffix("/torque"))
            {
                check(
                    &format!("torque/{name}"),
                    truth.get(&format!("joint/{name}/torque")),
                );
                assert!(
                    estimates[&format!("valid/{name}")]
                        .iter()
                        .all(|v| *v == 1.0)
                );
                assert!(
                    estimates[&format!("torque_std/{name}")]
                        .iter()
                        .all(|s| *s > 0.0 && *s < 1.0)
                );
            }
            for part in ["fx", "fy", "fz", "tx", "ty", "tz"] {
                let name = format!("contact/hand/{part}");
                check(&name, truth.get(&name));
            }
            assert_eq!(compared, 201 * 13);
        }
    }
}

/// Parameters with the sensor's offsets and a hand that is a kilogram heavier than in the URDF.
fn parameters_file() -> String {
    use proprio_dynamics::spatial;
    use proprio_estimator::parameters::{Offset, Parameters, Provenance};
    use proprio_estimator::setup::Setup;
    let robot = SimulatedRobot::open("icub_left_arm").expect("the robot of the source tree");
    let setup = Setup::new(&robot.config).expect("its model");
    let (link, mut inertia) = (
        setup.robot.model.inertias().len() - 1,
        setup.robot.model.inertias()[setup.robot.model.inertias().len() - 1],
    );
    inertia.mass += 1.0;
    let offset = Offset {
        sensor: "l_arm_ft_sensor".into(),
        reading: spatial::Wrench::zero(),
        drift: spatial::Wrench::zero(),
        known: Nanos::ZERO,
        noise: spatial::Wrench::zero(),
        calibrated: None,
    };
    let provenance = Provenance {
        program: "proprio test".into(),
        ..Provenance::default()
    };
    let mut parameters = Parameters::new(&setup.robot, provenance);
    // They have no uncertainty.
    let root = parameters.root().resize(0, 16, 0.0);
    parameters
        .set_identified(&[(link, inertia)], &[offset], &root)
        .expect("a body that can exist");
    parameters.to_string()
}

#[test]
fn identified_parameters_take_the_place_of_the_urdfs() {
    let place = Place::new();
    place.write("log.csv", &oracle("icub_left_arm_mujoco.csv"));
    place.write("p.toml", &parameters_file());
    let estimate = |more: &[&str]| {
        let args = [
            "estimate",
            "--config",
            "estimator.toml",
            "--log",
            "log.csv",
            "--out",
            "e.csv",
        ];
        place.run(&[&args[..], more].concat()).good();
        table(&place.read("e.csv"))
    };
    let mean = |estimates: &BTreeMap<String, Vec<f64>>, column: &str| {
        estimates[column].iter().sum::<f64>() / estimates[column].len() as f64
    };
    let (plain, with) = (estimate(&[]), estimate(&["--parameters", "p.toml"]));
    let force = |estimates: &BTreeMap<String, Vec<f64>>| {
        let parts = ["fx", "fy", "fz"].map(|part| mean(estimates, &format!("contact/hand/{part}")));
        parts.iter().map(|x| x * x).sum::<f64>().sqrt()
    };
    // The golden log has no offsets, and the file's are zero: the wrench at the hand then shows the
    // weight of the additional kilogram.
    let felt = force(&with);
    assert!((felt - 9.8).abs() < 1.5, "{felt}");
    assert!(force(&plain) > 12.0, "the offsets of estimator.toml");
    // The configuration may name the file; the daemon reports it.
    place.change(
        "estimator.toml",
        "named.toml",
        &[(
            "model = \"model.urdf\"",
            "model = \"model.urdf\"\nparameters = \"p.toml\"",
        )],
    );
    let check = place
        .run(&["estimator", "--config", "named.toml", "--check"])
        .good()
        .out;
    assert!(
        check.contains("inertial parameters: identified by proprio test: 1 of 9 links"),
        "{check}"
    );
    assert!(
        check.contains("the URDF's, taken as known to 20 %: "),
        "{check}"
    );
    let check = place
        .run(&["estimator", "--config", "estimator.toml", "--check"])
        .good()
        .out;
    assert!(
        check.contains("inertial parameters: the URDF's, taken as known to 20 %"),
        "{check}"
    );
    place
        .run(&[
            "estimate",
            "--config",
            "named.toml",
            "--log",
            "log.csv",
            "--out",
            "named.csv",
        ])
        .good();
    assert!(
        place.read("named.csv") == place.read("e.csv"),
        "the same as by --parameters"
    );
}

// ---------------------------------------------------------------- processes

#[test]
fn a_second_gateway_or_estimator_is_refused_by_the_first_ones_number() {
    let place = Place::new();
    for (verb, config) in [("gateway", "gateway.toml"), ("estimator", "estimator.toml")] {
        let mut first = place.start(&[verb, "--config", config]);
        until(PATIENCE, || first.log().contains("running").then_some(()))
            .unwrap_or_else(|| panic!("{verb}: {}", first.log()));
        let number = format!("process {}", first.id());
        place.run(&[verb, "--config", config]).fails(
            1,
            &[&number, "only one gateway and one estimator per robot"],
        );
        first.assert_runs();
        // A gateway of another robot or in another domain is permitted.
        place.change(
            config,
            "other.toml",
            &[("robot = \"icub_left_arm\"", "robot = \"other\"")],
        );
        if verb == "gateway" {
            // On separate buses.
            place.change(
                "other.toml",
                "other.toml",
                &[
                    ("name = \"left_arm\" }", "name = \"other\" }"),
                    ("name = \"left_arm_motors\" }", "name = \"other_motors\" }"),
                ],
            );
        }
        for args in [
            &[verb, "--config", "other.toml"][..],
            &[verb, "--config", config, "--domain", "elsewhere"],
        ] {
            let mut other = place.start(args);
            until(PATIENCE, || other.log().contains("running").then_some(()))
                .unwrap_or_else(|| panic!("{args:?}: {}", other.log()));
            other.end();
        }
        // SIGTERM ends it with success and a log line.
        first.end();
        assert!(first.log().contains("SIGTERM"), "{}", first.log());
        // After its end, its place is free.
        let mut next = place.start(&[verb, "--config", config]);
        until(PATIENCE, || next.log().contains("running").then_some(()))
            .unwrap_or_else(|| panic!("{verb}: {}", next.log()));
        next.end();
    }
    let left: Vec<_> = place
        .rig
        .domain
        .base
        .read_dir()
        .into_iter()
        .flatten()
        .flatten()
        .map(|e| e.path())
        .collect();
    assert!(left.is_empty(), "left over: {left:?}");
}

#[test]
fn the_simulator_tells_what_it_did_as_json() {
    let place = Place::new();
    let ran = place
        .run(&[
            "simulate",
            "--seconds",
            "0.5",
            "--truth",
            "truth.csv",
            "--fault",
            "lost:0.1",
            "--json",
        ])
        .good();
    let told = ran.json();
    let push = "link l_hand is pushed at contact hand with up to 10 N and 0.3 Nm, from 0.2 s to \
                0.3 s; nobody declares it (--skin does)";
    assert!(ran.err.contains(push), "{}", ran.err);
    assert!(
        told["sent"].as_u64().unwrap() > 500 && told["lost_on_request"].as_u64().unwrap() > 20,
        "{told}"
    );
    assert_eq!(told["truth_rows"], 501);
    assert_eq!(table(&place.read("truth.csv"))["t"].len(), 501);
    // It runs until it is stopped.
    let mut process = place.start(&["simulate", "--json"]);
    until(PATIENCE, || {
        process.log().contains("is powered on").then_some(())
    })
    .unwrap_or_else(|| panic!("{}", process.log()));
    process.end();
    let log = process.log();
    assert!(log.contains("from 8 s to 12 s of every 20 s"), "{log}");
    let calm = place.run(&["simulate", "--seconds", "0.2", "--no-push"]);
    let calm = calm.good();
    assert!(!calm.err.contains("pushed"), "{}", calm.err);
    assert!(
        serde_json::from_str::<Json>(&process.output()).is_ok(),
        "{}",
        process.output()
    );
}

/// The prefixes of the segments that process `id` has mapped, one per shared-memory domain.
fn domains_of(id: u32) -> BTreeSet<String> {
    let maps = fs::read_to_string(format!("/proc/{id}/maps")).unwrap_or_default();
    maps.lines()
        .filter_map(|l| {
            Some(
                l.split_once("/dev/shm/proprio_")?
                    .1
                    .split_once('_')?
                    .0
                    .to_owned(),
            )
        })
        .collect()
}

/// Asserts that an ended demonstration left only its results: no other file, no segment, no
/// process.
fn assert_clean(place: &Place, domains: &BTreeSet<String>) {
    let left: Vec<_> = fs::read_dir(place.path("tmp"))
        .unwrap()
        .flatten()
        .map(|e| e.path())
        .collect();
    assert!(left.is_empty(), "temporary files: {left:?}");
    let segments = fs::read_dir("/dev/shm")
        .unwrap()
        .flatten()
        .map(|e| e.file_name().to_string_lossy().into_owned());
    let left: Vec<String> = segments
        .filter(|s| domains.iter().any(|d| s.contains(d.as_str())))
        .collect();
    assert!(left.is_empty(), "segments: {left:?}");
    let folder = place
        .path("")
        .to_string_lossy()
        .trim_end_matches('/')
        .to_owned();
    let processes = fs::read_dir("/proc").unwrap().flatten().filter_map(|e| {
        let line = fs::read(e.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).replace('\0', " ");
        line.contains(&folder).then_some(line)
    });
    assert_eq!(processes.collect::<Vec<_>>(), [""; 0]);
}

/// Runs a demonstration of `seconds`; returns its summary.
fn demo(place: &Place, seconds: f64, more: &[&str]) -> Json {
    demo_of(7, place, seconds, more)
}

/// As [`demo`], of a robot with so many joints.
fn demo_of(joints: usize, place: &Place, seconds: f64, more: &[&str]) -> Json {
    let number = seconds.to_string();
    let args = [&["demo", "--seconds", &number, "--out", "d"], more].concat();
    let mut process = place.start(&args);
    let mut domains = BTreeSet::new();
    let status = until(PATIENCE + PATIENCE, || {
        if domains.is_empty() {
            domains = domains_of(process.id());
        }
        process.ended()
    });
    let status = status.unwrap_or_else(|| panic!("{args:?} does not end: {}", process.log()));
    assert!(status.success(), "{args:?}: {status}: {}", process.log());
    assert_eq!(domains.len(), 1, "its domain was seen");
    assert_clean(place, &domains);
    for name in [
        "report.html",
        "estimates.csv",
        "cad.urdf",
        "estimator.toml",
        "gateway.log",
        "estimator.log",
        "simulate.log",
    ] {
        assert!(
            fs::metadata(place.path("d").join(name)).is_ok_and(|m| m.is_file()),
            "{name}"
        );
    }
    let report = place.read("d/report.html");
    assert!(
        report.starts_with("<!doctype html>") && report.contains("<svg") && !report.contains("NaN")
    );
    for outside in ["http://", "https://", "src=", "<script"] {
        // The SVG name space is only a name and is not fetched.
        assert!(
            !report
                .replace("http://www.w3.org/2000/svg", "")
                .contains(outside),
            "the report stands alone: {outside}"
        );
    }
    let text = process.output();
    assert!(
        !text.contains('\x1b') && text.contains("RMS error"),
        "no terminal, no escape sequences: {text}"
    );
    let summary: Json = serde_json::from_str(&place.read("d/summary.json")).unwrap();
    for key in ["frames", "samples", "lost", "estimates"] {
        assert!(summary[key].is_u64(), "{key}: {summary}");
    }
    for key in ["rate_hz", "valid_share"] {
        assert!(summary[key].is_f64(), "{key}: {summary}");
    }
    for key in ["p50", "p99", "p999"] {
        assert!(
            summary["latency_us"][key].as_f64().is_some_and(|l| l > 0.0),
            "{key}: {summary}"
        );
    }
    assert_eq!(
        summary["torque_rms_error_nm"].as_object().unwrap().len(),
        joints,
        "{summary}"
    );
    let rows = table(&place.read("d/estimates.csv"))["t"].len();
    assert_eq!(summary["estimates"], rows, "the table holds them all");
    // Where a push begins and ends, an estimate or two; that is less than one of a thousand.
    let untrue = summary["untrue_estimates"].as_object().unwrap();
    let sum: u64 = untrue.values().map(|count| count.as_u64().unwrap()).sum();
    assert_eq!(untrue.len(), joints, "{summary}");
    assert!(
        1000 * sum <= (rows * joints) as u64,
        "valid torques are true: {summary}"
    );
    summary
}

/// The reasons in a table of estimates, with their counts.
fn reasons(place: &Place) -> BTreeMap<String, usize> {
    let text = place.read("d/estimates.csv");
    let names: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    let of = |part: &str| {
        (0..names.len())
            .filter(|i| names[*i].starts_with(part))
            .collect::<Vec<_>>()
    };
    let (valid, reason, torque) = (of("valid/"), of("reason/"), of("torque/"));
    let mut counts = BTreeMap::new();
    for line in text.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        for ((valid, reason), torque) in valid.iter().zip(&reason).zip(&torque) {
            assert_eq!(
                cells[*valid] == "1",
                cells[*reason].is_empty(),
                "withheld with a reason, and only then: {line}"
            );
            assert_eq!(cells[*valid] == "1", !cells[*torque].is_empty(), "{line}");
            if !cells[*reason].is_empty() {
                *counts.entry(cells[*reason].to_owned()).or_default() += 1;
            }
        }
    }
    counts
}

/// Whether the machine let the processes of a demonstration keep up. If not, samples are late or
/// lost, and torques are withheld as they must be: then nothing can be said of their share.
fn has_kept_up(summary: &serde_json::Value) -> bool {
    let buses = summary["simulator"]["buses"].as_array().unwrap();
    let in_time = buses.iter().all(|bus| bus["skipped"] == 0);
    let has_kept_up = in_time && summary["latency_us"]["p99"].as_f64().unwrap() < 1000.0;
    if !has_kept_up {
        println!("this machine is busy, so shares and reasons are not compared: {summary}");
    }
    has_kept_up
}

#[test]
fn a_demonstration_ends_well_and_leaves_nothing_behind() {
    let place = Place::new();
    let summary = demo(&place, 12.0, &["--seed", "4"]);
    let has_kept_up = has_kept_up(&summary);
    assert_eq!(summary["seed"], 4);
    browse(&place.path("d/report.html"));
    if has_kept_up {
        assert_eq!(summary["lost"], 0, "{summary}");
        // Until motion has confirmed the setup, torques are uncertain and withheld.
        assert!(summary["valid_share"].as_f64().unwrap() > 0.1, "{summary}");
    }
    // Their figures rest on the valid ones alone.
    for (joint, error) in summary["torque_rms_error_nm"].as_object().unwrap() {
        let count = summary["valid_estimates"][joint].as_u64().unwrap();
        assert_eq!(count == 0, error.is_null(), "{joint}: {summary}");
        assert!(
            error.is_null() || error.as_f64().unwrap() < 0.4,
            "{joint}: {summary}"
        );
    }
    let verdict = summary["verdict"].as_str().unwrap();
    assert!(
        summary["worked"].is_null() && verdict.starts_with("Too short to tell"),
        "{verdict}"
    );
    let identification = &summary["identification"];
    assert!(
        identification["after"].is_null() && identification["settled_since_s"].is_null(),
        "{summary}"
    );
    assert!(
        identification["moving_since_s"].as_f64().unwrap() < 3.1,
        "{summary}"
    );
    assert_eq!(
        identification["learning"]["cad"].as_object().unwrap().len(),
        7,
        "{summary}"
    );
    let expected = |reason: &String| {
        let words = ["starting", "stale", "implausible"];
        reason == "uncertain" || words.iter().any(|word| reason.starts_with(word))
    };
    assert!(
        !has_kept_up || reasons(&place).keys().all(expected),
        "{:?}",
        reasons(&place)
    );
}

/// CANopen drives that measure at the gateway's SYNC beside a polled sensor, and moteus controllers
/// that are asked on CAN FD: all devices stream, no frame is lost, and torques are estimated. With
/// the right masses they are near the truth, if the machine lets the simulated boards answer in
/// time.
#[test]
fn a_demonstration_of_other_boards_ends_well() {
    // About three times the errors on a machine that does nothing else: 0.27 and 0.011 Nm.
    for (robot, joints, limit) in [("six_axis_arm", 6, 0.8), ("moteus_leg", 3, 0.03)] {
        let place = Place::new();
        let more = ["--robot", robot, "--seed", "4", "--cad-error", "0"];
        let summary = demo_of(joints, &place, 12.0, &more);
        let log = place.read("d/gateway.log");
        assert!(log.matches("INFO streaming").count() > joints, "{log}");
        assert!(!log.contains("panicked"), "{log}");
        if !has_kept_up(&summary) {
            continue;
        }
        assert_eq!(summary["lost"], 0, "{summary}");
        // From about four seconds of motion on, and while nothing is declared to push.
        assert!(summary["valid_share"].as_f64().unwrap() > 0.1, "{summary}");
        for (joint, error) in summary["torque_rms_error_nm"].as_object().unwrap() {
            // Withheld throughout in so short a run: no figure.
            let Some(error) = error.as_f64() else {
                continue;
            };
            assert!(error < limit, "{robot} {joint}: {summary}");
        }
    }
}

/// A robot at rest whose boards measure velocities, and positions with the jitter of the gears: no
/// motion that contains information about masses.
#[test]
fn an_arm_that_stands_still_learns_nothing_of_its_masses() {
    let place = Place::new();
    let settings = SimulationSettings {
        still: 20.0,
        push: false,
        ..SimulationSettings::default()
    };
    place.write("still.log", &session(10.0, &settings));
    place
        .run(&[
            "decode",
            "--config",
            "gateway.toml",
            "--log",
            "still.log",
            "--out",
            "still.csv",
        ])
        .good();
    let hand = "link = \"l_hand\"\n";
    place.change(
        "estimator.toml",
        "learning.toml",
        &[
            (
                hand,
                &format!("{hand}presence = \"possible\"\n[identification]\nenabled = true\n"),
            ),
            ("[output]\n", "[output]\nmax_torque_std_nm = 1e6\n"),
        ],
    );
    place
        .run(&[
            "estimate",
            "--config",
            "learning.toml",
            "--log",
            "still.csv",
            "--out",
            "e.csv",
        ])
        .good();
    let estimates = table(&place.read("e.csv"));
    let at = |column: &str, t: f64| {
        let row = estimates["t"]
            .iter()
            .position(|x| *x > T0.seconds() + t)
            .unwrap();
        estimates[column][row]
    };
    // Nothing shows that the setup is as configured, so there is no torque, however uncertain.
    for joint in ["l_elbow", "l_wrist_pitch", "l_shoulder_roll"] {
        let deviation = at(&format!("torque_std/{joint}"), 9.5);
        assert!(deviation.is_infinite(), "{joint}: {deviation}");
    }
}

#[test]
fn a_demonstration_learns_what_its_urdf_has_wrong() {
    let place = Place::new();
    let summary = demo(&place, 20.0, &[]);
    let identification = &summary["identification"];
    assert!(identification["refused"].is_null(), "{summary}");
    assert!(
        (identification["settled_since_s"].as_f64().unwrap() - 15.0).abs() < 1.0,
        "{summary}"
    );
    let share = |phase: &str, key: &str| identification[phase][key].as_f64().unwrap();
    // At rest nothing is identified, and nothing shows that the setup is as stated.
    assert_eq!(share("before", "valid_share"), 0.0, "{summary}");
    assert!(
        summary["valid_share"].as_f64().unwrap() >= 0.95,
        "{summary}"
    );
    assert!(share("after", "valid_share") >= 0.95, "{summary}");
    assert!(
        identification["solutions"].as_u64().unwrap() > 10,
        "{summary}"
    );
    let error = |phase: &str, whose: &str, joint: &str| {
        identification[phase][whose][joint].as_f64().unwrap()
    };
    // The wrist's links are light. On a busy machine, with late stamps, the noise is as large as
    // the CAD's error.
    for (joint, times, noise) in [
        ("l_elbow", 1.5, 0.01),
        ("l_wrist_prosup", 1.0, 0.03),
        ("l_wrist_pitch", 1.0, 0.03),
        ("l_wrist_yaw", 1.0, 0.03),
    ] {
        let (identified, cad) = (
            error("after", "identified", joint),
            error("after", "cad", joint),
        );
        assert!(identified < (cad / times).max(noise), "{joint}: {summary}");
        assert_eq!(identified, summary["torque_rms_error_nm"][joint]);
    }
    // The torques above the sensor depend on its reading, its offset and links that nobody
    // identifies: with the same offset, both are equally good.
    for joint in ["l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw"] {
        let [identified, cad] = ["identified", "cad"].map(|whose| error("after", whose, joint));
        assert!(identified < 0.16, "{joint}: {summary}");
        assert!((identified / cad - 1.0).abs() < 0.1, "{joint}: {summary}");
    }
    let verdict = summary["verdict"].as_str().unwrap();
    assert!(
        verdict.starts_with("It worked") && summary["worked"] != false,
        "{verdict}"
    );
    // The report shows it, in any browser. The URDF equals the robot's except for its inertias.
    let report = place.read("d/report.html");
    for part in [
        "onset of motion",
        "withheld",
        "pushed",
        "± 2σ",
        "Identified parameters",
        "l_hand: ",
    ] {
        assert!(report.contains(part), "{part}");
    }
    browse(&place.path("d/report.html"));
    let (cad, urdf) = (place.read("d/cad.urdf"), place.read("model.urdf"));
    assert_ne!(cad, urdf);
    for part in ["<joint", "<origin", "<limit", "<sensor"] {
        assert_eq!(
            cad.matches(part).count(),
            urdf.matches(part).count(),
            "{part}"
        );
    }
    assert!(place.read("d/estimator.toml").contains("cad.urdf"));
    // The output is complete: both daemons run with it.
    let [_, told] = ["gateway", "estimator"].map(|program| {
        let config = format!("d/{program}.toml");
        place.run(&[program, "--config", &config, "--check"]).good()
    });
    // The torques that were withheld before the motion, and why.
    let why = "l_shoulder_yaw, ";
    let line = told.out.lines().find(|line| line.contains(why));
    let line = line.unwrap_or_else(|| panic!("{}", told.out));
    assert!(
        line.contains("until a few seconds of motion have shown"),
        "{line}"
    );
}

#[test]
fn a_demonstration_with_faults_says_so() {
    let place = Place::new();
    // Every hundredth frame is lost: compensated and counted.
    let summary = demo(&place, 2.5, &["--fault", "lost:0.01"]);
    assert!(
        summary["simulator"]["lost_on_request"].as_u64().unwrap() > 20,
        "{summary}"
    );
    assert_eq!(
        summary["lost"], 0,
        "what never reached a bus was not lost on the way: {summary}"
    );
    // A motor board is silent for a second: the torques beyond it are withheld, with the board as
    // the cause.
    let summary = demo(&place, 12.0, &["--fault", "silent:l_elbow_motor@9..10"]);
    let share = summary["valid_share"].as_f64().unwrap();
    assert!(share > 0.2 && share < 0.95, "{summary}");
    let found = reasons(&place);
    assert!(found["stale:l_elbow"] > 100, "{found:?}");
    // A saturated force/torque sensor: its frozen values are not used as measurements.
    let summary = demo(&place, 12.0, &["--fault", "saturate:l_arm_ft_sensor@9..10"]);
    let share = summary["valid_share"].as_f64().unwrap();
    assert!(share > 0.2 && share < 0.95, "{summary}");
    let found = reasons(&place);
    assert!(found["saturated:l_arm_ft_sensor"] > 100, "{found:?}");
    // An undeclared push on the hand is detected while it lasts.
    demo(&place, 12.0, &["--fault", "push:l_hand=50@9..10"]);
    let table = place.read("d/estimates.csv");
    let column = |name: &str| {
        table
            .lines()
            .next()
            .unwrap()
            .split(',')
            .position(|own| own == name)
            .unwrap()
    };
    let (detected, told) = (
        column("contact/hand/detected"),
        column("residual/l_upper_arm/reason"),
    );
    let rows = table
        .lines()
        .skip(1)
        .map(|line| line.split(',').collect::<Vec<_>>());
    let seen: Vec<bool> = rows
        .map(|row| row[detected] == "1" && row[told] == "hand")
        .collect();
    let count = seen.iter().filter(|seen| **seen).count();
    assert!((700..1500).contains(&count), "{count} of {}", seen.len());
}

#[test]
fn an_interrupted_demonstration_takes_its_processes_with_it() {
    use nix::sys::signal::{Signal, kill};
    let place = Place::new();
    let mut process = place.start(&["demo", "--seconds", "60", "--out", "d"]);
    let mut domains = BTreeSet::new();
    until(PATIENCE, || {
        domains = domains_of(process.id());
        (!domains.is_empty() && place.exists("d/simulate.log")).then_some(())
    })
    .expect("the demonstration runs");
    kill(
        nix::unistd::Pid::from_raw(i32::try_from(process.id()).unwrap()),
        Signal::SIGTERM,
    )
    .unwrap();
    let status = until(PATIENCE, || process.ended()).expect("it ends");
    assert_eq!(status.code(), Some(1), "{}", process.log());
    assert!(process.log().contains("interrupted"), "{}", process.log());
    assert_clean(&place, &domains);
}

#[test]
fn the_machine_readable_summaries_of_files_are_json() {
    let place = Place::new();
    place.write("s.csv", &oracle("icub_left_arm_mujoco.csv"));
    for (args, keys) in [
        (
            &[
                "encode",
                "--config",
                "gateway.toml",
                "--samples",
                "s.csv",
                "--out",
                "s.log",
                "--json",
            ][..],
            &["frames", "samples", "refused", "rows", "bad_rows"][..],
        ),
        (
            &[
                "decode",
                "--config",
                "gateway.toml",
                "--log",
                "s.log",
                "--out",
                "d.csv",
                "--json",
            ],
            &["frames", "samples", "unclaimed", "bad_lines", "devices"],
        ),
        (
            &[
                "estimate",
                "--config",
                "estimator.toml",
                "--log",
                "d.csv",
                "--out",
                "e.csv",
                "--json",
            ],
            &["estimates", "rows", "late", "backward", "not_finite"],
        ),
    ] {
        let ran = place.run(args).good();
        assert_eq!(ran.out.lines().count(), 1, "{}", ran.out);
        let json = ran.json();
        for key in keys {
            assert!(!json[*key].is_null(), "{key}: {json}");
        }
    }
    // The library gives the same numbers.
    let robot = SimulatedRobot::open("icub_left_arm").unwrap();
    let report =
        offline::encode(&robot.plan, place.read("s.csv").as_bytes(), std::io::sink()).unwrap();
    assert_eq!((report.samples, report.table.rows), (201 * 9, 201));
}
