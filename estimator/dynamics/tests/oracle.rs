//! Comparison of whole robots with MuJoCo, Pinocchio and iDynTree: inverse dynamics, regressors,
//! the equation of motion, and contact wrenches from F/T readings.
//!
//! The contents, order and axes of the golden files: `tests/oracle/README.md`. The tolerance is
//! 1e-9 of the largest magnitude, which is separate for the forces and torques of wrenches.

mod common;

use std::path::{Path, PathBuf};

use common::{State, gap, mass_matrix, parameters};
use nalgebra::DVector;
use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::regressor::{EstimateRows, Regressor, StackedRegressor};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, Determinacy, ExternalWrench, FrameMotion,
    InverseDynamics, Kinematics, Noise, SensorCut, Solver, Structure,
};
use serde_json::Value as Json;

const NEAR: f64 = 1e-9;

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/oracle")
}

fn json(file: &Path) -> Json {
    let text = std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    serde_json::from_str(&text).unwrap()
}

fn golden(name: &str) -> Json {
    json(&folder().join(name))
}

/// A robot and the results of the libraries for it.
struct Robot {
    name: &'static str,
    /// With its F/T joints kept.
    model: Model,
    equation: Json,
    contacts: Json,
    /// Expected numbers: cases for the equation of motion, bases among them, sub-trees, contact
    /// scenarios.
    counts: [usize; 4],
}

impl Robot {
    fn new(
        name: &'static str,
        urdf: &Path,
        equation: Json,
        contacts: Json,
        counts: [usize; 4],
    ) -> Self {
        let text =
            std::fs::read_to_string(urdf).unwrap_or_else(|e| panic!("{}: {e}", urdf.display()));
        let elements = Model::from_urdf(&text, &[]).unwrap().sensors().to_vec();
        let keep: Vec<&str> = elements
            .iter()
            .map(|element| element.joint.as_str())
            .collect();
        let model = Model::from_urdf(&text, &keep).unwrap();
        for golden in [&equation, &contacts] {
            // The results of the libraries are in the order of the URDF, which is that of our
            // degrees of freedom.
            let dofs: Vec<&str> = (0..model.dof_count())
                .map(|dof| model.dof_name(dof))
                .collect();
            assert_eq!(texts(&golden["joints"]), dofs);
        }
        let sensors: Vec<&str> = model
            .sensors()
            .iter()
            .map(|element| element.name.as_str())
            .collect();
        assert_eq!(texts(&contacts["sensors"]), sensors);
        Self {
            name,
            model,
            equation,
            contacts,
            counts,
        }
    }
}

/// The walker; and the iCub if its files are available, which may not be redistributed here:
/// `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf and icub_v25.json (their
/// sources: `tests/oracle/README.md`).
fn robots() -> Vec<Robot> {
    let file = "walker.urdf";
    let (equation, contacts) = (
        golden("walker_equation.json"),
        golden("walker_contacts.json"),
    );
    let walker = Robot::new(
        "walker",
        &folder().join(file),
        equation,
        contacts,
        [12, 4, 6, 7],
    );
    assert_eq!(walker.model.warnings(), &[] as &[String]);
    // At least one of each kind: a property that all sensors share could be wrong in both the test
    // and the program.
    let elements = walker.model.sensors();
    for frame in [
        MeasurementFrame::Child,
        MeasurementFrame::Parent,
        MeasurementFrame::Sensor,
    ] {
        assert!(elements.iter().any(|element| element.frame == frame));
    }
    for direction in [
        MeasurementDirection::ChildToParent,
        MeasurementDirection::ParentToChild,
    ] {
        assert!(
            elements
                .iter()
                .any(|element| element.direction == direction)
        );
    }
    let mut robots = vec![walker];
    let models = std::env::var_os("PROPRIO_ICUB_MODELS").map(PathBuf::from);
    match models.map(|folder| {
        (
            folder.join("iCubGazeboV2_5.urdf"),
            folder.join("icub_v25.json"),
        )
    }) {
        Some((urdf, golden)) if golden.exists() => {
            let golden = json(&golden);
            robots.push(Robot::new(
                "icub",
                &urdf,
                golden.clone(),
                golden,
                [6, 3, 7, 3],
            ));
        }
        _ => {
            println!("skipped: PROPRIO_ICUB_MODELS has no icub_v25.json");
        }
    }
    robots
}

