//! A setup as text, which `proprio estimator --check` prints, and as a [`Description`]: the names
//! behind the numbers of the estimates.

use crate::setup::Setup;
use proprio_dynamics::ContactKind;
use proprio_dynamics::calibration::Gain;
use proprio_dynamics::regressor::identifiable::{Identifiable, Measurement, Offsets, Scope};
use proprio_identification::robot::BaseMotion;
use proprio_topics::{Description, Entry, Kind, Name, Publisher, Role, TRIGGER};
use std::fmt;

impl Setup {
    /// Text for a person: the joints between the base and an F/T sensor. Empty if there are none.
    ///
    /// The torque of such a joint is the sensor's reading plus the load of the links in between,
    /// which depends on their inertial parameters: those of the URDF, unless they were identified.
    /// The standard deviation of the torque contains their uncertainty.
    #[must_use]
    pub fn upstream_note(&self) -> String {
        let (model, cuts) = (&self.robot.model, self.robot.structure.sensors());
        let mut parts = Vec::new();
        for sensor in cuts {
            let (mut joints, mut are_identified) = (Vec::new(), true);
            let mut joint = sensor.joint();
            // Up to the root, or to the next sensor: then both ends of the segment are measured.
            let bounded = loop {
                let parent = model.joints().get(joint).map_or(0, |j| j.parent);
                if parent == 0 {
                    break false;
                }
                are_identified &= self.initial.is_identified(parent);
                joint = parent - 1;
                if cuts.iter().any(|cut| cut.joint() == joint) {
                    break true;
                }
                let moves = model.joints().get(joint).is_some_and(|j| j.dof.is_some());
                // Between a moving joint and a sensor in it there is no mass.
                if moves && model.cut(model.joint_name(joint)) != Some(sensor.joint()) {
                    joints.push(model.joint_name(joint));
                }
            };
            if !joints.is_empty() && !bounded {
                joints.reverse();
                let whose = match are_identified {
                    true => "the identified parameters",
                    false => "the URDF's parameters",
                };
                parts.push(format!(
                    "{} is mounted beyond {}: the torques of these joints also depend on {whose} \
                     of the links in between.",
                    model.joint_name(sensor.joint()),
                    joints.join(", ")
                ));
            }
        }
        parts.join(" ")
    }

