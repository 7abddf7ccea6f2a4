//! Passes over a log's instants: what it tells of the parameters, and what is left when these are given.

use super::dot;
use super::information::{Information, Panel};
use super::instants::{Break, Instant};
use super::noise;
use super::parallel;
use super::rows::{Layout, RowMaker, Rows};
use super::session::{Block, Session, smooth};
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// Offsets are constant within blocks of this length \[s\]; between blocks they walk.
pub(super) const BLOCK: f64 = 0.1;

/// Variance of an offset before anything is measured [N^2 or Nm^2]: no F/T sensor is a thousand off. Of friction coefficients [Nm^2]: a hundred.
pub(super) const OFFSET_VARIANCE: f64 = 1e6;
const FRICTION_VARIANCE: f64 = 1e4;

/// Means over so many autocorrelation times count as independent; at most so many blocks are one.
const INDEPENDENT: f64 = 8.0;
const LONGEST: usize = 10;

/// A channel of whose noise less than this shows among that of others is not judged by it.
const LEAST_SHARE: f64 = 1e-3;

/// Rows that are absorbed at once.
const PANEL: usize = 96;

/// Blocks of instants that one thread takes at a time, and how many times that rows are kept of.
const TOGETHER: usize = 16;
const AT_ONCE: usize = 32;

/// How fast offsets may walk, at the most.
#[derive(Clone, Debug)]
pub(super) struct Walks {
    /// The greatest variance of a step between blocks, relative to that of a block's noise.
    pub relative: f64,
    /// Per channel of F/T sensors, the greatest rate [unit^2/s].
    pub rates: Vec<f64>,
}

/// Consecutive instants of one log, with offsets and friction of their own.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece<'a> {
    pub instants: &'a [Instant],
    /// Where offsets start afresh.
    pub breaks: &'a [Break],
}

/// Noise of all channels.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct NoiseModel {
    /// Per channel: mean square of what is left when the walking offset is taken away.
    pub square: Vec<f64>,
    /// Per channel: its integrated autocorrelation time, in instants.
    pub time: Vec<f64>,
    /// Per channel: rate of the offset's random walk [unit^2/s].
    pub drift: Vec<f64>,
    /// Per channel: variance of a row that gives block means the variance beside the walk that they were found to have.
    pub block: Vec<f64>,
    /// Per channel: no variance is taken as less.
    pub least: Vec<f64>,
}

impl NoiseModel {
    /// Before anything is known: far more than the least, in its proportions.
    pub(super) fn unknown(least: Vec<f64>) -> Self {
        let channels = least.len();
        let start: Vec<f64> = least.iter().map(|least| 1e6 * least).collect();
        Self {
            square: start.clone(),
            time: vec![1.0; channels],
            drift: vec![0.0; channels],
            block: start,
            least,
        }
    }

    /// Variances of rows that count as independent though they are not: for what is said of parameters.
    pub(super) fn inflated(&self) -> Vec<f64> {
        let each = self.square.iter().zip(&self.time).zip(&self.block).zip(&self.least);
        each.map(|(((square, time), block), least)| (square * time).max(*block).max(*least))
            .collect()
    }

    /// Variances for following the offsets.
    pub(super) fn following(&self) -> Vec<f64> {
        self.block.iter().zip(&self.least).map(|(x, y)| x.max(*y)).collect()
    }

    /// Half way between this model, from data that parameters were fitted to, and one from data held out: the first falls short of the noise by as much as the second, which has the
    /// parameters' errors besides, exceeds it (to first order in the number of parameters). Walks as here.
    pub(super) fn midway(&self, held_out: &Self) -> Self {
        let mut midway = self.clone();
        let (own, others) = (self.inflated(), held_out.inflated());
        for (channel, time) in midway.time.iter_mut().enumerate() {
            // What was not among the data held out says nothing of it.
            if self.square[channel] > 0.0 && held_out.square[channel] > 0.0 {
                *time = 0.5 * (own[channel] + others[channel]) / self.square[channel];
            }
        }
        midway
    }

    /// The greatest relative change of a variance.
    pub(super) fn change(&self, other: &Self) -> f64 {
        let pairs = self.inflated().into_iter().zip(other.inflated());
        pairs.map(|(x, y)| (x / y).ln().abs()).fold(0.0, f64::max)
    }

    /// Where rounds of noise and fit go round in a circle, the last of these models back to one like the newest (no variance changed by more than `within`, as [`NoiseModel::change`] has it): of
    /// each channel the greatest noise on the way, so that nothing is stated as surer than it is in any of them. None if they do not.
    pub(super) fn of_circle(rounds: &[Self], within: f64) -> Option<Self> {
        let (newest, before) = rounds.split_last()?;
        let back = before.iter().rposition(|other| newest.change(other) < within)?;
        let mut greatest = newest.clone();
        for other in &before[back + 1..] {
            let (own, others) = (greatest.inflated(), other.inflated());
            for channel in (0..own.len()).filter(|&channel| others[channel] > own[channel]) {
                greatest.square[channel] = other.square[channel];
                greatest.time[channel] = other.time[channel];
                greatest.drift[channel] = other.drift[channel];
                greatest.block[channel] = other.block[channel];
            }
        }
        Some(greatest)
    }

