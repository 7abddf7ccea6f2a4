//! One sub-tree's part of the root of the covariance: its columns, and the wrenches `W` of its
//! links. The parent module has the equations.

use super::covariance::{Block, Covariance, triangle};
use super::vectors::{
    Calibrated, ColumnBlock, Covariance6, LANES, Lanes, Member, Root, add_covariance,
    add_independent, add_link, add_offset, add_reading, dot, numbers, project, splat, times,
    vectors, vectors_mut,
};
use nalgebra::{DMatrix, Matrix6};
use proprio_dynamics::regressor::{LINK_PARAMETERS, link_rows};
use proprio_dynamics::spatial::Motion;
use proprio_dynamics::{Kinematics, Solver, Structure};
use pulp::Simd;
use std::ops::Range;

/// The part of the root that belongs to one sub-tree, and memory for the roots of its wrenches.
#[derive(Clone, Debug)]
pub(super) struct SubtreeRoot {
    /// Number of rows, in units of [`LANES`].
    pub(super) rows: usize,
    pub(super) links: Vec<Link>,
    /// The columns of correlated links and sensors.
    pub(super) column_blocks: Vec<ColumnBlock>,
    /// Links that are correlated with nothing else in this sub-tree: number, index in the sub-tree,
    /// and root (upper triangular).
    pub(super) independent: Vec<(usize, usize, Box<Root>)>,
    /// Per link, the covariance of the wrenches below it from the links in `independent`; then with
    /// what is uncertain in the readings at `ends` besides.
    pub(super) below_alone: Vec<Covariance6>,
    pub(super) below: Vec<Covariance6>,
    /// The sensors at its ends.
    pub(super) ends: Vec<End>,
    /// `W` of each link: six columns of `rows` each.
    pub(super) wrenches: Vec<Lanes>,
}

/// A link of a sub-tree.
#[derive(Clone, Debug)]
pub(super) struct Link {
    pub(super) link: usize,
    /// Place of its parent in the sub-tree; its own for the top.
    pub(super) parent: usize,
    /// The rows in which its `W` is not zero.
    pub(super) rows: Range<usize>,
}

/// A sensor at an end of a sub-tree.
#[derive(Clone, Copy, Debug)]
pub(super) struct End {
    pub(super) sensor: usize,
    /// The link that its wrench acts on, and the index of that in the sub-tree.
    pub(super) link: usize,
    pub(super) link_index: usize,
    /// Whether its offset enters the balance with a positive sign.
    pub(super) is_positive: bool,
}

impl SubtreeRoot {
    pub(super) fn new(structure: &Structure, number: usize, covariance: &Covariance) -> Self {
        let numbers: Vec<usize> = structure.links_of(number).collect();
        let index_of = |link: usize| {
            let index = numbers.iter().position(|&other| other == link);
            index.unwrap_or(0)
        };
        let sensors = structure.subtrees()[number].sensors.iter();
        let ends: Vec<End> = sensors
            .map(|sensor| End::new(structure, number, sensor, index_of))
            .collect();
        let (mut column_blocks, mut independent, mut rows) = (Vec::new(), Vec::new(), 0);
        for block in &covariance.blocks {
            let members = members(block, &ends, &numbers);
            let wanted = members.iter().flat_map(|own| own.columns.clone());
            let wanted: Vec<usize> = wanted.collect();
            if wanted.is_empty() || block.root.nrows() == 0 {
                continue;
            }
            let root = triangle(block.root.select_columns(&wanted));
            if let [
                BlockMember {
                    what: Member::Link(number),
                    link,
                    ..
                },
            ] = members.as_slice()
            {
                let at = |i, j| {
                    if i < root.nrows() && i <= j {
                        root[(i, j)]
                    } else {
                        0.0
                    }
                };
                let matrix = std::array::from_fn(|i| std::array::from_fn(|j| at(i, j)));
                independent.push((*number, index_of(*link), Box::new(matrix)));
                continue;
            }
            column_blocks.extend(blocks_of(block, members, &root, rows, index_of));
            rows += root.nrows().div_ceil(LANES);
        }
        let links = links(structure, &numbers, &column_blocks, index_of);
        let below = match independent.is_empty() && ends.is_empty() {
            true => Vec::new(),
            false => vec![Covariance6::default(); links.len()],
        };
        Self {
            wrenches: vec![[0.0; LANES]; 6 * rows * links.len()],
            below_alone: below.clone(),
            below,
            rows,
            links,
            column_blocks,
            independent,
            ends,
        }
    }

