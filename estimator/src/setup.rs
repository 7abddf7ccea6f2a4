//! The resolved configuration: estimator.toml, the URDF and identified parameters, checked against
//! each other, with every name resolved to a number.

mod contacts;
mod names;
mod sensors;

pub use self::names::{frame, nearest};

use self::contacts::{contacts, skins, stances, standing};
use self::names::no_joint;
pub(crate) use self::names::similar_name;
use self::sensors::sensors;
use crate::config::{Base, Config, ForceTorque, InvalidConfig, STANDARD_GRAVITY};
use crate::differentiate::Settings;
use crate::drive::DriveModel;
use crate::inertial::InertialState;
use crate::parameters::{Parameters, ParametersError};
use crate::skin::PatchSetup;
use crate::units;
use proprio_dynamics::calibration::{self, Calibration, UNKNOWN_OFFSET};
use proprio_dynamics::model::{Frame, JointKind, Model, ModelError};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, SensorCut, Structure, StructureError,
};
use proprio_identification::Robot;
use proprio_identification::robot::{
    BaseMotion, Channel, ChannelRole, IdentificationInput, NamedContact,
};
use proprio_topics::{Kind, MAX_JOINTS, Nanos};
use std::path::Path;

/// Largest number of samples for an estimate of velocity and acceleration. The differentiator keeps
/// 128; the difference is for samples that come while an instant waits for other channels.
const WINDOW: usize = 96;

/// The resolved configuration of the estimator. What changes while it runs (the parameters in use,
/// the places of contacts) is in [`crate::pipeline::Pipeline`].
#[derive(Debug, Clone)]
pub struct Setup {
    /// The robot.
    pub robot: Robot,
    /// The inertial parameters, offsets and calibrations to begin with: those of the URDF and the
    /// configuration, or those identified earlier.
    pub initial: InertialState,
    /// How long an estimate waits for channels without a sample, by stamps.
    pub max_wait: Nanos,
    /// Whether an estimate waits for them at all. If not, they are extrapolated.
    pub waits: bool,
    /// Per degree of freedom: a torque whose standard deviation exceeds this is withheld \[Nm or
    /// N\]. The default is the larger of two values: the largest gravity load of the links beyond
    /// the joint, with the limb stretched out (the error of an estimate from the URDF alone), and
    /// a quarter of the joint's effort limit. Without a credible limit in the URDF, the limit is
    /// taken to be ten times the gravity load.
    pub max_deviation: Vec<f64>,
    /// The patches of tactile skin.
    pub skins: Vec<PatchSetup>,
    /// How joint positions are differentiated.
    pub joint_settings: Settings,
    /// How angular velocities are differentiated.
    pub gyro_settings: Settings,
    /// The drives that the torques are compared with: those of the identified parameters.
    pub drives: Vec<DriveModel>,
    /// Whether the reports of all drives are kept, so that drives can be identified from them
    /// ([`crate::pipeline::Pipeline::drive_rows`]).
    pub learns_drives: bool,
    /// Whether parameters are identified on-line.
    pub identifies: bool,
    /// The time between two on-line identification instants.
    pub identification_period: Nanos,
    warnings: Vec<String>,
}

impl Setup {
    /// Reads a configuration, applies `adjust` to it, then reads the files that it names (model,
    /// identified parameters). Logs the warnings.
    ///
    /// # Errors
    /// [`InvalidConfig`].
    pub fn load(
        file: &Path,
        adjust: impl FnOnce(&mut Config),
    ) -> Result<(Config, Self), InvalidConfig> {
        let mut config = Config::load(file)?;
        adjust(&mut config);
        let setup = Self::new(&config).map_err(|problem| InvalidConfig {
            file: file.to_owned(),
            problem,
        })?;
        for warning in setup.warnings() {
            tracing::warn!("{}: {warning}", file.display());
        }
        Ok((config, setup))
    }

