//! The evidence of hypotheses about one sub-tree, and what its parameters are if they hold.
//!
//! ```text
//! y = A x + v,   x ~ N(0, 1),   v ~ N(0, noise V)
//! log p(y) = -1/2 (log det(1 + S / noise) + n log noise + (y'y - b'(noise + S)^-1 b) / noise)
//! S = A'A,   b = A'y,   n rows
//! ```
//!
//! with rows whitened by V, which is as stated, and columns by a root of their prior. S, b and y'y
//! are the Gram matrix of `[A | y]`, in which ticks add up. The noise is the most likely one, but
//! not below the stated one.

use crate::prior::link_cad_root;
use crate::readings::{Hypothesis, MotionReading, WrenchReading};
use crate::robot::Robot;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, SMatrix, Vector6};
use proprio_dynamics::calibration::UNKNOWN_OFFSET;
use proprio_dynamics::regressor::{LINK_PARAMETERS, SubTreeRegressor};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{Kinematics, Structure};

/// Standard deviation of each component of a steady force \[N\].
pub(super) const FORCE: f64 = 25.0;
/// Ticks in which a misfit lasts: the 3 s of a movement, for it depends on the posture. In them it
/// counts as one.
pub(super) const LASTING: f64 = 30.0;
/// An unknown of how the motion is read, as in [`MotionReading::at`], whose effect is linear.
pub(super) const SMALL: f64 = 1e-3;

/// The unknowns of a sub-tree, `[d | s]`: ten per link, six per sensor.
#[derive(Clone, Debug)]
pub(super) struct SubtreeUnknowns {
    pub(super) links: Vec<usize>,
    pub(super) sensors: Vec<usize>,
    /// Per link `U` of the prior's covariance `U'U`.
    pub(super) roots: Vec<SMatrix<f64, LINK_PARAMETERS, LINK_PARAMETERS>>,
    /// CAD and configured offsets.
    pub(super) reference: Vec<f64>,
}

impl SubtreeUnknowns {
    pub(super) fn new(robot: &Robot, subtree: &SubTreeRegressor, offsets: &[Wrench]) -> Self {
        let (links, sensors): (_, Vec<usize>) =
            (subtree.links().to_vec(), subtree.sensors().collect());
        let cad = robot.model.inertias();
        let parameters = links.iter().flat_map(|&link| cad[link].parameters());
        let offsets = sensors.iter().flat_map(|&own| offsets[own].torque_first());
        let root = |&link: &usize| link_cad_root(&cad[link], robot.urdf_relative_std);
        Self {
            reference: parameters.chain(offsets).collect(),
            roots: links.iter().map(root).collect(),
            links,
            sensors,
        }
    }

    pub(super) fn count(&self) -> usize {
        self.reference.len()
    }

    /// What the reference leaves of each row.
    pub(super) fn rest(&self, rows: &SubTreeRegressor) -> Vec<f64> {
        let measured = rows.projected_measured().iter().enumerate();
        measured
            .map(|(i, y)| y - dot(rows.projected_row(i), &self.reference))
            .collect()
    }

    /// The smallest wrench on the sub-tree that is what the reference leaves of its rows. Unlike
    /// the rows, it does not depend on how the contacts were eliminated.
    pub(super) fn wrench_left(&self, rows: &SubTreeRegressor) -> Option<Vector6<f64>> {
        let projections = projections(rows);
        let square = &projections * projections.transpose();
        let weights = Cholesky::new(square)?.solve(&DVector::from_vec(self.rest(rows)));
        let wrench = projections.tr_mul(&weights);
        Some(Vector6::from_column_slice(wrench.as_slice()))
    }

    fn first_offset(&self) -> usize {
        LINK_PARAMETERS * self.links.len()
    }

