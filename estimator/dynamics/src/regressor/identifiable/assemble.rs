//! Assembles an orthonormal basis of the whole identifiable subspace and its null vectors from the
//! unobservable directions of each joint.
//!
//! The unknowns are *composites*: `theta_j` is the inertia of all bodies beyond joint `j`, frozen
//! at the reference position, in the frame of its outer body. They are equivalent to the parameters
//! of the links (`phi_p = theta_p - sum of theta_c, moved to p`), and the rows of each joint
//! involve its own composite only. So the null space is a direct sum of pairs: `+theta` on the
//! outer body of a joint, `-theta` moved to the inner body. Its complement is built from the leaves
//! to the top. At each body ten directions are still open. The `n` null pairs of the joint towards
//! the top involve `n` of them; the others are final.

use nalgebra::{DMatrix, Matrix6, SMatrix, SymmetricEigen};

use super::pass::{Units, wrench_transform};
use super::reach::{Subspace, coefficients, span_more};
use crate::spatial::{Pose, RigidInertia};

pub(super) type Matrix10 = SMatrix<f64, 10, 10>;

/// Entries below this, relative to one, are rounding errors.
const ROUNDING: f64 = 1e-13;

/// The unobservable and observable parts, for the rows of one joint or of the top, of its composite
/// `theta` and the offsets `O` beyond it; SI units, [torque; force].
#[derive(Clone, Debug)]
pub(super) struct Hidden {
    /// Basis of the unobservable transfers, for any `O` that hides them, 10 x n: reduced to the
    /// identity in the rows `pivots`.
    pub(super) transfers: DMatrix<f64>,
    pub(super) pivots: Vec<usize>,
    /// With `theta = hiding * O` every row that involves `theta` vanishes.
    hiding: SMatrix<f64, 10, 6>,
    /// Independent rows on `O` alone.
    offsets: Vec<[f64; 6]>,
}

impl Hidden {
    pub(super) fn new(rows: &Subspace<16>, units: &Units, tolerance: f64) -> Self {
        let mut rest: Vec<[f64; 16]> = rows.basis().iter().map(coefficients).collect();
        // The span of the parameter part, carrying the offset part along.
        let mut kept = Vec::new();
        span_more(&mut kept, &mut rest, 10, tolerance);
        let offsets = rest
            .iter()
            .map(|row| std::array::from_fn(|i| clean(row[10 + i]) * units.offset(i)))
            .collect();

        let rank = kept.len();
        let inertial = DMatrix::from_fn(10, rank, |i, k| kept[k][i] * units.parameter(i));
        let (q, r) = householder(inertial);
        let (transfers, pivots) = reduced(&q.columns(rank, 10 - rank).into_owned());
        // The theta of least norm with inertial^T theta = -offset part.
        let mut hiding = SMatrix::zeros();
        for component in 0..6 {
            let mut y: Vec<f64> = kept
                .iter()
                .map(|row| -clean(row[10 + component]) * units.offset(component))
                .collect();
            for i in 0..rank {
                let known: f64 = (0..i).map(|k| r[(k, i)] * y[k]).sum();
                y[i] = (y[i] - known) / r[(i, i)];
            }
            for i in 0..10 {
                hiding[(i, component)] = (0..rank).map(|k| q[(i, k)] * y[k]).sum();
            }
        }
        Self {
            transfers,
            pivots,
            hiding,
            offsets,
        }
    }
}

/// One body of a separately measured part of the robot.
#[derive(Clone, Debug)]
pub(super) struct Composite {
    /// Index of its block of ten columns: 0 for the first ten.
    pub(super) block: usize,
    /// Its inner member in the same part, and its pose in that member at the reference position;
    /// `None` for a top.
    pub(super) inner: Option<(usize, Pose)>,
    pub(super) hidden: Hidden,
    /// Offsets of sensors on this body: index of the six columns, and the 6 x 6 matrix that takes
    /// them to wrenches in its frame.
    pub(super) offsets: Vec<(usize, Matrix6<f64>)>,
}

