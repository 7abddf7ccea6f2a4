//! estimator.toml, the URDF and what was identified, checked against each other and resolved: what the rest of the estimator works with.

use crate::calibration::{self, Calibration, Kind as Calibrated, UNKNOWN_OFFSET, Unknown};
use crate::config::{
    Base, Config, ContactKind as KindWord, Differentiation, Direction, Foot, ForceTorque, Gain, IdentificationInput,
    Presence, STANDARD_GRAVITY, SensorFrame, TorqueSide,
};
use crate::differentiate::Settings;
use crate::dynamics::{ContactKind, ContactSet, ContactSpec, FrameMotion, Noise, SensorCut, Structure, StructureError};
use crate::model::{Frame, JointKind, MeasurementDirection, MeasurementFrame, Model};
use crate::parameters::{Offset, Parameters, ParametersError, cad_root};
use crate::regressor::Covariance;
use crate::regressor::identifiable::{BaseRegime, Identifiable, JointMotion, Measured, Offsets, Regime, Scope};
use crate::spatial::{Pose, RigidInertia, Vec3, Wrench};
use nalgebra::DMatrix;
use proprio_topics::{Description, Entry, Kind, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name, Nanos, Publisher, Role};
use std::fmt;

/// How many samples an estimate of velocity and acceleration uses at the most: the differentiator keeps 128, and the rest
/// are those that may come while an instant is waiting for other channels.
const WINDOW: usize = 96;

/// What a channel of the pipeline is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Use {
    /// Degree of freedom number.
    Joint(usize),
    /// F/T sensor number.
    Sensor(usize),
    /// The IMU of the base.
    Base,
}

/// A channel that the pipeline reads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// What it measures.
    pub kind: Kind,
    /// Its name.
    pub name: String,
    /// What it is for.
    pub role: Use,
}

/// Where kinematics start.
#[derive(Debug, Clone, PartialEq)]
pub enum BaseMotion {
    /// The base link stands still: its motion is this, always.
    Standing(FrameMotion),
    /// The first of these whose contact is present is the base link, and stands still.
    Stance(Vec<Stance>),
    /// An IMU at this pose in the base link tells.
    Imu(Pose),
}

/// A link that stands still while its contact is present.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stance {
    /// The link.
    pub link: usize,
    /// Its motion then.
    pub motion: FrameMotion,
    /// The number of its contact.
    pub contact: usize,
}

/// A contact as it is published.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedContact {
    /// Its name.
    pub name: String,
    /// The frame that its wrench is expressed in.
    pub frame: String,
    /// Whether it is there unless declared absent.
    pub always: bool,
}

/// Everything that does not change while the estimator runs.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The robot's name.
    pub robot: String,
    /// The model.
    pub model: Model,
    /// Sub-trees, sensors, contacts.
    pub structure: Structure,
    /// The link where kinematics start; with [`BaseMotion::Stance`] where they start first.
    pub base_link: usize,
    /// Its motion.
    pub base: BaseMotion,
    /// Per degree of freedom, where it is locked; NaN if it is measured.
    pub locked: Vec<f64>,
    /// Per F/T sensor, what its corrected reading is with no load.
    pub offsets: Vec<Wrench>,
    /// Per F/T sensor, by what variance its readings are noisier than configured, as was found [torque; force] \[Nm^2, N^2\].
    pub excess: Vec<[f64; 6]>,
    /// Per F/T sensor, how its readings are corrected.
    pub calibrations: Vec<Calibration>,
    /// What of the sensors' calibrations is identified from recorded logs.
    pub calibrated: calibration::Kind,
    /// How far a gain may be off, relative ([`crate::config::Identification::gain_std`]).
    pub gain_deviation: f64,
    /// The contacts that are published. The structure may have one more, the last: what a fixed base stands on.
    pub contacts: Vec<NamedContact>,
    /// The contacts present when nobody declares anything.
    pub always: ContactSet,
    /// The published contact that carries a fixed base, if one does: nobody can declare it absent.
    pub support: Option<usize>,
    /// The number of the trigger's channel.
    pub trigger: usize,
    /// How long an estimate waits.
    pub max_wait: Nanos,
    /// How long a channel may be silent.
    pub max_silence: Nanos,
    /// Per degree of freedom: a torque whose standard deviation exceeds this is withheld \[Nm or N\]. If it is not configured, the most that gravity can make of the links beyond the
    /// joint, by the URDF and the limb stretched out (who knows nothing but that knows as much), or a quarter of the joint's effort limit, whichever is more. A URDF without a credible
    /// limit is taken to mean ten times that load.
    pub max_deviation: Vec<f64>,
    /// How joint positions are differentiated.
    pub joint_settings: Settings,
    /// How angular velocities are differentiated.
    pub gyro_settings: Settings,
    /// How uncertain inertial parameters and offsets are.
    pub covariance: Covariance,
    /// Whether parameters are identified on-line.
    pub identifies: bool,
    /// The time between two instants of on-line identification.
    pub identification_period: Nanos,
    /// Where joint torques are measured that parameters are identified from.
    pub torque_side: TorqueSide,
    channels: Vec<Channel>,
    warnings: Vec<String>,
    /// Inertias as the URDF has them.
    cad: Vec<RigidInertia>,
    /// Offsets as the configuration has them, and their standard deviations [torque; force].
    configured: Vec<(Wrench, [f64; 6])>,
    /// Calibrations as the configuration has them.
    workbench: Vec<Calibration>,
    model_deviation: f64,
    identified: Option<Parameters>,
}

