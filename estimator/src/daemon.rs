//! The estimator daemon: one data-plane thread from samples to estimates, and a control plane that looks after it.
//!
//! The data-plane thread polls shared memory; it takes no lock and allocates nothing once its ports are open. A service
//! that is not there yet is looked for now and then, so gateway and estimator can start in any order, and either can be
//! killed and started again.

use crate::check::Check;
use crate::config::{Config, ConfigError};
use crate::first_look::FirstLook;
use crate::identify::online::{Paused, state};
use crate::pipeline::{Job, Pipeline};
use crate::setup::Setup;
use anyhow::{Context, anyhow};
use proprio_topics::ipc::{Domain, DomainConfig, DomainError, PortError, Reader, Topic, Writer, monotonic};
use proprio_topics::realtime;
use proprio_topics::{
    ContactDeclaration, ContactEstimate, Description, EstimatorHealth, IdentificationHealth, InertiaEstimate, Nanos,
    Publisher, Role, Sample, TorqueEstimate,
};
use sd_notify::NotifyState;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::atomic::{AtomicBool, AtomicI64};
use std::sync::mpsc;
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};

/// How long the data plane sleeps when there is nothing to do.
const NAP: Duration = Duration::from_micros(100);
/// How often a service that is not there is looked for.
const LOOK: Nanos = Nanos::from_millis(50);
/// How often health is sent.
const HEALTH_PERIOD: Nanos = Nanos::from_millis(100);
/// For how many of these a temperature must have been missing before that is worth a line: boards send it every few seconds at the best.
const COLD: u32 = 100;
/// A data plane that has not turned for so long is stuck.
const STUCK: Nanos = Nanos::from_millis(500);
/// How many samples are taken at once, at the most: as many as may wait from all buses (6 MB).
const INBOX: usize = <Sample as Topic>::QUALITY.buffer * <Sample as Topic>::QUALITY.publishers;

/// Checks a configuration, and prints what would be estimated from what.
///
/// # Errors
/// As for [`run`].
pub fn check(config: &Path) -> anyhow::Result<Setup> {
    let (_, setup) = load(config, |_| {})?;
    let checked = Check::of(&setup).context("the configuration can not be checked")?;
    // Whoever reads it may stop early.
    let _ = write!(std::io::stdout(), "{setup}{checked}");
    let file = config.to_owned();
    match checked.problem() {
        Some(problem) => Err(ConfigError { file, problem }.into()),
        None => Ok(setup),
    }
}

/// Runs the estimator until SIGTERM or SIGINT.
///
/// # Errors
/// One chain that says what, where and what to do; [`ConfigError`] at its root is a wrong configuration.
pub fn run(config: &Path, domain: &DomainConfig) -> anyhow::Result<()> {
    let (config, setup) = load(config, |_| {})?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start")?;
    runtime.block_on(serve(&config, setup, domain))
}

/// Reads a configuration, changed by `adjust` before anything else is read, and what it names: model, identified parameters. Tells warnings to the log.
///
/// # Errors
/// [`ConfigError`].
pub fn load(file: &Path, adjust: impl FnOnce(&mut Config)) -> Result<(Config, Setup), ConfigError> {
    let mut config = Config::load(file)?;
    adjust(&mut config);
    let setup = Setup::new(&config).map_err(|problem| ConfigError {
        file: file.to_owned(),
        problem,
    })?;
    for warning in setup.warnings() {
        tracing::warn!("{}: {warning}", file.display());
    }
    Ok((config, setup))
}

/// Whether an error that [`run`] ended with is a wrong configuration: exit 2, else 1.
pub fn is_configuration(error: &anyhow::Error) -> bool {
    error
        .chain()
        .any(|cause| cause.is::<ConfigError>() || cause.downcast_ref().is_some_and(DomainError::is_configuration))
}

