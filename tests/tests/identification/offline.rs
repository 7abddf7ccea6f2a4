//! Identification off-line: from swings, beside pushes, with payloads.

use super::*;

#[test]
fn a_swing_is_enough_to_identify_what_a_sensor_carries() {
    for sessions in robots() {
        let (train, validate) = (sessions.log("train"), sessions.log("validate"));
        let logs = [
            ("train.csv", &*train, LogRole::Train),
            ("validate.csv", &*validate, LogRole::Validate),
        ];
        let outcome = identified(&sessions, &logs);
        must_be_good("train", &sessions, &outcome);
        // Compared as text, because missing values are NaN, which is not equal to itself.
        let again = identified(&sessions, &logs);
        assert!(
            format!("{outcome:?}") == format!("{again:?}"),
            "the same logs give the same outcome"
        );

        assert_eq!(
            outcome.logs.iter().map(|log| log.role).collect::<Vec<_>>(),
            [LogRole::Train, LogRole::Validate]
        );
        let (mut offsets, mut far) = (0, Vec::new());
        for (log, name) in outcome.logs.iter().zip(["train", "validate"]) {
            // The log's true torques are only compared, not used for identification.
            for joint in log
                .joints
                .iter()
                .filter(|joint| sessions.distal.contains(&joint.name.as_str()))
            {
                assert!(
                    joint.rms_nm.identified < joint.rms_nm.cad,
                    "{name}: {joint:?}"
                );
            }
            assert!(
                log.predicted.relative_error.identified < log.predicted.relative_error.cad,
                "{name}: {:?}",
                log.predicted
            );
            assert!(
                log.findings
                    .iter()
                    .all(|finding| finding.severity == Severity::Note),
                "{name}: {:?}",
                log.findings
            );
            // It moves 5 s, or 1 s, after its beginning, slowly at first.
            let onset = log.onset.expect("it stands still first").0 as f64 * 1e-9;
            let (moves, _) = sessions.moving(name);
            assert!(
                onset > moves - 0.1 && onset < moves + 1.0,
                "{name}: onset at {onset} s"
            );
            for offset in &log.offsets {
                let truth = &sessions.facts["sessions"][name]["offsets"][offset.sensor.as_str()];
                for (channel, (found, truth)) in
                    offset.end.iter().zip(numbers(&truth["end"])).enumerate()
                {
                    offsets += 1;
                    if (found - truth).abs() > 4.0 * offset.deviation[channel] {
                        let (sensor, axis) = (&offset.sensor, WRENCH[channel]);
                        far.push(format!("{name} {sensor} {axis}: {found}, not {truth}"));
                    }
                }
            }
        }
        let most = if sessions.stands { offsets / 10 } else { 0 };
        assert!(far.len() <= most, "{far:?}");
        let validated = &outcome.logs[1];
        for sensor in &validated.sensors {
            for (part, (own, cad)) in WRENCH
                .iter()
                .zip(sensor.rms.identified.iter().zip(sensor.rms.cad_fitted))
            {
                assert!(
                    *own <= 1.05 * cad,
                    "{} {part}: {own}, CAD {cad}",
                    sensor.name
                );
            }
        }
        // Unseen links stay as they were.
        for link in outcome.links.iter().filter(|link| !link.seen) {
            assert_eq!(link.identified, link.cad, "{}", link.name);
        }
    }
}

#[test]
fn declared_pushes_do_no_harm() {
    for sessions in robots() {
        let outcome = identified(
            &sessions,
            &[("contact.csv", &sessions.log("contact"), LogRole::Train)],
        );
        must_be_good("pushes, declared", &sessions, &outcome);
        let left_out = &outcome.logs[0].excluded;
        // Most of every push is excluded.
        let pushed: f64 = sessions
            .pushes("contact")
            .iter()
            .map(|(from, to)| to - from)
            .sum();
        let (begin, end) = outcome.logs[0].span;
        let rate = outcome.logs[0].used as f64 / ((end.0 - begin.0) as f64 * 1e-9 - pushed);
        let noticed: u64 = left_out
            .iter()
            .filter(|out| out.reason.contains("contact"))
            .map(|out| out.instants)
            .sum();
        assert!(noticed as f64 > 0.5 * pushed * rate, "{left_out:?}");
    }
}

