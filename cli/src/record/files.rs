//! The files that a recording takes along: configurations with everything that they name, so that
//! it can be read where they are not, or have changed.

use crate::folder::{read, with_files};
use anyhow::Context;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// The files of these configurations: names, and contents. That of an estimator is
/// `estimator.toml`, that of a gateway `gateway.toml`, whatever its name was.
pub(super) fn of(configurations: &[PathBuf]) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    let copies = TempDir::with_prefix("proprio-")?;
    for file in configurations {
        let folder = file.parent().unwrap_or(Path::new("."));
        let table = read(file)?;
        let name = match table.contains_key("bus") {
            true => "gateway.toml",
            false => "estimator.toml",
        };
        let copy =
            with_files(table, folder, copies.path()).with_context(|| file.display().to_string())?;
        fs::write(copies.path().join(name), toml::to_string(&copy)?)?;
    }
    let mut files = Vec::new();
    collect(copies.path(), copies.path(), &mut files)?;
    files.sort();
    Ok(files)
}

fn collect(folder: &Path, base: &Path, files: &mut Vec<(String, Vec<u8>)>) -> anyhow::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            collect(&path, base, files)?;
        } else {
            let name = path.strip_prefix(base)?.display().to_string();
            files.push((name, fs::read(&path)?));
        }
    }
    Ok(())
}
