//! A URDF text to a [`Model`]: parsed by urdf-rs, checked here (urdf-rs checks nothing), folded, numbered.
//!
//! The text is read twice. roxmltree first: for what urdf-rs drops (`<sensor>`, `<gazebo>`, whether an `<inertial>` was there at all) and for the line of a
//! number that is none. Then urdf-rs, for everything else, on the links and joints alone.
//!
//! What is an error and what a warning: an error is what would make the dynamics wrong or meaningless without anyone noticing. A triangle inequality that is
//! violated (CAD exports do it) is a warning: the numbers computed are those of the inertia as written.

use std::collections::{HashMap, HashSet};

use urdf_rs::JointType;

use super::{Axis, Frame, Joint, JointFacts, JointKind, Limits, Model, ModelError};
use crate::spatial::{Inconsistency, Mat3, Pose, RigidInertia, Vec3};

/// Tolerance on the signs of principal moments, relative to the greatest: a URDF is written by hand or with six digits.
const INERTIA_TOLERANCE: f64 = 1e-5;

/// In which frame an F/T sensor measures: its axes and the point its torque is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeasurementFrame {
    /// The frame of the joint's child link.
    Child,
    /// The frame of the joint's parent link.
    Parent,
    /// A frame of its own, given by its pose in the child link.
    Sensor,
}

/// The wrench of whom on whom an F/T sensor reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeasurementDirection {
    /// The wrench that the child exerts on the parent.
    ChildToParent,
    /// The wrench that the parent exerts on the child.
    ParentToChild,
}

/// An F/T sensor as a URDF describes it: iDynTree's `<sensor>` element, or Gazebo's inside `<gazebo reference="joint">`.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorElement {
    /// Its name.
    pub name: String,
    /// The joint it sits in.
    pub joint: String,
    /// The frame it measures in (child, if the URDF does not say).
    pub frame: MeasurementFrame,
    /// Whose wrench it reports (child to parent, if the URDF does not say).
    pub direction: MeasurementDirection,
    /// Its pose in the joint's child link, `x_cs`: the identity if the URDF does not say. Means something with [`MeasurementFrame::Sensor`] only.
    pub pose: Pose,
}

/// A link as the URDF has it, before folding.
struct RawLink {
    name: String,
    inertia: RigidInertia,
    has_inertial: bool,
}

/// A joint as the URDF has it, before folding.
struct RawJoint {
    name: String,
    kind: JointKind,
    parent: usize,
    child: usize,
    origin: Pose,
    limits: Option<Limits>,
    effort: Option<f64>,
}

/// Reads, checks, folds and numbers.
pub(super) fn read(text: &str, keep: &[&str]) -> Result<Model, ModelError> {
    let document = roxmltree::Document::parse(text).map_err(|error| ModelError::Syntax(error.to_string()))?;
    let mut warnings = Vec::new();
    let with_inertial = check_numbers(&document)?;
    let sensors = read_sensors(&document, &mut warnings);
    let robot = urdf_rs::read_from_string(&dynamics_only(text, &document, &mut warnings))
        .map_err(|error| ModelError::NotUrdf(error.to_string()))?;

    let (links, numbers) = read_links(&robot, &with_inertial, &mut warnings)?;
    let joints = read_joints(&robot, &numbers, &mut warnings)?;
    let tree = Tree::build(&links, &joints)?;
    check_kept(keep, &joints, &sensors)?;
    Folder {
        links: &links,
        joints: &joints,
        keep: keep.iter().copied().collect(),
    }
    .fold(&tree, robot.name, sensors, warnings)
}

/// The links of a URDF with their own inertias, each about its own origin, in the order of the text.
pub(super) fn link_inertias(text: &str) -> Result<Vec<(String, RigidInertia)>, ModelError> {
    let document = roxmltree::Document::parse(text).map_err(|error| ModelError::Syntax(error.to_string()))?;
    let mut warnings = Vec::new();
    let with_inertial = check_numbers(&document)?;
    let robot = urdf_rs::read_from_string(&dynamics_only(text, &document, &mut warnings))
        .map_err(|error| ModelError::NotUrdf(error.to_string()))?;
    let (links, _) = read_links(&robot, &with_inertial, &mut warnings)?;
    Ok(links.into_iter().map(|link| (link.name, link.inertia)).collect())
}

