//! Checks the rules of the source tree: permitted dependencies, places of `unsafe` and of clocks,
//! and the form of every file.
//!
//! Each rule is a function that returns a list of violations. Each test runs it on the tree and on
//! a tree with a violation, so that an ineffective rule is detected too.

use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

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

/// The files that may contain `unsafe`, with the reason.
const UNSAFE: [(&str, &str); 12] = [
    ("ffi/src/lib.rs", "pointers from C"),
    ("ffi/benches/read.rs", "calls what C calls"),
    ("ffi/tests/values.rs", "calls what C calls"),
    (
        "gateway/src/link/socket.rs",
        "recvmmsg without allocation, and an ioctl that no library wraps",
    ),
    (
        "gateway/topics/src/ipc/bell.rs",
        "an atomic word in memory that processes share",
    ),
    (
        "gateway/topics/src/ipc/guard.rs",
        "a signal handler that maps memory",
    ),
    (
        "gateway/topics/src/ipc/memory.rs",
        "gives mapped memory back to the system",
    ),
    (
        "gateway/topics/src/realtime.rs",
        "locks the mappings of a process",
    ),
    ("gateway/topics/tests/allocation.rs", "a counting allocator"),
    ("gateway/topics/tests/layout.rs", "the bytes of a payload"),
    (
        "gateway/topics/tests/robot.rs",
        "a thread that may make no system call",
    ),
    ("tests/tests/allocation.rs", "a counting allocator"),
];

/// The files that may read a system clock, with the reason. All others get the time as an argument
/// or call one of these.
const CLOCKS: [(&str, &str); 2] = [
    (
        "gateway/src/clock.rs",
        "the gateway's clock, which also converts the kernel's stamps",
    ),
    (
        "gateway/topics/src/ipc/clock.rs",
        "the same for consumers, which do not have the gateway",
    ),
];

/// The files that may call these clocks: the outermost loops of programs, and tests that wait for
/// processes.
const OUTERMOST: [(&str, &str); 18] = [
    ("gateway/topics/src/ipc/clock.rs", "is it"),
    ("gateway/src/clock.rs", "the gateway's clock"),
    ("gateway/topics/src/ipc/bell.rs", "tests of waiting"),
    (
        "gateway/topics/src/ipc/failures.rs",
        "the pause between two attempts to connect, after a failure only",
    ),
    (
        "gateway/topics/src/ipc/presence.rs",
        "watches for a second who sends",
    ),
    (
        "gateway/topics/src/ipc/robot.rs",
        "the loop of the thread that opens ports",
    ),
    ("gateway/topics/examples/", "programs"),
    ("ffi/src/lib.rs", "hands the clock to C"),
    ("bridge/src/described.rs", "waits for what is sent again"),
    ("ffi/benches/", "measure"),
    ("gateway/topics/benches/", "measure"),
    ("gateway/benches/", "measure"),
    ("estimator/src/daemon.rs", "the daemon's loop"),
    (
        "estimator/src/daemon/identification.rs",
        "when its state was written",
    ),
    ("cli/src/", "programs"),
    ("bridge/view/src/main.rs", "a program"),
    ("bridge/ros2/src/main.rs", "a program"),
    ("tests/", "tests of processes"),
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("tests/ lies in the workspace")
        .to_owned()
}

fn cargo(args: &[&str]) -> String {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(args)
        .current_dir(root())
        .output()
        .expect("cargo runs");
    assert!(
        output.status.success(),
        "cargo {args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("cargo speaks UTF-8")
}

/// The manifests of all members, without indirect dependencies, which would need the sources for
/// every system.
fn metadata() -> Value {
    let text = cargo(&[
        "metadata",
        "--format-version",
        "1",
        "--no-deps",
        "--offline",
        "--locked",
    ]);
    serde_json::from_str(&text).expect("cargo metadata is JSON")
}

fn list<'a>(value: &'a Value, key: &str) -> &'a [Value] {
    value[key]
        .as_array()
        .unwrap_or_else(|| panic!("{key} is a list"))
}

fn text<'a>(value: &'a Value, key: &str) -> &'a str {
    value[key]
        .as_str()
        .unwrap_or_else(|| panic!("{key} is text"))
}

/// Whether `name` matches `pattern`: a name, or a prefix with a star.
fn fits(pattern: &str, name: &str) -> bool {
    pattern
        .strip_suffix('*')
        .map_or(pattern == name, |beginning| name.starts_with(beginning))
}

