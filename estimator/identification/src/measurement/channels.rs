//! Names and places of the measured channels, and the attribution of residuals to channels.

use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::Unknowns;
use crate::robot::{AXES, Robot};
use nalgebra::DMatrix;

/// The channel of a sensor's axis. Axes are in the order of samples (forces first), channels have
/// torques first.
pub(crate) fn channel_of(sensor_place: usize, axis: usize) -> usize {
    6 * sensor_place + (axis + 3) % 6
}

pub(crate) fn sensor_name(robot: &Robot, sensor: usize) -> String {
    let name = robot.sensor_names().nth(sensor);
    name.unwrap_or_default().to_owned()
}

pub(crate) fn channel_name(
    robot: &Robot,
    unknowns: &Unknowns,
    channel: usize,
) -> (String, &'static str) {
    let wrenches = unknowns.wrenches();
    if channel < wrenches {
        let axis = (channel % 6 + 3) % 6;
        let name = sensor_name(robot, unknowns.sensors[channel / 6]);
        (
            format!("wrench/{name}/{}", AXES[axis]),
            if axis < 3 { "N" } else { "Nm" },
        )
    } else {
        let dof = unknowns.joints[channel - wrenches];
        (format!("joint/{}/torque", robot.model.dof_name(dof)), "Nm")
    }
}

/// The map from the residuals of rows (not whitened) to the noise of these channels that explains
/// them, with all other channels taken as exact: `V N^T (N V N^T)^-1`. None if no row has any of
/// these channels.
pub(crate) fn attribute_to(
    rows: &MeasurementRows,
    variances: &[f64],
    channels: std::ops::Range<usize>,
) -> Option<DMatrix<f64>> {
    /// Relative variance of the other channels: where several sub-trees disagree about the
    /// channels, the others take the remainder, at a cost.
    const OTHERS: f64 = 1e-6;
    let has = |row: &usize| rows.n(*row)[channels.clone()].iter().any(|x| *x != 0.0);
    let own: Vec<usize> = (0..rows.count).filter(has).collect();
    if own.is_empty() {
        return None;
    }
    let variance = |c: usize| variances[c] * if channels.contains(&c) { 1.0 } else { OTHERS };
    let n = DMatrix::from_fn(own.len(), variances.len(), |i, c| rows.n(own[i])[c]);
    let scaled = DMatrix::from_fn(own.len(), variances.len(), |i, c| n[(i, c)] * variance(c));
    let mut square = &scaled * n.transpose();
    let least = 1e-12 * square.diagonal().max();
    for i in 0..own.len() {
        square[(i, i)] += least;
    }
    let solved = square
        .cholesky()?
        .solve(&scaled.columns_range(channels.clone()).into_owned());
    let mut map = DMatrix::zeros(channels.len(), rows.count);
    for (i, row) in own.iter().enumerate() {
        map.set_column(*row, &solved.row(i).transpose());
    }
    Some(map)
}
