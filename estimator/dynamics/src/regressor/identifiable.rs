//! The identifiable subspace of inertial parameters and sensor offsets, in closed form: which of
//! their combinations appear in the measurements.
//!
//! The paper's identifiable subspace `I_Y` (section III.A, eq. (6) and (7)) is the orthogonal
//! complement of the parameters that no motion excites. Usually its basis `B` comes from a rank
//! decision on sampled regressors. Here it follows from the geometry of the joints. This covers any
//! tree cut at any F/T sensors, a base of restricted motion, joints in static postures only, joint
//! torques instead of wrenches, and unknown sensor offsets. [`Identifiable::new`] decides ranks
//! only of matrices with at most sixteen columns (and of the offsets alone).
//!
//! # How
//! A body's ten parameters are a symmetric 4 x 4 matrix, the pseudo-inertia `J`
//! ([`crate::spatial::RigidInertia::pseudo_inertia`]); the acceleration of its points is `D r`,
//! `r = [x, y, z, 1]`, with
//!
//! ```text
//! D = [S(alpha) + S(omega)^2, a; 0, 0]          a: proper acceleration of the origin
//! D J - J D^T = [S(n), f; -f^T, 0]              net wrench of the body
//! tr(E^T D J)                                   its component along the twist E
//! ```
//!
//! where `E = [S(e), e_0; 0, 0]`.
//!
//! Let `theta` be the inertia of all bodies beyond a joint, frozen at a reference position, in the
//! frame of the joint's outer body, and `S` a twist that the joint allows. The joint moves `theta`
//! as `X theta X^T`, `X = exp(S q)`, and
//!
//! ```text
//! D_c = X^-1 (D_p + 2 S(omega_p) S dq + S^2 dq^2 + S ddq) X
//! ```
//!
//! is the `D` of the outer body. As `q`, `dq`, `ddq` are free, `theta` leaves the measurements
//! unchanged, compared with the same body frozen, if and only if each coefficient does. These are
//! linear conditions on `theta`. Only the *linear spans* of the quantities that the bodies attain
//! matter: of `(D, 1)`, of `omega`, and of the rows `sym(E^T D)`. These spans are computed
//! recursively from body to body. With a free base and a measured wrench the spans are the whole
//! spaces, and the condition is
//!
//! ```text
//! S theta = 0    for every twist S that the joint allows
//! ```
//!
//! Its solutions `theta` are point masses in the kernel of all `S`. These are three directions for
//! a revolute joint (mass, first moment and second moment along the axis), six for a prismatic one,
//! ten for a fixed one, one for helical, cylindrical, universal, spherical and planar joints. A
//! null vector is such a `theta` on the joint's outer body and its opposite on the inner one. The
//! null space is their direct sum: `10 N_B - sum n_j` combinations are identifiable. For restricted
//! base motion compare Wensing, Niemeyer and Slotine, arXiv:1711.03896 (for joint torques); here
//! wrenches, offsets and postures follow from the same recursion.
//!
//! # Contacts
//! With unknown contacts that are always present, only those twists `E` remain along which no
//! contact does work, `E . c = 0`. On the link where the pass through a sub-tree begins (the base,
//! or the link beyond the sensor towards it) these twists are constant, and the recursion starts
//! from them instead of all six. If the unknowns span all six, only the torques beyond remain of
//! the sub-tree. If only wrenches are measured, a contact with six unknowns does so on any link.
//! The recursion does not cover fewer unknowns on another link, or torques together with contacts
//! beyond their joints; these cases are errors.
//!
//! # Speed
//! The number of operations grows with the square of the number of links, as does the size of the
//! basis. To measure: `cargo bench -p proprio-dynamics --bench identifiable`.
//!
//! # Tolerance
//! Spans are compared in units in which lengths (the largest distance between neighbouring joints),
//! accelerations (gravity) and twists are of order one. A direction counts as new if its part
//! outside a span exceeds [`Regime::tolerance`]. Angles with nine digits in the URDF thus count as
//! exact. With fewer digits, axes that should be parallel are not, and a larger tolerance is
//! needed.
//!
//! Lengths and gravity below a millionth of their SI unit count as zero when these units are
//! chosen. Values above a million times their SI unit are errors, as are rotations that are not
//! orthonormal to the tolerance. So all results are finite.

