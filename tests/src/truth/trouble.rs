//! What goes wrong in a run.

use super::random::Random;
use proprio_dynamics::spatial::{Mat3, Pose, Vec3};
use proprio_topics::Kind;
use std::f64::consts::FRAC_PI_2;

/// The readings of a channel, with their stamps \[s\].
#[derive(Debug, Clone)]
pub(super) struct Series {
    /// What it measures.
    pub(super) kind: Kind,
    /// The channel.
    pub(super) name: String,
    /// Stamp and values: a position; forces and torques; acceleration and angular velocity.
    pub(super) rows: Vec<(f64, Vec<f64>)>,
}

impl Series {
    pub(super) fn each(&mut self, change: impl Fn(&mut [f64])) {
        self.rows.iter_mut().for_each(|(_, values)| change(values));
    }
}

/// When a force acts on the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum When {
    /// From before the start until some seconds after the first motion.
    Start,
    /// From 15 to 18 s and from 25 to 27 s.
    Middle,
    /// From 12 to 24 s and from 28 to 40 s.
    Long,
}

/// What is wrong with the readings of a channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Defect {
    /// No readings from 20 to 30 s.
    Off,
    /// The reading of 20 s is repeated until 30 s.
    Stuck,
    /// From 20 to 30 s one reading in ten is any number in the range.
    Garbage,
    /// All values are multiplied.
    Scale(f64),
    /// One reading in so many arrives.
    Slow(usize),
    /// Stamped so much late \[s\].
    Late(f64),
    /// Nothing for .1 to 1 s, once in about 3 s.
    Intermittent,
    /// A slow ramp of the offset.
    Drift,
    /// Two channels of the kind have each other's readings; of one, two axes.
    Swapped,
    /// No value exceeds 60 % of its range.
    Saturated,
    /// One bit of 16 is flipped in 1 % of the readings.
    Flipped,
    /// One reading is far off, at 18, 26 and 34 s.
    Spike,
    /// From 22 s on the offset is another one.
    Jump,
    /// The sign is wrong.
    Sign,
    /// Mounted in another direction than stated, by this angle \[rad\].
    Turned(f64),
    /// The encoder's zero is off \[rad or m\].
    Zero(f64),
}

/// What goes wrong in a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Trouble {
    /// Nothing; the URDF's masses are wrong by up to 15 %, as in all runs.
    None,
    /// The URDF is wrong by this fraction.
    Cad(f64),
    /// A force acts on a hand.
    Push(When),
    /// A force acts on a link in the middle of a limb, where no contact is possible.
    Elsewhere(When),
    /// From 20 s on the hand carries something.
    Payload,
    /// Gravity has another direction than stated \[rad\].
    Tilt(f64),
    /// The offsets of the F/T sensors are stated, wrong by so much \[N\] (and 3 % of that in Nm).
    Stated(f64),
    /// As before, and identification is off; with a force on a hand in the middle of the run.
    NotLearning(f64),
    /// A channel of this kind has a defect.
    Channel(Kind, Defect),
}

