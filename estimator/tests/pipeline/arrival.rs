//! Samples in any order, late, missing, saturated or bad.

use super::*;

#[test]
fn a_log_without_stamps_keeps_its_order_and_its_estimates() {
    let log = golden("icub_left_arm_mujoco.csv");
    let blank: String = log
        .lines()
        .enumerate()
        .map(|(i, line)| {
            if i == 0 {
                format!("{line}\n")
            } else {
                format!(",{}\n", line.split_once(',').unwrap().1)
            }
        })
        .collect();
    let run = |text: &str| {
        let mut out = Vec::new();
        offline::estimate(setup(|_| {}), text.as_bytes(), &mut out, None).unwrap();
        table(std::str::from_utf8(&out).unwrap())
    };
    let (with, without) = (run(&log), run(&blank));
    assert_eq!(with["torque/l_elbow"], without["torque/l_elbow"]);
    assert!(without["t"].iter().all(String::is_empty));
}

#[test]
fn every_trigger_stamp_gives_one_estimate_in_order() {
    // Extrapolated values may be uncertain to any degree.
    let setup = setup(|config| config.output.max_torque_std_nm = Some(1000.0));
    let events = recording(&setup, 0.5);
    let stamps: Vec<Nanos> = events
        .iter()
        .filter(|e| e.0 == setup.robot.trigger)
        .map(|e| e.1)
        .collect();
    let (estimates, _) = run(setup, &events);
    assert_eq!(estimates.iter().map(|e| e.t).collect::<Vec<_>>(), stamps);
    // Once every channel has three samples, everything is valid.
    assert!(
        estimates
            .iter()
            .filter(|e| e.t > Nanos::from_millis(40))
            .all(|e| e.torques.joints().iter().all(|j| j.valid == 1))
    );
}

#[test]
fn the_order_of_arrival_does_not_matter_within_half_the_wait() {
    let base = setup(|_| {});
    let mut state = 12345_u64;
    let mut random = move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as i64
    };
    for trial in 0..12 {
        let phases: Vec<f64> = base
            .robot
            .channels
            .iter()
            .map(|_| (random() % 4_000_000) as f64 * 1e-9)
            .collect();
        let events = recording_with(&base, 0.25, |channel| phases[channel]);
        let (want, _) = run(base.clone(), &events);
        // Each channel arrives with its own delay and some jitter, below half the wait of 1 ms.
        let delays: Vec<i64> = base
            .robot
            .channels
            .iter()
            .map(|_| random() % 440_000)
            .collect();
        let mut arrivals: Vec<(i64, Event)> = events
            .iter()
            .map(|e| (e.1.0 + delays[e.0] + random() % 50_000, *e))
            .collect();
        arrivals.sort_by_key(|(at, e)| (*at, e.1));
        let shuffled: Vec<Event> = arrivals.into_iter().map(|(_, e)| e).collect();
        assert_ne!(
            shuffled.iter().map(|e| e.0).collect::<Vec<_>>(),
            events.iter().map(|e| e.0).collect::<Vec<_>>()
        );
        let (got, pipeline) = run(base.clone(), &shuffled);
        assert_eq!(
            pipeline.counts().late + pipeline.counts().backward,
            0,
            "trial {trial}"
        );
        assert_eq!(bits(&got), bits(&want), "trial {trial}");
    }
}

#[test]
fn a_stale_channel_withholds_only_what_depends_on_it() {
    let setup = setup(|_| {});
    let elbow = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let names: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
    let mut events = recording(&setup, 0.6);
    events.retain(|e| e.0 != elbow || e.1 < Nanos::from_millis(200));
    let (estimates, _) = run(setup, &events);
    let last = estimates.last().unwrap();
    for (name, joint) in names.iter().zip(last.torques.joints()) {
        // With an unknown wrench on the hand, a torque depends on the F/T sensor and on the links
        // between it and the joint. The elbow's angle affects the links beyond the elbow, which
        // only the wrist's torques need.
        let depends = name.starts_with("l_wrist");
        assert_eq!(joint.valid, u32::from(!depends), "{name}");
        assert_eq!(
            joint.reason,
            if depends { Reason::Stale } else { Reason::None },
            "{name}"
        );
        assert_eq!(
            (joint.torque.is_nan(), joint.standard_deviation.is_nan()),
            (depends, depends),
            "{name}: a withheld torque has no number"
        );
        if depends {
            assert_eq!(joint.cause, u32::try_from(elbow).unwrap());
        }
    }
}

#[test]
fn saturation_withholds_and_a_channel_without_samples_gives_nan() {
    let setup = setup(|_| {});
    let (ft, imu) = (
        setup
            .robot
            .channel(Kind::Wrench, "l_arm_ft_sensor")
            .unwrap(),
        setup.robot.channel(Kind::Imu, "chest_imu").unwrap(),
    );
    let mut events = recording(&setup, 0.3);
    for event in &mut events {
        if event.0 == ft && event.1 >= Nanos::from_millis(200) {
            event.3 = Quality::SATURATED | Quality::FROZEN;
        }
    }
    let (estimates, _) = run(setup.clone(), &events);
    let before = estimates
        .iter()
        .find(|e| e.t > Nanos::from_millis(150))
        .unwrap();
    assert!(before.torques.joints().iter().all(|j| j.valid == 1));
    assert!(
        estimates
            .last()
            .unwrap()
            .torques
            .joints()
            .iter()
            .all(|j| j.valid == 0 && j.reason == Reason::Saturated)
    );
    events.retain(|e| e.0 != imu);
    let (estimates, _) = run(setup, &events);
    assert!(!estimates.is_empty());
    for joint in estimates.iter().flat_map(|e| e.torques.joints()) {
        assert!(joint.torque.is_nan() && joint.reason == Reason::NeverSeen && joint.valid == 0);
    }
}

