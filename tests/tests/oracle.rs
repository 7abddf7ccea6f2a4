//! Compares `proprio estimate` on files with other libraries: for the walker of `tests/oracle`, and
//! for the iCub if its files are available. The log contains positions, velocities and
//! accelerations; the kinematics start at a standing link or an IMU. Torques and contact wrenches
//! must equal those of the golden files or, for a standing iCub, those of this project's inverse
//! dynamics, which other tests compare with the libraries.

use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{
    ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics, Noise, SensorCut,
};
use proprio_tests::Rig;
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

/// Tolerance relative to the largest magnitude of all torques, contact forces or contact torques of
/// a log.
const NEAR: f64 = 1e-9;
const WRENCH: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];
const IMU: [&str; 9] = ["ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz"];

fn oracle(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("oracle")
        .join(name)
}

fn read(file: &Path) -> Json {
    serde_json::from_str(
        &fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display())),
    )
    .unwrap()
}

fn items(value: &Json) -> &[Json] {
    value.as_array().expect("a list")
}

fn text(value: &Json) -> &str {
    value.as_str().expect("a text")
}

fn names(value: &Json) -> Vec<&str> {
    items(value).iter().map(text).collect()
}

fn numbers(value: &Json) -> Vec<f64> {
    items(value)
        .iter()
        .map(|x| x.as_f64().expect("a number"))
        .collect()
}

/// The start of the kinematics.
enum Base<'a> {
    Imu { link: &'a str },
    Fixed { link: &'a str, gravity: Vec<f64> },
}

/// A contact to estimate.
struct Contact<'a> {
    name: &'a str,
    link: &'a str,
    kind: &'a str,
    position: Vec<f64>,
    direction: Option<Vec<f64>>,
}

/// One instant: measurements and expected results.
struct Row {
    /// Per joint: position, velocity, acceleration.
    joints: Vec<[f64; 3]>,
    imu: Vec<f64>,
    /// Per F/T sensor.
    readings: Vec<Vec<f64>>,
    torque: Vec<f64>,
    /// Per contact.
    contacts: Vec<Vec<f64>>,
}

/// The parts of a robot that a run needs.
struct Robot<'a> {
    urdf: &'a Path,
    joints: Vec<&'a str>,
    /// Names and joints of the F/T sensors; frame and direction are those of the URDF's sensor
    /// elements.
    sensors: Vec<(&'a str, String)>,
}

impl<'a> Robot<'a> {
    fn new(urdf: &'a Path, joints: &'a Json, sensors: &'a Json) -> Self {
        let model = Model::from_file(urdf, &[]).unwrap();
        let joint = |name: &str| {
            model
                .sensors()
                .iter()
                .find(|s| s.name == name)
                .unwrap()
                .joint
                .clone()
        };
        Self {
            urdf,
            joints: names(joints),
            sensors: names(sensors)
                .into_iter()
                .map(|name| (name, joint(name)))
                .collect(),
        }
    }

    /// A sensor's reading without load: a different one for each.
    fn offset(&self, sensor: usize) -> Vec<f64> {
        (0..6)
            .map(|i| 0.25 * (sensor as f64 - 2.0) + 0.125 * f64::from(i))
            .collect()
    }

