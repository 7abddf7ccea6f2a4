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
///
/// Its covariance is kept as `P = U D U^T`, `U` unit upper triangular, `D` diagonal (Bierman, "Factorization Methods for Discrete Sequential Estimation", Academic Press 1977,
/// ch. V): an update is of positive sums and quotients. Subtracting from `P` itself, which falls from 1e6 to 1e-6 with the first row of an exact sensor, leaves no digit of it.
#[derive(Clone, Debug)]
pub(super) struct Session {
    count: usize,
    columns: usize,
    /// Unit upper triangle, column by column, so that what is worked on lies together.
    u: Vec<f64>,
    d: Vec<f64>,
    /// Estimates: a row per unknown.
    x: Vec<f64>,
    gain: Vec<f64>,
    work: Vec<f64>,
}

impl Session {
    /// Nothing known but these variances.
    pub(super) fn new(prior: &[f64], columns: usize) -> Self {
        let count = prior.len();
        let mut u = vec![0.0; count * count];
        u.iter_mut().step_by(count + 1).for_each(|entry| *entry = 1.0);
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

    /// Time passes: variances are added.
    pub(super) fn drift(&mut self, variances: &[f64]) {
        for (i, variance) in variances.iter().enumerate() {
            if *variance > 0.0 {
                self.work.fill(0.0);
                self.work[i] = 1.0;
                self.add(*variance, i);
            }
        }
    }

    /// `P + weight w w^T`, `w` in the working room with zeros beyond `last` (Agee, Turner 1972).
    fn add(&mut self, mut weight: f64, last: usize) {
        let n = self.count;
        for j in (0..=last).rev() {
            let own = self.work[j];
            if own == 0.0 {
                continue;
            }
            let before = self.d[j];
            let after = before + weight * own * own;
            let share = weight * own / after;
            self.d[j] = after;
            weight *= before / after;
            for (u, w) in self.u[j * n..][..j].iter_mut().zip(&mut self.work) {
                *w -= own * *u;
                *u += share * *w;
            }
        }
    }

    /// One unknown starts afresh.
    pub(super) fn renew(&mut self, unknown: usize, variance: f64) {
        let n = self.count;
        // What it has in common with those before it stays theirs; then nothing is.
        let weight = self.d[unknown];
        self.work.fill(0.0);
        self.work[..unknown].copy_from_slice(&self.u[unknown * n..][..unknown]);
        self.u[unknown * n..][..unknown].fill(0.0);
        self.u[unknown * n..]
            .iter_mut()
            .skip(unknown + n)
            .step_by(n)
            .for_each(|u| *u = 0.0);
        if unknown > 0 {
            self.add(weight, unknown - 1);
        }
        self.d[unknown] = variance;
        self.x[unknown * self.columns..][..self.columns].fill(0.0);
    }

    /// Takes a whitened row; it becomes its innovation, scaled to unit variance.
    pub(super) fn update(&mut self, g: &[f64], row: &mut [f64]) {
        let n = self.count;
        for (i, weight) in g.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
            for (value, x) in row.iter_mut().zip(&self.x[i * self.columns..][..self.columns]) {
                *value -= weight * x;
            }
        }
        // One unknown after the other, `f = U^T g`; the variance grows from that of the row's noise to that of its innovation.
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
        for (gain, x) in self.gain.iter().zip(self.x.chunks_exact_mut(self.columns.max(1))) {
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

    pub(super) fn covariance(&self) -> DMatrix<f64> {
        let u = DMatrix::from_column_slice(self.count, self.count, &self.u);
        let mut scaled = u.clone();
        for (mut column, d) in scaled.column_iter_mut().zip(&self.d) {
            column *= *d;
        }
        scaled * u.transpose()
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
    smooth_with(blocks, |_, _, _, _| ());
}

/// The same, telling on the way back in time, of each block but the first, how the block before is known from it: `(number, block, gain, continues)`. The covariance of the unknowns of the block
/// before with those of any later block is `gain` times the rows `continues` of this block's with it: of what did not start afresh.
pub(super) fn smooth_with(blocks: &mut [Block], mut tell: impl FnMut(usize, &Block, &DMatrix<f64>, &[usize])) {
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
        let inner = predicted.select_rows(&continues).select_columns(&continues);
        let Some(factor) = inner.cholesky().filter(|_| !continues.is_empty()) else {
            tell(k, new, &DMatrix::zeros(new.drift.len(), 0), &[]);
            continue;
        };
        // P (P + Q)^-1 as 1 - Q (P + Q)^-1: what hardly walks is known from the future to the last digit.
        let mut gain = factor.solve(&old.p.select_columns(&continues).transpose()).transpose();
        let inverse = factor.inverse();
        for (place, &i) in continues.iter().enumerate() {
            for other in 0..continues.len() {
                gain[(i, other)] = f64::from(u8::from(place == other)) - new.drift[i] * inverse[(place, other)];
            }
        }
        tell(k, new, &gain, &continues);
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

    /// Covariances of all blocks with all others, against those of least squares; an unknown that starts afresh has none with what it was before but through what goes on.
    #[test]
    fn blocks_go_together_as_in_least_squares_on_everything() {
        let (s, count) = (2, 5);
        let (prior, steps) = ([4.0, 9.0], [0.3, 0.1]);
        let g = |block: usize| [[1.0, 1.0], [0.2 * block as f64, -0.5]];
        let mut precision = DMatrix::<f64>::zeros(s * count, s * count);
        let mut session = Session::new(&prior, 1);
        let mut blocks: Vec<Block> = Vec::new();
        for block in 0..count {
            let mut drift = steps.to_vec();
            if block == 3 {
                drift[0] = f64::INFINITY;
            }
            for i in 0..s {
                let (now, before) = (s * block + i, (s * block + i).wrapping_sub(s));
                if block == 0 || drift[i].is_infinite() {
                    precision[(now, now)] += 1.0 / prior[i];
                } else {
                    precision[(now, now)] += 1.0 / drift[i];
                    precision[(before, before)] += 1.0 / drift[i];
                    precision[(now, before)] -= 1.0 / drift[i];
                    precision[(before, now)] -= 1.0 / drift[i];
                }
            }
            if block > 0 {
                session.drift(&steps);
            }
            if block == 3 {
                session.renew(0, prior[0]);
            }
            for row in g(block) {
                for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    precision[(s * block + i, s * block + j)] += row[i] * row[j];
                }
                session.update(&row, &mut [0.0]);
            }
            blocks.push(Block {
                x: session.estimates(),
                p: session.covariance(),
                drift,
            });
        }
        let expected = precision.try_inverse().expect("regular");
        let mut carried: Vec<(usize, DMatrix<f64>)> = Vec::new();
        smooth_with(&mut blocks, |block, state, gain, continues| {
            carried.push((block, state.p.clone()));
            for (later, covariance) in &mut carried {
                *covariance = gain * covariance.select_rows(continues);
                let expected = expected.view((s * (block - 1), s * *later), (s, s));
                assert!((&*covariance - expected).amax() < 1e-9, "{} and {later}", block - 1);
            }
        });
        assert_eq!(carried.len(), count - 1);
    }

    /// An offset of which next to nothing is known, and rows as exact as those of a torque sensor: every digit counts. Against orthogonal least squares on all unknowns.
    #[test]
    fn elimination_keeps_its_digits_from_a_start_of_a_million() {
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
                // Six rows of an instant, their noise between a thousandth and a tenth.
                let weight = [700.0, 300.0, 500.0, 12.0, 10.0, 6.0][k % s];
                let mut g: Vec<f64> = (0..s).map(|_| 0.1 * weight * next()).collect();
                g[k % s] += weight;
                ((0..p).map(|_| weight * next()).collect(), g, 200.0 * weight * next())
            })
            .collect();

        // [d | s of each block]; a step of no variance: the same unknown.
        let mut place = vec![[0; 6]; count];
        let mut unknowns = p;
        for block in 0..count {
            for i in 0..s {
                place[block][i] = if block > 0 && steps[i] == 0.0 {
                    place[block - 1][i]
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
            lines.push((line(&[(place[0][i], 1.0 / f64::sqrt(prior[i]))]), 0.0));
            for block in 1..count {
                if steps[i] > 0.0 {
                    let weight = 1.0 / f64::sqrt(steps[i]);
                    lines.push((line(&[(place[block][i], weight), (place[block - 1][i], -weight)]), 0.0));
                }
            }
        }
        for (k, (a, g, y)) in rows.iter().enumerate() {
            let of_d = a.iter().copied().enumerate();
            let of_s = g.iter().enumerate().map(|(i, g)| (place[k / per_block][i], *g));
            lines.push((line(&of_d.chain(of_s).collect::<Vec<_>>()), *y));
        }
        // Exact rows first: so Householder's triangle keeps the digits of all (Higham 2002, th. 20.7).
        lines.sort_by(|a, b| b.0.amax().total_cmp(&a.0.amax()));
        let dense = DMatrix::from_fn(lines.len(), unknowns, |i, j| lines[i].0[j]);
        let right = DVector::from_fn(lines.len(), |i, _| lines[i].1);
        let qr = dense.qr();
        let all = qr
            .r()
            .solve_upper_triangular(&(qr.q().transpose() * right))
            .expect("determined");

        let mut session = Session::new(&prior, p + 1);
        let (mut told, mut rights) = (DMatrix::zeros(rows.len(), p), DVector::zeros(rows.len()));
        for (k, (a, g, y)) in rows.iter().enumerate() {
            if k > 0 && k % per_block == 0 {
                session.drift(&steps);
            }
            let mut line = [a.clone(), vec![*y]].concat();
            session.update(g, &mut line);
            (0..p).for_each(|i| told[(k, i)] = line[i]);
            rights[k] = line[p];
        }
        let qr = told.qr();
        let d = qr
            .r()
            .solve_upper_triangular(&(qr.q().transpose() * rights))
            .expect("determined");
        let off = (&d - all.rows(0, p)).amax() / all.rows(0, p).amax();
        assert!(off < 1e-10, "{off:e}");
        let last = session.estimates();
        for i in 0..s {
            let own = last[(i, p)] - last.row(i).columns(0, p).transpose().dot(&d);
            let off = (own - all[place[count - 1][i]]).abs() / all.amax();
            assert!(off < 1e-10, "offset {i}: {off:e}");
        }
    }

    /// What starts afresh forgets, and the others keep, as if it had never been.
    #[test]
    fn an_unknown_that_starts_afresh_takes_nothing_with_it() {
        let rows = [[1.0, 0.5, -0.3], [0.2, 1.0, 0.7], [0.4, -0.6, 1.0], [0.9, 0.1, 0.2]];
        for unknown in 0..3 {
            let mut session = Session::new(&[4.0, 9.0, 2.0], 1);
            for (k, g) in rows.iter().enumerate() {
                session.update(g, &mut [k as f64 - 1.3]);
            }
            let (x, p) = (session.estimates(), session.covariance());
            session.renew(unknown, 5.0);
            let (other_x, other_p) = (session.estimates(), session.covariance());
            for i in 0..3 {
                let expected = if i == unknown { 0.0 } else { x[(i, 0)] };
                assert!((other_x[(i, 0)] - expected).abs() < 1e-14);
                for j in 0..3 {
                    let expected = match (i == unknown, j == unknown) {
                        (true, true) => 5.0,
                        (false, false) => p[(i, j)],
                        _ => 0.0,
                    };
                    assert!((other_p[(i, j)] - expected).abs() < 1e-14, "{unknown}: {other_p} {p}");
                }
            }
        }
    }
}
