//! Every program that reads a running robot survives what may happen to it: it says why there is
//! nothing, never crashes, goes on by itself as soon as there is something again, and holds no
//! memory of what is over. Gateway and estimator are started again when they have ended, as by a
//! service manager.
//!
//! Where the test may mount, /dev/shm is its own: small, so that what is not given back is noticed,
//! and filled to the last byte. The bridges' own tests do the same with their programs.
#![allow(missing_docs)]

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};
use proprio_tests::damage::{DELETIONS, SHORTENINGS};
use proprio_tests::terminal::Terminal;
use proprio_tests::{Arm, PATIENCE, Process, Rig, Written, now, until};
use proprio_topics::Nanos;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

const ROBOT: &str = "icub_left_arm";

/// Gives this thread, and what it starts, a /dev/shm of its own; returns whether it could.
fn own_shared_memory() -> bool {
    let none = None::<&str>;
    let flags = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
    let tmpfs = Some("tmpfs");
    let mounted = unshare(CloneFlags::CLONE_NEWNS)
        .and_then(|()| mount(none, "/", none, flags, none))
        .and_then(|()| mount(tmpfs, "/dev/shm", tmpfs, MsFlags::empty(), Some("size=96m")));
    mounted.is_ok()
}

/// The daemons.
struct Daemons<'a> {
    rig: &'a Rig,
    arm: &'a Written,
    gateway: Process,
    estimator: Process,
    /// `proprio status`, which came at the worst moments.
    statuses: Vec<Process>,
}

impl<'a> Daemons<'a> {
    fn start(rig: &'a Rig, arm: &'a Written) -> Self {
        Self {
            gateway: rig.start(&["gateway", "--config", &arm.gateway]),
            estimator: rig.start(&["estimator", "--config", &arm.estimator]),
            statuses: Vec::new(),
            rig,
            arm,
        }
    }

    /// Starts again who has ended.
    fn restart(&mut self) {
        if self.gateway.ended().is_some() {
            let arguments = ["gateway", "--config", &self.arm.gateway];
            self.gateway = self.rig.start(&arguments);
        }
        if self.estimator.ended().is_some() {
            let arguments = ["estimator", "--config", &self.arm.estimator];
            self.estimator = self.rig.start(&arguments);
        }
    }
}

