//! On-line identification while the robot works: rows of every observation in the real-time loop, a
//! solution once a second in another thread, and neither waits for the other.
//!
//! ```text
//! Online::observe                 real-time loop: fixed time, no allocation
//!     rows of each component -> block of 0.1 s -> gate -> [R | z]
//! Online::take_job -> SolutionJob::run    any thread
//!     [R | z] + prior -> bodies, offsets, covariance, noise, changes
//!     ticks           -> what else than stated may be the case
//! Online::give_back, Online::apply
//!     the solution is in use from the stamp (snapshot + 1 s) on
//! ```
//!
//! A solution, and the time from which it is in use, depend on the observed stamps and values
//! alone. So live operation and replay agree, provided that jobs come back before their stamp. Late
//! ones are applied later, and counted ([`ObservationCounts::late`]).
//!
//! # Components
//! Sub-trees that can be free of contacts are linked by the F/T sensors that they share. Each such
//! *component* has its own square-root information over `[offsets of its sensors | parameters of
//! its links]`, relative to the configured offsets and to CAD. A sub-tree with unknown contacts
//! gives the combinations of its six equations that these do not reach: none under a full wrench.
//!
//! In a large component the rows of a limb contain the limb and its sensors only. They are gathered
//! in a separate triangle, and merged once a second, which costs a tenth. The drift of offsets is
//! added as often, since each step of a random walk involves all linked unknowns. (Small
//! components: ten times a second.)
//!
//! # Noise
//! Rows are whitened with *inflated* variances, and offsets drift between blocks (random walks).
//! `noise_tracker` estimates both from the mean of each channel from one second to the next, minus
//! the prediction by the earlier bodies. All readings count there, rejected ones too: otherwise
//! noise above the assumed one would be rejected for ever. Initially the noise is assumed hundreds
//! of times the stated one. Offsets are constant while a contact is declared or a disturbance is
//! suspected.
//!
//! # Gating
//! A block is absorbed one block later, and only if both it and the next pass the gate: the block's
//! mean innovation, whitened by the predictive covariance `P + R`, is tested against chi-square. A
//! failure means an undeclared contact, an outlier, an offset jump, or another load. Its rows are
//! rejected (kept for a later test), and the component reports [`Paused::Suspected`]. If this lasts
//! three seconds while a sensor tilts, the rejected rows are tested for a change. If the
//! information with re-initialised offsets of the tilted sensors explains them, together with
//! bodies that are probable under CAD, these offsets are re-initialised. If new parameters of the
//! outermost links explain them better, the load has changed. Otherwise it remains a contact, for
//! any duration.
//!
//! # Hypotheses
//! Identification fits whatever is wrong with the setup, too: a reversed encoder is absorbed by the
//! bodies. So what may be other than stated is weighed beside it (`bank`), with ten instants a
//! second. A torque covers every hypothesis that is not refuted, and is withheld while another one
//! is likelier than what is stated ([`Doubt`]). If a disturbance begins before a contact since the
//! start is refuted, it may be the end of that contact. Then everything is learnt anew.
//!
//! # The parameters in use
//! Initially CAD. Then the parameters that predict later readings better (`selection`), with the
//! offsets that fit them best. The most probable parameters are solved every second, and judge new
//! rows.

pub(crate) mod bank;
mod noise_tracker;
mod rows;
mod selection;
pub mod state;

mod component;
mod earlier;
mod job;
mod parameters;
mod solution;

pub use bank::{COVERED, Hypothesis, MotionReading, WrenchReading};
pub use job::SolutionJob;
pub use solution::{
    ComponentSolution, DetectedChange, Doubt, ObservationCounts, OnlineError, OnlineObservation,
    Paused, Solution,
};

use bank::{Bank, TICK, Tick};
use component::{Component, ComponentLayout, KEPT, LARGE};
use job::ComponentJob;
use solution::{BLOCK, SOLVE};

use std::sync::Arc;

use proprio_topics::Nanos;

use crate::prior::Prior;
use crate::robot::Robot;
use proprio_dynamics::regressor::StackedRegressor;
use proprio_dynamics::spatial::Wrench;
use proprio_dynamics::{DynamicsError, Kinematics};

