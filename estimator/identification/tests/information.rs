//! Tests of the recursive triangle against batch least squares by another route (nalgebra's QR on
//! all rows at once), and against theory.
//!
//! Recorded rows are read from the folder `PROPRIO_DATA`, if it is set.

#[path = "../../dynamics/tests/common/mod.rs"]
mod common;

use std::path::Path;

use common::Random;
use nalgebra::{DMatrix, DVector};
use proprio_identification::linear::information::{Information, InformationError, Panel};
use proptest::prelude::*;

/// Rows `[A | y]`, and their batch least-squares solution.
#[derive(Clone)]
struct Rows {
    a: DMatrix<f64>,
    y: DVector<f64>,
}

impl Rows {
    fn random(random: &mut Random, count: usize, unknowns: usize) -> Self {
        Self {
            a: DMatrix::from_fn(count, unknowns, |_, _| random.real(1.0)),
            y: DVector::from_fn(count, |_, _| random.real(1.0)),
        }
    }

    /// Rows with this condition number, and column sizes from `1 / sizes` to `sizes`. The residuals
    /// are so small that they, times the square of the condition, do not limit the comparison.
    fn ill_conditioned(
        random: &mut Random,
        count: usize,
        unknowns: usize,
        condition: f64,
        sizes: f64,
    ) -> Self {
        let left = Self::random(random, count, unknowns).a.qr().q();
        let right = Self::random(random, unknowns, unknowns).a.qr().q();
        let steps = unknowns.saturating_sub(1).max(1) as f64;
        let spread = DMatrix::from_diagonal(&DVector::from_fn(unknowns, |k, _| {
            condition.powf(-(k as f64) / steps)
        }));
        let mut a = left * spread * right;
        let truth = DVector::from_fn(unknowns, |_, _| random.real(1.0));
        let y = &a * truth + DVector::from_fn(count, |_, _| random.real(1e-8));
        for mut column in a.column_iter_mut() {
            column *= sizes.powf(random.real(1.0));
        }
        Self { a, y }
    }

    fn row(&self, i: usize) -> (Vec<f64>, f64) {
        (self.a.row(i).iter().copied().collect(), self.y[i])
    }

    fn stacked(parts: &[&Self]) -> Self {
        let unknowns = parts[0].a.ncols();
        let rows: Vec<_> = parts
            .iter()
            .flat_map(|part| (0..part.a.nrows()).map(|i| part.row(i)))
            .collect();
        Self {
            a: DMatrix::from_fn(rows.len(), unknowns, |i, j| rows[i].0[j]),
            y: DVector::from_fn(rows.len(), |i, _| rows[i].1),
        }
    }

    /// The same rows over some columns of a larger set of unknowns.
    fn spread(&self, columns: &[usize], unknowns: usize) -> Self {
        let mut a = DMatrix::zeros(self.a.nrows(), unknowns);
        for (from, &to) in columns.iter().enumerate() {
            a.set_column(to, &self.a.column(from));
        }
        Self {
            a,
            y: self.y.clone(),
        }
    }

    /// Householder on all rows, with columns scaled to norm one: the solution and the residual's
    /// square sum.
    fn batch(&self) -> (DVector<f64>, f64) {
        let scales: Vec<f64> = self.a.column_iter().map(|column| column.norm()).collect();
        let mut scaled = self.a.clone();
        scaled
            .column_iter_mut()
            .zip(&scales)
            .for_each(|(mut c, s)| c /= *s);
        let qr = scaled.clone().qr();
        let right = qr.q().transpose() * &self.y;
        let x = qr.r().solve_upper_triangular(&right).expect("full rank");
        let residual = (&scaled * &x - &self.y).norm_squared();
        (DVector::from_fn(x.len(), |k, _| x[k] / scales[k]), residual)
    }

