//! The cost of decoding a frame, for each driver: `cargo bench -p proprio-gateway --bench decode`.
//!
//! The frames are those of the driver's own board. Where the host asks first, host and board talk
//! for a while, and what the board said is decoded again and again, with stamps that go on. Only
//! [`proprio_drivers::Device::on_frame`] is timed.

use divan::Bencher;
use divan::counter::ItemsCount;
use proprio_drivers::{Board, DRIVERS, Decoded, Device, Frame, Frames, Mode};
use proprio_gateway::devices::build;
use proprio_gateway::plan::{DevicePlan, Plan};
use proprio_topics::{
    Gauges, Imu, JointState, Kind, Nanos, Quality, Reading, Skin, StampKind, Temperature, Wrench,
};
use std::io::Write as _;

/// The keys that a driver needs beside those that all devices have.
const KEYS: &[(&str, &str)] = &[
    (
        "icub_strain",
        "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]",
    ),
    ("optoforce_daq", "counts_per_newton = [26.42, 28.8, 3.02]"),
    ("cubemars", "model = \"AK80-9\""),
    ("damiao", "model = \"DM4310\""),
    ("robstride", "model = \"RS03\""),
    ("vesc", "pole_pairs = 7"),
    (
        "dbc",
        "file = \"bench.dbc\"\nperiod_ms = 1\n[[bus.device.reading]]\nkind = \"wrench\"\n\
         pair_timeout_ms = 0.4\nfields = { fx = \"F.X\", fy = \"F.Y\", fz = \"F.Z\", \
         tx = \"T.X\", ty = \"T.Y\", tz = \"T.Z\" }",
    ),
];

const DESCRIPTION: &str = "\
BO_ 4 F: 6 X
 SG_ X : 0|16@1- (0.1,0) [0|0] \"N\" X
 SG_ Y : 16|16@1- (0.1,0) [0|0] \"N\" X
 SG_ Z : 32|16@1- (0.1,0) [0|0] \"N\" X
BO_ 5 T: 6 X
 SG_ X : 7|16@0- (0.1,0) [0|0] \"Nm\" X
 SG_ Y : 23|16@0- (0.1,0) [0|0] \"Nm\" X
 SG_ Z : 39|16@0- (0.1,0) [0|0] \"Nm\" X
";