// ---------------------------------------------------------------- numbers, as text

/// Checks every number of `<inertial>`, `<origin>`, `<axis>` and `<limit>`, while their lines are known. Returns the links that have an `<inertial>`.
fn check_numbers(document: &roxmltree::Document<'_>) -> Result<HashSet<String>, ModelError> {
    let robot = document.root_element();
    if !robot.has_tag_name("robot") {
        return Err(ModelError::NotUrdf(format!(
            "its root element is <{}>, not <robot>",
            robot.tag_name().name()
        )));
    }
    let line = |node: roxmltree::Node<'_, '_>| document.text_pos_at(node.range().start).row;
    let mut with_inertial = HashSet::new();
    for owner in robot
        .children()
        .filter(|node| node.has_tag_name("link") || node.has_tag_name("joint"))
    {
        let name = owner.attribute("name").unwrap_or("(without a name)");
        let label = format!("{} {name}", owner.tag_name().name());
        let mut elements: Vec<_> = owner.children().collect();
        if owner.has_tag_name("link") {
            elements.clear();
            if let Some(inertial) = owner.children().find(|node| node.has_tag_name("inertial")) {
                with_inertial.insert(name.to_owned());
                elements.extend(inertial.children());
                for missing in ["mass", "inertia"] {
                    if !elements.iter().any(|node| node.has_tag_name(missing)) {
                        return Err(ModelError::IncompleteInertial {
                            line: line(inertial),
                            link: name.to_owned(),
                            missing,
                        });
                    }
                }
            }
        }
        for element in elements {
            let (attributes, count): (&[&str], usize) = match element.tag_name().name() {
                "origin" => (&["xyz", "rpy"], 3),
                "axis" => (&["xyz"], 3),
                "mass" => (&["value"], 1),
                "inertia" => (&["ixx", "ixy", "ixz", "iyy", "iyz", "izz"], 1),
                "limit" => (&["lower", "upper"], 1),
                _ => continue,
            };
            for &attribute in attributes {
                let Some(value) = element.attribute(attribute) else {
                    continue;
                };
                let numbers: Result<Vec<f64>, _> = value.split_whitespace().map(str::parse).collect();
                let is_number = matches!(&numbers, Ok(numbers) if numbers.len() == count);
                // An infinite limit is no limit.
                let is_wrong = |x: &f64| x.is_nan() || (x.is_infinite() && !element.has_tag_name("limit"));
                if is_number && !numbers.iter().flatten().any(is_wrong) {
                    continue;
                }
                // Only here, for finding the line reads the text from its beginning.
                let (line, owner, attribute, value) = (line(element), label, attribute.to_owned(), value.to_owned());
                let element = format!("<{}>", element.tag_name().name());
                return Err(if is_number {
                    ModelError::NotFinite {
                        line,
                        owner,
                        element,
                        attribute,
                        value,
                    }
                } else {
                    ModelError::Number {
                        line,
                        owner,
                        element,
                        attribute,
                        value,
                        expected: if count == 3 { "three numbers" } else { "a number" },
                    }
                });
            }
        }
    }
    Ok(with_inertial)
}

/// The text without what dynamics do not need (shapes, materials, extensions: most of a URDF) and without repeated elements, at which urdf-rs stumbles. Of
/// repeated ones the first counts, as for urdfdom.
fn dynamics_only(text: &str, document: &roxmltree::Document<'_>, warnings: &mut Vec<String>) -> String {
    let mut dropped = Vec::new();
    let mut keep_first = |node: roxmltree::Node<'_, '_>, wanted: &[&str], owner: &str| {
        let mut seen = HashSet::new();
        for child in node.children().filter(roxmltree::Node::is_element) {
            let tag = child.tag_name().name();
            if wanted.contains(&tag) && !seen.insert(tag) {
                warnings.push(format!("{owner}: <{tag}> is there twice; the first counts"));
                dropped.push(child.range());
            } else if !wanted.contains(&tag) {
                dropped.push(child.range());
            }
        }
    };
    let mut others = Vec::new();
    for node in document.root_element().children().filter(roxmltree::Node::is_element) {
        let owner = format!(
            "{} {}",
            node.tag_name().name(),
            node.attribute("name").unwrap_or("(without a name)")
        );
        match node.tag_name().name() {
            "link" => {
                keep_first(node, &["inertial"], &owner);
                if let Some(inertial) = node.children().find(|child| child.has_tag_name("inertial")) {
                    keep_first(inertial, &["origin", "mass", "inertia"], &owner);
                }
            }
            "joint" => keep_first(node, &["origin", "parent", "child", "axis", "limit", "mimic"], &owner),
            _ => others.push(node.range()),
        }
    }
    dropped.extend(others);
    dropped.sort_by_key(|range| range.start);
    let mut kept = String::with_capacity(text.len());
    let mut end = 0;
    for range in dropped {
        kept.push_str(text.get(end..range.start).unwrap_or_default());
        end = end.max(range.end);
    }
    kept.push_str(text.get(end..).unwrap_or_default());
    kept
}

