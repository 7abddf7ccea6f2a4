//! How well parameters predict a log: the figure by which they are judged, for CAD and for what was
//! identified alike. It depends on the log and on the parameters alone.
//!
//! ```text
//! e_k(t) = (1 + E_k)^-1 M_k (r - A d - G s)       what F/T sensor k reads less what all else predicts
//! s      = argmin  sum over t, k of |S e_k(t)|^2
//! error  = ( sum |S e_k|^2 / sum |S (y_k - mean y_k)|^2 )^1/2
//! ```
//!
//! `M_k` lays all of what the rows leave to sensor `k` ([`laid_to`]), `E_k` is what is wrong with its
//! gain: readings are predicted as the sensor gives them, for two sensors that are corrected to
//! nothing would agree perfectly. `S` turns forces into moments ([`Layout::scale`]).
//! Parameters, gains and friction are as they were found in the training logs. Free are the offsets
//! `s` alone: one constant for each channel and log; and, for a second figure, a linear drift besides.
//! (An offset that walks takes up what the model has wrong, the more the faster it may walk.)
//! Parameters found on-line are judged as they were in force: at each instant those that had been learnt
//! by then, beside the offsets that these leave in the log as a whole ([`predicted`]).

use super::assess::{both, channel_of, laid_to, rms, sensor_name};
use super::instants::Instant;
use super::outcome::{Both, InForce, Predicted};
use super::parallel;
use super::passes::OFFSET_VARIANCE;
use super::rows::{FRICTION, Further, Layout, RowMaker, Rows};
use super::{add_multiple, dot};
use crate::calibration::{Kind, Unknown};
use crate::config::{Gain, IdentificationInput};
use crate::dynamics::DynamicsError;
use crate::setup::Setup;
use crate::spatial::RigidInertia;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Matrix6xX, Vector3, Vector6};
use proprio_topics::Nanos;

/// Instants of a log that are looked at, at the most: its RMS is known from these to 1 %, and CAD's
/// and another's are of the same ones.
const MOST: usize = 20_000;

/// Instants that one thread takes at a time.
const TOGETHER: usize = 256;

/// Parameters to be judged.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    /// Less CAD's, from some instant on, in the columns of a layout.
    pub course: Vec<(Nanos, DVector<f64>)>,
    /// Of each joint of that layout.
    pub friction: Vec<[f64; FRICTION]>,
}

/// What a candidate leaves of a log, at the instants that were looked at; NaN where nothing is
/// compared.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Errors {
    /// Per channel of the layout, readings with constant offsets, and torques.
    pub channels: Vec<Vec<f64>>,
    /// Per channel of F/T sensors, with linear drifts; empty if these were not asked for.
    pub drifting: Vec<Vec<f64>>,
    /// Per degree of freedom whose torque two sides tell, their difference.
    pub routes: Vec<Vec<f64>>,
}

/// Which offsets are free.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Free {
    Constants,
    /// Once constants alone, once linear drifts besides.
    WithDrifts,
}

/// A log to judge parameters by, and what rows can be made of it.
pub(super) struct Yardstick<'a> {
    maker: RowMaker<'a>,
    instants: Vec<Instant>,
}

/// The candidates in the columns of the log's own layout.
struct Plan {
    /// All parameters that any of them has in force at any time.
    sets: Vec<Set>,
    /// Distinct gains: what turns an error of what each sensor measures into one of what it reads.
    gains: Vec<Vec<Matrix6<f64>>>,
    courses: Vec<Course>,
}

/// What a candidate has in force.
struct Course {
    /// From when on which set.
    sets: Vec<(Nanos, usize)>,
    /// Of each joint.
    friction: Vec<[f64; FRICTION]>,
}

struct Set {
    d: DVector<f64>,
    /// Which gains.
    gains: usize,
}

