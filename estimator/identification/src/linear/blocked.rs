//! Factorisations of matrices with some hundred rows by products of blocks: nalgebra's matrix
//! products are several times as fast as its loops over columns.
//!
//! Every block is an owned copy, since products with strided views give wrong results.

use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, Dyn};

/// Size of a block. Smaller blocks make products slow; larger blocks leave more to loops.
const BLOCK: usize = 48;

/// First rows of the blocks, and their lengths.
fn blocks(count: usize) -> impl DoubleEndedIterator<Item = (usize, usize)> {
    (0..count.div_ceil(BLOCK))
        .map(move |number| (number * BLOCK, BLOCK.min(count - number * BLOCK)))
}

/// A copy of `rows` by `columns` numbers from `(row, column)` on. (The copy of a view proceeds
/// number by number.)
fn copied(
    from: &DMatrix<f64>,
    (row, column): (usize, usize),
    (rows, columns): (usize, usize),
) -> DMatrix<f64> {
    let mut to = DMatrix::zeros(rows, columns);
    let height = from.nrows();
    let sources = from.as_slice().chunks_exact(height.max(1)).skip(column);
    for (to, from) in to.as_mut_slice().chunks_exact_mut(rows.max(1)).zip(sources) {
        to.copy_from_slice(&from[row..row + rows]);
    }
    to
}

/// Writes a block at its place.
fn put(to: &mut DMatrix<f64>, (row, column): (usize, usize), block: &DMatrix<f64>) {
    let (rows, height) = (block.nrows(), to.nrows());
    let targets = to.as_mut_slice().chunks_exact_mut(height.max(1));
    let targets = targets.skip(column);
    for (from, to) in block.as_slice().chunks_exact(rows.max(1)).zip(targets) {
        to[row..row + rows].copy_from_slice(from);
    }
}

/// The lower triangle of `A^T A`. Above the diagonal blocks the result is zero.
pub(crate) fn gram(a: &DMatrix<f64>) -> DMatrix<f64> {
    let count = a.ncols();
    let transposed = a.transpose();
    let mut gram = DMatrix::zeros(count, count);
    for (first, length) in blocks(count) {
        let left = copied(&transposed, (first, 0), (count - first, a.nrows()));
        let product = left * copied(a, (0, first), (a.nrows(), length));
        put(&mut gram, (first, first), &product);
    }
    gram
}

/// The Cholesky factorisation of a positive definite matrix, of which the lower triangle is used.
/// None if it is not positive definite to rounding.
pub(crate) fn cholesky(mut matrix: DMatrix<f64>) -> Option<Cholesky<f64, Dyn>> {
    let count = matrix.nrows();
    for (first, length) in blocks(count) {
        let diagonal = Cholesky::new(copied(&matrix, (first, first), (length, length)))?.unpack();
        put(&mut matrix, (first, first), &diagonal);
        let (next, below) = (first + length, count - first - length);
        if below == 0 {
            break;
        }
        let inverse = diagonal.solve_lower_triangular(&DMatrix::identity(length, length))?;
        let panel = copied(&matrix, (next, first), (below, length)) * inverse.transpose();
        put(&mut matrix, (next, first), &panel);
        let transposed = panel.transpose();
        for (start, width) in blocks(below) {
            let left = copied(&panel, (start, 0), (below - start, length));
            let product = left * copied(&transposed, (0, start), (length, width));
            let mut target = matrix.view_mut((next + start, next + start), (below - start, width));
            target -= product;
        }
    }
    // A factorisation uses the lower triangle and the diagonal only.
    Some(Cholesky::pack_dirty(matrix))
}

/// `L^-1` of a lower triangular matrix without zeros on its diagonal. Numbers above the diagonal
/// are ignored.
pub(crate) fn inverse(l: &DMatrix<f64>) -> DMatrix<f64> {
    let count = l.nrows();
    let mut inverse = DMatrix::zeros(count, count);
    for (first, length) in blocks(count) {
        let diagonal = copied(l, (first, first), (length, length))
            .solve_lower_triangular(&DMatrix::identity(length, length))
            .unwrap_or_else(|| DMatrix::zeros(length, length));
        if first > 0 {
            // [L11 0; L21 L22]^-1 = [L11^-1 0; -L22^-1 L21 L11^-1  L22^-1]
            let left = copied(l, (first, 0), (length, first));
            let product = -(&diagonal * (left * copied(&inverse, (0, 0), (first, first))));
            put(&mut inverse, (first, 0), &product);
        }
        put(&mut inverse, (first, first), &diagonal);
    }
    inverse
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    #[test]
    fn blocks_give_the_result_of_columns() {
        for count in [1, 7, 47, 48, 49, 96, 131, 200] {
            let values = normals(count as u64, (count + 3) * count);
            let a = DMatrix::from_vec(count + 3, count, values);
            let expected = a.transpose() * &a;
            let found = gram(&a);
            let lower = |matrix: &DMatrix<f64>| matrix.lower_triangle();
            let scale = expected.norm();
            assert!(
                (lower(&found) - lower(&expected)).norm() <= 1e-14 * scale,
                "{count}"
            );
            // Numbers above the diagonal are ignored.
            let mut spoilt = found;
            spoilt.fill_upper_triangle(f64::NAN, 1);
            let factor = cholesky(spoilt).unwrap();
            let l = factor.l();
            assert!(
                (&l * l.transpose() - &expected).norm() <= 1e-13 * scale,
                "{count}"
            );
            let mut dirty = factor.l_dirty().clone();
            dirty.fill_upper_triangle(f64::NAN, 1);
            let inverse = inverse(&dirty);
            assert_eq!(inverse, inverse.lower_triangle());
            assert!(
                (inverse * &l - DMatrix::identity(count, count)).norm() <= 1e-10,
                "{count}"
            );
            // Only the last pivot is not positive.
            let mut indefinite = expected;
            indefinite[(count - 1, count - 1)] = -1.0;
            assert!(cholesky(indefinite).is_none());
        }
    }
}
