//! The upper triangle `[R | z]`.

use crate::arithmetic::dot;
use crate::linear::information::panel::{Panel, Reflect};
use pulp::Arch;

/// `[R | z]`, row by row; zeros below the diagonal.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Triangle {
    pub(crate) unknowns: usize,
    pub(crate) values: Vec<f64>,
}

impl Triangle {
    pub(crate) fn new(unknowns: usize) -> Self {
        Self {
            unknowns,
            values: vec![0.0; unknowns * (unknowns + 1)],
        }
    }

    /// `[R_kk ... R_kn | z_k]`.
    pub(crate) fn row(&self, k: usize) -> &[f64] {
        let width = self.unknowns + 1;
        &self.values[k * width + k..(k + 1) * width]
    }

    pub(crate) fn right_sides(&self) -> impl Iterator<Item = f64> {
        let width = self.unknowns + 1;
        let last = self.values.iter().skip(self.unknowns);
        last.step_by(width).copied()
    }

    /// Absorbs the panel's rows and empties the panel. Returns the increase of the residual's
    /// square sum.
    pub(crate) fn absorb(&mut self, panel: &mut Panel) -> f64 {
        let rows = panel.pad();
        if rows == 0 {
            return 0.0;
        }
        let Panel {
            stride,
            values,
            filled,
            ..
        } = &mut *panel;
        Arch::new().dispatch(Reflect {
            unknowns: self.unknowns,
            triangle: &mut self.values,
            rows,
            stride: *stride,
            panel: values,
            filled,
        });
        let right = &panel.values[self.unknowns * panel.stride..][..rows];
        let residual = dot(right, right);
        panel.clear();
        residual
    }

    /// Absorbs the rows of another triangle, whose unknown `i` is `columns[i]` here. Returns the
    /// increase of the residual's square sum.
    pub(crate) fn add(
        &mut self,
        other: &Self,
        columns: &[usize],
        work: &mut Panel,
        row: &mut [f64],
    ) -> f64 {
        let mut residual = 0.0;
        for k in 0..other.unknowns {
            let from = other.row(k);
            if from.iter().all(|&value| value == 0.0) {
                continue;
            }
            row.fill(0.0);
            for (&column, &value) in columns[k..].iter().zip(from) {
                row[column] = value;
            }
            if work.push_row(row, from[from.len() - 1]).is_err() {
                residual += self.absorb(work);
                // There is room now, and the numbers of a triangle are finite.
                let _ = work.push_row(row, from[from.len() - 1]);
            }
        }
        residual + self.absorb(work)
    }

    /// A step of a random walk of unknown `c`: `x_c + w`, `w` of this standard deviation, infinite
    /// for a free unknown.
    ///
    /// In the new unknown, each row has an additional term `-R_ic w`, and `w / deviation = 0` is an
    /// additional row. Rotations of that row with rows c to 0, in this order, remove `w` from these
    /// and keep them triangular. The remaining row is about `w` and dropped (Bierman 1977, sect.
    /// VII.2).
    pub(crate) fn drift(&mut self, c: usize, deviation: f64, work_row: &mut [f64]) {
        let width = self.unknowns + 1;
        work_row.fill(0.0);
        let mut pivot = 1.0 / deviation;
        if pivot.is_infinite() {
            return; // less than any rounding
        }
        for i in (0..=c).rev() {
            let row = &mut self.values[i * width + i..(i + 1) * width];
            let entry = -row[c - i];
            if entry == 0.0 {
                continue;
            }
            let hypotenuse = pivot.hypot(entry);
            let (cosine, sine) = (pivot / hypotenuse, entry / hypotenuse);
            for (work_row, row) in work_row[i..].iter_mut().zip(&mut *row) {
                (*work_row, *row) = (
                    cosine * *work_row + sine * *row,
                    cosine * *row - sine * *work_row,
                );
            }
            pivot = hypotenuse;
            if deviation == f64::INFINITY {
                row[c - i] = 0.0; // exactly
            }
        }
    }
}
