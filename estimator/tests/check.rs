//! The figures of `estimator --check`, against numbers computed by hand.

use proprio_dynamics::model::Model;
use proprio_estimator::check::{Check, Posture};
use proprio_estimator::config::{Config, STANDARD_GRAVITY};
use proprio_estimator::setup::Setup;

/// A base, an F/T sensor below it, a shoulder, an arm with a hand. The arm has 2 kg, with its
/// centre of mass 0.1 m out along x; the wrist is 0.4 m out; the hand has 1 kg, with its centre of
/// mass 0.2 m beyond the wrist.
fn setup(contacts: &str, effort: f64, locked: &str) -> Setup {
    setup_with(contacts, effort, locked, &[])
}

/// The same, with parts of its configuration replaced.
fn setup_with(contacts: &str, effort: f64, locked: &str, changes: &[(&str, &str)]) -> Setup {
    let link = |name: &str, mass: f64, x: f64| {
        format!(
            "<link name=\"{name}\"><inertial><origin xyz=\"{x} 0 0\"/><mass value=\"{mass}\"/>\
             <inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" iyy=\"0.01\" iyz=\"0\" izz=\"0.01\"/>\
             </inertial></link>"
        )
    };
    let joint = |name: &str, parent: &str, child: &str, x: f64, limits: &str| {
        format!(
            "<joint name=\"{name}\" type=\"revolute\"><parent link=\"{parent}\"/><child \
             link=\"{child}\"/>\
             <origin xyz=\"{x} 0 0\"/><axis xyz=\"0 1 0\"/><limit {limits} effort=\"{effort}\" \
             velocity=\"5\"/></joint>"
        )
    };
    let urdf = format!(
        "<robot name=\"r\">{}{}{}{}<joint name=\"ft\" type=\"fixed\"><parent link=\"base\"/>\
         <child link=\"mount\"/>\
         <origin xyz=\"0 0 -0.5\"/></joint>{}{}</robot>",
        link("base", 5.0, 0.0),
        link("mount", 0.5, 0.0),
        link("arm", 2.0, 0.1),
        link("hand", 1.0, 0.2),
        joint("shoulder", "mount", "arm", 0.0, "lower=\"-2\" upper=\"2\""),
        // Zero is outside its limits: the nearest limit, -0.5, is used.
        joint("wrist", "arm", "hand", 0.4, "lower=\"-2\" upper=\"-0.5\""),
    );
    let config = format!(
        "schema = 1\nrobot = \"r\"\nmodel = \"r.urdf\"\n[base]\nkind = \"fixed\"\nlink = \
         \"base\"\n[[force_torque]]\n\
         sensor = \"strain\"\njoint = \"ft\"\nframe = \"child\"\ndirection = \"parent_to_child\"\n\
         {contacts}{locked}"
    );
    let config = changes.iter().fold(config, |config, (from, to)| {
        assert!(config.contains(from), "{from}");
        config.replacen(from, to, 1)
    });
    let model = Model::from_urdf(&urdf, &["ft"]).expect("a model");
    Setup::with_model(&Config::parse(&config).expect("a configuration"), model).expect("it fits")
}

/// The figures, all joints at zero.
fn checked(setup: &Setup) -> Check {
    Check::of(setup, &Posture::unknown(setup)).expect("numbers")
}

