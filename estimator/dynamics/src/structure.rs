//! The robot cut at its F/T sensors: sub-trees, the places where the environment may touch it, and
//! the sensors, joints and links on which each torque depends.
//!
//! Cutting the tree at `n` sensors leaves `n + 1` sub-trees. Each sub-tree must balance, which
//! gives six equations (the first six rows of eq. (3) of the paper, for a sub-tree and any base):
//!
//! ```text
//! sum of net wrenches of its links = sum of its sensors' wrenches
//!                                    + known external wrenches + unknown contact wrenches
//! ```
//!
//! They determine six unknowns at most.

mod bit_set;

pub use bit_set::{BitSet, ContactSet, DofSet, LinkSet, SensorSet};

use crate::kinematics::Kinematics;
use crate::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use crate::spatial::{Motion, Pose, Vec3, Wrench};

/// Standard deviations of the noise of an F/T sensor's six channels, in its measurement frame.
/// Channels are assumed independent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Of the force \[N\].
    pub force: [f64; 3],
    /// Of the torque \[Nm\].
    pub torque: [f64; 3],
}

/// An F/T sensor: the fixed joint where the tree is cut, and how the sensor measures the wrench
/// through it. In a moving joint the cut is on the child's side, as Gazebo, Universal Robots and
/// Kinova have it: the torque about its axis is measured too.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorCut {
    joint: usize,
    /// Measurement frame in the child, `x_cm`.
    pose: Pose,
    direction: MeasurementDirection,
    /// Variances.
    force: Vec3,
    torque: Vec3,
}

impl SensorCut {
    /// A sensor in the joint named `joint` (which the model must have kept). `pose` is the pose of
    /// the sensor in the joint's child link, `x_cs`; it is used with [`MeasurementFrame::Sensor`]
    /// only.
    ///
    /// # Errors
    /// The model has no such joint, or was read without keeping it; the parent's frame is given for
    /// a moving joint; the noise is not positive and finite; or the pose is not finite.
    pub fn new(
        model: &Model,
        joint: &str,
        frame: MeasurementFrame,
        direction: MeasurementDirection,
        pose: &Pose,
        noise: &Noise,
    ) -> Result<Self, StructureError> {
        let name = || joint.to_owned();
        let number = model.cut(joint).ok_or_else(|| match model.joint(joint) {
            Some(_) => StructureError::JointMoves(name()),
            None => StructureError::NoJoint(name()),
        })?;
        let folded = model
            .joints()
            .get(number)
            .ok_or_else(|| StructureError::NoJoint(name()))?;
        let is_moving = model.joint(joint) != Some(number);
        if noise
            .force
            .iter()
            .chain(&noise.torque)
            // The computation uses variances: they must not underflow or overflow either.
            .any(|&deviation| !(deviation > 0.0 && (deviation * deviation).is_normal()))
        {
            return Err(StructureError::Noise(name()));
        }
        if !pose.is_finite() {
            return Err(StructureError::SensorPose(name()));
        }
        let x_cm = match frame {
            // A body has the frame of the link that its joint moves, so the frame of the child link
            // is that of the body.
            MeasurementFrame::Child => Pose::identity(),
            MeasurementFrame::Parent if is_moving => {
                return Err(StructureError::ParentFrame(name()));
            }
            MeasurementFrame::Parent => {
                let parent_link = model
                    .joint_links(number)
                    .and_then(|(parent, _)| model.frame(parent));
                let x_body_link = parent_link
                    .ok_or_else(|| StructureError::NoJoint(name()))?
                    .pose;
                folded.placement.inverse() * x_body_link
            }
            MeasurementFrame::Sensor => *pose,
        };
        let square =
            |deviations: [f64; 3]| Vec3::from(deviations.map(|deviation| deviation * deviation));
        Ok(Self {
            joint: number,
            pose: x_cm,
            direction,
            force: square(noise.force),
            torque: square(noise.torque),
        })
    }

    /// Number of the joint it sits in.
    pub fn joint(&self) -> usize {
        self.joint
    }

