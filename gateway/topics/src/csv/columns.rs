//! The columns of a table: their names, and the conversion between a value and its cells.

use crate::{ContactState, Kind, Quality, Reading, VALUES};
use core::ops::Range;
use std::format;
use std::string::String;

/// The quantity in one column of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum ColumnQuantity {
    /// A value of a reading of this kind: its place in [`Kind::fields`].
    Value(Kind, u8),
    Quality,
    /// A value of a contact's state: its place in [`CONTACT`].
    Contact(u8),
}

/// The names of the values of a contact's state.
const CONTACT: [&str; 8] = ["active", "px", "py", "pz", "p_std", "dx", "dy", "dz"];

/// All columns of a contact.
pub(super) fn contact_fields() -> impl Iterator<Item = ColumnQuantity> {
    (0_u8..).take(CONTACT.len()).map(ColumnQuantity::Contact)
}

/// The readings that a channel of kind `kind` can have, its main one first.
pub(super) const fn readings(kind: Kind) -> &'static [Kind] {
    match kind {
        Kind::Joint => &[Kind::Joint, Kind::Actuator],
        Kind::Wrench => &[Kind::Wrench, Kind::Gauges, Kind::Temperature],
        Kind::Imu => &[Kind::Imu],
        Kind::Gauges => &[Kind::Gauges],
        Kind::Temperature => &[Kind::Temperature],
        Kind::Actuator => &[Kind::Actuator],
        Kind::Skin => &[Kind::Skin],
    }
}

/// The first so many values of a channel's main reading are the table's usual columns; all others
/// are optional.
pub(super) const fn usual(kind: Kind) -> usize {
    match kind {
        Kind::Joint => 2,
        Kind::Imu => 6,
        other => other.fields().len(),
    }
}

/// The values of a reading that are present or absent together, with their names.
const fn groups(kind: Kind) -> &'static [(Range<usize>, &'static str)] {
    match kind {
        Kind::Joint | Kind::Temperature | Kind::Skin => &[],
        Kind::Wrench => &[(0..6, "fx fy fz tx ty tz")],
        Kind::Imu => &[
            (0..3, "ax ay az"),
            (3..6, "gx gy gz"),
            (6..9, "alx aly alz"),
            (9..12, "mx my mz"),
            (12..16, "qw qx qy qz"),
        ],
        Kind::Gauges => &[(0..6, "g0 to g5")],
        // Many drives report no duty.
        Kind::Actuator => &[(1..4, "mode, encoder, faults")],
    }
}

/// The kind of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SeriesKind {
    /// A channel of the gateway.
    Channel(Kind),
    /// A contact that is declared present or absent, and where.
    Contact,
}

/// A channel or contact of a log.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Series {
    /// Its kind.
    pub kind: SeriesKind,
    /// Its name.
    pub name: String,
}

/// The value of a series in one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// A reading and its quality flags.
    Reading(Reading, Quality),
    /// Whether a contact is present from here on, and where.
    Contact(ContactState),
}

/// The values of one series in the row that is being read or written.
#[derive(Clone)]
pub(super) struct Cells {
    /// By the number of the reading's kind.
    values: [[f64; VALUES]; Kind::ALL.len()],
    quality: f64,
    /// In the order of [`CONTACT`].
    contact: [f64; CONTACT.len()],
}

impl Cells {
    pub(super) const EMPTY: Self = Self {
        values: [[f64::NAN; VALUES]; Kind::ALL.len()],
        quality: f64::NAN,
        contact: [f64::NAN; CONTACT.len()],
    };

    pub(super) fn slot(&mut self, field: ColumnQuantity) -> Option<&mut f64> {
        match field {
            ColumnQuantity::Value(kind, i) => {
                self.values.get_mut(kind as usize)?.get_mut(usize::from(i))
            }
            ColumnQuantity::Quality => Some(&mut self.quality),
            ColumnQuantity::Contact(i) => self.contact.get_mut(usize::from(i)),
        }
    }
}

pub(super) const fn word(what: SeriesKind) -> &'static str {
    match what {
        SeriesKind::Channel(kind) => kind.word(),
        SeriesKind::Contact => "contact",
    }
}