/// On-line identification of a robot's inertial parameters and F/T offsets. See the [module](self).
#[derive(Debug)]
pub struct Online {
    stacked: StackedRegressor,
    components: Vec<Component>,
    period: Nanos,
    newest: Nanos,
    job: Option<Box<SolutionJob>>,
    /// Time of the job's snapshot; None before the first observation.
    snapshot: Option<Nanos>,
    is_away: bool,
    /// Whether the stamp of the job that is away has passed.
    is_overdue: bool,
    late: u64,
    solution: Solution,
    /// Those since the last job are the first `tick_count`.
    ticks: Vec<Tick>,
    tick_count: usize,
    last_tick: Nanos,
}

impl Online {
    /// Starts from the robot's CAD, and `offsets`, one per sensor. One observation is expected per
    /// `period`.
    ///
    /// # Errors
    /// [`OnlineError`].
    pub fn new(robot: &Robot, offsets: &[Wrench], period: Nanos) -> Result<Self, OnlineError> {
        let (model, structure) = (&robot.model, &robot.structure);
        let kinematics = Kinematics::new(model, robot.base_link)?;
        let mut stacked = StackedRegressor::new(structure);
        let readings = vec![Wrench::zero(); structure.sensors().len()];
        stacked.update(&kinematics, &readings, &robot.always, &[])?;
        let per = |time: Nanos| usize::try_from(time.0 / period.0.max(1)).unwrap_or(0);
        let (per_job, per_block) = (per(SOLVE + SOLVE).max(1), per(BLOCK) + 2);
        let components: Vec<Component> = (linked_subtrees(&stacked).into_iter())
            .map(|subtrees| {
                let layout = ComponentLayout::new(robot, &stacked, subtrees, offsets);
                Component::new(layout, per_job, per_block, period.seconds())
            })
            .collect();
        if components.is_empty() {
            return Err(OnlineError::Nothing);
        }
        // glibc requests matrices of this size from the system and returns them one by one, which
        // costs a tenth of a job's time. Once a larger block was freed, it keeps that much memory.
        if components
            .iter()
            .any(|component| component.information.unknowns() >= LARGE)
        {
            drop(std::hint::black_box(Vec::<u8>::with_capacity(KEPT)));
        }
        let cad = model.inertias();
        let tick = Tick::new(model.dof_count(), structure.sensors().len());
        let ticks = vec![tick; usize::try_from(2 * SOLVE.0 / TICK.0).unwrap_or(0)];
        let relative = robot.urdf_relative_std;
        let prior = Arc::new(Prior::new(cad)?.with_relative_std(relative));
        let solution = Solution {
            data_until: Nanos::MIN,
            components: components.iter().map(|c| c.unknown(cad, offsets)).collect(),
            doubts: vec![Doubt::COMPLETE; model.dof_count()],
        };
        let layouts = components.iter().map(|component| &*component.layout);
        let job = Box::new(SolutionJob {
            data_until: Nanos::MIN,
            components: (components.iter().zip(&solution.components))
                .map(|(component, known)| {
                    ComponentJob::new(component, known.clone(), period, &prior, relative)
                })
                .collect(),
            prior,
            solution: solution.clone(),
            bank: Bank::new(robot, offsets, layouts)?,
            ticks: ticks.clone(),
            tick_count: 0,
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
            ticks,
            tick_count: 0,
            last_tick: Nanos::MIN,
        })
    }

    /// Why identification of a component pauses, and the counts of its observations; None if the
    /// component does not exist.
    pub fn state(&self, component: usize) -> Option<(Paused, ObservationCounts)> {
        let of = self.components.get(component)?;
        Some((
            of.paused,
            ObservationCounts {
                late: self.late,
                ..of.counts
            },
        ))
    }

    /// The solution in use.
    pub fn solution(&self) -> &Solution {
        &self.solution
    }

