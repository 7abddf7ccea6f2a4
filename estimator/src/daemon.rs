//! The estimator daemon: one data-plane thread turns samples into estimates, and a control plane
//! supervises it.
//!
//! The data-plane thread waits for samples in shared memory. Once its ports are open it takes no
//! lock, and allocates nothing but the 48 bytes with which iceoryx2 lends each payload. (Ports of a
//! damaged domain are opened anew, which does both.) It retries services that are not there yet, so
//! gateway and estimator can start in any order, and either can be killed and started again.

mod identification;

use self::identification::{IdentificationThread, StateFile};
use crate::check::{Check, Posture};
use crate::config::{Config, InvalidConfig};
use crate::first_look::FirstLook;
use crate::gateway_log::{ChannelStatus, GatewayLog};
use crate::pipeline::Pipeline;
use crate::setup::Setup;
use anyhow::{Context, anyhow};
use proprio_topics::ipc::{
    Domain, DomainConfig, PortError, Reader, Renewal, Renewing, Topic, Watch, Writer, monotonic,
    open_files_remedy,
};
use proprio_topics::{
    ContactDeclaration, ContactEstimate, Description, DriveEstimate, EstimatorHealth,
    GatewayHealth, InertiaEstimate, Nanos, Publisher, Role, Sample, TorqueBudget, TorqueEstimate,
    realtime,
};
use sd_notify::NotifyState;
use std::io::Write as _;
use std::path::Path;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::atomic::{AtomicBool, AtomicI64};
use std::sync::{Arc, mpsc};
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};

/// How often the data plane tries to open services that are not open yet.
const CONNECT_PERIOD: Nanos = Nanos::from_millis(50);
/// How often the health message is published.
const HEALTH_PERIOD: Nanos = Nanos::from_millis(100);
/// How often the budget of a torque is published while somebody reads them, of one joint after
/// another.
const BUDGET_PERIOD: Nanos = Nanos::from_millis(10);
/// A missing temperature is reported after this number of health periods, 10 s: boards send it
/// every few seconds at best.
const MISSING_TEMPERATURE: u32 = 100;
/// A data plane whose loop has not run for this long is stalled.
const STALLED: Nanos = Nanos::from_millis(500);
/// Most samples taken at once: as many as can be queued from all buses (6 MB).
const MOST_TAKEN: usize = <Sample as Topic>::QUALITY.buffer * <Sample as Topic>::QUALITY.publishers;

/// Checks a configuration, and prints what the estimator would read and estimate (`--check`), in
/// the `posture` that is returned for its setup.
///
/// # Errors
/// As for [`run`].
pub fn check(
    config: &Path,
    posture: impl FnOnce(&Setup) -> Result<Posture, String>,
) -> anyhow::Result<Setup> {
    let (_, setup) = Setup::load(config, |_| {})?;
    let file = config.to_owned();
    let invalid = |problem| InvalidConfig {
        file: file.clone(),
        problem,
    };
    let posture = posture(&setup).map_err(invalid)?;
    let checked = Check::of(&setup, &posture).context("the configuration cannot be checked")?;
    // The reader of a pipe may close it early.
    let _ = write!(std::io::stdout(), "{setup}{checked}");
    match checked.problem() {
        Some(problem) => Err(InvalidConfig { file, problem }.into()),
        None => Ok(setup),
    }
}

/// Runs the estimator until SIGTERM or SIGINT.
///
/// # Errors
/// One error chain that states what is wrong, where, and what to do. [`InvalidConfig`] in the chain
/// means a wrong configuration.
pub fn run(config: &Path, domain: &DomainConfig) -> anyhow::Result<()> {
    let (config, setup) = Setup::load(config, |_| {})?;
    let served = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start")
        .and_then(|runtime| runtime.block_on(serve(&config, setup, domain)));
    served.map_err(|error| match open_files_remedy(&format!("{error:#}")) {
        Some(remedy) => error.context(remedy),
        None => error,
    })
}

