//! The figures of `estimator --check`, against numbers computed by hand.

use proprio_dynamics::model::Model;
use proprio_estimator::check::Check;
use proprio_estimator::config::{Config, STANDARD_GRAVITY};
use proprio_estimator::setup::Setup;

/// A base, an F/T sensor below it, a shoulder, an arm with a hand. The arm has 2 kg, with its
/// centre of mass 0.1 m out along x; the wrist is 0.4 m out; the hand has 1 kg, with its centre of
/// mass 0.2 m beyond the wrist.
fn setup(contacts: &str, effort: f64, locked: &str) -> Setup {
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
    let model = Model::from_urdf(&urdf, &["ft"]).expect("a model");
    Setup::with_model(&Config::parse(&config).expect("a configuration"), model).expect("it fits")
}

#[test]
fn masses_and_readings_at_rest_are_those_of_a_balance() {
    let check = Check::of(&setup("", 50.0, "")).expect("numbers");
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
    let check = Check::of(&setup("", 50.0, &down)).expect("numbers");
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
    let check = Check::of(&setup("", 0.05, "")).expect("numbers");
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
        Check::of(&setup("", 0.08 * STANDARD_GRAVITY + 1e-9, ""))
            .expect("numbers")
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
    let check = Check::of(&setup(&both, 50.0, "")).expect("numbers");
    assert_eq!(check.undetermined, ["wrist"]);
    assert_eq!(check.hiding, ["palm", "elbow"]);
    let problem = check.problem().expect("one");
    for word in ["wrist", "palm, elbow", "presence = \"possible\""] {
        assert!(problem.contains(word), "{problem}");
    }
    // No problem if one contact is possible only, or if the joint is locked.
    let possible =
        contact("palm", "hand", "presence = \"possible\"\n") + &contact("elbow", "arm", "");
    assert!(
        Check::of(&setup(&possible, 50.0, ""))
            .expect("numbers")
            .problem()
            .is_none()
    );
    assert!(
        Check::of(&setup(&both, 50.0, "[locked]\nwrist = -1\n"))
            .expect("numbers")
            .problem()
            .is_none()
    );
}
