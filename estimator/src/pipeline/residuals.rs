//! Residual test: whether the F/T readings of a sub-tree agree with the net wrenches of its links,
//! and which undeclared contact would explain a significant residual.
//!
//! ```text
//! b     imbalance: sum of net wrenches, less the wrenches of the sensors and known wrenches
//! A x   wrench of the contacts that are present, x unknown
//! S = C / n + P + M    covariance of b: C F/T noise (mean of n readings), P parameters and
//!                      offsets, M motion
//! q = min over x of (b - A x)^T S^-1 (b - A x)    chi-square, 6 - rank A degrees of freedom
//! ```
//!
//! Two imbalances are tested: that of the instant and, where no contact is known, an exponential
//! mean with [`TIME_CONSTANT`], which shows disturbances below the noise of one reading. `q` is
//! converted to the normal deviate of equal probability. Above [`SIGNIFICANT`], an unknown external
//! wrench acts on the sub-tree. Of the contacts that are possible there, the one that leaves the
//! smallest deviate is taken as present, provided that this deviate is at most [`PLAUSIBLE`]; the
//! one detected before is given an advantage of [`PREVIOUS`]. A detected contact is a force within
//! [`CONTACT_RADIUS`] of the contact's `position_m`: without that bound, any six numbers could be a
//! wrench at any contact. It stays present until `q` is plausible without it. In some postures a
//! load hardly shows, so torques assume that it may still be there until [`GONE`]. While a residual
//! is not plausible without a contact, that may have begun: deviations cover it. If no contact
//! explains the residual, all torques of the sub-tree are withheld, because the place where the
//! wrench acts is unknown.
//!
//! A contact that is detected from the start on may as well be a wrong offset, a wrong mounting, or
//! another direction of gravity. So it counts only once the residual of its sub-tree has been
//! plausible without it for [`CONFIRMED`]. One that was there before the residual could not be
//! tested, because of a fault, may still be there after it.

use super::offset_steps::OffsetStep;
use super::significance::{SIGNIFICANT, TIME_CONSTANT, kept};
use nalgebra::{Matrix6, Vector6};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, Kinematics, LeastSquares, SensorSet, Solver, Structure, noise_factor,
    unknowns,
};
use proprio_identification::statistics::deviate;
use proprio_topics::Nanos;

/// The deviate up to which a residual is plausible: 99 % of instants without an unknown wrench.
const PLAUSIBLE: f64 = 2.326;
/// Advantage of the contact that was detected before, a deviate: of two that fit about equally well
/// it is preferred.
const PREVIOUS: f64 = 1.0;
/// Distance from a contact's position to the force of a detected contact, one standard deviation
/// \[m\]: 99 % within 17 cm, the size of a hand or a foot.
const CONTACT_RADIUS: f64 = 0.05;
/// Time in which a plausible residual confirms the model \[s\]: some ten independent means.
const CONFIRMED: f64 = 1.0;
/// Time in which a plausible residual shows that a contact has ended \[s\].
const GONE: f64 = 2.0;
/// Rounding error of the variances computed in single precision, relative.
const ROUNDING_SHARE: f64 = 1e-6;

/// The residual of a sub-tree at the last instant.
#[derive(Debug, Clone, Copy)]
pub(super) struct SubtreeResidual {
    /// The wrench that known contacts do not explain, at the origin and in the axes of the
    /// sub-tree's top link.
    pub(super) wrench: Wrench,
    /// Its normal deviate; NaN where it cannot be tested.
    pub(super) significance: f64,
    /// The detected contact.
    pub(super) contact: Option<usize>,
    /// The contact that would explain a residual that is improbable, but not significant.
    suspected: Option<usize>,
    /// Whether the residual is significant and no contact explains it.
    pub(super) is_unexplained: bool,
    /// Whether it is significant, but the model has not been confirmed without a contact.
    pub(super) is_unconfirmed: bool,
}

impl SubtreeResidual {
    const NOTHING: Self = Self {
        wrench: Wrench {
            torque: Vec3::new(0.0, 0.0, 0.0),
            force: Vec3::new(0.0, 0.0, 0.0),
        },
        significance: f64::NAN,
        contact: None,
        suspected: None,
        is_unexplained: false,
        is_unconfirmed: false,
    };

