//! The equation of motion's blocks and Jacobians as identities with inverse dynamics, energies and
//! finite differences, on random robots of 1 to 40 links with all joint types, rooted at any link.

mod common;

use common::{Random, RandomRobot, State, gap, motion, size};
use nalgebra::{DMatrix, DVector, Matrix6};
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::spatial::{Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    DynamicsError, EquationOfMotion, ExternalWrench, FrameMotion, InverseDynamics, Kinematics,
};
use proptest::prelude::*;

const EXACT: f64 = 1e-10;
/// Error of central differences: the step is about the cube root of the rounding unit, so
/// truncation (its square) and rounding (its inverse) are both near 1e-10, multiplied by
/// derivatives for rates of some rad/s.
const DIFFERENCES: f64 = 1e-7;
const STEP: f64 = 1e-5;

fn robots() -> impl Strategy<Value = (usize, u64)> {
    (1..=40_usize, any::<u64>())
}

/// A robot in motion, seen from a random base.
struct Scene {
    model: Model,
    state: State,
    base: usize,
    motion: FrameMotion,
    random: Random,
}

impl Scene {
    fn new((links, seed): (usize, u64)) -> Self {
        let mut random = Random::new(seed);
        let model = RandomRobot::new(links, &mut random).model();
        let state = State::new(&model, &mut random);
        Self {
            base: random.below(model.link_count()),
            motion: motion(&mut random),
            model,
            state,
            random,
        }
    }

    fn dofs(&self) -> usize {
        self.model.dof_count()
    }

    fn kinematics_from(&self, base: usize, state: &State, motion: &FrameMotion) -> Kinematics {
        let mut kinematics = Kinematics::new(&self.model, base).expect("a link of the model");
        kinematics
            .update(&self.model, state.get(), motion)
            .expect("a finite state");
        kinematics
    }

    fn kinematics(&self) -> Kinematics {
        self.kinematics_from(self.base, &self.state, &self.motion)
    }

    /// The same instant after `t` seconds at constant joint velocities.
    fn kinematics_after(&self, t: f64) -> Kinematics {
        let mut state = self.state.clone();
        let [position, velocity, _] = &mut state.0;
        position
            .iter_mut()
            .zip(velocity)
            .for_each(|(q, dq)| *q += *dq * t);
        self.kinematics_from(self.base, &state, &self.motion)
    }

    fn equation(&self, kinematics: &Kinematics, gravity: &Vec3) -> EquationOfMotion {
        let mut equation = EquationOfMotion::new(&self.model);
        equation
            .update(&self.model, kinematics, gravity)
            .expect("finite numbers");
        equation
    }

    /// Twists of all links in base coordinates when the base moves with `base_twist`.
    fn twists(&self, kinematics: &Kinematics, base_twist: &Motion) -> Vec<Motion> {
        common::twists(&self.model, kinematics, &self.state.0[1], base_twist)
    }
}

fn floating(model: &Model, kinematics: &Kinematics, frame: &Frame) -> DMatrix<f64> {
    let mut jacobian = DMatrix::from_element(6, 6 + model.dof_count(), f64::NAN);
    kinematics
        .floating_jacobian(model, frame, jacobian.as_view_mut())
        .expect("a frame of the model");
    jacobian
}

fn origin(link: usize) -> Frame {
    Frame {
        link,
        pose: Pose::identity(),
    }
}

/// `[I^c F; F^T H]`.
fn full(equation: &EquationOfMotion) -> DMatrix<f64> {
    let n = equation.joint_inertia().nrows();
    let mut matrix = DMatrix::zeros(6 + n, 6 + n);
    matrix
        .view_mut((0, 0), (6, 6))
        .copy_from(&equation.composite_matrix());
    matrix
        .view_mut((0, 6), (6, n))
        .copy_from(equation.coupling());
    matrix
        .view_mut((6, 0), (n, 6))
        .copy_from(&equation.coupling().transpose());
    matrix
        .view_mut((6, 6), (n, n))
        .copy_from(equation.joint_inertia());
    matrix
}

/// `[p^c; C]`.
fn bias(equation: &EquationOfMotion) -> DVector<f64> {
    stacked(&equation.bias_wrench(), equation.bias_torque())
}

