//! Every reader of what others write, as a function of bytes. None may panic, hang or want memory
//! without bounds, whatever the bytes. `tests/fuzz.rs` gives them mutations of the seeds; with
//! `fuzz/`, a fuzzer looks for others that reach more code.

use proprio_dynamics::model::Model;
use proprio_estimator::config::{Config, Occurrence};
use proprio_estimator::parameters::{Parameters, Provenance};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_estimator::skin::TaxelMap;
use proprio_gateway::log;
use proprio_gateway::plan::Plan;
use proprio_simulator::SimulatedRobot;
use proprio_topics::{Imu, JointState, Kind, Nanos, Quality, Reading, Wrench, csv};
use std::cell::RefCell;
use std::fs;
use std::path::Path;

/// A reader.
pub struct Target {
    /// What it reads.
    pub name: &'static str,
    /// Legal input, from which mutations reach more than random bytes do.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Reads; whether it found nothing wrong.
    pub run: fn(&[u8]) -> bool,
}

/// All of them. Frames are not among them: `drivers/tests/drivers/any_frame.rs` makes those.
pub const TARGETS: &[Target] = &[
    Target {
        name: "log",
        seeds: || {
            files(&[
                "gateway/tests/log/bus.log",
                "gateway/tests/log/bus.asc",
                "gateway/tests/log/bus.trc",
                "gateway/tests/log/bus.csv",
                "gateway/tests/log/bus.blf",
                "gateway/tests/log/stored.blf",
                "gateway/tests/log/straddling.blf",
            ])
        },
        run: read_log,
    },
    Target {
        name: "table",
        seeds: || files(&["tests/oracle/icub_left_arm_mujoco.csv"]),
        run: read_table,
    },
    Target {
        name: "gateway",
        seeds: || {
            files(&[
                "config/icub_left_arm/gateway.toml",
                "config/six_axis_arm/gateway.toml",
                "config/moteus_leg/gateway.toml",
            ])
        },
        run: |bytes| Plan::parse(&text(bytes), Path::new("/nowhere")).is_ok(),
    },
    Target {
        name: "estimator",
        seeds: || {
            files(&[
                "config/icub_left_arm/estimator.toml",
                "config/six_axis_arm/estimator.toml",
                "config/moteus_leg/estimator.toml",
            ])
        },
        run: |bytes| Config::parse(&text(bytes)).is_ok(),
    },
    Target {
        name: "dbc",
        seeds: || files(&["gateway/tests/dbc/everything.dbc"]),
        run: |bytes| {
            let skin = "name = \"s\"\ndriver = \"dbc\"\n[[bus.device.reading]]\nkind = \"skin\"\n\
                        fields = { p0 = \"Intel.High\" }\nunits = { p0 = \"raw\" }";
            read_beside(bytes, "file", skin)
        },
    },
    Target {
        name: "eds",
        seeds: || {
            files(&[
                "gateway/tests/eds/drive.eds",
                "gateway/tests/eds/drive.dcf",
                "gateway/tests/eds/encoder.eds",
            ])
        },
        run: |bytes| {
            let drive = "name = \"d\"\ndriver = \"canopen_drive\"\naddress = 5\n\
                         [[bus.device.joint]]\nname = \"j\"";
            read_beside(bytes, "eds", drive)
        },
    },
    Target {
        name: "urdf",
        seeds: || {
            files(&[
                "config/icub_left_arm/model.urdf",
                "config/six_axis_arm/model.urdf",
                "config/moteus_leg/model.urdf",
            ])
        },
        run: |bytes| Model::from_urdf(&text(bytes), &[]).is_ok(),
    },
    Target {
        name: "taxels",
        seeds: || vec![b"# x y z nx ny nz\n0.01 0 0 0 0 1\n0 0.01 0 0 1 0\n".into()],
        run: |bytes| TaxelMap::parse(&text(bytes)).is_ok(),
    },
    Target {
        name: "parameters",
        seeds: || {
            let parameters = Parameters::new(&arm(|_| {}).robot, Provenance::default());
            vec![parameters.to_string().into()]
        },
        run: read_parameters,
    },
    Target {
        name: "state",
        seeds: || vec![state().into()],
        run: read_state,
    },
];

impl Target {
    /// That of a name.
    #[must_use]
    pub fn named(name: &str) -> Option<&'static Self> {
        TARGETS.iter().find(|target| target.name == name)
    }
}

