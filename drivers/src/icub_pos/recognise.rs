//! Recognising boards by their type, or by the labels in their frames.

use super::{IcubPosOptions, LABEL_MOST, POS, VALUES};
use crate::icub::{self, class};
use crate::recognise::{Finding, Key, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::vec::Vec;

impl Recognise for IcubPosOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [icub::board::PSC, icub::board::MTB4];
        let maybe = [icub::board::MTB4];
        icub::recognise(seen, Self::NAME, &types, &maybe, |evidence, address, _| {
            let id = icub::stream(class::PERIODIC_ANALOG, address, POS);
            let stream = evidence.sends(id, |frame| match *frame.data() {
                [quantity, values, ref bytes @ ..] if frame.len() == 8 => {
                    let count = values & 0xF;
                    let (values, _) = bytes.as_chunks();
                    let mut carried = values.iter().take(count.into());
                    // A length may be any.
                    let is_angle = |value| i16::from_le_bytes(value).unsigned_abs() <= 3600;
                    quantity < 2
                        && (1..=VALUES).contains(&count)
                        && carried.all(|value| quantity == 1 || is_angle(*value))
                }
                _ => false,
            });
            let Some(stream) = stream else {
                return (Vec::new(), Vec::from([0, 1]));
            };
            let mut keys: Vec<Key> = Vec::new();
            let mut joints: Vec<u8> = Vec::new();
            for frame in stream.kept() {
                let &[quantity, values, ..] = frame.data() else {
                    continue;
                };
                let (label, count) = (values >> 4, values & 0xF);
                joints.extend(label..(label + count).min(LABEL_MOST + 1));
                if quantity == 1 && keys.is_empty() {
                    keys.push(Key::new("quantity", "\"length\""));
                }
            }
            joints.sort_unstable();
            joints.dedup();
            let first = |frame: &Frame| {
                let label = frame.data().get(1).map(|values| values >> 4);
                label == joints.first().copied()
            };
            keys.extend(Key::period_ms(stream.period_of(first), 1, 255));
            (keys, joints)
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
