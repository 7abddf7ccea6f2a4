//! Processes that die at any instant: the next start succeeds, the other processes continue, and no
//! files are left.
//!
//! `PROPRIO_KILLS=300 cargo test -p proprio-topics --features ipc --test crashes -- --nocapture`
//! uses more instants and prints the measured times.
#![allow(missing_docs, clippy::unwrap_used)]

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use proprio_topics::ipc::{
    Domain, DomainConfig, PortError, Presence, Reader, Watch, Writer, monotonic,
};
use proprio_topics::{GatewayHealth, Header, JointState, Nanos, Reading, Sample};
use std::io::{Read, Write};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

const ROLE: &str = "PROPRIO_TEST_ROLE";
/// A start that takes longer than this is considered hung. Not a measure of speed.
const HANGS: Nanos = Nanos::from_millis(20_000);

fn sample() -> Sample {
    Sample::new(Header::default(), 1, &Reading::Joint(JointState::ABSENT))
}

/// Not a test: the code of a child process. The test executable runs itself with [`ROLE`] set.
#[test]
fn child() {
    let Ok(role) = std::env::var(ROLE) else {
        return;
    };
    let domain = Domain::open(&DomainConfig::from_env()).unwrap();
    let ready = |word: &str| {
        // Written directly, because the test harness captures output.
        std::io::stderr().write_all(word.as_bytes()).unwrap();
    };
    let mut stdin = std::io::stdin();
    let flags = OFlag::from_bits_retain(fcntl(&stdin, FcntlArg::F_GETFL).unwrap());
    fcntl(&stdin, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK)).unwrap();
    // A child stops at the end of its standard input.
    let mut go_on = || {
        std::thread::sleep(Duration::from_millis(1));
        !matches!(stdin.read(&mut [0; 1]), Ok(0))
    };
    match role.as_str() {
        "writer" | "lonely writer" => {
            let _only = Writer::<GatewayHealth>::create(&domain, "icub", domain.epoch()).unwrap();
            let mut writer = Writer::<Sample>::create(&domain, "icub", domain.epoch()).unwrap();
            ready("R");
            while go_on() {
                writer.send(&sample(), monotonic()).unwrap();
            }
        }
        "reader" => {
            let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
            let mut said = false;
            while go_on() {
                if reader.latest().unwrap().is_some() && !said {
                    ready("R");
                    said = true;
                }
            }
        }
        "refused" => match Writer::<GatewayHealth>::create(&domain, "icub", domain.epoch()) {
            Err(PortError::Taken { holder, .. }) => ready(&format!("T{holder}")),
            other => panic!("{other:?}"),
        },
        other => panic!("{other}"),
    }
}

fn spawn(role: &str, config: &DomainConfig) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "child", "--test-threads=1", "-q"])
        .env(ROLE, role)
        .env("PROPRIO_RUNTIME_DIR", &config.base)
        .env("PROPRIO_DOMAIN", &config.name)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Waits until the child reports that it is ready, and meanwhile calls `work` about every
/// millisecond. Returns the time it took.
fn await_ready(child: &mut Child, mut work: impl FnMut()) -> Nanos {
    let start = monotonic();
    let mut stderr = child.stderr.take().unwrap();
    let flags = OFlag::from_bits_retain(fcntl(&stderr, FcntlArg::F_GETFL).unwrap());
    fcntl(&stderr, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK)).unwrap();
    let mut said = Vec::new();
    loop {
        let mut bytes = [0; 4096];
        match stderr.read(&mut bytes) {
            Ok(0) => panic!("the child ended: {}", String::from_utf8_lossy(&said)),
            Ok(n) => said.extend(&bytes[..n]),
            Err(e) => assert_eq!(e.kind(), std::io::ErrorKind::WouldBlock),
        }
        if said == b"R" {
            child.stderr = Some(stderr);
            return monotonic() - start;
        }
        assert!(
            monotonic() - start < HANGS,
            "the child hangs in its start; its output: {}",
            String::from_utf8_lossy(&said)
        );
        work();
        std::thread::sleep(Duration::from_micros(300));
    }
}

