//! The counters of a bus thread, which the control plane reads without a lock: one writer, relaxed
//! atomics.

use crate::link::LinkCounters;
use crate::link::error_frame::ErrorFrame;
use crate::load::{Totals, WireBits, bits_on_wire};
use crate::plan::BusPlan;
use proprio_drivers::{Device, Frame, State};
use proprio_topics::{
    BusError, BusHealth, Code, Counter, DeviceHealth, LinkState, MAX_CHANNELS, Name, Nanos, Refusal,
};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicI64, AtomicU32, AtomicU64, Ordering, fence};

/// The counters of one bus.
#[derive(Debug)]
pub struct BusStatus {
    name: Name,
    number: u32,
    /// Frames passed to the devices.
    pub frames: AtomicU64,
    /// The most bits of the frames received and sent: nominal, and of the data phase of CAN FD.
    bits: [AtomicU64; 2],
    /// Frames that no device claims.
    pub unclaimed: AtomicU64,
    /// Frames that were not sent.
    pub send_failures: AtomicU64,
    /// Attempts to send that found the link's queue full.
    pub queue_full: AtomicU64,
    /// Samples published.
    pub published: AtomicU64,
    /// Samples not published.
    pub publish_failures: AtomicU64,
    /// Reader connections made while publishing.
    pub connections: AtomicU64,
    /// Stamp of the last frame.
    pub last_frame: AtomicI64,
    /// Time of the last turn of the loop.
    pub last_turn: AtomicI64,
    link: [AtomicU64; 4],
    link_state: AtomicU32,
    errors: [ErrorStatus; BusError::ALL.len()],
    devices: Vec<DeviceStatus>,
    /// When the newest sample of each channel was acquired.
    newest: [AtomicI64; MAX_CHANNELS],
}

/// The number of error frames with one cause, and the newest of them.
#[derive(Debug, Default)]
struct ErrorStatus {
    /// Twice the number; odd while the newest frame is being written.
    version: AtomicU64,
    classes: AtomicU32,
    data: AtomicU64,
}

impl ErrorStatus {
    /// Counts and keeps `frame`. For one writer.
    fn record(&self, frame: ErrorFrame) {
        let version = self.version.load(Relaxed);
        self.version.store(version + 1, Relaxed);
        fence(Ordering::Release);
        self.classes.store(frame.classes, Relaxed);
        self.data.store(u64::from_ne_bytes(frame.data), Relaxed);
        self.version.store(version + 2, Ordering::Release);
    }

    fn count(&self) -> u64 {
        self.version.load(Relaxed) / 2
    }

    /// The newest frame; `None` before the first, and if the next one is being written.
    fn newest(&self) -> Option<ErrorFrame> {
        let version = self.version.load(Ordering::Acquire);
        let frame = ErrorFrame {
            classes: self.classes.load(Relaxed),
            data: self.data.load(Relaxed).to_ne_bytes(),
        };
        fence(Ordering::Acquire);
        (version >= 2 && version.is_multiple_of(2) && self.version.load(Relaxed) == version)
            .then_some(frame)
    }
}

#[derive(Debug)]
struct DeviceStatus {
    name: Name,
    counters: [AtomicU64; Counter::ALL.len()],
    state: AtomicU32,
    refusal: AtomicU32,
    /// The frozen axes in the lower half, those beyond the full scale in the upper.
    axes: AtomicU32,
}

impl BusStatus {
    /// Zero counters for bus number `number`.
    #[must_use]
    pub fn new(number: u32, plan: &BusPlan) -> Self {
        let name = |n: &str| Name::new(n).unwrap_or(Name::EMPTY);
        let devices = plan.devices.iter().map(|d| DeviceStatus {
            name: name(&d.name),
            counters: [const { AtomicU64::new(0) }; Counter::ALL.len()],
            state: AtomicU32::new(0),
            refusal: AtomicU32::new(0),
            axes: AtomicU32::new(0),
        });
        Self {
            name: name(&plan.name),
            number,
            frames: AtomicU64::new(0),
            bits: Default::default(),
            unclaimed: AtomicU64::new(0),
            send_failures: AtomicU64::new(0),
            queue_full: AtomicU64::new(0),
            published: AtomicU64::new(0),
            publish_failures: AtomicU64::new(0),
            connections: AtomicU64::new(0),
            last_frame: AtomicI64::new(Nanos::MIN.0),
            last_turn: AtomicI64::new(Nanos::MIN.0),
            link: [const { AtomicU64::new(0) }; 4],
            link_state: AtomicU32::new(LinkState::Up as u32),
            errors: Default::default(),
            devices: devices.collect(),
            newest: [const { AtomicI64::new(i64::MIN) }; MAX_CHANNELS],
        }
    }

