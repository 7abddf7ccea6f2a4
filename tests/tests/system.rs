//! `proprio status`, `echo` and `record` beside a running system.
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::sys::stat::Mode;
use nix::unistd::{Pid, mkfifo};
use proprio_tests::watch::{Newest, open, valid_since};
use proprio_tests::{Arm, PATIENCE, Rig, now, until};
use proprio_topics::csv::{Row, SeriesKind, TableReader, Value};
use proprio_topics::{GatewayHealth, Kind, Nanos, TorqueEstimate};
use serde_json::Value as Json;
use std::fs::{self, File};
use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixDatagram;
use std::process::Stdio;
use std::time::Duration;

#[test]
fn a_running_system_says_what_it_does() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .write(&rig.path("robot"));
    let out = |arguments: &[&str]| {
        let output = rig.command(arguments).output().expect("it runs");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (
            output.status.code(),
            text(&output.stdout),
            text(&output.stderr),
        )
    };
    // Nobody is there: the commands say so, and create nothing.
    let (code, _, err) = out(&["status"]);
    assert!(
        code == Some(1) && err.contains("no gateway or estimator runs"),
        "{err}"
    );

    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder, "--skin"]);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let domain = rig.open();
    let mut torques = open::<TorqueEstimate>(&domain, "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());

    let (code, text, err) = out(&["status", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let status: Json = serde_json::from_str(&text).expect("JSON");
    assert_eq!(violations(&status, &schema(), "status"), [""; 0], "{text}");
    let robot = &status["robots"][0];
    assert_eq!(robot["robot"], "icub_left_arm");
    for process in ["gateway", "estimator"] {
        assert_eq!(robot[process]["is"], "is running", "{text}");
    }
    assert_eq!(robot["gateway"]["health"]["buses"][0]["link"], "up");
    let rates: Vec<_> = robot["channels"]
        .as_array()
        .expect("a list")
        .iter()
        .collect();
    assert_eq!(rates.len(), 9);
    for channel in rates {
        // Not a measure of speed: a machine that does other things catches up in bursts.
        let rate = channel["rate_hz"].as_f64().expect("a rate");
        assert!((20.0..5000.0).contains(&rate), "{channel}");
        assert!(
            channel["age_s"].as_f64().is_some_and(|age| age < 5.0),
            "{channel}"
        );
    }
    let health = &robot["estimator"]["health"];
    let rate = health["estimates_hz"].as_f64().expect("a rate");
    assert!((20.0..5000.0).contains(&rate), "{health}");
    let (_, text, _) = out(&["status"]);
    for part in [
        "robot icub_left_arm",
        "gateway is running",
        "streaming",
        "l_arm_ft_sensor",
    ] {
        assert!(text.contains(part), "{text}");
    }

    let (code, text, err) = out(&["echo", "l_arm_ft_sensor", "--count", "5", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let samples: Vec<Json> = text
        .lines()
        .map(|l| serde_json::from_str(l).expect("JSON"))
        .collect();
    assert_eq!(samples.len(), 5);
    assert!(
        samples
            .windows(2)
            .all(|w| w[0]["t_ns"].as_i64() < w[1]["t_ns"].as_i64())
    );
    assert!(
        samples[0]["values"]["fz"]
            .as_f64()
            .is_some_and(|fz| fz != 0.0),
        "{text}"
    );
    let (code, _, err) = out(&["echo", "l_arm_ft_sensr"]);
    assert!(
        code == Some(1) && err.contains("did you mean \"l_arm_ft_sensor\"?"),
        "{err}"
    );

    // Lines arrive as they come, not in blocks.
    let piped = || {
        let mut command = rig.command(&["echo", "l_elbow"]);
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command.spawn().expect("it runs")
    };
    let mut echo = piped();
    let mut pipe = echo.stdout.take().expect("a pipe");
    let mut read = || {
        let mut bytes = vec![0; 1 << 16];
        let count = pipe.read(&mut bytes).expect("readable");
        String::from_utf8(bytes[..count].to_vec()).expect("text")
    };
    let pieces: Vec<String> = (0..10).map(|_| read()).collect();
    assert!(pieces.iter().any(|piece| piece.len() < 4096), "{pieces:?}");
    // A signal ends it with a whole line.
    let pid = Pid::from_raw(i32::try_from(echo.id()).expect("a process"));
    kill(pid, Signal::SIGINT).expect("it runs");
    let mut rest = pieces.concat();
    loop {
        match read() {
            piece if piece.is_empty() => break,
            piece => rest.push_str(&piece),
        }
    }
    assert_eq!(echo.wait().expect("it ends").code(), Some(0));
    let is_whole = |line: &str| {
        (line.contains(" joint position ") || line.contains(" actuator duty "))
            && line.contains("  ")
    };
    assert!(rest.ends_with('\n') && rest.lines().all(is_whole), "{rest}");
    // Who reads may stop: it ends, and says nothing.
    let mut echo = piped();
    drop(echo.stdout.take());
    let ended = until(PATIENCE, || echo.try_wait().expect("a process"));
    let mut said = String::new();
    let mut log = echo.stderr.take().expect("a pipe");
    log.read_to_string(&mut said).expect("text");
    assert_eq!(
        (ended.and_then(|end| end.code()), said.as_str()),
        (Some(0), "")
    );

    // A recording holds what was published, in order, over a restart of the gateway.
    let table = rig.path("samples.csv");
    let table_text = table.to_string_lossy().into_owned();
    // It does not overwrite unless it is asked to.
    fs::write(&table, "mine").expect("a file");
    let (code, _, err) = out(&["record", "--out", &table_text, "--seconds", "3"]);
    assert!(
        code == Some(1) && err.contains("overwrite it with --force"),
        "{err}"
    );
    assert_eq!(fs::read_to_string(&table).expect("a file"), "mine");
    let mut recording = rig.start(&["record", "--out", &table_text, "--force", "--seconds", "3"]);
    let begun = || fs::metadata(&table).is_ok_and(|m| m.len() > 64 << 10);
    assert!(
        until(PATIENCE, || begun().then_some(())).is_some(),
        "no rows"
    );
    gateway.kill();
    gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    recording.wait();
    let said = recording.output();
    assert!(said.contains(" 0 lost, 0 out of order"), "{said}");
    assert!(said.contains("1 restarts of the gateway ("), "{said}");
    let log = recording.log();
    assert!(
        log.contains("the gateway was restarted: a gap of "),
        "{log}"
    );
    let mut reader = TableReader::new(File::open(&table).expect("a table")).expect("a table");
    let series = reader.series().to_vec();
    assert!(
        series
            .iter()
            .any(|s| s.kind == SeriesKind::Contact && s.name == "hand"),
        "{series:?}"
    );
    let ft = series
        .iter()
        .position(|s| s.kind == SeriesKind::Channel(Kind::Wrench));
    let (mut row, mut last, mut count) = (Row::default(), Nanos::MIN, 0);
    while reader.next_row(&mut row).expect("readable") {
        let t = row.t.expect("a stamp");
        assert!(t >= last);
        if row
            .items
            .iter()
            .any(|item| Some(item.series) == ft && matches!(item.value, Value::Reading(..)))
        {
            count += 1;
        }
        last = t;
    }
    assert_eq!(reader.report().bad_rows, 0);
    // Most of three seconds at 250 Hz, on a machine that may catch up in bursts.
    assert!((400..=2000).contains(&count), "{count}");
    [&mut estimator, &mut gateway, &mut simulator]
        .into_iter()
        .for_each(proprio_tests::Process::end);
    drop((torques, domain));
    rig.assert_nothing_left();
}

/// A board that fell silent was seen, and what depends on it is withheld: `status` and `echo` say
/// so, and why.
#[test]
fn what_fell_silent_was_last_seen_and_withholds_torques() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .write(&rig.path("robot"));
    let out = |arguments: &[&str]| {
        let output = rig.command(arguments).output().expect("it runs");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (
            output.status.code(),
            text(&output.stdout),
            text(&output.stderr),
        )
    };
    let silent = ["--fault", "silent:l_elbow_motor@6.."];
    let simulate = ["simulate", "--robot", &arm.folder, silent[0], silent[1]];
    let mut simulator = rig.start(&simulate);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let (_, _, err) = out(&["echo", "--robot", "icub_left_arm", "--torques"]);
    assert!(!err.is_empty(), "no estimator runs");
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let domain = rig.open();
    let mut torques = open::<TorqueEstimate>(&domain, "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());

    // Before: values with their standard deviations.
    let text = until(PATIENCE, || {
        let (code, text, err) = out(&["echo", "--torques", "l_elbow", "--count", "1"]);
        assert_eq!(code, Some(0), "{err}");
        text.contains(" +- ").then_some(text)
    });
    let text = text.expect("a torque");
    assert!(
        text.contains(" l_elbow ") && !text.contains("l_wrist_yaw"),
        "{text}"
    );
    let (code, text, err) = out(&["echo", "--contacts", "--count", "2", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let lines: Vec<Json> = text
        .lines()
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect();
    assert_eq!(lines.len(), 2);
    let hand = &lines[0]["contacts"]["hand"];
    let keys = [
        "force", "torque", "std", "valid", "reason", "cause", "located", "detected",
    ];
    assert!(keys.iter().all(|key| hand.get(key).is_some()), "{text}");
    assert_eq!(hand["valid"] == true, hand["force"].is_array(), "{text}");
    let (code, text, err) = out(&["echo", "--contacts", "hand", "--count", "1"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(
        text.contains(" hand fx ") || text.contains(" hand withheld: "),
        "{text}"
    );
    for (arguments, what) in [
        (
            ["echo", "--torques", "l_elbw"],
            "no joint \"l_elbw\"; did you mean \"l_elbow\"?",
        ),
        (["echo", "--contacts", "foot"], "no contact \"foot\""),
    ] {
        let (code, _, err) = out(&arguments);
        assert!(code == Some(1) && err.contains(what), "{err}");
    }

    // After: the channel was last seen then, without a quality, and the torques say why.
    let channel = |status: &Json| {
        let channels = status["robots"][0]["channels"].as_array();
        let mut channels = channels.into_iter().flatten();
        channels
            .find(|channel| channel["name"] == "l_elbow")
            .cloned()
    };
    let status = until(PATIENCE, || {
        let (_, text, _) = out(&["status", "--json"]);
        let status: Json = serde_json::from_str(&text).ok()?;
        (channel(&status)?["age_s"].as_f64()? > 1.5).then_some(status)
    });
    let status = status.expect("it falls silent");
    assert_eq!(
        violations(&status, &schema(), "status"),
        [""; 0],
        "{status}"
    );
    let elbow = channel(&status).expect("a channel");
    assert_eq!(
        (&elbow["quality"], &elbow["rate_hz"]),
        (&Json::Null, &Json::from(0.0))
    );
    let torque = &status["robots"][0]["estimator"]["health"]["torques"]["l_wrist_yaw"];
    assert_eq!(torque["valid"], false, "{status}");
    assert_eq!(
        (&torque["reason"], &torque["cause"]),
        (&"stale".into(), &"l_elbow".into())
    );
    assert_eq!(
        (&torque["torque"], &torque["std"]),
        (&Json::Null, &Json::Null)
    );
    let (_, text, _) = out(&["status"]);
    let line = text.lines().find(|line| line.contains("joint    l_elbow "));
    let line = line.expect("a line");
    assert!(
        line.contains("last seen ") && !line.contains("good"),
        "{line}"
    );
    let says_why =
        |line: &str| line.contains("l_wrist_yaw") && line.contains("withheld: stale (l_elbow)");
    assert!(text.lines().any(says_why), "{text}");
    // Who waits for its samples is told.
    let mut echo = rig.command(&["echo", "l_elbow"]);
    let mut echo = echo.stderr(Stdio::piped()).spawn().expect("it runs");
    let mut word = [0; 8];
    let mut log = echo.stderr.take().expect("a pipe");
    log.read_exact(&mut word).expect("a line");
    assert_eq!(&word, b"waiting:");
    kill(
        Pid::from_raw(i32::try_from(echo.id()).expect("a process")),
        Signal::SIGINT,
    )
    .expect("it runs");
    assert_eq!(echo.wait().expect("it ends").code(), Some(0));
    let (_, text, _) = out(&["echo", "--torques", "l_wrist_yaw", "--count", "1"]);
    assert!(
        text.trim_end()
            .ends_with(" l_wrist_yaw withheld: stale (l_elbow)"),
        "{text}"
    );
    let (_, text, _) = out(&["echo", "--torques", "--count", "1", "--json"]);
    let line: Json = serde_json::from_str(&text).expect("JSON");
    assert!(line["t_ns"].is_i64());
    let of_joints = line["torques"].as_object().expect("an object");
    assert_eq!(of_joints.len(), 7);
    assert_eq!(of_joints["l_wrist_yaw"]["reason"], "stale");

    [&mut estimator, &mut gateway, &mut simulator]
        .into_iter()
        .for_each(proprio_tests::Process::end);
    drop((torques, domain));
    rig.assert_nothing_left();
}

/// A service manager restarts a gateway whose watchdog is not fed. The stuck bus is one whose log
/// comes through a pipe, from which nothing comes for a while.
#[test]
fn the_watchdog_is_not_fed_while_one_bus_is_stuck() {
    let rig = Rig::new();
    let (address, log) = (rig.path("notify"), rig.path("log"));
    let manager = UnixDatagram::bind(&address).expect("a socket");
    manager
        .set_read_timeout(Some(Duration::from_millis(500)))
        .expect("a socket");
    mkfifo(&log, Mode::from_bits_truncate(0o600)).expect("a pipe");
    let mut pipe = File::options()
        .read(true)
        .write(true)
        .open(&log)
        .expect("a pipe");
    let board = |address: u32| {
        format!(
            "[[bus.device]]\ndriver = \"icub_strain\"\nname = \"ft{address}\"\n\
             address = {address}\nfull_scale_n = [1804.0, 1804.0, 1804.0]\n\
             full_scale_nm = [31.0, 31.0, 31.0]\n"
        )
    };
    let config = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"a\"\n\
         source = {{ kind = \"virtual\", name = \"a\" }}\n{}\
         [[bus]]\nname = \"b\"\nsource = {{ kind = \"replay\", log = \"log\" }}\n{}",
        board(1),
        board(2)
    );
    fs::write(rig.path("gateway.toml"), config).expect("a file");
    let mut command = rig.command(&["gateway", "--config"]);
    command
        .arg(rig.path("gateway.toml"))
        .env("NOTIFY_SOCKET", &address)
        .env("WATCHDOG_USEC", "3000000");
    let mut gateway = rig.spawn(command, "gateway");

    // A second of frames from now on, more than the reader takes at once: 64 KiB.
    let begun = now();
    let second = || {
        let start = 1.5 + (now() - begun).seconds();
        let lines: String = (0..4000)
            .map(|k| {
                format!(
                    "({:.5}) b 32A#008000800080\n",
                    start + 0.00025 * f64::from(k)
                )
            })
            .collect();
        lines.into_bytes()
    };
    let is_fed = || {
        let mut bytes = [0; 256];
        let received = manager.recv(&mut bytes);
        received.is_ok_and(|length| bytes[..length].starts_with(b"WATCHDOG=1"))
    };
    let mut health = None;
    for _ in 0..2 {
        pipe.write_all(&second()).expect("it is read");
        assert!(
            until(PATIENCE, || is_fed().then_some(())).is_some(),
            "{}",
            gateway.log()
        );
        assert!(
            until(PATIENCE, || (!is_fed()).then_some(())).is_some(),
            "{}",
            gateway.log()
        );
        // It lives, and says so to whoever reads.
        gateway.assert_runs();
        health
            .get_or_insert_with(|| Newest::<GatewayHealth>::open(&rig.open(), "r"))
            .fresh();
    }
    drop((health, pipe));
    gateway.end();
}

fn schema() -> Json {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/status.schema.json");
    serde_json::from_str(&fs::read_to_string(file).expect("the schema")).expect("JSON")
}

/// Where a value differs from a JSON schema. Only of what our schema uses: a whole validator would
/// bring twenty crates.
fn violations(value: &Json, schema: &Json, place: &str) -> Vec<String> {
    let is_a = |word: &Json| match word.as_str() {
        Some("object") => value.is_object(),
        Some("array") => value.is_array(),
        Some("string") => value.is_string(),
        Some("number") => value.is_number(),
        Some("integer") => value.is_u64() || value.is_i64(),
        Some("boolean") => value.is_boolean(),
        Some("null") => value.is_null(),
        _ => panic!("{place}: no type {word}"),
    };
    let types = &schema["type"];
    let fits = types
        .as_array()
        .map_or_else(|| is_a(types), |all| all.iter().any(is_a));
    if !fits {
        return vec![format!("{place}: {value} is no {types}")];
    }
    let mut found = Vec::new();
    for item in value.as_array().into_iter().flatten() {
        found.extend(violations(item, &schema["items"], &format!("{place}[]")));
    }
    let Some(members) = value.as_object() else {
        return found;
    };
    let required = schema["required"].as_array().into_iter().flatten();
    let missing = required
        .filter_map(Json::as_str)
        .filter(|key| !members.contains_key(*key));
    found.extend(missing.map(|key| format!("{place}: no {key}")));
    for (key, member) in members {
        match schema["properties"]
            .get(key)
            .unwrap_or(&schema["additionalProperties"])
        {
            own @ Json::Object(_) => {
                found.extend(violations(member, own, &format!("{place}.{key}")));
            }
            _ => found.push(format!("{place}: {key} is not in the schema")),
        }
    }
    found
}

#[test]
fn a_status_that_differs_from_its_schema_is_noticed() {
    let right = serde_json::json!({ "domain": "d", "domains": [], "robots": [] });
    assert_eq!(violations(&right, &schema(), "status"), [""; 0]);
    for (key, value, expected) in [
        ("domain", Json::Null, "status.domain: null is no"),
        ("new", Json::Null, "status: new is not in the schema"),
        (
            "robots",
            serde_json::json!([{}]),
            "status.robots[]: no robot",
        ),
    ] {
        let mut altered = right.clone();
        altered[key] = value;
        let found = violations(&altered, &schema(), "status");
        assert!(found[0].starts_with(expected), "{found:?}");
    }
}
