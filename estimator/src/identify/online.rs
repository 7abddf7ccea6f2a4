//! Identification while the robot works: rows in at every instant, a solution once a second, on two sides of a wall that neither waits at.
//!
//! ```text
//! Online::observe (data plane)   rows of each component -> block of 0.1 s -> gate -> [R | z]          fixed time, no allocation
//! Online::take_job -> Job::run (any thread)   [R | z] + prior -> bodies, offsets, covariance, noise, changes
//! Online::give_back, Online::apply            from the stamp (snapshot + 1 s) on, the solution is what is in force
//! ```
//!
//! What a solution says, and from which instant on it is in force, depends on the stamps and values observed alone: live and replayed alike, provided
//! that jobs come back before their stamp. Those that do not are applied later, and counted ([`Counts::late`]).
//!
//! # Components
//! Sub-trees that can be free of contacts hang together by the F/T sensors that they share. Each such *component* has a square-root information of its own
//! over `[offsets of its sensors | parameters of its links]`, relative to the configuration's offsets and to CAD. A sub-tree with unknown contacts gives the combinations
//! of its six equations that these do not reach: none at all under a full wrench.
//!
//! A large component's rows of a limb tell of that limb and its sensors alone. They are gathered in a triangle of their own, and join the others' once a second: a tenth of the work. What
//! offsets wander is reckoned as often, for each step of a walk is one of all that hangs together. (Small components: ten times a second.)
//!
//! # Noise
//! Rows are whitened with *inflated* variances, and offsets wander between blocks (random walks), both as `channel` finds them from what each channel reads in the mean from one second
//! to the next, less what the bodies explain that were known before. All that is read counts there, also what was put aside: noise that is larger than was thought would else be put
//! aside for ever. Before anything is known the noise is taken as hundreds of times what was stated. Offsets stand still while a contact is declared or suspected.
//!
//! # Gating
//! A block goes in one block after it was gathered, and only if that and the next are clean: its mean innovation, whitened by the predictive covariance `P + R`, is
//! tested against chi-square. What fails is a contact that nobody declared, an outlier, a jump of an offset, or another load: rows are kept aside, the component is
//! [`Paused::Suspected`] and says so. If it lasts three seconds while a sensor tilts, the rows put aside are asked what they are. If the same information with offsets of the sensors that have
//! tilted starting afresh explains them, beside bodies as probable as CAD lets them be, the offsets do; if new parameters of the outermost links explain them better, a load
//! has changed; else it stays a contact, however long.
//!
//! # What is in force
//! CAD, and then what has predicted the readings that came after it better (`contest`), with the offsets that go best with it. What is most probable is found every second, and judges new
//! rows.

mod channel;
mod contest;
mod rows;
pub mod state;

use std::sync::Arc;

use nalgebra::{DMatrix, DMatrixView, DVector};
use proprio_topics::{Nanos, Reason};

use pulp::{Arch, Simd, WithSimd};

use self::channel::{Channel, Second};
use self::contest::Contest;
use self::rows::{Instant, Kinds, Rows, spread};
use super::information::{Information, InformationError, Panel};
use super::lanes::{self, TOGETHER};
use super::prior::{Posterior, Prior, PriorError};
use super::{add_multiple, dot, factorise, forward};
use crate::calibration::UNKNOWN_OFFSET;
use crate::dynamics::{ContactSet, DofSet, DynamicsError, Kinematics, Structure};
use crate::model::Model;
use crate::parameters::cad_root;
use crate::regressor::{StackedRegressor, Weighting};
use crate::spatial::{RigidInertia, Vec3, Wrench};
use crate::statistics::chi_square;

/// Ten parameters per link.
const WIDTH: usize = 10;
/// How long rows are gathered before the gate judges them.
const BLOCK: Nanos = Nanos::from_millis(100);
/// How often there is a solution, and how long after its data it is in force.
const SOLVE: Nanos = Nanos::from_millis(1000);
/// A component of so many unknowns gathers limb by limb what is about at most half of them.
const LARGE: usize = 150;
/// How long these gather before they join [s].
const GATHERED: f64 = 1.0;
/// The gate's level, in standard deviations of a normal distribution: one false alarm in millions of independent blocks.
const GATE: f64 = 5.0;
/// So many clean blocks end a suspicion.
const CLEAN: u32 = 3;
/// Innovations of one kind for so long, while the sensors tilt, are no contact but a change.
const PERSISTENT: f64 = 3.0;
/// By how much a sensor must tilt meanwhile, as the cosine of the angle: 20 degrees. An offset, a weight and a push can not be told apart where it does not.
const TILTED: f64 = 0.94;
/// Mean square of what a change leaves of the rows' innovations, in units of inflated noise, up to which it explains them.
const EXPLAINED: f64 = 1.0;
/// The squared Newton decrement down to which bodies are sought to find the prior's weight, and to tell of them: a hundredth and a ten-thousandth of a standard deviation.
const NEAR: f64 = 1e-4;
const NEAREST: f64 = 1e-8;
/// A step of the prior's weight, as a logarithm, that is worth no second fit at once: the next second begins with it.
const SETTLED: f64 = 1e-3;
/// Half of the memory that is kept for jobs \[B\]; glibc follows up to 32 MiB.
const KEPT: usize = 24 << 20;
/// A channel of whose noise less than this shows among that of others is judged as if it were so much.
const LEAST_SHARE: f64 = 1e-3;
/// A series of residuals that is longer has holes that nothing explains [instants].
const LONGEST: usize = 100_000;

/// Why nothing can be identified on-line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum OnlineError {
    /// No sub-tree with an F/T sensor can ever be free of contacts.
    #[error(
        "nothing can be identified on-line: no part of the robot between F/T sensors can be free of contacts; give contacts that come and go presence = \"possible\""
    )]
    Nothing,
    /// Sizes that do not go together.
    #[error(transparent)]
    Dynamics(#[from] DynamicsError),
    /// CAD that is no starting point.
    #[error(transparent)]
    Prior(#[from] PriorError),
    /// An earlier state that does not fit.
    #[error(transparent)]
    Information(#[from] InformationError),
}

/// All that is observed at one instant.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    /// The instant; later than the last one.
    pub t: Nanos,
    /// Poses and motions of all links.
    pub kinematics: &'a Kinematics,
    /// F/T readings as they come, offsets not removed, in their measurement frames; finite also where a sensor is at fault.
    pub readings: &'a [Wrench],
    /// Contacts that are present.
    pub active: &'a ContactSet,
    /// What speaks against the motion of the base.
    pub base: Reason,
    /// What speaks against each joint's motion.
    pub joints: &'a [Reason],
    /// The joints that have moved since the instant before, beyond their noise.
    pub moved: &'a DofSet,
    /// Whether the base has.
    pub is_base_moved: bool,
    /// What speaks against each sensor's reading.
    pub sensors: &'a [Reason],
}

/// Why a component learns nothing at present.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Paused {
    /// It learns.
    #[default]
    No,
    /// A contact is declared that leaves none of its equations.
    Contact,
    /// Its sensors read what neither noise nor its knowledge's uncertainty explains: a contact that nobody declared, an outlier, a change.
    Suspected,
    /// A channel that it needs is at fault.
    Fault(Reason),
}

impl std::fmt::Display for Paused {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::No => write!(f, "identification goes on"),
            Self::Contact => write!(f, "identification pauses: a contact is declared"),
            Self::Suspected => write!(
                f,
                "identification pauses: the readings do not fit what is known; a contact that is not declared, or a change"
            ),
            Self::Fault(reason) => write!(f, "identification pauses: a channel is at fault ({reason:?})"),
        }
    }
}

/// A change that was found, and what was let go of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Change {
    /// The sensors' offsets have jumped, and start afresh.
    Offset,
    /// The outermost links have another load, and their parameters start afresh.
    Load,
}

impl std::fmt::Display for Change {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Offset => "an F/T offset has jumped: offsets are learnt anew",
            Self::Load => "the robot carries another load: the parameters of its outermost links are learnt anew",
        })
    }
}

/// What became of a component's instants.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Instants whose rows went in.
    pub learnt: u64,
    /// Of these, those of blocks in which nothing moved: they teach a weight, once, and offsets.
    pub still: u64,
    /// Instants left out under a declared contact.
    pub contact: u64,
    /// Instants left out because they did not fit, for no longer than a block: outliers, and how everything begins that does not fit.
    pub outlier: u64,
    /// Instants left out because they did not fit either: contacts that nobody declared, and changes until they are found.
    pub suspected: u64,
    /// Instants left out because a channel was silent.
    pub stale: u64,
    /// Instants left out because a sensor was saturated.
    pub saturated: u64,
    /// Instants left out because a device reported a fault.
    pub device_fault: u64,
    /// Instants left out because a channel was not seen yet, told too little, or nothing was known of the base.
    pub unseen: u64,
    /// Changes found: of all kinds, ...
    pub changes: u64,
    /// ... of offsets, ...
    pub offset_changes: u64,
    /// ... and of loads.
    pub load_changes: u64,
    /// Solutions that came after their stamp.
    pub late: u64,
    /// Solutions that could not be found.
    pub failed: u64,
}

