//! The result of an identification: figures, findings, series for plots.

pub(crate) mod assemble;
mod calibration;
mod comparison;
mod curves;
mod log;
pub(crate) mod outcome;
pub(crate) mod prediction;
pub(crate) mod uncertainty;
