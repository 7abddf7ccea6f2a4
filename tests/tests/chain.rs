//! The short set of [`proprio_tests::chain`]: what holds from the frames to the torques under every
//! fault.
#![allow(missing_docs)]

use proprio_tests::chain::{FAMILIES, Family, Fault, Shown, run, soak};

fn family(name: &str) -> Family {
    let found = FAMILIES.iter().find(|family| family.name == name);
    *found.unwrap_or_else(|| panic!("{name}"))
}

fn shown(seed: u64, name: &str, fault: Fault) -> Shown {
    run(seed, family(name), fault).unwrap_or_else(|| panic!("{name}: no such device"))
}

/// Every fault of a part of the list, each in another family.
fn nothing_is_broken(part: usize) {
    for (number, (name, fault)) in Fault::ALL.iter().enumerate().skip(part).step_by(4) {
        // A robot on a fixed base has no IMU.
        let families = FAMILIES.iter().cycle().skip(7 * number);
        let seed = 1 + number as u64;
        let one = families.take(FAMILIES.len()).find_map(|family| {
            let shown = run(seed, *family, *fault)?;
            Some((family.name, shown))
        });
        let (family, shown) = one.expect("some family");
        assert!(
            !shown.is_broken(),
            "{name}, {family}, seed {seed}: {shown:#?}"
        );
        assert!(shown.readings[0] > 10_000, "{name}, {family}: {shown:#?}");
    }
}

// Four tests, because they run side by side.

#[test]
fn nothing_is_broken_by_the_first_faults() {
    nothing_is_broken(0);
}

#[test]
fn nothing_is_broken_by_the_second_faults() {
    nothing_is_broken(1);
}

#[test]
fn nothing_is_broken_by_the_third_faults() {
    nothing_is_broken(2);
}

#[test]
fn nothing_is_broken_by_the_fourth_faults() {
    nothing_is_broken(3);
}

/// A device that is off withholds what depends on it, is named, and is used again.
#[test]
fn a_device_that_is_off_is_named() {
    for name in ["moteus", "icub_strain"] {
        let shown = shown(3, name, Fault::Off);
        let [all, concerned] = shown.named;
        assert!(!shown.is_broken(), "{name}: {shown:#?}");
        // Without its only F/T sensor there is no estimate.
        let is_told = name != "moteus" || all > 1000;
        assert!(all == concerned && is_told, "{name}: {shown:#?}");
        assert!(shown.valid[1] < 0.7, "{name}: {shown:#?}");
        assert!(shown.valid[0] > 0.8, "{name}: {shown:#?}");
        assert!(shown.valid[2] > 0.8, "{name}: {shown:#?}");
    }
}

/// A sensor that takes the load at its start for zero has another offset after a restart, under a
/// push that nobody declares as well: its torques are withheld until that is known again.
#[test]
fn a_new_zero_is_learnt_anew() {
    let shown = shown(6, "jr3_can", Fault::Restart);
    assert!(!shown.is_broken(), "{shown:#?}");
    assert!(shown.valid[0] > 0.95 && shown.valid[2] > 0.95, "{shown:#?}");
    assert!(shown.valid[1] < 0.6, "{shown:#?}");
}

#[test]
fn one_seed_is_one_run() {
    let [one, other] = [(); 2].map(|()| shown(3, "moteus", Fault::Loss));
    assert_eq!(format!("{one:?}"), format!("{other:?}"));
    let another = shown(4, "moteus", Fault::Loss);
    assert_ne!(one.frames, another.frames);
}

/// A longer run with one fault after the other.
#[test]
fn all_is_accounted_for_after_many_faults() {
    let shown = soak(5, family("icub_motor"), 160.0, &mut |_| {}).expect("a robot with joints");
    assert!(
        shown.missing.is_empty() && shown.silent.is_empty(),
        "{shown:#?}"
    );
    assert!(
        shown.frames > 80_000 && shown.readings[0] > 80_000,
        "{shown:#?}"
    );
}

/// What the long set has found, one of each kind: an encoder that jumps by turns; frames of an F/T
/// sensor that become late; a push that goes on while an encoder is away; one that begins slowly.
#[test]
fn what_the_long_set_has_found_stays_mended() {
    for (seed, name, fault) in [
        (31, "myactuator v2", Fault::Wrong),
        (21, "robotous_rft", Fault::Delayed),
        (44, "moteus", Fault::Slow),
        (44, "canopen_encoder", Fault::None),
        (14, "canopen_drive at SYNC", Fault::Old),
        (18, "odrive", Fault::Flipped),
    ] {
        let shown = shown(seed, name, fault);
        assert!(!shown.is_broken(), "{name}, {fault:?}: {shown:#?}");
    }
}
