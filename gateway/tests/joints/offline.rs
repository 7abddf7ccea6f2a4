//! Joints from logs to tables and back.

use super::{ELBOW, HALF_POSITION, HALF_VELOCITY, SHOULDER, cells, plan, truth};
use proprio_gateway::offline::{decode, encode};
use proprio_topics::Quality;
use proprio_topics::csv::Columns;
use std::f64::consts::TAU;

/// A table, encoded as a log by the drivers' own boards and decoded again, is the same table to
/// half a step: coupled motors that wrap, an encoder that wraps merged with a drive.
#[test]
fn a_table_is_the_same_after_encoding_and_decoding() {
    // Every motor's angle is reported within a turn of its shaft.
    let wraps = "ratio = 100.0\n wraps_rad = [-3.141592653589793, 3.141592653589793]\n\
                 centre_rad = 0.0\n max_speed_radps = 600.0\n";
    let text = format!("{ELBOW}{SHOULDER}").replace("max_silence_ms = 30\n", "");
    let shoulder = text.find("board_1").unwrap();
    let text = text[..shoulder].to_owned() + &text[shoulder..].replace("ratio = 100.0\n", wraps);
    let plan = plan(&text).unwrap();
    let names = ["elbow", "pitch", "roll", "yaw"];
    let columns = ["position", "velocity", "torque", "current"];
    let mut header = "t".to_owned();
    for name in names {
        for column in columns {
            header += &format!(",joint/{name}/{column}");
        }
    }
    let mut table = header.clone();
    for k in 0..600 {
        let t = 4e-3 * f64::from(k);
        table += &format!("\n{:.6}", 10.0 + t);
        for number in 0..names.len() {
            let number = if number == 0 { 3 } else { number - 1 };
            let mut state = truth(number, t);
            // The elbow turns like a wheel.
            if number == 3 {
                (state.position, state.velocity) = (0.4 + 5.0 * t, 5.0);
            }
            for value in [state.position, state.velocity, state.torque, state.current] {
                table += &format!(",{value}");
            }
        }
    }
    let mut log = Vec::new();
    let report = encode(&plan, table.as_bytes(), &mut log).unwrap();
    assert_eq!((report.samples, report.refused), (2400, 0), "{report:?}");
    let mut decoded = Vec::new();
    let report = decode(&plan, &log[..], &mut decoded, Columns::All).unwrap();
    // With the drive's own state.
    assert_eq!(report.samples, 2400 + 600, "{report:?}");
    let (before, after) = (cells(&table), cells(&String::from_utf8(decoded).unwrap()));
    assert_eq!(before.len(), after.len());
    for (t, row) in &before {
        for (column, value) in row {
            let found = after[t].get(column).copied().unwrap_or(f64::NAN);
            let is_elbow = column.contains("elbow");
            let bound = match column.rsplit('/').next().unwrap() {
                "position" if is_elbow => 0.5 * TAU / 65536.0,
                "position" => 1.615 * HALF_POSITION / 100.0,
                "velocity" if is_elbow => 0.5 * TAU / 4096.0 / 100.0,
                "velocity" => 1.615 * HALF_VELOCITY / 100.0,
                "torque" if is_elbow => 0.5 * 5e-4 * 100.0,
                // These boards measure no torque.
                "torque" => {
                    assert!(found.is_nan(), "{column}");
                    continue;
                }
                "current" if is_elbow => 0.5 * 3e-3,
                _ => 0.5e-3,
            };
            let off = (found - value).abs();
            assert!(off <= bound * 1.001, "{t} {column}: {value} {found}");
        }
        let quality = |name: &str| after[t][&format!("{name}/quality")];
        assert!(
            names.iter().all(|name| quality(name) == 0.0),
            "{:?}",
            after[t]
        );
    }
    // A joint of a coupling alone can not be told in the motors' angles.
    let alone = "t,joint/pitch/position,joint/elbow/position\n0.1,0.2,0.3\n";
    let report = encode(&plan, alone.as_bytes(), Vec::new()).unwrap();
    assert_eq!((report.samples, report.refused), (1, 1));
    let reason = report.first_refusal.unwrap();
    assert_eq!(
        reason,
        "line 2: the joints of a coupling must be in one row"
    );
}

/// Flags go back to the device that they came from.
#[test]
fn flags_are_encoded_where_they_were_decoded() {
    let plan = plan(&format!("{ELBOW}{SHOULDER}")).unwrap();
    let fault = Quality::DEVICE_FAULT.0;
    let drive = Quality::DRIVE_FAULT.0;
    let mut table = "t".to_owned();
    for name in ["elbow", "pitch", "roll", "yaw"] {
        table += &format!(",joint/{name}/position,joint/{name}/velocity,{name}/quality");
    }
    // The elbow's encoder, its drive, the third motor, the second one, the first one, none.
    let flags = [
        [fault, 0, 0, 0],
        [drive, 0, 0, 0],
        [0, 0, 0, fault],
        [0, 0, fault, fault],
        [0, fault, fault, 0],
        [0, 0, 0, 0],
    ];
    for (k, flags) in flags.iter().enumerate() {
        table += &format!("\n{:.3}", 1.0 + 0.01 * k as f64);
        for flag in flags {
            table += &format!(",0.1,0.2,{flag}");
        }
    }
    let (mut log, mut decoded) = (Vec::new(), Vec::new());
    encode(&plan, table.as_bytes(), &mut log).unwrap();
    decode(&plan, &log[..], &mut decoded, Columns::All).unwrap();
    let rows = cells(&String::from_utf8(decoded).unwrap());
    for (row, flags) in rows.values().zip(&flags) {
        let quality =
            ["elbow", "pitch", "roll", "yaw"].map(|name| row[&format!("{name}/quality")] as u32);
        assert_eq!(quality, *flags);
        assert!(row["joint/elbow/velocity"].is_finite());
    }
}
