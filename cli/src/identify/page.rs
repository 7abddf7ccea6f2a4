//! `report.html`: an outcome for people. First what it means and what to do, then what supports that, then everything else.

use super::advice::{Advice, Grade, findings, percent, sentence};
use super::summary::{role, severity};
use crate::report::plot::{Axis, Ink, Plot, Series};
use crate::report::{self, Cell, Table, escape, number, short};
use proprio_estimator::calibration::{Unknown, swapped};
use proprio_estimator::identify::{
    BaseParameterOutcome, Both, CalibrationOutcome, Curve, LogOutcome, Outcome, Predicted, Role, Severity, Spectrum,
    Three, Verdict,
};
use proprio_topics::Nanos;

/// Channels of an F/T sensor, in the order of their six numbers.
const WRENCH: [(&str, &str); 6] = [
    ("fx", "N"),
    ("fy", "N"),
    ("fz", "N"),
    ("tx", "Nm"),
    ("ty", "Nm"),
    ("tz", "Nm"),
];
/// How many points all lines of a report have together, at the most: at some seven bytes each it stays well below 2 MB.
const POINTS: usize = 130_000;
/// So many curves are drawn at the most: more make a page that nobody looks through.
const CURVES: usize = 160;
/// So many points all spectra have together.
const SPECTRUM_POINTS: usize = 40_000;
/// Lines and bands that a curve of the outcome makes, those of its error included.
const LINES: usize = 7;
/// So many base parameters and weak directions are listed at once; the others can be unfolded.
const LISTED: usize = 12;

/// The page.
pub(crate) fn page(outcome: &Outcome, advice: &Advice) -> String {
    let mut blocks = vec![verdict(advice), key_facts(outcome)];
    blocks.extend(found(outcome));
    blocks.extend(logs(outcome));
    blocks.extend(curves(outcome));
    blocks.extend(residuals(outcome));
    if !matches!(outcome.verdict, Verdict::Nothing(_)) {
        blocks.extend(parameters(outcome));
    }
    blocks.extend(excitation(outcome));
    blocks.extend(sessions(outcome));
    blocks.push(how_to_read());
    report::page(&format!("Identification of {}", outcome.robot), &blocks)
}

fn verdict(advice: &Advice) -> String {
    let class = match advice.grade {
        Grade::Accept => "good",
        Grade::Care => "care",
        Grade::Reject => "bad",
    };
    let next = report::list(&advice.next);
    let next = if next.is_empty() {
        next
    } else {
        format!("<div><h3>What to do next</h3>{next}</div>")
    };
    format!(
        "<div class=\"verdict {class}\"><h2>{}</h2><div class=\"sides\"><div>{}</div>{next}</div></div>",
        advice.grade.headline(),
        report::paragraph(&advice.why.join(" "))
    )
}

fn key_facts(outcome: &Outcome) -> String {
    let mut facts = Vec::new();
    for log in &outcome.logs {
        let error = &log.predicted.relative_error;
        if error.identified.is_finite() {
            facts.push((
                format!("error on {} ({})", log.file, role_words(log.role)),
                format!("{}, CAD {}", percent(error.identified), percent(error.cad)),
            ));
        }
    }
    facts.push((
        "combinations of parameters".into(),
        format!("{} shown of {}", outcome.rank, outcome.structural_rank),
    ));
    if outcome.effective.is_finite() {
        facts.push((
            "decided by the logs".into(),
            format!("{:.1} of {}", outcome.effective, outcome.rank),
        ));
    }
    facts.push(("distance of CAD, tau".into(), number(outcome.tau)));
    if outcome.shrink < 1.0 {
        facts.push(("kept of the change from CAD".into(), percent(outcome.shrink)));
    }
    let physical = match outcome.consistency.feasible {
        Some(true) => "yes",
        Some(false) => "no",
        None => "not decided",
    };
    facts.push(("physical bodies fit the logs".into(), physical.into()));
    let facts: Vec<(&str, String)> = facts
        .iter()
        .map(|(name, value)| (name.as_str(), value.clone()))
        .collect();
    report::facts(&facts)
}