/// Parses a column's name into kind (`None`: a channel's quality), name and field.
pub(super) fn parse_column(column: &str) -> Option<(Option<SeriesKind>, &str, ColumnQuantity)> {
    let (front, field) = column.rsplit_once('/')?;
    if let Some((head, name)) = front.split_once('/') {
        let what = match head {
            "contact" => Some(SeriesKind::Contact),
            _ => (Kind::ALL.into_iter())
                .find(|kind| kind.word() == head)
                .map(SeriesKind::Channel),
        };
        if let Some(what) = what
            && !name.is_empty()
        {
            return parse_field(what, field).map(|f| (Some(what), name, f));
        }
    }
    (field == "quality" && !front.is_empty()).then_some((None, front, ColumnQuantity::Quality))
}

pub(super) fn parse_field(what: SeriesKind, field: &str) -> Option<ColumnQuantity> {
    if field == "quality" && what != SeriesKind::Contact {
        return Some(ColumnQuantity::Quality);
    }
    let SeriesKind::Channel(kind) = what else {
        let at = CONTACT.iter().position(|name| *name == field)?;
        return Some(ColumnQuantity::Contact(u8::try_from(at).ok()?));
    };
    readings(kind).iter().find_map(|&kind| {
        let at = kind.fields().iter().position(|name| *name == field)?;
        Some(ColumnQuantity::Value(kind, u8::try_from(at).ok()?))
    })
}

/// Passes the readings in `cells` to `push`; `Err` says what is wrong with them.
pub(super) fn items_of(
    series: &Series,
    cells: &Cells,
    mut push: impl FnMut(Value),
) -> Result<(), String> {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let quality = if cells.quality.is_nan() {
        Quality::GOOD
    } else {
        Quality(cells.quality as u32)
    };
    let SeriesKind::Channel(kind) = series.kind else {
        if let Some(state) = contact_of(&cells.contact)? {
            push(Value::Contact(state));
        }
        return Ok(());
    };
    for &kind in readings(kind) {
        let Some(values) = cells.values.get(kind as usize) else {
            continue;
        };
        for (group, names) in groups(kind) {
            let group = values.get(group.clone()).unwrap_or_default();
            let missing = group.iter().filter(|value| value.is_nan()).count();
            if missing > 0 && missing < group.len() {
                return Err(format!("holds some of {names}, but not all"));
            }
        }
        if values.iter().any(|value| !value.is_nan()) {
            let reading = Reading::from_values(kind, values)
                .ok_or_else(|| format!("has values of {kind} that must be integers and are not"))?;
            push(Value::Reading(reading, quality));
        }
    }
    Ok(())
}

/// The contact's state in these cells; `None` if they are empty.
fn contact_of(cells: &[f64; CONTACT.len()]) -> Result<Option<ContactState>, String> {
    let [active, px, py, pz, position_std, dx, dy, dz] = *cells;
    let (position, direction) = ([px, py, pz], [dx, dy, dz]);
    let given = |values: &[f64]| values.iter().filter(|value| !value.is_nan()).count();
    for (values, names) in [(&position, "px py pz"), (&direction, "dx dy dz")] {
        if !matches!(given(values), 0 | 3) {
            return Err(format!("holds some of {names}, but not all"));
        }
    }
    if !position_std.is_nan() && given(&position) == 0 {
        return Err("holds p_std without px py pz".into());
    }
    if active.is_nan() {
        return match given(cells) {
            0 => Ok(None),
            _ => Err("says where the contact is, but not whether it is present: active".into()),
        };
    }
    Ok(Some(ContactState {
        active: active != 0.0,
        position,
        position_std,
        direction,
    }))
}

pub(super) fn field_word(field: ColumnQuantity) -> &'static str {
    match field {
        ColumnQuantity::Value(kind, i) => {
            (kind.fields().get(usize::from(i)).copied()).unwrap_or_default()
        }
        ColumnQuantity::Quality => "quality",
        ColumnQuantity::Contact(i) => CONTACT.get(usize::from(i)).copied().unwrap_or_default(),
    }
}

