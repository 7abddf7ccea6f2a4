//! Recognising boards by their type, or by the frames of their joints.

use super::{FRAME, IcubMc4Options, MODES, kind};
use crate::icub::{self, class};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::vec::Vec;

impl Recognise for IcubMc4Options {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [icub::board::MC4, icub::board::BLL];
        icub::recognise(seen, Self::NAME, &types, &[], |evidence, address, _| {
            let id = |kind| icub::stream(class::PERIODIC_MOTOR, address, kind);
            let positions = evidence.sends_length(id(kind::POSITION), FRAME);
            // Newer boards have a status of the same identifier.
            if let Some(positions) = positions {
                if let Some(velocities) = evidence.sends_length(id(kind::VELOCITY), FRAME) {
                    evidence.together(velocities, positions);
                }
                evidence.sends(id(kind::STATUS), |frame| match *frame.data() {
                    [_, a, _, b, _, _, _, _] => MODES.contains(&a) && MODES.contains(&b),
                    _ => false,
                });
            }
            let keys = Key::period_ms(positions.and_then(Stream::period), 1, 255);
            (keys.into_iter().collect(), Vec::from([0, 1]))
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
