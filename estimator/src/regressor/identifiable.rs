//! Which combinations of inertial parameters and sensor offsets show in the measurements: the identifiable subspace, in closed form.
//!
//! The paper's identifiable subspace `I_Y` (section III.A, eq. (6) and (7)) is the orthogonal complement of the parameters that no motion shows. Usually its
//! basis `B` comes from a rank decision on sampled regressors. Here it follows from the geometry of the joints, for any tree cut at any F/T sensors, for
//! a base that is restricted in its motion, joints that only take postures, joint torques instead of wrenches, and unknown sensor offsets:
//! [`Identifiable::new`] decides ranks only of matrices with at most sixteen columns (and of the offsets among themselves).
//!
//! # How
//! A body's ten parameters are a symmetric 4 x 4 matrix, the pseudo-inertia `J` ([`crate::spatial::RigidInertia::pseudo_inertia`]); the acceleration of
//! its points is `D r`, `r = [x, y, z, 1]`, with
//!
//! ```text
//! D = [S(alpha) + S(omega)^2, a; 0, 0]        a: proper acceleration of the origin
//! D J - J D^T = [S(n), f; -f^T, 0]            its net wrench
//! tr(E^T D J)                                 the net wrench's component along the twist E = [S(e), e_0; 0, 0]
//! ```
//!
//! Let `theta` be the inertia of everything beyond a joint, frozen at a reference position and seen from the joint's outer body, and `S` a twist that
//! the joint allows. The joint moves `theta` as `X theta X^T`, `X = exp(S q)`, and
//!
//! ```text
//! D_c = X^-1 (D_p + 2 S(omega_p) S dq + S^2 dq^2 + S ddq) X
//! ```
//!
//! is the outer body's `D`. As `q`, `dq`, `ddq` are free, `theta` leaves the measurements unchanged, compared with the same body frozen, exactly if each
//! coefficient does. These are linear conditions on `theta`, in which only the *linear spans* of what the bodies attain matter, of `(D, 1)`, of
//! `omega`, and of the rows `sym(E^T D)`; and these spans follow from body to body. With a free base and a measured wrench all is attained and what remains is
//!
//! ```text
//! S theta = 0    for every twist S that the joint allows:    theta = point masses in the kernel of all S
//! ```
//!
//! three directions for a revolute joint (mass, first moment and second moment along the axis), six for a prismatic one, ten for a fixed one, one for helical,
//! cylindrical, universal, spherical and planar joints. A null vector is such a `theta` on the joint's outer body and its opposite on the inner one.
//! The null space is their direct sum: `10 N_B - sum n_j` combinations are identifiable. For restricted base motion compare Wensing, Niemeyer and
//! Slotine, arXiv:1711.03896 (for joint torques); here wrenches, offsets and postures follow from the same recursion.
//!
//! # Contacts
//! Unknown contacts that are always present leave those twists `E` along which none of them does work, `E . c = 0`. On the link where the pass through a
//! sub-tree begins (the base, or the link beyond the sensor towards it) they are constant, and the recursion starts from them instead of all six.
//! Unknowns that take up all six leave nothing of the sub-tree but the torques beyond. If only wrenches are measured, a contact with six unknowns does so on any
//! link. What is left by fewer unknowns on another link, or between torques and contacts beyond their joints, is not in this recursion, and refused.
//!
//! # Speed
//! The operations grow with the square of the number of links, as the entries of the basis do. To measure: `cargo bench -p proprio-estimator --bench identifiable`.
//!
//! # Tolerance
//! Spans are compared in units in which lengths (the largest distance between neighbouring joints), accelerations (gravity) and twists are of order one. A
//! direction counts if it sticks out of a span by more than [`Regime::tolerance`]. Angles that the URDF gives with nine digits are thus exact;
//! with fewer, what should be parallel is not, and a larger tolerance forgives it.
//!
//! Lengths and gravity below a millionth of their SI unit count as none when these units are chosen, and above a million times it they are refused, as are
//! rotations that are not orthonormal to the tolerance: nothing that is not finite comes out.

mod assemble;
mod expression;
mod reach;

use nalgebra::{DMatrix, SMatrix};

use self::assemble::{Hidden, Member, NullVector, Scale, assemble, wrench_transform};
use self::reach::{Reach, Span};
use crate::dynamics::{ContactKind, ContactSet, ContactSpec, DynamicsError, SensorCut, Structure, check_size};
use crate::model::{JointKind, Model};
use crate::spatial::{Mat3, Motion, Pose, Vec3, Wrench};

