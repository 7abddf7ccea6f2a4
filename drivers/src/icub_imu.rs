//! The IMU on iCub boards strain2, strain2c, mtb4, mtb4c and rfe (a Bosch BNO055), and the legacy inertial frames of mtb.
//!
//! Streams of address `a`, little-endian, class 5:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `5a3` | IMU_TRIPLE | 8 | SEQ u8, SNS u8, x y z i16 |
//! | `5a4` | IMU_QUATERNION | 8 | w x y z i16, in 1/16384; no SEQ |
//! | `5a5` | IMU_STATUS | 8 | SEQ u8, calibration of gyroscope, accelerometer, magnetometer (0 to 3 each), duration u32 \[us\] |
//! | `5a1` | DIGITAL_ACCELEROMETER (legacy) | 6 | x y z i16 |
//! | `5a0` | DIGITAL_GYROSCOPE (legacy) | 6 | x y z i16 |
//!
//! | SNS | quantity | a step is |
//! |---|---|---|
//! | 0 | proper acceleration | 0.01 m/s^2 |
//! | 1 | magnetic field | 1/16 uT |
//! | 2 | angular velocity | 1/16 deg/s |
//! | 3 | Euler angles | 1/16 deg: passed over, as sign and order changed in October 2023; use the quaternion |
//! | 5, 6 | linear acceleration, gravity | 0.01 m/s^2: passed over, they add nothing to 0 and the quaternion |
//!
//! - SEQ is the same in all frames of one acquisition and goes up by one, 0 after 255. Within an acquisition the order is
//!   acceleration, magnetic field, angular velocity, (3, 5, 6), quaternion, status. A reading is given as soon as all of
//!   `quantities` are there; it is stamped by its first frame and carries SEQ as its device counter. One that stays
//!   incomplete is counted (unpaired) and never given; a gap in SEQ is counted (lost); both show as GAP_BEFORE.
//! - A frame that is up to 4 acquisitions old came late: its acquisition is gone, it is counted as unpaired.
//! - The quaternion has no SEQ: it belongs to the acquisition that is open, if that began within half a period.
//! - With "status" among the quantities, a sensor in use that is at calibration 0 makes readings NOT_CALIBRATED.
//! - Legacy frames have no SEQ either: an accelerometer and a gyroscope frame are paired by time, as strain boards' halves
//!   are. Their scale depends on the board, which the frames do not tell: `legacy` must. mtb: 2 g and 250 deg/s over
//!   2^15; bno055 (strain2, mtb4 in legacy mode): 0.01 m/s^2 and 1/16 deg/s.
//!
//! Commands on `20a`:
//!
//! | bytes | meaning | answer on `2a0` |
//! |---|---|---|
//! | `34 mask(u16) mode orientation 0 0 0` | what to send: bits as SNS, 4 quaternion, 15 status | none |
//! | `33` | what it was told | 8 bytes of the same form |
//! | `35 ms` | period, 0 stops; the chip's fusion runs at 100 Hz | none |
//! | `4F mask ms` | legacy: mask bit 1 accelerometer, 2 gyroscope, 3 external accelerometer; 0 stops | none |
//!
//! The board does not acknowledge its configuration, and one that was lost would leave it in other axes: so it is asked
//! what it was told, and told again until it agrees. A board that does not answer (an old firmware) is started all the
//! same; one that keeps answering otherwise too, and that is counted as changed.
//!
//! Sources: `TSD-ICUBUNIT-canprotocol-sensorboards.docx` v1.12, `embot_app_application_theIMU.cpp` (icub-firmware b4299211),
//! `canBusInertialMTB` (icub-main 24c1a003). Certain, except mode 0: raw by the document, IMU fusion by the firmware.
//!
//! # Keys
//! ```toml
//! quantities = ["acceleration", "angular_velocity"]  # also "magnetic_field", "orientation", "status"
//! period_ms = 10            # 1 to 255
//! mode = "ndof"             # "ndof", "raw_or_imu" (mode 0, see above), or a Bosch operation mode: "acconly", "magonly",
//!                           # "gyronly", "accmag", "accgyro", "maggyro", "amg", "imu", "compass", "m4g", "ndof_fmc_off"
//! placement = 6             # axes P0 to P7 of the BNO055's datasheet; default: the board's own
//! legacy = "none"           # "mtb" or "bno055": legacy frames of that scale instead
//! legacy_mask = 6           # which legacy sensors; default accelerometer and gyroscope
//! power_on_silence_ms = 0   # see `crate::icub`
//! listen = false            # true: somebody else commands this board; never transmit
//! ```