#[test]
fn undeclared_pushes_do_no_harm() {
    for sessions in robots() {
        let log = undeclared(&sessions.log("contact"));
        let outcome = identified(&sessions, &[("contact.csv", &log, LogRole::Train)]);
        println!("{:?} {:?}", suspicions(&outcome), outcome.logs[0].excluded);
        must_be_good("pushes, undeclared", &sessions, &outcome);
        let said = suspicions(&outcome);
        assert!(
            said.len() == 1 && said[0].0 == FindingCode::Disturbance,
            "{said:?}"
        );
        // Every push is excluded, except its soft beginning and end, and little else.
        let pushed: f64 = sessions
            .pushes("contact")
            .iter()
            .map(|(from, to)| to - from)
            .sum();
        let (begin, end) = outcome.logs[0].span;
        let seconds = (end - begin).seconds();
        let left_out = &outcome.logs[0].excluded;
        let suspected = left_out
            .iter()
            .find(|out| out.reason.contains("suspected"))
            .expect("a reason");
        let share = suspected.instants as f64 / outcome.logs[0].used as f64;
        assert!(
            share * seconds > pushed - 0.8,
            "{share} of {seconds} s, pushed for {pushed} s"
        );
        // Two blocks of 0.1 s before and after each push are excluded too, and the blocks in which
        // it begins and ends.
        let beside = 0.6 * sessions.pushes("contact").len() as f64;
        assert!(
            share * seconds < pushed + beside,
            "{share} of {seconds} s, pushed for {pushed} s"
        );
    }
}

/// Undeclared pushes, in a training or a validation log, are reported as such; the sensor that
/// measured them is not reported as wrong.
#[test]
fn undeclared_pushes_are_no_fault_of_the_sensor() {
    let sessions = arm();
    let (train, pushed) = (sessions.log("train"), undeclared(&sessions.log("contact")));
    for logs in [
        vec![("contact.csv", &*pushed, LogRole::Train)],
        vec![
            ("train.csv", &*train, LogRole::Train),
            ("contact.csv", &*pushed, LogRole::Validate),
        ],
    ] {
        let outcome = identified(&sessions, &logs);
        let touched = outcome.logs.last().expect("a log");
        let said = |code: FindingCode| {
            touched
                .findings
                .iter()
                .filter(|finding| finding.code == code)
                .count()
        };
        let (role, findings) = (touched.role, &touched.findings);
        assert_eq!(said(FindingCode::Disturbance), 1, "{role:?}: {findings:?}");
        assert_eq!(said(FindingCode::Unexplained), 0, "{role:?}: {findings:?}");
    }
}

