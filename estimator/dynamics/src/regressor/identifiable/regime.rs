//! Motion and measurements for which [`super::Identifiable`] is computed.

use crate::model::Model;
use crate::spatial::{Motion, Pose, Vec3};
use crate::structure::{ContactSet, Structure};

/// Motion of a joint during the measurements.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JointMotion {
    /// It moves: position, velocity and acceleration all vary.
    Moving,
    /// It takes different positions, but is at rest during each measurement: static postures.
    Posed,
    /// It is always at this position [rad or m].
    Locked(f64),
}

/// One degree of freedom of a joint of any type, or of the base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Freedom {
    /// The motion that one unit of it causes, of the outer body relative to the inner one, in the
    /// frame of the outer body with every freedom of the joint at zero. That of a helical joint has
    /// both parts. A zero twist allows no motion.
    pub twist: Motion,
    /// How it moves.
    pub motion: JointMotion,
}

/// How the base moves.
#[derive(Clone, Debug, PartialEq)]
pub enum BaseRegime {
    /// Freely.
    Free,
    /// As if these joints held it to the world.
    Restricted {
        /// Physical gravity with all of them at zero, in base-link coordinates [m/s^2].
        gravity: Vec3,
        /// From the world to the base link; twists in base-link coordinates. Empty: the base is
        /// fixed. One moving rotation about the vertical: a turntable. Posed rotations: the base is
        /// tilted between measurements.
        joints: Vec<Freedom>,
    },
}

/// Motion of the base and the joints, and contacts, during the measurements.
#[derive(Clone, Debug, PartialEq)]
pub struct Regime {
    /// The link whose motion `motion` describes.
    pub base: usize,
    /// How it moves.
    pub motion: BaseRegime,
    /// Motion of each joint, by degree of freedom.
    pub joints: Vec<JointMotion>,
    /// Unknown contacts of the [`Structure`] that are present in all measurements: the support of a
    /// fixed base, the ground under a foot. They remove equations from the balance of their
    /// sub-tree ([Contacts](super#contacts)). Intermittent contacts do not belong here: the
    /// parameters that they hide are observable while they are absent.
    pub contacts: ContactSet,
    /// See [Tolerance](super#tolerance); clamped to 1e-12 to 0.01.
    pub tolerance: f64,
}

impl Regime {
    /// The default tolerance.
    pub const TOLERANCE: f64 = 1e-7;

    /// A free base and moving joints, no unknown contact.
    pub fn free(model: &Model) -> Self {
        Self {
            base: 0,
            motion: BaseRegime::Free,
            joints: vec![JointMotion::Moving; model.dof_count()],
            contacts: ContactSet::EMPTY,
            tolerance: Self::TOLERANCE,
        }
    }

    /// Link `base` at rest, gravity in its coordinates [m/s^2], and moving joints. Its support is
    /// not included as a contact: see [`Regime::contacts`].
    pub fn fixed(model: &Model, base: usize, gravity: &Vec3) -> Self {
        Self {
            base,
            motion: BaseRegime::Restricted {
                gravity: *gravity,
                joints: Vec::new(),
            },
            ..Self::free(model)
        }
    }
}

/// The measured quantities.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measured {
    /// The wrench: what the environment exerts on the whole tree, or the balance of a sub-tree
    /// between its F/T sensors (eq. (11)). The result does not depend on the link in whose
    /// coordinates it is (Lemma 1). All six components, minus those that [`Regime::contacts`]
    /// remove.
    Wrench,
    /// Every joint torque and nothing else (eq. (12)): that of all bodies of the sub-tree beyond
    /// the joint, seen from the base.
    Torques,
    /// Both. With a free base the torques add nothing (Proposition 1); with a restricted one they
    /// can.
    Both,
}

/// Whether offsets of the F/T sensors are unknowns too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offsets {
    /// They are known.
    Known,
    /// They are estimated too: six columns per sensor.
    Unknown,
}

/// The part of the robot and the sensors.
#[derive(Clone, Copy, Debug)]
pub enum Scope<'a> {
    /// All links, without regard to the sensors between them; the wrench is that on the base link,
    /// without unknown contacts elsewhere. Its offset, if unknown, is in the base link's frame.
    Tree,
    /// One sub-tree between F/T sensors, by its number. Offsets are those of its sensors.
    SubTree(&'a Structure, usize),
    /// Every sub-tree: all rows of all of them together, except those that [`Regime::contacts`]
    /// remove. A sub-tree without sensors counts too, because its balance is known if no unknown
    /// contact acts on it.
    SubTrees(&'a Structure),
}

/// The meaning of a column of the regressor, which is a row of the basis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Column {
    /// An inertial parameter.
    Inertial {
        /// The link.
        link: usize,
        /// Its index among the ten `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]`.
        parameter: usize,
    },
    /// A component of an offset: reading = true wrench + offset.
    Offset {
        /// The sensor of the [`Structure`] (0 for the base wrench of a whole tree).
        sensor: usize,
        /// Its index among `[t_x, t_y, t_z, f_x, f_y, f_z]`, in the measurement frame.
        component: usize,
    },
}

/// The unobservable part of the inertia beyond a joint, with the contacts of the regime present.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Invisible {
    /// The joint; `None` for the link where the pass through the tree, or sub-tree, begins. In a
    /// mechanism: the number of the body beyond, minus one, as in a model.
    pub joint: Option<usize>,
    /// The link beyond it, seen from the base.
    pub link: usize,
    /// Number of unobservable transfers between the links of the joint. For the first link: number
    /// of unobservable directions of the inertia of all bodies together, frozen.
    pub directions: usize,
}

/// A rigid body of a mechanism with joints of any type. The data of the base, the first body, are
/// ignored: see [`BaseRegime`].
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// The inner body, with a smaller number; `None` for the first body, the base.
    pub parent: Option<usize>,
    /// Pose of this body in the inner one, `x_pc`, with every freedom of the joint at zero. Its
    /// rotation must be orthonormal to the tolerance.
    pub placement: Pose,
    /// The joint, from the inner body to this one; several freedoms act in sequence, as if massless
    /// bodies were between them.
    pub joint: Vec<Freedom>,
}
