//! How well the parameters predict the measurements. First log by log and curve by curve,
//! then the residuals.

use super::words::{WRENCH, counted, role_words};
use crate::identify::advice::percent;
use crate::identify::summary::role;
use crate::report::plot::{Ink, Plot, PlotAxis, Trace};
use crate::report::{self, Cell, ReportTable, number};
use proprio_identification::{
    Both, Curve, LogOutcome, LogRole, ModelComparison, Outcome, Predicted,
};
use proprio_topics::Nanos;

/// How many points all lines of a report have together, at the most: at some seven bytes each it
/// stays well below 2 MB.
const POINTS: usize = 130_000;
/// So many curves are drawn at the most: more make a page that nobody looks through.
const CURVES: usize = 160;
/// Lines and bands that a curve of the outcome makes, those of its error included.
const LINES: usize = 7;

pub(super) fn logs(outcome: &Outcome) -> Option<String> {
    if outcome.logs.is_empty() {
        return None;
    }
    let mut relative = ReportTable::new(
        "Relative prediction error, |predicted − measured| / |measured|: of joint torques where \
         any were measured, else of F/T readings. Friction and gains are those of the training \
         logs; one constant offset of each F/T channel is fitted to the log. Last two columns: F/T \
         readings, with a linear drift fitted, too",
        &[
            "log",
            "role",
            "identified",
            "CAD",
            "F/T, identified, with drift",
            "F/T, CAD, with drift",
        ],
    );
    let mut used = ReportTable::new(
        "Observations of each log",
        &["log", "use", "observations", "from [s]", "to [s]"],
    );
    for log in &outcome.logs {
        let mut cells: Vec<Cell> = vec![log.file.as_str().into(), role(log.role).into()];
        let Predicted {
            relative_error,
            relative_error_with_drift,
            ..
        } = &log.predicted;
        for Both { cad, identified } in [*relative_error, *relative_error_with_drift] {
            let worst = cad.max(identified);
            cells.push(Cell::Bar(
                percent(identified),
                identified / worst,
                Ink::Identified,
            ));
            cells.push(Cell::Bar(percent(cad), cad / worst, Ink::Fitted));
        }
        relative.row(cells);
        let since = |t: Nanos| (t - log.span.0).seconds();
        let mut row = |what: &str, count: u64, from: f64, to: f64| {
            used.row(vec![
                log.file.as_str().into(),
                what.into(),
                Cell::Written(count.to_string()),
                from.into(),
                to.into(),
            ]);
        };
        row("used", log.used, 0.0, since(log.span.1));
        for excluded in &log.excluded {
            row(
                &format!("excluded: {}", excluded.reason),
                excluded.instants,
                since(excluded.first),
                since(excluded.last),
            );
        }
    }
    let tables = report::tables([relative, used]);
    Some(report::section("The logs", &tables))
}

/// The errors of the identified parameters and of the CAD with fitted offsets, with bars on one
/// scale; and of the CAD with configured offsets.
fn errors(three: &ModelComparison<f64>, text: fn(f64) -> String) -> [Cell; 3] {
    let ModelComparison {
        cad,
        cad_fitted,
        identified,
    } = *three;
    let worst = cad_fitted.max(identified);
    [
        Cell::Bar(text(identified), identified / worst, Ink::Identified),
        Cell::Bar(text(cad_fitted), cad_fitted / worst, Ink::Fitted),
        Cell::Written(text(cad)),
    ]
}

/// The columns of [`errors`], the first word of each row included. Nothing is fitted to torques
/// that are only compared with those from F/T sensors; there the CAD is one column, not two.
fn columns<'a>(
    mut rows: impl Iterator<Item = &'a ModelComparison<f64>>,
) -> &'static [&'static str] {
    if rows.all(|row| row.cad.to_bits() == row.cad_fitted.to_bits()) {
        &["identified", "CAD"]
    } else {
        &ERRORS
    }
}

const ERRORS: [&str; 3] = [
    "identified",
    "CAD, offsets fitted",
    "CAD, offsets as configured",
];