async fn serve(config: &Config, setup: Setup, domain: &DomainConfig) -> anyhow::Result<()> {
    let mut terminate = signal(SignalKind::terminate()).context("cannot catch SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot catch SIGINT")?;
    let stop = Arc::new(AtomicBool::new(false));
    let last_turn = Arc::new(AtomicI64::new(monotonic().0));
    let (ready, is_ready) = mpsc::channel();
    let (robot, realtime) = (config.robot.clone(), config.realtime);
    let mut domain = Domain::open(domain)?;
    let save_every = Nanos::from_seconds(config.identification.save_every_s);
    let state_file = config.identification.state.clone();
    let state_file = state_file.map(|file| StateFile::new(file, save_every));
    let channels: Arc<[ChannelStatus]> = std::iter::repeat_with(ChannelStatus::default)
        .take(setup.channels().count())
        .collect();
    let mut gateway_log = GatewayLog::new(&setup, &domain.config().name);
    let mut gateway = Watch::<GatewayHealth>::default();
    let renewal = Arc::new(Renewal::default());
    let shared = PlaneStatus {
        last_turn: Arc::clone(&last_turn),
        channels: Arc::clone(&channels),
    };
    let (stop_there, domain_there) = (Arc::clone(&stop), domain.clone());
    let renewing = Renewing::new(Arc::clone(&renewal));
    let thread = std::thread::Builder::new()
        .name("estimate".into())
        .spawn(move || {
            let mut plane =
                match DataPlane::open(domain_there, &robot, setup, state_file, shared, renewing) {
                    Ok(plane) => plane,
                    Err(error) => return drop(ready.send(Err(error))),
                };
            let refused = realtime
                .map(|r| realtime::apply(r.cpu, r.priority))
                .unwrap_or_default();
            let _ = ready.send(Ok(refused));
            plane.run(&stop_there);
        })
        .context("cannot start a thread")?;
    for refusal in is_ready
        .recv()
        .map_err(|_| anyhow!("the data plane ended at once"))??
    {
        tracing::warn!("real-time scheduling not granted: {refusal}");
    }
    tracing::info!(robot = config.robot, "running");
    let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("running")]);
    let watchdog = sd_notify::watchdog_enabled();
    let mut renewal = RenewalLog {
        renewal,
        is_damaged: false,
        has_failed: false,
    };
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
        let now = monotonic();
        if let Some(new) = renewal.renewed(&domain) {
            domain = new;
            gateway = Watch::default();
        }
        gateway_log.tell(gateway.poll(&domain, &config.robot, now), &channels, now);
        if watchdog.is_some() && now - Nanos(last_turn.load(Relaxed)) < STALLED {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
    };
    tracing::info!(why, "stopping");
    let _ = sd_notify::notify(&[NotifyState::Stopping]);
    stop.store(true, Release);
    thread
        .join()
        .map_err(|_| anyhow!("the data plane panicked; this is a bug in the program: report it"))
}

/// Passes a domain that replaces a damaged one to the data plane, and tells of it once.
struct RenewalLog {
    renewal: Arc<Renewal>,
    is_damaged: bool,
    has_failed: bool,
}

impl RenewalLog {
    /// The new domain, if the present one is damaged and could be replaced.
    fn renewed(&mut self, domain: &Domain) -> Option<Domain> {
        let Some(renewed) = domain.renewed() else {
            (self.is_damaged, self.has_failed) = (false, false);
            return None;
        };
        if !std::mem::replace(&mut self.is_damaged, true) {
            tracing::error!("{}", domain.damage());
        }
        match renewed {
            Ok(new) => {
                self.renewal.pass(new.clone());
                Some(new)
            }
            Err(error) => {
                if !std::mem::replace(&mut self.has_failed, true) {
                    tracing::error!("{error}; trying again");
                }
                None
            }
        }
    }
}