    /// A row over the unknowns as one over unknowns of unit variance: `a P^(1/2)`.
    fn scale(&self, row: &[f64], to: &mut [f64]) {
        let (of_links, offsets) = row.split_at(self.first_offset());
        let (to_links, to_offsets) = to.split_at_mut(self.first_offset());
        let links = of_links.chunks_exact(LINK_PARAMETERS).zip(&self.roots);
        for ((row, root), to) in links.zip(to_links.chunks_exact_mut(LINK_PARAMETERS)) {
            for (i, to) in to.iter_mut().enumerate() {
                *to = root.row(i).iter().zip(row).map(|(u, a)| u * a).sum();
            }
        }
        let deviations = UNKNOWN_OFFSET.iter().cycle();
        for ((to, value), deviation) in to_offsets.iter_mut().zip(offsets).zip(deviations) {
            *to = value * deviation;
        }
    }

    /// The unknowns of these unknowns of unit variance, `P^(1/2) w` beyond the reference.
    fn unscale(&self, scaled: &[f64]) -> Vec<f64> {
        let (of_links, offsets) = scaled.split_at(self.first_offset());
        let links = of_links.chunks_exact(LINK_PARAMETERS).zip(&self.roots);
        let links = links.flat_map(|(w, root)| {
            let sum = move |i| {
                root.column(i)
                    .iter()
                    .zip(w)
                    .map(|(u, w)| u * w)
                    .sum::<f64>()
            };
            (0..LINK_PARAMETERS).map(sum)
        });
        let offsets = offsets.iter().zip(UNKNOWN_OFFSET.iter().cycle());
        let changes = links.chain(offsets.map(|(w, deviation)| w * deviation));
        let pairs = changes.zip(&self.reference);
        pairs
            .map(|(change, reference)| change + reference)
            .collect()
    }
}

/// A hypothesis in its [`SharedDesign`].
#[derive(Clone, Debug)]
pub(super) struct Branch {
    pub(super) wrench_reading: WrenchReading,
    /// What multiplies the columns of the links, and of each sensor.
    of_links: f64,
    of_sensors: Vec<f64>,
    pub(super) log_prior: f64,
    /// The most likely variance of the noise, in units of V.
    pub(super) noise: f64,
    pub(super) log_evidence: f64,
    /// Against the likeliest hypothesis.
    pub(super) log_odds: f64,
    pub(super) is_refuted: bool,
}

impl Branch {
    pub(super) fn new(wrench_reading: WrenchReading, prior: f64, sensors: &[usize]) -> Self {
        // Noise and offsets stay those of readings in the sensor's own unit. So of the first
        // sensor, it is everything else that is taken in that unit.
        let (of_links, of_sensors) = match wrench_reading {
            WrenchReading::Unit(number, factor) => {
                let is_first = sensors.first() == Some(&number);
                let other = if is_first { 1.0 / factor } else { 1.0 };
                let own = if is_first { 1.0 } else { factor };
                let factor = |sensor: &usize| if *sensor == number { own } else { other };
                (other, sensors.iter().map(factor).collect())
            }
            _ => (1.0, vec![1.0; sensors.len()]),
        };
        Self {
            wrench_reading,
            of_links,
            of_sensors,
            log_prior: prior.ln(),
            noise: 1.0,
            log_evidence: 0.0,
            log_odds: prior.ln(),
            is_refuted: false,
        }
    }

    /// The right side of a row, of which the reference leaves `rest` with the readings as stated.
    fn right(&self, columns: &SubtreeUnknowns, now: &TickRows<'_>, row: usize, rest: f64) -> f64 {
        let (of_links, offsets) = (now.rows.projected_row(row)).split_at(now.rows.offset_column());
        let changes = (columns.sensors.iter().enumerate()).map(|(place, &sensor)| {
            let reading = now.readings[sensor];
            let change = match self.wrench_reading {
                WrenchReading::Unit(..) => {
                    let configured = &columns.reference[columns.first_offset()..];
                    let six = |axis| configured[6 * place + axis];
                    let offset = Wrench::from_torque_first(std::array::from_fn(six));
                    (reading - offset) * (self.of_sensors[place] - 1.0)
                }
                wrench_reading => wrench_reading.reading(sensor, now.readings) - reading,
            };
            dot(&offsets[6 * place..6 * place + 6], &change.torque_first())
        });
        let bodies = (1.0 - self.of_links) * dot(of_links, &columns.reference);
        rest + changes.sum::<f64>() + bodies
    }