    /// Takes in an observation. Does not allocate.
    ///
    /// # Errors
    /// Sizes do not match, or numbers are not finite. Nothing is changed then.
    pub fn observe(&mut self, observation: &OnlineObservation<'_>) -> Result<(), DynamicsError> {
        let (t, kinematics) = (observation.t, observation.kinematics);
        let (readings, active) = (observation.readings, observation.active);
        let period = self.period.0.max(1);
        let slot = t.0.div_euclid(period);
        // A block has room for one observation per slot.
        if t <= self.newest || slot == self.newest.0.div_euclid(period) {
            return Ok(());
        }
        self.stacked.update(kinematics, readings, active, &[])?;
        self.newest = t;
        self.snapshot.get_or_insert(t);
        for (component, known) in self.components.iter_mut().zip(&self.solution.components) {
            component.observe(observation, &self.stacked, known, slot);
        }
        if t.saturating_sub(TICK) >= self.last_tick
            && !self.components.iter().any(|component| component.waits)
            && let Some(tick) = self.ticks.get_mut(self.tick_count)
        {
            self.last_tick = t;
            self.tick_count += 1;
            let base_motion = &observation.base_motion;
            let motion = (observation.state, base_motion, kinematics.base());
            tick.copy_from(slot, motion, readings, active);
            let all = self.components.iter().enumerate();
            let moving = all.filter(|(_, component)| component.is_moved(observation));
            tick.moving = bank::bits(moving.map(|(number, _)| number));
        }
        Ok(())
    }

    /// F/T sensor number `sensor` has a new zero from the next observation on, as its device says:
    /// its offset is learnt anew, and all else is kept. Does not allocate.
    pub fn forget_offset(&mut self, sensor: usize) {
        for component in &mut self.components {
            let mut sensors = component.layout.sensors.iter();
            if let Some(place) = sensors.position(|own| *own == sensor) {
                component.forget_offset(place);
            }
        }
    }

    /// Whether the solution in use has the zero that F/T sensor number `sensor` has since
    /// [`Self::forget_offset`]. Never for a sensor that is not identified.
    pub fn knows_zero(&self, sensor: usize) -> bool {
        let mut own = self.components.iter();
        own.find(|component| component.layout.sensors.contains(&sensor))
            .is_some_and(|component| !component.is_outdated)
    }

    /// Returns a job to run once a second; None while the last one has not come back or waits for
    /// its stamp. Does not allocate.
    pub fn take_job(&mut self) -> Option<Box<SolutionJob>> {
        let due = self.snapshot? + SOLVE;
        if self.is_away || self.newest < due {
            return None;
        }
        let mut job = self.job.take()?;
        self.is_away = true;
        self.snapshot = Some(self.newest);
        job.data_until = self.newest;
        std::mem::swap(&mut job.ticks, &mut self.ticks);
        job.tick_count = std::mem::take(&mut self.tick_count);
        for (part, component) in job.components.iter_mut().zip(&mut self.components) {
            component.join();
            // Both have the same unknowns.
            let _ = part.information.copy_from(&component.information);
            std::mem::swap(&mut part.accepted_rows, &mut component.accepted_rows);
            std::mem::swap(&mut part.rejected_rows, &mut component.rejected_rows);
            component.accepted_rows.clear();
            component.rejected_rows.clear();
            component.waits = false;
            part.has_new_zero = component.is_outdated;
            part.is_disturbed = component.is_disturbed;
            part.cosines.copy_from_slice(&component.cosines);
            part.row_variances.copy_from_slice(&component.row_variances);
            component
                .row_variances
                .copy_from_slice(&component.variances);
            part.seconds_in_motion = component.seconds_in_motion;
            part.rows = component.rows;
        }
        Some(job)
    }

    /// Returns a finished job.
    pub fn give_back(&mut self, job: Box<SolutionJob>) {
        self.job = Some(job);
    }

