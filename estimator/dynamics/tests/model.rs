//! The model: folding, numbering, sensor elements, and the message for each kind of error in a
//! URDF.

mod common;

use common::{Random, RandomRobot};
use proprio_dynamics::model::{
    AxisKind, JointKind, MeasurementDirection, MeasurementFrame, Model, ModelError,
};
use proprio_dynamics::spatial::{Pose, RigidInertia, Vec3};
use proptest::prelude::*;

const INERTIAL: &str = "<inertial><origin xyz=\"0.1 0 0\"/><mass value=\"2\"/>\
                        <inertia ixx=\"0.02\" ixy=\"0.001\" ixz=\"0\" iyy=\"0.03\" iyz=\"0\" \
                        izz=\"0.04\"/></inertial>";

/// base -(turn)- arm -(grip, fixed)- tool -(slide)- finger, with massless frames.
fn robot() -> String {
    format!(
        "<robot name=\"r\">
         <link name=\"base\">{INERTIAL}</link>
         <link name=\"arm\">{INERTIAL}</link>
         <link name=\"tool\">{INERTIAL}</link>
         <link name=\"finger\">{INERTIAL}</link>
         <link name=\"tip\"/>
         <joint name=\"slide\" type=\"prismatic\"><parent link=\"tool\"/><child link=\"finger\"/>\
         <origin xyz=\"0 0 0.1\"/><axis xyz=\"1 1 0\"/>\
         <limit lower=\"0\" upper=\"0.1\" effort=\"1\" velocity=\"1\"/></joint>
         <joint name=\"turn\" type=\"revolute\"><parent link=\"base\"/><child link=\"arm\"/>\
         <origin xyz=\"0 0 0.5\" rpy=\"0 0 0.3\"/><axis xyz=\"0 0 -2\"/>\
         <limit lower=\"-1\" upper=\"2\" effort=\"1\" velocity=\"1\"/></joint>
         <joint name=\"grip\" type=\"fixed\"><parent link=\"arm\"/><child link=\"tool\"/>\
         <origin xyz=\"0.2 0 0\" rpy=\"0 0.4 0\"/></joint>
         <joint name=\"end\" type=\"fixed\"><parent link=\"finger\"/><child link=\"tip\"/>\
         <origin xyz=\"0 0 0.05\"/></joint>
         </robot>"
    )
}

fn read(text: &str) -> Result<Model, ModelError> {
    Model::from_urdf(text, &[])
}

/// The message for the robot with `from` replaced by `to`.
fn message(from: &str, to: &str) -> String {
    let text = robot();
    assert!(text.contains(from), "nothing to break: {from}");
    read(&text.replacen(from, to, 1))
        .expect_err("broken")
        .to_string()
}

#[test]
fn fixed_joints_are_folded_unless_kept() {
    let folded = read(&robot()).unwrap();
    assert_eq!(
        (
            folded.link_count(),
            folded.joint_count(),
            folded.dof_count()
        ),
        (3, 2, 2)
    );
    assert_eq!(folded.joint("grip"), None);
    assert!(folded.is_folded("grip") && !folded.is_folded("turn") && !folded.is_folded("nothing"));
    let mut links: Vec<_> = folded.folded_joints().map(|(_, links)| links).collect();
    links.sort_unstable();
    assert_eq!(links, [["arm", "tool"], ["finger", "tip"]]);
    // The body of the arm includes the tool: masses are added, and the tool's inertia is about the
    // arm's origin.
    let arm = folded.frame("arm").unwrap();
    let tool = folded.frame("tool").unwrap();
    assert_eq!(arm.link, tool.link);
    assert_eq!(arm.pose, Pose::identity());
    let alone = read(&robot()).unwrap().inertias()[0];
    let sum = alone + alone.transformed(&tool.pose);
    let body = folded.inertias()[arm.link];
    assert_eq!(body.mass, 4.0);
    assert!(
        (body.inertia - sum.inertia).amax() < 1e-15
            && (body.first_moment - sum.first_moment).amax() < 1e-15
    );
    // The tip is a frame of the finger.
    let tip = folded.frame("tip").unwrap();
    assert_eq!(
        (tip.link, tip.pose.translation),
        (
            folded.frame("finger").unwrap().link,
            Vec3::new(0.0, 0.0, 0.05)
        )
    );

    let kept = Model::from_urdf(&robot(), &["grip"]).unwrap();
    assert_eq!(
        (kept.link_count(), kept.joint_count(), kept.dof_count()),
        (4, 3, 2)
    );
    let grip = kept.joint("grip").unwrap();
    assert_eq!(kept.joints()[grip].kind, JointKind::Fixed);
    assert_eq!(kept.joint_links(grip), Some(("arm", "tool")));
    assert_eq!(kept.frame("tool").unwrap().pose, Pose::identity());
}