/// Closes its standard input and waits for its end.
fn stop(mut child: Child) {
    drop(child.stdin.take());
    let start = monotonic();
    while child.try_wait().unwrap().is_none() {
        assert!(monotonic() - start < HANGS, "the child hangs in its end");
        std::thread::sleep(Duration::from_micros(300));
    }
    assert!(child.wait().unwrap().success());
}

fn kill(mut child: Child) {
    child.kill().unwrap();
    child.wait().unwrap();
}

/// Another gateway that starts at once hides neither.
#[test]
fn a_watch_tells_a_killed_gateway_from_one_that_has_left() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let mut watch = Watch::<GatewayHealth>::default();
    let mut state = || watch.poll(&domain, "icub", monotonic());
    assert_eq!(state(), Presence::NotStarted);
    let start = || {
        let mut child = spawn("writer", &config);
        await_ready(&mut child, || ());
        child
    };
    let ends: [(fn(Child), Presence); 3] = [
        (kill, Presence::Killed),
        (stop, Presence::Ended),
        (kill, Presence::Killed),
    ];
    for (end, went) in ends {
        let first = start();
        assert_eq!(state(), Presence::Running);
        end(first);
        assert_eq!([state(), state()], [went; 2]);
        let second = start();
        assert_eq!(state(), Presence::Running);
        end(second);
        let third = start();
        assert_eq!([state(), state()], [went, Presence::Running]);
        end(third);
        assert_eq!(state(), went);
    }
}

/// Waits `delay` by polling the clock: sleeping is too coarse for steps of microseconds.
fn pause(delay: Nanos) {
    let end = monotonic() + delay;
    while monotonic() < end {
        std::thread::sleep(Duration::from_micros(20));
    }
}

fn kills(default: u32) -> u32 {
    std::env::var("PROPRIO_KILLS").map_or(default, |n| n.parse().unwrap())
}

/// The prefix of the domain's segments, from the names of its node files.
fn prefix(config: &DomainConfig) -> String {
    std::fs::read_dir(config.base.join(&config.name).join("nodes"))
        .unwrap()
        .filter_map(|e| e.unwrap().file_name().into_string().ok())
        .find_map(|n| {
            n.strip_prefix("proprio_")
                .and_then(|n| n.split_once('_').map(|(h, _)| format!("proprio_{h}_")))
        })
        .unwrap()
}

fn assert_nothing_left(config: &DomainConfig, prefix: &str) {
    let files: Vec<_> = std::fs::read_dir(&config.base)
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    assert!(files.is_empty(), "left over: {files:?}");
    let segments: Vec<_> = std::fs::read_dir("/dev/shm")
        .unwrap()
        .filter_map(|e| e.unwrap().file_name().into_string().ok())
        .filter(|n| n.starts_with(prefix))
        .collect();
    assert!(segments.is_empty(), "left over: {segments:?}");
}

fn summary(what: &str, times: &mut [Nanos]) {
    times.sort();
    let ms = |n: Nanos| n.seconds() * 1e3;
    let at = |share: usize| ms(times[(times.len() - 1) * share / 100]);
    println!(
        "{what}: {} kills, all recovered; next start ready after {:.1} ms (median), {:.1} (99 %), \
         {:.1} (worst)",
        times.len(),
        at(50),
        at(99),
        at(100)
    );
}