use crate::icub::{self, Ask, Bringup, Inquiry, Paired, Pairing, class, command};
use crate::{
    Board, Claim, Decoded, Device, EncodeError, Frame, Frames, Mode, Refusal, Spec, SpecError, State, Transmit, device,
};
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use core::f64::consts::PI;
use proprio_topics::{Counter, Imu, Kind, Nanos, Quality, Reading, StampKind};
use serde::Deserialize;

/// Types of the streams.
mod kind {
    pub(super) const LEGACY_GYROSCOPE: u8 = 0;
    pub(super) const LEGACY_ACCELEROMETER: u8 = 1;
    pub(super) const TRIPLE: u8 = 3;
    pub(super) const QUATERNION: u8 = 4;
    pub(super) const STATUS: u8 = 5;
}

/// SNS, and bits of the mask.
mod sensor {
    pub(super) const ACCELERATION: u8 = 0;
    pub(super) const MAGNETIC_FIELD: u8 = 1;
    pub(super) const ANGULAR_VELOCITY: u8 = 2;
    pub(super) const EULER: u8 = 3;
    pub(super) const QUATERNION: u8 = 4;
    pub(super) const LINEAR_ACCELERATION: u8 = 5;
    pub(super) const GRAVITY: u8 = 6;
    pub(super) const STATUS: u8 = 15;
}

/// One step of acceleration \[m/s^2\].
const ACCELERATION_LSB: f64 = 0.01;
/// One step of the magnetic field \[T\].
const FIELD_LSB: f64 = 1e-6 / 16.0;
/// One step of angular velocity \[rad/s\].
const RATE_LSB: f64 = PI / 180.0 / 16.0;
/// One step of a quaternion.
const QUATERNION_LSB: f64 = 1.0 / 16384.0;
/// One step of a legacy mtb accelerometer: 2 g over 2^15 \[m/s^2\].
const MTB_ACCELERATION_LSB: f64 = 2.0 * 9.80665 / 32768.0;
/// One step of a legacy mtb gyroscope: 250 deg/s over 2^15 \[rad/s\].
const MTB_RATE_LSB: f64 = 250.0 / 32768.0 * PI / 180.0;
/// An acquisition that began so many numbers ago is late; one further back is a counter that began anew, or a long gap.
const LATE: u8 = 4;
/// How long an acquisition takes a simulated board \[us\]; real ones take 2 to 6 ms.
const ACQUISITION_US: u32 = 4000;

/// What an IMU measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Proper acceleration.
    Acceleration,
    /// Magnetic field.
    MagneticField,
    /// Angular velocity.
    AngularVelocity,
    /// Orientation as a quaternion.
    Orientation,
    /// How well it is calibrated.
    Status,
}

impl Quantity {
    /// Its bit in the mask.
    const fn bit(self) -> u16 {
        1 << match self {
            Self::Acceleration => sensor::ACCELERATION,
            Self::MagneticField => sensor::MAGNETIC_FIELD,
            Self::AngularVelocity => sensor::ANGULAR_VELOCITY,
            Self::Orientation => sensor::QUATERNION,
            Self::Status => sensor::STATUS,
        }
    }
}

/// How the chip computes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fusion {
    /// Fusion of all three sensors.
    #[default]
    Ndof,
    /// Mode 0: raw sensors by the document, fusion without magnetometer by the firmware.
    RawOrImu,
    /// Accelerometer alone.
    Acconly,
    /// Magnetometer alone.
    Magonly,
    /// Gyroscope alone.
    Gyronly,
    /// Accelerometer and magnetometer.
    Accmag,
    /// Accelerometer and gyroscope.
    Accgyro,
    /// Magnetometer and gyroscope.
    Maggyro,
    /// All three, no fusion.
    Amg,
    /// Fusion of accelerometer and gyroscope.
    Imu,
    /// Heading.
    Compass,
    /// Magnet for gyroscope.
    M4g,
    /// As `ndof`, fast magnetometer calibration off.
    NdofFmcOff,
}

impl Fusion {
    /// The mode byte: 0x80 marks a Bosch operation mode.
    const fn code(self) -> u8 {
        match self {
            Self::RawOrImu => 0x00,
            Self::Ndof => 0x01,
            Self::Acconly => 0x81,
            Self::Magonly => 0x82,
            Self::Gyronly => 0x83,
            Self::Accmag => 0x84,
            Self::Accgyro => 0x85,
            Self::Maggyro => 0x86,
            Self::Amg => 0x87,
            Self::Imu => 0x88,
            Self::Compass => 0x89,
            Self::M4g => 0x8A,
            Self::NdofFmcOff => 0x8B,
        }
    }
}

