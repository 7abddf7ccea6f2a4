//! The drive of a joint as a second opinion on its torque: its constant, its friction, its rotor,
//! and how they are found from the torque of the force/torque (F/T) sensors.
//!
//! # The model
//! A drive reports `s`, a torque \[Nm; N\] or a current \[A\]. With the torque `tau` of the joint,
//! on the link's side of the gear, and `sgn(dq) = tanh(dq / v0)`,
//!
//! ```text
//! K s = tau + (c + l |tau|) sgn(dq) + d dq + J ddq + b
//! ```
//!
//! | symbol | [`DriveModel::parameters`] | unit |
//! |---|---|---|
//! | `K` | constant: torque of the joint by the reported one, or by current | 1; Nm/A |
//! | `c` | Coulomb friction | Nm |
//! | `d` | viscous friction | Nm s/rad |
//! | `l` | load-dependent friction, by the torque that the gear transmits | 1 |
//! | `J` | inertia of the rotor times the square of the gear ratio | kg m^2 |
//! | `b` | offset of the report | Nm |
//!
//! (N, N/A, N s/m and kg for a prismatic joint.) Load-dependent friction is that of a gear whose
//! teeth press on each other (Gautier, Briot, "Global identification of joint drive gains and
//! dynamic parameters of robots", 2014; Hamon, Gautier, Garrec, "Dynamic identification of robots
//! with a dry friction model depending on load and velocity", 2010).
//!
//! # The fit
//! [`fit`] finds `s` as a linear function of `tau`, `sgn(dq)`, `dq`, `|tau| sgn(dq)`, `ddq` and
//! one, because the errors of `s` (friction that the model lacks) are much larger than those of
//! `tau`.
//! - Below `v0` the friction may have any value between `-c` and `c`, with a variance of `c^2 / 3`:
//!   such rows count less.
//! - Seconds in which something else acts (a push that no sensor sees) count less: their residuals
//!   have a Student distribution with four degrees of freedom.
//! - Residuals are correlated within a second, not between seconds: the covariance is that of the
//!   sums over seconds (the "sandwich" of cluster-robust statistics).
//! - The error of `tau` itself is that of the robot's parameters, and does not average out. The
//!   drive inherits it ([`DriveModel::inherited`]): it is part of the deviation of the drive's
//!   torque, and not of the difference between both.
//! - What a log does not show (friction of a joint that stood still) keeps a wide prior.

use nalgebra::{Matrix6, Vector6};
use proprio_identification::COULOMB_SPEED;
use proprio_topics::Nanos;

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

/// What a drive reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DriveSignal {
    /// A torque \[Nm; N\].
    Torque,
    /// A current \[A\].
    Current,
}

/// A joint's drive, as identified.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveModel {
    /// The joint.
    pub joint: String,
    /// What it reports.
    pub signal: DriveSignal,
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
pub struct DriveRow {
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
        "only {seconds} s, with stamps, have a valid torque and a report of the drive; \
         {LEAST_SECONDS} are needed"
    )]
    TooShort {
        /// How many seconds can be used.
        seconds: usize,
    },
    /// The report does not follow the torque: its constant may be zero.
    #[error(
        "what it reports does not follow the torque, which gives no constant to {SIGNIFICANT} \
         deviations; move the joint so that its torque changes more"
    )]
    Unrelated,
}

impl DriveModel {
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
        // At rest, it is anything between plus and minus friction.
        let friction = (coulomb + load * torque.abs()).powi(2) + self.covariance[(1, 1)];
        let beside = self.noise.powi(2) + friction / 3.0 * (1.0 - sign * sign);
        let variance =
            by_parameters.dot(&(self.covariance * by_parameters)) + beside / rest.powi(2);
        let [relative, offset] = self.inherited;
        (
            torque,
            [variance, (relative * torque).powi(2) + offset.powi(2)],
        )
    }

    /// Standard deviations of [`DriveModel::parameters`], with what they inherit.
    #[must_use]
    pub fn deviations(&self) -> [f64; 6] {
        let [relative, offset] = self.inherited;
        let inherited = [relative * self.parameters[0], 0.0, 0.0, 0.0, 0.0, offset];
        std::array::from_fn(|i| {
            let variance = self.covariance[(i, i)].max(0.0);
            (variance + inherited[i].powi(2)).sqrt()
        })
    }
}

