//! The pipeline on a robot for which three other libraries agree, and its rules: estimates depend
//! on stamps alone (immediate ones on the order of arrival), a missing channel affects only the
//! estimates that depend on it, and bad samples are counted and affect nothing else.

use proprio_dynamics::calibration::Calibration;
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame};
use proprio_dynamics::spatial::Wrench as Wrench6;
use proprio_estimator::config::{Config, ContactModel, Occurrence};
use proprio_estimator::offline;
use proprio_estimator::pipeline::{Estimate, Pipeline};
use proprio_estimator::setup::Setup;
use proprio_topics::csv::{Row, TableReader, Value, What};
use proprio_topics::{ContactState, JointState, Kind, Nanos, Quality, Reading, Reason, Wrench};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

/// The configuration of the arm, with no sensor offset (the golden files have none) and `more` at
/// the end.
fn setup(change: impl FnOnce(&mut Config)) -> Setup {
    let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    for ft in &mut config.force_torque {
        (ft.offset_n, ft.offset_nm) = (Some([0.0; 3]), Some([0.0; 3]));
    }
    config.output.max_wait_ms = Some(1.0);
    change(&mut config);
    Setup::new(&config).unwrap()
}

fn golden(name: &str) -> String {
    std::fs::read_to_string(root().join("tests/oracle").join(name)).unwrap()
}

/// A table of numbers by column name.
fn table(text: &str) -> HashMap<String, Vec<String>> {
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let names: Vec<String> = reader
        .headers()
        .unwrap()
        .iter()
        .map(str::to_owned)
        .collect();
    let mut columns: HashMap<String, Vec<String>> =
        names.iter().map(|n| (n.clone(), vec![])).collect();
    for record in reader.records() {
        for (name, cell) in names.iter().zip(record.unwrap().iter()) {
            columns.get_mut(name).unwrap().push(cell.to_owned());
        }
    }
    columns
}

#[test]
fn estimates_from_a_file_equal_those_of_other_libraries() {
    for (name, base_is_imu) in [
        ("icub_left_arm_mujoco.csv", true),
        ("icub_left_arm_mujoco.csv", false),
        ("icub_left_arm_mujoco_contact.csv", true),
        ("icub_left_arm_mujoco_contact.csv", false),
    ] {
        let setup = setup(|config| {
            if !base_is_imu {
                config.base = proprio_estimator::config::Base::Fixed {
                    link: "chest".into(),
                    gravity_mps2: [0.0, 0.0, -9.80665],
                };
                config.contact.retain(|c| c.name() != "stand");
            }
        });
        let joints: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
        let (log, mut out) = (golden(name), Vec::new());
        let report = offline::estimate(setup, log.as_bytes(), &mut out, None).unwrap();
        let (want, got) = (table(&log), table(std::str::from_utf8(&out).unwrap()));
        assert_eq!(report.estimates, 201);
        assert_eq!(want["t"].len(), got["t"].len());
        let number = |s: &String| s.parse::<f64>().unwrap();
        assert!(
            want["t"]
                .iter()
                .zip(&got["t"])
                .all(|(a, b)| number(a) == number(b)),
            "the same instants"
        );
        for joint in &joints {
            let pairs = want[&format!("joint/{joint}/torque")]
                .iter()
                .zip(&got[&format!("torque/{joint}")]);
            for (want, got) in pairs {
                let (want, got) = (number(want), number(got));
                assert!(
                    (want - got).abs() < 1e-9 * (1.0 + want.abs()),
                    "{name} imu {base_is_imu} {joint}: {want} {got}"
                );
            }
            assert!(got[&format!("valid/{joint}")].iter().all(|v| v == "1"));
            assert!(got[&format!("reason/{joint}")].iter().all(String::is_empty));
        }
        for part in ["fx", "fy", "fz", "tx", "ty", "tz"] {
            let column = format!("contact/hand/{part}");
            for (row, got) in got[&column].iter().enumerate() {
                let want = want.get(&column).map_or(0.0, |w| number(&w[row]));
                assert!(
                    (want - number(got)).abs() < 1e-9,
                    "{name} {column} {row}: {want} {got}"
                );
            }
        }
    }
}

/// The arm's log as sent by a sensor with cross-talk whose board warms up; and the temperatures.
fn miscalibrated(log: &str, change: &Calibration) -> (String, Vec<f64>) {
    let inverse = change.gain().try_inverse().unwrap();
    let mut reader = csv::Reader::from_reader(log.as_bytes());
    let names: Vec<String> = reader
        .headers()
        .unwrap()
        .iter()
        .map(str::to_owned)
        .collect();
    let parts =
        ["fx", "fy", "fz", "tx", "ty", "tz"].map(|part| format!("wrench/l_arm_ft_sensor/{part}"));
    let places = parts.map(|part| names.iter().position(|name| *name == part).unwrap());
    let mut text = format!("{},wrench/l_arm_ft_sensor/temperature\n", names.join(","));
    let (mut temperatures, mut last) = (Vec::new(), change.reference().unwrap());
    for (row, record) in reader.records().enumerate() {
        let mut cells: Vec<String> = record.unwrap().iter().map(str::to_owned).collect();
        let [fx, fy, fz, tx, ty, tz] = places.map(|place| cells[place].parse::<f64>().unwrap());
        let warm = Wrench6::from_parts([fx, fy, fz], [tx, ty, tz])
            + *change.per_kelvin() * change.temperature_rise(last);
        let raw = inverse * nalgebra::Vector6::from(warm.torque_first());
        for (place, axis) in places.into_iter().zip([3, 4, 5, 0, 1, 2]) {
            cells[place] = raw[axis].to_string();
        }
        // Every tenth row has a temperature, which holds from the next row on.
        let now = 25.0 + 0.05 * row as f64;
        let cell = if row % 10 == 0 {
            now.to_string()
        } else {
            String::new()
        };
        temperatures.push(last);
        last = if row % 10 == 0 { now } else { last };
        text += &format!("{},{cell}\n", cells.join(","));
    }
    (text, temperatures)
}

fn calibration() -> Calibration {
    let gain = nalgebra::Matrix6::from_fn(|i, j| {
        if i == j {
            1.0 + 0.02 * i as f64
        } else {
            0.003 * (i as f64 - j as f64)
        }
    });
    Calibration::new(
        gain,
        Wrench6::from_parts([0.3, -0.2, 0.5], [0.01, -0.02, 0.005]),
        Some(24.0),
    )
}

/// As configured: the gain row by row, [force; torque].
fn calibrate(config: &mut Config, change: &Calibration) {
    let ft = &mut config.force_torque[0];
    ft.gain = Some(change.gain_force_first().to_vec());
    ft.temperature_n_per_k = change.per_kelvin().force.into();
    ft.temperature_nm_per_k = change.per_kelvin().torque.into();
    ft.reference_celsius = change.reference();
}