/// All troubles, by the name that the table has for them.
pub const TROUBLES: &[(&str, Trouble)] = {
    use Defect::*;
    use Kind::{Imu, Joint, Wrench};
    use Trouble::*;
    const DEG: f64 = FRAC_PI_2 / 90.0;
    &[
        ("clean", None),
        ("URDF 40 % off", Cad(0.4)),
        ("push at the start", Push(When::Start)),
        ("push in the middle", Push(When::Middle)),
        ("two long pushes", Push(When::Long)),
        ("push where no contact is", Elsewhere(When::Middle)),
        ("payload taken", Payload),
        ("gravity 20 deg off", Tilt(20.0 * DEG)),
        ("offsets stated", Stated(0.0)),
        ("offsets stated wrong by 10 N", Stated(10.0)),
        ("not learning, offsets right", NotLearning(0.0)),
        ("not learning, offsets wrong by 10 N", NotLearning(10.0)),
        ("F/T off", Channel(Wrench, Off)),
        ("F/T stuck", Channel(Wrench, Stuck)),
        ("F/T garbage", Channel(Wrench, Garbage)),
        ("F/T gain 8 % off", Channel(Wrench, Scale(1.08))),
        ("F/T in other units", Channel(Wrench, Scale(1000.0))),
        ("F/T one in ten", Channel(Wrench, Slow(10))),
        ("F/T late 20 ms", Channel(Wrench, Late(0.02))),
        ("F/T late 100 ms", Channel(Wrench, Late(0.1))),
        ("F/T intermittent", Channel(Wrench, Intermittent)),
        ("F/T drifts", Channel(Wrench, Drift)),
        ("F/T swapped", Channel(Wrench, Swapped)),
        ("F/T saturated", Channel(Wrench, Saturated)),
        ("F/T bits flipped", Channel(Wrench, Flipped)),
        ("F/T spikes", Channel(Wrench, Spike)),
        ("F/T offset jumps", Channel(Wrench, Jump)),
        ("F/T sign", Channel(Wrench, Sign)),
        ("F/T turned 5 deg", Channel(Wrench, Turned(5.0 * DEG))),
        ("F/T turned 90 deg", Channel(Wrench, Turned(90.0 * DEG))),
        ("encoder off", Channel(Joint, Off)),
        ("encoder stuck", Channel(Joint, Stuck)),
        ("encoder garbage", Channel(Joint, Garbage)),
        ("encoder in degrees", Channel(Joint, Scale(1.0 / DEG))),
        ("encoder gear 20 % off", Channel(Joint, Scale(1.2))),
        ("encoder one in ten", Channel(Joint, Slow(10))),
        ("encoder late 20 ms", Channel(Joint, Late(0.02))),
        ("encoder intermittent", Channel(Joint, Intermittent)),
        ("encoder drifts", Channel(Joint, Drift)),
        ("encoders swapped", Channel(Joint, Swapped)),
        ("encoder bits flipped", Channel(Joint, Flipped)),
        ("encoder spikes", Channel(Joint, Spike)),
        ("encoder reversed", Channel(Joint, Sign)),
        ("encoder zero .05 rad", Channel(Joint, Zero(0.05))),
        ("IMU off", Channel(Imu, Off)),
        ("IMU stuck", Channel(Imu, Stuck)),
        ("IMU garbage", Channel(Imu, Garbage)),
        ("IMU in g", Channel(Imu, Scale(1.0 / 9.80665))),
        ("IMU late 20 ms", Channel(Imu, Late(0.02))),
        ("IMU intermittent", Channel(Imu, Intermittent)),
        ("IMU bits flipped", Channel(Imu, Flipped)),
        ("IMU turned 5 deg", Channel(Imu, Turned(5.0 * DEG))),
        ("IMU turned 90 deg", Channel(Imu, Turned(90.0 * DEG))),
    ]
};

/// The time of a defect that passes \[s\].
const WINDOW: (f64, f64) = (20.0, 30.0);

/// The ranges of a channel's values.
fn ranges(kind: Kind) -> &'static [f64] {
    match kind {
        Kind::Wrench => &[1000.0, 1000.0, 1000.0, 40.0, 40.0, 40.0],
        Kind::Imu => &[40.0, 40.0, 40.0, 8.0, 8.0, 8.0],
        _ => &[6.3],
    }
}