/// The content of files of this repository.
fn files(names: &[&str]) -> Vec<Vec<u8>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let read = |name: &&str| fs::read(root.join(name)).expect(name);
    names.iter().map(read).collect()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The setup of the arm of this repository.
fn arm(change: impl FnOnce(&mut Config)) -> Setup {
    let folder = SimulatedRobot::find("icub_left_arm").expect("the robot of this repository");
    let mut config = Config::load(&folder.join("estimator.toml")).expect("its configuration");
    change(&mut config);
    Setup::new(&config).expect("its setup")
}

/// Records are at most as many as bytes: it ends.
fn read_log(bytes: &[u8]) -> bool {
    let mut reader = log::LogReader::new(bytes);
    let mut records = 0;
    while let Ok(Some(_)) = reader.next_record() {
        records += 1;
        assert!(records <= bytes.len(), "records of nothing");
    }
    let _ = (reader.why_empty(), reader.step_back());
    reader.bad().count() == 0 && records > 0
}

fn read_table(bytes: &[u8]) -> bool {
    let Ok(mut reader) = csv::TableReader::new(bytes) else {
        return false;
    };
    let mut rows = 0;
    let mut row = csv::Row::default();
    while let Ok(true) = reader.next_row(&mut row) {
        rows += 1;
        assert!(rows <= bytes.len(), "rows of nothing");
    }
    rows > 0
}

/// Reads a file that `key` of a device names.
fn read_beside(bytes: &[u8], key: &str, device: &str) -> bool {
    thread_local! {
        static FOLDER: tempfile::TempDir = tempfile::tempdir().expect("a folder");
    }
    FOLDER.with(|folder| {
        fs::write(folder.path().join("given"), bytes).expect("a file in a temporary folder");
        // The device's own keys come before its tables.
        let device = device.replacen('\n', &format!("\n{key} = \"given\"\n"), 1);
        let text = format!(
            "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
             source = {{ kind = \"virtual\", name = \"v\" }}\n[[bus.device]]\n{device}\n"
        );
        Plan::parse(&text, folder.path()).is_ok()
    })
}

/// What is read is written as what is read again.
fn read_parameters(bytes: &[u8]) -> bool {
    let Ok(parameters) = Parameters::parse(&text(bytes)) else {
        return false;
    };
    let again = Parameters::parse(&parameters.to_string());
    assert!(again.is_ok_and(|again| again.to_string() == parameters.to_string()));
    true
}

/// Reads a state without its checksum: whether that fits is not left to chance.
fn read_state(bytes: &[u8]) -> bool {
    thread_local! {
        static PIPELINE: RefCell<Pipeline> = RefCell::new(learning());
    }
    let body = text(bytes);
    let body = body.trim_end();
    let sum = body
        .bytes()
        .chain([b'\n'])
        .fold(0xcbf2_9ce4_8422_2325_u64, |sum, byte| {
            (sum ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        });
    PIPELINE.with(|pipeline| {
        let mut pipeline = pipeline.borrow_mut();
        let is_read = pipeline
            .resume(&format!("{body}\nsum {sum:016x}\n"))
            .is_ok();
        if is_read {
            *pipeline = learning();
        }
        is_read
    })
}

/// An estimator of the arm that identifies.
fn learning() -> Pipeline {
    Pipeline::new(arm(|config| {
        config.identification.enabled = true;
        config.contact.last_mut().expect("a contact").presence = Occurrence::Possible;
    }))
}

/// A state of the arm at rest, without its checksum.
fn state() -> String {
    let mut pipeline = learning();
    let channels: Vec<Kind> = pipeline.setup().channels().map(|(kind, _)| kind).collect();
    for step in 0..3000 {
        for (channel, kind) in channels.iter().enumerate() {
            let reading = match kind {
                Kind::Joint => Reading::Joint(JointState {
                    position: 0.1,
                    ..JointState::ABSENT
                }),
                Kind::Wrench => Reading::Wrench(Wrench {
                    force: [0.0, 0.0, 10.0],
                    torque: [0.0; 3],
                }),
                _ => Reading::Imu(Imu {
                    proper_acceleration: [0.0, 0.0, 9.8],
                    angular_velocity: [0.0; 3],
                    ..Imu::ABSENT
                }),
            };
            pipeline.push(channel, Nanos::from_millis(step), &reading, Quality::GOOD);
        }
        while pipeline.poll().is_some() {
            if let Some(job) = pipeline.take_job() {
                let state = job.state();
                return state.rsplit_once("sum ").expect("a checksum").0.to_owned();
            }
        }
    }
    panic!("no job within three seconds")
}
