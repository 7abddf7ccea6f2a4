//! The Debian package on a machine with systemd: installation, upgrade and purge, and what the
//! services do when they are killed, stopped, given a wrong configuration, or when the disk is
//! full, the clock is set or an interface disappears.
//!
//! Runs if PROPRIO_DEB names the package. Then systemd is process 1 of a machine that may be
//! changed, with vcan0 and vcan1 (`tests/run --only systemd` provides it: user-mode Linux with one
//! slow processor), one test at a time. Each test starts from services that run.
#![allow(missing_docs)]

use proprio_tests::can::{add_interface, run, tool};
use proprio_tests::{Arm, now, until};
use proprio_topics::Nanos;
use serde_json::Value;
use std::fs;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use tempfile::TempDir;

const UNITS: [&str; 2] = ["proprio-gateway.service", "proprio-estimator.service"];
const LOOP: &str = "control-loop.service";
const PROGRAM: &str = "/usr/bin/proprio";
/// What the loop reads, in its own words.
const READ: &str = "/tmp/control-loop";
/// For whatever has no limit of its own.
const PATIENCE: Nanos = Nanos::from_millis(60_000);

/// The output of a shell's line, which must succeed.
fn sh(line: &str) -> String {
    let (output, succeeded) = attempt(line);
    assert!(succeeded, "{line}\n{output}");
    output
}

/// What a shell's line prints, and whether it succeeds.
fn attempt(line: &str) -> (String, bool) {
    let output = tool("sh -c")
        .arg(format!("{line} 2>&1"))
        .output()
        .expect("a shell");
    let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    (text, output.status.success())
}

fn property(unit: &str, name: &str) -> String {
    sh(&format!("systemctl show -P {name} {unit}"))
}

/// When something of a service last happened: `ActiveEnter`, `ExecMainStart`.
fn time_of(event: &str, unit: &str) -> Nanos {
    let micros = property(unit, &format!("{event}TimestampMonotonic"));
    Nanos(1000 * micros.parse::<i64>().expect("a number"))
}

/// The process of a service that is ready; 0 if it is not.
fn process(unit: &str) -> u32 {
    let is_active = property(unit, "ActiveState") == "active";
    let id = property(unit, "MainPID").parse().expect("a number");
    if is_active { id } else { 0 }
}

/// What the journal has, once it has taken in all that it was sent: this machine is slow.
fn journal(options: &str) -> String {
    let line = format!("journalctl --sync; journalctl --no-pager -o cat {options}");
    sh(&line)
}

fn log(unit: &str) -> String {
    journal(&format!("-u {unit}"))
}

/// Waits until `condition` holds.
fn eventually(what: &str, limit: Nanos, mut condition: impl FnMut() -> bool) {
    // Each look starts processes, of which every one costs the services time.
    let mut check = || {
        let holds = condition();
        std::thread::sleep(std::time::Duration::from_millis(200));
        holds.then_some(())
    };
    let holds = until(limit, &mut check).is_some();
    let logs = || UNITS.map(log).join("\n");
    assert!(holds, "not within {limit} s: {what}\n{}", logs());
}

/// The newest torque that the loop has read: when it was acquired, and whether it is valid.
fn newest_torque() -> Option<(Nanos, bool)> {
    let text = fs::read_to_string(READ).ok()?;
    // The last line may not be complete.
    let lines = text.lines().rev();
    let read: Value = lines
        .take(2)
        .find_map(|line| serde_json::from_str(line).ok())?;
    let is_valid = read["torques"]["l_elbow"]["valid"].as_bool()?;
    Some((Nanos(read["t_ns"].as_i64()?), is_valid))
}

/// A robot whose boards are simulated, and the services that read them.
struct Machine {
    boards: Child,
    folder: TempDir,
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = self.boards.kill();
        let _ = self.boards.wait();
    }
}

impl Machine {
    fn package() -> Option<String> {
        let package = std::env::var("PROPRIO_DEB").ok();
        if package.is_none() {
            println!(
                "skipped: PROPRIO_DEB is not set (tests/run --only systemd provides a machine)"
            );
        }
        package
    }

