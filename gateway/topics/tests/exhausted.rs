//! Ports of a process that may open no more files connect to each other as soon as it may again.
//! One test: the limit belongs to the process.
#![allow(missing_docs, clippy::unwrap_used)]

use nix::sys::resource::{Resource, getrlimit, setrlimit};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, SendError, TakeError, Writer, monotonic};
use proprio_topics::{EstimatorHealth, Nanos};

/// Calls `run` while this process may open no more files.
fn without_files<R>(run: impl FnOnce() -> R) -> R {
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, 0, hard).unwrap();
    let result = run();
    setrlimit(Resource::RLIMIT_NOFILE, soft, hard).unwrap();
    result
}

/// Calls `attempt` until it succeeds.
fn soon<R>(mut attempt: impl FnMut() -> Option<R>) -> R {
    let end = monotonic() + Nanos::from_millis(20_000);
    loop {
        if let Some(result) = attempt() {
            return result;
        }
        assert!(monotonic() < end, "never");
        std::thread::yield_now();
    }
}

#[test]
fn a_connection_that_failed_is_made_later() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "test")).unwrap();
    let health = EstimatorHealth::default();
    let create = || Writer::<EstimatorHealth>::create(&domain, "icub", 1).unwrap();
    let open = || Reader::<EstimatorHealth>::open(&domain, "icub").unwrap();

    // A reader whose writer is restarted.
    let mut first = create();
    let mut reader = open();
    first.send(&health, monotonic()).unwrap();
    assert!(reader.try_take().unwrap().is_some());
    drop(first);
    let mut second = create();
    let refused = without_files(|| reader.try_take());
    assert_eq!(refused.unwrap_err(), TakeError::Connection);
    // What waits in the port when it is opened again wakes whoever waits, although nothing is sent
    // any more.
    second.send(&health, monotonic()).unwrap();
    soon(|| {
        let taken = reader.try_take().ok()?;
        (taken.is_none() && reader.wait(Nanos::ZERO)).then_some(())
    });
    let sequence = soon(|| {
        second.send(&health, monotonic()).unwrap();
        reader.try_take().ok().flatten()
    })
    .header
    .sequence;
    assert!(reader.lost() <= sequence, "{} lost", reader.lost());
    let taken = soon(|| reader.latest().unwrap().is_none().then(|| reader.taken()));
    second.send(&health, monotonic()).unwrap();
    reader.try_take().unwrap().unwrap();
    assert_eq!(reader.taken(), taken + 1);

    // A writer that another reader opens.
    let mut other = open();
    let refused = without_files(|| second.send(&health, monotonic()));
    assert_eq!(refused.unwrap_err(), SendError::Connection);
    soon(|| {
        let sent = second.send(&health, monotonic());
        sent.is_ok_and(|sent| sent.readers == 2).then_some(())
    });
    assert!(other.latest().unwrap().is_some());
    assert!(reader.latest().unwrap().is_some());
    assert_eq!(second.update_connections(), Ok(0));
}
