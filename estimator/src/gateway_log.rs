//! What the estimator's log says about its input: when the gateway comes, goes or is stuck, and
//! which channels are missing. One line for each change, with what to do. Part of the control
//! plane: the data plane only stores what has come ([`ChannelStatus`]).

use crate::setup::Setup;
use proprio_topics::Nanos;
use proprio_topics::ipc::Presence;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicI64};

/// A channel without a sample for this long after the gateway has come is missing: boards may stay
/// 6 s in their bootloader, and take another moment to start.
const START: Nanos = Nanos::from_millis(10_000);
/// A channel that was received is missing after this silence, or after its own maximum silence if
/// that is longer: as long as a gateway without health counts as stuck.
const SILENCE: Nanos = Nanos::from_millis(1000);

/// What the data plane has received of a channel.
#[derive(Debug)]
pub(crate) struct ChannelStatus {
    undescribed: AtomicBool,
    newest: AtomicI64,
}

impl Default for ChannelStatus {
    fn default() -> Self {
        Self {
            undescribed: AtomicBool::new(false),
            newest: AtomicI64::new(Nanos::MIN.0),
        }
    }
}

impl ChannelStatus {
    /// Whether the gateway's description has this channel.
    pub(crate) fn set_described(&self, described: bool) {
        self.undescribed.store(!described, Relaxed);
    }

    /// The stamp of its newest sample.
    pub(crate) fn set_newest(&self, t: Nanos) {
        self.newest.store(t.0, Relaxed);
    }
}

/// Why a channel is missing, if it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Absence {
    No,
    Undescribed,
    Silent,
}

/// A channel, as the log knows it.
#[derive(Debug)]
struct WatchedChannel {
    name: String,
    newest: i64,
    /// When its next sample must have come.
    due: Nanos,
    told: Absence,
}

/// Turns what is known of the gateway into log lines.
#[derive(Debug)]
pub(crate) struct GatewayLog {
    robot: String,
    domain: String,
    told: Option<Presence>,
    silence: Nanos,
    channels: Vec<WatchedChannel>,
}

impl GatewayLog {
    /// For the gateway of the robot in the shared-memory domain `domain`.
    pub(crate) fn new(setup: &Setup, domain: &str) -> Self {
        let robot = &setup.robot;
        let channels = setup.channels().map(|(_, name)| WatchedChannel {
            name: name.to_owned(),
            newest: Nanos::MIN.0,
            due: Nanos::MAX,
            told: Absence::No,
        });
        Self {
            robot: robot.name.clone(),
            domain: domain.to_owned(),
            told: None,
            silence: robot.max_silence.max(SILENCE),
            channels: channels.collect(),
        }
    }

    /// Logs what has changed since the last call. `channels` are those of the configuration.
    pub(crate) fn tell(&mut self, gateway: Presence, channels: &[ChannelStatus], now: Nanos) {
        let gateway = match (gateway, self.told) {
            // One that had gone before this estimator started is no news.
            (Presence::Ended | Presence::Killed, None | Some(Presence::NotStarted)) => {
                Presence::NotStarted
            }
            _ => gateway,
        };
        let before = self.told.replace(gateway);
        if before != Some(gateway) {
            self.tell_gateway(gateway, before);
            if gateway == Presence::Running && !matches!(before, Some(Presence::Stuck { .. })) {
                self.channels.iter_mut().for_each(|c| c.due = now + START);
            }
        }
        // Without a gateway that runs, everything is missing: that has been told.
        if gateway == Presence::Running {
            self.tell_channels(channels, now);
        }
    }

    fn tell_gateway(&self, gateway: Presence, before: Option<Presence>) {
        let (robot, domain) = (self.robot.as_str(), self.domain.as_str());
        match gateway {
            Presence::NotStarted => tracing::info!(
                "waiting for the gateway of robot {robot:?} in domain {domain:?}: start it with \
                 the same robot, user and PROPRIO_DOMAIN"
            ),
            Presence::Running => match before {
                None | Some(Presence::NotStarted) => tracing::info!("the gateway is running"),
                Some(Presence::Stuck { .. }) => {
                    tracing::info!("the gateway sends its health again");
                }
                _ => tracing::info!("the gateway is running again"),
            },
            Presence::Stuck { .. } => tracing::error!(
                "the gateway {gateway}: it has sent no health for 1 s; torques become stale; if it \
                 does not go on (SIGCONT), restart it"
            ),
            Presence::Ended => tracing::warn!(
                "the gateway has stopped: torques become stale until it is started again"
            ),
            Presence::Killed => tracing::error!(
                "the gateway {gateway}: torques become stale until it is started again; its own \
                 log and the kernel's (out of memory?) may say why"
            ),
        }
    }