fn stacked(wrench: &Wrench, torque: &[f64]) -> DVector<f64> {
    let six = wrench.torque.iter().chain(wrench.force.iter());
    DVector::from_iterator(6 + torque.len(), six.chain(torque).copied())
}

/// `[v_b; dq]`.
fn velocities(twist: &Motion, rates: &[f64]) -> DVector<f64> {
    let six = twist.angular.iter().chain(twist.linear.iter());
    DVector::from_iterator(6 + rates.len(), six.chain(rates).copied())
}

/// A body's 6 x 6 inertia about its centre of mass, transformed to its origin: another method than
/// that of the library.
fn inertia_matrix(body: &RigidInertia) -> Matrix6<f64> {
    let centre = body.centre().expect("mass");
    let cross = centre.cross_matrix();
    let about_centre = body.inertia + cross * cross * body.mass;
    // Twist of the centre of mass from that of the origin.
    let mut shift = Matrix6::identity();
    shift.fixed_view_mut::<3, 3>(3, 0).copy_from(&-cross);
    let mut at_centre = Matrix6::from_diagonal_element(body.mass);
    at_centre
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&about_centre);
    shift.transpose() * at_centre * shift
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 120,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// Equation (3), with gravity in the base's acceleration and with gravity in the bias: both
    /// sides agree for any accelerations, velocities and external wrenches. The right side is that
    /// of the Newton-Euler recursion.
    #[test]
    fn both_sides_agree(robot in robots()) {
        let mut scene = Scene::new(robot);
        let kinematics = scene.kinematics();
        let external: Vec<_> = (0..3)
            .map(|_| ExternalWrench {
                frame: scene.random.frame(&scene.model),
                wrench: scene.random.wrench(),
            })
            .collect();
        let mut inverse = InverseDynamics::new(&scene.model);
        inverse
            .update(&scene.model, &kinematics, &external)
            .unwrap();
        let mut right = stacked(&inverse.base_wrench(), inverse.torque());
        let mut scale = size(right.as_slice());
        for ExternalWrench { frame, wrench } in &external {
            right += floating(&scene.model, &kinematics, frame).transpose() * stacked(wrench, &[]);
            scale = scale.max(size(right.as_slice()));
        }
        let gravity = scene.random.vector(9.8);
        for gravity in [Vec3::zeros(), gravity] {
            let equation = scene.equation(&kinematics, &gravity);
            prop_assert_eq!(equation.base(), scene.base);
            let a_b = Motion {
                angular: scene.motion.angular_acceleration,
                linear: scene.motion.proper_acceleration + gravity,
            };
            // As matrices, and by the method.
            let left = full(&equation) * velocities(&a_b, &scene.state.0[2]) + bias(&equation);
            prop_assert!(gap(left.as_slice(), right.as_slice()) < EXACT * scale);
            let mut torque = vec![f64::NAN; scene.dofs()];
            let wrench = equation
                .left_side(&a_b, &scene.state.0[2], &mut torque)
                .unwrap();
            prop_assert!(
                gap(stacked(&wrench, &torque).as_slice(), right.as_slice()) < EXACT * scale
            );
        }
    }

    /// The bias is inverse dynamics without accelerations; gravity moves into it from the base's
    /// acceleration.
    #[test]
    fn bias_is_inverse_dynamics_without_accelerations(robot in robots()) {
        let mut scene = Scene::new(robot);
        let gravity = scene.random.vector(9.8);
        let moving = scene.kinematics();
        let mut still = scene.state.clone();
        still.0[2].fill(0.0);
        for gravity in [Vec3::zeros(), gravity] {
            let motion = FrameMotion {
                angular_velocity: scene.motion.angular_velocity,
                ..FrameMotion::standing(&gravity)
            };
            let mut inverse = InverseDynamics::new(&scene.model);
            inverse
                .update(
                    &scene.model,
                    &scene.kinematics_from(scene.base, &still, &motion),
                    &[],
                )
                .unwrap();
            let expected = stacked(&inverse.base_wrench(), inverse.torque());
            // Accelerations in the kinematics have no influence.
            let equation = scene.equation(&moving, &gravity);
            prop_assert!(
                gap(bias(&equation).as_slice(), expected.as_slice())
                    < EXACT * size(expected.as_slice())
            );
        }
        let (proper, with_weight) = (
            scene.equation(&moving, &Vec3::zeros()),
            scene.equation(&moving, &gravity),
        );
        let upwards = Motion {
            angular: Vec3::zeros(),
            linear: -gravity,
        };
        let weight = full(&proper) * velocities(&upwards, &vec![0.0; scene.dofs()]);
        let difference = bias(&with_weight) - bias(&proper);
        prop_assert!(
            gap(difference.as_slice(), weight.as_slice())
                < EXACT * size(bias(&with_weight).as_slice())
        );
    }

    /// The inertia by its definition, sum of J^T M J over links; I^c also as the sum of the links'
    /// inertias in base coordinates. Symmetric and positive definite.
    #[test]
    fn inertia_is_the_sum_over_links(robot in robots()) {
        let scene = Scene::new(robot);
        let kinematics = scene.kinematics();
        let equation = scene.equation(&kinematics, &Vec3::zeros());
        let matrix = full(&equation);
        let mut expected = DMatrix::zeros(matrix.nrows(), matrix.ncols());
        let mut composite = RigidInertia::zero();
        for (link, body) in scene.model.inertias().iter().enumerate() {
            let jacobian = floating(&scene.model, &kinematics, &origin(link));
            expected += jacobian.transpose() * inertia_matrix(body) * jacobian;
            composite = composite + body.transformed(kinematics.pose(link));
        }
        prop_assert!(
            gap(matrix.as_slice(), expected.as_slice()) < EXACT * size(expected.as_slice())
        );
        let (got, expected) = (
            equation.composite_inertia().parameters(),
            composite.parameters(),
        );
        prop_assert!(gap(&got, &expected) < EXACT * size(&expected));
        prop_assert!(equation.joint_inertia() == &equation.joint_inertia().transpose());
        // H is a block on the diagonal, so it is definite if the whole matrix is. The matrix is
        // scaled to ones on the diagonal; otherwise hands would be compared with whole bodies.
        let root = matrix.map_diagonal(f64::sqrt);
        let scaled = DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |i, j| {
            matrix[(i, j)] / (root[i] * root[j])
        });
        prop_assert!(scaled.iter().all(|x| x.is_finite()));
        let least = scaled
            .symmetric_eigenvalues()
            .iter()
            .fold(f64::INFINITY, |least, &x| least.min(x));
        prop_assert!(least > 0.0, "{}", least);
    }

    /// 1/2 [v; dq]^T M [v; dq] is the kinetic energy of the links, each about its centre of mass;
    /// and F, I^c give the momentum of the whole robot.
    #[test]
    fn energy_and_momentum_are_those_of_the_links(robot in robots()) {
        let mut scene = Scene::new(robot);
        let kinematics = scene.kinematics();
        let equation = scene.equation(&kinematics, &Vec3::zeros());
        let base_twist = Motion {
            angular: scene.random.vector(2.0),
            linear: scene.random.vector(2.0),
        };
        let velocities = velocities(&base_twist, &scene.state.0[1]);
        let (mut energy, mut angular, mut linear) = (0.0, Vec3::zeros(), Vec3::zeros());
        for ((twist, body), link) in scene
            .twists(&kinematics, &base_twist)
            .iter()
            .zip(scene.model.inertias())
            .zip(0..)
        {
            let (pose, centre) = (kinematics.pose(link), body.centre().unwrap());
            let about_centre = body
                .transformed(&Pose {
                    translation: -centre,
                    ..Pose::identity()
                })
                .inertia;
            let in_base = pose.rotation * about_centre * pose.rotation.transpose();
            let place = pose.point(&centre);
            let velocity = twist.linear + twist.angular.cross(&place);
            energy += 0.5 * body.mass * velocity.norm_squared()
                + 0.5 * twist.angular.dot(&(in_base * twist.angular));
            linear += velocity * body.mass;
            angular += in_base * twist.angular + place.cross(&(velocity * body.mass));
        }
        let product = full(&equation) * &velocities;
        prop_assert!((0.5 * velocities.dot(&product) - energy).abs() < EXACT * energy.max(1.0));
        let momentum = stacked(
            &Wrench {
                torque: angular,
                force: linear,
            },
            &[],
        );
        prop_assert!(
            gap(&product.as_slice()[..6], momentum.as_slice()) < EXACT * size(momentum.as_slice())
        );
    }

    /// The work of the velocity bias equals that of the change of inertia: with x =
    /// [omega_b; 0; dq], x^T [p^c; C] = 1/2 x^T dM/dt x. For a base at rest that is the
    /// antisymmetry of dH/dt - 2 C(q, dq), along dq.
    #[test]
    fn bias_does_the_work_of_the_changing_inertia(robot in robots(), turning in any::<bool>()) {
        let mut scene = Scene::new(robot);
        if !turning {
            scene.motion.angular_velocity = Vec3::zeros();
        }
        let equation = scene.equation(&scene.kinematics(), &Vec3::zeros());
        let twist = Motion {
            angular: scene.motion.angular_velocity,
            linear: Vec3::zeros(),
        };
        let x = velocities(&twist, &scene.state.0[1]);
        let [before, after] = [-STEP, STEP]
            .map(|t| full(&scene.equation(&scene.kinematics_after(t), &Vec3::zeros())));
        let rate = (after - before) / (2.0 * STEP);
        let scale = x.abs().dot(&(full(&equation).abs() * x.abs())).max(1.0);
        let (work, change) = (x.dot(&bias(&equation)), 0.5 * x.dot(&(rate * &x)));
        prop_assert!(
            (work - change).abs() < DIFFERENCES * scale,
            "{} {} of {}",
            work,
            change,
            scale
        );
    }

    /// Jacobians are derivatives of the frame's pose, J dq the relative twist, X its rigid part,
    /// X^T the transform of wrenches.
    #[test]
    fn jacobians_are_derivatives_of_poses(robot in robots()) {
        let mut scene = Scene::new(robot);
        let kinematics = scene.kinematics();
        let frame = scene.random.frame(&scene.model);
        let pose_in = |kinematics: &Kinematics| *kinematics.pose(frame.link) * frame.pose;
        let x_bf = pose_in(&kinematics);
        let full = floating(&scene.model, &kinematics, &frame);
        let n = scene.dofs();
        // Written into a part of a larger matrix with any previous content.
        let mut stack = DMatrix::from_element(12, n + 2, f64::NAN);
        kinematics
            .jacobian(&scene.model, &frame, stack.view_mut((6, 1), (6, n)))
            .unwrap();
        let jacobian = stack.view((6, 1), (6, n)).into_owned();
        prop_assert_eq!(&jacobian, &full.view((0, 6), (6, n)).into_owned());
        prop_assert!(stack.rows(0, 6).iter().all(|x| x.is_nan()));
        let scale = size(jacobian.as_slice());
        for dof in 0..n {
            let [before, after] = [-STEP, STEP].map(|dq| {
                let mut state = scene.state.clone();
                state.0[0][dof] += dq;
                pose_in(&scene.kinematics_from(scene.base, &state, &scene.motion))
            });
            let turn = before.rotation.transpose() * after.rotation / (4.0 * STEP);
            let angular = Vec3::new(
                turn[(2, 1)] - turn[(1, 2)],
                turn[(0, 2)] - turn[(2, 0)],
                turn[(1, 0)] - turn[(0, 1)],
            );
            let linear =
                x_bf.rotation.transpose() * (after.translation - before.translation) / (2.0 * STEP);
            let expected = velocities(&Motion { angular, linear }, &[]);
            prop_assert!(
                gap(jacobian.column(dof).as_slice(), expected.as_slice()) < DIFFERENCES * scale
            );
        }
        let base_twist = Motion {
            angular: scene.random.vector(2.0),
            linear: scene.random.vector(2.0),
        };
        let in_base = scene.twists(&kinematics, &base_twist)[frame.link];
        let expected = x_bf.twist_back(&in_base);
        let got = &full * velocities(&base_twist, &scene.state.0[1]);
        let expected = velocities(&expected, &[]);
        prop_assert!(
            gap(got.as_slice(), expected.as_slice()) < EXACT * size(expected.as_slice()).max(scale)
        );
        let wrench = scene.random.wrench();
        let (moved, expected) = (
            full.columns(0, 6).transpose() * stacked(&wrench, &[]),
            stacked(&x_bf.wrench(&wrench), &[]),
        );
        prop_assert!(
            gap(moved.as_slice(), expected.as_slice()) < EXACT * size(expected.as_slice())
        );
    }

    /// Another base is another choice of six velocities: M_b = S^T M_c S, S = [X J; 0 1] from
    /// [v_b; dq] to [v_c; dq]. And an object whose base changes at run time has the results of a
    /// new one, to the last bit.
    #[test]
    fn bases_are_congruent(robot in robots()) {
        let mut scene = Scene::new(robot);
        let gravity = scene.random.vector(9.8);
        let mut kinematics = scene.kinematics();
        let first = scene.kinematics();
        let mut equation = EquationOfMotion::new(&scene.model);
        let expected = full(&scene.equation(&first, &Vec3::zeros()));
        for base in (0..scene.model.link_count()).rev() {
            kinematics.set_base(&scene.model, base).unwrap();
            kinematics
                .update(&scene.model, scene.state.get(), first.motion(base))
                .unwrap();
            equation
                .update(&scene.model, &kinematics, &gravity)
                .unwrap();
            let fresh = scene.equation(
                &scene.kinematics_from(base, &scene.state, first.motion(base)),
                &gravity,
            );
            prop_assert!(
                full(&fresh) == full(&equation)
                    && bias(&fresh) == bias(&equation)
                    && equation.base() == base
            );
            let jacobian = floating(&scene.model, &first, &origin(base));
            let mut s = DMatrix::identity(expected.nrows(), expected.ncols());
            s.rows_mut(0, 6).copy_from(&jacobian);
            let got = s.transpose() * full(&equation) * &s;
            let scale = size(full(&equation).as_slice()).max(size(expected.as_slice()));
            prop_assert!(
                gap(got.as_slice(), expected.as_slice())
                    < EXACT * scale * size(jacobian.as_slice())
            );
        }
    }
}