/// Result of `assemble`.
#[derive(Clone, Debug)]
pub(super) struct Assembled {
    /// Orthonormal columns.
    pub(super) basis: DMatrix<f64>,
    /// Sparse null vectors, each with its pivot: an entry 1 in a column that is zero in all earlier
    /// null vectors.
    pub(super) null: Vec<NullVector>,
    /// Number of directions lost to the offsets.
    pub(super) confused: usize,
}

/// A null vector: columns and entries, ascending; `pivot` is the column where its entry is 1.
#[derive(Clone, Debug)]
pub(super) struct NullVector {
    pub(super) pivot: usize,
    pub(super) entries: Vec<(usize, f64)>,
}

/// Assembles the members of all parts, each after its inner member and depth first, over
/// `10 * members.len() + 6 * sensors` columns.
pub(super) fn assemble(
    members: &[Composite],
    sensors: usize,
    units: &Units,
    tolerance: f64,
) -> Assembled {
    let inertial = 10 * members.len();
    let moved: Vec<Option<Matrix10>> = members
        .iter()
        .map(|member| member.inner.map(|(_, pose)| parameter_transform(&pose)))
        .collect();
    let mut null = null_pairs(members, &moved);
    let rank = inertial - null.len();
    let alone = complement(members, &moved, rank);
    if sensors == 0 {
        return Assembled {
            basis: alone,
            null,
            confused: 0,
        };
    }

    let count = 6 * sensors;
    let (hiding, visible) = offset_maps(members, &moved, count);
    // Rows on offsets alone, compared in scaled units; then made orthonormal in SI units.
    let factors: Vec<f64> = (0..count).map(|i| units.offset(i % 6)).collect();
    let found = independent_rows(visible, &factors, tolerance);
    let separate = found.len();
    let (q, _) = householder(DMatrix::from_fn(count, separate, |i, k| found[k][i]));
    let seen = q.columns(0, separate).into_owned();
    let unseen = q.columns(separate, count - separate).into_owned();
    let (unseen, pivots) = reduced(&unseen);
    for (k, &pivot) in pivots.iter().enumerate() {
        let hidden = &hiding * unseen.column(k);
        let parameters = hidden.iter().copied().enumerate();
        let offsets = unseen.column(k);
        let offsets = offsets.iter().enumerate().map(|(i, &x)| (inertial + i, x));
        null.push(NullVector {
            pivot: inertial + pivot,
            entries: parameters
                .chain(offsets)
                .filter(|(_, x)| clean(*x) != 0.0)
                .collect(),
        });
    }

    let mut basis = DMatrix::zeros(inertial + count, rank + separate);
    let (parameters, offsets) = joined(alone, &hiding, &seen);
    basis
        .view_mut((0, 0), (inertial, rank))
        .copy_from(&parameters);
    basis
        .view_mut((inertial, 0), (count, rank))
        .copy_from(&offsets);
    basis
        .view_mut((inertial, rank), (count, separate))
        .copy_from(&seen);
    Assembled {
        basis,
        null,
        confused: count - separate,
    }
}

/// Orthonormal rows [A | C] over parameters and offsets, each as columns, from orthonormal rows
/// `alone` over parameters: C follows from the null vectors (hiding o, o). The rows `seen` on
/// offsets alone are subtracted, then the rows are made orthonormal: (1 + C C^T)^-1/2 = 1 + C
/// g(C^T C) C^T with g(l) = -1 / (s (s + 1)), s = sqrt(1 + l).
fn joined(
    alone: DMatrix<f64>,
    hiding: &DMatrix<f64>,
    seen: &DMatrix<f64>,
) -> (DMatrix<f64>, DMatrix<f64>) {
    let mut carried = -alone.tr_mul(hiding);
    let known = &carried * seen;
    carried -= known * seen.transpose();
    if carried.iter().all(|x| clean(*x) == 0.0) {
        let offsets = DMatrix::zeros(carried.ncols(), carried.nrows());
        return (alone, offsets);
    }
    let gram = carried.tr_mul(&carried);
    let SymmetricEigen {
        eigenvectors,
        eigenvalues,
    } = SymmetricEigen::new(gram.clone());
    let g = eigenvalues.map(|value| {
        let s = (1.0 + value.max(0.0)).sqrt();
        -1.0 / (s * (s + 1.0))
    });
    let g = &eigenvectors * DMatrix::from_diagonal(&g) * eigenvectors.transpose();
    let factor = g * carried.transpose();
    let parameters = &alone + (&alone * &carried) * &factor;
    let offsets = carried.transpose() + gram * factor;
    (parameters, offsets)
}

