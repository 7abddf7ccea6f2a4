//! Recognising sensors by forces and torques on the identifiers that they are delivered with.

use super::{AidinAft200Options, COMMAND, FULL_SCALE, NEWTON, NEWTON_METRE, axes, command};
use crate::recognise::{Evidence, Finding, Key, Traffic};
use crate::{Driver, Frame, Id, Recognise};
use alloc::vec::Vec;
use proprio_topics::Quality;

impl Recognise for AidinAft200Options {
    /// By the identifiers of delivery, with forces and torques that it can measure.
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let mut evidence = Evidence::new(seen, 1);
        let keys = Self::default();
        let half = |scale: (f64, f64), most: f64| {
            move |frame: &Frame| match frame.data().first_chunk() {
                Some(&half) => {
                    let mut quality = Quality::GOOD;
                    let values = axes(half, scale, 0, &mut quality);
                    frame.len() <= 8 && values.iter().all(|value| value.abs() <= most)
                }
                None => false,
            }
        };
        let force = evidence.sends(Id::standard(keys.id_force), half(NEWTON, FULL_SCALE.0));
        let torque = evidence.sends(
            Id::standard(keys.id_torque),
            half(NEWTON_METRE, FULL_SCALE.1),
        );
        let (Some(force), Some(torque)) = (force, torque) else {
            return Vec::new();
        };
        evidence.together(force, torque);
        evidence.measures(force);
        evidence.measures(torque);
        evidence.sends(COMMAND, |frame| match *frame.data() {
            [number, command, ..] => {
                let known = (command::TRANSMIT..=command::PERIOD).contains(&command);
                number > 0 && known && frame.len() == 8
            }
            _ => false,
        });
        let finding = evidence.finding(Self::NAME, 1, "AIDIN AFT200");
        let period = Key::period_ms(force.period(), 1, 65);
        (finding
            .into_iter()
            .map(|finding| finding.with_keys(period.clone())))
        .collect()
    }
}
