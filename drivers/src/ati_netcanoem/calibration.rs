//! What turns gauges into a wrench: matrix, counts and units, from the keys, from the sensor's
//! answers, or from its answers to another program.

use super::frames::{ForceUnit, TorqueUnit, id, opcode};
use super::options::{AtiNetcanoemOptions, is_row};
use crate::bringup::{Ask, Attempts, Inquiry, Timing};
use crate::bytes::u32_be;
use crate::received::Received;
use crate::{Frame, Mode, NotSent};
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Nanos, Refusal};

pub(super) const TIMING: Timing = Timing {
    send_within: Nanos::from_millis(50),
    ..Timing::POLLED
};

/// \[N or Nm per gauge count\], by axis and gauge.
pub(super) fn per_count(
    mut matrix: [[f64; 6]; 6],
    [force, torque]: [f64; 2],
    [newton, newton_metre]: [f64; 2],
) -> [[f64; 6]; 6] {
    let (f, t) = (newton / force, newton_metre / torque);
    for (row, unit) in matrix.iter_mut().zip([f, f, f, t, t, t]) {
        *row = row.map(|entry| entry * unit);
    }
    matrix
}

/// The requests, in their order: select a calibration, counts, units, six rows.
const SELECT: u8 = 0;
const COUNTS: u8 = 1;
const UNITS: u8 = 2;
const ROWS: u8 = 3;
const ALL: u8 = ROWS + 6;

/// Rows that were asked for and not yet answered: more than any program asks for at once.
type Rows = ArrayVec<u8, 8>;

/// Matrix, counts and units.
#[derive(Debug)]
pub(super) struct CalibrationQuery {
    base: u8,
    mode: Mode,
    select: Option<u8>,
    /// Which of counts, units and matrix are configured: never asked for, and replies are ignored.
    configured: [bool; 3],
    counts: Option<[f64; 2]>,
    units: Option<[f64; 2]>,
    matrix: [[f64; 6]; 6],
    /// Pairs of columns that are known, one bit each, per row.
    known: [u8; 6],
    /// The rows whose replies are to come, per pair of columns.
    asked_rows: [Rows; 3],
    /// \[N or Nm per gauge count\], once all is known.
    per_count: Option<[[f64; 6]; 6]>,
    refusal: Option<Refusal>,
    /// The last answer that differs from an earlier one: row, pair of columns, values.
    differing: Option<(u8, usize, [u64; 2])>,
    /// The current request.
    question: u8,
    answered: bool,
    /// How often it was sent: each may be answered.
    sent: u8,
    attempts: Attempts,
}

impl CalibrationQuery {
    pub(super) fn new(base: u8, mode: Mode, options: &AtiNetcanoemOptions) -> Self {
        let (counts, units) = (options.counts(), options.units());
        let configured = [counts.is_some(), units.is_some(), options.matrix.is_some()];
        let mut this = Self {
            base,
            mode,
            select: options.calibration,
            configured,
            counts,
            units,
            matrix: options.matrix.as_deref().copied().unwrap_or_default(),
            known: [if options.matrix.is_some() { 0b111 } else { 0 }; 6],
            asked_rows: Default::default(),
            per_count: None,
            refusal: None,
            differing: None,
            question: 0,
            answered: false,
            sent: 0,
            attempts: Attempts::new(TIMING),
        };
        this.complete();
        this
    }

    /// \[N or Nm per gauge count\], by axis and gauge.
    pub(super) const fn per_count(&self) -> Option<&[[f64; 6]; 6]> {
        self.per_count.as_ref()
    }

    /// Matrix, counts and units in use, once all are known.
    #[allow(clippy::cast_possible_truncation)] // they came as 32-bit numbers, or were configured
    pub(super) fn in_use(&self) -> Option<crate::Calibration> {
        self.per_count?;
        Some(crate::Calibration::Counts {
            matrix: self.matrix.map(|row| row.map(|entry| entry as f32)),
            counts: self.counts?,
            units: self.units?,
        })
    }

    /// Readings come and the calibration is not known: another program has not asked for it.
    pub(super) fn missed(&mut self) {
        self.refusal.get_or_insert(Refusal::NoCalibration);
    }