/// Which legacy frames, hence which scale.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Legacy {
    /// No legacy frames: IMU_TRIPLE and the others.
    #[default]
    None,
    /// An mtb's discrete sensors.
    Mtb,
    /// A BNO055 in legacy mode.
    Bno055,
}

impl Legacy {
    /// Steps of acceleration \[m/s^2\] and angular velocity \[rad/s\].
    const fn lsb(self) -> [f64; 2] {
        match self {
            Self::Mtb => [MTB_ACCELERATION_LSB, MTB_RATE_LSB],
            Self::None | Self::Bno055 => [ACCELERATION_LSB, RATE_LSB],
        }
    }
}

/// The keys of `driver = "icub_imu"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// What a reading must hold; default acceleration and angular velocity.
    pub quantities: Vec<Quantity>,
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// How the chip computes; default ndof.
    pub mode: Fusion,
    /// Placement P0 to P7; default the board's own.
    pub placement: Option<u8>,
    /// Legacy frames; default none.
    pub legacy: Legacy,
    /// Legacy sensors; default 6: internal accelerometer, external gyroscope.
    pub legacy_mask: Option<u8>,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
    /// Somebody else commands this board; default false.
    pub listen: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            quantities: [Quantity::Acceleration, Quantity::AngularVelocity].to_vec(),
            period_ms: 10,
            mode: Fusion::Ndof,
            placement: None,
            legacy: Legacy::None,
            legacy_mask: None,
            power_on_silence_ms: 0,
            listen: false,
        }
    }
}

/// Legacy sensors that are asked for by default: internal accelerometer and external gyroscope.
const LEGACY_MASK: u8 = 0b110;
/// The legacy gyroscope's bit; the others are accelerometers.
const LEGACY_GYROSCOPE: u8 = 0b100;
/// All legacy accelerometers.
const LEGACY_ACCELEROMETERS: u8 = 0b1011;

/// What the keys come to.
#[derive(Debug, Clone, Copy)]
struct Plan {
    address: u8,
    period_ms: u8,
    /// The mask of quantities that make a reading.
    want: u16,
    /// IMU_CONFIG_SET.
    configuration: [u8; 8],
    legacy: Legacy,
    legacy_mask: u8,
}

impl Plan {
    fn new(spec: &Spec, options: &Options) -> Result<Self, SpecError> {
        let address = icub::address(spec)?;
        icub::no_joints(spec)?;
        let period_ms = icub::period_ms("period_ms", options.period_ms)?;
        let want = options
            .quantities
            .iter()
            .fold(0, |mask, quantity| mask | quantity.bit());
        let inertial = Quantity::Acceleration.bit() | Quantity::AngularVelocity.bit();
        // Every reading needs a frame with SEQ to hold it together.
        if want & (inertial | Quantity::MagneticField.bit()) == 0 {
            let expected = "a list with at least one of acceleration, angular_velocity, magnetic_field";
            return Err(SpecError::Keys {
                key: "quantities",
                expected,
            });
        }
        let legacy_mask = options.legacy_mask.unwrap_or(LEGACY_MASK);
        if options.legacy == Legacy::None {
            if options.legacy_mask.is_some() {
                return Err(SpecError::Keys {
                    key: "legacy_mask",
                    expected: "absent without legacy",
                });
            }
        } else {
            if want & !inertial != 0 {
                let expected = "acceleration or angular_velocity or both, with legacy frames";
                return Err(SpecError::Keys {
                    key: "quantities",
                    expected,
                });
            }
            let lacks = (want & Quantity::Acceleration.bit() != 0 && legacy_mask & LEGACY_ACCELEROMETERS == 0)
                || (want & Quantity::AngularVelocity.bit() != 0 && legacy_mask & LEGACY_GYROSCOPE == 0);
            if lacks || legacy_mask > 0xF {
                let expected = "at most 15, with bit 2 for angular_velocity and bit 0, 1 or 3 for acceleration";
                return Err(SpecError::Key {
                    key: "legacy_mask",
                    value: f64::from(legacy_mask),
                    expected,
                });
            }
        }
        let orientation = match options.placement {
            None => 0,
            Some(placement @ 0..=7) => 0x80 | placement,
            Some(other) => {
                return Err(SpecError::Key {
                    key: "placement",
                    value: f64::from(other),
                    expected: "0 to 7",
                });
            }
        };
        let [low, high] = want.to_le_bytes();
        let configuration = [
            command::IMU_CONFIG_SET,
            low,
            high,
            options.mode.code(),
            orientation,
            0,
            0,
            0,
        ];
        Ok(Self {
            address,
            period_ms,
            want,
            configuration,
            legacy: options.legacy,
            legacy_mask,
        })
    }
}

