//! Offsets on-line, contacts beside them, and what is published.

use super::*;

#[test]
fn an_offset_that_wanders_is_followed_and_known_to_wander() {
    let sessions = arm();
    let log = sessions.log("train");
    let noise = NOISE;
    // One channel drifts by one to three times its noise in a second; the others hardly drift, as
    // in the session.
    for (axis, rate) in [(0, 1.0), (2, 3.0)] {
        let steps: Vec<f64> = {
            let mut random = fastrand::Rng::with_seed(axis as u64 + 1);
            // A sum of twelve uniform numbers is nearly normal.
            let mut normal = || (0..12).map(|_| random.f64()).sum::<f64>() - 6.0;
            let mut at = 0.0;
            (0..3000)
                .map(|_| {
                    at += rate * noise[axis] * 0.1 * normal();
                    at
                })
                .collect()
        };
        let wander = |t: f64| {
            let (k, part) = ((t * 100.0) as usize, (t * 100.0).fract());
            steps[k] + part * (steps[k + 1] - steps[k])
        };
        let alter = |t: f64, name: &str, reading: &mut Reading, _: &mut Quality| {
            if let (Reading::Wrench(wrench), "l_arm_ft_sensor") = (reading, name) {
                wrench.force[axis] += wander(t);
            }
            true
        };
        let mut end = None;
        let (told, counts) = inertias_by(learning(&sessions), &log, alter, &mut end);
        let pipeline = end.expect("the pipeline");
        let drift = pipeline.identification().unwrap().solution().components[0].drift_std[0];
        // [torque; force]
        let found: Vec<f64> = (0..6).map(|i| drift[(i + 3) % 6] / noise[i]).collect();
        println!("{found:.3?} {counts:?}");
        assert!(
            found[axis] > 0.3 * rate && found[axis] < 3.0 * rate,
            "{found:?}"
        );
        // Half a minute shows that the others drift less.
        assert!(
            (0..6).all(|i| i == axis || found[i] < 0.7 * found[axis]),
            "{found:?}"
        );
        assert_eq!(counts.changes, 0);
        // The change is at the reported place.
        let (_, last) = told.last().unwrap();
        let offset = last.offsets()[0];
        let there = &sessions.facts["sessions"]["train"]["offsets"]["l_arm_ft_sensor"]["end"];
        let expected = numbers(there)[axis] + wander(last.header.acquired.seconds());
        let apart = (offset.force[axis] - expected).abs();
        println!(
            "{} +- {}, not {expected}",
            offset.force[axis], offset.standard_deviation[axis]
        );
        assert!(
            apart < 4.0 * offset.standard_deviation[axis].max(noise[axis] * rate * 0.5),
            "{apart}"
        );
    }
}

/// A sensor that slips or is hit reads another offset from then on. That is found, and the new
/// offset is identified within its stated uncertainty.
#[test]
fn an_offset_jump_is_found_and_the_new_offset_identified() {
    let sessions = arm();
    let jump = [6.0, -4.0, 9.0];
    let from = 12.0;
    let alter = |t: f64, name: &str, reading: &mut Reading, _: &mut Quality| {
        if let (Reading::Wrench(wrench), "l_arm_ft_sensor", true) = (reading, name, t >= from) {
            wrench
                .force
                .iter_mut()
                .zip(jump)
                .for_each(|(x, by)| *x += by);
        }
        true
    };
    let (published, counts) = inertias(learning(&sessions), &sessions.log("train"), alter);
    println!("{counts:?}");
    assert_eq!((counts.offset_changes, counts.load_changes), (1, 0));
    let (_, last) = published.last().unwrap();
    let offset = last.offsets()[0];
    let there = &sessions.facts["sessions"]["train"]["offsets"]["l_arm_ft_sensor"]["end"];
    for (axis, (before, by)) in numbers(there).into_iter().zip(jump).enumerate() {
        let (found, std) = (offset.force[axis], offset.standard_deviation[axis]);
        println!("{axis}: {found:.3} +- {std:.3} N, {:.3} N", before + by);
        // Of the five seconds that are left after it is taken for a jump.
        assert!(std < 0.8, "{axis}: {std}");
        assert!((found - before - by).abs() < 4.0 * std.max(NOISE[axis]));
    }
}

