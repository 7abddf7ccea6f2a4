//! Uncertainty of the parameters: covariances, weak directions, base parameters.

use crate::fit::{Identified, link_inertias};
use crate::measurement::reduction::ReducedLog;
use crate::measurement::unknowns::{ExtraParameter, Unknowns};
use crate::prepared_log::PreparedLog;
use crate::report::comparison::{STILL, UNREAD};
use crate::report::outcome::{BaseParameterOutcome, CovarianceRoot, LinkOutcome, RotorOutcome};
use crate::robot::{IdentificationInput, Robot};
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::regressor::identifiable::{
    BaseParameter, Identifiable, JointMotion, Measurement, Offsets, ParameterColumn, Scope, Term,
};
use proprio_dynamics::spatial::RigidInertia;

pub(crate) const PARAMETERS: [&str; 10] = [
    "m", "h_x", "h_y", "h_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz",
];

pub(crate) fn unseen(robot: &Robot, link: usize, cad: &RigidInertia) -> LinkOutcome {
    LinkOutcome {
        link,
        name: robot.model.link_name(link).to_owned(),
        cad: *cad,
        floored: None,
        identified: *cad,
        deviation: [f64::NAN; 10],
        retained_fraction: 0.0,
        significance: 0.0,
        seen: false,
    }
}

/// Rotors whose inertia is not separable from that of links: their column is a combination of those
/// of the other rotors and the links' parameters.
pub(crate) fn rotors_not_separable(
    identified: &Identified<'_>,
    spread: &[DMatrix<f64>],
) -> Vec<String> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let mut fitted = unknowns.parameters_without_cad();
    if fitted.is_empty() {
        return Vec::new();
    }
    let (mut r, _) = identified.information.to_triangle();
    scale_links(&mut r, spread);
    // Rotors without rows are not tested.
    fitted.retain(|column| r.column(*column).norm() > 0.0);
    let sum = |column: usize| {
        let ExtraParameter::RotorInertia(dof) = unknowns.extra[column - unknowns.inertial()] else {
            return None;
        };
        Some(format!(
            "not separable, only their sum is identified: the rotor inertia of {0}, and the \
             inertia of the links that {0} moves, about its axis",
            robot.model.dof_name(dof)
        ))
    };
    let sums = combinations(&r, &fitted).into_iter();
    sums.filter_map(sum).collect()
}

/// Those of these columns of a matrix, none of them zero, that are linear combinations of all other
/// columns within rounding: to 1e-5 of their length.
pub(crate) fn combinations(matrix: &DMatrix<f64>, columns: &[usize]) -> Vec<usize> {
    /// Largest distance from the combination, relative to the length.
    const MAX_DISTANCE: f64 = 1e-5;
    const ROUNDING: f64 = 1e-12;
    // Component of each column orthogonal to the rest of the matrix ...
    let mut remainder = matrix.select_columns(columns);
    remainder
        .column_iter_mut()
        .for_each(|mut column| _ = column.normalize_mut());
    let svd = matrix.clone().remove_columns_at(columns).svd(true, false);
    let sizes = &svd.singular_values;
    let known = (0..sizes.len()).filter(|&i| sizes[i] > 1e-10 * sizes.max());
    if let Some(axes) = svd.u.map(|u| u.select_columns(&known.collect::<Vec<_>>())) {
        remainder -= &axes * axes.tr_mul(&remainder);
    }
    // ... and its distance from the span of the others: the inverse length of its row of the
    // pseudo-inverse.
    let svd = remainder.svd(false, true);
    let directions = svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, columns.len()));
    let far = |index: usize| {
        let row = directions.column(index);
        let squares = row
            .iter()
            .zip(&svd.singular_values)
            .map(|(v, size)| (v / size.max(ROUNDING)).powi(2));
        squares.sum::<f64>().sqrt().recip()
    };
    let each = columns.iter().enumerate();
    each.filter(|(index, _)| far(*index) < MAX_DISTANCE)
        .map(|(_, column)| *column)
        .collect()
}

