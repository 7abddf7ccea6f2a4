//! The identifiable subspace of inertial parameters and sensor offsets, in closed form: which of
//! their combinations appear in the measurements.
//!
//! The paper's identifiable subspace `I_Y` (section III.A, eq. (6) and (7)) is the orthogonal
//! complement of the parameters that no motion excites. Usually its basis `B` comes from a rank
//! decision on sampled regressors. Here it follows from the geometry of the joints. This covers any
//! tree cut at any F/T sensors, a free base or one at rest, moving and locked joints, joint torques
//! instead of wrenches, and unknown sensor offsets. [`Identifiable::new`] decides ranks only of
//! matrices with at most sixteen columns (and of the offsets alone).
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
//! ten for a fixed one. A
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
//! chosen. Values above a million times their SI unit are errors. So all results are finite.

mod assemble;
mod expression;
mod pass;
mod reach;
mod regime;

use nalgebra::DMatrix;

use self::assemble::{Assembled, Composite, Hidden, assemble};
use self::pass::{Units, Visit, check_vector, contact_wrenches, pass, sides};
use self::reach::{Reach, Subspace};
use crate::error::{DynamicsError, check_size};
use crate::model::Model;
use crate::spatial::{Vec3, Wrench};
use crate::structure::Structure;

pub use expression::{BaseParameter, Term};
pub use regime::{BaseRegime, JointMotion, Measurement, Offsets, ParameterColumn, Regime, Scope};

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
    columns: Vec<ParameterColumn>,
    names: Vec<String>,
    assembled: Assembled,
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
        measured: Measurement,
        offsets: Offsets,
    ) -> Result<Self, DynamicsError> {
        check(model, scope, regime)?;
        let visits = pass(model, regime)?;
        let contacts = contact_wrenches(scope, regime, measured, &visits)?;
        let gravity = match &regime.motion {
            BaseRegime::Free => None,
            BaseRegime::Fixed(gravity) => {
                check_vector(gravity, "gravity of regime", 0)?;
                Some(*gravity)
            }
        };
        let recursion = Recursion {
            units: Units::of(&visits, gravity.as_ref()),
            visits,
            scope,
            measured,
            gravity,
            contacts,
            tolerance: regime.tolerance.clamp(1e-12, 1e-2),
        };
        let links: Vec<usize> = (0..model.link_count())
            .filter(|&link| scope.part_of(link).is_some())
            .collect();
        let sensors = match offsets {
            Offsets::Known => Vec::new(),
            Offsets::Unknown => scope.sensors(),
        };
        let composites = recursion.composites(model, &links, &sensors);
        let (units, tolerance) = (&recursion.units, recursion.tolerance);
        let assembled = assemble(&composites, sensors.len(), units, tolerance);
        let (columns, names) = labels(model, scope, &links, &sensors);
        Ok(Self {
            columns,
            names,
            assembled,
        })
    }

    /// `B`, columns x [`Identifiable::rank`]: orthonormal columns that span the identifiable
    /// subspace, so that `pi = B^T phi` are the base parameters of any `phi` and `B pi` is its
    /// identifiable part (eq. (7)).
    pub fn basis(&self) -> &DMatrix<f64> {
        &self.assembled.basis
    }

    /// Its dimension: the number of identifiable combinations.
    pub fn rank(&self) -> usize {
        self.assembled.basis.ncols()
    }

    /// The meaning of each column.
    pub fn columns(&self) -> &[ParameterColumn] {
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
        let vectors = &self.assembled.null;
        let mut null = DMatrix::zeros(self.columns.len(), vectors.len());
        for (k, vector) in vectors.iter().enumerate() {
            for &(column, entry) in &vector.entries {
                null[(column, k)] = entry;
            }
        }
        null
    }

    /// Number of directions lost to the offsets: rank without offsets + number of offset columns -
    /// rank with them. In these directions an offset and inertial parameters, or several offsets,
    /// are not separable in this regime.
    pub fn confused(&self) -> usize {
        self.assembled.confused
    }

    /// The base parameters as readable sums, one per dimension: see [`BaseParameter`].
    pub fn base_parameters(&self) -> Vec<BaseParameter> {
        expression::base_parameters(&self.names, &self.assembled.null)
    }
}