pub use expression::{BaseParameter, Term};

/// What a joint does while measurements are taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JointMotion {
    /// It moves: position, velocity and acceleration are all different from time to time.
    Moving,
    /// It takes different positions, but is at rest whenever one measures: static postures.
    Posed,
    /// It never leaves this position [rad or m].
    Locked(f64),
}

/// One degree of freedom of a joint of any type, or of the base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Freedom {
    /// The motion that one unit of it causes, of the outer body relative to the inner one, in the frame of the outer body with every freedom of
    /// the joint at zero. A helical joint's has both parts. A zero twist allows nothing.
    pub twist: Motion,
    /// What it does.
    pub motion: JointMotion,
}

/// How the base moves.
#[derive(Clone, Debug, PartialEq)]
pub enum BaseRegime {
    /// At will.
    Free,
    /// As if these joints held it to the world.
    Restricted {
        /// Physical gravity with all of them at zero, in base-link coordinates [m/s^2].
        gravity: Vec3,
        /// From the world to the base link; twists in base-link coordinates. None: the base is fixed. One moving rotation about the vertical: a turntable.
        /// Posed rotations: the base is tilted between measurements.
        joints: Vec<Freedom>,
    },
}

/// What moves, and how, while measurements are taken.
#[derive(Clone, Debug, PartialEq)]
pub struct Regime {
    /// The link whose motion `motion` tells.
    pub base: usize,
    /// How it moves.
    pub motion: BaseRegime,
    /// What each joint does, by degree of freedom.
    pub joints: Vec<JointMotion>,
    /// Unknown contacts of the [`Structure`] that are there whenever one measures: the support of a fixed base, the ground under a foot. What they take up of the
    /// balance of their sub-tree shows nothing ([Contacts](self#contacts)). Those that come and go do not belong here: what they hide shows while they are gone.
    pub contacts: ContactSet,
    /// See [Tolerance](self#tolerance); taken as 1e-12 at least and 0.01 at most.
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

    /// Link `base` held still, gravity in its coordinates [m/s^2], and moving joints. What holds it is no contact yet: see [`Regime::contacts`].
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

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measured {
    /// The wrench: what the environment exerts on the whole tree, or the balance of a sub-tree between its F/T sensors (eq. (11)). Which link's coordinates it
    /// is in does not matter (Lemma 1). All six components, less what [`Regime::contacts`] take up.
    Wrench,
    /// Every joint torque and nothing else (eq. (12)): of everything beyond the joint, seen from the base, as far as the sub-tree goes.
    Torques,
    /// Both. With a free base the torques add nothing (Proposition 1); with a restricted one they can.
    Both,
}

/// Whether offsets of the F/T sensors are unknowns too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offsets {
    /// They are known.
    Known,
    /// They are estimated along: six columns per sensor.
    Unknown,
}

/// Which part of the robot, and which sensors.
#[derive(Clone, Copy, Debug)]
pub enum Scope<'a> {
    /// All links, whatever sensors sit between them; the wrench is that on the base link, without unknown contacts elsewhere. Its offset, if unknown, is in the base link's frame.
    Tree,
    /// One sub-tree between F/T sensors, by its number. Offsets are those of its sensors.
    SubTree(&'a Structure, usize),
    /// Every sub-tree: all rows of all of them together, but those that [`Regime::contacts`] take up. One without sensors counts too, for its balance is known
    /// if nothing unknown touches it.
    SubTrees(&'a Structure),
}

/// What a column of the regressor, a row of the basis, stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Column {
    /// An inertial parameter.
    Inertial {
        /// Of this link.
        link: usize,
        /// Its number among the ten `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]`.
        parameter: usize,
    },
    /// A component of an offset: reading = true wrench + offset.
    Offset {
        /// Of this sensor of the [`Structure`] (0 for the base wrench of a whole tree).
        sensor: usize,
        /// Its number among `[t_x, t_y, t_z, f_x, f_y, f_z]`, in the measurement frame.
        component: usize,
    },
}

/// How much of the inertia beyond a joint does not show, with the contacts of the regime present.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Invisible {
    /// The joint; none for the link where the pass through the tree, or sub-tree, begins. Of a mechanism: the number of the body beyond, less one, as in a model.
    pub joint: Option<usize>,
    /// The link beyond it, seen from the base.
    pub link: usize,
    /// How many transfers between the links of the joint do not show. For the first link: how many directions of the inertia of everything frozen.
    pub directions: usize,
}