    /// Absorbs the rows in panels of these sizes in turn.
    fn feed(&self, information: &mut Information, sizes: &[usize]) {
        let largest = *sizes.iter().max().expect("a size");
        let mut panel = Panel::new(self.a.ncols(), largest);
        let mut sizes = sizes.iter().cycle();
        let mut size = *sizes.next().expect("a size");
        for i in 0..self.a.nrows() {
            let (a, y) = self.row(i);
            panel.push_row(&a, y).expect("room");
            if panel.rows() == size {
                information.absorb(&mut panel).expect("sizes");
                size = *sizes.next().expect("a size");
            }
        }
        information.absorb(&mut panel).expect("sizes");
    }

    fn information(&self, sizes: &[usize]) -> Information {
        let mut information = Information::new(self.a.ncols());
        self.feed(&mut information, sizes);
        information
    }
}

fn solution(information: &Information) -> DVector<f64> {
    let (r, z) = information.to_triangle();
    r.solve_upper_triangular(&z).expect("determined")
}

/// Condition number of the triangle with its columns scaled to norm one.
fn condition(information: &Information) -> f64 {
    let (mut r, _) = information.to_triangle();
    r.column_iter_mut()
        .filter(|column| column.norm() > 0.0)
        .for_each(|mut column| _ = column.normalize_mut());
    let values = r.singular_values();
    values.max() / values.min()
}

/// Number of directions with more information than rounding.
fn rank(information: &Information) -> usize {
    let (mut r, _) = information.to_triangle();
    r.column_iter_mut()
        .filter(|column| column.norm() > 0.0)
        .for_each(|mut column| _ = column.normalize_mut());
    r.rank(1e-9)
}

/// `R^T R`, which is equal for all triangles of the same rows.
fn gram(information: &Information) -> DMatrix<f64> {
    let (root, _) = information.to_triangle();
    root.transpose() * root
}

/// Norm of the difference relative to the second vector, each number in units of its column.
fn difference(a: &DVector<f64>, b: &DVector<f64>, scales: &[f64]) -> f64 {
    let scaled = |x: &DVector<f64>| DVector::from_fn(x.len(), |k, _| x[k] * scales[k]);
    (scaled(a) - scaled(b)).norm() / scaled(b).norm()
}

fn scales(rows: &Rows) -> Vec<f64> {
    rows.a.column_iter().map(|column| column.norm()).collect()
}

