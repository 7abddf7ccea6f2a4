//! `report.html` of a demonstration, and its short form for the terminal.

use super::evaluation::Evaluation;
use super::learnt::learnt_section;
use super::torques::torque_plots;
use crate::report::plot::{Ink, Plot};
use crate::report::{self, Cell, Table};
use proprio_topics::Nanos;

/// Why the CAD may be better at joints whose torques rest on offsets.
const TRUE_OFFSETS: &str = "The torques of the wrong URDF use the offsets of the F/T sensors that \
                            the robot's configuration states. Identification does not: it has to \
                            find them.";

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

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
            format!(
                "{} s, the first {} s at rest, seed {}",
                args.seconds,
                args.still(),
                args.seed
            ),
        ),
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
    facts.push((
        "errors within 2σ",
        format!("{} {since}", percent(judged.within_2_sigma)),
    ));
    facts.push((
        "latency",
        format!(
            "{:.0} us median, {:.0} us at 99 %, from frame stamp to torque published",
            evaluation.latency(0.5),
            evaluation.latency(0.99)
        ),
    ));
    facts
}

/// The times of the pushes in seconds of the report.
fn pushes(evaluation: &Evaluation<'_>) -> Vec<(f64, f64)> {
    let compared = &evaluation.compared;
    let began = evaluation.watched.simulator["t0"]
        .as_i64()
        .map_or(compared.first, Nanos);
    let at = |t: f64| {
        compared
            .time(began + Nanos::from_seconds(t))
            .min(compared.time(evaluation.last))
    };
    let touched = evaluation.experiment.touched.iter();
    touched
        .map(|(from, until)| (at(*from), at(*until)))
        .collect()
}

/// The page.
pub(super) fn page(evaluation: &Evaluation<'_>) -> String {
    let Evaluation {
        watched,
        compared,
        judged,
        since,
        ..
    } = evaluation;
    let setup = &evaluation.experiment.setup;
    let mut rows = Table::new(
        &format!("RMS errors of the torques against the simulator's truth, {since} [Nm]"),
        &["joint", "identified", "CAD", "RMS torque"],
    );
    for (i, name) in watched.joints.iter().enumerate() {
        let of = |values: &[f64]| values.get(i).copied().unwrap_or(f64::NAN);
        let (identified, cad) = (of(&judged.identified), of(&judged.cad));
        let bar =
            |value: f64, ink| Cell::Bar(report::number(value), value / identified.max(cad), ink);
        rows.row(vec![
            name.as_str().into(),
            bar(identified, Ink::Identified),
            bar(cad, Ink::Cad),
            of(&judged.size).into(),
        ]);
    }
    let pushes = pushes(evaluation);
    let plots: Vec<Plot> = (watched.joints.iter().zip(&compared.joints))
        .flat_map(|(name, instants)| torque_plots(name, instants, compared, &pushes))
        .collect();
    report::page(
        &format!("proprio demo: {}", setup.robot.name),
        &[
            report::paragraph(&evaluation.experiment.story(evaluation.args)),
            report::facts(&facts(evaluation)),
            report::section(
                "Joint torques",
                &[
                    rows.html(),
                    report::paragraph(TRUE_OFFSETS),
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

/// Prints the result.
pub(super) fn print(evaluation: &Evaluation<'_>) {
    let Evaluation {
        judged,
        watched,
        since,
        ..
    } = evaluation;
    for (name, value) in facts(evaluation) {
        print_line!("{name:<17} {value}");
    }
    print_line!(
        "RMS error of the torques against the simulator's truth, {since} [Nm]: identified, and \
         with the wrong URDF:"
    );
    let errors = judged.identified.iter().zip(&judged.cad);
    for (joint, (identified, cad)) in watched.joints.iter().zip(errors) {
        print_line!("  {joint:<20} {identified:.4}  {cad:.4}");
    }
    print_line!("{TRUE_OFFSETS}");
    let upstream = evaluation.experiment.setup.upstream_note();
    if !upstream.is_empty() {
        print_line!("{upstream}");
    }
    print_line!(
        "{}: report.html, estimates.csv, summary.json, cad.urdf, estimator.toml and the \
         processes' logs",
        evaluation.args.out.display()
    );
}
