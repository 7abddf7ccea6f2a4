//! The F/T board's own side. It reports its full scales, executes the host's commands, and sends
//! readings as frames.

use super::exchange::MINUS_PRESENT;
use super::frames::{CELSIUS_PER_LSB, STEPS, StrainHalf, ZERO, kind, saturation_bytes};
use super::options::{IcubStrainOptions, StrainStream};
use crate::icub::{self, class, command};
use crate::{Board, EncodeError, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Saturation, Temperature, Wrench};

/// Default full scales: the iCub's usual sensor \[N, Nm\]. A simulated board reports them on
/// request.
const USUAL_FULL_SCALE: [f64; 6] = [1804.0, 1804.0, 1804.0, 31.0, 31.0, 31.0];

/// The board's own side.
///
/// It behaves as a strain2 with the unit calibration matrix: its raw gauges are its axes. Its
/// memory holds the configured full scales, else 1804 N and 31 Nm. The matrix in its memory can be
/// overwritten and read, and is not used: what the board would then send is not simulated.
#[derive(Debug)]
struct StrainBoard {
    address: u8,
    full_scale: [f64; 6],
    /// Whether the host knows the scale: from the same configuration, or from the board's answer
    /// (to the program that has started it, too).
    scale_known: bool,
    period: Nanos,
    /// The stream selected by the host; `None` while it is silent.
    stream: Option<StrainStream>,
    /// The calibrated counts of the last vector that was not saturated.
    last_good: Option<[u16; 6]>,
    /// The gauges of the last vector.
    gauges: [u16; 6],
    /// What is added to each calibrated axis, in steps; lost with the power.
    tare: [i16; 6],
    /// In 1/32768, by axis and gauge.
    matrix: [[i16; 6]; 6],
}

impl StrainBoard {
    /// The frames of both halves.
    fn send(&self, first_kind: u8, counts: [u16; 6], saturation: [u8; 2], out: &mut Frames) {
        let [a, b, c, d, e, f] = counts;
        for (kind, counts, saturation) in [
            (first_kind, [a, b, c], saturation[0]),
            (first_kind + 1, [d, e, f], saturation[1]),
        ] {
            let id = icub::stream(class::PERIODIC_ANALOG, self.address, kind);
            let _ = out.try_push(StrainHalf { counts, saturation }.frame(id));
        }
    }

    fn encode_wrench(
        &mut self,
        wrench: &Wrench,
        mut quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let values = board::axes(wrench)?;
        if !self.scale_known {
            return Err(EncodeError::NoFullScale);
        }
        let mut counts = [ZERO; 6];
        for (axis, ((count, value), full_scale)) in
            (0..).zip(counts.iter_mut().zip(values).zip(self.full_scale))
        {
            // With a full scale of zero (a corrupt memory) a board sends zero for any load.
            let per_step = if full_scale > 0.0 {
                full_scale / STEPS
            } else {
                f64::INFINITY
            };
            let steps = bytes::quantise(value, per_step, i64::from(i32::MIN), i64::from(i32::MAX))
                + i64::from(ZERO);
            *count = u16::try_from(steps).unwrap_or_else(|_| {
                let high = steps > 0;
                quality = quality.with_saturation(
                    axis,
                    if high {
                        Saturation::High
                    } else {
                        Saturation::Low
                    },
                );
                if high { u16::MAX } else { 0 }
            });
        }
        let raw = counts;
        self.gauges = raw;
        for (count, tare) in counts.iter_mut().zip(self.tare) {
            let sum = signed(i32::from(*count) - i32::from(ZERO) + i32::from(tare));
            // Back to the code of the stream: the sign bit is inverted.
            *count = sum.cast_unsigned() ^ ZERO;
        }
        if !quality.contains(Quality::SATURATED) {
            self.last_good = Some(counts);
        } else if !quality.contains(Quality::FROZEN) {
            // (A reading with FROZEN is from a recording: it already is the last good
            // vector.)
            counts = self.last_good.unwrap_or(counts);
        }
        let saturation = saturation_bytes(quality);
        // A board that was not started encodes a recording, in which a wrench is a
        // calibrated reading.
        let stream = self.stream.unwrap_or_default();
        if stream != StrainStream::Uncalibrated {
            self.send(kind::FORCE, counts, saturation, out);
        }
        if stream != StrainStream::Calibrated {
            self.send(kind::RAW_FORCE, raw, saturation, out);
        }
        Ok(())
    }
}

/// An entry of the matrix. The upper half of `row` selects a stored set; there is one.
fn entry(matrix: &mut [[i16; 6]; 6], row: u8, column: u8) -> Option<&mut i16> {
    matrix
        .get_mut(usize::from(row & 0xF))?
        .get_mut(usize::from(column))
}