/// How well parameters that were in force at their times predict what F/T sensors read at the instants
/// of a log, beside CAD's with the workbench's calibrations. `cad` is a setup without identified
/// parameters, of which the instants were made; the course ascends in time, and its first parameters
/// hold from the beginning.
///
/// # Errors
/// Instants of another robot.
pub(crate) fn predicted(cad: &Setup, instants: &[Instant], course: &[InForce]) -> Result<Predicted, DynamicsError> {
    let has_gains = course.iter().any(|in_force| in_force.calibrations != cad.calibrations);
    let kind = if has_gains {
        Kind {
            gain: Gain::Full,
            temperature: true,
        }
    } else {
        Kind::default()
    };
    let yardstick = Yardstick::of_record(cad, &[IdentificationInput::Wrench], kind, instants)?;
    let layout = Layout {
        links: (0..cad.model.link_count()).collect(),
        further: (0..cad.calibrations.len())
            .flat_map(|sensor| {
                kind.unknowns()
                    .map(move |unknown| Further::Calibration(sensor, unknown))
            })
            .collect(),
        ..Layout::default()
    };
    let of_cad = vec![(Nanos::ZERO, DVector::zeros(layout.unknowns()))];
    let own = course
        .iter()
        .map(|in_force| (in_force.since, beside(cad, &layout, in_force)));
    let candidates = [of_cad, own.collect()].map(|course| Candidate {
        course,
        friction: Vec::new(),
    });
    Ok(yardstick.predicted(&layout, &candidates))
}

/// Parameters less CAD's, in the columns of a layout.
fn beside(cad: &Setup, layout: &Layout, in_force: &InForce) -> DVector<f64> {
    let mut d = DVector::zeros(layout.unknowns());
    for (place, &link) in layout.links.iter().enumerate() {
        let parameters = [&in_force.bodies[link], &cad.model.inertias()[link]].map(RigidInertia::parameters);
        let change = parameters[0].iter().zip(parameters[1]).map(|(own, cad)| own - cad);
        d.rows_mut(10 * place, 10)
            .iter_mut()
            .zip(change)
            .for_each(|(d, change)| *d = change);
    }
    let changes: Vec<(Matrix6<f64>, [f64; 6])> = in_force
        .calibrations
        .iter()
        .zip(&cad.calibrations)
        .map(|(own, workbench)| own.after(workbench))
        .collect();
    for (further, value) in layout.further.iter().zip(d.iter_mut().skip(layout.inertial())) {
        if let Further::Calibration(sensor, unknown) = *further {
            let (gain, per_kelvin) = &changes[sensor];
            *value = match unknown {
                Unknown::Gain { channel, of } => gain[(channel, of)],
                Unknown::Temperature { channel } => per_kelvin[channel],
            };
        }
    }
    d
}

/// One comparison of an instant.
struct Comparison {
    of: Of,
    /// What each set leaves without offsets.
    left: Vec<f64>,
    /// What the offsets are multiplied by in it, for each of the distinct gains.
    h: Vec<Vec<f64>>,
}

/// What is compared.
#[derive(Clone, Copy)]
enum Of {
    Channel(usize),
    Route(usize),
}

impl<'a> Yardstick<'a> {
    /// By all that was recorded, whatever a fit found to act on the robot.
    ///
    /// # Errors
    /// Instants of another robot.
    pub(super) fn of_record(
        setup: &'a Setup,
        inputs: &[IdentificationInput],
        calibrated: Kind,
        instants: &[Instant],
    ) -> Result<Self, DynamicsError> {
        let stride = instants.len().div_ceil(MOST).max(1);
        let recorded = |instant: &Instant| Instant {
            suspected: Default::default(),
            fitted: Vec::new(),
            shaking: Vec::new(),
            ..instant.clone()
        };
        let instants: Vec<Instant> = instants.iter().step_by(stride).map(recorded).collect();
        let mut maker = RowMaker::survey(setup, inputs, instants.iter())?;
        maker.calibrate(calibrated, instants.iter());
        Ok(Self { maker, instants })
    }

    /// By what the parameters may be fitted to, in the columns of `maker`.
    pub(super) fn of_fit(maker: &RowMaker<'a>, instants: &[Instant]) -> Self {
        let given = |instant: &Instant| Instant {
            fitted: Vec::new(),
            ..instant.clone()
        };
        Self {
            maker: maker.clone(),
            instants: instants.iter().map(given).collect(),
        }
    }

    fn layout(&self) -> &Layout {
        self.maker.layout()
    }

