//! What holds for every device, whatever its family: it claims the same identifiers whoever
//! commands it, it sleeps until it has something to do, its start gets over lost answers, and after
//! an interruption it mixes nothing old with anything new.

use crate::recognise::{BOARDS, Bus, Row, readings, recorded};
use crate::rig::{Rig, board, count, decode, encode, listener, options, spec};
use proprio_drivers::{Decoded, Device, Frame, Id, Mode, NotSent, Options, StampedReading, State};
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, Skin, StampKind, Wrench};

fn device(row: &Row, mode: Mode) -> Box<dyn Device> {
    let (driver, keys, address, outputs) = *row;
    options(driver, keys)
        .device(&spec(address, mode, outputs))
        .expect("legal keys")
}

/// So `listen_only` can change while the gateway runs.
#[test]
fn claims_do_not_depend_on_who_commands() {
    for row in BOARDS {
        let [listens, commands] = [Mode::Listen, Mode::Supervise].map(|mode| device(row, mode));
        assert_eq!(listens.claims(), commands.claims(), "{row:?}");
    }
}

/// A host that polls only when a frame has come or [`Device::next_wake`] is over, while every
/// `lost`-th answer of the first half second is lost. Its state at the end, and in the last second
/// how many readings came, and how often it woke in vain.
fn woken(row: &Row, lost: Option<usize>) -> (State, usize, usize) {
    let mut bus = Bus::new(row);
    let mut host = device(row, Mode::Supervise);
    let (mut answered, mut readings, mut needless) = (0, 0, 0);
    for turn in 0..4000 {
        let mut out = Decoded::new();
        let is_due = host.next_wake().is_some_and(|wake| wake <= bus.now);
        let mut frames = bus.turn();
        if row.1.contains("sync") && turn % 10 == 0 {
            let sync = Frame::new(Id::standard(0x80), &[]).at(bus.now, StampKind::Software);
            host.overhear(&sync, &mut out);
            frames.extend(bus.ask(&sync));
        }
        let now = bus.now;
        for frame in &frames {
            host.on_frame(&frame.at(now, StampKind::Software), &mut out);
        }
        if is_due || !frames.is_empty() {
            let mut sent = false;
            while let Some(transmit) = host.poll_transmit(now, &mut out) {
                sent = true;
                host.on_sent(&transmit.frame, Ok(now));
                for answer in bus.ask(&transmit.frame) {
                    answered += 1;
                    if turn < 500 && lost.is_some_and(|lost| answered % lost == 0) {
                        continue;
                    }
                    host.on_frame(&answer.at(now, StampKind::Software), &mut out);
                }
            }
            needless += usize::from(turn >= 3000 && frames.is_empty() && !sent);
            let wake = host.next_wake();
            assert!(
                wake.is_none_or(|wake| wake > now),
                "{row:?} at {now:?}: {wake:?}"
            );
        }
        readings += if turn >= 3000 { out.readings.len() } else { 0 };
    }
    (host.state(), readings, needless)
}

#[test]
fn a_device_sleeps_until_it_has_something_to_do() {
    for row in BOARDS {
        let (state, readings, needless) = woken(row, None);
        assert_eq!(state, State::Streaming, "{row:?}");
        // The slowest boards send every 50 ms, which is the maximum silence here.
        assert!(
            readings >= 10 && needless <= 20,
            "{row:?}: {readings}, {needless}"
        );
    }
}

#[test]
fn a_start_gets_over_lost_answers() {
    for row in BOARDS {
        for lost in [1, 2, 3] {
            let (state, readings, _) = woken(row, Some(lost));
            assert!(
                state == State::Streaming && readings >= 10,
                "{row:?}: {lost}"
            );
        }
    }
}

