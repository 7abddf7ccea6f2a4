//! Logs and tables: damaged, converted, in every format.

use super::*;

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
    let assess = [
        "estimate",
        "--config",
        "estimator.toml",
        "--log",
        "good.csv",
        "--assess",
    ];
    let ran = place
        .run(&[&assess[..], &["--out", "a.out"]].concat())
        .good();
    // In that configuration the hand may always be touched.
    assert!(
        ran.err.contains("no F/T reading can be predicted"),
        "{}",
        ran.err
    );
    let report = place
        .run(&[&assess[..], &["--out", "a.out", "--json"]].concat())
        .good()
        .json();
    let assessment = &report["assessment"];
    assert!(
        assessment["changes"] == 0 && assessment["torques"].is_object(),
        "{report}"
    );
    assert!(
        assessment["predicted"]["relative_error"]["cad"].is_null(),
        "{report}"
    );
    let clean = place.estimate("good.csv", "good.out");
    assert_eq!(
        place.read("a.out"),
        place.read("good.out"),
        "figures change no estimate"
    );
    assert!(clean.err.is_empty(), "{}", clean.err);
    let dirty = place.estimate("bad.csv", "bad.out");
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
        let lines = dirty
            .err
            .lines()
            .filter(|l| l.starts_with(&format!("bad.csv: line {line}: skipped: ")));
        let lines: Vec<_> = lines.collect();
        assert!(
            lines.len() == 1 && lines[0].contains(what),
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
        .line("decode --config gateway.toml --log faults.log --out samples.csv")
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
    let report = place.estimate("samples.csv", "estimates.csv").json();
    let withheld = report["withheld_by_reason"].as_object().unwrap();
    let sum: u64 = withheld.values().map(|count| count.as_u64().unwrap()).sum();
    assert!(
        withheld["device_fault"].as_u64().unwrap() > 1000,
        "{report}"
    );
    assert_eq!(report["torques_withheld"], sum, "{report}");
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
    place.estimate("good.csv", "good.out");
    let dirty = place.estimate("bad.csv", "bad.out");
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
            .line(&format!(
                "decode --config gateway.toml --log {log} --out {out}"
            ))
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
    let line = format!("bad.log: at line {} the time steps back by ", motor + 2);
    assert!(dirty.err.contains(&line), "{}", dirty.err);
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
            place.line(&format!(
                "decode --config gateway.toml --log {log} --out {out}"
            ))
        };
        decode("none").fails(1, &["none: cannot be read", "No such file"]);
        decode("empty").fails(1, &["empty: the log holds no frame", "it is empty"]);
        decode("text").fails(1, &["text: the log holds no frame", "line 1"]);
        decode("noise").fails(1, &["noise: the log holds no frame"]);
        let estimate = |log: &str| {
            place.line(&format!(
                "estimate --config estimator.toml --log {log} --out {out}"
            ))
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
            place.line(&format!(
                "encode --config gateway.toml --samples {log} --out {out}"
            ))
        };
        encode("none").fails(1, &["none: cannot be read", "No such file"]);
        encode("empty").fails(1, &["empty: ", "must name the columns"]);
        encode("header.csv").fails(1, &["header.csv: ", "no rows"]);
        encode("noise").fails(1, &["noise: "]);
        assert_eq!(names(&place), there, "no half-written file");
        assert_eq!(place.read("keep.csv"), "precious");
    }
    place
        .line("decode --config gateway.toml --log other.log --out new.csv")
        .fails(1, &["other.log: no sample in 2 frames", "interfaces"]);
    place
        .line("decode --config gateway.toml --log text --out no/such/folder.csv")
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

#[test]
fn encode_and_decode_are_inverses_within_half_a_step() {
    let place = Place::new();
    let samples = oracle("icub_left_arm_mujoco.csv");
    place.write("samples.csv", &samples);
    let report = place
        .line("encode --config gateway.toml --samples samples.csv --out session.log --json")
        .good()
        .json();
    assert_eq!(
        (&report["rows"], &report["samples"], &report["refused"]),
        (&201.into(), &(201 * 9).into(), &0.into()),
        "{report}"
    );
    let report = place.decode("session.log", "again.csv").json();
    assert_eq!(
        (
            &report["samples"],
            &report["bad_lines"],
            &report["unclaimed"]
        ),
        (&(201 * 9).into(), &0.into(), &0.into()),
        "{report}"
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
        .line("encode --config gateway.toml --samples again.csv --out again.log")
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
        .line("encode --config gateway.toml --samples same --out same")
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
    let summary = decoded.err.lines().last().unwrap();
    assert_eq!(
        serde_json::from_str::<Json>(summary).unwrap()["samples"],
        201 * 9,
        "{summary}"
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
        .line("encode --config gateway.toml --samples samples.csv --out a.log")
        .good();
    place
        .line("decode --config gateway.toml --log a.log --out a.csv")
        .good();
    place
        .line("estimate --config estimator.toml --log a.csv --out e.csv")
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
        .line("decode --config gateway.toml --log a.log --out /dev/null")
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
    let report = place.decode("session.log", "s.csv").json();
    for device in report["devices"].as_array().unwrap() {
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
