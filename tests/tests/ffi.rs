//! The C library as its users have it: installed by `ffi/install`, found with pkg-config, with
//! programs in C and C++ that gcc compiles under all warnings and the address sanitizer, beside
//! live daemons that are killed and started again.
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_tests::{Arm, PATIENCE, Process, Rig, until};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The source tree.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Runs a command that must succeed; its output.
fn run(command: &mut Command) -> String {
    let output = command
        .output()
        .unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
    assert!(
        output.status.success(),
        "{command:?}: {}{}",
        text(&output.stderr),
        text(&output.stdout)
    );
    text(&output.stdout)
}

/// Whether the programs are there that `tests/run` installs; else says that the test is skipped.
fn can_compile() -> bool {
    for program in ["gcc", "g++", "pkg-config"] {
        if Command::new(program).arg("--version").output().is_err() {
            println!("skipped: {program} is not installed");
            return false;
        }
    }
    true
}

/// The library, installed in the rig's folder.
struct Library {
    prefix: PathBuf,
}

impl Library {
    /// `None` if what compiles programs is missing: the test is skipped.
    fn install(rig: &Rig) -> Option<Self> {
        if !can_compile() {
            return None;
        }
        let prefix = rig.path("prefix");
        // Built with this test, beside it.
        let test = std::env::current_exe().expect("this program's own path");
        let built = test.parent().expect("its folder");
        run(Command::new(root().join("ffi/install"))
            .arg(&prefix)
            .env("PROPRIO_LIBRARIES", built));
        Some(Self { prefix })
    }

    /// What pkg-config says of it.
    fn flags(&self, words: &[&str]) -> Vec<String> {
        let said = run(Command::new("pkg-config")
            .args(words)
            .arg("proprio")
            .env("PKG_CONFIG_PATH", self.prefix.join("lib/pkgconfig")));
        said.split_whitespace().map(ToOwned::to_owned).collect()
    }

    /// Compiles `source` with this compiler's command, as a user who takes warnings for errors.
    fn compile(&self, compiler: &[&str], source: &Path, libraries: &[String], to: &Path) {
        let [compiler, arguments @ ..] = compiler else {
            panic!("a compiler")
        };
        run(Command::new(compiler)
            .args(arguments)
            .args(["-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"])
            .args(self.flags(&["--cflags"]))
            .arg(source)
            .arg("-o")
            .arg(to)
            .args(libraries)
            .arg(format!("-Wl,-rpath,{}", self.prefix.join("lib").display())));
    }

    /// Flags that link the shared library, or the static one.
    fn shared(&self) -> Vec<String> {
        self.flags(&["--libs"])
    }

    fn archive(&self) -> Vec<String> {
        let archive = self.prefix.join("lib/libproprio.a");
        let mut flags = vec![archive.display().to_string()];
        let all = self.flags(&["--libs", "--static"]);
        flags.extend(all.into_iter().filter(|flag| flag != "-lproprio"));
        flags
    }
}

/// A simulated arm with its two daemons.
struct Robot<'a> {
    rig: &'a Rig,
    gateway_toml: String,
    estimator_toml: String,
    _simulator: Process,
    gateway: Process,
    estimator: Process,
}

impl<'a> Robot<'a> {
    fn start(rig: &'a Rig) -> Self {
        let arm = Arm::new()
            .periods(4, 10, 4)
            .on_virtual(["a", "b"])
            .write(&rig.path("robot"));
        Self {
            rig,
            _simulator: rig.start(&["simulate", "--robot", &arm.folder]),
            gateway: rig.start(&["gateway", "--config", &arm.gateway]),
            estimator: rig.start(&["estimator", "--config", &arm.estimator]),
            gateway_toml: arm.gateway,
            estimator_toml: arm.estimator,
        }
    }

    fn start_gateway(&mut self) {
        self.gateway = self.rig.start(&["gateway", "--config", &self.gateway_toml]);
    }

    fn start_estimator(&mut self) {
        self.estimator = self
            .rig
            .start(&["estimator", "--config", &self.estimator_toml]);
    }
}

/// Starts a program in the rig's domain.
fn spawn(rig: &Rig, program: &Path, arguments: &[&str]) -> Process {
    let mut command = Command::new(program);
    command
        .args(arguments)
        .env("PROPRIO_DOMAIN", &rig.domain.name)
        .env("PROPRIO_RUNTIME_DIR", &rig.domain.base);
    let name = program.file_name().expect("its name");
    rig.spawn(command, &name.to_string_lossy())
}

/// Waits until `program` has printed one of these words since it had printed `from` bytes; then how
/// many it has printed.
fn hear(program: &mut Process, from: usize, words: &[&str]) -> usize {
    let heard = until(PATIENCE, || {
        program.assert_runs();
        let output = program.output();
        let new = output.get(from..).unwrap_or_default();
        words
            .iter()
            .any(|word| new.contains(word))
            .then_some(output.len())
    });
    heard.unwrap_or_else(|| panic!("none of {words:?} in {}", program.output()))
}