/// The plan of one device, with a joint if it needs one.
fn plan(driver: &str) -> DevicePlan {
    let folder = tempfile::tempdir().expect("a folder");
    let mut file = std::fs::File::create(folder.path().join("bench.dbc")).expect("a file");
    file.write_all(DESCRIPTION.as_bytes()).expect("written");
    let keys = KEYS.iter().find(|(name, _)| *name == driver);
    let keys = keys.map_or("", |(_, keys)| keys);
    let head = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
         source = {{ kind = \"virtual\", name = \"b\" }}\n[[bus.device]]\ndriver = {driver:?}\n\
         name = \"d\"\nmax_silence_ms = 2000.0\n"
    );
    let (mut address, mut joint) = ("", "");
    loop {
        let plan = Plan::parse(&format!("{head}{address}{keys}\n{joint}"), folder.path());
        match plan {
            Err(problem) if problem.contains("address is missing") => address = "address = 1\n",
            Err(problem) if problem.contains("needs a joint") => {
                joint = "[[bus.device.joint]]\nname = \"j\"\n";
            }
            plan => return plan.expect(driver).buses.remove(0).devices.remove(0),
        }
    }
}

/// A reading that changes with `step`.
fn reading(kind: Kind, step: i64) -> Option<Reading> {
    let x = 0.01 * (step % 100) as f64;
    Some(match kind {
        Kind::Joint => Reading::Joint(JointState {
            position: x,
            velocity: 1.0 - x,
            acceleration: 0.0,
            torque: 2.0 * x,
            current: 0.1 + x,
        }),
        Kind::Wrench => Reading::Wrench(Wrench {
            force: [1.0 + x, 2.0 - x, 3.0 * x],
            torque: [0.1 * x, 0.2 + x, 0.3 - x],
        }),
        Kind::Imu => Reading::Imu(Imu {
            proper_acceleration: [x, -x, 9.81],
            angular_velocity: [x, 1.0, -x],
            angular_acceleration: [0.0; 3],
            magnetic_field: [2e-5; 3],
            orientation: [1.0, 0.0, 0.0, 0.0],
        }),
        Kind::Gauges => Reading::Gauges(Gauges { counts: [7; 6] }),
        Kind::Temperature => Reading::Temperature(Temperature { celsius: 20.0 + x }),
        Kind::Skin => Reading::Skin(Skin {
            triangle: 3,
            taxels: [x; 12],
        }),
        Kind::Actuator => return None,
    })
}

/// The frames of the first seconds that the device claims, each with its time.
fn conversation(plan: &DevicePlan) -> Vec<(Nanos, Frame)> {
    const STEP: Nanos = Nanos::from_micros(500);
    let mut spec = plan.spec.clone();
    spec.mode = Mode::Supervise;
    let mut host = plan.options.device(&spec).expect("a device");
    let mut board = plan.options.board(&spec).expect("a board");
    let (mut heard, mut out) = (Vec::new(), Decoded::new());
    let mut due = Nanos::ZERO;
    for step in 0..8_000 {
        let now = Nanos(step * STEP.0);
        let mut frames = Frames::new();
        present(plan, &mut *board, step);
        while let Some(sent) = host.poll_transmit(now, &mut out) {
            // Whoever listens needs the questions too.
            heard.push((now, sent.frame));
            board.on_frame(&sent.frame, &mut frames);
            host.on_sent(&sent.frame, Ok(now));
        }
        if board.period().is_some_and(|_| now >= due) {
            due = now + board.period().unwrap_or(STEP);
            for output in &plan.outputs {
                if let Some(reading) = reading(output.kind, step) {
                    let _ = board.encode(output.number, &reading, Quality::GOOD, &mut frames);
                }
            }
        }
        for frame in &frames {
            heard.push((now, *frame));
            if host.claims().iter().any(|claim| claim.matches(frame.id)) {
                host.on_frame(&frame.at(now, StampKind::Software), &mut out);
            }
        }
        out.clear();
    }
    heard.retain(|(_, frame)| host.claims().iter().any(|claim| claim.matches(frame.id)));
    heard
}

fn present(plan: &DevicePlan, board: &mut dyn Board, step: i64) {
    for output in &plan.outputs {
        if let Some(reading) = reading(output.kind, step) {
            board.present(output.number, &reading, Quality::GOOD);
        }
    }
}

#[divan::bench(args = DRIVERS.iter().filter(|name| **name != "canopen_sync"))]
fn frame(bencher: Bencher<'_, '_>, driver: &str) {
    let plan = plan(driver);
    let heard = conversation(&plan);
    let mut device: Box<dyn Device> = build(&plan, Some(Mode::Listen)).expect("a device");
    let (mut out, mut shift) = (Decoded::new(), Nanos::ZERO);
    // After the start: the second half.
    let (start, rest) = heard.split_at(heard.len() / 2);
    for (t, frame) in start {
        device.on_frame(&frame.at(*t, StampKind::Software), &mut out);
        out.clear();
    }
    let span = |frames: &[(Nanos, Frame)]| match frames {
        [(first, _), .., (last, _)] => *last - *first + Nanos::from_millis(1),
        _ => panic!("{driver}: the board said nothing"),
    };
    let mut readings = 0;
    bencher
        .counter(ItemsCount::new(rest.len()))
        .bench_local(|| {
            for (t, frame) in rest {
                device.on_frame(&frame.at(*t + shift, StampKind::Software), &mut out);
                readings += out.readings.len();
                out.clear();
            }
            shift += span(rest);
        });
    let state = device.state();
    assert!(
        readings > 0,
        "{driver}: frames, but no readings: {state:?}, {:?}",
        &rest[..6]
    );
}

fn main() {
    divan::main();
}
