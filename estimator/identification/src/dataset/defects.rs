//! The defects of a log. The text of each states what is wrong, where, how much, and what to do.

use crate::finding::Severity;
use proprio_topics::Nanos;
use std::fmt;

/// Least duration of a log \[s\], and least number of rows of a log without stamps.
pub(crate) const LEAST_SECONDS: f64 = 2.0;
pub(crate) const LEAST_ROWS: u64 = 20;

/// The apparent units of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Units {
    /// Positions in degrees.
    Degrees,
    /// Forces or torques far beyond the robot's weight: converter counts, or thousandths.
    Counts,
    /// A proper acceleration that is not near gravity.
    NotMetresPerSecondSquared,
}

/// Something wrong with a log. [`fmt::Display`] states what, where, how much, and what to do.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Defect {
    /// The log cannot be used.
    Unreadable {
        /// The reason.
        reason: String,
    },
    /// Rows that could not be read.
    SkippedRows {
        /// Number of rows.
        rows: u64,
        /// Line of the first.
        line: u64,
        /// The error in it.
        reason: String,
    },
    /// The log has no sample of a configured sensor.
    NeverSeen {
        /// Its channel.
        channel: String,
    },
    /// Rows that repeat the previous row.
    RepeatedRows {
        /// Number of rows.
        rows: usize,
        /// Time of the first.
        first: Nanos,
    },
    /// Readings that repeat the previous one exactly.
    Repeated {
        /// The channel.
        channel: String,
        /// Number of repeats.
        samples: usize,
        /// Number of samples.
        of: usize,
    },
    /// Stamps that are not later than the previous one.
    Stamps {
        /// The channel.
        channel: String,
        /// Samples excluded because of a repeated stamp.
        repeated: usize,
        /// Samples excluded because their stamps go backward.
        backward: usize,
        /// Time of the first.
        first: Nanos,
    },
    /// Intervals without samples.
    Gaps {
        /// The channel.
        channel: String,
        /// Number of gaps.
        gaps: usize,
        /// Their total length.
        total: Nanos,
        /// The longest.
        longest: Nanos,
        /// Start of the longest.
        at: Nanos,
    },
    /// A channel that repeats its reading while the robot moves.
    Frozen {
        /// The channel.
        channel: String,
        /// Start.
        from: Nanos,
        /// End.
        to: Nanos,
    },
    /// Readings that their device repeats instead of measuring, as the log's quality tells.
    MarkedFrozen {
        /// The channel.
        channel: String,
        /// Number of samples.
        samples: usize,
        /// Time of the first.
        first: Nanos,
    },
    /// A joint whose position never changes.
    Still {
        /// The channel.
        channel: String,
    },
    /// A quantity that stays at its extreme while others change.
    Saturated {
        /// The channel.
        channel: String,
        /// The quantity; empty if the device itself reports saturation.
        axis: &'static str,
        /// Number of samples.
        samples: usize,
        /// Time of the first.
        first: Nanos,
        /// The extreme value; NaN if the device itself reports saturation.
        value: f64,
    },
    /// A channel in other units than SI.
    WrongUnits {
        /// The channels.
        channels: Vec<String>,
        /// The apparent units.
        units: Units,
        /// The magnitude that shows it, in the expected unit.
        magnitude: f64,
    },
    /// A given derivative that does not match the derivative of the other quantity.
    Derivative {
        /// The joint.
        joint: String,
        /// `velocity` or `acceleration`.
        given: &'static str,
        /// The ratio of the true derivative to the given one.
        factor: f64,
    },
    /// A given derivative that is noisier than the one of the positions, and is not used.
    NoisyDerivative {
        /// The joint.
        joint: String,
        /// `velocity` or `acceleration`.
        given: &'static str,
        /// RMS of its difference from the derivative of the positions, SI.
        off: f64,
    },
    /// The robot does not move.
    NoMotion {
        /// The largest motion of any joint \[rad or m\].
        most: f64,
    },
    /// The log is too short.
    TooShort {
        /// Its duration \[s\]; 0 for a log without stamps.
        seconds: f64,
        /// Number of rows.
        rows: u64,
        /// Where its time begins to run backward, if most samples were excluded because of that.
        backward: Option<Nanos>,
    },
    /// Samples far from their neighbours.
    Outliers {
        /// The channel.
        channel: String,
        /// The quantity.
        axis: &'static str,
        /// Number of samples.
        samples: usize,
        /// The largest deviation, in the quantity's unit.
        largest: f64,
        /// Its time.
        t: Nanos,
    },
    /// An F/T sensor whose readings fit the model only with the opposite sign.
    WrongSign {
        /// The channel.
        sensor: String,
    },
    /// An F/T sensor whose readings fit the model only in another frame.
    WrongFrame {
        /// The channel.
        sensor: String,
        /// The configuration that fits.
        instead: String,
    },
}

/// The SI unit of a quantity of a channel.
fn unit(axis: &str) -> &'static str {
    match axis {
        "fx" | "fy" | "fz" => "N",
        "tx" | "ty" | "tz" | "torque" => "Nm",
        "ax" | "ay" | "az" => "m/s^2",
        "gx" | "gy" | "gz" => "rad/s",
        "position" => "rad (or m)",
        _ => "",
    }
}

