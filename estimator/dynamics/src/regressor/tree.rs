//! The regressor of the whole tree for any base and any serialization: the wrench on the base and
//! all joint torques.

use nalgebra::{Const, DMatrixView, DVector, Dyn};

use super::link::{LINK_PARAMETERS, WITH_FORCE, link_rows, row_along};
use crate::error::{DynamicsError, check_size};
use crate::kinematics::Kinematics;
use crate::model::{Joint, Model};
use crate::spatial::Motion;

/// The order of the columns of links and of the rows of degrees of freedom: the paper's
/// serializations of links and joints.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Serialization {
    /// Per link: its place.
    links: Vec<usize>,
    /// Per degree of freedom: its place.
    dofs: Vec<usize>,
}

impl Serialization {
    /// The order of the model.
    pub fn of_model(model: &Model) -> Self {
        Self {
            links: (0..model.link_count()).collect(),
            dofs: (0..model.dof_count()).collect(),
        }
    }

    /// Any order: the model's numbers of all links and of all degrees of freedom, in the new order.
    ///
    /// # Errors
    /// A list does not contain each number once.
    pub fn new(model: &Model, links: &[usize], dofs: &[usize]) -> Result<Self, SerializationError> {
        Ok(Self {
            links: places("links", links, model.link_count())?,
            dofs: places("degrees of freedom", dofs, model.dof_count())?,
        })
    }

    /// Number of links.
    pub fn link_count(&self) -> usize {
        self.links.len()
    }

    /// Number of degrees of freedom.
    pub fn dof_count(&self) -> usize {
        self.dofs.len()
    }

    /// The first of a link's ten columns; `None` if there is no such link.
    pub fn link_column(&self, link: usize) -> Option<usize> {
        self.links.get(link).map(|place| LINK_PARAMETERS * place)
    }

    /// Index of a degree of freedom among the joint rows; `None` if there is no such degree of
    /// freedom.
    pub fn dof_place(&self, dof: usize) -> Option<usize> {
        self.dofs.get(dof).copied()
    }

    /// `phi`: the ten parameters of every link of a model, in this order. A link that is not in the
    /// serialization is omitted.
    pub fn parameters(&self, model: &Model) -> DVector<f64> {
        let mut phi = DVector::zeros(LINK_PARAMETERS * self.links.len());
        for (inertia, &place) in model.inertias().iter().zip(&self.links) {
            phi.rows_mut(LINK_PARAMETERS * place, LINK_PARAMETERS)
                .copy_from_slice(&inertia.parameters());
        }
        phi
    }
}

/// The place of each number in the given order.
fn places(
    what: &'static str,
    order: &[usize],
    count: usize,
) -> Result<Vec<usize>, SerializationError> {
    if order.len() != count {
        return Err(SerializationError::Count {
            what,
            got: order.len(),
            expected: count,
        });
    }
    let mut places = vec![None; count];
    for (place, &number) in order.iter().enumerate() {
        match places.get_mut(number) {
            Some(slot @ None) => *slot = Some(place),
            Some(Some(_)) => return Err(SerializationError::Twice { what, number }),
            None => return Err(SerializationError::Unknown { what, number }),
        }
    }
    // There are as many numbers as places, and none occurs twice: every place is filled.
    Ok(places.into_iter().flatten().collect())
}

/// Why an order is not a serialization.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SerializationError {
    /// Too few or too many numbers.
    #[error("a serialization of {expected} {what} has {got} numbers")]
    Count {
        /// What is serialized.
        what: &'static str,
        /// How many were given.
        got: usize,
        /// How many there are.
        expected: usize,
    },
    /// A number that occurs twice.
    #[error("a serialization of {what} has number {number} twice")]
    Twice {
        /// What is serialized.
        what: &'static str,
        /// The number.
        number: usize,
    },
    /// A number that the model does not have.
    #[error("a serialization of {what} has number {number}, which the model does not have")]
    Unknown {
        /// What is serialized.
        what: &'static str,
        /// The number.
        number: usize,
    },
}

/// The next joint with a degree of freedom between a link and the base.
#[derive(Clone, Copy, Debug)]
struct Hop {
    dof: usize,
    /// The child of the joint.
    child: usize,
    /// Other joints have the same degree of freedom.
    is_shared: bool,
    /// The link on its other side.
    next: usize,
}

