//! The result of on-line identification: each link's inertial parameters and each F/T sensor's
//! offset, with standard deviations and the amount of data used.
//!
//! Published about once a second. A reader that opens late receives the last one.

use crate::{Header, MAX_LINKS, MAX_SENSORS, Name, valid};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

/// An identified link.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct LinkInertia {
    /// The link, as the model names it.
    pub name: Name,
    /// Mass \[kg\]; mass times centre of mass, x y z \[kg m\]; rotational inertia Ixx Ixy Ixz Iyy
    /// Iyz Izz \[kg m²\] about the origin of the link's frame, in its axes.
    ///
    /// They always belong to a physically possible body. Forces determine only combinations of the
    /// links' parameters: a single parameter may be far from the true value, as its standard
    /// deviation then shows, while the torques are correct.
    pub parameters: [f64; 10],
    /// Their standard deviations, in the same order and units; NaN where nothing is known.
    pub standard_deviation: [f64; 10],
    /// Duration of the motion used for identification since the estimator's start \[s\].
    pub motion: f64,
    /// Number of equations used since then: at most six per instant for each sub-tree (part of the
    /// robot between F/T sensors).
    pub rows: u64,
    /// Links and sensors with the same number are identified together, from the same equations.
    pub group: u32,
    /// 1 if the parameters come from the data up to the header's `acquired`. 0 if there is no data
    /// or no physically possible body fits it: then they are the previous parameters, at first the
    /// model's.
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

/// The offset of one F/T sensor: its reading without load.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct SensorOffset {
    /// The sensor's channel.
    pub name: Name,
    /// Force \[N\], in the sensor's measurement frame.
    pub force: [f64; 3],
    /// Torque \[Nm\], in the same axes, about the frame's origin.
    pub torque: [f64; 3],
    /// Standard deviations of force \[N\] and torque \[Nm\] at the header's `acquired`; NaN where
    /// nothing is known. Offsets drift (random walk), so the uncertainty grows with time.
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

/// The identified parameters in use from now on: the payload of `<robot>/estimate/inertia`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/InertiaEstimate/2")]
pub struct InertiaEstimate {
    /// `acquired` is the instant of the newest data used, about a second before the parameters are
    /// in use. [`Nanos::MIN`](crate::Nanos::MIN): the parameters of an earlier run, resumed.
    pub header: Header,
    /// Number of valid entries in `links`.
    pub link_count: u32,
    /// Number of valid entries in `offsets`.
    pub offset_count: u32,
    /// The identified links; those beyond [`MAX_LINKS`] are omitted.
    pub links: [LinkInertia; MAX_LINKS],
    /// The offsets of the sensors used; those beyond [`MAX_SENSORS`] are omitted.
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
    /// The valid links.
    #[must_use]
    pub fn links(&self) -> &[LinkInertia] {
        valid(&self.links, self.link_count)
    }

    /// The valid offsets.
    #[must_use]
    pub fn offsets(&self) -> &[SensorOffset] {
        valid(&self.offsets, self.offset_count)
    }
}

// Readers in other languages depend on these byte offsets.
const _: () = {
    use core::mem::offset_of;
    assert!(size_of::<LinkInertia>() == 248 && size_of::<SensorOffset>() == 168);
    assert!(
        offset_of!(LinkInertia, parameters) == 64
            && offset_of!(LinkInertia, standard_deviation) == 144
    );
    assert!(offset_of!(LinkInertia, motion) == 224 && offset_of!(LinkInertia, rows) == 232);
    assert!(offset_of!(LinkInertia, group) == 240 && offset_of!(LinkInertia, accepted) == 244);
    assert!(offset_of!(SensorOffset, force) == 64 && offset_of!(SensorOffset, torque) == 88);
    assert!(
        offset_of!(SensorOffset, standard_deviation) == 112
            && offset_of!(SensorOffset, group) == 160
    );
    assert!(
        offset_of!(InertiaEstimate, link_count) == 56 && offset_of!(InertiaEstimate, links) == 64
    );
    assert!(offset_of!(InertiaEstimate, offsets) == 64 + 248 * MAX_LINKS);
    assert!(size_of::<InertiaEstimate>() == 64 + 248 * MAX_LINKS + 168 * MAX_SENSORS);
};
