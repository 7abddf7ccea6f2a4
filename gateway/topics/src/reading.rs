//! A device's measurement in SI units, one variant per kind of quantity, and its form in shared
//! memory: the kind's number and up to [`VALUES`] numbers.

use crate::code::coded;
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// A joint's (or a motor shaft's) state, positive along the axis that the configuration states.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointState {
    /// Position \[rad, or m for a prismatic joint\]. NaN if this device does not report it.
    pub position: f64,
    /// Velocity \[rad/s or m/s\] as the device reports it. NaN if not reported.
    pub velocity: f64,
    /// Acceleration \[rad/s^2 or m/s^2\]. NaN if not reported.
    pub acceleration: f64,
    /// Measured torque \[Nm, or N\], by the parent link on the child link along the axis. NaN if
    /// not measured.
    pub torque: f64,
    /// Motor current \[A\]. NaN if not reported.
    pub current: f64,
}

impl JointState {
    /// Nothing reported yet.
    pub const ABSENT: Self = Self {
        position: f64::NAN,
        velocity: f64::NAN,
        acceleration: f64::NAN,
        torque: f64::NAN,
        current: f64::NAN,
    };
}

/// A six-axis force/torque sensor's reading, in the sensor's own axes and about the sensor's own
/// origin.
///
/// The gateway passes on the device's values in SI units. The body that the wrench acts on and the
/// pose of the sensor frame are in the estimator's configuration (`[[force_torque]]`: `frame`,
/// `direction`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wrench {
    /// Force \[N\], sensor axes.
    pub force: [f64; 3],
    /// Torque \[Nm\], sensor axes, about the sensor's origin. NaN if the sensor measures none.
    pub torque: [f64; 3],
}

/// An inertial measurement unit's reading, in the IMU's axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Imu {
    /// Proper acceleration of the IMU's origin \[m/s^2\]: classical acceleration minus gravity. At
    /// rest it points up.
    pub proper_acceleration: [f64; 3],
    /// Angular velocity \[rad/s\] with respect to an inertial frame.
    pub angular_velocity: [f64; 3],
    /// Angular acceleration \[rad/s^2\]. NaN if not reported.
    pub angular_acceleration: [f64; 3],
    /// Magnetic field \[T\]. NaN if not reported.
    pub magnetic_field: [f64; 3],
    /// Orientation as a unit quaternion w, x, y, z (world from IMU, by the device's own filter).
    /// NaN if not reported.
    pub orientation: [f64; 4],
}

impl Imu {
    /// Nothing reported yet.
    pub const ABSENT: Self = Self {
        proper_acceleration: [f64::NAN; 3],
        angular_velocity: [f64::NAN; 3],
        angular_acceleration: [f64::NAN; 3],
        magnetic_field: [f64::NAN; 3],
        orientation: [f64::NAN; 4],
    };
}

/// Raw strain gauge counts of a force/torque sensor, before its calibration matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gauges {
    /// Analog-to-digital counts of channels 0 to 5, as the device sends them.
    pub counts: [i32; 6],
}

/// A device's temperature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Temperature {
    /// Temperature \[degrees Celsius\].
    pub celsius: f64,
}

/// A motor board's state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Actuator {
    /// Duty cycle of the power stage, -1 to 1. NaN if not reported.
    pub duty: f64,
    /// Control mode, the device's own code (see the driver).
    pub mode: u32,
    /// Encoder state, the device's own bits (see the driver).
    pub encoder: u32,
    /// Fault bits, the device's own (see the driver); 0 is no fault.
    pub faults: u32,
}

/// A patch of tactile skin: one triangle of twelve taxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Skin {
    /// The triangle's number on its device.
    pub triangle: u32,
    /// Pressure on each taxel, as the device scales it (see the driver). NaN if not reported.
    pub taxels: [f64; 12],
}

