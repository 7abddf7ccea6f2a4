//! parameters.toml read, written, truncated, changed, and of another robot.

use super::in_use::with_calibration;
use super::{arm, drive, identified, root};
use crate::common::{Random, humanoid};
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::calibration::{Gain, Kind};
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::Wrench;
use proprio_estimator::config::Config;
use proprio_estimator::drive::DriveModel;
use proprio_estimator::parameters::{
    Friction, Offset, Parameters, ParametersError, Provenance, Rotor,
};
use proprio_estimator::setup::Setup;
use proprio_topics::Nanos;

#[test]
fn a_file_reads_back_as_what_was_written() {
    let setup = arm();
    let parameters = identified(&setup, &mut Random::new(3));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("parameters.toml");
    parameters.save(&file).unwrap();
    let read = Parameters::load(&file).unwrap();
    assert_eq!(read, parameters);
    let text = std::fs::read_to_string(&file).unwrap();
    assert_eq!(read.to_string(), text, "and again");
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "nothing else is left there"
    );
    // A file from before rotors were identified.
    let older: String = text
        .lines()
        .filter(|line| !line.starts_with("rotor_inertia_kgm2 = 0.08"))
        .filter(|line| !line.starts_with("rotor_inertia_std"))
        .flat_map(|line| [line, "\n"])
        .collect();
    let older = Parameters::parse(&older).unwrap();
    assert_eq!(
        (older.friction()[0].rotor, older.friction()[0].coulomb),
        (None, 0.5)
    );
    // A file with nothing identified is valid, too.
    let nothing = Parameters::new(&setup.robot, Provenance::default());
    assert_eq!(Parameters::parse(&nothing.to_string()).unwrap(), nothing);
    // The given numbers are reproduced: deviations to rounding, the covariance to a billionth of
    // them.
    let mut random = Random::new(3);
    let columns = 10 * setup.robot.model.inertias().len();
    let root = DMatrix::from_fn(columns, columns, |_, j| {
        random.real(if j % 10 < 4 { 1e-2 } else { 1e-6 })
    });
    let links: Vec<_> = setup
        .robot
        .model
        .inertias()
        .iter()
        .copied()
        .enumerate()
        .collect();
    let mut parameters = nothing;
    parameters.set_identified(&links, &[], &root).unwrap();
    let (expected, got) = (
        root.transpose() * &root,
        parameters.root().transpose() * parameters.root(),
    );
    for i in 0..columns {
        let deviation = parameters.deviation(i / 10).unwrap()[i % 10];
        assert!((deviation * deviation - expected[(i, i)]).abs() < 1e-12 * expected[(i, i)]);
        for j in 0..columns {
            let scale = (expected[(i, i)] * expected[(j, j)]).sqrt();
            assert!((got[(i, j)] - expected[(i, j)]).abs() < 2e-8 * scale);
        }
    }
}

/// Nine digits are enough for the hardest case: a combination known a million times better than its
/// parameters.
#[test]
fn the_file_keeps_the_variance_of_combinations() {
    let setup = arm();
    let links: Vec<_> = setup
        .robot
        .model
        .inertias()
        .iter()
        .copied()
        .enumerate()
        .collect();
    let columns = 10 * links.len();
    let mut random = Random::new(8);
    let direction = DVector::from_fn(columns, |_, _| random.real(1.0)).normalize();
    let all = DMatrix::from_fn(columns, columns, |_, _| random.real(1.0));
    let narrow =
        DMatrix::identity(columns, columns) - &direction * direction.transpose() * (1.0 - 1e-6);
    let root = all.clone() * narrow;
    let mut parameters = Parameters::new(&setup.robot, Provenance::default());
    parameters.set_identified(&links, &[], &root).unwrap();
    let (got, expected) = (
        (parameters.root() * &direction).norm(),
        (root * &direction).norm(),
    );
    assert!(expected < 2e-6 * (all * &direction).norm());
    assert!((got - expected).abs() < 5e-3 * expected, "{got} {expected}");
}

