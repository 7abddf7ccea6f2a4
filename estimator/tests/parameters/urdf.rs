//! URDFs with the inertias of identified parameters.

use super::{arm, identified, root};
use crate::common::{Random, RandomRobot, gap, size};
use nalgebra::Matrix4;
use proprio_dynamics::model::{Model, ModelError};
use proprio_dynamics::spatial::{Mat3, RigidInertia, Vec3};
use proprio_dynamics::{FrameMotion, Kinematics};
use proptest::prelude::*;

/// A physically consistent body near another one.
fn near(inertia: &RigidInertia, random: &mut Random) -> RigidInertia {
    let stretch = Matrix4::identity() + Matrix4::from_fn(|_, _| random.real(0.15));
    let pseudo = stretch * inertia.pseudo_inertia() * stretch.transpose();
    let sigma: Mat3 = pseudo.fixed_view::<3, 3>(0, 0).into_owned();
    let sigma = (sigma + sigma.transpose()) / 2.0;
    RigidInertia {
        mass: pseudo[(3, 3)],
        first_moment: pseudo.fixed_view::<3, 1>(0, 3).into_owned(),
        inertia: Mat3::from_diagonal_element(sigma.trace()) - sigma,
    }
}

fn check_same(urdf: &str, keep: &[&str], expected: &[RigidInertia]) {
    let model = Model::from_urdf(urdf, keep).unwrap();
    for (link, (got, expected)) in model.inertias().iter().zip(expected).enumerate() {
        let (got, expected) = (got.parameters(), expected.parameters());
        let gap = gap(&got, &expected);
        assert!(
            gap < 1e-12 * size(&expected),
            "{}: {gap:e}",
            model.link_name(link)
        );
    }
}

/// The text without its inertias, to compare the rest.
fn without_inertials(text: &str) -> String {
    let mut rest = text;
    let mut kept = String::new();
    while let Some(from) = rest.find("<inertial>") {
        kept += &rest[..from];
        rest = &rest[from + rest[from..].find("</inertial>").unwrap() + "</inertial>".len()..];
    }
    kept + rest
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn a_urdf_with_other_inertias_says_just_these((links, seed) in (1..=20_usize, any::<u64>())) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let (text, model) = (robot.urdf(), robot.model());
        let keep: Vec<&str> = robot.cuts.iter().map(String::as_str).collect();
        let mut wanted = model.inertias().to_vec();
        for inertia in &mut wanted {
            if random.chance(70) {
                *inertia = near(inertia, &mut random);
            }
        }
        let new = Model::rewrite_urdf(&text, &keep, &wanted).unwrap();
        check_same(&new, &keep, &wanted);
        prop_assert_eq!(without_inertials(&new), without_inertials(&text));
        // Every share is physically consistent.
        let read = urdf_rs::read_from_string(&new).unwrap();
        for link in &read.links {
            let (i, m) = (&link.inertial.inertia, link.inertial.mass.value);
            let tensor = Mat3::new(i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz);
            let share = RigidInertia::from_centroidal(m, &Vec3::zeros(), &tensor);
            prop_assert!(share.check(1e-9).is_ok(), "{}", link.name);
        }
        let same = Model::rewrite_urdf(&text, &keep, model.inertias()).unwrap();
        prop_assert_eq!(same, text, "nothing to change");
    }
}

