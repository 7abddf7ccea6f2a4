//! The rows of one instant: what its measurements say of the links' parameters and of the log's own unknowns, and through which noise.
//!
//! ```text
//! A d + G s = r + N e
//! ```
//!
//! - `d = phi - phi_CAD`: ten per link that any log can see ([`Layout::links`]), then whatever else belongs to the robot and not to a log ([`Layout::further`]);
//! - `s`: the log's own unknowns: six offsets [torque; force] per F/T sensor that shows in a row; Coulomb, viscous and offset torque per joint whose torque is measured;
//! - `r`: what was measured less what CAD predicts;
//! - `e`: the noise of the *channels*, independent of each other: six per F/T sensor, one per joint torque.
//!
//! Two kinds of rows, one below the other. Those of F/T sensors are the balances of sub-trees, of which [`StackedRegressor::eliminate_contacts`] leaves the combinations that no present
//! contact reaches: noise enters them as offsets do, `N = G`. Those of joint torques are rows of the whole tree's [`Regressor`], for joints beyond which, seen from the base, nothing touches
//! the robot: there `N = 1` and `G = [tanh(dq / v0), dq, 1]`. If torques are measured at the motors' side, `A` has the joint's acceleration beside them: it times the inertia of the motor's rotor.
//!
//! Where calibrations of F/T sensors are unknown, too ([`crate::calibration`]), so that a sensor measures `(1 + E) r - k (T - T0) - o`, `A` has columns of `E` and `k` beside those that `G` has of `o`: times
//! `-r`, or the temperature. There `r` is what the sensor would have read without noise, by an earlier fit ([`Instant::fitted`]). For with the noise in it, a gain of nothing and bodies without mass
//! would leave nothing of any row: mass and gain grow together, so that only priors would speak against it, and noise, of which there is the more the longer a log is, for it.

use super::gate::UnitSet;
use super::instants::Instant;
use super::{dot, factorise, forward};
use crate::calibration::{Kind, Unknown};
use crate::config::{IdentificationInput, TorqueSide};
use crate::dynamics::{DynamicsError, JointState, Kinematics, Structure};
use crate::regressor::{Regressor, StackedRegressor, Weighting};
use crate::setup::Setup;
use crate::spatial::{Motion, Vec3, Wrench};
use nalgebra::{DVector, Matrix6, Vector6};

/// Speed over which the sign of Coulomb friction is smoothed [rad/s or m/s].
pub(super) const COULOMB_SPEED: f64 = 0.02;

/// Parameters of a link.
pub(super) const WIDTH: usize = 10;

/// Friction columns of a joint.
pub(super) const FRICTION: usize = 3;

/// Precision of the prior of a rotor's inertia about zero [1/(kg m^2)^2]: none is known to be larger than a hundred.
const ROTOR_PRECISION: f64 = 1e-4;

/// An unknown of the robot beside its links' parameters: one column of `A`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Further {
    /// Inertia of the rotor that drives a degree of freedom, reflected to it: rotor inertia times the square of the gear ratio [kg m^2, kg].
    RotorInertia(usize),
    /// What is wrong with the calibration of an F/T sensor, by its number.
    Calibration(usize, Unknown),
}

/// Precision of the prior of a reading's change per kelvin about zero [1/(N/K)^2, 1/(Nm/K)^2]: none is known to be larger than ten.
const TEMPERATURE_PRECISION: f64 = 1e-2;

impl Further {
    /// Precision of its Gaussian prior about zero. Of a gain: as [`crate::config::Identification::gain_std`] says, whatever the units.
    fn precision(self, setup: &Setup) -> f64 {
        match self {
            Self::RotorInertia(_) => ROTOR_PRECISION,
            Self::Calibration(_, Unknown::Temperature { .. }) => TEMPERATURE_PRECISION,
            Self::Calibration(sensor, Unknown::Gain { channel, of }) => {
                let noise = setup.structure.sensors()[sensor].noise();
                let norm = |three: [f64; 3]| Vec3::from(three).norm();
                let length = norm(noise.torque) / norm(noise.force);
                let unit = match (channel < 3, of < 3) {
                    (true, false) => length,
                    (false, true) => 1.0 / length,
                    _ => 1.0,
                };
                (setup.gain_deviation * unit).powi(-2)
            }
        }
    }

    /// Whether CAD says nothing of it, rather than that it is zero: then CAD is compared with the value that goes best with its bodies.
    pub(super) fn lacks_cad(self) -> bool {
        match self {
            Self::RotorInertia(_) => true,
            // The workbench's calibration is right, as far as CAD knows.
            Self::Calibration(..) => false,
        }
    }
}

