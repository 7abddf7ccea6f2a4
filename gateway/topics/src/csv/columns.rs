//! The columns of a table: their names, and the conversion between a value and its cells.

use crate::{Actuator, Gauges, Imu, JointState, Kind, Quality, Reading, Temperature, Wrench};
use std::string::String;

/// The quantity in one column of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Field {
    Joint(u8),
    Wrench(u8),
    Imu(u8),
    Gauge(u8),
    Temperature,
    Actuator(u8),
    Quality,
    Active,
}

const JOINT: [&str; 5] = ["position", "velocity", "acceleration", "torque", "current"];
const WRENCH: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];
const IMU: [&str; 16] = [
    "ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz", "mx", "my", "mz", "qw", "qx", "qy",
    "qz",
];
const GAUGES: [&str; 6] = ["g0", "g1", "g2", "g3", "g4", "g5"];
const ACTUATOR: [&str; 4] = ["duty", "mode", "encoder", "faults"];
/// The vectors of an IMU's reading; each is present or absent as a whole.
const IMU_GROUPS: [core::ops::Range<usize>; 5] = [0..3, 3..6, 6..9, 9..12, 12..16];

fn position(names: &[&str], name: &str) -> Option<u8> {
    names
        .iter()
        .position(|n| *n == name)
        .and_then(|i| u8::try_from(i).ok())
}

/// The kind of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum What {
    /// A channel of the gateway.
    Channel(Kind),
    /// A contact that is declared present or absent.
    Contact,
}

/// A channel or contact of a log.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Series {
    /// Its kind.
    pub what: What,
    /// Its name.
    pub name: String,
}

/// The value of a series in one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// A reading and its quality flags.
    Reading(Reading, Quality),
    /// Whether a contact is present from here on.
    Active(bool),
}

/// The values of one series in the row that is being read or written.
#[derive(Clone)]
pub(super) struct Cells {
    joint: [f64; 5],
    wrench: [f64; 6],
    imu: [f64; 16],
    gauges: [f64; 6],
    actuator: [f64; 4],
    temperature: f64,
    quality: f64,
    active: f64,
}

impl Cells {
    pub(super) const EMPTY: Self = Self {
        joint: [f64::NAN; 5],
        wrench: [f64::NAN; 6],
        imu: [f64::NAN; 16],
        gauges: [f64::NAN; 6],
        actuator: [f64::NAN; 4],
        temperature: f64::NAN,
        quality: f64::NAN,
        active: f64::NAN,
    };

    pub(super) fn slot(&mut self, field: Field) -> Option<&mut f64> {
        match field {
            Field::Joint(i) => self.joint.get_mut(usize::from(i)),
            Field::Wrench(i) => self.wrench.get_mut(usize::from(i)),
            Field::Imu(i) => self.imu.get_mut(usize::from(i)),
            Field::Gauge(i) => self.gauges.get_mut(usize::from(i)),
            Field::Actuator(i) => self.actuator.get_mut(usize::from(i)),
            Field::Temperature => Some(&mut self.temperature),
            Field::Quality => Some(&mut self.quality),
            Field::Active => Some(&mut self.active),
        }
    }
}

/// `Some(true)` if all of `values` are present, `Some(false)` if none is, otherwise `None`.
fn all_or_none(values: &[f64]) -> Option<bool> {
    let there = values.iter().filter(|v| !v.is_nan()).count();
    if there == values.len() {
        Some(true)
    } else if there == 0 {
        Some(false)
    } else {
        None
    }
}

pub(super) const fn word(what: What) -> &'static str {
    match what {
        What::Channel(kind) => kind.word(),
        What::Contact => "contact",
    }
}

/// Parses a column's name into kind (`None`: a channel's quality), name and field.
pub(super) fn parse_column(column: &str) -> Option<(Option<What>, &str, Field)> {
    let (front, field) = column.rsplit_once('/')?;
    if let Some((head, name)) = front.split_once('/') {
        let what = match head {
            "joint" => Some(What::Channel(Kind::Joint)),
            "wrench" => Some(What::Channel(Kind::Wrench)),
            "imu" => Some(What::Channel(Kind::Imu)),
            "contact" => Some(What::Contact),
            _ => None,
        };
        if let Some(what) = what
            && !name.is_empty()
        {
            return parse_field(what, field).map(|f| (Some(what), name, f));
        }
    }
    (field == "quality" && !front.is_empty()).then_some((None, front, Field::Quality))
}

pub(super) fn parse_field(what: What, field: &str) -> Option<Field> {
    if field == "quality" && what != What::Contact {
        return Some(Field::Quality);
    }
    match what {
        What::Channel(Kind::Joint) => position(&JOINT, field)
            .map(Field::Joint)
            .or_else(|| position(&ACTUATOR, field).map(Field::Actuator)),
        What::Channel(Kind::Wrench) => position(&WRENCH, field)
            .map(Field::Wrench)
            .or_else(|| position(&GAUGES, field).map(Field::Gauge))
            .or_else(|| (field == "temperature").then_some(Field::Temperature)),
        What::Channel(Kind::Imu) => position(&IMU, field).map(Field::Imu),
        What::Contact => (field == "active").then_some(Field::Active),
    }
}

