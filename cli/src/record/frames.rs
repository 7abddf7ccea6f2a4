//! The raw frames of buses, heard beside the gateway by sockets of this program's own.

use crate::scan::open_bus;
use anyhow::Context;
use proprio_drivers::Frame;
use proprio_gateway::link::{Link as _, ListenOnly, Received};
use proprio_simulator::parse_bus;
use proprio_topics::Nanos;
use proprio_topics::ipc::{DomainConfig, monotonic};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread;

/// Frames that wait to be recorded: half a second of eight full buses.
const WAITING: usize = 1 << 16;
/// How often a thread looks whether it shall end.
const TURN: Nanos = Nanos::from_millis(100);

/// Hears buses, each in a thread of its own.
pub(super) struct RawFrames {
    /// Their names.
    pub(super) buses: Vec<String>,
    frames: Receiver<(usize, Frame)>,
    lost: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

impl RawFrames {
    /// Of these buses: can0, or virtual:NAME.
    pub(super) fn open(buses: &[String], domain: &DomainConfig) -> anyhow::Result<Self> {
        let (sender, frames) = sync_channel(WAITING);
        let mut all = Self {
            buses: Vec::new(),
            frames,
            lost: Arc::default(),
            stop: Arc::default(),
        };
        for (number, bus) in buses.iter().enumerate() {
            let source = parse_bus(bus)?;
            let opened = open_bus(&source, domain).with_context(|| format!("bus {bus}"))?;
            let (link, interface) = opened;
            // A virtual bus has the name after `virtual:`.
            let name = bus.split_once(':').map_or(bus.as_str(), |(_, name)| name);
            all.buses.push(interface.unwrap_or_else(|| name.to_owned()));
            let mut bus = BusListener {
                number,
                link: ListenOnly(link),
                sender: sender.clone(),
                lost: Arc::clone(&all.lost),
                stop: Arc::clone(&all.stop),
            };
            thread::Builder::new()
                .name("frames".into())
                .spawn(move || bus.run())?;
        }
        Ok(all)
    }

    /// A frame that waits, with the number of its bus.
    pub(super) fn next(&self) -> Option<(usize, Frame)> {
        self.frames.try_recv().ok()
    }

    /// Frames that came too fast to be recorded.
    pub(super) fn lost(&self) -> u64 {
        self.lost.load(Relaxed)
    }
}

impl Drop for RawFrames {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
    }
}

/// The thread of a bus.
struct BusListener {
    number: usize,
    link: ListenOnly,
    sender: SyncSender<(usize, Frame)>,
    lost: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

impl BusListener {
    fn run(&mut self) {
        let mut dropped = 0;
        while !self.stop.load(Relaxed) {
            match self.link.recv(monotonic() + TURN) {
                Received::Frame(frame) | Received::Error(frame) => {
                    match self.sender.try_send((self.number, frame)) {
                        Ok(()) => {}
                        Err(TrySendError::Full(_)) => {
                            self.lost.fetch_add(1, Relaxed);
                        }
                        Err(TrySendError::Disconnected(_)) => return,
                    }
                }
                Received::Ended => return,
                Received::TimedOut | Received::StateChanged => {}
            }
            let now = self.link.counters().dropped;
            self.lost.fetch_add(now - dropped, Relaxed);
            dropped = now;
        }
    }
}