/// Identified rotor inertias.
pub(crate) fn rotors(identified: &Identified<'_>, root: &DMatrix<f64>) -> Vec<RotorOutcome> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let rotor = |(extra, column): (&ExtraParameter, usize)| {
        let ExtraParameter::RotorInertia(dof) = *extra else {
            return None;
        };
        Some(RotorOutcome {
            joint: robot.model.dof_name(dof).to_owned(),
            inertia: identified.d[column],
            deviation: root.row(column).norm(),
        })
    };
    let extra = unknowns.extra.iter().zip(unknowns.inertial()..);
    extra.filter_map(rotor).collect()
}

/// `R` of the links' parameters, marginalised over the extra parameters, with columns in units of
/// the prior's spread; and that spread: per link a matrix from such units to the ten parameters, `2
/// tau^2 M^-1 = spread spread^T`.
pub(crate) fn scaled_information(identified: &Identified<'_>) -> (DMatrix<f64>, Vec<DMatrix<f64>>) {
    let mut scaled = of_links(identified);
    let spread = |&link: &usize| {
        let factor = identified.prior.metric(link).cholesky();
        let inverse = factor.and_then(|factor| factor.l().try_inverse());
        let inverse = inverse.unwrap_or_default().transpose();
        let spread = inverse * (2.0_f64.sqrt() * identified.fit.tau);
        DMatrix::from_column_slice(LINK_PARAMETERS, LINK_PARAMETERS, spread.as_slice())
    };
    let spreads: Vec<DMatrix<f64>> = identified.unknowns().links.iter().map(spread).collect();
    scale_links(&mut scaled, &spreads);
    (scaled, spreads)
}

/// Multiplies the columns of each link by one of these matrices.
fn scale_links(r: &mut DMatrix<f64>, spreads: &[DMatrix<f64>]) {
    for (index, spread) in spreads.iter().enumerate() {
        let mut columns = r.columns_mut(LINK_PARAMETERS * index, LINK_PARAMETERS);
        let scaled = columns.clone_owned() * spread;
        columns.copy_from(&scaled);
    }
}

/// Square-root information about the links' parameters, marginalised over the extra parameters: the
/// lower right block of the triangle of `[R_extra | R_links]`. Extra parameters that CAD contains
/// have their prior; the others have none.
pub(crate) fn of_links(identified: &Identified<'_>) -> DMatrix<f64> {
    let (r, _) = identified.information.to_triangle();
    let unknowns = identified.unknowns();
    let (links, extra) = (unknowns.inertial(), unknowns.extra.len());
    if extra == 0 {
        return r;
    }
    let rows = r.nrows();
    let order: Vec<usize> = (links..links + extra).chain(0..links).collect();
    let mut all = r
        .select_columns(&order)
        .resize_vertically(rows + extra, 0.0);
    for (index, (precision, own)) in unknowns.precision.iter().zip(&unknowns.extra).enumerate() {
        if !own.lacks_cad() {
            all[(rows + index, index)] = precision.sqrt();
        }
    }
    let r = all.qr().r();
    r.view((extra, extra), (links, links)).into_owned()
}

/// A square root `F` of the covariance `F F^T` of CAD's errors: the prior's spread of each link and
/// the prior of extra parameters that CAD contains. Extra parameters that it does not contain were
/// fitted to the data together with CAD ([`Identified::cad`]): CAD's errors and noise propagate to
/// them.
pub(crate) fn cad_root(
    unknowns: &Unknowns,
    r: &DMatrix<f64>,
    spread: &[DMatrix<f64>],
) -> DMatrix<f64> {
    let count = unknowns.parameters();
    let fitted = unknowns.parameters_without_cad();
    let given = (0..count).filter(|column| !fitted.contains(column));
    let given: Vec<usize> = given.collect();
    let precision = &unknowns.precision;
    let mut root = DMatrix::zeros(count, count);
    for (index, spread) in spread.iter().enumerate() {
        root.view_mut(
            (LINK_PARAMETERS * index, LINK_PARAMETERS * index),
            (LINK_PARAMETERS, LINK_PARAMETERS),
        )
        .copy_from(spread);
    }
    for (precision, column) in precision.iter().zip(unknowns.inertial()..) {
        root[(column, column)] = 1.0 / precision.sqrt();
    }
    if fitted.is_empty() {
        return root;
    }
    let columns = r.select_columns(&fitted);
    let mut square = columns.tr_mul(&columns);
    for (index, &column) in fitted.iter().enumerate() {
        square[(index, index)] += precision[column - unknowns.inertial()];
        root[(column, column)] = 0.0;
    }
    let Some(factor) = square.cholesky() else {
        return root;
    };
    // (R_f^T R_f + prior)^-1 [-R_f^T R_c (error of c) + noise], the noise of covariance R_f^T R_f +
    // prior.
    let moved =
        factor.solve(&columns.tr_mul(&(r.select_columns(&given) * root.select_rows(&given))));
    let noise = factor.l().transpose().try_inverse();
    for (index, &column) in fitted.iter().enumerate() {
        root.row_mut(column).copy_from(&-moved.row(index));
        for (other, &at) in fitted.iter().enumerate() {
            root[(column, at)] += noise.as_ref().map_or(0.0, |noise| noise[(index, other)]);
        }
    }
    root
}

