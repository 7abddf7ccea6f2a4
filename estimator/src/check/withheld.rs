//! Which torques and contact wrenches would be withheld, and why: the pipeline itself is asked. It
//! gets perfect samples of the robot at rest, until its windows are full; what its last estimate
//! withholds is withheld in this posture however well all channels work.
//!
//! The cause of an uncertain torque is what makes it certain when it is taken as known: first the
//! offsets of the F/T sensors, then the URDF's inertial parameters, too.

use crate::inertial::InertialState;
use crate::pipeline::Pipeline;
use crate::setup::Setup;
use nalgebra::{Matrix6, Vector6};
use proprio_dynamics::FrameMotion;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_identification::robot::{BaseMotion, ChannelRole};
use proprio_topics::{
    ContactState, Imu, JointState, JointTorque, Nanos, Quality, Reading, Reason, Temperature,
};

/// Number of instants: more than the window of any channel has samples, and than 50 ms have, over
/// which residuals are averaged.
const INSTANTS: i64 = 128;
/// Longest time between two instants.
const PERIOD: Nanos = Nanos::from_millis(5);

/// The robot at rest in a posture.
pub(super) struct Still {
    /// Per degree of freedom \[rad or m\].
    pub(super) position: Vec<f64>,
    /// The motion of the base link.
    pub(super) base: FrameMotion,
    /// A contact that is declared to be present: that of the foot on which the robot stands.
    pub(super) declared: Option<usize>,
    /// Per F/T sensor, its reading without offset.
    pub(super) loads: Vec<Wrench>,
}

/// What would be withheld.
#[derive(Clone, Debug, Default)]
pub struct Withheld {
    /// Each reason, with the joints and contacts that it concerns: names, and in brackets the
    /// standard deviation and its bound.
    pub reasons: Vec<(String, Vec<String>)>,
    /// Of the torques that are valid, the largest standard deviation \[Nm or N\] and its joint.
    pub largest: Option<(String, f64)>,
}

impl Withheld {
    pub(super) fn of(setup: &Setup, still: &Still) -> Self {
        let now = trial(setup, still);
        let known_offsets = || {
            let mut known = setup.clone();
            known.identifies = false;
            for (_, deviation) in &mut known.robot.offsets {
                *deviation = [0.0; 6];
            }
            known
        };
        let is_uncertain = |joint: &JointTorque| joint.reason == Reason::Uncertain;
        let (mut offsets_known, mut all_known) = (Vec::new(), Vec::new());
        if now.torques.iter().any(is_uncertain) {
            offsets_known = trial(&rebuilt(known_offsets()), still).torques;
            let mut known = known_offsets();
            known.robot.urdf_relative_std = 0.0;
            all_known = trial(&rebuilt(known), still).torques;
        }
        let is_valid = |torques: &[JointTorque], dof: usize| {
            torques.get(dof).is_some_and(|joint| joint.valid == 1)
        };
        let mut this = Self::default();
        let names: Vec<&str> = setup.robot.joint_names().collect();
        for ((dof, joint), name) in now.torques.iter().enumerate().zip(&names) {
            let std = joint.standard_deviation;
            if joint.valid == 1 {
                if this.largest.as_ref().is_none_or(|(_, most)| std > *most) {
                    this.largest = Some(((*name).to_owned(), std));
                }
                continue;
            }
            let reason = joint.reason.get().unwrap_or_default();
            if reason != Reason::Uncertain {
                this.add(&format!("{}{}", reason.word(), hint(reason)), name);
                continue;
            }
            if std.is_infinite() {
                let why = "uncertain, until a few seconds of motion have shown that the setup is \
                           as configured";
                this.add(why, name);
                continue;
            }
            let why = if is_valid(&offsets_known, dof) {
                unknown_offsets(setup)
            } else if is_valid(&all_known, dof) {
                format!(
                    "because the URDF's inertial parameters are taken as known to {} % only \
                     (identification.urdf_relative_std): identify them",
                    short(100.0 * setup.robot.urdf_relative_std)
                )
            } else {
                "because of the noise of the F/T sensors and encoders".to_owned()
            };
            let most = setup.max_deviation.get(dof).copied().unwrap_or(f64::NAN);
            let name = format!("{name} (+- {}, bound {})", short(std), short(most));
            this.add(
                &format!("uncertain (output.max_torque_std_nm), {why}"),
                &name,
            );
        }
        for (contact, reason) in setup.robot.contact_names().zip(now.contacts) {
            if !matches!(reason, Reason::None | Reason::Absent) {
                let why = format!("{}{}", reason.word(), hint(reason));
                this.add(&why, &format!("contact {contact}"));
            }
        }
        this
    }

    fn add(&mut self, why: &str, name: &str) {
        match self.reasons.iter_mut().find(|(own, _)| own == why) {
            Some((_, names)) => names.push(name.to_owned()),
            None => self.reasons.push((why.to_owned(), vec![name.to_owned()])),
        }
    }
}

/// What a reason means for a robot whose channels all work.
const fn hint(reason: Reason) -> &'static str {
    match reason {
        Reason::Undetermined => ": the contacts that are present have too many unknowns",
        Reason::NoStance => ": no contact of base.foot is declared to be present",
        Reason::Unexplained => {
            ": nothing in the configuration carries the robot; add a [[contact]] where it is held"
        }
        Reason::Contradicted => {
            ": something else than configured explains the readings better; the log names it"
        }
        _ => "",
    }
}

