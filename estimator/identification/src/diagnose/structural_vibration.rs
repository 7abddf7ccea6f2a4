//! Structural vibration: a robot vibrates on its elastic joints and its stand at 5 to 20 Hz, with
//! amplitudes below an encoder's resolution but accelerations of tenths of a metre per second
//! squared.
//!
//! The kinematics lack these accelerations, and the model lacks their inertial forces: the readings
//! of the F/T sensors of a sub-tree do not balance. But F/T sensors *elsewhere* in the robot
//! observe the same vibration. A sub-tree's missing acceleration is modelled as a linear function
//! of the high-pass filtered readings of the sensors that do not bound it:
//!
//! ```text
//! delta(t) = B x(t)          x = readings less their mean over a window around t
//! wrench   = M(q) delta
//! ```
//!
//! with `delta` [angular; linear] about the origin and in the axes of the sub-tree's top link, and
//! `M(q)` the sub-tree's CAD inertia with its joints locked. `B` belongs to the robot (and to its
//! stand): it is fitted by least squares to the training logs' imbalance, high-pass filtered in the
//! same way; inertia is in `M`, so that `B` holds in other postures. The window is the one that
//! predicts held-out fifths of the training logs best. `B` is used only if this improves the
//! prediction by more than a standard error.
//!
//! A sub-tree's own sensors are never used, so that torques from the two sides of a joint stay
//! independent of each other, and a contact on the sub-tree remains in them. A contact elsewhere
//! that exceeds all vibration of the training logs is not taken for vibration; a weaker one is, in
//! proportion to its resemblance.
//!
//! # Measured
//! A real iCub on its left foot, the right leg between two sensors; torques from either side,
//! trained on ten seconds and compared on the ten after them (the test
//! `leg_torques_from_either_sensor_agree` prints them). RMS of the difference \[Nm\] with CAD,
//! without and with the vibration that the left foot's sensor observes: hip yaw 0.013, 0.013; knee
//! 0.076, 0.074; ankle pitch 0.378, 0.204; ankle roll 0.119, 0.075.

use crate::dataset::defects::OffsetJump;
use crate::dataset::observation::Annotated;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{Segment, residuals};
use crate::measurement::rows::Rows;
use nalgebra::{DMatrix, DVector, Matrix6, Vector6};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_topics::Nanos;

/// Windows to choose from \[s\]. Encoders observe slower motion.
const WINDOWS: [f64; 5] = [0.1, 0.15, 0.2, 0.3, WIDEST];
const WIDEST: f64 = 0.5;

/// Folds of the training logs, each predicted from the others.
const FOLDS: usize = 5;

/// A sensor is used for a sub-tree if it was read at this fraction of the instants.
const PRESENT: f64 = 0.9;

/// Readings that exceed all of the training logs' by this factor are a contact, not vibration.
const BEYOND: f64 = 2.0;

/// Fewest instants per unknown.
const INSTANTS_PER_UNKNOWN: usize = 5;

/// Regularisation of the normal equations, whose columns have unit norm: directions that are not
/// excited stay at zero.
const RIDGE: f64 = 1e-6;

/// The vibration model of a robot.
#[derive(Clone, Debug)]
pub(crate) struct StructuralVibration {
    pub parts: Vec<Part>,
}

/// The vibration model of one sub-tree.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    /// Its number in the structure.
    pub subtree: usize,
    /// The sensors that observe its vibration, none of them its own.
    pub sensors: Vec<usize>,
    /// Readings are reduced by their mean over this window \[s\].
    pub window: f64,
    /// Explained fraction of the mean square of the sub-tree's imbalance, high-pass filtered with
    /// the widest window, each of the six components in units of its deviation; on held-out data.
    pub explained: f64,
    /// `B`, six rows, six columns for each sensor ([torque; force]).
    response: DMatrix<f64>,
    /// Largest absolute value of each of these readings in training, less their mean.
    reach: DVector<f64>,
}