    /// Adds what is uncertain in the readings, given the variances of each sensor's channels.
    #[inline(always)]
    pub(super) fn add_readings(&mut self, solver: &Solver, readings: &[[f64; 6]]) {
        self.below.copy_from_slice(&self.below_alone);
        for end in &self.ends {
            let variances = readings[end.sensor];
            if variances == [0.0; 6] {
                continue;
            }
            let mut covariance = Covariance6::default();
            add_reading(&mut covariance, solver.sensor_pose(end.sensor), &variances);
            let mut index = end.link_index;
            loop {
                add_covariance(&mut self.below[index], &covariance);
                if index == 0 {
                    break;
                }
                index = self.links[index].parent;
            }
        }
    }

    /// Computes `W` of every link.
    #[inline(always)]
    pub(super) fn update<S: Simd>(&mut self, simd: S, solver: &Solver, kinematics: &Kinematics) {
        let rows = self.rows;
        for (link, wrenches) in self
            .links
            .iter()
            .zip(self.wrenches.chunks_exact_mut((6 * rows).max(1)))
        {
            for column in wrenches.chunks_exact_mut(rows.max(1)) {
                column[link.rows.clone()].fill([0.0; LANES]);
            }
        }
        for column_block in &self.column_blocks {
            let out = &mut self.wrenches[6 * rows * column_block.link_index..][..6 * rows];
            match column_block.what {
                Member::Link(link) => {
                    let coefficients = link_rows(kinematics.pose(link), kinematics.motion(link));
                    add_link(simd, out, rows, column_block, &coefficients);
                }
                Member::Sensor(sensor, is_positive) => {
                    add_offset(
                        simd,
                        out,
                        rows,
                        column_block,
                        solver.sensor_pose(sensor),
                        is_positive,
                    );
                }
                // Contained in the columns of its sensor.
                Member::Calibration => {}
            }
        }
        self.below_alone.fill(Covariance6::default());
        for (link, index, root) in &self.independent {
            let coefficients = link_rows(kinematics.pose(*link), kinematics.motion(*link));
            add_independent(&mut self.below_alone[*index], root, &coefficients);
        }
        for index in (1..self.below_alone.len()).rev() {
            let below = self.below_alone[index];
            add_covariance(&mut self.below_alone[self.links[index].parent], &below);
        }
        for index in (1..self.links.len()).rev() {
            let Link {
                parent,
                rows: range,
                ..
            } = self.links[index].clone();
            if range.is_empty() {
                continue;
            }
            let (before, after) = self.wrenches.split_at_mut(6 * rows * index);
            for axis in 0..6 {
                let below = &after[axis * rows..][range.clone()];
                let above = &mut before[6 * rows * parent + axis * rows..][range.clone()];
                let (above, below) = (vectors_mut::<S>(above), vectors::<S>(below));
                for (sum, value) in above.iter_mut().zip(below) {
                    *sum = simd.add_f32s(*sum, *value);
                }
            }
        }
    }

    /// `|W_l s - W_b h|^2`, `l` being the link at `index`.
    #[inline(always)]
    pub(super) fn variance<S: Simd>(
        &self,
        simd: S,
        index: usize,
        axis: &Motion,
        response: &Motion,
    ) -> f64 {
        self.correlated(simd, index, axis, response) + self.independent(index, axis, response)
    }

    /// The part of [`Self::variance`] from independent links, and from readings.
    #[inline(always)]
    fn independent(&self, index: usize, axis: &Motion, response: &Motion) -> f64 {
        let (Some(below), Some(all)) = (self.below.get(index), self.below.first()) else {
            return 0.0;
        };
        let (s, h) = (numbers(axis), numbers(response));
        let product = times(below, &s);
        if *response == Motion::zero() {
            return dot(&s, &product);
        }
        // If one side has no links, rounding errors of either sign remain.
        (dot(&s, &product) - 2.0 * dot(&h, &product) + dot(&h, &times(all, &h))).max(0.0)
    }