/// What is known of a component from some instant on.
#[derive(Clone, Debug, Default)]
pub struct ComponentSolution {
    /// Its links.
    pub links: Vec<usize>,
    /// Their inertias: of bodies that can exist.
    pub bodies: Vec<RigidInertia>,
    /// Its sensors.
    pub sensors: Vec<usize>,
    /// Their offsets, raw reading less true one, in their measurement frames.
    pub offsets: Vec<Wrench>,
    /// A root `U` of the covariance `P = U^T U` over [ten per link | torque, force of each sensor's offset].
    pub root: DMatrix<f64>,
    /// How far each offset wanders in a second [Nm/s^½, N/s^½], [torque; force].
    pub drift: Vec<[f64; 6]>,
    /// Variance of one reading about what the model says of it [Nm^2, N^2], [torque; force]: the sensor's noise, vibration, late stamps.
    pub noise: Vec<[f64; 6]>,
    /// The stamp of the newest data that this is found from.
    pub data: Nanos,
    /// The prior's weight; not a number before the first solution.
    pub tau: f64,
    /// How many parameters the data determine, rather than the prior.
    pub effective: f64,
    /// For how long its links have moved in what was learnt from so far [s].
    pub motion: f64,
    /// How many rows were learnt from so far, in motion and at rest.
    pub rows: u64,
    /// Whether all this is found from the data up to [`Solution::data`]. Else nothing that can exist fitted these, and it is what was there before.
    pub is_accepted: bool,
    /// What is most probable, `[s | d]`, and a root of its covariance over `[d | s]`: by this new readings are judged.
    estimate: Vec<f64>,
    spread: DMatrix<f64>,
}

/// What a job found.
#[derive(Clone, Debug, Default)]
pub struct Solution {
    /// The stamp of the newest data that it was looked for in.
    pub data: Nanos,
    /// Of each component.
    pub components: Vec<ComponentSolution>,
}

/// Information about some of a component's unknowns alone.
#[derive(Clone, Debug)]
struct Limb {
    columns: Vec<usize>,
    information: Information,
    panel: Panel,
}

impl Limb {
    fn new(columns: Vec<usize>, rows: usize) -> Self {
        Self {
            information: Information::new(columns.len()),
            panel: Panel::new(columns.len(), rows),
            columns,
        }
    }
}

/// Sub-trees that sensors join, and what is known of them.
#[derive(Clone, Debug)]
struct Component {
    links: Vec<usize>,
    sensors: Vec<usize>,
    /// Joints whose motion its rows rest on, by the link that kinematics start at.
    dofs: Vec<DofSet>,
    /// Contacts on its links that come and go.
    passing: ContactSet,
    /// CAD and configured offsets, `[s | d]`.
    reference: Vec<f64>,
    kinds: Arc<Kinds>,
    /// Columns of the links at the ends of its limbs.
    outermost: Vec<usize>,
    information: Information,
    panel: Panel,
    /// Of a large component, what its limbs' rows told since they last joined the information.
    limbs: Vec<Limb>,
    /// Which of these the rows of each kind go to, if to any.
    limb_of: Vec<Option<usize>>,
    /// For how long offsets have wandered since they last did in the information, and how long they may [s].
    wandered: f64,
    stride: f64,
    variances: Vec<f64>,
    /// Those that the rows for the next job are whitened with.
    whitened: Vec<f64>,
    /// The configured ones.
    least: Vec<f64>,
    /// Standard deviations of a second of drift.
    wander: Vec<f64>,
    /// Columns of the offsets.
    offsets: Vec<usize>,
    /// Room for how far these wander at once, in standard deviations.
    deviations: Vec<f64>,
    gathered: Rows,
    pending: Rows,
    /// For the next job: what went in, what was put aside.
    learnt: Rows,
    aside: Rows,
    block_from: Nanos,
    drifted: Nanos,
    active: ContactSet,
    is_suspected: bool,
    /// Whether a second block did not fit, either.
    lasts: bool,
    clean: u32,
    /// The links that carry the sensors; how the proper acceleration of each pointed when the present suspicion began; the least cosine to it since.
    carriers: Vec<usize>,
    directions: Vec<Vec3>,
    cosines: Vec<f64>,
    /// Whether what is in force can be trusted to judge rows.
    judges: bool,
    paused: Paused,
    last_change: Option<Change>,
    counts: Counts,
    /// What was learnt from: seconds in motion, rows.
    motion: f64,
    rows: u64,
    /// The rows of the present instant.
    instant: Instant,
    row: Vec<f64>,
    scratch: Scratch,
}

/// Room for the gate.
#[derive(Clone, Debug)]
struct Scratch {
    covariance: Vec<f64>,
    mean: Vec<f64>,
    projected: Vec<f64>,
    innovations: Vec<f64>,
}

/// Identification of a robot's inertial parameters and F/T offsets, on-line. See the [module](self).
#[derive(Debug)]
pub struct Online {
    stacked: StackedRegressor,
    components: Vec<Component>,
    period: Nanos,
    newest: Nanos,
    job: Option<Box<Job>>,
    /// When the job's snapshot was taken; none while nothing was observed.
    snapshot: Option<Nanos>,
    is_away: bool,
    /// Whether the stamp of the job that is away has passed.
    is_overdue: bool,
    late: u64,
    solution: Solution,
}

impl Online {
    /// Nothing known but `cad`, one inertia per link, and `offsets`, one per sensor. One instant is expected per `period`, and CAD to be off by this share, `relative`. `always` are the contacts that are never absent.
    ///
    /// # Errors
    /// [`OnlineError`].
    #[allow(clippy::too_many_arguments, reason = "each of another kind")]
    pub fn new(
        model: &Model,
        structure: &Structure,
        cad: &[RigidInertia],
        offsets: &[Wrench],
        always: &ContactSet,
        base: usize,
        period: Nanos,
        relative: f64,
    ) -> Result<Self, OnlineError> {
        let kinematics = Kinematics::new(model, base)?;
        let mut stacked = StackedRegressor::new(structure);
        let readings = vec![Wrench::zero(); structure.sensors().len()];
        stacked.update(&kinematics, &readings, always, &[])?;
        stacked.eliminate_contacts(Weighting::Noise);
        // Sub-trees that can be free, and which of them share a sensor.
        let is_free: Vec<bool> = stacked
            .subtrees()
            .iter()
            .map(|subtree| subtree.remaining() > 0 && subtree.sensors().len() > 0)
            .collect();
        let mut group: Vec<usize> = (0..is_free.len()).collect();
        for sensor in 0..structure.sensors().len() {
            let sharing: Vec<usize> = (0..is_free.len())
                .filter(|&k| is_free[k] && structure.subtrees()[k].sensors.contains(sensor))
                .collect();
            if let [a, b] = sharing[..] {
                let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
                group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
            }
        }
        let per_job = usize::try_from(2 * SOLVE.0 / period.0.max(1)).unwrap_or(0).max(1);
        let per_block = usize::try_from(BLOCK.0 / period.0.max(1)).unwrap_or(0) + 2;
        let components: Vec<Component> = (0..is_free.len())
            .filter(|&k| is_free[k] && group[k] == k)
            .map(|first| {
                let subtrees = (0..is_free.len())
                    .filter(|&k| is_free[k] && group[k] == first)
                    .collect();
                Component::new(
                    model,
                    &stacked,
                    subtrees,
                    cad,
                    offsets,
                    always,
                    per_job,
                    per_block,
                    period.seconds(),
                )
            })
            .collect();
        if components.is_empty() {
            return Err(OnlineError::Nothing);
        }
        // Matrices of a large component are of a size that glibc gets from the system, and gives back, one by one: a tenth of a job's time. Once it has freed a larger block, it keeps as much.
        if components
            .iter()
            .any(|component| component.information.unknowns() >= LARGE)
        {
            drop(std::hint::black_box(Vec::<u8>::with_capacity(KEPT)));
        }
        let prior = Arc::new(Prior::new(cad)?.expecting(relative));
        let solution = Solution {
            data: Nanos::MIN,
            components: components.iter().map(|c| c.unknown(cad, offsets)).collect(),
        };
        let job = Box::new(Job {
            data: Nanos::MIN,
            parts: (components.iter().zip(&solution.components))
                .map(|(component, known)| Part::new(component, known.clone(), period, &prior, relative))
                .collect(),
            prior,
            solution: solution.clone(),
        });
        Ok(Self {
            stacked,
            components,
            period,
            newest: Nanos::MIN,
            job: Some(job),
            snapshot: None,
            is_away: false,
            is_overdue: false,
            late: 0,
            solution,
        })
    }

