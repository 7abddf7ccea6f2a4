//! Loops over the rows of the root, in the widest vector instructions of the processor.

use proprio_dynamics::calibration::Unknown;
use proprio_dynamics::regressor::{LINK_PARAMETERS, LinkRows, WITH_FORCE};
use proprio_dynamics::spatial::{Motion, Pose};
use pulp::Simd;
use std::ops::Range;

/// Rows per group: the length of the longest vector register, and a multiple of all shorter ones.
pub(crate) const LANES: usize = 16;

/// One group of rows of a column.
pub(crate) type Lanes = [f32; LANES];

/// The root of a link's covariance, upper triangular.
pub(crate) type Root = [[f64; LINK_PARAMETERS]; LINK_PARAMETERS];

/// A covariance of a wrench [torque; force], symmetric.
pub(crate) type Covariance6 = [[f64; 6]; 6];

/// A motion as six numbers [angular; linear].
pub(crate) fn numbers(motion: &Motion) -> [f64; 6] {
    let (n, v) = (&motion.angular, &motion.linear);
    [n.x, n.y, n.z, v.x, v.y, v.z]
}

#[allow(clippy::cast_possible_truncation, reason = "single precision suffices")]
pub(crate) fn single(value: f64) -> f32 {
    value as f32
}

#[inline(always)]
pub(crate) fn splat<S: Simd>(simd: S, motion: &Motion) -> [S::f32s; 6] {
    let mut all = [simd.splat_f32s(0.0); 6];
    for (to, value) in all.iter_mut().zip(numbers(motion)) {
        *to = simd.splat_f32s(single(value));
    }
    all
}

/// Rows as a whole number of vector registers.
#[inline(always)]
pub(crate) fn vectors<S: Simd>(rows: &[Lanes]) -> &[S::f32s] {
    S::as_simd_f32s(rows.as_flattened()).0
}

#[inline(always)]
pub(crate) fn vectors_mut<S: Simd>(rows: &mut [Lanes]) -> &mut [S::f32s] {
    S::as_mut_simd_f32s(rows.as_flattened_mut()).0
}

