//! Makes a [`Model`] from a URDF text: parsed by urdf-rs, checked here (urdf-rs has no checks),
//! folded and numbered.
//!
//! The text is read twice. First by roxmltree: for the elements that urdf-rs drops (`<sensor>`,
//! `<gazebo>`, the presence of an `<inertial>`) and for the line of an invalid number. Then by
//! urdf-rs, for everything else, with only the links and joints.
//!
//! Errors are defects that would silently make the dynamics wrong or meaningless. A violated
//! triangle inequality (common in CAD exports) is only a warning: the inertia is used as written.

mod elements;

use crate::model::urdf::elements::{check_numbers, dynamics_only, read_sensors};
use std::collections::{HashMap, HashSet};
use std::path::Path;

use urdf_rs::JointType;

use super::{
    Axis, Frame, Joint, JointFacts, JointKind, Limits, MeasurementDirection, MeasurementFrame,
    Model, ModelError, SensorElement,
};
use crate::spatial::{Inconsistency, Mat3, Pose, RigidInertia, Vec3};

/// Tolerance on the signs of principal moments, relative to the greatest: a URDF is written by hand
/// or with six digits.
const INERTIA_TOLERANCE: f64 = 1e-5;

/// A link of the URDF, before folding.
struct RawLink {
    name: String,
    inertia: RigidInertia,
    has_inertial: bool,
}

/// A joint of the URDF, before folding.
struct RawJoint {
    name: String,
    kind: JointKind,
    parent: usize,
    child: usize,
    origin: Pose,
    limits: Option<Limits>,
    effort: Option<f64>,
}

/// Reads and checks a URDF, folds fixed joints and numbers the result.
pub(super) fn read(text: &str, keep: &[&str]) -> Result<Model, ModelError> {
    let document =
        roxmltree::Document::parse(text).map_err(|error| ModelError::Syntax(error.to_string()))?;
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

/// The links of a URDF with their own inertias, each about its own origin, in the order of the
/// text.
pub(super) fn link_inertias(text: &str) -> Result<Vec<(String, RigidInertia)>, ModelError> {
    let document =
        roxmltree::Document::parse(text).map_err(|error| ModelError::Syntax(error.to_string()))?;
    let mut warnings = Vec::new();
    let with_inertial = check_numbers(&document)?;
    let robot = urdf_rs::read_from_string(&dynamics_only(text, &document, &mut warnings))
        .map_err(|error| ModelError::NotUrdf(error.to_string()))?;
    let (links, _) = read_links(&robot, &with_inertial, &mut warnings)?;
    Ok(links
        .into_iter()
        .map(|link| (link.name, link.inertia))
        .collect())
}

// ---------------------------------------------------------------- numbers, as text

// ---------------------------------------------------------------- sensors

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

fn read_inertia(
    link: &urdf_rs::Link,
    warnings: &mut Vec<String>,
) -> Result<RigidInertia, ModelError> {
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
    // The mass is checked above; a unit mass allows the other conditions to be checked where it is
    // zero.
    let unit = RigidInertia {
        mass: 1.0,
        first_moment: Vec3::zeros(),
        inertia: centroidal,
    };
    match unit.check(INERTIA_TOLERANCE) {
        Err(Inconsistency::NotPositive { least }) => {
            return Err(ModelError::InertiaNotPositive {
                link: name.clone(),
                least,
            });
        }
        Err(Inconsistency::Triangle { moments: [a, b, c] }) => warnings.push(format!(
            "link {name}: principal moments {a:.3e}, {b:.3e}, {c:.3e} kg m^2 violate the triangle \
             inequality: no body has this inertia; it is used as written"
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
    Ok(RigidInertia::from_centroidal(
        mass,
        &origin.translation,
        &turned,
    ))
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
            numbers
                .get(link)
                .copied()
                .ok_or_else(|| ModelError::UnknownLink {
                    joint: name.clone(),
                    role,
                    link: link.clone(),
                })
        };
        let (parent, child) = (
            find("parent", &joint.parent.link)?,
            find("child", &joint.child.link)?,
        );
        let axis = || {
            Axis::new(Vec3::from(joint.axis.xyz.0))
                .ok_or_else(|| ModelError::ZeroAxis(name.clone()))
        };
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
        let roots: Vec<usize> = (0..links.len())
            .filter(|&link| above[link].is_none())
            .collect();
        if roots.len() > 1 {
            return Err(ModelError::SeveralRoots(
                roots.iter().map(|&link| links[link].name.clone()).collect(),
            ));
        }
        // Each link has at most one parent, so a link not reached from the root is in a loop or
        // below one.
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

fn check_kept(
    keep: &[&str],
    joints: &[RawJoint],
    sensors: &[SensorElement],
) -> Result<(), ModelError> {
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
            Some(joint) if joint.kind != JointKind::Fixed => {
                return Err(ModelError::SensorJointMoves(name.to_owned()));
            }
            Some(_) => {}
        }
    }
    Ok(())
}

// ---------------------------------------------------------------- folding

/// Folds fixed joints and numbers the remaining bodies and joints.
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
        // Bodies depth first: the top link of each, and the joint that moves it, with its parent
        // body and its pose there.
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
                        "link {link_name}: the body that joint {} moves is massless",
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
                warnings.push(format!(
                    "root link {link_name}: neither it nor a link fixed to it has an <inertial>; \
                     it is assumed massless"
                ));
            }
            model.inertias.push(inertia);
            model.link_names.push(link_name);
            // The stack is last in, first out: pushed in reverse, the joints of a body come in the
            // order of the file.
            bodies.extend(below.into_iter().rev());
        }
        model.warnings = warnings;
        Ok(model)
    }
}

impl Model {
    /// Reads a URDF from its text, checks it, and folds every fixed joint except those named in
    /// `keep` (the ones that carry F/T sensors).
    ///
    /// # Errors
    /// The first error found ([`ModelError`]). Oddities that are not errors become lines of
    /// [`Model::warnings`].
    pub fn from_urdf(text: &str, keep: &[&str]) -> Result<Self, ModelError> {
        read(text, keep)
    }

    /// [`Model::from_urdf`] on a file.
    ///
    /// # Errors
    /// The file cannot be read, or as [`Model::from_urdf`].
    pub fn from_file(path: &Path, keep: &[&str]) -> Result<Self, ModelError> {
        let text = std::fs::read_to_string(path).map_err(|error| ModelError::Read {
            path: path.to_path_buf(),
            reason: error.to_string(),
        })?;
        Self::from_urdf(&text, keep)
    }
}