/// One reading of one channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reading {
    /// A joint's state.
    Joint(JointState),
    /// A force/torque sensor's wrench.
    Wrench(Wrench),
    /// An inertial measurement unit's accelerations, rates and orientation.
    Imu(Imu),
    /// A force/torque sensor's uncalibrated gauges.
    Gauges(Gauges),
    /// A temperature.
    Temperature(Temperature),
    /// A motor board's state.
    Actuator(Actuator),
    /// A patch of skin.
    Skin(Skin),
}

// The words are also the first parts of CSV columns.
coded! {
    /// The kind of a reading. The kind of a channel is that of its main reading; a channel may also
    /// carry readings of other kinds, such as the temperature of a force/torque sensor.
    pub enum Kind {
        /// [`Reading::Joint`].
        Joint = 0 => "joint",
        /// [`Reading::Wrench`].
        Wrench = 1 => "wrench",
        /// [`Reading::Imu`].
        Imu = 2 => "imu",
        /// [`Reading::Gauges`].
        Gauges = 3 => "gauges",
        /// [`Reading::Temperature`].
        Temperature = 4 => "temperature",
        /// [`Reading::Actuator`].
        Actuator = 5 => "actuator",
        /// [`Reading::Skin`].
        Skin = 6 => "skin",
    }
}

/// The largest number of values of a reading.
pub const VALUES: usize = 16;

impl Kind {
    /// The names of a reading's values, in their order: those of CSV columns.
    #[must_use]
    pub const fn fields(self) -> &'static [&'static str] {
        match self {
            Self::Joint => &["position", "velocity", "acceleration", "torque", "current"],
            Self::Wrench => &["fx", "fy", "fz", "tx", "ty", "tz"],
            Self::Imu => &[
                "ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz", "mx", "my", "mz", "qw",
                "qx", "qy", "qz",
            ],
            Self::Gauges => &["g0", "g1", "g2", "g3", "g4", "g5"],
            Self::Temperature => &["temperature"],
            Self::Actuator => &["duty", "mode", "encoder", "faults"],
            Self::Skin => &[
                "triangle", "p0", "p1", "p2", "p3", "p4", "p5", "p6", "p7", "p8", "p9", "p10",
                "p11",
            ],
        }
    }
}

impl Reading {
    /// Its kind.
    #[must_use]
    pub const fn kind(&self) -> Kind {
        match self {
            Self::Joint(_) => Kind::Joint,
            Self::Wrench(_) => Kind::Wrench,
            Self::Imu(_) => Kind::Imu,
            Self::Gauges(_) => Kind::Gauges,
            Self::Temperature(_) => Kind::Temperature,
            Self::Actuator(_) => Kind::Actuator,
            Self::Skin(_) => Kind::Skin,
        }
    }

    /// Its values in the order of [`Kind::fields`]; zero beyond them.
    #[must_use]
    pub fn values(&self) -> [f64; VALUES] {
        match self {
            Self::Joint(j) => {
                padded([[j.position, j.velocity, j.acceleration, j.torque, j.current]])
            }
            Self::Wrench(w) => padded([w.force, w.torque]),
            Self::Imu(i) => {
                let [w, x, y, z] = i.orientation;
                padded([
                    i.proper_acceleration,
                    i.angular_velocity,
                    i.angular_acceleration,
                    i.magnetic_field,
                    [w, x, y],
                    [z, 0.0, 0.0],
                ])
            }
            Self::Gauges(g) => padded([g.counts.map(f64::from)]),
            Self::Temperature(t) => padded([[t.celsius]]),
            Self::Actuator(a) => {
                let [mode, encoder, faults] = [a.mode, a.encoder, a.faults].map(f64::from);
                padded([[a.duty, mode, encoder, faults]])
            }
            Self::Skin(s) => {
                let mut values = [0.0; VALUES];
                let all = core::iter::once(f64::from(s.triangle)).chain(s.taxels);
                values.iter_mut().zip(all).for_each(|(to, from)| *to = from);
                values
            }
        }
    }

