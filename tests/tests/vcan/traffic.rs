//! What a bus may carry: errors, floods, halves of two boards, skewed clocks.

use super::*;

/// A controller's error frames, which on a virtual interface any program may send: each cause is
/// counted, the first of a run is told in words, and bus-off is a state of the link.
#[test]
fn error_frames_reach_health_and_log() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let arm = Arm::slow()
        .on_interfaces(INTERFACES)
        .write(&rig.path("robot"));
    let mut gateway = gateway(&rig, &arm);
    let domain = rig.open();
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    health.wait("both links up", |h| {
        h.buses().iter().filter(|b| b.link == LinkState::Up).count() == 2
    });
    let errors = |h: &GatewayHealth, cause: BusError| h.buses()[0].errors[cause as usize];
    // Error passive in both directions with the error counters, ten times; then an overflow, and a
    // stuff error in the data length code.
    for _ in 0..10 {
        can::run("cansend vcan0 20000204#0030000000008087");
    }
    can::run("cansend vcan0 20000004#0001000000000000");
    can::run("cansend vcan0 20000008#0000040B00000000");
    let state = health.wait("the errors", |h| errors(h, BusError::Protocol) == 1);
    let bus = &state.buses()[0];
    assert_eq!(
        [BusError::Passive, BusError::RxOverflow, BusError::Bus].map(|c| errors(&state, c)),
        [10, 1, 0]
    );
    assert_eq!((bus.error_frames, bus.dropped), (12, 1));
    assert_eq!(state.buses()[1].error_frames, 0, "the other bus has none");
    // What the kernel knows of a virtual interface.
    let state = health.wait("the interface's totals", |h| {
        h.buses()[0].interface.rx_frames >= 12
    });
    assert_eq!(state.buses()[0].interface.fd, 1);

    // A bus-off with "back to active" in the same frame, as candleLight sends it, is only counted.
    for _ in 0..5 {
        can::run("cansend vcan0 20000044#004C0000007F7F00");
    }
    health.wait("the reports", |h| errors(h, BusError::BusOff) == 5);
    std::thread::sleep(Duration::from_millis(300));
    let state = health.fresh();
    assert_eq!(state.buses()[0].link, LinkState::Up);
    can::run("cansend vcan0 20000040#0000000000000000");
    health.wait("bus-off", |h| h.buses()[0].link == LinkState::BusOff);
    can::run("cansend vcan0 20000100#0000000000000000");
    let back = health.wait("up again", |h| h.buses()[0].link == LinkState::Up);
    assert_eq!(back.buses()[0].link_losses, 1);
    assert_eq!(back.buses()[1].link_losses, 0);
    drop((health, domain));
    gateway.end();
    let log = gateway.log();
    for (words, count) in [
        ("rx passive, tx passive; error counters: tx=128, rx=135", 1),
        ("receive buffer overflow", 1),
        ("protocol violation at data length code", 1),
        ("the link is bus_off", 1),
        ("the link is up again", 1),
    ] {
        assert_eq!(log.matches(words).count(), count, "{words:?} in\n{log}");
    }
    rig.assert_nothing_left();
}

