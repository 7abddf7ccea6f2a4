//! Rows of one observation, whitened by the noise of its channels.

use crate::arithmetic::{add_multiple, dot, factorise, forward};
use crate::measurement::unknowns::Unknowns;

/// The rows of one observation.
#[derive(Clone, Debug, Default)]
pub(crate) struct MeasurementRows {
    pub count: usize,
    pub(crate) parameters: usize,
    pub(crate) nuisance: usize,
    pub(crate) channels: usize,
    wrenches: usize,
    pub(crate) a: Vec<f64>,
    pub(crate) r: Vec<f64>,
    pub(crate) g: Vec<f64>,
    pub(crate) n: Vec<f64>,
    /// Per row, the number of its unit: a sub-tree, or [`Observation::TORQUES`].
    pub(crate) units: Vec<usize>,
    /// Lower factor of `N V N^T`, row by row, once whitened.
    pub(crate) factor: Vec<f64>,
}

impl MeasurementRows {
    /// None yet, with room for as many as there are channels: few observations have more.
    pub(crate) fn new(unknowns: &Unknowns) -> Self {
        let (parameters, nuisance) = (unknowns.parameters(), unknowns.nuisance());
        let channels = unknowns.channels();
        Self {
            parameters,
            nuisance,
            channels,
            wrenches: unknowns.wrenches(),
            a: Vec::with_capacity(parameters * channels),
            r: Vec::with_capacity(channels),
            g: Vec::with_capacity(nuisance * channels),
            n: Vec::with_capacity(channels * channels),
            units: Vec::with_capacity(channels),
            ..Self::default()
        }
    }

    /// Appends a row of zeros to a unit.
    pub(crate) fn push(&mut self, unit: usize) -> (&mut [f64], &mut f64, &mut [f64], &mut [f64]) {
        self.count += 1;
        self.units.push(unit);
        self.a.resize(self.parameters * self.count, 0.0);
        self.r.push(0.0);
        self.g.resize(self.nuisance * self.count, 0.0);
        self.n.resize(self.channels * self.count, 0.0);
        let last = self.count - 1;
        (
            &mut self.a[self.parameters * last..],
            &mut self.r[last],
            &mut self.g[self.nuisance * last..],
            &mut self.n[self.channels * last..],
        )
    }

    /// The rows of one unit, before whitening.
    pub(crate) fn of_unit(&self, unit: usize) -> Self {
        let mut own = Self {
            parameters: self.parameters,
            nuisance: self.nuisance,
            channels: self.channels,
            wrenches: self.wrenches,
            ..Self::default()
        };
        for row in (0..self.count).filter(|&row| self.units[row] == unit) {
            let (a, r, g, n) = own.push(unit);
            a.copy_from_slice(self.a(row));
            *r = self.r(row);
            g.copy_from_slice(self.g(row));
            n.copy_from_slice(self.n(row));
        }
        own
    }

    pub(crate) fn a(&self, row: usize) -> &[f64] {
        &self.a[self.parameters * row..][..self.parameters]
    }

    pub(crate) fn r(&self, row: usize) -> f64 {
        self.r[row]
    }

    /// What these parameters leave of a row: `r - A d`.
    pub(crate) fn without_bodies(&self, row: usize, d: &[f64]) -> f64 {
        self.r(row) - dot(self.a(row), d)
    }

    /// What these parameters and nuisance parameters leave of a row: `r - A d - G s`.
    pub(crate) fn residual(&self, row: usize, d: &[f64], s: &[f64]) -> f64 {
        self.without_bodies(row, d) - dot(self.g(row), s)
    }

    pub(crate) fn g(&self, row: usize) -> &[f64] {
        &self.g[self.nuisance * row..][..self.nuisance]
    }

    pub(crate) fn n(&self, row: usize) -> &[f64] {
        &self.n[self.channels * row..][..self.channels]
    }

    /// Makes the noise of the rows independent and of unit variance, given the variances of the
    /// channels: `A`, `r`, `G` become `L^-1 A` ..., with `L L^T = N diag(v) N^T`. Combinations that
    /// no channel's noise reaches get a floor of 1e-9 of the greatest variance, since they would
    /// count as exact otherwise. `N` is unchanged.
    pub(crate) fn whiten(&mut self, variances: &[f64]) {
        self.whiten_with(variances, &mut [], 0);
    }

    /// Whitens extra columns as well: `width` numbers for each row.
    pub(crate) fn whiten_with(&mut self, variances: &[f64], extra: &mut [f64], width: usize) {
        let m = self.count;
        self.factor.clear();
        self.factor.resize(m * m, 0.0);
        for i in 0..m {
            for j in 0..=i {
                let pairs = self.n(i).iter().zip(self.n(j)).zip(variances);
                let sum: f64 = pairs.map(|((x, y), v)| x * y * v).sum();
                self.factor[i * m + j] = sum;
            }
        }
        factorise(&mut self.factor, m);
        for (values, count) in [
            (&mut self.a, self.parameters),
            (&mut self.r, 1),
            (&mut self.g, self.nuisance),
        ] {
            forward(&self.factor, m, values, count);
        }
        if width > 0 {
            forward(&self.factor, m, extra, width);
        }
    }

    /// The most likely noise of each channel, given whitened residuals of all rows: `diag(v) N^T
    /// W^-1 rho` (Gauss, Markov); zero for channels in no row.
    pub(crate) fn channel_noise(&self, variances: &[f64], mut whitened: Vec<f64>) -> Vec<f64> {
        let m = self.count;
        for i in (0..m).rev() {
            let below = (i + 1..m).map(|k| self.factor[k * m + i] * whitened[k]);
            whitened[i] = (whitened[i] - below.sum::<f64>()) / self.factor[i * m + i];
        }
        let mut out = vec![0.0; self.channels];
        for (row, weight) in whitened.iter().enumerate() {
            for (sum, entry) in out.iter_mut().zip(self.n(row)) {
                *sum += weight * entry;
            }
        }
        for (value, variance) in out.iter_mut().zip(variances) {
            *value *= variance;
        }
        out
    }

    /// Adds `diag(v) N^T W^-1 N` to `sum` (channels by channels, row by row): how
    /// [`MeasurementRows::channel_noise`] shares the noise of the rows among the channels. The
    /// diagonal is the share of a channel's variance that its most likely noise has, `(v -
    /// posterior variance) / v`: one if the rows separate the channel from all others, less if it
    /// appears only mixed with others.
    pub(crate) fn add_shares(&self, variances: &[f64], sum: &mut [f64]) {
        let (m, channels) = (self.count, self.channels);
        let mut white = self.n.clone();
        forward(&self.factor, m, &mut white, channels);
        for row in white.chunks_exact(channels.max(1)) {
            for ((own, variance), sums) in row
                .iter()
                .zip(variances)
                .zip(sum.chunks_exact_mut(channels))
            {
                if *own != 0.0 {
                    let weight = own * variance;
                    add_multiple(sums, weight, row);
                }
            }
        }
    }

    /// The joint of a torque row; None for other rows.
    pub(crate) fn joint(&self, row: usize) -> Option<usize> {
        let torques = &self.n(row)[self.wrenches..];
        torques.iter().position(|entry| *entry != 0.0)
    }

    /// Whether any row has this channel's noise.
    pub(crate) fn has(&self, channel: usize) -> bool {
        (0..self.count).any(|row| self.n(row)[channel] != 0.0)
    }
}
