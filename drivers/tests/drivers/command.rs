//! Commands to a device that streams: tares and calibrations of F/T boards, with the bytes of their
//! protocols, their confirmation, and every way in which they can fail.

use crate::rig::{Rig, board, decode, frame, listener, options, poll, spec};
use proprio_drivers::calibration::{Calibration, Defect, MOST_CONDITION};
use proprio_drivers::{
    COMMAND_TIME, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device, Frame,
    Frames, Mode, NotSent, State,
};
use proprio_topics::{Counter, Nanos, Quality, Reading, Wrench};

const SCALES: &str = "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]\n";

/// The load of the protocol's worked example, whose frames are 31A#E380B76A1887 and
/// 31B#2184BE770881.
const LOAD: Wrench = Wrench {
    force: [12.5, -300.0, 100.0],
    torque: [1.0, -2.0, 0.25],
};

/// Minus the numbers of these frames.
const ANSWERS: [&str; 6] = [
    "210#1600FF1D",
    "210#16011549",
    "210#1602F8E8",
    "210#1603FBDF",
    "210#16040842",
    "210#1605FEF8",
];

fn streaming(keys: &str) -> Rig {
    let mut rig = Rig::new("icub_strain", keys, &[], (0, Reading::Wrench(LOAD)));
    rig.run(50);
    assert_eq!(rig.device.state(), State::Streaming);
    rig.sent.clear();
    rig.readings.clear();
    rig
}

fn tare(rig: &mut Rig) -> Result<(), CommandRefused> {
    rig.device.command(Command::Tare, rig.now)
}

/// The outcome and the time until it came \[ms\].
fn outcome(rig: &mut Rig) -> (Result<CommandOutcome, CommandFailed>, u32) {
    for ms in 0..2000 {
        if let Some(outcome) = rig.device.outcome() {
            assert_eq!(rig.device.outcome(), None, "it is given once");
            return (outcome, ms);
        }
        rig.run(1);
    }
    panic!("a command without an outcome")
}

fn values(rig: &Rig) -> Vec<([f64; 6], bool)> {
    let values = |reading: &Reading| match reading {
        Reading::Wrench(w) => {
            let ([a, b, c], [d, e, f]) = (w.force, w.torque);
            [a, b, c, d, e, f]
        }
        other => panic!("{other:?}"),
    };
    let readings = rig.readings.iter();
    readings
        .map(|r| {
            (
                values(&r.reading),
                r.quality.contains(Quality::ZERO_CHANGED),
            )
        })
        .collect()
}

#[test]
fn a_tare_is_commanded_once_and_read_back() {
    let mut rig = streaming(SCALES);
    rig.run(20);
    assert_eq!(tare(&mut rig), Ok(()));
    assert_eq!(tare(&mut rig), Err(CommandRefused::Busy));
    let (outcome, _) = outcome(&mut rig);
    let Ok(CommandOutcome::Tared(Some(added))) = outcome else {
        panic!("{outcome:?}")
    };
    for (added, load) in [(added.force, LOAD.force), (added.torque, LOAD.torque)] {
        for (added, load) in added.iter().zip(load) {
            assert!((added + load).abs() < 0.03, "{added} {load}");
        }
    }
    rig.run(40);
    let questions = (0..6).map(|axis| format!("201#160{axis}"));
    let wanted: Vec<_> = std::iter::once("201#1501".to_owned())
        .chain(questions)
        .collect();
    assert_eq!(rig.sent, wanted);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(rig.faults.iter().all(|f| f.counter == Counter::Starts));
    // The first reading with the new zero is marked, and those after it are not.
    let values = values(&rig);
    let first = values
        .iter()
        .position(|(v, _)| *v == [0.0; 6])
        .expect("a zero");
    assert!(first > 0 && values[0].0 != [0.0; 6]);
    let marked: Vec<bool> = values.iter().map(|(_, gap)| *gap).collect();
    assert!(marked[first] && !marked[..first].contains(&true));
    assert!(marked.len() > first + 3 && !marked[first + 1..].contains(&true));
    // It can be repeated; the zero stays.
    assert_eq!(tare(&mut rig), Ok(()));
}

