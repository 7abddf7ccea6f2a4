//! Passes over a log's observations: the information about the parameters, and the residuals for
//! given parameters.

use crate::arithmetic::{add_multiple, dot};
use crate::dataset::observation::Annotated;
use crate::linear::information::{Information, Panel};
use crate::linear::nuisance::{NuisanceEstimate, NuisanceFilter, smooth};
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::Unknowns;
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// Offsets are constant within blocks of this length \[s\] and drift between blocks (random walk).
pub(crate) const BLOCK: f64 = 0.1;

/// Prior variance of an offset [N^2 or Nm^2]: no F/T offset exceeds 1000.
pub(crate) const OFFSET_VARIANCE: f64 = 1e6;

/// Prior variance of a friction coefficient [Nm^2]: none exceeds 100.
const FRICTION_VARIANCE: f64 = 1e4;

/// Rows that are absorbed at once.
const PANEL: usize = 96;

/// Blocks that one thread processes at a time.
const BLOCKS_PER_TASK: usize = 16;

/// Number of blocks whose rows are kept in memory.
const AT_ONCE: usize = 512;

/// Consecutive observations of one log, with their own offsets and friction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LogSegment<'a> {
    pub instants: &'a [Annotated],
    /// The number of the training log; none if its seconds are not weighted.
    pub log: Option<usize>,
}

impl<'a> LogSegment<'a> {
    /// Its seconds are not weighted.
    pub(crate) fn alone(instants: &'a [Annotated]) -> Self {
        let log = None;
        Self { instants, log }
    }
}

/// Prior variances of the nuisance parameters.
pub(crate) fn nuisance_prior(unknowns: &Unknowns) -> Vec<f64> {
    let mut prior = vec![OFFSET_VARIANCE; unknowns.wrenches()];
    prior.resize(unknowns.nuisance(), FRICTION_VARIANCE);
    prior
}

/// The blocks of consecutive observations, each of this duration.
pub(crate) fn blocks(instants: &[Annotated], seconds: f64) -> Vec<Range<usize>> {
    let (mut blocks, mut start) = (Vec::new(), 0);
    for end in 1..=instants.len() {
        let is_long = |next: &Annotated| (next.t - instants[start].t).seconds() >= seconds;
        if instants.get(end).is_none_or(is_long) {
            blocks.push(start..end);
            start = end;
        }
    }
    blocks
}

/// The information about the parameters in a segment, and the nuisance parameters at its end.
pub(crate) struct ReducedLog {
    /// About `d`, with offsets and friction eliminated.
    pub information: Information,
    /// At the end of the segment `s = estimate - slope d`, with this covariance.
    pub slope: DMatrix<f64>,
    pub covariance: DMatrix<f64>,
}

/// Reduces a segment to its information about the parameters.
pub(crate) fn reduce(
    measurement: &mut MeasurementModel<'_>,
    segment: LogSegment<'_>,
    noise: &NoiseModel,
) -> ReducedLog {
    reduce_with(measurement, segment, noise, &[], 0, &|_, _, _| Vec::new())
}

/// Extra columns of an observation's rows, row by row, given its number in the segment and the
/// rows.
type ExtraColumns<'a> = dyn Fn(&mut MeasurementModel<'_>, usize, &MeasurementRows) -> Vec<f64> + 'a;