    /// What multiplies the columns: `[d | s]`, and those of a contact.
    fn factors(&self, links: usize, unknowns: usize) -> Vec<f64> {
        let of_links = std::iter::repeat_n(self.of_links, LINK_PARAMETERS * links);
        let of_sensors = self.of_sensors.iter().flat_map(|factor| [*factor; 6]);
        let mut all: Vec<f64> = of_links.chain(of_sensors).collect();
        all.resize(unknowns, 1.0);
        all
    }
}

/// The rows of a sub-tree at one time.
pub(super) struct TickRows<'a> {
    pub(super) rows: &'a SubTreeRegressor,
    pub(super) structure: &'a Structure,
    pub(super) kinematics: &'a Kinematics,
    pub(super) readings: &'a [Wrench],
    /// The wrench that CAD and configured offsets leave if one unknown of the motion is [`SMALL`],
    /// each in turn.
    pub(super) shifted: &'a [Vector6<f64>],
    /// The stated variances of each sensor's channels, [torque; force].
    pub(super) variances: &'a [[f64; 6]],
}

/// Hypotheses with the same A: they differ in how F/T readings are taken.
#[derive(Clone, Debug)]
pub(super) struct SharedDesign {
    pub(super) motion_reading: MotionReading,
    pub(super) contact: Option<usize>,
    unknowns: usize,
    pub(super) branches: Vec<Branch>,
    /// Of `[A | y of each branch]`; empty before the first tick.
    gram: DMatrix<f64>,
    rows: f64,
    ticks: usize,
    /// The log-evidence of unknowns that were forgotten.
    forgotten: f64,
}

impl SharedDesign {
    pub(super) fn new(
        motion_reading: MotionReading,
        contact: Option<usize>,
        columns: &SubtreeUnknowns,
        branches: Vec<Branch>,
    ) -> Self {
        Self {
            motion_reading,
            contact,
            unknowns: columns.count()
                + motion_reading.unknowns()
                + if contact.is_some() { 3 } else { 0 },
            branches,
            gram: DMatrix::zeros(0, 0),
            rows: 0.0,
            ticks: 0,
            forgotten: 0.0,
        }
    }

    /// Number of ticks that were added.
    pub(super) fn ticks(&self) -> usize {
        self.ticks
    }

    pub(super) fn hypothesis(&self, branch: &Branch) -> Hypothesis {
        Hypothesis {
            motion_reading: self.motion_reading,
            wrench_reading: branch.wrench_reading,
            contact: self.contact,
        }
    }

    /// What is stated, from the same readings; with this contact from now on.
    pub(super) fn continued(&self, columns: &SubtreeUnknowns, contact: Option<usize>) -> Self {
        let branches = self.branches[..1].to_vec();
        let mut with = Self::new(self.motion_reading, contact, columns, branches);
        if !self.gram.is_empty() {
            let own = (0..self.unknowns).map(Some);
            let own = own.chain((self.unknowns..with.unknowns).map(|_| None));
            let from: Vec<Option<usize>> = own.chain([Some(self.unknowns)]).collect();
            with.gram = DMatrix::from_fn(from.len(), from.len(), |i, j| match (from[i], from[j]) {
                (Some(i), Some(j)) => self.gram[(i, j)],
                _ => 0.0,
            });
        }
        (with.rows, with.ticks, with.forgotten) = (self.rows, self.ticks, self.forgotten);
        with
    }

