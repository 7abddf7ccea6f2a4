//! The resolved configuration: estimator.toml, the URDF and identified parameters, checked against
//! each other, with every name resolved to a number.

use crate::config::{
    Base, Config, ContactKind as KindWord, Differentiation, Direction, Foot, ForceTorque, Presence,
    STANDARD_GRAVITY, SensorFrame, Timing,
};
use crate::differentiate::Settings;
use crate::drive::Drive;
use crate::inertial::InertialState;
use crate::parameters::{Parameters, ParametersError};
use crate::plausible;
use crate::skin::{PatchSetup, TRIANGLE, TRIANGLES, Taxel, TaxelMap, threshold};
use proprio_dynamics::calibration::{self, Calibration, UNKNOWN_OFFSET};
use proprio_dynamics::model::{
    Frame, JointKind, MeasurementDirection, MeasurementFrame, Model, ModelError, SensorElement,
};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, Noise, SensorCut, Structure, StructureError,
};
use proprio_identification::Robot;
use proprio_identification::robot::{
    BaseMotion, Channel, ChannelRole, IdentificationInput, NamedContact, Stance,
};
use proprio_topics::{Kind, MAX_CONTACTS, MAX_JOINTS, Name, Nanos};

/// Largest number of samples for an estimate of velocity and acceleration. The differentiator keeps
/// 128; the difference is for samples that come while an instant waits for other channels.
const WINDOW: usize = 96;

