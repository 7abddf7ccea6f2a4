//! The test of whether an additional effect explains residuals: a load, an encoder offset, a delay,
//! another frame of a sensor.
//!
//! An effect adds unknowns to the parameters and the noise. Its gain is the increase of twice the
//! log-likelihood with these unknowns, with all others fitted again. In the linear case the gain is
//! the square of the estimate in standard deviations. Without an effect, the gain is a chi-square
//! variable with one degree of freedom per unknown (Wilks 1938), or less under a prior. If the best
//! of several effects is tested, the false alarm rate of each is divided by their number
//! (Bonferroni).

use crate::parallel;
use crate::statistics::{chi_square, exceeded};

/// Probability of finding an effect of a kind in a log without one.
pub(crate) const FALSE_ALARM: f64 = 1e-3;

/// The threshold of the gain of an effect with `freedom` unknowns, the best of `tried`.
pub(crate) fn needed(freedom: usize, tried: usize) -> f64 {
    chi_square(freedom, exceeded(FALSE_ALARM / tried.max(1) as f64))
}

/// The threshold for one unknown of either sign, in standard deviations.
pub(crate) fn threshold(tried: usize) -> f64 {
    needed(1, tried).sqrt()
}

/// The hypotheses that are accepted one after another, of those that are `tried` beside the
/// accepted ones: the first whose cost is within the factor `similar` of the least one, if it is
/// lower than before by more than `least`, given the cost before.
pub(crate) fn accepted<H: Clone + Send + Sync>(
    tried: impl Fn(&[H]) -> Vec<H>,
    cost: impl Fn(&[H]) -> Option<f64> + Sync,
    least: impl Fn(f64) -> f64,
    similar: f64,
) -> Vec<H> {
    let mut accepted = Vec::new();
    let Some(mut before) = cost(&[]) else {
        return accepted;
    };
    loop {
        let tried = tried(&accepted);
        let costs = parallel::map(tried.len(), |number| {
            cost(&[&accepted[..], &tried[number..=number]].concat()).unwrap_or(f64::INFINITY)
        });
        let lowest = costs.iter().copied().fold(f64::INFINITY, f64::min);
        let mut all = tried.into_iter().zip(costs);
        let most = before - least(before);
        match all.find(|(_, cost)| *cost < most && *cost <= similar * lowest) {
            Some((own, cost)) => {
                accepted.push(own);
                before = cost;
            }
            None => return accepted,
        }
    }
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