/// As [`reduce`], without the observations flagged in `excluded` (all are used if it is empty), and
/// with `width` extra columns after those of `d`.
pub(crate) fn reduce_with(
    measurement: &mut MeasurementModel<'_>,
    segment: LogSegment<'_>,
    noise: &NoiseModel,
    excluded: &[bool],
    width: usize,
    columns: &ExtraColumns<'_>,
) -> ReducedLog {
    let unknowns = measurement.unknowns().clone();
    let links = unknowns.parameters();
    let p = links + width;
    let variances = noise.inflated();
    let mut nuisance = NuisanceFilter::new(&nuisance_prior(&unknowns), p + 1);
    let mut information = Information::new(p);
    let mut panel = Panel::new(p, PANEL);
    let mut line = vec![0.0; p + 1];
    let mut last = None;
    for range in blocks(segment.instants, BLOCK) {
        let t = segment.instants[range.start].t;
        if let Some(last) = last.replace(t) {
            nuisance.drift(&noise.steps(&unknowns, (t - last).seconds()));
        }
        for number in range {
            if excluded.get(number) == Some(&true) {
                continue;
            }
            let mut rows = measurement.rows(&segment.instants[number]);
            let mut slopes = columns(measurement, number, &rows);
            let at = (segment.log, segment.instants[number].t);
            rows.whiten_with(&noise.at(&unknowns, &variances, at), &mut slopes, width);
            for row in 0..rows.count {
                line[..links].copy_from_slice(rows.a(row));
                line[links..p].copy_from_slice(&slopes[row * width..][..width]);
                line[p] = rows.r(row);
                nuisance.update(rows.g(row), &mut line);
                if panel.rows() == panel.capacity() {
                    let _ = information.absorb(&mut panel);
                }
                // Rows that are not finite are skipped.
                let _ = panel.push_row(&line[..p], line[p]);
            }
        }
    }
    let _ = information.absorb(&mut panel);
    let estimates = nuisance.estimates();
    ReducedLog {
        information,
        slope: estimates.columns(0, links).into_owned(),
        covariance: nuisance.covariance(),
    }
}

/// The residuals of a segment, for several sets of parameters.
pub(crate) struct Residuals {
    /// Per set, per channel, per observation: noise; NaN if no row has the channel.
    pub noise: Vec<Vec<Vec<f64>>>,
    /// Per channel, per observation: the prediction by the first set without offsets and friction:
    /// of an F/T sensor's reading, or of a joint's torque.
    pub predicted: Vec<Vec<f64>>,
    /// The corresponding measurement.
    pub measured: Vec<Vec<f64>>,
    /// Blocks of observations.
    pub ranges: Vec<Range<usize>>,
    /// Per block, the smoothed nuisance parameters, a column per set.
    pub nuisance: Vec<NuisanceEstimate>,
    /// How noise is shared among channels ([`MeasurementRows::add_shares`]): the mean over
    /// observations, a row per channel.
    pub shares: DMatrix<f64>,
    /// Per channel, the number of observations in which any row has it.
    pub seen: Vec<f64>,
}

impl Residuals {
    /// Whether any row had this channel.
    pub(crate) fn has_channel(&self, channel: usize) -> bool {
        self.measured[channel].iter().any(|x| x.is_finite())
    }

    /// The drift of a channel's offset about its mean, per block, for the first set. Drifts of
    /// several sensors that rows mix are shared as their noise is. (Otherwise the sensor with the
    /// greatest assumed drift rate would get all of it.)
    pub(crate) fn offset_drift(&self, unknowns: &Unknowns, channel: usize) -> Vec<f64> {
        let mut sum = vec![0.0; self.nuisance.len()];
        for other in 0..unknowns.wrenches() {
            let share = self.shares[(channel, other)];
            if share == 0.0 {
                continue;
            }
            let unknown = unknowns.offset_of(other);
            let values = self.nuisance.iter().map(|block| block.x[(unknown, 0)]);
            let mean = values.clone().sum::<f64>() / self.nuisance.len() as f64;
            for (sum, value) in sum.iter_mut().zip(values) {
                *sum += share * (value - mean);
            }
        }
        sum
    }
}