    /// Pose of the measurement frame in the joint's child, `x_cm`.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// Standard deviations of its channels, in the measurement frame.
    pub fn noise(&self) -> Noise {
        Noise {
            force: self.force.map(f64::sqrt).into(),
            torque: self.torque.map(f64::sqrt).into(),
        }
    }

    /// What the sensor reads, without offset, when the parent exerts `wrench` on the child (at the
    /// origin and in the axes of the child).
    pub fn reading(&self, wrench: &Wrench) -> Wrench {
        self.pose.wrench_back(wrench) * self.sign()
    }

    /// The wrench that the parent exerts on the child (at the origin and in the axes of the child)
    /// when the sensor reads `reading`, offset removed.
    pub fn transmitted(&self, reading: &Wrench) -> Wrench {
        self.pose.wrench(reading) * self.sign()
    }

    /// 1 if the reading is the wrench by the parent on the child, -1 if it is its opposite.
    pub fn sign(&self) -> f64 {
        match self.direction {
            MeasurementDirection::ChildToParent => -1.0,
            MeasurementDirection::ParentToChild => 1.0,
        }
    }

    /// `Sigma m`: the covariance of the readings applied to a motion in the measurement frame.
    #[inline]
    pub(super) fn covariance_times(&self, motion: &Motion) -> Wrench {
        Wrench {
            torque: self.torque.component_mul(&motion.angular),
            force: self.force.component_mul(&motion.linear),
        }
    }
}

/// The unknown components of a contact's wrench.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ContactKind {
    /// Force and torque: six unknowns.
    Wrench,
    /// A force through the contact's position: three unknowns.
    Force,
    /// A force through the contact's position along this direction of the contact's frame: one
    /// unknown.
    ForceAlong(Vec3),
}

impl ContactKind {
    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        match self {
            Self::Wrench => 6,
            Self::Force => 3,
            Self::ForceAlong(_) => 1,
        }
    }
}

/// A place where the environment may exert an unknown wrench. A fixed base is such a contact, of
/// kind `Wrench`, and must be added by the caller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactSpec {
    /// The frame of the reported wrench: its axes, and its origin as the point of the torque.
    pub frame: Frame,
    /// What is unknown.
    pub kind: ContactKind,
    /// Position of the contact in that frame \[m\]: the point where forces act, and about which the
    /// minimum norm takes the contact's torque.
    pub position: Vec3,
}

impl ContactSpec {
    fn place(
        &mut self,
        index: usize,
        position: &Vec3,
        direction: Option<&Vec3>,
    ) -> Result<(), StructureError> {
        if !position.iter().all(|x| x.is_finite()) {
            return Err(StructureError::Contact { index });
        }
        if let (ContactKind::ForceAlong(own), Some(direction)) = (&mut self.kind, direction) {
            let norm = direction.norm();
            if !norm.is_finite() || norm < 1e-9 {
                return Err(StructureError::Direction { index });
            }
            *own = direction / norm;
        }
        self.position = *position;
        Ok(())
    }
}

/// One part of the robot between F/T sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubTree {
    /// Its link nearest to the model's root.
    pub top: usize,
    /// The F/T sensors at its ends.
    pub sensors: SensorSet,
    /// The contacts on its links.
    pub contacts: ContactSet,
}

/// The part of a sub-tree from which a joint torque is computed. The joint divides its sub-tree
/// into two sides; a side is sufficient if no unknown contact acts on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// From the side of the child: no unknown contact there.
    Child,
    /// From the side of the parent: no unknown contact there.
    Parent,
    /// From both sides, the wrench of each weighted by its inverse covariance: neither has an
    /// unknown contact, and both have sensors.
    Fused,
    /// From the solution of the whole sub-tree: unknown contacts on both sides.
    Whole,
}