mod scaling;

mod tree;

use crate::regressor::identifiable::scaling::{
    check_pose, check_size_of, contact_wrenches, of_length_one, of_order_one, scaled, unit,
};
use crate::regressor::identifiable::tree::{Attached, at_reference, base_reach, route, sides};
mod assemble;
mod expression;
mod reach;
mod regime;

use nalgebra::{DMatrix, SMatrix};

use self::assemble::{Hidden, Member, NullVector, Scale, assemble};
use self::reach::{Reach, Span};
use crate::error::{DynamicsError, check_size};
use crate::model::Model;
use crate::spatial::{Pose, Wrench};
use crate::structure::{ContactKind, Structure};

pub use expression::{BaseParameter, Term};
pub use regime::{
    BaseRegime, Body, Column, Freedom, Invisible, JointMotion, Measured, Offsets, Regime, Scope,
};

/// The identifiable subspace of inertial parameters, with or without offsets.
///
/// Columns: ten per link of the scope, links ascending; then, with unknown offsets, six per sensor
/// of the scope, sensors ascending, `[torque; force]` in the measurement frame, so that reading =
/// true wrench + offset. An offset enters the balance of a sub-tree as
///
/// ```text
/// Y phi + O o = sum of the raw readings' wrenches
/// O o = sum of +- SensorCut::transmitted(o)
/// ```
///
/// with `+` for the sensor above the sub-tree's top link, where `transmitted` is the wrench by the
/// parent on that link, and `-` for the sensors below.
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
    /// There is no such base or sub-tree, the regime or the structure is for another model, a
    /// number of the regime is not finite, the model or the regime has lengths or accelerations
    /// that are too large ([Tolerance](self#tolerance)), or contacts for which there is no closed
    /// form ([Contacts](self#contacts)).
    pub fn new(
        model: &Model,
        scope: Scope<'_>,
        regime: &Regime,
        measured: Measured,
        offsets: Offsets,
    ) -> Result<Self, DynamicsError> {
        check_size(
            "joints of the regime",
            regime.joints.len(),
            model.dof_count(),
        )?;
        if regime.base >= model.link_count() {
            return Err(DynamicsError::NoLink(regime.base));
        }
        let structure = match scope {
            Scope::Tree => None,
            Scope::SubTree(structure, _) | Scope::SubTrees(structure) => Some(structure),
        };
        if let Some(structure) = structure {
            check_size(
                "links of the structure",
                structure.link_count(),
                model.link_count(),
            )?;
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
        // The separately measured parts of the robot: numbers of sub-trees, or one number for all
        // links of a whole tree.
        let piece = |link: usize| match scope {
            Scope::Tree => Some(0),
            Scope::SubTree(structure, number) => {
                structure.subtree_of(link).filter(|&of| of == number)
            }
            Scope::SubTrees(structure) => structure.subtree_of(link),
        };
        let route = route(model, regime.base);
        let place = |link: usize| route.iter().position(|step| step.link == link).unwrap_or(0);
        let bodies: Vec<Body> = route.iter().map(|step| step.body(model, regime)).collect();
        let links: Vec<usize> = (0..model.link_count())
            .filter(|&link| piece(link).is_some())
            .collect();
        let sensors: Vec<usize> = match (scope, offsets) {
            (_, Offsets::Known) => Vec::new(),
            (Scope::Tree, Offsets::Unknown) => vec![0],
            (Scope::SubTree(structure, number), Offsets::Unknown) => {
                structure.subtrees()[number].sensors.iter().collect()
            }
            (Scope::SubTrees(structure), Offsets::Unknown) => {
                (0..structure.sensors().len()).collect()
            }
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
            let Some(number) = piece(spec.frame.link) else {
                continue;
            };
            let first = route.iter().find(|step| piece(step.link) == Some(number));
            let is_first = first.is_some_and(|step| step.link == spec.frame.link);
            // Its place is irrelevant if it removes the whole balance and nothing else is measured.
            if !is_first && (spec.kind != ContactKind::Wrench || measured != Measured::Wrench) {
                return Err(DynamicsError::Contact(contact));
            }
            unknown.extend(
                contact_wrenches(spec)
                    .into_iter()
                    .map(|wrench| (number, wrench)),
            );
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

    /// Computes the subspace of a mechanism with joints of any type; body 0 is its base. The motion
    /// of the base is given by `motion` alone: its `placement` and `joint` are ignored. An unknown
    /// offset is that of the wrench on the base, in its frame.
    ///
    /// # Errors
    /// There is no body, the number of a parent is not smaller than that of its body, a number is
    /// not finite, a rotation is invalid, or a length or acceleration is too large
    /// ([Tolerance](self#tolerance)).
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
        // Depth first, so that the bodies beyond a body come directly after it.
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
        found.label(
            &links,
            |body| format!("body{body}"),
            &sensors,
            |_| "base".to_owned(),
        );
        Ok(found)
    }

    /// `B`, columns x [`Identifiable::rank`]: orthonormal columns that span the identifiable
    /// subspace, so that `pi = B^T phi` are the base parameters of any `phi` and `B pi` is its
    /// identifiable part (eq. (7)).
    pub fn basis(&self) -> &DMatrix<f64> {
        &self.basis
    }

    /// Its dimension: the number of identifiable combinations.
    pub fn rank(&self) -> usize {
        self.basis.ncols()
    }

    /// The meaning of each column.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Name of each column, such as `l_hand.m` or `l_arm_ft_sensor.f_x`.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// A basis of the null space, columns x (columns - rank). Its columns are sparse and readable,
    /// not orthonormal: each is a transfer of inertia between the two links of a joint, or
    /// unobservable parameters of a single link. The last [`Identifiable::confused`] ones state
    /// which offset is not separable from which parameters.
    pub fn null(&self) -> DMatrix<f64> {
        let mut null = DMatrix::zeros(self.columns.len(), self.null.len());
        for (k, vector) in self.null.iter().enumerate() {
            for &(column, entry) in &vector.entries {
                null[(column, k)] = entry;
            }
        }
        null
    }

    /// Per joint within the scope, and for the first link of each part, the number of unobservable
    /// directions, in the order of a pass from the base.
    pub fn invisible(&self) -> &[Invisible] {
        &self.invisible
    }

    /// Number of directions lost to the offsets: rank without offsets + number of offset columns -
    /// rank with them. In these directions an offset and inertial parameters, or several offsets,
    /// are not separable in this regime.
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
        const PARAMETERS: [&str; 10] = [
            "m", "h_x", "h_y", "h_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz",
        ];
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

/// Visits the bodies, which are depth first. `pieces`: the measured part to which each body
/// belongs. `numbers`: the caller's numbers, which give the order of the columns of measured parts.
/// `unknown`: per part, unknown wrenches that are always present, in the frame of its first body.
#[expect(
    clippy::too_many_arguments,
    reason = "the one place where both entries meet"
)]
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
        joints.push(at_reference(
            &body.placement,
            &body.joint,
            "joint to link",
            |_| number,
        )?);
    }
    let held = match motion {
        BaseRegime::Free => None,
        BaseRegime::Restricted { gravity, joints } => {
            check_size_of(gravity, "gravity of regime", 0)?;
            let (world, freedoms) =
                at_reference(&Pose::identity(), joints, "joint of the base", |index| {
                    index
                })?;
            Some((world.rotation.tr_mul(gravity), freedoms))
        }
    };
    let scale = Scale {
        length: unit(
            joints
                .iter()
                .skip(1)
                .map(|(placement, _)| placement.translation.norm()),
        ),
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
    // Bodies between the base and a measured one are needed too.
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
        let inner = body
            .parent
            .filter(|&parent| piece.is_some() && pieces[parent] == piece);
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
                    let own = own
                        .map(|(_, wrench)| of_length_one(wrench, &scale))
                        .collect();
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