/// What data plane and control plane tell each other, without a lock.
struct PlaneStatus {
    /// The time of the last turn of its loop.
    last_turn: Arc<AtomicI64>,
    /// Per channel of the configuration, what has come of it.
    channels: Arc<[ChannelStatus]>,
}

/// The ports of the data plane.
struct EstimatorPorts {
    domain: Domain,
    samples: Option<Reader<Sample>>,
    descriptions: Option<Reader<Description>>,
    declarations: Reader<ContactDeclaration>,
    torques: Writer<TorqueEstimate>,
    contacts: Writer<ContactEstimate>,
    budgets: Writer<TorqueBudget>,
    /// What the drives say of the torques; none if no drive is known.
    drives: Option<Writer<DriveEstimate>>,
    /// The identified parameters; none if identification is off.
    inertias: Option<Writer<InertiaEstimate>>,
    health: Writer<EstimatorHealth>,
    description: Writer<Description>,
}

impl EstimatorPorts {
    fn open(domain: Domain, setup: &Setup, robot: &str, identifies: bool) -> anyhow::Result<Self> {
        let epoch = domain.epoch();
        // The health topic first: it admits one writer, so a second estimator of this robot fails
        // here.
        let health = Writer::create(&domain, robot, epoch)?;
        let mut description = Writer::<Description>::create(&domain, robot, epoch)?;
        description.send(&setup.description(), monotonic())?;
        // Create the service here: then the reader is open before any program declares.
        let creator = Writer::<ContactDeclaration>::create(&domain, robot, epoch)?;
        let declarations = Reader::open(&domain, robot)?;
        drop(creator);
        Ok(Self {
            samples: None,
            descriptions: None,
            declarations,
            torques: Writer::create(&domain, robot, epoch)?,
            contacts: Writer::create(&domain, robot, epoch)?,
            budgets: Writer::create(&domain, robot, epoch)?,
            drives: match setup.drives.is_empty() {
                true => None,
                false => Some(Writer::create(&domain, robot, epoch)?),
            },
            inertias: match identifies {
                true => Some(Writer::create(&domain, robot, epoch)?),
                false => None,
            },
            health,
            description,
            domain,
        })
    }
}

/// What the data-plane thread owns.
struct DataPlane {
    robot: String,
    pipeline: Pipeline,
    ports: EstimatorPorts,
    renewing: Renewing,
    /// Losses and epochs of the readers of domains before.
    lost: u64,
    epochs: u64,
    /// The samples taken at once, to be sorted by stamp; never grows.
    taken: Vec<Sample>,
    unknown_contact_reported: bool,
    refusal_reported: bool,
    /// Consecutive health periods in which a sensor lacked the temperature that its calibration
    /// needs.
    without_temperature: u32,
    /// Per channel number of the gateway, the pipeline's channel.
    channel_of: Vec<Option<usize>>,
    /// The gateway's epoch that `channel_of` belongs to.
    channels_epoch: u64,
    health: EstimatorHealth,
    identification: Option<IdentificationThread>,
    first_look: FirstLook,
    next_connect: Nanos,
    next_health: Nanos,
    /// When the next budget is due, and the joint that it is of.
    next_budget: (Nanos, usize),
    shared: PlaneStatus,
}