#[test]
fn dofs_are_numbered_as_listed_and_links_depth_first() {
    let model = read(&robot()).unwrap();
    assert_eq!([model.dof_name(0), model.dof_name(1)], ["slide", "turn"]);
    assert_eq!(
        (model.dof("turn"), model.dof("grip"), model.dof("nothing")),
        (Some(1), None, None)
    );
    for (number, joint) in model.joints().iter().enumerate() {
        assert_eq!(joint.child, number + 1);
        assert!(joint.parent < joint.child);
    }
    let limits = model.limits(model.joint("turn").unwrap()).unwrap();
    assert_eq!((limits.lower, limits.upper), (-1.0, 2.0));
}

#[test]
fn axes_are_normalised() {
    let model = read(&robot()).unwrap();
    let kind = |name: &str| model.joints()[model.joint(name).unwrap()].kind;
    let JointKind::Revolute(turn) = kind("turn") else {
        panic!("revolute")
    };
    assert_eq!(
        (turn.vector, turn.kind),
        (Vec3::new(0.0, 0.0, -1.0), AxisKind::Z(-1.0))
    );
    let JointKind::Prismatic(slide) = kind("slide") else {
        panic!("prismatic")
    };
    assert!((slide.vector.norm() - 1.0).abs() < 1e-15);
    assert_eq!(slide.kind, AxisKind::Any);
}

/// The inertia of a link is about its origin and in its axes, for any `<inertial><origin>`.
#[test]
fn inertia_is_moved_to_the_link_origin() {
    let text = robot().replacen(
        "<origin xyz=\"0.1 0 0\"/>",
        "<origin xyz=\"0.1 0.2 -0.3\" rpy=\"0.3 0.4 0.5\"/>",
        1,
    );
    let got = read(&text).unwrap().inertias()[0];
    let principal =
        RigidInertia::from_parameters(&[2.0, 0.0, 0.0, 0.0, 0.02, 0.001, 0.0, 0.03, 0.0, 0.04]);
    let expected = principal.transformed(&Pose::from_xyz_rpy([0.1, 0.2, -0.3], [0.3, 0.4, 0.5]));
    assert!(
        (got.inertia - expected.inertia).amax() < 1e-15
            && (got.first_moment - expected.first_moment).amax() < 1e-15
    );
    assert_eq!(got.check(1e-9), Ok(()));
}

#[test]
fn sensor_elements_of_both_forms_are_read() {
    let plain = "<sensor name=\"s\" type=\"force_torque\"><parent joint=\"grip\"/><force_torque>\
        <frame>sensor</frame>\
                 <measure_direction>parent_to_child</measure_direction></force_torque>\
                 <origin xyz=\"1 2 3\" rpy=\"0 0 0.5\"/></sensor>";
    let gazebo = |pose: &str| {
        format!(
            "<gazebo reference=\"grip\"><sensor name=\"s\" type=\"force_torque\"><force_torque>\
             <frame>sensor</frame>\
             <measure_direction>parent_to_child</measure_direction></force_torque>\
             <pose>{pose}</pose></sensor></gazebo>"
        )
    };
    let with = |elements: &str| {
        read(&robot().replace("</robot>", &format!("{elements}</robot>"))).unwrap()
    };
    for elements in [
        plain.to_owned(),
        gazebo("1 2 3 0 0 0.5"),
        gazebo("1 2 3 0 0 0.5") + plain,
    ] {
        let model = with(&elements);
        assert_eq!(model.sensors().len(), 1);
        assert_eq!(model.warnings(), &[] as &[String]);
        let sensor = &model.sensors()[0];
        assert_eq!((sensor.name.as_str(), sensor.joint.as_str()), ("s", "grip"));
        assert_eq!(
            (sensor.frame, sensor.direction),
            (
                MeasurementFrame::Sensor,
                MeasurementDirection::ParentToChild
            )
        );
        assert_eq!(
            sensor.pose,
            Pose::from_xyz_rpy([1.0, 2.0, 3.0], [0.0, 0.0, 0.5])
        );
    }
    // Two descriptions that differ: the plain one counts, with a warning.
    let model = with(&(gazebo("9 9 9 0 0 0") + plain));
    assert_eq!(
        model.sensors()[0].pose.translation,
        Vec3::new(1.0, 2.0, 3.0)
    );
    assert_eq!(
        model.warnings(),
        [
            "line 11: F/T sensor s in joint grip is described twice, and differently; the first \
          description counts"
        ]
    );
    // A sensor's name is its own in its joint only: both arms may have an "s".
    let other = plain.replace("parent_to_child", "child_to_parent");
    let model = with(&(plain.to_owned() + &other.replace("\"grip\"", "\"end\"")));
    let directions = model
        .sensors()
        .iter()
        .map(|s| (s.joint.as_str(), s.direction));
    assert_eq!(
        directions.collect::<Vec<_>>(),
        [
            ("grip", MeasurementDirection::ParentToChild),
            ("end", MeasurementDirection::ChildToParent)
        ]
    );
    // SDF's poses may be in degrees.
    let turned =
        gazebo("1 2 3 0 0 90").replace("<pose>", "<pose degrees=\"true\" relative_to=\"\">");
    assert_eq!(
        with(&turned).sensors()[0].pose,
        Pose::from_xyz_rpy([1.0, 2.0, 3.0], [0.0, 0.0, std::f64::consts::FRAC_PI_2])
    );
    for attribute in [
        "relative_to=\"base\"",
        "rotation_format=\"quat_xyzw\"",
        "degrees=\"x\"",
    ] {
        let model = with(&gazebo("1 2 3 0 0 0").replace("<pose>", &format!("<pose {attribute}>")));
        assert_eq!(model.sensors(), []);
        assert!(
            model
                .unread_sensor("grip")
                .is_some_and(|why| why.contains(attribute))
        );
    }
    // Defaults: child, child to parent. Invalid values: ignored, with a warning.
    let model =
        with("<gazebo reference=\"grip\"><sensor name=\"g\" type=\"force_torque\"/></gazebo>");
    assert_eq!(
        (model.sensors()[0].frame, model.sensors()[0].direction),
        (MeasurementFrame::Child, MeasurementDirection::ChildToParent)
    );
    let model = with(&plain.replace("sensor</frame>", "elsewhere</frame>"));
    assert_eq!(model.sensors(), []);
    assert_eq!(
        model.warnings(),
        [
            "line 11: F/T sensor element s: its frame is elsewhere, not child, parent or sensor; \
             it is ignored"
        ]
    );
    // Other sensors and other Gazebo extensions are ignored.
    assert_eq!(
        with("<gazebo><plugin/></gazebo><sensor name=\"i\" type=\"imu\"/>").sensors(),
        []
    );
}