impl DriveSignal {
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
/// torque, if that follows the joint's, else that of the current; `None` if the drive reports
/// neither.
///
/// # Errors
/// [`Unfit`], of the first that it reports.
pub fn fit(joint: &str, logs: &[Vec<DriveRow>]) -> Option<Result<DriveModel, Unfit>> {
    let is_reported = |signal: &DriveSignal| {
        let mut rows = logs.iter().flatten();
        rows.any(|row| signal.of(row.report).is_finite())
    };
    let signals = [DriveSignal::Torque, DriveSignal::Current].into_iter();
    let found = signals.filter(is_reported).map(|signal| {
        let fitted =
            |has_load| DriveFit::new(signal, logs, has_load).and_then(|fit| fit.drive(joint));
        fitted(true)
            .ok()
            .filter(|drive| {
                let load = drive.parameters[3];
                load > SIGNIFICANT * drive.deviations()[3] && load < 1.0
            })
            .map_or_else(|| fitted(false), Ok)
    });
    found.reduce(|first, second| first.or_else(|error| second.map_err(|_| error)))
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
    /// Variance of `tau`.
    torque: f64,
    /// How far the direction of friction is open: one at rest.
    rest: f64,
}

/// A fit of `s = x . theta`.
struct DriveFit {
    signal: DriveSignal,
    has_load: bool,
    seconds: Vec<Second>,
    /// RMS of `s`.
    report: f64,
    /// See [`DriveFit::wide`].
    prior: Matrix6<f64>,
    theta: Vector6<f64>,
    /// Variance of a residual in motion.
    variance: f64,
}

impl DriveFit {
    fn new(signal: DriveSignal, logs: &[Vec<DriveRow>], has_load: bool) -> Result<Self, Unfit> {
        let seconds = seconds(signal, logs, has_load);
        if seconds.len() < LEAST_SECONDS {
            return Err(Unfit::TooShort {
                seconds: seconds.len(),
            });
        }
        let mut fit = Self {
            signal,
            has_load,
            report: f64::NAN,
            prior: Matrix6::zeros(),
            seconds,
            theta: Vector6::zeros(),
            variance: f64::NAN,
        };
        fit.report = fit.rms(|row| row.s).max(f64::MIN_POSITIVE);
        fit.prior = fit.wide();
        // Before the first fit, residuals are taken to be as large as the report.
        fit.variance = fit.report.powi(2);
        Ok(fit)
    }

    fn rows(&self) -> impl Iterator<Item = (f64, &Equation)> {
        let seconds = self.seconds.iter();
        seconds.flat_map(|Second { equations, weight }| {
            equations.iter().map(move |row| (*weight, row))
        })
    }

    fn rms(&self, of: fn(&Equation) -> f64) -> f64 {
        let squares: f64 = self.rows().map(|(_, row)| of(row).powi(2)).sum();
        (squares / self.rows().count().max(1) as f64).sqrt()
    }

    fn residual(&self, row: &Equation) -> f64 {
        row.s - row.x.dot(&self.theta)
    }

    /// The variance of a row's residual: at rest, friction has any value between its limits.
    fn variance_of(&self, row: &Equation) -> f64 {
        let friction = self.theta[1] + self.theta[3] * row.x[0].abs();
        self.variance + friction.powi(2) / 3.0 * row.rest
    }

    /// Information matrix of the weighted rows and the prior, and the right-hand side.
    fn equations(&self) -> (Matrix6<f64>, Vector6<f64>) {
        let (mut information, mut right) = (self.prior, Vector6::zeros());
        for (of_second, row) in self.rows() {
            let weight = of_second / self.variance_of(row);
            information += weight * row.x * row.x.transpose();
            right += weight * row.s * row.x;
        }
        (information, right)
    }

