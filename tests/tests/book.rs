//! The commands of the book, run as a new user types them: page after page, in one folder, on
//! simulated robots. Every line of a block of the shell is run, and what only the text names is
//! run with the same options somewhere. [`TABLE`] says what a line must show, what takes the place
//! of a part of it (another bus, a shorter time), and which test runs it if this one cannot.
#![allow(missing_docs)]

use proprio_tests::terminal::Terminal;
use proprio_tests::{Process, Rig, now, until};
use proprio_topics::Nanos;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// `== PAGE` begins the rows of a page. A row begins with the beginning of a line of one of its
/// blocks, or with words of its text: a command, or what is done by hand. Without a row a line of
/// `proprio` or `cp` must end with success, daemons must start. Below a row:
///
/// | words | what they mean |
/// |---|---|
/// | `as A => B` | B is typed for A |
/// | `shows A` | it must show A; until it does, it is run again |
/// | `block` | it must show the page's first block of text, but for numbers |
/// | `fails A` | it ends with 1, and says A |
/// | `computes` | it takes its time: it must end with success until the end of the test |
/// | `by hand A` | the function of this name does what the text tells |
/// | `elsewhere A: B: C` | not here, but by file A, which has the text B, because of C |
/// | `nowhere C` | not at all, because of C |
const TABLE: &str = r#"
== index.md
proprio help max_silence_ms
    shows proprio help input.max_silence_ms
proprio help canopen_drive
    shows TPDO
proprio help unexplained
    shows Neither the model nor
proprio help identify
    shows --validate
proprio help topics
    shows Signs, and the wrench to expect

== first.md
proprio demo
    elsewhere tests/tests/command/demo.rs: fn a_demonstration_ends_well: needs the machine alone
proprio status
    shows device l_elbow_motor streaming
    shows estimates/s
proprio top
    shows TORQUES  7 of 7 valid
proprio echo --torques l_elbow --count 5
    shows +-
proprio echo l_arm_ft_sensor --count 5
    shows wrench fx
proprio simulate --robot config/icub_left_arm --fault
    as @20..25 => @3..10
proprio why l_wrist_yaw
    shows is withheld
    shows l_elbow_motor
proprio simulate --help
    shows still:JOINT
sed -i
proprio simulate --no-push
    as --no-push => --no-push --robot config/icub_left_arm
proprio record --out a.csv
    as 30 => 10
proprio record --out b.csv
    as 15 => 5
proprio identify
    shows no better than the CAD
    shows parameters.toml

== commissioning/excite.md
proprio excite --config my_arm/estimator.toml --out
    as --out => --seconds 4 --out
    block
proprio excite --config my_arm/estimator.toml --joint
    as 20 => 4
    computes
proprio excite --config my_arm/estimator.toml --parameters
    as --out => --seconds 4 --out
    computes

== commissioning/identifiable.md
proprio identifiable config/icub_left_arm/model.urdf --sensors
    shows 44 combinations of 96
proprio identifiable config/icub_left_arm/model.urdf --base
    shows F/T sensors in l_arm_ft_sensor, l_wrist_yaw
proprio identifiable --config config/icub_left_arm/estimator.toml --absent hand
    block
proprio identifiable --config config/icub_left_arm/estimator.toml --absent hand --joint
    shows l_hand.m

== commissioning/identification.md
proprio identify --config my_arm/estimator.toml --samples a.csv
    as --samples b.csv =>
    as c.csv => b.csv
    as --out result => --out again
    computes
proprio identify --config my_arm/estimator.toml --samples with.csv
    as with.csv => b.csv
    computes
proprio decode
    as proprio => proprio encode --config my_arm/gateway.toml --samples b.csv --out b.log; proprio
    as decode => decode --config my_arm/gateway.toml --log b.log --out decoded.csv

== read/c.md
cargo build
    elsewhere tests/tests/ffi.rs: lib/libproprio.a: builds for minutes
sudo PROPRIO_LIBRARIES
    elsewhere tests/tests/ffi.rs: ffi/install: needs root
