//! Buses on which no device is that Proprio knows: nothing is likely on them. And buses with
//! devices of two families: both are found, and nothing else.
//!
//! Identifiers and lengths of cars: opendbc 7343a66d (MIT), `_toyota_2017`, `vw_mqb`, `hyundai_can`
//! and `_honda_common`. Contents are made here, of what car messages consist of: counters,
//! checksums, multiplexers, flags, slow and fast signals, unused bytes.

use crate::findings::traffic;
use crate::recognise::{BOARDS, Row, recorded};
use crate::rig::{options, spec};
use proprio_drivers::{Certainty, Claim, Finding, Frame, Id, Mode, Traffic, recognise};
use proprio_topics::{Nanos, StampKind};

/// The identifiers with 8 bytes, and those with another length.
type Car = (&'static str, &'static [u16], &'static [(u16, usize)]);

const CARS: [Car; 4] = [
    (
        "Toyota",
        &[
            0x024, 0x025, 0x0A6, 0x0AA, 0x0B4, 0x127, 0x1C4, 0x1D3, 0x224, 0x245, 0x260, 0x266,
            0x2E6, 0x320, 0x343, 0x361, 0x382, 0x399, 0x3B0, 0x3B7, 0x3BC, 0x3F1, 0x3FC, 0x411,
            0x412, 0x413, 0x414, 0x420, 0x43B, 0x489, 0x48A, 0x48B, 0x580, 0x581, 0x582, 0x610,
            0x611, 0x614, 0x620, 0x622, 0x623, 0x638, 0x6F3,
        ],
        &[
            (0x3ED, 2),
            (0x078, 4),
            (0x228, 4),
            (0x262, 5),
            (0x2E4, 5),
            (0x077, 6),
            (0x1AA, 6),
            (0x161, 7),
            (0x230, 7),
            (0x365, 7),
        ],
    ),
    (
        "Volkswagen",
        &[
            0x040, 0x041, 0x086, 0x09D, 0x09E, 0x09F, 0x0A7, 0x0A8, 0x0AD, 0x0AE, 0x0B2, 0x0FD,
            0x101, 0x104, 0x106, 0x107, 0x108, 0x116, 0x117, 0x11E, 0x120, 0x121, 0x122, 0x126,
            0x12B, 0x12D, 0x12E, 0x130, 0x15A, 0x187, 0x1A2, 0x1AB, 0x2A7, 0x2A9, 0x2B7, 0x30B,
            0x30C, 0x30F, 0x318, 0x31E, 0x324, 0x32A, 0x32B, 0x32C, 0x365, 0x366, 0x385, 0x391,
            0x392, 0x394, 0x395, 0x397, 0x3B1, 0x3B5, 0x3BE, 0x3C7, 0x3C8, 0x3D5, 0x3D6, 0x3D8,
            0x3DB, 0x3DC, 0x3DD, 0x3DF, 0x3E5, 0x462, 0x463, 0x464, 0x494, 0x497, 0x520, 0x521,
            0x569, 0x585, 0x59D, 0x5A0, 0x5F0, 0x5F8, 0x640, 0x641, 0x642, 0x643, 0x645, 0x647,
            0x658, 0x659, 0x65A, 0x65C, 0x65D, 0x65E, 0x65F, 0x661, 0x66E, 0x670, 0x6B2, 0x6B4,
            0x6B7, 0x6B8,
        ],
        &[(0x128, 3), (0x0AF, 4), (0x3C0, 4)],
    ),
    (
        "Hyundai",
        &[
            0x010, 0x040, 0x042, 0x043, 0x044, 0x07F, 0x080, 0x081, 0x091, 0x111, 0x112, 0x113,
            0x130, 0x140, 0x153, 0x160, 0x165, 0x183, 0x18F, 0x220, 0x251, 0x260, 0x271, 0x280,
            0x316, 0x329, 0x340, 0x356, 0x361, 0x366, 0x367, 0x368, 0x371, 0x372, 0x380, 0x381,
            0x383, 0x384, 0x386, 0x389, 0x38A, 0x38C, 0x38D, 0x391, 0x392, 0x394, 0x410, 0x412,
            0x420, 0x421, 0x428, 0x429, 0x470, 0x483, 0x484, 0x48A, 0x492, 0x495, 0x4A7, 0x4EC,
            0x4F4, 0x50A, 0x50C, 0x515, 0x51B, 0x520, 0x521, 0x522, 0x523, 0x524, 0x525, 0x526,
            0x527, 0x52A, 0x53A, 0x541, 0x544, 0x545, 0x546, 0x547, 0x549, 0x54B, 0x54C, 0x553,
            0x555, 0x556, 0x557, 0x559, 0x55A, 0x55B, 0x563, 0x573, 0x575, 0x57F, 0x583, 0x584,
            0x587, 0x58B, 0x592, 0x596, 0x59D, 0x5A0, 0x5A1, 0x5C0, 0x5C7, 0x5D2, 0x5D3, 0x5D4,
            0x5FA, 0x5FB, 0x5FF,
        ],
        &[
            (0x500, 1),
            (0x400, 2),
            (0x4A2, 2),
            (0x591, 2),
            (0x59A, 2),
            (0x7C0, 2),
            (0x162, 3),
            (0x501, 3),
            (0x550, 3),
            (0x586, 3),
            (0x164, 4),
            (0x393, 4),
            (0x3F9, 4),
            (0x436, 4),
            (0x485, 4),
            (0x4F1, 4),
            (0x502, 4),
            (0x507, 4),
            (0x552, 4),
            (0x562, 4),
            (0x5B0, 4),
            (0x2B0, 5),
            (0x38E, 5),
            (0x38F, 5),
            (0x571, 5),
            (0x5FC, 5),
            (0x030, 6),
            (0x200, 6),
            (0x387, 6),
            (0x42A, 6),
            (0x47F, 6),
            (0x53E, 6),
            (0x593, 6),
            (0x390, 7),
            (0x490, 7),
        ],
    ),
    (
        "Honda",
        &[
            0x091, 0x094, 0x130, 0x13C, 0x158, 0x17C, 0x184, 0x1A4, 0x1C2, 0x1D0, 0x1EA, 0x255,
            0x309, 0x30C, 0x324, 0x35E, 0x374, 0x37B, 0x405, 0x516,
        ],
        &[(0x1AB, 3), (0x223, 6), (0x305, 7)],
    ),
];

/// Numbers that look arbitrary.
struct Random(u64);

impl Random {
    /// A number below `count`.
    fn below(&mut self, count: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005);
        self.0 = self.0.wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % count
    }

    fn byte(&mut self) -> u8 {
        self.below(256).to_le_bytes()[0]
    }
}