/// Figs. 3 and 4 of the paper: what was measured, what is predicted, and the error within its band.
pub(super) fn curves(outcome: &Outcome) -> Vec<String> {
    let count: usize = outcome.logs.iter().map(|l| l.curves.len()).sum();
    let most = (POINTS / (LINES * count.clamp(1, CURVES))).min(900);
    // Validation logs first: they show more than logs that were fitted.
    let mut logs: Vec<&LogOutcome> = outcome.logs.iter().collect();
    logs.sort_by_key(|l| l.role == LogRole::Train);
    let mut shown: Vec<[Vec<&Curve>; 2]> = logs
        .iter()
        .map(|log| {
            let (torques, wrenches) = log.curves.iter().partition(|c| is_torque(c, log));
            [torques, wrenches]
        })
        .collect();
    // Torques of all logs come before the channels of any.
    let mut room = CURVES;
    for kind in [0, 1] {
        for curves in shown.iter_mut().map(|of_log| &mut of_log[kind]) {
            curves.truncate(room);
            room -= curves.len();
        }
    }
    let mut sections = Vec::new();
    for (i, (log, shown)) in logs.into_iter().zip(shown).enumerate() {
        let mut body = Vec::new();
        body.extend(joint_table(log));
        let drawn: usize = shown.iter().map(Vec::len).sum();
        if drawn < log.curves.len() {
            body.push(report::paragraph(&format!(
                "{} of this log are left out to keep this page small.",
                counted(log.curves.len() - drawn, "curve")
            )));
        }
        for (title, curves) in ["Joint torques", "F/T channels"].into_iter().zip(shown) {
            if curves.is_empty() {
                continue;
            }
            let plots: Vec<Plot> = curves.iter().flat_map(|c| pair(c, log, most)).collect();
            let open = i == 0 && (title == "Joint torques" || body.is_empty());
            body.push(report::folded(
                &format!(
                    "{title}, predicted and measured: {}",
                    counted(plots.len(), "plot")
                ),
                open,
                &[report::figures(&plots)],
            ));
        }
        if !body.is_empty() {
            sections.push(report::section(
                &format!(
                    "Predicted and measured: {} ({})",
                    log.file,
                    role_words(log.role)
                ),
                &body,
            ));
        }
    }
    sections
}

fn is_torque(curve: &Curve, log: &LogOutcome) -> bool {
    log.joints.iter().any(|j| j.name == curve.name)
}

fn joint_table(log: &LogOutcome) -> Vec<String> {
    let heads = columns(log.joints.iter().map(|joint| &joint.rms_nm));
    let mut joints = ReportTable::new(
        "RMS of measured less predicted joint torque [Nm], and the share of measured torques \
         within the stated 95 % interval",
        &[&["joint"], heads, &["RMS torque", "within 95 %"]].concat(),
    );
    for joint in &log.joints {
        let mut cells = vec![joint.name.as_str().into()];
        cells.extend(errors(&joint.rms_nm, number).into_iter().take(heads.len()));
        cells.extend([
            joint.measured_rms_nm.into(),
            Cell::Written(percent(joint.coverage)),
        ]);
        joints.row(cells);
    }
    let mut routes = ReportTable::new(
        "The same joint torque from the F/T sensor on either side [Nm]: RMS of their difference",
        &[&["joint"], &ERRORS[..]].concat(),
    );
    let mut moving = ReportTable::new(
        "The same without the mean of the difference [Nm]",
        &[&["joint"], &ERRORS[..]].concat(),
    );
    for route in &log.two_route {
        for (table, three) in [
            (&mut routes, &route.rms_nm),
            (&mut moving, &route.rms_mean_removed_nm),
        ] {
            let mut cells = vec![route.joint.as_str().into()];
            cells.extend(errors(three, number));
            table.row(cells);
        }
    }
    report::tables([joints, routes, moving])
}

/// The values of a curve and their error.
fn pair(curve: &Curve, log: &LogOutcome, most: usize) -> [Plot; 2] {
    let (quantity, measured) = if is_torque(curve, log) {
        ("torque", "measured")
    } else {
        ("load", "measured, fitted offset subtracted")
    };
    let points = |y: &[f64]| {
        curve
            .t
            .iter()
            .copied()
            .zip(y.iter().copied())
            .collect::<Vec<_>>()
    };
    let errors = |y: &[f64]| -> Vec<(f64, f64)> {
        curve
            .t
            .iter()
            .zip(y)
            .zip(&curve.measured)
            .map(|((t, y), m)| (*t, y - m))
            .collect()
    };
    let band = |centre: &dyn Fn(usize) -> f64| -> Vec<(f64, f64, f64)> {
        (curve.t.iter().zip(&curve.sigma).enumerate())
            .map(|(i, (t, s))| (*t, centre(i) - 2.0 * s, centre(i) + 2.0 * s))
            .collect()
    };
    let centre = |i: usize| curve.identified.get(i).copied().unwrap_or(f64::NAN);
    let plot = |note: &str, y: &str, series| Plot {
        title: curve.name.clone(),
        note: note.into(),
        x: PlotAxis::new("t [s]"),
        y: PlotAxis::new(&format!("{y} [{}]", curve.unit)),
        series,
        shades: vec![],
        marks: log
            .onset
            .iter()
            .map(|t| ((*t - log.span.0).seconds(), "onset of motion".to_owned()))
            .collect(),
        most,
    };
    [
        plot(
            "",
            quantity,
            vec![
                Trace::band("± 2σ", Ink::Identified, band(&centre)),
                Trace::line(measured, Ink::Measured, points(&curve.measured)),
                Trace::line(
                    "CAD, offsets fitted",
                    Ink::Fitted,
                    points(&curve.cad_fitted),
                ),
                Trace::line("identified", Ink::Identified, points(&curve.identified)),
            ],
        ),
        plot(
            "predicted − measured",
            "error",
            vec![
                Trace::band("± 2σ", Ink::Identified, band(&|_| 0.0)),
                Trace::line(
                    "CAD, offsets fitted",
                    Ink::Fitted,
                    errors(&curve.cad_fitted),
                ),
                Trace::line("identified", Ink::Identified, errors(&curve.identified)),
            ],
        ),
    ]
}

