//! Gateway and estimator are killed (SIGKILL) at any instant, including start-up, and started
//! again. The chain recovers while the simulator and the other process keep running. On the virtual
//! bus; `vcan.rs` does the same on a kernel's bus.
//!
//! What an estimator loses while it is stopped, or cannot use, is counted.
//!
//! `PROPRIO_KILLS=1000 cargo test -p proprio-tests --test recovery -- --nocapture` uses more
//! instants. Start-up kills are drawn from the first `PROPRIO_STARTUP_MS` (default 15).
#![allow(missing_docs)]

use proprio_tests::watch::{Newest, all_valid, open, valid_since};
use proprio_tests::{Arm, PATIENCE, Process, Rig, now, until};
use proprio_topics::ipc::{Reader, TakeError, Topic, Writer};
use proprio_topics::{
    Description, Entry, EstimatorHealth, Header, JointState, Kind, Name, Nanos, Publisher, Reading,
    Role, Sample, TorqueEstimate, Wrench,
};
use std::collections::BTreeMap;
use std::time::Duration;

/// A recovery that took longer is told in detail.
const SLOW: Nanos = Nanos::from_millis(1000);

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |v| {
        v.parse()
            .unwrap_or_else(|_| panic!("{name} = {v:?} must be a number"))
    })
}

/// The number of these files that are connections of a writer to a reader.
fn connections(files: &[String]) -> usize {
    let connections = files.iter().filter(|name| name.ends_with(".connection"));
    connections.count()
}

fn sleep(random: &mut fastrand::Rng, most: Duration) {
    std::thread::sleep(most.mul_f64(random.f64()));
}

/// Waits until every torque is valid again after `since`; returns whether it is, and what came
/// meanwhile, in words: how many estimates were withheld and why, and the longest time for which
/// this process itself was not scheduled.
fn recovery(torques: &mut Reader<TorqueEstimate>, since: Nanos) -> (bool, String) {
    let (mut withheld, mut paused, mut last) = (BTreeMap::new(), Nanos::ZERO, now());
    let recovered = until(PATIENCE, || {
        let turn = now();
        paused = paused.max(turn - std::mem::replace(&mut last, turn));
        // A writer that is killed as it connects is an error that ends with the next attempt.
        let mut next = || match torques.try_take() {
            Err(TakeError::Connection) => None,
            taken => taken.expect("shared memory can be read"),
        };
        while let Some(estimate) = next() {
            if estimate.header.acquired <= since {
                continue;
            }
            if all_valid(&estimate) {
                return Some(());
            }
            let invalid = estimate.joints().iter().find(|joint| joint.valid != 1);
            let why = invalid.map(|joint| format!("{:?}, channel {}", joint.reason, joint.cause));
            *withheld.entry(why.unwrap_or_default()).or_insert(0) += 1;
        }
        None
    });
    let story = format!("withheld: {withheld:?}; this process paused for {paused} s at most");
    (recovered.is_some(), story)
}

