//! What is known of a robot at an instant, from the payloads that were heard until then.

use proprio_topics::ipc::Presence;
use proprio_topics::{
    ContactEstimate, Counter, Description, EstimatorHealth, GatewayHealth, Header, InertiaEstimate,
    MAX_CHANNELS, Nanos, Publisher, Quality, Sample, TorqueEstimate,
};
use std::sync::Arc;

/// Over how long rates are counted.
const WINDOW: Nanos = Nanos::from_millis(1000);
/// What the scale of a bar keeps from one estimate to the next, so that one peak is forgotten.
const FADE: f64 = 0.999;

/// What a channel sent.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct ChannelRate {
    /// When the last sample was acquired.
    pub(super) last: Option<Nanos>,
    /// Samples per second, in the last complete window; and the flags of all of them.
    pub(super) rate: f64,
    pub(super) quality: Option<Quality>,
    /// The same, so far, of the window that is not complete.
    count: u64,
    flags: Quality,
}

/// What is known of a robot.
#[derive(Debug, Clone, Default)]
pub(super) struct RobotState {
    /// When.
    pub(super) now: Nanos,
    /// All robots of the domain.
    pub(super) robots: Vec<String>,
    /// The one that this is about.
    pub(super) robot: Option<String>,
    /// What is waited for, or what is wrong; empty if nothing is.
    pub(super) trouble: String,
    /// Whether the daemons are there, and what they said last.
    pub(super) gateway: (Presence, Option<Arc<GatewayHealth>>),
    pub(super) estimator: (Presence, Option<Arc<EstimatorHealth>>),
    /// Their names for all numbers.
    pub(super) channel_names: Option<Arc<Description>>,
    pub(super) names: Option<Arc<Description>>,
    /// The channels, by their numbers.
    pub(super) channels: Vec<ChannelRate>,
    /// Readings per second of each device.
    pub(super) readings: Vec<f64>,
    /// Estimates per second.
    pub(super) estimates: f64,
    torques: Option<Arc<TorqueEstimate>>,
    contacts: Option<Arc<ContactEstimate>>,
    inertia: Option<Arc<InertiaEstimate>>,
    /// For each joint, what its bar shows at most.
    pub(super) scales: Vec<f64>,
    /// The beginning of the window, and what the daemons said then.
    began: Nanos,
    before: (Option<Arc<GatewayHealth>>, Option<Arc<EstimatorHealth>>),
}

/// The increase per second of a counter; 0 if its publisher was started meanwhile.
fn rate((a, before): (&Header, u64), (b, after): (&Header, u64)) -> f64 {
    let seconds = b.published.saturating_sub(a.published).seconds();
    match a.epoch == b.epoch && seconds > 0.0 {
        true => after.saturating_sub(before) as f64 / seconds,
        false => 0.0,
    }
}

impl RobotState {
    /// Names of a gateway or an estimator. After a restart they may be others: what was said with
    /// the old ones is forgotten.
    pub(super) fn describe(&mut self, names: Description) {
        let place = match names.publisher.get() {
            Some(Publisher::Gateway) => &mut self.channel_names,
            Some(Publisher::Estimator) => &mut self.names,
            None => return,
        };
        if (place.as_ref()).is_some_and(|old| old.header.epoch == names.header.epoch) {
            return;
        }
        *place = Some(Arc::new(names));
        match names.publisher == Publisher::Gateway {
            true => self.channels = vec![ChannelRate::default(); MAX_CHANNELS],
            false => self.scales.clear(),
        }
    }

    pub(super) fn sample(&mut self, sample: &Sample) {
        let is_named = |names: &Arc<Description>| names.header.epoch == sample.header.epoch;
        if !self.channel_names.as_ref().is_some_and(is_named) {
            return;
        }
        if let Some(channel) = self.channels.get_mut(sample.channel as usize) {
            channel.count += 1;
            channel.flags |= sample.header.quality;
            channel.last = channel.last.max(Some(sample.header.acquired));
        }
    }

    pub(super) fn hear_torques(&mut self, torques: TorqueEstimate) {
        self.scales.resize(torques.joints().len(), 0.0);
        for (scale, joint) in self.scales.iter_mut().zip(torques.joints()) {
            // NaN, of what is withheld, changes nothing.
            *scale = (*scale * FADE).max(joint.torque.abs() + 2.0 * joint.standard_deviation);
        }
        self.torques = Some(Arc::new(torques));
    }

    pub(super) fn hear_contacts(&mut self, contacts: ContactEstimate) {
        self.contacts = Some(Arc::new(contacts));
    }

    pub(super) fn hear_inertia(&mut self, inertia: InertiaEstimate) {
        self.inertia = Some(Arc::new(inertia));
    }

    /// What is heard after `now` is later; rates are counted to here.
    pub(super) fn tick(&mut self, now: Nanos) {
        self.now = now;
        if self.began == Nanos::ZERO {
            self.began = now;
        }
        let window = now.saturating_sub(self.began);
        if window < WINDOW {
            return;
        }
        for channel in &mut self.channels {
            channel.rate = channel.count as f64 / window.seconds();
            channel.quality = (channel.count > 0).then_some(channel.flags);
            (channel.count, channel.flags) = (0, Quality::GOOD);
        }
        if let (Some(a), Some(b)) = (&self.before.0, &self.gateway.1) {
            let pairs = a.devices().iter().zip(b.devices());
            let rates = pairs.map(|(before, after)| {
                let [before, after] =
                    [before, after].map(|it| it.counters[Counter::Readings as usize]);
                rate((&a.header, before), (&b.header, after))
            });
            self.readings = rates.collect();
        }
        if let (Some(a), Some(b)) = (&self.before.1, &self.estimator.1) {
            self.estimates = rate((&a.header, a.estimates), (&b.header, b.estimates));
        }
        self.before = (self.gateway.1.clone(), self.estimator.1.clone());
        self.began = now;
    }

    /// The newest torques, with the names of the estimator that sent them.
    pub(super) fn torques(&self) -> Option<(&TorqueEstimate, &Description)> {
        let (torques, names) = (self.torques.as_deref()?, self.names.as_deref()?);
        (torques.header.epoch == names.header.epoch).then_some((torques, names))
    }

    /// The newest contacts, likewise.
    pub(super) fn contacts(&self) -> Option<(&ContactEstimate, &Description)> {
        let (contacts, names) = (self.contacts.as_deref()?, self.names.as_deref()?);
        (contacts.header.epoch == names.header.epoch).then_some((contacts, names))
    }

    /// What was identified last, by the estimator that runs.
    pub(super) fn inertia(&self) -> Option<&InertiaEstimate> {
        let (inertia, names) = (self.inertia.as_deref()?, self.names.as_deref()?);
        (inertia.header.epoch == names.header.epoch).then_some(inertia)
    }
}
