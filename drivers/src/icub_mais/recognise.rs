//! Recognising boards by their type, or by their two frames.

use super::{HES0TO6, HES7TO14, IcubMaisOptions, SECOND, SENSORS};
use crate::icub::{self, class};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::vec::Vec;

impl Recognise for IcubMaisOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        icub::recognise(
            seen,
            Self::NAME,
            &[icub::board::MAIS],
            &[],
            |evidence, address, _| {
                let id = |kind| icub::stream(class::PERIODIC_ANALOG, address, kind);
                let first = evidence.sends_length(id(HES0TO6), usize::from(SECOND));
                let second = evidence.sends_length(id(HES7TO14), usize::from(SENSORS - SECOND));
                if let (Some(first), Some(second)) = (first, second) {
                    evidence.together(first, second);
                } else if first.is_some() || second.is_some() {
                    evidence.lacks();
                }
                let keys = Key::period_ms(first.and_then(Stream::period), 1, 255);
                (keys.into_iter().collect(), (0..SENSORS).collect())
            },
        )
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
