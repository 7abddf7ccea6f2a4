//! Detectors of errors of sensors, logs and model. Each returns its findings.

pub(crate) mod delay;
pub(crate) mod disturbance;
pub(crate) mod encoder_offsets;
pub(crate) mod gravity;
pub(crate) mod load;
pub(crate) mod plausibility;
pub(crate) mod sensor_frame;
pub(crate) mod torque_units;
pub(crate) mod undeclared;
pub(crate) mod wrench_units;
