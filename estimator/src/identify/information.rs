//! What measurements tell of the unknowns, as the square root of their information: an upper triangle that takes in rows, for ever, in constant memory.
//!
//! Linear measurements `y = A x + e` of `n` unknowns, the noise `e` independent with variance one (*whitened* rows), come down to
//!
//! ```text
//! |A x - y|^2 = |R x - z|^2 + rho^2        R: n x n, upper triangular, no negative number on its diagonal
//! ```
//!
//! `R^T R = A^T A` is the information matrix, its inverse the covariance of the least-squares estimate, which solves `R x = z`; `rho^2` is what no `x`
//! explains. `A^T A` itself is never formed: that would square the condition number. Notation and methods are those of Bierman, "Factorization Methods
//! for Discrete Sequential Estimation" (Academic Press, 1977), ch. IV to VII.
//!
//! - [`Panel`]: rows, gathered until it is worth while; [`Information`]: `[R | z]`, `rho^2`. It holds no prior: that is added at the solution.
//! - [`Posterior`]: information and prior together: estimate, covariance, standard deviation of a row's prediction.
//! - [`DirectionalForgetting`]: the same as absorbing, but old information makes room for new.
//! - [`Excitation`]: rank, condition and weakest directions, for reports.
//!
//! # Order of the unknowns
//! What drifts or will be forgotten (offsets, friction: a session's) belongs **first**, what stays (the robot's parameters) last: `[s | d]`. A walk of
//! unknown `c` touches rows `0..=c` alone, and [`Information::trailing`] reads the information about `d`, with `s` eliminated, off the triangle. In the
//! other order everything is as right, and slower.
//!
//! # Where the speed comes from
//! A panel is absorbed column by column by Householder reflections of the panel's column and one number of `R`: 2 m n^2 operations for `m` rows, all of them
//! in loops over the panel's columns, which are contiguous, short, and stay in the first cache. Four reflections are applied together, to eight columns at a time, in the widest instructions of the processor
//! (`lanes.rs`). Exact zeros are skipped: a column that is zero in the panel costs little until a reflection fills it. So rows about few unknowns are cheap, provided that their panel has no other rows.
//!
//! Six rows a sample, plain x86-64, `cargo bench -p proprio-estimator --bench identify` (two-core virtual machine, AMD EPYC with AVX-512: fastest of
//! 100), us per sample, solution once per panel:
//!
//! | unknowns | panels of 1 sample | 4 | 8 | 16 |
//! |---|---|---|---|---|
//! | 44 | 4.5 | 1.5 | 1.0 | 0.8 |
//! | 66 | 8.7 | 2.9 | 2.0 | 1.5 |
//! | 120 | 24 | 7.8 | 5.2 | 4.0 |
//! | 426 | 282 | 89 | 57 | 43 |
//!
//! Rows about 56 of 426 unknowns that nothing links to the others, panels of 8: 5.7. A step of six walks among 44 unknowns: 0.6 us if they are the first,
//! 5.5 if the last; of 36 among 426: 92 us and 1200.
//!
//! # Why it stays sound
//! - Every step is an orthogonal transformation; each is backward stable column by column, whatever the scales of the columns (Higham, "Accuracy and Stability of
//!   Numerical Algorithms", SIAM 2002, th. 19.13). A rank-deficient start is none of a problem: `R` may hold zeros.
//! - `R` is *corrected*, not computed anew: `R + e` with `e` of the panel's size. What a step rounds is half a unit in the last place of `R`, and unbiased:
//!   after `N` panels a relative error of the order of `sqrt(N) 1e-16`, 1e-12 after 1e8. A correction is lost only where it is below that unit, after 1e15
//!   equal rows.

use nalgebra::{DMatrix, DVector};
use pulp::{Arch, Simd, WithSimd};

use super::lanes::{self, Aligned, LANES, TOGETHER};
use super::{add_multiple, dot};

/// Why rows were refused, or why nothing can be solved.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum InformationError {
    /// Two sizes that must agree do not.
    #[error("{what}: {got} instead of {expected}")]
    Size {
        /// What was counted.
        what: &'static str,
        /// How many there are.
        got: usize,
        /// How many there must be.
        expected: usize,
    },
    /// A column that does not exist.
    #[error("there is no unknown {column}: the information is about {unknowns}, counted from 0")]
    Column {
        /// Its number.
        column: usize,
        /// How many unknowns there are.
        unknowns: usize,
    },
    /// The panel has no room for another row.
    #[error("the panel already holds {capacity} rows: absorb it first")]
    Full {
        /// Rows that it can hold.
        capacity: usize,
    },
    /// A row with a number that is none, or beyond 1e120, where squares overflow.
    #[error(
        "a row has {value} in column {column} (the right side comes after the last unknown); rows must be finite and below 1e120"
    )]
    Value {
        /// The column; the number of unknowns for the right side.
        column: usize,
        /// What stood there.
        value: f64,
    },
    /// A standard deviation, or a retention, outside its range.
    #[error("{what} is {value}, which is outside its range")]
    Range {
        /// What it is.
        what: &'static str,
        /// What it was.
        value: f64,
    },
    /// Rows and prior leave an unknown free.
    #[error("unknown {unknown} is not determined by the rows and the prior together")]
    Undetermined {
        /// The first one that is a combination of those before it, as far as the rows can tell.
        unknown: usize,
    },
}

