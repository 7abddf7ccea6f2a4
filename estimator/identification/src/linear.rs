//! Linear estimation: square-root information, the filter of nuisance parameters, noise, and the
//! loops they run in.

pub(crate) mod blocked;
pub mod information;
pub(crate) mod noise;
pub(crate) mod nuisance;
pub(crate) mod simd;
