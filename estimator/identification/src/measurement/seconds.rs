//! Noise that differs from second to second: a robot that stands on a foot which nobody declares,
//! or a part of a motion that the model explains badly, would otherwise set the noise of a whole
//! log, and its good seconds would count for nothing.
//!
//! The noise of the F/T channels follows Student's t distribution with [`FREEDOM`] degrees of
//! freedom, its scale common to all channels and readings of a second:
//!
//! ```text
//! e_c ~ N(0, w sigma_c^2)        in a second with the factor w
//! w   = (nu + sum_c s_c / sigma_c^2) / (nu + C)
//! ```
//!
//! `s_c` is the mean square of channel `c` in the second, `C` the number of its channels; the
//! readings of a second count as one, since they are correlated for about as long (EM algorithm:
//! Lange, Little, Taylor, JASA 1989). Torques of joints keep one variance: their large residuals
//! are where the robot moves fast, which is where inertia shows.
//!
//! Without it, parameters of the real leg from spans in which its foot stands on the ground predict
//! the other spans as CAD does; with it, with .82 to .89 of CAD's error (difference of the torques
//! from either of two sensors).

use crate::measurement::noise_model::{Seconds, second};
use crate::measurement::reduction::{LogSegment, Residuals};
use crate::measurement::unknowns::Unknowns;
use std::collections::BTreeMap;

/// Degrees of freedom, as Lange, Little and Taylor recommend where they are not estimated.
const FREEDOM: f64 = 4.0;

/// Rounds of factors and variances: each divides the error by more than two, since a second's own
/// part in the variances is small.
const ROUNDS: usize = 20;

impl Seconds {
    /// From the residuals of training logs.
    pub(crate) fn of(
        unknowns: &Unknowns,
        segments: &[LogSegment<'_>],
        residuals: &[Residuals],
    ) -> Self {
        let channels = unknowns.wrenches();
        // Per second and channel: sum of squares, number of readings.
        let mut sums: BTreeMap<(usize, i64), Vec<(f64, f64)>> = BTreeMap::new();
        for (segment, residuals) in segments.iter().zip(residuals) {
            let Some(log) = segment.log else { continue };
            for (i, instant) in segment.instants.iter().enumerate() {
                let own = sums.entry((log, second(instant.t)));
                let own = own.or_insert_with(|| vec![(0.0, 0.0); channels]);
                for (sum, noise) in own.iter_mut().zip(&residuals.noise[0]) {
                    if noise[i].is_finite() {
                        *sum = (sum.0 + noise[i] * noise[i], sum.1 + 1.0);
                    }
                }
            }
        }
        sums.retain(|_, own| own.iter().any(|(_, count)| *count > 0.0));
        let (seconds, sums): (Vec<_>, Vec<_>) = sums.into_iter().unzip();
        Self(seconds.into_iter().zip(factors(&sums)).collect())
    }

    /// Divides the residuals of the F/T channels by the root of their factor, so that their
    /// variances are those of a second with factor 1.
    pub(crate) fn standardise(
        &self,
        unknowns: &Unknowns,
        segments: &[LogSegment<'_>],
        residuals: &mut [Residuals],
    ) {
        let channels = unknowns.wrenches();
        for (segment, residuals) in segments.iter().zip(residuals) {
            for (i, instant) in segment.instants.iter().enumerate() {
                let root = self.factor(segment.log, instant.t).sqrt();
                for set in &mut residuals.noise {
                    for noise in &mut set[..channels] {
                        noise[i] /= root;
                    }
                }
            }
        }
    }
}

/// The factors of seconds, from the sum of squares and the number of readings of each channel.
fn factors(sums: &[Vec<(f64, f64)>]) -> Vec<f64> {
    let mut factors = vec![1.0; sums.len()];
    for _ in 0..ROUNDS {
        let mut all = vec![(0.0, 0.0); sums.first().map_or(0, Vec::len)];
        for (own, factor) in sums.iter().zip(&factors) {
            for (all, (square, count)) in all.iter_mut().zip(own) {
                *all = (all.0 + square / factor, all.1 + count);
            }
        }
        for (own, factor) in sums.iter().zip(&mut factors) {
            let seen = own.iter().zip(&all);
            let seen = seen.filter(|(own, all)| own.1 > 0.0 && all.0 > 0.0);
            let (sum, count) = seen.fold((0.0, 0.0), |(sum, count), (own, all)| {
                (sum + own.0 / own.1 / (all.0 / all.1), count + 1.0)
            });
            *factor = (FREEDOM + sum) / (FREEDOM + count);
        }
    }
    factors
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A third of the log has sixty times the noise: it sets the plain mean square, 1200 times that
    /// of the good seconds, but not their variance.
    #[test]
    fn a_bad_third_does_not_set_the_noise_of_the_rest() {
        let second = |square: f64| vec![(100.0 * square, 100.0); 6];
        let sums = [vec![second(1.0); 20], vec![second(3600.0); 10]].concat();
        let found = factors(&sums);
        let weighted = sums.iter().zip(&found).map(|(own, w)| own[0].0 / w);
        let variance = weighted.sum::<f64>() / 3000.0;
        assert!((0.8..2.0).contains(&(found[0] * variance)), "{}", found[0]);
        assert!(found[29] > 1000.0 * found[0], "{found:?}");
        // Seconds that are alike are not told apart.
        let alike = factors(&vec![second(7.0); 5]);
        assert!(alike.iter().all(|w| (w - 1.0).abs() < 1e-9), "{alike:?}");
    }
}