/// `a^T C b`.
#[inline(always)]
pub(crate) fn bilinear_form(a: &[f64; 6], covariance: &Covariance6, b: &[f64; 6]) -> f64 {
    let mut product = [0.0; 6];
    for (row, a) in covariance.iter().zip(a) {
        for (sum, value) in product.iter_mut().zip(row) {
            *sum += a * value;
        }
    }
    product.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Adds `A P A^T` of a link, `P = U^T U`.
pub(crate) fn add_independent(out: &mut Covariance6, root: &Root, coefficients: &LinkRows) {
    let columns: [[f64; 6]; LINK_PARAMETERS] =
        std::array::from_fn(|c| std::array::from_fn(|axis| coefficients[axis][c]));
    for (first, row) in root.iter().enumerate() {
        let mut wrench = [0.0; 6];
        for (u, column) in row.iter().zip(&columns).skip(first) {
            for (sum, value) in wrench.iter_mut().zip(column) {
                *sum += u * value;
            }
        }
        for (sums, a) in out.iter_mut().zip(wrench) {
            for (sum, b) in sums.iter_mut().zip(wrench) {
                *sum += a * b;
            }
        }
    }
}

/// Vector register number `i` of `W m`.
#[inline(always)]
pub(crate) fn project<S: Simd>(
    simd: S,
    axes: &[&[S::f32s]; 6],
    i: usize,
    motion: &[S::f32s; 6],
) -> S::f32s {
    let mut sum = simd.splat_f32s(0.0);
    for (axis, m) in axes.iter().zip(motion) {
        sum = simd.mul_add_e_f32s(axis[i], *m, sum);
    }
    sum
}

/// Adds `U_l A_l^T`.
#[inline(always)]
pub(crate) fn add_link<S: Simd>(
    simd: S,
    out: &mut [Lanes],
    rows: usize,
    column_block: &ColumnBlock,
    coefficients: &LinkRows,
) {
    let mut a = [[0.0; 6]; LINK_PARAMETERS];
    for (axis, row) in coefficients.iter().enumerate() {
        for (a, value) in a.iter_mut().zip(row) {
            a[axis] = single(*value);
        }
    }
    let mut out = out.chunks_exact_mut(rows);
    let mut next = || {
        out.next()
            .and_then(|column| column.get_mut(column_block.rows.clone()))
            .unwrap_or_default()
    };
    let [t0, t1, t2, f0, f1, f2] = [next(), next(), next(), next(), next(), next()];
    let torques = vectors_mut::<S>(t0)
        .iter_mut()
        .zip(vectors_mut::<S>(t1))
        .zip(vectors_mut::<S>(t2));
    let forces = vectors_mut::<S>(f0)
        .iter_mut()
        .zip(vectors_mut::<S>(f1))
        .zip(vectors_mut::<S>(f2));
    let columns = vectors::<S>(&column_block.columns);
    let count = columns.len() / LINK_PARAMETERS;
    for (i, (((t0, t1), t2), ((f0, f1), f2))) in torques.zip(forces).enumerate() {
        let (mut torque, mut force) = ([*t0, *t1, *t2], [*f0, *f1, *f2]);
        for (c, a) in a.iter().enumerate() {
            let u = columns[c * count + i];
            for axis in 0..3 {
                torque[axis] = simd.mul_add_e_f32s(u, simd.splat_f32s(a[axis]), torque[axis]);
            }
            // The inertia tensor has no effect on the force.
            if c < WITH_FORCE {
                for axis in 0..3 {
                    force[axis] = simd.mul_add_e_f32s(u, simd.splat_f32s(a[axis + 3]), force[axis]);
                }
            }
        }
        ([*t0, *t1, *t2], [*f0, *f1, *f2]) = (torque, force);
    }
}

/// Adds `U_s A_s^T`: the effect of a sensor's offset on the balance of the sub-tree, as a wrench in
/// base coordinates.
#[inline(always)]
pub(crate) fn add_offset<S: Simd>(
    simd: S,
    out: &mut [Lanes],
    rows: usize,
    column_block: &ColumnBlock,
    x_bm: &Pose,
    is_positive: bool,
) {
    let sign = if is_positive { 1.0 } else { -1.0 };
    let turn = x_bm.rotation * sign;
    let levered = x_bm.translation.cross_matrix() * turn;
    let columns = vectors::<S>(&column_block.columns);
    let count = columns.len() / 6;
    let (torques, forces) = out.split_at_mut(3 * rows);
    let out = torques
        .chunks_exact_mut(rows)
        .zip(forces.chunks_exact_mut(rows));
    for (axis, (torque, force)) in out.enumerate() {
        let torque = vectors_mut::<S>(&mut torque[column_block.rows.clone()]);
        let force = vectors_mut::<S>(&mut force[column_block.rows.clone()]);
        for channel in 0..3 {
            let turn = simd.splat_f32s(single(turn[(axis, channel)]));
            let levered = simd.splat_f32s(single(levered[(axis, channel)]));
            let (n, f) = (
                &columns[channel * count..][..count],
                &columns[(channel + 3) * count..][..count],
            );
            for (((torque, force), n), f) in torque.iter_mut().zip(force.iter_mut()).zip(n).zip(f) {
                *torque = simd.mul_add_e_f32s(*n, turn, simd.mul_add_e_f32s(*f, levered, *torque));
                *force = simd.mul_add_e_f32s(*f, turn, *force);
            }
        }
    }
}

/// The columns of a link or of a sensor's offset in the root, without the rows that are zero.
#[derive(Clone, Debug)]
pub(crate) struct ColumnBlock {
    pub(crate) what: Member,
    /// Place in the sub-tree of the link that it acts on.
    pub(crate) place: usize,
    pub(crate) rows: Range<usize>,
    pub(crate) columns: Vec<Lanes>,
    /// For a sensor whose calibration is uncertain, too: its parts. `columns` is then their
    /// combination for the present reading.
    pub(crate) calibration: Option<Box<Calibrated>>,
}

impl ColumnBlock {
    /// Combines the columns of offset and calibration: an unknown of the calibration acts like an
    /// offset, with a factor that depends on the reading.
    pub(crate) fn set_calibration_point(&mut self, corrected: &[f64; 6], kelvin: f64) {
        let Some(calibration) = &self.calibration else {
            return;
        };
        self.columns.copy_from_slice(&calibration.offset);
        let count = self.rows.len();
        for (unknown, own) in &calibration.unknowns {
            let factor = single(unknown.as_offset(corrected, kelvin));
            let sums = self.columns.as_flattened_mut().iter_mut();
            let sums = sums.skip(LANES * count * unknown.channel());
            sums.zip(own.as_flattened())
                .for_each(|(sum, value)| *sum += factor * value);
        }
    }
}

/// The columns of an offset, and those of the unknowns of its sensor's calibration, in the rows of
/// the offset's columns.
#[derive(Clone, Debug)]
pub(crate) struct Calibrated {
    pub(crate) offset: Vec<Lanes>,
    pub(crate) unknowns: Vec<(Unknown, Vec<Lanes>)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Member {
    /// The unknowns of a sensor's calibration. They come before its offset, so that the offset has
    /// at least as many rows.
    Calibration,
    Link(usize),
    /// A sensor, and whether its offset enters the balance with a positive sign.
    Sensor(usize, bool),
}
