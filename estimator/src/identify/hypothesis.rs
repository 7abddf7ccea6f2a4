//! Whether something more explains what data leave: one test for whatever may have happened to a
//! robot or its sensors.
//!
//! Something more (a load, a jump of an offset, a joint's zero, a delay) is further unknowns beside
//! parameters and noise. Its gain is by how much twice the log-likelihood rises with them, all the
//! rest fitted again; where all is linear that is the square of the estimate in its own standard
//! deviations. If there is nothing more, the gain is a chi-square variable with a degree of freedom
//! per unknown (Wilks 1938), or less under a prior. The best of many must exceed what one of them
//! by itself exceeds so many times more rarely (Bonferroni).

use crate::statistics::{chi_square, exceeded};

/// How often something is found in a log where there is nothing of its kind.
pub(super) const FALSE_ALARM: f64 = 1e-3;

/// The gain that something of `freedom` unknowns must exceed, being the best of `tried`.
pub(super) fn needed(freedom: usize, tried: usize) -> f64 {
    chi_square(freedom, exceeded(FALSE_ALARM / tried.max(1) as f64))
}

/// The same for one unknown, of either sign, in its standard deviations.
pub(super) fn deviations(tried: usize) -> f64 {
    needed(1, tried).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::normals;
    use super::*;

    /// Of ten thousand rounds in which the best of five sums of three squares is looked at, one in a
    /// thousand exceeds what is needed.
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
        let (found, expected) = (alarms(needed(freedom, tried)) as f64, FALSE_ALARM * rounds as f64);
        assert!(
            (found - expected).abs() < 4.0 * expected.sqrt(),
            "{found}, not {expected}"
        );
        // Without the correction for many there are five times as many.
        assert!(alarms(needed(freedom, 1)) as f64 > 3.0 * expected);
    }
}