// ---------------------------------------------------------------- dependencies

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

// ---------------------------------------------------------------- sources

/// A file of the tree.
struct Source {
    path: String,
    size: u64,
    /// Empty if it is not UTF-8.
    text: String,
}

impl Source {
    fn new(path: &str, text: &str) -> Self {
        Self {
            path: path.into(),
            size: text.len() as u64,
            text: text.into(),
        }
    }

    fn is_rust(&self) -> bool {
        self.path.ends_with(".rs")
    }

    /// The lines of code, numbered from 1, without comments. A `//` in a string literal hides the
    /// rest of its line.
    fn code(&self) -> impl Iterator<Item = (usize, &str)> {
        self.text
            .lines()
            .enumerate()
            .map(|(at, line)| (at + 1, line.split("//").next().unwrap_or_default()))
    }
}

/// Every file that is tracked or would be added by `git add`; without git, every file except the
/// outputs of builds and runs.
fn sources() -> Vec<Source> {
    let root = root();
    let git = Command::new("git")
        .args([
            "ls-files",
            "-z",
            "--cached",
            "--others",
            "--exclude-standard",
        ])
        .current_dir(&root)
        .output();
    let paths: Vec<String> = match git {
        Ok(output) if output.status.success() => String::from_utf8_lossy(&output.stdout)
            .split('\0')
            .filter(|p| !p.is_empty())
            .map(ToOwned::to_owned)
            .collect(),
        _ => {
            let mut found = Vec::new();
            walk(&root, "", &mut found);
            found
        }
    };
    let mut sources = Vec::new();
    for path in paths {
        let file = root.join(&path);
        // A tracked file may be deleted in the work tree.
        let Ok(bytes) = std::fs::read(&file) else {
            continue;
        };
        sources.push(Source {
            path,
            size: bytes.len() as u64,
            text: String::from_utf8(bytes).unwrap_or_default(),
        });
    }
    assert!(
        sources.iter().any(|s| s.path == "gateway/src/clock.rs"),
        "the files are found"
    );
    sources
}

fn walk(root: &Path, below: &str, found: &mut Vec<String>) {
    for entry in std::fs::read_dir(root.join(below))
        .expect("a folder")
        .flatten()
    {
        let name = entry.file_name().to_string_lossy().into_owned();
        let path = if below.is_empty() {
            name.clone()
        } else {
            format!("{below}/{name}")
        };
        match entry.file_type() {
            Ok(kind)
                if kind.is_dir()
                    && !["target", ".git", "proprio-demo"].contains(&name.as_str()) =>
            {
                walk(root, &path, found);
            }
            Ok(kind) if kind.is_file() => found.push(path),
            _ => {}
        }
    }
}

/// Whether `path` is in a list of files, or of folders (with a slash at the end).
fn listed(list: &[(&str, &str)], path: &str) -> bool {
    list.iter()
        .any(|(place, _)| path == *place || (place.ends_with('/') && path.starts_with(place)))
}

/// Whether `line` contains `word` as a whole word.
fn has_word(line: &str, word: &str) -> bool {
    let part = |c: char| c.is_alphanumeric() || c == '_';
    line.match_indices(word).any(|(at, _)| {
        let before = line.get(..at).and_then(|l| l.chars().next_back());
        let after = line.get(at + word.len()..).and_then(|l| l.chars().next());
        !before.is_some_and(part) && !after.is_some_and(part)
    })
}

/// Lines of Rust code outside the files of `allowed` for which `found` returns true.
fn outside<'a>(
    sources: &'a [Source],
    allowed: &[(&str, &str)],
    found: impl Fn(&str) -> bool + 'a,
) -> Vec<String> {
    let rust = sources
        .iter()
        .filter(|s| s.is_rust() && !listed(allowed, &s.path));
    rust.flat_map(|s| {
        s.code()
            .filter(|(_, line)| found(line))
            .map(|(at, line)| format!("{}:{at}: {}", s.path, line.trim()))
    })
    .collect()
}

/// This file contains the words that it searches for, so it is excluded.
const THIS: &str = "tests/tests/architecture.rs";

fn unsafe_lines(sources: &[Source]) -> Vec<String> {
    let mut allowed = UNSAFE.to_vec();
    allowed.push((THIS, "names the word"));
    outside(sources, &allowed, |line| {
        has_word(line, "unsafe")
            || line.contains("allow(unsafe_code")
            || line.contains("expect(unsafe_code")
    })
}

