//! Evaluates identification on sessions that MuJoCo simulated and noisy boards recorded
//! (`tests/oracle/sessions.py`), with the true torques.
//!
//! First it checks the sessions themselves: without noise the estimator with the true URDF gives
//! MuJoCo's torques and pushes, so every frame, sign and unit agrees. With noise it gives them to
//! the accuracy of the noise; with the URDF that is 20 % wrong it is far from that.
//!
//! The arm's sessions are always used. An iCub's sessions are used if they exist: in
//! `icub_sessions` next to the URDF in `PROPRIO_ICUB_MODELS` (`tests/oracle/README.md` describes
//! how to make them).

use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::Wrench;
use proprio_estimator::assessment::{Assessment, Assessor, Coverage};
use proprio_estimator::config::{Config, ForceTorque, Occurrence};
use proprio_estimator::export::parameters;
use proprio_estimator::offline::estimate;
use proprio_estimator::parameters::{Offset, Parameters, Provenance};
use proprio_estimator::pipeline::{Estimate, Job, Pipeline};
use proprio_estimator::setup::Setup;
use proprio_estimator::{files, reading};
use proprio_identification::online::{DetectedChange, ObservationCounts, Paused};
use proprio_identification::{FindingCode, LogRole, Outcome, Severity, Verdict, identify};
use proprio_topics::csv::{Row, SeriesValue, TableReader, Value, What};
use proprio_topics::{InertiaEstimate, Nanos, Quality, Reading};
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

const WRENCH: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];

/// The noise of an iCub arm's strain board and the board's step: `[fx fy fz tx ty tz]` [N, Nm].
const NOISE: [f64; 6] = [0.0760, 0.0894, 0.1794, 0.00194, 0.00286, 0.00143];
const STEP: [f64; 6] = [
    1804.0 / 32768.0,
    1804.0 / 32768.0,
    1804.0 / 32768.0,
    31.0 / 32768.0,
    31.0 / 32768.0,
    31.0 / 32768.0,
];

/// One robot's sessions.
struct Sessions {
    folder: PathBuf,
    /// The URDF that MuJoCo simulated.
    urdf: PathBuf,
    facts: Json,
    /// Joints beyond an F/T sensor, from the body: their torques depend only on readings and on
    /// identifiable links.
    distal: Vec<&'static str>,
    /// With noise and exact parameters, torques are this near, relative to their RMS. An iCub's
    /// model has links with 0.01 kg m^2 about every axis (for the stability of a simulator), so
    /// errors of the accelerations matter there.
    near: f64,
    /// With noise, the CAD's errors are at least this many times larger, in every joint of
    /// `distal`.
    cad_further: f64,
    /// It stands on a foot that never turns: the weight of that leg and the offset of the foot's
    /// sensor are not separable without the CAD.
    stands: bool,
}

fn arm() -> Sessions {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let distal = vec!["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"];
    Sessions::new(
        here.join("oracle/sessions"),
        here.join("../config/icub_left_arm/model.urdf"),
        distal,
        (0.03, 7.5),
    )
}

fn icub() -> Option<Sessions> {
    let Some(models) = std::env::var_os("PROPRIO_ICUB_MODELS") else {
        println!("skipped: PROPRIO_ICUB_MODELS does not say where iCubGazeboV2_5.urdf is");
        return None;
    };
    let folder = Path::new(&models).join("icub_sessions");
    if !folder.is_dir() {
        println!("skipped: there is no {}", folder.display());
        return None;
    }
    let distal = vec![
        "l_elbow",
        "l_wrist_prosup",
        "l_wrist_pitch",
        "l_wrist_yaw",
        "r_elbow",
        "r_wrist_prosup",
        "r_wrist_pitch",
        "r_wrist_yaw",
        "r_hip_yaw",
        "r_knee",
        "r_ankle_pitch",
        "r_ankle_roll",
    ];
    let urdf = Path::new(&models).join("iCubGazeboV2_5.urdf");
    Some(Sessions {
        stands: true,
        ..Sessions::new(folder, urdf, distal, (0.15, 1.5))
    })
}

/// The robots whose sessions are available.
fn robots() -> Vec<Sessions> {
    std::iter::once(arm()).chain(icub()).collect()
}

/// The estimator's URDF.
#[derive(Clone, Copy, PartialEq)]
enum Urdf {
    True,
    /// 20 % off.
    Cad,
}