/// Why the offsets are not known, and what to do.
fn unknown_offsets(setup: &Setup) -> String {
    let names = setup.robot.sensor_names().enumerate();
    let unknown = names.filter(|(sensor, _)| setup.known_offset(*sensor).is_none());
    let unknown: Vec<&str> = unknown.map(|(_, name)| name).collect();
    if setup.identifies {
        return format!(
            "until on-line identification has found the offset of {}: that needs motion without \
             contacts",
            unknown.join(", ")
        );
    }
    if unknown.is_empty() {
        return "because the offsets of the F/T sensors are too uncertain (offset_std_n, \
                offset_std_nm)"
            .to_owned();
    }
    format!(
        "because the offset of {} is unknown: give offset_n and offset_nm, or set enabled = true \
         in [identification]",
        unknown.join(", ")
    )
}

/// A number with three digits.
fn short(number: f64) -> String {
    significant(number, 3)
}

/// A number with so many significant digits, at most nine of them after the point.
#[must_use]
pub fn significant(number: f64, digits: u8) -> String {
    if !number.is_finite() || number == 0.0 {
        return format!("{number}");
    }
    let decimals = f64::from(digits) - 1.0 - number.abs().log10().floor();
    format!("{number:.*}", decimals.clamp(0.0, 9.0) as usize)
}

/// The setup with its parameters computed again.
fn rebuilt(mut setup: Setup) -> Setup {
    let mut state = InertialState::configured(&setup.robot);
    if let Some(parameters) = setup.initial.identified() {
        // They were applied to this robot before.
        let _ = state.apply(&setup.robot, parameters);
    }
    setup.initial = state;
    setup
}

/// The last estimate of a trial.
struct TrialEnd {
    torques: Vec<JointTorque>,
    /// Per contact.
    contacts: Vec<Reason>,
}

/// Runs the pipeline on perfect samples of the robot at rest.
fn trial(setup: &Setup, still: &Still) -> TrialEnd {
    let mut pipeline = Pipeline::new(setup.clone());
    let robot = &setup.robot;
    let readings: Vec<Reading> = (robot.channels.iter())
        .map(|channel| match channel.role {
            ChannelRole::Joint(dof) => Reading::Joint(JointState {
                position: still.position.get(dof).copied().unwrap_or(0.0),
                ..JointState::ABSENT
            }),
            ChannelRole::Sensor(sensor) => Reading::Wrench(raw(setup, still, sensor)),
            ChannelRole::Base => Reading::Imu(Imu {
                proper_acceleration: still.imu(&robot.base).into(),
                angular_velocity: [0.0; 3],
                ..Imu::ABSENT
            }),
        })
        .collect();
    if let Some(contact) = still.declared {
        pipeline.declare(contact, Nanos::ZERO, &ContactState::configured(true));
    }
    let period = Nanos((robot.max_silence.0 / 4).clamp(1, PERIOD.0));
    let mut last = TrialEnd {
        torques: Vec::new(),
        contacts: Vec::new(),
    };
    let calibrations = setup.initial.calibrations.iter().enumerate();
    let temperatures: Vec<(usize, Reading)> = calibrations
        .filter_map(|(number, calibration)| {
            let role = ChannelRole::Sensor(number);
            let channel = robot.channels.iter().position(|c| c.role == role)?;
            let celsius = calibration.reference()?;
            Some((channel, Reading::Temperature(Temperature { celsius })))
        })
        .collect();
    for instant in 0..INSTANTS {
        let t = Nanos(period.0 * (instant + 1));
        for (channel, temperature) in &temperatures {
            pipeline.push(*channel, t, temperature, Quality::GOOD);
        }
        // The trigger comes last: what waits for no one has everything.
        let others = (0..readings.len()).filter(|channel| *channel != robot.trigger);
        for channel in others.chain([robot.trigger]) {
            if let Some(reading) = readings.get(channel) {
                pipeline.push(channel, t, reading, Quality::GOOD);
            }
        }
        if instant + 1 == INSTANTS {
            pipeline.finish();
        }
        while let Some(estimate) = pipeline.poll() {
            let reason = |c: &proprio_topics::ContactWrench| c.reason.get().unwrap_or_default();
            last = TrialEnd {
                torques: estimate.torques.joints().to_vec(),
                contacts: estimate.contacts.contacts().iter().map(reason).collect(),
            };
        }
    }
    last
}

/// What sensor number `sensor` sends: its load and offset before calibration.
fn raw(setup: &Setup, still: &Still, sensor: usize) -> proprio_topics::Wrench {
    let wrench = |wrenches: &[Wrench]| wrenches.get(sensor).copied().unwrap_or(Wrench::zero());
    let corrected = wrench(&still.loads) + wrench(&setup.initial.offsets);
    let gain = setup.initial.calibrations.get(sensor).map(|c| *c.gain());
    let inverse = gain.and_then(Matrix6::try_inverse);
    let corrected = Vector6::from(corrected.torque_first());
    let [tx, ty, tz, fx, fy, fz] = inverse
        .map_or(corrected, |inverse| inverse * corrected)
        .into();
    proprio_topics::Wrench {
        force: [fx, fy, fz],
        torque: [tx, ty, tz],
    }
}

impl Still {
    /// What an IMU as base measures.
    fn imu(&self, base: &BaseMotion) -> Vec3 {
        match base {
            BaseMotion::Imu(pose) => self.base.at(pose).proper_acceleration,
            _ => self.base.proper_acceleration,
        }
    }
}