/// Two seconds of a bus.
#[derive(Default)]
struct Bus(Vec<(f64, Frame)>);

impl Bus {
    /// A message each `period` \[ms\], the first at `at`; `data` is given its number.
    fn every(&mut self, period: f64, at: f64, id: Id, mut data: impl FnMut(u32) -> Vec<u8>) {
        for turn in 0..10_000_u32 {
            let ms = at + period * f64::from(turn);
            if ms > 2000.0 {
                return;
            }
            self.0.push((ms, Frame::new(id, &data(turn))));
        }
    }

    fn heard(mut self) -> Traffic {
        self.0.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut heard = Traffic::new();
        for (ms, frame) in self.0 {
            let t = Nanos::from_seconds(1000.0 + ms * 1e-3);
            heard.on_frame(&frame.at(t, StampKind::Software));
        }
        heard
    }
}

/// A message as cars have them.
fn message(bus: &mut Bus, random: &mut Random, id: Id, length: usize) {
    let period = [10.0, 20.0, 50.0, 100.0][random.below(4) as usize];
    let at = random.below(10_000) as f64 * 1e-4 * period;
    let kinds: Vec<u64> = (0..length).map(|_| random.below(10)).collect();
    let first: Vec<u8> = (0..length).map(|_| random.byte()).collect();
    let (counter, checksum, mux) = (random.below(3), random.below(3), random.below(6) == 0);
    let mut noise = Random(random.0);
    bus.every(period, at, id, |turn| {
        let slow = (f64::from(turn) * period * 1e-3).sin() * 3000.0;
        let slow = (slow as i16).to_be_bytes();
        let mut data: Vec<u8> = (kinds.iter().zip(&first).enumerate())
            .map(|(place, (kind, first))| match kind {
                0..=2 => 0,
                3 => 0xFF,
                4 => *first,
                5 => first & 1 << (turn / 50 % 8),
                6 | 7 => slow[place % 2],
                8 => first.wrapping_add(noise.byte() & 3),
                _ => noise.byte(),
            })
            .collect();
        let count = turn.to_le_bytes()[0] & 0xF;
        if let (true, Some(byte)) = (mux, data.first_mut()) {
            *byte = turn.to_le_bytes()[0] % 5;
        }
        match (counter, length) {
            (0, 2..) => data[length - 2] = data[length - 2] & 0xF0 | count,
            (1, 2..) => data[1] = data[1] & 0x0F | count << 4,
            _ => {}
        }
        let sum = data
            .iter()
            .fold(id.raw() as u8, |sum, byte| sum.wrapping_add(*byte));
        match (checksum, length) {
            (0, 2..) => data[length - 1] = sum,
            (1, 2..) => data[0] = sum ^ 0x5A,
            _ => {}
        }
        data
    });
}

