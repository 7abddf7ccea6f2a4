//! From the outputs of a bus's devices to the joints' samples, and back.
//!
//! ```text
//! output --turns--> gear --> shaft --------------------------------> channel
//!         (wrap)   (map)      ^  \--> coupling --> the joint's shaft --^
//!                  another output     (matrix)     ^ another output
//! ```
//!
//! - A device's angle is made continuous (`wrap`), and goes through its gear (`map`) to a *shaft*:
//!   a joint, or a motor of a coupling.
//! - A shaft may have several sources: the position of one device, the torque of another (`shaft`).
//! - The motors of a coupling together give the states of its joints (`coupling`, `matrix`), which
//!   are a source of the joints' shafts.
//! - What belongs to a motor and not to a joint, its current and its drive's state, is found at the
//!   joint of the same place in the coupling's list.
//!
//! [`Layout`] says which leads where; `Joints` does it while the bus runs, without allocation;
//! [`Layout::inverse`] is the way back, for boards that encode.

mod coupling;
mod map;
mod matrix;
mod shaft;
mod track;
mod wrap;

pub use map::JointMap;
pub use matrix::{MOST, Matrix, MatrixError};
pub use shaft::Takes;
pub(crate) use track::Measured;
pub use wrap::Wrap;

use crate::config::Quantity;
use coupling::Coupling;
use proprio_drivers::Output;
use proprio_topics::{JointState, Nanos, Quality};
use shaft::{Shaft, Source};

/// Where a device's output leads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feed {
    /// The number of the shaft in [`Layout::shafts`].
    pub shaft: usize,
    /// Its place among the shaft's sources.
    pub place: usize,
    /// The range of the device's angle, if its turns are to be counted.
    pub wrap: Option<Wrap>,
}

/// The shafts and couplings of a bus.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Layout {
    /// The joints, and the motors of couplings.
    pub shafts: Vec<ShaftPlan>,
    /// The couplings.
    pub couplings: Vec<CouplingPlan>,
}

/// A joint, or a motor of a coupling.
#[derive(Debug, Clone, PartialEq)]
pub struct ShaftPlan {
    /// Its name.
    pub name: String,
    /// Where its state goes.
    pub target: Target,
    /// Its sources.
    pub sources: Vec<SourcePlan>,
}

/// Where a shaft's state goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// To the channel of this number.
    Channel(u32),
    /// To a coupling: its number, and the place among its motors.
    Motor(usize, usize),
}

/// A source of a shaft.
#[derive(Debug, Clone, PartialEq)]
pub struct SourcePlan {
    /// What gives it.
    pub origin: Origin,
    /// What is taken of it.
    pub takes: Takes,
    /// The longest time for which a reading may be used \[ns\].
    pub max_silence: Nanos,
}

/// What gives a shaft its state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// The device of this number on the bus, and of this name.
    Device(usize, String),
    /// The coupling of this number.
    Coupling(usize),
}

/// A coupling.
#[derive(Debug, Clone, PartialEq)]
pub struct CouplingPlan {
    /// The shafts of its joints, and its place among the sources of each.
    pub joints: Vec<(usize, usize)>,
    /// The shafts of its motors.
    pub motors: Vec<usize>,
    /// joints = matrix * motors.
    pub matrix: Matrix,
}

impl Layout {
    /// The source that a feed leads to.
    #[must_use]
    pub fn source(&self, feed: &Feed) -> Option<&SourcePlan> {
        self.shafts.get(feed.shaft)?.sources.get(feed.place)
    }