    /// Writes which parameters are in use, and their uncertainty.
    fn write_parameters(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let known = if self.robot.urdf_relative_std > 0.0 {
            format!(
                "taken as known to {} %",
                (1e6 * self.robot.urdf_relative_std).round() / 1e4
            )
        } else {
            "taken as exact".to_owned()
        };
        let Some(parameters) = self.initial.identified() else {
            return writeln!(
                f,
                "inertial parameters: the URDF's, {known} (identification.urdf_relative_std)"
            );
        };
        let provenance = parameters.provenance();
        let logs: Vec<_> = provenance
            .logs
            .iter()
            .map(|log| log.file.as_str())
            .collect();
        let from = if logs.is_empty() {
            String::new()
        } else {
            format!(" from {}", logs.join(", "))
        };
        let tau = provenance.tau.map_or(String::new(), |tau| {
            format!(" (scale of the prior: tau = {tau})")
        });
        let links = self.robot.model.link_count();
        writeln!(
            f,
            "inertial parameters: identified by {}{from}{tau}: {} of {links} links",
            provenance.program,
            parameters.identified().count()
        )?;
        let others = (0..links).filter(|&link| !self.initial.is_identified(link));
        let others: Vec<_> = others
            .map(|link| self.robot.model.link_name(link))
            .collect();
        if !others.is_empty() {
            writeln!(f, "  the URDF's, {known}: {}", others.join(", "))?;
        }
        for (index, offset) in parameters.offsets().iter().enumerate() {
            let deviation = parameters.offset_deviation(index).unwrap_or_default();
            let numbers = offset
                .reading
                .force_first()
                .into_iter()
                .zip(deviation.force_first());
            let numbers: Vec<_> = numbers
                .map(|(value, std)| format!("{value:.3} +- {std:.3}"))
                .collect();
            writeln!(
                f,
                "  offset of {} [N, Nm]: {}",
                offset.sensor,
                numbers.join(", ")
            )?;
            if let Some(found) = &offset.calibrated {
                let text = |values: [f64; 6]| values.map(|value| format!("{value:.4}")).join(", ");
                if found.kind.gain != Gain::None {
                    let gain = found.calibration.gain_force_first();
                    let diagonal = text(std::array::from_fn(|i| gain[7 * i]));
                    writeln!(f, "  gain of {}, diagonal: {diagonal}", offset.sensor)?;
                }
                if let (true, Some(reference)) =
                    (found.kind.temperature, found.calibration.reference())
                {
                    let per_kelvin = text(found.calibration.per_kelvin().force_first());
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

    /// Text for a person: how many inertial parameters of a sub-tree are identifiable from its F/T
    /// sensors. None without a sensor.
    fn identifiability_note(&self, number: usize) -> Option<String> {
        let subtree = self.robot.structure.subtrees().get(number)?;
        if subtree.sensors.is_empty() {
            return None;
        }
        // The unknown wrench of an always present contact absorbs the effect of all parameters.
        let hides = |contact: &usize| {
            let spec = self.robot.structure.contacts().get(*contact);
            self.robot.always.contains(*contact)
                && spec.is_some_and(|spec| spec.kind == ContactKind::Wrench)
        };
        if let Some(contact) = subtree.contacts.iter().find(hides) {
            let name = self.robot.contact_label(contact);
            return Some(format!(
                "none of its inertial parameters can be identified while {name} is present"
            ));
        }
        let seen = |offsets| {
            let scope = Scope::SubTree(&self.robot.structure, number);
            Identifiable::new(
                &self.robot.model,
                scope,
                &self.robot.regime(),
                Measurement::Wrench,
                offsets,
            )
            .ok()
        };
        let (known, unknown) = (seen(Offsets::Known)?, seen(Offsets::Unknown)?);
        let lost = match unknown.confused() {
            0 => String::new(),
            n => format!("; {n} of these are not separable from the sensors' offsets"),
        };
        Some(format!(
            "{} independent combinations of its {} inertial parameters can be identified from its \
             F/T{lost}",
            known.rank(),
            known.columns().len()
        ))
    }

    /// The names behind the numbers of the estimates.
    #[must_use]
    pub fn description(&self) -> Box<Description> {
        let name = |text: &str| Name::new(text).unwrap_or(Name::EMPTY);
        let of_skin = |number: usize| {
            let skin = number.checked_sub(self.robot.channels.len());
            skin.and_then(|skin| self.skins.get(skin))
        };
        let channels = self
            .channels()
            .enumerate()
            .map(|(number, (kind, own))| Entry {
                name: name(own),
                origin: match number == self.robot.trigger {
                    true => name(TRIGGER),
                    false => Name::EMPTY,
                },
                kind: kind.in_memory(),
                max_silence: of_skin(number)
                    .map_or(self.robot.max_silence, |skin| skin.max_silence),
                ..Entry::NONE
            });
        let joints = self.robot.joint_names().map(|j| Entry {
            name: name(j),
            role: Role::Joint.in_memory(),
            ..Entry::NONE
        });
        let contacts = self.robot.contacts.iter().map(|c| Entry {
            name: name(&c.name),
            origin: name(&c.frame),
            role: Role::Contact.in_memory(),
            kind: Kind::Wrench.in_memory(),
            ..Entry::NONE
        });
        let subtrees = self.robot.subtree_names().map(|top| Entry {
            name: name(top),
            origin: name(top),
            role: Role::SubTree.in_memory(),
            kind: Kind::Wrench.in_memory(),
            ..Entry::NONE
        });
        let numbered = channels
            .zip(0..)
            .chain(joints.zip(0..))
            .chain(contacts.zip(0..));
        let numbered = numbered.chain(subtrees.zip(0..));
        Box::new(Description::new(
            Publisher::Estimator,
            numbered.map(|(entry, index)| Entry { index, ..entry }),
        ))
    }
}

impl Setup {
    /// Writes where kinematics start.
    fn write_base(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let base = self.robot.model.link_name(self.robot.base_link);
        let stances = match &self.robot.base {
            BaseMotion::Imu(_) => return writeln!(f, "base {base}: an IMU measures its motion"),
            BaseMotion::Standing(_) => return writeln!(f, "base {base}: at rest"),
            BaseMotion::Stance(stances) => stances,
        };
        writeln!(
            f,
            "base: the first of these links whose contact is present, at rest"
        )?;
        for stance in stances {
            let contact = self.robot.contacts.get(stance.contact);
            let contact = contact.map_or("", |contact| contact.name.as_str());
            let link = self.robot.model.link_name(stance.link);
            writeln!(f, "  {link} with contact {contact}")?;
        }
        Ok(())
    }

    /// Writes the channels, the skins, and where F/T sensors are that move.
    fn write_channels(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, channel) in self.robot.channels.iter().enumerate() {
            let trigger = if number == self.robot.trigger {
                " (trigger: each of its stamps gives an estimate)"
            } else {
                ""
            };
            let kind = channel.kind.word();
            writeln!(f, "  reads {kind} {}{trigger}", channel.name)?;
        }
        for skin in &self.skins {
            let taxels = skin.taxels.iter().flatten().count();
            writeln!(
                f,
                "  reads skin {}: {taxels} taxels, pressed above {:.1}; touches of {} within \
                 {:.1} mm",
                skin.channel,
                skin.threshold,
                self.robot.contact_label(skin.contact),
                1e3 * skin.position_std
            )?;
        }
        let model = &self.robot.model;
        let sensors = self.robot.structure.sensors().iter();
        for (sensor, name) in sensors.zip(self.robot.sensor_names()) {
            let joint = model.joint_name(sensor.joint());
            if model.joint(joint) != Some(sensor.joint()) {
                writeln!(
                    f,
                    "  {name} is in the moving joint {joint}, on the side of its child"
                )?;
            }
        }
        Ok(())
    }

    /// Writes which joints are locked or follow others.
    fn write_joints(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let model = &self.robot.model;
        for (number, joint) in model.joints().iter().enumerate() {
            let name = model.joint_name(number);
            match joint.dof.and_then(|_| model.follows(name)) {
                Some(_) if joint.ratio == 0.0 => {
                    writeln!(f, "  locked {name} at {}", joint.offset)?;
                }
                Some(leader) => writeln!(
                    f,
                    "  {name} follows {leader}; the torque of {leader} includes its torque"
                )?,
                None => (),
            }
        }
        for (dof, position) in self.robot.locked.iter().enumerate() {
            if !position.is_nan() {
                writeln!(f, "  locked {} at {position}", model.dof_name(dof))?;
            }
        }
        Ok(())
    }

    /// Writes what each sub-tree is solved from.
    fn write_subtrees(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (model, structure) = (&self.robot.model, &self.robot.structure);
        for (number, subtree) in structure.subtrees().iter().enumerate() {
            let sensors = subtree.sensors.iter();
            let sensors: Vec<_> = sensors
                .filter_map(|s| structure.sensors().get(s))
                .map(|s| model.joint_name(s.joint()))
                .collect();
            let contacts = subtree.contacts.iter();
            let names: Vec<_> = contacts.map(|c| self.robot.contact_label(c)).collect();
            let contacts = subtree.contacts.iter();
            let specs = contacts.filter_map(|c| structure.contacts().get(c));
            let unknowns: usize = specs.map(|spec| spec.kind.unknowns()).sum();
            writeln!(
                f,
                "sub-tree {number} from {}: F/T [{}], contacts [{}]: {unknowns} unknowns in 6 \
                 equations",
                model.link_name(subtree.top),
                sensors.join(", "),
                names.join(", ")
            )?;
            if let Some(note) = self.identifiability_note(number) {
                writeln!(f, "  {note}")?;
            }
        }
        Ok(())
    }
}

impl fmt::Display for Setup {
    /// The text that `proprio estimator --check` prints.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "robot {}: {} links, {} moving joints, {} sub-trees",
            self.robot.name,
            self.robot.model.link_count(),
            self.robot.model.dof_count(),
            self.robot.structure.subtrees().len()
        )?;
        self.write_base(f)?;
        self.write_channels(f)?;
        self.write_joints(f)?;
        self.write_subtrees(f)?;
        self.write_parameters(f)?;
        let note = self.upstream_note();
        if !note.is_empty() {
            writeln!(f, "{note}")?;
        }
        for warning in self.warnings() {
            writeln!(f, "note: {warning}")?;
        }
        Ok(())
    }
}
