//! Data beside a prior: the graded coordinates, Newton's method on the cost in them, and what it ends with. The page is that of [`super`].

use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, DVector, Dyn, Matrix4, Vector4};
use pulp::{Arch, Simd, WithSimd};

use super::{
    Centre, Expected, GREATEST_TAU, Matrix10, Prior, PriorError, Vector10, blocked, body_of, check_finite, congruence,
    divergence, pack, stationary_tau, unpack,
};
use crate::identify::lanes;
use crate::spatial::RigidInertia;

/// No body that is handed out is thinner in any direction than this, by CAD's measure and squared; the pseudo-inertia stays positive definite when rounded.
const LEAST_EIGENVALUE: f64 = 1e-9;

/// Where a body's least or greatest eigenvalue, relative to the coordinates' own body, leaves `1 / STRETCH .. STRETCH` the coordinates are made anew.
const STRETCH: f64 = 1e3;

/// Newton steps of one fit, at most.
const NEWTON_STEPS: usize = 300;

/// A step that would take a body this part of the way out of what can exist, or farther, asks for a larger weight to begin with.
const OUTSIDE: f64 = 0.9;

/// Squared Newton decrement, by the weight, at which one weight on the central path has done its work for the next.
pub(in crate::identify) const CENTRED: f64 = 0.1;

/// Data beside the prior of the links that they tell of: from here a fit for any weight.
#[derive(Clone, Debug)]
pub struct Posterior {
    links: Vec<usize>,
    centres: Vec<Centre>,
    expected: Expected,
    /// By `u` about CAD: as many rows as the data's rank.
    data: DMatrix<f64>,
    right: DVector<f64>,
    /// What the right sides have beyond that.
    residual_square: f64,
    /// Of the further unknowns: unit, the prior's standard deviation or what gives the data's column unit norm; and whether there is a prior.
    further: Vec<(f64, bool)>,
    /// The coordinates about CAD, where every fit begins.
    chart: Chart,
}

impl Posterior {
    /// From the data's information `[R | z]`, any number of whitened rows, usually the upper triangle of all. Columns: ten per link of `links`, in that order,
    /// `d = phi - phi_CAD` with CAD as given; then one for each further unknown, whose prior is zero with this `precision`, the inverse of its variance; 0: none.
    ///
    /// # Errors
    /// Sizes do not match, a link is not there, or a number is not finite.
    pub fn new(
        prior: &Prior,
        links: &[usize],
        data: &DMatrix<f64>,
        right: &DVector<f64>,
        precision: &[f64],
    ) -> Result<Self, PriorError> {
        let expected = 10 * links.len() + precision.len();
        if data.ncols() != expected {
            return Err(PriorError::Size {
                what: "columns",
                found: data.ncols(),
                expected,
            });
        }
        if right.len() != data.nrows() {
            return Err(PriorError::Size {
                what: "right sides",
                found: right.len(),
                expected: data.nrows(),
            });
        }
        for (position, &link) in links.iter().enumerate() {
            if link >= prior.link_count() {
                return Err(PriorError::NoLink {
                    link,
                    count: prior.link_count(),
                });
            }
            if links[..position].contains(&link) {
                return Err(PriorError::Twice(link));
            }
        }
        check_finite("an entry of the data", data.as_slice())?;
        check_finite("a right side of the data", right.as_slice())?;
        if let Some(&value) = precision.iter().find(|&&p| !(p.is_finite() && p >= 0.0)) {
            return Err(PriorError::Number {
                what: "a precision",
                value,
            });
        }
        let centres: Vec<_> = links.iter().map(|&link| prior.centres[link].clone()).collect();
        let mut local = data.clone();
        let mut shift = DVector::zeros(expected);
        for (position, centre) in centres.iter().enumerate() {
            let columns = data.fixed_columns::<10>(10 * position).into_owned() * centre.parameters;
            local.fixed_columns_mut::<10>(10 * position).copy_from(&columns);
            let floored = Vector10::from(centre.reference.parameters()) - centre.cad;
            shift.fixed_rows_mut::<10>(10 * position).copy_from(&floored);
        }
        let mut further = Vec::with_capacity(precision.len());
        for (index, &precision) in precision.iter().enumerate() {
            let mut column = local.column_mut(10 * links.len() + index);
            let norm = column.norm();
            let unit = match (precision > 0.0, norm > 0.0) {
                (true, _) => 1.0 / precision.sqrt(),
                (false, true) => 1.0 / norm,
                (false, false) => 1.0,
            };
            column *= unit;
            further.push((unit, precision > 0.0));
        }
        // Directions below rounding of the largest count as unseen.
        let least = f64::EPSILON * expected as f64;
        let stretch = vec![Matrix4::identity(); links.len()];
        let mut chart = Chart::new(
            local,
            right - data * shift,
            stretch,
            DVector::zeros(further.len()),
            least,
        );
        let rank = chart.scale.iter().filter(|&&scale| scale > 0.0).count();
        let scaled = DMatrix::from_fn(rank, expected, |row, column| chart.scale[row] * chart.t[(row, column)]);
        Ok(Self {
            links: links.to_vec(),
            data: scaled,
            right: chart.right.rows(0, rank).into_owned(),
            residual_square: std::mem::take(&mut chart.residual_square),
            centres,
            expected: prior.expected,
            further,
            chart,
        })
    }

