//! Weighted least squares of least norm for six equations and any number of unknowns, without
//! allocation.
//!
//! For `A x = b` with noise covariance `C = L L^T` on `b` and weights `w_j` on the unknowns: the
//! solution is, of all `x` that minimise `(b - A x)^T C^-1 (b - A x)`, the one that minimises
//! `sum (x_j / w_j)^2`. With `M = L^-1 A W` this is `x = W M^+ L^-1 b`. The pseudo-inverse comes
//! from a one-sided Jacobi rotation of the six rows of `M` until they are orthogonal,
//! `Q^T M = diag(sigma) V^T`. This gives the singular values to full relative accuracy (Demmel,
//! Veselic 1992), so the rank is decided from them and not from their squares. A few sweeps over
//! fixed storage suffice.
//!
//! The covariance and the weights are properties of sensors and contacts, not of coordinates: `x`
//! does not depend on the point and the axes in which the six equations are written.

use nalgebra::{Matrix6, Vector6};

/// Singular values below this, relative to the greatest, count as zero.
const RANK_TOLERANCE: f64 = 1e-8;
/// Rows count as orthogonal below this cosine.
const ORTHOGONAL: f64 = 1e-15;
/// Rows whose square is below this fraction of the sum of all squares are rounding errors. They are
/// not rotated, because the loop would not converge on them.
const NEGLIGIBLE: f64 = 1e-26;
/// Maximal number of sweeps over all pairs of rows; six or seven suffice, the bound only guards the
/// loop.
const SWEEPS: usize = 30;

/// Solution operator of one set of six equations.
#[derive(Clone, Debug)]
pub struct LeastSquares {
    /// Columns of `Q^T M`, one per unknown.
    columns: Vec<Vector6<f64>>,
    weights: Vec<f64>,
    /// `1 / sigma_i^2`, or zero where `sigma_i` counts as zero.
    inverse_squares: Vector6<f64>,
    /// Columns `L^-T q_i`.
    dual: Matrix6<f64>,
    rank: usize,
}

impl LeastSquares {
    /// Room for `capacity` unknowns.
    pub fn with_capacity(capacity: usize) -> Self {
        Self {
            columns: Vec::with_capacity(capacity),
            weights: Vec::with_capacity(capacity),
            inverse_squares: Vector6::zeros(),
            dual: Matrix6::identity(),
            rank: 0,
        }
    }

    /// Removes all unknowns.
    pub fn clear(&mut self) {
        self.columns.clear();
        self.weights.clear();
    }

    /// Whether there is no unknown.
    pub fn is_empty(&self) -> bool {
        self.columns.is_empty()
    }

    /// Adds an unknown: its column of `A` and its weight `w_j`.
    pub fn push(&mut self, column: Vector6<f64>, weight: f64) {
        self.columns.push(column);
        self.weights.push(weight);
    }

    /// Factorises, given the lower Cholesky factor `L` of the covariance.
    pub fn factorise(&mut self, lower: &Matrix6<f64>) {
        for (column, weight) in self.columns.iter_mut().zip(&self.weights) {
            lower.solve_lower_triangular_unchecked_mut(column);
            *column *= *weight;
        }
        let negligible = NEGLIGIBLE
            * self
                .columns
                .iter()
                .map(nalgebra::Matrix::norm_squared)
                .sum::<f64>();
        let mut q = Matrix6::<f64>::identity();
        for _ in 0..SWEEPS {
            let mut rotated = false;
            for i in 0..5 {
                for j in i + 1..6 {
                    rotated |= self.rotate_rows(&mut q, i, j, negligible);
                }
            }
            if !rotated {
                break;
            }
        }
        let squares = self.columns.iter().fold(Vector6::zeros(), |sum, column| {
            sum + column.component_mul(column)
        });
        let least = squares.max() * RANK_TOLERANCE * RANK_TOLERANCE;
        self.inverse_squares = squares.map(|square| {
            if square > least && square > 0.0 {
                1.0 / square
            } else {
                0.0
            }
        });
        self.rank = self.inverse_squares.iter().filter(|&&x| x > 0.0).count();
        // From the last row up, all columns at once: a quarter of the time of column by column.
        let mut rows = q.transpose();
        for i in (0..6).rev() {
            let mut row = rows.column(i).into_owned();
            for k in i + 1..6 {
                row -= rows.column(k) * lower[(k, i)];
            }
            rows.set_column(i, &(row / lower[(i, i)]));
        }
        self.dual = rows.transpose();
    }

