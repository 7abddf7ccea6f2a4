//! The measurement model: the linear equations of one observation, and the noise in them.
//!
//! ```text
//! A d + G s = r + N e
//! ```
//!
//! - `d = phi - phi_CAD`: ten parameters per link that appears in any log ([`Unknowns::links`]),
//!   then the extra parameters of the robot ([`Unknowns::extra`]);
//! - `s`: the nuisance parameters of the log: six offsets [torque; force] per F/T sensor that
//!   appears in a row; Coulomb friction, viscous friction and torque offset per joint whose torque
//!   is measured;
//! - `r`: the measurement minus the prediction by CAD;
//! - `e`: the noise of the *channels*, independent of each other: six per F/T sensor, one per joint
//!   torque.
//!
//! There are two kinds of rows. Rows of F/T sensors are the balances of sub-trees, of which
//! [`StackedRegressor`] keeps the combinations that no present contact reaches. Noise enters these
//! rows as offsets do: `N = G`. Rows of joint torques come from the [`Regressor`] of the whole
//! tree, for joints beyond which, seen from the base, nothing touches the robot. There `N = 1` and
//! `G = [tanh(dq / v0), dq, 1]`. If torques are measured at the motor side, `A` has an extra column
//! for the rotor inertia: its entry is the acceleration of the joint.
//!
//! If the calibrations of F/T sensors are unknown too ([`proprio_dynamics::calibration`]), a sensor
//! measures `(1 + E) r - k (T - T0) - o`. `A` then has columns for `E` and `k`: the entries that
//! `G` has for `o`, times `-r` or the temperature. Here `r` is the noise-free reading by an earlier
//! fit ([`Annotated::fitted`]). The measured reading must not be used: a gain of zero with massless
//! bodies would then make every row zero. Mass and gain scale together, so only the priors would
//! speak against this solution, and the noise, which grows with the length of the log, for it.

use crate::arithmetic::{dot, mean};
use crate::dataset::observation::{Annotated, Observation, SubtreeSet};
use crate::dataset::stream::range;
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::{ExtraParameter, FRICTION, Unknowns, friction_row};
use crate::parallel;
use crate::robot::{IdentificationInput, Robot, TorqueSide, is_between};
use nalgebra::{DVector, Matrix6, Vector6};
use proprio_dynamics::calibration::{Kind, Unknown};
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::regressor::{Regressor, StackedRegressor};
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_dynamics::{DynamicsError, JointState, Kinematics};
use std::ops::Range;

/// Which links, extra parameters and channels appear in rows, and which of them in the same ones
/// (union-find). They are numbered in this order.
struct AppearingNodes {
    parent: Vec<usize>,
    seen: Vec<bool>,
}

impl AppearingNodes {
    fn new(count: usize) -> Self {
        Self {
            parent: (0..count).collect(),
            seen: vec![false; count],
        }
    }

    /// The representative of a node's group.
    fn group(&mut self, mut node: usize) -> usize {
        while self.parent[node] != node {
            self.parent[node] = self.parent[self.parent[node]];
            node = self.parent[node];
        }
        node
    }

    /// Adds a row over `links` links and the extra parameters, with its noise.
    fn add(&mut self, links: usize, a: &[f64], noise: &[f64]) {
        let (of_links, extra) = a.split_at(LINK_PARAMETERS * links);
        let single = extra.iter().chain(noise).map(std::slice::from_ref);
        let columns = of_links.chunks_exact(LINK_PARAMETERS).chain(single);
        let mut first = None;
        for (node, columns) in columns.enumerate() {
            if columns.iter().any(|x| *x != 0.0) {
                self.seen[node] = true;
                let own = self.group(node);
                let with = self.group(*first.get_or_insert(own));
                self.parent[own.max(with)] = own.min(with);
            }
        }
    }

    fn groups(&mut self, nodes: impl Iterator<Item = usize>) -> Vec<usize> {
        nodes.map(|node| self.group(node)).collect()
    }

