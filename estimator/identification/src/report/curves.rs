//! Curves of readings and predictions for a report.

use crate::dataset::observation::Annotated;
use crate::measurement::channels::{channel_of, sensor_name};
use crate::report::comparison::{Judged, SensorComparison, TorqueSeries};
use crate::report::outcome::Curve;
use crate::robot::AXES;

/// Most points of a curve.
pub(crate) const POINTS: usize = 2000;

pub(crate) fn curves(
    judged: &Judged<'_>,
    instants: &[Annotated],
    times: &[f64],
    compared: &SensorComparison,
    torques: &[TorqueSeries],
) -> Vec<Curve> {
    let (robot, unknowns) = (judged.identified.robot(), judged.identified.unknowns());
    let points: Vec<usize> = (0..instants.len())
        .step_by(instants.len().div_ceil(POINTS).max(1))
        .collect();
    // The standard deviation changes slowly: it is computed at a tenth of the points and held
    // between them.
    let deviations = judged.deviations(points.iter().step_by(10).map(|&i| &instants[i]));
    let sigma = |channel: usize| -> Vec<f64> {
        (0..points.len())
            .map(|number| deviations[number / 10][channel])
            .collect()
    };
    let t: Vec<f64> = points.iter().map(|&i| times[i]).collect();
    let pick =
        |values: &dyn Fn(usize) -> f64| points.iter().map(|&i| values(i)).collect::<Vec<f64>>();
    let mut out = Vec::new();
    for TorqueSeries {
        dof,
        errors,
        measured,
    } in torques
    {
        let index = unknowns.joints.binary_search(dof).ok();
        out.push(Curve {
            name: robot.model.dof_name(*dof).to_owned(),
            unit: "Nm",
            t: t.clone(),
            measured: pick(&|i| measured[i]),
            cad_fitted: pick(&|i| measured[i] - errors[1][i]),
            identified: pick(&|i| measured[i] - errors[2][i]),
            sigma: index.map_or_else(
                || vec![f64::NAN; points.len()],
                |index| sigma(unknowns.wrenches() + index),
            ),
        });
    }
    for (index, &sensor) in unknowns.sensors.iter().enumerate() {
        for (axis, word) in AXES.into_iter().enumerate() {
            let channel = channel_of(index, axis);
            let load = &compared.load[channel];
            out.push(Curve {
                name: format!("{} {word}", sensor_name(robot, sensor)),
                unit: if axis < 3 { "N" } else { "Nm" },
                t: t.clone(),
                measured: pick(&|i| load[i]),
                cad_fitted: pick(&|i| load[i] - compared.errors[1][channel][i]),
                identified: pick(&|i| load[i] - compared.errors[2][channel][i]),
                sigma: sigma(channel),
            });
        }
    }
    out
}
