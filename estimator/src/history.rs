//! The last samples of one channel, for values that are used as measured: the sample of an instant,
//! or a linear interpolation between two samples.

use proprio_topics::{Nanos, Quality};

/// Number of samples kept: enough for an estimate that waits for other channels, and for
/// identification, whose instants lie further back.
pub const KEPT: usize = 1024;

/// The last `K` samples of one channel, `D` numbers each; NaN where one is absent.
#[derive(Debug, Clone)]
pub struct History<const D: usize, const K: usize = KEPT> {
    samples: Box<[Entry<D>; K]>,
    /// How many were ever pushed; the newest is at `(count - 1) % K`.
    count: usize,
}

#[derive(Debug, Clone, Copy)]
struct Entry<const D: usize> {
    t: Nanos,
    value: [f64; D],
    quality: Quality,
}

/// The value of a channel at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChannelValue<const D: usize> {
    /// The value.
    pub value: [f64; D],
    /// The combined quality flags of the samples it comes from.
    pub quality: Quality,
    /// Age of the last sample up to the instant \[ns\].
    pub age: Nanos,
    /// Whether a sample is stamped with the instant itself.
    pub exact: bool,
    /// Whether a later sample was used.
    pub interpolated: bool,
}

impl<const D: usize, const K: usize> Default for History<D, K> {
    fn default() -> Self {
        let none = Entry {
            t: Nanos::MIN,
            value: [f64::NAN; D],
            quality: Quality::GOOD,
        };
        Self {
            samples: Box::new([none; K]),
            count: 0,
        }
    }
}

impl<const D: usize, const K: usize> History<D, K> {
    /// Adds a sample; its stamp must be later than the last one's.
    pub fn push(&mut self, t: Nanos, value: [f64; D], quality: Quality) {
        if let Some(place) = self.samples.get_mut(self.count % K) {
            *place = Entry { t, value, quality };
        }
        self.count += 1;
    }

    /// The stamp of the newest sample.
    #[must_use]
    pub fn newest(&self) -> Option<Nanos> {
        self.get(0).map(|e| e.t)
    }

    /// The sample that has `age` later ones.
    fn get(&self, age: usize) -> Option<&Entry<D>> {
        if age >= self.count.min(K) {
            return None;
        }
        self.samples.get((self.count - 1 - age) % K)
    }

    /// The kept samples stamped `from` to `to`, newest first.
    pub fn within(
        &self,
        from: Nanos,
        to: Nanos,
    ) -> impl ExactSizeIterator<Item = (Nanos, &[f64; D], Quality)> {
        let (newest, oldest) = (
            self.count_while(|t| t > to),
            self.count_while(|t| t >= from),
        );
        (newest..oldest.max(newest)).map(|age| {
            let entry = &self.samples[(self.count - 1 - age) % K];
            (entry.t, &entry.value, entry.quality)
        })
    }

    /// How many of the newest samples have stamps of this kind.
    fn count_while(&self, is_late: impl Fn(Nanos) -> bool) -> usize {
        let (mut low, mut high) = (0, self.count.min(K));
        while low < high {
            let middle = usize::midpoint(low, high);
            match self.get(middle).is_some_and(|entry| is_late(entry.t)) {
                true => low = middle + 1,
                false => high = middle,
            }
        }
        low
    }

    /// The value at `t`: the sample of that instant; else a linear interpolation between the last
    /// sample before and the first after, if that is stamped `until` or earlier; else the last
    /// sample before, held. `None` if there is no sample up to `t`.
    ///
    /// It depends on stamps alone, not on the time of arrival.
    #[must_use]
    pub fn at(&self, t: Nanos, until: Nanos) -> Option<ChannelValue<D>> {
        let mut after = None;
        let mut age = 0;
        let before = loop {
            let entry = self.get(age)?;
            if entry.t <= t {
                break entry;
            }
            after = Some(entry);
            age += 1;
        };
        let since = t - before.t;
        let held = ChannelValue {
            value: before.value,
            quality: before.quality,
            age: since,
            exact: since == Nanos::ZERO,
            interpolated: false,
        };
        match after {
            Some(after) if !held.exact && after.t <= until => {
                let part = since.seconds() / (after.t - before.t).seconds();
                let mut value = before.value;
                for (v, next) in value.iter_mut().zip(after.value) {
                    *v += part * (next - *v);
                }
                Some(ChannelValue {
                    value,
                    quality: before.quality | after.quality,
                    interpolated: true,
                    ..held
                })
            }
            _ => Some(held),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_exact_interpolated_or_held() {
        let mut history: History<1> = History::default();
        assert!(history.at(Nanos(5), Nanos(9)).is_none());
        history.push(Nanos(10), [1.0], Quality::GOOD);
        history.push(Nanos(20), [3.0], Quality::SATURATED);
        history.push(Nanos(30), [9.0], Quality::GOOD);
        assert!(history.at(Nanos(5), Nanos(100)).is_none());
        let at = |t, until| {
            history
                .at(Nanos(t), Nanos(until))
                .map(|h| (h.value[0], h.quality, h.exact, h.interpolated))
        };
        assert_eq!(at(10, 100), Some((1.0, Quality::GOOD, true, false)));
        assert_eq!(at(15, 100), Some((2.0, Quality::SATURATED, false, true)));
        // The next sample is later than allowed: the last one is held, whether the next has arrived
        // or not.
        assert_eq!(at(15, 19), Some((1.0, Quality::GOOD, false, false)));
        assert_eq!(at(35, 100), Some((9.0, Quality::GOOD, false, false)));
    }

    #[test]
    fn the_oldest_samples_are_dropped() {
        let mut history: History<1> = History::default();
        for i in 0..5000 {
            history.push(Nanos(i), [0.0], Quality::GOOD);
        }
        assert_eq!(history.newest(), Some(Nanos(4999)));
        assert!(history.at(Nanos(5000 - 1025), Nanos::MAX).is_none());
        assert!(history.at(Nanos(5000 - 1024), Nanos::MAX).is_some());
        let within = history.within(Nanos(0), Nanos(4000));
        assert_eq!(
            within.map(|(t, ..)| t.0).collect::<Vec<_>>(),
            (3976..=4000).rev().collect::<Vec<_>>()
        );
    }
}
