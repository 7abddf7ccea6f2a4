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

/// Six numbers, padded with zeros to whole vector registers.
pub(crate) type Six = [f64; 8];

/// A covariance of a wrench [torque; force], symmetric.
pub(crate) type Covariance6 = [Six; 6];

/// A motion as six numbers [angular; linear].
#[inline(always)]
pub(crate) fn numbers(motion: &Motion) -> Six {
    let (n, v) = (&motion.angular, &motion.linear);
    [n.x, n.y, n.z, v.x, v.y, v.z, 0.0, 0.0]
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

/// `sum += a x`.
#[inline(always)]
fn add(sum: &mut Six, a: f64, x: &Six) {
    for i in 0..8 {
        sum[i] += a * x[i];
    }
}

/// `sum += C`.
#[inline(always)]
pub(crate) fn add_covariance(sum: &mut Covariance6, covariance: &Covariance6) {
    for (sum, row) in sum.iter_mut().zip(covariance) {
        add(sum, 1.0, row);
    }
}

/// `C a`.
#[inline(always)]
pub(crate) fn times(covariance: &Covariance6, a: &Six) -> Six {
    let mut product = [0.0; 8];
    for i in 0..6 {
        add(&mut product, a[i], &covariance[i]);
    }
    product
}

/// `a . b`.
#[inline(always)]
pub(crate) fn dot(a: &Six, b: &Six) -> f64 {
    let mut sum = 0.0;
    for i in 0..6 {
        sum += a[i] * b[i];
    }
    sum
}

/// Adds `A P A^T` of a link, `P = U^T U`.
#[inline(always)]
pub(crate) fn add_independent(out: &mut Covariance6, root: &Root, coefficients: &LinkRows) {
    let [a, b, c, d, e, f] = coefficients;
    let mut columns = [[0.0; 8]; LINK_PARAMETERS];
    for (i, column) in columns.iter_mut().enumerate() {
        *column = [a[i], b[i], c[i], d[i], e[i], f[i], 0.0, 0.0];
    }
    let mut sum = *out;
    for (first, row) in root.iter().enumerate() {
        let mut wrench = [0.0; 8];
        for c in first..LINK_PARAMETERS {
            add(&mut wrench, row[c], &columns[c]);
        }
        for i in 0..6 {
            add(&mut sum[i], wrench[i], &wrench);
        }
    }
    *out = sum;
}

/// Adds the covariance of a sensor's wrench at the origin, from the variances of its channels
/// [torque; force].
#[inline(always)]
pub(crate) fn add_reading(out: &mut Covariance6, x_bm: &Pose, variances: &[f64; 6]) {
    for channel in 0..3 {
        let axis = x_bm.rotation.column(channel).into_owned();
        let arm = x_bm.translation.cross(&axis);
        let by_torque = [axis.x, axis.y, axis.z, 0.0, 0.0, 0.0, 0.0, 0.0];
        let by_force = [arm.x, arm.y, arm.z, axis.x, axis.y, axis.z, 0.0, 0.0];
        for (column, variance) in [
            (by_torque, variances[channel]),
            (by_force, variances[channel + 3]),
        ] {
            for i in 0..6 {
                add(&mut out[i], variance * column[i], &column);
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
    /// Index in the sub-tree of the link that it acts on.
    pub(crate) link_index: usize,
    pub(crate) rows: Range<usize>,
    pub(crate) columns: Vec<Lanes>,
    /// For a sensor whose calibration is uncertain, too: its parts. `columns` is then their
    /// combination for the present reading.
    pub(crate) calibration: Option<Box<Calibrated>>,
}

impl ColumnBlock {
    /// Its columns one by one; `columns` are its own, or as many others of the same rows.
    pub(crate) fn columns_of<'a>(
        &self,
        columns: &'a [Lanes],
    ) -> impl Iterator<Item = &'a [Lanes]> + use<'a> {
        columns.chunks_exact(self.rows.len().max(1))
    }

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
