//! In-place calibration of a force/torque sensor: from its reading to the wrench that acts on it.
//!
//! A sensor has a factory calibration. Mounted in a robot it is strained, and its electronics warm
//! up. Besides the offset, two effects are corrected here:
//!
//! ```text
//! corrected = C r - k (T - T0)          wrench = corrected - offset
//! ```
//!
//! - `r`: the reading as sent by the sensor's board;
//! - `C`: the gain, 6 by 6 (the identity if the board's own matrix is accurate enough);
//! - `T`: the board's temperature \[degrees Celsius\];
//! - `k`: the change of the reading per kelvin [N/K, Nm/K];
//! - `T0`: the reference temperature, at which the offset is valid.
//!
//! An error of the gain is relative to the corrected reading, `true = (1 + E) corrected`: so `E` is
//! small, and zero for a correct gain. A [`Kind`] selects the unknown entries of `E` and of `k`.
//! [`Calibration::then`] composes two corrections.
//!
//! Vectors over channels are in the order [torque; force] of [`crate::spatial`], unless stated
//! otherwise: files and logs have [force; torque].

use crate::spatial::Wrench;
use nalgebra::{Matrix6, Vector6};
use serde::Deserialize;

/// Standard deviation of an unknown offset, neither declared nor identified yet, of each channel
/// [torque; force] \[Nm, N\]. It is larger than the offset of any sensor, so it does not influence
/// the estimate.
pub const UNKNOWN_OFFSET: [f64; 6] = [100.0, 100.0, 100.0, 1000.0, 1000.0, 1000.0];

/// Correction of a sensor's reading; the result is the wrench plus an offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    gain: Matrix6<f64>,
    per_kelvin: Wrench,
    reference: Option<f64>,
    has_gain: bool,
    has_temperature: bool,
}

impl Default for Calibration {
    /// No correction.
    fn default() -> Self {
        Self::new(Matrix6::identity(), Wrench::zero(), None)
    }
}

impl Calibration {
    /// A calibration with a gain, a change of the reading per kelvin [Nm/K, N/K] and the reference
    /// temperature at which this change is zero \[degrees Celsius\]. Without a reference,
    /// temperature is not corrected.
    #[must_use]
    pub fn new(gain: Matrix6<f64>, per_kelvin: Wrench, reference: Option<f64>) -> Self {
        Self {
            has_gain: gain != Matrix6::identity(),
            has_temperature: reference.is_some() && per_kelvin != Wrench::zero(),
            gain,
            per_kelvin,
            reference,
        }
    }

    /// The gain `C`, rows and columns [torque; force].
    #[must_use]
    pub fn gain(&self) -> &Matrix6<f64> {
        &self.gain
    }

    /// Change of the reading per kelvin, `k` [Nm/K, N/K].
    #[must_use]
    pub fn per_kelvin(&self) -> &Wrench {
        &self.per_kelvin
    }

    /// Reference temperature `T0` \[degrees Celsius\], if known.
    #[must_use]
    pub fn reference(&self) -> Option<f64> {
        self.reference
    }

    /// Whether the correction depends on the board's temperature.
    #[must_use]
    pub fn depends_on_temperature(&self) -> bool {
        self.has_temperature
    }

    /// Variance of each channel [torque; force] [Nm^2, N^2] due to the uncertainty of the board's
    /// temperature. `age` is the time since the last temperature message; `None`: there was none. A
    /// temperature is exact for a minute. Then its standard deviation grows by one kelvin per
    /// minute, up to 10 K: the warm-up of a board within hours (an iCub's: 14 K).
    #[must_use]
    pub fn temperature_variance(&self, age: Option<f64>) -> [f64; 6] {
        const MAX_KELVIN: f64 = 10.0;
        if !self.has_temperature {
            return [0.0; 6];
        }
        let kelvin = age.map_or(MAX_KELVIN, |age| (age / 60.0 - 1.0).clamp(0.0, MAX_KELVIN));
        self.per_kelvin.torque_first().map(|k| (k * kelvin).powi(2))
    }