    /// Begins where earlier identification ended: these links have these inertias, `root^T root` being the covariance of their ten parameters each, in this order. Their errors are taken as
    /// Gaussian about them; the prior about CAD stays, which they have heard once already: it counts twice, and little beside them.
    ///
    /// # Errors
    /// The root has another width, or a covariance that is not positive definite in some component. Nothing is changed then in that component and those after it.
    pub fn begin_with(
        &mut self,
        cad: &[RigidInertia],
        links: &[(usize, RigidInertia)],
        root: &DMatrix<f64>,
    ) -> Result<(), OnlineError> {
        let width = WIDTH * links.len();
        if root.ncols() != width {
            let (what, got, expected) = ("columns of the covariance's root", root.ncols(), width);
            return Err(InformationError::Size { what, got, expected }.into());
        }
        let pairs = self.components.iter_mut().zip(&mut self.solution.components);
        for (number, (component, known)) in pairs.enumerate() {
            let (session, unknowns) = (component.offsets.len(), component.information.unknowns());
            // Columns in the component, columns of the root, and what the parameters are beside CAD.
            let mut columns = Vec::new();
            for (place, link) in component.links.iter().enumerate() {
                let Some(at) = links.iter().position(|(number, _)| number == link) else {
                    continue;
                };
                let (found, cad) = (links[at].1.parameters(), cad[*link].parameters());
                columns.extend((0..WIDTH).map(|i| (session + WIDTH * place + i, WIDTH * at + i, found[i] - cad[i])));
                known.bodies[place] = links[at].1;
            }
            if columns.is_empty() {
                continue;
            }
            // U of these columns alone, by their deviations: P = S U^T U S, so that the whitened error is U^-T S^-1 (d - d_0).
            let mut own = DMatrix::from_fn(root.nrows(), columns.len(), |i, j| root[(i, columns[j].1)]);
            let deviations: Vec<f64> = own.column_iter().map(|column| column.norm()).collect();
            for (mut column, deviation) in own.column_iter_mut().zip(&deviations) {
                column /= *deviation;
            }
            let upper = own.qr().r();
            let inverse = upper
                .transpose()
                .try_inverse()
                .filter(|inverse| inverse.iter().all(|x| x.is_finite()));
            let Some(inverse) = inverse.filter(|_| upper.nrows() == columns.len()) else {
                return Err(InformationError::Undetermined { unknown: columns[0].0 }.into());
            };
            let mut panel = Panel::new(unknowns, columns.len());
            for whitened in inverse.row_iter() {
                let (mut row, mut right) = (vec![0.0; unknowns], 0.0);
                for ((&(column, _, value), deviation), weight) in columns.iter().zip(&deviations).zip(whitened.iter()) {
                    row[column] = weight / deviation;
                    right += row[column] * value;
                }
                panel.push_row(&row, right)?;
            }
            component.information.absorb(&mut panel)?;
            // In force from the beginning: of links that are not among them CAD is.
            let Some(job) = &mut self.job else { continue };
            let Some(part) = job.parts.get_mut(number) else {
                continue;
            };
            let mut begun = part.contest.in_force().clone();
            let (rows, parameters) = begun.root.shape();
            begun.root = begun.root.resize_vertically(rows + columns.len(), 0.0);
            for (j, (&(column, _, value), deviation)) in columns.iter().zip(&deviations).enumerate() {
                begun.change[column - session] = value;
                begun.root.column_mut(column - session).fill(0.0);
                for i in 0..=j {
                    begun.root[(rows + i, column - session)] = upper[(i, j)] * deviation;
                }
            }
            begun.root = begun.root.qr().r();
            begun.bodies.clone_from(&known.bodies);
            begun.tau = f64::NAN;
            debug_assert_eq!(begun.root.ncols(), parameters);
            part.contest.enthrone(begun);
            part.tell(known);
            part.good.clone_from(known);
        }
        Ok(())
    }

    /// Number of components.
    pub fn component_count(&self) -> usize {
        self.components.len()
    }

    /// Why a component learns nothing at present, and what became of its instants so far; none if there is no such component.
    pub fn state(&self, component: usize) -> Option<(Paused, Counts)> {
        let of = self.components.get(component)?;
        Some((
            of.paused,
            Counts {
                late: self.late,
                ..of.counts
            },
        ))
    }

    /// How much a component's noise is inflated: variance of each channel [torque; force of each sensor] by the configured one. Empty if there is no such component.
    pub fn inflation(&self, component: usize) -> Vec<f64> {
        let of = self.components.get(component);
        of.map_or(Vec::new(), |of| {
            of.variances.iter().zip(&of.least).map(|(v, least)| v / least).collect()
        })
    }

    /// What is in force.
    pub fn solution(&self) -> &Solution {
        &self.solution
    }

    /// Takes in what is observed at an instant. Does not allocate.
    ///
    /// # Errors
    /// Sizes, or numbers that are not finite; then nothing was taken in.
    pub fn observe(&mut self, observation: &Observation<'_>) -> Result<(), DynamicsError> {
        let Observation {
            t,
            kinematics,
            readings,
            active,
            ..
        } = *observation;
        let period = self.period.0.max(1);
        let slot = t.0.div_euclid(period);
        // A block has room for one instant in each slot.
        if t <= self.newest || slot == self.newest.0.div_euclid(period) {
            return Ok(());
        }
        self.stacked.update(kinematics, readings, active, &[])?;
        self.stacked.eliminate_contacts(Weighting::Noise);
        self.newest = t;
        self.snapshot.get_or_insert(t);
        for (component, known) in self.components.iter_mut().zip(&self.solution.components) {
            component.observe(observation, &self.stacked, known, slot);
        }
        Ok(())
    }

    /// Once a second a job to run; none while the last one has not come back or waits for its stamp. Does not allocate.
    pub fn take_job(&mut self) -> Option<Box<Job>> {
        let due = self.snapshot? + SOLVE;
        if self.is_away || self.newest < due {
            return None;
        }
        let mut job = self.job.take()?;
        self.is_away = true;
        self.snapshot = Some(self.newest);
        job.data = self.newest;
        for (part, component) in job.parts.iter_mut().zip(&mut self.components) {
            component.join();
            // Made for the same unknowns.
            let _ = part.information.copy_from(&component.information);
            std::mem::swap(&mut part.learnt, &mut component.learnt);
            std::mem::swap(&mut part.aside, &mut component.aside);
            component.learnt.clear();
            component.aside.clear();
            part.is_suspected = component.is_suspected;
            part.is_moving = part.learnt.is_moving() || part.aside.is_moving();
            part.cosines.copy_from_slice(&component.cosines);
            part.whitened.copy_from_slice(&component.whitened);
            component.whitened.copy_from_slice(&component.variances);
            part.motion = component.motion;
            part.rows = component.rows;
        }
        Some(job)
    }

    /// Gives a job back that has run.
    pub fn give_back(&mut self, job: Box<Job>) {
        self.job = Some(job);
    }

    /// Puts the job's solution in force if its stamp has come: whether something changed. Call it before [`Online::take_job`], after each instant. Does not allocate.
    pub fn apply(&mut self) -> bool {
        let Some(due) = self.snapshot.filter(|_| self.is_away).map(|snapshot| snapshot + SOLVE) else {
            return false;
        };
        if self.newest < due {
            return false;
        }
        let Some(job) = &mut self.job else {
            self.is_overdue = true;
            return false;
        };
        self.is_away = false;
        self.late += u64::from(std::mem::take(&mut self.is_overdue));
        std::mem::swap(&mut self.solution, &mut job.solution);
        for (part, component) in job.parts.iter_mut().zip(&mut self.components) {
            component.variances.copy_from_slice(&part.variances);
            component.wander.copy_from_slice(&part.wander);
            component.judges = part.failure.is_none();
            component.counts.failed += u64::from(part.failure.is_some());
            // What has passed by itself meanwhile was no change.
            part.is_replaced &= component.is_suspected;
            if let Some((change, information)) = part.change.as_mut().filter(|_| component.is_suspected) {
                component.last_change = Some(*change);
                std::mem::swap(information, &mut component.information);
                // As old as what it replaces.
                component.limbs.iter_mut().for_each(|limb| limb.information.clear());
                // The solution in force is the one of before the change; the next one knows of it.
                component.judges = false;
                component.is_suspected = false;
                component.paused = Paused::No;
                component.counts.changes += 1;
                match change {
                    Change::Offset => component.counts.offset_changes += 1,
                    Change::Load => component.counts.load_changes += 1,
                }
                component.pending.clear();
                component.gathered.clear();
            }
        }
        true
    }

    /// The last change that was found in a component ([`Counts::changes`] tells how many there were).
    pub fn last_change(&self, component: usize) -> Option<Change> {
        self.components.get(component)?.last_change
    }
}

