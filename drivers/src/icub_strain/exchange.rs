//! The host's side of what an operator asks of a board that streams: a tare, which is commanded and
//! then read back, or the board's calibration, which is only read.

use crate::bringup::{Attempts, Timing};
use crate::icub::{self, class, command};
use crate::received::Received;
use crate::{COMMAND_TIME, Command, CommandFailed, Frame, Mode, NotSent};
use proprio_topics::{Counter, Nanos};

/// The mode of SET_CURR_TARE that takes minus the present force and torque of every axis.
pub(super) const MINUS_PRESENT: u8 = 1;

/// The questions about full scales come first, ...
const SCALES: usize = 6;
/// ... then those about the entries of the matrix, row by row.
const ALL: usize = SCALES + 36;

/// The numbers of the answers, in the order of the questions: six of a tare, all of a calibration.
pub(super) type Told = [u16; ALL];

#[derive(Debug, Clone, Copy, PartialEq)]
enum ExchangeStep {
    Idle,
    /// The command is to be sent, or on its way.
    Commanding,
    /// The number of the current question.
    Asking(usize),
}

/// A tare or a calibration. A command is sent once; questions are repeated at the pace of those of
/// the bring-up, one at a time, so that the stream is not delayed.
#[derive(Debug)]
pub(super) struct Exchange {
    address: u8,
    what: Command,
    step: ExchangeStep,
    /// Given up after this.
    limit: Nanos,
    attempts: Attempts,
    under_way: Option<Frame>,
    /// Per question, how many answers may still arrive.
    open: [u8; ALL],
    told: Told,
    /// Whether the next reading may be the first with the new zero.
    may_step: bool,
    outcome: Option<Result<(Command, Told), CommandFailed>>,
}

impl Exchange {
    pub(super) const fn new(address: u8) -> Self {
        Self {
            address,
            what: Command::Tare,
            step: ExchangeStep::Idle,
            limit: Nanos::MIN,
            attempts: Attempts::new(Timing::USUAL),
            under_way: None,
            open: [0; ALL],
            told: [0; ALL],
            may_step: false,
            outcome: None,
        }
    }

    /// Whether one has begun and its outcome has not been taken.
    pub(super) const fn is_open(&self) -> bool {
        !matches!(self.step, ExchangeStep::Idle) || self.outcome.is_some()
    }

    const fn tares(&self) -> bool {
        matches!(self.what, Command::Tare)
    }

    /// Whether this reading may be the first with a new zero: each one from the command to the end
    /// of the tare, and the next.
    pub(super) fn take_step(&mut self) -> bool {
        let taring = self.tares() && matches!(self.step, ExchangeStep::Asking(_));
        core::mem::take(&mut self.may_step) || taring
    }

    pub(super) fn begin(&mut self, what: Command, now: Nanos) {
        self.what = what;
        self.step = match what {
            Command::Tare => ExchangeStep::Commanding,
            Command::Calibration => ExchangeStep::Asking(0),
        };
        self.attempts.begin();
        self.limit = now + COMMAND_TIME;
        self.open = [0; ALL];
    }

    /// A message to the board.
    fn message(&self, data: &[u8]) -> Frame {
        Frame::new(icub::to_board(class::POLLING_ANALOG, self.address), data)
    }

    fn command(&self) -> Frame {
        self.message(&[command::SET_CURR_TARE, MINUS_PRESENT])
    }

    /// Question number `at`, about the regulation set in use.
    #[allow(clippy::cast_possible_truncation)] // at most 5
    fn question(&self, at: usize) -> Frame {
        match at.checked_sub(SCALES) {
            _ if self.tares() => self.message(&[command::GET_CURR_TARE, at as u8]),
            None => self.message(&[command::GET_FULL_SCALES, at as u8]),
            Some(entry) => {
                let (row, column) = (entry / 6, entry % 6);
                self.message(&[command::GET_MATRIX_RC, row as u8, column as u8])
            }
        }
    }

    /// The next frame to send at `now`.
    pub(super) fn poll(&mut self, now: Nanos) -> Option<Frame> {
        if self.step == ExchangeStep::Idle || self.under_way.is_some() {
            return None;
        }
        if now > self.limit {
            self.give_up(CommandFailed::NoAnswer);
            return None;
        }
        self.under_way = match self.step {
            ExchangeStep::Asking(at) if now >= self.attempts.next() => {
                self.attempts.ask(now);
                if let Some(open) = self.open.get_mut(at) {
                    *open = open.saturating_add(1);
                }
                Some(self.question(at))
            }
            ExchangeStep::Commanding => Some(self.command()),
            ExchangeStep::Asking(_) | ExchangeStep::Idle => None,
        };
        self.under_way
    }