async fn serve(config: &Config, setup: Setup, domain: &DomainConfig) -> anyhow::Result<()> {
    let mut terminate = signal(SignalKind::terminate()).context("cannot catch SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot catch SIGINT")?;
    let stop = Arc::new(AtomicBool::new(false));
    let last_turn = Arc::new(AtomicI64::new(monotonic().0));
    let (ready, is_ready) = mpsc::channel();
    let (robot, realtime, domain) = (config.robot.clone(), config.realtime, domain.clone());
    let kept = config.identification.state.clone().map(|file| Kept {
        file,
        every: Nanos::from_seconds(config.identification.save_every_s),
    });
    let (stop_there, turn_there) = (Arc::clone(&stop), Arc::clone(&last_turn));
    let thread = std::thread::Builder::new()
        .name("estimate".into())
        .spawn(move || {
            let mut plane = match DataPlane::open(&domain, &robot, setup, kept, turn_there) {
                Ok(plane) => plane,
                Err(error) => return drop(ready.send(Err(error))),
            };
            let refused = realtime.map(|r| realtime::apply(r.cpu, r.priority)).unwrap_or_default();
            let _ = ready.send(Ok(refused));
            plane.run(&stop_there);
        })
        .context("cannot start a thread")?;
    for refusal in is_ready.recv().map_err(|_| anyhow!("the data plane ended at once"))?? {
        tracing::warn!("real-time scheduling not granted: {refusal}");
    }
    tracing::info!(robot = config.robot, "running");
    let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("running")]);
    let watchdog = sd_notify::watchdog_enabled();
    let mut ticks = tokio::time::interval(Duration::from_millis(100));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let why = loop {
        tokio::select! {
            _ = terminate.recv() => break "SIGTERM",
            _ = interrupt.recv() => break "SIGINT",
            _ = ticks.tick() => {}
        }
        if thread.is_finished() {
            break "the data plane has ended";
        }
        if watchdog.is_some() && monotonic() - Nanos(last_turn.load(Relaxed)) < STUCK {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
    };
    tracing::info!(why, "stopping");
    let _ = sd_notify::notify(&[NotifyState::Stopping]);
    stop.store(true, Release);
    thread
        .join()
        .map_err(|_| anyhow!("the data plane panicked; this is a mistake in the program"))
}

/// What the data-plane thread owns.
struct DataPlane {
    domain: Domain,
    robot: String,
    pipeline: Pipeline,
    samples: Option<Reader<Sample>>,
    /// What was waiting, to be put in order; never grows.
    inbox: Vec<Sample>,
    descriptions: Option<Reader<Description>>,
    declarations: Reader<ContactDeclaration>,
    told_of_contact: bool,
    /// For how many healths in a row a sensor has been without the temperature that its calibration wants.
    cold: u32,
    /// Per channel number of the gateway: the pipeline's channel.
    map: Vec<Option<usize>>,
    /// The gateway's epoch that `map` belongs to.
    mapped: u64,
    torques: Writer<TorqueEstimate>,
    contacts: Writer<ContactEstimate>,
    /// Where something is identified.
    inertias: Option<Writer<InertiaEstimate>>,
    health_writer: Writer<EstimatorHealth>,
    description_writer: Writer<Description>,
    health: EstimatorHealth,
    identifier: Option<Identifier>,
    first_look: FirstLook,
    next_look: Nanos,
    next_health: Nanos,
    last_turn: Arc<AtomicI64>,
}

impl DataPlane {
    fn open(
        domain: &DomainConfig,
        robot: &str,
        setup: Setup,
        kept: Option<Kept>,
        last_turn: Arc<AtomicI64>,
    ) -> anyhow::Result<Self> {
        let domain = Domain::open(domain)?;
        let epoch = domain.epoch();
        // The health first: it admits one writer, which is how a second estimator of this robot finds out.
        let health_writer = Writer::create(&domain, robot, epoch)?;
        let mut description_writer = Writer::<Description>::create(&domain, robot, epoch)?;
        let torques = Writer::create(&domain, robot, epoch)?;
        let contacts = Writer::create(&domain, robot, epoch)?;
        let now = monotonic();
        description_writer.send(&setup.description(), now)?;
        let first_look = FirstLook::start(&setup)?;
        let mut pipeline = Pipeline::new(setup);
        if let Some(kept) = &kept {
            kept.resume(&mut pipeline);
        }
        if let Some(refusal) = pipeline.identification_refused() {
            tracing::warn!("identification.enabled: {refusal}");
        }
        let identifier = pipeline
            .identification()
            .map(|online| Identifier::start(online.component_count(), kept))
            .transpose()?;
        let inertias = match identifier {
            Some(_) => Some(Writer::create(&domain, robot, epoch)?),
            None => None,
        };
        Ok(Self {
            robot: robot.to_owned(),
            pipeline,
            identifier,
            first_look,
            samples: None,
            inbox: Vec::with_capacity(INBOX),
            descriptions: None,
            // Its service is created here, so that it need not be looked for: whoever declares comes when he likes.
            declarations: {
                let creator = Writer::<ContactDeclaration>::create(&domain, robot, epoch)?;
                let reader = Reader::open(&domain, robot)?;
                drop(creator);
                reader
            },
            told_of_contact: false,
            cold: 0,
            map: Vec::with_capacity(proprio_topics::MAX_CHANNELS),
            mapped: 0,
            torques,
            contacts,
            inertias,
            health_writer,
            description_writer,
            health: EstimatorHealth {
                started: now,
                ..EstimatorHealth::default()
            },
            next_look: Nanos::ZERO,
            next_health: Nanos::ZERO,
            last_turn,
            domain,
        })
    }

