//! The regressor of the whole tree for any base: the wrench on the base and all joint torques.

use super::link::{LINK_PARAMETERS, WITH_FORCE, link_rows, row_along};
use crate::error::{DynamicsError, check_sizes};
use crate::kinematics::Kinematics;
use crate::model::{Joint, Model};
use crate::spatial::Motion;

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
/// - The other rows, `Y_c`: the joint torques \[Nm\] or forces \[N\], along the URDF axis, exerted
///   by the URDF parent on the URDF child, for any base.
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
/// depth: linear for limbs of bounded length, quadratic for a chain.
///
/// Rows are stored one after the other. Zeros are written when the kinematics start from another
/// base.
#[derive(Clone, Debug)]
pub struct Regressor {
    values: Vec<f64>,
    /// Numbers in a row.
    stride: usize,
    /// The base of the current pattern of zeros; `None` before the first update.
    base: Option<usize>,
    /// Per link: the next moving joint towards the base.
    hops: Vec<Option<Hop>>,
    /// Per link: the axis of the joint above in base coordinates, with the sign for which the net
    /// wrenches beyond the joint give its torque.
    axes: Vec<Motion>,
    /// Per degree of freedom: how many joints have it.
    sharing: Vec<usize>,
}

impl Regressor {
    /// For a model, in its order of links and degrees of freedom.
    pub fn new(model: &Model) -> Self {
        let (links, dofs) = (model.link_count(), model.dof_count());
        let mut sharing = vec![0; dofs];
        let joints = model.joints().iter();
        (joints.filter_map(|joint| joint.dof)).for_each(|dof| sharing[dof] += 1);
        let stride = LINK_PARAMETERS * links;
        Self {
            values: vec![0.0; (6 + dofs) * stride],
            stride,
            base: None,
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
        let (links, dofs) = (self.hops.len(), self.sharing.len());
        check_sizes([
            ("links of the model", model.link_count(), links),
            ("degrees of freedom of the model", model.dof_count(), dofs),
            ("links of the kinematics", kinematics.link_count(), links),
        ])?;
        if self.base != Some(kinematics.base()) {
            self.rebase(model, kinematics);
        }
        for (number, joint) in model.joints().iter().enumerate() {
            if let Some(axis) = kinematics.joint_axis(joint) {
                let is_reversed = kinematics.is_reversed(number);
                self.axes[joint.child] = if is_reversed { -axis } else { axis };
            }
        }
        self.fill(kinematics);
        Ok(())
    }

    /// Changes to the base of the kinematics: updates the joints between each link and the base,
    /// and writes the zeros of the joints' rows.
    fn rebase(&mut self, model: &Model, kinematics: &Kinematics) {
        self.values[6 * self.stride..].fill(0.0);
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
            if !kinematics.is_reversed(number) {
                let next = joint.parent;
                self.hops[joint.child] = hop(joint, next).or(self.hops[next]);
            }
        }
        self.base = Some(base);
    }

    /// Writes all non-zero entries.
    ///
    /// In base coordinates a link's six rows are its part of `Y_n` already; each joint between the
    /// link and the base takes its row from them, as the component along its axis: six products per
    /// column of mass and first moment, three for the others, whose force is zero.
    #[inline(always)]
    fn fill(&mut self, kinematics: &Kinematics) {
        let Self {
            values,
            stride,
            hops,
            axes,
            ..
        } = self;
        let stride = *stride;
        let (wrench, joints) = values.split_at_mut(6 * stride);
        for (link, hop) in hops.iter().enumerate() {
            let rows = link_rows(kinematics.pose(link), kinematics.motion(link));
            let column = LINK_PARAMETERS * link;
            for axis in 0..3 {
                if let Some(out) =
                    wrench[axis * stride + column..].first_chunk_mut::<LINK_PARAMETERS>()
                {
                    *out = rows[axis];
                }
                let force = &mut wrench[(axis + 3) * stride + column..][..WITH_FORCE];
                force.copy_from_slice(&rows[axis + 3][..WITH_FORCE]);
            }
            let path = || std::iter::successors(*hop, |hop| hops[hop.next]);
            let start = |hop: &Hop| stride * hop.dof + column;
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

    /// A row: 0 to 5 for the wrench on the base [torque; force], then those of the joints.
    ///
    /// # Panics
    /// There is no such row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[self.stride * row..self.stride * (row + 1)]
    }

    /// The row of a joint's torque, by degree of freedom; `None` if there is no such degree of
    /// freedom.
    pub fn joint_row(&self, dof: usize) -> Option<&[f64]> {
        (dof < self.sharing.len()).then(|| self.row(6 + dof))
    }
}