/// A square root of the covariance of the shrunk parameters, with a retained fraction `kept` of the
/// change from CAD per column: `(1 - b^2) P + b^2 Q` with `b = 1 - kept`, `P = root root^T` and `Q
/// = cad cad^T` the covariance of CAD's errors.
///
/// The error is `kept` times that of the estimate plus `b` times that of CAD. The estimate's error
/// has covariance `P`, CAD's error `Q`, and their cross-covariance is `P`, because the change of
/// the estimate is uncorrelated with its remaining error. So with a retained fraction of 0 the
/// result is the prior's covariance. (No row contains two groups of parameters, and the retained
/// fraction is the same within a group.)
pub(crate) fn shrunk(root: &DMatrix<f64>, cad: &DMatrix<f64>, kept: &[f64]) -> DMatrix<f64> {
    let narrow = root.ncols();
    let mut wide = root.clone().resize_horizontally(narrow + cad.ncols(), 0.0);
    for (row, kept) in kept.iter().enumerate() {
        let back = 1.0 - kept;
        let scale = (1.0 - back * back).sqrt();
        wide.view_mut((row, 0), (1, narrow)).scale_mut(scale);
        wide.view_mut((row, narrow), (1, cad.ncols()))
            .copy_from(&(cad.row(row) * back));
    }
    upper(&wide)
}

pub(crate) fn links(
    identified: &Identified<'_>,
    root: &DMatrix<f64>,
    wide: &DMatrix<f64>,
    spread: &[DMatrix<f64>],
) -> Vec<LinkOutcome> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let moved = link_inertias(robot, unknowns, &identified.d);
    let inverse = |spread: &DMatrix<f64>| {
        let inverse = spread.clone().try_inverse();
        inverse.unwrap_or_else(|| DMatrix::zeros(LINK_PARAMETERS, LINK_PARAMETERS))
    };
    let inverses: Vec<DMatrix<f64>> = spread.iter().map(inverse).collect();
    // Of the rows of a link, in units of the prior's spread.
    let scaled = |matrix: &DMatrix<f64>, index: usize| {
        let block = matrix.rows(LINK_PARAMETERS * index, LINK_PARAMETERS);
        &inverses[index] * block.into_owned()
    };
    // Covariance of the estimate if CAD were right: P - P (prior's precision) P.
    let mut weighted = root.clone();
    for index in 0..inverses.len() {
        weighted
            .rows_mut(LINK_PARAMETERS * index, LINK_PARAMETERS)
            .copy_from(&scaled(root, index));
    }
    for (precision, row) in unknowns.precision.iter().zip(unknowns.inertial()..) {
        weighted.row_mut(row).scale_mut(precision.sqrt());
    }
    // root root^T - (root weighed^T)(...)^T
    let shrinking = root * weighted.transpose();
    let outcome = |(link, cad): (usize, &RigidInertia)| {
        let floored = identified.prior.floors().iter().any(|f| f.link == link);
        let outcome = LinkOutcome {
            floored: floored.then(|| *identified.prior.reference(link)),
            ..unseen(robot, link, cad)
        };
        let Ok(index) = unknowns.links.binary_search(&link) else {
            let metric = identified.prior.metric(link);
            let metric = metric.try_inverse().unwrap_or_default();
            return LinkOutcome {
                deviation: std::array::from_fn(|k| {
                    (2.0 * metric[(k, k)]).max(0.0).sqrt() * identified.fit.tau
                }),
                ..outcome
            };
        };
        let change = identified.d.rows(LINK_PARAMETERS * index, LINK_PARAMETERS);
        LinkOutcome {
            identified: moved[link],
            deviation: std::array::from_fn(|k| wide.row(LINK_PARAMETERS * index + k).norm()),
            retained_fraction: identified.retained[index],
            significance: significance(
                &scaled(root, index),
                &scaled(&shrinking, index),
                &(&inverses[index] * change),
            ),
            seen: true,
            ..outcome
        }
    };
    let links = robot.model.inertias().iter().enumerate();
    links.map(outcome).collect()
}

