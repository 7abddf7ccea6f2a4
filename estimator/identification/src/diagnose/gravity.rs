//! Gravity that points elsewhere than the configuration says: a robot on a wall, or upside down.
//!
//! The rows are linear in the proper acceleration `p` of a base that stands still. With CAD, and
//! offsets and friction eliminated, least squares gives the `p` that explains the logs best; its
//! direction, with the configured magnitude, is accepted if it is nearer to another axis than to
//! the configured one, and leaves less than a ninth of the squared residuals.
//!
//! Without it, an arm on a wall is identified with an error of 78 % on held-out torques, with the
//! right gravity of 0.7 %, and nothing names the cause.

use crate::dataset::observation::Observation;
use crate::finding::{Finding, FindingCode, Severity};
use crate::linear::nuisance::NuisanceFilter;
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::nuisance_prior;
use crate::measurement::rows::Rows;
use crate::robot::BaseMotion;
use crate::training::{TrainingLog, map_segments, sample};
use nalgebra::{Matrix3, Matrix4, Vector3};
use proprio_dynamics::Structure;
use proprio_dynamics::spatial::Vec3;

/// Most of the squared residuals that may be left: parameters wrong by a third leave a ninth. (A
/// joint that counts backwards looks like another gravity, and leaves more.)
const REMAINING: f64 = 1.0 / 9.0;

/// The finding, if the logs contradict the configured gravity.
pub(crate) fn wrong(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
) -> Option<Finding> {
    let (robot, unknowns) = (measurement.robot(), measurement.unknowns());
    let mut instants = training.iter().flat_map(|log| &log.instants);
    let first = instants.next()?.observation();
    let stands = |own: &Observation| own.base_link == first.base_link && own.base == first.base;
    if !matches!(robot.base, BaseMotion::Standing(_))
        || !instants.all(|own| stands(own.observation()))
    {
        return None;
    }
    // A force has the weight of its torque at a lever of this length.
    let mut variances = vec![1.0; unknowns.channels()];
    for torque in (0..unknowns.sensors.len()).flat_map(|place| 6 * place..6 * place + 3) {
        variances[torque] = Structure::LENGTH_SCALE.powi(2);
    }
    // Gram matrix of the columns of `p`, then the residual.
    let parts = map_segments(
        measurement,
        &sample(measurement, training),
        |measurement, _, segment| {
            let mut gram = Matrix4::zeros();
            let mut nuisance = NuisanceFilter::new(&nuisance_prior(unknowns), 4);
            let [mut rows, mut moved] = [Rows::new(unknowns), Rows::new(unknowns)];
            for instant in segment.instants {
                if measurement.make(instant, &mut rows).is_err() {
                    continue;
                }
                let mut lines = vec![0.0; 4 * rows.count];
                for axis in 0..3 {
                    let mut unit = Vec3::zeros();
                    unit[axis] = 1.0;
                    let other = instant.clone().map(|own| own.accelerated(&unit));
                    if measurement.make(&other, &mut moved).is_err() || moved.count != rows.count {
                        continue;
                    }
                    for row in 0..rows.count {
                        lines[4 * row + axis] = moved.r(row) - rows.r(row);
                    }
                }
                (0..rows.count).for_each(|row| lines[4 * row + 3] = rows.r(row));
                rows.whiten_with(&variances, &mut lines, 4);
                for (row, line) in lines.chunks_exact_mut(4).enumerate() {
                    nuisance.update(rows.g(row), line);
                    let line = nalgebra::Vector4::from_row_slice(line);
                    gram += line * line.transpose();
                }
            }
            gram
        },
    );
    let gram: Matrix4<f64> = parts.iter().sum();
    let columns: Matrix3<f64> = gram.fixed_view::<3, 3>(0, 0).into_owned();
    let right: Vector3<f64> = gram.fixed_view::<3, 1>(0, 3).into_owned();
    let squares = |change: &Vector3<f64>| {
        gram[(3, 3)] + 2.0 * change.dot(&right) + change.dot(&(columns * change))
    };
    let configured = first.base.proper_acceleration;
    let best = configured - columns.cholesky()?.solve(&right);
    let found = best.normalize() * configured.norm();
    let is_other_axis = found.dot(&configured) < 0.5_f64.sqrt() * configured.norm_squared();
    if !is_other_axis || squares(&(found - configured)) > REMAINING * squares(&Vector3::zeros()) {
        return None;
    }
    let written = |p: &Vec3| {
        let [x, y, z] = [-p.x, -p.y, -p.z].map(|x| if x.abs() < 0.05 { 0.0 } else { x });
        format!("[{x:.1}, {y:.1}, {z:.1}]")
    };
    Some(Finding {
        severity: Severity::Refusal,
        code: FindingCode::WrongGravity,
        subject: "base.gravity_mps2".into(),
        text: format!(
            "the logs contradict the configured gravity_mps2 = {}: with {} in the axes of {} the \
             URDF's links leave {:.0} % of the error; correct [base]",
            written(&configured),
            written(&found),
            robot.model.link_name(first.base_link),
            100.0 * (squares(&(found - configured)) / squares(&Vector3::zeros())).sqrt()
        ),
    })
}
