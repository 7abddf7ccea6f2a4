//! How much of the change from CAD is kept: as much as predicts data held out better than CAD does.
//!
//! The training logs are cut into folds that differ in motion: blocks of a second, in the order of
//! their posture along the direction in which postures differ most (where the robot repeats one
//! posture, in time). Each fold is predicted with parameters from all others, by the yardstick by which
//! parameters are judged ([`super::yardstick`]).
//!
//! Of a group of links that no measured channel tells apart, the gain over CAD is the sum of `e0^2 - e^2`
//! over its channels, `e0` being CAD's error: a parabola in the share that is kept. Kept is the greatest
//! of 1, 0.9, ... 0.1 whose gain is within a standard error of the best share's, if it is more than a
//! standard error itself; else nothing. The standard error is that from blocks or that from folds,
//! whichever is greater: what is wrong in one posture is wrong there all the time.

use super::batch::{IdentifyError, LEAST_FOLD, added, beside_cad, over, posterior, without_negative_rotors};
use super::information::Information;
use super::outcome::{Finding, Severity};
use super::passes::{NoiseModel, Piece, Residuals, Walks, leave, noise_of, tell_with};
use super::prior::Prior;
use super::rows::{Groups, RowMaker};
use super::yardstick::{self, Candidate, Errors, Free, Yardstick};
use super::{assess, parallel};
use nalgebra::{DMatrix, DVector};
use proprio_topics::Nanos;
use std::ops::Range;

/// Folds, at the most; each has [`LEAST_FOLD`] instants at least.
const FOLDS: usize = 5;

/// Length of a block \[s\].
const BLOCK: f64 = 1.0;

/// What held-out data say of the change from CAD.
pub(super) struct Guard {
    /// What is kept, per link of the layout, then per further unknown.
    pub share: Vec<f64>,
    pub findings: Vec<Finding>,
    /// How well held-out data are predicted with what is kept.
    pub held: Held,
    blocks: Vec<Block>,
    /// Per fold, the parameters by all others.
    sets: Vec<DVector<f64>>,
}

impl Guard {
    /// Noise of the same pieces, corrected by what held-out data show of it.
    pub(super) fn noise(
        &self,
        maker: &RowMaker<'_>,
        pieces: &[Piece<'_>],
        noise: NoiseModel,
        walks: &Walks,
    ) -> NoiseModel {
        if self.sets.is_empty() {
            return noise;
        }
        let left: Vec<Residuals> = over(maker, pieces, |maker, number, piece| {
            let own = self.blocks.iter().filter(|block| block.piece == number);
            each_from_its_fold(leave(maker, piece, &noise, &self.sets), own)
        });
        noise.midway(&noise_of(maker.layout(), &left, 0, walks, &noise.least))
    }
}

/// Errors of held-out data.
#[derive(Clone, Debug, Default)]
pub(super) struct Held {
    /// Per block, its fold.
    folds: Vec<usize>,
    /// Per channel and block, the sum of squares, and of how many instants \[Nm^2\].
    squares: Vec<Vec<(f64, usize)>>,
    /// Per F/T sensor, the sum of squares of its readings, less their means \[Nm^2\].
    loads: Vec<f64>,
    /// ... and of its stated noise.
    noises: Vec<f64>,
}

impl Held {
    /// By how much the squares are less than others of the same blocks, and the standard error of that.
    /// Where something was left out in one of the two, nothing is compared.
    pub(super) fn gain_over(&self, other: &Self) -> (f64, f64) {
        let of_block = |block: usize| -> f64 {
            let pairs = self
                .squares
                .iter()
                .zip(&other.squares)
                .map(|(own, other)| (own[block], other[block]));
            let same = pairs.filter(|((_, count), (_, others))| count == others);
            same.map(|((own, _), (other, _))| other - own).sum()
        };
        total(&(0..self.folds.len()).map(of_block).collect::<Vec<f64>>(), &self.folds)
    }

    /// The RMS error, relative to that of others.
    pub(super) fn relative_to(&self, other: &Self) -> f64 {
        (sum(&self.squares) / sum(&other.squares)).sqrt()
    }

