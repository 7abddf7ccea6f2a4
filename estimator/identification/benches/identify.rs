//! Time of identification per sample on one core. One sample is six whitened rows: those of the
//! sub-tree of one F/T sensor.
//!
//! `taskset -c 1 cargo bench -p proprio-identification --bench identify`
//!
//! Items are samples: read the throughput, or divide the time by the samples per panel. 44
//! unknowns: 38 base parameters of a limb of five links and six offsets; 66: the same limb's 50
//! full parameters, offsets, friction; 120: three limbs' base parameters; 426: a whole iCub, 39
//! links and six sensors.

#[path = "../../dynamics/tests/common/mod.rs"]
mod common;

use common::Random;
use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use proprio_identification::linear::information::{Information, Panel};

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

/// A triangle that has absorbed some thousand rows, and rows to cycle through.
struct Bench {
    information: Information,
    panel: Panel,
    rows: Vec<Vec<f64>>,
    turn: usize,
}

impl Bench {
    /// Rows with numbers in the first `filled` columns and zeros in the others.
    fn new(unknowns: usize, samples: usize, filled: usize) -> Self {
        let mut random = Random::new(64);
        let mut bench = Self {
            information: Information::new(unknowns),
            panel: Panel::new(unknowns, ROWS * samples),
            rows: (0..128 * ROWS)
                .map(|_| random.reals(unknowns, 1.0))
                .collect(),
            turn: 0,
        };
        for _ in 0..2000 / samples {
            bench.fill(samples);
            bench
                .information
                .absorb(&mut bench.panel)
                .expect("the same size");
        }
        for row in &mut bench.rows {
            row[filled..].fill(0.0);
        }
        bench
    }

    fn fill(&mut self, samples: usize) {
        for _ in 0..ROWS * samples {
            self.turn = (self.turn + 1) % self.rows.len();
            self.panel
                .push_row(&self.rows[self.turn], 1.0)
                .expect("room");
        }
    }
}

/// Absorb rows, get the triangle, solve once per panel.
#[divan::bench(args = SIZES)]
fn a_absorb_and_solve(bencher: Bencher<'_, '_>, (unknowns, samples): (usize, usize)) {
    let mut bench = Bench::new(unknowns, samples, unknowns);
    bencher.counter(ItemsCount::new(samples)).bench_local(|| {
        bench.fill(samples);
        bench
            .information
            .absorb(&mut bench.panel)
            .expect("the same size");
        let (r, z) = bench.information.to_triangle();
        black_box(r.solve_upper_triangular(&z).expect("determined"));
    });
}

/// Absorb without solving.
#[divan::bench(args = [(44, 8), (426, 8)])]
fn b_absorb(bencher: Bencher<'_, '_>, (unknowns, samples): (usize, usize)) {
    let mut bench = Bench::new(unknowns, samples, unknowns);
    bencher.counter(ItemsCount::new(samples)).bench_local(|| {
        bench.fill(samples);
        bench
            .information
            .absorb(&mut bench.panel)
            .expect("the same size");
        black_box(&bench.information);
    });
}

/// A sub-tree's rows about 56 of 426 unknowns, in a triangle without links between these and the
/// others.
#[divan::bench]
fn c_absorb_few_of_many(bencher: Bencher<'_, '_>) {
    let mut bench = Bench::new(426, 8, 56);
    bench.information = Information::new(426);
    bencher.counter(ItemsCount::new(8_usize)).bench_local(|| {
        bench.fill(8);
        bench
            .information
            .absorb(&mut bench.panel)
            .expect("the same size");
        black_box(&bench.information);
    });
}

/// One step of the offsets' random walks, first among the unknowns and last; per step.
#[divan::bench(args = [(44, 6, true), (44, 6, false), (426, 36, true), (426, 36, false)])]
fn d_drift(bencher: Bencher<'_, '_>, (unknowns, offsets, first): (usize, usize, bool)) {
    let mut bench = Bench::new(unknowns, 8, unknowns);
    let start = if first { 0 } else { unknowns - offsets };
    let columns: Vec<usize> = (start..start + offsets).collect();
    let deviations = vec![1e-6; offsets];
    bencher.bench_local(|| {
        bench
            .information
            .drift(&columns, &deviations)
            .expect("columns");
        black_box(&bench.information);
    });
}