#[test]
fn malformed_files_have_one_clear_message_each() {
    let is = |from: &str, to: &str, expected: &str| assert_eq!(message(from, to), expected);
    is(
        "<child link=\"tip\"/>",
        "<child link=\"tap\"/>",
        "line 10: joint end: its child link tap is not in the URDF; correct the name or add the \
         link",
    );
    is(
        "<parent link=\"tool\"/>",
        "<parent link=\"toll\"/>",
        "line 7: joint slide: its parent link toll is not in the URDF; correct the name or add \
         the link",
    );
    is(
        "mass value=\"2\"",
        "mass value=\"NaN\"",
        "line 2: link base: <mass> value=\"NaN\" is not finite; write the number that it is",
    );
    is(
        "ixy=\"0.001\"",
        "ixy=\"inf\"",
        "line 2: link base: <inertia> ixy=\"inf\" is not finite; write the number that it is",
    );
    is(
        "rpy=\"0 0 0.3\"",
        "rpy=\"0 0 nan\"",
        "line 8: joint turn: <origin> rpy=\"0 0 nan\" is not finite; write the number that it is",
    );
    is(
        "xyz=\"0 0 0.5\"",
        "xyz=\"0 0.5\"",
        "line 8: joint turn: <origin> xyz=\"0 0.5\" is not three numbers with spaces between them",
    );
    is(
        "upper=\"2\"",
        "upper=\"two\"",
        "line 8: joint turn: <limit> upper=\"two\" is not a number",
    );
    is(
        "<axis xyz=\"0 0 -2\"/>",
        "<axis xyz=\"0 0 0\"/>",
        "line 8: joint turn: its <axis> xyz is zero; write a direction, such as xyz=\"0 0 1\"",
    );
    is(
        "mass value=\"2\"",
        "mass value=\"-2\"",
        "line 2: link base: the mass is -2 kg; a mass cannot be negative: correct the <mass>",
    );
    is(
        "<mass value=\"2\"/>",
        "",
        "line 2: link base: its <inertial> has no <mass>; add <mass value=\"...\"/> in kg",
    );
    is(
        "ixx=\"0.02\"",
        "ixx=\"-0.02\"",
        "line 2: link base: the inertia is not positive semidefinite (least principal moment about \
         the centre of mass -2.002e-2 kg m^2); no body has this inertia: correct ixx to izz of the \
         <inertia> (about the centre of mass, in kg m^2)",
    );
    is(
        "<link name=\"tip\"/>",
        "<link name=\"tip\"/><link name=\"tip\"/>",
        "line 6: link tip: the link on line 6 has the same name; rename one of them",
    );
    is(
        "name=\"end\"",
        "name=\"grip\"",
        "line 10: joint grip: the joint on line 9 has the same name; rename one of them",
    );
    is(
        "<child link=\"tip\"/>",
        "<child link=\"arm\"/>",
        "line 10: joint end: its child arm is already the child of joint turn (line 8); loops \
         cannot be described, only trees: remove one of the joints",
    );
    is(
        "type=\"prismatic\"",
        "type=\"planar\"",
        "line 7: joint slide: type=\"planar\" is possible only between the root and the robot, \
         where it is dropped because any link can be the base; remove the joint, or make it \
         of prismatic and continuous joints",
    );
    is(
        "type=\"prismatic\"",
        "type=\"floating\"",
        "line 7: joint slide: type=\"floating\" is possible only between the root and the robot, \
         where it is dropped because any link can be the base; remove the joint, or make it of \
         prismatic and continuous joints",
    );
    is(
        "<link name=\"tip\"/>",
        "<link name=\"tip\"/><link name=\"loose\"/>",
        "links base (line 2), loose (line 6) have no parent; a robot has one root: connect the \
         others to it by joints, or remove them",
    );
    is(
        &format!("<link name=\"finger\">{INERTIAL}</link>"),
        "<link name=\"finger\"/>",
        "line 5: link finger, beyond joint slide: the mass is unknown, because no <inertial> is \
         there or in a link fixed to it; add one (with mass 0 and inertia 0 if it is meant to be \
         massless)",
    );
    // A loop: tool is the parent of arm, which is the parent of tool.
    is(
        "<parent link=\"base\"/>",
        "<parent link=\"tip\"/>",
        "line 3: link arm: the joints above it form a loop; only trees can be described: remove a \
         joint",
    );
    is(
        "</robot>",
        "</robt>",
        "the URDF is not XML: line 11: </robt> where <robot> of line 1 is open",
    );
    is(
        "type=\"prismatic\"",
        "type=\"sliding\"",
        "line 7: joint slide: type=\"sliding\" is not a type of joint; types are revolute, \
         continuous, prismatic and fixed",
    );
    assert_eq!(
        read("<sdf/>").unwrap_err().to_string(),
        "not a URDF: its root element is <sdf>, not <robot>; convert it, for example with gz \
         sdf or sdformat_urdf"
    );
    assert_eq!(
        read("<robot name=\"r\"></robot>").unwrap_err(),
        ModelError::NoLinks
    );
    assert!(
        read("")
            .unwrap_err()
            .to_string()
            .starts_with("the URDF is not XML: ")
    );
    let missing = Model::from_file(std::path::Path::new("/nowhere/model.urdf"), &[])
        .unwrap_err()
        .to_string();
    assert!(
        missing.starts_with("cannot read /nowhere/model.urdf: "),
        "{missing}"
    );
}