/// A rigid body of a mechanism with joints of any type. Of the base, the first body, nothing counts but that it is there: see [`BaseRegime`].
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// The inner body, with a smaller number; none for the first body, the base.
    pub parent: Option<usize>,
    /// Pose of this body in the inner one, `x_pc`, with every freedom of the joint at zero. Its rotation must be one, to the tolerance.
    pub placement: Pose,
    /// The joint, from the inner body to this one; more than one freedom act one after the other, as if massless bodies were between them.
    pub joint: Vec<Freedom>,
}

/// The identifiable subspace of inertial parameters, with or without offsets.
///
/// Columns: ten per link of the scope, links ascending; then, with unknown offsets, six per sensor of the scope, sensors ascending, `[torque; force]` in
/// the measurement frame, so that reading = true wrench + offset. An offset enters the balance of a sub-tree as
///
/// ```text
/// Y phi + O o = sum of the raw readings' wrenches,     O o = sum of +- the wrench that SensorCut::transmitted makes of o
/// ```
///
/// `+` for the sensor above the sub-tree's top link, which reads the wrench by the parent on it, `-` for the sensors below.
#[derive(Clone, Debug)]
pub struct Identifiable {
    columns: Vec<Column>,
    names: Vec<String>,
    basis: DMatrix<f64>,
    null: Vec<NullVector>,
    invisible: Vec<Invisible>,
    confused: usize,
}

impl Identifiable {
    /// Computes the subspace of a model.
    ///
    /// # Errors
    /// There is no such base or sub-tree, the regime or the structure is for another model, a number of the regime is not finite, or the model or the regime
    /// has lengths or accelerations that nothing can be computed with ([Tolerance](self#tolerance)), or contacts for which there is no closed form
    /// ([Contacts](self#contacts)).
    pub fn new(
        model: &Model,
        scope: Scope<'_>,
        regime: &Regime,
        measured: Measured,
        offsets: Offsets,
    ) -> Result<Self, DynamicsError> {
        check_size("joints of the regime", regime.joints.len(), model.dof_count())?;
        if regime.base >= model.link_count() {
            return Err(DynamicsError::NoLink(regime.base));
        }
        let structure = match scope {
            Scope::Tree => None,
            Scope::SubTree(structure, _) | Scope::SubTrees(structure) => Some(structure),
        };
        if let Some(structure) = structure {
            check_size("links of the structure", structure.link_count(), model.link_count())?;
        }
        if let Scope::SubTree(structure, number) = scope
            && number >= structure.subtrees().len()
        {
            return Err(DynamicsError::Index {
                what: "sub-trees",
                index: number,
                count: structure.subtrees().len(),
            });
        }
        // The pieces of the robot that are measured: numbers of sub-trees, one for all links of a whole tree.
        let piece = |link: usize| match scope {
            Scope::Tree => Some(0),
            Scope::SubTree(structure, number) => structure.subtree_of(link).filter(|&of| of == number),
            Scope::SubTrees(structure) => structure.subtree_of(link),
        };
        let route = route(model, regime.base);
        let place = |link: usize| route.iter().position(|step| step.link == link).unwrap_or(0);
        let bodies: Vec<Body> = route.iter().map(|step| step.body(model, regime)).collect();
        let links: Vec<usize> = (0..model.link_count()).filter(|&link| piece(link).is_some()).collect();
        let sensors: Vec<usize> = match (scope, offsets) {
            (_, Offsets::Known) => Vec::new(),
            (Scope::Tree, Offsets::Unknown) => vec![0],
            (Scope::SubTree(structure, number), Offsets::Unknown) => {
                structure.subtrees()[number].sensors.iter().collect()
            }
            (Scope::SubTrees(structure), Offsets::Unknown) => (0..structure.sensors().len()).collect(),
        };
        let mut attached = Vec::new();
        for (column, &sensor) in sensors.iter().enumerate() {
            match structure {
                None => attached.push(Attached {
                    body: 0,
                    column,
                    carry: SMatrix::identity(),
                }),
                Some(structure) => {
                    let sides = sides(model, &structure.sensors()[sensor]);
                    let sides = sides.into_iter().filter(|&(link, _)| piece(link).is_some());
                    attached.extend(sides.map(|(link, carry)| Attached {
                        body: place(link),
                        column,
                        carry,
                    }));
                }
            }
        }
        let scopes: Vec<_> = route.iter().map(|step| piece(step.link)).collect();
        let mut unknown = Vec::new();
        for contact in regime.contacts.iter() {
            let contacts = structure.map_or(&[][..], Structure::contacts);
            let spec = contacts.get(contact).ok_or(DynamicsError::Index {
                what: "contacts",
                index: contact,
                count: contacts.len(),
            })?;
            let Some(number) = piece(spec.frame.link) else { continue };
            let first = route.iter().find(|step| piece(step.link) == Some(number));
            let is_first = first.is_some_and(|step| step.link == spec.frame.link);
            // Where it is does not matter if nothing of the balance is left and nothing else is measured.
            if !is_first && (spec.kind != ContactKind::Wrench || measured != Measured::Wrench) {
                return Err(DynamicsError::Contact(contact));
            }
            unknown.extend(contact_wrenches(spec).into_iter().map(|wrench| (number, wrench)));
        }
        let numbers: Vec<usize> = route.iter().map(|step| step.link).collect();
        let mut found = solve(
            &bodies,
            &scopes,
            &numbers,
            &attached,
            &unknown,
            sensors.len(),
            &regime.motion,
            measured,
            regime.tolerance,
        )?;
        for invisible in &mut found.invisible {
            invisible.joint = invisible.joint.and(route[place(invisible.link)].joint);
        }
        let sensor_name = |sensor: usize| {
            structure.map_or("base", |structure| {
                model.joint_name(structure.sensors()[sensor].joint())
            })
        };
        found.label(
            &links,
            |link| model.link_name(link).to_owned(),
            &sensors,
            |sensor| sensor_name(sensor).to_owned(),
        );
        Ok(found)
    }

