//! Whether what a log gives as an F/T sensor's reading is in newtons and newton metres. Asked before anything is fitted.
//!
//! Both, the reading and what CAD predicts, lose their means (an offset may be anything), and are compared, forces and torques each by themselves. CAD may be wrong by much: a gripper that the URDF does
//! not have on a light flange is thirty times its mass. So a log is refused only for what no robot reads, while the two go together (correlation above 0.7 either way):
//!
//! - 30 times as much as predicted, and changes beyond the weight of the whole robot, at a lever of a metre: no newtons, or no newton metres;
//! - forces and torques both less than a 300th: kilonewtons.
//!
//! More than 3 times, or less than a third, is said. Kilograms of force look so, and masses that are wrong by that.

use super::assess::{laid_to, sensor_name};
use super::batch::Prepared;
use super::dot;
use super::outcome::{Finding, Severity};
use super::rows::{RowMaker, Rows};
use nalgebra::DVector;

/// Instants that are looked at, at most; and in a stretch of constant offset at least.
const ENOUGH: usize = 2000;
const LEAST: usize = 50;

/// A reading so many times what CAD says may be none in newtons; nor may one so many times less; one so many times is said.
const LARGE: f64 = 30.0;
const SMALL: f64 = 300.0;
const ODD: f64 = 3.0;

/// Of the whole robot's weight [m].
const LEVER: f64 = 1.0;

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
    /// `most`: what a robot could make it read.
    fn is_too_large(&self, most: f64) -> bool {
        self.ratio > LARGE && self.correlation.abs() > TOGETHER && self.ratio * self.predicted > most
    }

    fn is_too_small(&self) -> bool {
        self.ratio < 1.0 / SMALL && self.correlation.abs() > TOGETHER
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
    let weight = 9.80665 * maker.setup().cad().iter().map(|body| body.mass).sum::<f64>();
    let mut faults = Vec::new();
    for (place, pairs) in pairs(maker, log).into_iter().enumerate() {
        let noise = maker.setup().structure.sensors()[sensors[place]].noise();
        let [torque, force] = [(0..3, noise.torque), (3..6, noise.force)].map(|(axes, noise)| {
            let found = Pairs::compare(pairs[axes].iter());
            (found.predicted > TELLS * noise.into_iter().fold(0.0, f64::max)).then_some(found)
        });
        let fault = fault(force, torque, weight);
        faults.extend(fault.map(|fault| (fault, sensor_name(maker.setup(), sensors[place]), force, torque)));
    }
    // What is predicted of one sensor rests on the others of its part of the robot: who is far too large makes them look too small.
    if faults.iter().any(|(fault, ..)| *fault == Fault::Large) {
        faults.retain(|(fault, ..)| *fault != Fault::Small);
    }
    log.refused = faults.iter().any(|(fault, ..)| *fault != Fault::Odd);
    let findings = faults
        .into_iter()
        .map(|(fault, name, force, torque)| fault.finding(&name, force, torque));
    log.findings.extend(findings);
}

/// What is wrong with a sensor's units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    Large,
    Small,
    Odd,
}

fn fault(force: Option<Compared>, torque: Option<Compared>, weight: f64) -> Option<Fault> {
    let both = || {
        [(force, weight), (torque, LEVER * weight)]
            .into_iter()
            .filter_map(|(of, most)| Some((of?, most)))
    };
    if both().any(|(of, most)| of.is_too_large(most)) {
        Some(Fault::Large)
    } else if both().count() > 0 && both().all(|(of, _)| of.is_too_small()) {
        Some(Fault::Small)
    } else if both().any(|(of, _)| of.is_odd()) {
        Some(Fault::Odd)
    } else {
        None
    }
}

impl Fault {
    fn finding(self, name: &str, force: Option<Compared>, torque: Option<Compared>) -> Finding {
        let both = [("forces", force), ("torques", torque)];
        let told = both.iter().filter_map(|(word, own)| Some((word, own.as_ref()?.ratio)));
        let told: Vec<String> = told.map(|(word, ratio)| format!("{word} {}", times(ratio))).collect();
        let told = told.join(" and ");
        let (severity, code, rest) = match self {
            Self::Large => (
                Severity::Refusal,
                "wrong_units",
                "it is in counts or thousandths (convert it to N and Nm), or the URDF's masses are not in kg",
            ),
            Self::Small => (
                Severity::Refusal,
                "wrong_units",
                "it is in thousands (convert it to N and Nm), or the URDF's masses are not in kg",
            ),
            Self::Odd => (
                Severity::Warning,
                "scale",
                "the robot carries what the URDF does not have, or its masses are wrong by as much; or the units are others (1 kgf is 9.807 N) or the calibration is wrong, and so are the parameters: weigh the robot, or hang a known mass on it",
            ),
        };
        Finding {
            severity,
            code,
            subject: format!("wrench/{name}"),
            text: format!(
                "wrench/{name} does not change by what the masses of the URDF ask for, but by {told} as much: {rest}"
            ),
        }
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

    /// What is found of a sensor whose forces are `scale` times those that CAD asks for, which is wrong by `wrong` of another motion; with noise. The robot weighs ten times what moves there.
    fn found(scale: f64, wrong: f64, noise: f64) -> Option<Fault> {
        fault(Some(forces(scale, wrong, noise)), None, 80.0)
    }

    fn forces(scale: f64, wrong: f64, noise: f64) -> Compared {
        let deviates = normals(3, 1000);
        let each = deviates.iter().enumerate().map(|(i, deviate)| {
            let t = 0.05 * i as f64;
            let (x, other) = (8.0 * (0.9 * t).sin(), 8.0 * (1.7 * t + 1.0).sin());
            (300.0 + scale * (x + wrong * other + noise * deviate), x)
        });
        let mut pairs = Pairs::default();
        pairs.add(&each.collect::<Vec<_>>());
        Pairs::compare(std::iter::once(&pairs))
    }

    #[test]
    fn readings_that_are_none_are_told_from_a_wrong_model() {
        for (wrong, noise) in [(0.0, 0.01), (0.5, 1.0), (1.5, 4.0), (5.0, 10.0)] {
            assert_eq!(found(1.0, wrong, noise), None, "{wrong} {noise}");
        }
        // Cables and offsets that wander, over little motion, are not counts.
        assert_eq!(found(1.0, 60.0, 1.0), None);
        assert_eq!(found(1000.0, 0.3, 1.0), Some(Fault::Large));
        assert_eq!(found(-1000.0, 0.3, 1.0), Some(Fault::Large));
        assert_eq!(found(0.001, 0.3, 1.0), Some(Fault::Small));
        for kilograms in [0.102, 9.8] {
            assert_eq!(found(kilograms, 0.3, 1.0), Some(Fault::Odd));
        }
    }

    /// A gripper on a flange that the URDF has alone, or the other way round; a tool whose centre of mass is elsewhere: odd, but a robot's.
    #[test]
    fn what_the_urdf_has_wrong_is_not_refused() {
        let heavy = |scale| fault(Some(forces(scale, 0.3, 1.0)), Some(forces(scale, 0.3, 1.0)), 5000.0);
        for scale in [40.0, 0.02] {
            assert_eq!(heavy(scale), Some(Fault::Odd), "{scale}");
        }
        for scale in [40.0, 0.001] {
            let elsewhere = fault(Some(forces(1.1, 0.3, 1.0)), Some(forces(scale, 0.3, 1.0)), 5000.0);
            assert_eq!(elsewhere, Some(Fault::Odd), "{scale}");
        }
    }
}