/// What a torque or a contact wrench depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dependence {
    /// F/T sensors whose readings enter.
    pub sensors: SensorSet,
    /// Degrees of freedom whose measured motion enters.
    pub dofs: DofSet,
    /// Links whose inertial parameters enter.
    pub links: LinkSet,
    /// Whether the motion of the base enters: it does if the inertia of any link does.
    pub base: bool,
    /// Unknown contacts that were solved for: the value assumes that they are of the declared kind
    /// and at the declared place.
    pub contacts: ContactSet,
    /// Possible contacts that are assumed to be absent.
    pub absent: ContactSet,
}

/// Per link: its place in the tree.
#[derive(Clone, Copy, Debug)]
pub(super) struct LinkPlace {
    pub(super) parent: usize,
    pub(super) subtree: usize,
    /// One past the last link below this one: links are numbered depth first.
    pub(super) end: usize,
    /// The joint above is a cut; also true of the root.
    pub(super) is_top: bool,
    /// Contacts and sensors at links at or below this one, within its sub-tree.
    pub(super) contacts_below: ContactSet,
    pub(super) sensors_below: SensorSet,
}

/// The robot cut at its F/T sensors, with its possible contacts; shared by any number of solvers.
/// Only the places of the contacts can change ([`Structure::place_contact`]).
#[derive(Clone, Debug)]
pub struct Structure {
    sensors: Vec<SensorCut>,
    contacts: Vec<ContactSpec>,
    pub(super) places: Vec<LinkPlace>,
    subtrees: Vec<SubTree>,
    /// Per degree of freedom, the links that it moves: first that of the joint with its name.
    dof_links: Vec<Vec<usize>>,
    link_dofs: Vec<Option<usize>>,
    pub(super) length_scale: f64,
}

impl Structure {
    /// Default length that compares forces with torques in the minimum norm: 0.1 m, so that 1 N has
    /// the weight of 0.1 Nm.
    pub const LENGTH_SCALE: f64 = 0.1;

    /// Cuts a model at its sensors. `length_scale` \[m\] compares forces and torques where contacts
    /// leave more than six unknowns.
    ///
    /// # Errors
    /// [`StructureError`]: too many sensors, contacts or links; two sensors in one joint; a contact
    /// without a valid link or direction; an invalid length.
    pub fn new(
        model: &Model,
        sensors: &[SensorCut],
        contacts: &[ContactSpec],
        length_scale: f64,
    ) -> Result<Self, StructureError> {
        for (what, count, most) in [
            ("F/T sensors", sensors.len(), SensorSet::CAPACITY),
            ("contacts", contacts.len(), ContactSet::CAPACITY),
            ("links", model.link_count(), LinkSet::CAPACITY),
        ] {
            if count > most {
                return Err(StructureError::TooMany { what, count, most });
            }
        }
        if !(length_scale.is_finite() && length_scale > 0.0) {
            return Err(StructureError::LengthScale(length_scale));
        }
        let mut contacts = contacts.to_vec();
        for (index, contact) in contacts.iter_mut().enumerate() {
            if contact.frame.link >= model.link_count() || !contact.frame.pose.is_finite() {
                return Err(StructureError::Contact { index });
            }
            let (position, direction) = match contact.kind {
                ContactKind::ForceAlong(configured) => (contact.position, Some(configured)),
                ContactKind::Wrench | ContactKind::Force => (contact.position, None),
            };
            contact.place(index, &position, direction.as_ref())?;
        }
        let mut places = cut_places(model, sensors)?;
        let subtrees = subtrees(&mut places, sensors, &contacts);
        let (dof_links, link_dofs) = moved_links(model);
        Ok(Self {
            sensors: sensors.to_vec(),
            contacts,
            places,
            subtrees,
            dof_links,
            link_dofs,
            length_scale,
        })
    }

    /// The F/T sensors.
    pub fn sensors(&self) -> &[SensorCut] {
        &self.sensors
    }

    /// The contacts.
    pub fn contacts(&self) -> &[ContactSpec] {
        &self.contacts
    }