#[test]
fn the_chain_recovers_from_kills_at_any_instant() {
    let kills = setting("PROPRIO_KILLS", 200);
    let startup = Duration::from_millis(setting("PROPRIO_STARTUP_MS", 15));
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .write(&rig.path("robot"));
    let gateway_args = ["gateway", "--config", &arm.gateway];
    let estimator_args = ["estimator", "--config", &arm.estimator];
    let start = |number: usize| {
        rig.start(if number == 0 {
            &gateway_args
        } else {
            &estimator_args
        })
    };
    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let mut processes: [Process; 2] = [start(0), start(1)];

    let domain = rig.open();
    let mut torques = open::<TorqueEstimate>(&domain, "icub_left_arm");
    let mut health = Newest::<EstimatorHealth>::open(&domain, "icub_left_arm");
    assert!(
        valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some(),
        "the chain does not start"
    );
    let at_start = rig.settled_segments();
    let segments = at_start.len();

    let mut random = fastrand::Rng::with_seed(7);
    let mut times: Vec<(Nanos, usize, bool)> = Vec::new();
    for kill in 0..kills {
        let (victim, at_startup) = ((kill % 2) as usize, kill / 2 % 2 == 0);
        if at_startup {
            processes[victim].kill();
            processes[victim] = start(victim);
            sleep(&mut random, startup);
        } else {
            sleep(&mut random, Duration::from_millis(150));
        }
        processes[victim].kill();
        let restarted = now();
        processes[victim] = start(victim);
        let (recovered, story) = recovery(&mut torques, restarted);
        let (what, after) = (["gateway", "estimator"][victim], now() - restarted);
        let story = || {
            let [gateway, estimator] = processes.each_ref().map(Process::log);
            format!(
                "kill {kill} of the {what} (start-up: {at_startup}), {after} s: {story}\n\
                 gateway:\n{gateway}\nestimator:\n{estimator}"
            )
        };
        assert!(recovered, "no recovery: {}", story());
        if after > SLOW {
            println!("{}", story());
        }
        times.push((after, victim, at_startup));
        processes
            .iter_mut()
            .chain([&mut simulator])
            .for_each(Process::assert_runs);
        // The files of the dead process are removed, except those that a survivor has not released
        // yet.
        let left = rig.segments().len();
        assert!(
            left <= 2 * segments,
            "{left} segments after kill {kill} instead of {segments}"
        );
    }
    // A reader releases the files of dead writers when it reads; but the connection that a writer
    // made as it was killed may be left until the reader ends, one in thousands of kills.
    let settled = until(PATIENCE, || {
        health.get();
        let _ = valid_since(&mut torques, Nanos::MAX, Nanos::ZERO);
        let left = rig.segments();
        let leak = usize::from(connections(&left) == connections(&at_start) + 1);
        (left.len() <= segments + leak).then_some(())
    });
    assert!(
        settled.is_some(),
        "instead of {segments} segments: {:#?}",
        rig.segments()
    );
    let last = health.fresh();

    for (what, victim) in [("gateway", 0), ("estimator", 1)] {
        for (when, at_startup) in [("start-up", true), ("running", false)] {
            let some = times
                .iter()
                .filter(|(_, v, s)| (*v, *s) == (victim, at_startup));
            let mut ms: Vec<f64> = some.map(|(t, ..)| t.seconds() * 1e3).collect();
            ms.sort_by(f64::total_cmp);
            if let (Some(median), Some(most)) = (ms.get(ms.len() / 2), ms.last()) {
                println!(
                    "{what}, {when}: {} kills, recovered after {median:.0} ms (median), {most:.0} \
                     ms at most",
                    ms.len()
                );
            }
        }
    }
    let mut all: Vec<Nanos> = times.iter().map(|(t, ..)| *t).collect();
    all.sort();
    let at = |share: f64| all[((all.len() - 1) as f64 * share).round() as usize].seconds();
    println!(
        "{kills} kills: p50 {:.3} s, p99 {:.3} s, most {:.3} s; {last:?}",
        at(0.5),
        at(0.99),
        at(1.0)
    );
    // The requirement, kept on a machine that is busy with other tests too: sixteen processes that
    // compete for two processors leave half of it.
    assert!(at(1.0) < 1.0, "at worst {} s", at(1.0));

    drop((torques, health, domain));
    let [gateway, estimator] = &mut processes;
    [estimator, gateway, &mut simulator]
        .into_iter()
        .for_each(Process::end);
    rig.assert_nothing_left();
}