    /// The machine with services that run, whatever an earlier test left; `None` if it is not
    /// provided.
    fn running() -> Option<Self> {
        let package = Self::package()?;
        if !Path::new(PROGRAM).exists() {
            sh(&format!("dpkg -i {package}"));
        }
        let _ = attempt("umount /var/lib/proprio");
        for interface in ["vcan0", "vcan1"] {
            if !Path::new("/sys/class/net").join(interface).exists() {
                add_interface(interface);
            }
        }
        let folder = tempfile::tempdir().expect("a folder");
        let arm = Arm::slow()
            .on_interfaces(["vcan0", "vcan1"])
            .write(folder.path());
        let boards = Command::new(PROGRAM)
            .args(["simulate", "--robot", &arm.folder])
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the simulator");
        // What the arm's configuration names lies elsewhere; on the machine all is in one folder.
        let estimator = folder.path().join("estimator.toml");
        let text = fs::read_to_string(&estimator).expect("its configuration");
        let model = arm_model(&text);
        fs::copy(&model, folder.path().join("model.urdf")).expect("a copy of the model");
        fs::write(&estimator, text.replace(&model, "model.urdf")).expect("its configuration");
        sh("systemctl reset-failed");
        sh(&format!(
            "{PROGRAM} install --force --config {}",
            folder.path().display()
        ));
        let this = Self { boards, folder };
        this.start_loop();
        this.expect_torques("after the start");
        Some(this)
    }

    /// Starts the example of a control loop, which runs as the user of the services.
    fn start_loop(&self) {
        let program = "/usr/local/bin/control-loop";
        let line = format!("exec {PROGRAM} echo --torques l_elbow --json >{READ}");
        fs::write(program, format!("#!/bin/sh\n{line}\n")).expect("a program");
        fs::set_permissions(program, fs::Permissions::from_mode(0o755)).expect("a program");
        let unit = format!("/usr/share/doc/proprio/examples/{LOOP}");
        let unit_file = Path::new("/etc/systemd/system").join(LOOP);
        // systemd takes seconds to read all units again.
        if !unit_file.exists() {
            fs::copy(unit, unit_file).expect("the example");
            sh("systemctl daemon-reload");
        }
        sh(&format!("systemctl restart {LOOP}"));
    }

    /// Waits for a valid torque acquired from now on.
    fn expect_torques(&self, when: &str) {
        let since = now();
        eventually(&format!("a valid torque {when}"), PATIENCE, || {
            newest_torque().is_some_and(|(t, is_valid)| is_valid && t > since)
        });
        println!("a valid torque {when}: {} s", now() - since);
    }

    /// Writes a file of the configuration anew.
    fn configure(&self, name: &str, change: impl FnOnce(String) -> String) {
        let text = fs::read_to_string(self.folder.path().join(name)).expect("a configuration");
        fs::write(Path::new("/etc/proprio").join(name), change(text)).expect("it is written");
    }
}

/// A configuration with some change.
fn changed(text: &str, change: impl FnOnce(&mut toml::Table)) -> String {
    let mut table: toml::Table = text.parse().expect("TOML");
    change(&mut table);
    table.to_string()
}

/// The path of the model in an estimator.toml.
fn arm_model(text: &str) -> String {
    let table: toml::Table = text.parse().expect("TOML");
    table["model"].as_str().expect("a path").to_owned()
}

/// What is left of the program on the machine, but its user; `files` are those of its package.
fn leftovers(files: &str) -> String {
    let found = sh(
        "find /etc/proprio /etc/systemd /var/lib/proprio /var/lib/systemd /run /dev/shm \
                    -name '*proprio*' -not -path '/run/with-vcan*' 2>/dev/null || true",
    );
    let is_file = |path: &&str| Path::new(path).is_file();
    let files: Vec<&str> = files.lines().filter(is_file).collect();
    found + &files.join("\n")
}