#[test]
fn the_board_answers_with_what_it_adds() {
    let mut board = board("icub_strain", SCALES, &[]);
    let ask = |board: &mut dyn proprio_drivers::Board, text: &str| -> Vec<String> {
        let mut out = Frames::new();
        board.on_frame(&frame(text, 0.0), &mut out);
        out.iter().map(Frame::to_string).collect()
    };
    let sends = |board: &mut dyn proprio_drivers::Board| -> Vec<String> {
        let frames = crate::rig::encode(board, 0, &Reading::Wrench(LOAD), Quality::GOOD);
        frames.iter().map(Frame::to_string).collect()
    };
    assert_eq!(ask(&mut *board, "201#0700"), [""; 0]);
    assert_eq!(sends(&mut *board), ["31A#E380B76A1887", "31B#2184BE770881"]);
    assert_eq!(ask(&mut *board, "201#1602"), ["210#16020000"]);
    assert_eq!(ask(&mut *board, "201#1501"), [""; 0], "not acknowledged");
    for (axis, answer) in ANSWERS.iter().enumerate() {
        assert_eq!(ask(&mut *board, &format!("201#160{axis}")), [*answer]);
    }
    assert_eq!(sends(&mut *board), ["31A#008000800080", "31B#008000800080"]);
    // A second tare does not add to the first one.
    assert_eq!(ask(&mut *board, "201#1501"), [""; 0]);
    assert_eq!(ask(&mut *board, "201#1600"), [ANSWERS[0]]);
    // A given value, and none.
    assert_eq!(ask(&mut *board, "201#1502010001"), [""; 0]);
    assert_eq!(ask(&mut *board, "201#1601"), ["210#16010001"]);
    assert_eq!(ask(&mut *board, "201#1500"), [""; 0]);
    assert_eq!(sends(&mut *board), ["31A#E380B76A1887", "31B#2184BE770881"]);
}

#[test]
fn every_reading_is_marked_until_a_lost_answer_is_there() {
    let mut rig = streaming(SCALES);
    rig.run(20);
    let mut lost = 3;
    rig.board_loses = Box::new(move |_, frame| {
        let lose = frame.data().starts_with(&[0x16, 4]) && lost > 0;
        lost -= i32::from(lose);
        lose
    });
    assert_eq!(tare(&mut rig), Ok(()));
    let (outcome, ms) = outcome(&mut rig);
    assert!(
        matches!(outcome, Ok(CommandOutcome::Tared(_))),
        "{outcome:?}"
    );
    assert!((60..70).contains(&ms), "three times 20 ms: {ms}");
    let asked = |text: &str| rig.sent.iter().filter(|sent| *sent == text).count();
    assert_eq!(
        (asked("201#1501"), asked("201#1603"), asked("201#1604")),
        (1, 1, 4)
    );
    rig.run(40);
    let marked: Vec<bool> = values(&rig).iter().map(|(_, gap)| *gap).collect();
    let first = marked.iter().position(|gap| *gap).expect("a mark");
    let count = marked.iter().filter(|gap| **gap).count();
    assert!((6..=8).contains(&count), "{marked:?}");
    assert!(
        marked[first..first + count].iter().all(|gap| *gap),
        "{marked:?}"
    );
    assert!(marked.len() > first + count);
}

#[test]
fn a_tare_that_fails_says_how_and_leaves_the_stream_alone() {
    // No answer: whether it took effect is not known, so readings are marked.
    let mut rig = streaming(SCALES);
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x16));
    assert_eq!(tare(&mut rig), Ok(()));
    let (failed, ms) = outcome(&mut rig);
    assert_eq!(failed, Err(CommandFailed::NoAnswer));
    assert!((1000..=1010).contains(&ms), "{ms}");
    let asked = rig.sent.iter().filter(|s| *s == "201#1600").count();
    assert!((15..=18).contains(&asked), "{asked}");
    assert_eq!(rig.sent.iter().filter(|s| *s == "201#1501").count(), 1);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.count(Counter::Silences), 0);
    let sent = rig.sent.len();
    rig.run(100);
    assert_eq!(rig.sent.len(), sent, "it is over");

    // Not sent: nothing follows, and nothing is marked.
    let mut rig = streaming(SCALES);
    rig.interface =
        Box::new(|frame| (frame.data().first() == Some(&0x15)).then_some(NotSent::Deadline));
    assert_eq!(tare(&mut rig), Ok(()));
    assert_eq!(outcome(&mut rig).0, Err(CommandFailed::NotSent));
    rig.run(50);
    assert_eq!((rig.sent.len(), rig.unsent.len()), (0, 1));
    assert!(values(&rig).iter().all(|(_, gap)| !gap));

    // A restart, a stop and a silence end it.
    type End = fn(&mut Rig);
    let ends: [End; 3] = [
        |rig| rig.device.restart(rig.now),
        |rig| rig.device.stop(rig.now),
        |rig| rig.board_loses = Box::new(|_, _| true),
    ];
    for end in ends {
        let mut rig = streaming(SCALES);
        rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x16));
        assert_eq!(tare(&mut rig), Ok(()));
        rig.run(3);
        end(&mut rig);
        assert_eq!(outcome(&mut rig).0, Err(CommandFailed::Interrupted));
    }
    // Before it was sent, it is known to have had no effect.
    let mut rig = streaming(SCALES);
    assert_eq!(tare(&mut rig), Ok(()));
    rig.device.restart(rig.now);
    assert_eq!(outcome(&mut rig).0, Err(CommandFailed::NotSent));
    rig.run(50);
    assert!(!rig.sent.contains(&"201#1501".to_owned()));
}