/// Elements that the dynamics do not need may be arbitrarily odd.
#[test]
fn shapes_and_extensions_are_not_read() {
    let odd = "<visual><geometry><blob/></geometry><origin xyz=\"a\"/></visual></link>\
        <transmission/><material/><link name=\"tip\">";
    let model = read(
        &robot()
            .replace("<link name=\"tip\"/>", "<link name=\"tip\"></link>")
            .replacen(
                "<link name=\"tip\">",
                &format!("<link name=\"side\">{odd}"),
                1,
            ),
    );
    assert!(
        matches!(model, Err(ModelError::SeveralRoots(_))),
        "side is a separate link"
    );
    let shaped = robot().replacen(
        "<link name=\"tip\"/>",
        "<link name=\"tip\"><visual><geometry><blob/></geometry></visual></link>",
        1,
    );
    assert_eq!(read(&shaped).unwrap().warnings(), &[] as &[String]);
}

#[test]
fn sensor_joints_must_be_there() {
    let error = |keep: &str| Model::from_urdf(&robot(), &[keep]).unwrap_err().to_string();
    assert_eq!(
        error("grab"),
        "joint grab, named as the joint of an F/T sensor, is not in the URDF; \
         any of its joints could carry one, fixed or moving (it is then on the child's side): \
         grip, end, slide, turn"
    );
    let described =
        "<gazebo reference=\"turn\"><sensor name=\"s\" type=\"force_torque\"/></gazebo>";
    let text = robot().replace("</robot>", &format!("{described}</robot>"));
    let error = Model::from_urdf(&text, &["grab"]).unwrap_err().to_string();
    assert!(error.ends_with(" side): turn"), "{error}");
}

/// The cut of a sensor in a moving joint is on the side of the child.
#[test]
fn a_moving_joint_with_a_sensor_is_divided() {
    let (whole, cut) = (
        read(&robot()).unwrap(),
        Model::from_urdf(&robot(), &["turn"]).unwrap(),
    );
    assert_eq!((cut.dof_count(), cut.link_count()), (2, 4));
    let (turn, sensor) = (cut.joint("turn").unwrap(), cut.cut("turn").unwrap());
    let [moving, fixed] = [turn, sensor].map(|number| cut.joints()[number]);
    assert_eq!(moving, whole.joints()[whole.joint("turn").unwrap()]);
    assert_eq!(
        (fixed.kind, fixed.parent, fixed.placement),
        (JointKind::Fixed, moving.child, Pose::identity())
    );
    assert_eq!(cut.inertias()[moving.child], RigidInertia::zero());
    assert_eq!(cut.link_name(moving.child), "arm above turn");
    assert_eq!(cut.frame("arm").unwrap().link, fixed.child);
    assert_eq!(cut.inertias()[fixed.child], whole.inertias()[1]);
    assert_eq!(cut.joint_name(sensor), "turn");
    assert_eq!(cut.cut("slide"), None);
    // A fixed one is its own cut.
    let grip = Model::from_urdf(&robot(), &["grip"]).unwrap();
    assert_eq!(grip.cut("grip"), grip.joint("grip"));
}