    /// Computes the subspace of a mechanism with joints of any type; body 0 is its base, and how it moves is in `motion` alone: its own `placement` and `joint`
    /// mean nothing. An unknown offset is that of the wrench on the base, in its frame.
    ///
    /// # Errors
    /// There is no body, a parent's number is not smaller than the body's, a number is not finite, a rotation is none, or a length or acceleration is
    /// nothing to compute with ([Tolerance](self#tolerance)).
    pub fn of_mechanism(
        bodies: &[Body],
        motion: &BaseRegime,
        measured: Measured,
        offsets: Offsets,
        tolerance: f64,
    ) -> Result<Self, DynamicsError> {
        if bodies.is_empty() {
            return Err(DynamicsError::NoLink(0));
        }
        for (number, body) in bodies.iter().enumerate() {
            let is_valid = match body.parent {
                Some(parent) => parent < number,
                None => number == 0,
            };
            if !is_valid {
                return Err(DynamicsError::NoLink(body.parent.unwrap_or(number)));
            }
        }
        // Depth first, so that what lies beyond a body comes right after it.
        let mut order = Vec::with_capacity(bodies.len());
        let mut waiting = vec![0];
        while let Some(body) = waiting.pop() {
            order.push(body);
            waiting.extend(
                (body + 1..bodies.len())
                    .rev()
                    .filter(|&b| bodies[b].parent == Some(body)),
            );
        }
        let sorted: Vec<Body> = order
            .iter()
            .map(|&body| Body {
                parent: bodies[body]
                    .parent
                    .and_then(|parent| order.iter().position(|&b| b == parent)),
                ..bodies[body].clone()
            })
            .collect();
        let sensors: Vec<usize> = match offsets {
            Offsets::Known => Vec::new(),
            Offsets::Unknown => vec![0],
        };
        let attached: Vec<_> = sensors
            .iter()
            .map(|&column| Attached {
                body: 0,
                column,
                carry: SMatrix::identity(),
            })
            .collect();
        let scopes = vec![Some(0); bodies.len()];
        let mut found = solve(
            &sorted,
            &scopes,
            &order,
            &attached,
            &[],
            sensors.len(),
            motion,
            measured,
            tolerance,
        )?;
        let links: Vec<usize> = (0..bodies.len()).collect();
        found.label(&links, |body| format!("body{body}"), &sensors, |_| "base".to_owned());
        Ok(found)
    }