sudo ldconfig
    elsewhere tests/tests/ffi.rs: ffi/install: needs root
cc loop.c
    elsewhere tests/tests/ffi.rs: read/c.md: needs the installed library
c++
    elsewhere tests/tests/ffi.rs: read/c.md: needs the installed library

== read/python.md
pip install
    elsewhere tests/run: ./python || return 1: builds for minutes

== read/ros2.md
cargo install
    elsewhere tests/run: bridge/$name/Cargo.toml: a workspace of its own
proprio ros2
    elsewhere bridge/ros2/tests/conftest.py: proprio-ros2: a workspace of its own
ros2 topic list
    elsewhere bridge/ros2/tests/listen.py: topic: a program of ROS 2
ros2 topic echo
    elsewhere bridge/ros2/tests/test_values.py: joint_states: a program of ROS 2
ros2 topic hz
    elsewhere bridge/ros2/tests/test_values.py: ft/l_arm_ft_sensor: a program of ROS 2
ros2 run
    nowhere a program of ROS 2

== read/viewers.md
cargo install
    elsewhere tests/run: bridge/$name/Cargo.toml: a workspace of its own
proprio view
    elsewhere bridge/view/tests/test_view.py: "--config": a workspace of its own

== watch.md
proprio echo l_elbow
    shows joint position
proprio echo --torques
    shows l_wrist_yaw
proprio ctl devices
    shows icub_strain, address 13 on left_arm
sudo -u proprio proprio status
    as sudo -u proprio proprio => proprio
proprio status --json
    shows "gateway"

== recordings.md
proprio record --out run.mcap
    as run.mcap => run.mcap --config config/icub_left_arm/estimator.toml --seconds 3
proprio record --ring
    as /var/lib/proprio/box => box
    as /etc/proprio => config/icub_left_arm
proprio ctl snapshot
The file is named after the robot
    by hand snapshot
proprio estimate --samples FILE
    as FILE => run.mcap --out run.csv

== troubleshooting/why.md
proprio why l_elbow
    shows l_elbow is valid
    shows it rests on
proprio why l_elbow --samples
    as black_box => run
    shows it rests on
proprio table --estimates
    as --estimates => --estimates --recording run.mcap --out estimates.csv

== troubleshooting/machine.md
proprio doctor
    shows virtual bus
    shows real-time

== reference/commands.md
source <(proprio completions bash)
    as source <( =>
    as ) =>
    shows _proprio

== commissioning/steps.md
sudo ip link set can0
    elsewhere tests/tests/vcan/main.rs: fn interfaces_go_and_come_back: needs root and CAN
proprio doctor
    shows CAN interfaces
proprio scan --bus can0
    as can0 => virtual:drives --seconds 0.3
    shows nothing was sent
proprio scan --bus can0 --active
    as can0 => virtual:drives --seconds 0.3
    shows canopen_drive_6
proprio scan --bus virtual:drives
    as --active => --active --seconds 0.5
    shows canopen_drive_1
proprio scan --bus virtual:sensor
    as --ask => --seconds 0.5 --ask
    shows ATI sensor at a NETCANOEM board
proprio setup --out robot --robot my_robot
    as --out robot => --out mine --bus virtual:drives --seconds 0.3
    shows mine/gateway.toml is written
proprio setup --out robot --robot six_axis_arm
    as --ask => --seconds 0.5 --ask
    shows robot/gateway.toml is written: fill in what is marked
Fill in what it marks, and remove these comments
    by hand fill in
cp
Then write `robot/estimator.toml`. The smallest one:
    by hand estimator.toml
proprio gateway --config robot/gateway.toml --check
    shows wrench base_ft
    shows joint joint_6
proprio estimator --config robot/estimator.toml --check --gateway
    shows mass of all links: 38.200 kg
    shows its offset is not known
    shows robot/gateway.toml publishes all channels
proprio status
    shows device base_ft streaming
proprio echo joint_2
    shows joint position 0.6