#[test]
fn corrected_readings_give_the_same_estimates_as_exact_ones() {
    let log = golden("icub_left_arm_mujoco_contact.csv");
    let change = calibration();
    let (wrong, temperatures) = miscalibrated(&log, &change);
    assert!(temperatures.last().unwrap() - temperatures[0] > 9.0);
    let run = |setup: Setup, text: &str| {
        let mut out = Vec::new();
        offline::estimate(setup, text.as_bytes(), &mut out, None).unwrap();
        table(std::str::from_utf8(&out).unwrap())
    };
    let right = run(setup(|_| {}), &log);
    let corrected = run(setup(|config| calibrate(config, &change)), &wrong);
    let uncorrected = run(setup(|_| {}), &wrong);
    let mut off: f64 = 0.0;
    for column in [
        "torque/l_shoulder_pitch",
        "torque/l_elbow",
        "contact/hand/fz",
        "torque_std/l_elbow",
    ] {
        // Before the first row no temperature was received.
        let rows = right[column]
            .iter()
            .zip(&corrected[column])
            .zip(&uncorrected[column]);
        for ((right, corrected), uncorrected) in rows.skip(usize::from(column.contains("std"))) {
            let number = |s: &String| s.parse::<f64>().unwrap();
            assert!(
                (number(right) - number(corrected)).abs() < 1e-9,
                "{column}: {right} {corrected}"
            );
            off = off.max((number(right) - number(uncorrected)).abs());
        }
    }
    assert!(off > 1.0, "{off}");
    // Without corrections not a bit changes, with temperatures or without.
    let with_temperatures: String = log
        .lines()
        .zip(wrong.lines())
        .fold(String::new(), |text, (line, other)| {
            text + line + "," + other.rsplit_once(',').unwrap().1 + "\n"
        });
    assert_eq!(run(setup(|_| {}), &with_temperatures), right);
}

/// A temperature may arrive up to half the wait after a wrench with a later stamp, and nothing
/// changes: a live run equals a replay.
#[test]
fn temperatures_count_by_their_stamps() {
    let change = calibration();
    let (log, _) = miscalibrated(&golden("icub_left_arm_mujoco_contact.csv"), &change);
    let run = |delay: Nanos| {
        let mut pipeline = Pipeline::new(setup(|config| {
            calibrate(config, &change);
            config.output.max_wait_ms = Some(40.0);
        }));
        let mut reader = TableReader::new(log.as_bytes()).unwrap();
        let series: Vec<_> = reader.series().to_vec();
        let (mut row, mut samples) = (Row::default(), Vec::new());
        while reader.next_row(&mut row).unwrap() {
            for item in &row.items {
                let of = &series[item.series];
                if let (What::Channel(kind), Value::Reading(reading, quality)) =
                    (of.what, &item.value)
                    && let Some(channel) = pipeline.setup().robot.channel(kind, &of.name)
                {
                    let late = matches!(reading, Reading::Temperature(_));
                    let arrival = row.t.unwrap() + if late { delay } else { Nanos::ZERO };
                    samples.push((arrival, row.t.unwrap(), channel, *reading, *quality));
                }
            }
        }
        samples.sort_by_key(|(arrival, ..)| *arrival);
        let mut torques = Vec::new();
        for (_, t, channel, reading, quality) in samples {
            pipeline.push(channel, t, &reading, quality);
            while let Some(estimate) = pipeline.poll() {
                torques.push((estimate.t, estimate.torques.joints()[0].torque.to_bits()));
            }
        }
        (torques, pipeline.counts().late)
    };
    let (prompt, late) = run(Nanos::ZERO);
    assert_eq!((prompt.len(), late), (201, 0));
    assert_eq!(run(Nanos::from_millis(20)), (prompt.clone(), 0));
    // Later than that it is counted as late.
    let (other, late) = run(Nanos::from_millis(80));
    assert!(late > 10, "{late}");
    assert_ne!(other, prompt);
}

fn temperature(celsius: f64) -> Reading {
    Reading::Temperature(proprio_topics::Temperature { celsius })
}

/// Temperatures that are not used have no effect.
#[test]
fn temperatures_count_only_if_trusted_and_needed() {
    let change = calibration();
    let wanting = || setup(|config| calibrate(config, &change));
    let plain = setup(|_| {});
    let sensor = plain
        .robot
        .channel(Kind::Wrench, "l_arm_ft_sensor")
        .unwrap();
    let events = recording(&plain, 0.5);
    let with = |said: &[(f64, f64, Quality)]| {
        let said = said.iter();
        let said = said.map(|(t, celsius, quality)| {
            (
                sensor,
                Nanos::from_seconds(*t),
                temperature(*celsius),
                *quality,
            )
        });
        // In the order of arrival: each before samples with the same stamp.
        let mut all = events.clone();
        for one in said {
            all.insert(all.partition_point(|other| other.1 < one.1), one);
        }
        all
    };
    // If no calibration depends on temperature, not even invalid temperatures are counted.
    let odd = with(&[
        (0.1, 30.0, Quality::GOOD),
        (0.1, 30.0, Quality::GOOD),
        (0.2, f64::NAN, Quality::GOOD),
    ]);
    let ((without, before), (got, after)) = (run(plain.clone(), &events), run(plain, &odd));
    assert_eq!(bits(&got), bits(&without));
    assert_eq!(after.counts(), before.counts());
    // If one does, they are.
    let (_, pipeline) = run(wanting(), &odd);
    let (taken, counts) = (before.counts().taken, pipeline.counts());
    assert_eq!(
        (counts.taken, counts.backward, counts.not_finite),
        (taken + 1, 1, 1)
    );
    // A temperature that the board marks as faulty is not taken.
    let good = (0.1, 26.0, Quality::GOOD);
    let faulty = (0.2, 900.0, Quality::DEVICE_FAULT);
    let (right, _) = run(wanting(), &with(&[good]));
    let (got, pipeline) = run(wanting(), &with(&[good, faulty]));
    assert_eq!(bits(&got), bits(&right));
    assert_eq!(pipeline.counts().taken, taken + 1);
    let (wrong, _) = run(wanting(), &with(&[good, (0.2, 900.0, Quality::GOOD)]));
    assert_ne!(bits(&wrong), bits(&right));
}