/// The pairs: a transfer on the outer body, its opposite on the inner.
fn null_pairs(members: &[Composite], moved: &[Option<Matrix10>]) -> Vec<NullVector> {
    let mut null = Vec::new();
    for (member, moved) in members.iter().zip(moved) {
        for (k, &pivot) in member.hidden.pivots.iter().enumerate() {
            let theta = member.hidden.transfers.column(k);
            let mut entries: Vec<_> = theta
                .iter()
                .enumerate()
                .map(|(i, &x)| (10 * member.block + i, x))
                .collect();
            if let (Some((inner, _)), Some(moved)) = (member.inner, moved) {
                let opposite = -(moved * theta);
                let first = 10 * members[inner].block;
                entries.extend(opposite.iter().enumerate().map(|(i, &x)| (first + i, x)));
            }
            entries.retain(|(_, x)| clean(*x) != 0.0);
            entries.sort_unstable_by_key(|&(column, _)| column);
            null.push(NullVector {
                pivot: 10 * member.block + pivot,
                entries,
            });
        }
    }
    null
}

/// What a body passes to its inner body.
struct OpenDirections {
    /// End of the range of members from this one on that are this one or beyond it.
    end: usize,
    /// Directions that its joint's null pairs involve, over ten entries per member beyond: 10
    /// (end - member) x n.
    directions: DMatrix<f64>,
    /// The null pairs in these directions, n x n.
    pairs: DMatrix<f64>,
}

/// How the null pairs of a joint turn the ten directions of its inner body that are open.
struct JointTurn {
    own: DMatrix<f64>,
    /// What comes from the directions that the outer body passed up.
    handed: DMatrix<f64>,
}

/// Orthonormal basis of the complement of all null pairs, `10 * members.len()` x `rank`.
fn complement(members: &[Composite], moved: &[Option<Matrix10>], rank: usize) -> DMatrix<f64> {
    let mut basis = DMatrix::zeros(10 * members.len(), rank);
    let mut done = 0;
    let mut open: Vec<Option<OpenDirections>> = members.iter().map(|_| None).collect();
    let mut outer: Vec<Vec<usize>> = vec![Vec::new(); members.len()];
    for (number, member) in members.iter().enumerate() {
        if let Some((inner, _)) = member.inner {
            outer[inner].push(number);
        }
    }
    for (number, member) in members.iter().enumerate().rev() {
        let beyond: Vec<(usize, OpenDirections)> = outer[number]
            .iter()
            .filter_map(|&child| open[child].take().map(|open| (child, open)))
            .collect();
        let (mut own, turns) = take_pairs(members, moved, &beyond);
        // The null pairs of the joint towards the top, or the unobservable directions of the top,
        // among the ten directions still open.
        let n = member.hidden.pivots.len();
        let (mut turned, involved) = householder(own.tr_mul(&member.hidden.transfers));
        own *= &turned;
        let end = beyond
            .iter()
            .map(|(_, open)| open.end)
            .max()
            .unwrap_or(number + 1);
        let finished = 10 - n;
        let mut directions = DMatrix::zeros(10 * (end - number), n);
        directions.rows_mut(0, 10).copy_from(&own.columns(0, n));
        // The others are final.
        let mut out = basis.columns_mut(done, finished);
        out.rows_mut(10 * member.block, 10)
            .copy_from(&own.columns(n, finished));
        // The directions passed up by each joint are rotated with all joints after it.
        for ((child, open), turn) in beyond.iter().zip(&turns).rev() {
            let part = &open.directions * (&turn.handed * &turned);
            turned = &turn.own * turned;
            directions
                .rows_mut(10 * (child - number), part.nrows())
                .copy_from(&part.columns(0, n));
            for (row, member) in members[*child..open.end].iter().enumerate() {
                out.rows_mut(10 * member.block, 10)
                    .copy_from(&part.view((10 * row, n), (10, finished)));
            }
        }
        done += finished;
        if member.inner.is_some() {
            open[number] = Some(OpenDirections {
                end,
                directions,
                pairs: involved,
            });
        }
    }
    basis
}

