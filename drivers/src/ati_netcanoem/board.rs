//! The board's own side: tells its calibration, and answers requests with the gauges of its load.

use super::calibration::per_count;
use super::frames::{STATUS_ANY, id, opcode, opcode_of};
use super::options::AtiNetcanoemOptions;
use crate::calibration::inverse;
use crate::{Board, EncodeError, Format, Frame, Frames, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Wrench};

/// The calibration of a simulated sensor without keys: about 450 N and 23 Nm at full scale; each
/// gauge acts on all axes, as three beams with two gauges each do.
const MATRIX: [[f64; 6]; 6] = [
    [-310.0, 120.0, 890.0, -13_200.0, -540.0, 13_100.0],
    [-95.0, 15_300.0, 420.0, -7_650.0, 310.0, -7_550.0],
    [13_800.0, -260.0, 13_700.0, -150.0, 13_900.0, 330.0],
    [12.0, 180.0, -1_210.0, -95.0, 1_230.0, -88.0],
    [1_420.0, 9.0, -700.0, 160.0, -715.0, -150.0],
    [21.0, 730.0, 17.0, 725.0, 26.0, 740.0],
];
const COUNTS: [f64; 2] = [1e6, 1e6];
/// The serial number of a simulated sensor.
const SERIAL: &[u8; 8] = b"FT00000\0";
/// Newton and newton metre.
const UNITS: [u8; 2] = [2, 3];
/// Status of a sensor with a fault: its calibration.
const FAULT: u16 = 1 << 6 | STATUS_ANY;

/// The board's own side.
#[derive(Debug)]
struct NetcanoemBoard {
    base: u8,
    matrix: [[f64; 6]; 6],
    counts: [f64; 2],
    units: [u8; 2],
    /// Counts of the gauges per N and Nm.
    gauges: [[f64; 6]; 6],
    load: Wrench,
    quality: Quality,
}

impl NetcanoemBoard {
    fn reply(&self, opcode: u8, data: &[u8], out: &mut Frames) {
        board::send(id(self.base, opcode), data, out);
    }

    /// Both halves of the reading of `load`.
    #[allow(clippy::cast_possible_truncation)] // quantised to 16 bits
    fn readings(&self, load: &Wrench, quality: Quality, out: &mut Frames) {
        let ([fx, fy, fz], [tx, ty, tz]) = (load.force, load.torque);
        let load = [fx, fy, fz, tx, ty, tz];
        let gauge = |row: &[f64; 6]| {
            let count: f64 = row.iter().zip(load).map(|(g, axis)| g * axis).sum();
            (bytes::quantise(count, 1.0, -32768, 32767) as i16).to_be_bytes()
        };
        let [g0, g1, g2, g3, g4, g5] = self.gauges.each_ref().map(gauge);
        let status = if quality.contains(Quality::DEVICE_FAULT) {
            FAULT
        } else {
            0
        };
        let first = [status.to_be_bytes(), g0, g2, g4].concat();
        self.reply(opcode::GAUGES, &first, out);
        self.reply(opcode::GAUGES_SECOND, &[g1, g3, g5].concat(), out);
    }
}

impl Simulate for AtiNetcanoemOptions {
    /// A board after power-on.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let (base, _) = self.check(spec)?;
        let matrix = self.matrix.as_deref().copied().unwrap_or(MATRIX);
        let counts = self.counts().unwrap_or(COUNTS);
        let units = match (self.force_unit, self.torque_unit) {
            (Some(force), Some(torque)) => [force as u8, torque as u8],
            _ => UNITS,
        };
        let per_count = per_count(matrix, counts, self.units().unwrap_or([1.0; 2]));
        Ok(Box::new(NetcanoemBoard {
            base,
            matrix,
            counts,
            units,
            gauges: inverse(per_count).ok_or(SpecError::keys("matrix", "invertible"))?,
            load: Wrench {
                force: [0.0; 3],
                torque: [0.0; 3],
            },
            quality: Quality::GOOD,
        }))
    }
}

impl Board for NetcanoemBoard {
    #[allow(clippy::cast_possible_truncation)] // the protocol's numbers are 32 bits wide
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let Some(opcode) =
            opcode_of(frame.id, self.base).filter(|_| frame.format == Format::Classic)
        else {
            return;
        };
        match (opcode, frame.data()) {
            (opcode::GAUGES, []) => self.readings(&self.load, self.quality, out),
            (opcode::MATRIX, &[row]) => {
                let row = self.matrix.get(usize::from(row)).copied();
                let numbers = row.unwrap_or_default().map(|x| (x as f32).to_be_bytes());
                for (columns, pair) in (opcode::MATRIX..).zip(numbers.chunks(2)) {
                    self.reply(columns, &pair.concat(), out);
                }
            }
            (opcode::SELECT, &[number]) => self.reply(opcode, &[number], out),
            (opcode::COUNTS, []) => {
                let counts = self.counts.map(|count| (count as u32).to_be_bytes());
                self.reply(opcode, &counts.concat(), out);
            }
            (opcode::SERIAL, []) => self.reply(opcode, SERIAL, out),
            (opcode::UNITS, []) => self.reply(opcode, &self.units, out),
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        None
    }

    fn present(&mut self, _output: u8, reading: &Reading, quality: Quality) {
        if let Reading::Wrench(wrench) = reading {
            (self.load, self.quality) = (*wrench, quality);
        }
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let wrench = board::only_wrench(output, reading)?;
        board::axes(wrench)?;
        self.readings(wrench, quality, out);
        Ok(())
    }
}
