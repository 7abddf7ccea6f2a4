//! Whether what a log gives as an F/T sensor's reading is in newtons and newton metres. Asked before anything is fitted.
//!
//! What CAD says of a reading's changes is roughly right, however wrong its masses are. Both, the reading and the prediction, lose their means (an offset may be anything), and are compared, forces
//! and torques each by themselves:
//!
//! - 30 times as much while the two go together (correlation above 0.7 either way), or less than a thirtieth: no newtons, or no newton metres. The log is refused;
//! - more than 3 times, or less than a third, while they go together: said. Kilograms of force look so, and a URDF whose masses are wrong by that.

use super::assess::{laid_to, sensor_name};
use super::batch::Prepared;
use super::dot;
use super::outcome::{Finding, Severity};
use super::rows::{RowMaker, Rows};
use nalgebra::DVector;

/// Instants that are looked at, at most; and in a stretch of constant offset at least.
const ENOUGH: usize = 2000;
const LEAST: usize = 50;

/// A reading so many times what CAD says, or as many times less, is none in newtons; one so many times is said.
const FACTOR: f64 = 30.0;
const ODD: f64 = 3.0;

/// The two go together.
const TOGETHER: f64 = 0.7;

/// What CAD predicts tells something if it changes by so many times the sensor's noise.
const TELLS: f64 = 5.0;

/// What was read and predicted, without their means.
#[derive(Default)]
struct Pairs {
    read: Vec<f64>,
    predicted: Vec<f64>,
}

impl Pairs {
    fn add(&mut self, stretch: &[(f64, f64)]) {
        let count = stretch.len() as f64;
        let (read, predicted) = stretch.iter().fold((0.0, 0.0), |(y, x), own| (y + own.0, x + own.1));
        self.read.extend(stretch.iter().map(|own| own.0 - read / count));
        self.predicted
            .extend(stretch.iter().map(|own| own.1 - predicted / count));
    }

