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
//! rows are learnt. Residuals beyond the stated noise are a misfit, which lasts: three seconds of
//! them count as one tick.
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
//! motion nothing is known about it, and the torques that it matters to are unknown. In the first
//! second no torque is valid.

mod evidence;
mod subtree_hypotheses;

pub use crate::readings::{Hypothesis, MotionReading, WrenchReading};

use crate::online::component::ComponentLayout;
use crate::online::solution::{DetectedChange, Doubt, OnlineError, Solution};
use crate::readings::SeenMotion;
use crate::robot::{Robot, stated_noise};
use evidence::{HypothesisPosterior, SMALL, SharedDesign, SubtreeUnknowns, TickRows, dot};
use nalgebra::Vector6;
use proprio_dynamics::model::Model;
use proprio_dynamics::regressor::{EstimateRows, LINK_PARAMETERS, StackedRegressor};
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_dynamics::{ContactSet, FrameMotion, JointState, Kinematics, Solver, Structure};
use proprio_topics::Nanos;
use std::collections::VecDeque;
use subtree_hypotheses::{CONTACT, SubtreeHypotheses, hypotheses};

/// Deviations within which the torque of a hypothesis lies that is not refuted. At four, the
/// promise, almost half of the room remains for the uncertainty of that torque itself.
pub const COVERED: f64 = 2.5;
/// Postures in which torques are compared, one in [`APART`] ticks: those of 10 s.
const POSTURES: usize = 20;
const APART: usize = 5;
/// Ticks in motion from which on torques are compared: those of 2 s.
const SHOWN: usize = 20;
/// Motion before which a component's solution is not used \[s\]. What is learnt from a few postures
/// looks certain, and what is wrong with the setup does not show yet: of robots on a foot, gravity
/// that is 20 degrees off shows within a second.
const BEGUN: f64 = 1.0;
/// Ticks that wait for the gate, at most: those of 3 s.
const MOST_WAITING: usize = 30;
/// The last ticks that are kept, those of 6 s: of them, the ones that a change is found in.
pub(crate) const LATEST: usize = 60;
/// Times that a change is weighed, in which its noise converges.
const WEIGHINGS: usize = 10;
/// Period of the ticks.
pub(crate) const TICK: Nanos = Nanos::from_millis(100);

/// The readings at one time.
#[derive(Clone, Debug)]
pub(crate) struct Tick {
    /// Its slot in the time grid.
    pub(crate) slot: i64,
    motion: SeenMotion,
    base_link: usize,
    readings: Vec<Wrench>,
    active: ContactSet,
    /// The components that move, a bit each.
    pub(crate) moving: u64,
    /// Those that have learnt it.
    learnt_by: u64,
}