/// A pendulum that can be checked by hand: a point mass `m` at distance `l` on a hinge about y,
/// then seen from the swinging end.
#[test]
fn pendulum_has_its_textbook_terms() {
    let (m, l, q, dq) = (2.0, 0.5, 0.3, 1.5);
    let model = Model::from_urdf(
        "<robot name=\"pendulum\"><link name=\"wall\"/><link name=\"bob\"><inertial>\
         <origin xyz=\"0 0 -0.5\"/><mass value=\"2\"/>\
         <inertia ixx=\"0\" ixy=\"0\" ixz=\"0\" iyy=\"0\" iyz=\"0\" izz=\"0\"/></inertial></link>\
         <joint name=\"hinge\" type=\"continuous\"><parent link=\"wall\"/><child link=\"bob\"/>\
         <axis xyz=\"0 1 0\"/></joint></robot>",
        &[],
    )
    .unwrap();
    let state = State([vec![q], vec![dq], vec![0.0]]);
    let gravity = Vec3::new(0.0, 0.0, -9.81);
    let mut equation = EquationOfMotion::new(&model);
    // From the wall, which is at rest; and from the bob, which rotates with dq and whose axes are
    // rotated by q.
    let turned = Pose::from_xyz_rpy([0.0; 3], [0.0, q, 0.0]).rotation;
    let cases = [
        (0, Vec3::zeros(), gravity, m * l * l),
        (1, Vec3::y() * dq, turned.transpose() * gravity, 0.0),
    ];
    for (base, angular_velocity, gravity, inertia) in cases {
        let mut kinematics = Kinematics::new(&model, base).unwrap();
        let motion = FrameMotion {
            angular_velocity,
            ..FrameMotion::standing(&gravity)
        };
        kinematics.update(&model, state.get(), &motion).unwrap();
        equation.update(&model, &kinematics, &gravity).unwrap();
        // From the bob, the wall swings, and a wall without mass needs no torque.
        assert!((equation.joint_inertia()[(0, 0)] - inertia).abs() < 1e-15);
        let torque = if base == 0 {
            m * 9.81 * l * q.sin()
        } else {
            0.0
        };
        assert!((equation.bias_torque()[0] - torque).abs() < 1e-14);
        // The base must carry the weight and the centripetal force m l dq^2, which points from the
        // bob to the hinge.
        let hinge_from_bob = if base == 0 {
            turned * Vec3::z()
        } else {
            Vec3::z()
        };
        let force = -gravity * m + hinge_from_bob * (m * l * dq * dq);
        assert!((equation.bias_wrench().force - force).amax() < 1e-13);
        assert_eq!(equation.composite_inertia().mass, m);
    }
}

