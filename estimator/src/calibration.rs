//! In-place calibration of a force/torque sensor: what it read to what acts on it.
//!
//! A sensor is calibrated on a workbench; screwed into a robot it is strained, and its board warms up. Beside its offset two things are put right here:
//!
//! ```text
//! corrected = C r - k (T - T0)          wrench = corrected - offset
//! ```
//!
//! - `r`: what its board sends, `C`: the gain, 6 by 6 (the identity if the board applies its own matrix well enough);
//! - `T`: the board's temperature \[degrees Celsius\], `k`: by how much the reading changes per kelvin [N/K, Nm/K], `T0`: where the offset is that of.
//!
//! An error of the gain is told relative to what is corrected already, `true = (1 + E) corrected`: so `E` is small, and zero if nothing is wrong.
//! Which entries of `E` and of `k` are unknown is a [`Kind`]. [`Calibration::then`] puts two corrections one after the other.
//!
//! Vectors over channels are in the order [torque; force] of [`crate::spatial`], unless it says otherwise: files and logs have [force; torque].

use crate::config::Gain;
use crate::spatial::Wrench;
use nalgebra::{Matrix6, Vector6};
use proprio_topics::Nanos;

/// Standard deviation of an offset that nobody states and nobody has identified yet, of each channel
/// [torque; force] \[Nm, N\]: no sensor is that far off, so it has no say in what is found.
pub const UNKNOWN_OFFSET: [f64; 6] = [100.0, 100.0, 100.0, 1000.0, 1000.0, 1000.0];

/// What turns a sensor's reading into a wrench with an offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    gain: Matrix6<f64>,
    per_kelvin: Wrench,
    reference: Option<f64>,
    has_gain: bool,
    has_temperature: bool,
}

impl Default for Calibration {
    /// Readings as they are.
    fn default() -> Self {
        Self::new(Matrix6::identity(), Wrench::zero(), None)
    }
}

impl Calibration {
    /// With this gain, this change of the reading per kelvin [Nm/K, N/K] and the temperature at which there is none \[degrees Celsius\]; without that
    /// temperatures are not corrected.
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

    /// By how much the reading changes per kelvin, `k` [Nm/K, N/K].
    #[must_use]
    pub fn per_kelvin(&self) -> &Wrench {
        &self.per_kelvin
    }

    /// Where there is no change, `T0` \[degrees Celsius\], if that is known.
    #[must_use]
    pub fn reference(&self) -> Option<f64> {
        self.reference
    }

    /// Whether what a board's temperature is makes any difference.
    #[must_use]
    pub fn depends_on_temperature(&self) -> bool {
        self.has_temperature
    }

    /// Variance of each channel [torque; force] [Nm^2, N^2] by what is not known of the board's temperature, which was told so long ago; `None`: never. A temperature holds for a minute,
    /// then is a kelvin less certain with every minute, up to 10 K: as much as boards warm up by within hours (an iCub's: 14 K).
    #[must_use]
    pub fn temperature_variance(&self, age: Option<Nanos>) -> [f64; 6] {
        const MOST: f64 = 10.0;
        if !self.has_temperature {
            return [0.0; 6];
        }
        let kelvin = age.map_or(MOST, |age| (age.seconds() / 60.0 - 1.0).clamp(0.0, MOST));
        self.per_kelvin.torque_first().map(|k| (k * kelvin).powi(2))
    }

    /// How far a temperature is from the reference \[K\]; 0 if either is not known.
    #[must_use]
    pub fn warmth(&self, celsius: f64) -> f64 {
        let kelvin = self.reference.map(|reference| celsius - reference);
        kelvin.filter(|kelvin| kelvin.is_finite()).unwrap_or(0.0)
    }

    /// `C r - k (T - T0)`; where the temperature is not known (NaN), it is taken to be `T0`. Where there is nothing to correct, `r` bit for bit.
    #[must_use]
    pub fn apply(&self, reading: &Wrench, celsius: f64) -> Wrench {
        let mut corrected = *reading;
        if self.has_gain {
            corrected = wrench(&(self.gain * Vector6::from(reading.torque_first())));
        }
        if self.has_temperature {
            corrected -= self.per_kelvin * self.warmth(celsius);
        }
        corrected
    }

    /// This one, and after it another that was found on what it corrects: `(1 + e) (C r - k (T - T0)) - more (T - T0)`. A reference that this one has not is taken to be `reference`.
    #[must_use]
    pub fn then(&self, e: &Matrix6<f64>, more: &Wrench, reference: Option<f64>) -> Self {
        let change = Matrix6::identity() + e;
        let own = change * Vector6::from(self.per_kelvin.torque_first());
        Self::new(change * self.gain, wrench(&own) + *more, self.reference.or(reference))
    }

