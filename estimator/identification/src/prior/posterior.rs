//! The posterior of data and prior: graded coordinates, Newton's method on the cost in them, and
//! its result. The equations are in [`super`].

mod newton;

use crate::prior::posterior::newton::{Chart, Descent, Iterate, Newton, block};
use nalgebra::{DMatrix, DVector, Matrix4};

use crate::linear::blocked;
use crate::prior::{
    Centre, Expected, GREATEST_TAU, Matrix10, Prior, PriorError, Vector10, body_of, check_finite,
    congruence, divergence, pack, stationary_tau, unpack,
};
use proprio_dynamics::spatial::RigidInertia;

/// The least squared extent of a returned body in any direction, relative to CAD: the
/// pseudo-inertia stays positive definite after rounding.
const LEAST_EIGENVALUE: f64 = 1e-9;

/// Greatest number of Newton steps of one fit.
const NEWTON_STEPS: usize = 300;

/// A Newton step that covers more than this fraction of the way to the boundary of the feasible set
/// starts the central path.
const OUTSIDE: f64 = 0.9;

/// Squared Newton decrement, relative to the weight, at which one weight on the central path is
/// accurate enough for the next.
const CENTRED: f64 = 0.1;

/// Data and the prior of their links, for fits with any weight.
#[derive(Clone, Debug)]
pub struct Posterior {
    centres: Vec<Centre>,
    expected: Expected,
    /// By `u` about CAD: the number of rows is the data's rank.
    data: DMatrix<f64>,
    right: DVector<f64>,
    /// Square sum of the right sides beyond the rank.
    residual_square: f64,
    /// For each extra parameter: its unit (the prior's standard deviation, or else the one that
    /// gives the data's column unit norm), and whether it has a prior.
    extra: Vec<(f64, bool)>,
    /// The coordinates about CAD, where every fit begins.
    chart: Chart,
}

impl Posterior {
    /// From the data's information `[R | z]`: any number of whitened rows, usually the upper
    /// triangle. Columns: ten per link of `links`, in that order, `d = phi - phi_CAD` with CAD as
    /// given; then one per extra parameter, whose prior is zero with this `precision`, the inverse
    /// of its variance (0: no prior).
    ///
    /// # Errors
    /// Sizes do not match, a link does not exist, or a number is not finite.
    pub fn new(
        prior: &Prior,
        links: &[usize],
        data: &DMatrix<f64>,
        right: &DVector<f64>,
        precision: &[f64],
    ) -> Result<Self, PriorError> {
        check_data(prior, links, data, right, precision)?;
        let count = data.ncols();
        let centre = |&link: &usize| prior.centres[link].clone();
        let centres: Vec<Centre> = links.iter().map(centre).collect();
        let mut local = data.clone();
        let mut shift = DVector::zeros(count);
        for (position, centre) in centres.iter().enumerate() {
            let columns = data.fixed_columns::<10>(10 * position).into_owned() * centre.parameters;
            local
                .fixed_columns_mut::<10>(10 * position)
                .copy_from(&columns);
            let floored = Vector10::from(centre.reference.parameters()) - centre.cad;
            shift
                .fixed_rows_mut::<10>(10 * position)
                .copy_from(&floored);
        }
        let mut extra = Vec::with_capacity(precision.len());
        for (index, &precision) in precision.iter().enumerate() {
            let mut column = local.column_mut(10 * links.len() + index);
            let norm = column.norm();
            let unit = match (precision > 0.0, norm > 0.0) {
                (true, _) => 1.0 / precision.sqrt(),
                (false, true) => 1.0 / norm,
                (false, false) => 1.0,
            };
            column *= unit;
            extra.push((unit, precision > 0.0));
        }
        // Directions below rounding of the largest count as not determined.
        let least = f64::EPSILON * count as f64;
        let stretch = vec![Matrix4::identity(); links.len()];
        let (right, zero) = (right - data * shift, DVector::zeros(extra.len()));
        let mut chart = Chart::new(local, right, stretch, zero, least);
        let rank = chart.scale.iter().filter(|&&scale| scale > 0.0).count();
        let scaled = DMatrix::from_fn(rank, count, |row, column| {
            chart.scale[row] * chart.t[(row, column)]
        });
        Ok(Self {
            data: scaled,
            right: chart.right.rows(0, rank).into_owned(),
            residual_square: std::mem::take(&mut chart.residual_square),
            centres,
            expected: prior.expected,
            extra,
            chart,
        })
    }