/// Arithmetic of instants saturates: at the ends of their range a wait is over as soon as it
/// begins. Every call ends all the same.
#[test]
fn no_device_turns_for_ever_at_an_end_of_time() {
    for row in BOARDS {
        let frames = recorded(row, 200);
        let ends = [
            Nanos::MIN,
            Nanos(i64::MIN + 1),
            Nanos(i64::MAX - 1),
            Nanos::MAX,
        ];
        let modes = [Mode::Listen, Mode::Supervise];
        for (mode, now) in modes
            .into_iter()
            .flat_map(|mode| ends.map(|end| (mode, end)))
        {
            let mut device = device(row, mode);
            let mut out = Decoded::new();
            for frame in frames.iter().take(100) {
                out = Decoded::new();
                device.on_frame(&frame.at(now, StampKind::Log), &mut out);
                // One frame is under way at a time; it is not sent, as of a log.
                if let Some(transmit) = device.poll_transmit(now, &mut out) {
                    assert_eq!(mode, Mode::Supervise, "{row:?}");
                    device.on_sent(&transmit.frame, Err(NotSent::Refused));
                }
                device.next_wake();
            }
            device.restart(now);
            device.poll_transmit(now, &mut out);
            device.stop(now);
            device.poll_transmit(now, &mut out);
        }
    }
}

/// A changed maximum silence holds from then on.
#[test]
fn the_maximum_silence_can_change() {
    for row in BOARDS {
        let frames = recorded(row, 1000);
        for (ms, silences) in [(400, 0), (200, 1)] {
            let mut device = device(row, Mode::Listen);
            device.set_max_silence(Nanos::from_millis(ms));
            read(&mut *device, &frames);
            let last = frames.last().expect("frames").t;
            let mut out = Decoded::new();
            // A device that polls may have had its last reading some time before.
            while (device.poll_transmit(last + Nanos::from_millis(300), &mut out)).is_some() {}
            assert_eq!(
                count(&out.faults, Counter::Silences),
                silences,
                "{row:?} {ms}"
            );
        }
    }
}

/// The longest time from a reading's first frame to its second, as a key states it.
#[test]
fn a_pair_comes_within_the_stated_time() {
    let wrench = Reading::Wrench(Wrench {
        force: [9.0; 3],
        torque: [0.9; 3],
    });
    let skin = Reading::Skin(Skin {
        triangle: 0,
        taxels: [9.0; 12],
    });
    let scales = "full_scale_n = [900, 900, 900]\nfull_scale_nm = [90, 90, 90]\n";
    let dbc = crate::dbc::WRENCH;
    let stated = "pair_timeout_ms = 2.0";
    let cases = [
        ("icub_strain", format!("{scales}{stated}"), wrench),
        ("icub_skin", format!("triangles = [0, 0]\n{stated}"), skin),
        ("dbc", dbc.into(), wrench),
    ];
    for (driver, keys, reading) in cases {
        for (ms, us, expected) in [
            ("4.0", 3_500, 1),
            ("4.0", 4_500, 0),
            ("0.5", 450, 1),
            ("0.5", 550, 0),
            ("1000.0", 999_000, 1),
        ] {
            let keys = keys.replace(stated, &format!("pair_timeout_ms = {ms}"));
            let mut board = board(driver, &keys, &[]);
            let frames = encode(&mut *board, 0, &reading, Quality::GOOD);
            let [first, second, ..] = frames[..] else {
                panic!("{driver}: {frames:?}")
            };
            let mut device = listener(driver, &keys, &[]);
            let t = Nanos::from_millis(50);
            let frames = [
                first.at(t, StampKind::Software),
                second.at(t + Nanos::from_micros(us), StampKind::Software),
            ];
            let (readings, _) = decode(&mut *device, &frames);
            assert_eq!(readings.len(), expected, "{driver} {ms} {us}");
        }
        for wrong in ["0.0", "-1.0", "1000.1", "nan"] {
            let keys = keys.replace(stated, &format!("pair_timeout_ms = {wrong}"));
            let options = options(driver, &keys);
            let address = options.default_address().unwrap_or(1);
            let refused = options.device(&spec(address, Mode::Listen, &[]));
            assert!(refused.is_err(), "{driver} {wrong}");
        }
    }
}

/// Those with the key `period_ms` whose boards do not take it from the host: they are polled, or
/// set by another program.
const NOT_SET: [&str; 12] = [
    "ati_netcanoem",
    "canopen_drive",
    "cubemars",
    "damiao",
    "icub_mc4",
    "icub_motor",
    "moteus",
    "myactuator",
    "odrive",
    "robstride",
    "vesc",
    "xsens_mti",
];

