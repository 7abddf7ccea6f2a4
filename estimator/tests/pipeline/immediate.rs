//! Estimates that do not wait for other channels.

use super::*;

/// What a wrench or an IMU that sends every 10 ms only costs an immediate estimate that the
/// encoders trigger: the RMS difference \[Nm\] to one that has a sample every millisecond, and the
/// share within two deviations; and the same if the last value is held instead. The signal moves by
/// many times its noise in 10 ms.
#[test]
fn what_an_immediate_estimate_extrapolates_is_better_than_the_last_value() {
    let trigger = |config: &mut Config| config.output.trigger = Some("l_elbow".into());
    let waiting = || {
        setup(|config| {
            trigger(config);
            config.output.max_wait_ms = Some(0.0);
            config.output.max_torque_std_nm = Some(1000.0);
        })
    };
    let base = waiting();
    let mut noise = noise_of(1);
    for kind in [Kind::Wrench, Kind::Imu] {
        let mut all = vec![];
        for (channel, t, reading, quality) in recording(&base, 1.0) {
            let phase = |t: Nanos| (2.0 * std::f64::consts::TAU * t.seconds()).sin();
            match reading {
                Reading::Wrench(mut w) => {
                    w.force = w.force.map(|f| f + 20.0 * phase(t) + 0.1 * noise());
                    all.push((channel, t, Reading::Wrench(w), quality));
                }
                Reading::Imu(imu) => {
                    // Ten samples in a period of the recording.
                    for t in (0..10).map(|i| t + Nanos::from_millis(i)) {
                        let acceleration = imu.proper_acceleration;
                        let proper_acceleration =
                            acceleration.map(|a| a + 5.0 * phase(t) + 0.01 * noise());
                        let reading = Reading::Imu(proprio_topics::Imu {
                            proper_acceleration,
                            ..imu
                        });
                        all.push((channel, t, reading, quality));
                    }
                }
                _ => all.push((channel, t, reading, quality)),
            }
        }
        all.sort_by_key(|e| (e.1, e.0));
        let mut number = 0;
        let sparse: Vec<Event> = all
            .iter()
            .filter(|e| {
                let is_kind = e.2.kind() == kind;
                number += usize::from(is_kind);
                !is_kind || number % 10 == 1
            })
            .copied()
            .collect();
        assert!(sparse.len() < all.len());
        let (dense, _) = run_immediate(trigger, &all);
        let (immediate, _) = run_immediate(trigger, &sparse);
        let (rms, within) = difference(&immediate, &dense);
        let (rms_held, _) = difference(&run(waiting(), &sparse).0, &run(waiting(), &all).0);
        println!("{kind:?}: {rms:.5} Nm ({within:.3} within), held {rms_held:.5} Nm");
        assert!(rms < 0.3 * rms_held, "{kind:?} {rms} {rms_held}");
        assert!(within > 0.95, "{kind:?} {within}");
        if kind == Kind::Imu {
            // Its extrapolation is far more certain than its mounting.
            continue;
        }
        // What extrapolation adds to the deviations is of the size of what it costs.
        let variance = |estimates: &[Estimate]| {
            let joints = |e: &Estimate| -> f64 {
                let joints = e.torques.joints().iter();
                joints.map(|j| j.standard_deviation.powi(2)).sum()
            };
            let after = estimates.iter().skip(100);
            let count = (estimates.len() - 100) * estimates[0].torques.joints().len();
            after.map(joints).sum::<f64>() / count as f64
        };
        let added = (variance(&immediate) - variance(&dense)).max(0.0).sqrt();
        println!("deviation added: {added:.5} Nm");
        assert!((0.5..4.0).contains(&(added / rms)), "{added} {rms}");
    }
}

