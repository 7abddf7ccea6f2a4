//! Plans the identification of a robot: what its force/torque (F/T) sensors can tell of its joint
//! torques at all, and which motion tells the most.
//!
//! - [`knowledge`]: the closed form. Which combinations of parameters a set of sensors identifies
//!   ([`proprio_dynamics::regressor::identifiable`]), which torques rest on them and which on CAD
//!   for ever, and the standard deviation of each torque in the end.
//! - [`motion`]: Fourier series with a soft start and stop, within the limits of the joints and
//!   boxes for links.
//! - [`excite`]: the motion that lessens the deviations of torques the most, and what they will be
//!   after it, by the forecast of the identification itself
//!   ([`proprio_identification::forecast`]).
//! - [`workspace`]: the states at which torques are wanted, and their deviations there for a
//!   covariance of the parameters.
//!
//! Everything is computed from a seed, and so the same every time.

pub mod excite;
pub mod knowledge;
pub mod motion;
pub mod workspace;