    fn config(&self, base: &Base<'_>, contacts: &[Contact<'_>]) -> String {
        let mut toml = format!(
            "schema = 1\nrobot = \"robot\"\nmodel = {:?}\n[base]\n",
            self.urdf
        );
        let _ = match base {
            Base::Imu { link } => writeln!(
                toml,
                "kind = \"imu\"\nsensor = \"the_imu\"\nlink = {link:?}"
            ),
            Base::Fixed { link, gravity } => {
                writeln!(
                    toml,
                    "kind = \"fixed\"\nlink = {link:?}\ngravity_mps2 = {gravity:?}"
                )
            }
        };
        for (number, (name, joint)) in self.sensors.iter().enumerate() {
            let offset = self.offset(number);
            let (force, torque) = offset.split_at(3);
            let _ = writeln!(
                toml,
                "[[force_torque]]\nsensor = {name:?}\njoint = {joint:?}\noffset_n = \
                 {force:?}\noffset_nm = {torque:?}"
            );
        }
        for contact in contacts {
            let Contact {
                name, link, kind, ..
            } = contact;
            let _ = writeln!(
                toml,
                "[[contact]]\nname = {name:?}\nlink = {link:?}\nkind = {kind:?}\nposition_m = {:?}",
                contact.position
            );
            if let Some(direction) = &contact.direction {
                let _ = writeln!(toml, "direction = {direction:?}");
            }
        }
        // Every number is compared, even if it is uncertain because of the URDF.
        toml + "[output]\nmax_torque_std_nm = 1000.0\n"
    }

    fn log(&self, rows: &[Row]) -> String {
        let mut header = vec!["t".to_owned()];
        for joint in &self.joints {
            header.extend(
                ["position", "velocity", "acceleration"]
                    .map(|what| format!("joint/{joint}/{what}")),
            );
        }
        for (sensor, _) in &self.sensors {
            header.extend(WRENCH.map(|part| format!("wrench/{sensor}/{part}")));
        }
        header.extend(IMU.map(|part| format!("imu/the_imu/{part}")));
        let mut log = header.join(",");
        for (number, row) in rows.iter().enumerate() {
            let _ = write!(log, "\n0.{number:02}");
            let readings = row
                .readings
                .iter()
                .enumerate()
                .flat_map(|(sensor, reading)| {
                    let offset = self.offset(sensor);
                    reading
                        .iter()
                        .zip(offset)
                        .map(|(r, o)| r + o)
                        .collect::<Vec<_>>()
                });
            let cells = row
                .joints
                .iter()
                .flatten()
                .copied()
                .chain(readings)
                .chain(row.imu.iter().copied());
            cells.for_each(|cell| {
                let _ = write!(log, ",{cell:?}");
            });
        }
        log + "\n"
    }

    /// Runs the program and compares all its estimates. `published` are the contacts of the
    /// configuration, by their number in a row.
    fn check(
        &self,
        what: &str,
        base: &Base<'_>,
        contacts: &[Contact<'_>],
        published: &[usize],
        rows: &[Row],
    ) {
        let rig = Rig::new();
        fs::write(rig.path("estimator.toml"), self.config(base, contacts)).unwrap();
        fs::write(rig.path("log.csv"), self.log(rows)).unwrap();
        let arguments = "estimate --config estimator.toml --log log.csv --out estimates.csv --json";
        let mut command = rig.command(&arguments.split(' ').collect::<Vec<_>>());
        let ran = command.current_dir(rig.path("")).output().unwrap();
        let (out, err) = (
            String::from_utf8_lossy(&ran.stdout),
            String::from_utf8_lossy(&ran.stderr),
        );
        assert!(ran.status.success(), "{what}: {err}");
        let report: Json = serde_json::from_str(out.trim()).unwrap();
        assert_eq!(
            (&report["estimates"], &report["torques_withheld"]),
            (&rows.len().into(), &0.into()),
            "{what}: {report}"
        );

        let estimates = table(&fs::read_to_string(rig.path("estimates.csv")).unwrap());
        let column = |name: String| {
            estimates.get(&name).unwrap_or_else(|| {
                panic!("{what}: the table has no {name}: {:?}", estimates.keys())
            })
        };
        let near = |name: &str, got: Vec<f64>, expected: Vec<f64>| {
            assert_eq!(got.len(), expected.len(), "{what}: {name}");
            let size = expected.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            for (got, expected) in got.iter().zip(&expected) {
                let close = (got - expected).abs() < NEAR * size;
                assert!(
                    close,
                    "{what}: {name}: {got}, not {expected} (largest magnitude {size})"
                );
            }
        };
        let torques = self
            .joints
            .iter()
            .flat_map(|joint| column(format!("torque/{joint}")).clone());
        let expected =
            (0..self.joints.len()).flat_map(|joint| rows.iter().map(move |row| row.torque[joint]));
        near("torque", torques.collect(), expected.collect());
        for joint in &self.joints {
            assert!(
                column(format!("valid/{joint}"))
                    .iter()
                    .all(|valid| *valid == 1.0),
                "{what}: {joint}"
            );
        }
        assert_eq!(contacts.len(), published.len());
        for (kind, parts) in [("contact forces", 0..3), ("contact torques", 3..6)] {
            let (mut got, mut expected) = (vec![], vec![]);
            for (contact, number) in contacts.iter().zip(published) {
                for part in parts.clone() {
                    got.extend(column(format!("contact/{}/{}", contact.name, WRENCH[part])));
                    expected.extend(rows.iter().map(|row| row.contacts[*number][part]));
                }
                assert!(
                    column(format!("contact/{}/valid", contact.name))
                        .iter()
                        .all(|valid| *valid == 1.0),
                    "{what}"
                );
            }
            near(kind, got, expected);
        }
    }
}

