//! One component in the real-time loop: rows of each observation, blocks, the gate, information.

use crate::arithmetic::{add_multiple, dot, factorise, forward};
use crate::linear::information::{Information, Panel};
use crate::linear::simd::{self, VECTORS};
use crate::online::channel::Channel;
use crate::online::rows::{Kinds, ObservationRows, Rows, spread};
use crate::online::solution::{BLOCK, Change, ComponentSolution, Counts, Observation, Paused};
use crate::robot::ChannelRole;
use crate::statistics::chi_square;
use nalgebra::DMatrix;
use proprio_dynamics::model::Model;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::regressor::StackedRegressor;
use proprio_dynamics::spatial::{RigidInertia, Vec3, Wrench};
use proprio_dynamics::{ContactSet, DofSet, LinkSet};
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

/// Sub-trees that are linked by sensors, and the information about them.
#[derive(Clone, Debug)]
pub(crate) struct Component {
    pub(crate) subtrees: Vec<usize>,
    pub(crate) links: Vec<usize>,
    pub(crate) sensors: Vec<usize>,
    /// Joints whose motion its rows depend on, by the link where kinematics start.
    pub(crate) dofs: Vec<DofSet>,
    /// Contacts on its links that come and go.
    pub(crate) intermittent: ContactSet,
    /// CAD and configured offsets, `[s | d]`.
    pub(crate) reference: Vec<f64>,
    pub(crate) kinds: Arc<Kinds>,
    /// Columns of the links at the ends of its limbs.
    pub(crate) outermost: Vec<usize>,
    pub(crate) information: Information,
    pub(crate) panel: Panel,
    /// For a large component, the information of its limbs since the last merge.
    pub(crate) limbs: Vec<Limb>,
    /// The limb that takes the rows of each kind, if any.
    pub(crate) limb_of: Vec<Option<usize>>,
    /// Time of drift that the information does not include yet, and its limit [s].
    pub(crate) drift_time: f64,
    pub(crate) drift_interval: f64,
    pub(crate) variances: Vec<f64>,
    /// The variances with which the rows for the next job are whitened.
    pub(crate) whitened: Vec<f64>,
    /// The configured variances.
    pub(crate) least: Vec<f64>,
    /// Standard deviations of the offsets' drift in a second.
    pub(crate) drift_rates: Vec<f64>,
    /// Columns of the offsets.
    pub(crate) offsets: Vec<usize>,
    /// Work space for the standard deviations of one drift step.
    pub(crate) deviations: Vec<f64>,
    pub(crate) gathered: Rows,
    pub(crate) pending: Rows,
    /// For the next job: absorbed rows, rejected rows.
    pub(crate) learnt: Rows,
    pub(crate) rejected_rows: Rows,
    pub(crate) block_from: Nanos,
    pub(crate) last_drift: Nanos,
    pub(crate) active: ContactSet,
    pub(crate) is_disturbed: bool,
    /// Whether a second block failed the gate, too.
    pub(crate) is_persistent: bool,
    pub(crate) clean: u32,
    /// The links that carry the sensors; the direction of the proper acceleration of each when the
    /// present disturbance began; the least cosine to it since.
    pub(crate) carriers: Vec<usize>,
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
    seen: Nanos,
    pub(crate) last_change: Option<Change>,
    pub(crate) counts: Counts,
    /// Amount of absorbed data: seconds in motion, rows.
    pub(crate) motion: f64,
    pub(crate) rows: u64,
    /// The rows of the present observation.
    pub(crate) current_rows: ObservationRows,
    pub(crate) row: Vec<f64>,
    pub(crate) scratch: Scratch,
}

