//! Makes a [`Model`] from a URDF text: read by `xml.rs`, checked, folded and numbered here.
//!
//! Not by urdf-rs: it checks nothing, its messages have no place, and it refuses files for the lack
//! of attributes that nobody uses.
//!
//! Errors are defects that would silently make the dynamics wrong or meaningless. What does no harm
//! is a warning: a violated triangle inequality (common in CAD exports), or an impossible inertia
//! of a part whose body, the links that are fixed together, has a possible one. Such inertias are
//! used as written.

mod elements;

use std::collections::{HashMap, HashSet};
use std::path::Path;

use self::elements::{check_expanded, defect, numbers, once, part, place, read_sensors, required};
use super::xml::{self, Document, ElementRef};
use super::{
    AxisKind, Frame, Joint, JointAxis, JointFacts, JointKind, Limits, MeasurementDirection,
    MeasurementFrame, Model, ModelError, POINT, SensorElement, Unread,
};
use crate::spatial::{Mat3, Pose, RigidInertia, Vec3};

/// Tolerance on the signs of principal moments, relative to the greatest: a URDF is written by hand
/// or with six digits.
const INERTIA_TOLERANCE: f64 = 1e-5;

/// Numbers of links or joints by their names, in the order of the text.
type Numbers<'d> = HashMap<&'d str, usize>;

/// A link of the URDF, before folding.
struct UrdfLink<'d> {
    node: ElementRef<'d>,
    name: &'d str,
    inertia: RigidInertia,
    has_inertial: bool,
    /// The least principal moment about its own centre of mass, where it is negative beyond
    /// tolerance.
    negative: Option<f64>,
}

/// A joint of the URDF, before folding.
struct UrdfJoint<'d> {
    node: ElementRef<'d>,
    name: &'d str,
    /// None if it is `floating` or `planar`.
    kind: Option<JointKind>,
    parent: usize,
    child: usize,
    origin: Pose,
    limits: Option<Limits>,
    effort: Option<f64>,
    velocity: Option<f64>,
    /// The joint that it follows, with multiplier and offset.
    mimic: Option<(&'d str, f64, f64)>,
}

/// The `<robot>` of a document.
pub(super) fn robot<'d>(document: &'d Document<'_>) -> Result<ElementRef<'d>, ModelError> {
    let root = document.root("robot");
    if root.name() == "robot" {
        check_expanded(root)?;
        Ok(root)
    } else {
        Err(ModelError::NotUrdf {
            root: root.name().to_owned(),
        })
    }
}

/// The links of a URDF with their own inertias, each about its own origin, in the order of the
/// text.
pub(super) fn link_inertias<'d>(
    document: &'d Document<'_>,
) -> Result<Vec<(&'d str, RigidInertia)>, ModelError> {
    let (links, _) = read_links(robot(document)?, &mut Vec::new())?;
    Ok(links
        .into_iter()
        .map(|link| (link.name, link.inertia))
        .collect())
}

// ---------------------------------------------------------------- links and joints

/// The pose that an element's `<origin>` gives.
fn origin(node: ElementRef<'_>, owner: ElementRef<'_>) -> Result<Pose, ModelError> {
    let Some(origin) = node.child("origin") else {
        return Ok(Pose::identity());
    };
    let three = |attribute| numbers(origin, owner, attribute).map(Option::unwrap_or_default);
    Ok(Pose::from_xyz_rpy(three("xyz")?, three("rpy")?))
}

/// The name of a link or a joint, which must be the first of its name.
fn name<'d>(
    node: ElementRef<'d>,
    seen: &mut Numbers<'d>,
    nodes: impl Fn(usize) -> ElementRef<'d>,
) -> Result<&'d str, ModelError> {
    let name = required(
        node,
        node,
        "name",
        "write name=\"...\": joints, sensors and configurations refer to it",
    )?;
    match seen.insert(name, seen.len()) {
        None => Ok(name),
        Some(first) => {
            let (kind, first) = (node.name(), nodes(first).line());
            let what =
                format_args!("the {kind} on line {first} has the same name; rename one of them");
            Err(defect(node, node, what))
        }
    }
}

