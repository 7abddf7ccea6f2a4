//! `proprio top` on a pseudo-terminal, beside daemons that come, go and are killed.
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, ttyname};
use proprio_tests::terminal::Terminal;
use proprio_tests::{Arm, Rig, now};
use proprio_topics::Nanos;
use std::fs;
use std::process::Command;

fn all_valid(text: &str) -> bool {
    text.contains("TORQUES  7 of 7 valid")
}

#[test]
fn a_robot_is_followed_whatever_comes_and_goes() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .aligned(20.0)
        .write(&rig.path("robot"));
    let mut top = Terminal::start(rig.command(&["top"]).env_remove("NO_COLOR"));
    top.wait("it waits", |text| text.contains("waiting: "));
    let _simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    top.wait("channels", |text| text.contains("CHANNELS  9 of 9 alive"));
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    top.wait("torques", all_valid);
    assert!(top.has_colours());

    estimator.kill();
    let text = top.wait("it is gone", |text| text.contains("estimator was killed"));
    assert!(text.contains("  l_elbow           gone"), "{text}");
    estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    top.wait("torques again", all_valid);
    gateway.kill();
    top.wait("the gateway is gone", |text| {
        text.contains("gateway   was killed") && text.contains("CHANNELS  0 of 9 alive")
    });
    let _gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    top.wait("torques again", all_valid);
    // Another program deletes the domain; the daemons make it again.
    let root = rig.domain.base.join(&rig.domain.name);
    fs::remove_dir_all(&root).expect("the domain is there");
    let since = now();
    top.wait("torques, from a new domain", |text| {
        all_valid(text) && root.is_dir() && now() - since > Nanos::from_millis(2000)
    });

    top.press("/ELBOW\r");
    let text = top.wait("a filter", |text| !text.contains("l_wrist_yaw"));
    assert!(
        text.contains("l_elbow") && text.contains("filter: ELBOW"),
        "{text}"
    );
    top.press("p");
    let paused = top.wait("a pause", |text| text.starts_with("PAUSED"));
    let picture = |text: &str| text.split_once('\n').map(|(_, rest)| rest.to_owned());
    std::thread::sleep(std::time::Duration::from_millis(500));
    assert_eq!(picture(&top.text()), picture(&paused));
    top.press("p");
    top.wait("it goes on", |text| {
        text.starts_with("proprio top") && picture(text) != picture(&paused)
    });
    top.press("\x1b");
    top.wait("all names", |text| text.contains("l_wrist_yaw"));

    let path = ttyname(&top.line).expect("its path");
    let mut stty = Command::new("stty");
    stty.arg("-F").arg(path).args(["cols", "40", "rows", "10"]);
    assert!(stty.status().expect("stty runs").success());
    top.resized(10, 40);
    top.wait("a small screen", |text| {
        text.contains("TORQUES") && text.lines().last() == Some("q quit  ? keys")
    });
    top.press("q");
    assert!(top.ended().success());
    estimator.assert_runs();
}

#[test]
fn signals_end_it_and_what_is_no_terminal_is_refused() {
    let rig = Rig::new();
    let start = || {
        let mut command = rig.command(&["top", "--robot", "nobody"]);
        let mut top = Terminal::start(command.env("NO_COLOR", "1"));
        top.wait("it waits", |text| text.contains("waiting: "));
        assert!(!top.has_colours());
        top
    };
    for signal in [Signal::SIGTERM, Signal::SIGINT] {
        let mut top = start();
        let id = Pid::from_raw(i32::try_from(top.child.id()).expect("a process"));
        kill(id, signal).expect("it runs");
        assert!(top.ended().success());
    }
    let mut top = start();
    top.press("\x03");
    assert!(top.ended().success());

    let output = rig.command(&["top"]).output().expect("it runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.starts_with("error: standard output is no terminal"),
        "{said}"
    );
    assert_eq!(said.lines().count(), 1, "{said}");
}