    /// By how much the variances of these channels are less than those of another model: the geometric mean.
    pub(super) fn quieter(&self, other: &Self, channels: &[usize]) -> f64 {
        let (own, others) = (self.inflated(), other.inflated());
        let sum: f64 = channels.iter().map(|&c| (others[c] / own[c]).ln()).sum();
        (sum / channels.len().max(1) as f64).exp()
    }

    fn steps(&self, layout: &Layout, seconds: f64) -> Vec<f64> {
        let mut variances = vec![0.0; layout.session()];
        for (channel, rate) in self.drift.iter().enumerate() {
            variances[layout.offset_of(channel)] = rate * seconds;
        }
        variances
    }
}

/// Variances of a log's own unknowns before anything is measured.
pub(super) fn session_prior(layout: &Layout) -> Vec<f64> {
    let mut prior = vec![OFFSET_VARIANCE; 6 * layout.sensors.len()];
    prior.resize(layout.session(), FRICTION_VARIANCE);
    prior
}

/// A block of instants, with the sensors (places in the layout) that start afresh with it.
pub(super) type BlockRange = (Range<usize>, Vec<usize>);

/// The blocks of a piece.
pub(super) fn blocks(layout: &Layout, piece: Piece<'_>) -> Vec<BlockRange> {
    let instants = piece.instants;
    let mut out = Vec::new();
    let mut start = 0;
    let mut afresh = Vec::new();
    for i in 1..=instants.len() {
        let next: Vec<usize> = match instants.get(i) {
            Some(instant) => piece
                .breaks
                .iter()
                .filter(|b| instants[i - 1].t < b.t && b.t <= instant.t)
                .filter_map(|b| layout.sensors.binary_search(&b.sensor).ok())
                .collect(),
            None => Vec::new(),
        };
        let ends = instants
            .get(i)
            .is_none_or(|instant| (instant.t - instants[start].t).seconds() >= BLOCK);
        if ends || !next.is_empty() {
            out.push((start..i, std::mem::replace(&mut afresh, next)));
            start = i;
        }
    }
    out
}

/// Lets time pass between blocks; what was added to the variances, infinite where an offset starts afresh.
fn pass_time(session: &mut Session, steps: Vec<f64>, afresh: &[usize]) -> Vec<f64> {
    let mut added = steps;
    session.drift(&added);
    for sensor in afresh {
        for (axis, added) in added[6 * sensor..6 * sensor + 6].iter_mut().enumerate() {
            session.renew(6 * sensor + axis, OFFSET_VARIANCE);
            *added = f64::INFINITY;
        }
    }
    added
}

/// What a piece of a log tells of the parameters, and what it says of its own unknowns at its end.
pub(super) struct Told {
    /// Of `d`, offsets and friction eliminated.
    pub information: Information,
    /// At the end `s = estimate - slope d`, with this covariance.
    pub slope: DMatrix<f64>,
    pub covariance: DMatrix<f64>,
}

/// Tells what a piece says of the parameters.
pub(super) fn tell(maker: &mut RowMaker<'_>, piece: Piece<'_>, noise: &NoiseModel) -> Told {
    tell_with(maker, piece, noise, &[], 0, &mut |_, _, _, _| ())
}

/// The same with further columns: what a constant error of these joints' positions would do.
pub(super) fn tell_angles(
    maker: &mut RowMaker<'_>,
    piece: Piece<'_>,
    noise: &NoiseModel,
    angles: &[usize],
    d: &[f64],
) -> Told {
    const ANGLE: f64 = 1e-5;
    let mut turned = Rows::new(maker.layout());
    let mut columns = |maker: &mut RowMaker<'_>, number: usize, rows: &Rows, slopes: &mut [f64]| {
        for (place, &dof) in angles.iter().enumerate() {
            let mut other = piece.instants[number].clone();
            other.position[dof] += ANGLE;
            if maker.make(&other, &mut turned).is_err() || turned.count != rows.count {
                continue;
            }
            for row in 0..rows.count {
                // The row holds at the true position, which is the measured one less the error. Offsets are in it with their own, small, change.
                let right = |r: &Rows| r.r(row) - dot(r.a(row), d);
                slopes[row * angles.len() + place] = -(right(rows) - right(&turned)) / ANGLE;
            }
        }
    };
    tell_with(maker, piece, noise, &[], angles.len(), &mut columns)
}

/// Writes further columns of an instant's rows, row by row, given the instant's number in the piece and its rows.
type Columns<'a> = dyn FnMut(&mut RowMaker<'_>, usize, &Rows, &mut [f64]) + 'a;