    /// The nodes in this range that appear, counted from its start.
    fn appearing(&self, range: Range<usize>) -> Vec<usize> {
        let is_seen = |place: &usize| self.seen[range.start + place];
        (0..range.len()).filter(is_seen).collect()
    }
}

/// The group of each unknown and channel. No row has unknowns or channels of two groups.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Groups {
    /// Per link of the layout.
    pub links: Vec<usize>,
    /// Per extra parameter.
    pub extra: Vec<usize>,
    /// Per channel.
    pub channels: Vec<usize>,
}

/// Computes the rows of observations.
#[derive(Clone)]
pub(crate) struct MeasurementModel<'a> {
    robot: &'a Robot,
    unknowns: Unknowns,
    /// CAD's parameters of all links.
    cad: Vec<f64>,
    kinematics: Kinematics,
    stacked: StackedRegressor,
    tree: Regressor,
    readings: Vec<Wrench>,
    /// Per sensor, the unknowns of its calibration and their columns of `A`.
    calibrations: Vec<Vec<(usize, Unknown)>>,
    /// Per sensor, the reference temperature of its change per kelvin \[degrees Celsius\]; NaN if
    /// none was recorded.
    references: Vec<f64>,
    wrench: bool,
    torque: bool,
    /// Whether rows are also made of sub-trees on which an undeclared disturbance acts.
    includes_disturbed: bool,
    groups: Groups,
}