proprio ctl calibration
    shows matrix
proprio ctl tare
    fails this device has no such command
proprio estimator --config robot/estimator.toml --check
    shows the difference: force
Write it into estimator.toml
    by hand offsets
proprio top
    shows TORQUES  6 of 6 valid
proprio why joint_2
    shows joint_2 is valid
proprio simulate --robot config/six_axis_arm --no-push
Move the robot slowly. Torques must be there
    by hand valid
proprio record --out a.csv
    as 120 => 8
proprio record --out c.csv
    as 60 => 4
proprio identify
    shows accept
    shows parameters.toml
cp
name it there above the first table
    by hand parameters
proprio estimate
    shows F/T prediction error
sudo proprio install
    as sudo proprio install => proprio install --dry-run --root image
    shows etc/proprio/estimator.toml
sudo -u proprio proprio status
    as sudo -u proprio proprio => proprio

== commissioning/signs.md
proprio echo joint_2
    shows joint position
proprio simulate
from 0.6 to 1.2 rad is the positive direction
    by hand moved
proprio echo base_ft
    shows wrench fx
proprio estimator
    block
write `sign = -1` for `joint_3`
    by hand wrong sign

== commissioning/install.md
cargo build
    elsewhere tests/run: cargo build: builds for minutes
sudo target/release/proprio install
    as sudo target/release/proprio install => proprio install --dry-run --root image
    shows usr/local/bin/proprio
sudo -u proprio proprio status
    as sudo -u proprio proprio => proprio
cargo install cargo-deb
    elsewhere tests/run: cargo-deb --version: builds for minutes
cargo deb
    elsewhere tests/run: cargo deb --quiet: builds for minutes
sudo apt install
    elsewhere tests/tests/systemd.rs: PROPRIO_DEB: needs root and systemd
sudo proprio install
    elsewhere cli/tests/install.rs: fn what_a_package_has_installed: needs root and systemd

== figures/truth.md
cargo run
    elsewhere tests/tests/command/demo.rs: fn a_demonstration_with_faults: needs the machine alone

== ../../../README.md
cargo run
    elsewhere tests/tests/command/demo.rs: fn a_demonstration_ends_well: needs the machine alone
cargo install cargo-deb
    elsewhere tests/run: cargo-deb --version: builds for minutes
cargo deb
    elsewhere tests/run: cargo deb --quiet: builds for minutes
sudo apt install
    elsewhere tests/tests/systemd.rs: PROPRIO_DEB: needs root and systemd
tests/run
    elsewhere .ci/run: tests/run: runs this test
"#;

/// The pages that are about the arm of which nobody has described more than the URDF; the others
/// are about the iCub-like one.
const COMMISSIONING: [&str; 3] = [
    "commissioning/steps.md",
    "commissioning/signs.md",
    "commissioning/install.md",
];

/// A row of the table: a line of a page, or words of it, and what is said of them.
#[derive(Clone)]
struct Row {
    text: String,
    /// Whether it is a line of a block.
    is_line: bool,
    rules: Vec<&'static str>,
}

impl Row {
    fn all<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'static str> + 'a {
        let rules = self
            .rules
            .iter()
            .filter_map(move |rule| rule.strip_prefix(kind));
        rules.map(str::trim)
    }

    fn has(&self, kind: &str) -> bool {
        self.all(kind).next().is_some()
    }