#[test]
fn what_is_only_odd_is_a_warning() {
    let warning = |from: &str, to: &str| {
        let text = robot();
        assert!(text.contains(from));
        let model = read(&text.replacen(from, to, 1)).expect("only odd");
        assert_eq!(model.warnings().len(), 1, "{:?}", model.warnings());
        model.warnings()[0].clone()
    };
    assert!(warning("izz=\"0.04\"", "izz=\"0.08\"").contains("link base: principal moments"));
    assert_eq!(
        warning("lower=\"-1\"", "lower=\"3\""),
        "joint turn: its lower limit 3 is above its upper limit 2"
    );
    assert!(
        warning(
            &format!("<link name=\"base\">{INERTIAL}</link>"),
            "<link name=\"base\"/>"
        )
        .starts_with("root link base: neither it")
    );
    assert_eq!(
        warning(
            "<child link=\"tip\"/>",
            "<child link=\"tip\"/><origin xyz=\"9 9 9\"/>"
        ),
        "line 10: joint end: <origin> occurs twice; the first one counts"
    );
    // Declared massless.
    let nothing = "<link name=\"finger\"><inertial><mass value=\"0\"/>\
        <inertia ixx=\"0\" ixy=\"0\" ixz=\"0\" iyy=\"0\" iyz=\"0\" izz=\"0\"/></inertial></link>";
    assert_eq!(
        warning(&format!("<link name=\"finger\">{INERTIAL}</link>"), nothing),
        "link finger: the body that joint slide moves is massless"
    );
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 400,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// A damaged file gives a model or an error, never a panic.
    #[test]
    fn a_damaged_file_is_no_crash(
        cuts in prop::collection::vec((any::<prop::sample::Index>(), 0..60_usize), 1..4),
        swap in any::<prop::sample::Index>(),
    ) {
        let mut text = robot().into_bytes();
        for (at, length) in cuts {
            let start = at.index(text.len());
            text.drain(start..(start + length).min(text.len()));
        }
        let at = swap.index(text.len());
        text[at] = b'9';
        let text = String::from_utf8(text).expect("ASCII");
        if let Err(error) = Model::from_urdf(&text, &["grip"]) {
            prop_assert!(!error.to_string().is_empty());
        }
    }

    /// Folding keeps the pose of every link and the total mass.
    #[test]
    fn folding_keeps_places_and_masses((links, seed) in (1..=40_usize, any::<u64>())) {
        use proprio_dynamics::{FrameMotion, JointState, Kinematics};
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let folded = Model::from_urdf(&robot.urdf(), &[]).unwrap();
        // With every fixed joint kept, nothing is folded.
        let fixed: Vec<String> = (0..links)
            .map(|link| format!("joint{link}"))
            .filter(|name| folded.is_folded(name))
            .collect();
        let keep: Vec<&str> = fixed.iter().map(String::as_str).collect();
        let whole = Model::from_urdf(&robot.urdf(), &keep).unwrap();
        prop_assert_eq!(whole.link_count(), links);
        prop_assert_eq!(folded.link_count(), links - fixed.len());
        prop_assert_eq!(folded.dof_count(), whole.dof_count());
        let mass = |model: &Model| {
            model
                .inertias()
                .iter()
                .map(|inertia| inertia.mass)
                .sum::<f64>()
        };
        prop_assert!((mass(&folded) - mass(&whole)).abs() < 1e-12 * mass(&whole));
        let [q, zeros] = [
            random.reals(folded.dof_count(), 2.0),
            vec![0.0; folded.dof_count()],
        ];
        let state = JointState {
            position: &q,
            velocity: &zeros,
            acceleration: &zeros,
        };
        let place = |model: &Model, name: &str| {
            let mut kinematics = Kinematics::new(model, 0).unwrap();
            kinematics
                .update(model, state, &FrameMotion::standing(&Vec3::zeros()))
                .unwrap();
            let frame = model.frame(name).unwrap();
            *kinematics.pose(frame.link) * frame.pose
        };
        for link in 0..links {
            let name = format!("link{link}");
            let (a, b) = (place(&folded, &name), place(&whole, &name));
            prop_assert!(
                (a.rotation - b.rotation).amax() < 1e-12
                    && (a.translation - b.translation).amax() < 1e-12,
                "{}",
                name
            );
        }
    }
}