    /// The figures of what F/T sensors read; none of joint torques.
    pub(super) fn predicted(&self, layout: &Layout, candidates: &[Candidate; 2]) -> Predicted {
        let setup = self.maker.setup();
        let errors = self.errors(layout, candidates, Free::WithDrifts);
        let layout = self.layout();
        let (mut squares, mut all) = ([[0.0; 2]; 2], 0.0);
        for channel in 0..6 * layout.sensors.len() {
            let weighed = |values: &[f64]| -> f64 {
                let finite = values.iter().filter(|x| x.is_finite());
                finite.map(|x| (x * layout.scale(channel)).powi(2)).sum()
            };
            for ([constant, drifting], errors) in squares.iter_mut().zip(&errors) {
                *constant += weighed(&errors.channels[channel]);
                *drifting += weighed(&errors.drifting[channel]);
            }
            all += weighed(&self.load(channel, &errors[0]));
        }
        let relative = |which: usize| both(squares.map(|of| (of[which] / all).sqrt()));
        let series = |of: &dyn Fn(&Errors) -> f64| both([of(&errors[0]), of(&errors[1])]);
        let of_channel = |channel: usize| series(&|errors| rms(errors.channels[channel].iter().copied()));
        let of_sensor = |place: usize| {
            let axes: [Both<f64>; 6] = std::array::from_fn(|axis| of_channel(channel_of(place, axis)));
            both([axes.map(|axis| axis.cad), axes.map(|axis| axis.identified)])
        };
        let routes = (0..setup.model.dof_count()).map(|dof| {
            let of_dof = series(&|errors| rms(errors.routes[dof].iter().copied()));
            (setup.model.dof_name(dof).to_owned(), of_dof)
        });
        Predicted {
            relative_error: relative(0),
            relative_error_with_drift: relative(1),
            joints: Vec::new(),
            sensors: (layout.sensors.iter().enumerate())
                .map(|(place, sensor)| (sensor_name(setup, *sensor), of_sensor(place)))
                .collect(),
            two_route: routes.filter(|(_, rms)| rms.cad.is_finite()).collect(),
        }
    }

    /// Readings of a channel of F/T sensors, less their mean over the log, where errors are known.
    pub(super) fn load(&self, channel: usize, errors: &Errors) -> Vec<f64> {
        let sensor = self.layout().sensors[channel / 6];
        let pairs = self.instants.iter().zip(&errors.channels[channel]);
        let read = pairs.filter(|(_, error)| error.is_finite());
        let load: Vec<f64> = read
            .map(|(i, _)| i.readings[sensor].torque_first()[channel % 6])
            .collect();
        let mean = load.iter().sum::<f64>() / load.len().max(1) as f64;
        load.into_iter().map(|x| x - mean).collect()
    }