/// Ten directions of a body stay open throughout, at first its parameters. The joints beyond are
/// processed one by one: the null pairs of a joint, in these ten and in the directions passed up,
/// remove as many directions as were passed up. (One matrix for all joints would cost the third
/// power of their number.) Returns them over the body's parameters, and the turn by each joint.
fn take_pairs(
    members: &[Composite],
    moved: &[Option<Matrix10>],
    beyond: &[(usize, OpenDirections)],
) -> (DMatrix<f64>, Vec<JointTurn>) {
    let mut own = DMatrix::identity(10, 10);
    let mut turns = Vec::with_capacity(beyond.len());
    for (child, open) in beyond {
        let n = open.pairs.ncols();
        let mut local = DMatrix::zeros(10 + n, n);
        if let Some(moved) = &moved[*child] {
            let opposite = -(own.tr_mul(moved) * &members[*child].hidden.transfers);
            local.rows_mut(0, 10).copy_from(&opposite);
        }
        local.rows_mut(10, n).copy_from(&open.pairs);
        let (q, _) = householder(local);
        let turn = q.view((0, n), (10, 10)).into_owned();
        own *= &turn;
        turns.push(JointTurn {
            own: turn,
            handed: q.view((10, n), (n, 10)).into_owned(),
        });
    }
    (own, turns)
}

/// Per column of an offset, the parameters that hide it; and per row on offsets alone, its entries.
fn offset_maps(
    members: &[Composite],
    moved: &[Option<Matrix10>],
    count: usize,
) -> (DMatrix<f64>, Vec<Vec<f64>>) {
    let mut hiding = DMatrix::zeros(10 * members.len(), count);
    let mut rows = Vec::new();
    // The offsets of the sensors at or beyond each member, as a wrench in its frame.
    let mut beyond: Vec<Option<DMatrix<f64>>> = vec![None; members.len()];
    for (number, member) in members.iter().enumerate().rev() {
        for (sensor, carry) in &member.offsets {
            let sum = beyond[number].get_or_insert_with(|| DMatrix::zeros(6, count));
            let mut columns = sum.columns_mut(6 * sensor, 6);
            columns += carry;
        }
        let Some(sum) = beyond[number].take() else {
            continue;
        };
        for row in &member.hidden.offsets {
            rows.push(
                (0..count)
                    .map(|k| (0..6).map(|i| row[i] * sum[(i, k)]).sum())
                    .collect(),
            );
        }
        let theta = member.hidden.hiding * &sum;
        let mut rows = hiding.rows_mut(10 * member.block, 10);
        rows += &theta;
        if let (Some((inner, pose)), Some(moved)) = (member.inner, &moved[number]) {
            let mut others = hiding.rows_mut(10 * members[inner].block, 10);
            others -= moved * theta;
            let at_inner = beyond[inner].get_or_insert_with(|| DMatrix::zeros(6, count));
            *at_inner += wrench_transform(&pose) * sum;
        }
    }
    (hiding, rows)
}