/// An inertia is set only for an existing body, and only if it is finite.
#[test]
fn an_inertia_is_replaced_or_refused() {
    let mut model = RandomRobot::new(6, &mut Random::new(1)).model();
    let count = model.link_count();
    let before = model.inertias().to_vec();
    let new = RigidInertia::from_parameters(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]);
    assert_eq!(
        model.set_inertia(count, new),
        Err(ModelError::NoLink(count))
    );
    for parameter in 0..10 {
        for wrong in [f64::NAN, f64::INFINITY] {
            let mut parameters = new.parameters();
            parameters[parameter] = wrong;
            let error = model
                .set_inertia(1, RigidInertia::from_parameters(&parameters))
                .unwrap_err();
            assert_eq!(
                error.to_string(),
                format!(
                    "link {}: the inertia given for it is not finite",
                    model.link_name(1)
                )
            );
        }
    }
    assert_eq!(model.inertias(), before);
    model.set_inertia(1, new).unwrap();
    assert_eq!(model.inertias()[1], new);
    assert!(
        model
            .inertias()
            .iter()
            .zip(&before)
            .enumerate()
            .all(|(link, (now, old))| (now == old) == (link != 1))
    );
}

/// What tinyxml2 reads, and so urdfdom, Pinocchio and MuJoCo.
#[test]
fn what_other_readers_take_is_taken() {
    let same = |text: &str| {
        let model = read(text).unwrap_or_else(|error| panic!("{error}: {text}"));
        assert_eq!((model.link_count(), model.dof_count()), (3, 2), "{text}");
        assert_eq!(model.warnings(), &[] as &[String], "{text}");
    };
    let declaration = "<?xml version=\"1.0\"?>";
    for before in [
        "\n\n<?xml version=\"1.0\"?>\n",
        "<?xml version=\"1.0\"?>\n<?xml version=\"1.0\"?>",
        "<?xml version=\"1.0\" encoding=\"klingon\"?>",
        "<?xml version=\"1.0\"?><!DOCTYPE robot>",
        "<!DOCTYPE robot SYSTEM \"r.dtd\" [ <!ELEMENT robot ANY> <!ENTITY a \"b\"> ]>",
        "<!-- a -- comment --->",
        "<?stylesheet a?>\n<note/>",
        "\u{feff}\u{feff}<?xml version=\"1.0\"?>",
        "<!x><?xml version=\"1.0\"?>\n<!ELEMENT robot ANY>",
    ] {
        same(&(before.to_owned() + &robot()));
    }
    for after in [
        "\n<robot/>",
        "\0\0",
        "\0<robot",
        "\n<!-- the end -->",
        "</robot>\n",
        "</robot> <x",
    ] {
        same(&format!("{declaration}{}{after}", robot()));
    }
    for inside in [
        "<gazebo reference=\"tip\"><sensor:camera name=\"a\"><x:y/></sensor:camera></gazebo>",
        "<gazebo p:q=\"1\">a & b &foo; &lt;<![CDATA[ < ]]></gazebo>",
        "<material name=\"a & b < c > d &foo;\"/>",
        "<material name='a'rgba=\"1\"/>",
        "<!x 'y'>",
        "<transmission/><group><link name=\"base\"/></group>",
    ] {
        same(&robot().replacen(
            "<link name=\"tip\"/>",
            &format!("<link name=\"tip\"/>{inside}"),
            1,
        ));
    }
    same(&robot().replace('"', "'"));
    same(&robot().replacen(
        "<robot name=\"r\">",
        "<robot xmlns=\"http://x\" xmlns:a=\"b\">",
        1,
    ));
    same(
        &robot()
            .replace("velocity=\"1\"", "")
            .replace("effort=\"1\"", ""),
    );
    same(&robot().replace("lower=\"-1\"", "lower=\"\""));
    same(&robot().replace("xyz=\"0 0 0.05\"", "xyz=\"\""));
    // What a fixed joint does not use.
    same(&robot().replacen(
        "<child link=\"tip\"/>",
        "<child link=\"tip\"/><axis xzy=\"a\"/><limit lower=\"a\"/><mimic joint=\"none\"/>",
        1,
    ));
    let accent = robot().replace("\"tip\"", "\"&#233;\"");
    assert!(read(&accent).unwrap().frame("\u{e9}").is_some());
}

