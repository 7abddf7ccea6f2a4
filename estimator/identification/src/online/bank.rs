//! Hypotheses about what may be other than stated: an encoder reversed, a sensor turned, a contact
//! that has been there since the start. Their evidence says which of them the readings refute.
//!
//! ```text
//! ticks (ten a second) -> rows of each hypothesis -> Gram matrix -> evidence -> refuted?
//!                                                               -> torques  -> spread
//! ```
//!
//! # Evidence
//! Each hypothesis takes the readings in its own way ([`Hypothesis`]). Then the six equations of a
//! sub-tree are linear in its parameters and offsets, and, for a contact since the start, in its
//! steady force along the axes of the base. What else is estimated, a tilt of the base or an error
//! of an encoder, has columns by differences at CAD. So the evidence has a closed form
//! (`evidence.rs`).
//!
//! Ticks count in which something moves, for at rest nothing separates the hypotheses, and whose
//! rows are learnt. Residuals beyond the stated noise are a misfit, which lasts: a second of them
//! counts as one tick.
//!
//! # What follows
//! Unless a hypothesis is less likely than an error beyond the promised four deviations, its
//! torques may be the true ones. So the deviation of a torque is at least that of the hypothesis,
//! and covers the torque of the hypothesis within [`COVERED`] deviations. If another hypothesis
//! than the stated one is the likeliest, no torque is valid that depends on the sub-tree or its
//! sensors; it is named once the stated one is that unlikely. A hypothesis whose odds have fallen
//! by four decades is refuted, and dropped.
//!
//! The setup is taken as stated until something contradicts it: the prior odds of each hypothesis
//! about it are small. Those of a contact since the start are not. Before the first two seconds of
//! motion nothing is known about it, and the torques that it matters to are unknown.

mod evidence;
pub(crate) mod hypothesis;
mod unit;

pub use hypothesis::{Hypothesis, Sight, View};

use crate::online::solution::{Change, Doubt, OnlineError, Solution};
use crate::prior::cad_root;
use crate::robot::BaseMotion;
use evidence::{Columns, Fit, Posterior, Rows, SMALL, dot};
use hypothesis::Motion;
use proprio_dynamics::model::Model;
use proprio_dynamics::regressor::{EstimateRows, LINK_PARAMETERS, StackedRegressor, Weighting};
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_dynamics::{ContactSet, FrameMotion, JointState, Kinematics, Solver, Structure};
use proprio_topics::Nanos;
use std::collections::VecDeque;
use unit::{CONTACT, Unit};

/// Deviations within which the torque of a hypothesis lies that is not refuted. At four, the
/// promise, almost half of the room remains for the uncertainty of that torque itself.
pub const COVERED: f64 = 2.5;
/// Postures in which torques are compared, one in [`APART`] ticks: those of 10 s.
const POSTURES: usize = 20;
const APART: usize = 5;
/// Ticks in motion from which on torques are compared: those of 2 s.
const SHOWN: usize = 20;
/// Ticks that wait for the gate, at most: those of 3 s.
const MOST_WAITING: usize = 30;
/// Times that a change is weighed, in which its noise converges.
const WEIGHINGS: usize = 10;
/// Period of the ticks.
pub(crate) const TICK: Nanos = Nanos::from_millis(100);

/// The readings at one time.
#[derive(Clone, Debug)]
pub(crate) struct Tick {
    /// Its slot in the time grid.
    pub(crate) slot: i64,
    motion: Motion,
    base_link: usize,
    readings: Vec<Wrench>,
    active: ContactSet,
    /// The components that move, a bit each.
    pub(crate) moving: u64,
    /// Those that have learnt it.
    learnt: u64,
}

impl Tick {
    pub(crate) fn new(dofs: usize, sensors: usize) -> Self {
        Self {
            slot: 0,
            motion: Motion::new(dofs),
            base_link: 0,
            readings: vec![Wrench::zero(); sensors],
            active: ContactSet::EMPTY,
            moving: 0,
            learnt: 0,
        }
    }

    /// Does not allocate.
    pub(crate) fn copy_from(
        &mut self,
        slot: i64,
        (state, base, base_link): (JointState<'_>, &FrameMotion, usize),
        readings: &[Wrench],
        active: &ContactSet,
    ) {
        self.motion.copy_from(state, base);
        self.readings.copy_from_slice(readings);
        (self.slot, self.base_link, self.active) = (slot, base_link, *active);
    }
}

/// The bit of a component in [`Tick`].
fn bit(component: usize) -> u64 {
    1 << component.min(63)
}

/// The bits of these components.
pub(crate) fn bits(components: impl Iterator<Item = usize>) -> u64 {
    components.fold(0, |bits, component| bits | bit(component))
}

/// What a component contributes.
pub(crate) struct Share<'a> {
    /// The sub-trees that can be free of contacts.
    pub(crate) subtrees: &'a [usize],
    /// The contacts on them that come and go.
    pub(crate) intermittent: ContactSet,
}