/// What is known on-line of links and sensors that hang together.
#[derive(Debug, Clone, Copy)]
pub struct Learnt<'a> {
    /// The links.
    pub links: &'a [usize],
    /// The F/T sensors.
    pub sensors: &'a [usize],
    /// The root `U` of the covariance `U^T U` over [ten per link | torque, force per sensor], if there is one yet.
    pub root: Option<&'a DMatrix<f64>>,
    /// Per sensor its offset.
    pub offsets: &'a [Wrench],
    /// Per sensor how far its offset wanders in a second [torque; force].
    pub drift: &'a [[f64; 6]],
    /// Since when.
    pub known: Nanos,
}

impl Setup {
    /// Reads the model and resolves every name.
    ///
    /// # Errors
    /// What is wrong, where, and what would be legal.
    pub fn new(config: &Config) -> Result<Self, String> {
        let keep: Vec<&str> = config.force_torque.iter().map(|f| f.joint.as_str()).collect();
        let model = Model::from_file(&config.model, &keep).map_err(|e| {
            let text = e.to_string();
            if text.contains(&*config.model.to_string_lossy()) {
                text
            } else {
                format!("{}: {text}", config.model.display())
            }
        })?;
        Self::with_model(config, model)
    }

    /// Resolves every name of `config` in `model`, in which the joints of the F/T sensors were kept.
    ///
    /// # Errors
    /// As [`Setup::new`].
    pub fn with_model(config: &Config, model: Model) -> Result<Self, String> {
        let mut warnings: Vec<String> = model.warnings().to_vec();
        let identification = &config.identification;
        if identification.enabled && identification.inputs.contains(&IdentificationInput::Torque) {
            warnings.push(
                "identification.inputs: on-line, parameters are identified from the force/torque sensors alone; for joint torques use `proprio identify`".into(),
            );
        }
        let dofs = model.dof_count();
        if dofs > MAX_JOINTS {
            return Err(format!(
                "the model has {dofs} moving joints; at most {MAX_JOINTS} are possible"
            ));
        }
        let mut locked = vec![f64::NAN; dofs];
        for (joint, position) in &config.locked {
            let dof = model
                .dof(joint)
                .ok_or_else(|| format!("locked.{joint}: {}", no_joint(&model, joint)))?;
            if let Some(place) = locked.get_mut(dof) {
                *place = *position;
            }
        }
        let mut channels = Vec::new();
        let mut add = |kind, name: &str, role| match channels.iter().find(|c: &&Channel| c.name == name) {
            Some(other) if other.kind == kind => Err(format!("two {} channels are named {name:?}", Kind::word(kind))),
            Some(other) => Err(format!(
                "{name:?} is a {} and a {}: channels need names of their own",
                other.kind.word(),
                Kind::word(kind)
            )),
            None => {
                channels.push(Channel {
                    kind,
                    name: name.to_owned(),
                    role,
                });
                Ok(())
            }
        };
        let sensors = sensors(config, &model, &mut warnings)?;
        for (number, ft) in config.force_torque.iter().enumerate() {
            add(Kind::Wrench, &ft.sensor, Use::Sensor(number))?;
        }
        for (dof, position) in locked.iter().enumerate() {
            if position.is_nan() {
                add(Kind::Joint, model.dof_name(dof), Use::Joint(dof))?;
            }
        }
        let (contacts, mut specs) = contacts(config, &model)?;
        let (base_link, base) = match &config.base {
            Base::Fixed { link, gravity_mps2 } => {
                let frame = frame(&model, link).map_err(|e| format!("base.link: {e}"))?;
                (frame.link, BaseMotion::Standing(standing(&frame, *gravity_mps2)))
            }
            Base::Stance { foot } => {
                let stances = stances(foot, &model, &contacts, &specs)?;
                (stances.first().map_or(0, |s| s.link), BaseMotion::Stance(stances))
            }
            Base::Imu {
                sensor,
                link,
                xyz_m,
                rpy_rad,
            } => {
                let frame = frame(&model, link).map_err(|e| format!("base.link: {e}"))?;
                add(Kind::Imu, sensor, Use::Base)?;
                (
                    frame.link,
                    BaseMotion::Imu(frame.pose * Pose::from_xyz_rpy(*xyz_m, *rpy_rad)),
                )
            }
        };
        let mut support = None;
        if let BaseMotion::Standing(_) = base {
            // What a fixed base stands on, unless the configuration has it as a contact of its own.
            let there = |(spec, contact): (&ContactSpec, &NamedContact)| {
                spec.frame.link == base_link && spec.kind == ContactKind::Wrench && contact.always
            };
            support = specs.iter().zip(&contacts).position(there);
            if support.is_none() {
                let frame = Frame {
                    link: base_link,
                    pose: Pose::identity(),
                };
                specs.push(ContactSpec {
                    frame,
                    kind: ContactKind::Wrench,
                    position: Vec3::zeros(),
                });
            }
        }
        let mut always = ContactSet::first(specs.len());
        contacts
            .iter()
            .enumerate()
            .filter(|(_, c)| !c.always)
            .for_each(|(i, _)| always.remove(i));
        let structure = Structure::new(&model, &sensors, &specs, Structure::LENGTH_SCALE).map_err(|e| match e {
            StructureError::Contact { index } | StructureError::Direction { index } => {
                format!("contact {:?}: {e}", contacts.get(index).map_or("", |c| c.name.as_str()))
            }
            e => e.to_string(),
        })?;
        let trigger = match &config.output.trigger {
            Some(name) => channels.iter().position(|c| c.name == *name).ok_or_else(|| {
                let names: Vec<_> = channels.iter().map(|c| c.name.as_str()).collect();
                format!(
                    "output.trigger = {name:?} is not a channel that is read; these are: {}",
                    names.join(", ")
                )
            })?,
            // Sensors come first, then joints.
            None => 0,
        };
        if channels.is_empty() {
            return Err("nothing is measured: no force_torque, no joint that is not locked, no IMU".into());
        }
        let Differentiation {
            position_noise_rad,
            angular_velocity_noise_radps,
            max_window_ms,
        } = config.differentiation;
        let max_silence = Nanos::from_seconds(config.input.max_silence_ms * 1e-3);
        let settings = |noise| Settings {
            noise,
            capacity: WINDOW,
            max_window: Nanos::from_seconds(max_window_ms * 1e-3),
            max_gap: max_silence,
        };
        let configured: Vec<(Wrench, [f64; 6])> = config.force_torque.iter().map(ForceTorque::offset).collect();
        let workbench: Vec<Calibration> = config.force_torque.iter().map(ForceTorque::calibration).collect();
        let mut setup = Self {
            excess: vec![[0.0; 6]; configured.len()],
            calibrations: workbench.clone(),
            workbench,
            calibrated: calibration::Kind {
                gain: identification.gain,
                temperature: identification.temperature,
            },
            gain_deviation: identification.gain_std,
            robot: config.robot.clone(),
            structure,
            base_link,
            base,
            locked,
            offsets: configured.iter().map(|(offset, _)| *offset).collect(),
            contacts,
            always,
            support,
            trigger,
            max_wait: Nanos::from_seconds(config.output.max_wait_ms * 1e-3),
            max_silence,
            max_deviation: config
                .output
                .max_torque_std_nm
                .map_or_else(|| worthless(&model), |bound| vec![bound; dofs]),
            joint_settings: settings(position_noise_rad),
            gyro_settings: settings(angular_velocity_noise_radps),
            covariance: Covariance::exact(model.link_count(), configured.len()),
            channels,
            warnings,
            cad: model.inertias().to_vec(),
            configured,
            model_deviation: config.identification.model_std,
            identifies: config.identification.enabled,
            identification_period: Nanos::from_seconds(1.0 / config.identification.rate_hz),
            torque_side: config.identification.torque_side,
            identified: None,
            model,
        };
        setup.settle();
        if let Some(file) = &config.parameters {
            Parameters::load(file)
                .and_then(|parameters| setup.apply(&parameters))
                .map_err(|error| format!("parameters: {} {error}", file.display()))?;
        }
        Ok(setup)
    }

