//! The covariance of inertial parameters and F/T offsets, in independent blocks.

use nalgebra::{Cholesky, DMatrix};
use proprio_dynamics::calibration::Kind;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::{DynamicsError, check_size};
use proprio_topics::Nanos;

/// Covariance `P` of inertial parameters and F/T offsets, in mutually independent blocks, each
/// given by a root `U`, `P = U^T U`.
///
/// Parameters and offsets in no block are exact.
#[derive(Clone, Debug, PartialEq)]
pub struct Covariance {
    pub(crate) blocks: Vec<Block>,
    pub(crate) drifts: Vec<Drift>,
    /// Which links and which sensors are in a block.
    pub(crate) links: Vec<bool>,
    pub(crate) sensors: Vec<bool>,
}

/// Links and sensors whose parameters and offsets are correlated.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Block {
    pub(crate) links: Vec<usize>,
    pub(crate) sensors: Vec<usize>,
    pub(crate) calibrations: Vec<(usize, Kind)>,
    pub(crate) root: DMatrix<f64>,
}

/// The drift (random walk) of an offset from its identified value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Drift {
    /// Increase of each channel's variance per second [torque; force] [Nm^2/s, N^2/s].
    pub(crate) rate: [f64; 6],
    /// The instant of the identified value.
    pub(crate) known: Known,
}

/// The instant at which an offset had its identified value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Known {
    /// An instant of the running clock.
    At(Nanos),
    /// The end of a log with this first and last stamp, whose clock may be another one.
    InLog(Nanos, Nanos),
}

impl Known {
    /// The time for which an offset has drifted at `t`, if the run began at `run_start` \[s\].
    pub(crate) fn elapsed(self, t: Nanos, run_start: Nanos) -> f64 {
        let between = |a: Nanos, b: Nanos| a.saturating_sub(b).seconds().abs();
        match self {
            Self::At(known) => between(t, known),
            // The running clock is before the log: so it is another clock, and its difference to
            // the log's stamps says nothing about the elapsed time.
            Self::InLog(first, _) if t < first => between(t, run_start),
            // The same clock, or another one with similar stamps: at least the time since the run
            // began.
            Self::InLog(_, last) => between(t, last).max(between(t, run_start)),
        }
    }
}

impl Covariance {
    /// No uncertainty, for a model with this number of links and sensors.
    pub fn exact(links: usize, sensors: usize) -> Self {
        let still = Drift {
            rate: [0.0; 6],
            known: Known::At(Nanos::ZERO),
        };
        Self {
            blocks: Vec::new(),
            drifts: vec![still; sensors],
            links: vec![false; links],
            sensors: vec![false; sensors],
        }
    }

    /// Adds a block: columns ten per link, then six per sensor [torque; force], both in the order
    /// given. `root` is any matrix `U` for which `U^T U` is their covariance.
    ///
    /// # Errors
    /// A link or sensor that does not exist or already has a block; a root of another width, or one
    /// that is not finite. Nothing is changed then.
    pub fn add(
        &mut self,
        links: &[usize],
        sensors: &[usize],
        root: DMatrix<f64>,
    ) -> Result<(), DynamicsError> {
        self.add_calibrated(links, sensors, &[], root)
    }

    /// The same if calibrations of some of these sensors are uncertain, too: the columns of
    /// [`Kind::unknowns`] follow those of the offsets, sensor by sensor as given.
    ///
    /// # Errors
    /// As [`Covariance::add`]; a calibration of a sensor that is not among `sensors`.
    pub fn add_calibrated(
        &mut self,
        links: &[usize],
        sensors: &[usize],
        calibrations: &[(usize, Kind)],
        root: DMatrix<f64>,
    ) -> Result<(), DynamicsError> {
        let of_calibrations: usize = calibrations.iter().map(|(_, kind)| kind.count()).sum();
        check_size(
            "columns of a covariance",
            root.ncols(),
            LINK_PARAMETERS * links.len() + 6 * sensors.len() + of_calibrations,
        )?;
        if let Some((sensor, _)) = calibrations
            .iter()
            .find(|(sensor, _)| !sensors.contains(sensor))
        {
            return Err(DynamicsError::Index {
                what: "sensors with an offset in the same covariance",
                index: *sensor,
                count: sensors.len(),
            });
        }
        if let Some(index) = root.iter().position(|value| !value.is_finite()) {
            return Err(DynamicsError::NotFinite {
                what: "number of a covariance",
                index,
            });
        }
        let (mut with_links, mut with_sensors) = (self.links.clone(), self.sensors.clone());
        mark("links without a covariance", links, &mut with_links)?;
        mark("sensors without a covariance", sensors, &mut with_sensors)?;
        (self.links, self.sensors) = (with_links, with_sensors);
        self.blocks.push(Block {
            links: links.to_vec(),
            sensors: sensors.to_vec(),
            calibrations: calibrations.to_vec(),
            root,
        });
        Ok(())
    }

