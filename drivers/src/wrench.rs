//! What force/torque sensors have in common: full scales, the saturation of their axes, and
//! commands that change their zero.

use crate::{COMMAND_TIME, CommandFailed, CommandOutcome, NotSent, SpecError};
use alloc::vec::Vec;
use proprio_topics::{Nanos, Quality, Saturation};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

/// Deserializes exactly three numbers; a plain array would ignore further ones.
pub(crate) fn three<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<[f64; 3]>, D::Error> {
    let numbers = Vec::<f64>::deserialize(deserializer)?;
    let three = <[f64; 3]>::try_from(numbers.as_slice());
    three
        .map(Some)
        .map_err(|_| D::Error::invalid_length(numbers.len(), &"3 numbers"))
}

/// The full scales of the keys `full_scale_n` and `full_scale_nm`, force then torque; `None` if
/// neither is given.
///
/// # Errors
/// [`SpecError`]: one alone, or a value out of range.
pub(crate) fn full_scale(
    force: Option<[f64; 3]>,
    torque: Option<[f64; 3]>,
    zero_allowed: bool,
) -> Result<Option<[f64; 6]>, SpecError> {
    let incomplete = |given, missing| Err(SpecError::Incomplete { given, missing });
    let ([fx, fy, fz], [tx, ty, tz]) = match (force, torque) {
        (None, None) => return Ok(None),
        (Some(_), None) => return incomplete("full_scale_n", "full_scale_nm"),
        (None, Some(_)) => return incomplete("full_scale_nm", "full_scale_n"),
        (Some(force), Some(torque)) => (force, torque),
    };
    let all = [fx, fy, fz, tx, ty, tz];
    for (axis, value) in all.into_iter().enumerate() {
        // The upper limit is the largest value in the 16 bits in which sensors report it.
        let legal = value.is_finite()
            && value <= f64::from(u16::MAX)
            && (value > 0.0 || (zero_allowed && value == 0.0));
        if !legal {
            let key = if axis < 3 {
                "full_scale_n"
            } else {
                "full_scale_nm"
            };
            return Err(SpecError::key(key, value, "above 0 and at most 65535"));
        }
    }
    Ok(Some(all))
}

/// `quality` with the saturation of axis `axis`, which the sensor reports without saying at which
/// end: the one on whose side `value` is.
pub(crate) fn overloaded(quality: Quality, axis: u32, value: f64) -> Quality {
    let end = if value < 0.0 {
        Saturation::Low
    } else {
        Saturation::High
    };
    quality.with_saturation(axis, end)
}

/// The saturation of an axis whose code is limited to `least..=most`.
pub(crate) fn at_end<T: PartialEq>(count: T, least: T, most: T) -> Saturation {
    if count == least {
        Saturation::Low
    } else if count == most {
        Saturation::High
    } else {
        Saturation::None
    }
}

/// Marks the readings around a command that changes a sensor's zero. The sensor does not say which
/// reading is the first with the new one, so every reading from the command until it has certainly
/// taken effect has ZERO_CHANGED, and the first after it.
#[derive(Debug, Default)]
pub(crate) struct NewZero {
    /// From then on the command has taken effect; `None`: no reading is to be marked.
    until: Option<Nanos>,
}

impl NewZero {
    /// A command takes effect some time between `t` and `until`.
    pub(crate) const fn expect(&mut self, until: Nanos) {
        self.until = Some(until);
    }

    /// It has taken effect at `t`.
    pub(crate) fn confirm(&mut self, t: Nanos) {
        self.until = self.until.map(|until| until.min(t));
    }

    /// ZERO_CHANGED if the reading that was received at `t` is to be marked.
    pub(crate) fn mark(&mut self, t: Nanos) -> Quality {
        match self.until {
            None => return Quality::GOOD,
            Some(until) if t >= until => self.until = None,
            Some(_) => {}
        }
        Quality::ZERO_CHANGED
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
enum TareStep {
    #[default]
    Idle,
    /// To be sent before this.
    Due(Nanos),
    UnderWay,
    /// Sent; to be confirmed before this.
    Sent(Nanos),
}

/// A tare of one frame, of a sensor that can not be asked what it has taken as its zero.
#[derive(Debug, Default)]
pub(crate) struct TareCommand {
    step: TareStep,
    outcome: Option<Result<CommandOutcome, CommandFailed>>,
}

impl TareCommand {
    /// Whether one has begun and its outcome has not been taken.
    pub(crate) fn is_open(&self) -> bool {
        self.step != TareStep::Idle || self.outcome.is_some()
    }

    pub(crate) fn begin(&mut self, now: Nanos) {
        self.step = TareStep::Due(now + COMMAND_TIME);
    }

    /// Whether the frame is to be sent at `now`.
    pub(crate) fn poll(&mut self, now: Nanos) -> bool {
        match self.step {
            TareStep::Due(until) if now <= until => {
                self.step = TareStep::UnderWay;
                return true;
            }
            TareStep::Due(_) => self.end(Err(CommandFailed::NotSent)),
            TareStep::Sent(until) if now > until => self.end(Err(CommandFailed::NoAnswer)),
            _ => {}
        }
        false
    }

    /// What became of the frame. It is confirmed within `confirmed` after it was sent; `None`: not
    /// at all.
    pub(crate) fn sent(&mut self, outcome: Result<Nanos, NotSent>, confirmed: Option<Nanos>) {
        match (self.step, outcome, confirmed) {
            (TareStep::UnderWay, Ok(t), Some(within)) => self.step = TareStep::Sent(t + within),
            (TareStep::UnderWay, Ok(_), None) => self.end(Ok(CommandOutcome::Tared(None))),
            (TareStep::UnderWay, Err(_), _) => self.end(Err(CommandFailed::NotSent)),
            _ => {}
        }
    }

    /// The sensor has confirmed a command.
    pub(crate) fn confirm(&mut self) {
        // Its answer may come before the interface tells that the frame was sent.
        if matches!(self.step, TareStep::UnderWay | TareStep::Sent(_)) {
            self.end(Ok(CommandOutcome::Tared(None)));
        }
    }

    /// The device is started again or stopped.
    pub(crate) fn interrupt(&mut self) {
        match self.step {
            TareStep::Idle => {}
            TareStep::Due(_) => self.end(Err(CommandFailed::NotSent)),
            TareStep::UnderWay | TareStep::Sent(_) => self.end(Err(CommandFailed::Interrupted)),
        }
    }

    fn end(&mut self, outcome: Result<CommandOutcome, CommandFailed>) {
        self.step = TareStep::Idle;
        self.outcome = Some(outcome);
    }

    pub(crate) fn outcome(&mut self) -> Option<Result<CommandOutcome, CommandFailed>> {
        self.outcome.take()
    }

    /// Time of the next poll.
    pub(crate) fn wake(&self) -> Option<Nanos> {
        match self.step {
            TareStep::Idle | TareStep::UnderWay => None,
            TareStep::Due(_) => Some(Nanos::MIN),
            TareStep::Sent(until) => Some(until + Nanos(1)),
        }
    }
}