    /// What each of the candidates, given in the columns of `layout`, leaves.
    pub(super) fn errors(&self, layout: &Layout, candidates: &[Candidate], free: Free) -> Vec<Errors> {
        let own = self.layout();
        let (offsets, channels) = (6 * own.sensors.len(), own.channels());
        let drifts = if free == Free::WithDrifts { offsets } else { 0 };
        let width = offsets + drifts;
        let dofs = self.maker.setup().model.dof_count();
        let plan = Plan::new(layout, own, candidates);
        let all: Vec<usize> = (0..plan.sets.len()).collect();
        // First the offsets, of each set in all of the log; then what the sets in force leave.
        let zero = || {
            let normals = vec![DMatrix::zeros(width, width); plan.gains.len()];
            (normals, vec![DVector::zeros(width); plan.sets.len()])
        };
        let sums = self.over(zero, |(normals, rights), made| {
            for Comparison { of, left, h } in comparisons(made, &plan, &all) {
                let Of::Channel(channel) = of else { continue };
                let square = own.scale(channel).powi(2);
                let lines: Vec<Vec<f64>> = h.iter().map(|h| line(h, made.late, drifts)).collect();
                for (normal, line) in normals.iter_mut().zip(&lines) {
                    for (i, x) in line.iter().enumerate().filter(|(_, x)| **x != 0.0) {
                        let column = &mut normal.as_mut_slice()[width * i..][..width];
                        add_multiple(column, square * x, line);
                    }
                }
                for ((right, left), set) in rights.iter_mut().zip(left).zip(&plan.sets) {
                    add_multiple(right.as_mut_slice(), square * left, &lines[set.gains]);
                }
            }
        });
        let sums = sums.into_iter().reduce(|(mut normals, mut rights), (more, others)| {
            normals.iter_mut().zip(more).for_each(|(normal, more)| *normal += more);
            rights.iter_mut().zip(others).for_each(|(right, other)| *right += other);
            (normals, rights)
        });
        let (normals, rights) = sums.unwrap_or_else(zero);
        let fitted: Vec<[DVector<f64>; 2]> = (rights.iter().zip(&plan.sets))
            .map(|(right, set)| [offsets, width].map(|count| solved(&normals[set.gains], right, count)))
            .collect();
        let width = channels + drifts + dofs;
        let values = self.over(Vec::new, |values: &mut Vec<f64>, made| {
            let start = values.len();
            values.resize(start + candidates.len() * width, f64::NAN);
            let out = &mut values[start..];
            let in_force = plan.in_force(made.instant.t);
            for Comparison { of, left, h } in comparisons(made, &plan, &in_force) {
                for ((out, left), &set) in out.chunks_exact_mut(width).zip(left).zip(&in_force) {
                    let ([constant, drifting], h) = (&fitted[set], &h[plan.sets[set].gains]);
                    let remains = left - dot(h, constant.as_slice());
                    match of {
                        Of::Route(dof) => out[channels + drifts + dof] = remains,
                        Of::Channel(channel) => {
                            out[channel] = remains;
                            if channel < drifts {
                                let line = line(h, made.late, drifts);
                                out[channels + channel] = left - dot(&line, drifting.as_slice());
                            }
                        }
                    }
                }
            }
            for (row, joint) in (0..made.rows.count).filter_map(|row| Some((row, made.rows.joint(row, offsets)?))) {
                let share = &made.rows.g(row)[offsets + FRICTION * joint..][..FRICTION];
                for ((out, &set), Course { friction, .. }) in
                    out.chunks_exact_mut(width).zip(&in_force).zip(&plan.courses)
                {
                    let d = plan.sets[set].d.as_slice();
                    out[offsets + joint] = made.rows.r(row) - dot(made.rows.a(row), d) - dot(share, &friction[joint]);
                }
            }
        });
        let values: Vec<f64> = values.concat();
        let column = |which: usize, place: usize| -> Vec<f64> {
            let at = which * width + place;
            values
                .chunks_exact(candidates.len() * width)
                .map(|all| all[at])
                .collect()
        };
        (0..candidates.len())
            .map(|which| Errors {
                channels: (0..channels).map(|channel| column(which, channel)).collect(),
                drifting: (channels..channels + drifts)
                    .map(|place| column(which, place))
                    .collect(),
                routes: (channels + drifts..width).map(|place| column(which, place)).collect(),
            })
            .collect()
    }

    /// Runs over all instants, on all cores, with something of its own for each part of the log.
    fn over<T: Send>(&self, make: impl Fn() -> T + Sync, each: impl Fn(&mut T, &Made<'_, '_>) + Sync) -> Vec<T> {
        let trusted = stated_variances(self.maker.setup(), self.layout());
        let (Some(first), Some(last)) = (self.instants.first(), self.instants.last()) else {
            return Vec::new();
        };
        let half = 0.5 * (last.t - first.t).seconds().max(f64::MIN_POSITIVE);
        parallel::map_with(
            self.instants.len().div_ceil(TOGETHER),
            || (self.maker.clone(), Rows::new(self.layout())),
            |(maker, rows), part| {
                let mut own = make();
                let end = self.instants.len().min(TOGETHER * (part + 1));
                for instant in &self.instants[TOGETHER * part..end] {
                    if maker.make(instant, rows).is_err() {
                        rows.clear();
                    }
                    let made = Made {
                        late: (instant.t - first.t).seconds() / half - 1.0,
                        instant,
                        maker,
                        rows,
                        trusted: &trusted,
                    };
                    each(&mut own, &made);
                }
                own
            },
        )
    }
}

/// An instant of which rows were made.
struct Made<'a, 'b> {
    instant: &'a Instant,
    /// From -1 at the log's beginning to 1 at its end.
    late: f64,
    maker: &'a RowMaker<'b>,
    rows: &'a Rows,
    trusted: &'a [f64],
}

