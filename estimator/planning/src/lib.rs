#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

pub mod excite;
pub mod knowledge;
pub mod motion;
pub mod workspace;
