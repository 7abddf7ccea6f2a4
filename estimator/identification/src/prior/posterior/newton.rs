//! Newton steps on pseudo-inertias: charts, curvature, descent.

use crate::linear::{blocked, simd};
use crate::prior::unpack;
use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, DVector, Dyn, Matrix4};
use pulp::{Arch, Simd, WithSimd};

/// A chart is rebuilt if an eigenvalue of a body, relative to the chart's own body, leaves `1 /
/// STRETCH .. STRETCH`.
pub(crate) const STRETCH: f64 = 1e3;

/// The state of a descent.
pub(crate) struct Iterate {
    pub(crate) chart: Chart,
    pub(crate) y: DVector<f64>,
    /// The last weight for which this was approximately the minimum: infinite for CAD, None for a
    /// guess.
    pub(crate) centred: Option<f64>,
}

/// A Newton step, and the change of the cost along it.
pub(crate) struct Newton {
    pub(crate) step: DVector<f64>,
    /// Squared length of the step in the Hessian's norm: twice the decrease of a quadratic cost.
    pub(crate) decrement: f64,
    /// The possible rounding error of the decrement.
    pub(crate) rounding: f64,
    /// Eigenvalues of the links' change relative to their bodies, and the least of them. At -1 a
    /// body ceases to be physical.
    pub(crate) values: Vec<f64>,
    pub(crate) least: f64,
    /// Coefficients of the cost's change.
    pub(crate) linear: f64,
    pub(crate) square: f64,
    /// Factor of the Hessian by `y`.
    pub(crate) factor: Cholesky<f64, Dyn>,
    /// Square root of the prior's part of the Hessian, a row for each of `u`.
    pub(crate) prior_rows: DMatrix<f64>,
}

impl Newton {
    /// The fraction of the step to take; None if the cost does not fall any more, to rounding.
    pub(crate) fn length(&self, weight: f64) -> Option<f64> {
        // The change of the cost is computed directly, since the difference of two large costs
        // would not be exact.
        let change = |t: f64| {
            let logs: f64 = self.values.iter().map(|value| (t * value).ln_1p()).sum();
            t * self.linear + 0.5 * t * t * self.square - weight * logs
        };
        let most = if self.least < 0.0 {
            -0.9 / self.least
        } else {
            1.0
        };
        let lengths = std::iter::successors(Some(most.min(1.0)), |t| Some(0.5 * t));
        lengths
            .take(40)
            .find(|&t| change(t) <= -1e-4 * t * self.decrement)
    }
}

/// The result of a descent.
pub(crate) struct Descent {
    /// The next step, which is not taken.
    pub(crate) next: Newton,
    pub(crate) iterations: usize,
    pub(crate) is_converged: bool,
}

/// Coordinates `u` about some bodies, and `y = T u`, in which the data are diagonal.
#[derive(Clone, Debug)]
pub(crate) struct Chart {
    /// The bodies relative to CAD, `1 + U = L L^T`; these are the `L`.
    pub(crate) stretch: Vec<Matrix4<f64>>,
    /// `L^T L`, the gradient of the trace of `L (1 + u) L^T`.
    pub(crate) gram: Vec<Matrix4<f64>>,
    /// The extra parameters at `u = 0`, in their units.
    pub(crate) extra: DVector<f64>,
    /// Diagonal of the data by `y`.
    pub(crate) scale: DVector<f64>,
    /// Its right side.
    pub(crate) right: DVector<f64>,
    /// Square sum of the right side beyond it.
    pub(crate) residual_square: f64,
    /// `u -> y`.
    pub(crate) t: DMatrix<f64>,
    /// `y -> u`, and transposed.
    pub(crate) v: DMatrix<f64>,
    pub(crate) v_transposed: DMatrix<f64>,
}

impl Chart {
    /// From data by `u`. Diagonal entries up to `least` times the largest count as zero.
    pub(crate) fn new(
        data: DMatrix<f64>,
        right: DVector<f64>,
        stretch: Vec<Matrix4<f64>>,
        extra: DVector<f64>,
        least: f64,
    ) -> Self {
        let count = data.ncols();
        let graded = Graded::new(data, right, least);
        let inverse = graded.inverse();
        let mut v = DMatrix::zeros(count, count);
        let mut t = DMatrix::zeros(count, count);
        for (row, &column) in graded.order.iter().enumerate() {
            for other in 0..count {
                v[(column, other)] = inverse[(row, other)];
                t[(other, column)] = graded.t[(other, row)];
            }
        }
        Self {
            gram: stretch.iter().map(|l| l.transpose() * l).collect(),
            v_transposed: v.transpose(),
            residual_square: graded.residual_square,
            scale: graded.scale,
            right: graded.right,
            stretch,
            extra,
            t,
            v,
        }
    }

    /// Excess of `|R x - z|^2` over its minimum.
    pub(crate) fn excess(&self, y: &DVector<f64>) -> f64 {
        (self.scale.component_mul(y) - &self.right).norm_squared() + self.residual_square
    }