    /// Moves a contact: its position \[m\] and, for [`ContactKind::ForceAlong`], its direction (of
    /// any length; `None`: as it is), in its frame. A later solution is for this place. Does not
    /// allocate.
    ///
    /// # Errors
    /// [`StructureError`]: there is no such contact, or numbers are not finite, or the direction is
    /// zero. Nothing is changed then.
    pub fn place_contact(
        &mut self,
        index: usize,
        position: &Vec3,
        direction: Option<&Vec3>,
    ) -> Result<(), StructureError> {
        let contact = self.contacts.get_mut(index);
        contact
            .ok_or(StructureError::Contact { index })?
            .place(index, position, direction)
    }

    /// The sub-trees. The first one contains the model's root.
    pub fn subtrees(&self) -> &[SubTree] {
        &self.subtrees
    }

    /// Number of the sub-tree that a link belongs to.
    pub fn subtree_of(&self, link: usize) -> Option<usize> {
        self.places.get(link).map(|place| place.subtree)
    }

    /// Number of degrees of freedom.
    pub fn dof_count(&self) -> usize {
        self.dof_links.len()
    }

    /// Number of links.
    pub fn link_count(&self) -> usize {
        self.places.len()
    }

    /// Route of the torque of a degree of freedom while the contacts in `active` are present, at
    /// the joint with its name; `None` if there is no such degree of freedom.
    pub fn route(&self, dof: usize, active: &ContactSet) -> Option<Route> {
        self.link_of(dof).map(|link| self.route_above(link, active))
    }

    /// Route of the joint above a link.
    #[inline]
    pub(super) fn route_above(&self, link: usize, active: &ContactSet) -> Route {
        let place = &self.places[link];
        let subtree = &self.subtrees[place.subtree];
        let unknown_below = !place.contacts_below.intersection(active).is_empty();
        let unknown_above = !subtree
            .contacts
            .difference(&place.contacts_below)
            .intersection(active)
            .is_empty();
        let measured_below = !place.sensors_below.is_empty();
        let measured_above = !subtree.sensors.difference(&place.sensors_below).is_empty();
        match (unknown_below, unknown_above) {
            (true, true) => Route::Whole,
            (false, true) => Route::Child,
            (true, false) => Route::Parent,
            // A side without sensors has no noise; the other side then adds no information.
            (false, false) if measured_below && measured_above => Route::Fused,
            (false, false) if measured_below => Route::Parent,
            (false, false) => Route::Child,
        }
    }

    /// What the torque of a degree of freedom depends on, by the locality theorem, with the current
    /// base of the kinematics and the contacts in `active` present. It depends on one side of the
    /// joint alone where no unknown contact acts on that side ([`Route`]). With joints that follow
    /// it, it depends on what any of their torques depends on.
    pub fn torque_dependence(
        &self,
        dof: usize,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) -> Option<Dependence> {
        let links = self.dof_links.get(dof)?.iter();
        let each = links.map(|&link| self.dependence_above(link, kinematics, active));
        each.reduce(|a, b| Dependence {
            sensors: a.sensors.union(&b.sensors),
            dofs: a.dofs.union(&b.dofs),
            links: a.links.union(&b.links),
            base: a.base || b.base,
            contacts: a.contacts.union(&b.contacts),
            absent: a.absent.union(&b.absent),
        })
    }

    /// What the torque of the joint above a link depends on.
    fn dependence_above(
        &self,
        link: usize,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) -> Dependence {
        let place = &self.places[link];
        let subtree = &self.subtrees[place.subtree];
        let route = self.route_above(link, active);
        let (sensors, contacts) = match route {
            Route::Child => (place.sensors_below, place.contacts_below),
            Route::Parent => (
                subtree.sensors.difference(&place.sensors_below),
                subtree.contacts.difference(&place.contacts_below),
            ),
            Route::Fused | Route::Whole => (subtree.sensors, subtree.contacts),
        };
        let enters = |other: &usize| match route {
            Route::Child => self.below(link).contains(other),
            Route::Parent => !self.below(link).contains(other),
            Route::Fused | Route::Whole => true,
        };
        let links = self.links_of(place.subtree).filter(enters).collect();
        self.dependence(sensors, contacts, links, kinematics, active)
    }