fn check_size(what: &'static str, got: usize, expected: usize) -> Result<(), InformationError> {
    if got == expected {
        return Ok(());
    }
    Err(InformationError::Size { what, got, expected })
}

/// Of a column's norm: a diagonal element of `R` below this is rounding, not information.
const ROUNDING: f64 = 1e-12;

/// Whitened rows `[a | y]` on their way into an [`Information`]. A buffer for reuse: absorbing empties it.
#[derive(Clone, Debug)]
pub struct Panel {
    unknowns: usize,
    capacity: usize,
    rows: usize,
    /// Distance of columns, which are padded with zeros to a multiple of the lanes.
    stride: usize,
    /// Column by column, the right side last.
    values: Aligned,
    /// Which columns hold anything but zeros.
    filled: Vec<bool>,
}

impl Panel {
    /// Room for `capacity` rows over so many unknowns. Absorbing is fastest from about 40 rows on; beyond some hundred they leave the first cache.
    pub fn new(unknowns: usize, capacity: usize) -> Self {
        let stride = capacity.next_multiple_of(LANES);
        Self {
            unknowns,
            capacity,
            rows: 0,
            stride,
            values: Aligned::zeros(stride * (unknowns + 1)),
            filled: vec![false; unknowns + 1],
        }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.unknowns
    }

    /// Number of rows that wait.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of rows that it can hold.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Adds the row `a x = y`, in units of its noise's standard deviation. Numbers below 1e-140 may count as zero.
    ///
    /// # Errors
    /// Another length than the number of unknowns, no room, or a number that is not finite or beyond 1e120. Nothing is changed then.
    pub fn push_row(&mut self, a: &[f64], y: f64) -> Result<(), InformationError> {
        check_size("numbers of a row", a.len(), self.unknowns)?;
        if self.rows == self.capacity {
            let capacity = self.capacity;
            return Err(InformationError::Full { capacity });
        }
        let wrong = |value: &f64| value.is_nan() || value.abs() > 1e120;
        // One pass without a way out of it: the place is looked for only if there is one.
        if a.iter().fold(wrong(&y), |any, value| any | wrong(value)) {
            let column = a.iter().position(wrong).unwrap_or(self.unknowns);
            let value = a.get(column).copied().unwrap_or(y);
            return Err(InformationError::Value { column, value });
        }
        let columns = self.values[self.rows..].iter_mut().step_by(self.stride.max(1));
        for ((to, filled), &value) in columns.zip(&mut self.filled).zip(a.iter().chain([&y])) {
            *to = value;
            *filled |= value != 0.0;
        }
        self.rows += 1;
        Ok(())
    }

    /// Lets go of all rows.
    pub fn clear(&mut self) {
        self.rows = 0;
        self.filled.fill(false);
    }

    /// Zeros below the last row, as far as loops will look; how far that is.
    fn pad(&mut self) -> usize {
        let padded = self.rows.next_multiple_of(LANES);
        if padded > self.rows {
            for column in self.values.chunks_exact_mut(self.stride) {
                column[self.rows..padded].fill(0.0);
            }
        }
        padded
    }
}

/// Columns that reflections are applied to together.
const COLUMNS: usize = 8;

/// A Householder reflection of a panel's column `v` and the diagonal element of `R` in the same column, `[alpha; v] -> [beta; 0]`.
#[derive(Clone, Copy, Default)]
struct Reflection {
    column: usize,
    /// `beta - alpha`.
    delta: f64,
    per_beta: f64,
    per_delta: f64,
    /// `v . v_i` with those of the reflections before it that are applied together with it.
    products: [f64; TOGETHER],
}

/// Reflects the rows of a panel into the triangle `[R | z]` of so many unknowns. Of the panel's right side there remains what nothing explains.
struct Reflect<'a> {
    unknowns: usize,
    triangle: &'a mut [f64],
    /// Of the panel, with those that it is padded with; and the distance of its columns.
    rows: usize,
    stride: usize,
    panel: &'a mut [f64],
    filled: &'a mut [bool],
}

impl WithSimd for Reflect<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            unknowns,
            triangle,
            rows,
            stride,
            panel,
            filled,
        } = self;
        let width = unknowns + 1;
        let (mut pending, mut count) = ([Reflection::default(); TOGETHER], 0);
        for k in 0..width {
            let (before, own) = panel.split_at_mut(k * stride);
            let own = &mut own[..rows];
            for reflection in &pending[..count] {
                let r = &mut triangle[reflection.column * width + k];
                if filled[k] || *r != 0.0 {
                    filled[k] = true;
                    let v = &before[reflection.column * stride..][..rows];
                    let growth = (lanes::inner(simd, v, own) - reflection.delta * *r) * reflection.per_beta;
                    *r += growth;
                    lanes::add(simd, own, -(growth * reflection.per_delta), v);
                }
            }
            if k == unknowns || !filled[k] {
                continue;
            }
            let diagonal = &mut triangle[k * width + k];
            // It keeps the sign of alpha: R is then corrected, by delta = beta - alpha on the diagonal, written such that nothing cancels (Parlett 1971; Higham 2002, sect. 19.1).
            let (alpha, sigma) = (*diagonal, lanes::inner(simd, own, own));
            if sigma <= 1e-40 * alpha * alpha + 1e-280 {
                continue; // far below rounding
            }
            let delta = sigma / (alpha + (alpha * alpha + sigma).sqrt());
            *diagonal = alpha + delta;
            let mut products = [0.0; TOGETHER];
            for (product, other) in products.iter_mut().zip(&pending[..count]) {
                *product = lanes::inner(simd, own, &before[other.column * stride..][..rows]);
            }
            pending[count] = Reflection {
                column: k,
                delta,
                per_beta: 1.0 / *diagonal,
                per_delta: 1.0 / delta,
                products,
            };
            count += 1;
            if count == TOGETHER {
                let (before, after) = panel.split_at_mut((k + 1) * stride);
                let four = pending.map(|reflection| &before[reflection.column * stride..][..rows]);
                let columns = after
                    .chunks_mut(COLUMNS * stride)
                    .zip(filled[k + 1..].chunks_mut(COLUMNS));
                for (number, (columns, filled)) in columns.enumerate() {
                    let first = k + 1 + number * COLUMNS;
                    let rows_above = pending.map(|reflection| reflection.column * width + first);
                    apply(
                        simd,
                        (&pending, four),
                        (&mut *triangle, rows_above),
                        (columns, stride),
                        filled,
                    );
                }
                count = 0;
            }
        }
    }
}