#[test]
fn what_is_missing_has_its_place_and_the_remedy() {
    let is = |from: &str, to: &str, expected: &str| assert_eq!(message(from, to), expected);
    is(
        "<axis xyz=\"0 0 -2\"/>",
        "<axis xzy=\"0 0 -2\"/>",
        "line 8: joint turn: its <axis> has no xyz (it has xzy); write its direction, such as \
         xyz=\"0 0 1\"",
    );
    is(
        "ixy=\"0.001\"",
        "",
        "line 2: link base: its <inertia> has no ixy (it has ixx, ixz, iyy, iyz, izz); write all \
         six of ixx, ixy, ixz, iyy, iyz, izz; a product of inertia of a symmetric body is 0",
    );
    is(
        "ixy=\"0.001\"",
        "ixy=\" \"",
        "line 2: link base: its <inertia> has an empty ixy; write all six of ixx, ixy, ixz, iyy, \
         iyz, izz; a product of inertia of a symmetric body is 0",
    );
    is(
        "<parent link=\"tool\"/>",
        "<parent link=\"\"/>",
        "line 7: joint slide: its <parent> has an empty link; write link=\"...\", the name of a \
         link",
    );
    is(
        "<mass value=\"2\"/>",
        "<mass val=\"2\"/>",
        "line 2: link base: its <mass> has no value (it has val); write value=\"...\", the mass in \
         kg",
    );
    is(
        "type=\"prismatic\"",
        "",
        "line 7: joint slide: its <joint> has no type (it has name); write type=\"revolute\", \
         \"continuous\", \"prismatic\" or \"fixed\"",
    );
    is(
        "type=\"revolute\"",
        "type=\"Revolute\"",
        "line 8: joint turn: type=\"Revolute\" is not a type of joint; types are revolute, \
         continuous, prismatic and fixed",
    );
    is(
        "<parent link=\"tool\"/>",
        "",
        "line 7: joint slide: its <joint> has no <parent>; add <parent link=\"...\"/>",
    );
    is(
        "<link name=\"tip\"/>",
        "<link/>",
        "line 6: link (without a name): its <link> has no name; write name=\"...\": joints, \
         sensors and configurations refer to it",
    );
    is(
        "xyz=\"0 0 0.5\"",
        "xyz=\"0 0 ${height}\"",
        "line 8: joint turn: <origin> xyz=\"0 0 ${height}\" is not expanded: the file is a xacro; \
         expand it first (xacro FILE > model.urdf)",
    );
    is(
        "<link name=\"tip\"/>",
        "<link name=\"${side}_tip\"/>",
        "line 6: link ${side}_tip: <link> name=\"${side}_tip\" is not expanded: the file is a \
         xacro; expand it first (xacro FILE > model.urdf)",
    );
    // What xacro leaves out would be missing without a word, links and joints too.
    is(
        "<link name=\"tip\"/>",
        "<link name=\"tip\">\n<xacro:shell/></link>",
        "line 7: robot r: <xacro:shell> is not expanded: the file is a xacro; expand it first \
         (xacro FILE > model.urdf)",
    );
    let empty = "<robot name=\"r\" xmlns:xacro=\"http://www.ros.org/wiki/xacro\">";
    let macros = format!("{empty}\n<xacro:arm/></robot>");
    assert!(
        (read(&macros).unwrap_err().to_string()).starts_with("line 2: robot r: <xacro:arm> is not")
    );
    // Its name space alone is what an expanded file has.
    read(&robot().replacen("<robot name=\"r\">", empty, 1)).unwrap();
    // All bodies without a mass in one message.
    let text = robot().replace(
        &format!("<link name=\"finger\">{INERTIAL}</link>"),
        "<link name=\"finger\"/>",
    );
    let text = text.replace(
        &format!("<link name=\"arm\">{INERTIAL}</link>"),
        "<link name=\"arm\"/>",
    );
    let text = text.replace(
        &format!("<link name=\"tool\">{INERTIAL}</link>"),
        "<link name=\"tool\"/>",
    );
    assert_eq!(
        read(&text).unwrap_err().to_string(),
        "line 3: link arm, beyond joint turn; line 5: link finger, beyond joint slide: the \
         mass is unknown, because no <inertial> is there or in a link fixed to it; add one \
         (with mass 0 and inertia 0 if it is meant to be massless)"
    );
}

/// The inertia of the links that are fixed together counts, not that of each.
#[test]
fn an_impossible_part_of_a_possible_body_is_a_warning() {
    let part = |mass: f64, xx: f64| {
        format!(
            "<link name=\"tool\"><inertial><mass value=\"{mass:e}\"/><inertia ixx=\"{xx:e}\" \
             ixy=\"0\" ixz=\"0\" iyy=\"1e-9\" iyz=\"0\" izz=\"1e-9\"/></inertial></link>"
        )
    };
    let with = |part: &str| {
        let whole = format!("<link name=\"tool\">{INERTIAL}</link>");
        read(&robot().replacen(&whole, part, 1))
    };
    let model = with(&part(1e-6, -3.6e-8)).unwrap();
    assert_eq!(
        model.warnings(),
        [
            "link tool: its inertia is not positive semidefinite (least principal moment -3.600e-8 \
             kg m^2): no body has this inertia; it is used as written, because with the links \
             fixed to it the inertia is possible"
        ]
    );
    let whole = with(&part(1e-6, 0.0)).unwrap();
    let change = model.inertias()[1].inertia - whole.inertias()[1].inertia;
    assert!(
        (change.trace() + 3.6e-8).abs() < 1e-15,
        "it is used as written"
    );
    let model = with(&part(-0.5, 1e-9)).unwrap();
    assert!(
        model.warnings()[0].starts_with("link tool: its mass is -0.5 kg; it is used as written")
    );
    assert_eq!(model.inertias()[1].mass, 1.5);
    assert_eq!(
        with(&part(-3.0, 1e-9)).unwrap_err().to_string(),
        "line 4: link tool: the mass is -1 kg, together with the links fixed to it (arm); a mass \
         cannot be negative: correct the <mass>"
    );
    let error = with(&part(1e-6, -0.2)).unwrap_err().to_string();
    assert!(
        error.starts_with("line 4: link tool: the inertia is not positive semidefinite (least ")
            && error.contains(", together with the links fixed to it (arm); no body has this"),
        "{error}"
    );
}

