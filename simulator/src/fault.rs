//! Faults of the simulated boards and buses on request.
//!
//! | text | effect |
//! |---|---|
//! | `lost:0.01` | every frame is lost with this probability; with `@2..8` only in that time |
//! | `silent:BOARD@3..4` | the board neither sends nor listens, then continues |
//! | `reboot:BOARD@5` | the board is off for half a second, then waits to be started |
//! | `saturate:BOARD@5..5.5` | a gauge is at its upper end: flagged, values frozen |
//! | `freeze:BOARD@5..6` | the board repeats its last reading, and does not say so |
//! | `spike:BOARD@6` | one reading is wrong by 200 N and 5 Nm on every axis |
//! | `late:BOARD=0.02@2..` | the board sends what it measured 0.02 s before, as if it were new |
//! | `late_half:BOARD@2..8` | second halves of about one reading in ten are late |
//! | `push:l_forearm=20@8..9` | an undeclared force of 20 N pushes this link of the URDF |
//! | `push:l_forearm=20:0.03,-0.07,0:-1,0,0@8..9` | the same, at this point and in this direction |
//! | `still:l_elbow` | this joint of the URDF does not move |
//! | `still:l_elbow=0.8` | it does not move, and stands at 0.8 rad (or m) |
//!
//! A late half follows just after the next reading's first half; `late_half:BOARD@6` delays one
//! reading. A push acts at the origin of the link's frame along its x axis, or at the point \[m\]
//! and in the direction given in that frame. A skin of estimator.toml feels it where it is.
//!
//! Times are seconds since the start of the simulation; the end may be omitted (`5..`). BOARD is
//! the board's name in gateway.toml or the name of one of its channels.

use std::fmt;
use std::str::FromStr;

/// One fault.
#[derive(Debug, Clone, PartialEq)]
pub enum InjectedFault {
    /// Frames are lost on all buses.
    Lost {
        /// Probability for each frame, 0 to 1.
        probability: f64,
        /// When.
        window: TimeWindow,
    },
    /// A board neither sends nor listens.
    Silent {
        /// Which.
        device: String,
        /// When.
        window: TimeWindow,
    },
    /// A board loses its state and starts again.
    Reboot {
        /// Which.
        device: String,
        /// When \[s\].
        at: f64,
    },
    /// An F/T sensor is saturated.
    Saturate {
        /// Which.
        device: String,
        /// When.
        window: TimeWindow,
    },
    /// A board repeats its last reading.
    Freeze {
        /// Which.
        device: String,
        /// When.
        window: TimeWindow,
    },
    /// One F/T reading is far from the truth.
    Spike {
        /// Whose.
        device: String,
        /// When \[s\].
        at: f64,
    },
    /// A board sends old readings as new ones.
    Late {
        /// Whose.
        device: String,
        /// How old they are \[s\].
        age: f64,
        /// When.
        window: TimeWindow,
    },
    /// Second halves of readings are late.
    LateHalf {
        /// Whose.
        device: String,
        /// When.
        window: TimeWindow,
        /// Only the first reading in the window.
        once: bool,
    },
    /// An undeclared force pushes the robot.
    Push {
        /// The link of the URDF.
        link: String,
        /// The force \[N\].
        force: f64,
        /// Where it acts in the link's frame \[m\]; default: at its origin.
        at: Option<[f64; 3]>,
        /// Its direction in the link's frame, of any length; default: along the x axis.
        along: Option<[f64; 3]>,
        /// When.
        window: TimeWindow,
    },
    /// A joint does not move.
    Still {
        /// The joint of the URDF.
        joint: String,
        /// Where it stands \[rad or m\]; default: in the middle of its range.
        at: Option<f64>,
    },
}

/// A time window in seconds since the start of the simulation, excluding its end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeWindow {
    /// Start \[s\].
    pub from: f64,
    /// End \[s\], excluded; infinite if the window never ends.
    pub until: f64,
}

impl TimeWindow {
    /// The whole simulation.
    pub(crate) const ALWAYS: Self = Self {
        from: 0.0,
        until: f64::INFINITY,
    };

    /// Whether `t` \[s\] is in the window.
    #[must_use]
    pub fn contains(&self, t: f64) -> bool {
        t >= self.from && t < self.until
    }
}