#[test]
fn unsafe_code_is_in_named_files_alone() {
    let mut sources = sources();
    assert_eq!(unsafe_lines(&sources), [""; 0]);
    for (file, why) in UNSAFE {
        let there = sources
            .iter()
            .find(|s| s.path == file)
            .is_some_and(|s| s.code().any(|(_, l)| has_word(l, "unsafe")));
        assert!(
            there,
            "{file} ({why}) has no unsafe code any more: remove it from the list"
        );
    }
    sources.push(Source::new(
        "drivers/src/new.rs",
        "//! New.\nfn f() { unsafe { g() } } // why\n// unsafe\n#![allow(unsafe_code)]\n",
    ));
    assert_eq!(unsafe_lines(&sources).len(), 2);
    let manifest = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
    assert!(
        manifest.contains("unsafe_code = \"deny\"")
            && manifest.contains("undocumented_unsafe_blocks = \"deny\"")
    );
    for package in list(&metadata(), "packages") {
        let manifest = std::fs::read_to_string(text(package, "manifest_path")).unwrap();
        assert!(
            manifest.contains("[lints]\nworkspace = true"),
            "{}: the workspace's lints",
            text(package, "name")
        );
    }
}

/// Reads of the system's clocks and, in the libraries, of the project's clocks.
fn clock_reads(sources: &[Source]) -> Vec<String> {
    let mut allowed = CLOCKS.to_vec();
    allowed.push((THIS, "names the words"));
    allowed.push((
        "tests/peers/server.rs",
        "the stopwatch of the comparison with other libraries",
    ));
    let system = [
        "Instant::now",
        "SystemTime::now",
        "clock_gettime",
        "UNIX_EPOCH",
        ".elapsed()",
        "Utc::now",
        "Local::now",
    ];
    let mut wrong = outside(sources, &allowed, |line| {
        system.iter().any(|w| line.contains(w))
    });
    let own: Vec<&Source> = sources
        .iter()
        .filter(|s| !s.path.contains("/tests/") && !listed(&OUTERMOST, &s.path))
        .collect();
    for source in own.into_iter().filter(|s| s.is_rust()) {
        wrong.extend(
            source
                .code()
                .filter(|(_, l)| l.contains("monotonic()"))
                .map(|(at, l)| format!("{}:{at}: {}", source.path, l.trim())),
        );
    }
    wrong
}

#[test]
fn only_the_clock_modules_read_a_clock() {
    let mut sources = sources();
    assert_eq!(clock_reads(&sources), [""; 0]);
    for (file, why) in CLOCKS {
        assert!(
            sources
                .iter()
                .any(|s| s.path == file && s.text.contains("clock_gettime")),
            "{file}: {why}"
        );
    }
    sources.push(Source::new(
        "estimator/src/new.rs",
        "//! New.\nlet a = std::time::Instant::now();\nlet b = monotonic();\n",
    ));
    sources.push(Source::new(
        "simulator/tests/new.rs",
        "//! New.\nlet a = SystemTime::now();\nlet b = monotonic();\n",
    ));
    sources.push(Source::new(
        "tests/peers/ours/src/new.rs",
        "//! New.\nlet a = Instant::now();\n",
    ));
    assert_eq!(clock_reads(&sources).len(), 4);
    // The libraries' cores must not contain any clock, by any name.
    let pure = [
        "drivers/src/",
        "gateway/src/devices.rs",
        "gateway/src/bus.rs",
        "estimator/src/pipeline",
        "estimator/dynamics/src",
        "estimator/identification/src",
    ];
    for place in pure {
        assert!(
            sources.iter().any(|s| s.path.starts_with(place)),
            "{place}: no such file"
        );
    }
    for source in sources
        .iter()
        .filter(|s| s.is_rust() && pure.iter().any(|p| s.path.starts_with(p)))
    {
        for (at, line) in source.code() {
            assert!(
                !line.contains("std::time") && !line.contains("Monotonic"),
                "{}:{at}: {line}",
                source.path
            );
        }
    }
}