#[test]
fn masses_and_readings_at_rest_are_those_of_a_balance() {
    let check = checked(&setup("", 50.0, ""));
    assert!((check.mass - 8.5).abs() < 1e-12);
    let [sensor] = &check.sensors[..] else {
        panic!("one sensor")
    };
    assert_eq!(sensor.name, "strain");
    assert!((sensor.mass - 3.5).abs() < 1e-12);
    // The mount carries the weight upwards; about y, -g (2 * 0.1 + 1 * (0.4 + 0.2 cos 0.5)).
    let moment = (0.6 + 0.2 * 0.5_f64.cos()) * STANDARD_GRAVITY;
    let expected = [0.0, 0.0, 3.5 * STANDARD_GRAVITY, 0.0, -moment, 0.0];
    for (read, expected) in sensor.reading.force_first().into_iter().zip(expected) {
        assert!((read - expected).abs() < 1e-9, "{:?}", sensor.reading);
    }
    assert!(
        check.overloaded.is_empty() && check.undetermined.is_empty() && check.problem().is_none()
    );
    let text = check.to_string();
    assert!(text.contains("mass of all links: 8.500 kg"), "{text}");
    assert!(
        text.contains("strain: force [0, 0, 34.323] N, torque [0, -7.605, 0] Nm, from 3.500 kg"),
        "{text}"
    );
    // Locked with the arm straight down: no torque.
    let down = format!(
        "[locked]\nshoulder = {}\nwrist = 0\n",
        std::f64::consts::FRAC_PI_2
    );
    let check = checked(&setup("", 50.0, &down));
    assert!(
        check.sensors[0].reading.torque.norm() < 1e-9,
        "{:?}",
        check.sensors[0].reading
    );
}

/// A limb that its drive cannot hold, such as one with masses in grams, is reported. A credible
/// effort limit is not.
#[test]
fn an_arm_that_its_drives_could_not_hold_is_told() {
    let check = checked(&setup("", 0.05, ""));
    let [(joint, load, effort), (wrist, ..)] = &check.overloaded[..] else {
        panic!("{:?}", check.overloaded)
    };
    assert_eq!(
        (joint.as_str(), wrist.as_str(), *effort),
        ("shoulder", "wrist", 0.05)
    );
    assert!((load - 0.8 * STANDARD_GRAVITY).abs() < 1e-9, "{load}");
    assert!(check.to_string().contains("check the units of both"));
    // Up to ten times the limit is accepted, because lengths never all lie in one line.
    assert!(
        checked(&setup("", 0.08 * STANDARD_GRAVITY + 1e-9, ""))
            .overloaded
            .is_empty()
    );
}

#[test]
fn torques_that_contacts_hide_for_ever_are_told() {
    let contact = |name: &str, link: &str, more: &str| {
        format!("[[contact]]\nname = \"{name}\"\nlink = \"{link}\"\n{more}")
    };
    // The wrist is between the two contacts. The shoulder is before both, and the sensor determines
    // its torque.
    let both = contact("palm", "hand", "") + &contact("elbow", "arm", "");
    let check = checked(&setup(&both, 50.0, ""));
    assert_eq!(check.undetermined, ["wrist"]);
    assert_eq!(check.hiding, ["palm", "elbow"]);
    let problem = check.problem().expect("one");
    for word in ["wrist", "palm, elbow", "presence = \"possible\""] {
        assert!(problem.contains(word), "{problem}");
    }
    // No problem if one contact is possible only, or if the joint is locked.
    let possible =
        contact("palm", "hand", "presence = \"possible\"\n") + &contact("elbow", "arm", "");
    assert!(checked(&setup(&possible, 50.0, "")).problem().is_none());
    assert!(
        checked(&setup(&both, 50.0, "[locked]\nwrist = -1\n"))
            .problem()
            .is_none()
    );
}