    /// `B`, columns x [`Identifiable::rank`]: orthonormal columns that span the identifiable subspace, so that `phi = B pi` for the part that can be known and
    /// `pi = B^T phi` are the base parameters of any `phi` (eq. (7)).
    pub fn basis(&self) -> &DMatrix<f64> {
        &self.basis
    }

    /// Its dimension: how many combinations can be identified.
    pub fn rank(&self) -> usize {
        self.basis.ncols()
    }

    /// What each column stands for.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Name of each column, such as `l_hand.m` or `l_arm_ft_sensor.f_x`.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// A basis of the null space, columns x (columns - rank). Its columns are sparse and readable, not orthonormal: each is a transfer of inertia
    /// between the two links of a joint, or parameters that a single link hides; the last [`Identifiable::confused`] ones say which offset looks like
    /// which parameters.
    pub fn null(&self) -> DMatrix<f64> {
        let mut null = DMatrix::zeros(self.columns.len(), self.null.len());
        for (k, vector) in self.null.iter().enumerate() {
            for &(column, entry) in &vector.entries {
                null[(column, k)] = entry;
            }
        }
        null
    }

    /// Per joint within the scope, and for the first link of each piece, how many directions do not show; the order is that of a pass from the base.
    pub fn invisible(&self) -> &[Invisible] {
        &self.invisible
    }

    /// How many directions the offsets lose: rank without offsets + number of offset columns - rank with them. In these, an offset and inertial parameters, or
    /// several offsets, can not be told apart as long as the regime lasts.
    pub fn confused(&self) -> usize {
        self.confused
    }

    /// The base parameters as readable sums, one per dimension: see [`BaseParameter`].
    pub fn base_parameters(&self) -> Vec<BaseParameter> {
        expression::base_parameters(&self.names, &self.null)
    }

    fn label(
        &mut self,
        links: &[usize],
        link_name: impl Fn(usize) -> String,
        sensors: &[usize],
        sensor_name: impl Fn(usize) -> String,
    ) {
        const PARAMETERS: [&str; 10] = ["m", "h_x", "h_y", "h_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz"];
        const COMPONENTS: [&str; 6] = ["t_x", "t_y", "t_z", "f_x", "f_y", "f_z"];
        for &link in links {
            let name = link_name(link);
            for (parameter, suffix) in PARAMETERS.iter().enumerate() {
                self.columns.push(Column::Inertial { link, parameter });
                self.names.push(format!("{name}.{suffix}"));
            }
        }
        for &sensor in sensors {
            let name = sensor_name(sensor);
            for (component, suffix) in COMPONENTS.iter().enumerate() {
                self.columns.push(Column::Offset { sensor, component });
                self.names.push(format!("{name}.{suffix}"));
            }
        }
    }
}

/// A sensor's offset on a body.
struct Attached {
    body: usize,
    /// Number of its six columns.
    column: usize,
    /// From the measurement frame to the wrench in the body's frame, with its sign in the balance.
    carry: SMatrix<f64, 6, 6>,
}

/// How a sensor's offset enters the balance of the sub-trees above and below it: link, and the 6 x 6 that takes it to a wrench in the link's frame.
fn sides(model: &Model, cut: &SensorCut) -> [(usize, SMatrix<f64, 6, 6>); 2] {
    let joint = &model.joints()[cut.joint()];
    let mut at_child = SMatrix::<f64, 6, 6>::zeros();
    for component in 0..6 {
        let unit = |i: usize| f64::from(u8::from(i == component));
        let Wrench { torque, force } = cut.transmitted(&Wrench {
            torque: Vec3::from_fn(|i, _| unit(i)),
            force: Vec3::from_fn(|i, _| unit(3 + i)),
        });
        at_child.fixed_view_mut::<3, 1>(0, component).copy_from(&torque);
        at_child.fixed_view_mut::<3, 1>(3, component).copy_from(&force);
    }
    let at_parent = -(wrench_transform(&joint.placement) * at_child);
    [(joint.child, at_child), (joint.parent, at_parent)]
}

/// A link in the order of a pass from the base, depth first.
struct Step {
    link: usize,
    /// Place in the pass of the link before it, and the joint between.
    parent: Option<usize>,
    joint: Option<usize>,
    /// The joint is crossed from child to parent.
    reversed: bool,
}

