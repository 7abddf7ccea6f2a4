//! A recorded log gives the samples and the quality that its frames gave live.
#![allow(missing_docs, clippy::unwrap_used)]

use proprio_gateway::offline::{DecodeReport, decode};
use proprio_gateway::plan::Plan;
use proprio_topics::csv::Columns;
use proprio_topics::{Counter, Quality};
use std::fmt::Write as _;
use std::path::Path;

/// A motor board and an F/T board, at default settings.
const ARM: &str = r#"
    schema = 1
    robot = "arm"
    [[bus]]
    name = "arm"
    source = { kind = "virtual", name = "arm" }
      [[bus.device]]
      driver = "icub_motor"
      name = "elbow_board"
      address = 4
        [[bus.device.joint]]
        name = "elbow"
      [[bus.device]]
      driver = "icub_strain"
      name = "ft"
      address = 13
      full_scale_n = [1804.0, 1804.0, 1804.0]
      full_scale_nm = [31.0, 31.0, 31.0]
"#;

/// The qualities of `elbow` and `ft` in the order of their samples.
fn decoded(log: &str) -> ([Vec<Quality>; 2], DecodeReport) {
    let plan = Plan::parse(ARM, Path::new(".")).unwrap();
    let mut table = Vec::new();
    let report = decode(&plan, log.as_bytes(), &mut table, Columns::Main).unwrap();
    let table = String::from_utf8(table).unwrap();
    let names: Vec<&str> = table.lines().next().unwrap().split(',').collect();
    let quality = |name: &str| {
        let at = names.iter().position(|column| *column == name).unwrap();
        (table.lines().skip(1))
            .filter_map(|row| row.split(',').nth(at)?.parse().ok().map(Quality))
            .collect()
    };
    ([quality("elbow/quality"), quality("ft/quality")], report)
}

fn log(times_ms: impl IntoIterator<Item = u32>) -> String {
    let mut log = String::new();
    for ms in times_ms {
        let t = f64::from(ms) * 1e-3;
        writeln!(log, "({t:.6}) can0 140#0000000000000000").unwrap();
        writeln!(log, "({:.6}) can0 3DA#008000800080", t + 1e-4).unwrap();
        writeln!(log, "({:.6}) can0 3DB#008000800080", t + 2e-4).unwrap();
    }
    log
}

#[test]
fn a_silence_in_a_log_is_a_gap_as_it_was_live() {
    // The default maximum silence is 100 ms.
    let ([elbow, ft], report) = decoded(&log([0, 10, 20, 119, 320, 330]));
    let gap = Quality::GAP_BEFORE;
    for quality in [elbow, ft] {
        let flags: Vec<bool> = quality.iter().map(|q| q.contains(gap)).collect();
        assert_eq!(flags, [false, false, false, false, true, false]);
    }
    for device in report.devices {
        assert_eq!(device.counts, [(Counter::Silences, 1)], "{}", device.name);
    }
}

#[test]
fn one_stamp_far_in_the_future_costs_one_frame() {
    let good = log([0, 10, 20, 30, 40]);
    let bad = good.replace("(0.020000) can0 140#", "(920.020000) can0 140#");
    assert_ne!(good, bad);
    let ([elbow, ft], report) = decoded(&bad);
    assert_eq!((elbow.len(), ft.len()), (4, 5));
    assert_eq!((report.bad_lines, report.out_of_order), (1, 0));
    assert!(
        report.bad[0].contains("later than that of the next frame"),
        "{:?}",
        report.bad
    );
}
