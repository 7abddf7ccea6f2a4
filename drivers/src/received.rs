//! A frame from the bus, and where what it tells goes.

use crate::{Decoded, Format, Frame, StampedReading};
use core::ops::Deref;
use proprio_topics::{Counter, Quality, Reading, Temperature};

/// A frame from the bus. What a family reads in it, and the faults that it shows, are added to the
/// result of decoding it.
#[derive(Debug)]
pub(crate) struct Received<'a> {
    frame: &'a Frame,
    out: &'a mut Decoded,
}

impl Deref for Received<'_> {
    type Target = Frame;

    fn deref(&self) -> &Frame {
        self.frame
    }
}

impl<'a> Received<'a> {
    pub(crate) const fn new(frame: &'a Frame, out: &'a mut Decoded) -> Self {
        Self { frame, out }
    }

    /// Its bytes, whatever kind of frame it is.
    pub(crate) fn data(&self) -> &'a [u8] {
        self.frame.data()
    }

    /// The payload of a classic data frame. Other frames are counted, except error frames, which
    /// belong to no device.
    pub(crate) fn payload(&mut self) -> Option<&'a [u8]> {
        match self.format {
            Format::Classic => return Some(self.data()),
            Format::Fd { .. } => self.fault(Counter::Value),
            Format::Remote => self.fault(Counter::Length),
            Format::Error => {}
        }
        None
    }

    /// As [`Received::payload`], of a frame with `length` bytes: others are counted, too.
    pub(crate) fn payload_of(&mut self, length: usize) -> Option<&'a [u8]> {
        let data = self.payload()?;
        if data.len() != length {
            self.fault(Counter::Length);
            return None;
        }
        Some(data)
    }

    /// The payload of a data frame, classic or CAN FD. Other frames are counted, except error
    /// frames.
    pub(crate) fn fd_payload(&mut self) -> Option<&'a [u8]> {
        match self.format {
            Format::Fd { .. } => Some(self.data()),
            _ => self.payload(),
        }
    }

    /// Counts a fault.
    pub(crate) fn fault(&mut self, counter: Counter) {
        self.faults(counter, 1);
    }

    /// Counts `count` faults.
    pub(crate) fn faults(&mut self, counter: Counter, count: u32) {
        self.out.fault(counter, count, self.frame.id);
    }

    /// Counts the faults in `quality`.
    pub(crate) fn faults_in(&mut self, quality: Quality) {
        for (flag, counter) in [
            (Quality::SATURATED, Counter::Saturated),
            (Quality::DEVICE_FAULT, Counter::DeviceFault),
            (Quality::DRIVE_FAULT, Counter::DriveFault),
        ] {
            if quality.contains(flag) {
                self.fault(counter);
            }
        }
    }

    /// Adds a reading that it completes.
    pub(crate) fn push(&mut self, stamped: StampedReading) {
        self.out.push(stamped, self.frame.id);
    }

    /// Adds a reading that it holds.
    pub(crate) fn tell(&mut self, output: u8, quality: Quality, reading: Reading) {
        self.push(StampedReading::new(output, self, quality, reading));
    }

    /// Adds the reading of a thermometer, if there is one.
    pub(crate) fn temperature(&mut self, output: u8, celsius: f64) {
        if celsius.is_finite() {
            let reading = Reading::Temperature(Temperature { celsius });
            self.tell(output, Quality::GOOD, reading);
        }
    }
}
