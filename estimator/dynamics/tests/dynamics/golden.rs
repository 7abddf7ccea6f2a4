//! Comparison with golden files.

use super::*;
use std::path::PathBuf;

const NEAR: f64 = 1e-9;

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The arm of the golden files, with its sensor as the URDF describes it.
fn arm() -> (Model, SensorCut) {
    let model = Model::from_file(
        &folder().join("config/icub_left_arm/model.urdf"),
        &["l_arm_ft_sensor"],
    )
    .unwrap();
    assert_eq!(model.warnings(), &[] as &[String]);
    let element = model.sensors()[0].clone();
    let noise = Noise {
        force: [0.08, 0.09, 0.18],
        torque: [0.002, 0.003, 0.0015],
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
    (model, cut)
}

/// Columns of a log by name, and its rows.
struct Log(Vec<String>, Vec<Vec<f64>>);

impl Log {
    fn read(name: &str) -> Self {
        let mut reader = csv::Reader::from_path(folder().join("tests/oracle").join(name)).unwrap();
        let names = reader
            .headers()
            .unwrap()
            .iter()
            .map(str::to_owned)
            .collect();
        let rows = reader
            .records()
            .map(|row| {
                row.unwrap()
                    .iter()
                    .map(|cell| cell.parse().unwrap())
                    .collect()
            })
            .collect();
        Self(names, rows)
    }

    fn get<const N: usize>(&self, row: usize, columns: [&str; N]) -> [f64; N] {
        columns.map(|column| self.1[row][self.0.iter().position(|name| name == column).unwrap()])
    }

    fn wrench(&self, row: usize, name: &str) -> Wrench {
        let [f, t] = ["f", "t"].map(|kind| {
            ["x", "y", "z"].map(|axis| self.get(row, [&format!("{name}/{kind}{axis}")])[0])
        });
        Wrench::from_parts(f, t)
    }

    fn vector(&self, row: usize, name: &str) -> Vec3 {
        Vec3::from(["x", "y", "z"].map(|axis| self.get(row, [&format!("{name}{axis}")])[0]))
    }

    fn joints(&self, row: usize, model: &Model, what: &str) -> Vec<f64> {
        (0..model.dof_count())
            .map(|dof| self.get(row, [&format!("joint/{}/{what}", model.dof_name(dof))])[0])
            .collect()
    }

    /// Largest magnitude over the file, per kind of quantity, as in the limits of the golden
    /// files.
    fn largest(&self, ends: &[&str]) -> f64 {
        let wanted = |name: &str| ends.iter().any(|end| name.ends_with(end));
        let columns = self
            .0
            .iter()
            .enumerate()
            .filter(|(_, name)| wanted(name))
            .map(|(index, _)| index);
        columns
            .flat_map(|index| self.1.iter().map(move |row| row[index].abs()))
            .fold(0.0, f64::max)
    }
}

/// Both logs, from the fixed chest and from the IMU: predictions agree with MuJoCo, and the
/// torques and the contact are recovered from MuJoCo's readings.
#[test]
fn arm_on_a_fixed_chest() {
    let (model, cut) = arm();
    let chest = model.frame("chest").unwrap();
    let hand = ContactSpec {
        frame: model.frame("l_hand").unwrap(),
        kind: ContactKind::Wrench,
        position: Vec3::new(0.0, 0.0, 0.1),
    };
    let base = ContactSpec {
        frame: chest,
        kind: ContactKind::Wrench,
        position: Vec3::zeros(),
    };
    let structure = Structure::new(&model, &[cut], &[hand, base], Structure::LENGTH_SCALE).unwrap();
    let mut solver = Solver::new(&structure);
    let imu = model.frame("chest_imu_frame").unwrap();
    for (name, touched) in [
        ("icub_left_arm_mujoco.csv", false),
        ("icub_left_arm_mujoco_contact.csv", true),
    ] {
        let log = Log::read(name);
        assert_eq!(log.1.len(), 201);
        let torque_limit = NEAR * log.largest(&["/torque"]);
        let force_limit = NEAR * log.largest(&["/fx", "/fy", "/fz"]);
        let moment_limit = NEAR * log.largest(&["/tx", "/ty", "/tz"]);
        let agree = |a: &Wrench, b: &Wrench| {
            (a.force - b.force).amax() < force_limit && (a.torque - b.torque).amax() < moment_limit
        };
        for row in 0..log.1.len() {
            let state = State(
                ["position", "velocity", "acceleration"].map(|what| log.joints(row, &model, what)),
            );
            let measured = FrameMotion {
                angular_velocity: log.vector(row, "imu/chest_imu/g"),
                angular_acceleration: log.vector(row, "imu/chest_imu/al"),
                proper_acceleration: log.vector(row, "imu/chest_imu/a"),
            };
            let standing = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.80665));
            let contact = if touched {
                log.wrench(row, "contact/hand")
            } else {
                Wrench::zero()
            };
            let reading = log.wrench(row, "wrench/l_arm_ft_sensor");
            let expected = log.joints(row, &model, "torque");
            for motion in [
                standing,
                FrameMotion::of_link_from_imu(&measured, &imu.pose),
            ] {
                let kinematics = kinematics(&model, chest.link, &state, &motion);
                let acting = [ExternalWrench {
                    frame: hand.frame,
                    wrench: contact,
                }];
                let inverse = inverse(&model, &kinematics, &acting);
                assert!(
                    gap(inverse.torque(), &expected) < torque_limit,
                    "{name} {row}"
                );
                assert!(
                    agree(
                        &cut.reading(&inverse.transmitted(&kinematics, cut.joint())),
                        &reading
                    ),
                    "{name} {row}"
                );
                let felt = kinematics.frame_motion(&imu);
                assert!(
                    (felt.proper_acceleration - measured.proper_acceleration).amax() < NEAR * 10.0
                );
                solver
                    .solve(
                        &model,
                        &structure,
                        &kinematics,
                        &[reading],
                        &ContactSet::first(2),
                        &[],
                    )
                    .unwrap();
                assert!(
                    gap(solver.torque(), &expected) < torque_limit,
                    "{name} {row}"
                );
                assert!(
                    agree(&solver.contacts()[0].wrench, &contact),
                    "{name} {row}"
                );
            }
        }
    }
}

