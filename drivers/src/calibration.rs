//! What a force/torque sensor's own memory says of its calibration, and what can be wrong with it.

use arrayvec::ArrayVec;
use core::fmt;
use proprio_topics::axes;

/// The calibration that is in use in a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Calibration {
    /// Of an iCub strain board: reading = full scale x matrix x gauges, with gauges from -1 to 1.
    Fractions {
        /// Full scale of fx fy fz \[N\], tx ty tz \[Nm\].
        full_scale: [u16; 6],
        /// By axis and gauge, in 1/32768.
        matrix: [[i16; 6]; 6],
    },
    /// Of an ATI sensor: reading = unit / counts x matrix x gauges, with gauges in counts.
    Counts {
        /// By axis and gauge.
        matrix: [[f32; 6]; 6],
        /// Counts per unit of force and of torque.
        counts: [f64; 2],
        /// The units of force \[N\] and torque \[Nm\].
        units: [f64; 2],
    },
    /// Of a sensor that only tells its full scales: fx fy fz \[N\], tx ty tz \[Nm\].
    FullScale([f64; 6]),
}

/// Something that is wrong with a calibration. Axes and gauges count from 0: axis 0 is fx.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Defect {
    /// The full scale of this axis is zero.
    ZeroFullScale {
        /// The axis.
        axis: u8,
    },
    /// The entry is FFFF, as in memory that was erased.
    Erased {
        /// The axis.
        axis: u8,
        /// The gauge.
        gauge: u8,
    },
    /// The entry is no finite number.
    NotFinite {
        /// The axis.
        axis: u8,
        /// The gauge.
        gauge: u8,
    },
    /// No gauge has an effect on this axis: it always reads zero.
    ZeroRow {
        /// The axis.
        axis: u8,
    },
    /// This gauge has no effect on any axis.
    ZeroColumn {
        /// The gauge.
        gauge: u8,
    },
    /// The axes can not be told from each other ([`MOST_CONDITION`]).
    Condition {
        /// The condition number; infinite: the matrix is singular.
        number: f64,
    },
}

/// The highest condition number of a matrix that can be right, with each axis divided by its norm.
/// With it one step of 16 bits at a gauge can be 3 % of a full scale; sensors are made with tens.
pub const MOST_CONDITION: f64 = 1000.0;

/// Every defect that a calibration can have: a full scale, an entry and a row per axis, a column
/// per gauge, the whole.
pub type Defects = ArrayVec<Defect, 25>;

impl Calibration {
    /// \[N or Nm per gauge count\], by axis and gauge; `None` if the sensor does not tell.
    #[must_use]
    pub fn per_count(&self) -> Option<[[f64; 6]; 6]> {
        let mut rows = [[0.0; 6]; 6];
        match *self {
            Self::Fractions { full_scale, matrix } => {
                for ((to, from), most) in rows.iter_mut().zip(matrix).zip(full_scale) {
                    *to = from.map(|entry| f64::from(entry) / 32768.0 * f64::from(most) / 32768.0);
                }
            }
            Self::Counts {
                matrix,
                counts: [force, torque],
                units: [newton, newton_metre],
            } => {
                let (f, t) = (newton / force, newton_metre / torque);
                for ((to, from), unit) in rows.iter_mut().zip(matrix).zip([f, f, f, t, t, t]) {
                    *to = from.map(|entry| f64::from(entry) * unit);
                }
            }
            Self::FullScale(_) => return None,
        }
        Some(rows)
    }

    /// The full scales fx fy fz \[N\], tx ty tz \[Nm\]; `None` if the sensor does not tell.
    #[must_use]
    pub fn full_scale(&self) -> Option<[f64; 6]> {
        match *self {
            Self::Fractions { full_scale, .. } => Some(full_scale.map(f64::from)),
            Self::Counts { .. } => None,
            Self::FullScale(all) => Some(all),
        }
    }

