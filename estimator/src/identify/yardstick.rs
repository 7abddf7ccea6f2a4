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
//! nothing would agree perfectly. `S` turns forces into moments ([`Structure::LENGTH_SCALE`]).
//! Parameters, gains and friction are as they were found in the training logs. Free are the offsets
//! `s` alone: one constant for each channel and log; and, for a second figure, a linear drift besides.
//! (An offset that walks takes up what the model has wrong, the more the faster it may walk.)

use super::assess::laid_to;
use super::instants::Instant;
use super::parallel;
use super::passes::OFFSET_VARIANCE;
use super::rows::{FRICTION, Further, Layout, RowMaker, Rows};
use super::{add_multiple, dot};
use crate::calibration::{Kind, Unknown};
use crate::config::IdentificationInput;
use crate::dynamics::{DynamicsError, Structure};
use crate::setup::Setup;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3};
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
    /// Per channel of F/T sensors, with linear drifts.
    pub drifting: Vec<Vec<f64>>,
    /// Per degree of freedom whose torque two sides tell, their difference.
    pub routes: Vec<Vec<f64>>,
}

/// A log to judge parameters by, and what rows can be made of it.
pub(super) struct Yardstick<'a> {
    maker: RowMaker<'a>,
    instants: Vec<Instant>,
}

/// A candidate in the columns of the log's own layout.
struct Own {
    course: Vec<InForce>,
    friction: Vec<[f64; FRICTION]>,
}

/// From when on, parameters, and what turns an error of what each sensor measures into one of what it
/// reads.
type InForce = (Nanos, DVector<f64>, Vec<Matrix6<f64>>);

/// One comparison of an instant.
struct Comparison {
    of: Of,
    /// What each candidate leaves without offsets.
    left: Vec<f64>,
    /// What the offsets are multiplied by in it: by each candidate, or by all alike.
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

    pub(super) fn layout(&self) -> &Layout {
        self.maker.layout()
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
    pub(super) fn errors(&self, layout: &Layout, candidates: &[Candidate]) -> Vec<Errors> {
        let own = self.layout();
        let (offsets, channels) = (6 * own.sensors.len(), own.channels());
        let dofs = self.maker.setup().model.dof_count();
        let candidates: Vec<Own> = candidates.iter().map(|candidate| candidate.of(layout, own)).collect();
        // Offsets are multiplied alike by all candidates but those that change gains.
        let ways = if candidates.iter().any(Own::has_gains) {
            candidates.len()
        } else {
            1
        };
        // First the offsets, then what they leave.
        let zero = || {
            let normals = vec![DMatrix::zeros(2 * offsets, 2 * offsets); ways];
            (normals, vec![DVector::zeros(2 * offsets); candidates.len()])
        };
        let sums = self.over(&candidates, zero, |(normals, rights), late, compared| {
            for Comparison { of, left, h } in compared {
                let Of::Channel(channel) = of else { continue };
                let square = scale(*channel).powi(2);
                let lines: Vec<Vec<f64>> = h.iter().map(|h| twice(h, late)).collect();
                for (normal, line) in normals.iter_mut().zip(lines.iter().cycle()) {
                    for (i, x) in line.iter().enumerate().filter(|(_, x)| **x != 0.0) {
                        let column = &mut normal.as_mut_slice()[2 * offsets * i..][..2 * offsets];
                        add_multiple(column, square * x, line);
                    }
                }
                for ((right, left), line) in rights.iter_mut().zip(left).zip(lines.iter().cycle()) {
                    add_multiple(right.as_mut_slice(), square * left, line);
                }
            }
        });
        let sums = sums.into_iter().reduce(|(mut normals, mut rights), (more, others)| {
            normals.iter_mut().zip(more).for_each(|(normal, more)| *normal += more);
            rights.iter_mut().zip(others).for_each(|(right, other)| *right += other);
            (normals, rights)
        });
        let (normals, rights) = sums.unwrap_or_else(zero);
        let fitted: Vec<[DVector<f64>; 2]> = rights
            .iter()
            .zip(normals.iter().cycle())
            .map(|(right, normal)| [offsets, 2 * offsets].map(|count| solved(normal, right, count)))
            .collect();
        let width = channels + offsets + dofs;
        let values = self.over(&candidates, Vec::new, |values: &mut Vec<f64>, late, compared| {
            let start = values.len();
            values.resize(start + candidates.len() * width, f64::NAN);
            for Comparison { of, left, h } in compared {
                let places = values[start..].chunks_exact_mut(width).zip(left).zip(&fitted);
                for (((out, left), [constant, drifting]), h) in places.zip(h.iter().cycle()) {
                    let remains = left - dot(h, constant.as_slice());
                    match *of {
                        Of::Route(dof) => out[channels + offsets + dof] = remains,
                        Of::Channel(channel) => {
                            out[channel] = remains;
                            if channel < offsets {
                                out[channels + channel] = left - dot(&twice(h, late), drifting.as_slice());
                            }
                        }
                    }
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
                drifting: (channels..channels + offsets)
                    .map(|place| column(which, place))
                    .collect(),
                routes: (channels + offsets..width).map(|place| column(which, place)).collect(),
            })
            .collect()
    }

    /// Runs over all instants, on all cores, with something of its own for each part of the log: `each`
    /// gets how late in the log an instant is, from -1 to 1, and what is compared there.
    fn over<T: Send>(
        &self,
        candidates: &[Own],
        make: impl Fn() -> T + Sync,
        each: impl Fn(&mut T, f64, &[Comparison]) + Sync,
    ) -> Vec<T> {
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
                    let late = (instant.t - first.t).seconds() / half - 1.0;
                    let compared = match maker.make(instant, rows) {
                        Ok(()) => comparisons(maker, rows, instant, &trusted, candidates),
                        Err(_) => Vec::new(),
                    };
                    each(&mut own, late, &compared);
                }
                own
            },
        )
    }
}

