//! Recognising boards by their type, or by both halves of a reading.

use super::IcubStrainOptions;
use super::frames::kind;
use crate::icub::{self, board as boards, class};
use crate::recognise::{self, Finding, Key, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::vec::Vec;

impl Recognise for IcubStrainOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [boards::STRAIN, boards::STRAIN2, boards::STRAIN2C];
        icub::recognise(seen, Self::NAME, &types, &[], |evidence, address, _| {
            let id = |kind| icub::stream(class::PERIODIC_ANALOG, address, kind);
            let mut half = |kind| evidence.sends(id(kind), |frame| matches!(frame.len(), 6 | 7));
            let calibrated = (half(kind::FORCE), half(kind::TORQUE));
            let raw = (half(kind::RAW_FORCE), half(kind::RAW_TORQUE));
            for pair in [calibrated, raw] {
                if let (Some(force), Some(torque)) = pair {
                    evidence.together(force, torque);
                    evidence.measures(force);
                } else if pair.0.is_some() || pair.1.is_some() {
                    evidence.lacks();
                }
            }
            for kind in kind::THERMOMETERS {
                evidence.sends_length(id(kind), 5);
            }
            let stream = calibrated.0.or(raw.0);
            let mut keys: Vec<Key> = Vec::new();
            keys.extend(Key::period_ms(
                stream.and_then(recognise::Stream::period),
                1,
                255,
            ));
            match (calibrated.0, raw.0) {
                (Some(_), Some(_)) => keys.push(Key::new("stream", "\"both\"")),
                (None, Some(_)) => keys.push(Key::new("stream", "\"uncalibrated\"")),
                _ => {}
            }
            (keys, Vec::new())
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
