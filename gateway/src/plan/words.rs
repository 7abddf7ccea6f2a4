//! Words of messages about a configuration.

/// The word that was probably meant, as the end of a message; empty if none is near.
#[must_use]
pub fn did_you_mean<'a>(unknown: &str, words: impl Iterator<Item = &'a str>) -> String {
    // Winkler's similarity, because most mistakes are at the end of a key; above 0.85 two words
    // share most letters, or one is the beginning of the other.
    words
        .map(|word| (strsim::jaro_winkler(unknown, word), word))
        .filter(|(similarity, _)| *similarity > 0.85)
        .max_by(|(a, _), (b, _)| a.total_cmp(b))
        .map_or_else(String::new, |(_, word)| format!("; did you mean {word:?}?"))
}

/// A list of names, each in quotes.
pub(super) fn quoted<S: AsRef<str>>(names: impl IntoIterator<Item = S>) -> String {
    let quoted = names.into_iter().map(|name| format!("{:?}", name.as_ref()));
    quoted.collect::<Vec<_>>().join(", ")
}
