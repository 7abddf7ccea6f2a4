//! Every URDF of the PyPI packages example-robot-data and icub-models, against Pinocchio: what it
//! loads is loaded, or refused with the place, for a reason that is listed here; inverse dynamics
//! agree.
//!
//! The URDFs and the golden file are not in the repository. `PROPRIO_ROBOTS` names the folder that
//! `tests/oracle/generate.py --robots` makes (`tests/oracle/README.md`).

use proprio_dynamics::spatial::Vec3;
use proprio_dynamics::{FrameMotion, InverseDynamics, JointState, Kinematics};
use proprio_estimator::config::Config;
use proprio_estimator::setup::Setup;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The URDFs that are refused, and why.
const REFUSED: [(&str, &str); 5] = [
    // Compound joints with links of unknown mass between them, which Pinocchio takes as massless.
    (
        "example_robot_data-human_description-human.urdf",
        "line 32: link left_upperleg_virtual, beyond joint left_hip_Z; line 40: link ",
    ),
    // Its ixz, -0.0575, is greater than ixx, 0.0564, and izz, 0.0212, allow.
    (
        "example_robot_data-romeo_description-romeo_laas_small.urdf",
        "line 328: link body: the inertia is not positive semidefinite",
    ),
    // Pinocchio refuses it too.
    (
        "example_robot_data-ur_description-ur3.urdf",
        "the URDF has no link",
    ),
    // Multicopters without joints.
    (
        "example_robot_data-hector_description-quadrotor_base.urdf",
        "no channel is read",
    ),
    (
        "example_robot_data-iris_description-iris_simple.urdf",
        "no channel is read",
    ),
];

/// Largest difference from the golden torques, relative to the largest torque of the state or 1 Nm.
const TOLERANCE: f64 = 1e-9;

#[test]
fn robots_of_other_projects_load_and_have_pinocchios_torques() {
    let Some(folder) = std::env::var_os("PROPRIO_ROBOTS").map(PathBuf::from) else {
        println!("skipped: PROPRIO_ROBOTS (folder of robots.json) is not set");
        return;
    };
    let golden = std::fs::read_to_string(folder.join("robots.json")).unwrap();
    let golden: Value = serde_json::from_str(&golden).unwrap();
    let robots = golden["robots"].as_object().unwrap();
    let (mut loaded, mut wrong, mut worst) = (0, Vec::new(), 0.0_f64);
    for (name, robot) in robots {
        let listed = REFUSED.iter().find(|(file, _)| file == name);
        match (load(&folder.join(name)), listed) {
            (Ok(setup), None) => {
                loaded += 1;
                match robot["refused"].as_str() {
                    Some(_) => {}
                    None => worst = worst.max(compare(&setup, name, robot)),
                }
            }
            (Ok(_), Some(_)) => wrong.push(format!("{name}: listed as refused, but loaded")),
            (Err(message), Some((_, why))) if message.contains(why) => {}
            (Err(message), _) => wrong.push(format!("{name}: {message}")),
        }
    }
    assert!(
        wrong.is_empty(),
        "{} of {}:\n{}",
        wrong.len(),
        robots.len(),
        wrong.join("\n")
    );
    println!(
        "{loaded} of {} loaded; greatest difference {worst:.1e}",
        robots.len()
    );
    assert!(worst <= TOLERANCE, "{worst:e}");
}

/// The robot on its root, as `proprio estimator --check` loads it.
fn load(urdf: &Path) -> Result<Setup, String> {
    let text = |link: &str| {
        format!(
            "schema = 1\nrobot = \"r\"\nmodel = {urdf:?}\n[base]\nkind = \"fixed\"\nlink = \
             {link:?}\n"
        )
    };
    let file = tempfile::NamedTempFile::new().unwrap();
    // Without the name of the root: an error of the URDF comes first.
    let root = proprio_dynamics::model::Model::from_file(urdf, &[]);
    let root = root.map_or_else(|_| String::new(), |model| model.link_name(0).to_owned());
    std::fs::write(file.path(), text(&root)).unwrap();
    Setup::new(&Config::load(file.path()).map_err(|error| error.to_string())?)
}

/// The greatest difference of the torques.
fn compare(setup: &Setup, name: &str, robot: &Value) -> f64 {
    let model = &setup.robot.model;
    let numbers = |value: &Value| -> Vec<f64> {
        let numbers = value.as_array().unwrap().iter();
        numbers.map(|number| number.as_f64().unwrap()).collect()
    };
    let joints = robot["joints"].as_array().unwrap();
    let dofs: Vec<usize> = (joints.iter())
        .map(|joint| {
            let joint = joint.as_str().unwrap();
            (model.dof(joint)).unwrap_or_else(|| panic!("{name}: {joint} has no coordinate"))
        })
        .collect();
    assert_eq!(dofs.len(), model.dof_count(), "{name}: {joints:?}");
    if let Some(base) = robot["base"].as_str() {
        assert_eq!(model.link_name(0), base, "{name}");
    }
    let gravity = Vec3::from_row_slice(&numbers(&robot["gravity"]));
    let base = FrameMotion::standing(&gravity);
    let mut kinematics = Kinematics::new(model, 0).unwrap();
    let mut dynamics = InverseDynamics::new(model);
    let mut worst = 0.0_f64;
    for case in robot["cases"].as_array().unwrap() {
        let by_dof = |key: &str| {
            let mut ordered = vec![0.0; dofs.len()];
            (dofs.iter().zip(numbers(&case[key]))).for_each(|(&dof, x)| ordered[dof] = x);
            ordered
        };
        let [position, velocity, acceleration, torque] =
            ["position", "velocity", "acceleration", "torque"].map(by_dof);
        let state = JointState {
            position: &position,
            velocity: &velocity,
            acceleration: &acceleration,
        };
        kinematics.update(model, state, &base).unwrap();
        dynamics.update(model, &kinematics, &[]).unwrap();
        let scale = torque.iter().fold(1.0_f64, |most, x| most.max(x.abs()));
        for (own, other) in dynamics.torque().iter().zip(&torque) {
            let error = (own - other).abs() / scale;
            assert!(error <= TOLERANCE, "{name}: {own} instead of {other}");
            worst = worst.max(error);
        }
    }
    worst
}
