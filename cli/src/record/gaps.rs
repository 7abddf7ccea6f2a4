//! Finds the times of a recording without samples.

use proprio_topics::{Description, Nanos};

/// A time without samples.
struct Gap {
    from: Nanos,
    to: Nanos,
    restarted: bool,
}

impl Gap {
    fn seconds(&self) -> f64 {
        (self.to - self.from).seconds()
    }
}

/// Finds the times without samples.
pub(super) struct Gaps {
    /// Longer than between two samples of the slowest channel.
    silence: Nanos,
    /// The start of the gateway that sends, and the stamp of its newest sample.
    last: Option<(u64, Nanos)>,
    found: Vec<Gap>,
    /// That nothing comes has been told.
    told: bool,
}

impl Gaps {
    pub(super) fn new(description: &Description) -> Self {
        let slowest = description.entries().iter().map(|entry| entry.max_silence);
        let slowest = slowest.max().unwrap_or_default();
        Self {
            silence: Nanos::from_millis(500).max(slowest + slowest),
            last: None,
            found: Vec::new(),
            told: false,
        }
    }

    /// A sample of the start `epoch` of the gateway, acquired at `t`.
    pub(super) fn see(&mut self, epoch: u64, t: Nanos) {
        if let Some((of, from)) = self.last {
            let gap = Gap {
                from,
                to: t,
                restarted: epoch != of,
            };
            if gap.restarted || t - from > self.silence {
                let why = match gap.restarted {
                    true => "the gateway was restarted",
                    false => "no channel had a sample",
                };
                tracing::warn!("{why}: a gap of {:.3} s after {from} s", gap.seconds());
                self.found.push(gap);
            }
        }
        let newest = self
            .last
            .filter(|(of, _)| *of == epoch)
            .map_or(t, |(_, last)| last.max(t));
        (self.last, self.told) = (Some((epoch, newest)), false);
    }

    /// Nothing came until `now`: tells it, once, and returns true then.
    pub(super) fn wait(&mut self, now: Nanos) -> bool {
        if let Some((_, last)) = self.last
            && now - last > self.silence
            && !std::mem::replace(&mut self.told, true)
        {
            tracing::warn!(
                "no samples since {last} s; recording goes on when they come (`proprio status`)"
            );
            return true;
        }
        false
    }

    /// What to say of them when the recording ends at `end`; empty if there are none.
    pub(super) fn summary(&self, end: Nanos) -> String {
        let seconds = |gaps: &mut dyn Iterator<Item = &Gap>| gaps.map(Gap::seconds).sum::<f64>();
        let mut parts = Vec::new();
        let restarts = || self.found.iter().filter(|gap| gap.restarted);
        let others = || self.found.iter().filter(|gap| !gap.restarted);
        if restarts().count() > 0 {
            let (count, time) = (restarts().count(), seconds(&mut restarts()));
            parts.push(format!("{count} restarts of the gateway ({time:.3} s)"));
        }
        if others().count() > 0 {
            let (count, time) = (others().count(), seconds(&mut others()));
            parts.push(format!("{count} silences of all channels ({time:.3} s)"));
        }
        match self.last {
            Some((_, last)) if end - last > self.silence => {
                parts.push(format!("none in the last {:.3} s", (end - last).seconds()));
            }
            _ => {}
        }
        match parts.is_empty() {
            true => String::new(),
            false => format!("times without samples: {}", parts.join(", ")),
        }
    }
}
