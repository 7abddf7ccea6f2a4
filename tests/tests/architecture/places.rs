//! The places of what may not stand anywhere: `unsafe`, clocks, the paths of confined libraries and
//! the standard library.

use crate::{Source, has_word, list, metadata, root, sources, text};

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

/// Whether `path` is in a list of files, or of folders (with a slash at the end).
fn listed(list: &[(&str, &str)], path: &str) -> bool {
    list.iter()
        .any(|(place, _)| path == *place || (place.ends_with('/') && path.starts_with(place)))
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

/// These files contain the words that they search for, so they are excluded.
const THIS: &str = "tests/tests/architecture/";

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
    let inner: Vec<&Source> = sources
        .iter()
        .filter(|s| !s.path.contains("/tests/") && !listed(&OUTERMOST, &s.path))
        .collect();
    for source in inner.into_iter().filter(|s| s.is_rust()) {
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
