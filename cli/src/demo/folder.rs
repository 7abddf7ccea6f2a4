//! A robot's configuration as a folder that stands alone: with all files that it names.

use anyhow::Context;
use proprio_estimator::config::ConfigError;
use proprio_simulator::Robot;
use std::fs::{self};
use std::path::{Component, Path, PathBuf};

/// Where copies of files are put that lie outside the robot's folder.
const ELSEWHERE: &str = "elsewhere";

/// Reads a configuration file.
pub(super) fn read(file: &Path) -> anyhow::Result<toml::Table> {
    let text =
        fs::read_to_string(file).with_context(|| format!("{}: cannot be read", file.display()))?;
    text.parse().with_context(|| file.display().to_string())
}

/// Copies the robot's configuration, and all files that it names, to the folder `to`. If `buses`
/// are given, they replace the sources of its buses.
pub(super) fn copy_robot(robot: &Robot, buses: &[String], to: &Path) -> anyhow::Result<()> {
    let mut gateway = read(&robot.folder.join("gateway.toml"))?;
    if let (false, Some(toml::Value::Array(list))) = (buses.is_empty(), gateway.get_mut("bus")) {
        if buses.len() == 1 && list.len() > 1 {
            // One interface for all: all devices move to the first bus.
            let mut all = |key: &str| -> Vec<toml::Value> {
                list.iter_mut()
                    .filter_map(|bus| bus.as_table_mut()?.remove(key))
                    .filter_map(|of_bus| of_bus.as_array().cloned())
                    .flatten()
                    .collect()
            };
            let parts = ["device", "coupling"].map(|key| (key, all(key)));
            list.truncate(1);
            if let Some(bus) = list.first_mut().and_then(toml::Value::as_table_mut) {
                for (key, of_all) in parts.into_iter().filter(|(_, of_all)| !of_all.is_empty()) {
                    bus.insert(key.into(), of_all.into());
                }
            }
        } else if buses.len() != list.len() {
            let problem = format!(
                "--bus is given {} times; the robot has {} buses: give one interface for each, or \
                 one for all",
                buses.len(),
                list.len()
            );
            return Err(ConfigError {
                file: robot.folder.join("gateway.toml"),
                problem,
            }
            .into());
        }
        for (bus, interface) in list.iter_mut().zip(buses) {
            if let Some(bus) = bus.as_table_mut() {
                let source = [("kind", "socketcan"), ("interface", interface.as_str())];
                let source: toml::Table = source
                    .into_iter()
                    .map(|(k, v)| (k.to_owned(), v.into()))
                    .collect();
                bus.insert("source".into(), source.into());
            }
        }
    }
    let mut estimator = read(&robot.folder.join("estimator.toml"))?;
    // Parameters identified on a real robot do not apply to the simulated one.
    estimator.remove("parameters");
    if let Some(identification) = estimator
        .get_mut("identification")
        .and_then(toml::Value::as_table_mut)
    {
        identification.remove("state");
    }
    fs::create_dir_all(to)?;
    for (name, table) in [("gateway.toml", gateway), ("estimator.toml", estimator)] {
        let table = with_files(table, &robot.folder, to)?;
        fs::write(to.join(name), table.to_string())?;
    }
    Ok(())
}

/// Copies every file that `table`, a configuration in the folder `from`, names to the folder `to`.
/// Returns the configuration that names the copies.
///
/// A name of a file is any text that leads to one: which keys name files is the drivers' matter.
pub(super) fn with_files(
    table: toml::Table,
    from: &Path,
    to: &Path,
) -> anyhow::Result<toml::Table> {
    let copied = |(key, value)| Ok((key, with_files_of(value, from, to)?));
    table.into_iter().map(copied).collect()
}

fn with_files_of(value: toml::Value, from: &Path, to: &Path) -> anyhow::Result<toml::Value> {
    Ok(match value {
        toml::Value::Table(table) => with_files(table, from, to)?.into(),
        toml::Value::Array(values) => {
            let values = values.into_iter();
            let copied = values.map(|value| with_files_of(value, from, to));
            toml::Value::Array(copied.collect::<anyhow::Result<_>>()?)
        }
        toml::Value::String(name) if from.join(&name).is_file() => copied(&name, from, to)?.into(),
        other => other,
    })
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
        let place = tempfile::tempdir().unwrap();
        let (from, to) = (place.path().join("a/robot"), place.path().join("b"));
        fs::create_dir_all(from.join("maps")).unwrap();
        for (file, text) in [
            ("a/robot/drive.dbc", "one"),
            ("a/robot/maps/hand.txt", "two"),
            ("a/drive.dbc", "three"),
        ] {
            fs::write(place.path().join(file), text).unwrap();
        }
        let outside = place.path().join("a/drive.dbc");
        let table = format!(
            "name = \"drive\"\nlink = \"\"\n[[bus]]\ndevice = [{{ dbc = \"drive.dbc\" }}, \
             {{ eds = \"../drive.dbc\" }}, {{ any = {outside:?} }}]\n[skin]\ntaxels = \
             \"./maps/hand.txt\"\nnone = \"maps/foot.txt\"\n"
        );
        let copy = with_files(table.parse().unwrap(), &from, &to).unwrap();
        fs::remove_dir_all(place.path().join("a")).unwrap();
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
