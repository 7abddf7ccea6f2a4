//! JR3 and OptoForce sensors: two frames with a sequence number for each reading.

mod jr3;
mod optoforce;

use crate::rig::{FD, decode};
use proprio_drivers::{Device, Fault, Format, Frame, Id};
use proprio_topics::{Counter, Quality};

fn faults_of(faults: &[Fault]) -> Vec<(Counter, u32)> {
    faults.iter().map(|f| (f.counter, f.count)).collect()
}

/// Frames of every wrong form are counted and yield nothing.
fn wrong_frames_are_counted(device: &mut dyn Device, id: u16, short: usize) {
    let id = Id::standard(id);
    let frames = [
        Frame::new(id, &[0; 8][..short]),
        Frame::remote(id, 8),
        Frame::with_format(id, FD, &[0; 8]).unwrap(),
        Frame::with_format(id, Format::Error, &[0; 8]).unwrap(),
    ];
    let (readings, faults) = decode(device, &frames);
    assert!(readings.is_empty());
    let expected = [
        (Counter::Length, 1),
        (Counter::Length, 1),
        (Counter::Value, 1),
    ];
    assert_eq!(faults_of(&faults), expected, "{id}");
}

/// The counters of readings with the quality of each, and the faults.
type Found = (Vec<(u32, Quality)>, Vec<(Counter, u32)>);

const GOOD: Quality = Quality::DEVICE_COUNTER;
const GAP: Quality = Quality(GOOD.0 | Quality::GAP_BEFORE.0);
const FROZEN: Quality = Quality(GOOD.0 | Quality::FROZEN.0);
