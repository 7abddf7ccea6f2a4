//! The unknowns that belong to a log, not to the robot, eliminated: offsets that wander, friction.
//!
//! Rows of the log are `A d + G s = r + noise`, with `s` a random walk. For the estimate of `d` everything that matters is in the *innovations*: what each row tells beyond what the
//! rows before it and the random walk tell of `G s`. A Kalman filter on `s` gives them; its gains depend on neither `A` nor `r`, so it is run on every column of `[A | r]` at once, as if each
//! were a series of measurements. The rows that come out have independent noise of unit variance and no `s` left: least squares on them are exactly those on all unknowns together
//! (de Jong 1991, "The diffuse Kalman filter"; the augmented part there is `A`).
//!
//! For given `d` the same filter, and a smoother back through time (Rauch, Tung, Striebel), give `s` at every instant, and the residuals.

use nalgebra::DMatrix;

/// A Kalman filter on the session's unknowns, with as many right-hand columns as wanted.
#[derive(Clone, Debug)]
pub(super) struct Session {
    count: usize,
    columns: usize,
    /// Covariance, row by row.
    p: Vec<f64>,
    /// Estimates: a row per unknown.
    x: Vec<f64>,
    gain: Vec<f64>,
}

impl Session {
    /// Nothing known but these variances.
    pub(super) fn new(prior: &[f64], columns: usize) -> Self {
        let count = prior.len();
        let mut p = vec![0.0; count * count];
        for (i, variance) in prior.iter().enumerate() {
            p[i * count + i] = *variance;
        }
        Self {
            count,
            columns,
            p,
            x: vec![0.0; count * columns],
            gain: vec![0.0; count],
        }
    }

    /// Time passes: variances are added.
    pub(super) fn drift(&mut self, variances: &[f64]) {
        for (i, variance) in variances.iter().enumerate() {
            self.p[i * self.count + i] += variance;
        }
    }

    /// One unknown starts afresh.
    pub(super) fn renew(&mut self, unknown: usize, variance: f64) {
        for i in 0..self.count {
            self.p[i * self.count + unknown] = 0.0;
            self.p[unknown * self.count + i] = 0.0;
        }
        self.p[unknown * self.count + unknown] = variance;
        self.x[unknown * self.columns..][..self.columns].fill(0.0);
    }

    /// Takes a whitened row; it becomes its innovation, scaled to unit variance.
    pub(super) fn update(&mut self, g: &[f64], row: &mut [f64]) {
        let n = self.count;
        let mut variance = 1.0;
        self.gain.fill(0.0);
        for (i, weight) in g.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
            for (sum, p) in self.gain.iter_mut().zip(&self.p[i * n..][..n]) {
                *sum += weight * p;
            }
            for (value, x) in row.iter_mut().zip(&self.x[i * self.columns..][..self.columns]) {
                *value -= weight * x;
            }
        }
        variance += g.iter().zip(&self.gain).map(|(x, y)| x * y).sum::<f64>();
        let inverse = 1.0 / variance;
        for i in 0..n {
            let gain = self.gain[i] * inverse;
            if gain == 0.0 {
                continue;
            }
            for (p, other) in self.p[i * n..][..n].iter_mut().zip(&self.gain) {
                *p -= gain * other;
            }
            for (x, value) in self.x[i * self.columns..][..self.columns].iter_mut().zip(&*row) {
                *x += gain * value;
            }
        }
        let scale = inverse.sqrt();
        row.iter_mut().for_each(|x| *x *= scale);
    }

    pub(super) fn covariance(&self) -> DMatrix<f64> {
        DMatrix::from_row_slice(self.count, self.count, &self.p)
    }

    pub(super) fn estimates(&self) -> DMatrix<f64> {
        DMatrix::from_row_slice(self.count, self.columns, &self.x)
    }
}

