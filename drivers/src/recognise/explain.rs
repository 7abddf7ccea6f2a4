//! Which devices explain a bus best, together.
//!
//! The device with the highest probability is taken first; its frames are explained then, and
//! count against every other that needs them: each by four bits, as if it were one of sixteen
//! buses on which two devices send on one identifier. The frames that remain are fewer, so an
//! identifier among them counts more.

use super::background::{NEAR, common, identifier};
use super::traffic::Traffic;
use super::{Certainty, Explained, Finding, IdUse, PRIOR, probability};
use crate::Id;
use alloc::collections::{BTreeMap, BTreeSet};
use alloc::vec::Vec;

/// What two senders on one identifier count.
const CONTESTED: f64 = 4.0;
/// Where one of a family is sure, another has an even chance to be there: at which address is
/// still open.
const FAMILY: f64 = PRIOR - 1.0;

/// Whether both cannot be true: each has frames of one identifier for itself.
fn contests(a: &Finding, b: &Finding, of: &Explained) -> bool {
    b.explains.iter().any(|other| {
        let shared = match (of.part, other.part) {
            (_, IdUse::Takes) | (IdUse::Takes, IdUse::Tells) => true,
            (IdUse::Takes, IdUse::Sends(_)) => false,
            (IdUse::Tells, IdUse::Tells) => a.address == b.address,
            (IdUse::Sends(Some(one)), IdUse::Sends(Some(another))) => {
                a.driver == b.driver && one != another
            }
            (IdUse::Tells | IdUse::Sends(_), _) => false,
        };
        other.id == of.id && !shared
    })
}

/// The count of the identifiers of 11 or 29 bits, as `id` has them.
const fn of_format(counts: &mut [usize; 2], id: Id) -> &mut usize {
    let [standard, extended] = counts;
    match id {
        Id::Standard(_) => standard,
        Id::Extended(_) => extended,
    }
}

/// A finding that is not yet judged.
struct OpenFinding {
    finding: Finding,
    /// The probability that nothing before it is there that contests it.
    free: f64,
    /// The streams that nobody of its family explains, with 11 and 29 bits.
    others: [usize; 2],
    /// The family's identifiers.
    family: BTreeSet<Id>,
}

impl OpenFinding {
    /// How many streams that nobody of its family explains are near `id`.
    fn near(&self, seen: &Traffic, id: Id) -> usize {
        let same = |raw: u32| match id {
            Id::Standard(_) => u16::try_from(raw.min(0x7FF)).map_or(id, Id::standard),
            Id::Extended(_) => Id::extended(raw.min(0x1FFF_FFFF)),
        };
        let range = same(id.raw().saturating_sub(NEAR))..=same(id.raw() + NEAR);
        let near = seen.between(range).filter(|other| *other != id);
        near.filter(|other| !self.family.contains(other)).count()
    }

    /// The bits for it, where `sure` are there: also those that contest it, or (`alone`) not they.
    fn bits(&self, seen: &Traffic, sure: &[Finding], alone: bool) -> f64 {
        let finding = &self.finding;
        let mut bits = finding.bits;
        let is_one = |known: &&Finding| known.certainty() >= Some(Certainty::Likely);
        if (sure.iter().filter(is_one)).any(|known| known.driver == finding.driver) {
            bits += FAMILY;
        }
        let mut before: Vec<Id> = Vec::new();
        for explained in &finding.explains {
            let part = explained.part;
            if part == IdUse::Takes {
                continue;
            }
            if !alone && sure.iter().any(|known| contests(finding, known, explained)) {
                bits -= CONTESTED;
                continue;
            }
            let mut alike: Vec<u32> = (explained.alike.iter())
                .filter(|id| !self.family.contains(id))
                .filter(|id| {
                    matches!(id, Id::Standard(_)) == matches!(explained.id, Id::Standard(_))
                })
                .map(|id| id.raw())
                .collect();
            alike.sort_unstable();
            let near = self.near(seen, explained.id);
            let mut others = self.others;
            let others = *of_format(&mut others, explained.id);
            let is_next = before.iter().any(|id| seen.are_in_a_row(*id, explained.id));
            bits += common(explained.bits, others, alike.len());
            bits += identifier(explained.id, others, &alike, near, is_next);
            before.push(explained.id);
        }
        bits
    }

