#![doc = include_str!("../README.md")]

pub mod excite;
pub mod knowledge;
pub mod motion;
pub mod workspace;
