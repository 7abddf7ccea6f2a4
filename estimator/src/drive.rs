//! The drive of a joint as a second opinion on its torque: its constant, its friction, its rotor,
//! and how they are found from the torque of the force/torque (F/T) sensors.
//!
//! # The model
//! A drive reports `s`, a torque \[Nm; N\] or a current \[A\]. With the torque `tau` of the joint, on
//! the link's side of the gear, and `sgn(dq) = tanh(dq / v0)`,
//!
//! ```text
//! K s = tau + (c + l |tau|) sgn(dq) + d dq + J ddq + b
//! ```
//!
//! | symbol | [`Drive::parameters`] | unit |
//! |---|---|---|
//! | `K` | constant: torque of the joint by the reported one, or by current | 1; Nm/A |
//! | `c` | Coulomb friction | Nm |
//! | `d` | viscous friction | Nm s/rad |
//! | `l` | load-dependent friction, by the torque that the gear transmits | 1 |
//! | `J` | inertia of the rotor times the square of the gear ratio | kg m^2 |
//! | `b` | offset of the report | Nm |
//!
//! (N, N/A, N s/m and kg for a prismatic joint.) Load-dependent friction is that of a gear whose
//! teeth press on each other (Gautier, Janot, "Global identification of drive gains parameters of
//! robots using a known payload", 2014; Hamon et al., "Dynamic identification of robots with a dry
//! friction model depending on load and velocity", 2010).
//!
//! # The fit
//! [`fit`] finds `s` as a linear function of `tau`, `sgn(dq)`, `dq`, `|tau| sgn(dq)`, `ddq` and one,
//! because the errors of `s` (friction that the model lacks) are much larger than those of `tau`.
//! - Below `v0` the friction may have any value between `-c` and `c`: such rows count less by that
//!   variance.
//! - Seconds in which something else acts (a push that no sensor sees) count less: their residuals
//!   have a Student distribution with [`NU`] degrees of freedom.
//! - Residuals are correlated within a second, not between seconds: the covariance is that of the
//!   sums over seconds (the "sandwich" of cluster-robust statistics).
//! - The error of `tau` itself is that of the robot's parameters, and does not average out. The
//!   drive inherits it ([`Drive::inherited`]): it is part of the deviation of the drive's torque,
//!   and not of the difference between both.
//! - What a log does not show (friction of a joint that stood still) keeps its prior, [`prior`].

use crate::config::Timing;
use crate::offline::{self, OfflineError};
use crate::setup::Setup;
use nalgebra::{Matrix6, Vector6};
use proprio_identification::COULOMB_SPEED;
use proprio_topics::Nanos;
use std::io::Read;
use std::ops::ControlFlow;

/// Degrees of freedom of the distribution of a second's residuals: between 3 and 5 is usual in
/// robust regression (Lange, Little, Taylor 1989).
const NU: f64 = 4.0;

/// Rounds of weighting. The weights change by less than a per cent after four.
const ROUNDS: usize = 8;

/// The fewest seconds that six unknowns and their deviations are found from: twice as many.
const LEAST_SECONDS: usize = 12;

/// A constant differs from zero, and load-dependent friction is part of the model, if it is as many
/// deviations from zero: by chance, that happens to one drive in 370.
const SIGNIFICANT: f64 = 3.0;

/// The least noise, by the RMS of the report: that of numbers with 16 bits.
const LEAST_NOISE: f64 = 1e-5;

/// The least time between two rows: friction and load change no faster than a joint moves.
const ROW_PERIOD: Nanos = Nanos::from_millis(10);

/// What a drive reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Signal {
    /// A torque \[Nm; N\].
    Torque,
    /// A current \[A\].
    Current,
}

/// A joint's drive, as identified.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// The joint.
    pub joint: String,
    /// What it reports.
    pub signal: Signal,
    /// `K, c, d, l, J, b`, see [`crate::drive`].
    pub parameters: [f64; 6],
    /// Their covariance, if the torques that they were found from are exact.
    pub covariance: Matrix6<f64>,
    /// What it inherits from the errors of these torques: a relative standard deviation of `K`, and
    /// one of `b` \[Nm; N\].
    pub inherited: [f64; 2],
    /// Standard deviation of what the model does not explain \[Nm; N\].
    pub noise: f64,
}