/// What the columns of all rows stand for.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Layout {
    /// Links that show in at least one row, ascending; ten columns of `A` each.
    pub links: Vec<usize>,
    /// What else of the robot shows in at least one row: a column of `A` each, after those of the links.
    pub further: Vec<Further>,
    /// Precision of the prior of each of these, for [`super::prior::Posterior`].
    pub precision: Vec<f64>,
    /// F/T sensors that do, ascending; six columns of `G` and of `N` each, [torque; force].
    pub sensors: Vec<usize>,
    /// Degrees of freedom whose measured torque is used, ascending; three columns of `G` after those of the sensors, and one of `N`.
    pub joints: Vec<usize>,
}

impl Layout {
    /// Number of the links' unknown parameters: of the first columns of `A`.
    pub(super) fn inertial(&self) -> usize {
        WIDTH * self.links.len()
    }

    /// Number of the robot's unknowns: of columns of `A`.
    pub(super) fn unknowns(&self) -> usize {
        self.inertial() + self.further.len()
    }

    /// The column of a further unknown, if it shows.
    pub(super) fn column(&self, further: Further) -> Option<usize> {
        let place = self.further.iter().position(|own| *own == further)?;
        Some(self.inertial() + place)
    }

    /// Columns of the unknowns of which CAD says nothing.
    pub(super) fn beside_cad(&self) -> Vec<usize> {
        let each = self.further.iter().zip(self.inertial()..);
        each.filter(|(further, _)| further.lacks_cad())
            .map(|(_, column)| column)
            .collect()
    }

    /// Number of the log's own unknowns.
    pub(super) fn session(&self) -> usize {
        6 * self.sensors.len() + FRICTION * self.joints.len()
    }

    /// Number of channels.
    pub(super) fn channels(&self) -> usize {
        6 * self.sensors.len() + self.joints.len()
    }

    /// What turns a channel's unit into Nm.
    pub(super) fn scale(&self, channel: usize) -> f64 {
        if channel < 6 * self.sensors.len() && channel % 6 >= 3 {
            Structure::LENGTH_SCALE
        } else {
            1.0
        }
    }

    /// Deviations of the channels of F/T sensors, as stated.
    pub(super) fn stated<'a>(&'a self, setup: &'a Setup) -> impl Iterator<Item = f64> + 'a {
        self.sensors.iter().flat_map(|&sensor| {
            let noise = setup.structure.sensors()[sensor].noise();
            noise.torque.into_iter().chain(noise.force)
        })
    }

    /// The session's unknown that a channel's offset is.
    pub(super) fn offset_of(&self, channel: usize) -> usize {
        let wrenches = 6 * self.sensors.len();
        if channel < wrenches {
            channel
        } else {
            wrenches + FRICTION * (channel - wrenches) + 2
        }
    }
}

/// Rows of one instant; reusable room.
#[derive(Clone, Debug, Default)]
pub(super) struct Rows {
    pub count: usize,
    unknowns: usize,
    session: usize,
    channels: usize,
    a: Vec<f64>,
    r: Vec<f64>,
    g: Vec<f64>,
    n: Vec<f64>,
    /// Per row, which unit's it is: a sub-tree's, or [`Instant::TORQUES`].
    units: Vec<usize>,
    /// Lower factor of `N V N^T`, row by row, once whitened.
    factor: Vec<f64>,
}

impl Rows {
    pub(super) fn new(layout: &Layout) -> Self {
        Self {
            unknowns: layout.unknowns(),
            session: layout.session(),
            channels: layout.channels(),
            ..Self::default()
        }
    }

    pub(super) fn clear(&mut self) {
        self.count = 0;
        self.units.clear();
        for part in [&mut self.a, &mut self.r, &mut self.g, &mut self.n, &mut self.factor] {
            part.clear();
        }
    }

    /// Another row of a unit, of zeros.
    fn push(&mut self, unit: usize) -> (&mut [f64], &mut f64, &mut [f64], &mut [f64]) {
        self.count += 1;
        self.units.push(unit);
        self.a.resize(self.unknowns * self.count, 0.0);
        self.r.push(0.0);
        self.g.resize(self.session * self.count, 0.0);
        self.n.resize(self.channels * self.count, 0.0);
        let last = self.count - 1;
        (
            &mut self.a[self.unknowns * last..],
            &mut self.r[last],
            &mut self.g[self.session * last..],
            &mut self.n[self.channels * last..],
        )
    }