/// Nothing leaves a gateway on a bus that it may only listen to, although its board is one that it
/// would start.
#[test]
fn nothing_is_sent_on_a_bus_to_listen_to() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let config = rig.path("gateway.toml");
    let plan = |listen_only: bool| {
        format!(
            "schema = 1\nrobot = \"listener\"\n[[bus]]\nname = \"bus\"\n\
             source = {{ kind = \"socketcan\", interface = \"vcan0\" }}\n\
             listen_only = {listen_only}\n[[bus.device]]\ndriver = \"icub_strain\"\n\
             name = \"ft\"\naddress = 1\nfull_scale_n = [1804.0, 1804.0, 1804.0]\n\
             full_scale_nm = [31.0, 31.0, 31.0]\n"
        )
    };
    for listen_only in [true, false] {
        fs::write(&config, plan(listen_only)).expect("a configuration");
        let dump = Candump::start(&rig, "vcan0", "", "7FF#");
        let mut gateway = rig.start(&["gateway", "--config", text(&config)]);
        let domain = rig.open();
        let mut health = Newest::<GatewayHealth>::open(&domain, "listener");
        health.wait("the link up", |h| {
            bus(h.buses(), "bus").link == LinkState::Up
        });
        for frame in ["31A#008000800080", "31B#008000800080"] {
            can::run(&format!("cansend vcan0 {frame}"));
        }
        health.wait("both frames", |h| bus(h.buses(), "bus").frames == 2);
        // The board is started again after 0.35 s of silence.
        std::thread::sleep(Duration::from_millis(1000));
        let sent = bus(health.fresh().buses(), "bus").sent;
        drop((health, domain));
        gateway.end();
        assert_eq!(sent == 0, listen_only, "{sent} sent");
        assert_eq!(dump.count() == 2, listen_only, "{}", dump.log());
    }
    rig.assert_nothing_left();
}

/// A scan that is not active sends nothing, and hears what others send.
#[test]
fn a_scan_of_an_interface_sends_nothing() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    for active in [false, true] {
        let dump = Candump::start(&rig, "vcan0", "", "7FF#");
        let mut arguments = vec!["scan", "--bus", "vcan0", "--seconds", "1"];
        if active {
            arguments.push("--active");
        }
        let mut scan = rig.start(&arguments);
        std::thread::sleep(Duration::from_millis(500));
        can::run("cansend vcan0 31A#008000800080");
        scan.wait();
        let output = scan.output();
        assert!(output.contains("31A"), "{output}");
        // Its questions are the others: all in classic frames and, on this interface, in CAN FD.
        assert_eq!(dump.count() == 1, !active, "{}", dump.log());
    }
}