/// A fault that is not valid or not possible for this robot.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FaultError {
    /// The fault begins after the end of the run.
    #[error("fault {text:?} begins after the end of the run ({seconds} s)")]
    AfterEnd {
        /// The fault as given.
        text: String,
        /// Duration of the run \[s\].
        seconds: f64,
    },
    /// The kind of fault is not known.
    #[error(
        "fault {text:?}: {kind:?} is not known; known are lost, silent, reboot, saturate, \
         freeze, spike, late, late_half, push, still; for example {EXAMPLES}"
    )]
    Kind {
        /// What was typed.
        text: String,
        /// Its kind.
        kind: String,
    },
    /// Its form is wrong.
    #[error("fault {text:?}: it must have the form {form}")]
    Form {
        /// What was typed.
        text: String,
        /// The legal form, with an example.
        form: &'static str,
    },
    /// The robot has no such board.
    #[error(
        "fault {fault}: this robot has no board or channel {device:?}; it has {}",
        known.join(", ")
    )]
    Device {
        /// The fault.
        fault: String,
        /// Whose it should be.
        device: String,
        /// The boards.
        known: Vec<String>,
    },
    /// This fault is not possible for this board.
    #[error("fault {fault}: {device:?} is not {needed}")]
    NotPossible {
        /// The fault.
        fault: String,
        /// Whose it should be.
        device: String,
        /// The kind of board that the fault needs.
        needed: &'static str,
    },
}

const EXAMPLES: &str =
    "\"lost:0.01\", \"silent:l_arm_ft_sensor@3..4\", \"spike:l_arm_ft_sensor@6\"";

impl InjectedFault {
    /// When it begins \[s\].
    #[must_use]
    pub fn begin(&self) -> f64 {
        match self {
            Self::Lost { window, .. }
            | Self::Silent { window, .. }
            | Self::Saturate { window, .. }
            | Self::Freeze { window, .. }
            | Self::Late { window, .. }
            | Self::LateHalf { window, .. }
            | Self::Push { window, .. } => window.from,
            Self::Reboot { at, .. } | Self::Spike { at, .. } => *at,
            Self::Still { .. } => 0.0,
        }
    }

    /// The board concerned.
    #[must_use]
    pub fn device(&self) -> Option<&str> {
        match self {
            Self::Lost { .. } | Self::Push { .. } | Self::Still { .. } => None,
            Self::Silent { device, .. }
            | Self::Reboot { device, .. }
            | Self::Saturate { device, .. }
            | Self::Freeze { device, .. }
            | Self::Spike { device, .. }
            | Self::Late { device, .. }
            | Self::LateHalf { device, .. } => Some(device),
        }
    }
}

/// `5`, as seconds.
fn instant(text: &str) -> Option<f64> {
    number(text.trim()).filter(|t| *t >= 0.0)
}

/// `3..4` or `3..`.
fn window(text: &str) -> Option<TimeWindow> {
    let (from, until) = text.split_once("..")?;
    let from = instant(from)?;
    let until = if until.trim().is_empty() {
        f64::INFINITY
    } else {
        instant(until)?
    };
    (from < until).then_some(TimeWindow { from, until })
}

/// A finite number.
fn number(text: &str) -> Option<f64> {
    text.parse().ok().filter(|x: &f64| x.is_finite())
}

/// `NAME=REST` with a name.
fn named(text: &str) -> Option<(String, &str)> {
    let (name, rest) = text.split_once('=')?;
    (!name.is_empty()).then(|| (name.to_owned(), rest))
}

/// `0.03,-0.07,0`.
fn vector(text: &str) -> Option<[f64; 3]> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|x| number(x.trim())).collect();
    numbers?.try_into().ok()
}

/// The form of each kind of fault, and an example.
const FORMS: [&str; 10] = [
    "lost:PROBABILITY[@FROM..UNTIL] with a probability from 0 to 1, for example \"lost:0.01\"",
    "silent:BOARD@FROM..UNTIL, for example \"silent:l_arm_ft_sensor@3..4\"",
    "reboot:BOARD@TIME, for example \"reboot:l_arm_ft_sensor@5\"",
    "saturate:BOARD@FROM..UNTIL, for example \"saturate:l_arm_ft_sensor@5..5.5\"",
    "freeze:BOARD@FROM..UNTIL, for example \"freeze:l_arm_ft_sensor@5..6\"",
    "spike:BOARD@TIME, for example \"spike:l_arm_ft_sensor@6\"",
    "late:BOARD=SECONDS@FROM..UNTIL, for example \"late:l_arm_ft_sensor=0.02@5..8\"",
    "late_half:BOARD@FROM..UNTIL or late_half:BOARD@TIME, for example \
     \"late_half:l_arm_ft_sensor@2..8\"",
    "push:LINK=NEWTONS[:X,Y,Z[:DX,DY,DZ]]@FROM..UNTIL, for example \"push:l_forearm=20@8..9\"",
    "still:JOINT[=RAD], for example \"still:l_elbow=0.8\"",
];

