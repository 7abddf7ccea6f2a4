//! When a residual of F/T readings is taken for more than chance, and how it is averaged over time.

use proprio_topics::Nanos;

/// The deviate above which a residual is significant. By chance one test of six degrees of freedom
/// exceeds it with probability 1.3e-7 (2.9e-7 if [`proprio_identification::statistics::deviate`]
/// were exact). The mean has some ten independent values a second, so it does every nine days in
/// each sub-tree; that of the instant every two hours at 1 kHz, if there were no error but the
/// noise of single readings.
pub(super) const SIGNIFICANT: f64 = 5.0;
/// Time constant of mean residuals.
pub(super) const TIME_CONSTANT: Nanos = Nanos::from_millis(50);

/// The part of an exponential mean that is left after this time.
pub(super) fn kept(since: Nanos) -> f64 {
    (-since.seconds() / TIME_CONSTANT.seconds()).exp()
}