    /// The most probable bodies and extra parameters for this weight.
    ///
    /// # Errors
    /// `tau` is not positive, or an extra parameter without prior is not determined.
    pub fn fit(&self, tau: f64) -> Result<MapEstimate, PriorError> {
        if !(tau.is_finite() && tau > 0.0) {
            return Err(PriorError::Number {
                what: "the scale tau",
                value: tau,
            });
        }
        let mut state = self.start();
        let weight = 0.5 / (tau * tau);
        let end = self.descend(&mut state, weight, 1e-13 * weight)?;
        Ok(self.finish(state, end, tau))
    }

    /// As [`Posterior::fit`], starting from a guess in the form of [`MapEstimate::x`], down to this
    /// squared Newton decrement. The cost may exceed its minimum by half of the decrement; at one
    /// standard deviation it exceeds it by one half. Starts from CAD if the guess is not physical,
    /// or a step from it leaves the feasible set.
    pub(crate) fn fit_from(
        &self,
        x: &[f64],
        tau: f64,
        decrement: f64,
    ) -> Result<MapEstimate, PriorError> {
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

    /// Coordinates of these unknowns about CAD; None if they are not physical.
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
        for (value, &(unit, _)) in u.iter_mut().skip(10 * self.centres.len()).zip(&self.extra) {
            *value /= unit;
        }
        Some(u)
    }