impl Step {
    fn body(&self, model: &Model, regime: &Regime) -> Body {
        let Some(joint) = self.joint.map(|joint| model.joints()[joint]) else {
            return Body {
                parent: None,
                placement: Pose::identity(),
                joint: Vec::new(),
            };
        };
        let twist = match joint.kind {
            JointKind::Revolute(axis) => Some(Motion::rotation(&axis.vector, &Vec3::zeros())),
            JointKind::Prismatic(axis) => Some(Motion::translation(&axis.vector)),
            JointKind::Fixed => None,
        };
        // Crossed the other way, x_cp(q) = exp(-S q) x_cp(0) = x_cp(0) exp(-(x_pc S) q).
        let (placement, twist) = if self.reversed {
            let turned = twist.map(|twist| -joint.placement.twist(&twist));
            (joint.placement.inverse(), turned)
        } else {
            (joint.placement, twist)
        };
        let motion = joint.dof.and_then(|dof| regime.joints.get(dof).copied());
        Body {
            parent: self.parent,
            placement,
            joint: twist
                .zip(motion)
                .map(|(twist, motion)| Freedom { twist, motion })
                .into_iter()
                .collect(),
        }
    }
}

/// The links of a model in the order of a pass from link `base`.
fn route(model: &Model, base: usize) -> Vec<Step> {
    let mut joints_at: Vec<Vec<usize>> = vec![Vec::new(); model.link_count()];
    for (number, joint) in model.joints().iter().enumerate() {
        joints_at[joint.parent].push(number);
        joints_at[joint.child].push(number);
    }
    let mut route: Vec<Step> = Vec::with_capacity(model.link_count());
    let mut waiting = vec![Step {
        link: base,
        parent: None,
        joint: None,
        reversed: false,
    }];
    while let Some(step) = waiting.pop() {
        let (link, from) = (step.link, step.joint);
        let place = route.len();
        route.push(step);
        for &number in joints_at[link].iter().rev().filter(|&&joint| Some(joint) != from) {
            let joint = &model.joints()[number];
            let reversed = joint.child == link;
            waiting.push(Step {
                link: if reversed { joint.parent } else { joint.child },
                parent: Some(place),
                joint: Some(number),
                reversed,
            });
        }
    }
    route
}

