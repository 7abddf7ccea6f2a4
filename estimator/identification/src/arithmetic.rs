//! Inner products, and triangular factors of matrices stored row by row in slices.

/// Number of independent sums of an inner product. A single sum would wait for itself at every
/// step.
const LANES: usize = 4;

/// The inner product of two slices of equal length.
#[inline(always)]
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    debug_assert_eq!(a.len(), b.len());
    let ((a8, a), (b8, b)) = (
        a.as_chunks::<{ 2 * LANES }>(),
        b.as_chunks::<{ 2 * LANES }>(),
    );
    let mut sum = [0.0; 2 * LANES];
    for (x, y) in a8.iter().zip(b8) {
        for lane in 0..2 * LANES {
            sum[lane] += x[lane] * y[lane];
        }
    }
    let mut four = [0.0; LANES];
    for lane in 0..LANES {
        four[lane] = sum[lane] + sum[lane + LANES];
    }
    let ((a4, a), (b4, b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (x, y) in a4.iter().zip(b4) {
        for lane in 0..LANES {
            four[lane] += x[lane] * y[lane];
        }
    }
    let rest: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    (four[0] + four[2]) + (four[1] + four[3]) + rest
}

/// `to += factor * from`.
#[inline(always)]
pub(crate) fn add_multiple(to: &mut [f64], factor: f64, from: &[f64]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += factor * from;
    }
}

/// Lower factor of a covariance, row by row in place. The variance of combinations without noise is
/// set to 1e-9 of the greatest variance.
pub(crate) fn factorise(covariance: &mut [f64], count: usize) {
    let greatest = (0..count)
        .map(|i| covariance[i * count + i])
        .fold(0.0, f64::max);
    let floor = 1e-9 * greatest.max(f64::MIN_POSITIVE);
    for i in 0..count {
        for j in 0..=i {
            let (above, own) = covariance.split_at(i * count);
            let other = if j == i { own } else { &above[j * count..] };
            let rest = own[j] - dot(&own[..j], &other[..j]);
            covariance[i * count + j] = if i == j {
                rest.max(floor).sqrt()
            } else {
                rest / covariance[j * count + j]
            };
        }
    }
}

/// Applies `L^-1` from the left to `count` rows of `width` numbers.
pub(crate) fn forward(factor: &[f64], count: usize, values: &mut [f64], width: usize) {
    for i in 0..count {
        let (above, own) = values.split_at_mut(i * width);
        let own = &mut own[..width];
        for j in 0..i {
            let weight = factor[i * count + j];
            if weight != 0.0 {
                for (x, y) in own.iter_mut().zip(&above[j * width..][..width]) {
                    *x -= weight * y;
                }
            }
        }
        let scale = 1.0 / factor[i * count + i];
        own.iter_mut().for_each(|x| *x *= scale);
    }
}

/// The mean of the finite values; NaN of none.
pub(crate) fn mean<'a>(values: impl IntoIterator<Item = &'a f64>) -> f64 {
    let finite = values.into_iter().filter(|x| x.is_finite());
    let (sum, count) = finite.fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
    sum / count
}

/// The root mean square of the finite values; NaN of none.
pub(crate) fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let finite = values.filter(|x| x.is_finite());
    let (sum, count) = finite.fold((0.0, 0.0), |(sum, count), x| (sum + x * x, count + 1.0));
    (sum / count).sqrt()
}

/// Normal deviates for tests: splitmix64 and Box, Muller.
#[cfg(test)]
pub(crate) fn normals(seed: u64, count: usize) -> Vec<f64> {
    let mut state = seed;
    let mut uniform = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    (0..count)
        .map(|_| {
            (-2.0 * uniform().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos()
        })
        .collect()
}
