//! Why a torque is as uncertain as it is: what it rests on, and how much of its variance each of
//! these inputs causes.

use crate::code::coded;
use crate::{Code, Header, JointTorque, Name, valid};
use core::fmt;
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

coded! {
    /// What causes a part of a torque's variance.
    pub enum Source {
        /// Noise of an F/T sensor, as stated or found.
        Noise = 0 => "noise",
        /// The offset of an F/T sensor.
        Offset = 1 => "offset",
        /// The gain, or another part of the calibration, of an F/T sensor.
        Gain = 2 => "gain",
        /// What an F/T sensor's offset has drifted since it was known, by time or temperature;
        /// noise beyond the stated one; and the change of a reading that is extrapolated.
        Drift = 3 => "drift",
        /// The inertial parameters of a link.
        Link = 4 => "link",
        /// The position of a joint: noise and zero of its encoder.
        Position = 5 => "position",
        /// The acceleration of a joint, if it is differentiated.
        Acceleration = 6 => "acceleration",
        /// The proper acceleration of the base: a base that is not level, or bias and mounting of
        /// its IMU.
        Base = 7 => "base",
        /// The angular acceleration of the base, differentiated from its IMU.
        Rotation = 8 => "rotation",
        /// The place of a contact.
        Place = 9 => "place",
        /// What else than the stated setup explains the readings nearly as well: an encoder's zero,
        /// a tilted base. Identification has not refuted it.
        Alternative = 10 => "alternative",
        /// The offset of an F/T sensor may have jumped, or a contact may have begun.
        Step = 11 => "step",
        /// Further inputs together.
        Others = 12 => "others",
        /// A contact that is present: the torque rests on its kind, and has its wrench as an
        /// unknown.
        Present = 13 => "present",
        /// A possible contact that the torque assumes to be absent.
        Absent = 14 => "absent",
    }
}

/// One input of a torque.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct BudgetPart {
    /// The channel of an F/T sensor, the joint, the link or the contact; empty where there is one
    /// only.
    pub name: Name,
    /// Its share of the torque's variance \[Nm^2 or N^2\]: zero if the torque rests on it, but its
    /// error does not matter or is not known. Negative if its error cancels a part of others that
    /// are correlated with it: the mass of a link, and the offset that was identified with it.
    pub variance: f64,
    /// Of a position: how far the joint has moved since the estimator's start, as a share of its
    /// range (of 2 rad or 0.2 m, if the URDF has no limits). Otherwise zero.
    pub travel: f64,
    /// What it is.
    pub source: Code<Source>,
    /// Unused, zero.
    pub reserved: u32,
}

/// A line of at most 255 bytes of UTF-8, for a person; what is longer is cut.
#[repr(C)]
#[derive(Clone, Copy, PartialEq, Eq, ZeroCopySend, FromBytes)]
pub struct Line {
    bytes: [u8; 255],
    length: u8,
}

impl Line {
    /// An empty line.
    pub const EMPTY: Self = Self {
        bytes: [0; 255],
        length: 0,
    };

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        let bytes = self.bytes.get(..usize::from(self.length));
        core::str::from_utf8(bytes.unwrap_or_default()).unwrap_or("?")
    }
}

impl fmt::Write for Line {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for letter in text.chars() {
            let start = usize::from(self.length);
            let Some(slot) = self.bytes.get_mut(start..start + letter.len_utf8()) else {
                return Err(fmt::Error);
            };
            letter.encode_utf8(slot);
            self.length += u8::try_from(letter.len_utf8()).unwrap_or(0);
        }
        Ok(())
    }
}

impl fmt::Debug for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

/// What one torque of an estimate rests on: the payload of `<robot>/estimate/budget`, one joint
/// after another. It is only computed while somebody reads it.
///
/// The variances of the parts sum to `deviation` squared.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/TorqueBudget/1")]
pub struct TorqueBudget {
    /// `acquired` is that of the estimate.
    pub header: Header,
    /// The torque as it was published.
    pub torque: JointTorque,
    /// Its standard deviation \[Nm or N\], also where it is withheld; infinite if what the setup
    /// may be else is not known yet, NaN if it could not be computed.
    pub deviation: f64,
    /// Its largest permitted standard deviation \[Nm or N\]; infinite if there is no bound.
    pub bound: f64,
    /// The joint: an index into `TorqueEstimate::joints`.
    pub joint: u32,
    /// Number of valid entries in `parts`.
    pub count: u32,
    /// 1 if the joint is prismatic: then it is a force \[N\].
    pub is_force: u32,
    /// Unused, zero.
    pub reserved: u32,
    /// What is likelier than the configured setup, if the readings contradict that; else empty.
    pub likelier: Line,
    /// What the F/T readings of its sub-tree have that nothing explains; else empty.
    pub unexplained: Line,
    /// What it rests on, the largest share first.
    pub parts: [BudgetPart; Self::CAPACITY],
}