fn items(value: &Json) -> &[Json] {
    value.as_array().expect("a list")
}

fn text(value: &Json) -> &str {
    value.as_str().expect("a text")
}

fn texts(value: &Json) -> Vec<&str> {
    items(value).iter().map(text).collect()
}

fn numbers(value: &Json) -> Vec<f64> {
    items(value)
        .iter()
        .map(|x| x.as_f64().expect("a number"))
        .collect()
}

fn vector(value: &[f64]) -> Vec3 {
    Vec3::from_row_slice(value)
}

fn wrench(value: &Json) -> Wrench {
    let v = numbers(value);
    assert_eq!(v.len(), 6);
    Wrench::from_parts([v[0], v[1], v[2]], [v[3], v[4], v[5]])
}

fn largest<'a>(values: impl IntoIterator<Item = &'a f64>) -> f64 {
    values
        .into_iter()
        .fold(0.0, |most, x| f64::max(most, x.abs()))
}

#[track_caller]
fn assert_near(got: &[f64], expected: &[f64], what: &str) {
    let (gap, size) = (gap(got, expected), largest(expected));
    assert!(size > 0.0, "{what}: nothing to compare");
    assert!(
        gap < NEAR * size,
        "{what}: differs by {gap:e}, largest magnitude {size:e}"
    );
}

/// Lists of wrenches: all forces on one scale, and all torques.
#[track_caller]
fn assert_wrenches(got: &[Wrench], expected: &[Wrench], what: &str) {
    let part = |list: &[Wrench], of: fn(&Wrench) -> Vec3| -> Vec<f64> {
        list.iter()
            .flat_map(|wrench| of(wrench).iter().copied().collect::<Vec<_>>())
            .collect()
    };
    for (name, of) in [
        ("forces", (|w: &Wrench| w.force) as fn(&Wrench) -> Vec3),
        ("torques", |w| w.torque),
    ] {
        assert_near(
            &part(got, of),
            &part(expected, of),
            &format!("{what}: {name}"),
        );
    }
}

/// A wrench, force first, and joint torques: each of the three kinds on its own scale.
#[track_caller]
fn assert_generalised(got: &[f64], expected: &[f64], what: &str) {
    assert_eq!(got.len(), expected.len());
    for (name, part) in [
        ("force", 0..3),
        ("torque", 3..6),
        ("joint torques", 6..got.len()),
    ] {
        assert_near(
            &got[part.clone()],
            &expected[part],
            &format!("{what}: {name}"),
        );
    }
}

fn state(case: &Json) -> State {
    State(["position", "velocity", "acceleration"].map(|what| numbers(&case[what])))
}

fn kinematics(model: &Model, base: usize, state: &State, motion: &FrameMotion) -> Kinematics {
    let mut kinematics = Kinematics::new(model, base).unwrap();
    kinematics.update(model, state.get(), motion).unwrap();
    kinematics
}

fn inverse(model: &Model, kinematics: &Kinematics, external: &[ExternalWrench]) -> InverseDynamics {
    let mut inverse = InverseDynamics::new(model);
    inverse.update(model, kinematics, external).unwrap();
    inverse
}

// ---------------------------------------------------------------- the equation of motion

/// A case of a golden file's `cases`.
struct Case<'a> {
    json: &'a Json,
    what: String,
    base: usize,
    state: State,
    motion: FrameMotion,
    kinematics: Kinematics,
    external: Vec<ExternalWrench>,
}

impl Case<'_> {
    fn numbers(&self, what: &str) -> Vec<f64> {
        numbers(&self.json[what])
    }

    fn lists(&self, what: &str) -> Vec<Vec<f64>> {
        items(&self.json[what]).iter().map(numbers).collect()
    }
}

fn equation_cases(robot: &Robot) -> Vec<Case<'_>> {
    let model = &robot.model;
    let cases: Vec<_> = items(&robot.equation["cases"])
        .iter()
        .map(|json| {
            let of_base = |what: &str| vector(&numbers(&json[format!("base_{what}")]));
            let base = model.frame(text(&json["base"])).unwrap();
            // Each base is a separate body, so its frame is that of base coordinates.
            assert_eq!(base.pose, Pose::identity());
            let (state, motion) = (
                state(json),
                FrameMotion {
                    angular_velocity: of_base("angular_velocity"),
                    angular_acceleration: of_base("angular_acceleration"),
                    proper_acceleration: of_base("proper_acceleration"),
                },
            );
            let external = json["external"]
                .as_object()
                .unwrap()
                .iter()
                .map(|(frame, value)| ExternalWrench {
                    frame: model.frame(frame).unwrap(),
                    wrench: wrench(value),
                });
            Case {
                json,
                what: format!("{} from {}", robot.name, text(&json["base"])),
                base: base.link,
                kinematics: kinematics(model, base.link, &state, &motion),
                state,
                motion,
                external: external.collect(),
            }
        })
        .collect();
    let mut bases: Vec<_> = cases.iter().map(|case| case.base).collect();
    bases.dedup();
    assert_eq!([cases.len(), bases.len()], robot.counts[..2]);
    cases
}

