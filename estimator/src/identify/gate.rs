//! What acted on the robot in a recorded log though nobody declared it: contacts, and a load picked up or put down.
//!
//! Asked after a fit, not before: what CAD has wrong is no contact, for a fit to all of the log takes it up. And by the measure of what the log itself usually leaves: model errors and a
//! structure's vibrations are there all the time, and grow with motion; a contact comes, stands out, and goes.
//!
//! - [`contacts`]: per part of the robot (*unit*: a sub-tree between F/T sensors, or all measured joint torques) and block of 0.1 s, the mean of what is left. Its square, whitened, is
//!   compared with that of blocks in which the robot moves as much. What stands out is left out with a margin, and the fit repeated ([`super::batch`]) until it stays.
//! - [`breaks`]: which sudden changes of a sensor's reading are one of its offset, and not of what it carries.
//! - [`load`]: from some instant on, everything fails in the same way, and the ten parameters of one body at the end of a limb explain it.

use super::batch::{LONG, Prepared, over};
use super::hypothesis::needed;
use super::information::Information;
use super::instants::{Break, Instant};
use super::passes::{NoiseModel, Piece, blocks, follow, leave, tell};
use super::prior::Prior;
use super::rows::{Layout, RowMaker, Rows, WIDTH};
use super::session::{Block, smooth_with};
use crate::dynamics::BitSet;
use crate::statistics::chi_square;
use nalgebra::{DMatrix, DVector, Matrix6, SMatrix, SVector, Vector6};
use proprio_topics::Nanos;
use std::collections::BTreeMap;
use std::ops::Range;

/// What stands out of a block's squares, as the deviate of a normal variable: one block in three million by
/// chance. By so many times the usual variance model errors vary where the robot moves as much; and of more
/// channels than a wrench has, they are no freer. (Of six channels, 39 times the usual square. Real logs
/// without contacts, a leg of cables and a torque-controlled arm, come to 12 to 24 times; pushes of 5 N at a
/// hand with the arm's board to 80 and more.)
const STANDS_OUT: f64 = 5.0;
const VARIES: f64 = 3.5;
const FREE: usize = 6;

/// The quantile that is called usual: three in ten, so that contact may be most of the time; and the normal
/// deviate below which as many are.
const USUAL: f64 = 0.3;
const USUAL_DEVIATE: f64 = -0.524_400_5;

/// Blocks before and after what stands out that are left out too: a touch begins and ends softly.
const MARGIN: usize = 2;

/// Rounds of level, scale and what stands out from them.
const ROUNDS: usize = 20;

/// The level of less than this is not asked for [blocks].
const SHORT: usize = 10;

/// So many times less of a variance is to be known better. And what lasts longer than this between two
/// breaks is no touch \[s\].
const BETTER: f64 = 100.0;
const TOUCH: f64 = 10.0;

/// No contact is looked for where more than this would be one: then the model is not the robot's, or the log not this robot's.
const MOST: f64 = 0.7;

/// Half of the window whose median is the level of a channel: an offset wanders more slowly, a contact is shorter [blocks].
const WINDOW: usize = 150;

/// Pieces that a log is cut into to find out when a load came: of a second, but at most so many.
const PIECES: usize = 64;
const PIECE: f64 = 1.0;

/// Pieces on either side of the change at least.
const LEAST_PIECES: usize = 3;

/// A load is at least so heavy [kg], and its centre at most so far from its link's origin [m].
const LEAST_MASS: f64 = 0.02;
const REACH: f64 = 1.0;

/// Parts of the robot whose equations hold or fail together: numbers of sub-trees, and [`Instant::TORQUES`].
pub type UnitSet = BitSet<2>;

/// A load that came or went within a log.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Load {
    /// Which of the training logs.
    pub log: usize,
    /// Place of its link in the layout.
    pub place: usize,
    /// The side that is left out.
    pub span: (Nanos, Nanos),
    /// The part of it in which the load was there all the time, as it is in the end: not so near to the change.
    pub clear: (Nanos, Nanos),
    /// Within so much the moment of its change is known \[s\].
    pub within: f64,
    /// Whether that is the side after the change.
    pub is_after: bool,
    /// Whose equations it is in.
    pub units: UnitSet,
}

impl Load {
    /// Whether an instant of that log is in the part that is left out.
    pub(super) fn has(&self, t: Nanos) -> bool {
        self.span.0 <= t && t <= self.span.1
    }
}

