//! Compares the estimated torques with those that the joints' drives report ([`crate::drive`]). No
//! estimate depends on it.

use super::Pipeline;
use crate::drive::{Drive, Row};
use crate::history::History;
use crate::setup::Setup;
use proprio_dynamics::Dependence;
use proprio_identification::Robot;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{
    Agreement, Candidate, Code, DriveEstimate, DriveTorque, JointTorque, NO_CAUSE, Name,
    NamedCandidate, Nanos, Quality, Reason,
};

/// Time constant of the smoothed difference \[s\]: less than the half second in which a person or a
/// monitor expects to hear of it, and longer than the jitter of a drive's report.
const SMOOTHING: f64 = 0.1;

/// How many deviations the smoothed difference may have. A normal variable with one independent
/// value in each time constant exceeds it once in an hour: `erfc(z / sqrt 2) = 0.1 s / 3600 s`.
const DISAGREEMENT: f64 = 4.2;

/// A disagreement ends at half of it.
const AGREEMENT: f64 = 0.5 * DISAGREEMENT;

/// Time constant of the ratio of the two torques \[s\]: that of a motion.
const RATIO: f64 = 2.0;

/// A drive in other units explains a disagreement if this share of its mean square is in
/// proportion to the report: then what is left is within half of the difference.
const PROPORTIONAL: f64 = 0.75;

/// How many reports of a drive are kept: as many as come while an estimate waits.
const KEPT: usize = 256;

/// The drives of all joints.
pub(super) struct Drives {
    /// Per degree of freedom, if its reports are kept.
    watched: Vec<Option<Watched>>,
    estimate: DriveEstimate,
}

struct Watched {
    /// Torque and current.
    reports: History<2, KEPT>,
    /// None while it is to be identified.
    drive: Option<Drive>,
    comparison: Comparison,
}

/// The difference between both torques so far.
#[derive(Clone, Copy, Default)]
struct Comparison {
    /// The instant of the last comparison.
    last: Option<Nanos>,
    /// The smoothed difference, in deviations.
    deviate: f64,
    disagrees: bool,
    /// Smoothed squares and product of the motor's torque `m = K s` and the difference `d`: `m^2`,
    /// `m d`, `d^2`.
    moments: [f64; 3],
}

impl Comparison {
    /// Takes a motor's torque, the difference of the drive's torque to that of the F/T sensors, and
    /// the deviation of the difference.
    fn update(&mut self, t: Nanos, motor: f64, difference: f64, deviation: f64) {
        let since = self.last.map_or(f64::INFINITY, |last| (t - last).seconds());
        // After a gap, what was before does not count.
        let since = if since > RATIO { f64::INFINITY } else { since };
        let part = |constant: f64| 1.0 - (-since / constant).exp();
        if since.is_infinite() {
            *self = Self::default();
        }
        self.deviate += part(SMOOTHING) * (difference / deviation - self.deviate);
        let now = [motor * motor, motor * difference, difference * difference];
        for (moment, now) in self.moments.iter_mut().zip(now) {
            *moment += part(RATIO) * (now - *moment);
        }
        let most = if self.disagrees {
            AGREEMENT
        } else {
            DISAGREEMENT
        };
        self.disagrees = self.deviate.abs() > most;
        self.last = Some(t);
    }

    /// What the drive reports by what it should: with `r` times the report `s`, `d = (r - 1) K s`.
    fn ratio(&self) -> f64 {
        let [square, product, _] = self.moments;
        1.0 / (1.0 - product / square)
    }

    fn agreement(&self) -> Code<Agreement> {
        match self.disagrees {
            true => Agreement::Disagrees.in_memory(),
            false => Agreement::Agrees.in_memory(),
        }
    }

    /// Whether the difference is in proportion to the report.
    fn is_proportional(&self) -> bool {
        let [square, product, differences] = self.moments;
        product * product > PROPORTIONAL * square * differences
    }
}

impl Drives {
    /// None if there is nothing to compare, and nothing to learn.
    pub(super) fn new(setup: &Setup) -> Option<Box<Self>> {
        if setup.drives.is_empty() && !setup.learns_drives {
            return None;
        }
        let robot = &setup.robot;
        let watched = (0..robot.model.dof_count()).map(|dof| {
            let joint = robot.model.dof_name(dof);
            let drive = setup.drives.iter().find(|drive| drive.joint == joint);
            (drive.is_some() || setup.learns_drives).then(|| Watched {
                reports: History::default(),
                drive: drive.cloned(),
                comparison: Comparison::default(),
            })
        });
        Some(Box::new(Self {
            watched: watched.collect(),
            estimate: DriveEstimate::new(),
        }))
    }

