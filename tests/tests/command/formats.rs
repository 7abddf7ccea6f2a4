//! Every format that candump writes, and the mixed bus of its screen.

use super::*;

/// What people paste from a terminal: one bus with a force/torque sensor that another program asks,
/// CANopen nodes that a master starts, boards of an iCub and frames of nobody; no stamps at all.
#[test]
fn a_mixed_bus_on_the_screen_of_candump_decodes() {
    let (ati, canopen) = sessions();
    let is_frame = |line: &&&str| !line.contains(' ');
    let mut left = ati.iter().filter(is_frame).peekable();
    let mut right = canopen.iter().filter(is_frame).peekable();
    let mut log = String::new();
    for turn in 0.. {
        // In steps of different lengths.
        let next = if turn % 5 < 2 {
            left.next()
        } else {
            right.next()
        };
        let Some(frame) = next.or_else(|| left.next()).or_else(|| right.next()) else {
            break;
        };
        let mut line = |frame: &str| {
            let (id, data) = frame.split_once('#').unwrap();
            let bytes: Vec<&str> = (0..data.len() / 2)
                .map(|i| &data[2 * i..2 * i + 2])
                .collect();
            writeln!(log, "  can0  {id}   [{}]  {}", bytes.len(), bytes.join(" ")).unwrap();
        };
        line(frame);
        if turn % 9 == 0 {
            line("31A#E380B76A1887");
            line("31B#2184BE770881");
            line("7FF#00");
        }
    }
    let place = Place::new();
    place.write("screen.log", &log);
    let device = |driver: &str, name: &str, address: u32, keys: &str| {
        format!(
            "[[bus.device]]\ndriver = {driver:?}\nname = {name:?}\naddress = {address}\n{keys}\n"
        )
    };
    let joint = |name: &str| format!("[[bus.device.joint]]\nname = {name:?}");
    let scales = "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]";
    let drive = format!("velocity_unit = \"0.1 rpm\"\n{}", joint("elbow"));
    let config = [
        "schema = 1\nrobot = \"mixed\"\n[[bus]]\nname = \"can0\"\n\
         source = { kind = \"socketcan\", interface = \"can0\" }\n"
            .to_owned(),
        device("ati_netcanoem", "wrist", 0x3F, ""),
        device("canopen_drive", "drive", 5, &drive),
        device("canopen_encoder", "encoder", 9, &joint("shoulder")),
        device("icub_strain", "ankle", 1, scales),
    ]
    .concat();
    place.write("gateway.toml", &config);
    let report = place
        .line("decode --config gateway.toml --log screen.log --out s.csv --all --json")
        .good()
        .json();
    for device in report["devices"].as_array().unwrap() {
        assert!(device["refusal"].is_null(), "{device}");
    }
    let samples = table(&place.read("s.csv"));
    let column = |name: &str| {
        let values = samples[name].iter().copied().filter(|v| !v.is_nan());
        values.collect::<Vec<_>>()
    };
    let truth = |lines: &[&str], who: &str, at: usize, unit: f64| {
        let rows = lines.iter().filter_map(|line| line.strip_prefix(who));
        let number = |row: &str| row.split(' ').nth(at).unwrap().parse::<f64>().unwrap();
        rows.map(|row| number(row) * unit).collect::<Vec<_>>()
    };
    let turn = std::f64::consts::TAU;
    for (name, right) in [
        ("wrench/wrist/fx", truth(&ati, "wrench ", 0, 1.0)),
        ("wrench/wrist/tz", truth(&ati, "wrench ", 5, 1.0)),
        (
            "joint/elbow/position",
            truth(&canopen, "drive ", 0, turn / 10_000.0),
        ),
        ("joint/elbow/torque", truth(&canopen, "drive ", 2, 0.88e-3)),
        (
            "joint/shoulder/position",
            truth(&canopen, "encoder ", 0, turn / 3600.0),
        ),
    ] {
        let read = column(name);
        assert_eq!(read.len(), right.len(), "{name}");
        for (a, b) in read.iter().zip(&right) {
            assert!((a - b).abs() <= 1e-9 * b.abs().max(1.0), "{name}: {a} {b}");
        }
    }
    let ankle = column("wrench/ankle/fx");
    assert!(
        ankle.len() > 10 && (ankle[0] - 12.498).abs() < 1e-3,
        "{ankle:?}"
    );
}

#[test]
fn every_candump_format_gives_the_same_samples() {
    let place = Place::new();
    let log = session(1.0, &SimulationSettings::default());
    let decode = |text: &str| {
        place
            .run_with(
                &[
                    "decode",
                    "--config",
                    "gateway.toml",
                    "--log",
                    "-",
                    "--out",
                    "-",
                    "--json",
                ],
                text.as_bytes(),
            )
            .good()
    };
    let reference = decode(&log).out;
    assert!(reference.lines().count() > 1000);
    // Per column, its values in order: every format must give these, apart from the stamps.
    let values = |csv: &str| {
        let mut columns = table(csv);
        columns.remove("t");
        columns
            .into_values()
            .map(|c| {
                c.into_iter()
                    .filter(|v| !v.is_nan())
                    .map(f64::to_bits)
                    .collect()
            })
            .collect::<Vec<Vec<u64>>>()
    };
    let wanted = values(&reference);
    for (name, absolute, text) in formats(&log) {
        let ran = decode(&text);
        let report: Json = serde_json::from_str(ran.err.lines().last().unwrap()).unwrap();
        assert_eq!(report["bad_lines"], 0, "{name}: {}", ran.err);
        if absolute {
            assert!(ran.out == reference, "{name}: not the same table");
        } else {
            assert!(values(&ran.out) == wanted, "{name}: not the same values");
        }
        let stamps = &table(&ran.out)["t"];
        assert_eq!(
            name.contains("since"),
            !absolute && stamps.iter().all(|t| !t.is_nan()),
            "{name}: stamps"
        );
        if name.contains("since") {
            let whole = table(&reference);
            assert!(
                stamps
                    .iter()
                    .zip(&whole["t"])
                    .all(|(a, b)| ((a - stamps[0]) - (b - whole["t"][0])).abs() < 1e-9),
                "{name}: the same times between samples"
            );
        }
    }
}