/// What a joint and its drive do at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// The instant.
    pub t: Nanos,
    /// What the drive reports: torque \[Nm; N\] and current \[A\], NaN where it reports none.
    pub report: [f64; 2],
    /// The torque by the F/T sensors \[Nm; N\], and its standard deviation.
    pub torque: f64,
    /// See `torque`.
    pub deviation: f64,
    /// Velocity of the joint \[rad/s; m/s\].
    pub velocity: f64,
    /// Acceleration of the joint \[rad/s^2; m/s^2\].
    pub acceleration: f64,
}

/// Why no drive can be identified.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Unfit {
    /// Too little of the log can be used.
    #[error(
        "only {seconds} s have a valid torque and a report of the drive; {LEAST_SECONDS} are needed"
    )]
    TooShort {
        /// How many seconds can be used.
        seconds: usize,
    },
    /// The report does not follow the torque.
    #[error(
        "what it reports does not follow the torque: its constant is known to {:.0} % only. Move \
         the joint so that its torque changes more", 100.0 * .relative
    )]
    Uncertain {
        /// Relative deviation of the constant.
        relative: f64,
    },
}

impl Drive {
    /// The torque of the joint by its drive \[Nm; N\], from what it reports and the joint's motion;
    /// and two variances: the second is what it inherits.
    #[must_use]
    pub fn torque(&self, report: f64, velocity: f64, acceleration: f64) -> (f64, [f64; 2]) {
        let [constant, coulomb, viscous, load, rotor, offset] = self.parameters;
        let sign = (velocity / COULOMB_SPEED).tanh();
        let free =
            constant * report - coulomb * sign - viscous * velocity - rotor * acceleration - offset;
        // Of the torque with its own friction; a gear that loses all of it transmits none.
        let rest = (1.0 + load * sign * free.signum()).max(0.1);
        let torque = free / rest;
        let by_parameters = Vector6::new(
            report,
            -sign,
            -velocity,
            -torque.abs() * sign,
            -acceleration,
            -1.0,
        ) / rest;
        // At rest, friction holds whatever is less than it.
        let stiction = (coulomb + load * torque.abs()).powi(2) * (1.0 - sign * sign);
        let variance =
            by_parameters.dot(&(self.covariance * by_parameters)) + self.noise.powi(2) + stiction;
        let [relative, offset] = self.inherited;
        (
            torque,
            [variance, (relative * torque).powi(2) + offset.powi(2)],
        )
    }

    /// Standard deviations of [`Drive::parameters`], with what they inherit.
    #[must_use]
    pub fn deviations(&self) -> [f64; 6] {
        let [relative, offset] = self.inherited;
        let inherited = [relative * self.parameters[0], 0.0, 0.0, 0.0, 0.0, offset];
        std::array::from_fn(|i| {
            let own = self.covariance[(i, i)].max(0.0);
            (own + inherited[i].powi(2)).sqrt()
        })
    }
}

impl Signal {
    /// Its value in a report.
    #[must_use]
    pub const fn of(self, [torque, current]: [f64; 2]) -> f64 {
        match self {
            Self::Torque => torque,
            Self::Current => current,
        }
    }
}

/// Finds the drive of a joint from logs, each with its rows in order. It is that of the reported
/// torque, if there is one, else that of the current; `None` if the drive reports neither.
///
/// # Errors
/// [`Unfit`].
pub fn fit(joint: &str, logs: &[Vec<Row>]) -> Option<Result<Drive, Unfit>> {
    let has = |signal: Signal| {
        let mut rows = logs.iter().flatten();
        rows.any(|row| signal.of(row.report).is_finite())
    };
    let signal = [Signal::Torque, Signal::Current]
        .into_iter()
        .find(|signal| has(*signal))?;
    let with_load = fitted(joint, signal, logs, true);
    Some(with_load.and_then(|drive| {
        let load = drive.parameters[3];
        let is_asked = load > SIGNIFICANT * drive.deviations()[3] && load < 1.0;
        match is_asked {
            true => Ok(drive),
            false => fitted(joint, signal, logs, false),
        }
    }))
}