    /// Difference of a temperature from the reference \[K\]; 0 if either is unknown.
    #[must_use]
    pub fn temperature_rise(&self, celsius: f64) -> f64 {
        let kelvin = self.reference.map(|reference| celsius - reference);
        kelvin.filter(|kelvin| kelvin.is_finite()).unwrap_or(0.0)
    }

    /// `C r - k (T - T0)`. An unknown temperature (NaN) is assumed to be `T0`. Where there is
    /// nothing to correct, the result is `r`, bit for bit.
    #[must_use]
    pub fn apply(&self, reading: &Wrench, celsius: f64) -> Wrench {
        let mut corrected = *reading;
        if self.has_gain {
            corrected = wrench(&(self.gain * Vector6::from(reading.torque_first())));
        }
        if self.has_temperature {
            corrected -= self.per_kelvin * self.temperature_rise(celsius);
        }
        corrected
    }

    /// Variances of the corrected channels, from those of a reading whose channels have the
    /// standard deviations `reading` and independent errors.
    #[must_use]
    pub fn variance_of(&self, reading: &Wrench) -> [f64; 6] {
        let std = Vector6::from(reading.torque_first());
        let gain = &self.gain;
        std::array::from_fn(|i| {
            gain.row(i)
                .iter()
                .zip(&std)
                .map(|(c, s)| (c * s).powi(2))
                .sum()
        })
    }

    /// This correction followed by another one that was identified on its output:
    /// `(1 + e) (C r - k (T - T0)) - more (T - T0)`. If this one has no reference temperature,
    /// `reference` is used.
    #[must_use]
    pub fn then(&self, e: &Matrix6<f64>, more: &Wrench, reference: Option<f64>) -> Self {
        let change = Matrix6::identity() + e;
        let drift = change * Vector6::from(self.per_kelvin.torque_first());
        Self::new(
            change * self.gain,
            wrench(&drift) + *more,
            self.reference.or(reference),
        )
    }

    /// The inverse of [`Calibration::then`]: the gain error `e` and the additional change per
    /// kelvin, [torque; force], that make this calibration from `first`. The error is zero if the
    /// gain of `first` has no inverse.
    #[must_use]
    pub fn after(&self, first: &Self) -> (Matrix6<f64>, [f64; 6]) {
        let inverse = first.gain.try_inverse();
        let change = inverse.map_or_else(Matrix6::identity, |inverse| self.gain * inverse);
        let carried = wrench(&(change * Vector6::from(first.per_kelvin.torque_first())));
        let more = (self.per_kelvin - carried).torque_first();
        (change - Matrix6::identity(), more)
    }

    /// The gain row by row, rows and columns [force; torque].
    #[must_use]
    pub fn gain_force_first(&self) -> [f64; 36] {
        std::array::from_fn(|i| self.gain[(swapped(i / 6), swapped(i % 6))])
    }
}

/// A gain in the order of files, rows and columns [force; torque]: 36 numbers row by row, or the 6
/// of a diagonal.
#[must_use]
pub fn gain_from_force_first(numbers: &[f64]) -> Option<Matrix6<f64>> {
    match numbers.len() {
        6 => Some(Matrix6::from_fn(|i, j| {
            if i == j { numbers[swapped(i)] } else { 0.0 }
        })),
        36 => Some(Matrix6::from_fn(|i, j| {
            numbers[6 * swapped(i) + swapped(j)]
        })),
        _ => None,
    }
}

/// Reorders the numbers of six channels, or of 36 pairs of channels row by row: [torque; force] to
/// [force; torque] and back.
#[must_use]
pub fn force_first(numbers: &[f64]) -> Vec<f64> {
    let at = |i: usize| numbers.get(i).copied().unwrap_or(f64::NAN);
    match numbers.len() {
        36 => (0..36)
            .map(|i| at(6 * swapped(i / 6) + swapped(i % 6)))
            .collect(),
        count => (0..count).map(|i| at(swapped(i))).collect(),
    }
}