    /// The links, in the order of the columns.
    pub fn links(&self) -> &[usize] {
        &self.links
    }

    /// How many combinations of the unknowns the data determine, to rounding.
    pub fn rank(&self) -> usize {
        self.data.nrows()
    }

    /// The square sum of what no choice of the unknowns fits, were there neither prior nor consistency.
    pub fn residual_square(&self) -> f64 {
        self.residual_square
    }

    /// The most probable bodies and further unknowns for this weight.
    ///
    /// # Errors
    /// `tau` is not positive, or a further unknown without prior is not determined.
    pub fn fit(&self, tau: f64) -> Result<Fit, PriorError> {
        if !(tau.is_finite() && tau > 0.0) {
            return Err(PriorError::Number {
                what: "the weight tau",
                value: tau,
            });
        }
        let mut state = self.start();
        let weight = 0.5 / (tau * tau);
        let end = self.descend(&mut state, weight, 1e-13 * weight)?;
        Ok(self.finish(state, end, tau))
    }

    /// The same from near where the minimum is to be expected, unknowns as in [`Fit::x`], and as near as the square of the Newton decrement says: by half as much the
    /// cost may be above its least, which is one half at a standard deviation. From CAD where these are no bodies, or a step from them leaves the bodies.
    pub(in crate::identify) fn fit_from(&self, x: &[f64], tau: f64, decrement: f64) -> Result<Fit, PriorError> {
        if !(tau.is_finite() && tau > 0.0) {
            return self.fit(tau);
        }
        let mut state = self.start();
        if let Some(u) = self.place(x) {
            state.y = &self.chart.t * u;
            state.centred = None;
        }
        let weight = 0.5 / (tau * tau);
        let end = self.descend(&mut state, weight, decrement.max(1e-13 * weight))?;
        Ok(self.finish(state, end, tau))
    }

    /// Coordinates about CAD of these unknowns; none if they are no bodies.
    fn place(&self, x: &[f64]) -> Option<DVector<f64>> {
        if x.len() != self.data.ncols() {
            return None;
        }
        let mut u = DVector::from_column_slice(x);
        for (link, centre) in self.centres.iter().enumerate() {
            let of_cad = centre.cad - Vector10::from(centre.reference.parameters());
            let own = centre.whiten * (of_cad + u.fixed_rows::<10>(10 * link));
            (Matrix4::identity() + unpack(&own)).cholesky()?;
            u.fixed_rows_mut::<10>(10 * link).copy_from(&own);
        }
        for (value, &(unit, _)) in u.iter_mut().skip(10 * self.centres.len()).zip(&self.further) {
            *value /= unit;
        }
        Some(u)
    }

    /// The same for the weight that the data choose: [`Fit::next_tau`] until it stays, from [`GREATEST_TAU`] on.
    ///
    /// # Errors
    /// As for [`Posterior::fit`].
    pub fn weigh(&self) -> Result<Fit, PriorError> {
        let mut fit = self.fit(GREATEST_TAU)?;
        for _ in 0..100 {
            let tau = fit.next_tau();
            let is_settled = (tau / fit.tau).ln().abs() < 1e-3;
            let iterations = fit.iterations;
            fit = self.fit(tau)?;
            fit.iterations += iterations;
            if is_settled {
                break;
            }
        }
        Ok(fit)
    }