impl Component {
    #[allow(clippy::too_many_arguments, reason = "one caller, which has them all")]
    pub(crate) fn new(
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
        let offset_count = 6 * sensors.len();
        let unknowns = offset_count + LINK_PARAMETERS * links.len();
        let place = |list: &[usize], of: usize| list.binary_search(&of).unwrap_or(0);
        if unknowns >= LARGE {
            // Whitened rows also have the unknowns of earlier rows, so the trunk's come last.
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
                    let first = offset_count + LINK_PARAMETERS * place(&links, link);
                    first..first + LINK_PARAMETERS
                });
                let of_sensors = subtree.sensors().flat_map(|sensor| {
                    let first = 6 * place(&sensors, sensor);
                    first..first + 6
                });
                of_links.chain(of_sensors).collect()
            })
            .collect();
        let to_root = |mut link: usize| {
            let mut above = LinkSet::default();
            while link > 0 {
                above.insert(link);
                link = model.joints()[link - 1].parent;
            }
            above
        };
        let to_root: Vec<LinkSet> = (0..model.link_count()).map(to_root).collect();
        // From a base to a link: joints on the paths of both to the root are not crossed.
        let crossed = |base: &LinkSet| -> DofSet {
            let moved = links.iter().fold(LinkSet::default(), |moved, &link| {
                let (there, back) = (
                    to_root[link].difference(base),
                    base.difference(&to_root[link]),
                );
                moved.union(&there).union(&back)
            });
            let dofs = moved.iter().filter_map(|link| model.joints()[link - 1].dof);
            dofs.collect()
        };
        let dofs = to_root.iter().map(crossed).collect();
        let parents: Vec<usize> = model.joints().iter().map(|joint| joint.parent).collect();
        let outermost = (links.iter().enumerate())
            .filter(|(_, link)| !parents.contains(link))
            .flat_map(|(place, _)| {
                offset_count + LINK_PARAMETERS * place..offset_count + LINK_PARAMETERS * (place + 1)
            })
            .collect();
        let mut reference: Vec<f64> = sensors
            .iter()
            .flat_map(|&s| offsets[s].torque_first())
            .collect();
        reference.extend(links.iter().flat_map(|&link| cad[link].parameters()));
        let noise: Vec<f64> = (sensors.iter())
            .flat_map(|&s| {
                let noise = structure.sensors()[s].noise();
                Wrench::from_parts(noise.force, noise.torque).torque_first()
            })
            .collect();
        let intermittent = (subtrees.iter())
            .fold(ContactSet::default(), |set, &k| {
                set.union(&structure.subtrees()[k].contacts)
            })
            .difference(always);
        let kinds = Arc::new(Kinds::new(
            stacked,
            &subtrees,
            &columns,
            (offset_count, unknowns),
        ));
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
            drift_interval: if limbs.is_empty() { 0.0 } else { GATHERED },
            drift_time: 0.0,
            limbs,
            limb_of,
            dofs,
            intermittent,
            reference,
            outermost,
            information: Information::new(unknowns),
            panel: Panel::new(unknowns, most * per_block),
            variances: channels.iter().map(|channel| channel.noise().0).collect(),
            least: noise.iter().map(|sigma| sigma * sigma).collect(),
            drift_rates: channels.iter().map(|channel| channel.noise().1).collect(),
            whitened: channels.iter().map(|channel| channel.noise().0).collect(),
            offsets: (0..offset_count).collect(),
            deviations: vec![0.0; offset_count],
            gathered: Rows::new(&kinds, per_block),
            pending: Rows::new(&kinds, per_block),
            learnt: Rows::new(&kinds, per_job),
            rejected_rows: Rows::new(&kinds, per_job),
            block_from: Nanos::MIN,
            last_drift: Nanos::MIN,
            active: ContactSet::default(),
            is_disturbed: false,
            is_persistent: false,
            clean: 0,
            carriers: sensors
                .iter()
                .map(|&s| structure.sensors()[s].joint() + 1)
                .collect(),
            directions: vec![Vec3::zeros(); sensors.len()],
            cosines: vec![1.0; sensors.len()],
            may_judge: false,
            waits: false,
            is_outdated: false,
            paused: Paused::No,
            seen: Nanos::ZERO,
            last_change: None,
            counts: Counts::default(),
            motion: 0.0,
            rows: 0,
            current_rows: ObservationRows::new(&kinds),
            row: vec![0.0; unknowns],
            scratch: Scratch {
                covariance: vec![0.0; most * most],
                mean: vec![0.0; unknowns + 1],
                projected: vec![0.0; most * (unknowns + offset_count)],
                innovations: vec![0.0; most],
            },
            kinds,
            subtrees,
            links,
            sensors,
        }
    }

    /// The initial solution.
    pub(crate) fn unknown(&self, cad: &[RigidInertia], offsets: &[Wrench]) -> ComponentSolution {
        ComponentSolution {
            leading: None,
            links: self.links.clone(),
            bodies: self.links.iter().map(|&link| cad[link]).collect(),
            sensors: self.sensors.clone(),
            offsets: self.sensors.iter().map(|&sensor| offsets[sensor]).collect(),
            root: DMatrix::zeros(
                0,
                LINK_PARAMETERS * self.links.len() + 6 * self.sensors.len(),
            ),
            drift: self
                .drift_rates
                .chunks_exact(6)
                .map(|six| std::array::from_fn(|i| six[i]))
                .collect(),
            noise: (self.least.chunks_exact(6))
                .map(|six| std::array::from_fn(|i| six[i]))
                .collect(),
            worst: vec![[0.0; 6]; self.sensors.len()],
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
        (self.motion, self.rows) = (0.0, 0);
        self.last_change = Some(Change::Offset);
        self.counts.changes += 1;
        self.counts.offset_changes += 1;
    }

    pub(crate) fn observe(
        &mut self,
        seen: &Observation<'_>,
        stacked: &StackedRegressor,
        known: &ComponentSolution,
        slot: i64,
    ) {
        let t = seen.t;
        if self.waits {
            (self.block_from, self.last_drift) = (t, t);
            return;
        }
        if self.block_from == Nanos::MIN {
            (self.block_from, self.last_drift) = (t, t);
        }
        let intermittent = self.intermittent.intersection(seen.active);
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
        let of_sensors = (self.sensors.iter())
            .filter_map(|&s| Some((*seen.sensors.get(s)?, ChannelRole::Sensor(s))));
        let base = seen.kinematics.base();
        let of_joints = (self.dofs[base].iter())
            .filter_map(|dof| Some((*seen.joints.get(dof)?, ChannelRole::Joint(dof))));
        let mut faults = std::iter::once((seen.base, ChannelRole::Base))
            .chain(of_sensors)
            .chain(of_joints);
        if let Some((reason, channel)) = faults.find(|(reason, _)| *reason != Reason::None) {
            // A doubtful reading, or a few, are no pause.
            if reason != Reason::Implausible || t - self.seen >= BLOCK {
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
        self.seen = t;
        let made = (self.current_rows).make(&self.kinds, stacked, &self.reference, &self.variances);
        if made == 0 {
            self.paused = Paused::Contact;
            self.counts.contact += 1;
            return;
        }
        self.paused = if self.is_disturbed {
            Paused::Suspected
        } else {
            Paused::No
        };
        if self.is_disturbed {
            let tilts = self
                .carriers
                .iter()
                .zip(&mut self.directions)
                .zip(&mut self.cosines);
            for ((&link, began), cosine) in tilts {
                let acceleration = seen.kinematics.motion(link).proper_acceleration;
                let direction = acceleration / acceleration.norm().max(1e-3);
                if *began == Vec3::zeros() {
                    *began = direction;
                }
                *cosine = cosine.min(direction.dot(began));
            }
        }
        self.gathered.push(slot, &self.current_rows);
        self.gathered.has_moved |= self.is_moved(seen);
    }

    /// Whether something moves that its rows depend on.
    pub(crate) fn is_moved(&self, seen: &Observation<'_>) -> bool {
        let base = seen.kinematics.base();
        seen.is_base_moved || !seen.moved.intersection(&self.dofs[base]).is_empty()
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
            for (to, drift_rates) in self.deviations.iter_mut().zip(&self.drift_rates) {
                *to = drift_rates * self.drift_time.sqrt();
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
        for limb in &mut self.limbs {
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
        for ((kind, rows), limb) in self
            .kinds
            .iter()
            .zip(self.pending.iter())
            .zip(&self.limb_of)
        {
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
        let observations = self.pending.observations();
        self.counts.learnt += observations;
        if self.pending.is_moving() {
            self.motion += self.pending.span;
        } else {
            self.counts.still += observations;
        }
        self.rows += self.pending.len() as u64;
        self.learnt.take_from(&self.pending);
        self.pending.clear();
    }

    /// Whether the mean innovation of the gathered block exceeds what noise, the uncertainty of the
    /// solution in use, and the drift of the offsets up to `t` since its data explain.
    pub(crate) fn exceeds_gate(&mut self, known: &ComponentSolution, t: Nanos) -> bool {
        let unknowns = self.kinds.unknowns();
        let (offset_count, root_time) = (
            self.offsets.len(),
            (t - known.data).seconds().max(0.0).sqrt(),
        );
        let projected_width = unknowns + offset_count;
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
            // The observations of a block have equally many rows with the same meaning: their sum
            // over the root of their number has unit noise.
            let Some(first) = rows.slots().first() else {
                continue;
            };
            let own = rows
                .slots()
                .iter()
                .take_while(|slot| *slot == first)
                .count();
            let observations = rows.slots().len() / own;
            let scale = 1.0 / (observations as f64).sqrt();
            let width = kind.columns.len() + 1;
            let mean = &mut mean[..width];
            for index in 0..own {
                mean.fill(0.0);
                for row in rows
                    .values()
                    .chunks_exact(width)
                    .skip(index)
                    .step_by(own)
                    .take(observations)
                {
                    add_multiple(mean, scale, row);
                }
                let (row, right) = mean.split_at(kind.columns.len());
                innovations[m] = kind.residual(row, right[0], &known.estimate);
                let (to, walk) =
                    projected[m * projected_width..][..projected_width].split_at_mut(unknowns);
                walk.fill(0.0);
                for (value, &channel) in row.iter().zip(&kind.columns[..kind.offsets]) {
                    walk[channel] = value * self.drift_rates[channel] * root_time;
                }
                // U a: the columns of U are [d | s].
                Arch::new().dispatch(Project {
                    root: &known.spread,
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
                let (a, b) = (
                    &projected[i * projected_width..],
                    &projected[j * projected_width..],
                );
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
pub(crate) struct Project<'a> {
    pub(crate) root: &'a DMatrix<f64>,
    pub(crate) offset_count: usize,
    pub(crate) columns: &'a [usize],
    pub(crate) row: &'a [f64],
    pub(crate) to: &'a mut [f64],
}

impl WithSimd for Project<'_> {
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

/// Channels with these stated deviations.
pub(crate) fn channels(stated: &[f64], period: f64) -> Vec<Channel> {
    stated
        .iter()
        .map(|sigma| Channel::new(sigma * sigma, period))
        .collect()
}

/// Work space of the gate.
#[derive(Clone, Debug)]
pub(crate) struct Scratch {
    pub(crate) covariance: Vec<f64>,
    pub(crate) mean: Vec<f64>,
    pub(crate) projected: Vec<f64>,
    pub(crate) innovations: Vec<f64>,
}
