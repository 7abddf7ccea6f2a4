//! Recognising boards by their type, or by pairs of frames of a triangle.

use super::{FIRST, IcubSkinOptions, SECOND};
use crate::icub::{self, class};
use crate::recognise::{Finding, Key, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::format;
use alloc::vec::Vec;

impl Recognise for IcubSkinOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        // An mtb4 may be an IMU alone.
        let maybe = [icub::board::MTB4, icub::board::MTB4W, icub::board::MTB4C];
        let types = [&[icub::board::MTB][..], &maybe].concat();
        icub::recognise(seen, Self::NAME, &types, &maybe, |evidence, address, _| {
            let mut keys: Vec<Key> = Vec::new();
            let mut triangles: Option<(u8, u8)> = None;
            for triangle in 0..16 {
                let id = icub::stream(class::PERIODIC_SKIN, address, triangle);
                let stream = evidence.sends(id, |frame| {
                    matches!(*frame.data(), [FIRST | SECOND, _, _, _, _, _, _, _])
                });
                let Some(stream) = stream else { continue };
                let first = |frame: &Frame| frame.data().first() == Some(&FIRST);
                if triangles.is_none() {
                    keys.extend(Key::period_ms(stream.period_of(first), 1, 255));
                }
                triangles = Some((triangles.map_or(triangle, |(first, _)| first), triangle));
            }
            if let Some((first, last)) = triangles {
                keys.push(Key::new("triangles", format!("[{first}, {last}]")));
            }
            (keys, Vec::new())
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