impl Tick {
    pub(crate) fn new(dofs: usize, sensors: usize) -> Self {
        Self {
            slot: 0,
            motion: SeenMotion::new(dofs),
            base_link: 0,
            readings: vec![Wrench::zero(); sensors],
            active: ContactSet::EMPTY,
            moving: 0,
            learnt_by: 0,
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

/// All hypotheses about a robot. See the [module](self).
#[derive(Clone, Debug)]
pub(crate) struct Bank {
    equations: TickEquations,
    subtrees: Vec<SubtreeHypotheses>,
    waiting: Vec<Tick>,
    /// The last [`LATEST`], waiting or not.
    latest: Vec<Tick>,
    /// The last [`POSTURES`], and the ticks since then.
    recent: VecDeque<Tick>,
    since_last: usize,
}

/// The equations of the robot at a tick, as seen by a hypothesis.
#[derive(Clone, Debug)]
struct TickEquations {
    model: Model,
    structure: Structure,
    kinematics: Kinematics,
    stacked: StackedRegressor,
    solver: Solver,
    motion: SeenMotion,
    /// The stated variances of each sensor's channels, [torque; force].
    variances: Vec<[f64; 6]>,
}

impl Bank {
    /// About the sub-trees of these components. `offsets` are the configured ones.
    pub(crate) fn new<'a>(
        robot: &Robot,
        offsets: &[Wrench],
        components: impl Iterator<Item = &'a ComponentLayout>,
    ) -> Result<Self, OnlineError> {
        let (model, structure) = (&robot.model, &robot.structure);
        let stacked = StackedRegressor::new(structure);
        let mut subtrees = Vec::new();
        for (component, layout) in components.enumerate() {
            for &number in &layout.subtrees {
                let subtree = &stacked.subtrees()[number];
                let unknowns = SubtreeUnknowns::new(robot, subtree, offsets);
                let contacts = &structure.subtrees()[number].contacts;
                let contacts = contacts.intersection(&layout.intermittent);
                let at_start = hypotheses(&unknowns, robot, &contacts);
                subtrees.push(SubtreeHypotheses::new(
                    component, number, unknowns, at_start,
                ));
            }
        }
        let sensors = structure.sensors().iter();
        let stated = sensors.map(|cut| stated_noise(cut).map(|sigma| sigma * sigma));
        Ok(Self {
            subtrees,
            equations: TickEquations {
                variances: stated.collect(),
                kinematics: Kinematics::new(model, robot.base_link)?,
                stacked,
                solver: Solver::new(structure),
                motion: SeenMotion::new(model.dof_count()),
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
        let old = self.latest.len().saturating_sub(LATEST);
        self.latest.drain(..old);
        let newest = decided.iter().map(|(newest, _)| *newest).max();
        let newest = newest.unwrap_or(i64::MIN);
        let waiting = std::mem::take(&mut self.waiting).into_iter();
        let (now, later): (Vec<Tick>, Vec<Tick>) = waiting
            .chain(ticks.iter().cloned())
            .partition(|tick| tick.slot <= newest);
        // If nothing is learnt, no tick is decided.
        let old = later.len().saturating_sub(MOST_WAITING);
        self.waiting = later.into_iter().skip(old).collect();
        for mut tick in now {
            for (component, (_, slots)) in decided.iter().enumerate() {
                if slots.binary_search(&tick.slot).is_ok() {
                    tick.learnt_by |= bit(component);
                }
            }
            let is_learnt = |component: usize| tick.learnt_by & tick.moving & bit(component) != 0;
            let mut motion_readings: Vec<MotionReading> = Vec::new();
            for subtree in self
                .subtrees
                .iter()
                .filter(|subtree| is_learnt(subtree.component))
            {
                motion_readings.extend(subtree.fits.iter().map(|fit| fit.motion_reading));
            }
            while let Some(motion_reading) = motion_readings.pop() {
                motion_readings.retain(|other| *other != motion_reading);
                let Some(shifted) = self
                    .equations
                    .shifted(&tick, motion_reading, &self.subtrees)
                else {
                    continue;
                };
                if !self.equations.update(&tick, motion_reading) {
                    continue;
                }
                let subtrees = self.subtrees.iter_mut().zip(&shifted);
                for (subtree, shifted) in
                    subtrees.filter(|(subtree, _)| is_learnt(subtree.component))
                {
                    let rows = self.equations.rows(subtree, &tick, shifted);
                    for fit in subtree
                        .fits
                        .iter_mut()
                        .filter(|fit| fit.motion_reading == motion_reading)
                    {
                        fit.add(&subtree.columns, &rows);
                    }
                }
            }
            self.since_last += usize::from(tick.learnt_by != 0);
            if tick.learnt_by != 0 && self.since_last >= APART {
                self.since_last = 0;
                if self.recent.len() == POSTURES {
                    self.recent.pop_front();
                }
                self.recent.push_back(tick);
            }
        }
        self.weigh();
    }

    /// Whether a contact explains the readings of these slots better than other offsets do: a
    /// steady force along the axes of the base. `ticks` are the newest. A push is more usual than a
    /// jump of an offset, as much as no contact at the start than one.
    ///
    /// A jump concerns some sub-trees of the component, a contact one; the others are as before.
    pub(crate) fn is_rather_a_contact(
        &mut self,
        component: usize,
        slots: &[i64],
        ticks: &[Tick],
    ) -> bool {
        let all = self.latest.iter().chain(ticks);
        let rejected: Vec<&Tick> = all.filter(|tick| slots.contains(&tick.slot)).collect();
        let (mut jump, mut contact) = (0.0, f64::NEG_INFINITY);
        for subtree in (self.subtrees.iter()).filter(|subtree| subtree.component == component) {
            let mut fits = subtree.changes();
            for tick in &rejected {
                if self.equations.update(tick, MotionReading::AsStated) {
                    let rows = self.equations.rows(subtree, tick, &[]);
                    for fit in &mut fits {
                        fit.add(&subtree.columns, &rows);
                    }
                }
            }
            let evidence = |fit: &mut SharedDesign| {
                (0..WEIGHINGS).for_each(|_| fit.weigh(&subtree.columns));
                fit.branches[0].log_evidence
            };
            let mut evidence = fits.iter_mut().map(evidence);
            let [unchanged, jumped] = [(); 2].map(|()| evidence.next().unwrap_or_default());
            // Against what is unchanged, so that the sum over sub-trees is that of the component.
            jump += (jumped - unchanged).max(0.0);
            contact = evidence.fold(contact, |most, own| most.max(own - unchanged));
        }
        contact > jump + CONTACT.ln()
    }

    /// Weighs all hypotheses. What is wrong with the robot, rather than with one sub-tree, must be
    /// compatible with the others, too.
    fn weigh(&mut self) {
        self.subtrees.iter_mut().for_each(SubtreeHypotheses::weigh);
        let evidence: Vec<_> = self
            .subtrees
            .iter()
            .map(SubtreeHypotheses::evidence)
            .collect();
        for (number, subtree) in self.subtrees.iter_mut().enumerate() {
            subtree.decide(|motion_reading, wrench_reading| {
                let others = evidence.iter().enumerate();
                let others = others.filter(|(other, _)| *other != number);
                let weight =
                    |(_, of_subtree): (usize, &Vec<(MotionReading, WrenchReading, f64)>)| {
                        let same = of_subtree
                            .iter()
                            .find(|own| (own.0, own.1) == (motion_reading, wrench_reading));
                        same.map(|own| own.2)
                    };
                others.filter_map(weight).sum()
            });
        }
    }

    /// Sets the doubts about the torques of a solution, which is in use. Torques that can not be
    /// compared keep theirs. `disturbed` are the components whose rows are rejected, a bit each:
    /// what was learnt does not explain their readings. Of those that begin `anew` nothing is
    /// known.
    pub(crate) fn doubt(&mut self, solution: &mut Solution, disturbed: u64, anew: u64) {
        let (equations, subtrees, recent) = (&mut self.equations, &self.subtrees, &self.recent);
        let in_use = equations.in_use(solution);
        let mut doubts: Vec<Option<Doubt>> = vec![None; solution.doubts.len()];
        for component in &mut solution.components {
            component.leading = None;
        }
        for subtree in subtrees {
            let dofs = equations.dofs(&subtree.columns.sensors, Some(subtree.subtree));
            let leading = subtree.leading();
            let (is_doubtful, is_settled) = (subtree.is_doubtful(), subtree.is_settled());
            let of_component = &mut solution.components[subtree.component].leading;
            *of_component = of_component.or(leading);
            let mut add = |dof: usize, deviation: f64| {
                let doubt = doubts[dof].get_or_insert(Doubt::NONE);
                doubt.deviation = doubt.deviation.max(deviation);
                doubt.leading = doubt.leading.or(leading);
            };
            // The first postures of a motion do not show yet what is wrong, nor how far apart the
            // torques will be.
            let seconds = solution.components[subtree.component].seconds_in_motion;
            let is_begun = seconds > 0.0 && seconds < BEGUN || anew & bit(subtree.component) != 0;
            let is_shown =
                subtree.fits[0].ticks() >= SHOWN && disturbed & bit(subtree.component) == 0;
            if is_doubtful || is_begun || !is_settled {
                let beyond = equations.dofs(&measured_with(subtree, subtrees), None);
                beyond.iter().for_each(|&dof| add(dof, f64::INFINITY));
            }
            if is_doubtful || is_begun || !is_settled && !is_shown {
                dofs.iter().for_each(|&dof| add(dof, f64::INFINITY));
                continue;
            }
            let is_learnt = |tick: &&Tick| tick.learnt_by & bit(subtree.component) != 0;
            if recent.iter().any(|tick| is_learnt(&tick)) {
                dofs.iter().for_each(|&dof| add(dof, 0.0));
            }
            let alternatives = subtree.alternatives();
            if alternatives.is_empty() {
                continue;
            }
            for tick in recent.iter().filter(is_learnt) {
                let published = equations.torques(tick, &Hypothesis::AS_STATED, &in_use, &dofs);
                for other in &alternatives {
                    let torques =
                        equations.alternative(tick, (&subtree.columns, other), &in_use, &dofs);
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
    pub(crate) fn forget(&mut self, component: usize, change: DetectedChange) {
        let model = &self.equations.model;
        let subtrees = self.subtrees.iter_mut();
        let own = subtrees.filter(|subtree| subtree.component == component);
        own.for_each(|subtree| match change {
            DetectedChange::Anew => subtree.begin_anew(),
            DetectedChange::Offset => subtree.forget(&subtree.offsets()),
            DetectedChange::Load => subtree.forget(&subtree.loads(model)),
        });
    }

    /// Whether a contact may have been there since the start.
    pub(crate) fn may_have_begun_in_contact(&self, component: usize) -> bool {
        let mut own = self
            .subtrees
            .iter()
            .filter(|subtree| subtree.component == component);
        own.any(SubtreeHypotheses::may_have_begun_in_contact)
    }
}

impl TickEquations {
    /// Sets the regressor to a tick; false if it can not be computed.
    fn update(&mut self, tick: &Tick, motion_reading: MotionReading) -> bool {
        self.set_kinematics(tick, motion_reading)
            && self
                .stacked
                .update(&self.kinematics, &tick.readings, &tick.active, &[])
                .is_ok()
    }

    /// The rows of a sub-tree at a tick, to which the regressor is set.
    fn rows<'a>(
        &'a self,
        subtree: &SubtreeHypotheses,
        tick: &'a Tick,
        shifted: &'a [Vector6<f64>],
    ) -> TickRows<'a> {
        TickRows {
            rows: &self.stacked.subtrees()[subtree.subtree],
            structure: &self.structure,
            kinematics: &self.kinematics,
            readings: &tick.readings,
            shifted,
            variances: &self.variances,
        }
    }

    /// Of each sub-tree, the wrench that its reference leaves if what is estimated of the motion is
    /// a little off, each in turn; none if it can not be computed.
    fn shifted(
        &mut self,
        tick: &Tick,
        motion_reading: MotionReading,
        subtrees: &[SubtreeHypotheses],
    ) -> Option<Vec<Vec<Vector6<f64>>>> {
        let mut shifted = vec![Vec::new(); subtrees.len()];
        let unknowns = motion_reading.unknowns();
        for place in 0..unknowns {
            let mut values = vec![0.0; unknowns];
            values[place] = SMALL;
            if !self.update(tick, motion_reading.at(&values)) {
                return None;
            }
            for (subtree, shifted) in subtrees.iter().zip(&mut shifted) {
                let rows = &self.stacked.subtrees()[subtree.subtree];
                shifted.push(subtree.columns.wrench_left(rows)?);
            }
        }
        Some(shifted)
    }

    fn set_kinematics(&mut self, tick: &Tick, motion_reading: MotionReading) -> bool {
        self.motion
            .copy_from(tick.motion.state(), &tick.motion.base);
        self.motion.see(motion_reading);
        let (kinematics, motion) = (&mut self.kinematics, &self.motion);
        let set = kinematics.set_base(&self.model, tick.base_link);
        set.and_then(|()| kinematics.update(&self.model, motion.state(), &motion.base))
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
        if let Some(contact) = hypothesis.contact {
            active.insert(contact);
        }
        let readings: Vec<Wrench> = (0..tick.readings.len())
            .map(|sensor| hypothesis.wrench_reading.reading(sensor, &tick.readings))
            .collect();
        if !self.set_kinematics(tick, hypothesis.motion_reading) {
            return nothing;
        }
        let (model, structure, kinematics) = (&self.model, &self.structure, &self.kinematics);
        let solved = (self.solver).solve(model, structure, kinematics, &readings, &active, &[]);
        let rows = solved.and_then(|()| EstimateRows::new(structure, &self.solver, kinematics));
        let Ok(rows) = rows else {
            return nothing;
        };
        let torque = |&dof: &usize| {
            let mut row = vec![0.0; parameters.len()];
            rows.torque_row(dof, &mut row).ok()?;
            let measured = rows.torque_measured(dof, &readings, &[]).ok()?;
            Some((measured + dot(&row, parameters), row))
        };
        dofs.iter().map(torque).collect()
    }

    /// The torques of `dofs` if another hypothesis about the sub-tree holds, and their deviations.
    fn alternative(
        &mut self,
        tick: &Tick,
        (columns, other): (&SubtreeUnknowns, &HypothesisPosterior),
        in_use: &[f64],
        dofs: &[usize],
    ) -> Vec<Option<(f64, f64)>> {
        // A contact that is known to be there makes the hypothesis the stated one.
        let contact = other.hypothesis.contact;
        if contact.is_some_and(|contact| tick.active.contains(contact)) {
            return vec![None; dofs.len()];
        }
        let places = self.columns(columns);
        let mut parameters = in_use.to_vec();
        for (&place, value) in places.iter().zip(&other.mean) {
            parameters[place] = *value;
        }
        let torques = self.torques(tick, &other.hypothesis, &parameters, dofs);
        let shifted: Vec<_> = (0..other.of_motion_reading.len())
            .map(|place| {
                let (mut values, mut hypothesis) =
                    (other.of_motion_reading.clone(), other.hypothesis);
                values[place] += SMALL;
                hypothesis.motion_reading = hypothesis.motion_reading.at(&values);
                self.torques(tick, &hypothesis, &parameters, dofs)
            })
            .collect();
        let with_deviation = |(number, own): (usize, Option<(f64, Vec<f64>)>)| {
            let (torque, row) = own?;
            let sensitivity: Vec<f64> = places.iter().map(|&place| row[place]).collect();
            let to_view = |all: &Vec<Option<(f64, Vec<f64>)>>| {
                let other = all[number].as_ref();
                other.map(|(other, _)| (other - torque) / SMALL)
            };
            let of_motion_reading = shifted.iter().map(to_view).collect::<Option<Vec<f64>>>()?;
            Some((
                torque,
                other.deviation(columns, &sensitivity, &of_motion_reading),
            ))
        };
        let torques = torques.into_iter().enumerate();
        torques.map(with_deviation).collect()
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
    fn columns(&self, own: &SubtreeUnknowns) -> Vec<usize> {
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

/// The sensors whose offsets follow from those of a sub-tree, from sub-tree to sub-tree: no other
/// one weighs them alone.
fn measured_with(subtree: &SubtreeHypotheses, subtrees: &[SubtreeHypotheses]) -> Vec<usize> {
    let others = || {
        subtrees
            .iter()
            .filter(|other| other.subtree != subtree.subtree)
    };
    let is_alone = |sensor: &usize| others().any(|other| other.columns.sensors == [*sensor]);
    let mut found = subtree.columns.sensors.clone();
    found.retain(|sensor| !is_alone(sensor));
    let mut checked = 0;
    while let Some(&sensor) = found.get(checked) {
        checked += 1;
        let with = others().filter(|other| other.columns.sensors.contains(&sensor));
        for &next in with.flat_map(|other| &other.columns.sensors) {
            if !is_alone(&next) && !found.contains(&next) {
                found.push(next);
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;
    use crate::readings::GRAVITY;
    use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame};
    use proprio_dynamics::spatial::{Pose, Vec3};
    use proprio_dynamics::{
        ContactKind, ContactSpec, ExternalWrench, InverseDynamics, Noise, SensorCut,
    };
    use std::f64::consts::PI;

    /// An arm of three moving links on a sensor, that can be touched at its tip.
    struct Arm {
        robot: Robot,
        tip: Frame,
    }

    impl Arm {
        fn new() -> Self {
            let mut text = String::from("<robot name=\"r\"><link name=\"l0\"/>");
            let joints = [("continuous", "1 0 0"), ("fixed", "0 0 1")];
            let more = [("continuous", "0 1 0"), ("continuous", "1 0 0")];
            for (number, (kind, axis)) in joints.into_iter().chain(more).enumerate() {
                let own = number + 1;
                text += &format!(
                    "<link name=\"l{own}\"><inertial><origin xyz=\"0.01 0.02 0.1\"/>\
                     <mass value=\"1\"/><inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" iyy=\"0.012\" \
                     iyz=\"0\" izz=\"0.005\"/></inertial></link><joint name=\"j{own}\" \
                     type=\"{kind}\"><parent link=\"l{number}\"/><child link=\"l{own}\"/>\
                     <origin xyz=\"0.02 0 0.2\"/><axis xyz=\"{axis}\"/></joint>"
                );
            }
            let model = Model::from_urdf(&(text + "</robot>"), &["j2"]).unwrap();
            let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
            let noise = Noise {
                force: [0.1; 3],
                torque: [0.005; 3],
            };
            let cut =
                SensorCut::new(&model, "j2", frame, direction, &Pose::identity(), &noise).unwrap();
            let tip = Frame {
                link: model.inertias().len() - 1,
                pose: Pose::identity(),
            };
            let contact = ContactSpec {
                frame: tip,
                kind: ContactKind::Force,
                position: Vec3::new(0.0, 0.0, 0.2),
            };
            let gravity = Vec3::new(0.0, 0.0, -GRAVITY);
            let (sensors, contacts) = ([("ft", cut)], [("tip", contact)]);
            let mut robot =
                Robot::standing("r", model, "l0", &gravity, &sensors, &contacts).unwrap();
            robot.always = ContactSet::EMPTY;
            Self { robot, tip }
        }

        fn bank(&self) -> Bank {
            let beyond = self.robot.structure.subtree_of(self.tip.link).unwrap();
            let stacked = StackedRegressor::new(&self.robot.structure);
            let offsets = [Wrench::zero()];
            let layout = ComponentLayout::new(&self.robot, &stacked, vec![beyond], &offsets);
            Bank::new(&self.robot, &offsets, std::iter::once(&layout)).unwrap()
        }

        /// The readings of the truth in this slot, and what encoders and base tell of it: joint 1
        /// and the base are taken as `told`. A force acts at the tip, and the offset is another.
        fn tick(&self, slot: i64, told: MotionReading, force: Vec3, offset: Wrench) -> Tick {
            let phase = 0.1 * slot as f64;
            let sines = |derivative: u8| -> Vec<f64> {
                let sine = |joint: i32| {
                    let (rate, shift) = (0.6 + 0.37 * f64::from(joint), f64::from(joint));
                    let angle = rate * phase + shift + 0.5 * PI * f64::from(derivative);
                    0.8 * rate.powi(i32::from(derivative)) * angle.sin()
                };
                (0..3).map(sine).collect()
            };
            let mut truth = SeenMotion::new(3);
            (truth.position, truth.velocity, truth.acceleration) = (sines(0), sines(1), sines(2));
            truth.base = FrameMotion::standing(&Vec3::new(0.0, 0.0, -GRAVITY));
            let mut kinematics = Kinematics::new(&self.robot.model, 0).unwrap();
            kinematics
                .update(&self.robot.model, truth.state(), &truth.base)
                .unwrap();
            let pose = *kinematics.pose(self.tip.link);
            let point = Frame {
                link: self.tip.link,
                pose: Pose {
                    translation: Vec3::new(0.0, 0.0, 0.2),
                    ..Pose::identity()
                },
            };
            let wrench = Wrench {
                torque: Vec3::zeros(),
                force: pose.rotation.transpose() * force,
            };
            let mut dynamics = InverseDynamics::new(&self.robot.model);
            let external = [ExternalWrench {
                frame: point,
                wrench,
            }];
            dynamics
                .update(&self.robot.model, &kinematics, &external)
                .unwrap();
            let cut = &self.robot.structure.sensors()[0];
            let noise = normals(slot as u64, 6);
            let noise = Wrench::from_parts(
                [0, 1, 2].map(|i| 0.1 * noise[i]),
                [3, 4, 5].map(|i| 0.005 * noise[i]),
            );
            let reading = cut.reading(&dynamics.transmitted(&kinematics, cut.joint()));
            let mut seen = truth.clone();
            seen.see(told);
            let mut tick = Tick::new(3, 1);
            let readings = [reading + offset + noise];
            let state = (seen.state(), &seen.base, 0);
            tick.copy_from(slot, state, &readings, &ContactSet::EMPTY);
            tick.moving = 1;
            tick
        }

        /// A bank that has learnt 20 s of this.
        fn learnt(&self, told: MotionReading) -> Bank {
            let mut bank = self.bank();
            for second in 0..20 {
                let slots: Vec<i64> = (10 * second..10 * second + 10).collect();
                let tick = |slot: &i64| self.tick(*slot, told, Vec3::zeros(), Wrench::zero());
                let ticks: Vec<Tick> = slots.iter().map(tick).collect();
                bank.learn(&ticks, &[(*slots.last().unwrap(), slots)]);
            }
            bank
        }
    }

    /// What a bank makes of a reading of the motion that has unknowns.
    fn estimate(bank: &Bank, is_it: impl Fn(&MotionReading) -> bool) -> MotionReading {
        let subtree = &bank.subtrees[0];
        let fit = subtree
            .fits
            .iter()
            .find(|fit| is_it(&fit.motion_reading))
            .unwrap();
        fit.posterior(&subtree.columns, 0)
            .unwrap()
            .hypothesis
            .motion_reading
    }

    #[test]
    fn the_zero_and_the_gain_of_an_encoder_are_estimated() {
        for (off, is_small) in [([-0.03, -0.02], true), ([-0.15, -0.1], false)] {
            let bank = Arm::new().learnt(MotionReading::Encoder(1, off));
            let found = estimate(&bank, |motion_reading| {
                matches!(motion_reading, MotionReading::Encoder(1, _))
            });
            let MotionReading::Encoder(_, [offset, gain]) = found else {
                panic!("{found:?}");
            };
            // Right is (reading - off[0]) / (1 + off[1]). The columns are those without an error.
            let right = [-off[0] / (1.0 + off[1]), 1.0 / (1.0 + off[1]) - 1.0];
            let tolerance = if is_small { 0.1 } else { 0.3 };
            assert!((offset / right[0] - 1.0).abs() < tolerance, "{offset}");
            assert!((gain / right[1] - 1.0).abs() < tolerance, "{gain}");
            let leading = bank.subtrees[0].leading().map(|own| own.motion_reading);
            assert_eq!(leading, (!is_small).then_some(found));
        }
    }

    #[test]
    fn the_tilt_of_the_base_is_estimated_and_harmless_if_small() {
        for (tilt, is_small) in [(0.03, true), (0.2, false)] {
            let bank = Arm::new().learnt(MotionReading::BaseTurned(Vec3::new(0.0, -tilt, 0.0)));
            let is_it = |motion_reading: &MotionReading| {
                matches!(motion_reading, MotionReading::BaseTurned(_))
            };
            let MotionReading::BaseTurned(turn) = estimate(&bank, is_it) else {
                panic!();
            };
            assert!((turn.y - tilt).abs() < 0.05 * tilt, "{turn}");
            assert!(turn.x.abs() < 0.05 * tilt, "{turn}");
            // The turn about gravity is not seen, and does not count.
            let subtree = &bank.subtrees[0];
            assert_eq!(subtree.is_doubtful(), !is_small, "{tilt}");
            if !is_small {
                let leading = subtree.leading().unwrap();
                assert!(is_it(&leading.motion_reading), "{leading:?}");
            }
        }
    }

    #[test]
    fn a_steady_push_is_told_from_an_offset_that_jumps() {
        let arm = Arm::new();
        let push = (Vec3::new(8.0, 3.0, -5.0), Wrench::zero());
        let jump = Wrench::from_parts([8.0, 3.0, -5.0], [0.5, 0.2, -0.3]);
        for ((force, offset), is_contact) in [(push, true), ((Vec3::zeros(), jump), false)] {
            let mut bank = arm.learnt(MotionReading::AsStated);
            let slots: Vec<i64> = (200..230).collect();
            let tick = |slot: &i64| arm.tick(*slot, MotionReading::AsStated, force, offset);
            let rejected: Vec<Tick> = slots.iter().map(tick).collect();
            // They wait, for nothing is decided about them; only one second is new.
            bank.learn(&rejected[..20], &[(199, Vec::new())]);
            let found = bank.is_rather_a_contact(0, &slots, &rejected[20..]);
            assert_eq!(found, is_contact, "{force} {offset:?}");
        }
    }
}
