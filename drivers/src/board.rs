//! The device's own side of its protocol as a sans-I/O state machine, [`Board`], and [`Simulate`],
//! which makes it from a device's keys.

use crate::{Driver, Frame, Id, Spec, SpecError};
use alloc::boxed::Box;
use arrayvec::ArrayVec;
use proprio_topics::{Imu, JointState, Nanos, Quality, Reading, Wrench};

/// Frames that a board sends at once: two for each of a skin board's 16 triangles.
pub type Frames = ArrayVec<Frame, 32>;

/// Why a board cannot encode a reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The family has no reading of this kind.
    #[error("this device has no such reading")]
    Kind,
    /// The output number is not one of the board's.
    #[error("this device has no output {0}")]
    Output(u8),
    /// A full scale is needed to encode, and the configuration has none.
    #[error("full_scale_n and full_scale_nm are needed to encode")]
    NoFullScale,
    /// A value is not finite, and the protocol cannot mark it as absent.
    #[error("a value is not finite")]
    NotFinite,
}

/// The device's own side of its protocol: answers commands and encodes readings, as the hardware
/// does. After power-on it waits for its start command; one whose [`Spec`] says
/// [`Mode::Listen`](crate::Mode::Listen) has been started by another program.
///
/// Boards differ in when they send. One that *streams* has a [`Board::period`], and its readings
/// are encoded then. One that is *polled* has none: it answers a request in [`Board::on_frame`]
/// with the reading that [`Board::present`] gave it last.
pub trait Board: Send {
    /// Takes a frame from the bus and adds the answers to `out`. Frames for other boards are
    /// ignored; a board that only sends ignores all.
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let _ = (frame, out);
    }

    /// The current streaming period of its main reading \[ns\]; `None` while it does not stream.
    fn period(&self) -> Option<Nanos>;

    /// Whether the board measures when this frame arrives, however late it answers.
    fn measures_at(&self, frame: &Frame) -> bool {
        let _ = frame;
        false
    }

    /// The reading of output `output` at this instant, with which a polled board answers a request.
    /// A board that streams does not need it.
    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = (output, reading, quality);
    }

    /// Encodes a reading of output `output`, quantised and limited as the board does, and adds its
    /// frames to `out`.
    ///
    /// `quality` sets the flags that the protocol can carry: saturation per axis, faults. Values
    /// beyond the range are limited.
    ///
    /// # Errors
    /// [`EncodeError`]: a reading, output or value that the protocol cannot carry.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError>;
}

/// A driver whose devices can be simulated.
pub trait Simulate: Driver {
    /// The device's own side.
    ///
    /// # Errors
    /// As [`Driver::device`].
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError>;
}

/// Adds a frame to those that a board sends; there is room for all.
pub(crate) fn send(id: Id, data: &[u8], out: &mut Frames) {
    let _ = out.try_push(Frame::new(id, data));
}

/// Whether the faults of a drive and of its sensor in `quality` are others than `told`.
pub(crate) fn has_other_faults(quality: Quality, told: Quality) -> bool {
    let carried = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT;
    (quality.0 ^ told.0) & carried.0 != 0
}

/// The code that tells of the faults in `quality`: `none`, that of the sensor, or that of the
/// drive.
pub(crate) const fn fault_code<T: Copy>(quality: Quality, [none, sensor, drive]: [T; 3]) -> T {
    if quality.contains(Quality::DEVICE_FAULT) {
        sensor
    } else if quality.contains(Quality::DRIVE_FAULT) {
        drive
    } else {
        none
    }
}

/// The current of a joint, if need be by its torque and the torque per current.
pub(crate) fn current(joint: &JointState, torque_constant: Option<f64>) -> f64 {
    match torque_constant {
        Some(constant) if joint.current.is_nan() => joint.torque / constant,
        _ => joint.current,
    }
}

/// That `output` is 0, the only one of its board.
pub(crate) const fn only_output(output: u8) -> Result<(), EncodeError> {
    match output {
        0 => Ok(()),
        _ => Err(EncodeError::Output(output)),
    }
}

/// The wrench that a board is to encode whose only output it is.
pub(crate) fn only_wrench(output: u8, reading: &Reading) -> Result<&Wrench, EncodeError> {
    match reading {
        Reading::Wrench(wrench) => only_output(output).map(|()| wrench),
        _ => Err(EncodeError::Kind),
    }
}

/// As [`only_wrench`], of an IMU.
pub(crate) fn only_imu(output: u8, reading: &Reading) -> Result<&Imu, EncodeError> {
    match reading {
        Reading::Imu(imu) => only_output(output).map(|()| imu),
        _ => Err(EncodeError::Kind),
    }
}

/// That all values are finite.
pub(crate) fn finite(values: &[f64]) -> Result<(), EncodeError> {
    match values.iter().all(|value| value.is_finite()) {
        true => Ok(()),
        false => Err(EncodeError::NotFinite),
    }
}

/// That none of these is infinite: what is not measured is not a number.
pub(crate) fn finite_or_absent(values: &[f64]) -> Result<(), EncodeError> {
    match values.iter().any(|value| value.is_infinite()) {
        true => Err(EncodeError::NotFinite),
        false => Ok(()),
    }
}

/// fx fy fz tx ty tz of a wrench \[N, Nm\], all of them finite.
pub(crate) fn axes(wrench: &Wrench) -> Result<[f64; 6], EncodeError> {
    let ([fx, fy, fz], [tx, ty, tz]) = (wrench.force, wrench.torque);
    let axes = [fx, fy, fz, tx, ty, tz];
    finite(&axes).map(|()| axes)
}
