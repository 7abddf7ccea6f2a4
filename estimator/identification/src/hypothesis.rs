//! The test of whether an additional effect explains residuals: a load, an offset jump, an encoder
//! offset and a delay.
//!
//! An effect adds unknowns to the parameters
//! and the noise. Its gain is the increase of twice the log-likelihood with these unknowns, with
//! all others fitted again. In the linear case the gain is the square of the estimate in standard
//! deviations. Without an effect, the gain is a chi-square variable with one degree of freedom per
//! unknown (Wilks 1938), or less under a prior. If the best of several effects is tested, the false
//! alarm rate of each is divided by their number (Bonferroni).

use crate::statistics::{chi_square, exceeded};

/// Probability of finding an effect of a kind in a log without one.
pub(crate) const FALSE_ALARM: f64 = 1e-3;

/// The threshold of the gain of an effect with `freedom` unknowns, the best of `tried`.
pub(crate) fn needed(freedom: usize, tried: usize) -> f64 {
    chi_square(freedom, exceeded(FALSE_ALARM / tried.max(1) as f64))
}

/// The threshold for one unknown of either sign, in standard deviations.
pub(crate) fn deviations(tried: usize) -> f64 {
    needed(1, tried).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// The best of five sums of three squares exceeds the threshold in one of a thousand rounds.
    #[test]
    fn false_alarms_are_as_rare_as_stated() {
        let (freedom, tried, rounds) = (3, 5, 20_000);
        let deviates = normals(11, freedom * tried * rounds);
        let squares: Vec<f64> = (deviates.chunks_exact(freedom))
            .map(|own| own.iter().map(|x| x * x).sum())
            .collect();
        let alarms = |needed: f64| {
            let rounds = squares.chunks_exact(tried);
            rounds.filter(|own| own.iter().any(|x| *x > needed)).count()
        };
        let (found, expected) = (
            alarms(needed(freedom, tried)) as f64,
            FALSE_ALARM * rounds as f64,
        );
        assert!(
            (found - expected).abs() < 4.0 * expected.sqrt(),
            "{found}, not {expected}"
        );
        // Without the correction for the number tried there are five times as many.
        assert!(alarms(needed(freedom, 1)) as f64 > 3.0 * expected);
    }
}