    /// Takes inertial parameters and F/T offsets from what was identified, where it was; elsewhere the URDF's and the configuration's stay.
    ///
    /// # Errors
    /// They are another robot's, or were identified with another model. Nothing is changed then.
    pub fn apply(&mut self, parameters: &Parameters) -> Result<(), ParametersError> {
        parameters.check_setup(self)?;
        self.identified = Some(parameters.clone());
        self.settle();
        Ok(())
    }

    /// Puts inertias, offsets and their covariance where the estimator reads them. What is given here was checked when it was made, so nothing is refused.
    fn settle(&mut self) {
        let (links, sensors) = (self.cad.len(), self.configured.len());
        self.covariance = Covariance::exact(links, sensors);
        self.offsets = self.configured.iter().map(|(offset, _)| *offset).collect();
        self.calibrations.clone_from(&self.workbench);
        self.excess.fill([0.0; 6]);
        for (link, cad) in self.cad.iter().enumerate() {
            let identified = self.identified.as_ref().and_then(|parameters| parameters.inertia(link));
            let _ = self.model.set_inertia(link, identified.unwrap_or(*cad));
        }
        let (mut measured, mut calibrated) = (Vec::new(), Vec::new());
        if let Some(parameters) = &self.identified {
            for offset in parameters.offsets() {
                let Some(sensor) = self.sensor(&offset.sensor) else {
                    continue;
                };
                if let Some(place) = self.offsets.get_mut(sensor) {
                    *place = offset.reading;
                }
                set_noise(
                    &mut self.excess,
                    &self.structure,
                    sensor,
                    offset.noise.torque_first().map(|x| x * x),
                );
                if let (Some(place), Some(found)) = (self.calibrations.get_mut(sensor), &offset.calibrated) {
                    *place = found.calibration;
                    calibrated.push((sensor, found.kind));
                }
                let ([fx, fy, fz], [tx, ty, tz]) = (offset.drift.force.into(), offset.drift.torque.into());
                let log = parameters.provenance().logs.iter().find(|log| log.end == offset.known);
                let first = log.map_or(offset.known, |log| log.start);
                let _ = self
                    .covariance
                    .set_drift_of_log(sensor, [tx, ty, tz, fx, fy, fz], (first, offset.known));
                measured.push(sensor);
            }
            let identified: Vec<usize> = parameters.identified().collect();
            let _ = self
                .covariance
                .add_calibrated(&identified, &measured, &calibrated, parameters.root());
        }
        let mut covariance = std::mem::replace(&mut self.covariance, Covariance::exact(0, 0));
        self.fill(&mut covariance, &measured);
        self.covariance = covariance;
    }

    /// Says of every link that has no covariance what the URDF is taken to be worth, and of every sensor that is not in `measured` what the configuration says.
    fn fill(&self, covariance: &mut Covariance, measured: &[usize]) {
        for (link, cad) in self.cad.iter().enumerate() {
            if !covariance.has_link(link) && self.model_deviation > 0.0 {
                let _ = covariance.add(&[link], &[], own_root(cad, self.model_deviation));
            }
        }
        for (sensor, (_, deviation)) in self.configured.iter().enumerate() {
            if !measured.contains(&sensor) {
                self.add_offset(covariance, sensor, deviation);
            }
        }
    }

    /// Says how uncertain a sensor's offset is, and the calibration that was identified of it.
    fn add_offset(&self, covariance: &mut Covariance, sensor: usize, deviation: &[f64; 6]) {
        let calibrated = self.calibrated_among(&[sensor]);
        let known: Vec<f64> = deviation
            .iter()
            .chain(calibrated.iter().flat_map(|(_, d)| *d))
            .copied()
            .collect();
        if known.iter().any(|deviation| *deviation != 0.0) {
            let kinds: Vec<(usize, Calibrated)> = calibrated.iter().map(|(kind, _)| *kind).collect();
            let root = DMatrix::from_fn(known.len(), known.len(), |i, j| if i == j { known[i] } else { 0.0 });
            let _ = covariance.add_calibrated(&[], &[sensor], &kinds, root);
        }
    }

