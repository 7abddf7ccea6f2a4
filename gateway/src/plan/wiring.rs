//! From the tables of a bus's joints and couplings to their [`JointsPlan`], checked.

use super::ChannelPlan;
use super::words::{did_you_mean, quoted};
use crate::config::{CouplingConfig, JointConfig, JointQuantity};
use crate::joints::{
    CouplingPlan, InputPlan, JointMap, JointsPlan, MOST, Matrix, Origin, ShaftInput, ShaftPlan,
    ShaftRole, Takes, Wrap,
};
use proprio_topics::{Kind, Nanos};
use std::f64::consts::TAU;

/// How near a range may be to a whole number of turns without being one \[turns\]: nearer, it is a
/// rounded number, whose error grows with each turn.
const ROUNDED: f64 = 0.01;

/// The plan of one bus's joints while its devices are read.
#[derive(Debug)]
pub(super) struct Wiring {
    couplings: Vec<(CouplingConfig, Matrix)>,
    plan: JointsPlan,
    /// Per coupling and joint, its channel, once its motor or a device at the joint is known.
    channels: Vec<Vec<Option<u32>>>,
}

/// The device whose table is read.
pub(super) struct NewDevice<'a> {
    pub(super) name: &'a str,
    /// The number of its bus.
    pub(super) bus: usize,
    /// Its own on the bus.
    pub(super) number: usize,
    pub(super) max_silence: Nanos,
}

impl NewDevice<'_> {
    /// A channel of it.
    pub(super) fn channel(&self, name: String, kind: Kind) -> ChannelPlan {
        ChannelPlan {
            name,
            kind,
            bus: self.bus,
            device: self.number,
            max_silence: self.max_silence,
        }
    }
}

/// The device that a joint's channel is shown with: its number, and its maximum silence \[ns\].
pub(super) struct Shown {
    pub(super) channel: u32,
    pub(super) device: usize,
    pub(super) max_silence: Nanos,
}

impl Wiring {
    /// From the couplings of a bus.
    ///
    /// # Errors
    /// A message with the coupling, the error and the legal values.
    pub(super) fn new(couplings: Vec<CouplingConfig>) -> Result<Self, String> {
        let mut checked: Vec<(CouplingConfig, Matrix)> = Vec::new();
        for raw in couplings {
            let at = format!("coupling of {}", quoted(&raw.joints));
            let n = raw.joints.len();
            if n == 0 || n > MOST || raw.motors.len() != n {
                return Err(format!(
                    "{at}: there are {n} joints and {} motors; it must be as many of both, 1 to \
                     {MOST}",
                    raw.motors.len()
                ));
            }
            let matrix = Matrix::new(&raw.matrix, n).map_err(|e| format!("{at}: {e}"))?;
            takes(&at, raw.takes.as_deref())?;
            let (mut joints, mut motors) = (Vec::new(), Vec::new());
            for (other, _) in &checked {
                joints.extend(&other.joints);
                motors.extend(&other.motors);
            }
            for (joint, motor) in raw.joints.iter().zip(&raw.motors) {
                if joints.contains(&joint) || motors.contains(&motor) {
                    let twice = if joints.contains(&joint) {
                        joint
                    } else {
                        motor
                    };
                    return Err(format!("{at}: {twice:?} is in a coupling already"));
                }
                joints.push(joint);
                motors.push(motor);
            }
            if let Some(both) = joints.iter().find(|joint| motors.contains(*joint)) {
                return Err(format!(
                    "{at}: {both:?} is a joint and a motor; they need different names"
                ));
            }
            checked.push((raw, matrix));
        }
        let channels = checked.iter().map(|(raw, _)| vec![None; raw.joints.len()]);
        Ok(Self {
            channels: channels.collect(),
            couplings: checked,
            plan: JointsPlan::default(),
        })
    }

    /// The coupling that has motor `name`, and its index there.
    fn motor(&self, name: &str) -> Option<(usize, usize)> {
        let places = self
            .couplings
            .iter()
            .map(|(raw, _)| raw.motors.iter().position(|m| m == name));
        places
            .enumerate()
            .find_map(|(coupling, index)| Some((coupling, index?)))
    }

    /// The name of the channel of joint or motor `name`; a motor's is that of the joint in its
    /// place.
    pub(super) fn channel_name<'a>(&'a self, name: &'a str) -> &'a str {
        self.motor(name)
            .and_then(|(coupling, index)| self.couplings.get(coupling)?.0.joints.get(index))
            .map_or(name, String::as_str)
    }

    /// The number of the channel `name`, if it is a joint's.
    pub(super) fn channel(&self, name: &str) -> Option<u32> {
        let shaft = self.plan.shafts.iter().find(|shaft| shaft.name == name);
        let channel = shaft.and_then(|shaft| match shaft.role {
            ShaftRole::Joint(channel) => Some(channel),
            ShaftRole::Motor(..) => None,
        });
        channel.or_else(|| {
            let couplings = self.couplings.iter().zip(&self.channels);
            let mut joints = couplings.flat_map(|((raw, _), known)| raw.joints.iter().zip(known));
            joints.find_map(|(joint, channel)| channel.filter(|_| joint == name))
        })
    }

