//! One component in the real-time loop: rows of each observation, blocks, the gate, information.

use crate::arithmetic::{add_multiple, dot, factorise, forward};
use crate::linear::information::{Information, Panel};
use crate::linear::simd::{self, VECTORS};
use crate::online::noise_tracker::NoiseTracker;
use crate::online::rows::{RowBuffer, SubtreeColumns, WhitenedRows, expand, most_rows, row_kinds};
use crate::online::solution::{
    BLOCK, ComponentSolution, DetectedChange, ObservationCounts, OnlineObservation, Paused,
};
use crate::robot::{ChannelRole, Robot, dofs_between, stated_noise};
use crate::statistics::chi_square;
use nalgebra::DMatrix;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::regressor::StackedRegressor;
use proprio_dynamics::spatial::{RigidInertia, Vec3, Wrench};
use proprio_dynamics::{ContactSet, DofSet};
use proprio_topics::{Nanos, Reason};
use pulp::{Arch, Simd, WithSimd};
use std::sync::Arc;

/// Number of unknowns from which a component gathers separately the rows about at most half of
/// them.
pub(crate) const LARGE: usize = 150;

/// Interval of merging these into the component's information [s].
pub(crate) const GATHERED: f64 = 1.0;

/// The gate's level, in standard deviations of a normal distribution: one false alarm in millions
/// of independent blocks.
pub(crate) const GATE: f64 = 5.0;

/// Number of clean blocks that end a disturbance.
pub(crate) const CLEAN: u32 = 3;

/// Half of the memory that is kept for jobs \[B\]; glibc follows up to 32 MiB.
pub(crate) const KEPT: usize = 24 << 20;

/// Information about some of a component's unknowns only.
#[derive(Clone, Debug)]
pub(crate) struct Limb {
    pub(crate) columns: Vec<usize>,
    pub(crate) information: Information,
    pub(crate) panel: Panel,
}

impl Limb {
    pub(crate) fn new(columns: Vec<usize>, rows: usize) -> Self {
        Self {
            information: Information::new(columns.len()),
            panel: Panel::new(columns.len(), rows),
            columns,
        }
    }
}

/// What a component is about. It does not change.
#[derive(Debug)]
pub(crate) struct ComponentLayout {
    pub(crate) subtrees: Vec<usize>,
    pub(crate) links: Vec<usize>,
    pub(crate) sensors: Vec<usize>,
    /// Joints whose motion its rows depend on, by the link where kinematics start.
    dofs: Vec<DofSet>,
    /// Contacts on its links that come and go.
    pub(crate) intermittent: ContactSet,
    /// CAD and configured offsets, `[s | d]`.
    pub(crate) reference: Vec<f64>,
    /// The kinds of its rows.
    pub(crate) kinds: Vec<SubtreeColumns>,
    /// Columns of the links at the ends of its limbs.
    pub(crate) outermost: Vec<usize>,
    /// The links that carry the sensors.
    carriers: Vec<usize>,
    /// The configured standard deviations of the channels.
    pub(crate) deviations: Vec<f64>,
}

