//! The information about the unknowns in square-root form: an upper triangle that absorbs any
//! number of rows in constant memory.
//!
//! Linear measurements `y = A x + e` of `n` unknowns, with independent noise `e` of unit variance
//! (*whitened* rows), reduce to
//!
//! ```text
//! |A x - y|^2 = |R x - z|^2 + rho^2        R: n x n, upper triangular, diagonal >= 0
//! ```
//!
//! `R^T R = A^T A` is the information matrix. Its inverse is the covariance of the least-squares
//! estimate, the solution of `R x = z`. `rho^2` is the square sum of the residuals. `A^T A` itself
//! is never formed, since that would square the condition number. Notation and methods are those of
//! Bierman, "Factorization Methods for Discrete Sequential Estimation" (Academic Press, 1977), ch.
//! IV to VII.
//!
//! - [`Panel`]: a buffer of rows; [`Information`]: `[R | z]`, `rho^2`. It holds no prior; the prior
//!   is added at the solution.
//!
//! # Order of the unknowns
//! Unknowns that drift (nuisance parameters: offsets, friction) belong **first**, constant ones
//! (the robot's parameters) last: `[s | d]`. A random walk of unknown `c` changes only the rows
//! `0..=c`, and [`Information::trailing`] reads the information about `d`, with `s` eliminated,
//! directly off the triangle. Any other order is correct too, but slower.
//!
//! # Speed
//! A panel is absorbed column by column by Householder reflections of the panel's column and one
//! number of `R`: 2 m n^2 operations for `m` rows. All loops run over the panel's columns, which
//! are contiguous, short, and stay in the first-level cache. Four reflections are applied together,
//! to eight columns at a time, in the widest vector instructions of the processor (`simd.rs`).
//! Exact zeros are skipped: a column of zeros in the panel costs little until a reflection fills
//! it. So rows about few unknowns are cheap, provided that their panel has no other rows.
//!
//! Six rows a sample, plain x86-64, `cargo bench -p proprio-identification --bench identify`
//! (two-core virtual machine, AMD EPYC with AVX-512: fastest of 100), us per sample, solution once
//! per panel:
//!
//! | unknowns | panels of 1 sample | 4 | 8 | 16 |
//! |---|---|---|---|---|
//! | 44 | 4.5 | 1.5 | 1.0 | 0.8 |
//! | 66 | 8.7 | 2.9 | 2.0 | 1.5 |
//! | 120 | 24 | 7.8 | 5.2 | 4.0 |
//! | 426 | 282 | 89 | 57 | 43 |
//!
//! Rows about 56 of 426 unknowns that no row links to the others, panels of 8: 5.7. A step of six
//! random walks among 44 unknowns: 0.6 us if they are the first, 5.5 if the last; of 36 among 426:
//! 92 us and 1200.
//!
//! # Numerical stability
//! - Every step is an orthogonal transformation. Each is backward stable column by column, whatever
//!   the scales of the columns (Higham, "Accuracy and Stability of Numerical Algorithms", SIAM
//!   2002, th. 19.13). A rank-deficient start is allowed: `R` may hold zeros.
//! - `R` is *corrected*, not recomputed: `R + e` with `e` of the panel's size. The rounding error
//!   of a step is half a unit in the last place of `R`, and unbiased. After `N` panels the relative
//!   error is of the order of `sqrt(N) 1e-16`: 1e-12 after 1e8. A correction is lost only if it is
//!   below that unit, after 1e15 equal rows.

mod panel;

pub use panel::{InformationError, Panel};

use crate::arithmetic::dot;
use nalgebra::{DMatrix, DVector};
use panel::Reflect;
pub(crate) use panel::check_size;
use pulp::Arch;

/// A compensated sum (Neumaier 1974) of a quantity that is not negative.
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

/// The information of any number of whitened rows about `n` unknowns: `[R | z]` and the square sum
/// of the residuals.
#[derive(Clone, Debug)]
pub struct Information {
    unknowns: usize,
    /// `[R | z]`, row by row; zeros below the diagonal.
    values: Vec<f64>,
    residual: Sum,
    rows: u64,
    /// Work space of [`Information::drift`]: one row.
    work_row: Vec<f64>,
}

