//! estimator.toml: what is legal, and what is said of the rest.

use super::*;

#[test]
fn the_reference_of_estimator_toml_is_new() {
    crate::schema::check("estimator.schema.json", |_| crate::schema::of::<Config>());
}

const ARM: &str = r#"
        schema = 1
        robot = "icub"
        model = "model.urdf"
        [base]
        kind = "fixed"
        link = "chest"
        [[force_torque]]
        sensor = "ft"
        joint = "ft_joint"
        [[contact]]
        name = "hand"
        link = "l_hand"
        [output]
        trigger = "ft"
    "#;

#[test]
fn too_many_numbers_are_refused() {
    for (key, place) in [
        ("gravity_mps2", "[base]\n"),
        ("noise_n", "[[force_torque]]\n"),
        ("direction", "[[contact]]\n"),
    ] {
        for numbers in ["[0, 0]", "[0, 0, 0, 0]"] {
            let text = ARM
                .replace(place, &format!("{place}{key} = {numbers}\n"))
                .replace("        ", "");
            let error = Config::parse(&text).unwrap_err();
            let given = numbers.matches('0').count();
            assert!(
                error.contains(&format!("{given} numbers where 3 are needed")),
                "{error}"
            );
            // Where the kind decides what a table holds, TOML only knows which table.
            assert!(error.contains(key) || error.contains("[base]"), "{error}");
        }
    }
}

#[test]
fn defaults_are_as_documented() {
    let config = Config::parse(ARM).unwrap();
    assert_eq!(
        config.base,
        Base::Fixed {
            link: "chest".into(),
            gravity_mps2: [0.0, 0.0, -9.80665]
        }
    );
    assert_eq!(config.force_torque[0].noise_n, [0.08, 0.09, 0.18]);
    assert_eq!(config.contact[0].kind, ContactModel::Wrench);
    assert_eq!(config.contact[0].presence, Occurrence::Always);
    assert!(!config.identification.enabled);
    assert_eq!(config.identification.urdf_relative_std, 0.2);
    assert_eq!(config.identification.rate_hz, 100.0);
    assert_eq!(config.identification.gain, Gain::Auto);
    assert_eq!(config.identification.gain_std, 0.05);
    assert!(!config.identification.temperature);
    assert_eq!(config.force_torque[0].calibration(), Calibration::default());
    let (_, deviations) = config.force_torque[0].offset();
    assert_eq!(deviations, UNKNOWN_OFFSET);
}

#[test]
fn each_mistake_has_one_clear_message() {
    for (from, to, expected) in [
        (
            "robot = \"icub\"",
            "robot = \"-x\"",
            "robot = \"-x\": a robot's name begins with a letter or a digit",
        ),
        ("schema = 1", "schema = 3", "schema = 3 is not known"),
        (
            "kind = \"fixed\"",
            "kind = \"fixd\"",
            "unknown variant `fixd`, expected one of `fixed`, `stance`, `imu`",
        ),
        (
            "joint = \"ft_joint\"",
            "joint = \"ft_joint\"\nnoise_n = [0.1, 0.0, 0.1]",
            "noise_n has the value 0",
        ),
        (
            "link = \"l_hand\"",
            "link = \"l_hand\"\nkind = \"force_along\"",
            "direction is missing",
        ),
        (
            "link = \"l_hand\"",
            "link = \"l_hand\"\ndirection = [0.0, 0.0, 1.0]",
            "is allowed with kind = \"force_along\" only",
        ),
        (
            "joint = \"ft_joint\"",
            "joint = \"ft_joint\"\noffset_std_n = [0.1, -1.0, 0.1]",
            "offset_std_n has the value -1",
        ),
        (
            "[output]",
            "[identification]\nurdf_relative_std = -0.1\n[output]",
            "identification.urdf_relative_std = -0.1 must be 0 to 2",
        ),
        (
            "[output]",
            "[identification]\nrate_hz = 0.1\n[output]",
            "identification.rate_hz = 0.1 must be 1 to 1000",
        ),
        (
            "joint = \"ft_joint\"",
            "joint = \"ft_joint\"\ngain = [1, 1, 1]",
            "3 numbers where 6 (a diagonal) or 36 (row by row) are needed",
        ),
        (
            "joint = \"ft_joint\"",
            "joint = \"ft_joint\"\ngain = [1, 1, 0, 1, 1, 1]",
            "gain is singular",
        ),
        (
            "joint = \"ft_joint\"",
            "joint = \"ft_joint\"\ntemperature_n_per_k = [0, 0, 0.1]",
            "reference_celsius is missing",
        ),
        (
            "[output]",
            "[identification]\ngain = \"some\"\n[output]",
            "unknown variant `some`, expected one of `auto`, `none`, `diagonal`, `full`",
        ),
        (
            "[output]",
            "[identification]\ngain_std = 0.0\n[output]",
            "identification.gain_std = 0 must be above 0, at most 1",
        ),
        (
            "[output]",
            "[identification]\nsave_every_s = 0\n[output]",
            "identification.save_every_s = 0 must be 1 to",
        ),
        (
            "[output]",
            "[[skin]]\nchannel = \"s\"\nlink = \"a\"\ncontact = \"hand\"\ntaxels = \"t\"\n\
                 noise = 0\n[output]",
            "skin \"s\": noise = 0 must be above 0",
        ),
        (
            "[output]",
            "[[skin]]\nchannel = \"s\"\nlink = \"a\"\ncontact = \"hand\"\n[output]",
            "missing field `taxels`",
        ),
        (
            "trigger = \"ft\"",
            "triger = \"ft\"",
            "unknown field `triger`",
        ),
        (
            "trigger = \"ft\"",
            "timing = \"immediate\"\nmax_wait_ms = 2",
            "output.max_wait_ms is of no use with timing = \"immediate\"",
        ),
        (
            "trigger = \"ft\"",
            "max_wait_ms = -1.0",
            "max_wait_ms = -1 must be 0 to 250",
        ),
        (
            "link = \"chest\"",
            "link = \"chest\"\ngravity_mps2 = [0.0, 0.0, nan]",
            "base.gravity_mps2 has the value NaN",
        ),
        (
            "kind = \"fixed\"\n        link = \"chest\"",
            "kind = \"stance\"\n        foot = []",
            "base.foot is empty",
        ),
        (
            "kind = \"fixed\"\n        link = \"chest\"",
            "kind = \"stance\"\n        foot = [{ link = \"chest\" }]",
            "missing field `contact`",
        ),
    ] {
        assert!(ARM.contains(from), "{from}");
        let problem = Config::parse(&ARM.replacen(from, to, 1)).unwrap_err();
        assert!(problem.contains(expected), "{from} -> {to}: {problem}");
    }
}