/// Motors that are commanded in the way of MIT's mini cheetah, and answer on `reply`.
fn mit(motors: std::ops::RangeInclusive<u16>, reply: impl Fn(u16) -> u16, temperature: u8) -> Bus {
    let mut bus = Bus::default();
    for motor in motors {
        let at = f64::from(motor) * 0.3;
        let position = move |turn: u32| {
            let phase = f64::from(turn) * 0.03 + f64::from(motor);
            (32768.0 + 3000.0 * phase.sin()) as u16
        };
        bus.every(5.0, at, Id::standard(motor), |turn| {
            let [high, low] = position(turn).to_be_bytes();
            vec![high, low, 0x7F, 0xF0, 0xA3, 0x33, 0x37, 0xFF]
        });
        bus.every(5.0, at + 0.15, Id::standard(reply(motor)), |turn| {
            let [high, low] = position(turn.saturating_sub(1)).to_be_bytes();
            let moving = 2047.0 + 200.0 * (f64::from(turn) * 0.03 + f64::from(motor)).cos();
            let [a, b] = ((moving as u16) << 4 | 7).to_be_bytes();
            let status = 0x10 | motor.to_le_bytes()[0];
            vec![status, high, low, a, b, 0xFF, temperature, temperature - 3]
        });
    }
    bus
}

/// Motors of MyActuator, and their controllers at several rates: positions with a greatest speed,
/// speeds, currents or questions, with the answers or without. Its commands are on identifiers that
/// other devices have for themselves.
fn commanded(all: &mut Vec<(String, &'static [&'static str], Bus)>) {
    for (period, motors, command, answers) in [1.0, 4.0, 20.0, 50.0, 100.0]
        .into_iter()
        .flat_map(|period| (1..=8).map(move |motors| (period, motors)))
        .flat_map(|(period, motors)| [0xA4, 0xA2, 0xA1, 0x9C].map(|c| (period, motors, c)))
        .flat_map(|(period, motors, c)| [true, false].map(|answers| (period, motors, c, answers)))
    {
        let mut bus = Bus::default();
        for motor in 1..=motors {
            let at = f64::from(motor) * 0.2;
            let position = move |turn: u32| {
                let phase = f64::from(turn) * period * 2e-3 + f64::from(motor);
                ((9000.0 * phase.sin()) as i32, (100.0 * phase.cos()) as i16)
            };
            bus.every(period, at, Id::standard(0x140 + motor), |turn| {
                let (place, speed) = position(turn);
                let value = if command == 0xA4 { place } else { speed.into() };
                let [a, b, c, d] = value.to_le_bytes();
                match command {
                    0xA4 => vec![0xA4, 0, 0xF4, 1, a, b, c, d],
                    0xA1 => vec![0xA1, 0, 0, 0, a, b, 0, 0],
                    0xA2 => vec![0xA2, 0, 0, 0, a, b, c, d],
                    _ => vec![0x9C, 0, 0, 0, 0, 0, 0, 0],
                }
            });
            if answers {
                bus.every(period, at + 0.1, Id::standard(0x240 + motor), |turn| {
                    let (place, speed) = position(turn);
                    let [a, b] = speed.to_le_bytes();
                    let [c, d] = ((place / 100) as i16).to_le_bytes();
                    vec![command, 35, 0x10, 0, a, b, c, d]
                });
            }
        }
        all.push((
            format!("{motors} MyActuator by {command:02X} each {period} ms, answers: {answers}"),
            &["myactuator"],
            bus,
        ));
    }
}