    fn tell_channels(&mut self, channels: &[ChannelStatus], now: Nanos) {
        let silence = self.silence;
        let mut changed = [Absence::No, Absence::Undescribed, Absence::Silent]
            .map(|missing| (missing, Vec::new()));
        for (channel, status) in self.channels.iter_mut().zip(channels) {
            let newest = status.newest.load(Relaxed);
            let came = std::mem::replace(&mut channel.newest, newest) != newest;
            if came {
                channel.due = now + silence;
            }
            let missing = if status.undescribed.load(Relaxed) {
                Absence::Undescribed
            } else if came {
                Absence::No
            } else if now > channel.due {
                Absence::Silent
            } else {
                channel.told
            };
            if std::mem::replace(&mut channel.told, missing) != missing
                && let Some((_, names)) = changed.iter_mut().find(|(m, _)| *m == missing)
            {
                names.push(channel.name.as_str());
            }
        }
        for (missing, names) in changed.iter().filter(|(_, names)| !names.is_empty()) {
            let names = names.join(", ");
            match missing {
                Absence::No => tracing::info!("received again: {names}"),
                Absence::Undescribed => tracing::error!(
                    "the gateway does not have {names}: what depends on it is withheld; add it to \
                     gateway.toml, correct its name, or lock the joint in [locked]"
                ),
                Absence::Silent => tracing::warn!(
                    "no samples of {names}: what depends on it is withheld; see the gateway's log \
                     and `proprio status` for its board"
                ),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io;
    use std::sync::{Arc, Mutex};

    /// Collects log lines.
    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl io::Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// The lines that `run` logs.
    fn logged(run: impl FnOnce()) -> Vec<String> {
        let lines = Lines::default();
        let writer = lines.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_writer(move || writer.clone())
            .with_ansi(false)
            .without_time()
            .with_target(false)
            .finish();
        tracing::subscriber::with_default(subscriber, run);
        let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        text.lines().map(|l| l.trim().to_owned()).collect()
    }

    /// A log of an elbow and a wrist, and what the data plane knows of them.
    fn log() -> (GatewayLog, [ChannelStatus; 2]) {
        let channels = ["elbow", "wrist"].map(|name| WatchedChannel {
            name: name.to_owned(),
            newest: Nanos::MIN.0,
            due: Nanos::MAX,
            told: Absence::No,
        });
        let log = GatewayLog {
            robot: "icub".to_owned(),
            domain: "lab".to_owned(),
            told: None,
            silence: SILENCE,
            channels: channels.into(),
        };
        (log, Default::default())
    }

    #[test]
    fn a_gateway_that_comes_and_goes_is_one_line_each() {
        let (mut log, channels) = log();
        let mut now = Nanos::ZERO;
        for (gateway, told) in [
            (
                Presence::Ended,
                "INFO waiting for the gateway of robot \"icub\" in domain",
            ),
            (Presence::Running, "INFO the gateway is running"),
            (
                Presence::Stuck { process: 7 },
                "ERROR the gateway (process 7) is stopped or stuck",
            ),
            (Presence::Running, "INFO the gateway sends its health again"),
            (
                Presence::Killed,
                "ERROR the gateway was killed or has crashed",
            ),
            (Presence::Running, "INFO the gateway is running again"),
            (Presence::Ended, "WARN the gateway has stopped"),
        ] {
            let lines = logged(|| {
                for _ in 0..5 {
                    now += Nanos::from_millis(100);
                    for channel in &channels {
                        channel.set_newest(now);
                    }
                    log.tell(gateway, &channels, now);
                }
            });
            let [line] = &lines[..] else {
                panic!("{gateway}: {lines:?}")
            };
            assert!(line.starts_with(told), "{line}, not {told}");
        }
    }

    #[test]
    fn a_missing_channel_is_named_once_and_once_when_it_comes() {
        let (mut log, channels) = log();
        let [elbow, wrist] = &channels;
        let mut now = Nanos::ZERO;
        let mut tick = |seconds: i64, coming: &[&ChannelStatus], gateway| {
            logged(|| {
                for _ in 0..10 * seconds {
                    now += Nanos::from_millis(100);
                    coming.iter().for_each(|channel| channel.set_newest(now));
                    log.tell(gateway, &channels, now);
                }
            })
        };
        let running = Presence::Running;
        assert_eq!(tick(9, &[elbow], running), ["INFO the gateway is running"]);
        let lines = tick(60, &[elbow], running);
        assert!(
            lines.len() == 1 && lines[0].starts_with("WARN no samples of wrist:"),
            "{lines:?}"
        );
        assert_eq!(
            tick(5, &[elbow, wrist], running),
            ["INFO received again: wrist"]
        );
        let lines = tick(5, &[], running);
        assert!(
            lines.len() == 1 && lines[0].starts_with("WARN no samples of elbow, wrist:"),
            "{lines:?}"
        );
        // A gateway that goes is one line, and gives the boards time when it comes again.
        assert_eq!(tick(60, &[], Presence::Ended).len(), 1);
        elbow.set_described(false);
        let lines = tick(9, &[wrist], running);
        assert_eq!(lines.len(), 3, "{lines:?}");
        assert!(lines[0].ends_with("is running again"), "{lines:?}");
        assert_eq!(lines[1], "INFO received again: wrist");
        assert!(
            lines[2].starts_with("ERROR the gateway does not have elbow:"),
            "{lines:?}"
        );
        elbow.set_described(true);
        assert_eq!(
            tick(9, &[elbow, wrist], running),
            ["INFO received again: elbow"]
        );
    }
}