#[test]
fn an_icubs_file_is_less_than_a_megabyte() {
    let (text, sensors) = humanoid();
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("model.urdf"), text).unwrap();
    let mut config = String::from(
        "schema = 1\nrobot = \"r\"\nmodel = \"model.urdf\"\n[base]\nkind = \"fixed\"\nlink = \
         \"link0\"\n",
    );
    for joint in &sensors {
        config += &format!("[[force_torque]]\nsensor = \"{joint}\"\njoint = \"{joint}\"\n");
    }
    let file = folder.path().join("estimator.toml");
    std::fs::write(&file, config).unwrap();
    let mut config = Config::load(&file).unwrap();
    let setup = Setup::new(&config).unwrap();
    let mut parameters = Parameters::new(&setup.robot, Provenance::default());
    let links: Vec<_> = setup
        .robot
        .model
        .inertias()
        .iter()
        .copied()
        .enumerate()
        .collect();
    let offsets: Vec<Offset> = sensors
        .iter()
        .map(|sensor| Offset {
            sensor: sensor.clone(),
            reading: Wrench::from_parts([1.0 / 3.0; 3], [1.0 / 7.0; 3]),
            drift: Wrench::zero(),
            known: Nanos::ZERO,
            noise: Wrench::zero(),
            calibrated: None,
        })
        .collect();
    let (columns, mut random) = (10 * links.len() + 6 * offsets.len(), Random::new(5));
    assert_eq!(columns, 426);
    let root = DMatrix::from_fn(columns, columns, |_, _| random.real(1e-3));
    parameters.set_identified(&links, &offsets, &root).unwrap();
    let written = folder.path().join("parameters.toml");
    parameters.save(&written).unwrap();
    let bytes = std::fs::metadata(&written).unwrap().len();
    assert!(bytes < 1_000_000, "{bytes}");
    config.parameters = Some(written);
    assert_eq!(
        Setup::new(&config).unwrap().initial.identified(),
        Some(&parameters)
    );
}

#[test]
fn a_file_that_is_truncated_or_changed_is_refused_with_a_sentence() {
    let setup = arm();
    let text = identified(&setup, &mut Random::new(3)).to_string();
    // Truncated at any place, down to the last bracket.
    let mut lengths: Vec<usize> = text
        .match_indices('\n')
        .map(|(at, _)| at + 1)
        .filter(|&at| at < text.len())
        .collect();
    lengths.extend((0..text.len() - 2).step_by(997));
    lengths.push(text.len() - 2);
    for length in lengths {
        let error = Parameters::parse(&text[..length]).unwrap_err();
        let sentence = error.to_string();
        assert!(
            matches!(error, ParametersError::Damaged(_)),
            "{length}: {sentence}"
        );
        assert!(
            sentence.contains("identify again") && !sentence.contains('\n'),
            "{sentence}"
        );
    }
    let first_column = text.find("[1000000000]").unwrap();
    let mut half = text.clone();
    half.replace_range(
        first_column.."[1000000000]".len() + first_column,
        "[500000000]",
    );
    for (changed, expected) in [
        (half, "correlation.root: column 0 has length 0.5, not 1"),
        (
            text.replace("program =", "programme ="),
            "unknown field `programme`",
        ),
        (
            text.replacen("identified = [", "identified = [nan, ", 1),
            "11 numbers where 10 are needed",
        ),
        (
            text.replacen("std_n = [", "std_n = [-", 1),
            "correlation.root: column",
        ),
        (
            text.replacen("coulomb_nm = 0.5", "coulomb_nm = inf", 1),
            "joint l_elbow: a number is not finite",
        ),
        (
            text.replacen("rotor_inertia_std_kgm2 = 0.002", "", 1),
            "joint l_elbow: only one of rotor_inertia_kgm2 and rotor_inertia_std_kgm2 is given",
        ),
        (
            text.replacen("coulomb_nm = 0.4", "coulomb_nm = inf", 1),
            "drive l_elbow: a number is not finite",
        ),
        (
            text.replacen("identified = [", "identified = [-", 1),
            "no rigid body has these ten parameters: its mass is -",
        ),
        (
            text.replacen("name = \"l_elbow_1\"", "name = \"l_forearm\"", 1),
            "link l_forearm is given twice",
        ),
        ("\u{0}\u{1}garbage".into(), "line 1"),
        (String::new(), "missing field `schema`"),
    ] {
        match Parameters::parse(&changed) {
            Err(error) => assert!(error.to_string().contains(expected), "{expected}: {error}"),
            Ok(_) => assert!(changed == text, "nothing changed for {expected}"),
        }
    }
    let schema = Parameters::parse("schema = 2\nnew = true\n").unwrap_err();
    assert_eq!(
        schema.to_string(),
        "has schema = 2; this version reads schema = 1: identify again, or use the version that \
         wrote it"
    );
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("p.toml");
    assert!(matches!(
        Parameters::load(&file),
        Err(ParametersError::Read(_))
    ));
    std::fs::write(&file, [0xff, 0xfe, 0x00]).unwrap();
    assert!(matches!(
        Parameters::load(&file),
        Err(ParametersError::Damaged(_))
    ));
}