/// The model is that of the libraries: its bodies are named as in the golden file, and the torques
/// and the base wrench agree for any base.
#[test]
fn inverse_dynamics_from_any_base() {
    for robot in robots() {
        let model = &robot.model;
        let mut bodies = texts(&robot.equation["bodies"]);
        let mut links: Vec<&str> = (0..model.link_count())
            .map(|link| model.link_name(link))
            .collect();
        bodies.sort_unstable();
        links.sort_unstable();
        assert_eq!(bodies, links);
        for case in equation_cases(&robot) {
            let inverse = inverse(model, &case.kinematics, &case.external);
            assert_near(inverse.torque(), &case.numbers("torque"), &case.what);
            assert_wrenches(
                &[inverse.base_wrench()],
                &[wrench(&case.json["base_wrench"])],
                &case.what,
            );
        }
    }
}

/// Products with two vectors of parameters for all bases, and every number of the regressor for
/// some; columns in the libraries' order of bodies.
#[test]
fn regressor_of_any_base() {
    let mut whole = 0;
    for robot in robots() {
        let model = &robot.model;
        let link = |name: &&str| {
            (0..model.link_count())
                .find(|&link| model.link_name(link) == *name)
                .unwrap()
        };
        let links: Vec<usize> = texts(&robot.equation["bodies"]).iter().map(link).collect();
        let columns: Vec<usize> = links
            .iter()
            .flat_map(|&link| 10 * link..10 * link + 10)
            .collect();
        let reordered = |row: &[f64]| -> Vec<f64> { columns.iter().map(|&c| row[c]).collect() };
        // One object for all bases.
        let mut regressor = Regressor::new(model);
        let vectors: Vec<Vec<f64>> = items(&robot.equation["parameters"])
            .iter()
            .map(numbers)
            .collect();
        assert_eq!(vectors.len(), 2);
        let parameters = reordered(&parameters(model));
        for case in equation_cases(&robot) {
            let what = &case.what;
            regressor.update(model, &case.kinematics).unwrap();
            // Force first, as the golden file has it.
            let rows = [3, 4, 5, 0, 1, 2]
                .into_iter()
                .chain(6..6 + model.dof_count());
            let rows: Vec<Vec<f64>> = rows.map(|row| reordered(regressor.row(row))).collect();
            let times =
                |vector: &[f64]| -> Vec<f64> { rows.iter().map(|row| dot(row, vector)).collect() };
            let products = case.lists("regressor_products");
            assert_eq!(products.len(), vectors.len());
            for (vector, product) in vectors.iter().zip(products) {
                assert_generalised(&times(vector), &product, what);
            }
            // With the parameters of the robot, and without external wrenches.
            let inverse = inverse(model, &case.kinematics, &[]);
            let mut needed = inverse.base_wrench().force_first().to_vec();
            needed.extend(inverse.torque());
            assert_generalised(&times(&parameters), &needed, what);
            if case.json.get("regressor").is_some() {
                let expected = case.lists("regressor");
                assert_eq!(expected.len(), rows.len());
                // Column by column: those of masses are a hundred times larger than others.
                for column in 0..columns.len() {
                    let got: Vec<f64> = rows.iter().map(|row| row[column]).collect();
                    let expected: Vec<f64> = expected.iter().map(|row| row[column]).collect();
                    assert_near(&got, &expected, &format!("{what}, column {column}"));
                }
                whole += 1;
            }
        }
    }
    assert_eq!(whole, 2);
}

