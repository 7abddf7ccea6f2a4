//! Tests of `Window`: exact results where possible, error bounds elsewhere, and errors instead of
//! panics.
//!
//! Angles are in degrees here, as in the figures of the module's documentation: the window has no
//! unit of its own.

use nalgebra::{DMatrix, DVector};
use proprio_estimator::differentiate::{
    Grid, MAX_SAMPLES, Pushed, Refused, Settings, SettingsError, SignalEstimate, Unavailable,
    Window,
};
use proprio_topics::Nanos;
use proptest::prelude::*;
use std::f64::consts::TAU;

/// Position, velocity, acceleration at a time \[s\].
type Motion<'a> = &'a dyn Fn(f64) -> [f64; 3];

/// A small random generator, so that the numbers are the same everywhere.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Standard normal, by the sum of twelve uniform numbers.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
}

/// How a benchmark samples its motion.
#[derive(Clone, Copy)]
struct Sampling {
    /// Intervals are uniformly distributed between these \[s\].
    interval: [f64; 2],
    quantum: f64,
    /// Standard deviation of the noise added before quantisation \[quanta\].
    jitter: f64,
    capacity: usize,
    /// Time of the estimate after the newest sample \[s\].
    after: f64,
}

const COARSE: Sampling = Sampling {
    interval: [0.01, 0.01],
    quantum: 0.055,
    jitter: 0.0,
    capacity: MAX_SAMPLES,
    after: 0.0,
};

/// Errors of value, velocity and acceleration over a run, and the stated standard deviations.
#[derive(Debug, Default)]
struct Errors {
    rms: [f64; 3],
    worst: [f64; 3],
    /// Share of errors within two of the stated standard deviations.
    covered: [f64; 3],
}

fn settings(sampling: Sampling) -> Settings {
    Settings {
        capacity: sampling.capacity,
        ..Settings::new(sampling.quantum / 2.0)
    }
}

fn channels(e: &SignalEstimate<1>) -> [[f64; 2]; 3] {
    [
        [e.value[0], e.value_std[0]],
        [e.first[0], e.first_std[0]],
        [e.second[0], e.second_std[0]],
    ]
}

/// Runs `seconds` of every motion, and compares after the first second of each.
fn run(motions: &[Motion<'_>], sampling: Sampling, seconds: f64) -> Errors {
    let (mut errors, mut count) = (Errors::default(), 0.0);
    for (seed, motion) in (1_u64..).zip(motions) {
        let mut random = Random(0x9E37_79B9_7F4A_7C15 ^ (seed * 77_777));
        let mut window = Window::<1>::new(settings(sampling)).unwrap();
        let mut now = 0.0;
        while now < seconds {
            let measured = motion(now)[0] + sampling.jitter * sampling.quantum * random.normal();
            let rounded = (measured / sampling.quantum).round() * sampling.quantum;
            window.push(Nanos::from_seconds(now), [rounded]).unwrap();
            if now > 1.0 {
                let at = now + sampling.after;
                let estimate = window.at(Nanos::from_seconds(at)).unwrap();
                for (m, ([e, std], truth)) in
                    channels(&estimate).into_iter().zip(motion(at)).enumerate()
                {
                    errors.rms[m] += (e - truth).powi(2);
                    errors.worst[m] = errors.worst[m].max((e - truth).abs());
                    errors.covered[m] += f64::from((e - truth).abs() < 2.0 * std);
                }
                count += 1.0;
            }
            now += sampling.interval[0]
                + (sampling.interval[1] - sampling.interval[0]) * random.uniform();
        }
    }
    errors.rms = errors.rms.map(|sum| (sum / count).sqrt());
    errors.covered = errors.covered.map(|n| n / count);
    println!("{errors:.5?}");
    errors
}

fn sine(amplitude: f64, hertz: f64, phase: f64, t: f64) -> [f64; 3] {
    let (w, (s, c)) = (TAU * hertz, (TAU * hertz * t + phase).sin_cos());
    [amplitude * s, amplitude * w * c, -amplitude * w * w * s]
}

/// Joint `j` of seven: three sines, 20 deg at about 0.3 Hz to 3 deg at 1.3 to 1.9 Hz.
fn arm(j: f64, t: f64) -> [f64; 3] {
    let a = sine(20.0, 0.25 + 0.02 * j, j, t);
    let b = sine(10.0, 0.6 + 0.05 * j, 2.0 * j, t);
    let c = sine(3.0, 1.3 + 0.1 * j, 3.0 * j, t);
    std::array::from_fn(|m| a[m] + b[m] + c[m])
}

/// At rest until 1.5 s, then a minimum-jerk motion of 40 deg in 0.8 s, then at rest.
fn reach(offset: f64, t: f64) -> [f64; 3] {
    let (whole, amplitude) = (0.8, 40.0);
    let u = ((t - 1.5) / whole).clamp(0.0, 1.0);
    [
        offset + amplitude * u.powi(3) * (10.0 - 15.0 * u + 6.0 * u * u),
        amplitude / whole * 30.0 * (u * (1.0 - u)).powi(2),
        amplitude / whole.powi(2) * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u),
    ]
}