    /// Adds the rows of a sub-tree at one time.
    pub(super) fn add(&mut self, columns: &SubtreeUnknowns, now: &TickRows<'_>) {
        let rows = now.rows;
        let (count, width) = (rows.remaining(), self.unknowns + self.branches.len());
        let mut all = DMatrix::zeros(count, width);
        let mut covariance = DMatrix::zeros(count, count);
        let mut scaled = vec![0.0; columns.count()];
        let rest = columns.rest(rows);
        let sensors = columns.sensors.iter();
        let variances: Vec<f64> = sensors.flat_map(|&own| now.variances[own]).collect();
        for i in 0..count {
            let offsets = &rows.projected_row(i)[rows.offset_column()..];
            columns.scale(rows.projected_row(i), &mut scaled);
            for (column, value) in scaled.iter().enumerate() {
                all[(i, column)] = *value;
            }
            for (number, branch) in self.branches.iter().enumerate() {
                all[(i, self.unknowns + number)] = branch.right(columns, now, i, rest[i]);
            }
            for j in 0..=i {
                let others = &rows.projected_row(j)[rows.offset_column()..];
                let terms = offsets.iter().zip(others).zip(&variances);
                let sum: f64 = terms.map(|((a, b), variance)| a * b * variance).sum();
                (covariance[(i, j)], covariance[(j, i)]) = (sum, sum);
            }
        }
        if let Some(contact) = self.contact {
            let Some(wrenches) = unit_forces(contact, now) else {
                return;
            };
            for (axis, wrench) in wrenches.iter().enumerate() {
                for i in 0..count {
                    all[(i, columns.count() + axis)] = -FORCE * dot(rows.projection(i), wrench);
                }
            }
        }
        for (place, wrench) in now.shifted.iter().enumerate() {
            let shifted = projections(rows) * wrench;
            for (i, (shifted, own)) in shifted.iter().zip(&rest).enumerate() {
                all[(i, columns.count() + place)] = (own - shifted) / SMALL;
            }
        }
        let Some(factor) = Cholesky::new(covariance) else {
            return;
        };
        factor.l_dirty().solve_lower_triangular_mut(&mut all);
        if count > 0 && all.iter().all(|x| x.is_finite()) {
            if self.gram.is_empty() {
                self.gram = DMatrix::zeros(width, width);
            }
            self.gram.gemm_tr(1.0, &all, &all, 1.0);
            self.rows += count as f64;
            self.ticks += 1;
            let takes_less =
                |branch: &Branch| !branch.is_refuted && branch.of_sensors.iter().any(|s| *s < 1.0);
            if self.branches.iter().any(takes_less) {
                let parts = noise_parts(columns, now, &factor);
                for (number, branch) in self.branches.iter().enumerate() {
                    let terms = branch.of_sensors.iter().zip(&parts);
                    let less: f64 = terms.map(|(s, part)| (1.0 - s * s).max(0.0) * part).sum();
                    self.gram[(self.unknowns + number, self.unknowns + number)] += less;
                }
            }
        }
    }

    /// Forgets these unknowns: they have other values from now on.
    pub(super) fn forget(&mut self, columns: &[usize]) {
        if self.gram.is_empty() || columns.is_empty() {
            return;
        }
        let open = self.branches.iter().filter(|branch| !branch.is_refuted);
        let likeliest = open.max_by(|a, b| a.log_odds.total_cmp(&b.log_odds));
        let noise = likeliest.map_or(1.0, |branch| branch.noise);
        let own = DMatrix::from_fn(columns.len(), columns.len(), |i, j| {
            self.gram[(columns[i], columns[j])] + if i == j { noise } else { 0.0 }
        });
        let Some(factor) = Cholesky::new(own) else {
            return;
        };
        let mut across = DMatrix::from_fn(columns.len(), self.gram.ncols(), |i, j| {
            self.gram[(columns[i], j)]
        });
        factor.l_dirty().solve_lower_triangular_mut(&mut across);
        self.gram.gemm_tr(-1.0, &across, &across, 1.0);
        for &column in columns {
            self.gram.row_mut(column).fill(0.0);
            self.gram.column_mut(column).fill(0.0);
        }
        self.forgotten -= 0.5 * log_det(&factor, noise);
    }

    /// Finds each branch's most likely noise, and its evidence.
    pub(super) fn weigh(&mut self, columns: &SubtreeUnknowns) {
        if self.gram.is_empty() {
            return;
        }
        for number in 0..self.branches.len() {
            if self.branches[number].is_refuted {
                continue;
            }
            // Two iterations: the noise converges while ticks come in.
            for _ in 0..2 {
                let Some((factor, mut right)) = self.system(columns, number) else {
                    break;
                };
                factor.l_dirty().solve_lower_triangular_mut(&mut right);
                let column = self.unknowns + number;
                let square = self.gram[(column, column)] - right.norm_squared();
                let branch = &mut self.branches[number];
                let log_determinant = log_det(&factor, branch.noise);
                branch.noise = (square / self.rows).max(1.0);
                branch.log_evidence = self.forgotten
                    - 0.5
                        * (log_determinant + self.rows * branch.noise.ln() + square / branch.noise);
            }
        }
    }