/// What each bus is, the drivers that may find their devices on it, and its frames.
fn controls(seed: u64) -> Vec<(String, &'static [&'static str], Traffic)> {
    let mut all: Vec<(String, &'static [&'static str], Bus)> = Vec::new();
    let random = &mut Random(seed);
    for (name, long, short) in CARS {
        let mut bus = Bus::default();
        for (id, length) in long.iter().map(|id| (*id, 8)).chain(short.iter().copied()) {
            message(&mut bus, random, Id::standard(id), length);
        }
        all.push((name.into(), &[], bus));
    }
    // A few low identifiers, as people number their first devices.
    for count in 1..=8_u16 {
        let mut bus = Bus::default();
        for id in 1..=count {
            message(&mut bus, random, Id::standard(id), 8);
        }
        all.push((format!("{count} numbered from 1"), &[], bus));
    }
    // Actuators. Damiao's answer on their number plus 10, or all on 0.
    all.push((
        "Damiao".into(),
        &["damiao"],
        mit(1..=7, |motor| 0x10 + motor, 31),
    ));
    all.push((
        "Damiao, two".into(),
        &["damiao"],
        mit(1..=2, |motor| 0x10 + motor, 28),
    ));
    all.push(("Damiao on 0".into(), &["damiao"], mit(1..=6, |_| 0, 35)));
    // RobStride: type 2, the motor, the host; commands of type 1 with a torque.
    let mut bus = Bus::default();
    for motor in 1..=6_u32 {
        let at = f64::from(motor) * 0.2;
        let command = Id::extended(0x0180_0000 | 0x7F00 | motor);
        bus.every(10.0, at, command, |_| {
            vec![0x80, 0, 0x80, 0, 0x10, 0, 0x08, 0]
        });
        let reply = Id::extended(0x0280_00FD | motor << 8);
        bus.every(10.0, at + 0.2, reply, |turn| {
            let [a, b] = (0x8000 + (turn * 7 % 900) as u16).to_be_bytes();
            vec![a, b, 0x80, 0x11, 0x7F, 0xF0, 0x01, 0x2C]
        });
    }
    all.push(("RobStride".into(), &["robstride"], bus));
    // MyActuator: requests on 140 plus the number, replies on 240.
    let mut bus = Bus::default();
    for motor in 1..=6_u16 {
        let at = f64::from(motor) * 0.5;
        bus.every(4.0, at, Id::standard(0x140 + motor), |_| {
            vec![0x9C, 0, 0, 0, 0, 0, 0, 0]
        });
        bus.every(4.0, at + 0.2, Id::standard(0x240 + motor), |turn| {
            let [a, b] = ((turn * 5 % 3000) as u16).to_le_bytes();
            vec![0x9C, 35, 0x10, 0, 0xF4, 1, a, b]
        });
    }
    all.push(("MyActuator".into(), &["myactuator"], bus));
    commanded(&mut all);
    // VESC: status 1 of controllers 1 to 4.
    let mut bus = Bus::default();
    for motor in 1..=4_u32 {
        bus.every(
            20.0,
            f64::from(motor),
            Id::extended(0x900 | motor),
            |turn| {
                let [a, b, c, d] = (4000 + turn * 3).to_be_bytes();
                vec![a, b, c, d, 0, 12, 0, 250]
            },
        );
    }
    all.push(("VESC".into(), &["vesc"], bus));
    // RoboMaster: one command to four motors, feedback of each a thousand times a second.
    let mut bus = Bus::default();
    bus.every(2.0, 0.1, Id::standard(0x200), |_| {
        vec![0, 100, 0, 200, 0xFF, 0x9C, 0, 0]
    });
    for motor in 0..4_u16 {
        let at = f64::from(motor) * 0.12;
        bus.every(1.0, at, Id::standard(0x201 + motor), |turn| {
            let [a, b] = ((turn * 23 % 8192) as u16).to_be_bytes();
            vec![a, b, 1, 0x30, 0, 77, 41, 0]
        });
    }
    all.push(("RoboMaster".into(), &[], bus));
    // An unknown sensor of six axes: two frames with a counter.
    for first in [0x001, 0x050, 0x180, 0x310] {
        let mut bus = Bus::default();
        for half in 0..2_u16 {
            let mut noise = Random(seed + u64::from(half));
            let id = Id::standard(first + half);
            bus.every(2.0, 0.2 * f64::from(half), id, |turn| {
                let mut data: Vec<u8> = (0..6).map(|_| noise.byte()).collect();
                data.extend([turn.to_le_bytes()[0], 0]);
                data
            });
        }
        all.push((format!("a sensor on {first:03X}"), &[], bus));
    }
    // J1939: a truck's engine, retarder, brakes and dashboard.
    let mut bus = Bus::default();
    for id in [
        0x0CF0_0400_u32,
        0x0CF0_0300,
        0x18F0_000F,
        0x18F0_010B,
        0x18F0_0E00,
        0x0CF0_0203,
        0x18FE_F100,
        0x18FE_EE00,
        0x18FE_EF00,
        0x18FE_DF00,
        0x18FE_BF0B,
        0x18FE_F600,
        0x18FE_F500,
        0x18FE_E617,
        0x18FE_C117,
        0x18FD_7C00,
        0x18EC_FF00,
        0x18EB_FF00,
        0x0CFE_6CEE,
    ] {
        message(&mut bus, random, Id::extended(id), 8);
    }
    all.push(("J1939".into(), &[], bus));
    // Frames of one form: on one block of identifiers, in steps, and on all.
    for (step, count) in [
        (1, 16),
        (1, 128),
        (1, 0x800),
        (2, 64),
        (4, 64),
        (8, 64),
        (16, 64),
        (32, 64),
    ] {
        let start = random.below(u64::from(0x800 - step * (count - 1))) as u16;
        for (form, length) in [(0, 8), (1, 8), (2, 8), (3, 8), (0, 4), (1, 6), (2, 1)] {
            let mut bus = Bus::default();
            let constant: Vec<u8> = (0..length).map(|_| random.byte()).collect();
            for k in 0..count {
                let mut noise = Random(seed ^ u64::from(k));
                let id = Id::standard(start + k * step);
                bus.every(100.0, f64::from(k) * 0.04, id, |turn| match form {
                    0 => vec![0; length],
                    1 => constant.clone(),
                    2 => (0..length).map(|_| noise.byte()).collect(),
                    _ => vec![turn.to_le_bytes()[0], 0, 0, 0, 0, 0, 0, 0],
                });
            }
            all.push((
                format!("{count} of form {form}/{length} from {start:03X} by {step}"),
                &[],
                bus,
            ));
        }
    }
    // One to four arbitrary identifiers, of 11 bits or 29, with all kinds of contents.
    for form in 0..4 {
        for count in 1..=4 {
            let mut bus = Bus::default();
            for _ in 0..count {
                let id = match random.below(3) {
                    0 => Id::standard(random.below(0x20) as u16),
                    1 => Id::standard(random.below(0x800) as u16),
                    _ => Id::extended(random.below(1 << 29) as u32),
                };
                let constant: Vec<u8> = (0..8).map(|_| random.byte()).collect();
                let mut noise = Random(random.0);
                bus.every(10.0, random.below(10) as f64, id, |turn| match form {
                    0 => vec![0; 8],
                    1 => constant.clone(),
                    2 => (0..8).map(|_| noise.byte()).collect(),
                    _ => [&turn.to_le_bytes()[..], &[0; 4]].concat(),
                });
            }
            all.push((format!("{count} arbitrary of form {form}"), &[], bus));
        }
    }
    let heard = |(name, own, bus): (String, &'static [&'static str], Bus)| (name, own, bus.heard());
    all.into_iter().map(heard).collect()
}

