//! Random numbers from a seed: the same seed gives the same robot, motion and noise. Each purpose
//! has a separate stream, so that the result does not depend on the order in which boards or
//! threads draw.

/// A stream of random numbers.
#[derive(Debug, Clone)]
pub(crate) struct Random {
    generator: fastrand::Rng,
    /// The second number of a pair of normal numbers.
    spare: Option<f64>,
}

impl Random {
    /// Stream number `stream` of `seed`, for purpose `purpose`.
    pub(crate) fn new(seed: u64, purpose: &str, stream: usize) -> Self {
        // FNV-1a over all three: any difference gives a different stream.
        let bytes = purpose
            .bytes()
            .chain(seed.to_le_bytes())
            .chain((stream as u64).to_le_bytes());
        let hash = bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        });
        Self {
            generator: fastrand::Rng::with_seed(hash),
            spare: None,
        }
    }

    /// Uniform in `from..to`.
    pub(crate) fn uniform(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * self.generator.f64()
    }

    /// True with this probability.
    pub(crate) fn happens(&mut self, probability: f64) -> bool {
        probability > 0.0 && self.generator.f64() < probability
    }

    /// Normal with mean 0 and standard deviation 1 (Box and Muller, 1958).
    pub(crate) fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        let radius = (-2.0 * (1.0 - self.generator.f64()).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * self.generator.f64()).sin_cos();
        self.spare = Some(radius * sin);
        radius * cos
    }

    /// Adds normal noise of standard deviation `deviation` to each of `values`.
    pub(crate) fn disturb<const N: usize>(&mut self, values: &mut [f64; N], deviation: [f64; N]) {
        for (value, deviation) in values.iter_mut().zip(deviation) {
            *value += deviation * self.normal();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_mean_0_and_deviation_1() {
        let mut random = Random::new(3, "test", 0);
        let n = 100_000;
        let values: Vec<f64> = (0..n).map(|_| random.normal()).collect();
        let mean = values.iter().sum::<f64>() / f64::from(n);
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / f64::from(n);
        let beyond_two = values.iter().filter(|v| v.abs() > 2.0).count() as f64 / f64::from(n);
        // Standard errors: 0.0032, 0.0045, 0.0007.
        assert!(
            mean.abs() < 0.013
                && (variance - 1.0).abs() < 0.018
                && (beyond_two - 0.0455).abs() < 0.003
        );
    }

    #[test]
    fn streams_differ_and_repeat() {
        let first = |seed, purpose, stream| Random::new(seed, purpose, stream).uniform(0.0, 1.0);
        assert_eq!(first(1, "a", 0), first(1, "a", 0));
        for other in [first(2, "a", 0), first(1, "b", 0), first(1, "a", 1)] {
            assert_ne!(other, first(1, "a", 0));
        }
    }
}