fn list(value: &serde_json::Value) -> Vec<f64> {
    value
        .as_array()
        .expect("a list")
        .iter()
        .map(|x| x.as_f64().expect("a number"))
        .collect()
}

fn vector(value: &serde_json::Value) -> Vec3 {
    Vec3::from_row_slice(&list(value))
}

fn force_first(value: &serde_json::Value) -> Wrench {
    let v = list(value);
    Wrench::from_parts([v[0], v[1], v[2]], [v[3], v[4], v[5]])
}

/// 30 random states of the arm on a moving chest, by Pinocchio.
#[test]
fn arm_on_a_moving_chest() {
    let (model, cut) = arm();
    let text =
        std::fs::read_to_string(folder().join("tests/oracle/icub_left_arm_moving_base.json"))
            .unwrap();
    let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
    let cases = golden["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 30);
    let names: Vec<_> = golden["joints"]
        .as_array()
        .unwrap()
        .iter()
        .map(|name| name.as_str().unwrap())
        .collect();
    assert_eq!(
        names,
        (0..7).map(|dof| model.dof_name(dof)).collect::<Vec<_>>(),
        "dofs are numbered as the URDF lists them"
    );
    let chest = model.frame("chest").unwrap();
    let imu = model.frame("chest_imu_frame").unwrap();
    for case in cases {
        let state = State(["position", "velocity", "acceleration"].map(|what| list(&case[what])));
        let motion_of = |prefix: &str| FrameMotion {
            angular_velocity: vector(&case[format!("{prefix}_angular_velocity")]),
            angular_acceleration: vector(&case[format!("{prefix}_angular_acceleration")]),
            proper_acceleration: vector(&case[format!("{prefix}_proper_acceleration")]),
        };
        let from_imu = FrameMotion::of_link_from_imu(&motion_of("imu"), &imu.pose);
        for motion in [motion_of("base"), from_imu] {
            let kinematics = kinematics(&model, chest.link, &state, &motion);
            let inverse = inverse(&model, &kinematics, &[]);
            let expected = list(&case["torque"]);
            assert!(gap(inverse.torque(), &expected) < NEAR * size(&expected));
            let (reading, base) = (force_first(&case["ft"]), force_first(&case["base_wrench"]));
            let got = cut.reading(&inverse.transmitted(&kinematics, cut.joint()));
            assert!(wrench_gap(&got, &reading) < NEAR * size(&reading.force_first()));
            assert!(wrench_gap(&inverse.base_wrench(), &base) < NEAR * size(&base.force_first()));
        }
    }
}

/// A whole iCub (32 joints, 6 F/T sensors, 7 sub-trees, one full wrench in each, kinematics
/// from the chest's IMU) as iDynTree solves it.
///
/// The robot's URDF may not be redistributed here, so the test runs only where it is available:
/// `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of the PyPI package
/// icub-models 3.2.0), `PROPRIO_DATA` that of the recorded logs, beside which the golden file
/// is.
#[test]
fn whole_icub_as_idyntree_has_it() {
    let (Ok(models), Ok(data)) = (
        std::env::var("PROPRIO_ICUB_MODELS"),
        std::env::var("PROPRIO_DATA"),
    ) else {
        println!(
            "skipped: PROPRIO_ICUB_MODELS and PROPRIO_DATA do not say where the robot and the \
             golden file are"
        );
        return;
    };
    let golden = PathBuf::from(data).join("../oracle/icub_v25_idyntree.json");
    let Ok(golden) = std::fs::read_to_string(&golden) else {
        println!("skipped: there is no {}", golden.display());
        return;
    };
    let golden: serde_json::Value = serde_json::from_str(&golden).unwrap();
    let names = |key: &str| -> Vec<String> {
        golden[key]
            .as_array()
            .unwrap()
            .iter()
            .map(|name| name.as_str().unwrap().to_owned())
            .collect()
    };
    let text = std::fs::read_to_string(PathBuf::from(models).join("iCubGazeboV2_5.urdf")).unwrap();
    let elements = Model::from_urdf(&text, &[]).unwrap().sensors().to_vec();
    let sensors: Vec<_> = names("ft")
        .iter()
        .map(|name| {
            elements
                .iter()
                .find(|element| element.name == *name)
                .unwrap()
                .clone()
        })
        .collect();
    let keep: Vec<&str> = sensors
        .iter()
        .map(|element| element.joint.as_str())
        .collect();
    let model = Model::from_urdf(&text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let cuts: Vec<_> = sensors
        .iter()
        .map(|s| SensorCut::new(&model, &s.joint, s.frame, s.direction, &s.pose, &noise).unwrap())
        .collect();
    assert_eq!(names("dofs").len(), model.dof_count());
    for case in golden["cases"].as_array().unwrap() {
        let contact_names: Vec<&String> = case["ext"].as_object().unwrap().keys().collect();
        let contacts: Vec<_> = contact_names
            .iter()
            .map(|name| ContactSpec {
                frame: model.frame(name).unwrap(),
                kind: ContactKind::Wrench,
                position: Vec3::zeros(),
            })
            .collect();
        let structure = Structure::new(&model, &cuts, &contacts, Structure::LENGTH_SCALE).unwrap();
        assert_eq!(structure.subtrees().len(), 7);
        let by_name = |values: &serde_json::Value| {
            let (names, values) = (names("dofs"), list(values));
            (0..model.dof_count())
                .map(|dof| values[names.iter().position(|n| n == model.dof_name(dof)).unwrap()])
                .collect::<Vec<_>>()
        };
        let state = State(["q", "dq", "ddq"].map(|what| by_name(&case[what])));
        let frame = model.frame(case["imu_frame"].as_str().unwrap()).unwrap();
        let measured = FrameMotion {
            angular_velocity: vector(&case["omega"]),
            angular_acceleration: vector(&case["alpha"]),
            proper_acceleration: vector(&case["acc"]),
        };
        let kinematics = kinematics(
            &model,
            frame.link,
            &state,
            &FrameMotion::of_link_from_imu(&measured, &frame.pose),
        );
        let readings: Vec<_> = case["ft"]
            .as_array()
            .unwrap()
            .iter()
            .map(force_first)
            .collect();
        let mut solver = Solver::new(&structure);
        solver
            .solve(
                &model,
                &structure,
                &kinematics,
                &readings,
                &ContactSet::first(contacts.len()),
                &[],
            )
            .unwrap();
        let expected = by_name(&case["tau"]);
        assert!(
            gap(solver.torque(), &expected) < NEAR * size(&expected),
            "{}",
            gap(solver.torque(), &expected)
        );
        for (contact, name) in solver.contacts().iter().zip(&contact_names) {
            let expected = force_first(&case["ext"][name.as_str()]);
            assert!(
                wrench_gap(&contact.wrench, &expected) < NEAR * 300.0,
                "{name}"
            );
        }
    }
}