/// The forms of an inertial element, and of a link without one.
#[test]
fn everything_but_the_inertials_stays_byte_for_byte() {
    let urdf = r#"<?xml version="1.0"?>
<!-- a comment -->
<robot name="r" xmlns:xacro="http://x">
	<link name="base"/>
  <joint name="fixed0" type="fixed"><parent link="base"/><child link="body"/></joint>
    <link name="body">
      <visual><geometry><box size="1 1 1"/></geometry></visual> <!-- stays -->
      <inertial>
        <origin xyz="0.1 0 0" rpy="0 0 1.5"/> <mass value="2"/>
        <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/>
      </inertial>
    </link>
  <joint name="swing" type="continuous">
    <parent link="body"/><child link="frame"/><axis xyz="0 1 0"/>
  </joint>
  <link name="frame"> <!-- nothing --> </link>
  <joint name="fixed1" type="fixed">
    <parent link="frame"/><child link="a"/><origin xyz="0 0 0.3" rpy="0.1 0 0"/>
  </joint>
  <link name="a"><inertial>
    <mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>
  </inertial></link>
  <joint name="fixed2" type="fixed">
    <parent link="a"/><child link="b"/><origin xyz="0.2 0 0"/>
  </joint>
  <link name="b"><inertial>
    <mass value="0.5"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/>
  </inertial></link>
  <transmission name="t"><type>x</type></transmission>
  <gazebo reference="b"><sensor type="camera" name="c"/></gazebo>
</robot>
"#;
    let model = Model::from_urdf(urdf, &[]).unwrap();
    let mut random = Random::new(1);
    let wanted: Vec<RigidInertia> = model
        .inertias()
        .iter()
        .map(|i| near(i, &mut random))
        .collect();
    let new = Model::rewrite_urdf(urdf, &[], &wanted).unwrap();
    check_same(&new, &[], &wanted);
    assert_eq!(without_inertials(&new), without_inertials(urdf));
    assert_eq!(
        new.matches("<inertial>").count(),
        3,
        "frames without mass stay what they are:\n{new}"
    );
    // In the style of the old element.
    assert!(
        new.contains("\n      <inertial>\n        <origin xyz=\""),
        "{new}"
    );
    // Masses change by one factor within a body.
    let read = urdf_rs::read_from_string(&new).unwrap();
    let mass = |name: &str| {
        read.links
            .iter()
            .find(|l| l.name == name)
            .unwrap()
            .inertial
            .mass
            .value
    };
    assert!((mass("a") / mass("b") - 2.0).abs() < 1e-12);

    // A body without mass, on a link that is written as one tag, as two, or with content.
    for link in [
        "<link name=\"tip\"/>",
        "<link name=\"tip\"></link>",
        "<link name=\"tip\"><visual/></link>",
    ] {
        let joint =
            "<joint name=\"j\" type=\"fixed\"><parent link=\"b\"/><child link=\"tip\"/></joint>";
        let text = urdf.replace("</robot>", &format!("{joint}{link}</robot>"));
        // If its joint is kept, it is a separate body without an inertial element. If it is folded,
        // it does not need one.
        let text = text.replace(
            "type=\"fixed\"><parent link=\"b\"/><child link=\"tip\"",
            "type=\"fixed\"><parent link=\"b\"/><child link=\"tip2\"",
        );
        let text = text.replace(
            "</robot>",
            "<link name=\"tip2\"><inertial><mass value=\"0\"/><inertia ixx=\"0\" ixy=\"0\" \
             ixz=\"0\" iyy=\"0\" iyz=\"0\" izz=\"0\"/></inertial></link>\
             <joint name=\"k\" type=\"fixed\"><parent link=\"tip2\"/><child link=\"tip\"/></joint>\
             </robot>",
        );
        let model = Model::from_urdf(&text, &["j"]).unwrap();
        let mut wanted = model.inertias().to_vec();
        let body = model.frame("tip").unwrap().link;
        wanted[body] = RigidInertia::from_centroidal(
            0.3,
            &Vec3::new(0.0, 0.1, 0.0),
            &(Mat3::identity() * 1e-3),
        );
        check_same(
            &Model::rewrite_urdf(&text, &["j"], &wanted).unwrap(),
            &["j"],
            &wanted,
        );
    }
    // The root, without an inertial element on any of its links, in each form.
    for link in [
        "<link name=\"world\"/>",
        "<link name=\"world\"></link>",
        "<link name=\"world\"> <visual/></link>",
    ] {
        let text = urdf.replace(
            "<link name=\"base\"/>",
            &format!(
                "<link name=\"base\"/>{link}<joint \
                name=\"up\" type=\"continuous\"><parent link=\"world\"/><child link=\"base\"/>\
                </joint>"
            ),
        );
        let model = Model::from_urdf(&text, &[]).unwrap();
        let mut wanted = model.inertias().to_vec();
        wanted[0] = wanted[1];
        let new = Model::rewrite_urdf(&text, &[], &wanted).unwrap();
        check_same(&new, &[], &wanted);
        // A self-closing tag is opened for it.
        let plain = |text: &str| {
            without_inertials(text)
                .replace("<link name=\"world\"></link>", "<link name=\"world\"/>")
        };
        assert_eq!(plain(&new), plain(&text));
    }
    // A body with inconsistent shares: the top link with mass gets all of it, and the other links
    // lose theirs.
    let broken = urdf.replace("ixx=\"0.001\"", "ixx=\"0.1\"");
    let new = Model::rewrite_urdf(&broken, &[], &wanted).unwrap();
    check_same(&new, &[], &wanted);
    assert_eq!(
        (
            new.matches("<inertial>").count(),
            new.contains("<link name=\"b\"></link>")
        ),
        (2, true),
        "{new}"
    );

    let model = Model::from_urdf(urdf, &[]).unwrap();
    assert_eq!(
        Model::rewrite_urdf(urdf, &[], &model.inertias()[..1]),
        Err(ModelError::InertiaCount {
            given: 1,
            needed: 2
        })
    );
    let mut infinite = model.inertias().to_vec();
    infinite[1].mass = f64::INFINITY;
    assert!(Model::rewrite_urdf(urdf, &[], &infinite).is_err());
    assert!(matches!(
        Model::rewrite_urdf("<robot", &[], &[]),
        Err(ModelError::Syntax { .. })
    ));
}

#[test]
fn the_urdf_of_identified_parameters_can_be_loaded() {
    let setup = arm();
    let parameters = identified(&setup, &mut Random::new(3));
    let text = std::fs::read_to_string(root().join("config/icub_left_arm/model.urdf")).unwrap();
    let new = parameters.urdf(&text, &setup.robot).unwrap();
    let mut applied = arm();
    applied.apply(&parameters).unwrap();
    check_same(&new, &["l_arm_ft_sensor"], applied.initial.model.inertias());
    assert_eq!(without_inertials(&new), without_inertials(&text));
    let base = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81));
    let model = Model::from_urdf(&new, &["l_arm_ft_sensor"]).unwrap();
    let still = vec![0.0; model.dof_count()];
    let weigh = |model: &Model| {
        let mut kinematics = Kinematics::new(model, 0).unwrap();
        let state = proprio_dynamics::JointState {
            position: &still,
            velocity: &still,
            acceleration: &still,
        };
        kinematics.update(model, state, &base).unwrap();
        kinematics
            .net_wrenches()
            .iter()
            .map(|w| w.force.norm())
            .sum::<f64>()
    };
    assert!((weigh(&model) - weigh(&applied.initial.model)).abs() < 1e-12 * weigh(&model));
}