// ---------------------------------------------------------------- sensors

/// Reads both forms of F/T `<sensor>` elements; what cannot be understood becomes a warning, for the configuration may say all of it.
fn read_sensors(document: &roxmltree::Document<'_>, warnings: &mut Vec<String>) -> Vec<SensorElement> {
    let mut sensors: Vec<SensorElement> = Vec::new();
    let is_sensor =
        |node: &roxmltree::Node<'_, '_>| node.has_tag_name("sensor") && node.attribute("type") == Some("force_torque");
    let robot = document.root_element();
    let plain = robot.children().filter(is_sensor).map(|node| {
        (
            node,
            node.children()
                .find(|child| child.has_tag_name("parent"))
                .and_then(|parent| parent.attribute("joint")),
        )
    });
    let gazebo = robot
        .children()
        .filter(|node| node.has_tag_name("gazebo"))
        .flat_map(|node| {
            node.children()
                .filter(is_sensor)
                .map(move |sensor| (sensor, node.attribute("reference")))
        });
    // iDynTree's form first: where a URDF has both, the other only repeats it.
    for (node, joint) in plain.chain(gazebo) {
        let name = node.attribute("name").unwrap_or_default();
        let read = match joint {
            Some(joint) => read_sensor(node, name, joint),
            None => Err("it does not say in which joint it sits".to_owned()),
        };
        match read {
            Err(why) => warnings.push(format!("F/T sensor element {name}: {why}; it is ignored")),
            Ok(sensor) => match sensors.iter().find(|other| other.name == sensor.name) {
                None => sensors.push(sensor),
                Some(other) if same_sensor(other, &sensor) => {}
                Some(_) => {
                    warnings.push(format!(
                        "F/T sensor {name} is described twice, and differently; the first description counts"
                    ));
                }
            },
        }
    }
    sensors
}

fn read_sensor(node: roxmltree::Node<'_, '_>, name: &str, joint: &str) -> Result<SensorElement, String> {
    let inner = |wanted: &str| {
        node.descendants()
            .find(|child| child.has_tag_name(wanted))
            .and_then(|child| child.text())
            .map(str::trim)
    };
    let frame = match inner("frame") {
        None | Some("child") => MeasurementFrame::Child,
        Some("parent") => MeasurementFrame::Parent,
        Some("sensor") => MeasurementFrame::Sensor,
        Some(other) => return Err(format!("its frame is {other}, not child, parent or sensor")),
    };
    let direction = match inner("measure_direction") {
        None | Some("child_to_parent") => MeasurementDirection::ChildToParent,
        Some("parent_to_child") => MeasurementDirection::ParentToChild,
        Some(other) => {
            return Err(format!(
                "its direction is {other}, not child_to_parent or parent_to_child"
            ));
        }
    };
    let triple = |text: Option<&str>| -> Result<[f64; 3], String> { floats(text.unwrap_or("0 0 0")) };
    let pose = if let Some(origin) = node.children().find(|child| child.has_tag_name("origin")) {
        Pose::from_xyz_rpy(triple(origin.attribute("xyz"))?, triple(origin.attribute("rpy"))?)
    } else if let Some(pose) = node.children().find(|child| child.has_tag_name("pose")) {
        let [x, y, z, roll, pitch, yaw] = floats(pose.text().unwrap_or("0 0 0 0 0 0"))?;
        Pose::from_xyz_rpy([x, y, z], [roll, pitch, yaw])
    } else {
        Pose::identity()
    };
    Ok(SensorElement {
        name: name.to_owned(),
        joint: joint.to_owned(),
        frame,
        direction,
        pose,
    })
}

