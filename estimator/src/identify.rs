//! Identifies a robot's inertial parameters, and the offsets of its F/T sensors, from what they measure while it moves.

pub mod consistent;
pub mod information;
pub mod instants;
pub mod prior;
