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
    let told = whys(&bound("0.15")).join("; ");
    assert!(
        told.contains("known to 20.0 % only (identification.urdf_relative_std)"),
        "{told}"
    );
    let told = whys(&bound("1e-5")).join("; ");
    assert!(told.contains("because of the noise"), "{told}");

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
    let told = reasons(&hidden);
    let (_, names) = told
        .iter()
        .find(|(why, _)| why.starts_with("undetermined"))
        .expect("it");
    assert!(names.contains(&"wrist".to_owned()), "{told:?}");
}
