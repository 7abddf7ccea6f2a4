//! The devices on a bus, of all that its drivers recognise. Where the devices of two findings would
//! read the same frames, the one with more evidence is the device, and the other is kept as its
//! rival.

use proprio_drivers::{Claim, Finding, Id, Mode, Options, Outputs, Spec, Traffic, recognise};
use proprio_topics::Nanos;

/// A device on a bus.
#[derive(Debug, Clone)]
pub struct FoundDevice {
    /// Its name in the configuration: driver and address, after a prefix.
    pub name: String,
    /// What speaks for it.
    pub finding: Finding,
    /// Other devices that the same frames might come from, with less evidence.
    pub rivals: Vec<Finding>,
    /// The identifiers that it reads.
    pub(super) claims: Vec<Claim>,
}

impl FoundDevice {
    /// Whether the frames of `id` are explained by it.
    #[must_use]
    pub fn explains(&self, id: Id) -> bool {
        let claimed = self.claims.iter().any(|claim| claim.matches(id));
        claimed || self.finding.has(id)
    }
}

/// The driver and its keys, for the device of `finding`; placeholders stand for what a person has
/// to fill in.
fn options(finding: &Finding) -> Result<(Options, Spec), String> {
    let keys: String = (finding.keys.iter())
        .map(|key| format!("{} = {}\n", key.name, key.value))
        .collect();
    let table: toml::Table = keys.parse().map_err(|e: toml::de::Error| e.to_string())?;
    let options = Options::deserialize(finding.driver, table);
    let spec = Spec {
        address: finding.address,
        max_silence: Nanos::from_millis(100),
        mode: Mode::Listen,
        outputs: Outputs(finding.joints.iter().copied().take(16).collect()),
    };
    Ok((options.map_err(|e| format!("{e:?}"))?, spec))
}

/// The identifiers that the device of `finding` reads.
fn claims(finding: &Finding) -> Result<Vec<Claim>, String> {
    let (options, spec) = options(finding)?;
    let device = options.device(&spec).map_err(|e| e.to_string())?;
    Ok(device.claims().to_vec())
}

/// The first of `own` claims that another device's claims contest.
pub(crate) fn contested<'c>(own: &'c [Claim], others: &[Claim]) -> Option<&'c Claim> {
    let contests = |a: &Claim, b: &Claim| a.overlaps(b) && (a.exclusive || b.exclusive);
    own.iter().find(|a| others.iter().any(|b| contests(a, b)))
}

/// The devices on the bus of `heard`, the surest first. `prefix` begins their names.
#[must_use]
pub fn devices(heard: &Traffic, prefix: &str) -> Vec<FoundDevice> {
    let mut devices: Vec<FoundDevice> = Vec::new();
    for finding in recognise(heard) {
        let claims = match (finding.unusable, claims(&finding)) {
            ("", Ok(claims)) => claims,
            ("", Err(problem)) => {
                tracing::warn!(driver = finding.driver, "a finding is not legal: {problem}");
                continue;
            }
            _ => Vec::new(),
        };
        // As the plan refuses it: one identifier, two readers.
        let rivals = |device: &FoundDevice| contested(&claims, &device.claims).is_some();
        if let Some(better) = devices.iter_mut().find(|device| rivals(device)) {
            better.rivals.push(finding);
            continue;
        }
        let base = format!("{prefix}{}_{}", finding.driver, finding.address);
        let is_free = |name: &String| devices.iter().all(|device| device.name != *name);
        let more = (2..).map(|number| format!("{base}_{number}"));
        let name = std::iter::once(base.clone()).chain(more).find(is_free);
        devices.push(FoundDevice {
            name: name.unwrap_or(base),
            finding,
            rivals: Vec::new(),
            claims,
        });
    }
    // Of those that are equally sure, as a person counts them.
    devices.sort_by(|a, b| {
        let order = |device: &FoundDevice| (device.finding.driver, device.finding.address);
        let by_certainty = b.finding.certainty().cmp(&a.finding.certainty());
        by_certainty.then(order(a).cmp(&order(b)))
    });
    devices
}