    /// What is estimated beside `[d | s]`, along the axis where it is largest: a share of
    /// [`FORCE`], or what [`MotionReading::at`] takes.
    ///
    /// Of a force it is the root mean square. How uncertain the motion is counts in the deviation
    /// of torques instead: the turn of a standing base about gravity is never known, and matters to
    /// none.
    pub(super) fn extent(&self, columns: &SubtreeUnknowns) -> f64 {
        let Some((factor, right)) = self.system(columns, 0) else {
            return f64::INFINITY;
        };
        let mean = factor.solve(&right);
        let deviation = |axis: usize| {
            let mut unit = DVector::zeros(self.unknowns);
            unit[axis] = 1.0;
            let _ = factor.l_dirty().solve_lower_triangular_mut(&mut unit);
            unit.norm() * self.branches[0].noise.sqrt()
        };
        let axes = (columns.count()..self.unknowns).map(|axis| match self.contact {
            Some(_) => mean[axis].hypot(deviation(axis)),
            None => mean[axis].abs(),
        });
        axes.fold(0.0, f64::max)
    }

    /// What the parameters are if a branch holds.
    pub(super) fn posterior(
        &self,
        columns: &SubtreeUnknowns,
        number: usize,
    ) -> Option<HypothesisPosterior> {
        let (factor, right) = self.system(columns, number)?;
        let branch = &self.branches[number];
        let solution = factor.solve(&right);
        let (own, extra) = solution.as_slice().split_at(columns.count());
        let mut mean = columns.unscale(own);
        let mut hypothesis = self.hypothesis(branch);
        hypothesis.motion_reading = self.motion_reading.at(extra);
        // The offset is in the sensor's own unit.
        let offset_factor = |&sensor: &usize| match branch.wrench_reading {
            WrenchReading::Unit(number, factor) if number == sensor => factor,
            _ => 1.0,
        };
        let offset_factors: Vec<f64> = columns.sensors.iter().map(offset_factor).collect();
        scale_offsets(&mut mean[columns.first_offset()..], &offset_factors);
        Some(HypothesisPosterior {
            hypothesis,
            mean,
            of_motion_reading: extra[..self.motion_reading.unknowns()].to_vec(),
            offset_factors,
            factor,
            noise: branch.noise,
        })
    }

    /// The factor of `noise + S` and b of a branch.
    fn system(&self, columns: &SubtreeUnknowns, number: usize) -> Option<System> {
        let (unknowns, branch) = (self.unknowns, &self.branches[number]);
        if self.gram.is_empty() {
            let root = DMatrix::from_diagonal_element(unknowns, unknowns, branch.noise.sqrt());
            return Some((Cholesky::pack_dirty(root), DVector::zeros(unknowns)));
        }
        let factors = branch.factors(columns.links.len(), unknowns);
        let precision = DMatrix::from_fn(unknowns, unknowns, |i, j| {
            self.gram[(i, j)] * factors[i] * factors[j] + if i == j { branch.noise } else { 0.0 }
        });
        let right = DVector::from_fn(unknowns, |i, _| {
            self.gram[(i, unknowns + number)] * factors[i]
        });
        Some((Cholesky::new(precision)?, right))
    }
}

type System = (Cholesky<f64, Dyn>, DVector<f64>);

/// The parameters of a sub-tree if a hypothesis holds.
#[derive(Clone, Debug)]
pub(super) struct HypothesisPosterior {
    pub(super) hypothesis: Hypothesis,
    /// `[d | s]`, in SI units.
    pub(super) mean: Vec<f64>,
    /// What [`MotionReading::at`] takes.
    pub(super) of_motion_reading: Vec<f64>,
    offset_factors: Vec<f64>,
    factor: Cholesky<f64, Dyn>,
    noise: f64,
}