/// Sub-trees that are linked by sensors, and the information about them.
#[derive(Clone, Debug)]
pub(crate) struct Component {
    pub(crate) layout: Arc<ComponentLayout>,
    pub(crate) information: Information,
    pub(crate) panel: Panel,
    /// Per kind of rows, for a large component: the limb that takes them, if any, with its
    /// information since the last merge.
    pub(crate) limbs: Vec<Option<Limb>>,
    /// Time of drift that the information does not include yet, and its limit [s].
    pub(crate) drift_time: f64,
    pub(crate) drift_interval: f64,
    pub(crate) variances: Vec<f64>,
    /// The variances with which the rows for the next job are whitened.
    pub(crate) row_variances: Vec<f64>,
    /// Standard deviations of the offsets' drift in a second.
    pub(crate) drift_std: Vec<f64>,
    /// Columns of the offsets.
    pub(crate) offsets: Vec<usize>,
    /// Work space for the standard deviations of one drift step.
    pub(crate) deviations: Vec<f64>,
    pub(crate) gathered: RowBuffer,
    pub(crate) pending: RowBuffer,
    /// For the next job: absorbed rows, rejected rows.
    pub(crate) accepted_rows: RowBuffer,
    pub(crate) rejected_rows: RowBuffer,
    pub(crate) block_from: Nanos,
    pub(crate) last_drift: Nanos,
    pub(crate) active: ContactSet,
    pub(crate) is_disturbed: bool,
    /// Whether a second block failed the gate, too.
    pub(crate) is_persistent: bool,
    pub(crate) clean: u32,
    /// The direction of the proper acceleration of each sensor's carrier when the present
    /// disturbance began; the least cosine to it since.
    pub(crate) directions: Vec<Vec3>,
    pub(crate) cosines: Vec<f64>,
    /// Whether the solution in use may judge rows.
    pub(crate) may_judge: bool,
    /// A sensor has a new zero: nothing is observed before the next job, which begins without it.
    pub(crate) waits: bool,
    /// Whether the solution in use is from before that job.
    pub(crate) is_outdated: bool,
    pub(crate) paused: Paused,
    /// The last instant without a fault.
    last_seen: Nanos,
    pub(crate) last_change: Option<DetectedChange>,
    pub(crate) counts: ObservationCounts,
    /// Amount of absorbed data: seconds in motion, rows.
    pub(crate) seconds_in_motion: f64,
    pub(crate) rows: u64,
    /// The rows of the present observation.
    pub(crate) current_rows: WhitenedRows,
    pub(crate) row: Vec<f64>,
    pub(crate) scratch: GateBuffers,
}

impl ComponentLayout {
    pub(crate) fn new(
        robot: &Robot,
        stacked: &StackedRegressor,
        mut subtrees: Vec<usize>,
        offsets: &[Wrench],
    ) -> Self {
        let (model, structure) = (&robot.model, stacked.structure());
        let mut links: Vec<usize> = subtrees
            .iter()
            .flat_map(|&k| structure.links_of(k))
            .collect();
        let mut sensors: Vec<usize> = subtrees
            .iter()
            .flat_map(|&k| stacked.subtrees()[k].sensors())
            .collect();
        for list in [&mut links, &mut sensors] {
            list.sort_unstable();
            list.dedup();
        }
        let unknowns = 6 * sensors.len() + LINK_PARAMETERS * links.len();
        if unknowns >= LARGE {
            // Whitened rows also have the unknowns of earlier rows, so the trunk's come last.
            let subtree = |k: usize| &stacked.subtrees()[k];
            subtrees.sort_by_key(|&k| (subtree(k).sensors().len(), subtree(k).links().len()));
        }
        let dofs = |base: usize| dofs_between(model, base, &links).collect();
        let has_child = |link: &usize| model.joints().iter().any(|joint| joint.parent == *link);
        let outermost = (links
            .iter()
            .zip((6 * sensors.len()..).step_by(LINK_PARAMETERS)))
        .filter(|(link, _)| !has_child(link))
        .flat_map(|(_, first)| first..first + LINK_PARAMETERS);
        let of_sensors = sensors.iter().flat_map(|&s| offsets[s].torque_first());
        let of_links = (links.iter()).flat_map(|&link| model.inertias()[link].parameters());
        let cuts = structure.sensors();
        let deviations = sensors.iter().flat_map(|&s| stated_noise(&cuts[s]));
        let contacts = subtrees.iter().map(|&k| &structure.subtrees()[k].contacts);
        Self {
            dofs: (0..model.link_count()).map(dofs).collect(),
            intermittent: contacts
                .fold(ContactSet::default(), |all, own| all.union(own))
                .difference(&robot.always),
            reference: of_sensors.chain(of_links).collect(),
            kinds: row_kinds(stacked, &subtrees, &sensors, &links),
            outermost: outermost.collect(),
            carriers: sensors.iter().map(|&s| cuts[s].joint() + 1).collect(),
            deviations: deviations.collect(),
            subtrees,
            links,
            sensors,
        }
    }

    /// Number of offsets, `s`.
    pub(crate) fn offset_count(&self) -> usize {
        6 * self.sensors.len()
    }