    /// One Jacobi rotation. Returns whether it was needed.
    fn rotate_rows(&mut self, q: &mut Matrix6<f64>, i: usize, j: usize, negligible: f64) -> bool {
        let (mut ii, mut jj, mut ij) = (0.0, 0.0, 0.0);
        for column in &self.columns {
            ii += column[i] * column[i];
            jj += column[j] * column[j];
            ij += column[i] * column[j];
        }
        if ij == 0.0 || ij.abs() <= ORTHOGONAL * (ii * jj).sqrt() || ii.min(jj) <= negligible {
            return false;
        }
        let zeta = (jj - ii) / (2.0 * ij);
        let t = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
        let c = 1.0 / (1.0 + t * t).sqrt();
        let s = c * t;
        for column in &mut self.columns {
            let (a, b) = (column[i], column[j]);
            column[i] = c * a - s * b;
            column[j] = s * a + c * b;
        }
        for row in 0..6 {
            let (a, b) = (q[(row, i)], q[(row, j)]);
            q[(row, i)] = c * a - s * b;
            q[(row, j)] = s * a + c * b;
        }
        true
    }

    /// Rank of the six equations in the unknowns.
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// The row of the solution operator for unknown `j`: `x_j = k . b`.
    pub fn gain(&self, j: usize) -> Vector6<f64> {
        self.dual * self.columns[j].component_mul(&self.inverse_squares) * self.weights[j]
    }

    /// Whether `sum_j g_j x_j` is determined by the equations rather than by the least norm:
    /// whether the part of `g` (scaled by the weights) outside the span of the rows is below
    /// `tolerance`, relative to the size of `g`. `gradient` gives `g_j` and its size without
    /// cancellation, so that a `g` that is zero except for rounding (a force whose line meets the
    /// joint's axis) counts as determined.
    pub(super) fn determines(
        &self,
        gradient: impl Fn(usize) -> (f64, f64),
        tolerance: f64,
    ) -> bool {
        let scaled = |j: usize, weight: f64| gradient(j).0 * weight;
        let columns = || self.columns.iter().zip(&self.weights).enumerate();
        let along = columns().fold(Vector6::zeros(), |sum, (j, (column, &weight))| {
            sum + column * scaled(j, weight)
        });
        let inside = along.component_mul(&self.inverse_squares);
        let (mut total, mut outside) = (0.0, 0.0);
        for (j, (column, &weight)) in columns() {
            let g = scaled(j, weight);
            total += (gradient(j).1 * weight).powi(2);
            outside += (g - column.dot(&inside)).powi(2);
        }
        outside <= tolerance * tolerance * total
    }

    /// The rows `p = q_i^T L^-1` to which no unknown contributes, `p A = 0`. There are six minus
    /// the rank of them, orthonormal in the metric of the covariance: `p C p'^T = 1 or 0`.
    pub fn complement(&self) -> impl Iterator<Item = Vector6<f64>> {
        let free = self.dual.column_iter().zip(&self.inverse_squares);
        free.filter(|(_, inverse)| **inverse == 0.0)
            .map(|(row, _)| row.into_owned())
    }

    /// `P = L^-T (1 - Q_r Q_r^T) L^-1`: the weight of the part of `b` that no unknown explains.
    /// `b^T P b` is its chi-square. It is zero where the rank is 6.
    pub fn unexplained(&self) -> Matrix6<f64> {
        self.complement()
            .fold(Matrix6::zeros(), |sum, row| sum + row * row.transpose())
    }
}

/// The weighting of six equations [torque; force] with this noise covariance: its lower Cholesky
/// factor. The factorisation can fail by rounding where the noise of channels of one sensor differs
/// by a factor of 1e8; then only the variances are used.
pub fn noise_factor(covariance: Matrix6<f64>) -> Matrix6<f64> {
    let variances = || Matrix6::from_diagonal(&covariance.diagonal().map(f64::sqrt));
    covariance
        .cholesky()
        .map_or_else(variances, nalgebra::Cholesky::unpack)
}