/// A device that streams, without a board: every frame is given by hand.
struct ByHand {
    device: Box<dyn Device>,
    /// \[ms\]
    now: i64,
}

impl ByHand {
    fn new() -> Self {
        let device = options("icub_strain", SCALES)
            .device(&spec(1, Mode::Supervise, &[]))
            .expect("a legal configuration");
        let mut this = Self { device, now: 0 };
        for _ in 0..2 {
            let start = this.poll().expect("a start command");
            this.device.on_sent(&start, Ok(this.at()));
        }
        assert_eq!(
            (this.reading(), this.poll(), this.reading()),
            (false, None, false)
        );
        assert_eq!(this.device.command(Command::Tare, this.at()), Ok(()));
        assert_eq!(this.device.next_wake(), Some(Nanos::MIN), "at once");
        this
    }

    fn at(&self) -> Nanos {
        Nanos::from_millis(self.now)
    }

    fn poll(&mut self) -> Option<Frame> {
        let now = self.at();
        let transmit = self.device.poll_transmit(now, &mut Decoded::new())?;
        assert!(transmit.deadline > now && transmit.deadline <= now + Nanos::from_millis(100));
        Some(transmit.frame)
    }

    /// The frame that it sends now.
    fn send(&mut self) -> String {
        let frame = self.poll().expect("a frame");
        self.device.on_sent(&frame, Ok(self.at()));
        frame.to_string()
    }

    /// Whether a reading that comes a millisecond later is marked.
    fn reading(&mut self) -> bool {
        self.now += 1;
        let halves = ["31A#008000800080", "31B#008000800080"];
        let frames = halves.map(|half| frame(half, self.now as f64));
        let (readings, _) = decode(&mut *self.device, &frames);
        readings[0].quality.contains(Quality::ZERO_CHANGED)
    }

    fn answer(&mut self, text: &str) {
        let (_, faults) = decode(&mut *self.device, &[frame(text, self.now as f64)]);
        assert!(faults.is_empty(), "{faults:?}");
    }
}

#[test]
fn a_command_given_up_on_its_way_still_marks_the_readings() {
    let mut by_hand = ByHand::new();
    let command = by_hand.poll().expect("the command");
    assert_eq!(command.to_string(), "201#1501");
    // The board falls silent, comes back, and then the interface takes the frame.
    by_hand.now += 60;
    assert_eq!(by_hand.poll(), None);
    assert_eq!(
        by_hand.device.outcome(),
        Some(Err(CommandFailed::Interrupted))
    );
    assert!(!by_hand.reading(), "the command has not been sent");
    by_hand.device.on_sent(&command, Ok(by_hand.at()));
    assert!(by_hand.reading(), "the zero may be another one");
    assert!(!by_hand.reading());
    assert_eq!(by_hand.device.outcome(), None);
}

#[test]
fn answers_come_late_and_twice() {
    let mut by_hand = ByHand::new();
    assert_eq!(by_hand.send(), "201#1501");
    assert!(by_hand.reading(), "it may have been on its way");
    assert_eq!(by_hand.send(), "201#1600");
    by_hand.now += 20;
    assert_eq!(by_hand.send(), "201#1600");
    for _ in 0..2 {
        by_hand.answer(ANSWERS[0]);
    }
    for (axis, answer) in ANSWERS.iter().enumerate().skip(1) {
        assert_eq!(by_hand.send(), format!("201#160{axis}"));
        assert_eq!(by_hand.device.outcome(), None);
        by_hand.answer(answer);
    }
    assert!(by_hand.reading(), "the first that surely has the new zero");
    assert!(!by_hand.reading());
    let Some(Ok(CommandOutcome::Tared(Some(added)))) = by_hand.device.outcome() else {
        panic!("no outcome")
    };
    // -227 and 264 steps.
    assert!(
        (added.force[0] + 227.0 * 1804.0 / 32768.0).abs() < 1e-9,
        "{added:?}"
    );
    assert!(
        (added.torque[2] + 264.0 * 31.0 / 32768.0).abs() < 1e-9,
        "{added:?}"
    );
    assert_eq!(by_hand.poll(), None);
}