/// The regressor of the whole tree, `(6 + n) x 10 N_B`: `[f_b; tau] = Y phi`, paper eq. (11) and
/// (12).
///
/// - Rows 0 to 5, `Y_n`: the wrench by the environment on the base link [torque; force], at its
///   origin and in its axes.
/// - The other rows, `Y_c`: the joint torques [Nm] or forces [N], along the URDF axis, exerted by
///   the URDF parent on the URDF child, for any base.
/// - Columns: ten per link. A joint's row is zero for the links on the base's side of the joint.
///
/// Both are valid only while the base link is the only link in contact with the environment. A
/// wrench on another link adds to `Y phi`: its negative, transformed to the base, on the base; and
/// `-J^T f` on the torques of the joints between that link and the base (eq. (3) of the paper). If
/// such wrenches are unknown, use the equations of [`super::StackedRegressor`], or
/// [`super::EstimateRows`] for torques.
///
/// The matrix is dense, `10 N_B (6 + n)` numbers, so its size grows with the square of the size of
/// the robot. An update writes only the non-zero entries: six rows of ten for each link, and one
/// for each moving joint between it and the base. Its cost is the number of links times their mean
/// depth: linear for limbs of bounded length, quadratic for a chain. Measured with the kinematics
/// (benchmark `regressor`, `scaling`, plain x86-64, fastest of 100), robots of 8, 32, 128 and 500
/// links: 1.2, 4.4, 19 and 76 us with limbs of eight links on one root; 1.1, 4.7, 50 and 1370 us as
/// a chain, whose matrix of 20 MB fits no cache.
///
/// Rows are stored one after the other. Zeros are written once; when the kinematics start from
/// another base, only the rows of the joints between the old base and the new one change.
#[derive(Clone, Debug)]
pub struct Regressor {
    serialization: Serialization,
    values: Vec<f64>,
    /// Numbers in a row.
    stride: usize,
    /// The base of the current pattern of zeros; `None` before the first update.
    base: Option<usize>,
    /// Per joint: whether the base is on the side of the child.
    reversed: Vec<bool>,
    /// Per link: the next moving joint towards the base.
    hops: Vec<Option<Hop>>,
    /// Per link: the axis of the joint above in base coordinates, with the sign for which the net
    /// wrenches beyond the joint give its torque.
    axes: Vec<Motion>,
    /// Per degree of freedom: how many joints have it.
    sharing: Vec<usize>,
}

impl Regressor {
    /// For a model, in the model's order of links and degrees of freedom.
    pub fn new(model: &Model) -> Self {
        Self::room(model, Serialization::of_model(model))
    }

    /// For a model, in another order.
    ///
    /// # Errors
    /// The serialization is for another model.
    pub fn with_serialization(
        model: &Model,
        serialization: Serialization,
    ) -> Result<Self, DynamicsError> {
        check_size(
            "links of the serialization",
            serialization.link_count(),
            model.link_count(),
        )?;
        check_size(
            "degrees of freedom of the serialization",
            serialization.dof_count(),
            model.dof_count(),
        )?;
        Ok(Self::room(model, serialization))
    }

    fn room(model: &Model, serialization: Serialization) -> Self {
        let (links, dofs) = (serialization.link_count(), serialization.dof_count());
        let mut sharing = vec![0; dofs];
        let joints = model.joints().iter();
        (joints.filter_map(|joint| joint.dof)).for_each(|dof| sharing[dof] += 1);
        let stride = LINK_PARAMETERS * links;
        Self {
            serialization,
            values: vec![0.0; (6 + dofs) * stride],
            stride,
            base: None,
            reversed: vec![false; model.joint_count()],
            hops: vec![None; links],
            axes: vec![Motion::zero(); links],
            sharing,
        }
    }

    /// Computes the regressor from the links' poses and motions, for the base of these kinematics.
    /// The model's inertias are not used.
    ///
    /// # Errors
    /// The size of the model or of the kinematics differs from that at construction. Nothing is
    /// changed in that case.
    pub fn update(&mut self, model: &Model, kinematics: &Kinematics) -> Result<(), DynamicsError> {
        check_size("links of the model", model.link_count(), self.hops.len())?;
        check_size(
            "degrees of freedom of the model",
            model.dof_count(),
            self.serialization.dof_count(),
        )?;
        check_size(
            "links of the kinematics",
            kinematics.link_count(),
            self.hops.len(),
        )?;
        if self.base != Some(kinematics.base()) {
            self.rebase(model, kinematics);
        }
        for joint in model.joints() {
            if let Some(axis) = kinematics.joint_axis(joint) {
                self.axes[joint.child] = if self.reversed[joint.child - 1] {
                    -axis
                } else {
                    axis
                };
            }
        }
        fill(
            kinematics,
            &self.serialization,
            &self.hops,
            &self.axes,
            self.stride,
            &mut self.values,
        );
        Ok(())
    }

