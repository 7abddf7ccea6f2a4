//! What identification needs beside the data plane: the thread that solves, and the file that keeps
//! its state between runs.

use crate::files;
use crate::pipeline::{Job, Pipeline};
use anyhow::Context;
use proprio_identification::online::{Hypothesis, Online, Paused};
use proprio_identification::robot::Robot;
use proprio_topics::ipc::monotonic;
use proprio_topics::{IdentificationHealth, Nanos};
use std::path::PathBuf;
use std::sync::mpsc;

/// Reports what is likelier than the configuration.
fn report_leading(group: Option<&str>, likelier: Option<Hypothesis>, robot: &Robot) {
    match likelier {
        Some(hypothesis) => tracing::warn!(
            group,
            "the readings contradict the configuration: more likely, {}; torques that depend on \
             it are withheld",
            hypothesis.describe(robot)
        ),
        None => tracing::info!(group, "the readings agree with the configuration again"),
    }
}

/// The file that keeps the state of identification between runs.
pub(super) struct StateFile {
    file: PathBuf,
    every: Nanos,
    /// It could not be written the last time.
    fails: bool,
}

impl StateFile {
    /// This file, written every so often.
    pub(super) fn new(file: PathBuf, every: Nanos) -> Self {
        Self {
            file,
            every,
            fails: false,
        }
    }

    /// Resumes from the file, if there is one. A file that cannot be used is renamed.
    pub(super) fn resume(&self, pipeline: &mut Pipeline) {
        let file = self.file.display();
        let text = match std::fs::read(&self.file) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return,
            Err(error) => {
                return tracing::error!(
                    "{file}: cannot be read: {error}; identification starts without it"
                );
            }
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
        };
        match pipeline.resume(&text) {
            Ok(()) => tracing::info!("{file}: identification resumes from this state"),
            Err(error) => match files::set_aside(&self.file) {
                Ok(aside) => tracing::error!(
                    "{file}: {error}; renamed to {}, identification starts without it",
                    aside.display()
                ),
                Err(other) => {
                    tracing::error!(
                        "{file}: {error}; it cannot be renamed ({other}) and will be overwritten"
                    );
                }
            },
        }
    }

    /// Writes it; a failure is told once, until it can be written again.
    fn write(&mut self, text: &str) {
        let result = files::replace(&self.file, text, 0o600);
        let file = self.file.display();
        let failed = std::mem::replace(&mut self.fails, result.is_err());
        match result {
            Err(error) if !failed => tracing::error!(
                "{file}: the state of identification cannot be written: {error}; check the folder \
                 and its permissions"
            ),
            Ok(()) if failed => tracing::info!("{file} can be written again"),
            _ => {}
        }
    }
}

/// The thread that solves for the parameters, and the state that was last reported. The data plane
/// never waits for it.
pub(super) struct IdentificationThread {
    pub(super) jobs: Option<mpsc::SyncSender<Job>>,
    done: mpsc::Receiver<Job>,
    thread: Option<std::thread::JoinHandle<()>>,
    /// Per component, what was last reported: why it pauses, its number of changes, and what is
    /// likelier than the configuration.
    reported: Vec<(Paused, u64, Option<Hypothesis>)>,
    /// Per component, the names of its F/T sensors.
    groups: Vec<String>,
}

impl IdentificationThread {
    /// Starts the thread. It ends when this is dropped, and then writes its state.
    pub(super) fn start(
        online: &Online,
        robot: &Robot,
        mut state_file: Option<StateFile>,
    ) -> anyhow::Result<Self> {
        let components = online.solution().components.iter();
        let groups: Vec<String> = components
            .map(|component| {
                let name = |sensor: &usize| robot.sensor_names().nth(*sensor);
                let names: Vec<_> = component.sensors.iter().filter_map(name).collect();
                names.join(", ")
            })
            .collect();
        let named = groups.clone();
        let (jobs, queue) = mpsc::sync_channel::<Job>(1);
        let (results, done) = mpsc::sync_channel(1);
        let work = move || {
            let (mut unwritten, mut written) = (None, monotonic());
            let mut failing = vec![false; named.len()];
            while let Ok(mut job) = queue.recv() {
                job.run();
                let of_groups = failing.iter_mut().zip(&named);
                for ((fails, group), failure) in of_groups.zip(job.failures()) {
                    match failure {
                        Some(error) if !*fails => tracing::error!(
                            group,
                            "identification cannot solve for the parameters: {error}; the earlier \
                             parameters stay in use"
                        ),
                        None if *fails => {
                            tracing::info!(group, "identification solves for the parameters again");
                        }
                        _ => {}
                    }
                    *fails = failure.is_some();
                }
                let text = state_file.as_ref().map(|_| job.state());
                // Send before writing to the disk, which may be slow: the solution must be in use
                // in time. A receiver that is gone needs none.
                let _ = results.send(job);
                if let (Some(state_file), Some(text)) = (&mut state_file, text) {
                    if monotonic() - written >= state_file.every {
                        state_file.write(&text);
                        (unwritten, written) = (None, monotonic());
                    } else {
                        unwritten = Some(text);
                    }
                }
            }
            if let (Some(state_file), Some(text)) = (&mut state_file, unwritten) {
                state_file.write(&text);
            }
        };
        let thread = std::thread::Builder::new()
            .name("identify".into())
            .spawn(work)
            .context("cannot start a thread")?;
        Ok(Self {
            jobs: Some(jobs),
            done,
            thread: Some(thread),
            reported: vec![(Paused::No, 0, None); groups.len()],
            groups,
        })
    }