    /// Those of these sensors whose calibration was identified: what of it, and its standard deviations.
    fn calibrated_among(&self, sensors: &[usize]) -> Vec<((usize, Calibrated), &[f64])> {
        let Some(parameters) = &self.identified else {
            return Vec::new();
        };
        let of = |(place, offset): (usize, &Offset)| {
            let sensor = self.sensor(&offset.sensor).filter(|sensor| sensors.contains(sensor))?;
            let kind = offset.calibrated.as_ref()?.kind;
            Some(((sensor, kind), parameters.calibration_deviation(place)))
        };
        parameters.offsets().iter().enumerate().filter_map(of).collect()
    }

    /// The covariance where some links and sensors are identified on-line. Where a group has no root nothing is known of it yet: links are as uncertain as
    /// identification's prior has them before any data, and offsets anything.
    ///
    /// Calibrations are not identified on-line. Those that were identified before stay as uncertain as they were found to be, independent of the rest but for this: an offset that is
    /// found on-line was found with the gain as it is, and takes up what the gain's error `E` makes of the offset itself. What is left is its share of the load, `E (r - o)`.
    pub fn covariance_with<'a>(&self, groups: impl Iterator<Item = Learnt<'a>>) -> Covariance {
        let mut covariance = Covariance::exact(self.cad.len(), self.configured.len());
        let mut measured = Vec::new();
        // Numbers are the model's own, and each is in one group only: nothing is refused.
        for group in groups {
            measured.extend_from_slice(group.sensors);
            if let Some(root) = group.root {
                let calibrated = self.calibrated_among(group.sensors);
                let kinds: Vec<(usize, Calibrated)> = calibrated.iter().map(|(kind, _)| *kind).collect();
                let root = with_calibrations(&group, root, &calibrated);
                let _ = covariance.add_calibrated(group.links, group.sensors, &kinds, root);
                for (&sensor, rate) in group.sensors.iter().zip(group.drift) {
                    let _ = covariance.set_drift(sensor, *rate, group.known);
                }
                continue;
            }
            for &link in group.links {
                if let Some(cad) = self.cad.get(link).filter(|_| self.model_deviation > 0.0) {
                    let _ = covariance.add(&[link], &[], own_root(cad, self.model_deviation));
                }
            }
            for &sensor in group.sensors {
                self.add_offset(&mut covariance, sensor, &UNKNOWN_OFFSET);
            }
        }
        self.fill(&mut covariance, &measured);
        covariance
    }

    /// How far the URDF's inertial parameters are expected to be from the robot's, relative ([`crate::config::Identification::model_std`]).
    #[must_use]
    pub fn model_deviation(&self) -> f64 {
        self.model_deviation
    }

    /// Calibrations of the F/T sensors as the configuration has them, whatever was identified.
    #[must_use]
    pub fn workbench(&self) -> &[Calibration] {
        &self.workbench
    }

    /// The same without what was identified: with the URDF's inertias, and calibrations and offsets as
    /// configured.
    #[must_use]
    pub fn as_configured(&self) -> Self {
        let mut configured = Self {
            identified: None,
            ..self.clone()
        };
        configured.settle();
        configured
    }

    /// Inertias of the links as the URDF has them, whatever was identified.
    #[must_use]
    pub fn cad(&self) -> &[RigidInertia] {
        &self.cad
    }

    /// What was identified, if it is used.
    #[must_use]
    pub fn identified(&self) -> Option<&Parameters> {
        self.identified.as_ref()
    }

    /// Number of the F/T sensor with this channel.
    #[must_use]
    pub fn sensor(&self, channel: &str) -> Option<usize> {
        self.channels.iter().find_map(|c| match c.role {
            Use::Sensor(number) if c.name == channel => Some(number),
            _ => None,
        })
    }

    /// The channels that are read.
    #[must_use]
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// The number of a channel.
    #[must_use]
    pub fn channel(&self, kind: Kind, name: &str) -> Option<usize> {
        self.channels.iter().position(|c| c.kind == kind && c.name == name)
    }

    /// Whether channel number `channel` is of an F/T sensor whose calibration depends on the temperature of its board.
    #[must_use]
    pub fn depends_on_temperature(&self, channel: usize) -> bool {
        let role = self.channels.get(channel).map(|channel| channel.role);
        let calibration = match role {
            Some(Use::Sensor(number)) => self.calibrations.get(number),
            _ => None,
        };
        calibration.is_some_and(Calibration::depends_on_temperature)
    }

    /// The number of a contact that is published.
    #[must_use]
    pub fn contact(&self, name: &str) -> Option<usize> {
        self.contacts.iter().position(|c| c.name == name)
    }

    /// The names of the joints, in the order of the estimates.
    pub fn joint_names(&self) -> impl Iterator<Item = &str> {
        (0..self.model.dof_count()).map(|dof| self.model.dof_name(dof))
    }

    /// The names of the contacts, in the order of the estimates.
    pub fn contact_names(&self) -> impl Iterator<Item = &str> {
        self.contacts.iter().map(|c| c.name.as_str())
    }

    /// The names of the F/T sensors' channels, in the order of the structure's sensors.
    pub fn sensor_names(&self) -> impl Iterator<Item = &str> {
        let sensors = 0..self.structure.sensors().len();
        sensors.map(|sensor| {
            let channel = self.channels.iter().find(|channel| channel.role == Use::Sensor(sensor));
            channel.map_or("", |channel| channel.name.as_str())
        })
    }

    /// The names of the sub-trees, those of their top links, in the order of the estimates.
    pub fn subtree_names(&self) -> impl Iterator<Item = &str> {
        let subtrees = self.structure.subtrees().iter();
        subtrees
            .take(MAX_SUBTREES)
            .map(|subtree| self.model.link_name(subtree.top))
    }

    /// What is odd but not wrong, one sentence each.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Which torques rest on links that no F/T sensor measures the far side of alone: a sentence for people, empty if none.
    ///
    /// A joint between the base and an F/T sensor has as its torque the sensor's reading and what the links in between weigh:
    /// figures of the URDF, as far as they were not identified. How uncertain these make it is in its standard deviation.
    #[must_use]
    pub fn upstream_note(&self) -> String {
        let mut parts = Vec::new();
        for sensor in self.structure.sensors() {
            let (mut joints, mut are_identified) = (Vec::new(), true);
            let mut joint = sensor.joint();
            // Up to the root, or to the next sensor: beyond that one, both sides are measured.
            let bounded = loop {
                let parent = self.model.joints().get(joint).map_or(0, |j| j.parent);
                if parent == 0 {
                    break false;
                }
                are_identified &= self.is_identified(parent);
                joint = parent - 1;
                if self.structure.sensors().iter().any(|s| s.joint() == joint) {
                    break true;
                }
                if self.model.joints().get(joint).is_some_and(|j| j.dof.is_some()) {
                    joints.push(self.model.joint_name(joint));
                }
            };
            if !joints.is_empty() && !bounded {
                joints.reverse();
                let whose = if are_identified {
                    "identified parameters of the links in between"
                } else {
                    "the URDF's links in between"
                };
                parts.push(format!(
                    "{} lies beyond {}: their torques also rest on {whose}.",
                    self.model.joint_name(sensor.joint()),
                    joints.join(", ")
                ));
            }
        }
        parts.join(" ")
    }

    fn is_identified(&self, link: usize) -> bool {
        let parameters = self.identified.as_ref();
        parameters.is_some_and(|parameters| parameters.inertia(link).is_some())
    }

    /// Says which parameters are in force, and how certain they are.
    fn tell_parameters(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let known = if self.model_deviation > 0.0 {
            format!("taken as known to {} %", (1e6 * self.model_deviation).round() / 1e4)
        } else {
            "taken as exact".to_owned()
        };
        let Some(parameters) = &self.identified else {
            return writeln!(f, "inertial parameters: the URDF's, {known} (identification.model_std)");
        };
        let provenance = parameters.provenance();
        let logs: Vec<_> = provenance.logs.iter().map(|log| log.file.as_str()).collect();
        let from = if logs.is_empty() {
            String::new()
        } else {
            format!(" from {}", logs.join(", "))
        };
        let tau = provenance
            .tau
            .map_or(String::new(), |tau| format!(" (prior's weight tau = {tau})"));
        let links = self.model.link_count();
        writeln!(
            f,
            "inertial parameters: identified by {}{from}{tau}: {} of {links} links",
            provenance.program,
            parameters.identified().count()
        )?;
        let others = (0..links).filter(|&link| !self.is_identified(link));
        let others: Vec<_> = others.map(|link| self.model.link_name(link)).collect();
        if !others.is_empty() {
            writeln!(f, "  the URDF's, {known}: {}", others.join(", "))?;
        }
        for (place, offset) in parameters.offsets().iter().enumerate() {
            let deviation = parameters.offset_deviation(place).unwrap_or_default();
            let numbers = offset.reading.force_first().into_iter().zip(deviation.force_first());
            let numbers: Vec<_> = numbers.map(|(value, std)| format!("{value:.3} +- {std:.3}")).collect();
            writeln!(f, "  offset of {} [N, Nm]: {}", offset.sensor, numbers.join(", "))?;
            if let Some(found) = &offset.calibrated {
                let of = |values: [f64; 6]| values.map(|value| format!("{value:.4}")).join(", ");
                if found.kind.gain != Gain::None {
                    let diagonal: [f64; 6] = std::array::from_fn(|i| found.calibration.gain_force_first()[7 * i]);
                    writeln!(f, "  gain of {}, diagonal: {}", offset.sensor, of(diagonal))?;
                }
                if let (true, Some(reference)) = (found.kind.temperature, found.calibration.reference()) {
                    let per_kelvin = of(found.calibration.per_kelvin().force_first());
                    writeln!(
                        f,
                        "  per kelvin beyond {reference} C, {} [N/K, Nm/K]: {per_kelvin}",
                        offset.sensor
                    )?;
                }
            }
        }
        Ok(())
    }

    /// What can move while the estimator runs, for the question which parameters its sensors can see at all ([`Identifiable`]). A robot with several feet
    /// is taken to stand on the first.
    #[must_use]
    pub fn regime(&self) -> Regime {
        let fixed = |motion: &FrameMotion| BaseRegime::Restricted {
            gravity: -motion.proper_acceleration,
            joints: Vec::new(),
        };
        let motion = match &self.base {
            BaseMotion::Standing(motion) => fixed(motion),
            BaseMotion::Stance(stances) => stances.first().map_or(BaseRegime::Free, |stance| fixed(&stance.motion)),
            BaseMotion::Imu(_) => BaseRegime::Free,
        };
        let joint = |&locked: &f64| {
            if locked.is_nan() {
                JointMotion::Moving
            } else {
                JointMotion::Locked(locked)
            }
        };
        Regime {
            base: self.base_link,
            motion,
            joints: self.locked.iter().map(joint).collect(),
            contacts: ContactSet::EMPTY,
            tolerance: Regime::TOLERANCE,
        }
    }

    /// What a sub-tree's F/T sensors can tell of its inertial parameters: a sentence for people. None without a sensor.
    fn sight(&self, number: usize) -> Option<String> {
        let subtree = self.structure.subtrees().get(number)?;
        if subtree.sensors.is_empty() {
            return None;
        }
        // One that nobody can declare absent takes up whatever the links make.
        let hides = |contact: &usize| {
            let spec = self.structure.contacts().get(*contact);
            self.always.contains(*contact) && spec.is_some_and(|spec| spec.kind == ContactKind::Wrench)
        };
        if let Some(contact) = subtree.contacts.iter().find(hides) {
            let name = self.contact_label(contact);
            return Some(format!(
                "none of its inertial parameters shows in its F/T while {name} is present"
            ));
        }
        let seen = |offsets| {
            let scope = Scope::SubTree(&self.structure, number);
            Identifiable::new(&self.model, scope, &self.regime(), Measured::Wrench, offsets).ok()
        };
        let (known, unknown) = (seen(Offsets::Known)?, seen(Offsets::Unknown)?);
        let lost = match unknown.confused() {
            0 => String::new(),
            n => format!("; {n} of these cannot be told from the sensors' offsets"),
        };
        Some(format!(
            "{} independent combinations of its {} inertial parameters show in its F/T{lost}",
            known.rank(),
            known.columns().len()
        ))
    }

    /// The name of a contact for people.
    pub(crate) fn contact_label(&self, contact: usize) -> &str {
        self.contacts
            .get(contact)
            .map_or("what the base stands on", |c| c.name.as_str())
    }

    /// The names behind the numbers of the estimates.
    #[must_use]
    pub fn description(&self) -> Box<Description> {
        let name = |text: &str| Name::new(text).unwrap_or(Name::EMPTY);
        let channels = self.channels.iter().map(|c| Entry {
            name: name(&c.name),
            kind: c.kind,
            max_silence: self.max_silence,
            ..Entry::NONE
        });
        let joints = self.joint_names().map(|j| Entry {
            name: name(j),
            role: Role::Joint,
            ..Entry::NONE
        });
        let contacts = self.contacts.iter().map(|c| Entry {
            name: name(&c.name),
            frame: name(&c.frame),
            role: Role::Contact,
            kind: Kind::Wrench,
            ..Entry::NONE
        });
        let subtrees = self.subtree_names().map(|top| Entry {
            name: name(top),
            frame: name(top),
            role: Role::SubTree,
            kind: Kind::Wrench,
            ..Entry::NONE
        });
        let numbered = channels.zip(0..).chain(joints.zip(0..)).chain(contacts.zip(0..));
        let numbered = numbered.chain(subtrees.zip(0..));
        Box::new(Description::new(
            Publisher::Estimator,
            numbered.map(|(entry, index)| Entry { index, ..entry }),
        ))
    }
}