    /// `1 + U` of every link where nothing keeps the bodies from being impossible: the minimum with the quadratic form of `D` for weight `tau = 1`.
    pub(in crate::identify) fn unbounded(&self) -> Result<Vec<Matrix4<f64>>, PriorError> {
        let chart = &self.chart;
        let mut hessian = &chart.v_transposed * &chart.v * 0.5;
        for (index, scale) in chart.scale.iter().enumerate() {
            hessian[(index, index)] += scale * scale;
        }
        let factor = Cholesky::new(hessian).ok_or(PriorError::Undetermined)?;
        let u = chart.coordinates(&factor.solve(&chart.scale.component_mul(&chart.right)));
        Ok((0..self.centres.len())
            .map(|link| Matrix4::identity() + block(&u, link))
            .collect())
    }

    /// Axes of a direction `v` of a link's coordinates: along `v`, the function `a . r + b` of the point `r` [m] in link axes whose square the body's mass integrates
    /// to `v^T (1 + U) v`. Returns `[a; b]`.
    pub(in crate::identify) fn plane(&self, position: usize, direction: &Vector4<f64>) -> Vector4<f64> {
        let inverse = self.centres[position].root.try_inverse().unwrap_or_default();
        inverse.transpose() * direction
    }

    pub(in crate::identify) fn start(&self) -> State {
        State {
            chart: self.chart.clone(),
            y: DVector::zeros(self.chart.scale.len()),
            centred: Some(f64::INFINITY),
        }
    }

    /// The minimum of `1/2 |R x - z|^2 + weight sum D + ...`, until the squared Newton decrement is below the tolerance.
    ///
    /// Where a Newton step would leave the bodies, it begins with a weight at which it does not, and lowers it by tenths (the central path: a descent that ran straight
    /// into the boundary would creep along it). From a guess there is no such path (where a body is more than twice CAD's, a Newton step to CAD overshoots at any
    /// weight), so a guess from which the step leaves the bodies is given up for CAD.
    pub(in crate::identify) fn descend(
        &self,
        state: &mut State,
        weight: f64,
        tolerance: f64,
    ) -> Result<Descent, PriorError> {
        let (mut current, mut iterations) = (weight, 0);
        let mut newton = self.newton(state, current)?;
        if newton.least < -OUTSIDE && state.centred.is_none() {
            *state = self.start();
            newton = self.newton(state, current)?;
        }
        let greatest = 0.1 * state.centred.unwrap_or(0.0);
        while newton.least < -OUTSIDE && current < greatest {
            current = (100.0 * current).min(greatest);
            newton = self.newton(state, current)?;
        }
        loop {
            let is_last = current <= weight;
            let goal = if is_last { tolerance } else { CENTRED * current };
            let is_converged = loop {
                if newton.decrement <= goal + newton.rounding {
                    break true;
                }
                if iterations >= NEWTON_STEPS {
                    break false;
                }
                let Some(t) = newton.length(current) else {
                    break newton.decrement <= 1e-6 * current;
                };
                state.y += &newton.step * t;
                iterations += 1;
                newton = self.newton(state, current)?;
            };
            state.centred = Some(current);
            if is_last || iterations >= NEWTON_STEPS {
                return Ok(Descent {
                    decrement: newton.decrement,
                    factor: newton.factor,
                    prior_rows: newton.prior_rows,
                    iterations,
                    is_converged: is_converged && is_last,
                });
            }
            current = (0.1 * current).max(weight);
            newton = self.newton(state, current)?;
        }
    }