/// A board sends at the period of the keys, once the host has set it.
#[test]
fn a_board_is_set_to_the_period_of_its_keys() {
    for (driver, keys, _, outputs) in BOARDS {
        let table: toml::Table = "period_ms = 8".parse().expect("TOML");
        let has_key = Options::deserialize(driver, table).is_ok();
        if !has_key || NOT_SET.contains(driver) {
            continue;
        }
        for ms in [20, 40] {
            let usual = keys.replace("period_ms = 20", "");
            let keys = format!("{usual}\nperiod_ms = {ms}");
            let reading = readings(driver, outputs, Nanos::ZERO)[0];
            let mut rig = Rig::with_board(driver, &keys, &usual, outputs, reading);
            rig.run(500);
            let set = rig.board.period();
            assert_eq!(set, Some(Nanos::from_millis(ms)), "{driver}");
        }
    }
}

/// A device that never hears anything is silent, woken by nothing but its own time, and sleeps.
#[test]
fn a_device_that_is_never_heard_is_silent() {
    for row in BOARDS {
        let mut device = device(row, Mode::Listen);
        let (mut now, mut out) = (Nanos::from_millis(1000), Decoded::new());
        let mut wakes = 0;
        while device.poll_transmit(now, &mut out).is_none() {
            match device.next_wake() {
                Some(wake) if wake < Nanos::from_millis(60_000) => now = wake.max(now),
                _ => break,
            }
            wakes += 1;
            assert!(wakes < 10, "{row:?} does not sleep");
        }
        assert_eq!(device.state(), State::Silent, "{row:?}");
    }
}

/// How long a listening device waits for a board before it calls it silent.
fn waits_for(keys: &str) -> Nanos {
    let mut device = listener("icub_strain", keys, &[]);
    let (start, mut out) = (Nanos::from_millis(1000), Decoded::new());
    let mut now = start;
    while device.state() != State::Silent {
        assert_eq!(device.poll_transmit(now, &mut out), None);
        now = device.next_wake().map_or(now, |wake| wake.max(now));
    }
    now - start
}

/// A board may be switched on together with the host, and sends nothing in its bootloader.
#[test]
fn a_listening_device_waits_for_the_bootloader_too() {
    let longer = waits_for("power_on_silence_ms = 6000") - waits_for("power_on_silence_ms = 0");
    assert_eq!(longer, Nanos::from_millis(6000));
}

/// A host that polls at the very instants that the device asks for, heard or not, is never asked
/// for an instant that is over.
#[test]
fn a_device_does_what_it_has_to_when_it_says() {
    let more: [Row; 2] = [
        ("canopen_sync", "", 0, &[]),
        ("icub_strain", "power_on_silence_ms = 100", 13, &[]),
    ];
    for row in BOARDS.iter().chain(&more) {
        for (mode, frames) in [
            (Mode::Listen, 0),
            (Mode::Listen, 50),
            (Mode::Supervise, 0),
            (Mode::Supervise, 50),
        ] {
            let mut device = device(row, mode);
            let (mut now, mut out) = (Nanos::from_millis(1000), Decoded::new());
            for frame in recorded(row, 100).iter().take(frames) {
                now = frame.t;
                device.poll_transmit(now, &mut out);
                device.on_frame(frame, &mut out);
            }
            for _ in 0..100 {
                while let Some(transmit) = device.poll_transmit(now, &mut out) {
                    device.on_sent(&transmit.frame, Ok(now));
                }
                let Some(wake) = device.next_wake() else {
                    break;
                };
                assert!(wake > now, "{row:?} {mode:?} {frames}: {wake:?} at {now:?}");
                now = wake;
            }
        }
    }
}