fn found(outcome: &Outcome) -> Option<String> {
    let mut all: Vec<_> = findings(outcome).collect();
    all.sort_by_key(|(_, f)| std::cmp::Reverse(f.severity));
    let item = |(log, f): &(Option<&LogOutcome>, &proprio_estimator::identify::Finding)| {
        let place = log
            .map(|l| format!("<small>{}: </small>", escape(&l.file)))
            .unwrap_or_default();
        format!(
            "<li><span class=\"tag {0}\">{0}</span>{place}{1}</li>",
            severity(f.severity),
            escape(&sentence(&f.text))
        )
    };
    let list = |items: Vec<String>| format!("<ul class=\"findings\">{}</ul>", items.concat());
    let (serious, notes): (Vec<_>, Vec<_>) = all.iter().partition(|(_, f)| f.severity > Severity::Note);
    let mut body = Vec::new();
    if !serious.is_empty() {
        body.push(list(serious.iter().map(&item).collect()));
    }
    if !notes.is_empty() {
        body.push(report::folded(
            &counted(notes.len(), "note"),
            serious.is_empty() && notes.len() < 6,
            &[list(notes.iter().map(item).collect())],
        ));
    }
    let text = &outcome.consistency.text;
    if !text.is_empty() && !all.iter().any(|(_, f)| f.text.contains(text.as_str())) {
        body.push(report::paragraph(&format!("Physical consistency: {}", sentence(text))));
    }
    (!body.is_empty()).then(|| report::section("What was found", &body))
}

fn role_words(role: Role) -> &'static str {
    match role {
        Role::Train => "fitted",
        Role::Validate => "for validation",
    }
}

fn logs(outcome: &Outcome) -> Option<String> {
    if outcome.logs.is_empty() {
        return None;
    }
    let mut relative = Table::new(
        "Relative error of what the parameters predict, |predicted − measured| / |measured|: friction and gains from the training logs, one constant offset of each F/T channel for the log (and a linear drift besides)",
        &[
            "log",
            "role",
            "identified",
            "CAD",
            "identified, with drift",
            "CAD, with drift",
        ],
    );
    let mut fitted = Table::new(
        "The same with offsets that walk, and friction, fitted to the log",
        &[&["log", "role"], &ERRORS[..]].concat(),
    );
    let mut used = Table::new(
        "Instants of each log",
        &["log", "what became of them", "instants", "from [s]", "to [s]"],
    );
    for log in &outcome.logs {
        let of_log = || -> Vec<Cell> { vec![log.file.as_str().into(), role(log.role).into()] };
        let mut cells = of_log();
        let Predicted {
            relative_error,
            relative_error_with_drift,
            ..
        } = &log.predicted;
        for Both { cad, identified } in [*relative_error, *relative_error_with_drift] {
            let worst = cad.max(identified);
            cells.push(Cell::Bar(percent(identified), identified / worst, Ink::Identified));
            cells.push(Cell::Bar(percent(cad), cad / worst, Ink::Fitted));
        }
        relative.row(cells);
        let mut cells = of_log();
        cells.extend(errors(&log.fitted_error, percent));
        fitted.row(cells);
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
        for left in &log.left_out {
            row(
                &format!("left out: {}", left.reason),
                left.instants,
                since(left.first),
                since(left.last),
            );
        }
    }
    Some(report::section(
        "The logs",
        &[relative.html(), fitted.html(), used.html()],
    ))
}

