//! Identification on-line: torques, pushes, loads, saved states.

use super::*;

#[test]
fn on_line_the_torques_become_better_than_those_of_cad() {
    let sessions = arm();
    let after = |name: &str| {
        let (begin, _) = sessions.moving(name);
        nearer(&sessions, name, &sessions.log(name), |t| t > begin + 12.0)
    };
    let (each, all) = after("train");
    assert!(
        all > 5.0 && each.iter().all(|ratio| *ratio > 4.0),
        "{all} {each:?}"
    );
    // Moving from posture to posture, with pauses, gives less information in 12 s, and the CAD is
    // nearly right in one wrist joint by chance.
    let (each, all) = after("validate");
    assert!(
        all > 2.0 && each.iter().all(|ratio| *ratio > 0.7),
        "{all} {each:?}"
    );
}

/// Parameters identified within a log are assessed as they were in use: the CAD's at first, then
/// better ones. MuJoCo's torques are in the log as measured torques.
#[test]
fn a_run_that_learns_is_assessed_as_it_went() {
    let sessions = arm();
    let log = sessions.log("train");
    let assessed = |setup: Setup, log: &str| {
        let mut assessor = Assessor::new(&setup, log.as_bytes()).unwrap();
        estimate(setup, log.as_bytes(), std::io::sink(), Some(&mut assessor)).unwrap();
        assessor.finish()
    };
    let learnt = assessed(learning(&sessions), &log);
    println!("{learnt:?}");
    let ratio = |assessment: &Assessment| {
        let error = &assessment.predicted.relative_error;
        error.identified / error.cad
    };
    assert!((0.45..0.8).contains(&ratio(&learnt)), "{}", ratio(&learnt));
    assert!((3..20).contains(&learnt.changes), "{}", learnt.changes);
    let figure =
        |of: &[(String, Coverage)], name: &str| of.iter().find(|(own, _)| own == name).unwrap().1;
    let residual = figure(&learnt.residuals, "l_upper_arm");
    assert!(
        residual.covered > 0.97 && residual.count > 1300,
        "{residual:?}"
    );
    let elbow = figure(&learnt.torques, "l_elbow");
    assert!(
        elbow.covered > 0.9 && elbow.rms < 0.1 && elbow.count > 650,
        "{elbow:?}"
    );
    // The CAD alone has the CAD's error; its torques are not the robot's.
    let cad = assessed(sessions.setup(Urdf::Cad, Some("train")), &log);
    assert!((ratio(&cad) - 1.0).abs() < 1e-12 && cad.changes == 0);
    // With the true parameters, only noise remains.
    let exact = assessed(sessions.setup(Urdf::True, Some("train")), &log);
    let (elbow, of_cad) = (
        figure(&exact.torques, "l_elbow"),
        figure(&cad.torques, "l_elbow"),
    );
    assert!(
        elbow.covered > 0.9 && 5.0 * elbow.rms < of_cad.rms,
        "{elbow:?} {of_cad:?}"
    );
}

#[test]
fn what_is_stated_on_line_covers_the_errors_of_motion_too() {
    let sessions = arm();
    for name in ["train", "validate"] {
        let (begin, _) = sessions.moving(name);
        let learnt = scores(
            &sessions,
            name,
            &sessions.log(name),
            learning(&sessions),
            |t| t > begin + 12.0,
        );
        for joint in &sessions.distal {
            let Score {
                error,
                stated,
                covered,
                ..
            } = learnt[*joint];
            println!(
                "{name} {joint}: {error:.4} Nm, stated {stated:.4}, 95 % hold {:.0} %",
                100.0 * covered
            );
            assert!(
                covered > 0.85 && stated < 6.0 * error,
                "{name} {joint}: {covered} {stated} {error}"
            );
        }
    }
}