#[test]
fn a_tare_is_refused_where_it_cannot_be() {
    let mut rig = Rig::new("icub_strain", SCALES, &[], (0, Reading::Wrench(LOAD)));
    assert_eq!(tare(&mut rig), Err(CommandRefused::NotStreaming));
    let mut listens = Rig::started(
        "icub_strain",
        SCALES,
        Mode::Listen,
        (0, Reading::Wrench(LOAD)),
    );
    listens.run(30);
    assert_eq!(listens.device.state(), State::Streaming);
    assert_eq!(tare(&mut listens), Err(CommandRefused::ListenOnly));
    let mut raw = streaming(&format!("{SCALES}stream = \"uncalibrated\""));
    assert!(matches!(tare(&mut raw), Err(CommandRefused::Useless(_))));
    for (driver, keys, outputs) in [("icub_imu", "", &[][..]), ("icub_motor", "", &[0])] {
        let mut device = listener(driver, keys, outputs);
        let refused = device.command(Command::Tare, Nanos::ZERO);
        assert_eq!(refused, Err(CommandRefused::Unsupported), "{driver}");
        assert_eq!(device.outcome(), None);
    }
    for rig in [&mut rig, &mut listens, &mut raw] {
        assert_eq!(rig.device.outcome(), None);
        assert!(!rig.sent.contains(&"201#1501".to_owned()));
    }
}

#[test]
fn an_answer_that_nobody_asked_for_is_counted() {
    let mut rig = streaming(SCALES);
    let answers = ["210#16000001", "210#160001", "210#16060001"].map(|text| frame(text, 2000.0));
    let (readings, faults) = decode(&mut *rig.device, &answers);
    assert!(readings.is_empty());
    let counted: Vec<_> = faults.iter().map(|fault| fault.counter).collect();
    assert_eq!(
        counted,
        [Counter::Unexpected, Counter::Length, Counter::Value]
    );
    // Another program's answers are not for a device that only listens.
    let mut device = listener("icub_strain", SCALES, &[]);
    assert!(decode(&mut *device, &answers).1.is_empty());
}

#[test]
fn a_tare_that_a_silence_ends_marks_the_reading_after_it() {
    let mut by_hand = ByHand::new();
    assert_eq!(by_hand.send(), "201#1501");
    // No reading comes before the silence.
    by_hand.now += 60;
    for _ in 0..3 {
        if let Some(frame) = by_hand.poll() {
            by_hand.device.on_sent(&frame, Ok(by_hand.at()));
        }
    }
    assert_eq!(
        by_hand.device.outcome(),
        Some(Err(CommandFailed::Interrupted))
    );
    assert!(by_hand.reading(), "the first after it");
    assert!(!by_hand.reading());
}

fn calibration(rig: &mut Rig) -> Calibration {
    assert_eq!(rig.device.command(Command::Calibration, rig.now), Ok(()));
    match outcome(rig).0 {
        Ok(CommandOutcome::Calibration(calibration)) => calibration,
        other => panic!("{other:?}"),
    }
}

/// Writes an entry of the matrix into the memory of the board at address 1.
fn overwrite(rig: &mut Rig, row: u8, column: u8, entry: u16) {
    let text = format!("201#030{row}0{column}{entry:04X}");
    rig.board.on_frame(&frame(&text, 0.0), &mut Frames::new());
}

