//! What was identified: the parameters, how well the motion excites them, and what belongs to no
//! link: time offsets, rotors, calibrations, offsets and friction.

use super::words::WRENCH;
use crate::identify::advice::{percent, sentence};
use crate::report::plot::{Ink, Plot, PlotAxis, Trace};
use crate::report::{self, Cell, ReportTable, number};
use proprio_dynamics::calibration::{Unknown, swapped};
use proprio_dynamics::spatial::RigidInertia;
use proprio_identification::{BaseParameterOutcome, CalibrationOutcome, LogOutcome, Outcome};

/// Number of weak directions listed at once; the others can be unfolded.
const LISTED: usize = 12;

pub(super) fn parameters(outcome: &Outcome) -> Option<String> {
    let mut body = base_parameters(&outcome.base_parameters);
    let links = links(outcome);
    let is_worth_a_section = !body.is_empty() || !links.is_empty();
    body.push(links.html());
    let floored: Vec<&str> = outcome
        .links
        .iter()
        .filter(|l| l.floored.is_some())
        .map(|l| l.name.as_str())
        .collect();
    if !floored.is_empty() {
        body.push(report::paragraph(&format!(
            "The CAD's inertia of {} is physically inconsistent or nearly zero; identification \
             started from the nearest consistent inertia.",
            floored.join(", ")
        )));
    }
    let untouched = outcome.links.iter().filter(|l| !l.seen).count();
    if untouched > 0 {
        body.push(report::paragraph(&format!(
            "The logs do not observe {} the CAD's parameters.",
            if untouched == 1 {
                "one other link; it keeps".to_owned()
            } else {
                format!("{untouched} other links; they keep")
            }
        )));
    }
    is_worth_a_section.then(|| report::section("Parameters", &body))
}

/// Plots and a table of the base parameters; nothing without any.
fn base_parameters(all: &[BaseParameterOutcome]) -> Vec<String> {
    if all.is_empty() {
        return Vec::new();
    }
    let of_unit = |unit: &str| -> Vec<(usize, &BaseParameterOutcome)> {
        let numbered = (1..).zip(all);
        numbered.filter(|(_, b)| b.unit == unit).collect()
    };
    let plots: Vec<Plot> = ["kg", "kg m", "kg m^2"]
        .map(|unit| (unit, of_unit(unit)))
        .into_iter()
        .filter(|(_, some)| !some.is_empty())
        .map(|(unit, some)| base_plot(unit, &some))
        .chain([change_plot(all)])
        .collect();
    let mut table = ReportTable::new(
        "Base parameters; last column: change from the CAD in standard deviations",
        &[
            "no.",
            "combination",
            "unit",
            "CAD",
            "identified",
            "change/σ",
        ],
    );
    for (number, b) in (1_u32..).zip(all) {
        table.row(vec![
            Cell::Text(number.to_string()),
            b.expression.as_str().into(),
            unit_text(b.unit).into(),
            b.cad.into(),
            Cell::Uncertain(b.identified, b.deviation),
            Cell::Number((b.identified - b.cad).abs() / b.deviation),
        ]);
    }
    vec![
        report::paragraph(
            "Base parameters: the combinations of inertial parameters that the measurements depend \
             on, numbered as in the table below. Bars are two standard deviations; where a bar \
             spans the CAD's value, the logs do not contradict it.",
        ),
        report::figures(&plots),
        report::folded(
            &format!("All {} base parameters", all.len()),
            false,
            &[table.html()],
        ),
    ]
}

/// Masses and centres of mass of the links that the logs observe.
fn links(outcome: &Outcome) -> ReportTable {
    let mut links = ReportTable::new(
        "Links that the logs observe: physically consistent parameters; directions that the \
         logs do not determine keep their CAD values. Last column: change from the CAD in standard \
         deviations (below 2: not significant)",
        &[
            "link",
            "mass CAD [kg]",
            "mass [kg]",
            "centre of mass CAD [mm]",
            "centre of mass [mm]",
            "change/σ",
        ],
    );
    let centre = |body: &RigidInertia| -> Cell {
        if body.mass > 0.0 {
            let [x, y, z] = [0, 1, 2].map(|i| {
                format!("{:.1}", body.first_moment[i] / body.mass * 1e3).replace('-', "−")
            });
            format!("{x}, {y}, {z}").into()
        } else {
            "–".into()
        }
    };
    for link in outcome.links.iter().filter(|l| l.seen) {
        links.row(vec![
            link.name.as_str().into(),
            link.cad.mass.into(),
            Cell::Uncertain(link.identified.mass, link.deviation[0]),
            centre(&link.cad),
            centre(&link.identified),
            link.significance.into(),
        ]);
    }
    links
}

