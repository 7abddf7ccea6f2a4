//! Writes a table row by row. Values of one instant share a row.

use super::columns::{
    Cells, ColumnQuantity, Series, SeriesKind, Value, contact_fields, field_word, readings, spread,
    usual, word,
};
use crate::{Kind, Nanos};
use std::format;
use std::io;
use std::string::String;
use std::vec::Vec;

/// Which columns a [`TableWriter`] writes per channel, besides its quality.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Columns {
    /// The columns that the estimator reads: position and velocity; the wrench; accelerations and
    /// rates.
    Main,
    /// All columns of the channel's kind.
    All,
}

/// Writes a log row by row.
pub struct TableWriter<W> {
    output: W,
    /// Per series: its first column and its fields.
    series: Vec<(SeriesKind, usize, Vec<ColumnQuantity>)>,
    /// The current row, one cell per column after `t`; NaN is empty.
    cells: Vec<f64>,
    /// The text of the current row.
    text: Vec<u8>,
    pending: Option<Option<Nanos>>,
}

impl<W: io::Write> TableWriter<W> {
    /// Writes the header for `series`, each with `columns`.
    ///
    /// # Errors
    /// If `output` cannot be written.
    pub fn new(mut output: W, series: &[Series], columns: Columns) -> io::Result<Self> {
        let mut header = String::from("t");
        let (mut layout, mut count) = (Vec::new(), 0);
        for one in series {
            let fields = fields_of(one.kind, columns);
            for field in &fields {
                header.push(',');
                match field {
                    ColumnQuantity::Quality => header.push_str(&one.name),
                    _ => header.push_str(&format!("{}/{}", word(one.kind), one.name)),
                }
                header.push('/');
                header.push_str(field_word(*field));
            }
            let first = count;
            count += fields.len();
            layout.push((one.kind, first, fields));
        }
        header.push('\n');
        output.write_all(header.as_bytes())?;
        Ok(Self {
            output,
            series: layout,
            cells: std::vec![f64::NAN; count],
            text: Vec::with_capacity(512),
            pending: None,
        })
    }

    /// Adds a value at `t` to the current row, or begins a new row.
    ///
    /// Consecutive values of one instant share a row unless a cell would be written twice.
    ///
    /// # Errors
    /// If the previous row cannot be written.
    pub fn push(&mut self, t: Option<Nanos>, series: usize, value: &Value) -> io::Result<()> {
        let mut cells = Cells::EMPTY;
        spread(value, &mut cells);
        let Some((_, first, fields)) = self.series.get(series) else {
            return Ok(());
        };
        let (first, count) = (*first, fields.len());
        let mut incoming = [f64::NAN; 24];
        for (field, slot) in fields.iter().zip(&mut incoming) {
            *slot = cells.slot(*field).map_or(f64::NAN, |v| *v);
        }
        let range = first..first + count;
        // The quality cell may be written twice in one row (a wrench and a temperature): its bits
        // are OR-ed.
        let taken = self
            .cells
            .get(range.clone())
            .unwrap_or_default()
            .iter()
            .zip(&incoming)
            .zip(fields);
        let clash = taken
            .into_iter()
            .any(|((old, new), f)| *f != ColumnQuantity::Quality && !old.is_nan() && !new.is_nan());
        if self.pending.is_some_and(|p| p != t || t.is_none()) || clash {
            self.flush_row()?;
        }
        self.pending = Some(t);
        let fields = self.series.get(series).map_or(&[][..], |s| s.2.as_slice());
        for ((cell, new), field) in self
            .cells
            .get_mut(range)
            .unwrap_or_default()
            .iter_mut()
            .zip(incoming)
            .zip(fields)
        {
            if *field == ColumnQuantity::Quality && !cell.is_nan() && !new.is_nan() {
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let both = *cell as u32 | new as u32;
                *cell = f64::from(both);
            } else if !new.is_nan() {
                *cell = new;
            }
        }
        Ok(())
    }

    fn flush_row(&mut self) -> io::Result<()> {
        use io::Write as _;
        let Some(t) = self.pending.take() else {
            return Ok(());
        };
        self.text.clear();
        if let Some(t) = t {
            write!(self.text, "{t}")?;
        }
        for cell in &mut self.cells {
            self.text.push(b',');
            if !cell.is_nan() {
                #[allow(clippy::float_cmp, clippy::cast_possible_truncation)]
                if *cell == f64::from(*cell as i32) && (*cell != 0.0 || cell.is_sign_positive()) {
                    write_integer(&mut self.text, *cell as i32);
                } else {
                    self.text
                        .extend_from_slice(zmij::Buffer::new().format(*cell).as_bytes());
                }
                *cell = f64::NAN;
            }
        }
        self.text.push(b'\n');
        self.output.write_all(&self.text)
    }

    /// Flushes the output: the rows that are complete outlive a crash of this program.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.output.flush()
    }

    /// Writes the last row and returns the output.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(mut self) -> io::Result<W> {
        self.flush_row()?;
        self.output.flush()?;
        Ok(self.output)
    }
}

fn write_integer(text: &mut Vec<u8>, value: i32) {
    let mut digits = [0_u8; 10];
    let mut rest = value.unsigned_abs();
    let mut at = digits.len();
    loop {
        at -= 1;
        if let Some(d) = digits.get_mut(at) {
            *d = b'0' + u8::try_from(rest % 10).unwrap_or(0);
        }
        rest /= 10;
        if rest == 0 {
            break;
        }
    }
    if value < 0 {
        text.push(b'-');
    }
    text.extend_from_slice(digits.get(at..).unwrap_or_default());
}

fn fields_of(what: SeriesKind, columns: Columns) -> Vec<ColumnQuantity> {
    let SeriesKind::Channel(kind) = what else {
        return contact_fields().collect();
    };
    let values = |kind: Kind, count| {
        (0_u8..)
            .take(count)
            .map(move |i| ColumnQuantity::Value(kind, i))
    };
    let mut fields: Vec<ColumnQuantity> = match columns {
        Columns::Main => values(kind, usual(kind)).collect(),
        Columns::All => (readings(kind).iter())
            .flat_map(|&kind| values(kind, kind.fields().len()))
            .collect(),
    };
    fields.push(ColumnQuantity::Quality);
    fields
}