#[test]
fn a_calibration_is_read_while_the_board_streams() {
    let raw = format!("{SCALES}stream = \"uncalibrated\"");
    for keys in [SCALES, "", &raw] {
        let mut rig = streaming(keys);
        overwrite(&mut rig, 2, 5, 0xFD2E);
        overwrite(&mut rig, 5, 0, 0x0123);
        rig.run(20);
        let matrices = calibration(&mut rig);
        let Calibration::Fractions { full_scale, matrix } = matrices else {
            panic!("{matrices:?}")
        };
        assert_eq!(full_scale, [1804, 1804, 1804, 31, 31, 31]);
        let mut expected = [[0; 6]; 6];
        (0..6).for_each(|axis| expected[axis][axis] = i16::MAX);
        (expected[2][5], expected[5][0]) = (-722, 0x123);
        assert_eq!(matrix, expected);
        let scales = (0..6).map(|axis| format!("201#180{axis}"));
        let entries = (0..36).map(|k| format!("201#0A0{}0{}", k / 6, k % 6));
        assert_eq!(rig.sent, scales.chain(entries).collect::<Vec<_>>());
        assert_eq!(matrices.defects().as_slice(), []);
        // 1804 N at 32768 counts.
        let per_count = matrices.per_count().unwrap();
        assert!((per_count[2][5] * 32768.0 + 722.0 / 32768.0 * 1804.0).abs() < 1e-9);
        // The stream did not notice.
        rig.run(100);
        assert_eq!(rig.device.state(), State::Streaming);
        assert!(
            rig.faults.iter().all(|f| f.counter == Counter::Starts),
            "{:?}",
            rig.faults
        );
        assert!(rig.readings.len() >= 11);
        assert!(rig.readings.iter().all(|r| r.quality == Quality::GOOD));
        assert_eq!(calibration(&mut rig), matrices, "again");
        if keys == SCALES {
            assert_eq!(tare(&mut rig), Ok(()));
            assert!(matches!(
                outcome(&mut rig).0,
                Ok(CommandOutcome::Tared(Some(_)))
            ));
        }
    }
}

#[test]
fn a_calibration_that_cannot_be_read_says_why() {
    // Every third answer is lost; each question is repeated after 20 ms.
    let mut rig = streaming(SCALES);
    let mut count = 0;
    rig.board_loses = Box::new(move |_, frame| {
        count += u32::from(frame.id == proprio_drivers::Id::standard(0x210));
        frame.id == proprio_drivers::Id::standard(0x210) && count % 3 == 0
    });
    let learnt = calibration(&mut rig);
    assert_eq!(learnt.defects().as_slice(), []);
    assert_eq!(rig.count(Counter::Unexpected), 0);
    // An old firmware that does not know the question.
    let mut rig = streaming(SCALES);
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x0A));
    assert_eq!(rig.device.command(Command::Calibration, rig.now), Ok(()));
    assert_eq!(
        rig.device.command(Command::Calibration, rig.now),
        Err(CommandRefused::Busy)
    );
    let (failed, ms) = outcome(&mut rig);
    assert_eq!(failed, Err(CommandFailed::NoAnswer));
    assert!((1000..=1010).contains(&ms), "{ms}");
    rig.run(50);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(
        values(&rig).iter().all(|(_, gap)| !gap),
        "no zero has changed"
    );
    // A restart, then the full scales are asked for the bring-up again.
    let mut rig = streaming("");
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x18));
    assert_eq!(rig.device.command(Command::Calibration, rig.now), Ok(()));
    rig.run(3);
    rig.device.restart(rig.now);
    assert_eq!(outcome(&mut rig).0, Err(CommandFailed::Interrupted));
    rig.board_loses = Box::new(|_, _| false);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    // Who only listens does not ask.
    let mut listens = listener("icub_strain", SCALES, &[]);
    let refused = listens.command(Command::Calibration, Nanos::ZERO);
    assert_eq!(refused, Err(CommandRefused::ListenOnly));
    let answers = ["210#0A00000001", "210#180000FF"].map(|text| frame(text, 1.0));
    assert!(decode(&mut *listens, &answers[..1]).1.is_empty());
    // Answers that nobody asked for, too short, and beyond the matrix.
    let mut rig = streaming(SCALES);
    let answers = [
        "210#0A00007FFF",
        "210#0A0000",
        "210#0A06000001",
        "210#0A00060001",
    ];
    let answers = answers.map(|text| frame(text, 2000.0));
    let (_, faults) = decode(&mut *rig.device, &answers);
    let counted: Vec<_> = faults.iter().map(|fault| fault.counter).collect();
    assert_eq!(
        counted,
        [
            Counter::Unexpected,
            Counter::Length,
            Counter::Value,
            Counter::Value
        ]
    );
}

