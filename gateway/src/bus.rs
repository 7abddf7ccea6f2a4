//! The data plane of one bus: the loop that moves frames from the link through the devices to the
//! sink and sends the devices' frames. One thread owns it. After start it allocates nothing but the
//! 48 bytes with which iceoryx2 lends each payload, takes no lock, and waits only for frames, at
//! most `MAX_TURN` at a time. (But if the domain is damaged, the sink makes its port anew.)
//!
//! **Time.** Before a frame is processed, the devices are advanced to its stamp; when no frame is
//! waiting, to the clock. After a stall, frames that wait are thus no silence, and a silence
//! between two of them is one, as in a recorded log.
//!
//! **Sending never delays receiving.** What a device wants to send goes into a queue of [`QUEUE`]
//! frames, and each turn sends what the link takes. If the link's own queue is full, the next
//! attempt is made after [`RETRY`]; poll does not tell when a CAN interface has room. A frame that
//! is not sent by its deadline is dropped, and so is everything that waits when the link is lost: a
//! stale command moves robots. Every device learns what became of its frames. (What the kernel's
//! queue holds when an interface goes down, the kernel drops; a frame that the controller has begun
//! to send can not be recalled.)
//!
//! **Requests.** Once per turn the loop looks into its [`Inbox`], by which the control plane
//! commands a device or replaces it. Its frames go the same way as all others, and the other
//! devices do not notice. Replies go back by the inbox too, with what was replaced.

use crate::clock::Clock;
use crate::devices::BusDevices;
use crate::inbox::Inbox;
use crate::link::error_frame::ErrorFrame;
use crate::link::{Link, Received, TransmitError};
use crate::publish::Sink;
use crate::status::BusStatus;
use proprio_drivers::{Frame, NotSent, Transmit};
use proprio_topics::{LinkState, Nanos};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// Maximum wait in one turn of the loop. The watchdog needs a sign of life every 100 ms, with or
/// without frames.
pub(crate) const MAX_TURN: Nanos = Nanos::from_millis(50);

/// Time for the devices to stop before the link is closed in any case.
pub(crate) const STOP_TIME: Nanos = Nanos::from_millis(200);

/// Maximum number of frames that wait to be sent: a start-up command for each of 16 boards, several
/// times over.
pub const QUEUE: usize = 64;

/// Time to the next attempt after the link's queue was full: meanwhile a bus of 1 Mbit/s sends
/// about eight of its frames.
pub const RETRY: Nanos = Nanos::from_millis(1);

/// A running bus.
pub struct Bus<S> {
    link: Box<dyn Link>,
    devices: BusDevices,
    sink: S,
    status: Arc<BusStatus>,
    link_was_up: bool,
    queue: SendQueue,
    inbox: Option<Inbox>,
}

/// Whether more frames can come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// Continue with the next turn.
    Continue,
    /// The log has ended.
    Ended,
}

/// The frames that wait to be sent, in the order in which the devices gave them.
struct SendQueue {
    waiting: VecDeque<QueuedFrame>,
    /// Frames that found the queue full, until their devices have been told.
    refused: Vec<QueuedFrame>,
    /// Time of the next attempt after the link's queue was full.
    retry: Nanos,
}

struct QueuedFrame {
    device: u16,
    frame: Frame,
    /// \[ns\] of the clock.
    deadline: Nanos,
}

impl<S: Sink> Bus<S> {
    /// Combines link, devices and sink.
    pub fn new(link: Box<dyn Link>, devices: BusDevices, sink: S, status: Arc<BusStatus>) -> Self {
        let link_was_up = link.state() == LinkState::Up;
        Self {
            link,
            devices,
            sink,
            status,
            link_was_up,
            queue: SendQueue {
                waiting: VecDeque::with_capacity(QUEUE),
                refused: Vec::with_capacity(QUEUE),
                retry: Nanos::MIN,
            },
            inbox: None,
        }
    }

    /// The same with an inbox.
    #[must_use]
    pub fn with_inbox(mut self, inbox: Inbox) -> Self {
        self.inbox = Some(inbox);
        self
    }