#[test]
fn a_reader_outlives_its_writer_and_a_restarted_one_is_not_refused() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let prefix = prefix(&config);
    let mut first = spawn("writer", &config);
    await_ready(&mut first, || ());
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    let mut second = spawn("refused", &config);
    let mut said = String::new();
    second
        .stderr
        .take()
        .unwrap()
        .read_to_string(&mut said)
        .unwrap();
    assert!(second.wait().unwrap().success(), "{said}");
    assert_eq!(
        said,
        format!("T{}", first.id()),
        "the error names the first gateway's process"
    );
    for epochs in 1..=5 {
        // What the writer before had sent may come first.
        let mut taken = 0;
        while taken < 20 || reader.epochs() < epochs {
            taken += u32::from(reader.try_take().unwrap().is_some());
        }
        assert_eq!((reader.epochs(), reader.lost()), (epochs, 0));
        kill(first);
        first = spawn("writer", &config);
        await_ready(&mut first, || ());
    }
    stop(first);
    drop((reader, domain));
    assert_nothing_left(&config, &prefix);
}

/// Kills a child of `role` at instants spread over its start. After each kill, another child must
/// start successfully.
///
/// `work` is the work of the surviving process; it returns whether it has received something from a
/// writer (if it reads).
fn sweep_start(role: &str, kills: u32, config: &DomainConfig, mut work: impl FnMut() -> bool) {
    let mut child = spawn(role, config);
    let typical = await_ready(&mut child, || {
        work();
    });
    kill(child);
    let mut times = Vec::new();
    for k in 0..kills {
        // Even steps over one and a half times a typical start, in a shuffled order.
        let part = i64::from(k * 7919 % kills);
        let victim = spawn(role, config);
        pause(Nanos(typical.0 * 3 / 2 * part / i64::from(kills)));
        kill(victim);
        // First read everything that the killed writer may have sent, so that only the next
        // writer's payloads count.
        while work() {}
        let mut next = spawn(role, config);
        let mut got = false;
        times.push(await_ready(&mut next, || got |= work()));
        let start = monotonic();
        while !got && role == "writer" {
            assert!(
                monotonic() - start < HANGS,
                "the surviving process receives nothing from the next writer"
            );
            got = work();
            std::thread::sleep(Duration::from_micros(300));
        }
        if k % 2 == 0 { kill(next) } else { stop(next) }
    }
    summary(
        &format!(
            "start of a {role} (typically {:.1} ms)",
            typical.seconds() * 1e3
        ),
        &mut times,
    );
}

#[test]
fn a_writer_killed_anywhere_in_its_start_hinders_nobody() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let prefix = prefix(&config);
    let mut reader = None;
    let mut taken = 0;
    sweep_start("writer", kills(40), &config, || {
        if reader.is_none() {
            reader = Reader::<Sample>::open(&domain, "icub").ok();
        }
        let Some(reader) = &mut reader else {
            return false;
        };
        let before = taken;
        while reader.try_take().unwrap().is_some() {
            taken += 1;
        }
        taken > before
    });
    let reader = reader.unwrap();
    assert!(
        reader.epochs() >= u64::from(kills(40)),
        "at least one of each writer that started"
    );
    assert_eq!(reader.lost(), 0);
    println!(
        "the surviving reader took {taken} samples of {} epochs, lost none",
        reader.epochs()
    );
    drop((reader, domain));
    assert_nothing_left(&config, &prefix);
}

#[test]
fn a_reader_killed_anywhere_in_its_start_hinders_nobody() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let prefix = prefix(&config);
    let mut writer = Writer::<Sample>::create(&domain, "icub", domain.epoch()).unwrap();
    sweep_start("reader", kills(40), &config, || {
        writer.send(&sample(), monotonic()).unwrap();
        false
    });
    domain.sweep().unwrap();
    assert_eq!(writer.send(&sample(), monotonic()).unwrap().readers, 0);
    drop((writer, domain));
    assert_nothing_left(&config, &prefix);
}