/// The errors of the identified parameters and of the fitted CAD, with bars that can be compared; and of the CAD as it is.
fn errors(three: &Three<f64>, text: fn(f64) -> String) -> [Cell; 3] {
    let Three {
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

/// `1 plot`, `2 plots`.
fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// The heads of these three.
const ERRORS: [&str; 3] = ["identified", "CAD, fitted", "CAD as configured"];

/// Figs. 3 and 4 of the paper: what was measured, what is predicted, and the error within its band.
fn curves(outcome: &Outcome) -> Vec<String> {
    let count: usize = outcome.logs.iter().map(|l| l.curves.len()).sum();
    let most = (POINTS / (LINES * count.clamp(1, CURVES))).min(900);
    // Logs for validation tell more than those that were fitted.
    let mut logs: Vec<&LogOutcome> = outcome.logs.iter().collect();
    logs.sort_by_key(|l| l.role == Role::Train);
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
                "{} of this log are left out of this page, which would be too large with them.",
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
                &format!("{title}, predicted and measured: {}", counted(plots.len(), "plot")),
                open,
                &[report::figures(&plots)],
            ));
        }
        if !body.is_empty() {
            sections.push(report::section(
                &format!("Predicted and measured: {} ({})", log.file, role_words(log.role)),
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
    let mut joints = Table::new(
        "RMS of measured less predicted joint torque [Nm], and how often the measured torque lies within the stated 95 % interval",
        &[&["joint"], &ERRORS[..], &["RMS torque", "within 95 %"]].concat(),
    );
    for joint in &log.joints {
        let mut cells = vec![joint.name.as_str().into()];
        cells.extend(errors(&joint.rms_nm, number));
        cells.extend([joint.measured_rms_nm.into(), Cell::Written(percent(joint.coverage))]);
        joints.row(cells);
    }
    let mut routes = Table::new(
        "The same joint torque from the F/T sensor on either side [Nm]: RMS of their difference",
        &[&["joint"], &ERRORS[..]].concat(),
    );
    let mut moving = Table::new(
        "The same without the mean of the difference [Nm]",
        &[&["joint"], &ERRORS[..]].concat(),
    );
    for route in &log.two_route {
        for (table, three) in [(&mut routes, &route.rms_nm), (&mut moving, &route.rms_mean_removed_nm)] {
            let mut cells = vec![route.joint.as_str().into()];
            cells.extend(errors(three, number));
            table.row(cells);
        }
    }
    [joints, routes, moving]
        .iter()
        .filter(|t| !t.is_empty())
        .map(Table::html)
        .collect()
}

/// The values of a curve and their error.
fn pair(curve: &Curve, log: &LogOutcome, most: usize) -> [Plot; 2] {
    let points = |y: &[f64]| curve.t.iter().copied().zip(y.iter().copied()).collect::<Vec<_>>();
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
    let plot = |note: &str, series| Plot {
        title: curve.name.clone(),
        note: note.into(),
        x: Axis::new("t [s]"),
        y: Axis::new(&format!("[{}]", curve.unit)),
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
            vec![
                Series::band("± 2σ", Ink::Identified, band(&centre)),
                Series::line("measured", Ink::Measured, points(&curve.measured)),
                Series::line("CAD, fitted", Ink::Fitted, points(&curve.cad_fitted)),
                Series::line("identified", Ink::Identified, points(&curve.identified)),
            ],
        ),
        plot(
            "error: predicted − measured",
            vec![
                Series::band("± 2σ", Ink::Identified, band(&|_| 0.0)),
                Series::line("CAD, fitted", Ink::Fitted, errors(&curve.cad_fitted)),
                Series::line("identified", Ink::Identified, errors(&curve.identified)),
            ],
        ),
    ]
}

fn residuals(outcome: &Outcome) -> Option<String> {
    let mut body = Vec::new();
    let mut tables = Vec::new();
    for log in &outcome.logs {
        for sensor in &log.sensors {
            let mut table = Table::new(
                &format!(
                    "{}, {}: RMS of what it reads less what is predicted, and how often it reads what lies within the stated 95 % interval",
                    sensor.name, log.file
                ),
                &[&["channel"], &ERRORS[..], &["within 95 %"]].concat(),
            );
            let Three {
                cad,
                cad_fitted,
                identified,
            } = &sensor.rms;
            for (i, (channel, unit)) in WRENCH.iter().enumerate() {
                let mut cells = vec![format!("{channel}\u{a0}[{unit}]").into()];
                let three = Three {
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
    let count: usize = outcome.logs.iter().map(|l| l.spectra.len().min(CURVES)).sum();
    let most = (SPECTRUM_POINTS / (2 * count.max(1))).clamp(40, 300);
    for log in &outcome.logs {
        let plots: Vec<Plot> = log.spectra.iter().take(CURVES).map(|s| spectrum(s, most)).collect();
        if !plots.is_empty() {
            body.push(report::folded(
                &format!("Power spectra of the residuals, {}: {}", log.file, counted(plots.len(), "plot")),
                false,
                &[
                    report::paragraph("A peak that identification does not lower is no matter of inertial parameters: vibration, friction, a time offset, mains."),
                    report::figures(&plots),
                ],
            ));
        }
    }
    let mut noise = Table::new(
        "Noise of each channel, from what no parameter explains. With a long memory (autocorrelation) a channel tells less than its deviation promises, and is weighted so.",
        &["channel", "unit", "deviation", "memory [s]", "drift [unit/√s]"],
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

fn spectrum(spectrum: &Spectrum, most: usize) -> Plot {
    // Frequency 0 has no place on a logarithmic axis.
    let points = |y: &[f64]| {
        spectrum
            .frequency
            .iter()
            .copied()
            .zip(y.iter().copied())
            .filter(|(f, _)| *f > 0.0)
            .collect::<Vec<_>>()
    };
    Plot {
        title: spectrum.name.clone(),
        x: Axis::log("frequency [Hz]"),
        y: Axis::log("[unit²/Hz]"),
        series: vec![
            Series::line("CAD, fitted", Ink::Fitted, points(&spectrum.cad_fitted)),
            Series::line("identified", Ink::Identified, points(&spectrum.identified)),
        ],
        most,
        ..Plot::default()
    }
}

fn parameters(outcome: &Outcome) -> Option<String> {
    let mut body = Vec::new();
    let units = ["kg", "kg m", "kg m^2"];
    let of_unit = |unit: &str| -> Vec<(usize, &BaseParameterOutcome)> {
        outcome
            .base_parameters
            .iter()
            .enumerate()
            .filter(|(_, b)| b.unit == unit)
            .map(|(i, b)| (i + 1, b))
            .collect()
    };
    let plots: Vec<Plot> = units
        .iter()
        .map(|unit| (unit, of_unit(unit)))
        .filter(|(_, some)| !some.is_empty())
        .map(|(unit, some)| base_plot(unit, &some))
        .chain((!outcome.base_parameters.is_empty()).then(|| change_plot(&outcome.base_parameters)))
        .collect();
    if !plots.is_empty() {
        body.push(report::paragraph(
            "Base parameters: the combinations of inertial parameters that can show in what is measured, numbered as in the table below. Bars are two standard deviations; \
             where a bar spans the CAD's value, the logs give no reason to doubt it.",
        ));
        body.push(report::figures(&plots));
        let row = |(i, b): (usize, &BaseParameterOutcome)| -> Vec<Cell> {
            vec![
                Cell::Text((i + 1).to_string()),
                b.expression.as_str().into(),
                unit_text(b.unit).into(),
                b.cad.into(),
                Cell::Uncertain(b.identified, b.deviation),
                Cell::Number((b.identified - b.cad).abs() / b.deviation),
            ]
        };
        let mut table = Table::new(
            "Base parameters; last the change in standard deviations",
            &["no.", "combination", "unit", "CAD", "identified", "change/σ"],
        );
        outcome
            .base_parameters
            .iter()
            .enumerate()
            .for_each(|entry| table.row(row(entry)));
        body.push(report::folded(
            &format!("All {} base parameters", outcome.base_parameters.len()),
            false,
            &[table.html()],
        ));
    }
    let mut links = Table::new(
        "Links that the logs reach: full parameters of bodies that can exist, nearest to CAD where the logs do not decide. Last: how far from CAD, in standard deviations (below 2: not at all)",
        &[
            "link",
            "mass CAD [kg]",
            "mass [kg]",
            "centre of mass CAD [mm]",
            "centre of mass [mm]",
            "from CAD",
        ],
    );
    for link in outcome.links.iter().filter(|l| l.seen) {
        let centre = |body: &proprio_estimator::spatial::RigidInertia| -> Cell {
            if body.mass > 0.0 {
                let [x, y, z] =
                    [0, 1, 2].map(|i| format!("{:.1}", body.first_moment[i] / body.mass * 1e3).replace('-', "−"));
                format!("{x}, {y}, {z}").into()
            } else {
                "–".into()
            }
        };
        links.row(vec![
            link.name.as_str().into(),
            link.cad.mass.into(),
            Cell::Uncertain(link.identified.mass, link.deviation[0]),
            centre(&link.cad),
            centre(&link.identified),
            link.significance.into(),
        ]);
    }
    body.push(links.html());
    let floored: Vec<&str> = outcome
        .links
        .iter()
        .filter(|l| l.floored.is_some())
        .map(|l| l.name.as_str())
        .collect();
    if !floored.is_empty() {
        body.push(report::paragraph(&format!(
            "The CAD's inertia of {} is that of no body that can exist, or next to nothing; identification started from the nearest body with some mass and extent.",
            floored.join(", ")
        )));
    }
    let untouched = outcome.links.iter().filter(|l| !l.seen).count();
    if untouched > 0 {
        body.push(report::paragraph(&format!(
            "What the logs reach ends there: {} the CAD's parameters.",
            if untouched == 1 {
                "one other link keeps".to_owned()
            } else {
                format!("{untouched} other links keep")
            }
        )));
    }
    (!plots.is_empty() || !links.is_empty()).then(|| report::section("Parameters", &body))
}

fn unit_text(unit: &str) -> String {
    unit.replace("^2", "²")
}

fn base_plot(unit: &str, some: &[(usize, &BaseParameterOutcome)]) -> Plot {
    let (first, last) = (some.first().map_or(0, |s| s.0), some.last().map_or(0, |s| s.0));
    let cad = some
        .iter()
        .map(|(i, b)| (*i as f64 - 0.15, b.cad, f64::NAN, f64::NAN))
        .collect();
    let identified = some
        .iter()
        .map(|(i, b)| {
            (
                *i as f64 + 0.15,
                b.identified,
                b.identified - 2.0 * b.deviation,
                b.identified + 2.0 * b.deviation,
            )
        })
        .collect();
    let mut x = Axis::new("number of the base parameter");
    x.range = Some((first as f64 - 0.7, last as f64 + 0.7));
    Plot {
        title: match unit {
            "kg" => "Masses".into(),
            "kg m" => "First moments".into(),
            _ => "Moments of inertia".into(),
        },
        x,
        y: Axis::new(&format!("[{}]", unit_text(unit))),
        series: vec![
            Series::dots("CAD", Ink::Cad, cad),
            Series::dots("identified ± 2σ", Ink::Identified, identified),
        ],
        ..Plot::default()
    }
}

/// Small parameters are lost beside large ones: all of them by how certain they are.
fn change_plot(all: &[BaseParameterOutcome]) -> Plot {
    let mut x = Axis::new("number of the base parameter");
    let (from, to) = (0.3, all.len() as f64 + 0.7);
    x.range = Some((from, to));
    let change = |b: &BaseParameterOutcome| (b.identified - b.cad) / b.deviation;
    let dots = (1..)
        .zip(all)
        .map(|(i, b): (u32, _)| (f64::from(i), change(b), f64::NAN, f64::NAN));
    Plot {
        title: "Change from CAD".into(),
        note: "in standard deviations".into(),
        x,
        y: Axis::new("change / σ"),
        series: vec![
            Series::band(
                "no reason to doubt the CAD",
                Ink::Cad,
                vec![(from, -2.0, 2.0), (to, -2.0, 2.0)],
            ),
            Series::dots("identified", Ink::Identified, dots.collect()),
        ],
        ..Plot::default()
    }
}

fn excitation(outcome: &Outcome) -> Option<String> {
    let mut body = Vec::new();
    let values = &outcome.singular_values;
    if !values.is_empty() {
        let dots = values
            .iter()
            .enumerate()
            .map(|(i, v)| (i as f64 + 1.0, *v, f64::NAN, f64::NAN))
            .collect();
        let mut x = Axis::new("number of the combination, best shown first");
        x.range = Some((0.3, values.len() as f64 + 0.7));
        body.push(report::paragraph(&format!(
            "Each dot is one combination of parameters: above 1 the logs decide about it, below 1 the CAD does. {} of {} that the robot's structure lets show were shown; condition {}.",
            outcome.rank,
            outcome.structural_rank,
            number(outcome.condition)
        )));
        body.push(report::figures(&[Plot {
            title: "Excitation spectrum".into(),
            note: "singular values, relative to the prior's spread".into(),
            x,
            y: Axis::log("singular value"),
            series: vec![
                Series::line("", Ink::Fitted, vec![(0.3, 1.0), (values.len() as f64 + 0.7, 1.0)]),
                Series::dots("", Ink::Identified, dots),
            ],
            ..Plot::default()
        }]));
    }
    let weak = |range: std::ops::Range<usize>| {
        let mut table = Table::new(
            "What the motion shows least, worst first, and how much of its uncertainty is the CAD's",
            &["combination", "relative excitation", "left to CAD"],
        );
        for w in outcome
            .weakest
            .get(range.start.min(outcome.weakest.len())..range.end.min(outcome.weakest.len()))
            .unwrap_or_default()
        {
            table.row(vec![
                w.expression.as_str().into(),
                w.relative.into(),
                Cell::Bar(percent(w.prior_share), w.prior_share, Ink::Fitted),
            ]);
        }
        table
    };
    body.push(weak(0..LISTED).html());
    let rest = weak(LISTED..usize::MAX);
    if !rest.is_empty() {
        body.push(report::folded("More weak directions", false, &[rest.html()]));
    }
    if !outcome.confused.is_empty() {
        body.push(format!(
            "<h3>What this motion can not tell apart</h3>{}",
            report::list(outcome.confused.iter().map(|text| sentence(text)))
        ));
        body.push(report::paragraph(
            "As long as the robot moves as in these logs, torques do not depend on how these are shared out; they do when it moves otherwise (a tilted base, for example), and their \
             standard deviation says so then.",
        ));
    }
    body.retain(|part| !part.is_empty());
    (!body.is_empty()).then(|| report::section("What the motion shows", &body))
}

/// What was found of a sensor's calibration: a row for each number.
fn calibration(c: &CalibrationOutcome) -> Table {
    let since = c.identified.reference().map_or(String::new(), |celsius| {
        format!("; the change per kelvin counts from {celsius:.1} °C")
    });
    let mut table = Table::new(
        &format!(
            "{}: calibration in place: the wrench is (1 + error) times the reading as the workbench corrects it{since}",
            c.sensor
        ),
        &["what", "found", "± before any log"],
    );
    let word = |channel: usize| WRENCH[swapped(channel)].0;
    for (((unknown, error), deviation), prior) in c.kind.unknowns().zip(&c.error).zip(&c.deviation).zip(&c.prior) {
        let (what, factor) = match unknown {
            Unknown::Gain { channel, of } if channel == of => {
                (format!("error of the gain of {} [%]", word(channel)), 100.0)
            }
            Unknown::Gain { channel, of } => {
                let unit = |channel: usize| WRENCH[swapped(channel)].1;
                (
                    format!("{} of {} [{}/{}]", word(channel), word(of), unit(channel), unit(of)),
                    1.0,
                )
            }
            Unknown::Temperature { channel } => (
                format!("{} by temperature [{}/K]", word(channel), WRENCH[swapped(channel)].1),
                1.0,
            ),
        };
        table.row(vec![
            what.into(),
            Cell::Uncertain(factor * error, factor * deviation),
            (factor * prior).into(),
        ]);
    }
    table
}

/// What is no link's: time, rotors and calibrations, which are the robot's; offsets and friction, which belong to a log.
fn sessions(outcome: &Outcome) -> Option<String> {
    let mut body = Vec::new();
    let mut times = Table::new(
        "Time offset of each stream against the encoders; late is positive",
        &["channel", "offset [ms]", ""],
    );
    for o in &outcome.time_offsets {
        times.row(vec![
            o.channel.as_str().into(),
            Cell::Uncertain(o.seconds * 1e3, o.deviation * 1e3),
            if o.significant {
                "more than chance"
            } else {
                "may be chance"
            }
            .into(),
        ]);
    }
    body.push(times.html());
    let mut rotors = Table::new(
        "Inertia of the motors' rotors, reflected to the joints: measured torque = torque + rotor inertia · acceleration + friction; the robot's, the same in all logs",
        &["joint", "rotor inertia [kg m², kg where it slides]"],
    );
    for r in &outcome.rotors {
        rotors.row(vec![r.joint.as_str().into(), Cell::Uncertain(r.inertia, r.deviation)]);
    }
    if !rotors.is_empty() {
        body.push(rotors.html());
    }
    for c in &outcome.calibrations {
        body.push(calibration(c).html());
    }
    for log in &outcome.logs {
        let mut offsets = Table::new(
            &format!("{}: offsets of the F/T sensors: what they read with no load", log.file),
            &[
                "channel",
                "unit",
                "at the start",
                "at the end",
                "rate [unit/√s]",
                "started afresh at [s]",
            ],
        );
        for o in &log.offsets {
            let breaks: Vec<String> = o.breaks.iter().map(|t| short((*t - log.span.0).seconds())).collect();
            for (i, (channel, unit)) in WRENCH.iter().enumerate() {
                offsets.row(vec![
                    format!("{} {channel}", o.sensor).into(),
                    (*unit).into(),
                    o.start[i].into(),
                    Cell::Uncertain(o.end[i], o.deviation[i]),
                    o.rate[i].into(),
                    breaks.join(", ").into(),
                ]);
            }
        }
        let mut friction = Table::new(
            &format!(
                "{}: friction of the joints: coulomb · tanh(velocity / 0.02 rad/s) + viscous · velocity + offset",
                log.file
            ),
            &["joint", "Coulomb [Nm]", "viscous [Nm s/rad]", "offset [Nm]"],
        );
        for f in &log.friction {
            friction.row(vec![
                f.joint.as_str().into(),
                Cell::Uncertain(f.coulomb_nm, f.deviation[0]),
                Cell::Uncertain(f.viscous, f.deviation[1]),
                Cell::Uncertain(f.offset_nm, f.deviation[2]),
            ]);
        }
        let tables: Vec<String> = [offsets, friction]
            .iter()
            .filter(|t| !t.is_empty())
            .map(Table::html)
            .collect();
        if !tables.is_empty() {
            body.push(report::folded(
                &format!("Offsets and friction: {}", log.file),
                false,
                &tables,
            ));
        }
    }
    body.retain(|part| !part.is_empty());
    (!body.is_empty()).then(|| report::section("Offsets, friction and time, log by log", &body))
}

fn how_to_read() -> String {
    report::section(
        "How to read this",
        &[report::list([
            "CAD as configured: the URDF's inertial parameters and the offsets that estimator.toml states, without friction.",
            "CAD, fitted: the same parameters, but offsets (which may drift) and friction fitted to the log. This is what identified parameters must beat.",
            "Identified: parameters fitted to the training logs; offsets and friction fitted to each log in the same way as for the CAD.",
            "σ: standard deviation of the prediction, from the uncertainty of the parameters and the noise of the measurement. About 95 % of what was measured should lie within ± 2σ.",
            "tau: how far the CAD is from the robot, relatively, as the logs tell; the CAD is trusted accordingly. 0: it is exact; 1: nothing but a rough guess.",
        ])],
    )
}

#[cfg(test)]
mod tests {
    use super::super::example;
    use super::*;
    use std::path::Path;
    use std::process::Command;

    fn made(outcome: &Outcome) -> String {
        page(outcome, &Advice::of(outcome))
    }

    #[test]
    fn every_part_of_an_outcome_is_on_the_page() {
        let html = made(&example::outcome());
        for part in [
            "Identification of icub_legs",
            "Accept with care",
            "2.35 %",
            "6.40 %",
            "jumps by 20.1 N",
            "walk_2.csv",
            "onset of motion",
            "Excitation spectrum",
            "First moments",
            "r_lower_leg.I_xx + r_ankle_1.I_yy",
            "contact declared: right_foot",
            "Coulomb [Nm]",
            "r_leg_ft_sensor fx",
            "96.8 %",
            "nothing turned about a horizontal axis",
        ] {
            assert!(html.contains(part), "the page does not say {part:?}");
        }
        assert!(
            !html.contains("NaN") && !html.contains("inf"),
            "a number that is not one"
        );
        assert!(html.len() < 1_000_000, "{} bytes", html.len());
    }

    #[test]
    fn a_report_on_many_joints_stays_small() {
        let mut outcome = example::outcome();
        outcome.logs = vec![
            outcome.logs[0].clone(),
            outcome.logs[1].clone(),
            outcome.logs[0].clone(),
        ];
        for log in &mut outcome.logs {
            log.curves = (0..80)
                .map(|i| Curve {
                    name: format!("joint {i}"),
                    ..log.curves[0].clone()
                })
                .collect();
            log.spectra = vec![log.spectra[0].clone(); 80];
        }
        let html = made(&outcome);
        assert!(html.len() < 2_000_000, "{} bytes", html.len());
        assert!(html.contains("80 curves of this log are left out"));
    }

    #[test]
    fn nothing_identified_is_told_first() {
        let html = made(&example::nothing());
        let told = html
            .find("Nothing was identified: no joint moved in any log.")
            .expect("the reason");
        assert!(html.find("<figure>").is_none_or(|figure| told < figure));
        assert!(html.contains("record the robot moving") && !html.contains("NaN"));
    }

    /// What a real browser finds wrong with pages; nothing if none is at hand.
    fn browse(pages: &[(&str, &str)]) -> Option<String> {
        let folder = tempfile::tempdir().unwrap();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/browser/check.py");
        let mut command = Command::new("python3");
        command.arg(script);
        for (name, html) in pages {
            let file = folder.path().join(format!("{name}.html"));
            std::fs::write(&file, html).unwrap();
            command.arg(file);
        }
        // To look at them oneself.
        if let Some(pictures) = std::env::var_os("PROPRIO_SCREENSHOTS") {
            command.arg("--screenshots").arg(pictures);
        }
        let ran = match command.output() {
            Ok(ran) => ran,
            Err(error) => {
                println!("skipped: python3: {error}");
                return None;
            }
        };
        let said = String::from_utf8_lossy(&ran.stdout) + String::from_utf8_lossy(&ran.stderr);
        match ran.status.code() {
            Some(3) => {
                println!("skipped: {said}");
                None
            }
            Some(code @ (0 | 1)) => {
                assert_eq!(code == 0, said.is_empty(), "{said}");
                Some(said.into_owned())
            }
            code => panic!("{code:?}: {said}"),
        }
    }

    #[test]
    fn a_browser_shows_it_without_fault() {
        let (identified, nothing) = (made(&example::outcome()), made(&example::nothing()));
        if let Some(faults) = browse(&[("identified", &identified), ("nothing", &nothing)]) {
            assert_eq!(faults, "");
        }
    }

    #[test]
    fn a_browser_finds_what_is_wrong() {
        let wrong = report::page(
            "wrong",
            &[
                "<p style=\"width:2000px\">wide</p><p style=\"font-size:6px\">small</p><figure></figure>\
               <img src=\"http://127.0.0.1:9/x.png\" alt=\"\"><script>console.error('broken')</script>"
                    .to_owned(),
            ],
        );
        if let Some(faults) = browse(&[("wrong", &wrong)]) {
            for fault in [
                "px wide",
                "smaller than 10 px",
                "without a caption",
                "nothing is drawn",
                "asks for http",
                "broken",
            ] {
                assert!(faults.contains(fault), "{fault} is not found: {faults}");
            }
        }
    }
}
