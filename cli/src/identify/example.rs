//! An outcome made by hand for tests: something in every part of it, long names, numbers that are
//! not there.

use proprio_dynamics::calibration::{
    Calibration, Gain, Kind, Unknown, force_first, gain_from_force_first,
};
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_identification::{
    BaseParameterOutcome, Both, CalibrationOutcome, ChannelNoise, CovarianceRoot, Curve, Excluded,
    Finding, FindingCode, FrictionOutcome, JointOutcome, LinkOutcome, LogOutcome, LogRole,
    ModelComparison, OffsetOutcome, Outcome, Predicted, RotorOutcome, SensorOutcome, Severity,
    TimeOffset, TwoRouteOutcome, Verdict, WeakDirection,
};
use proprio_topics::Nanos;

const JOINTS: [&str; 3] = ["r_hip_yaw", "r_knee", "r_ankle_pitch_with_a_long_name"];
const LINKS: [&str; 4] = ["r_upper_leg", "r_lower_leg", "r_ankle_1", "r_foot"];

fn three<T>(cad: T, cad_fitted: T, identified: T) -> ModelComparison<T> {
    ModelComparison {
        cad,
        cad_fitted,
        identified,
    }
}

fn both<T>(cad: T, identified: T) -> Both<T> {
    Both { cad, identified }
}

fn at(seconds: f64) -> Nanos {
    Nanos::from_millis(1_000_000 + (seconds * 1e3) as i64)
}

/// Numbers that look like noise, the same at every run.
fn noise(i: usize) -> f64 {
    (i as f64 * 12.9898).sin() * 43_758.547 % 1.0
}

fn curve(name: &str, unit: &'static str, n: usize) -> Curve {
    let t: Vec<f64> = (0..1500).map(|i| i as f64 * 0.02).collect();
    let moving = |t: f64| if t < 4.0 { 0.0 } else { (t - 4.0).min(1.0) };
    let torque = |t: f64| 3.0 * (0.7 * t + n as f64).sin() * moving(t) + 2.0;
    Curve {
        name: name.into(),
        unit,
        // A gap.
        measured: t
            .iter()
            .enumerate()
            .map(|(i, t)| {
                if (600..640).contains(&i) {
                    f64::NAN
                } else {
                    torque(*t) + 0.05 * noise(i)
                }
            })
            .collect(),
        cad_fitted: t
            .iter()
            .map(|t| torque(*t) * 0.93 + 0.2 * (1.9 * t).cos() * moving(*t))
            .collect(),
        identified: t
            .iter()
            .map(|t| torque(*t) * 0.995 + 0.04 * (1.9 * t).cos())
            .collect(),
        sigma: t
            .iter()
            .map(|t| {
                if *t < 4.0 {
                    3.0
                } else {
                    0.05 + 0.4 / (t - 3.0)
                }
            })
            .collect(),
        t,
    }
}

fn excluded() -> Vec<Excluded> {
    vec![
        Excluded {
            reason: "too close to the beginning, the end or a gap for accelerations".into(),
            instants: 60,
            first: at(0.0),
            last: at(30.0),
        },
        Excluded {
            reason: "contact declared: right_foot".into(),
            instants: 240,
            first: at(12.0),
            last: at(14.4),
        },
    ]
}

