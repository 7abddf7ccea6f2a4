//! Arbitrary frames in any order at any time cause no panic, no endless loop, and no non-finite
//! number in a wrench, but for the torque of a sensor that measures none.

use crate::rig::{options, spec};
use proprio_drivers::{Board, Claim, Decoded, Device, Format, Frame, Frames, Id, Mode, NotSent};
use proprio_topics::{Nanos, Quality, Reading, StampKind};
use proptest::prelude::*;

/// Every family in all its configurations.
const SETUPS: &[(&str, &str, &[u8])] = &[
    ("icub_strain", "", &[]),
    (
        "icub_strain",
        "full_scale_n = [9, 9, 9]\nfull_scale_nm = [1, 1, 1]\ntemperature_period_s = 1",
        &[],
    ),
    (
        "icub_strain",
        "stream = \"both\"\npower_on_silence_ms = 20",
        &[],
    ),
    ("icub_imu", "", &[]),
    (
        "icub_imu",
        "quantities = [\"acceleration\", \"magnetic_field\", \"angular_velocity\", \
         \"orientation\", \"status\"]",
        &[],
    ),
    ("icub_imu", r#"legacy = "mtb""#, &[]),
    ("icub_imu", r#"legacy = "bno055""#, &[]),
    ("icub_motor", "", &[0]),
    ("icub_mc4", "", &[0, 1]),
    ("icub_mc4", "velocity_shift = [0, 15]\nhold_ms = 1000", &[1]),
    ("icub_pos", "", &[0, 1, 2, 15]),
    ("icub_pos", "sensors = [{ label = 2 }]", &[2, 3]),
    ("icub_skin", "", &[]),
    (
        "icub_skin",
        "triangles = [3, 5]\npair_timeout_ms = 4.0",
        &[],
    ),
    ("icub_mais", "", &[0, 6, 7, 14]),
    ("ati_netcanoem", "", &[]),
    ("ati_netcanoem", crate::ati::KEYS, &[]),
    ("canopen_encoder", "", &[0]),
    ("canopen_encoder", "counts_per_turn = 10\nsync = 1", &[0]),
    ("canopen_drive", "", &[0]),
    (
        "canopen_drive",
        "counts_per_turn = 10\nrated_torque = 1.0\nrated_current = 1.0\n\
         pdos = [{ number = 1, objects = [0x6041, 0x6064], sync = 1 }, \
         { number = 2, objects = [0x606C, 0x6077], sync = 1 }, \
         { number = 3, objects = [0x603F, 0x6061, 0x6078] }]",
        &[0],
    ),
    ("canopen_sync", "", &[]),
    ("moteus", "", &[0]),
    ("moteus", "host = 7", &[0]),
    ("odrive", "", &[0]),
    (
        "odrive",
        "request_period_ms = 5\ntorque_constant = 0.1",
        &[0],
    ),
    ("odrive", "firmware = \"0.5\"\nrequest_period_ms = 2", &[0]),
    ("cubemars", "model = \"AK80-9\"", &[0]),
    (
        "cubemars",
        "model = \"AK60-6\"\nhost_id = 1\neffort = \"current\"\neffort_max = 40.0",
        &[0],
    ),
    (
        "cubemars",
        "mode = \"servo\"\nmodel = \"AK10-9\"\nangle = \"electrical\"\ntorque_constant = 1.0",
        &[0],
    ),
    ("damiao", "model = \"DM4310\"", &[0]),
    ("damiao", "host_id = 0x11\nrequest_period_ms = 2", &[0]),
    (
        "damiao",
        "model = \"DM8009\"\nrequest_period_ms = 2\nfd = true",
        &[0],
    ),
    ("myactuator", "", &[0]),
    ("myactuator", "position = \"motion\"", &[0]),
    (
        "myactuator",
        "protocol = \"v2\"\nrequest_period_ms = 2",
        &[0],
    ),
    ("robstride", "model = \"RS03\"", &[0]),
    (
        "robstride",
        "model = \"CyberGear\"\nprotocol = \"mit\"",
        &[0],
    ),
    ("robstride", "model = \"RS00\"\nrequest_period_ms = 2", &[0]),
    ("vesc", "pole_pairs = 7\ntorque_constant = 0.1", &[0]),
    ("vesc", "pole_pairs = 7\nposition = \"tachometer\"", &[0]),
    ("xsens_mti", "", &[]),
    (
        "xsens_mti",
        "quantities = [\"sample_time\", \"group_counter\", \"status\", \"orientation\", \
         \"angular_velocity\", \"acceleration\", \"magnetic_field\"]\nmagnetic_unit = 50e-6\n\
         sample_time_unit_us = 1\nquaternion_one = 32768",
        &[],
    ),
    (
        "xsens_mti",
        "quantities = [\"acceleration\", \"angular_velocity\"]\nhigh_rate = \"rate_first\"\n\
         extended = true\nperiod_ms = 1.0",
        &[],
    ),
    (
        "xsens_mti",
        "quantities = [\"group_counter\", \"orientation\"]\nidentifiers = { error = 2 }",
        &[],
    ),
    ("openimu", "", &[]),
    (
        "openimu",
        "quantities = [\"orientation\", \"acceleration\", \"angular_velocity\"]\naxes = \"xyz\"\n\
         acceleration_z = \"down\"\nperiod_ms = 500",
        &[],
    ),
    ("openimu", "quantities = [\"orientation\"]", &[]),
    ("robotous_rft", "", &[]),
    ("robotous_rft", "rate_hz = 1000", &[]),
    ("aidin_aft200", "", &[]),
    ("jr3_can", "", &[]),
    (
        "jr3_can",
        "full_scale_n = [9, 9, 9]\nfull_scale_nm = [1, 1, 1]\nperiod_ms = 1",
        &[],
    ),
    ("optoforce_daq", "counts_per_newton = [26, 28, 3]", &[]),
    (
        "optoforce_daq",
        "counts_per_newton = [26, 28, 3]\nrate_hz = 1000\nzero = true\nfill = false",
        &[],
    ),
    ("dbc", crate::dbc::WRENCH, &[]),
    ("dbc", crate::dbc::DRIVE, &[0]),
    ("dbc", crate::dbc::PAGES, &[]),
];

/// About 18 years: clocks may jump, but not to the limits of `i64` nanoseconds.
const YEARS: i64 = 1 << 59;

/// Events of the bus and the clock.
#[derive(Debug, Clone)]
enum Event {
    Frame {
        id: u16,
        pick: u32,
        any: Option<u32>,
        format: u8,
        data: Vec<u8>,
        command: Option<u8>,
        stamped: bool,
    },
    Pass {
        ns: i64,
    },
    Poll {
        sent: bool,
    },
    Restart,
    Stop,
}

fn event() -> impl Strategy<Value = Event> {
    let data = prop_oneof![
        // Mostly lengths of the protocol.
        8 => proptest::collection::vec(any::<u8>(), 4..=8),
        1 => proptest::collection::vec(any::<u8>(), 0..=8),
    ];
    // For iCub boards: streams and replies of address 1 in all classes, and commands to address 1
    // and to all boards, to exercise the board too. Half of the frames have an identifier that the
    // device claims, or that of its last command, whatever the family.
    let id = prop_oneof![
        4 => (0_u16..8, 0_u16..16).prop_map(|(class, low)| class << 8 | 0x10 | low),
        1 => prop_oneof![Just(0x001), Just(0x201), Just(0x20F), Just(0x701), Just(0x70F)],
    ];
    let command = proptest::option::of(prop_oneof![
        Just(0x18),
        Just(0x33),
        Just(0x07),
        Just(0x34),
        Just(0x35),
        Just(0x51),
        Just(0x53)
    ]);
    let any_id = proptest::option::weighted(0.1, any::<u32>());
    prop_oneof![
        40 => (
            (id, any::<u32>(), any_id),
            0_u8..20, data, command, proptest::bool::weighted(0.9)
        )
            .prop_map(|((id, pick, any), format, data, command, stamped)| {
                Event::Frame { id, pick, any, format, data, command, stamped }
            }),
        10 => prop_oneof![
            0_i64..1_000_000, 0_i64..100_000_000, -5_000_000_i64..2_000_000_000, -YEARS..YEARS
        ]
            .prop_map(|ns| Event::Pass { ns }),
        10 => any::<bool>().prop_map(|sent| Event::Poll { sent }),
        1 => Just(Event::Restart),
        1 => Just(Event::Stop),
    ]
}

fn to_frame(event: &Event, claims: &[Claim], command_id: Option<Id>, now: Nanos) -> Option<Frame> {
    let Event::Frame {
        id,
        pick,
        any,
        format,
        data,
        command,
        stamped,
    } = event
    else {
        return None;
    };
    let mut data = data.clone();
    if let (Some(command), Some(first)) = (command, data.first_mut()) {
        *first = *command;
    }
    let some_id = |claim: &Claim| match claim.id {
        Id::Standard(raw) => Id::standard(raw | (*pick & !claim.mask) as u16),
        Id::Extended(raw) => Id::extended(raw | *pick & !claim.mask),
    };
    let claimed = claims
        .get(*pick as usize / 8 % claims.len().max(1))
        .map(some_id);
    let id = match (any, pick % 8) {
        (Some(any), _) => Id::extended(*any),
        (None, 0) => command_id.unwrap_or(Id::standard(*id)),
        (None, 1..=3) => claimed.unwrap_or(Id::standard(*id)),
        (None, _) => Id::standard(*id),
    };
    let format = match format {
        0 => Format::Fd {
            bit_rate_switch: true,
            error_state: false,
        },
        1 => Format::Remote,
        2 => Format::Error,
        _ => Format::Classic,
    };
    let stamp = if *stamped {
        StampKind::Software
    } else {
        StampKind::None
    };
    Frame::with_format(id, format, &data).map(|frame| frame.at(now, stamp))
}

fn is_finite(reading: &Reading) -> bool {
    match reading {
        // A sensor with three axes reports no torque at all.
        Reading::Wrench(wrench) => {
            let absent = wrench.torque.iter().all(|value| value.is_nan());
            let mut torque = wrench
                .torque
                .iter()
                .map(|value| absent || value.is_finite());
            wrench.force.iter().all(|value| value.is_finite()) && torque.all(|finite| finite)
        }
        Reading::Imu(imu) => imu
            .proper_acceleration
            .iter()
            .chain(&imu.angular_velocity)
            .all(|value| !value.is_infinite()),
        Reading::Joint(joint) => joint.position.is_finite(),
        Reading::Temperature(temperature) => temperature.celsius.is_finite(),
        Reading::Actuator(actuator) => !actuator.duty.is_infinite(),
        Reading::Gauges(_) | Reading::Skin(_) => true,
    }
}

fn drive(device: &mut dyn Device, board: &mut dyn Board, events: &[Event], listens: bool) {
    let mut now = Nanos::from_millis(1000);
    let mut out = Decoded::new();
    let mut command_id = None;
    for event in events {
        out.clear();
        match event {
            Event::Frame { .. } => {
                let Some(frame) = to_frame(event, device.claims(), command_id, now) else {
                    continue;
                };
                device.on_frame(&frame, &mut out);
                let mut answers = Frames::new();
                board.on_frame(&frame, &mut answers);
                for answer in answers {
                    device.on_frame(&answer.at(now, StampKind::Software), &mut out);
                }
            }
            Event::Pass { ns } => now = Nanos((now.0 + ns).clamp(-YEARS, YEARS)),
            Event::Poll { sent } => {
                for turn in 0.. {
                    assert!(turn < 32, "it never stops sending");
                    let Some(transmit) = device.poll_transmit(now, &mut out) else {
                        break;
                    };
                    assert!(!listens, "a listener sends {transmit:?}");
                    command_id = Some(transmit.frame.id);
                    let outcome = if *sent {
                        Ok(now)
                    } else {
                        Err(NotSent::Refused)
                    };
                    device.on_sent(&transmit.frame, outcome);
                    let mut answers = Frames::new();
                    board.on_frame(&transmit.frame, &mut answers);
                }
            }
            Event::Restart => device.restart(now),
            Event::Stop => device.stop(now),
        }
        let _ = (device.state(), device.next_wake(), board.period());
        for stamped in &out.readings {
            assert!(is_finite(&stamped.reading), "{stamped:?}");
            // Decoded readings can be encoded again (a wrench only if the board knows its scale).
            let mut frames = Frames::new();
            let _ = board.encode(
                stamped.output,
                &stamped.reading,
                stamped.quality | Quality::GOOD,
                &mut frames,
            );
        }
    }
}

proptest! {
    #[test]
    fn does_no_harm(
        setup in 0..SETUPS.len(), listens: bool,
        events in proptest::collection::vec(event(), 1..300),
    ) {
        let (driver, keys, outputs) = SETUPS[setup];
        let mode = if listens { Mode::Listen } else { Mode::Supervise };
        let options = options(driver, keys);
        let spec = spec(options.default_address().unwrap_or(1), mode, outputs);
        let mut device = options.device(&spec).unwrap();
        let mut board = options.board(&spec).unwrap();
        let silent = match driver {
            "icub_motor" => true,
            "optoforce_daq" => !keys.contains("rate_hz"),
            _ => false,
        };
        drive(&mut *device, &mut *board, &events, listens || silent);
    }
}

/// Sensors, encoders and motors of one board can be configured together; two devices of the same
/// kind cannot.
#[test]
fn claims_are_exclusive_within_a_kind_only() {
    let claims = |driver: &str, outputs: &[u8], address| {
        let device = options(driver, "")
            .device(&spec(address, Mode::Supervise, outputs))
            .unwrap();
        device.claims().to_vec()
    };
    let collide = |a: &[Claim], b: &[Claim]| {
        a.iter().any(|a| {
            b.iter()
                .any(|b| a.exclusive && b.exclusive && a.overlaps(b))
        })
    };
    let families: [(&str, &[u8]); 6] = [
        ("icub_strain", &[]),
        ("icub_imu", &[]),
        ("icub_motor", &[0]),
        ("icub_pos", &[0]),
        ("icub_skin", &[]),
        ("icub_mais", &[0]),
    ];
    for (k, (driver, outputs)) in families.iter().enumerate() {
        let mine = claims(driver, outputs, 13);
        assert!(collide(&mine, &mine), "{driver} shares its streams");
        assert!(
            !collide(&mine, &claims(driver, outputs, 12)),
            "{driver} takes another address's streams"
        );
        for (other, outputs) in families.iter().skip(k + 1) {
            assert!(
                !collide(&mine, &claims(other, outputs, 13)),
                "{driver} and {other}"
            );
        }
    }
}
