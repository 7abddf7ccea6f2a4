//! Handles the parts of a URDF that urdf-rs drops or refuses: sensor elements, invalid numbers,
//! extensions.

use super::{MeasurementDirection, MeasurementFrame, ModelError, SensorElement};
use crate::spatial::Pose;
use std::collections::HashSet;

/// Checks every number of `<inertial>`, `<origin>`, `<axis>` and `<limit>`, while their line
/// numbers are known. Returns the links that have an `<inertial>`.
pub(crate) fn check_numbers(
    document: &roxmltree::Document<'_>,
) -> Result<HashSet<String>, ModelError> {
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
                let numbers: Result<Vec<f64>, _> =
                    value.split_whitespace().map(str::parse).collect();
                let is_number = matches!(&numbers, Ok(numbers) if numbers.len() == count);
                // An infinite limit means no limit.
                let is_wrong =
                    |x: &f64| x.is_nan() || (x.is_infinite() && !element.has_tag_name("limit"));
                if is_number && !numbers.iter().flatten().any(is_wrong) {
                    continue;
                }
                // The line is computed only for an error, because this scans the text from its
                // beginning.
                let (line, owner, attribute, value) =
                    (line(element), label, attribute.to_owned(), value.to_owned());
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
                        expected: if count == 3 {
                            "three numbers"
                        } else {
                            "a number"
                        },
                    }
                });
            }
        }
    }
    Ok(with_inertial)
}

/// The text without elements that the dynamics do not need (shapes, materials, extensions: most of
/// a URDF) and without repeated elements, which urdf-rs refuses. Of repeated elements the first one
/// counts, as in urdfdom.
pub(crate) fn dynamics_only(
    text: &str,
    document: &roxmltree::Document<'_>,
    warnings: &mut Vec<String>,
) -> String {
    let mut dropped = Vec::new();
    let mut keep_first = |node: roxmltree::Node<'_, '_>, wanted: &[&str], owner: &str| {
        let mut seen = HashSet::new();
        for child in node.children().filter(roxmltree::Node::is_element) {
            let tag = child.tag_name().name();
            if wanted.contains(&tag) && !seen.insert(tag) {
                warnings.push(format!(
                    "{owner}: <{tag}> occurs twice; the first one counts"
                ));
                dropped.push(child.range());
            } else if !wanted.contains(&tag) {
                dropped.push(child.range());
            }
        }
    };
    let mut others = Vec::new();
    for node in document
        .root_element()
        .children()
        .filter(roxmltree::Node::is_element)
    {
        let owner = format!(
            "{} {}",
            node.tag_name().name(),
            node.attribute("name").unwrap_or("(without a name)")
        );
        match node.tag_name().name() {
            "link" => {
                keep_first(node, &["inertial"], &owner);
                if let Some(inertial) = node.children().find(|child| child.has_tag_name("inertial"))
                {
                    keep_first(inertial, &["origin", "mass", "inertia"], &owner);
                }
            }
            "joint" => keep_first(
                node,
                &["origin", "parent", "child", "axis", "limit", "mimic"],
                &owner,
            ),
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

/// Reads both forms of F/T `<sensor>` elements. An element that cannot be understood becomes a
/// warning, because the configuration can replace it.
pub(crate) fn read_sensors(
    document: &roxmltree::Document<'_>,
    warnings: &mut Vec<String>,
) -> Vec<SensorElement> {
    let mut sensors: Vec<SensorElement> = Vec::new();
    let is_sensor = |node: &roxmltree::Node<'_, '_>| {
        node.has_tag_name("sensor") && node.attribute("type") == Some("force_torque")
    };
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
    // iDynTree's form comes first: where a URDF has both, the other is a repetition.
    for (node, joint) in plain.chain(gazebo) {
        let name = node.attribute("name").unwrap_or_default();
        let read = match joint {
            Some(joint) => read_sensor(node, name, joint),
            None => Err("it does not name its joint".to_owned()),
        };
        match read {
            Err(why) => warnings.push(format!("F/T sensor element {name}: {why}; it is ignored")),
            Ok(sensor) => match sensors.iter().find(|other| other.name == sensor.name) {
                None => sensors.push(sensor),
                Some(other) if same_sensor(other, &sensor) => {}
                Some(_) => {
                    warnings.push(format!(
                        "F/T sensor {name} is described twice, and differently; the first \
                         description counts"
                    ));
                }
            },
        }
    }
    sensors
}

pub(crate) fn read_sensor(
    node: roxmltree::Node<'_, '_>,
    name: &str,
    joint: &str,
) -> Result<SensorElement, String> {
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
    let triple =
        |text: Option<&str>| -> Result<[f64; 3], String> { floats(text.unwrap_or("0 0 0")) };
    let pose = if let Some(origin) = node.children().find(|child| child.has_tag_name("origin")) {
        Pose::from_xyz_rpy(
            triple(origin.attribute("xyz"))?,
            triple(origin.attribute("rpy"))?,
        )
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

pub(crate) fn floats<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Option<Vec<f64>> = text
        .split_whitespace()
        .map(|word| word.parse().ok().filter(|x: &f64| x.is_finite()))
        .collect();
    numbers
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| format!("its pose \"{text}\" is not {N} finite numbers"))
}

pub(crate) fn same_sensor(a: &SensorElement, b: &SensorElement) -> bool {
    a.joint == b.joint
        && a.frame == b.frame
        && a.direction == b.direction
        && (a.pose.rotation - b.pose.rotation).amax() < 1e-6
        && (a.pose.translation - b.pose.translation).amax() < 1e-6
}