impl Sessions {
    fn new(
        folder: PathBuf,
        urdf: PathBuf,
        distal: Vec<&'static str>,
        (near, cad_further): (f64, f64),
    ) -> Self {
        let facts = serde_json::from_str(&read(&folder.join("sessions.json"))).unwrap();
        Self {
            folder,
            urdf,
            facts,
            distal,
            near,
            cad_further,
            stands: false,
        }
    }

    fn log(&self, name: &str) -> String {
        read(&self.folder.join(format!("{name}.csv")))
    }

    /// With the F/T offsets in the middle of a session's drift, if a session is named. The hand is
    /// touched only if declared.
    fn setup(&self, urdf: Urdf, offsets_of: Option<&str>) -> Setup {
        self.setup_for(Occurrence::Possible, urdf, offsets_of)
    }

    /// The same, but the hand may always be touched: torques beyond the sensor depend on its
    /// reading.
    fn setup_touched(&self, urdf: Urdf, offsets_of: Option<&str>) -> Setup {
        self.setup_for(Occurrence::Always, urdf, offsets_of)
    }

    fn setup_for(&self, hand: Occurrence, urdf: Urdf, offsets_of: Option<&str>) -> Setup {
        Setup::new(&self.config(hand, urdf, offsets_of)).unwrap()
    }

    fn config(&self, hand: Occurrence, urdf: Urdf, offsets_of: Option<&str>) -> Config {
        let mut config = Config::load(&self.folder.join("estimator.toml")).unwrap();
        config.contact.last_mut().expect("the hand").presence = hand;
        // Errors are measured here, however large: no torque is withheld as uncertain.
        config.output.max_torque_std_nm = Some(1e6);
        if urdf == Urdf::True {
            config.model.clone_from(&self.urdf);
            // Its parameters are exact: the stated standard deviations contain only the sensors'
            // noise.
            config.identification.urdf_relative_std = 0.0;
        }
        if let Some(name) = offsets_of {
            let offsets = &self.facts["sessions"][name]["offsets"];
            for ForceTorque {
                sensor,
                offset_n,
                offset_nm,
                ..
            } in &mut config.force_torque
            {
                let [start, end] =
                    ["start", "end"].map(|when| numbers(&offsets[sensor.as_str()][when]));
                let middle: Vec<f64> = start.iter().zip(end).map(|(a, b)| 0.5 * (a + b)).collect();
                let three = |of: &[f64]| of.try_into().ok();
                (*offset_n, *offset_nm) = (three(&middle[..3]), three(&middle[3..]));
            }
        }
        config
    }

    /// Start of the motion and end of a session [s].
    fn moving(&self, name: &str) -> (f64, f64) {
        let facts = &self.facts["sessions"][name];
        (
            facts["still_until"].as_f64().unwrap(),
            facts["seconds"].as_f64().unwrap(),
        )
    }

    /// Beginnings and ends of a session's pushes [s].
    fn pushes(&self, name: &str) -> Vec<(f64, f64)> {
        let pushes = self.facts["sessions"][name]["pushes"]
            .as_array()
            .expect("a list");
        pushes
            .iter()
            .map(|push| (push["from"].as_f64().unwrap(), push["to"].as_f64().unwrap()))
            .collect()
    }
}

fn read(file: &Path) -> String {
    fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()))
}

fn numbers(list: &Json) -> Vec<f64> {
    let list = list.as_array().expect("a list");
    list.iter().map(|x| x.as_f64().expect("a number")).collect()
}

/// A table by column; NaN for empty cells and text.
struct Table(BTreeMap<String, Vec<f64>>);

impl Table {
    fn new(text: &str) -> Self {
        let mut lines = text.lines().map(|line| line.split(','));
        let names: Vec<&str> = lines.next().expect("a header").collect();
        let mut columns = vec![vec![]; names.len()];
        for cells in lines {
            for (column, cell) in columns.iter_mut().zip(cells) {
                column.push(cell.parse().unwrap_or(f64::NAN));
            }
        }
        assert!(
            columns
                .iter()
                .all(|column| column.len() == columns[0].len())
        );
        Self(names.into_iter().map(str::to_owned).zip(columns).collect())
    }

    fn column(&self, name: &str) -> &[f64] {
        self.0
            .get(name)
            .unwrap_or_else(|| panic!("no column {name}"))
    }

    /// The rows of this table at each of `stamps`, in hundredths of a millisecond, the resolution
    /// of the logs.
    fn rows_at(&self, stamps: &[f64]) -> Vec<usize> {
        let tick = |t: f64| (t * 1e5).round() as i64;
        let own: BTreeMap<i64, usize> = self
            .column("t")
            .iter()
            .enumerate()
            .map(|(row, t)| (tick(*t), row))
            .collect();
        stamps.iter().map(|t| own[&tick(*t)]).collect()
    }

