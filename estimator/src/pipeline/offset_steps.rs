//! What a residual may be instead of what torques assume: a step of an F/T offset instead of a
//! contact, or a contact that begins instead of noise. The deviations of torques cover it.
//!
//! A blow, a cable that slips or a restart of the sensor's board changes its offset at once, and
//! any change of the six readings may as well be a wrench at a contact, or elsewhere. So from the
//! first significant residual of a sub-tree on, each of its sensors may have a step that makes the
//! residual zero, and the deviations of torques cover those that follow from it. A step stays the
//! same in the axes of the sensor, while a contact rarely does. So it is refuted as soon as the
//! residual has changed there significantly since it settled.

use super::significance::{SIGNIFICANT, kept};
use nalgebra::{Matrix6, Vector6};
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{Pose, Wrench};
use proprio_dynamics::{ContactSet, Kinematics, Solver, Structure};
use proprio_identification::online::COVERED;
use proprio_identification::statistics::deviate;
use proprio_topics::Nanos;

/// Time after which a mean shows a step whole, but for a thousandth.
const SETTLED: Nanos = Nanos::from_millis(350);

/// A step of one sensor, as far as it may explain the residual of a sub-tree.
#[derive(Debug, Clone)]
pub(super) struct OffsetStep {
    pub(super) sensor: usize,
    /// The change of its reading that makes the residual zero, per unit of the residual in its
    /// axes: 1 or -1.
    sign: f64,
    state: State,
}

#[derive(Debug, Clone, Copy)]
#[allow(
    clippy::large_enum_variant,
    reason = "the real-time loop does not allocate"
)]
enum State {
    /// There is no residual.
    None,
    /// The residual began at this time; then its mean in the axes of the sensor, and the time of
    /// that.
    Began(Nanos, Vector6<f64>, Nanos),
    /// The mean and its covariance when it had settled; then the mean, and the time of that.
    Settled(Vector6<f64>, Matrix6<f64>, Vector6<f64>, Nanos),
    Refuted,
}

impl OffsetStep {
    /// Those of the sensors of a sub-tree.
    pub(super) fn of_subtree(structure: &Structure, number: usize) -> Vec<Self> {
        let sensors = structure.subtrees()[number].sensors.iter();
        let step = |sensor: usize| {
            let cut = &structure.sensors()[sensor];
            let is_child = structure.subtree_of(cut.joint() + 1) == Some(number);
            Self {
                sensor,
                sign: if is_child { cut.sign() } else { -cut.sign() },
                state: State::None,
            }
        };
        sensors.map(step).collect()
    }

    /// There is no residual, or it is not known.
    pub(super) fn end(&mut self) {
        self.state = State::None;
    }

    /// Takes the residual of the sub-tree at `t` and its covariance, in base coordinates, if it is
    /// significant; `pose` is that of the sensor.
    pub(super) fn follow(
        &mut self,
        t: Nanos,
        residual: Option<(&Vector6<f64>, &Matrix6<f64>)>,
        pose: &Pose,
    ) {
        let Some((residual, covariance)) = residual else {
            return self.end();
        };
        let back = |column: &[f64; 6]| {
            Vector6::from(
                pose.wrench_back(&Wrench::from_torque_first(*column))
                    .torque_first(),
            )
        };
        let now = back(&(*residual).into());
        let next = |mean: Vector6<f64>, before: Nanos| {
            let keep = kept(t - before);
            mean * keep + now * (1.0 - keep)
        };
        let in_sensor = || {
            let columns: [Vector6<f64>; 6] = std::array::from_fn(|axis| {
                back(&std::array::from_fn(|i| f64::from(u8::from(i == axis))))
            });
            let turn = Matrix6::from_columns(&columns);
            turn * covariance * turn.transpose()
        };
        self.state = match self.state {
            State::None => State::Began(t, now, t),
            State::Began(began, mean, before) => {
                let mean = next(mean, before);
                match t - began < SETTLED {
                    true => State::Began(began, mean, t),
                    false => State::Settled(mean, in_sensor(), mean, t),
                }
            }
            State::Settled(first, of_first, mean, before) => {
                let mean = next(mean, before);
                let change = mean - first;
                let inverse = (of_first + in_sensor()).cholesky();
                let square = inverse.map_or(0.0, |inverse| change.dot(&inverse.solve(&change)));
                match deviate(square, 6) > SIGNIFICANT {
                    true => State::Refuted,
                    false => State::Settled(first, of_first, mean, t),
                }
            }
            State::Refuted => State::Refuted,
        };
    }