    /// Adds the joint `raw` of `device` with the gear `map`; `channel` is that of
    /// [`Wiring::channel_name`], `at` its place in the file.
    ///
    /// # Errors
    /// A message with the place, the error and the legal values.
    pub(super) fn add(
        &mut self,
        at: &str,
        raw: &JointConfig,
        device: &NewDevice<'_>,
        channel: u32,
        map: &JointMap,
    ) -> Result<ShaftInput, String> {
        let takes = takes(at, raw.takes.as_deref())?;
        let wrap = wrap(at, raw, map)?;
        if wrap.is_some() && !takes.has(JointQuantity::Position) {
            return Err(format!(
                "{at}: wraps_rad is given, but takes has no \"position\""
            ));
        }
        let input = InputPlan {
            origin: Origin::Device(device.number, device.name.to_owned()),
            takes,
            max_silence: device.max_silence,
        };
        let role = match self.motor(&raw.name) {
            None => ShaftRole::Joint(channel),
            Some((coupling, index)) => {
                let joint = self
                    .channels
                    .get_mut(coupling)
                    .and_then(|c| c.get_mut(index));
                if let Some(known) = joint {
                    *known = Some(channel);
                }
                ShaftRole::Motor(coupling, index)
            }
        };
        let at = self.attach(&raw.name, role, input);
        Ok(ShaftInput { wrap, ..at })
    }

    /// Adds an input, of which no turns are counted, to shaft `name`.
    fn attach(&mut self, name: &str, role: ShaftRole, input: InputPlan) -> ShaftInput {
        let shafts = &mut self.plan.shafts;
        let number = shafts.iter().position(|shaft| shaft.name == name);
        let number = number.unwrap_or_else(|| {
            shafts.push(ShaftPlan {
                name: name.to_owned(),
                role,
                inputs: Vec::new(),
            });
            shafts.len() - 1
        });
        let index = shafts.get_mut(number).map_or(0, |shaft| {
            shaft.inputs.push(input);
            shaft.inputs.len() - 1
        });
        ShaftInput {
            shaft: number,
            index,
            wrap: None,
        }
    }

    /// The plan, once all devices of the bus are added, and the device that each joint's channel
    /// is shown with.
    ///
    /// # Errors
    /// A message with the joint or coupling, the error and the legal values.
    pub(super) fn finish(mut self) -> Result<(JointsPlan, Vec<Shown>), String> {
        let couplings = std::mem::take(&mut self.couplings);
        let channels = std::mem::take(&mut self.channels);
        for (number, ((raw, matrix), channels)) in couplings.into_iter().zip(channels).enumerate() {
            let at = format!("coupling of {}", quoted(&raw.joints));
            let shafts = &self.plan.shafts;
            let mut motors = Vec::new();
            for name in &raw.motors {
                let Some(motor) = shafts.iter().position(|shaft| shaft.name == *name) else {
                    let known = shafts.iter().map(|shaft| shaft.name.as_str());
                    return Err(format!(
                        "{at}: motor {name:?} is no [[bus.device.joint]] of this bus; all motors \
                         of a coupling must be on one bus, because each bus has a thread of its \
                         own{}",
                        did_you_mean(name, known)
                    ));
                };
                motors.push(motor);
            }
            let takes = takes(&at, raw.takes.as_deref())?;
            let positions = motors
                .iter()
                .filter_map(|motor| shafts.get(*motor)?.position());
            let max_silence = positions.map(|input| input.max_silence).max();
            let max_silence = max_silence.unwrap_or(Nanos::MAX);
            let mut joints = Vec::new();
            for (name, channel) in raw.joints.iter().zip(channels) {
                let input = InputPlan {
                    origin: Origin::Coupling(number),
                    takes,
                    max_silence,
                };
                let role = ShaftRole::Joint(channel.unwrap_or(u32::MAX));
                joints.push(self.attach(name, role, input));
            }
            self.plan.couplings.push(CouplingPlan {
                joints,
                motors,
                matrix,
            });
        }
        for shaft in &self.plan.shafts {
            Self::check(shaft)?;
        }
        let shafts = self.plan.shafts.iter();
        let shown = shafts.filter_map(|shaft| self.shown(shaft)).collect();
        Ok((self.plan, shown))
    }