    /// The rows with a value in column `name`.
    fn rows_with(&self, name: &str) -> Vec<usize> {
        let column = self.column(name);
        (0..column.len())
            .filter(|row| !column[*row].is_nan())
            .collect()
    }
}

fn estimates(setup: Setup, log: &str) -> Table {
    let mut out = Vec::new();
    estimate(setup, log.as_bytes(), &mut out, None).unwrap();
    Table::new(&String::from_utf8(out).unwrap())
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0_f64);
    for value in values {
        assert!(!value.is_nan());
        sum += value * value;
        count += 1.0;
    }
    assert!(count > 0.0);
    (sum / count).sqrt()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The errors of the torques of one joint.
struct Score {
    /// RMS of the error [Nm].
    error: f64,
    /// RMS of the true torque [Nm].
    size: f64,
    /// The median of the stated standard deviation [Nm]; NaN if none is stated.
    stated: f64,
    /// The fraction of errors within 1.96 standard deviations.
    covered: f64,
}

impl Score {
    /// The score of a joint's torque in the given rows of the tables of truth and estimates.
    fn new(truth: &Table, rows: &[usize], told: &Table, own: &[usize], joint: &str) -> Self {
        let tau = truth.column(&format!("joint/{joint}/torque"));
        let [hat, stated] =
            ["torque", "torque_std"].map(|what| told.column(&format!("{what}/{joint}")));
        let pairs = || rows.iter().zip(own);
        let within =
            |(row, own): &(&usize, &usize)| (hat[**own] - tau[**row]).abs() < 1.96 * stated[**own];
        Self {
            error: rms(pairs().map(|(row, own)| hat[*own] - tau[*row])),
            size: rms(rows.iter().map(|row| tau[*row])),
            stated: median(own.iter().map(|own| stated[*own]).collect()),
            covered: pairs().filter(within).count() as f64 / rows.len() as f64,
        }
    }
}

/// Scores of every joint over the instants of a session that have a truth and for which `counts` is
/// true. The robot moves; the last half second, without later samples, is excluded.
fn scores(
    sessions: &Sessions,
    name: &str,
    log: &str,
    setup: Setup,
    counts: impl Fn(f64) -> bool,
) -> BTreeMap<String, Score> {
    let joints: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
    let (truth, told) = (Table::new(log), estimates(setup, log));
    let (begin, end) = sessions.moving(name);
    let stamps = truth.column("t");
    let rows: Vec<usize> = truth
        .rows_with(&format!("joint/{}/torque", joints[0]))
        .into_iter()
        .filter(|row| stamps[*row] > begin && stamps[*row] < end - 0.5 && counts(stamps[*row]))
        .collect();
    assert!(rows.len() > 30, "{name}: only {} instants", rows.len());
    let own = told.rows_at(&rows.iter().map(|row| stamps[*row]).collect::<Vec<_>>());
    let score = |joint: &String| (joint.clone(), Score::new(&truth, &rows, &told, &own, joint));
    joints.iter().map(score).collect()
}

/// Without the column that declares contacts.
fn undeclared(log: &str) -> String {
    let header = log.lines().next().expect("a header");
    let gone = header
        .split(',')
        .position(|name| name.ends_with("/active"))
        .expect("declared contacts");
    let keep = |line: &str| {
        let cells = line.split(',').enumerate().filter(|(at, _)| *at != gone);
        cells.map(|(_, cell)| cell).collect::<Vec<_>>().join(",")
    };
    log.lines().map(|line| keep(line) + "\n").collect()
}

#[test]
fn without_noise_the_torques_are_those_of_mujoco() {
    for sessions in robots() {
        let log = sessions.log("exact");
        let setup = sessions.setup(Urdf::True, None);
        let joints: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
        let (truth, told) = (Table::new(&log), estimates(setup, &log));
        assert!(told.column("t").len() == truth.column("t").len() && truth.column("t").len() >= 18);
        for joint in &joints {
            let (tau, hat) = (
                truth.column(&format!("joint/{joint}/torque")),
                told.column(&format!("torque/{joint}")),
            );
            let size = tau.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            for (row, (tau, hat)) in tau.iter().zip(hat).enumerate() {
                assert!(
                    (tau - hat).abs() < 1e-9 * size.max(1.0),
                    "{joint}, row {row}: {hat}, not {tau}"
                );
            }
        }
        let pushed: Vec<usize> = truth
            .rows_with("contact/hand/fx")
            .into_iter()
            .filter(|row| truth.column("contact/hand/active")[*row] == 1.0)
            .collect();
        assert!(pushed.len() >= 5);
        for part in WRENCH.map(|part| format!("contact/hand/{part}")) {
            for row in &pushed {
                let (true_one, estimated) = (truth.column(&part)[*row], told.column(&part)[*row]);
                assert!(
                    (true_one - estimated).abs() < 1e-9 * 10.0,
                    "{part}, row {row}: {estimated}, not {true_one}"
                );
            }
        }
    }
}