/// `steps`, limited to the range of a Q15 number.
fn signed(steps: i32) -> i16 {
    i16::try_from(steps).unwrap_or(if steps > 0 { i16::MAX } else { i16::MIN })
}

impl Simulate for IcubStrainOptions {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let address = icub::address(spec)?;
        let configured = self.full_scale(true)?;
        let period = icub::period(self.period_ms)?;
        Ok(Box::new(StrainBoard {
            address,
            full_scale: configured.unwrap_or(USUAL_FULL_SCALE),
            scale_known: configured.is_some() || spec.mode == Mode::Listen,
            period,
            stream: (spec.mode == Mode::Listen).then_some(self.stream),
            last_good: None,
            gauges: [ZERO; 6],
            tare: [0; 6],
            matrix: core::array::from_fn(|axis| {
                core::array::from_fn(|gauge| if axis == gauge { i16::MAX } else { 0 })
            }),
        }))
    }
}

impl Board for StrainBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let (class, board) = (class::POLLING_ANALOG, icub::board::STRAIN2);
        match icub::answer_management(frame, class, self.address, board, out) {
            Some(&[command::GET_FULL_SCALES, channel]) => {
                let Some(&full_scale) = self.full_scale.get(usize::from(channel & 0xF)) else {
                    return;
                };
                #[allow(clippy::cast_sign_loss, clippy::cast_possible_truncation)]
                // limited to 16 bits
                let [high, low] =
                    (bytes::quantise(full_scale, 1.0, 0, i64::from(u16::MAX)) as u16).to_be_bytes();
                let id = icub::to_host(class::POLLING_ANALOG, self.address);
                board::send(id, &[command::GET_FULL_SCALES, channel, high, low], out);
                self.scale_known = true;
            }
            Some(&[command::SET_MATRIX_RC, row, column, high, low]) => {
                if let Some(entry) = entry(&mut self.matrix, row, column) {
                    *entry = i16::from_be_bytes([high, low]);
                }
            }
            Some(&[command::GET_MATRIX_RC, row, column]) => {
                let Some(entry) = entry(&mut self.matrix, row, column) else {
                    return;
                };
                let [high, low] = entry.to_be_bytes();
                let id = icub::to_host(class::POLLING_ANALOG, self.address);
                let data = [command::GET_MATRIX_RC, row, column, high, low];
                board::send(id, &data, out);
            }
            Some(&[command::SET_CURR_TARE, 0, ..]) => self.tare = [0; 6],
            Some(&[command::SET_CURR_TARE, MINUS_PRESENT, ..]) => {
                self.tare = self
                    .gauges
                    .map(|gauge| signed(i32::from(ZERO) - i32::from(gauge)));
            }
            Some(&[command::SET_CURR_TARE, 2, channel, high, low]) => {
                if let Some(tare) = self.tare.get_mut(usize::from(channel)) {
                    *tare = i16::from_be_bytes([high, low]);
                }
            }
            Some(&[command::GET_CURR_TARE, channel]) => {
                let tare = self.tare.get(usize::from(channel)).copied().unwrap_or(0);
                let [high, low] = tare.to_be_bytes();
                let id = icub::to_host(class::POLLING_ANALOG, self.address);
                board::send(id, &[command::GET_CURR_TARE, channel, high, low], out);
            }
            Some(&[command::SET_CANDATARATE, ms]) if ms > 0 => {
                self.period = Nanos::from_millis(i64::from(ms));
            }
            Some(&[command::SET_TXMODE, mode]) => self.stream = StrainStream::from_code(mode),
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.stream.is_some().then_some(self.period)
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        board::only_output(output)?;
        match reading {
            Reading::Wrench(wrench) => self.encode_wrench(wrench, quality, out)?,
            Reading::Gauges(gauges) => {
                #[allow(clippy::cast_sign_loss, clippy::cast_possible_truncation)]
                // limited to 16 bits
                let counts = gauges
                    .counts
                    .map(|count| count.clamp(0, i32::from(u16::MAX)) as u16);
                self.send(kind::RAW_FORCE, counts, saturation_bytes(quality), out);
            }
            Reading::Temperature(Temperature { celsius }) => {
                board::finite(&[*celsius])?;
                let [low, high] = bytes::quantise_i16(*celsius, CELSIUS_PER_LSB).to_le_bytes();
                let id = icub::stream(class::PERIODIC_ANALOG, self.address, kind::THERMOMETER);
                board::send(id, &[1, low, high, 0, 0], out);
            }
            _ => return Err(EncodeError::Kind),
        }
        Ok(())
    }
}