/// Random frames of every kind, and every configured identifier with every length. The gateway
/// counts each frame that passes its filters, for the same reasons as `proprio decode` on candump's
/// log, and keeps running.
#[test]
fn floods_are_counted() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let arm = Arm::slow()
        .on_interfaces(INTERFACES)
        .write(&rig.path("robot"));
    let plan = &arm.robot.plan;
    let dumps: Vec<Candump> = INTERFACES
        .iter()
        .enumerate()
        .map(|(number, interface)| {
            let claims = claims(plan, number);
            let probe = format!("{:03X}#", claims[0].id.raw());
            Candump::start(&rig, interface, &can::filter(&claims), &probe)
        })
        .collect();
    let mut gateway = gateway(&rig, &arm);
    let domain = rig.open();
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    health.wait("both links up", |h| {
        h.buses().iter().filter(|b| b.link == LinkState::Up).count() == 2
    });
    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let readings = |h: &GatewayHealth| {
        h.devices()
            .iter()
            .map(|d| count(d, Counter::Readings))
            .collect::<Vec<_>>()
    };
    let quiet = health.wait("readings of all", |h| readings(h).iter().all(|n| *n > 5));
    assert_eq!(
        quiet
            .devices()
            .iter()
            .map(|d| count(d, Counter::Length))
            .sum::<u64>(),
        0
    );

    let mut data = fastrand::Rng::with_seed(3);
    let mut log = String::new();
    for (number, interface) in INTERFACES.iter().enumerate() {
        for kind in ["", "-e", "-R", "-e -R", "-f", "-m"] {
            can::run(&format!(
                "cangen {interface} -g 0 -p 100 -I r -L r -D r -n 1500 {kind}"
            ));
        }
        for claim in claims(plan, number) {
            for length in (0..=8).cycle().take(45) {
                let bytes: String = (0..length)
                    .map(|_| format!("{:02X}", data.u8(..)))
                    .collect();
                log.push_str(&format!(
                    "(0.000000) {interface} {:03X}#{bytes}\n",
                    claim.id.raw()
                ));
            }
        }
    }
    let claimed = rig.path("claimed.log");
    fs::write(&claimed, log).expect("a log");
    can::run(&format!("canplayer -t -g 0 -I {}", claimed.display()));
    let flooded = health.fresh();
    let continued = health.within(recovery(), |h| {
        readings(h)
            .iter()
            .zip(readings(&flooded))
            .all(|(now, then)| *now > then + 5)
    });
    let continued = continued.expect("readings of all soon after the flood");
    // Each claimed identifier had 5 frames of each of the lengths 0 to 8, of which at most three
    // are legal.
    for device in continued.devices() {
        assert!(count(device, Counter::Length) >= 30, "{device:?}");
    }
    gateway.assert_runs();
    simulator.end();

    // All frames have been received and written when both numbers are equal and stay constant.
    let mut last = None;
    until(PATIENCE, || {
        std::thread::sleep(Duration::from_millis(300));
        let received: Vec<u64> = health
            .fresh()
            .buses()
            .iter()
            .map(|b| b.frames + b.dropped)
            .collect();
        let seen: Vec<u64> = dumps.iter().map(|dump| dump.count() as u64).collect();
        let equal = received == seen;
        (last.replace(seen.clone()) == Some(seen) && equal).then_some(())
    });
    let end = health.fresh();
    let log = rig.path("flood.log");
    fs::write(&log, dumps.iter().map(Candump::log).collect::<String>()).expect("a log");
    for (dump, bus) in dumps.iter().zip(end.buses()) {
        assert!(!dump.log().contains("DROP"), "candump itself lost frames");
        println!(
            "{}: candump {}, gateway {} and {} dropped",
            bus.name,
            dump.count(),
            bus.frames,
            bus.dropped
        );
        assert_eq!(bus.frames + bus.dropped, dump.count() as u64, "{bus:?}");
        assert_eq!(bus.unclaimed, 0);
    }
    // Compare by reason, if the gateway has received all frames that candump has.
    if end.buses().iter().all(|b| b.dropped == 0) {
        let table = rig.path("flood.csv");
        let decode = [
            "decode",
            "--config",
            &arm.gateway,
            "--log",
            text(&log),
            "--out",
            text(&table),
            "--json",
        ];
        let decoded: serde_json::Value =
            serde_json::from_slice(&rig.run(&decode).stdout).expect("a summary");
        for (device, offline) in end
            .devices()
            .iter()
            .zip(decoded["devices"].as_array().expect("devices"))
        {
            assert_eq!(offline["name"], device.name.as_str());
            assert_eq!(
                offline["frames"],
                count(device, Counter::Frames),
                "{offline}"
            );
            // The gateway accepts an IMU's answers only after a question, but `decode` only
            // listens.
            if device.name.as_str() == "chest_imu" {
                continue;
            }
            for counter in [Counter::Length, Counter::Value] {
                let counted = offline["counts"]
                    .get(counter.word())
                    .and_then(serde_json::Value::as_u64)
                    .unwrap_or(0);
                assert_eq!(
                    counted,
                    count(device, counter),
                    "{} of {offline}",
                    counter.word()
                );
            }
        }
    }
    drop((health, domain));
    gateway.end();
    assert!(!gateway.log().contains("panicked"));
    rig.assert_nothing_left();
}

// --- Order and time
// --------------------------------------------------------------------------------