const OFFSETS: [f64; 5] = [0.013, 7.0001, 0.0275, 3.04, -11.02];

fn with_arm(sampling: Sampling, seconds: f64) -> Errors {
    let joints: Vec<_> = (0..7).map(|j| move |t| arm(f64::from(j), t)).collect();
    run(
        &joints.iter().map(|m| m as Motion<'_>).collect::<Vec<_>>(),
        sampling,
        seconds,
    )
}

fn at_rest(sampling: Sampling) -> Errors {
    let motions = OFFSETS.map(|offset| move |_| [offset, 0.0, 0.0]);
    run(&motions.each_ref().map(|m| m as Motion<'_>), sampling, 5.0)
}

fn reaching(sampling: Sampling) -> Errors {
    let motions = OFFSETS.map(|offset| move |t| reach(offset, t));
    run(&motions.each_ref().map(|m| m as Motion<'_>), sampling, 3.5)
}

// Other adaptive windows on a sine of 20 deg, 0.5 Hz at 100 Hz with 0.055 deg: velocity RMS error
// moving / at rest 6.39 / 0.13 (line), 3.92 / 0.77 (line through the ends), 5.61 / 0.12 (best
// line), 2.43 / 0.26 deg/s (quadratic). The bounds below are the figures of `Window`, rounded up.

#[test]
fn a_sine_seen_by_a_coarse_encoder() {
    let motion = |t| sine(20.0, 0.5, 0.0, t);
    for (what, sampling, velocity, acceleration) in [
        ("at the newest sample", COARSE, 0.7, 16.0),
        (
            "window of 64",
            Sampling {
                capacity: 64,
                ..COARSE
            },
            0.8,
            19.0,
        ),
        (
            "half a period back",
            Sampling {
                after: -0.005,
                ..COARSE
            },
            0.65,
            15.0,
        ),
        (
            "half a period ahead",
            Sampling {
                after: 0.005,
                ..COARSE
            },
            0.75,
            17.0,
        ),
        (
            "0.3 quanta of noise",
            Sampling {
                jitter: 0.3,
                ..COARSE
            },
            0.8,
            20.0,
        ),
        (
            "irregular stamps",
            Sampling {
                interval: [0.005, 0.017],
                ..COARSE
            },
            0.8,
            19.0,
        ),
    ] {
        let errors = run(&[&motion], sampling, 8.0);
        assert!(
            errors.rms[1] < velocity && errors.rms[2] < acceleration,
            "{what}: {errors:?}"
        );
        assert!(
            errors.covered.iter().all(|share| *share > 0.7),
            "{what}: {errors:?}"
        );
    }
}

#[test]
fn nothing_moves_at_rest() {
    for (what, jitter, velocity, acceleration) in [
        ("no noise", 0.0, 1e-9, 1e-6),
        ("rare ticks", 0.05, 0.1, 0.5),
        ("ticks all the time", 0.3, 0.1, 0.5),
    ] {
        let errors = at_rest(Sampling { jitter, ..COARSE });
        assert!(
            errors.rms[1] < velocity && errors.rms[2] < acceleration,
            "{what}: {errors:?}"
        );
        // A plain second difference gives 550 deg/s^2 for one tick in neighbouring samples.
        assert!(
            errors.worst[1] < 0.5 && errors.worst[2] < 3.0,
            "{what}: {errors:?}"
        );
    }
    let short = at_rest(Sampling {
        jitter: 0.3,
        capacity: 64,
        ..COARSE
    });
    assert!(short.rms[1] < 0.26 && short.worst[2] < 10.0, "{short:?}");
}

#[test]
fn an_arm_with_fine_encoders() {
    let fine = |interval: f64| Sampling {
        interval: [interval; 2],
        quantum: 5.5e-5,
        ..COARSE
    };
    let errors = with_arm(fine(0.004), 4.0);
    assert!(
        errors.rms[1] < 0.01 && errors.rms[2] < 1.6,
        "250 Hz: {errors:?}"
    );
    let errors = with_arm(fine(0.001), 2.0);
    assert!(
        errors.rms[1] < 0.01 && errors.rms[2] < 1.4,
        "1 kHz: {errors:?}"
    );
}

#[test]
fn the_onset_of_motion_is_not_overshot() {
    // The peaks of the motion: 93.75 deg/s and 360.8 deg/s^2.
    let coarse = reaching(COARSE);
    assert!(
        coarse.worst[1] < 10.0 && coarse.worst[2] < 360.8,
        "{coarse:?}"
    );
    let fine = reaching(Sampling {
        interval: [0.001; 2],
        quantum: 5.5e-5,
        ..COARSE
    });
    assert!(
        fine.worst[1] < 0.2 && fine.worst[2] < 40.0 && fine.rms[2] < 3.0,
        "{fine:?}"
    );
}

/// Stamps from intervals in microseconds.
fn stamps(start: i64, intervals: &[i64]) -> Vec<Nanos> {
    intervals
        .iter()
        .scan(Nanos(start), |t, dt| {
            *t += Nanos::from_micros(*dt);
            Some(*t)
        })
        .collect()
}

proptest! {
    /// Any polynomial up to the second degree is reproduced with any stamps: at a sample, between
    /// two samples and beyond them.
    #[test]
    fn quadratics_are_exact(
        start in -1_000_000_000_000_000_i64..1_000_000_000_000_000,
        intervals in prop::collection::vec(200_i64..20_000, 3..200),
        coefficients in prop::array::uniform3(-10.0..10.0_f64),
        degree in 0_usize..3,
        noise in 1e-6..1.0_f64,
        ahead in -1.0..1.0_f64,
    ) {
        let stamps = stamps(start, &intervals);
        let last = *stamps.last().unwrap();
        let c: [f64; 3] = std::array::from_fn(|k| if k <= degree { coefficients[k] } else { 0.0 });
        let signal = |t: Nanos| {
            let s = (t - last).seconds();
            [c[0] + s * (c[1] + s * c[2]), c[1] + 2.0 * s * c[2], 2.0 * c[2]]
        };
        let mut window = Window::<1>::new(Settings::new(noise)).unwrap();
        for t in &stamps {
            window.push(*t, [signal(*t)[0]]).unwrap();
        }
        let before = stamps[stamps.len() - 2];
        let span = (last - window.oldest().unwrap().0).seconds().min(1.0);
        for t in [last, before, last + Nanos::from_seconds(ahead * (last - before).seconds())] {
            let e = window.at(t).unwrap();
            let scale = 1e-12 * (1.0 + c[0].abs() + c[1].abs() + c[2].abs());
            for (m, ([got, std], want)) in channels(&e).into_iter().zip(signal(t)).enumerate() {
                // The rounding error of the samples, times the noise gain of the window.
                let allowed = scale / (span / 4.0).powi(i32::try_from(m).unwrap());
                prop_assert!(
                    (got - want).abs() <= allowed,
                    "{m}: {got} for {want}, allowed {allowed}"
                );
                prop_assert!(std > 0.0);
            }
            prop_assert_eq!(e.ahead, window.newest_for(t, Nanos::MAX).unwrap() - t);
        }
    }

    /// No input causes a panic, and every estimate is finite.
    #[test]
    fn whatever_comes_is_refused_or_finite(
        samples in prop::collection::vec(
            (any::<i64>(), prop::array::uniform3(any::<f64>())),
            0..40,
        ),
        close in prop::collection::vec(
            (1_i64..2_000, prop::array::uniform3(-1e200..1e200_f64)),
            0..200,
        ),
        instants in prop::collection::vec((any::<i64>(), any::<i64>()), 1..10),
    ) {
        let mut window = Window::<3>::new(Settings::new(1e-3)).unwrap();
        let mut ask = Vec::new();
        for (t, v) in samples {
            let before = window.newest();
            match window.push(Nanos(t), v) {
                Ok(_) => prop_assert!(before.is_none_or(|(newest, _)| Nanos(t) > newest)),
                Err(_) => prop_assert_eq!(window.newest(), before),
            }
        }
        window.clear();
        let mut t = Nanos::ZERO;
        for (dt, v) in close {
            t += Nanos(dt);
            prop_assert!(window.push(t, v).is_ok());
            ask.push((t, Nanos::MAX));
            ask.push((t - Nanos(dt / 2), t));
        }
        ask.extend(instants.into_iter().map(|(t, until)| (Nanos(t), Nanos(until))));
        for (t, until) in ask {
            if let Ok(e) = window.at_using(t, until) {
                let all = [e.value, e.first, e.second, e.value_std, e.first_std, e.second_std];
                for v in all.as_flattened() {
                    prop_assert!(v.is_finite());
                }
                prop_assert!(e.samples.iter().all(|n| (3..=MAX_SAMPLES).contains(n)));
            }
        }
    }

    /// The estimate is the least-squares polynomial of the reported samples, of the degree whose
    /// windows may be that long; the reference is a decomposition of the matrix of powers. Sharing
    /// a grid between channels, with equal or other stamps, does not change a bit.
    #[test]
    fn estimates_are_least_squares_polynomials_of_the_samples_named(
        start in -1_000_000_000_000_000_000_i64..1_000_000_000_000_000_000,
        step in 500_i64..8_000,
        jitter in prop::collection::vec(0.6..1.4_f64, 130),
        errors in prop::collection::vec(-1.0..1.0_f64, 130),
        noise in 1e-6..1e-2_f64,
        hertz in 0.1..4.0_f64,
        ahead in -1.0..1.0_f64,
        capacity in 20_usize..=MAX_SAMPLES,
    ) {
        let intervals: Vec<i64> = jitter.iter().map(|j| (step as f64 * j) as i64).collect();
        let stamps = stamps(start, &intervals);
        let settings = Settings { capacity, ..Settings::new(noise) };
        let [mut window, mut other] = [(); 2].map(|()| Window::<1>::new(settings).unwrap());
        let mut samples = Vec::new();
        for (t, error) in stamps.iter().zip(&errors) {
            let value = sine(0.5, hertz, 1.0, (*t - stamps[0]).seconds())[0] + noise * error;
            window.push(*t, [value]).unwrap();
            other.push(*t, [error * 7.0 * noise]).unwrap();
            samples.push(((*t - *stamps.last().unwrap()).seconds(), value));
        }
        let last = *stamps.last().unwrap();
        let t = last + Nanos::from_micros((ahead * step as f64) as i64).min(Nanos::ZERO);
        let estimate = window.at_using(t, last).unwrap();
        let newest = last + estimate.ahead + (t - last);
        let skipped = stamps.iter().filter(|stamp| **stamp > newest).count();
        let at = (t - newest).seconds();
        let derivatives = channels(&estimate).into_iter().zip(estimate.samples);
        for (m, (([got, std], length), gain)) in
            derivatives.zip([1.0, 10.0, 100.0]).enumerate()
        {
            let used = &samples[samples.len() - skipped - length..samples.len() - skipped];
            let span = (used[length - 1].0 - used[0].0).max(1e-9);
            let shift = used[length - 1].0;
            let fits = (2..=4.min(length - 1)).map(|degree| {
                let powers = DMatrix::from_fn(length, degree + 1, |i, k| {
                    (1.0 + 2.0 * (used[i].0 - shift) / span).powi(i32::try_from(k).unwrap())
                });
                let values = DVector::from_fn(length, |i, _| used[i].1);
                let c = powers.svd(true, true).solve(&values, 1e-14).unwrap();
                let v = 1.0 + 2.0 * at / span;
                let falling = |k: usize| (0..m).map(|j| k as f64 - j as f64).product::<f64>();
                let sum: f64 = (m..=degree)
                    .map(|k| c[k] * falling(k) * v.powi(i32::try_from(k - m).unwrap()))
                    .sum();
                sum * (2.0 / span).powi(i32::try_from(m).unwrap())
            });
            let nearest = fits.map(|fit| (fit - got).abs()).fold(f64::INFINITY, f64::min);
            let allowed = 1e-9 * gain / span.powi(i32::try_from(m).unwrap());
            prop_assert!(
                nearest <= allowed,
                "{m}: off by {nearest}, allowed {allowed}, of {length} samples, std {std}"
            );
        }
        let mut grid = Grid::new();
        prop_assert!(other.at_sharing(t, last, &mut grid).is_ok());
        prop_assert_eq!(window.at_sharing(t, last, &mut grid), Ok(estimate));
        // The same stamps with another instant; an instant with other samples; fewer samples.
        prop_assert_eq!(window.at_sharing(last, last, &mut grid), window.at_using(last, last));
        prop_assert_eq!(
            window.at_sharing(stamps[100], last, &mut grid),
            window.at_using(stamps[100], last)
        );
        prop_assert_eq!(window.at_sharing(t, last, &mut grid), Ok(estimate));
        let mut shorter =
            Window::<1>::new(Settings { capacity: capacity - 7, ..settings }).unwrap();
        for (t, error) in stamps.iter().zip(&errors) {
            shorter.push(*t, [error * noise]).unwrap();
        }
        prop_assert_eq!(shorter.at_sharing(t, last, &mut grid), shorter.at_using(t, last));
        prop_assert_eq!(window.at_sharing(t, last, &mut grid), Ok(estimate));
        // One stamp differs; the number of samples is the same.
        other.clear();
        for (number, (t, error)) in stamps.iter().zip(&errors).enumerate() {
            let late = Nanos(i64::from(number + 5 + skipped == stamps.len()));
            other.push(*t + late, [*error * noise]).unwrap();
        }
        prop_assert_eq!(other.at_sharing(t, last, &mut grid), other.at_using(t, last));
        prop_assert_eq!(window.at_sharing(t, last, &mut grid), Ok(estimate));
    }

    /// One window of three components gives the same as three windows of one.
    #[test]
    fn components_do_not_mix(
        intervals in prop::collection::vec(1_000_i64..9_000, 20..100),
        values in prop::collection::vec(prop::array::uniform3(-1.0..1.0_f64), 100),
    ) {
        let mut all = Window::<3>::new(Settings::new(0.2)).unwrap();
        let mut each = [(); 3].map(|()| Window::<1>::new(Settings::new(0.2)).unwrap());
        for (t, v) in stamps(0, &intervals).into_iter().zip(values) {
            all.push(t, v).unwrap();
            for (window, v) in each.iter_mut().zip(v) {
                window.push(t, [v]).unwrap();
            }
        }
        let t = all.newest().unwrap().0 - Nanos(300_000);
        let joint = all.at(t).unwrap();
        for (i, window) in each.iter().enumerate() {
            let alone = window.at(t).unwrap();
            prop_assert_eq!(alone.value[0].to_bits(), joint.value[i].to_bits());
            prop_assert_eq!(alone.first[0].to_bits(), joint.first[i].to_bits());
            prop_assert_eq!(alone.second[0].to_bits(), joint.second[i].to_bits());
            prop_assert_eq!(alone.second_std[0].to_bits(), joint.second_std[i].to_bits());
        }
    }

    /// An estimate depends on the samples up to its instant and the first later one alone. Samples
    /// that were dropped before, and samples pushed later, do not change a bit.
    #[test]
    fn only_the_samples_that_may_count_count(
        intervals in prop::collection::vec(1_000_i64..9_000, 60..120),
        values in prop::collection::vec(-1.0..1.0_f64, 120),
        later in 1_usize..20,
        wait_us in 0_i64..12_000,
        offset_us in 0_i64..9_000,
    ) {
        let stamps = stamps(0, &intervals);
        let settings = Settings { capacity: 30, ..Settings::new(0.1) };
        let cut = stamps.len() - later;
        let t = stamps[cut - 1] + Nanos::from_micros(offset_us.min(intervals[cut] - 1));
        let until = t + Nanos::from_micros(wait_us);
        // The samples that may be used: one more if it is there and not too late.
        let counted = if stamps[cut] <= until { cut + 1 } else { cut };
        let mut expected = Window::<1>::new(Settings { capacity: 30 - later, ..settings }).unwrap();
        for (t, v) in stamps.iter().zip(&values).take(counted).skip(counted - (30 - later)) {
            expected.push(*t, [*v]).unwrap();
        }
        let mut early = Window::<1>::new(Settings { capacity: 30 - later, ..settings }).unwrap();
        let mut late = Window::<1>::new(Settings { capacity: 29, ..settings }).unwrap();
        for (i, (t, v)) in stamps.iter().zip(&values).enumerate() {
            if i < counted {
                early.push(*t, [*v]).unwrap();
            }
            if i >= counted - (30 - later) {
                late.push(*t, [*v]).unwrap();
            }
        }
        prop_assert_eq!(expected.newest_for(t, until), Some(stamps[counted - 1]));
        let want = expected.at(t);
        prop_assert_eq!(early.at_using(t, until), want);
        prop_assert_eq!(late.at_using(t, until), want);
        prop_assert!(want.is_ok());
    }
}

#[test]
fn a_gap_starts_anew() {
    let mut window = Window::<1>::new(Settings::new(0.01)).unwrap();
    let ms = Nanos::from_millis;
    for i in 0..50 {
        assert_eq!(window.push(ms(i * 10), [5.0]), Ok(Pushed::Added));
    }
    assert_eq!(window.at(ms(590)).unwrap().value[0], 5.0);
    assert_eq!(window.at(ms(591)), Err(Unavailable::Stale { by: ms(101) }));
    assert_eq!(
        window.push(ms(591), [7.0]),
        Ok(Pushed::Restarted { gap: ms(101) })
    );
    assert_eq!(
        window.at(ms(591)),
        Err(Unavailable::Starting { samples: 1 })
    );
    assert_eq!(window.at(ms(590)), Err(Unavailable::Before { by: ms(1) }));
    window.push(ms(601), [7.0]).unwrap();
    assert_eq!(
        window.at(ms(601)),
        Err(Unavailable::Starting { samples: 2 })
    );
    window.push(ms(611), [7.0]).unwrap();
    let e = window.at(ms(611)).unwrap();
    assert_eq!(
        (e.value, e.first, e.second, e.samples),
        ([7.0], [0.0], [0.0], [3; 3])
    );
}

#[test]
fn old_samples_go() {
    let settings = Settings {
        capacity: 16,
        max_window: Nanos::from_millis(50),
        ..Settings::new(0.01)
    };
    let mut window = Window::<1>::new(settings).unwrap();
    let ms = Nanos::from_millis;
    for i in 0..1000 {
        // A constant that changes: only recent samples count.
        window
            .push(ms(i * 10), [if i < 990 { 1.0 } else { 2.0 }])
            .unwrap();
        assert_eq!(window.len(), 128.min(usize::try_from(i).unwrap() + 1));
        assert_eq!(window.oldest().unwrap().0, ms((i - 127).max(0) * 10));
    }
    assert_eq!(window.exactly(ms(9_980)), Some([2.0]));
    assert_eq!(window.exactly(ms(9_981)), None);
    let e = window.at(ms(9_990)).unwrap();
    // Within 50 ms: six samples, all of the new value.
    assert_eq!(
        (e.value, e.first, e.second, e.samples),
        ([2.0], [0.0], [0.0], [6; 3])
    );
    assert_eq!(window.at(ms(8_719)), Err(Unavailable::Before { by: ms(1) }));
}

#[test]
fn samples_that_came_later_do_not_change_an_estimate() {
    let settings = Settings {
        capacity: 96,
        ..Settings::new(1e-4)
    };
    let ms = Nanos::from_millis;
    // At rest the window is as long as it may be.
    let signal = |i: i64| [if i % 3 == 0 { 1e-4 } else { -1e-4 }];
    let mut window = Window::<1>::new(settings).unwrap();
    for i in 0..200 {
        window.push(ms(i), signal(i)).unwrap();
    }
    let t = ms(198) + Nanos(400_000);
    let early = window.at_using(t, ms(200)).unwrap();
    assert_eq!(early.samples.iter().max(), Some(&96));
    for i in 200..230 {
        window.push(ms(i), signal(i)).unwrap();
    }
    assert_eq!(window.at_using(t, ms(200)).unwrap(), early);
}

#[test]
fn what_is_wrong_is_refused_and_said() {
    let good = Settings::new(0.1);
    for noise in [0.0, -1.0, f64::INFINITY] {
        assert_eq!(
            Window::<1>::new(Settings { noise, ..good }).unwrap_err(),
            SettingsError::Noise(noise)
        );
    }
    assert!(matches!(
        Window::<1>::new(Settings::new(f64::NAN)).unwrap_err(),
        SettingsError::Noise(_)
    ));
    for capacity in [0, 2, MAX_SAMPLES + 1] {
        assert_eq!(
            Window::<1>::new(Settings { capacity, ..good }).unwrap_err(),
            SettingsError::Capacity(capacity)
        );
    }
    let zero = Nanos::ZERO;
    assert_eq!(
        Window::<1>::new(Settings {
            max_gap: zero,
            ..good
        })
        .unwrap_err(),
        SettingsError::Duration(zero)
    );
    let mut window = Window::<1>::new(good).unwrap();
    assert_eq!(window.at(zero), Err(Unavailable::Starting { samples: 0 }));
    window.push(Nanos(10), [1.0]).unwrap();
    for got in [Nanos(10), Nanos(9), Nanos::MIN] {
        assert_eq!(
            window.push(got, [2.0]),
            Err(Refused::NotLater {
                newest: Nanos(10),
                got
            })
        );
    }
    for v in [f64::NAN, f64::INFINITY] {
        assert_eq!(window.push(Nanos(20), [v]), Err(Refused::NotFinite));
    }
    assert_eq!(window.newest(), Some((Nanos(10), [1.0])));
}

#[test]
fn instants_before_a_gap_keep_their_samples_whenever_the_gap_ends() {
    let settings = Settings {
        max_gap: Nanos::from_millis(50),
        ..Settings::new(1e-6)
    };
    let ms = Nanos::from_millis;
    let mut window = Window::<1>::new(settings).unwrap();
    for i in 0..20 {
        window.push(ms(i), [i as f64]).unwrap();
    }
    let before = window.at_using(ms(19), ms(20)).unwrap();
    for i in 200..203 {
        window.push(ms(i), [1000.0 - i as f64]).unwrap();
    }
    assert_eq!(window.at_using(ms(19), ms(20)).unwrap(), before);
    // Samples after the gap are not fitted together with those before.
    let after = window.at(ms(202)).unwrap();
    assert!(
        (after.first[0] + 1000.0).abs() < 1e-3 && after.samples == [3; 3],
        "{after:?}"
    );
    window.interrupt();
    window.push(ms(203), [0.0]).unwrap();
    assert_eq!(
        window.at(ms(203)),
        Err(Unavailable::Starting { samples: 1 })
    );
    assert_eq!(window.at_using(ms(202), ms(202)).unwrap(), after);
}

/// Noise is measured in motion and at rest. Jitter of stamps counts as noise of a moving signal;
/// the motion itself does not.
#[test]
fn noise_shows_in_the_samples_late_stamps_included() {
    let found = |noise: f64, late: f64, amplitude: f64| {
        let mut window = Window::<1>::new(Settings::new(1e-6)).unwrap();
        let mut random = 4_u32;
        let mut uniform = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(random >> 8) / f64::from(1_u32 << 24)
        };
        // A sum of twelve uniform numbers is nearly normal.
        let mut normal = || (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        let mut last = Nanos::MIN;
        for k in 0..120 {
            let t = 0.01 * f64::from(k);
            let value = amplitude * (3.0 * t).sin() + noise * normal();
            let stamp = Nanos::from_seconds(t + late * normal().abs()).max(last + Nanos(1000));
            last = stamp;
            window.push(stamp, [value]).unwrap();
        }
        window.noise(Nanos::from_seconds(1.2))[0]
    };
    assert!(found(0.0, 0.0, 1.0) < 1e-6);
    for amplitude in [0.0, 1.0] {
        let ratio = found(1e-3, 0.0, amplitude) / 1e-3;
        assert!((0.8..1.2).contains(&ratio), "{amplitude}: {ratio}");
    }
    // |N(0, 1 ms)| has a standard deviation of 0.6 ms, and the signal's RMS velocity is 2.1 /s.
    let ratio = found(0.0, 1e-3, 1.0) / (0.6e-3 * 2.1);
    assert!((0.6..1.6).contains(&ratio), "{ratio}");
    assert!(found(0.0, 1e-3, 0.0) < 1e-9);
}

/// A replay that begins later measures the same noise: it depends on the longest window alone, at
/// any sample rate.
#[test]
fn noise_is_of_the_longest_window_alone() {
    let begun = |at: i64| {
        let mut window = Window::<1>::new(Settings::new(1e-6)).unwrap();
        for k in at..60 {
            // Large noise at first, then decreasing.
            let value = if k % 2 == 0 { 1.0 / k as f64 } else { 0.0 };
            window.push(Nanos::from_millis(40 * k), [value]).unwrap();
        }
        window.noise(Nanos::from_millis(40 * 59))[0]
    };
    let late = begun(60 - 26 - 5);
    assert!(late > 0.0);
    assert_eq!(late, begun(2));
}