/// Gravity to the side, as on a wall, and joints at other places.
#[test]
fn readings_are_those_of_the_posture_and_of_the_configured_gravity() {
    let setup = setup_on_wall();
    let at = |given: &[&str]| {
        let given: Vec<String> = given.iter().map(|text| (*text).to_owned()).collect();
        Posture::parse(&setup, &given)
    };
    // Along x, in the arm's direction, with the wrist straight: no torque.
    let straight = at(&["wrist=0"]).expect("a posture");
    let check = Check::of(&setup, &straight).expect("numbers");
    let reading = &check.sensors[0].reading;
    assert!(
        (reading.force.x - 3.5 * STANDARD_GRAVITY).abs() < 1e-9,
        "{reading:?}"
    );
    assert!(reading.torque.norm() < 1e-9, "{reading:?}");
    // The arm turned by a right angle: a lever of 0.8 kg m, upwards or downwards.
    let turned = at(&["wrist=0", " shoulder = 1.5707963267948966"]).expect("a posture");
    let check = Check::of(&setup, &turned).expect("numbers");
    let moment = check.sensors[0].reading.torque.y.abs();
    assert!((moment - 0.8 * STANDARD_GRAVITY).abs() < 1e-9, "{moment}");
    let text = check.to_string();
    assert!(
        text.contains("shoulder 1.571, wrist 0, others at zero"),
        "{text}"
    );
    assert!(text.contains("gravity [-9.807, 0, 0] m/s^2"), "{text}");
    for (given, expected) in [
        ("wrist", "give a joint and its position"),
        ("wirst=1", "did you mean \"wrist\"?"),
        ("wrist=inf", "\"inf\" must be a number"),
        ("wrist=90", "looks like degrees; in rad it is 1.570796"),
    ] {
        let error = at(&[given]).expect_err(given);
        assert!(error.contains(expected), "{error}");
    }
}

/// The arm with gravity along -x, and its offset known.
fn setup_on_wall() -> Setup {
    setup_with(
        "",
        50.0,
        "",
        &[
            (
                "link = \"base\"\n",
                "link = \"base\"\ngravity_mps2 = [-9.80665, 0, 0]\n",
            ),
            (
                "frame = ",
                "offset_n = [1, 2, 3]\noffset_nm = [0.1, 0.2, 0.3]\nframe = ",
            ),
        ],
    )
}

/// A robot that stands on its hand: the sensor carries what lies on its other side, the base.
#[test]
fn a_robot_is_held_by_its_base_link() {
    let setup = setup_with("", 50.0, "", &[("link = \"base\"", "link = \"hand\"")]);
    let straight = Posture::parse(&setup, &["wrist=0".to_owned()]).expect("a posture");
    let check = Check::of(&setup, &straight).expect("numbers");
    let force = check.sensors[0].reading.force;
    // By the base on the mount: it pulls down with its weight.
    assert!((force.z + 5.0 * STANDARD_GRAVITY).abs() < 1e-9, "{force:?}");
}

#[test]
fn what_will_be_withheld_is_told_with_its_cause() {
    let reasons = |setup: &Setup| checked(setup).withheld.reasons;
    // With an unknown wrench at the hand, every torque rests on the sensor.
    let hand = "[[contact]]\nlink = \"hand\"\n";
    let unknown = setup(hand, 50.0, "");
    let [(why, names)] = &reasons(&unknown)[..] else {
        panic!("{:?}", reasons(&unknown))
    };
    assert!(why.starts_with("uncertain"), "{why}");
    assert!(
        why.contains("the offset of strain is unknown: give offset_n"),
        "{why}"
    );
    let [shoulder, wrist, ..] = &names[..] else {
        panic!("{names:?}")
    };
    assert!(shoulder.starts_with("shoulder (+- ") && wrist.starts_with("wrist (+- "));
    assert!(names[0].contains("bound 12.5"), "{names:?}");
    let text = checked(&unknown).to_string();
    assert!(text.contains("its offset is not known"), "{text}");

    let known = (
        "frame = ",
        "offset_n = [1, 2, 3]\noffset_nm = [0.1, 0.2, 0.3]\nframe = ",
    );
    let good = setup_with(hand, 50.0, "", &[known]);
    assert_eq!(reasons(&good), []);
    let (_, largest) = checked(&good).withheld.largest.expect("a deviation");
    assert!(largest > 0.0 && largest < 12.5, "{largest}");
    let text = checked(&good).to_string();
    assert!(
        text.contains("withheld at rest in this posture: nothing; standard"),
        "{text}"
    );
    assert!(
        text.contains("its offset in use: force [1, 2, 3] N"),
        "{text}"
    );

    // A bound that the URDF's parameters exceed, and one that noise exceeds.
    let bound = |most: &str| {
        let table = format!("[output]\nmax_torque_std_nm = {most}\n[[force_torque]]");
        setup_with(hand, 50.0, "", &[known, ("[[force_torque]]", &table)])
    };
    let whys = |setup: &Setup| {
        reasons(setup)
            .into_iter()
            .map(|(why, _)| why)
            .collect::<Vec<_>>()
    };
    let why = whys(&bound("0.15")).join("; ");
    assert!(
        why.contains("known to 20.0 % only (identification.urdf_relative_std)"),
        "{why}"
    );
    let why = whys(&bound("1e-5")).join("; ");
    assert!(why.contains("because of the noise"), "{why}");

    // On-line identification does not use the offsets that are stated.
    let identifies = (
        "[[force_torque]]",
        "[identification]\nenabled = true\n[[force_torque]]",
    );
    let possible = format!("{hand}presence = \"possible\"\n");
    let learning = setup_with(&possible, 50.0, "", &[known, identifies]);
    let text = checked(&learning).to_string();
    assert!(text.contains("its offset is not known"), "{text}");
    // Where it is not possible, they are used.
    let refused = setup_with(hand, 50.0, "", &[known, identifies]);
    let text = checked(&refused).to_string();
    for part in [
        "note: nothing can be identified on-line: ",
        "its offset in use: force [1, 2, 3]",
    ] {
        assert!(text.contains(part), "{text}");
    }

    // What hides a torque at any time is withheld for that reason.
    let both = format!("{hand}[[contact]]\nlink = \"arm\"\n");
    let hidden = setup_with(&both, 50.0, "", &[known]);
    let groups = reasons(&hidden);
    let (_, names) = groups
        .iter()
        .find(|(why, _)| why.starts_with("undetermined"))
        .expect("it");
    assert!(names.contains(&"wrist".to_owned()), "{groups:?}");
}