/// How one sees that a program reads.
enum Sign {
    /// Its output has a line with this word, which begins with the instant.
    Echoes(&'static str),
    /// Its output has this word again; so far it has as many bytes.
    Says(&'static str, usize),
    /// The file has a newer sample.
    Records(PathBuf),
    /// So has a snapshot.
    Holds,
}

/// A program that reads.
struct Reader {
    name: &'static str,
    process: Process,
    sign: Sign,
}

/// The instant that begins a row.
fn instant(row: &str) -> Option<Nanos> {
    let digits = row.split([' ', ',']).next()?;
    Some(Nanos::from_seconds(digits.parse().ok()?))
}

/// The newest instant in the complete lines of a text that have this word.
fn newest(text: &str, word: &str) -> Option<Nanos> {
    let (whole, _) = text.rsplit_once('\n')?;
    instant(whole.rsplit('\n').find(|line| line.contains(word))?)
}

/// The newest instant in a file of samples.
fn recorded(file: &Path) -> Option<Nanos> {
    if file.extension().is_some_and(|end| end == "csv") {
        return newest(&fs::read_to_string(file).ok()?, ",");
    }
    let mut table = Vec::new();
    proprio_recording::to_table(fs::File::open(file).ok()?, &mut table).ok()?;
    newest(&String::from_utf8(table).ok()?, ",")
}

impl Reader {
    fn start(rig: &Rig, arguments: &[&str], sign: Sign) -> Self {
        let name = match sign {
            Sign::Echoes(_) | Sign::Says(..) => "echo",
            Sign::Records(_) => "record",
            Sign::Holds => "black box",
        };
        Self {
            name,
            process: rig.start(arguments),
            sign,
        }
    }

    /// What comes from now on is news.
    fn forget(&mut self) {
        if let Sign::Says(_, from) = &mut self.sign {
            *from = self.process.output().len();
        }
    }

    fn has_news(&self, rig: &Rig, since: Nanos) -> bool {
        let is_new = |newest: Option<Nanos>| newest > Some(since);
        match &self.sign {
            Sign::Echoes(word) => is_new(newest(&self.process.output(), word)),
            Sign::Says(word, from) => self.process.output()[*from..].contains(word),
            Sign::Records(file) => is_new(recorded(file)),
            Sign::Holds => {
                let asked = rig.command(&["ctl", "snapshot"]).output();
                let said = String::from_utf8(asked.expect("it runs").stdout).expect("text");
                let file = said.trim().strip_suffix(" is written").map(Path::new);
                let found = file.and_then(recorded);
                file.map(fs::remove_file);
                is_new(found)
            }
        }
    }
}

/// Those that may be started before anybody is there.
fn waiting(rig: &Rig, control_loop: Option<&Path>) -> (Vec<Reader>, Terminal) {
    let folder = rig.path("box").display().to_string();
    let black_box = ["record", "--ring", "3", "--out", &folder];
    let mut readers = vec![Reader::start(rig, &black_box, Sign::Holds)];
    if let Some(program) = control_loop {
        let mut command = Command::new(program);
        command
            .arg(ROBOT)
            .env("PROPRIO_DOMAIN", &rig.domain.name)
            .env("PROPRIO_RUNTIME_DIR", &rig.domain.base);
        readers.push(Reader {
            name: "a control loop in C",
            process: rig.spawn(command, "control_loop"),
            sign: Sign::Says(" Nm  +- ", 0),
        });
    }
    (readers, Terminal::start(&mut rig.command(&["top"])))
}

/// The others; `turn` tells their files apart.
fn others(rig: &Rig, turn: u32) -> Vec<Reader> {
    let file = |end: &str| rig.path(&format!("run_{turn}.{end}"));
    let [mcap, csv] = ["mcap", "csv"].map(file);
    let record = |file: &Path, more: &[&str]| {
        let path = file.display().to_string();
        let arguments = [&["record", "--out", &path], more].concat();
        Reader::start(rig, &arguments, Sign::Records(file.to_owned()))
    };
    vec![
        record(&csv, &[]),
        record(&mcap, &["--frames", "virtual:a"]),
        Reader::start(rig, &["echo", "l_elbow"], Sign::Echoes("joint")),
        Reader::start(rig, &["echo", "--torques"], Sign::Echoes(" +- ")),
    ]
}

/// `ffi/examples/control_loop.c`, if there is a compiler.
fn control_loop(rig: &Rig) -> Option<PathBuf> {
    let ffi = Path::new(env!("CARGO_MANIFEST_DIR")).join("../ffi");
    let program = rig.path("control_loop");
    // Built with this test, beside it.
    let test = std::env::current_exe().expect("this program's own path");
    let compiled = Command::new("gcc")
        .arg("-I")
        .arg(ffi.join("include"))
        .arg(ffi.join("examples/control_loop.c"))
        .arg(test.with_file_name("libproprio.a"))
        .args([
            "-lgcc_s",
            "-lutil",
            "-lrt",
            "-lpthread",
            "-lm",
            "-ldl",
            "-o",
        ])
        .arg(&program)
        .status();
    match compiled {
        Ok(status) => assert!(status.success(), "the example does not compile"),
        Err(_) => println!("without the example in C: gcc is not installed"),
    }
    program.exists().then_some(program)
}

/// Programs that do a thing once say in one line why they cannot, and end.
fn assert_refused(rig: &Rig, why: &str) {
    let out = rig.path("never.mcap").display().to_string();
    let all: [&[&str]; 4] = [
        &["status"],
        &["echo", "l_elbow"],
        &["echo", "--torques"],
        &["record", "--out", &out],
    ];
    for arguments in all {
        let output = rig.command(arguments).output().expect("it runs");
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {said}");
        assert!(
            said.starts_with("error: ") && said.contains(why) && said.lines().count() == 1,
            "{arguments:?}: {said}"
        );
    }
}

/// Waits until every reader has something newer than from before this call.
fn assert_recovered(
    what: &str,
    rig: &Rig,
    daemons: &mut Daemons<'_>,
    readers: &mut [Reader],
    top: &mut Terminal,
) {
    let start = now();
    daemons.statuses.push(rig.start(&["status"]));
    let picture = top.text();
    readers.iter_mut().for_each(Reader::forget);
    let mut silent: Vec<_> = (0..readers.len()).collect();
    let mut is_shown = false;
    let recovered = until(PATIENCE, || {
        daemons.restart();
        readers
            .iter_mut()
            .for_each(|reader| reader.process.assert_runs());
        silent.retain(|number| !readers[*number].has_news(rig, start));
        let text = top.text();
        is_shown |= text.contains("TORQUES  7 of 7 valid") && text != picture;
        sleep(Duration::from_millis(50));
        (silent.is_empty() && is_shown).then_some(())
    });
    let names: Vec<_> = silent.iter().map(|number| readers[*number].name).collect();
    assert!(
        recovered.is_some(),
        "{what}: nothing new in {names:?}\ntop:\n{}\ngateway:\n{}\nestimator:\n{}",
        top.text(),
        daemons.gateway.log(),
        daemons.estimator.log()
    );
    assert!(top.is_full_screen(), "{what}: {}", top.text());
    println!("{what}: {} s", now() - start);
}

fn survive(is_own: bool) {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .write(&rig.path("robot"));
    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder]);

