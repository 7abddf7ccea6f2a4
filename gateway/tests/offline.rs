//! A recorded log gives the samples and the quality that its frames gave live.
#![allow(missing_docs, clippy::unwrap_used)]

use proprio_gateway::log::Stamps;
use proprio_gateway::offline::{DecodeReport, decode, decode_with};
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

/// What relative stamps mean may be stated; a guess is reported, a statement is none.
#[test]
fn the_meaning_of_stamps_may_be_stated() {
    let plan = Plan::parse(ARM, Path::new(".")).unwrap();
    let log: String = [0, 10, 20, 30]
        .map(|ms| format!(" (000.{ms:03}000)  can0  140   [8]  00 00 00 00 00 00 00 00\n"))
        .concat();
    for (stated, means, times) in [
        (
            Stamps::Detect,
            Stamps::SinceStart,
            ["0", "0.01", "0.02", "0.03"],
        ),
        (
            Stamps::SinceStart,
            Stamps::SinceStart,
            ["0", "0.01", "0.02", "0.03"],
        ),
        (
            Stamps::SincePrevious,
            Stamps::SincePrevious,
            ["0", "0.01", "0.03", "0.06"],
        ),
    ] {
        let mut table = Vec::new();
        let report = decode_with(&plan, log.as_bytes(), stated, &mut table, Columns::Main).unwrap();
        let table = String::from_utf8(table).unwrap();
        let first: Vec<_> = (table.lines().skip(1))
            .filter_map(|row| row.split(',').next())
            .collect();
        assert_eq!((first, report.stamps), (times.to_vec(), means));
        let doubt = report.doubt.unwrap_or_default();
        assert_eq!(
            doubt.contains("--stamps since-previous"),
            stated == Stamps::Detect
        );
    }
    // A log with dates has no such meaning.
    let log = log.replace("(000.", "(1700000000.");
    let report = decode(&plan, log.as_bytes(), &mut Vec::new(), Columns::Main).unwrap();
    assert_eq!((report.stamps, report.doubt), (Stamps::Detect, None));
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

/// The log of a board at 100 Hz whose axes are noisy, and that repeats its reading from `from` to
/// `until`.
fn noisy(readings: u32, from: u32, until: u32) -> String {
    let (mut log, mut random) = (String::new(), 12_345_u32);
    let mut counts = [0_u16; 6];
    for k in 0..readings {
        for count in &mut counts {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            if !(from..until).contains(&k) {
                *count = (0x8000 + (random >> 28) as u16).swap_bytes();
            }
        }
        let [a, b, c, d, e, f] = counts;
        let t = f64::from(k) * 1e-2;
        writeln!(log, "({t:.6}) can0 3DA#{a:04X}{b:04X}{c:04X}").unwrap();
        writeln!(log, "({:.6}) can0 3DB#{d:04X}{e:04X}{f:04X}", t + 2e-4).unwrap();
    }
    log
}

#[test]
fn a_frozen_sensor_in_a_log_is_marked_as_live() {
    let ([_, ft], report) = decoded(&noisy(3000, 2000, 2100));
    let marked: Vec<_> = (0..ft.len())
        .filter(|k| ft[*k].contains(Quality::FROZEN))
        .collect();
    assert_eq!(marked.last(), Some(&2099), "{marked:?}");
    assert!((2015..2020).contains(&marked[0]), "{marked:?}");
    assert_eq!(marked.len(), 2100 - marked[0], "without a gap");
    let counts = &report.devices[1].counts;
    assert!(
        counts.contains(&(Counter::Frozen, marked.len() as u64)),
        "{counts:?}"
    );
    let ([_, ft], _) = decoded(&noisy(30_000, 0, 0));
    assert!(ft.iter().all(|quality| !quality.contains(Quality::FROZEN)));
}

/// A value of a JR3 beyond its full scale is counted, and delivered.
#[test]
fn a_value_beyond_the_full_scale_is_counted() {
    let text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                source = { kind = \"virtual\", name = \"b\" }\n[[bus.device]]\n\
                driver = \"jr3_can\"\nname = \"ft\"\naddress = 1\n\
                full_scale_n = [100, 100, 100]\nfull_scale_nm = [5, 5, 5]\n";
    let plan = Plan::parse(text, Path::new(".")).unwrap();
    // At the full scale, beyond it on ty.
    let log = "(1.0) can0 601#004000C000000100\n(1.0002) can0 681#0000000000000100\n\
               (1.01) can0 601#004000C000004F00\n(1.0102) can0 681#0000024000004F00\n";
    let mut table = Vec::new();
    let report = decode(&plan, log.as_bytes(), &mut table, Columns::Main).unwrap();
    assert_eq!((report.samples, report.bad_lines), (2, 0));
    let counts = &report.devices[0].counts;
    assert!(counts.contains(&(Counter::OutOfRange, 1)), "{counts:?}");
}

/// Of an adapter that is named by its serial number a log does not say which interface it was: a
/// bus takes the frames of an interface with its own name, and the others are named.
#[test]
fn interfaces_of_a_log_that_no_bus_takes_are_named() {
    let adapter = "{ kind = \"socketcan\", serial = \"0042\" }";
    let bus = |name: &str| {
        ARM.replace("arm", name)
            .replace("elbow", &format!("{name}_elbow"))
    };
    let second = bus("leg").replace("\"ft\"", "\"leg_ft\"");
    let second = &second[second.find("[[bus]]").unwrap()..];
    let text = format!("{ARM}{second}")
        .replace("{ kind = \"virtual\", name = \"arm\" }", adapter)
        .replace(
            "{ kind = \"virtual\", name = \"leg\" }",
            &adapter.replace("42", "43"),
        );
    let plan = Plan::parse(&text, Path::new(".")).unwrap();
    let log: String = (["can7", "arm", "can3", "can7"].into_iter().zip(0..))
        .map(|(name, t)| format!("({t}.000000) {name} 140#0000000000000000\n"))
        .collect();
    let report = decode(&plan, log.as_bytes(), &mut Vec::new(), Columns::Main).unwrap();
    assert_eq!(
        (report.frames, report.samples, report.other_interfaces),
        (4, 1, 3)
    );
    assert_eq!(report.other_names, ["can7", "can3"]);
}

/// Of a log of several buses, one bus takes its own frames; of a log that was recorded under other
/// names, all, which is told if there are several. Its interface may come late.
#[test]
fn one_bus_takes_the_frames_of_its_interface_if_the_log_has_it() {
    let line = |name: &str, t: u32| format!("({t}.000000) {name} 140#0000000000000000\n");
    let decoded = |log: &str| {
        let plan = Plan::parse(ARM, Path::new(".")).unwrap();
        decode(&plan, log.as_bytes(), &mut Vec::new(), Columns::Main).unwrap()
    };
    let late: String = (0..9_000).map(|t| line("leg", t)).collect();
    let report = decoded(&(late + &line("arm", 9_000)));
    assert_eq!((report.samples, report.other_interfaces), (1, 9_000));
    assert_eq!(
        (report.other_names, report.several),
        (vec!["leg".to_owned()], None)
    );
    let report = decoded(&(line("can0", 1) + &line("can0", 2)));
    assert_eq!((report.samples, report.several), (2, None));
    let report = decoded(&(line("can0", 1) + &line("can1", 2)));
    assert_eq!((report.samples, report.other_interfaces), (2, 0));
    let text = report.several.unwrap();
    assert!(
        text.starts_with("the log has the interfaces can0, can1, and the frames of all count")
            && text.contains("interface or name of the bus in gateway.toml"),
        "{text}"
    );
}

/// Where the clock was set back, by how much, and what to do: until it has caught up, nothing is
/// taken.
#[test]
fn a_clock_that_was_set_back_is_told_with_its_place() {
    let before = log((1_000..1_050).step_by(10));
    let (_, report) = decoded(&format!("{before}{}", log((400..430).step_by(10))));
    assert_eq!(
        report.step_back.as_deref(),
        Some(
            "at line 16 the time steps back by 0.6402 s, from 1.0402 s to 0.4 s: what has an \
             earlier stamp than its last one is dropped. Cut the log there, and read the parts one \
             by one"
        )
    );
    // Frames of two interfaces that are read in turn are a little out of order.
    let (_, report) = decoded(&format!("{before}{}", log([980, 1_100])));
    assert_eq!(report.step_back, None);
}
