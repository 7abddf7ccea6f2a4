//! Reads the elements of a URDF: their numbers and names, with a message that has the place where
//! one is missing or wrong, and the elements of F/T sensors.

use super::{
    ElementRef, MeasurementDirection, MeasurementFrame, ModelError, SensorElement, Unread,
};
use crate::spatial::Pose;
use std::collections::HashSet;
use std::fmt;

/// The place of an element of a link or joint: `line 8: joint turn`.
pub(super) fn place(element: ElementRef<'_>, owner: ElementRef<'_>) -> String {
    let name = owner.attribute("name").unwrap_or("(without a name)");
    format!("line {}: {} {name}", element.line(), owner.name())
}

/// The error that something about an element of a link or joint is.
pub(super) fn defect(
    element: ElementRef<'_>,
    owner: ElementRef<'_>,
    what: impl fmt::Display,
) -> ModelError {
    ModelError::Defect(format!("{}: {what}", place(element, owner)))
}

/// An element's name as it is written.
fn tag(element: ElementRef<'_>) -> String {
    format!("<{}>", element.name())
}

/// The element of this name directly in another one.
pub(super) fn part<'d>(
    parent: ElementRef<'d>,
    owner: ElementRef<'d>,
    name: &str,
    remedy: &str,
) -> Result<ElementRef<'d>, ModelError> {
    parent.child(name).ok_or_else(|| {
        let parent_tag = tag(parent);
        let what = format_args!("its {parent_tag} has no <{name}>; {remedy}");
        defect(parent, owner, what)
    })
}

/// The value of an attribute, which is there, not empty, and expanded.
pub(super) fn required<'d>(
    element: ElementRef<'d>,
    owner: ElementRef<'d>,
    attribute: &str,
    remedy: &str,
) -> Result<&'d str, ModelError> {
    if let Some(value) = element.attribute(attribute) {
        return expanded(element, owner, attribute, value);
    }
    let there: Vec<&str> = element.attributes().collect();
    let lack = if there.contains(&attribute) {
        format!("an empty {attribute}")
    } else if there.is_empty() {
        format!("no {attribute}")
    } else {
        format!("no {attribute} (it has {})", there.join(", "))
    };
    let what = format_args!("its {} has {lack}; {remedy}", tag(element));
    Err(defect(element, owner, what))
}

/// The value of an attribute, unless xacro would put something else in its place.
fn expanded<'d>(
    element: ElementRef<'d>,
    owner: ElementRef<'d>,
    attribute: &str,
    value: &'d str,
) -> Result<&'d str, ModelError> {
    if !value.contains("${") && !value.contains("$(") {
        return Ok(value);
    }
    let what = format!("{} {attribute}=\"{value}\"", tag(element));
    Err(unexpanded(element, owner, &what))
}

fn unexpanded(element: ElementRef<'_>, owner: ElementRef<'_>, what: &str) -> ModelError {
    let what = format_args!(
        "{what} is not expanded: the file is a xacro; expand it first (xacro FILE > model.urdf)"
    );
    defect(element, owner, what)
}

/// Refuses elements that xacro would replace: links and joints may be missing.
pub(super) fn check_expanded(robot: ElementRef<'_>) -> Result<(), ModelError> {
    let mut inside = robot.descendants();
    match inside.find(|node| node.name().starts_with("xacro:")) {
        None => Ok(()),
        Some(left) => Err(unexpanded(left, robot, &tag(left))),
    }
}

/// The `N` numbers of an attribute; none if it is missing or empty.
pub(super) fn numbers<const N: usize>(
    element: ElementRef<'_>,
    owner: ElementRef<'_>,
    attribute: &str,
) -> Result<Option<[f64; N]>, ModelError> {
    let Some(value) = element.attribute(attribute) else {
        return Ok(None);
    };
    expanded(element, owner, attribute, value)?;
    let parsed: Result<Vec<f64>, _> = value.split_whitespace().map(str::parse).collect();
    let numbers = parsed.ok().and_then(|n| <[f64; N]>::try_from(n).ok());
    // An infinite limit means no limit.
    let is_limit = element.name() == "limit";
    let is_wrong = |x: &f64| x.is_nan() || (x.is_infinite() && !is_limit);
    let not = |expected: &str| {
        let what = format_args!("{} {attribute}=\"{value}\" is not {expected}", tag(element));
        Err(defect(element, owner, what))
    };
    match numbers {
        Some(numbers) if !numbers.iter().any(is_wrong) => Ok(Some(numbers)),
        Some(_) => not("finite; write the number that it is"),
        None if N == 3 => not("three numbers with spaces between them"),
        None => not("a number"),
    }
}

