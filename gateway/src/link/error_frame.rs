//! What an error frame of a CAN interface reports: class bits in the identifier, details in the
//! data (linux/can/error.h).

use proprio_drivers::{Format, Frame};
use proprio_topics::BusError;
use std::fmt;

/// An error frame without its stamp.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ErrorFrame {
    /// The class bits.
    pub classes: u32,
    /// The details of the classes; the error counters, if the class bits say so.
    pub data: [u8; 8],
}

/// What tells that a cause is reported: one of these class bits and, in byte 1 of the data, one of
/// these bits (any data if there are none).
const SIGNS: [(BusError, u32, libc::c_int); BusError::ALL.len()] = {
    use libc::*;
    const RX_TX_WARNING: c_int = CAN_ERR_CRTL_RX_WARNING | CAN_ERR_CRTL_TX_WARNING;
    const RX_TX_PASSIVE: c_int = CAN_ERR_CRTL_RX_PASSIVE | CAN_ERR_CRTL_TX_PASSIVE;
    [
        (BusError::TxTimeout, CAN_ERR_TX_TIMEOUT, 0),
        (BusError::ArbitrationLost, CAN_ERR_LOSTARB, 0),
        (BusError::RxOverflow, CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW),
        (BusError::TxOverflow, CAN_ERR_CRTL, CAN_ERR_CRTL_TX_OVERFLOW),
        (BusError::Warning, CAN_ERR_CRTL, RX_TX_WARNING),
        (BusError::Passive, CAN_ERR_CRTL, RX_TX_PASSIVE),
        (BusError::Active, CAN_ERR_CRTL, CAN_ERR_CRTL_ACTIVE),
        (BusError::Protocol, CAN_ERR_PROT, 0),
        (BusError::Transceiver, CAN_ERR_TRX, 0),
        (BusError::NoAck, CAN_ERR_ACK, 0),
        (BusError::BusOff, CAN_ERR_BUSOFF, 0),
        (BusError::Bus, CAN_ERR_BUSERROR, 0),
        (BusError::Restarted, CAN_ERR_RESTARTED, 0),
    ]
};

impl ErrorFrame {
    /// The contents of `frame`; `None` if it is not an error frame.
    #[must_use]
    pub fn of(frame: &Frame) -> Option<Self> {
        if frame.format != Format::Error {
            return None;
        }
        let mut data = [0; 8];
        for (to, from) in data.iter_mut().zip(frame.data()) {
            *to = *from;
        }
        Some(Self {
            classes: frame.id.raw() & libc::CAN_ERR_MASK,
            data,
        })
    }

    /// What it reports; several causes are usual, none is possible.
    pub fn causes(self) -> impl Iterator<Item = BusError> {
        let [_, controller, ..] = self.data;
        SIGNS
            .into_iter()
            .filter(move |(_, class, details)| {
                self.classes & class != 0
                    && (*details == 0 || libc::c_int::from(controller) & details != 0)
            })
            .map(|(cause, ..)| cause)
    }

    /// Whether it reports `cause`.
    #[must_use]
    pub fn reports(self, cause: BusError) -> bool {
        self.causes().any(|c| c == cause)
    }
}

impl fmt::Display for ErrorFrame {
    /// In words, with the place of a protocol violation, the bit after which arbitration was lost,
    /// and the error counters, as far as the frame has them. Allocates.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match socketcan::CanErrorFrame::new_error(self.classes, &self.data) {
            Ok(frame) => fmt::Display::fmt(&frame.into_error(), f),
            // Eight bytes always fit.
            Err(error) => fmt::Display::fmt(&error, f),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_drivers::Id;

    fn frame(classes: u32, data: [u8; 8]) -> ErrorFrame {
        let frame = Frame::with_format(Id::extended(classes), Format::Error, &data).unwrap();
        ErrorFrame::of(&frame).unwrap()
    }

    /// One frame per cause, written out from linux/can/error.h, with its words.
    #[test]
    fn every_cause_has_its_bit_and_its_words() {
        use BusError as E;
        let controller = |bits| [0, bits, 0, 0, 0, 0, 0, 0];
        let golden: [(u32, [u8; 8], &[E], &str); 17] = [
            (0x001, [0; 8], &[E::TxTimeout], "transmission timeout"),
            (
                0x002,
                [11, 0, 0, 0, 0, 0, 0, 0],
                &[E::ArbitrationLost],
                "arbitration lost after 11 bits",
            ),
            (0x004, controller(0x01), &[E::RxOverflow], "receive buffer"),
            (0x004, controller(0x02), &[E::TxOverflow], "transmit buffer"),
            (0x004, controller(0x04), &[E::Warning], "rx warning"),
            (0x004, controller(0x08), &[E::Warning], "tx warning"),
            (0x004, controller(0x10), &[E::Passive], "rx passive"),
            (0x004, controller(0x20), &[E::Passive], "tx passive"),
            (0x004, controller(0x40), &[E::Active], "error active"),
            // A stuff error in the data length code.
            (
                0x008,
                [0, 0, 0x04, 0x0B, 0, 0, 0, 0],
                &[E::Protocol],
                "protocol violation at data length code",
            ),
            // CANH without a wire.
            (
                0x010,
                [0, 0, 0, 0, 0x04, 0, 0, 0],
                &[E::Transceiver],
                "CAN High",
            ),
            (0x020, [0; 8], &[E::NoAck], "no ack"),
            (0x040, [0; 8], &[E::BusOff], "bus off"),
            (0x080, [0; 8], &[E::Bus], "bus error"),
            (0x100, [0; 8], &[E::Restarted], "restarted"),
            // The state changes of the kernel's can_change_state(): both directions, with counters.
            (
                0x204,
                [0, 0x30, 0, 0, 0, 0, 128, 135],
                &[E::Passive],
                "tx=128, rx=135",
            ),
            // A bus error as the SJA1000's driver reports it, and a controller problem of no kind.
            (
                0x08C,
                [0, 0, 0x88, 0x19, 0, 0, 0, 0],
                &[E::Protocol, E::Bus],
                "at ack slot",
            ),
        ];
        for (classes, data, causes, words) in golden {
            let frame = frame(classes, data);
            assert_eq!(frame.causes().collect::<Vec<_>>(), causes, "{frame:?}");
            let text = frame.to_string().to_lowercase();
            assert!(text.contains(&words.to_lowercase()), "{text} {words}");
        }
        let all: Vec<E> = frame(0x3FF, [0xFF; 8]).causes().collect();
        assert_eq!(all, E::ALL, "in the order of the counters");
        assert_eq!(frame(0x200, [0xFF; 8]).causes().count(), 0);
        assert!(frame(0x40, [0; 8]).reports(E::BusOff));
        assert!(!frame(0x40, [0; 8]).reports(E::Passive));
    }

    #[test]
    fn other_frames_are_none_and_short_ones_are_padded() {
        assert_eq!(ErrorFrame::of(&Frame::new(Id::extended(4), &[0; 8])), None);
        let short = Frame::with_format(Id::extended(4), Format::Error, &[0, 1]).unwrap();
        let frame = ErrorFrame::of(&short).unwrap();
        assert_eq!(frame.data, [0, 1, 0, 0, 0, 0, 0, 0]);
        assert!(frame.reports(BusError::RxOverflow));
    }
}