/// Tells a board its configuration and makes sure that it has it.
#[derive(Debug)]
struct Configure {
    address: u8,
    wanted: [u8; 8],
    /// Legacy boards have no such configuration.
    needed: bool,
    /// The board has it, or will not say so.
    settled: bool,
    /// The configuration has been told and its question is next.
    told: bool,
    attempts: u8,
    ask_at: Nanos,
    /// Answers may still come until then.
    counts_until: Nanos,
}

impl Configure {
    fn answer(&mut self, data: &[u8], mode: Mode, frame: &Frame, out: &mut Decoded) {
        if mode == Mode::Listen {
            return;
        }
        let &[_, ref has @ .., _, _, _] = data else {
            return out.fault(Counter::Length, 1, frame.id);
        };
        let [_, wants @ .., _, _, _] = &self.wanted;
        if has.len() != wants.len() {
            return out.fault(Counter::Length, 1, frame.id);
        }
        if frame.t > self.counts_until {
            return out.fault(Counter::Unexpected, 1, frame.id);
        }
        if self.settled {
            // A late answer, to a question asked before the one that settled it.
            return;
        }
        let agrees = has == wants;
        self.settled = agrees || self.attempts >= icub::ATTEMPTS;
        if !agrees {
            self.told = false;
            self.ask_at = Nanos::MIN;
            if self.settled {
                out.fault(Counter::Changed, 1, frame.id);
            }
        }
    }
}

impl Inquiry for Configure {
    fn begin(&mut self) {
        self.settled = !self.needed;
        self.told = false;
        self.attempts = 0;
        self.ask_at = Nanos::MIN;
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        if self.settled {
            return Ask::Done;
        }
        if now < self.ask_at {
            return Ask::Wait;
        }
        let id = icub::to_board(class::POLLING_ANALOG, self.address);
        if !self.told {
            if self.attempts >= icub::ATTEMPTS {
                self.settled = true;
                return Ask::Done;
            }
            self.told = true;
            return Ask::Send(Frame::new(id, &self.wanted));
        }
        self.told = false;
        self.attempts += 1;
        self.ask_at = now + icub::ANSWER_TIMEOUT;
        self.counts_until = now + icub::ANSWER_COUNTS;
        Ask::Send(Frame::new(id, &[command::IMU_CONFIG_GET]))
    }

    fn wake(&self) -> Option<Nanos> {
        Some(self.ask_at)
    }

    fn refusal(&self) -> Option<Refusal> {
        None
    }
}

/// The acquisition that is being put together.
#[derive(Debug, Clone, Copy)]
struct Acquisition {
    open: bool,
    acquired: Nanos,
    stamp: StampKind,
    /// What it holds, as bits of the mask.
    have: u16,
    imu: Imu,
}

impl Acquisition {
    const NONE: Self = Self {
        open: false,
        acquired: Nanos::ZERO,
        stamp: StampKind::None,
        have: 0,
        imu: Imu::ABSENT,
    };
}

/// The host's side of an IMU.
#[derive(Debug)]
pub struct ImuDevice {
    plan: Plan,
    claims: ArrayVec<Claim, 4>,
    bringup: Bringup,
    configure: Configure,
    acquisition: Acquisition,
    /// SEQ of the last acquisition that was begun.
    sequence: Option<u8>,
    /// The sensors in use that the last status said are not calibrated.
    not_calibrated: bool,
    legacy: Pairing<[i16; 3]>,
    /// How long an acquisition may take.
    together: Nanos,
    gap: bool,
    /// A reading has been given: from then on a restart leaves a gap.
    seen: bool,
}