/// Passes the readings in `cells` to `push`; `Err` names an incomplete vector.
pub(super) fn items_of(
    series: &Series,
    cells: &Cells,
    mut push: impl FnMut(Value),
) -> Result<(), &'static str> {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let quality = if cells.quality.is_nan() {
        Quality::GOOD
    } else {
        Quality(cells.quality as u32)
    };
    match series.what {
        What::Contact => {
            if !cells.active.is_nan() {
                push(Value::Active(cells.active != 0.0));
            }
        }
        What::Channel(Kind::Joint) => {
            let [position, velocity, acceleration, torque, current] = cells.joint;
            if cells.joint.iter().any(|v| !v.is_nan()) {
                let state = JointState {
                    position,
                    velocity,
                    acceleration,
                    torque,
                    current,
                };
                push(Value::Reading(Reading::Joint(state), quality));
            }
            if all_or_none(&cells.actuator).ok_or("duty, mode, encoder, faults")? {
                let [duty, mode, encoder, faults] = cells.actuator;
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let state = Actuator {
                    duty,
                    mode: mode as u32,
                    encoder: encoder as u32,
                    faults: faults as u32,
                    reserved: 0,
                };
                push(Value::Reading(Reading::Actuator(state), quality));
            }
        }
        What::Channel(Kind::Wrench) => {
            let [fx, fy, fz, tx, ty, tz] = cells.wrench;
            if all_or_none(&cells.wrench).ok_or("fx fy fz tx ty tz")? {
                let wrench = Wrench {
                    force: [fx, fy, fz],
                    torque: [tx, ty, tz],
                };
                push(Value::Reading(Reading::Wrench(wrench), quality));
            }
            if all_or_none(&cells.gauges).ok_or("g0 to g5")? {
                #[allow(clippy::cast_possible_truncation)]
                let counts = cells.gauges.map(|g| g as i32);
                push(Value::Reading(Reading::Gauges(Gauges { counts }), quality));
            }
            if !cells.temperature.is_nan() {
                push(Value::Reading(
                    Reading::Temperature(Temperature {
                        celsius: cells.temperature,
                    }),
                    quality,
                ));
            }
        }
        What::Channel(Kind::Imu) => {
            for (group, part) in IMU_GROUPS.into_iter().zip([
                "ax ay az",
                "gx gy gz",
                "alx aly alz",
                "mx my mz",
                "qw qx qy qz",
            ]) {
                all_or_none(cells.imu.get(group).unwrap_or_default()).ok_or(part)?;
            }
            if cells.imu.iter().any(|v| !v.is_nan()) {
                let [
                    ax,
                    ay,
                    az,
                    gx,
                    gy,
                    gz,
                    alx,
                    aly,
                    alz,
                    mx,
                    my,
                    mz,
                    qw,
                    qx,
                    qy,
                    qz,
                ] = cells.imu;
                let imu = Imu {
                    proper_acceleration: [ax, ay, az],
                    angular_velocity: [gx, gy, gz],
                    angular_acceleration: [alx, aly, alz],
                    magnetic_field: [mx, my, mz],
                    orientation: [qw, qx, qy, qz],
                };
                push(Value::Reading(Reading::Imu(imu), quality));
            }
        }
    }
    Ok(())
}

pub(super) fn field_word(field: Field) -> &'static str {
    let of = |names: &[&'static str], i: u8| names.get(usize::from(i)).copied().unwrap_or_default();
    match field {
        Field::Joint(i) => of(&JOINT, i),
        Field::Wrench(i) => of(&WRENCH, i),
        Field::Imu(i) => of(&IMU, i),
        Field::Gauge(i) => of(&GAUGES, i),
        Field::Actuator(i) => of(&ACTUATOR, i),
        Field::Temperature => "temperature",
        Field::Quality => "quality",
        Field::Active => "active",
    }
}