#[test]
fn bad_samples_are_counted_and_affect_nothing_else() {
    let setup = setup(|_| {});
    let events = recording(&setup, 0.3);
    let (want, clean) = run(setup.clone(), &events);
    assert_eq!(clean.counts().taken, events.len() as u64);
    let mut bad = vec![];
    let (mut backward, mut not_finite) = (0, 0);
    for (i, event) in events.iter().enumerate() {
        bad.push(*event);
        if i % 7 == 0 {
            // The same stamp again, with another value.
            let Reading::Joint(state) = event.2 else {
                continue;
            };
            bad.push((
                event.0,
                event.1,
                Reading::Joint(JointState {
                    position: 99.0,
                    ..state
                }),
                event.3,
            ));
            backward += 1;
        }
        if let (0, Reading::Wrench(wrench)) = (i % 5, event.2) {
            let force = [f64::NAN, wrench.force[1], wrench.force[2]];
            bad.push((
                event.0,
                event.1 + Nanos(1),
                Reading::Wrench(Wrench { force, ..wrench }),
                event.3,
            ));
            not_finite += 1;
        }
    }
    let (got, pipeline) = run(setup, &bad);
    assert!(backward > 10 && not_finite > 10);
    assert_eq!(
        (pipeline.counts().backward, pipeline.counts().not_finite),
        (backward, not_finite)
    );
    assert_eq!(bits(&got), bits(&want));
}

#[test]
fn a_channel_that_comes_too_late_is_dropped_and_counted() {
    let setup = setup(|_| {});
    let elbow = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let events = recording(&setup, 0.3);
    let arrives = |e: &Event| {
        if e.0 == elbow && e.1 > Nanos::from_millis(200) {
            e.1 + Nanos::from_millis(30)
        } else {
            e.1
        }
    };
    let mut late = events.clone();
    late.sort_by_key(|e| (arrives(e), e.0));
    let expected = events
        .iter()
        .filter(|e| e.0 == elbow && e.1 > Nanos::from_millis(200))
        .count();
    let triggers = events.iter().filter(|e| e.0 == setup.robot.trigger).count();
    let (estimates, pipeline) = run(setup, &late);
    // Samples of the last 30 ms may still be used by a waiting instant.
    assert!(
        (expected - 10..=expected).contains(&(pipeline.counts().late as usize)),
        "{:?} of {expected}",
        pipeline.counts()
    );
    assert_eq!(pipeline.counts().backward, 0);
    assert_eq!(estimates.len(), triggers);
}

#[test]
fn a_gap_of_everything_does_not_reach_back() {
    let base = setup(|_| {});
    let mut events = recording(&base, 0.6);
    events.retain(|e| e.1 < Nanos::from_millis(200) || e.1 > Nanos::from_millis(400));
    let (want, _) = run(base.clone(), &events);
    let last = want
        .iter()
        .rfind(|e| e.t < Nanos::from_millis(200))
        .unwrap();
    assert!(
        last.torques.joints().iter().all(|j| j.valid == 1),
        "the last instant before the gap: {:?}",
        last.torques.joints()
    );
    // After the gap, with each channel as the first.
    let after = events
        .iter()
        .position(|e| e.1 > Nanos::from_millis(400))
        .unwrap();
    for k in 1..6 {
        let mut other = events.clone();
        other[after..after + 9].rotate_left(k);
        other[after..after + 9].sort_by_key(|e| (e.1.0 - 400_000_000) / 300_000);
        let (got, pipeline) = run(base.clone(), &other);
        if pipeline.counts().backward + pipeline.counts().late == 0 {
            assert_eq!(bits(&got), bits(&want));
        }
    }
}

/// Drives report velocities with their positions, and a bit of one may be wrong.
#[test]
fn a_measured_velocity_that_cannot_be_true_is_as_if_not_measured() {
    let begin = setup(|_| {});
    // The joints and the sensor at the same instants: there a measured velocity is used as it is.
    let mut events = recording_with(&begin, 1.0, |_| 0.0);
    let joint = begin.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let mut last = None;
    for (channel, t, reading, _) in &mut events {
        if let (true, Reading::Joint(state)) = (*channel == joint, reading) {
            if let Some((then, before)) = last {
                state.velocity = (state.position - before) / (*t - then).seconds();
            }
            last = Some((*t, state.position));
        }
    }
    let (true_ones, _) = run(begin, &events);
    let mut own: Vec<&mut Reading> = (events.iter_mut())
        .filter(|event| event.0 == joint && event.1 > Nanos::from_millis(500))
        .map(|event| &mut event.2)
        .collect();
    for (number, wrong) in [(0, 60.0), (25, -60.0), (50, f64::MAX)] {
        let Reading::Joint(state) = &mut *own[number] else {
            panic!("a joint");
        };
        state.velocity = wrong;
    }
    let (estimates, pipeline) = run(setup(|_| {}), &events);
    assert_eq!(pipeline.counts().not_finite, 0);
    let joints = |all: &[Estimate]| -> Vec<JointTorque> {
        let each = all.iter().flat_map(|one| one.torques.joints());
        each.copied().collect()
    };
    let (true_ones, others) = (joints(&true_ones), joints(&estimates));
    assert_eq!(true_ones.len(), others.len());
    for (one, other) in true_ones.iter().zip(&others) {
        assert_eq!(one.valid, other.valid);
        let apart = (one.torque - other.torque).abs();
        assert!(one.valid == 0 || apart < 0.05, "{apart} Nm at {one:?}");
    }
    assert!(true_ones.iter().filter(|one| one.valid == 1).count() > 3000);
}
