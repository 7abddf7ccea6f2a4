//! What a person may do wrong, and what is said of it.

use super::*;

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
    assert_eq!(place.line("").code, Some(2));
    place
        .line("simulate --robot nobody")
        .fails(2, &["there is no robot \"nobody\"", "no gateway.toml in"]);
    place
        .line("simulate --seconds 0")
        .fails(2, &["seconds = 0 must be above 0"]);
    place
        .line("simulate --bus udp:x")
        .fails(2, &["\"udp:x\"", "virtual:left_arm"]);
    for verb in ["simulate", "demo"] {
        place
            .line(&format!("{verb} --fault lots"))
            .fails(2, &["fault \"lots\"", "lost", "for example"]);
        place
            .line(&format!("{verb} --fault silent:nose@1..2"))
            .fails(2, &["no board or channel \"nose\"", "l_arm_ft_sensor"]);
    }
    place
        .line("demo --seconds 3 --fault push:l_hand=20@4..5")
        .fails(2, &["push:l_hand=20@4..5", "after the end", "3 s"]);
    place
        .line("demo --robot nobody")
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
            .line("gateway --config wrong.toml")
            .fails_in("wrong.toml", expected);
        if !to.contains("fast") {
            place
                .line("gateway --config wrong.toml --check")
                .fails_in("wrong.toml", expected);
            place
                .line("decode --config wrong.toml --log - --out o.csv")
                .fails_in("wrong.toml", expected);
        }
    }
    place
        .line("gateway --config none.toml")
        .fails(2, &["none.toml: cannot be read", "No such file"]);
    assert!(
        place
            .line("gateway --config gateway.toml --check")
            .good()
            .out
            .contains("l_elbow")
    );
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
            .line("estimate --config wrong.toml --log - --out o.csv")
            .fails_in("wrong.toml", expected);
    }
    assert!(!place.exists("o.csv"));
    let check = place
        .line("estimator --config estimator.toml --check")
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
    let ran = place.line("estimator --config hidden.toml --check");
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
    let out = check("gateway.toml").good().out;
    assert!(
        out.contains("gateway.toml publishes all channels that the estimator reads\n"),
        "{out}"
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
        .line("estimator --config estimator.toml --gateway gateway.toml")
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
        let ran = place.line("estimator --config wrong.toml --check");
        ran.fails_in("wrong.toml", expected);
        assert!(ran.err.contains("wrong.urdf"), "{}", ran.err);
        place
            .line("estimator --config wrong.toml")
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
        .line("estimate --config locked.toml --log cut.csv --out o.csv")
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

#[test]
fn an_interface_that_is_not_there_is_told_and_so_is_a_kernel_without_can() {
    let place = Place::new();
    on_interface(&place, "nocan7");
    let ran = place.line("gateway --config can.toml");
    let simulate = place.line("simulate --bus nocan7 --bus nocan8 --seconds 1");
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
    let demo = place.line("demo --bus nocan7 --seconds 2 --out d");
    demo.fails(1, &[expected, "gateway"]);
    if has_can() {
        on_interface(&place, "lo");
        place
            .line("gateway --config can.toml")
            .fails(1, &["lo is not a CAN interface"]);
    }
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
    let report = place.line("doctor --json").good().json();
    let checks: Vec<&str> = report
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
    for finding in report.as_array().unwrap() {
        let verdict = finding["verdict"].as_str().unwrap();
        assert!(["ok", "lacking", "failed"].contains(&verdict), "{finding}");
        assert_eq!(
            verdict == "ok",
            finding["hint"].as_str().unwrap().is_empty(),
            "what lacks has a remedy: {finding}"
        );
    }
    let can = report
        .as_array()
        .unwrap()
        .iter()
        .find(|f| f["check"] == "kernel CAN")
        .unwrap();
    assert_eq!(can["verdict"] == "ok", has_can(), "{can}");
    let words = place.line("doctor").good().out;
    assert!(checks.iter().all(|c| words.contains(c)), "{words}");
    // The folder of a domain belongs in memory.
    let verdict = |base: &Path| {
        let mut command = place.command(&["doctor", "--json"]);
        command.env("PROPRIO_RUNTIME_DIR", base);
        let report = finish(command, b"", "doctor").good().json();
        let mut of_memory = report.as_array().unwrap().iter();
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