/// Refuses arguments that do not fit each other.
fn check(model: &Model, scope: Scope<'_>, regime: &Regime) -> Result<(), DynamicsError> {
    check_size(
        "joints of the regime",
        regime.joints.len(),
        model.dof_count(),
    )?;
    if regime.base >= model.link_count() {
        return Err(DynamicsError::NoLink(regime.base));
    }
    if let Some(structure) = scope.structure() {
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
    if !regime.tolerance.is_finite() {
        return Err(DynamicsError::NotFinite {
            what: "tolerance of regime",
            index: 0,
        });
    }
    Ok(())
}

/// The meaning and the name of each column.
fn labels(
    model: &Model,
    scope: Scope<'_>,
    links: &[usize],
    sensors: &[usize],
) -> (Vec<ParameterColumn>, Vec<String>) {
    const PARAMETERS: [&str; 10] = [
        "m", "h_x", "h_y", "h_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz",
    ];
    const COMPONENTS: [&str; 6] = ["t_x", "t_y", "t_z", "f_x", "f_y", "f_z"];
    let (mut columns, mut names) = (Vec::new(), Vec::new());
    for &link in links {
        let name = model.link_name(link);
        for (parameter, suffix) in PARAMETERS.iter().enumerate() {
            columns.push(ParameterColumn::Inertial { link, parameter });
            names.push(format!("{name}.{suffix}"));
        }
    }
    let cuts = scope.structure().map_or(&[][..], Structure::sensors);
    for &sensor in sensors {
        let name = model.joint_name(cuts[sensor].joint());
        for (component, suffix) in COMPONENTS.iter().enumerate() {
            columns.push(ParameterColumn::Offset { sensor, component });
            names.push(format!("{name}.{suffix}"));
        }
    }
    (columns, names)
}

/// The recursion of the spans from the base over all links.
struct Recursion<'a> {
    visits: Vec<Visit>,
    scope: Scope<'a>,
    measured: Measurement,
    /// None if the base is free.
    gravity: Option<Vec3>,
    /// See [`contact_wrenches`].
    contacts: Vec<(usize, Wrench)>,
    units: Units,
    tolerance: f64,
}

impl Recursion<'_> {
    /// The links of the scope, with what is hidden beyond the joint before each, in the order of
    /// the pass.
    fn composites(&self, model: &Model, links: &[usize], sensors: &[usize]) -> Vec<Composite> {
        let cuts = self.scope.structure().map_or(&[][..], Structure::sensors);
        let sides: Vec<_> = sensors.iter().map(|&k| sides(model, &cuts[k])).collect();
        let mut places = vec![0; self.visits.len()];
        let mut composites = Vec::with_capacity(links.len());
        for (number, (visit, hidden)) in self.visits.iter().zip(self.hidden()).enumerate() {
            let Some(hidden) = hidden else { continue };
            let offsets = sides.iter().enumerate().flat_map(|(column, sides)| {
                let carries = sides.iter().filter(|(link, _)| *link == visit.link);
                carries.map(move |(_, carry)| (column, *carry))
            });
            places[number] = composites.len();
            composites.push(Composite {
                block: links.partition_point(|&other| other < visit.link),
                inner: self
                    .inner(visit)
                    .map(|inner| (places[inner], visit.placement)),
                hidden,
                offsets: offsets.collect(),
            });
        }
        composites
    }

    /// The previous link, if it is in the same separately measured part.
    fn inner(&self, visit: &Visit) -> Option<usize> {
        let part = self.scope.part_of(visit.link)?;
        let of_parent = |&parent: &usize| self.scope.part_of(self.visits[parent].link);
        visit
            .parent
            .filter(|parent| of_parent(parent) == Some(part))
    }

    /// Per link of the pass, if it is in the scope, what is hidden beyond the joint before it.
    fn hidden(&self) -> Vec<Option<Hidden>> {
        let (units, tolerance) = (&self.units, self.tolerance);
        let torques = self.measured != Measurement::Wrench;
        let mut reaches: Vec<Reach> = Vec::with_capacity(self.visits.len());
        let mut all_hidden = Vec::with_capacity(self.visits.len());
        for visit in &self.visits {
            let (part, inner) = (self.scope.part_of(visit.link), self.inner(visit));
            let mut rows = Subspace::default();
            let mut reach = match (visit.parent, self.gravity) {
                (Some(parent), _) => reaches[parent].moved(&units.pose(&visit.placement)),
                (None, None) => Reach::free(),
                (None, Some(gravity)) => Reach::standing(&(gravity / -units.acceleration)),
            };
            if let Some((twist, moves)) = &visit.freedom {
                let measured = torques && inner.is_some();
                let reached = reach.cross(&units.twist(twist), *moves, measured, tolerance);
                rows.join(&reached, tolerance);
            }
            if let (Some(part), None) = (part, inner) {
                reach.begin(self.measured_twists(part), tolerance);
                rows = reach.rows().clone();
            }
            all_hidden.push(part.map(|_| Hidden::new(&rows, units, tolerance)));
            reaches.push(reach);
        }
        all_hidden
    }

    /// The twists along which the balance of a part is measured, where its pass begins.
    fn measured_twists(&self, part: usize) -> Subspace<6> {
        if self.measured == Measurement::Torques {
            return Subspace::default();
        }
        let applied = self.contacts.iter().filter(|(of, _)| *of == part);
        let unknown = applied
            .map(|(_, wrench)| self.units.wrench(wrench))
            .collect();
        Subspace::without(unknown, self.tolerance)
    }
}