    pub(crate) fn coordinates(&self, y: &DVector<f64>) -> DVector<f64> {
        &self.v * y
    }

    /// The extra parameters, in their units.
    pub(crate) fn extra(&self, u: &DVector<f64>) -> DVector<f64> {
        &self.extra + u.rows(10 * self.stretch.len(), self.extra.len())
    }

    /// Whether a body is too far from that of the chart, relative to it.
    pub(crate) fn is_strained(&self, u: &DVector<f64>) -> bool {
        (0..self.stretch.len()).any(|link| {
            let values = (Matrix4::identity() + block(u, link)).symmetric_eigenvalues();
            values.min() < 1.0 / STRETCH || values.max() > STRETCH
        })
    }
}

/// `U` of a link.
pub(crate) fn block(u: &DVector<f64>, link: usize) -> Matrix4<f64> {
    unpack(&u.fixed_rows::<10>(10 * link).into_owned())
}

/// A column-pivoted QR factorisation of data, `R = Q diag(scale) T`, with the columns of `T` in the
/// order of the pivots.
pub(crate) struct Graded {
    pub(crate) order: Vec<usize>,
    pub(crate) scale: DVector<f64>,
    pub(crate) right: DVector<f64>,
    pub(crate) t: DMatrix<f64>,
    pub(crate) residual_square: f64,
}

impl Graded {
    /// By Householder reflections, until the rest is at most `least` times the first column.
    pub(crate) fn new(mut data: DMatrix<f64>, mut right: DVector<f64>, least: f64) -> Self {
        let (rows, count) = data.shape();
        let mut order: Vec<usize> = (0..count).collect();
        let mut scale = DVector::zeros(count);
        let mut rank = 0;
        let mut reflector = vec![0.0; rows];
        // Square norms of the rest of each column.
        let mut squares: Vec<f64> = data
            .column_iter()
            .map(|column| column.norm_squared())
            .collect();
        for step in 0..rows.min(count) {
            let (pivot, square) = (step..count).fold((step, -1.0), |best, column| {
                let square = squares[column];
                if square > best.1 {
                    (column, square)
                } else {
                    best
                }
            });
            let length = square.sqrt();
            if length <= least * scale[0] {
                break;
            }
            rank = step + 1;
            data.swap_columns(step, pivot);
            order.swap(step, pivot);
            squares.swap(step, pivot);
            let (head, tail) = data.as_mut_slice().split_at_mut((step + 1) * rows);
            let column = &mut head[step * rows + step..];
            let sign = if column[0] < 0.0 { -1.0 } else { 1.0 };
            let reflector = &mut reflector[step..];
            reflector.copy_from_slice(column);
            reflector[0] += sign * length;
            Arch::new().dispatch(PivotedReflection {
                reflector,
                per_half: 1.0 / (length * (length + sign * column[0])),
                columns: tail,
                rows,
                squares: &mut squares[step + 1..],
                right: &mut right.as_mut_slice()[step..],
            });
            column[0] = -sign * length;
            column[1..].fill(0.0);
            scale[step] = length;
        }
        let mut t = DMatrix::identity(count, count);
        let mut graded = DVector::zeros(count);
        for row in 0..rank {
            let diagonal = data[(row, row)];
            for column in row..count {
                t[(row, column)] = data[(row, column)] / diagonal;
            }
            graded[row] = right[row] * diagonal.signum();
        }
        Self {
            order,
            residual_square: right.rows_range(rank..).norm_squared(),
            right: graded,
            scale,
            t,
        }
    }

    /// `T^-1`, upper triangular.
    pub(crate) fn inverse(&self) -> DMatrix<f64> {
        blocked::inverse(&self.t.transpose()).transpose()
    }
}

/// Reflects the rows from the pivot's on, in the columns after it and in the right side, and
/// updates the square norms of the rows below.
pub(crate) struct PivotedReflection<'a> {
    pub(crate) reflector: &'a [f64],
    /// Two over the reflector's square norm.
    pub(crate) per_half: f64,
    pub(crate) columns: &'a mut [f64],
    pub(crate) rows: usize,
    pub(crate) squares: &'a mut [f64],
    pub(crate) right: &'a mut [f64],
}

impl WithSimd for PivotedReflection<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Some((first, below)) = self.reflector.split_first() else {
            return;
        };
        let step = self.rows - self.reflector.len();
        for (column, square) in self.columns.chunks_exact_mut(self.rows).zip(self.squares) {
            if let Some((own_first, own)) = column[step..].split_first_mut() {
                let factor = -self.per_half * (first * *own_first + simd::inner(simd, below, own));
                *own_first += factor * first;
                *square = simd::add_and_square(simd, own, factor, below);
            }
        }
        let factor = -self.per_half * simd::inner(simd, self.reflector, self.right);
        simd::add(simd, self.right, factor, self.reflector);
    }
}
