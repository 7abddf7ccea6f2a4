//! The permitted dependencies between members, and on libraries.

use crate::{cargo, list, metadata, text};
use serde_json::Value;
use std::collections::BTreeSet;

/// The permitted direct dependencies between members of the workspace.
const DIRECTIONS: [(&str, &[&str]); 14] = [
    ("proprio-topics", &[]),
    ("proprio-drivers", &["proprio-topics"]),
    ("proprio-gateway", &["proprio-drivers", "proprio-topics"]),
    ("proprio-dynamics", &[]),
    (
        "proprio-identification",
        &["proprio-dynamics", "proprio-topics"],
    ),
    (
        "proprio-planning",
        &[
            "proprio-dynamics",
            "proprio-identification",
            "proprio-topics",
        ],
    ),
    (
        "proprio-estimator",
        &[
            "proprio-dynamics",
            "proprio-identification",
            "proprio-topics",
        ],
    ),
    (
        "proprio-simulator",
        &[
            "proprio-gateway",
            "proprio-drivers",
            "proprio-dynamics",
            "proprio-estimator",
            "proprio-topics",
        ],
    ),
    ("proprio-cli", &EVERYTHING),
    ("proprio-bridge", &["proprio-topics"]),
    (
        "proprio-recording",
        &["proprio-bridge", "proprio-drivers", "proprio-topics"],
    ),
    ("proprio-ffi", &["proprio-topics"]),
    ("proprio-tests", &EVERYTHING),
    (
        "peers-ours",
        &["proprio-dynamics", "proprio-identification"],
    ),
];
const EVERYTHING: [&str; 11] = [
    "proprio-topics",
    "proprio-drivers",
    "proprio-gateway",
    "proprio-dynamics",
    "proprio-identification",
    "proprio-planning",
    "proprio-estimator",
    "proprio-simulator",
    "proprio-bridge",
    "proprio-recording",
    "proprio-ffi",
];

/// Libraries that only some members may depend on directly: the name (or a prefix with a star) and
/// these members.
const CONFINED: [(&str, &[&str]); 7] = [
    ("socketcan", &["proprio-gateway"]),
    ("iceoryx2*", &["proprio-topics"]),
    (
        "nalgebra*",
        &[
            "proprio-dynamics",
            "proprio-identification",
            "proprio-planning",
            "proprio-estimator",
            "proprio-simulator",
        ],
    ),
    // The estimator uses it in a test to read its own output.
    ("urdf-rs", &["proprio-estimator"]),
    ("tokio", &["proprio-gateway", "proprio-estimator"]),
    // Not in the daemons' crates.
    ("mcap", &["proprio-recording"]),
    ("ratatui*", &["proprio-cli"]),
];

/// Libraries of tests alone, whoever uses them: they describe and check documents.
const IN_TESTS: [&str; 3] = ["schemars", "clap_mangen", "pulldown-cmark"];

/// The parts of iceoryx2 that topics may use without its feature `ipc`: they are no_std and open
/// nothing.
const ALWAYS_IN_TOPICS: [&str; 2] = ["iceoryx2-bb-elementary-traits", "iceoryx2-bb-derive-macros"];

/// All libraries that drivers and topics (without features) may depend on, directly or not: all are
/// no_std.
const BARE: [&str; 20] = [
    "arrayvec",
    "iceoryx2-bb-concurrency",
    "iceoryx2-bb-derive-macros",
    "iceoryx2-bb-elementary",
    "iceoryx2-bb-elementary-traits",
    "iceoryx2-log",
    "iceoryx2-log-types",
    "iceoryx2-pal-concurrency-sync",
    "libm",
    "proc-macro2",
    "proprio-topics",
    "quote",
    "serde",
    "serde_core",
    "serde_derive",
    "syn",
    "thiserror",
    "thiserror-impl",
    "zerocopy",
    "zerocopy-derive",
];

/// Whether `name` matches `pattern`: a name, or a prefix with a star.
fn fits(pattern: &str, name: &str) -> bool {
    pattern
        .strip_suffix('*')
        .map_or(pattern == name, |beginning| name.starts_with(beginning))
}

fn wrong_directions(metadata: &Value) -> Vec<String> {
    let mut wrong = Vec::new();
    for package in list(metadata, "packages") {
        let name = text(package, "name");
        let Some((_, allowed)) = DIRECTIONS.iter().find(|(member, _)| *member == name) else {
            wrong.push(format!("{name} is not in the table of directions"));
            continue;
        };
        for dependency in list(package, "dependencies") {
            let to = text(dependency, "name");
            if to.starts_with("proprio-") && !allowed.contains(&to) {
                wrong.push(format!("{name} -> {to}"));
            }
        }
    }
    wrong
}

fn escaped_libraries(metadata: &Value) -> Vec<String> {
    let mut wrong = Vec::new();
    for package in list(metadata, "packages") {
        let name = text(package, "name");
        for dependency in list(package, "dependencies") {
            let to = text(dependency, "name");
            let owners = CONFINED
                .iter()
                .find(|(pattern, _)| fits(pattern, to))
                .map(|(_, owners)| *owners);
            if owners.is_some_and(|owners| !owners.contains(&name)) {
                wrong.push(format!("{name} -> {to}"));
            }
            if IN_TESTS.contains(&to) && dependency["kind"] != "dev" {
                wrong.push(format!("{name} -> {to} outside tests"));
            }
            // Identification uses types of topics, but neither ports nor tables.
            if name == "proprio-identification"
                && to == "proprio-topics"
                && !list(dependency, "features").is_empty()
            {
                wrong.push(format!("{name} -> {to} with features"));
            }
            let hidden = dependency["optional"] == true || dependency["kind"] == "dev";
            if name == "proprio-topics"
                && fits("iceoryx2*", to)
                && !hidden
                && !ALWAYS_IN_TOPICS.contains(&to)
            {
                wrong.push(format!("{name} -> {to} without the feature ipc"));
            }
        }
        if name == "proprio-topics" {
            let features = package["features"]
                .as_object()
                .expect("features are a table");
            for (feature, parts) in features {
                let takes = parts
                    .as_array()
                    .expect("a list")
                    .iter()
                    .filter_map(Value::as_str);
                wrong.extend(
                    takes
                        .filter(|p| {
                            feature != "ipc" && p.trim_start_matches("dep:").starts_with("iceoryx2")
                        })
                        .filter(|p| *p != format!("dep:{feature}"))
                        .map(|p| format!("{name}: feature {feature} takes {p}")),
                );
            }
            if features.contains_key("default") {
                wrong.push(format!(
                    "{name} has default features: a consumer takes what it needs"
                ));
            }
        }
    }
    wrong
}