/// The same without some instants (none if `held` is empty), and with `width` further columns of
/// whatever kind, after those of `d`.
pub(super) fn tell_with(
    maker: &mut RowMaker<'_>,
    piece: Piece<'_>,
    noise: &NoiseModel,
    held: &[bool],
    width: usize,
    columns: &mut Columns<'_>,
) -> Told {
    let layout = maker.layout().clone();
    let links = layout.unknowns();
    let p = links + width;
    let variances = noise.inflated();
    let mut session = Session::new(&session_prior(&layout), p + 1);
    let mut rows = Rows::new(&layout);
    let mut information = Information::new(p);
    let mut panel = Panel::new(p, PANEL);
    let mut line = vec![0.0; p + 1];
    let mut slopes = Vec::new();
    let mut last = None;
    for (range, afresh) in blocks(&layout, piece) {
        let t = piece.instants[range.start].t;
        if let Some(last) = last.replace(t) {
            pass_time(&mut session, noise.steps(&layout, (t - last).seconds()), &afresh);
        }
        for number in range {
            if held.get(number) == Some(&true) || maker.make(&piece.instants[number], &mut rows).is_err() {
                continue;
            }
            slopes.clear();
            slopes.resize(rows.count * width, 0.0);
            columns(maker, number, &rows, &mut slopes);
            rows.whiten_with(&variances, &mut slopes, width);
            for row in 0..rows.count {
                line[..links].copy_from_slice(rows.a(row));
                line[links..p].copy_from_slice(&slopes[row * width..][..width]);
                line[p] = rows.r(row);
                session.update(rows.g(row), &mut line);
                if panel.rows() == panel.capacity() {
                    let _ = information.absorb(&mut panel);
                }
                // A row that is not finite, of numbers beyond all bounds, tells nothing.
                let _ = panel.push_row(&line[..p], line[p]);
            }
        }
    }
    let _ = information.absorb(&mut panel);
    let estimates = session.estimates();
    Told {
        information,
        slope: estimates.columns(0, links).into_owned(),
        covariance: session.covariance(),
    }
}

/// What is left of a piece of a log, for some sets of parameters.
pub(super) struct Residuals {
    /// Per set, per channel, per instant: noise; NaN where no row has it.
    pub noise: Vec<Vec<Vec<f64>>>,
    /// Per channel, per instant: what the first set says without offsets and friction: of an F/T sensor's reading, of a joint's torque.
    pub predicted: Vec<Vec<f64>>,
    /// The same of what was measured, less what is known of shaking.
    pub measured: Vec<Vec<f64>>,
    /// Blocks of instants.
    pub ranges: Vec<Range<usize>>,
    /// Per block the session's unknowns, a column per set, given all of the piece.
    pub session: Vec<Block>,
    /// How what shows is shared among channels ([`Rows::add_shares`]): the mean over instants, a row per channel.
    pub shares: DMatrix<f64>,
    /// Per channel, at how many instants any row has it.
    pub seen: Vec<f64>,
}

impl Residuals {
    /// Whether any row had this channel.
    pub(super) fn hears(&self, channel: usize) -> bool {
        self.measured[channel].iter().any(|x| x.is_finite())
    }

    /// What a channel's offset does beside its mean since it last started afresh, per block; of what walks of several sensors that rows mix, each sensor's has the share that its noise has.
    /// (Given to whoever is thought to walk most, it would all be thought that one's.)
    fn walk(&self, layout: &Layout, set: usize, channel: usize) -> Vec<f64> {
        let mut sum = vec![0.0; self.session.len()];
        for other in 0..6 * layout.sensors.len() {
            let share = self.shares[(channel, other)];
            if share == 0.0 {
                continue;
            }
            let unknown = layout.offset_of(other);
            let mut start = 0;
            for end in 1..=self.session.len() {
                if end < self.session.len() && self.session[end].drift[unknown].is_finite() {
                    continue;
                }
                let own = &self.session[start..end];
                let mean = own.iter().map(|block| block.x[(unknown, set)]).sum::<f64>() / own.len() as f64;
                for (sum, block) in sum[start..end].iter_mut().zip(own) {
                    *sum += share * (block.x[(unknown, set)] - mean);
                }
                start = end;
            }
        }
        sum
    }
}

