//! Plots the on-line identification: parameters and offsets over the solutions, with their true
//! values.

use super::compared::AlignedRun;
use crate::demo::experiment::{Experiment, Link};
use crate::demo::watching::ReceivedRun;
use crate::report::plot::{Ink, Plot, PlotAxis, Trace};
use crate::report::{self, Cell, ReportTable};
use proprio_identification::robot::AXES;

/// Names and units of a link's ten parameters.
const PARAMETERS: [(&str, &str); 10] = [
    ("mass m", "kg"),
    ("first moment m c_x", "kg m"),
    ("first moment m c_y", "kg m"),
    ("first moment m c_z", "kg m"),
    ("inertia I_xx", "kg m²"),
    ("inertia I_xy", "kg m²"),
    ("inertia I_xz", "kg m²"),
    ("inertia I_yy", "kg m²"),
    ("inertia I_yz", "kg m²"),
    ("inertia I_zz", "kg m²"),
];
/// Number of link parameters that are plotted: those that the data determine best.
const DRAWN: usize = 8;

/// One identified number over the solutions.
pub(super) struct Convergence {
    title: String,
    unit: &'static str,
    /// Instant \[s\], value, standard deviation.
    points: Vec<(f64, f64, f64)>,
    cad: f64,
    truth: f64,
}

impl Convergence {
    /// The relative reduction of its standard deviation.
    fn reduction(&self) -> f64 {
        match (self.points.first(), self.points.last()) {
            (Some((_, _, first)), Some((_, _, last))) if *first > 0.0 => last / first,
            _ => f64::INFINITY,
        }
    }

    /// Whether the last value is within two standard deviations of the truth.
    pub(super) fn is_within_2_sigma(&self) -> bool {
        self.points
            .last()
            .is_some_and(|(_, value, deviation)| (value - self.truth).abs() <= 2.0 * deviation)
    }

    fn plot(&self, compared: &AlignedRun) -> Plot {
        let ends = [self.points.first(), self.points.last()];
        let level = |value: f64| ends.iter().flatten().map(|(t, ..)| (*t, value)).collect();
        let band = self
            .points
            .iter()
            .map(|(t, x, s)| (*t, x - 2.0 * s, x + 2.0 * s));
        let line = self.points.iter().map(|(t, x, _)| (*t, *x));
        let mut series = vec![Trace::band("± 2σ", Ink::Identified, band.collect())];
        if self.cad.is_finite() {
            series.push(Trace::line("CAD", Ink::Cad, level(self.cad)));
        }
        series.push(Trace::line("truth", Ink::Measured, level(self.truth)));
        series.push(Trace::line("identified", Ink::Identified, line.collect()));
        Plot {
            title: self.title.clone(),
            x: PlotAxis::new("t [s]"),
            y: PlotAxis::new(&format!("[{}]", self.unit)),
            series,
            marks: vec![(compared.time(compared.moving), "onset of motion".to_owned())],
            ..Plot::default()
        }
    }
}

/// The links' parameters and the sensors' offsets over the solutions.
pub(super) fn courses(
    experiment: &Experiment,
    watched: &ReceivedRun,
    compared: &AlignedRun,
) -> (Vec<Convergence>, Vec<Convergence>) {
    let (mut parameters, mut offsets) = (vec![], vec![]);
    let Some(last) = watched.learnt.last() else {
        return (parameters, offsets);
    };
    let find = |links: &[Link], name: &str| {
        links
            .iter()
            .find(|(n, _)| n == name)
            .map(|(_, values)| *values)
    };
    for (index, link) in last.links.iter().enumerate() {
        let name = link.name.as_str();
        let (Some(truth), Some(cad)) = (find(&experiment.truth, name), find(&experiment.cad, name))
        else {
            continue;
        };
        for (i, ((symbol, unit), (truth, cad))) in PARAMETERS
            .into_iter()
            .zip(truth.into_iter().zip(cad))
            .enumerate()
        {
            let points = watched.learnt.iter().filter_map(|learnt| {
                let link = learnt.links.get(index)?;
                Some((
                    compared.time(learnt.t),
                    *link.parameters.get(i)?,
                    *link.standard_deviation.get(i)?,
                ))
            });
            parameters.push(Convergence {
                title: format!("{name}: {symbol}"),
                unit,
                points: points.collect(),
                cad,
                truth,
            });
        }
    }
    for (index, offset) in last.offsets.iter().enumerate() {
        let name = offset.name.as_str();
        let Some((_, truth)) = experiment.offsets.iter().find(|(n, _)| n == name) else {
            continue;
        };
        for (i, (part, truth)) in AXES.into_iter().zip(truth).enumerate() {
            let points = watched.learnt.iter().filter_map(|learnt| {
                let offset = learnt.offsets.get(index)?;
                let value = offset.force.iter().chain(&offset.torque).nth(i)?;
                Some((
                    compared.time(learnt.t),
                    *value,
                    *offset.standard_deviation.get(i)?,
                ))
            });
            offsets.push(Convergence {
                title: format!("{name}: {part}"),
                unit: if i < 3 { "N" } else { "Nm" },
                points: points.collect(),
                cad: f64::NAN,
                truth: *truth,
            });
        }
    }
    (parameters, offsets)
}

/// Figure 4 of the paper: the identified parameters over time.
pub(super) fn learnt_section(
    parameters: &[Convergence],
    offsets: &[Convergence],
    compared: &AlignedRun,
) -> String {
    let Some(course) = parameters.first().or(offsets.first()) else {
        return String::new();
    };
    let updates = course.points.len();
    let mut best: Vec<&Convergence> = parameters.iter().collect();
    best.sort_by(|a, b| a.reduction().total_cmp(&b.reduction()));
    best.truncate(DRAWN);
    let mut masses = ReportTable::new(
        "Masses of the links beyond the F/T sensor [kg]. Forces determine certain sums of \
         neighbouring links' parameters much better than each parameter, as its standard deviation \
         shows.",
        &["link", "truth", "CAD", "identified"],
    );
    for mass in parameters.iter().step_by(PARAMETERS.len()) {
        if let Some((_, value, deviation)) = mass.points.last() {
            let name = mass.title.split(':').next().unwrap_or_default();
            masses.row(vec![
                name.into(),
                mass.truth.into(),
                mass.cad.into(),
                Cell::Uncertain(*value, *deviation),
            ]);
        }
    }
    let plots = |courses: &[&Convergence]| -> Vec<Plot> {
        courses.iter().map(|course| course.plot(compared)).collect()
    };
    report::section(
        "Identified parameters",
        &[
            report::paragraph(&format!(
                "Identification updated the inertial parameters and the F/T offsets once a second, \
                 {updates} times. Drawn are the parameters whose standard deviation fell most, \
                 then the offsets of the sensors."
            )),
            report::figures(&plots(&best)),
            masses.html(),
            report::folded(
                "The sensors' offsets",
                false,
                &[report::figures(&plots(&offsets.iter().collect::<Vec<_>>()))],
            ),
        ],
    )
}

#[cfg(test)]
impl Convergence {
    /// A number whose last value and standard deviation are these.
    pub(super) fn ending(value: f64, deviation: f64, truth: f64) -> Self {
        Self {
            title: String::new(),
            unit: "",
            points: vec![(0.0, truth, 1e-9), (1.0, value, deviation)],
            cad: f64::NAN,
            truth,
        }
    }
}