impl Component {
    #[allow(clippy::too_many_arguments, reason = "one caller, which has them all")]
    fn new(
        model: &Model,
        stacked: &StackedRegressor,
        mut subtrees: Vec<usize>,
        cad: &[RigidInertia],
        offsets: &[Wrench],
        always: &ContactSet,
        per_job: usize,
        per_block: usize,
        period: f64,
    ) -> Self {
        let structure = stacked.structure();
        let mut links: Vec<usize> = subtrees.iter().flat_map(|&k| structure.links_of(k)).collect();
        let mut sensors: Vec<usize> = subtrees.iter().flat_map(|&k| stacked.subtrees()[k].sensors()).collect();
        for list in [&mut links, &mut sensors] {
            list.sort_unstable();
            list.dedup();
        }
        let session = 6 * sensors.len();
        let unknowns = session + WIDTH * links.len();
        let place = |list: &[usize], of: usize| list.binary_search(&of).unwrap_or(0);
        if unknowns >= LARGE {
            // Whitened rows have the unknowns of rows before them: the trunk's come last.
            let size = |&k: &usize| {
                (
                    stacked.subtrees()[k].sensors().len(),
                    stacked.subtrees()[k].links().len(),
                )
            };
            subtrees.sort_by_key(size);
        }
        let columns: Vec<Vec<usize>> = subtrees
            .iter()
            .map(|&k| {
                let subtree = &stacked.subtrees()[k];
                let of_links = subtree.links().iter().flat_map(|&link| {
                    let first = session + WIDTH * place(&links, link);
                    first..first + WIDTH
                });
                let of_sensors = subtree.sensors().flat_map(|sensor| {
                    let first = 6 * place(&sensors, sensor);
                    first..first + 6
                });
                of_links.chain(of_sensors).collect()
            })
            .collect();
        let to_root = |mut link: usize| {
            let mut dofs = DofSet::default();
            while link > 0 {
                let joint = &model.joints()[link - 1];
                if let Some(dof) = joint.dof {
                    dofs.insert(dof);
                }
                link = joint.parent;
            }
            dofs
        };
        let to_root: Vec<DofSet> = (0..model.link_count()).map(to_root).collect();
        // From a base to a link: a joint on the way of both to the root is crossed by neither.
        let crossed = |base: &DofSet| {
            links.iter().fold(DofSet::default(), |dofs, &link| {
                let (there, back) = (to_root[link].difference(base), base.difference(&to_root[link]));
                dofs.union(&there).union(&back)
            })
        };
        let dofs = to_root.iter().map(crossed).collect();
        let parents: Vec<usize> = model.joints().iter().map(|joint| joint.parent).collect();
        let outermost = (links.iter().enumerate())
            .filter(|(_, link)| !parents.contains(link))
            .flat_map(|(place, _)| session + WIDTH * place..session + WIDTH * (place + 1))
            .collect();
        let mut reference: Vec<f64> = sensors.iter().flat_map(|&s| offsets[s].torque_first()).collect();
        reference.extend(links.iter().flat_map(|&link| cad[link].parameters()));
        let noise: Vec<f64> = (sensors.iter())
            .flat_map(|&s| {
                let noise = structure.sensors()[s].noise();
                Wrench::from_parts(noise.force, noise.torque).torque_first()
            })
            .collect();
        let passing = (subtrees.iter())
            .fold(ContactSet::default(), |set, &k| {
                set.union(&structure.subtrees()[k].contacts)
            })
            .difference(always);
        let kinds = Arc::new(Kinds::new(stacked, &subtrees, &columns, (session, unknowns)));
        let (mut limbs, mut limb_of) = (Vec::new(), Vec::new());
        for kind in kinds.iter() {
            let is_limb = unknowns >= LARGE && 2 * kind.columns.len() <= unknowns;
            limb_of.push(is_limb.then_some(limbs.len()));
            if is_limb {
                limbs.push(Limb::new(kind.columns.clone(), 6 * per_block));
            }
        }
        let most = kinds.most();
        let channels = channels(&noise, period);
        Self {
            stride: if limbs.is_empty() { 0.0 } else { GATHERED },
            wandered: 0.0,
            limbs,
            limb_of,
            dofs,
            passing,
            reference,
            outermost,
            information: Information::new(unknowns),
            panel: Panel::new(unknowns, most * per_block),
            variances: channels.iter().map(|channel| channel.noise().0).collect(),
            least: noise.iter().map(|sigma| sigma * sigma).collect(),
            wander: channels.iter().map(|channel| channel.noise().1).collect(),
            whitened: channels.iter().map(|channel| channel.noise().0).collect(),
            offsets: (0..session).collect(),
            deviations: vec![0.0; session],
            gathered: Rows::new(&kinds, per_block),
            pending: Rows::new(&kinds, per_block),
            learnt: Rows::new(&kinds, per_job),
            aside: Rows::new(&kinds, per_job),
            block_from: Nanos::MIN,
            drifted: Nanos::MIN,
            active: ContactSet::default(),
            is_suspected: false,
            lasts: false,
            clean: 0,
            carriers: sensors.iter().map(|&s| structure.sensors()[s].joint() + 1).collect(),
            directions: vec![Vec3::zeros(); sensors.len()],
            cosines: vec![1.0; sensors.len()],
            judges: false,
            paused: Paused::No,
            last_change: None,
            counts: Counts::default(),
            motion: 0.0,
            rows: 0,
            instant: Instant::new(&kinds),
            row: vec![0.0; unknowns],
            scratch: Scratch {
                covariance: vec![0.0; most * most],
                mean: vec![0.0; unknowns + 1],
                projected: vec![0.0; most * (unknowns + session)],
                innovations: vec![0.0; most],
            },
            kinds,
            links,
            sensors,
        }
    }

    /// A solution that says nothing.
    fn unknown(&self, cad: &[RigidInertia], offsets: &[Wrench]) -> ComponentSolution {
        ComponentSolution {
            links: self.links.clone(),
            bodies: self.links.iter().map(|&link| cad[link]).collect(),
            sensors: self.sensors.clone(),
            offsets: self.sensors.iter().map(|&sensor| offsets[sensor]).collect(),
            root: DMatrix::zeros(0, WIDTH * self.links.len() + 6 * self.sensors.len()),
            drift: self
                .wander
                .chunks_exact(6)
                .map(|six| std::array::from_fn(|i| six[i]))
                .collect(),
            noise: (self.least.chunks_exact(6))
                .map(|six| std::array::from_fn(|i| six[i]))
                .collect(),
            tau: f64::NAN,
            ..ComponentSolution::default()
        }
    }

    fn observe(&mut self, seen: &Observation<'_>, stacked: &StackedRegressor, known: &ComponentSolution, slot: i64) {
        let t = seen.t;
        if self.block_from == Nanos::MIN {
            (self.block_from, self.drifted) = (t, t);
        }
        let passing = self.passing.intersection(seen.active);
        if passing != self.active {
            // Who declares a touch may be a little late, and who declares its end a little early.
            self.counts.contact += self.gathered.instants() + self.pending.instants();
            self.gathered.clear();
            self.pending.clear();
            self.active = passing;
            (self.block_from, self.drifted) = (t, t);
        }
        if t - self.block_from >= BLOCK {
            self.close(t, known);
            self.block_from = t;
        }
        let of_sensors = self.sensors.iter().filter_map(|&s| seen.sensors.get(s));
        let base = seen.kinematics.base();
        let of_joints = self.dofs[base].iter().filter_map(|dof| seen.joints.get(dof));
        let fault = std::iter::once(&seen.base).chain(of_sensors).chain(of_joints);
        if let Some(reason) = fault.copied().find(|reason| *reason != Reason::None) {
            self.paused = Paused::Fault(reason);
            let counts = &mut self.counts;
            *match reason {
                Reason::Stale => &mut counts.stale,
                Reason::Saturated => &mut counts.saturated,
                Reason::DeviceFault => &mut counts.device_fault,
                _ => &mut counts.unseen,
            } += 1;
            return;
        }
        let made = (self.instant).make(&self.kinds, stacked, &self.reference, &self.variances);
        if made == 0 {
            self.paused = Paused::Contact;
            self.counts.contact += 1;
            return;
        }
        self.paused = if self.is_suspected {
            Paused::Suspected
        } else {
            Paused::No
        };
        if self.is_suspected {
            let tilts = self.carriers.iter().zip(&mut self.directions).zip(&mut self.cosines);
            for ((&link, began), cosine) in tilts {
                let acceleration = seen.kinematics.motion(link).proper_acceleration;
                let direction = acceleration / acceleration.norm().max(1e-3);
                if *began == Vec3::zeros() {
                    *began = direction;
                }
                *cosine = cosine.min(direction.dot(began));
            }
        }
        self.gathered.push(slot, &self.instant);
        self.gathered.has_moved |= seen.is_base_moved || !seen.moved.intersection(&self.dofs[base]).is_empty();
    }

    /// The end of a block: the gate judges, offsets wander, rows go in or aside.
    fn close(&mut self, t: Nanos, known: &ComponentSolution) {
        let elapsed = (t - self.drifted).seconds().clamp(0.0, 60.0);
        self.drifted = t;
        if !self.gathered.is_empty() && self.judges && self.is_odd(known, t) {
            self.lasts = self.is_suspected;
            if !self.is_suspected {
                self.is_suspected = true;
                self.cosines.fill(1.0);
                self.directions.fill(Vec3::zeros());
            }
            self.clean = 0;
            let instants = self.pending.instants() + self.gathered.instants();
            self.leave_out(instants);
            self.aside.take_from(&self.gathered);
            self.pending.clear();
            self.gathered.clear();
            return;
        }
        if !self.gathered.is_empty() && self.is_suspected {
            self.clean += 1;
            if self.clean < CLEAN {
                let instants = self.gathered.instants();
                self.leave_out(instants);
                self.gathered.clear();
                return;
            }
            self.is_suspected = false;
        }
        if self.active.is_empty() && !self.is_suspected {
            self.wandered += elapsed;
        }
        if self.wandered > 0.0 && self.wandered >= self.stride {
            self.join();
            for (to, wander) in self.deviations.iter_mut().zip(&self.wander) {
                *to = wander * self.wandered.sqrt();
            }
            self.wandered = 0.0;
            let _ = self.information.drift(&self.offsets, &self.deviations);
        }
        if !self.gathered.is_empty() {
            self.absorb();
            self.gathered.span = (t - self.block_from).seconds().min(2.0 * BLOCK.seconds());
            std::mem::swap(&mut self.pending, &mut self.gathered);
        }
    }

    /// Counts instants that do not fit, or stand too near to such.
    fn leave_out(&mut self, instants: u64) {
        *if self.lasts {
            &mut self.counts.suspected
        } else {
            &mut self.counts.outlier
        } += instants;
    }

    /// What limbs gathered joins the rest.
    fn join(&mut self) {
        for limb in &mut self.limbs {
            if limb.information.rows() > 0 {
                // Made for each other.
                let (panel, row) = (&mut self.panel, &mut self.row);
                let _ = (self.information).take(&mut limb.information, &limb.columns, panel, row);
            }
        }
    }