/// During a declared contact nothing shows what offsets do, so they are taken to stay: their
/// standard deviation would grow without limit otherwise, and a long push would cost them.
#[test]
fn offsets_do_not_drift_during_a_declared_contact() {
    let sessions = arm();
    let (from, mut end) = (20.0, None);
    // A sensor that drifts, so that ten seconds of its drift would be seen.
    let steps = {
        let mut random = fastrand::Rng::with_seed(3);
        let mut at = 0.0;
        (0..3001).map(move |_| {
            at += 0.3 * NOISE[2] * (random.f64() + random.f64() + random.f64() - 1.5) * 2.0;
            at
        })
    };
    let steps: Vec<f64> = steps.collect();
    let alter = |t: f64, name: &str, reading: &mut Reading, _: &mut Quality| {
        if let (Reading::Wrench(wrench), "l_arm_ft_sensor") = (reading, name) {
            wrench.force[2] += steps[(t.clamp(0.0, 30.0) * 100.0) as usize];
        }
        true
    };
    let log = declared(&sessions.log("train"), from, f64::INFINITY);
    let (published, counts) = inertias_by(learning(&sessions), &log, alter, &mut end);
    let drift = end.unwrap().identification().unwrap().solution().components[0].drift_std[0][5];
    let after: Vec<f64> = published
        .iter()
        .filter(|(t, _)| t.seconds() > from + 3.0)
        .map(|(_, inertia)| inertia.offsets()[0].standard_deviation[2])
        .collect();
    println!("{counts:?}, drift {drift:.3} N/s^0.5, {after:.4?} N");
    let (first, last) = (after[0], *after.last().unwrap());
    assert!(after.len() >= 4);
    let seconds = (after.len() - 1) as f64;
    // With drift it would be this at the least.
    let drifted = (first * first + drift * drift * seconds).sqrt();
    assert!(drifted > 1.5 * first, "the test sees nothing: {drift}");
    assert!((last / first - 1.0).abs() < 0.05, "{after:?}");
}

/// A declaration may come a little late and end a little early: the blocks beside it are not used
/// either.
#[test]
fn blocks_beside_a_declared_contact_are_not_used() {
    let sessions = arm();
    let log = declared(&sessions.log("train"), 15.0, 15.05);
    let (_, counts) = inertias(learning(&sessions), &log, |_, _, _, _| true);
    let (_, without) = inertias(learning(&sessions), &sessions.log("train"), |_, _, _, _| {
        true
    });
    // The contact itself is a twentieth of a second, of 28 s of observations.
    let itself = 0.05 * without.learnt as f64 / 28.0;
    println!("{counts:?}, {itself} during the contact");
    assert_eq!(without.contact, 0);
    // Two blocks of 0.1 s before it, at the most, and a part of a block after it.
    let more = counts.contact as f64 - itself;
    assert!(more > itself && more < 7.0 * itself, "{more}");
}

#[test]
fn why_instants_are_left_out_is_counted() {
    let sessions = arm();
    let log = sessions.log("train");
    let run = |alter: &dyn Fn(f64, &str, &mut Reading, &mut Quality) -> bool| {
        inertias(learning(&sessions), &log, alter).1
    };
    let untouched = run(&|_, _, _, _| true);
    let lost = |c: &ObservationCounts| {
        [
            c.contact,
            c.outlier,
            c.suspected,
            c.saturated,
            c.device_fault,
        ]
    };
    println!("{untouched:?}");
    assert_eq!(lost(&untouched), [0; 5]);
    // The last instants have no later samples.
    assert!(untouched.stale < 20, "{untouched:?}");
    // The robot stands for 5 of 28 s; the rest are moments between swings.
    let instants = untouched.learnt as f64 / 28.0;
    assert!(untouched.still as f64 > 4.0 * instants && (untouched.still as f64) < 12.0 * instants);
    let during = |t: f64, from: f64, to: f64| (from..to).contains(&t);
    let sensor = "l_arm_ft_sensor";
    let counts = run(&|t, name, reading, quality| {
        if name == sensor && during(t, 10.0, 10.5) {
            *quality |= Quality::SATURATED;
        }
        if name == sensor && during(t, 12.0, 12.5) {
            *quality |= Quality::DEVICE_FAULT;
        }
        // A cable that jerks and returns to its state; a push that lasts.
        if let (Reading::Wrench(wrench), true) = (reading, name == sensor) {
            if during(t, 16.0, 16.03) {
                wrench.force[0] += 20.0;
            }
            if during(t, 20.0, 21.0) {
                wrench.force[1] += 20.0;
            }
        }
        !(name == "l_elbow" && during(t, 14.0, 14.6))
    });
    println!("{counts:?}");
    let seconds = |count: u64| count as f64 / instants;
    assert_eq!(counts.contact, 0);
    assert!(
        (0.4..1.1).contains(&seconds(counts.saturated)),
        "{}",
        seconds(counts.saturated)
    );
    assert!(
        (0.4..1.1).contains(&seconds(counts.device_fault)),
        "{}",
        seconds(counts.device_fault)
    );
    let stale = seconds(counts.stale - untouched.stale);
    assert!((0.3..1.2).contains(&stale), "{stale}");
    assert!(
        (0.05..1.5).contains(&seconds(counts.outlier)),
        "{}",
        seconds(counts.outlier)
    );
    assert!(
        (0.7..2.0).contains(&seconds(counts.suspected)),
        "{}",
        seconds(counts.suspected)
    );
    assert_eq!(
        (counts.changes, counts.offset_changes, counts.load_changes),
        (0, 0, 0)
    );
}