/// Takes parameters as given, and fits offsets and friction: the blocks of instants, and what is known at the end of each by what was before, a column per set.
pub(super) fn follow(
    maker: &RowMaker<'_>,
    piece: Piece<'_>,
    noise: &NoiseModel,
    sets: &[DVector<f64>],
) -> (Vec<BlockRange>, Vec<Block>) {
    let layout = maker.layout().clone();
    let k = sets.len();
    let variances = noise.following();
    let mut session = Session::new(&session_prior(&layout), k);
    let make = || (maker.clone(), Rows::new(&layout));
    let (mut states, mut last) = (Vec::new(), None);
    let blocks = blocks(&layout, piece);
    for some in blocks.chunks(AT_ONCE * TOGETHER) {
        // Per row what every set leaves of it, and how offsets and friction are in it.
        let width = k + layout.session();
        let shares: Vec<_> = some.chunks(TOGETHER).collect();
        let lines = parallel::map_with(shares.len(), make, |(maker, rows), number| -> Vec<Vec<f64>> {
            let of_block = |(range, _): &BlockRange| {
                let mut lines = Vec::new();
                for instant in &piece.instants[range.clone()] {
                    if maker.make(instant, rows).is_err() {
                        continue;
                    }
                    rows.whiten(&variances);
                    for row in 0..rows.count {
                        lines.extend(sets.iter().map(|set| rows.r(row) - dot(rows.a(row), set.as_slice())));
                        lines.extend_from_slice(rows.g(row));
                    }
                }
                lines
            };
            shares[number].iter().map(of_block).collect()
        });
        for ((range, afresh), mut lines) in some.iter().zip(lines.into_iter().flatten()) {
            let t = piece.instants[range.start].t;
            let mut drift = vec![0.0; layout.session()];
            if let Some(last) = last.replace(t) {
                drift = pass_time(&mut session, noise.steps(&layout, (t - last).seconds()), afresh);
            }
            for line in lines.chunks_exact_mut(width) {
                let (values, g) = line.split_at_mut(k);
                session.update(g, values);
            }
            states.push(Block {
                x: session.estimates(),
                p: session.covariance(),
                drift,
            });
        }
    }
    (blocks, states)
}

/// The same given all of the piece, and what is left.
pub(super) fn leave(maker: &RowMaker<'_>, piece: Piece<'_>, noise: &NoiseModel, sets: &[DVector<f64>]) -> Residuals {
    let layout = maker.layout().clone();
    let (k, channels, count) = (sets.len(), layout.channels(), piece.instants.len());
    let variances = noise.following();
    let make = || (maker.clone(), Rows::new(&layout));
    let (blocks, mut states) = follow(maker, piece, noise, sets);
    let ranges: Vec<Range<usize>> = blocks.into_iter().map(|(range, _)| range).collect();
    smooth(&mut states);
    let mut first = maker.cad_of_layout();
    if let Some(set) = sets.first() {
        first.iter_mut().zip(set).for_each(|(value, change)| *value += change);
    }
    let cad = maker.cad_of_layout();
    let number = |at: usize| at * TOGETHER..ranges.len().min((at + 1) * TOGETHER);
    // Of some blocks: per instant and channel, what each set leaves, what the first predicts, what was measured; sums of shares; where channels are seen.
    let parts = parallel::map_with(ranges.len().div_ceil(TOGETHER), make, |(maker, rows), at| {
        let (mut white, mut e) = (Vec::new(), vec![0.0; channels]);
        let (mut shares, mut seen) = (vec![0.0; channels * channels], vec![0.0_f64; channels]);
        let mut values = Vec::new();
        for (range, state) in ranges[number(at)].iter().zip(&states[number(at)]) {
            for instant in &piece.instants[range.clone()] {
                let start = values.len();
                values.resize(start + (k + 2) * channels, f64::NAN);
                if maker.make(instant, rows).is_err() {
                    continue;
                }
                rows.whiten(&variances);
                rows.add_shares(&variances, &mut shares);
                let there: Vec<usize> = (0..channels).filter(|&channel| rows.has(channel)).collect();
                there.iter().for_each(|&channel| seen[channel] += 1.0);
                let mut give = |value: &dyn Fn(usize) -> f64, out: usize| {
                    white.clear();
                    white.extend((0..rows.count).map(value));
                    rows.channel_noise(&variances, &mut white, &mut e);
                    for &channel in &there {
                        values[start + out * channels + channel] = e[channel];
                    }
                };
                for (set, d) in sets.iter().enumerate() {
                    let s = state.x.column(set);
                    give(
                        &|row| rows.r(row) - dot(rows.a(row), d.as_slice()) - dot(rows.g(row), s.as_slice()),
                        set,
                    );
                }
                give(&|row| dot(rows.a(row), &first), k);
                give(&|row| rows.r(row) + dot(rows.a(row), &cad), k + 1);
            }
        }
        (values, shares, seen)
    });
    let mut left = vec![vec![vec![f64::NAN; count]; channels]; k + 2];
    let (mut shares, mut seen) = (vec![0.0; channels * channels], vec![0.0_f64; channels]);
    let mut i = 0;
    for (values, of_part, seen_there) in parts {
        for values in values.chunks_exact((k + 2) * channels) {
            let columns = left.iter_mut().flatten();
            columns.zip(values).for_each(|(column, value)| column[i] = *value);
            i += 1;
        }
        shares.iter_mut().zip(of_part).for_each(|(sum, share)| *sum += share);
        seen.iter_mut().zip(seen_there).for_each(|(sum, seen)| *sum += seen);
    }
    let measured = left.pop().unwrap_or_default();
    let predicted = left.pop().unwrap_or_default();
    Residuals {
        noise: left,
        predicted,
        measured,
        ranges,
        session: states,
        shares: DMatrix::from_fn(channels, channels, |i, j| shares[i * channels + j] / seen[i].max(1.0)),
        seen,
    }
}