    /// Whether it is significant.
    pub(super) fn is_disturbed(&self) -> bool {
        self.contact.is_some() || self.is_unexplained
    }
}

/// Tests the residuals of all sub-trees.
pub(super) struct ResidualMonitor {
    subtrees: Vec<SubtreeState>,
    least: LeastSquares,
}

struct SubtreeState {
    residual: SubtreeResidual,
    mean: Option<Mean>,
    /// What the residual may be instead of a contact.
    steps: Vec<OffsetStep>,
    /// When it was last tested.
    tested: Nanos,
    /// For how long in all, and how long without a break until now, the residual was plausible
    /// without a contact \[s\].
    plausible_in_all: f64,
    plausible_lately: f64,
    /// The detected contact, or the last one, if it may still be there.
    lingering: Option<usize>,
}

/// Exponential mean of the imbalance `b`.
#[derive(Clone, Copy)]
struct Mean {
    value: Vector6<f64>,
    /// Its variance relative to that of one reading, `1 / n`.
    variance_ratio: f64,
    t: Nanos,
}

/// The solver's result at one instant.
pub(super) struct SolvedInstant<'a> {
    pub(super) t: Nanos,
    pub(super) structure: &'a Structure,
    pub(super) kinematics: &'a Kinematics,
    pub(super) solver: &'a Solver,
    /// The contacts that are known to be present.
    pub(super) known: &'a ContactSet,
}

impl ResidualMonitor {
    pub(super) fn new(structure: &Structure) -> Self {
        let nothing = |number: usize| SubtreeState {
            residual: SubtreeResidual::NOTHING,
            mean: None,
            steps: OffsetStep::of_subtree(structure, number),
            tested: Nanos::MIN,
            plausible_in_all: 0.0,
            plausible_lately: 0.0,
            lingering: None,
        };
        Self {
            subtrees: (0..structure.subtrees().len()).map(nothing).collect(),
            least: LeastSquares::with_capacity(6 * structure.contacts().len()),
        }
    }

    /// The residual of each sub-tree.
    pub(super) fn subtrees(&self) -> impl Iterator<Item = &SubtreeResidual> {
        self.subtrees.iter().map(|subtree| &subtree.residual)
    }

    /// Each sub-tree's number, and what its residual may be instead of a contact.
    pub(super) fn steps(&self) -> impl Iterator<Item = (usize, &OffsetStep)> {
        let all = self.subtrees.iter().enumerate();
        all.flat_map(|(number, state)| state.steps.iter().map(move |step| (number, step)))
    }

    /// The sensors of the sub-trees whose model has not been confirmed without a contact.
    pub(super) fn unconfirmed(&self, structure: &Structure) -> SensorSet {
        self.sensors_where(structure, |state| state.residual.is_unconfirmed)
    }

    /// The sensors whose noise can not be told from a contact: one is, or may be, on a sub-tree
    /// whose model has been confirmed without it.
    pub(super) fn touched(&self, structure: &Structure) -> SensorSet {
        self.sensors_where(structure, |state| {
            state.lingering.is_some() && state.plausible_in_all >= CONFIRMED
        })
    }

    /// The sensors of these sub-trees.
    fn sensors_where(
        &self,
        structure: &Structure,
        is_one: impl Fn(&SubtreeState) -> bool,
    ) -> SensorSet {
        let both = structure.subtrees().iter().zip(&self.subtrees);
        both.filter(|(_, state)| is_one(state))
            .fold(SensorSet::EMPTY, |all, (own, _)| all.union(&own.sensors))
    }

    /// The detected contacts.
    pub(super) fn detected(&self) -> ContactSet {
        self.contacts(|state| state.residual.contact)
    }

    /// These, and those that may still be there, though the residual is plausible without them.
    pub(super) fn lingering(&self) -> ContactSet {
        self.contacts(|state| state.lingering)
    }

    /// The contacts that may have begun: the residual is not plausible without them.
    pub(super) fn suspected(&self) -> ContactSet {
        self.contacts(|state| state.residual.suspected)
    }

