//! Names as ROS 2 allows them: of topics, types and namespaces.

use std::collections::BTreeMap;

/// `text` as a part of a topic's name. ROS allows ASCII letters, digits and single underscores,
/// and hides what begins with an underscore.
fn legal(text: &str) -> String {
    let mut name = String::new();
    for c in text.chars() {
        let c = if c.is_ascii_alphanumeric() { c } else { '_' };
        if c != '_' || !name.ends_with('_') {
            name.push(c);
        }
    }
    if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
        name.insert(0, 'x');
    }
    name
}

/// The names of all topics in a namespace.
#[derive(Debug)]
pub(crate) struct TopicNames {
    namespace: String,
    /// Of each name that is taken: whose it is.
    taken: BTreeMap<String, String>,
}

impl TopicNames {
    /// `namespace` as [`namespace`] gives it.
    pub(crate) fn new(namespace: &str) -> Self {
        Self {
            namespace: namespace.to_owned(),
            taken: BTreeMap::new(),
        }
    }

    /// The name of `topic` (`/imu/chest-imu`) in ROS. Those of two topics differ: the second one
    /// ends with a number, if they would not.
    pub(crate) fn of(&mut self, topic: &str) -> String {
        let (kind, name) = topic
            .trim_start_matches('/')
            .split_once('/')
            .map_or((topic.trim_start_matches('/'), None), |(kind, name)| {
                (kind, Some(name))
            });
        let plain = match name {
            Some(name) => format!("{}/{kind}/{}", self.namespace, legal(name)),
            None => format!("{}/{kind}", self.namespace),
        };
        let mut unique = plain.clone();
        let mut number = 1;
        while self.taken.get(&unique).is_some_and(|whose| whose != topic) {
            number += 1;
            unique = format!("{plain}_{number}");
        }
        self.taken.insert(unique.clone(), topic.to_owned());
        unique
    }
}

/// The name of a topic in DDS.
pub(crate) fn dds_topic(topic: &str) -> String {
    format!("rt{topic}")
}

/// The name of a type (`sensor_msgs/msg/Imu`) in DDS.
pub(crate) fn dds_type(name: &str) -> String {
    let (package, name) = name.rsplit_once('/').unwrap_or(("", name));
    format!("{}::dds_::{name}_", package.replace('/', "::"))
}

/// A namespace from the command line: empty, or with a slash before each part.
///
/// # Errors
/// It is none that ROS allows.
pub(crate) fn namespace(text: &str) -> Result<String, String> {
    let mut namespace = String::new();
    for part in text.trim_start_matches('/').split('/') {
        match part {
            "" if namespace.is_empty() && text.trim_start_matches('/').is_empty() => {}
            _ if part == legal(part) => {
                namespace.push('/');
                namespace.push_str(part);
            }
            _ => {
                return Err(format!(
                    "a namespace is names that begin with a letter, of letters, digits and single \
                     underscores, with slashes between them: not {part:?}"
                ));
            }
        }
    }
    Ok(namespace)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_legal() {
        let mut topics = TopicNames::new("");
        for (topic, name) in [
            ("/joint_states", "/joint_states"),
            ("/imu/chest_imu", "/imu/chest_imu"),
            ("/imu/chest-imu.1", "/imu/chest_imu_1"),
            ("/ft/2nd  sensor", "/ft/x2nd_sensor"),
            ("/ft/_hidden", "/ft/x_hidden"),
            ("/contact/l/hand", "/contact/l_hand"),
            ("/contact/f\u{fc}\u{df}e", "/contact/f_e"),
            ("/contact/", "/contact/x"),
        ] {
            assert_eq!(topics.of(topic), name);
        }
    }

    #[test]
    fn two_topics_have_two_names() {
        let mut topics = TopicNames::new("/left");
        assert_eq!(topics.of("/ft/a-b"), "/left/ft/a_b");
        assert_eq!(topics.of("/ft/a.b"), "/left/ft/a_b_2");
        assert_eq!(topics.of("/ft/a b"), "/left/ft/a_b_3");
        assert_eq!(topics.of("/ft/a-b"), "/left/ft/a_b");
        assert_eq!(topics.of("/ft/a.b"), "/left/ft/a_b_2");
    }

    #[test]
    fn a_namespace_is_checked() {
        for (text, is) in [("", ""), ("/", ""), ("arm", "/arm"), ("/a/b_1", "/a/b_1")] {
            assert_eq!(namespace(text).as_deref(), Ok(is), "{text}");
        }
        for text in ["a-b", "a//b", "a/", "1", "_a", "a__b", "\u{e4}"] {
            assert!(namespace(text).is_err(), "{text}");
        }
    }

    #[test]
    fn types_are_named_as_in_dds() {
        assert_eq!(
            dds_type("sensor_msgs/msg/JointState"),
            "sensor_msgs::msg::dds_::JointState_"
        );
        assert_eq!(dds_topic("/joint_states"), "rt/joint_states");
    }
}