    fn run(&mut self, stop: &AtomicBool) {
        while !stop.load(Acquire) {
            let now = monotonic();
            self.last_turn.store(now.0, Relaxed);
            self.health.last_turn = now;
            if now >= self.next_look {
                self.next_look = now + LOOK;
                look(&mut self.samples, &self.domain, &self.robot);
                look(&mut self.descriptions, &self.domain, &self.robot);
            }
            self.take_declarations(now);
            if let Some(job) = self.identifier.as_mut().and_then(Identifier::take) {
                self.pipeline.give_back(job);
            }
            let idle = !self.take_samples(now);
            if now >= self.next_health {
                self.next_health = now + HEALTH_PERIOD;
                self.tell_health(now);
            }
            if idle {
                std::thread::sleep(NAP);
            }
        }
        self.tell_health(monotonic());
        if self.identifier.is_some() {
            tracing::info!("instants of identification: {}", self.health.identification);
        }
    }

    /// Takes what is waiting and publishes what it completes; whether there was anything.
    fn take_samples(&mut self, now: Nanos) -> bool {
        // Shared memory hands out all of one bus before the next one's. After a stall that would let the first bus run ahead by more
        // than an estimate waits, and what the others sent meanwhile would be late: so they are put in order first.
        self.inbox.clear();
        while self.inbox.len() < INBOX
            && let Some(Ok(Some(sample))) = self.samples.as_mut().map(Reader::try_take)
        {
            self.inbox.push(sample);
        }
        self.inbox
            .sort_unstable_by_key(|s| (s.header.acquired, s.header.bus, s.header.sequence));
        self.health.samples += self.inbox.len() as u64;
        for at in 0..self.inbox.len() {
            let Some(sample) = self.inbox.get(at).copied() else {
                break;
            };
            if sample.header.epoch != self.mapped {
                self.take_descriptions();
            }
            let channel = self.map.get(sample.channel as usize).copied().flatten();
            if sample.header.epoch != self.mapped {
                self.health.unknown_channel += 1;
                continue;
            }
            // A channel that the configuration does not name is not an error: the gateway may serve others.
            let Some(channel) = channel else { continue };
            let (t, quality) = (sample.header.acquired, sample.header.quality);
            self.first_look.see(now, channel, t, &sample.reading, quality);
            self.pipeline.push(channel, t, &sample.reading, quality);
            while let Some(estimate) = self.pipeline.poll() {
                let now = monotonic();
                let sent = self.torques.send(&estimate.torques, now).is_ok()
                    & self.contacts.send(&estimate.contacts, now).is_ok();
                self.health.estimates += 1;
                self.health.publish_failures += u64::from(!sent);
                self.health.withheld += u64::from(estimate.torques.joints().iter().any(|j| j.valid != 1));
                self.health.last_estimate = estimate.t;
                if let Some(inertias) = &mut self.inertias
                    && let Some(inertia) = self.pipeline.inertia()
                {
                    self.health.publish_failures += u64::from(inertias.send(inertia, now).is_err());
                }
                if let Some(jobs) = self.identifier.as_ref().and_then(|identifier| identifier.jobs.as_ref())
                    && let Some(job) = self.pipeline.take_job()
                {
                    // There is one job, so there is room; a thread that ended has told why.
                    let _ = jobs.try_send(job);
                }
            }
        }
        !self.inbox.is_empty()
    }