    /// One turn: send what waits, wait for a frame, process it.
    pub fn turn(&mut self, clock: &impl Clock) -> Turn {
        let now = clock.now();
        self.status.last_turn.store(now.0, Relaxed);
        self.follow_link(now);
        self.serve(now);
        let mut deadline = now + MAX_TURN;
        if self.link_was_up {
            self.send(now, clock);
            let wake = self.devices.next_wake().unwrap_or(Nanos::MAX);
            deadline = deadline.min(wake);
            if !self.queue.waiting.is_empty() {
                deadline = deadline.min(self.queue.retry);
            }
        }
        match self.link.recv(deadline) {
            Received::Frame(frame) => {
                self.advance(frame.t, clock);
                let (sink, status) = (&mut self.sink, &self.status);
                self.devices
                    .on_frame(&frame, |sample| match sink.publish(sample, clock.now()) {
                        Ok(connections) => {
                            status.published.fetch_add(1, Relaxed);
                            status.set_newest(sample.channel, sample.header.acquired);
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
                self.advance(frame.t, clock);
                if let Some(error) = ErrorFrame::of(&frame) {
                    self.status.record_error(error);
                }
            }
            Received::TimedOut => {
                // Until then nothing had arrived. The clock itself may be later, if this thread
                // was not scheduled meanwhile, and then frames may be waiting again.
                self.advance(clock.now().min(deadline).max(now), clock);
                self.sink.idle(clock.now());
            }
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

    /// Starts the devices again when the link is lost (no device streams over it, and the health
    /// must show that) and when it is back.
    fn follow_link(&mut self, now: Nanos) {
        let up = self.link.state() == LinkState::Up;
        if up == self.link_was_up {
            return;
        }
        self.link_was_up = up;
        self.give_up();
        self.devices.restart(now);
    }

    /// Takes requests from the inbox, and replies to those that have ended.
    fn serve(&mut self, now: Nanos) {
        let Some(inbox) = &mut self.inbox else { return };
        while let Some((device, request)) = inbox.take() {
            if let Some(reply) = self.devices.request(device, request, now) {
                inbox.reply(device, reply);
            }
        }
        self.devices
            .settle(self.link_was_up, |device, reply| inbox.reply(device, reply));
    }

    /// Lets the time of the devices pass until `then` and queues what they want to send.
    fn advance(&mut self, then: Nanos, clock: &impl Clock) {
        // Over a lost link nothing is sent or expected.
        if !self.link_was_up || self.link.state() != LinkState::Up {
            return;
        }
        let (queue, status) = (&mut self.queue, &self.status);
        self.devices
            .poll_transmit(then, |device, Transmit { frame, deadline }| {
                // A device that lives in the past has as much time as it would have had then.
                let behind = (clock.now() - then).max(Nanos::ZERO);
                let waiting = QueuedFrame {
                    device,
                    frame: *frame,
                    deadline: *deadline + behind,
                };
                if queue.waiting.len() < QUEUE {
                    queue.waiting.push_back(waiting);
                } else {
                    status.send_failures.fetch_add(1, Relaxed);
                    // More than a full queue at once only a faulty device wants to send.
                    if queue.refused.len() < QUEUE {
                        queue.refused.push(waiting);
                    }
                }
            });
        for QueuedFrame { device, frame, .. } in queue.refused.drain(..) {
            self.devices.on_sent(device, &frame, Err(NotSent::Deadline));
        }
    }

    /// Sends what waits, as far as the link takes it, without waiting.
    fn send(&mut self, now: Nanos, clock: &impl Clock) {
        if self.queue.waiting.is_empty() {
            return;
        }
        let (devices, status) = (&mut self.devices, &self.status);
        self.queue.waiting.retain(|waiting| {
            let in_time = now <= waiting.deadline;
            if !in_time {
                status.send_failures.fetch_add(1, Relaxed);
                devices.on_sent(waiting.device, &waiting.frame, Err(NotSent::Deadline));
            }
            in_time
        });
        if now < self.queue.retry {
            return;
        }
        while let Some(waiting) = self.queue.waiting.front() {
            // Before the call: within it a receiver may be woken and take the processor.
            let then = clock.now();
            let outcome = match self.link.send(&waiting.frame) {
                Ok(()) => {
                    self.status.on_wire(&waiting.frame);
                    Ok(then)
                }
                Err(TransmitError::Full) => {
                    self.status.queue_full.fetch_add(1, Relaxed);
                    self.queue.retry = now + RETRY;
                    return;
                }
                Err(TransmitError::NotUp) => return self.give_up(),
                Err(
                    TransmitError::ListenOnly
                    | TransmitError::Unsupported
                    | TransmitError::System(_),
                ) => {
                    self.status.send_failures.fetch_add(1, Relaxed);
                    Err(NotSent::Refused)
                }
            };
            let (device, frame) = (waiting.device, waiting.frame);
            self.queue.waiting.pop_front();
            self.devices.on_sent(device, &frame, outcome);
        }
    }

    /// Drops everything that waits.
    fn give_up(&mut self) {
        while let Some(QueuedFrame { device, frame, .. }) = self.queue.waiting.pop_front() {
            self.status.send_failures.fetch_add(1, Relaxed);
            self.devices.on_sent(device, &frame, Err(NotSent::LinkLost));
        }
        self.queue.retry = Nanos::MIN;
    }

    /// Stops the devices, within `STOP_TIME`.
    pub fn stop(&mut self, clock: &impl Clock) {
        let now = clock.now();
        // A device that took over now would start its board again.
        self.inbox = None;
        self.devices.stop(now);
        let end = now + STOP_TIME;
        while !(self.devices.stopped() && self.queue.waiting.is_empty())
            && clock.now() < end
            && self.link.state() == LinkState::Up
        {
            if self.turn(clock) == Turn::Ended {
                break;
            }
        }
    }

    /// The link's closing note for the log, if any.
    #[must_use]
    pub(crate) fn link_note(&self) -> Option<String> {
        self.link.note()
    }

    /// Returns the sink.
    pub fn into_sink(self) -> S {
        self.sink
    }
}