#[test]
fn pushes_do_no_harm_to_what_is_learnt_on_line_declared_or_not() {
    let sessions = arm();
    let log = sessions.log("contact");
    let last = sessions.pushes("contact").last().expect("a push").1;
    for log in [undeclared(&log), log] {
        let (each, all) = nearer(&sessions, "contact", &log, |t| t > last + 1.0);
        assert!(
            all > 3.0 && each.iter().all(|ratio| *ratio > 1.2),
            "{all} {each:?}"
        );
    }
}

/// MuJoCo pushes hand and forearm, undeclared: the pushes are detected in time and on the right
/// link, and no valid torque is wrong because of them. Nothing else is detected.
#[test]
fn pushes_that_nobody_declares_are_found_where_they_act() {
    for sessions in robots() {
        let (log, facts) = (
            sessions.log("pushed"),
            &sessions.facts["sessions"]["pushed"],
        );
        let mut config = sessions.config(Occurrence::Possible, Urdf::Cad, None);
        config.identification.enabled = true;
        let mut forearm = config.contact.last().unwrap().clone();
        (forearm.name, forearm.link) = (Some("forearm".into()), "l_forearm".into());
        for push in facts["pushes"].as_array().unwrap() {
            if push["link"] == "l_forearm" {
                forearm.position_m = numbers(&push["point"]).try_into().unwrap();
            }
        }
        config.contact.push(forearm);
        let setup = Setup::new(&config).unwrap();
        let contact = ["hand", "forearm"].map(|name| setup.robot.contact(name).unwrap());
        let names: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
        let truth = Table::new(&log);
        let stamps = truth.column("t");
        let (estimates, ..) = told(setup, &log, 0);
        // The contact detected at an instant, if any.
        let found = |e: &Estimate| {
            let detected = |place: usize| e.contacts.contacts()[contact[place]].detected == 1;
            let is_unexplained = e.contacts.residuals().iter().any(|r| r.unexplained == 1);
            [detected(0), detected(1), is_unexplained]
                .iter()
                .position(|is| *is)
        };
        let pushes: Vec<(f64, f64, usize, f64)> = (facts["pushes"].as_array().unwrap().iter())
            .map(|push| {
                let [from, to] = ["from", "to"].map(|when| push[when].as_f64().unwrap());
                let force = numbers(&push["force"])
                    .iter()
                    .map(|f| f * f)
                    .sum::<f64>()
                    .sqrt();
                (from, to, usize::from(push["link"] == "l_forearm"), force)
            })
            .collect();
        assert!(pushes.len() >= 4);
        let (mut errors, mut within, mut count) = (Vec::new(), 0, 0);
        for (from, to, link, force) in &pushes {
            let during: Vec<&Estimate> = (estimates.iter())
                .filter(|e| (from + 0.1..to - 0.1).contains(&e.t.seconds()))
                .collect();
            let share = |of: &dyn Fn(&Estimate) -> bool| {
                during.iter().filter(|e| of(e)).count() as f64 / during.len() as f64
            };
            let (seen, right) = (
                share(&|e| found(e).is_some()),
                share(&|e| found(e) == Some(*link)),
            );
            let first = estimates
                .iter()
                .find(|e| e.t.seconds() > *from && found(e).is_some());
            let delay = first.map_or(f64::INFINITY, |e| e.t.seconds() - from);
            for e in &during {
                // The truth is in separate rows, with the stamps of the first F/T sensor.
                let at = stamps.partition_point(|t| *t < e.t.seconds() - 1e-6);
                for joint in &sessions.distal {
                    let (number, tau) = (
                        names.iter().position(|name| name == joint).unwrap(),
                        truth.column(&format!("joint/{joint}/torque"))[at],
                    );
                    let torque = e.torques.joints()[number];
                    if torque.valid == 1 && !tau.is_nan() {
                        errors.push(torque.torque - tau);
                        within += usize::from(
                            (torque.torque - tau).abs() < 2.0 * torque.standard_deviation,
                        );
                        count += 1;
                    }
                }
            }
            println!(
                "{force:.0} N at link {link}: found {:.0} %, the right link {:.0} %, after {:.0} \
                 ms",
                100.0 * seen,
                100.0 * right,
                1e3 * delay
            );
            if *force > 4.0 {
                assert!(
                    seen > 0.97 && right > 0.9 && delay < 0.1,
                    "{force} {seen} {right} {delay}"
                );
            }
        }
        let error = rms(errors.into_iter());
        let covered = within as f64 / f64::from(count);
        println!(
            "torques beyond sensors, while pushed: RMS error {error:.4} Nm, {:.0} % within 2 sigma",
            100.0 * covered
        );
        assert!(
            count > 50 && error < 0.05 && covered > 0.9,
            "{count} {error} {covered}"
        );
        let quiet = |e: &&Estimate| {
            let t = e.t.seconds();
            t > facts["still_until"].as_f64().unwrap()
                && !pushes
                    .iter()
                    .any(|(from, to, ..)| t > *from && t < to + 0.3)
        };
        let false_alarms = estimates
            .iter()
            .filter(quiet)
            .filter(|e| found(e).is_some())
            .count();
        assert_eq!(false_alarms, 0);
    }
}

