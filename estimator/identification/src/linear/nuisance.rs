//! Elimination of the nuisance parameters of a log: drifting offsets, friction.
//!
//! Rows of the log are `A d + G s = r + noise`, with `s` a random walk. For the estimate of `d`
//! only the *innovations* matter: each row minus its prediction from the rows before it and the
//! random walk. A Kalman filter on `s` gives them. Its gains depend on neither `A` nor `r`, so it
//! runs on every column of `[A | r]` at once, as if each were a series of measurements. The
//! resulting rows have independent noise of unit variance and no `s`. Least squares on them is
//! exactly least squares on all unknowns together (de Jong 1991, "The diffuse Kalman filter"; the
//! augmented part there is `A`).
//!
//! For given `d` the same filter and a backward smoother (Rauch, Tung, Striebel) give `s` at every
//! time, and the residuals.

use nalgebra::DMatrix;

/// A Kalman filter on the nuisance parameters, with any number of right-hand columns.
///
/// Its covariance is kept as `P = U D U^T`, `U` unit upper triangular, `D` diagonal (Bierman,
/// "Factorization Methods for Discrete Sequential Estimation", Academic Press 1977, ch. V). An
/// update then has positive sums and quotients only. Subtraction from `P` itself would lose all
/// digits: `P` falls from 1e6 to 1e-6 with the first row of an exact sensor.
#[derive(Clone, Debug)]
pub(crate) struct NuisanceFilter {
    count: usize,
    columns: usize,
    /// Unit upper triangle, column by column, so that inner loops are contiguous.
    u: Vec<f64>,
    d: Vec<f64>,
    /// Estimates: a row per unknown.
    x: Vec<f64>,
    gain: Vec<f64>,
    work: Vec<f64>,
}

impl NuisanceFilter {
    /// The initial state with these prior variances.
    pub(crate) fn new(prior: &[f64], columns: usize) -> Self {
        let count = prior.len();
        let mut u = vec![0.0; count * count];
        u.iter_mut()
            .step_by(count + 1)
            .for_each(|entry| *entry = 1.0);
        Self {
            count,
            columns,
            u,
            d: prior.to_vec(),
            x: vec![0.0; count * columns],
            gain: vec![0.0; count],
            work: vec![0.0; count],
        }
    }

    /// A time step: adds these variances.
    pub(crate) fn drift(&mut self, variances: &[f64]) {
        for (i, variance) in variances.iter().enumerate() {
            if *variance > 0.0 {
                self.work.fill(0.0);
                self.work[i] = 1.0;
                self.add(*variance, i);
            }
        }
    }

    /// `P + weight w w^T`, `w` in the work space with zeros beyond `last` (Agee, Turner 1972).
    fn add(&mut self, mut weight: f64, last: usize) {
        let n = self.count;
        for j in (0..=last).rev() {
            let value = self.work[j];
            if value == 0.0 {
                continue;
            }
            let before = self.d[j];
            let after = before + weight * value * value;
            let share = weight * value / after;
            self.d[j] = after;
            weight *= before / after;
            for (u, w) in self.u[j * n..][..j].iter_mut().zip(&mut self.work) {
                *w -= value * *u;
                *u += share * *w;
            }
        }
    }

    /// Absorbs a whitened row. The row becomes its innovation, scaled to unit variance.
    pub(crate) fn update(&mut self, g: &[f64], row: &mut [f64]) {
        let n = self.count;
        for (i, weight) in g.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
            let estimate = &self.x[i * self.columns..][..self.columns];
            for (value, x) in row.iter_mut().zip(estimate) {
                *value -= weight * x;
            }
        }
        // One unknown after the other, `f = U^T g`. The variance grows from that of the row's noise
        // to that of its innovation.
        let mut variance = 1.0;
        self.gain.fill(0.0);
        for j in 0..n {
            let column = &mut self.u[j * n..][..=j];
            let f: f64 = column.iter().zip(g).map(|(u, g)| u * g).sum();
            if f == 0.0 {
                continue;
            }
            let v = self.d[j] * f;
            let before = variance;
            variance += f * v;
            self.d[j] *= before / variance;
            let weight = -f / before;
            for (u, gain) in column[..j].iter_mut().zip(&mut self.gain) {
                let old = *u;
                *u += weight * *gain;
                *gain += v * old;
            }
            self.gain[j] = v;
        }
        let estimates = self.x.chunks_exact_mut(self.columns.max(1));
        for (gain, x) in self.gain.iter().zip(estimates) {
            if *gain != 0.0 {
                let gain = gain / variance;
                for (x, value) in x.iter_mut().zip(&*row) {
                    *x += gain * value;
                }
            }
        }
        let scale = 1.0 / variance.sqrt();
        row.iter_mut().for_each(|x| *x *= scale);
    }

    pub(crate) fn covariance(&self) -> DMatrix<f64> {
        let u = DMatrix::from_column_slice(self.count, self.count, &self.u);
        let mut scaled = u.clone();
        for (mut column, d) in scaled.column_iter_mut().zip(&self.d) {
            column *= *d;
        }
        scaled * u.transpose()
    }

    pub(crate) fn estimates(&self) -> DMatrix<f64> {
        DMatrix::from_row_slice(self.count, self.columns, &self.x)
    }
}