/// A table of numbers by column; text is NaN.
fn table(text: &str) -> BTreeMap<String, Vec<f64>> {
    let mut lines = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let names = lines.next().expect("a header");
    let mut columns: BTreeMap<String, Vec<f64>> =
        names.iter().map(|n| ((*n).to_owned(), vec![])).collect();
    for cells in lines {
        assert_eq!(cells.len(), names.len());
        for (name, cell) in names.iter().zip(cells) {
            columns
                .get_mut(*name)
                .unwrap()
                .push(cell.parse().unwrap_or(f64::NAN));
        }
    }
    columns
}

/// Every scenario without known wrenches (which files cannot contain): from the IMU, and, if a link
/// stands still, also from that link, with and without its support declared as a contact.
fn check_scenarios(robot: &Robot<'_>, golden: &Json) -> [usize; 3] {
    let mut runs = [0; 3];
    for scenario in items(&golden["scenarios"]) {
        if scenario.get("known").is_some() {
            continue;
        }
        let name = text(&scenario["name"]);
        let contacts = || {
            items(&scenario["contacts"])
                .iter()
                .map(|json| Contact {
                    name: text(&json["name"]),
                    link: text(&json["link"]),
                    kind: text(&json["kind"]),
                    position: numbers(&json["position"]),
                    direction: json.get("direction").map(numbers),
                })
                .collect::<Vec<_>>()
        };
        let rows: Vec<Row> = items(&scenario["cases"])
            .iter()
            .map(|case| {
                let [q, dq, ddq] =
                    ["position", "velocity", "acceleration"].map(|what| numbers(&case[what]));
                let lists = |what: &str| items(&case[what]).iter().map(numbers).collect::<Vec<_>>();
                Row {
                    joints: (0..q.len())
                        .map(|joint| [q[joint], dq[joint], ddq[joint]])
                        .collect(),
                    imu: numbers(&case["imu"]),
                    readings: lists("readings"),
                    torque: numbers(&case["torque"]),
                    contacts: lists("contacts"),
                }
            })
            .collect();
        let all: Vec<usize> = (0..contacts().len()).collect();
        let imu = Base::Imu {
            link: text(&golden["imu"]),
        };
        robot.check(
            &format!("{name}, from the IMU"),
            &imu,
            &contacts(),
            &all,
            &rows,
        );
        runs[0] += 1;
        if text(&scenario["base"]["kind"]) != "fixed" {
            continue;
        }
        let base = Base::Fixed {
            link: text(&scenario["base"]["link"]),
            gravity: numbers(&scenario["base"]["gravity"]),
        };
        robot.check(
            &format!("{name}, standing"),
            &base,
            &contacts(),
            &all,
            &rows,
        );
        runs[1] += 1;
        let closing = text(&scenario["closing"]);
        let others: Vec<usize> = all
            .iter()
            .copied()
            .filter(|number| contacts()[*number].name != closing)
            .collect();
        let declared: Vec<_> = contacts()
            .into_iter()
            .filter(|contact| contact.name != closing)
            .collect();
        assert_eq!(declared.len() + 1, all.len());
        robot.check(
            &format!("{name}, standing on nothing declared"),
            &base,
            &declared,
            &others,
            &rows,
        );
        runs[2] += 1;
    }
    runs
}

#[test]
fn the_walker_through_files() {
    let golden = read(&oracle("walker_contacts.json"));
    let urdf = oracle("walker.urdf");
    let robot = Robot::new(&urdf, &golden["joints"], &golden["sensors"]);
    assert_eq!(check_scenarios(&robot, &golden), [6, 2, 2]);
}

/// The URDF of an iCub, which may not be redistributed here: `PROPRIO_ICUB_MODELS` names the folder
/// with iCubGazeboV2_5.urdf (of the PyPI package icub-models 3.2.0).
fn icub() -> Option<PathBuf> {
    let folder = std::env::var_os("PROPRIO_ICUB_MODELS");
    if folder.is_none() {
        println!("skipped: PROPRIO_ICUB_MODELS (folder of iCubGazeboV2_5.urdf) is not set");
    }
    folder.map(|folder| Path::new(&folder).join("iCubGazeboV2_5.urdf"))
}

/// Comparison with MuJoCo, Pinocchio and iDynTree, if the golden file exists next to the URDF
/// (`tests/oracle/README.md` describes how to make it).
#[test]
fn the_icub_through_files() {
    let Some(urdf) = icub() else { return };
    let file = urdf.with_file_name("icub_v25.json");
    if !file.exists() {
        println!("skipped: there is no {}", file.display());
        return;
    }
    let golden = read(&file);
    let robot = Robot::new(&urdf, &golden["joints"], &golden["sensors"]);
    assert_eq!(check_scenarios(&robot, &golden), [3, 2, 2]);
}