    /// Another program's request, or the host's own.
    pub(super) fn asked(&mut self, row: u8) {
        for rows in &mut self.asked_rows {
            // Asked again, because there was no answer.
            if row < 6 && !rows.contains(&row) && rows.try_push(row).is_err() {
                rows.clear();
            }
        }
    }

    /// A reply to one of the requests for the calibration.
    pub(super) fn answer(&mut self, opcode: u8, data: &[u8], frame: &mut Received<'_>) {
        let expected = match (self.mode, opcode) {
            (Mode::Listen, _) => true,
            (Mode::Supervise, opcode::SELECT) => self.question == SELECT,
            (Mode::Supervise, opcode::COUNTS) => self.question == COUNTS,
            (Mode::Supervise, opcode::UNITS) => self.question == UNITS,
            _ => (ROWS..ALL).contains(&self.question),
        };
        let mine = self.mode == Mode::Listen || (self.sent > 0 && self.attempts.counts(frame.t));
        if !expected || !mine {
            return frame.fault(Counter::Unexpected);
        }
        match (opcode, data.len()) {
            (opcode::SELECT, 1) if data.first().copied() == self.select => {
                self.answered = true;
                self.complete();
            }
            // Another program selects another calibration: what was read before is void.
            (opcode::SELECT, 1) if self.mode == Mode::Listen => self.forget(),
            (opcode::SELECT, 1) => frame.fault(Counter::Value),
            (opcode::COUNTS, 8) => {
                let counts = [u32_be(data, 0), u32_be(data, 4)].map(f64::from);
                self.take(0, counts.map(|c| (c > 0.0).then_some(c)), frame);
            }
            (opcode::UNITS, 2) => {
                let &[force, torque] = data else { return };
                let force = ForceUnit::from_code(force).map(ForceUnit::newton);
                let torque = TorqueUnit::from_code(torque).map(TorqueUnit::newton_metre);
                self.take(1, [force, torque], frame);
            }
            (opcode::MATRIX..=opcode::MATRIX_LAST, 8) => {
                self.columns(usize::from(opcode - opcode::MATRIX), data, frame);
            }
            _ => frame.fault(Counter::Length),
        }
    }

    /// Counts (0) or units (1); `None` is a value that cannot be used.
    fn take(&mut self, which: usize, told: [Option<f64>; 2], frame: &mut Received<'_>) {
        let is_configured = self.configured.get(which) == Some(&true);
        let known = match which {
            0 => &mut self.counts,
            _ => &mut self.units,
        };
        let [Some(force), Some(torque)] = told else {
            if !is_configured {
                *known = None;
            }
            frame.fault(Counter::Value);
            let channel = if told[0].is_none() { 0 } else { 3 };
            return self.refuse(Refusal::BadCalibration { channel }, frame);
        };
        self.answered = true;
        if is_configured {
            return;
        }
        match *known {
            Some(earlier) if earlier != [force, torque] => {
                frame.fault(Counter::Changed);
                self.refuse(Refusal::Changed, frame);
            }
            _ => {
                *known = Some([force, torque]);
                self.complete();
            }
        }
    }

    /// The pair of columns `pair` of the row that was asked for first.
    fn columns(&mut self, pair: usize, data: &[u8], frame: &mut Received<'_>) {
        let rows = self.asked_rows.get_mut(pair);
        let Some(row) = rows.and_then(|rows| rows.pop_at(0)) else {
            if self.mode == Mode::Supervise {
                // The second answer to a request that was repeated.
                return;
            }
            frame.fault(Counter::Unexpected);
            // Then earlier replies may have been taken for those of another row.
            if !self.configured[2] && self.per_count.is_none() {
                self.known = [0; 6];
            }
            return;
        };
        let at = usize::from(row);
        let (Some(values), Some(known)) = (self.matrix.get_mut(at), self.known.get_mut(at)) else {
            return;
        };
        let entries = [0, 4].map(|at| f64::from(f32::from_bits(u32_be(data, at))));
        let bit = 1 << pair;
        if !self.configured[2] {
            let Some(columns) = values.get_mut(2 * pair..2 * pair + 2) else {
                return;
            };
            // By bits: not a number differs from itself.
            let same = columns
                .iter()
                .zip(entries)
                .all(|(a, b)| a.to_bits() == b.to_bits());
            if *known & bit != 0 && !same {
                // An answer that was long on its way, as after a loss of the link, is that of
                // another row: the row is asked for again.
                let differing = Some((row, pair, entries.map(f64::to_bits)));
                if self.mode == Mode::Supervise && self.differing != differing {
                    self.differing = differing;
                    self.answered = false;
                    self.asked_rows.iter_mut().for_each(ArrayVec::clear);
                    self.attempts.slow_down(frame.t);
                    return frame.fault(Counter::Unexpected);
                }
                frame.fault(Counter::Changed);
                return self.refuse(Refusal::Changed, frame);
            }
            columns.copy_from_slice(&entries);
            *known |= bit;
        }
        if *known != 0b111 {
            return;
        }
        if is_row(values) {
            self.answered |= self.question == ROWS + row;
            self.complete();
        } else {
            *known = 0;
            frame.fault(Counter::Value);
            self.refuse(Refusal::BadCalibration { channel: row }, frame);
        }
    }