/// Applies four reflections, one after the other in effect, to some columns of the panel and to the triangle's numbers above them. With `c` a column, `r_j` the triangle's number in the row of
/// reflection `j`, and `c + sum_{i < j} f_i v_i` what reflection `j` finds: `r_j` grows by `g_j = (v_j . c + sum_{i < j} f_i v_j . v_i - delta_j r_j) / beta_j`, and `f_j = -g_j / delta_j`.
#[inline(always)]
fn apply<S: Simd>(
    simd: S,
    (reflections, four): (&[Reflection; TOGETHER], [&[f64]; TOGETHER]),
    (triangle, places): (&mut [f64], [usize; TOGETHER]),
    (columns, stride): (&mut [f64], usize),
    filled: &mut [bool],
) {
    let (count, rows) = (filled.len(), four[0].len());
    let mut above = [[0.0; COLUMNS]; TOGETHER];
    for (above, place) in above.iter_mut().zip(places) {
        above[..count].copy_from_slice(&triangle[place..][..count]);
    }
    let mut is_any = false;
    for (place, filled) in filled.iter_mut().enumerate() {
        for above in &above {
            *filled |= above[place] != 0.0;
        }
        is_any |= *filled;
    }
    if !is_any {
        return;
    }
    // What is not filled is zero, and stays it.
    let mut factors = [[0.0; COLUMNS]; TOGETHER];
    for (place, column) in columns.chunks(stride).enumerate() {
        for (products, product) in factors
            .iter_mut()
            .zip(lanes::inner_of_four(simd, four, &column[..rows]))
        {
            products[place] = product;
        }
    }
    for (j, reflection) in reflections.iter().enumerate() {
        let (earlier, own) = factors.split_at_mut(j);
        for (earlier, product) in earlier.iter().zip(&reflection.products) {
            for place in 0..COLUMNS {
                own[0][place] += earlier[place] * product;
            }
        }
        for place in 0..COLUMNS {
            let growth = (own[0][place] - reflection.delta * above[j][place]) * reflection.per_beta;
            above[j][place] += growth;
            own[0][place] = -(growth * reflection.per_delta);
        }
    }
    for (above, place) in above.iter().zip(places) {
        triangle[place..][..count].copy_from_slice(&above[..count]);
    }
    for (place, column) in columns.chunks_mut(stride).enumerate() {
        let own = [
            factors[0][place],
            factors[1][place],
            factors[2][place],
            factors[3][place],
        ];
        lanes::add_four(simd, &mut column[..rows], own, four);
    }
}

/// `[R | z]`, row by row; below the diagonal zeros.
#[derive(Clone, Debug, PartialEq)]
struct Triangle {
    unknowns: usize,
    values: Vec<f64>,
}

impl Triangle {
    fn new(unknowns: usize) -> Self {
        Self {
            unknowns,
            values: vec![0.0; unknowns * (unknowns + 1)],
        }
    }

    /// `[R_kk ... R_kn | z_k]`.
    fn row(&self, k: usize) -> &[f64] {
        let width = self.unknowns + 1;
        &self.values[k * width + k..(k + 1) * width]
    }

    fn right_sides(&self) -> impl Iterator<Item = f64> {
        let width = self.unknowns + 1;
        self.values.iter().skip(self.unknowns).step_by(width).copied()
    }

    /// Takes the panel's rows in and leaves it empty. Returns by how much the residual's square sum grows.
    fn absorb(&mut self, panel: &mut Panel) -> f64 {
        let rows = panel.pad();
        if rows == 0 {
            return 0.0;
        }
        let Panel {
            stride, values, filled, ..
        } = &mut *panel;
        Arch::new().dispatch(Reflect {
            unknowns: self.unknowns,
            triangle: &mut self.values,
            rows,
            stride: *stride,
            panel: values,
            filled,
        });
        let right = &panel.values[self.unknowns * panel.stride..][..rows];
        let residual = dot(right, right);
        panel.clear();
        residual
    }

    /// Takes in the rows of another triangle, whose unknown `i` is `columns[i]` here. Returns by how much the residual's square sum grows.
    fn add(&mut self, other: &Self, columns: &[usize], work: &mut Panel, row: &mut [f64]) -> f64 {
        let mut residual = 0.0;
        for k in 0..other.unknowns {
            let from = other.row(k);
            if from.iter().all(|&value| value == 0.0) {
                continue;
            }
            row.fill(0.0);
            for (&column, &value) in columns[k..].iter().zip(from) {
                row[column] = value;
            }
            if work.push_row(row, from[from.len() - 1]).is_err() {
                residual += self.absorb(work);
                // There is room now, and what lies in a triangle is finite.
                let _ = work.push_row(row, from[from.len() - 1]);
            }
        }
        residual + self.absorb(work)
    }