fn close(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance * a.abs().max(b.abs())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn any_blocking_is_batch(
        seed in any::<u64>(),
        unknowns in 1_usize..50,
        more in 0_usize..80,
        sizes in prop::collection::vec(1_usize..40, 1..4),
    ) {
        let rows = Rows::random(&mut Random::new(seed), unknowns + 3 + more, unknowns);
        let information = rows.information(&sizes);
        let (x, residual) = rows.batch();
        // A random square-like matrix may be ill-conditioned by chance; residual and right sides
        // determine the effect of that.
        let condition = condition(&information);
        let tolerance = 1e-14 * condition * condition.max(100.0);
        prop_assert!(difference(&solution(&information), &x, &scales(&rows)) < tolerance);
        prop_assert!(close(information.residual_square(), residual, 1e-10));
        prop_assert_eq!(information.rows(), rows.a.nrows() as u64);
        for k in 0..unknowns {
            prop_assert!(information.row(k)[0] >= 0.0);
        }
    }

    #[test]
    fn skipping_zeros_changes_nothing(
        seed in any::<u64>(), unknowns in 2_usize..40, filled in 5_usize..95,
    ) {
        let mut random = Random::new(seed);
        let mut rows = Rows::random(&mut random, 3 * unknowns, unknowns);
        rows.a.iter_mut().for_each(|value| if !random.chance(filled) { *value = 0.0 });
        let information = rows.information(&[1, 7, 3]);
        let expected = rows.a.transpose() * &rows.a;
        prop_assert!((gram(&information) - &expected).norm() <= 1e-13 * expected.norm());
    }

    #[test]
    fn merging_is_all_rows_together(
        seed in any::<u64>(), first in 1_usize..12, second in 1_usize..12,
    ) {
        let mut random = Random::new(seed);
        let unknowns = first + second;
        let mut columns: Vec<usize> = (0..unknowns).collect();
        random.shuffle(&mut columns);
        let all = Rows::random(&mut random, 2 * unknowns, unknowns);
        let some = Rows::random(&mut random, first + 5, first);
        let others = Rows::random(&mut random, 2, second);
        let mut merged = all.information(&[4]);
        merged.merge(&some.information(&[3]), &columns[..first]).expect("columns");
        merged.merge(&others.information(&[2]), &columns[first..]).expect("columns");
        let together = Rows::stacked(&[
            &all,
            &some.spread(&columns[..first], unknowns),
            &others.spread(&columns[first..], unknowns),
        ]);
        let (x, residual) = together.batch();
        prop_assert!(difference(&solution(&merged), &x, &scales(&together)) < 1e-9);
        prop_assert!(close(merged.residual_square(), residual, 1e-10));
        prop_assert_eq!(merged.rows(), together.a.nrows() as u64);
    }

    #[test]
    fn marginalising_is_the_schur_complement(
        seed in any::<u64>(), nuisance in 1_usize..8, kept in 1_usize..12,
    ) {
        let mut random = Random::new(seed);
        let unknowns = nuisance + kept;
        let mut columns: Vec<usize> = (0..unknowns).collect();
        random.shuffle(&mut columns);
        let rows = Rows::random(&mut random, 3 * unknowns, unknowns);
        let (gone, kept) = columns.split_at(nuisance);
        let information = rows.information(&[5]);
        let full = rows.a.transpose() * &rows.a;
        let pick = |a: &[usize], b: &[usize]| {
            DMatrix::from_fn(a.len(), b.len(), |i, j| full[(a[i], b[j])])
        };
        let inverse = pick(gone, gone).try_inverse().expect("full rank");
        let expected = pick(kept, kept) - pick(kept, gone) * inverse * pick(gone, kept);
        let mut marginalised = information.clone();
        marginalised.marginalise(gone).expect("columns");
        let found = gram(&marginalised);
        let part = DMatrix::from_fn(kept.len(), kept.len(), |i, j| found[(kept[i], kept[j])]);
        prop_assert!((part - &expected).norm() < 1e-11 * expected.norm());
        for &column in gone {
            prop_assert!(found.column(column).iter().all(|&value| value == 0.0));
        }
        prop_assert!(marginalised.residual_square() == information.residual_square());

        // Rows with new nuisance parameters in the same columns give the same as rows over separate
        // columns from the beginning.
        let next = Rows::random(&mut random, 2 * unknowns, unknowns);
        next.feed(&mut marginalised, &[6]);
        let rename = |c: usize| gone.iter().position(|g| *g == c).map_or(c, |g| unknowns + g);
        let renamed: Vec<usize> = (0..unknowns).map(rename).collect();
        let two = Rows::stacked(&[
            &rows.spread(&(0..unknowns).collect::<Vec<_>>(), unknowns + nuisance),
            &next.spread(&renamed, unknowns + nuisance),
        ]);
        let (x, residual) = two.batch();
        let x = DVector::from_fn(unknowns, |c, _| x[renamed[c]]);
        prop_assert!(difference(&solution(&marginalised), &x, &vec![1.0; unknowns]) < 1e-8);
        prop_assert!(close(marginalised.residual_square(), residual, 1e-9));
    }

    /// Compared with a separate unknown for every offset of every block, and rows for the steps of
    /// the random walk between them.
    #[test]
    fn drifting_is_an_unknown_per_block(
        seed in any::<u64>(),
        offsets in 1_usize..4,
        fixed in 1_usize..6,
        blocks in 2_usize..8,
        first in any::<bool>(),
        exponent in -3.0..3.0,
    ) {
        let mut random = Random::new(seed);
        let unknowns = offsets + fixed;
        let column = |o| if first { o } else { fixed + o };
        let drifting: Vec<usize> = (0..offsets).map(column).collect();
        let deviations: Vec<f64> =
            (0..offsets).map(|_| 10_f64.powf(exponent + random.real(0.5))).collect();
        let mut information = Information::new(unknowns);
        // Constant unknowns, then the offsets of each block.
        let all = fixed + blocks * offsets;
        let mut parts = Vec::new();
        for block in 0..blocks {
            if block > 0 {
                information.drift(&drifting, &deviations).expect("a drift");
                let (a, y) = (DMatrix::zeros(offsets, all), DVector::zeros(offsets));
                let mut steps = Rows { a, y };
                for (o, deviation) in deviations.iter().enumerate() {
                    steps.a[(o, fixed + block * offsets + o)] = 1.0 / deviation;
                    steps.a[(o, fixed + (block - 1) * offsets + o)] = -1.0 / deviation;
                }
                parts.push(steps);
            }
            let rows = Rows::random(&mut random, unknowns + 2, unknowns);
            rows.feed(&mut information, &[4]);
            let place = |c: usize| match drifting.iter().position(|w| *w == c) {
                Some(o) => fixed + block * offsets + o,
                None if first => c - offsets,
                None => c,
            };
            parts.push(rows.spread(&(0..unknowns).map(place).collect::<Vec<_>>(), all));
        }
        let batch = Rows::stacked(&parts.iter().collect::<Vec<_>>());
        let (x, residual) = batch.batch();
        let last = |c: usize| match drifting.iter().position(|w| *w == c) {
            Some(o) => x[fixed + (blocks - 1) * offsets + o],
            None => x[if first { c - offsets } else { c }],
        };
        let expected = DVector::from_fn(unknowns, |c, _| last(c));
        prop_assert!(difference(&solution(&information), &expected, &vec![1.0; unknowns]) < 1e-8);
        prop_assert!(close(information.residual_square(), residual, 1e-8));
    }


}