/// Says what variance the readings of a sensor have [torque; force].
pub(crate) fn set_noise(excess: &mut [[f64; 6]], structure: &Structure, sensor: usize, found: [f64; 6]) {
    if let (Some(place), Some(cut)) = (excess.get_mut(sensor), structure.sensors().get(sensor)) {
        let stated = Wrench::from_parts(cut.noise().force, cut.noise().torque).torque_first();
        *place = std::array::from_fn(|i| (found[i] - stated[i] * stated[i]).max(0.0));
    }
}

/// Of each degree of freedom, the standard deviation beyond which a torque is worth nothing ([`Setup::max_deviation`]) \[Nm or N\].
fn worthless(model: &Model) -> Vec<f64> {
    /// Drives carry some ten times the links alone. A limit beyond a hundred times is no limit, but a number that had to be there.
    const USUAL: f64 = 10.0;
    const CREDIBLE: f64 = 100.0;
    let mut bounds = gravity_loads(model);
    for (number, joint) in model.joints().iter().enumerate() {
        if let Some(bound) = joint.dof.and_then(|dof| bounds.get_mut(dof)) {
            let effort = model.effort(number).filter(|effort| *effort <= CREDIBLE * *bound);
            *bound = bound.max(effort.unwrap_or(USUAL * *bound) / 4.0);
        }
    }
    bounds
}

