//! Whether a bus-off that an error frame reports is believed.
//!
//! A controller that is bus-off neither sends nor receives, and its driver takes the carrier away.
//! Some adapters report one that is none (candleLight firmware, whenever a controller comes back to
//! error active). To believe it would start all boards again. So a report that contradicts itself
//! is counted only, and any other is believed when the carrier has gone, or when nothing was
//! received for a while. That while doubles whenever a frame or a carrier refutes the belief, so
//! that an adapter that goes on so does not start boards more than once in two seconds.

use super::error_frame::ErrorFrame;
use proprio_topics::{BusError, Nanos};

/// At first, a report is believed after this long without a frame. A bus whose boards stream has
/// dozens in it.
const PATIENCE: Nanos = Nanos::from_millis(50);
/// At last, after this long.
const MOST_PATIENCE: Nanos = Nanos::from_millis(2000);
/// For this long after a report a carrier does not end a bus-off: the kernel's link watch updates
/// it at most once a second. Half a second is for a busy machine.
const LINK_WATCH: Nanos = Nanos::from_millis(1500);

/// What is known of the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ControllerState {
    OnTheBus,
    /// Bus-off was reported at this time.
    Suspected(Nanos),
    /// And is believed.
    Off(Nanos),
}

/// Follows the reports of one interface.
#[derive(Debug)]
pub(super) struct BusOff {
    state: ControllerState,
    patience: Nanos,
}

impl Default for BusOff {
    fn default() -> Self {
        Self {
            state: ControllerState::OnTheBus,
            patience: PATIENCE,
        }
    }
}

impl BusOff {
    /// An error frame has arrived.
    pub(super) fn report(&mut self, error: ErrorFrame, now: Nanos) {
        let reports = |cause| error.reports(cause);
        let is_off = reports(BusError::BusOff);
        // A controller that counts errors is on the bus; but one that goes bus-off has just counted
        // some.
        let counts = error.classes & libc::CAN_ERR_CRTL != 0;
        let is_on = reports(BusError::Restarted) || reports(BusError::Active) || counts && !is_off;
        self.state = match self.state {
            _ if is_on => ControllerState::OnTheBus,
            ControllerState::OnTheBus if is_off => ControllerState::Suspected(now),
            unchanged => unchanged,
        };
    }

    /// A frame has arrived.
    pub(super) fn receive(&mut self) {
        if let ControllerState::Off(_) = self.state {
            self.be_patient();
        }
        self.state = ControllerState::OnTheBus;
    }

    /// A belief was wrong.
    fn be_patient(&mut self) {
        self.patience = (self.patience + self.patience).min(MOST_PATIENCE);
    }

    /// The interface has a carrier, or has none, at `now`.
    pub(super) fn see_carrier(&mut self, has_carrier: bool, now: Nanos) {
        if !has_carrier && self.state != ControllerState::OnTheBus {
            self.patience = PATIENCE;
        }
        self.state = match self.state {
            ControllerState::Suspected(since) if !has_carrier || now - since >= self.patience => {
                ControllerState::Off(since)
            }
            // No frame has refuted it: boards that only answer were not asked meanwhile.
            ControllerState::Off(since) if has_carrier && now - since >= LINK_WATCH => {
                self.be_patient();
                ControllerState::OnTheBus
            }
            unchanged => unchanged,
        };
    }

    /// Whether it was reported, and is not believed yet: nothing should be sent.
    pub(super) fn is_suspected(&self) -> bool {
        matches!(self.state, ControllerState::Suspected(_))
    }

    /// Whether the controller is bus-off.
    pub(super) fn is_off(&self) -> bool {
        matches!(self.state, ControllerState::Off(_))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OFF: ErrorFrame = ErrorFrame {
        classes: 0x40,
        data: [0; 8],
    };
    const MS: fn(i64) -> Nanos = Nanos::from_millis;

    #[test]
    fn a_report_that_contradicts_itself_is_not_believed() {
        // candleLight: bus-off, back to active, warnings, error counters of 127.
        let error = ErrorFrame {
            classes: 0x44,
            data: [0, 0x4C, 0, 0, 0, 0x7F, 0x7F, 0],
        };
        let mut bus = BusOff::default();
        bus.report(error, MS(0));
        bus.see_carrier(true, MS(10_000));
        assert!(!bus.is_suspected() && !bus.is_off());
    }

    #[test]
    fn silence_or_a_lost_carrier_confirms_a_report_and_a_frame_refutes_it() {
        let reported = || {
            let mut bus = BusOff::default();
            bus.report(OFF, MS(0));
            assert!(bus.is_suspected() && !bus.is_off());
            bus
        };
        let mut bus = reported();
        bus.see_carrier(true, PATIENCE - Nanos(1));
        assert!(!bus.is_off());
        bus.see_carrier(true, PATIENCE);
        assert!(bus.is_off() && !bus.is_suspected());
        bus.see_carrier(true, LINK_WATCH - Nanos(1));
        assert!(bus.is_off());
        bus.see_carrier(true, LINK_WATCH);
        assert!(!bus.is_off(), "the carrier is there");

        let mut bus = reported();
        bus.see_carrier(false, MS(1));
        assert!(bus.is_off());
        bus.see_carrier(false, MS(60_000));
        assert!(bus.is_off(), "until the carrier is back");
        bus.report(
            ErrorFrame {
                classes: 0x100,
                ..OFF
            },
            MS(60_001),
        );
        assert!(!bus.is_off(), "restarted");

        let mut bus = reported();
        bus.receive();
        bus.see_carrier(true, MS(1000));
        assert!(!bus.is_off() && !bus.is_suspected());
    }

    /// Reports every 10 ms, a frame every 60 ms: each belief is wrong.
    #[test]
    fn wrong_beliefs_become_rare() {
        let (mut own, mut beliefs, mut was_off) = (BusOff::default(), 0, false);
        for t in 0..60_000 {
            if t % 10 == 0 {
                own.report(OFF, MS(t));
            }
            if t % 60 == 59 {
                own.receive();
            }
            own.see_carrier(true, MS(t));
            beliefs += u32::from(own.is_off() && !was_off);
            was_off = own.is_off();
        }
        assert_eq!(beliefs, 1);
        // A real one is believed at once again.
        own.report(OFF, MS(60_000));
        own.see_carrier(false, MS(60_000));
        assert!(own.is_off());
        own.receive();
        own.report(OFF, MS(60_001));
        own.see_carrier(true, MS(60_001) + PATIENCE + PATIENCE);
        assert!(own.is_off());
    }
}
