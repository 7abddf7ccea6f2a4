//! Robots and figures that are known, and readable sums.

use super::*;

/// Sensors as the URDF describes them.
fn described(text: &str) -> (Model, Structure) {
    let elements = Model::from_urdf(text, &[]).unwrap().sensors().to_vec();
    let keep: Vec<&str> = elements
        .iter()
        .map(|element| element.joint.as_str())
        .collect();
    let model = Model::from_urdf(text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let cuts: Vec<_> = elements
        .iter()
        .map(|s| SensorCut::new(&model, &s.joint, s.frame, s.direction, &s.pose, &noise).unwrap())
        .collect();
    let structure = Structure::new(&model, &cuts, &[], Structure::LENGTH_SCALE).unwrap();
    (model, structure)
}

pub(super) fn left_arm() -> (Model, Structure) {
    described(include_str!("../../../../config/icub_left_arm/model.urdf"))
}

/// Five links and four revolute joints beyond the F/T sensor: 50 parameters, 38 identifiable
/// combinations; without the sensor, 8 links and 7 joints: 90 -> 59.
#[test]
fn arm_of_the_repository() {
    let (model, structure) = left_arm();
    let mut random = Random::new(1);
    let ask = |scope, regime, measured, offsets| Question {
        model: &model,
        scope,
        regime,
        measured,
        offsets,
    };
    let free = || Regime::free(&model);
    let beyond = ask(
        Scope::SubTree(&structure, 1),
        free(),
        Measurement::Wrench,
        Offsets::Known,
    )
    .check(&mut random);
    assert_eq!((beyond.columns().len(), beyond.rank()), (50, 38));
    assert_eq!(
        beyond.columns()[11],
        ParameterColumn::Inertial {
            link: model.frame("l_elbow_1").unwrap().link,
            parameter: 1
        }
    );
    assert_eq!(beyond.names()[11], "l_elbow_1.h_x");
    let with = ask(
        Scope::SubTree(&structure, 1),
        free(),
        Measurement::Wrench,
        Offsets::Unknown,
    )
    .check(&mut random);
    assert_eq!(
        (with.columns().len(), with.rank(), with.confused()),
        (56, 44, 0)
    );
    assert_eq!(
        with.columns()[55],
        ParameterColumn::Offset {
            sensor: 0,
            component: 5
        }
    );
    assert_eq!(with.names()[55], "l_arm_ft_sensor.f_z");
    let whole = ask(Scope::Tree, free(), Measurement::Wrench, Offsets::Known).check(&mut random);
    assert_eq!((whole.columns().len(), whole.rank()), (90, 90 - 7 * 3 - 10));
    // With the cut at the sensor nothing is lost between the two sides: 90 - 21.
    let cut = ask(
        Scope::SubTrees(&structure),
        free(),
        Measurement::Wrench,
        Offsets::Known,
    )
    .check(&mut random);
    assert_eq!(cut.rank(), 69);
    // On its stand the chest is fixed. The arm's F/T sensor still determines everything beyond it,
    // because the shoulder rotates the arm about three axes.
    let stand = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY));
    let arm = ask(
        Scope::SubTree(&structure, 1),
        stand.clone(),
        Measurement::Wrench,
        Offsets::Unknown,
    )
    .check(&mut random);
    assert_eq!((arm.rank(), arm.confused()), (44, 0));
    sums(&arm, &mut random);
    // Joint torques alone, and with the wrench on the stand.
    for measured in [Measurement::Torques, Measurement::Both] {
        ask(Scope::Tree, stand.clone(), measured, Offsets::Known).check(&mut random);
    }
}

/// Effect of a sensor at rest and of unknown offsets on the rank: rank without offsets, with them,
/// and the loss, for five links and four revolute joints.
#[test]
fn restricted_motion_and_offsets() {
    let (model, structure) = left_arm();
    let base = model.frame("l_upper_arm").unwrap().link;
    let mut random = Random::new(2);
    let up = Vec3::new(0.3, -0.5, 0.81).normalize();
    for (motion, without, with, lost) in [
        (BaseRegime::Fixed(up * -GRAVITY), 29, 32, 3),
        (BaseRegime::Free, 38, 44, 0),
    ] {
        let regime = Regime {
            base,
            motion,
            ..Regime::free(&model)
        };
        let ask = |offsets| Question {
            model: &model,
            scope: Scope::SubTree(&structure, 1),
            regime: regime.clone(),
            measured: Measurement::Wrench,
            offsets,
        };
        let known = ask(Offsets::Known).check(&mut random);
        let unknown = ask(Offsets::Unknown).check(&mut random);
        assert_eq!(
            (known.rank(), unknown.rank(), unknown.confused()),
            (without, with, lost)
        );
        assert_eq!(known.confused(), 0);
        sums(&unknown, &mut random);
    }
}