    /// Checks that each quantity of a shaft has one input, and the position has one.
    fn check(shaft: &ShaftPlan) -> Result<(), String> {
        let at = format!("joint {:?}", shaft.name);
        let by = |input: &InputPlan| match &input.origin {
            Origin::Device(_, name) => format!("device {name:?}"),
            Origin::Coupling(_) => "its coupling".to_owned(),
        };
        for (number, input) in shaft.inputs.iter().enumerate() {
            for other in shaft.inputs.iter().take(number) {
                let mut both = input.takes.quantities().filter(|q| other.takes.has(*q));
                let Some(quantity) = both.next() else {
                    continue;
                };
                let word = word(quantity);
                return Err(format!(
                    "{at}: its {word} comes from {} and from {}; give them different names or, if \
                     both measure this joint, say with takes = [...] what each of them gives: {}",
                    by(other),
                    by(input),
                    quoted(Takes::ALL.quantities().map(self::word))
                ));
            }
        }
        if shaft.position().is_some() {
            return Ok(());
        }
        Err(format!(
            "{at}: no device gives its position (only {}); the position makes the samples",
            shaft.inputs.iter().map(by).collect::<Vec<_>>().join(", ")
        ))
    }

    /// The device to show the channel of a joint with: the one that gives its position; for a
    /// coupling, the motor in the joint's place.
    fn shown(&self, shaft: &ShaftPlan) -> Option<Shown> {
        let ShaftRole::Joint(channel) = shaft.role else {
            return None;
        };
        let input = shaft.position()?;
        let shafts = &self.plan.shafts;
        let device = match input.origin {
            Origin::Device(device, _) => device,
            Origin::Coupling(number) => {
                let coupling = self.plan.couplings.get(number)?;
                let is_it = |joint: &ShaftInput| {
                    let joint = shafts.get(joint.shaft);
                    joint.is_some_and(|joint| joint.name == shaft.name)
                };
                let index = coupling.joints.iter().position(is_it)?;
                let motor = shafts.get(*coupling.motors.get(index)?)?;
                match motor.position()?.origin {
                    Origin::Device(device, _) => device,
                    Origin::Coupling(_) => return None,
                }
            }
        };
        Some(Shown {
            channel,
            device,
            max_silence: input.max_silence,
        })
    }
}

/// The word of a quantity in `takes`.
pub(super) const fn word(quantity: JointQuantity) -> &'static str {
    match quantity {
        JointQuantity::Position => "position",
        JointQuantity::Velocity => "velocity",
        JointQuantity::Acceleration => "acceleration",
        JointQuantity::Torque => "torque",
        JointQuantity::Current => "current",
    }
}

fn takes(at: &str, list: Option<&[JointQuantity]>) -> Result<Takes, String> {
    match list {
        None => Ok(Takes::ALL),
        Some([]) => Err(format!(
            "{at}: takes is empty; it must name what is taken: {}",
            quoted(Takes::ALL.quantities().map(word))
        )),
        Some(list) => Ok(Takes::of(list)),
    }
}

/// Refuses what is no angle. More than a full turn is none: such a number is in degrees.
pub(super) fn angle(at: &str, key: &str, value: f64) -> Result<(), String> {
    if value.abs() <= TAU {
        return Ok(());
    }
    Err(format!(
        "{at}: {key} = {value} looks like degrees; in rad it is {:.6} (at most a full turn, \
         {TAU:.6}, is possible)",
        value.to_radians()
    ))
}

/// The range of a joint's table, checked; `at` is its place.
fn wrap(at: &str, raw: &JointConfig, map: &JointMap) -> Result<Option<Wrap>, String> {
    let (range, centre, speed) = match (raw.wraps_rad, raw.centre_rad, raw.max_speed_radps) {
        (None, None, None) => return Ok(None),
        (Some(range), Some(centre), Some(speed)) => (range, centre, speed),
        (range, centre, speed) => {
            let keys = [
                ("wraps_rad", range.is_some()),
                ("centre_rad", centre.is_some()),
                ("max_speed_radps", speed.is_some()),
            ];
            let missing = keys.iter().filter(|(_, is)| !is).map(|(key, _)| *key);
            return Err(format!(
                "{at}: {} is missing; wraps_rad, centre_rad and max_speed_radps belong together",
                missing.collect::<Vec<_>>().join(" and ")
            ));
        }
    };
    let [low, high] = range;
    let width = high - low;
    if !(width > 0.0 && width.is_finite()) {
        return Err(format!(
            "{at}: wraps_rad = [{low}, {high}] must be the lower and the upper end of a range"
        ));
    }
    let turns = width / TAU;
    let off = (turns - turns.round()).abs();
    if turns.round() >= 1.0 && off < ROUNDED && off > 1e-9 * turns {
        return Err(format!(
            "{at}: wraps_rad = [{low}, {high}] looks like {} of the device, rounded: the error \
             would grow with each turn; write [{low}, {}]",
            if turns.round() > 1.0 {
                format!("{} turns", turns.round())
            } else {
                "one turn".to_owned()
            },
            low + turns.round() * TAU
        ));
    }
    angle(at, "centre_rad", centre)?;
    if !(speed > 0.0 && speed.is_finite()) {
        return Err(format!("{at}: max_speed_radps = {speed} must be above 0"));
    }
    Ok(Some(Wrap {
        low,
        range: width,
        centre: (centre - map.offset) / map.gain,
        certain: Nanos::from_seconds(0.5 * width / speed),
    }))
}