    /// Puts the job's solution in use if its stamp has come. Returns whether something changed.
    /// Call it after each observation, before [`Online::take_job`]. Does not allocate.
    pub fn apply(&mut self) -> bool {
        let Some(due) = self
            .snapshot
            .filter(|_| self.is_away)
            .map(|snapshot| snapshot + SOLVE)
        else {
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
        for (part, component) in job.components.iter_mut().zip(&mut self.components) {
            component.variances.copy_from_slice(&part.variances);
            component.drift_std.copy_from_slice(&part.drift_std);
            component.is_outdated &=
                component.waits || !part.has_new_zero || part.failure.is_some();
            component.may_judge = part.failure.is_none() && !component.is_outdated;
            component.counts.failed += u64::from(part.failure.is_some());
            // A disturbance that has ended meanwhile was no change.
            part.is_replaced &= component.is_disturbed;
            if let Some((change, information)) =
                part.change.as_mut().filter(|_| component.is_disturbed)
            {
                component.last_change = Some(*change);
                std::mem::swap(information, &mut component.information);
                // The limbs' information is from before the change too.
                for limb in component.limbs.iter_mut().flatten() {
                    limb.information.clear();
                }
                // The solution in use precedes the change; the next one includes it.
                component.may_judge = false;
                component.is_disturbed = false;
                component.paused = Paused::No;
                component.counts.changes += 1;
                match change {
                    DetectedChange::Offset => component.counts.offset_changes += 1,
                    DetectedChange::Load => component.counts.load_changes += 1,
                    DetectedChange::Anew => {
                        (component.seconds_in_motion, component.rows) = (0.0, 0);
                    }
                }
                component.pending.clear();
                component.gathered.clear();
            }
        }
        true
    }

    /// The last change found in a component ([`ObservationCounts::changes`] is their number).
    pub fn last_change(&self, component: usize) -> Option<DetectedChange> {
        self.components.get(component)?.last_change
    }
}

/// The sub-trees that can be free of contacts, in groups that share sensors.
fn linked_subtrees(stacked: &StackedRegressor) -> Vec<Vec<usize>> {
    let structure = stacked.structure();
    let is_free: Vec<bool> = (stacked.subtrees().iter())
        .map(|subtree| subtree.remaining() > 0 && subtree.sensors().len() > 0)
        .collect();
    let free: Vec<usize> = (0..is_free.len()).filter(|&k| is_free[k]).collect();
    let mut group: Vec<usize> = (0..is_free.len()).collect();
    for sensor in 0..structure.sensors().len() {
        let has_sensor = |k: &&usize| structure.subtrees()[**k].sensors.contains(sensor);
        let sharing: Vec<usize> = free.iter().filter(has_sensor).copied().collect();
        if let [a, b] = sharing[..] {
            let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
            let others = group.iter_mut().filter(|g| **g == from);
            others.for_each(|g| *g = to);
        }
    }
    let firsts = free.iter().filter(|&&k| group[k] == k);
    firsts
        .map(|first| free.iter().copied().filter(|&k| group[k] == *first))
        .map(Iterator::collect)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;
    use crate::linear::information::Information;
    use crate::online::parameters::ParameterEstimate;
    use crate::robot::BaseMotion;
    use nalgebra::DMatrix;
    use nalgebra::DVector;
    use proprio_dynamics::ContactSet;
    use proprio_dynamics::DofSet;
    use proprio_dynamics::model::Model;
    use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame};
    use proprio_dynamics::spatial::Pose;
    use proprio_dynamics::spatial::Vec3;
    use proprio_dynamics::{FrameMotion, JointState, Noise, SensorCut};
    use proprio_topics::Reason;
    use std::fmt::Write as _;

