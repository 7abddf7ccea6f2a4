//! Time of all standard deviations of torques and contact wrenches, per sample on one core.
//!
//! `taskset -c 1 cargo bench -p proprio-estimator --bench propagation`
//!
//! The robot is that of `estimator/dynamics/benches/regressor.rs`.

#[path = "../dynamics/benches/robot/mod.rs"]
mod robot;

use divan::{Bencher, black_box};
use nalgebra::DMatrix;
use proprio_dynamics::{ContactSet, Solver};
use proprio_estimator::propagation::{Covariance, Propagation};
use proprio_topics::Nanos;
use robot::Bench;
use robot::common::Random;

/// The covariance: every link independent, as with a URDF; the limbs beyond the sensors and all
/// offsets correlated, the other links independent; or everything correlated, as after a complete
/// identification.
const UNCERTAIN: [&str; 3] = ["urdf", "limbs", "all"];

fn main() {
    divan::main();
}

/// Kinematics, solution, and the standard deviations of all torques and of seven full contact
/// wrenches.
#[divan::bench(args = UNCERTAIN)]
fn h_deviations(bencher: Bencher<'_, '_>, uncertain: &str) {
    let contacts = Bench::new(true).contacts();
    deviations(bencher, uncertain, &contacts);
}

/// The same without contacts: torques from both sides of a joint depend on all links of their
/// sub-tree.
#[divan::bench(args = UNCERTAIN)]
fn i_deviations_without_contacts(bencher: Bencher<'_, '_>, uncertain: &str) {
    deviations(bencher, uncertain, &ContactSet::EMPTY);
}

fn deviations(bencher: Bencher<'_, '_>, uncertain: &str, contacts: &ContactSet) {
    let mut bench = Bench::new(true);
    let mut solver = Solver::new(&bench.structure);
    let readings = bench.readings();
    let (links, sensors) = (bench.model.link_count(), readings.len());
    let mut covariance = Covariance::exact(links, sensors);
    let mut random = Random::new(426);
    let mut root = |columns| DMatrix::from_fn(columns, columns, |_, _| random.real(0.01));
    let (together, alone): (Vec<usize>, Vec<usize>) =
        (0..links).partition(|&link| match uncertain {
            "urdf" => false,
            "limbs" => bench.structure.subtree_of(link) != Some(0),
            _ => true,
        });
    let offsets: Vec<usize> = (0..if uncertain == "urdf" { 0 } else { sensors }).collect();
    let columns = 10 * together.len() + 6 * offsets.len();
    covariance
        .add(&together, &offsets, root(columns))
        .expect("a covariance");
    for link in alone {
        covariance
            .add(&[link], &[], root(10))
            .expect("a covariance");
    }
    let mut propagation =
        Propagation::new(&bench.structure, &covariance).expect("the same structure");
    let mut t = Nanos::ZERO;
    bencher.bench_local(|| {
        bench.next();
        // Nothing is held from one instant to the next.
        t += Nanos::from_millis(10);
        let (structure, kinematics) = (&bench.structure, &bench.kinematics);
        solver
            .solve(
                &bench.model,
                structure,
                kinematics,
                &readings,
                contacts,
                &[],
            )
            .expect("finite input");
        solver
            .update_deviations(structure)
            .expect("the same structure");
        propagation
            .update(structure, &solver, kinematics, t)
            .expect("the same structure");
        black_box(&propagation);
    });
}
