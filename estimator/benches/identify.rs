//! What identification costs per sample on one core. One sample is six whitened rows: those of one F/T sensor's sub-tree.
//!
//! `taskset -c 1 cargo bench -p proprio-estimator --bench identify`
//!
//! Items are samples: read the throughput, or divide the time by the samples that a panel holds. 44 unknowns: 38 base parameters of a limb of five links
//! and six offsets; 66: the same limb's 50 full parameters, offsets, friction; 120: three limbs' base parameters; 426: a whole iCub, 39 links and six sensors.

#[path = "../tests/common/mod.rs"]
mod common;

use common::Random;
use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use proprio_estimator::identify::information::{DirectionalForgetting, Information, Panel, Posterior};

fn main() {
    divan::main();
}

const ROWS: usize = 6;

/// Unknowns, samples per panel.
const SIZES: [(usize, usize); 16] = [
    (44, 1),
    (44, 4),
    (44, 8),
    (44, 16),
    (66, 1),
    (66, 4),
    (66, 8),
    (66, 16),
    (120, 1),
    (120, 4),
    (120, 8),
    (120, 16),
    (426, 1),
    (426, 4),
    (426, 8),
    (426, 16),
];

/// A triangle that has seen some thousand rows, and rows to go round.
struct Bench {
    information: Information,
    posterior: Posterior,
    panel: Panel,
    rows: Vec<Vec<f64>>,
    turn: usize,
}

impl Bench {
    /// Rows that hold numbers in `filled` columns, the others zeros.
    fn new(unknowns: usize, samples: usize, filled: usize) -> Self {
        let mut random = Random::new(64);
        let mut bench = Self {
            information: Information::new(unknowns),
            posterior: Posterior::new(unknowns),
            panel: Panel::new(unknowns, ROWS * samples),
            rows: (0..128 * ROWS).map(|_| random.reals(unknowns, 1.0)).collect(),
            turn: 0,
        };
        for _ in 0..2000 / samples {
            bench.fill(samples);
            bench.information.absorb(&mut bench.panel).expect("the same size");
        }
        for row in &mut bench.rows {
            row[filled..].fill(0.0);
        }
        bench
    }

    fn fill(&mut self, samples: usize) {
        for _ in 0..ROWS * samples {
            self.turn = (self.turn + 1) % self.rows.len();
            self.panel.push_row(&self.rows[self.turn], 1.0).expect("room");
        }
    }
}

/// Rows in, triangle, solution once per panel.
#[divan::bench(args = SIZES)]
fn a_absorb_and_solve(bencher: Bencher<'_, '_>, (unknowns, samples): (usize, usize)) {
    let mut bench = Bench::new(unknowns, samples, unknowns);
    bencher.counter(ItemsCount::new(samples)).bench_local(|| {
        bench.fill(samples);
        bench.information.absorb(&mut bench.panel).expect("the same size");
        bench.posterior.update(&bench.information, None).expect("determined");
        black_box(bench.posterior.estimate());
    });
}

/// Without the solution.
#[divan::bench(args = [(44, 8), (426, 8)])]
fn b_absorb(bencher: Bencher<'_, '_>, (unknowns, samples): (usize, usize)) {
    let mut bench = Bench::new(unknowns, samples, unknowns);
    bencher.counter(ItemsCount::new(samples)).bench_local(|| {
        bench.fill(samples);
        bench.information.absorb(&mut bench.panel).expect("the same size");
        black_box(&bench.information);
    });
}

/// A sub-tree's rows about 56 of 426 unknowns, in a triangle that knows of no link between these and the others.
#[divan::bench]
fn c_absorb_few_of_many(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(426, 8, 56);
    bench.information = Information::new(426);
    bencher.counter(ItemsCount::new(8_usize)).bench_local(|| {
        bench.fill(8);
        bench.information.absorb(&mut bench.panel).expect("the same size");
        black_box(&bench.information);
    });
}

/// One step of the walks of offsets, first among the unknowns and last; per step.
#[divan::bench(args = [(44, 6, true), (44, 6, false), (426, 36, true), (426, 36, false)])]
fn d_drift(bencher: Bencher<'_, '_>, (unknowns, offsets, first): (usize, usize, bool)) {
    let mut bench = Bench::new(unknowns, 8, unknowns);
    let start = if first { 0 } else { unknowns - offsets };
    let columns: Vec<usize> = (start..start + offsets).collect();
    let deviations = vec![1e-6; offsets];
    bencher.bench_local(|| {
        bench.information.drift(&columns, &deviations).expect("columns");
        black_box(&bench.information);
    });
}

/// Absorbing with directional forgetting.
#[divan::bench(args = [(44, 1), (44, 4), (44, 8), (426, 7)])]
fn e_absorb_and_forget(bencher: Bencher<'_, '_>, (unknowns, samples): (usize, usize)) {
    let mut bench = Bench::new(unknowns, samples, unknowns);
    let mut forgetting = DirectionalForgetting::new(unknowns, ROWS * samples, 0.99).expect("a retention");
    bencher.counter(ItemsCount::new(samples)).bench_local(|| {
        bench.fill(samples);
        forgetting
            .absorb(&mut bench.information, &mut bench.panel)
            .expect("the same size");
        black_box(&bench.information);
    });
}

/// Standard deviations of 32 predictions.
#[divan::bench(args = [44, 426])]
fn f_deviations(bencher: Bencher<'_, '_>, unknowns: usize) {
    let mut bench = Bench::new(unknowns, 8, unknowns);
    bench.posterior.update(&bench.information, None).expect("determined");
    bencher.counter(ItemsCount::new(32_usize)).bench_local(|| {
        for row in &bench.rows[..32] {
            black_box(bench.posterior.deviation(row));
        }
    });
}

/// Solution with a dense prior, and the merge of a whole triangle.
#[divan::bench(args = [44, 426])]
fn g_solve_with_prior(bencher: Bencher<'_, '_>, unknowns: usize) {
    let mut bench = Bench::new(unknowns, 8, unknowns);
    let prior = bench.information.clone();
    bencher.bench_local(|| {
        bench
            .posterior
            .update(&bench.information, Some(&prior))
            .expect("determined");
        black_box(bench.posterior.estimate());
    });
}
