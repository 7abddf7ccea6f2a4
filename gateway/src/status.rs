//! The counters of a bus thread, which the control plane reads without a lock: one writer, relaxed
//! atomics.

use crate::link::LinkCounters;
use crate::plan::BusPlan;
use proprio_drivers::State;
use proprio_topics::{BusHealth, Code, Counter, DeviceHealth, LinkState, Name, Nanos, Refusal};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicI64, AtomicU32, AtomicU64};

/// The counters of one bus.
#[derive(Debug)]
pub struct BusStatus {
    name: Name,
    number: u32,
    /// Frames passed to the devices.
    pub frames: AtomicU64,
    /// Frames that no device claims.
    pub unclaimed: AtomicU64,
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
    link: [AtomicU64; 5],
    link_state: AtomicU32,
    devices: Vec<DeviceStatus>,
}

#[derive(Debug)]
struct DeviceStatus {
    name: Name,
    counters: [AtomicU64; Counter::ALL.len()],
    state: AtomicU32,
    refusal: AtomicU32,
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
        });
        Self {
            name: name(&plan.name),
            number,
            frames: AtomicU64::new(0),
            unclaimed: AtomicU64::new(0),
            published: AtomicU64::new(0),
            publish_failures: AtomicU64::new(0),
            connections: AtomicU64::new(0),
            last_frame: AtomicI64::new(Nanos::MIN.0),
            last_turn: AtomicI64::new(Nanos::MIN.0),
            link: [const { AtomicU64::new(0) }; 5],
            link_state: AtomicU32::new(LinkState::Up as u32),
            devices: devices.collect(),
        }
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

    /// Sets the state of a device.
    pub fn set_state(&self, device: u16, state: State) {
        if let Some(status) = self.devices.get(usize::from(device)) {
            let refusal = state.refusal().map_or(0, Refusal::code);
            status.state.store(state.published() as u32, Relaxed);
            status.refusal.store(refusal, Relaxed);
        }
    }

    /// Copies the link's state and counters.
    pub fn set_link(&self, state: LinkState, counters: &LinkCounters) {
        let LinkCounters {
            dropped,
            error_frames,
            sent,
            send_failures,
            losses,
            received: _,
        } = *counters;
        for (cell, value) in
            self.link
                .iter()
                .zip([dropped, error_frames, sent, send_failures, losses])
        {
            cell.store(value, Relaxed);
        }
        self.link_state.store(state as u32, Relaxed);
    }

    /// The bus's part of the health message.
    #[must_use]
    pub fn bus(&self) -> BusHealth {
        let [dropped, error_frames, sent, send_failures, link_losses] =
            [0, 1, 2, 3, 4].map(|i| self.link.get(i).map_or(0, |c: &AtomicU64| c.load(Relaxed)));
        BusHealth {
            name: self.name,
            frames: self.frames.load(Relaxed),
            unclaimed: self.unclaimed.load(Relaxed),
            dropped,
            error_frames,
            sent,
            send_failures,
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
            DeviceHealth {
                name: d.name,
                counters,
                state: Code::of_number(d.state.load(Relaxed)),
                refusal: d.refusal.load(Relaxed),
                bus: self.number,
                reserved: 0,
            }
        })
    }
}