fn end(mut program: Process) {
    let id = Pid::from_raw(i32::try_from(program.id()).expect("a process number"));
    kill(id, Signal::SIGTERM).expect("the signal is sent");
    // The sanitizers make it fail if it leaks or has touched what is not its own.
    program.wait();
}

#[test]
fn programs_in_c_and_cpp_outlive_every_daemon() {
    let rig = Rig::new();
    let Some(library) = Library::install(&rig) else {
        return;
    };
    let examples = root().join("ffi/examples");
    let sanitized = [
        "-g",
        "-O1",
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
    ];
    let (in_c, in_cpp) = (rig.path("control_loop"), rig.path("push"));
    let gcc = [&["gcc", "-std=c99"], &sanitized[..]].concat();
    library.compile(
        &gcc,
        &examples.join("control_loop.c"),
        &library.archive(),
        &in_c,
    );
    let gpp = [&["g++", "-std=c++17"], &sanitized[..]].concat();
    library.compile(&gpp, &examples.join("push.cpp"), &library.shared(), &in_cpp);

    // Before anybody is there.
    let mut loops = spawn(&rig, &in_c, &["icub_left_arm"]);
    let mut waits = spawn(
        &rig,
        &in_cpp,
        &["icub_left_arm", "hand", "l_elbow", "l_arm_ft_sensor"],
    );
    let mut of_loop = hear(&mut loops, 0, &["the gateway is not running"]);
    let of_wait = hear(&mut waits, 0, &["the estimator is not running"]);

    let mut robot = Robot::start(&rig);
    of_loop = hear(&mut loops, of_loop, &[" Nm  +- "]);
    // The simulated hand is pushed again and again.
    let mut of_wait = hear(&mut waits, of_wait, &["pushed with "]);
    for _ in 0..2 {
        robot.estimator.kill();
        of_loop = hear(&mut loops, of_loop, &["the estimator was killed"]);
        of_loop = hear(&mut loops, of_loop, &["stale: "]);
        robot.start_estimator();
        of_loop = hear(&mut loops, of_loop, &[" Nm  +- "]);
        robot.gateway.kill();
        hear(&mut loops, of_loop, &["the gateway was killed"]);
        of_wait = hear(
            &mut waits,
            of_wait,
            &["no estimate: the gateway was killed"],
        );
        robot.start_gateway();
        let since = loops.output().len();
        of_loop = hear(&mut loops, since, &[" Nm  +- "]);
    }
    end(loops);
    end(waits);
}

/// As `gateway/topics/tests/robot.rs` shows of Rust's reader.
#[test]
fn a_cycle_in_c_makes_no_system_call_and_no_allocation() {
    let rig = Rig::new();
    let Some(library) = Library::install(&rig) else {
        return;
    };
    let source = root().join("tests/tests/ffi/cycle.c");
    for (name, flags) in [("shared", library.shared()), ("archive", library.archive())] {
        let program = rig.path(name);
        library.compile(&["gcc", "-std=gnu99", "-O2"], &source, &flags, &program);
        let mut cycles = spawn(&rig, &program, &[]);
        let heard = hear(&mut cycles, 0, &["---"]);
        let robot = Robot::start(&rig);
        let heard = hear(&mut cycles, heard, &["+++"]);
        drop(robot);
        // Its clock stands, so that nothing grows old; but its ports go.
        hear(&mut cycles, heard + 200, &["+++"]);
        assert!(!cycles.output().contains('a'), "a cycle allocates");
    }
}

#[test]
fn a_child_that_ends_its_copy_of_a_reader_does_its_parent_no_harm() {
    let rig = Rig::new();
    let Some(library) = Library::install(&rig) else {
        return;
    };
    let (source, program) = (root().join("tests/tests/ffi/fork.c"), rig.path("fork"));
    library.compile(&["gcc", "-std=gnu99"], &source, &library.shared(), &program);
    let _robot = Robot::start(&rig);
    let mut forks = spawn(&rig, &program, &[]);
    forks.wait();
    assert_eq!(forks.output(), "goes on, the child ended with 0\n");
}

/// The programs of the documentation are compiled as they stand.
#[test]
fn the_documents_programs_compile() {
    let rig = Rig::new();
    let Some(library) = Library::install(&rig) else {
        return;
    };
    let page = fs::read_to_string(root().join("docs/book/src/read/c.md")).expect("the page");
    let mut compiled = 0;
    for (language, compiler) in [("c", ["gcc", "-std=c99"]), ("cpp", ["g++", "-std=c++17"])] {
        for block in page.split("```").skip(1).step_by(2) {
            let Some(program) = block.strip_prefix(&format!("{language}\n")) else {
                continue;
            };
            let source = rig.path(&format!("program.{language}"));
            fs::write(&source, program).expect("a file of this test");
            library.compile(&compiler, &source, &library.shared(), &rig.path("program"));
            compiled += 1;
        }
    }
    assert!(compiled >= 2, "{compiled} programs");
}