/// A chain of `moving` joints, of which the last `locked` are locked.
fn chain(moving: usize, locked: usize) -> Result<Setup, String> {
    let mut urdf = String::from("<robot name=\"r\"><link name=\"l0\"/>");
    for joint in 1..=moving {
        urdf += &format!(
            "<link name=\"l{joint}\"><inertial><origin xyz=\"0 0 0.05\"/><mass value=\"0.1\"/>\
             <inertia ixx=\"1e-4\" ixy=\"0\" ixz=\"0\" iyy=\"1e-4\" iyz=\"0\" izz=\"1e-4\"/>\
             </inertial></link><joint name=\"j{joint}\" type=\"continuous\"><parent link=\"l{}\"/>\
             <child link=\"l{joint}\"/><origin xyz=\"0 0 0.1\"/><axis xyz=\"0 1 0\"/></joint>",
            joint - 1
        );
    }
    let mut config = String::from(
        "schema = 1\nrobot = \"r\"\nmodel = \"r.urdf\"\n[base]\nkind = \"fixed\"\nlink = \"l0\"\n\
         [locked]\n",
    );
    (moving - locked + 1..=moving).for_each(|joint| config += &format!("j{joint} = 0.1\n"));
    let model = Model::from_urdf(&(urdf + "</robot>"), &[]).expect("a model");
    Setup::with_model(&Config::parse(&config).expect("a configuration"), model)
}

/// A humanoid with hands; locked joints do not count. Their torques are published where they fit.
#[test]
fn only_measured_joints_are_limited() {
    let names =
        |setup: &Setup| -> Vec<String> { setup.robot.joint_names().map(str::to_owned).collect() };
    let setup = chain(75, 35).expect("40 measured joints");
    assert_eq!((names(&setup).len(), setup.robot.channels.len()), (75, 40));
    let setup = chain(120, 0).expect("120 measured joints");
    assert_eq!(names(&setup).len(), 120);
    let setup = chain(150, 30).expect("120 measured joints");
    assert_eq!(names(&setup).len(), 120);
    assert_eq!(names(&setup).last().map(String::as_str), Some("j120"));
    assert_eq!(
        chain(150, 21).expect_err("129 measured joints"),
        "r.urdf: 129 joints are to be measured; 128 at most: name joints that nobody measures in \
         [locked], with their positions, or make them fixed in the URDF"
    );
    // A locked joint still moves a body of its own.
    assert_eq!(
        chain(512, 500).expect_err("513 bodies"),
        "r.urdf: its joints, those in [locked] too, join 513 bodies; 512 at most: make joints that \
         never move fixed in the URDF (type=\"fixed\")"
    );
}

