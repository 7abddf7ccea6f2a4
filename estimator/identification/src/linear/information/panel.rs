//! A buffer of whitened rows, and the reflections that absorb them.

use crate::linear::simd::{self, Aligned, LANES, VECTORS};
use pulp::{Simd, WithSimd};

/// Why rows were refused, or why there is no solution.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum InformationError {
    /// Two sizes that must agree differ.
    #[error("{what}: {got} instead of {expected}")]
    Size {
        /// The quantity.
        what: &'static str,
        /// Its number.
        got: usize,
        /// The required number.
        expected: usize,
    },
    /// A column that does not exist.
    #[error("there is no unknown {column}: the information is about {unknowns}, counted from 0")]
    Column {
        /// Its number.
        column: usize,
        /// Number of unknowns.
        unknowns: usize,
    },
    /// The panel is full.
    #[error("the panel already holds {capacity} rows: absorb it first")]
    Full {
        /// Number of rows that it can hold.
        capacity: usize,
    },
    /// A row with a number that is not finite, or beyond 1e120, where squares overflow.
    #[error(
        "a row has {value} in column {column} (the right side comes after the last unknown); rows \
         must be finite and below 1e120"
    )]
    Value {
        /// The column; the number of unknowns for the right side.
        column: usize,
        /// The number.
        value: f64,
    },
    /// A standard deviation outside its range.
    #[error("{what} is {value}, which is outside its range")]
    Range {
        /// The quantity.
        what: &'static str,
        /// Its value.
        value: f64,
    },
    /// Rows and prior do not determine an unknown.
    #[error("unknown {unknown} is not determined by the rows and the prior together")]
    Undetermined {
        /// The first unknown that the rows do not separate from those before it.
        unknown: usize,
    },
}

pub(crate) fn check_size(
    what: &'static str,
    got: usize,
    expected: usize,
) -> Result<(), InformationError> {
    if got == expected {
        return Ok(());
    }
    Err(InformationError::Size {
        what,
        got,
        expected,
    })
}

/// A buffer of whitened rows `[a | y]` for an [`Information`](super::Information). Absorbing
/// empties it for reuse.
#[derive(Clone, Debug)]
pub struct Panel {
    pub(crate) unknowns: usize,
    pub(crate) capacity: usize,
    pub(crate) rows: usize,
    /// Distance of columns, which are padded with zeros to a multiple of the lanes.
    pub(crate) stride: usize,
    /// Column by column, the right side last.
    pub(crate) values: Aligned,
    /// Which columns may have entries other than zero.
    pub(crate) filled: Vec<bool>,
}

impl Panel {
    /// Room for `capacity` rows about this many unknowns. Absorbing is fastest from about 40 rows
    /// on; several hundred rows exceed the first-level cache.
    pub fn new(unknowns: usize, capacity: usize) -> Self {
        let stride = capacity.next_multiple_of(LANES);
        Self {
            unknowns,
            capacity,
            rows: 0,
            stride,
            values: Aligned::zeros(stride * (unknowns + 1)),
            filled: vec![false; unknowns + 1],
        }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.unknowns
    }

    /// Number of buffered rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Greatest number of rows.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Adds the row `a x = y`, in units of its noise's standard deviation. Numbers below 1e-140 may
    /// count as zero.
    ///
    /// # Errors
    /// The length differs from the number of unknowns, the panel is full, or a number is not finite
    /// or beyond 1e120. Nothing is changed then.
    pub fn push_row(&mut self, a: &[f64], y: f64) -> Result<(), InformationError> {
        check_size("numbers of a row", a.len(), self.unknowns)?;
        if self.rows == self.capacity {
            let capacity = self.capacity;
            return Err(InformationError::Full { capacity });
        }
        let is_bad = |value: &f64| value.is_nan() || value.abs() > 1e120;
        // One pass without an early exit; the column is searched only if there is an error.
        if a.iter().fold(is_bad(&y), |any, value| any | is_bad(value)) {
            let column = a.iter().position(is_bad).unwrap_or(self.unknowns);
            let value = a.get(column).copied().unwrap_or(y);
            return Err(InformationError::Value { column, value });
        }
        let first = self.values[self.rows..].iter_mut();
        let columns = first.step_by(self.stride.max(1));
        for ((to, filled), &value) in columns.zip(&mut self.filled).zip(a.iter().chain([&y])) {
            *to = value;
            *filled |= value != 0.0;
        }
        self.rows += 1;
        Ok(())
    }

    /// Removes all rows.
    pub fn clear(&mut self) {
        self.rows = 0;
        self.filled.fill(false);
    }

    /// Pads the columns with zeros to a multiple of the lanes. Returns the padded number of rows.
    pub(crate) fn pad(&mut self) -> usize {
        let padded = self.rows.next_multiple_of(LANES);
        if padded > self.rows {
            for column in self.values.chunks_exact_mut(self.stride) {
                column[self.rows..padded].fill(0.0);
            }
        }
        padded
    }
}

/// Number of columns that reflections are applied to together.
pub(crate) const COLUMNS: usize = 8;

/// A Householder reflection of a panel's column `v` and the diagonal element of `R` in the same
/// column, `[alpha; v] -> [beta; 0]`.
#[derive(Clone, Copy, Default)]
pub(crate) struct Reflection {
    pub(crate) column: usize,
    /// `beta - alpha`.
    pub(crate) delta: f64,
    pub(crate) per_beta: f64,
    pub(crate) per_delta: f64,
    /// `v . v_i` with the previous reflections that are applied together with it.
    pub(crate) products: [f64; VECTORS],
}