/// What joints and drives do in a log, by degree of freedom, as the estimator with this `setup`
/// sees it; at most one row in [`ROW_PERIOD`].
///
/// # Errors
/// As for [`offline::follow`].
pub fn rows(setup: &Setup, log: impl Read) -> Result<Vec<Vec<Row>>, OfflineError> {
    let mut rows: Vec<Vec<Row>> = vec![Vec::new(); setup.robot.model.dof_count()];
    let mut setup = setup.clone();
    setup.drives.clear();
    setup.learns_drives = true;
    // A log has the samples that a running estimator would have to wait for.
    setup.timing = Timing::Aligned;
    offline::follow(setup, log, |pipeline, is_stamped| {
        for (dof, row) in pipeline.drive_rows() {
            if let Some(own) = rows.get_mut(dof)
                && own.last().is_none_or(|last| row.t >= last.t + ROW_PERIOD)
            {
                own.push(row);
            }
        }
        // Friction needs velocities, and seconds.
        Ok(match is_stamped {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(()),
        })
    })?;
    Ok(rows)
}

/// A second of a log: its rows as equations `s = x . theta`.
struct Second {
    equations: Vec<Equation>,
    /// How much it counts, by its residuals.
    weight: f64,
}

struct Equation {
    x: Vector6<f64>,
    s: f64,
    /// Variance of `tau`, and of the sign of the velocity.
    torque: f64,
    sign: f64,
}

fn fitted(joint: &str, signal: Signal, logs: &[Vec<Row>], has_load: bool) -> Result<Drive, Unfit> {
    let mut seconds = seconds(signal, logs, has_load);
    if seconds.len() < LEAST_SECONDS {
        return Err(Unfit::TooShort {
            seconds: seconds.len(),
        });
    }
    let unknowns = if has_load { 6.0 } else { 5.0 };
    let count = seconds.len() as f64;
    let (prior, report) = prior(&seconds);
    let (mut theta, mut variance) = (Vector6::zeros(), f64::NAN);
    let mut inverse = Matrix6::zeros();
    // The variance of a row's residual.
    let of_row = |theta: &Vector6<f64>, row: &Equation, variance: f64| {
        let tau = row.x[0].abs();
        variance + (theta[1] + theta[3] * tau).powi(2) * row.sign
    };
    for round in 0..ROUNDS {
        let weigh = |row: &Equation, of_second: f64| match round {
            0 => 1.0,
            _ => of_second / of_row(&theta, row, variance),
        };
        // Before the first fit, residuals are taken to be as large as the report.
        let (mut information, mut right) = (prior, Vector6::zeros());
        if round == 0 {
            information *= report.powi(2);
        }
        for second in &seconds {
            for row in &second.equations {
                let weight = weigh(row, second.weight);
                information += weight * row.x * row.x.transpose();
                right += weight * row.s * row.x;
            }
        }
        let Some(inverted) = information.try_inverse() else {
            return Err(Unfit::Uncertain {
                relative: f64::INFINITY,
            });
        };
        (theta, inverse) = (inverted * right, inverted);
        let residual = |row: &Equation| row.s - row.x.dot(&theta);
        // Rows count by how little friction at rest can have to do with them.
        let before = if round == 0 { report.powi(2) } else { variance };
        let (mut sum, mut weights) = (0.0, f64::MIN_POSITIVE);
        for second in &seconds {
            for row in &second.equations {
                let weight = second.weight * before / of_row(&theta, row, before);
                sum += weight * residual(row).powi(2);
                weights += weight;
            }
        }
        variance = (sum / weights).max(LEAST_NOISE.powi(2) * report.powi(2));
        for second in &mut seconds {
            let rows = second.equations.iter();
            let deviates =
                rows.map(|row| (row.s - row.x.dot(&theta)).powi(2) / of_row(&theta, row, variance));
            let mean = deviates.sum::<f64>() / second.equations.len() as f64;
            second.weight = (NU + 1.0) / (NU + mean);
        }
    }
    let mut scatter = Matrix6::zeros();
    for second in &seconds {
        let rows = second.equations.iter();
        let gradient: Vector6<f64> = rows
            .map(|row| {
                let weight = second.weight / of_row(&theta, row, variance);
                weight * (row.s - row.x.dot(&theta)) * row.x
            })
            .sum();
        scatter += gradient * gradient.transpose();
    }
    let few = count / (count - unknowns);
    let mut covariance = inverse * (scatter * few + prior) * inverse;
    if !has_load {
        covariance.row_mut(3).fill(0.0);
        covariance.column_mut(3).fill(0.0);
    }
    let rows = || seconds.iter().flat_map(|second| &second.equations);
    let mean = |of: fn(&Equation) -> f64| rows().map(of).sum::<f64>() / rows().count() as f64;
    let (torque, error) = (mean(|row| row.x[0] * row.x[0]), mean(|row| row.torque));
    let drive = physical(joint, signal, &theta, &covariance, (variance * few).sqrt());
    let Some(mut drive) = drive else {
        return Err(Unfit::Uncertain {
            relative: f64::INFINITY,
        });
    };
    drive.inherited = [(error / torque).sqrt(), error.sqrt()];
    let relative = drive.deviations()[0] / drive.parameters[0].abs();
    match SIGNIFICANT * relative <= 1.0 {
        true => Ok(drive),
        false => Err(Unfit::Uncertain { relative }),
    }
}