/// Of each degree of freedom, what gravity makes at the most of the links beyond its joint:
/// `g sum m d`, `d` along the joints' origins \[Nm or N\].
pub(crate) fn gravity_loads(model: &Model) -> Vec<f64> {
    let mut loads = vec![0.0; model.dof_count()];
    // Beyond each joint, from the tips on: mass, and its moment with the limb stretched out from the joint's origin.
    let mut beyond = vec![(0.0, 0.0); model.link_count()];
    for joint in model.joints().iter().rev() {
        let body = model.inertias().get(joint.child);
        let (mass, moment) = body.map_or((0.0, 0.0), |body| (body.mass, body.first_moment.norm()));
        let (more, moment_of_more) = beyond.get(joint.child).copied().unwrap_or_default();
        let (mass, moment) = (mass + more, moment + moment_of_more);
        if let Some(load) = joint.dof.and_then(|dof| loads.get_mut(dof)) {
            let is_prismatic = matches!(joint.kind, JointKind::Prismatic(_));
            *load = STANDARD_GRAVITY * if is_prismatic { mass } else { moment };
        }
        if let Some((sum, moments)) = beyond.get_mut(joint.parent) {
            *sum += mass;
            *moments += moment + mass * joint.placement.translation.norm();
        }
    }
    loads
}

