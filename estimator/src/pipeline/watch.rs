//! Whether F/T readings contradict what a sub-tree's links need, and which contact that nobody
//! declared would explain it.
//!
//! ```text
//! b = sum of net wrenches less sensors' and known wrenches      A x: what contacts that are present may do to it
//! S = C / n + P + M          noise of the F/T, n readings averaged; parameters and offsets; motion
//! q = min over x of (b - A x)^T S^-1 (b - A x)                  chi-square with 6 - rank A degrees of freedom
//! ```
//!
//! Two `b` are tested, that of the instant and, where no contact is known, the mean of some
//! [`MEAN`], which shows what is smaller than the noise of one reading. `q` counts as the normal
//! deviate that is as rare. Beyond [`CONTRADICTED`] something acts that is not known. Of the
//! contacts that are possible there, the one that leaves least unexplained is taken as present,
//! provided that what it leaves is usual ([`USUAL`]). A touch is a force within [`REACH`] of the
//! contact's `position_m`: any six numbers could be a wrench at any one of them. It stays present
//! until `q` is usual without it. What no contact explains condemns the sub-tree: where it acts
//! nobody knows.

use crate::dynamics::{ContactKind, ContactSet, Kinematics, LeastSquares, Solver, Structure, noise_factor, unknowns};
use crate::spatial::{Vec3, Wrench};
use crate::statistics::deviate;
use nalgebra::{Matrix6, Vector6};
use proprio_topics::Nanos;

/// The deviate beyond which readings are contradicted: 3 of 10 million instants by chance.
const CONTRADICTED: f64 = 5.0;
/// The deviate below which nothing acts any more: 99 % of instants in which nothing does.
const USUAL: f64 = 2.326;
/// Time constant of the mean.
const MEAN: Nanos = Nanos::from_millis(50);
/// How far from a contact's position a touch acts, one standard deviation \[m\]: 99 % within 17 cm,
/// a hand or a foot.
const REACH: f64 = 0.05;
/// Of the variances that are found in single precision, what rounding may leave.
const ROUNDING: f64 = 1e-6;

/// What was seen of a sub-tree at the last instant.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seen {
    /// What is unexplained but for contacts that were detected: at the origin and in the axes of
    /// the sub-tree's top link.
    pub(super) residual: Wrench,
    /// As a normal deviate. Not a number where nothing can be tested.
    pub(super) significance: f64,
    /// The contact that was detected.
    pub(super) contact: Option<usize>,
    /// No contact explains it.
    pub(super) is_unexplained: bool,
}

impl Seen {
    const NOTHING: Self = Self {
        residual: Wrench {
            torque: Vec3::new(0.0, 0.0, 0.0),
            force: Vec3::new(0.0, 0.0, 0.0),
        },
        significance: f64::NAN,
        contact: None,
        is_unexplained: false,
    };
}

/// Watches all sub-trees.
pub(super) struct Watch {
    subtrees: Vec<Subtree>,
    least: LeastSquares,
}

struct Subtree {
    seen: Seen,
    mean: Option<Mean>,
}

/// Mean of `b` with weights that fade.
#[derive(Clone, Copy)]
struct Mean {
    value: Vector6<f64>,
    /// Variance of it in that of one reading, `1 / n`.
    share: f64,
    t: Nanos,
}

/// An instant, solved.
pub(super) struct Instant<'a> {
    pub(super) t: Nanos,
    pub(super) structure: &'a Structure,
    pub(super) kinematics: &'a Kinematics,
    pub(super) solver: &'a Solver,
    /// The contacts that are known to be present.
    pub(super) declared: &'a ContactSet,
}

impl Watch {
    pub(super) fn new(structure: &Structure) -> Self {
        let nothing = || Subtree {
            seen: Seen::NOTHING,
            mean: None,
        };
        Self {
            subtrees: structure.subtrees().iter().map(|_| nothing()).collect(),
            least: LeastSquares::with_capacity(6 * structure.contacts().len()),
        }
    }

    /// What was seen of each sub-tree.
    pub(super) fn seen(&self) -> impl Iterator<Item = &Seen> {
        self.subtrees.iter().map(|subtree| &subtree.seen)
    }

    /// The contacts that were detected.
    pub(super) fn detected(&self) -> ContactSet {
        let mut detected = ContactSet::EMPTY;
        self.seen()
            .filter_map(|seen| seen.contact)
            .for_each(|contact| detected.insert(contact));
        detected
    }

