//! A deliberately wrong CAD: the robot's URDF with other masses, first moments and inertias, each
//! still physically possible. It shows the benefit of identification: the robot has the URDF's
//! inertias, and the estimator gets these.

use crate::noise::Random;
use crate::robot::{SimulatedRobot, SimulatedRobotError};
use crate::settings::SimulationSettings;
use crate::truth::Simulation;
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{Mat3, Pose, RigidInertia, Vec3};

/// Maximum number of URDFs drawn until one is wrong enough.
const DRAWS: usize = 300;
/// Minimum RMS error of each joint's torque, relative to the RMS of the torque, for a URDF that is
/// wrong enough: errors of neighbouring links may cancel and would then not show.
const ENOUGH: f64 = 0.1;
/// Number of instants at which torques are compared, and their interval \[s\].
const INSTANTS: (u32, f64) = (25, 0.9);

/// The URDF of `robot` with all inertias wrong by the fraction `relative` (0 to 0.5), up or down,
/// drawn from `settings.seed`. This applies to each body's mass, each component of its first moment
/// and each principal second moment about its centre of mass. Its principal axes are turned by
/// about `relative` radians. Bodies connected by fixed joints are one body.
///
/// Drawn again until, in every joint, the torques of the motion given by `settings` are wrong by a
/// tenth of their RMS (by `relative / 2` if that is less).
///
/// # Errors
/// [`SimulatedRobotError`]: the robot cannot be simulated, or its URDF cannot be read.
pub fn wrong_urdf(
    robot: &SimulatedRobot,
    settings: &SimulationSettings,
    relative: f64,
) -> Result<String, SimulatedRobotError> {
    let file = &robot.config.model;
    let error = |cause| SimulatedRobotError::Model {
        file: file.clone(),
        cause: Box::new(cause),
    };
    let text = Model::read_text(file).map_err(error)?;
    let truth = torques(robot, settings)?;
    let enough = ENOUGH.min(0.5 * relative);
    let mut best: Option<(f64, Model)> = None;
    for draw in 0..DRAWS {
        let mut random = Random::new(settings.seed, "cad", draw);
        let mut other = robot.clone();
        for (link, inertia) in robot.model.inertias().iter().enumerate() {
            let body = another_body(inertia, relative, &mut random);
            other.model.set_inertia(link, body).map_err(error)?;
        }
        // The relative error of the joint with the smallest error.
        let least = torques(&other, settings)?
            .iter()
            .zip(&truth)
            .map(|(other, truth)| {
                let off: f64 = other.iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum();
                (off / truth.iter().map(|b| b * b).sum::<f64>()).sqrt()
            })
            .filter(|share| share.is_finite())
            .fold(f64::INFINITY, f64::min);
        if best.as_ref().is_none_or(|(share, _)| least > *share) {
            best = Some((least, other.model));
        }
        if least > enough {
            break;
        }
    }
    let keep: Vec<&str> = robot
        .config
        .force_torque
        .iter()
        .map(|ft| ft.joint.as_str())
        .collect();
    let model = best.map_or_else(|| robot.model.clone(), |(_, model)| model);
    Model::rewrite_urdf(&text, &keep, model.inertias()).map_err(error)
}

/// Per joint, its torque at the instants compared, without pushes.
fn torques(
    robot: &SimulatedRobot,
    settings: &SimulationSettings,
) -> Result<Vec<Vec<f64>>, SimulatedRobotError> {
    let settings = SimulationSettings {
        push: false,
        faults: Vec::new(),
        ..settings.clone()
    };
    let mut simulation = Simulation::new(robot, &settings)?;
    let mut torques = vec![Vec::new(); simulation.joint_names().count()];
    for instant in 0..INSTANTS.0 {
        let truth = simulation.at(settings.still + f64::from(instant) * INSTANTS.1);
        for (torques, joint) in torques.iter_mut().zip(&truth.joints) {
            torques.push(joint.torque);
        }
    }
    Ok(torques)
}