/// No other process is alive, so that the creation and removal of the domain itself are interrupted
/// too.
#[test]
fn a_lonely_process_killed_in_its_start_or_end_hinders_nobody() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let mut first = spawn("writer", &config);
    await_ready(&mut first, || ());
    let prefix = prefix(&config);
    stop(first);
    assert_nothing_left(&config, &prefix);
    // Checking from outside leaves no files either.
    sweep_start("lonely writer", kills(20), &config, || false);

    let mut times = Vec::new();
    for k in 0..kills(20) {
        let mut victim = spawn("writer", &config);
        await_ready(&mut victim, || ());
        drop(victim.stdin.take());
        pause(Nanos::from_micros(
            i64::from(k) * 6000 / i64::from(kills(20)),
        ));
        kill(victim);
        let mut next = spawn("writer", &config);
        times.push(await_ready(&mut next, || ()));
        if k % 2 == 0 { kill(next) } else { stop(next) }
    }
    summary("end of a writer", &mut times);
    assert!(Domain::remove_if_unused(&config).unwrap());
    assert_nothing_left(&config, &prefix);
}

#[test]
fn a_writer_killed_in_its_end_hinders_nobody() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let prefix = prefix(&config);
    let mut times = Vec::new();
    let mut reader: Option<Reader<Sample>> = None;
    for k in 0..kills(20) {
        let mut victim = spawn("writer", &config);
        await_ready(&mut victim, || ());
        // Every other time a reader keeps the services alive.
        reader = if k % 2 == 0 {
            Some(Reader::open(&domain, "icub").unwrap())
        } else {
            None
        };
        drop(victim.stdin.take());
        pause(Nanos::from_micros(
            i64::from(k) * 6000 / i64::from(kills(20)),
        ));
        kill(victim);
        let mut next = spawn("writer", &config);
        times.push(await_ready(&mut next, || ()));
        if k % 2 == 0 { kill(next) } else { stop(next) }
    }
    summary("end of a writer beside a reader", &mut times);
    drop((reader, domain));
    assert_nothing_left(&config, &prefix);
}

/// Creates on purpose the files that a kill can leave behind: each alone makes iceoryx2 fail or
/// hang for ever.
#[test]
fn what_is_half_made_is_removed_while_others_work() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let prefix = prefix(&config);
    let mut writer = Writer::<Sample>::create(&domain, "icub", domain.epoch()).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    writer.send(&sample(), Nanos(0)).unwrap();

    let kind = "0123456789abcdef0123456789abcdef01234567";
    let shm = |name: &str| std::path::Path::new("/dev/shm").join(format!("{prefix}{name}"));
    let (nodes, services) = (
        base.path().join("test/nodes"),
        base.path().join("test/services"),
    );
    let live: Vec<_> = std::fs::read_dir(&services)
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    let make = |path: &std::path::Path, mode: u32, content: &[u8]| {
        std::fs::write(path, content).unwrap();
        std::fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(mode)).unwrap();
        path.to_path_buf()
    };
    let left = [
        make(&shm("node.0_10_0.global_mgmt_half"), 0o200, b""),
        make(&shm(&format!("{kind}_11.dynamic")), 0o200, b""),
        make(&shm(&format!("{kind}_12.data")), 0o200, b"0123456789abcdef"),
        make(&shm(&format!("{kind}_12_13.connection")), 0o600, b""),
        // Finished, but without an owner.
        make(
            &shm(&format!("{kind}_14.dynamic")),
            0o600,
            b"0123456789abcdef",
        ),
        make(&shm(&format!("{kind}_15.data")), 0o600, b"0123456789abcdef"),
        make(
            &shm(&format!("{kind}_15_16.connection")),
            0o600,
            b"0123456789abcdef",
        ),
        make(
            &services.join(format!("{prefix}{kind}.service")),
            0o600,
            b"",
        ),
        make(
            &services.join(format!("{prefix}f{}.service", &kind[1..])),
            0o400,
            b"service",
        ),
        // Nodes that died before, during and after the creation of their monitor file.
        {
            std::fs::create_dir(nodes.join("21")).unwrap();
            make(
                &nodes.join("21").join(format!("{prefix}node.details")),
                0o600,
                b"{",
            );
            nodes.join("21")
        },
        make(
            &nodes.join(format!("{prefix}22.node_monitor_context")),
            0o200,
            b"",
        ),
        make(&nodes.join(format!("{prefix}23.node_monitor")), 0o600, b""),
        make(
            &nodes.join(format!("{prefix}23.node_monitor_owner_lock")),
            0o600,
            b"",
        ),
    ];
    let mut other = spawn("reader", &config);
    await_ready(&mut other, || {
        writer.send(&sample(), Nanos(0)).unwrap();
    });
    for path in &left {
        assert!(!path.exists(), "{} is still there", path.display());
    }
    for path in &live {
        assert!(path.exists(), "{} is gone", path.display());
    }
    while reader.try_take().unwrap().is_some() {}
    assert_eq!(reader.lost(), 0);
    kill(other);
    let swept = domain.sweep().unwrap();
    assert_eq!((swept.nodes, swept.failures, swept.alive), (1, 0, 1));
    assert_eq!(
        domain.sweep().unwrap(),
        proprio_topics::ipc::SweepCounts {
            alive: 1,
            ..Default::default()
        }
    );
    drop((reader, writer, domain));
    assert_nothing_left(&config, &prefix);
}