impl FromStr for InjectedFault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let (kind, rest) = text.split_once(':').unwrap_or((text, ""));
        let (what, when) = match rest.rsplit_once('@') {
            Some((what, when)) => (what, Some(when)),
            None => (rest, None),
        };
        let of_kind = |form: &&str| form.split(':').next() == Some(kind);
        let known = FORMS.into_iter().find(of_kind);
        let form = known.ok_or_else(|| FaultError::Kind {
            text: text.to_owned(),
            kind: kind.to_owned(),
        })?;
        Self::parse(kind, what, when).ok_or_else(|| FaultError::Form {
            text: text.to_owned(),
            form,
        })
    }
}

impl InjectedFault {
    /// The fault `kind:what@when`; `None` if it has not the form of its kind.
    fn parse(kind: &str, what: &str, when: Option<&str>) -> Option<Self> {
        let device = what.to_owned();
        let is_named = !what.is_empty();
        let span = when.and_then(window).filter(|_| is_named);
        let moment = when.and_then(instant).filter(|_| is_named);
        Some(match (kind, span, moment) {
            ("lost", ..) => Self::Lost {
                probability: number(what).filter(|p| (0.0..=1.0).contains(p))?,
                window: when.map_or(Some(TimeWindow::ALWAYS), window)?,
            },
            ("silent", Some(window), _) => Self::Silent { device, window },
            ("saturate", Some(window), _) => Self::Saturate { device, window },
            ("freeze", Some(window), _) => Self::Freeze { device, window },
            ("reboot", _, Some(at)) => Self::Reboot { device, at },
            ("spike", _, Some(at)) => Self::Spike { device, at },
            ("late", Some(window), _) => {
                let (device, age) = named(what)?;
                Self::Late {
                    device,
                    age: number(age.trim()).filter(|age| *age > 0.0)?,
                    window,
                }
            }
            ("late_half", ..) => Self::LateHalf {
                device,
                window: span.or(moment.map(|from| TimeWindow {
                    from,
                    until: f64::INFINITY,
                }))?,
                once: span.is_none(),
            },
            ("push", Some(window), _) => {
                let (link, rest) = named(what)?;
                let mut parts = rest.split(':');
                let force = number(parts.next()?.trim())?;
                let at = parts.next().map(vector);
                let along = parts.next().map(vector);
                if parts.next().is_some() || along == Some(Some([0.0; 3])) {
                    return None;
                }
                // A vector that is given must be one.
                let given = |vector: Option<Option<_>>| vector.map_or(Some(None), |v| v.map(Some));
                Self::Push {
                    link,
                    force,
                    at: given(at)?,
                    along: given(along)?,
                    window,
                }
            }
            ("still", ..) => {
                let (joint, at) = match what.split_once('=') {
                    Some((joint, at)) => (joint, Some(number(at.trim())?)),
                    None => (what, None),
                };
                let joint = joint.to_owned();
                (!joint.is_empty() && when.is_none()).then_some(Self::Still { joint, at })?
            }
            _ => return None,
        })
    }
}

impl fmt::Display for TimeWindow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.until.is_finite() {
            write!(f, "{}..{}", self.from, self.until)
        } else {
            write!(f, "{}..", self.from)
        }
    }
}