/// Means of so many blocks each.
fn merge(means: &[f64], count: usize) -> Vec<f64> {
    let mean = |values: &[f64]| {
        let finite = values.iter().filter(|x| x.is_finite());
        let (sum, count) = finite.fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
        sum / count
    };
    means.chunks(count).map(mean).collect()
}

/// The noise of every channel, from what one set of parameters leaves of all pieces.
///
/// Where rows mix channels (a sub-tree between two sensors shows the sum of both), what is left is the *most likely* noise of each, which varies less than the noise: its variance is the
/// channel's less the posterior one, `v - (V - V N^T W^-1 N V)_cc`, a share of `v` that is known. What is found is divided by that share. Where it stays, the variances are those of the
/// greatest likelihood, as with the EM algorithm, which adds the posterior variance instead and comes there in many more rounds.
pub(super) fn noise_of(layout: &Layout, pieces: &[Residuals], set: usize, walks: &Walks, least: &[f64]) -> NoiseModel {
    let mut model = NoiseModel {
        least: least.to_vec(),
        ..NoiseModel::default()
    };
    for channel in 0..layout.channels() {
        let wanders = channel < 6 * layout.sensors.len();
        let (mut step, mut variance) = (0.0, 0.0);
        let mut left: Vec<Vec<f64>> = pieces.iter().map(|piece| piece.noise[set][channel].clone()).collect();
        let mut per_block = 1.0;
        if wanders {
            // Offset and noise together are a random walk and what is beside it.
            let mut means: Vec<noise::Blocks> = Vec::new();
            let (mut used, mut filled) = (0usize, 0usize);
            for (piece, left) in pieces.iter().zip(&mut left) {
                for (range, offset) in piece.ranges.iter().zip(piece.walk(layout, set, channel)) {
                    left[range.clone()].iter_mut().for_each(|x| *x += offset);
                }
                let mean = |range: &Range<usize>| {
                    let values = left[range.clone()].iter().filter(|x| x.is_finite());
                    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), x| (sum + x, count + 1));
                    (sum / count as f64, count)
                };
                let blocks: Vec<(f64, usize)> = piece.ranges.iter().map(mean).collect();
                used += blocks.iter().map(|b| b.1).sum::<usize>();
                filled += blocks.iter().filter(|b| b.1 > 0).count();
                // A new level after a break is no step of the walk: a piece of its own.
                let mut walk = Vec::new();
                for ((value, _), block) in blocks.iter().zip(&piece.session) {
                    if block.drift[layout.offset_of(channel)].is_infinite() {
                        means.push(std::mem::take(&mut walk));
                    }
                    walk.push(*value);
                }
                means.push(walk);
            }
            per_block = used as f64 / filled.max(1) as f64;
            // Noise that is correlated over more than a block looks like a walk there: once its correlation time is known, longer blocks tell the two apart.
            let totals = left.clone();
            let mut merged = 1;
            for _ in 0..2 {
                let longer: Vec<noise::Blocks> = means.iter().map(|means| merge(means, merged)).collect();
                let count = merged as f64;
                let fastest = walks.rates[channel] * BLOCK * count;
                let mut bound = (walks.relative * count * count).min(1.0);
                for _ in 0..4 {
                    (step, variance) = noise::random_walk(&longer, bound);
                    if step <= fastest {
                        break;
                    }
                    bound = fastest / (variance + step - fastest);
                }
                (step, variance) = (step / count, variance * count);
                let mut levels = means.iter().flat_map(|means| noise::levels(means, step, variance));
                for ((piece, left), total) in pieces.iter().zip(&mut left).zip(&totals) {
                    for range in &piece.ranges {
                        let level = levels.next().unwrap_or(f64::NAN);
                        for (x, total) in left[range.clone()].iter_mut().zip(&total[range.clone()]) {
                            *x = total - level;
                        }
                    }
                }
                let slices: Vec<&[f64]> = left.iter().map(Vec::as_slice).collect();
                let (_, time) = noise::autocorrelation_time(&slices);
                merged = ((INDEPENDENT * time / per_block).round() as usize).clamp(1, LONGEST);
            }
        }
        let slices: Vec<&[f64]> = left.iter().map(Vec::as_slice).collect();
        let (square, time) = noise::autocorrelation_time(&slices);
        let seen: f64 = pieces.iter().map(|piece| piece.seen[channel]).sum();
        let shown: f64 = pieces
            .iter()
            .map(|p| p.shares[(channel, channel)] * p.seen[channel])
            .sum();
        let share = if seen > 0.0 {
            (shown / seen).clamp(LEAST_SHARE, 1.0)
        } else {
            1.0
        };
        model.square.push(square / share);
        model.time.push(time);
        model.drift.push(step / BLOCK / share);
        let block = if wanders { variance * per_block } else { square * time };
        model.block.push(block / share);
    }
    model.least = alike(layout, pieces, &model);
    model
}

