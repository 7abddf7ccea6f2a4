//! Opens and reads recorded logs, and names them.

use crate::convert::check_header;
use crate::samples;
use anyhow::Context;
use proprio_estimator::sample_log;
use proprio_estimator::setup::Setup;
use proprio_identification::{Dataset, LogRole};
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

/// Opens a log and checks its columns.
pub(super) fn open(
    file: &Path,
    config: &Path,
    setup: &Setup,
) -> anyhow::Result<impl Read + Send + use<>> {
    let log = File::open(file).with_context(|| format!("{}: cannot be read", file.display()))?;
    let mut table = BufReader::with_capacity(1 << 18, samples::table(log, file)?);
    let mut header = Vec::new();
    // Skip blank lines before the header.
    while header.trim_ascii().is_empty() {
        let read = table
            .read_until(b'\n', &mut header)
            .with_context(|| format!("{}: cannot be read", file.display()))?;
        if read == 0 {
            break;
        }
    }
    check_header(&header, file, config, setup)?;
    Ok(Cursor::new(header).chain(table))
}

/// Reads a log.
pub(super) fn read(
    setup: &Setup,
    name: &str,
    role: LogRole,
    table: &mut (impl Read + Send),
) -> anyhow::Result<Dataset> {
    let dataset = sample_log::dataset_or_unreadable(&setup.robot, name, role, table);
    dataset.with_context(|| name.to_owned())
}

/// Names of the logs: file names, with as many parent folders as make them unique.
pub(super) fn names(files: &[(&PathBuf, LogRole)]) -> Vec<String> {
    let short = |file: &Path, parts: usize| -> String {
        let all: Vec<_> = file
            .components()
            .map(|c| c.as_os_str().to_string_lossy())
            .collect();
        all.get(all.len().saturating_sub(parts)..)
            .unwrap_or_default()
            .join("/")
    };
    files
        .iter()
        .map(|(file, _)| {
            let most = file.components().count();
            let alone = |parts: &usize| {
                files
                    .iter()
                    .filter(|(f, _)| short(f, *parts) == short(file, *parts))
                    .count()
                    == 1
            };
            let name = (1..=most).find(alone).map(|parts| short(file, parts));
            name.unwrap_or_else(|| file.display().to_string())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logs_have_the_shortest_unique_names() {
        let files: Vec<PathBuf> = [
            "/a/one/x.csv",
            "/a/two/x.csv",
            "y.csv",
            "/a/two/y.csv",
            "/z.csv",
            "/z.csv",
        ]
        .map(PathBuf::from)
        .to_vec();
        let files: Vec<(&PathBuf, LogRole)> = files.iter().map(|f| (f, LogRole::Train)).collect();
        assert_eq!(
            names(&files),
            [
                "one/x.csv",
                "two/x.csv",
                "y.csv",
                "two/y.csv",
                "/z.csv",
                "/z.csv"
            ]
        );
    }
}