#[test]
fn immediate_estimates_depend_on_the_order_of_arrival_alone() {
    let events = recording(&setup(|_| {}), 0.5);
    // Every channel but the trigger is late by up to three milliseconds.
    let trigger = setup(|_| {}).robot.trigger;
    let delay = |channel: usize| match channel == trigger {
        true => 0,
        false => 1_000_000 * (1 + channel as i64 % 3),
    };
    let mut arrivals: Vec<(i64, Event)> = events.iter().map(|e| (e.1.0 + delay(e.0), *e)).collect();
    arrivals.sort_by_key(|(at, e)| (*at, e.1));
    let arrived: Vec<Event> = arrivals.into_iter().map(|(_, e)| e).collect();
    let (first, pipeline) = run_immediate(|_| {}, &arrived);
    let counts = pipeline.counts();
    assert_eq!((counts.taken, counts.late), (events.len() as u64, 0));
    let (again, _) = run_immediate(|_| {}, &arrived);
    assert_eq!(bits(&first), bits(&again));
    let (in_order, _) = run_immediate(|_| {}, &events);
    assert_ne!(bits(&first), bits(&in_order));
    assert!(
        first
            .iter()
            .skip(100)
            .all(|e| e.torques.joints().iter().all(|j| j.valid == 1))
    );
}

/// The zero of an encoder changes by 0.1 rad: the estimates go over to those of the new zero
/// without taking the step for a motion.
#[test]
fn a_changed_zero_is_no_motion() {
    for max_wait_ms in [Some(1.0), None] {
        let setup = setup(|config| {
            config.output.max_wait_ms = max_wait_ms;
            config.output.max_torque_std_nm = Some(1000.0);
        });
        let elbow = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
        let step = Nanos::from_millis(500);
        let moved = |from: Nanos, flag: Quality| -> Vec<Event> {
            let mut is_first = true;
            let mut events = recording(&setup, 1.0);
            for (channel, t, reading, quality) in &mut events {
                if let Reading::Joint(joint) = reading
                    && *channel == elbow
                    && *t >= from
                {
                    joint.position += 0.1;
                    if std::mem::take(&mut is_first) {
                        *quality = flag;
                    }
                }
            }
            events
        };
        let valid = |j: &&JointTorque| j.valid == 1;
        let largest = |events: &[Event]| {
            let (estimates, _) = run(setup.clone(), events);
            let after = estimates.iter().filter(|e| e.t > Nanos::from_millis(400));
            after
                .flat_map(|e| e.torques.joints().iter().filter(valid))
                .map(|j| j.torque.abs())
                .fold(0.0, f64::max)
        };
        let never = largest(&moved(Nanos::MAX, Quality::GOOD));
        let always = largest(&moved(Nanos::ZERO, Quality::GOOD));
        let marked = largest(&moved(step, Quality::ZERO_CHANGED));
        let unmarked = largest(&moved(step, Quality::GOOD));
        let bound = 1.2 * never.max(always);
        assert!(marked < bound, "{max_wait_ms:?} {marked} {bound}");
        // Nor is a jump that nobody tells of.
        assert!(unmarked < bound, "{max_wait_ms:?} {unmarked} {bound}");
    }
}

#[test]
fn what_cannot_be_extrapolated_yet_is_not_valid() {
    let trigger = |config: &mut Config| config.output.trigger = Some("l_elbow".into());
    let sensor = setup(trigger)
        .robot
        .channel(Kind::Wrench, "l_arm_ft_sensor");
    let mut number = 0;
    let events: Vec<Event> = recording(&setup(trigger), 0.2)
        .into_iter()
        .filter(|e| {
            number += usize::from(Some(e.0) == sensor);
            Some(e.0) != sensor || number % 20 == 1
        })
        .collect();
    let readings: Vec<Nanos> = events
        .iter()
        .filter(|e| Some(e.0) == sensor)
        .map(|e| e.1)
        .collect();
    let (estimates, _) = run_immediate(trigger, &events);
    let mut seen = [0, 0];
    for e in estimates.iter().filter(|e| e.t > readings[1]) {
        let has_three = e.t >= readings[2];
        let reason = if has_three {
            Reason::None
        } else {
            Reason::Starting
        };
        assert_eq!(e.torques.joints()[0].reason.get(), Some(reason), "{}", e.t);
        seen[usize::from(has_three)] += 1;
    }
    assert!(seen[0] > 3 && seen[1] > 20, "{seen:?}");
}