#[test]
fn recursive_is_batch_for_ill_conditioned_rows() {
    let mut random = Random::new(7);
    for unknowns in [3, 17, 44, 66] {
        for condition in [1e2, 1e5, 1e7] {
            for sizes in [1.0, 1e6] {
                let rows =
                    Rows::ill_conditioned(&mut random, 8 * unknowns, unknowns, condition, sizes);
                let scales = scales(&rows);
                let (x, residual) = rows.batch();
                for panel in [1, 6, 24, 48, 8 * unknowns] {
                    let information = rows.information(&[panel]);
                    let apart = difference(&solution(&information), &x, &scales);
                    assert!(
                        apart < 1e-8,
                        "{unknowns} unknowns, condition {condition:e}, sizes {sizes:e}, panels of \
                         {panel}: {apart:e}"
                    );
                    let found = information.residual_square();
                    assert!(
                        close(found, residual, 1e-6),
                        "residual {found:e} instead of {residual:e}"
                    );
                }
            }
        }
    }
}

/// Starts with the triangle after 1e8 rows, absorbs 1e5 panels, and compares with a tree of merges,
/// in which every row passes 17 steps instead of 1e5.
#[test]
fn a_long_run_stays_accurate() {
    let (unknowns, rows, panels) = (12, 6, 100_000_usize);
    let mut random = Random::new(8);
    let start = Rows::ill_conditioned(&mut random, 3 * unknowns, unknowns, 1e3, 1.0);
    let start = Rows {
        a: start.a * 1e4,
        y: start.y * 1e4,
    };
    let mut information = start.information(&[12]);
    let mut levels: Vec<Option<Information>> = vec![Some(information.clone())];
    let identity: Vec<usize> = (0..unknowns).collect();
    let mut panel = Panel::new(unknowns, rows);
    let mut row = vec![0.0; unknowns];
    let mut total = start.a.nrows() as u64;
    for number in 0..panels {
        let mut leaf = Information::new(unknowns);
        let mut copy = Panel::new(unknowns, rows);
        for _ in 0..rows {
            row.iter_mut().for_each(|value| *value = random.real(1.0));
            let y = row.iter().sum::<f64>() + random.real(0.1);
            panel.push_row(&row, y).expect("room");
            copy.push_row(&row, y).expect("room");
            total += 1;
        }
        information.absorb(&mut panel).expect("sizes");
        leaf.absorb(&mut copy).expect("sizes");
        // As in binary counting: two of the same level make one of the next.
        let mut level = 1;
        let mut carried = leaf;
        let mut bits = number;
        while bits & 1 == 1 {
            let other = levels[level].take().expect("a full level");
            carried.merge(&other, &identity).expect("sizes");
            bits >>= 1;
            level += 1;
        }
        if levels.len() <= level {
            levels.resize(level + 1, None);
        }
        levels[level] = Some(carried);
    }
    let mut reference = Information::new(unknowns);
    for part in levels.iter().rev().flatten() {
        reference.merge(part, &identity).expect("sizes");
    }
    assert_eq!((information.rows(), reference.rows()), (total, total));
    let (found, expected) = (gram(&information), gram(&reference));
    let apart = (&found - &expected).norm() / expected.norm();
    let of_solution = difference(
        &solution(&information),
        &solution(&reference),
        &vec![1.0; unknowns],
    );
    println!("after {panels} panels: information {apart:.1e}, solution {of_solution:.1e}");
    // A biased rounding of one unit per panel would add up to 1e5 * 1e-16 = 1e-11.
    assert!(apart < 2e-12, "{apart:e}");
    assert!(of_solution < 1e-10, "{of_solution:e}");
    assert!(close(
        information.residual_square(),
        reference.residual_square(),
        1e-11
    ));
}