/// All hypotheses about a robot. See the [module](self).
#[derive(Clone, Debug)]
pub(crate) struct Bank {
    place: Place,
    units: Vec<Unit>,
    /// The stated variances of each sensor's channels, [torque; force].
    variances: Vec<[f64; 6]>,
    waiting: Vec<Tick>,
    /// The last ticks, waiting or not.
    latest: Vec<Tick>,
    /// The last [`POSTURES`], and the ticks since then.
    recent: VecDeque<Tick>,
    since_last: usize,
}

/// The equations of the robot at a tick, as seen by a hypothesis.
#[derive(Clone, Debug)]
struct Place {
    model: Model,
    structure: Structure,
    kinematics: Kinematics,
    stacked: StackedRegressor,
    solver: Solver,
    motion: Motion,
}

impl Bank {
    /// `relative` is the relative deviation of CAD parameters.
    pub(crate) fn new(
        model: &Model,
        structure: &Structure,
        base: (usize, &BaseMotion),
        cad: &[RigidInertia],
        offsets: &[Wrench],
        shares: &[Share<'_>],
        relative: f64,
    ) -> Result<Self, OnlineError> {
        let stacked = StackedRegressor::new(structure);
        let mut units = Vec::new();
        for (component, share) in shares.iter().enumerate() {
            for &subtree in share.subtrees {
                let own = &stacked.subtrees()[subtree];
                let (links, sensors) = (own.links().to_vec(), own.sensors().collect::<Vec<_>>());
                let parameters = links.iter().flat_map(|&link| cad[link].parameters());
                let offsets = sensors
                    .iter()
                    .flat_map(|&sensor| offsets[sensor].torque_first());
                let columns = Columns {
                    reference: parameters.chain(offsets).collect(),
                    roots: links
                        .iter()
                        .map(|&link| cad_root(&cad[link], relative))
                        .collect(),
                    links,
                    sensors,
                };
                let robot = (model, structure);
                let number = (component, subtree);
                units.push(Unit::new(number, columns, robot, base, &share.intermittent));
            }
        }
        let stated = structure.sensors().iter().map(|cut| {
            let noise = Wrench::from_parts(cut.noise().force, cut.noise().torque);
            noise.torque_first().map(|sigma| sigma * sigma)
        });
        Ok(Self {
            units,
            variances: stated.collect(),
            place: Place {
                kinematics: Kinematics::new(model, base.0)?,
                stacked,
                solver: Solver::new(structure),
                motion: Motion::new(model.dof_count()),
                model: model.clone(),
                structure: structure.clone(),
            },
            waiting: Vec::new(),
            latest: Vec::new(),
            recent: VecDeque::with_capacity(POSTURES),
            since_last: APART,
        })
    }

    /// Adds ticks. `decided` is the newest slot that each component has decided on, and the slots
    /// that it has learnt.
    pub(crate) fn learn(&mut self, ticks: &[Tick], decided: &[(i64, Vec<i64>)]) {
        self.latest.extend_from_slice(ticks);
        let old = self.latest.len().saturating_sub(MOST_WAITING);
        self.latest.drain(..old);
        let newest = decided
            .iter()
            .map(|(newest, _)| *newest)
            .max()
            .unwrap_or(i64::MIN);
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        let (now, later): (Vec<Tick>, Vec<Tick>) = waiting
            .chain(ticks.iter().cloned())
            .partition(|tick| tick.slot <= newest);
        // If nothing is learnt, no tick is decided.
        let old = later.len().saturating_sub(MOST_WAITING);
        self.waiting = later.into_iter().skip(old).collect();
        let Self {
            place,
            units,
            variances,
            recent,
            since_last,
            ..
        } = self;
        for mut tick in now {
            for (component, (_, slots)) in decided.iter().enumerate() {
                if slots.binary_search(&tick.slot).is_ok() {
                    tick.learnt |= bit(component);
                }
            }
            let is_learnt = |component: usize| tick.learnt & tick.moving & bit(component) != 0;
            let mut views: Vec<View> = Vec::new();
            for unit in units.iter().filter(|unit| is_learnt(unit.component)) {
                views.extend(unit.fits.iter().map(|fit| fit.view));
            }
            while let Some(view) = views.pop() {
                views.retain(|other| *other != view);
                let shifted = place.shifted(&tick, view, units);
                if !place.update(&tick, view) {
                    continue;
                }
                for (number, unit) in units.iter_mut().enumerate() {
                    if !is_learnt(unit.component) {
                        continue;
                    }
                    let shifted = shifted.get(number).map_or(&[][..], Vec::as_slice);
                    let rows = place.rows(unit, &tick, shifted, variances);
                    for fit in unit.fits.iter_mut().filter(|fit| fit.view == view) {
                        fit.add(&unit.columns, &rows);
                    }
                }
            }
            if tick.learnt != 0 {
                *since_last += 1;
            }
            if tick.learnt != 0 && *since_last >= APART {
                *since_last = 0;
                if recent.len() == POSTURES {
                    recent.pop_front();
                }
                recent.push_back(tick);
            }
        }
        self.weigh();
    }

    /// Whether a contact that has begun lately explains the last ticks, these included, better than
    /// other offsets: a steady force along the axes of the base. A push is more usual than a jump
    /// of an offset, as much as no contact at the start than one.
    pub(crate) fn is_rather_a_contact(&mut self, component: usize, ticks: &[Tick]) -> bool {
        let Self {
            place,
            units,
            variances,
            latest,
            ..
        } = self;
        let last: Vec<&Tick> = latest.iter().chain(ticks).collect();
        let last = &last[last.len().saturating_sub(MOST_WAITING)..];
        let mut own = units.iter().filter(|unit| unit.component == component);
        own.any(|unit| {
            let mut changes = unit.changes();
            for tick in last {
                if place.update(tick, View::AsStated) {
                    let rows = place.rows(unit, tick, &[], variances);
                    changes
                        .iter_mut()
                        .for_each(|fit| fit.add(&unit.columns, &rows));
                }
            }
            let evidence = |fit: &mut Fit| {
                (0..WEIGHINGS).for_each(|_| fit.weigh(&unit.columns));
                fit.branches[0].log_evidence
            };
            let mut evidence = changes.iter_mut().map(evidence);
            let changed = evidence.next().unwrap_or_default();
            evidence.any(|contact| contact > changed + CONTACT.ln())
        })
    }

    /// Weighs all hypotheses. What is wrong with the robot, rather than with one sub-tree, must be
    /// compatible with the others, too.
    fn weigh(&mut self) {
        self.units.iter_mut().for_each(Unit::weigh);
        let before = self.units.clone();
        for (number, unit) in self.units.iter_mut().enumerate() {
            unit.decide(|view, sight| {
                let others = before
                    .iter()
                    .enumerate()
                    .filter(|(other, _)| *other != number);
                others
                    .filter_map(|(_, other)| other.evidence(view, sight))
                    .sum()
            });
        }
    }

    /// Sets the doubts about the torques of a solution, which is in use. Torques that can not be
    /// compared keep theirs. `disturbed` are the components whose rows are rejected, a bit each:
    /// what was learnt does not explain their readings.
    pub(crate) fn doubt(&mut self, solution: &mut Solution, disturbed: u64) {
        let Self {
            place,
            units,
            recent,
            ..
        } = self;
        let in_use = place.in_use(solution);
        let mut doubts: Vec<Option<Doubt>> = vec![None; solution.doubts.len()];
        solution
            .components
            .iter_mut()
            .for_each(|own| own.leading = None);
        for unit in units.iter() {
            let dofs = place.dofs(&unit.columns.sensors, Some(unit.subtree));
            let leading = unit.leading();
            let (is_doubtful, is_settled) = (unit.is_doubtful(), unit.is_settled());
            let of_component = &mut solution.components[unit.component].leading;
            *of_component = of_component.or(leading);
            let mut add = |dof: usize, deviation: f64| {
                let doubt = doubts[dof].get_or_insert(Doubt::NONE);
                doubt.deviation = doubt.deviation.max(deviation);
                doubt.leading = doubt.leading.or(leading);
            };
            // The first postures of a motion do not show yet how far apart the torques will be.
            let is_shown = unit.fits[0].ticks() >= SHOWN && disturbed & bit(unit.component) == 0;
            if is_doubtful || !is_settled {
                let beyond = place.dofs(&measured_with(unit, units), None);
                beyond.iter().for_each(|&dof| add(dof, f64::INFINITY));
            }
            if is_doubtful || !is_settled && !is_shown {
                dofs.iter().for_each(|&dof| add(dof, f64::INFINITY));
                continue;
            }
            let learnt = |tick: &&Tick| tick.learnt & bit(unit.component) != 0;
            if recent.iter().any(|tick| learnt(&tick)) {
                dofs.iter().for_each(|&dof| add(dof, 0.0));
            }
            let alternatives = unit.alternatives();
            if alternatives.is_empty() {
                continue;
            }
            for tick in recent.iter().filter(learnt) {
                let published = place.torques(tick, &Hypothesis::AS_STATED, &in_use, &dofs);
                for other in &alternatives {
                    let torques = place.alternative(tick, (&unit.columns, other), &in_use, &dofs);
                    for (&dof, both) in dofs.iter().zip(published.iter().zip(torques)) {
                        if let (Some((published, _)), Some((torque, own))) = both {
                            add(dof, ((torque - published).abs() / COVERED).max(own));
                        }
                    }
                }
            }
        }
        for (to, doubt) in solution.doubts.iter_mut().zip(doubts) {
            *to = doubt.unwrap_or(*to);
        }
    }

    /// Forgets what a change of a component concerns.
    pub(crate) fn forget(&mut self, component: usize, change: Change) {
        let model = &self.place.model;
        let own = self
            .units
            .iter_mut()
            .filter(|unit| unit.component == component);
        own.for_each(|unit| match change {
            Change::Anew => unit.begin_anew(),
            Change::Offset => unit.forget(&unit.offsets()),
            Change::Load => unit.forget(&unit.loads(model)),
        });
    }

    /// Whether a contact may have been there since the start.
    pub(crate) fn may_have_begun_in_contact(&self, component: usize) -> bool {
        let mut own = self.units.iter().filter(|unit| unit.component == component);
        own.any(Unit::may_have_begun_in_contact)
    }
}

impl Place {
    /// Sets the regressor to a tick; false if it can not be computed.
    fn update(&mut self, tick: &Tick, view: View) -> bool {
        let is_updated = self.look(tick, view)
            && self
                .stacked
                .update(&self.kinematics, &tick.readings, &tick.active, &[])
                .is_ok();
        if is_updated {
            self.stacked.eliminate_contacts(Weighting::Noise);
        }
        is_updated
    }