/// A whole iCub: 39 links, 32 joints, 6 F/T sensors. The robot's URDF may not be redistributed
/// here, so the test runs only where it is available: `PROPRIO_ICUB_MODELS` names the folder with
/// iCubGazeboV2_5.urdf (of the PyPI package icub-models 3.2.0).
#[test]
fn whole_icub() {
    let Ok(models) = std::env::var("PROPRIO_ICUB_MODELS") else {
        println!("skipped: PROPRIO_ICUB_MODELS does not say where the robot is");
        return;
    };
    let text =
        std::fs::read_to_string(std::path::Path::new(&models).join("iCubGazeboV2_5.urdf")).unwrap();
    let (model, structure) = described(&text);
    known_humanoid(&model, &structure);
}

/// A generated robot with the tree of an iCub: the figures follow from the tree alone, as long as
/// its joints are in general position.
#[test]
fn humanoid_of_the_same_tree() {
    let (text, sensors) = humanoid();
    let keep: Vec<&str> = sensors.iter().map(String::as_str).collect();
    let model = Model::from_urdf(&text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
    let cut = |joint: &&str| {
        SensorCut::new(&model, joint, frame, direction, &Pose::identity(), &noise).unwrap()
    };
    let cuts: Vec<_> = keep.iter().map(cut).collect();
    let structure = Structure::new(&model, &cuts, &[], Structure::LENGTH_SCALE).unwrap();
    known_humanoid(&model, &structure);

    // On a stand that holds the root with an unmeasured wrench: the torso's six rows are removed,
    // and with them all combinations that only they determine.
    let support = ContactSpec {
        frame: Frame {
            link: 0,
            pose: Pose::identity(),
        },
        kind: ContactKind::Wrench,
        position: Vec3::zeros(),
    };
    let structure = Structure::new(&model, &cuts, &[support], Structure::LENGTH_SCALE).unwrap();
    let stand = Regime {
        contacts: ContactSet::first(1),
        ..Regime::free(&model)
    };
    let ask = |scope| {
        Identifiable::new(&model, scope, &stand, Measurement::Wrench, Offsets::Known)
            .unwrap()
            .rank()
    };
    assert_eq!(ask(Scope::SubTree(&structure, 0)), 0);
    assert_eq!(ask(Scope::SubTrees(&structure)), 294 - 122);
}

/// 39 links, 32 joints, six sensors: torso and head of 16 joints, limbs of four, feet of none.
fn known_humanoid(model: &Model, structure: &Structure) {
    assert_eq!(
        (
            model.link_count(),
            model.dof_count(),
            structure.sensors().len()
        ),
        (39, 32, 6)
    );
    let mut random = Random::new(4);
    let ask = |scope, offsets| Question {
        model,
        scope,
        regime: Regime::free(model),
        measured: Measurement::Wrench,
        offsets,
    };
    let tree = ask(Scope::Tree, Offsets::Known).check(&mut random);
    assert_eq!((tree.columns().len(), tree.rank()), (390, 234));
    let mut ranks = Vec::new();
    for number in 0..7 {
        let part = ask(Scope::SubTree(structure, number), Offsets::Known).check(&mut random);
        ranks.push(part.rank());
    }
    assert_eq!(ranks[0], 122, "torso and head");
    ranks.sort_unstable();
    assert_eq!(ranks, [10, 10, 38, 38, 38, 38, 122]);
    let stacked = ask(Scope::SubTrees(structure), Offsets::Known).check(&mut random);
    assert_eq!(stacked.rank(), 294);
    let with = ask(Scope::SubTrees(structure), Offsets::Unknown).check(&mut random);
    assert_eq!((with.rank(), with.confused()), (294 + 36, 0));
    sums(&tree, &mut random);
    sums(&with, &mut random);
}

/// A real arm on a fixed base whose joint torques are measured: `PROPRIO_DATA` names the folder
/// with kuka_lwr4.urdf.
#[test]
fn kuka_from_joint_torques() {
    let Ok(data) = std::env::var("PROPRIO_DATA") else {
        println!("skipped: PROPRIO_DATA does not say where the robot is");
        return;
    };
    let file = std::path::Path::new(&data).join("kuka_lwr4.urdf");
    if !file.exists() {
        println!("skipped: PROPRIO_DATA has no kuka_lwr4.urdf");
        return;
    }
    let model = Model::from_file(&file, &[]).unwrap();
    let mut random = Random::new(6);
    let regime = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY));
    let question = Question {
        model: &model,
        scope: Scope::Tree,
        regime,
        measured: Measurement::Torques,
        offsets: Offsets::Known,
    };
    let answer = question.check(&mut random);
    assert_eq!(answer.rank(), 43);
    sums(&answer, &mut random);
}