    /// A Newton step from where the state is; the state's coordinates are made anew first if they are strained.
    fn newton(&self, state: &mut State, weight: f64) -> Result<Newton, PriorError> {
        let (links, count) = (self.centres.len(), self.data.ncols());
        let mut u = state.chart.coordinates(&state.y);
        if state.chart.is_strained(&u) {
            self.move_chart(state, &u);
            u = DVector::zeros(count);
        }
        let chart = &state.chart;
        let residual = chart.scale.component_mul(&state.y) - &chart.right;
        let mut slope = DVector::zeros(count);
        let mut prior_rows = chart.v.clone();
        let (mut roots, mut maps) = (Vec::with_capacity(links), Vec::with_capacity(links));
        for link in 0..links {
            // A step stops at nine tenths of the way out of the cone of bodies, and charts move in time: there is a root.
            let body = (Matrix4::identity() + block(&u, link)).cholesky();
            let root = body.and_then(|body| body.l().try_inverse()).unwrap_or_default();
            slope
                .fixed_rows_mut::<10>(10 * link)
                .copy_from(&(pack(&(chart.gram[link] - root.transpose() * root)) * weight));
            maps.push(congruence(&root) * weight.sqrt());
            roots.push(root);
        }
        // Column by column: rows of a link lie far apart.
        for mut column in prior_rows.column_iter_mut() {
            for (link, map) in maps.iter().enumerate() {
                let mapped = map * column.fixed_rows::<10>(10 * link).into_owned();
                column.fixed_rows_mut::<10>(10 * link).copy_from(&mapped);
            }
        }
        for (index, &(_, has_prior)) in self.further.iter().enumerate() {
            let row = 10 * links + index;
            if has_prior {
                slope[row] = u[row] + chart.further[index];
            } else {
                prior_rows.row_mut(row).fill(0.0);
            }
        }
        let mut hessian = blocked::gram(&prior_rows);
        for index in 0..count {
            hessian[(index, index)] += chart.scale[index] * chart.scale[index];
        }
        let factor = blocked::cholesky(hessian).ok_or(PriorError::Undetermined)?;
        let gradient = chart.scale.component_mul(&residual) + &chart.v_transposed * &slope;
        let step = -factor.solve(&gradient);
        let change = &chart.v * &step;
        let data_change = chart.scale.component_mul(&step);
        let mut linear = residual.dot(&data_change);
        let mut square = data_change.norm_squared();
        let mut values = Vec::with_capacity(4 * links);
        for (link, root) in roots.iter().enumerate() {
            let change = block(&change, link);
            linear += weight * chart.gram[link].component_mul(&change).sum();
            let relative = root * change * root.transpose();
            values.extend(relative.symmetric_eigenvalues().iter().copied());
        }
        for (index, &(_, has_prior)) in self.further.iter().enumerate() {
            let row = 10 * links + index;
            if has_prior {
                linear += slope[row] * change[row];
                square += change[row] * change[row];
            }
        }
        Ok(Newton {
            decrement: -step.dot(&gradient),
            // The gradient is known to the rounding of what it is the difference of.
            rounding: (8.0 * f64::EPSILON).powi(2) * chart.right.norm_squared(),
            least: values.iter().copied().fold(0.0, f64::min),
            step,
            linear,
            square,
            values,
            factor,
            prior_rows,
        })
    }

    /// Coordinates about where the state is.
    fn move_chart(&self, state: &mut State, u: &DVector<f64>) {
        let chart = &state.chart;
        let links = self.centres.len();
        let mut local = self.data.clone();
        let mut origin = DVector::zeros(u.len());
        let mut stretch = Vec::with_capacity(links);
        for link in 0..links {
            let factor = (Matrix4::identity() + block(u, link)).cholesky();
            let l = chart.stretch[link] * factor.map_or(Matrix4::identity(), |factor| factor.l());
            let columns = local.fixed_columns::<10>(10 * link).into_owned() * congruence(&l);
            local.fixed_columns_mut::<10>(10 * link).copy_from(&columns);
            let place = pack(&(l * l.transpose() - Matrix4::identity()));
            origin.fixed_rows_mut::<10>(10 * link).copy_from(&place);
            stretch.push(l);
        }
        let further = chart.further(u);
        origin.rows_mut(10 * links, further.len()).copy_from(&further);
        let right = &self.right - &self.data * origin;
        state.chart = Chart::new(local, right, stretch, further, 0.0);
        state.y.fill(0.0);
    }