    /// What the wrench of a contact depends on: its whole sub-tree.
    pub fn contact_dependence(
        &self,
        contact: usize,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) -> Option<Dependence> {
        let link = self.contacts.get(contact)?.frame.link;
        Some(self.subtree_dependence(self.subtree_of(link)?, kinematics, active))
    }

    /// What the balance of a sub-tree depends on.
    pub fn subtree_dependence(
        &self,
        number: usize,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) -> Dependence {
        let subtree = &self.subtrees[number];
        let links = self.links_of(number).collect();
        self.dependence(subtree.sensors, subtree.contacts, links, kinematics, active)
    }

    fn dependence(
        &self,
        sensors: SensorSet,
        contacts: ContactSet,
        links: LinkSet,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) -> Dependence {
        // The pose and motion of a link depend on the joints between the base and the link.
        let mut dofs = DofSet::EMPTY;
        for link in links.iter() {
            let (mut a, mut b) = (kinematics.base(), link);
            while a != b {
                let lower = if a > b { &mut a } else { &mut b };
                if let Some(dof) = self.dof_of(*lower) {
                    dofs.insert(dof);
                }
                *lower = self.places[*lower].parent;
            }
        }
        Dependence {
            sensors,
            dofs,
            links,
            base: !links.is_empty(),
            contacts: contacts.intersection(active),
            absent: contacts.difference(active),
        }
    }

    /// The links at or below a link: they are numbered depth first.
    pub fn below(&self, link: usize) -> std::ops::Range<usize> {
        link..self.places[link].end
    }

    /// The parent of a link; that of the root is the root.
    pub fn parent_of(&self, link: usize) -> usize {
        self.places[link].parent
    }

    /// Length that compares forces with torques where there is no sensor noise to do so \[m\].
    pub fn length_scale(&self) -> f64 {
        self.length_scale
    }

    /// The link that a degree of freedom moves: that of the joint with its name.
    pub fn link_of(&self, dof: usize) -> Option<usize> {
        self.moved_by(dof).first().copied()
    }

    /// The links that a degree of freedom moves: that of the joint with its name, then those of the
    /// joints that follow it.
    pub fn moved_by(&self, dof: usize) -> &[usize] {
        self.dof_links.get(dof).map_or(&[], Vec::as_slice)
    }

    /// The degree of freedom of the joint above a link.
    pub fn dof_of(&self, link: usize) -> Option<usize> {
        self.link_dofs.get(link).copied().flatten()
    }

    /// The links of a sub-tree, ascending.
    pub fn links_of(&self, subtree: usize) -> impl Iterator<Item = usize> {
        let top = self.subtrees[subtree].top;
        (top..self.places[top].end).filter(move |&link| self.places[link].subtree == subtree)
    }
}

/// The place of every link, with the cuts at the sensors.
fn cut_places(model: &Model, sensors: &[SensorCut]) -> Result<Vec<LinkPlace>, StructureError> {
    let parent = |link: usize| {
        link.checked_sub(1)
            .map_or(0, |joint| model.joints()[joint].parent)
    };
    let mut places: Vec<LinkPlace> = (0..model.link_count())
        .map(|link| LinkPlace {
            parent: parent(link),
            subtree: 0,
            end: link + 1,
            is_top: link == 0,
            contacts_below: ContactSet::EMPTY,
            sensors_below: SensorSet::EMPTY,
        })
        .collect();
    for sensor in sensors {
        let place = places
            .get_mut(sensor.joint + 1)
            .ok_or_else(|| StructureError::NoJoint(String::new()))?;
        if std::mem::replace(&mut place.is_top, true) {
            return Err(StructureError::TwoSensors(
                model.joint_name(sensor.joint).to_owned(),
            ));
        }
    }
    Ok(places)
}