/// Paths into libraries that only one module may use.
fn leaked_paths(sources: &[Source]) -> Vec<String> {
    let here = (THIS, "names the words");
    let mut wrong = outside(
        sources,
        &[
            ("gateway/src/link/socketcan.rs", "the link"),
            ("gateway/src/link/error_frame.rs", "error frames in words"),
            here,
        ],
        |l| l.contains("socketcan::") && !l.contains("link::socketcan::"),
    );
    let ipc = [
        ("gateway/topics/src/ipc/", "the ports"),
        ("gateway/topics/tests/", "their tests"),
        ("gateway/topics/benches/", "measured beside it"),
        here,
    ];
    wrong.extend(outside(sources, &ipc, |l| {
        l.contains("iceoryx2::")
            || l.contains("iceoryx2_bb_container")
            || l.contains("iceoryx2_bb_system_types")
    }));
    let linear = [("estimator/", "its own"), ("simulator/", "its own"), here];
    wrong.extend(outside(sources, &linear, |l| l.contains("nalgebra::")));
    wrong
}

#[test]
fn libraries_are_named_where_they_belong() {
    let mut sources = sources();
    assert_eq!(leaked_paths(&sources), [""; 0]);
    assert!(
        sources
            .iter()
            .any(|s| s.path == "gateway/src/link/socketcan.rs" && s.text.contains("socketcan::"))
    );
    sources.push(Source::new(
        "gateway/src/new.rs",
        "//! New.\nuse socketcan::CanSocket;\nuse crate::link::socketcan::SocketCan;\n",
    ));
    sources.push(Source::new(
        "estimator/src/new.rs",
        "//! New.\nuse iceoryx2::prelude::*;\nuse nalgebra::DMatrix;\n",
    ));
    sources.push(Source::new(
        "gateway/topics/src/new.rs",
        "//! New.\nuse nalgebra::DMatrix;\n",
    ));
    assert_eq!(leaked_paths(&sources).len(), 3);
}

/// Files whose first lines do not say what they are for. A crate's README.md says it for the crate.
fn without_purpose(sources: &[Source]) -> Vec<String> {
    let has_readme = |s: &Source| {
        let folder = s.path.rsplit_once("/src/").map_or("", |(folder, _)| folder);
        let readme = format!("{folder}/README.md");
        s.text
            .starts_with("#![doc = include_str!(\"../README.md\")]")
            && (sources.iter()).any(|s| s.path == readme && s.text.starts_with("# "))
    };
    sources
        .iter()
        .filter(|s| s.is_rust() && !s.text.starts_with("//! ") && !has_readme(s))
        .map(|s| s.path.clone())
        .collect()
}

#[test]
fn every_file_says_what_it_is_for() {
    let mut sources = sources();
    assert_eq!(without_purpose(&sources), [""; 0]);
    sources.push(Source::new("cli/src/new.rs", "use std::io;\n"));
    assert_eq!(without_purpose(&sources), ["cli/src/new.rs"]);
}

/// Crates that must work without the standard library, by their `lib.rs`.
fn with_std(sources: &[Source]) -> Vec<String> {
    let mut wrong = Vec::new();
    for folder in ["drivers", "gateway/topics"] {
        let lib = format!("{folder}/src/lib.rs");
        let there = sources
            .iter()
            .any(|s| s.path == lib && s.code().any(|(_, l)| l.trim() == "#![no_std]"));
        if !there {
            wrong.push(format!("{lib} is not no_std"));
        }
    }
    for source in sources
        .iter()
        .filter(|s| s.path.starts_with("drivers/src/") && s.is_rust())
    {
        let mut for_tests = false;
        for (at, line) in source.code() {
            // Unit tests are the last module of a file.
            if for_tests && line.starts_with("mod ") {
                break;
            }
            if has_word(line, "std") && !for_tests {
                wrong.push(format!("{}:{at}: {}", source.path, line.trim()));
            }
            for_tests = line.trim() == "#[cfg(test)]";
        }
    }
    wrong
}

#[test]
fn drivers_and_the_contract_need_no_standard_library() {
    let mut sources = sources();
    assert_eq!(with_std(&sources), [""; 0]);
    sources.push(Source::new(
        "drivers/src/new.rs",
        "//! New.\nuse std::collections::HashMap;\n",
    ));
    sources
        .iter_mut()
        .filter(|s| s.path == "gateway/topics/src/lib.rs")
        .for_each(|s| s.text = s.text.replace("#![no_std]", ""));
    assert_eq!(with_std(&sources).len(), 2);
}

