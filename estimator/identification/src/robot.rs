//! The robot: its model, sensors and contacts, and the settings known before any measurement. It
//! does not change; identified parameters are stored elsewhere.

use proprio_dynamics::calibration::{self, Calibration, UNKNOWN_OFFSET};
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::regressor::identifiable::{BaseRegime, JointMotion, Regime};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, FrameMotion, SensorCut, Structure, StructureError,
};
use proprio_topics::{Kind, MAX_JOINTS, MAX_SUBTREES, Nanos, Reason};
use serde::Deserialize;

/// Names of the axes of a wrench, in the order of samples.
pub const AXES: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];

/// The role of a channel of the pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChannelRole {
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
    /// The kind of measurement.
    pub kind: Kind,
    /// Its name.
    pub name: String,
    /// Its role.
    pub role: ChannelRole,
}

/// The base of the kinematics.
#[derive(Debug, Clone, PartialEq)]
pub enum BaseMotion {
    /// The base link stands still, with this motion.
    Standing(FrameMotion),
    /// The first of these links whose contact is present is the base link, and stands still.
    Stance(Vec<Stance>),
    /// An IMU at this pose in the base link measures the motion.
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

/// A published contact.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedContact {
    /// Its name.
    pub name: String,
    /// The frame that its wrench is expressed in.
    pub frame: String,
    /// Whether it is present unless declared absent.
    pub always: bool,
}

/// A measurement that parameters are identified from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum IdentificationInput {
    /// The force/torque sensors.
    Wrench,
    /// Measured joint torques.
    Torque,
}

/// The side of the gear on which joint torques are measured.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TorqueSide {
    /// Between gear and link, by a joint torque sensor. The rotor's inertia is not included.
    #[default]
    Link,
    /// At the motor: current times torque constant and gear ratio. The rotor's inertia is included
    /// and identified, one number per joint (each joint is assumed to have its own motor). The
    /// value is the torque of the joint \[Nm; N for a prismatic joint\], as on the link side. If
    /// torques are no input of identification, they are compared unchanged.
    Motor,
}

/// The constant properties of a robot.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Its name.
    pub name: String,
    /// The model, with the inertial parameters of its URDF (CAD).
    pub model: Model,
    /// Sub-trees, sensors, contacts.
    pub structure: Structure,
    /// The link where kinematics start; with [`BaseMotion::Stance`] the initial one.
    pub base_link: usize,
    /// Its motion.
    pub base: BaseMotion,
    /// Per degree of freedom, its locked position; NaN if it is measured.
    pub locked: Vec<f64>,
    /// The published contacts. The structure may have one more at the end: the support of the
    /// base.
    pub contacts: Vec<NamedContact>,
    /// The contacts that are present without any declaration.
    pub always: ContactSet,
    /// The published contact that carries a fixed base, if any: it cannot be declared absent.
    pub support: Option<usize>,
    /// The channels that are read.
    pub channels: Vec<Channel>,
    /// The number of the channel whose stamps trigger an estimate.
    pub trigger: usize,
    /// The time that a channel may be silent.
    pub max_silence: Nanos,
    /// Peak noise of a joint position \[rad or m\].
    pub position_noise: f64,
    /// Per F/T sensor, the configured offset of its corrected reading, and its standard deviation
    /// [torque; force].
    pub offsets: Vec<(Wrench, [f64; 6])>,
    /// Per F/T sensor, the configured correction of its readings.
    pub calibrations: Vec<Calibration>,
    /// The parameters of the sensors' calibrations that are identified from logs.
    pub calibrated: calibration::Kind,
    /// Relative standard deviation of a gain.
    pub gain_std: f64,
    /// Relative standard deviation of the URDF's inertial parameters.
    pub urdf_relative_std: f64,
    /// The side on which the joint torques used for identification are measured.
    pub torque_side: TorqueSide,
}

/// Why a robot cannot be constructed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RobotError {
    /// The model has no such link.
    #[error("the model has no link {0:?}")]
    NoLink(String),
    /// Sensors and contacts do not fit the model.
    #[error(transparent)]
    Structure(#[from] StructureError),
}

/// The stated standard deviations of an F/T sensor's channels, [torque; force].
pub(crate) fn stated_noise(cut: &SensorCut) -> [f64; 6] {
    Wrench::from_parts(cut.noise().force, cut.noise().torque).torque_first()
}

/// The links from this one up to the root, which is left out.
fn links_above(model: &Model, mut link: usize) -> Vec<usize> {
    let mut links = Vec::new();
    while link > 0 {
        links.push(link);
        link = model.joints()[link - 1].parent;
    }
    links
}

/// The degrees of freedom that move a link against the root.
pub(crate) fn dofs_above(model: &Model, link: usize) -> Vec<usize> {
    let links = links_above(model, link).into_iter();
    links
        .filter_map(|link| model.joints()[link - 1].dof)
        .collect()
}

