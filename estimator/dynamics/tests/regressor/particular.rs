//! Refused input, degenerate contacts, and an arm by Pinocchio.

use super::*;

#[test]
fn what_does_not_fit_is_refused_and_changes_nothing() {
    let mut random = Random::new(29);
    let scene = loop {
        let scene = Scene::new(24, &mut random);
        if scene.sensors.len() > 1 && scene.truth.len() > 2 && scene.model.dof_count() > 4 {
            break scene;
        }
    };
    let other = Scene::new(7, &mut random);
    let active = scene.all();

    let mut regressor = Regressor::new(&scene.model);
    regressor.update(&scene.model, &scene.kinematics).unwrap();
    let before = all_rows(&regressor, &scene.model);
    assert!(matches!(
        regressor.update(&other.model, &scene.kinematics),
        Err(DynamicsError::Size { .. })
    ));
    assert!(matches!(
        regressor.update(&scene.model, &other.kinematics),
        Err(DynamicsError::Size { .. })
    ));
    assert_eq!(all_rows(&regressor, &scene.model), before);
    assert_eq!(regressor.joint_row(1000), None);

    let mut stacked = scene.stacked(&active);
    let read = |stacked: &StackedRegressor| {
        let trees = stacked.subtrees().iter();
        trees
            .map(|tree| {
                (
                    columns_of(tree, 0, tree.column_count()),
                    *tree.measured(),
                    *tree.covariance(),
                    tree.projected_measured().to_vec(),
                )
            })
            .collect::<Vec<_>>()
    };
    let before = read(&stacked);
    let mut not_finite = scene.raw.clone();
    not_finite[1].force.y = f64::NAN;
    let mut infinite = scene.known.clone();
    infinite[0].wrench.torque.z = f64::INFINITY;
    let mut nowhere = scene.known.clone();
    nowhere[0].frame.link = 1000;
    let mut try_with = |kinematics, readings, external| {
        let got = stacked.update(kinematics, readings, &active, external);
        assert_eq!(read(&stacked), before);
        got.unwrap_err()
    };
    let s = &scene;
    assert!(matches!(
        try_with(&other.kinematics, &s.raw, &s.known),
        DynamicsError::Size { .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &s.raw[1..], &s.known),
        DynamicsError::Size { .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &not_finite, &s.known),
        DynamicsError::NotFinite { index: 1, .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &s.raw, &infinite),
        DynamicsError::NotFinite { index: 0, .. }
    ));
    assert!(matches!(
        try_with(&s.kinematics, &s.raw, &nowhere),
        DynamicsError::NoLink(1000)
    ));
    let mut small = vec![3.0; 5];
    let solver = scene.solve(&scene.kinematics, &scene.offsets, &active);
    assert!(EstimateRows::new(&scene.structure, &solver, &other.kinematics).is_err());
    assert!(EstimateRows::new(&other.structure, &solver, &scene.kinematics).is_err());
    // Before a solution, or after one of another base or other positions, there are no rows.
    let refused = |solver: &Solver, kinematics: &Kinematics| {
        EstimateRows::new(&scene.structure, solver, kinematics).map(|_| ())
            == Err(DynamicsError::NotSolved)
    };
    assert!(refused(&Solver::new(&scene.structure), &scene.kinematics));
    let (state, mut moved) = (
        State::new(&scene.model, &mut random),
        scene.kinematics.clone(),
    );
    moved
        .update(&scene.model, state.get(), &motion(&mut random))
        .unwrap();
    assert!(refused(&solver, &moved));
    let beta = (scene.kinematics.base() + 1) % scene.model.link_count();
    let mut elsewhere = Kinematics::new(&scene.model, beta).unwrap();
    elsewhere
        .update(
            &scene.model,
            scene.state.get(),
            scene.kinematics.motion(beta),
        )
        .unwrap();
    assert!(refused(&solver, &elsewhere));
    let rows = EstimateRows::new(&scene.structure, &solver, &scene.kinematics).unwrap();
    assert!(rows.torque_row(0, &mut small).is_err());
    assert_eq!(small, vec![3.0; 5]);
    assert_eq!(rows.torque_subtree(1000), None);
    let mut row = vec![3.0; rows.column_count()];
    assert!(matches!(
        rows.torque_row(1000, &mut row),
        Err(DynamicsError::Index { index: 1000, .. })
    ));
    assert!(row.iter().all(|&x| x == 3.0));
    assert!(rows.torque_measured(0, &scene.raw[1..], &[]).is_err());
    assert!(rows.torque_measured(0, &scene.raw, &nowhere).is_err());
    assert!(rows.torque_measured(0, &not_finite, &[]).is_err());
}

