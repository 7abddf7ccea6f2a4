//! Motion that the encoders do not show: a robot shakes on its elastic joints and its stand, at 5 to 20 Hz, by less than an encoder's step, and yet with tenths of a metre per second squared.
//!
//! Such accelerations are missing in the kinematics, and so are the forces that go with them: what F/T sensors read between them does not balance. But F/T sensors *elsewhere* in the robot
//! feel the same shaking. A sub-tree's missing acceleration is taken as a linear function of what the sensors that do not bound it read quickly:
//!
//! ```text
//! delta(t) = B x(t),     x = readings less their mean over a window around t,     wrench = M(q) delta
//! ```
//!
//! with `delta` [angular; linear] about the origin and in the axes of the sub-tree's top link, and `M(q)` the inertia by CAD of the sub-tree with its joints locked. `B`
//! belongs to the robot (and to how it stands): it is fitted by least squares to the training logs' imbalance, what is slow taken off that alike; inertia is in `M`, so that it holds in
//! other postures. It has no say where it does not help: the window is the one that predicts held-out fifths of the training logs best, and it is used if it does so by more than a standard
//! error.
//!
//! A sub-tree's own sensors are never used, so that torques from two sides of a joint stay independent of each other, and a touch on the sub-tree stays in them. A touch elsewhere that is
//! quicker and stronger than all shaking of the training logs is not taken for shaking; a weaker one is, by as much as it resembles it.
//!
//! # Measured
//! A real iCub on its left foot, the right leg between two sensors; torques from either side, trained on ten seconds and compared on the ten after them (the test
//! `leg_torques_from_either_sensor_agree` prints them), RMS of the difference \[Nm\] by CAD, without and with what the left foot's sensor tells of shaking: hip yaw 0.013, 0.013; knee 0.076,
//! 0.074; ankle pitch 0.378, 0.204; ankle roll 0.119, 0.075.

use super::instants::{Break, Instant};
use super::passes::{NoiseModel, Piece, leave};
use super::rows::{RowMaker, Rows};
use crate::spatial::{Vec3, Wrench};
use nalgebra::{DMatrix, DVector, Matrix6, Vector6};
use proprio_topics::Nanos;

/// Windows to choose from \[s\]. What is slower, encoders show.
const WINDOWS: [f64; 5] = [0.1, 0.15, 0.2, 0.3, WIDEST];
const WIDEST: f64 = 0.5;

/// Pieces of the training logs that are predicted from the others.
const FOLDS: usize = 5;

/// A sensor is of use for a sub-tree if it was read at this share of the instants.
const PRESENT: f64 = 0.9;

/// Readings that exceed all of the training logs' by this factor are no shaking: something touched the robot.
const BEYOND: f64 = 2.0;

/// Fewest instants per unknown.
const INSTANTS_PER_UNKNOWN: usize = 5;

/// Added to the normal equations, of columns of unit norm: directions that nothing excites stay at zero.
const RIDGE: f64 = 1e-6;

/// What is known of a robot's shaking.
#[derive(Clone, Debug)]
pub(super) struct Shaking {
    pub parts: Vec<Part>,
}

/// One sub-tree's.
#[derive(Clone, Debug)]
pub(super) struct Part {
    /// Its number in the structure.
    pub subtree: usize,
    /// The sensors that tell of its shaking, none of them its own.
    pub sensors: Vec<usize>,
    /// Readings are taken less their mean over this \[s\].
    pub window: f64,
    /// Of what was left of the sub-tree's balance and is quicker than the widest window, each of the six in units of its deviation: the share of the mean square that is explained, held out.
    pub explained: f64,
    /// `B`, six rows, six columns for each sensor ([torque; force]).
    response: DMatrix<f64>,
    /// The greatest of each of these readings in training, less their mean.
    reach: DVector<f64>,
}

/// One instant of a sub-tree.
struct Moment {
    /// What its motion needs less what was measured.
    balance: Vector6<f64>,
    inertia: Matrix6<f64>,
}

/// Normal equations of one fold, and how many instants are in them.
#[derive(Clone)]
struct Sums {
    normal: DMatrix<f64>,
    right: DVector<f64>,
    /// The right side with what is quicker than the widest window, whatever the window is: for comparing windows.
    wide: DVector<f64>,
    reach: DVector<f64>,
    count: usize,
}