    /// Puts the rows of one unit into `out`, not whitened.
    pub(super) fn copy_unit(&self, unit: usize, out: &mut Self) {
        out.clear();
        for row in (0..self.count).filter(|&row| self.units[row] == unit) {
            let (a, r, g, n) = out.push(unit);
            a.copy_from_slice(self.a(row));
            *r = self.r(row);
            g.copy_from_slice(self.g(row));
            n.copy_from_slice(self.n(row));
        }
    }

    pub(super) fn a(&self, row: usize) -> &[f64] {
        &self.a[self.unknowns * row..][..self.unknowns]
    }

    pub(super) fn r(&self, row: usize) -> f64 {
        self.r[row]
    }

    pub(super) fn g(&self, row: usize) -> &[f64] {
        &self.g[self.session * row..][..self.session]
    }

    pub(super) fn n(&self, row: usize) -> &[f64] {
        &self.n[self.channels * row..][..self.channels]
    }

    /// Makes the noise of the rows independent and of unit variance, given the variances of the channels: `A`, `r`, `G` become `L^-1 A` ..., with
    /// `L L^T = N diag(v) N^T`. Combinations that no channel's noise reaches get a floor, 1e-9 of the greatest variance, in place of certainty. `N` is left as it is.
    pub(super) fn whiten(&mut self, variances: &[f64]) {
        self.whiten_with(variances, &mut [], 0);
    }

    /// The same, and of further columns, `width` numbers for each row.
    pub(super) fn whiten_with(&mut self, variances: &[f64], further: &mut [f64], width: usize) {
        let m = self.count;
        self.factor.clear();
        self.factor.resize(m * m, 0.0);
        for i in 0..m {
            for j in 0..=i {
                let pairs = self.n(i).iter().zip(self.n(j)).zip(variances);
                let sum: f64 = pairs.map(|((x, y), v)| x * y * v).sum();
                self.factor[i * m + j] = sum;
            }
        }
        factorise(&mut self.factor, m);
        for (values, count) in [
            (&mut self.a, self.unknowns),
            (&mut self.r, 1),
            (&mut self.g, self.session),
        ] {
            forward(&self.factor, m, values, count);
        }
        if width > 0 {
            forward(&self.factor, m, further, width);
        }
    }

    /// The most likely noise of each channel, given whitened residuals of all rows: `diag(v) N^T W^-1 rho` (Gauss, Markov); zero where no row has it.
    pub(super) fn channel_noise(&self, variances: &[f64], whitened: &mut [f64], out: &mut [f64]) {
        let m = self.count;
        for i in (0..m).rev() {
            let below: f64 = (i + 1..m).map(|k| self.factor[k * m + i] * whitened[k]).sum();
            whitened[i] = (whitened[i] - below) / self.factor[i * m + i];
        }
        out.fill(0.0);
        for (row, weight) in whitened.iter().enumerate() {
            for (sum, entry) in out.iter_mut().zip(self.n(row)) {
                *sum += weight * entry;
            }
        }
        for (value, variance) in out.iter_mut().zip(variances) {
            *value *= variance;
        }
    }

    /// Adds `diag(v) N^T W^-1 N` to `sum`, channels by channels, row by row: how [`Rows::channel_noise`] shares what the rows show among the channels. Its diagonal is the share of each channel's
    /// variance that its most likely noise has, `(v - posterior variance) / v`: one if the rows tell the channel from all others, less where they only show it mixed with others.
    pub(super) fn add_shares(&self, variances: &[f64], sum: &mut [f64]) {
        let (m, channels) = (self.count, self.channels);
        let mut white = self.n.clone();
        forward(&self.factor, m, &mut white, channels);
        for row in white.chunks_exact(channels.max(1)) {
            for ((own, variance), sums) in row.iter().zip(variances).zip(sum.chunks_exact_mut(channels)) {
                if *own != 0.0 {
                    let weight = own * variance;
                    sums.iter_mut().zip(row).for_each(|(sum, other)| *sum += weight * other);
                }
            }
        }
    }

    /// The joint whose torque a row is of, if it is of one's; `offsets`: channels before those of joints.
    pub(super) fn joint(&self, row: usize, offsets: usize) -> Option<usize> {
        self.n(row)[offsets..].iter().position(|entry| *entry != 0.0)
    }

    /// Whether any row has this channel's noise.
    pub(super) fn has(&self, channel: usize) -> bool {
        (0..self.count).any(|row| self.n(row)[channel] != 0.0)
    }
}

/// What Coulomb and viscous friction and the offset of a joint's torque are multiplied by in it.
pub(super) fn friction_row(velocity: f64) -> [f64; FRICTION] {
    [(velocity / COULOMB_SPEED).tanh(), velocity, 1.0]
}