/// The weighting where the noise is unknown: torques are compared with forces by a length [m].
pub(crate) fn scale_factor(length: f64) -> Matrix6<f64> {
    Matrix6::from_diagonal(&Vector6::new(length, length, length, 1.0, 1.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use proptest::prelude::*;

    fn build(columns: &[[f64; 6]], weights: &[f64], lower: &Matrix6<f64>) -> LeastSquares {
        let mut solver = LeastSquares::with_capacity(columns.len());
        for (column, weight) in columns.iter().zip(weights) {
            solver.push(Vector6::from(*column), *weight);
        }
        solver.factorise(lower);
        solver
    }

    fn lower() -> impl Strategy<Value = Matrix6<f64>> {
        prop::collection::vec(-1.0..1.0_f64, 36)
            .prop_map(|v| Matrix6::from_iterator(v).lower_triangle() + Matrix6::identity() * 1.5)
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        /// The four Penrose conditions, which only the pseudo-inverse meets, for any shape and
        /// rank. (nalgebra's dense singular value decomposition is no oracle here: 0.35.0 gives
        /// wrong vectors for some matrices of rank 3.)
        #[test]
        fn is_the_weighted_pseudo_inverse(
            columns in prop::collection::vec(prop::array::uniform6(-1.0..1.0_f64), 1..14),
            repeated in any::<bool>(),
            weights in prop::collection::vec(0.1..2.0_f64, 14),
            b in prop::array::uniform6(-5.0..5.0_f64),
            lower in lower(),
        ) {
            let mut columns = columns;
            if repeated {
                // Rank-deficient: every column but the first three repeats one of them.
                for j in 3..columns.len() {
                    columns[j] = columns[j % 3].map(|x| 0.5 * x);
                }
            }
            let n = columns.len();
            let whiten = lower.try_inverse().expect("invertible");
            let m = DMatrix::from_fn(6, n, |i, j| {
                (whiten * Vector6::from(columns[j]))[i] * weights[j]
            });
            let solver = build(&columns, &weights, &lower);
            let inverse = DMatrix::from_fn(n, 6, |j, i| {
                (lower.transpose() * solver.gain(j))[i] / weights[j]
            });
            // Rounding is magnified by the conditions of the equations and of their weighting.
            let condition = m.norm() * inverse.norm() * lower.norm() * whiten.norm();
            let scale = 1.0 + m.norm().max(inverse.norm());
            let tolerance = 1e-14 * condition * scale;
            let near = |a: &DMatrix<f64>, b: &DMatrix<f64>| (a - b).amax() < tolerance;
            prop_assert!(near(&(&m * &inverse * &m), &m));
            prop_assert!(near(&(&inverse * &m * &inverse), &inverse));
            prop_assert!(near(&(&m * &inverse), &(&m * &inverse).transpose()));
            prop_assert!(near(&(&inverse * &m), &(&inverse * &m).transpose()));
            // The projectors' trace is the rank, and what they leave is the residual.
            prop_assert!(((&m * &inverse).trace() - solver.rank() as f64).abs() < tolerance);
            let white = DVector::from_column_slice((whiten * Vector6::from(b)).as_slice());
            let residual = &white - &m * &inverse * &white;
            let chi_square = (solver.unexplained() * Vector6::from(b)).dot(&Vector6::from(b));
            prop_assert!(
                (chi_square - residual.norm_squared()).abs()
                    < tolerance * (1.0 + white.norm_squared())
            );
            // An unknown is determined exactly if the projector onto the rows has a one there.
            let rows = &inverse * &m;
            for j in 0..n {
                let determined =
                    solver.determines(|k| if k == j { (1.0, 1.0) } else { (0.0, 0.0) }, 1e-5);
                let beyond = rows[(j, j)] - (1.0 - 1e-10);
                prop_assert!(determined == (beyond > 0.0) || beyond.abs() < tolerance);
            }
        }
    }

    #[test]
    fn no_unknown_and_zero_columns_are_no_trouble() {
        let empty = build(&[], &[], &Matrix6::identity());
        assert_eq!(empty.rank(), 0);
        assert_eq!(empty.unexplained(), Matrix6::identity());
        let zero = build(&[[0.0; 6], [0.0; 6]], &[1.0, 1.0], &Matrix6::identity());
        assert_eq!(zero.rank(), 0);
        assert_eq!(zero.gain(1), Vector6::zeros());
        assert!(!zero.determines(|_| (1.0, 1.0), 1e-9));
    }
}