    /// The sums over all components for the health message. Reports what has changed since the last
    /// one.
    pub(super) fn health(&mut self, online: &Online, robot: &Robot) -> IdentificationHealth {
        let mut sum = IdentificationHealth {
            groups: u32::try_from(self.reported.len()).unwrap_or(0),
            ..IdentificationHealth::default()
        };
        for (component, (reported, changes, leading)) in self.reported.iter_mut().enumerate() {
            let Some((paused, counts)) = online.state(component) else {
                continue;
            };
            sum.paused += u32::from(paused != Paused::No);
            sum.learnt += counts.learnt;
            sum.still += counts.still;
            sum.contact += counts.contact;
            sum.outlier += counts.outlier;
            sum.suspected += counts.suspected;
            sum.stale += counts.stale;
            sum.saturated += counts.saturated;
            sum.device_fault += counts.device_fault;
            sum.unseen += counts.unseen;
            sum.offset_changes += counts.offset_changes;
            sum.load_changes += counts.load_changes;
            sum.unknown_changes += counts.changes - counts.offset_changes - counts.load_changes;
            // Common to all components.
            sum.late = counts.late;
            sum.failed += counts.failed;
            let group = self.groups.get(component).map(String::as_str);
            if std::mem::replace(reported, paused) != paused {
                tracing::info!(group, "{}", paused.describe(robot));
            }
            if std::mem::replace(changes, counts.changes) != counts.changes
                && let Some(change) = online.last_change(component)
            {
                tracing::warn!(group, "{change}");
            }
            let likelier = online.solution().components.get(component);
            let likelier = likelier.and_then(|own| own.leading);
            let kind = likelier.map(Hypothesis::without_estimate);
            if std::mem::replace(leading, kind) != kind {
                report_leading(group, likelier, robot);
            }
        }
        sum
    }

    /// A job that has been run. Reports once if the thread has ended.
    pub(super) fn finished_job(&mut self) -> Option<Job> {
        match self.done.try_recv() {
            Ok(job) => Some(job),
            Err(mpsc::TryRecvError::Empty) => None,
            Err(mpsc::TryRecvError::Disconnected) => {
                if self.jobs.take().is_some() {
                    tracing::error!(
                        "the identification thread has panicked: the parameters in use stay as \
                         they are and are no longer updated; restart the estimator and report this \
                         bug"
                    );
                }
                None
            }
        }
    }
}

impl Drop for IdentificationThread {
    fn drop(&mut self) {
        self.jobs = None;
        // The channel has room for the result of the last job, so this waits for one job at most.
        let _ = self.thread.take().map(std::thread::JoinHandle::join);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_panics_is_reported_once_and_gets_no_more_jobs() {
        let (jobs, queue) = mpsc::sync_channel::<Job>(1);
        let (results, done) = mpsc::sync_channel::<Job>(1);
        let work = move || {
            let _ends = (queue, results);
            panic!("as a fault in identification would");
        };
        let thread = std::thread::spawn(work);
        let mut identification = IdentificationThread {
            jobs: Some(jobs),
            done,
            thread: Some(thread),
            reported: Vec::new(),
            groups: Vec::new(),
        };
        let end = monotonic() + Nanos::from_millis(20_000);
        while !identification
            .thread
            .as_ref()
            .is_some_and(std::thread::JoinHandle::is_finished)
        {
            assert!(monotonic() < end, "the thread does not end");
            std::thread::yield_now();
        }
        assert!(identification.finished_job().is_none() && identification.jobs.is_none());
        assert!(identification.finished_job().is_none());
    }
}