/// A stopped estimator loses the samples that its buffers do not hold. Its health counts them.
#[test]
fn samples_lost_while_the_estimator_is_stopped_are_counted() {
    use nix::sys::signal::{Signal, kill};
    let rig = Rig::new();
    let arm = Arm::new().on_virtual(["a", "b"]).write(&rig.path("robot"));
    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let domain = rig.open();
    let mut samples = open::<Sample>(&domain, "icub_left_arm");
    let mut torques = open::<TorqueEstimate>(&domain, "icub_left_arm");
    let mut health = Newest::<EstimatorHealth>::open(&domain, "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());
    let before = health.fresh();
    let process = nix::unistd::Pid::from_raw(i32::try_from(estimator.id()).expect("an id"));
    kill(process, Signal::SIGSTOP).expect("it runs");
    // Two buses, so two writers, each with a buffer of its own for the reader.
    let held = 2 * Sample::QUALITY.buffer as u64;
    let (from, mut sent) = (samples.taken(), 0);
    let published = until(PATIENCE, || {
        while samples
            .try_take()
            .expect("shared memory can be read")
            .is_some()
        {}
        sent = samples.taken() - from;
        (sent >= 2 * held).then_some(())
    });
    kill(process, Signal::SIGCONT).expect("it is there");
    assert!(published.is_some(), "{sent} samples");
    // The estimator counts while it catches up.
    let mut last = 0;
    let after = health.wait("the loss", |h| {
        h.lost > before.lost && std::mem::replace(&mut last, h.lost) == h.lost
    });
    // What the buffers held was not lost. The readers do not stop and start at the same instant.
    let (lost, tolerance) = (after.lost - before.lost, 1000);
    assert!(
        lost + held + tolerance > sent && lost + held < sent + tolerance,
        "{lost} of {sent}"
    );
    [&mut estimator, &mut gateway, &mut simulator]
        .into_iter()
        .for_each(Process::end);
}

/// The test plays the gateway: a sample that comes after its estimate, a stamp that is repeated,
/// and a number that is not finite. Health counts each by its kind.
#[test]
fn samples_that_can_not_be_used_are_counted_by_kind() {
    let rig = Rig::new();
    let arm = Arm::new().aligned(1.0).on_virtual(["a", "b"]);
    let arm = arm.write(&rig.path("robot"));
    let domain = rig.open();
    let robot = "icub_left_arm";
    let channels = [("l_arm_ft_sensor", Kind::Wrench), ("l_elbow", Kind::Joint)];
    let entries = channels.iter().zip(0..).map(|((name, kind), index)| Entry {
        name: Name::new(name).expect("short"),
        kind: kind.in_memory(),
        role: Role::Channel.in_memory(),
        index,
        ..Entry::NONE
    });
    let description = Description::new(Publisher::Gateway, entries);
    let mut names = Writer::create(&domain, robot, domain.epoch()).expect("no gateway");
    let mut samples = Writer::<Sample>::create(&domain, robot, domain.epoch()).expect("no gateway");
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let mut health = Newest::<EstimatorHealth>::open(&domain, robot);
    let mut torques = open::<TorqueEstimate>(&domain, robot);
    let start = now();
    let mut send = |channel: u32, step: i64, reading: Reading| {
        let header = Header {
            acquired: start + Nanos::from_millis(10 * step),
            ..Header::default()
        };
        let sample = Sample::new(header, channel, &reading);
        samples.send(&sample, now()).expect("sent");
    };
    let wrench = |fx: f64| {
        Reading::Wrench(Wrench {
            force: [fx, 0.0, 0.0],
            torque: [0.0; 3],
        })
    };
    let elbow = Reading::Joint(JointState {
        position: 0.5,
        velocity: 0.0,
        acceleration: 0.0,
        torque: f64::NAN,
        current: f64::NAN,
    });
    // Until the estimator listens.
    let mut first = 0;
    until(PATIENCE, || {
        names.send(&description, now()).expect("sent");
        first += 1;
        send(0, first, wrench(1.0));
        health.get().is_some_and(|h| h.samples > 0).then_some(())
    })
    .expect("the estimator receives samples");
    let before = health.fresh().samples;
    for step in first + 1..=first + 100 {
        send(0, step, wrench(1.0));
        if step <= first + 50 {
            send(1, step, elbow);
        }
    }
    let none = health.wait("the samples", |h| h.samples >= before + 150);
    assert_eq!(
        (none.late, none.backward, none.not_finite),
        (0, 0, 0),
        "{none:?}"
    );
    until(PATIENCE, || {
        let estimate = torques.latest().expect("shared memory can be read")?;
        (estimate.header.acquired > start + Nanos::from_millis(10 * (first + 70))).then_some(())
    })
    .expect("estimates");
    send(1, first + 60, elbow);
    send(0, first + 200, wrench(1.0));
    send(0, first + 200, wrench(1.0));
    send(0, first + 300, wrench(f64::NAN));
    let counted = health.wait("the rest", |h| h.samples >= before + 154);
    assert_eq!(
        (counted.late, counted.backward, counted.not_finite),
        (1, 1, 1),
        "{counted:?}"
    );
    estimator.end();
}