    /// Unknown `c` goes one step: `x_c + w`, `w` of this standard deviation, infinite: anything.
    ///
    /// In the new unknown, each row has `-R_ic w` besides, and `w / deviation = 0` is one row more. Rotations of that row with rows c to 0, in this
    /// order, free these of `w` and leave them a triangle; what is left is about `w`, and dropped (Bierman 1977, sect. VII.2).
    fn walk(&mut self, c: usize, deviation: f64, walk: &mut [f64]) {
        let width = self.unknowns + 1;
        walk.fill(0.0);
        let mut of_walk = 1.0 / deviation;
        if of_walk.is_infinite() {
            return; // less than any rounding
        }
        for i in (0..=c).rev() {
            let row = &mut self.values[i * width + i..(i + 1) * width];
            let of_row = -row[c - i];
            if of_row == 0.0 {
                continue;
            }
            let hypotenuse = of_walk.hypot(of_row);
            let (cosine, sine) = (of_walk / hypotenuse, of_row / hypotenuse);
            for (walk, row) in walk[i..].iter_mut().zip(&mut *row) {
                (*walk, *row) = (cosine * *walk + sine * *row, cosine * *row - sine * *walk);
            }
            of_walk = hypotenuse;
            if deviation == f64::INFINITY {
                row[c - i] = 0.0; // exactly
            }
        }
    }

    /// `a <- R^-T a`. Where `R` tells nothing of an unknown, zero.
    fn forward(&self, a: &mut [f64], smallest: &[f64]) {
        for k in 0..self.unknowns {
            if a[k] == 0.0 {
                continue;
            }
            let row = self.row(k);
            a[k] = if row[0] > smallest[k] { a[k] / row[0] } else { 0.0 };
            let (solved, rest) = a.split_at_mut(k + 1);
            add_multiple(rest, -solved[k], &row[1..self.unknowns - k]);
        }
    }

    /// For each column the size of a diagonal element that is no more than rounding.
    fn rounding(&self, smallest: &mut [f64]) {
        smallest.fill(0.0);
        for k in 0..self.unknowns {
            for (sum, value) in smallest[k..].iter_mut().zip(self.row(k)) {
                *sum += value * value;
            }
        }
        smallest.iter_mut().for_each(|sum| *sum = ROUNDING * sum.sqrt());
    }
}

/// A sum that keeps what its additions round (Neumaier 1974); what it stands for is not negative.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sum {
    high: f64,
    low: f64,
}

impl Sum {
    fn add(&mut self, value: f64) {
        let sum = self.high + value;
        self.low += if self.high.abs() >= value.abs() {
            (self.high - sum) + value
        } else {
            (value - sum) + self.high
        };
        self.high = sum;
    }

    fn get(self) -> f64 {
        (self.high + self.low).max(0.0)
    }
}

/// Information of any number of whitened rows about `n` unknowns: `[R | z]` and the residual's square sum.
#[derive(Clone, Debug)]
pub struct Information {
    triangle: Triangle,
    residual: Sum,
    rows: u64,
    /// A row, for drifting.
    walk: Vec<f64>,
}

impl Information {
    /// None, about so many unknowns.
    pub fn new(unknowns: usize) -> Self {
        Self {
            triangle: Triangle::new(unknowns),
            residual: Sum::default(),
            rows: 0,
            walk: vec![0.0; unknowns + 1],
        }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.triangle.unknowns
    }

    /// Number of rows taken in.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// `|A x - y|^2` of all rows at the `x` that fits them best; steps of walks that `x` needs count as rows do.
    pub fn residual_square(&self) -> f64 {
        self.residual.get()
    }

    /// Row `k` of `[R | z]`, from its diagonal on: `R_kk` ... `R_kn`, then `z_k`.
    pub fn row(&self, k: usize) -> &[f64] {
        self.triangle.row(k)
    }

    /// `R` and `z`, copied: `R` upper triangular, `n x n`.
    pub fn to_triangle(&self) -> (DMatrix<f64>, DVector<f64>) {
        let (n, values) = (self.unknowns(), &self.triangle.values);
        let root = DMatrix::from_fn(n, n, |i, j| values[i * (n + 1) + j]);
        (root, DVector::from_iterator(n, self.triangle.right_sides()))
    }

    /// Becomes what `other` is. Does not allocate.
    ///
    /// # Errors
    /// The other is about another number of unknowns. Nothing is changed then.
    pub fn copy_from(&mut self, other: &Self) -> Result<(), InformationError> {
        check_size("unknowns of the other information", other.unknowns(), self.unknowns())?;
        self.triangle.values.copy_from_slice(&other.triangle.values);
        (self.residual, self.rows) = (other.residual, other.rows);
        Ok(())
    }

    /// Takes in the panel's rows and leaves the panel empty. Does not allocate.
    ///
    /// # Errors
    /// The panel is about another number of unknowns. Nothing is changed then.
    pub fn absorb(&mut self, panel: &mut Panel) -> Result<(), InformationError> {
        check_size("unknowns of the panel", panel.unknowns, self.unknowns())?;
        self.rows += panel.rows as u64;
        self.residual.add(self.triangle.absorb(panel));
        Ok(())
    }