/// Per degree of freedom, whether it moves one of these links against the base: one of its joints
/// is on a path between them.
pub(crate) fn is_between(model: &Model, base: usize, links: &[usize]) -> Vec<bool> {
    // Joints are compared, not degrees of freedom: several may follow one.
    let of_base = links_above(model, base);
    let mut is_between = vec![false; model.dof_count()];
    for &link in links {
        let above = links_above(model, link);
        let there = above.iter().filter(|link| !of_base.contains(link));
        let back = of_base.iter().filter(|link| !above.contains(link));
        for dof in there
            .chain(back)
            .filter_map(|link| model.joints()[link - 1].dof)
        {
            is_between[dof] = true;
        }
    }
    is_between
}

/// The degrees of freedom that move one of these links against the base, ascending.
pub(crate) fn dofs_between(
    model: &Model,
    base: usize,
    links: &[usize],
) -> impl Iterator<Item = usize> + use<> {
    let all = is_between(model, base, links).into_iter().enumerate();
    all.filter_map(|(dof, is_between)| is_between.then_some(dof))
}

impl Robot {
    /// Per degree of freedom, its position before any sample of it: where it is locked, else 0.
    #[must_use]
    pub fn position_without_samples(&self) -> Vec<f64> {
        let position = |q: &f64| if q.is_nan() { 0.0 } else { *q };
        self.locked.iter().map(position).collect()
    }

    /// The contacts that are present: those that always are, changed by the declarations, of which
    /// `declared` returns a contact's last one. The support of the base cannot be absent.
    #[must_use]
    pub fn active_contacts(&self, declared: impl Fn(usize) -> Option<bool>) -> ContactSet {
        let mut active = self.always;
        for contact in 0..self.structure.contacts().len() {
            match declared(contact) {
                Some(true) => active.insert(contact),
                Some(false) if self.support != Some(contact) => active.remove(contact),
                _ => {}
            }
        }
        active
    }

    /// The link where kinematics start, its motion, and why that motion is not valid. An IMU, if
    /// there is one, replaces the motion.
    #[must_use]
    pub fn base_motion(&self, active: &ContactSet) -> (usize, FrameMotion, Reason) {
        let at_rest = FrameMotion::standing(&Vec3::zeros());
        let stances = match &self.base {
            BaseMotion::Standing(motion) => return (self.base_link, *motion, Reason::None),
            BaseMotion::Imu(_) => return (self.base_link, at_rest, Reason::None),
            BaseMotion::Stance(stances) => stances,
        };
        let standing = stances.iter().find(|s| active.contains(s.contact));
        let fault = standing.map_or(Reason::NoStance, |_| Reason::None);
        standing
            .or(stances.first())
            .map_or((self.base_link, at_rest, fault), |stance| {
                (stance.link, stance.motion, fault)
            })
    }

    /// A robot that stands on its link `base`, with all joints measured: the default settings,
    /// without a configuration file.
    ///
    /// `gravity` is the physical one, in the axes of `base` \[m/s^2\]. Sensors and contacts have
    /// names. Contacts are present unless declared absent. The support of the base is a separate
    /// contact.
    ///
    /// # Errors
    /// [`RobotError`].
    pub fn standing(
        name: &str,
        model: Model,
        base: &str,
        gravity: &Vec3,
        sensors: &[(&str, SensorCut)],
        contacts: &[(&str, ContactSpec)],
    ) -> Result<Self, RobotError> {
        let carried = model
            .frame(base)
            .ok_or_else(|| RobotError::NoLink(base.to_owned()))?;
        let mut specs: Vec<ContactSpec> = contacts.iter().map(|(_, spec)| *spec).collect();
        specs.push(ContactSpec {
            frame: Frame {
                link: carried.link,
                pose: Pose::identity(),
            },
            kind: ContactKind::Wrench,
            position: Vec3::zeros(),
        });
        let cuts: Vec<SensorCut> = sensors.iter().map(|(_, cut)| *cut).collect();
        let channel = |kind, name: &str, role| Channel {
            kind,
            name: name.to_owned(),
            role,
        };
        let of_sensors = sensors.iter().enumerate();
        let of_sensors = of_sensors
            .map(|(number, (name, _))| channel(Kind::Wrench, name, ChannelRole::Sensor(number)));
        let dofs = 0..model.dof_count();
        let of_joints =
            dofs.map(|dof| channel(Kind::Joint, model.dof_name(dof), ChannelRole::Joint(dof)));
        let named = |(name, spec): &(&str, ContactSpec)| NamedContact {
            name: (*name).to_owned(),
            frame: model.link_name(spec.frame.link).to_owned(),
            always: true,
        };
        let rotation = carried.pose.rotation;
        Ok(Self {
            name: name.to_owned(),
            structure: Structure::new(&model, &cuts, &specs, Structure::LENGTH_SCALE)?,
            base_link: carried.link,
            base: BaseMotion::Standing(FrameMotion::standing(&(rotation * gravity))),
            locked: vec![f64::NAN; model.dof_count()],
            contacts: contacts.iter().map(named).collect(),
            always: ContactSet::first(specs.len()),
            support: None,
            channels: of_sensors.chain(of_joints).collect(),
            trigger: 0,
            max_silence: Nanos::from_millis(50),
            position_noise: 4.8e-4,
            offsets: vec![(Wrench::zero(), UNKNOWN_OFFSET); cuts.len()],
            calibrations: vec![Calibration::default(); cuts.len()],
            calibrated: calibration::Kind::default(),
            gain_std: 0.05,
            urdf_relative_std: 0.2,
            torque_side: TorqueSide::Link,
            model,
        })
    }