impl Defect {
    /// Its severity.
    #[must_use]
    pub fn severity(&self) -> Severity {
        match self {
            Self::Still { .. } => Severity::Note,
            Self::Unreadable { .. }
            | Self::NoMotion { .. }
            | Self::TooShort { .. }
            | Self::WrongUnits { .. } => Severity::Refusal,
            _ => Severity::Warning,
        }
    }
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unreadable { reason } => f.write_str(reason),
            Self::SkippedRows { rows, line, reason } => write!(
                f,
                "{rows} rows cannot be read and were skipped; the first: line {line}: {reason}"
            ),
            Self::NeverSeen { channel } => write!(
                f,
                "{channel} is in the configuration but has no sample: everything that \
                 needs it is excluded; record it, or remove it from the configuration"
            ),
            Self::RepeatedRows { rows, first } => write!(
                f,
                "{rows} rows repeat the previous row, the first at {first} s: they were excluded; \
                 let the recorder wait for new samples"
            ),
            Self::Repeated {
                channel,
                samples,
                of,
            } => write!(
                f,
                "{channel} repeats its last reading in {samples} of {of} samples: these were \
                 excluded; the sensor is slower than the recording"
            ),
            Self::Stamps {
                channel,
                repeated,
                backward,
                first,
            } => write!(
                f,
                "{channel}: {repeated} stamps occur twice and {backward} go backward, the first \
                 at {first} s: these samples were excluded; check the recorder's clock"
            ),
            Self::Gaps {
                channel,
                gaps,
                total,
                longest,
                at,
            } => write!(
                f,
                "{channel} has no samples for {:.3} s in {gaps} gaps, the longest of {:.3} s from \
                 {at} s on: these times are excluded",
                total.seconds(),
                longest.seconds()
            ),
            Self::Frozen { channel, from, to } => write!(
                f,
                "{channel} does not change from {from} s to {to} s while the robot moves: this \
                 time is excluded; check the cable and the board"
            ),
            Self::MarkedFrozen {
                channel,
                samples,
                first,
            } => write!(
                f,
                "{channel} is frozen in {samples} samples, the first at {first} s: its board \
                 repeats its readings instead of measuring; they are excluded; check the board, \
                 its cable and its temperature, and switch it off and on"
            ),
            Self::Still { channel } => write!(
                f,
                "{channel} never changes: the joint stands still, or its encoder is dead; \
                 parameters that need its motion keep their URDF values"
            ),
            Self::Saturated {
                channel,
                samples,
                first,
                value,
                ..
            } if value.is_nan() => write!(
                f,
                "{channel} reports saturation in {samples} samples, the first at {first} s: they \
                 are excluded; move more gently or use a larger range"
            ),
            Self::Saturated {
                channel,
                axis,
                samples,
                first,
                value,
            } => write!(
                f,
                "{channel}: {axis} is saturated at {value} in {samples} samples, the first at \
                 {first} s: they are excluded; move more gently or use a larger range"
            ),
            Self::WrongUnits {
                channels,
                units,
                magnitude,
            } => {
                let names = channels.join(", ");
                match units {
                    Units::Degrees => write!(
                        f,
                        "{names}: positions up to {magnitude:.4} rad are far beyond the URDF's \
                         limits, but within them as degrees: convert all joints to radians"
                    ),
                    Units::Counts => write!(
                        f,
                        "{names}: a typical magnitude of {magnitude:.4} N is more than 100 times \
                         the robot's weight: the unit is counts or thousandths; convert it to N \
                         and Nm"
                    ),
                    Units::NotMetresPerSecondSquared => write!(
                        f,
                        "{names}: a typical proper acceleration of {magnitude:.4} m/s^2 is not \
                         near 9.8: convert it to m/s^2"
                    ),
                }
            }
            Self::Derivative {
                joint,
                given,
                factor,
            } => write!(
                f,
                "joint/{joint}: the logged {given} must be multiplied by {factor:.4} to match the \
                 derivative of the other column: check its unit and sign, or remove the column"
            ),
            Self::NoisyDerivative { joint, given, off } => write!(
                f,
                "joint/{joint}: the logged {given} is not that of the positions: {off:.3} {} off, \
                 most of it noise; it is not used",
                if *given == "velocity" {
                    "rad/s"
                } else {
                    "rad/s^2"
                }
            ),
            Self::NoMotion { most } => write!(
                f,
                "no joint moves by more than {most:.4} rad: without motion, weights are not \
                 separable from offsets; record motion"
            ),
            Self::TooShort {
                seconds,
                rows,
                backward: Some(at),
            } => write!(
                f,
                "its time runs backward, first at {at} s: in order are only \
                 {seconds:.2} s of its {rows} rows; t must grow from row to row: sort the rows, or \
                 correct the recorder's clock"
            ),
            Self::TooShort { seconds, rows, .. } if *seconds > 0.0 => {
                write!(
                    f,
                    "the log of {seconds:.2} s ({rows} rows) is too short: record at least \
                     {LEAST_SECONDS} s of motion, better 30 s"
                )
            }
            Self::TooShort { rows, .. } => write!(
                f,
                "the log of {rows} rows is too short: record at least {LEAST_ROWS}"
            ),
            Self::Outliers {
                channel,
                axis,
                samples,
                largest,
                t,
            } => write!(
                f,
                "{channel}: {} of {axis}, the largest by {largest:.4} {} at {t} s: excluded",
                if *samples == 1 {
                    "1 outlier".to_owned()
                } else {
                    format!("{samples} outliers")
                },
                unit(axis)
            ),
            Self::WrongSign { sensor } => write!(
                f,
                "wrench/{sensor} fits only with the opposite sign (masses would be negative): \
                 check `direction` and `frame` in the configuration and, if an IMU measures \
                 gravity, that it is not upside down"
            ),
            Self::WrongFrame { sensor, instead } => write!(
                f,
                "wrench/{sensor} does not fit the links beyond it in the configured frame, but \
                 would with {instead}: check its mounting, and `frame` and `direction` in its \
                 [[force_torque]]"
            ),
        }
    }
}
