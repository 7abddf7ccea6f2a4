//! Tells apart the relative stamps of candump's screen format: from the start of the log (`-t z`)
//! or each from the line before (`-t d`).
//!
//! One step back proves nothing: on a host with several processors, and with several interfaces,
//! frames are printed a little out of order. What tells is whether the stamps climb all along.
//! Stamps since the start do; those since the line before fall as much as they rise. So the mean
//! stamps of up to 32 blocks of lines are compared one with the next. With a rise r and a fall f
//!
//! ```text
//! climb = (sum r - sum f) / (sum r + sum f)      1: only rises; about 0: as many falls
//! ```
//!
//! where the largest quarter of the steps, if they rise, is left out: the first stamp of `-t d`,
//! which is zero, or a bus that slowed down, makes such steps. A climb above 1/2 is one from the
//! start.
//!
//! The verdict is doubtful with fewer than 24 lines, and with a climb between 1/4 and 3/4. In 4000
//! made logs of each kind and of each of 11 lengths from 24 to 1000 lines (independent, periodic
//! and bursty frames; a bus that slows down; frames swapped in pairs; two interfaces in turn, one
//! read up to 20 frames late) at most 1 in 2000 was told wrong without doubt.

use super::candump::parse_line;
use super::record::{OwnedRecord, ParsedLine, StampForm};
use super::text::without_escapes;
use proprio_topics::Nanos;
use serde::Deserialize;

/// How the meaning is stated on a command line.
pub const STAMPS_OPTION: &str = "--stamps since-start or --stamps since-previous";
/// The most blocks that are compared.
const BLOCKS: usize = 32;
/// From so many stamps on a block has at least two: two interfaces that take turns have one.
const PAIRS: usize = 16;
/// The least number of stamps for a verdict without doubt.
const SURE: usize = 24;

/// The meaning of the relative stamps of a candump log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Stamps {
    /// Told by the whole log.
    #[default]
    Detect,
    /// Each counts from the start of the log (`candump -t z`, or `-t a` with a clock that was not
    /// set).
    SinceStart,
    /// Each counts from the line before (`candump -t d`).
    SincePrevious,
}

impl Stamps {
    /// The word for a meaning of relative stamps; `None` if there are none.
    #[must_use]
    pub const fn word(self) -> Option<&'static str> {
        match self {
            Self::Detect => None,
            Self::SinceStart => Some("since_start"),
            Self::SincePrevious => Some("since_previous"),
        }
    }
}

/// What the stamps of a log mean.
#[derive(Debug, PartialEq)]
pub(super) struct StampMeaning {
    pub(super) stamps: Stamps,
    /// It may be otherwise, and that would make a difference.
    pub(super) doubtful: bool,
}

/// Tells the meaning of the stamp `first` and of those in the lines that follow.
pub(super) fn judge(first: Nanos, lines: &[u8]) -> StampMeaning {
    let mut stamps = vec![first];
    let mut plain = Vec::new();
    for line in lines.split(|c| *c == b'\n') {
        plain.clear();
        plain.extend_from_slice(line);
        without_escapes(&mut plain);
        if let Ok(ParsedLine::Record(OwnedRecord {
            stamp: Some((t, StampForm::Relative)),
            ..
        })) = parse_line(&plain)
            && t.is_instant()
        {
            stamps.push(t);
        }
    }
    verdict(&stamps)
}

fn verdict(stamps: &[Nanos]) -> StampMeaning {
    let least = if stamps.len() < PAIRS { 1 } else { 2 };
    let size = stamps.len().div_ceil(BLOCKS).max(least);
    #[allow(clippy::cast_precision_loss)]
    let mean = |block: &[Nanos]| {
        let sum: i128 = block.iter().map(|t| i128::from(t.0)).sum();
        sum as f64 / block.len() as f64
    };
    let means: Vec<f64> = stamps.chunks(size).map(mean).collect();
    let pairs = means.iter().zip(means.iter().skip(1));
    let mut steps: Vec<f64> = pairs.map(|(before, after)| after - before).collect();
    steps.sort_by(f64::total_cmp);
    let (mut kept, without) = (steps.len(), steps.len().div_ceil(4));
    while kept > steps.len() - without && steps.get(kept - 1).is_some_and(|step| *step > 0.0) {
        kept -= 1;
    }
    steps.truncate(kept);
    let (net, way) = steps.iter().fold((0.0, 0.0), |(net, way), step| {
        (net + step, way + step.abs())
    });
    let same = match stamps {
        // Both ways they mean the same.
        [] | [_] | [Nanos::ZERO, _] => true,
        _ => stamps.iter().all(|t| *t == Nanos::ZERO),
    };
    // Without any step, all frames would be of one instant.
    let climb: f64 = if way > 0.0 { net / way } else { 0.0 };
    StampMeaning {
        stamps: match same || climb > 0.5 {
            true => Stamps::SinceStart,
            false => Stamps::SincePrevious,
        },
        doubtful: !same && (stamps.len() < SURE || way > 0.0 && (climb - 0.5).abs() < 0.25),
    }
}
