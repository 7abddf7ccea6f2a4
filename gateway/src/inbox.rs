//! The inbox of a bus thread: what the control plane asks of a device while the bus runs, and what
//! became of it.
//!
//! Two queues of one producer and one consumer each: requests to the bus thread, replies back.
//! Neither side ever waits for the other, and the bus thread neither takes a lock nor allocates.
//! Every request gets one reply while the bus runs, and a device has at most one request open
//! ([`Requests::send`] refuses a second one). As each queue has a place per device, neither is ever
//! full.
//!
//! What a request replaces goes back with its reply, so that its memory is freed in the control
//! plane.

use crate::plan::OutputPlan;
use proprio_drivers::{Command, CommandFailed, CommandOutcome, CommandRefused, Device};
use proprio_topics::Nanos;
use rtrb::{Consumer, Producer, RingBuffer};

/// What is asked of one device of the bus.
pub enum Request {
    /// To execute a command, if the bus thread takes it in time.
    Command {
        /// The command.
        command: Command,
        /// After this it is too late \[ns\].
        until: Nanos,
    },
    /// To go on as a changed configuration says.
    Replace(Replacement),
}

/// The parts of a device that a changed configuration replaces.
pub struct Replacement {
    /// The device that takes over, with the same claims, once the old one has stopped its board; it
    /// starts from bring-up. `None`: the old one goes on.
    pub device: Option<Box<dyn Device>>,
    /// The maximum silence of a device that goes on \[ns\].
    pub max_silence: Nanos,
    /// Its outputs: the same numbers, channels and kinds.
    pub outputs: Vec<OutputPlan>,
}

/// What became of a request.
pub enum Reply {
    /// The device did not begin the command.
    Refused(CommandRefused),
    /// The command has ended.
    Ended(Result<CommandOutcome, CommandFailed>),
    /// The replacement is in place; this is what it has replaced.
    Replaced(Replacement),
}

/// The device has a request open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("an earlier request to this device is still open")]
pub struct Busy;

/// The control plane's end.
pub struct Requests {
    to_bus: Producer<(u16, Request)>,
    from_bus: Consumer<(u16, Reply)>,
    /// Per device, whether a request is open.
    open: Vec<bool>,
}

/// The bus thread's end.
pub struct Inbox {
    from_control: Consumer<(u16, Request)>,
    to_control: Producer<(u16, Reply)>,
}

/// The two ends for a bus with this number of devices.
#[must_use]
pub fn inbox(devices: usize) -> (Requests, Inbox) {
    let (to_bus, from_control) = RingBuffer::new(devices);
    let (to_control, from_bus) = RingBuffer::new(devices);
    let requests = Requests {
        to_bus,
        from_bus,
        open: vec![false; devices],
    };
    let inbox = Inbox {
        from_control,
        to_control,
    };
    (requests, inbox)
}

impl Requests {
    /// Asks device number `device` of the bus.
    ///
    /// # Errors
    /// [`Busy`]: the reply to an earlier request has not been taken.
    pub fn send(&mut self, device: u16, request: Request) -> Result<(), Busy> {
        let open = self.open.get_mut(usize::from(device)).ok_or(Busy)?;
        if *open || self.to_bus.push((device, request)).is_err() {
            return Err(Busy);
        }
        *open = true;
        Ok(())
    }

    /// Whether a request to this device is open.
    #[must_use]
    pub fn is_open(&self, device: u16) -> bool {
        self.open.get(usize::from(device)).copied().unwrap_or(false)
    }

    /// The next reply, with the number of its device.
    pub fn take(&mut self) -> Option<(u16, Reply)> {
        let (device, reply) = self.from_bus.pop().ok()?;
        if let Some(open) = self.open.get_mut(usize::from(device)) {
            *open = false;
        }
        Some((device, reply))
    }
}

impl Inbox {
    /// The next request, with the number of its device.
    pub fn take(&mut self) -> Option<(u16, Request)> {
        self.from_control.pop().ok()
    }

    /// Replies to the request to this device.
    pub fn reply(&mut self, device: u16, reply: Reply) {
        // There is a place for each device, and each has at most one request open.
        let _ = self.to_control.push((device, reply));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_has_one_request_open_and_no_queue_is_ever_full() {
        let (mut requests, mut inbox) = inbox(3);
        let tare = || Request::Command {
            command: Command::Tare,
            until: Nanos::MAX,
        };
        for _ in 0..5 {
            for device in 0..3 {
                assert_eq!(requests.send(device, tare()), Ok(()));
                assert_eq!(requests.send(device, tare()), Err(Busy));
                assert!(requests.is_open(device));
            }
            assert_eq!(
                requests.send(3, tare()),
                Err(Busy),
                "there is no such device"
            );
            while let Some((device, _)) = inbox.take() {
                inbox.reply(device, Reply::Refused(CommandRefused::Unsupported));
                assert_eq!(requests.send(device, tare()), Err(Busy), "not yet taken");
            }
            for device in 0..3 {
                assert!(matches!(requests.take(), Some((d, _)) if d == device));
                assert!(!requests.is_open(device));
            }
            assert!(requests.take().is_none());
        }
    }
}