#[test]
fn a_package_waits_for_a_configuration_and_a_purge_leaves_nothing() {
    let Some(package) = Machine::package() else {
        return;
    };
    sh(&format!("systemctl stop {LOOP} || true; dpkg -P proprio"));
    sh(&format!(
        "rm -f {READ} /usr/local/bin/control-loop /etc/systemd/system/{LOOP}"
    ));
    assert_eq!(leftovers(PROGRAM), "", "before");
    let output = sh(&format!("dpkg -i {package}"));
    assert!(output.contains("no robot is configured"), "{output}");
    for unit in UNITS {
        assert_eq!(property(unit, "UnitFileState"), "enabled", "{unit}");
        assert_eq!(property(unit, "ConditionResult"), "no", "{unit}");
        assert_eq!(property(unit, "ActiveState"), "inactive", "{unit}");
    }
    // The examples are some.
    for daemon in ["gateway", "estimator"] {
        let config = format!("/usr/share/doc/proprio/examples/icub_left_arm/{daemon}.toml");
        sh(&format!("{PROGRAM} {daemon} --config {config} --check"));
    }
    assert!(
        !fs::read(PROGRAM)
            .expect("it")
            .windows(12)
            .any(|w| w == b".debug_line\0")
    );

    let machine = Machine::running().expect("a package");
    for unit in UNITS {
        // /lib may be a link to /usr/lib.
        let file = fs::canonicalize(property(unit, "FragmentPath")).expect("a unit");
        assert_eq!(file, Path::new("/usr/lib/systemd/system").join(unit));
        assert_eq!(property(unit, "NRestarts"), "0", "{unit}");
        let id = process(unit);
        let owner = fs::metadata(format!("/proc/{id}")).expect("it runs").uid();
        assert_eq!(owner.to_string(), sh("id -u proprio"), "{unit}");
    }
    let of_a_device = journal(&format!("-u {} DEVICE=l_arm_ft_sensor", UNITS[0]));
    assert!(of_a_device.contains("streaming"), "{of_a_device}");
    assert!(
        !Path::new("/usr/local/bin/proprio").exists(),
        "it would hide an upgrade"
    );
    for (unit, most) in UNITS.into_iter().zip([1.8, 0.7]) {
        let report = sh(&format!("systemd-analyze security --no-pager {unit}"));
        let level = report.split("exposure level for ").nth(1).expect("a level");
        let level = level
            .split(' ')
            .nth(1)
            .and_then(|word| word.parse::<f64>().ok());
        println!("{unit}: exposure {level:?}");
        assert!(level.is_some_and(|level| level <= most), "{unit}: {report}");
    }

    // The sandbox leaves real time.
    let real_time = || {
        "cpu = 0\npriority = 10"
            .parse::<toml::Table>()
            .expect("TOML")
    };
    machine.configure("gateway.toml", |text| {
        changed(&text, |table| {
            for bus in table["bus"].as_array_mut().expect("buses") {
                let bus = bus.as_table_mut().expect("a table");
                bus.insert("realtime".into(), real_time().into());
            }
        })
    });
    machine.configure("estimator.toml", |text| {
        changed(&text, |table| {
            drop(table.insert("realtime".into(), real_time().into()));
        })
    });
    sh(&format!("systemctl restart {}", UNITS.join(" ")));
    machine.expect_torques("in real time");
    for unit in UNITS {
        assert!(!log(unit).contains("not granted"), "{}", log(unit));
        let threads = sh(&format!("ps -L -o cls= -p {}", process(unit)));
        assert!(threads.contains("FF"), "{unit}: {threads}");
    }

    drop(machine);
    sh(&format!(
        "systemctl stop {LOOP}; rm /etc/systemd/system/{LOOP}"
    ));
    sh(&format!("rm -f {READ} /usr/local/bin/control-loop"));
    let files = sh("dpkg -L proprio");
    assert!(files.contains(PROGRAM), "{files}");
    // As of a process that was killed.
    sh("install -o proprio -m 600 /dev/null /dev/shm/proprio_left");
    sh("dpkg -P proprio");
    assert_eq!(leftovers(&files), "", "after a purge");
    let (state, _) = attempt(&format!("systemctl is-active {}", UNITS[0]));
    assert_eq!(state, "inactive");
}

