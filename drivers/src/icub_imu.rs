//! The IMU on iCub boards strain2, strain2c, mtb4, mtb4c and rfe (a Bosch BNO055), and the legacy
//! inertial frames of mtb.
//!
//! Streams of address `a`, little-endian, class 5:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `5a3` | IMU_TRIPLE | 8 | SEQ u8, SNS u8, x y z i16 |
//! | `5a4` | IMU_QUATERNION | 8 | w x y z i16, in 1/16384; no SEQ |
//! | `5a5` | IMU_STATUS | 8 | SEQ u8, calibrations gyr, acc, mag (0 to 3), duration u32 \[us\] |
//! | `5a1` | DIGITAL_ACCELEROMETER (legacy) | 6 | x y z i16 |
//! | `5a0` | DIGITAL_GYROSCOPE (legacy) | 6 | x y z i16 |
//!
//! | SNS | quantity | step |
//! |---|---|---|
//! | 0 | proper acceleration | 0.01 m/s^2 |
//! | 1 | magnetic field | 1/16 uT |
//! | 2 | angular velocity | 1/16 deg/s |
//! | 3 | Euler angles (ignored) | 1/16 deg |
//! | 5, 6 | linear acceleration, gravity (ignored) | 0.01 m/s^2 |
//!
//! Euler angles are ignored because their sign and order changed in October 2023; use the
//! quaternion. Linear acceleration and gravity follow from 0 and the quaternion.
//!
//! - SEQ is the same in all frames of one acquisition and goes up by one, 0 after 255. Within an
//!   acquisition the order is acceleration, magnetic field, angular velocity, (3, 5, 6),
//!   quaternion, status. A reading is complete when all of `quantities` have arrived. Its stamp is
//!   that of its first frame, its device counter is SEQ. An incomplete reading is counted
//!   (unpaired) and dropped; a gap in SEQ is counted (lost). Both set GAP_BEFORE.
//!   The first acquisition that is heard may have begun before; after a command to the board SEQ
//!   may jump once, because the board begins anew. Neither is a fault.
//! - A frame that is up to 4 acquisitions old is late: it is counted as unpaired.
//! - The quaternion has no SEQ: it belongs to the current acquisition, if that began within half a
//!   period.
//! - With "status" among the quantities, a sensor in use that is at calibration 0 makes readings
//!   NOT_CALIBRATED.
//! - Legacy frames have no SEQ either: an accelerometer and a gyroscope frame are paired by time,
//!   as strain boards' halves are. Their scale depends on the board and is not in the frames:
//!   `legacy` states it. mtb: 2 g and 250 deg/s over 2^15; bno055 (strain2, mtb4 in legacy mode):
//!   0.01 m/s^2 and 1/16 deg/s.
//!
//! Commands on `20a`:
//!
//! | bytes | meaning | answer on `2a0` |
//! |---|---|---|
//! | `34 mask(u16) mode orientation 0 0 0` | mask: bits as SNS, 4 quaternion, 15 status | none |
//! | `33` | get the configuration | 8 bytes of the same form |
//! | `35 ms` | period, 0 stops; the chip's fusion runs at 100 Hz | none |
//! | `4F mask ms` | legacy: mask bit 1 acc, 2 gyr, 3 external acc; 0 stops | none |
//!
//! The board does not acknowledge its configuration, and a lost one would leave it with other axes.
//! Therefore the driver reads the configuration back and repeats it until it matches. A board that
//! does not answer (old firmware) is started anyway. So is one whose answer never matches, which is
//! counted as changed.
//!
//! Sources: `TSD-ICUBUNIT-canprotocol-sensorboards.docx` v1.12, `embot_app_application_theIMU.cpp`
//! (icub-firmware b4299211), `canBusInertialMTB` (icub-main 24c1a003). Certain, except mode 0: raw
//! by the document, IMU fusion by the firmware.
//!
//! # Keys
//! ```toml
//! quantities = ["acceleration", "angular_velocity"]
//!                           # also "magnetic_field", "orientation", "status"
//! period_ms = 10            # 1 to 255
//! mode = "ndof"             # "ndof", "raw_or_imu" (mode 0, see above), or a Bosch operation mode:
//!                           # "acconly", "magonly", "gyronly", "accmag", "accgyro", "maggyro",
//!                           # "amg", "imu", "compass", "m4g", "ndof_fmc_off"
//! placement = 6             # axes P0 to P7 of the BNO055's datasheet; default: the board's own
//! legacy = "none"           # "mtb" or "bno055": legacy frames of that scale instead
//! # legacy_mask = 6         # with legacy: which sensors; default accelerometer and gyroscope
//! power_on_silence_ms = 0   # see `crate::icub`
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::ImuBoard;
pub use frames::{Fusion, Legacy, Quantity};
pub use options::Options;

use crate::icub;
use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::ImuDevice;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "icub_imu";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        ImuDevice::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(ImuBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::boards(seen, Self::NAME)
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
