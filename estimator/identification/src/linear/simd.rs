//! Inner loops over long slices, in the widest vector instructions of the processor, also in a
//! portable build ([`pulp`]). Call them within [`pulp::Arch::dispatch`], without closures in
//! between: those would be compiled for the baseline processor.

use std::ops::{Deref, DerefMut};

use pulp::Simd;

/// Number of vectors processed together, so that no instruction waits for a single sum.
pub(crate) const VECTORS: usize = 4;

/// A multiple of the vector length of every processor.
pub(crate) const LANES: usize = 8;

/// Numbers that start at a cache line. A vector across two lines would need two loads.
#[derive(Debug)]
pub(crate) struct Aligned {
    storage: Vec<f64>,
    start: usize,
    len: usize,
}

impl Aligned {
    pub(crate) fn zeros(len: usize) -> Self {
        const LINE: usize = 64;
        let storage = vec![0.0; len + LINE / size_of::<f64>()];
        // If there is no aligned place, an unaligned one works too, only slower.
        let start = storage.as_ptr().align_offset(LINE).min(storage.len() - len);
        Self {
            storage,
            start,
            len,
        }
    }
}

impl Clone for Aligned {
    /// Copied, since the alignment of the new storage differs.
    fn clone(&self) -> Self {
        let mut other = Self::zeros(self.len);
        other.copy_from_slice(self);
        other
    }
}

impl Deref for Aligned {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        &self.storage[self.start..][..self.len]
    }
}

impl DerefMut for Aligned {
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.storage[self.start..][..self.len]
    }
}

/// The inner product of two slices of equal length.
#[inline(always)]
pub(crate) fn inner<S: Simd>(simd: S, a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (S::as_simd_f64s(a), S::as_simd_f64s(b));
    let mut sum = simd.splat_f64s(0.0);
    for (a, b) in a.iter().zip(b) {
        sum = simd.mul_add_e_f64s(*a, *b, sum);
    }
    let mut total = simd.reduce_sum_f64s(sum);
    for (a, b) in a_rest.iter().zip(b_rest) {
        total += a * b;
    }
    total
}

/// The inner products of four slices with `c`, whose length is a multiple of [`LANES`].
#[inline(always)]
pub(crate) fn inner_of_four<S: Simd>(
    simd: S,
    four: [&[f64]; VECTORS],
    c: &[f64],
) -> [f64; VECTORS] {
    let [a, b, d, e] = vectors::<S>(four);
    let mut sums = [simd.splat_f64s(0.0); VECTORS];
    for ((((c, a), b), d), e) in S::as_simd_f64s(c).0.iter().zip(a).zip(b).zip(d).zip(e) {
        sums[0] = simd.mul_add_e_f64s(*a, *c, sums[0]);
        sums[1] = simd.mul_add_e_f64s(*b, *c, sums[1]);
        sums[2] = simd.mul_add_e_f64s(*d, *c, sums[2]);
        sums[3] = simd.mul_add_e_f64s(*e, *c, sums[3]);
    }
    let [a, b, d, e] = sums;
    [
        simd.reduce_sum_f64s(a),
        simd.reduce_sum_f64s(b),
        simd.reduce_sum_f64s(d),
        simd.reduce_sum_f64s(e),
    ]
}

/// `c += f v`.
#[inline(always)]
pub(crate) fn add<S: Simd>(simd: S, c: &mut [f64], factor: f64, v: &[f64]) {
    let ((c, c_rest), (v, v_rest)) = (S::as_mut_simd_f64s(c), S::as_simd_f64s(v));
    let splat = simd.splat_f64s(factor);
    for (c, v) in c.iter_mut().zip(v) {
        *c = simd.mul_add_e_f64s(splat, *v, *c);
    }
    for (c, v) in c_rest.iter_mut().zip(v_rest) {
        *c += factor * v;
    }
}

/// `c += f v`, and then `c . c`.
#[inline(always)]
pub(crate) fn add_and_square<S: Simd>(simd: S, c: &mut [f64], factor: f64, v: &[f64]) -> f64 {
    let ((c, c_rest), (v, v_rest)) = (S::as_mut_simd_f64s(c), S::as_simd_f64s(v));
    let (splat, mut sum) = (simd.splat_f64s(factor), simd.splat_f64s(0.0));
    for (c, v) in c.iter_mut().zip(v) {
        *c = simd.mul_add_e_f64s(splat, *v, *c);
        sum = simd.mul_add_e_f64s(*c, *c, sum);
    }
    let mut total = simd.reduce_sum_f64s(sum);
    for (c, v) in c_rest.iter_mut().zip(v_rest) {
        *c += factor * v;
        total += *c * *c;
    }
    total
}

/// `c += sum f_j v_j`.
#[inline(always)]
pub(crate) fn add_four<S: Simd>(
    simd: S,
    c: &mut [f64],
    factors: [f64; VECTORS],
    four: [&[f64]; VECTORS],
) {
    let mut splat = [simd.splat_f64s(0.0); VECTORS];
    for (splat, factor) in splat.iter_mut().zip(factors) {
        *splat = simd.splat_f64s(factor);
    }
    let [a, b, d, e] = vectors::<S>(four);
    let (c, rest) = S::as_mut_simd_f64s(c);
    let done = four[0].len() - rest.len();
    for ((((c, a), b), d), e) in c.iter_mut().zip(a).zip(b).zip(d).zip(e) {
        let half = simd.mul_add_e_f64s(splat[1], *b, simd.mul_add_e_f64s(splat[0], *a, *c));
        *c = simd.add_f64s(
            half,
            simd.mul_add_e_f64s(splat[3], *e, simd.mul_f64s(splat[2], *d)),
        );
    }
    for (i, c) in rest.iter_mut().enumerate() {
        for (factor, v) in factors.iter().zip(four) {
            *c += factor * v[done + i];
        }
    }
}

#[inline(always)]
fn vectors<S: Simd>(four: [&[f64]; VECTORS]) -> [&[S::f64s]; VECTORS] {
    let [a, b, d, e] = four;
    [
        S::as_simd_f64s(a).0,
        S::as_simd_f64s(b).0,
        S::as_simd_f64s(d).0,
        S::as_simd_f64s(e).0,
    ]
}