    /// Number of the links' parameters, `d`.
    pub(crate) fn parameters(&self) -> usize {
        LINK_PARAMETERS * self.links.len()
    }

    /// Estimators of the noise of each channel.
    pub(crate) fn trackers(&self, period: f64) -> Vec<NoiseTracker> {
        let stated = self.deviations.iter();
        stated
            .map(|sigma| NoiseTracker::new(sigma * sigma, period))
            .collect()
    }
}

impl Component {
    /// With room for this many observations per job and per block.
    pub(crate) fn new(
        layout: ComponentLayout,
        per_job: usize,
        per_block: usize,
        period: f64,
    ) -> Self {
        let (kinds, unknowns) = (&layout.kinds, layout.reference.len());
        let (offset_count, most) = (layout.offset_count(), most_rows(kinds));
        let limb = |own: &SubtreeColumns| {
            let is_limb = unknowns >= LARGE && 2 * own.columns.len() <= unknowns;
            is_limb.then(|| Limb::new(own.columns.clone(), 6 * per_block))
        };
        let limbs: Vec<Option<Limb>> = kinds.iter().map(limb).collect();
        let noise: Vec<(f64, f64)> = (layout.trackers(period).iter())
            .map(NoiseTracker::noise)
            .collect();
        let variances: Vec<f64> = noise.iter().map(|(variance, _)| *variance).collect();
        Self {
            drift_interval: if limbs.iter().any(Option::is_some) {
                GATHERED
            } else {
                0.0
            },
            drift_time: 0.0,
            limbs,
            information: Information::new(unknowns),
            panel: Panel::new(unknowns, most * per_block),
            row_variances: variances.clone(),
            variances,
            drift_std: noise.iter().map(|(_, rate)| *rate).collect(),
            offsets: (0..offset_count).collect(),
            deviations: vec![0.0; offset_count],
            gathered: RowBuffer::new(kinds, per_block),
            pending: RowBuffer::new(kinds, per_block),
            accepted_rows: RowBuffer::new(kinds, per_job),
            rejected_rows: RowBuffer::new(kinds, per_job),
            block_from: Nanos::MIN,
            last_drift: Nanos::MIN,
            active: ContactSet::default(),
            is_disturbed: false,
            is_persistent: false,
            clean: 0,
            directions: vec![Vec3::zeros(); layout.sensors.len()],
            cosines: vec![1.0; layout.sensors.len()],
            may_judge: false,
            waits: false,
            is_outdated: false,
            paused: Paused::No,
            last_seen: Nanos::ZERO,
            last_change: None,
            counts: ObservationCounts::default(),
            seconds_in_motion: 0.0,
            rows: 0,
            current_rows: WhitenedRows::new(kinds, offset_count),
            row: vec![0.0; unknowns],
            scratch: GateBuffers {
                covariance: vec![0.0; most * most],
                mean: vec![0.0; unknowns + 1],
                projected: vec![0.0; most * (unknowns + offset_count)],
                innovations: vec![0.0; most],
            },
            layout: Arc::new(layout),
        }
    }

    /// The initial solution: CAD, and these offsets.
    pub(crate) fn unknown(&self, cad: &[RigidInertia], offsets: &[Wrench]) -> ComponentSolution {
        let (links, sensors) = (&self.layout.links, &self.layout.sensors);
        let noise = self.layout.deviations.chunks_exact(6);
        let square = |six: &[f64]| std::array::from_fn(|i| six[i] * six[i]);
        let drift = self.drift_std.chunks_exact(6);
        ComponentSolution {
            links: links.clone(),
            bodies: links.iter().map(|&link| cad[link]).collect(),
            sensors: sensors.clone(),
            offsets: sensors.iter().map(|&sensor| offsets[sensor]).collect(),
            root: DMatrix::zeros(0, self.layout.reference.len()),
            drift_std: drift.map(|six| std::array::from_fn(|i| six[i])).collect(),
            noise: noise.map(square).collect(),
            worst: vec![[0.0; 6]; sensors.len()],
            tau: f64::NAN,
            ..ComponentSolution::default()
        }
    }