/// An independent subset with the same span. The remainder of a row after projection counts if its
/// norm, with entries multiplied by 1 / `units`, exceeds `tolerance`.
fn independent_rows(mut rows: Vec<Vec<f64>>, units: &[f64], tolerance: f64) -> Vec<Vec<f64>> {
    for row in &mut rows {
        row.iter_mut().zip(units).for_each(|(x, unit)| *x /= unit);
    }
    let mut kept = Vec::new();
    span_more(&mut kept, &mut rows, units.len(), tolerance);
    for row in &mut kept {
        row.iter_mut().zip(units).for_each(|(x, unit)| *x *= unit);
    }
    kept
}

fn clean(x: f64) -> f64 {
    if x.abs() < ROUNDING { 0.0 } else { x }
}

/// The matrix that takes the ten parameters of a body in `b` to those in `a`, given `x_ab`.
fn parameter_transform(x_ab: &Pose) -> Matrix10 {
    let mut matrix = Matrix10::zeros();
    for k in 0..10 {
        let mut unit = [0.0; 10];
        unit[k] = 1.0;
        let column = RigidInertia::from_parameters(&unit)
            .transformed(x_ab)
            .parameters();
        matrix.set_column(k, &column.into());
    }
    matrix
}

/// Columns of the same span that are the identity in some rows, and these rows. The other entries
/// stay small, because each step takes the row with the largest remainder, the first of equals.
fn reduced(columns: &DMatrix<f64>) -> (DMatrix<f64>, Vec<usize>) {
    let count = columns.ncols();
    let mut rest = columns.clone();
    let mut pivots = Vec::with_capacity(count);
    for _ in 0..count {
        let norms: Vec<f64> = rest.row_iter().map(|row| row.norm_squared()).collect();
        let most = norms.iter().copied().fold(0.0, f64::max);
        let pivot = norms
            .iter()
            .position(|&norm| norm >= most * (1.0 - 1e-6))
            .unwrap_or(0);
        pivots.push(pivot);
        let unit = rest.row(pivot) / norms[pivot].sqrt();
        for _ in 0..2 {
            let along = &rest * unit.transpose();
            rest -= along * &unit;
        }
        rest.row_mut(pivot).fill(0.0);
    }
    pivots.sort_unstable();
    // Gauss-Jordan on the columns; these rows make it well-conditioned.
    let mut out = columns.clone();
    for (k, &pivot) in pivots.iter().enumerate() {
        let most =
            (k..count).max_by(|&a, &b| out[(pivot, a)].abs().total_cmp(&out[(pivot, b)].abs()));
        out.swap_columns(k, most.unwrap_or(k));
        let unit = out.column(k) / out[(pivot, k)];
        let mut along = out.row(pivot).into_owned();
        along[k] = 0.0;
        out.ger(-1.0, &unit, &along.transpose(), 1.0);
        out.set_column(k, &unit);
        out.row_mut(pivot).fill(0.0);
        out[(pivot, k)] = 1.0;
    }
    out.iter_mut().for_each(|x| *x = clean(*x));
    (out, pivots)
}

/// Householder QR of a matrix with at least as many rows as columns: all of `Q`, square, and the
/// square `R`.
fn householder(mut a: DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
    let (m, n) = a.shape();
    let mut q = DMatrix::identity(m, m);
    for k in 0..n {
        let mut v = a.view((k, k), (m - k, 1)).into_owned();
        let norm = v.norm();
        if norm == 0.0 {
            continue;
        }
        v[0] += norm.copysign(v[0]);
        let norm = v.norm();
        v /= norm;
        let mut part = a.view_mut((k, k), (m - k, n - k));
        let along = part.tr_mul(&v);
        part.gemm(-2.0, &v, &along.transpose(), 1.0);
        let mut part = q.columns_mut(k, m - k);
        let along = &part * &v;
        part.gemm(-2.0, &along, &v.transpose(), 1.0);
    }
    let r = a.rows(0, n).into_owned();
    (q, r)
}