/// Index of a channel in the other order: [torque; force] to [force; torque] and back.
#[must_use]
pub fn swapped(channel: usize) -> usize {
    (channel + 3) % 6
}

fn wrench(torque_first: &Vector6<f64>) -> Wrench {
    Wrench::from_torque_first((*torque_first).into())
}

/// The unknown entries of a gain error.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Gain {
    /// All 36 where there is a sensor: the prior keeps those that the logs do not determine.
    #[default]
    Auto,
    /// None: the factory gain is correct.
    None,
    /// One for each channel.
    Diagonal,
    /// All 36.
    Full,
}

/// The part of a sensor's calibration that is unknown and identified.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Kind {
    /// Unknown entries of the gain error.
    pub gain: Gain,
    /// Whether the change per kelvin is unknown too.
    pub temperature: bool,
}

/// One unknown of a sensor's calibration; channels [torque; force].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unknown {
    /// Entry of `E`: error of one channel per unit of the reading of another (or the same).
    Gain {
        /// The channel with the error.
        channel: usize,
        /// The channel of the reading.
        of: usize,
    },
    /// Entry of `k`: change of a channel per kelvin.
    Temperature {
        /// The channel.
        channel: usize,
    },
}

impl Kind {
    /// Whether nothing is unknown.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.count() == 0
    }

    /// Number of unknowns.
    #[must_use]
    pub fn count(&self) -> usize {
        self.unknowns().count()
    }

    /// The unknowns in the order of their columns: entries of `E` row by row, then of `k`. `Auto`
    /// has none until the logs are known.
    pub fn unknowns(self) -> impl Iterator<Item = Unknown> {
        let gains = (0..6).flat_map(move |channel| {
            (0..6).filter_map(move |of| {
                let is_unknown =
                    self.gain == Gain::Full || self.gain == Gain::Diagonal && of == channel;
                is_unknown.then_some(Unknown::Gain { channel, of })
            })
        });
        let kelvins = (0..6).filter(move |_| self.temperature);
        gains.chain(kelvins.map(|channel| Unknown::Temperature { channel }))
    }
}

impl Unknown {
    /// The channel that it changes.
    #[must_use]
    pub fn channel(self) -> usize {
        match self {
            Self::Gain { channel, .. } | Self::Temperature { channel } => channel,
        }
    }

