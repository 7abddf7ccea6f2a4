//! Plots the joints' torques. Shades mark withheld torques and touches of the robot.

use super::compared::{AlignedRun, AlignedTorque};
use crate::report::plot::{Ink, Plot, PlotAxis, Shade, Trace};

/// Stretches of a plot with smaller gaps are merged \[s\].
const GAP: f64 = 0.05;

/// The stretches in which `is` holds; close ones are merged.
fn stretches(instants: impl Iterator<Item = (f64, bool)>) -> Vec<(f64, f64)> {
    let mut found: Vec<(f64, f64)> = vec![];
    let mut last = f64::NAN;
    for (t, is) in instants {
        match found.last_mut() {
            _ if !is => {}
            Some((_, until)) if t - *until < GAP => *until = t,
            // The stretch begins at the end of the last instant without it.
            _ => found.push((if last.is_nan() { t } else { last }, t)),
        }
        last = t;
    }
    found
}

/// Figure 3 of the paper: the torque of a joint (true, with the CAD, and identified with its band),
/// and its error.
pub(super) fn torque_plots(
    name: &str,
    instants: &[AlignedTorque],
    compared: &AlignedRun,
    touched: &[(f64, f64)],
) -> [Plot; 2] {
    let withheld = stretches(
        instants
            .iter()
            .map(|i| (compared.time(i.t), i.estimate.valid != 1)),
    );
    let plot = |note: &str, quantity: &str, series| Plot {
        title: name.to_owned(),
        note: note.to_owned(),
        x: PlotAxis::new("t [s]"),
        y: PlotAxis::new(&format!("{quantity} [Nm]")),
        series,
        marks: vec![(compared.time(compared.moving), "onset of motion".to_owned())],
        shades: vec![
            (Shade::Withheld, withheld.clone()),
            (Shade::Touched, touched.to_vec()),
        ],
        ..Plot::default()
    };
    let line = |of: &dyn Fn(&AlignedTorque) -> f64| -> Vec<(f64, f64)> {
        instants
            .iter()
            .map(|i| (compared.time(i.t), of(i)))
            .collect()
    };
    // Withheld torques are NaN: they have no line and no band.
    let band = |of: &dyn Fn(&AlignedTorque) -> f64| -> Vec<(f64, f64, f64)> {
        let around = instants
            .iter()
            .map(|i| (i, of(i), 2.0 * i.estimate.standard_deviation));
        around
            .map(|(i, value, two)| (compared.time(i.t), value - two, value + two))
            .collect()
    };
    [
        plot(
            "",
            "torque",
            vec![
                Trace::band("± 2σ", Ink::Identified, band(&|i| i.estimate.torque)),
                Trace::line("CAD", Ink::Cad, line(&|i| i.cad)),
                Trace::line("identified", Ink::Identified, line(&|i| i.estimate.torque)),
                Trace::line("truth", Ink::Measured, line(&|i| i.truth)),
            ],
        ),
        plot(
            "estimated − truth",
            "error",
            vec![
                Trace::band("± 2σ", Ink::Identified, band(&|i| 0.0 * i.estimate.torque)),
                Trace::line("CAD", Ink::Cad, line(&|i| i.cad - i.truth)),
                Trace::line("identified", Ink::Identified, line(&AlignedTorque::error)),
            ],
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretches_begin_where_the_last_good_one_was_and_close_ones_are_one() {
        let flags = [
            (0.0, false),
            (0.01, true),
            (0.02, false),
            (0.03, true),
            (0.2, false),
            (0.3, true),
        ];
        assert_eq!(stretches(flags.into_iter()), [(0.0, 0.03), (0.2, 0.3)]);
        assert_eq!(stretches([(1.0, true)].into_iter()), [(1.0, 1.0)]);
    }
}