impl BudgetPart {
    /// An unused entry.
    pub const NONE: Self = Self {
        name: Name::EMPTY,
        variance: 0.0,
        travel: 0.0,
        source: Source::Others.in_memory(),
        reserved: 0,
    };
}

impl TorqueBudget {
    /// Maximum number of parts. A joint of a free-floating humanoid's torso rests on a hundred and
    /// twenty.
    pub const CAPACITY: usize = 160;

    /// Nothing computed yet.
    #[must_use]
    pub fn new() -> Self {
        Self {
            header: Header::default(),
            torque: JointTorque::ABSENT,
            deviation: f64::NAN,
            bound: f64::INFINITY,
            joint: 0,
            count: 0,
            is_force: 0,
            reserved: 0,
            likelier: Line::EMPTY,
            unexplained: Line::EMPTY,
            parts: [BudgetPart::NONE; Self::CAPACITY],
        }
    }

    /// The unit of the torque.
    #[must_use]
    pub const fn unit(&self) -> &'static str {
        if self.is_force == 0 { "Nm" } else { "N" }
    }

    /// The valid parts.
    #[must_use]
    pub fn parts(&self) -> &[BudgetPart] {
        valid(&self.parts, self.count)
    }

    /// Adds a part, to an existing one of the same source and name if there is one; if there is no
    /// room, to the last one, which is [`Source::Others`] then.
    pub fn add(&mut self, part: BudgetPart) {
        let count = self.count as usize;
        let parts = self.parts.get_mut(..count).unwrap_or_default();
        let same = |own: &&mut BudgetPart| own.source == part.source && own.name == part.name;
        if let Some(own) = parts.iter_mut().find(same) {
            own.variance += part.variance;
            own.travel = own.travel.max(part.travel);
        } else if let Some(slot) = self.parts.get_mut(count) {
            *slot = part;
            self.count += 1;
        } else if let Some(last) = self.parts.last_mut() {
            *last = BudgetPart {
                variance: last.variance + part.variance,
                ..BudgetPart::NONE
            };
        }
    }

    /// Puts the largest shares first.
    pub fn sort(&mut self) {
        let parts = self.parts.get_mut(..self.count as usize);
        let by_size =
            |a: &BudgetPart, b: &BudgetPart| b.variance.abs().total_cmp(&a.variance.abs());
        parts.unwrap_or_default().sort_unstable_by(by_size);
    }
}

impl Default for TorqueBudget {
    fn default() -> Self {
        Self::new()
    }
}

const _: () = assert!(size_of::<BudgetPart>() == 88 && size_of::<Line>() == 256);
const _: () =
    assert!(size_of::<TorqueBudget>() == 56 + 32 + 32 + 2 * 256 + 88 * TorqueBudget::CAPACITY);

#[cfg(test)]
mod tests {
    use super::*;
    use core::fmt::Write as _;

    fn part(name: &str, variance: f64) -> BudgetPart {
        BudgetPart {
            name: Name::new(name).unwrap(),
            variance,
            ..BudgetPart::NONE
        }
    }

    #[test]
    fn parts_of_one_input_are_one_and_none_is_lost() {
        let mut budget = TorqueBudget::new();
        for number in 0..2 * TorqueBudget::CAPACITY {
            budget.add(part(&std::format!("{}", number % 400), 1.0));
        }
        budget.add(part("7", 2.0));
        budget.sort();
        let sum: f64 = budget.parts().iter().map(|own| own.variance).sum();
        assert_eq!(sum, 2.0 + 2.0 * TorqueBudget::CAPACITY as f64);
        let [first, second, ..] = budget.parts() else {
            panic!("{budget:?}")
        };
        assert_eq!(first.variance, 1.0 + TorqueBudget::CAPACITY as f64);
        assert_eq!((second.name.as_str(), second.variance), ("7", 3.0));
    }

    #[test]
    fn a_line_that_is_too_long_is_cut_between_letters() {
        let mut line = Line::EMPTY;
        assert!(write!(line, "{}", "ä".repeat(127)).is_ok());
        assert!(write!(line, "äb").is_err());
        assert_eq!(line.as_str(), "ä".repeat(127));
        assert!(write!(line, "b").is_ok());
        assert_eq!(line.as_str().len(), 255);
    }
}
