//! The folder of a robot's configuration, and the files that a configuration names.

use anyhow::Context;
use std::fs;
use std::path::{Component, Path, PathBuf};

/// Where copies of files are put that lie outside the robot's folder.
const ELSEWHERE: &str = "elsewhere";

/// Reads a configuration file.
pub(crate) fn read(file: &Path) -> anyhow::Result<toml::Table> {
    let text =
        fs::read_to_string(file).with_context(|| format!("{}: cannot be read", file.display()))?;
    text.parse().with_context(|| file.display().to_string())
}

/// Copies every file that `table`, a configuration in the folder `from`, names to the folder `to`.
/// Returns the configuration that names the copies.
pub(crate) fn with_files(
    table: toml::Table,
    from: &Path,
    to: &Path,
) -> anyhow::Result<toml::Table> {
    let mut table = table;
    each_file(&mut table, from, &mut |name| {
        *name = copied(name, from, to)?;
        Ok(())
    })?;
    Ok(table)
}

/// Calls `visit` with every name of a file in `table`, a configuration in `folder`. That is any
/// text that leads to one: which keys name files is the drivers' matter.
///
/// # Errors
/// The first one of `visit`.
pub(crate) fn each_file(
    table: &mut toml::Table,
    folder: &Path,
    visit: &mut dyn FnMut(&mut String) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let mut values = table.iter_mut().map(|(_, value)| value);
    values.try_for_each(|value| each_file_of(value, folder, visit))
}

fn each_file_of(
    value: &mut toml::Value,
    folder: &Path,
    visit: &mut dyn FnMut(&mut String) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    match value {
        toml::Value::Table(table) => each_file(table, folder, visit),
        toml::Value::Array(values) => values
            .iter_mut()
            .try_for_each(|value| each_file_of(value, folder, visit)),
        toml::Value::String(name) if folder.join(&*name).is_file() => visit(name),
        _ => Ok(()),
    }
}

/// Copies the file that a configuration in `from` calls `name`; returns the name of the copy.
fn copied(name: &str, from: &Path, to: &Path) -> anyhow::Result<String> {
    let file = from.join(name);
    let at = || file.display().to_string();
    let below = |name: &Path| -> PathBuf {
        let parts = name.components();
        parts
            .filter(|part| matches!(part, Component::Normal(_)))
            .collect()
    };
    let climbs = |part: Component<'_>| !matches!(part, Component::Normal(_) | Component::CurDir);
    let place = if Path::new(name).components().any(climbs) {
        // Its whole path, so that two files of one name do not meet.
        Path::new(ELSEWHERE).join(below(&file.canonicalize().with_context(at)?))
    } else {
        below(Path::new(name))
    };
    let copy = to.join(&place);
    if let Some(folder) = copy.parent() {
        fs::create_dir_all(folder)?;
    }
    let bytes = fs::read(&file).with_context(|| format!("{}: cannot be read", at()))?;
    fs::write(&copy, bytes).with_context(|| format!("{}: cannot be written", copy.display()))?;
    let place = place.to_str().map(ToOwned::to_owned);
    place.with_context(|| format!("{} is not UTF-8", at()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Files beside the configuration, in a folder below it and elsewhere, whatever key names them.
    #[test]
    fn a_copied_configuration_needs_no_file_of_the_original() {
        let folder = tempfile::tempdir().unwrap();
        let (from, to) = (folder.path().join("a/robot"), folder.path().join("b"));
        fs::create_dir_all(from.join("maps")).unwrap();
        for (file, text) in [
            ("a/robot/drive.dbc", "one"),
            ("a/robot/maps/hand.txt", "two"),
            ("a/drive.dbc", "three"),
        ] {
            fs::write(folder.path().join(file), text).unwrap();
        }
        let outside = folder.path().join("a/drive.dbc");
        let table = format!(
            "name = \"drive\"\nlink = \"\"\n[[bus]]\ndevice = [{{ dbc = \"drive.dbc\" }}, \
             {{ eds = \"../drive.dbc\" }}, {{ any = {outside:?} }}]\n[skin]\ntaxels = \
             \"./maps/hand.txt\"\nnone = \"maps/foot.txt\"\n"
        );
        let copy = with_files(table.parse().unwrap(), &from, &to).unwrap();
        fs::remove_dir_all(folder.path().join("a")).unwrap();
        let read = |value: &toml::Value| fs::read_to_string(to.join(value.as_str().unwrap()));
        let devices = copy["bus"][0]["device"].as_array().unwrap();
        for (value, text) in [
            (&devices[0]["dbc"], "one"),
            (&devices[1]["eds"], "three"),
            (&devices[2]["any"], "three"),
            (&copy["skin"]["taxels"], "two"),
        ] {
            assert_eq!(read(value).unwrap(), text, "{value}");
        }
        assert_eq!(copy["name"].as_str(), Some("drive"));
        assert_eq!(copy["skin"]["none"].as_str(), Some("maps/foot.txt"));
    }
}