/// The resolved configuration of the estimator.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The robot, which does not change.
    pub robot: Robot,
    /// Its inertial parameters, offsets and calibrations in use.
    pub state: InertialState,
    /// How long an estimate waits for channels without a sample, by stamps.
    pub max_wait: Nanos,
    /// Whether an estimate waits for them at all.
    pub timing: Timing,
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
    pub drives: Vec<Drive>,
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
        let urdf = config.model.file_name().map(|name| name.to_string_lossy());
        let urdf = urdf.unwrap_or_default();
        let of_urdf = model.warnings().iter();
        let mut warnings: Vec<String> = of_urdf
            .map(|warning| format!("{urdf}: {warning}"))
            .collect();
        warnings.extend(plausible::check(config, &model)?);
        let identification = &config.identification;
        if identification.enabled && identification.inputs.contains(&IdentificationInput::Torque) {
            warnings.push(
                "identification.inputs: on-line identification uses the force/torque sensors alone \
                 and ignores \"torque\"; to use joint torques, run `proprio identify`"
                    .into(),
            );
        }
        let dofs = model.dof_count();
        let mut locked = vec![f64::NAN; dofs];
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
                .ok_or_else(|| format!("locked.{joint}: {}", no_joint(&model, joint)))?;
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
        let mut channels = Vec::new();
        let mut add =
            |kind, name: &str, role| match channels.iter().find(|c: &&Channel| c.name == name) {
                Some(other) if other.kind == kind => Err(format!(
                    "two {} channels are named {name:?}; give each its own name",
                    Kind::word(kind)
                )),
                Some(other) => Err(format!(
                    "{name:?} names a {} channel and a {} channel; give each its own name",
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
            add(Kind::Wrench, &ft.sensor, ChannelRole::Sensor(number))?;
        }
        for (dof, position) in locked.iter().enumerate() {
            if position.is_nan() {
                add(Kind::Joint, model.dof_name(dof), ChannelRole::Joint(dof))?;
            }
        }
        let (contacts, mut specs) = contacts(config, &model)?;
        let skins = skins(config, &model, &contacts, &specs, &mut warnings)?;
        let (base_link, base) = match &config.base {
            Base::Fixed { link, gravity_mps2 } => {
                let frame = frame(&model, link).map_err(|e| format!("base.link: {e}"))?;
                (
                    frame.link,
                    BaseMotion::Standing(standing(&frame, *gravity_mps2)),
                )
            }
            Base::Stance { foot } => {
                let stances = stances(foot, &model, &contacts, &specs)?;
                (
                    stances.first().map_or(0, |s| s.link),
                    BaseMotion::Stance(stances),
                )
            }
            Base::Imu {
                sensor,
                link,
                xyz_m,
                rpy_rad,
            } => {
                let frame = frame(&model, link).map_err(|e| format!("base.link: {e}"))?;
                add(Kind::Imu, sensor, ChannelRole::Base)?;
                (
                    frame.link,
                    BaseMotion::Imu(frame.pose * Pose::from_xyz_rpy(*xyz_m, *rpy_rad)),
                )
            }
        };
        // The ground reaction of the base, unless the configuration has a contact for it.
        let there = |(spec, contact): (&ContactSpec, &NamedContact)| {
            spec.frame.link == base_link && spec.kind == ContactKind::Wrench && contact.always
        };
        let (support, stands) = match &base {
            BaseMotion::Standing(_) => {
                let support = specs.iter().zip(&contacts).position(there);
                (support, support.is_none())
            }
            BaseMotion::Imu(_) => (None, is_untouched(&model, &sensors, &specs, base_link)),
            BaseMotion::Stance(_) => (None, false),
        };
        if stands {
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
        if stands && matches!(base, BaseMotion::Imu(_)) {
            let link = model.link_name(base_link);
            warnings.push(format!(
                "base: no [[contact]] is on the part of the robot that has the IMU; that part does \
                 not fly, so an unknown wrench is taken to act on link {link:?}. Add a [[contact]] \
                 where the robot is held or stands (presence = \"possible\" if it may fly)"
            ));
        }
        let mut always = ContactSet::first(specs.len());
        contacts
            .iter()
            .enumerate()
            .filter(|(_, c)| !c.always)
            .for_each(|(i, _)| always.remove(i));
        let structure = Structure::new(&model, &sensors, &specs, Structure::LENGTH_SCALE).map_err(
            |e| match e {
                StructureError::Contact { index } | StructureError::Direction { index } => {
                    format!(
                        "contact {:?}: {e}",
                        contacts.get(index).map_or("", |c| c.name.as_str())
                    )
                }
                StructureError::TooMany {
                    what: "links",
                    count,
                    most,
                } => format!(
                    "{}: its joints, those in [locked] too, join {count} bodies; {most} at most: \
                     make joints that never move fixed in the URDF (type=\"fixed\")",
                    config.model.display()
                ),
                e => e.to_string(),
            },
        )?;
        let trigger = match &config.output.trigger {
            Some(name) => channels
                .iter()
                .position(|c| c.name == *name)
                .ok_or_else(|| {
                    let names: Vec<_> = channels.iter().map(|c| c.name.as_str()).collect();
                    format!(
                        "output.trigger = {name:?} is not a channel of this configuration; the \
                         channels are: {}",
                        names.join(", ")
                    )
                })?,
            // Sensors come first, then joints.
            None => 0,
        };
        for skin in &skins {
            if let Some(other) = channels.iter().find(|c| c.name == skin.channel) {
                return Err(format!(
                    "{:?} names a {} channel and a skin channel; give each its own name",
                    skin.channel,
                    other.kind.word()
                ));
            }
        }
        if channels.is_empty() {
            return Err(
                "no channel is read: add a [[force_torque]] sensor, a joint that is not locked, or \
                 an IMU"
                    .into(),
            );
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
        let max_deviation = config
            .output
            .max_torque_std_nm
            .map_or_else(|| default_max_deviation(&model), |bound| vec![bound; dofs]);
        let robot = Robot {
            name: config.robot.clone(),
            structure,
            base_link,
            base,
            locked,
            contacts,
            always,
            support,
            channels,
            trigger,
            max_silence,
            position_noise: position_noise_rad,
            offsets: config
                .force_torque
                .iter()
                .map(ForceTorque::offset)
                .collect(),
            calibrations: config
                .force_torque
                .iter()
                .map(ForceTorque::calibration)
                .collect(),
            calibrated: calibration::Kind {
                gain: identification.gain,
                temperature: identification.temperature,
            },
            gain_std: identification.gain_std,
            urdf_relative_std: identification.urdf_relative_std,
            torque_side: identification.torque_side,
            model,
        };
        let mut setup = Self {
            state: InertialState::configured(&robot),
            robot,
            max_wait: Nanos::from_seconds(config.output.max_wait_ms() * 1e-3),
            timing: config.output.timing(),
            max_deviation,
            skins,
            joint_settings: settings(position_noise_rad),
            gyro_settings: settings(angular_velocity_noise_radps),
            drives: Vec::new(),
            learns_drives: false,
            identifies: identification.enabled,
            identification_period: Nanos::from_seconds(1.0 / identification.rate_hz),
            warnings,
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
        self.state.apply(&self.robot, parameters)?;
        self.drives = parameters.drives().to_vec();
        Ok(())
    }

    /// The robot with the parameters and calibrations in use as those of its URDF and
    /// configuration.
    #[must_use]
    pub fn robot_as_identified(&self) -> Robot {
        let mut robot = self.robot.clone();
        robot.model = self.state.model.clone();
        robot.calibrations.clone_from(&self.state.calibrations);
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
    pub fn known_offset(&self, sensor: usize) -> Option<Wrench> {
        let (_, deviation) = self.robot.offsets.get(sensor)?;
        let name = self.robot.sensor_names().nth(sensor)?;
        let is_identified = (self.state.identified())
            .is_some_and(|found| found.offsets().iter().any(|offset| offset.sensor == name));
        let is_known = is_identified || *deviation != UNKNOWN_OFFSET;
        (is_known && !self.identifies)
            .then(|| self.state.offsets.get(sensor).copied())
            .flatten()
    }

    /// Whether channel number `channel` is an F/T sensor whose calibration depends on the
    /// temperature of its board.
    #[must_use]
    pub fn depends_on_temperature(&self, channel: usize) -> bool {
        let role = self.robot.channels.get(channel).map(|channel| channel.role);
        let calibration = match role {
            Some(ChannelRole::Sensor(number)) => self.state.calibrations.get(number),
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

/// Per degree of freedom, the default of [`Setup::max_deviation`] \[Nm or N\].
fn default_max_deviation(model: &Model) -> Vec<f64> {
    /// The effort of a drive is typically ten times the gravity load of the links. A limit above
    /// a hundred times is a placeholder.
    const USUAL: f64 = 10.0;
    const CREDIBLE: f64 = 100.0;
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
            let own = STANDARD_GRAVITY * if is_prismatic { mass } else { moment };
            // Joints that follow add what they carry.
            *load += own * joint.ratio.abs();
        }
        if let Some((sum, moments)) = beyond.get_mut(joint.parent) {
            *sum += mass;
            *moments += moment + mass * joint.placement.translation.norm();
        }
    }
    loads
}

/// A frame, as the configuration and the URDF name it.
const fn frame_word(frame: MeasurementFrame) -> &'static str {
    match frame {
        MeasurementFrame::Child => "child",
        MeasurementFrame::Parent => "parent",
        MeasurementFrame::Sensor => "sensor",
    }
}

/// A direction, as the configuration and the URDF name it.
const fn direction_word(direction: MeasurementDirection) -> &'static str {
    match direction {
        MeasurementDirection::ChildToParent => "child_to_parent",
        MeasurementDirection::ParentToChild => "parent_to_child",
    }
}

/// The element of the URDF that describes a sensor: that of its name in its joint, else the only
/// one of the joint.
fn element_of<'m>(
    model: &'m Model,
    sensor: &str,
    joint: &str,
) -> Result<Option<&'m SensorElement>, String> {
    let of_joint: Vec<_> = model
        .sensors()
        .iter()
        .filter(|e| e.joint == joint)
        .collect();
    let named = of_joint.iter().find(|element| element.name == sensor);
    match (named, &of_joint[..]) {
        (Some(element), _) | (None, [element]) => Ok(Some(element)),
        (None, []) => Ok(None),
        (None, several) => {
            let names: Vec<&str> = several.iter().map(|e| e.name.as_str()).collect();
            Err(format!(
                ": the URDF has several sensors in joint {joint}, none of this name: {}; use the \
                 name of one of them",
                names.join(", ")
            ))
        }
    }
}

fn sensors(
    config: &Config,
    model: &Model,
    warnings: &mut Vec<String>,
) -> Result<Vec<SensorCut>, String> {
    let mut cuts = Vec::new();
    for ft in &config.force_torque {
        let at = format!("force_torque {:?}", ft.sensor);
        let element = element_of(model, &ft.sensor, &ft.joint).map_err(|why| at.clone() + &why)?;
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
            let mut differs = |key: &str, here: &str, urdf: &str| {
                if here != urdf {
                    warnings.push(format!(
                        "{at}: {key} is \"{here}\" here and \"{urdf}\" in the URDF; this file's \
                         value is used"
                    ));
                }
            };
            if let Some(frame) = frame {
                differs("frame", frame_word(frame), frame_word(element.frame));
            }
            if let Some(direction) = direction {
                let urdf = direction_word(element.direction);
                differs("direction", direction_word(direction), urdf);
            }
        }
        let frame = frame
            .or(element.map(|e| e.frame))
            .unwrap_or(MeasurementFrame::Child);
        let direction = direction
            .or(element.map(|e| e.direction))
            .unwrap_or(MeasurementDirection::ChildToParent);
        if let (None, Some(why)) = (element, model.unread_sensor(&ft.joint))
            && (ft.frame.is_none() || ft.direction.is_none())
        {
            return Err(format!(
                "{at}: the URDF does not tell how it measures: {why}; correct it there, or give \
                 frame and direction here"
            ));
        }
        let given = ft.xyz_m.is_some();
        if ft.xyz_m.is_some() != ft.rpy_rad.is_some() {
            return Err(format!(
                "{at}: only one of xyz_m and rpy_rad is given: give both or neither"
            ));
        }
        if given && frame != MeasurementFrame::Sensor {
            return Err(format!(
                "{at}: xyz_m and rpy_rad are allowed with frame = \"sensor\" only; remove them, or \
                 set frame = \"sensor\""
            ));
        }
        let pose = match element {
            _ if given => {
                Pose::from_xyz_rpy(ft.xyz_m.unwrap_or_default(), ft.rpy_rad.unwrap_or_default())
            }
            Some(element) => element.pose,
            None if frame == MeasurementFrame::Sensor => {
                return Err(format!(
                    "{at}: frame = \"sensor\" needs its pose: xyz_m and rpy_rad here, or a sensor \
                     element in the URDF"
                ));
            }
            None => Pose::identity(),
        };
        if let Some(element) = element.filter(|_| given) {
            let apart = element.pose.inverse() * pose;
            let turned = (apart.rotation.trace() - 3.0).abs();
            if apart.translation.norm() > 1e-6 || turned > 1e-9 {
                warnings.push(format!(
                    "{at}: its pose here differs from the one in the URDF; this file's pose is used"
                ));
            }
        }
        let noise = Noise {
            force: ft.noise_n,
            torque: ft.noise_nm,
        };
        let cut = SensorCut::new(model, &ft.joint, frame, direction, &pose, &noise).map_err(
            |e| match e {
                StructureError::NoJoint(_) => format!(
                    "{at}: joint = {:?}: {}",
                    ft.joint,
                    no_joint(model, &ft.joint)
                ),
                e => format!("{at}: {e}"),
            },
        )?;
        cuts.push(cut);
    }
    Ok(cuts)
}