    /// The fit for the weight that the data choose: iterates [`MapEstimate::next_tau`] from
    /// [`GREATEST_TAU`] to convergence.
    ///
    /// # Errors
    /// As for [`Posterior::fit`].
    pub fn maximise_evidence(&self) -> Result<MapEstimate, PriorError> {
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

    pub(crate) fn start(&self) -> Iterate {
        Iterate {
            chart: self.chart.clone(),
            y: DVector::zeros(self.chart.scale.len()),
            centred: Some(f64::INFINITY),
        }
    }

    /// Finds the minimum of `1/2 |R x - z|^2 + weight sum D + ...`, down to this squared Newton
    /// decrement.
    ///
    /// If a Newton step would leave the feasible set, the descent begins with a weight at which it
    /// does not, and lowers it by factors of ten (the central path; a direct descent would creep
    /// along the boundary). From a guess there is no such path: where a body is more than twice
    /// CAD's, a Newton step to CAD overshoots at any weight. So such a guess is replaced by CAD.
    pub(crate) fn descend(
        &self,
        state: &mut Iterate,
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
            let goal = if is_last {
                tolerance
            } else {
                CENTRED * current
            };
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
                    next: newton,
                    iterations,
                    is_converged: is_converged && is_last,
                });
            }
            current = (0.1 * current).max(weight);
            newton = self.newton(state, current)?;
        }
    }

    /// A Newton step from the state. The state's chart is rebuilt first if it is strained.
    fn newton(&self, state: &mut Iterate, weight: f64) -> Result<Newton, PriorError> {
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
            // A step covers at most nine tenths of the way to the boundary, and charts are rebuilt
            // in time, so that the root exists.
            let body = (Matrix4::identity() + block(&u, link)).cholesky();
            let root = body
                .and_then(|body| body.l().try_inverse())
                .unwrap_or_default();
            slope
                .fixed_rows_mut::<10>(10 * link)
                .copy_from(&(pack(&(chart.gram[link] - root.transpose() * root)) * weight));
            maps.push(congruence(&root) * weight.sqrt());
            roots.push(root);
        }
        // Column by column, since rows of a link are far apart in memory.
        for mut column in prior_rows.column_iter_mut() {
            for (link, map) in maps.iter().enumerate() {
                let mapped = map * column.fixed_rows::<10>(10 * link).into_owned();
                column.fixed_rows_mut::<10>(10 * link).copy_from(&mapped);
            }
        }
        for (index, &(_, has_prior)) in self.extra.iter().enumerate() {
            let row = 10 * links + index;
            if has_prior {
                slope[row] = u[row] + chart.extra[index];
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
        for (index, &(_, has_prior)) in self.extra.iter().enumerate() {
            let row = 10 * links + index;
            if has_prior {
                linear += slope[row] * change[row];
                square += change[row] * change[row];
            }
        }
        Ok(Newton {
            decrement: -step.dot(&gradient),
            // The gradient is a difference; its rounding error is that of its terms.
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

    /// Rebuilds the chart about the state.
    fn move_chart(&self, state: &mut Iterate, u: &DVector<f64>) {
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
        let extra = chart.extra(u);
        origin.rows_mut(10 * links, extra.len()).copy_from(&extra);
        let right = &self.right - &self.data * origin;
        state.chart = Chart::new(local, right, stretch, extra, 0.0);
        state.y.fill(0.0);
    }

    pub(crate) fn finish(&self, state: Iterate, descent: Descent, tau: f64) -> MapEstimate {
        let Iterate { chart, y, .. } = state;
        let u = chart.coordinates(&y);
        let links = self.centres.len();
        let mut x = DVector::zeros(u.len());
        let mut bodies = Vec::with_capacity(links);
        let mut divergence_sum = 0.0;
        for (link, centre) in self.centres.iter().enumerate() {
            let l = &chart.stretch[link];
            // U relative to CAD, not 1 + U: a small one keeps its digits.
            let mut relative =
                l * block(&u, link) * l.transpose() + (l * l.transpose() - Matrix4::identity());
            let least = relative.symmetric_eigenvalues().min() + 1.0;
            if least < LEAST_EIGENVALUE {
                relative += Matrix4::identity() * (2.0 * LEAST_EIGENVALUE - least);
            }
            divergence_sum += divergence(&relative);
            let difference = body_of(&(centre.root * relative * centre.root.transpose()));
            let body = centre.reference + difference;
            x.fixed_rows_mut::<10>(10 * link)
                .copy_from(&(Vector10::from(body.parameters()) - centre.cad));
            bodies.push(body);
        }
        for (index, (value, &(unit, _))) in chart.extra(&u).iter().zip(&self.extra).enumerate() {
            x[10 * links + index] = value * unit;
        }
        // gamma = 10 L - tr(H^-1 K), K the links' part of the prior's Hessian. With H = S^2 + K +
        // K_f, S the data's diagonal, K_f the part of the extra parameters, it follows from S and
        // K_f.
        let inverse = blocked::inverse(descent.next.factor.l_dirty());
        let of_data = inverse.column_iter().zip(chart.scale.iter());
        let of_data: f64 = of_data
            .map(|(column, scale)| scale * scale * column.norm_squared())
            .sum();
        let extra = descent.next.prior_rows.rows(10 * links, self.extra.len());
        let of_further = self.extra.len() as f64 - (&inverse * extra.transpose()).norm_squared();
        let effective = (of_data - of_further).max(0.0);
        let residual_square = self.residual_square + chart.excess(&y);
        let centres = self.centres.iter().zip(&chart.stretch);
        let maps = centres.map(|(centre, l)| centre.parameters * congruence(l));
        MapEstimate {
            x,
            bodies,
            tau,
            divergence: divergence_sum,
            effective,
            residual_square,
            iterations: descent.iterations,
            is_converged: descent.is_converged,
            decrement: descent.next.decrement,
            maps: maps.collect(),
            expected: self.expected,
            units: self.extra.iter().map(|&(unit, _)| unit).collect(),
            chart,
            inverse,
        }
    }
}

/// Checks what a posterior is made from.
fn check_data(
    prior: &Prior,
    links: &[usize],
    data: &DMatrix<f64>,
    right: &DVector<f64>,
    precision: &[f64],
) -> Result<(), PriorError> {
    for (what, found, expected) in [
        ("columns", data.ncols(), 10 * links.len() + precision.len()),
        ("right sides", right.len(), data.nrows()),
    ] {
        if found != expected {
            return Err(PriorError::Size {
                what,
                found,
                expected,
            });
        }
    }
    let count = prior.link_count();
    for (position, &link) in links.iter().enumerate() {
        if link >= count {
            return Err(PriorError::NoLink { link, count });
        }
        if links[..position].contains(&link) {
            return Err(PriorError::Twice(link));
        }
    }
    check_finite("an entry of the data", data.as_slice())?;
    check_finite("a right side of the data", right.as_slice())?;
    match precision.iter().find(|p| !(p.is_finite() && **p >= 0.0)) {
        Some(&value) => Err(PriorError::Number {
            what: "a precision",
            value,
        }),
        None => Ok(()),
    }
}

/// The most probable bodies under data and prior, and their uncertainty.
///
/// Unknowns are in the order of the columns of [`Posterior::new`]. The posterior is Gaussian to
/// second order about this maximum (Laplace), with the curvature that the prior has there.
#[derive(Clone, Debug)]
pub struct MapEstimate {
    /// `[d | s]`: parameters minus CAD as given [kg, kg m, kg m^2], ten per link; the extra
    /// parameters.
    pub x: DVector<f64>,
    /// The links' bodies, `phi_CAD + d`: always physical.
    pub bodies: Vec<RigidInertia>,
    /// The weight of this fit.
    pub tau: f64,
    /// The divergence from CAD, summed over all links.
    pub divergence: f64,
    /// `gamma`: the number of the links' parameters that the data determine, rather than the prior.
    pub effective: f64,
    /// `|R x - z|^2`.
    pub residual_square: f64,
    /// Number of Newton steps.
    pub iterations: usize,
    /// Whether the fit converged.
    pub is_converged: bool,
    /// Square of the last Newton decrement.
    pub(crate) decrement: f64,
    /// `u -> phi`, for each link.
    maps: Vec<Matrix10>,
    /// The prior of `tau`.
    expected: Expected,
    /// Units of the extra parameters.
    units: Vec<f64>,
    chart: Chart,
    /// The inverse of the factor `L` of the Hessian by the chart's `y`.
    inverse: DMatrix<f64>,
}

impl MapEstimate {
    /// One iteration of the evidence: the weight for which this divergence, of this number of
    /// parameters, is the expected one (see [The weight](super#the-weight)). At most
    /// [`GREATEST_TAU`].
    pub fn next_tau(&self) -> f64 {
        stationary_tau(self.divergence, self.effective, self.expected)
    }

    /// A square root of the posterior covariance of `x`: `F` with `F F^T` the covariance. The
    /// variance of `a^T x` is `|F^T a|^2`.
    pub fn covariance_root(&self) -> DMatrix<f64> {
        // F = (u -> d) V A^-1/2: the factor's inverse, transposed, from the right.
        let mut root = &self.chart.v * self.inverse.transpose();
        for mut column in root.column_iter_mut() {
            for (link, map) in self.maps.iter().enumerate() {
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// From any start, physical or not, the same minimum within the tolerance; from near it, in
    /// fewer steps.
    #[test]
    fn a_fit_from_any_start_is_the_fit() {
        let body = |mass: f64| {
            let [m, c, i] = [mass, 0.05 * mass, 0.01 * mass];
            RigidInertia::from_parameters(&[
                m,
                c,
                0.3 * c,
                -c,
                i,
                0.1 * i,
                0.0,
                1.2 * i,
                0.0,
                0.9 * i,
            ])
        };
        let cad = [body(1.0), body(2.5), body(0.4)];
        let prior = Prior::new(&cad).unwrap();
        let columns = 10 * cad.len() + 2;
        let rows = 24;
        let data = DMatrix::from_vec(rows, columns, normals(4, rows * columns)) * 30.0;
        let right = DVector::from_vec(normals(5, rows)) * 10.0;
        let posterior = Posterior::new(&prior, &[0, 1, 2], &data, &right, &[1.0, 0.0]).unwrap();
        let fit = posterior.fit(0.4).unwrap();
        let root = fit.covariance_root().lu();
        let mut impossible = fit.x.clone();
        impossible[10] = -100.0;
        // For a body of more than twice CAD's parameters a Newton step overshoots, whatever the
        // prior's weight.
        let mut heavy = fit.x.clone();
        for (link, (cad, own)) in cad.iter().zip(&fit.bodies).enumerate() {
            let more = Vector10::from(own.parameters()) * 20.0 - Vector10::from(cad.parameters());
            heavy.fixed_rows_mut::<10>(10 * link).copy_from(&more);
        }
        let other = posterior.fit(0.3).unwrap();
        let steps = fit.iterations;
        for (x, most) in [
            (&fit.x, 1),
            (&other.x, steps),
            (&impossible, steps),
            (&heavy, steps),
        ] {
            let found = posterior.fit_from(x.as_slice(), 0.4, 1e-8).unwrap();
            // In standard deviations.
            let off = root.solve(&(&found.x - &fit.x)).expect("a root").norm();
            assert!(off < 2e-4, "{off}");
            assert!(found.is_converged && found.decrement <= 1e-8 && found.iterations <= most);
            assert!((found.effective - fit.effective).abs() < 1e-3 * fit.effective);
        }
        assert!(posterior.fit_from(&[0.0; 3], 0.4, 1e-8).is_ok());
        assert!(posterior.fit_from(fit.x.as_slice(), -1.0, 1e-8).is_err());
    }
}