    /// Takes in all that `other` knows, as if its rows had been absorbed here: its unknown `i` is `columns[i]` of this one. Information that nothing links
    /// adds up: of several logs about one robot, of a sub-tree's rows about the whole. Allocates.
    ///
    /// # Errors
    /// Not one column per unknown of `other`, or one that does not exist here. Nothing is changed then.
    pub fn merge(&mut self, other: &Self, columns: &[usize]) -> Result<(), InformationError> {
        let n = self.unknowns();
        check_size("columns of the other information", columns.len(), other.unknowns())?;
        check_columns(columns, n)?;
        let (mut work, mut row) = (Panel::new(n, MERGED_ROWS), vec![0.0; n]);
        self.residual
            .add(self.triangle.add(&other.triangle, columns, &mut work, &mut row));
        self.residual.add(other.residual.get());
        self.rows += other.rows;
        Ok(())
    }

    /// The same as [`Information::merge`], and `other` knows nothing afterwards. Does not allocate: `work` is any panel about these unknowns, empty before and after, and `row` has room for one.
    ///
    /// # Errors
    /// As for [`Information::merge`], and if panel or row do not fit.
    pub(super) fn take(
        &mut self,
        other: &mut Self,
        columns: &[usize],
        work: &mut Panel,
        row: &mut [f64],
    ) -> Result<(), InformationError> {
        check_size("columns of the other information", columns.len(), other.unknowns())?;
        check_columns(columns, self.unknowns())?;
        check_size("unknowns of the panel", work.unknowns, self.unknowns())?;
        check_size("numbers of a row", row.len(), self.unknowns())?;
        self.residual
            .add(self.triangle.add(&other.triangle, columns, work, row));
        self.residual.add(other.residual.get());
        self.rows += other.rows;
        other.clear();
        Ok(())
    }

    /// Knows nothing any more.
    pub(super) fn clear(&mut self) {
        self.triangle.values.fill(0.0);
        (self.residual, self.rows) = (Sum::default(), 0);
    }

    /// One step of a random walk: unknown `columns[i]` becomes `x + w`, `w` normal with the standard deviation `deviation[i]`, independent of
    /// everything. From here on the unknown is the one after the step. Zero changes nothing; with infinity the unknown starts afresh, and what was known of
    /// the others remains. Exact; does not allocate; rows after the column are not touched.
    ///
    /// # Errors
    /// The two differ in length, a column does not exist, a deviation is negative or no number. Nothing is changed then.
    pub fn drift(&mut self, columns: &[usize], deviation: &[f64]) -> Result<(), InformationError> {
        check_size("standard deviations of a drift", deviation.len(), columns.len())?;
        check_columns(columns, self.unknowns())?;
        if let Some(&value) = deviation.iter().find(|value| value.is_nan() || **value < 0.0) {
            let what = "a drift's standard deviation";
            return Err(InformationError::Range { what, value });
        }
        for (&column, &deviation) in columns.iter().zip(deviation) {
            self.triangle.walk(column, deviation, &mut self.walk);
        }
        Ok(())
    }

    /// Forgets these unknowns, a session's when it ends: they become free, and what their rows told of the others remains (with `A^T A = [[B, C], [C^T, D]]`,
    /// of the others `B - C D^-1 C^T`). The same as a drift without bound.
    ///
    /// # Errors
    /// A column does not exist. Nothing is changed then.
    pub fn marginalise(&mut self, columns: &[usize]) -> Result<(), InformationError> {
        check_columns(columns, self.unknowns())?;
        for &column in columns {
            self.triangle.walk(column, f64::INFINITY, &mut self.walk);
        }
        Ok(())
    }

    /// What is known of the unknowns from `first` on alone, those before it being free: a corner of the triangle, copied. Empty if there are none.
    pub fn trailing(&self, first: usize) -> Self {
        let n = self.unknowns().saturating_sub(first);
        let mut trailing = Self::new(n);
        for (k, to) in trailing.triangle.values.chunks_exact_mut(n + 1).enumerate() {
            to[k..].copy_from_slice(self.row(first + k));
        }
        trailing.residual = self.residual;
        trailing.rows = self.rows;
        trailing
    }

    /// What is known of these unknowns alone, in this order, the others being free. Allocates; for a tail of the unknowns [`Information::trailing`] is quick.
    ///
    /// # Errors
    /// A column does not exist, or is named twice.
    pub fn marginal(&self, columns: &[usize]) -> Result<Self, InformationError> {
        let n = self.unknowns();
        check_columns(columns, n)?;
        let free: Vec<usize> = (0..n).filter(|column| !columns.contains(column)).collect();
        check_size("different columns", n - free.len(), columns.len())?;
        let mut places = vec![0; n];
        for (place, &column) in free.iter().chain(columns).enumerate() {
            places[column] = place;
        }
        let mut reordered = Self::new(n);
        reordered.merge(self, &places)?;
        let mut marginal = reordered.trailing(free.len());
        marginal.residual = self.residual;
        Ok(marginal)
    }

    /// What the rows excite, unknowns measured by the root of their own information. Allocates; a singular value decomposition.
    pub fn excitation(&self) -> Excitation {
        let (mut scaled, _) = self.to_triangle();
        let scales: Vec<f64> = scaled.column_iter().map(|column| column.norm()).collect();
        for (mut column, &scale) in scaled.column_iter_mut().zip(&scales) {
            column /= if scale > 0.0 { scale } else { 1.0 };
        }
        let svd = scaled.svd(false, true);
        Excitation {
            singular: svd.singular_values.iter().copied().collect(),
            directions: svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, 0)),
            scales,
        }
    }
}