    /// Reads who is who from the gateway.
    fn take_descriptions(&mut self) {
        while let Some(Ok(Some(description))) = self.descriptions.as_mut().map(Reader::try_take) {
            if description.publisher != Publisher::Gateway {
                continue;
            }
            self.map.clear();
            for number in 0..proprio_topics::MAX_CHANNELS {
                let entry = u32::try_from(number)
                    .ok()
                    .and_then(|n| description.find(Role::Channel, n));
                self.map
                    .push(entry.and_then(|e| self.pipeline.setup().channel(e.kind, e.name.as_str())));
            }
            self.mapped = description.header.epoch;
            let missing = (0..self.pipeline.setup().channels().len()).filter(|c| !self.map.contains(&Some(*c)));
            for channel in missing {
                let name = self
                    .pipeline
                    .setup()
                    .channels()
                    .get(channel)
                    .map_or("", |c| c.name.as_str());
                tracing::error!(
                    channel = name,
                    "the gateway has no such channel: what depends on it is withheld; measure it, or lock it in [locked]"
                );
            }
        }
    }

    fn take_declarations(&mut self, now: Nanos) {
        while let Ok(Some(declared)) = self.declarations.try_take() {
            match self.pipeline.setup().contact(declared.contact.as_str()) {
                Some(contact) => {
                    let (t, active) = (declared.header.acquired, declared.active != 0);
                    self.first_look.declare(now, contact, t, active);
                    self.pipeline.declare(contact, t, active);
                }
                // Once: whoever misspells a name may do so a thousand times a second.
                None if !self.told_of_contact => {
                    self.told_of_contact = true;
                    tracing::warn!(
                        contact = declared.contact.as_str(),
                        "a contact was declared that the configuration does not have"
                    );
                }
                None => {}
            }
        }
    }

    /// Says once that a sensor's temperature is missing, and once that none is any more.
    fn tell_temperatures(&mut self) {
        if self.pipeline.without_temperature().next().is_none() {
            if std::mem::replace(&mut self.cold, 0) >= COLD {
                tracing::info!("the temperatures that calibrations want are there again");
            }
            return;
        }
        self.cold = self.cold.saturating_add(1);
        if self.cold == COLD {
            for sensor in self.pipeline.without_temperature() {
                tracing::warn!(
                    sensor,
                    "its calibration wants the temperature of its board, which has not been told yet, or not for a minute: torques that rest on it are less certain; have the board send it"
                );
            }
        }
    }

    fn tell_health(&mut self, now: Nanos) {
        self.tell_temperatures();
        let counts = self.pipeline.counts();
        (self.health.late, self.health.backward, self.health.not_finite) =
            (counts.late, counts.backward, counts.not_finite);
        self.health.lost = self.samples.as_ref().map_or(0, Reader::lost);
        self.health.epochs = self.samples.as_ref().map_or(0, Reader::epochs);
        if let (Some(identifier), Some(online)) = (&mut self.identifier, self.pipeline.identification()) {
            let mut sum = IdentificationHealth {
                groups: u32::try_from(identifier.told.len()).unwrap_or(0),
                ..IdentificationHealth::default()
            };
            for (component, (told, changes)) in identifier.told.iter_mut().enumerate() {
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
                // One for all of them.
                sum.late = counts.late;
                sum.failed += counts.failed;
                if std::mem::replace(told, paused) != paused {
                    tracing::info!(component, "{paused}");
                }
                if std::mem::replace(changes, counts.changes) != counts.changes
                    && let Some(change) = online.last_change(component)
                {
                    tracing::warn!(component, "{change}");
                }
            }
            self.health.identification = sum;
        }
        // Who can not be reached now gets the next one.
        let _ = self.health_writer.send(&self.health, now);
        let _ = self.description_writer.update_connections();
        let _ = self.inertias.as_mut().map(Writer::update_connections);
    }
}

/// Where what was identified is kept.
struct Kept {
    file: PathBuf,
    every: Nanos,
}

impl Kept {
    /// Goes on from the file, if it is there; one that does not fit is set aside.
    fn resume(&self, pipeline: &mut Pipeline) {
        let file = self.file.display();
        let text = match std::fs::read(&self.file) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return,
            Err(error) => {
                return tracing::error!("{file}: can not be read: {error}; identification begins without it");
            }
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
        };
        match pipeline.resume(&text) {
            Ok(()) => tracing::info!("{file}: identification goes on where it was"),
            Err(error) => match state::set_aside(&self.file) {
                Ok(aside) => tracing::error!(
                    "{file}: {error}; renamed to {}, identification begins without it",
                    aside.display()
                ),
                Err(other) => {
                    tracing::error!("{file}: {error}; it can not be renamed ({other}), and will be overwritten");
                }
            },
        }
    }

    fn write(&self, text: &str) {
        if let Err(error) = state::write(&self.file, text) {
            tracing::error!("{}: {error}", self.file.display());
        }
    }
}