/// What is compared at an instant, with these sets: readings, and two routes to a torque.
fn comparisons(made: &Made<'_, '_>, plan: &Plan, sets: &[usize]) -> Vec<Comparison> {
    let (rows, layout) = (made.rows, made.maker.layout());
    let offsets = 6 * layout.sensors.len();
    let left: Vec<DVector<f64>> = sets
        .iter()
        .map(|&set| &plan.sets[set].d)
        .map(|d| DVector::from_fn(rows.count, |row, _| rows.r(row) - dot(rows.a(row), d.as_slice())))
        .collect();
    let g = DMatrix::from_fn(rows.count, offsets, |row, column| rows.g(row)[column]);
    let mut compared = Vec::new();
    for place in 0..layout.sensors.len() {
        let Some(map) = laid_to(rows, made.trusted, 6 * place..6 * place + 6) else {
            continue;
        };
        let maps: Vec<Matrix6xX<f64>> = plan.gains.iter().map(|gains| gains[place] * &map).collect();
        let h: Vec<Matrix6xX<f64>> = maps.iter().map(|map| map * &g).collect();
        let each = left.iter().zip(sets);
        let errors: Vec<Vector6<f64>> = each.map(|(left, &set)| &maps[plan.sets[set].gains] * left).collect();
        for k in (0..6).filter(|k| rows.has(6 * place + k)) {
            compared.push(Comparison {
                of: Of::Channel(6 * place + k),
                left: errors.iter().map(|error| error[k]).collect(),
                h: h.iter().map(|h| h.row(k).iter().copied().collect()).collect(),
            });
        }
    }
    for (dof, along) in made.maker.two_routes(rows) {
        compared.push(Comparison {
            of: Of::Route(dof),
            left: left.iter().map(|left| along.dot(left)).collect(),
            h: vec![g.tr_mul(&along).as_slice().to_vec(); plan.gains.len()],
        });
    }
    compared
}

impl Plan {
    fn new(from: &Layout, to: &Layout, candidates: &[Candidate]) -> Self {
        let mut plan = Self {
            sets: Vec::new(),
            gains: Vec::new(),
            courses: Vec::new(),
        };
        for Candidate { course, friction } in candidates {
            let mut own: Vec<(Nanos, usize)> = Vec::new();
            for (since, d) in course {
                let d = carried(from, d, to);
                if own.last().is_some_and(|(_, set)| plan.sets[*set].d == d) {
                    continue;
                }
                let gains = gains(to, &d);
                let known = plan.gains.iter().position(|other| *other == gains);
                let number = known.unwrap_or(plan.gains.len());
                if known.is_none() {
                    plan.gains.push(gains);
                }
                own.push((*since, plan.sets.len()));
                plan.sets.push(Set { d, gains: number });
            }
            let of_joint = |dof: &usize| {
                let place = from.joints.binary_search(dof).ok();
                place.map_or([0.0; FRICTION], |place| friction[place])
            };
            plan.courses.push(Course {
                sets: own,
                friction: to.joints.iter().map(of_joint).collect(),
            });
        }
        plan
    }

    /// The set that each candidate has in force at an instant; the first from the beginning.
    fn in_force(&self, t: Nanos) -> Vec<usize> {
        let of_course = |Course { sets, .. }: &Course| {
            let at = sets.partition_point(|(since, _)| *since <= t);
            sets[at.saturating_sub(1)].1
        };
        self.courses.iter().map(of_course).collect()
    }
}

/// What constants are multiplied by, and after it so many drifts.
fn line(h: &[f64], late: f64, drifts: usize) -> Vec<f64> {
    h.iter()
        .copied()
        .chain(h.iter().take(drifts).map(|x| late * x))
        .collect()
}

/// The first so many offsets that leave least. Those of which nothing shows are nought.
fn solved(normal: &DMatrix<f64>, right: &DVector<f64>, count: usize) -> DVector<f64> {
    let mut own = normal.view((0, 0), (count, count)).into_owned();
    for i in 0..count {
        own[(i, i)] += 1.0 / OFFSET_VARIANCE;
    }
    let right = right.rows(0, count).into_owned();
    let solution = own.cholesky().map(|factor| factor.solve(&right));
    solution.unwrap_or_else(|| DVector::zeros(count))
}