/// What no channel's variance is taken to be less than, for channels that rows show only together
/// with others: how their sum is shared out tells little, and its likelihood is greatest where some
/// have no noise at all, so that the combinations of rows that show these would be exact. So none has
/// less than half the noise, relative to what is stated, that they have in the mean.
fn alike(layout: &Layout, pieces: &[Residuals], model: &NoiseModel) -> Vec<f64> {
    const LEAST: f64 = 0.5;
    let wrenches = 6 * layout.sensors.len();
    let relative = |c: usize| (model.square[c] * model.time[c]).max(model.block[c]) / model.least[c];
    let mut least = model.least.clone();
    for (channel, least) in least.iter_mut().enumerate().take(wrenches) {
        let is_mixed = |other: usize| {
            let shares = |p: &Residuals| p.shares[(channel, other)] != 0.0 || p.shares[(other, channel)] != 0.0;
            other / 6 != channel / 6 && pieces.iter().any(shares)
        };
        // Forces with forces, torques with torques.
        let others = (0..wrenches).filter(|&other| other % 6 / 3 == channel % 6 / 3 && is_mixed(other));
        let (sum, count) = others.fold((relative(channel), 1.0), |(sum, count), c| {
            (sum + relative(c), count + 1.0)
        });
        if count > 1.0 {
            *least *= (LEAST.powi(2) * sum / count).max(1.0);
        }
    }
    least
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::gate::UnitSet;
    use super::super::normals;
    use super::*;
    use crate::config::{Config, IdentificationInput};
    use crate::dynamics::{FrameMotion, SensorSet};
    use crate::model::Model;
    use crate::setup::Setup;
    use crate::spatial::{Vec3, Wrench};
    use nalgebra::{Matrix6, Vector6};
    use proprio_topics::{Nanos, Reason};

    /// Rounds end where they stay, or come back to where they were; then with the greatest noise on the way round.
    #[test]
    fn rounds_that_go_round_end() {
        let noise = |squares: [f64; 2]| NoiseModel {
            square: squares.to_vec(),
            time: vec![2.0; 2],
            block: vec![1e-3; 2],
            drift: squares.map(|x| 0.01 * x).to_vec(),
            least: vec![1e-9; 2],
        };
        let far = [[9.0, 9.0], [5.0, 7.0]].map(noise);
        let of = |rounds: &[[f64; 2]]| {
            let rounds: Vec<NoiseModel> = far.iter().cloned().chain(rounds.iter().copied().map(noise)).collect();
            NoiseModel::of_circle(&rounds, 0.03)
        };
        assert_eq!(of(&[[1.0, 2.0], [1.2, 2.0], [1.5, 2.0]]), None);
        assert_eq!(of(&[[1.0, 2.0], [1.2, 2.0], [1.201, 2.0]]), Some(noise([1.201, 2.0])));
        let found = of(&[[3.0, 3.0], [1.0, 2.2], [1.3, 2.0], [1.1, 2.1], [1.001, 2.201]]).unwrap();
        assert_eq!(found, noise([1.3, 2.201]));
        assert_eq!(NoiseModel::of_circle(&far[..1], 0.03), None);
    }

    /// Three links between two F/T sensors, a foot beyond that stands on something: the readings of both sensors are in the same six equations.
    pub(in crate::identify) fn between_two_sensors() -> Setup {
        let link = |name: &str| {
            format!(
                "<link name=\"{name}\"><inertial><origin xyz=\"0.02 -0.01 0.1\" rpy=\"0 0 0\"/><mass value=\"1.5\"/><inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" iyy=\"0.012\" iyz=\"0\" izz=\"0.005\"/></inertial></link>"
            )
        };
        let joint = |name: &str, parent: &str, child: &str, rest: &str| {
            let kind = if rest.is_empty() { "fixed" } else { "revolute" };
            format!(
                "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"{parent}\"/><child link=\"{child}\"/><origin xyz=\"0 0.03 0.2\" rpy=\"0.3 0.1 0\"/>{rest}</joint>"
            )
        };
        let turns =
            |axis: &str| format!("<axis xyz=\"{axis}\"/><limit lower=\"-3\" upper=\"3\" effort=\"9\" velocity=\"9\"/>");
        let urdf = ["base", "thigh", "knee", "shank", "foot"].map(link).concat()
            + &joint("hip_ft", "base", "thigh", "")
            + &joint("j1", "thigh", "knee", &turns("1 0 0"))
            + &joint("j2", "knee", "shank", &turns("0 1 0"))
            + &joint("foot_ft", "shank", "foot", "");
        let urdf = format!("<robot name=\"leg\">{urdf}</robot>");
        let config = "schema = 1\nrobot = \"leg\"\nmodel = \"leg.urdf\"\n[base]\nkind = \"fixed\"\nlink = \"base\"\n\
            [[force_torque]]\nsensor = \"hip\"\njoint = \"hip_ft\"\n[[force_torque]]\nsensor = \"foot\"\njoint = \"foot_ft\"\n\
            [[contact]]\nname = \"floor\"\nlink = \"foot\"\n";
        let model = Model::from_urdf(&urdf, &["hip_ft", "foot_ft"]).expect("a model");
        Setup::with_model(&Config::parse(config).expect("a configuration"), model).expect("it fits")
    }

    /// What both sensors read at 100 Hz while CAD is right, with these deviations of their channels and of their offsets' steps, [torque; force] of both.
    pub(in crate::identify) fn readings(
        setup: &Setup,
        count: usize,
        noise: &[f64; 12],
        walk: &[f64; 12],
    ) -> Vec<Instant> {
        // Of each of twelve channels, a step of its offset and its noise.
        let mut deviates = normals(7, 24 * count).into_iter();
        let mut normal = || deviates.next().expect("enough");
        let zero = Wrench::zero();
        let mut instants: Vec<Instant> = (0..count)
            .map(|k| {
                let t = 0.01 * k as f64;
                let angles = [(1.3, 2.1, 0.4), (1.1, 1.4, 1.9)].map(|(size, rate, phase): (f64, f64, f64)| {
                    let (s, c) = (rate * t + phase).sin_cos();
                    [size * s, size * rate * c, -size * rate * rate * s]
                });
                Instant {
                    t: Nanos::from_seconds(t),
                    position: angles.iter().map(|a| a[0]).collect(),
                    velocity: angles.iter().map(|a| a[1]).collect(),
                    acceleration: angles.iter().map(|a| a[2]).collect(),
                    torque: vec![f64::NAN; 2],
                    base_link: setup.base_link,
                    base: FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.80665)),
                    readings: vec![zero; 2],
                    active: setup.always,
                    faults: vec![Reason::None; setup.channels().len()],
                    base_fault: Reason::None,
                    temperatures: Vec::new(),
                    fitted: Vec::new(),
                    outliers: SensorSet::default(),
                    suspected: UnitSet::default(),
                    shaking: Vec::new(),
                }
            })
            .collect();
        let mut maker = RowMaker::survey(setup, &[IdentificationInput::Wrench], instants.iter()).expect("rows");
        let mut rows = Rows::new(maker.layout());
        let mut offset = [0.0; 12];
        for instant in &mut instants {
            // r = 0 for G m + r(0) = 0: the foot's reading is chosen, the hip's follows.
            maker.make(instant, &mut rows).expect("rows");
            assert_eq!(rows.count, 6);
            let g = |first: usize| Matrix6::from_fn(|i, j| rows.g(i)[first + j]);
            let foot = Vector6::new(0.5, -0.3, 0.2, 3.0, -2.0, 20.0);
            let hip = g(0).try_inverse().expect("a transform") * (-Vector6::from_fn(|i, _| rows.r(i)) - g(6) * foot);
            for (i, offset) in offset.iter_mut().enumerate() {
                *offset += walk[i] * normal();
            }
            let mut noisy = |exact: &Vector6<f64>, first: usize| {
                let value: [f64; 6] =
                    std::array::from_fn(|i| exact[i] + offset[first + i] + noise[first + i] * normal());
                Wrench::from_parts([value[3], value[4], value[5]], [value[0], value[1], value[2]])
            };
            instant.readings = vec![noisy(&hip, 0), noisy(&foot, 6)];
        }
        instants
    }

    fn noise_found(setup: &Setup, instants: &[Instant], rounds: usize) -> NoiseModel {
        let maker = RowMaker::survey(setup, &[IdentificationInput::Wrench], instants.iter()).expect("rows");
        let layout = maker.layout().clone();
        assert_eq!((layout.sensors.len(), layout.channels()), (2, 12));
        let least: Vec<f64> = (0..12)
            .map(|channel| if channel % 6 < 3 { 1e-10 } else { 1e-8 })
            .collect();
        let mut noise = NoiseModel::unknown(least.clone());
        let piece = Piece { instants, breaks: &[] };
        let zero = DVector::zeros(layout.unknowns());
        let walks = Walks {
            relative: 0.01,
            rates: vec![f64::INFINITY; 12],
        };
        for _ in 0..rounds {
            let left = leave(&maker, piece, &noise, std::slice::from_ref(&zero));
            noise = noise_of(&layout, std::slice::from_ref(&left), 0, &walks, &least);
        }
        noise
    }

    /// Something undeclared on the foot acts on every joint between it and the base; something on the base on none. Where it is on a sub-tree nobody knows, so it may be beyond all joints there.
    #[test]
    fn torques_are_not_taken_where_something_undeclared_may_act_beyond() {
        let setup = between_two_sensors();
        let mut instants = readings(&setup, 3, &[0.1; 12], &[0.0; 12]);
        for instant in &mut instants {
            instant.active = crate::dynamics::ContactSet::default();
            instant.torque = vec![1.0, 2.0];
        }
        let inputs = [IdentificationInput::Wrench, IdentificationInput::Torque];
        let mut maker = RowMaker::survey(&setup, &inputs, instants.iter()).expect("rows");
        let zero = vec![0.0; maker.layout().unknowns()];
        let of_link = |name: &str| {
            let link = (0..setup.model.link_count()).find(|&link| setup.model.link_name(link) == name);
            link.and_then(|link| setup.structure.subtree_of(link))
                .expect("a sub-tree")
        };
        let mut rows = Rows::new(maker.layout());
        for (suspected, expected) in [
            (None, 2),
            (Some(of_link("base")), 2),
            (Some(of_link("knee")), 0),
            (Some(of_link("foot")), 0),
            (Some(Instant::TORQUES), 0),
        ] {
            let mut instant = instants[1].clone();
            suspected.into_iter().for_each(|unit| instant.suspected.insert(unit));
            maker.make(&instant, &mut rows).expect("rows");
            let mut own = Rows::new(maker.layout());
            rows.copy_unit(Instant::TORQUES, &mut own);
            assert_eq!(own.count, expected, "rows with {suspected:?}");
            if suspected != Some(Instant::TORQUES) {
                let errors = maker.torque_errors(&instant, &zero).expect("errors");
                let there = errors.iter().filter(|x| x.is_finite()).count();
                assert_eq!(there, expected, "compared with {suspected:?}");
            }
        }
    }

    const HIP_AND_FOOT: [f64; 12] = [0.02, 0.03, 0.015, 0.4, 0.3, 0.5, 0.004, 0.006, 0.003, 0.1, 0.08, 0.15];

    #[test]
    fn the_noise_of_two_sensors_is_told_apart() {
        let setup = between_two_sensors();
        let instants = readings(&setup, 6000, &HIP_AND_FOOT, &[0.0; 12]);
        let noise = noise_found(&setup, &instants, 12);
        // Forces are told apart by their lever arms; torques, by how the sensors turn against each other alone, hardly: but as a whole they are known.
        let is_torque = |channel: &usize| channel % 6 < 3;
        for channel in (0..12).filter(|channel| !is_torque(channel)) {
            let ratio = noise.square[channel].sqrt() / HIP_AND_FOOT[channel];
            println!(
                "channel {channel}: {ratio:.3}, time {:.2}, drift {:.2e}",
                noise.time[channel], noise.drift[channel]
            );
            // The quieter of the two has a quarter of the other's noise: it is taken to have half of what both
            // have in the mean at the least.
            let most = if channel < 6 { 1.05 } else { 1.5 };
            assert!((0.95..most).contains(&ratio), "channel {channel}: {ratio}");
        }
        let of_torques = |square: &dyn Fn(usize) -> f64| (0..12).filter(is_torque).map(square).sum::<f64>();
        let ratio = of_torques(&|channel| noise.square[channel]) / of_torques(&|channel| HIP_AND_FOOT[channel].powi(2));
        assert!((ratio - 1.0).abs() < 0.15, "{ratio}");
        // None is without noise, however the rows' is shared out.
        let relative = |channel: usize| noise.inflated()[channel] / if channel % 6 < 3 { 1e-10 } else { 1e-8 };
        for kind in [[0, 1, 2, 6, 7, 8], [3, 4, 5, 9, 10, 11]] {
            let all: Vec<f64> = kind.into_iter().map(relative).collect();
            let greatest = all.iter().copied().fold(0.0, f64::max);
            assert!(all.iter().all(|own| *own >= 0.25 * greatest / 6.0), "{all:?}");
        }
    }

    /// Which of two offsets wanders can not be told where rows show their sum alone; how far both together wander can.
    #[test]
    fn the_walk_of_two_offsets_is_found_as_a_whole() {
        let setup = between_two_sensors();
        let mut walk = [0.0; 12];
        walk[3..6].fill(0.003);
        walk[9..12].fill(0.003);
        let instants = readings(&setup, 6000, &HIP_AND_FOOT, &walk);
        let noise = noise_found(&setup, &instants, 12);
        for (channel, (square, expected)) in noise.square.iter().zip(HIP_AND_FOOT).enumerate() {
            println!(
                "channel {channel}: {:.3}, drift {:.2e}",
                square.sqrt() / expected,
                noise.drift[channel]
            );
        }
        let whole: f64 = [3, 4, 5, 9, 10, 11].map(|channel| noise.drift[channel]).iter().sum();
        let expected = 6.0 * 0.003 * 0.003 / 0.01;
        assert!((0.5..2.0).contains(&(whole / expected)), "{whole}, not {expected}");
    }
}