/// Rows of a triangle that are taken in at once.
const MERGED_ROWS: usize = 32;

fn check_columns(columns: &[usize], unknowns: usize) -> Result<(), InformationError> {
    match columns.iter().find(|&&column| column >= unknowns) {
        Some(&column) => Err(InformationError::Column { column, unknowns }),
        None => Ok(()),
    }
}

/// Information and prior, solved: an estimate and how sure it is. Room is made once; [`Posterior::update`] and [`Posterior::deviation`] do not allocate.
#[derive(Clone, Debug)]
pub struct Posterior {
    triangle: Triangle,
    work: Panel,
    row: Vec<f64>,
    smallest: Vec<f64>,
    identity: Vec<usize>,
    estimate: Vec<f64>,
    cost: f64,
}

impl Posterior {
    /// Room for so many unknowns; all of them zero.
    pub fn new(unknowns: usize) -> Self {
        Self {
            triangle: Triangle::new(unknowns),
            work: Panel::new(unknowns, MERGED_ROWS),
            row: vec![0.0; unknowns],
            smallest: vec![0.0; unknowns],
            identity: (0..unknowns).collect(),
            estimate: vec![0.0; unknowns],
            cost: 0.0,
        }
    }

    /// Least squares with the rows of both. A prior is given as the information of its rows: `x = x_0` with standard deviation `s` is the row
    /// `x / s = x_0 / s`. Neither is changed.
    ///
    /// # Errors
    /// Numbers of unknowns that differ, or an unknown that nothing determines. The estimate is the last one then, the covariance none.
    pub fn update(&mut self, information: &Information, prior: Option<&Information>) -> Result<(), InformationError> {
        let n = self.estimate.len();
        check_size("unknowns of the information", information.unknowns(), n)?;
        self.triangle.values.copy_from_slice(&information.triangle.values);
        let mut cost = information.residual;
        if let Some(prior) = prior {
            check_size("unknowns of the prior", prior.unknowns(), n)?;
            let (work, row) = (&mut self.work, &mut self.row[..]);
            cost.add(self.triangle.add(&prior.triangle, &self.identity, work, row));
            cost.add(prior.residual.get());
        }
        self.triangle.rounding(&mut self.smallest);
        let undetermined = |k: &usize| self.triangle.row(*k)[0] <= self.smallest[*k];
        if let Some(unknown) = (0..n).find(undetermined) {
            return Err(InformationError::Undetermined { unknown });
        }
        for k in (0..n).rev() {
            let row = self.triangle.row(k);
            let known = dot(&row[1..n - k], &self.estimate[k + 1..]);
            self.estimate[k] = (row[n - k] - known) / row[0];
        }
        self.cost = cost.get();
        Ok(())
    }

    /// The unknowns.
    pub fn estimate(&self) -> &[f64] {
        &self.estimate
    }

    /// `|A x - y|^2` at the estimate, of all rows, the prior's among them.
    pub fn cost(&self) -> f64 {
        self.cost
    }

    /// Standard deviation of `a x`: `sqrt(a P a^T) = |R^-T a^T|`, without the noise of a measurement of it. Unknowns after the end of `a` do not count.
    pub fn deviation(&mut self, a: &[f64]) -> f64 {
        self.row.fill(0.0);
        for (to, from) in self.row.iter_mut().zip(a) {
            *to = *from;
        }
        self.triangle.forward(&mut self.row, &self.smallest);
        dot(&self.row, &self.row).sqrt()
    }

    /// `log det(A^T A)`, the prior's rows among those of `A`: for the evidence.
    pub fn log_determinant(&self) -> f64 {
        let diagonal = (0..self.estimate.len()).map(|k| self.triangle.row(k)[0]);
        2.0 * diagonal.map(f64::ln).sum::<f64>()
    }

    /// `R^-1`, a square root of the covariance: `P = R^-1 R^-T`. Upper triangular, `n x n`; column `k` has nothing below row `k`. Allocates.
    pub fn covariance_root(&self) -> DMatrix<f64> {
        let n = self.estimate.len();
        // Row i of R^-1 is u^T R^-1 with u the unit vector: R^-T u, a forward substitution.
        let mut root = DMatrix::zeros(n, n);
        let mut unit = vec![0.0; n];
        for i in 0..n {
            unit.fill(0.0);
            unit[i] = 1.0;
            self.triangle.forward(&mut unit, &self.smallest);
            root.row_mut(i).iter_mut().zip(&unit).for_each(|(to, from)| *to = *from);
        }
        root
    }

    /// `P`, the covariance of the estimate, `n x n`. Allocates.
    pub fn covariance(&self) -> DMatrix<f64> {
        let root = self.covariance_root();
        &root * root.transpose()
    }
}