fn floats<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Option<Vec<f64>> = text
        .split_whitespace()
        .map(|word| word.parse().ok().filter(|x: &f64| x.is_finite()))
        .collect();
    numbers
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| format!("its pose \"{text}\" is not {N} finite numbers"))
}

fn same_sensor(a: &SensorElement, b: &SensorElement) -> bool {
    a.joint == b.joint
        && a.frame == b.frame
        && a.direction == b.direction
        && (a.pose.rotation - b.pose.rotation).amax() < 1e-6
        && (a.pose.translation - b.pose.translation).amax() < 1e-6
}

// ---------------------------------------------------------------- links and joints

fn pose(origin: &urdf_rs::Pose) -> Pose {
    Pose::from_xyz_rpy(origin.xyz.0, origin.rpy.0)
}

fn read_links(
    robot: &urdf_rs::Robot,
    with_inertial: &HashSet<String>,
    warnings: &mut Vec<String>,
) -> Result<(Vec<RawLink>, HashMap<String, usize>), ModelError> {
    if robot.links.is_empty() {
        return Err(ModelError::NoLinks);
    }
    let mut links = Vec::with_capacity(robot.links.len());
    let mut numbers = HashMap::with_capacity(robot.links.len());
    for (number, link) in robot.links.iter().enumerate() {
        if numbers.insert(link.name.clone(), number).is_some() {
            return Err(ModelError::DuplicateLink(link.name.clone()));
        }
        let has_inertial = with_inertial.contains(&link.name);
        let inertia = if has_inertial {
            read_inertia(link, warnings)?
        } else {
            RigidInertia::zero()
        };
        links.push(RawLink {
            name: link.name.clone(),
            inertia,
            has_inertial,
        });
    }
    Ok((links, numbers))
}

fn read_inertia(link: &urdf_rs::Link, warnings: &mut Vec<String>) -> Result<RigidInertia, ModelError> {
    let (mass, i) = (link.inertial.mass.value, &link.inertial.inertia);
    let name = &link.name;
    #[rustfmt::skip]
    let centroidal = Mat3::new(
        i.ixx, i.ixy, i.ixz,
        i.ixy, i.iyy, i.iyz,
        i.ixz, i.iyz, i.izz,
    );
    if mass < 0.0 {
        return Err(ModelError::NegativeMass {
            link: name.clone(),
            mass,
        });
    }
    // The mass is checked above; a unit one lets the other conditions be checked where it is zero.
    let unit = RigidInertia {
        mass: 1.0,
        first_moment: Vec3::zeros(),
        inertia: centroidal,
    };
    match unit.check(INERTIA_TOLERANCE) {
        Err(Inconsistency::NotPositive { least }) => {
            return Err(ModelError::InertiaNotPositive { link: name.clone(), least });
        }
        Err(Inconsistency::Triangle { moments: [a, b, c] }) => warnings.push(format!(
            "link {name}: principal moments {a:.3e}, {b:.3e}, {c:.3e} kg m^2 break the triangle inequality: no body has this inertia; it is used as written"
        )),
        _ => {}
    }
    if mass == 0.0 && centroidal != Mat3::zeros() {
        warnings.push(format!(
            "link {name}: it has no mass but a moment of inertia; both are used as written"
        ));
    }
    let origin = pose(&link.inertial.origin);
    let turned = origin.rotation * centroidal * origin.rotation.transpose();
    Ok(RigidInertia::from_centroidal(mass, &origin.translation, &turned))
}

