//! Every simulated board is recognised as itself, by listening and by asking, and by no other
//! driver with more certainty. Arbitrary traffic is nothing.

use crate::rig::{FD, options, spec};
use proprio_drivers::{
    Board, Certainty, Claim, DRIVERS, Decoded, Finding, Format, Frame, Frames, Id, Mode, Options,
    Traffic, asked_by_name, questions, recognise,
};
use proprio_topics::{
    Actuator, Imu, JointState, Nanos, Quality, Reading, Skin, StampKind, Temperature, Wrench,
};
use proptest::prelude::*;
use proptest::strategy::ValueTree;

/// Every family: driver, keys, address, outputs that are joints.
pub(crate) const BOARDS: &[Row] = &[
    ("icub_strain", "", 13, &[]),
    ("icub_strain", "stream = \"both\"", 1, &[]),
    ("icub_imu", "", 3, &[]),
    (
        "icub_imu",
        "quantities = [\"acceleration\", \"orientation\", \"status\"]\nperiod_ms = 20",
        14,
        &[],
    ),
    ("icub_imu", "legacy = \"mtb\"", 9, &[]),
    ("icub_motor", "", 2, &[0]),
    ("icub_mc4", "", 5, &[0, 1]),
    ("icub_pos", "", 8, &[0, 1]),
    ("icub_skin", "triangles = [2, 5]", 6, &[]),
    ("icub_mais", "", 14, &[0, 6, 7, 14]),
    ("ati_netcanoem", "", 0x20, &[]),
    ("ati_netcanoem", "", 0x31, &[]),
    ("canopen_drive", "", 3, &[0]),
    ("canopen_drive", "sync = 1", 127, &[0]),
    ("canopen_encoder", "", 32, &[0]),
    ("moteus", "", 1, &[0]),
    ("moteus", "host = 7", 11, &[0]),
    ("odrive", "", 0, &[0]),
    ("odrive", "firmware = \"0.5\"", 63, &[0]),
    ("cubemars", "model = \"AK80-9\"", 7, &[0]),
    ("cubemars", "model = \"AK80-9\"\nhost_id = 5", 5, &[0]),
    (
        "cubemars",
        "mode = \"servo\"\nmodel = \"AK10-9\"",
        104,
        &[0],
    ),
    ("xsens_mti", "", 0, &[]),
    (
        "xsens_mti",
        "quantities = [\"acceleration\", \"angular_velocity\"]\nextended = true\n\
         high_rate = \"rate_first\"",
        0,
        &[],
    ),
    ("openimu", "", 0x80, &[]),
    ("robotous_rft", "", 0x64, &[]),
    (
        "robotous_rft",
        "model = \"RFT64-6A01\"\nrate_hz = 1000",
        0x64,
        &[],
    ),
    ("aidin_aft200", "", 1, &[]),
    ("jr3_can", "", 1, &[]),
    ("jr3_can", "", 100, &[]),
    (
        "optoforce_daq",
        "counts_per_newton = [26, 28, 3]",
        0x100,
        &[],
    ),
    (
        "damiao",
        "model = \"DM4310\"\nhost_id = 0x17\nrequest_period_ms = 10",
        7,
        &[0],
    ),
    (
        "damiao",
        "model = \"DM4310\"\nhost_id = 0x18\nrequest_period_ms = 5",
        8,
        &[0],
    ),
    (
        "myactuator",
        "position = \"status\"\nrequest_period_ms = 20",
        9,
        &[0],
    ),
    ("myactuator", "request_period_ms = 5", 2, &[0]),
    (
        "myactuator",
        "protocol = \"v2\"\nrequest_period_ms = 5",
        3,
        &[0],
    ),
    ("robstride", "model = \"RS03\"", 127, &[0]),
    (
        "robstride",
        "model = \"RS03\"\nrequest_period_ms = 5",
        1,
        &[0],
    ),
    ("robstride", "model = \"RS03\"\nprotocol = \"mit\"", 1, &[0]),
    ("vesc", "pole_pairs = 7", 1, &[0]),
    (
        "vesc",
        "pole_pairs = 7\nposition = \"tachometer\"",
        104,
        &[0],
    ),
];
/// Drivers without a device that speaks, or with one that a file describes.
const NOT_RECOGNISED: [&str; 2] = ["canopen_sync", "dbc"];

#[test]
fn no_driver_is_left_out() {
    for driver in DRIVERS {
        let tested = BOARDS.iter().any(|(tested, ..)| tested == driver);
        assert_ne!(tested, NOT_RECOGNISED.contains(driver), "{driver}");
    }
}