impl DataPlane {
    fn open(
        domain: Domain,
        robot: &str,
        setup: Setup,
        state_file: Option<StateFile>,
        shared: PlaneStatus,
        renewing: Renewing,
    ) -> anyhow::Result<Self> {
        let first_look = FirstLook::start(&setup)?;
        let mut pipeline = Pipeline::new(setup);
        let identifies = pipeline.identification().is_some();
        // Before the state: another estimator of this robot may be using its file.
        let ports = EstimatorPorts::open(domain, pipeline.setup(), robot, identifies)?;
        if let Some(state_file) = &state_file {
            state_file.resume(&mut pipeline);
        }
        if let Some(refusal) = pipeline.identification_refused() {
            tracing::warn!("identification.enabled: {refusal}");
        }
        let identification = pipeline
            .identification()
            .map(|online| IdentificationThread::start(online, &pipeline.setup().robot, state_file))
            .transpose()?;
        Ok(Self {
            robot: robot.to_owned(),
            pipeline,
            ports,
            renewing,
            lost: 0,
            epochs: 0,
            identification,
            first_look,
            taken: Vec::with_capacity(MOST_TAKEN),
            unknown_contact_reported: false,
            refusal_reported: false,
            without_temperature: 0,
            channel_of: Vec::with_capacity(proprio_topics::MAX_CHANNELS),
            channels_epoch: 0,
            health: EstimatorHealth {
                started: monotonic(),
                ..EstimatorHealth::default()
            },
            next_connect: Nanos::ZERO,
            next_health: Nanos::ZERO,
            next_budget: (Nanos::ZERO, 0),
            shared,
        })
    }

    /// Opens all ports anew if a domain was passed. What was identified stays.
    fn renew(&mut self, now: Nanos) {
        let (setup, robot) = (self.pipeline.setup(), &self.robot);
        let identifies = self.ports.inertias.is_some();
        let open = |domain: &Domain| EstimatorPorts::open(domain.clone(), setup, robot, identifies);
        match self.renewing.ports(now, open) {
            Some(Ok(ports)) => {
                if let Some(samples) = &self.ports.samples {
                    self.lost += samples.lost();
                    self.epochs += samples.epochs();
                }
                self.ports = ports;
            }
            Some(Err(error)) => {
                tracing::error!("estimates cannot be published: {error:#}; trying again");
            }
            None => {}
        }
    }

    fn run(&mut self, stop: &AtomicBool) {
        while !stop.load(Acquire) {
            let now = monotonic();
            self.shared.last_turn.store(now.0, Relaxed);
            self.health.last_turn = now;
            self.renew(now);
            if now >= self.next_connect {
                self.next_connect = now + CONNECT_PERIOD;
                connect(&mut self.ports.samples, &self.ports.domain, &self.robot);
                connect(
                    &mut self.ports.descriptions,
                    &self.ports.domain,
                    &self.robot,
                );
            }
            self.take_declarations(now);
            if let Some(job) = self
                .identification
                .as_mut()
                .and_then(IdentificationThread::finished_job)
            {
                self.pipeline.give_back(job);
            }
            let idle = !self.take_samples(now);
            if now >= self.next_health {
                self.next_health = now + HEALTH_PERIOD;
                self.publish_health(now);
            }
            if idle {
                self.wait();
            }
        }
        self.publish_health(monotonic());
        if self.identification.is_some() {
            tracing::info!(
                "observations of identification: {}",
                self.health.identification
            );
        }
    }

    /// Waits until the gateway publishes a sample, or something else is to be done.
    fn wait(&self) {
        let is_connected = self.ports.samples.is_some() && self.ports.descriptions.is_some();
        let until = match is_connected {
            true => self.next_health,
            false => self.next_health.min(self.next_connect),
        };
        match &self.ports.samples {
            Some(samples) => {
                samples.wait(until);
            }
            None => {
                let left = until.saturating_sub(monotonic()).0;
                std::thread::sleep(Duration::from_nanos(u64::try_from(left).unwrap_or(0)));
            }
        }
    }

