//! Force and torque frames have no sequence number. They must never be paired across readings, even
//! if frames are lost or late.

use crate::rig::{board, count, decode, encode, listener};
use proprio_drivers::{Frame, Id};
use proprio_topics::{Counter, Nanos, Quality, Reading, StampKind, Wrench};
use proptest::prelude::*;

const KEYS: &str = "full_scale_n = [32768, 32768, 32768]\nfull_scale_nm = [32768, 32768, 32768]";
const PERIOD_US: i64 = 10_000;
/// Delay from a force frame to its torque frame on a bus without other traffic.
const USUAL_US: i64 = 150;

/// The two frames of reading `number`; both contain that number, with a step of 1 N or 1 Nm.
fn halves(number: u16) -> [Frame; 2] {
    let value = f64::from(number);
    let reading = Reading::Wrench(Wrench {
        force: [value; 3],
        torque: [value; 3],
    });
    encode(
        &mut *board("icub_strain", KEYS, &[]),
        0,
        &reading,
        Quality::GOOD,
    )
    .try_into()
    .unwrap()
}

fn at(frame: Frame, us: i64) -> Frame {
    frame.at(Nanos::from_micros(us), StampKind::Software)
}

/// As [`numbers_at`] a period of 10 ms.
fn numbers(frames: &[Frame]) -> (Vec<u16>, Vec<bool>, u32) {
    numbers_at(PERIOD_US, frames)
}

/// The numbers of the decoded readings, which must be equal in force and torque, and whether each
/// has GAP_BEFORE; the number of unpaired halves.
fn numbers_at(period_us: i64, frames: &[Frame]) -> (Vec<u16>, Vec<bool>, u32) {
    let keys = format!("{KEYS}\nperiod_ms = {}", period_us / 1000);
    let (readings, faults) = decode(&mut *listener("icub_strain", &keys, &[]), frames);
    let numbers = readings
        .iter()
        .map(|stamped| {
            let Reading::Wrench(wrench) = stamped.reading else {
                panic!("{stamped:?}")
            };
            assert_eq!(wrench.force, wrench.torque, "halves of two readings");
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let number = wrench.force[0] as u16;
            number
        })
        .collect();
    let gaps = readings
        .iter()
        .map(|stamped| stamped.quality.contains(Quality::GAP_BEFORE))
        .collect();
    (numbers, gaps, count(&faults, Counter::Unpaired))
}

/// Frames named `F1` or `T1`, at times in units of a period.
fn sequence(items: &[(&str, f64)]) -> Vec<Frame> {
    items
        .iter()
        .map(|(name, periods)| {
            let [force, torque] = halves(name[1..].parse().unwrap());
            #[allow(clippy::cast_possible_truncation)]
            at(
                if name.starts_with('F') { force } else { torque },
                (periods * PERIOD_US as f64) as i64,
            )
        })
        .collect()
}

#[test]
fn a_late_torque_is_not_paired_with_the_next_force() {
    let frames = sequence(&[
        ("F0", 0.0),
        ("T0", 0.015),
        ("F1", 1.0),
        ("F2", 2.0),
        ("T1", 2.01),
        ("T2", 2.015),
        ("F3", 3.0),
        ("T3", 3.015),
    ]);
    let (numbers, gaps, unpaired) = numbers(&frames);
    assert_eq!(
        (numbers, gaps, unpaired),
        (vec![0, 3], vec![false, true], 4)
    );
}

/// The first torque's force was sent before anybody listened: nothing is lost, and no gap is in
/// what follows. A later torque without its force is counted.
#[test]
fn a_stream_may_be_joined_between_two_halves() {
    let (numbers, gaps, unpaired) = numbers(&sequence(&[
        ("T0", 0.015),
        ("F1", 1.0),
        ("T1", 1.015),
        ("T2", 2.015),
        ("F3", 3.0),
        ("T3", 3.015),
    ]));
    assert_eq!(
        (numbers, gaps, unpaired),
        (vec![1, 3], vec![false, true], 1)
    );
}