/// Two to eight frames of one form in a row, wherever that is.
fn rows(seed: u64) -> Vec<(String, Traffic)> {
    let random = &mut Random(seed);
    let mut row = |count: u16| {
        let start = random.below(u64::from(0x800 - count)) as u16;
        let (form, constant) = (random.below(4), random.below(1 << 62).to_le_bytes());
        let mut bus = Bus::default();
        for k in 0..count {
            let mut noise = Random(seed ^ u64::from(k));
            let id = Id::standard(start + k);
            bus.every(20.0, f64::from(k) * 0.3, id, |turn| match form {
                0 => vec![0; 8],
                1 => constant.to_vec(),
                2 => (0..8).map(|_| noise.byte()).collect(),
                _ => [&turn.to_le_bytes()[..], &constant[4..]].concat(),
            });
        }
        let name = format!("{count} of form {form} from {start:03X}");
        (name, bus.heard())
    };
    (0..2000).map(|k| row(2 + k % 7)).collect()
}

/// What is likely, and more.
fn likely(heard: &Traffic) -> Vec<Finding> {
    let mut all = recognise(heard);
    all.retain(|finding| finding.certainty() >= Some(Certainty::Likely));
    all
}

#[test]
fn nothing_is_likely_on_a_bus_without_a_device_that_is_known() {
    let mut wrong = Vec::new();
    let mut buses = 0;
    for seed in 1..=6 {
        for (name, own, heard) in controls(seed) {
            buses += 1;
            for finding in likely(&heard) {
                if !own.contains(&finding.driver) {
                    let (driver, address, bits) = (finding.driver, finding.address, finding.bits);
                    wrong.push(format!("{name} ({seed}): {driver} {address}, {bits:.1}"));
                }
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "{} of {buses} buses:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}

/// `likely` is a promise: on a bus without a device that is known, one of 120 at most.
#[test]
fn likely_is_wrong_on_one_of_120_buses_at_most() {
    let mut wrong = Vec::new();
    let rows = rows(7);
    for (name, heard) in &rows {
        let found = likely(heard).into_iter();
        wrong.extend(found.map(|f| format!("{name}: {} {}, {:.1}", f.driver, f.address, f.bits)));
    }
    let (few, all) = (wrong.len() * 120 <= rows.len(), wrong.join("\n"));
    assert!(few, "{} of {}:\n{all}", wrong.len(), rows.len());
}

/// Motors of CubeMars 1 and 2 and their controller: the frames on the identifiers of delivery of
/// two other sensors are these motors' commands.
#[test]
fn the_commands_of_motors_are_no_sensor() {
    for torque in [0x7FF, 0x801] {
        let mut bus = Bus::default();
        for motor in 1..=2_u16 {
            let at = 0.3 * f64::from(motor);
            let position = |turn: u32| (35_000.0 + 20.0 * f64::from(turn)) as u16;
            bus.every(5.0, at, Id::standard(motor), |turn| {
                let [a, b] = position(turn).to_be_bytes();
                vec![a, b, 0x81, 0x50, 0xA3, 0x33, 0x37, 0xFF]
            });
            bus.every(5.0, at + 0.1, Id::standard(0), |turn| {
                let [a, b] = position(turn).to_be_bytes();
                let [c, d] = (0x8150_u16 | torque >> 8).to_be_bytes();
                let torque = torque.to_le_bytes()[0];
                vec![motor.to_le_bytes()[0], a, b, c, d, torque, 0x46, 0]
            });
        }
        let found = recognise(&bus.heard());
        let mut named: Vec<(&str, u32)> = found.iter().map(|f| (f.driver, f.address)).collect();
        named.sort_unstable();
        assert_eq!(named, [("cubemars", 1), ("cubemars", 2)], "{found:?}");
        let sure = |found: &Finding| found.certainty() >= Some(Certainty::Likely);
        assert!(found.iter().all(sure), "{found:?}");
    }
}

/// A motor of CubeMars that replies on its own number, on which it is commanded, too.
#[test]
fn a_motor_is_found_among_its_commands() {
    let mut bus = Bus::default();
    let position = |turn: u32| (33_000.0 + 3000.0 * (f64::from(turn) * 0.03).sin()) as u16;
    bus.every(5.0, 0.3, Id::standard(7), |turn| {
        let [a, b] = position(turn).to_be_bytes();
        vec![a, b, 0x7F, 0xF0, 0xA3, 0x33, 0x37, 0xFF]
    });
    bus.every(5.0, 0.4, Id::standard(7), |turn| {
        let [a, b] = position(turn).to_be_bytes();
        let velocity = 2047.0 + 300.0 * (f64::from(turn) * 0.03).cos();
        let [c, d] = ((velocity as u16) << 4 | 7).to_be_bytes();
        vec![7, a, b, c, d, 0xFF, 0x46, 0]
    });
    let found = likely(&bus.heard());
    let named: Vec<(&str, u32)> = found.iter().map(|f| (f.driver, f.address)).collect();
    assert_eq!(named, [("cubemars", 7)], "{found:?}");
}

/// A node of a profile that no driver reads is named as such, and taken for nothing else.
#[test]
fn an_unknown_node_is_a_node() {
    let mut bus = Bus::default();
    let node = 0x15;
    bus.every(100.0, 3.0, Id::standard(0x700 + node), |_| vec![5]);
    bus.every(10.0, 1.0, Id::standard(0x180 + node), |turn| {
        turn.to_le_bytes()[..2].to_vec()
    });
    bus.every(500.0, 7.0, Id::standard(0x600 + node), |_| {
        vec![0x40, 0, 0x10, 0, 0, 0, 0, 0]
    });
    bus.every(500.0, 7.4, Id::standard(0x580 + node), |_| {
        vec![0x43, 0, 0x10, 0, 0x91, 1, 0x0F, 0]
    });
    let found = likely(&bus.heard());
    let named: Vec<(u32, bool)> = found
        .iter()
        .map(|found| (found.address, found.unusable.is_empty()))
        .collect();
    assert_eq!(named, [(0x15, false)], "{found:?}");
}

/// The identifiers of frames, and those that the device of `row` reads.
fn uses<'f>(row: &Row, frames: &'f [Frame]) -> (Vec<Claim>, impl Iterator<Item = Id> + 'f) {
    let (driver, keys, address, outputs) = *row;
    let spec = spec(address, Mode::Listen, outputs);
    let device = options(driver, keys).device(&spec).expect("legal keys");
    (
        device.claims().to_vec(),
        frames.iter().map(|frame| frame.id),
    )
}

/// Frames of two boards on one bus, unless one reads what the other sends or is commanded by it, or
/// both send on one identifier.
fn both(a: (&Row, &[Frame]), b: (&Row, &[Frame])) -> Option<Traffic> {
    for ((row, frames), (_, others)) in [(a, b), (b, a)] {
        let (claims, mut ids) = uses(row, frames);
        let alone = recognise(&traffic(frames));
        let commands: Vec<_> = alone.iter().flat_map(|found| &found.commands).collect();
        let read = |frame: &Frame| {
            claims.iter().any(|claim| claim.matches(frame.id))
                || commands.iter().any(|ids| ids.contains(&frame.id))
        };
        if others.iter().any(read) || ids.any(|id| others.iter().any(|frame| frame.id == id)) {
            return None;
        }
    }
    let mut all = [a.1, b.1].concat();
    all.sort_by_key(|frame| frame.t);
    Some(traffic(&all))
}

/// The devices of `row`: a board of iCub may have others.
fn is_its(found: &Finding, row: &Row) -> bool {
    let icub = |driver: &str| driver.starts_with("icub");
    (found.driver, found.address) == (row.0, row.2)
        || icub(found.driver) && icub(row.0) && found.address == row.2
}

#[test]
fn two_families_on_one_bus_are_found_and_nothing_else() {
    let frames: Vec<Vec<Frame>> = BOARDS.iter().map(|row| recorded(row, 1500)).collect();
    let (mut wrong, mut pairs) = (Vec::new(), 0);
    for (a, row_a) in BOARDS.iter().enumerate() {
        for (b, row_b) in BOARDS.iter().enumerate().skip(a + 1) {
            let Some(heard) = both((row_a, &frames[a]), (row_b, &frames[b])) else {
                continue;
            };
            pairs += 1;
            let found = likely(&heard);
            for row in [row_a, row_b] {
                if !found
                    .iter()
                    .any(|f| (f.driver, f.address) == (row.0, row.2))
                {
                    wrong.push(format!("{row:?} is lost beside {row_a:?} {row_b:?}"));
                }
            }
            for other in found
                .iter()
                .filter(|f| !is_its(f, row_a) && !is_its(f, row_b))
            {
                let (driver, address) = (other.driver, other.address);
                wrong.push(format!(
                    "{driver} {address} is found in {row_a:?} {row_b:?}"
                ));
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "{} of {pairs} pairs:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
    assert!(pairs > 350, "{pairs}");
}