    /// Takes all waiting samples and publishes the estimates that they complete. False if there
    /// were none.
    fn take_samples(&mut self, now: Nanos) -> bool {
        // Shared memory delivers all samples of one bus before those of the next. After a stall the
        // first bus would run ahead by more than an estimate waits, and the samples of the others
        // would be late. So sort by stamp first.
        self.taken.clear();
        while self.taken.len() < MOST_TAKEN
            && let Some(taken) = self.ports.samples.as_mut().map(Reader::try_take)
        {
            match taken {
                Ok(Some(sample)) => self.taken.push(sample),
                Ok(None) => break,
                Err(error) => {
                    // The reader tries again; once is enough in the log.
                    if !std::mem::replace(&mut self.refusal_reported, true) {
                        tracing::warn!("no samples of a bus of the gateway: {error}; trying again");
                    }
                    break;
                }
            }
        }
        self.taken
            .sort_unstable_by_key(|s| (s.header.acquired, s.header.bus, s.header.sequence));
        self.health.samples += self.taken.len() as u64;
        for at in 0..self.taken.len() {
            let Some(sample) = self.taken.get(at).copied() else {
                break;
            };
            self.take_sample(now, &sample);
            // Samples of one stamp arrived together: an immediate estimate uses them all.
            let next = self.taken.get(at + 1).map(|next| next.header.acquired);
            if next != Some(sample.header.acquired) {
                self.publish_estimates();
            }
        }
        !self.taken.is_empty()
    }

    /// Passes a sample to the pipeline, if its channel is one of the configuration's.
    fn take_sample(&mut self, now: Nanos, sample: &Sample) {
        if sample.header.epoch != self.channels_epoch {
            self.take_descriptions();
        }
        if sample.header.epoch != self.channels_epoch {
            self.health.unknown_channel += 1;
            return;
        }
        // A channel that the configuration does not name is ignored: the gateway may serve other
        // programs.
        let channel = self
            .channel_of
            .get(sample.channel as usize)
            .copied()
            .flatten();
        let (Some(channel), Some(reading)) = (channel, sample.reading()) else {
            return;
        };
        let (t, quality) = (sample.header.acquired, sample.header.quality);
        self.first_look.see(now, channel, t, &reading, quality);
        self.pipeline.push(channel, t, &reading, quality);
    }

    /// Publishes the estimates that are due.
    fn publish_estimates(&mut self) {
        while let Some(estimate) = self.pipeline.poll() {
            let now = monotonic();
            let sent = self.ports.torques.send(&estimate.torques, now).is_ok()
                & self.ports.contacts.send(&estimate.contacts, now).is_ok();
            self.health.estimates += 1;
            self.health.publish_failures += u64::from(!sent);
            self.health.withheld +=
                u64::from(estimate.torques.joints().iter().any(|j| j.valid != 1));
            self.health.last_estimate = estimate.t;
            if let Some(inertias) = &mut self.ports.inertias
                && let Some(inertia) = self.pipeline.inertia()
            {
                self.health.publish_failures += u64::from(inertias.send(inertia, now).is_err());
            }
            if let Some(jobs) = self
                .identification
                .as_ref()
                .and_then(|identification| identification.jobs.as_ref())
                && let Some(job) = self.pipeline.take_job()
            {
                // There is one job, so the queue has room. If the thread has ended, the error is
                // reported elsewhere.
                let _ = jobs.try_send(job);
            }
            if let (Some(writer), Some(drives)) = (&mut self.ports.drives, self.pipeline.drives()) {
                self.health.publish_failures += u64::from(writer.send(drives, now).is_err());
            }
            self.publish_budget(now);
        }
    }

    /// Publishes the budget of the next joint of the last estimate, if it is due and anybody reads
    /// it.
    fn publish_budget(&mut self, now: Nanos) {
        let (due, joint) = self.next_budget;
        if now < due {
            return;
        }
        self.next_budget = (now + BUDGET_PERIOD, joint);
        if self.ports.budgets.readers() == 0 {
            return;
        }
        match self.pipeline.budget(joint) {
            Some(budget) => {
                let sent = self.ports.budgets.send(budget, now);
                self.health.publish_failures += u64::from(sent.is_err());
                self.next_budget.1 = joint + 1;
            }
            None => self.next_budget.1 = 0,
        }
    }