fn read_links<'d>(
    robot: ElementRef<'d>,
    warnings: &mut Vec<String>,
) -> Result<(Vec<UrdfLink<'d>>, Numbers<'d>), ModelError> {
    let mut links: Vec<UrdfLink<'_>> = Vec::new();
    let mut numbers = HashMap::new();
    for node in robot.children().filter(|node| node.name() == "link") {
        let name = name(node, &mut numbers, |first| links[first].node)?;
        let mut link = UrdfLink {
            node,
            name,
            inertia: RigidInertia::zero(),
            has_inertial: false,
            negative: None,
        };
        once(node, node, &["inertial"], warnings);
        if let Some(inertial) = node.child("inertial") {
            link.has_inertial = true;
            read_inertia(&mut link, inertial, warnings)?;
        }
        links.push(link);
    }
    if links.is_empty() {
        return Err(ModelError::NoLinks);
    }
    Ok((links, numbers))
}

fn read_inertia(
    link: &mut UrdfLink<'_>,
    inertial: ElementRef<'_>,
    warnings: &mut Vec<String>,
) -> Result<(), ModelError> {
    let (owner, name) = (link.node, link.name);
    once(inertial, owner, &["origin", "mass", "inertia"], warnings);
    let mass = part(inertial, owner, "mass", "add <mass value=\"...\"/> in kg")?;
    let remedy = "add <inertia ixx=\"...\" .../> about the centre of mass, in kg m^2";
    let tensor = part(inertial, owner, "inertia", remedy)?;
    let number = |node: ElementRef<'_>, attribute, remedy| {
        required(node, owner, attribute, remedy)?;
        numbers(node, owner, attribute).map(|one| one.map_or(0.0, |[number]| number))
    };
    let mass = number(mass, "value", "write value=\"...\", the mass in kg")?;
    let product = "write all six of ixx, ixy, ixz, iyy, iyz, izz; a product of inertia of a \
                   symmetric body is 0";
    let moment = |attribute| number(tensor, attribute, product);
    let (xx, xy, xz) = (moment("ixx")?, moment("ixy")?, moment("ixz")?);
    let (yy, yz, zz) = (moment("iyy")?, moment("iyz")?, moment("izz")?);
    #[rustfmt::skip]
    let centroidal = Mat3::new(
        xx, xy, xz,
        xy, yy, yz,
        xz, yz, zz,
    );
    let mut moments: [f64; 3] = centroidal.symmetric_eigenvalues().into();
    moments.sort_by(f64::total_cmp);
    let [a, b, c] = moments;
    let slack = INERTIA_TOLERANCE * c.abs() + POINT * mass.abs();
    if a < -slack {
        link.negative = Some(a);
    } else if c > a + b + slack {
        warnings.push(format!(
            "link {name}: principal moments {a:.3e}, {b:.3e}, {c:.3e} kg m^2 violate the triangle \
             inequality: no body has this inertia; it is used as written"
        ));
    }
    if mass == 0.0 && centroidal != Mat3::zeros() {
        warnings.push(format!(
            "link {name}: it has no mass but a moment of inertia; both are used as written"
        ));
    }
    let origin = origin(inertial, owner)?;
    let turned = origin.rotation * centroidal * origin.rotation.transpose();
    link.inertia = RigidInertia::from_centroidal(mass, &origin.translation, &turned);
    Ok(())
}

fn read_joints<'d>(
    robot: ElementRef<'d>,
    links: &Numbers<'d>,
    warnings: &mut Vec<String>,
) -> Result<(Vec<UrdfJoint<'d>>, Numbers<'d>), ModelError> {
    let mut joints: Vec<UrdfJoint<'_>> = Vec::new();
    let mut numbers = HashMap::new();
    for node in robot.children().filter(|node| node.name() == "joint") {
        let name = name(node, &mut numbers, |first| joints[first].node)?;
        let used = ["origin", "parent", "child", "axis", "limit", "mimic"];
        once(node, node, &used, warnings);
        let joint = read_joint(node, name, links)?;
        if let Some(Limits { lower, upper }) = joint.limits
            && lower > upper
        {
            warnings.push(format!(
                "joint {name}: its lower limit {lower} is above its upper limit {upper}"
            ));
        }
        joints.push(joint);
    }
    Ok((joints, numbers))
}