/// Reflects the rows of a panel into the triangle `[R | z]`. The residual remains in the panel's
/// right side.
pub(crate) struct Reflect<'a> {
    pub(crate) unknowns: usize,
    pub(crate) triangle: &'a mut [f64],
    /// Number of rows of the panel, padding included, and the distance of its columns.
    pub(crate) rows: usize,
    pub(crate) stride: usize,
    pub(crate) panel: &'a mut [f64],
    pub(crate) filled: &'a mut [bool],
}

impl WithSimd for Reflect<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            unknowns,
            triangle,
            rows,
            stride,
            panel,
            filled,
        } = self;
        let width = unknowns + 1;
        let (mut pending, mut count) = ([Reflection::default(); VECTORS], 0);
        for k in 0..width {
            let (before, own) = panel.split_at_mut(k * stride);
            let own = &mut own[..rows];
            for reflection in &pending[..count] {
                let r = &mut triangle[reflection.column * width + k];
                if filled[k] || *r != 0.0 {
                    filled[k] = true;
                    let v = &before[reflection.column * stride..][..rows];
                    let growth =
                        (simd::inner(simd, v, own) - reflection.delta * *r) * reflection.per_beta;
                    *r += growth;
                    simd::add(simd, own, -(growth * reflection.per_delta), v);
                }
            }
            if k == unknowns || !filled[k] {
                continue;
            }
            let diagonal = &mut triangle[k * width + k];
            // It keeps the sign of alpha. R is then corrected by delta = beta - alpha on the
            // diagonal, written without cancellation (Parlett 1971; Higham 2002, sect. 19.1).
            let (alpha, sigma) = (*diagonal, simd::inner(simd, own, own));
            if sigma <= 1e-40 * alpha * alpha + 1e-280 {
                continue; // far below rounding
            }
            let delta = sigma / (alpha + (alpha * alpha + sigma).sqrt());
            *diagonal = alpha + delta;
            let mut products = [0.0; VECTORS];
            for (product, other) in products.iter_mut().zip(&pending[..count]) {
                *product = simd::inner(simd, own, &before[other.column * stride..][..rows]);
            }
            pending[count] = Reflection {
                column: k,
                delta,
                per_beta: 1.0 / *diagonal,
                per_delta: 1.0 / delta,
                products,
            };
            count += 1;
            if count == VECTORS {
                let (before, after) = panel.split_at_mut((k + 1) * stride);
                let four = pending.map(|reflection| &before[reflection.column * stride..][..rows]);
                let columns = after
                    .chunks_mut(COLUMNS * stride)
                    .zip(filled[k + 1..].chunks_mut(COLUMNS));
                for (number, (columns, filled)) in columns.enumerate() {
                    let first = k + 1 + number * COLUMNS;
                    let rows_above = pending.map(|reflection| reflection.column * width + first);
                    apply(
                        simd,
                        (&pending, four),
                        (&mut *triangle, rows_above),
                        (columns, stride),
                        filled,
                    );
                }
                count = 0;
            }
        }
    }
}

/// Applies four successive reflections to some columns of the panel and to the triangle's numbers
/// above them. For a column `c` and the triangle's number `r_j` in the row of reflection `j`, the
/// reflection meets `c + sum_{i < j} f_i v_i`: `r_j` grows by `g_j = (v_j . c + sum_{i < j} f_i v_j
/// . v_i - delta_j r_j) / beta_j`, and `f_j = -g_j / delta_j`.
#[inline(always)]
pub(crate) fn apply<S: Simd>(
    simd: S,
    (reflections, four): (&[Reflection; VECTORS], [&[f64]; VECTORS]),
    (triangle, places): (&mut [f64], [usize; VECTORS]),
    (columns, stride): (&mut [f64], usize),
    filled: &mut [bool],
) {
    let (count, rows) = (filled.len(), four[0].len());
    let mut above = [[0.0; COLUMNS]; VECTORS];
    for (above, place) in above.iter_mut().zip(places) {
        above[..count].copy_from_slice(&triangle[place..][..count]);
    }
    let mut is_any = false;
    for (place, filled) in filled.iter_mut().enumerate() {
        for above in &above {
            *filled |= above[place] != 0.0;
        }
        is_any |= *filled;
    }
    if !is_any {
        return;
    }
    // Columns that are not filled are zero and remain zero.
    let mut factors = [[0.0; COLUMNS]; VECTORS];
    for (place, column) in columns.chunks(stride).enumerate() {
        for (products, product) in
            factors
                .iter_mut()
                .zip(simd::inner_of_four(simd, four, &column[..rows]))
        {
            products[place] = product;
        }
    }
    for (j, reflection) in reflections.iter().enumerate() {
        let (earlier, own) = factors.split_at_mut(j);
        for (earlier, product) in earlier.iter().zip(&reflection.products) {
            for place in 0..COLUMNS {
                own[0][place] += earlier[place] * product;
            }
        }
        for place in 0..COLUMNS {
            let growth = (own[0][place] - reflection.delta * above[j][place]) * reflection.per_beta;
            above[j][place] += growth;
            own[0][place] = -(growth * reflection.per_delta);
        }
    }
    for (above, place) in above.iter().zip(places) {
        triangle[place..][..count].copy_from_slice(&above[..count]);
    }
    for (place, column) in columns.chunks_mut(stride).enumerate() {
        let own = [
            factors[0][place],
            factors[1][place],
            factors[2][place],
            factors[3][place],
        ];
        simd::add_four(simd, &mut column[..rows], own, four);
    }
}