    /// Takes the report of a joint's drive; a value that it does not report is NaN.
    pub(super) fn push(&mut self, dof: usize, t: Nanos, report: [f64; 2], quality: Quality) {
        if let Some(Some(own)) = self.watched.get_mut(dof)
            && report.iter().any(|value| value.is_finite())
            && own.reports.newest().is_none_or(|newest| t > newest)
        {
            own.reports.push(t, report, quality);
        }
    }

    /// Compares the torques of an estimate with what the drives report.
    fn compare(&mut self, at: &Instant<'_>, dependences: &[Dependence]) {
        let out = &mut self.estimate;
        (out.count, out.candidate_count) = (0, 0);
        out.header.acquired = at.t;
        let mut any_disagrees = false;
        for (joint, (dof, torque)) in at.joints().enumerate() {
            let Some(Some(own)) = self.watched.get_mut(dof) else {
                continue;
            };
            let Some(drive) = &own.drive else { continue };
            let Some(place) = out.drives.get_mut(out.count as usize) else {
                break;
            };
            out.count += 1;
            *place = DriveTorque {
                joint: u32::try_from(joint).unwrap_or(u32::MAX),
                ..DriveTorque::ABSENT
            };
            let (reason, cause) = match at.report(own) {
                Ok(report) => {
                    let [velocity, acceleration] = at.motion(dof);
                    let signal = drive.signal.of(report);
                    let (by_drive, [variance, inherited]) =
                        drive.torque(signal, velocity, acceleration);
                    place.torque = by_drive;
                    place.standard_deviation = (variance + inherited).sqrt();
                    match torque.valid {
                        1 if by_drive.is_finite() => {
                            let difference = by_drive - torque.torque;
                            let deviation = (variance + torque.standard_deviation.powi(2)).sqrt();
                            let comparison = &mut own.comparison;
                            comparison.update(
                                at.t,
                                drive.parameters[0] * signal,
                                difference,
                                deviation,
                            );
                            (place.deviate, place.ratio) = (comparison.deviate, comparison.ratio());
                            place.agreement = comparison.agreement();
                            any_disagrees |= comparison.disagrees;
                            (Reason::None, NO_CAUSE)
                        }
                        1 => (Reason::NotFinite, at.channel(dof)),
                        _ => (torque.reason.get().unwrap_or_default(), torque.cause),
                    }
                }
                Err(reason) => (reason, at.channel(dof)),
            };
            place.reason = reason.in_memory();
            place.cause = cause;
        }
        if any_disagrees {
            self.name_candidates(at, dependences);
        }
    }

    /// Names what may have caused the disagreements: for the joints of each sub-tree together, what
    /// the torques of all of them rest on. A joint that agrees clears nothing: a force may pass
    /// through its axis.
    fn name_candidates(&mut self, at: &Instant<'_>, dependences: &[Dependence]) {
        let (robot, structure) = (at.robot, &at.robot.structure);
        let out = &mut self.estimate;
        let drives = out.drives.get(..out.count as usize).unwrap_or_default();
        let subtree = |own: &DriveTorque| {
            let dof = robot.published().nth(own.joint as usize)?;
            Some((dof, structure.subtree_of(structure.link_of(dof)?)?))
        };
        let mut add = |kind: Candidate, name: &str, joint: u32| {
            if let Some(place) = out.candidates.get_mut(out.candidate_count as usize) {
                let name = Name::new(name).unwrap_or(Name::EMPTY);
                *place = NamedCandidate {
                    name,
                    kind: kind.in_memory(),
                    joint,
                };
                out.candidate_count += 1;
            }
        };
        for number in 0..structure.subtrees().len() {
            let disagreeing = || {
                let own = drives
                    .iter()
                    .filter(|own| own.agreement == Agreement::Disagrees);
                own.filter_map(subtree)
                    .filter_map(move |(dof, own)| (own == number).then_some(dof))
            };
            let Some(first) = disagreeing().next() else {
                continue;
            };
            let joint = robot.published().position(|dof| dof == first);
            let joint = joint.and_then(|joint| u32::try_from(joint).ok());
            let joint = joint.unwrap_or(u32::MAX);
            let dependence = |dof: usize| dependences.get(dof);
            let all = |is: &dyn Fn(&Dependence) -> bool| {
                disagreeing().all(|dof| dependence(dof).is_some_and(is))
            };
            let watched = |dof: usize| self.watched.get(dof)?.as_ref();
            let is_drive =
                |dof: usize| watched(dof).is_some_and(|own| own.comparison.is_proportional());
            // In other units, each of them; else one drive that differs may be at fault.
            let by_drive = disagreeing().all(is_drive);
            let mut name_drives = || {
                let names = disagreeing().map(|dof| robot.model.dof_name(dof));
                names.for_each(|name| add(Candidate::Drive, name, joint));
            };
            if by_drive {
                name_drives();
            }
            for link in structure.links_of(number) {
                let rests = |own: &Dependence| own.links.contains(link);
                if all(&rests) {
                    add(Candidate::Contact, robot.model.link_name(link), joint);
                }
            }
            for channel in &robot.channels {
                if let ChannelRole::Sensor(sensor) = channel.role
                    && all(&|own: &Dependence| own.sensors.contains(sensor))
                {
                    add(Candidate::Sensor, &channel.name, joint);
                }
            }
            if !by_drive && disagreeing().count() == 1 {
                let name = robot.model.dof_name(first);
                add(Candidate::Drive, name, joint);
            }
        }
    }
}