/// What a body adds to a link, with its covariance.
#[derive(Clone, Debug)]
pub(super) struct Added {
    pub parameters: SVector<f64, WIDTH>,
    pub covariance: SMatrix<f64, WIDTH, WIDTH>,
}

/// Per instant of a log, the units that something undeclared acts on. `loads` are left alone.
pub(super) fn contacts(
    maker: &RowMaker<'_>,
    all: &[&Prepared],
    loads: &[Load],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<Vec<UnitSet>> {
    // Long logs in parts, so that all cores have work: of a minute at least, which a contact is not most of.
    let (mut pieces, mut logs) = (Vec::new(), Vec::new());
    for (number, log) in all.iter().enumerate() {
        let minutes = ((log.span.1 - log.span.0).seconds() / 60.0) as usize;
        let count = log.instants.len().div_ceil(LONG).min(minutes).max(1);
        let at = |part: usize| log.instants.len() * part / count;
        for part in 0..count {
            pieces.push(Piece {
                instants: &log.instants[at(part)..at(part + 1)],
                breaks: &log.breaks,
            });
            logs.push(number);
        }
    }
    let found = over(maker, &pieces, |maker, number, piece| {
        let own: Vec<&Load> = loads.iter().filter(|load| load.log == logs[number]).collect();
        of_piece(maker, piece, &own, noise, d)
    });
    let mut out = vec![Vec::new(); all.len()];
    for (log, found) in logs.into_iter().zip(found) {
        out[log].extend(found);
    }
    out
}

/// Which of these breaks, of each log, a fit bears out: an offset that is the same before and after, within what it wanders and what is known of it by these parameters, was none. (What touches the
/// robot shows in the readings of every sensor that it goes through, as if their offsets changed; by the links between the sensors it is told apart.) Of a sensor that nothing is fitted to, all.
pub(super) fn breaks(
    maker: &RowMaker<'_>,
    all: &[&Prepared],
    breaks: &[Vec<Break>],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<Vec<Break>> {
    let layout = maker.layout();
    let borne_out = |(log, breaks): (&&Prepared, &Vec<Break>)| {
        let place = |b: &Break| layout.sensors.binary_search(&b.sensor).ok();
        if breaks.iter().all(|b| place(b).is_none()) {
            return breaks.clone();
        }
        let piece = Piece {
            instants: &log.instants,
            breaks,
        };
        let (blocks, mut states) = follow(maker, piece, noise, std::slice::from_ref(d));
        let afresh = |block: usize| &blocks[block].1;
        let t = |block: usize| log.instants[blocks[block].0.start].t;
        // Offsets go together where rows show several: how the level after each break does with those before it, and before the breaks of a touch's time earlier.
        let mut carried: Vec<(usize, usize, DMatrix<f64>)> = Vec::new();
        let mut together = BTreeMap::new();
        smooth_with(&mut states, |block, state, gain, continues| {
            for &place in afresh(block) {
                carried.push((place, block, state.p.columns(6 * place, 6).into_owned()));
            }
            carried.retain(|(_, later, _)| (t(*later) - t(block)).seconds() <= TOUCH);
            for (place, later, covariance) in &mut carried {
                *covariance = gain * covariance.select_rows(continues);
                if afresh(block).contains(place) {
                    let own: Matrix6<f64> = covariance.fixed_view::<6, 6>(6 * *place, 0).into_owned();
                    together.insert((*place, block, *later), own);
                }
            }
        });
        let mut kept: Vec<bool> = breaks.iter().map(|b| place(b).is_none()).collect();
        for place in 0..layout.sensors.len() {
            let begins: Vec<usize> = (0..blocks.len()).filter(|&k| afresh(k).contains(&place)).collect();
            let level = |block: usize| {
                let Block { x, p, .. } = &states[block];
                Level {
                    t: t(block),
                    value: x.fixed_view::<6, 1>(6 * place, 0).into_owned(),
                    covariance: p.fixed_view::<6, 6>(6 * place, 6 * place).into_owned(),
                }
            };
            let walk = Vector6::from_fn(|axis, _| noise.drift[6 * place + axis]);
            // The last level before each break, and the first after it.
            let levels: Vec<(Level, Level)> = begins.iter().map(|&k| (level(k - 1), level(k))).collect();
            let shared = |before: usize, after: usize| {
                let key = (place, begins[before], begins[after]);
                together.get(&key).copied().unwrap_or_default()
            };
            let is_new = new_levels(&levels, &shared, &walk);
            let own = breaks.iter().zip(&mut kept);
            for (b, kept) in own.filter(|(b, _)| b.sensor == layout.sensors[place]) {
                let number = begins.partition_point(|&k| t(k) < b.t);
                *kept = is_new.get(number).is_some_and(|is| *is);
            }
        }
        let kept = breaks.iter().zip(kept).filter(|(_, kept)| *kept);
        kept.map(|(b, _)| b.clone()).collect()
    };
    all.iter().zip(breaks).map(borne_out).collect()
}

/// A sensor's offset at some time.
#[derive(Clone, Debug)]
struct Level {
    t: Nanos,
    value: Vector6<f64>,
    covariance: Matrix6<f64>,
}

impl Level {
    /// Whether it can not be another one's that went on, walking. `shared`: the covariance of the other one with this one.
    fn is_other(&self, before: &Self, shared: &Matrix6<f64>, walk: &Vector6<f64>, needed: f64) -> bool {
        let step = self.value - before.value;
        let walked = Matrix6::from_diagonal(&(walk * (self.t - before.t).seconds().max(0.0)));
        let covariance = self.covariance + before.covariance - shared - shared.transpose() + walked;
        covariance
            .cholesky()
            .is_none_or(|factor| step.dot(&factor.solve(&step)) > needed)
    }

    /// Whether more is known of it than of another one, clearly.
    fn is_known_better(&self, than: &Self) -> bool {
        let known = |level: &Self| level.covariance.diagonal().iter().map(|v| v.ln()).sum::<f64>();
        known(self) < known(than) - 6.0 * BETTER.ln()
    }
}

/// Of each break of a sensor, given its level before and after, and the covariance of the one before a break with the one after the same or a later break: whether there is another level
/// indeed. What soon comes back to where it was is a touch between two breaks.
fn new_levels(
    levels: &[(Level, Level)],
    shared: &dyn Fn(usize, usize) -> Matrix6<f64>,
    walk: &Vector6<f64>,
) -> Vec<bool> {
    let mut is_new = vec![true; levels.len()];
    let needed = needed(6, levels.len());
    let mut number = 0;
    let mut known: Option<usize> = None;
    while number < levels.len() {
        let own = &levels[number].0;
        let is_better = |known: &usize| levels[*known].0.is_known_better(own);
        let before = known.filter(is_better).unwrap_or(number);
        // As far as possible.
        let last = (number..levels.len())
            .take_while(|&k| k == number || (levels[k].1.t - own.t).seconds() < TOUCH)
            .filter(|&k| {
                !levels[k]
                    .1
                    .is_other(&levels[before].0, &shared(before, k), walk, needed)
            })
            .last();
        known = last.map(|_| before);
        if let Some(last) = last {
            is_new[number..=last].fill(false);
            number = last;
        }
        number += 1;
    }
    is_new
}

fn of_piece(
    maker: &mut RowMaker<'_>,
    piece: Piece<'_>,
    loads: &[&Load],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<UnitSet> {
    let layout = maker.layout().clone();
    let channels = layout.channels();
    let variances = noise.following();
    let left = leave(maker, piece, noise, std::slice::from_ref(d));
    // Offsets where they are most of the time: a contact that they followed must not hide behind them.
    let ranges = blocks(&layout, piece);
    let starts_of = |counts: &dyn Fn(usize) -> bool| {
        let breaks = (0..ranges.len()).filter(|&k| ranges[k].1.iter().any(|sensor| counts(*sensor)));
        stretches(breaks, ranges.len())
    };
    let mut session = vec![DVector::zeros(layout.session()); ranges.len()];
    for unknown in 0..layout.session() {
        // Six offsets per sensor, then what never starts afresh.
        for stretch in starts_of(&|sensor| sensor == unknown / 6).windows(2) {
            let own = left.session[stretch[0]..stretch[1]].iter();
            let middle = quantile(own.map(|block| block.x[(unknown, 0)]).collect(), 0.5);
            session[stretch[0]..stretch[1]]
                .iter_mut()
                .for_each(|x| x[unknown] = middle);
        }
    }
    // Per unit, channel and block: the most likely mean of the channel's noise and the offset's wandering, by the unit's rows alone.
    let units: Vec<usize> = (0..maker.setup().structure.subtrees().len())
        .chain([Instant::TORQUES])
        .collect();
    let mut series = vec![vec![vec![f64::NAN; ranges.len()]; channels]; units.len()];
    let mut motion = vec![0.0; ranges.len()];
    let (mut rows, mut own) = (Rows::new(&layout), Rows::new(&layout));
    let (mut white, mut e) = (Vec::new(), vec![0.0; channels]);
    maker.disregard_suspicions(true);
    for (block, (range, _)) in ranges.iter().enumerate() {
        let mut sums = vec![(vec![0.0; channels], vec![0.0_f64; channels]); units.len()];
        for instant in &piece.instants[range.clone()] {
            motion[block] += instant.velocity.iter().map(|v| v * v).sum::<f64>() / range.len() as f64;
            if maker.make(instant, &mut rows).is_err() {
                continue;
            }
            for (&unit, (sums, counts)) in units.iter().zip(&mut sums) {
                if loads
                    .iter()
                    .any(|load| load.units.contains(unit) && load.has(instant.t))
                {
                    continue;
                }
                rows.copy_unit(unit, &mut own);
                if own.count == 0 {
                    continue;
                }
                white.clear();
                white.extend((0..own.count).map(|row| {
                    own.r(row)
                        - super::dot(own.a(row), d.as_slice())
                        - super::dot(own.g(row), session[block].as_slice())
                }));
                own.whiten_with(&variances, &mut white, 1);
                own.channel_noise(&variances, &mut white, &mut e);
                for channel in (0..channels).filter(|&channel| own.has(channel)) {
                    sums[channel] += e[channel];
                    counts[channel] += 1.0;
                }
            }
        }
        for ((sums, counts), series) in sums.iter().zip(&mut series) {
            for channel in (0..channels).filter(|&channel| counts[channel] > 0.0) {
                series[channel][block] = sums[channel] / counts[channel];
            }
        }
    }
    maker.disregard_suspicions(false);
    let mut out = vec![UnitSet::default(); piece.instants.len()];
    for (&unit, series) in units.iter().zip(&series) {
        let seen: Vec<usize> = (0..channels)
            .filter(|&c| series[c].iter().any(|x| x.is_finite()))
            .collect();
        let own: Vec<&[f64]> = seen.iter().map(|&c| series[c].as_slice()).collect();
        let least: Vec<f64> = seen.iter().map(|&c| noise.least[c]).collect();
        let starts = starts_of(&|sensor| seen.iter().any(|channel| channel / 6 == sensor));
        let odd = stands_out(&own, &starts, &motion, &least);
        let share = odd.iter().filter(|odd| **odd).count() as f64 / odd.len().max(1) as f64;
        if share > MOST {
            continue;
        }
        for ((range, _), _) in ranges.iter().zip(&odd).filter(|(_, odd)| **odd) {
            out[range.clone()].iter_mut().for_each(|set| set.insert(unit));
        }
    }
    out
}

/// Where stretches of blocks begin of which each has a level of its own, and the number of blocks: at these breaks. One that is too short to tell its level from what acts there goes with
/// its neighbour: where something touches the robot, breaks of several sensors follow each other.
fn stretches(breaks: impl Iterator<Item = usize>, count: usize) -> Vec<usize> {
    let mut starts = vec![0];
    for at in breaks {
        if at - starts[starts.len() - 1] >= SHORT {
            starts.push(at);
        }
    }
    if starts.len() > 1 && count - starts[starts.len() - 1] < SHORT {
        starts.pop();
    }
    starts.push(count);
    starts
}

/// Which blocks of some channels' means stand out from a slowly wandering level. A new level begins at each of `starts`, which end with the number of blocks; `motion` says how much the robot
/// moved in each, `least` what variance a channel has at least.
fn stands_out(series: &[&[f64]], starts: &[usize], motion: &[f64], least: &[f64]) -> Vec<bool> {
    let count = motion.len();
    let mut odd = vec![false; count];
    if series.is_empty() || count == 0 {
        return odd;
    }
    let mut levels: Vec<Vec<f64>> = series.iter().map(|series| medians(series, starts)).collect();
    let of_channels = |deviate: f64| chi_square(series.len().min(FREE), deviate);
    let most = VARIES * of_channels(STANDS_OUT) / of_channels(USUAL_DEVIATE);
    for _ in 0..ROUNDS {
        let mut squares = vec![0.0; count];
        let mut seen = vec![false; count];
        for ((series, level), least) in series.iter().zip(&levels).zip(least) {
            let errors: Vec<f64> = series.iter().zip(level).map(|(x, level)| (x - level).powi(2)).collect();
            let usual = errors.iter().zip(&odd).filter(|(x, odd)| x.is_finite() && !**odd);
            // The median of the square of a normal deviate is 0.455.
            let scale = (quantile(usual.map(|(x, _)| *x).collect(), 0.5) / 0.455).max(*least);
            for (block, error) in errors.iter().enumerate().filter(|(_, error)| error.is_finite()) {
                squares[block] += error / scale;
                seen[block] = true;
            }
        }
        let usual = usual(&squares, &seen, motion);
        let fails: Vec<bool> = (0..count).map(|k| seen[k] && squares[k] > most * usual[k]).collect();
        let mut next = vec![false; count];
        for k in (0..count).filter(|&k| fails[k]) {
            next[k.saturating_sub(MARGIN)..(k + MARGIN + 1).min(count)].fill(true);
        }
        if next == odd {
            break;
        }
        odd = next;
        for (series, level) in series.iter().zip(&mut levels) {
            let clean: Vec<f64> = series
                .iter()
                .zip(&odd)
                .map(|(x, odd)| if *odd { f64::NAN } else { *x })
                .collect();
            // A level that follows faster would follow into a contact, too.
            for (level, next) in level.iter_mut().zip(medians(&clean, starts)) {
                if next.is_finite() {
                    *level = next;
                }
            }
        }
    }
    odd
}

/// The usual square of each block: of blocks in which the robot moves about as much, and not less than of all.
fn usual(squares: &[f64], seen: &[bool], motion: &[f64]) -> Vec<f64> {
    const STATIONS: usize = 40;
    let mut order: Vec<usize> = (0..squares.len()).filter(|&k| seen[k]).collect();
    order.sort_by(|&a, &b| motion[a].total_cmp(&motion[b]).then(a.cmp(&b)));
    let of = |some: &[usize]| quantile(some.iter().map(|&k| squares[k]).collect(), USUAL);
    let all = of(&order);
    let mut out = vec![all; squares.len()];
    // A third of the blocks at a time, so that a contact is not most of any. Of all thirds that a block is in the most lenient counts: what is left may change at once where motion begins.
    let width = order.len().div_ceil(3).max(25).min(order.len());
    let stride = order.len().div_ceil(STATIONS).max(1);
    let last = order.len() - width;
    for start in (0..last).step_by(stride).chain([last]) {
        let own = &order[start..start + width];
        let near = of(own);
        own.iter().for_each(|&k| out[k] = out[k].max(near));
    }
    out
}

/// Medians of a series in a window that goes along, per stretch.
fn medians(series: &[f64], starts: &[usize]) -> Vec<f64> {
    const STRIDE: usize = 10;
    let mut out = vec![f64::NAN; series.len()];
    for stretch in starts.windows(2) {
        for start in (stretch[0]..stretch[1]).step_by(STRIDE) {
            let end = (start + STRIDE).min(stretch[1]);
            let around = start.saturating_sub(WINDOW).max(stretch[0])..(end + WINDOW).min(stretch[1]);
            let own = series[around].iter().copied().filter(|x| x.is_finite()).collect();
            out[start..end].fill(quantile(own, 0.5));
        }
    }
    out
}

/// A quantile of some numbers; not a number of none.
fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let place = (share * (values.len() - 1) as f64).round() as usize;
    *values.select_nth_unstable_by(place, f64::total_cmp).1
}

/// `[R^T R, R^T z]` of some information: what a change of load is looked for in, not what anything is solved from in the end.
struct Normal {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
}

impl Normal {
    fn new(unknowns: usize) -> Self {
        Self {
            matrix: DMatrix::zeros(unknowns, unknowns),
            right: DVector::zeros(unknowns),
        }
    }

    fn add(&mut self, information: &Information) {
        let (r, z) = information.to_triangle();
        self.matrix += r.transpose() * &r;
        self.right += r.transpose() * z;
    }

    fn add_prior(&mut self, prior: &Prior, layout: &Layout, tau: f64) {
        for (place, &link) in layout.links.iter().enumerate() {
            let mut own = self.matrix.fixed_view_mut::<WIDTH, WIDTH>(WIDTH * place, WIDTH * place);
            own += prior.metric(link) / (2.0 * tau * tau);
        }
        for (precision, column) in layout.precision.iter().copied().zip(layout.inertial()..) {
            self.matrix[(column, column)] += precision;
        }
    }
}

/// What a body that is on the link at `place` in `some` of `all` data only would have to be, and by how much it lessens the squares. `factor`: of all data and the prior; `x`: what solves them.
fn body(
    prior: &Prior,
    layout: &Layout,
    place: usize,
    some: &Normal,
    factor: &nalgebra::Cholesky<f64, nalgebra::Dyn>,
    x: &DVector<f64>,
) -> Option<(Added, f64)> {
    let cross = some.matrix.fixed_columns::<WIDTH>(WIDTH * place).into_owned();
    let own = cross.fixed_rows::<WIDTH>(WIDTH * place).into_owned();
    // The body is no less known than to three times the link's own size.
    let weak = prior.metric(layout.links[place]) / 18.0;
    let rest = own + weak - cross.transpose() * factor.solve(&cross);
    let misfit = some.right.fixed_rows::<WIDTH>(WIDTH * place).into_owned() - cross.transpose() * x;
    let covariance = rest.cholesky()?.inverse();
    let parameters = covariance * misfit;
    let gain = misfit.dot(&parameters);
    Some((Added { parameters, covariance }, gain))
}

impl Added {
    /// Whether something could be picked up, or put down, that has these parameters.
    fn is_a_body(&self) -> bool {
        let mass = self.parameters[0];
        let centre = self.parameters.fixed_rows::<3>(1) / mass;
        let is_sure = mass * mass > needed(1, 1) * self.covariance[(0, 0)];
        mass.abs() > LEAST_MASS && is_sure && centre.norm() < REACH
    }
}

/// Looks for a load that came or went within one of the logs, given the noise and the prior's weight of a fit to all of them.
///
/// A log is cut into pieces. For each instant between two of them, and each link at the end of a limb: a body there in the pieces after it only (or in those before it only), by how much does
/// it lessen what is left? Which side is left out: where there are other logs, the one that does not go with them; of a single log the shorter.
pub(super) fn load(
    maker: &RowMaker<'_>,
    prior: &Prior,
    training: &[&Prepared],
    noise: &NoiseModel,
    tau: f64,
) -> Option<Load> {
    let layout = maker.layout();
    let model = &maker.setup().model;
    let mut pieces = Vec::new();
    let mut of_log: Vec<Range<usize>> = Vec::new();
    let piece = |log: &Prepared| ((log.span.1 - log.span.0).seconds() / PIECES as f64).max(PIECE);
    for log in training {
        let first = pieces.len();
        let seconds = piece(log);
        let mut start = 0;
        for i in 1..=log.instants.len() {
            let ends = log
                .instants
                .get(i)
                .is_none_or(|instant| (instant.t - log.instants[start].t).seconds() >= seconds);
            if ends {
                pieces.push(Piece {
                    instants: &log.instants[start..i],
                    breaks: &log.breaks,
                });
                start = i;
            }
        }
        of_log.push(first..pieces.len());
    }
    let told = over(maker, &pieces, |maker, _, piece| tell(maker, piece, noise).information);
    let mut all = Normal::new(layout.unknowns());
    told.iter().for_each(|told| all.add(told));
    all.add_prior(prior, layout, tau);
    let factor = all.matrix.clone().cholesky()?;
    let x = factor.solve(&all.right);
    let ends: Vec<usize> = (0..layout.links.len())
        .filter(|&place| model.joints().iter().all(|joint| joint.parent != layout.links[place]))
        .collect();
    // As if one were tried: the noise has the load in it yet. Whether it is quieter without decides.
    let least = needed(WIDTH, 1);
    let mut best: Option<(f64, f64, usize, usize, usize)> = None;
    for (log, range) in of_log.iter().enumerate() {
        if range.len() < 2 * LEAST_PIECES {
            continue;
        }
        let mut whole = Normal::new(layout.unknowns());
        told[range.clone()].iter().for_each(|told| whole.add(told));
        let mut before = Normal::new(layout.unknowns());
        for at in range.start + 1..range.end + 1 - LEAST_PIECES {
            before.add(&told[at - 1]);
            if at < range.start + LEAST_PIECES {
                continue;
            }
            let after = Normal {
                matrix: &whole.matrix - &before.matrix,
                right: &whole.right - &before.right,
            };
            for &place in &ends {
                let of = |some: &Normal| {
                    body(prior, layout, place, some, &factor, &x)
                        .filter(|(added, _)| added.is_a_body())
                        .map_or(0.0, |(_, gain)| gain)
                };
                let (later, earlier) = (of(&after), of(&before));
                let gain = later.max(earlier);
                if gain > least && best.is_none_or(|best| gain > best.0.max(best.1)) {
                    best = Some((later, earlier, log, at, place));
                }
            }
        }
    }
    let (later, earlier, log, at, place) = best?;
    let range = &of_log[log];
    let is_after = if training.len() > 1 {
        later >= earlier
    } else {
        at - range.start >= range.end - at
    };
    let left_out = if is_after { at..range.end } else { range.start..at };
    let first = pieces[left_out.start].instants.first()?.t;
    let last = pieces[left_out.end - 1].instants.last()?.t;
    // All units whose rows have links or channels in common with that link's.
    let structure = &maker.setup().structure;
    let groups = &maker.groups().links;
    let mut units = UnitSet::default();
    for (other, group) in layout.links.iter().zip(groups) {
        if *group == groups[place] {
            units.insert(structure.subtree_of(*other).unwrap_or(0));
            if !layout.joints.is_empty() {
                units.insert(Instant::TORQUES);
            }
        }
    }
    // The change may be anywhere in the piece beside it.
    let (from, to) = if is_after {
        (left_out.start + 1, left_out.end)
    } else {
        (left_out.start, left_out.end - 1)
    };
    let clear = (pieces[from].instants.first()?.t, pieces[to - 1].instants.last()?.t);
    Some(Load {
        log,
        place,
        span: (first, last),
        clear,
        within: piece(training[log]),
        is_after,
        units,
    })
}

/// The body that a load is, by the part of the log that was left out for it and by all that was used.
pub(super) fn added(
    maker: &RowMaker<'_>,
    prior: &Prior,
    training: &[&Prepared],
    load: &Load,
    noise: &NoiseModel,
    used: &Information,
    tau: f64,
) -> Option<Added> {
    let log = training.get(load.log)?;
    let is_clear = |instant: &&Instant| load.clear.0 <= instant.t && instant.t <= load.clear.1;
    let first = log.instants.iter().position(|instant| is_clear(&instant))?;
    let count = log.instants[first..].iter().take_while(is_clear).count();
    let mut maker = maker.clone();
    maker.disregard_suspicions(true);
    let piece = Piece {
        instants: &log.instants[first..first + count],
        breaks: &log.breaks,
    };
    let told = tell(&mut maker, piece, noise);
    let layout = maker.layout();
    let mut some = Normal::new(layout.unknowns());
    some.add(&told.information);
    let mut all = Normal {
        matrix: some.matrix.clone(),
        right: some.right.clone(),
    };
    all.add(used);
    all.add_prior(prior, layout, tau);
    let factor = all.matrix.clone().cholesky()?;
    let x = factor.solve(&all.right);
    body(prior, layout, load.place, &some, &factor, &x).map(|(added, _)| added)
}

#[cfg(test)]
mod tests {
    use super::super::normals;
    use super::*;

    /// Six channels of a robot that stands, moves slowly, moves fast, by turns, and leaves the more the faster it moves; offsets that drift and, once, become others.
    fn usual_log(seed: u64) -> (Vec<Vec<f64>>, Vec<usize>, Vec<f64>) {
        let count = 600;
        let motion: Vec<f64> = (0..count).map(|k| [0.0, 0.3, 2.0][k / 40 % 3]).collect();
        let series = (0..6)
            .map(|channel| {
                let noise = normals(10 * seed + channel, count);
                let slope = 1e-3 * channel as f64;
                let value = |k: usize| 7.0 + slope * k as f64 + if k < 350 { 0.0 } else { 20.0 };
                (0..count).map(|k| value(k) + (0.1 + motion[k]) * noise[k]).collect()
            })
            .collect();
        (series, vec![0, 350, count], motion)
    }

    fn found(series: &[Vec<f64>], starts: &[usize], motion: &[f64]) -> Vec<bool> {
        let series: Vec<&[f64]> = series.iter().map(Vec::as_slice).collect();
        stands_out(&series, starts, motion, &vec![1e-6; series.len()])
    }

    #[test]
    fn what_grows_with_motion_and_drifts_is_no_contact() {
        for seed in 0..20 {
            let (series, starts, motion) = usual_log(seed);
            assert_eq!(
                found(&series, &starts, &motion).iter().filter(|odd| **odd).count(),
                0,
                "seed {seed}"
            );
        }
    }

    /// Of few channels chance alone makes squares many times the usual ones.
    #[test]
    fn the_chance_of_few_channels_is_no_contact() {
        for channels in 1..=3 {
            for seed in 0..20 {
                let (mut series, starts, motion) = usual_log(seed);
                series.truncate(channels);
                let odd = found(&series, &starts, &motion);
                assert_eq!(odd.iter().filter(|odd| **odd).count(), 0, "{channels}, seed {seed}");
                series[0][90..140].iter_mut().for_each(|x| *x += 60.0);
                let odd = found(&series, &starts, &motion);
                assert!(odd[90..140].iter().all(|odd| *odd), "{channels}, seed {seed}");
            }
        }
    }

    #[test]
    fn what_comes_and_goes_is_a_contact_as_long_as_it_lasts() {
        for seed in 0..20 {
            let (mut series, starts, motion) = usual_log(seed);
            // A third of the time, in one direction and in another; both while the robot moves fast and while it stands.
            let spans = [90..140, 200..260, 400..470, 540..555];
            for (number, span) in spans.iter().enumerate() {
                for (channel, size) in [(number, 60.0), (number + 1, -40.0)] {
                    series[channel][span.clone()].iter_mut().for_each(|x| *x += size);
                }
            }
            let odd = found(&series, &starts, &motion);
            for (k, odd) in odd.iter().enumerate() {
                let touched = spans.iter().any(|span| span.contains(&k));
                let near = spans
                    .iter()
                    .any(|span| k + MARGIN >= span.start && k < span.end + MARGIN);
                assert!(*odd || !touched, "seed {seed}: block {k} is touched");
                assert!(!*odd || near, "seed {seed}: block {k} is free");
            }
        }
    }

    /// Breaks of two sensors that follow each other, as where something is picked up: what is between them has no level of its own, and what acts there does not end there.
    #[test]
    fn a_contact_does_not_hide_between_breaks() {
        for seed in 0..20 {
            let (mut series, _, motion) = usual_log(seed);
            let span = 100..160;
            for (channel, size) in [(0, 60.0), (3, -40.0)] {
                series[channel][span.clone()].iter_mut().for_each(|x| *x += size);
            }
            let starts = stretches([127, 131, 350].into_iter(), motion.len());
            assert_eq!(starts, [0, 127, 350, 600]);
            let odd = found(&series, &starts, &motion);
            assert!(odd[span].iter().all(|odd| *odd), "seed {seed}");
        }
        assert_eq!(stretches([4, 300, 595].into_iter(), 600), [0, 300, 600]);
    }

    /// A sensor's level, known to `deviation` in each channel.
    fn level(seconds: f64, value: f64, deviation: f64) -> Level {
        Level {
            t: Nanos::from_seconds(seconds),
            value: Vector6::repeat(value),
            covariance: Matrix6::identity() * deviation * deviation,
        }
    }

    fn apart(_: usize, _: usize) -> Matrix6<f64> {
        Matrix6::zeros()
    }

    #[test]
    fn an_offset_that_is_the_same_before_and_after_did_not_jump() {
        // Per case: time of each break, and the levels before the first of them and after each; which of them stay.
        for (what, breaks, values, expected) in [
            ("nothing", &[3.0][..], &[7.0, 7.1][..], &[false][..]),
            ("a jump", &[3.0], &[7.0, 9.0], &[true]),
            ("there and back soon", &[3.0, 5.0], &[7.0, 9.0, 7.1], &[false, false]),
            ("there and back late", &[3.0, 25.0], &[7.0, 9.0, 7.1], &[true, true]),
            (
                "a jump, then a touch",
                &[3.0, 15.0, 17.0],
                &[7.0, 9.0, 5.0, 9.0],
                &[true, false, false],
            ),
        ] {
            let at = |number: usize, t: f64| level(t, values[number], 0.1);
            let levels: Vec<(Level, Level)> = (breaks.iter().enumerate())
                .map(|(number, &t)| (at(number, t - 0.1), at(number + 1, t)))
                .collect();
            assert_eq!(new_levels(&levels, &apart, &Vector6::zeros()), expected, "{what}");
            // A walk that goes as far in the time between two blocks leaves nothing to tell a jump by.
            let walk = Vector6::repeat(100.0);
            assert!(
                new_levels(&levels, &apart, &walk).iter().all(|is_new| !is_new),
                "{what}"
            );
        }
    }

    /// What is between two breaks was left out, and says nothing: whether the offset jumped is told by what is before and after both.
    #[test]
    fn a_jump_is_told_across_what_was_left_out() {
        for (after, expected) in [(7.1, [false, false]), (9.0, [false, true])] {
            let between = |t: f64| level(t, 40.0, 1e3);
            let levels = [
                (level(3.0, 7.0, 0.1), between(3.1)),
                (between(8.0), level(8.1, after, 0.1)),
            ];
            assert_eq!(new_levels(&levels, &apart, &Vector6::zeros()), expected, "{after}");
        }
    }
}