    pub(in crate::identify) fn finish(&self, state: State, descent: Descent, tau: f64) -> Fit {
        let State { chart, y, .. } = state;
        let u = chart.coordinates(&y);
        let links = self.centres.len();
        let mut x = DVector::zeros(u.len());
        let mut bodies = Vec::with_capacity(links);
        let mut divergences = Vec::with_capacity(links);
        let mut inverses = Vec::with_capacity(links);
        for (link, centre) in self.centres.iter().enumerate() {
            let l = &chart.stretch[link];
            // From the factors, which resolve bodies much thinner than what U can tell from none.
            let local = (Matrix4::identity() + block(&u, link)).cholesky();
            let root = local
                .and_then(|local| (l * local.l()).try_inverse())
                .unwrap_or_default();
            inverses.push(root.transpose() * root);
            // U relative to CAD, not 1 + U: a small one keeps its digits.
            let mut relative = l * block(&u, link) * l.transpose() + (l * l.transpose() - Matrix4::identity());
            let least = relative.symmetric_eigenvalues().min() + 1.0;
            if least < LEAST_EIGENVALUE {
                relative += Matrix4::identity() * (2.0 * LEAST_EIGENVALUE - least);
            }
            divergences.push(divergence(&relative));
            let difference = body_of(&(centre.root * relative * centre.root.transpose()));
            let body = centre.reference + difference;
            x.fixed_rows_mut::<10>(10 * link)
                .copy_from(&(Vector10::from(body.parameters()) - centre.cad));
            bodies.push(body);
        }
        for (index, (value, &(unit, _))) in chart.further(&u).iter().zip(&self.further).enumerate() {
            x[10 * links + index] = value * unit;
        }
        // gamma = 10 L - tr(H^-1 K), K the links' part of the prior's. With H = S^2 + K + K_f, S the data's diagonal, K_f the further unknowns': of that trace what S and K_f leave.
        let inverse = blocked::inverse(descent.factor.l_dirty());
        let of_data = inverse.column_iter().zip(chart.scale.iter());
        let of_data: f64 = of_data
            .map(|(column, scale)| scale * scale * column.norm_squared())
            .sum();
        let further = descent.prior_rows.rows(10 * links, self.further.len()).transpose();
        let of_further = self.further.len() as f64 - (&inverse * further).norm_squared();
        let effective = (of_data - of_further).max(0.0);
        let residual_square = self.residual_square + chart.excess(&y);
        let mut maps = Vec::with_capacity(links);
        for (centre, l) in self.centres.iter().zip(&chart.stretch) {
            let back = l.try_inverse().unwrap_or_default();
            maps.push((centre.parameters * congruence(l), congruence(&back) * centre.whiten));
        }
        Fit {
            x,
            bodies,
            tau,
            divergence: divergences.iter().sum(),
            divergences,
            effective,
            residual_square,
            iterations: descent.iterations,
            is_converged: descent.is_converged,
            decrement: descent.decrement,
            inverses,
            maps,
            expected: self.expected,
            units: self.further.iter().map(|&(unit, _)| unit).collect(),
            chart,
            factor: descent.factor,
            inverse,
        }
    }
}

/// Where a descent stands.
pub(in crate::identify) struct State {
    chart: Chart,
    y: DVector<f64>,
    /// The last weight that this was the minimum for, about; CAD is for an infinite one, a guess for none.
    centred: Option<f64>,
}

impl State {
    /// The square sum that the data leave above their least.
    pub(in crate::identify) fn excess(&self) -> f64 {
        self.chart.excess(&self.y)
    }
}

/// A step of Newton's method, and how the cost changes along it.
struct Newton {
    step: DVector<f64>,
    /// Square of the step's length in the Hessian's norm: twice what a quadratic cost would fall.
    decrement: f64,
    /// What of it may be rounding.
    rounding: f64,
    /// Of the links' change relative to their bodies: the eigenvalues, and the least. At -1 a body ceases to be one.
    values: Vec<f64>,
    least: f64,
    /// Coefficients of the cost's change.
    linear: f64,
    square: f64,
    /// Of the Hessian by `y`.
    factor: Cholesky<f64, Dyn>,
    /// Square root of the prior's part of it, a row for each of `u`.
    prior_rows: DMatrix<f64>,
}

impl Newton {
    /// How much of the step to take: none if the cost does not fall any more, to rounding.
    fn length(&self, weight: f64) -> Option<f64> {
        // The cost's change itself, not the difference of two costs: exact however large these are.
        let change = |t: f64| {
            let logs: f64 = self.values.iter().map(|value| (t * value).ln_1p()).sum();
            t * self.linear + 0.5 * t * t * self.square - weight * logs
        };
        let most = if self.least < 0.0 { -0.9 / self.least } else { 1.0 };
        let lengths = std::iter::successors(Some(most.min(1.0)), |t| Some(0.5 * t));
        lengths.take(40).find(|&t| change(t) <= -1e-4 * t * self.decrement)
    }
}

/// How a descent ended.
pub(in crate::identify) struct Descent {
    decrement: f64,
    factor: Cholesky<f64, Dyn>,
    prior_rows: DMatrix<f64>,
    pub(in crate::identify) iterations: usize,
    pub(in crate::identify) is_converged: bool,
}