impl fmt::Display for InjectedFault {
    /// The fault in its text form.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Lost {
                probability,
                window,
            } if *window == TimeWindow::ALWAYS => write!(f, "lost:{probability}"),
            Self::Lost {
                probability,
                window,
            } => write!(f, "lost:{probability}@{window}"),
            Self::Silent { device, window } => write!(f, "silent:{device}@{window}"),
            Self::Reboot { device, at } => write!(f, "reboot:{device}@{at}"),
            Self::Saturate { device, window } => write!(f, "saturate:{device}@{window}"),
            Self::Freeze { device, window } => write!(f, "freeze:{device}@{window}"),
            Self::Spike { device, at } => write!(f, "spike:{device}@{at}"),
            Self::Late {
                device,
                age,
                window,
            } => write!(f, "late:{device}={age}@{window}"),
            Self::Still { joint, at } => {
                write!(f, "still:{joint}")?;
                at.map_or(Ok(()), |at| write!(f, "={at}"))
            }
            Self::LateHalf {
                device,
                window,
                once: true,
            } => write!(f, "late_half:{device}@{}", window.from),
            Self::LateHalf {
                device,
                window,
                once: false,
            } => write!(f, "late_half:{device}@{window}"),
            Self::Push {
                link,
                force,
                at,
                along,
                window,
            } => {
                write!(f, "push:{link}={force}")?;
                for [x, y, z] in at.iter().chain(along) {
                    write!(f, ":{x},{y},{z}")?;
                }
                write!(f, "@{window}")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_typed_is_what_is_printed() {
        for text in [
            "lost:0.01",
            "lost:1@2..8",
            "silent:l_arm_ft_sensor@3..4",
            "silent:l_arm_ft_sensor@3..",
            "reboot:chest_imu@5",
            "saturate:l_arm_ft_sensor@5..5.5",
            "freeze:l_arm_ft_sensor@5..6",
            "spike:l_arm_ft_sensor@6",
            "late:l_arm_ft_sensor=0.02@2..8",
            "still:l_elbow",
            "still:l_elbow=-0.8",
            "late_half:l_arm_ft_sensor@2..8",
            "late_half:l_arm_ft_sensor@2.5",
            "push:l_forearm=20@8..9",
            "push:l_hand=-2.5@3..",
            "push:l_hand=20:0.01,-0.02,0@3..4",
            "push:l_hand=20:0.01,-0.02,0:0,-1,0.5@3..4",
        ] {
            assert_eq!(text.parse::<InjectedFault>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn each_mistake_is_answered_with_what_would_be_legal() {
        for (text, expected) in [
            (
                "lose:0.1",
                "\"lose\" is not known; known are lost, silent, reboot",
            ),
            ("lost:1.5", "lost:PROBABILITY"),
            ("lost", "lost:PROBABILITY"),
            ("lost:0.1@4..3", "lost:PROBABILITY"),
            (
                "silent:ft",
                "silent:BOARD@FROM..UNTIL, for example \"silent:l_arm_ft_sensor@3..4\"",
            ),
            ("silent:ft@3", "silent:BOARD@FROM..UNTIL"),
            ("silent:@3..4", "silent:BOARD@FROM..UNTIL"),
            ("spike:ft@-1", "spike:BOARD@TIME"),
            ("spike:ft@nan", "spike:BOARD@TIME"),
            ("reboot:ft@1..2", "reboot:BOARD@TIME"),
            ("saturate:ft@inf..", "saturate:BOARD@FROM..UNTIL"),
            ("freeze:ft@5", "freeze:BOARD@FROM..UNTIL"),
            ("late:ft@2..8", "late:BOARD=SECONDS@FROM..UNTIL"),
            ("late:=0.1@2..8", "late:BOARD=SECONDS@FROM..UNTIL"),
            ("late:ft=-1@2..8", "late:BOARD=SECONDS@FROM..UNTIL"),
            ("late:ft=0.1", "late:BOARD=SECONDS@FROM..UNTIL"),
            ("still:", "still:JOINT"),
            ("still:=1", "still:JOINT"),
            ("still:l_elbow=", "still:JOINT"),
            ("still:l_elbow=inf", "still:JOINT"),
            ("still:l_elbow@3..", "still:JOINT"),
            ("late_half:ft", "late_half:BOARD@FROM..UNTIL or"),
            (
                "push:hand@1..2",
                "push:LINK=NEWTONS[:X,Y,Z[:DX,DY,DZ]]@FROM..UNTIL",
            ),
            ("push:hand=2:1,2@1..2", "push:LINK=NEWTONS["),
            ("push:hand=2:1,2,nan@1..2", "push:LINK=NEWTONS["),
            ("push:hand=2:1,2,3:0,0,0@1..2", "push:LINK=NEWTONS["),
            ("push:hand=2:1,2,3:0,0,1:4@1..2", "push:LINK=NEWTONS["),
            (
                "push:=5@1..2",
                "push:LINK=NEWTONS[:X,Y,Z[:DX,DY,DZ]]@FROM..UNTIL",
            ),
            (
                "push:hand=5@3",
                "push:LINK=NEWTONS[:X,Y,Z[:DX,DY,DZ]]@FROM..UNTIL",
            ),
            (
                "push:hand=hard@1..2",
                "push:LINK=NEWTONS[:X,Y,Z[:DX,DY,DZ]]@FROM..UNTIL",
            ),
        ] {
            let message = text.parse::<InjectedFault>().unwrap_err().to_string();
            assert!(message.contains(expected), "{text}: {message}");
        }
    }
}