#[test]
fn with_noise_the_true_urdf_is_as_near_as_noise_explains_and_cad_is_not() {
    for sessions in robots() {
        let own = |name: &str, urdf, log: &str, counts: &dyn Fn(f64) -> bool| {
            scores(
                &sessions,
                name,
                log,
                sessions.setup(urdf, Some(name)),
                counts,
            )
        };
        for name in ["train", "validate"] {
            let log = sessions.log(name);
            let [exact, cad] = [Urdf::True, Urdf::Cad].map(|urdf| own(name, urdf, &log, &|_| true));
            for (joint, score) in &exact {
                let Score {
                    error,
                    size,
                    stated,
                    ..
                } = score;
                if sessions.distal.contains(&joint.as_str()) {
                    println!(
                        "{name} {joint}: {error:.4} Nm of {size:.3}, CAD {:.4}",
                        cad[joint].error
                    );
                    // Nothing touches the links beyond them: their accuracy is that of the motion.
                    assert!(
                        *error < sessions.near * size,
                        "{name} {joint}: {error} of {size}"
                    );
                    let further = cad[joint].error / error;
                    assert!(
                        further > sessions.cad_further,
                        "{name} {joint}: CAD {further} times further off"
                    );
                } else {
                    // From the sensor's reading, whose offset drifts by some tenths of a newton.
                    // The stated deviation contains only the sensors' noise.
                    let near = (3.0 * stated).max(if sessions.near > 0.1 {
                        sessions.near * size
                    } else {
                        0.0
                    });
                    assert!(
                        *error < near,
                        "{name} {joint}: {error} of {size}, stated {stated}"
                    );
                }
            }
        }
    }
}

#[test]
fn with_noise_and_the_hand_touched_torques_rest_on_the_reading() {
    for sessions in robots() {
        let log = sessions.log("validate");
        let run = |urdf| {
            let setup = sessions.setup_touched(urdf, Some("validate"));
            scores(&sessions, "validate", &log, setup, |_| true)
        };
        let (exact, cad) = (run(Urdf::True), run(Urdf::Cad));
        for joint in ["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"] {
            let Score { error, stated, .. } = &exact[joint];
            println!(
                "{joint}: {error:.4} Nm, stated {stated:.4}, CAD {:.4}",
                cad[joint].error
            );
            assert!(*error < 3.0 * stated, "{joint}: {error}, stated {stated}");
            let further = cad[joint].error / error;
            assert!(
                further > sessions.cad_further,
                "{joint}: CAD {further} times further off"
            );
        }
    }
}

#[test]
fn a_push_at_the_hand_is_told_where_it_is_declared() {
    for sessions in robots() {
        let (log, pushes) = (sessions.log("contact"), sessions.pushes("contact"));
        assert!(pushes.len() >= 3);
        let at = |t: f64| {
            pushes
                .iter()
                .any(|(from, to)| t > from + 0.2 && t < to - 0.2)
        };
        let run = |urdf, log: &str| {
            scores(
                &sessions,
                "contact",
                log,
                sessions.setup(urdf, Some("contact")),
                at,
            )
        };
        let (declared, hidden) = (run(Urdf::True, &log), run(Urdf::True, &undeclared(&log)));
        for joint in ["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"] {
            let Score { error, stated, .. } = &declared[joint];
            println!(
                "{joint}: {error:.4} Nm, stated {stated:.4}, undeclared {:.4}",
                hidden[joint].error
            );
            assert!(error < &(2.0 * stated), "{joint}: {error}, stated {stated}");
        }
        // An undeclared push is detected.
        assert!(hidden["l_elbow"].error < 1.1 * declared["l_elbow"].error);
    }
}