#[test]
fn what_is_identified_is_told_once_a_second_with_what_it_rests_on() {
    let sessions = arm();
    let (begin, end) = sessions.moving("train");
    let (told, _) = inertias(learning(&sessions), &sessions.log("train"), |_, _, _, _| {
        true
    });
    assert!(told.len() as f64 > end - 3.0, "{} in {end} s", told.len());
    let setup = learning(&sessions);
    let truth = sessions.setup(Urdf::True, None);
    let (mut errors, mut motion) = (Vec::new(), 0.0);
    for (at, inertia) in &told {
        let data = inertia.header.acquired;
        assert!((0.9..1.5).contains(&(*at - data).seconds()), "{at} {data}");
        assert_eq!((inertia.links().len(), inertia.offsets().len()), (5, 1));
        assert_eq!(inertia.offsets()[0].name.as_str(), "l_arm_ft_sensor");
        let mut square = 0.0;
        for link in inertia.links() {
            assert_eq!((link.accepted, link.group), (1, 0));
            assert!(
                link.standard_deviation
                    .iter()
                    .all(|x| x.is_finite() && *x > 0.0)
            );
            // To find itself at a posture, at first, is a motion of a block.
            let most = (data.seconds() - begin).max(0.0) + 0.5;
            assert!(
                link.motion >= motion && link.motion <= most,
                "{} {most}",
                link.motion
            );
            let number = (0..setup.robot.model.link_count())
                .find(|n| setup.robot.model.link_name(*n) == link.name.as_str());
            let true_body = truth.robot.model.inertias()[number.expect("a link of the model")];
            let apart = true_body.parameters()[0] - link.parameters[0];
            square += (apart / link.standard_deviation[0]).powi(2);
        }
        errors.push((square / 5.0).sqrt());
        motion = inertia.links()[0].motion;
    }
    let (first, last) = (&told[0].1.links()[0], &told.last().unwrap().1.links()[0]);
    assert!(
        last.rows > 4 * first.rows && last.rows > 5000,
        "{} {}",
        first.rows,
        last.rows
    );
    // Masses: within the stated deviations, which are smaller than at first.
    println!("{errors:.2?}, {motion} s");
    assert!(
        motion > 0.6 * (end - begin),
        "{motion} of {} s",
        end - begin
    );
    assert!(errors.iter().all(|error| *error < 3.0), "{errors:?}");
    let total = |at: usize| {
        told[at]
            .1
            .links()
            .iter()
            .map(|link| link.standard_deviation[0].powi(2))
            .sum::<f64>()
    };
    assert!(total(told.len() - 1) < 0.5 * total(0));
}

#[test]
fn standing_still_teaches_nothing() {
    let sessions = arm();
    let log = standing(&sessions.log("train"), 4.8, 12);
    let mut end = None;
    let (estimates, _, counts, changes) = told_by(learning(&sessions), &log, 0, &mut end);
    assert!(
        changes.is_empty() && counts.learnt > 2000,
        "{counts:?} {changes:?}"
    );
    // At rest nothing shows that the setup is as stated, and parameters without information stay
    // those of the CAD, as uncertain as before.
    let elbow = estimates.last().unwrap().torques.joints()[3];
    assert_eq!(
        (elbow.valid, elbow.reason.get()),
        (0, Some(proprio_topics::Reason::Uncertain))
    );
    let end = end.unwrap();
    let (model, known) = (&end.setup().robot.model, end.identification().unwrap());
    let known = &known.solution().components[0];
    for (place, (&link, body)) in known.links.iter().zip(&known.bodies).enumerate() {
        let deviation = known.root.column(10 * place).norm();
        let cad = model.inertias()[link].mass;
        let of_cad = end.setup().robot.urdf_relative_std * cad;
        assert!(deviation > 0.5 * of_cad, "{link}: {deviation} {of_cad}");
        assert!((body.mass - cad).abs() < deviation, "{link}: {}", body.mass);
    }
}