    /// What the reading changed by; none if it is no step.
    fn change(&self) -> Option<Wrench> {
        let (State::Began(_, mean, _) | State::Settled(_, _, mean, _)) = self.state else {
            return None;
        };
        Some(Wrench::from_torque_first((self.sign * mean).into()))
    }
}

/// How far the torques may be from those that steps of F/T offsets, or contacts that begin, make
/// likely.
pub(super) struct OffsetStepCover {
    solver: Solver,
    readings: Vec<Wrench>,
    torque: Vec<f64>,
    /// Per contact, whether there may be a step instead of it.
    contacts: ContactSet,
}

impl OffsetStepCover {
    pub(super) fn new(structure: &Structure, dofs: usize) -> Self {
        Self {
            solver: Solver::new(structure),
            readings: vec![Wrench::zero(); structure.sensors().len()],
            torque: vec![0.0; dofs],
            contacts: ContactSet::EMPTY,
        }
    }

    /// The least deviation of each torque.
    pub(super) fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// The least deviation of a component of a contact's wrench.
    pub(super) fn contact(&self, contact: usize, value: f64) -> f64 {
        match self.contacts.contains(contact) {
            true => value.abs() / COVERED,
            false => 0.0,
        }
    }

    /// Compares the torques of `solver` with those of all steps that are not refuted, and with
    /// those of all contacts that are suspected. `known` are the contacts that are known to be
    /// present, `lingering` those that residuals show. Does not allocate.
    #[allow(clippy::too_many_arguments, reason = "each of another kind")]
    pub(super) fn update<'a>(
        &mut self,
        model: &Model,
        structure: &Structure,
        kinematics: &Kinematics,
        solver: &Solver,
        readings: &[Wrench],
        [known, lingering, suspected]: [&ContactSet; 3],
        steps: impl Iterator<Item = (usize, &'a OffsetStep)>,
    ) {
        self.torque.fill(0.0);
        self.contacts = ContactSet::EMPTY;
        for (number, step) in steps {
            let Some(change) = step.change() else {
                continue;
            };
            let lingering_here = structure.subtrees()[number]
                .contacts
                .intersection(lingering);
            self.contacts = self.contacts.union(&lingering_here);
            self.readings.copy_from_slice(readings);
            let Some(reading) = self.readings.get_mut(step.sensor) else {
                continue;
            };
            *reading += change;
            let active = known.union(&lingering.difference(&lingering_here));
            let solved =
                self.solver
                    .solve(model, structure, kinematics, &self.readings, &active, &[]);
            if solved.is_err() {
                continue;
            }
            self.cover(solver);
        }
        let assumed = known.union(lingering);
        if suspected.difference(&assumed) == ContactSet::EMPTY {
            return;
        }
        let active = assumed.union(suspected);
        let solved = (self.solver)
            .solve(model, structure, kinematics, readings, &active, &[])
            .and_then(|()| self.solver.update_deviations(structure));
        if solved.is_err() {
            return;
        }
        self.cover(solver);
        let noise = self.solver.torque_deviation();
        for (deviation, noise) in self.torque.iter_mut().zip(noise) {
            *deviation = deviation.max(*noise);
        }
    }

    /// The deviations cover the last solution, too.
    fn cover(&mut self, solver: &Solver) {
        let both = solver.torque().iter().zip(self.solver.torque());
        for (deviation, (torque, other)) in self.torque.iter_mut().zip(both) {
            *deviation = deviation.max((torque - other).abs() / COVERED);
        }
    }
}