#[test]
fn empty_and_rank_deficient_information_is_valid() {
    let mut information = Information::new(4);
    let mut panel = Panel::new(4, 8);
    information.absorb(&mut panel).expect("no rows");
    information
        .drift(&[0, 3], &[1.0, f64::INFINITY])
        .expect("nothing to drift");
    panel.push_row(&[0.0; 4], 3.0).expect("room");
    panel.push_row(&[0.0, 2.0, 0.0, 0.0], 4.0).expect("room");
    panel.push_row(&[1.0, 1.0, 0.0, 0.0], 5.0).expect("room");
    information.absorb(&mut panel).expect("sizes");
    assert_eq!(
        information.residual_square(),
        9.0,
        "a row of zeros is all residual"
    );
    assert_eq!(rank(&information), 2);
    // Repeated rows of one direction add one to the rank.
    for _ in 0..100 {
        for _ in 0..8 {
            panel.push_row(&[0.3, 0.1, 0.7, 1.4], 1.0).expect("room");
        }
        information.absorb(&mut panel).expect("sizes");
    }
    assert_eq!(rank(&information), 3);
    // The undetermined direction is orthogonal to all rows.
    let (r, _) = information.to_triangle();
    let unseen = DVector::from_column_slice(&[0.0, 0.0, 2.0, -1.0]);
    assert!((r * unseen).norm() < 1e-9);
}

#[test]
fn bad_rows_change_nothing() {
    let rows = Rows::random(&mut Random::new(9), 12, 3);
    let mut information = rows.information(&[5]);
    let before = information.clone();
    let mut panel = Panel::new(3, 2);
    for value in [f64::NAN, f64::INFINITY, -f64::INFINITY, 1e121] {
        let refused = |column| Err(InformationError::Value { column, value });
        for column in 0..3 {
            let mut row = [1.0; 3];
            row[column] = value;
            let answer = panel.push_row(&row, 0.0);
            assert_eq!(
                format!("{answer:?}"),
                format!("{:?}", refused(column) as Result<(), _>)
            );
        }
        let answer = panel.push_row(&[1.0; 3], value);
        assert_eq!(
            format!("{answer:?}"),
            format!("{:?}", refused(3) as Result<(), _>)
        );
    }
    assert!(panel.push_row(&[1.0; 2], 0.0).is_err());
    assert_eq!(panel.rows(), 0);
    information.absorb(&mut panel).expect("no rows");
    assert_eq!(
        (information.to_triangle(), information.rows()),
        (before.to_triangle(), 12)
    );

    panel.push_row(&[1.0; 3], 0.0).expect("room");
    panel.push_row(&[1.0; 3], 0.0).expect("room");
    assert_eq!(
        panel.push_row(&[1.0; 3], 0.0),
        Err(InformationError::Full { capacity: 2 })
    );
    assert!(Information::new(4).absorb(&mut panel).is_err());
    assert_eq!(panel.rows(), 2, "the rows remain");
    for deviation in [-1.0, f64::NAN] {
        assert!(information.drift(&[0], &[deviation]).is_err());
    }
    assert!(information.drift(&[3], &[1.0]).is_err());
    assert!(information.drift(&[0, 1], &[1.0]).is_err());
    assert!(information.marginalise(&[1, 3]).is_err());
    assert!(information.merge(&before, &[0, 1, 3]).is_err());
    assert!(information.merge(&before, &[0, 1]).is_err());
    assert_eq!(information.to_triangle(), before.to_triangle());
}