    /// Sets the drift of a sensor's offset from its value at `known`, an instant of the running
    /// clock: standard deviations [torque; force] after one second [Nm/s^½, N/s^½].
    /// They grow with the square root of the time since, or until, that instant.
    ///
    /// # Errors
    /// The sensor does not exist, or a number is not finite or is negative.
    pub fn set_drift(
        &mut self,
        sensor: usize,
        rate: [f64; 6],
        known: Nanos,
    ) -> Result<(), DynamicsError> {
        self.drift(sensor, rate, Known::At(known))
    }

    /// The same for an offset identified from a log with this first and last stamp. The log's clock
    /// may differ from the running one (another machine, or a restart). So time counts from the
    /// first instant given to [`Propagation::update`](super::Propagation::update), or from the end
    /// of the log, whichever is earlier. If the running clock is before the log's first stamp, the
    /// clocks differ, and time counts from the first instant alone.
    ///
    /// # Errors
    /// As for [`Covariance::set_drift`].
    pub fn set_drift_of_log(
        &mut self,
        sensor: usize,
        rate: [f64; 6],
        (first, last): (Nanos, Nanos),
    ) -> Result<(), DynamicsError> {
        self.drift(sensor, rate, Known::InLog(first, last))
    }

    pub(crate) fn drift(
        &mut self,
        sensor: usize,
        rate: [f64; 6],
        known: Known,
    ) -> Result<(), DynamicsError> {
        let count = self.drifts.len();
        let place = self.drifts.get_mut(sensor).ok_or(DynamicsError::Index {
            what: "sensors",
            index: sensor,
            count,
        })?;
        if let Some(index) = rate
            .iter()
            .position(|rate| !(rate.is_finite() && *rate >= 0.0))
        {
            return Err(DynamicsError::NotFinite {
                what: "rate of a drift",
                index,
            });
        }
        *place = Drift {
            rate: rate.map(|rate| rate * rate),
            known,
        };
        Ok(())
    }

    /// Whether a link's parameters are in a block.
    pub fn has_link(&self, link: usize) -> bool {
        self.links.get(link).is_some_and(|there| *there)
    }

    /// All of `P`, over `[10 per link | 6 per sensor]`, without drift and without calibrations.
    pub fn dense(&self) -> DMatrix<f64> {
        let (links, sensors) = (self.links.len(), self.sensors.len());
        let mut all = DMatrix::zeros(
            LINK_PARAMETERS * links + 6 * sensors,
            LINK_PARAMETERS * links + 6 * sensors,
        );
        for block in &self.blocks {
            let columns: Vec<usize> = block.model_columns(links).collect();
            let covariance = block.root.transpose() * &block.root;
            for (i, &row) in columns.iter().enumerate() {
                for (j, &column) in columns.iter().enumerate() {
                    all[(row, column)] = covariance[(i, j)];
                }
            }
        }
        all
    }
}

/// Marks these links or sensors as taken; an error if one does not exist or is taken already.
pub(crate) fn mark(
    what: &'static str,
    numbers: &[usize],
    places: &mut [bool],
) -> Result<(), DynamicsError> {
    let count = places.len();
    for &index in numbers {
        match places.get_mut(index) {
            Some(taken) if !*taken => *taken = true,
            _ => return Err(DynamicsError::Index { what, index, count }),
        }
    }
    Ok(())
}

impl Block {
    /// Its columns among those of the whole model.
    pub(crate) fn model_columns(&self, links: usize) -> impl Iterator<Item = usize> {
        let of_links = self
            .links
            .iter()
            .flat_map(|&l| LINK_PARAMETERS * l..LINK_PARAMETERS * (l + 1));
        let of_sensors = self.sensors.iter().flat_map(move |&s| {
            LINK_PARAMETERS * links + 6 * s..LINK_PARAMETERS * links + 6 * (s + 1)
        });
        of_links.chain(of_sensors)
    }
}

/// The upper triangle `R` with `R^T R = U^T U`. Uses the Cholesky factor of the product if that is
/// positive definite: this is fast, and accurate enough for single precision.
pub(crate) fn triangle(root: DMatrix<f64>) -> DMatrix<f64> {
    match Cholesky::new(root.transpose() * &root) {
        Some(factor) => factor.l().transpose(),
        None => root.qr().r(),
    }
}