    /// The part of [`Self::variance`] from correlated links and sensors.
    #[inline(always)]
    fn correlated<S: Simd>(&self, simd: S, index: usize, axis: &Motion, response: &Motion) -> f64 {
        let own = self.links[index].rows.clone();
        let mut sum = simd.splat_f32s(0.0);
        if *response == Motion::zero() {
            let s = splat(simd, axis);
            let below = self.axes::<S>(index, &own);
            for i in 0..below[0].len() {
                let y = project(simd, &below, i, &s);
                sum = simd.mul_add_e_f32s(y, y, sum);
            }
        } else {
            let (s, minus_h) = (splat(simd, axis), splat(simd, &-*response));
            // Its rows are among those of the top link.
            let rows = self.links[0].rows.clone();
            for (part, is_own) in [
                (rows.start..own.start, false),
                (own.clone(), true),
                (own.end..rows.end, false),
            ] {
                let (all, below) = (self.axes::<S>(0, &part), self.axes::<S>(index, &part));
                for i in 0..all[0].len() {
                    let mut y = project(simd, &all, i, &minus_h);
                    if is_own {
                        y = simd.add_f32s(y, project(simd, &below, i, &s));
                    }
                    sum = simd.mul_add_e_f32s(y, y, sum);
                }
            }
        }
        f64::from(simd.reduce_sum_f32s(sum))
    }

    /// `W_b^T W_b`.
    #[inline(always)]
    pub(super) fn covariance_of_all<S: Simd>(&self, simd: S) -> Matrix6<f64> {
        let mut covariance = Matrix6::zeros();
        let Some(link) = self.links.first() else {
            return covariance;
        };
        let axes = self.axes::<S>(0, &link.rows);
        for i in 0..6 {
            for j in i..6 {
                let mut sum = simd.splat_f32s(0.0);
                for (a, b) in axes[i].iter().zip(axes[j]) {
                    sum = simd.mul_add_e_f32s(*a, *b, sum);
                }
                let independent = self.below.first().map_or(0.0, |below| below[i][j]);
                let sum = f64::from(simd.reduce_sum_f32s(sum)) + independent;
                (covariance[(i, j)], covariance[(j, i)]) = (sum, sum);
            }
        }
        covariance
    }

    /// `|W_b k|^2`.
    #[inline(always)]
    pub(super) fn variance_of_all<S: Simd>(&self, simd: S, motion: &Motion) -> f64 {
        if self.links.is_empty() || *motion == Motion::zero() {
            return 0.0;
        }
        self.variance(simd, 0, motion, &Motion::zero())
    }

    /// Some rows of the six columns of a link's `W`.
    #[inline(always)]
    fn axes<S: Simd>(&self, index: usize, rows: &Range<usize>) -> [&[S::f32s]; 6] {
        let all = &self.wrenches[6 * self.rows * index..][..6 * self.rows];
        let mut axes: [&[S::f32s]; 6] = [&[]; 6];
        if !rows.is_empty() {
            for (axis, column) in axes.iter_mut().zip(all.chunks_exact(self.rows)) {
                *axis = vectors::<S>(&column[rows.clone()]);
            }
        }
        axes
    }
}

impl End {
    fn new(
        structure: &Structure,
        subtree: usize,
        sensor: usize,
        index_of: impl Fn(usize) -> usize,
    ) -> Self {
        let cut = &structure.sensors()[sensor];
        let child = cut.joint() + 1;
        let is_above = structure.subtree_of(child) == Some(subtree);
        let link = match is_above {
            true => child,
            false => structure.parent_of(child),
        };
        Self {
            sensor,
            link,
            link_index: index_of(link),
            is_positive: is_above == (cut.sign() > 0.0),
        }
    }
}

/// A link or sensor of a sub-tree, in a block of the covariance.
struct BlockMember {
    what: Member,
    link: usize,
    /// Its columns of the block's root.
    columns: Range<usize>,
}