    /// Precision of the prior about zero. Friction may be as large as the whole report, at 1 rad/s
    /// (1 m/s), and for a rotor at 1 rad/s^2; load-dependent friction as large as the torque. It
    /// gives what the log does not show a finite deviation, and weighs nothing beside a second of
    /// what it does show. The constant and the offset have ten times the deviation that their
    /// columns alone could explain.
    fn wide(&self) -> Matrix6<f64> {
        let report = self.report;
        let by_torque = report / self.rms(|row| row.x[0]).max(1e-9);
        let most = [
            10.0 * by_torque,
            report,
            report,
            by_torque,
            report,
            10.0 * report,
        ];
        Matrix6::from_diagonal(&Vector6::from(most).map(|most| most.powi(-2)))
    }

    /// One round: `theta`, then the variance, then what each second counts.
    fn improve(&mut self) -> Option<()> {
        let (information, right) = self.equations();
        self.theta = information.cholesky()?.solve(&right);
        // Squared, so that rows at rest, which show friction and no noise, drop out.
        let of_motion = |row: &Equation| (self.variance / self.variance_of(row)).powi(2);
        let (sum, weights) = self
            .rows()
            .fold((0.0, 0.0), |(sum, weights), (weight, row)| {
                let weight = weight * of_motion(row);
                (sum + weight * self.residual(row).powi(2), weights + weight)
            });
        let least = (LEAST_NOISE * self.report).powi(2);
        self.variance = (sum / weights).max(least);
        let weights = self.seconds.iter().map(|second| {
            let deviates = second.equations.iter();
            let deviates = deviates.map(|row| self.residual(row).powi(2) / self.variance_of(row));
            let mean = deviates.sum::<f64>() / second.equations.len() as f64;
            (NU + 1.0) / (NU + mean)
        });
        let weights: Vec<f64> = weights.collect();
        for (second, weight) in self.seconds.iter_mut().zip(weights) {
            second.weight = weight;
        }
        Some(())
    }

    /// The covariance of `theta`.
    fn covariance(&self) -> Option<Matrix6<f64>> {
        let (information, _) = self.equations();
        let inverse = information.try_inverse()?;
        let scatter: Matrix6<f64> = (self.seconds.iter())
            .map(|second| {
                let rows = second.equations.iter();
                let gradient: Vector6<f64> = rows
                    .map(|row| self.residual(row) * second.weight / self.variance_of(row) * row.x)
                    .sum();
                gradient * gradient.transpose()
            })
            .sum();
        let mut covariance = inverse * (self.few() * scatter + self.prior) * inverse;
        if !self.has_load {
            covariance.row_mut(3).fill(0.0);
            covariance.column_mut(3).fill(0.0);
        }
        Some(covariance)
    }

    /// By how much squared residuals are larger than they look, for so many unknowns.
    fn few(&self) -> f64 {
        let count = self.seconds.len() as f64;
        count / (count - if self.has_load { 6.0 } else { 5.0 })
    }