    /// Takes the outcome of a frame that [`Exchange::poll`] gave.
    pub(super) fn sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        if self.under_way.take_if(|last| last == frame).is_none() {
            return;
        }
        let commanded = *frame == self.command();
        // A command that was given up on its way takes effect, too.
        self.may_step |= commanded && outcome.is_ok();
        match self.step {
            ExchangeStep::Commanding if commanded && outcome.is_ok() => {
                self.step = ExchangeStep::Asking(0);
                self.attempts.begin();
            }
            ExchangeStep::Commanding if commanded => self.end(Err(CommandFailed::NotSent)),
            ExchangeStep::Asking(at) if !commanded => {
                // If the answer is here already, the next question is another one.
                let asked = if *frame == self.question(at) {
                    self.attempts.sent(outcome);
                    at
                } else {
                    at.saturating_sub(1)
                };
                if outcome.is_err()
                    && let Some(open) = self.open.get_mut(asked)
                {
                    *open = open.saturating_sub(1);
                }
            }
            _ => {}
        }
    }

    /// The number of the question that `data` answers, and the number in it.
    fn parse(data: &[u8]) -> Result<(usize, u16), Counter> {
        let (at, most, high, low) = match *data {
            [
                command::GET_CURR_TARE | command::GET_FULL_SCALES,
                channel,
                high,
                low,
            ] => (usize::from(channel), 6, high, low),
            [command::GET_MATRIX_RC, row, column, high, low] if column < 6 => {
                let at = SCALES + 6 * usize::from(row) + usize::from(column);
                (at, ALL, high, low)
            }
            [command::GET_MATRIX_RC, _, _, _, _] => return Err(Counter::Value),
            _ => return Err(Counter::Length),
        };
        match at < most {
            true => Ok((at, u16::from_be_bytes([high, low]))),
            false => Err(Counter::Value),
        }
    }

    /// Whether `data`, an answer about a full scale, belongs to this exchange.
    pub(super) fn expects(&self, data: &[u8]) -> bool {
        let at = Self::parse(data).map_or(ALL, |(at, _)| at);
        !self.tares() && self.open.get(at).is_some_and(|open| *open > 0)
    }

    /// Takes an answer of the board.
    pub(super) fn answer(&mut self, data: &[u8], mode: Mode, frame: &mut Received<'_>) {
        if let [command::GET_MATRIX_RC, row, 0..6, _, _] = *data
            && matches!((row >> 4, row & 0xF), (1..=3, 0..6))
        {
            // About a stored regulation set, not the one in use: another program has asked.
            return;
        }
        let (at, number) = match Self::parse(data) {
            // Another program has asked.
            Ok(_) if mode == Mode::Listen => return,
            Ok(parsed) => parsed,
            Err(counter) => return frame.fault(counter),
        };
        let is_tare = data.first() == Some(&command::GET_CURR_TARE);
        let (Some(open), Some(told)) = (self.open.get_mut(at), self.told.get_mut(at)) else {
            return;
        };
        if *open == 0 || is_tare != matches!(self.what, Command::Tare) {
            return frame.fault(Counter::Unexpected);
        }
        *open -= 1;
        if self.step != ExchangeStep::Asking(at) {
            return;
        }
        *told = number;
        self.step = ExchangeStep::Asking(at + 1);
        self.attempts.begin();
        if at + 1 == if is_tare { 6 } else { ALL } {
            self.end(Ok((self.what, self.told)));
        }
    }

    /// Ends it, if it is under way: the device is started again or stopped.
    pub(super) fn interrupt(&mut self) {
        self.give_up(CommandFailed::Interrupted);
        if !self.tares() {
            // The bring-up asks for the full scales, too: these answers are its own.
            self.open = [0; ALL];
        }
    }

    fn give_up(&mut self, why: CommandFailed) {
        match self.step {
            ExchangeStep::Idle => {}
            ExchangeStep::Commanding if self.under_way.is_none() => {
                self.end(Err(CommandFailed::NotSent));
            }
            ExchangeStep::Commanding | ExchangeStep::Asking(_) => self.end(Err(why)),
        }
    }

    fn end(&mut self, outcome: Result<(Command, Told), CommandFailed>) {
        self.may_step |= self.tares() && matches!(self.step, ExchangeStep::Asking(_));
        self.step = ExchangeStep::Idle;
        self.outcome = Some(outcome);
    }

    pub(super) fn outcome(&mut self) -> Option<Result<(Command, Told), CommandFailed>> {
        self.outcome.take()
    }

    /// Time of the next poll.
    pub(super) fn wake(&self) -> Option<Nanos> {
        match self.step {
            _ if self.under_way.is_some() => None,
            ExchangeStep::Idle => None,
            ExchangeStep::Commanding => Some(Nanos::MIN),
            ExchangeStep::Asking(_) => Some(self.attempts.next().min(self.limit + Nanos(1))),
        }
    }
}
