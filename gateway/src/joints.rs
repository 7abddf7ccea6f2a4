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
//! - A shaft may have several inputs: the position of one device, the torque of another (`shaft`).
//! - The motors of a coupling together give the states of its joints (`coupling`, `matrix`), which
//!   are an input of the joints' shafts.
//! - What belongs to a motor and not to a joint, its current and its drive's state, is found at the
//!   joint of the same index in the coupling's list.
//!
//! Three nouns: an *output* of a device is an *input* of a shaft ([`ShaftInput`]), and so is what a
//! *coupling* makes of its motors. [`JointsPlan`] says which leads where; `Joints` does it while
//! the bus runs, without allocation; [`JointsPlan::inverse`] is the way back, for boards that
//! encode.

mod coupling;
mod map;
mod matrix;
mod shaft;
mod track;
mod wrap;

pub use map::JointMap;
pub use matrix::{MOST, Matrix, MatrixError};
pub use shaft::Takes;
pub(crate) use track::ShaftState;
pub use wrap::Wrap;

use crate::config::JointQuantity;
use coupling::CoupledMotors;
use proprio_drivers::StampedReading;
use proprio_topics::{JointState, Nanos, Quality};
use shaft::{RunningInput, Shaft};

/// Which input of which shaft.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShaftInput {
    /// The number of the shaft in [`JointsPlan::shafts`].
    pub shaft: usize,
    /// Its index among the shaft's inputs.
    pub index: usize,
    /// The range of the device's angle, if its turns are to be counted.
    pub wrap: Option<Wrap>,
}

/// The shafts and couplings of a bus.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JointsPlan {
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
    /// Which of the two it is.
    pub role: ShaftRole,
    /// Its inputs.
    pub inputs: Vec<InputPlan>,
}

impl ShaftPlan {
    /// The input that gives its position.
    #[must_use]
    pub fn position(&self) -> Option<&InputPlan> {
        let mut inputs = self.inputs.iter();
        inputs.find(|input| input.takes.has(JointQuantity::Position))
    }
}

/// What a shaft is, and so where its state goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShaftRole {
    /// A joint: to the channel of this number.
    Joint(u32),
    /// A motor of the coupling of this number, at this index among its motors.
    Motor(usize, usize),
}

/// An input of a shaft.
#[derive(Debug, Clone, PartialEq)]
pub struct InputPlan {
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
    /// The inputs of its joints' shafts that it gives.
    pub joints: Vec<ShaftInput>,
    /// The shafts of its motors.
    pub motors: Vec<usize>,
    /// joints = matrix * motors.
    pub matrix: Matrix,
}

impl CouplingPlan {
    /// What is taken of its motors.
    pub(crate) fn takes(&self, plan: &JointsPlan) -> Takes {
        let input = self.joints.first().and_then(|joint| plan.input(joint));
        input.map_or(Takes::ALL, |input| input.takes)
    }
}

impl JointsPlan {
    /// What an input is.
    #[must_use]
    pub fn input(&self, at: &ShaftInput) -> Option<&InputPlan> {
        self.shafts.get(at.shaft)?.inputs.get(at.index)
    }

    /// Whether a reading at this input can complete a sample: it gives a position that the channel
    /// takes. The others must come before it to be in the sample of the same instant.
    #[must_use]
    pub fn completes(&self, at: &ShaftInput) -> bool {
        let has_position = |at: &ShaftInput| {
            self.input(at)
                .is_some_and(|input| input.takes.has(JointQuantity::Position))
        };
        let is_taken = match self.shafts.get(at.shaft).map(|shaft| shaft.role) {
            Some(ShaftRole::Motor(coupling, _)) => (self.couplings.get(coupling))
                .and_then(|coupling| coupling.joints.first())
                .is_some_and(has_position),
            Some(ShaftRole::Joint(_)) => true,
            None => false,
        };
        is_taken && has_position(at)
    }

    /// The way from joints to the device of an input with this gear.
    #[must_use]
    pub fn inverse(&self, at: &ShaftInput, map: JointMap) -> Option<Inverse> {
        let channel = |shaft: usize| match self.shafts.get(shaft)?.role {
            ShaftRole::Joint(channel) => Some(channel),
            ShaftRole::Motor(..) => None,
        };
        let (channels, motor) = match self.shafts.get(at.shaft)?.role {
            ShaftRole::Joint(channel) => (vec![channel], None),
            ShaftRole::Motor(coupling, index) => {
                let coupling = self.couplings.get(coupling)?;
                let joints = coupling.joints.iter().map(|joint| channel(joint.shaft));
                let motor = (coupling.matrix.clone(), index);
                (joints.collect::<Option<_>>()?, Some(motor))
            }
        };
        Some(Inverse {
            channels,
            motor,
            map,
            wrap: at.wrap,
        })
    }
}

/// The way from joints to a device.
#[derive(Debug, Clone)]
pub struct Inverse {
    /// The channels of the joints that move its shaft.
    pub channels: Vec<u32>,
    /// For a motor of a coupling, its matrix and the index of the motor.
    motor: Option<(Matrix, usize)>,
    map: JointMap,
    wrap: Option<Wrap>,
}

impl Inverse {
    /// Whether channel number `index` of [`Inverse::channels`] moves the shaft, and is moved by it.
    #[must_use]
    pub fn moves(&self, index: usize) -> bool {
        self.motor.as_ref().is_none_or(|(matrix, motor)| {
            matrix
                .row(index)
                .nth(*motor)
                .is_some_and(|weight| weight != 0.0)
        })
    }