/// Walks the bodies, which are depth first. `pieces`: which measured piece each belongs to; `numbers`: what the caller calls them, in whose order those
/// of measured pieces have their columns; `unknown`: per piece wrenches that are always there, in the frame of its first body.
#[expect(clippy::too_many_arguments, reason = "the one place where both entries meet")]
fn solve(
    bodies: &[Body],
    pieces: &[Option<usize>],
    numbers: &[usize],
    attached: &[Attached],
    unknown: &[(usize, Wrench)],
    sensors: usize,
    motion: &BaseRegime,
    measured: Measured,
    tolerance: f64,
) -> Result<Identifiable, DynamicsError> {
    if !tolerance.is_finite() {
        return Err(DynamicsError::NotFinite {
            what: "tolerance of regime",
            index: 0,
        });
    }
    let tolerance = tolerance.clamp(1e-12, 1e-2);
    let mut joints = Vec::with_capacity(bodies.len());
    for (body, &number) in bodies.iter().zip(numbers) {
        check_pose(&body.placement, tolerance, "placement of link", number)?;
        joints.push(at_reference(&body.placement, &body.joint, "joint to link", |_| number)?);
    }
    let held = match motion {
        BaseRegime::Free => None,
        BaseRegime::Restricted { gravity, joints } => {
            check_size_of(gravity, "gravity of regime", 0)?;
            let (world, freedoms) = at_reference(&Pose::identity(), joints, "joint of the base", |index| index)?;
            Some((world.rotation.tr_mul(gravity), freedoms))
        }
    };
    let scale = Scale {
        length: unit(joints.iter().skip(1).map(|(placement, _)| placement.translation.norm())),
        acceleration: unit(held.iter().map(|(gravity, _)| gravity.norm())),
    };
    let mut measured_numbers: Vec<usize> = numbers
        .iter()
        .zip(pieces)
        .filter(|(_, piece)| piece.is_some())
        .map(|(&number, _)| number)
        .collect();
    measured_numbers.sort_unstable();
    let torques = measured != Measured::Wrench;
    let mut reaches: Vec<Option<Reach>> = vec![None; bodies.len()];
    // Bodies on the way to a measured one count too.
    let mut is_needed: Vec<bool> = pieces.iter().map(Option::is_some).collect();
    for (number, body) in bodies.iter().enumerate().rev() {
        if let Some(parent) = body.parent {
            is_needed[parent] |= is_needed[number];
        }
    }
    let mut places = vec![0; bodies.len()];
    let (mut members, mut invisible): (Vec<Member>, _) = (Vec::new(), Vec::new());
    for (number, (body, (placement, freedoms))) in bodies.iter().zip(joints).enumerate() {
        if !is_needed[number] {
            continue;
        }
        let piece = pieces[number];
        let inner = body.parent.filter(|&parent| piece.is_some() && pieces[parent] == piece);
        let mut visible = None;
        let before = body.parent.and_then(|parent| reaches[parent].as_ref());
        let mut reach = match before {
            None => base_reach(held.as_ref(), &scale, tolerance),
            Some(before) => {
                let mut reach = before.moved(&scaled(&placement, &scale));
                let mut rows = Span::empty();
                for (twist, motion) in freedoms {
                    let twist = of_order_one(&twist, &scale);
                    let step = reach.cross(&twist, motion, torques && inner.is_some(), tolerance);
                    rows.join(&step, tolerance);
                }
                visible = Some(rows);
                reach
            }
        };
        if piece.is_some() {
            let rows = match (visible, inner) {
                (Some(rows), Some(_)) => rows,
                _ => {
                    let own = unknown.iter().filter(|&&(of, _)| Some(of) == piece);
                    let own = own.map(|(_, wrench)| of_length_one(wrench, &scale)).collect();
                    let axes = match measured {
                        Measured::Torques => Span::empty(),
                        Measured::Wrench | Measured::Both => Span::without(own, tolerance),
                    };
                    reach.begin(axes, tolerance);
                    reach.rows().clone()
                }
            };
            let hidden = Hidden::new(&rows, &scale, tolerance);
            invisible.push(Invisible {
                joint: inner.map(|_| numbers[number].saturating_sub(1)),
                link: numbers[number],
                directions: hidden.count(),
            });
            places[number] = members.len();
            members.push(Member {
                block: measured_numbers.partition_point(|&other| other < numbers[number]),
                inner: inner.map(|inner| (places[inner], placement)),
                hidden,
                offsets: attached
                    .iter()
                    .filter(|attached| attached.body == number)
                    .map(|attached| (attached.column, attached.carry))
                    .collect(),
            });
        }
        reaches[number] = Some(reach);
    }
    let assembled = assemble(&members, sensors, &scale, tolerance);
    Ok(Identifiable {
        columns: Vec::new(),
        names: Vec::new(),
        basis: assembled.basis,
        null: assembled.null,
        invisible,
        confused: assembled.confused,
    })
}

/// What the base attains. `held`: gravity and the freedoms that it has, none if it is free.
fn base_reach(held: Option<&(Vec3, Vec<(Motion, JointMotion)>)>, scale: &Scale, tolerance: f64) -> Reach {
    let Some((gravity, freedoms)) = held else {
        return Reach::free();
    };
    let mut reach = Reach::standing(&(gravity / -scale.acceleration));
    for (twist, motion) in freedoms {
        reach.cross(&of_order_one(twist, scale), *motion, false, tolerance);
    }
    reach
}

/// Pose of the outer body with moving freedoms at zero and locked ones where they are, and the freedoms in its frame then, each with a largest entry of
/// about one (its size says nothing: what counts is what it allows). `what` and `index` name them in an error.
fn at_reference(
    placement: &Pose,
    freedoms: &[Freedom],
    what: &'static str,
    index: impl Fn(usize) -> usize,
) -> Result<(Pose, Vec<(Motion, JointMotion)>), DynamicsError> {
    let mut outer = Pose::identity();
    let mut out = Vec::with_capacity(freedoms.len());
    for (number, freedom) in freedoms.iter().enumerate().rev() {
        let index = index(number);
        let Motion { angular, linear } = freedom.twist;
        let largest = angular.amax().max(linear.amax());
        let position = match freedom.motion {
            JointMotion::Locked(position) => position,
            JointMotion::Moving | JointMotion::Posed => 0.0,
        };
        let is_finite = angular.iter().chain(&linear).chain([&position]).all(|x| x.is_finite());
        if !is_finite {
            return Err(DynamicsError::NotFinite { what, index });
        }
        if largest == 0.0 {
            continue;
        }
        let twist = Motion {
            angular: angular / largest,
            linear: linear / largest,
        };
        out.push((outer.twist_back(&twist), freedom.motion));
        if position != 0.0 {
            let displacement = exponential(&twist, position * largest);
            check_size_of(&displacement.translation, what, index)?;
            outer = displacement * outer;
            check_size_of(&outer.translation, what, index)?;
        }
    }
    out.reverse();
    let pose = *placement * outer;
    check_size_of(&pose.translation, what, index(0))?;
    Ok((pose, out))
}