/// What a sub-tree needs for a motion that its encoders do not show: [torque; force], zero where nothing is known of any.
fn shaking_of(instant: &Instant, subtree: usize) -> [f64; 6] {
    let known = instant.shaking.iter().find(|(number, _)| *number == subtree);
    known.map_or([0.0; 6], |(_, wrench)| wrench.torque_first())
}

/// The representative of a node's set.
fn root_of(parent: &mut [usize], mut node: usize) -> usize {
    while parent[node] != node {
        parent[node] = parent[parent[node]];
        node = parent[node];
    }
    node
}

/// Of each unknown and channel, the number of the group that it belongs to: no row has two groups.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Groups {
    /// Per link of the layout.
    pub links: Vec<usize>,
    /// Per further unknown.
    pub further: Vec<usize>,
    /// Per channel.
    pub channels: Vec<usize>,
}

/// Makes rows of instants.
#[derive(Clone)]
pub(super) struct RowMaker<'a> {
    setup: &'a Setup,
    layout: Layout,
    /// CAD's parameters of all links.
    cad: Vec<f64>,
    kinematics: Kinematics,
    stacked: StackedRegressor,
    tree: Regressor,
    readings: Vec<Wrench>,
    /// Per sensor, what is unknown of its calibration: columns of `A`.
    calibrations: Vec<Vec<(usize, Unknown)>>,
    /// Per sensor, the temperature from which its change per kelvin counts \[degrees Celsius\]; NaN if none was recorded.
    references: Vec<f64>,
    wrench: bool,
    torque: bool,
    /// Whether rows are made of units that something undeclared acts on, too.
    disregards: bool,
    groups: Groups,
}

