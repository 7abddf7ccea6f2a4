//! What speaks for each board of the iCub protocol and what does not, and the keys that its streams
//! tell: frames computed by hand from the tables of the drivers.

use crate::rig::{FD, decode, frame, listener};
use proprio_drivers::{Finding, Frame, Id, Traffic, recognise};

/// The iCub boards that are found where these frames, at these times \[ms\], come every 10 ms.
fn found(frames: &[(&str, f64)]) -> Vec<Finding> {
    let mut heard = Traffic::new();
    for turn in 0..20 {
        for (text, ms) in frames {
            heard.on_frame(&frame(text, 10.0 * f64::from(turn) + ms));
        }
    }
    icub(&heard)
}

fn icub(heard: &Traffic) -> Vec<Finding> {
    let mut findings = recognise(heard);
    findings.retain(|finding| finding.driver.starts_with("icub"));
    findings
}

/// The keys of what is found for `driver`.
fn keys(findings: &[Finding], driver: &str) -> String {
    let finding = findings.iter().find(|finding| finding.driver == driver);
    let keys = finding.expect("it is found").keys.iter();
    let texts: Vec<String> = keys
        .map(|key| format!("{} = {}", key.name, key.value))
        .collect();
    texts.join("; ")
}

/// A board that tells its type needs no streams, unless boards of its type may lack what a driver
/// reads: an mtb4 is an IMU, and perhaps has skin or encoders.
#[test]
fn a_board_is_read_by_the_drivers_of_its_type() {
    for (board, name, drivers) in [
        ("03", "mc4", &["icub_mc4"][..]),
        ("04", "bll", &["icub_mc4"]),
        ("05", "mtb", &["icub_imu", "icub_skin"]),
        ("06", "strain", &["icub_strain"]),
        ("07", "mais", &["icub_mais"]),
        ("08", "2foc", &["icub_motor"]),
        ("0B", "mtb4", &["icub_imu"]),
        ("0C", "strain2", &["icub_imu", "icub_strain"]),
        ("0D", "rfe", &["icub_imu"]),
        ("0F", "psc", &["icub_pos"]),
        ("10", "mtb4w", &["icub_imu"]),
        ("12", "amcbldc", &["icub_motor"]),
        ("14", "mtb4c", &["icub_imu"]),
        ("15", "amc2c", &["icub_motor"]),
        ("16", "strain2c", &["icub_imu", "icub_strain"]),
        ("18", "amcfoc2c", &["icub_motor"]),
        ("77", "of the future", &[]),
    ] {
        let answer = format!("7E0#FF{board}020008");
        let findings = found(&[(&answer, 0.0)]);
        let mut names: Vec<&str> = findings.iter().map(|finding| finding.driver).collect();
        names.sort_unstable();
        assert_eq!(names, drivers, "{name}");
        for finding in &findings {
            let what = format!("{name}, firmware 2.0.8");
            assert_eq!((finding.address, &finding.what), (14, &what));
        }
        if drivers.contains(&"icub_imu") {
            // An mtb alone has discrete sensors with a scale of their own.
            let legacy = if name == "mtb" {
                "legacy = \"mtb\""
            } else {
                ""
            };
            assert_eq!(keys(&findings, "icub_imu"), legacy, "{name}");
        }
    }
}

#[test]
fn what_no_board_answers_is_no_answer() {
    let answer = "730#FF0C020008";
    assert_eq!(found(&[(answer, 0.0)]).len(), 2);
    // An answer with a byte too many; with other frames that are no commands of the bootloader.
    assert_eq!(found(&[("730#FF0C02000801", 0.0)]), []);
    for other in ["730#10", "730#20", "730#FE", "730#"] {
        assert_eq!(found(&[(answer, 0.0), (other, 1.0)]), [], "{other}");
    }
    for known in ["730#0F", "730#0C0061626364"] {
        assert_eq!(found(&[(answer, 0.0), (known, 1.0)]).len(), 2, "{known}");
    }
    // These boards know no CAN FD.
    for (id, data) in [
        (0x730, &[0xFF, 0x0C, 2, 0, 8][..]),
        (0x230, &[0x1C, 0x0C, 2, 0, 8, 2, 0, 1]),
    ] {
        let classic = Frame::new(Id::standard(id), data);
        let fd = Frame::with_format(Id::standard(id), FD, data).unwrap();
        for (frame, boards) in [(classic, 2), (fd, 0)] {
            let mut heard = Traffic::new();
            heard.on_frame(&frame);
            assert_eq!(icub(&heard).len(), boards, "{frame}");
        }
    }
}