    /// The inverse of [`Reading::values`]; `None` if a value that counts something is no integer
    /// of its range.
    #[must_use]
    pub fn from_values(kind: Kind, values: &[f64; VALUES]) -> Option<Self> {
        let [
            v0,
            v1,
            v2,
            v3,
            v4,
            v5,
            v6,
            v7,
            v8,
            v9,
            v10,
            v11,
            v12,
            v13,
            v14,
            v15,
        ] = *values;
        Some(match kind {
            Kind::Joint => Self::Joint(JointState {
                position: v0,
                velocity: v1,
                acceleration: v2,
                torque: v3,
                current: v4,
            }),
            Kind::Wrench => Self::Wrench(Wrench {
                force: [v0, v1, v2],
                torque: [v3, v4, v5],
            }),
            Kind::Imu => Self::Imu(Imu {
                proper_acceleration: [v0, v1, v2],
                angular_velocity: [v3, v4, v5],
                angular_acceleration: [v6, v7, v8],
                magnetic_field: [v9, v10, v11],
                orientation: [v12, v13, v14, v15],
            }),
            Kind::Gauges => {
                let mut counts = [0; 6];
                for (count, value) in counts.iter_mut().zip(values) {
                    *count = i32::try_from(integer(*value)?).ok()?;
                }
                Self::Gauges(Gauges { counts })
            }
            Kind::Temperature => Self::Temperature(Temperature { celsius: v0 }),
            Kind::Actuator => {
                let [mode, encoder, faults] = [unsigned(v1)?, unsigned(v2)?, unsigned(v3)?];
                Self::Actuator(Actuator {
                    duty: v0,
                    mode,
                    encoder,
                    faults,
                })
            }
            Kind::Skin => Self::Skin(Skin {
                triangle: unsigned(v0)?,
                taxels: [v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12],
            }),
        })
    }
}

fn padded<const N: usize, const M: usize>(parts: [[f64; N]; M]) -> [f64; VALUES] {
    let mut values = [0.0; VALUES];
    let all = parts.as_flattened();
    values
        .iter_mut()
        .zip(all)
        .for_each(|(to, from)| *to = *from);
    values
}

/// `value` as an integer, if it is one of at most 32 bits.
#[allow(clippy::cast_possible_truncation)] // within the range
fn integer(value: f64) -> Option<i64> {
    let nearest = value as i64;
    (value.abs() < 4_294_967_296.0 && nearest as f64 == value).then_some(nearest)
}

fn unsigned(value: f64) -> Option<u32> {
    u32::try_from(integer(value)?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn each_value_of_a_reading_has_a_name() {
        for kind in Kind::ALL {
            let mut values = [f64::NAN; VALUES];
            for (value, number) in values.iter_mut().zip(0_u8..) {
                *value = f64::from(number);
            }
            let back = Reading::from_values(kind, &values).unwrap().values();
            let count = kind.fields().len();
            assert_eq!(back[..count], values[..count], "{kind}");
            assert!(back[count..].iter().all(|v| *v == 0.0), "{kind}");
        }
    }

    #[test]
    fn counts_are_integers_of_their_range() {
        let reading = |kind, v| Reading::from_values(kind, &[v; VALUES]);
        for bad in [f64::NAN, f64::INFINITY, 0.5, 5e9, -5e9] {
            assert_eq!(reading(Kind::Gauges, bad), None);
            assert_eq!(reading(Kind::Actuator, bad), None);
            assert_eq!(reading(Kind::Skin, bad), None);
        }
        assert_eq!(reading(Kind::Actuator, -1.0), None);
        assert_eq!(reading(Kind::Gauges, 3e9), None);
        assert!(reading(Kind::Gauges, -2_147_483_648.0).is_some());
        assert!(reading(Kind::Actuator, 4_294_967_295.0).is_some());
    }

    proptest! {
        #[test]
        fn any_values_are_legal_input(code in 0..9_u32, values: [f64; VALUES]) {
            if let Some(kind) = crate::Code::<Kind>::of_number(code).get()
                && let Some(reading) = Reading::from_values(kind, &values)
            {
                let count = kind.fields().len();
                for (back, value) in reading.values().iter().zip(&values).take(count) {
                    prop_assert!(back == value || back.to_bits() == value.to_bits());
                }
            }
        }
    }
}