    /// A trunk of four links, and four limbs of four links behind a sensor each. The first limb
    /// ends in a foot behind another sensor.
    fn robot() -> Robot {
        let (mut text, mut sensors, mut links) =
            (String::from("<robot name=\"r\">"), Vec::new(), 0);
        let mut link = |parent: Option<usize>, is_sensor: bool| {
            let _ = write!(
                text,
                "<link name=\"l{links}\"><inertial><origin xyz=\"0.01 0.02 0.05\"/>\
                 <mass value=\"1\"/><inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" iyy=\"0.012\" \
                 iyz=\"0\" izz=\"0.015\"/></inertial></link>"
            );
            if let Some(parent) = parent {
                let kind = if is_sensor { "fixed" } else { "continuous" };
                let axis = ["1 0 0", "0 1 0", "0 0 1"][links % 3];
                let _ = write!(
                    text,
                    "<joint name=\"j{links}\" type=\"{kind}\"><parent link=\"l{parent}\"/>\
                     <child link=\"l{links}\"/><origin xyz=\"0.05 0.02 0.1\" \
                     rpy=\"0.3 {parent} 0\"/><axis xyz=\"{axis}\"/></joint>"
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
        let noise = Noise {
            force: [0.1, 0.2, 0.3],
            torque: [0.01, 0.02, 0.03],
        };
        let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
        let cuts: Vec<(&str, SensorCut)> = (keep.iter())
            .map(|joint| {
                let pose = Pose::identity();
                let cut = SensorCut::new(&model, joint, frame, direction, &pose, &noise);
                (*joint, cut.unwrap())
            })
            .collect();
        let gravity = Vec3::new(0.0, 0.0, -9.81);
        let mut robot = Robot::standing("r", model, "l0", &gravity, &cuts, &[]).unwrap();
        // In free flight.
        (robot.base, robot.always) = (BaseMotion::Imu(Pose::identity()), ContactSet::default());
        robot
    }

    fn online(robot: &Robot) -> Online {
        let offsets = vec![Wrench::zero(); robot.structure.sensors().len()];
        Online::new(robot, &offsets, Nanos::from_millis(10)).unwrap()
    }

    /// Observations every ten milliseconds of a robot in random motion, with random readings.
    fn observe(robot: &Robot, observations: i64, online: &mut [&mut Online]) {
        let (model, count) = (&robot.model, robot.structure.sensors().len());
        let mut kinematics = Kinematics::new(model, 0).unwrap();
        let dofs = model.dof_count();
        let (joints, fine) = (vec![Reason::None; dofs], vec![Reason::None; count]);
        for step in 0..observations {
            let numbers = normals(step as u64, 3 * dofs + 6 * count + 9);
            let (of_joints, rest) = numbers.split_at(3 * dofs);
            let [position, velocity, acceleration] =
                [0, 1, 2].map(|m| &of_joints[m * dofs..(m + 1) * dofs]);
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
            let six = |six: &[f64]| {
                Wrench::from_parts([six[0], six[1], six[2]], [six[3], six[4], six[5]])
            };
            let readings: Vec<Wrench> = rest[9..].chunks_exact(6).map(six).collect();
            for online in &mut *online {
                let observation = OnlineObservation {
                    t: Nanos::from_millis(10 * step),
                    kinematics: &kinematics,
                    readings: &readings,
                    active: &ContactSet::default(),
                    base: Reason::None,
                    joints: &joints,
                    moved: &DofSet::default(),
                    is_base_moved: true,
                    state,
                    base_motion: motion,
                    sensors: &fine,
                };
                online.observe(&observation).unwrap();
            }
        }
    }

    /// The gate accepts the drift that an offset may have had since the data of the solution.
    #[test]
    fn the_drift_of_offsets_passes_the_gate() {
        let robot = robot();
        let mut online = online(&robot);
        let mut known = online.job.as_ref().unwrap().solution.components[0].clone();
        observe(&robot, 1, &mut [&mut online]);
        let component = &mut online.components[0];
        // Unknowns that explain the observation, except for an offset.
        let (unknowns, mut a, mut y) = (component.layout.reference.len(), Vec::new(), Vec::new());
        for (kind, rows) in component.layout.kinds.iter().zip(component.gathered.iter()) {
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
        let explains = a
            .svd(true, true)
            .solve(&DVector::from_vec(y), 1e-12)
            .unwrap();
        known.estimate = explains.as_slice().to_vec();
        known.covariance_root = DMatrix::zeros(unknowns, unknowns);
        component.drift_std.fill(1e5);
        let now = Nanos::from_seconds(100.0);
        for (offset, since, exceeds_gate) in [
            (0.0, 0.0, false),
            (1e5, 0.0, true),
            (1e5, 100.0, false),
            (3e7, 100.0, true),
        ] {
            known.estimate[3] = explains[3] + offset;
            known.data_until = Nanos::from_seconds(100.0 - since);
            assert_eq!(
                component.exceeds_gate(&known, now),
                exceeds_gate,
                "{offset} N after {since} s"
            );
        }
    }

    /// The covariance of a mixture matches its definition.
    #[test]
    fn a_mixture_of_two_sets_has_its_mean_and_covariance() {
        let set = |seed: u64| ParameterEstimate {
            change: normals(seed, 3),
            root: DMatrix::from_vec(4, 3, normals(seed + 1, 12)),
            bodies: Vec::new(),
            tau: 1.0,
            effective: 1.0,
        };
        let (first, second) = (set(1), set(3));
        let [a, b] = [&first, &second].map(|set| DVector::from_column_slice(&set.change));
        for share in [0.0, 0.3, 1.0] {
            let mixed = ParameterEstimate::between(&first, &second, share).unwrap();
            let [p, p1, p2] = [&mixed, &first, &second].map(|set| set.root.tr_mul(&set.root));
            let apart = (&b - &a) * (&b - &a).transpose() * (share * (1.0 - share));
            assert!(
                (p - p1 * (1.0 - share) - p2 * share - apart).amax() < 1e-12,
                "{share}"
            );
            let mean = &a * (1.0 - share) + &b * share;
            assert!(
                (DVector::from_vec(mixed.change) - mean).amax() < 1e-12,
                "{share}"
            );
        }
    }

    /// A failure to solve is reported, with the earlier solution in use, until it is over.
    #[test]
    fn a_failure_is_reported_until_it_is_over() {
        let mut job = online(&robot()).job.unwrap();
        let last_valid = job.solution.components[0].clone();
        for (tau, text) in [(f64::NAN, Some("the scale tau is NaN")), (1.0, None)] {
            job.components[0].tau = tau;
            job.run();
            let reported: Vec<Option<String>> =
                job.failures().map(|f| f.map(ToString::to_string)).collect();
            let [reported] = reported.try_into().unwrap();
            let begins = |reported: &String| text.is_some_and(|text| reported.starts_with(text));
            assert!(
                reported.as_ref().map_or(text.is_none(), begins),
                "{reported:?}"
            );
            let own = &job.solution.components[0];
            assert_eq!(
                (own.is_accepted, own.estimate == last_valid.estimate),
                (text.is_none(), text.is_some())
            );
        }
    }

    /// Absorbing limb by limb or all together gives the same information, and rows of limbs are
    /// absorbed limb by limb.
    #[test]
    fn limbs_give_the_same_information_separately() {
        let robot = robot();
        let [mut apart, mut together] = [(); 2].map(|()| online(&robot));
        assert_eq!(
            (
                apart.components.len(),
                apart.components[0].limbs.iter().flatten().count()
            ),
            (1, 5)
        );
        together.components[0].limbs.fill(None);
        observe(&robot, 260, &mut [&mut apart, &mut together]);
        // Thirty of the 36 rows of an observation, since the last full second.
        let component = &mut apart.components[0];
        let by_limbs: u64 = component
            .limbs
            .iter()
            .flatten()
            .map(|limb| limb.information.rows())
            .sum();
        let (all, rows) = (
            together.components[0].information.rows(),
            component.information.rows(),
        );
        assert!(
            by_limbs > 0 && by_limbs + rows == all && by_limbs.is_multiple_of(30),
            "{by_limbs} of {all}"
        );
        component.join();
        assert!(
            component
                .limbs
                .iter()
                .flatten()
                .all(|limb| limb.information.rows() == 0)
        );
        let (found, expected) = (&component.information, &together.components[0].information);
        assert_eq!(found.rows(), expected.rows());
        let square = |information: &Information| {
            let (r, z) = information.to_triangle();
            (r.transpose() * &r, r.transpose() * &z)
        };
        let ((a, b), (c, d)) = (square(found), square(expected));
        assert!((&a - &c).norm() < 1e-12 * c.norm() && (b - &d).norm() < 1e-12 * d.norm());
        // In directions without information, the right side belongs to the residual.
        let unexplained = |information: &Information| {
            let (_, z) = information.to_triangle();
            z.norm_squared() + information.residual_square()
        };
        let (found, expected) = (unexplained(found), unexplained(expected));
        assert!((found - expected).abs() < 1e-10 * expected);
    }
}