/// A similar body that is also physically possible.
fn another_body(body: &RigidInertia, relative: f64, random: &mut Random) -> RigidInertia {
    let mut off = || {
        if random.happens(0.5) {
            relative
        } else {
            -relative
        }
    };
    if body.centre().is_none() {
        return *body;
    }
    let mass = body.mass * (1.0 + off());
    let first_moment = body.first_moment.map(|h| h * (1.0 + off()));
    let about_centre = body.about_centre();
    // Second moments of the mass, not moments of inertia: any positive values are physically
    // possible.
    let spread = Mat3::from_diagonal_element(about_centre.trace() / 2.0) - about_centre;
    let principal = spread.symmetric_eigen();
    let extents: Vec3 = principal
        .eigenvalues
        .map(|extent| extent.max(0.0) * (1.0 + off()));
    let turn = Pose::from_xyz_rpy(
        [0.0; 3],
        [off(), off(), off()].map(|angle| angle / 3.0_f64.sqrt()),
    );
    let axes = turn.rotation * principal.eigenvectors;
    let spread = axes * Mat3::from_diagonal(&extents) * axes.transpose();
    let inertia = Mat3::from_diagonal_element(spread.trace()) - spread;
    RigidInertia::from_centroidal(mass, &(first_moment / mass), &inertia)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(robot: &SimulatedRobot, text: &str) -> Model {
        let keep: Vec<&str> = robot
            .config
            .force_torque
            .iter()
            .map(|ft| ft.joint.as_str())
            .collect();
        Model::from_urdf(text, &keep).unwrap()
    }

    #[test]
    fn the_wrong_urdf_is_of_bodies_that_exist_and_is_as_wrong_as_asked() {
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        let text = wrong_urdf(&robot, &SimulationSettings::default(), 0.2).unwrap();
        let wrong_model = model(&robot, &text);
        assert_eq!(wrong_model.link_count(), robot.model.link_count());
        for (link, (body, truth)) in wrong_model
            .inertias()
            .iter()
            .zip(robot.model.inertias())
            .enumerate()
        {
            let name = wrong_model.link_name(link);
            if truth.mass == 0.0 {
                assert_eq!(body, truth, "{name}");
                continue;
            }
            body.check(1e-9)
                .unwrap_or_else(|why| panic!("{name}: {why:?}"));
            assert!(
                ((body.mass / truth.mass - 1.0).abs() - 0.2).abs() < 1e-9,
                "{name}"
            );
            for (h, true_h) in body.first_moment.iter().zip(&truth.first_moment) {
                assert!(
                    ((h - true_h).abs() - 0.2 * true_h.abs()).abs() < 1e-9,
                    "{name}"
                );
            }
            assert!(
                (body.inertia - truth.inertia).norm() > 0.01 * truth.inertia.norm(),
                "{name}"
            );
        }
        // Everything else is unchanged: geometry, limits, sensors.
        assert_eq!(wrong_model.joints(), robot.model.joints());
    }

    #[test]
    fn every_torque_is_off_and_the_seed_counts() {
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        for seed in [1, 2, 3] {
            let settings = SimulationSettings {
                seed,
                ..SimulationSettings::default()
            };
            let text = wrong_urdf(&robot, &settings, 0.2).unwrap();
            assert_eq!(
                text,
                wrong_urdf(&robot, &settings, 0.2).unwrap(),
                "the same seed, the same URDF"
            );
            let mut other = robot.clone();
            other.model = model(&robot, &text);
            let (wrong, truth) = (
                torques(&other, &settings).unwrap(),
                torques(&robot, &settings).unwrap(),
            );
            for ((wrong, truth), joint) in wrong.iter().zip(&truth).zip(0..) {
                let off: f64 = wrong.iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum();
                let size: f64 = truth.iter().map(|b| b * b).sum();
                assert!(
                    off.sqrt() > 0.099 * size.sqrt() && off.sqrt() < 0.8 * size.sqrt(),
                    "seed {seed}, joint {joint}"
                );
            }
        }
        let [one, two] = [1, 2].map(|seed| {
            let settings = SimulationSettings {
                seed,
                ..SimulationSettings::default()
            };
            wrong_urdf(&robot, &settings, 0.2).unwrap()
        });
        assert_ne!(one, two);
    }
}