fn log(file: &str, role: LogRole) -> LogOutcome {
    LogOutcome {
        file: file.into(),
        role,
        span: (at(0.0), at(30.0)),
        used: 2700,
        excluded: excluded(),
        onset: Some(at(4.0)),
        predicted: Predicted {
            relative_error: both(0.064, 0.0235),
            relative_error_with_drift: both(0.06, 0.0225),
            joints: vec![("r_knee".into(), both(0.24, 0.09))],
            sensors: vec![(
                "r_leg_ft_sensor".into(),
                both([0.6, 3.0, 0.6, 0.3, 0.2, 0.1], [0.5; 6]),
            )],
            two_route: vec![("r_knee".into(), both(0.25, 0.14))],
        },
        joints: JOINTS
            .iter()
            .map(|j| JointOutcome {
                name: (*j).into(),
                rms_nm: three(0.9, 0.2, 0.07),
                measured_rms_nm: 3.1,
                coverage: 0.946,
            })
            .collect(),
        sensors: vec![SensorOutcome {
            name: "r_leg_ft_sensor".into(),
            rms: three(
                [f64::NAN; 6],
                [0.5, 2.9, 0.5, 0.22, 0.1, 0.04],
                [0.4, 0.9, 0.45, 0.1, 0.09, 0.04],
            ),
            coverage: [0.95, 0.94, 0.968, 0.95, 0.97, 0.93],
        }],
        two_route: vec![TwoRouteOutcome {
            joint: "r_knee".into(),
            rms_nm: three(12.0, 0.138, 0.13),
            rms_mean_removed_nm: three(0.2, 0.12, 0.11),
        }],
        offsets: vec![OffsetOutcome {
            sensor: "r_leg_ft_sensor".into(),
            start: [-290.1, 12.0, 3.0, 1.0, -2.0, 0.1],
            end: [-289.0, 12.5, 3.1, 1.01, -2.1, 0.12],
            deviation: [0.1, 0.1, 0.2, 0.01, 0.01, 0.01],
            rate: [0.05, 0.04, 0.1, 0.002, 0.002, 0.001],
        }],
        friction: vec![FrictionOutcome {
            joint: "r_knee".into(),
            coulomb_nm: 0.41,
            viscous: 0.08,
            offset_nm: -0.02,
            deviation: [0.01, 0.004, 0.02],
        }],
        findings: vec![Finding {
            severity: Severity::Warning,
            code: FindingCode::Disturbance,
            subject: "r_leg_ft_sensor".into(),
            text: "the links at r_leg_ft_sensor: undeclared disturbance 1 time between 17.3 and \
                   18.3 s after the log's start"
                .into(),
        }],
        curves: JOINTS
            .iter()
            .enumerate()
            .map(|(i, j)| curve(j, "Nm", i))
            .chain([curve("r_leg_ft_sensor fx", "N", 7)])
            .collect(),
    }
}

/// Everything is well, but for a disturbance of a log.
pub(crate) fn outcome() -> Outcome {
    Outcome {
        robot: "icub_legs".into(),
        verdict: Verdict::Identified,
        links: links(),
        covariance: CovarianceRoot {
            columns: vec![],
            calibrations: vec![],
            root: Default::default(),
        },
        rotors: vec![RotorOutcome {
            joint: "r_knee".into(),
            inertia: 0.052,
            deviation: 0.003,
        }],
        calibrations: vec![calibration()],
        tau: 0.58,
        least_retained_fraction: 1.0,
        unknowns: 40,
        rank: 31,
        structural_rank: 38,
        effective: 14.3,
        condition: 3.2e5,
        singular_values: (0..31)
            .map(|i| 300.0 * 10f64.powf(-f64::from(i) * 0.18))
            .collect(),
        weakest: (0..20)
            .map(|i| WeakDirection {
                expression: format!("r_foot.I_zz - 0.4{i} r_lower_leg.h_z"),
                links: vec![],
                relative: 1e-5 * f64::from(i + 1),
                prior_share: 1.0 - 0.02 * f64::from(i),
            })
            .collect(),
        not_separable: vec![
            "the offset of r_leg_ft_sensor along gravity and the mass of the leg: nothing turned \
             about a horizontal axis"
                .into(),
        ],
        base_parameters: base_parameters(),
        channels: ["fx", "fy", "fz", "tx", "ty", "tz"]
            .iter()
            .map(|c| ChannelNoise {
                name: format!("wrench/r_leg_ft_sensor/{c}"),
                unit: if c.starts_with('f') { "N" } else { "Nm" },
                deviation: 0.2,
                autocorrelation_seconds: 0.12,
                drift: 0.01,
            })
            .collect(),
        time_offsets: vec![TimeOffset {
            channel: "wrench/r_leg_ft_sensor".into(),
            seconds: 0.0061,
            deviation: 0.0004,
            significant: true,
        }],
        logs: vec![
            log("walk_1.csv", LogRole::Train),
            log("walk_2.csv", LogRole::Validate),
        ],
        findings: vec![Finding {
            severity: Severity::Note,
            code: FindingCode::InertiaRegularised,
            subject: "r_upper_leg".into(),
            text: "r_upper_leg lies above r_leg_ft_sensor: nothing measured tells its parameters"
                .into(),
        }],
    }
}