impl HypothesisPosterior {
    /// The standard deviation of a number with these sensitivities to `[d | s]`, and to what
    /// [`MotionReading::at`] takes.
    pub(super) fn deviation(
        &self,
        columns: &SubtreeUnknowns,
        sensitivity: &[f64],
        of_motion_reading: &[f64],
    ) -> f64 {
        let mut scaled = DVector::zeros(self.factor.l_dirty().nrows());
        columns.scale(sensitivity, &mut scaled.as_mut_slice()[..columns.count()]);
        let offsets = columns.first_offset()..columns.count();
        scale_offsets(&mut scaled.as_mut_slice()[offsets], &self.offset_factors);
        scaled.as_mut_slice()[columns.count()..][..of_motion_reading.len()]
            .copy_from_slice(of_motion_reading);
        let factor = self.factor.l_dirty();
        let _ = factor.solve_lower_triangular_mut(&mut scaled);
        scaled.norm() * self.noise.sqrt()
    }
}

/// Multiplies the offsets of each sensor.
fn scale_offsets(offsets: &mut [f64], factors: &[f64]) {
    for (six, factor) in offsets.chunks_exact_mut(6).zip(factors) {
        six.iter_mut().for_each(|value| *value *= factor);
    }
}

/// Per sensor, the expected square of its noise in the whitened rows: together, their number. To
/// read a sensor in a larger unit takes its noise for less, and must not look like a better fit.
fn noise_parts(
    columns: &SubtreeUnknowns,
    now: &TickRows<'_>,
    factor: &Cholesky<f64, Dyn>,
) -> Vec<f64> {
    let first = now.rows.offset_column();
    let part = |(place, &sensor): (usize, &usize)| {
        let variances = &now.variances[sensor];
        let mut own = DMatrix::from_fn(now.rows.remaining(), 6, |row, channel| {
            let value = now.rows.projected_row(row)[first + 6 * place + channel];
            value * variances[channel].sqrt()
        });
        let _ = factor.l_dirty().solve_lower_triangular_mut(&mut own);
        own.norm_squared()
    };
    columns.sensors.iter().enumerate().map(part).collect()
}

/// The combinations of the six equations that give the rows.
fn projections(rows: &SubTreeRegressor) -> DMatrix<f64> {
    DMatrix::from_fn(rows.remaining(), 6, |row, i| rows.projection(row)[i])
}

/// The wrenches of forces of 1 N at a contact along the axes of the base, at and in the axes of the
/// sub-tree's top link.
fn unit_forces(contact: usize, now: &TickRows<'_>) -> Option<[[f64; 6]; 3]> {
    let spec = now.structure.contacts().get(contact)?;
    let frame = *now.kinematics.pose(spec.frame.link) * spec.frame.pose;
    let point = frame.point(&spec.position);
    let to_top = now.kinematics.pose(now.rows.top()).inverse();
    Some([0, 1, 2].map(|axis| {
        let force = Vec3::ith(axis, 1.0);
        let torque = point.cross(&force);
        to_top.wrench(&Wrench { torque, force }).torque_first()
    }))
}

