//! What the estimator has identified so far: each link's inertial parameters, each F/T sensor's offset, with their standard deviations and what they rest on.
//!
//! About once a second. A reader that comes late gets the last one.

use crate::{Header, MAX_LINKS, MAX_SENSORS, Name};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// One link that is identified.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct LinkInertia {
    /// The link, as the model names it.
    pub name: Name,
    /// Mass \[kg\]; mass times centre of mass, x y z \[kg m\]; rotational inertia Ixx Ixy Ixz Iyy Iyz Izz \[kg m²\]: about the origin of the link's frame, in its axes.
    ///
    /// Always those of a body that can exist. Only combinations of several links' parameters can be told from forces: single ones may be far from the truth where their
    /// standard deviations say so, and torques right all the same.
    pub parameters: [f64; 10],
    /// Their standard deviations, in the same order and units; NaN where nothing is known.
    pub standard_deviation: [f64; 10],
    /// For how long the robot has moved in what was learnt from since the estimator began \[s\].
    pub motion: f64,
    /// Rows that were learnt from since then: at most six for each part of the robot between F/T sensors at each instant.
    pub rows: u64,
    /// Links and sensors with the same number are identified together, from the same rows.
    pub group: u32,
    /// 1 if this is found from the data up to the header's `acquired`. 0 if there is nothing, or no body that can exist fits it: then it is what was in force before,
    /// the model's own at first.
    pub accepted: u32,
}

impl LinkInertia {
    /// Nothing identified.
    pub const ABSENT: Self = Self {
        name: Name::EMPTY,
        parameters: [f64::NAN; 10],
        standard_deviation: [f64::NAN; 10],
        motion: 0.0,
        rows: 0,
        group: 0,
        accepted: 0,
    };
}

/// The offset of one F/T sensor: what it reads with no load.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct SensorOffset {
    /// The sensor's channel.
    pub name: Name,
    /// Force \[N\], in the sensor's measurement frame.
    pub force: [f64; 3],
    /// Torque \[Nm\], likewise.
    pub torque: [f64; 3],
    /// Standard deviations of force \[N\] and torque \[Nm\] at the header's `acquired`; NaN where nothing is known. Offsets wander: later they are less certain.
    pub standard_deviation: [f64; 6],
    /// As [`LinkInertia::group`].
    pub group: u32,
    /// As [`LinkInertia::accepted`].
    pub accepted: u32,
}

impl SensorOffset {
    /// Nothing identified.
    pub const ABSENT: Self = Self {
        name: Name::EMPTY,
        force: [f64::NAN; 3],
        torque: [f64::NAN; 3],
        standard_deviation: [f64::NAN; 6],
        group: 0,
        accepted: 0,
    };
}

/// What is identified, and in force from now on: the payload of `<robot>/estimate/inertia`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("proprio/InertiaEstimate/1")]
pub struct InertiaEstimate {
    /// When; `acquired` is the instant of the newest data in it, about a second before it is in force. [`Nanos::MIN`](crate::Nanos::MIN): an earlier run's, resumed.
    pub header: Header,
    /// How many of `links` are set.
    pub link_count: u32,
    /// How many of `offsets` are set.
    pub offset_count: u32,
    /// The links that are identified; those beyond [`MAX_LINKS`] are left out.
    pub links: [LinkInertia; MAX_LINKS],
    /// The offsets of the sensors that they are identified from; those beyond [`MAX_SENSORS`] are left out.
    pub offsets: [SensorOffset; MAX_SENSORS],
}

impl Default for InertiaEstimate {
    /// Nothing identified.
    fn default() -> Self {
        Self {
            header: Header::default(),
            link_count: 0,
            offset_count: 0,
            links: [LinkInertia::ABSENT; MAX_LINKS],
            offsets: [SensorOffset::ABSENT; MAX_SENSORS],
        }
    }
}

impl InertiaEstimate {
    /// The links that are set.
    #[must_use]
    pub fn links(&self) -> &[LinkInertia] {
        self.links.get(..self.link_count as usize).unwrap_or(&self.links)
    }

    /// The offsets that are set.
    #[must_use]
    pub fn offsets(&self) -> &[SensorOffset] {
        self.offsets.get(..self.offset_count as usize).unwrap_or(&self.offsets)
    }
}

// Who reads it in another language counts bytes.
const _: () = {
    use core::mem::offset_of;
    assert!(size_of::<LinkInertia>() == 248 && size_of::<SensorOffset>() == 168);
    assert!(offset_of!(LinkInertia, parameters) == 64 && offset_of!(LinkInertia, standard_deviation) == 144);
    assert!(offset_of!(LinkInertia, motion) == 224 && offset_of!(LinkInertia, rows) == 232);
    assert!(offset_of!(LinkInertia, group) == 240 && offset_of!(LinkInertia, accepted) == 244);
    assert!(offset_of!(SensorOffset, force) == 64 && offset_of!(SensorOffset, torque) == 88);
    assert!(offset_of!(SensorOffset, standard_deviation) == 112 && offset_of!(SensorOffset, group) == 160);
    assert!(offset_of!(InertiaEstimate, link_count) == 48 && offset_of!(InertiaEstimate, links) == 56);
    assert!(offset_of!(InertiaEstimate, offsets) == 56 + 248 * MAX_LINKS);
    assert!(size_of::<InertiaEstimate>() == 56 + 248 * MAX_LINKS + 168 * MAX_SENSORS);
};