#[test]
fn parameters_of_another_robot_are_refused_with_the_first_difference() {
    let setup = arm();
    let parameters = identified(&setup, &mut Random::new(3));
    let text = parameters.to_string();
    let refused = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        let other = Parameters::parse(&text.replacen(from, to, 1)).unwrap();
        let mut setup = setup.clone();
        let error = setup.apply(&other).unwrap_err().to_string();
        assert_eq!(
            (setup.initial.identified(), &setup.initial.offsets),
            (None, &arm().initial.offsets),
            "nothing is changed"
        );
        error
    };
    assert_eq!(
        refused("robot = \"icub_left_arm\"", "robot = \"icub_right_arm\""),
        "belongs to robot \"icub_right_arm\", not to \"icub_left_arm\"; use the parameters of \
         \"icub_left_arm\", or identify again"
    );
    let sensor = refused("name = \"l_arm_ft_sensor\"", "name = \"r_arm_ft_sensor\"");
    assert!(
        sensor.contains(
            "has force/torque sensor \"r_arm_ft_sensor\", which the configuration does not have"
        ),
        "{sensor}"
    );
    let joint = refused(
        "[[drive]]\njoint = \"l_elbow\"",
        "[[drive]]\njoint = \"l_elbw\"",
    );
    assert!(joint.contains("has joint \"l_elbw\""), "{joint}");

    // Another URDF: a heavier hand, a longer arm, a link more.
    let urdf = std::fs::read_to_string(root().join("config/icub_left_arm/model.urdf")).unwrap();
    let hand = setup
        .robot
        .model
        .link_name(setup.robot.model.inertias().len() - 1)
        .to_owned();
    let mut inertias = setup.robot.model.inertias().to_vec();
    inertias.last_mut().unwrap().mass *= 1.01;
    let keep = ["l_arm_ft_sensor"];
    let heavier = Model::rewrite_urdf(&urdf, &keep, &inertias).unwrap();
    let joint = urdf.find("<joint name=\"l_elbow\"").unwrap();
    let origin = joint + urdf[joint..].find("xyz=\"").unwrap() + 5;
    let mut longer = urdf.clone();
    longer.insert(origin, '1');
    let more = urdf.replace(
        "</robot>",
        &format!(
            "<link name=\"tip\"><inertial><mass value=\"1\"/><inertia ixx=\"1\" ixy=\"0\" \
             ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial></link>\
             <joint name=\"j\" type=\"continuous\"><parent link=\"{hand}\"/><child link=\"tip\"/>\
             <axis xyz=\"0 0 1\"/></joint></robot>"
        ),
    );
    for (urdf, expected) in [
        (
            heavier,
            format!("link {hand} has other inertial parameters in that URDF"),
        ),
        (longer, "has another frame or axis there".into()),
        (more, "the URDF has link tip, which it does not have".into()),
        (
            urdf.replace("\"l_shoulder_2\"", "\"l_shoulder_two\""),
            "it has link l_shoulder_2 where the URDF has l_shoulder_two".into(),
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("model.urdf");
        std::fs::write(&file, urdf).unwrap();
        let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
        config.model = file;
        if expected.contains("tip") {
            config.locked.insert("j".into(), 0.0);
        }
        let mut other = Setup::new(&config).unwrap();
        let error = other.apply(&parameters).unwrap_err().to_string();
        assert!(
            error.contains(&expected) && error.contains("use the URDF"),
            "{expected}: {error}"
        );
    }
}