#[test]
fn when_a_job_is_done_changes_nothing_unless_it_is_late() {
    let sessions = arm();
    let log = sessions.log("validate");
    let (at_once, _, counts, _) = told(learning(&sessions), &log, 0);
    let (later, ..) = told(learning(&sessions), &log, 40);
    assert_eq!(counts.late, 0);
    assert_eq!(at_once.len(), later.len());
    // Equal bit for bit, including NaN.
    for (a, b) in at_once.iter().zip(&later) {
        assert_eq!(format!("{a:?}"), format!("{b:?}"));
    }
    // 50 estimates a second: a job that takes longer than a second is late and is reported.
    let (_, _, counts, _) = told(learning(&sessions), &log, 80);
    assert!(counts.late > 3, "{counts:?}");
}

#[test]
fn a_push_that_nobody_declares_is_suspected_at_once_and_a_declared_one_is_no_surprise() {
    let sessions = arm();
    let log = sessions.log("contact");
    let pushes = sessions.pushes("contact");
    for (log, expected) in [
        (undeclared(&log), Paused::Suspected),
        (log, Paused::Contact),
    ] {
        let (_, said, _, changes) = told(learning(&sessions), &log, 0);
        let pauses: Vec<f64> = said
            .iter()
            .filter(|(_, paused)| *paused == expected)
            .map(|(t, _)| *t)
            .collect();
        // One false detection of a push.
        let more = usize::from(expected == Paused::Suspected);
        assert!(
            (pushes.len()..=pushes.len() + more).contains(&pauses.len()),
            "{said:?}"
        );
        for (pause, (from, _)) in pauses.iter().zip(&pushes) {
            // An instant lies a quarter of a second behind, a block takes a tenth.
            assert!(pause - from > 0.0 && pause - from < 0.6, "{pause} {from}");
        }
        let surprised = said.iter().any(|(_, paused)| *paused == Paused::Suspected);
        assert_eq!(surprised, expected == Paused::Suspected, "{said:?}");
        // The robot's own parameters are not forgotten.
        assert!(!changes.contains(&DetectedChange::Load), "{changes:?}");
        assert!(changes.len() <= more, "{changes:?}");
    }
}