impl Defect {
    /// Puts the defect into `all` channels of this kind, of which number `bad` has it.
    pub(super) fn apply(self, all: &mut [Series], bad: usize, random: &mut Random) {
        let count = all.len();
        if let Self::Swapped = self {
            if count > 1 {
                let (a, b) = (bad % (count - 1), bad % (count - 1) + 1);
                let (left, right) = all.split_at_mut(b);
                std::mem::swap(&mut left[a].rows, &mut right[0].rows);
            } else {
                for (_, values) in &mut all[bad].rows {
                    values.chunks_mut(3).for_each(|axes| axes.swap(0, 1));
                }
            }
            return;
        }
        let series = &mut all[bad];
        let ranges = ranges(series.kind);
        let is_in = |t: f64| WINDOW.0 < t && t < WINDOW.1;
        let unit = |random: &mut Random| -> Vec<f64> {
            ranges.iter().map(|range| range * random.normal()).collect()
        };
        match self {
            Self::Off => series.rows.retain(|(t, _)| !is_in(*t)),
            Self::Stuck => {
                let mut held: Option<Vec<f64>> = None;
                for (_, values) in series.rows.iter_mut().filter(|(t, _)| is_in(*t)) {
                    values.clone_from(held.get_or_insert(values.clone()));
                }
            }
            Self::Garbage => {
                for (_, values) in series.rows.iter_mut().filter(|(t, _)| is_in(*t)) {
                    if random.happens(0.1) {
                        *values = unit(random);
                    }
                }
            }
            Self::Scale(factor) => {
                series.each(|values| values.iter_mut().for_each(|v| *v *= factor));
            }
            Self::Sign => series.each(|values| values.iter_mut().for_each(|v| *v = -*v)),
            Self::Zero(off) => series.each(|values| values.iter_mut().for_each(|v| *v += off)),
            Self::Slow(times) => {
                let mut number = 0;
                series.rows.retain(|_| {
                    number += 1;
                    number % times == 0
                });
            }
            Self::Late(by) => series.rows.iter_mut().for_each(|(t, _)| *t += by),
            Self::Intermittent => {
                let (mut from, mut until) = (random.uniform(1.0, 4.0), 0.0);
                series.rows.retain(|(t, _)| {
                    if *t > from {
                        until = from + random.uniform(0.1, 1.0);
                        from = until + random.uniform(1.0, 4.0);
                    }
                    *t > until
                });
            }
            Self::Drift => {
                let rate: Vec<f64> = unit(random).iter().map(|v| v * 2e-4).collect();
                for (t, values) in &mut series.rows {
                    values
                        .iter_mut()
                        .zip(&rate)
                        .for_each(|(v, rate)| *v += *t * rate);
                }
            }
            Self::Saturated => {
                let most: Vec<f64> = (0..ranges.len())
                    .map(|axis| {
                        let all = series.rows.iter().map(|(_, values)| values[axis].abs());
                        0.6 * all.fold(0.0, f64::max)
                    })
                    .collect();
                series.each(|values| {
                    for (v, most) in values.iter_mut().zip(&most) {
                        *v = v.clamp(-most, *most);
                    }
                });
            }
            Self::Flipped => {
                for (_, values) in &mut series.rows {
                    if random.happens(0.01) {
                        let axis = random.below(values.len());
                        let step = ranges[axis] / 32768.0;
                        let raw = (values[axis] / step) as i16 ^ (1_i16 << random.below(16));
                        values[axis] = f64::from(raw) * step;
                    }
                }
            }
            Self::Spike => {
                for at in [18.0, 26.0, 34.0] {
                    if let Some((_, values)) = series.rows.iter_mut().find(|(t, _)| *t >= at) {
                        let off = unit(random);
                        values
                            .iter_mut()
                            .zip(off)
                            .for_each(|(v, off)| *v += 0.2 * off);
                    }
                }
            }
            Self::Jump => {
                let off: Vec<f64> = unit(random).iter().map(|v| v * 0.01).collect();
                for (_, values) in series.rows.iter_mut().filter(|(t, _)| *t > 22.0) {
                    values.iter_mut().zip(&off).for_each(|(v, off)| *v += off);
                }
            }
            Self::Turned(angle) => {
                let right = angle > 1.5;
                let axis = match right {
                    true => [Vec3::x(), Vec3::y(), Vec3::z()][random.below(3)],
                    false => random.direction(),
                };
                let turn = rotation(axis * angle);
                series.each(|values| {
                    for axes in values.chunks_exact_mut(3) {
                        let v = turn * Vec3::new(axes[0], axes[1], axes[2]);
                        axes.copy_from_slice(v.as_slice());
                    }
                });
            }
            Self::Swapped => {}
        }
    }
}

/// The rotation about a vector by its length \[rad\].
pub(super) fn rotation(turn: Vec3) -> Mat3 {
    let Some(axis) = turn.try_normalize(1e-12) else {
        return Pose::identity().rotation;
    };
    let (sin, cos) = turn.norm().sin_cos();
    let k = Mat3::new(
        0.0, -axis.z, axis.y, axis.z, 0.0, -axis.x, -axis.y, axis.x, 0.0,
    );
    Mat3::identity() + k * sin + k * k * (1.0 - cos)
}