fn links() -> Vec<LinkOutcome> {
    let links = LINKS.iter().enumerate().map(|(i, name)| {
        let size = i as f64 + 1.0;
        let cad = [
            1.0 / size,
            0.01,
            -0.02,
            0.03,
            0.004,
            0.0001,
            0.0,
            0.005,
            0.0002,
            0.003,
        ];
        let identified = cad.map(|p| p * 1.12);
        LinkOutcome {
            link: i + 1,
            name: (*name).into(),
            cad: RigidInertia::from_parameters(&cad),
            floored: (i == 2).then(|| RigidInertia::from_parameters(&cad)),
            identified: RigidInertia::from_parameters(&identified),
            deviation: cad.map(|p| p.abs() * 0.03 + 1e-4),
            retained_fraction: 1.0,
            significance: 4.2 / size,
            seen: i > 0,
        }
    });
    links.collect()
}

fn base_parameters() -> Vec<BaseParameterOutcome> {
    let parameters = (0..38).map(|i| {
        let (unit, size) = match i {
            0..4 => ("kg", 1.0),
            4..16 => ("kg m", 0.05),
            _ => ("kg m^2", 0.004),
        };
        BaseParameterOutcome {
            expression: format!(
                "r_lower_leg.I_xx + r_ankle_1.I_yy - 0.25 r_foot.h_{i} + 0.0221 r_foot.m"
            ),
            unit,
            cad: size * noise(i),
            identified: size * (noise(i) + 0.2 * noise(i + 50)),
            deviation: size * 0.05 * (1.0 + noise(i + 7).abs()),
        }
    });
    parameters.collect()
}

/// A gain of each channel, and a change per kelvin.
fn calibration() -> CalibrationOutcome {
    let kind = Kind {
        gain: Gain::Diagonal,
        temperature: true,
    };
    let error: Vec<f64> = (0..12).map(|i| 0.05 * noise(i)).collect();
    let gain: Vec<f64> = force_first(&error[..6]).iter().map(|x| 1.0 + x).collect();
    let per_kelvin = Wrench::from_parts(
        [error[9], error[10], error[11]],
        [error[6], error[7], error[8]],
    );
    CalibrationOutcome {
        sensor: "r_leg_ft_sensor".into(),
        configured: Calibration::default(),
        identified: Calibration::new(
            gain_from_force_first(&gain).unwrap(),
            per_kelvin,
            Some(31.2),
        ),
        kind,
        deviation: error.iter().map(|x| 0.1 * x.abs() + 1e-4).collect(),
        prior: kind
            .unknowns()
            .map(|unknown| {
                if matches!(unknown, Unknown::Gain { .. }) {
                    0.05
                } else {
                    10.0
                }
            })
            .collect(),
        error,
    }
}

/// A robot that stood still.
pub(crate) fn nothing() -> Outcome {
    let mut outcome = outcome();
    outcome.verdict = Verdict::Nothing("no joint moved in any log".into());
    (
        outcome.tau,
        outcome.rank,
        outcome.condition,
        outcome.effective,
    ) = (f64::NAN, 0, f64::NAN, 0.0);
    outcome.singular_values.clear();
    outcome.weakest.clear();
    outcome.base_parameters.clear();
    outcome.calibrations.clear();
    outcome.channels.clear();
    outcome.rotors.clear();
    for log in &mut outcome.logs {
        log.used = 0;
        log.predicted = Predicted {
            relative_error: both(f64::NAN, f64::NAN),
            relative_error_with_drift: both(f64::NAN, f64::NAN),
            ..Predicted::default()
        };
        log.joints.clear();
        log.sensors.clear();
        log.two_route.clear();
        log.curves.clear();
        log.offsets.clear();
        log.friction.clear();
        log.findings = vec![Finding {
            severity: Severity::Refusal,
            code: FindingCode::NoMotion,
            subject: String::new(),
            text: "no joint moved by more than its noise: nothing but an offset can be told from \
                   this log; record the robot moving"
                .into(),
        }];
    }
    outcome
}