impl ImuDevice {
    /// A board that nothing is known of yet.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, joints, quantities that do not go together, a key out of range.
    pub fn new(spec: &Spec, options: &Options) -> Result<Self, SpecError> {
        let plan = Plan::new(spec, options)?;
        let silence = icub::power_on_silence(options.power_on_silence_ms)?;
        let mode = if options.listen { Mode::Listen } else { spec.mode };
        let is_legacy = plan.legacy != Legacy::None;
        let kinds: &[u8] = if is_legacy {
            &[kind::LEGACY_ACCELEROMETER, kind::LEGACY_GYROSCOPE]
        } else {
            &[kind::TRIPLE, kind::QUATERNION, kind::STATUS]
        };
        let watched = icub::stream(
            class::PERIODIC_INERTIAL,
            plan.address,
            *kinds.first().unwrap_or(&kind::TRIPLE),
        );
        let mut bringup = Bringup::new(spec, mode, silence, watched);
        let id = icub::to_board(class::POLLING_ANALOG, plan.address);
        let mut claims: ArrayVec<Claim, 4> = icub::claims(class::PERIODIC_INERTIAL, plan.address, kinds);
        if is_legacy {
            bringup.start_with(id, &[command::ACC_GYRO_SETUP, plan.legacy_mask, plan.period_ms]);
            bringup.stop_with(id, &[command::ACC_GYRO_SETUP, 0, 0]);
        } else {
            bringup.start_with(id, &[command::IMU_TRANSMIT, plan.period_ms]);
            bringup.stop_with(id, &[command::IMU_TRANSMIT, 0]);
            claims.push(Claim::shared(icub::to_host(class::POLLING_ANALOG, plan.address)));
        }
        let together = Nanos::from_micros(i64::from(plan.period_ms) * 500);
        Ok(Self {
            claims,
            bringup,
            configure: Configure {
                address: plan.address,
                wanted: plan.configuration,
                needed: !is_legacy,
                settled: false,
                told: false,
                attempts: 0,
                ask_at: Nanos::MIN,
                counts_until: Nanos::MIN,
            },
            acquisition: Acquisition::NONE,
            sequence: None,
            not_calibrated: false,
            // A BNO055 board sends the accelerometer first; of an mtb's order nothing is written.
            legacy: Pairing::new(together, plan.legacy == Legacy::Bno055),
            together,
            gap: false,
            seen: false,
            plan,
        })
    }

    /// Finds the acquisition that a frame with `sequence` belongs to: whether it is the open one.
    fn belongs(&mut self, sequence: u8, frame: &Frame, out: &mut Decoded) -> bool {
        if let Some(last) = self.sequence {
            match sequence.wrapping_sub(last) {
                // Unless it is open it has been given, and this is more than was wanted.
                0 => return self.acquisition.open,
                ahead if ahead <= u8::MAX - LATE => {
                    self.abandon(frame, out);
                    if ahead > 1 {
                        out.fault(Counter::Lost, u32::from(ahead) - 1, frame.id);
                        self.gap = true;
                    }
                }
                _ => {
                    out.fault(Counter::Unpaired, 1, frame.id);
                    self.gap = true;
                    return false;
                }
            }
        }
        self.sequence = Some(sequence);
        self.acquisition = Acquisition {
            open: true,
            acquired: frame.t,
            stamp: frame.stamp,
            ..Acquisition::NONE
        };
        true
    }

    /// Gives up an acquisition that stayed incomplete.
    fn abandon(&mut self, frame: &Frame, out: &mut Decoded) {
        if core::mem::take(&mut self.acquisition.open) {
            out.fault(Counter::Unpaired, 1, frame.id);
            self.gap = true;
        }
    }

    /// Notes that the acquisition now holds `bit`, and gives it once it holds all that is wanted.
    fn hold(&mut self, bit: u16, frame: &Frame, out: &mut Decoded) {
        self.acquisition.have |= bit;
        if self.acquisition.have & self.plan.want != self.plan.want {
            return;
        }
        self.acquisition.open = false;
        let Acquisition {
            acquired, stamp, imu, ..
        } = self.acquisition;
        let mut quality = Quality::DEVICE_COUNTER;
        if self.not_calibrated {
            quality |= Quality::NOT_CALIBRATED;
        }
        let counter = u32::from(self.sequence.unwrap_or(0));
        self.give(imu, acquired, stamp, counter, quality, frame, out);
    }

    #[allow(clippy::too_many_arguments)]
    fn give(
        &mut self,
        imu: Imu,
        acquired: Nanos,
        stamp: StampKind,
        device_counter: u32,
        mut quality: Quality,
        frame: &Frame,
        out: &mut Decoded,
    ) {
        if core::mem::take(&mut self.gap) | self.bringup.reading(frame.t) {
            quality |= Quality::GAP_BEFORE;
        }
        self.seen = true;
        let reading = Reading::Imu(imu);
        out.push(
            device::Output {
                output: 0,
                acquired,
                stamp,
                device_counter,
                quality,
                reading,
            },
            frame.id,
        );
    }