impl<'a> MeasurementModel<'a> {
    /// The model for these measurements. Its columns are the unknowns that appear in any of
    /// `observations`.
    ///
    /// # Errors
    /// The observations are of another robot.
    pub(crate) fn for_observations<'b>(
        robot: &'a Robot,
        inputs: &[IdentificationInput],
        observations: impl Iterator<Item = &'b Annotated>,
    ) -> Result<Self, DynamicsError> {
        let (links, sensors) = (robot.model.link_count(), robot.structure.sensors().len());
        let wrench = inputs.contains(&IdentificationInput::Wrench);
        let torque = inputs.contains(&IdentificationInput::Torque);
        let dofs = 0..robot.model.dof_count();
        let has_rotors = torque && robot.torque_side == TorqueSide::Motor;
        let rotors = dofs.clone().filter(|_| has_rotors);
        let extra: Vec<ExtraParameter> = rotors.map(ExtraParameter::RotorInertia).collect();
        let all = Unknowns {
            links: (0..links).collect(),
            precision: extra.iter().map(|one| one.precision(robot)).collect(),
            extra,
            sensors: (0..sensors).collect(),
            joints: dofs.collect(),
        };
        let mut measurement = Self {
            robot,
            unknowns: all,
            cad: (robot.model.inertias().iter())
                .flat_map(RigidInertia::parameters)
                .collect(),
            kinematics: Kinematics::new(&robot.model, robot.base_link)?,
            stacked: StackedRegressor::new(&robot.structure),
            tree: Regressor::new(&robot.model),
            readings: vec![Wrench::zero(); sensors],
            calibrations: vec![Vec::new(); sensors],
            references: vec![f64::NAN; sensors],
            wrench,
            torque,
            includes_disturbed: false,
            groups: Groups::default(),
        };
        // Links, extra parameters and channels are joined if a row has both.
        let extra = measurement.unknowns.extra.len();
        let (first_channel, channels) = (links + extra, measurement.unknowns.channels());
        let mut nodes = AppearingNodes::new(first_channel + channels);
        for observation in observations {
            let rows = measurement.checked_rows(observation)?;
            for row in 0..rows.count {
                nodes.add(links, rows.a(row), rows.n(row));
            }
        }
        let first_torque = first_channel + 6 * sensors;
        let is_read =
            |sensor: &usize| nodes.seen[first_channel + 6 * sensor..][..6].contains(&true);
        let extra = nodes.appearing(links..first_channel);
        let all = std::mem::take(&mut measurement.unknowns);
        measurement.unknowns = Unknowns {
            links: nodes.appearing(0..links),
            extra: extra.iter().map(|&place| all.extra[place]).collect(),
            precision: extra.iter().map(|&place| all.precision[place]).collect(),
            sensors: (0..sensors).filter(is_read).collect(),
            joints: nodes.appearing(first_torque..first_channel + channels),
        };
        let unknowns = &measurement.unknowns;
        let wrenches = unknowns.sensors.iter().flat_map(|s| 6 * s..6 * s + 6);
        let wrenches = wrenches.map(|channel| first_channel + channel);
        let torques = unknowns.joints.iter().map(|joint| first_torque + joint);
        measurement.groups = Groups {
            links: nodes.groups(unknowns.links.iter().copied()),
            extra: nodes.groups(extra.iter().map(|place| links + place)),
            channels: nodes.groups(wrenches.chain(torques)),
        };
        Ok(measurement)
    }

    /// Sets the precisions of the extra parameters' priors.
    pub(crate) fn set_precision(&mut self, precision: Vec<f64>) {
        self.unknowns.precision = precision;
    }

    /// Makes these parameters of the calibrations of the visible sensors unknown, and no others. A
    /// gain has all its entries. The change per kelvin is included where the temperature varies in
    /// these observations. Its reference temperature is the configured one, else the mean.
    pub(crate) fn set_calibration_unknowns<'b>(
        &mut self,
        wanted: Kind,
        observations: impl Iterator<Item = &'b Annotated>,
    ) {
        /// Least temperature range that determines a change per kelvin [K].
        const MIN_TEMPERATURE_RANGE: f64 = 0.1;
        let robot = self.robot;
        // Calibration parameters come last.
        let is_other = |extra: &&ExtraParameter| !matches!(extra, ExtraParameter::Calibration(..));
        let others = self.unknowns.extra.iter().filter(is_other).count();
        self.unknowns.extra.truncate(others);
        self.unknowns.precision.truncate(others);
        self.groups.extra.truncate(others);
        self.calibrations.iter_mut().for_each(Vec::clear);
        let mut temperatures = vec![Vec::new(); self.references.len()];
        for observation in observations {
            let measured = temperatures.iter_mut().zip(&observation.temperatures);
            for (own, celsius) in measured.filter(|(_, celsius)| celsius.is_finite()) {
                own.push(*celsius);
            }
        }
        for (place, &sensor) in self.unknowns.sensors.iter().enumerate() {
            let own: &Vec<f64> = &temperatures[sensor];
            let configured = robot.calibrations[sensor].reference();
            self.references[sensor] = configured.unwrap_or(mean(own));
            let varies = range(own.iter().copied()) > MIN_TEMPERATURE_RANGE;
            let kind = Kind {
                temperature: wanted.temperature && varies,
                ..wanted
            };
            for unknown in kind.unknowns() {
                let extra = ExtraParameter::Calibration(sensor, unknown);
                self.calibrations[sensor].push((
                    LINK_PARAMETERS * self.unknowns.links.len() + self.unknowns.extra.len(),
                    unknown,
                ));
                self.unknowns.extra.push(extra);
                self.unknowns.precision.push(extra.precision(robot));
                self.groups.extra.push(self.groups.channels[6 * place]);
            }
        }
    }

    /// The reference temperature of a sensor's change per kelvin \[degrees Celsius\], if one was
    /// recorded or configured.
    pub(crate) fn reference(&self, sensor: usize) -> Option<f64> {
        let reference = self.references.get(sensor).copied();
        reference.filter(|celsius| celsius.is_finite())
    }

    /// Columns and entries of a sensor's calibration in a row, where its offset has the entries
    /// `values`. An unknown of the calibration acts as an offset proportional to the reading.
    fn calibration<'b>(
        &'b self,
        observation: &'b Annotated,
        sensor: usize,
        values: &'b [f64],
    ) -> impl Iterator<Item = (usize, f64)> + 'b {
        let celsius = observation.temperatures.get(sensor);
        let kelvin = celsius.map(|celsius| celsius - self.references[sensor]);
        let kelvin = kelvin.filter(|kelvin| kelvin.is_finite()).unwrap_or(0.0);
        let fitted = observation.fitted.get(sensor);
        let fitted = fitted.filter(|fitted| fitted.is_finite());
        let corrected = fitted.unwrap_or(&self.readings[sensor]).torque_first();
        let unknowns = self.calibrations[sensor].iter();
        unknowns.map(move |&(column, unknown)| {
            let as_offset = unknown.as_offset(&corrected, kelvin);
            (column, values[unknown.channel()] * as_offset)
        })
    }

    pub(crate) fn unknowns(&self) -> &Unknowns {
        &self.unknowns
    }

    /// Groups of unknowns and channels. No row has two groups.
    pub(crate) fn groups(&self) -> &Groups {
        &self.groups
    }

    /// Whether rows are also made of [`Annotated::disturbed`] sub-trees from now on.
    pub(crate) fn include_disturbed(&mut self, includes_disturbed: bool) {
        self.includes_disturbed = includes_disturbed;
    }

    /// CAD's parameters in the columns of the rows; zero for extra parameters.
    pub(crate) fn cad_of_unknowns(&self) -> Vec<f64> {
        let links = self.unknowns.links.iter();
        let of_links = links.map(|link| &self.cad[LINK_PARAMETERS * link..][..LINK_PARAMETERS]);
        let mut all: Vec<f64> = of_links.flatten().copied().collect();
        all.resize(self.unknowns.parameters(), 0.0);
        all
    }

    /// Measured minus predicted torque of every joint, for parameters `d` relative to CAD; NaN
    /// where there is no torque, or where a contact or an undeclared disturbance may act beyond the
    /// joint.
    ///
    /// # Errors
    /// The observation is of another robot, or a position, velocity or acceleration is not finite.
    pub(crate) fn torque_errors(
        &mut self,
        observation: &Annotated,
        d: &[f64],
    ) -> Result<Vec<f64>, DynamicsError> {
        self.move_to(observation)?;
        self.tree.update(&self.robot.model, &self.kinematics)?;
        let blocked = self.blocked(observation);
        let error = |dof: usize| {
            let Some(row) = self.tree.joint_row(dof).filter(|_| !blocked[dof]) else {
                return f64::NAN;
            };
            let links = self.unknowns.links.iter();
            let own = (links.zip(d.chunks_exact(LINK_PARAMETERS)))
                .map(|(link, d)| dot(&row[LINK_PARAMETERS * link..][..LINK_PARAMETERS], d));
            observation.torque[dof] - dot(row, &self.cad) - own.sum::<f64>()
        };
        Ok((0..self.robot.model.dof_count()).map(error).collect())
    }

    pub(crate) fn robot(&self) -> &'a Robot {
        self.robot
    }

    /// Runs `work` for each item, on all cores, with a copy of this model for each thread. Results
    /// are in the order of the items.
    pub(crate) fn map<I: Copy + Sync, T: Send>(
        &self,
        items: impl IntoIterator<Item = I>,
        work: impl Fn(&mut Self, I) -> T + Sync,
    ) -> Vec<T> {
        let items: Vec<I> = items.into_iter().collect();
        parallel::map_with(
            items.len(),
            || self.clone(),
            |own, number| work(own, items[number]),
        )
    }

    /// The rows of an observation. Sub-trees with a missing reading, missing torques, and sub-trees
    /// under an undeclared disturbance ([`Annotated::disturbed`]) have none, nor has an observation
    /// whose motion is not finite. (Its sizes are those of the robot.)
    pub(crate) fn rows(&mut self, observation: &Annotated) -> MeasurementRows {
        let rows = self.checked_rows(observation);
        rows.unwrap_or_else(|_| MeasurementRows::new(&self.unknowns))
    }

    /// The same; the error says why there are none.
    pub(crate) fn checked_rows(
        &mut self,
        observation: &Annotated,
    ) -> Result<MeasurementRows, DynamicsError> {
        let mut rows = MeasurementRows::new(&self.unknowns);
        self.move_to(observation)?;
        if self.wrench {
            self.wrench_rows(observation, &mut rows)?;
        }
        if self.torque {
            self.torque_rows(observation, &mut rows)?;
        }
        Ok(rows)
    }

    fn move_to(&mut self, observation: &Annotated) -> Result<(), DynamicsError> {
        self.kinematics
            .set_base(&self.robot.model, observation.base_link)?;
        let state = JointState {
            position: &observation.position,
            velocity: &observation.velocity,
            acceleration: &observation.acceleration,
        };
        self.kinematics
            .update(&self.robot.model, state, &observation.base)
    }

    /// Joints whose torque can be computed from either side: both have F/T sensors and no contacts.
    /// Returns the degree of freedom and the combination of the last rows (not whitened) that gives
    /// the difference of the two torques.
    pub(crate) fn two_routes(&self, rows: &MeasurementRows) -> Vec<(usize, DVector<f64>)> {
        let robot = self.robot;
        let mut routes = Vec::new();
        for (number, subtree) in self.stacked.subtrees().iter().enumerate() {
            let is_own = |row: &usize| rows.units[*row] == number;
            let own: Vec<usize> = (0..rows.count).filter(is_own).collect();
            if subtree.sensors().len() < 2 || !subtree.contacts().is_empty() || own.len() < 6 {
                continue;
            }
            // Rows are combinations of the six equations.
            let combined = Matrix6::from_fn(|row, equation| subtree.projection(row)[equation]);
            let Some(equations) = combined.try_inverse() else {
                continue;
            };
            for joint in robot.model.joints() {
                let inside = robot.structure.subtree_of(joint.child) == Some(number)
                    && joint.child != subtree.top();
                if let (Some(dof), true, Some(axis)) =
                    (joint.dof, inside, self.kinematics.joint_axis(joint))
                {
                    // The axis is given in the base; the equations are about the top link's origin
                    // in its axes.
                    let along = self.kinematics.pose(subtree.top()).inverse().twist(&axis);
                    let along = along.angular.iter().chain(&along.linear).copied();
                    let along = equations.tr_mul(&Vector6::from_iterator(along));
                    let mut all = DVector::zeros(rows.count);
                    let weights = own.iter().zip(along.iter());
                    weights.for_each(|(row, weight)| all[*row] = *weight);
                    routes.push((dof, all));
                }
            }
        }
        routes
    }

    /// The channels (places in the layout) that appear in rows of these sub-trees.
    pub(crate) fn channels_of(&self, set: &SubtreeSet) -> Vec<usize> {
        let (unknowns, subtrees) = (self.unknowns(), self.stacked.subtrees());
        let is_read = |sensor: usize| {
            let mut own = subtrees
                .iter()
                .enumerate()
                .filter(|(number, _)| set.contains(*number));
            own.any(|(_, subtree)| subtree.sensors().any(|other| other == sensor))
        };
        let sensors = (0..unknowns.sensors.len()).filter(|&place| is_read(unknowns.sensors[place]));
        let of_sensors = sensors.flat_map(|place| 6 * place..6 * place + 6);
        let of_joints = unknowns.wrenches()..unknowns.channels();
        of_sensors
            .chain(of_joints.filter(|_| set.contains(Observation::TORQUES)))
            .collect()
    }

    fn wrench_rows(
        &mut self,
        observation: &Annotated,
        rows: &mut MeasurementRows,
    ) -> Result<(), DynamicsError> {
        for (reading, given) in self.readings.iter_mut().zip(&observation.readings) {
            *reading = if given.is_finite() {
                *given
            } else {
                Wrench::zero()
            };
        }
        self.stacked
            .update(&self.kinematics, &self.readings, &observation.active, &[])?;
        for (unit, subtree) in self.stacked.subtrees().iter().enumerate() {
            let readings = &observation.readings;
            let unread = |sensor: usize| readings.get(sensor).is_none_or(|r| !r.is_finite());
            let is_disturbed = !self.includes_disturbed && observation.disturbed.contains(unit);
            if is_disturbed || subtree.sensors().len() == 0 || subtree.sensors().any(unread) {
                continue;
            }
            for number in 0..subtree.remaining() {
                let from = subtree.projected_row(number);
                let (links, offsets) = from.split_at(subtree.offset_column());
                let (a, r, g, n) = rows.push(unit);
                *r = subtree.projected_measured()[number];
                for (values, link) in links.chunks_exact(LINK_PARAMETERS).zip(subtree.links()) {
                    let cad = &self.cad[LINK_PARAMETERS * link..][..LINK_PARAMETERS];
                    *r -= values.iter().zip(cad).map(|(x, y)| x * y).sum::<f64>();
                    if let Ok(place) = self.unknowns.links.binary_search(link) {
                        a[LINK_PARAMETERS * place..][..LINK_PARAMETERS].copy_from_slice(values);
                    }
                }
                for (values, sensor) in offsets.chunks_exact(6).zip(subtree.sensors()) {
                    if let Ok(place) = self.unknowns.sensors.binary_search(&sensor) {
                        g[6 * place..][..6].copy_from_slice(values);
                        n[6 * place..][..6].copy_from_slice(values);
                    }
                    for (column, entry) in self.calibration(observation, sensor, values) {
                        a[column] = entry;
                    }
                }
            }
        }
        Ok(())
    }

    fn torque_rows(
        &mut self,
        observation: &Annotated,
        rows: &mut MeasurementRows,
    ) -> Result<(), DynamicsError> {
        if !self.includes_disturbed && observation.disturbed.contains(Observation::TORQUES) {
            return Ok(());
        }
        self.tree.update(&self.robot.model, &self.kinematics)?;
        let wrenches = self.unknowns.sensors.len();
        let blocked = self.blocked(observation);
        for (place, &dof) in self.unknowns.joints.iter().enumerate() {
            let torque = observation.torque.get(dof).copied().unwrap_or(f64::NAN);
            let Some(row) = self.tree.joint_row(dof) else {
                continue;
            };
            if !torque.is_finite() || blocked[dof] {
                continue;
            }
            let (a, r, g, n) = rows.push(Observation::TORQUES);
            *r = torque - row.iter().zip(&self.cad).map(|(x, y)| x * y).sum::<f64>();
            let places = a.chunks_exact_mut(LINK_PARAMETERS);
            for (to, link) in places.zip(&self.unknowns.links) {
                to.copy_from_slice(&row[LINK_PARAMETERS * link..][..LINK_PARAMETERS]);
            }
            if let Some(column) = self.unknowns.column(ExtraParameter::RotorInertia(dof)) {
                a[column] = observation.acceleration[dof];
            }
            let velocity = observation.velocity[dof];
            g[6 * wrenches + FRICTION * place..][..FRICTION]
                .copy_from_slice(&friction_row(velocity));
            n[6 * wrenches + place] = 1.0;
        }
        Ok(())
    }

    /// Per degree of freedom, whether a present contact lies beyond its joint, seen from the base:
    /// the joint is on the path from the contact's link to the base. A disturbed sub-tree counts
    /// with all its links, since the link of the contact is unknown.
    fn blocked(&self, observation: &Annotated) -> Vec<bool> {
        let structure = &self.robot.structure;
        let declared = observation
            .active
            .iter()
            .filter_map(|contact| structure.contacts().get(contact));
        let mut touched: Vec<usize> = declared.map(|spec| spec.frame.link).collect();
        if !self.includes_disturbed {
            let subtrees = observation
                .disturbed
                .iter()
                .filter(|unit| *unit < structure.subtrees().len());
            touched.extend(subtrees.flat_map(|unit| structure.links_of(unit)));
        }
        is_between(&self.robot.model, self.kinematics.base(), &touched)
    }
}
