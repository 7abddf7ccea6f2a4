//! Regressors: wrenches and torques as linear functions of the inertial parameters, and the
//! combinations of these parameters that can be identified.
//!
//! | from | to | result | paper |
//! |---|---|---|---|
//! | `Kinematics` | [`link_regressor`] | net wrench of a link `= A_l phi_l` | (8) to (10) |
//! | `Kinematics` | [`Regressor`] | [base wrench; joint torques] `= Y phi` | (11), (12) |
//! | `Kinematics` | [`StackedRegressor`] | F/T readings `= Y phi + O o - C x` | |
//! | `Kinematics`, `Solver` | [`EstimateRows`] | torques of `phi`, `o` | |
//! | `Model`, regime | [`identifiable`] | identifiable combinations of `phi` and `o` | (6), (7) |
//!
//! - [`Regressor`] is for any base.
//! - [`StackedRegressor`] has the equations of each sub-tree; identification uses it.
//! - [`EstimateRows`] carries a covariance of parameters and offsets to the torques of
//!   [`crate::Solver`].
//! - [`identifiable`] uses no measurement. It computes the combinations that can appear in the rows
//!   of a [`Regressor`] or a [`StackedRegressor`] at all; its columns have the same order.
//!
//! Equation numbers are those of Traversaro et al. (ICRA 2015); notation, frames and signs are
//! those of [`crate::spatial`]. Everything here is linear in the parameters and is valid for any
//! ten numbers per link, also for physically inconsistent ones. Memory is allocated at
//! construction; no `update` allocates.
//!
//! # Columns
//! Ten per link, in the model's order of links:
//! `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` about the origin and in the axes of the
//! link ([`crate::spatial`]). Offsets of an F/T sensor follow in six columns `[torque; force]`, in
//! its measurement frame. An offset is what the sensor adds: raw reading = true reading + offset.
//!
//! # Sources of the speed
//! - The poses and motions of the links are those of [`crate::Kinematics`], computed once for
//!   everything.
//! - The six rows of a link are transformed to base coordinates once. There they are its part of
//!   the base wrench already, and the row of each joint between the link and the base is one
//!   product along the joint's axis; no joint needs a further transform.
//! - The six columns of the tensor of inertia have no force: half of the products of each row are
//!   omitted there.
//! - The ten columns of a link are adjacent in every row, so that loops of fixed length over them
//!   become vector instructions on any processor.
//! - Zeros are written once. They change only with the base.
//!
//! The growth of the cost with the size of the robot is documented at [`Regressor`]; speeds are in
//! docs/book/src/figures/speed.md.

mod estimate;
pub mod identifiable;
mod link;
mod subtree;
mod tree;

pub use estimate::EstimateRows;
pub use link::{LINK_PARAMETERS, LinkRows, WITH_FORCE, link_regressor, link_rows};
pub use subtree::{PresentContact, StackedRegressor, SubTreeRegressor};
pub use tree::Regressor;
