//! The example program runs, and finds the masses that the readings show.

#[path = "../examples/identification.rs"]
#[allow(unreachable_pub, reason = "a program is a crate of its own")]
mod identification;

#[test]
fn the_example_finds_the_masses() {
    identification::main().expect("an outcome");
    let outcome = identification::run().expect("an outcome");
    let beyond: Vec<_> = outcome.links.iter().filter(|link| link.seen).collect();
    let mass = |of: &dyn Fn(&proprio_identification::LinkOutcome) -> f64| -> f64 {
        beyond.iter().map(|link| of(link)).sum()
    };
    // CAD has 80 % of the true masses; the links beyond the sensor together are seen.
    let (cad, identified) = (
        mass(&|link| link.cad.mass),
        mass(&|link| link.identified.mass),
    );
    assert!(
        (identified / cad - 1.25).abs() < 0.01,
        "{cad} -> {identified} kg"
    );
    assert!(!outcome.covariance.root.is_empty());
    assert!(beyond.iter().all(|link| link.deviation[0] > 0.0));
}