/// Coordinates `u` about some bodies and `y = T u`, in which the data are diagonal.
#[derive(Clone, Debug)]
struct Chart {
    /// The bodies, relative to CAD: `1 + U = L L^T`; these are the `L`.
    stretch: Vec<Matrix4<f64>>,
    /// `L^T L`, the gradient of the trace of `L (1 + u) L^T`.
    gram: Vec<Matrix4<f64>>,
    /// The further unknowns where `u` is zero, in their units.
    further: DVector<f64>,
    /// Diagonal of the data by `y`.
    scale: DVector<f64>,
    /// Right side to it.
    right: DVector<f64>,
    /// What the right side has beyond it.
    residual_square: f64,
    /// `u -> y`.
    t: DMatrix<f64>,
    /// `y -> u`, and transposed.
    v: DMatrix<f64>,
    v_transposed: DMatrix<f64>,
}

impl Chart {
    /// From data by `u`; what is at most `least` times the largest of their diagonal counts as zero.
    fn new(
        data: DMatrix<f64>,
        right: DVector<f64>,
        stretch: Vec<Matrix4<f64>>,
        further: DVector<f64>,
        least: f64,
    ) -> Self {
        let count = data.ncols();
        let graded = Graded::new(data, right, least);
        let inverse = graded.inverse();
        let mut v = DMatrix::zeros(count, count);
        let mut t = DMatrix::zeros(count, count);
        for (row, &column) in graded.order.iter().enumerate() {
            for other in 0..count {
                v[(column, other)] = inverse[(row, other)];
                t[(other, column)] = graded.t[(other, row)];
            }
        }
        Self {
            gram: stretch.iter().map(|l| l.transpose() * l).collect(),
            v_transposed: v.transpose(),
            residual_square: graded.residual_square,
            scale: graded.scale,
            right: graded.right,
            stretch,
            further,
            t,
            v,
        }
    }

    /// By how much `|R x - z|^2` is above its least.
    fn excess(&self, y: &DVector<f64>) -> f64 {
        (self.scale.component_mul(y) - &self.right).norm_squared() + self.residual_square
    }

    fn coordinates(&self, y: &DVector<f64>) -> DVector<f64> {
        &self.v * y
    }

    /// The further unknowns, in their units.
    fn further(&self, u: &DVector<f64>) -> DVector<f64> {
        &self.further + u.rows(10 * self.stretch.len(), self.further.len())
    }

    /// Whether a body is too far, by its own measure, from that of the coordinates.
    fn is_strained(&self, u: &DVector<f64>) -> bool {
        (0..self.stretch.len()).any(|link| {
            let values = (Matrix4::identity() + block(u, link)).symmetric_eigenvalues();
            values.min() < 1.0 / STRETCH || values.max() > STRETCH
        })
    }
}

/// `U` of a link.
fn block(u: &DVector<f64>, link: usize) -> Matrix4<f64> {
    unpack(&u.fixed_rows::<10>(10 * link).into_owned())
}

/// A column-pivoted QR factorization of data, `R = Q diag(scale) T` with the columns of `T` in the order of the pivots.
struct Graded {
    order: Vec<usize>,
    scale: DVector<f64>,
    right: DVector<f64>,
    t: DMatrix<f64>,
    residual_square: f64,
}

