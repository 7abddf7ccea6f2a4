//! A real iCub's log, through every way there is: encoded to CAN frames and decoded again, from a file and, on vcan, played by canplayer
//! through gateway and estimator. Needs the log (`PROPRIO_DATA`) and the robot's URDF (`PROPRIO_ICUB_URDF`); says that it skips without.

use proprio_estimator::config::Config;
use proprio_estimator::offline::estimate;
use proprio_estimator::setup::Setup;
use proprio_gateway::offline::{decode, encode};
use proprio_gateway::plan::Plan;
use proprio_topics::csv::{self, Columns, Row, Series, Value, What};
use proprio_topics::{Kind, Nanos, Reading};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

struct Leg {
    plan: Plan,
    config: Config,
    /// The recorded table.
    table: String,
}

/// The configuration and the log, or nothing if they are not at hand.
fn leg() -> Option<Leg> {
    let (Some(data), Some(urdf)) = (std::env::var_os("PROPRIO_DATA"), std::env::var_os("PROPRIO_ICUB_URDF")) else {
        println!("skipped: PROPRIO_DATA (recorded logs) or PROPRIO_ICUB_URDF (iCubGenova02 of icub-models) is not set");
        return None;
    };
    let log = PathBuf::from(data).join("icub_leg_24_44s.csv");
    let Ok(table) = std::fs::read_to_string(&log) else {
        println!("skipped: there is no {}", log.display());
        return None;
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("real_leg");
    let mut config = Config::load(&folder.join("estimator.toml")).expect("the configuration");
    config.model = urdf.into();
    Some(Leg {
        plan: Plan::load(&folder.join("gateway.toml")).expect("the plan"),
        config,
        table,
    })
}

impl Leg {
    fn setup(&self) -> Setup {
        Setup::new(&self.config).expect("configuration and model fit")
    }

    /// Estimates of a table: per instant, per joint, the torque.
    fn estimates(&self, table: &str) -> Vec<(Nanos, Vec<f64>, Vec<bool>)> {
        let mut out = Vec::new();
        estimate(self.setup(), table.as_bytes(), &mut out).expect("estimates");
        let text = String::from_utf8(out).expect("text");
        let mut lines = text.lines();
        let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
        let columns =
            |part: &str| -> Vec<usize> { (0..header.len()).filter(|i| header[*i].starts_with(part)).collect() };
        let (torques, valids) = (columns("torque/"), columns("valid/"));
        lines
            .map(|line| {
                let cells: Vec<&str> = line.split(',').collect();
                let number = |i: &usize| cells[*i].parse().unwrap_or(f64::NAN);
                let t = Nanos::parse_seconds(cells[0]).expect("a stamp");
                (
                    t,
                    torques.iter().map(number).collect(),
                    valids.iter().map(|i| cells[*i] == "1").collect(),
                )
            })
            .collect()
    }
}

/// RMS difference per joint over the instants of both that are valid in both, and how many these are.
fn rms(a: &[(Nanos, Vec<f64>, Vec<bool>)], b: &[(Nanos, Vec<f64>, Vec<bool>)]) -> (Vec<f64>, usize) {
    let joints = a.first().map_or(0, |x| x.1.len());
    let (mut sums, mut count) = (vec![0.0; joints], 0);
    for (x, y) in a.iter().zip(b) {
        if x.2.iter().chain(&y.2).all(|valid| *valid) {
            count += 1;
            sums.iter_mut()
                .zip(x.1.iter().zip(&y.1))
                .for_each(|(s, (p, q))| *s += (p - q).powi(2));
        }
    }
    (sums.into_iter().map(|s| (s / count as f64).sqrt()).collect(), count)
}

/// All values of a table by kind, channel and instant.
fn values(table: &str) -> HashMap<(Kind, String), Vec<(Nanos, Vec<f64>)>> {
    let mut reader = csv::Reader::new(table.as_bytes()).expect("a table");
    let series = reader.series().to_vec();
    let (mut row, mut values) = (Row::default(), HashMap::<_, Vec<_>>::new());
    while reader.next_row(&mut row).expect("a row") {
        for item in &row.items {
            let Series {
                what: What::Channel(kind),
                name,
            } = &series[item.series]
            else {
                continue;
            };
            let Value::Reading(reading, _) = item.value else {
                continue;
            };
            let numbers = match reading {
                Reading::Joint(j) => vec![j.position],
                Reading::Wrench(w) => w.force.into_iter().chain(w.torque).collect(),
                _ => continue,
            };
            values
                .entry((*kind, name.clone()))
                .or_default()
                .push((row.t.expect("a stamp"), numbers));
        }
    }
    values
}

#[test]
fn encoded_and_decoded_every_value_is_within_half_a_step() {
    let Some(leg) = leg() else { return };
    let (mut log, mut decoded) = (Vec::new(), Vec::new());
    let report = encode(&leg.plan, leg.table.as_bytes(), &mut log).expect("encoded");
    assert_eq!(
        (report.refused, report.table.bad_rows, report.unknown_channels.len()),
        (0, 0, 0)
    );
    let back = decode(&leg.plan, log.as_slice(), &mut decoded, Columns::Main).expect("decoded");
    assert_eq!(
        (back.samples, back.unclaimed, back.bad_lines, back.other_interfaces),
        (report.samples, 0, 0, 0)
    );
    let decoded = String::from_utf8(decoded).expect("text");
    let (before, after) = (values(&leg.table), values(&decoded));
    assert_eq!(before.len(), after.len());
    for (channel, samples) in &before {
        let others = &after[channel];
        assert_eq!(samples.len(), others.len(), "{channel:?}");
        for ((t, want), (u, got)) in samples.iter().zip(others) {
            assert_eq!(t, u, "{channel:?}");
            for (i, (want, got)) in want.iter().zip(got).enumerate() {
                // Half a step: of 16 bits over the full scale both ways; of 360/65536 degrees of the motor's shaft.
                let half = match channel.0 {
                    Kind::Wrench if i < 3 => 1804.0 / 32768.0 / 2.0,
                    Kind::Wrench => 31.0 / 32768.0 / 2.0,
                    _ => (360.0_f64 / 65536.0).to_radians() / 100.0 / 2.0,
                };
                assert!(
                    (want - got).abs() <= half * (1.0 + 1e-9),
                    "{channel:?} at {t}: {want} {got}"
                );
            }
        }
    }
    let (original, quantised) = (leg.estimates(&leg.table), leg.estimates(&decoded));
    assert_eq!(original.len(), quantised.len());
    let (differences, count) = rms(&original, &quantised);
    assert!(count * 10 > original.len() * 9, "{count} of {}", original.len());
    let worst = differences.iter().copied().fold(0.0, f64::max);
    println!("RMS torque difference after quantisation to CAN frames: worst joint {worst:.4} Nm over {count} instants");
    // A step of the sensors is 0.055 N and 0.001 Nm; a leg is 0.7 m long.
    assert!(worst < 0.05, "{differences:?}");
}