    /// A sample of `channel`, acquired at `t`, was published.
    pub fn set_newest(&self, channel: u32, t: Nanos) {
        if let Some(newest) = self.newest.get(channel as usize) {
            newest.store(t.0, Relaxed);
        }
    }

    /// When the newest sample of each channel was acquired; [`Nanos::MIN`] for a channel that had
    /// none, or is not of this bus.
    pub fn newest(&self) -> impl Iterator<Item = Nanos> {
        self.newest.iter().map(|t| Nanos(t.load(Relaxed)))
    }

    /// Adds `n` to a counter of a device.
    pub fn count(&self, device: u16, counter: Counter, n: u64) {
        if let Some(cell) = self
            .devices
            .get(usize::from(device))
            .and_then(|d| d.counters.get(counter as usize))
        {
            cell.fetch_add(n, Relaxed);
        }
    }

    /// Sets the state of a device, and what is told of it.
    pub(crate) fn set_state(&self, device: u16, now: &dyn Device) {
        if let Some(status) = self.devices.get(usize::from(device)) {
            let state = now.state();
            let lacks = now.lacks().filter(|_| state == State::Streaming);
            let refusal = state.refusal().or(lacks).map_or(0, Refusal::code);
            status.state.store(state.published() as u32, Relaxed);
            status.refusal.store(refusal, Relaxed);
            if state != State::Streaming {
                // Nothing is known of readings that do not come.
                status.axes.store(0, Relaxed);
            }
        }
    }

    /// Sets which axes of an F/T sensor are frozen, and which are beyond its full scale.
    pub(crate) fn set_axes(&self, device: u16, frozen: u16, beyond: u16) {
        if let Some(status) = self.devices.get(usize::from(device)) {
            let axes = u32::from(frozen) | u32::from(beyond) << 16;
            status.axes.store(axes, Relaxed);
        }
    }

    /// Counts what `frame`, received or sent, can have taken of the bus. For one writer.
    pub(crate) fn on_wire(&self, frame: &Frame) {
        let WireBits { nominal, data } = bits_on_wire(frame);
        for (cell, bits) in self
            .bits
            .iter()
            .zip([nominal, data])
            .filter(|(_, b)| *b > 0)
        {
            cell.store(cell.load(Relaxed) + u64::from(bits), Relaxed);
        }
    }

    /// The frames so far and their bits, without what the kernel tells of the interface.
    #[must_use]
    pub fn totals(&self) -> Totals {
        let [nominal_bits, data_bits] = self.bits.each_ref().map(|cell| cell.load(Relaxed));
        let [_, _, sent, _] = self.link.each_ref().map(|cell| cell.load(Relaxed));
        Totals {
            frames: self.frames.load(Relaxed) + sent,
            nominal_bits,
            data_bits,
            ..Totals::default()
        }
    }

    /// Copies the link's state and counters.
    pub(crate) fn set_link(&self, state: LinkState, counters: &LinkCounters) {
        let LinkCounters {
            dropped,
            error_frames,
            sent,
            losses,
            received: _,
        } = *counters;
        for (cell, value) in self.link.iter().zip([dropped, error_frames, sent, losses]) {
            cell.store(value, Relaxed);
        }
        self.link_state.store(state as u32, Relaxed);
    }

    /// Counts an error frame under each of its causes.
    pub(crate) fn record_error(&self, frame: ErrorFrame) {
        for cause in frame.causes() {
            if let Some(status) = self.errors.get(cause as usize) {
                status.record(frame);
            }
        }
    }

    /// The newest error frame with `cause`; `None` before the first, and for an instant while the
    /// bus thread writes the next.
    #[must_use]
    pub fn newest_error(&self, cause: BusError) -> Option<ErrorFrame> {
        self.errors
            .get(cause as usize)
            .and_then(ErrorStatus::newest)
    }