/// Where another program has asked for the version, nobody needs to ask. The bits are those of the
/// identifier (12), of the command, the type and the last byte (1; 0 counts one), less those of one
/// driver of 32 and of 14 addresses.
#[test]
fn an_answer_to_another_program_names_a_board() {
    for (answer, driver, what, types, fits) in [
        (
            "230#1C0C020008020001",
            "icub_strain",
            "strain2, firmware 2.0.8",
            3_f64,
            7.0,
        ),
        (
            "230#1C07010203020000",
            "icub_mais",
            "mais, firmware 1.2.3",
            1.0,
            1.0,
        ),
        (
            "030#5B08020105020001",
            "icub_motor",
            "2foc, firmware 2.1.5",
            4.0,
            7.0,
        ),
    ] {
        let findings = found(&[(answer, 0.0)]);
        let finding = findings.iter().find(|finding| finding.driver == driver);
        let finding = finding.unwrap_or_else(|| panic!("{driver} is not found"));
        assert_eq!((finding.address, finding.what.as_str()), (3, what));
        let bits = 12.0 + 8.0 + (8.0 - types.log2()) + fits - 5.0 - 14_f64.log2();
        assert!((finding.bits - bits).abs() < 0.01, "{finding:?}");
    }
    // It does not say whether the protocols fit; it answers a motor's question.
    for other in ["230#1C0C020008020002", "230#5B0C020008020001"] {
        assert_eq!(found(&[(other, 0.0)]), [], "{other}");
    }
    // Other protocols use its identifier: a type that nobody knows is none, and refutes nothing.
    let unknown = ("230#1C77020008020001", 5.0);
    let findings = found(&[
        ("33A#008000800080", 0.0),
        ("33B#008000800080", 0.2),
        unknown,
    ]);
    assert_eq!(findings.len(), 1, "{findings:?}");
    assert_eq!(findings[0].what, "iCub board");
}

/// Each first group of frames is a board's; one byte or the length of the others is not.
#[test]
fn frames_that_a_board_does_not_send_refute_it() {
    let strain: &[&str] = &["31A#008000800080", "31B#008000800080"];
    let cases: [(&str, &[&str], &[&str]); 6] = [
        (
            "icub_strain",
            strain,
            &["31A#0080008000", "31B#00800080008001FF"],
        ),
        (
            "icub_mc4",
            &["111#0000010000FCFFFF", "113#0001000100000000"],
            &["113#000100EE00000000", "113#00EE000100000000"],
        ),
        (
            "icub_motor",
            &["110#E803FFFF00000100", "113#061F007D81400080"],
            &["113#0620007D81400080", "113#EE1F007D81400080"],
        ),
        (
            "icub_pos",
            &["311#0023840384038403", "311#0151840300000000"],
            &[
                "311#0223840384038403",
                "311#0020840384038403",
                "311#0024840384038403",
            ],
        ),
        (
            "icub_imu",
            &["513#010000009CFFD503", "513#0106A0050000F8FF"],
            &[
                "513#0104A0050000F8FF",
                "513#0107A0050000F8FF",
                "513#0102A0050000F8",
            ],
        ),
        (
            "icub_imu",
            &["515#01030002A00F0000"],
            &[
                "515#01040002A00F0000",
                "515#01030402A00F0000",
                "515#01030004A00F0000",
                "515#01030002A00F00",
            ],
        ),
    ];
    for (driver, own, foreign) in cases {
        let is_found = |other: Option<&str>| {
            let frames: Vec<(&str, f64)> = own
                .iter()
                .copied()
                .chain(other)
                .zip((0..).map(f64::from))
                .collect();
            found(&frames)
                .iter()
                .any(|finding| finding.driver == driver)
        };
        assert!(is_found(None), "{driver}");
        for other in foreign {
            assert!(!is_found(Some(other)), "{driver} {other}");
        }
    }
}

