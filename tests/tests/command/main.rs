//! The `proprio` command from the user's side: help, exit codes, one clear message per error,
//! output files that are complete or absent, and the demonstration.

mod demo;
mod files;
mod formats;
mod logs;
mod mistakes;

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

    /// Estimates from a table; the summary.
    fn estimate(&self, log: &str, out: &str) -> Ran {
        let config = "estimator.toml";
        let args = [
            "estimate", "--config", config, "--log", log, "--out", out, "--json",
        ];
        self.run(&args).good()
    }

    /// Decodes a log of frames; the summary.
    fn decode(&self, log: &str, out: &str) -> Ran {
        let config = "gateway.toml";
        let args = [
            "decode", "--config", config, "--log", log, "--out", out, "--json",
        ];
        self.run(&args).good()
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

    /// Runs `proprio` with these words, which spaces separate, until it ends.
    fn line(&self, words: &str) -> Ran {
        self.run(&words.split_whitespace().collect::<Vec<_>>())
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
    let help = place.line("--help").good();
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
            let expected = [
                "is not installed",
                &format!("cargo install --path bridge/{verb}"),
            ];
            place.line(&format!("{verb} --help")).fails(1, &expected);
            continue;
        }
        let help = place.line(&format!("{verb} --help")).good();
        assert!(
            help.out.contains(&format!("Usage: proprio {verb}")),
            "{}",
            help.out
        );
        assert!(help.err.is_empty(), "{}", help.err);
        assert!(
            place
                .line(&format!("help {verb}"))
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
            let parts = option
                .trim_start()
                .split("  ")
                .filter(|part| !part.trim().is_empty())
                .count();
            assert!(parts >= 2, "{verb}: {option:?} says nothing");
        }
    }
    assert!(place.line("--version").good().out.starts_with("proprio "));
    let page = place.line("help unexplained").good();
    assert!(page.out.starts_with("## `unexplained`\n"), "{}", page.out);
    let script = place.line("completions bash").good();
    assert!(script.out.contains("identify"));
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

// ---------------------------------------------------------------- a machine that lacks something

/// A configuration with one bus on a kernel interface.
fn on_interface(place: &Place, name: &str) {
    let source = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\nsource = {{ kind = \"socketcan\", \
         interface = \"{name}\" }}\n"
    );
    place.write("can.toml", &source);
}

fn has_can() -> bool {
    use nix::sys::socket::{AddressFamily, SockFlag, SockType, socket};
    !matches!(
        socket(AddressFamily::Can, SockType::Raw, SockFlag::empty(), None),
        Err(nix::Error::EAFNOSUPPORT)
    )
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

/// The frames of two sessions that other implementations made, and lines of `who` among them.
fn sessions() -> (Vec<&'static str>, Vec<&'static str>) {
    let ati = include_str!("../../../drivers/tests/drivers/ati.txt");
    let canopen = include_str!("../../../drivers/tests/drivers/canopen.txt");
    (ati.lines().collect(), canopen.lines().collect())
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
    let columns = |part: &str| {
        (0..names.len())
            .filter(|i| names[*i].starts_with(part))
            .collect::<Vec<_>>()
    };
    let (valid, reason, torque) = (columns("valid/"), columns("reason/"), columns("torque/"));
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