    fn triple(&mut self, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let &[sequence, sensor, ..] = data else { return };
        if !matches!(
            sensor,
            sensor::ACCELERATION..=sensor::EULER | sensor::LINEAR_ACCELERATION | sensor::GRAVITY
        ) {
            return out.fault(Counter::Value, 1, frame.id);
        }
        let bit = 1_u16 << sensor;
        if !self.belongs(sequence, frame, out) || self.plan.want & bit == 0 {
            return;
        }
        let imu = &mut self.acquisition.imu;
        let (field, lsb) = match sensor {
            sensor::ACCELERATION => (&mut imu.proper_acceleration, ACCELERATION_LSB),
            sensor::MAGNETIC_FIELD => (&mut imu.magnetic_field, FIELD_LSB),
            // The others are never wanted.
            _ => (&mut imu.angular_velocity, RATE_LSB),
        };
        *field = vector(data, 2).map(|count| f64::from(count) * lsb);
        self.hold(bit, frame, out);
    }

    fn quaternion(&mut self, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let bit = Quantity::Orientation.bit();
        if self.plan.want & bit == 0 {
            return;
        }
        let begun = (self.acquisition.acquired, self.acquisition.stamp);
        if !self.acquisition.open || !icub::within(begun, (frame.t, frame.stamp), self.together) {
            out.fault(Counter::Unpaired, 1, frame.id);
            self.gap = true;
            return;
        }
        let [x, y, z] = vector(data, 2);
        let w = icub::i16_le(data, 0);
        self.acquisition.imu.orientation = [w, x, y, z].map(|count| f64::from(count) * QUATERNION_LSB);
        self.hold(bit, frame, out);
    }

    fn status(&mut self, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let &[sequence, gyroscope, accelerometer, magnetometer, ..] = data else {
            return;
        };
        if gyroscope > 3 || accelerometer > 3 || magnetometer > 3 {
            return out.fault(Counter::Value, 1, frame.id);
        }
        let bit = Quantity::Status.bit();
        if self.plan.want & bit == 0 || !self.belongs(sequence, frame, out) {
            return;
        }
        let lacks = |quantity: Quantity, calibration| self.plan.want & quantity.bit() != 0 && calibration == 0;
        self.not_calibrated = lacks(Quantity::Acceleration, accelerometer)
            || lacks(Quantity::AngularVelocity, gyroscope)
            || lacks(Quantity::MagneticField, magnetometer);
        self.hold(bit, frame, out);
    }

    fn legacy(&mut self, is_gyroscope: bool, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let quantity = if is_gyroscope {
            Quantity::AngularVelocity
        } else {
            Quantity::Acceleration
        };
        if self.plan.want & quantity.bit() == 0 {
            return;
        }
        let counts = vector(data, 0);
        let mut imu = Imu::ABSENT;
        let (mut acquired, mut stamp) = (frame.t, frame.stamp);
        let [acceleration_lsb, rate_lsb] = self.plan.legacy.lsb();
        let mut set = |is_gyroscope: bool, counts: [i16; 3]| {
            if is_gyroscope {
                imu.angular_velocity = counts.map(|count| f64::from(count) * rate_lsb);
            } else {
                imu.proper_acceleration = counts.map(|count| f64::from(count) * acceleration_lsb);
            }
        };
        set(is_gyroscope, counts);
        if self.plan.want != quantity.bit() {
            let mut unpaired = 0;
            let paired = self.legacy.push(is_gyroscope, frame, counts, &mut unpaired);
            if unpaired > 0 {
                out.fault(Counter::Unpaired, unpaired, frame.id);
                self.gap = true;
            }
            let Paired::With(t, kind, first) = paired else { return };
            set(!is_gyroscope, first);
            (acquired, stamp) = (t, kind);
        }
        self.give(imu, acquired, stamp, 0, Quality::GOOD, frame, out);
    }

    /// Forgets what has not been completed: the counter may begin anew.
    fn reset(&mut self) {
        self.acquisition.open = false;
        self.sequence = None;
        self.not_calibrated = false;
        self.legacy.reset();
        self.gap |= self.seen;
    }
}

/// Three signed 16-bit numbers from `at`.
fn vector(data: &[u8], at: usize) -> [i16; 3] {
    [
        icub::i16_le(data, at),
        icub::i16_le(data, at + 2),
        icub::i16_le(data, at + 4),
    ]
}

impl Device for ImuDevice {
    fn kind(&self) -> Kind {
        Kind::Imu
    }

    fn claims(&self) -> &[Claim] {
        &self.claims
    }