    /// Forgets the offset of the sensor at this place, and keeps what is known of all else.
    pub(crate) fn forget_offset(&mut self, place: usize) {
        self.join();
        let columns: [usize; 6] = std::array::from_fn(|axis| 6 * place + axis);
        // The columns exist.
        let _ = self.information.marginalise(&columns);
        self.gathered.clear();
        self.pending.clear();
        (self.waits, self.is_outdated, self.may_judge) = (true, true, false);
        (self.is_disturbed, self.is_persistent) = (false, false);
        self.paused = Paused::No;
        // A contact may be there since: that is to be seen by another motion.
        (self.seconds_in_motion, self.rows) = (0.0, 0);
        self.last_change = Some(DetectedChange::Offset);
        self.counts.changes += 1;
        self.counts.offset_changes += 1;
    }

    pub(crate) fn observe(
        &mut self,
        observation: &OnlineObservation<'_>,
        stacked: &StackedRegressor,
        known: &ComponentSolution,
        slot: i64,
    ) {
        let t = observation.t;
        if self.waits {
            (self.block_from, self.last_drift) = (t, t);
            return;
        }
        if self.block_from == Nanos::MIN {
            (self.block_from, self.last_drift) = (t, t);
        }
        let intermittent = self.layout.intermittent.intersection(observation.active);
        if intermittent != self.active {
            // A declaration may be a little late, and its end a little early.
            self.counts.contact += self.gathered.observations() + self.pending.observations();
            self.gathered.clear();
            self.pending.clear();
            self.active = intermittent;
            (self.block_from, self.last_drift) = (t, t);
        }
        if t - self.block_from >= BLOCK {
            self.close(t, known);
            self.block_from = t;
        }
        if let Some((reason, channel)) = self.fault(observation) {
            // A doubtful reading, or a few, are no pause.
            if reason != Reason::Implausible || t - self.last_seen >= BLOCK {
                self.paused = Paused::Fault(reason, channel);
            }
            let counts = &mut self.counts;
            *match reason {
                Reason::Stale => &mut counts.stale,
                Reason::Saturated => &mut counts.saturated,
                Reason::DeviceFault | Reason::Frozen | Reason::Implausible => {
                    &mut counts.device_fault
                }
                _ => &mut counts.unseen,
            } += 1;
            return;
        }
        self.last_seen = t;
        let (kinds, reference) = (&self.layout.kinds, &self.layout.reference);
        let made = (self.current_rows).make(kinds, stacked, reference, &self.variances);
        if made == 0 {
            self.paused = Paused::Contact;
            self.counts.contact += 1;
            return;
        }
        self.paused = Paused::No;
        if self.is_disturbed {
            self.paused = Paused::Suspected;
            self.follow_tilt(observation);
        }
        self.gathered.push(slot, &self.current_rows);
        self.gathered.has_moved |= self.is_moved(observation);
    }

    /// The first fault of a channel that it needs.
    fn fault(&self, observation: &OnlineObservation<'_>) -> Option<(Reason, ChannelRole)> {
        let of_sensors = (self.layout.sensors.iter())
            .filter_map(|&s| Some((*observation.sensors.get(s)?, ChannelRole::Sensor(s))));
        let base = observation.kinematics.base();
        let of_joints = (self.layout.dofs[base].iter())
            .filter_map(|dof| Some((*observation.joints.get(dof)?, ChannelRole::Joint(dof))));
        let mut faults = std::iter::once((observation.base, ChannelRole::Base))
            .chain(of_sensors)
            .chain(of_joints);
        faults.find(|(reason, _)| *reason != Reason::None)
    }

    /// Notes how far each sensor has tilted since the present disturbance began.
    fn follow_tilt(&mut self, observation: &OnlineObservation<'_>) {
        let directions = self.directions.iter_mut().zip(&mut self.cosines);
        for (&link, (began, cosine)) in self.layout.carriers.iter().zip(directions) {
            let acceleration = observation.kinematics.motion(link).proper_acceleration;
            let direction = acceleration / acceleration.norm().max(1e-3);
            if *began == Vec3::zeros() {
                *began = direction;
            }
            *cosine = cosine.min(direction.dot(began));
        }
    }