#[test]
fn an_upgrade_keeps_the_configuration_and_restarts_the_services() {
    let Some(machine) = Machine::running() else {
        return;
    };
    let package = Machine::package().expect("a package");
    let line = "# measured on this robot\n";
    machine.configure("gateway.toml", |text| line.to_owned() + &text);
    let before = UNITS.map(process);
    sh(&format!(
        "cd /tmp && rm -rf next && dpkg-deb -R {package} next && \
         sed -i 's/^Version: .*/Version: 999/' next/DEBIAN/control && \
         dpkg-deb -Znone -b next next.deb && rm -r next && dpkg -i next.deb"
    ));
    assert_eq!(sh("dpkg-query -W -f '${Version}' proprio"), "999");
    let kept = fs::read_to_string("/etc/proprio/gateway.toml").expect("it stays");
    assert!(kept.starts_with(line), "{kept}");
    for (unit, before) in UNITS.into_iter().zip(before) {
        let after = process(unit);
        assert!(after != 0 && after != before, "{unit} was not restarted");
    }
    machine.expect_torques("after the upgrade");
    // A removal keeps the configuration, too, and a new installation goes on with it.
    sh("dpkg -r proprio");
    assert!(Path::new("/etc/proprio/gateway.toml").exists());
    sh(&format!("dpkg -i {package}"));
    machine.expect_torques("after a new installation");
}

#[test]
fn a_killed_service_is_back() {
    let Some(machine) = Machine::running() else {
        return;
    };
    for unit in UNITS {
        for _ in 0..2 {
            let old = process(unit);
            let start = now();
            sh(&format!("kill -KILL {old}"));
            eventually(&format!("{unit} is back"), PATIENCE, || {
                let new = process(unit);
                new != 0 && new != old
            });
            let took = time_of("ActiveEnter", unit) - start;
            // Of no meaning in user-mode Linux, which is slow: recovery.rs measures without it.
            println!("{unit}: back after {took} s");
            machine.expect_torques(&format!("after a kill of {unit}"));
        }
    }
}

#[test]
fn a_service_that_hangs_is_restarted_by_the_watchdog() {
    let Some(machine) = Machine::running() else {
        return;
    };
    for unit in UNITS {
        let old = process(unit);
        let start = now();
        sh(&format!("kill -STOP {old}"));
        eventually("the watchdog acts", PATIENCE, || {
            let new = process(unit);
            new != 0 && new != old
        });
        let took = time_of("ExecMainStart", unit) - start;
        println!("{unit}: the watchdog acted after {took} s");
        // 2 s to notice and 0.2 s to wait; the rest is user-mode Linux.
        assert!(took < Nanos::from_millis(10_000), "{unit}: {took} s");
        assert!(log(unit).contains("Watchdog timeout"), "{}", log(unit));
        machine.expect_torques(&format!("after a stop of {unit}"));
    }
}

#[test]
fn a_wrong_configuration_is_told_once_and_a_reload_refuses_it() {
    let Some(machine) = Machine::running() else {
        return;
    };
    let gateway = UNITS[0];
    let old = process(gateway);
    machine.configure("gateway.toml", |text| "bogus = 1\n".to_owned() + &text);
    let (told, reloaded) = attempt(&format!("systemctl reload {gateway}"));
    assert!(!reloaded, "a wrong file was taken: {told}");
    assert_eq!(process(gateway), old);
    machine.expect_torques("after a refused reload");

    for (unit, file) in UNITS.into_iter().zip(["gateway.toml", "estimator.toml"]) {
        machine.configure(file, |text| "bogus = 1\n".to_owned() + &text);
        let errors = || journal(&format!("-p err -u {unit}"));
        let before = errors().matches("bogus = 1").count();
        let (_, restarted) = attempt(&format!("systemctl restart {unit}"));
        assert!(!restarted, "{unit} starts with a wrong file");
        std::thread::sleep(std::time::Duration::from_secs(2));
        assert_eq!(property(unit, "ActiveState"), "failed");
        assert_eq!(property(unit, "ExecMainStatus"), "2");
        assert_eq!(property(unit, "NRestarts"), "0", "{unit}: a loop");
        assert_eq!(
            errors().matches("bogus = 1").count(),
            before + 1,
            "{unit}: {}",
            attempt("journalctl --no-pager -o verbose --grep 'bogus = 1'").0
        );
        machine.configure(file, |text| text);
        sh(&format!("systemctl start {unit}"));
        machine.expect_torques(&format!("after {file} was mended"));
    }
    // A file that is right is taken over by the same process.
    let same = process(gateway);
    machine.configure("gateway.toml", |text| {
        text.replacen("= 1000.0", "= 900.0", 1)
    });
    sh(&format!("systemctl reload {gateway}"));
    assert_eq!(process(gateway), same);
    assert!(
        log(gateway).contains("l_arm_ft_sensor: max_silence_ms"),
        "{}",
        log(gateway)
    );
    machine.expect_torques("after a reload");
}