    fn on_frame(&mut self, frame: &Frame, out: &mut Decoded) {
        if !self.bringup.active() {
            return;
        }
        let is_legacy = self.plan.legacy != Legacy::None;
        if let Some(stream) = icub::stream_type(frame.id, class::PERIODIC_INERTIAL, self.plan.address) {
            let expected = match stream {
                kind::LEGACY_GYROSCOPE | kind::LEGACY_ACCELEROMETER if is_legacy => 6,
                kind::TRIPLE | kind::QUATERNION | kind::STATUS if !is_legacy => 8,
                _ => return,
            };
            let Some(data) = icub::payload(frame, out) else { return };
            match stream {
                _ if data.len() != expected => out.fault(Counter::Length, 1, frame.id),
                kind::TRIPLE => self.triple(data, frame, out),
                kind::QUATERNION => self.quaternion(data, frame, out),
                kind::STATUS => self.status(data, frame, out),
                _ => self.legacy(stream == kind::LEGACY_GYROSCOPE, data, frame, out),
            }
        } else if !is_legacy
            && frame.id == icub::to_host(class::POLLING_ANALOG, self.plan.address)
            && let Some(data) = icub::payload(frame, out)
        {
            match data.first() {
                Some(&command::IMU_CONFIG_GET) => self.configure.answer(data, self.bringup.mode(), frame, out),
                // Answers to other questions are for others.
                Some(_) => {}
                None => out.fault(Counter::Length, 1, frame.id),
            }
        }
    }

    fn poll_transmit(&mut self, now: Nanos, out: &mut Decoded) -> Option<Transmit> {
        let was_silent = self.bringup.is_silent();
        let transmit = self.bringup.poll(now, &mut self.configure, out);
        if self.bringup.is_silent() && !was_silent {
            self.reset();
        }
        transmit
    }

    fn next_wake(&self) -> Option<Nanos> {
        self.bringup.next_wake(&self.configure)
    }

    fn state(&self) -> State {
        self.bringup.state(&self.configure)
    }

    fn stop(&mut self, _now: Nanos) {
        self.bringup.stop();
    }

    fn restart(&mut self, _now: Nanos) {
        self.bringup.restart();
        self.reset();
    }
}

/// The board's own side.
#[derive(Debug)]
pub struct ImuBoard {
    plan: Plan,
    period: Nanos,
    streaming: bool,
    /// What it was told to send, as IMU_CONFIG_SET has it.
    configuration: Option<[u8; 8]>,
    /// What it was told to send of legacy frames.
    legacy_mask: Option<u8>,
    /// SEQ of the last acquisition.
    sequence: u8,
}

impl ImuBoard {
    /// A board just powered. With `listen` somebody else has started it already.
    ///
    /// # Errors
    /// As [`ImuDevice::new`].
    pub fn new(spec: &Spec, options: &Options) -> Result<Self, SpecError> {
        let plan = Plan::new(spec, options)?;
        Ok(Self {
            period: Nanos::from_millis(i64::from(plan.period_ms)),
            streaming: options.listen,
            configuration: None,
            legacy_mask: None,
            sequence: 0,
            plan,
        })
    }

    /// What a reading is sent as: what it was told, else what the keys say.
    fn mask(&self) -> u16 {
        match (self.plan.legacy, self.configuration, self.legacy_mask) {
            (Legacy::None, Some([_, low, high, ..]), _) => u16::from_le_bytes([low, high]),
            (Legacy::Mtb | Legacy::Bno055, _, Some(mask)) => {
                let bit = |sensors: u8, quantity: Quantity| if mask & sensors == 0 { 0 } else { quantity.bit() };
                bit(LEGACY_ACCELEROMETERS, Quantity::Acceleration) | bit(LEGACY_GYROSCOPE, Quantity::AngularVelocity)
            }
            _ => self.plan.want,
        }
    }

    fn send(&self, kind: u8, data: &[u8], out: &mut Frames) {
        let _ = out.try_push(Frame::new(
            icub::stream(class::PERIODIC_INERTIAL, self.plan.address, kind),
            data,
        ));
    }
}