#[test]
fn a_setup_names_the_file_that_it_could_not_use() {
    let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    config.parameters = Some("nowhere/p.toml".into());
    let problem = Setup::new(&config).unwrap_err();
    assert!(
        problem.starts_with("parameters: nowhere/p.toml cannot be read: "),
        "{problem}"
    );
}

#[test]
fn inconsistent_or_infinite_parameters_are_refused() {
    let setup = arm();
    let mut parameters = identified(&setup, &mut Random::new(3));
    let before = parameters.clone();
    let (good, root) = (setup.robot.model.inertias()[3], DMatrix::identity(10, 10));
    let mut negative = good;
    negative.mass = -1.0;
    let mut no_number = root.clone();
    no_number[(3, 3)] = f64::NAN;
    let twice = DMatrix::identity(20, 20);
    for (links, root, expected) in [
        (vec![(3, negative)], &root, "no rigid body has these"),
        (
            vec![(3, good)],
            &twice,
            "columns of the covariance's root: 20 given, 10 needed",
        ),
        (vec![(3, good), (3, good)], &twice, "link 3 is given twice"),
        (
            vec![(99, good)],
            &root,
            "link 99 is given twice, or is not one of the 9 links",
        ),
        (
            vec![(3, good)],
            &no_number,
            "the covariance: a number is not finite",
        ),
    ] {
        let error = parameters
            .set_identified(&links, &[], root)
            .unwrap_err()
            .to_string();
        assert!(error.contains(expected), "{expected}: {error}");
    }
    let friction = |coulomb, deviation| Friction {
        joint: "l_elbow".into(),
        coulomb,
        rotor: Some(Rotor {
            inertia: 0.1,
            deviation,
        }),
        ..Friction::default()
    };
    assert!(parameters.set_friction(&[friction(f64::NAN, 0.0)]).is_err());
    assert!(parameters.set_friction(&[friction(0.0, -1.0)]).is_err());
    let mut odd = drive();
    odd.parameters[1] = f64::NAN;
    assert!(parameters.set_drives(&[odd]).is_err());
    let noise = -0.1;
    assert!(
        parameters
            .set_drives(&[DriveModel { noise, ..drive() }])
            .is_err()
    );
    assert_eq!(parameters, before);
}

#[test]
fn an_incomplete_calibration_is_refused() {
    let text = with_calibration(
        &arm(),
        Kind {
            gain: Gain::Diagonal,
            temperature: true,
        },
    )
    .to_string();
    for (key, expected) in [
        ("gain", "gain is missing"),
        ("reference_celsius", "the temperature keys are incomplete"),
        (
            "temperature_nm_per_k",
            "the temperature keys are incomplete",
        ),
        (
            "temperature_std_n_per_k",
            "the temperature keys are incomplete",
        ),
        ("gain_std", "correlation.root must have"),
    ] {
        let cut: String = text
            .lines()
            .filter(|line| !line.starts_with(&format!("{key} = ")))
            .map(|line| format!("{line}\n"))
            .collect();
        assert_ne!(cut, text, "{key}");
        let error = Parameters::parse(&cut).unwrap_err().to_string();
        assert!(error.contains(expected), "{key}: {error}");
    }
}