#[test]
fn what_is_wrong_with_a_calibration_is_named() {
    let mut rig = streaming(SCALES);
    for column in 0..6 {
        overwrite(&mut rig, 1, column, 0xFFFF);
    }
    overwrite(&mut rig, 4, 4, 0);
    let learnt = calibration(&mut rig);
    let words: Vec<String> = learnt.defects().iter().map(ToString::to_string).collect();
    let expected = [
        "the entry of fy, gauge 0 is FFFF, as in erased memory",
        "the row of ty is zero: it always reads zero",
    ];
    assert_eq!(words, expected);
    overwrite(&mut rig, 1, 4, 0);
    let words: Vec<_> = calibration(&mut rig).defects().into_iter().collect();
    assert_eq!(
        words[1..],
        [Defect::ZeroRow { axis: 4 }, Defect::ZeroColumn { gauge: 4 }]
    );

    let mut full_scale = [1804, 1804, 1804, 31, 31, 31];
    let mut matrix = [[0; 6]; 6];
    (0..6).for_each(|axis| matrix[axis][axis] = 20_000);
    let defects = |full_scale, matrix| -> Vec<Defect> {
        let fractions = Calibration::Fractions { full_scale, matrix };
        fractions.defects().into_iter().collect()
    };
    assert_eq!(defects(full_scale, matrix), []);
    full_scale[3] = 0;
    assert_eq!(
        defects(full_scale, matrix),
        [Defect::ZeroFullScale { axis: 3 }]
    );
    full_scale[3] = 31;
    // Two axes that are nearly the same, then the same.
    matrix[0] = [10_000, 10_000, 0, 0, 0, 0];
    matrix[1] = [10_000, 10_010, 0, 0, 0, 0];
    let [Defect::Condition { number }] = defects(full_scale, matrix)[..] else {
        panic!()
    };
    assert!(number > MOST_CONDITION && number.is_finite(), "{number}");
    matrix[1] = [10_000, 12_000, 0, 0, 0, 0];
    assert_eq!(defects(full_scale, matrix), []);
    matrix[1] = matrix[0];
    assert!(matches!(
        defects(full_scale, matrix)[..],
        [Defect::Condition { .. }]
    ));
    // The size of the numbers does not matter.
    matrix = [[0; 6]; 6];
    (0..6_i16).for_each(|axis| matrix[usize::try_from(axis).unwrap()][0] = 1 + axis);
    for (axis, row) in (0..6_i16).zip(&mut matrix) {
        row[usize::try_from(axis).unwrap()] += 5 * axis;
    }
    assert_eq!(defects(full_scale, matrix), []);
}

/// Counts and units as sensors have them: 1000 counts per 4 N, 500 counts per 0.25 Nm.
#[test]
fn what_a_gauge_count_means_follows_from_counts_and_units() {
    let mut matrix = [[0.0_f32; 6]; 6];
    for (entry, n) in matrix.iter_mut().flatten().zip(1_u8..) {
        *entry = f32::from(n);
    }
    let counts = Calibration::Counts {
        matrix,
        counts: [1000.0, 500.0],
        units: [4.0, 0.25],
    };
    let per_count = counts.per_count().expect("it is told");
    for (axis, row) in per_count.iter().enumerate() {
        let unit = if axis < 3 { 0.004 } else { 0.0005 };
        for (value, entry) in row.iter().zip(matrix[axis]) {
            assert!((value - f64::from(entry) * unit).abs() < 1e-15, "{axis}");
        }
    }
}

/// Two rows of length 1 at an angle `a`, and four at right angles: the squares of the matrix sum up
/// to 6, those of its inverse to 4 + 2 / sin(a)^2.
#[test]
fn axes_that_can_not_be_told_from_each_other_have_a_high_condition_number() {
    let full_scale = [100; 6];
    let mut matrix = [[0; 6]; 6];
    (0..6).for_each(|axis| matrix[axis][axis] = 30_000);
    let words = |matrix| {
        let fractions = Calibration::Fractions { full_scale, matrix };
        let defects = fractions.defects();
        (
            defects.first().copied(),
            defects.iter().map(ToString::to_string).collect::<Vec<_>>(),
        )
    };
    for tenths in [10_i16, 20, 300] {
        matrix[1] = [30_000, 3 * tenths, 0, 0, 0, 0];
        let sine = (f64::from(tenths) / 10_000.0).atan().sin();
        let right = (6.0 * (4.0 + 2.0 / (sine * sine))).sqrt();
        let (first, words) = words(matrix);
        if right < MOST_CONDITION {
            assert_eq!(first, None, "{right}");
            continue;
        }
        let Some(Defect::Condition { number }) = first else {
            panic!("{first:?}")
        };
        assert!((number / right - 1.0).abs() < 1e-6, "{number} {right}");
        let expected = format!(
            "the condition number is {right:.0}, above 1000: axes can not be told from each other"
        );
        assert_eq!(words, [expected]);
    }
    matrix[0] = [30_000, 30_000, 0, 0, 0, 0];
    matrix[1] = matrix[0];
    assert_eq!(words(matrix).1, ["the matrix is singular"]);
    matrix[0] = [30_000, 0, 0, 0, 0, 0];
    // An axis with small numbers only is told as well as another.
    matrix[1] = [0, 1, 0, 0, 0, 0];
    assert_eq!(words(matrix).1, [""; 0]);
}