impl<'a> RowMaker<'a> {
    /// For these measurements; what the columns stand for is what shows in any of `instants`.
    ///
    /// # Errors
    /// Instants of another robot.
    pub(super) fn survey<'b>(
        setup: &'a Setup,
        inputs: &[IdentificationInput],
        instants: impl Iterator<Item = &'b Instant>,
    ) -> Result<Self, DynamicsError> {
        let (links, sensors) = (setup.model.link_count(), setup.structure.sensors().len());
        let (wrench, torque) = (
            inputs.contains(&IdentificationInput::Wrench),
            inputs.contains(&IdentificationInput::Torque),
        );
        let dofs = 0..setup.model.dof_count();
        let has_rotors = torque && setup.torque_side == TorqueSide::Motor;
        let further: Vec<Further> = if has_rotors {
            dofs.clone().map(Further::RotorInertia).collect()
        } else {
            Vec::new()
        };
        let all = Layout {
            links: (0..links).collect(),
            precision: further.iter().map(|further| further.precision(setup)).collect(),
            further,
            sensors: (0..sensors).collect(),
            joints: dofs.collect(),
        };
        let mut maker = Self {
            setup,
            layout: all,
            cad: setup
                .model
                .inertias()
                .iter()
                .flat_map(crate::spatial::RigidInertia::parameters)
                .collect(),
            kinematics: Kinematics::new(&setup.model, setup.base_link)?,
            stacked: StackedRegressor::new(&setup.structure),
            tree: Regressor::new(&setup.model),
            readings: vec![Wrench::zero(); sensors],
            calibrations: vec![Vec::new(); sensors],
            references: vec![f64::NAN; sensors],
            wrench,
            torque,
            disregards: false,
            groups: Groups::default(),
        };
        // Links, further unknowns and channels, joined wherever a row has both.
        let (channels, unknowns) = (maker.layout.channels(), links + maker.layout.further.len());
        let mut parent: Vec<usize> = (0..unknowns + channels).collect();
        let mut rows = Rows::new(&maker.layout);
        let (mut seen, mut heard) = (vec![false; unknowns], vec![false; channels]);
        for instant in instants {
            maker.make(instant, &mut rows)?;
            for row in 0..rows.count {
                let mut first = None;
                let mut join = |node: usize| {
                    let own = root_of(&mut parent, node);
                    let with = root_of(&mut parent, *first.get_or_insert(own));
                    parent[own.max(with)] = own.min(with);
                };
                let (of_links, of_further) = rows.a(row).split_at(WIDTH * links);
                let columns = of_links.chunks_exact(WIDTH).chain(of_further.chunks_exact(1));
                for (node, (seen, columns)) in seen.iter_mut().zip(columns).enumerate() {
                    if columns.iter().any(|x| *x != 0.0) {
                        *seen = true;
                        join(node);
                    }
                }
                for (channel, (heard, entry)) in heard.iter_mut().zip(rows.n(row)).enumerate() {
                    if *entry != 0.0 {
                        *heard = true;
                        join(unknowns + channel);
                    }
                }
            }
        }
        let numbers = |flags: &[bool]| (0..flags.len()).filter(|&i| flags[i]).collect();
        let (wrenches, torques) = heard.split_at(6 * sensors);
        let sensing: Vec<bool> = wrenches.chunks(6).map(|six| six.contains(&true)).collect();
        let (seen, shows) = seen.split_at(links);
        let shown: Vec<usize> = numbers(shows);
        maker.layout = Layout {
            links: numbers(seen),
            further: shown.iter().map(|&place| maker.layout.further[place]).collect(),
            precision: shown.iter().map(|&place| maker.layout.precision[place]).collect(),
            sensors: numbers(&sensing),
            joints: numbers(torques),
        };
        let layout = &maker.layout;
        let wrench_channels = layout.sensors.iter().flat_map(|s| 6 * s..6 * s + 6);
        let channels: Vec<usize> = wrench_channels
            .chain(layout.joints.iter().map(|j| 6 * sensors + j))
            .collect();
        let mut groups_of =
            |nodes: &mut dyn Iterator<Item = usize>| nodes.map(|node| root_of(&mut parent, node)).collect();
        maker.groups = Groups {
            links: groups_of(&mut layout.links.iter().copied()),
            further: groups_of(&mut shown.into_iter().map(|place| links + place)),
            channels: groups_of(&mut channels.into_iter().map(|channel| unknowns + channel)),
        };
        Ok(maker)
    }

    /// From now on this of the calibrations of the sensors that show is unknown, too, and nothing else of them. Of a gain all of a sensor's entries; a change per kelvin where its temperature changed in these instants. The
    /// temperature from which that counts is the configured one, else the mean.
    pub(super) fn calibrate<'b>(&mut self, wanted: Kind, instants: impl Iterator<Item = &'b Instant>) {
        /// A board whose temperature varies less tells nothing [K].
        const LEAST: f64 = 0.1;
        let setup = self.setup;
        // They come last.
        let others = self.layout.further.iter();
        let others = others
            .filter(|further| !matches!(further, Further::Calibration(..)))
            .count();
        self.layout.further.truncate(others);
        self.layout.precision.truncate(others);
        self.groups.further.truncate(others);
        self.calibrations.iter_mut().for_each(Vec::clear);
        let mut temperatures = vec![Vec::new(); self.references.len()];
        for instant in instants {
            let measured = temperatures.iter_mut().zip(&instant.temperatures);
            for (own, celsius) in measured.filter(|(_, celsius)| celsius.is_finite()) {
                own.push(*celsius);
            }
        }
        for (place, &sensor) in self.layout.sensors.iter().enumerate() {
            let own = &temperatures[sensor];
            let (low, high) = own
                .iter()
                .fold((f64::MAX, f64::MIN), |(low, high), x| (low.min(*x), high.max(*x)));
            let mean = own.iter().sum::<f64>() / own.len() as f64;
            self.references[sensor] = setup.calibrations[sensor].reference().unwrap_or(mean);
            let kind = Kind {
                temperature: wanted.temperature && high - low > LEAST,
                ..wanted
            };
            for unknown in kind.unknowns() {
                let further = Further::Calibration(sensor, unknown);
                self.calibrations[sensor].push((WIDTH * self.layout.links.len() + self.layout.further.len(), unknown));
                self.layout.further.push(further);
                self.layout.precision.push(further.precision(setup));
                self.groups.further.push(self.groups.channels[6 * place]);
            }
        }
    }

    /// The temperature from which a sensor's change per kelvin counts \[degrees Celsius\], if one was recorded or configured.
    pub(super) fn reference(&self, sensor: usize) -> Option<f64> {
        self.references
            .get(sensor)
            .copied()
            .filter(|celsius| celsius.is_finite())
    }

    /// Columns that a sensor's calibration has in a row, and their entries, where its offset has `values` in it: an unknown of the calibration is as an offset of so much as is read.
    fn calibration<'b>(
        &'b self,
        instant: &'b Instant,
        sensor: usize,
        values: &'b [f64],
    ) -> impl Iterator<Item = (usize, f64)> + 'b {
        let celsius = instant.temperatures.get(sensor).copied().unwrap_or(f64::NAN);
        let kelvin = Some(celsius - self.references[sensor]).filter(|kelvin| kelvin.is_finite());
        let fitted = instant.fitted.get(sensor).filter(|fitted| fitted.is_finite());
        let corrected = fitted.unwrap_or(&self.readings[sensor]).torque_first();
        self.calibrations[sensor].iter().map(move |&(column, unknown)| {
            let as_offset = unknown.as_offset(&corrected, kelvin.unwrap_or(0.0));
            (column, values[unknown.channel()] * as_offset)
        })
    }

    pub(super) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Groups of unknowns and channels: no row has two groups.
    pub(super) fn groups(&self) -> &Groups {
        &self.groups
    }

    /// From now on rows are made of [`Instant::suspected`] units, too; or not any more.
    pub(super) fn disregard_suspicions(&mut self, disregards: bool) {
        self.disregards = disregards;
    }

    /// CAD's parameters in the columns of the rows; zero of further unknowns.
    pub(super) fn cad_of_layout(&self) -> Vec<f64> {
        let links = self.layout.links.iter();
        let of_links = links.flat_map(|link| self.cad[WIDTH * link..][..WIDTH].iter().copied());
        of_links.chain(self.layout.further.iter().map(|_| 0.0)).collect()
    }

    /// Measured less predicted torque of every joint, for parameters `d` beside CAD; NaN where there is none, a contact lies beyond, or
    /// something undeclared may act beyond.
    ///
    /// # Errors
    /// As for [`RowMaker::make`].
    pub(super) fn torque_errors(&mut self, instant: &Instant, d: &[f64]) -> Result<Vec<f64>, DynamicsError> {
        let mut rows = Rows::new(&self.layout);
        self.make(instant, &mut rows)?;
        self.tree.update(&self.setup.model, &self.kinematics)?;
        let blocked = self.blocked(instant);
        let error = |dof: usize| {
            let Some(row) = self.tree.joint_row(dof).filter(|_| !blocked[dof]) else {
                return f64::NAN;
            };
            let own = self
                .layout
                .links
                .iter()
                .enumerate()
                .map(|(place, link)| dot(&row[WIDTH * link..][..WIDTH], &d[WIDTH * place..][..WIDTH]));
            instant.torque[dof] - dot(row, &self.cad) - own.sum::<f64>()
        };
        Ok((0..self.setup.model.dof_count()).map(error).collect())
    }

    pub(super) fn setup(&self) -> &'a Setup {
        self.setup
    }

    /// The rows of an instant. Sub-trees with a reading that is not there, torques that are not, and what something undeclared acts on ([`Instant::suspected`]) give none.
    ///
    /// # Errors
    /// The instant is of another robot, or a position, velocity or acceleration is not finite.
    pub(super) fn make(&mut self, instant: &Instant, rows: &mut Rows) -> Result<(), DynamicsError> {
        rows.clear();
        if instant.base_link != self.kinematics.base() {
            self.kinematics.set_base(&self.setup.model, instant.base_link)?;
        }
        let state = JointState {
            position: &instant.position,
            velocity: &instant.velocity,
            acceleration: &instant.acceleration,
        };
        self.kinematics.update(&self.setup.model, state, &instant.base)?;
        if self.wrench {
            self.wrench_rows(instant, rows)?;
        }
        if self.torque {
            self.torque_rows(instant, rows)?;
        }
        Ok(())
    }

    /// Joints whose torque two sides tell, each with F/T sensors and without contacts: the degree of
    /// freedom, and the combination of these rows (not whitened), made last, that is how far the two
    /// are apart.
    pub(super) fn two_routes(&self, rows: &Rows) -> Vec<(usize, DVector<f64>)> {
        let setup = self.setup;
        let mut routes = Vec::new();
        for (number, subtree) in self.stacked.subtrees().iter().enumerate() {
            let own: Vec<usize> = (0..rows.count).filter(|&row| rows.units[row] == number).collect();
            if subtree.sensors().len() < 2 || !subtree.contacts().is_empty() || own.len() < 6 {
                continue;
            }
            // Rows are combinations of the six equations.
            let combined = Matrix6::from_fn(|row, equation| subtree.projection(row)[equation]);
            let Some(equations) = combined.try_inverse() else {
                continue;
            };
            for joint in setup.model.joints() {
                let inside = setup.structure.subtree_of(joint.child) == Some(number) && joint.child != subtree.top();
                if let (Some(dof), true, Some(axis)) = (joint.dof, inside, self.kinematics.joint_axis(joint)) {
                    // The axis is in the base, equations are about the top link's origin in its axes.
                    let along = self.kinematics.pose(subtree.top()).inverse().twist(&axis);
                    let along = Vector6::from_iterator(along.angular.iter().chain(&along.linear).copied());
                    let along = equations.tr_mul(&along);
                    let mut all = DVector::zeros(rows.count);
                    own.iter()
                        .zip(along.iter())
                        .for_each(|(row, weight)| all[*row] = *weight);
                    routes.push((dof, all));
                }
            }
        }
        routes
    }

    /// What a sub-tree needs for its motion less what its sensors measure, for these parameters and the log's own unknowns, after [`RowMaker::make`]: about its top link's origin, in that link's
    /// axes. None if a sensor was not read, or an unknown contact touches it.
    pub(super) fn balance(&self, instant: &Instant, d: &[f64], session: &[f64], number: usize) -> Option<Wrench> {
        let subtree = self.stacked.subtrees().get(number)?;
        let unread = |sensor: usize| instant.readings.get(sensor).is_none_or(|r| !r.is_finite());
        let is_suspected = !self.disregards && instant.suspected.contains(number);
        if is_suspected
            || subtree.sensors().len() == 0
            || subtree.sensors().any(unread)
            || !subtree.contacts().is_empty()
        {
            return None;
        }
        let mut b = shaking_of(instant, number);
        for (row, sum) in b.iter_mut().enumerate() {
            let (links, offsets) = subtree.row(row).split_at(subtree.offset_column());
            for (values, link) in links.chunks_exact(WIDTH).zip(subtree.links()) {
                *sum += dot(values, &self.cad[WIDTH * link..][..WIDTH]);
                if let Ok(place) = self.layout.links.binary_search(link) {
                    *sum += dot(values, &d[WIDTH * place..][..WIDTH]);
                }
            }
            for (values, sensor) in offsets.chunks_exact(6).zip(subtree.sensors()) {
                if let Ok(place) = self.layout.sensors.binary_search(&sensor) {
                    *sum += dot(values, &session[6 * place..][..6]);
                }
                *sum += self
                    .calibration(instant, sensor, values)
                    .map(|(column, entry)| entry * d[column])
                    .sum::<f64>();
            }
            *sum -= subtree.measured()[row];
        }
        Some(Wrench {
            torque: Vec3::new(b[0], b[1], b[2]),
            force: Vec3::new(b[3], b[4], b[5]),
        })
    }

    /// The sensors around each sub-tree.
    pub(super) fn sensors_of_subtrees(&self) -> Vec<Vec<usize>> {
        let each = self.stacked.subtrees().iter();
        each.map(|subtree| subtree.sensors().collect()).collect()
    }

    /// The layout's channels that rows of these units have.
    pub(super) fn channels_of(&self, units: &UnitSet) -> Vec<usize> {
        let (layout, subtrees) = (self.layout(), self.stacked.subtrees());
        let is_read = |sensor: usize| {
            let mut own = subtrees
                .iter()
                .enumerate()
                .filter(|(number, _)| units.contains(*number));
            own.any(|(_, subtree)| subtree.sensors().any(|other| other == sensor))
        };
        let sensors = (0..layout.sensors.len()).filter(|&place| is_read(layout.sensors[place]));
        let of_sensors = sensors.flat_map(|place| 6 * place..6 * place + 6);
        let of_joints = 6 * layout.sensors.len()..layout.channels();
        of_sensors
            .chain(of_joints.filter(|_| units.contains(Instant::TORQUES)))
            .collect()
    }

    /// What a sub-tree needs for accelerating as if its joints were locked, by CAD, after [`RowMaker::make`]: for a unit of each of [angular; linear], about its top link's origin and in that
    /// link's axes, the wrench.
    pub(super) fn inertia_of_subtree(&self, number: usize) -> Option<[Wrench; 6]> {
        let subtree = self.stacked.subtrees().get(number)?;
        let to_top = self.kinematics.pose(subtree.top()).inverse();
        let mut wrenches = [Wrench::zero(); 6];
        for &link in subtree.links() {
            let body = self.setup.model.inertias()[link].transformed(&(to_top * *self.kinematics.pose(link)));
            for (k, sum) in wrenches.iter_mut().enumerate() {
                let unit = |first: usize| Vec3::from_fn(|i, _| f64::from(u8::from(first + i == k)));
                *sum += body.momentum(&Motion {
                    angular: unit(0),
                    linear: unit(3),
                });
            }
        }
        Some(wrenches)
    }

    fn wrench_rows(&mut self, instant: &Instant, rows: &mut Rows) -> Result<(), DynamicsError> {
        for (reading, given) in self.readings.iter_mut().zip(&instant.readings) {
            *reading = if given.is_finite() { *given } else { Wrench::zero() };
        }
        self.stacked
            .update(&self.kinematics, &self.readings, &instant.active, &[])?;
        self.stacked.eliminate_contacts(Weighting::Noise);
        for (unit, subtree) in self.stacked.subtrees().iter().enumerate() {
            let unread = |sensor: usize| instant.readings.get(sensor).is_none_or(|r| !r.is_finite());
            let is_suspected = !self.disregards && instant.suspected.contains(unit);
            if is_suspected || subtree.sensors().len() == 0 || subtree.sensors().any(unread) {
                continue;
            }
            let shaking = shaking_of(instant, unit);
            for number in 0..subtree.remaining() {
                let from = subtree.projected_row(number);
                let (links, offsets) = from.split_at(subtree.offset_column());
                let (a, r, g, n) = rows.push(unit);
                *r = subtree.projected_measured()[number] - dot(subtree.projection(number), &shaking);
                for (values, link) in links.chunks_exact(WIDTH).zip(subtree.links()) {
                    let cad = &self.cad[WIDTH * link..][..WIDTH];
                    *r -= values.iter().zip(cad).map(|(x, y)| x * y).sum::<f64>();
                    if let Ok(place) = self.layout.links.binary_search(link) {
                        a[WIDTH * place..][..WIDTH].copy_from_slice(values);
                    }
                }
                for (values, sensor) in offsets.chunks_exact(6).zip(subtree.sensors()) {
                    if let Ok(place) = self.layout.sensors.binary_search(&sensor) {
                        g[6 * place..][..6].copy_from_slice(values);
                        n[6 * place..][..6].copy_from_slice(values);
                    }
                    for (column, entry) in self.calibration(instant, sensor, values) {
                        a[column] = entry;
                    }
                }
            }
        }
        Ok(())
    }

    fn torque_rows(&mut self, instant: &Instant, rows: &mut Rows) -> Result<(), DynamicsError> {
        if !self.disregards && instant.suspected.contains(Instant::TORQUES) {
            return Ok(());
        }
        self.tree.update(&self.setup.model, &self.kinematics)?;
        let wrenches = self.layout.sensors.len();
        let blocked = self.blocked(instant);
        for (place, &dof) in self.layout.joints.iter().enumerate() {
            let torque = instant.torque.get(dof).copied().unwrap_or(f64::NAN);
            let Some(row) = self.tree.joint_row(dof) else { continue };
            if !torque.is_finite() || blocked[dof] {
                continue;
            }
            let (a, r, g, n) = rows.push(Instant::TORQUES);
            *r = torque - row.iter().zip(&self.cad).map(|(x, y)| x * y).sum::<f64>();
            for (to, link) in a.chunks_exact_mut(WIDTH).zip(&self.layout.links) {
                to.copy_from_slice(&row[WIDTH * link..][..WIDTH]);
            }
            if let Some(column) = self.layout.column(Further::RotorInertia(dof)) {
                a[column] = instant.acceleration[dof];
            }
            let velocity = instant.velocity[dof];
            g[6 * wrenches + FRICTION * place..][..FRICTION].copy_from_slice(&friction_row(velocity));
            n[6 * wrenches + place] = 1.0;
        }
        Ok(())
    }

    /// Per degree of freedom, whether a present contact lies beyond its joint, seen from the base: on the way from that contact's link to the base. Where something undeclared acts on a sub-tree,
    /// nobody knows on which of its links: it may be any.
    fn blocked(&self, instant: &Instant) -> Vec<bool> {
        let model = &self.setup.model;
        let mut blocked = vec![false; model.dof_count()];
        let to_root = |mut link: usize| {
            let mut joints = Vec::new();
            while link > 0 {
                joints.push(link - 1);
                link = model.joints()[link - 1].parent;
            }
            joints
        };
        let base = to_root(self.kinematics.base());
        let structure = &self.setup.structure;
        let declared = instant
            .active
            .iter()
            .filter_map(|contact| structure.contacts().get(contact));
        let mut touched: Vec<usize> = declared.map(|spec| spec.frame.link).collect();
        if !self.disregards {
            let subtrees = instant
                .suspected
                .iter()
                .filter(|unit| *unit < structure.subtrees().len());
            touched.extend(subtrees.flat_map(|unit| structure.links_of(unit)));
        }
        for link in touched {
            let own = to_root(link);
            let apart = own
                .iter()
                .filter(|j| !base.contains(j))
                .chain(base.iter().filter(|j| !own.contains(j)));
            for dof in apart.filter_map(|&joint| model.joints()[joint].dof) {
                blocked[dof] = true;
            }
        }
        blocked
    }
}