/// A tensor that is zero but for rounding, as iCub's heads have it.
#[test]
fn a_rounding_error_of_an_inertia_is_zero() {
    let body = |mass: f64, xx: f64| {
        let text = format!(
            "<link name=\"finger\"><inertial><mass value=\"{mass:e}\"/><inertia ixx=\"{xx:e}\" \
             ixy=\"0\" ixz=\"0\" iyy=\"0\" iyz=\"0\" izz=\"0\"/></inertial></link>"
        );
        let whole = format!("<link name=\"finger\">{INERTIAL}</link>");
        read(&robot().replacen(&whole, &text, 1))
    };
    assert_eq!(body(1.0, -2e-35).unwrap().warnings(), &[] as &[String]);
    assert_eq!(body(1.0, -9e-10).unwrap().warnings(), &[] as &[String]);
    // Without a mass of its own it is measured by that of the robot.
    assert!(body(0.0, -5e-17).is_ok());
    for (mass, xx) in [(1.0, -2e-9), (0.0, -1e-12), (1e-6, -3.6e-8)] {
        let error = body(mass, xx).unwrap_err().to_string();
        assert!(
            error.contains("the inertia is not positive semidefinite"),
            "{error}"
        );
    }
}

/// A joint that only says that the robot floats, or moves in a plane.
#[test]
fn a_floating_root_joint_is_dropped() {
    for kind in ["floating", "planar"] {
        let world = format!(
            "<link name=\"world\"/><link name=\"map\"/><joint name=\"fix\" type=\"fixed\">\
             <parent link=\"world\"/><child link=\"map\"/></joint><joint name=\"free\" \
             type=\"{kind}\"><parent link=\"map\"/><child link=\"base\"/></joint></robot>"
        );
        let model = read(&robot().replacen("</robot>", &world, 1)).unwrap();
        assert_eq!((model.link_count(), model.dof_count()), (3, 2));
        assert_eq!((model.link_name(0), model.joint("free")), ("base", None));
        assert!(model.frame("world").is_none() && model.frame("map").is_none());
        let dropped = ["world", "map", "fix", "free", "base", "turn"].map(|n| model.is_dropped(n));
        assert_eq!(dropped, [true, true, true, true, false, false]);
        assert_eq!(
            model.warnings(),
            [
                "joint free: it is the motion of the whole robot, so it is dropped: link base \
                 is the \
              root"
            ]
        );
        // Beside another part it is not the motion of the whole robot.
        let beside = "<link name=\"table\"/><joint name=\"by\" type=\"fixed\">\
                      <parent link=\"map\"/><child link=\"table\"/></joint></robot>";
        let text = robot()
            .replacen("</robot>", &world, 1)
            .replacen("</robot>", beside, 1);
        let error = read(&text).unwrap_err().to_string();
        assert!(
            error.starts_with(&format!(
                "line 11: joint free: type=\"{kind}\" is possible only "
            )),
            "{error}"
        );
    }
}

/// The body between a moving joint and its sensor is no link of the URDF.
#[test]
fn an_inertia_above_a_sensor_in_a_moving_joint_is_written_to_the_link_beyond() {
    let text = robot();
    let model = Model::from_urdf(&text, &["turn"]).unwrap();
    let mut inertias = model.inertias().to_vec();
    let above = model.joints()[model.joint("turn").unwrap()].child;
    assert_eq!(
        Model::rewrite_urdf(&text, &["turn"], &inertias).unwrap(),
        text
    );
    inertias[above] = inertias[0];
    let new = Model::rewrite_urdf(&text, &["turn"], &inertias).unwrap();
    let [whole, changed] = [read(&text).unwrap(), read(&new).unwrap()];
    let expected = whole.inertias()[1] + inertias[0];
    assert!((changed.inertias()[1].inertia - expected.inertia).amax() < 1e-12);
    assert!((changed.inertias()[1].mass - expected.mass).abs() < 1e-12);
    assert_eq!(changed.inertias()[2], whole.inertias()[2]);
}
