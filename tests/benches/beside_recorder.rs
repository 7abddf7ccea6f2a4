//! What a recorder costs the daemons beside it: latencies of samples and torques with and without
//! one, in turns, on two full buses; and whether it loses a frame that it does not count.
//!
//! `cargo bench -p proprio-tests --bench beside_recorder -- --seconds 600`
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::indexing_slicing)]

use proprio_drivers::{Frame, Id};
use proprio_gateway::clock::sleep_until;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link as _, send_by};
use proprio_recording::frames;
use proprio_tests::watch::{open, valid_since};
use proprio_tests::{Arm, PATIENCE, Rig};
use proprio_topics::ipc::{Reader, Topic, monotonic};
use proprio_topics::{Nanos, Sample, TorqueEstimate};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread;

/// Of the frames that fill a bus; no device has it.
const FILLER: Id = Id::standard(0x7F0);
/// Frames of eight bytes per second that a bus of 1 Mbit/s carries: 111 bits and stuff bits.
const FULL: u64 = 8_000;
/// A round.
const ROUND: f64 = 30.0;

/// Sends so many frames per second, each with its number, until `stop`.
fn fill(domain: &str, bus: &str, rate: u64, stop: &AtomicBool) {
    let mut link = VirtualBus::open(domain, bus, &[FILLER_CLAIM]).unwrap();
    let (mut number, mut next) = (0_u64, monotonic());
    while !stop.load(Relaxed) {
        for _ in 0..rate / 1000 {
            let frame = Frame::new(FILLER, &number.to_le_bytes());
            if send_by(&mut link, &frame, monotonic() + Nanos::from_millis(10)).is_ok() {
                number += 1;
            }
        }
        // What others send is not read here; the socket drops it.
        let _ = link.counters();
        next += Nanos::from_millis(1);
        sleep_until(next);
    }
}

/// The filler's own identifier: so that nothing else wakes its link.
const FILLER_CLAIM: proprio_drivers::Claim = proprio_drivers::Claim::exclusive(FILLER);

/// Latencies of one topic: from acquisition to publication.
struct Latencies<T: Topic> {
    reader: Reader<T>,
    found: [Vec<i64>; 2],
}

impl<T: Topic> Latencies<T> {
    fn take(&mut self, with_recorder: bool) {
        while let Ok(Some(payload)) = self.reader.try_take() {
            let header = payload.header();
            let latency = (header.published - header.acquired).0;
            self.found[usize::from(with_recorder)].push(latency);
        }
    }

    fn print(&mut self, what: &str) {
        for (found, condition) in self.found.iter_mut().zip(["alone", "beside a recorder"]) {
            found.sort_unstable();
            let at = |share: f64| match found.is_empty() {
                true => f64::NAN,
                false => found[((found.len() - 1) as f64 * share) as usize] as f64 * 1e-3,
            };
            println!(
                "{what:<8} {condition:<18} {:>9} payloads, median {:>6.0} us, 99 % {:>6.0} us, \
                 99.9 % {:>6.0} us, {} lost by this reader",
                found.len(),
                at(0.5),
                at(0.99),
                at(0.999),
                self.reader.lost(),
            );
        }
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let named = arguments.iter().position(|it| it == "--seconds");
    let named = named.and_then(|place| arguments.get(place + 1)?.parse().ok());
    let is_bench = arguments.iter().any(|it| it == "--bench");
    let seconds: f64 = named.unwrap_or(if is_bench { 120.0 } else { 4.0 });
    let round = ROUND.min(seconds / 2.0);

    let rig = Rig::new();
    let arm = Arm::new()
        .periods(1, 5, 2)
        .on_virtual(["a", "b"])
        .aligned(20.0)
        .write(&rig.path("robot"));
    let _simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let _gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let _estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let domain = rig.open();
    let mut torques = open::<TorqueEstimate>(&domain, "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());
    let stop = Arc::new(AtomicBool::new(false));
    // The F/T board sends 2,000 frames, the IMU 400, seven motor boards 3,500 a second.
    for (bus, own) in [("a", 2_400), ("b", 3_500)] {
        let (name, stop) = (rig.domain.name.clone(), Arc::clone(&stop));
        thread::spawn(move || fill(&name, bus, FULL - own, &stop));
    }

    let mut of_torques = Latencies {
        reader: torques,
        found: Default::default(),
    };
    let mut of_samples = Latencies::<Sample> {
        reader: open(&domain, "icub_left_arm"),
        found: Default::default(),
    };
    let (mut recorded, mut uncounted) = (0, 0);
    for number in 0..(seconds / round) as usize {
        let with_recorder = number % 2 == 1;
        let out = rig.path("run.mcap").display().to_string();
        let length = round.to_string();
        let mut recorder = with_recorder.then(|| {
            rig.start(&[
                "record",
                "--out",
                &out,
                "--force",
                "--frames",
                "virtual:a",
                "--frames",
                "virtual:b",
                "--seconds",
                &length,
            ])
        });
        let end = monotonic() + Nanos::from_seconds(round);
        while monotonic() < end {
            of_samples.reader.wait(end);
            of_torques.take(with_recorder);
            of_samples.take(with_recorder);
        }
        if let Some(recorder) = &mut recorder {
            recorder.wait();
            let output = recorder.output();
            println!("{}", output.trim());
            // The recorder's last line of frames: `N frames, M lost`.
            let lost = output
                .split(" frames, ")
                .nth(1)
                .and_then(|it| it.split(' ').next());
            let lost: u64 = lost.and_then(|it| it.parse().ok()).unwrap_or(0);
            let file = BufReader::new(File::open(&out).unwrap());
            let mut last = BTreeMap::<String, u64>::new();
            let mut missing = 0;
            frames(file, |bus, frame| {
                recorded += 1;
                if frame.id == FILLER {
                    let mut bytes = [0; 8];
                    bytes.copy_from_slice(frame.data());
                    let number = u64::from_le_bytes(bytes);
                    let before = last.insert(bus.to_owned(), number);
                    missing += before.map_or(0, |before| number - before - 1);
                }
                Ok(())
            })
            .unwrap();
            uncounted += missing.saturating_sub(lost);
        }
    }
    stop.store(true, Relaxed);
    of_samples.print("samples");
    of_torques.print("torques");
    println!("{recorded} frames recorded, {uncounted} lost without being counted");
    assert!(recorded > 0 && uncounted == 0);
}