#[test]
fn a_standing_robots_readings_have_the_noise_of_its_board() {
    for sessions in robots() {
        let log = Table::new(&sessions.log("train"));
        let (until, _) = sessions.moving("train");
        for sensor in sessions.facts["sessions"]["train"]["offsets"]
            .as_object()
            .unwrap()
            .keys()
        {
            for (channel, part) in WRENCH.iter().enumerate() {
                let name = format!("wrench/{sensor}/{part}");
                let rows = log.rows_with(&name);
                let still: Vec<f64> = rows
                    .into_iter()
                    .filter(|row| log.column("t")[*row] < until)
                    .map(|row| log.column(&name)[row])
                    .collect();
                // Differences of neighbouring samples do not contain the drift.
                let found = rms(still.windows(2).map(|two| two[1] - two[0])) / 2.0_f64.sqrt();
                let expected = NOISE[channel].hypot(STEP[channel] / 12.0_f64.sqrt());
                // 250 values or more: a standard error of 5.5 %.
                assert!(
                    (found / expected - 1.0).abs() < 0.22,
                    "{name}: {found}, not {expected}"
                );
            }
        }
    }
}

#[test]
fn the_cad_is_a_fifth_off_in_every_link_and_physical() {
    for sessions in robots() {
        let load = |path: &Path| Model::from_file(path, &[]).unwrap();
        let (cad, truth) = (
            load(&sessions.folder.join("cad.urdf")),
            load(&sessions.urdf),
        );
        assert_eq!(cad.link_count(), truth.link_count());
        let mut off = vec![];
        for (wrong, right) in cad.inertias().iter().zip(truth.inertias()) {
            if right.mass > 0.0 {
                wrong.check(1e-9).unwrap();
                off.push((wrong.mass / right.mass - 1.0).abs());
            }
        }
        // Folded frames bring more than one link together: then some of it cancels.
        assert!(
            off.len() >= 8 && off.iter().all(|off| *off < 0.2001),
            "{off:?}"
        );
        assert!(
            off.iter().filter(|off| **off > 0.1999).count() >= 7,
            "{off:?}"
        );
    }
}

/// With on-line identification, and no knowledge of offsets and CAD at the start.
fn learning(sessions: &Sessions) -> Setup {
    let mut config = Config::load(&sessions.folder.join("estimator.toml")).unwrap();
    config.contact.last_mut().expect("the hand").presence = Occurrence::Possible;
    config.identification.enabled = true;
    Setup::new(&config).unwrap()
}