/// A board with labels 2 and 3 in one frame, 4 and 7 in others between them.
#[test]
fn encoders_tell_their_labels_and_their_quantity() {
    for (quantity, expected) in [
        ("00", "period_ms = 10"),
        ("01", "quantity = \"length\"; period_ms = 10"),
    ] {
        let frames = ["22", "41", "71"].map(|label| format!("311#{quantity}{label}840300000000"));
        let times = [0.0, 3.0, 5.0];
        let frames: Vec<(&str, f64)> = frames.iter().map(String::as_str).zip(times).collect();
        let findings = found(&frames);
        assert_eq!(keys(&findings, "icub_pos"), expected);
        assert_eq!(findings[0].joints, [2, 3, 4, 7]);
    }
    // Labels end at 15.
    let findings = found(&[("311#00F2840300000000", 0.0)]);
    assert_eq!(findings[0].joints, [15]);
}

#[test]
fn a_strain_board_tells_what_it_streams() {
    let calibrated = [("31A#008000800080", 0.0), ("31B#008000800080", 0.2)];
    let raw = [("318#008000800080", 0.4), ("319#008000800080", 0.6)];
    for (frames, expected) in [
        (&calibrated[..], "period_ms = 10"),
        (&raw, "period_ms = 10; stream = \"uncalibrated\""),
        (
            &[calibrated, raw].concat(),
            "period_ms = 10; stream = \"both\"",
        ),
    ] {
        assert_eq!(keys(&found(frames), "icub_strain"), expected);
    }
}

/// The scale of legacy frames is that of the board, which only the board's type tells. A board that
/// sends both kinds of frames is read by the newer ones.
#[test]
fn the_scale_of_legacy_frames_is_that_of_the_boards_type() {
    let legacy = [("511#0040000000C0", 0.0), ("510#00400000FFFF", 0.3)];
    let triple = ("513#0100A0050000F8FF", 0.6);
    let (mtb, strain2) = (("710#FF05020008", 5.0), ("710#FF0C020008", 5.0));
    let [a, b] = legacy;
    let newer = "period_ms = 10; quantities = [\"acceleration\"]";
    let alone = |legacy: &str, quantity: &str| {
        let mask = if quantity == "acceleration" { 2 } else { 4 };
        format!(
            "legacy = \"{legacy}\"; quantities = [\"{quantity}\"]; legacy_mask = {mask}; \
             period_ms = 10"
        )
    };
    for (frames, expected) in [
        (&[a, b, mtb][..], "legacy = \"mtb\"; period_ms = 10"),
        (&[a, b, strain2], "legacy = \"bno055\"; period_ms = 10"),
        // A board that is set to send one of them.
        (&[a, mtb], &alone("mtb", "acceleration")),
        (&[b, mtb], &alone("mtb", "angular_velocity")),
        (&[a, strain2], &alone("bno055", "acceleration")),
        (&[b, strain2], &alone("bno055", "angular_velocity")),
        (&[a, b, triple, strain2], newer),
        (&[a, b, triple], newer),
        (&[strain2], ""),
    ] {
        assert_eq!(keys(&found(frames), "icub_imu"), expected);
    }
    // A device with these keys reads what was heard.
    for heard in [
        &[a, mtb][..],
        &[b, mtb],
        &[a, b, mtb],
        &[a, strain2],
        &[b, strain2],
    ] {
        let keys = keys(&found(heard), "icub_imu").replace("; ", "\n");
        let frames = heard.iter().map(|(text, ms)| frame(text, *ms));
        let mut device = listener("icub_imu", &keys, &[]);
        let (readings, _) = decode(&mut *device, &frames.collect::<Vec<_>>());
        assert_eq!(readings.len(), 1, "{keys}");
    }
    // Of a board that has not told its type a person must say it.
    let findings = found(&legacy);
    assert_eq!(
        keys(&findings, "icub_imu"),
        "legacy = \"mtb\"; period_ms = 10"
    );
    assert!(findings[0].keys[0].note.contains("which board"));
}