#[test]
fn an_ati_sensor_tells_what_was_read_at_its_start() {
    let load = (0, Reading::Wrench(LOAD));
    let mut rig = Rig::new("ati_netcanoem", "", &[], load);
    let early = rig.device.command(Command::Calibration, rig.now);
    assert!(
        matches!(early, Err(CommandRefused::Unknown(_))),
        "{early:?}"
    );
    rig.run(300);
    assert_eq!(rig.device.state(), State::Streaming);
    let learnt = calibration(&mut rig);
    let Calibration::Counts {
        matrix,
        counts,
        units,
    } = learnt
    else {
        panic!("{learnt:?}")
    };
    assert_eq!((counts, units), ([1e6, 1e6], [1.0, 1.0]));
    assert_eq!((matrix[0][3], matrix[5][5]), (-13_200.0, 740.0));
    assert_eq!(learnt.defects().as_slice(), []);
    assert!((learnt.per_count().unwrap()[0][3] + 0.0132).abs() < 1e-9);
    assert_eq!(learnt.full_scale(), None);
    assert_eq!(tare(&mut rig), Err(CommandRefused::Unsupported));
    let mut broken = matrix;
    broken[2][1] = f32::NAN;
    let altered = Calibration::Counts {
        matrix: broken,
        counts,
        units,
    };
    assert_eq!(
        altered.defects().as_slice(),
        [Defect::NotFinite { axis: 2, gauge: 1 }]
    );
}

/// A tare of one frame: the readings with the old and with the new zero, and those marked.
fn tared(driver: &str, frame: &str) -> (Rig, Vec<([f64; 6], bool)>) {
    let mut rig = Rig::new(driver, "", &[], (0, Reading::Wrench(LOAD)));
    rig.run(2000);
    assert_eq!(rig.device.state(), State::Streaming);
    rig.reading.1 = Reading::Wrench(Wrench {
        force: [2.0, -3.0, 4.0],
        torque: [0.1, 0.2, -0.3],
    });
    rig.run(500);
    rig.readings.clear();
    rig.sent.clear();
    assert_eq!(tare(&mut rig), Ok(()));
    assert_eq!(tare(&mut rig), Err(CommandRefused::Busy));
    let (outcome, ms) = outcome(&mut rig);
    assert_eq!(outcome, Ok(CommandOutcome::Tared(None)));
    assert!(ms < 5, "{ms}");
    rig.run(300);
    assert_eq!(rig.sent, [frame]);
    let values = values(&rig);
    (rig, values)
}

#[test]
fn sensors_that_do_not_tell_their_zero_are_tared() {
    for (driver, command) in [
        ("robotous_rft", "064#1101000000000000"),
        ("jr3_can", "301#"),
    ] {
        let (mut rig, values) = tared(driver, command);
        let last = values.last().expect("readings");
        assert_eq!(*last, ([0.0; 6], false), "{driver}");
        let first = values.iter().position(|(v, _)| *v == [0.0; 6]).unwrap();
        assert!(
            values[first].1,
            "{driver}: the first with the new zero is marked"
        );
        // Not sent; given up before it was sent.
        rig.interface = Box::new(|_| Some(NotSent::Deadline));
        assert_eq!(tare(&mut rig), Ok(()));
        assert_eq!(outcome(&mut rig).0, Err(CommandFailed::NotSent));
        assert_eq!(tare(&mut rig), Ok(()));
        rig.device.restart(rig.now);
        assert_eq!(outcome(&mut rig).0, Err(CommandFailed::NotSent));
        assert_eq!(tare(&mut rig), Err(CommandRefused::NotStreaming));
        let mut listens = listener(driver, "", &[]);
        let refused = listens.command(Command::Tare, Nanos::ZERO);
        assert_eq!(refused, Err(CommandRefused::ListenOnly), "{driver}");
    }
    // A JR3 confirms; without its answer it is not known.
    let (mut rig, _) = tared("jr3_can", "301#");
    rig.board_loses = Box::new(|_, frame| frame.id == proprio_drivers::Id::standard(0x101));
    assert_eq!(tare(&mut rig), Ok(()));
    let (failed, ms) = outcome(&mut rig);
    assert_eq!(failed, Err(CommandFailed::NoAnswer));
    assert!((100..=103).contains(&ms), "{ms}");
    // Its full scales are known since its start.
    let learnt = calibration(&mut rig);
    assert_eq!(learnt.full_scale().map(|all| all[0].round()), Some(115.0));
    assert_eq!((learnt.per_count(), learnt.defects().len()), (None, 0));
    let refused = rig.device.full_scale().map(|all| all[5]);
    assert!(
        refused.is_some_and(|most| (most - 6.1).abs() < 1e-9),
        "{refused:?}"
    );
}

