//! Wrenches and torques as linear functions of the inertial parameters, and which combinations of these can be identified at all.
//!
//! ```text
//! Kinematics -> link_regressor:         net wrench of one link = A_l phi_l                                       eq. (8) to (10)
//!            -> Regressor:              [wrench on the base; joint torques] = Y phi, any base, any serialization  eq. (11), (12)
//!            -> StackedRegressor:       sub-tree by sub-tree, Y phi + O o - C x = what its F/T sensors read: identification is fed with it
//! Kinematics, Solver -> EstimateRows:   what the solver's torques and contact wrenches owe to parameters and offsets: carries a covariance
//!            -> Propagation:            the standard deviations that such a covariance gives them, all at once
//! joints' rows of either -> MotorRegressor: torques of the motors, through coupled joints, with rotor inertia and friction
//! Model, Regime -> Identifiable:        which combinations of phi and o can show in the rows of a Regressor or a StackedRegressor at all
//! ```
//!
//! The last is in [`identifiable`]; it sees no measurement, and it has its columns in the same order.
//!
//! Equation numbers are those of Traversaro et al. (ICRA 2015); notation, frames and signs are those of [`crate::spatial`]. Everything here is linear
//! in the parameters and holds for any ten numbers per link, those of bodies that cannot exist included. Room is made at construction; no `update`
//! allocates.
//!
//! # Columns
//! Ten per link, in the model's order of links unless a serialization says otherwise: `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` about
//! the origin and in the axes of the link ([`crate::spatial`]). Offsets of an F/T sensor follow in six columns `[torque; force]`, in its measurement
//! frame. An offset is what the sensor adds: raw reading = true reading + offset.
//!
//! # Where the speed comes from
//! - The poses and motions of the links are those of [`crate::dynamics::Kinematics`], computed once for everything.
//! - A link's six rows are brought to base coordinates once. There they are its part of the base's wrench already, and the row of each joint on the
//!   way to the base is one product along the joint's axis: nothing is transformed again at every joint.
//! - The six columns of the tensor of inertia make no force: half of each row's products are left out there.
//! - The ten columns of a link lie side by side in every row, so that loops of fixed length over them become vector instructions on any processor.
//! - Zeros are written once. They change only with the base, and then only in the rows of joints between the old one and the new.
//!
//! iCub V2.5, 32 joints, another state at every call, kinematics included, one core, one interleaved run with equal outputs (`tests/peers/run`; idle two-core
//! virtual machine, Intel Xeon); least and median of 100 rounds \[us\], and their time as a multiple of ours built alike, of the medians:
//!
//! | | 38 x 330, all fixed joints folded | 38 x 390, six F/T joints kept |
//! |---|---|---|
//! | [`Regressor`], plain x86-64 | 3.19 / 3.43 | 3.61 / 3.91 |
//! | [`Regressor`], `-C target-cpu=native` | 3.56 / 3.90 | 4.08 / 4.45 |
//! | Pinocchio 4.1.0, `-march=native` | 11.08 / 12.01 (3.1 x native) | |
//! | iDynTree 15.1.0, its wheel | 41.3 / 44.6 (13.0 x plain) | 48.8 / 52.5 (13.4 x plain) |
//!
//! The others, likewise with kinematics (1.6 us of each), 39 bodies, plain x86-64, `cargo bench -p proprio-estimator --bench regressor` on the same
//! machine, fastest of 100: [`Regressor`] with the base changing from foot to foot at every call 5.4; [`StackedRegressor`] with seven full wrenches
//! 4.3, without contacts and whitened 10.1; [`EstimateRows`] of all 32 torques, solution included, 13.5; [`Regressor`] and [`MotorRegressor`] with
//! all terms 7.1 us.
//!
//! How the cost grows with the robot is said at [`Regressor`].

mod estimate;
pub mod identifiable;
mod link;
mod motor;
mod propagate;
mod subtree;
mod tree;

pub use estimate::EstimateRows;
pub use link::link_regressor;
pub use motor::{Actuator, Coupling, MotorError, MotorRegressor, MotorTerm, Transmission};
pub use propagate::{Covariance, Propagation};
pub use subtree::{PresentContact, StackedRegressor, SubTreeRegressor, Weighting};
pub use tree::{Regressor, Serialization, SerializationError};