/// The variances of readings as stated: which of several sensors takes what the rows leave must not
/// depend on what was found in a log.
fn stated_variances(setup: &Setup, layout: &Layout) -> Vec<f64> {
    let mut variances: Vec<f64> = layout.stated(setup).map(|x| x * x).collect();
    variances.resize(layout.channels(), 1.0);
    variances
}

/// Parameters in the columns of another layout; CAD's where `from` has none.
fn carried(from: &Layout, d: &DVector<f64>, to: &Layout) -> DVector<f64> {
    let mut out = DVector::zeros(to.unknowns());
    for (place, link) in to.links.iter().enumerate() {
        if let Ok(other) = from.links.binary_search(link) {
            out.rows_mut(10 * place, 10).copy_from(&d.rows(10 * other, 10));
        }
    }
    for (place, further) in to.further.iter().enumerate() {
        if let Some(column) = from.column(*further) {
            out[to.inertial() + place] = d[column];
        }
    }
    out
}

/// Of each sensor of the layout, what turns an error of what it measures into one of what it reads.
fn gains(layout: &Layout, d: &DVector<f64>) -> Vec<Matrix6<f64>> {
    let of_sensor = |sensor: &usize| {
        let mut gain = Matrix6::identity();
        for (further, value) in layout.further.iter().zip(d.iter().skip(layout.inertial())) {
            if let Further::Calibration(own, Unknown::Gain { channel, of }) = further
                && own == sensor
            {
                gain[(*channel, *of)] += value;
            }
        }
        gain.try_inverse().unwrap_or_else(Matrix6::identity)
    };
    layout.sensors.iter().map(of_sensor).collect()
}

/// For each set of parameters the friction, one of each joint of the layout for all these instants
/// together, that leaves least of their torques.
pub(super) fn friction<'b>(
    maker: &RowMaker<'_>,
    instants: impl Iterator<Item = &'b Instant>,
    sets: &[DVector<f64>],
) -> Vec<Vec<[f64; FRICTION]>> {
    let layout = maker.layout();
    let (joints, offsets) = (layout.joints.len(), 6 * layout.sensors.len());
    if joints == 0 {
        return vec![Vec::new(); sets.len()];
    }
    let zero = || vec![(Matrix3::zeros(), vec![Vector3::zeros(); sets.len()]); joints];
    let instants: Vec<&Instant> = instants.collect();
    let parts = parallel::map_with(
        instants.len().div_ceil(TOGETHER),
        || (maker.clone(), Rows::new(layout)),
        |(maker, rows), part| {
            let mut sums = zero();
            let end = instants.len().min(TOGETHER * (part + 1));
            for instant in &instants[TOGETHER * part..end] {
                if maker.make(instant, rows).is_err() {
                    continue;
                }
                for row in 0..rows.count {
                    let Some(joint) = rows.joint(row, offsets) else {
                        continue;
                    };
                    let g = Vector3::from_column_slice(&rows.g(row)[offsets + FRICTION * joint..][..FRICTION]);
                    let (normal, rights) = &mut sums[joint];
                    *normal += g * g.transpose();
                    for (right, d) in rights.iter_mut().zip(sets) {
                        *right += g * (rows.r(row) - dot(rows.a(row), d.as_slice()));
                    }
                }
            }
            sums
        },
    );
    let mut total = zero();
    for part in parts {
        for ((normal, rights), (more, others)) in total.iter_mut().zip(part) {
            *normal += more;
            rights.iter_mut().zip(others).for_each(|(right, other)| *right += other);
        }
    }
    let solve = |normal: &Matrix3<f64>, right: &Vector3<f64>| -> [f64; FRICTION] {
        // A joint that stands still has no friction that shows.
        let solution = normal.svd(true, true).solve(right, 1e-9 * normal.norm());
        solution.unwrap_or_else(|_| Vector3::zeros()).into()
    };
    (0..sets.len())
        .map(|set| {
            total
                .iter()
                .map(|(normal, rights)| solve(normal, &rights[set]))
                .collect()
        })
        .collect()
}
