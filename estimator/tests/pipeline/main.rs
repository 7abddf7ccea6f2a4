//! The pipeline on a robot for which three other libraries agree, and its rules: estimates depend
//! on stamps alone (immediate ones on the order of arrival), a missing channel affects only the
//! estimates that depend on it, and bad samples are counted and affect nothing else.

mod arrival;
mod calibration;
mod configuration;
mod contacts;
mod immediate;

use proprio_dynamics::calibration::Calibration;
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame};
use proprio_dynamics::spatial::Wrench as Wrench6;
use proprio_estimator::config::{Config, ContactModel, Occurrence};
use proprio_estimator::offline;
use proprio_estimator::pipeline::{Estimate, Pipeline};
use proprio_estimator::setup::Setup;
use proprio_topics::csv::{Row, SeriesKind, TableReader, Value};
use proprio_topics::{
    ContactState, JointState, JointTorque, Kind, Nanos, Quality, Reading, Reason, Wrench,
};
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

fn temperature(celsius: f64) -> Reading {
    Reading::Temperature(proprio_topics::Temperature { celsius })
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
    let channel = |s: &proprio_topics::csv::Series| match s.kind {
        SeriesKind::Channel(kind) => setup.robot.channel(kind, &s.name),
        SeriesKind::Contact => None,
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
    let joint = |j: &JointTorque| {
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