    /// Reads the model and resolves every name.
    ///
    /// # Errors
    /// A text that states what is wrong, where, and what is allowed.
    pub fn new(config: &Config) -> Result<Self, String> {
        let keep: Vec<&str> = config
            .force_torque
            .iter()
            .map(|f| f.joint.as_str())
            .collect();
        let mut model = Model::from_file(&config.model, &keep).map_err(|e| match e {
            ModelError::Read { .. } => e.to_string(),
            ModelError::UnknownSensorJoint { ref joint, .. } => {
                let mut sensors = config.force_torque.iter();
                let sensor = sensors.find(|ft| ft.joint == *joint).map(|ft| &ft.sensor);
                format!(
                    "force_torque {:?}: joint = {joint:?}: {}: {e}",
                    sensor.map_or("", String::as_str),
                    config.model.display()
                )
            }
            e => format!("{}: {e}", config.model.display()),
        })?;
        hold(config, &mut model);
        Self::with_model(config, model)
    }

    /// Resolves every name of `config` in `model`, in which the joints of the F/T sensors were
    /// kept.
    ///
    /// # Errors
    /// As [`Setup::new`].
    pub fn with_model(config: &Config, model: Model) -> Result<Self, String> {
        let mut warnings = notes(config, &model)?;
        let identification = &config.identification;
        let locked = locked(config, &model, &mut warnings)?;
        let sensors = sensors(config, &model, &mut warnings)?;
        let channels = channels(config, &model, &locked)?;
        let (contacts, mut specs) = contacts(config, &model)?;
        let skins = skins(config, &model, &contacts, &specs, &mut warnings)?;
        let (base_link, base) = base(config, &model, &contacts, &specs)?;
        let support = match &base {
            BaseMotion::Standing(_) => {
                let mut known = specs.iter().zip(&contacts);
                let support = known.position(|(spec, contact)| {
                    spec.frame.link == base_link && is_wrench(spec) && contact.always
                });
                if support.is_none() {
                    specs.push(ground_reaction(base_link));
                }
                support
            }
            BaseMotion::Imu(_) if is_untouched(&model, &sensors, &specs, base_link) => {
                specs.push(ground_reaction(base_link));
                warnings.push(untouched(&model, base_link));
                None
            }
            BaseMotion::Imu(_) | BaseMotion::Stance(_) => None,
        };
        let mut always = ContactSet::first(specs.len());
        let at_times = (0..).zip(&contacts).filter(|(_, c)| !c.always);
        at_times.for_each(|(number, _)| always.remove(number));
        let structure = Structure::new(&model, &sensors, &specs, Structure::LENGTH_SCALE)
            .map_err(|error| structure_problem(config, &contacts, &error))?;
        let sensors = config.force_torque.iter();
        let robot = Robot {
            name: config.robot.clone(),
            structure,
            base_link,
            base,
            locked,
            contacts,
            always,
            support,
            trigger: trigger(config, &channels)?,
            channels,
            max_silence: Nanos::from_seconds(config.input.max_silence_ms * 1e-3),
            position_noise: config.differentiation.position_noise_rad,
            offsets: sensors.clone().map(ForceTorque::offset).collect(),
            calibrations: sensors.map(ForceTorque::calibration).collect(),
            calibrated: calibration::Kind {
                gain: identification.gain,
                temperature: identification.temperature,
            },
            gain_std: identification.gain_std,
            urdf_relative_std: identification.urdf_relative_std,
            torque_side: identification.torque_side,
            model,
        };
        let noise = &config.differentiation;
        let mut setup = Self {
            initial: InertialState::configured(&robot),
            max_wait: Nanos::from_seconds(config.output.wait_ms().unwrap_or(1.0) * 1e-3),
            waits: config.output.wait_ms().is_some(),
            max_deviation: max_deviation(config, &robot.model),
            skins,
            joint_settings: differentiation(config, noise.position_noise_rad),
            gyro_settings: differentiation(config, noise.angular_velocity_noise_radps),
            drives: Vec::new(),
            learns_drives: false,
            identifies: identification.enabled,
            identification_period: Nanos::from_seconds(1.0 / identification.rate_hz),
            warnings,
            robot,
        };
        if let Some(file) = &config.parameters {
            Parameters::load(file)
                .and_then(|parameters| setup.apply(&parameters))
                .map_err(|error| format!("parameters: {} {error}", file.display()))?;
        }
        Ok(setup)
    }

    /// Takes identified inertial parameters, F/T offsets ([`InertialState::apply`]) and drives.
    ///
    /// # Errors
    /// They belong to another robot, or were identified with another model. Nothing is changed
    /// then.
    pub fn apply(&mut self, parameters: &Parameters) -> Result<(), ParametersError> {
        self.initial.apply(&self.robot, parameters)?;
        self.drives = parameters.drives().to_vec();
        Ok(())
    }