/// The usable rows, by second.
fn seconds(signal: Signal, logs: &[Vec<Row>], has_load: bool) -> Vec<Second> {
    let mut seconds = Vec::new();
    for log in logs {
        let mut last = None;
        for row in log {
            let s = signal.of(row.report);
            let numbers = [s, row.torque, row.deviation, row.velocity, row.acceleration];
            if numbers.iter().any(|number| !number.is_finite()) {
                continue;
            }
            let second = row.t.0.div_euclid(Nanos::from_millis(1000).0);
            if last != Some(second) {
                last = Some(second);
                seconds.push(Second {
                    equations: Vec::new(),
                    weight: 1.0,
                });
            }
            let sign = (row.velocity / COULOMB_SPEED).tanh();
            let load = if has_load {
                row.torque.abs() * sign
            } else {
                0.0
            };
            if let Some(second) = seconds.last_mut() {
                second.equations.push(Equation {
                    x: Vector6::new(row.torque, sign, row.velocity, load, row.acceleration, 1.0),
                    s,
                    torque: row.deviation.powi(2),
                    sign: 1.0 - sign * sign,
                });
            }
        }
    }
    seconds
}

/// Precision of the prior about zero, and the RMS of the report. Friction may be as large as the
/// whole report, at 1 rad/s (1 m/s), and for a rotor at 1 rad/s^2; load-dependent friction as large
/// as the torque. It gives what the log does not show a finite deviation, and weighs nothing beside
/// a second of what it does show. The constant and the offset have ten times the deviation that
/// their columns alone could explain.
fn prior(seconds: &[Second]) -> (Matrix6<f64>, f64) {
    let rows = || seconds.iter().flat_map(|second| &second.equations);
    let rms = |of: fn(&Equation) -> f64| {
        let squares = rows().map(|row| of(row).powi(2)).sum::<f64>();
        (squares / rows().count().max(1) as f64).sqrt()
    };
    let report = rms(|row| row.s).max(f64::MIN_POSITIVE);
    let by_torque = report / rms(|row| row.x[0]).max(1e-9);
    let most = Vector6::new(
        10.0 * by_torque,
        report,
        report,
        by_torque,
        report,
        10.0 * report,
    );
    (
        Matrix6::from_diagonal(&most.map(|most| most.powi(-2))),
        report,
    )
}

/// The drive with `s = theta . x`, whose residuals have the standard deviation `noise` in units of
/// the report.
fn physical(
    joint: &str,
    signal: Signal,
    theta: &Vector6<f64>,
    covariance: &Matrix6<f64>,
    noise: f64,
) -> Option<Drive> {
    let constant = 1.0 / theta[0];
    if !constant.is_finite() {
        return None;
    }
    let mut parameters = [0.0; 6];
    let mut by_theta = Matrix6::zeros();
    for (i, place) in parameters.iter_mut().enumerate() {
        let own = if i == 0 { 1.0 } else { theta[i] };
        *place = own * constant;
        by_theta[(i, 0)] = -own * constant * constant;
        if i > 0 {
            by_theta[(i, i)] = constant;
        }
    }
    Some(Drive {
        joint: joint.to_owned(),
        signal,
        parameters,
        covariance: by_theta * covariance * by_theta.transpose(),
        inherited: [0.0; 2],
        noise: noise * constant.abs(),
    })
}