/// Significance of the change of a link's parameters as a standard normal deviate, from the link's
/// rows of the root of the posterior covariance `P` (`root`), of `P` times the root of the prior's
/// precision (`shrinking`), and from the change; all in units of the prior's spread.
///
/// Only directions that the logs determine rather than the prior count: those with less than half
/// of the prior's variance. There the change is measured by the covariance that it would have if
/// CAD were right, `P - P (prior's precision) P`. Its square is then a chi-square variable, which
/// Fisher's square-root approximation converts to a deviate.
pub(crate) fn significance(
    root: &DMatrix<f64>,
    shrinking: &DMatrix<f64>,
    change: &DVector<f64>,
) -> f64 {
    let svd = root.clone().svd(true, false);
    let Some(axes) = svd.u else { return 0.0 };
    let known: Vec<usize> = (0..svd.singular_values.len())
        .filter(|&i| svd.singular_values[i].powi(2) < 0.5)
        .collect();
    if known.is_empty() {
        return 0.0;
    }
    // Each direction in units of its own standard deviation: these differ by many orders of
    // magnitude.
    let scale = |i: usize| 1.0 / svd.singular_values[known[i]].max(f64::MIN_POSITIVE);
    let axes = axes.select_columns(&known).transpose();
    let (own, shrinking, change) = (&axes * root, &axes * shrinking, &axes * change);
    let scatter = &own * own.transpose() - &shrinking * shrinking.transpose();
    let scatter = DMatrix::from_fn(known.len(), known.len(), |i, j| {
        scatter[(i, j)] * scale(i) * scale(j)
    });
    let change = DVector::from_fn(known.len(), |i, _| change[i] * scale(i));
    let square = match scatter.cholesky() {
        Some(factor) => change.dot(&factor.solve(&change)),
        // Not positive definite because of rounding: the whole posterior covariance instead.
        None => change.norm_squared(),
    };
    ((2.0 * square).sqrt() - (2.0 * known.len() as f64 - 1.0).sqrt()).max(0.0)
}

/// Joint covariance of the parameters, and of each sensor's offset at the end of the last segment
/// of a training log in which it was read.
pub(crate) fn covariance(
    unknowns: &Unknowns,
    logs: &[ReducedLog],
    root: &DMatrix<f64>,
) -> CovarianceRoot {
    let (links, p) = (unknowns.inertial(), unknowns.parameters());
    let s = unknowns.wrenches();
    let of_links = unknowns.links.iter().flat_map(|&link| {
        (0..LINK_PARAMETERS).map(move |parameter| ParameterColumn::Inertial { link, parameter })
    });
    let of_sensors = unknowns.sensors.iter().flat_map(|&sensor| {
        (0..6).map(move |component| ParameterColumn::Offset { sensor, component })
    });
    let wide = root.ncols();
    let mut joint = DMatrix::zeros(p + s, wide + s);
    joint.view_mut((0, 0), (p, wide)).copy_from(root);
    // Given the parameters, offsets in different segments are independent.
    let source = |index: usize| {
        let read = |reduced: &ReducedLog| {
            (0..6).any(|axis| reduced.covariance[(6 * index + axis, 6 * index + axis)] < UNREAD)
        };
        let last = logs.len().saturating_sub(1);
        logs.iter().rposition(read).unwrap_or(last)
    };
    let sources: Vec<usize> = (0..unknowns.sensors.len()).map(source).collect();
    for (number, reduced) in logs.iter().enumerate() {
        let rows = (0..s).filter(|unknown| sources[unknown / 6] == number);
        let rows: Vec<usize> = rows.collect();
        if rows.is_empty() {
            continue;
        }
        let moved = reduced.slope.select_rows(&rows) * root;
        let covariance = reduced.covariance.select_rows(&rows).select_columns(&rows);
        let factor = covariance.cholesky();
        for (i, unknown) in rows.iter().enumerate() {
            let mut row = joint.view_mut((p + unknown, 0), (1, wide));
            row.copy_from(&-moved.row(i));
            for (j, column) in rows[..=i].iter().enumerate() {
                let entry = factor.as_ref().map_or(0.0, |f| f.l_dirty()[(i, j)]);
                joint[(p + unknown, wide + column)] = entry;
            }
        }
    }
    // Marginalised over the other extra parameters.
    let (mut rows, mut calibrations): (Vec<usize>, Vec<_>) =
        ((0..links).chain(p..p + s).collect(), Vec::new());
    for (extra, row) in unknowns.extra.iter().zip(links..) {
        if let ExtraParameter::Calibration(sensor, unknown) = *extra {
            rows.push(row);
            calibrations.push((sensor, unknown));
        }
    }
    let joint = joint.select_rows(&rows);
    CovarianceRoot {
        columns: of_links.chain(of_sensors).collect(),
        calibrations,
        root: upper(&joint),
    }
}