/// Degenerate sets of contacts: repeated, collinear, more than six unknowns. The number of
/// remaining rows is correct, and no result is NaN.
#[test]
fn degenerate_contacts_leave_the_right_number_of_rows() {
    let mut random = Random::new(41);
    let robot = loop {
        let robot = RandomRobot::new(12, &mut random);
        if !robot.cuts.is_empty() {
            break robot;
        }
    };
    let model = robot.model();
    let frame = Frame {
        link: model.link_count() - 1,
        pose: random.pose(),
    };
    let (a, b) = (random.vector(0.2), random.vector(0.2));
    let spec = |kind, position| ContactSpec {
        frame,
        kind,
        position,
    };
    let along = random.vector(1.0);
    use ContactKind::{Force, ForceAlong, Wrench as Full};
    for (contacts, remaining) in [
        (vec![], 6),
        (vec![spec(Full, a)], 0),
        (vec![spec(Force, a)], 3),
        (vec![spec(ForceAlong(along), a)], 5),
        // The same contact twice; two on one line; three forces at three points. The force along
        // the line between two points stays undetermined.
        (vec![spec(Force, a), spec(Force, a)], 3),
        (
            vec![
                spec(ForceAlong(along), a),
                spec(ForceAlong(-along), a + along),
            ],
            5,
        ),
        (vec![spec(Force, a), spec(Force, b)], 1),
        (vec![spec(Full, a), spec(Full, b), spec(Force, b)], 0),
    ] {
        let sensors = robot.sensors(&model, &mut random);
        let truth = contacts
            .iter()
            .map(|spec| {
                let force = match spec.kind {
                    ForceAlong(direction) => direction.normalize() * random.real(50.0),
                    _ => random.vector(50.0),
                };
                Wrench {
                    torque: spec.position.cross(&force),
                    force,
                }
            })
            .collect();
        let scene = Scene::with(model.clone(), sensors, contacts, truth, &mut random);
        let number = scene.structure.subtree_of(frame.link).unwrap();
        let stacked = scene.stacked(&scene.all());
        let tree = &stacked.subtrees()[number];
        assert_eq!(tree.remaining(), remaining);
        let unknowns = scene.known_of(tree.links(), tree.sensors());
        for row in 0..remaining {
            let scale =
                weight(tree.projected_row(row), &unknowns) + size(tree.projected_measured());
            let left = dot(tree.projected_row(row), &unknowns) - tree.projected_measured()[row];
            assert!(left.abs() < 1e-9 * scale, "{left}");
        }
    }
}

#[test]
#[should_panic(expected = "rows remain")]
fn there_are_no_rows_beyond_the_remaining_ones() {
    let mut random = Random::new(5);
    let scene = Scene::new(3, &mut random);
    let stacked = scene.stacked(&scene.all());
    let tree = &stacked.subtrees()[0];
    tree.projected_row(tree.remaining());
}

/// 30 random states of an arm on a moving chest, by Pinocchio: `Y phi` gives its base wrench and
/// torques, the arm's six rows its F/T reading.
#[test]
fn arm_on_a_moving_chest() {
    let folder = std::path::PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..");
    let model = Model::from_file(
        &folder.join("config/icub_left_arm/model.urdf"),
        &["l_arm_ft_sensor"],
    )
    .unwrap();
    let element = model.sensors()[0].clone();
    let noise = proprio_dynamics::Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let cut = SensorCut::new(
        &model,
        &element.joint,
        element.frame,
        element.direction,
        &element.pose,
        &noise,
    )
    .unwrap();
    let chest = model.frame("chest").unwrap();
    assert_eq!(chest.pose, Pose::identity());
    let base = ContactSpec {
        frame: chest,
        kind: ContactKind::Wrench,
        position: nalgebra::zero(),
    };
    let structure = Structure::new(&model, &[cut], &[base], Structure::LENGTH_SCALE).unwrap();
    let text = std::fs::read_to_string(folder.join("tests/oracle/icub_left_arm_moving_base.json"))
        .unwrap();
    let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
    let list = |value: &serde_json::Value| -> Vec<f64> {
        value
            .as_array()
            .unwrap()
            .iter()
            .map(|x| x.as_f64().unwrap())
            .collect()
    };
    let cases = golden["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 30);
    let mut regressor = Regressor::new(&model);
    let phi = parameters(&model);
    let mut stacked = StackedRegressor::new(&structure);
    let mut kinematics = Kinematics::new(&model, chest.link).unwrap();
    for case in cases {
        let state = State(["position", "velocity", "acceleration"].map(|what| list(&case[what])));
        let vector = |name: &str| nalgebra::Vector3::from_row_slice(&list(&case[name]));
        let motion = proprio_dynamics::FrameMotion {
            angular_velocity: vector("base_angular_velocity"),
            angular_acceleration: vector("base_angular_acceleration"),
            proper_acceleration: vector("base_proper_acceleration"),
        };
        kinematics.update(&model, state.get(), &motion).unwrap();
        regressor.update(&model, &kinematics).unwrap();
        let got: Vec<f64> = (0..6 + model.dof_count())
            .map(|row| dot(regressor.row(row), &phi))
            .collect();
        let (wrench, torque) = (list(&case["base_wrench"]), list(&case["torque"]));
        // The golden file has force first.
        assert!(gap(&got[..3], &wrench[3..]) < 1e-9 * size(&wrench));
        assert!(gap(&got[3..6], &wrench[..3]) < 1e-9 * size(&wrench));
        assert!(gap(&got[6..], &torque) < 1e-9 * size(&torque));

        let ft = list(&case["ft"]);
        let reading = Wrench::from_parts([ft[0], ft[1], ft[2]], [ft[3], ft[4], ft[5]]);
        stacked
            .update(&kinematics, &[reading], &ContactSet::first(1), &[])
            .unwrap();
        let arm = &stacked.subtrees()[structure.subtree_of(cut.joint() + 1).unwrap()];
        let mut unknowns: Vec<f64> = arm
            .links()
            .iter()
            .flat_map(|&link| model.inertias()[link].parameters())
            .collect();
        assert_eq!(unknowns.len(), 50);
        unknowns.extend([0.0; 6]);
        for row in 0..6 {
            assert!((dot(arm.row(row), &unknowns) - arm.measured()[row]).abs() < 1e-9 * size(&ft));
        }
        // The reading is the wrench by the child on the parent, in the child: the right side is its
        // negative.
        assert!(gap(arm.measured(), &torque_first(&-reading)) < 1e-12 * size(&ft));
    }
}