/// Absorbs like [`Information::absorb`], and in the directions that a panel tells of lets old information make room, so that what changed is followed.
///
/// A direction that nothing is told about keeps all its information, bit for bit: standing still forgets nothing, and there is no wind-up. In detail: with `P` the
/// covariance before the panel, the panel's rows are rotated such that their predictions are independent, `A P A^T = diag(s_1^2, s_2^2, ...)`; `s_i^2` is the panel's
/// information in direction `i` over the old one's. In each of them the fraction `min(1 - retention, s_i^2)` of the old information is let go, and then the row
/// added. So
/// - information never decreases in any direction, and where rows bring less than `1 - retention` of what is there, they replace as much as they bring;
/// - under steady excitation it is plain exponential forgetting, a memory of `1 / (1 - retention)` panels, in whatever subspace is excited (where panels differ
///   much, the rich ones set the level and the memory is some times longer);
/// - nothing depends on units or on the choice of coordinates: directions are those of the rows in the metric of `P`.
///
/// What is known already beyond `1 / (1 - retention)` panels, from logs or from richer motion, is therefore given up no faster than rows replace it. A change that
/// was detected wants more: [`Information::drift`] of the unknowns that it concerns.
///
/// One row at a time and without the `min`, this is Kulhavy's restricted exponential forgetting (Automatica 23, 1987, pp. 589-600). Cao and Schwartz (Automatica
/// 36, 2000, pp. 1725-1731) take directions by the Euclidean product of unknowns, which depends on units. A bound on the covariance has to be chosen for each unknown;
/// here one number is, and it is a time.
#[derive(Clone, Debug)]
pub struct DirectionalForgetting {
    retention: f64,
    /// Old and new information together.
    after: Triangle,
    smallest: Vec<f64>,
    /// The panel's rows with their right sides, one after the other; and their `R^-T a` with `R` of `after`.
    rows: Vec<f64>,
    whitened: Vec<f64>,
    /// Residuals at the estimate of `after`.
    residuals: Vec<f64>,
    gram: Vec<f64>,
    rotation: Vec<f64>,
    rotated: Vec<f64>,
    pull: Vec<f64>,
}

impl DirectionalForgetting {
    /// For panels of at most `capacity` rows; `retention` in (0, 1]: what one panel leaves of old information that it replaces fully. One forgets nothing.
    ///
    /// # Errors
    /// A retention outside its range.
    pub fn new(unknowns: usize, capacity: usize, retention: f64) -> Result<Self, InformationError> {
        if !(retention > 0.0 && retention <= 1.0) {
            let what = "the retention of a forgetting";
            return Err(InformationError::Range { what, value: retention });
        }
        Ok(Self {
            retention,
            after: Triangle::new(unknowns),
            smallest: vec![0.0; unknowns],
            rows: vec![0.0; capacity * (unknowns + 1)],
            whitened: vec![0.0; capacity * unknowns],
            residuals: vec![0.0; capacity],
            gram: vec![0.0; capacity * capacity],
            rotation: vec![0.0; capacity * capacity],
            rotated: vec![0.0; unknowns + 1],
            pull: vec![0.0; unknowns],
        })
    }

    /// Takes in the panel's rows, lets go of what they replace, and leaves the panel empty. Costs two to three times what absorbing alone does, and a
    /// diagonalisation of the size of the panel, which grows with the cube of its rows: for panels of one or two samples. Does not allocate.
    ///
    /// The residual's square sum grows by the rows' innovations in units of their standard deviations, as without forgetting.
    ///
    /// # Errors
    /// The numbers of unknowns differ, or the panel holds more rows than this was made for: nothing is changed then. Rows whose combinations are beyond
    /// 1e120: the information is not changed, the panel is empty.
    pub fn absorb(&mut self, information: &mut Information, panel: &mut Panel) -> Result<(), InformationError> {
        let (n, count) = (self.after.unknowns, panel.rows);
        check_size("unknowns of the information", information.unknowns(), n)?;
        check_size("unknowns of the panel", panel.unknowns, n)?;
        if count * n > self.whitened.len() || count > self.residuals.len() {
            let capacity = self.residuals.len();
            return Err(InformationError::Full { capacity });
        }
        if self.retention == 1.0 || n == 0 {
            return information.absorb(panel);
        }
        let width = n + 1;
        for (i, row) in self.rows.chunks_exact_mut(width).take(count).enumerate() {
            for (value, column) in row.iter_mut().zip(panel.values.chunks_exact(panel.stride)) {
                *value = column[i];
            }
        }
        // From the sum, where all directions of the rows are known: s^2 / (1 + s^2) instead of s^2, which may be infinite.
        self.after.values.copy_from_slice(&information.triangle.values);
        self.after.absorb(panel);
        self.after.rounding(&mut self.smallest);
        let rows = self.rows.chunks_exact(width).take(count);
        for ((row, whitened), residual) in rows.zip(self.whitened.chunks_exact_mut(n)).zip(&mut self.residuals) {
            whitened.copy_from_slice(&row[..n]);
            self.after.forward(whitened, &self.smallest);
            let predicted: f64 = whitened.iter().zip(self.after.right_sides()).map(|(u, z)| u * z).sum();
            *residual = row[n] - predicted;
        }
        for i in 0..count {
            for j in 0..=i {
                let product = dot(&self.whitened[i * n..(i + 1) * n], &self.whitened[j * n..(j + 1) * n]);
                (self.gram[i * count + j], self.gram[j * count + i]) = (product, product);
            }
        }
        diagonalise(&mut self.gram, &mut self.rotation, count);

        self.pull.fill(0.0);
        let mut grown = 0.0;
        let refill = |panel: &mut Panel, a: &[f64], y: f64| panel.push_row(a, y).inspect_err(|_| panel.clear());
        for i in 0..count {
            self.rotated.fill(0.0);
            let mut residual = 0.0;
            for (j, row) in self.rows.chunks_exact(width).take(count).enumerate() {
                let share = self.rotation[j * count + i];
                add_multiple(&mut self.rotated, share, row);
                residual += share * self.residuals[j];
            }
            let Some((y, a)) = self.rotated.split_last_mut() else {
                continue;
            };
            let share = self.gram[i * count + i].clamp(0.0, 1.0);
            if share > NEW {
                refill(panel, a, *y)?;
                continue;
            }
            let gain = share / (1.0 - share);
            let let_go = gain.min(1.0 - self.retention);
            let weight = if gain > 0.0 { 1.0 - let_go / gain } else { 0.0 };
            let innovation = residual / (1.0 - share);
            let predicted = *y - innovation;
            // Information grows by `weight a^T a`, as if the rest of the row were the old one's; the estimate follows the whole row. By the right side
            // if there is row enough to carry it, else at the end.
            let root = weight.sqrt();
            let square = innovation * innovation / (1.0 + weight * gain);
            if weight >= 0.5 {
                a.iter_mut().for_each(|value| *value *= root);
                refill(panel, a, root * predicted + innovation / root)?;
                grown += square * (1.0 - let_go - 1.0 / weight);
            } else {
                add_multiple(&mut self.pull, innovation, a);
                grown += square * (1.0 - let_go);
                if weight > 0.0 {
                    a.iter_mut().for_each(|value| *value *= root);
                    refill(panel, a, root * predicted)?;
                }
            }
        }
        let triangle = &mut information.triangle;
        grown += triangle.absorb(panel);
        if self.pull.iter().any(|&value| value != 0.0) {
            triangle.rounding(&mut self.smallest);
            triangle.forward(&mut self.pull, &self.smallest);
            let right_sides = triangle.values.iter_mut().skip(n).step_by(width);
            right_sides.zip(&self.pull).for_each(|(z, pull)| *z += pull);
        }
        information.residual.add(grown);
        information.rows += count as u64;
        Ok(())
    }
}