#[test]
fn order_alone_decides_where_there_are_no_stamps() {
    let mut frames = sequence(&[
        ("F0", 0.0),
        ("T0", 0.0),
        ("F1", 0.0),
        ("F2", 0.0),
        ("T1", 0.0),
        ("T2", 0.0),
        ("F3", 0.0),
        ("T3", 0.0),
        ("F4", 0.0),
        ("F5", 0.0),
        ("T5", 0.0),
        ("F6", 0.0),
        ("T6", 0.0),
        ("T7", 0.0),
        ("F8", 0.0),
        ("T8", 0.0),
    ]);
    for frame in &mut frames {
        *frame = frame.at(Nanos::ZERO, StampKind::None);
    }
    let (numbers, gaps, unpaired) = numbers(&frames);
    assert_eq!(numbers, [0, 3, 6, 8]);
    assert_eq!(gaps, [false, true, true, true]);
    assert_eq!(unpaired, 4 + 3 + 1);
}

#[test]
fn a_torque_too_long_after_its_force_is_not_paired_either() {
    let (numbers, _, unpaired) = numbers(&sequence(&[
        ("F0", 0.0),
        ("T0", 0.6),
        ("F1", 1.0),
        ("T1", 1.015),
    ]));
    assert_eq!((numbers, unpaired), (vec![1], 2));
}

/// The late torque of reading 1 comes after force 3, whose own torque is lost: more than two
/// periods late, but not as quickly after a force as usual.
#[test]
fn in_doubt_a_torque_must_follow_its_force_as_quickly_as_usual() {
    let (numbers, gaps, unpaired) = numbers(&sequence(&[
        ("F0", 0.0),
        ("T0", 0.015),
        ("F1", 1.0),
        ("F2", 2.0),
        ("T2", 2.015),
        ("F3", 3.0),
        ("T1", 3.2),
        ("F4", 4.0),
        ("T4", 4.015),
    ]));
    assert_eq!(
        (numbers, gaps, unpaired),
        (vec![0, 4], vec![false, true], 5)
    );
}

/// A frame without a stamp has no time at which it could be too late or too early.
#[test]
fn nothing_expires_without_a_stamp() {
    for stamped in [[false, true], [true, false], [false, false]] {
        let mut frames = sequence(&[("F0", 3.0), ("T0", 9.0), ("F1", 10.0), ("T1", 10.015)]);
        for (frame, has_stamp) in frames.iter_mut().zip(stamped) {
            if !has_stamp {
                *frame = frame.at(Nanos::ZERO, StampKind::None);
            }
        }
        let (numbers, _, unpaired) = numbers(&frames);
        assert_eq!((numbers, unpaired), (vec![0, 1], 0), "{stamped:?}");
    }
}

/// In doubt, a second half must come within twice the usual delay and the time of a frame; as long
/// as none is usual, within half of what the period allows. The usual delay follows the bus.
#[test]
fn in_doubt_the_usual_delay_decides() {
    for (delays, delay, is_read) in [
        // (2 * 150 + 125) us, and (2 * 400 + 125) us.
        (&[(150, 1)][..], 420, true),
        (&[(150, 1)], 430, false),
        (&[(400, 30)], 900, true),
        (&[(400, 30)], 950, false),
        (&[(150, 1), (400, 60)], 900, true),
        (&[(400, 1), (150, 60)], 420, true),
        (&[(400, 1), (150, 60)], 700, false),
        // Half of 0.3 ms and half a period.
        (&[], 2600, true),
        (&[], 2700, false),
    ] {
        let mut frames = Vec::new();
        let mut number = 100_u16;
        let mut reading = |frames: &mut Vec<Frame>, delays: &[i64]| {
            let [force, torque] = halves(number);
            let t = i64::from(number) * PERIOD_US;
            frames.push(at(force, t));
            frames.extend(delays.iter().map(|delay| at(torque, t + delay)));
            number += 1;
        };
        for (delay, count) in delays {
            (0..*count).for_each(|_| reading(&mut frames, &[*delay]));
        }
        let before = frames.len() / 2;
        // A second half that is lost: the next one may be the late one.
        reading(&mut frames, &[]);
        reading(&mut frames, &[150]);
        reading(&mut frames, &[delay]);
        let (numbers, _, _) = numbers(&frames);
        assert_eq!(
            numbers.len() - before,
            usize::from(is_read),
            "{delays:?} {delay}"
        );
    }
}