fn too_large(sources: &[Source]) -> Vec<String> {
    sources
        .iter()
        .filter(|s| s.size > 1 << 20)
        .map(|s| format!("{}: {} bytes", s.path, s.size))
        .collect()
}

#[test]
fn no_file_is_large() {
    let mut sources = sources();
    assert_eq!(too_large(&sources), [""; 0]);
    sources.push(Source {
        path: "tests/recording.log".into(),
        size: (1 << 20) + 1,
        text: String::new(),
    });
    assert_eq!(too_large(&sources).len(), 1);
}

/// Lines of text and code over 100 columns. The outputs of candump are as it prints them.
fn too_wide(sources: &[Source]) -> Vec<String> {
    let texts = [".rs", ".md", ".toml", ".py", ".css", ".cpp", ".hpp", "/run"];
    let ours = |s: &&Source| {
        texts.iter().any(|end| s.path.ends_with(end)) && s.path != "gateway/tests/candump.rs"
    };
    let lines = (sources.iter().filter(ours))
        .flat_map(|s| s.text.lines().zip(1..).map(move |(line, at)| (s, line, at)));
    lines
        .filter(|(_, line, _)| line.chars().count() > 100)
        .map(|(source, _, at)| format!("{}:{at}", source.path))
        .collect()
}

#[test]
fn no_line_is_wider_than_100_columns() {
    let mut sources = sources();
    assert_eq!(too_wide(&sources), [""; 0]);
    let line = format!("// {}\n", "é".repeat(97));
    sources.push(Source::new(
        "cli/src/wide.rs",
        &format!("{line}{}", &line[1..]),
    ));
    assert_eq!(too_wide(&sources), [""; 0]);
    sources.push(Source::new("cli/src/wider.rs", &format!("{line}/{line}")));
    assert_eq!(too_wide(&sources), ["cli/src/wider.rs:2"]);
}

/// Words that mark unfinished work.
fn unfinished(sources: &[Source]) -> Vec<String> {
    let words = [
        concat!("TO", "DO"),
        concat!("FIX", "ME"),
        concat!("XX", "X"),
        concat!("to", "do!"),
        concat!("unimple", "mented!"),
    ];
    let lines = sources
        .iter()
        .filter(|s| !s.path.ends_with(".csv"))
        .flat_map(|s| s.text.lines().zip(1..).map(move |(line, at)| (s, line, at)));
    lines
        .filter(|(_, line, _)| {
            words.iter().any(|w| {
                w.strip_suffix('!')
                    .map_or_else(|| has_word(line, w), |_| line.contains(w))
            })
        })
        .map(|(s, line, at)| format!("{}:{at}: {}", s.path, line.trim()))
        .collect()
}

#[test]
fn nothing_is_left_for_later() {
    let mut sources = sources();
    assert_eq!(unfinished(&sources), [""; 0]);
    sources.push(Source::new(
        "cli/src/new.rs",
        concat!(
            "//! New.\n// TO",
            "DO: the rest\nfn f() { to",
            "do!() }\nunimple",
            "mented!()\n"
        ),
    ));
    assert_eq!(unfinished(&sources).len(), 3);
}

/// Tests that SECURITY.md names as `file::test`, and that do not exist.
fn missing_tests(sources: &[Source]) -> Vec<&str> {
    let document = sources.iter().find(|source| source.path == "SECURITY.md");
    let words = document.map_or("", |source| &source.text).split('`');
    let is_missing = |word: &&str| {
        word.split_once(".rs::").is_some_and(|(file, test)| {
            let file = format!("{file}.rs");
            let mut files = sources
                .iter()
                .filter(|source| Path::new(&source.path).ends_with(&file));
            !files.any(|source| source.text.contains(&format!("fn {test}(")))
        })
    };
    words.filter(is_missing).collect()
}

#[test]
fn tests_that_a_document_names_exist() {
    let mut sources = sources();
    assert_eq!(missing_tests(&sources), [""; 0]);
    let document = (sources.iter_mut()).find(|source| source.path == "SECURITY.md");
    let text = &mut document.expect("it is there").text;
    assert!(text.matches(".rs::").count() > 10);
    text.push_str("`truth.rs::all_is_well` `none.rs::a_valid_torque_is_true`");
    let missing = ["truth.rs::all_is_well", "none.rs::a_valid_torque_is_true"];
    assert_eq!(missing_tests(&sources), missing);
}