impl Information {
    /// No information, about this many unknowns.
    pub fn new(unknowns: usize) -> Self {
        Self {
            unknowns,
            values: vec![0.0; unknowns * (unknowns + 1)],
            residual: Sum::default(),
            rows: 0,
            work_row: vec![0.0; unknowns + 1],
        }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.unknowns
    }

    /// Number of absorbed rows.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// `|A x - y|^2` of all rows at the `x` that fits them best. Steps of random walks count as
    /// rows.
    pub fn residual_square(&self) -> f64 {
        self.residual.get()
    }

    /// Row `k` of `[R | z]`, from its diagonal on: `R_kk` ... `R_kn`, then `z_k`.
    pub fn row(&self, k: usize) -> &[f64] {
        let width = self.unknowns + 1;
        &self.values[k * width + k..(k + 1) * width]
    }

    /// `R` and `z`, copied: `R` upper triangular, `n x n`.
    pub fn to_triangle(&self) -> (DMatrix<f64>, DVector<f64>) {
        let n = self.unknowns;
        let at = |i: usize, j: usize| self.values[i * (n + 1) + j];
        (
            DMatrix::from_fn(n, n, at),
            DVector::from_fn(n, |i, _| at(i, n)),
        )
    }

    /// Becomes a copy of `other`. Does not allocate.
    ///
    /// # Errors
    /// The other has another number of unknowns. Nothing is changed then.
    pub fn copy_from(&mut self, other: &Self) -> Result<(), InformationError> {
        let what = "unknowns of the other information";
        check_size(what, other.unknowns(), self.unknowns())?;
        self.values.copy_from_slice(&other.values);
        (self.residual, self.rows) = (other.residual, other.rows);
        Ok(())
    }

    /// Absorbs the panel's rows and empties the panel. Does not allocate.
    ///
    /// # Errors
    /// The panel has another number of unknowns. Nothing is changed then.
    pub fn absorb(&mut self, panel: &mut Panel) -> Result<(), InformationError> {
        check_size("unknowns of the panel", panel.unknowns, self.unknowns())?;
        self.rows += panel.rows as u64;
        let residual = self.reflect(panel);
        self.residual.add(residual);
        Ok(())
    }

    /// Reflects the panel's rows into the triangle and empties the panel. Returns the increase of
    /// the residual's square sum.
    fn reflect(&mut self, panel: &mut Panel) -> f64 {
        let rows = panel.pad();
        if rows == 0 {
            return 0.0;
        }
        let Panel {
            stride,
            values,
            filled,
            ..
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

    /// Absorbs the information of `other`, as if its rows had been absorbed here. Its unknown `i`
    /// is `columns[i]` of this one. Independent information adds up: of several logs about one
    /// robot, of a sub-tree's rows about the whole. Allocates.
    ///
    /// # Errors
    /// The number of columns differs from the number of unknowns of `other`, or a column does not
    /// exist here. Nothing is changed then.
    pub fn merge(&mut self, other: &Self, columns: &[usize]) -> Result<(), InformationError> {
        let n = self.unknowns();
        self.add(
            other,
            columns,
            &mut Panel::new(n, MERGED_ROWS),
            &mut vec![0.0; n],
        )
    }

    /// As [`Information::merge`], and clears `other`. Does not allocate: `work` is any panel about
    /// these unknowns, empty before and after, and `row` holds one row.
    ///
    /// # Errors
    /// As for [`Information::merge`], and if panel or row do not fit.
    pub(crate) fn take(
        &mut self,
        other: &mut Self,
        columns: &[usize],
        work: &mut Panel,
        row: &mut [f64],
    ) -> Result<(), InformationError> {
        self.add(other, columns, work, row)?;
        other.clear();
        Ok(())
    }

    fn add(
        &mut self,
        other: &Self,
        columns: &[usize],
        work: &mut Panel,
        row: &mut [f64],
    ) -> Result<(), InformationError> {
        let what = "columns of the other information";
        check_size(what, columns.len(), other.unknowns())?;
        check_columns(columns, self.unknowns())?;
        check_size("unknowns of the panel", work.unknowns, self.unknowns())?;
        check_size("numbers of a row", row.len(), self.unknowns())?;
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
                residual += self.reflect(work);
                // There is room now, and the numbers of a triangle are finite.
                let _ = work.push_row(row, from[from.len() - 1]);
            }
        }
        residual += self.reflect(work);
        self.residual.add(residual);
        self.residual.add(other.residual.get());
        self.rows += other.rows;
        Ok(())
    }