fn read_joints(
    robot: &urdf_rs::Robot,
    numbers: &HashMap<String, usize>,
    warnings: &mut Vec<String>,
) -> Result<Vec<RawJoint>, ModelError> {
    let mut joints = Vec::with_capacity(robot.joints.len());
    let mut names = HashSet::with_capacity(robot.joints.len());
    for joint in &robot.joints {
        let name = &joint.name;
        if !names.insert(name.as_str()) {
            return Err(ModelError::DuplicateJoint(name.clone()));
        }
        let find = |role: &'static str, link: &String| {
            numbers.get(link).copied().ok_or_else(|| ModelError::UnknownLink {
                joint: name.clone(),
                role,
                link: link.clone(),
            })
        };
        let (parent, child) = (find("parent", &joint.parent.link)?, find("child", &joint.child.link)?);
        let axis = || Axis::new(Vec3::from(joint.axis.xyz.0)).ok_or_else(|| ModelError::ZeroAxis(name.clone()));
        let unsupported = |kind| {
            Err(ModelError::UnsupportedJoint {
                joint: name.clone(),
                kind,
            })
        };
        let kind = match joint.joint_type {
            JointType::Revolute | JointType::Continuous => JointKind::Revolute(axis()?),
            JointType::Prismatic => JointKind::Prismatic(axis()?),
            JointType::Fixed => JointKind::Fixed,
            JointType::Floating => return unsupported("floating"),
            JointType::Planar => return unsupported("planar"),
            JointType::Spherical => return unsupported("spherical"),
        };
        if let Some(mimic) = &joint.mimic {
            warnings.push(format!(
                "joint {name}: <mimic> of {} is ignored; its position must be measured or locked",
                mimic.joint
            ));
        }
        let limited = matches!(joint.joint_type, JointType::Revolute | JointType::Prismatic);
        let limits = limited.then_some(Limits {
            lower: joint.limit.lower,
            upper: joint.limit.upper,
        });
        if let Some(Limits { lower, upper }) = limits
            && lower > upper
        {
            warnings.push(format!(
                "joint {name}: its lower limit {lower} is above its upper limit {upper}"
            ));
        }
        joints.push(RawJoint {
            name: name.clone(),
            kind,
            parent,
            child,
            origin: pose(&joint.origin),
            limits,
            effort: Some(joint.limit.effort).filter(|effort| *effort > 0.0 && effort.is_finite()),
        });
    }
    Ok(joints)
}

/// The URDF's tree: its root, and the joints below each link in the order of the file.
struct Tree {
    root: usize,
    children: Vec<Vec<usize>>,
}

impl Tree {
    fn build(links: &[RawLink], joints: &[RawJoint]) -> Result<Self, ModelError> {
        let mut above: Vec<Option<usize>> = vec![None; links.len()];
        let mut children = vec![Vec::new(); links.len()];
        for (number, joint) in joints.iter().enumerate() {
            if let Some(first) = above[joint.child].replace(number) {
                return Err(ModelError::TwoParents {
                    link: links[joint.child].name.clone(),
                    first: joints[first].name.clone(),
                    second: joint.name.clone(),
                });
            }
            children[joint.parent].push(number);
        }
        let roots: Vec<usize> = (0..links.len()).filter(|&link| above[link].is_none()).collect();
        if roots.len() > 1 {
            return Err(ModelError::SeveralRoots(
                roots.iter().map(|&link| links[link].name.clone()).collect(),
            ));
        }
        // With one parent each, a link that no root leads to is in a loop or below one.
        let mut reached = vec![false; links.len()];
        let mut stack = roots.clone();
        while let Some(link) = stack.pop() {
            reached[link] = true;
            stack.extend(children[link].iter().map(|&joint| joints[joint].child));
        }
        match (roots.first(), reached.iter().position(|&found| !found)) {
            (Some(&root), None) => Ok(Self { root, children }),
            (_, lost) => Err(ModelError::Loop(links[lost.unwrap_or(0)].name.clone())),
        }
    }
}

fn check_kept(keep: &[&str], joints: &[RawJoint], sensors: &[SensorElement]) -> Result<(), ModelError> {
    for &name in keep {
        match joints.iter().find(|joint| joint.name == name) {
            None => {
                let all = || {
                    joints
                        .iter()
                        .filter(|joint| joint.kind == JointKind::Fixed)
                        .map(|joint| joint.name.clone())
                };
                let mut fixed: Vec<String> = all()
                    .filter(|joint| sensors.iter().any(|sensor| sensor.joint == *joint))
                    .collect();
                if fixed.is_empty() {
                    fixed = all().take(10).collect();
                }
                return Err(ModelError::UnknownSensorJoint {
                    joint: name.to_owned(),
                    fixed,
                });
            }
            Some(joint) if joint.kind != JointKind::Fixed => return Err(ModelError::SensorJointMoves(name.to_owned())),
            Some(_) => {}
        }
    }
    Ok(())
}