    fn drive(mut self, joint: &str) -> Result<DriveModel, Unfit> {
        (0..ROUNDS)
            .try_for_each(|_| self.improve())
            .ok_or(Unfit::Unrelated)?;
        let covariance = self.covariance().ok_or(Unfit::Unrelated)?;
        // From `s = theta . x` to `K s = ...`.
        let constant = 1.0 / self.theta[0];
        let mut parameters = [constant; 6];
        let mut by_theta = Matrix6::zeros();
        by_theta[(0, 0)] = -constant * constant;
        for (i, place) in parameters.iter_mut().enumerate().skip(1) {
            *place = self.theta[i] * constant;
            by_theta[(i, 0)] = -*place * constant;
            by_theta[(i, i)] = constant;
        }
        let error = self.rows().map(|(_, row)| row.torque).sum::<f64>();
        let error = (error / self.rows().count() as f64).sqrt();
        let drive = DriveModel {
            joint: joint.to_owned(),
            signal: self.signal,
            parameters,
            covariance: by_theta * covariance * by_theta.transpose(),
            inherited: [error / self.rms(|row| row.x[0]), error],
            noise: (self.variance * self.few()).sqrt() * constant.abs(),
        };
        match constant.abs() > SIGNIFICANT * drive.deviations()[0] {
            true => Ok(drive),
            false => Err(Unfit::Unrelated),
        }
    }
}

/// The usable rows, by second.
fn seconds(signal: DriveSignal, logs: &[Vec<DriveRow>], has_load: bool) -> Vec<Second> {
    let mut seconds: Vec<Second> = Vec::new();
    for log in logs {
        let mut last = None;
        for row in log {
            let s = signal.of(row.report);
            let numbers = [s, row.torque, row.deviation, row.velocity, row.acceleration];
            if numbers.iter().any(|number| !number.is_finite()) {
                continue;
            }
            let number = row.t.0.div_euclid(Nanos::from_millis(1000).0);
            if last.replace(number) != Some(number) {
                seconds.push(Second {
                    equations: Vec::new(),
                    weight: 1.0,
                });
            }
            let sign = (row.velocity / COULOMB_SPEED).tanh();
            let load = f64::from(u8::from(has_load)) * row.torque.abs() * sign;
            if let Some(second) = seconds.last_mut() {
                second.equations.push(Equation {
                    x: Vector6::new(row.torque, sign, row.velocity, load, row.acceleration, 1.0),
                    s,
                    torque: row.deviation.powi(2),
                    rest: 1.0 - sign * sign,
                });
            }
        }
    }
    seconds
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A drive with this model, and no uncertainty.
    fn exact(parameters: [f64; 6]) -> DriveModel {
        DriveModel {
            joint: "elbow".into(),
            signal: DriveSignal::Current,
            parameters,
            covariance: Matrix6::zeros(),
            inherited: [0.0; 2],
            noise: 0.0,
        }
    }

    /// What a drive reports by the equation of the module's page.
    fn report([k, c, d, l, j, b]: [f64; 6], tau: f64, dq: f64, ddq: f64) -> f64 {
        let sign = (dq / COULOMB_SPEED).tanh();
        (tau + (c + l * tau.abs()) * sign + d * dq + j * ddq + b) / k
    }

    /// Rows at 50 Hz of a joint that swings with a varying load, and rests for a fifth of the time.
    /// The drive reports `reports(t, report of the model)`.
    fn rows(
        parameters: [f64; 6],
        seconds: f64,
        reports: impl Fn(f64, f64) -> [f64; 2],
    ) -> Vec<DriveRow> {
        let row = |number: u32| {
            let t = 0.02 * f64::from(number);
            let moves = if t % 5.0 < 4.0 { 1.0 } else { 0.0 };
            let (velocity, acceleration) = (
                moves * (1.3 * t).sin() * (1.0 + 0.5 * (0.37 * t).cos()),
                moves * 1.5 * (1.7 * t).cos(),
            );
            let torque = 4.0 * (0.61 * t).sin() + 2.0 * (2.3 * t).cos();
            DriveRow {
                t: Nanos::from_seconds(t),
                report: reports(t, report(parameters, torque, velocity, acceleration)),
                torque,
                deviation: 0.01,
                velocity,
                acceleration,
            }
        };
        (0..(50.0 * seconds) as u32).map(row).collect()
    }

    const MODEL: [f64; 6] = [2.5, 0.8, 0.3, 0.06, 0.05, -0.2];

    proptest! {
        /// From the torque to the report and back.
        #[test]
        fn the_torque_of_a_report_is_the_one_that_it_was_made_from(
            k in prop_oneof![0.1..20.0_f64, -20.0..-0.1_f64], c in 0.0..3.0_f64,
            d in 0.0..2.0_f64, l in 0.0..0.5_f64, j in 0.0..1.0_f64, b in -2.0..2.0_f64,
            tau in -50.0..50.0_f64, dq in -2.0..2.0_f64, ddq in -9.0..9.0_f64,
        ) {
            let parameters = [k, c, d, l, j, b];
            let s = report(parameters, tau, dq, ddq);
            let (torque, _) = exact(parameters).torque(s, dq, ddq);
            prop_assert!((torque - tau).abs() < 1e-9 * (1.0 + tau.abs()), "{torque} {tau}");
        }
    }

    #[test]
    fn a_report_without_noise_gives_the_model() {
        let found = fit("elbow", &[rows(MODEL, 40.0, |_, s| [f64::NAN, s])]);
        let found = found.unwrap().unwrap();
        assert_eq!(found.signal, DriveSignal::Current);
        for (found, expected) in found.parameters.into_iter().zip(MODEL) {
            assert!((found - expected).abs() < 2e-3, "{found} {expected}");
        }
        assert!(found.noise < 1e-3, "{}", found.noise);
    }

    /// Noise and ripple are within their deviations, and a second in which something else acts does
    /// not matter.
    #[test]
    fn the_stated_deviations_cover_the_errors() {
        let disturbed = |t: f64, s: f64| {
            let ripple = 0.05 * (97.0 * t).sin() + 0.03 * (311.0 * t + 1.0).sin();
            let push = if (20.0..22.0).contains(&t) { 3.0 } else { 0.0 };
            [f64::NAN, s + ripple + push]
        };
        let found = fit("elbow", &[rows(MODEL, 60.0, disturbed)]);
        let found = found.unwrap().unwrap();
        for ((own, deviation), expected) in (found.parameters.into_iter())
            .zip(found.deviations())
            .zip(MODEL)
        {
            assert!(
                (own - expected).abs() < 4.0 * deviation,
                "{own} {deviation} {expected}"
            );
            assert!(deviation < 0.1, "{deviation}");
        }
        let noise = 2.5 * f64::hypot(0.05, 0.03) / f64::sqrt(2.0);
        assert!(
            (0.7..1.6).contains(&(found.noise / noise)),
            "{} {noise}",
            found.noise
        );
    }

    #[test]
    fn without_a_load_in_the_data_there_is_none_in_the_model() {
        let [k, c, d, _, j, b] = MODEL;
        let noisy = |t: f64, s: f64| [s + 0.05 * (97.0 * t).sin(), f64::NAN];
        let found = fit("elbow", &[rows([k, c, d, 0.0, j, b], 40.0, noisy)]);
        let found = found.unwrap().unwrap();
        assert_eq!(
            (found.signal, found.parameters[3]),
            (DriveSignal::Torque, 0.0)
        );
        assert_eq!(found.deviations()[3], 0.0);
    }

    /// A torque that is none is not the end: the current may do.
    #[test]
    fn the_report_that_follows_the_torque_is_used() {
        let both = fit("elbow", &[rows(MODEL, 40.0, |_, s| [0.0, s])]);
        assert_eq!(both.unwrap().unwrap().signal, DriveSignal::Current);
        let constant = fit("elbow", &[rows(MODEL, 40.0, |_, _| [1.5, f64::NAN])]);
        assert_eq!(constant, Some(Err(Unfit::Unrelated)));
        let short = fit("elbow", &[rows(MODEL, 8.0, |_, s| [s, f64::NAN])]);
        assert_eq!(short, Some(Err(Unfit::TooShort { seconds: 8 })));
        let none = fit("elbow", &[rows(MODEL, 40.0, |_, _| [f64::NAN; 2])]);
        assert_eq!(none, None);
    }

    /// A joint that never moved keeps a friction that may be as large as the report.
    #[test]
    fn what_a_log_does_not_show_stays_uncertain() {
        let mut still = rows(MODEL, 40.0, |_, s| [s, f64::NAN]);
        for row in &mut still {
            (row.velocity, row.acceleration) = (0.0, 0.0);
            row.report = [report(MODEL, row.torque, 0.0, 0.0), f64::NAN];
        }
        let found = fit("elbow", &[still]).unwrap().unwrap();
        let (_, [moving, _]) = found.torque(1.0, 1.0, 0.0);
        let (_, [resting, _]) = found.torque(1.0, 0.0, 0.0);
        assert!(moving > 1.0 && resting > 0.5, "{moving} {resting}");
    }

    /// At rest, anything between plus and minus friction is possible.
    #[test]
    fn friction_at_rest_is_part_of_the_deviation() {
        let (_, [resting, inherited]) = exact(MODEL).torque(0.0, 0.0, 0.0);
        let torque: f64 = 0.2;
        let expected = (0.8 + 0.06 * torque).powi(2) / 3.0;
        assert!(
            (resting - expected).abs() < 1e-12 && inherited == 0.0,
            "{resting} {expected}"
        );
        let (_, [moving, _]) = exact(MODEL).torque(0.0, 1.0, 0.0);
        assert!(moving < 1e-12, "{moving}");
    }
}