/// A board that this host has not begun to start is not stopped: it may serve another program.
#[test]
fn a_board_that_was_not_started_is_not_stopped() {
    for row in BOARDS {
        let mut device = device(row, Mode::Supervise);
        let (now, mut out) = (Nanos::from_millis(1000), Decoded::new());
        device.stop(now);
        assert_eq!(device.poll_transmit(now, &mut out), None, "{row:?}");
        let end = (device.state(), device.next_wake());
        assert_eq!(end, (State::Stopped, None), "{row:?}");
    }
}

/// The names of its channels differ.
#[test]
fn each_output_has_its_own_name() {
    for row in BOARDS {
        let (driver, keys, ..) = *row;
        let outputs = options(driver, keys).outputs();
        let named = outputs.iter().filter(|output| output.kind != Kind::Joint);
        let mut names: Vec<_> = named
            .map(|output| (output.number, &output.suffix))
            .collect();
        let all = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), all, "{row:?}");
        // The names of joints are their own.
        let joints = outputs.iter().any(|output| output.kind == Kind::Joint);
        let nameless = names.iter().any(|(_, suffix)| suffix.is_empty());
        assert!(!(joints && nameless), "{row:?}: {outputs:?}");
    }
}

/// Only force/torque sensors have full scales.
#[test]
fn what_is_no_wrench_has_no_full_scale() {
    for row in BOARDS {
        let outputs = options(row.0, row.1).outputs();
        if outputs.iter().all(|output| output.kind != Kind::Wrench) {
            assert_eq!(device(row, Mode::Listen).full_scale(), None, "{row:?}");
        }
    }
}

/// Only drivers with a key for it have a file to read.
#[test]
fn no_file_is_read_that_the_keys_do_not_name() {
    for row in BOARDS {
        let options = options(row.0, row.1);
        assert_eq!(
            (options.description(), options.eds()),
            (None, None),
            "{row:?}"
        );
    }
}

/// A reading has the stamp of one frame, and the kind of that stamp.
#[test]
fn stamps_and_their_kinds_belong_together() {
    for row in BOARDS {
        let kinds = [
            StampKind::Hardware,
            StampKind::Software,
            StampKind::Software,
        ];
        let frames: Vec<Frame> = (recorded(row, 1000).iter().zip(kinds.into_iter().cycle()))
            .map(|(frame, kind)| frame.at(frame.t, kind))
            .collect();
        for stamped in read(&mut *device(row, Mode::Listen), &frames) {
            let measured = frames.iter().filter(|frame| frame.t == stamped.acquired);
            let kinds: Vec<StampKind> = measured.map(|frame| frame.stamp).collect();
            assert!(
                kinds.contains(&stamped.stamp),
                "{row:?}: {stamped:?}, {kinds:?}"
            );
        }
    }
}

/// A steady stream has no gaps; after a silence the first reading of each output has one, also
/// where the silence was in the midst of a reading.
#[test]
fn a_gap_is_told_once() {
    let gaps = |readings: &[StampedReading]| {
        let gaps = readings
            .iter()
            .filter(|r| r.quality.contains(Quality::GAP_BEFORE));
        gaps.count()
    };
    for row in BOARDS {
        let frames = recorded(row, 1000);
        for cut in frames.len() / 2..frames.len() / 2 + 3 {
            let (before, after) = frames.split_at(cut);
            let later = Nanos::from_millis(2000);
            let after = after
                .iter()
                .map(|frame| frame.at(frame.t + later, frame.stamp));
            let mut device = device(row, Mode::Listen);
            device.set_max_silence(Nanos::from_millis(200));
            let steady = read(&mut *device, before);
            let resumed = read(&mut *device, &after.collect::<Vec<_>>());
            let mut outputs: Vec<_> = steady.iter().map(key).collect();
            outputs.sort_unstable();
            outputs.dedup();
            assert!(!outputs.is_empty());
            let counted = (gaps(&steady), gaps(&resumed));
            assert_eq!(counted, (0, outputs.len()), "{row:?} {cut}");
            assert!(
                resumed[0].quality.contains(Quality::GAP_BEFORE),
                "{row:?} {cut}"
            );
        }
    }
}

/// What a reading is of: the output, and the triangle of a skin.
fn key(stamped: &StampedReading) -> (u8, u32) {
    match stamped.reading {
        Reading::Skin(skin) => (stamped.output, skin.triangle),
        _ => (stamped.output, 0),
    }
}

