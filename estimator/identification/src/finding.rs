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

macro_rules! codes {
    ($($(#[$meaning:meta])* $code:ident => $word:literal,)*) => {
        /// What a finding is about, for a program.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[non_exhaustive]
        pub enum FindingCode {
            $($(#[$meaning])* $code,)*
        }

        impl FindingCode {
            /// The word for it in files.
            #[must_use]
            pub const fn as_str(self) -> &'static str {
                match self {
                    $(Self::$code => $word,)*
                }
            }
        }
    };
}

codes! {
    /// A log has columns, but nothing usable in them.
    Unreadable => "unreadable",
    /// Rows of a log could not be read.
    SkippedRows => "skipped_rows",
    /// A configured sensor is missing in a log.
    NeverSeen => "never_seen",
    /// Rows repeat the row before.
    RepeatedRows => "repeated_rows",
    /// Readings repeat the one before.
    Repeated => "repeated",
    /// Timestamps occur twice or go backward.
    Timestamps => "timestamps",
    /// A channel has gaps.
    Gap => "gap",
    /// A channel does not change while the robot moves.
    Frozen => "frozen",
    /// A joint never moves.
    JointStill => "joint_still",
    /// A channel is cut off at the end of its range.
    Saturated => "saturated",
    /// A channel is in other units than SI.
    WrongUnits => "wrong_units",
    /// Readings are several times what the masses of the URDF predict.
    Scale => "scale",
    /// A recorded derivative is not that of its signal.
    Derivative => "derivative",
    /// Nothing moves.
    NoMotion => "no_motion",
    /// A log is too short.
    TooShort => "too_short",
    /// Samples are further apart than a channel may be silent.
    SampleSpacing => "sample_spacing",
    /// A log is given twice.
    DuplicateLog => "duplicate_log",
    /// Samples lie far off their neighbours.
    Outliers => "outliers",
    /// A channel has the wrong sign.
    WrongSign => "wrong_sign",
    /// An F/T sensor measures in another frame than configured.
    WrongFrame => "wrong_frame",
    /// Gravity points elsewhere than configured.
    WrongGravity => "wrong_gravity",
    /// An undeclared contact or load acted.
    Disturbance => "disturbance",
    /// When disturbances acted did not converge.
    DisturbancesNotConverged => "disturbances_not_converged",
    /// A load was picked up or put down.
    LoadChanged => "load_changed",
    /// The identified parameters do not explain the readings of a sensor.
    Unexplained => "unexplained",
    /// An encoder has another zero, or counts the other way round.
    EncoderOffset => "encoder_offset",
    /// A stream is stamped late or early.
    TimeOffset => "time_offset",
    /// Noise and prior weight did not converge.
    NotConverged => "not_converged",
    /// Parameters were shrunk to those of the CAD model.
    ShrunkToCad => "shrunk_to_cad",
    /// There was too little data for cross-validation.
    NotCrossValidated => "not_cross_validated",
    /// The inertia of a rotor comes out negative.
    NegativeRotorInertia => "negative_rotor_inertia",
    /// Rotor inertias were requested but cannot be identified.
    RotorsNotAvailable => "rotors_not_available",
    /// A calibration was requested but cannot be identified.
    CalibrationNotAvailable => "calibration_not_available",
    /// A change with temperature was requested, but none was recorded.
    NoTemperature => "no_temperature",
    /// The motion does not show entries of a calibration.
    CalibrationNotObservable => "calibration_not_observable",
    /// A common gain error cannot be separated from mass.
    GainMassNotSeparable => "gain_mass_not_separable",
    /// The inertia of the URDF is that of no body, or nearly none.
    InertiaRegularised => "inertia_regularised",
    /// Nothing was identified.
    NotIdentified => "not_identified",
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

impl Finding {
    pub(crate) fn new(
        severity: Severity,
        code: FindingCode,
        subject: impl Into<String>,
        text: impl Into<String>,
    ) -> Self {
        let (subject, text) = (subject.into(), text.into());
        Self {
            severity,
            code,
            subject,
            text,
        }
    }

    pub(crate) fn note(
        code: FindingCode,
        subject: impl Into<String>,
        text: impl Into<String>,
    ) -> Self {
        Self::new(Severity::Note, code, subject, text)
    }

    pub(crate) fn warning(
        code: FindingCode,
        subject: impl Into<String>,
        text: impl Into<String>,
    ) -> Self {
        Self::new(Severity::Warning, code, subject, text)
    }

    pub(crate) fn refusal(
        code: FindingCode,
        subject: impl Into<String>,
        text: impl Into<String>,
    ) -> Self {
        Self::new(Severity::Refusal, code, subject, text)
    }
}