/// Warns of elements that occur twice: the first one counts, as in urdfdom.
pub(super) fn once(
    element: ElementRef<'_>,
    owner: ElementRef<'_>,
    names: &[&str],
    warnings: &mut Vec<String>,
) {
    let mut seen = HashSet::new();
    for child in element.children() {
        let name = child.name();
        if names.contains(&name) && !seen.insert(name) {
            warnings.push(format!(
                "{}: <{name}> occurs twice; the first one counts",
                place(child, owner)
            ));
        }
    }
}

/// Reads both forms of F/T `<sensor>` elements. One that cannot be understood becomes a warning,
/// and is kept with what is wrong: the configuration may replace it.
pub(super) fn read_sensors(
    robot: ElementRef<'_>,
    warnings: &mut Vec<String>,
) -> (Vec<SensorElement>, Vec<Unread>) {
    let (mut sensors, mut unread): (Vec<SensorElement>, Vec<Unread>) = (Vec::new(), Vec::new());
    let is_sensor = |node: &ElementRef<'_>| {
        node.name() == "sensor" && node.attribute("type") == Some("force_torque")
    };
    let plain = robot.children().filter(is_sensor).map(|node| {
        (
            node,
            node.child("parent")
                .and_then(|parent| parent.attribute("joint")),
        )
    });
    let gazebo = robot
        .children()
        .filter(|node| node.name() == "gazebo")
        .flat_map(|node| {
            node.children()
                .filter(is_sensor)
                .map(move |sensor| (sensor, node.attribute("reference")))
        });
    // iDynTree's form comes first: where a URDF has both, the other is a repetition.
    for (node, joint) in plain.chain(gazebo) {
        let name = node.attribute("name").unwrap_or_default();
        let read = match joint {
            Some(joint) => read_sensor(node, name, joint),
            None => Err("it does not name its joint".to_owned()),
        };
        match read {
            Err(why) => {
                let why = format!("line {}: F/T sensor element {name}: {why}", node.line());
                warnings.push(format!("{why}; it is ignored"));
                unread.push(Unread {
                    joint: joint.unwrap_or_default().to_owned(),
                    why,
                });
            }
            Ok(sensor) => {
                // A name is its own among the sensors of a joint only.
                let id = (&sensor.joint, &sensor.name);
                match sensors
                    .iter()
                    .find(|other| (&other.joint, &other.name) == id)
                {
                    None => sensors.push(sensor),
                    Some(other) if is_same_description(other, &sensor) => {}
                    Some(_) => warnings.push(format!(
                        "line {}: F/T sensor {name} in joint {} is described twice, and \
                         differently; the first description counts",
                        node.line(),
                        sensor.joint
                    )),
                }
            }
        }
    }
    (sensors, unread)
}

pub(super) fn read_sensor(
    node: ElementRef<'_>,
    name: &str,
    joint: &str,
) -> Result<SensorElement, String> {
    let inner = |wanted: &str| {
        node.descendant(wanted)
            .map(ElementRef::text)
            .filter(|text| !text.is_empty())
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
    let triple =
        |text: Option<&str>| -> Result<[f64; 3], String> { floats(text.unwrap_or("0 0 0")) };
    let pose = if let Some(origin) = node.child("origin") {
        Pose::from_xyz_rpy(
            triple(origin.attribute("xyz"))?,
            triple(origin.attribute("rpy"))?,
        )
    } else if let Some(pose) = node.child("pose") {
        let said = |key| pose.attribute(key).map(str::trim).unwrap_or_default();
        for key in ["relative_to", "frame", "rotation_format"] {
            if !["", "euler_rpy", joint].contains(&said(key)) {
                return Err(format!("its <pose> has {key}=\"{}\"", said(key)));
            }
        }
        let unit = match said("degrees") {
            "" | "false" | "0" => 1.0,
            "true" | "1" => std::f64::consts::PI / 180.0,
            other => return Err(format!("its <pose> has degrees=\"{other}\"")),
        };
        let [x, y, z, roll, pitch, yaw] = floats(if pose.text().is_empty() {
            "0 0 0 0 0 0"
        } else {
            pose.text()
        })?;
        Pose::from_xyz_rpy([x, y, z], [roll, pitch, yaw].map(|angle| unit * angle))
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

pub(super) fn floats<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Option<Vec<f64>> = text
        .split_whitespace()
        .map(|word| word.parse().ok().filter(|x: &f64| x.is_finite()))
        .collect();
    numbers
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| format!("its pose \"{text}\" is not {N} finite numbers"))
}

pub(super) fn is_same_description(a: &SensorElement, b: &SensorElement) -> bool {
    a.joint == b.joint
        && a.frame == b.frame
        && a.direction == b.direction
        && (a.pose.rotation - b.pose.rotation).amax() < 1e-6
        && (a.pose.translation - b.pose.translation).amax() < 1e-6
}