/// `log det(1 + S / noise)`, from the factor of `noise + S`.
fn log_det(factor: &Cholesky<f64, Dyn>, noise: f64) -> f64 {
    let own = factor.l_dirty();
    (0..own.nrows())
        .map(|i| 2.0 * own[(i, i)].ln() - noise.ln())
        .sum()
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    const UNKNOWNS: usize = LINK_PARAMETERS + 6;

    fn columns() -> SubtreeUnknowns {
        SubtreeUnknowns {
            links: vec![1],
            sensors: vec![0],
            roots: vec![SMatrix::identity()],
            reference: vec![0.0; UNKNOWNS],
        }
    }

    /// Random rows, and right sides with noise of this deviation.
    fn rows(seed: u64, count: usize, deviation: f64) -> (DMatrix<f64>, DVector<f64>) {
        let a = DMatrix::from_vec(count, UNKNOWNS, normals(seed, count * UNKNOWNS));
        let x = DVector::from_vec(normals(seed + 1, UNKNOWNS));
        let v = DVector::from_vec(normals(seed + 2, count));
        let y = &a * x + v * deviation;
        (a, y)
    }

    fn fit(wrench_reading: WrenchReading) -> SharedDesign {
        let branches = vec![Branch::new(wrench_reading, 1.0, &[0])];
        SharedDesign::new(MotionReading::AsStated, None, &columns(), branches)
    }

    fn add(fit: &mut SharedDesign, a: &DMatrix<f64>, y: &DVector<f64>) {
        let all = DMatrix::from_fn(y.len(), UNKNOWNS + 1, |i, j| {
            if j < UNKNOWNS { a[(i, j)] } else { y[i] }
        });
        if fit.gram.is_empty() {
            fit.gram = DMatrix::zeros(UNKNOWNS + 1, UNKNOWNS + 1);
        }
        fit.gram += all.tr_mul(&all);
        fit.rows += y.len() as f64;
    }

    /// Until the noise has converged.
    fn weighed(fit: &mut SharedDesign) -> (f64, f64) {
        (0..100).for_each(|_| fit.weigh(&columns()));
        (fit.branches[0].log_evidence, fit.branches[0].noise)
    }

    /// `log p(y)` but for a constant, by its definition.
    fn log_density(a: &DMatrix<f64>, y: &DVector<f64>, noise: f64) -> f64 {
        let covariance = a * a.transpose() + DMatrix::identity(y.len(), y.len()) * noise;
        let factor = Cholesky::new(covariance).unwrap();
        let log_det: f64 = factor.l().diagonal().iter().map(|d| 2.0 * d.ln()).sum();
        -0.5 * (log_det + y.dot(&factor.solve(y)))
    }

    #[test]
    fn the_evidence_is_the_density_of_the_readings_with_their_likeliest_noise() {
        for (deviation, least) in [(3.0, 4.0), (0.1, 1.0)] {
            let (a, y) = rows(7, 60, deviation);
            let mut fit = fit(WrenchReading::AsStated);
            add(&mut fit, &a, &y);
            let (evidence, noise) = weighed(&mut fit);
            assert!(
                (evidence - log_density(&a, &y, noise)).abs() < 1e-6,
                "{evidence}"
            );
            assert!(noise >= least && noise < 3.0 * least, "{noise}");
            // The stated noise is the least one.
            if noise > 1.0 {
                for other in [0.8 * noise, 1.2 * noise] {
                    let of_other = log_density(&a, &y, other);
                    assert!(of_other < evidence + 0.5, "{other}: {of_other}, {evidence}");
                }
            }
        }
    }

    #[test]
    fn what_is_forgotten_may_have_another_value_afterwards() {
        let ((a, y), (b, z)) = (rows(11, 40, 0.3), rows(21, 40, 0.3));
        let offsets: Vec<usize> = (LINK_PARAMETERS..UNKNOWNS).collect();
        let mut fit = fit(WrenchReading::AsStated);
        add(&mut fit, &a, &y);
        fit.forget(&offsets);
        add(&mut fit, &b, &z);
        // The offsets of the later rows have columns of their own.
        let all = DMatrix::from_fn(80, UNKNOWNS + 6, |i, j| match (i < 40, j) {
            (true, 0..UNKNOWNS) => a[(i, j)],
            (false, 0..LINK_PARAMETERS) => b[(i - 40, j)],
            (false, UNKNOWNS..) => b[(i - 40, j - 6)],
            _ => 0.0,
        });
        let right = DVector::from_iterator(80, y.iter().chain(z.iter()).copied());
        let (evidence, noise) = weighed(&mut fit);
        // Both halves have their own bodies in this data, so the noise is not the stated one.
        let expected = log_density(&all, &right, noise);
        let of_forgotten = log_density(&all, &right, 1.0);
        assert!(noise > 1.0 && of_forgotten < expected, "{noise}");
        assert!((evidence - expected).abs() < 0.1 * (expected - of_forgotten).abs());
    }

    /// What begins now has said nothing yet, and explains only what comes.
    #[test]
    fn a_contact_continued_explains_later_rows_alone() {
        let ((a, y), (b, z)) = (rows(61, 40, 0.3), rows(71, 40, 0.3));
        let mut before = SharedDesign::new(
            MotionReading::AsStated,
            None,
            &columns(),
            [WrenchReading::AsStated, WrenchReading::Unit(0, 4.0)]
                .map(|wrench_reading| Branch::new(wrench_reading, 1.0, &[0]))
                .to_vec(),
        );
        let all = DMatrix::from_fn(40, UNKNOWNS + 2, |i, j| {
            if j < UNKNOWNS { a[(i, j)] } else { y[i] }
        });
        before.gram = all.tr_mul(&all);
        before.rows = 40.0;
        let mut with = before.continued(&columns(), Some(0));
        let without = weighed(&mut before);
        let own = weighed(&mut with);
        assert!((own.0 - without.0).abs() < 1e-9 && (own.1 - without.1).abs() < 1e-9);
        assert!((with.extent(&columns()) - 1.0).abs() < 1e-9);
        // Later rows have columns of the force.
        let force = DMatrix::from_vec(40, 3, normals(81, 120));
        let later = DMatrix::from_fn(40, UNKNOWNS + 4, |i, j| match j {
            0..UNKNOWNS => b[(i, j)],
            UNKNOWNS..19 => force[(i, j - UNKNOWNS)],
            _ => z[i],
        });
        with.gram += later.tr_mul(&later);
        with.rows += 40.0;
        let every = DMatrix::from_fn(80, UNKNOWNS + 3, |i, j| match (i < 40, j < UNKNOWNS) {
            (true, true) => a[(i, j)],
            (true, false) => 0.0,
            (false, _) => later[(i - 40, j)],
        });
        let right = DVector::from_iterator(80, y.iter().chain(z.iter()).copied());
        let (evidence, noise) = weighed(&mut with);
        assert!((evidence - log_density(&every, &right, noise)).abs() < 1e-6);
    }

    #[test]
    fn readings_in_another_unit_are_those_of_bodies_in_that_unit() {
        let (mut a, y) = rows(31, 60, 0.3);
        let mut fit = fit(WrenchReading::Unit(0, 4.0));
        add(&mut fit, &a, &y);
        let (evidence, noise) = weighed(&mut fit);
        a.columns_mut(0, LINK_PARAMETERS).scale_mut(0.25);
        assert!(
            (evidence - log_density(&a, &y, noise)).abs() < 1e-6,
            "{evidence}"
        );
    }

    #[test]
    fn the_deviation_of_a_number_is_that_of_its_posterior() {
        let (a, y) = rows(41, 60, 0.3);
        let mut fit = fit(WrenchReading::AsStated);
        let columns = columns();
        let sensitivity = normals(51, UNKNOWNS);
        let mut expected = DVector::from_column_slice(&sensitivity);
        for (number, deviation) in UNKNOWN_OFFSET.iter().enumerate() {
            expected[LINK_PARAMETERS + number] *= deviation;
        }
        let before = fit
            .posterior(&columns, 0)
            .unwrap()
            .deviation(&columns, &sensitivity, &[]);
        assert!((before - expected.norm()).abs() < 1e-9, "{before}");
        add(&mut fit, &a, &y);
        let (_, noise) = weighed(&mut fit);
        let covariance = (a.tr_mul(&a) / noise + DMatrix::identity(UNKNOWNS, UNKNOWNS))
            .try_inverse()
            .unwrap();
        let after = fit.posterior(&columns, 0).unwrap();
        let deviation = expected.dot(&(&covariance * &expected)).sqrt();
        assert!((after.deviation(&columns, &sensitivity, &[]) - deviation).abs() < 1e-9);
        let mean = covariance * a.tr_mul(&y) / noise;
        for (number, value) in after.mean.iter().enumerate() {
            let scale = number
                .checked_sub(LINK_PARAMETERS)
                .map_or(1.0, |i| UNKNOWN_OFFSET[i]);
            assert!((value - scale * mean[number]).abs() < 1e-9, "{number}");
        }
    }
}