/// Fits offsets and friction for given parameters. Returns the blocks of observations, and the
/// filtered (not smoothed) estimates at the end of each block, a column per set.
pub(crate) fn filter_nuisance(
    measurement: &MeasurementModel<'_>,
    segment: LogSegment<'_>,
    noise: &NoiseModel,
    sets: &[DVector<f64>],
) -> (Vec<Range<usize>>, Vec<NuisanceEstimate>) {
    let unknowns = measurement.unknowns().clone();
    let k = sets.len();
    let variances = noise.offset_tracking_variances();
    let mut nuisance = NuisanceFilter::new(&nuisance_prior(&unknowns), k);
    let (mut states, mut last) = (Vec::new(), None);
    let blocks = blocks(segment.instants, BLOCK);
    for some in blocks.chunks(AT_ONCE) {
        // Per row: the residual of every set, and the coefficients of the nuisance parameters.
        let width = k + unknowns.nuisance();
        let lines = measurement.map(some, |measurement, range| {
            let mut lines = Vec::new();
            for observation in &segment.instants[range.clone()] {
                let mut rows = measurement.rows(observation);
                let at = (segment.log, observation.t);
                rows.whiten(&noise.at(&unknowns, &variances, at));
                for row in 0..rows.count {
                    let sets = sets.iter().map(DVector::as_slice);
                    lines.extend(sets.map(|set| rows.without_bodies(row, set)));
                    lines.extend_from_slice(rows.g(row));
                }
            }
            lines
        });
        for (range, mut lines) in some.iter().zip(lines) {
            let t = segment.instants[range.start].t;
            let mut drift = vec![0.0; unknowns.nuisance()];
            if let Some(last) = last.replace(t) {
                drift = noise.steps(&unknowns, (t - last).seconds());
                nuisance.drift(&drift);
            }
            for line in lines.chunks_exact_mut(width) {
                let (values, g) = line.split_at_mut(k);
                nuisance.update(g, values);
            }
            states.push(NuisanceEstimate {
                x: nuisance.estimates(),
                p: nuisance.covariance(),
                drift,
            });
        }
    }
    (blocks, states)
}

/// As [`filter_nuisance`], smoothed over the whole segment, with the residuals.
pub(crate) fn residuals(
    measurement: &MeasurementModel<'_>,
    segment: LogSegment<'_>,
    noise: &NoiseModel,
    sets: &[DVector<f64>],
) -> Residuals {
    let unknowns = measurement.unknowns();
    let (k, channels, count) = (sets.len(), unknowns.channels(), segment.instants.len());
    let (ranges, mut states) = filter_nuisance(measurement, segment, noise, sets);
    smooth(&mut states);
    let cad = measurement.cad_of_unknowns();
    let mut first = cad.clone();
    if let Some(set) = sets.first() {
        add_multiple(&mut first, 1.0, set.as_slice());
    }
    let pass = ResidualPass {
        sets,
        first,
        cad,
        variances: noise.offset_tracking_variances(),
    };
    let tasks = ranges.chunks(BLOCKS_PER_TASK);
    let parts = measurement.map(
        tasks.zip(states.chunks(BLOCKS_PER_TASK)),
        |measurement, blocks| {
            let mut sums = ResidualSums::new(channels);
            for (range, state) in blocks.0.iter().zip(blocks.1) {
                for observation in &segment.instants[range.clone()] {
                    pass.add(measurement.rows(observation), state, &mut sums);
                }
            }
            sums
        },
    );
    let mut left = vec![vec![vec![f64::NAN; count]; channels]; k + 2];
    let ResidualSums {
        mut shares,
        mut seen,
        ..
    } = ResidualSums::new(channels);
    let mut i = 0;
    for part in parts {
        for values in part.values.chunks_exact((k + 2) * channels) {
            for (column, value) in left.iter_mut().flatten().zip(values) {
                column[i] = *value;
            }
            i += 1;
        }
        add_multiple(&mut shares, 1.0, &part.shares);
        add_multiple(&mut seen, 1.0, &part.seen);
    }
    let measured = left.pop().unwrap_or_default();
    let predicted = left.pop().unwrap_or_default();
    Residuals {
        noise: left,
        predicted,
        measured,
        ranges,
        nuisance: states,
        shares: DMatrix::from_fn(channels, channels, |i, j| {
            shares[i * channels + j] / seen[i].max(1.0)
        }),
        seen,
    }
}