    /// What [`Calibration::then`] was given to make this one of `first`: the gain's error `e` and the
    /// further change per kelvin, [torque; force]. An error of zero where `first` has no inverse.
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

/// A gain as files have it, rows and columns [force; torque]: 36 numbers row by row, or the 6 of a diagonal.
#[must_use]
pub fn gain_from_force_first(numbers: &[f64]) -> Option<Matrix6<f64>> {
    match numbers.len() {
        6 => Some(Matrix6::from_fn(|i, j| if i == j { numbers[swapped(i)] } else { 0.0 })),
        36 => Some(Matrix6::from_fn(|i, j| numbers[6 * swapped(i) + swapped(j)])),
        _ => None,
    }
}

/// Numbers of six channels, or of 36 pairs of them row by row, in the other order: [torque; force] to [force; torque] and back.
#[must_use]
pub fn force_first(numbers: &[f64]) -> Vec<f64> {
    let at = |i: usize| numbers.get(i).copied().unwrap_or(f64::NAN);
    match numbers.len() {
        36 => (0..36).map(|i| at(6 * swapped(i / 6) + swapped(i % 6))).collect(),
        count => (0..count).map(|i| at(swapped(i))).collect(),
    }
}

/// The other half of six channels: [torque; force] to [force; torque] and back.
#[must_use]
pub fn swapped(channel: usize) -> usize {
    (channel + 3) % 6
}

fn wrench(torque_first: &Vector6<f64>) -> Wrench {
    Wrench::from_torque_first((*torque_first).into())
}

/// What of a sensor's calibration is unknown, and identified.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Kind {
    /// Which entries of the gain's error.
    pub gain: Gain,
    /// Whether, too, the change per kelvin.
    pub temperature: bool,
}

/// One unknown of a sensor's calibration; channels [torque; force].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unknown {
    /// `E`: what is wrong in one channel, per unit of what is read in another (or the same).
    Gain {
        /// The channel that is wrong.
        channel: usize,
        /// The channel by whose reading.
        of: usize,
    },
    /// `k`: by how much a channel changes per kelvin.
    Temperature {
        /// The channel.
        channel: usize,
    },
}

impl Kind {
    /// Whether nothing is.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        matches!(self.gain, Gain::None | Gain::Auto) && !self.temperature
    }

    /// How many numbers are unknown.
    #[must_use]
    pub fn count(&self) -> usize {
        let gains = match self.gain {
            // Nothing until it is chosen.
            Gain::None | Gain::Auto => 0,
            Gain::Diagonal => 6,
            Gain::Full => 36,
        };
        gains + 6 * usize::from(self.temperature)
    }

    /// The unknowns in the order of their columns: entries of `E` row by row, then of `k`.
    pub fn unknowns(self) -> impl Iterator<Item = Unknown> {
        let gains = (0..6).flat_map(move |channel| {
            (0..6).filter_map(move |of| {
                let is_unknown = self.gain == Gain::Full || self.gain == Gain::Diagonal && of == channel;
                is_unknown.then_some(Unknown::Gain { channel, of })
            })
        });
        let kelvins = (0..6).filter(move |_| self.temperature);
        gains.chain(kelvins.map(|channel| Unknown::Temperature { channel }))
    }
}

impl Unknown {
    /// The channel that is wrong by it.
    #[must_use]
    pub fn channel(self) -> usize {
        match self {
            Self::Gain { channel, .. } | Self::Temperature { channel } => channel,
        }
    }

    /// By how much the *offset* of that channel seems changed per unit of this unknown, while so much is read (corrected, [torque; force]) and it is so far from the
    /// reference: a gain too small by `E` is as an offset of `-E r`, a warm board one of `k (T - T0)`.
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
        // Of what is read about x, 0.3 N/Nm is a force along x in truth.
        gain[(3, 0)] = 0.3;
        gain[(5, 5)] = 2.0;
        let calibration = Calibration::new(gain, Wrench::from_parts([0.0, 0.5, 0.0], [0.0; 3]), Some(30.0));
        let raw = Wrench::from_parts([1.0, 2.0, 3.0], [10.0, 20.0, 30.0]);
        let got = calibration.apply(&raw, 34.0);
        assert_eq!(got, Wrench::from_parts([4.0, 0.0, 6.0], [10.0, 20.0, 30.0]));
        // Without a temperature: as at the reference.
        assert_eq!(
            calibration.apply(&raw, f64::NAN),
            Wrench::from_parts([4.0, 2.0, 6.0], [10.0, 20.0, 30.0])
        );
        let text = calibration.gain_force_first();
        assert_eq!((text[3], text[14], text[0]), (0.3, 2.0, 1.0));
        assert_eq!(gain_from_force_first(&text), Some(gain));
        let diagonal = gain_from_force_first(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
        assert_eq!(diagonal.diagonal(), Vector6::new(4.0, 5.0, 6.0, 1.0, 2.0, 3.0));
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
        // A first one without a reference gets one.
        let plain = Calibration::default().then(&Matrix6::zeros(), &more, Some(20.0));
        assert_eq!(plain.apply(&raw, 21.0), raw - more);
    }

    /// What [`Unknown::as_offset`] says is the derivative of the wrench.
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
                let changed = base.then(&e, &wrench(&Vector6::from(more)), None).apply(&raw, 31.0);
                let change = (changed - corrected).torque_first();
                let expected = -1e-3 * unknown.as_offset(&corrected.torque_first(), base.warmth(31.0));
                for (channel, value) in change.into_iter().enumerate() {
                    let expected = if channel == unknown.channel() { expected } else { 0.0 };
                    assert!(
                        (value - expected).abs() < 1e-12,
                        "{unknown:?}, {channel}: {value} {expected}"
                    );
                }
            }
        }
    }
}