/// An estimate, and what it was made from.
#[derive(Clone, Copy)]
struct Instant<'a> {
    t: Nanos,
    /// Reports up to this stamp count.
    until: Nanos,
    robot: &'a Robot,
    torques: &'a [JointTorque],
    /// Per degree of freedom.
    velocity: &'a [f64],
    acceleration: &'a [f64],
}

impl<'a> Instant<'a> {
    /// The degrees of freedom of the joints, and their torques.
    fn joints(self) -> impl Iterator<Item = (usize, &'a JointTorque)> {
        self.robot.published().zip(self.torques)
    }

    fn motion(&self, dof: usize) -> [f64; 2] {
        [self.velocity, self.acceleration]
            .map(|values| values.get(dof).copied().unwrap_or(f64::NAN))
    }

    fn report(&self, own: &Watched) -> Result<[f64; 2], Reason> {
        match own.reports.at(self.t, self.until) {
            None => Err(Reason::NeverSeen),
            Some(held) if held.age > self.robot.max_silence => Err(Reason::Stale),
            Some(held) if held.quality.intersects(Quality::DRIVE_FAULT) => Err(Reason::DeviceFault),
            Some(held) => Ok(held.value),
        }
    }

    /// The channel of a joint.
    fn channel(&self, dof: usize) -> u32 {
        let mut channels = self.robot.channels.iter();
        let number = channels.position(|own| own.role == ChannelRole::Joint(dof));
        number
            .and_then(|number| u32::try_from(number).ok())
            .unwrap_or(NO_CAUSE)
    }
}

impl Pipeline {
    /// The torques of the drives at the last estimate, and whether they agree with it; none if no
    /// drive is known.
    #[must_use]
    pub fn drives(&self) -> Option<&DriveEstimate> {
        let drives = self.drives.as_ref()?;
        (!self.setup.drives.is_empty()).then_some(&drives.estimate)
    }

    /// What joints and drives do at the last estimate, per degree of freedom whose torque is valid
    /// and whose drive reports something: what a drive is identified from. Of all joints, with
    /// [`Setup::learns_drives`].
    pub fn drive_rows(&self) -> impl Iterator<Item = (usize, Row)> {
        let at = self.instant();
        let joints = at.joints().filter(|(_, torque)| torque.valid == 1);
        joints.filter_map(move |(dof, torque)| {
            let watched = self.drives.as_ref()?.watched.get(dof)?.as_ref()?;
            let [velocity, acceleration] = at.motion(dof);
            let row = Row {
                t: at.t,
                report: at.report(watched).ok()?,
                torque: torque.torque,
                deviation: torque.standard_deviation,
                velocity,
                acceleration,
            };
            Some((dof, row))
        })
    }

    /// The last estimate, as drives are compared with it.
    fn instant(&self) -> Instant<'_> {
        Instant {
            t: self.estimate.t,
            until: self.until(self.estimate.t),
            robot: &self.setup.robot,
            torques: self.estimate.torques.joints(),
            velocity: &self.velocity,
            acceleration: &self.acceleration,
        }
    }

    /// Compares the torques of the estimate at hand with those of the drives.
    pub(super) fn compare_drives(&mut self) {
        if let Some(mut drives) = self.drives.take() {
            drives.compare(&self.instant(), &self.dependences.torques);
            self.drives = Some(drives);
        }
    }
}