/// If a board's temperature is unknown, the standard deviations of torques grow, as with an
/// uncertain offset.
#[test]
fn without_a_temperature_torques_are_less_certain() {
    let change = calibration();
    // All channels at rest at one instant, and a temperature of this age.
    let log = golden("icub_left_arm_mujoco.csv");
    let std = |age: Option<f64>, kelvin: f64| {
        let mut pipeline = Pipeline::new(setup(|config| {
            calibrate(config, &change);
            let ft = &mut config.force_torque[0];
            ft.offset_std_n = Some(ft.temperature_n_per_k.map(|k| (k * kelvin).abs()));
            ft.offset_std_nm = Some(ft.temperature_nm_per_k.map(|k| (k * kelvin).abs()));
        }));
        let t = Nanos::from_seconds(10_000.0);
        if let Some(age) = age {
            let sensor = pipeline
                .setup()
                .robot
                .channel(Kind::Wrench, "l_arm_ft_sensor")
                .unwrap();
            pipeline.push(
                sensor,
                t - Nanos::from_seconds(age),
                &temperature(27.0),
                Quality::GOOD,
            );
        }
        let mut reader = TableReader::new(log.as_bytes()).unwrap();
        let series: Vec<_> = reader.series().to_vec();
        let mut row = Row::default();
        assert!(reader.next_row(&mut row).unwrap());
        for item in &row.items {
            let of = &series[item.series];
            if let (What::Channel(kind), Value::Reading(reading, quality)) = (of.what, &item.value)
                && let Some(channel) = pipeline.setup().robot.channel(kind, &of.name)
            {
                pipeline.push(channel, t, reading, *quality);
            }
        }
        pipeline.finish();
        let torques = pipeline.poll().unwrap().torques;
        let told: Vec<&str> = pipeline.without_temperature().collect();
        let deviations: Vec<f64> = torques
            .joints()
            .iter()
            .map(|j| j.standard_deviation)
            .collect();
        (deviations, told == ["l_arm_ft_sensor"])
    };
    let known = std(Some(30.0), 0.0);
    assert!(!known.1);
    assert_eq!(std(Some(59.0), 0.0), known);
    for (age, kelvin) in [(Some(180.0), 2.0), (Some(5000.0), 10.0), (None, 10.0)] {
        let (found, is_told) = std(age, 0.0);
        let (expected, _) = std(Some(30.0), kelvin);
        assert!(is_told, "{age:?}");
        for ((found, expected), known) in found.iter().zip(&expected).zip(&known.0) {
            // The temperature is that of half the wait before.
            assert!(
                (found / expected - 1.0).abs() < 1e-3,
                "{age:?}: {found} {expected}"
            );
            assert!(found > known, "{age:?}: {found} {known}");
        }
    }
}

/// Information gathered with one gain is not valid for readings with another gain.
#[test]
fn a_state_identified_with_other_calibrations_is_not_resumed() {
    let identifying = |change: &dyn Fn(&mut Config)| {
        Pipeline::new(setup(|config| {
            config.identification.enabled = true;
            config.contact.last_mut().unwrap().presence = Occurrence::Possible;
            change(config);
        }))
    };
    let mut pipeline = identifying(&|_| {});
    let events = recording(pipeline.setup(), 3.0);
    let mut state = None;
    for (channel, t, reading, quality) in events {
        pipeline.push(channel, t, &reading, quality);
        while pipeline.poll().is_some() {
            if let Some(job) = pipeline.take_job() {
                state = Some(job.state());
                pipeline.give_back(job);
            }
        }
    }
    let state = state.expect("a job within three seconds");
    identifying(&|_| {}).resume(&state).unwrap();
    // Offsets are not compared: a restart may change them.
    identifying(&|config| config.force_torque[0].offset_n = Some([5.0, 0.0, 0.0]))
        .resume(&state)
        .unwrap();
    let other: [&dyn Fn(&mut Config); 4] = [
        &|config| config.force_torque[0].gain = Some(vec![1.07, 1.0, 1.0, 1.0, 1.0, 1.0]),
        &|config| {
            config.force_torque[0].temperature_n_per_k = [0.0, 0.05, 0.0];
            config.force_torque[0].reference_celsius = Some(25.0);
        },
        &|config| {
            config.force_torque[0].direction = match config.force_torque[0].direction {
                Some(MeasurementDirection::ChildToParent) => {
                    Some(MeasurementDirection::ParentToChild)
                }
                _ => Some(MeasurementDirection::ChildToParent),
            }
        },
        &|config| config.force_torque[0].frame = Some(MeasurementFrame::Parent),
    ];
    for (number, change) in other.into_iter().enumerate() {
        let mut pipeline = identifying(change);
        let fresh = pipeline.identification().unwrap().solution().components[0]
            .bodies
            .clone();
        let error = pipeline.resume(&state).unwrap_err().to_string();
        assert!(
            error.contains("mounting or calibration"),
            "{number}: {error}"
        );
        let after = &pipeline.identification().unwrap().solution().components[0].bodies;
        assert_eq!(after, &fresh);
    }
}

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

/// One sample of a recording: channel, stamp, reading, quality.
type Event = (usize, Nanos, Reading, Quality);

/// A recording at realistic, unequal rates, made from the golden trajectory: F/T at 1 kHz, joints
/// at 250 Hz with positions only, IMU at 100 Hz; each channel with its own phase.
fn recording(setup: &Setup, seconds: f64) -> Vec<Event> {
    recording_with(setup, seconds, |channel| 0.0001 * channel as f64)
}

/// The same with the phase of each channel [s] given.
fn recording_with(setup: &Setup, seconds: f64, phase: impl Fn(usize) -> f64) -> Vec<Event> {
    let mut reader =
        TableReader::new(golden("icub_left_arm_mujoco.csv").leak().as_bytes()).unwrap();
    let channel = |s: &proprio_topics::csv::Series| match s.what {
        What::Channel(kind) => setup.robot.channel(kind, &s.name),
        What::Contact => None,
    };
    let series: Vec<_> = reader.series().iter().map(channel).collect();
    let mut rows: Vec<(f64, HashMap<usize, Reading>)> = vec![];
    let mut row = Row::default();
    while reader.next_row(&mut row).unwrap() {
        let items = row.items.iter().filter_map(|i| match i.value {
            Value::Reading(reading, _) => Some((series[i.series]?, reading)),
            Value::Contact(_) => None,
        });
        rows.push((row.t.unwrap().seconds(), items.collect()));
    }
    let mix = |a: f64, b: f64, p: f64| a + (b - a) * p;
    let at = |channel: usize, t: f64| {
        let after = rows.partition_point(|(x, _)| *x <= t).min(rows.len() - 1);
        let ((t0, a), (t1, b)) = (&rows[after - 1], &rows[after]);
        let p = (t - t0) / (t1 - t0);
        match (a[&channel], b[&channel]) {
            (Reading::Joint(a), Reading::Joint(b)) => Reading::Joint(JointState {
                position: mix(a.position, b.position, p),
                ..JointState::ABSENT
            }),
            (Reading::Wrench(a), Reading::Wrench(b)) => Reading::Wrench(Wrench {
                force: std::array::from_fn(|i| mix(a.force[i], b.force[i], p)),
                torque: std::array::from_fn(|i| mix(a.torque[i], b.torque[i], p)),
            }),
            (a, _) => a,
        }
    };
    let mut events = vec![];
    for (number, channel) in setup.robot.channels.iter().enumerate() {
        let period = match channel.kind {
            Kind::Wrench => 1e-3,
            Kind::Joint => 4e-3,
            _ => 1e-2,
        };
        let mut t = phase(number);
        while t < seconds {
            events.push((number, Nanos::from_seconds(t), at(number, t), Quality::GOOD));
            t += period;
        }
    }
    events.sort_by_key(|e| (e.1, e.0));
    events
}

