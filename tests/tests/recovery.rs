//! Gateway and estimator are killed (SIGKILL) at any instant, including start-up, and started
//! again. The chain recovers while the simulator and the other process keep running. On the virtual
//! bus; `vcan.rs` does the same on a kernel's bus.
//!
//! `PROPRIO_KILLS=1000 cargo test -p proprio-tests --test recovery -- --nocapture` uses more
//! instants. Start-up kills are drawn from the first `PROPRIO_STARTUP_MS` (default 15).
#![allow(missing_docs)]

use proprio_tests::watch::{Newest, open, valid_since};
use proprio_tests::{Arm, PATIENCE, Process, Rig, now, until};
use proprio_topics::ipc::Topic;
use proprio_topics::{EstimatorHealth, Nanos, Sample, TorqueEstimate};
use std::time::Duration;

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |v| {
        v.parse()
            .unwrap_or_else(|_| panic!("{name} = {v:?} must be a number"))
    })
}

fn sleep(random: &mut fastrand::Rng, most: Duration) {
    std::thread::sleep(most.mul_f64(random.f64()));
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
    // All services of both exist by then.
    health.fresh();
    let segments = rig.segments().len();

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
        let valid = valid_since(&mut torques, restarted, PATIENCE);
        let what = ["gateway", "estimator"][victim];
        assert!(
            valid.is_some(),
            "kill {kill} of the {what} (start-up: {at_startup}): no recovery"
        );
        times.push((now() - restarted, victim, at_startup));
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
    // A reader releases the files of dead writers when it reads.
    let settled = until(PATIENCE, || {
        health.get();
        let _ = valid_since(&mut torques, Nanos::MAX, Nanos::ZERO);
        (rig.segments().len() <= segments).then_some(())
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
    // The requirement is one second; on a machine that is busy with other tests the worst case may
    // take longer.
    assert!(at(0.5) < 1.0, "median {} s", at(0.5));
    assert!(at(1.0) < 5.0, "at worst {} s", at(1.0));

    drop((torques, health, domain));
    let [gateway, estimator] = &mut processes;
    [estimator, gateway, &mut simulator]
        .into_iter()
        .for_each(Process::end);
    rig.assert_nothing_left();
}

/// An estimator that stood still loses the samples that its buffer does not hold, and those that it
/// finds there are too old for their estimates: its health shows both.
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
    let after = health.wait("the loss", |h| h.lost > before.lost);
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