// ---------------------------------------------------------------- folding

/// Folds fixed joints and numbers what is left.
struct Folder<'a> {
    links: &'a [RawLink],
    joints: &'a [RawJoint],
    keep: HashSet<&'a str>,
}

impl Folder<'_> {
    fn fold(
        &self,
        tree: &Tree,
        name: String,
        sensors: Vec<SensorElement>,
        mut warnings: Vec<String>,
    ) -> Result<Model, ModelError> {
        // Degrees of freedom in the order of the file.
        let mut count = 0;
        let dofs: Vec<Option<usize>> = self
            .joints
            .iter()
            .map(|joint| {
                (joint.kind != JointKind::Fixed).then(|| {
                    count += 1;
                    count - 1
                })
            })
            .collect();
        let mut model = Model {
            name,
            inertias: Vec::new(),
            joints: Vec::new(),
            dofs: vec![0; count],
            link_names: Vec::new(),
            joint_facts: Vec::new(),
            joint_numbers: HashMap::new(),
            folded_joints: HashMap::new(),
            frames: HashMap::with_capacity(self.links.len()),
            sensors,
            warnings: Vec::new(),
        };
        // Bodies depth first: the link on top of each, and the joint that moves it with the body and the pose it hangs from.
        let mut bodies = vec![(tree.root, None::<(usize, usize, Pose)>)];
        while let Some((top, above)) = bodies.pop() {
            let body = model.inertias.len();
            let mut inertia = RigidInertia::zero();
            let mut has_inertial = false;
            let mut below = Vec::new();
            let mut group = vec![(top, Pose::identity())];
            while let Some((link, x_body_link)) = group.pop() {
                inertia = inertia + self.links[link].inertia.transformed(&x_body_link);
                has_inertial |= self.links[link].has_inertial;
                model.frames.insert(
                    self.links[link].name.clone(),
                    Frame {
                        link: body,
                        pose: x_body_link,
                    },
                );
                for &number in &tree.children[link] {
                    let joint = &self.joints[number];
                    let x_body_joint = x_body_link * joint.origin;
                    if joint.kind == JointKind::Fixed && !self.keep.contains(joint.name.as_str()) {
                        model.folded_joints.insert(joint.name.clone(), ());
                        group.push((joint.child, x_body_joint));
                    } else {
                        below.push((joint.child, Some((number, body, x_body_joint))));
                    }
                }
            }
            let link_name = self.links[top].name.clone();
            if let Some((number, parent, placement)) = above {
                let joint = &self.joints[number];
                if !has_inertial {
                    return Err(ModelError::MissingInertial {
                        link: link_name,
                        joint: joint.name.clone(),
                    });
                }
                if inertia.mass == 0.0 {
                    warnings.push(format!(
                        "link {link_name}: what joint {} moves weighs nothing",
                        joint.name
                    ));
                }
                let new = model.joints.len();
                model.joint_numbers.insert(joint.name.clone(), new);
                if let Some(dof) = dofs[number] {
                    model.dofs[dof] = new;
                }
                model.joints.push(Joint {
                    kind: joint.kind,
                    parent,
                    child: body,
                    placement,
                    dof: dofs[number],
                });
                model.joint_facts.push(JointFacts {
                    name: joint.name.clone(),
                    parent_link: self.links[joint.parent].name.clone(),
                    child_link: self.links[joint.child].name.clone(),
                    limits: joint.limits,
                    effort: joint.effort,
                });
            } else if !has_inertial {
                warnings.push(format!("root link {link_name}: neither it nor a link fixed to it has an <inertial>; it is taken to weigh nothing"));
            }
            model.inertias.push(inertia);
            model.link_names.push(link_name);
            // The stack is last in, first out: reversed, the joints of a body come in the order of the file.
            bodies.extend(below.into_iter().rev());
        }
        model.warnings = warnings;
        Ok(model)
    }
}
