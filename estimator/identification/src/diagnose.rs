//! Detectors of errors of sensors, logs and model. Each returns its findings.

pub(crate) mod configuration;
pub(crate) mod disturbance;
pub(crate) mod load;
pub(crate) mod plausibility;
pub(crate) mod search;
pub(crate) mod undeclared;
