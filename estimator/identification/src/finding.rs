//! Something that a person should know, of a log or of what was identified.

/// How serious a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Good to know.
    Note,
    /// The result is sound as far as it goes, but something is wrong and should be looked at.
    Warning,
    /// This part of the input was not used, or nothing could be identified, because of it.
    Refusal,
}

/// What a finding is about, for a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum FindingCode {
    /// A log has columns, but nothing usable in them.
    Unreadable,
    /// Rows of a log could not be read.
    SkippedRows,
    /// A configured sensor is missing in a log.
    NeverSeen,
    /// Rows repeat the row before.
    RepeatedRows,
    /// Readings repeat the one before.
    Repeated,
    /// Timestamps occur twice or go backward.
    Timestamps,
    /// A channel has gaps.
    Gap,
    /// A channel does not change while the robot moves.
    Frozen,
    /// A joint never moves.
    JointStill,
    /// A channel is cut off at the end of its range.
    Saturated,
    /// A channel is in other units than SI.
    WrongUnits,
    /// Readings are several times what the masses of the URDF predict.
    Scale,
    /// A recorded derivative is not that of its signal.
    Derivative,
    /// Nothing moves.
    NoMotion,
    /// A log is too short.
    TooShort,
    /// Samples are further apart than a channel may be silent.
    SampleSpacing,
    /// A log is given twice.
    DuplicateLog,
    /// Samples lie far off their neighbours.
    Outliers,
    /// A channel has the wrong sign.
    WrongSign,
    /// An F/T sensor measures in another frame than configured.
    WrongFrame,
    /// Gravity points elsewhere than configured.
    WrongGravity,
    /// An undeclared contact or load acted.
    Disturbance,
    /// When disturbances acted did not converge.
    DisturbancesNotConverged,
    /// A load was picked up or put down.
    LoadChanged,
    /// The identified parameters do not explain the readings of a sensor.
    Unexplained,
    /// An encoder has another zero, or counts the other way round.
    EncoderOffset,
    /// A stream is stamped late or early.
    TimeOffset,
    /// Noise and prior weight did not converge.
    NotConverged,
    /// Parameters were shrunk to those of the CAD model.
    ShrunkToCad,
    /// There was too little data for cross-validation.
    NotCrossValidated,
    /// The inertia of a rotor comes out negative.
    NegativeRotorInertia,
    /// Rotor inertias were requested but cannot be identified.
    RotorsNotAvailable,
    /// A calibration was requested but cannot be identified.
    CalibrationNotAvailable,
    /// A change with temperature was requested, but none was recorded.
    NoTemperature,
    /// The motion does not show entries of a calibration.
    CalibrationNotObservable,
    /// A common gain error cannot be separated from mass.
    GainMassNotSeparable,
    /// The inertia of the URDF is that of no body, or nearly none.
    InertiaRegularised,
    /// Nothing was identified.
    NotIdentified,
}

impl FindingCode {
    /// The word for it in files.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Unreadable => "unreadable",
            Self::SkippedRows => "skipped_rows",
            Self::NeverSeen => "never_seen",
            Self::RepeatedRows => "repeated_rows",
            Self::Repeated => "repeated",
            Self::Timestamps => "timestamps",
            Self::Gap => "gap",
            Self::Frozen => "frozen",
            Self::JointStill => "joint_still",
            Self::Saturated => "saturated",
            Self::WrongUnits => "wrong_units",
            Self::Scale => "scale",
            Self::Derivative => "derivative",
            Self::NoMotion => "no_motion",
            Self::TooShort => "too_short",
            Self::SampleSpacing => "sample_spacing",
            Self::DuplicateLog => "duplicate_log",
            Self::Outliers => "outliers",
            Self::WrongSign => "wrong_sign",
            Self::WrongFrame => "wrong_frame",
            Self::WrongGravity => "wrong_gravity",
            Self::Disturbance => "disturbance",
            Self::DisturbancesNotConverged => "disturbances_not_converged",
            Self::LoadChanged => "load_changed",
            Self::Unexplained => "unexplained",
            Self::EncoderOffset => "encoder_offset",
            Self::TimeOffset => "time_offset",
            Self::NotConverged => "not_converged",
            Self::ShrunkToCad => "shrunk_to_cad",
            Self::NotCrossValidated => "not_cross_validated",
            Self::NegativeRotorInertia => "negative_rotor_inertia",
            Self::RotorsNotAvailable => "rotors_not_available",
            Self::CalibrationNotAvailable => "calibration_not_available",
            Self::NoTemperature => "no_temperature",
            Self::CalibrationNotObservable => "calibration_not_observable",
            Self::GainMassNotSeparable => "gain_mass_not_separable",
            Self::InertiaRegularised => "inertia_regularised",
            Self::NotIdentified => "not_identified",
        }
    }
}

impl std::fmt::Display for FindingCode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.as_str())
    }
}

/// Something found in a log, in the model or in the result, in words for a person.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// How serious it is.
    pub severity: Severity,
    /// What it is about, for a program.
    pub code: FindingCode,
    /// What it is about: the name of a channel, joint, link; empty if about everything.
    pub subject: String,
    /// One or two sentences: what, where, how much, what to do.
    pub text: String,
}