/// What a board measures at `t`, moving.
pub(crate) fn readings(driver: &str, outputs: &[u8], t: Nanos) -> Vec<(u8, Reading)> {
    let x = (t.seconds() * 7.0).sin();
    let wrench = Wrench {
        force: [12.0 + x, -30.0, 5.0 * x],
        torque: [0.1, -0.2 * x, 0.3],
    };
    let joint = JointState {
        position: 0.5 * x,
        velocity: 3.5 * (t.seconds() * 7.0).cos(),
        acceleration: 0.0,
        torque: 0.2,
        current: 1.5,
    };
    let actuator = Actuator {
        duty: 0.1,
        mode: if driver == "odrive" { 8 } else { 1 },
        encoder: 0,
        faults: 0,
    };
    let imu = Imu {
        proper_acceleration: [x, 0.5, 9.81],
        angular_velocity: [0.1, -0.2, x],
        angular_acceleration: [f64::NAN; 3],
        orientation: [1.0, 0.0, 0.0, 0.0],
        magnetic_field: [1e-5; 3],
    };
    if !outputs.is_empty() {
        let joints = outputs.iter().flat_map(|output| {
            [
                (*output, Reading::Joint(joint)),
                (*output, Reading::Actuator(actuator)),
            ]
        });
        return joints.collect();
    }
    match driver {
        "icub_imu" | "xsens_mti" | "openimu" => vec![(0, Reading::Imu(imu))],
        "icub_skin" => (2..=5)
            .map(|triangle| {
                let skin = Skin {
                    triangle,
                    taxels: [3.0 + x.round(); 12],
                };
                (0, Reading::Skin(skin))
            })
            .collect(),
        "icub_strain" => vec![
            (0, Reading::Wrench(wrench)),
            (0, Reading::Temperature(Temperature { celsius: 31.0 })),
        ],
        _ => vec![(0, Reading::Wrench(wrench))],
    }
}

