//! Processes a real iCub's log in every possible way: encoded to CAN frames and decoded again, from
//! a file and, on vcan, played by canplayer through gateway and estimator. Needs the log
//! (`PROPRIO_DATA`) and the folder of the robot's URDF (`PROPRIO_ICUB_MODELS`); skipped with a note
//! without them.

use proprio_estimator::config::{Config, Occurrence};
use proprio_estimator::export::parameters;
use proprio_estimator::offline::estimate;
use proprio_estimator::sample_log;
use proprio_estimator::setup::Setup;
use proprio_gateway::link::send_by;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::log;
use proprio_gateway::offline::{decode, encode};
use proprio_gateway::plan::Plan;
use proprio_identification::{LogRole, identify};
use proprio_tests::watch::{Newest, Recorder, rows};
use proprio_tests::{Rig, can, now, uml};
use proprio_topics::csv::{self, Columns, Row, Series, SeriesKind, Value};
use proprio_topics::{EstimatorHealth, GatewayHealth, Kind, Nanos, Reading};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

struct Leg {
    plan: Plan,
    config: Config,
    /// The recorded table.
    table: String,
}

/// The configuration and the log; `None` if they are not available.
fn leg() -> Option<Leg> {
    let (Some(data), Some(models)) = (
        std::env::var_os("PROPRIO_DATA"),
        std::env::var_os("PROPRIO_ICUB_MODELS"),
    ) else {
        println!(
            "skipped: PROPRIO_DATA (recorded logs) or PROPRIO_ICUB_MODELS (robots of icub-models) \
             is not set"
        );
        return None;
    };
    let log = PathBuf::from(data).join("icub_leg_24_44s.csv");
    let Ok(table) = std::fs::read_to_string(&log) else {
        println!("skipped: there is no {}", log.display());
        return None;
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("real_leg");
    let mut config = Config::load(&folder.join("estimator.toml")).expect("the configuration");
    config.model = PathBuf::from(models).join("iCubGenova02.urdf");
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
    fn estimates(&self, table: &str) -> Estimates {
        let mut out = Vec::new();
        estimate(self.setup(), table.as_bytes(), &mut out, None).expect("estimates");
        let text = String::from_utf8(out).expect("text");
        let mut lines = text.lines();
        let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
        let columns = |part: &str| -> Vec<usize> {
            (0..header.len())
                .filter(|i| header[*i].starts_with(part))
                .collect()
        };
        let (torques, reasons) = (columns("torque/"), columns("reason/"));
        lines
            .map(|line| {
                let cells: Vec<&str> = line.split(',').collect();
                let number = |i: &usize| cells[*i].parse().unwrap_or(f64::NAN);
                let t = Nanos::parse_seconds(cells[0]).expect("a stamp");
                (
                    t,
                    torques.iter().map(number).collect(),
                    reasons
                        .iter()
                        .map(|i| matches!(cells[*i], "" | "uncertain"))
                        .collect(),
                )
            })
            .collect()
    }
}

/// Estimates by instant: the torques, and whether they come from good samples. Without offsets the
/// values are wrong, but every path must give the same ones.
type Estimates = Vec<(Nanos, Vec<f64>, Vec<bool>)>;

/// RMS difference per joint over the pairs of instants that are good in both, and the number of
/// these pairs.
fn rms(a: &Estimates, b: &Estimates, pairs: &[(Nanos, Nanos)]) -> (Vec<f64>, usize) {
    let by_time = |e: &Estimates| -> HashMap<Nanos, usize> {
        e.iter().enumerate().map(|(i, x)| (x.0, i)).collect()
    };
    let (of_a, of_b) = (by_time(a), by_time(b));
    let (mut sums, mut count) = (vec![0.0; a[0].1.len()], 0);
    for (t, u) in pairs {
        let (Some(x), Some(y)) = (of_a.get(t).map(|i| &a[*i]), of_b.get(u).map(|i| &b[*i])) else {
            continue;
        };
        if x.2.iter().chain(&y.2).all(|good| *good) {
            count += 1;
            sums.iter_mut()
                .zip(x.1.iter().zip(&y.1))
                .for_each(|(s, (p, q))| *s += (p - q).powi(2));
        }
    }
    (
        sums.into_iter()
            .map(|s| (s / count as f64).sqrt())
            .collect(),
        count,
    )
}

/// The instants of the trigger in `a` and `b`, paired by the sensor's reading; `a` may lack some.
fn pairs(a: &str, b: &str) -> Vec<(Nanos, Nanos)> {
    let trigger = (Kind::Wrench, "r_leg_ft_sensor".to_owned());
    let (a, b) = (
        values(a).remove(&trigger).expect("the trigger"),
        values(b).remove(&trigger).expect("the trigger"),
    );
    let mut rest = b.iter();
    a.iter()
        .filter_map(|(t, value)| {
            rest.find(|(_, other)| other == value)
                .map(|(u, _)| (*t, *u))
        })
        .collect()
}

/// The values of each channel at its instants.
type Values = HashMap<(Kind, String), Vec<(Nanos, Vec<f64>)>>;

/// All values of a table by kind, channel and instant.
fn values(table: &str) -> Values {
    let mut reader = csv::TableReader::new(table.as_bytes()).expect("a table");
    let series = reader.series().to_vec();
    let (mut row, mut values) = (Row::default(), HashMap::<_, Vec<_>>::new());
    while reader.next_row(&mut row).expect("a row") {
        for item in &row.items {
            let Series {
                kind: SeriesKind::Channel(kind),
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
        (
            report.refused,
            report.table.bad_rows,
            report.unknown_channels.len()
        ),
        (0, 0, 0)
    );
    let back = decode(&leg.plan, log.as_slice(), &mut decoded, Columns::Main).expect("decoded");
    assert_eq!(
        (
            back.samples,
            back.unclaimed,
            back.bad_lines,
            back.other_interfaces
        ),
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
                // Half a step: of 16 bits over the full scale both ways; of 360/65536 degrees of
                // the motor's shaft.
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
    let (differences, count) = rms(&original, &quantised, &pairs(&decoded, &decoded));
    // For more than half of the log the sensor of the left leg is frozen, and what rests on it is
    // not used; a busy machine may lose some more.
    assert!(
        count * 5 > original.len() * 2,
        "{count} of {}",
        original.len()
    );
    let worst = differences.iter().copied().fold(0.0, f64::max);
    println!(
        "RMS torque difference after quantisation to CAN frames: worst joint {worst:.4} Nm over \
         {count} instants"
    );
    // A step of the sensors is 0.055 N and 0.001 Nm; a leg is 0.7 m long.
    assert!(worst < 0.05, "{differences:?}");
}

#[test]
fn played_onto_vcan_the_live_estimates_are_those_of_the_samples_received() {
    if can::vcan() {
        let player = |rig: &Rig, log: &str| {
            rig.spawn(
                can::tool(&format!("canplayer -I {log} vcan0=vcan0 vcan1=vcan1")),
                "canplayer",
            )
        };
        live_is_replay(["vcan0", "vcan1"], |rig, log| {
            let mut player = player(rig, log);
            Box::new(move || player.ended().is_some())
        });
    }
}

#[test]
fn played_onto_virtual_buses_the_live_estimates_are_those_of_the_samples_received() {
    if std::env::var_os("PROPRIO_VCAN").is_some() {
        println!("skipped: not for user-mode Linux, which is too slow");
        return;
    }
    let names = ["l", "r"].map(|side| format!("leg_{side}_{}", std::process::id()));
    live_is_replay([&names[0], &names[1]], |rig, log| {
        let (log, domain, names) = (log.to_owned(), rig.domain.name.clone(), names.clone());
        let player = std::thread::spawn(move || {
            let mut buses = names
                .each_ref()
                .map(|name| VirtualBus::open(&domain, name, &[]).expect("a virtual bus"));
            let file = std::fs::File::open(log).expect("the log");
            let mut reader = log::LogReader::new(std::io::BufReader::new(file));
            let begin = now();
            let mut first = None;
            while let Some(record) = reader.next_record().expect("the log") {
                let due = begin + (record.frame.t - *first.get_or_insert(record.frame.t));
                let wait = due - now();
                if wait > Nanos::ZERO {
                    std::thread::sleep(std::time::Duration::from_nanos(wait.0.unsigned_abs()));
                }
                let bus = names
                    .iter()
                    .position(|name| name == record.interface)
                    .expect("one of the buses");
                let patience = now() + Nanos::from_millis(1000);
                send_by(&mut buses[bus], &record.frame, patience).expect("a frame can be sent");
            }
        });
        Box::new(move || player.is_finished())
    });
}

/// Starts a player of a log; the returned closure tests whether it has ended.
type Play<'a> = &'a dyn Fn(&Rig, &str) -> Box<dyn FnMut() -> bool>;

/// Plays the log's first six seconds onto two buses, in slow motion on a slow machine, and compares
/// the live estimates with a replay of the received samples.
fn live_is_replay(buses: [&str; 2], play: impl Fn(&Rig, &str) -> Box<dyn FnMut() -> bool>) {
    // If the machine stalls for longer than half the wait, samples are late; then try again.
    let tries = 5;
    assert!(
        (0..tries).any(|_| one_live_is_replay(buses, &play)),
        "samples were late in each of {tries} tries: this machine is too slow for the \
         configured wait"
    );
}

/// The configuration with its times in ms multiplied by `slower`, except the wait, which gets its
/// maximum.
fn slow_motion(text: &str, slower: i64) -> String {
    let line = |line: &str| match line.split_once(" = ") {
        Some((key, value)) if key.ends_with("_ms") && key != "max_wait_ms" => {
            match (value.parse::<i64>(), value.parse::<f64>()) {
                (Ok(whole), _) => format!("{key} = {}\n", whole * slower),
                (_, Ok(number)) => format!("{key} = {:?}\n", number * slower as f64),
                _ => panic!("{line} is not a number"),
            }
        }
        _ => format!("{line}\n"),
    };
    text.lines().map(line).collect()
}

/// One attempt; false if samples were late, so that no comparison is possible.
fn one_live_is_replay(buses: [&str; 2], play: Play<'_>) -> bool {
    let Some(mut leg) = leg() else { return true };
    // Two thousand frames a second are too many for user-mode Linux: use slow motion there.
    let slower = if uml() { 4 } else { 1 };
    let (begin, until) = (Nanos::from_millis(24_000), Nanos::from_millis(30_000));
    let mut table = String::new();
    for line in leg.table.lines() {
        match line
            .split_once(',')
            .map(|(t, rest)| (Nanos::parse_seconds(t), rest))
        {
            Some((Some(t), rest)) if t < until => {
                table.push_str(&format!(
                    "{},{rest}\n",
                    begin + Nanos((t - begin).0 * slower)
                ));
            }
            Some((Some(_), _)) => {}
            _ => table.push_str(&format!("{line}\n")),
        }
    }
    leg.table = table;
    let rig = Rig::new();
    let file = |name: &str| rig.path(name).to_str().expect("a path in UTF-8").to_owned();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("real_leg");
    let mut text = std::fs::read_to_string(folder.join("gateway.toml")).expect("the configuration");
    for (interface, bus) in ["vcan0", "vcan1"].into_iter().zip(buses) {
        let source = format!("kind = \"virtual\", name = \"{bus}\"");
        if interface != bus {
            text = text.replacen(
                &format!("kind = \"socketcan\", interface = \"{interface}\""),
                &source,
                1,
            );
        }
    }
    let text = slow_motion(&text, slower);
    std::fs::write(file("gateway.toml"), &text).expect("a copy");
    leg.plan = Plan::load(Path::new(&file("gateway.toml"))).expect("the plan");
    let text = std::fs::read_to_string(folder.join("estimator.toml")).expect("the configuration");
    let text = slow_motion(&text, slower);
    let model = format!("model = {:?}", leg.config.model);
    std::fs::write(
        file("estimator.toml"),
        text.replacen("model = \"model.urdf\"", &model, 1),
    )
    .expect("a copy");
    leg.config = Config::load(Path::new(&file("estimator.toml"))).expect("the configuration");
    std::fs::write(file("leg.csv"), &leg.table).expect("a copy");
    rig.run(&[
        "encode",
        "--config",
        &file("gateway.toml"),
        "--samples",
        &file("leg.csv"),
        "--out",
        &file("leg.log"),
    ]);

    let mut gateway = rig.start(&["gateway", "--config", &file("gateway.toml")]);
    let mut estimator = rig.start(&["estimator", "--config", &file("estimator.toml")]);
    let domain = rig.open();
    let mut recorder = Recorder::of_all(&domain, "icub_legs");
    let mut gateway_health: Newest<GatewayHealth> = Newest::open(&domain, "icub_legs");
    let mut health: Newest<EstimatorHealth> = Newest::open(&domain, "icub_legs");
    gateway_health.fresh();
    health.fresh();
    let frames = std::fs::read_to_string(file("leg.log"))
        .expect("the log")
        .lines()
        .count() as u64;
    let mut ended = play(&rig, &file("leg.log"));
    // After the end of the log the last estimates follow, which wait for later samples.
    let mut quiet_since = now();
    let mut seen = 0;
    while !ended() || now() - quiet_since < Nanos::from_millis(1000) {
        recorder.take();
        if recorder.taken.len() != seen {
            (seen, quiet_since) = (recorder.taken.len(), now());
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    gateway_health.fresh();
    let received: u64 = gateway_health
        .fresh()
        .buses()
        .iter()
        .map(|b| b.frames)
        .sum();
    assert_eq!(received, frames, "every frame that was played");
    health.fresh();
    let last = health.fresh();
    assert_eq!(
        (recorder.lost(), last.lost),
        (0, 0),
        "nothing lost on the way here or to the estimator"
    );
    gateway.end();
    estimator.end();
    // User-mode Linux often stalls for longer than half the wait.
    if last.late > 0 && !uml() {
        println!("{} samples were late: trying again", last.late);
        return false;
    }

    let setup = leg.setup();
    let channels: Vec<(Kind, String)> = leg
        .plan
        .channels
        .iter()
        .map(|c| (c.kind, c.name.clone()))
        .collect();
    let received = rig.path("received.csv");
    recorder.write_samples(&channels, &received);
    let received = std::fs::read_to_string(received).expect("the samples");
    let mut out = Vec::new();
    estimate(leg.setup(), received.as_bytes(), &mut out, None).expect("estimates");
    let offline = rows(&String::from_utf8(out).expect("text"));
    let live = recorder.estimate_rows(&setup);
    let stamp = |t: &str| Nanos::parse_seconds(t);
    let first = live
        .keys()
        .filter_map(|t| stamp(t))
        .min()
        .expect("estimates");
    // The estimator may connect a little later than the recorder, and the last instants may still
    // have been waiting when it was stopped.
    let before = offline
        .keys()
        .filter(|t| stamp(t).is_some_and(|t| t < first))
        .count();
    assert!(
        before * 10 < offline.len()
            && live.len() + before + 5 + last.late as usize >= offline.len(),
        "{} live, {} offline, {before} of them before the first that is live",
        live.len(),
        offline.len()
    );
    // Standard deviations are kept for 0.1 s per posture, derivatives use the longest available
    // window, and their noise four more samples. An estimator that begins later therefore begins
    // with different values.
    let begun = first + Nanos::from_millis(if before > 0 { 1000 + 40 * slower } else { 100 });
    let mut differing = live
        .iter()
        .filter(|(t, row)| stamp(t).is_none_or(|t| t >= begun) && offline.get(*t) != Some(*row));
    if let Some((t, row)) = differing.clone().next() {
        println!("first at {t}:\nlive   {row:?}\nreplay {:?}", offline.get(t));
    }
    let different = differing.by_ref().count();
    println!(
        "{different} of {} live estimates differ, {} samples were late",
        live.len(),
        last.late
    );
    // Late samples change the estimates around them. Beyond the longest window the estimates agree
    // again.
    let may_differ = if last.late > 0 { live.len() * 2 / 3 } else { 0 };
    assert!(
        different <= may_differ,
        "{different} of {} live estimates",
        live.len()
    );

    let log = std::fs::read(file("leg.log")).expect("the log");
    let mut decoded = Vec::new();
    decode(&leg.plan, log.as_slice(), &mut decoded, Columns::Main).expect("decoded");
    let pairs = pairs(&received, &String::from_utf8(decoded).expect("text"));
    let (original, quantised) = (leg.estimates(&leg.table), leg.estimates(&received));
    let (differences, count) = rms(&quantised, &original, &pairs);
    let worst = differences.iter().copied().fold(0.0, f64::max);
    println!(
        "{} live estimates; RMS torque difference to the original log: worst joint {worst:.4} Nm \
         over {count} instants",
        live.len() - 1
    );
    // For more than half of the log the sensor of the left leg is frozen, and what rests on it is
    // not used; a busy machine may lose some more.
    assert!(
        count * 5 > original.len() * 2,
        "{count} of {}",
        original.len()
    );
    true
}

/// A torque and its standard deviation, of two estimates.
type Pair = ((f64, f64), (f64, f64));

/// Torques of some joints from 34 to 44 s with their standard deviations; `None` where not valid.
fn swinging(setup: Setup, table: &str) -> Vec<[Option<(f64, f64)>; 4]> {
    let joints = ["r_hip_pitch", "r_hip_yaw", "r_knee", "r_ankle_pitch"];
    let mut out = Vec::new();
    estimate(setup, table.as_bytes(), &mut out, None).expect("estimates");
    let text = String::from_utf8(out).expect("text");
    let mut lines = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = lines.next().expect("a header");
    let place = |name: String| {
        header
            .iter()
            .position(|column| *column == name)
            .expect("a column")
    };
    let columns = joints.map(|joint| {
        ["torque", "torque_std", "valid"].map(|what| place(format!("{what}/{joint}")))
    });
    let number = |cell: &str| cell.parse::<f64>().unwrap_or(f64::NAN);
    lines
        .filter(|cells| (34.0..44.0).contains(&number(cells[0])))
        .map(|cells| {
            columns.map(|[torque, deviation, valid]| {
                (cells[valid] == "1").then(|| (number(cells[torque]), number(cells[deviation])))
            })
        })
        .collect()
}

/// With on-line identification, started at any moment, the torques of the swinging leg agree with
/// those from off-line identification and with the inverse dynamics of the CAD, which for a free
/// limb is as accurate as the CAD. It is not declared that the foot stands on the ground until 14
/// s, nor that the sensors were never tared.
#[test]
fn on_line_the_torques_of_a_real_leg_are_what_they_are_from_its_log() {
    /// Medians of iDynTree's inverse dynamics of `iCubGenova02` \[Nm\], and the assumed relative
    /// error of the CAD.
    const CAD: [(f64, f64); 4] = [(0.44, 0.2), (-0.10, 0.2), (4.11, 0.2), (-0.36, 0.2)];
    /// At the hip and the ankle the moments of the limb's parts cancel, so two fifths of the sum
    /// are less than a fifth of each moment \[Nm\].
    const LITTLE: f64 = 0.4;
    let Some(mut leg) = leg() else { return };
    let data = PathBuf::from(std::env::var_os("PROPRIO_DATA").expect("the logs"));
    let spans = ["icub_leg_12_24s.csv", "icub_leg_24_44s.csv"];
    let [Ok(first), Ok(second)] = spans.map(|name| std::fs::read_to_string(data.join(name))) else {
        println!("skipped: there is no {}", spans.join(", or no "));
        return;
    };
    let texts = [first, second];
    leg.config
        .contact
        .retain(|contact| contact.name() != "right_leg");
    let foot = leg
        .config
        .contact
        .iter_mut()
        .find(|contact| contact.name() == "right_foot");
    foot.expect("the foot's contact").presence = Occurrence::Possible;

    let identified = {
        let setup = leg.setup();
        let log = texts[1].as_bytes();
        let dataset =
            sample_log::dataset(&setup.robot, spans[1], LogRole::Train, log).expect("a log");
        let outcome = identify(&setup.robot, vec![dataset], &[], &mut |_| ()).expect("an outcome");
        let mut with = setup.clone();
        with.apply(&parameters(&outcome, &setup.robot, "this test").expect("parameters"))
            .expect("they fit");
        swinging(with, &texts[1])
    };
    leg.config.identification.enabled = true;
    let mut rows = texts[0].lines().chain(texts[1].lines().skip(1));
    let header = rows.next().expect("a header").to_owned();
    let rows: Vec<&str> = rows.collect();
    let mut all = Vec::new();
    for begin in [12.0, 17.0, 20.0, 24.0, 30.0] {
        let is_later = |row: &&&str| {
            row.split(',')
                .next()
                .and_then(|t| t.parse().ok())
                .is_some_and(|t: f64| t >= begin)
        };
        let table = std::iter::once(header.as_str())
            .chain(rows.iter().filter(is_later).copied())
            .flat_map(|row| [row, "\n"])
            .collect::<String>();
        let own = swinging(leg.setup(), &table);
        for (joint, (cad, share)) in CAD.iter().enumerate() {
            // Both have the same instants, except at the beginning of the table.
            let from = identified.len().saturating_sub(own.len());
            let pairs: Vec<_> = (own.iter().rev().zip(identified[from..].iter().rev()))
                .filter_map(|(own, other)| Some((own[joint]?, other[joint]?)))
                .collect();
            let within = |((a, s), (b, r)): &&Pair| (a - b).abs() <= 2.0 * s.hypot(*r);
            let covered = pairs.iter().filter(within).count() as f64 / pairs.len() as f64;
            all.push(covered);
            let median = |of: &dyn Fn(&Pair) -> f64| {
                let mut values: Vec<f64> = pairs.iter().map(of).collect();
                values.sort_by(f64::total_cmp);
                values[values.len() / 2]
            };
            let apart = median(&|((a, _), (b, _))| a - b).abs();
            let joint_deviation = median(&|((_, s), (_, r))| s.hypot(*r));
            let median = median(&|((value, _), _)| *value);
            println!(
                "from {begin} s, joint {joint}: {median:.2} Nm, {:.0} % within",
                100.0 * covered
            );
            assert!(
                apart < 2.0 * joint_deviation,
                "from {begin} s, joint {joint}: {apart}, {joint_deviation}"
            );
            let apart = (median - cad).abs();
            assert!(
                apart < (2.0 * share * cad).abs().max(LITTLE),
                "from {begin} s, joint {joint}: {median}, CAD {cad}"
            );
        }
    }
    let mean = all.iter().sum::<f64>() / all.len() as f64;
    println!("{:.0} % within in all", 100.0 * mean);
    assert!(mean >= 0.85, "{all:?}");
}

/// How often the four sensors of a real robot are said to be frozen, in the counts of their boards
/// (the logs' values are encoded to frames): never where they measure. The left leg's sensor does
/// freeze in two of the logs, for up to nine seconds while the robot moves and its other sensors go
/// on: a gauge was saturated, which the tables do not tell. There, each repeated reading is marked
/// from the sixteenth on.
#[test]
fn real_sensors_are_said_to_be_frozen_only_where_they_are() {
    let Some(data) = std::env::var_os("PROPRIO_DATA") else {
        println!("skipped: PROPRIO_DATA (recorded logs) is not set");
        return;
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("real_leg");
    let plan = Plan::load(&folder.join("gateway.toml")).expect("the plan");
    let (mut readings, mut frozen) = (0, 0);
    for name in ["12_24", "24_44", "57_70"] {
        let file = PathBuf::from(&data).join(format!("icub_leg_{name}s.csv"));
        let Ok(table) = std::fs::read_to_string(&file) else {
            println!("skipped: there is no {}", file.display());
            return;
        };
        let (mut log, mut decoded) = (Vec::new(), Vec::new());
        encode(&plan, table.as_bytes(), &mut log).expect("frames");
        decode(&plan, &log[..], &mut decoded, Columns::Main).expect("samples");
        let mut reader = csv::TableReader::new(&decoded[..]).expect("a table");
        let series = reader.series().to_vec();
        // Per sensor: the last reading, how often it was repeated, and its first stamp.
        let mut past: HashMap<usize, (Reading, u32, Nanos)> = HashMap::new();
        let mut row = Row::default();
        while reader.next_row(&mut row).expect("a row") {
            for item in &row.items {
                let Value::Reading(reading @ Reading::Wrench(_), quality) = item.value else {
                    continue;
                };
                let t = row.t.expect("a stamp");
                let (last, run, first) = past.entry(item.series).or_insert((reading, 0, t));
                *run = if *last == reading && t > *first {
                    *run + 1
                } else {
                    0
                };
                *last = reading;
                let marked = quality.contains(proprio_topics::Quality::FROZEN);
                let sensor = &series[item.series].name;
                // An axis may have been equal by chance once or twice before the others.
                assert!(!marked || *run >= 14, "{name}: {sensor} at {t}, run {run}");
                assert!(marked || *run < 20, "{name}: {sensor} at {t}, run {run}");
                readings += 1;
                frozen += u32::from(marked);
                if marked {
                    assert_eq!(sensor, "l_leg_ft_sensor");
                }
            }
        }
    }
    println!("{frozen} of {readings} readings marked, all of them repeated; 0 false alarms");
    assert!(frozen > 1000 && readings > 15_000, "{frozen} of {readings}");
}