    /// Maps the channel numbers of the gateway's description to the pipeline's channels.
    fn take_descriptions(&mut self) {
        while let Some(Ok(Some(description))) =
            self.ports.descriptions.as_mut().map(Reader::try_take)
        {
            if description.publisher != Publisher::Gateway {
                continue;
            }
            self.channel_of.clear();
            for number in 0..proprio_topics::MAX_CHANNELS {
                let entry = u32::try_from(number)
                    .ok()
                    .and_then(|n| description.find(Role::Channel, n));
                let setup = self.pipeline.setup();
                self.channel_of
                    .push(entry.and_then(|e| setup.channel(e.kind.get()?, e.name.as_str())));
            }
            self.channels_epoch = description.header.epoch;
            for (number, channel) in self.shared.channels.iter().enumerate() {
                channel.set_described(self.channel_of.contains(&Some(number)));
            }
        }
    }

    fn take_declarations(&mut self, now: Nanos) {
        while let Ok(Some(declared)) = self.ports.declarations.try_take() {
            match self
                .pipeline
                .setup()
                .robot
                .contact(declared.contact.as_str())
            {
                Some(contact) => {
                    let (t, state) = (declared.header.acquired, declared.state());
                    self.first_look.declare(now, contact, t, state.active);
                    self.pipeline.declare(contact, t, &state);
                }
                // Report once: a program may repeat a misspelt name a thousand times a second.
                None if !self.unknown_contact_reported => {
                    self.unknown_contact_reported = true;
                    tracing::warn!(
                        contact = declared.contact.as_str(),
                        "a contact was declared that is not in estimator.toml; check its name"
                    );
                }
                None => {}
            }
        }
    }

    /// Reports once that a sensor's temperature is missing, and once that all are there again.
    fn report_temperatures(&mut self) {
        if self.pipeline.without_temperature().next().is_none() {
            if std::mem::replace(&mut self.without_temperature, 0) >= MISSING_TEMPERATURE {
                tracing::info!("all temperatures that the calibrations need are received again");
            }
            return;
        }
        self.without_temperature = self.without_temperature.saturating_add(1);
        if self.without_temperature == MISSING_TEMPERATURE {
            for sensor in self.pipeline.without_temperature() {
                tracing::warn!(
                    sensor,
                    "the calibration needs the temperature of the sensor's board, but none was \
                     received in the last minute: torques that depend on this sensor are less \
                     certain; let the board send its temperature"
                );
            }
        }
    }

    fn publish_health(&mut self, now: Nanos) {
        self.report_temperatures();
        for (number, channel) in self.shared.channels.iter().enumerate() {
            let newest = self.first_look.newest(number);
            if let Some(t) = newest.or_else(|| self.pipeline.newest(number)) {
                channel.set_newest(t);
            }
        }
        let counts = self.pipeline.counts();
        (
            self.health.late,
            self.health.backward,
            self.health.not_finite,
        ) = (counts.late, counts.backward, counts.not_finite);
        self.health.lost = self.lost + self.ports.samples.as_ref().map_or(0, Reader::lost);
        self.health.epochs = self.epochs + self.ports.samples.as_ref().map_or(0, Reader::epochs);
        if let (Some(thread), Some(online)) =
            (&mut self.identification, self.pipeline.identification())
        {
            self.health.identification = thread.health(online, &self.pipeline.setup().robot);
        }
        // A failed send is not repeated: the next health message follows soon.
        let _ = self.ports.health.send(&self.health, now);
        let _ = self.ports.description.update_connections();
        let _ = self.ports.inertias.as_mut().map(Writer::update_connections);
    }
}

/// Opens a service that is not open yet, if it exists.
fn connect<T: Topic>(reader: &mut Option<Reader<T>>, domain: &Domain, robot: &str) {
    if reader.is_none() {
        match Reader::open(domain, robot) {
            Ok(opened) => *reader = Some(opened),
            Err(PortError::NotYet { .. }) => {}
            Err(error) => tracing::warn!("{error}; trying again"),
        }
    }
}