    /// Removes all information.
    pub(crate) fn clear(&mut self) {
        self.values.fill(0.0);
        (self.residual, self.rows) = (Sum::default(), 0);
    }

    /// One step of a random walk: unknown `columns[i]` becomes `x + w`, with `w` independent,
    /// normal, of standard deviation `deviation[i]`. The unknown then is its value after the step.
    /// Zero changes nothing. Infinity re-initialises the unknown and keeps the information about
    /// the others. Exact; does not allocate; does not change rows after the column.
    ///
    /// # Errors
    /// The lengths differ, a column does not exist, or a deviation is negative or NaN. Nothing is
    /// changed then.
    pub fn drift(&mut self, columns: &[usize], deviation: &[f64]) -> Result<(), InformationError> {
        let what = "standard deviations of a drift";
        check_size(what, deviation.len(), columns.len())?;
        check_columns(columns, self.unknowns())?;
        let is_invalid = |value: &&f64| value.is_nan() || **value < 0.0;
        if let Some(&value) = deviation.iter().find(is_invalid) {
            let what = "a drift's standard deviation";
            return Err(InformationError::Range { what, value });
        }
        for (&column, &deviation) in columns.iter().zip(deviation) {
            self.walk(column, deviation);
        }
        Ok(())
    }

    /// Marginalises these unknowns, for example the nuisance parameters at the end of a log: they
    /// become free, and the information about the others remains (with `A^T A = [[B, C], [C^T,
    /// D]]`, `B - C D^-1 C^T` for the others). The same as a drift by infinity.
    ///
    /// # Errors
    /// A column does not exist. Nothing is changed then.
    pub fn marginalise(&mut self, columns: &[usize]) -> Result<(), InformationError> {
        check_columns(columns, self.unknowns())?;
        for &column in columns {
            self.walk(column, f64::INFINITY);
        }
        Ok(())
    }

    /// A step of a random walk of unknown `c`: `x_c + w`, `w` of this standard deviation, infinite
    /// for a free unknown.
    ///
    /// In the new unknown, each row has an additional term `-R_ic w`, and `w / deviation = 0` is an
    /// additional row. Rotations of that row with rows c to 0, in this order, remove `w` from these
    /// and keep them triangular. The remaining row is about `w` and dropped (Bierman 1977, sect.
    /// VII.2).
    fn walk(&mut self, c: usize, deviation: f64) {
        let (width, work_row) = (self.unknowns + 1, &mut self.work_row);
        work_row.fill(0.0);
        let mut pivot = 1.0 / deviation;
        if pivot.is_infinite() {
            return; // less than any rounding
        }
        for i in (0..=c).rev() {
            let row = &mut self.values[i * width + i..(i + 1) * width];
            let entry = -row[c - i];
            if entry == 0.0 {
                continue;
            }
            let hypotenuse = pivot.hypot(entry);
            let (cosine, sine) = (pivot / hypotenuse, entry / hypotenuse);
            for (work_row, row) in work_row[i..].iter_mut().zip(&mut *row) {
                (*work_row, *row) = (
                    cosine * *work_row + sine * *row,
                    cosine * *row - sine * *work_row,
                );
            }
            pivot = hypotenuse;
            if deviation == f64::INFINITY {
                row[c - i] = 0.0; // exactly
            }
        }
    }

    /// The marginal information about the unknowns from `first` on: a corner of the triangle,
    /// copied. Empty if there are none.
    pub fn trailing(&self, first: usize) -> Self {
        let n = self.unknowns().saturating_sub(first);
        let mut trailing = Self::new(n);
        for (k, to) in trailing.values.chunks_exact_mut(n + 1).enumerate() {
            to[k..].copy_from_slice(self.row(first + k));
        }
        trailing.residual = self.residual;
        trailing.rows = self.rows;
        trailing
    }
}

/// Rows of a triangle that are absorbed at once.
const MERGED_ROWS: usize = 32;

fn check_columns(columns: &[usize], unknowns: usize) -> Result<(), InformationError> {
    match columns.iter().find(|&&column| column >= unknowns) {
        Some(&column) => Err(InformationError::Column { column, unknowns }),
        None => Ok(()),
    }
}
