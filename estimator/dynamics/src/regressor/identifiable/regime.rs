//! Motion and measurements for which [`super::Identifiable`] is computed.

use crate::model::Model;
use crate::spatial::Vec3;
use crate::structure::{ContactSet, Structure};

/// Motion of a joint during the measurements.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JointMotion {
    /// It moves: position, velocity and acceleration all vary.
    Moving,
    /// It is always at this position [rad or m].
    Locked(f64),
}

/// How the base moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BaseRegime {
    /// Freely.
    Free,
    /// It is at rest, with this physical gravity in base-link coordinates [m/s^2].
    Fixed(Vec3),
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
            motion: BaseRegime::Fixed(*gravity),
            ..Self::free(model)
        }
    }
}

/// The measured quantities.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measurement {
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
    /// All links, without regard to the sensors between them, so without offsets; the wrench is
    /// that on the base link, without unknown contacts elsewhere.
    Tree,
    /// One sub-tree between F/T sensors, by its number. Offsets are those of its sensors.
    SubTree(&'a Structure, usize),
    /// Every sub-tree: all rows of all of them together, except those that [`Regime::contacts`]
    /// remove. A sub-tree without sensors counts too, because its balance is known if no unknown
    /// contact acts on it.
    SubTrees(&'a Structure),
}

impl<'a> Scope<'a> {
    pub(super) fn structure(self) -> Option<&'a Structure> {
        match self {
            Scope::Tree => None,
            Scope::SubTree(structure, _) | Scope::SubTrees(structure) => Some(structure),
        }
    }

    /// The separately measured part to which a link belongs: the number of its sub-tree, or one
    /// number for all links of a whole tree. `None` outside the scope.
    pub(super) fn part_of(self, link: usize) -> Option<usize> {
        match self {
            Scope::Tree => Some(0),
            Scope::SubTree(structure, number) => {
                structure.subtree_of(link).filter(|&of| of == number)
            }
            Scope::SubTrees(structure) => structure.subtree_of(link),
        }
    }

    /// The sensors whose offsets enter, ascending.
    pub(super) fn sensors(self) -> Vec<usize> {
        match self {
            Scope::Tree => Vec::new(),
            Scope::SubTree(structure, number) => {
                structure.subtrees()[number].sensors.iter().collect()
            }
            Scope::SubTrees(structure) => (0..structure.sensors().len()).collect(),
        }
    }
}

/// The meaning of a column of the regressor, which is a row of the basis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ParameterColumn {
    /// An inertial parameter.
    Inertial {
        /// The link.
        link: usize,
        /// Its index among the ten `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]`.
        parameter: usize,
    },
    /// A component of an offset: reading = true wrench + offset.
    Offset {
        /// The sensor of the [`Structure`].
        sensor: usize,
        /// Its index among `[t_x, t_y, t_z, f_x, f_y, f_z]`, in the measurement frame.
        component: usize,
    },
}