#[test]
fn a_payload_is_identified() {
    for sessions in robots() {
        let (train, log) = (sessions.log("train"), sessions.log("payload"));
        let facts = &sessions.facts["sessions"]["payload"]["payload"];
        let [from, all_from] = ["from", "all_from"].map(|when| facts[when].as_f64().unwrap());

        // The later part: another robot, with 0.5 kg more beyond the sensor.
        let after = part(&log, all_from, f64::INFINITY);
        let outcome = identified(&sessions, &[("after.csv", &after, LogRole::Train)]);
        let truth = sessions.setup(Urdf::True, None).robot.model;
        let beyond = [
            "l_upper_arm",
            "l_elbow_1",
            "l_forearm",
            "l_wrist_1",
            "l_hand",
        ];
        let links: BTreeSet<usize> = beyond
            .iter()
            .map(|name| truth.frame(name).unwrap().link)
            .collect();
        let right: f64 = links.iter().map(|link| truth.inertias()[*link].mass).sum();
        let found: f64 = links
            .iter()
            .map(|link| outcome.links[*link].identified.mass)
            .sum();
        println!("beyond the sensor: {found:.3} kg, without payload {right:.3}");
        assert!(
            (found - right - 0.5).abs() < 0.05,
            "{found} kg, without payload {right}"
        );
        // A second after it is there, the parameters that include it are confirmed.
        let settled = |t: f64| t > all_from + 1.5;
        let run = |setup| scores(&sessions, "payload", &log, setup, settled);
        let (cad, own) = (
            run(sessions.setup(Urdf::Cad, Some("payload"))),
            run(with(sessions.setup(Urdf::Cad, Some("payload")), &outcome)),
        );
        for joint in ["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"] {
            assert!(
                own[joint].error < cad[joint].error / sessions.cad_further.min(5.0),
                "{joint}: {}, CAD {}",
                own[joint].error,
                cad[joint].error
            );
        }

        let before = identified(
            &sessions,
            &[
                ("train.csv", &train, LogRole::Train),
                ("before.csv", &part(&log, 0.0, from), LogRole::Train),
            ],
        );
        must_be_good("before the payload", &sessions, &before);
    }
}

#[test]
fn a_payload_picked_up_within_a_log_is_noticed_and_told() {
    for sessions in robots() {
        let (train, log) = (sessions.log("train"), sessions.log("payload"));
        let facts = &sessions.facts["sessions"]["payload"]["payload"];
        let [from, all_from, mass] =
            ["from", "all_from", "mass"].map(|what| facts[what].as_f64().unwrap());
        let centre = numbers(&facts["centre"]);
        let alone: &[(&str, &str, LogRole)] = &[("payload.csv", &log, LogRole::Train)];
        let both: &[(&str, &str, LogRole)] = &[
            ("train.csv", &train, LogRole::Train),
            ("payload.csv", &log, LogRole::Train),
        ];
        for logs in [alone, both] {
            let outcome = identified(&sessions, logs);
            must_be_good("payload, undeclared", &sessions, &outcome);
            let said = suspicions(&outcome);
            println!("{said:?}");
            assert_eq!(said.len(), 1, "{said:?}");
            // Half a log with a load may be taken for another disturbance: it is left out, too.
            let (code, text) = &said[0];
            assert!(
                [FindingCode::LoadChanged, FindingCode::Disturbance].contains(code)
                    && (*code == FindingCode::LoadChanged || text.contains("load")),
                "{said:?}"
            );
            let left_out = &outcome.logs.last().expect("a log").excluded;
            let load = left_out
                .iter()
                .filter(|out| {
                    out.reason == "another load: l_hand" || out.reason.contains("suspected")
                })
                .max_by_key(|out| out.instants)
                .expect("a reason");
            let (first, last) = (load.first.seconds(), load.last.seconds());
            assert!(
                first > from - 0.5 && first < all_from && last > 23.0,
                "{load:?}"
            );
            if *code == FindingCode::Disturbance {
                continue;
            }
            // `... +0.501 +- 0.001 kg, first moment -0.0008, +0.0027, +0.0296 +- ...`
            let (before, after) = said[0].1.split_once(" kg, first moment ").expect("a body");
            let parsed = |text: &str| {
                text.trim()
                    .parse::<f64>()
                    .unwrap_or_else(|e| panic!("{text}: {e}"))
            };
            let found = parsed(
                before
                    .split(": ")
                    .last()
                    .unwrap()
                    .split(" +- ")
                    .next()
                    .unwrap(),
            );
            assert!((found - mass).abs() < 0.01, "{found} kg, not {mass}");
            for (part, centre) in after.split(" +- ").next().unwrap().split(", ").zip(&centre) {
                assert!(
                    (parsed(part) - mass * centre).abs() < 0.001,
                    "{part} kg m of {centre} m"
                );
            }
        }
    }
}
