//! Words that several parts of the page use: channels of a sensor, roles of logs, counts of things.

use proprio_identification::LogRole;

/// Channels of an F/T sensor, in the order of their six numbers.
pub(super) const WRENCH: [(&str, &str); 6] = [
    ("fx", "N"),
    ("fy", "N"),
    ("fz", "N"),
    ("tx", "Nm"),
    ("ty", "Nm"),
    ("tz", "Nm"),
];

pub(super) fn role_words(role: LogRole) -> &'static str {
    match role {
        LogRole::Train => "training",
        LogRole::Validate => "validation",
    }
}

/// A count with its noun: `1 plot`, `2 plots`.
pub(super) fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}