const GRIPPER: &str = "<robot name=\"r\"><link name=\"base\"/>\
    <link name=\"a\"><inertial><origin xyz=\"0.1 0 0.2\"/><mass value=\"1\"/><inertia ixx=\"0.02\" \
    ixy=\"0\" ixz=\"0\" iyy=\"0.03\" iyz=\"0\" izz=\"0.025\"/></inertial></link>\
    <link name=\"b\"><inertial><origin xyz=\"0 0 0.1\"/><mass value=\"0.5\"/><inertia ixx=\"1e-3\" \
    ixy=\"0\" ixz=\"0\" iyy=\"1e-3\" iyz=\"0\" izz=\"1e-3\"/></inertial></link>\
    <joint name=\"j1\" type=\"continuous\"><parent link=\"base\"/><child link=\"a\"/>\
    <axis xyz=\"0 1 0\"/></joint>\
    <joint name=\"j2\" type=\"continuous\"><parent link=\"a\"/><child link=\"b\"/>\
    <origin xyz=\"0 0 0.4\"/><axis xyz=\"0 1 0\"/>\
    <mimic joint=\"j1\" multiplier=\"-1.5\" offset=\"0.2\"/></joint></robot>";

/// A robot in files, as the programs read it.
fn files(urdf: &[u8], config: &str) -> (tempfile::TempDir, Result<Setup, String>) {
    let folder = tempfile::tempdir().unwrap();
    let text = "schema = 1\nrobot = \"r\"\nmodel = \"r.urdf\"\n[base]\nkind = \"fixed\"\n\
                link = \"base\"\n";
    std::fs::write(folder.path().join("r.urdf"), urdf).unwrap();
    let file = folder.path().join("estimator.toml");
    std::fs::write(&file, text.to_owned() + config).unwrap();
    let setup = Config::load(&file).map_err(|error| error.to_string());
    let setup = setup.and_then(|config| Setup::new(&config));
    (folder, setup)
}

/// From a log of the first joint alone. The torque of the actuated joint includes that of the
/// follower: -1.106490 Nm + 1.5 x 0.039074 Nm, which Pinocchio computes along their own axes.
#[test]
fn a_joint_that_follows_another_is_not_measured() {
    let (_folder, setup) = files(GRIPPER.as_bytes(), "");
    let setup = setup.expect("one channel");
    let names: Vec<&str> = setup.channels().map(|(_, name)| name).collect();
    assert_eq!(names, ["j1"]);
    let follows = "  j2 follows j1; the torque of j1 includes its torque\n";
    assert_eq!(setup.to_string().matches(follows).count(), 1, "{setup}");
    let rows: String = (0..3).map(|row| format!("0.0{row},0.1,0.5,2\n")).collect();
    let log = "t,joint/j1/position,joint/j1/velocity,joint/j1/acceleration\n".to_owned() + &rows;
    let mut out = Vec::new();
    proprio_estimator::offline::estimate(setup, log.as_bytes(), &mut out, None).expect("estimates");
    let out = String::from_utf8(out).unwrap();
    let mut lines = out.lines();
    let column = lines
        .next()
        .unwrap()
        .split(',')
        .position(|name| name == "torque/j1")
        .unwrap();
    let mut count = 0;
    for line in lines {
        let torque: f64 = line.split(',').nth(column).unwrap().parse().unwrap();
        assert!((torque + 1.047_879).abs() < 1e-6, "{torque}");
        count += 1;
    }
    assert_eq!(count, 3);

    // The configuration wins over the URDF, and says so.
    let (_folder, setup) = files(GRIPPER.as_bytes(), "[locked]\nj2 = 0.5\n");
    let setup = setup.expect("a held follower");
    let joint = setup.robot.model.joints()[setup.robot.model.joint("j2").unwrap()];
    assert_eq!((joint.ratio, joint.offset), (0.0, 0.5));
    assert!(setup.warnings().iter().any(|warning| {
        warning == "locked.j2: in the URDF this joint follows j1 (<mimic>); here it is held at 0.5"
    }));
    let text = setup.to_string();
    assert!(text.contains("  locked j2 at 0.5\n"), "{text}");
    assert!(!text.contains(follows), "{text}");
    // With the leader locked, the follower is where that puts it.
    let (_folder, setup) = files(GRIPPER.as_bytes(), "[locked]\nj1 = 0.5\n");
    assert!(setup.unwrap_err().starts_with("no channel is read"));
    // A fixed leader holds it already.
    let fixed = "<joint name=\"j1\" type=\"fixed\">";
    let urdf = GRIPPER.replace("<joint name=\"j1\" type=\"continuous\">", fixed);
    let (_folder, setup) = files(urdf.as_bytes(), "[locked]\nj2 = 0.5\n");
    assert_eq!(
        setup.unwrap_err(),
        "locked.j2: \"j2\" follows \"j1\" (<mimic>), a fixed joint, which already holds it; remove \
         it here, or its <mimic> in the URDF"
    );
}