/// The upper triangular `U` with `U U^T = M M^T`.
pub(crate) fn upper(m: &DMatrix<f64>) -> DMatrix<f64> {
    let n = m.nrows();
    let flipped = DMatrix::from_fn(m.ncols(), n, |i, j| m[(n - 1 - j, i)]);
    let r = flipped.qr().r();
    DMatrix::from_fn(n, n, |i, j| {
        if j < i {
            0.0
        } else {
            r[(n - 1 - j, n - 1 - i)]
        }
    })
}

/// The combination of parameters of a direction `v` in units of the prior's spread `S`, `v . S^-1
/// d`, as an expression, and the links of its parameters. Up to four terms, the largest ones in
/// units of the prior's spread; factors are in the parameters' own units, the first one is 1.
pub(crate) fn expression(
    robot: &Robot,
    unknowns: &Unknowns,
    spread: &[DMatrix<f64>],
    direction: &DVector<f64>,
) -> (String, Vec<usize>) {
    let mut parts: Vec<(usize, f64, f64)> = Vec::new();
    for (index, spread) in spread.iter().enumerate() {
        let Some(inverse) = spread.clone().try_inverse() else {
            continue;
        };
        let rows = direction.rows(LINK_PARAMETERS * index, LINK_PARAMETERS);
        let factors = inverse.tr_mul(&rows.into_owned());
        for (k, factor) in factors.iter().enumerate() {
            let size = (factor * spread.row(k).norm()).abs();
            parts.push((LINK_PARAMETERS * index + k, *factor, size));
        }
    }
    parts.sort_by(|a, b| b.2.total_cmp(&a.2).then(a.0.cmp(&b.0)));
    let link = |column: usize| unknowns.links[column / LINK_PARAMETERS];
    let leading = parts.iter().take(4);
    let leading = leading.filter(|part| part.2 >= 0.1 * parts[0].2);
    let mut links: Vec<usize> = leading.clone().map(|part| link(part.0)).collect();
    links.dedup();
    let mut terms = leading.map(|&(column, factor, _)| {
        let parameter = PARAMETERS[column % LINK_PARAMETERS];
        Term {
            coefficient: factor / parts[0].1,
            column,
            name: format!("{}.{parameter}", robot.model.link_name(link(column))),
        }
    });
    let Some(kept) = terms.next() else {
        return (String::new(), links);
    };
    let terms = terms.collect();
    (BaseParameter { kept, terms }.to_string(), links)
}

/// Identifiable subspace for the joints that moved in the logs.
pub(crate) fn subspace(
    training: &[&PreparedLog],
    identified: &Identified<'_>,
) -> Option<Identifiable> {
    let robot = identified.robot();
    let mut regime = robot.regime();
    for (dof, joint) in regime.joints.iter_mut().enumerate() {
        let all = || training.iter().flat_map(|log| log.instants.iter());
        let (low, high) = all().fold((f64::MAX, f64::MIN), |(a, b), i| {
            (a.min(i.position[dof]), b.max(i.position[dof]))
        });
        if high - low < STILL {
            *joint = JointMotion::Locked(0.5 * (low + high));
        }
    }
    if identified.inputs == [IdentificationInput::Torque] {
        return Identifiable::new(
            &robot.model,
            Scope::Tree,
            &regime,
            Measurement::Torques,
            Offsets::Known,
        )
        .ok();
    }
    regime.contacts = robot.always;
    let subspace = |measured| {
        let scope = Scope::SubTrees(&robot.structure);
        Identifiable::new(&robot.model, scope, &regime, measured, Offsets::Unknown).ok()
    };
    // Joint torques count beside F/T sensors only if all moving joints have one: the subspace of
    // some torques is not computed.
    let is_measured = |dof| {
        matches!(regime.joints[dof], JointMotion::Locked(_))
            || identified.unknowns().joints.contains(&dof)
    };
    let all_measured = (0..regime.joints.len()).all(is_measured);
    let both = all_measured.then(|| subspace(Measurement::Both));
    both.flatten().or_else(|| subspace(Measurement::Wrench))
}