fn unit_text(unit: &str) -> String {
    unit.replace("^2", "²")
}

fn base_plot(unit: &str, some: &[(usize, &BaseParameterOutcome)]) -> Plot {
    let (first, last) = (
        some.first().map_or(0, |s| s.0),
        some.last().map_or(0, |s| s.0),
    );
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
    let range = (first as f64 - 0.7, last as f64 + 0.7);
    Plot {
        title: match unit {
            "kg" => "Masses".into(),
            "kg m" => "First moments".into(),
            _ => "Moments of inertia".into(),
        },
        x: PlotAxis::within("number of the base parameter", range),
        y: PlotAxis::new(&format!("[{}]", unit_text(unit))),
        series: vec![
            Trace::dots("CAD", Ink::Cad, cad),
            Trace::dots("identified ± 2σ", Ink::Identified, identified),
        ],
        ..Plot::default()
    }
}

/// Small parameters vanish beside large ones; in standard deviations all are comparable.
fn change_plot(all: &[BaseParameterOutcome]) -> Plot {
    let (from, to) = (0.3, all.len() as f64 + 0.7);
    let change = |b: &BaseParameterOutcome| (b.identified - b.cad) / b.deviation;
    let dots = (1..)
        .zip(all)
        .map(|(i, b): (u32, _)| (f64::from(i), change(b), f64::NAN, f64::NAN));
    Plot {
        title: "Change from CAD".into(),
        note: "in standard deviations".into(),
        x: PlotAxis::within("number of the base parameter", (from, to)),
        y: PlotAxis::new("change / σ"),
        series: vec![
            Trace::band(
                "not significant",
                Ink::Cad,
                vec![(from, -2.0, 2.0), (to, -2.0, 2.0)],
            ),
            Trace::dots("identified", Ink::Identified, dots.collect()),
        ],
        ..Plot::default()
    }
}

