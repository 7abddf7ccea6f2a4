//! A full /dev/shm costs nobody his life: what is made is allocated at once, and a lack is an error
//! with the numbers in it. Each test has a /dev/shm of its own, in a mount namespace of its thread.
#![allow(missing_docs, clippy::unwrap_used)]

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};
use proprio_topics::ipc::{Domain, DomainConfig, DomainError, PortError, Reader, Writer};
use proprio_topics::{Header, Nanos, Reading, Sample, Wrench};
use std::fs;
use std::io::Write as _;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

/// Runs `test` with a /dev/shm of `size`; not without the right to mount.
fn with_shared_memory(size: &'static str, test: impl FnOnce() + Send + 'static) {
    let body = move || {
        let none = None::<&str>;
        let mounted = unshare(CloneFlags::CLONE_NEWNS)
            .and_then(|()| mount(none, "/", none, MsFlags::MS_REC | MsFlags::MS_PRIVATE, none))
            .and_then(|()| {
                let size = format!("size={size}");
                let flags = MsFlags::empty();
                mount(
                    Some("tmpfs"),
                    "/dev/shm",
                    Some("tmpfs"),
                    flags,
                    Some(&*size),
                )
            });
        match mounted {
            Ok(()) => test(),
            Err(cause) => println!("skipped: no mount namespace of its own ({cause})"),
        }
    };
    std::thread::spawn(body).join().unwrap();
}

fn place() -> (tempfile::TempDir, DomainConfig) {
    let base = tempfile::tempdir().unwrap();
    let config = DomainConfig::new(base.path(), "test");
    (base, config)
}

fn segments() -> Vec<PathBuf> {
    let entries = fs::read_dir("/dev/shm").unwrap();
    entries.map(|entry| entry.unwrap().path()).collect()
}

fn fill() {
    let mut file = fs::File::create("/dev/shm/fill").unwrap();
    while file.write_all(&[1; 4096]).is_ok() {}
}

fn no_room(error: &PortError) -> (u64, u64) {
    match error {
        PortError::Domain(DomainError::NoRoom { needed, free }) => (*needed, *free),
        other => panic!("{other}"),
    }
}

#[test]
fn a_start_without_room_is_an_error_that_says_how_much() {
    with_shared_memory("1m", || {
        let (_base, config) = place();
        let domain = Domain::open(&config).unwrap();
        let error = Writer::<Sample>::create(&domain, "icub", 1).unwrap_err();
        let (needed, free) = no_room(&error);
        assert!(needed > 1 << 20 && free < 1 << 20, "{error}");
        assert!(error.to_string().contains("/dev/shm is full"), "{error}");
        let size = Some("size=64m");
        let flags = MsFlags::MS_REMOUNT;
        mount(None::<&str>, "/dev/shm", None::<&str>, flags, size).unwrap();
        drop(Writer::<Sample>::create(&domain, "icub", 1).unwrap());
        drop(domain);
        assert!(segments().is_empty(), "{:?}", segments());
    });
    with_shared_memory("64k", || {
        let (_base, config) = place();
        let refused = Domain::open(&config).map(drop);
        assert!(
            matches!(refused, Err(DomainError::NoRoom { .. })),
            "{refused:?}"
        );
    });
}

#[test]
fn who_runs_goes_on_when_memory_is_full_and_a_newcomer_is_told() {
    with_shared_memory("64m", || {
        let (_base, config) = place();
        let domain = Domain::open(&config).unwrap();
        let mut writer = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
        let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
        for path in segments() {
            let meta = fs::metadata(&path).unwrap();
            assert!(
                meta.blocks() * 512 >= meta.len(),
                "{} is sparse",
                path.display()
            );
            assert_eq!(
                meta.mode() & 0o77,
                0,
                "{} is not its owner's",
                path.display()
            );
        }
        fill();
        let reading = Reading::Wrench(Wrench {
            force: [1.0; 3],
            torque: [0.1; 3],
        });
        let sample = Sample::new(Header::default(), 0, &reading);
        for k in 0..1000 {
            writer.send(&sample, Nanos(k)).unwrap();
            assert!(reader.try_take().unwrap().is_some());
        }
        let error = Reader::<Sample>::open(&domain, "icub").unwrap_err();
        assert_eq!(no_room(&error).1, 0);
        let error = Domain::open(&config).unwrap_err();
        assert!(matches!(error, DomainError::NoRoom { .. }), "{error}");
        fs::remove_file("/dev/shm/fill").unwrap();
        let mut late = Reader::<Sample>::open(&domain, "icub").unwrap();
        writer.send(&sample, Nanos(0)).unwrap();
        assert!(late.try_take().unwrap().is_some());
    });
}