    /// What is wrong with it. Of several entries of one axis, the first is given.
    #[must_use]
    pub fn defects(&self) -> Defects {
        let mut found = Defects::new();
        let mut add = |defect| {
            // There is room for all.
            let _ = found.try_push(defect);
        };
        for (axis, scale) in (0..).zip(self.full_scale().unwrap_or([1.0; 6])) {
            if scale <= 0.0 {
                add(Defect::ZeroFullScale { axis });
            }
        }
        let rows = match *self {
            Self::Fractions { matrix, .. } => matrix.map(|row| row.map(f64::from)),
            Self::Counts { matrix, .. } => matrix.map(|row| row.map(f64::from)),
            Self::FullScale(_) => return found,
        };
        let raw = matches!(self, Self::Fractions { .. });
        let mut usable = true;
        for (axis, row) in (0..).zip(&rows) {
            let first = |wrong: fn(f64) -> bool| (0..).zip(row).find(|(_, x)| wrong(**x));
            if raw && let Some((gauge, _)) = first(|entry| entry == -1.0) {
                add(Defect::Erased { axis, gauge });
            }
            if let Some((gauge, _)) = first(|entry| !entry.is_finite()) {
                usable = false;
                add(Defect::NotFinite { axis, gauge });
            } else if row.iter().all(|entry| *entry == 0.0) {
                usable = false;
                add(Defect::ZeroRow { axis });
            }
        }
        for gauge in 0..6 {
            let entry = |row: &[f64; 6]| row.get(usize::from(gauge)).copied();
            if rows.iter().all(|row| entry(row) == Some(0.0)) {
                usable = false;
                add(Defect::ZeroColumn { gauge });
            }
        }
        if usable {
            let number = condition(rows);
            if number.is_nan() || number > MOST_CONDITION {
                add(Defect::Condition { number });
            }
        }
        found
    }
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = |axis: u8| axes(1 << axis);
        match *self {
            Self::ZeroFullScale { axis } => write!(f, "the full scale of {} is zero", name(axis)),
            Self::Erased { axis, gauge } => {
                let axis = name(axis);
                write!(
                    f,
                    "the entry of {axis}, gauge {gauge} is FFFF, as in erased memory"
                )
            }
            Self::NotFinite { axis, gauge } => {
                write!(f, "the entry of {}, gauge {gauge} is no number", name(axis))
            }
            Self::ZeroRow { axis } => {
                write!(f, "the row of {} is zero: it always reads zero", name(axis))
            }
            Self::ZeroColumn { gauge } => write!(f, "gauge {gauge} has no effect on any axis"),
            Self::Condition { number } if number.is_finite() => write!(
                f,
                "the condition number is {number:.0}, above {MOST_CONDITION}: axes can not be \
                 told from each other"
            ),
            Self::Condition { .. } => f.write_str("the matrix is singular"),
        }
    }
}

/// The condition number in the Frobenius norm, with each row divided by its norm; infinite if the
/// matrix is singular.
fn condition(mut rows: [[f64; 6]; 6]) -> f64 {
    let square = |rows: &[[f64; 6]]| rows.iter().flatten().map(|x| x * x).sum::<f64>();
    for row in &mut rows {
        let norm = libm::sqrt(square(&[*row]));
        *row = row.map(|entry| entry / norm);
    }
    match inverse(rows) {
        Some(inverse) => libm::sqrt(square(&rows) * square(&inverse)),
        None => f64::INFINITY,
    }
}

/// The inverse, by Gauss and Jordan with pivots; `None` if it is singular.
pub(crate) fn inverse(matrix: [[f64; 6]; 6]) -> Option<[[f64; 6]; 6]> {
    let mut left = matrix;
    let mut right = core::array::from_fn(|i| core::array::from_fn(|j| f64::from(u8::from(i == j))));
    for column in 0..6 {
        let size = |row: &usize| {
            left.get(*row)
                .and_then(|r| r.get(column))
                .map_or(0.0, |x| x.abs())
        };
        let pivot = (column..6).max_by(|a, b| size(a).total_cmp(&size(b)))?;
        left.swap(column, pivot);
        right.swap(column, pivot);
        let (l, r): ([f64; 6], [f64; 6]) = (*left.get(column)?, *right.get(column)?);
        let divisor = *l.get(column)?;
        if !divisor.is_normal() {
            return None;
        }
        let (l, r) = (l.map(|x| x / divisor), r.map(|x| x / divisor));
        for (row, (a, b)) in left.iter_mut().zip(&mut right).enumerate() {
            if row == column {
                (*a, *b) = (l, r);
                continue;
            }
            let factor = *a.get(column)?;
            a.iter_mut().zip(l).for_each(|(x, y)| *x -= factor * y);
            b.iter_mut().zip(r).for_each(|(x, y)| *x -= factor * y);
        }
    }
    Some(right)
}