/// The mass matrix and the bias of the equation of motion, by inverse dynamics of unit
/// accelerations and of velocities alone, agree with the libraries' for any base.
#[test]
fn blocks_of_the_equation_of_motion() {
    for robot in robots() {
        let model = &robot.model;
        let size = 6 + model.dof_count();
        for case in equation_cases(&robot) {
            let what = &case.what;
            let [position, velocity, _] = case.state.0.clone();
            let slow = State([position.clone(), velocity, vec![0.0; model.dof_count()]]);
            let turning = FrameMotion {
                angular_velocity: case.motion.angular_velocity,
                ..FrameMotion::standing(&Vec3::zeros())
            };
            let slow = inverse(model, &kinematics(model, case.base, &slow, &turning), &[]);
            let mut bias = slow.base_wrench().force_first().to_vec();
            bias.extend(slow.torque());
            assert_generalised(&bias, &case.numbers("bias"), &format!("{what}: bias"));

            let mass = mass_matrix(model, case.base, &position);
            if case.json.get("mass_matrix").is_some() {
                // Its lower triangle, row by row.
                let lower = case.numbers("mass_matrix");
                assert_eq!(lower.len(), size * (size + 1) / 2);
                // Row by row, so that the mass of the trunk does not mask the inertia of a wrist.
                for (row, got) in mass.row_iter().enumerate() {
                    let at = |column: usize| {
                        let (row, column) = (row.max(column), row.min(column));
                        lower[row * (row + 1) / 2 + column]
                    };
                    let got: Vec<f64> = got.iter().copied().collect();
                    let expected: Vec<f64> = (0..size).map(at).collect();
                    assert_near(
                        &got,
                        &expected,
                        &format!("{what}: row {row} of the mass matrix"),
                    );
                }
            } else {
                let vectors = case.lists("generalised_accelerations");
                let products = case.lists("mass_matrix_products");
                assert_eq!([vectors.len(), products.len()], [2, 2]);
                for (vector, product) in vectors.iter().zip(products) {
                    let got = &mass * DVector::from_column_slice(vector);
                    assert_generalised(got.as_slice(), &product, &format!("{what}: mass matrix"));
                }
            }
        }
    }
}

// ---------------------------------------------------------------- contacts

/// All sensors of the URDF, with their frames and directions.
fn cuts(model: &Model) -> Vec<SensorCut> {
    // All different: where readings agree exactly, their weights must have no influence.
    model
        .sensors()
        .iter()
        .zip(1_u8..)
        .map(|(element, number)| {
            let noise = Noise {
                force: [0.1, 0.07 * f64::from(number), 0.2],
                torque: [0.002, 0.003 / f64::from(number), 0.001],
            };
            SensorCut::new(
                model,
                &element.joint,
                element.frame,
                element.direction,
                &element.pose,
                &noise,
            )
            .unwrap()
        })
        .collect()
}

fn contact_spec(json: &Json, model: &Model) -> ContactSpec {
    ContactSpec {
        frame: model.frame(text(&json["link"])).unwrap(),
        kind: match text(&json["kind"]) {
            "wrench" => ContactKind::Wrench,
            "force" => ContactKind::Force,
            "force_along" => ContactKind::ForceAlong(vector(&numbers(&json["direction"]))),
            other => panic!("{other}"),
        },
        position: vector(&numbers(&json["position"])),
    }
}

/// A case of a golden file's `scenarios`.
struct Touch<'a> {
    model: &'a Model,
    scenario: String,
    structure: &'a Structure,
    /// The kinematics from the IMU, from the standing link if there is one, and from a foot.
    kinematics: Vec<Kinematics>,
    readings: Vec<Wrench>,
    torque: Vec<f64>,
    /// Of the structure's contacts.
    truth: Vec<Wrench>,
    known: Vec<ExternalWrench>,
}

impl Touch<'_> {
    /// All contacts are present in all cases.
    fn present(&self) -> ContactSet {
        ContactSet::first(self.truth.len())
    }

    fn what(&self, kinematics: &Kinematics) -> String {
        format!(
            "{}, from {}",
            self.scenario,
            self.model.link_name(kinematics.base())
        )
    }

    /// Largest force or torque that a sensor reads.
    fn size(&self) -> f64 {
        largest(
            &self
                .readings
                .iter()
                .flat_map(Wrench::force_first)
                .collect::<Vec<_>>(),
        )
    }
}

