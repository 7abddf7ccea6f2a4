//! Dynamics alone: a URDF in; inverse dynamics, the regressor and base parameters out.

use proprio_dynamics::model::Model;
use proprio_dynamics::regressor::Regressor;
use proprio_dynamics::regressor::identifiable::{
    Identifiable, Measurement, Offsets, Regime, Scope,
};
use proprio_dynamics::spatial::{RigidInertia, Vec3};
use proprio_dynamics::{FrameMotion, InverseDynamics, JointState, Kinematics};

/// Prints the torques of an arm in one state, and what its torques can show of its inertia.
pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let model = Model::from_urdf(
        include_str!("../../../config/icub_left_arm/model.urdf"),
        &[],
    )?;
    let (gravity, n) = (Vec3::new(0.0, 0.0, -9.80665), model.dof_count());
    let [position, velocity, acceleration] = [0.3, 0.5, 1.0].map(|value| vec![value; n]);
    let state = JointState {
        position: &position,
        velocity: &velocity,
        acceleration: &acceleration,
    };
    let mut kinematics = Kinematics::new(&model, 0)?;
    kinematics.update(&model, state, &FrameMotion::standing(&gravity))?;
    let (mut inverse, mut regressor) = (InverseDynamics::new(&model), Regressor::new(&model));
    inverse.update(&model, &kinematics, &[])?;
    regressor.update(&model, &kinematics)?;
    let parameters: Vec<f64> = model
        .inertias()
        .iter()
        .flat_map(RigidInertia::parameters)
        .collect();
    for (dof, torque) in inverse.torque().iter().enumerate() {
        let row = regressor.joint_row(dof).ok_or("a joint without a row")?;
        let product: f64 = row.iter().zip(&parameters).map(|(y, phi)| y * phi).sum();
        println!(
            "{}: {torque:.4} Nm, Y phi = {product:.4} Nm",
            model.dof_name(dof)
        );
        assert!((product - torque).abs() < 1e-9, "torque = Y phi");
    }
    let regime = Regime::fixed(&model, 0, &gravity);
    let seen = Identifiable::new(
        &model,
        Scope::Tree,
        &regime,
        Measurement::Torques,
        Offsets::Known,
    )?;
    seen.base_parameters()
        .iter()
        .for_each(|base_parameter| println!("{base_parameter}"));
    Ok(())
}