pub(super) fn excitation(outcome: &Outcome) -> Option<String> {
    let mut body = Vec::new();
    let values = &outcome.singular_values;
    if !values.is_empty() {
        let dots = values
            .iter()
            .enumerate()
            .map(|(i, v)| (i as f64 + 1.0, *v, f64::NAN, f64::NAN))
            .collect();
        let (from, to) = (0.3, values.len() as f64 + 0.7);
        body.push(report::paragraph(&format!(
            "Each dot is one combination of parameters. The logs determine those above 1; those \
             below 1 keep their CAD values. {} are above 1. The robot's structure makes {} \
             identifiable by a rich enough motion. Condition number: {}.",
            values.iter().filter(|v| **v > 1.0).count(),
            outcome.structural_rank,
            number(outcome.condition)
        )));
        body.push(report::figures(&[Plot {
            title: "Excitation spectrum".into(),
            note: "singular values, relative to the prior standard deviation".into(),
            x: PlotAxis::within("number of the combination, best excited first", (from, to)),
            y: PlotAxis::log("singular value"),
            series: vec![
                Trace::line("", Ink::Fitted, vec![(from, 1.0), (to, 1.0)]),
                Trace::dots("", Ink::Identified, dots),
            ],
            ..Plot::default()
        }]));
    }
    let weak = |range: std::ops::Range<usize>| {
        let mut table = ReportTable::new(
            "Least excited combinations, worst first, and the share of their variance that is the \
             prior's",
            &["combination", "relative excitation", "prior's share"],
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
        body.push(report::folded(
            "More weak directions",
            false,
            &[rest.html()],
        ));
    }
    if !outcome.not_separable.is_empty() {
        body.push(format!(
            "<h3>Not separable with this motion</h3>{}",
            report::list(outcome.not_separable.iter().map(|text| sentence(text)))
        ));
        body.push(report::paragraph(
            "While the robot moves as in these logs, torques do not depend on how each sum is \
             divided. With another motion (a tilted base, for example) they do, and their standard \
             deviation grows accordingly.",
        ));
    }
    body.retain(|part| !part.is_empty());
    (!body.is_empty()).then(|| report::section("Excitation by the motion", &body))
}

/// The calibration of a sensor, a row for each identified number.
fn calibration(c: &CalibrationOutcome) -> ReportTable {
    let since = c.identified.reference().map_or(String::new(), |celsius| {
        format!("; the change per kelvin counts from {celsius:.1} °C")
    });
    let mut table = ReportTable::new(
        &format!(
            "{}: calibration in the robot: the wrench is (1 + error) times the reading after the \
             factory calibration{since}",
            c.sensor
        ),
        &["quantity", "identified", "prior σ"],
    );
    let word = |channel: usize| WRENCH[swapped(channel)].0;
    for (((unknown, error), deviation), prior) in c
        .kind
        .unknowns()
        .zip(&c.error)
        .zip(&c.deviation)
        .zip(&c.prior)
    {
        let (what, factor) = match unknown {
            Unknown::Gain { channel, of } if channel == of => {
                (format!("error of the gain of {} [%]", word(channel)), 100.0)
            }
            Unknown::Gain { channel, of } => {
                let unit = |channel: usize| WRENCH[swapped(channel)].1;
                (
                    format!(
                        "{} of {} [{}/{}]",
                        word(channel),
                        word(of),
                        unit(channel),
                        unit(of)
                    ),
                    1.0,
                )
            }
            Unknown::Temperature { channel } => (
                format!(
                    "{} by temperature [{}/K]",
                    word(channel),
                    WRENCH[swapped(channel)].1
                ),
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

/// Time offsets, rotors and calibrations, which belong to the robot; offsets and friction, which
/// belong to a log.
pub(super) fn sessions(outcome: &Outcome) -> Option<String> {
    let mut times = ReportTable::new(
        "Time offset of each stream against the encoders; late is positive",
        &["channel", "offset [ms]", ""],
    );
    for o in &outcome.time_offsets {
        times.row(vec![
            o.channel.as_str().into(),
            Cell::Uncertain(o.seconds * 1e3, o.deviation * 1e3),
            if o.significant {
                "significant"
            } else {
                "not significant"
            }
            .into(),
        ]);
    }
    let mut rotors = ReportTable::new(
        "Rotor inertias, reflected to the joints; the same in all logs: measured torque = torque + \
         rotor inertia · acceleration + friction",
        &["joint", "rotor inertia [kg m², kg where it slides]"],
    );
    for r in &outcome.rotors {
        rotors.row(vec![
            r.joint.as_str().into(),
            Cell::Uncertain(r.inertia, r.deviation),
        ]);
    }
    let mut body = vec![times.html(), rotors.html()];
    body.extend(outcome.calibrations.iter().map(|c| calibration(c).html()));
    for log in &outcome.logs {
        let tables = report::tables([offsets(log), friction(log)]);
        if !tables.is_empty() {
            let title = format!("Offsets and friction: {}", log.file);
            body.push(report::folded(&title, false, &tables));
        }
    }
    body.retain(|part| !part.is_empty());
    (!body.is_empty()).then(|| report::section("Offsets, friction and time, log by log", &body))
}

fn offsets(log: &LogOutcome) -> ReportTable {
    let mut offsets = ReportTable::new(
        &format!(
            "{}: offsets of the F/T sensors (their reading without load)",
            log.file
        ),
        &[
            "channel",
            "unit",
            "at the start",
            "at the end",
            "rate [unit/√s]",
        ],
    );
    for o in &log.offsets {
        for (i, (channel, unit)) in WRENCH.iter().enumerate() {
            offsets.row(vec![
                format!("{} {channel}", o.sensor).into(),
                (*unit).into(),
                o.start[i].into(),
                Cell::Uncertain(o.end[i], o.deviation[i]),
                o.rate[i].into(),
            ]);
        }
    }
    offsets
}

fn friction(log: &LogOutcome) -> ReportTable {
    let mut friction = ReportTable::new(
        &format!(
            "{}: friction of the joints: coulomb · tanh(velocity / 0.02 rad/s) + viscous · \
             velocity + offset",
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
    friction
}
