//! Recognising boards by their type, or by positions and states.

use super::{IcubMotorOptions, kind, mode};
use crate::icub::{self, class};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::vec::Vec;

impl Recognise for IcubMotorOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [
            icub::board::TWO_FOC,
            icub::board::AMCBLDC,
            icub::board::AMC2C,
            icub::board::AMCFOC2C,
        ];
        icub::recognise(seen, Self::NAME, &types, &[], |evidence, address, _| {
            let id = |kind| icub::stream(class::PERIODIC_MOTOR, address, kind);
            let motion = evidence.sends_length(id(kind::TWO_FOC), 8);
            let is_status = |frame: &Frame| match *frame.data() {
                [mode, encoder, _, _, _, _, _, _] => {
                    mode::ALL.contains(&u32::from(mode)) && encoder < 32
                }
                _ => false,
            };
            // Older boards have a status of the same identifier.
            if let Some(motion) = motion {
                if let Some(status) = evidence.sends(id(kind::STATUS), is_status) {
                    evidence.together(motion, status);
                }
                evidence.sends_length(id(kind::ADDITIONAL_STATUS), 4);
            }
            let keys = Key::period_ms(motion.and_then(Stream::period), 1, 255);
            (keys.into_iter().collect(), Vec::from([0]))
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