/// Scenarios of a standing robot as `walker_contacts.json` has them, each with `count` random
/// states within the joints' limits: readings, torques, and the wrench at `closing` from this
/// project's own inverse dynamics.
fn made_scenarios(urdf: &Path, imu: &str, mut scenarios: Json, count: usize) -> Json {
    let elements = Model::from_file(urdf, &[]).unwrap().sensors().to_vec();
    let cut: Vec<&str> = elements
        .iter()
        .map(|element| element.joint.as_str())
        .collect();
    let model = Model::from_file(urdf, &cut).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let cuts: Vec<SensorCut> = elements
        .iter()
        .map(|e| SensorCut::new(&model, &e.joint, e.frame, e.direction, &e.pose, &noise).unwrap())
        .collect();
    let mut random = fastrand::Rng::with_seed(20_250_911);
    let mut between = move |lower: f64, upper: f64| lower + random.f64() * (upper - lower);
    for scenario in scenarios.as_array_mut().unwrap() {
        let frame = |name: &Json| model.frame(text(name)).unwrap();
        let (start, closing) = (frame(&scenario["base"]["link"]), text(&scenario["closing"]));
        let gravity = Vec3::from_row_slice(&numbers(&scenario["base"]["gravity"]));
        let mut kinematics = Kinematics::new(&model, start.link).unwrap();
        let standing = FrameMotion::of_link_from_imu(&FrameMotion::standing(&gravity), &start.pose);
        let mut inverse = InverseDynamics::new(&model);
        let cases = (0..count).map(|_| {
            let limits = |dof| model.dof_joint(dof).and_then(|joint| model.limits(joint));
            let ranges = (0..model.dof_count())
                .map(|dof| limits(dof).map_or((-3.0, 3.0), |l| (l.lower, l.upper)));
            let position: Vec<f64> = ranges.map(|(lower, upper)| between(lower, upper)).collect();
            let mut each = |size: f64| -> Vec<f64> {
                (0..model.dof_count())
                    .map(|_| between(-size, size))
                    .collect()
            };
            let (velocity, acceleration) = (each(2.0), each(10.0));
            let state = JointState {
                position: &position,
                velocity: &velocity,
                acceleration: &acceleration,
            };
            kinematics.update(&model, state, &standing).unwrap();

            let mut triple = |size: f64| Vec3::from_fn(|_, _| between(-size, size));
            let contacts = items(&scenario["contacts"]);
            let mut acting: Vec<ExternalWrench> = contacts
                .iter()
                .map(|contact| {
                    let force = triple(40.0);
                    let arm = Vec3::from_row_slice(&numbers(&contact["position"]));
                    let wrench = |force: Vec3, torque| Wrench { torque, force };
                    let wrench = match text(&contact["kind"]) {
                        "wrench" => wrench(force, triple(4.0)),
                        "force" => wrench(force, arm.cross(&force)),
                        "force_along" => {
                            let direction = Vec3::from_row_slice(&numbers(&contact["direction"]));
                            let along = direction.normalize() * force.x;
                            wrench(along, arm.cross(&along))
                        }
                        other => panic!("{other}"),
                    };
                    ExternalWrench {
                        frame: frame(&contact["link"]),
                        wrench,
                    }
                })
                .collect();
            // It stands on `closing`, which carries the remaining wrench.
            let closing = contacts
                .iter()
                .position(|c| text(&c["name"]) == closing)
                .unwrap();
            assert_eq!(acting[closing].frame, start);
            acting[closing].wrench = Wrench::zero();
            inverse.update(&model, &kinematics, &acting).unwrap();
            acting[closing].wrench = start.pose.wrench_back(&inverse.base_wrench());
            inverse.update(&model, &kinematics, &acting).unwrap();
            assert!(inverse.base_wrench().force.norm() < 1e-9);

            let felt = kinematics.frame_motion(&model.frame(imu).unwrap());
            let felt = [
                felt.proper_acceleration,
                felt.angular_velocity,
                felt.angular_acceleration,
            ];
            let readings = cuts
                .iter()
                .map(|cut| cut.reading(&inverse.transmitted(&kinematics, cut.joint())));
            let wrenches: Vec<[f64; 6]> = (acting.iter())
                .map(|acting| acting.wrench.force_first())
                .collect();
            json!({
                "position": position, "velocity": velocity, "acceleration": acceleration,
                "imu": felt.iter().flatten().collect::<Vec<_>>(),
                "readings": readings.map(|reading| reading.force_first()).collect::<Vec<_>>(),
                "torque": inverse.torque(),
                "contacts": wrenches,
            })
        });
        let cases: Vec<Json> = cases.collect();
        scenario["cases"] = Json::Array(cases);
    }
    let names = (0..model.dof_count())
        .map(|dof| model.dof_name(dof))
        .collect::<Vec<_>>();
    let sensors: Vec<&str> = elements
        .iter()
        .map(|element| element.name.as_str())
        .collect();
    json!({ "imu": imu, "joints": names, "sensors": sensors, "scenarios": scenarios })
}