impl Board for ImuBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let is_legacy = self.plan.legacy != Legacy::None;
        let board = if self.plan.legacy == Legacy::Mtb {
            icub::board::MTB
        } else {
            icub::board::STRAIN2
        };
        icub::answer_management(frame, class::POLLING_ANALOG, self.plan.address, board, out);
        let Some(bytes) = icub::command_for(frame, class::POLLING_ANALOG, self.plan.address) else {
            return;
        };
        match *bytes {
            [command::IMU_CONFIG_SET, a, b, c, d, e, f, g] if !is_legacy => {
                // As the firmware does: a new configuration stops the stream.
                self.streaming = false;
                self.configuration = Some([command::IMU_CONFIG_SET, a, b, c, d, e, f, g]);
            }
            [command::IMU_CONFIG_GET] if !is_legacy => {
                let mut answer = self.configuration.unwrap_or_default();
                if let Some(first) = answer.first_mut() {
                    *first = command::IMU_CONFIG_GET;
                }
                let _ = out.try_push(Frame::new(
                    icub::to_host(class::POLLING_ANALOG, self.plan.address),
                    &answer,
                ));
            }
            [command::IMU_TRANSMIT, ms] if !is_legacy => {
                // A board that was never told what to send sends nothing.
                self.streaming = ms > 0 && self.configuration.is_some_and(|c| c[1] != 0 || c[2] != 0);
                if ms > 0 {
                    self.period = Nanos::from_millis(i64::from(ms));
                    self.sequence = 0;
                }
            }
            [command::ACC_GYRO_SETUP, mask, ms] if is_legacy => {
                self.streaming = mask != 0 && ms > 0;
                self.legacy_mask = Some(mask);
                if ms > 0 {
                    self.period = Nanos::from_millis(i64::from(ms));
                }
            }
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.streaming.then_some(self.period)
    }

    fn encode(&mut self, output: u8, reading: &Reading, quality: Quality, out: &mut Frames) -> Result<(), EncodeError> {
        let Reading::Imu(imu) = reading else {
            return Err(EncodeError::Kind);
        };
        if output != 0 {
            return Err(EncodeError::Output(output));
        }
        let mask = self.mask();
        let sends = |quantity: Quantity| mask & quantity.bit() != 0;
        let finite = |values: &[f64]| values.iter().all(|value| value.is_finite());
        if (sends(Quantity::Acceleration) && !finite(&imu.proper_acceleration))
            || (sends(Quantity::AngularVelocity) && !finite(&imu.angular_velocity))
            || (sends(Quantity::MagneticField) && !finite(&imu.magnetic_field))
            || (sends(Quantity::Orientation) && !finite(&imu.orientation))
        {
            return Err(EncodeError::NotFinite);
        }
        let bytes = |values: [f64; 3], lsb: f64| {
            let [[a, b], [c, d], [e, f]] = values.map(|value| icub::quantise_i16(value, lsb).to_le_bytes());
            [a, b, c, d, e, f]
        };
        let [acceleration_lsb, rate_lsb] = self.plan.legacy.lsb();
        let acceleration = bytes(imu.proper_acceleration, acceleration_lsb);
        let rate = bytes(imu.angular_velocity, rate_lsb);
        if self.plan.legacy != Legacy::None {
            if sends(Quantity::Acceleration) {
                self.send(kind::LEGACY_ACCELEROMETER, &acceleration, out);
            }
            if sends(Quantity::AngularVelocity) {
                self.send(kind::LEGACY_GYROSCOPE, &rate, out);
            }
            return Ok(());
        }
        self.sequence = self.sequence.wrapping_add(1);
        let sequence = self.sequence;
        let triple = |sensor: u8, [a, b, c, d, e, f]: [u8; 6]| [sequence, sensor, a, b, c, d, e, f];
        if sends(Quantity::Acceleration) {
            self.send(kind::TRIPLE, &triple(sensor::ACCELERATION, acceleration), out);
        }
        if sends(Quantity::MagneticField) {
            let field = bytes(imu.magnetic_field, FIELD_LSB);
            self.send(kind::TRIPLE, &triple(sensor::MAGNETIC_FIELD, field), out);
        }
        if sends(Quantity::AngularVelocity) {
            self.send(kind::TRIPLE, &triple(sensor::ANGULAR_VELOCITY, rate), out);
        }
        if sends(Quantity::Orientation) {
            let [w, x, y, z] = imu.orientation;
            let [w0, w1] = icub::quantise_i16(w, QUATERNION_LSB).to_le_bytes();
            let [a, b, c, d, e, f] = bytes([x, y, z], QUATERNION_LSB);
            self.send(kind::QUATERNION, &[w0, w1, a, b, c, d, e, f], out);
        }
        if sends(Quantity::Status) {
            let calibration = if quality.contains(Quality::NOT_CALIBRATED) {
                0
            } else {
                3
            };
            let [a, b, c, d] = ACQUISITION_US.to_le_bytes();
            let status = [sequence, calibration, calibration, calibration, a, b, c, d];
            self.send(kind::STATUS, &status, out);
        }
        Ok(())
    }
}