pub(crate) fn base_parameters(
    identified: &Identified<'_>,
    root: &DMatrix<f64>,
    subspace: Option<&Identifiable>,
) -> (Vec<BaseParameterOutcome>, Vec<String>, usize) {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let Some(subspace) = subspace else {
        return (Vec::new(), Vec::new(), 0);
    };
    let moved = link_inertias(robot, unknowns, &identified.d);
    let value_of = |bodies: &[RigidInertia]| -> Vec<f64> {
        let columns = subspace.columns().iter();
        columns
            .map(|column| match column {
                ParameterColumn::Inertial { link, parameter } => {
                    bodies[*link].parameters()[*parameter]
                }
                ParameterColumn::Offset { .. } => 0.0,
            })
            .collect()
    };
    let (cad, new) = (value_of(robot.model.inertias()), value_of(&moved));
    let (mut out, mut not_separable, mut rank) = (Vec::new(), Vec::new(), 0);
    for base in subspace.base_parameters() {
        let is_inertial =
            |column: usize| matches!(subspace.columns()[column], ParameterColumn::Inertial { .. });
        let all = || std::iter::once(&base.kept).chain(&base.terms);
        let inertial = all().filter(|t| is_inertial(t.column)).count();
        let offsets = all().count() - inertial;
        if offsets > 0 {
            if inertial > 0 || offsets > 1 {
                not_separable.push(format!(
                    "not separable, only their sum is identified: {base}"
                ));
            }
            continue;
        }
        let mut row = DVector::zeros(unknowns.parameters());
        let mut seen = true;
        for term in all() {
            if let ParameterColumn::Inertial { link, parameter } = subspace.columns()[term.column] {
                match unknowns.links.binary_search(&link) {
                    Ok(index) => row[LINK_PARAMETERS * index + parameter] += term.coefficient,
                    Err(_) => seen = false,
                }
            }
        }
        rank += usize::from(seen);
        let (Some(before), Some(after), true) = (base.value(&cad), base.value(&new), seen) else {
            continue;
        };
        let unit = match subspace.columns()[base.kept.column] {
            ParameterColumn::Inertial { parameter: 0, .. } => "kg",
            ParameterColumn::Inertial {
                parameter: 1..=3, ..
            } => "kg m",
            _ => "kg m^2",
        };
        out.push(BaseParameterOutcome {
            expression: base.to_string(),
            unit,
            cad: before,
            identified: after,
            deviation: root.tr_mul(&row).norm(),
        });
    }
    (out, not_separable, rank)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measurement::reduction::tests::between_two_sensors;

    /// The same columns as a test of each column alone finds.
    #[test]
    fn linear_combinations_of_columns_are_found() {
        let one_by_one = |matrix: &DMatrix<f64>, column: usize| {
            let mut rest = matrix.column(column).normalize();
            let svd = matrix.clone().remove_column(column).svd(true, false);
            let (axes, sizes) = (svd.u.unwrap(), &svd.singular_values);
            for (axis, _) in axes
                .column_iter()
                .zip(sizes)
                .filter(|(_, size)| **size > 1e-10 * sizes.max())
            {
                rest.axpy(-axis.dot(&rest), &axis, 1.0);
            }
            rest.norm() < 1e-5
        };
        // Columns 0 to 19 are links, 3 of them sums of others and 2 zero; the rest are rotors,
        // which each case changes.
        let random = DMatrix::from_vec(30, 26, crate::arithmetic::normals(11, 30 * 26));
        let with = |change: &dyn Fn(&mut DMatrix<f64>)| {
            let mut matrix = random.clone();
            for column in 0..20 {
                matrix
                    .column_mut(column)
                    .scale_mut(10.0_f64.powi(column as i32 % 5 - 4));
            }
            for (sum, a, b) in [(3, 0, 7), (9, 1, 3), (12, 4, 9)] {
                let combined = 2.0 * matrix.column(a) - matrix.column(b);
                matrix.set_column(sum, &combined);
            }
            [5, 17]
                .into_iter()
                .for_each(|column| matrix.column_mut(column).fill(0.0));
            change(&mut matrix);
            matrix
        };
        let set = |matrix: &mut DMatrix<f64>, column: usize, own: DVector<f64>| {
            matrix.set_column(column, &own);
        };
        type Change<'a> = &'a dyn Fn(&mut DMatrix<f64>);
        let cases: [(Change<'_>, &[usize]); 6] = [
            (&|_| (), &[]),
            // A combination of links, much longer than their columns.
            (
                &|m| set(m, 21, 3e4 * m.column(2) + 1e5 * m.column(12)),
                &[21],
            ),
            // A combination of links and another rotor: neither is separable.
            (&|m| set(m, 22, m.column(2) - m.column(24)), &[22, 24]),
            // A combination of links, and one of links and another rotor.
            (
                &|m| {
                    set(m, 20, m.column(0) * 1e3);
                    set(m, 25, m.column(23) + m.column(20));
                },
                &[20, 23, 25],
            ),
            // Within rounding, and not.
            (&|m| set(m, 21, m.column(14) + 1e-7 * m.column(21)), &[21]),
            (&|m| set(m, 21, m.column(14) + 1e-3 * m.column(21)), &[]),
        ];
        for (change, expected) in cases {
            let (matrix, rotors) = (with(change), [20, 21, 22, 23, 24, 25]);
            let alone: Vec<usize> = rotors
                .into_iter()
                .filter(|&column| one_by_one(&matrix, column))
                .collect();
            assert_eq!(combinations(&matrix, &rotors), alone);
            assert_eq!(alone, expected);
        }
    }

    /// One link with directions of standard deviations from the prior's spread to a ten thousandth
    /// of it; a change by ten standard deviations in one of the well-determined directions.
    #[test]
    fn significance_uses_the_best_determined_directions() {
        let share: Vec<f64> = (0..10).map(|i| 10f64.powf(-0.9 * f64::from(i))).collect();
        let root = DMatrix::from_diagonal(&DVector::from_fn(10, |i, _| share[i].sqrt()));
        // With the prior's precision the unit matrix, P times its root is P.
        let shrinking = &root * &root;
        let moved = |direction: usize, deviations: f64| {
            let mut change = DVector::zeros(10);
            change[direction] = deviations * (share[direction] - share[direction].powi(2)).sqrt();
            significance(&root, &shrinking, &change)
        };
        // Nine directions count: sqrt(2 x 100) - sqrt(2 x 9 - 1).
        let expected = 200f64.sqrt() - 17f64.sqrt();
        for direction in [3, 9] {
            let found = moved(direction, 10.0);
            assert!(
                (found - expected).abs() < 1e-6 * expected,
                "{direction}: {found} {expected}"
            );
        }
        assert_eq!(moved(0, 10.0), 0.0, "the logs do not determine it");
        assert_eq!(moved(9, 1.0), 0.0, "chance");
    }

    /// The covariance of a square root.
    fn squared(root: &DMatrix<f64>) -> DMatrix<f64> {
        root * root.transpose()
    }

    #[test]
    fn parameters_shrunk_to_cad_are_as_uncertain_as_cad() {
        let mut state = 1.0_f64;
        let mut next = || {
            state = (state * 1.7 + 0.31).fract();
            state - 0.5
        };
        // Two links without common rows.
        let mut narrow = DMatrix::zeros(20, 20);
        for index in [0, 10] {
            let block = DMatrix::from_fn(10, 10, |_, _| 0.01 * next());
            narrow.view_mut((index, index), (10, 10)).copy_from(&block);
        }
        let spread: Vec<DMatrix<f64>> = (0..2)
            .map(|_| DMatrix::from_fn(10, 10, |_, _| next()))
            .collect();
        let mut cad = DMatrix::zeros(20, 20);
        for (index, spread) in spread.iter().enumerate() {
            cad.view_mut((10 * index, 10 * index), (10, 10))
                .copy_from(spread);
        }
        let block = |m: &DMatrix<f64>, index: usize| {
            m.view((10 * index, 10 * index), (10, 10)).into_owned()
        };
        let all = squared(&narrow);
        for (kept, back) in [(1.0, 0.0), (0.0, 1.0), (0.7, 0.3)] {
            let found = squared(&shrunk(&narrow, &cad, &[[kept; 10], [1.0; 10]].concat()));
            let expected =
                block(&all, 0) * (1.0 - back * back) + squared(&spread[0]) * (back * back);
            assert!((block(&found, 0) - expected).amax() < 1e-12, "{kept}");
            assert!(
                (block(&found, 1) - block(&all, 1)).amax() < 1e-12,
                "{kept}: the other link's"
            );
        }
    }

    /// CAD's errors have the prior's spread; parameters fitted together with CAD have the
    /// propagated errors, and noise.
    #[test]
    fn parameters_fitted_with_cad_have_its_errors() {
        let mut state = 0.7_f64;
        let mut next = || {
            state = (state * 1.9 + 0.37).fract();
            state - 0.5
        };
        let unknowns = Unknowns {
            links: vec![2],
            extra: vec![
                ExtraParameter::RotorInertia(0),
                ExtraParameter::RotorInertia(1),
            ],
            precision: vec![0.5, 2.0],
            ..Unknowns::default()
        };
        let r = DMatrix::from_fn(12, 12, |_, _| 3.0 * next());
        let spread = DMatrix::from_fn(10, 10, |_, _| next());
        let found = squared(&cad_root(&unknowns, &r, std::slice::from_ref(&spread)));
        let (links, rotors) = (r.columns(0, 10).into_owned(), r.columns(10, 2).into_owned());
        let mut precision = rotors.transpose() * &rotors;
        for (index, own) in unknowns.precision.iter().copied().enumerate() {
            precision[(index, index)] += own;
        }
        let inverse = precision.try_inverse().expect("known");
        let slope = &inverse * rotors.transpose() * links;
        let bodies = squared(&spread);
        let close = |name: &str, found: DMatrix<f64>, expected: DMatrix<f64>| {
            assert!(
                (&found - &expected).amax() < 1e-9 * expected.amax(),
                "{name}: {found} {expected}"
            );
        };
        close(
            "bodies",
            found.view((0, 0), (10, 10)).into_owned(),
            bodies.clone(),
        );
        close(
            "both",
            found.view((10, 0), (2, 10)).into_owned(),
            -(&slope * &bodies),
        );
        let expected = &slope * &bodies * slope.transpose() + inverse;
        close(
            "rotors",
            found.view((10, 10), (2, 2)).into_owned(),
            expected,
        );
    }

    #[test]
    fn weak_directions_are_in_the_parameters_own_units() {
        let robot = between_two_sensors();
        let unknowns = Unknowns {
            links: vec![3, 5],
            ..Unknowns::default()
        };
        // kg, kg m and kg m^2 are uncertain by 1, 0.1 and 0.01; m and h_x of the second link
        // together besides.
        let scale = |k: usize| [1.0, 0.1, 0.01][usize::from(k > 0) + usize::from(k > 3)];
        let plain = DMatrix::from_diagonal(&DVector::from_fn(10, |k, _| scale(k)));
        let mut mixed = plain.clone();
        mixed[(1, 0)] = 0.05;
        let mut direction = DVector::zeros(20);
        (direction[0], direction[2], direction[4]) = (1.0, -0.5, 0.05);
        let first = robot.model.link_name(3);
        assert_eq!(
            expression(
                &robot,
                &unknowns,
                &[plain.clone(), mixed.clone()],
                &direction
            ),
            // m / 1 - 0.5 h_y / 0.1, and too little of I_xx.
            (
                format!("{first}.m - 5 {first}.h_y"),
                vec![unknowns.links[0]]
            )
        );
        // h_x / 0.1 of what h_x is beside its share of m: (h_x - 0.05 m) / 0.1.
        let direction = DVector::from_fn(20, |k, _| f64::from(u8::from(k == 11)));
        let second = robot.model.link_name(5);
        assert_eq!(
            expression(&robot, &unknowns, &[plain, mixed], &direction),
            (
                format!("{second}.h_x - 0.05 {second}.m"),
                vec![unknowns.links[1]]
            )
        );
    }
}