/// The thread that solves for the parameters, and what was last told of it. The data plane never waits for it.
struct Identifier {
    jobs: Option<mpsc::SyncSender<Job>>,
    done: mpsc::Receiver<Job>,
    thread: Option<std::thread::JoinHandle<()>>,
    /// Per component: why it pauses, and how many changes it has seen.
    told: Vec<(Paused, u64)>,
}

impl Identifier {
    /// Starts the thread; it ends with this, and then keeps what it knows.
    fn start(components: usize, kept: Option<Kept>) -> anyhow::Result<Self> {
        let (jobs, waiting) = mpsc::sync_channel::<Job>(1);
        let (back, done) = mpsc::sync_channel(1);
        let work = move || {
            let (mut unwritten, mut written) = (None, monotonic());
            let mut failing = vec![false; components];
            while let Ok(mut job) = waiting.recv() {
                job.run();
                for (component, (fails, failure)) in failing.iter_mut().zip(job.failures()).enumerate() {
                    match failure {
                        Some(error) if !*fails => tracing::error!(
                            component,
                            "identification can not solve for the parameters: {error}; what was known before stays in force"
                        ),
                        None if *fails => tracing::info!(component, "identification solves for the parameters again"),
                        _ => {}
                    }
                    *fails = failure.is_some();
                }
                let text = kept.as_ref().map(|_| job.state());
                // Before the disk, which may be slow: what it found has to be in force in time. Who has ended needs no solution any more.
                let _ = back.send(job);
                if let (Some(kept), Some(text)) = (&kept, text) {
                    if monotonic() - written >= kept.every {
                        kept.write(&text);
                        (unwritten, written) = (None, monotonic());
                    } else {
                        unwritten = Some(text);
                    }
                }
            }
            if let (Some(kept), Some(text)) = (&kept, unwritten) {
                kept.write(&text);
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
            told: vec![(Paused::No, 0); components],
        })
    }
}

impl Identifier {
    /// A job that is done. Says once if there will be no more.
    fn take(&mut self) -> Option<Job> {
        match self.done.try_recv() {
            Ok(job) => Some(job),
            Err(mpsc::TryRecvError::Empty) => None,
            Err(mpsc::TryRecvError::Disconnected) => {
                if self.jobs.take().is_some() {
                    tracing::error!(
                        "the thread that identifies has panicked: what is in force stays so and nothing is learnt any more; restart the estimator, and report this"
                    );
                }
                None
            }
        }
    }
}

impl Drop for Identifier {
    fn drop(&mut self) {
        self.jobs = None;
        // The job that is done takes the room of the channel: none is waited for longer than one takes.
        let _ = self.thread.take().map(std::thread::JoinHandle::join);
    }
}

/// Opens a service that is not open yet, if it is there.
fn look<T: Topic>(reader: &mut Option<Reader<T>>, domain: &Domain, robot: &str) {
    if reader.is_none() {
        match Reader::open(domain, robot) {
            Ok(opened) => *reader = Some(opened),
            Err(PortError::NotYet { .. }) => {}
            Err(error) => tracing::warn!("{error}; trying again"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_panics_is_told_once_and_asked_for_nothing_more() {
        let (jobs, waiting) = mpsc::sync_channel::<Job>(1);
        let (back, done) = mpsc::sync_channel::<Job>(1);
        let work = move || {
            let _ends = (waiting, back);
            panic!("as a fault in identification would");
        };
        let thread = std::thread::spawn(work);
        let mut identifier = Identifier {
            jobs: Some(jobs),
            done,
            thread: Some(thread),
            told: Vec::new(),
        };
        while !identifier
            .thread
            .as_ref()
            .is_some_and(std::thread::JoinHandle::is_finished)
        {
            std::thread::yield_now();
        }
        assert!(identifier.take().is_none() && identifier.jobs.is_none());
        assert!(identifier.take().is_none());
    }
}