#[test]
fn a_load_that_is_picked_up_is_noticed_and_learnt() {
    let sessions = arm();
    let log = sessions.log("payload");
    let (estimates, said, counts, changes) = told(learning(&sessions), &log, 0);
    assert_eq!(changes, [DetectedChange::Load], "{said:?}");
    assert_eq!((counts.changes, counts.load_changes), (1, 1));
    let from = sessions.facts["sessions"]["payload"]["payload"]["from"]
        .as_f64()
        .unwrap();
    let suspected = said
        .iter()
        .find(|(_, paused)| *paused == Paused::Suspected)
        .unwrap()
        .0;
    assert!(suspected > from && suspected < from + 1.0, "{suspected}");
    // The last two seconds, compared with the estimates without the change.
    let truth = Table::new(&log);
    let rows = truth.rows_with("joint/l_elbow/torque");
    let names: Vec<String> = sessions
        .setup(Urdf::Cad, None)
        .robot
        .joint_names()
        .map(str::to_owned)
        .collect();
    for joint in &sessions.distal {
        let number = names.iter().position(|name| name == joint).unwrap();
        let error_of = |estimates: &[Estimate]| {
            rms(rows.iter().filter_map(|row| {
                let t = truth.column("t")[*row];
                let at = estimates
                    .iter()
                    .find(|e| (e.t.seconds() - t).abs() < 1e-6)?;
                let tau = truth.column(&format!("joint/{joint}/torque"))[*row];
                (t > 21.5 && t < 23.5).then(|| at.torques.joints()[number].torque - tau)
            }))
        };
        // The reference knows the arm exactly, and that nothing touches it.
        let mut exact = sessions.config(Occurrence::Possible, Urdf::True, Some("payload"));
        exact.contact.retain(|contact| contact.name() != "hand");
        // Such noise explains the load, so that no torque is withheld.
        exact.force_torque[0].noise_n = [1e3; 3];
        exact.force_torque[0].noise_nm = [1e3; 3];
        let exact = Setup::new(&exact).unwrap();
        let exact = scores(&sessions, "payload", &log, exact, |t| t > 20.0);
        let (error, without) = (error_of(&estimates), exact[*joint].error);
        println!("{joint}: {error:.4} Nm, without the load {without:.4}");
        // Two seconds after it is known what it is.
        assert!(error < without / 2.5, "{joint}: {error} {without}");
    }
}

#[test]
fn identification_begins_where_the_session_before_ended() {
    let sessions = arm();
    let mut setup = learning(&sessions);
    let mut pipeline = None;
    told_by(setup.clone(), &sessions.log("train"), 0, &mut pipeline);
    let pipeline = pipeline.unwrap();
    let known = &pipeline.identification().unwrap().solution().components[0];
    let mut parameters = Parameters::new(&setup.robot, Provenance::default());
    let inertias: Vec<_> = known
        .links
        .iter()
        .copied()
        .zip(known.bodies.iter().copied())
        .collect();
    let offset = Offset {
        sensor: "l_arm_ft_sensor".into(),
        reading: known.offsets[0],
        drift: Wrench::zero(),
        known: Nanos::ZERO,
        noise: Wrench::zero(),
        calibrated: None,
    };
    parameters
        .set_identified(&inertias, &[offset], &known.root)
        .unwrap();
    setup.apply(&parameters).unwrap();
    // From 4 s of motion on no contact since the start is possible any more. Without what was
    // known, the arm is hardly better than CAD then.
    let log = sessions.log("validate");
    let (begin, _) = sessions.moving("validate");
    let early = |t: f64| t > begin + 4.0 && t < begin + 8.0;
    let resumed = scores(&sessions, "validate", &log, setup, early);
    let cad = scores(
        &sessions,
        "validate",
        &log,
        sessions.setup(Urdf::Cad, Some("validate")),
        early,
    );
    let all = |scores: &BTreeMap<String, Score>| {
        rms(sessions.distal.iter().map(|joint| scores[*joint].error))
    };
    println!("{:.4} Nm, CAD {:.4}", all(&resumed), all(&cad));
    assert!(all(&resumed) < all(&cad) / 5.0);
}