#[test]
fn a_full_disk_costs_the_state_of_identification_and_nothing_else() {
    let Some(machine) = Machine::running() else {
        return;
    };
    let estimator = UNITS[1];
    sh("mount -t tmpfs -o size=1m,uid=proprio,gid=proprio,mode=755 tmpfs /var/lib/proprio");
    let _ = attempt("cat /dev/zero >/var/lib/proprio/full");
    let before = log(estimator).len();
    let learn = |table: &mut toml::Table| {
        for contact in table["contact"].as_array_mut().expect("contacts") {
            let contact = contact.as_table_mut().expect("a table");
            contact.insert("presence".into(), "possible".into());
        }
        let identification =
            "enabled = true\nsave_every_s = 1.0\nstate = \"/var/lib/proprio/state\"";
        let identification: toml::Table = identification.parse().expect("TOML");
        table.insert("identification".into(), identification.into());
    };
    machine.configure("estimator.toml", |text| changed(&text, learn));
    sh(&format!("systemctl restart {estimator}"));
    let id = process(estimator);
    let counted = |what| {
        let text = log(estimator);
        text[before..].matches(what).count()
    };
    eventually("the full disk is told", PATIENCE, || {
        counted("No space left") > 0
    });
    // With contacts that may come and go, estimates are not valid at once, but they come.
    let flow = |when: &str| {
        let since = now() + Nanos::from_millis(2000);
        eventually(&format!("an estimate {when}"), PATIENCE, || {
            newest_torque().is_some_and(|(t, _)| t > since)
        });
    };
    flow("with a full disk");
    sh("rm /var/lib/proprio/full");
    eventually("the state is written", PATIENCE, || {
        counted("can be written again") > 0 && Path::new("/var/lib/proprio/state").exists()
    });
    flow("after the disk was full");
    assert_eq!(process(estimator), id, "it did not run on");
    assert_eq!(counted("No space left"), 1, "{}", log(estimator));
    machine.configure("estimator.toml", |text| text);
    sh(&format!(
        "systemctl stop {estimator}; umount /var/lib/proprio"
    ));
}

#[test]
fn steps_of_the_clock_are_not_noticed() {
    let Some(machine) = Machine::running() else {
        return;
    };
    let before = UNITS.map(process);
    for step in ["+1 hour", "-3 hours", "+2 hours"] {
        sh(&format!("date -s '{step}'"));
        machine.expect_torques(&format!("after {step}"));
        // Longer than the watchdog's time.
        std::thread::sleep(std::time::Duration::from_secs(3));
    }
    assert_eq!(UNITS.map(process), before);
}

#[test]
fn an_interface_may_go_and_come_back() {
    let Some(machine) = Machine::running() else {
        return;
    };
    let before = UNITS.map(process);
    run("ip link del dev vcan1");
    eventually("no torque without joints", PATIENCE, || {
        newest_torque()
            .is_none_or(|(t, is_valid)| !is_valid || now() - t > Nanos::from_millis(2000))
    });
    assert!(
        log(UNITS[0]).contains("the link is gone"),
        "{}",
        log(UNITS[0])
    );
    add_interface("vcan1");
    machine.expect_torques("after the interface came back");
    assert_eq!(UNITS.map(process), before, "nobody was restarted");
}

#[test]
fn a_stop_leaves_nothing() {
    let Some(machine) = Machine::running() else {
        return;
    };
    sh(&format!("systemctl stop {LOOP}"));
    for unit in UNITS {
        let start = now();
        sh(&format!("systemctl stop {unit}"));
        println!("{unit}: stopped after {} s", now() - start);
        assert_eq!(property(unit, "Result"), "success", "{unit}");
        assert_eq!(property(unit, "ExecMainStatus"), "0", "{unit}");
    }
    assert_eq!(
        sh("find /run/proprio -type f; find /dev/shm -name 'proprio*'"),
        ""
    );
    drop(machine);
}
