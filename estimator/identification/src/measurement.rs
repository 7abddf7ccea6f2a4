//! The measurement model: the equations of one observation, and the reduction of a log to
//! information about the parameters.

pub(crate) mod channels;
pub(crate) mod model;
pub(crate) mod noise_estimate;
pub(crate) mod noise_model;
pub(crate) mod reduction;
pub(crate) mod rows;
pub(crate) mod seconds;
pub(crate) mod unknowns;