    /// Per F/T sensor, the mean square of its error beyond its stated noise, relative to that of what it
    /// reads.
    pub(super) fn relative_squares(&self) -> Vec<f64> {
        let errors = self.squares.chunks(6).map(sum);
        let sizes = self.loads.iter().zip(&self.noises);
        errors
            .zip(sizes)
            .map(|(error, (load, noise))| (error - noise) / load)
            .collect()
    }
}

fn sum(squares: &[Vec<(f64, usize)>]) -> f64 {
    squares.iter().flatten().map(|(square, _)| square).sum()
}

/// Some instants of a piece that follow each other, and the fold that they belong to.
struct Block {
    piece: usize,
    range: Range<usize>,
    fold: usize,
}

/// Holds out fold after fold of these pieces of the training logs.
///
/// # Errors
/// As for [`posterior`].
pub(super) fn held_out(
    maker: &RowMaker<'_>,
    prior: &Prior,
    pieces: &[Piece<'_>],
    noise: &NoiseModel,
    tau: f64,
) -> Result<Guard, IdentifyError> {
    let layout = maker.layout();
    let total: usize = pieces.iter().map(|piece| piece.instants.len()).sum();
    let count = (total / LEAST_FOLD).min(FOLDS);
    if count < 2 {
        return Ok(Guard {
            share: vec![0.0; layout.links.len() + layout.further.len()],
            findings: vec![not_checked()],
            held: Held::default(),
            blocks: Vec::new(),
            sets: Vec::new(),
        });
    }
    let blocks = blocks(pieces, count);
    let told = parallel::map_with(
        count * pieces.len(),
        || maker.clone(),
        |maker, number| {
            let (fold, piece) = (number / pieces.len(), number % pieces.len());
            let mut held = vec![false; pieces[piece].instants.len()];
            for block in blocks.iter().filter(|b| b.fold == fold && b.piece == piece) {
                held[block.range.clone()].fill(true);
            }
            tell_with(maker, pieces[piece], noise, &held, 0, &mut |_, _, _, _| ())
        },
    );
    let mut sets: Vec<DVector<f64>> = Vec::new();
    let mut candidates: Vec<Candidate> = Vec::new();
    // Of each fold, CAD and what the others say.
    let mut pairs: Vec<[usize; 2]> = Vec::new();
    let cad_is_one = layout.beside_cad().is_empty() && layout.joints.is_empty();
    for (fold, told) in told.chunks(pieces.len()).enumerate() {
        let others: Information = added(told, layout.unknowns());
        let own = posterior(prior, layout, &others)?.fit(tau)?;
        // As they are given out.
        let own = without_negative_rotors(prior, layout, &others, &own)?;
        let both = [beside_cad(layout, &others), own];
        let of_others = blocks.iter().filter(|block| block.fold != fold);
        let instants = of_others.flat_map(|block| &pieces[block.piece].instants[block.range.clone()]);
        let friction = yardstick::friction(maker, instants, &both);
        let both_judged = both.iter().zip(friction).map(|(d, friction)| Candidate {
            course: vec![(Nanos::ZERO, d.clone())],
            friction,
        });
        let knows_cad = cad_is_one && fold > 0;
        candidates.extend(both_judged.skip(usize::from(knows_cad)));
        let last = candidates.len() - 1;
        pairs.push([if knows_cad { 0 } else { last - 1 }, last]);
        sets.push(both.into_iter().nth(1).unwrap_or_default());
    }
    let mut loads = vec![0.0; layout.sensors.len()];
    let mut noises = loads.clone();
    let mut errors: Vec<Vec<Errors>> = Vec::new();
    for piece in pieces {
        let yardstick = Yardstick::of_fit(maker, piece.instants);
        let own = yardstick.errors(layout, &candidates, Free::Constants);
        for (channel, stated) in layout.stated(maker.setup()).enumerate() {
            let read = yardstick.load(channel, &own[0]);
            let scale = layout.scale(channel).powi(2);
            loads[channel / 6] += scale * read.iter().map(|x| x * x).sum::<f64>();
            noises[channel / 6] += scale * read.len() as f64 * stated * stated;
        }
        errors.push(own);
    }
    // Per channel and block: sums of e0 (e0 - e1), (e0 - e1)^2 and e0^2.
    let sums: Vec<Vec<Sums>> = (0..layout.channels())
        .map(|channel| {
            let of_block = |block: &Block| {
                let of = |set: usize| {
                    let of_candidate = &errors[block.piece][pairs[block.fold][set]];
                    &of_candidate.channels[channel][block.range.clone()]
                };
                let pairs = of(0)
                    .iter()
                    .zip(of(1))
                    .filter(|(e0, e1)| e0.is_finite() && e1.is_finite());
                pairs.fold(Sums::default(), |sums, (e0, e1)| Sums {
                    cross: sums.cross + e0 * (e0 - e1),
                    square: sums.square + (e0 - e1).powi(2),
                    cad: sums.cad + e0 * e0,
                    count: sums.count + 1,
                })
            };
            blocks.iter().map(of_block).collect()
        })
        .collect();
    let folds: Vec<usize> = blocks.iter().map(|block| block.fold).collect();
    let (share, findings) = kept(maker, &folds, &sums);
    let squares = sums.iter().enumerate().map(|(channel, sums)| {
        let own = links_of(maker, channel).map_or(0.0, |place| share[place]);
        let scale = layout.scale(channel).powi(2);
        let left = |sums: &Sums| (scale * (sums.cad - sums.gain(own)), sums.count);
        sums.iter().map(left).collect()
    });
    let held = Held {
        squares: squares.collect(),
        folds,
        loads,
        noises,
    };
    Ok(Guard {
        share,
        findings,
        held,
        blocks,
        sets,
    })
}

/// Sums over the instants of a block, of CAD's error `e0` and that with the whole change, `e1`.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    /// Of `e0 (e0 - e1)`.
    cross: f64,
    /// Of `(e0 - e1)^2`.
    square: f64,
    /// Of `e0^2`.
    cad: f64,
    count: usize,
}

impl Sums {
    /// By how much squares are less than CAD's with a share of the change.
    fn gain(&self, share: f64) -> f64 {
        2.0 * share * self.cross - share * share * self.square
    }
}

/// The first link of the layout that a channel tells of.
fn links_of(maker: &RowMaker<'_>, channel: usize) -> Option<usize> {
    let Groups { links, channels, .. } = maker.groups();
    links.iter().position(|group| *group == channels[channel])
}

/// A sum over blocks and its standard error, that from blocks or that from folds.
fn total(values: &[f64], folds: &[usize]) -> (f64, f64) {
    let mut of_folds = vec![0.0; folds.iter().max().map_or(0, |last| last + 1)];
    folds
        .iter()
        .zip(values)
        .for_each(|(fold, value)| of_folds[*fold] += value);
    (values.iter().sum(), scatter(values).max(scatter(&of_folds)))
}

/// Cuts pieces into blocks, and deals these out to `count` folds by their posture.
fn blocks(pieces: &[Piece<'_>], count: usize) -> Vec<Block> {
    let total: usize = pieces.iter().map(|piece| piece.instants.len()).sum();
    let most = (total / count).max(1);
    let mut blocks = Vec::new();
    for (piece, Piece { instants, .. }) in pieces.iter().enumerate() {
        let mut start = 0;
        for end in 1..=instants.len() {
            let is_long = |end: usize| (instants[end].t - instants[start].t).seconds() >= BLOCK || end - start >= most;
            if end == instants.len() || is_long(end) {
                blocks.push(Block {
                    piece,
                    range: start..end,
                    fold: 0,
                });
                start = end;
            }
        }
    }
    let dofs = pieces.first().map_or(0, |piece| piece.instants[0].position.len());
    let mut postures = DMatrix::from_fn(blocks.len(), dofs, |number, dof| {
        let Block { piece, range, .. } = &blocks[number];
        let positions = pieces[*piece].instants[range.clone()].iter().map(|i| i.position[dof]);
        positions.sum::<f64>() / range.len() as f64
    });
    for mut column in postures.column_iter_mut() {
        let mean = column.mean();
        column.add_scalar_mut(-mean);
    }
    // The direction in which they differ most; in time if they hardly differ.
    const STILL: f64 = 0.01;
    let svd = postures.clone().svd(false, true);
    let differ = svd.singular_values.max() / (blocks.len() as f64).sqrt();
    let along: Vec<f64> = match svd.v_t.filter(|_| differ > STILL) {
        Some(directions) => {
            let first = svd.singular_values.imax();
            (postures * directions.row(first).transpose()).iter().copied().collect()
        }
        None => (0..blocks.len()).map(|number| number as f64).collect(),
    };
    let mut order: Vec<usize> = (0..blocks.len()).collect();
    order.sort_by(|&a, &b| along[a].total_cmp(&along[b]));
    let mut before = 0;
    for number in order {
        let block = &mut blocks[number];
        let middle = before + block.range.len() / 2;
        block.fold = (middle * count / total).min(count - 1);
        before += block.range.len();
    }
    blocks
}

/// What is left of a log with parameters to which the instant at hand had nothing to say: `left` is of
/// one set for each fold, what comes out of a single one.
fn each_from_its_fold<'a>(mut left: Residuals, blocks: impl Iterator<Item = &'a Block>) -> Residuals {
    let count = left.measured.first().map_or(0, Vec::len);
    let mut folds = vec![0; count];
    for block in blocks {
        folds[block.range.clone()].fill(block.fold);
    }
    let own = |channel: usize| (0..count).map(|i| left.noise[folds[i]][channel][i]).collect();
    let own: Vec<Vec<f64>> = (0..left.measured.len()).map(own).collect();
    left.noise = vec![own];
    for (range, block) in left.ranges.iter().zip(&mut left.session) {
        let set = folds.get(range.start).copied().unwrap_or(0);
        block.x = block.x.columns(set, 1).into_owned();
    }
    left
}

/// What is kept of each group, from sums per channel and block.
fn kept(maker: &RowMaker<'_>, folds: &[usize], sums: &[Vec<Sums>]) -> (Vec<f64>, Vec<Finding>) {
    let layout = maker.layout();
    let Groups {
        links,
        further,
        channels,
    } = maker.groups();
    let mut share = vec![0.0; links.len() + further.len()];
    let mut findings = Vec::new();
    let mut groups: Vec<usize> = links.clone();
    groups.sort_unstable();
    groups.dedup();
    for group in groups {
        let own: Vec<usize> = (0..layout.channels()).filter(|&c| channels[c] == group).collect();
        // The gain with a share of the change, in some channels, and its standard error.
        let gain = |share: f64, some: &[usize]| {
            let of_block = |block: usize| -> f64 {
                let each = some
                    .iter()
                    .map(|&c| layout.scale(c).powi(2) * sums[c][block].gain(share));
                each.sum()
            };
            total(&(0..folds.len()).map(of_block).collect::<Vec<f64>>(), folds)
        };
        let shares: Vec<f64> = (1..=10).rev().map(|tenth| f64::from(tenth) / 10.0).collect();
        let best = shares.iter().map(|share| gain(*share, &own));
        let best = best.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default();
        let keeps = |share: &&f64| {
            let (gain, error) = gain(**share, &own);
            gain > error && gain >= best.0 - best.1
        };
        let kept = shares.iter().find(keeps).copied().unwrap_or(0.0);
        if kept < 1.0 {
            let of_group = layout.links.iter().zip(links).filter(|(_, g)| **g == group);
            let names: Vec<&str> = of_group.map(|(link, _)| maker.setup().model.link_name(*link)).collect();
            findings.push(shrunk(kept, names.join(", ")));
        }
        for &channel in &own {
            let (gain, error) = gain(kept, &[channel]);
            if gain < -2.0 * error {
                findings.push(worse(assess::channel_name(maker.setup(), layout, channel).0));
            }
        }
        let all = share.iter_mut().zip(links.iter().chain(further));
        for (value, _) in all.filter(|(_, g)| **g == group) {
            *value = kept;
        }
    }
    (share, findings)
}

/// Standard error of a sum of these values.
fn scatter(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    (variance * count).sqrt()
}

fn not_checked() -> Finding {
    Finding {
        severity: Severity::Warning,
        code: "not_checked",
        subject: String::new(),
        text: format!(
            "the logs are too short to hold a part back and see whether identified parameters predict it: all links stay as in the URDF; record at least {} instants that can be used",
            2 * LEAST_FOLD
        ),
    }
}

fn shrunk(kept: f64, names: String) -> Finding {
    let text = if kept > 0.0 {
        format!(
            "the full change from CAD predicts held-out data less well than a part of it: {:.0} % of it is kept for {names}",
            100.0 * kept
        )
    } else {
        format!(
            "identified parameters predict held-out data no better than CAD: {names} stay as in the URDF; record more, and more different, motion"
        )
    };
    Finding {
        severity: Severity::Warning,
        code: "shrunk",
        subject: names,
        text,
    }
}

fn worse(channel: String) -> Finding {
    Finding {
        severity: Severity::Note,
        code: "channel_worse",
        text: format!(
            "{channel}: held-out data are predicted a little worse than by CAD, though all channels of these links together are predicted better"
        ),
        subject: channel,
    }
}