/// The inverse of [`items_of`].
pub(super) fn spread(value: &Value, cells: &mut Cells) {
    match value {
        Value::Contact(state) => {
            let active = f64::from(u8::from(state.active));
            let ([px, py, pz], [dx, dy, dz]) = (state.position, state.direction);
            cells.contact = [active, px, py, pz, state.position_std, dx, dy, dz];
        }
        Value::Reading(reading, quality) => {
            cells.quality = f64::from(quality.0);
            if let Some(values) = cells.values.get_mut(reading.kind() as usize) {
                *values = reading.values();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::csv::{Columns, Row, TableReader, TableWriter};
    use crate::{Actuator, Imu, JointState, Nanos, Temperature, Wrench};
    use std::vec;
    use std::vec::Vec;

    #[test]
    fn a_drive_may_report_no_duty() {
        let series = Series {
            kind: SeriesKind::Channel(Kind::Joint),
            name: "elbow".into(),
        };
        let read = |values: [f64; 4]| {
            let mut cells = Cells::EMPTY;
            cells.values[Kind::Actuator as usize][..4].copy_from_slice(&values);
            let mut readings = Vec::new();
            let result = items_of(&series, &cells, |value| readings.push(value));
            (result.is_ok(), readings)
        };
        let (good, readings) = read([f64::NAN, 3.0, 0.0, 7.0]);
        let [
            Value::Reading(
                Reading::Actuator(Actuator {
                    mode, faults, duty, ..
                }),
                _,
            ),
        ] = &readings[..]
        else {
            panic!("{readings:?}")
        };
        assert!(good && duty.is_nan() && (*mode, *faults) == (3, 7));
        assert!(!read([0.5, 3.0, f64::NAN, 7.0]).0);
    }

    #[test]
    fn what_is_written_is_read_back_bit_for_bit() {
        let series = [
            Series {
                kind: SeriesKind::Channel(Kind::Joint),
                name: "elbow".into(),
            },
            Series {
                kind: SeriesKind::Channel(Kind::Wrench),
                name: "ft".into(),
            },
            Series {
                kind: SeriesKind::Channel(Kind::Imu),
                name: "chest".into(),
            },
            Series {
                kind: SeriesKind::Contact,
                name: "hand".into(),
            },
        ];
        let imu = Imu {
            proper_acceleration: [-0.0, 1e-300, 9.80665],
            angular_velocity: [0.1, -2.0, 3e10],
            ..Imu::ABSENT
        };
        let touch = ContactState {
            active: true,
            position: [0.01, -0.07, 1.0 / 3.0],
            position_std: 0.002,
            direction: [0.6, 0.0, -0.8],
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
            (3, Value::Contact(touch)),
        ];
        assert_ne!(touch, ContactState::configured(true));
        let mut writer = TableWriter::new(Vec::new(), &series, Columns::All).unwrap();
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
        let mut reader = TableReader::new(text.as_bytes()).unwrap();
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
            let all = (cells.values.iter().flatten()).chain(&cells.contact);
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

    #[test]
    fn a_place_is_whole_and_belongs_to_a_declaration() {
        let nan = f64::NAN;
        let contact = |cells: [f64; 8]| contact_of(&cells);
        assert_eq!(contact([nan; 8]), Ok(None));
        let state = contact([1.0, nan, nan, nan, nan, nan, nan, nan])
            .unwrap()
            .unwrap();
        assert!(state.active && state.position[0].is_nan() && state.direction[2].is_nan());
        let state = contact([0.0, 1.0, 2.0, 3.0, nan, 4.0, 5.0, 6.0])
            .unwrap()
            .unwrap();
        assert_eq!(
            (state.active, state.position, state.direction),
            (false, [1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
        );
        for (cells, told) in [
            ([1.0, 1.0, nan, 3.0, nan, nan, nan, nan], "some of px py pz"),
            ([1.0, nan, nan, nan, nan, 1.0, nan, nan], "some of dx dy dz"),
            ([1.0, nan, nan, nan, 0.1, nan, nan, nan], "p_std without"),
            (
                [nan, 1.0, 2.0, 3.0, nan, nan, nan, nan],
                "but not whether it is present",
            ),
        ] {
            assert!(contact(cells).unwrap_err().contains(told), "{told}");
        }
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
                kind: SeriesKind::Channel(kind),
                name: "one".into(),
            }];
            let mut writer = TableWriter::new(Vec::new(), &series, Columns::All).unwrap();
            let flags: Vec<Quality> = (0..32).map(|bit| Quality(1 << bit)).collect();
            for (t, flag) in (0..).zip(&flags) {
                let value = Value::Reading(reading, *flag);
                writer.push(Some(Nanos(t)), 0, &value).unwrap();
            }
            let text = writer.finish().unwrap();
            let mut reader = TableReader::new(text.as_slice()).unwrap();
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