    /// Apparent change of the *offset* of that channel per unit of this unknown, at the corrected
    /// reading `corrected` [torque; force] and `kelvin` above the reference temperature. A gain too
    /// small by `E` acts as an offset of `-E r`, a warm board as one of `k (T - T0)`.
    #[must_use]
    pub fn as_offset(self, corrected: &[f64; 6], kelvin: f64) -> f64 {
        match self {
            Self::Gain { of, .. } => -corrected.get(of).copied().unwrap_or(f64::NAN),
            Self::Temperature { .. } => kelvin,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn any() -> Calibration {
        let gain = Matrix6::from_fn(|i, j| {
            if i == j {
                1.1
            } else {
                0.01 * (i as f64 - 2.0 * j as f64)
            }
        });
        Calibration::new(
            gain,
            Wrench::from_parts([0.05, -0.02, 0.1], [1e-3, 2e-3, -3e-3]),
            Some(25.0),
        )
    }

    #[test]
    fn a_reading_with_nothing_to_correct_stays_bit_for_bit() {
        let odd = Wrench::from_parts([-0.0, f64::MIN_POSITIVE, 1e300], [0.1, f64::NAN, -1.0]);
        let same = Calibration::default().apply(&odd, 80.0);
        let bits = |w: &Wrench| w.force_first().map(f64::to_bits);
        assert_eq!(bits(&same), bits(&odd));
    }

    #[test]
    fn by_hand() {
        let mut gain = Matrix6::identity();
        // Of the torque reading about x, 0.3 N/Nm is actually a force along x.
        gain[(3, 0)] = 0.3;
        gain[(5, 5)] = 2.0;
        let calibration = Calibration::new(
            gain,
            Wrench::from_parts([0.0, 0.5, 0.0], [0.0; 3]),
            Some(30.0),
        );
        let raw = Wrench::from_parts([1.0, 2.0, 3.0], [10.0, 20.0, 30.0]);
        let got = calibration.apply(&raw, 34.0);
        assert_eq!(got, Wrench::from_parts([4.0, 0.0, 6.0], [10.0, 20.0, 30.0]));
        // Without a temperature the result is as at the reference.
        assert_eq!(
            calibration.apply(&raw, f64::NAN),
            Wrench::from_parts([4.0, 2.0, 6.0], [10.0, 20.0, 30.0])
        );
        let text = calibration.gain_force_first();
        assert_eq!((text[3], text[14], text[0]), (0.3, 2.0, 1.0));
        assert_eq!(gain_from_force_first(&text), Some(gain));
        let diagonal = gain_from_force_first(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
        assert_eq!(
            diagonal.diagonal(),
            Vector6::new(4.0, 5.0, 6.0, 1.0, 2.0, 3.0)
        );
        assert_eq!(gain_from_force_first(&[1.0; 7]), None);
    }

    #[test]
    fn one_after_the_other() {
        let first = any();
        let e = Matrix6::from_fn(|i, j| 0.02 * ((3 * i + j) as f64).sin());
        let more = Wrench::from_parts([0.01, 0.02, 0.03], [-0.01, 0.0, 0.01]);
        let raw = Wrench::from_parts([12.0, -3.0, 40.0], [0.5, 1.0, -2.0]);
        let step = Vector6::from(first.apply(&raw, 31.0).torque_first());
        let expected = wrench(&(step + e * step)) - more * 6.0;
        let got = first.then(&e, &more, Some(99.0)).apply(&raw, 31.0);
        for (a, b) in got.force_first().into_iter().zip(expected.force_first()) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        let (e_again, more_again) = first.then(&e, &more, Some(99.0)).after(&first);
        assert!((e_again - e).norm() < 1e-12);
        let same = more_again
            .iter()
            .zip(more.torque_first())
            .all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(same, "{more_again:?}");
        // A first calibration without a reference gets one.
        let plain = Calibration::default().then(&Matrix6::zeros(), &more, Some(20.0));
        assert_eq!(plain.apply(&raw, 21.0), raw - more);
    }

    /// [`Unknown::as_offset`] is the derivative of the wrench.
    #[test]
    fn unknowns_are_what_a_small_change_does() {
        let base = any();
        let raw = Wrench::from_parts([12.0, -3.0, 40.0], [0.5, 1.0, -2.0]);
        let corrected = base.apply(&raw, 31.0);
        for (gain, temperature, count) in [
            (Gain::None, false, 0),
            (Gain::Diagonal, false, 6),
            (Gain::Full, true, 42),
            (Gain::None, true, 6),
        ] {
            let kind = Kind { gain, temperature };
            assert_eq!((kind.count(), kind.unknowns().count()), (count, count));
            assert_eq!(kind.is_empty(), count == 0);
            for unknown in kind.unknowns() {
                let (mut e, mut more) = (Matrix6::zeros(), [0.0; 6]);
                match unknown {
                    Unknown::Gain { channel, of } => e[(channel, of)] = 1e-3,
                    Unknown::Temperature { channel } => more[channel] = 1e-3,
                }
                let changed = base
                    .then(&e, &wrench(&Vector6::from(more)), None)
                    .apply(&raw, 31.0);
                let change = (changed - corrected).torque_first();
                let expected = -1e-3
                    * unknown.as_offset(&corrected.torque_first(), base.temperature_rise(31.0));
                for (channel, value) in change.into_iter().enumerate() {
                    let expected = if channel == unknown.channel() {
                        expected
                    } else {
                        0.0
                    };
                    assert!(
                        (value - expected).abs() < 1e-12,
                        "{unknown:?}, {channel}: {value} {expected}"
                    );
                }
            }
        }
    }
}