    /// Number of the F/T sensor with this channel.
    #[must_use]
    pub fn sensor(&self, channel: &str) -> Option<usize> {
        self.channels.iter().find_map(|c| match c.role {
            ChannelRole::Sensor(number) if c.name == channel => Some(number),
            _ => None,
        })
    }

    /// The number of a channel.
    #[must_use]
    pub fn channel(&self, kind: Kind, name: &str) -> Option<usize> {
        let mut channels = self.channels.iter();
        channels.position(|c| c.kind == kind && c.name == name)
    }

    /// The number of a published contact.
    #[must_use]
    pub fn contact(&self, name: &str) -> Option<usize> {
        self.contacts.iter().position(|c| c.name == name)
    }

    /// The degrees of freedom whose torques are published, in the order of the estimates: all, but
    /// without the locked ones if there are more than [`MAX_JOINTS`].
    pub fn published(&self) -> impl Iterator<Item = usize> {
        (0..self.locked.len()).filter(|&dof| self.is_published(dof))
    }

    /// Whether the torque of a degree of freedom is among [`Robot::published`].
    #[must_use]
    pub fn is_published(&self, dof: usize) -> bool {
        let position = self.locked.get(dof);
        position.is_some_and(|q| q.is_nan() || self.locked.len() <= MAX_JOINTS)
    }

    /// The names of the joints, in the order of the estimates.
    pub fn joint_names(&self) -> impl Iterator<Item = &str> {
        self.published().map(|dof| self.model.dof_name(dof))
    }

    /// The names of the contacts, in the order of the estimates.
    pub fn contact_names(&self) -> impl Iterator<Item = &str> {
        self.contacts.iter().map(|c| c.name.as_str())
    }

    /// The names of the F/T sensors' channels, in the order of the structure's sensors.
    pub fn sensor_names(&self) -> impl Iterator<Item = &str> {
        let sensors = 0..self.structure.sensors().len();
        sensors.map(|sensor| {
            let channel = self
                .channels
                .iter()
                .find(|channel| channel.role == ChannelRole::Sensor(sensor));
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

    /// The possible motions while the estimator runs, which determine the parameters that its
    /// sensors can identify at all ([`proprio_dynamics::regressor::identifiable`]). A robot with
    /// several feet is assumed to stand on the first.
    #[must_use]
    pub fn regime(&self) -> Regime {
        let fixed = |motion: &FrameMotion| BaseRegime::Fixed(-motion.proper_acceleration);
        let motion = match &self.base {
            BaseMotion::Standing(motion) => fixed(motion),
            BaseMotion::Stance(stances) => stances
                .first()
                .map_or(BaseRegime::Free, |stance| fixed(&stance.motion)),
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

    /// The name of a contact, as text for a person.
    #[must_use]
    pub fn contact_label(&self, contact: usize) -> &str {
        self.contacts
            .get(contact)
            .map_or("the support of the base", |c| c.name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint that follows one on the way to the base moves the links beyond it.
    #[test]
    fn a_joint_that_follows_another_is_between_links() {
        let link = |name: &str| {
            format!(
                "<link name=\"{name}\"><inertial><mass value=\"1\"/><inertia ixx=\"1\" ixy=\"0\" \
                 ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial></link>"
            )
        };
        let joint = |name: &str, parent: &str, child: &str, mimic: &str| {
            format!(
                "<joint name=\"{name}\" type=\"continuous\"><parent link=\"{parent}\"/>\
                 <child link=\"{child}\"/><axis xyz=\"0 0 1\"/>{mimic}</joint>"
            )
        };
        let text = ["a", "b", "c"].map(link).concat()
            + &joint("first", "a", "b", "")
            + &joint("second", "b", "c", "<mimic joint=\"first\"/>");
        let model = Model::from_urdf(&format!("<robot name=\"r\">{text}</robot>"), &[]).unwrap();
        assert_eq!(model.dof_count(), 1);
        let between =
            |base: usize, link: usize| dofs_between(&model, base, &[link]).collect::<Vec<usize>>();
        assert_eq!(
            [between(0, 2), between(1, 2), between(2, 1)],
            [[0]; 3].map(Vec::from)
        );
        assert_eq!(between(1, 1), Vec::<usize>::new());
    }
}