/// A chain: a turntable about the vertical, an arm that rotates about y at a distance `length` [m]
/// from it, and a slide along x at the end.
pub(super) fn hand_made(length: f64) -> Model {
    let inertial = "<inertial><mass value=\"1\"/>\
        <inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial>";
    let joint = |number: usize, kind: &str, xyz: &str, axis: &str| {
        format!(
            "<joint name=\"j{number}\" type=\"{kind}\"><parent link=\"{}\"/><child link=\"{}\"/>\
             <origin xyz=\"{xyz}\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-1\" upper=\"1\" effort=\"1\" velocity=\"1\"/></joint>",
            NAMES[number],
            NAMES[number + 1]
        )
    };
    const NAMES: [&str; 4] = ["base", "table", "arm", "slide"];
    let links: String = NAMES
        .iter()
        .map(|name| format!("<link name=\"{name}\">{inertial}</link>"))
        .collect();
    let text = format!(
        "<robot name=\"chain\">{links}{}{}{}</robot>",
        joint(0, "revolute", "0 0 0.5", "0 0 1"),
        joint(1, "revolute", &format!("0 {length:e} 0"), "0 1 0"),
        joint(2, "prismatic", "0.1 0 0", "1 0 0"),
    );
    Model::from_urdf(&text, &[]).unwrap()
}

/// By hand: a mass on a revolute joint's axis, its first moment and second moment along the axis
/// may belong to either link, so `m`, `h` along the axis and one of the `I` across it are added to
/// the inner link, transformed to its frame. The second moments of a sliding body keep their axes,
/// but its mass and first moment are identifiable.
#[test]
fn sums_are_readable() {
    let model = hand_made(0.25);
    let ask = |regime: &Regime, measured| {
        let scope = Scope::Tree;
        let answer = Identifiable::new(&model, scope, regime, measured, Offsets::Known).unwrap();
        answer
            .base_parameters()
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
    };
    let inertia_across = "0.25 table.m + table.h_z + table.I_xx + 0.3125 arm.m + 0.5 arm.h_y \
        + arm.I_xx + slide.I_xx";
    let free = [
        "base.m + table.m + arm.m",
        "base.h_x",
        "base.h_y",
        "base.h_z + 0.5 table.m + table.h_z + 0.5 arm.m",
        &format!("base.I_xx + {inertia_across}"),
        "base.I_xy",
        "base.I_xz",
        &format!("base.I_yy + {inertia_across}"),
        "base.I_yz",
        "base.I_zz",
        "table.h_x",
        "table.h_y + 0.25 arm.m + arm.h_y",
        "table.I_xy",
        "table.I_xz",
        "table.I_yy - table.I_xx - 0.0625 arm.m - 0.5 arm.h_y - arm.I_xx - slide.I_xx",
        "table.I_yz",
        "table.I_zz + 0.0625 arm.m + 0.5 arm.h_y + arm.I_xx + slide.I_xx",
        "arm.h_x",
        "arm.h_z",
        "arm.I_xy + slide.I_xy",
        "arm.I_xz + slide.I_xz",
        "arm.I_yy + slide.I_yy",
        "arm.I_yz + slide.I_yz",
        "arm.I_zz - arm.I_xx - slide.I_xx + slide.I_zz",
        "slide.m",
        "slide.h_x",
        "slide.h_y",
        "slide.h_z",
    ];
    assert_eq!(ask(&Regime::free(&model), Measurement::Wrench), free);

    // On a stand: of the I_xx, I_yy, I_zz and I_xy of the body that rotates about the vertical only
    // I_zz is identifiable; the rest of the base's inertia has no effect. From the joint torques
    // the base is unobservable, and so is the table's first moment, because its axis is along
    // gravity.
    let stand = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY));
    let torques: Vec<&str> = free[16..].to_vec();
    assert_eq!(ask(&stand, Measurement::Torques), torques);
    let wrench: Vec<&str> = [
        "base.m + table.m + arm.m",
        "base.h_x",
        "base.h_y",
        "table.h_x",
        "table.h_y + 0.25 arm.m + arm.h_y",
        "table.I_xz",
        "table.I_yz",
    ]
    .into_iter()
    .chain(torques)
    .collect();
    assert_eq!(ask(&stand, Measurement::Wrench), wrench);
}

/// A link of 30 m would give factors of 900 m^2: other parameters are eliminated there.
#[test]
fn factors_stay_small() {
    let model = hand_made(30.0);
    let regime = Regime::free(&model);
    let answer = Identifiable::new(
        &model,
        Scope::Tree,
        &regime,
        Measurement::Wrench,
        Offsets::Known,
    )
    .unwrap();
    assert_eq!(answer.rank(), 28);
    sums(&answer, &mut Random::new(1));
    let sums = answer.base_parameters();
    assert!(
        sums.iter().any(|sum| sum.kept.name == "arm.m"),
        "eliminated where links are short"
    );
}

#[test]
fn small_numbers_print_short() {
    let term = |coefficient, name: &str| Term {
        coefficient,
        column: 0,
        name: name.to_owned(),
    };
    let sum = BaseParameter {
        kept: term(1.0, "a.m"),
        terms: vec![
            term(-1.0, "b.m"),
            term(0.123_456, "c.m"),
            term(-2e-6, "d.m"),
            term(7.0, "e.m"),
            term(1.000_01, "f.m"),
        ],
    };
    assert_eq!(
        sum.to_string(),
        "a.m - b.m + 0.1235 c.m - 2e-6 d.m + 7 e.m + f.m"
    );
}