    /// Whether something moves that its rows depend on.
    pub(crate) fn is_moved(&self, observation: &OnlineObservation<'_>) -> bool {
        let base = observation.kinematics.base();
        observation.is_base_moved
            || !observation
                .moved
                .intersection(&self.layout.dofs[base])
                .is_empty()
    }

    /// Ends a block: gate, drift of the offsets, then rows are absorbed or rejected.
    pub(crate) fn close(&mut self, t: Nanos, known: &ComponentSolution) {
        let elapsed = (t - self.last_drift).seconds().clamp(0.0, 60.0);
        self.last_drift = t;
        if !self.gathered.is_empty() && self.may_judge && self.exceeds_gate(known, t) {
            self.is_persistent = self.is_disturbed;
            if !self.is_disturbed {
                self.is_disturbed = true;
                self.cosines.fill(1.0);
                self.directions.fill(Vec3::zeros());
            }
            self.clean = 0;
            let observations = self.pending.observations() + self.gathered.observations();
            self.count_rejected(observations);
            self.rejected_rows.take_from(&self.gathered);
            self.pending.clear();
            self.gathered.clear();
            return;
        }
        if !self.gathered.is_empty() && self.is_disturbed {
            self.clean += 1;
            if self.clean < CLEAN {
                let observations = self.gathered.observations();
                self.count_rejected(observations);
                self.gathered.clear();
                return;
            }
            self.is_disturbed = false;
        }
        if self.active.is_empty() && !self.is_disturbed {
            self.drift_time += elapsed;
        }
        if self.drift_time > 0.0 && self.drift_time >= self.drift_interval {
            self.join();
            for (to, drift_std) in self.deviations.iter_mut().zip(&self.drift_std) {
                *to = drift_std * self.drift_time.sqrt();
            }
            self.drift_time = 0.0;
            let _ = self.information.drift(&self.offsets, &self.deviations);
        }
        if !self.gathered.is_empty() {
            self.absorb();
            self.gathered.span = (t - self.block_from).seconds().min(2.0 * BLOCK.seconds());
            std::mem::swap(&mut self.pending, &mut self.gathered);
        }
    }

    /// Counts observations that fail the gate, or are too near to such.
    pub(crate) fn count_rejected(&mut self, observations: u64) {
        *if self.is_persistent {
            &mut self.counts.suspected
        } else {
            &mut self.counts.outlier
        } += observations;
    }

    /// Merges the limbs' information.
    pub(crate) fn join(&mut self) {
        for limb in self.limbs.iter_mut().flatten() {
            if limb.information.rows() > 0 {
                // The sizes match by construction.
                let (panel, row) = (&mut self.panel, &mut self.row);
                let _ = (self.information).take(&mut limb.information, &limb.columns, panel, row);
            }
        }
    }

    /// Absorbs the pending block.
    pub(crate) fn absorb(&mut self) {
        // The rows are finite, and there is room.
        let kinds = self.layout.kinds.iter().zip(&mut self.limbs);
        for ((kind, limb), rows) in kinds.zip(self.pending.iter()) {
            for (a, y, _) in rows.iter() {
                if let Some(limb) = limb {
                    let _ = limb.panel.push_row(a, y);
                } else if a.len() == self.row.len() {
                    let _ = self.panel.push_row(a, y);
                } else {
                    expand(kind, a, &mut self.row);
                    let _ = self.panel.push_row(&self.row, y);
                }
            }
        }
        let _ = self.information.absorb(&mut self.panel);
        for limb in self.limbs.iter_mut().flatten() {
            let _ = limb.information.absorb(&mut limb.panel);
        }
        let observations = self.pending.observations();
        self.counts.learnt += observations;
        if self.pending.is_moving() {
            self.seconds_in_motion += self.pending.span;
        } else {
            self.counts.still += observations;
        }
        self.rows += self.pending.len() as u64;
        self.accepted_rows.take_from(&self.pending);
        self.pending.clear();
    }

