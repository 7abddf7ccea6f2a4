//! Wrenches and proper accelerations at an instant after their last sample, for estimates that do
//! not wait for it.

use crate::differentiate::{Grid, Settings, Window};
use proprio_topics::Nanos;

/// Extrapolates the `D` numbers of a channel: the adaptive window of [`crate::differentiate`], in
/// units of each number's own noise.
pub(super) struct Predictor<const D: usize> {
    window: Box<Window<D>>,
    /// Peak noise of each number.
    noise: [f64; D],
}

/// Values at an instant after the last sample, and their standard deviations.
pub(super) struct Extrapolated<const D: usize> {
    pub(super) value: [f64; D],
    pub(super) std: [f64; D],
}

impl<const D: usize> Predictor<D> {
    /// A predictor without samples. `noise` is the peak noise of each number, as in
    /// [`Settings::noise`], which is ignored; the samples may show more. None if it is not
    /// positive.
    pub(super) fn new(noise: [f64; D], settings: Settings) -> Option<Self> {
        let window = Window::new(Settings {
            noise: 1.0,
            ..settings
        });
        let is_valid = noise.iter().all(|x| x.is_finite() && *x > 0.0);
        let window = window.ok().filter(|_| is_valid)?;
        Some(Self {
            window: Box::new(window),
            noise,
        })
    }

    /// Takes a sample. One that is not good is left out; it and one that does not continue those
    /// before separate them from what follows.
    pub(super) fn push(&mut self, t: Nanos, value: &[f64; D], is_good: bool, is_continued: bool) {
        if !is_continued {
            self.window.interrupt();
        }
        if is_good {
            let scaled = std::array::from_fn(|i| value[i] / self.noise[i]);
            let _ = self.window.push(t, scaled);
        } else {
            self.window.interrupt();
        }
    }

    /// The values at `t`, after the last sample. None if too few samples are at hand, or the last
    /// one is too old.
    pub(super) fn at(&self, t: Nanos, grid: &mut Grid) -> Option<Extrapolated<D>> {
        let estimate = self.window.at_sharing(t, t, grid).ok()?;
        let scaled = |x: [f64; D]| std::array::from_fn(|i| x[i] * self.noise[i]);
        Some(Extrapolated {
            value: scaled(estimate.value),
            std: scaled(estimate.value_std),
        })
    }
}