/// A row of [`BOARDS`]: driver, keys, address, outputs.
pub(crate) type Row = (&'static str, &'static str, u32, &'static [u8]);

/// A board on a bus, with all that is heard of it.
pub(crate) struct Bus {
    board: Box<dyn Board>,
    driver: &'static str,
    outputs: &'static [u8],
    pub(crate) now: Nanos,
    due: Option<Nanos>,
    heard: Traffic,
    frames: Vec<Frame>,
}

impl Bus {
    pub(crate) fn new(row: &Row) -> Self {
        let (driver, keys, address, outputs) = *row;
        let spec = spec(address, Mode::Supervise, outputs);
        Self {
            board: options(driver, keys).board(&spec).expect("legal keys"),
            driver,
            outputs,
            now: Nanos::from_millis(1000),
            due: None,
            heard: Traffic::new(),
            frames: Vec::new(),
        }
    }

    fn hear(&mut self, frames: &[Frame]) {
        for frame in frames {
            // A frame takes about 0.1 ms.
            self.now += Nanos::from_micros(100);
            let frame = frame.at(self.now, StampKind::Software);
            self.heard.on_frame(&frame);
            self.frames.push(frame);
        }
    }

    pub(crate) fn ask(&mut self, question: &Frame) -> Frames {
        let mut answers = Frames::new();
        self.board.on_frame(question, &mut answers);
        answers
    }

    /// A millisecond: the board sends what is due. Returns it.
    pub(crate) fn turn(&mut self) -> Vec<Frame> {
        let turn = self.now.0 / 1_000_000;
        let mut sent = Frames::new();
        for (output, reading) in readings(self.driver, self.outputs, self.now) {
            self.board.present(output, &reading, Quality::GOOD);
        }
        match self.board.period() {
            None => self.due = None,
            Some(period) if self.now >= *self.due.get_or_insert(self.now) => {
                self.due = self.due.map(|due| due + period);
                let mut once = Frames::new();
                for (output, reading) in readings(self.driver, self.outputs, self.now) {
                    let encoded = self
                        .board
                        .encode(output, &reading, Quality::GOOD, &mut once);
                    // Not every board has an actuator.
                    assert!(encoded.is_ok() || !matches!(reading, Reading::Joint(_)));
                }
                sent.extend(once.into_iter().take(16));
            }
            Some(_) => {}
        }
        self.hear(&sent);
        self.now = Nanos((turn + 1) * 1_000_000);
        sent.to_vec()
    }
}

/// What is heard while the board's own host starts it and reads it.
fn overheard(row: &Row) -> Traffic {
    started(row, 3000).heard
}

/// The frames of that, in `turns` milliseconds.
pub(crate) fn recorded(row: &Row, turns: usize) -> Vec<Frame> {
    started(row, turns).frames
}

fn started(row: &Row, turns: usize) -> Bus {
    let (driver, keys, address, outputs) = *row;
    let mut bus = Bus::new(row);
    let mut host = options(driver, keys)
        .device(&spec(address, Mode::Supervise, outputs))
        .expect("legal keys");
    for _ in 0..turns {
        let mut out = Decoded::new();
        while let Some(transmit) = host.poll_transmit(bus.now, &mut out) {
            host.on_sent(&transmit.frame, Ok(bus.now));
            bus.hear(&[transmit.frame]);
            let answers = bus.ask(&transmit.frame);
            bus.hear(&answers);
            for answer in answers {
                host.on_frame(&answer.at(bus.now, StampKind::Software), &mut out);
            }
        }
        if keys.contains("sync") && bus.now.0 / 1_000_000 % 10 == 0 {
            let sync = Frame::new(Id::standard(0x80), &[]);
            bus.hear(&[sync]);
            let answers = bus.ask(&sync);
            bus.hear(&answers);
        }
        for frame in bus.turn() {
            host.on_frame(&frame.at(bus.now, StampKind::Software), &mut out);
        }
    }
    bus
}

/// What is heard of a board that nobody has started, when it is asked.
fn asked(row: &Row) -> Traffic {
    asked_bus(row).heard
}

fn asked_bus(row: &Row) -> Bus {
    let mut bus = Bus::new(row);
    let mut done: Vec<Frame> = Vec::new();
    let turns = |bus: &mut Bus| (0..500).for_each(|_| drop(bus.turn()));
    turns(&mut bus);
    loop {
        let all = questions(&bus.heard, DRIVERS);
        let new: Vec<Frame> = all.into_iter().filter(|q| !done.contains(q)).collect();
        if new.is_empty() {
            return bus;
        }
        for question in new {
            let answers = bus.ask(&question);
            bus.hear(&answers);
            done.push(question);
        }
        turns(&mut bus);
    }
}

/// The best finding of `driver` at `address`, after checks that hold for all.
fn own(heard: &Traffic, row: &Row) -> Option<Finding> {
    let (driver, _, address, _) = *row;
    let findings = recognise(heard);
    for finding in &findings {
        // Its keys make a device, once somebody has filled in what is not known.
        let keys: String = (finding.keys.iter())
            .map(|key| format!("{} = {}\n", key.name, key.value))
            .collect();
        let table: toml::Table = keys.parse().expect("TOML");
        let options = Options::deserialize(finding.driver, table)
            .unwrap_or_else(|error| panic!("{finding:?}: {error:?}"));
        let spec = spec(finding.address, Mode::Listen, &finding.joints);
        let device = options.device(&spec);
        assert!(device.is_ok(), "{finding:?}: {:?}", device.err());
        assert!(!finding.explains.is_empty());
        for explained in &finding.explains {
            assert!(heard.stream(explained.id).is_some(), "{finding:?}");
        }
    }
    let found = findings
        .iter()
        .find(|f| (f.driver, f.address) == (driver, address));
    let found = found.cloned();
    for other in findings {
        let sure = found.as_ref().and_then(Finding::certainty);
        let is_other = (other.driver, other.address) != (driver, address);
        assert!(
            !is_other || other.certainty() <= sure,
            "{row:?} is rather {other:?}\nthan {found:?}"
        );
    }
    found
}

#[test]
fn every_board_is_recognised_by_listening_to_it() {
    for row in BOARDS {
        let heard = overheard(row);
        let finding = own(&heard, row).unwrap_or_else(|| panic!("{row:?} is not found"));
        assert!(
            finding.certainty() >= Some(Certainty::Likely),
            "{finding:?}"
        );
        assert_eq!(finding.unusable, "");
        // Nothing of what is heard of a board, and of its host, remains unknown, but for the SYNC
        // and for the settings that a J1939 host sends to a group.
        let by_host = |id: Id| match id {
            Id::Standard(raw) => raw == 0x80,
            Id::Extended(raw) => raw & 0xFFFF_00FF == 0x18FF_00F9,
        };
        let (driver, keys, address, outputs) = *row;
        let claimed = options(driver, keys)
            .device(&spec(address, Mode::Listen, outputs))
            .expect("legal keys");
        for stream in heard.streams().filter(|stream| !by_host(stream.id)) {
            let known = finding.has(stream.id)
                || claimed
                    .claims()
                    .iter()
                    .any(|claim| claim.matches(stream.id))
                || finding.commands.iter().any(|ids| ids.contains(&stream.id));
            assert!(known, "{row:?}: {}", stream.id);
        }
    }
}

/// The board of `row`, if `frames` show it.
fn found_in(frames: &[Frame], row: &Row) -> Option<Finding> {
    let mut heard = Traffic::new();
    frames.iter().for_each(|frame| heard.on_frame(frame));
    let mut findings = recognise(&heard).into_iter();
    findings.find(|found| (found.driver, found.address) == (row.0, row.2))
}

/// Frames that a device does not send, on an identifier that is its own, speak against it.
#[test]
fn foreign_frames_speak_against_a_device() {
    // Anything may be on the identifiers of its host, and of process data.
    let is_free = |driver: &str, address: u32, id: Id| match (driver, id.raw()) {
        ("canopen_drive" | "canopen_encoder", id) => id - address != 0x580 && id - address != 0x700,
        ("robotous_rft", id) => id == 0x64,
        ("aidin_aft200", id) => id == 0x102,
        ("damiao", id) => id == 0x7FF,
        ("myactuator", id) => [0x142, 0x149].contains(&id),
        ("robstride", id) => id == 0x1100_FD01,
        (driver, id) => driver.starts_with("icub") && id == 0x200 + address,
    };
    for row in BOARDS {
        let (driver, _, address, _) = *row;
        for frames in [recorded(row, 1000), asked_bus(row).frames] {
            let Some(Finding {
                bits: before,
                explains,
                ..
            }) = found_in(&frames, row)
            else {
                continue;
            };
            for id in explains.into_iter().map(|explained| explained.id) {
                let foreign = frames.iter().map(|frame| match frame.id == id {
                    true => Frame::new(id, &[0xFF; 3]).at(frame.t, frame.stamp),
                    false => *frame,
                });
                let foreign: Vec<Frame> = foreign.collect();
                let after = found_in(&foreign, row).map_or(0.0, |found| found.bits);
                let free = is_free(driver, address, id);
                assert!(after < before || free, "{row:?} {id}: {before} {after}");
            }
        }
    }
}

/// So do contents that a device does not send: a value of a byte beyond the last, or a number of a
/// size that nothing measures.
#[test]
fn foreign_contents_speak_against_a_device() {
    let far = 1e20_f32.to_le_bytes();
    for (driver, id, at, good, bad) in [
        ("odrive", Id::standard(0x001), 4, &[14][..], &[15][..]),
        ("odrive", Id::standard(0x009), 0, &[0; 4], &far),
        ("odrive", Id::standard(0x009), 4, &[0; 4], &far),
        ("cubemars", Id::extended(0x2968), 7, &[7], &[8]),
        ("canopen_drive", Id::standard(0x583), 0, &[0x60], &[0x61]),
        ("jr3_can", Id::standard(0x101), 0, &[1], &[2]),
        ("robotous_rft", Id::standard(0x001), 0, &[0x0B], &[0x77]),
    ] {
        let row = BOARDS
            .iter()
            .find(|row| row.0 == driver && recorded(row, 1000).iter().any(|frame| frame.id == id));
        let row = row.unwrap_or_else(|| panic!("{driver} sends no {id}"));
        let frames = recorded(row, 1000);
        let bits = |part: &[u8]| {
            let with_part = frames.iter().map(|frame| {
                let mut data = frame.data().to_vec();
                if frame.id == id && data.len() >= at + part.len() {
                    data[at..at + part.len()].copy_from_slice(part);
                }
                Frame::new(frame.id, &data).at(frame.t, frame.stamp)
            });
            let found = found_in(&with_part.collect::<Vec<_>>(), row);
            found.map_or(0.0, |found| found.bits)
        };
        let (of_good, of_bad) = (bits(good), bits(bad));
        assert!(of_bad < of_good, "{row:?} {id}: {of_good}, {of_bad}");
    }
}

/// Families that answer no question, and send nothing before they are started.
const MUTE: [&str; 1] = ["aidin_aft200"];

#[test]
fn every_board_is_recognised_by_asking_it() {
    for row in BOARDS {
        let finding = own(&asked(row), row);
        if MUTE.contains(&row.0) {
            assert_eq!(finding, None);
            continue;
        }
        let finding = finding.unwrap_or_else(|| panic!("{row:?} is not found"));
        assert!(
            finding.certainty() >= Some(Certainty::Likely),
            "{finding:?}"
        );
    }
}

/// What a board tells of itself ends up in words and keys.
#[test]
fn findings_say_what_was_found() {
    let found = |index: usize, active: bool| {
        let row = &BOARDS[index];
        let heard = if active { asked(row) } else { overheard(row) };
        let found = own(&heard, row).unwrap();
        let keys: Vec<String> = (found.keys.iter())
            .map(|key| format!("{} = {}", key.name, key.value))
            .collect();
        let certainty = found.certainty().unwrap();
        (found.what, keys.join("; "), certainty)
    };
    let row = |driver: &str, keys: &str| {
        let is_it = |row: &&(&str, &str, u32, &[u8])| (row.0, row.1) == (driver, keys);
        BOARDS.iter().position(|row| is_it(&row)).unwrap()
    };
    let (what, _, certainty) = found(row("icub_strain", ""), true);
    assert_eq!(what, "strain2, firmware 2.0.8, \"simulated board\"");
    assert_eq!(certainty, Certainty::Certain);
    let (_, keys, _) = found(row("icub_strain", "stream = \"both\""), false);
    assert_eq!(keys, "period_ms = 10; stream = \"both\"");
    let (_, keys, _) = found(3, false);
    assert_eq!(
        keys,
        "period_ms = 20; quantities = [\"acceleration\", \"orientation\", \"status\"]"
    );
    let (what, _, certainty) = found(row("canopen_encoder", ""), true);
    let (head, tail) = ("CANopen encoder (CiA 406), vendor 0x0", "serial 0x20");
    assert!(what.starts_with(head) && what.ends_with(tail), "{what}");
    assert_eq!(certainty, Certainty::Certain);
    let (what, keys, _) = found(row("odrive", "firmware = \"0.5\""), true);
    assert_eq!(what, "ODrive");
    assert_eq!(keys, "firmware = \"0.6\"; period_ms = 10");
    let (what, _, certainty) = found(row("ati_netcanoem", ""), true);
    assert_eq!(what, "ATI sensor at a NETCANOEM board, serial FT00000");
    assert_eq!(certainty, Certainty::Certain);
    let (what, keys, certainty) = found(
        row("robotous_rft", "model = \"RFT64-6A01\"\nrate_hz = 1000"),
        true,
    );
    assert_eq!(what, "RFT64-6A01, serial RFT-SIMULATED");
    assert_eq!(keys, "model = \"RFT64-6A01\"");
    assert_eq!(certainty, Certainty::Certain);
    let (_, keys, _) = found(row("icub_skin", "triangles = [2, 5]"), false);
    assert_eq!(keys, "period_ms = 50; triangles = [2, 5]");
    let xsens = BOARDS
        .iter()
        .position(|row| row.1.contains("extended = true"));
    let (_, keys, _) = found(xsens.unwrap(), false);
    assert_eq!(
        keys,
        "quantities = [\"angular_velocity\", \"acceleration\"]; period_ms = 10; extended = true; \
         high_rate = \"rate_first\""
    );
    let (_, keys, certainty) = found(row("moteus", "host = 7"), false);
    assert_eq!(
        (keys.as_str(), certainty),
        ("host = 7; period_ms = 2", Certainty::Certain)
    );
}

/// A question of one family starts, stops or changes nothing in the boards of another, nor in its
/// own: afterwards a board sends what one that was not asked sends. The families that are
/// asked by name only are not asked here.
#[test]
fn questions_change_nothing() {
    for row in BOARDS {
        let (driver, keys, _, outputs) = *row;
        for address in 0..=127 {
            let spec = spec(address, Mode::Supervise, outputs);
            let board = || options(driver, keys).board(&spec);
            let (Ok(mut asked), Ok(mut other)) = (board(), board()) else {
                continue;
            };
            // All that boards at any address would answer is heard, so that all is asked.
            let mut heard = Traffic::new();
            for _ in 0..3 {
                for question in questions(&heard, &[]) {
                    let mut answers = Frames::new();
                    asked.on_frame(&question, &mut answers);
                    for answer in answers {
                        heard.on_frame(&answer);
                    }
                }
            }
            assert_eq!(asked.period(), other.period(), "{row:?} at {address}");
            for (output, reading) in readings(driver, outputs, Nanos::ZERO) {
                let mut frames = [Frames::new(), Frames::new()];
                let [a, b] = &mut frames;
                let _ = asked.encode(output, &reading, Quality::GOOD, a);
                let _ = other.encode(output, &reading, Quality::GOOD, b);
                assert_eq!(a, b, "{row:?} at {address}");
            }
        }
    }
}

#[test]
fn families_whose_questions_are_commands_are_asked_by_name_alone() {
    let heard = Traffic::new();
    let safe = questions(&heard, &[]);
    // CANopen's network management, SYNC and the process data that nodes receive; the start of a
    // JR3; motors of CubeMars.
    let commands = |id: Id| match id {
        Id::Standard(raw) => raw <= 0x17F || (0x200..=0x57F).contains(&raw) && raw & 0x80 == 0,
        // moteus controllers, from another host.
        Id::Extended(raw) => (0xFD00..=0xFDFF).contains(&raw),
    };
    for question in &safe {
        assert!(!commands(question.id), "{question}");
    }
    let by_name: Vec<&str> = asked_by_name().collect();
    assert_eq!(
        by_name,
        [
            "ati_netcanoem",
            "myactuator",
            "robstride",
            "robotous_rft",
            "jr3_can"
        ]
    );
    for driver in by_name {
        let more = questions(&heard, &[driver]);
        assert!(more.len() > safe.len(), "{driver}");
        assert!(
            more.iter().any(|question| commands(question.id)),
            "{driver}"
        );
    }
}

/// What one family asks, another may take for a command: not on the identifiers of a device that
/// is heard.
#[test]
fn nothing_is_asked_where_a_device_that_is_heard_takes_commands() {
    let ask = |row: usize, named: &[&str]| {
        let asks = questions(&overheard(&BOARDS[row]), named);
        asks.into_iter()
            .map(|question| question.id)
            .collect::<Vec<_>>()
    };
    let row = |driver: &str| BOARDS.iter().position(|row| row.0 == driver).unwrap();
    // ODrive 50: CANopen nodes 0x40 to 0x5F.
    let odrive = ("odrive", "", 50, &[0][..]);
    let heard = overheard(&odrive);
    let asked: Vec<Id> = questions(&heard, &[]).iter().map(|q| q.id).collect();
    let nodes = |nodes: std::ops::RangeInclusive<u16>| nodes.map(|n| Id::standard(0x600 + n));
    assert!(nodes(0x41..=0x5F).all(|id| !asked.contains(&id)));
    assert!(
        nodes(1..=0x3F)
            .chain(nodes(0x60..=0x7F))
            .all(|id| asked.contains(&id))
    );
    assert!(asked.contains(&Id::standard(50 << 5)), "its own question");
    // A node receives process data where sensors of ATI and JR3 are asked.
    let sensors = ["ati_netcanoem", "jr3_can"];
    let drive = ask(row("canopen_drive"), &sensors);
    for (id, node) in [(0x308, 8), (0x503, 3)] {
        let is_its = node == 3;
        assert_eq!(drive.contains(&Id::standard(id)), !is_its, "{id:x}");
    }
    assert!(!ask(row("canopen_encoder"), &sensors).contains(&Id::standard(0x520)));
    // Also a node that tells nothing of itself but that it is there.
    let mut beats = Traffic::new();
    beats.on_frame(&crate::rig::frame("703#05", 0.0));
    let asks = questions(&beats, &sensors);
    assert!(
        asks.iter()
            .all(|question| question.id != Id::standard(0x503))
    );
    assert!(
        asks.iter()
            .any(|question| question.id == Id::standard(0x308))
    );
    // Also among many others, where a heartbeat alone speaks for hardly anything; but not if what
    // looks like one is explained by something for which more speaks.
    for id in 0x80..0x180_u16 {
        beats.on_frame(&Frame::new(Id::standard(id), &[0; 8]));
    }
    let is_node = |finding: &Finding| finding.driver.starts_with("canopen");
    let mut nodes = recognise(&beats).into_iter().filter(is_node);
    assert!(nodes.all(|node| node.certainty() == Some(Certainty::Possible)));
    let asks = questions(&beats, &sensors);
    assert!(
        asks.iter()
            .all(|question| question.id != Id::standard(0x503))
    );
    let mut master = Traffic::new();
    for (text, ms) in [
        ("701#05", 0.0),
        ("601#4000100000000000", 1.0),
        ("581#4300100092010200", 1.5),
    ] {
        master.on_frame(&crate::rig::frame(text, ms));
    }
    let asks = questions(&master, &[]);
    assert!(
        asks.iter()
            .any(|question| question.id == Id::standard(0x602))
    );
    // A board of ATI takes commands where one of JR3 is asked.
    let board = ("ati_netcanoem", "", 0x49, &[][..]);
    let asks = questions(&overheard(&board), &["jr3_can"]);
    let is_its = |question: &Frame| (0x490..=0x49F).contains(&question.id.raw());
    assert!(!asks.iter().any(is_its));
    // A JR3 board is started where others are asked.
    let jr3 = BOARDS
        .iter()
        .position(|row| (row.0, row.2) == ("jr3_can", 100))
        .unwrap();
    assert!(!ask(jr3, &["ati_netcanoem"]).contains(&Id::standard(0x2E4)));
    let board = ("jr3_can", "", 8, &[][..]);
    let asks = questions(&overheard(&board), &["ati_netcanoem"]);
    assert!(
        asks.iter()
            .all(|question| question.id != Id::standard(0x208))
    );
    // A motor of CubeMars with the number that is Robotous' identifier.
    let motor = ("cubemars", "model = \"AK80-9\"", 0x64, &[0][..]);
    let asks = questions(&overheard(&motor), &["robotous_rft"]);
    assert!(
        asks.iter()
            .all(|question| question.id != Id::standard(0x64))
    );
    let nobody = questions(&Traffic::new(), &["robotous_rft"]);
    assert!(
        nobody
            .iter()
            .any(|question| question.id == Id::standard(0x64))
    );
}

/// An iCub board that waits in its bootloader is named, and left alone.
#[test]
fn a_bootloader_is_named_and_left_alone() {
    let mut heard = Traffic::new();
    heard.on_frame(&crate::rig::frame("730#FF0C0102", 0.0));
    let findings = recognise(&heard);
    let strain = findings.iter().find(|f| f.driver == "icub_strain").unwrap();
    assert_eq!(
        (strain.address, strain.what.as_str()),
        (3, "strain2, in its bootloader 1.2: restart it")
    );
    let asks = questions(&heard, &[]);
    assert!(asks.iter().all(|q| q.id != Id::standard(0x703)), "{asks:?}");
    let mut running = Traffic::new();
    running.on_frame(&crate::rig::frame("730#FF0C020008", 0.0));
    let asks = questions(&running, &[]);
    assert!(asks.iter().any(|q| q.id == Id::standard(0x703)), "{asks:?}");
}

/// A node of a profile that nobody reads is told, and not taken for a drive.
#[test]
fn a_node_of_another_profile_is_no_drive() {
    let mut heard = Traffic::new();
    heard.on_frame(&crate::rig::frame("705#7F", 0.0));
    heard.on_frame(&crate::rig::frame("585#4300100091010F00", 1.0));
    let findings = recognise(&heard);
    assert_eq!(findings.len(), 1, "{findings:?}");
    assert!(findings[0].what.contains("profile 401"));
    assert_eq!(findings[0].certainty(), Some(Certainty::Certain));
    assert!(findings[0].unusable.contains(".dbc"));
}

/// A drive that is asked tells of a TPDO by SYNC, which is missing unless somebody sends it.
#[test]
fn a_drive_that_waits_for_a_sync_says_so() {
    for (keys, is_heard, needs) in [
        ("sync = 1", false, true),
        ("sync = 1", true, false),
        ("sync = 0", false, false),
    ] {
        let row: Row = ("canopen_drive", keys, 9, &[0]);
        let mut heard = asked(&row);
        if is_heard {
            heard.on_frame(&Frame::new(Id::standard(0x80), &[]));
        }
        let found = own(&heard, &row).unwrap();
        assert_eq!(found.needs_sync, needs, "{keys} {is_heard}: {found:?}");
        assert_eq!(found.certainty(), Some(Certainty::Certain));
    }
    // A TPDO that is off waits for nothing.
    let mut heard = Traffic::new();
    for (text, ms) in [
        ("585#4300100092010200", 0.0),
        ("585#4F00180201000000", 1.0),
        ("585#4300180185010080", 2.0),
    ] {
        heard.on_frame(&crate::rig::frame(text, ms));
    }
    assert!(!recognise(&heard)[0].needs_sync);
}

/// A node that does not tell its profile is rather an encoder if it sends four bytes; but which of
/// both is a guess, however sure the node is.
#[test]
fn process_data_hint_at_a_profile() {
    for (pdo, first) in [
        ("189#00010203", "canopen_encoder"),
        ("189#2706010203040A", "canopen_drive"),
    ] {
        let mut heard = Traffic::new();
        heard.on_frame(&crate::rig::frame("709#05", 0.0));
        heard.on_frame(&crate::rig::frame(pdo, 1.0));
        for beat in 0..40 {
            let t = 1.0 + f64::from(beat);
            heard.on_frame(&crate::rig::frame("709#05", t));
            heard.on_frame(&crate::rig::frame(pdo, 50.0 * t));
        }
        let findings = recognise(&heard);
        let drivers: Vec<&str> = findings.iter().map(|f| f.driver).collect();
        assert_eq!(drivers.len(), 2);
        assert_eq!(drivers[0], first);
        // One of both, at most.
        let sum: f64 = findings.iter().map(Finding::probability).sum();
        assert!((0.99..1.01).contains(&sum), "{sum}");
        for finding in findings {
            assert_eq!(finding.certainty(), Some(Certainty::Possible));
            let period = finding.keys.iter().find(|key| key.name == "period_ms");
            assert_eq!(period.unwrap().value, "50");
        }
    }
}

/// A bus of streams, each of one length, whose bytes are constant, count, or are arbitrary.
fn streams() -> impl Strategy<Value = Vec<Frame>> {
    let id = prop_oneof![
        4 => (0..=0x7FF_u16).prop_map(Id::standard),
        1 => any::<u32>().prop_map(Id::extended),
    ];
    let stream = (
        id,
        proptest::array::uniform8(0..3_u8),
        any::<[u8; 8]>(),
        0..=8_usize,
    );
    proptest::collection::vec(stream, 1..40).prop_map(|streams| {
        let mut frames = Vec::new();
        let mut seed = 1_u32;
        for turn in 0..60_u8 {
            for (id, kinds, first, length) in &streams {
                let mut data = *first;
                for (byte, kind) in data.iter_mut().zip(kinds) {
                    seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    *byte = match kind {
                        0 => *byte,
                        1 => byte.wrapping_add(turn),
                        _ => seed.to_le_bytes()[3],
                    };
                }
                let t = Nanos::from_millis(i64::from(turn) * 10);
                frames.push(Frame::new(*id, &data[..*length]).at(t, StampKind::Software));
            }
        }
        frames
    })
}

/// A bus of frames of which everything is arbitrary, mostly with as many identifiers as frames.
fn arbitrary() -> impl Strategy<Value = Vec<Frame>> {
    let data = proptest::collection::vec(any::<u8>(), 0..=8);
    let frame = (any::<u32>(), data, 0..20_u8).prop_filter_map("too long", |(id, data, format)| {
        #[allow(clippy::cast_possible_truncation)]
        let standard = Id::standard(id as u16);
        let id = if id >> 31 == 0 {
            standard
        } else {
            Id::extended(id)
        };
        let format = match format {
            0 => Format::Remote,
            1 => Format::Error,
            2 => Format::Fd {
                bit_rate_switch: true,
                error_state: false,
            },
            _ => Format::Classic,
        };
        Frame::with_format(id, format, &data)
    });
    proptest::collection::vec(frame, 1..1000)
}

/// The surest of what is found.
fn surest(frames: &[Frame]) -> Option<Certainty> {
    let mut heard = Traffic::new();
    frames.iter().for_each(|frame| heard.on_frame(frame));
    recognise(&heard).first().and_then(Finding::certainty)
}

proptest! {
    #[test]
    fn nothing_is_certain_of_arbitrary_traffic(streams in streams(), frames in arbitrary()) {
        prop_assert!(surest(&streams) < Some(Certainty::Certain));
        prop_assert!(surest(&frames) < Some(Certainty::Certain));
    }
}

/// Findings on buses without a device are as rare as the top of `recognise.rs` says. The buses are
/// the same in each run.
#[test]
fn wrong_findings_are_as_rare_as_their_bits_say() {
    const BUSES: usize = 2000;
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    for of_streams in [true, false] {
        let mut counts = [0; 3];
        for _ in 0..BUSES {
            let frames = match of_streams {
                true => streams().new_tree(&mut runner).unwrap().current(),
                false => arbitrary().new_tree(&mut runner).unwrap().current(),
            };
            if let Some(certainty) = surest(&frames) {
                counts[certainty as usize] += 1;
            }
        }
        let [possible, likely, certain] = counts;
        println!("streams {of_streams}: {possible} possible, {likely} likely, {certain} certain");
        // With odds of 99 to 1, and a prior of 1 to 31, arbitrary frames must be 3000 times as
        // probable if the device is there: of 25 drivers that happens on one bus of 123, at most.
        assert!(possible <= BUSES / 2, "{possible} of {BUSES}");
        assert!(likely <= BUSES / 123, "{likely} of {BUSES}");
        assert_eq!(certain, 0);
    }
}

/// Identifiers that a finding's device claims are those that the board sends on.
#[test]
fn a_device_made_of_a_finding_claims_its_frames() {
    for row in BOARDS {
        let heard = overheard(row);
        let found = own(&heard, row).unwrap();
        let claims: Vec<Claim> = options(row.0, row.1)
            .device(&spec(row.2, Mode::Listen, row.3))
            .unwrap()
            .claims()
            .to_vec();
        let claimed = |id: &&Id| claims.iter().any(|claim| claim.matches(**id));
        assert!(found.explains.iter().any(|e| claimed(&&e.id)), "{found:?}");
    }
}

/// `frame` with another format.
fn with_format(frame: &Frame, format: Format) -> Frame {
    let other = Frame::with_format(frame.id, format, frame.data());
    other.expect("a legal length").at(frame.t, frame.stamp)
}

/// Whoever asks for frames need not be there. A device of classic CAN sends no CAN FD; Damiao's
/// send either.
#[test]
fn frames_of_another_format_are_no_device() {
    for row in BOARDS {
        let frames = recorded(row, 300);
        let asked = frames.iter().map(|frame| Frame::remote(frame.id, 8));
        assert_eq!(found_in(&asked.collect::<Vec<_>>(), row), None);
        if !options(row.0, row.1).needs_fd() && row.0 != "damiao" {
            let fd: Vec<Frame> = frames.iter().map(|frame| with_format(frame, FD)).collect();
            assert_eq!(found_in(&fd, row), None);
        }
    }
}