    /// The robot with the parameters and calibrations in use as those of its URDF and
    /// configuration.
    #[must_use]
    pub fn robot_as_identified(&self) -> Robot {
        let mut robot = self.robot.clone();
        robot.model = self.initial.model.clone();
        robot.calibrations.clone_from(&self.initial.calibrations);
        robot
    }

    /// The number of a channel: those of the robot come first, then the skins.
    #[must_use]
    pub fn channel(&self, kind: Kind, name: &str) -> Option<usize> {
        if kind != Kind::Skin {
            return self.robot.channel(kind, name);
        }
        let skin = self.skins.iter().position(|skin| skin.channel == name)?;
        Some(self.robot.channels.len() + skin)
    }

    /// Kind and name of each channel, by number.
    pub fn channels(&self) -> impl Iterator<Item = (Kind, &str)> {
        let skins = self.skins.iter();
        let of_robot = self
            .robot
            .channels
            .iter()
            .map(|c| (c.kind, c.name.as_str()));
        of_robot.chain(skins.map(|skin| (Kind::Skin, skin.channel.as_str())))
    }

    /// The offset in use of F/T sensor number `sensor`; none if it is not known.
    #[must_use]
    pub(crate) fn known_offset(&self, sensor: usize) -> Option<Wrench> {
        let (_, deviation) = self.robot.offsets.get(sensor)?;
        let name = self.robot.sensor_names().nth(sensor)?;
        let is_identified = (self.initial.identified())
            .is_some_and(|found| found.offsets().iter().any(|offset| offset.sensor == name));
        let is_known = is_identified || *deviation != UNKNOWN_OFFSET;
        (is_known && !self.identifies)
            .then(|| self.initial.offsets.get(sensor).copied())
            .flatten()
    }

    /// Whether channel number `channel` is an F/T sensor whose calibration depends on the
    /// temperature of its board.
    #[must_use]
    pub(crate) fn depends_on_temperature(&self, channel: usize) -> bool {
        let role = self.robot.channels.get(channel).map(|channel| channel.role);
        let calibration = match role {
            Some(ChannelRole::Sensor(number)) => self.initial.calibrations.get(number),
            _ => None,
        };
        calibration.is_some_and(Calibration::depends_on_temperature)
    }