fn sensors(config: &Config, model: &Model, warnings: &mut Vec<String>) -> Result<Vec<SensorCut>, String> {
    let mut cuts = Vec::new();
    for ft in &config.force_torque {
        let at = format!("force_torque {:?}", ft.sensor);
        let element = model.sensors().iter().find(|e| e.joint == ft.joint);
        let frame = ft.frame.map(|f| match f {
            SensorFrame::Child => MeasurementFrame::Child,
            SensorFrame::Parent => MeasurementFrame::Parent,
            SensorFrame::Sensor => MeasurementFrame::Sensor,
        });
        let direction = ft.direction.map(|d| match d {
            Direction::ChildToParent => MeasurementDirection::ChildToParent,
            Direction::ParentToChild => MeasurementDirection::ParentToChild,
        });
        if let Some(element) = element {
            if frame.is_some_and(|f| f != element.frame) {
                warnings.push(format!(
                    "{at}: frame is {:?} here and {:?} in the URDF; this file counts",
                    frame, element.frame
                ));
            }
            if direction.is_some_and(|d| d != element.direction) {
                warnings.push(format!(
                    "{at}: direction is {:?} here and {:?} in the URDF; this file counts",
                    direction, element.direction
                ));
            }
        }
        let frame = frame.or(element.map(|e| e.frame)).unwrap_or(MeasurementFrame::Child);
        let direction = direction
            .or(element.map(|e| e.direction))
            .unwrap_or(MeasurementDirection::ChildToParent);
        let given = ft.xyz_m.is_some();
        if ft.xyz_m.is_some() != ft.rpy_rad.is_some() {
            return Err(format!("{at}: xyz_m and rpy_rad go together: give both or neither"));
        }
        if given && frame != MeasurementFrame::Sensor {
            return Err(format!("{at}: xyz_m and rpy_rad belong to frame = \"sensor\" only"));
        }
        let pose = match element {
            _ if given => Pose::from_xyz_rpy(ft.xyz_m.unwrap_or_default(), ft.rpy_rad.unwrap_or_default()),
            Some(element) => element.pose,
            None if frame == MeasurementFrame::Sensor => {
                return Err(format!(
                    "{at}: frame = \"sensor\" needs its pose: xyz_m and rpy_rad here, or a sensor element in the URDF"
                ));
            }
            None => Pose::identity(),
        };
        if let Some(element) = element.filter(|_| given) {
            let apart = element.pose.inverse() * pose;
            let turned = (apart.rotation.trace() - 3.0).abs();
            if apart.translation.norm() > 1e-6 || turned > 1e-9 {
                warnings.push(format!(
                    "{at}: its pose here is another one than in the URDF; this file counts"
                ));
            }
        }
        let noise = Noise {
            force: ft.noise_n,
            torque: ft.noise_nm,
        };
        let cut = SensorCut::new(model, &ft.joint, frame, direction, &pose, &noise).map_err(|e| match e {
            StructureError::NoJoint(_) => format!("{at}: joint = {:?}: {}", ft.joint, no_joint(model, &ft.joint)),
            e => format!("{at}: {e}"),
        })?;
        cuts.push(cut);
    }
    Ok(cuts)
}

fn contacts(config: &Config, model: &Model) -> Result<(Vec<NamedContact>, Vec<ContactSpec>), String> {
    let (mut names, mut specs) = (Vec::<NamedContact>::new(), Vec::new());
    if config.contact.len() >= MAX_CONTACTS {
        return Err(format!(
            "there are {} contacts; at most {} are possible",
            config.contact.len(),
            MAX_CONTACTS - 1
        ));
    }
    for contact in &config.contact {
        let at = format!("contact {:?}", contact.name());
        if Name::new(contact.name()).is_none() || contact.name().contains(['/', ',', '"', '\n']) {
            return Err(format!(
                "{at}: a name has at most {} bytes, none of them / , \" or a line's end",
                Name::CAPACITY
            ));
        }
        if names.iter().any(|n| n.name == contact.name()) {
            return Err(format!(
                "{at}: two contacts have this name; give each a name of its own"
            ));
        }
        let frame = frame(model, &contact.link).map_err(|e| format!("{at}: link: {e}"))?;
        let kind = match (contact.kind, contact.direction) {
            (KindWord::Wrench, _) => ContactKind::Wrench,
            (KindWord::Force, _) => ContactKind::Force,
            (KindWord::ForceAlong, direction) => ContactKind::ForceAlong(Vec3::from(direction.unwrap_or_default())),
        };
        specs.push(ContactSpec {
            frame,
            kind,
            position: Vec3::from(contact.position_m),
        });
        let always = contact.presence == Presence::Always;
        names.push(NamedContact {
            name: contact.name().to_owned(),
            frame: contact.link.clone(),
            always,
        });
    }
    Ok((names, specs))
}

/// How a link moves while `frame`, which is fixed to it, stands still.
fn standing(frame: &Frame, gravity: [f64; 3]) -> FrameMotion {
    FrameMotion::of_link_from_imu(&FrameMotion::standing(&Vec3::from(gravity)), &frame.pose)
}

fn stances(
    feet: &[Foot],
    model: &Model,
    contacts: &[NamedContact],
    specs: &[ContactSpec],
) -> Result<Vec<Stance>, String> {
    let mut stances = Vec::<Stance>::new();
    for (number, foot) in feet.iter().enumerate() {
        let at = format!("base.foot {:?}", foot.link);
        let frame = frame(model, &foot.link).map_err(|e| format!("{at}: link: {e}"))?;
        let contact = contacts.iter().position(|c| c.name == foot.contact).ok_or_else(|| {
            let names = nearest(&foot.contact, contacts.iter().map(|c| c.name.as_str()));
            format!("{at}: contact = {:?} is not a contact{names}", foot.contact)
        })?;
        let carries = |spec: &ContactSpec| spec.frame.link == frame.link && spec.kind == ContactKind::Wrench;
        if !specs.get(contact).is_some_and(carries) {
            return Err(format!(
                "{at}: contact {:?} must be on the same link and of kind \"wrench\" to carry the robot",
                foot.contact
            ));
        }
        if stances.iter().any(|other| other.contact == contact) {
            return Err(format!("{at}: contact {:?} is another foot's already", foot.contact));
        }
        if number + 1 < feet.len() && contacts.get(contact).is_some_and(|c| c.always) {
            return Err(format!(
                "{at}: contact {:?} is always present, so that no foot after this one would ever be the base; give it presence = \"possible\"",
                foot.contact
            ));
        }
        stances.push(Stance {
            link: frame.link,
            motion: standing(&frame, foot.gravity_mps2),
            contact,
        });
    }
    Ok(stances)
}