    /// Whether a reading of this feed can complete a sample: it gives a position that the channel
    /// takes. The others must come before it to be in the sample of the same instant.
    #[must_use]
    pub fn completes(&self, feed: &Feed) -> bool {
        let has_position = |source: Option<&SourcePlan>| {
            source.is_some_and(|source| source.takes.has(Quantity::Position))
        };
        let coupled = match self.shafts.get(feed.shaft).map(|shaft| shaft.target) {
            Some(Target::Motor(coupling, _)) => (self.couplings.get(coupling))
                .and_then(|c| c.joints.first())
                .is_some_and(|(shaft, place)| {
                    let shaft = self.shafts.get(*shaft);
                    has_position(shaft.and_then(|s| s.sources.get(*place)))
                }),
            Some(Target::Channel(_)) => true,
            None => false,
        };
        coupled && has_position(self.source(feed))
    }

    /// The way from joints to the device of a feed with this gear.
    #[must_use]
    pub fn inverse(&self, feed: &Feed, map: JointMap) -> Option<Inverse> {
        let channel = |shaft: usize| match self.shafts.get(shaft)?.target {
            Target::Channel(channel) => Some(channel),
            Target::Motor(..) => None,
        };
        let (channels, motor) = match self.shafts.get(feed.shaft)?.target {
            Target::Channel(channel) => (vec![channel], None),
            Target::Motor(coupling, place) => {
                let coupling = self.couplings.get(coupling)?;
                let joints = coupling.joints.iter().map(|(shaft, _)| channel(*shaft));
                let motor = (coupling.matrix.clone(), place);
                (joints.collect::<Option<_>>()?, Some(motor))
            }
        };
        Some(Inverse {
            channels,
            motor,
            map,
            wrap: feed.wrap,
        })
    }
}

/// The way from joints to a device.
#[derive(Debug, Clone)]
pub struct Inverse {
    /// The channels of the joints that move its shaft.
    pub channels: Vec<u32>,
    /// For a motor of a coupling, its matrix and the place of the motor.
    motor: Option<(Matrix, usize)>,
    map: JointMap,
    wrap: Option<Wrap>,
}

impl Inverse {
    /// Whether channel number `place` of [`Inverse::channels`] moves the shaft, and is moved by it.
    #[must_use]
    pub fn moves(&self, place: usize) -> bool {
        self.motor.as_ref().is_none_or(|(matrix, motor)| {
            matrix
                .row(place)
                .nth(*motor)
                .is_some_and(|weight| weight != 0.0)
        })
    }

    /// The shaft's state from those of [`Inverse::channels`].
    #[must_use]
    pub fn shaft(&self, joints: &[JointState]) -> JointState {
        match &self.motor {
            None => joints.first().copied().unwrap_or(JointState::ABSENT),
            Some((matrix, place)) => matrix.motor(*place, joints.iter().copied()),
        }
    }

    /// What the device reports when its shaft has this state.
    #[must_use]
    pub fn device(&self, shaft: JointState) -> JointState {
        let state = self.map.device(shaft);
        JointState {
            position: (self.wrap).map_or(state.position, |wrap| wrap.reported(state.position)),
            ..state
        }
    }
}

/// The shafts and couplings of a running bus.
#[derive(Debug, Default)]
pub(crate) struct Joints {
    shafts: Vec<(Shaft, Target)>,
    couplings: Vec<(Coupling, Vec<(usize, usize)>)>,
}

impl Joints {
    /// Without readings.
    pub(crate) fn new(layout: &Layout) -> Self {
        let shaft = |plan: &ShaftPlan| {
            let sources = plan.sources.iter().map(|s| (s.takes, s.max_silence));
            (Shaft::new(sources), plan.target)
        };
        let coupling = |plan: &CouplingPlan| {
            let coupling = Coupling::new(plan.matrix.clone(), plan.motors.len());
            (coupling, plan.joints.clone())
        };
        Self {
            shafts: layout.shafts.iter().map(shaft).collect(),
            couplings: layout.couplings.iter().map(coupling).collect(),
        }
    }

    fn source(&mut self, feed: &Feed) -> Option<&mut Source> {
        let (shaft, _) = self.shafts.get_mut(feed.shaft)?;
        shaft.sources.get_mut(feed.place)
    }