    /// What is typed.
    fn typed(&self) -> String {
        self.all("as ").fold(self.text.clone(), |typed, change| {
            let (from, to) = change.split_once("=>").expect("what is typed for it");
            let (from, to) = (from.trim(), to.trim());
            assert!(typed.contains(from), "`{typed}` has no {from:?}");
            typed.replacen(from, to, 1)
        })
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn page(name: &str) -> String {
    let path = root().join("docs/book/src").join(name);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// All pages in their order, and README.md.
fn names() -> Vec<String> {
    let list = page("SUMMARY.md");
    let links = list
        .split("](")
        .skip(1)
        .filter_map(|rest| rest.split(')').next());
    links
        .chain(["../../../README.md"])
        .map(ToOwned::to_owned)
        .collect()
}

/// The blocks of a page in this language.
fn blocks<'a>(text: &'a str, language: &str) -> Vec<&'a str> {
    let blocks = text.split("```").skip(1).step_by(2);
    let named = blocks.filter_map(|block| block.split_once('\n'));
    named
        .filter(|(name, _)| *name == language)
        .map(|(_, block)| block)
        .collect()
}

/// Words with one space between them.
fn spaced(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// All that is done on a page, in order: its lines, with the rows of the table where they belong.
fn rows(name: &str) -> Vec<Row> {
    let text = page(name);
    let shell = blocks(&text, "sh").join("").replace("\\\n", " ");
    let mut lines: Vec<String> = shell.lines().rev().map(spaced).collect();
    let of_page = TABLE
        .split("\n== ")
        .find_map(|part| part.strip_prefix(&format!("{name}\n")));
    let mut all = Vec::new();
    let mut given: Vec<Row> = Vec::new();
    for line in of_page
        .unwrap_or_default()
        .lines()
        .filter(|line| !line.is_empty())
    {
        match (line.strip_prefix("    "), given.last_mut()) {
            (Some(rule), Some(row)) => row.rules.push(rule),
            _ => given.push(Row {
                text: line.into(),
                is_line: false,
                rules: Vec::new(),
            }),
        }
    }
    let plain = |text: String| Row {
        text,
        is_line: true,
        rules: Vec::new(),
    };
    for mut row in given {
        let begins = |line: &String| line.starts_with(&row.text);
        if let Some(at) = lines.iter().rposition(begins) {
            all.extend(lines.drain(at + 1..).rev().map(plain));
            row.text = lines.pop().expect("this line");
            row.is_line = true;
        } else {
            let is_there = spaced(&text).contains(&row.text);
            assert!(
                is_there,
                "{name} does not have, or not in this order: {}",
                row.text
            );
        }
        all.push(row);
    }
    all.extend(lines.drain(..).rev().map(plain));
    all
}

/// A folder, a domain, and what runs in them.
struct Place {
    daemons: RefCell<BTreeMap<String, Process>>,
    computing: RefCell<Vec<(String, Process)>>,
    rig: Rig,
}

const PATIENCE: Nanos = Nanos::from_millis(30_000);

impl Place {
    fn new() -> Self {
        let rig = Rig::new();
        let config = root().join("config").canonicalize().expect("the robots");
        symlink(config, rig.path("config")).expect("a link");
        Self {
            daemons: RefCell::default(),
            computing: RefCell::default(),
            rig,
        }
    }

    /// The line, as a shell in the folder runs it.
    fn shell(&self, line: &str) -> Command {
        let program = Rig::program();
        let folder = program.parent().expect("a folder").display();
        let path = std::env::var("PATH").unwrap_or_default();
        let mut command = Command::new("sh");
        command
            .args(["-c", line])
            .current_dir(self.rig.path(""))
            .env("PATH", format!("{folder}:{path}"))
            .env("PROPRIO_DOMAIN", &self.rig.domain.name)
            .env("PROPRIO_RUNTIME_DIR", &self.rig.domain.base)
            .env_remove("RUST_LOG")
            .stdin(Stdio::null());
        command
    }

    /// Its exit code, and all that it says.
    fn run(&self, line: &str) -> (Option<i32>, String) {
        let output = self.shell(line).output().expect("a shell");
        let said = [output.stdout, output.stderr].concat();
        (
            output.status.code(),
            String::from_utf8_lossy(&said).into_owned(),
        )
    }

    /// Runs it until it ends with success and shows all of these.
    fn shows(&self, line: &str, parts: &[&str]) -> String {
        let mut last = (None, String::new());
        let found = until(PATIENCE, || {
            last = self.run(line);
            let said = spaced(&last.1);
            let is_shown = parts.iter().all(|part| said.contains(part));
            (last.0 == Some(0) && is_shown).then_some(())
        });
        assert!(
            found.is_some(),
            "`{line}` must show {parts:?}: {:?}\n{}",
            last.0,
            last.1
        );
        last.1
    }

    /// Starts it; it must say this, on one of its outputs.
    fn start(&self, line: &str, says: &str) -> Process {
        let process = self.rig.spawn(self.shell(&format!("exec {line}")), "shell");
        let said = || process.output() + &process.log();
        let found = until(PATIENCE, || said().contains(says).then_some(()));
        assert!(found.is_some(), "`{line}` must say {says:?}: {}", said());
        process
    }

    /// Starts a daemon in place of the one of this verb that runs.
    fn daemon(&self, line: &str) {
        let verb = line.split(' ').nth(1).expect("a verb");
        if let Some(mut former) = self.daemons.borrow_mut().remove(verb) {
            former.end();
        }
        let says = if verb == "simulate" { "powered on" } else { "" };
        self.daemons
            .borrow_mut()
            .insert(verb.to_owned(), self.start(line, says));
    }

    fn on_screen(&self, line: &str, part: &str) {
        let mut screen = Terminal::start(&mut self.shell(&format!("exec {line}")));
        screen.wait(part, |text| text.contains(part));
        screen.press("q");
        assert!(screen.ended().success(), "{line}");
    }

    /// Does what a page tells.
    fn does(&self, row: &Row, text: &str) {
        let line = row.typed();
        let parts: Vec<&str> = row.all("shows ").collect();
        let first = parts.first().copied().unwrap_or_default();
        let is = |verb: &str| line.starts_with(&format!("proprio {verb}"));
        let ends = ["--check", "--help"]
            .iter()
            .any(|option| line.contains(option));
        if let Some(hand) = row.all("by hand ").next() {
            self.by_hand(hand);
        } else if row.has("elsewhere ") || row.has("nowhere ") {
        } else if let Some(part) = row.all("fails ").next() {
            let (code, said) = self.run(&line);
            assert!(
                code == Some(1) && said.contains(part),
                "`{line}`: {code:?}\n{said}"
            );
        } else if row.has("computes") {
            let process = self.start(&line, "");
            self.computing.borrow_mut().push((line, process));
        } else if is("top") {
            self.on_screen(&line, first);
        } else if is("echo") && !line.contains("--count") {
            // Until Ctrl-C.
            self.start(&line, first).kill();
        } else if !ends
            && ["simulate", "gateway", "estimator", "record --ring"]
                .into_iter()
                .any(is)
        {
            self.daemon(&line);
        } else {
            let said = skeleton(&self.shows(&line, &parts));
            let block = blocks(text, "text");
            let block = block
                .first()
                .filter(|_| row.has("block"))
                .copied()
                .unwrap_or_default();
            for part in skeleton(block).lines() {
                assert!(said.contains(part), "`{line}` must show {part:?}:\n{said}");
            }
        }
    }

    /// Writes a file again, with the second text in the place of each first one.
    fn change(&self, file: &str, changes: &[(&str, &str)]) {
        let path = self.rig.path(file);
        let mut text = fs::read_to_string(&path).expect("a file");
        for (from, to) in changes {
            assert!(text.contains(from), "{file} has no {from:?}");
            text = text.replace(from, to);
        }
        fs::write(path, text).expect("a file");
    }

    fn by_hand(&self, what: &str) {
        match what {
            "snapshot" => {
                let found = until(PATIENCE, || {
                    let mut files = fs::read_dir(self.rig.path("box")).ok()?.flatten();
                    files.find(|file| file.file_name().to_string_lossy().ends_with(".mcap"))
                });
                assert!(found.is_some(), "no file of the black box");
            }
            "fill in" => self.fill_in(),
            "estimator.toml" => {
                let file = self.rig.path("robot/estimator.toml");
                fs::write(file, of_steps(0)).expect("a file");
            }
            "offsets" => {
                let sensor = |text: &str| {
                    let (_, rest) = text.split_once("[[force_torque]]").expect("a sensor");
                    rest.split("\n[[")
                        .next()
                        .unwrap_or_default()
                        .trim()
                        .to_owned()
                };
                let (bare, whole) = (sensor(&of_steps(0)), sensor(&of_steps(1)));
                self.change("robot/estimator.toml", &[(&bare, &whole)]);
                let used = "its offset in use: force [3, -5, 12] N, torque [0.3, -0.2, 0.15] Nm";
                self.shows(CHECK, &[used]);
            }
            "valid" => self.on_screen("proprio top", "TORQUES  6 of 6 valid"),
            "parameters" => {
                let named = "parameters = \"parameters.toml\"\n\n[base]";
                self.change("robot/estimator.toml", &[("[base]", named)]);
                self.daemon("proprio estimator --config robot/estimator.toml");
                self.shows("proprio why joint_2", &["joint_2 is valid"]);
            }
            "moved" => self
                .start("proprio echo joint_2", "joint position 1.2")
                .kill(),
            "wrong sign" => self.wrong_sign(),
            other => panic!("nobody knows how to do {other:?}"),
        }
    }

    /// Names, ratios, and no comment is left.
    fn fill_in(&self) {
        let (code, said) = self.run("proprio gateway --config robot/gateway.toml --check");
        assert!(
            code == Some(2) && said.contains("placeholders are not filled in"),
            "{said}"
        );
        let file = "robot/gateway.toml";
        self.change(
            file,
            &[
                ("  # fill in: its name in the URDF", ""),
                ("  # fill in: gear ratio, and sign, offset_rad", ""),
                ("name = \"sensor_ati_netcanoem_32\"", "name = \"base_ft\""),
            ],
        );
        for joint in 1..=6 {
            let ratio = if joint <= 3 { 101 } else { 51 };
            let line = |ratio| format!("name = \"joint_{joint}\"\n    ratio = {ratio}.0");
            self.change(file, &[(&line(1), &line(ratio))]);
        }
    }

    /// The differences with a wrong sign are those that the page tells.
    fn wrong_sign(&self) {
        let turned = "name = \"joint_3\"\n    sign = -1";
        self.change("robot/gateway.toml", &[("name = \"joint_3\"", turned)]);
        self.shows("proprio ctl reload", &[]);
        let text = spaced(&page("commissioning/signs.md"));
        for (at, told) in [
            ("", "22.6 Nm as the arm stands"),
            (
                " --fault still:joint_2=1.2",
                "9.8 Nm with `still:joint_2=1.2`",
            ),
            (
                " --fault still:joint_3=0",
                "-0.2 Nm, the offset, with `still:joint_3=0`",
            ),
        ] {
            assert!(text.contains(told), "{told}");
            let number: f64 = told
                .split(' ')
                .next()
                .and_then(|n| n.parse().ok())
                .expect("a number");
            let robot = "proprio simulate --robot config/six_axis_arm --still 3600 --no-push";
            self.daemon(&format!("{robot}{at}"));
            let mut last = None;
            // At first the gateway waits for the new robot.
            let found = until(PATIENCE, || {
                let (_, said) = self.run(CHECK);
                let (_, behind) = said.split_once("the difference: ")?;
                let (_, torque) = behind.split_once("torque [")?;
                last = torque.split(", ").nth(1)?.parse::<f64>().ok();
                (last? - number).abs().lt(&0.06).then_some(())
            });
            assert!(found.is_some(), "{at}: {last:?}, not {number}");
        }
    }
}

const CHECK: &str = "proprio estimator --config robot/estimator.toml --check";

fn of_steps(block: usize) -> String {
    let text = page("commissioning/steps.md");
    blocks(&text, "toml")
        .get(block)
        .map(ToString::to_string)
        .expect("a block of the page")
}

/// The lines of a text without numbers, and without what follows on `...`.
fn skeleton(text: &str) -> String {
    let lines = text.lines().map(|line| {
        let words = line
            .split("...")
            .next()
            .unwrap_or_default()
            .split_whitespace();
        let kept = words.map(|word| {
            let is_number = word
                .trim_matches(|c: char| "[],;".contains(c))
                .parse::<f64>()
                .is_ok();
            if is_number { "#" } else { word }
        });
        kept.collect::<Vec<_>>().join(" ")
    });
    lines.collect::<Vec<_>>().join("\n")
}

fn follow(is_here: impl Fn(&str) -> bool) {
    let place = Place::new();
    for name in names().into_iter().filter(|name| is_here(name)) {
        let text = page(&name);
        for row in rows(&name) {
            let since = now();
            place.does(&row, &text);
            println!("{:6.2} s  {name}: {}", (now() - since).seconds(), row.text);
        }
    }
    for (line, process) in place.computing.borrow_mut().iter_mut() {
        println!("at last: {line}");
        process.wait();
    }
}

#[test]
fn a_new_user_looks_at_a_robot() {
    follow(|name| !COMMISSIONING.contains(&name));
}

#[test]
fn a_new_user_commissions_a_robot() {
    follow(|name| COMMISSIONING.contains(&name));
}

/// Lines that are run by chance may do anything: only known programs have no row.
#[test]
fn each_line_is_known_and_what_is_not_run_here_is_run_elsewhere() {
    let names = names();
    for part in TABLE.split("\n== ").skip(1) {
        let name = part.lines().next().unwrap_or_default();
        assert!(
            names.iter().any(|own| own == name),
            "there is no page {name}"
        );
    }
    let (mut run, mut left) = (0, 0);
    for (name, row) in names
        .iter()
        .flat_map(|name| rows(name).into_iter().map(move |row| (name, row)))
    {
        let is_known = ["proprio ", "cp ", "sed "]
            .iter()
            .any(|begin| row.typed().starts_with(begin));
        let is_ruled = (["elsewhere ", "nowhere ", "by hand "].iter()).any(|rule| row.has(rule));
        assert!(
            is_known || is_ruled || row.text == "proprio help",
            "{name}: {}",
            row.text
        );
        run += usize::from(!is_ruled);
        for rule in row.all("elsewhere ") {
            let mut parts = rule.splitn(3, ": ");
            let mut next = || parts.next().expect("a file, a text, a reason");
            let (file, part, _why) = (next(), next(), next());
            let text = fs::read_to_string(root().join(file)).unwrap_or_default();
            assert!(
                text.contains(part),
                "{name}: {}: {file} has no {part:?}",
                row.text
            );
            left += 1;
        }
    }
    assert!(run > 70 && left < 30, "{run} {left}");
}

/// Verb and options of a command; with the verb of `ctl`.
fn means(command: &str) -> Option<(String, BTreeSet<&str>)> {
    let (_, behind) = command.rsplit_once("proprio ")?;
    let mut words = behind.split([' ', '=']);
    let verb = match words.next()? {
        "ctl" => format!("ctl {}", words.next().unwrap_or_default()),
        verb => verb.to_owned(),
    };
    Some((verb, words.filter(|word| word.starts_with("--")).collect()))
}

/// What is only named in a text is run with these options somewhere.
#[test]
fn what_the_text_names_is_run_somewhere() {
    let all: Vec<Row> = names().iter().flat_map(|name| rows(name)).collect();
    let run: Vec<_> = all.iter().filter_map(|row| means(&row.text)).collect();
    let mut count = 0;
    for name in names() {
        let text = page(&name);
        let parts = text.split("```").step_by(2);
        let code = parts
            .flat_map(|part| part.split('`').skip(1).step_by(2))
            .map(spaced);
        for command in code.filter(|code| code.starts_with("proprio ")) {
            let (verb, options) = means(&command).expect("a command");
            let is_run = run
                .iter()
                .any(|(own, all)| *own == verb && options.is_subset(all));
            assert!(is_run, "{name}: `{command}` is run nowhere: give it a row");
            count += 1;
        }
    }
    assert!(count > 60, "{count}");
}
