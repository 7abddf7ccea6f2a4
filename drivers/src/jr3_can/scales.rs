//! The full scales: configured, asked of the board, or overheard when another program asks.

use super::protocol::{NEWTON_METRE_PER_LSB, READY, STEPS, id, op};
use crate::bringup::{Ask, Attempts, Inquiry, Timing};
use crate::received::Received;
use crate::{Frame, Mode, NotSent};
use proprio_topics::{Counter, Nanos, Refusal};

const TIMING: Timing = Timing::USUAL;

/// What is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Question {
    Forces,
    Moments,
    /// Nothing more.
    None,
}

#[derive(Debug)]
pub(super) struct Jr3Scales {
    /// The full scales are configured: nothing to ask.
    pub(super) settled: bool,
    /// N or Nm per step of the stream, once all six are known.
    pub(super) per_step: Option<[f64; 6]>,
    pub(super) refusal: Option<Refusal>,
    node: u16,
    forces: Option<[u16; 3]>,
    moments: Option<[u16; 3]>,
    /// The current question.
    question: Question,
    attempts: Attempts,
    /// The question whose answers may still come, how many, and until when.
    asked: Question,
    open: u8,
    open_until: Nanos,
}

impl Jr3Scales {
    pub(super) fn new(node: u16, configured: Option<[f64; 6]>) -> Self {
        Self {
            settled: configured.is_some(),
            per_step: configured.map(|all| all.map(|full_scale| full_scale / STEPS)),
            refusal: None,
            node,
            forces: None,
            moments: None,
            question: Question::Forces,
            attempts: Attempts::new(TIMING),
            asked: Question::None,
            open: 0,
            open_until: Nanos::MIN,
        }
    }

    /// Another program asks.
    pub(super) const fn overhear(&mut self, question: Question) {
        self.asked = question;
        self.open = 1;
    }

    /// Takes an answer of the board: its state and three full scales.
    pub(super) fn answer(
        &mut self,
        state: u8,
        scales: [u16; 3],
        mode: Mode,
        frame: &mut Received<'_>,
    ) {
        if self.open == 0 || (mode == Mode::Supervise && frame.t > self.open_until) {
            return frame.fault(Counter::Unexpected);
        }
        self.open -= 1;
        if state != READY {
            // The sensor is not connected, and the numbers mean nothing.
            self.attempts.slow_down(frame.t);
            return frame.fault(Counter::DeviceFault);
        }
        let (told, first) = match self.asked {
            Question::Forces => (&mut self.forces, 0),
            Question::Moments => (&mut self.moments, 3),
            Question::None => return,
        };
        let differs = told.is_some_and(|known| known != scales);
        if differs {
            frame.fault(Counter::Changed);
        }
        if self.settled || self.refusal == Some(Refusal::Changed) {
            return;
        }
        if differs {
            self.refusal = Some(Refusal::Changed);
            self.per_step = None;
            return;
        }
        if let Some((channel, _)) = (first..).zip(scales).find(|(_, scale)| *scale == 0) {
            self.refusal = Some(Refusal::ZeroFullScale { channel });
            // Asked again slowly: the board may be repaired meanwhile.
            self.attempts.slow_down(frame.t);
            return;
        }
        *told = Some(scales);
        if self.asked == self.question {
            self.question = match self.question {
                Question::Forces => Question::Moments,
                _ => Question::None,
            };
            self.attempts.begin();
        }
        if let (Some([fx, fy, fz]), Some([mx, my, mz])) = (self.forces, self.moments) {
            let force = |scale| f64::from(scale) / STEPS;
            let moment = |scale| f64::from(scale) * NEWTON_METRE_PER_LSB / STEPS;
            self.per_step = Some([
                force(fx),
                force(fy),
                force(fz),
                moment(mx),
                moment(my),
                moment(mz),
            ]);
            self.refusal = None;
        }
    }

    /// Whether answers to another question than the current one may still come.
    fn may_be_mistaken(&self) -> bool {
        self.open > 0 && self.asked != self.question
    }
}

impl Inquiry for Jr3Scales {
    fn begin(&mut self) {
        self.question = Question::Forces;
        self.attempts.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        let operation = match self.question {
            _ if self.settled => return Ask::Done,
            Question::Forces => op::GET_FORCE_SCALES,
            Question::Moments => op::GET_MOMENT_SCALES,
            Question::None => return Ask::Done,
        };
        if self.refusal == Some(Refusal::Changed)
            || now < self.attempts.next()
            || (self.may_be_mistaken() && now <= self.open_until)
        {
            return Ask::Wait;
        }
        if self.attempts.exhausted() && self.per_step.is_none() && self.refusal.is_none() {
            self.refusal = Some(Refusal::NoFullScale);
        }
        if now > self.open_until {
            self.open = 0;
        }
        self.attempts.ask(now);
        self.asked = self.question;
        self.open = self.open.saturating_add(1);
        self.open_until = now + TIMING.answer_counts;
        Ask::Send(Frame::new(id(operation, self.node), &[]))
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        self.attempts.sent(outcome);
        match outcome {
            Ok(t) => self.open_until = t + TIMING.answer_counts,
            Err(_) => self.open = self.open.saturating_sub(1),
        }
    }

    fn wake(&self) -> Option<Nanos> {
        if self.refusal == Some(Refusal::Changed) {
            return None;
        }
        let next = self.attempts.next();
        Some(if self.may_be_mistaken() {
            next.max(self.open_until + Nanos(1))
        } else {
            next
        })
    }

    fn refusal(&self) -> Option<Refusal> {
        self.refusal
    }
}