/// The inverse of [`items_of`].
pub(super) fn spread(value: &Value, cells: &mut Cells) {
    match value {
        Value::Active(active) => cells.active = f64::from(u8::from(*active)),
        Value::Reading(reading, quality) => {
            cells.quality = f64::from(quality.0);
            match reading {
                Reading::Joint(j) => {
                    cells.joint = [j.position, j.velocity, j.acceleration, j.torque, j.current];
                }
                Reading::Wrench(w) => {
                    let ([fx, fy, fz], [tx, ty, tz]) = (w.force, w.torque);
                    cells.wrench = [fx, fy, fz, tx, ty, tz];
                }
                Reading::Imu(i) => {
                    let parts = i
                        .proper_acceleration
                        .iter()
                        .chain(&i.angular_velocity)
                        .chain(&i.angular_acceleration);
                    let parts = parts.chain(&i.magnetic_field).chain(&i.orientation);
                    cells
                        .imu
                        .iter_mut()
                        .zip(parts)
                        .for_each(|(cell, v)| *cell = *v);
                }
                Reading::Gauges(g) => cells.gauges = g.counts.map(f64::from),
                Reading::Temperature(t) => cells.temperature = t.celsius,
                Reading::Actuator(a) => {
                    cells.actuator = [
                        a.duty,
                        f64::from(a.mode),
                        f64::from(a.encoder),
                        f64::from(a.faults),
                    ];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Nanos;
    use crate::csv::{Columns, Reader, Row, Writer};
    use std::vec;
    use std::vec::Vec;

    #[test]
    fn what_is_written_is_read_back_bit_for_bit() {
        let series = [
            Series {
                what: What::Channel(Kind::Joint),
                name: "elbow".into(),
            },
            Series {
                what: What::Channel(Kind::Wrench),
                name: "ft".into(),
            },
            Series {
                what: What::Channel(Kind::Imu),
                name: "chest".into(),
            },
            Series {
                what: What::Contact,
                name: "hand".into(),
            },
        ];
        let imu = Imu {
            proper_acceleration: [-0.0, 1e-300, 9.80665],
            angular_velocity: [0.1, -2.0, 3e10],
            ..Imu::ABSENT
        };
        let values = vec![
            (
                0,
                Value::Reading(
                    Reading::Joint(JointState {
                        position: 1.0 / 3.0,
                        ..JointState::ABSENT
                    }),
                    Quality::GOOD,
                ),
            ),
            (
                1,
                Value::Reading(
                    Reading::Wrench(Wrench {
                        force: [1.5, -2.0, 0.0],
                        torque: [0.1; 3],
                    }),
                    Quality::SATURATED,
                ),
            ),
            (
                1,
                Value::Reading(
                    Reading::Temperature(Temperature { celsius: 31.4 }),
                    Quality::FROZEN,
                ),
            ),
            (2, Value::Reading(Reading::Imu(imu), Quality::GOOD)),
            (3, Value::Active(true)),
        ];
        let mut writer = Writer::new(Vec::new(), &series, Columns::All).unwrap();
        for (number, value) in &values {
            writer
                .push(Some(Nanos(123_456_789)), *number, value)
                .unwrap();
        }
        // A second sample of one channel needs a new row.
        writer
            .push(Some(Nanos(123_456_789)), values[0].0, &values[0].1)
            .unwrap();
        let text = String::from_utf8(writer.finish().unwrap()).unwrap();
        let mut reader = Reader::new(text.as_bytes()).unwrap();
        let (mut rows, mut row) = (Vec::new(), Row::default());
        while reader.next_row(&mut row).unwrap() {
            rows.push(row.clone());
        }
        let report = reader.report();
        assert_eq!(
            (rows.len(), report.bad_rows, report.unknown_columns.len()),
            (2, 0, 0),
            "{text}"
        );
        assert_eq!(reader.series(), series);
        let bits = |v: &Value| {
            let mut cells = Cells::EMPTY;
            spread(v, &mut cells);
            let all = cells
                .joint
                .iter()
                .chain(&cells.wrench)
                .chain(&cells.imu)
                .chain([&cells.temperature, &cells.active]);
            all.map(|x| if x.is_nan() { 0 } else { x.to_bits() })
                .collect::<Vec<_>>()
        };
        let got: Vec<_> = rows[0]
            .items
            .iter()
            .map(|i| (i.series, bits(&i.value)))
            .collect();
        let want: Vec<_> = values.iter().map(|(n, v)| (*n, bits(v))).collect();
        assert_eq!(got, want);
        assert_eq!(rows[0].t, Some(Nanos(123_456_789)));
        let Value::Reading(_, quality) = rows[0].items[1].value else {
            panic!("a wrench")
        };
        assert_eq!(quality, Quality::SATURATED | Quality::FROZEN);
    }

    /// A flag lost on the way would make a faulty sample a good one.
    #[test]
    fn every_flag_of_every_kind_is_read_back() {
        let readings = [
            (
                Kind::Joint,
                Reading::Joint(JointState {
                    position: 1.0,
                    ..JointState::ABSENT
                }),
            ),
            (
                Kind::Wrench,
                Reading::Wrench(Wrench {
                    force: [1.0; 3],
                    torque: [2.0; 3],
                }),
            ),
            (
                Kind::Imu,
                Reading::Imu(Imu {
                    proper_acceleration: [1.0; 3],
                    ..Imu::ABSENT
                }),
            ),
        ];
        for (kind, reading) in readings {
            let series = [Series {
                what: What::Channel(kind),
                name: "one".into(),
            }];
            let mut writer = Writer::new(Vec::new(), &series, Columns::All).unwrap();
            let flags: Vec<Quality> = (0..32).map(|bit| Quality(1 << bit)).collect();
            for (t, flag) in (0..).zip(&flags) {
                let value = Value::Reading(reading, *flag);
                writer.push(Some(Nanos(t)), 0, &value).unwrap();
            }
            let text = writer.finish().unwrap();
            let mut reader = Reader::new(text.as_slice()).unwrap();
            let (mut got, mut row) = (Vec::new(), Row::default());
            while reader.next_row(&mut row).unwrap() {
                let Value::Reading(_, quality) = row.items[0].value else {
                    panic!("a reading")
                };
                got.push(quality);
            }
            assert_eq!(got, flags, "{kind:?}");
        }
    }
}
