//! Cost of the regressors per sample on one core, kinematics included: the whole tree, sub-tree by
//! sub-tree, and the rows of the estimates.
//!
//! `taskset -c 1 cargo bench -p proprio-dynamics --bench regressor`
//!
//! The robot is iCub V2.5 if `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of
//! the PyPI package icub-models 3.2.0). Otherwise it is a generated robot of the same shape: 32
//! joints, six F/T sensors. Folded completely it has 33 bodies (38 x 330), with the sensor joints
//! kept 39 (38 x 390).
//!
//! The joint state changes with every call: 64 states, in turn. So every line includes the
//! kinematics, whose cost alone is `a_kinematics`. `scaling` has one call on a robot of the named
//! number of links.

mod robot;

use robot::Bench;
use robot::common;

use divan::{Bencher, black_box};
use proprio_dynamics::regressor::{EstimateRows, Regressor, StackedRegressor};
use proprio_dynamics::{ContactSet, Solver};

fn main() {
    divan::main();
}

const KEPT: [bool; 2] = [false, true];

/// For comparison: the kinematics, which the next lines include.
#[divan::bench(args = KEPT)]
fn a_kinematics(bencher: Bencher<'_, '_>, kept: bool) {
    let mut bench = Bench::new(kept);
    bencher.bench_local(|| {
        bench.next();
        black_box(&bench.kinematics);
    });
}

/// Kinematics and the regressor of the whole tree: the call that is compared with Pinocchio and
/// iDynTree.
#[divan::bench(args = KEPT)]
fn b_kinematics_and_regressor(bencher: Bencher<'_, '_>, kept: bool) {
    let mut bench = Bench::new(kept);
    let mut regressor = Regressor::new(&bench.model);
    bencher.bench_local(|| {
        bench.next();
        regressor
            .update(&bench.model, &bench.kinematics)
            .expect("the same model");
        black_box(&regressor);
    });
}

/// The same with the base changing from foot to foot at every call.
#[divan::bench]
fn c_with_another_base_each_time(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut regressor = Regressor::new(&bench.model);
    let feet = [bench.model.link_count() - 1, bench.model.link_count() / 2];
    bencher.bench_local(|| {
        let base = feet[bench.turn % 2];
        bench
            .kinematics
            .set_base(&bench.model, base)
            .expect("a link of the model");
        bench.next();
        regressor
            .update(&bench.model, &bench.kinematics)
            .expect("the same model");
        black_box(&regressor);
    });
}

/// Kinematics and all sub-trees' equations, a full wrench in each.
#[divan::bench]
fn d_stacked(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut stacked = StackedRegressor::new(&bench.structure);
    let (readings, contacts) = (bench.readings(), bench.contacts());
    bencher.bench_local(|| {
        bench.next();
        stacked
            .update(&bench.kinematics, &readings, &contacts, &[])
            .expect("the same structure");
        black_box(&stacked);
    });
}

/// The same without contacts, whitened.
#[divan::bench]
fn e_stacked_and_whitened(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut stacked = StackedRegressor::new(&bench.structure);
    let readings = bench.readings();
    bencher.bench_local(|| {
        bench.next();
        stacked
            .update(&bench.kinematics, &readings, &ContactSet::EMPTY, &[])
            .expect("the same structure");
        black_box(&stacked);
    });
}

/// Kinematics, solution and the rows of all torques.
#[divan::bench]
fn f_rows_of_all_torques(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(true);
    let mut solver = Solver::new(&bench.structure);
    let (readings, contacts) = (bench.readings(), bench.contacts());
    let mut row = vec![0.0; 10 * bench.model.link_count() + 6 * readings.len()];
    let dofs = bench.model.dof_count();
    bencher.bench_local(|| {
        bench.next();
        let (structure, kinematics) = (&bench.structure, &bench.kinematics);
        solver
            .solve(
                &bench.model,
                structure,
                kinematics,
                &readings,
                &contacts,
                &[],
            )
            .expect("finite input");
        let rows = EstimateRows::new(structure, &solver, kinematics).expect("the same structure");
        for dof in 0..dofs {
            rows.torque_row(dof, &mut row).expect("a row");
            black_box(&row);
        }
    });
}

/// Kinematics and the whole tree's regressor against the size of the robot. The dense regressor is
/// `(6 + n) x 10 N_B`, of which an update writes, per link, six rows and one for each joint between
/// it and the base: links times mean depth.
mod scaling {
    use super::common::write_link;
    use super::{Bench, Bencher, Regressor, StackedRegressor, black_box};

    const SIZES: [usize; 4] = [8, 32, 128, 500];

    /// A robot in which `parent` gives the parent of link `i > 0`, with an F/T sensor where
    /// `is_cut`.
    fn robot(
        links: usize,
        parent: impl Fn(usize) -> usize,
        is_cut: impl Fn(usize) -> bool,
    ) -> Bench {
        let (mut text, mut cuts) = (String::from("<robot name=\"generated\">"), Vec::new());
        for link in 0..links {
            let [x, y, z] = [1.0, 2.0, 3.0].map(|factor| 0.1 * (factor * link as f64).sin());
            let kind = if is_cut(link) { "fixed" } else { "revolute" };
            let parent = (link > 0).then(|| parent(link));
            write_link(&mut text, link, parent, kind, [x, y, z]);
            if is_cut(link) {
                cuts.push(format!("joint{link}"));
            }
        }
        Bench::of(&(text + "</robot>"), &cuts)
    }

    fn regressor(bencher: Bencher<'_, '_>, mut bench: Bench) {
        let mut regressor = Regressor::new(&bench.model);
        bencher.bench_local(|| {
            bench.next();
            regressor
                .update(&bench.model, &bench.kinematics)
                .expect("the same model");
            black_box(&regressor);
        });
    }

    /// Serial: mean depth is half the number of links.
    #[divan::bench(args = SIZES)]
    fn of_chain(bencher: Bencher<'_, '_>, links: usize) {
        regressor(bencher, robot(links, |link| link - 1, |_| false));
    }

    /// Limbs of eight links on one root: mean depth stays below five.
    #[divan::bench(args = SIZES)]
    fn of_limbs(bencher: Bencher<'_, '_>, links: usize) {
        let parent = |link| if link % 8 == 1 { 0 } else { link - 1 };
        regressor(bencher, robot(links, parent, |_| false));
    }

    /// Kinematics and all sub-trees' equations, a sensor and a full wrench in each of these limbs.
    #[divan::bench(args = SIZES)]
    fn stacked_of_limbs(bencher: Bencher<'_, '_>, links: usize) {
        let parent = |link| if link % 8 == 1 { 0 } else { link - 1 };
        let mut bench = robot(links, parent, |link| link % 8 == 4);
        let mut stacked = StackedRegressor::new(&bench.structure);
        let (readings, contacts) = (bench.readings(), bench.contacts());
        bencher.bench_local(|| {
            bench.next();
            stacked
                .update(&bench.kinematics, &readings, &contacts, &[])
                .expect("the same structure");
            black_box(&stacked);
        });
    }
}