/// All cases of all scenarios of all robots.
fn for_each_touch(mut check: impl FnMut(&Touch<'_>)) {
    robots()
        .iter()
        .for_each(|robot| for_each_touch_of(robot, &mut check));
}

fn for_each_touch_of(robot: &Robot, check: &mut impl FnMut(&Touch<'_>)) {
    let (model, golden) = (&robot.model, &robot.contacts);
    let [_, _, subtrees, scenarios] = robot.counts;
    let cuts = cuts(model);
    let imu = model.frame(text(&golden["imu"])).unwrap();
    assert_eq!(items(&golden["scenarios"]).len(), scenarios);
    for scenario in items(&golden["scenarios"]) {
        let contacts: Vec<_> = items(&scenario["contacts"])
            .iter()
            .map(|json| contact_spec(json, model))
            .collect();
        let structure = Structure::new(model, &cuts, &contacts, Structure::LENGTH_SCALE).unwrap();
        assert_eq!(structure.subtrees().len(), subtrees);
        let known_at: Vec<Frame> = scenario.get("known").map_or(vec![], |known| {
            items(known)
                .iter()
                .map(|json| model.frame(text(&json["link"])).unwrap())
                .collect()
        });
        assert!(items(&scenario["cases"]).len() >= 2);
        for case in items(&scenario["cases"]) {
            let state = state(case);
            let felt = numbers(&case["imu"]);
            let measured = FrameMotion {
                proper_acceleration: vector(&felt[..3]),
                angular_velocity: vector(&felt[3..6]),
                angular_acceleration: vector(&felt[6..]),
            };
            let from = |frame: &Frame, motion: &FrameMotion| {
                kinematics(
                    model,
                    frame.link,
                    &state,
                    &FrameMotion::of_link_from_imu(motion, &frame.pose),
                )
            };
            let from_imu = from(&imu, &measured);
            let foot = model.frame("r_foot").unwrap();
            let mut starts = vec![from(&foot, &from_imu.frame_motion(&foot)), from_imu];
            if text(&scenario["base"]["kind"]) == "fixed" {
                let gravity = vector(&numbers(&scenario["base"]["gravity"]));
                let frame = model.frame(text(&scenario["base"]["link"])).unwrap();
                starts.push(from(&frame, &FrameMotion::standing(&gravity)));
            }
            let wrenches = |what: &str| items(&case[what]).iter().map(wrench).collect::<Vec<_>>();
            check(&Touch {
                model,
                scenario: format!("{}: {}", robot.name, text(&scenario["name"])),
                structure: &structure,
                kinematics: starts,
                readings: wrenches("readings"),
                torque: numbers(&case["torque"]),
                truth: wrenches("contacts"),
                known: known_at
                    .iter()
                    .zip(wrenches("known"))
                    .map(|(frame, wrench)| ExternalWrench {
                        frame: *frame,
                        wrench,
                    })
                    .collect(),
            });
        }
    }
}

/// Readings are predicted from the true wrenches.
#[test]
fn readings_from_contacts() {
    for_each_touch(|touch| {
        let model = touch.model;
        let specs = touch.structure.contacts().iter().zip(&touch.truth);
        let mut acting = touch.known.clone();
        acting.extend(specs.map(|(spec, wrench)| common::external(spec, *wrench)));
        for kinematics in &touch.kinematics {
            let what = touch.what(kinematics);
            let inverse = inverse(model, kinematics, &acting);
            assert_near(inverse.torque(), &touch.torque, &what);
            for (cut, reading) in touch.structure.sensors().iter().zip(&touch.readings) {
                let predicted = cut.reading(&inverse.transmitted(kinematics, cut.joint()));
                assert_wrenches(
                    &[predicted],
                    &[*reading],
                    &format!("{what}, {}", model.joint_name(cut.joint())),
                );
            }
        }
    });
}

/// True wrenches and torques are recovered from the readings.
#[test]
fn contacts_from_readings() {
    let mut unknowns: Vec<usize> = Vec::new();
    for_each_touch(|touch| {
        let model = touch.model;
        let structure = touch.structure;
        for subtree in structure.subtrees() {
            let kinds = subtree
                .contacts
                .iter()
                .map(|contact| structure.contacts()[contact].kind);
            unknowns.push(kinds.map(|kind| kind.unknowns()).sum());
        }
        let mut solver = Solver::new(structure);
        for kinematics in &touch.kinematics {
            let what = touch.what(kinematics);
            solver
                .solve(
                    model,
                    structure,
                    kinematics,
                    &touch.readings,
                    &touch.present(),
                    &touch.known,
                )
                .unwrap();
            assert_near(solver.torque(), &touch.torque, &what);
            let certainties = solver.torque_certainty().iter().copied();
            let contacts = solver.contacts().iter();
            assert!(
                certainties
                    .chain(contacts.map(|contact| contact.certainty))
                    .all(|certainty| certainty == Determinacy::Determined),
                "{what}"
            );
            let found: Vec<_> = solver
                .contacts()
                .iter()
                .map(|contact| contact.wrench)
                .collect();
            if !found.is_empty() {
                assert_wrenches(&found, &touch.truth, &what);
            }
            // The readings are consistent: the residual is zero where there are fewer unknowns than
            // equations.
            for balance in solver.balances() {
                assert!(
                    largest(&balance.residual.force_first()) < NEAR * touch.size(),
                    "{what}"
                );
            }
        }
    });
    // From none to six in a sub-tree, and six in several ways.
    unknowns.sort_unstable();
    unknowns.dedup();
    assert_eq!(unknowns, [0, 1, 3, 4, 6]);
}

/// The six equations of each sub-tree hold for the libraries' readings and wrenches, whatever the
/// sensors' offsets; and the solver's estimates are the products of its rows with parameters,
/// offsets and readings.
#[test]
fn sub_tree_regressors_hold_for_the_readings() {
    for_each_touch(|touch| {
        let model = touch.model;
        let parameters = parameters(model);
        let structure = touch.structure;
        // Six offsets per sensor, [torque; force].
        let offsets: Vec<f64> = (0..6 * structure.sensors().len())
            .map(|i| (i as f64 * 1.7).sin() * 5.0)
            .collect();
        let raw: Vec<Wrench> = touch
            .readings
            .iter()
            .zip(offsets.chunks(6))
            .map(|(reading, o)| {
                *reading
                    + Wrench {
                        torque: vector(&o[..3]),
                        force: vector(&o[3..]),
                    }
            })
            .collect();
        let unknowns: Vec<Vec<f64>> = structure
            .contacts()
            .iter()
            .zip(&touch.truth)
            .map(|(spec, wrench)| match spec.kind {
                ContactKind::Wrench => wrench.torque.iter().chain(&wrench.force).copied().collect(),
                ContactKind::Force => wrench.force.iter().copied().collect(),
                ContactKind::ForceAlong(direction) => vec![wrench.force.dot(&direction)],
            })
            .collect();
        let fixed = [&parameters[..], &offsets].concat();
        let mut stacked = StackedRegressor::new(structure);
        let mut solver = Solver::new(structure);
        for kinematics in &touch.kinematics {
            let what = touch.what(kinematics);
            stacked
                .update(kinematics, &raw, &touch.present(), &touch.known)
                .unwrap();
            for subtree in stacked.subtrees() {
                let links = subtree.links().iter();
                let sensors = subtree.sensors();
                let contacts = subtree.contacts().iter();
                let values: Vec<f64> = links
                    .flat_map(|&link| &parameters[10 * link..10 * link + 10])
                    .chain(sensors.flat_map(|sensor| &offsets[6 * sensor..6 * sensor + 6]))
                    .chain(contacts.flat_map(|present| &unknowns[present.contact]))
                    .copied()
                    .collect();
                for (row, measured) in subtree.measured().iter().enumerate() {
                    let made = dot(subtree.row(row), &values);
                    assert!(
                        (made - measured).abs() < NEAR * touch.size(),
                        "{what}: {made}, not {measured}"
                    );
                }
            }

            solver
                .solve(
                    model,
                    structure,
                    kinematics,
                    &touch.readings,
                    &touch.present(),
                    &touch.known,
                )
                .unwrap();
            let estimates = EstimateRows::new(structure, &solver, kinematics).unwrap();
            let mut row = vec![0.0; estimates.column_count()];
            // Parameters and offsets: the estimates are free of unknowns.
            let torque: Vec<f64> = (0..model.dof_count())
                .map(|dof| {
                    estimates.torque_row(dof, &mut row).unwrap();
                    dot(&row, &fixed) + estimates.torque_measured(dof, &raw, &touch.known).unwrap()
                })
                .collect();
            assert_near(&torque, &touch.torque, &what);
        }
    });
}

#[track_caller]
fn dot(row: &[f64], values: &[f64]) -> f64 {
    assert_eq!(row.len(), values.len());
    row.iter().zip(values).map(|(a, b)| a * b).sum()
}
