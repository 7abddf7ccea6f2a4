//! The data plane of one bus: the loop that moves frames from the link through the devices to the sink, and sends what
//! the devices want sent. One thread owns it all; it allocates nothing after start, takes no lock, and waits only for
//! frames, at most [`MAX_TURN`] at a time.

use crate::clock::Clock;
use crate::decoder::Decoder;
use crate::link::{Link, Received};
use crate::publish::Sink;
use crate::status::BusStatus;
use proprio_topics::{LinkState, Nanos};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// The longest that one turn of the loop waits: the watchdog wants a sign of life every 100 ms, frames or not.
pub const MAX_TURN: Nanos = Nanos::from_millis(50);

/// How long the devices get to stop before the link is closed all the same.
pub const STOP_TIME: Nanos = Nanos::from_millis(200);

/// One bus, running.
pub struct Bus<S> {
    link: Box<dyn Link>,
    decoder: Decoder,
    sink: S,
    status: Arc<BusStatus>,
    link_was_up: bool,
    /// The stamp of the frame taken last, as long as more may be waiting behind it.
    heard: Option<Nanos>,
}

/// Whether there is more to come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// Go on.
    Continue,
    /// The log has come to its end.
    Ended,
}

impl<S: Sink> Bus<S> {
    /// Puts link, devices and sink together.
    pub fn new(link: Box<dyn Link>, decoder: Decoder, sink: S, status: Arc<BusStatus>) -> Self {
        let link_was_up = link.state() == LinkState::Up;
        Self {
            link,
            decoder,
            sink,
            status,
            link_was_up,
            heard: None,
        }
    }

    /// One turn: send what is due, wait for a frame, take it.
    pub fn turn(&mut self, clock: &impl Clock) -> Turn {
        let now = clock.now();
        self.status.last_turn.store(now.0, Relaxed);
        let mut deadline = now + MAX_TURN;
        if self.link.state() == LinkState::Up {
            if !self.link_was_up {
                self.link_was_up = true;
                self.decoder.restart(now);
            }
            let link = &mut self.link;
            // After a stall old frames are waiting: a device is not silent as long as what it sent has not been read. So time passes
            // for the devices as it does in the frames, and by the clock only once nothing is waiting.
            let then = self.heard.map_or(now, |t| t.min(now));
            let behind = now - then;
            // A failure is counted by the link; what to do about it is the device's to decide when its reply stays out.
            self.decoder.poll_transmit(then, |t| {
                let _ = link.send(&t.frame, t.deadline + behind);
            });
            deadline = self.decoder.next_wake().map_or(deadline, |wake| wake.min(deadline));
        } else if self.link_was_up {
            // Nothing streams over a link that is lost, and its health should not say so.
            self.link_was_up = false;
            self.decoder.restart(now);
        }
        let received = self.link.recv(deadline);
        self.heard = None;
        match received {
            Received::Frame(frame) => {
                self.heard = Some(frame.t);
                let (sink, status) = (&mut self.sink, &self.status);
                self.decoder
                    .on_frame(&frame, |sample| match sink.publish(sample, clock.now()) {
                        Ok(connections) => {
                            status.published.fetch_add(1, Relaxed);
                            status.connections.fetch_add(u64::from(connections), Relaxed);
                        }
                        Err(_) => {
                            status.publish_failures.fetch_add(1, Relaxed);
                        }
                    });
            }
            Received::TimedOut => self.sink.idle(),
            Received::StateChanged => {}
            Received::Ended => {
                self.status.set_link(LinkState::Ended, &self.link.counters());
                return Turn::Ended;
            }
        }
        self.status.set_link(self.link.state(), &self.link.counters());
        Turn::Continue
    }

    /// Stops the devices, within [`STOP_TIME`].
    pub fn stop(&mut self, clock: &impl Clock) {
        let now = clock.now();
        self.decoder.stop(now);
        let end = now + STOP_TIME;
        while !self.decoder.stopped() && clock.now() < end && self.link.state() == LinkState::Up {
            if self.turn(clock) == Turn::Ended {
                break;
            }
        }
    }

    /// What a person should know of the link at its end.
    #[must_use]
    pub fn link_note(&self) -> Option<String> {
        self.link.note()
    }

    /// Gives the sink back.
    pub fn into_sink(self) -> S {
        self.sink
    }
}
