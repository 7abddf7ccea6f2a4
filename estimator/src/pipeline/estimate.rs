//! The pipeline's output: estimates, and counts of samples.

use proprio_topics::{
    ContactEstimate, ContactWrench, Header, JointTorque, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES,
    Nanos, Residual, TorqueEstimate,
};

/// The torques and contact wrenches of one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// The instant.
    pub t: Nanos,
    /// The joint torques. Only `acquired` of the header is set.
    pub torques: TorqueEstimate,
    /// The contact wrenches and residuals. Only `acquired` of the header is set.
    pub contacts: ContactEstimate,
}

impl Estimate {
    /// An estimate at `t` without values.
    #[must_use]
    pub fn absent(t: Nanos) -> Self {
        let header = Header {
            acquired: t,
            ..Header::default()
        };
        Self {
            t,
            torques: TorqueEstimate {
                header,
                count: 0,
                reserved: 0,
                joints: [JointTorque::ABSENT; MAX_JOINTS],
            },
            contacts: ContactEstimate {
                header,
                count: 0,
                residual_count: 0,
                contacts: [ContactWrench::ABSENT; MAX_CONTACTS],
                residuals: [Residual::ABSENT; MAX_SUBTREES],
            },
        }
    }
}

/// How many samples were taken and dropped.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Taken.
    pub taken: u64,
    /// Too late: dropped because their instant had been released, or taken after the release of an
    /// instant that would have used them.
    pub late: u64,
    /// Dropped: stamped no later than the last sample of their channel.
    pub backward: u64,
    /// Dropped: a value is not finite.
    pub not_finite: u64,
}
