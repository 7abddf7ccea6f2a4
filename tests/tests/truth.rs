//! The short set of [`proprio_tests::truth`]: valid torques are true.
#![allow(missing_docs)]

use proprio_tests::truth::{Outcome, Run, TROUBLES};

/// What is not found yet, or not in all runs: docs/book/src/figures/truth.md has the table.
const OPEN: &[&str] = &[
    "push where no contact is",
    "payload taken",
    "F/T gain 8 % off",
    "F/T saturated",
    "F/T sign",
    "F/T turned 5 deg",
    "encoder stuck",
    "encoder in degrees",
    "encoder gear 20 % off",
    "encoder drifts",
    "encoders swapped",
];

/// The runs of `name` with these seeds; a robot without such a channel has none.
fn runs(name: &str, seeds: impl Iterator<Item = u64>) -> Vec<(u64, Outcome)> {
    let (_, trouble) = TROUBLES
        .iter()
        .find(|(known, _)| *known == name)
        .expect(name);
    let run = |seed| Some((seed, Run::new(seed, *trouble)?.judged()));
    seeds.filter_map(run).collect()
}

/// With every trouble but those of [`OPEN`], or with one in `step`: a larger robot takes long.
fn every_valid_torque_is_true(seed: u64, step: usize) {
    for name in OPEN {
        assert!(TROUBLES.iter().any(|(known, _)| known == name), "{name}");
    }
    let kept = TROUBLES.iter().filter(|(name, _)| !OPEN.contains(name));
    for (name, _) in kept.skip(step - 1).step_by(step) {
        for (seed, outcome) in runs(name, seed..=seed) {
            assert!(!outcome.is_broken(), "{name}, seed {seed}: {outcome:#?}");
        }
    }
}

// A test for each robot, because they run side by side.

#[test]
fn a_valid_torque_is_true() {
    every_valid_torque_is_true(1, 1);
}

#[test]
fn a_valid_torque_is_true_on_another_robot() {
    every_valid_torque_is_true(3, 1);
}

#[test]
fn a_valid_torque_is_true_on_a_robot_that_stands_on_a_foot() {
    every_valid_torque_is_true(5, 2);
}

#[test]
fn torques_are_valid_where_nothing_is_wrong() {
    for name in [
        "clean",
        "URDF 40 % off",
        "push in the middle",
        "offsets stated",
    ] {
        // Of seed 24 both sensors of a limb move together, and that of 5 stands on one.
        for (seed, outcome) in runs(name, [2, 3, 4, 5, 24].into_iter()) {
            assert!(
                outcome.use_of() >= 0.95,
                "{name}, seed {seed}: {outcome:#?}"
            );
            assert!(!outcome.is_broken(), "{name}, seed {seed}: {outcome:#?}");
            assert!(outcome.torques[0] > 12_000, "{outcome:#?}");
        }
    }
}

/// What is withheld names the channel that is off, and torques come back.
#[test]
fn what_is_off_is_named() {
    let [(_, outcome)] = &runs("encoder off", 2..3)[..] else {
        panic!("one run");
    };
    let mut names: Vec<&str> = outcome.withheld.keys().map(String::as_str).collect();
    names.retain(|name| !name.starts_with("never_seen"));
    assert_eq!(names, ["stale:l0_j1", "uncertain"]);
    let share = |reason: &str| outcome.withheld[reason] as f64 / outcome.torques[0] as f64;
    // 10 of 45 s.
    assert!(
        (share("stale:l0_j1") - 10.0 / 45.0).abs() < 0.01,
        "{outcome:#?}"
    );
}

/// An encoder before the sensor turns what every joint before it carries: no torque that depends on
/// it is valid while it is stuck, also of the joints before it.
#[test]
fn a_stuck_encoder_withholds_what_depends_on_it() {
    for (seed, outcome) in runs("encoder stuck", 1..5) {
        assert!(!outcome.is_broken(), "seed {seed}: {outcome:#?}");
    }
}

/// An error of the gear is estimated, and named where it matters.
#[test]
fn a_wrong_gear_is_named() {
    let all = runs("encoder gear 20 % off", 2..6);
    let is_named = |(_, outcome): &&(u64, Outcome)| outcome.named() > 0.5;
    assert!(all.iter().filter(is_named).count() >= 2, "{all:#?}");
    for (seed, outcome) in all {
        assert!(!outcome.is_broken(), "seed {seed}: {outcome:#?}");
    }
}

#[test]
fn one_seed_is_one_run() {
    let log = |seed| Run::new(seed, TROUBLES[0].1).expect("a run").files();
    assert_eq!(log(5), log(5));
    assert_ne!(log(5), log(6));
}

/// Torques that a wrong setup affects are withheld, and most of them name its channel.
#[test]
fn what_is_wrong_with_the_setup_is_named() {
    for name in [
        "F/T sign",
        "F/T turned 90 deg",
        "encoder reversed",
        "IMU in g",
    ] {
        let all = runs(name, 1..5);
        let named: Vec<f64> = all.iter().map(|(_, outcome)| outcome.named()).collect();
        let mean = named.iter().sum::<f64>() / named.len() as f64;
        assert!(mean > 0.6, "{name}: {named:?}");
        for (seed, outcome) in all {
            let is_told = outcome
                .withheld
                .keys()
                .any(|why| why.starts_with("contradicted"));
            // The last joint of a flange may turn either way: its torques are true.
            let is_harmless = outcome.use_of() > 0.9;
            // What is not told apart from a contact since the start withholds everything.
            let is_withheld = outcome.use_of() == 0.0;
            assert!(
                is_told || is_harmless || is_withheld,
                "{name}, seed {seed}: {outcome:#?}"
            );
        }
    }
}
