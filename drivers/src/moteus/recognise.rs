//! Recognising controllers by replies that read as registers.

use super::{BITS, MoteusOptions, QUERY, REPLY, Reply, WANTED, fd, id};
use crate::recognise::{Evidence, Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::vec::Vec;

impl Recognise for MoteusOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let find = |stream: &Stream| {
            let [host, node, 0, 0] = stream.id.raw().to_le_bytes() else {
                return None;
            };
            if !(1..=127).contains(&node) || host > 127 || stream.id != id(node, host, 0) {
                return None;
            }
            let first = stream.kept().next()?;
            let bits = f64::from(Reply::parse(first.data())?.structure);
            // Of 127 controllers and 128 hosts.
            let mut evidence = Evidence::with_fd(seen, 127 * 128);
            evidence.sends_rarely(stream.id, bits, |frame| {
                Reply::parse(frame.data()).is_some()
            });
            let query = id(host, node, WANTED);
            evidence.sends_rarely(query, f64::from(BITS), |frame| {
                let opcode = frame.data().first();
                opcode.is_some_and(|opcode| *opcode < REPLY)
            });
            let what = "moteus controller";
            let finding = evidence.finding(Self::NAME, node.into(), what)?;
            let host = (host != 0).then(|| Key::new("host", host));
            let period = Key::period_ms(stream.period(), 1, 1000);
            Some(
                finding
                    .with_keys(host.into_iter().chain(period))
                    .with_joints([0]),
            )
        };
        seen.streams().filter_map(find).collect()
    }

    /// The driver's own query.
    fn questions(_seen: &Traffic) -> Vec<Frame> {
        let query = |node| fd(id(0, node, WANTED), &QUERY);
        (1..=127).filter_map(query).collect()
    }
}