    /// The maximum silence of a feed's device \[ns\].
    pub(crate) fn set_max_silence(&mut self, feed: &Feed, max_silence: Nanos) {
        if let Some(source) = self.source(feed) {
            source.max_silence = max_silence;
        }
    }

    /// The device of a feed, or its conversion, was replaced: the zero may have changed.
    pub(crate) fn replaced(&mut self, feed: &Feed) {
        if let Some(source) = self.source(feed) {
            source.replaced = true;
        }
    }

    /// The flags, for its joint's channel, of a reading that is no joint's state, such as a
    /// drive's.
    /// Where the device is not the joint's only source, what spoils its own readings does not spoil
    /// the joint's.
    pub(crate) fn flags(&self, feed: &Feed, quality: Quality) -> Quality {
        let alone = |(shaft, target): &(Shaft, Target)| {
            shaft.sources.len() == 1 && matches!(target, Target::Channel(_))
        };
        match self.shafts.get(feed.shaft).is_some_and(alone) {
            true => quality,
            false => Quality(quality.0 & Quality::DRIVE_FAULT.0),
        }
    }

    /// Takes the reading `output` of a device, with its `state`, through the gear `map`; calls
    /// `publish` with the channel of each sample that it completes. False: its stamp runs backward,
    /// and it was not taken.
    pub(crate) fn push(
        &mut self,
        feed: &Feed,
        map: &JointMap,
        output: &Output,
        mut state: JointState,
        mut publish: impl FnMut(u32, &Measured),
    ) -> bool {
        let Some(source) = self.source(feed) else {
            return true;
        };
        if output.acquired < source.last {
            return false;
        }
        source.last = output.acquired;
        let mut quality = output.quality;
        if std::mem::take(&mut source.replaced) {
            source.turns = wrap::Turns::default();
            quality |= Quality::GAP_BEFORE | Quality::ZERO_CHANGED;
        }
        if let Some(wrap) = &feed.wrap {
            let trusted = !quality.intersects(Quality::UNTRUSTED_ENCODER);
            let anew;
            (state.position, anew) =
                (source.turns).unwrap(wrap, output.acquired, state.position, trusted);
            if anew {
                quality |= Quality::GAP_BEFORE | Quality::ZERO_CHANGED;
            }
        }
        let measured = Measured {
            acquired: output.acquired,
            stamp: output.stamp,
            device_time: output.device_time,
            device_counter: output.device_counter,
            quality,
            state: map.joint(state),
            max_silence: source.max_silence,
        };
        match self.give(feed.shaft, feed.place, measured) {
            Some((Target::Channel(channel), whole)) => publish(channel, &whole),
            Some((Target::Motor(coupling, place), whole)) => {
                self.couple(coupling, place, whole, publish);
            }
            None => {}
        }
        true
    }

    /// The new state of shaft number `shaft`, if there is one, and where it goes.
    fn give(&mut self, shaft: usize, place: usize, of: Measured) -> Option<(Target, Measured)> {
        let (shaft, target) = self.shafts.get_mut(shaft)?;
        Some((*target, shaft.give(place, of)?))
    }

    /// Takes the state of a motor, and gives those of the joints.
    fn couple(
        &mut self,
        number: usize,
        motor: usize,
        state: Measured,
        mut publish: impl FnMut(u32, &Measured),
    ) {
        let Some((coupling, joints)) = self.couplings.get_mut(number) else {
            return;
        };
        if !coupling.give(motor, state) {
            return;
        }
        for joint in 0..joints.len() {
            let Some((coupling, joints)) = self.couplings.get(number) else {
                return;
            };
            let (Some(&(shaft, place)), Some(state)) = (joints.get(joint), coupling.joint(joint))
            else {
                continue;
            };
            if let Some((Target::Channel(channel), whole)) = self.give(shaft, place, state) {
                publish(channel, &whole);
            }
        }
    }
}