    /// The sensor cannot be used; it is asked again slowly, because it may be repaired meanwhile.
    fn refuse(&mut self, refusal: Refusal, frame: &Frame) {
        if self.refusal != Some(Refusal::Changed) {
            self.refusal = Some(refusal);
        }
        self.per_count = None;
        self.attempts.slow_down(frame.t);
    }

    fn forget(&mut self) {
        let [counts, units, matrix] = self.configured;
        if !counts {
            self.counts = None;
        }
        if !units {
            self.units = None;
        }
        if !matrix {
            self.known = [0; 6];
        }
        self.per_count = None;
        self.complete();
    }

    /// Computes the conversion, if all is known: then an answer also ends a refusal.
    fn complete(&mut self) {
        let rows_known = self.known.iter().all(|known| *known == 0b111);
        let (Some(counts), Some(units), true) = (self.counts, self.units, rows_known) else {
            return;
        };
        if self.refusal == Some(Refusal::Changed) {
            return;
        }
        self.refusal = None;
        self.per_count = Some(per_count(self.matrix, counts, units));
    }

    /// Whether the current request is not needed.
    fn is_needless(&self) -> bool {
        match self.question {
            SELECT => self.select.is_none(),
            COUNTS => self.configured[0],
            UNITS => self.configured[1],
            _ => self.configured[2],
        }
    }

    fn next_question(&mut self) {
        self.question += 1;
        self.answered = false;
        self.sent = 0;
        self.asked_rows.iter_mut().for_each(ArrayVec::clear);
        self.attempts.begin();
    }
}

impl Inquiry for CalibrationQuery {
    fn begin(&mut self) {
        self.differing = None;
        self.question = 0;
        self.answered = false;
        self.sent = 0;
        self.attempts.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        while self.question < ALL && (self.is_needless() || self.answered) {
            // A request that was repeated may be answered again, and a row's answer does not say
            // which row it is.
            if self.answered && self.sent > 1 && self.attempts.counts(now) {
                return Ask::Wait;
            }
            self.next_question();
        }
        if self.question >= ALL {
            return Ask::Done;
        }
        if self.refusal == Some(Refusal::Changed) || now < self.attempts.next() {
            return Ask::Wait;
        }
        if self.attempts.exhausted() {
            self.refusal.get_or_insert(Refusal::NoCalibration);
        }
        self.attempts.ask(now);
        self.sent = self.sent.saturating_add(1);
        let asks = |opcode, data: &[u8]| Ask::Send(Frame::new(id(self.base, opcode), data));
        match self.question {
            SELECT => asks(opcode::SELECT, &[self.select.unwrap_or(0)]),
            COUNTS => asks(opcode::COUNTS, &[]),
            UNITS => asks(opcode::UNITS, &[]),
            question => {
                let ask = asks(opcode::MATRIX, &[question - ROWS]);
                self.asked(question - ROWS);
                ask
            }
        }
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        if !self.answered {
            self.attempts.sent(outcome);
        }
        if outcome.is_err() {
            self.sent = self.sent.saturating_sub(1);
        }
    }

    fn wake(&self) -> Option<Nanos> {
        match self.refusal {
            Some(Refusal::Changed) => None,
            _ if self.answered => Some(self.attempts.counted_until() + Nanos(1)),
            _ => Some(self.attempts.next()),
        }
    }

    fn refusal(&self) -> Option<Refusal> {
        self.refusal
    }
}