/// Those of a sub-tree in a block: sensors first, the columns of a calibration before its
/// sensor's, then links from the tips on.
fn members(block: &Block, ends: &[End], links: &[usize]) -> Vec<BlockMember> {
    let mut members = Vec::new();
    let offsets = LINK_PARAMETERS * block.links.len();
    for end in ends {
        let Some(i) = block.sensors.iter().position(|&s| s == end.sensor) else {
            continue;
        };
        let link = end.link;
        let mut first = offsets + 6 * block.sensors.len();
        for (sensor, kind) in &block.calibrations {
            if *sensor == end.sensor {
                let columns = first..first + kind.count();
                members.push(BlockMember {
                    what: Member::Calibration,
                    link,
                    columns,
                });
            }
            first += kind.count();
        }
        let first = offsets + 6 * i;
        members.push(BlockMember {
            what: Member::Sensor(end.sensor, end.is_positive),
            link,
            columns: first..first + 6,
        });
    }
    for &link in links.iter().rev() {
        if let Some(i) = block.links.iter().position(|&l| l == link) {
            members.push(BlockMember {
                what: Member::Link(link),
                link,
                columns: LINK_PARAMETERS * i..LINK_PARAMETERS * (i + 1),
            });
        }
    }
    members
}

/// The columns of a block's members, `root` in single precision, whose rows begin at `rows`.
fn blocks_of(
    block: &Block,
    members: Vec<BlockMember>,
    root: &DMatrix<f64>,
    rows: usize,
    index_of: impl Fn(usize) -> usize,
) -> Vec<ColumnBlock> {
    let (mut blocks, mut first) = (Vec::new(), 0);
    let mut calibration: Vec<Vec<Lanes>> = Vec::new();
    for BlockMember {
        what,
        link,
        columns,
    } in members
    {
        let end = (first + columns.len()).min(root.nrows());
        let count = end.div_ceil(LANES);
        // A value too large for single precision becomes infinite, and so does the deviation.
        #[allow(clippy::cast_possible_truncation, reason = "single precision suffices")]
        let at = |row: usize, column: usize| {
            if row < end {
                root[(row, column)] as f32
            } else {
                0.0
            }
        };
        let lanes_of = |column: usize| {
            (0..count).map(move |chunk| std::array::from_fn(|i| at(LANES * chunk + i, column)))
        };
        let lanes = first..first + columns.len();
        first += columns.len();
        if what == Member::Calibration {
            calibration = lanes.map(|column| lanes_of(column).collect()).collect();
            continue;
        }
        let lanes: Vec<Lanes> = lanes.flat_map(lanes_of).collect();
        let own = std::mem::take(&mut calibration);
        let mut kinds = block.calibrations.iter();
        let kind =
            kinds.find(|(sensor, _)| matches!(what, Member::Sensor(own, _) if own == *sensor));
        blocks.push(ColumnBlock {
            what,
            link_index: index_of(link),
            rows: rows..rows + count,
            calibration: kind.map(|(_, kind)| {
                Box::new(Calibrated {
                    offset: lanes.clone(),
                    unknowns: kind.unknowns().zip(own).collect(),
                })
            }),
            columns: lanes,
        });
    }
    blocks
}

/// The links of a sub-tree, and the rows in which their wrenches are not zero.
fn links(
    structure: &Structure,
    numbers: &[usize],
    column_blocks: &[ColumnBlock],
    index_of: impl Fn(usize) -> usize,
) -> Vec<Link> {
    let mut links: Vec<Link> = numbers
        .iter()
        .enumerate()
        .map(|(index, &link)| Link {
            link,
            parent: match index {
                0 => 0,
                _ => index_of(structure.parent_of(link)),
            },
            rows: 0..0,
        })
        .collect();
    for column_block in column_blocks {
        let link = &mut links[column_block.link_index];
        link.rows = hull(&link.rows, &column_block.rows);
    }
    for index in (1..links.len()).rev() {
        let (parent, below) = (links[index].parent, links[index].rows.clone());
        links[parent].rows = hull(&links[parent].rows, &below);
    }
    links
}

/// The smallest range that contains both.
fn hull(a: &Range<usize>, b: &Range<usize>) -> Range<usize> {
    match (a.is_empty(), b.is_empty()) {
        (true, _) => b.clone(),
        (_, true) => a.clone(),
        _ => a.start.min(b.start)..a.end.max(b.end),
    }
}
