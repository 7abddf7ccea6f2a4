//! The data plane of one bus: the loop that moves frames from the link through the devices to the
//! sink and sends the devices' frames. One thread owns it. After start it allocates nothing, takes
//! no lock, and waits only for frames, at most [`MAX_TURN`] at a time.

use crate::clock::Clock;
use crate::decoder::Decoder;
use crate::link::error_frame::ErrorFrame;
use crate::link::{Link, Received};
use crate::publish::Sink;
use crate::status::BusStatus;
use proprio_topics::{LinkState, Nanos};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// Maximum wait in one turn of the loop. The watchdog needs a sign of life every 100 ms, with or
/// without frames.
pub const MAX_TURN: Nanos = Nanos::from_millis(50);

/// Time for the devices to stop before the link is closed in any case.
pub const STOP_TIME: Nanos = Nanos::from_millis(200);

/// A running bus.
pub struct Bus<S> {
    link: Box<dyn Link>,
    decoder: Decoder,
    sink: S,
    status: Arc<BusStatus>,
    link_was_up: bool,
    /// The stamp of the last frame, as long as more frames may be waiting.
    heard: Option<Nanos>,
}

/// Whether more frames can come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// Continue with the next turn.
    Continue,
    /// The log has ended.
    Ended,
}

impl<S: Sink> Bus<S> {
    /// Combines link, devices and sink.
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

    /// One turn: send the frames that are due, wait for a frame, process it.
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
            // After a stall old frames are waiting, and a device is not silent while its frames
            // have not been read. Therefore the devices' time follows the stamps of the frames, and
            // the clock only when no frame is waiting.
            let then = self.heard.map_or(now, |t| t.min(now));
            let behind = now - then;
            // The link counts failures. The device reacts when its reply does not arrive.
            self.decoder.poll_transmit(then, |t| {
                let _ = link.send(&t.frame, t.deadline + behind);
            });
            deadline = self
                .decoder
                .next_wake()
                .map_or(deadline, |wake| wake.min(deadline));
        } else if self.link_was_up {
            // No device streams over a lost link, and the health must show that.
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
                            status
                                .connections
                                .fetch_add(u64::from(connections), Relaxed);
                        }
                        Err(_) => {
                            status.publish_failures.fetch_add(1, Relaxed);
                        }
                    });
            }
            Received::Error(frame) => {
                if let Some(error) = ErrorFrame::of(&frame) {
                    self.status.record_error(error);
                }
            }
            Received::TimedOut => self.sink.idle(),
            Received::StateChanged => {}
            Received::Ended => {
                self.status
                    .set_link(LinkState::Ended, &self.link.counters());
                return Turn::Ended;
            }
        }
        self.status
            .set_link(self.link.state(), &self.link.counters());
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

    /// The link's closing note for the log, if any.
    #[must_use]
    pub fn link_note(&self) -> Option<String> {
        self.link.note()
    }

    /// Returns the sink.
    pub fn into_sink(self) -> S {
        self.sink
    }
}