/// Tests a standing iCub with kinematics from a fixed base, through files, with this project's
/// inverse dynamics as reference, because only the URDF is available.
/// [`the_icub_through_files_as_others_have_it`] compares the library with others for this robot,
/// with kinematics from an IMU.
#[test]
fn a_standing_icub_through_files() {
    let Some(urdf) = icub() else { return };
    let contact = |name: &str, link: &str| {
        json!({
            "name": name, "link": link, "kind": "wrench", "position": [0.0, 0.0, 0.0],
        })
    };
    let scenarios = json!([
        {
            "name": "root held, every limb touched", "closing": "root",
            "base": { "kind": "fixed", "link": "root_link", "gravity": [0.6, -1.1, -9.7] },
            "contacts": [
                contact("root", "root_link"),
                contact("left hand", "l_hand"), contact("right hand", "r_hand"),
                contact("left foot", "l_foot"), contact("right foot", "r_foot"),
                contact("left thigh", "l_upper_leg"), contact("right thigh", "r_upper_leg"),
            ],
        },
        {
            "name": "standing on the left sole", "closing": "sole",
            "base": { "kind": "fixed", "link": "l_sole", "gravity": [0.1, 0.2, -9.8] },
            "contacts": [
                contact("sole", "l_sole"),
                {
                    "name": "left hand", "link": "l_hand", "kind": "force",
                    "position": [0.05, 0.01, 0.02],
                },
                {
                    "name": "elbow", "link": "r_elbow_1", "kind": "force_along",
                    "position": [0.0, 0.02, 0.0], "direction": [0.2, 1.0, -0.3],
                },
            ],
        },
    ]);
    let made = made_scenarios(&urdf, "chest", scenarios, 4);
    let robot = Robot::new(&urdf, &made["joints"], &made["sensors"]);
    assert_eq!(check_scenarios(&robot, &made), [2, 2, 2]);
}

/// Golden values of iDynTree that this repository's generator does not make. `PROPRIO_DATA` names
/// the folder of the recorded logs; the golden values are next to it.
#[test]
fn the_icub_through_files_as_others_have_it() {
    let (Some(urdf), Ok(data)) = (icub(), std::env::var("PROPRIO_DATA")) else {
        println!("skipped: PROPRIO_DATA (folder next to the golden file) is not set");
        return;
    };
    let file = PathBuf::from(data).join("../oracle/icub_v25_idyntree.json");
    if !file.exists() {
        println!("skipped: there is no {}", file.display());
        return;
    }
    let golden = read(&file);
    let robot = Robot::new(&urdf, &golden["dofs"], &golden["ft"]);
    let cases = items(&golden["cases"]);
    let ends: Vec<&str> = cases[0]["ext"]
        .as_object()
        .unwrap()
        .keys()
        .map(String::as_str)
        .collect();
    let contacts: Vec<_> = ends
        .iter()
        .map(|link| Contact {
            name: link,
            link,
            kind: "wrench",
            position: vec![0.0; 3],
            direction: None,
        })
        .collect();
    let rows: Vec<Row> = cases
        .iter()
        .map(|case| {
            let [q, dq, ddq] = ["q", "dq", "ddq"].map(|what| numbers(&case[what]));
            Row {
                joints: (0..q.len())
                    .map(|joint| [q[joint], dq[joint], ddq[joint]])
                    .collect(),
                imu: ["acc", "omega", "alpha"]
                    .iter()
                    .flat_map(|what| numbers(&case[what]))
                    .collect(),
                readings: items(&case["ft"]).iter().map(numbers).collect(),
                torque: numbers(&case["tau"]),
                contacts: ends
                    .iter()
                    .map(|link| numbers(&case["ext"][*link]))
                    .collect(),
            }
        })
        .collect();
    assert_eq!(rows.len(), 6);
    let base = Base::Imu {
        link: text(&cases[0]["imu_frame"]),
    };
    robot.check("iCub", &base, &contacts, &[0, 1, 2, 3, 4, 5, 6], &rows);
}