impl Graded {
    /// By Householder reflections, until what is left is at most `least` times what was first.
    fn new(mut data: DMatrix<f64>, mut right: DVector<f64>, least: f64) -> Self {
        let (rows, count) = data.shape();
        let mut order: Vec<usize> = (0..count).collect();
        let mut scale = DVector::zeros(count);
        let mut rank = 0;
        let mut reflector = vec![0.0; rows];
        // Of what is left of each column.
        let mut squares: Vec<f64> = data.column_iter().map(|column| column.norm_squared()).collect();
        for step in 0..rows.min(count) {
            let (pivot, square) = (step..count).fold((step, -1.0), |best, column| {
                let square = squares[column];
                if square > best.1 { (column, square) } else { best }
            });
            let length = square.sqrt();
            if length <= least * scale[0] {
                break;
            }
            rank = step + 1;
            data.swap_columns(step, pivot);
            order.swap(step, pivot);
            squares.swap(step, pivot);
            let (head, tail) = data.as_mut_slice().split_at_mut((step + 1) * rows);
            let column = &mut head[step * rows + step..];
            let sign = if column[0] < 0.0 { -1.0 } else { 1.0 };
            let reflector = &mut reflector[step..];
            reflector.copy_from_slice(column);
            reflector[0] += sign * length;
            Arch::new().dispatch(Reflect {
                reflector,
                per_half: 1.0 / (length * (length + sign * column[0])),
                columns: tail,
                rows,
                squares: &mut squares[step + 1..],
                right: &mut right.as_mut_slice()[step..],
            });
            column[0] = -sign * length;
            column[1..].fill(0.0);
            scale[step] = length;
        }
        let mut t = DMatrix::identity(count, count);
        let mut graded = DVector::zeros(count);
        for row in 0..rank {
            let diagonal = data[(row, row)];
            for column in row..count {
                t[(row, column)] = data[(row, column)] / diagonal;
            }
            graded[row] = right[row] * diagonal.signum();
        }
        Self {
            order,
            residual_square: right.rows_range(rank..).norm_squared(),
            right: graded,
            scale,
            t,
        }
    }

    /// `T^-1`, upper triangular.
    fn inverse(&self) -> DMatrix<f64> {
        blocked::inverse(&self.t.transpose()).transpose()
    }
}

/// Reflects the rows from that of the pivot on of the columns after it, and of the right side; and leaves the square norms of what is below that row.
struct Reflect<'a> {
    reflector: &'a [f64],
    /// Two over the reflector's square norm.
    per_half: f64,
    columns: &'a mut [f64],
    rows: usize,
    squares: &'a mut [f64],
    right: &'a mut [f64],
}

impl WithSimd for Reflect<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Some((first, below)) = self.reflector.split_first() else {
            return;
        };
        let step = self.rows - self.reflector.len();
        for (column, square) in self.columns.chunks_exact_mut(self.rows).zip(self.squares) {
            if let Some((own_first, own)) = column[step..].split_first_mut() {
                let factor = -self.per_half * (first * *own_first + lanes::inner(simd, below, own));
                *own_first += factor * first;
                *square = lanes::add_and_square(simd, own, factor, below);
            }
        }
        let factor = -self.per_half * lanes::inner(simd, self.reflector, self.right);
        lanes::add(simd, self.right, factor, self.reflector);
    }
}

/// The most probable bodies under data and prior, and how sure that is.
///
/// Unknowns are in the order of the columns of [`Posterior::new`]. The posterior is Gaussian to second order about this maximum (Laplace), with the curvature
/// that the prior has there.
#[derive(Clone, Debug)]
pub struct Fit {
    /// `[d | s]`: parameters less CAD as given [kg, kg m, kg m^2], ten per link; the further unknowns.
    pub x: DVector<f64>,
    /// The links' bodies, `phi_CAD + d`: always such as can exist.
    pub bodies: Vec<RigidInertia>,
    /// The weight that this is for.
    pub tau: f64,
    /// The divergence from CAD, all links.
    pub divergence: f64,
    /// The same for each link.
    pub divergences: Vec<f64>,
    /// `gamma`: how many of the links' parameters the data determine, rather than the prior.
    pub effective: f64,
    /// `|R x - z|^2`.
    pub residual_square: f64,
    /// Newton steps taken.
    pub iterations: usize,
    /// Whether these were enough.
    pub is_converged: bool,
    /// Square of the Newton decrement that was left.
    pub(in crate::identify) decrement: f64,
    /// `(1 + U)^-1`, relative to CAD: the multipliers of consistency, over the prior's weight.
    pub(in crate::identify) inverses: Vec<Matrix4<f64>>,
    /// `u -> phi` and back, for each link.
    maps: Vec<(Matrix10, Matrix10)>,
    /// What is known of `tau` before any data.
    expected: Expected,
    /// Units of the further unknowns.
    units: Vec<f64>,
    chart: Chart,
    /// Of the Hessian by the chart's `y`: `L`, and its inverse.
    factor: Cholesky<f64, Dyn>,
    inverse: DMatrix<f64>,
}

impl Fit {
    /// One round of the evidence: the weight that makes this divergence, of this many parameters, the expected one (above, under "The weight"). At most [`GREATEST_TAU`].
    pub fn next_tau(&self) -> f64 {
        stationary_tau(self.divergence, self.effective, self.expected)
    }

