//! Starts, watches and ends the processes of the demonstration.

use anyhow::{Context, anyhow, bail};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_topics::Nanos;
use proprio_topics::ipc::{DomainConfig, monotonic};
use std::ffi::OsStr;
use std::fs::{self, File};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Maximum time of the processes to become ready, and to end. They need a second, but half a minute
/// in user-mode Linux on a busy machine. A process that fails is noticed at once.
pub(crate) const PATIENCE: Nanos = Nanos::from_millis(60_000);

/// The processes of the demonstration. Dropping this ends them.
pub(crate) struct Processes {
    pub(crate) private: PathBuf,
    pub(crate) domain: DomainConfig,
    pub(crate) out: PathBuf,
    pub(crate) running: Vec<(&'static str, Child)>,
    /// Set by a signal: end everything.
    pub(crate) stop: Arc<AtomicBool>,
}

impl Processes {
    pub(crate) fn start(
        &mut self,
        name: &'static str,
        args: &[impl AsRef<OsStr>],
    ) -> anyhow::Result<()> {
        let program = std::env::current_exe().context("cannot find the path of this program")?;
        let log = File::create(self.out.join(format!("{name}.log")))?;
        let output = if name == "simulate" {
            File::create(self.private.join("simulate.json"))?.into()
        } else {
            Stdio::null()
        };
        let child = Command::new(program)
            .arg(name)
            .args(args)
            .env("PROPRIO_DOMAIN", &self.domain.name)
            .env("PROPRIO_RUNTIME_DIR", &self.domain.base)
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(log)
            .spawn()
            .with_context(|| format!("cannot start {name}"))?;
        self.running.push((name, child));
        Ok(())
    }

    /// Whether `name` has ended; an error if it failed.
    pub(crate) fn ended(&mut self, name: &str) -> anyhow::Result<bool> {
        if self.stop.load(Relaxed) {
            bail!("interrupted");
        }
        let Some((_, child)) = self.running.iter_mut().find(|(n, _)| *n == name) else {
            return Ok(true);
        };
        match child.try_wait()? {
            None => Ok(false),
            Some(status) if status.success() => Ok(true),
            Some(status) => Err(anyhow!("{name} ended with {status}")),
        }
    }

    /// Ends all processes in the order estimator, gateway, simulator: first with SIGTERM, then by
    /// force.
    pub(crate) fn end(&mut self) -> anyhow::Result<()> {
        let mut problem = Ok(());
        for (name, mut child) in std::mem::take(&mut self.running).into_iter().rev() {
            if child.try_wait()?.is_none() {
                let _ = kill(Pid::from_raw(i32::try_from(child.id())?), Signal::SIGTERM);
            }
            let end = monotonic() + PATIENCE;
            let status = loop {
                if let Some(status) = child.try_wait()? {
                    break status;
                }
                if monotonic() > end {
                    child.kill()?;
                    break child.wait()?;
                }
                std::thread::sleep(Duration::from_millis(5));
            };
            if !status.success() && problem.is_ok() {
                problem = Err(anyhow!(
                    "{name} ended with {status}; see {}",
                    self.out.join(format!("{name}.log")).display()
                ));
            }
        }
        problem
    }

    /// The error with the last error lines of the processes' logs.
    pub(crate) fn explain(&self, error: anyhow::Error) -> anyhow::Error {
        let mut text = String::new();
        for name in ["gateway", "estimator", "simulate"] {
            let log = fs::read_to_string(self.out.join(format!("{name}.log"))).unwrap_or_default();
            let lines: Vec<_> = log
                .lines()
                .filter(|l| l.contains("ERROR") || l.starts_with("error"))
                .collect();
            for line in lines.iter().rev().take(3).rev() {
                let line = line.strip_prefix("error: ").unwrap_or(line);
                text.push_str(&format!("\n  {name}: {line}"));
            }
        }
        if text.is_empty() {
            error
        } else {
            anyhow!("{error:#}; from the logs of the processes:{text}")
        }
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        for (_, child) in &mut self.running {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
