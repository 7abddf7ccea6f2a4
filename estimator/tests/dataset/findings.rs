//! What is found in clean, damaged and real logs.

use super::*;

#[test]
fn each_defect_put_into_a_clean_log_is_found_and_nothing_else() {
    let robot = robot("");
    let clean = log(&robot, 20.0, 100.0, 0.3, 0.0, 11);
    let with = |change: &dyn Fn(&mut Table)| {
        let mut table = clean.clone();
        change(&mut table);
        table
    };
    let is_wrench = |row: &[f64]| !row[2].is_nan();
    let second = 1_000_000_000;
    let between =
        move |t: i64, low: i64, high: i64| t >= low * second / 10 && t < high * second / 10;
    let each = |table: &mut Table, f: &mut dyn FnMut(i64, &mut [f64])| {
        table.rows.iter_mut().for_each(|(t, row)| f(*t, row))
    };
    // (what, the change, the kinds found, a part of the sentence)
    type Change<'a> = Box<dyn Fn(&mut Table) + 'a>;
    let cases: Vec<(&str, Change<'_>, &[&str], &str)> = vec![
        (
            "a gap of all",
            Box::new(|t| t.rows.retain(|(t, _)| !between(*t, 80, 83))),
            &["gap"],
            "every channel has no samples for 0.3",
        ),
        (
            "a gap of the sensor",
            Box::new(|t| {
                t.rows
                    .retain(|(t, r)| !(is_wrench(r) && between(*t, 80, 84)))
            }),
            &["gap"],
            "wrench/ft has no samples for 0.4",
        ),
        (
            "a sensor that ends",
            Box::new(|t| t.rows.retain(|(t, r)| !(is_wrench(r) && *t > 12 * second))),
            &["gap"],
            "wrench/ft has no samples for 7.99",
        ),
        (
            "infinite",
            Box::new(|t| t.rows[500].1[0] = f64::INFINITY),
            &["skipped_rows"],
            "1 rows cannot be read and were skipped; the first: line 502",
        ),
        (
            "rows written twice",
            Box::new(|t| {
                (0..5).for_each(|i| {
                    let row = t.rows[600 + 40 * i].clone();
                    t.rows.insert(600 + 40 * i, row);
                })
            }),
            &["repeated", "repeated"],
            "repeats its last reading in",
        ),
        (
            "a slow sensor",
            Box::new(|t| {
                let (mut last, mut odd) = (vec![], false);
                each(t, &mut |_, r| {
                    if is_wrench(r) {
                        odd = !odd;
                        if odd {
                            last = r.to_vec()
                        } else {
                            r.copy_from_slice(&last)
                        }
                    }
                });
            }),
            &["repeated"],
            "wrench/ft repeats its last reading in 1000 of 2000",
        ),
        (
            "a frozen sensor",
            Box::new(|t| {
                let mut last: Option<Vec<f64>> = None;
                each(t, &mut |t, r| {
                    if is_wrench(r) && between(t, 100, 120) {
                        let held = last.get_or_insert_with(|| r.to_vec());
                        r.copy_from_slice(held)
                    }
                });
            }),
            &["frozen"],
            "wrench/ft does not change from",
        ),
        (
            "a dead sensor",
            Box::new(|t| {
                each(t, &mut |_, r| {
                    if is_wrench(r) {
                        r[2..].copy_from_slice(&OFFSET)
                    }
                })
            }),
            &["frozen"],
            "wrench/ft does not change from",
        ),
        (
            "a dead encoder",
            Box::new(|t| {
                let mut last: Option<f64> = None;
                each(t, &mut |t, r| {
                    if !r[0].is_nan() && between(t, 100, 120) {
                        r[0] = *last.get_or_insert(r[0])
                    }
                });
            }),
            &["frozen"],
            "joint/shoulder does not change from",
        ),
        (
            "a joint that stands still",
            Box::new(|t| {
                each(t, &mut |_, r| {
                    if !r[0].is_nan() {
                        r[1] = 0.25
                    }
                })
            }),
            &["joint_still"],
            "joint/elbow never changes",
        ),
        (
            "stamps that go backward",
            Box::new(|t| (0..6).for_each(|i| t.rows[1000 + i].0 -= second)),
            &["timestamps", "timestamps"],
            "joint/shoulder, joint/elbow: 0 stamps occur twice and 3 go backward",
        ),
        (
            "one stamp far ahead",
            Box::new(|t| t.rows[1000].0 += 1000 * second),
            &["timestamps"],
            "1 go backward",
        ),
        (
            "a saturated axis",
            Box::new(|t| {
                each(t, &mut |_, r| {
                    if is_wrench(r) {
                        r[2] = r[2].min(25.0)
                    }
                })
            }),
            &["saturated"],
            "fx is saturated at 25",
        ),
        (
            "degrees",
            Box::new(|t| {
                each(t, &mut |_, r| {
                    r[..2].iter_mut().for_each(|v| *v = v.to_degrees())
                })
            }),
            &["wrong_units"],
            "convert all joints to radians",
        ),
        (
            "no motion",
            Box::new(|t| {
                each(t, &mut |_, r| {
                    if !r[0].is_nan() {
                        (r[0], r[1]) = (0.1, 0.2)
                    }
                })
            }),
            &["joint_still", "joint_still", "no_motion"],
            "no joint moves",
        ),
        (
            "a log whose time runs backward",
            Box::new(|t| {
                let last = t.rows.len() - 1;
                let stamps: Vec<i64> = t.rows.iter().map(|row| row.0).collect();
                (0..=last).for_each(|i| t.rows[i].0 = stamps[last - i]);
            }),
            // One sample is left of each channel.
            &[
                "joint_still",
                "joint_still",
                "timestamps",
                "timestamps",
                "too_short",
            ],
            "its time runs backward, first at 1",
        ),
        (
            "too short",
            Box::new(|t| t.rows.truncate(300)),
            &["too_short"],
            "the log of 1.",
        ),
        (
            "ticks of the encoder",
            Box::new(|t| {
                for i in [400, 900, 1300] {
                    let row = (i..).find(|i| !t.rows[*i].1[0].is_nan()).unwrap();
                    t.rows[row].1[1] += 0.15;
                }
            }),
            &["outliers"],
            "joint/elbow: 3 outliers of position",
        ),
        (
            "an unrecorded sensor",
            Box::new(|t| each(t, &mut |_, r| r[2..].fill(f64::NAN))),
            &["never_seen"],
            "wrench/ft is in the configuration but",
        ),
    ];
    let mut failures = Vec::new();
    for (name, change, kinds, sentence) in cases {
        let findings = with(&*change).findings(&robot);
        let sentences: Vec<&str> = findings.iter().map(|own| own.text.as_str()).collect();
        let mut found: Vec<&str> = findings.iter().map(code).collect();
        found.sort_unstable();
        if found != kinds || !sentences.iter().any(|s| s.contains(sentence)) {
            failures.push(format!("{name}: {sentences:#?}"));
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

/// An extreme that is reached slowly, in coarse steps, is as flat as a saturated one. The same
/// holds for a joint that stops there, and for a torque that is measured more slowly than recorded.
#[test]
fn what_turns_round_or_rests_at_its_extreme_is_not_saturated_and_what_is_cut_off_is() {
    /// The findings on fx and on the elbow's torque, in half a minute of two joints that swing
    /// together, with stops if their range is below one. Both are the given functions of the joint
    /// positions, in steps of 1/200 and 1/2000 of their range.
    fn findings(
        hertz: f64,
        furthest: f64,
        torque: impl Fn(usize, f64) -> f64,
        force: impl Fn(f64) -> f64,
    ) -> Vec<String> {
        let mut random = Random(3);
        let rows = (0..3000_usize).map(|i| {
            let x = (std::f64::consts::TAU * hertz * 0.01 * i as f64)
                .sin()
                .clamp(-furthest, furthest);
            let mut row = vec![1.8 * x, 1.4 * x, 0.1 * (100.0 * force(x)).round()];
            row.extend((0..5).map(|k| OFFSET[k] + 10.0 * x + 0.1 * random.normal()));
            row.push(0.004 * (1000.0 * torque(i, x)).round());
            (10_000_000 * i as i64, row)
        });
        let table = Table {
            header: COLUMNS
                .into_iter()
                .chain(["joint/elbow/torque"])
                .map(str::to_owned)
                .collect(),
            rows: rows.collect(),
        };
        let recording = table.dataset(&robot(""));
        let flat = |own: &&Finding| ["saturated", "frozen"].contains(&code(own));
        let found = recording.findings().iter().filter(flat);
        found.map(|own| own.text.clone()).collect()
    }
    let none: [String; 0] = [];
    for hertz in [0.1, 0.2, 1.0] {
        assert_eq!(
            findings(hertz, 1.0, |_, x| x, |x| x),
            none,
            "turns round at {hertz} Hz"
        );
    }
    assert_eq!(findings(0.05, 0.6, |_, x| x, |x| x), none, "rests");
    // The gravity load of a link, largest while the joint passes that position.
    assert_eq!(
        findings(0.02, 1.0, |_, x| (1.8 * x).cos(), |x| x),
        none,
        "passes"
    );
    // Every eighth sample is a new one.
    let held = |i: usize, _: f64| (std::f64::consts::TAU * 0.6 * 0.08 * (i / 8) as f64).cos();
    assert_eq!(findings(0.2, 1.0, held, |x| x), none, "is slow");
    for limit in [0.95, 0.9, 0.85] {
        let found = findings(1.0, 1.0, |_, x| x.max(-limit), |x| x.min(limit));
        for (name, value) in [
            ("joint/elbow: torque", -0.004 * (1000.0 * limit)),
            ("wrench/ft: fx", 0.1 * (100.0 * limit)),
        ] {
            let expected = format!("{name} is saturated at {value}");
            assert!(
                found.iter().any(|finding| finding.starts_with(&expected)),
                "{expected}: {found:?}"
            );
        }
        assert_eq!(found.len(), 2, "{found:?}");
    }
}

#[test]
fn gating_follows_contacts_quality_and_edges() {
    let robot = robot("[[contact]]\nlink = \"hand\"\npresence = \"possible\"");
    let mut table = log(&robot, 10.0, 100.0, 0.0, 0.0, 3);
    table
        .header
        .extend(["contact/hand/active", "ft/quality"].map(str::to_owned));
    for (t, row) in &mut table.rows {
        let touched = *t >= 4_000_000_000 && *t < 6_000_000_000;
        let saturated = *t >= 7_000_000_000 && *t < 7_100_000_000 && !row[2].is_nan();
        // A touch pulls with 20 N.
        row[4] += if touched { 20.0 } else { 0.0 };
        row.extend([
            f64::from(touched),
            if row[2].is_nan() {
                f64::NAN
            } else {
                f64::from(Quality::SATURATED.0 * u32::from(saturated))
            },
        ]);
    }
    let instants = table.dataset(&robot);
    let findings = instants.findings();
    let codes: Vec<&str> = findings.iter().map(code).collect();
    assert_eq!(codes, ["saturated"], "{findings:#?}");
    let sensor = robot.channels.iter().position(|c| c.name == "ft").unwrap();
    let joint = robot
        .channels
        .iter()
        .position(|c| c.name == "elbow")
        .unwrap();
    for instant in instants.observations() {
        let t = instant.t.seconds();
        assert_eq!(instant.active.contains(0), (4.0..6.0).contains(&t), "{t}");
        assert_eq!(
            instant.faults[sensor] == Reason::Saturated,
            (6.99..7.11).contains(&t) && instant.readings[0].force.x.is_nan(),
            "{t}"
        );
        if (7.0..7.1).contains(&t) {
            assert_eq!(instant.faults[sensor], Reason::Saturated);
        }
        // At the ends a whole window is excluded, 0.3 s at most.
        match instant.faults[joint] {
            Reason::None => assert!((0.05..9.95).contains(&t), "{t}"),
            fault => assert!(
                fault == Reason::Starting && !(0.32..9.68).contains(&t)
                    || !(0.01..=9.98).contains(&t),
                "{t}: {fault}"
            ),
        }
    }
}

#[test]
fn an_imu_tells_how_the_base_moves() {
    let text = "schema = 1\nrobot = \"arm\"\nmodel = \"arm.urdf\"\n[base]\nkind = \"imu\"\nsensor \
                = \"chest\"\nlink = \"base\"\nxyz_m = [0.1, 0.0, 0.2]\n[[force_torque]]\nsensor = \
                \"ft\"\njoint = \"ft\"";
    let model = Model::from_urdf(URDF, &["ft"]).unwrap();
    let robot = Setup::with_model(&Config::parse(text).unwrap(), model)
        .unwrap()
        .robot;
    let fixed = self::robot("");
    let mut table = log(&fixed, 10.0, 100.0, 0.2, 0.0, 5);
    table
        .header
        .extend(["ax", "ay", "az", "gx", "gy", "gz"].map(|c| format!("imu/chest/{c}")));
    let mut random = Random(9);
    for (t, row) in &mut table.rows {
        let t = Nanos(*t).seconds();
        let there = row[2].is_nan();
        let rate = [motion(0, t)[1], 0.1, motion(1, t)[1]];
        let values = [0.3, -0.2, 9.7]
            .into_iter()
            .chain(rate.map(|r| r + 1e-3 * random.normal()));
        row.extend(values.map(|v| {
            if there {
                v + 1e-4 * random.normal()
            } else {
                f64::NAN
            }
        }));
    }
    let instants = table.dataset(&robot);
    let usable: Vec<&Observation> = instants
        .observations()
        .iter()
        .filter(|i| i.knows_motion(&robot.channels))
        .collect();
    assert!(usable.len() > 900);
    let alpha = rms(usable
        .iter()
        .map(|i| i.base.angular_acceleration.x - motion(0, i.t.seconds())[2]));
    let omega = rms(usable
        .iter()
        .map(|i| i.base.angular_velocity.z - motion(1, i.t.seconds())[1]));
    println!("angular acceleration {alpha:.2e} rad/s^2, angular velocity {omega:.2e} rad/s");
    assert!(alpha < 0.02 && omega < 5e-4);
    for (_, row) in &mut table.rows {
        row[8..11].iter_mut().for_each(|a| *a /= 9.80665);
    }
    let findings = table.findings(&robot);
    let codes: Vec<&str> = findings.iter().map(code).collect();
    assert_eq!(codes, ["wrong_units"], "{findings:#?}");
    let text = &findings[0].text;
    assert!(text.contains("is not near 9.8"), "{text}");
}

#[test]
fn the_leg_of_a_real_icub_has_its_true_defects_and_no_others() {
    let (Some(log), Some(models)) = (
        data("icub_leg_24_44s.csv"),
        std::env::var_os("PROPRIO_ICUB_MODELS"),
    ) else {
        println!("skipped: PROPRIO_DATA or PROPRIO_ICUB_MODELS is not set");
        return;
    };
    let mut config = Config::load(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/real_leg/estimator.toml"),
    )
    .unwrap();
    config.model = Path::new(&models).join("iCubGenova02.urdf");
    // The right foot is in the air.
    config.contact.clear();
    let robot = Setup::new(&config).unwrap().robot;
    let instants = read(&robot, std::fs::File::open(log).unwrap());
    instants
        .findings()
        .iter()
        .for_each(|own| println!("{own:?}"));
    println!("{} instants", instants.observations().len());
    assert_eq!(instants.observations().len(), 1981);
    let warnings = instants
        .findings()
        .iter()
        .filter(|own| own.severity > Severity::Note);
    // The left leg's board repeats one reading for nine seconds, and others now and then. All other
    // streams have no defect.
    let (left, right): (Vec<&Finding>, Vec<&Finding>) =
        warnings.partition(|own| own.text.contains("l_leg_ft_sensor"));
    let seconds = |own: &&&Finding| {
        let (_, rest) = own.text.split_once("does not change from ")?;
        let (from, rest) = rest.split_once(" s to ")?;
        let to = rest.split(' ').next()?;
        Some(to.parse::<f64>().ok()? - from.parse::<f64>().ok()?)
    };
    let frozen = left.iter().filter(|own| code(own) == "frozen");
    assert!(
        frozen
            .filter_map(|own| seconds(&own))
            .any(|seconds| seconds > 9.0)
    );
    assert_eq!(right, [] as [&Finding; 0]);
}

#[test]
fn the_logs_of_a_real_kuka_are_clean() {
    for file in ["kuka_lwr4_1.csv", "kuka_lwr4_2.csv"] {
        let (Some(log), Some(model)) = (data(file), data("kuka_lwr4.urdf")) else {
            return;
        };
        let text = "schema = 1\nrobot = \"kuka\"\nmodel = \"kuka_lwr4.urdf\"\n[base]\nkind = \
                    \"fixed\"\nlink = \"lwr_base_link\"\n[identification]\ninputs = [\"torque\"]";
        let mut config = Config::parse(text).unwrap();
        config.model = model;
        let robot = Setup::new(&config).unwrap().robot;
        let instants = read(&robot, std::fs::File::open(log).unwrap());
        instants
            .findings()
            .iter()
            .for_each(|own| println!("{own:?}"));
        assert_eq!(instants.findings(), []);
        let usable = instants
            .observations()
            .iter()
            .filter(|i| i.knows_motion(&robot.channels) && i.torque.iter().all(|t| t.is_finite()))
            .count();
        println!("{usable} of {} instants", instants.observations().len());
        assert!(
            usable > 2440
                && (0..7).all(|dof| instants
                    .observations()
                    .iter()
                    .any(|i| i.torque[dof].is_finite()))
        );
    }
}

#[test]
fn a_wrong_model_and_a_late_start_are_no_defects() {
    let robot = robot("");
    // Every mass is a third too large, every centre of mass is displaced.
    let mut altered = robot.clone();
    for (link, inertia) in robot.model.inertias().iter().enumerate() {
        let mut parameters = inertia.parameters().map(|p| 1.33 * p);
        parameters[1] += 0.02 * parameters[0];
        parameters[2] -= 0.03 * parameters[0];
        let changed = RigidInertia::from_parameters(&parameters);
        altered.model.set_inertia(link, changed).unwrap();
    }
    // At rest for six seconds; then the motion starts, within one second.
    let begin = |joint: usize, t: f64| {
        let s = ((t - 6.0) / 1.0).clamp(0.0, 1.0);
        let rate = s * s * (3.0 - 2.0 * s);
        let change = if s > 0.0 && s < 1.0 {
            6.0 * s * (1.0 - s)
        } else {
            0.0
        };
        let passed = s.powi(3) - 0.5 * s.powi(4) + (t - 7.0).max(0.0);
        let [q, dq, ddq] = motion(joint, passed);
        [q, dq * rate, ddq * rate * rate + dq * change]
    };
    let mut alarms = Vec::new();
    for seed in 0..8 {
        for (rate, jitter) in [(50.0, 0.2), (100.0, 0.5), (200.0, 0.3)] {
            for table in [
                log(&robot, 20.0, rate, jitter, 0.0, 100 + seed),
                log_of(&robot, begin, 20.0, rate, jitter, 0.0, 200 + seed),
            ] {
                alarms.extend(
                    table
                        .findings(&altered)
                        .into_iter()
                        .map(|own| format!("{seed}, {rate} Hz: {}", own.text)),
                );
            }
        }
    }
    assert!(alarms.is_empty(), "{}", alarms.join("\n"));
}
