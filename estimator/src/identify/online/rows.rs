//! The whitened rows of an instant, and of many: those of a sub-tree over the unknowns that they can tell of alone.
//!
//! The rows of a limb know of a sixth of a humanoid's unknowns; all that is done with rows then costs as much as is in them.

use crate::identify::{dot, factorise};
use crate::regressor::StackedRegressor;

/// The rows of one sub-tree.
#[derive(Clone, Debug)]
pub(super) struct Kind {
    /// The unknowns that they can tell of once they are whitened, ascending: the sub-tree's own, and those of the sub-trees before it that noise of common sensors joins to it.
    pub(super) columns: Vec<usize>,
    /// How many of these, the first, are offsets.
    pub(super) offsets: usize,
    subtree: usize,
    /// Where among `columns` those of the sub-tree's regressor are.
    own: Vec<usize>,
    /// Of each kind before, where among `columns` its columns are; empty for those that nothing joins.
    within: Vec<Vec<usize>>,
}

impl Kind {
    /// What these unknowns, `[s | d]`, leave of a row's right side.
    pub(super) fn left(&self, row: &[f64], right: f64, unknowns: &[f64]) -> f64 {
        let own = self.columns.iter().map(|&column| unknowns[column]);
        right - own.zip(row).map(|(x, a)| x * a).sum::<f64>()
    }
}

/// The kinds of a component's rows, over `[s | d]`.
#[derive(Clone, Debug)]
pub(super) struct Kinds {
    all: Vec<Kind>,
    unknowns: usize,
    /// Offsets, `s`.
    session: usize,
}

impl Kinds {
    /// Of these sub-trees, whose regressors have these columns.
    pub(super) fn new(
        stacked: &StackedRegressor,
        subtrees: &[usize],
        columns: &[Vec<usize>],
        (session, unknowns): (usize, usize),
    ) -> Self {
        let mut all: Vec<Kind> = Vec::new();
        // Those so far that hang together have the number of the last of them.
        let mut group: Vec<usize> = Vec::new();
        for (number, (&subtree, own)) in subtrees.iter().zip(columns).enumerate() {
            let sensors: Vec<usize> = stacked.subtrees()[subtree].sensors().collect();
            for earlier in 0..number {
                let mut others = stacked.subtrees()[all[earlier].subtree].sensors();
                let (shares, of) = (others.any(|s| sensors.contains(&s)), group[earlier]);
                if shares && of != number {
                    group.iter_mut().filter(|g| **g == of).for_each(|g| *g = number);
                }
            }
            group.push(number);
            let joined: Vec<bool> = (0..number).map(|earlier| group[earlier] == number).collect();
            let of_joined = all.iter().zip(&joined).filter(|(_, is_joined)| **is_joined);
            let mut told: Vec<usize> = of_joined.flat_map(|(kind, _)| kind.columns.iter().copied()).collect();
            told.extend(own);
            told.sort_unstable();
            told.dedup();
            let places = |of: &[usize]| of.iter().filter_map(|column| told.binary_search(column).ok()).collect();
            let within = all.iter().zip(&joined).map(|(kind, is_joined)| match is_joined {
                true => places(&kind.columns),
                false => Vec::new(),
            });
            let kind = Kind {
                offsets: told.iter().filter(|column| **column < session).count(),
                subtree,
                own: places(own),
                within: within.collect(),
                columns: told,
            };
            all.push(kind);
        }
        Self { all, unknowns, session }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Kind> {
        self.all.iter()
    }

    pub(super) fn unknowns(&self) -> usize {
        self.unknowns
    }

    /// The most rows that an instant can have.
    pub(super) fn most(&self) -> usize {
        6 * self.all.len()
    }
}

/// A row over all unknowns, its right side left out: in a place that has as many numbers.
pub(super) fn spread(kind: &Kind, row: &[f64], to: &mut [f64]) {
    to.fill(0.0);
    for (&column, &value) in kind.columns.iter().zip(row) {
        to[column] = value;
    }
}

/// The rows of one instant; room for them.
#[derive(Clone, Debug)]
pub(super) struct Instant {
    values: Vec<f64>,
    /// Of each row its kind, and where it begins.
    places: Vec<(usize, usize)>,
    /// Of each offset's channel.
    deviations: Vec<f64>,
    noise: Vec<f64>,
    covariance: Vec<f64>,
}

impl Instant {
    pub(super) fn new(kinds: &Kinds) -> Self {
        let most = kinds.most();
        Self {
            values: Vec::with_capacity(kinds.all.iter().map(|kind| 6 * (kind.columns.len() + 1)).sum()),
            places: Vec::with_capacity(most),
            deviations: vec![0.0; kinds.session],
            noise: vec![0.0; most * kinds.session],
            covariance: vec![0.0; most * most],
        }
    }