#[test]
fn drift_has_its_limits() {
    let rows = Rows::random(&mut Random::new(10), 20, 5);
    let information = rows.information(&[7]);
    let after = |deviation: f64| {
        let mut after = information.clone();
        after.drift(&[1, 3], &[deviation; 2]).expect("a drift");
        after
    };
    assert_eq!(after(0.0).to_triangle(), information.to_triangle());
    assert_eq!(after(1e-310).to_triangle(), information.to_triangle());
    let mut marginal = information.clone();
    marginal.marginalise(&[1, 3]).expect("columns");
    assert_eq!(after(f64::INFINITY).to_triangle(), marginal.to_triangle());
    assert!((gram(&after(1e9)) - gram(&marginal)).norm() < 1e-12 * gram(&information).norm());
    // Rows after the last column do not change.
    assert_eq!(after(1.0).row(4), information.row(4));
    let (root, right) = information.to_triangle();
    let corner = root.view((2, 2), (3, 3)).into_owned();
    let trailing = (corner, right.rows(2, 3).into_owned());
    assert_eq!(information.trailing(2).to_triangle(), trailing);
}

fn table(path: &Path) -> Option<DMatrix<f64>> {
    let mut reader = csv::Reader::from_path(path).ok()?;
    let rows: Vec<Vec<f64>> = reader
        .records()
        .map(|record| {
            record
                .expect("a row")
                .iter()
                .map(|cell| cell.parse().expect("a number"))
                .collect()
        })
        .collect();
    Some(DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| {
        rows[i][j]
    }))
}

/// 176 postures of an iCub's arm, recorded by the paper's first author: eleven base parameters that
/// gravity determines, and six offsets.
#[test]
fn recursive_is_batch_on_the_papers_arm() {
    let Some(folder) = std::env::var_os("PROPRIO_DATA") else {
        println!("skipped: PROPRIO_DATA (recorded logs) is not set");
        return;
    };
    let file = |what: &str| Path::new(&folder).join(format!("paper_static_right_arm_{what}.csv"));
    let (Some(a), Some(readings)) = (table(&file("regressor")), table(&file("ft"))) else {
        println!("skipped: there is no {}", file("regressor").display());
        return;
    };
    assert_eq!((a.shape(), readings.shape()), ((1056, 17), (176, 6)));
    let mut rows = Rows {
        y: DVector::from_fn(1056, |i, _| readings[(i / 6, i % 6)]),
        a,
    };
    // Noise of the arm's sensor at rest [N, Nm].
    let noise = [0.0760, 0.0894, 0.1794, 0.00194, 0.00286, 0.00143];
    for i in 0..1056 {
        rows.a.row_mut(i).scale_mut(1.0 / noise[i % 6]);
        rows.y[i] /= noise[i % 6];
    }
    let (x, residual) = rows.batch();
    let scales = scales(&rows);
    for panel in [1, 6, 24, 48, 96, 1056] {
        let information = rows.information(&[panel]);
        let apart = difference(&solution(&information), &x, &scales);
        assert!(apart < 1e-8, "panels of {panel}: {apart:e}");
        assert!(close(information.residual_square(), residual, 1e-10));
        println!(
            "panels of {panel}: {apart:.1e} apart, condition {:.0}, rank {}",
            condition(&information),
            rank(&information)
        );
        assert_eq!(rank(&information), 17);
    }
}

