//! Whitened rows of one or several observations. The rows of a sub-tree are stored over its own
//! unknowns only.
//!
//! The rows of a humanoid's limb contain a sixth of its unknowns; the cost of all operations is
//! proportional to that.

use crate::arithmetic::{dot, factorise};
use proprio_dynamics::regressor::{LINK_PARAMETERS, StackedRegressor};
use std::collections::BTreeSet;

/// The rows of one sub-tree.
#[derive(Clone, Debug)]
pub(crate) struct SubtreeColumns {
    /// The unknowns of these rows after whitening, ascending: the sub-tree's own, and those of
    /// earlier sub-trees that noise of common sensors links to it.
    pub(crate) columns: Vec<usize>,
    /// Number of offsets among these, which come first.
    pub(crate) offsets: usize,
    subtree: usize,
    /// Places of the sub-tree's regressor columns among `columns`.
    own: Vec<usize>,
    /// For each earlier kind, the places of its columns among `columns`; empty if not linked.
    within: Vec<Vec<usize>>,
}

impl SubtreeColumns {
    /// Numbers of a row, the right side included.
    pub(crate) fn width(&self) -> usize {
        self.columns.len() + 1
    }

    /// The residual of a row for these unknowns, `[s | d]`.
    pub(crate) fn residual(&self, row: &[f64], right: f64, unknowns: &[f64]) -> f64 {
        let own = self.columns.iter().map(|&column| unknowns[column]);
        right - own.zip(row).map(|(x, a)| x * a).sum::<f64>()
    }
}

/// The kinds of a component's rows over `[s | d]`, for these sub-trees, sensors and links.
pub(crate) fn row_kinds(
    stacked: &StackedRegressor,
    subtrees: &[usize],
    sensors: &[usize],
    links: &[usize],
) -> Vec<SubtreeColumns> {
    let offset_count = 6 * sensors.len();
    let place = |list: &[usize], own: usize| list.binary_search(&own).unwrap_or(0);
    // The columns of a sub-tree's regressor.
    let columns = subtrees.iter().map(|&subtree| {
        let subtree = &stacked.subtrees()[subtree];
        let of_links = subtree.links().iter().flat_map(|&link| {
            let first = offset_count + LINK_PARAMETERS * place(links, link);
            first..first + LINK_PARAMETERS
        });
        let of_sensors = subtree.sensors().flat_map(|sensor| {
            let first = 6 * place(sensors, sensor);
            first..first + 6
        });
        of_links.chain(of_sensors).collect::<Vec<usize>>()
    });
    let mut all: Vec<SubtreeColumns> = Vec::new();
    // Linked sub-trees have the number of the last of them.
    let mut group: Vec<usize> = Vec::new();
    for (number, (&subtree, own)) in subtrees.iter().zip(columns).enumerate() {
        let sensors: Vec<usize> = stacked.subtrees()[subtree].sensors().collect();
        for earlier in 0..number {
            let mut others = stacked.subtrees()[all[earlier].subtree].sensors();
            let (shares, of) = (others.any(|s| sensors.contains(&s)), group[earlier]);
            if shares {
                let linked = group.iter_mut().filter(|g| **g == of);
                linked.for_each(|g| *g = number);
            }
        }
        group.push(number);
        let is_joined = |earlier: &usize| group[*earlier] == number;
        let joined = (0..number).filter(is_joined);
        let of_joined = joined.flat_map(|earlier| &all[earlier].columns);
        let columns: BTreeSet<usize> = of_joined.chain(&own).copied().collect();
        let columns: Vec<usize> = columns.into_iter().collect();
        let places = |of: &[usize]| -> Vec<usize> {
            let places = of.iter().map(|column| columns.binary_search(column));
            places.filter_map(Result::ok).collect()
        };
        let within = (0..number).map(|earlier| match is_joined(&earlier) {
            true => places(&all[earlier].columns),
            false => Vec::new(),
        });
        let kind = SubtreeColumns {
            offsets: columns.partition_point(|column| *column < offset_count),
            subtree,
            own: places(&own),
            within: within.collect(),
            columns,
        };
        all.push(kind);
    }
    all
}