/// What the pass over some observations gives.
struct ResidualSums {
    /// Per observation and channel: the residual of each set, the prediction of the first set, the
    /// measurement.
    values: Vec<f64>,
    /// Sum of the shares ([`Residuals::shares`]).
    shares: Vec<f64>,
    /// Number of observations in which any row has a channel.
    seen: Vec<f64>,
}

impl ResidualSums {
    fn new(channels: usize) -> Self {
        Self {
            values: Vec::new(),
            shares: vec![0.0; channels * channels],
            seen: vec![0.0; channels],
        }
    }
}

/// The pass over observations for their residuals.
struct ResidualPass<'a> {
    sets: &'a [DVector<f64>],
    /// The parameters of the first set, and CAD's.
    first: Vec<f64>,
    cad: Vec<f64>,
    variances: Vec<f64>,
}

impl ResidualPass<'_> {
    /// Adds an observation with these rows, given the nuisance parameters of all sets.
    fn add(&self, mut rows: MeasurementRows, state: &NuisanceEstimate, sums: &mut ResidualSums) {
        let ResidualSums {
            values,
            shares,
            seen,
        } = sums;
        let (k, channels, start) = (self.sets.len(), seen.len(), values.len());
        values.resize(start + (k + 2) * channels, f64::NAN);
        rows.whiten(&self.variances);
        rows.add_shares(&self.variances, shares);
        let there: Vec<usize> = (0..channels).filter(|&channel| rows.has(channel)).collect();
        there.iter().for_each(|&channel| seen[channel] += 1.0);
        let mut write = |column: usize, of_row: &dyn Fn(usize) -> f64| {
            let white = (0..rows.count).map(of_row).collect();
            let noise = rows.channel_noise(&self.variances, white);
            for &channel in &there {
                values[start + column * channels + channel] = noise[channel];
            }
        };
        for (set, d) in self.sets.iter().enumerate() {
            let s = state.x.column(set);
            write(set, &|row| rows.residual(row, d.as_slice(), s.as_slice()));
        }
        write(k, &|row| dot(rows.a(row), &self.first));
        write(k + 1, &|row| rows.r(row) + dot(rows.a(row), &self.cad));
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::arithmetic::normals;
    use crate::dataset::observation::Observation;
    use crate::measurement::noise_estimate::estimate_noise;
    use crate::measurement::noise_model::Seconds;
    use crate::robot::{IdentificationInput, Robot};
    use nalgebra::{Matrix6, Vector6};
    use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame, Model};
    use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
    use proprio_dynamics::{ContactKind, ContactSpec, FrameMotion, Noise, SensorCut};
    use proprio_topics::{Nanos, Reason};

    /// The iteration ends when the model stays, or returns to an earlier one; then with the
    /// greatest noise of the cycle.
    #[test]
    fn limit_cycles_of_the_iteration_end() {
        let noise = |squares: [f64; 2]| NoiseModel {
            square: squares.to_vec(),
            time: vec![2.0; 2],
            block: vec![1e-3; 2],
            drift_variance: squares.map(|x| 0.01 * x).to_vec(),
            least: vec![1e-9; 2],
            seconds: Seconds::default(),
        };
        let far = [[9.0, 9.0], [5.0, 7.0]].map(noise);
        let cycle_end = |rounds: &[[f64; 2]]| {
            let rounds: Vec<NoiseModel> = far
                .iter()
                .cloned()
                .chain(rounds.iter().copied().map(noise))
                .collect();
            NoiseModel::end_limit_cycle(&rounds, 0.03)
        };
        assert_eq!(cycle_end(&[[1.0, 2.0], [1.2, 2.0], [1.5, 2.0]]), None);
        assert_eq!(
            cycle_end(&[[1.0, 2.0], [1.2, 2.0], [1.201, 2.0]]),
            Some(noise([1.201, 2.0]))
        );
        let found = cycle_end(&[
            [3.0, 3.0],
            [1.0, 2.2],
            [1.3, 2.0],
            [1.1, 2.1],
            [1.001, 2.201],
        ])
        .unwrap();
        assert_eq!(found, noise([1.3, 2.201]));
        assert_eq!(NoiseModel::end_limit_cycle(&far[..1], 0.03), None);
    }

    /// A leg with links between two F/T sensors and a foot beyond that stands on the ground. The
    /// readings of both sensors are in the same six equations.
    pub(crate) fn between_two_sensors() -> Robot {
        let link = |name: &str| {
            format!(
                "<link name=\"{name}\"><inertial><origin xyz=\"0.02 -0.01 0.1\" rpy=\"0 0 \
                 0\"/><mass value=\"1.5\"/><inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" \
                 iyy=\"0.012\" iyz=\"0\" izz=\"0.005\"/></inertial></link>"
            )
        };
        let joint = |name: &str, parent: &str, child: &str, rest: &str| {
            let kind = if rest.is_empty() { "fixed" } else { "revolute" };
            format!(
                "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"{parent}\"/><child \
                 link=\"{child}\"/><origin xyz=\"0 0.03 0.2\" rpy=\"0.3 0.1 0\"/>{rest}</joint>"
            )
        };
        let turns = |axis: &str| {
            format!(
                "<axis xyz=\"{axis}\"/><limit lower=\"-3\" upper=\"3\" effort=\"9\" \
                 velocity=\"9\"/>"
            )
        };
        let urdf = ["base", "thigh", "knee", "shank", "foot"]
            .map(link)
            .concat()
            + &joint("hip_ft", "base", "thigh", "")
            + &joint("j1", "thigh", "knee", &turns("1 0 0"))
            + &joint("j2", "knee", "shank", &turns("0 1 0"))
            + &joint("foot_ft", "shank", "foot", "");
        let urdf = format!("<robot name=\"leg\">{urdf}</robot>");
        let model = Model::from_urdf(&urdf, &["hip_ft", "foot_ft"]).expect("a model");
        let noise = Noise {
            force: [0.08, 0.09, 0.18],
            torque: [0.002, 0.003, 0.0015],
        };
        let cut = |joint: &str| {
            let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
            SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise)
                .expect("a sensor")
        };
        let floor = ContactSpec {
            frame: model.frame("foot").expect("a link"),
            kind: ContactKind::Wrench,
            position: Vec3::zeros(),
        };
        let sensors = [("hip", cut("hip_ft")), ("foot", cut("foot_ft"))];
        let gravity = Vec3::new(0.0, 0.0, -9.80665);
        Robot::standing(
            "leg",
            model.clone(),
            "base",
            &gravity,
            &sensors,
            &[("floor", floor)],
        )
        .expect("it fits")
    }

    /// Readings of both sensors at 100 Hz with CAD as the true model, with these standard
    /// deviations of the noise and of the offsets' steps, [torque; force] of both sensors.
    pub(crate) fn readings(
        robot: &Robot,
        count: usize,
        noise: &[f64; 12],
        walk: &[f64; 12],
    ) -> Vec<Annotated> {
        // For each of the twelve channels: the step of its offset, and its noise.
        let mut deviates = normals(7, 24 * count).into_iter();
        let mut normal = || deviates.next().expect("enough");
        let zero = Wrench::zero();
        let mut instants: Vec<Annotated> = (0..count)
            .map(|k| {
                let t = 0.01 * k as f64;
                let angles = [(1.3, 2.1, 0.4), (1.1, 1.4, 1.9)].map(
                    |(size, rate, phase): (f64, f64, f64)| {
                        let (s, c) = (rate * t + phase).sin_cos();
                        [size * s, size * rate * c, -size * rate * rate * s]
                    },
                );
                Annotated::from(Observation {
                    t: Nanos::from_seconds(t),
                    position: angles.iter().map(|a| a[0]).collect(),
                    velocity: angles.iter().map(|a| a[1]).collect(),
                    acceleration: angles.iter().map(|a| a[2]).collect(),
                    torque: vec![f64::NAN; 2],
                    base_link: robot.base_link,
                    base: FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.80665)),
                    readings: vec![zero; 2],
                    active: robot.always,
                    faults: vec![Reason::None; robot.channels.len()],
                    base_fault: Reason::None,
                    temperatures: Vec::new(),
                })
            })
            .collect();
        let mut measurement = MeasurementModel::for_observations(
            robot,
            &[IdentificationInput::Wrench],
            instants.iter(),
        )
        .expect("rows");
        let mut offset = [0.0; 12];
        for observation in &mut instants {
            // r = 0 for G m + r(0) = 0: the foot's reading is chosen, the hip's follows.
            let rows = measurement.rows(observation);
            assert_eq!(rows.count, 6);
            let g = |first: usize| Matrix6::from_fn(|i, j| rows.g(i)[first + j]);
            let foot = Vector6::new(0.5, -0.3, 0.2, 3.0, -2.0, 20.0);
            let hip = g(0).try_inverse().expect("a transform")
                * (-Vector6::from_fn(|i, _| rows.r(i)) - g(6) * foot);
            for (i, offset) in offset.iter_mut().enumerate() {
                *offset += walk[i] * normal();
            }
            let mut noisy = |exact: &Vector6<f64>, first: usize| {
                let value: [f64; 6] = std::array::from_fn(|i| {
                    exact[i] + offset[first + i] + noise[first + i] * normal()
                });
                Wrench::from_parts(
                    [value[3], value[4], value[5]],
                    [value[0], value[1], value[2]],
                )
            };
            observation.readings = vec![noisy(&hip, 0), noisy(&foot, 6)];
        }
        instants
    }

    fn noise_found(robot: &Robot, instants: &[Annotated], rounds: usize) -> NoiseModel {
        let measurement = MeasurementModel::for_observations(
            robot,
            &[IdentificationInput::Wrench],
            instants.iter(),
        )
        .expect("rows");
        let unknowns = measurement.unknowns().clone();
        assert_eq!((unknowns.sensors.len(), unknowns.channels()), (2, 12));
        let least: Vec<f64> = (0..12)
            .map(|channel| if channel % 6 < 3 { 1e-10 } else { 1e-8 })
            .collect();
        let mut noise = NoiseModel::unknown(least.clone());
        let segment = LogSegment::alone(instants);
        let zero = DVector::zeros(unknowns.parameters());
        let fastest = [f64::INFINITY; 12];
        for _ in 0..rounds {
            let left = residuals(&measurement, segment, &noise, std::slice::from_ref(&zero));
            noise = estimate_noise(&unknowns, std::slice::from_ref(&left), &fastest, &least);
        }
        noise
    }

    /// A disturbance on the foot acts on every joint between it and the base, one on the base on
    /// none. A disturbed sub-tree may be touched at any of its links, so beyond all of its joints.
    #[test]
    fn torques_are_not_used_if_a_disturbance_may_act_beyond() {
        let robot = between_two_sensors();
        let mut instants = readings(&robot, 3, &[0.1; 12], &[0.0; 12]);
        for observation in &mut instants {
            observation.active = proprio_dynamics::ContactSet::default();
            observation.torque = vec![1.0, 2.0];
        }
        let inputs = [IdentificationInput::Wrench, IdentificationInput::Torque];
        let mut measurement =
            MeasurementModel::for_observations(&robot, &inputs, instants.iter()).expect("rows");
        let zero = vec![0.0; measurement.unknowns().parameters()];
        let of_link = |name: &str| {
            let link =
                (0..robot.model.link_count()).find(|&link| robot.model.link_name(link) == name);
            link.and_then(|link| robot.structure.subtree_of(link))
                .expect("a sub-tree")
        };
        for (disturbed, expected) in [
            (None, 2),
            (Some(of_link("base")), 2),
            (Some(of_link("knee")), 0),
            (Some(of_link("foot")), 0),
            (Some(Observation::TORQUES), 0),
        ] {
            let mut observation = instants[1].clone();
            disturbed
                .into_iter()
                .for_each(|unit| observation.disturbed.insert(unit));
            let own = measurement.rows(&observation).of_unit(Observation::TORQUES);
            assert_eq!(own.count, expected, "rows with {disturbed:?}");
            if disturbed != Some(Observation::TORQUES) {
                let errors = measurement
                    .torque_errors(&observation, &zero)
                    .expect("errors");
                let there = errors.iter().filter(|x| x.is_finite()).count();
                assert_eq!(there, expected, "compared with {disturbed:?}");
            }
        }
    }

    const HIP_AND_FOOT: [f64; 12] = [
        0.02, 0.03, 0.015, 0.4, 0.3, 0.5, 0.004, 0.006, 0.003, 0.1, 0.08, 0.15,
    ];

    #[test]
    fn the_noise_of_two_sensors_is_separated() {
        let robot = between_two_sensors();
        let instants = readings(&robot, 6000, &HIP_AND_FOOT, &[0.0; 12]);
        let noise = noise_found(&robot, &instants, 12);
        // Lever arms separate the forces. Torques differ only by the rotation between the sensors,
        // so that they are hardly separable; their sum is well determined.
        let is_torque = |channel: &usize| channel % 6 < 3;
        for channel in (0..12).filter(|channel| !is_torque(channel)) {
            let ratio = noise.square[channel].sqrt() / HIP_AND_FOOT[channel];
            println!(
                "channel {channel}: {ratio:.3}, time {:.2}, drift {:.2e}",
                noise.time[channel], noise.drift_variance[channel]
            );
            // The quieter sensor has a quarter of the other's noise. Its lower limit is half of the
            // mean noise of both.
            let most = if channel < 6 { 1.05 } else { 1.5 };
            assert!((0.95..most).contains(&ratio), "channel {channel}: {ratio}");
        }
        let of_torques =
            |square: &dyn Fn(usize) -> f64| (0..12).filter(is_torque).map(square).sum::<f64>();
        let ratio = of_torques(&|channel| noise.square[channel])
            / of_torques(&|channel| HIP_AND_FOOT[channel].powi(2));
        assert!((ratio - 1.0).abs() < 0.15, "{ratio}");
        // No channel is without noise.
        let relative =
            |channel: usize| noise.inflated()[channel] / if channel % 6 < 3 { 1e-10 } else { 1e-8 };
        for kind in [[0, 1, 2, 6, 7, 8], [3, 4, 5, 9, 10, 11]] {
            let all: Vec<f64> = kind.into_iter().map(relative).collect();
            let greatest = all.iter().copied().fold(0.0, f64::max);
            assert!(
                all.iter().all(|own| *own >= 0.25 * greatest / 6.0),
                "{all:?}"
            );
        }
    }

    /// Rows that show only the sum of two offsets do not determine which of them drifts, but they
    /// determine the total drift.
    #[test]
    fn the_total_drift_of_two_offsets_is_found() {
        let robot = between_two_sensors();
        let mut walk = [0.0; 12];
        walk[3..6].fill(0.003);
        walk[9..12].fill(0.003);
        let instants = readings(&robot, 6000, &HIP_AND_FOOT, &walk);
        let noise = noise_found(&robot, &instants, 12);
        for (channel, (square, expected)) in noise.square.iter().zip(HIP_AND_FOOT).enumerate() {
            println!(
                "channel {channel}: {:.3}, drift {:.2e}",
                square.sqrt() / expected,
                noise.drift_variance[channel]
            );
        }
        let whole: f64 = [3, 4, 5, 9, 10, 11]
            .map(|channel| noise.drift_variance[channel])
            .iter()
            .sum();
        let expected = 6.0 * 0.003 * 0.003 / 0.01;
        assert!(
            (0.5..2.0).contains(&(whole / expected)),
            "{whole}, not {expected}"
        );
    }
}