/// Standing still: the same rows again and again, while offsets drift. They determine the sum of
/// offset and weight only. A million blocks must keep the earlier information, and add no more than
/// one exact measurement.
#[test]
fn a_million_blocks_of_one_posture_neither_lose_nor_add_information() {
    const OFFSETS: usize = 6;
    const UNKNOWNS: usize = 16;
    let mut random = Random::new(26);
    let columns: Vec<usize> = (0..OFFSETS).collect();
    let deviations = [0.01; OFFSETS];
    let mut information = Information::new(UNKNOWNS);
    let mut panel = Panel::new(UNKNOWNS, 600);
    // Some motion: offsets with every row, as in [I | Y].
    let truth = random.reals(UNKNOWNS, 1.0);
    let row = |k: usize, random: &mut Random| -> Vec<f64> {
        let offset = (0..OFFSETS).map(|i| f64::from(u8::from(i == k % OFFSETS)));
        offset
            .chain(random.reals(UNKNOWNS - OFFSETS, 1.0))
            .collect()
    };
    let product = |row: &[f64]| -> f64 { row.iter().zip(&truth).map(|(a, x)| a * x).sum() };
    for k in 0..600 {
        let a = row(k, &mut random);
        let y = product(&a) + random.real(1.7);
        panel.push_row(&a, y).unwrap();
    }
    information.absorb(&mut panel).unwrap();
    let known = |information: &Information| {
        let (root, _) = information.trailing(OFFSETS).to_triangle();
        root.transpose() * root
    };
    let moved = known(&information);
    let posture: Vec<Vec<f64>> = (0..OFFSETS).map(|k| row(k, &mut random)).collect();
    // The information of an exact measurement y = G d + s: with s = y - G d it is (G - D^-1 C)^T D
    // (G - D^-1 C), where D is the information about s and C that between both.
    let seen = DMatrix::from_fn(OFFSETS, UNKNOWNS - OFFSETS, |i, j| posture[i][OFFSETS + j]);
    let (root, _) = information.to_triangle();
    let joint = root.transpose() * root;
    let of_offsets = joint.view((0, 0), (OFFSETS, OFFSETS)).into_owned();
    let of_both = joint
        .view((0, OFFSETS), (OFFSETS, UNKNOWNS - OFFSETS))
        .into_owned();
    let apart = seen
        - of_offsets
            .clone()
            .cholesky()
            .expect("known")
            .solve(&of_both);
    let most = apart.transpose() * of_offsets * apart;
    let (mut soon, mut blocks) = (None, 0_u32);
    while blocks < 1_000_000 {
        information.drift(&columns, &deviations).unwrap();
        for a in &posture {
            panel.push_row(a, product(a)).unwrap();
        }
        information.absorb(&mut panel).unwrap();
        blocks += 1;
        if blocks == 5000 {
            soon = Some(known(&information));
        }
    }
    let (stood, soon) = (known(&information), soon.unwrap());
    let scale = moved.norm();
    // Nothing is lost in any direction,
    let least = (&stood - &moved).symmetric_eigenvalues().min();
    assert!(least > -1e-9 * scale, "lost {least} of {scale}");
    // no more is gained than one exact measurement gives,
    let over = (&moved + &most - &stood).symmetric_eigenvalues().min();
    assert!(over > -1e-9 * scale, "gained {over} too much, of {scale}");
    // and that is reached after some thousand blocks.
    let growth = (&stood - &soon).norm() / scale;
    println!("least {least:e}, over {over:e}, growth {growth:e}");
    assert!(growth < 1e-9, "{growth}");
    // The estimate stays close to the truth, and the square sum is that of consistent rows.
    assert!(
        solution(&information)
            .iter()
            .zip(&truth)
            .all(|(x, truth)| (x - truth).abs() < 0.5)
    );
    assert!(
        information.residual_square() < 1000.0,
        "{}",
        information.residual_square()
    );
}