    // Readers first.
    assert_refused(&rig, "no gateway or estimator");
    let program = control_loop(&rig);
    let (mut readers, mut top) = waiting(&rig, program.as_deref());
    top.wait("it waits", |text| text.contains("waiting: "));
    let mut all = Daemons::start(&rig, &arm);
    let daemons = &mut all;
    assert_recovered(
        "daemons that come late",
        &rig,
        daemons,
        &mut readers,
        &mut top,
    );
    readers.extend(others(&rig, 1));
    assert_recovered("the start", &rig, daemons, &mut readers, &mut top);

    type Kill = (&'static str, fn(&mut Daemons<'_>));
    let kills: [Kill; 3] = [
        ("the gateway is killed", |all| all.gateway.kill()),
        ("the estimator is killed", |all| all.estimator.kill()),
        ("both are ended", |all| {
            all.estimator.end();
            all.gateway.end();
        }),
    ];
    for (what, kill) in kills {
        kill(daemons);
        assert_recovered(what, &rig, daemons, &mut readers, &mut top);
    }

    if is_own {
        let fill = Path::new("/dev/shm/fill");
        let mut file = fs::File::create(fill).expect("a file");
        while file.write_all(&[1; 4096]).is_ok() {}
        assert_refused(&rig, "/dev/shm is full");
        assert_recovered("memory is full", &rig, daemons, &mut readers, &mut top);
        daemons.gateway.kill();
        daemons.estimator.kill();
        let mut refused = rig.start(&["gateway", "--config", &arm.gateway]);
        until(PATIENCE, || refused.ended()).expect("it ends");
        drop(file);
        fs::remove_file(fill).expect("it is there");
        assert!(
            refused.log().contains("/dev/shm is full"),
            "{}",
            refused.log()
        );
        assert_recovered("memory was full", &rig, daemons, &mut readers, &mut top);
    }

    let [payloads, .., everything] = SHORTENINGS;
    for (what, damage) in DELETIONS.into_iter().chain([payloads, everything]) {
        damage(&rig);
        assert_recovered(what, &rig, daemons, &mut readers, &mut top);
    }

    // Killed readers stop nobody.
    readers.iter_mut().for_each(|reader| reader.process.kill());
    drop((readers, top));
    let (mut readers, mut top) = waiting(&rig, program.as_deref());
    readers.extend(others(&rig, 2));
    assert_recovered("readers are killed", &rig, daemons, &mut readers, &mut top);

    for status in &mut all.statuses {
        let ended = until(PATIENCE, || status.ended()).expect("`status` ends");
        let said = status.log();
        let is_told = said.starts_with("error: ") && said.lines().count() == 1;
        assert!(ended.success() || is_told, "status: {said}");
    }
    for reader in &mut readers {
        reader.process.end();
        let said = reader.process.log();
        assert!(!said.contains("panicked"), "{}: {said}", reader.name);
    }
    top.press("q");
    assert!(top.ended().success());
    drop((readers, top));
    for process in [&mut simulator, &mut all.gateway, &mut all.estimator] {
        process.end();
    }
    rig.assert_nothing_left();
}

#[test]
fn whoever_reads_survives_everything() {
    let test = || {
        let is_own = own_shared_memory();
        if !is_own {
            println!("without a full /dev/shm: this user may not mount");
        }
        survive(is_own);
    };
    // In a thread of its own, which alone has other mounts.
    let ended = std::thread::spawn(test).join();
    if let Err(why) = ended {
        std::panic::resume_unwind(why);
    }
}