fn contacts(
    config: &Config,
    model: &Model,
) -> Result<(Vec<NamedContact>, Vec<ContactSpec>), String> {
    let (mut names, mut specs) = (Vec::<NamedContact>::new(), Vec::new());
    if config.contact.len() >= MAX_CONTACTS {
        return Err(format!(
            "the configuration has {} contacts; at most {} are possible: remove some",
            config.contact.len(),
            MAX_CONTACTS - 1
        ));
    }
    for contact in &config.contact {
        let at = format!("contact {:?}", contact.name());
        if Name::new(contact.name()).is_none() || contact.name().contains(['/', ',', '"', '\n']) {
            return Err(format!(
                "{at}: a name has at most {} bytes, without / , \" and line ends",
                Name::CAPACITY
            ));
        }
        if names.iter().any(|n| n.name == contact.name()) {
            return Err(format!(
                "{at}: two contacts have this name; give each its own name"
            ));
        }
        let frame = frame(model, &contact.link).map_err(|e| format!("{at}: link: {e}"))?;
        let kind = match (contact.kind, contact.direction) {
            (KindWord::Wrench, _) => ContactKind::Wrench,
            (KindWord::Force, _) => ContactKind::Force,
            (KindWord::ForceAlong, direction) => {
                ContactKind::ForceAlong(Vec3::from(direction.unwrap_or_default()))
            }
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

/// The patches of skin, with their taxels in the frames of their contacts.
fn skins(
    config: &Config,
    model: &Model,
    contacts: &[NamedContact],
    specs: &[ContactSpec],
    warnings: &mut Vec<String>,
) -> Result<Vec<PatchSetup>, String> {
    /// Further from its link's origin than any taxel of a robot's limb \[m\].
    const FAR: f64 = 2.0;
    let mut skins = Vec::<PatchSetup>::new();
    for skin in &config.skin {
        let at = format!("skin {:?}", skin.channel);
        if skins.iter().any(|other| other.channel == skin.channel) {
            return Err(format!(
                "{at}: two skins have this channel; give each its own"
            ));
        }
        let frame = frame(model, &skin.link).map_err(|e| format!("{at}: link: {e}"))?;
        let contact = (contacts.iter().position(|c| c.name == skin.contact)).ok_or_else(|| {
            let names = nearest(&skin.contact, contacts.iter().map(|c| c.name.as_str()));
            format!("{at}: contact = {:?} is not a contact{names}", skin.contact)
        })?;
        let Some(own) = specs.get(contact).map(|spec| spec.frame) else {
            continue;
        };
        if own.link != frame.link {
            return Err(format!(
                "{at}: contact {:?} is on the link {:?}, the skin on {:?}; name a contact on the \
                 skin's link",
                skin.contact,
                model.link_name(own.link),
                model.link_name(frame.link)
            ));
        }
        let map = TaxelMap::load(&skin.taxels).map_err(|e| format!("{at}: taxels: {e}"))?;
        let rows = map.0.len();
        let taxels = map.0.get(skin.first_taxel..).unwrap_or_default();
        let taxels = taxels.get(..TRIANGLE * TRIANGLES).unwrap_or(taxels);
        let count = taxels.iter().flatten().count();
        if count == 0 {
            return Err(format!(
                "{at}: first_taxel = {}: {} has no taxel from there on; it has {rows} rows, \
                 counted from 0",
                skin.first_taxel,
                skin.taxels.display()
            ));
        }
        if taxels
            .iter()
            .flatten()
            .any(|taxel| taxel.position.norm() > FAR)
        {
            warnings.push(format!(
                "{at}: {} places a taxel more than {FAR} m from the origin of {:?}: positions are \
                 in metres",
                skin.taxels.display(),
                skin.link
            ));
        }
        let x_cs = own.pose.inverse() * frame.pose;
        let placed = |taxel: &Taxel| Taxel {
            position: x_cs.point(&taxel.position),
            normal: x_cs.rotation * taxel.normal,
        };
        let of_pitch = || map.pitch().unwrap_or(0.0) / f64::sqrt(12.0);
        skins.push(PatchSetup {
            channel: skin.channel.clone(),
            contact,
            taxels: taxels
                .iter()
                .map(|taxel| taxel.as_ref().map(placed))
                .collect(),
            threshold: threshold(skin.noise, count, skin.false_alarms_per_hour),
            position_std: skin.position_std_m.unwrap_or_else(of_pitch),
            max_silence: Nanos::from_seconds(skin.max_silence_ms * 1e-3),
        });
    }
    Ok(skins)
}

/// The motion of a link while `frame`, which is fixed to it, is at rest.
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
        let contact = contacts
            .iter()
            .position(|c| c.name == foot.contact)
            .ok_or_else(|| {
                let names = nearest(&foot.contact, contacts.iter().map(|c| c.name.as_str()));
                format!("{at}: contact = {:?} is not a contact{names}", foot.contact)
            })?;
        let carries =
            |spec: &ContactSpec| spec.frame.link == frame.link && spec.kind == ContactKind::Wrench;
        if !specs.get(contact).is_some_and(carries) {
            return Err(format!(
                "{at}: contact {:?} must be on the same link and of kind \"wrench\" to carry the \
                 robot",
                foot.contact
            ));
        }
        if stances.iter().any(|other| other.contact == contact) {
            return Err(format!(
                "{at}: contact {:?} already belongs to another foot",
                foot.contact
            ));
        }
        if number + 1 < feet.len() && contacts.get(contact).is_some_and(|c| c.always) {
            return Err(format!(
                "{at}: contact {:?} is always present, so no later foot could become the base; \
                 give it presence = \"possible\"",
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

/// The frame of a link or of a link that was folded into another; the error suggests a similar
/// name.
pub fn frame(model: &Model, name: &str) -> Result<Frame, String> {
    model.frame(name).ok_or_else(|| {
        if model.is_dropped(name) {
            return dropped(model, name);
        }
        format!(
            "{name:?} is not a link of the URDF{}",
            nearest(name, model.frame_names())
        )
    })
}

/// Why the name of a link or joint above the robot is none of the model's.
fn dropped(model: &Model, name: &str) -> String {
    format!(
        "{name:?} is above the robot, which floats in the URDF, and is dropped; the root is the \
         link {:?}",
        model.link_name(0)
    )
}

/// Why a name is not a moving joint, with a suggestion.
fn no_joint(model: &Model, name: &str) -> String {
    if model.is_dropped(name) {
        return dropped(model, name);
    }
    if let Some(leader) = model.held_by(name) {
        return format!(
            "{name:?} follows {leader:?} (<mimic>), a fixed joint, which already holds it; remove \
             it here, or its <mimic> in the URDF"
        );
    }
    if let Some(joint) = model.joint(name)
        && model.joints().get(joint).is_some_and(|j| j.dof.is_none())
    {
        return format!("{name:?} is a fixed joint; there is nothing to lock");
    }
    if model.is_folded(name) {
        return format!("{name:?} is a fixed joint");
    }
    let names = (0..model.joint_count()).map(|j| model.joint_name(j));
    format!(
        "{name:?} is not a joint of the URDF{}",
        nearest(name, names)
    )
}

/// A suggestion for a misspelt name: the most similar one, or some of the names that exist.
pub fn nearest<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> String {
    let names = by_distance(name, names);
    similar(name, &names).unwrap_or_else(|| {
        let some: Vec<_> = names.iter().take(8).map(|(_, n)| *n).collect();
        format!(
            "; the names are {}{}",
            some.join(", "),
            if names.len() > 8 { ", ..." } else { "" }
        )
    })
}

/// The most similar name as a suggestion; none if none is similar.
pub(crate) fn similar_name<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Option<String> {
    similar(name, &by_distance(name, names))
}

/// Names with their distance from `name`, the nearest first.
fn by_distance<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Vec<(usize, &'a str)> {
    let mut names: Vec<_> = names
        .map(|n| (strsim::damerau_levenshtein(name, n), n))
        .collect();
    names.sort_unstable();
    names
}

fn similar(name: &str, by_distance: &[(usize, &str)]) -> Option<String> {
    let (distance, near) = by_distance.first()?;
    (*distance <= name.len() / 2).then(|| format!("; did you mean {near:?}?"))
}