/// At 1 kHz a second half may be late by the jitter of an adapter, unless the bus has been calm:
/// all second halves came within 0.3 ms and a quarter of the period.
#[test]
fn a_calm_bus_has_a_shorter_limit() {
    for (usual, readings, delay, is_read) in [
        (150, 300, 790, true),
        (150, 300, 810, false),
        (540, 300, 810, false),
        (560, 300, 810, true),
        (560, 300, 1290, true),
        (560, 300, 1310, false),
        // Calm begins with 192 readings.
        (150, 191, 810, true),
        (150, 192, 810, false),
    ] {
        let mut frames = Vec::new();
        for number in 0..=readings {
            let [force, torque] = halves(number);
            let t = i64::from(number) * 1000;
            let delay = if number == readings { delay } else { usual };
            frames.extend([at(force, t), at(torque, t + delay)]);
        }
        let (numbers, _, _) = numbers_at(1000, &frames);
        let read = usize::from(readings) + usize::from(is_read);
        assert_eq!(numbers.len(), read, "{usual} {readings} {delay}");
    }
}

/// The stamps of a stream at 1 kHz, each frame delayed by 0 to 1 ms and none before the last.
fn jittered(delays: impl Iterator<Item = i64>, lag: i64) -> Vec<i64> {
    let mut last = 0;
    delays
        .zip(0..)
        .map(|(delay, k)| {
            last = last.max(k / 2 * 1000 + k % 2 * lag + delay);
            last
        })
        .collect()
}

#[test]
fn an_adapter_that_jitters_by_a_millisecond_loses_no_reading_at_1_khz() {
    for (lag, first) in [(110, 1_u64), (150, 2), (290, 3)] {
        // A linear congruential generator (Knuth's MMIX).
        let mut state = first;
        let delays = core::iter::repeat_with(|| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            i64::try_from((state >> 33) % 1001).unwrap()
        });
        let times = jittered(delays.take(200_000), lag);
        let mut all = Vec::new();
        for (number, pair) in times.chunks(2).enumerate() {
            let number = u16::try_from(number % 30_000).unwrap();
            let [force, torque] = halves(number);
            all.extend([at(force, pair[0]), at(torque, pair[1])]);
        }
        let (numbers, _, unpaired) = numbers_at(1000, &all);
        assert_eq!((numbers.len(), unpaired), (100_000, 0), "lag {lag}");
    }
}

#[test]
fn two_boards_do_not_disturb_each_other() {
    let other = |frame: &Frame| {
        let Id::Standard(id) = frame.id else {
            panic!("{frame}")
        };
        Frame::new(Id::standard(id + 0x10), frame.data()).at(frame.t, frame.stamp)
    };
    // 31A 32A 31B 32B: each device gets all frames and uses its own.
    let mut frames = Vec::new();
    for number in 0..50_u16 {
        let [force, torque] = halves(number);
        let t = i64::from(number) * PERIOD_US;
        let [force, torque] = [at(force, t), at(torque, t + 300)];
        frames.extend([force, other(&force), torque, other(&torque)]);
    }
    let (numbers, _, unpaired) = numbers(&frames);
    assert_eq!((numbers, unpaired), ((0..50).collect(), 0));
}

/// The fate of a torque frame.
#[derive(Debug, Clone, Copy)]
enum Fate {
    Comes,
    Lost,
    /// Late by this \[us\].
    Late(i64),
}

/// A period, and the fates of the torque frames of a stream.
fn fates() -> impl Strategy<Value = (i64, Vec<Fate>)> {
    prop_oneof![Just(1000), Just(PERIOD_US)].prop_flat_map(|period| {
        let fate = prop_oneof![
            6 => Just(Fate::Comes),
            2 => Just(Fate::Lost),
            2 => (0_i64..2 * period - USUAL_US - 1).prop_map(Fate::Late),
            // Into the gap between the next force and its torque: the hardest case.
            2 => (period - USUAL_US..=period).prop_map(Fate::Late),
        ];
        (Just(period), proptest::collection::vec(fate, 1..60))
    })
}

/// A period, and whether each frame of a stream is lost. At 1 kHz the bus must first have shown
/// that it does not jitter, and frequent losses would look like jitter.
fn losses() -> impl Strategy<Value = (i64, Vec<bool>)> {
    let lost = |share| proptest::collection::vec(proptest::bool::weighted(share), 2..100);
    prop_oneof![
        lost(0.2).prop_map(|lost| (PERIOD_US, lost)),
        lost(0.05).prop_map(|lost| {
            let steady = core::iter::repeat_n(false, 2 * 255);
            (1000, steady.chain(lost).collect())
        }),
    ]
}