fn run(setup: Setup, events: &[Event]) -> (Vec<Estimate>, Pipeline) {
    let mut pipeline = Pipeline::new(setup);
    let mut estimates = vec![];
    for (channel, t, reading, quality) in events {
        pipeline.push(*channel, *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            estimates.push(estimate.clone());
        }
    }
    pipeline.finish();
    while let Some(estimate) = pipeline.poll() {
        estimates.push(estimate.clone());
    }
    (estimates, pipeline)
}

/// A torque bit for bit: value, deviation, validity, reason, cause.
type Bits = (u64, u64, u32, Reason, u32);

/// Bit for bit: NaN equals NaN.
fn bits(estimates: &[Estimate]) -> Vec<(Nanos, Vec<Bits>)> {
    let joint = |j: &proprio_topics::JointTorque| {
        (
            j.torque.to_bits(),
            j.standard_deviation.to_bits(),
            j.valid,
            j.reason.get().unwrap(),
            j.cause,
        )
    };
    estimates
        .iter()
        .map(|e| (e.t, e.torques.joints().iter().map(joint).collect()))
        .collect()
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

#[test]
fn samples_of_an_uncalibrated_encoder_are_not_differentiated() {
    let setup = setup(|_| {});
    let elbow = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let names: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
    let events = recording(&setup, 0.6);
    let (clean, _) = run(setup.clone(), &events);
    let mut bad = events;
    for event in bad
        .iter_mut()
        .filter(|e| e.0 == elbow && e.1 < Nanos::from_millis(300))
    {
        let Reading::Joint(state) = event.2 else {
            panic!("a joint")
        };
        event.2 = Reading::Joint(JointState {
            position: state.position + 1.0,
            ..state
        });
        event.3 = Quality::NOT_CALIBRATED;
    }
    let (estimates, _) = run(setup, &bad);
    let mut withheld = 0;
    for (estimate, clean) in estimates.iter().zip(&clean) {
        for ((name, joint), right) in names
            .iter()
            .zip(estimate.torques.joints())
            .zip(clean.torques.joints())
        {
            withheld += u32::from(joint.reason == Reason::DeviceFault);
            if joint.valid == 1 && right.valid == 1 {
                let error = joint.torque - right.torque;
                assert!(error.abs() < 0.2, "{name} at {}: {error}", estimate.t);
            }
        }
    }
    assert!(withheld > 500);
    assert!(
        estimates
            .last()
            .unwrap()
            .torques
            .joints()
            .iter()
            .all(|j| j.valid == 1)
    );
}

#[test]
fn the_ground_reaction_of_a_fixed_base_cannot_be_declared_absent() {
    let fixed = |presence| {
        move |config: &mut Config| {
            config.base = proprio_estimator::config::Base::Fixed {
                link: "chest".into(),
                gravity_mps2: [0.0, 0.0, -9.80665],
            };
            config
                .contact
                .iter_mut()
                .filter(|c| c.name() == "stand")
                .for_each(|c| c.presence = presence);
        }
    };
    use proprio_estimator::config::Occurrence::{Always, Possible};
    let mut torques = vec![];
    for presence in [Always, Possible] {
        let setup = setup(fixed(presence));
        let stand = setup.robot.contact("stand").unwrap();
        let events = recording(&setup, 0.2);
        let (want, _) = run(setup.clone(), &events);
        let mut pipeline = Pipeline::new(setup);
        pipeline.declare(stand, Nanos::ZERO, &ContactState::configured(false));
        let mut got = vec![];
        for (channel, t, reading, quality) in &events {
            pipeline.push(*channel, *t, reading, *quality);
            while let Some(estimate) = pipeline.poll() {
                got.push(estimate.clone());
            }
        }
        let roll = 1;
        let (want, got) = (
            want[150].torques.joints()[roll],
            got[150].torques.joints()[roll],
        );
        assert_eq!((want.valid, got.valid), (1, 1));
        torques.extend([want.torque, got.torque]);
    }
    assert!(
        torques.iter().all(|t| (t - torques[0]).abs() < 1e-9),
        "{torques:?}"
    );
}

#[test]
fn a_repeated_declaration_changes_nothing() {
    let setup = setup(|config| {
        for contact in config.contact.iter_mut().filter(|c| c.name() == "hand") {
            contact.presence = Occurrence::Possible;
        }
        config.output.max_wait_ms = Some(20.0);
    });
    let hand = setup.robot.contact("hand").unwrap();
    let events = recording(&setup, 0.3);
    let mut pipeline = Pipeline::new(setup);
    let mut next = Nanos::ZERO;
    for (channel, t, reading, quality) in &events {
        while next <= *t {
            pipeline.declare(hand, next, &ContactState::configured(true));
            next += Nanos::from_millis(1);
        }
        pipeline.push(*channel, *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            assert_ne!(
                estimate.contacts.contacts()[hand].reason,
                Reason::Absent,
                "at {}",
                estimate.t
            );
        }
    }
    // More changes than are kept: before the first that is kept, the last one of those dropped is
    // valid.
    let start = events.last().unwrap().1 + Nanos::from_millis(10);
    for i in 0..600 {
        let state = ContactState::configured(i % 2 == 1);
        pipeline.declare(hand, start + Nanos::from_millis(100 + i), &state);
    }
    let (mut present, mut all) = (0, 0);
    for (channel, t, reading, quality) in &events {
        pipeline.push(*channel, start + *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            if (start..start + Nanos::from_millis(100)).contains(&estimate.t) {
                let contact = &estimate.contacts.contacts()[hand];
                all += 1;
                present += usize::from(contact.reason != Reason::Absent && contact.detected == 0);
            }
        }
    }
    assert!(all > 50 && present == all, "{present} of {all}");
}

#[test]
fn a_possible_contact_is_absent_unless_declared() {
    let possible = |config: &mut Config| {
        for contact in config.contact.iter_mut().filter(|c| c.name() == "hand") {
            contact.presence = Occurrence::Possible;
        }
    };
    let setup = setup(possible);
    let hand = setup.robot.contact("hand").unwrap();
    let events = recording(&setup, 0.3);
    let mut pipeline = Pipeline::new(setup);
    pipeline.declare(
        hand,
        Nanos::from_millis(200),
        &ContactState::configured(true),
    );
    for (channel, t, reading, quality) in &events {
        pipeline.push(*channel, *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            let contact = estimate.contacts.contacts()[hand];
            if estimate.t < Nanos::from_millis(50) {
                continue;
            }
            if estimate.t < Nanos::from_millis(200) {
                assert_eq!(
                    (contact.valid, contact.reason),
                    (0, Reason::Absent.in_memory())
                );
                let numbers = contact.force.into_iter().chain(contact.torque);
                let mut numbers = numbers.chain(contact.standard_deviation);
                assert!(numbers.all(f64::is_nan), "{contact:?}");
            } else {
                assert_eq!(
                    (contact.valid, contact.reason),
                    (1, Reason::None.in_memory())
                );
                assert!(contact.force.iter().any(|f| *f != 0.0));
            }
        }
    }
}

#[test]
fn each_mistake_between_configuration_and_model_has_one_clear_message() {
    let load = || Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    let problem = |change: &dyn Fn(&mut Config)| {
        let mut config = load();
        change(&mut config);
        Setup::new(&config).map(|s| s.to_string()).unwrap_err()
    };
    for (change, expected) in [
        (
            &|c: &mut Config| c.contact[1].link = "l_hnad".into(),
            "contact \"hand\": link: \"l_hnad\" is not a link of the URDF; did you mean \
             \"l_hand\"?",
        ),
        (
            &|c: &mut Config| c.force_torque[0].joint = "l_arm_ft".into(),
            "joint l_arm_ft, named as the joint of an F/T sensor, is not in the URDF; any of its \
             joints could carry one, fixed or moving (it is then on the child's side): \
             l_arm_ft_sensor",
        ),
        (
            &|c: &mut Config| {
                c.force_torque[0].joint = "l_elbow".into();
                c.force_torque[0].frame = Some(MeasurementFrame::Parent);
            },
            "the F/T sensor in joint l_elbow cannot measure in the parent's frame, because the \
             joint moves",
        ),
        (
            &|c: &mut Config| {
                c.locked.insert("l_elbw".into(), 0.5);
            },
            "locked.l_elbw: \"l_elbw\" is not a joint of the URDF; did you mean \"l_elbow\"?",
        ),
        (
            &|c: &mut Config| c.output.trigger = Some("nobody".into()),
            "output.trigger = \"nobody\" is not a channel of this configuration",
        ),
        (
            &|c: &mut Config| c.contact[1].name = Some("stand".into()),
            "two contacts have this name",
        ),
        (
            &|c: &mut Config| c.model = "nowhere.urdf".into(),
            "nowhere.urdf",
        ),
    ] as [(&dyn Fn(&mut Config), &str); 7]
    {
        let problem = problem(change);
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
    // A joint that is neither measured nor locked.
    let log = golden("icub_left_arm_mujoco.csv").replace("joint/l_elbow/", "joint/l_elbo/");
    let error = offline::estimate(setup(|_| {}), log.as_bytes(), Vec::new(), None)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("joint/l_elbow; did you mean \"joint/l_elbo\"?; use a log of"),
        "{error}"
    );
}

#[test]
fn a_table_whose_clock_was_set_back_is_told_with_its_place() {
    let log = golden("icub_left_arm_mujoco.csv");
    let lines: Vec<&str> = log.lines().collect();
    let t = |line: usize| {
        let cell = lines[line].split(',').next().unwrap();
        Nanos::parse_seconds(cell).unwrap()
    };
    let set_back = [&lines[..100], &lines[20..40]].concat().join("\n");
    let report = offline::estimate(setup(|_| {}), set_back.as_bytes(), Vec::new(), None).unwrap();
    assert_eq!(report.step_back, Some((101, t(99), t(20))));
    assert_eq!(report.first_dropped, Some(101));
}

/// A robot whose IMU reads its weight does not fly because nobody has named what carries it.
#[test]
fn what_carries_an_imu_need_not_be_named() {
    let possible = |config: &mut Config| possible_hand_contact(config);
    let named = estimates_with_added(possible, "icub_left_arm_mujoco.csv", |_| [0.0; 6]);
    let unnamed = |config: &mut Config| {
        possible_hand_contact(config);
        config.contact.retain(|c| c.name() != "stand");
    };
    let others = estimates_with_added(unnamed, "icub_left_arm_mujoco.csv", |_| [0.0; 6]);
    let torques: Vec<&String> = named
        .keys()
        .filter(|name| name.contains("torque"))
        .collect();
    assert_eq!(torques.len(), 14);
    assert!(
        torques
            .iter()
            .all(|name| named[*name] == others[*name] && !named[*name][9].is_empty())
    );
    // It is told; and on the part of the robot beyond the sensor a contact carries nothing.
    let told = |setup: &Setup| setup.warnings().iter().any(|w| w.contains("does not fly"));
    assert!(told(&setup(unnamed)));
    assert!(!told(&setup(possible)));
    // What may fly says so.
    assert!(!told(&setup(|config| {
        config.contact[0].presence = Occurrence::Possible;
    })));
}

/// A robot that stands on its chest, then on its hand, then on nothing: the base follows the
/// declarations, and the torques equal the true ones.
#[test]
fn the_base_is_the_link_that_stands() {
    use proprio_dynamics::spatial::Vec3;
    use proprio_dynamics::{FrameMotion, InverseDynamics, JointState as State, Kinematics};
    use proprio_estimator::config::{Base, Foot, Occurrence};

    const GRAVITY: [[f64; 3]; 2] = [[0.0, 0.0, -9.80665], [3.0, 0.0, -9.3]];
    let on = |config: &mut Config| {
        let foot = |link: &str, contact: &str, gravity_mps2| Foot {
            link: link.into(),
            contact: contact.into(),
            gravity_mps2,
        };
        config.base = Base::Stance {
            foot: vec![
                foot("chest", "stand", GRAVITY[0]),
                foot("l_hand", "hand", GRAVITY[1]),
            ],
        };
        for contact in &mut config.contact {
            contact.presence = Occurrence::Possible;
        }
    };
    let setup = setup(on);
    let (stand, hand) = (
        setup.robot.contact("stand").unwrap(),
        setup.robot.contact("hand").unwrap(),
    );
    let dofs = setup.robot.model.dof_count();
    let mut pipeline = Pipeline::new(setup.clone());
    let ms = Nanos::from_millis;
    for (contact, t, active) in [
        (stand, 0, true),
        (stand, 40, false),
        (hand, 30, true),
        (hand, 70, false),
    ] {
        pipeline.declare(contact, ms(t), &ContactState::configured(active));
    }
    for step in 0..100 {
        let t = ms(step);
        let value = |dof: usize, factor: f64| (0.05 * step as f64 * factor + dof as f64).sin();
        let states = [1.0, 2.0, 5.0].map(|factor| {
            (0..dofs)
                .map(|dof| value(dof, factor))
                .collect::<Vec<f64>>()
        });
        // While both are declared, the foot listed first is the base.
        let foot = usize::from(step >= 40);
        let base = [
            setup.robot.base_link,
            setup.robot.model.frame("l_hand").unwrap().link,
        ][foot];
        let mut truth = Kinematics::new(&setup.robot.model, base).unwrap();
        let state = State {
            position: &states[0],
            velocity: &states[1],
            acceleration: &states[2],
        };
        let standing = FrameMotion::standing(&Vec3::from(GRAVITY[foot]));
        truth.update(&setup.robot.model, state, &standing).unwrap();
        let mut dynamics = InverseDynamics::new(&setup.robot.model);
        dynamics.update(&setup.robot.model, &truth, &[]).unwrap();
        let sensor = setup.robot.structure.sensors()[0];
        let [fx, fy, fz, tx, ty, tz] = sensor
            .reading(&dynamics.transmitted(&truth, sensor.joint()))
            .force_first();
        for (number, channel) in setup.robot.channels.iter().enumerate() {
            let reading = match channel.role {
                proprio_identification::robot::ChannelRole::Joint(dof) => {
                    Reading::Joint(JointState {
                        position: states[0][dof],
                        velocity: states[1][dof],
                        acceleration: states[2][dof],
                        ..JointState::ABSENT
                    })
                }
                _ => Reading::Wrench(Wrench {
                    force: [fx, fy, fz],
                    torque: [tx, ty, tz],
                }),
            };
            pipeline.push(number, t, &reading, Quality::GOOD);
        }
        let estimate = pipeline.poll().expect("every channel has this instant");
        for (joint, want) in estimate.torques.joints().iter().zip(dynamics.torque()) {
            // Both are declared from 30 to 40 ms: one contact in each half of the robot. Gravity is
            // another one at once then, and the first reading of it is not believed.
            if step == 40 && joint.valid == 0 {
                assert_eq!(joint.reason, Reason::Implausible);
            } else if step < 70 {
                assert_eq!(
                    (joint.valid, joint.reason),
                    (1, Reason::None.in_memory()),
                    "at {step} ms"
                );
                assert!(
                    (joint.torque - want).abs() < 1e-10,
                    "at {step} ms: {} {want}",
                    joint.torque
                );
            } else {
                // The motion of the base is unknown, and so is the ground reaction.
                assert_eq!(
                    (joint.valid, joint.reason),
                    (0, Reason::NoStance.in_memory()),
                    "at {step} ms"
                );
            }
        }
    }
}

#[test]
fn a_foot_needs_a_contact_that_can_carry() {
    use proprio_estimator::config::{Base, ContactModel, Foot};
    let foot = |link: &str, contact: &str| Foot {
        link: link.into(),
        contact: contact.into(),
        gravity_mps2: [0.0, 0.0, -9.8],
    };
    let problem = |kind, foot| {
        let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
        config.contact[0].kind = kind;
        config.base = Base::Stance { foot };
        Setup::new(&config).map(|s| s.to_string()).unwrap_err()
    };
    for (second, expected) in [
        (
            foot("l_hand", "hand"),
            "contact \"stand\" is always present, so no later foot could become the base",
        ),
        (
            foot("chest", "stand"),
            "contact \"stand\" is always present",
        ),
    ] {
        let problem = problem(ContactModel::Wrench, vec![foot("chest", "stand"), second]);
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
    for (link, contact, kind, expected) in [
        (
            "chst",
            "stand",
            ContactModel::Wrench,
            "base.foot \"chst\": link: \"chst\" is not a link of the URDF; did you mean \"chest\"?",
        ),
        (
            "chest",
            "stnd",
            ContactModel::Wrench,
            "contact = \"stnd\" is not a contact; did you mean \"stand\"?",
        ),
        (
            "chest",
            "hand",
            ContactModel::Wrench,
            "must be on the same link and of kind \"wrench\"",
        ),
        (
            "chest",
            "stand",
            ContactModel::Force,
            "must be on the same link and of kind \"wrench\"",
        ),
    ] {
        let problem = problem(kind, vec![foot(link, contact)]);
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
}

#[test]
fn the_plan_states_how_many_parameters_each_sensor_can_identify() {
    use proprio_estimator::config::{Base, Occurrence};
    let possible = |config: &mut Config| {
        for contact in &mut config.contact {
            contact.presence = Occurrence::Possible;
        }
    };
    // Four links and three revolute joints above the sensor, five and four beyond it; each joint
    // hides three directions.
    let text = setup(possible).to_string();
    for expected in [
        "31 independent combinations of its 40 inertial parameters can be identified",
        "38 independent combinations of its 50 inertial parameters can be identified",
    ] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
    // The unknown wrench of an always present contact absorbs the effect of all parameters.
    let text = setup(|_| {}).to_string();
    for contact in ["stand", "hand"] {
        let expected =
            format!("none of its inertial parameters can be identified while {contact} is present");
        assert!(text.contains(&expected), "{expected}:\n{text}");
    }
    // So does the ground reaction of a fixed base; and a locked joint joins two bodies.
    let less = setup(|config| {
        possible(config);
        config.base = Base::Fixed {
            link: "chest".into(),
            gravity_mps2: [0.0, 0.0, -9.80665],
        };
        config.locked.insert("l_wrist_yaw".into(), 0.3);
    });
    let text = less.to_string();
    for expected in [
        "none of its inertial parameters can be identified while the support of the base is \
         present",
        "31 independent combinations of its 50 inertial parameters can be identified",
    ] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
}

#[test]
fn a_torque_that_is_too_uncertain_is_withheld() {
    let estimate = |bound| {
        let setup = setup(|config| config.output.max_torque_std_nm = Some(bound));
        let events = recording(&setup, 0.2);
        run(setup, &events).0.pop().unwrap()
    };
    let wide = estimate(1.0);
    let deviations: Vec<f64> = wide
        .torques
        .joints()
        .iter()
        .map(|j| j.standard_deviation)
        .collect();
    assert!(
        wide.torques.joints().iter().all(|j| j.valid == 1),
        "{deviations:?}"
    );
    // A bound between the smallest and the largest: some are withheld, and how uncertain they are
    // is told.
    let greatest = deviations.iter().copied().fold(0.0, f64::max);
    let narrow = estimate(0.9 * greatest);
    assert!(narrow.torques.joints().iter().any(|j| j.valid == 1));
    for (joint, other) in narrow.torques.joints().iter().zip(wide.torques.joints()) {
        let (reason, torque) = if other.standard_deviation > 0.9 * greatest {
            (Reason::Uncertain, f64::NAN)
        } else {
            (Reason::None, other.torque)
        };
        assert_eq!(
            (
                joint.reason,
                joint.torque.to_bits(),
                joint.standard_deviation
            ),
            (
                reason.in_memory(),
                torque.to_bits(),
                other.standard_deviation
            )
        );
    }
}

/// The hand's contact is possible but not declared; the arm's parameters are exact.
fn possible_hand_contact(config: &mut Config) {
    config.identification.urdf_relative_std = 0.0;
    let hand = config
        .contact
        .iter_mut()
        .find(|contact| contact.name() == "hand");
    hand.unwrap().presence = Occurrence::Possible;
}

/// The estimates of a golden log, with `add(row)` added to the F/T reading of each row [N, Nm].
fn estimates_with_added(
    change: impl FnOnce(&mut Config),
    name: &str,
    add: impl Fn(usize) -> [f64; 6],
) -> HashMap<String, Vec<String>> {
    estimates_of(change, &golden(name), add)
}

/// The same of a log.
fn estimates_of(
    change: impl FnOnce(&mut Config),
    log: &str,
    add: impl Fn(usize) -> [f64; 6],
) -> HashMap<String, Vec<String>> {
    let mut rows = log
        .lines()
        .map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
    let header = rows.next().unwrap();
    let first = header
        .iter()
        .position(|c| c == "wrench/l_arm_ft_sensor/fx")
        .unwrap();
    let mut text = header.join(",") + "\n";
    for (number, mut row) in rows.enumerate() {
        for (cell, more) in row[first..first + 6].iter_mut().zip(add(number)) {
            *cell = (cell.parse::<f64>().unwrap() + more).to_string();
        }
        text += &(row.join(",") + "\n");
    }
    let mut out = Vec::new();
    offline::estimate(setup(change), text.as_bytes(), &mut out, None).unwrap();
    table(std::str::from_utf8(&out).unwrap())
}

/// The columns of the log of a pushed hand, and the rows of a free and of a pushed hand in them.
fn free_and_pushed() -> (String, Vec<String>, Vec<String>) {
    let free = golden("icub_left_arm_mujoco.csv");
    let pushed = golden("icub_left_arm_mujoco_contact.csv");
    let (header, pushed) = pushed.split_once('\n').unwrap();
    // It has the same columns, and those of the push.
    let more = header.split(',').count() - free.lines().next().unwrap().split(',').count();
    assert!(header.starts_with(free.lines().next().unwrap()));
    let free = free
        .lines()
        .skip(1)
        .map(|line| line.to_owned() + &",".repeat(more));
    let pushed = pushed.lines().map(str::to_owned);
    (header.to_owned(), free.collect(), pushed.collect())
}

/// A log of parts, each of which is so much later than its own times \[s\].
fn joined(header: &str, parts: &[(&[String], f64)]) -> String {
    let mut log = header.to_owned() + "\n";
    for (rows, later) in parts {
        for row in *rows {
            let (t, rest) = row.split_once(',').unwrap();
            log += &format!("{},{rest}\n", t.parse::<f64>().unwrap() + later);
        }
    }
    log
}

/// MuJoCo pushes the hand without a declaration: torques and wrench are the same as with one.
#[test]
fn an_undeclared_contact_is_detected() {
    // First without a contact, so that the setup is confirmed; a minute later with one.
    let (header, free, pushed) = free_and_pushed();
    let count_free = free.len();
    let log = joined(&header, &[(&free, 0.0), (&pushed, 60.0)]);
    let found = estimates_of(possible_hand_contact, &log, |_| [0.0; 6]);
    let told = estimates_of(
        |config| {
            possible_hand_contact(config);
            config.contact.last_mut().unwrap().presence = Occurrence::Always;
        },
        &log,
        |_| [0.0; 6],
    );
    // Where the force is small but the moment is 0.5 Nm, it is not a contact of the hand.
    let is_found: Vec<bool> = found["contact/hand/detected"]
        .iter()
        .map(|d| d == "1")
        .collect();
    let (before, after) = is_found.split_at(count_free);
    let [before, after] = [before, after].map(|of| of.iter().filter(|found| **found).count());
    assert!(before == 0 && after > 190, "{before} {after}");
    for (name, cells) in &told {
        // Standard deviations are those of the posture in which contacts changed.
        if name.starts_with("residual/") || name.contains("_std") || name == "contact/hand/detected"
        {
            continue;
        }
        let pairs = cells.iter().zip(&found[name]).zip(&is_found);
        for ((told, found), is_found) in pairs {
            assert!(!is_found || told == found, "{name}: {told} {found}");
        }
    }
    assert!(told["contact/hand/detected"].iter().all(|d| d == "0"));
    let names = found["residual/l_upper_arm/reason"].iter().zip(&is_found);
    assert!(
        names
            .skip(count_free)
            .all(|(name, is_found)| name == if *is_found { "hand" } else { "unexplained" })
    );
    // The residual has a significance where it can be tested, and none elsewhere.
    let stds = found["contact/hand/fx_std"].iter();
    assert!(
        stds.zip(&is_found)
            .all(|(std, is_found)| std.is_empty() != *is_found)
    );
    assert!(
        told["residual/l_upper_arm/significance"]
            .iter()
            .all(String::is_empty)
    );
    assert!(
        found["residual/chest/significance"]
            .iter()
            .all(String::is_empty)
    );
}

/// A contact that was there before an encoder failed may still be there after it: torques rest on
/// the reading until the residual has been plausible for two seconds.
#[test]
fn a_contact_may_be_there_after_a_fault() {
    let (header, free, mut pushed) = free_and_pushed();
    let mut columns = header.split(',');
    let at = (columns.position(|name| name == "joint/l_elbow/position")).unwrap();
    // The last five of ten seconds; at the end of the first five the push is detected.
    for row in &mut pushed[101..] {
        let mut cells: Vec<&str> = row.split(',').collect();
        cells[at..at + 4].fill("");
        *row = cells.join(",");
    }
    let log = joined(&header, &[(&free, 0.0), (&pushed, 60.0), (&free, 71.0)]);
    let found = estimates_of(possible_hand_contact, &log, |_| [0.0; 6]);
    let (during, after) = (free.len() + 150, free.len() + pushed.len());
    assert_eq!(found["contact/hand/detected"][free.len() + 100], "1");
    assert_eq!(found["reason/l_wrist_yaw"][during], "stale:l_elbow");
    let std = |row: usize| found["torque_std/l_elbow"][row].parse::<f64>().unwrap();
    // The same motion as at first, row by row. The reading is better than the arm's model.
    assert!((5..35).all(|row| std(after + row) < 0.75 * std(row)));
    assert!((45..200).all(|row| (std(after + row) / std(row) - 1.0).abs() < 0.01));
}

#[test]
fn nothing_is_detected_without_a_disturbance() {
    for urdf_relative_std in [0.0, 0.2] {
        let change = |config: &mut Config| {
            possible_hand_contact(config);
            config.identification.urdf_relative_std = urdf_relative_std;
        };
        let found = estimates_with_added(change, "icub_left_arm_mujoco.csv", |_| [0.0; 6]);
        assert!(
            found["residual/l_upper_arm/reason"]
                .iter()
                .all(String::is_empty)
        );
        let significance = &found["residual/l_upper_arm/significance"];
        assert!(significance.iter().all(|s| s.parse::<f64>().unwrap() < 0.0));
        assert!(found["contact/hand/detected"].iter().all(|d| d == "0"));
    }
}

/// A moment without a force is not a contact of the hand, and neither is a force far from it. The
/// place where it acts is unknown.
#[test]
fn an_unexplained_residual_withholds_the_torques_of_its_sub_tree() {
    let push = |number: usize| {
        if (50..100).contains(&number) {
            1.0
        } else {
            0.0
        }
    };
    for far in [
        [0.0, 0.0, 0.0, 0.0, 8.0, 0.0],
        [0.0, 100.0, 0.0, 0.0, 0.0, 0.0],
    ] {
        let found = estimates_with_added(possible_hand_contact, "icub_left_arm_mujoco.csv", |n| {
            far.map(|x| x * push(n))
        });
        for (joint, sees) in [
            ("l_elbow", true),
            ("l_wrist_yaw", true),
            ("l_shoulder_roll", false),
        ] {
            let column = |what: &str| &found[&format!("{what}/{joint}")];
            for (number, (reason, valid)) in
                column("reason").iter().zip(column("valid")).enumerate()
            {
                // A reading that jumps is not believed before the next one.
                if matches!(number, 50 | 100) {
                    continue;
                }
                let is_pushed = sees && push(number) > 0.0;
                let expected = if is_pushed {
                    ("unexplained", "0")
                } else {
                    ("", "1")
                };
                assert_eq!(
                    (reason.as_str(), valid.as_str()),
                    expected,
                    "{joint} {number} {far:?}"
                );
            }
        }
        let told = |number: usize| found["residual/l_upper_arm/reason"][number].as_str();
        let expected = |n: usize| if push(n) > 0.0 { "unexplained" } else { "" };
        assert!((0..201).all(|n| matches!(n, 50 | 100) || told(n) == expected(n)));
        // The residual is the added wrench, with opposite sign: it acts from parent to child.
        let force: f64 = ["fx", "fy", "fz"]
            .map(|axis| {
                found[&format!("residual/l_upper_arm/{axis}")][60]
                    .parse::<f64>()
                    .unwrap()
                    .powi(2)
            })
            .iter()
            .sum();
        assert!((force.sqrt() - far[1]).abs() < 1e-6);
    }
}

/// The hand is touched at a point by declaration. A torque that no force at that point explains
/// makes the wrench of that contact invalid, too.
#[test]
fn an_unexplained_residual_withholds_the_wrench_of_a_known_contact() {
    let touched = |config: &mut Config| {
        config.identification.urdf_relative_std = 0.0;
        let hand = config.contact.iter_mut().find(|c| c.name() == "hand");
        let hand = hand.unwrap();
        (hand.kind, hand.presence) = (ContactModel::Force, Occurrence::Always);
    };
    let found = estimates_with_added(touched, "icub_left_arm_mujoco.csv", |number| {
        let torque = if (50..100).contains(&number) {
            8.0
        } else {
            0.0
        };
        [0.0, 0.0, 0.0, 0.0, torque, torque]
    });
    for (number, reason) in found["contact/hand/reason"].iter().enumerate() {
        let expected = match number {
            // A reading that jumps is not believed before the next one.
            50 | 100 => "implausible:l_arm_ft_sensor",
            51..100 => "unexplained",
            _ => "",
        };
        assert_eq!(reason, expected, "{number}");
    }
}

/// A small force is below the noise of one reading, but significant in the mean of many. It is no
/// longer reported after it ends.
#[test]
fn the_mean_shows_a_force_below_the_noise_of_one_reading() {
    let noisy = |config: &mut Config| {
        possible_hand_contact(config);
        config.force_torque[0].noise_n = [1.0; 3];
        config.force_torque[0].noise_nm = [0.1; 3];
        config.output.max_wait_ms = Some(20.0);
    };
    let setup = setup(noisy);
    let events = recording(&setup, 0.9);
    let hand = setup.robot.contact("hand").unwrap();
    let (from, to) = (Nanos::from_millis(400), Nanos::from_millis(700));
    let detected = |force: f64| {
        let mut pipeline = Pipeline::new(setup.clone());
        let mut found = Vec::new();
        for (channel, t, reading, quality) in &events {
            let mut reading = *reading;
            if let Reading::Wrench(wrench) = &mut reading
                && (from..to).contains(t)
            {
                wrench.force[0] += force;
            }
            pipeline.push(*channel, *t, &reading, *quality);
            while let Some(estimate) = pipeline.poll() {
                let residuals = estimate.contacts.residuals();
                let is_seen = residuals
                    .iter()
                    .any(|r| r.unexplained == 1 || r.contact == hand as u32);
                found.push((estimate.t, is_seen));
            }
        }
        found
    };
    // 2.5 standard deviations of one reading, and many more of the mean of some 50.
    let found = detected(2.5);
    let first = found.iter().find(|(_, seen)| *seen).expect("it is seen").0;
    let last = found.iter().rev().find(|(_, seen)| *seen).unwrap().0;
    assert!(
        first > from + Nanos::from_millis(2) && first < from + Nanos::from_millis(60),
        "{first}"
    );
    assert!(last > to && last < to + Nanos::from_millis(150), "{last}");
    // Ten standard deviations are significant at once.
    let found = detected(10.0);
    let first = found.iter().find(|(_, seen)| *seen).expect("it is seen").0;
    assert!(
        first >= from && first < from + Nanos::from_millis(2),
        "{first}"
    );
}

/// An offset that is neither configured nor identified is unknown: its residual is never
/// significant, and the torques that depend on it are not valid.
#[test]
fn an_offset_that_is_not_configured_is_unknown() {
    let unknown = |config: &mut Config| {
        possible_hand_contact(config);
        (
            config.force_torque[0].offset_n,
            config.force_torque[0].offset_nm,
        ) = (None, None);
    };
    let found = estimates_with_added(unknown, "icub_left_arm_mujoco.csv", |_| {
        [100.0, -50.0, 20.0, 3.0, -2.0, 1.0]
    });
    assert!(
        found["residual/l_upper_arm/reason"]
            .iter()
            .all(String::is_empty)
    );
    for (joint, reason) in [("l_shoulder_roll", "uncertain"), ("l_elbow", "")] {
        assert!(
            found[&format!("reason/{joint}")]
                .iter()
                .all(|own| own == reason),
            "{joint}"
        );
    }
    let std = |joint: &str| {
        found[&format!("torque_std/{joint}")][0]
            .parse::<f64>()
            .unwrap()
    };
    assert!(std("l_shoulder_roll") > 100.0 && std("l_elbow") < 0.1);
}

/// Estimates of `events` that do not wait: each is made when its trigger sample arrives.
fn run_immediate(change: impl FnOnce(&mut Config), events: &[Event]) -> (Vec<Estimate>, Pipeline) {
    let setup = setup(|config| {
        config.output.max_wait_ms = None;
        config.output.max_torque_std_nm = Some(1000.0);
        change(config);
    });
    let trigger = setup.robot.trigger;
    let mut pipeline = Pipeline::new(setup);
    let mut estimates = vec![];
    for (channel, t, reading, quality) in events {
        pipeline.push(*channel, *t, reading, *quality);
        let estimate = pipeline.poll().cloned();
        assert_eq!(
            estimate.as_ref().map(|e| e.t),
            (*channel == trigger).then_some(*t)
        );
        estimates.extend(estimate);
        assert!(pipeline.poll().is_none());
    }
    (estimates, pipeline)
}

/// Per torque, the RMS difference of two series of estimates after the first 0.1 s, and the share
/// within two deviations of the first.
fn difference(a: &[Estimate], b: &[Estimate]) -> (f64, f64) {
    let (mut square, mut within, mut count) = (0.0, 0.0, 0.0);
    for (a, b) in a
        .iter()
        .zip(b)
        .filter(|(a, _)| a.t > Nanos::from_millis(100))
    {
        assert_eq!(a.t, b.t);
        for (a, b) in a.torques.joints().iter().zip(b.torques.joints()) {
            let error = a.torque - b.torque;
            square += error * error;
            within += f64::from(u8::from(error.abs() <= 2.0 * a.standard_deviation));
            count += 1.0;
        }
    }
    (f64::sqrt(square / count), within / count)
}

/// Noise of unit variance, uniformly distributed.
fn noise_of(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5) * f64::sqrt(12.0)
    }
}

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
        let valid = |j: &&proprio_topics::JointTorque| j.valid == 1;
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