    /// Looks at an instant. `covariance` is that of a sub-tree's imbalance but for F/T noise, `P +
    /// M`; none where it can not be trusted. Does not allocate.
    pub(super) fn update(&mut self, instant: &Instant<'_>, covariance: impl Fn(usize) -> Option<Matrix6<f64>>) {
        let Self { subtrees, least } = self;
        for (number, subtree) in subtrees.iter_mut().enumerate() {
            let before = subtree.seen.contact;
            subtree.seen = Seen::NOTHING;
            let facts = &instant.structure.subtrees()[number];
            let is_free = |contact: usize| instant.structure.contacts()[contact].kind != ContactKind::Wrench;
            let declared = facts.contacts.intersection(instant.declared);
            let known = if facts.sensors.is_empty() || !declared.iter().all(is_free) {
                None
            } else {
                covariance(number)
            };
            let Some(known) = known else {
                subtree.mean = None;
                continue;
            };
            let b = Vector6::from(instant.solver.imbalance(instant.structure, number).torque_first());
            // What a known contact does changes with its place: there is no mean of that.
            let before_it = subtree.mean.filter(|_| declared.is_empty());
            let case = Case {
                instant,
                number,
                declared,
                b,
                mean: Mean::next(before_it, instant.t, b),
                noise: instant.solver.noise(instant.structure, number, &Vec3::zeros()),
                known: known + Matrix6::from_diagonal(&(ROUNDING * known.diagonal())),
            };
            subtree.mean = Some(case.mean);
            subtree.seen = case.see(least, before);
        }
    }

    /// Parameters or offsets are others: what they leave is compared with nothing from before.
    pub(super) fn begin_anew(&mut self) {
        self.subtrees.iter_mut().for_each(|subtree| subtree.mean = None);
    }

    /// Forgets what was seen: an instant that could not be solved.
    pub(super) fn forget(&mut self) {
        for subtree in &mut self.subtrees {
            (subtree.seen, subtree.mean) = (Seen::NOTHING, None);
        }
    }
}

impl Mean {
    fn next(before: Option<Self>, t: Nanos, b: Vector6<f64>) -> Self {
        let Some(before) = before.filter(|mean| t - mean.t < MEAN) else {
            return Self {
                value: b,
                share: 1.0,
                t,
            };
        };
        let keep = (-(t - before.t).seconds() / MEAN.seconds()).exp();
        Self {
            value: before.value * keep + b * (1.0 - keep),
            share: keep * keep * before.share + (1.0 - keep) * (1.0 - keep),
            t,
        }
    }
}

/// A sub-tree at an instant.
struct Case<'a> {
    instant: &'a Instant<'a>,
    number: usize,
    declared: ContactSet,
    b: Vector6<f64>,
    mean: Mean,
    noise: Matrix6<f64>,
    known: Matrix6<f64>,
}

impl Case<'_> {
    fn see(&self, least: &mut LeastSquares, before: Option<usize>) -> Seen {
        let (significance, residual) = self.test(least, None);
        let top = self.instant.structure.subtrees()[self.number].top;
        let residual = Wrench {
            torque: residual.fixed_rows::<3>(0).into_owned(),
            force: residual.fixed_rows::<3>(3).into_owned(),
        };
        let mut seen = Seen {
            residual: self.instant.kinematics.pose(top).wrench_back(&residual),
            significance,
            ..Seen::NOTHING
        };
        // Also what is not a number is none that is usual.
        let limit = if before.is_some() { USUAL } else { CONTRADICTED };
        if significance <= limit || significance.is_nan() {
            return seen;
        }
        let possible = self.instant.structure.subtrees()[self.number]
            .contacts
            .difference(&self.declared);
        let mut best = USUAL;
        for contact in possible.iter() {
            let (left, _) = self.test(least, Some(contact));
            // Of two that do equally well, the one that it was.
            let left = if before == Some(contact) { left - 1.0 } else { left };
            if left <= best {
                (best, seen.contact) = (left, Some(contact));
            }
        }
        seen.is_unexplained = seen.contact.is_none() && significance > CONTRADICTED;
        seen
    }

    /// How rare what is unexplained would be, of the instant or of the mean, whichever is rarer, if
    /// this contact were present, too; and what the instant leaves.
    fn test(&self, least: &mut LeastSquares, touch: Option<usize>) -> (f64, Vector6<f64>) {
        let (structure, origin) = (self.instant.structure, Vec3::zeros());
        let columns = |contact: usize| {
            let spec = &structure.contacts()[contact];
            unknowns(spec, self.instant.kinematics, &origin, structure.length_scale())
        };
        let is_loose = touch.is_some_and(|contact| structure.contacts()[contact].kind == ContactKind::Wrench);
        let mut worst = (f64::NEG_INFINITY, self.b);
        // A mean of one reading is that reading.
        let mean = Some((self.mean.value, self.mean.share)).filter(|(_, share)| *share < 1.0);
        for (b, share) in mean.into_iter().chain([(self.b, 1.0)]) {
            let mut covariance = self.noise * share + self.known;
            if is_loose {
                let moment = (REACH * b.fixed_rows::<3>(3).norm()).powi(2);
                (0..3).for_each(|axis| covariance[(axis, axis)] += moment);
            }
            least.clear();
            let declared = self.declared.iter().flat_map(columns);
            let detected = touch
                .into_iter()
                .flat_map(|contact| columns(contact).into_iter().take(3));
            declared
                .chain(detected)
                .for_each(|(column, weight)| least.push(column, weight));
            least.factorise(&noise_factor(covariance));
            let weight = least.unexplained();
            let freedom = 6 - least.rank();
            if freedom == 0 {
                return (f64::NAN, Vector6::zeros());
            }
            // `b - A x` is what the weight gives back through the covariance.
            let level = deviate((weight * b).dot(&b), freedom);
            worst = (worst.0.max(level), covariance * weight * b);
        }
        worst
    }
}