#[test]
fn dependencies_point_one_way() {
    let mut metadata = metadata();
    assert_eq!(wrong_directions(&metadata), [""; 0]);
    let members: BTreeSet<&str> = list(&metadata, "packages")
        .iter()
        .map(|p| text(p, "name"))
        .collect();
    assert_eq!(
        members,
        DIRECTIONS.iter().map(|(name, _)| *name).collect(),
        "every row of the table is a member"
    );
    // The estimator must not depend on frames.
    let add = |metadata: &mut Value, to: &str, dependency: Value| {
        let packages = metadata["packages"].as_array_mut().unwrap();
        let package = packages.iter_mut().find(|p| p["name"] == to).unwrap();
        package["dependencies"]
            .as_array_mut()
            .unwrap()
            .push(dependency);
    };
    add(
        &mut metadata,
        "proprio-estimator",
        serde_json::json!({ "name": "proprio-drivers", "kind": "dev" }),
    );
    add(
        &mut metadata,
        "proprio-topics",
        serde_json::json!({ "name": "proprio-gateway", "kind": null }),
    );
    let mut wrong = wrong_directions(&metadata);
    wrong.sort();
    assert_eq!(
        wrong,
        [
            "proprio-estimator -> proprio-drivers",
            "proprio-topics -> proprio-gateway"
        ]
    );
    metadata["packages"][0]["name"] = "proprio-new".into();
    assert!(
        wrong_directions(&metadata)
            .contains(&"proprio-new is not in the table of directions".to_owned())
    );
}

#[test]
fn libraries_with_one_owner_stay_with_it() {
    let mut metadata = metadata();
    assert_eq!(escaped_libraries(&metadata), [""; 0]);
    for package in metadata["packages"].as_array_mut().unwrap() {
        let name = package["name"].as_str().unwrap().to_owned();
        let dependencies = package["dependencies"].as_array_mut().unwrap();
        match name.as_str() {
            "proprio-cli" => {
                dependencies.push(
                    serde_json::json!({ "name": "socketcan", "kind": null, "optional": false }),
                );
            }
            "proprio-gateway" => {
                dependencies.push(
                    serde_json::json!({ "name": "iceoryx2", "kind": null, "optional": true }),
                );
                dependencies.push(
                    serde_json::json!({ "name": "nalgebra", "kind": "dev", "optional": false }),
                );
                dependencies.push(
                    serde_json::json!({ "name": "schemars", "kind": null, "optional": true }),
                );
            }
            "proprio-topics" => {
                dependencies
                    .iter_mut()
                    .filter(|d| d["name"] == "iceoryx2")
                    .for_each(|d| d["optional"] = false.into());
                package["features"]["csv"]
                    .as_array_mut()
                    .unwrap()
                    .push("dep:iceoryx2-bb-container".into());
            }
            _ => {}
        }
    }
    let mut wrong = escaped_libraries(&metadata);
    wrong.sort();
    assert_eq!(
        wrong,
        [
            "proprio-cli -> socketcan",
            "proprio-gateway -> iceoryx2",
            "proprio-gateway -> nalgebra",
            "proprio-gateway -> schemars outside tests",
            "proprio-topics -> iceoryx2 without the feature ipc",
            "proprio-topics: feature csv takes dep:iceoryx2-bb-container",
        ]
    );
}

/// The names in the output of `cargo tree --prefix none`.
fn heavy(tree: &str, own: &str) -> Vec<String> {
    let names: BTreeSet<&str> = tree
        .lines()
        .filter_map(|line| line.split_whitespace().next())
        .collect();
    assert!(names.contains(own), "{tree}");
    let light = |name: &str| name == own || name == "unicode-ident" || BARE.contains(&name);
    names
        .into_iter()
        .filter(|name| !light(name))
        .map(ToOwned::to_owned)
        .collect()
}

#[test]
fn drivers_and_the_contract_rest_on_little() {
    for own in ["proprio-drivers", "proprio-topics"] {
        let tree = cargo(&[
            "tree",
            "-p",
            own,
            "--edges",
            "normal",
            "--prefix",
            "none",
            "--offline",
            "--locked",
        ]);
        assert_eq!(heavy(&tree, own), [""; 0], "{own}");
        let tree = format!("{tree}nix v0.31.0\nsocketcan v4.0.0\n");
        assert_eq!(heavy(&tree, own), ["nix", "socketcan"]);
    }
    let tree = cargo(&[
        "tree",
        "-p",
        "proprio-gateway",
        "--edges",
        "normal",
        "--prefix",
        "none",
        "--offline",
        "--locked",
    ]);
    let all = heavy(&tree, "proprio-gateway");
    assert!(
        all.iter().any(|n| n == "socketcan") && all.iter().any(|n| n == "iceoryx2"),
        "the names are read: {all:?}"
    );
}