/// What is compared at an instant of which rows were made.
fn comparisons(
    maker: &RowMaker<'_>,
    rows: &Rows,
    instant: &Instant,
    trusted: &[f64],
    candidates: &[Own],
) -> Vec<Comparison> {
    let layout = maker.layout();
    let offsets = 6 * layout.sensors.len();
    let in_force: Vec<&InForce> = candidates
        .iter()
        .map(|candidate| {
            let at = candidate.course.partition_point(|(from, ..)| *from <= instant.t);
            &candidate.course[at.saturating_sub(1)]
        })
        .collect();
    let left: Vec<DVector<f64>> = in_force
        .iter()
        .map(|(_, d, _)| DVector::from_fn(rows.count, |row, _| rows.r(row) - dot(rows.a(row), d.as_slice())))
        .collect();
    let g = DMatrix::from_fn(rows.count, offsets, |row, column| rows.g(row)[column]);
    let mut compared = Vec::new();
    for place in 0..layout.sensors.len() {
        let Some(map) = laid_to(rows, trusted, 6 * place..6 * place + 6) else {
            continue;
        };
        let h = &map * &g;
        let row = |matrix: &DMatrix<f64>, k: usize| matrix.row(k).iter().copied().collect();
        let (errors, ways): (Vec<DVector<f64>>, Vec<DMatrix<f64>>) = if candidates.iter().any(Own::has_gains) {
            let each = left.iter().zip(&in_force);
            each.map(|(left, (.., gains))| {
                let gain = DMatrix::from_fn(6, 6, |i, j| gains[place][(i, j)]);
                (&gain * (&map * left), gain * &h)
            })
            .unzip()
        } else {
            (left.iter().map(|left| &map * left).collect(), vec![h])
        };
        for k in (0..6).filter(|k| rows.has(6 * place + k)) {
            compared.push(Comparison {
                of: Of::Channel(6 * place + k),
                left: errors.iter().map(|error| error[k]).collect(),
                h: ways.iter().map(|h| row(h, k)).collect(),
            });
        }
    }
    for row in 0..rows.count {
        if let Some(joint) = rows.joint(row, offsets) {
            let share = &rows.g(row)[offsets + FRICTION * joint..][..FRICTION];
            let each = left.iter().zip(candidates);
            compared.push(Comparison {
                of: Of::Channel(offsets + joint),
                left: each
                    .map(|(left, own)| left[row] - dot(share, &own.friction[joint]))
                    .collect(),
                h: vec![vec![0.0; offsets]],
            });
        }
    }
    for (dof, along) in maker.two_routes(rows) {
        compared.push(Comparison {
            of: Of::Route(dof),
            left: left.iter().map(|left| along.dot(left)).collect(),
            h: vec![g.tr_mul(&along).as_slice().to_vec()],
        });
    }
    compared
}

impl Own {
    fn has_gains(&self) -> bool {
        let mut gains = self.course.iter().flat_map(|(.., gains)| gains);
        gains.any(|gain| *gain != Matrix6::identity())
    }
}

impl Candidate {
    /// In the columns of another layout.
    fn of(&self, from: &Layout, to: &Layout) -> Own {
        let carried = |d: &DVector<f64>| carried(from, d, to);
        let course = self.course.iter().map(|(t, d)| (*t, carried(d)));
        let friction = |dof: &usize| {
            let place = from.joints.binary_search(dof).ok();
            place.map_or([0.0; FRICTION], |place| self.friction[place])
        };
        Own {
            course: course.map(|(t, d)| (t, d.clone(), gains(to, &d))).collect(),
            friction: to.joints.iter().map(friction).collect(),
        }
    }
}

/// What turns the unit of a channel of F/T sensors into Nm.
pub(super) fn scale(channel: usize) -> f64 {
    if channel % 6 < 3 { 1.0 } else { Structure::LENGTH_SCALE }
}

/// A line for constants and drifts.
fn twice(h: &[f64], late: f64) -> Vec<f64> {
    h.iter().copied().chain(h.iter().map(|x| late * x)).collect()
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
pub(super) fn stated_variances(setup: &Setup, layout: &Layout) -> Vec<f64> {
    let mut variances = Vec::new();
    for &sensor in &layout.sensors {
        let noise = setup.structure.sensors()[sensor].noise();
        variances.extend(noise.torque.iter().chain(&noise.force).map(|x| x * x));
    }
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