/// Links without mass give a joint-space inertia that is only semidefinite, and finite numbers.
#[test]
fn massless_links_are_no_trouble() {
    let mut scene = Scene::new((12, 3));
    for link in 0..scene.model.link_count() {
        if link % 2 == 0 || link > 6 {
            scene.model.set_inertia(link, RigidInertia::zero()).unwrap();
        }
    }
    for base in 0..scene.model.link_count() {
        scene.base = base;
        let equation = scene.equation(&scene.kinematics(), &Vec3::z());
        let matrix = full(&equation);
        assert!(
            matrix
                .iter()
                .chain(bias(&equation).iter())
                .all(|x| x.is_finite())
        );
        let scale = size(matrix.as_slice());
        assert!(
            matrix
                .symmetric_eigenvalues()
                .iter()
                .all(|&x| x > -EXACT * scale)
        );
    }
}

/// Invalid input is refused, and the results stay unchanged.
#[test]
fn wrong_input_is_refused_and_changes_nothing() {
    let scene = Scene::new((9, 4));
    let (other, n) = (Scene::new((30, 5)), scene.dofs());
    assert!(n > 1 && other.dofs() != n);
    let kinematics = scene.kinematics();
    let mut equation = scene.equation(&kinematics, &Vec3::z());
    let before = (full(&equation), bias(&equation));
    let size_error =
        |result: Result<(), DynamicsError>| matches!(result, Err(DynamicsError::Size { .. }));
    let rates = &scene.state.0[1];
    assert!(size_error(equation.update(
        &other.model,
        &kinematics,
        &Vec3::z()
    )));
    assert!(size_error(equation.update(
        &scene.model,
        &other.kinematics(),
        &Vec3::z()
    )));
    // The same number of links, but another number of moving joints.
    let pair = |kind| {
        let text = format!(
            "<robot name=\"pair\"><link name=\"one\"/><link name=\"two\"><inertial>\
             <mass value=\"1\"/>\
             <inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial>\
             </link>\
             <joint name=\"joint\" type=\"{kind}\"><parent link=\"one\"/><child link=\"two\"/>\
             </joint></robot>"
        );
        Model::from_urdf(&text, if kind == "fixed" { &["joint"] } else { &[] }).unwrap()
    };
    let (stiff, hinged) = (pair("fixed"), pair("continuous"));
    let mut of_pair = Kinematics::new(&stiff, 0).unwrap();
    let (turning, still) = (
        State::new(&hinged, &mut Random::new(6)),
        FrameMotion::standing(&Vec3::z()),
    );
    assert!(size_error(of_pair.update(&hinged, turning.get(), &still)));
    assert!(size_error(EquationOfMotion::new(&hinged).update(
        &hinged,
        &of_pair,
        &Vec3::z()
    )));
    let nowhere = Vec3::new(0.0, 0.0, f64::INFINITY);
    assert_eq!(
        equation.update(&scene.model, &kinematics, &nowhere),
        Err(DynamicsError::NotFinite {
            what: "gravity",
            index: 2
        })
    );
    assert_eq!(before, (full(&equation), bias(&equation)));
    let mut torque = vec![0.0; n];
    assert!(
        equation
            .left_side(&Motion::zero(), &rates[1..], &mut torque)
            .is_err()
    );
    assert!(
        equation
            .left_side(&Motion::zero(), rates, &mut torque[1..])
            .is_err()
    );

    let mut out = DMatrix::from_element(6, n + 6, 7.0);
    let frame = origin(1);
    assert!(size_error(kinematics.jacobian(
        &scene.model,
        &frame,
        out.as_view_mut()
    )));
    assert!(size_error(kinematics.floating_jacobian(
        &scene.model,
        &frame,
        out.rows_mut(0, 5)
    )));
    assert!(size_error(kinematics.floating_jacobian(
        &other.model,
        &frame,
        out.as_view_mut()
    )));
    assert_eq!(
        kinematics.floating_jacobian(&scene.model, &origin(99), out.as_view_mut()),
        Err(DynamicsError::NoLink(99))
    );
    let mut askew = frame;
    askew.pose.translation.x = f64::NAN;
    assert!(matches!(
        kinematics.floating_jacobian(&scene.model, &askew, out.as_view_mut()),
        Err(DynamicsError::NotFinite { index: 1, .. })
    ));
    assert!(out.iter().all(|&x| x == 7.0));
}