/// Where a link or folded frame is; what is near in name, if there is none of that name.
fn frame(model: &Model, name: &str) -> Result<Frame, String> {
    model.frame(name).ok_or_else(|| {
        format!(
            "{name:?} is not a link of the URDF{}",
            nearest(name, model.frame_names())
        )
    })
}

fn no_joint(model: &Model, name: &str) -> String {
    if let Some(joint) = model.joint(name)
        && model.joints().get(joint).is_some_and(|j| j.dof.is_none())
    {
        return format!("{name:?} is a fixed joint; there is nothing to lock");
    }
    if model.is_folded(name) {
        return format!("{name:?} is a fixed joint");
    }
    let names = (0..model.joint_count()).map(|j| model.joint_name(j));
    format!("{name:?} is not a joint of the URDF{}", nearest(name, names))
}

/// A hint for somebody who misspelt a name.
pub fn nearest<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> String {
    let mut names: Vec<_> = names.map(|n| (strsim::damerau_levenshtein(name, n), n)).collect();
    names.sort_unstable();
    match names.first() {
        Some((distance, near)) if *distance <= name.len() / 2 => format!("; did you mean {near:?}?"),
        _ => {
            let some: Vec<_> = names.iter().take(8).map(|(_, n)| *n).collect();
            format!(
                "; there is {}{}",
                some.join(", "),
                if names.len() > 8 { ", ..." } else { "" }
            )
        }
    }
}

/// A group's root with the columns of its sensors' calibrations after its own, and a row for each.
fn with_calibrations(
    group: &Learnt<'_>,
    root: &DMatrix<f64>,
    calibrated: &[((usize, Calibrated), &[f64])],
) -> DMatrix<f64> {
    let more: usize = calibrated.iter().map(|((_, kind), _)| kind.count()).sum();
    let (rows, columns) = root.shape();
    let mut all = DMatrix::zeros(rows + more, columns + more);
    all.view_mut((0, 0), (rows, columns)).copy_from(root);
    let mut next = 0;
    for ((sensor, kind), deviations) in calibrated {
        let place = group.sensors.iter().position(|other| other == sensor).unwrap_or(0);
        let offset = group.offsets.get(place).map_or([0.0; 6], Wrench::torque_first);
        for (unknown, deviation) in kind.unknowns().zip(*deviations) {
            all[(rows + next, columns + next)] = *deviation;
            if let Unknown::Gain { channel, .. } = unknown {
                // While nothing but the offset is read, what is wrong is in the offset already.
                let column = 10 * group.links.len() + 6 * place + channel;
                all[(rows + next, column)] = -deviation * unknown.as_offset(&offset, 0.0);
            }
            next += 1;
        }
    }
    all
}

fn own_root(cad: &RigidInertia, relative: f64) -> DMatrix<f64> {
    let root = cad_root(cad, relative);
    DMatrix::from_fn(10, 10, |i, j| root[(i, j)])
}

impl fmt::Display for Setup {
    /// A table for people: `proprio estimator --check` prints it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "robot {}: {} links, {} moving joints, {} sub-trees",
            self.robot,
            self.model.link_count(),
            self.model.dof_count(),
            self.structure.subtrees().len()
        )?;
        let base = self.model.link_name(self.base_link);
        match &self.base {
            BaseMotion::Imu(_) => writeln!(f, "base {base}: an IMU tells its motion")?,
            BaseMotion::Standing(_) => writeln!(f, "base {base}: it stands still")?,
            BaseMotion::Stance(stances) => {
                writeln!(f, "base: the first of these that has its contact stands still")?;
                for stance in stances {
                    let contact = self.contacts.get(stance.contact).map_or("", |c| c.name.as_str());
                    writeln!(f, "  {} with contact {contact}", self.model.link_name(stance.link))?;
                }
            }
        }
        for (number, channel) in self.channels.iter().enumerate() {
            let trigger = if number == self.trigger {
                " (each of its stamps gives an estimate)"
            } else {
                ""
            };
            writeln!(f, "  reads {} {}{trigger}", channel.kind.word(), channel.name)?;
        }
        for (dof, position) in self.locked.iter().enumerate() {
            if !position.is_nan() {
                writeln!(f, "  locked {} at {position}", self.model.dof_name(dof))?;
            }
        }
        for (number, subtree) in self.structure.subtrees().iter().enumerate() {
            let sensors: Vec<_> = subtree
                .sensors
                .iter()
                .filter_map(|s| self.structure.sensors().get(s))
                .map(|s| self.model.joint_name(s.joint()))
                .collect();
            let contacts: Vec<_> = subtree.contacts.iter().map(|c| self.contact_label(c)).collect();
            let unknowns: usize = subtree
                .contacts
                .iter()
                .filter_map(|c| self.structure.contacts().get(c))
                .map(|c| c.kind.unknowns())
                .sum();
            writeln!(
                f,
                "sub-tree {number} from {}: F/T [{}], contacts [{}]: {unknowns} unknowns in 6 equations",
                self.model.link_name(subtree.top),
                sensors.join(", "),
                contacts.join(", ")
            )?;
            if let Some(sight) = self.sight(number) {
                writeln!(f, "  {sight}")?;
            }
        }
        self.tell_parameters(f)?;
        let note = self.upstream_note();
        if !note.is_empty() {
            writeln!(f, "{note}")?;
        }
        for warning in &self.warnings {
            writeln!(f, "note: {warning}")?;
        }
        Ok(())
    }
}