/// Names of a URDF may have what divides the cells of a table.
#[test]
fn any_name_has_its_column_in_the_table() {
    let name = "a, \"b\"\nc";
    let urdf = GRIPPER.replace("\"j1\"", "\"a, &quot;b&quot;\nc\"");
    let (_folder, setup) = files(urdf.as_bytes(), "");
    // Two positions are too few for an acceleration, for which the channel is named.
    let log = format!(
        "t,\"joint/{}/position\"\n0.01,0.1\n0.02,0.1\n",
        name.replace('"', "\"\"")
    );
    let mut out = Vec::new();
    proprio_estimator::offline::estimate(setup.unwrap(), log.as_bytes(), &mut out, None).unwrap();
    let mut table = csv::Reader::from_reader(out.as_slice());
    let header = table.headers().unwrap().clone();
    let column = |part: &str| {
        let wanted = format!("{part}/{name}");
        header.iter().position(|column| column == wanted).unwrap()
    };
    let (torque, reason) = (column("torque"), column("reason"));
    let rows: Vec<_> = table.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 2);
    for row in rows {
        assert_eq!((row.len(), &row[torque]), (header.len(), ""));
        assert!(row[reason].ends_with(&format!(":{name}")), "{row:?}");
    }
}

/// The names above a floating joint are in the file, but not in the model.
#[test]
fn a_name_above_the_robot_is_told_as_such() {
    let free = "<link name=\"world\"/><joint name=\"free\" type=\"floating\">\
                <parent link=\"world\"/><child link=\"base\"/></joint></robot>";
    let urdf = GRIPPER.replace("</robot>", free);
    let warning = |name: &str| {
        format!(
            "\"{name}\" is above the robot, which floats in the URDF, and is dropped; the root is \
             the link \"base\""
        )
    };
    let contact = "[[contact]]\nlink = \"world\"\nkind = \"wrench\"\npresence = \"always\"\n";
    let sensor = "[[force_torque]]\nsensor = \"s\"\njoint = \"free\"\n";
    for (more, place, name) in [
        (contact, "contact \"world\": link: ", "world"),
        (sensor, "force_torque \"s\": joint = \"free\": ", "free"),
        ("[locked]\nfree = 0.0\n", "locked.free: ", "free"),
    ] {
        let (_folder, setup) = files(urdf.as_bytes(), more);
        assert_eq!(setup.unwrap_err(), place.to_owned() + &warning(name));
    }
    assert!(files(urdf.as_bytes(), "").1.is_ok());
    // Of a joint that is not there at all, the configuration's key is told.
    let (folder, setup) = files(urdf.as_bytes(), &sensor.replace("free", "fre"));
    let place = format!(
        "force_torque \"s\": joint = \"fre\": {}: joint fre, named as",
        folder.path().join("r.urdf").display()
    );
    let problem = setup.unwrap_err();
    assert!(problem.starts_with(&place), "{problem}");
}