proptest! {
    /// Any torque frames lost, any late by up to two periods unless the one before is late too.
    #[test]
    fn halves_of_two_readings_are_never_put_together((period, fates) in fates()) {
        let mut events = Vec::new();
        let mut late_before = false;
        let mut on_time = Vec::new();
        for (number, fate) in (0_u16..).zip(&fates) {
            let [force, torque] = halves(number);
            let t = i64::from(number) * period;
            events.push((t, at(force, t)));
            let delay = match fate {
                Fate::Lost => { late_before = false; continue }
                Fate::Late(delay) if !late_before && *delay > 0 => { late_before = true; *delay }
                Fate::Comes | Fate::Late(_) => { late_before = false; on_time.push(number); 0 }
            };
            let t = t + USUAL_US + delay;
            events.push((t, at(torque, t)));
        }
        events.sort_by_key(|(t, _)| *t);
        let frames: Vec<Frame> = events.into_iter().map(|(_, frame)| frame).collect();
        let halves_in = u32::try_from(frames.len()).unwrap();
        let (numbers, gaps, unpaired) = numbers_at(period, &frames);
        // The readings are in order, and every half is in a reading, counted, or (the last force)
        // still waiting.
        prop_assert!(numbers.is_sorted());
        let paired = 2 * u32::try_from(numbers.len()).unwrap();
        let seen = paired + unpaired;
        prop_assert!((halves_in - 1..=halves_in).contains(&seen), "{} of {}", seen, halves_in);
        // Every reading after a lost one has GAP_BEFORE.
        for (k, pair) in numbers.windows(2).enumerate() {
            prop_assert_eq!(gaps[k + 1], pair[1] != pair[0] + 1);
        }
    }

    /// An adapter that exchanges neighbours costs no reading; with losses as well, none is wrong.
    #[test]
    fn exchanged_halves_are_put_together(
        (period, lost) in losses(),
        exchanged in proptest::collection::vec(proptest::bool::weighted(0.4), 700),
        with_losses: bool,
    ) {
        // At 1 kHz losses among exchanges can look like jitter.
        let with_losses = with_losses && period == PERIOD_US;
        let mut frames = Vec::new();
        let mut expected = Vec::new();
        // Whoever joins hears one reading first: before, a torque may be without its force.
        for (number, half_lost) in (0_u16..).zip(lost.chunks(2)) {
            let halves = halves(number);
            let t = i64::from(number) * period;
            let lost = |half: usize| {
                with_losses && number > 0 && half_lost.get(half).copied().unwrap_or(false)
            };
            // Both are in one transfer of the adapter.
            let order = match number > 0 && exchanged[usize::from(number)] {
                true => [1, 0],
                false => [0, 1],
            };
            let there: Vec<usize> = order.into_iter().filter(|half| !lost(*half)).collect();
            let times = (0..).map(|k| t + USUAL_US + 20 * k);
            frames.extend(there.iter().zip(times).map(|(half, t)| at(halves[*half], t)));
            if there.len() == 2 { expected.push(number); }
        }
        let (numbers, _, unpaired) = numbers_at(period, &frames);
        prop_assert!(numbers.iter().all(|number| expected.contains(number)));
        if !with_losses {
            prop_assert_eq!((numbers, unpaired), (expected, 0));
        } else {
            let paired = 2 * u32::try_from(numbers.len()).unwrap();
            let all = u32::try_from(frames.len()).unwrap();
            let seen = paired + unpaired;
            prop_assert!((all - 1..=all).contains(&seen), "{} of {}", seen, all);
        }
    }

    /// Losses alone cost at most one more reading than the number of losses.
    #[test]
    fn a_loss_costs_at_most_the_reading_after_it(
        (period, lost) in losses()
    ) {
        let mut frames = Vec::new();
        let mut expected = Vec::new();
        for (number, half_lost) in (0_u16..).zip(lost.chunks(2)) {
            let [force, torque] = halves(number);
            let t = i64::from(number) * period;
            let lost = |half: usize| half_lost.get(half).copied().unwrap_or(false);
            if !lost(0) { frames.push(at(force, t)); }
            if !lost(1) { frames.push(at(torque, t + USUAL_US)); }
            if !lost(0) && !lost(1) { expected.push(number); }
        }
        let (numbers, _, _) = numbers_at(period, &frames);
        let hit = lost.chunks(2).filter(|halves| halves.contains(&true)).count();
        prop_assert!(numbers.iter().all(|number| expected.contains(number)));
        prop_assert!(numbers.len() + hit >= expected.len());
    }
}
