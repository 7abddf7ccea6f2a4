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
    let count = names.len();
    let mut eliminated: Vec<usize> = null.iter().map(|vector| vector.pivot).collect();
    let mut order = vec![None; count];
    for (k, &pivot) in eliminated.iter().enumerate() {
        order[pivot] = Some(k);
    }
    // Dense null vectors with the identity at all pivots: those towards the base are computed
    // before those that need them.
    let mut ready: Vec<Vec<f64>> = Vec::with_capacity(null.len());
    for (k, vector) in null.iter().enumerate() {
        let mut dense = vec![0.0; count];
        for &(column, entry) in &vector.entries {
            dense[column] = entry;
        }
        for &(column, _) in &vector.entries {
            if let Some(other) = order[column].filter(|&other| other < k) {
                let factor = std::mem::take(&mut dense[column]);
                for (x, y) in dense.iter_mut().zip(&ready[other]) {
                    *x -= factor * y;
                }
                dense[column] = 0.0;
            }
        }
        ready.push(dense);
    }
    // phi ~ phi - ready_k phi_(pivot k): the coefficient of the eliminated k in the sum of a kept
    // column is -ready_k there.
    let mut is_kept: Vec<bool> = order.iter().map(Option::is_none).collect();
    loop {
        let worst = ready
            .iter()
            .enumerate()
            .flat_map(|(k, dense)| {
                dense
                    .iter()
                    .enumerate()
                    .map(move |(column, x)| (k, column, x.abs()))
            })
            .filter(|&(_, column, _)| is_kept[column])
            .max_by(|a, b| a.2.total_cmp(&b.2));
        let Some((k, column, _)) = worst.filter(|worst| worst.2 > BaseParameter::LARGEST) else {
            break;
        };
        // Each exchange multiplies the determinant of the eliminated rows by more than LARGEST, so
        // this ends.
        let pivot = ready[k][column];
        ready[k].iter_mut().for_each(|x| *x /= pivot);
        let chosen = ready[k].clone();
        for (other, dense) in ready.iter_mut().enumerate() {
            let factor = dense[column];
            if other != k && factor != 0.0 {
                dense
                    .iter_mut()
                    .zip(&chosen)
                    .for_each(|(x, y)| *x -= factor * y);
                dense[column] = 0.0;
            }
        }
        is_kept[column] = false;
        is_kept[eliminated[k]] = true;
        eliminated[k] = column;
    }
    let term = |coefficient: f64, column: usize| Term {
        coefficient,
        column,
        name: names[column].clone(),
    };
    let mut by_column: Vec<(usize, usize)> = eliminated.iter().copied().zip(0..).collect();
    by_column.sort_unstable();
    (0..count)
        .filter(|&column| is_kept[column])
        .map(|kept| BaseParameter {
            kept: term(1.0, kept),
            terms: by_column
                .iter()
                .map(|&(column, k)| (-ready[k][kept], column))
                .filter(|(coefficient, _)| coefficient.abs() >= BaseParameter::SMALLEST)
                .map(|(coefficient, column)| term(coefficient, column))
                .collect(),
        })
        .collect()
}