    /// One contact of each sub-tree, or none.
    fn contacts(&self, of: impl Fn(&SubtreeState) -> Option<usize>) -> ContactSet {
        let mut contacts = ContactSet::EMPTY;
        let all = self.subtrees.iter().filter_map(of);
        all.for_each(|contact| contacts.insert(contact));
        contacts
    }

    /// Tests the residuals at an instant. `covariance` is that of a sub-tree's imbalance without
    /// F/T noise, `P + M`; none where the sub-tree has a fault. Does not allocate.
    pub(super) fn update(
        &mut self,
        solved: &SolvedInstant<'_>,
        covariance: impl Fn(usize) -> Option<Matrix6<f64>>,
    ) {
        let Self { subtrees, least } = self;
        for (number, state) in subtrees.iter_mut().enumerate() {
            let before = state.residual.contact;
            state.residual = SubtreeResidual::NOTHING;
            let subtree = &solved.structure.subtrees()[number];
            let leaves_equations =
                |contact: usize| solved.structure.contacts()[contact].kind != ContactKind::Wrench;
            let known = subtree.contacts.intersection(solved.known);
            let model_covariance =
                if subtree.sensors.is_empty() || !known.iter().all(leaves_equations) {
                    None
                } else {
                    covariance(number)
                };
            let Some(model_covariance) = model_covariance else {
                // A contact that was there may still be there after the fault.
                (state.mean, state.plausible_lately) = (None, 0.0);
                if !known.is_empty() {
                    state.lingering = None;
                }
                state.steps.iter_mut().for_each(OffsetStep::end);
                continue;
            };
            let b = Vector6::from(
                solved
                    .solver
                    .imbalance(solved.structure, number)
                    .torque_first(),
            );
            // The wrench of a known contact varies with its place, so no mean is formed.
            let previous_mean = state.mean.filter(|_| known.is_empty());
            let test = SubtreeTest {
                solved,
                number,
                known,
                b,
                mean: Mean::next(previous_mean, solved.t, b),
                noise: solved
                    .solver
                    .noise(solved.structure, number, &Vec3::zeros()),
                model: model_covariance
                    + Matrix6::from_diagonal(&(ROUNDING_SHARE * model_covariance.diagonal())),
            };
            state.mean = Some(test.mean);
            state.residual = test.run(least, before);
            let is_disturbed = state.residual.is_disturbed();
            let covariance = test.noise + test.model;
            for step in &mut state.steps {
                let pose = solved.solver.sensor_pose(step.sensor);
                let residual = is_disturbed.then_some((&b, &covariance));
                step.follow(solved.t, residual, pose);
            }
            let since = solved
                .t
                .saturating_sub(std::mem::replace(&mut state.tested, solved.t));
            if state.residual.significance <= PLAUSIBLE {
                let since = since.min(TIME_CONSTANT).seconds();
                (state.plausible_in_all, state.plausible_lately) = (
                    state.plausible_in_all + since,
                    state.plausible_lately + since,
                );
            } else {
                state.plausible_lately = 0.0;
            }
            if state.residual.contact.is_some() {
                state.lingering = state.residual.contact;
            } else if state.residual.is_unexplained
                || state.plausible_lately > GONE
                || known != ContactSet::EMPTY
            {
                state.lingering = None;
            }
            state.residual.is_unconfirmed = is_disturbed && state.plausible_in_all < CONFIRMED;
        }
    }

    /// Restarts the means: parameters or offsets have changed, so earlier imbalances do not count.
    pub(super) fn restart_means(&mut self) {
        self.subtrees
            .iter_mut()
            .for_each(|subtree| subtree.mean = None);
    }

    /// Clears all residuals, after an instant that could not be solved.
    pub(super) fn reset(&mut self) {
        for subtree in &mut self.subtrees {
            (subtree.residual, subtree.mean) = (SubtreeResidual::NOTHING, None);
            subtree.plausible_lately = 0.0;
            subtree.steps.iter_mut().for_each(OffsetStep::end);
        }
    }
}

impl Mean {
    fn next(before: Option<Self>, t: Nanos, b: Vector6<f64>) -> Self {
        let Some(before) = before.filter(|mean| t - mean.t < TIME_CONSTANT) else {
            return Self {
                value: b,
                variance_ratio: 1.0,
                t,
            };
        };
        let keep = kept(t - before.t);
        Self {
            value: before.value * keep + b * (1.0 - keep),
            variance_ratio: keep * keep * before.variance_ratio + (1.0 - keep) * (1.0 - keep),
            t,
        }
    }
}