    /// Takes the pending block in.
    fn absorb(&mut self) {
        // Finite, and there is room.
        for ((kind, rows), limb) in self.kinds.iter().zip(self.pending.iter()).zip(&self.limb_of) {
            let mut limb = limb.and_then(|limb| self.limbs.get_mut(limb));
            for (a, y, _) in rows.iter() {
                if let Some(limb) = &mut limb {
                    let _ = limb.panel.push_row(a, y);
                } else if a.len() == self.row.len() {
                    let _ = self.panel.push_row(a, y);
                } else {
                    spread(kind, a, &mut self.row);
                    let _ = self.panel.push_row(&self.row, y);
                }
            }
        }
        let _ = self.information.absorb(&mut self.panel);
        for limb in &mut self.limbs {
            let _ = limb.information.absorb(&mut limb.panel);
        }
        let instants = self.pending.instants();
        self.counts.learnt += instants;
        if self.pending.is_moving() {
            self.motion += self.pending.span;
        } else {
            self.counts.still += instants;
        }
        self.rows += self.pending.len() as u64;
        self.learnt.take_from(&self.pending);
        self.pending.clear();
    }

    /// Whether the mean innovation of the gathered block is beyond what noise and the uncertainty of what is in force explain.
    /// (And how far offsets have wandered by `t`, since the data that this is found from.)
    fn is_odd(&mut self, known: &ComponentSolution, t: Nanos) -> bool {
        let unknowns = self.kinds.unknowns();
        let (session, wandered) = (self.offsets.len(), (t - known.data).seconds().max(0.0).sqrt());
        let projected_width = unknowns + session;
        if known.estimate.len() != unknowns || known.spread.shape() != (unknowns, unknowns) {
            return false;
        }
        let Scratch {
            mean,
            projected,
            covariance,
            innovations,
        } = &mut self.scratch;
        let mut m = 0;
        for (kind, rows) in self.kinds.iter().zip(self.gathered.iter()) {
            // Instants of a block have equally many rows, made alike: their sum over the root of their number has unit noise.
            let Some(first) = rows.slots().first() else { continue };
            let own = rows.slots().iter().take_while(|slot| *slot == first).count();
            let instants = rows.slots().len() / own;
            let scale = 1.0 / (instants as f64).sqrt();
            let width = kind.columns.len() + 1;
            let mean = &mut mean[..width];
            for index in 0..own {
                mean.fill(0.0);
                for row in rows
                    .values()
                    .chunks_exact(width)
                    .skip(index)
                    .step_by(own)
                    .take(instants)
                {
                    add_multiple(mean, scale, row);
                }
                let (row, right) = mean.split_at(kind.columns.len());
                innovations[m] = kind.left(row, right[0], &known.estimate);
                let (to, walk) = projected[m * projected_width..][..projected_width].split_at_mut(unknowns);
                walk.fill(0.0);
                for (value, &channel) in row.iter().zip(&kind.columns[..kind.offsets]) {
                    walk[channel] = value * self.wander[channel] * wandered;
                }
                // U a: the columns of U are [d | s].
                Arch::new().dispatch(Project {
                    root: &known.spread,
                    session,
                    columns: &kind.columns,
                    row,
                    to,
                });
                m += 1;
            }
        }
        for i in 0..m {
            for j in 0..=i {
                let (a, b) = (&projected[i * projected_width..], &projected[j * projected_width..]);
                let (a, b) = (&a[..projected_width], &b[..projected_width]);
                covariance[i * m + j] = dot(a, b) + f64::from(u8::from(i == j));
            }
        }
        factorise(covariance, m);
        forward(covariance, m, &mut innovations[..m], 1);
        let square: f64 = innovations[..m].iter().map(|x| x * x).sum();
        square > chi_square(m, GATE)
    }
}

/// `U a` of a row over some unknowns of `[s | d]`, `U` over `[d | s]`.
struct Project<'a> {
    root: &'a DMatrix<f64>,
    session: usize,
    columns: &'a [usize],
    row: &'a [f64],
    to: &'a mut [f64],
}

impl WithSimd for Project<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (rows, parameters) = (self.root.nrows(), self.root.ncols() - self.session);
        let root = self.root.as_slice();
        self.to.fill(0.0);
        let (columns, rest) = self.columns.as_chunks::<TOGETHER>();
        let (values, values_left) = self.row.as_chunks::<TOGETHER>();
        for (columns, values) in columns.iter().zip(values) {
            let mut four: [&[f64]; TOGETHER] = [&[]; TOGETHER];
            for (own, &column) in four.iter_mut().zip(columns) {
                *own = &root[rows * turned(column, self.session, parameters)..][..rows];
            }
            lanes::add_four(simd, self.to, *values, four);
        }
        for (&column, &value) in rest.iter().zip(values_left) {
            let own = &root[rows * turned(column, self.session, parameters)..][..rows];
            lanes::add(simd, self.to, value, own);
        }
    }
}

/// A column of `[s | d]` among those of `[d | s]`.
#[inline(always)]
fn turned(column: usize, session: usize, parameters: usize) -> usize {
    if column < session {
        parameters + column
    } else {
        column - session
    }
}

/// A component's share of a job.
#[derive(Clone, Debug)]
struct Part {
    kinds: Arc<Kinds>,
    links: Vec<usize>,
    sensors: Vec<usize>,
    information: Information,
    reference: Vec<f64>,
    outermost: Vec<usize>,
    learnt: Rows,
    aside: Rows,
    is_suspected: bool,
    /// Whether something moved in the second.
    is_moving: bool,
    /// [`Component::cosines`].
    cosines: Vec<f64>,
    /// Inflated.
    variances: Vec<f64>,
    channels: Vec<Channel>,
    /// How the means of the second before hang on the bodies, a column per channel, and what these were held to be.
    before: Option<(DMatrix<f64>, Vec<f64>)>,
    /// What the rows are whitened with.
    whitened: Vec<f64>,
    wander: Vec<f64>,
    period: f64,
    tau: f64,
    /// Why the last job found nothing.
    failure: Option<PriorError>,
    motion: f64,
    rows: u64,
    /// The last solution that was found.
    good: ComponentSolution,
    /// The most probable unknowns, `[s | d]`, and parameters; those in force, and who might replace them.
    estimate: Vec<f64>,
    spread: DMatrix<f64>,
    newest: Parameters,
    contest: Contest<Parameters>,
    /// Whether those in force are to be replaced, come what may.
    is_replaced: bool,
    /// What the rows that were put aside tell, and for how long there were any \[s\].
    put_aside: Information,
    asked: f64,
    change: Option<(Change, Information)>,
}

/// Parameters that are, or may come, in force.
#[derive(Clone, Debug, Default)]
struct Parameters {
    /// `d`.
    change: Vec<f64>,
    /// A root `U` of their covariance `U^T U`.
    root: DMatrix<f64>,
    bodies: Vec<RigidInertia>,
    tau: f64,
    effective: f64,
}

impl Parameters {
    /// CAD's, each uncertain by this share.
    fn of_cad(bodies: &[RigidInertia], relative: f64) -> Self {
        let count = WIDTH * bodies.len();
        let mut root = DMatrix::zeros(count, count);
        for (place, body) in bodies.iter().enumerate() {
            let at = WIDTH * place;
            root.view_mut((at, at), (WIDTH, WIDTH))
                .copy_from(&cad_root(body, relative));
        }
        Self {
            change: vec![0.0; count],
            root,
            bodies: bodies.to_vec(),
            tau: f64::NAN,
            effective: 0.0,
        }
    }
}

impl Parameters {
    /// So far from the first to the second: the mean of a mixture of both, and its covariance.
    ///
    /// ```text
    /// P = (1 - k) P_1 + k P_2 + k (1 - k) (d_2 - d_1) (d_2 - d_1)^T
    /// ```
    fn between(first: &Self, second: &Self, share: f64) -> Result<Self, InformationError> {
        let mixed = |a: f64, b: f64| a + share * (b - a);
        let bodies: Vec<RigidInertia> = (first.bodies.iter().zip(&second.bodies))
            .map(|(a, b)| {
                let (a, b) = (a.parameters(), b.parameters());
                RigidInertia::from_parameters(&std::array::from_fn(|i| mixed(a[i], b[i])))
            })
            .collect();
        // The triangle of three roots below each other, by what absorbs rows of measurements: several
        // times as fast as a QR decomposition that knows nothing of the processor.
        let apart = DMatrix::from_iterator(
            1,
            first.change.len(),
            second.change.iter().zip(&first.change).map(|(b, a)| b - a),
        );
        let mut all = Information::new(first.change.len());
        for (root, weight) in [
            (&first.root, 1.0 - share),
            (&second.root, share),
            (&apart, share * (1.0 - share)),
        ] {
            let mut panel = Panel::new(root.ncols(), root.nrows());
            for row in (root * weight.sqrt()).row_iter() {
                panel.push_row(row.transpose().as_slice(), 0.0)?;
            }
            all.absorb(&mut panel)?;
        }
        Ok(Self {
            change: first
                .change
                .iter()
                .zip(&second.change)
                .map(|(a, b)| mixed(*a, *b))
                .collect(),
            root: all.to_triangle().0,
            bodies,
            tau: second.tau,
            effective: second.effective,
        })
    }
}

/// Per block of a tenth of a second, when it was and the mean of each channel.
type Blocks = Vec<(f64, Vec<f64>)>;

/// The instants of some rows.
struct Span {
    first: i64,
    count: usize,
}