    /// Whether the mean innovation of the gathered block exceeds what noise, the uncertainty of the
    /// solution in use, and the drift of the offsets up to `t` since its data explain.
    pub(crate) fn exceeds_gate(&mut self, known: &ComponentSolution, t: Nanos) -> bool {
        let unknowns = self.layout.reference.len();
        let offset_count = self.offsets.len();
        let root_time = (t - known.data_until).seconds().max(0.0).sqrt();
        let projected_width = unknowns + offset_count;
        if known.estimate.len() != unknowns || known.covariance_root.shape() != (unknowns, unknowns)
        {
            return false;
        }
        let GateBuffers {
            mean,
            projected,
            covariance,
            innovations,
        } = &mut self.scratch;
        let mut m = 0;
        for (kind, rows) in self.layout.kinds.iter().zip(self.gathered.iter()) {
            // The observations of a block have equally many rows with the same meaning: their sum
            // over the root of their number has unit noise.
            let Some(first) = rows.slots().first() else {
                continue;
            };
            let slots = rows.slots().iter();
            let own = slots.take_while(|slot| *slot == first).count();
            let observations = rows.slots().len() / own;
            let scale = 1.0 / (observations as f64).sqrt();
            let width = kind.width();
            let mean = &mut mean[..width];
            for index in 0..own {
                mean.fill(0.0);
                let all = rows.values().chunks_exact(width);
                for row in all.skip(index).step_by(own).take(observations) {
                    add_multiple(mean, scale, row);
                }
                let (row, right) = mean.split_at(kind.columns.len());
                innovations[m] = kind.residual(row, right[0], &known.estimate);
                let (to, walk) =
                    projected[m * projected_width..][..projected_width].split_at_mut(unknowns);
                walk.fill(0.0);
                for (value, &channel) in row.iter().zip(&kind.columns[..kind.offsets]) {
                    walk[channel] = value * self.drift_std[channel] * root_time;
                }
                // U a: the columns of U are [d | s].
                Arch::new().dispatch(RootProjection {
                    root: &known.covariance_root,
                    offset_count,
                    columns: &kind.columns,
                    row,
                    to,
                });
                m += 1;
            }
        }
        for i in 0..m {
            for j in 0..=i {
                let [a, b] = [i, j].map(|k| &projected[k * projected_width..][..projected_width]);
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
pub(crate) struct RootProjection<'a> {
    pub(crate) root: &'a DMatrix<f64>,
    pub(crate) offset_count: usize,
    pub(crate) columns: &'a [usize],
    pub(crate) row: &'a [f64],
    pub(crate) to: &'a mut [f64],
}

impl WithSimd for RootProjection<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (rows, parameters) = (self.root.nrows(), self.root.ncols() - self.offset_count);
        let root = self.root.as_slice();
        self.to.fill(0.0);
        let (columns, rest) = self.columns.as_chunks::<VECTORS>();
        let (values, values_left) = self.row.as_chunks::<VECTORS>();
        for (columns, values) in columns.iter().zip(values) {
            let mut four: [&[f64]; VECTORS] = [&[]; VECTORS];
            for (own, &column) in four.iter_mut().zip(columns) {
                *own = &root[rows * reordered(column, self.offset_count, parameters)..][..rows];
            }
            simd::add_four(simd, self.to, *values, four);
        }
        for (&column, &value) in rest.iter().zip(values_left) {
            let own = &root[rows * reordered(column, self.offset_count, parameters)..][..rows];
            simd::add(simd, self.to, value, own);
        }
    }
}

/// The place of a column of `[s | d]` in `[d | s]`.
#[inline(always)]
pub(crate) fn reordered(column: usize, offset_count: usize, parameters: usize) -> usize {
    if column < offset_count {
        parameters + column
    } else {
        column - offset_count
    }
}

/// Work space of the gate.
#[derive(Clone, Debug)]
pub(crate) struct GateBuffers {
    pub(crate) covariance: Vec<f64>,
    pub(crate) mean: Vec<f64>,
    pub(crate) projected: Vec<f64>,
    pub(crate) innovations: Vec<f64>,
}