/// The test of one sub-tree at one instant.
struct SubtreeTest<'a> {
    solved: &'a SolvedInstant<'a>,
    number: usize,
    known: ContactSet,
    b: Vector6<f64>,
    mean: Mean,
    noise: Matrix6<f64>,
    /// Covariance of the imbalance without F/T noise, `P + M`.
    model: Matrix6<f64>,
}

impl SubtreeTest<'_> {
    fn run(&self, least: &mut LeastSquares, before: Option<usize>) -> SubtreeResidual {
        let (significance, residual) = self.test(least, None);
        let top = self.solved.structure.subtrees()[self.number].top;
        let residual = Wrench {
            torque: residual.fixed_rows::<3>(0).into_owned(),
            force: residual.fixed_rows::<3>(3).into_owned(),
        };
        let mut result = SubtreeResidual {
            wrench: self.solved.kinematics.pose(top).wrench_back(&residual),
            significance,
            ..SubtreeResidual::NOTHING
        };
        if significance <= PLAUSIBLE || significance.is_nan() {
            return result;
        }
        let possible = self.solved.structure.subtrees()[self.number]
            .contacts
            .difference(&self.known);
        let (mut best, mut found) = (PLAUSIBLE, None);
        for contact in possible.iter() {
            let (left, _) = self.test(least, Some(contact));
            let left = if before == Some(contact) {
                left - PREVIOUS
            } else {
                left
            };
            if left <= best {
                (best, found) = (left, Some(contact));
            }
        }
        // A contact that was present stays until the residual is plausible without it.
        if before.is_some() || significance > SIGNIFICANT {
            result.contact = found;
        } else {
            result.suspected = found;
        }
        result.is_unexplained = result.contact.is_none() && significance > SIGNIFICANT;
        result
    }

    /// The larger deviate of the two imbalances (mean and instant) if `detected_contact` were
    /// present, too; and the residual of the instant.
    fn test(
        &self,
        least: &mut LeastSquares,
        detected_contact: Option<usize>,
    ) -> (f64, Vector6<f64>) {
        let (structure, origin) = (self.solved.structure, Vec3::zeros());
        let columns = |contact: usize| {
            let spec = &structure.contacts()[contact];
            unknowns(
                spec,
                self.solved.kinematics,
                &origin,
                structure.length_scale(),
            )
        };
        let has_unknown_moment = detected_contact
            .is_some_and(|contact| structure.contacts()[contact].kind == ContactKind::Wrench);
        let mut largest = (f64::NEG_INFINITY, self.b);
        // The mean of one reading is that reading: test it once.
        let mean = Some((self.mean.value, self.mean.variance_ratio))
            .filter(|(_, variance_ratio)| *variance_ratio < 1.0);
        for (b, variance_ratio) in mean.into_iter().chain([(self.b, 1.0)]) {
            let mut covariance = self.noise * variance_ratio + self.model;
            if has_unknown_moment {
                let moment = (CONTACT_RADIUS * b.fixed_rows::<3>(3).norm()).powi(2);
                (0..3).for_each(|axis| covariance[(axis, axis)] += moment);
            }
            least.clear();
            let known = self.known.iter().flat_map(columns);
            let detected = detected_contact
                .into_iter()
                .flat_map(|contact| columns(contact).into_iter().take(3));
            known
                .chain(detected)
                .for_each(|(column, weight)| least.push(column, weight));
            let lower = noise_factor(covariance);
            let (square, residual, freedom) = if least.is_empty() {
                // Nothing explains any of it.
                let mut white = b;
                lower.solve_lower_triangular_unchecked_mut(&mut white);
                (white.norm_squared(), b, 6)
            } else {
                least.factorise(&lower);
                // `b - A x` is what the weight gives back through the covariance.
                let weighted = least.unexplained() * b;
                (weighted.dot(&b), covariance * weighted, 6 - least.rank())
            };
            if freedom == 0 {
                return (f64::NAN, Vector6::zeros());
            }
            largest = (largest.0.max(deviate(square, freedom)), residual);
        }
        largest
    }
}