    /// The shaft's state from those of [`Inverse::channels`].
    #[must_use]
    pub fn shaft(&self, joints: &[JointState]) -> JointState {
        match &self.motor {
            None => joints.first().copied().unwrap_or(JointState::ABSENT),
            Some((matrix, index)) => matrix.motor(*index, joints.iter().copied()),
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
    shafts: Vec<(Shaft, ShaftRole)>,
    couplings: Vec<(CoupledMotors, Vec<ShaftInput>)>,
}

impl Joints {
    /// Without readings.
    pub(crate) fn new(plan: &JointsPlan) -> Self {
        let shaft = |plan: &ShaftPlan| {
            let inputs = plan.inputs.iter().map(|s| (s.takes, s.max_silence));
            (Shaft::new(inputs), plan.role)
        };
        let coupling = |plan: &CouplingPlan| {
            let coupling = CoupledMotors::new(plan.matrix.clone(), plan.motors.len());
            (coupling, plan.joints.clone())
        };
        Self {
            shafts: plan.shafts.iter().map(shaft).collect(),
            couplings: plan.couplings.iter().map(coupling).collect(),
        }
    }

    fn input(&mut self, at: &ShaftInput) -> Option<&mut RunningInput> {
        let (shaft, _) = self.shafts.get_mut(at.shaft)?;
        shaft.inputs.get_mut(at.index)
    }

    /// The maximum silence of an input's device \[ns\].
    pub(crate) fn set_max_silence(&mut self, at: &ShaftInput, max_silence: Nanos) {
        if let Some(input) = self.input(at) {
            input.max_silence = max_silence;
        }
    }

    /// The device of an input, or its conversion, was replaced: the zero may have changed.
    pub(crate) fn replaced(&mut self, at: &ShaftInput) {
        if let Some(input) = self.input(at) {
            input.replaced = true;
        }
    }

    /// The flags, for its joint's channel, of a reading that is no joint's state, such as a
    /// drive's.
    /// Where the device is not the joint's only input, what spoils its own readings does not spoil
    /// the joint's.
    pub(crate) fn flags(&self, at: &ShaftInput, quality: Quality) -> Quality {
        let alone = |(shaft, role): &(Shaft, ShaftRole)| {
            shaft.inputs.len() == 1 && matches!(role, ShaftRole::Joint(_))
        };
        match self.shafts.get(at.shaft).is_some_and(alone) {
            true => quality,
            false => Quality(quality.0 & Quality::DRIVE_FAULT.0),
        }
    }

    /// Takes the reading `stamped` of a device, with its `state`, through the gear `map`; calls
    /// `publish` with the channel of each sample that it completes. False: its stamp runs backward,
    /// and it was not taken.
    pub(crate) fn push(
        &mut self,
        at: &ShaftInput,
        map: &JointMap,
        stamped: &StampedReading,
        mut state: JointState,
        mut publish: impl FnMut(u32, &ShaftState),
    ) -> bool {
        let Some(input) = self.input(at) else {
            return true;
        };
        if stamped.acquired < input.last {
            return false;
        }
        input.last = stamped.acquired;
        let mut quality = stamped.quality;
        if std::mem::take(&mut input.replaced) {
            input.turns = wrap::Turns::default();
            quality |= Quality::GAP_BEFORE | Quality::ZERO_CHANGED;
        }
        if let Some(wrap) = &at.wrap {
            let trusted = !quality.intersects(Quality::UNTRUSTED_ENCODER);
            let anew;
            (state.position, anew) =
                (input.turns).unwrap(wrap, stamped.acquired, state.position, trusted);
            if anew {
                quality |= Quality::GAP_BEFORE | Quality::ZERO_CHANGED;
            }
        }
        let measured = ShaftState {
            acquired: stamped.acquired,
            stamp: stamped.stamp,
            device_time: stamped.device_time,
            device_counter: stamped.device_counter,
            quality,
            state: map.joint(state),
            max_silence: input.max_silence,
        };
        match self.advance(at, measured) {
            Some((ShaftRole::Joint(channel), whole)) => publish(channel, &whole),
            Some((ShaftRole::Motor(coupling, index), whole)) => {
                self.couple(coupling, index, whole, publish);
            }
            None => {}
        }
        true
    }

    /// Takes what an input gives: the new state of its shaft, if there is one, and what that is.
    fn advance(&mut self, at: &ShaftInput, given: ShaftState) -> Option<(ShaftRole, ShaftState)> {
        let (shaft, role) = self.shafts.get_mut(at.shaft)?;
        Some((*role, shaft.push(at.index, given)?))
    }

    /// Takes the state of a motor, and gives those of the joints.
    fn couple(
        &mut self,
        number: usize,
        motor: usize,
        state: ShaftState,
        mut publish: impl FnMut(u32, &ShaftState),
    ) {
        let Some((coupling, joints)) = self.couplings.get_mut(number) else {
            return;
        };
        if !coupling.push(motor, state) {
            return;
        }
        for joint in 0..joints.len() {
            let Some((coupling, joints)) = self.couplings.get(number) else {
                return;
            };
            let (Some(&at), Some(state)) = (joints.get(joint), coupling.joint(joint)) else {
                continue;
            };
            if let Some((ShaftRole::Joint(channel), whole)) = self.advance(&at, state) {
                publish(channel, &whole);
            }
        }
    }
}