impl Span {
    /// None if there are none, or if they have holes that nothing explains.
    fn of<'a>(rows: impl Iterator<Item = &'a Rows>) -> Option<Self> {
        let ends = |rows: &'a Rows| rows.iter().flat_map(rows::OfKind::slots).copied();
        let (first, last) = rows
            .flat_map(ends)
            .fold((i64::MAX, i64::MIN), |(a, b), slot| (a.min(slot), b.max(slot)));
        let count = usize::try_from(last.checked_sub(first)?).ok()? + 1;
        (count <= LONGEST).then_some(Self { first, count })
    }

    fn place(&self, slot: i64) -> Option<usize> {
        usize::try_from(slot - self.first).ok().filter(|at| *at < self.count)
    }
}

impl Part {
    fn new(component: &Component, good: ComponentSolution, period: Nanos, prior: &Prior, relative: f64) -> Self {
        Self {
            kinds: component.kinds.clone(),
            links: component.links.clone(),
            sensors: component.sensors.clone(),
            information: component.information.clone(),
            reference: component.reference.clone(),
            outermost: component.outermost.clone(),
            learnt: component.learnt.clone_room(),
            aside: component.aside.clone_room(),
            is_suspected: false,
            is_moving: false,
            cosines: component.cosines.clone(),
            variances: component.variances.clone(),
            channels: channels(
                &component.least.iter().map(|v| v.sqrt()).collect::<Vec<_>>(),
                period.seconds(),
            ),
            before: None,
            whitened: component.variances.clone(),
            wander: component.wander.clone(),
            period: period.seconds(),
            tau: prior.expected_tau(),
            failure: None,
            motion: 0.0,
            rows: 0,
            estimate: Vec::new(),
            spread: DMatrix::zeros(0, 0),
            newest: Parameters::default(),
            contest: Contest::new(component.variances.len(), Parameters::of_cad(&good.bodies, relative)),
            is_replaced: false,
            good,
            put_aside: Information::new(component.information.unknowns()),
            asked: 0.0,
            change: None,
        }
    }

    fn run(&mut self, prior: &Prior, data: Nanos, solution: &mut ComponentSolution) {
        // A load that was found is in the information by now, and in nothing that is in force.
        let is_replaced = std::mem::take(&mut self.is_replaced);
        self.change = None;
        let weighed = self.weigh_change(prior);
        self.take_noise();
        self.judge();
        self.failure = weighed.and_then(|()| self.solve(prior)).err();
        match &self.failure {
            // What it holds is older than what is in force.
            Some(_) => solution.clone_from(&self.good),
            None => {
                if is_replaced {
                    self.contest.enthrone(self.newest.clone());
                }
                let newest = &self.newest;
                self.contest.enter(|| newest.clone());
                self.tell(solution);
                solution.data = data;
            }
        }
        solution.is_accepted = self.failure.is_none();
        (solution.motion, solution.rows) = (self.motion, self.rows);
        if solution.is_accepted {
            self.good.clone_from(solution);
        }
    }

    /// The most probable bodies and offsets: where the next trial begins.
    fn solve(&mut self, prior: &Prior) -> Result<(), PriorError> {
        let (session, parameters) = (6 * self.sensors.len(), WIDTH * self.links.len());
        let unknowns = session + parameters;
        let posterior = self.posterior(prior, &self.information)?;
        // One round of the evidence a second: it settles while data come in. Where it has, and from one second to the next, bodies are near where they were.
        let last: Vec<f64> = match self.estimate.split_at_checked(session) {
            Some((offsets, bodies)) => bodies.iter().chain(offsets).copied().collect(),
            None => vec![0.0; unknowns],
        };
        let mut fit = posterior.fit_from(&last, self.tau, NEAR)?;
        let tau = fit.next_tau();
        if (tau / self.tau).ln().abs() > SETTLED || fit.decrement > NEAREST {
            fit = posterior.fit_from(fit.x.as_slice(), tau, NEAREST)?;
        }
        self.tau = tau;
        // [d | s] -> [s | d]
        let (bodies, offsets) = fit.x.as_slice().split_at(parameters);
        self.estimate.clear();
        self.estimate.extend_from_slice(offsets);
        self.estimate.extend_from_slice(bodies);
        self.spread = fit.covariance_root().transpose();
        self.newest = Parameters {
            change: bodies.to_vec(),
            root: self.spread.columns(0, parameters).into_owned(),
            tau: fit.tau,
            effective: fit.effective,
            bodies: fit.bodies,
        };
        Ok(())
    }

    /// Judges the candidates by the second's rows.
    fn judge(&mut self) {
        // At rest all parameters predict as well.
        let is_any = self.learnt.is_moving() && !self.estimate.is_empty();
        let Some(span) = Span::of([&self.learnt].into_iter()).filter(|_| is_any) else {
            return;
        };
        let left: Vec<Blocks> = self.contest.all().map(|own| self.blocks(&span, &own.change)).collect();
        for (number, (t, _)) in left.first().into_iter().flatten().enumerate() {
            self.contest.take(*t, left.iter().map(|own| own[number].1.as_slice()));
        }
        // Those in force stay if what won is no number: nothing that was solved is.
        let between = |old: &Parameters, new: &Parameters, share| {
            Parameters::between(old, new, share).unwrap_or_else(|_| old.clone())
        };
        self.contest.decide(between);
    }

    /// What each channel has left of the second's rows for these parameters, in the mean of each block: when that was, and per channel.
    fn blocks(&self, span: &Span, change: &[f64]) -> Blocks {
        let session = self.variances.len();
        let unknowns: Vec<f64> = self.estimate.iter().take(session).chain(change).copied().collect();
        let (series, _) = self.series(&[&self.learnt], span, &unknowns);
        let per_block = (contest::BLOCK / self.period).round().max(1.0) as usize;
        let mean = |channel: usize, from: usize| {
            let own = series[channel * span.count..][..span.count].iter();
            let (sum, count) = (own.skip(from).take(per_block).filter(|x| x.is_finite()))
                .fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
            sum / count
        };
        let starts = (0..span.count).step_by(per_block);
        let blocks = starts.map(|from| {
            let means: Vec<f64> = (0..session).map(|channel| mean(channel, from)).collect();
            ((span.first as f64 + from as f64) * self.period, means)
        });
        blocks
            .filter(|(_, means)| means.iter().any(|x| x.is_finite()))
            .collect()
    }

    /// What is in force: the parameters, the offsets that go best with these, and what both are uncertain by.
    fn tell(&self, solution: &mut ComponentSolution) {
        let Parameters {
            change,
            root,
            bodies,
            tau,
            effective,
        } = self.contest.in_force();
        let (session, parameters) = (self.variances.len(), change.len());
        let (r, z) = self.information.to_triangle();
        // R_ss s = z - R_sd d, beside what was known of offsets before any data.
        let mut of_offsets = DMatrix::zeros(2 * session, session + parameters + 1);
        for i in 0..session {
            for j in i..session + parameters {
                of_offsets[(i, j)] = r[(i, j)];
            }
            of_offsets[(i, session + parameters)] = z[i];
            of_offsets[(session + i, i)] = 1.0 / UNKNOWN_OFFSET[i % 6];
        }
        let qr = of_offsets.columns(0, session).into_owned().qr();
        qr.q_tr_mul(&mut of_offsets);
        let triangle = qr.r();
        let mut solved = of_offsets.view((0, session), (session, parameters + 1)).into_owned();
        let _ = triangle.solve_upper_triangular_mut(&mut solved);
        let slope = solved.columns(0, parameters);
        let offsets = solved.column(parameters) - slope * DVector::from_column_slice(change);
        solution.estimate.clone_from(&self.estimate);
        solution.spread.clone_from(&self.spread);
        // [d | s]: what is uncertain of d is, by the slope, of s.
        let own = root.nrows();
        let mut joint = DMatrix::zeros(own + session, parameters + session);
        joint.view_mut((0, 0), (own, parameters)).copy_from(root);
        joint
            .view_mut((0, parameters), (own, session))
            .copy_from(&(root * slope.transpose() * -1.0));
        let inverse = triangle
            .try_inverse()
            .unwrap_or_else(|| DMatrix::from_element(session, session, f64::INFINITY));
        joint
            .view_mut((own, parameters), (session, session))
            .copy_from(&inverse.transpose());
        solution.root = joint;
        (solution.tau, solution.effective) = (*tau, *effective);
        solution.bodies.clone_from(bodies);
        for (to, rates) in solution.drift.iter_mut().zip(self.wander.chunks_exact(6)) {
            to.copy_from_slice(rates);
        }
        for (to, six) in solution.noise.iter_mut().zip(self.channels.chunks_exact(6)) {
            *to = std::array::from_fn(|i| six[i].reading());
        }
        for (place, offset) in solution.offsets.iter_mut().enumerate() {
            let six = |i: usize| self.reference[6 * place + i] + offsets[6 * place + i];
            *offset = Wrench::from_torque_first(std::array::from_fn(six));
        }
    }