/// Whether a joint has a coordinate; one without a kind lets the whole robot float.
fn is_moving(kind: Option<&JointKind>) -> bool {
    kind.is_some_and(|kind| *kind != JointKind::Fixed)
}

fn read_joint<'d>(
    node: ElementRef<'d>,
    name: &'d str,
    links: &Numbers<'d>,
) -> Result<UrdfJoint<'d>, ModelError> {
    let types = "write type=\"revolute\", \"continuous\", \"prismatic\" or \"fixed\"";
    let word = required(node, node, "type", types)?;
    let link = |role, remedy| {
        let element = part(node, node, role, remedy)?;
        let link = required(
            element,
            node,
            "link",
            "write link=\"...\", the name of a link",
        )?;
        links.get(link).copied().ok_or_else(|| {
            let what = format_args!(
                "its {role} link {link} is not in the URDF; correct the name or add the link"
            );
            defect(element, node, what)
        })
    };
    let parent = link("parent", "add <parent link=\"...\"/>")?;
    let child = link("child", "add <child link=\"...\"/>")?;
    let kind = match word {
        "revolute" | "continuous" => Some(JointKind::Revolute(axis(node)?)),
        "prismatic" => Some(JointKind::Prismatic(axis(node)?)),
        "fixed" => Some(JointKind::Fixed),
        "floating" | "planar" => None,
        _ => return Err(unsupported(node)),
    };
    let moves = is_moving(kind.as_ref());
    let limit = |attribute| match node.child("limit") {
        Some(limit) if moves => numbers(limit, node, attribute),
        _ => Ok(None),
    };
    let (lower, upper, effort) = (limit("lower")?, limit("upper")?, limit("effort")?);
    // What cannot be read counts as missing: only the planning of motions needs it.
    let velocity = limit("velocity").ok().flatten();
    let positive = |value: Option<[f64; 1]>| {
        let value = value.map(|[value]| value);
        value.filter(|value| *value > 0.0 && value.is_finite())
    };
    let is_limited = word != "continuous" && (lower.is_some() || upper.is_some());
    let limits = is_limited.then(|| Limits {
        lower: lower.map_or(0.0, |[lower]| lower),
        upper: upper.map_or(0.0, |[upper]| upper),
    });
    // An infinite limit means no limit.
    let limits = limits.filter(|limits| (limits.upper - limits.lower).is_finite());
    let mimic = if moves { mimic(node)? } else { None };
    Ok(UrdfJoint {
        node,
        name,
        kind,
        parent,
        child,
        origin: origin(node, node)?,
        limits,
        effort: positive(effort),
        velocity: positive(velocity),
        mimic,
    })
}

/// The error that a joint of this type is.
fn unsupported(joint: ElementRef<'_>) -> ModelError {
    let kind = joint.attribute("type").unwrap_or_default();
    let what = match kind {
        "floating" | "planar" => {
            "is possible only between the root and the robot, where it is dropped because any \
             link can be the base; remove the joint, or make it of prismatic and continuous joints"
        }
        "spherical" | "ball" => {
            "is not supported; write three continuous joints with massless links between them"
        }
        _ => "is not a type of joint; types are revolute, continuous, prismatic and fixed",
    };
    defect(joint, joint, format_args!("type=\"{kind}\" {what}"))
}

/// The direction of a joint's `<axis>`, x without one.
fn axis(node: ElementRef<'_>) -> Result<JointAxis, ModelError> {
    let Some(axis) = node.child("axis") else {
        return Ok(JointAxis {
            vector: Vec3::x(),
            kind: AxisKind::X(1.0),
        });
    };
    let remedy = "write its direction, such as xyz=\"0 0 1\"";
    required(axis, node, "xyz", remedy)?;
    let direction = numbers(axis, node, "xyz")?.unwrap_or_default();
    let zero = "its <axis> xyz is zero; write a direction, such as xyz=\"0 0 1\"";
    JointAxis::new(Vec3::from(direction)).ok_or_else(|| defect(axis, node, zero))
}