    /// Makes the whitened rows of the regressor's last update, relative to `reference`, given the variance of each offset's channel; how many.
    pub(super) fn make(
        &mut self,
        kinds: &Kinds,
        stacked: &StackedRegressor,
        reference: &[f64],
        variances: &[f64],
    ) -> usize {
        self.values.clear();
        self.places.clear();
        for (number, kind) in kinds.all.iter().enumerate() {
            let subtree = &stacked.subtrees()[kind.subtree];
            for (index, measured) in subtree.projected_measured().iter().enumerate() {
                let start = self.values.len();
                self.values.resize(start + kind.columns.len() + 1, 0.0);
                let (row, right) = self.values[start..].split_at_mut(kind.columns.len());
                right[0] = *measured;
                for (&place, value) in kind.own.iter().zip(subtree.projected_row(index)) {
                    row[place] = *value;
                    right[0] -= value * reference[kind.columns[place]];
                }
                self.places.push((number, start));
            }
        }
        let count = self.places.len();
        if self.values.iter().any(|value| !value.is_finite()) {
            self.values.clear();
            self.places.clear();
            return 0;
        }
        for (deviation, variance) in self.deviations.iter_mut().zip(variances) {
            *deviation = variance.sqrt();
        }
        // Noise enters as offsets do.
        let (session, noise) = (kinds.session, &mut self.noise);
        noise[..count * session].fill(0.0);
        for (&(number, start), noise) in self.places.iter().zip(noise.chunks_exact_mut(session.max(1))) {
            let kind = &kinds.all[number];
            for (&column, value) in kind.columns[..kind.offsets].iter().zip(&self.values[start..]) {
                noise[column] = value * self.deviations[column];
            }
        }
        for (i, (number, _)) in self.places.iter().enumerate() {
            for (j, (other, _)) in self.places[..=i].iter().enumerate() {
                let is_joined = number == other || !kinds.all[*number].within[*other].is_empty();
                self.covariance[i * count + j] = if is_joined {
                    dot(&noise[i * session..][..session], &noise[j * session..][..session])
                } else {
                    0.0
                };
            }
        }
        factorise(&mut self.covariance, count);
        // L^-1 from the left.
        for (i, &(number, start)) in self.places.iter().enumerate() {
            let (above, own) = self.values.split_at_mut(start);
            let kind = &kinds.all[number];
            let own = &mut own[..kind.columns.len() + 1];
            for (j, &(other, from)) in self.places[..i].iter().enumerate() {
                let weight = self.covariance[i * count + j];
                if weight == 0.0 {
                    continue;
                }
                let row = &above[from..][..kinds.all[other].columns.len() + 1];
                if number == other {
                    own.iter_mut().zip(row).for_each(|(x, y)| *x -= weight * y);
                } else {
                    let within = &kind.within[other];
                    within.iter().zip(row).for_each(|(&place, y)| own[place] -= weight * y);
                    own[kind.columns.len()] -= weight * row[row.len() - 1];
                }
            }
            let scale = 1.0 / self.covariance[i * count + i];
            own.iter_mut().for_each(|x| *x *= scale);
        }
        count
    }
}

/// Rows of some instants.
#[derive(Clone, Debug)]
pub(super) struct Rows {
    kinds: Vec<OfKind>,
    instants: u64,
    /// How long they were gathered [s].
    pub(super) span: f64,
    /// Of a block, whether something moved meanwhile; of several, how many of their instants are of such.
    pub(super) has_moved: bool,
    moving: u64,
}

/// Those of one sub-tree.
#[derive(Clone, Debug)]
pub(super) struct OfKind {
    width: usize,
    /// Rows that fit in.
    room: usize,
    values: Vec<f64>,
    /// Of each row, the instant's number in the grid.
    slots: Vec<i64>,
}

impl OfKind {
    /// All rows, each with its right side at its end.
    pub(super) fn values(&self) -> &[f64] {
        &self.values
    }