/// The state of the filter at the end of a block of observations.
#[derive(Clone, Debug)]
pub(crate) struct NuisanceEstimate {
    /// Estimates and covariance with the block's rows.
    pub x: DMatrix<f64>,
    pub p: DMatrix<f64>,
    /// Variances added since the previous block.
    pub drift: Vec<f64>,
}

/// Smooths the estimates of all blocks in place (Rauch, Tung, Striebel).
pub(crate) fn smooth(blocks: &mut [NuisanceEstimate]) {
    for k in (1..blocks.len()).rev() {
        let (before, after) = blocks.split_at_mut(k);
        let (old, new) = (&mut before[k - 1], &after[0]);
        let mut predicted = old.p.clone();
        for (i, variance) in new.drift.iter().enumerate() {
            predicted[(i, i)] += variance;
        }
        let Some(factor) = predicted.clone().cholesky() else {
            continue;
        };
        // P (P + Q)^-1 as 1 - Q (P + Q)^-1, which keeps all digits for unknowns that hardly drift.
        let mut gain = -factor.inverse();
        for (i, drift) in new.drift.iter().enumerate() {
            gain.row_mut(i).scale_mut(*drift);
            gain[(i, i)] += 1.0;
        }
        old.x += &gain * (&new.x - &old.x);
        old.p += &gain * (&new.p - predicted) * gain.transpose();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;

    /// Innovations with a drifting offset, compared with least squares on every block's offset: the
    /// information about `d`, its estimate, and the smoothed offsets.
    #[test]
    fn elimination_is_least_squares_on_all_unknowns() {
        let (p, s, count, per_block) = (3, 2, 12, 4);
        let mut x = 0.3_f64;
        let mut next = || {
            // A chaotic map: numbers without pattern.
            x = 3.99 * x * (1.0 - x);
            2.0 * x - 1.0
        };
        let prior = [50.0, 80.0];
        let steps = [0.4, 0.0];
        let rows: Vec<(Vec<f64>, Vec<f64>, f64)> = (0..count * per_block)
            .map(|_| {
                (
                    (0..p).map(|_| next()).collect(),
                    (0..s).map(|_| next()).collect(),
                    3.0 * next(),
                )
            })
            .collect();

        // All at once: [d | s of each block].
        let unknowns = p + s * count;
        let (mut normal, mut right) =
            (DMatrix::zeros(unknowns, unknowns), DVector::zeros(unknowns));
        let mut add = |a: DVector<f64>, y: f64, variance: f64| {
            normal += &a * a.transpose() / variance;
            right += a * (y / variance);
        };
        for i in 0..s {
            let mut a = DVector::zeros(unknowns);
            a[p + i] = 1.0;
            add(a, 0.0, prior[i]);
        }
        for (k, (a, g, y)) in rows.iter().enumerate() {
            let block = k / per_block;
            let mut row = DVector::zeros(unknowns);
            row.rows_mut(0, p).copy_from_slice(a);
            row.rows_mut(p + s * block, s).copy_from_slice(g);
            add(row, *y, 1.0);
        }
        for block in 1..count {
            for (i, step) in steps.iter().enumerate() {
                let mut a = DVector::zeros(unknowns);
                a[p + s * block + i] = 1.0;
                a[p + s * (block - 1) + i] = -1.0;
                // A step of zero variance is replaced by a tiny one.
                add(a, 0.0, f64::max(*step, 1e-9));
            }
        }
        let all = normal.clone().cholesky().expect("definite").solve(&right);

        let mut nuisance = NuisanceFilter::new(&prior, p + 1);
        let (mut information, mut weighted) = (DMatrix::zeros(p, p), DVector::zeros(p));
        for (k, (a, g, y)) in rows.iter().enumerate() {
            if k > 0 && k % per_block == 0 {
                nuisance.drift(&steps);
            }
            let mut line = [a.clone(), vec![*y]].concat();
            nuisance.update(g, &mut line);
            let a = DVector::from_column_slice(&line[..p]);
            information += &a * a.transpose();
            weighted += a * line[p];
        }
        let d = information.cholesky().expect("definite").solve(&weighted);
        assert!((&d - all.rows(0, p)).amax() < 1e-6, "{d} {all}");
        let last = nuisance.estimates();
        for i in 0..s {
            let value = last[(i, p)] - last.row(i).columns(0, p).transpose().dot(&d);
            assert!((value - all[p + s * (count - 1) + i]).abs() < 1e-6);
        }

        // With d known, all offsets.
        let mut nuisance = NuisanceFilter::new(&prior, 1);
        let mut blocks: Vec<NuisanceEstimate> = Vec::new();
        for block in 0..count {
            if block > 0 {
                nuisance.drift(&steps);
            }
            for (a, g, y) in &rows[per_block * block..per_block * (block + 1)] {
                let mut line = [y - DVector::from_column_slice(a).dot(&d)];
                nuisance.update(g, &mut line);
            }
            blocks.push(NuisanceEstimate {
                x: nuisance.estimates(),
                p: nuisance.covariance(),
                drift: steps.to_vec(),
            });
        }
        smooth(&mut blocks);
        for (block, found) in blocks.iter().enumerate() {
            for i in 0..s {
                assert!(
                    (found.x[(i, 0)] - all[p + s * block + i]).abs() < 1e-6,
                    "block {block}"
                );
            }
        }
    }

    /// An almost unknown offset, and rows as exact as those of a torque sensor, so that every digit
    /// matters. Compared with orthogonal least squares on all unknowns.
    #[test]
    fn elimination_keeps_its_digits_from_a_prior_variance_of_a_million() {
        let (p, s, count, per_block) = (4, 6, 8, 6);
        let mut x = 0.3_f64;
        let mut next = || {
            x = 3.99 * x * (1.0 - x);
            2.0 * x - 1.0
        };
        let prior = [1e6; 6];
        let steps = [1e-7, 2e-7, 0.0, 1e-4, 0.0, 3e-5];
        let rows: Vec<(Vec<f64>, Vec<f64>, f64)> = (0..count * per_block)
            .map(|k| {
                // Six rows of an observation, with noise between a thousandth and a tenth.
                let weight = [700.0, 300.0, 500.0, 12.0, 10.0, 6.0][k % s];
                let mut g: Vec<f64> = (0..s).map(|_| 0.1 * weight * next()).collect();
                g[k % s] += weight;
                (
                    (0..p).map(|_| weight * next()).collect(),
                    g,
                    200.0 * weight * next(),
                )
            })
            .collect();

        // [d | s of each block]. A step of zero variance means the same unknown.
        let mut index = vec![[0; 6]; count];
        let mut unknowns = p;
        for block in 0..count {
            for i in 0..s {
                index[block][i] = if block > 0 && steps[i] == 0.0 {
                    index[block - 1][i]
                } else {
                    unknowns += 1;
                    unknowns - 1
                };
            }
        }
        let mut lines: Vec<(DVector<f64>, f64)> = Vec::new();
        let line = |entries: &[(usize, f64)]| {
            let mut a = DVector::zeros(unknowns);
            entries.iter().for_each(|(at, value)| a[*at] = *value);
            a
        };
        for i in 0..s {
            lines.push((line(&[(index[0][i], 1.0 / f64::sqrt(prior[i]))]), 0.0));
            for block in 1..count {
                if steps[i] > 0.0 {
                    let weight = 1.0 / f64::sqrt(steps[i]);
                    lines.push((
                        line(&[(index[block][i], weight), (index[block - 1][i], -weight)]),
                        0.0,
                    ));
                }
            }
        }
        for (k, (a, g, y)) in rows.iter().enumerate() {
            let of_d = a.iter().copied().enumerate();
            let of_s = g
                .iter()
                .enumerate()
                .map(|(i, g)| (index[k / per_block][i], *g));
            lines.push((line(&of_d.chain(of_s).collect::<Vec<_>>()), *y));
        }
        // Exact rows first, so that Householder's triangle keeps the digits of all (Higham 2002,
        // th. 20.7).
        lines.sort_by(|a, b| b.0.amax().total_cmp(&a.0.amax()));
        let dense = DMatrix::from_fn(lines.len(), unknowns, |i, j| lines[i].0[j]);
        let right = DVector::from_fn(lines.len(), |i, _| lines[i].1);
        let qr = dense.qr();
        let all = qr
            .r()
            .solve_upper_triangular(&(qr.q().transpose() * right))
            .expect("determined");

        let mut nuisance = NuisanceFilter::new(&prior, p + 1);
        let (mut innovations, mut rights) =
            (DMatrix::zeros(rows.len(), p), DVector::zeros(rows.len()));
        for (k, (a, g, y)) in rows.iter().enumerate() {
            if k > 0 && k % per_block == 0 {
                nuisance.drift(&steps);
            }
            let mut line = [a.clone(), vec![*y]].concat();
            nuisance.update(g, &mut line);
            (0..p).for_each(|i| innovations[(k, i)] = line[i]);
            rights[k] = line[p];
        }
        let qr = innovations.qr();
        let d = qr
            .r()
            .solve_upper_triangular(&(qr.q().transpose() * rights))
            .expect("determined");
        let off = (&d - all.rows(0, p)).amax() / all.rows(0, p).amax();
        assert!(off < 1e-10, "{off:e}");
        let last = nuisance.estimates();
        for i in 0..s {
            let value = last[(i, p)] - last.row(i).columns(0, p).transpose().dot(&d);
            let off = (value - all[index[count - 1][i]]).abs() / all.amax();
            assert!(off < 1e-10, "offset {i}: {off:e}");
        }
    }
}