/// 31A 32A 31B 32B: two boards on one bus whose halves interleave.
#[test]
fn interleaved_boards_keep_their_own_halves() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let config = rig.path("gateway.toml");
    let board = |address: u32, scale: u32| {
        format!(
            "[[bus.device]]\ndriver = \"icub_strain\"\nname = \"ft{address}\"\n\
             address = {address}\nlisten_only = true\n\
             max_silence_ms = 5000\npair_timeout_ms = 500.0\n\
             full_scale_n = [{scale}, {scale}, {scale}]\n\
             full_scale_nm = [{scale}, {scale}, {scale}]\n"
        )
    };
    // The first board has a step of 1, the second of 2.
    let source = "schema = 1\nrobot = \"pair\"\n[[bus]]\nname = \"bus\"\n\
                  source = { kind = \"socketcan\", interface = \"vcan0\" }\n";
    fs::write(
        &config,
        format!("{source}{}{}", board(1, 32768), board(2, 65535)),
    )
    .expect("a configuration");
    let mut gateway = rig.start(&["gateway", "--config", text(&config)]);
    let domain = rig.open();
    let mut recorder = Recorder::of_samples(&domain, "pair");
    let mut health = Newest::<GatewayHealth>::open(&domain, "pair");
    health.wait("the link up", |h| {
        bus(h.buses(), "bus").link == LinkState::Up
    });

    // A reader's buffer holds those of both boards.
    let (readings, mut log) = (100_u32, String::new());
    for k in 0..readings {
        // Every half contains its reading's number: force k, torque k + 1000; those of the second
        // board are 5000 higher.
        for (n, (id, value)) in [
            (0x31A, k),
            (0x32A, k + 5000),
            (0x31B, k + 1000),
            (0x32B, k + 6000),
        ]
        .into_iter()
        .enumerate()
        {
            let [low, high] = u16::try_from(0x8000 + value)
                .expect("16 bits")
                .to_le_bytes();
            let t = 1.0 + 0.005 * f64::from(k) + 0.0002 * n as f64;
            log.push_str(&format!(
                "({t:.6}) can7 {id:03X}#{}\n",
                format!("{low:02X}{high:02X}").repeat(3)
            ));
        }
    }
    let file = rig.path("interleaved.log");
    fs::write(&file, log).expect("a log");
    can::run(&format!("canplayer -I {} vcan0=can7", file.display()));
    until(PATIENCE, || {
        recorder.take();
        (recorder.taken.len() >= 2 * readings as usize).then_some(())
    });
    for (number, (first, unit)) in [(0.0, 1.0), (5000.0, 65535.0 / 32768.0)]
        .into_iter()
        .enumerate()
    {
        let samples: Vec<_> = recorder
            .taken
            .iter()
            .filter(|s| s.channel as usize == number)
            .collect();
        assert_eq!(samples.len(), readings as usize, "board {number}");
        for (k, sample) in samples.iter().enumerate() {
            let Reading::Wrench(wrench) = sample.reading().unwrap() else {
                panic!("{sample:?}")
            };
            let force = (first + k as f64) * unit;
            assert_eq!(
                (wrench.force, wrench.torque),
                ([force; 3], [force + 1000.0 * unit; 3]),
                "reading {k}"
            );
            assert_eq!(sample.header.quality.0, 0);
        }
    }
    let end = health.fresh();
    assert!(
        end.devices()
            .iter()
            .all(|d| count(d, Counter::Unpaired) == 0),
        "{:?}",
        end.devices()
    );
    drop((recorder, health, domain));
    gateway.end();
    rig.assert_nothing_left();
}

/// The second bus is delayed, by half a millisecond and by more than the wait of an estimate. No
/// value gets to a wrong channel, every stamp of the trigger gives one estimate, and the estimates
/// equal those of `proprio estimate`, bit for bit.
#[test]
fn skewed_buses_are_not_mixed_up() {
    if !vcan() {
        return;
    }
    // Periods of F/T, IMU and joints, how long an estimate waits, and the skew [ms]. In the first
    // case each estimate has all channels; in the second the joints are later, and have a longer
    // period, than the wait of an estimate. The wait ends as far before a stamp of the trigger as
    // possible, so that the result does not depend on which bus's thread runs first.
    for (periods, max_wait, skew) in [([10, 20, 20], 250.0, 0.5), ([20, 20, 80], 41.0, 60.0)] {
        // If the machine stalls for longer than the wait, samples are late: then try again.
        let mut outcome = Ok(());
        for _ in 0..5 {
            outcome = skewed_buses(periods, max_wait, Nanos::from_seconds(skew * 1e-3));
            match &outcome {
                Err(stalled) => println!("{stalled}"),
                Ok(()) => break,
            }
        }
        assert_eq!(outcome, Ok(()));
    }
}