/// The joint that a joint follows, with multiplier and offset.
fn mimic(node: ElementRef<'_>) -> Result<Option<(&str, f64, f64)>, ModelError> {
    let Some(mimic) = node.child("mimic") else {
        return Ok(None);
    };
    let remedy = "write joint=\"...\", the joint that it follows";
    let follows = required(mimic, node, "joint", remedy)?;
    let [multiplier] = numbers(mimic, node, "multiplier")?.unwrap_or([1.0]);
    let [offset] = numbers(mimic, node, "offset")?.unwrap_or([0.0]);
    Ok(Some((follows, multiplier, offset)))
}

/// The URDF's tree: its root, and the joints below each link in the order of the file.
struct Tree {
    root: usize,
    children: Vec<Vec<usize>>,
    /// The links above the robot: those of a floating base that was dropped.
    dropped: HashSet<usize>,
}

impl Tree {
    fn build(
        links: &[UrdfLink<'_>],
        joints: &[UrdfJoint<'_>],
        warnings: &mut Vec<String>,
    ) -> Result<Self, ModelError> {
        let mut above: Vec<Option<usize>> = vec![None; links.len()];
        let mut children = vec![Vec::new(); links.len()];
        for (number, joint) in joints.iter().enumerate() {
            if let Some(first) = above[joint.child].replace(number) {
                let what = format_args!(
                    "its child {} is already the child of joint {} (line {}); loops cannot be \
                     described, only trees: remove one of the joints",
                    links[joint.child].name,
                    joints[first].name,
                    joints[first].node.line()
                );
                return Err(defect(joint.node, joint.node, what));
            }
            children[joint.parent].push(number);
        }
        let roots: Vec<usize> = (0..links.len())
            .filter(|&link| above[link].is_none())
            .collect();
        if roots.len() > 1 {
            let name = |&link: &usize| {
                let UrdfLink { node, name, .. } = &links[link];
                format!("{name} (line {})", node.line())
            };
            return Err(ModelError::SeveralRoots(roots.iter().map(name).collect()));
        }
        // Each link has at most one parent, so a link not reached from the root is in a loop or
        // below one.
        let mut reached = vec![false; links.len()];
        let mut stack = roots.clone();
        while let Some(link) = stack.pop() {
            reached[link] = true;
            stack.extend(children[link].iter().map(|&joint| joints[joint].child));
        }
        if let Some(lost) = reached.iter().position(|&found| !found) {
            let node = links[lost].node;
            let what =
                "the joints above it form a loop; only trees can be described: remove a joint";
            return Err(defect(node, node, what));
        }
        let mut tree = Self {
            // There is one, because it was reached.
            root: roots[0],
            children,
            dropped: HashSet::new(),
        };
        tree.drop_floating_base(links, joints, warnings)?;
        Ok(tree)
    }

    /// A joint that lets the whole robot float, or move in a plane, needs no coordinates: any link
    /// can be the base, whose motion is measured or which stands still. The links above it must be
    /// frames: massless, without other joints.
    fn drop_floating_base(
        &mut self,
        links: &[UrdfLink<'_>],
        joints: &[UrdfJoint<'_>],
        warnings: &mut Vec<String>,
    ) -> Result<(), ModelError> {
        let (mut link, mut above) = (self.root, HashSet::new());
        while links[link].inertia == RigidInertia::zero()
            && let [only] = self.children[link][..]
            && let Some(JointKind::Fixed) | None = joints[only].kind
        {
            above.insert(link);
            link = joints[only].child;
            if joints[only].kind.is_none() {
                warnings.push(format!(
                    "joint {}: it is the motion of the whole robot, so it is dropped: link {} is \
                     the root",
                    joints[only].name, links[link].name
                ));
                self.root = link;
                self.dropped.extend(above.iter().copied());
            }
        }
        let is_robot = |joint: &&UrdfJoint<'_>| !self.dropped.contains(&joint.parent);
        match (joints.iter().filter(is_robot)).find(|joint| joint.kind.is_none()) {
            None => Ok(()),
            Some(joint) => Err(unsupported(joint.node)),
        }
    }
}

fn check_kept(
    keep: &[&str],
    joints: &[UrdfJoint<'_>],
    sensors: &[SensorElement],
) -> Result<(), ModelError> {
    for &name in keep {
        if joints.iter().any(|joint| joint.name == name) {
            continue;
        }
        let (mut some, others): (Vec<_>, Vec<_>) =
            (joints.iter()).partition(|joint| joint.kind == Some(JointKind::Fixed));
        some.extend(others.into_iter().filter(|joint| joint.kind.is_some()));
        let described = |joint: &&UrdfJoint<'_>| sensors.iter().any(|s| s.joint == joint.name);
        if some.iter().any(described) {
            some.retain(described);
        } else {
            some.truncate(10);
        }
        return Err(ModelError::UnknownSensorJoint {
            joint: name.to_owned(),
            some: some.iter().map(|joint| joint.name.to_owned()).collect(),
        });
    }
    Ok(())
}

/// How the positions of the moving joints follow from the degrees of freedom: joint `j` is at
/// `ratio_j q_dof(j) + offset_j`.
struct Coordinates {
    /// Per joint; none for one that does not move.
    of: Vec<Option<(usize, f64, f64)>>,
    /// Per degree of freedom, the joint that it is named after.
    leaders: Vec<usize>,
    /// Joints that follow a fixed one; that one, and where it holds them.
    held: Vec<(usize, usize, f64)>,
}

impl Coordinates {
    /// Degrees of freedom are numbered in the order of the file. A joint with a `<mimic>` has the
    /// one of the joint that it follows, if necessary through others. One that follows a fixed
    /// joint is made fixed where that holds it.
    fn of(
        joints: &mut [UrdfJoint<'_>],
        numbers: &Numbers<'_>,
        warnings: &mut Vec<String>,
    ) -> Result<Self, ModelError> {
        for joint in joints.iter_mut() {
            let is_unknown = |(leader, ..): &(&str, f64, f64)| !numbers.contains_key(leader);
            if let Some((leader, ..)) = joint.mimic.filter(is_unknown) {
                let mimic = joint.node.child("mimic").unwrap_or(joint.node);
                warnings.push(format!(
                    "{}: its <mimic> joint=\"{leader}\" is not a joint of the URDF: it is taken as \
                     a joint of its own, which is measured or in [locked]",
                    place(mimic, joint.node)
                ));
                joint.mimic = None;
            }
        }
        let coordinates = Self::resolve(joints, numbers)?;
        for &(number, leader, position) in &coordinates.held {
            let leader = joints[leader].name;
            let joint = &mut joints[number];
            warnings.push(format!(
                "joint {}: it follows the fixed joint {leader} (<mimic>), so it is held at \
                 {position}",
                joint.name
            ));
            if let Some(kind) = joint.kind.replace(JointKind::Fixed) {
                joint.origin = kind.place(&joint.origin, position, position.sin_cos());
            }
        }
        Ok(coordinates)
    }

    /// The same without changing the joints.
    fn resolve(joints: &[UrdfJoint<'_>], numbers: &Numbers<'_>) -> Result<Self, ModelError> {
        let moves = |joint: &UrdfJoint<'_>| is_moving(joint.kind.as_ref());
        let leads = |joint: &UrdfJoint<'_>| moves(joint) && joint.mimic.is_none();
        let leaders: Vec<usize> = (0..joints.len()).filter(|&j| leads(&joints[j])).collect();
        let (mut of, mut held) = (Vec::with_capacity(joints.len()), Vec::new());
        for (number, joint) in joints.iter().enumerate() {
            if !moves(joint) {
                of.push(None);
                continue;
            }
            let (mut leader, mut ratio, mut offset) = (number, 1.0, 0.0);
            for steps in 0.. {
                let UrdfJoint { node, mimic, .. } = joints[leader];
                let Some((follows, multiplier, shift)) = mimic else {
                    break;
                };
                let error = |reason| {
                    let element = node.child("mimic").unwrap_or(node);
                    let what = format_args!("its <mimic> joint=\"{follows}\" {reason}");
                    defect(element, node, what)
                };
                let Some(&next) = numbers.get(follows) else {
                    break;
                };
                if joints[next].kind.is_none() {
                    return Err(error(
                        "is the motion of the whole robot; name a joint of the robot, or remove \
                         the <mimic>",
                    ));
                }
                if steps == joints.len() {
                    return Err(error(
                        "leads back to the joint itself; one of these joints must follow none",
                    ));
                }
                // q = ratio (multiplier q_next + shift) + offset
                (ratio, offset) = (ratio * multiplier, ratio * shift + offset);
                leader = next;
            }
            if !moves(&joints[leader]) {
                held.push((number, leader, offset));
            }
            let dof = leaders.iter().position(|&other| other == leader);
            of.push(dof.map(|dof| (dof, ratio, offset)));
        }
        Ok(Self { of, leaders, held })
    }
}

// ---------------------------------------------------------------- folding

/// Folds fixed joints and numbers the remaining bodies and joints.
struct Folding<'a, 'd> {
    links: &'a [UrdfLink<'d>],
    joints: &'a [UrdfJoint<'d>],
    keep: HashSet<&'a str>,
    coordinates: Coordinates,
}

/// Links that are fixed together.
struct Fused {
    /// In the frame of the top link.
    inertia: RigidInertia,
    /// The top link first.
    members: Vec<usize>,
    /// The joints that lead to other bodies, with their poses.
    below: Vec<(usize, Pose)>,
}

impl Folding<'_, '_> {
    fn fold(
        &self,
        tree: &Tree,
        name: String,
        (sensors, unread): (Vec<SensorElement>, Vec<Unread>),
        warnings: Vec<String>,
    ) -> Result<Model, ModelError> {
        let mut model = Model {
            name,
            inertias: Vec::new(),
            joints: Vec::new(),
            dofs: vec![0; self.coordinates.leaders.len()],
            link_names: Vec::new(),
            joint_facts: Vec::new(),
            joint_numbers: HashMap::new(),
            folded_joints: HashMap::new(),
            held: (self.coordinates.held.iter())
                .map(|&(joint, leader, _)| [joint, leader].map(|j| self.joints[j].name.to_owned()))
                .map(|[joint, leader]| (joint, leader))
                .collect(),
            frames: HashMap::with_capacity(self.links.len()),
            dropped: (tree.dropped.iter())
                .flat_map(|&link| {
                    let below = tree.children[link].iter().map(|&j| self.joints[j].name);
                    below.chain([self.links[link].name])
                })
                .map(str::to_owned)
                .collect(),
            sensors,
            unread,
            warnings,
        };
        let robot = (0..self.links.len()).filter(|link| !tree.dropped.contains(link));
        let total: f64 = robot.map(|link| self.links[link].inertia.mass.abs()).sum();
        let mut unknown = Vec::new();
        // Bodies depth first: the top link of each, and the joint that moves it, with its parent
        // body and its pose there.
        let mut bodies = vec![(tree.root, None::<(usize, usize, Pose)>)];
        while let Some((top, above)) = bodies.pop() {
            if let Some((number, parent, placement)) = above {
                self.add_joint(&mut model, number, parent, placement);
            }
            let Fused {
                inertia,
                members,
                below,
            } = self.fuse(&mut model, tree, top);
            let has_inertial = members.iter().any(|&link| self.links[link].has_inertial);
            let UrdfLink { node, name, .. } = self.links[top];
            self.check_body(&members, &inertia, total, &mut model.warnings)?;
            match above {
                Some((number, ..)) if !has_inertial => {
                    let joint = self.joints[number].name;
                    unknown.push(format!("{}, beyond joint {joint}", place(node, node)));
                }
                Some((number, ..)) if inertia.mass == 0.0 => model.warnings.push(format!(
                    "link {name}: the body that joint {} moves is massless",
                    self.joints[number].name
                )),
                None if !has_inertial => model.warnings.push(format!(
                    "root link {name}: neither it nor a link fixed to it has an <inertial>; \
                     it is assumed massless"
                )),
                _ => {}
            }
            let body = model.inertias.len();
            model.inertias.push(inertia);
            model.link_names.push(name.to_owned());
            // The stack is last in, first out: pushed in reverse, the joints of a body come in the
            // order of the file.
            let below = below.into_iter().rev();
            bodies.extend(below.map(|(number, placement)| {
                (self.joints[number].child, Some((number, body, placement)))
            }));
        }
        if !unknown.is_empty() {
            return Err(ModelError::Defect(format!(
                "{}: the mass is unknown, because no <inertial> is there or in a link fixed to it; \
                 add one (with mass 0 and inertia 0 if it is meant to be massless)",
                unknown.join("; ")
            )));
        }
        Ok(model)
    }

    /// The links that are fixed to `top`, as the next body of the model.
    fn fuse(&self, model: &mut Model, tree: &Tree, top: usize) -> Fused {
        let body = model.inertias.len();
        let mut fused = Fused {
            inertia: RigidInertia::zero(),
            members: Vec::new(),
            below: Vec::new(),
        };
        let mut group = vec![(top, Pose::identity())];
        while let Some((link, pose)) = group.pop() {
            fused.members.push(link);
            fused.inertia = fused.inertia + self.links[link].inertia.transformed(&pose);
            let name = self.links[link].name.to_owned();
            model.frames.insert(name, Frame { link: body, pose });
            for &number in &tree.children[link] {
                let joint = &self.joints[number];
                let x_body_joint = pose * joint.origin;
                let is_fixed = joint.kind == Some(JointKind::Fixed);
                if is_fixed && !self.keep.contains(joint.name) {
                    let links = [link, joint.child].map(|l| self.links[l].name.to_owned());
                    (model.folded_joints).insert(joint.name.to_owned(), links.into());
                    group.push((joint.child, x_body_joint));
                } else {
                    fused.below.push((number, x_body_joint));
                }
            }
        }
        fused
    }

    /// Adds the joint above the next body. A moving joint with an F/T sensor is divided: into the
    /// joint, which moves a body without mass in the place of its child, and the sensor's cut, a
    /// fixed joint of the same name at the child's side.
    fn add_joint(&self, model: &mut Model, number: usize, parent: usize, placement: Pose) {
        let joint = &self.joints[number];
        let (dof, ratio, offset) = match self.coordinates.of[number] {
            Some((dof, ratio, offset)) => (Some(dof), ratio, offset),
            None => (None, 0.0, 0.0),
        };
        let facts = JointFacts {
            name: joint.name.to_owned(),
            parent_link: self.links[joint.parent].name.to_owned(),
            child_link: self.links[joint.child].name.to_owned(),
            limits: joint.limits,
            effort: joint.effort,
            velocity: joint.velocity,
            mimic: (joint.mimic).map(|(leader, ratio, offset)| (leader.to_owned(), ratio, offset)),
        };
        let new = model.joints.len();
        model.joint_numbers.insert(joint.name.to_owned(), new);
        if let Some(dof) = dof.filter(|&dof| self.coordinates.leaders[dof] == number) {
            model.dofs[dof] = new;
        }
        model.joints.push(Joint {
            kind: joint.kind.unwrap_or(JointKind::Fixed),
            parent,
            child: new + 1,
            placement,
            dof,
            ratio,
            offset,
        });
        model.joint_facts.push(facts.clone());
        if dof.is_some() && self.keep.contains(joint.name) {
            model.inertias.push(RigidInertia::zero());
            let child = &facts.child_link;
            model
                .link_names
                .push(format!("{child} above {}", joint.name));
            model.joints.push(Joint {
                kind: JointKind::Fixed,
                parent: new + 1,
                child: new + 2,
                placement: Pose::identity(),
                dof: None,
                ratio: 0.0,
                offset: 0.0,
            });
            model.joint_facts.push(facts);
        }
    }

    /// Judges the inertia of the links that are fixed together. Up to rounding, it must be
    /// possible; that of one of the links need not be. `total` is the mass of the robot.
    fn check_body(
        &self,
        members: &[usize],
        body: &RigidInertia,
        total: f64,
        warnings: &mut Vec<String>,
    ) -> Result<(), ModelError> {
        let moments = body.about_centre().symmetric_eigenvalues();
        // What the sum of the robot's masses, with arms of a metre, has as rounding error.
        let rounding = f64::EPSILON * total;
        let slack = INERTIA_TOLERANCE * moments.amax() + POINT * body.mass.abs() + rounding;
        // Names the worst of the links, and those that are fixed to it.
        let refused = |value: &dyn Fn(&UrdfLink<'_>) -> f64, what: String, remedy| {
            let links = || members.iter().map(|&link| &self.links[link]);
            let worst = links().min_by(|a, b| value(a).total_cmp(&value(b)));
            let worst = worst.unwrap_or(&self.links[members[0]]);
            let others = links().filter(|other| other.name != worst.name && other.has_inertial);
            let others: Vec<&str> = others.map(|other| other.name).collect();
            let together = if others.is_empty() {
                String::new()
            } else {
                let others = others.join(", ");
                format!(", together with the links fixed to it ({others})")
            };
            let node = worst.node.child("inertial").unwrap_or(worst.node);
            let what = format_args!("{what}{together}; {remedy}");
            Err(defect(node, worst.node, what))
        };
        if body.mass < -rounding {
            let what = format!("the mass is {} kg", body.mass);
            let remedy = "a mass cannot be negative: correct the <mass>";
            return refused(&|link| link.inertia.mass, what, remedy);
        }
        if moments.min() < -slack {
            let what = format!(
                "the inertia is not positive semidefinite (least principal moment about the \
                 centre of mass {:.3e} kg m^2)",
                moments.min()
            );
            let remedy = "no body has this inertia: correct ixx to izz of the <inertia> (about the \
                          centre of mass, in kg m^2)";
            return refused(&|link| link.negative.unwrap_or(0.0), what, remedy);
        }
        for link in members.iter().map(|&link| &self.links[link]) {
            let name = link.name;
            if let Some(least) = link.negative.filter(|least| *least < -rounding) {
                warnings.push(format!(
                    "link {name}: its inertia is not positive semidefinite (least principal moment \
                     {least:.3e} kg m^2): no body has this inertia; it is used as written, because \
                     with the links fixed to it the inertia is possible"
                ));
            }
            if link.inertia.mass < 0.0 {
                warnings.push(format!(
                    "link {name}: its mass is {} kg; it is used as written, because with the links \
                     fixed to it the mass is not negative",
                    link.inertia.mass
                ));
            }
        }
        Ok(())
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
        let document = Document::parse(text)?;
        let robot = robot(&document)?;
        let mut warnings = Vec::new();
        let (sensors, unread) = read_sensors(robot, &mut warnings);
        let (links, link_numbers) = read_links(robot, &mut warnings)?;
        let (mut joints, joint_numbers) = read_joints(robot, &link_numbers, &mut warnings)?;
        let tree = Tree::build(&links, &joints, &mut warnings)?;
        check_kept(keep, &joints, &sensors)?;
        let coordinates = Coordinates::of(&mut joints, &joint_numbers, &mut warnings)?;
        Folding {
            links: &links,
            joints: &joints,
            keep: keep.iter().copied().collect(),
            coordinates,
        }
        .fold(
            &tree,
            robot.attribute("name").unwrap_or_default().to_owned(),
            (sensors, unread),
            warnings,
        )
    }

    /// [`Model::from_urdf`] on a file.
    ///
    /// # Errors
    /// The file cannot be read, or as [`Model::from_urdf`].
    pub fn from_file(path: &Path, keep: &[&str]) -> Result<Self, ModelError> {
        Self::from_urdf(&Self::read_text(path)?, keep)
    }

    /// The text of a URDF file, whatever its encoding: that of its byte order mark or of its
    /// declaration, which then says UTF-8.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read_text(path: &Path) -> Result<String, ModelError> {
        let bytes = std::fs::read(path).map_err(|error| ModelError::Read {
            path: path.to_path_buf(),
            reason: error.to_string(),
        })?;
        Ok(xml::decode(&bytes))
    }
}
