//! `report.html` of a demonstration, and its short form for the terminal.

use super::compared::percent;
use super::evaluation::Evaluation;
use super::learnt::learnt_section;
use super::torques::torque_plots;
use crate::report::plot::{Ink, Plot};
use crate::report::{self, Cell, ReportTable};
use proprio_topics::Nanos;

/// What the two columns of errors have in common.
const SAME_OFFSETS: &str = "Both use the offsets of the F/T sensors that identification found, so \
                            they differ in the inertial parameters of the links alone.";

/// The most important numbers, each with its name.
fn facts(evaluation: &Evaluation<'_>) -> Vec<(&'static str, String)> {
    let Evaluation {
        args,
        counts,
        judged,
        since,
        ..
    } = evaluation;
    let mut facts = vec![
        ("robot", evaluation.experiment.setup.robot.name.clone()),
        (
            "motion",
            format!("{} s, the first {} s at rest", args.seconds, args.still()),
        ),
        ("seed", args.seed.to_string()),
        (
            "frames",
            format!("{} received, {} lost", counts.frames, counts.lost),
        ),
        (
            "estimates",
            format!("{} at {:.1} Hz", counts.estimates, evaluation.rate_hz),
        ),
        (
            "torques valid",
            format!("{} {since}", percent(judged.valid_share)),
        ),
    ];
    if let Some(before) = &evaluation.before {
        facts.push((
            "before motion",
            format!("{} valid", percent(before.valid_share)),
        ));
    }
    if judged.valid_share > 0.0 {
        facts.push((
            "errors within 2σ",
            format!("{} {since}", percent(judged.within_2_sigma)),
        ));
    }
    facts.push((
        "latency from frame to torque",
        format!(
            "{:.0} us median, {:.0} us at 99 %",
            evaluation.latency(0.5),
            evaluation.latency(0.99)
        ),
    ));
    facts
}

/// Begin and end of the push in seconds of the report.
fn push(evaluation: &Evaluation<'_>) -> Option<(f64, f64)> {
    let compared = &evaluation.compared;
    let began = evaluation.watched.simulator["t0"]
        .as_i64()
        .map_or(compared.first, Nanos);
    let at = |t: f64| {
        compared
            .time(began + Nanos::from_seconds(t))
            .min(compared.time(evaluation.last))
    };
    let (push, _) = evaluation.experiment.push.as_ref()?;
    Some((at(push.from), at(push.until)))
}

/// The joints in the order in which they are told: number, name, and whether it is beyond an F/T
/// sensor.
fn joints<'a>(evaluation: &'a Evaluation<'_>) -> impl Iterator<Item = (usize, &'a str, bool)> {
    let places = evaluation.experiment.order.iter().enumerate();
    places.filter_map(|(place, &joint)| {
        let name = evaluation.watched.joints.get(joint)?;
        Some((joint, name.as_str(), place < evaluation.experiment.beyond))
    })
}

/// The page.
pub(super) fn page(evaluation: &Evaluation<'_>) -> String {
    let Evaluation {
        compared,
        judged,
        since,
        ..
    } = evaluation;
    let setup = &evaluation.experiment.setup;
    let verdict = &evaluation.verdict;
    let mut rows = ReportTable::new(
        &format!(
            "RMS errors of the torques against the simulator's truth, {since} [Nm], over the \
             estimates that are valid"
        ),
        &["joint", "where", "identified", "CAD", "RMS torque", "valid"],
    );
    for (i, name, is_beyond) in joints(evaluation) {
        let Some(accuracy) = judged.joints.get(i) else {
            continue;
        };
        let (identified, cad) = (accuracy.identified, accuracy.cad);
        let bar =
            |value: f64, ink| Cell::Bar(report::number(value), value / identified.max(cad), ink);
        rows.row(vec![
            name.into(),
            if is_beyond {
                "beyond F/T"
            } else {
                "before F/T"
            }
            .into(),
            bar(identified, Ink::Identified),
            bar(cad, Ink::Cad),
            accuracy.size.into(),
            Cell::Written(accuracy.valid.to_string()),
        ]);
    }
    let pushes: Vec<(f64, f64)> = push(evaluation).into_iter().collect();
    let plots: Vec<Plot> = joints(evaluation)
        .filter_map(|(i, name, _)| Some((name, compared.joints.get(i)?)))
        .flat_map(|(name, instants)| torque_plots(name, instants, compared, &pushes))
        .collect();
    report::page(
        &format!("proprio demo: {}", setup.robot.name),
        &[
            report::verdict(verdict.class(), verdict.headline, &verdict.figures),
            report::paragraph(&evaluation.experiment.story(evaluation.args)),
            report::facts(&facts(evaluation)),
            report::section(
                "Joint torques",
                &[
                    rows.html(),
                    report::paragraph(same_offsets(evaluation)),
                    report::paragraph(&setup.upstream_note()),
                    report::paragraph(
                        "Grey: torques are withheld, because an input is missing or their standard \
                         deviation is too large. Green: the robot is pushed; the push is \
                         declared, and identification pauses.",
                    ),
                    report::figures(&plots),
                ],
            ),
            learnt_section(&evaluation.parameters, &evaluation.offsets, compared),
        ],
    )
}

/// Empty if nothing is identified.
fn same_offsets(evaluation: &Evaluation<'_>) -> &'static str {
    match &evaluation.experiment.refused {
        None => SAME_OFFSETS,
        Some(_) => "",
    }
}

/// Prints the result: the verdict, what it rests on, and the circumstances.
pub(super) fn print(evaluation: &Evaluation<'_>) {
    let Evaluation { judged, since, .. } = evaluation;
    print_line!("\n{}\n", evaluation.verdict.sentence());
    print_line!("RMS error of the torques against the simulator's truth, {since} [Nm]:");
    let width = (evaluation.watched.joints.iter().map(String::len).max()).unwrap_or(0);
    let (none, width) = ("", width.max(20));
    print_line!(
        "  {none:<width$}  {:>10}  {:>8}  {:>15}",
        "identified",
        "CAD",
        "valid estimates"
    );
    let mut part = None;
    for (i, name, is_beyond) in joints(evaluation) {
        if part.replace(is_beyond) != Some(is_beyond) {
            let place = if is_beyond { "beyond" } else { "before" };
            print_line!("  {place} the F/T sensor:");
        }
        if let Some(accuracy) = judged.joints.get(i) {
            let [identified, cad] = [accuracy.identified, accuracy.cad].map(|error| {
                if error.is_finite() {
                    format!("{error:.4}")
                } else {
                    "-".to_owned()
                }
            });
            print_line!(
                "    {name:<width$}{identified:>10}  {cad:>8}  {:>15}",
                accuracy.valid
            );
        }
    }
    for note in [
        same_offsets(evaluation),
        &evaluation.experiment.setup.upstream_note(),
    ] {
        if !note.is_empty() {
            print_line!("{note}");
        }
    }
    print_line!();
    for (name, value) in facts(evaluation) {
        print_line!("{name:<29} {value}");
    }
    print_line!(
        "{}: report.html, estimates.csv, summary.json, the configuration (gateway.toml, \
         estimator.toml, cad.urdf) and the processes' logs",
        evaluation.args.out.display()
    );
}