    fn compare<'a>(all: impl Iterator<Item = &'a Self> + Clone) -> Compared {
        let sum = |of: fn(&Self) -> f64| all.clone().map(of).sum::<f64>();
        let (yy, xx) = (sum(|p| dot(&p.read, &p.read)), sum(|p| dot(&p.predicted, &p.predicted)));
        let count = sum(|p| p.read.len() as f64).max(1.0);
        Compared {
            predicted: (xx / count).sqrt(),
            ratio: (yy / xx).sqrt(),
            correlation: sum(|p| dot(&p.read, &p.predicted)) / (yy * xx).sqrt().max(f64::MIN_POSITIVE),
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Compared {
    /// Root mean square of what is predicted.
    predicted: f64,
    /// What is read, of that.
    ratio: f64,
    correlation: f64,
}

impl Compared {
    fn is_too_large(&self) -> bool {
        self.ratio > FACTOR && self.correlation.abs() > TOGETHER
    }

    fn is_too_small(&self) -> bool {
        self.ratio < 1.0 / FACTOR
    }

    fn is_odd(&self) -> bool {
        !(1.0 / ODD..=ODD).contains(&self.ratio) && self.correlation > TOGETHER
    }
}

/// Looks at the units of a log's sensors, says what is wrong with them in it, and refuses it if nothing can be identified from that.
pub(super) fn check(maker: &mut RowMaker<'_>, log: &mut Prepared) {
    if log.refused {
        return;
    }
    let sensors = maker.layout().sensors.clone();
    let mut findings = Vec::new();
    for (place, pairs) in pairs(maker, log).into_iter().enumerate() {
        let noise = maker.setup().structure.sensors()[sensors[place]].noise();
        let [torque, force] = [(0..3, noise.torque), (3..6, noise.force)].map(|(axes, noise)| {
            let found = Pairs::compare(pairs[axes].iter());
            (found.predicted > TELLS * noise.into_iter().fold(0.0, f64::max)).then_some(found)
        });
        findings.extend(units(&sensor_name(maker.setup(), sensors[place]), force, torque));
    }
    // What is predicted of one sensor rests on the others of its part of the robot: who is far too large makes them look too small.
    if findings.iter().any(|found| found.code == LARGE) {
        findings.retain(|found| found.code != SMALL);
    }
    for found in &mut findings {
        if found.code == LARGE || found.code == SMALL {
            found.code = "wrong_units";
        }
    }
    log.refused = findings.iter().any(|found| found.severity == Severity::Refusal);
    log.findings.extend(findings);
}

/// Told apart until all sensors are known.
const LARGE: &str = "large";
const SMALL: &str = "small";

fn units(name: &str, force: Option<Compared>, torque: Option<Compared>) -> Option<Finding> {
    let some = |is: fn(&Compared) -> bool| force.as_ref().is_some_and(is) || torque.as_ref().is_some_and(is);
    let both = [("forces", force), ("torques", torque)];
    let told = both.iter().filter_map(|(word, own)| Some((word, own.as_ref()?.ratio)));
    let told: Vec<String> = told.map(|(word, ratio)| format!("{word} {}", times(ratio))).collect();
    let told = told.join(" and ");
    let finding = |severity, code, rest: &str| Finding {
        severity,
        code,
        subject: format!("wrench/{name}"),
        text: format!(
            "wrench/{name} does not change by what the masses of the URDF ask for, but by {told} as much: {rest}"
        ),
    };
    if some(Compared::is_too_large) {
        Some(finding(
            Severity::Refusal,
            LARGE,
            "it is in counts or thousandths (convert it to N and Nm), or the URDF's masses are not in kg",
        ))
    } else if some(Compared::is_too_small) {
        Some(finding(
            Severity::Refusal,
            SMALL,
            "its channel is dead, or it is in thousands (convert it to N and Nm), or the URDF's masses are not in kg",
        ))
    } else if some(Compared::is_odd) {
        Some(finding(
            Severity::Warning,
            "scale",
            "either its units are others (1 kgf is 9.807 N) or its calibration is wrong, and so are the parameters, or the URDF's masses are wrong by as much: weigh the robot, or hang a known mass on it",
        ))
    } else {
        None
    }
}

fn times(ratio: f64) -> String {
    match ratio {
        ratio if ratio >= 10.0 => format!("{ratio:.0} times"),
        ratio if ratio >= 1.0 => format!("{ratio:.1} times"),
        ratio if ratio > 0.0 => format!("1/{:.0}", 1.0 / ratio),
        _ => "nothing,".into(),
    }
}

/// Per sensor of the layout and axis, torques first: what was read and what CAD and the other sensors predict, from stretches in which the offset is one.
fn pairs(maker: &mut RowMaker<'_>, log: &Prepared) -> Vec<[Pairs; 6]> {
    let layout = maker.layout().clone();
    let variances = vec![1.0; layout.channels()];
    let mut pairs: Vec<[Pairs; 6]> = layout.sensors.iter().map(|_| Default::default()).collect();
    let mut open: Vec<[Vec<(f64, f64)>; 6]> = layout.sensors.iter().map(|_| Default::default()).collect();
    let close = |pairs: &mut [Pairs; 6], open: &mut [Vec<(f64, f64)>; 6]| {
        for (pairs, stretch) in pairs.iter_mut().zip(open) {
            if stretch.len() >= LEAST {
                pairs.add(stretch);
            }
            stretch.clear();
        }
    };
    let mut rows = Rows::new(&layout);
    let mut last = log.span.0;
    for instant in log.instants.iter().step_by(log.instants.len().div_ceil(ENOUGH).max(1)) {
        let made = maker.make(instant, &mut rows).is_ok();
        let residual = DVector::from_fn(rows.count, |row, _| rows.r(row));
        for (place, &sensor) in layout.sensors.iter().enumerate() {
            if log
                .breaks
                .iter()
                .any(|b| b.sensor == sensor && last < b.t && b.t <= instant.t)
            {
                close(&mut pairs[place], &mut open[place]);
            }
            let Some(map) = made
                .then(|| laid_to(&rows, &variances, 6 * place..6 * place + 6))
                .flatten()
            else {
                continue;
            };
            let off = map * &residual;
            for (channel, read) in instant.readings[sensor].torque_first().into_iter().enumerate() {
                if rows.has(6 * place + channel) && (read + off[channel]).is_finite() {
                    open[place][channel].push((read, read - off[channel]));
                }
            }
        }
        last = instant.t;
    }
    pairs
        .iter_mut()
        .zip(&mut open)
        .for_each(|(pairs, open)| close(pairs, open));
    pairs
}

#[cfg(test)]
mod tests {
    use super::super::normals;
    use super::*;

    /// What is found of a sensor whose forces are `scale` times those that CAD asks for, which is wrong by `wrong` of another motion; with noise.
    fn found(scale: f64, wrong: f64, noise: f64) -> Option<&'static str> {
        let deviates = normals(3, 1000);
        let each = deviates.iter().enumerate().map(|(i, deviate)| {
            let t = 0.05 * i as f64;
            let (x, other) = (8.0 * (0.9 * t).sin(), 8.0 * (1.7 * t + 1.0).sin());
            (300.0 + scale * (x + wrong * other + noise * deviate), x)
        });
        let mut pairs = Pairs::default();
        pairs.add(&each.collect::<Vec<_>>());
        units("ft", Some(Pairs::compare(std::iter::once(&pairs))), None).map(|f| f.code)
    }

    #[test]
    fn readings_that_are_none_are_told_from_a_wrong_model() {
        for (wrong, noise) in [(0.0, 0.01), (0.5, 1.0), (1.5, 4.0), (5.0, 10.0)] {
            assert_eq!(found(1.0, wrong, noise), None, "{wrong} {noise}");
        }
        // Cables and offsets that wander, over little motion, are not counts.
        assert_eq!(found(1.0, 60.0, 1.0), None);
        assert_eq!(found(1000.0, 0.3, 1.0), Some(LARGE));
        assert_eq!(found(-1000.0, 0.3, 1.0), Some(LARGE));
        assert_eq!(found(0.001, 0.3, 1.0), Some(SMALL));
        assert_eq!(found(0.0, 0.0, 0.0), Some(SMALL));
        for kilograms in [0.102, 9.8] {
            assert_eq!(found(kilograms, 0.3, 1.0), Some("scale"));
        }
    }
}