/// The numbers of a reading.
fn numbers(reading: &Reading) -> Vec<f64> {
    match reading {
        Reading::Joint(joint) => vec![
            joint.position,
            joint.velocity,
            joint.torque,
            joint.current,
            joint.acceleration,
        ],
        Reading::Imu(imu) => [
            &imu.proper_acceleration[..],
            &imu.angular_velocity[..],
            &imu.orientation[..],
            &imu.magnetic_field[..],
        ]
        .concat(),
        Reading::Wrench(wrench) => [&wrench.force[..], &wrench.torque[..]].concat(),
        Reading::Skin(skin) => [&[f64::from(skin.triangle)][..], &skin.taxels[..]].concat(),
        Reading::Temperature(_) | Reading::Actuator(_) | Reading::Gauges(_) => vec![],
    }
}

/// The measurements from `frames`, with the time advanced to each.
fn read(device: &mut dyn Device, frames: &[Frame]) -> Vec<StampedReading> {
    let mut readings = Vec::new();
    for frame in frames {
        let mut out = Decoded::new();
        while device.poll_transmit(frame.t, &mut out).is_some() {}
        if device.claims().iter().any(|claim| claim.matches(frame.id)) {
            device.on_frame(frame, &mut out);
        }
        // States are told again after a start.
        let is_measured = |stamped: &&StampedReading| {
            !matches!(
                stamped.reading,
                Reading::Actuator(_) | Reading::Temperature(_)
            )
        };
        readings.extend(out.readings.iter().filter(is_measured).copied());
    }
    readings
}

/// Whether `part` is one of `whole`, but for values that it lacks. (Without the SYNC that caused it
/// a reading has the time of its frame.)
fn is_among(part: &StampedReading, whole: &[StampedReading], later: Nanos) -> bool {
    whole.iter().any(|stamped| {
        let mut pairs = numbers(&part.reading)
            .into_iter()
            .zip(numbers(&stamped.reading));
        stamped.output == part.output
            && stamped.reading.kind() == part.reading.kind()
            && (stamped.acquired + later - part.acquired).0.abs() <= 500_000
            && pairs.all(|(a, b)| a.is_nan() || a.to_bits() == b.to_bits())
    })
}

/// Wherever frames are cut, and some after the cut are lost: what comes then is what would have
/// come without it, but for a few readings.
#[test]
fn an_interruption_mixes_nothing() {
    for row in BOARDS {
        let frames = recorded(row, 1000);
        let whole = read(&mut *device(row, Mode::Listen), &frames);
        assert!(whole.len() >= 20, "{row:?}");
        for cut in frames.len() / 2..frames.len() / 2 + 6 {
            for lost in [0, 1, 2, 4] {
                let (before, after) = (&frames[..cut], &frames[cut + lost..]);
                // The board is started again.
                let mut restarted = device(row, Mode::Listen);
                read(&mut *restarted, before);
                restarted.restart(frames[cut].t);
                let again = read(&mut *restarted, after);
                let end = whole.iter().filter(|o| o.acquired > frames[cut + lost].t);
                let end = end.count();
                assert!(again.len() + 4 >= end, "{row:?} {cut}+{lost}");
                for stamped in &again {
                    assert!(
                        is_among(stamped, &whole, Nanos::ZERO),
                        "{row:?} {cut}+{lost}: {stamped:?}"
                    );
                }
                // It is silent for a while.
                let later = Nanos::from_millis(2000);
                let shifted: Vec<Frame> = (after.iter())
                    .map(|frame| frame.at(frame.t + later, frame.stamp))
                    .collect();
                let mut silent = device(row, Mode::Listen);
                read(&mut *silent, before);
                let after = read(&mut *silent, &shifted);
                for stamped in &after {
                    assert!(
                        is_among(stamped, &whole, later),
                        "{row:?} {cut}+{lost}: {stamped:?}"
                    );
                }
                assert!(after.len() + 4 >= end, "{row:?} {cut}+{lost}");
            }
        }
    }
}