    pub(super) fn slots(&self) -> &[i64] {
        &self.slots
    }

    /// Each row, its right side, and its instant.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&[f64], f64, i64)> {
        let rows = self.values.chunks_exact(self.width).zip(&self.slots);
        rows.filter_map(|(row, slot)| row.split_last().map(|(right, row)| (row, *right, *slot)))
    }

    fn push(&mut self, slot: i64, row: &[f64]) {
        if self.slots.len() < self.room {
            self.values.extend_from_slice(row);
            self.slots.push(slot);
        }
    }
}

impl Rows {
    /// With room for those of so many instants.
    pub(super) fn new(kinds: &Kinds, instants: usize) -> Self {
        let of_kind = |kind: &Kind| {
            let (width, room) = (kind.columns.len() + 1, 6 * instants);
            OfKind {
                width,
                room,
                values: Vec::with_capacity(width * room),
                slots: Vec::with_capacity(room),
            }
        };
        Self {
            kinds: kinds.all.iter().map(of_kind).collect(),
            instants: 0,
            span: 0.0,
            has_moved: false,
            moving: 0,
        }
    }

    /// An empty one with as much room.
    pub(super) fn clone_room(&self) -> Self {
        let mut other = self.clone();
        for kind in &mut other.kinds {
            kind.values.reserve_exact(kind.width * kind.room - kind.values.len());
            kind.slots.reserve_exact(kind.room - kind.slots.len());
        }
        other.clear();
        other
    }

    pub(super) fn len(&self) -> usize {
        self.kinds.iter().map(|kind| kind.slots.len()).sum()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.kinds.iter().all(|kind| kind.slots.is_empty())
    }

    pub(super) fn instants(&self) -> u64 {
        self.instants
    }

    pub(super) fn clear(&mut self) {
        for kind in &mut self.kinds {
            kind.values.clear();
            kind.slots.clear();
        }
        (self.instants, self.span, self.has_moved, self.moving) = (0, 0.0, false, 0);
    }

    /// Adds the rows of an instant, as far as there is room.
    pub(super) fn push(&mut self, slot: i64, instant: &Instant) {
        self.instants += u64::from(!instant.places.is_empty());
        for &(kind, start) in &instant.places {
            let kind = &mut self.kinds[kind];
            kind.push(slot, &instant.values[start..][..kind.width]);
        }
    }

    /// Whether something moved most of the time.
    pub(super) fn is_moving(&self) -> bool {
        self.has_moved || 2 * self.moving > self.instants
    }

    pub(super) fn take_from(&mut self, other: &Self) {
        self.instants += other.instants;
        self.moving += if other.is_moving() { other.instants } else { 0 };
        for (to, from) in self.kinds.iter_mut().zip(&other.kinds) {
            for (row, slot) in from.values.chunks_exact(from.width).zip(&from.slots) {
                to.push(*slot, row);
            }
        }
    }

    /// Kind by kind.
    pub(super) fn iter(&self) -> impl Iterator<Item = &OfKind> {
        self.kinds.iter()
    }
}