pub(super) fn residuals(outcome: &Outcome) -> Option<String> {
    let mut body = Vec::new();
    let mut tables = Vec::new();
    for log in &outcome.logs {
        for sensor in &log.sensors {
            let mut table = ReportTable::new(
                &format!(
                    "{}, {}: RMS of reading less predicted reading, and the share of readings \
                     within the stated 95 % interval",
                    sensor.name, log.file
                ),
                &[&["channel"], &ERRORS[..], &["within 95 %"]].concat(),
            );
            let ModelComparison {
                cad,
                cad_fitted,
                identified,
            } = &sensor.rms;
            for (i, (channel, unit)) in WRENCH.iter().enumerate() {
                let mut cells = vec![format!("{channel}\u{a0}[{unit}]").into()];
                let three = ModelComparison {
                    cad: cad[i],
                    cad_fitted: cad_fitted[i],
                    identified: identified[i],
                };
                cells.extend(errors(&three, number));
                cells.push(Cell::Written(percent(sensor.coverage[i])));
                table.row(cells);
            }
            tables.push(format!("<div>{}</div>", table.html()));
        }
    }
    if !tables.is_empty() {
        body.push(format!("<div class=\"figures\">{}</div>", tables.concat()));
    }
    let mut noise = ReportTable::new(
        "Noise of each channel, from the residuals. Observations of a channel with a long \
         autocorrelation time are not independent; they are weighted accordingly.",
        &[
            "channel",
            "unit",
            "standard deviation",
            "autocorrelation time [s]",
            "drift [unit/√s]",
        ],
    );
    for c in &outcome.channels {
        noise.row(vec![
            c.name.as_str().into(),
            c.unit.into(),
            c.deviation.into(),
            c.autocorrelation_seconds.into(),
            c.drift.into(),
        ]);
    }
    if !noise.is_empty() {
        body.push(report::folded("Noise", false, &[noise.html()]));
    }
    (!body.is_empty()).then(|| report::section("Residuals", &body))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identify::example;

    /// The error is predicted minus measured, with its band about zero.
    #[test]
    fn errors_are_predicted_minus_measured() {
        let outcome = example::outcome();
        let log = &outcome.logs[0];
        let curve = Curve {
            t: vec![0.0, 1.0],
            measured: vec![3.0, 4.0],
            cad_fitted: vec![5.0, 4.5],
            identified: vec![2.5, 4.0],
            sigma: vec![0.5, 0.25],
            ..log.curves[0].clone()
        };
        let [values, errors] = pair(&curve, log, 100);
        let svg = |plot: Plot| format!("{:?}", plot.series);
        let expected = [
            Trace::band(
                "± 2σ",
                Ink::Identified,
                vec![(0.0, -1.0, 1.0), (1.0, -0.5, 0.5)],
            ),
            Trace::line(
                "CAD, offsets fitted",
                Ink::Fitted,
                vec![(0.0, 2.0), (1.0, 0.5)],
            ),
            Trace::line("identified", Ink::Identified, vec![(0.0, -0.5), (1.0, 0.0)]),
        ];
        assert_eq!(svg(errors), format!("{expected:?}"));
        let band = Trace::band(
            "± 2σ",
            Ink::Identified,
            vec![(0.0, 1.5, 3.5), (1.0, 3.5, 4.5)],
        );
        assert!(svg(values).contains(&format!("{band:?}")));
    }
}