impl Shaking {
    /// Finds what the training logs show, for parameters `d` and the noise that they leave. None if no sub-tree's balance is predicted better with it.
    pub(super) fn find(
        maker: &RowMaker<'_>,
        pieces: &[Piece<'_>],
        noise: &NoiseModel,
        d: &DVector<f64>,
    ) -> Option<Self> {
        let subtrees = maker.sensors_of_subtrees();
        let all = maker.setup().structure.sensors().len();
        if all < 2 {
            return None;
        }
        let mut maker = maker.clone();
        let moments: Vec<Vec<Vec<Option<Moment>>>> = pieces
            .iter()
            .map(|piece| moments(&mut maker, *piece, noise, d, subtrees.len()))
            .collect();
        let parts = subtrees.iter().enumerate().filter_map(|(subtree, own)| {
            let of_pieces: Vec<&[Option<Moment>]> = moments.iter().map(|m| m[subtree].as_slice()).collect();
            let others = (0..all).filter(|sensor| !own.contains(sensor));
            let sensors: Vec<usize> = others.filter(|s| is_there(pieces, &of_pieces, *s)).collect();
            part(subtree, sensors, pieces, &of_pieces)
        });
        let parts: Vec<Part> = parts.collect();
        (!parts.is_empty()).then_some(Self { parts })
    }

    /// Writes into every instant what its sub-trees need for their shaking; where a sensor that would tell was not read, nothing.
    pub(super) fn apply(&self, maker: &RowMaker<'_>, instants: &mut [Instant], breaks: &[Break]) {
        let mut maker = maker.clone();
        let mut rows = Rows::new(maker.layout());
        for part in &self.parts {
            let quick = quick(instants, breaks, &part.sensors, part.window);
            for (instant, quick) in instants.iter_mut().zip(quick) {
                instant.shaking.retain(|(subtree, _)| *subtree != part.subtree);
                let Some(quick) = quick.filter(|x| part.covers(x)) else {
                    continue;
                };
                if maker.make(instant, &mut rows).is_err() {
                    continue;
                }
                let Some(inertia) = maker.inertia_of_subtree(part.subtree) else {
                    continue;
                };
                let w = matrix(&inertia) * Vector6::from_iterator((&part.response * quick).iter().copied());
                let wrench = Wrench {
                    torque: Vec3::new(w[0], w[1], w[2]),
                    force: Vec3::new(w[3], w[4], w[5]),
                };
                if wrench.is_finite() {
                    instant.shaking.push((part.subtree, wrench));
                }
            }
        }
    }
}

impl Part {
    /// Whether readings are as quick as those that the response was fitted to, and not a blow.
    fn covers(&self, quick: &DVector<f64>) -> bool {
        quick
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
    maker: &mut RowMaker<'_>,
    piece: Piece<'_>,
    noise: &NoiseModel,
    d: &DVector<f64>,
    subtrees: usize,
) -> Vec<Vec<Option<Moment>>> {
    let left = leave(maker, piece, noise, std::slice::from_ref(d));
    let mut rows = Rows::new(maker.layout());
    let mut out: Vec<Vec<Option<Moment>>> = (0..subtrees)
        .map(|_| (0..piece.instants.len()).map(|_| None).collect())
        .collect();
    for (range, block) in left.ranges.iter().zip(&left.session) {
        let session = block.x.column(0).into_owned();
        for i in range.clone() {
            let instant = &piece.instants[i];
            if maker.make(instant, &mut rows).is_err() {
                continue;
            }
            for (subtree, moments) in out.iter_mut().enumerate() {
                let balance = maker.balance(instant, d.as_slice(), session.as_slice(), subtree);
                let inertia = maker.inertia_of_subtree(subtree);
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
fn is_there(pieces: &[Piece<'_>], moments: &[&[Option<Moment>]], sensor: usize) -> bool {
    let (mut read, mut all) = (0.0, 0.0);
    for (piece, moments) in pieces.iter().zip(moments) {
        for (instant, _) in piece.instants.iter().zip(*moments).filter(|(_, m)| m.is_some()) {
            all += 1.0;
            read += f64::from(u8::from(instant.readings.get(sensor).is_some_and(Wrench::is_finite)));
        }
    }
    all > 0.0 && read >= PRESENT * all
}

/// Readings of these sensors, one below the other, less their mean over the window around each instant.
fn quick(instants: &[Instant], breaks: &[Break], sensors: &[usize], window: f64) -> Vec<Option<DVector<f64>>> {
    let readings: Vec<Option<DVector<f64>>> = instants
        .iter()
        .map(|instant| {
            let mut all = DVector::zeros(6 * sensors.len());
            for (place, &sensor) in sensors.iter().enumerate() {
                let reading = instant.readings.get(sensor).filter(|r| r.is_finite())?;
                all.rows_mut(6 * place, 6).copy_from_slice(&reading.torque_first());
            }
            Some(all)
        })
        .collect();
    let of_these = breaks.iter().filter(|b| sensors.contains(&b.sensor));
    let cuts: Vec<Nanos> = of_these.map(|b| b.t).collect();
    less_mean(instants, &cuts, &readings, window)
}

/// A series less its mean over the window around each instant; none where the window is not whole: at the ends, where an instant is missing, and where the level changes at a cut.
fn less_mean(
    instants: &[Instant],
    cuts: &[Nanos],
    series: &[Option<DVector<f64>>],
    window: f64,
) -> Vec<Option<DVector<f64>>> {
    let half = 0.5 * window;
    let width = series.iter().flatten().next().map_or(0, DVector::len);
    // Sums from the beginning, and how many instants or gaps there are until each: a window is whole if it has none.
    let mut sums = vec![DVector::zeros(width)];
    let mut holes = vec![0usize];
    let origin = series.iter().flatten().next().cloned();
    for (i, value) in series.iter().enumerate() {
        let mut sum = sums[i].clone();
        // Less the first value: offsets are large, and sums of long logs would lose digits.
        if let (Some(value), Some(origin)) = (value, &origin) {
            sum += value - origin;
        }
        sums.push(sum);
        let gap = i > 0 && {
            let (before, now) = (instants[i - 1].t, instants[i].t);
            (now - before).seconds() > half || cuts.iter().any(|cut| before < *cut && *cut <= now)
        };
        holes.push(holes[i] + usize::from(value.is_none() || gap));
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
            let whole = first > 0 && end < series.len() && holes[end] == holes[first];
            let value = series[i].as_ref().filter(|_| whole && end - first >= 3)?;
            let mean = (&sums[end] - &sums[first]) / (end - first) as f64 + origin.as_ref()?;
            Some(value - mean)
        })
        .collect()
}

/// A sub-tree's part, if it helps.
fn part(subtree: usize, sensors: Vec<usize>, pieces: &[Piece<'_>], moments: &[&[Option<Moment>]]) -> Option<Part> {
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
    // One scale for all windows, and one signal to explain: a window that leaves more has more to explain in what it leaves.
    let (mut square, mut count) = (Vector6::zeros(), 0.0);
    for (piece, balance) in pieces.iter().zip(&balances) {
        for b in less_mean(piece.instants, &[], balance, WIDEST).into_iter().flatten() {
            square += Vector6::from_fn(|k, _| b[k] * b[k]);
            count += 1.0;
        }
    }
    let weights = square.map(|s| if s > 0.0 { (count / s).sqrt() } else { 0.0 });
    let mut best: Option<(f64, f64, Part)> = None;
    for window in WINDOWS {
        let folds = sums(&sensors, window, pieces, moments, &balances, &weights);
        let unknowns = 36 * sensors.len();
        let instants: usize = folds.iter().map(|f| f.count).sum();
        if 6 * instants < INSTANTS_PER_UNKNOWN * unknowns || folds.iter().any(|f| f.count == 0) {
            continue;
        }
        let total = folds.iter().skip(1).fold(folds[0].clone(), |sum, f| sum.and(f, 1.0));
        // Per fold: by how much the mean square becomes less where it is predicted from the other folds.
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
                response: DMatrix::from_fn(6, 6 * sensors.len(), |i, j| b[i * 6 * sensors.len() + j]),
                reach: total.reach.clone(),
            };
            best = Some((mean, (variance / n).sqrt(), part));
        }
    }
    best.filter(|(gain, error, _)| gain > error).map(|(_, _, part)| part)
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
    pieces: &[Piece<'_>],
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
    for ((piece, moments), balance) in pieces.iter().zip(moments).zip(balances) {
        let quick = quick(piece.instants, piece.breaks, sensors, window);
        let wide = less_mean(piece.instants, &[], balance, WIDEST);
        let balance = less_mean(piece.instants, &[], balance, window);
        let instants = moments.len();
        let each = quick.iter().zip(balance.iter().zip(&wide)).zip(*moments);
        for (i, ((x, (b, wide)), moment)) in each.enumerate() {
            let (Some(x), Some(b), Some(wide), Some(moment)) = (x, b, wide, moment) else {
                continue;
            };
            let fold = &mut folds[i * FOLDS / instants];
            let weighted = Matrix6::from_diagonal(weights) * moment.inertia;
            let own = weighted.transpose() * weighted;
            let side = |b: &DVector<f64>| weighted.transpose() * -Vector6::from_fn(|k, _| weights[k] * b[k]);
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
    use crate::dynamics::{ContactSet, FrameMotion, SensorSet};
    use crate::identify::gate::UnitSet;
    use proprio_topics::Reason;

    /// Ten milliseconds apart; the readings of one sensor.
    fn instants(readings: &[Wrench]) -> Vec<Instant> {
        let each = readings.iter().enumerate();
        each.map(|(i, reading)| Instant {
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
            fitted: Vec::new(),
            outliers: SensorSet::default(),
            suspected: UnitSet::default(),
            shaking: Vec::new(),
        })
        .collect()
    }

    /// Shakes at 7 to 13 Hz above a slow sway; a body that turns meanwhile; the balance that a response `b` of it leaves, with noise and drift.
    fn shaken(b: &Matrix6<f64>, noise: f64) -> (Vec<Instant>, Vec<Option<Moment>>) {
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
            let shake = Vector6::from_fn(|k, _| (std::f64::consts::TAU * (7.0 + 1.2 * k as f64) * t + k as f64).sin());
            let slow = Vector6::from_fn(|k, _| 30.0 * (0.8 * t + k as f64).cos());
            let all = shake + slow;
            readings.push(Wrench::from_parts([all[3], all[4], all[5]], [all[0], all[1], all[2]]));
            let tilt = Matrix6::from_fn(|r, c| 0.2 * (0.3 * t + (r + 2 * c) as f64).sin());
            let inertia = Matrix6::identity() * 2.0 + tilt + tilt.transpose();
            let drift = Vector6::repeat(3.0 * (0.5 * t).sin());
            let own = Vector6::from_fn(|_, _| noise * normal());
            moments.push(Some(Moment {
                balance: -(inertia * (b * shake)) + drift + own,
                inertia,
            }));
        }
        (instants(&readings), moments)
    }

    fn found(instants: &[Instant], moments: &[Option<Moment>]) -> Option<Part> {
        let piece = Piece { instants, breaks: &[] };
        part(3, vec![0], &[piece], &[moments])
    }

    #[test]
    fn the_response_is_found_in_any_posture() {
        let b = Matrix6::from_fn(|r, c| 0.4 * (1.0 + (3 * r + 5 * c) as f64).cos());
        let (instants, moments) = shaken(&b, 0.1);
        let part = found(&instants, &moments).expect("it shakes");
        assert_eq!((part.subtree, part.sensors.as_slice()), (3, [0].as_slice()));
        let worst = (&part.response - DMatrix::from_fn(6, 6, |r, c| b[(r, c)])).amax();
        assert!(worst < 0.05, "{worst}: {}", part.response);
        assert!(part.explained > 0.8 && part.explained <= 1.0, "{}", part.explained);
    }

    #[test]
    fn what_no_other_sensor_feels_is_left_alone() {
        let (instants, moments) = shaken(&Matrix6::zeros(), 0.5);
        assert!(found(&instants, &moments).is_none());
    }

    /// Against the definition, and nothing at the ends and around what is missing.
    #[test]
    fn quick_is_what_differs_from_the_mean_around() {
        let mut series: Vec<Option<DVector<f64>>> = (0..40)
            .map(|i| Some(DVector::from_element(1, 1e3 + f64::from(i * i % 7))))
            .collect();
        let instants = instants(&[Wrench::zero(); 40]);
        series[20] = None;
        let quick = less_mean(&instants, &[Nanos::from_millis(305)], &series, 0.1);
        for (i, value) in quick.iter().enumerate() {
            let whole = (6..34).contains(&i) && !(15..=25).contains(&i) && !(26..=36).contains(&i);
            assert_eq!(value.is_some(), whole, "{i}");
            if let Some(value) = value {
                let around = series[i - 5..=i + 5].iter().flatten().map(|v| v[0]);
                let expected = series[i].as_ref().unwrap()[0] - around.sum::<f64>() / 11.0;
                assert!((value[0] - expected).abs() < 1e-9, "{i}");
            }
        }
    }
}