/// Nothing tells when a tare has taken effect: for 100 ms each reading may have either zero, and
/// the first after that is the first that surely has the new one.
#[test]
fn every_reading_that_may_have_the_old_zero_is_marked() {
    let (_, values) = tared("robotous_rft", "064#1101000000000000");
    let marks: Vec<bool> = values.iter().map(|(_, mark)| *mark).collect();
    let first = marks.iter().position(|mark| *mark).expect("a mark");
    let count = marks.iter().filter(|mark| **mark).count();
    // At 200 Hz.
    assert_eq!(count, 21, "{marks:?}");
    assert!(marks[first..first + count].iter().all(|mark| *mark));
    assert!(marks.len() > first + count);
}

/// A sensor that streams, a tare that was just commanded, and no limit of silence.
fn commanded(driver: &str) -> Rig {
    let mut rig = Rig::new(driver, "", &[], (0, Reading::Wrench(LOAD)));
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    rig.device.set_max_silence(Nanos::from_millis(10_000));
    assert_eq!(tare(&mut rig), Ok(()));
    assert_eq!(rig.device.next_wake(), Some(Nanos::MIN), "at once");
    rig
}

/// It would zero a load that nobody has seen.
#[test]
fn a_tare_that_is_too_late_is_not_sent() {
    for driver in ["robotous_rft", "jr3_can"] {
        let mut rig = commanded(driver);
        let last = rig.now + COMMAND_TIME;
        assert!(poll(&mut *rig.device, last).is_some(), "{driver}: in time");
        let mut rig = commanded(driver);
        let late = rig.now + COMMAND_TIME + Nanos(1);
        assert_eq!(poll(&mut *rig.device, late), None, "{driver}");
        let outcome = rig.device.outcome();
        assert_eq!(outcome, Some(Err(CommandFailed::NotSent)));
        assert_eq!(poll(&mut *rig.device, late), None, "it is over");
    }
}

/// A JR3 has 100 ms for its answer, and the device tells when they are over.
#[test]
fn a_tare_is_confirmed_in_time_or_not_at_all() {
    for answered in [true, false] {
        let mut rig = commanded("jr3_can");
        let now = rig.now;
        let command = poll(&mut *rig.device, now).expect("the command");
        let sent = now + Nanos::from_millis(4);
        rig.device.on_sent(&command, Ok(sent));
        let last = sent + Nanos::from_millis(100);
        assert_eq!(rig.device.next_wake(), Some(last + Nanos(1)));
        assert_eq!(poll(&mut *rig.device, last), None);
        assert_eq!(rig.device.outcome(), None);
        let expected = if answered {
            decode(&mut *rig.device, &[frame("101#00", last.seconds() * 1e3)]);
            Ok(CommandOutcome::Tared(None))
        } else {
            Err(CommandFailed::NoAnswer)
        };
        assert_eq!(poll(&mut *rig.device, last + Nanos(1)), None);
        assert_eq!(rig.device.outcome(), Some(expected));
    }
}

/// Live and in a recorded log, the same answers about the matrix are malformed. Those about a
/// stored regulation set are another program's; so are, in a log, all others.
#[test]
fn a_malformed_answer_about_the_matrix_is_one_whoever_asked() {
    for (answer, counter) in [
        ("210#0A", Some(Counter::Length)),
        ("210#0A0000112233", Some(Counter::Length)),
        ("210#0A06001122", Some(Counter::Value)),
        ("210#0A00061122", Some(Counter::Value)),
        ("210#0A46001122", Some(Counter::Value)),
        ("210#0A15051122", None),
        ("210#0A30001122", None),
    ] {
        let mut live = streaming(SCALES).device;
        let mut listening = listener("icub_strain", SCALES, &[]);
        for device in [&mut live, &mut listening] {
            let (_, faults) = decode(&mut **device, &[frame(answer, 60.0)]);
            let counters: Vec<Counter> = faults.iter().map(|fault| fault.counter).collect();
            assert_eq!(
                counters,
                counter.into_iter().collect::<Vec<_>>(),
                "{answer}"
            );
        }
    }
    let asked_by_another = [frame("210#0A00001122", 60.0), frame("210#16001122", 61.0)];
    let (_, faults) = decode(
        &mut *listener("icub_strain", SCALES, &[]),
        &asked_by_another,
    );
    assert!(faults.is_empty(), "{faults:?}");
}