    /// Changes to the base of the kinematics: updates the joints between each link and the base,
    /// and the pattern of zeros of the affected rows.
    fn rebase(&mut self, model: &Model, kinematics: &Kinematics) {
        for (number, joint) in model.joints().iter().enumerate() {
            let reversed = kinematics.is_reversed(number);
            if std::mem::replace(&mut self.reversed[number], reversed) != reversed
                && let Some(dof) = joint.dof
            {
                let start = self.stride * (6 + self.serialization.dofs[dof]);
                self.values[start..start + self.stride].fill(0.0);
            }
        }
        let base = kinematics.base();
        let sharing = &self.sharing;
        let hop = |joint: &Joint, next| {
            joint.dof.map(|dof| Hop {
                dof,
                child: joint.child,
                is_shared: sharing[dof] > 1,
                next,
            })
        };
        self.hops[base] = None;
        // First from the base up to the root, whose next link towards the base is a child; then
        // down, parents first.
        let mut link = base;
        while link > 0 {
            let joint = &model.joints()[link - 1];
            self.hops[joint.parent] = hop(joint, link).or(self.hops[link]);
            link = joint.parent;
        }
        for (number, joint) in model.joints().iter().enumerate() {
            if !self.reversed[number] {
                let next = joint.parent;
                self.hops[joint.child] = hop(joint, next).or(self.hops[next]);
            }
        }
        self.base = Some(base);
    }

    /// The order of columns and rows.
    pub fn serialization(&self) -> &Serialization {
        &self.serialization
    }

    /// Number of rows, `6 + n`.
    pub fn row_count(&self) -> usize {
        6 + self.serialization.dof_count()
    }

    /// Number of columns, `10 N_B`.
    pub fn column_count(&self) -> usize {
        self.stride
    }

    /// A row: 0 to 5 for the wrench on the base [torque; force], then those of the joints.
    ///
    /// # Panics
    /// There is no such row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[self.stride * row..self.stride * (row + 1)]
    }

    /// The three rows of the torque on the base link: `n_b = rows phi` [Nm].
    pub fn base_torque_rows(&self) -> [&[f64]; 3] {
        [0, 1, 2].map(|row| self.row(row))
    }

    /// The three rows of the force on the base link: `f_b = rows phi` [N].
    pub fn base_force_rows(&self) -> [&[f64]; 3] {
        [3, 4, 5].map(|row| self.row(row))
    }

    /// The row of a joint's torque, by degree of freedom; `None` if there is no such degree of
    /// freedom.
    pub fn joint_row(&self, dof: usize) -> Option<&[f64]> {
        self.serialization
            .dof_place(dof)
            .map(|place| self.row(6 + place))
    }

    /// `Y^T`, `10 N_B x (6 + n)`, as a view: its columns are the rows of `Y`, so that `Y phi` is
    /// `transposed().tr_mul(&phi)`. There is no such view of `Y` itself because nalgebra 0.35.0
    /// writes out of bounds when it multiplies a view with contiguous rows (its issue 1616).
    pub fn transposed(&self) -> DMatrixView<'_, f64> {
        transposed_view(&self.values, self.stride, self.row_count(), self.stride)
    }
}

/// Writes all non-zero entries.
///
/// In base coordinates a link's six rows are its part of `Y_n` already; each joint between the link
/// and the base takes its row from them, as the component along its axis: six products per column
/// of mass and first moment, three for the others, whose force is zero.
#[inline(always)]
fn fill(
    kinematics: &Kinematics,
    serialization: &Serialization,
    hops: &[Option<Hop>],
    axes: &[Motion],
    stride: usize,
    values: &mut [f64],
) {
    let (wrench, joints) = values.split_at_mut(6 * stride);
    for (link, &place) in serialization.links.iter().enumerate() {
        let rows = link_rows(kinematics.pose(link), kinematics.motion(link));
        let column = LINK_PARAMETERS * place;
        for axis in 0..3 {
            if let Some(out) = wrench[axis * stride + column..].first_chunk_mut::<LINK_PARAMETERS>()
            {
                *out = rows[axis];
            }
            let force = &mut wrench[(axis + 3) * stride + column..][..WITH_FORCE];
            force.copy_from_slice(&rows[axis + 3][..WITH_FORCE]);
        }
        let path = || std::iter::successors(hops[link], |hop| hops[hop.next]);
        let start = |hop: &Hop| stride * serialization.dofs[hop.dof] + column;
        for hop in path().filter(|hop| hop.is_shared) {
            joints[start(&hop)..][..LINK_PARAMETERS].fill(0.0);
        }
        for hop in path() {
            if let Some(out) = joints[start(&hop)..].first_chunk_mut::<LINK_PARAMETERS>() {
                let row = row_along(&axes[hop.child], &rows);
                if hop.is_shared {
                    out.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
                } else {
                    *out = row;
                }
            }
        }
    }
}

/// Consecutive rows as the columns of a matrix: `count` rows of `width` numbers, `stride` apart.
///
/// Not as rows: in products, nalgebra 0.35.0 takes the bounding length of a strided column for its
/// number of elements, and writes past the end of the result (its issue 1616).
pub(super) fn transposed_view(
    values: &[f64],
    width: usize,
    count: usize,
    stride: usize,
) -> DMatrixView<'_, f64> {
    DMatrixView::from_slice_with_strides_generic(
        values,
        Dyn(width),
        Dyn(count),
        Const::<1>,
        Dyn(stride),
    )
}