    /// The channels' noise, from the second's rows and what was known before: whitened residuals back to channels (Gauss, Markov).
    fn take_noise(&mut self) {
        let (session, unknowns) = (self.variances.len(), self.information.unknowns());
        if self.estimate.len() != unknowns || self.newest.root.ncols() + session != unknowns {
            return;
        }
        let rows = [&self.learnt, &self.aside];
        let Some(span) = Span::of(rows.into_iter()) else {
            return;
        };
        let instants = span.count;
        let (series, shown) = self.series(&rows, &span, &self.estimate);
        let mut sensitivities = self.sensitivities(&rows);
        let counts: Vec<f64> = (series.chunks_exact(instants))
            .map(|own| own.iter().filter(|x| x.is_finite()).count() as f64)
            .collect();
        // Where rows mix channels, the most likely noise of each varies less than its noise, by a share that is known.
        let shares: Vec<f64> = (shown.iter().zip(&counts))
            .map(|(shown, count)| (shown / count).clamp(LEAST_SHARE, 1.0))
            .collect();
        for ((mut column, count), share) in sensitivities.column_iter_mut().zip(&counts).zip(&shares) {
            column /= count.max(1.0) * share.sqrt();
        }
        // What is wrong of the bodies is, as long as the robot is as it was in the second before, a part of the offset. What a change of posture makes of it: |U (s - s')|.
        let bodies = &self.estimate[session..];
        let before = match self.before.take() {
            Some((before, others)) => {
                let change = DVector::from_fn(bodies.len(), |i, _| bodies[i] - others[i]);
                let shifts = before.tr_mul(&change);
                self.channels
                    .iter_mut()
                    .zip(&shifts)
                    .for_each(|(own, shift)| own.shift(-shift));
                before
            }
            None => sensitivities.clone(),
        };
        let of_bodies = &self.newest.root * (&sensitivities - before);
        self.before = Some((sensitivities, bodies.to_vec()));
        for (channel, own) in self.channels.iter_mut().enumerate() {
            // An offset that has jumped has not wandered there.
            if self.change.is_some() {
                own.interrupt();
            }
            let seen = || {
                series[channel * instants..][..instants]
                    .iter()
                    .filter(|x| x.is_finite())
            };
            let (count, share) = (counts[channel], shares[channel]);
            if count > 0.0 {
                let mean = seen().sum::<f64>() / count;
                own.take(&Second {
                    t: (span.first as f64 + 0.5 * span.count as f64) * self.period,
                    mean: self.estimate[channel] + mean / share.sqrt(),
                    count,
                    of_bodies: of_bodies.column(channel).norm_squared(),
                    scatter: seen().map(|x| (x - mean) * (x - mean)).sum::<f64>() / (count * share),
                    is_moving: self.is_moving,
                });
            }
            (self.variances[channel], self.wander[channel]) = own.noise();
        }
    }

    /// Whitened residuals back to channels (Gauss, Markov): per channel and instant its share of what these unknowns leave, NaN where no row has it. And per channel, of one unit of
    /// its own noise, how much of that shows, summed over instants.
    fn series(&self, rows: &[&Rows], span: &Span, unknowns: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let session = self.variances.len();
        let (mut series, mut shown) = (vec![f64::NAN; session * span.count], vec![0.0; session]);
        for rows in rows {
            for (kind, rows) in self.kinds.iter().zip(rows.iter()) {
                for (row, right, slot) in rows.iter() {
                    let residual = kind.left(row, right, unknowns);
                    let Some(instant) = span.place(slot) else { continue };
                    for (value, &channel) in row.iter().zip(&kind.columns[..kind.offsets]) {
                        if *value != 0.0 {
                            let weight = self.whitened[channel] * value;
                            let sum = &mut series[channel * span.count + instant];
                            *sum = if sum.is_nan() { 0.0 } else { *sum } + weight * residual;
                            shown[channel] += weight * value;
                        }
                    }
                }
            }
        }
        (series, shown)
    }

    /// How each channel's share, summed over instants, hangs on the bodies: its column of rows^T x weights.
    fn sensitivities(&self, rows: &[&Rows]) -> DMatrix<f64> {
        let (session, unknowns) = (self.variances.len(), self.information.unknowns());
        let mut sensitivities = DMatrix::zeros(unknowns - session, session);
        for rows in rows {
            for (kind, rows) in self.kinds.iter().zip(rows.iter()) {
                let (width, count) = (kind.columns.len() + 1, rows.slots().len());
                let all = DMatrixView::from_slice(rows.values(), width, count);
                let weights = DMatrix::from_fn(count, kind.offsets, |row, place| {
                    self.whitened[kind.columns[place]] * all[(place, row)]
                });
                let own = all * &weights;
                for (place, column) in own.column_iter().enumerate() {
                    let bodies = kind.columns.iter().zip(column.iter()).skip(kind.offsets);
                    bodies.for_each(|(at, value)| sensitivities[(at - session, kind.columns[place])] += value);
                }
            }
        }
        sensitivities
    }

    /// Asks the rows that were put aside what they are: offsets of sensors that have tilted, or another load, start afresh, if that explains them.
    ///
    /// A push explains whatever is read, so nothing else can be preferred to it but what is as good in many postures. And it harms least: nothing is learnt from it.
    fn weigh_change(&mut self, prior: &Prior) -> Result<(), PriorError> {
        if !self.is_suspected {
            self.put_aside.clear();
            self.asked = 0.0;
            return Ok(());
        }
        // Under a declared contact, or without a sensor, nothing is put aside: that time says nothing.
        if self.aside.is_empty() {
            return Ok(());
        }
        let unknowns = self.information.unknowns();
        let (mut panel, mut dense) = (Panel::new(unknowns, self.aside.len()), vec![0.0; unknowns]);
        for (kind, rows) in self.kinds.iter().zip(self.aside.iter()) {
            for (row, right, _) in rows.iter() {
                spread(kind, row, &mut dense);
                let _ = panel.push_row(&dense, right);
            }
        }
        let _ = self.put_aside.absorb(&mut panel);
        self.asked += SOLVE.seconds();
        let tilted: Vec<usize> = (self.cosines.iter().enumerate())
            .filter(|(_, cosine)| **cosine < TILTED)
            .flat_map(|(place, _)| 6 * place..6 * place + 6)
            .collect();
        if self.asked < PERSISTENT || tilted.is_empty() {
            return Ok(());
        }
        let all: Vec<usize> = (0..unknowns).collect();
        let (mut best, mut least) = (None, EXPLAINED * self.put_aside.rows() as f64);
        for (change, columns) in [(Change::Offset, &tilted), (Change::Load, &self.outermost)] {
            let mut fresh = self.information.clone();
            if columns.is_empty() || fresh.marginalise(columns).is_err() {
                continue;
            }
            let before = self.misfit(prior, &fresh)?;
            let _ = fresh.merge(&self.put_aside, &all);
            let left = self.misfit(prior, &fresh)? - before;
            if left < least {
                (best, least) = (Some((change, fresh)), left);
            }
        }
        if let Some((change, information)) = best {
            // What is in force knows nothing of the load; of offsets it says nothing.
            self.is_replaced = change == Change::Load;
            self.change = Some((change, information));
        }
        // A load that is being taken up is explained by nothing, but once it is, it is: what is not explained is asked anew with new rows.
        self.put_aside.clear();
        self.asked = 0.0;
        Ok(())
    }

    /// What the most probable bodies leave of these data, squared, and twice what they cost by the prior.
    fn misfit(&self, prior: &Prior, information: &Information) -> Result<f64, PriorError> {
        let fit = self.posterior(prior, information)?.fit(self.tau)?;
        Ok(fit.residual_square + information.residual_square() + fit.divergence / (fit.tau * fit.tau))
    }

    /// Data beside the prior, over `[d | s]`.
    fn posterior(&self, prior: &Prior, information: &Information) -> Result<Posterior, PriorError> {
        let (session, parameters) = (6 * self.sensors.len(), WIDTH * self.links.len());
        let (root, right) = information.to_triangle();
        // [s | d] -> [d | s]
        let order: Vec<usize> = (session..session + parameters).chain(0..session).collect();
        let precision: Vec<f64> = (0..session).map(|i| UNKNOWN_OFFSET[i % 6].powi(-2)).collect();
        Posterior::new(prior, &self.links, &root.select_columns(&order), &right, &precision)
    }
}

/// Of channels with these stated deviations.
fn channels(stated: &[f64], period: f64) -> Vec<Channel> {
    stated.iter().map(|sigma| Channel::new(sigma * sigma, period)).collect()
}

/// A snapshot of what was taken in, to be solved wherever there is time. Pure: what it finds depends on what it was given alone.
#[derive(Debug)]
pub struct Job {
    prior: Arc<Prior>,
    data: Nanos,
    parts: Vec<Part>,
    solution: Solution,
}

impl Job {
    /// Solves: prior with its weight by evidence, bodies that can exist, covariance, noise, changes. Takes a millisecond or two for each limb by itself, a tenth of a second for 426 unknowns
    /// that hang together, longer where bodies have moved far, and allocates.
    pub fn run(&mut self) {
        self.solution.data = self.data;
        for (part, solution) in self.parts.iter_mut().zip(&mut self.solution.components) {
            part.run(&self.prior, self.data, solution);
        }
    }

    /// What it found.
    pub fn solution(&self) -> &Solution {
        &self.solution
    }