/// Greatest number of rows of an observation.
pub(crate) fn most_rows(kinds: &[SubtreeColumns]) -> usize {
    6 * kinds.len()
}

/// Expands a row to all unknowns, without its right side.
pub(crate) fn expand(kind: &SubtreeColumns, row: &[f64], to: &mut [f64]) {
    to.fill(0.0);
    for (&column, &value) in kind.columns.iter().zip(row) {
        to[column] = value;
    }
}

/// The rows of one observation; reusable buffers.
#[derive(Clone, Debug)]
pub(crate) struct WhitenedRows {
    values: Vec<f64>,
    /// Per row its kind, and its start.
    places: Vec<(usize, usize)>,
    /// Noise deviation per channel.
    deviations: Vec<f64>,
    noise: Vec<f64>,
    covariance: Vec<f64>,
}

impl WhitenedRows {
    /// For rows of these kinds over this number of offsets.
    pub(crate) fn new(kinds: &[SubtreeColumns], offset_count: usize) -> Self {
        let most = most_rows(kinds);
        Self {
            values: Vec::with_capacity(kinds.iter().map(|kind| 6 * kind.width()).sum()),
            places: Vec::with_capacity(most),
            deviations: vec![0.0; offset_count],
            noise: vec![0.0; most * offset_count],
            covariance: vec![0.0; most * most],
        }
    }