/// Share of a row's information in the sum from which on there is nothing old to forget.
const NEW: f64 = 0.999;

/// Jacobi's rotations: a symmetric matrix, `count x count`, becomes diagonal, `V^T A V`; and `V`. Both lie at the start of their buffers.
fn diagonalise(matrix: &mut [f64], rotation: &mut [f64], count: usize) {
    for (place, value) in rotation.iter_mut().take(count * count).enumerate() {
        *value = if place % (count + 1) == 0 { 1.0 } else { 0.0 };
    }
    let turn = |values: &mut [f64], one: usize, other: usize, cosine: f64, sine: f64| {
        (values[one], values[other]) = (
            cosine * values[one] - sine * values[other],
            sine * values[one] + cosine * values[other],
        );
    };
    for _sweep in 0..30 {
        let (mut off, mut all) = (0.0, 0.0);
        for p in 0..count {
            for q in 0..count {
                let square = matrix[p * count + q].powi(2);
                all += square;
                off += if p == q { 0.0 } else { square };
            }
        }
        if off <= 1e-30 * all {
            return;
        }
        for p in 0..count {
            for q in p + 1..count {
                let between = matrix[p * count + q];
                if between == 0.0 {
                    continue;
                }
                let cotangent = (matrix[q * count + q] - matrix[p * count + p]) / (2.0 * between);
                let tangent = cotangent.signum() / (cotangent.abs() + cotangent.hypot(1.0));
                let cosine = 1.0 / tangent.hypot(1.0);
                let sine = cosine * tangent;
                for k in 0..count {
                    turn(matrix, k * count + p, k * count + q, cosine, sine);
                    turn(rotation, k * count + p, k * count + q, cosine, sine);
                }
                for k in 0..count {
                    turn(matrix, p * count + k, q * count + k, cosine, sine);
                }
            }
        }
    }
}

/// How well rows determine the unknowns, each unknown measured by the root of its own information: numbers that do not depend on units.
#[derive(Clone, Debug)]
pub struct Excitation {
    singular: Vec<f64>,
    /// Row by row, as the singular values.
    directions: DMatrix<f64>,
    scales: Vec<f64>,
}

impl Excitation {
    /// Singular values of the column-scaled `R`, descending. An unknown that no row holds adds a zero.
    pub fn singular_values(&self) -> &[f64] {
        &self.singular
    }

    /// How many of them are above `tolerance` times the greatest.
    pub fn rank(&self, tolerance: f64) -> usize {
        let greatest = self.singular.first().copied().unwrap_or(0.0);
        let counts = |&&value: &&f64| value > tolerance * greatest;
        self.singular.iter().filter(counts).count()
    }

    /// The greatest over the least: infinite if rows leave a direction free.
    pub fn condition(&self) -> f64 {
        match (self.singular.first(), self.singular.last()) {
            (Some(&greatest), Some(&least)) if greatest > 0.0 => greatest / least,
            (Some(_), _) => f64::INFINITY,
            (None, _) => 1.0,
        }
    }

    /// The `number`-th weakest direction, from zero: how far the unknowns go together, in their own units, such that the rows change by the singular value,
    /// in standard deviations. An unknown that no row holds is a direction of its own, of size one.
    pub fn weakest(&self, number: usize) -> Option<Vec<f64>> {
        let row = self.singular.len().checked_sub(number + 1)?;
        let scales = self.scales.iter().map(|&scale| if scale > 0.0 { scale } else { 1.0 });
        Some(
            self.directions
                .row(row)
                .iter()
                .zip(scales)
                .map(|(v, s)| v / s)
                .collect(),
        )
    }
}