/// The ratio of the CAD's error (with known offsets) to the error of the torques beyond the sensor,
/// where `counts` is true: per joint and for all joints.
fn nearer(
    sessions: &Sessions,
    name: &str,
    log: &str,
    counts: impl Fn(f64) -> bool + Copy,
) -> (Vec<f64>, f64) {
    let learnt = scores(sessions, name, log, learning(sessions), counts);
    let cad = scores(
        sessions,
        name,
        log,
        sessions.setup(Urdf::Cad, Some(name)),
        counts,
    );
    let exact = scores(
        sessions,
        name,
        log,
        sessions.setup(Urdf::True, Some(name)),
        counts,
    );
    let ratio = |joint: &&str| {
        let Score {
            error,
            stated,
            covered,
            ..
        } = &learnt[*joint];
        println!(
            "{name} {joint}: {error:.4} Nm, stated {stated:.4} (95 % hold {:.0} %), CAD {:.4}, \
             exact parameters {:.4}",
            100.0 * covered,
            cad[*joint].error,
            exact[*joint].error
        );
        cad[*joint].error / error
    };
    let of_all = |scores: &BTreeMap<String, Score>| {
        rms(sessions.distal.iter().map(|joint| scores[*joint].error))
    };
    (
        sessions.distal.iter().map(ratio).collect(),
        of_all(&cad) / of_all(&learnt),
    )
}

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
                    let told = e.torques.joints()[number];
                    if told.valid == 1 && !tau.is_nan() {
                        errors.push(told.torque - tau);
                        within +=
                            usize::from((told.torque - tau).abs() < 2.0 * told.standard_deviation);
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

/// Estimates; since when what was said of the arm's identification; its counts at the end; what
/// changed.
type Told = (
    Vec<Estimate>,
    Vec<(f64, Paused)>,
    ObservationCounts,
    Vec<DetectedChange>,
);

/// What a pipeline told, and at which instants something was said of the arm's identification; its
/// jobs come back after so many estimates.
fn told(setup: Setup, log: &str, delay: usize) -> Told {
    told_by(setup, log, delay, &mut None)
}

/// The same; the pipeline is left in `end`.
fn told_by(setup: Setup, log: &str, delay: usize, end: &mut Option<Pipeline>) -> Told {
    *end = Some(Pipeline::new(setup));
    told_from(log, delay, end)
}

/// The same of a pipeline that is there.
fn told_from(log: &str, delay: usize, end: &mut Option<Pipeline>) -> Told {
    let mut pipeline = end.take().expect("a pipeline");
    assert!(pipeline.identification_refused().is_none());
    let mut reader = TableReader::new(log.as_bytes()).unwrap();
    let series: Vec<_> = reader
        .series()
        .iter()
        .map(|s| (s.what, s.name.clone()))
        .collect();
    let (mut row, mut job, mut age) = (Row::default(), None, 0);
    let (mut estimates, mut said, mut changes) = (vec![], vec![], vec![]);
    loop {
        let more = reader.next_row(&mut row).unwrap();
        if more {
            for SeriesValue {
                series: number,
                value,
            } in &row.items
            {
                let (t, (what, name)) = (row.t.unwrap(), &series[*number]);
                match (what, value) {
                    (What::Channel(kind), Value::Reading(reading, quality)) => {
                        if let Some(channel) = pipeline.setup().robot.channel(*kind, name) {
                            pipeline.push(channel, t, reading, *quality);
                        }
                    }
                    (What::Contact, Value::Contact(state)) => {
                        let contact = pipeline.setup().robot.contact(name).unwrap();
                        pipeline.declare(contact, t, state);
                    }
                    _ => {}
                }
            }
        } else {
            pipeline.finish();
        }
        while let Some(estimate) = pipeline.poll() {
            let t = estimate.t.seconds();
            estimates.push(estimate.clone());
            age += 1;
            if job.is_none() {
                job = pipeline.take_job();
                age = 0;
            }
            if let Some(mut done) = job.take_if(|_: &mut Job| age >= delay) {
                done.run();
                pipeline.give_back(done);
            }
            let online = pipeline.identification().unwrap();
            let (paused, counts) = online.state(0).unwrap();
            if said.last().is_none_or(|(_, last)| *last != paused) {
                said.push((t, paused));
            }
            if counts.changes as usize > changes.len() {
                changes.extend(online.last_change(0));
            }
        }
        if !more {
            let counts = pipeline.identification().unwrap().state(0).unwrap().1;
            *end = Some(pipeline);
            return (estimates, said, counts, changes);
        }
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
    let told = {
        let mut end = Some(resumed);
        told_from(&log, 0, &mut end).0
    };
    let errors: Vec<f64> = truth
        .rows_with(&format!("joint/{joint}/torque"))
        .into_iter()
        .filter_map(|row| {
            let t = truth.column("t")[row];
            let at = told.iter().find(|e| (e.t.seconds() - t).abs() < 1e-6)?;
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

/// What a pipeline identifies of a log, each time that it says so, and the instant of the estimate
/// after which it does; and its counts at the end. `alter` may change each channel's sample, or
/// keep it back.
fn inertias(
    setup: Setup,
    log: &str,
    alter: impl Fn(f64, &str, &mut Reading, &mut Quality) -> bool,
) -> (Vec<(Nanos, InertiaEstimate)>, ObservationCounts) {
    inertias_by(setup, log, alter, &mut None)
}

/// The same; the pipeline is left in `end`.
fn inertias_by(
    setup: Setup,
    log: &str,
    alter: impl Fn(f64, &str, &mut Reading, &mut Quality) -> bool,
    end: &mut Option<Pipeline>,
) -> (Vec<(Nanos, InertiaEstimate)>, ObservationCounts) {
    let mut pipeline = Pipeline::new(setup);
    let mut reader = TableReader::new(log.as_bytes()).unwrap();
    let series: Vec<_> = reader
        .series()
        .iter()
        .map(|s| (s.what, s.name.clone()))
        .collect();
    let (mut row, mut told) = (Row::default(), vec![]);
    while reader.next_row(&mut row).unwrap() {
        for SeriesValue {
            series: number,
            value,
        } in &row.items
        {
            let (what, name) = &series[*number];
            if let (What::Contact, Value::Contact(state)) = (what, value) {
                let contact = pipeline.setup().robot.contact(name).unwrap();
                pipeline.declare(contact, row.t.unwrap(), state);
            }
            if let (What::Channel(kind), Value::Reading(reading, quality)) = (what, value)
                && let Some(channel) = pipeline.setup().robot.channel(*kind, name)
            {
                let (t, mut reading, mut quality) = (row.t.unwrap(), *reading, *quality);
                if alter(t.seconds(), name, &mut reading, &mut quality) {
                    pipeline.push(channel, t, &reading, quality);
                }
            }
        }
        while let Some(estimate) = pipeline.poll() {
            let t = estimate.t;
            told.extend(pipeline.inertia().map(|inertia| (t, *inertia)));
            if let Some(mut job) = pipeline.take_job() {
                job.run();
                pipeline.give_back(job);
            }
        }
    }
    let counts = pipeline.identification().unwrap().state(0).unwrap().1;
    *end = Some(pipeline);
    (told, counts)
}

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
        let drift = pipeline.identification().unwrap().solution().components[0].drift[0];
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
        assert!(std < 0.5, "{axis}: {std}");
        assert!((found - before - by).abs() < 4.0 * std.max(NOISE[axis]));
    }
}

/// A log in which the hand is declared to be touched in a span of time.
fn declared(log: &str, from: f64, to: f64) -> String {
    let mut lines = log.lines();
    let header = lines.next().expect("a header");
    let rows = lines.map(|line| {
        let t: f64 = line.split(',').next().unwrap().parse().unwrap();
        format!("{line},{}\n", u8::from((from..to).contains(&t)))
    });
    format!("{header},contact/hand/active\n") + &rows.collect::<String>()
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
    let drift = end.unwrap().identification().unwrap().solution().components[0].drift[0][5];
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

/// The part of a log before the robot moves, `times` times over, stamps going on.
fn standing(log: &str, until: f64, times: usize) -> String {
    let mut lines = log.lines();
    let mut text = lines.next().expect("a header").to_owned() + "\n";
    let still: Vec<(f64, &str)> = lines
        .map(|line| line.split_once(',').expect("a stamp"))
        .map(|(t, rest)| (t.parse().expect("a number"), rest))
        .take_while(|(t, _)| *t < until)
        .collect();
    for time in 0..times {
        for (t, rest) in &still {
            let _ = writeln!(text, "{:.5},{rest}", t + until * time as f64);
        }
    }
    text
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

/// Identifies from logs given as text, with the URDF that is 20 % wrong.
fn identified(sessions: &Sessions, logs: &[(&str, &str, LogRole)]) -> Outcome {
    let robot = sessions.setup(Urdf::Cad, None).robot;
    let dataset = |(file, text, role): &(&str, &str, LogRole)| {
        reading::dataset_or_unreadable(&robot, file, *role, text.as_bytes()).unwrap()
    };
    let datasets = logs.iter().map(dataset).collect();
    identify(&robot, datasets, &[], &mut |_| {}).unwrap()
}

/// A setup with the identified parameters and its own offsets.
fn with(mut setup: Setup, outcome: &Outcome) -> Setup {
    for link in outcome.links.iter().filter(|link| link.seen) {
        link.identified
            .check(1e-9)
            .unwrap_or_else(|e| panic!("{}: no body: {e:?}", link.name));
    }
    let offsets = setup.initial.offsets.clone();
    let identified = parameters(outcome, &setup.robot, "a test").unwrap();
    setup.apply(&identified).unwrap();
    setup.initial.offsets = offsets;
    setup
}

/// Scores of every torque over the instants of all sessions without noise and contact: only the
/// parameters' errors.
fn without_noise(sessions: &Sessions, setup: Setup) -> BTreeMap<String, Score> {
    let log = sessions.log("exact");
    let joints: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
    let (truth, told) = (Table::new(&log), estimates(setup, &log));
    let free: Vec<usize> = (0..truth.column("t").len())
        .filter(|row| truth.column("contact/hand/active")[*row] == 0.0)
        .collect();
    let score = |joint: &String| {
        (
            joint.clone(),
            Score::new(&truth, &free, &told, &free, joint),
        )
    };
    joints.iter().map(score).collect()
}

/// The sensors' gains are identified, too, although here they are exact. Without noise, every
/// torque that depends on a sensor and on links beyond it is at least four times nearer to the
/// truth than CAD's. By noisy boards and with anything possible at the hand (so that torques rest
/// on the sensor's reading; without, they rest on the links beyond the joint, and 28 s of 50 Hz do
/// not hold what it would take to come within 1.5 times of exact parameters) it is at most 1.5
/// times as far from the truth as exact parameters get, or as stated, and CAD's are four times
/// further off, as long as noise lets that be seen: always, with the arm. Every other torque, which
/// rests on links that the motion does not show in full: no worse than CAD's, or within the stated
/// deviation, of a robot that stands on a foot four of them; most of their errors are within 1.96
/// of these.
fn must_be_good(what: &str, sessions: &Sessions, outcome: &Outcome) {
    println!(
        "{what}: {:?}, tau {:.3}, shrink {}",
        outcome.verdict, outcome.tau, outcome.least_retained_fraction
    );
    let cad = without_noise(sessions, sessions.setup(Urdf::Cad, None));
    let own = without_noise(sessions, with(sessions.setup(Urdf::Cad, None), outcome));
    let (log, name) = (sessions.log("validate"), "validate");
    let run = |setup: Setup| scores(sessions, name, &log, setup, |_| true);
    let noisy_exact = run(sessions.setup_touched(Urdf::True, Some(name)));
    let noisy_cad = run(sessions.setup_touched(Urdf::Cad, Some(name)));
    let noisy_own = run(with(sessions.setup_touched(Urdf::Cad, Some(name)), outcome));
    for (joint, score) in &own {
        println!(
            "  {joint}: without noise CAD {:.4}, identified {:.4} +- {:.4} Nm; with noise CAD \
             {:.4}, identified {:.4} +- {:.4}, exact {:.4} Nm",
            cad[joint].error,
            score.error,
            score.stated,
            noisy_cad[joint].error,
            noisy_own[joint].error,
            noisy_own[joint].stated,
            noisy_exact[joint].error
        );
    }
    let mut covered = Vec::new();
    for (joint, score) in &own {
        let (error, cad) = (score.error, cad[joint].error);
        let [exact, off, noisy] =
            [&noisy_exact, &noisy_cad, &noisy_own].map(|scores| scores[joint].error);
        if sessions.distal.contains(&joint.as_str()) {
            let stated = noisy_own[joint].stated;
            assert!(error <= cad / 4.0, "{what}: {joint}: {error} Nm, CAD {cad}");
            assert!(
                noisy <= 1.5 * exact.max(stated),
                "{what}: {joint}: {noisy} Nm, exact parameters {exact}, stated {stated}"
            );
            assert!(
                noisy <= off / 4.0 || exact > off / 6.0,
                "{what}: {joint}: {noisy} Nm, CAD {off}"
            );
        } else {
            let stated = score.stated;
            covered.push(score.covered);
            let most = if sessions.stands { 4.0 } else { 1.0 } * stated;
            assert!(
                noisy <= 1.05 * off + 1e-3 || error <= most,
                "{what}: {joint}: {noisy} Nm, CAD {off}; without noise {error} +- {stated}"
            );
        }
    }
    let share = covered.iter().sum::<f64>() / covered.len() as f64;
    println!(
        "  of the joints that rest on other links, too, {:.1} % are as near as stated",
        100.0 * share
    );
    assert!(share > 0.85, "{what}: {share} of {} joints", covered.len());
    assert_eq!(outcome.verdict, Verdict::Identified, "{what}");
}

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

/// What is said of something undeclared.
fn suspicions(outcome: &Outcome) -> Vec<(FindingCode, String)> {
    let findings = outcome.logs.iter().flat_map(|log| &log.findings);
    let about = findings.filter(|finding| {
        [FindingCode::Disturbance, FindingCode::LoadChanged].contains(&finding.code)
    });
    about
        .map(|finding| (finding.code, finding.text.clone()))
        .collect()
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

/// The lines of a log in a span of time \[s\].
fn part(log: &str, from: f64, to: f64) -> String {
    let within = |line: &&str| {
        line.split(',')
            .next()
            .unwrap()
            .parse::<f64>()
            .is_ok_and(|t| t >= from && t < to)
    };
    let mut lines = log.lines();
    let header = lines.next().expect("a header").to_owned() + "\n";
    lines
        .filter(within)
        .fold(header, |text, line| text + line + "\n")
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
            let told = |text: &str| {
                text.trim()
                    .parse::<f64>()
                    .unwrap_or_else(|e| panic!("{text}: {e}"))
            };
            let own = told(
                before
                    .split(": ")
                    .last()
                    .unwrap()
                    .split(" +- ")
                    .next()
                    .unwrap(),
            );
            assert!((own - mass).abs() < 0.01, "{own} kg, not {mass}");
            for (part, centre) in after.split(" +- ").next().unwrap().split(", ").zip(&centre) {
                assert!(
                    (told(part) - mass * centre).abs() < 0.001,
                    "{part} kg m of {centre} m"
                );
            }
        }
    }
}