#[test]
fn a_urdf_is_read_in_the_encoding_that_it_declares() {
    let declared = |encoding: &str| {
        format!("<?xml version=\"1.0\" encoding=\"{encoding}\"?><!-- \u{e9} -->{GRIPPER}")
            .replace("\"a\"", "\"\u{e9}paule\"")
    };
    let latin = |text: &str| text.chars().map(|c| c as u8).collect::<Vec<u8>>();
    let utf16 = |text: &str| -> Vec<u8> {
        let marked = format!("\u{feff}{text}");
        marked.encode_utf16().flat_map(u16::to_le_bytes).collect()
    };
    for bytes in [
        declared("UTF-8").into_bytes(),
        latin(&declared("ISO-8859-1")),
        latin(&declared("windows-1252")),
        latin(&declared("utf-8")),
        utf16(&declared("UTF-16")),
    ] {
        let (folder, setup) = files(&bytes, "");
        let model = setup.expect("it is read").robot.model;
        assert!(model.frame("\u{e9}paule").is_some());
        // As text it can be written again in UTF-8.
        let text = Model::read_text(&folder.path().join("r.urdf")).unwrap();
        assert!(text.to_lowercase().contains("encoding=\"utf-8\""), "{text}");
        let new = Model::rewrite_urdf(&text, &[], model.inertias()).unwrap();
        assert_eq!(new, text);
    }
    let broken = GRIPPER.replace("<axis xyz=\"0 1 0\"/>", "<axis xzy=\"0 1 0\"/>");
    let (folder, setup) = files(broken.as_bytes(), "");
    let file = folder.path().join("r.urdf");
    assert_eq!(
        setup.unwrap_err(),
        format!(
            "{}: line 1: joint j1: its <axis> has no xyz (it has xzy); write its direction, \
             such as xyz=\"0 0 1\"",
            file.display()
        )
    );
}