#[test]
fn a_state_is_resumed_and_one_that_does_not_fit_is_refused() {
    let sessions = arm();
    let mut end = None;
    told_by(learning(&sessions), &sessions.log("train"), 0, &mut end);
    let mut taught = end.unwrap();
    // One more job, whose snapshot the state is of.
    let mut at = Nanos::from_seconds(28.0);
    let job = loop {
        if let Some(job) = taught.take_job() {
            break job;
        }
        at += Nanos::from_millis(20);
        assert!(at < Nanos::from_seconds(40.0));
        let trigger = taught.setup().robot.trigger;
        let reading = Reading::Wrench(proprio_topics::Wrench {
            force: [0.0; 3],
            torque: [0.0; 3],
        });
        taught.push(trigger, at, &reading, Quality::GOOD);
        while taught.poll().is_some() {}
    };
    let text = job.state();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("state");
    files::replace(&file, &text, 0o600).unwrap();
    assert_eq!(read(&file), text);

    let mut resumed = Pipeline::new(learning(&sessions));
    resumed.resume(&text).unwrap();
    // Without offsets, which a restart may change, but with the same bodies, apart from the
    // information in the offsets.
    let known =
        |pipeline: &Pipeline| pipeline.identification().unwrap().solution().components[0].clone();
    let (before, after) = (known(&taught), known(&resumed));
    for (a, b) in before.bodies.iter().zip(&after.bodies) {
        assert!(
            (a.mass - b.mass).abs() < 0.1 * a.mass.max(0.1),
            "{} {}",
            a.mass,
            b.mass
        );
    }
    // The state is useful from the beginning of the next session.
    let (begin, _) = sessions.moving("validate");
    let log = sessions.log("validate");
    let mut early = f64::NAN;
    let joint = "l_elbow";
    let truth = Table::new(&log);
    let resumed_estimates = {
        let mut end = Some(resumed);
        told_from(&log, 0, &mut end).0
    };
    let errors: Vec<f64> = truth
        .rows_with(&format!("joint/{joint}/torque"))
        .into_iter()
        .filter_map(|row| {
            let t = truth.column("t")[row];
            let at = resumed_estimates
                .iter()
                .find(|e| (e.t.seconds() - t).abs() < 1e-6)?;
            let is_early = t > begin + 4.0 && t < begin + 7.0;
            is_early.then(|| {
                at.torques.joints()[3].torque - truth.column(&format!("joint/{joint}/torque"))[row]
            })
        })
        .collect();
    if !errors.is_empty() {
        early = rms(errors.into_iter());
    }
    println!("{early:.4} Nm");
    assert!(early < 0.015, "{early}");

    let refused = |text: &str| {
        let mut pipeline = Pipeline::new(learning(&sessions));
        pipeline.resume(text).unwrap_err().to_string()
    };
    assert!(refused("").contains("damaged"));
    assert!(refused(&text[..text.len() / 2]).contains("damaged"));
    let at = text.find("row").unwrap() + 10;
    let other = if &text[at..=at] == "0" { "1" } else { "0" };
    assert!(
        refused(&format!("{}{other}{}", &text[..at], &text[at + 1..])).contains("wrong checksum")
    );
    assert!(refused(&text.replacen("state 3", "state 4", 1)).contains("schema 4"));
    let mut config = Config::load(&sessions.folder.join("estimator.toml")).unwrap();
    config.identification.enabled = true;
    config.contact.last_mut().unwrap().presence = Occurrence::Possible;
    config.robot = "another".into();
    let other = Pipeline::new(Setup::new(&config).unwrap())
        .resume(&text)
        .unwrap_err();
    assert!(other.to_string().contains("another robot"), "{other}");
    config.robot = "icub_left_arm".into();
    config.model.clone_from(&sessions.urdf);
    let other = Pipeline::new(Setup::new(&config).unwrap())
        .resume(&text)
        .unwrap_err();
    assert!(other.to_string().contains("another model"), "{other}");
    let aside = files::set_aside(&file).unwrap();
    assert!(aside.ends_with("state.bad-1") && aside.exists() && !file.exists());
}