/// A process that dies while it cleans up after another may have removed a port's tag without
/// freeing the port's place in its service.
#[test]
fn a_place_is_freed_although_who_was_freeing_it_died() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let domain = Domain::open(&config).unwrap();
    let prefix = prefix(&config);
    let nodes = || -> Vec<std::path::PathBuf> {
        let entries = std::fs::read_dir(base.path().join("test/nodes")).unwrap();
        entries
            .map(|e| e.unwrap().path())
            .filter(|p| p.is_dir())
            .collect()
    };
    let before = nodes();
    let mut writer = spawn("lonely writer", &config);
    await_ready(&mut writer, || {});
    // This reader keeps the service, and with it the places of its ports, alive.
    let reader = Reader::<GatewayHealth>::open(&domain, "icub").unwrap();
    kill(writer);

    let mut dead = nodes();
    dead.retain(|node| !before.contains(node));
    let [dead] = dead.as_slice() else {
        panic!("one node has died: {dead:?}")
    };
    // The state after a sweep that was killed when it had removed the first tags.
    let kept = base
        .path()
        .join("test/kept")
        .join(dead.file_name().unwrap());
    std::fs::create_dir_all(&kept).unwrap();
    let mut tags = 0;
    for entry in std::fs::read_dir(dead).unwrap() {
        let tag = entry.unwrap().path();
        if tag.extension().is_some_and(|e| e == "port_tag") {
            std::fs::rename(&tag, kept.join(tag.file_name().unwrap())).unwrap();
            tags += 1;
        }
    }
    assert_eq!(tags, 2, "the writer's ports");

    let next = Writer::<GatewayHealth>::create(&domain, "icub", domain.epoch());
    assert!(next.is_ok(), "{}", next.unwrap_err());
    assert!(!kept.exists(), "the kept tags are removed with their node");
    drop((next, reader, domain));
    assert_nothing_left(&config, &prefix);
}

#[test]
fn a_domain_in_use_is_not_removed() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    assert!(
        Domain::remove_if_unused(&config).unwrap(),
        "a domain that never existed counts as removed"
    );
    let mut writer = spawn("writer", &config);
    await_ready(&mut writer, || ());
    let prefix = prefix(&config);
    assert!(!Domain::remove_if_unused(&config).unwrap());
    let domain = Domain::open(&config).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    while reader.try_take().unwrap().is_none() {}
    assert!(!Domain::remove_if_unused(&config).unwrap());
    drop((reader, domain));
    kill(writer);
    assert!(Domain::remove_if_unused(&config).unwrap());
    assert_nothing_left(&config, &prefix);
}