    /// The bits for it, where `sure` are there: as far as nothing that contests it is there.
    fn odds(&self, seen: &Traffic, sure: &[Finding]) -> f64 {
        let alone = self.bits(seen, sure, true);
        let taken = 1.0 - self.free;
        if taken <= 0.0 {
            return alone;
        }
        // What contests it is not there, or it is there all the same.
        let beside = self.bits(seen, sure, false);
        let yes = self.free * probability(alone) + taken * probability(beside);
        let no = self.free * probability(-alone) + taken * probability(-beside);
        libm::log2(yes / no)
    }
}

/// `findings`, none of them judged.
fn unjudged(seen: &Traffic, findings: Vec<Finding>) -> Vec<OpenFinding> {
    let mut families: BTreeMap<&str, BTreeSet<Id>> = BTreeMap::new();
    for finding in &findings {
        let family = families.entry(finding.driver).or_default();
        family.extend(finding.explains.iter().map(|explained| explained.id));
    }
    let open = findings.into_iter().map(|finding| {
        let family = families.get(finding.driver).cloned().unwrap_or_default();
        let mut others = [0; 2];
        for stream in seen.streams().filter(|stream| !family.contains(&stream.id)) {
            *of_format(&mut others, stream.id) += 1;
        }
        OpenFinding {
            finding,
            free: 1.0,
            others,
            family,
        }
    });
    open.collect()
}

/// `findings` with the odds that each has beside the others, the surest first. In: what speaks for
/// each but for its identifiers.
pub(crate) fn explain(seen: &Traffic, findings: Vec<Finding>) -> Vec<Finding> {
    let mut open = unjudged(seen, findings);
    let mut sure: Vec<Finding> = Vec::new();
    loop {
        let odds = |one: &OpenFinding| one.odds(seen, &sure);
        let all: Vec<f64> = open.iter().map(odds).collect();
        let best = (all.iter().enumerate()).max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(&a.0)));
        let Some((place, bits)) = best.map(|(place, bits)| (place, *bits)) else {
            return sure;
        };
        if bits < Certainty::POSSIBLE {
            open.iter_mut()
                .zip(all)
                .for_each(|(one, bits)| one.finding.bits = bits);
            open.sort_by(|a, b| b.finding.bits.total_cmp(&a.finding.bits));
            sure.extend(open.into_iter().map(|one| one.finding));
            return sure;
        }
        let mut best = open.remove(place).finding;
        let contested = |one: &OpenFinding| {
            best.explains
                .iter()
                .any(|e| contests(&best, &one.finding, e))
        };
        // The others that would explain the same frames, too, are there instead of it.
        let rivals: Vec<usize> = (0..open.len())
            .filter(|k| open.get(*k).is_some_and(&contested))
            .collect();
        let instead: f64 = (rivals.iter().filter_map(|k| open.get(*k)))
            .map(|rival| libm::exp2(rival.bits(seen, &sure, true).min(500.0)) * rival.free)
            .sum();
        let bits = bits.min(500.0) - libm::log2(1.0 + instead);
        for rival in rivals {
            if let Some(rival) = open.get_mut(rival) {
                rival.free *= probability(-bits);
            }
        }
        if bits >= Certainty::LIKELY {
            for one in &mut open {
                let ids = best.explains.iter().map(|explained| explained.id);
                for id in ids.filter(|id| one.family.insert(*id)) {
                    let count = of_format(&mut one.others, id);
                    *count = count.saturating_sub(1);
                }
            }
        }
        best.bits = bits;
        sure.push(best);
    }
}
