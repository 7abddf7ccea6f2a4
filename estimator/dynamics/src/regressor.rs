//! Regressors: wrenches and torques as linear functions of the inertial parameters, and the
//! combinations of these parameters that can be identified.
//!
//! | from | to | result | paper |
//! |---|---|---|---|
//! | `Kinematics` | [`link_regressor`] | net wrench of a link `= A_l phi_l` | (8) to (10) |
//! | `Kinematics` | [`Regressor`] | [base wrench; joint torques] `= Y phi` | (11), (12) |
//! | `Kinematics` | [`StackedRegressor`] | F/T readings `= Y phi + O o - C x` | |
//! | `Kinematics`, `Solver` | [`EstimateRows`] | torques and contact wrenches of `phi`, `o` | |
//! | rows of joints | [`MotorRegressor`] | motor torques | |
//! | `Model`, regime | [`identifiable`] | identifiable combinations of `phi` and `o` | (6), (7) |
//!
//! - [`Regressor`] is for any base and any serialization.
//! - [`StackedRegressor`] has the equations of each sub-tree; identification uses it.
//! - [`EstimateRows`] carries a covariance of parameters and offsets to the results of
//!   [`crate::Solver`].
//! - [`MotorRegressor`] takes the joint rows of either regressor through coupled joints to the
//!   motors, and adds rotor inertia and friction.
//! - [`identifiable`] uses no measurement. It computes the combinations that can appear in the rows
//!   of a [`Regressor`] or a [`StackedRegressor`] at all; its columns have the same order.
//!
//! Equation numbers are those of Traversaro et al. (ICRA 2015); notation, frames and signs are
//! those of [`crate::spatial`]. Everything here is linear in the parameters and is valid for any
//! ten numbers per link, also for physically inconsistent ones. Memory is allocated at
//! construction; no `update` allocates.
//!
//! # Columns
//! Ten per link, in the model's order of links unless a serialization gives another order:
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
//! - Zeros are written once. They change only with the base, and then only in the rows of joints
//!   between the old base and the new one.
//!
//! iCub V2.5, 32 joints, another state at every call, kinematics included, one core, one
//! interleaved run with equal outputs (`tests/peers/run`; idle two-core virtual machine, Intel
//! Xeon). Least / median of 100 rounds \[us\], and the ratio of the medians to ours built alike:
//!
//! | | 38 x 330, all fixed joints folded | 38 x 390, six F/T joints kept |
//! |---|---|---|
//! | [`Regressor`], plain x86-64 | 3.19 / 3.43 | 3.61 / 3.91 |
//! | [`Regressor`], `-C target-cpu=native` | 3.56 / 3.90 | 4.08 / 4.45 |
//! | Pinocchio 4.1.0, `-march=native` | 11.08 / 12.01 (3.1 x native) | |
//! | iDynTree 15.1.0, its wheel | 41.3 / 44.6 (13.0 x plain) | 48.8 / 52.5 (13.4 x plain) |
//!
//! The others, also with kinematics (1.6 us of each), 39 bodies, plain x86-64,
//! `cargo bench -p proprio-dynamics --bench regressor` on the same machine, fastest of 100 \[us\]:
//!
//! | | |
//! |---|---|
//! | [`Regressor`], the base changing from foot to foot at every call | 5.4 |
//! | [`StackedRegressor`], seven full wrenches | 4.3 |
//! | [`StackedRegressor`], without contacts, whitened | 10.1 |
//! | [`EstimateRows`] of all 32 torques, solution included | 13.5 |
//! | [`Regressor`] and [`MotorRegressor`] with all terms | 7.1 |
//!
//! The growth of the cost with the size of the robot is documented at [`Regressor`].

mod estimate;
pub mod identifiable;
mod link;
mod motor;
mod subtree;
mod tree;

pub use estimate::EstimateRows;
pub use link::{LINK_PARAMETERS, LinkRows, WITH_FORCE, link_regressor, link_rows};
pub use motor::{Actuator, Coupling, MotorError, MotorRegressor, MotorTerm, Transmission};
pub use subtree::{PresentContact, StackedRegressor, SubTreeRegressor, Weighting};
pub use tree::{Regressor, Serialization, SerializationError};