/// Balance of a sub-tree at one instant.
struct Moment {
    /// Wrench that its motion requires less the measured one.
    balance: Vector6<f64>,
    inertia: Matrix6<f64>,
}

/// Normal equations of one fold, and its number of instants.
#[derive(Clone)]
struct Sums {
    normal: DMatrix<f64>,
    right: DVector<f64>,
    /// The right side of the imbalance filtered with the widest window: for comparing windows.
    wide: DVector<f64>,
    reach: DVector<f64>,
    count: usize,
}

impl StructuralVibration {
    /// Fits the vibration model to the training logs, for parameters `d` and their noise. None if
    /// it improves the balance of no sub-tree.
    pub(crate) fn find(
        measurement: &MeasurementModel<'_>,
        segments: &[Segment<'_>],
        noise: &NoiseModel,
        d: &DVector<f64>,
    ) -> Option<Self> {
        let subtrees = measurement.sensors_of_subtrees();
        let all = measurement.robot().structure.sensors().len();
        if all < 2 {
            return None;
        }
        let mut measurement = measurement.clone();
        let moments: Vec<Vec<Vec<Option<Moment>>>> = segments
            .iter()
            .map(|segment| moments(&mut measurement, *segment, noise, d, subtrees.len()))
            .collect();
        let parts = subtrees.iter().enumerate().filter_map(|(subtree, own)| {
            let of_segments: Vec<&[Option<Moment>]> =
                moments.iter().map(|m| m[subtree].as_slice()).collect();
            let others = (0..all).filter(|sensor| !own.contains(sensor));
            let sensors: Vec<usize> = others
                .filter(|s| is_mostly_read(segments, &of_segments, *s))
                .collect();
            part(subtree, sensors, segments, &of_segments)
        });
        let parts: Vec<Part> = parts.collect();
        (!parts.is_empty()).then_some(Self { parts })
    }

    /// Writes the wrench of the vibration of each sub-tree into every instant; nothing where a
    /// sensor that observes it was not read.
    pub(crate) fn apply(
        &self,
        measurement: &MeasurementModel<'_>,
        instants: &mut [Annotated],
        offset_jumps: &[OffsetJump],
    ) {
        let mut measurement = measurement.clone();
        let mut rows = Rows::new(measurement.unknowns());
        for part in &self.parts {
            let high_passed = high_passed(instants, offset_jumps, &part.sensors, part.window);
            for (instant, high_passed) in instants.iter_mut().zip(high_passed) {
                instant
                    .vibration
                    .retain(|(subtree, _)| *subtree != part.subtree);
                let Some(high_passed) = high_passed.filter(|x| part.covers(x)) else {
                    continue;
                };
                if measurement.make(instant, &mut rows).is_err() {
                    continue;
                }
                let Some(inertia) = measurement.inertia_of_subtree(part.subtree) else {
                    continue;
                };
                let w = matrix(&inertia)
                    * Vector6::from_iterator((&part.response * high_passed).iter().copied());
                let wrench = Wrench {
                    torque: Vec3::new(w[0], w[1], w[2]),
                    force: Vec3::new(w[3], w[4], w[5]),
                };
                if wrench.is_finite() {
                    instant.vibration.push((part.subtree, wrench));
                }
            }
        }
    }
}

impl Part {
    /// Whether filtered readings are within the range to which the response was fitted, and not a
    /// contact.
    fn covers(&self, high_passed: &DVector<f64>) -> bool {
        high_passed
            .iter()
            .zip(&self.reach)
            .all(|(x, reach)| x.abs() <= BEYOND * reach)
    }
}

fn matrix(columns: &[Wrench; 6]) -> Matrix6<f64> {
    Matrix6::from_fn(|row, column| columns[column].torque_first()[row])
}

/// Per sub-tree and instant: balance and inertia.
fn moments(
    measurement: &mut MeasurementModel<'_>,
    segment: Segment<'_>,
    noise: &NoiseModel,
    d: &DVector<f64>,
    subtrees: usize,
) -> Vec<Vec<Option<Moment>>> {
    let residuals = residuals(measurement, segment, noise, std::slice::from_ref(d));
    let mut rows = Rows::new(measurement.unknowns());
    let mut out: Vec<Vec<Option<Moment>>> = (0..subtrees)
        .map(|_| (0..segment.instants.len()).map(|_| None).collect())
        .collect();
    for (range, block) in residuals.ranges.iter().zip(&residuals.nuisance) {
        let nuisance = block.x.column(0).into_owned();
        for i in range.clone() {
            let instant = &segment.instants[i];
            if measurement.make(instant, &mut rows).is_err() {
                continue;
            }
            for (subtree, moments) in out.iter_mut().enumerate() {
                let balance =
                    measurement.balance(instant, d.as_slice(), nuisance.as_slice(), subtree);
                let inertia = measurement.inertia_of_subtree(subtree);
                moments[i] = balance.zip(inertia).map(|(balance, inertia)| Moment {
                    balance: Vector6::from(balance.torque_first()),
                    inertia: matrix(&inertia),
                });
            }
        }
    }
    out
}

/// Whether a sensor was read at most of the instants that a sub-tree has.
fn is_mostly_read(segments: &[Segment<'_>], moments: &[&[Option<Moment>]], sensor: usize) -> bool {
    let (mut read, mut all) = (0.0, 0.0);
    for (segment, moments) in segments.iter().zip(moments) {
        for (instant, _) in segment
            .instants
            .iter()
            .zip(*moments)
            .filter(|(_, m)| m.is_some())
        {
            all += 1.0;
            read += f64::from(u8::from(
                instant.readings.get(sensor).is_some_and(Wrench::is_finite),
            ));
        }
    }
    all > 0.0 && read >= PRESENT * all
}

/// High-pass filtered readings of these sensors, stacked: less their mean over the window around
/// each instant.
fn high_passed(
    instants: &[Annotated],
    offset_jumps: &[OffsetJump],
    sensors: &[usize],
    window: f64,
) -> Vec<Option<DVector<f64>>> {
    let readings: Vec<Option<DVector<f64>>> = instants
        .iter()
        .map(|instant| {
            let mut all = DVector::zeros(6 * sensors.len());
            for (place, &sensor) in sensors.iter().enumerate() {
                let reading = instant.readings.get(sensor).filter(|r| r.is_finite())?;
                all.rows_mut(6 * place, 6)
                    .copy_from_slice(&reading.torque_first());
            }
            Some(all)
        })
        .collect();
    let of_these = offset_jumps.iter().filter(|b| sensors.contains(&b.sensor));
    let cuts: Vec<Nanos> = of_these.map(|b| b.t).collect();
    less_mean(instants, &cuts, &readings, window)
}

/// A series less its mean over the window around each instant; none where the window is not whole:
/// at the ends, where an instant is missing, and where the level changes at a cut.
fn less_mean(
    instants: &[Annotated],
    cuts: &[Nanos],
    series: &[Option<DVector<f64>>],
    window: f64,
) -> Vec<Option<DVector<f64>>> {
    let half = 0.5 * window;
    let width = series.iter().flatten().next().map_or(0, DVector::len);
    // Cumulative sums of values and of missing instants and gaps: a window is complete if it has
    // none of the latter.
    let mut sums = vec![DVector::zeros(width)];
    let mut missing = vec![0usize];
    let origin = series.iter().flatten().next().cloned();
    for (i, value) in series.iter().enumerate() {
        let mut sum = sums[i].clone();
        // Relative to the first value: offsets are large, and sums of long logs would lose digits.
        if let (Some(value), Some(origin)) = (value, &origin) {
            sum += value - origin;
        }
        sums.push(sum);
        let gap = i > 0 && {
            let (before, now) = (instants[i - 1].t, instants[i].t);
            (now - before).seconds() > half || cuts.iter().any(|cut| before < *cut && *cut <= now)
        };
        missing.push(missing[i] + usize::from(value.is_none() || gap));
    }
    let seconds = |i: usize, j: usize| (instants[j].t - instants[i].t).seconds();
    let (mut first, mut end) = (0, 0);
    (0..series.len())
        .map(|i| {
            while seconds(first, i) > half {
                first += 1;
            }
            while end < series.len() && seconds(i, end) <= half {
                end += 1;
            }
            let is_complete = first > 0 && end < series.len() && missing[end] == missing[first];
            let value = series[i]
                .as_ref()
                .filter(|_| is_complete && end - first >= 3)?;
            let mean = (&sums[end] - &sums[first]) / (end - first) as f64 + origin.as_ref()?;
            Some(value - mean)
        })
        .collect()
}

/// A sub-tree's vibration model, if it improves its balance.
fn part(
    subtree: usize,
    sensors: Vec<usize>,
    segments: &[Segment<'_>],
    moments: &[&[Option<Moment>]],
) -> Option<Part> {
    if sensors.is_empty() {
        return None;
    }
    let balances: Vec<Vec<Option<DVector<f64>>>> = moments
        .iter()
        .map(|moments| {
            let each = moments.iter().map(Option::as_ref);
            each.map(|m| m.map(|m| DVector::from_column_slice(m.balance.as_slice())))
                .collect()
        })
        .collect();
    // One scale and one signal to explain for all windows: a wider window passes more of the
    // signal, so its own signal would not be comparable.
    let (mut square, mut count) = (Vector6::zeros(), 0.0);
    for (segment, balance) in segments.iter().zip(&balances) {
        for b in less_mean(segment.instants, &[], balance, WIDEST)
            .into_iter()
            .flatten()
        {
            square += Vector6::from_fn(|k, _| b[k] * b[k]);
            count += 1.0;
        }
    }
    let weights = square.map(|s| if s > 0.0 { (count / s).sqrt() } else { 0.0 });
    let mut best: Option<(f64, f64, Part)> = None;
    for window in WINDOWS {
        let folds = sums(&sensors, window, segments, moments, &balances, &weights);
        let unknowns = 36 * sensors.len();
        let instants: usize = folds.iter().map(|f| f.count).sum();
        if 6 * instants < INSTANTS_PER_UNKNOWN * unknowns || folds.iter().any(|f| f.count == 0) {
            continue;
        }
        let total = folds
            .iter()
            .skip(1)
            .fold(folds[0].clone(), |sum, f| sum.and(f, 1.0));
        // Per fold: reduction of its mean square when it is predicted from the other folds.
        let mut gains = Vec::new();
        for fold in &folds {
            let b = total.and(fold, -1.0).solve()?;
            gains.push((2.0 * b.dot(&fold.wide) - b.dot(&(&fold.normal * &b))) / fold.count as f64);
        }
        let n = gains.len() as f64;
        let mean = gains.iter().sum::<f64>() / n;
        let variance = gains.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (n - 1.0);
        if best.as_ref().is_none_or(|(gain, _, _)| mean > *gain) {
            let b = total.solve()?;
            let part = Part {
                subtree,
                sensors: sensors.clone(),
                window,
                explained: mean / 6.0,
                response: DMatrix::from_fn(6, 6 * sensors.len(), |i, j| {
                    b[i * 6 * sensors.len() + j]
                }),
                reach: total.reach.clone(),
            };
            best = Some((mean, (variance / n).sqrt(), part));
        }
    }
    best.filter(|(gain, error, _)| gain > error)
        .map(|(_, _, part)| part)
}

impl Sums {
    fn and(&self, other: &Self, sign: f64) -> Self {
        Self {
            normal: &self.normal + &other.normal * sign,
            right: &self.right + &other.right * sign,
            wide: &self.wide + &other.wide * sign,
            reach: self.reach.sup(&other.reach),
            count: self.count,
        }
    }

    fn solve(&self) -> Option<DVector<f64>> {
        let scale = self
            .normal
            .diagonal()
            .map(|x| if x > 0.0 { x.sqrt().recip() } else { 0.0 });
        let n = scale.len();
        let scaled = DMatrix::from_fn(n, n, |i, j| {
            scale[i] * self.normal[(i, j)] * scale[j] + if i == j { RIDGE } else { 0.0 }
        });
        let b = scaled.cholesky()?.solve(&self.right.component_mul(&scale));
        Some(b.component_mul(&scale))
    }
}

/// Normal equations of `W M (B x) = -W b`, unknowns row by row of `B`, fold by fold of time.
fn sums(
    sensors: &[usize],
    window: f64,
    segments: &[Segment<'_>],
    moments: &[&[Option<Moment>]],
    balances: &[Vec<Option<DVector<f64>>>],
    weights: &Vector6<f64>,
) -> Vec<Sums> {
    let width = 6 * sensors.len();
    let empty = Sums {
        normal: DMatrix::zeros(6 * width, 6 * width),
        right: DVector::zeros(6 * width),
        wide: DVector::zeros(6 * width),
        reach: DVector::zeros(width),
        count: 0,
    };
    let mut folds = vec![empty; FOLDS];
    for ((segment, moments), balance) in segments.iter().zip(moments).zip(balances) {
        let high_passed = high_passed(segment.instants, segment.offset_jumps, sensors, window);
        let wide = less_mean(segment.instants, &[], balance, WIDEST);
        let balance = less_mean(segment.instants, &[], balance, window);
        let instants = moments.len();
        let each = high_passed
            .iter()
            .zip(balance.iter().zip(&wide))
            .zip(*moments);
        for (i, ((x, (b, wide)), moment)) in each.enumerate() {
            let (Some(x), Some(b), Some(wide), Some(moment)) = (x, b, wide, moment) else {
                continue;
            };
            let fold = &mut folds[i * FOLDS / instants];
            let weighted = Matrix6::from_diagonal(weights) * moment.inertia;
            let own = weighted.transpose() * weighted;
            let side = |b: &DVector<f64>| {
                weighted.transpose() * -Vector6::from_fn(|k, _| weights[k] * b[k])
            };
            let (right, wide) = (side(b), side(wide));
            let outer = x * x.transpose();
            for p in 0..6 {
                for k in 0..width {
                    fold.right[p * width + k] += right[p] * x[k];
                    fold.wide[p * width + k] += wide[p] * x[k];
                }
                for q in 0..6 {
                    let mut block = fold.normal.view_mut((p * width, q * width), (width, width));
                    block += &outer * own[(p, q)];
                }
            }
            fold.reach = fold.reach.sup(&x.abs());
            fold.count += 1;
        }
    }
    folds
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::observation::Observation;
    use proprio_dynamics::{ContactSet, FrameMotion, SensorSet};
    use proprio_topics::Reason;

    /// Ten milliseconds apart; the readings of one sensor.
    fn instants(readings: &[Wrench]) -> Vec<Annotated> {
        let each = readings.iter().enumerate();
        each.map(|(i, reading)| {
            Annotated::from(Observation {
                t: Nanos::from_millis(10 * i64::try_from(i).unwrap()),
                position: Vec::new(),
                velocity: Vec::new(),
                acceleration: Vec::new(),
                torque: Vec::new(),
                base_link: 0,
                base: FrameMotion::standing(&Vec3::zeros()),
                readings: vec![*reading],
                active: ContactSet::default(),
                faults: Vec::new(),
                base_fault: Reason::None,
                temperatures: Vec::new(),
                outliers: SensorSet::default(),
            })
        })
        .collect()
    }

    /// Vibration at 7 to 13 Hz on a slow sway; a body that rotates meanwhile; its balance for a
    /// response `b`, with noise and drift.
    fn vibrating(b: &Matrix6<f64>, noise: f64) -> (Vec<Annotated>, Vec<Option<Moment>>) {
        // Sums of twelve numbers of a linear congruence: as good as normal here.
        let mut state = 7_u64;
        let mut uniform = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        let mut normal = || (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        let (mut readings, mut moments) = (Vec::new(), Vec::new());
        for i in 0..1500 {
            let t = 0.01 * f64::from(i);
            // The frequencies are apart enough for none to be another's copy.
            let vibration = Vector6::from_fn(|k, _| {
                (std::f64::consts::TAU * (7.0 + 1.2 * k as f64) * t + k as f64).sin()
            });
            let slow = Vector6::from_fn(|k, _| 30.0 * (0.8 * t + k as f64).cos());
            let all = vibration + slow;
            readings.push(Wrench::from_parts(
                [all[3], all[4], all[5]],
                [all[0], all[1], all[2]],
            ));
            let tilt = Matrix6::from_fn(|r, c| 0.2 * (0.3 * t + (r + 2 * c) as f64).sin());
            let inertia = Matrix6::identity() * 2.0 + tilt + tilt.transpose();
            let drift = Vector6::repeat(3.0 * (0.5 * t).sin());
            let own = Vector6::from_fn(|_, _| noise * normal());
            moments.push(Some(Moment {
                balance: -(inertia * (b * vibration)) + drift + own,
                inertia,
            }));
        }
        (instants(&readings), moments)
    }

    fn found(instants: &[Annotated], moments: &[Option<Moment>]) -> Option<Part> {
        let segment = Segment {
            instants,
            offset_jumps: &[],
        };
        part(3, vec![0], &[segment], &[moments])
    }

    #[test]
    fn the_response_is_found_in_any_posture() {
        let b = Matrix6::from_fn(|r, c| 0.4 * (1.0 + (3 * r + 5 * c) as f64).cos());
        let (instants, moments) = vibrating(&b, 0.1);
        let part = found(&instants, &moments).expect("it shakes");
        assert_eq!((part.subtree, part.sensors.as_slice()), (3, [0].as_slice()));
        let worst = (&part.response - DMatrix::from_fn(6, 6, |r, c| b[(r, c)])).amax();
        assert!(worst < 0.05, "{worst}: {}", part.response);
        assert!(
            part.explained > 0.8 && part.explained <= 1.0,
            "{}",
            part.explained
        );
    }

    #[test]
    fn vibration_that_no_other_sensor_observes_is_kept() {
        let (instants, moments) = vibrating(&Matrix6::zeros(), 0.5);
        assert!(found(&instants, &moments).is_none());
    }

    /// Against the definition, and nothing at the ends and around what is missing.
    #[test]
    fn high_passed_is_the_difference_from_the_mean_around() {
        let mut series: Vec<Option<DVector<f64>>> = (0..40)
            .map(|i| Some(DVector::from_element(1, 1e3 + f64::from(i * i % 7))))
            .collect();
        let instants = instants(&[Wrench::zero(); 40]);
        series[20] = None;
        let high_passed = less_mean(&instants, &[Nanos::from_millis(305)], &series, 0.1);
        for (i, value) in high_passed.iter().enumerate() {
            let is_complete =
                (6..34).contains(&i) && !(15..=25).contains(&i) && !(26..=36).contains(&i);
            assert_eq!(value.is_some(), is_complete, "{i}");
            if let Some(value) = value {
                let around = series[i - 5..=i + 5].iter().flatten().map(|v| v[0]);
                let expected = series[i].as_ref().unwrap()[0] - around.sum::<f64>() / 11.0;
                assert!((value[0] - expected).abs() < 1e-9, "{i}");
            }
        }
    }
}