    /// Warnings: oddities that are not errors, one sentence each.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

/// What is odd in the URDF and the configuration, each on its own.
fn notes(config: &Config, model: &Model) -> Result<Vec<String>, String> {
    let urdf = config.model.file_name().map(|name| name.to_string_lossy());
    let urdf = urdf.unwrap_or_default();
    let of_urdf = model.warnings().iter();
    let mut notes: Vec<String> = of_urdf
        .map(|warning| format!("{urdf}: {warning}"))
        .collect();
    notes.extend(units::check(config, model)?);
    let identification = &config.identification;
    if identification.enabled && identification.inputs.contains(&IdentificationInput::Torque) {
        notes.push(
            "identification.inputs: on-line identification uses the force/torque sensors alone \
                 and ignores \"torque\"; to use joint torques, run `proprio identify`"
                .into(),
        );
    }
    Ok(notes)
}

/// The unknown wrench on the base, for which the configuration has no contact.
fn ground_reaction(link: usize) -> ContactSpec {
    let frame = Frame {
        link,
        pose: Pose::identity(),
    };
    ContactSpec {
        frame,
        kind: ContactKind::Wrench,
        position: Vec3::zeros(),
    }
}

/// Per degree of freedom, the position of a joint that is not measured; NaN if it is.
fn locked(config: &Config, model: &Model, warnings: &mut Vec<String>) -> Result<Vec<f64>, String> {
    let mut locked = vec![f64::NAN; model.dof_count()];
    for (joint, position) in &config.locked {
        if let Some(leader) = model.follows(joint) {
            warnings.push(format!(
                "locked.{joint}: in the URDF this joint follows {leader} (<mimic>); here it is \
                 held at {position}"
            ));
            continue;
        }
        let dof = model
            .dof(joint)
            .ok_or_else(|| format!("locked.{joint}: {}", no_joint(model, joint)))?;
        if let Some(place) = locked.get_mut(dof) {
            *place = *position;
        }
    }
    let measured = locked.iter().filter(|position| position.is_nan()).count();
    if measured > MAX_JOINTS {
        return Err(format!(
            "{}: {measured} joints are to be measured; {MAX_JOINTS} at most: name joints that \
             nobody measures in [locked], with their positions, or make them fixed in the URDF",
            config.model.display()
        ));
    }
    Ok(locked)
}

/// The channels of the robot: F/T sensors, then measured joints, then the IMU of the base.
fn channels(config: &Config, model: &Model, locked: &[f64]) -> Result<Vec<Channel>, String> {
    let sensors = config.force_torque.iter().enumerate();
    let sensors = sensors.map(|(number, ft)| {
        let role = ChannelRole::Sensor(number);
        (Kind::Wrench, ft.sensor.as_str(), role)
    });
    let measured = (0..).zip(locked).filter(|(_, position)| position.is_nan());
    let joints =
        measured.map(|(dof, _)| (Kind::Joint, model.dof_name(dof), ChannelRole::Joint(dof)));
    let imu = match &config.base {
        Base::Imu { sensor, .. } => Some((Kind::Imu, sensor.as_str(), ChannelRole::Base)),
        _ => None,
    };
    let mut channels = Vec::<Channel>::new();
    for (kind, name, role) in sensors.chain(joints).chain(imu) {
        match channels.iter().find(|other| other.name == name) {
            Some(other) if other.kind == kind => {
                return Err(format!(
                    "two {} channels are named {name:?}; give each its own name",
                    kind.word()
                ));
            }
            Some(other) => return Err(two_kinds(name, other.kind, kind)),
            None => channels.push(Channel {
                kind,
                name: name.to_owned(),
                role,
            }),
        }
    }
    for skin in &config.skin {
        if let Some(other) = channels.iter().find(|other| other.name == skin.channel) {
            return Err(two_kinds(&skin.channel, other.kind, Kind::Skin));
        }
    }
    if channels.is_empty() {
        return Err(
            "no channel is read: add a [[force_torque]] sensor, a joint that is not locked, or an \
             IMU"
            .into(),
        );
    }
    Ok(channels)
}

fn two_kinds(name: &str, one: Kind, other: Kind) -> String {
    format!(
        "{name:?} names a {} channel and a {} channel; give each its own name",
        one.word(),
        other.word()
    )
}

/// The channel whose stamps give estimates.
fn trigger(config: &Config, channels: &[Channel]) -> Result<usize, String> {
    let Some(name) = &config.output.trigger else {
        // Sensors come first, then joints.
        return Ok(0);
    };
    let number = channels.iter().position(|channel| channel.name == *name);
    number.ok_or_else(|| {
        let names: Vec<_> = channels.iter().map(|c| c.name.as_str()).collect();
        format!(
            "output.trigger = {name:?} is not a channel of this configuration; the channels are: \
             {}",
            names.join(", ")
        )
    })
}

/// The link where kinematics start, and how its motion is known.
fn base(
    config: &Config,
    model: &Model,
    contacts: &[NamedContact],
    specs: &[ContactSpec],
) -> Result<(usize, BaseMotion), String> {
    let on = |link: &str| frame(model, link).map_err(|e| format!("base.link: {e}"));
    Ok(match &config.base {
        Base::Fixed { link, gravity_mps2 } => {
            let frame = on(link)?;
            let motion = standing(&frame, *gravity_mps2);
            (frame.link, BaseMotion::Standing(motion))
        }
        Base::Stance { foot } => {
            let stances = stances(foot, model, contacts, specs)?;
            let first = stances.first().map_or(0, |stance| stance.link);
            (first, BaseMotion::Stance(stances))
        }
        Base::Imu {
            link,
            xyz_m,
            rpy_rad,
            ..
        } => {
            let frame = on(link)?;
            let pose = frame.pose * Pose::from_xyz_rpy(*xyz_m, *rpy_rad);
            (frame.link, BaseMotion::Imu(pose))
        }
    })
}

fn is_wrench(spec: &ContactSpec) -> bool {
    spec.kind == ContactKind::Wrench
}

/// What is wrong with a configuration that has no [`Structure`].
fn structure_problem(config: &Config, contacts: &[NamedContact], error: &StructureError) -> String {
    match error {
        StructureError::Contact { index } | StructureError::Direction { index } => {
            let name = contacts.get(*index).map_or("", |c| c.name.as_str());
            format!("contact {name:?}: {error}")
        }
        StructureError::TooMany {
            what: "links",
            count,
            most,
        } => format!(
            "{}: its joints, those in [locked] too, join {count} bodies; {most} at most: make \
             joints that never move fixed in the URDF (type=\"fixed\")",
            config.model.display()
        ),
        error => error.to_string(),
    }
}

/// How a signal with this peak noise is differentiated.
fn differentiation(config: &Config, noise: f64) -> Settings {
    Settings {
        noise,
        capacity: WINDOW,
        max_window: Nanos::from_seconds(config.differentiation.max_window_ms * 1e-3),
        max_gap: Nanos::from_seconds(config.input.max_silence_ms * 1e-3),
    }
}

/// The warning that an unknown wrench is taken to act on the base link.
fn untouched(model: &Model, base_link: usize) -> String {
    format!(
        "base: no [[contact]] is on the part of the robot that has the IMU; that part does not \
         fly, so an unknown wrench is taken to act on link {:?}. Add a [[contact]] where the robot \
         is held or stands (presence = \"possible\" if it may fly)",
        model.link_name(base_link)
    )
}

/// Whether no contact is on the links that are between the F/T sensors around `link`.
fn is_untouched(model: &Model, sensors: &[SensorCut], specs: &[ContactSpec], link: usize) -> bool {
    // Of each link, the link at the top of its part. Parents are before their children.
    let mut top: Vec<usize> = (0..model.link_count()).collect();
    for (number, joint) in model.joints().iter().enumerate() {
        if sensors.iter().all(|sensor| sensor.joint() != number) {
            top[joint.child] = top[joint.parent];
        }
    }
    specs.iter().all(|spec| top[spec.frame.link] != top[link])
}

/// Holds the joints at the positions of `[locked]` that follow another one in the URDF.
pub fn hold(config: &Config, model: &mut Model) {
    for (joint, position) in &config.locked {
        model.hold(joint, *position);
    }
}

/// [`Setup::max_deviation`].
fn max_deviation(config: &Config, model: &Model) -> Vec<f64> {
    /// The effort of a drive is typically ten times the gravity load of the links. A limit above
    /// a hundred times is a placeholder.
    const USUAL: f64 = 10.0;
    const CREDIBLE: f64 = 100.0;
    if let Some(bound) = config.output.max_torque_std_nm {
        return vec![bound; model.dof_count()];
    }
    let mut bounds = gravity_loads(model);
    for (dof, bound) in bounds.iter_mut().enumerate() {
        if let Some(number) = model.dof_joint(dof) {
            let effort = model
                .effort(number)
                .filter(|effort| *effort <= CREDIBLE * *bound);
            *bound = bound.max(effort.unwrap_or(USUAL * *bound) / 4.0);
        }
    }
    bounds
}

/// Per degree of freedom, the largest possible gravity load of the links beyond its joint:
/// `g sum m d`, with `d` along the joints' origins \[Nm or N\].
pub(crate) fn gravity_loads(model: &Model) -> Vec<f64> {
    let mut loads = vec![0.0; model.dof_count()];
    // Beyond each joint, from the tips to the root: mass, and its first moment about the joint's
    // origin with the limb stretched out.
    let mut beyond = vec![(0.0, 0.0); model.link_count()];
    for joint in model.joints().iter().rev() {
        let body = model.inertias().get(joint.child);
        let (mass, moment) = body.map_or((0.0, 0.0), |body| (body.mass, body.first_moment.norm()));
        let (more, moment_of_more) = beyond.get(joint.child).copied().unwrap_or_default();
        let (mass, moment) = (mass + more, moment + moment_of_more);
        if let Some(load) = joint.dof.and_then(|dof| loads.get_mut(dof)) {
            let is_prismatic = matches!(joint.kind, JointKind::Prismatic(_));
            let effort = STANDARD_GRAVITY * if is_prismatic { mass } else { moment };
            // Joints that follow add what they carry.
            *load += effort * joint.ratio.abs();
        }
        if let Some((sum, moments)) = beyond.get_mut(joint.parent) {
            *sum += mass;
            *moments += moment + mass * joint.placement.translation.norm();
        }
    }
    loads
}