/// What the filter knew at the end of a block of instants.
#[derive(Clone, Debug)]
pub(super) struct Block {
    /// Estimates and covariance with the block's rows.
    pub x: DMatrix<f64>,
    pub p: DMatrix<f64>,
    /// Variances added between the block before and this one; an unknown that started afresh has infinity here.
    pub drift: Vec<f64>,
}

/// Estimates of every block given all blocks, in place (Rauch, Tung, Striebel).
pub(super) fn smooth(blocks: &mut [Block]) {
    for k in (1..blocks.len()).rev() {
        let (before, after) = blocks.split_at_mut(k);
        let (old, new) = (&mut before[k - 1], &after[0]);
        // Unknowns that are not constant, and continue: the others are known from the future as they are.
        let mut predicted = old.p.clone();
        for (i, variance) in new.drift.iter().enumerate() {
            if variance.is_finite() {
                predicted[(i, i)] += variance;
            }
        }
        let continues: Vec<usize> = (0..new.drift.len()).filter(|&i| new.drift[i].is_finite()).collect();
        if continues.is_empty() {
            continue;
        }
        let cross = old.p.select_columns(&continues);
        let inner = predicted.select_rows(&continues).select_columns(&continues);
        let Some(factor) = inner.cholesky() else { continue };
        let gain = factor.solve(&cross.transpose()).transpose();
        let ahead = new.x.select_rows(&continues) - old.x.select_rows(&continues);
        old.x += &gain * ahead;
        let apart = new.p.select_rows(&continues).select_columns(&continues)
            - predicted.select_rows(&continues).select_columns(&continues);
        old.p += &gain * apart * gain.transpose();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;

    /// Innovations of a walking offset against least squares with every block's offset as an unknown of its own: the information about `d`, its estimate, and the smoothed offsets.
    #[test]
    fn elimination_is_least_squares_on_everything() {
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

        // Everything at once: [d | s of each block].
        let unknowns = p + s * count;
        let (mut normal, mut right) = (DMatrix::zeros(unknowns, unknowns), DVector::zeros(unknowns));
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
                // A step of no variance is a step of hardly any.
                add(a, 0.0, f64::max(*step, 1e-9));
            }
        }
        let all = normal.clone().cholesky().expect("definite").solve(&right);

        let mut session = Session::new(&prior, p + 1);
        let (mut information, mut told) = (DMatrix::zeros(p, p), DVector::zeros(p));
        for (k, (a, g, y)) in rows.iter().enumerate() {
            if k > 0 && k % per_block == 0 {
                session.drift(&steps);
            }
            let mut line = [a.clone(), vec![*y]].concat();
            session.update(g, &mut line);
            let a = DVector::from_column_slice(&line[..p]);
            information += &a * a.transpose();
            told += a * line[p];
        }
        let d = information.cholesky().expect("definite").solve(&told);
        assert!((&d - all.rows(0, p)).amax() < 1e-6, "{d} {all}");
        let last = session.estimates();
        for i in 0..s {
            let own = last[(i, p)] - last.row(i).columns(0, p).transpose().dot(&d);
            assert!((own - all[p + s * (count - 1) + i]).abs() < 1e-6);
        }

        // With d known, all offsets.
        let mut session = Session::new(&prior, 1);
        let mut blocks: Vec<Block> = Vec::new();
        for block in 0..count {
            if block > 0 {
                session.drift(&steps);
            }
            for (a, g, y) in &rows[per_block * block..per_block * (block + 1)] {
                let mut line = [y - DVector::from_column_slice(a).dot(&d)];
                session.update(g, &mut line);
            }
            blocks.push(Block {
                x: session.estimates(),
                p: session.covariance(),
                drift: steps.to_vec(),
            });
        }
        smooth(&mut blocks);
        for (block, found) in blocks.iter().enumerate() {
            for i in 0..s {
                assert!((found.x[(i, 0)] - all[p + s * block + i]).abs() < 1e-6, "block {block}");
            }
        }
    }
}