    /// The bus's part of the health message, without what the kernel tells of the interface.
    #[must_use]
    pub fn bus(&self) -> BusHealth {
        let errors = self.errors.each_ref().map(ErrorStatus::count);
        let overflows = errors
            .get(BusError::RxOverflow as usize)
            .copied()
            .unwrap_or(0);
        let [dropped, error_frames, sent, link_losses] =
            [0, 1, 2, 3].map(|i| self.link.get(i).map_or(0, |c: &AtomicU64| c.load(Relaxed)));
        BusHealth {
            name: self.name,
            frames: self.frames.load(Relaxed),
            unclaimed: self.unclaimed.load(Relaxed),
            // The controller tells of an overflow, not of the number of frames: at least one.
            dropped: dropped + overflows,
            error_frames,
            errors,
            sent,
            send_failures: self.send_failures.load(Relaxed),
            queue_full: self.queue_full.load(Relaxed),
            link_losses,
            published: self.published.load(Relaxed),
            publish_failures: self.publish_failures.load(Relaxed),
            connections: self.connections.load(Relaxed),
            last_frame: Nanos(self.last_frame.load(Relaxed)),
            last_turn: Nanos(self.last_turn.load(Relaxed)),
            link: Code::of_number(self.link_state.load(Relaxed)),
            ..BusHealth::EMPTY
        }
    }

    /// The devices' parts of the health message.
    pub fn devices(&self) -> impl Iterator<Item = DeviceHealth> + '_ {
        self.devices.iter().map(|d| {
            let mut counters = [0; Counter::ALL.len()];
            counters
                .iter_mut()
                .zip(&d.counters)
                .for_each(|(to, from)| *to = from.load(Relaxed));
            let [f0, f1, b0, b1] = d.axes.load(Relaxed).to_le_bytes();
            DeviceHealth {
                name: d.name,
                counters,
                state: Code::of_number(d.state.load(Relaxed)),
                refusal: d.refusal.load(Relaxed),
                bus: self.number,
                frozen_axes: u16::from_le_bytes([f0, f1]),
                beyond_axes: u16::from_le_bytes([b0, b1]),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;
    use std::path::Path;
    use std::sync::atomic::AtomicBool;

    fn status() -> BusStatus {
        let text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                    source = { kind = \"virtual\", name = \"b\" }\n";
        let plan = Plan::parse(text, Path::new(".")).unwrap();
        BusStatus::new(0, &plan.buses[0])
    }

    const fn controller(bits: u8, mark: u8) -> ErrorFrame {
        ErrorFrame {
            classes: libc::CAN_ERR_CRTL,
            data: [0, bits, 0, 0, 0, 0, mark, mark],
        }
    }

    #[test]
    fn every_cause_is_counted_and_its_newest_frame_kept() {
        let status = status();
        assert_eq!(status.newest_error(BusError::Warning), None);
        status.record_error(controller(0x0C, 1));
        // A warning and an overflow.
        status.record_error(controller(0x05, 2));
        status.record_error(controller(0x30, 3));
        let health = status.bus();
        let count = |cause: BusError| health.errors[cause as usize];
        assert_eq!(
            [BusError::Warning, BusError::Passive, BusError::RxOverflow].map(count),
            [2, 1, 1]
        );
        assert_eq!(health.errors.iter().sum::<u64>(), 4);
        assert_eq!(health.dropped, 1, "an overflow has lost a frame");
        let newest = |cause| status.newest_error(cause).map(|f| f.data[7]);
        assert_eq!(
            [BusError::Warning, BusError::Passive, BusError::Bus].map(newest),
            [Some(2), Some(3), None]
        );
    }

    /// Classes and data of one frame are never mixed with those of another.
    #[test]
    fn the_newest_frame_is_read_whole() {
        let (status, stop) = (status(), AtomicBool::new(false));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for i in (0..=0xFF_u8).cycle().take(200_000) {
                    status.record_error(ErrorFrame {
                        classes: libc::CAN_ERR_ACK | u32::from(i) << 16,
                        data: [i; 8],
                    });
                }
                stop.store(true, Relaxed);
            });
            while !stop.load(Relaxed) {
                if let Some(frame) = status.newest_error(BusError::NoAck) {
                    let [first, ..] = frame.data;
                    assert_eq!(frame.data, [first; 8]);
                    assert_eq!(frame.classes >> 16, u32::from(first));
                }
            }
        });
        assert_eq!(status.bus().errors[BusError::NoAck as usize], 200_000);
    }
}