/// The six axes of a wrist are those of the last moving joint: the torque about its axis is read.
#[test]
fn a_sensor_in_a_moving_joint_is_on_the_side_of_its_child() {
    let sensor = "[[force_torque]]\nsensor = \"s\"\njoint = \"j1\"\n";
    // A joint that follows another one is such a joint, and is listed once.
    let in_follower = sensor.replace("j1", "j2");
    let (_folder, setup) = files(GRIPPER.as_bytes(), &in_follower);
    let text = setup.expect("a cut in a following joint").to_string();
    assert_eq!(text.matches("j2 follows j1").count(), 1, "{text}");
    let urdf = GRIPPER.replace("<mimic", "<ignored");
    let (_folder, setup) = files(urdf.as_bytes(), sensor);
    let setup = setup.expect("a cut in a moving joint");
    let names: Vec<&str> = setup.channels().map(|(_, name)| name).collect();
    assert_eq!(names, ["s", "j1", "j2"]);
    let text = setup.to_string();
    assert!(
        text.contains("  s is in the moving joint j1, on the side of its child\n")
            && !text.contains("mounted beyond"),
        "{text}"
    );
    let check = checked(&setup);
    let [at_rest] = &check.sensors[..] else {
        panic!("one sensor")
    };
    // Child to parent, at rest: the weight of both links, 1 kg at x = 0.1 m.
    assert!((at_rest.mass - 1.5).abs() < 1e-12);
    let expected = [
        0.0,
        0.0,
        -1.5 * STANDARD_GRAVITY,
        0.0,
        0.1 * STANDARD_GRAVITY,
        0.0,
    ];
    for (read, expected) in at_rest.reading.force_first().into_iter().zip(expected) {
        assert!((read - expected).abs() < 1e-9, "{:?}", at_rest.reading);
    }
    // The torque of j1, by the parent on the child, is what the sensor reads about its axis.
    let log = "t,joint/j1/position,joint/j1/velocity,joint/j1/acceleration,joint/j2/position,\
               joint/j2/velocity,joint/j2/acceleration,wrench/s/fx,wrench/s/fy,wrench/s/fz,\
               wrench/s/tx,wrench/s/ty,wrench/s/tz\n0,0.3,0,0,0.2,0,0,1,2,-15,0.1,0.7,0.2\n";
    // With so much noise any reading may be that of the links alone.
    let known = format!(
        "{sensor}offset_n = [0, 0, 0]\noffset_nm = [0, 0, 0]\nnoise_n = [9, 9, 9]\n\
         noise_nm = [9, 9, 9]\n[output]\nmax_torque_std_nm = 100\n"
    );
    let (_folder, setup) = files(urdf.as_bytes(), &known);
    let setup = setup.expect("a known offset");
    let mut out = Vec::new();
    proprio_estimator::offline::estimate(setup, log.as_bytes(), &mut out, None).expect("estimates");
    let out = String::from_utf8(out).unwrap();
    let (header, row) = out.trim_end().split_once('\n').unwrap();
    let column = header
        .split(',')
        .position(|name| name == "torque/j1")
        .unwrap();
    let torque: f64 = row.split(',').nth(column).unwrap().parse().unwrap();
    assert!((torque + 0.7).abs() < 1e-9, "{torque}");
    // The parent moves against the sensor.
    let (_folder, setup) = files(urdf.as_bytes(), &format!("{sensor}frame = \"parent\"\n"));
    let error = setup.unwrap_err();
    assert!(
        error.starts_with("force_torque \"s\": the F/T sensor in joint j1 cannot measure in the")
            && error.contains("use the frame of the child"),
        "{error}"
    );
}

/// Of several sensors in one joint the one of the given name is read; how one that cannot be
/// understood measures is not guessed.
#[test]
fn a_sensor_is_the_one_of_its_name_in_its_joint() {
    let element = |name: &str, direction: &str| {
        format!(
            "<gazebo reference=\"j2\"><sensor name=\"{name}\" type=\"force_torque\"><force_torque>\
             <measure_direction>{direction}</measure_direction></force_torque></sensor></gazebo>"
        )
    };
    let robot = |elements: &[String]| {
        let elements = elements.concat() + "</robot>";
        GRIPPER
            .replace("<mimic", "<ignored")
            .replace("</robot>", &elements)
    };
    let fz = |urdf: &str, name: &str, keys: &str| {
        let ft = format!("[[force_torque]]\nsensor = \"{name}\"\njoint = \"j2\"\n{keys}");
        let (_folder, setup) = files(urdf.as_bytes(), &ft);
        setup.map(|setup| checked(&setup).sensors[0].reading.force_first()[2])
    };
    let two = robot(&[
        element("u", "child_to_parent"),
        element("w", "parent_to_child"),
    ]);
    let (u, w) = (fz(&two, "u", "").unwrap(), fz(&two, "w", "").unwrap());
    assert!(u < -4.0 && (u + w).abs() < 1e-9, "{u} {w}");
    let error = fz(&two, "v", "").unwrap_err();
    assert!(
        error.contains("\"v\": the URDF has several sensors in joint j2, none of this name: u, w"),
        "{error}"
    );
    let one = robot(&[element("u", "parent_to_child")]);
    assert_eq!(fz(&one, "v", ""), Ok(w));
    let misspelt = robot(&[element("u", "parenttochild")]);
    let error = fz(&misspelt, "u", "").unwrap_err();
    assert!(
        error.contains("its direction is parenttochild") && error.contains("line 1: F/T sensor"),
        "{error}"
    );
    let given = "frame = \"child\"\ndirection = \"parent_to_child\"\n";
    assert_eq!(fz(&misspelt, "u", given), Ok(w));
}