    /// For each component why it was not solved, if it was not: what was known before stays in force.
    pub fn failures(&self) -> impl Iterator<Item = Option<&PriorError>> {
        self.parts.iter().map(|part| part.failure.as_ref())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dynamics::{FrameMotion, JointState, Noise, SensorCut};
    use crate::identify::normals;
    use crate::model::{MeasurementDirection, MeasurementFrame};
    use crate::spatial::Pose;
    use std::fmt::Write as _;

    /// A trunk of four links and four limbs of as many behind a sensor each; the first limb ends in a foot behind another sensor.
    fn robot() -> (Model, Vec<String>) {
        let (mut text, mut sensors, mut links) = (String::from("<robot name=\"r\">"), Vec::new(), 0);
        let mut link = |parent: Option<usize>, is_sensor: bool| {
            let _ = write!(
                text,
                "<link name=\"l{links}\"><inertial><origin xyz=\"0.01 0.02 0.05\"/><mass value=\"1\"/>\
                 <inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" iyy=\"0.012\" iyz=\"0\" izz=\"0.015\"/></inertial></link>"
            );
            if let Some(parent) = parent {
                let kind = if is_sensor { "fixed" } else { "continuous" };
                let axis = ["1 0 0", "0 1 0", "0 0 1"][links % 3];
                let _ = write!(
                    text,
                    "<joint name=\"j{links}\" type=\"{kind}\"><parent link=\"l{parent}\"/><child link=\"l{links}\"/>\
                     <origin xyz=\"0.05 0.02 0.1\" rpy=\"0.3 {parent} 0\"/><axis xyz=\"{axis}\"/></joint>"
                );
                if is_sensor {
                    sensors.push(format!("j{links}"));
                }
            }
            links += 1;
            links - 1
        };
        let trunk = (0..4).fold(None, |parent, _| Some(link(parent, false)));
        for limb in 0..4 {
            let end = (0..4).fold(trunk, |parent, place| Some(link(parent, place == 0)));
            if limb == 0 {
                link(end, true);
            }
        }
        let text = text + "</robot>";
        let keep: Vec<&str> = sensors.iter().map(String::as_str).collect();
        let model = Model::from_urdf(&text, &keep).unwrap();
        (model, sensors)
    }

    fn structure(model: &Model, sensors: &[String]) -> Structure {
        let noise = Noise {
            force: [0.1, 0.2, 0.3],
            torque: [0.01, 0.02, 0.03],
        };
        let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
        let cuts: Vec<SensorCut> = (sensors.iter())
            .map(|joint| SensorCut::new(model, joint, frame, direction, &Pose::identity(), &noise).unwrap())
            .collect();
        Structure::new(model, &cuts, &[], Structure::LENGTH_SCALE).unwrap()
    }

    fn online(model: &Model, structure: &Structure) -> Online {
        let offsets = vec![Wrench::zero(); structure.sensors().len()];
        let none = ContactSet::default();
        let period = Nanos::from_millis(10);
        Online::new(model, structure, model.inertias(), &offsets, &none, 0, period, 0.2).unwrap()
    }

    /// So many instants, ten milliseconds apart, of a robot thrown about, with readings that go with nothing.
    fn observe(model: &Model, count: usize, instants: i64, online: &mut [&mut Online]) {
        let mut kinematics = Kinematics::new(model, 0).unwrap();
        let dofs = model.dof_count();
        let (joints, fine) = (vec![Reason::None; dofs], vec![Reason::None; count]);
        for instant in 0..instants {
            let numbers = normals(instant as u64, 3 * dofs + 6 * count + 9);
            let (of_joints, rest) = numbers.split_at(3 * dofs);
            let [position, velocity, acceleration] = [0, 1, 2].map(|m| &of_joints[m * dofs..(m + 1) * dofs]);
            let state = JointState {
                position,
                velocity,
                acceleration,
            };
            let motion = FrameMotion {
                angular_velocity: Vec3::new(rest[0], rest[1], rest[2]),
                angular_acceleration: Vec3::new(rest[3], rest[4], rest[5]),
                proper_acceleration: Vec3::new(rest[6], rest[7], 9.81 + rest[8]),
            };
            kinematics.update(model, state, &motion).unwrap();
            let six = |six: &[f64]| Wrench::from_parts([six[0], six[1], six[2]], [six[3], six[4], six[5]]);
            let readings: Vec<Wrench> = rest[9..].chunks_exact(6).map(six).collect();
            for online in &mut *online {
                let observation = Observation {
                    t: Nanos::from_millis(10 * instant),
                    kinematics: &kinematics,
                    readings: &readings,
                    active: &ContactSet::default(),
                    base: Reason::None,
                    joints: &joints,
                    moved: &DofSet::default(),
                    is_base_moved: true,
                    sensors: &fine,
                };
                online.observe(&observation).unwrap();
            }
        }
    }

    /// An offset that may have wandered since the data that is known is not odd.
    #[test]
    fn what_offsets_may_have_wandered_is_not_odd() {
        let (model, sensors) = robot();
        let mut online = online(&model, &structure(&model, &sensors));
        let mut known = online.job.as_ref().unwrap().solution.components[0].clone();
        observe(&model, sensors.len(), 1, &mut [&mut online]);
        let component = &mut online.components[0];
        // What explains the instant, but for an offset.
        let (unknowns, mut a, mut y) = (component.kinds.unknowns(), Vec::new(), Vec::new());
        for (kind, rows) in component.kinds.iter().zip(component.gathered.iter()) {
            for row in rows.values().chunks_exact(kind.columns.len() + 1) {
                let mut whole = vec![0.0; unknowns];
                for (&column, value) in kind.columns.iter().zip(row) {
                    whole[column] = *value;
                }
                a.extend(whole);
                y.push(row[kind.columns.len()]);
            }
        }
        let a = DMatrix::from_row_slice(y.len(), unknowns, &a);
        let explains = a.svd(true, true).solve(&DVector::from_vec(y), 1e-12).unwrap();
        known.estimate = explains.as_slice().to_vec();
        known.spread = DMatrix::zeros(unknowns, unknowns);
        component.wander.fill(1e5);
        let now = Nanos::from_seconds(100.0);
        for (offset, since, is_odd) in [
            (0.0, 0.0, false),
            (1e5, 0.0, true),
            (1e5, 100.0, false),
            (3e7, 100.0, true),
        ] {
            known.estimate[3] = explains[3] + offset;
            known.data = Nanos::from_seconds(100.0 - since);
            assert_eq!(component.is_odd(&known, now), is_odd, "{offset} N after {since} s");
        }
    }

    /// The covariance of a mixture is that of its definition.
    #[test]
    fn between_two_sets_is_their_mixture() {
        let set = |seed: u64| Parameters {
            change: normals(seed, 3),
            root: DMatrix::from_vec(4, 3, normals(seed + 1, 12)),
            bodies: Vec::new(),
            tau: 1.0,
            effective: 1.0,
        };
        let (first, second) = (set(1), set(3));
        let [a, b] = [&first, &second].map(|set| DVector::from_column_slice(&set.change));
        for share in [0.0, 0.3, 1.0] {
            let mixed = Parameters::between(&first, &second, share).unwrap();
            let [p, p1, p2] = [&mixed, &first, &second].map(|set| set.root.tr_mul(&set.root));
            let apart = (&b - &a) * (&b - &a).transpose() * (share * (1.0 - share));
            assert!((p - p1 * (1.0 - share) - p2 * share - apart).amax() < 1e-12, "{share}");
            let mean = &a * (1.0 - share) + &b * share;
            assert!((DVector::from_vec(mixed.change) - mean).amax() < 1e-12, "{share}");
        }
    }

    /// What can not be solved is told, with what was known before in force; and that it is over.
    #[test]
    fn a_failure_is_told_until_it_is_over() {
        let (model, sensors) = robot();
        let mut job = online(&model, &structure(&model, &sensors)).job.unwrap();
        let good = job.solution.components[0].clone();
        for (tau, text) in [(f64::NAN, Some("the weight tau is NaN")), (1.0, None)] {
            job.parts[0].tau = tau;
            job.run();
            let told: Vec<Option<String>> = job.failures().map(|f| f.map(ToString::to_string)).collect();
            let [told] = told.try_into().unwrap();
            let begins = |told: &String| text.is_some_and(|text| told.starts_with(text));
            assert!(told.as_ref().map_or(text.is_none(), begins), "{told:?}");
            let own = &job.solution.components[0];
            assert_eq!(
                (own.is_accepted, own.estimate == good.estimate),
                (text.is_none(), text.is_some())
            );
        }
    }

    /// Limb by limb or all together, the same is known; and limbs' rows do go limb by limb.
    #[test]
    fn limbs_tell_the_same_by_themselves() {
        let (model, sensors) = robot();
        let structure = structure(&model, &sensors);
        let [mut apart, mut together] = [(); 2].map(|()| online(&model, &structure));
        assert_eq!((apart.components.len(), apart.components[0].limbs.len()), (1, 5));
        together.components[0].limbs.clear();
        observe(&model, sensors.len(), 260, &mut [&mut apart, &mut together]);
        // Thirty of 36 rows of an instant, of those since the last full second.
        let component = &mut apart.components[0];
        let by_limbs: u64 = component.limbs.iter().map(|limb| limb.information.rows()).sum();
        let (all, rows) = (together.components[0].information.rows(), component.information.rows());
        assert!(
            by_limbs > 0 && by_limbs + rows == all && by_limbs.is_multiple_of(30),
            "{by_limbs} of {all}"
        );
        component.join();
        assert!(component.limbs.iter().all(|limb| limb.information.rows() == 0));
        let (found, expected) = (&component.information, &together.components[0].information);
        assert_eq!(found.rows(), expected.rows());
        let square = |information: &Information| {
            let (r, z) = information.to_triangle();
            (r.transpose() * &r, r.transpose() * &z)
        };
        let ((a, b), (c, d)) = (square(found), square(expected));
        assert!((&a - &c).norm() < 1e-12 * c.norm() && (b - &d).norm() < 1e-12 * d.norm());
        // Where rows tell nothing of a direction, what stands beside it on the right is what nothing explains.
        let unexplained = |information: &Information| {
            let (_, z) = information.to_triangle();
            z.norm_squared() + information.residual_square()
        };
        let (found, expected) = (unexplained(found), unexplained(expected));
        assert!((found - expected).abs() < 1e-10 * expected);
    }
}