    /// Computes the whitened rows of the regressor's last update, relative to `reference`, given
    /// the variance of each offset's channel. Returns their number.
    pub(crate) fn make(
        &mut self,
        kinds: &[SubtreeColumns],
        stacked: &StackedRegressor,
        reference: &[f64],
        variances: &[f64],
    ) -> usize {
        self.values.clear();
        self.places.clear();
        for (number, kind) in kinds.iter().enumerate() {
            let subtree = &stacked.subtrees()[kind.subtree];
            for (index, measured) in subtree.projected_measured().iter().enumerate() {
                let start = self.values.len();
                self.values.resize(start + kind.width(), 0.0);
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
        self.factorise_noise(kinds, variances);
        self.whiten(kinds);
        count
    }

    /// Computes the factor of the rows' covariance by the noise of these variances.
    fn factorise_noise(&mut self, kinds: &[SubtreeColumns], variances: &[f64]) {
        let count = self.places.len();
        for (deviation, variance) in self.deviations.iter_mut().zip(variances) {
            *deviation = variance.sqrt();
        }
        // Noise enters as offsets do.
        let (offset_count, noise) = (self.deviations.len(), &mut self.noise);
        noise[..count * offset_count].fill(0.0);
        for (&(number, start), noise) in self
            .places
            .iter()
            .zip(noise.chunks_exact_mut(offset_count.max(1)))
        {
            let kind = &kinds[number];
            for (&column, value) in kind.columns[..kind.offsets]
                .iter()
                .zip(&self.values[start..])
            {
                noise[column] = value * self.deviations[column];
            }
        }
        let noise = |row: usize| &noise[row * offset_count..][..offset_count];
        for (i, (number, _)) in self.places.iter().enumerate() {
            for (j, (other, _)) in self.places[..=i].iter().enumerate() {
                let is_joined = number == other || !kinds[*number].within[*other].is_empty();
                self.covariance[i * count + j] = if is_joined {
                    dot(noise(i), noise(j))
                } else {
                    0.0
                };
            }
        }
        factorise(&mut self.covariance, count);
    }

    /// Applies the inverse of the factor from the left.
    fn whiten(&mut self, kinds: &[SubtreeColumns]) {
        let count = self.places.len();
        for (i, &(number, start)) in self.places.iter().enumerate() {
            let (above, own) = self.values.split_at_mut(start);
            let kind = &kinds[number];
            let own = &mut own[..kind.width()];
            for (j, &(other, from)) in self.places[..i].iter().enumerate() {
                let weight = self.covariance[i * count + j];
                if weight == 0.0 {
                    continue;
                }
                let row = &above[from..][..kinds[other].width()];
                if number == other {
                    own.iter_mut().zip(row).for_each(|(x, y)| *x -= weight * y);
                } else {
                    let within = &kind.within[other];
                    for (&place, y) in within.iter().zip(row) {
                        own[place] -= weight * y;
                    }
                    own[kind.columns.len()] -= weight * row[row.len() - 1];
                }
            }
            let scale = 1.0 / self.covariance[i * count + i];
            own.iter_mut().for_each(|x| *x *= scale);
        }
    }
}

/// The rows of several observations.
#[derive(Clone, Debug)]
pub(crate) struct RowBuffer {
    kinds: Vec<SubtreeRows>,
    observations: u64,
    /// Duration of gathering [s].
    pub(crate) span: f64,
    /// For a block, whether something moved; `moving` is the number of observations of such blocks.
    pub(crate) has_moved: bool,
    moving: u64,
}

/// The rows of one sub-tree.
#[derive(Clone, Debug)]
pub(crate) struct SubtreeRows {
    width: usize,
    /// Capacity in rows.
    room: usize,
    values: Vec<f64>,
    /// Per row, the observation's slot in the time grid.
    slots: Vec<i64>,
}

impl SubtreeRows {
    /// All rows, each with its right side at its end.
    pub(crate) fn values(&self) -> &[f64] {
        &self.values
    }

    pub(crate) fn slots(&self) -> &[i64] {
        &self.slots
    }

    /// Each row, its right side, and its slot.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&[f64], f64, i64)> {
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

impl RowBuffer {
    /// With room for this number of observations.
    pub(crate) fn new(kinds: &[SubtreeColumns], observations: usize) -> Self {
        let of_kind = |kind: &SubtreeColumns| {
            let (width, room) = (kind.width(), 6 * observations);
            SubtreeRows {
                width,
                room,
                values: Vec::with_capacity(width * room),
                slots: Vec::with_capacity(room),
            }
        };
        Self {
            kinds: kinds.iter().map(of_kind).collect(),
            observations: 0,
            span: 0.0,
            has_moved: false,
            moving: 0,
        }
    }

    /// An empty copy with the same capacity.
    pub(crate) fn clone_room(&self) -> Self {
        let mut other = self.clone();
        for kind in &mut other.kinds {
            kind.values
                .reserve_exact(kind.width * kind.room - kind.values.len());
            kind.slots.reserve_exact(kind.room - kind.slots.len());
        }
        other.clear();
        other
    }

    pub(crate) fn len(&self) -> usize {
        self.kinds.iter().map(|kind| kind.slots.len()).sum()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.kinds.iter().all(|kind| kind.slots.is_empty())
    }

    pub(crate) fn observations(&self) -> u64 {
        self.observations
    }

    pub(crate) fn clear(&mut self) {
        for kind in &mut self.kinds {
            kind.values.clear();
            kind.slots.clear();
        }
        (self.observations, self.span, self.has_moved, self.moving) = (0, 0.0, false, 0);
    }

    /// Adds the rows of an observation, as far as there is room.
    pub(crate) fn push(&mut self, slot: i64, observation: &WhitenedRows) {
        self.observations += u64::from(!observation.places.is_empty());
        for &(kind, start) in &observation.places {
            let kind = &mut self.kinds[kind];
            kind.push(slot, &observation.values[start..][..kind.width]);
        }
    }

    /// Whether something moved most of the time.
    pub(crate) fn is_moving(&self) -> bool {
        self.has_moved || 2 * self.moving > self.observations
    }

    pub(crate) fn take_from(&mut self, other: &Self) {
        self.observations += other.observations;
        self.moving += other.observations * u64::from(other.is_moving());
        for (to, from) in self.kinds.iter_mut().zip(&other.kinds) {
            for (row, slot) in from.values.chunks_exact(from.width).zip(&from.slots) {
                to.push(*slot, row);
            }
        }
    }

    /// Kind by kind.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &SubtreeRows> {
        self.kinds.iter()
    }
}