/// The sub-trees, and what is below each link in its sub-tree.
fn subtrees(
    places: &mut [LinkPlace],
    sensors: &[SensorCut],
    contacts: &[ContactSpec],
) -> Vec<SubTree> {
    let mut subtrees = Vec::with_capacity(sensors.len() + 1);
    for link in 0..places.len() {
        if places[link].is_top {
            places[link].subtree = subtrees.len();
            subtrees.push(SubTree {
                top: link,
                sensors: SensorSet::EMPTY,
                contacts: ContactSet::EMPTY,
            });
        } else {
            places[link].subtree = places[places[link].parent].subtree;
        }
    }
    for (index, contact) in contacts.iter().enumerate() {
        let place = &mut places[contact.frame.link];
        place.contacts_below.insert(index);
        subtrees[place.subtree].contacts.insert(index);
    }
    for (index, sensor) in sensors.iter().enumerate() {
        // For the side of the child, the sensor is at the top of the sub-tree, above all of its
        // joints; for the side of the parent it is below.
        let child = sensor.joint + 1;
        let parent = places[child].parent;
        places[parent].sensors_below.insert(index);
        for link in [child, parent] {
            subtrees[places[link].subtree].sensors.insert(index);
        }
    }
    for link in (1..places.len()).rev() {
        let below = places[link];
        let above = &mut places[below.parent];
        above.end = above.end.max(below.end);
        if !below.is_top {
            above.contacts_below = above.contacts_below.union(&below.contacts_below);
            above.sensors_below = above.sensors_below.union(&below.sensors_below);
        }
    }
    subtrees
}

/// Per degree of freedom, the links that it moves: first that of the joint with its name. Per link,
/// the degree of freedom of the joint above it.
fn moved_links(model: &Model) -> (Vec<Vec<usize>>, Vec<Option<usize>>) {
    let mut dof_links: Vec<Vec<usize>> = (0..model.dof_count())
        .filter_map(|dof| model.dof_joint(dof))
        .map(|joint| vec![joint + 1])
        .collect();
    let mut link_dofs = vec![None; model.link_count()];
    for joint in model.joints() {
        link_dofs[joint.child] = joint.dof;
        if let Some(links) = joint.dof.and_then(|dof| dof_links.get_mut(dof))
            && !links.contains(&joint.child)
        {
            links.push(joint.child);
        }
    }
    (dof_links, link_dofs)
}

/// Why a structure cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StructureError {
    /// The model has no such joint, or the joint was folded because it was not named when the model
    /// was read.
    #[error("joint {0}, named as the joint of an F/T sensor, is not in the model")]
    NoJoint(String),
    /// The joint moves, and was not named when the model was read.
    #[error("joint {0} moves; name it as the joint of an F/T sensor when the model is read")]
    JointMoves(String),
    /// The parent of a moving joint moves against the sensor, which is on the child's side.
    #[error(
        "the F/T sensor in joint {0} cannot measure in the parent's frame, because the joint moves \
         and the sensor is on its child's side; use the frame of the child, or one of the sensor's \
         own"
    )]
    ParentFrame(String),
    /// Two sensors in one joint.
    #[error("two F/T sensors are in joint {0}")]
    TwoSensors(String),
    /// A standard deviation that is zero, negative or not finite.
    #[error(
        "F/T sensor in joint {0}: every standard deviation of its noise must be positive and finite"
    )]
    Noise(String),
    /// The pose of a sensor is not finite.
    #[error("F/T sensor in joint {0}: its pose is not finite")]
    SensorPose(String),
    /// More than the capacity.
    #[error("{count} {what}: {most} at most")]
    TooMany {
        /// What is counted.
        what: &'static str,
        /// How many there are.
        count: usize,
        /// The capacity.
        most: usize,
    },
    /// A contact on a link that does not exist, or whose frame or position is not finite.
    #[error("contact {index}: its link does not exist, or its frame or position is not finite")]
    Contact {
        /// Its number.
        index: usize,
    },
    /// A contact whose direction is zero or not finite.
    #[error("contact {index}: its direction is zero or not finite")]
    Direction {
        /// Its number.
        index: usize,
    },
    /// A length scale that is not positive and finite.
    #[error("the length scale is {0} m; it must be positive and finite")]
    LengthScale(f64),
}