    /// A square root of the posterior covariance of `x`: `F` with `F F^T` the covariance. The variance of `a^T x` is `|F^T a|^2`.
    pub fn covariance_root(&self) -> DMatrix<f64> {
        // F = (u -> d) V A^-1/2: the factor's inverse, transposed, from the right.
        let mut root = &self.chart.v * self.inverse.transpose();
        for mut column in root.column_iter_mut() {
            for (link, (map, _)) in self.maps.iter().enumerate() {
                let mapped = map * column.fixed_rows::<10>(10 * link).into_owned();
                column.fixed_rows_mut::<10>(10 * link).copy_from(&mapped);
            }
        }
        for (index, unit) in self.units.iter().enumerate() {
            let mut row = root.row_mut(10 * self.maps.len() + index);
            row *= *unit;
        }
        root
    }

    /// The posterior covariance of `x`.
    pub fn covariance(&self) -> DMatrix<f64> {
        let root = self.covariance_root();
        &root * root.transpose()
    }

    /// The upper triangular square root of the posterior's precision: `P` with `P^T P` the inverse of the covariance, and a positive diagonal.
    pub fn precision_root(&self) -> DMatrix<f64> {
        let mut root = self.factor.l().transpose() * &self.chart.t;
        for (link, (_, inverse)) in self.maps.iter().enumerate() {
            let columns = root.fixed_columns::<10>(10 * link).into_owned() * inverse;
            root.fixed_columns_mut::<10>(10 * link).copy_from(&columns);
        }
        for (index, unit) in self.units.iter().enumerate() {
            let mut column = root.column_mut(10 * self.maps.len() + index);
            column /= *unit;
        }
        let mut triangle = root.qr().r();
        for row in 0..triangle.nrows() {
            if triangle[(row, row)] < 0.0 {
                triangle.row_mut(row).neg_mut();
            }
        }
        triangle
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identify::normals;

    /// From anywhere, bodies or not, the same minimum, as near as was asked for; from near it, in fewer steps.
    #[test]
    fn a_fit_from_elsewhere_is_the_fit() {
        let body = |mass: f64| {
            let [m, c, i] = [mass, 0.05 * mass, 0.01 * mass];
            RigidInertia::from_parameters(&[m, c, 0.3 * c, -c, i, 0.1 * i, 0.0, 1.2 * i, 0.0, 0.9 * i])
        };
        let cad = [body(1.0), body(2.5), body(0.4)];
        let prior = Prior::new(&cad).unwrap();
        let columns = 10 * cad.len() + 2;
        let rows = 24;
        let data = DMatrix::from_vec(rows, columns, normals(4, rows * columns)) * 30.0;
        let right = DVector::from_vec(normals(5, rows)) * 10.0;
        let posterior = Posterior::new(&prior, &[0, 1, 2], &data, &right, &[1.0, 0.0]).unwrap();
        let fit = posterior.fit(0.4).unwrap();
        let precision = fit.precision_root();
        let mut impossible = fit.x.clone();
        impossible[10] = -100.0;
        // Where a body is more than twice CAD's a Newton step overshoots, whatever the prior's weight.
        let mut heavy = fit.x.clone();
        for (link, (cad, own)) in cad.iter().zip(&fit.bodies).enumerate() {
            let more = Vector10::from(own.parameters()) * 20.0 - Vector10::from(cad.parameters());
            heavy.fixed_rows_mut::<10>(10 * link).copy_from(&more);
        }
        let other = posterior.fit(0.3).unwrap();
        let steps = fit.iterations;
        for (x, most) in [(&fit.x, 1), (&other.x, steps), (&impossible, steps), (&heavy, steps)] {
            let found = posterior.fit_from(x.as_slice(), 0.4, 1e-8).unwrap();
            // In standard deviations.
            let off = (&precision * (&found.x - &fit.x)).norm();
            assert!(off < 2e-4, "{off}");
            assert!(found.is_converged && found.decrement <= 1e-8 && found.iterations <= most);
            assert!((found.effective - fit.effective).abs() < 1e-3 * fit.effective);
        }
        assert!(posterior.fit_from(&[0.0; 3], 0.4, 1e-8).is_ok());
        assert!(posterior.fit_from(fit.x.as_slice(), -1.0, 1e-8).is_err());
    }
}