    /// The rows of a unit at a tick, to which the regressor is set.
    fn rows<'a>(
        &'a self,
        unit: &Unit,
        tick: &'a Tick,
        shifted: &'a [Vec<f64>],
        variances: &'a [[f64; 6]],
    ) -> Rows<'a> {
        Rows {
            rows: &self.stacked.subtrees()[unit.subtree],
            structure: &self.structure,
            kinematics: &self.kinematics,
            readings: &tick.readings,
            shifted,
            variances,
        }
    }

    /// Of each unit, what its reference leaves of its rows, if what a view estimates is a little
    /// off, each in turn.
    fn shifted(&mut self, tick: &Tick, view: View, units: &[Unit]) -> Vec<Vec<Vec<f64>>> {
        let mut shifted = vec![Vec::new(); units.len()];
        let unknowns = view.unknowns();
        for place in 0..unknowns {
            let mut values = vec![0.0; unknowns];
            values[place] = SMALL;
            if !self.update(tick, view.at(&values)) {
                return Vec::new();
            }
            for (unit, shifted) in units.iter().zip(&mut shifted) {
                shifted.push(unit.columns.rest(&self.stacked.subtrees()[unit.subtree]));
            }
        }
        shifted
    }

    fn look(&mut self, tick: &Tick, view: View) -> bool {
        self.motion
            .copy_from(tick.motion.state(), &tick.motion.base);
        self.motion.see(view);
        self.kinematics
            .set_base(&self.model, tick.base_link)
            .is_ok()
            && (self.kinematics)
                .update(&self.model, self.motion.state(), &self.motion.base)
                .is_ok()
    }

    /// The torques of `dofs` at a tick, with these parameters, and their sensitivities to them;
    /// none where they do not follow from the readings.
    fn torques(
        &mut self,
        tick: &Tick,
        hypothesis: &Hypothesis,
        parameters: &[f64],
        dofs: &[usize],
    ) -> Vec<Option<(f64, Vec<f64>)>> {
        let nothing = vec![None; dofs.len()];
        let mut active = tick.active;
        hypothesis
            .contact
            .iter()
            .for_each(|&contact| active.insert(contact));
        let readings: Vec<Wrench> = (0..tick.readings.len())
            .map(|sensor| hypothesis.sight.reading(sensor, &tick.readings))
            .collect();
        if !self.look(tick, hypothesis.view) {
            return nothing;
        }
        let Self {
            model,
            structure,
            kinematics,
            solver,
            ..
        } = self;
        if solver
            .solve(model, structure, kinematics, &readings, &active, &[])
            .is_err()
        {
            return nothing;
        }
        let Ok(rows) = EstimateRows::new(structure, solver, kinematics) else {
            return nothing;
        };
        let torque = |&dof: &usize| {
            let row = row(&rows, dof, parameters.len())?;
            let measured = rows.torque_measured(dof, &readings, &[]).ok()?;
            Some((measured + dot(&row, parameters), row))
        };
        dofs.iter().map(torque).collect()
    }

    /// The torques of `dofs` if another hypothesis about the sub-tree holds, and their deviations.
    fn alternative(
        &mut self,
        tick: &Tick,
        (columns, other): (&Columns, &Posterior),
        in_use: &[f64],
        dofs: &[usize],
    ) -> Vec<Option<(f64, f64)>> {
        // A contact that is known to be there makes the hypothesis the stated one.
        if other
            .hypothesis
            .contact
            .is_some_and(|contact| tick.active.contains(contact))
        {
            return vec![None; dofs.len()];
        }
        let places = self.columns(columns);
        let mut parameters = in_use.to_vec();
        for (&place, value) in places.iter().zip(&other.mean) {
            parameters[place] = *value;
        }
        let torques = self.torques(tick, &other.hypothesis, &parameters, dofs);
        let with_deviation = |(torque, row): (f64, Vec<f64>)| {
            let sensitivity: Vec<f64> = places.iter().map(|&place| row[place]).collect();
            (torque, other.deviation(columns, &sensitivity))
        };
        torques
            .into_iter()
            .map(|torque| torque.map(with_deviation))
            .collect()
    }

    /// The degrees of freedom whose torques depend on one of these sensors, or on this sub-tree.
    fn dofs(&self, sensors: &[usize], own: Option<usize>) -> Vec<usize> {
        let is_own = |subtree: usize| {
            let mut of_subtree = self.structure.subtrees()[subtree].sensors.iter();
            Some(subtree) == own || of_subtree.any(|sensor| sensors.contains(&sensor))
        };
        let depends = |dof: &usize| {
            let links = self.structure.moved_by(*dof).iter();
            links
                .filter_map(|&link| self.structure.subtree_of(link))
                .any(is_own)
        };
        (0..self.model.dof_count()).filter(depends).collect()
    }

    /// The places of a sub-tree's columns among those of the robot, ten per link, six per sensor.
    fn columns(&self, own: &Columns) -> Vec<usize> {
        let first = LINK_PARAMETERS * self.structure.link_count();
        let links = own.links.iter().map(|link| LINK_PARAMETERS * link);
        let links = links.flat_map(|column| column..column + LINK_PARAMETERS);
        let sensors = own.sensors.iter().map(|sensor| first + 6 * sensor);
        links
            .chain(sensors.flat_map(|column| column..column + 6))
            .collect()
    }

    /// The parameters in use, in these columns.
    fn in_use(&self, solution: &Solution) -> Vec<f64> {
        let first = LINK_PARAMETERS * self.structure.link_count();
        let mut all: Vec<f64> = self
            .model
            .inertias()
            .iter()
            .flat_map(RigidInertia::parameters)
            .collect();
        all.resize(first + 6 * self.structure.sensors().len(), 0.0);
        for own in &solution.components {
            for (&link, body) in own.links.iter().zip(&own.bodies) {
                all[LINK_PARAMETERS * link..][..LINK_PARAMETERS]
                    .copy_from_slice(&body.parameters());
            }
            for (&sensor, offset) in own.sensors.iter().zip(&own.offsets) {
                all[first + 6 * sensor..][..6].copy_from_slice(&offset.torque_first());
            }
        }
        all
    }
}

/// The sensors whose offsets follow from those of a unit: no other sub-tree weighs them alone.
fn measured_with(unit: &Unit, units: &[Unit]) -> Vec<usize> {
    let sensors = |unit: &Unit| unit.columns.sensors.clone();
    let is_alone = |sensor: &usize| units.iter().any(|other| sensors(other) == [*sensor]);
    let shares = |other: &&Unit| {
        let mut own = other.columns.sensors.iter();
        own.any(|sensor| unit.columns.sensors.contains(sensor))
    };
    let found = units.iter().filter(shares).flat_map(sensors);
    found.filter(|sensor| !is_alone(sensor)).collect()
}

/// The row of a torque over the columns of the robot.
fn row(rows: &EstimateRows<'_>, dof: usize, columns: usize) -> Option<Vec<f64>> {
    let subtree = rows.torque_subtree(dof)?;
    let mut own = vec![0.0; rows.column_count(subtree)?];
    rows.torque_row(dof, &mut own).ok()?;
    let mut all = vec![0.0; columns];
    rows.expand(subtree, &own, &mut all).ok()?;
    Some(all)
}
