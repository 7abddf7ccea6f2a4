//! Base parameters as readable sums: the eliminated parameters, and the parameters to which they
//! are added.

use std::fmt;

use super::assemble::NullVector;

/// A parameter with its factor in a sum.
#[derive(Clone, Debug, PartialEq)]
pub struct Term {
    /// The factor.
    pub coefficient: f64,
    /// The column of the parameter.
    pub column: usize,
    /// Its name, such as `l_hand.m`.
    pub name: String,
}

/// An identifiable combination of parameters: one that is kept, and multiples of eliminated ones,
/// which appear only in such sums.
///
/// One parameter is eliminated per null vector. At each joint these are parameters of the outer
/// link, chosen for the smallest factors, so that parameters are lumped towards the base. Offsets
/// are eliminated rather than the parameters from which they are not separable. Where a factor
/// would exceed [`BaseParameter::LARGEST`] (long links), the two parameters exchange roles, until
/// no factor does. The sums of one subspace are a basis of it: they have the same information as
/// `B^T phi`.
///
/// Prints as `upper.m + lower.m`, `lower.h_y - 0.25 hand.m`, with four digits.
#[derive(Clone, Debug, PartialEq)]
pub struct BaseParameter {
    /// The kept parameter; its coefficient is 1.
    pub kept: Term,
    /// The added terms, columns ascending.
    pub terms: Vec<Term>,
}

impl BaseParameter {
    /// Bound on the coefficients.
    pub const LARGEST: f64 = 10.0;

    /// Coefficients below this are rounding errors, mainly of the URDF's angles, and are dropped.
    const SMALLEST: f64 = 1e-9;

    /// Its value, given a value per column; `None` if a column that it needs is missing.
    pub fn value(&self, columns: &[f64]) -> Option<f64> {
        std::iter::once(&self.kept)
            .chain(&self.terms)
            .map(|term| Some(term.coefficient * columns.get(term.column)?))
            .sum()
    }
}

impl fmt::Display for BaseParameter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.kept.name)?;
        for term in &self.terms {
            let sign = if term.coefficient < 0.0 { '-' } else { '+' };
            // Four significant digits without trailing zeros: the shortest text of the rounded
            // number.
            let rounded: f64 = format!("{:.3e}", term.coefficient.abs())
                .parse()
                .unwrap_or(f64::NAN);
            if rounded == 1.0 {
                write!(f, " {sign} {}", term.name)?;
            } else if rounded < 1e-3 {
                write!(f, " {sign} {rounded:e} {}", term.name)?;
            } else {
                write!(f, " {sign} {rounded} {}", term.name)?;
            }
        }
        Ok(())
    }
}

/// The sums for these null vectors, each of which has a 1 at its pivot and zeros at the pivots of
/// later ones.
pub(super) fn base_parameters(names: &[String], null: &[NullVector]) -> Vec<BaseParameter> {
    let mut elimination = Elimination::new(names.len(), null);
    elimination.bound();
    let term = |coefficient: f64, column: usize| Term {
        coefficient,
        column,
        name: names[column].clone(),
    };
    let eliminated = elimination.eliminated.iter().copied();
    let mut by_column: Vec<(usize, usize)> = eliminated.zip(0..).collect();
    by_column.sort_unstable();
    (0..names.len())
        .filter(|&column| elimination.is_kept[column])
        .map(|kept| BaseParameter {
            kept: term(1.0, kept),
            terms: by_column
                .iter()
                .map(|&(column, k)| (-elimination.vectors[k][kept], column))
                .filter(|(coefficient, _)| coefficient.abs() >= BaseParameter::SMALLEST)
                .map(|(coefficient, column)| term(coefficient, column))
                .collect(),
        })
        .collect()
}

/// Dense null vectors, with the identity at the columns that they eliminate: `phi ~ phi - vector_k
/// phi_(eliminated k)`, so the coefficient of the eliminated `k` in the sum of a kept column is
/// `-vector_k` there.
struct Elimination {
    /// Per vector, its column.
    eliminated: Vec<usize>,
    is_kept: Vec<bool>,
    vectors: Vec<Vec<f64>>,
}

impl Elimination {
    fn new(count: usize, null: &[NullVector]) -> Self {
        let mut order = vec![None; count];
        for (k, vector) in null.iter().enumerate() {
            order[vector.pivot] = Some(k);
        }
        // Those towards the base are computed before those that need them.
        let mut vectors: Vec<Vec<f64>> = Vec::with_capacity(null.len());
        for (k, vector) in null.iter().enumerate() {
            let mut dense = vec![0.0; count];
            for &(column, entry) in &vector.entries {
                dense[column] = entry;
            }
            for &(column, _) in &vector.entries {
                if let Some(other) = order[column].filter(|&other| other < k) {
                    let factor = std::mem::take(&mut dense[column]);
                    for (x, y) in dense.iter_mut().zip(&vectors[other]) {
                        *x -= factor * y;
                    }
                    dense[column] = 0.0;
                }
            }
            vectors.push(dense);
        }
        Self {
            eliminated: null.iter().map(|vector| vector.pivot).collect(),
            is_kept: order.iter().map(Option::is_none).collect(),
            vectors,
        }
    }

    /// Exchanges kept and eliminated columns until no factor exceeds the bound.
    fn bound(&mut self) {
        while let Some((k, column)) = self.worst() {
            // Each exchange multiplies the determinant of the eliminated rows by more than LARGEST,
            // so this ends.
            let pivot = self.vectors[k][column];
            self.vectors[k].iter_mut().for_each(|x| *x /= pivot);
            let chosen = self.vectors[k].clone();
            for (other, dense) in self.vectors.iter_mut().enumerate() {
                let factor = dense[column];
                if other != k && factor != 0.0 {
                    dense
                        .iter_mut()
                        .zip(&chosen)
                        .for_each(|(x, y)| *x -= factor * y);
                    dense[column] = 0.0;
                }
            }
            self.is_kept[column] = false;
            self.is_kept[self.eliminated[k]] = true;
            self.eliminated[k] = column;
        }
    }

    /// The vector and the kept column of the greatest factor, if it exceeds the bound.
    fn worst(&self) -> Option<(usize, usize)> {
        let factors = self.vectors.iter().enumerate().flat_map(|(k, dense)| {
            let columns = dense.iter().enumerate();
            columns.map(move |(column, x)| (k, column, x.abs()))
        });
        let kept = factors.filter(|&(_, column, _)| self.is_kept[column]);
        let (k, column, worst) = kept.max_by(|a, b| a.2.total_cmp(&b.2))?;
        (worst > BaseParameter::LARGEST).then_some((k, column))
    }
}
