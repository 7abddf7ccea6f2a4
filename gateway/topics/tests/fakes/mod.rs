//! An estimator and a gateway that send what a test wants, for readers under test.

use proprio_topics::ipc::{Domain, Writer, monotonic};
use proprio_topics::{
    ContactEstimate, ContactWrench, Description, Entry, EstimatorHealth, GatewayHealth, Header,
    Imu, JointState, JointTorque, Kind, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name, Nanos,
    Publisher, Quality, Reading, Reason, Residual, Role, Sample, TorqueEstimate, Wrench,
};

/// The names of a publisher's numbers.
pub(crate) fn description(
    publisher: Publisher,
    entries: &[(&str, Role, Kind, u32)],
) -> Description {
    let entries = entries.iter().map(|(name, role, kind, index)| Entry {
        name: Name::new(name).unwrap(),
        role: role.in_memory(),
        kind: kind.in_memory(),
        index: *index,
        max_silence: Nanos::from_millis(30),
        ..Entry::NONE
    });
    Description::new(publisher, entries)
}

/// The writers of an estimator; `elbow` and `wrist` are its joints, in this order.
pub(crate) struct Estimator {
    pub(crate) torques: Writer<TorqueEstimate>,
    pub(crate) contacts: Writer<ContactEstimate>,
    pub(crate) descriptions: Writer<Description>,
    pub(crate) health: Writer<EstimatorHealth>,
}

impl Estimator {
    pub(crate) fn start(domain: &Domain, epoch: u64, joints: [&str; 2]) -> Self {
        let mut this = Self {
            health: Writer::create(domain, "icub", epoch).unwrap(),
            torques: Writer::create(domain, "icub", epoch).unwrap(),
            contacts: Writer::create(domain, "icub", epoch).unwrap(),
            descriptions: Writer::create(domain, "icub", epoch).unwrap(),
        };
        let entries = [
            (joints[0], Role::Joint, Kind::Joint, 0),
            (joints[1], Role::Joint, Kind::Joint, 1),
            ("hand", Role::Contact, Kind::Wrench, 0),
            ("ft", Role::Channel, Kind::Wrench, 3),
        ];
        let description = description(Publisher::Estimator, &entries);
        this.descriptions.send(&description, monotonic()).unwrap();
        this
    }

    /// Torques of 1.5 Nm, and one that is withheld because of `ft`; a contact of 7 N.
    pub(crate) fn send(&mut self, t: Nanos, values: [f64; 2]) {
        let joint = |torque: f64| JointTorque {
            torque,
            standard_deviation: 0.1,
            valid: u32::from(torque < 2.0),
            reason: if torque < 2.0 {
                Reason::None
            } else {
                Reason::Stale
            }
            .in_memory(),
            cause: 3,
            ..JointTorque::ABSENT
        };
        let header = Header {
            acquired: t,
            ..Header::default()
        };
        let mut joints = [JointTorque::ABSENT; MAX_JOINTS];
        (joints[0], joints[1]) = (joint(values[0]), joint(values[1]));
        let torques = TorqueEstimate {
            header,
            count: 2,
            reserved: 0,
            joints,
        };
        let mut contacts = [ContactWrench::ABSENT; MAX_CONTACTS];
        contacts[0] = ContactWrench {
            force: [7.0, 7.1, 7.2],
            torque: [0.1, 0.2, 0.3],
            standard_deviation: [0.5, 0.6, 0.7, 0.8, 0.9, 1.0],
            valid: 1,
            reason: Reason::None.in_memory(),
            detected: 1,
            position: [0.25, 0.26, 0.27],
            located: 1,
            ..ContactWrench::ABSENT
        };
        let contacts = ContactEstimate {
            header,
            count: 1,
            residual_count: 0,
            contacts,
            residuals: [Residual::ABSENT; MAX_SUBTREES],
        };
        // Published long after the instant that it refers to.
        let now = monotonic();
        self.torques.send(&torques, now).unwrap();
        self.contacts.send(&contacts, now).unwrap();
        self.health.send(&EstimatorHealth::default(), now).unwrap();
        self.descriptions.update_connections().unwrap();
    }
}

/// The writers of a gateway with an encoder, a force/torque sensor and an IMU.
pub(crate) struct Gateway {
    pub(crate) samples: Writer<Sample>,
    pub(crate) descriptions: Writer<Description>,
    pub(crate) health: Writer<GatewayHealth>,
}

/// The gateway's channels.
pub(crate) const CHANNELS: [(&str, Kind); 3] = [
    ("elbow", Kind::Joint),
    ("ft", Kind::Wrench),
    ("chest", Kind::Imu),
];

impl Gateway {
    pub(crate) fn start(domain: &Domain, epoch: u64, first: u32) -> Self {
        let mut this = Self {
            health: Writer::create(domain, "icub", epoch).unwrap(),
            samples: Writer::create(domain, "icub", epoch).unwrap(),
            descriptions: Writer::create(domain, "icub", epoch).unwrap(),
        };
        this.describe(first);
        this
    }

    pub(crate) fn describe(&mut self, first: u32) {
        let entries: Vec<_> = (CHANNELS.into_iter().zip(first..))
            .map(|((name, kind), number)| (name, Role::Channel, kind, number))
            .collect();
        let description = description(Publisher::Gateway, &entries);
        self.descriptions.send(&description, monotonic()).unwrap();
    }

    pub(crate) fn send(&mut self, t: Nanos, first: u32, quality: Quality) {
        let header = Header {
            acquired: t,
            quality,
            ..Header::default()
        };
        let readings = [
            Reading::Joint(JointState {
                position: 0.25,
                velocity: 0.5,
                acceleration: 0.75,
                torque: 1.25,
                current: f64::NAN,
            }),
            Reading::Wrench(Wrench {
                force: [1.0, 2.0, 3.0],
                torque: [4.0, 5.0, 6.0],
            }),
            Reading::Imu(Imu {
                proper_acceleration: [0.1, 0.2, 9.8],
                angular_velocity: [0.3, 0.4, 0.5],
                angular_acceleration: [0.6, 0.7, 0.8],
                magnetic_field: [0.9, 1.0, 1.1],
                orientation: [0.5, -0.5, 0.5, -0.5],
            }),
            // Not the main reading of its channel.
            Reading::Temperature(proprio_topics::Temperature { celsius: 30.0 }),
        ];
        let now = monotonic();
        for (reading, number) in readings
            .iter()
            .zip([first, first + 1, first + 2, first + 1])
        {
            let sample = Sample::new(header, number, reading);
            self.samples.send(&sample, now).unwrap();
        }
        self.health.send(&GatewayHealth::new(now), now).unwrap();
        self.descriptions.update_connections().unwrap();
    }
}
