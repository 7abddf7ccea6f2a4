//! The demonstration: what it shows, and what it leaves behind.

use super::*;

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
        .line("decode --config gateway.toml --log still.log --out still.csv")
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
        .line("estimate --config learning.toml --log still.csv --out e.csv")
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