/// A twist in scaled units, of length one.
fn of_order_one(twist: &Motion, scale: &Scale) -> Motion {
    let Motion { angular, linear } = twist;
    let linear = linear / scale.length;
    let norm = angular.norm().hypot(linear.norm());
    Motion {
        angular: angular / norm,
        linear: linear / norm,
    }
}

/// A wrench in scaled units, [torque; force], of length one.
fn of_length_one(wrench: &Wrench, scale: &Scale) -> [f64; 6] {
    let (n, f) = (wrench.torque / scale.length, wrench.force);
    let norm = n.norm().hypot(f.norm());
    [n.x, n.y, n.z, f.x, f.y, f.z].map(|x| x / norm)
}

/// A contact's unknowns, each being one, as wrenches in the link's frame.
fn contact_wrenches(spec: &ContactSpec) -> Vec<Wrench> {
    let pose = &spec.frame.pose;
    let point = pose.point(&spec.position);
    let force = |along: Vec3| Wrench {
        torque: point.cross(&along),
        force: along,
    };
    let axes = [Vec3::x(), Vec3::y(), Vec3::z()];
    match spec.kind {
        ContactKind::Wrench => {
            let torques = axes.map(|torque| Wrench {
                torque,
                force: Vec3::zeros(),
            });
            torques.into_iter().chain(axes.map(force)).collect()
        }
        ContactKind::Force => axes.map(force).to_vec(),
        ContactKind::ForceAlong(direction) => vec![force(pose.rotation * direction)],
    }
}

/// The displacement by a constant twist, `exp(S q)`: a turn about its axis, and what goes along it.
fn exponential(twist: &Motion, q: f64) -> Pose {
    let rate = twist.angular.norm();
    if rate == 0.0 {
        return Pose {
            rotation: Mat3::identity(),
            translation: twist.linear * q,
        };
    }
    let (axis, v) = (twist.angular / rate, twist.linear / rate);
    let angle = rate * q;
    let cross = axis.cross_matrix();
    let (sine, versine) = (angle.sin(), 2.0 * (angle / 2.0).sin().powi(2));
    let along = axis * axis.dot(&v);
    Pose {
        rotation: Mat3::identity() + cross * sine + cross * cross * versine,
        translation: along * angle + (v - along) * sine + axis.cross(&v) * versine,
    }
}

fn scaled(pose: &Pose, scale: &Scale) -> Pose {
    Pose {
        rotation: pose.rotation,
        translation: pose.translation / scale.length,
    }
}

/// Nothing longer [m] or faster [m/s^2] can be computed with, and nothing below its inverse is worth a unit: the squares of lengths stand beside ones.
const LARGEST: f64 = 1e6;

/// The unit of lengths, or of accelerations: the largest, if it is one.
fn unit(sizes: impl Iterator<Item = f64>) -> f64 {
    let largest = sizes.fold(0.0, f64::max);
    if largest > 1.0 / LARGEST { largest } else { 1.0 }
}

fn check_size_of(vector: &Vec3, what: &'static str, index: usize) -> Result<(), DynamicsError> {
    if vector.iter().any(|x| !x.is_finite()) {
        return Err(DynamicsError::NotFinite { what, index });
    }
    if vector.amax() > LARGEST {
        return Err(DynamicsError::OutOfRange { what, index });
    }
    Ok(())
}

fn check_pose(pose: &Pose, tolerance: f64, what: &'static str, index: usize) -> Result<(), DynamicsError> {
    if !pose.is_finite() {
        return Err(DynamicsError::NotFinite { what, index });
    }
    check_size_of(&pose.translation, what, index)?;
    let r = &pose.rotation;
    let is_orthonormal = (r.tr_mul(r) - Mat3::identity()).amax() <= tolerance;
    if is_orthonormal && r.determinant() > 0.0 {
        Ok(())
    } else {
        Err(DynamicsError::NoRotation { what, index })
    }
}
