//! Figures: what is left of every log with CAD, with CAD and fitted offsets, and with the identified parameters; and what is known of the parameters, in numbers and words.

use super::batch::{Identified, LEAST_FOLD, Prepared, bodies, feasibility, per_column, verdict};
use super::gate::UnitSet;
use super::outcome::{
    BaseParameterOutcome, Both, CalibrationOutcome, ChannelNoise, Consistency, CovarianceRoot, Curve, Finding,
    FrictionOutcome, JointOutcome, LinkOutcome, LogOutcome, OffsetOutcome, Outcome, Predicted, RotorOutcome,
    SensorOutcome, Severity, Spectrum, Three, TwoRouteOutcome, Verdict, WeakDirection,
};
use super::passes::{OFFSET_VARIANCE, Residuals, Told, leave, tell};
use super::rows::{FRICTION, Further, Layout, RowMaker, Rows, WIDTH, friction_row};
use super::session::Block;
use super::yardstick::{self, Candidate, Yardstick};
use super::{AXES, delay, dot, parallel, zeros};
use crate::calibration::{Kind, Unknown, swapped};
use crate::config::{Gain, IdentificationInput};
use crate::dynamics::Structure;
use crate::regressor::identifiable::{
    BaseParameter, Column, Identifiable, JointMotion, Measured, Offsets, Scope, Term,
};
use crate::setup::Setup;
use crate::spatial::{RigidInertia, Wrench};
use nalgebra::{DMatrix, DVector, Matrix6};
use proprio_topics::Nanos;
use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};
use std::sync::Arc;

/// Points of a curve at the most.
const POINTS: usize = 2000;

/// Seconds at both ends of a log that do not count where torques are compared: filters and derivatives need them.
const EDGE: f64 = 0.3;

/// Torques with more samples per second are raw: they are compared below [`CUT_OFF`].
const RAW_RATE: f64 = 400.0;

/// Of the fourth-order Butterworth filter, run forwards and backwards, for raw torques \[Hz\].
const CUT_OFF: f64 = 5.0;

/// Missing samples over this \[s\] do not show below [`CUT_OFF`].
const BRIDGED: f64 = 0.02;

/// Samples of a spectrum's window.
const SPECTRUM: usize = 256;

/// Blocks of instants that one thread takes at a time.
const TOGETHER: usize = 64;

/// A joint that moves less stands still \[rad\].
const STILL: f64 = 0.01;

/// An offset with this variance has not been read.
const UNREAD: f64 = 0.9 * OFFSET_VARIANCE;

const PARAMETERS: [&str; 10] = ["m", "h_x", "h_y", "h_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz"];

/// The channel of a sensor's quantity, given in the order of samples: channels have torques first.
pub(super) fn channel_of(sensor_place: usize, axis: usize) -> usize {
    6 * sensor_place + (axis + 3) % 6
}

pub(super) fn sensor_name(setup: &Setup, sensor: usize) -> String {
    setup.sensor_names().nth(sensor).unwrap_or_default().to_owned()
}

pub(super) fn channel_name(setup: &Setup, layout: &Layout, channel: usize) -> (String, &'static str) {
    let wrenches = 6 * layout.sensors.len();
    if channel < wrenches {
        let axis = (channel % 6 + 3) % 6;
        let name = sensor_name(setup, layout.sensors[channel / 6]);
        (
            format!("wrench/{name}/{}", AXES[axis]),
            if axis < 3 { "N" } else { "Nm" },
        )
    } else {
        let dof = layout.joints[channel - wrenches];
        (format!("joint/{}/torque", setup.model.dof_name(dof)), "Nm")
    }
}

pub(super) fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for value in values.filter(|x| x.is_finite()) {
        sum += value * value;
        count += 1.0;
    }
    if count > 0.0 { (sum / count).sqrt() } else { f64::NAN }
}

fn mean(values: &[f64]) -> f64 {
    let finite = values.iter().filter(|x| x.is_finite());
    let (sum, count) = finite.fold((0.0, 0.0), |(s, n), x| (s + x, n + 1.0));
    sum / count
}

/// What there is to say where nothing was identified: CAD, and why.
pub(super) fn nothing(setup: &Setup, prepared: &[Prepared], reason: String) -> Outcome {
    let nan = Three {
        cad: f64::NAN,
        cad_fitted: f64::NAN,
        identified: f64::NAN,
    };
    let logs = prepared.iter().map(|log| LogOutcome {
        file: log.file.clone(),
        role: log.role,
        span: log.span,
        used: 0,
        left_out: log.left_out.clone(),
        onset: None,
        predicted: Predicted {
            relative_error: both([f64::NAN; 2]),
            relative_error_with_drift: both([f64::NAN; 2]),
            ..Predicted::default()
        },
        fitted_error: nan,
        joints: Vec::new(),
        sensors: Vec::new(),
        two_route: Vec::new(),
        offsets: Vec::new(),
        friction: Vec::new(),
        findings: log.all_findings(),
        curves: Vec::new(),
        spectra: Vec::new(),
    });
    Outcome {
        robot: setup.robot.clone(),
        links: setup
            .model
            .inertias()
            .iter()
            .enumerate()
            .map(|(link, cad)| unseen(setup, link, cad))
            .collect(),
        covariance: CovarianceRoot {
            columns: Vec::new(),
            calibrations: Vec::new(),
            root: DMatrix::zeros(0, 0),
        },
        rotors: Vec::new(),
        calibrations: Vec::new(),
        tau: f64::NAN,
        shrink: 0.0,
        unknowns: 0,
        rank: 0,
        structural_rank: 0,
        effective: 0.0,
        condition: f64::NAN,
        singular_values: Vec::new(),
        weakest: Vec::new(),
        confused: Vec::new(),
        base_parameters: Vec::new(),
        channels: Vec::new(),
        time_offsets: Vec::new(),
        consistency: Consistency {
            feasible: None,
            deviations: 0.0,
            links: Vec::new(),
            text: "nothing was identified: the parameters are CAD's".into(),
        },
        logs: logs.collect(),
        findings: vec![Finding {
            severity: Severity::Refusal,
            code: "nothing",
            subject: String::new(),
            text: reason.clone(),
        }],
        verdict: Verdict::Nothing(reason),
    }
}

fn unseen(setup: &Setup, link: usize, cad: &RigidInertia) -> LinkOutcome {
    LinkOutcome {
        link,
        name: setup.model.link_name(link).to_owned(),
        cad: *cad,
        floored: None,
        identified: *cad,
        deviation: [f64::NAN; 10],
        kept: 0.0,
        significance: 0.0,
        seen: false,
    }
}

/// Everything there is to say.
pub(super) fn outcome(
    setup: &Setup,
    maker: &RowMaker<'_>,
    prepared: &[Prepared],
    training: &[&Prepared],
    identified: &Identified,
) -> Outcome {
    let layout = &identified.layout;
    let p = layout.inertial();
    let narrow = identified.fit.covariance_root();
    let (scaled, spread) = scaled_information(identified);
    let root = if identified.kept.iter().all(|kept| *kept >= 1.0) {
        narrow.clone()
    } else {
        let kept = per_column(layout, &identified.kept);
        let (r, _) = identified.information.to_triangle();
        shrunk(&narrow, &cad_root(layout, &r, &spread), &kept)
    };
    let svd = scaled.svd(false, true);
    let mut order: Vec<usize> = (0..svd.singular_values.len()).collect();
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    let singular: Vec<f64> = order.iter().map(|&i| svd.singular_values[i]).collect();
    let greatest = singular.first().copied().unwrap_or(0.0);
    let rank = singular
        .iter()
        .filter(|s| **s > 1e-8 * greatest && greatest > 0.0)
        .count();
    let subspace = subspace(setup, training, identified);
    let directions = svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, p));
    let weakest = order[..rank].iter().rev().take(5).map(|&i| {
        let direction = directions.row(i).transpose();
        let value = svd.singular_values[i];
        let (expression, links) = expression(setup, layout, &spread, &direction);
        WeakDirection {
            expression,
            links,
            relative: value / greatest,
            prior_share: 1.0 / (1.0 + value * value),
        }
    });
    let (base_parameters, mut confused, structural_rank) = base_parameters(setup, identified, &root, subspace.as_ref());
    let sums = confused_rotors(setup, identified, &spread);
    let structural_rank = structural_rank.saturating_sub(sums.len());
    confused.extend(sums);
    let mut findings: Vec<Finding> = identified
        .prior
        .floors()
        .iter()
        .filter(|floor| layout.links.contains(&floor.link))
        .map(|floor| Finding {
            severity: Severity::Note,
            code: "cad_floored",
            subject: setup.model.link_name(floor.link).to_owned(),
            text: floor.describe(setup.model.link_name(floor.link)),
        })
        .collect();
    findings.extend(zeros::joint_zeros(maker, training, identified));
    let (time_offsets, late) = delay::delays(maker, training, identified);
    findings.extend(late);
    let consistency = feasibility(setup, identified);
    if consistency.feasible != Some(true) {
        findings.push(Finding {
            severity: Severity::Warning,
            code: if consistency.feasible.is_none() {
                "undecided"
            } else {
                "not_physical"
            },
            subject: consistency.links.join(", "),
            text: consistency.text.clone(),
        });
    }
    findings.extend(identified.findings.iter().cloned());
    let (calibrations, told) = calibrations(setup, maker, identified, &root);
    findings.extend(told);
    let mut maker = maker.clone();
    let sets = [identified.cad.clone(), identified.d.clone()];
    let instants = training.iter().flat_map(|log| &log.instants);
    let friction = yardstick::friction(&maker, instants, &sets);
    let candidates = [0, 1].map(|set| Candidate {
        course: vec![(Nanos::ZERO, sets[set].clone())],
        friction: friction[set].clone(),
    });
    let logs = prepared
        .iter()
        .map(|log| log_outcome(&mut maker, log, identified, &sets, &candidates, &root))
        .collect();
    Outcome {
        robot: setup.robot.clone(),
        verdict: verdict(identified),
        links: links(setup, identified, &narrow, &root, &spread),
        covariance: covariance(identified, &root),
        tau: identified.fit.tau,
        shrink: identified.kept[..layout.links.len()]
            .iter()
            .copied()
            .fold(1.0, f64::min),
        rotors: rotors(setup, identified, &root),
        calibrations,
        unknowns: p,
        rank,
        structural_rank,
        effective: identified.fit.effective,
        condition: if rank > 0 {
            greatest / singular[rank - 1]
        } else {
            f64::NAN
        },
        singular_values: singular,
        weakest: weakest.collect(),
        confused,
        base_parameters,
        channels: channels(setup, identified, training),
        time_offsets,
        consistency,
        logs,
        findings,
    }
}

/// Rotors whose inertia only CAD tells from that of links: what the data say of one is what they say of some combination of the others and of the links' parameters.
fn confused_rotors(setup: &Setup, identified: &Identified, spread: &[DMatrix<f64>]) -> Vec<String> {
    let layout = &identified.layout;
    let mut fitted = layout.beside_cad();
    if fitted.is_empty() {
        return Vec::new();
    }
    let (mut r, _) = identified.information.to_triangle();
    for (place, spread) in spread.iter().enumerate() {
        let columns = r.columns(WIDTH * place, WIDTH).into_owned() * spread;
        r.columns_mut(WIDTH * place, WIDTH).copy_from(&columns);
    }
    // Of what no row has there is nothing to be told apart.
    fitted.retain(|column| r.column(*column).norm() > 0.0);
    let sum = |column: usize| {
        let Further::RotorInertia(dof) = layout.further[column - layout.inertial()] else {
            return None;
        };
        Some(format!(
            "only as a sum: the inertia of the rotor of {0}, and that of the links that {0} turns, about its axis",
            setup.model.dof_name(dof)
        ))
    };
    combinations(&r, &fitted).into_iter().filter_map(sum).collect()
}

/// Of these columns of a matrix, none of them zero, those that combinations of all other columns come as near to as rounding lets tell: to a hundred thousandth of their length.
fn combinations(matrix: &DMatrix<f64>, columns: &[usize]) -> Vec<usize> {
    /// Of that length.
    const NEAR: f64 = 1e-5;
    const ROUNDING: f64 = 1e-12;
    // Of each column what the rest of the matrix leaves of it, whose directions these are ...
    let mut left = matrix.select_columns(columns);
    left.column_iter_mut().for_each(|mut column| _ = column.normalize_mut());
    let svd = matrix.clone().remove_columns_at(columns).svd(true, false);
    let sizes = &svd.singular_values;
    let known = (0..sizes.len()).filter(|&i| sizes[i] > 1e-10 * sizes.max());
    if let Some(axes) = svd.u.map(|u| u.select_columns(&known.collect::<Vec<_>>())) {
        left -= &axes * axes.tr_mul(&left);
    }
    // ... and how far that is from the others': one over the length of its row of the inverse.
    let svd = left.svd(false, true);
    let directions = svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, columns.len()));
    let far = |place: usize| {
        let row = directions.column(place);
        let squares = row
            .iter()
            .zip(&svd.singular_values)
            .map(|(v, size)| (v / size.max(ROUNDING)).powi(2));
        squares.sum::<f64>().sqrt().recip()
    };
    let each = columns.iter().enumerate();
    each.filter(|(place, _)| far(*place) < NEAR)
        .map(|(_, column)| *column)
        .collect()
}

/// Inertias of the rotors whose motors' torques were measured.
fn rotors(setup: &Setup, identified: &Identified, root: &DMatrix<f64>) -> Vec<RotorOutcome> {
    let layout = &identified.layout;
    let rotor = |(further, column): (&Further, usize)| {
        let Further::RotorInertia(dof) = *further else {
            return None;
        };
        Some(RotorOutcome {
            joint: setup.model.dof_name(dof).to_owned(),
            inertia: identified.d[column],
            deviation: root.row(column).norm(),
        })
    };
    layout
        .further
        .iter()
        .zip(layout.inertial()..)
        .filter_map(rotor)
        .collect()
}

/// Share of the prior's standard deviation from which on the logs are said to tell nothing.
const TOLD_NOTHING: f64 = 0.8;

/// So many of these are named; all are in the table.
const NAMED: usize = 8;

/// Calibrations of the sensors of which something was to be identified, and what is to be said of them.
fn calibrations(
    setup: &Setup,
    maker: &RowMaker<'_>,
    identified: &Identified,
    root: &DMatrix<f64>,
) -> (Vec<CalibrationOutcome>, Vec<Finding>) {
    let layout = &identified.layout;
    let (mut outcomes, mut findings) = (Vec::new(), Vec::new());
    if identified.calibrated.is_empty() {
        return (outcomes, findings);
    }
    let precision = &layout.precision;
    for &sensor in &layout.sensors {
        let name = sensor_name(setup, sensor);
        let own: Vec<(usize, Unknown, f64)> = (layout.further.iter().zip(layout.inertial()..).zip(precision))
            .filter_map(|((further, column), precision)| match *further {
                Further::Calibration(other, unknown) if other == sensor => {
                    Some((column, unknown, precision.sqrt().recip()))
                }
                _ => None,
            })
            .collect();
        let (mut e, mut kelvin) = (Matrix6::zeros(), [0.0; 6]);
        for (column, unknown, _) in &own {
            match *unknown {
                Unknown::Gain { channel, of } => e[(channel, of)] = identified.d[*column],
                Unknown::Temperature { channel } => kelvin[channel] = identified.d[*column],
            }
        }
        let is_gain = |unknown: &Unknown| matches!(unknown, Unknown::Gain { .. });
        let kind = Kind {
            gain: if own.iter().any(|(_, unknown, _)| is_gain(unknown)) {
                identified.calibrated.gain
            } else {
                Gain::None
            },
            temperature: own.iter().any(|(_, unknown, _)| !is_gain(unknown)),
        };
        if setup.calibrated.temperature && !kind.temperature {
            findings.push(Finding {
                severity: Severity::Warning,
                code: "no_temperature",
                subject: name.clone(),
                text: format!(
                    "{name}: how it changes with temperature is not identified, for no log has its temperature (column wrench/{name}/temperature), or it never changed"
                ),
            });
        }
        if kind.is_empty() {
            continue;
        }
        let more = Wrench::from_torque_first(kelvin);
        let reference = maker.reference(sensor).filter(|_| kind.temperature);
        let deviation: Vec<f64> = own.iter().map(|(column, ..)| root.row(*column).norm()).collect();
        let prior: Vec<f64> = own.iter().map(|(.., prior)| *prior).collect();
        // What the logs hardly tell, in the words of samples.
        let mut vague: Vec<String> = Vec::new();
        for ((_, unknown, prior), deviation) in own.iter().zip(&deviation) {
            let word = |channel: usize| AXES[swapped(channel)];
            if *deviation > TOLD_NOTHING * prior {
                vague.push(match *unknown {
                    Unknown::Gain { channel, of } if channel == of => format!("the gain of {}", word(channel)),
                    Unknown::Gain { channel, of } => format!("{} of {}", word(channel), word(of)),
                    Unknown::Temperature { channel } => format!("{} by temperature", word(channel)),
                });
            }
        }
        if !vague.is_empty() {
            let (count, more) = (vague.len(), if vague.len() > NAMED { ", ..." } else { "" });
            vague.truncate(NAMED);
            findings.push(Finding {
                severity: Severity::Note,
                code: "calibration_unseen",
                text: format!(
                    "{name}: the logs tell next to nothing of {} of the {} numbers of its calibration, which stay about as the workbench has them: {}. Motion that loads these channels more would tell",
                    count,
                    own.len(),
                    vague.join(", ") + more
                ),
                subject: name.clone(),
            });
        }
        // All forces too large by some share, and all masses beyond: the same readings.
        let forces = own.iter().filter(
            |(_, unknown, _)| matches!(unknown, Unknown::Gain { channel, of } if channel == of && *channel >= 3),
        );
        let forces: Vec<usize> = forces.map(|(column, ..)| *column).collect();
        if forces.len() == 3 {
            let common: f64 = forces.iter().map(|&column| identified.d[column]).sum::<f64>() / 3.0;
            let sum = forces.iter().map(|&column| root.row(column).into_owned());
            let spread = sum.reduce(|a, b| a + b).map_or(f64::NAN, |sum| sum.norm() / 3.0);
            let before = setup.gain_deviation / 3.0_f64.sqrt();
            if spread > 0.5 * before {
                findings.push(Finding {
                    severity: Severity::Note,
                    code: "gain_or_mass",
                    text: format!(
                        "{name}: gains that are all too small look as masses beyond it that are all too small, so what its forces have in common, {:+.1} +- {:.1} %, is told from mass by the prior alone: how far the workbench may be off (identification.gain_std) against how far CAD seems to be. Hang a known mass on it, or weigh a link and put that in the URDF, to tell them apart",
                        100.0 * common,
                        100.0 * spread
                    ),
                    subject: name.clone(),
                });
            }
        }
        outcomes.push(CalibrationOutcome {
            sensor: name,
            workbench: setup.calibrations[sensor],
            identified: setup.calibrations[sensor].then(&e, &more, reference),
            kind,
            error: own.iter().map(|(column, ..)| identified.d[*column]).collect(),
            deviation,
            prior,
        });
    }
    (outcomes, findings)
}

fn channels(setup: &Setup, identified: &Identified, training: &[&Prepared]) -> Vec<ChannelNoise> {
    let noise = &identified.noise;
    let seconds: f64 = training.iter().map(|log| (log.span.1 - log.span.0).seconds()).sum();
    let instants: usize = training.iter().map(|log| log.instants.len()).sum();
    let period = seconds / instants.max(1) as f64;
    (0..identified.layout.channels())
        .map(|channel| {
            let (name, unit) = channel_name(setup, &identified.layout, channel);
            ChannelNoise {
                name,
                unit,
                deviation: noise.square[channel].sqrt(),
                autocorrelation: noise.time[channel],
                autocorrelation_seconds: noise.time[channel] * period,
                drift: noise.drift[channel].sqrt(),
            }
        })
        .collect()
}

/// `R` of the links' parameters, whatever the further unknowns are, with columns in units of the prior's spread, and that spread: per link a matrix from such units to the ten parameters,
/// `2 tau^2 M^-1 = spread spread^T`.
fn scaled_information(identified: &Identified) -> (DMatrix<f64>, Vec<DMatrix<f64>>) {
    let r = of_links(identified);
    let mut scaled = r.clone();
    let mut spreads = Vec::new();
    for (place, &link) in identified.layout.links.iter().enumerate() {
        let metric = identified.prior.metric(link);
        let inverse = metric
            .cholesky()
            .and_then(|c| c.l().try_inverse())
            .map(|l| l.transpose());
        let spread = inverse.unwrap_or_default() * (2.0_f64.sqrt() * identified.fit.tau);
        let spread = DMatrix::from_fn(WIDTH, WIDTH, |i, j| spread[(i, j)]);
        let columns = r.columns(WIDTH * place, WIDTH).into_owned() * &spread;
        scaled.columns_mut(WIDTH * place, WIDTH).copy_from(&columns);
        spreads.push(spread);
    }
    (scaled, spreads)
}

/// What the data tell of the links' parameters if nothing but these data is known of the further unknowns (where CAD says something of them, its word too): the triangle of
/// `[R_further | R_links]`, below and right of what the further ones take.
fn of_links(identified: &Identified) -> DMatrix<f64> {
    let (r, _) = identified.information.to_triangle();
    let (links, further) = (identified.layout.inertial(), identified.layout.further.len());
    if further == 0 {
        return r;
    }
    let rows = r.nrows();
    let order: Vec<usize> = (links..links + further).chain(0..links).collect();
    let mut all = r.select_columns(&order).resize_vertically(rows + further, 0.0);
    let layout = &identified.layout;
    for (place, (precision, own)) in layout.precision.iter().copied().zip(&layout.further).enumerate() {
        all[(rows + place, place)] = if own.lacks_cad() { 0.0 } else { precision.sqrt() };
    }
    all.qr().r().view((further, further), (links, links)).into_owned()
}

/// A square root `F` of the covariance `F F^T` of CAD's errors: the prior's spread of each link, the prior of further unknowns that CAD says are zero; and of those of which it says nothing, which
/// were fitted to the data with CAD's bodies ([`Identified::cad`]), what these errors and noise make of them.
fn cad_root(layout: &Layout, r: &DMatrix<f64>, spread: &[DMatrix<f64>]) -> DMatrix<f64> {
    let count = layout.unknowns();
    let fitted = layout.beside_cad();
    let given: Vec<usize> = (0..count).filter(|column| !fitted.contains(column)).collect();
    let precision = &layout.precision;
    let mut root = DMatrix::zeros(count, count);
    for (place, spread) in spread.iter().enumerate() {
        root.view_mut((WIDTH * place, WIDTH * place), (WIDTH, WIDTH))
            .copy_from(spread);
    }
    for (precision, column) in precision.iter().zip(layout.inertial()..) {
        root[(column, column)] = 1.0 / precision.sqrt();
    }
    if fitted.is_empty() {
        return root;
    }
    let own = r.select_columns(&fitted);
    let mut square = own.tr_mul(&own);
    for (place, &column) in fitted.iter().enumerate() {
        square[(place, place)] += precision[column - layout.inertial()];
        root[(column, column)] = 0.0;
    }
    let Some(factor) = square.cholesky() else {
        return root;
    };
    // (R_f^T R_f + prior)^-1 [-R_f^T R_c (error of c) + noise], the noise of covariance R_f^T R_f + prior.
    let moved = factor.solve(&own.tr_mul(&(r.select_columns(&given) * root.select_rows(&given))));
    let noise = factor.l().transpose().try_inverse();
    for (place, &column) in fitted.iter().enumerate() {
        root.row_mut(column).copy_from(&-moved.row(place));
        for (other, &at) in fitted.iter().enumerate() {
            root[(column, at)] += noise.as_ref().map_or(0.0, |noise| noise[(place, other)]);
        }
    }
    root
}

/// A square root of the covariance of what is kept, `kept` of the change from CAD per column: `(1 - b^2) P + b^2 Q` with `b = 1 - kept`, `P = root root^T` and `Q = cad cad^T` the covariance of
/// CAD's errors.
///
/// The error is `kept` times that of the estimate and `b` times that of CAD; the estimate's error has covariance `P`, CAD's `Q`, and `P` is what they have in common, since what the
/// estimate moved by tells nothing of what it is still off by. So with nothing kept it is the prior's. (No row has two groups of unknowns, and within a group the same is kept.)
fn shrunk(root: &DMatrix<f64>, cad: &DMatrix<f64>, kept: &[f64]) -> DMatrix<f64> {
    let narrow = root.ncols();
    let mut wide = root.clone().resize_horizontally(narrow + cad.ncols(), 0.0);
    for (row, kept) in kept.iter().enumerate() {
        let back = 1.0 - kept;
        let scale = (1.0 - back * back).sqrt();
        wide.view_mut((row, 0), (1, narrow)).scale_mut(scale);
        wide.view_mut((row, narrow), (1, cad.ncols()))
            .copy_from(&(cad.row(row) * back));
    }
    upper(&wide)
}

fn links(
    setup: &Setup,
    identified: &Identified,
    root: &DMatrix<f64>,
    wide: &DMatrix<f64>,
    spread: &[DMatrix<f64>],
) -> Vec<LinkOutcome> {
    let layout = &identified.layout;
    let moved = bodies(setup, layout, &identified.d);
    // What the estimate would scatter by if CAD were right: P - P (prior's precision) P.
    let mut weighed = root.clone();
    for (place, spread) in spread.iter().enumerate() {
        let inverse = spread
            .clone()
            .try_inverse()
            .unwrap_or_else(|| DMatrix::zeros(WIDTH, WIDTH));
        let rows = inverse * root.rows(WIDTH * place, WIDTH).into_owned();
        weighed.rows_mut(WIDTH * place, WIDTH).copy_from(&rows);
    }
    for (precision, row) in layout.precision.iter().copied().zip(layout.inertial()..) {
        weighed.row_mut(row).scale_mut(precision.sqrt());
    }
    // root root^T - (root weighed^T)(...)^T
    let shrinking = root * weighed.transpose();
    setup
        .model
        .inertias()
        .iter()
        .enumerate()
        .map(|(link, cad)| {
            let floored = identified.prior.floors().iter().any(|f| f.link == link);
            let floored = floored.then(|| *identified.prior.reference(link));
            let Ok(place) = layout.links.binary_search(&link) else {
                let metric = identified.prior.metric(link).try_inverse().unwrap_or_default();
                let mut deviation = [0.0; 10];
                for (k, value) in deviation.iter_mut().enumerate() {
                    *value = (2.0 * metric[(k, k)]).max(0.0).sqrt() * identified.fit.tau;
                }
                return LinkOutcome {
                    floored,
                    deviation,
                    ..unseen(setup, link, cad)
                };
            };
            let own = root.rows(WIDTH * place, WIDTH).into_owned();
            let mut deviation = [0.0; 10];
            for (k, value) in deviation.iter_mut().enumerate() {
                *value = wide.row(WIDTH * place + k).norm();
            }
            let inverse = spread[place]
                .clone()
                .try_inverse()
                .unwrap_or_else(|| DMatrix::zeros(WIDTH, WIDTH));
            let significance = significance(
                &(&inverse * own),
                &(&inverse * shrinking.rows(WIDTH * place, WIDTH).into_owned()),
                &(&inverse * identified.d.rows(WIDTH * place, WIDTH)),
            );
            LinkOutcome {
                link,
                name: setup.model.link_name(link).to_owned(),
                cad: *cad,
                floored,
                identified: moved[link],
                deviation,
                kept: identified.kept[place],
                significance,
                seen: true,
            }
        })
        .collect()
}

/// How far a link's parameters moved, as standard normal deviates, from rows of the root of their posterior covariance `P`, of `P` times the root of the prior's precision, and from the
/// change; all in units of the prior's spread.
///
/// Directions count of which the logs rather than the prior decide: less than half of the prior's variance is left. There the change is measured by the scatter that it would have if CAD
/// were right, `P - P (prior's precision) P`; its square is a chi-square variable, made a deviate by Fisher's root.
fn significance(root: &DMatrix<f64>, shrinking: &DMatrix<f64>, change: &DVector<f64>) -> f64 {
    let svd = root.clone().svd(true, false);
    let Some(axes) = svd.u else { return 0.0 };
    let known: Vec<usize> = (0..svd.singular_values.len())
        .filter(|&i| svd.singular_values[i].powi(2) < 0.5)
        .collect();
    if known.is_empty() {
        return 0.0;
    }
    // Each direction in units of its own deviation: they differ by many orders of magnitude.
    let scale = |i: usize| 1.0 / svd.singular_values[known[i]].max(f64::MIN_POSITIVE);
    let axes = axes.select_columns(&known).transpose();
    let (own, shrinking, change) = (&axes * root, &axes * shrinking, &axes * change);
    let scatter = &own * own.transpose() - &shrinking * shrinking.transpose();
    let scatter = DMatrix::from_fn(known.len(), known.len(), |i, j| scatter[(i, j)] * scale(i) * scale(j));
    let change = DVector::from_fn(known.len(), |i, _| change[i] * scale(i));
    let square = match scatter.cholesky() {
        Some(factor) => change.dot(&factor.solve(&change)),
        // Lost in rounding: as if it scattered by its whole uncertainty.
        None => change.norm_squared(),
    };
    ((2.0 * square).sqrt() - (2.0 * known.len() as f64 - 1.0).sqrt()).max(0.0)
}

/// Of the parameters, and of the offsets at the end of the last piece of a training log in which each sensor was read, together.
fn covariance(identified: &Identified, root: &DMatrix<f64>) -> CovarianceRoot {
    let layout = &identified.layout;
    let (links, p, s) = (layout.inertial(), layout.unknowns(), 6 * layout.sensors.len());
    let mut columns = Vec::new();
    for &link in &layout.links {
        columns.extend((0..WIDTH).map(|parameter| Column::Inertial { link, parameter }));
    }
    for &sensor in &layout.sensors {
        columns.extend((0..6).map(|component| Column::Offset { sensor, component }));
    }
    let wide = root.ncols();
    let mut joint = DMatrix::zeros(p + s, wide + s);
    joint.view_mut((0, 0), (p, wide)).copy_from(root);
    // Given the parameters, offsets in different pieces have nothing in common.
    let source = |place: usize| {
        let read = |told: &Told| (0..6).any(|axis| told.covariance[(6 * place + axis, 6 * place + axis)] < UNREAD);
        let last = identified.told.len().saturating_sub(1);
        identified.told.iter().rposition(read).unwrap_or(last)
    };
    let sources: Vec<usize> = (0..layout.sensors.len()).map(source).collect();
    for (number, told) in identified.told.iter().enumerate() {
        let own = (0..s).filter(|unknown| sources[unknown / 6] == number);
        let own: Vec<usize> = own.collect();
        if own.is_empty() {
            continue;
        }
        let moved = told.slope.select_rows(&own) * root;
        let factor = told.covariance.select_rows(&own).select_columns(&own).cholesky();
        for (i, unknown) in own.iter().enumerate() {
            joint.view_mut((p + unknown, 0), (1, wide)).copy_from(&-moved.row(i));
            for (j, column) in own.iter().enumerate() {
                joint[(p + unknown, wide + column)] =
                    factor.as_ref().map_or(0.0, |f| f.l_dirty()[(i, j)]) * f64::from(u8::from(j <= i));
            }
        }
    }
    // Whatever the other further unknowns are.
    let (mut rows, mut calibrations): (Vec<usize>, Vec<_>) = ((0..links).chain(p..p + s).collect(), Vec::new());
    for (further, row) in layout.further.iter().zip(links..) {
        if let Further::Calibration(sensor, unknown) = *further {
            rows.push(row);
            calibrations.push((sensor, unknown));
        }
    }
    let joint = joint.select_rows(&rows);
    CovarianceRoot {
        columns,
        calibrations,
        root: upper(&joint),
    }
}

/// The upper triangular `U` with `U U^T = M M^T`.
fn upper(m: &DMatrix<f64>) -> DMatrix<f64> {
    let n = m.nrows();
    let flipped = DMatrix::from_fn(m.ncols(), n, |i, j| m[(n - 1 - j, i)]);
    let r = flipped.qr().r();
    DMatrix::from_fn(n, n, |i, j| if j < i { 0.0 } else { r[(n - 1 - j, n - 1 - i)] })
}

/// The combination of parameters that a direction `v`, in units of the prior's spread `S`, is: `v . S^-1 d`, in words. Up to four terms, those which weigh most by the prior's spread of
/// each parameter; the factors are those of the parameters in their own units, the first one's 1. And the links that these are of.
fn expression(
    setup: &Setup,
    layout: &Layout,
    spread: &[DMatrix<f64>],
    direction: &DVector<f64>,
) -> (String, Vec<usize>) {
    let mut parts: Vec<(usize, f64, f64)> = Vec::new();
    for (place, spread) in spread.iter().enumerate() {
        let Some(inverse) = spread.clone().try_inverse() else {
            continue;
        };
        let factors = inverse.tr_mul(&direction.rows(WIDTH * place, WIDTH).into_owned());
        for (k, factor) in factors.iter().enumerate() {
            parts.push((WIDTH * place + k, *factor, (factor * spread.row(k).norm()).abs()));
        }
    }
    parts.sort_by(|a, b| b.2.total_cmp(&a.2).then(a.0.cmp(&b.0)));
    let term = |&(column, factor, _): &(usize, f64, f64)| Term {
        coefficient: factor / parts[0].1,
        column,
        name: format!(
            "{}.{}",
            setup.model.link_name(layout.links[column / WIDTH]),
            PARAMETERS[column % WIDTH]
        ),
    };
    let told: Vec<_> = parts.iter().take(4).filter(|part| part.2 >= 0.1 * parts[0].2).collect();
    let mut links: Vec<usize> = told.iter().map(|part| layout.links[part.0 / WIDTH]).collect();
    links.dedup();
    let mut terms = told.into_iter().map(term);
    let Some(kept) = terms.next() else {
        return (String::new(), links);
    };
    let terms = terms.collect();
    (BaseParameter { kept, terms }.to_string(), links)
}

/// What can show at all with the joints that moved in the logs.
fn subspace(setup: &Setup, training: &[&Prepared], identified: &Identified) -> Option<Identifiable> {
    let mut regime = setup.regime();
    for (dof, joint) in regime.joints.iter_mut().enumerate() {
        let all = || training.iter().flat_map(|log| log.instants.iter());
        let (low, high) = all().fold((f64::MAX, f64::MIN), |(a, b), i| {
            (a.min(i.position[dof]), b.max(i.position[dof]))
        });
        if high - low < STILL {
            *joint = JointMotion::Locked(0.5 * (low + high));
        }
    }
    if identified.inputs == [IdentificationInput::Torque] {
        return Identifiable::new(&setup.model, Scope::Tree, &regime, Measured::Torques, Offsets::Known).ok();
    }
    regime.contacts = setup.always;
    let of = |measured| {
        let scope = Scope::SubTrees(&setup.structure);
        Identifiable::new(&setup.model, scope, &regime, measured, Offsets::Unknown).ok()
    };
    // Torques of all joints that move tell something beside F/T sensors; what those of some do is not known.
    let is_measured =
        |dof| matches!(regime.joints[dof], JointMotion::Locked(_)) || identified.layout.joints.contains(&dof);
    let both = (0..regime.joints.len())
        .all(is_measured)
        .then(|| of(Measured::Both))
        .flatten();
    both.or_else(|| of(Measured::Wrench))
}

fn base_parameters(
    setup: &Setup,
    identified: &Identified,
    root: &DMatrix<f64>,
    subspace: Option<&Identifiable>,
) -> (Vec<BaseParameterOutcome>, Vec<String>, usize) {
    let layout = &identified.layout;
    let Some(subspace) = subspace else {
        return (Vec::new(), Vec::new(), 0);
    };
    let moved = bodies(setup, layout, &identified.d);
    let value_of = |bodies: &[RigidInertia]| -> Vec<f64> {
        let columns = subspace.columns().iter();
        columns
            .map(|column| match column {
                Column::Inertial { link, parameter } => bodies[*link].parameters()[*parameter],
                Column::Offset { .. } => 0.0,
            })
            .collect()
    };
    let (cad, new) = (value_of(setup.model.inertias()), value_of(&moved));
    let (mut out, mut confused, mut rank) = (Vec::new(), Vec::new(), 0);
    for base in subspace.base_parameters() {
        let is_inertial = |column: usize| matches!(subspace.columns()[column], Column::Inertial { .. });
        let all = || std::iter::once(&base.kept).chain(&base.terms);
        let inertial = all().filter(|t| is_inertial(t.column)).count();
        let offsets = all().count() - inertial;
        if offsets > 0 {
            if inertial > 0 || offsets > 1 {
                confused.push(format!("only as a sum: {base}"));
            }
            continue;
        }
        let mut row = DVector::zeros(layout.unknowns());
        let mut seen = true;
        for term in all() {
            if let Column::Inertial { link, parameter } = subspace.columns()[term.column] {
                match layout.links.binary_search(&link) {
                    Ok(place) => row[WIDTH * place + parameter] += term.coefficient,
                    Err(_) => seen = false,
                }
            }
        }
        rank += usize::from(seen);
        let (Some(before), Some(after), true) = (base.value(&cad), base.value(&new), seen) else {
            continue;
        };
        let unit = match subspace.columns()[base.kept.column] {
            Column::Inertial { parameter: 0, .. } => "kg",
            Column::Inertial { parameter: 1..=3, .. } => "kg m",
            _ => "kg m^2",
        };
        out.push(BaseParameterOutcome {
            expression: base.to_string(),
            unit,
            cad: before,
            identified: after,
            deviation: root.tr_mul(&row).norm(),
        });
    }
    (out, confused, rank)
}

/// A degree of freedom; what is left of its torque with CAD, with CAD and friction fitted to the log,
/// with identified parameters and friction fitted, with CAD and the training logs' friction, with
/// identified parameters and the training logs' friction; what was measured.
type TorqueSeries = (usize, [Vec<f64>; 5], Vec<f64>);

/// What is left of a joint's torque with one set's friction from the training logs, in place of that
/// which was fitted to the log.
fn with_friction_of_training(
    layout: &Layout,
    instants: &[super::instants::Instant],
    left: &Residuals,
    (set, friction): (usize, &[[f64; FRICTION]]),
    place: usize,
) -> Vec<f64> {
    let wrenches = 6 * layout.sensors.len();
    let mut errors = left.noise[set][wrenches + place].clone();
    for (range, block) in left.ranges.iter().zip(&left.session) {
        for i in range.clone() {
            for (k, share) in friction_row(instants[i].velocity[layout.joints[place]])
                .into_iter()
                .enumerate()
            {
                let fitted = block.x[(wrenches + FRICTION * place + k, set)];
                errors[i] += share * (fitted - friction[place][k]);
            }
        }
    }
    errors
}

fn log_outcome(
    maker: &mut RowMaker<'_>,
    log: &Prepared,
    identified: &Identified,
    sets: &[DVector<f64>; 2],
    candidates: &[Candidate; 2],
    root: &DMatrix<f64>,
) -> LogOutcome {
    let setup = maker.setup();
    let layout = &identified.layout;
    let usable = !log.instants.is_empty() && !log.refused;
    let instants = if usable { log.instants.as_slice() } else { &[] };
    let left = leave(
        maker,
        super::passes::Piece {
            instants,
            breaks: &log.breaks,
        },
        &identified.noise,
        sets,
    );
    let times: Vec<f64> = instants.iter().map(|i| (i.t - log.span.0).seconds()).collect();
    let places = Places::new(&times);
    let filter = places.as_ref().filter(|_| log.torque_rate > RAW_RATE);
    let inner = |i: &usize| {
        let (first, last) = (
            times.first().copied().unwrap_or(0.0),
            times.last().copied().unwrap_or(0.0),
        );
        times[*i] >= first + EDGE && times[*i] <= last - EDGE
    };
    let wrenches = 6 * layout.sensors.len();
    let compared = Compared::new(maker, instants, &left, identified, sets);
    let untouched = untouched(maker, log, identified, sets);
    let torques = left.noise[1].iter().skip(wrenches);
    let errors: Vec<&[f64]> = compared.errors[2].iter().chain(torques).map(Vec::as_slice).collect();
    let coverage = covered(maker, instants, &errors, identified, root);

    // Torques: identified from, or the truth beside F/T sensors.
    let mut joints = Vec::new();
    let mut torques_predicted = Vec::new();
    let mut torque_share = Vec::new();
    let mut torque_series: Vec<TorqueSeries> = Vec::new();
    if layout.joints.is_empty() {
        let dofs = setup.model.dof_count();
        let mut errors = [vec![Vec::new(); dofs], vec![Vec::new(); dofs]];
        if instants.iter().any(|i| i.torque.iter().any(|x| x.is_finite())) {
            for (set, errors) in sets.iter().zip(&mut errors) {
                for instant in instants {
                    let row = maker
                        .torque_errors(instant, set.as_slice())
                        .unwrap_or_else(|_| vec![f64::NAN; dofs]);
                    errors.iter_mut().zip(row).for_each(|(e, x)| e.push(x));
                }
            }
            for (dof, cad) in errors[0].iter().enumerate() {
                if cad.iter().any(|x| x.is_finite()) {
                    let measured = instants.iter().map(|i| i.torque[dof]).collect();
                    let own = errors[1][dof].clone();
                    let series = [cad.clone(), cad.clone(), own.clone(), cad.clone(), own];
                    torque_series.push((dof, series, measured));
                }
            }
        }
    } else {
        for (place, &dof) in layout.joints.iter().enumerate() {
            let channel = wrenches + place;
            let measured: Vec<f64> = instants.iter().map(|i| i.torque[dof]).collect();
            let raw = left.measured[channel]
                .iter()
                .zip(&left.predicted[channel])
                .map(|(m, p)| m - p)
                .collect();
            let [cad, own] = [0, 1]
                .map(|set| with_friction_of_training(layout, instants, &left, (set, &candidates[set].friction), place));
            let fitted = [0, 1].map(|set| left.noise[set][channel].clone());
            let [cad_fitted, own_fitted] = fitted;
            torque_series.push((dof, [raw, cad_fitted, own_fitted, cad, own], measured));
        }
    }
    for (dof, errors, measured) in &torque_series {
        let smooth = |x: &[f64]| match &filter {
            Some(places) => places.low_passed(x),
            None => x.to_vec(),
        };
        let keep = |x: &[f64]| -> Vec<f64> { (0..x.len()).filter(inner).map(|i| x[i]).collect() };
        let errors = errors.each_ref().map(|e| keep(&smooth(e)));
        let [cad, fitted, own, ..] = &errors;
        let measured = keep(&smooth(measured));
        let place = layout.joints.binary_search(dof).ok();
        let of_training = both([3, 4].map(|set| rms(errors[set].iter().copied())));
        torques_predicted.push((setup.model.dof_name(*dof).to_owned(), of_training));
        joints.push(JointOutcome {
            name: setup.model.dof_name(*dof).to_owned(),
            rms_nm: three([cad, fitted, own].map(|x| rms(x.iter().copied()))),
            measured_rms_nm: rms(measured.iter().copied()),
            coverage: place.map_or(f64::NAN, |place| coverage[wrenches + place]),
        });
        torque_share.push((errors.to_vec(), measured));
    }

    let mut sensors = Vec::new();
    let mut findings = Vec::new();
    let mut wrench_share = Vec::new();
    for (place, &sensor) in layout.sensors.iter().enumerate() {
        let name = sensor_name(setup, sensor);
        let mut values = [[f64::NAN; 6]; 3];
        findings.extend(unexplained(
            setup,
            sensor,
            &name,
            untouched.as_ref().unwrap_or(&compared),
            place,
        ));
        for axis in 0..6 {
            let channel = channel_of(place, axis);
            let errors = compared.errors.each_ref().map(|set| &set[channel]);
            for (value, errors) in values.iter_mut().zip(errors) {
                value[axis] = rms(errors.iter().copied());
            }
            let scale = if axis < 3 { Structure::LENGTH_SCALE } else { 1.0 };
            let load = &compared.load[channel];
            let (centre, raw_mean) = (mean(load), mean(errors[0]));
            let errors: Vec<Vec<f64>> = (errors.iter().zip([raw_mean, 0.0, 0.0]))
                .map(|(errors, mean)| errors.iter().map(|x| (x - mean) * scale).collect())
                .collect();
            wrench_share.push((errors, load.iter().map(|x| (x - centre) * scale).collect::<Vec<_>>()));
        }
        sensors.push(SensorOutcome {
            name,
            rms: three(values),
            coverage: std::array::from_fn(|axis| coverage[channel_of(place, axis)]),
        });
    }
    let is_of_torque = !torque_share.is_empty();
    let share = if is_of_torque { &torque_share } else { &wrench_share };
    let relative = |which: usize| {
        let (mut above, mut below) = (0.0, 0.0);
        for (errors, measured) in share {
            for (e, m) in errors[which].iter().zip(measured) {
                if e.is_finite() && m.is_finite() {
                    above += e * e;
                    below += m * m;
                }
            }
        }
        (above / below).sqrt()
    };
    let yardstick = Yardstick::of_record(setup, &identified.inputs, identified.calibrated, instants);
    // Rows were made of these very instants before.
    let mut predicted = yardstick.map_or_else(
        |_| Predicted::default(),
        |yardstick| yardstick.predicted(layout, candidates),
    );
    predicted.joints = torques_predicted;
    if is_of_torque {
        predicted.relative_error = both([3, 4].map(relative));
    }
    let deviations = session_deviations(maker, log, instants, identified, root);
    LogOutcome {
        file: log.file.clone(),
        role: log.role,
        span: log.span,
        used: instants.len() as u64,
        left_out: log.left_out.clone(),
        onset: onset(instants),
        predicted,
        fitted_error: three([0, 1, 2].map(relative)),
        joints,
        sensors,
        two_route: two_route(maker, instants, &left, sets),
        offsets: offsets(setup, layout, log, identified, &left, &deviations),
        friction: friction(setup, layout, &left, &deviations),
        findings: log.all_findings().into_iter().chain(findings).collect(),
        curves: curves(maker, instants, &times, &compared, identified, root, &torque_series),
        spectra: spectra(setup, layout, places.as_ref(), &left),
    }
}

pub(super) fn both<T: Copy>([cad, identified]: [T; 2]) -> Both<T> {
    Both { cad, identified }
}

fn three<T: Copy>(values: [T; 3]) -> Three<T> {
    Three {
        cad: values[0],
        cad_fitted: values[1],
        identified: values[2],
    }
}

/// A log to validate with as if it were one to train on: without what something undeclared was found to act on, nor its share in the offsets. None if nothing was found, for then it is the same.
fn untouched(
    maker: &RowMaker<'_>,
    log: &Prepared,
    identified: &Identified,
    sets: &[DVector<f64>; 2],
) -> Option<Compared> {
    if log.touched.iter().all(UnitSet::is_empty) {
        return None;
    }
    let mut instants = log.instants.clone();
    for (instant, units) in instants.iter_mut().zip(&log.touched) {
        instant.suspected = *units;
    }
    let piece = super::passes::Piece {
        instants: &instants,
        breaks: &log.breaks,
    };
    let left = leave(maker, piece, &identified.noise, sets);
    Some(Compared::new(maker, &instants, &left, identified, sets))
}

/// What the identified parameters leave of a sensor's readings if it is far more than its noise. How much of what they change by that is depends on how much the log moves: it is told, and refuses nothing.
///
/// Of a log in which something undeclared acted, `compared` is of the rest; nothing is said of fewer than [`LEAST_FOLD`] instants.
fn unexplained(setup: &Setup, sensor: usize, name: &str, compared: &Compared, place: usize) -> Option<Finding> {
    /// More than so many times the stated noise, and than this share of what the axis changes by, is said.
    const TIMES: f64 = 10.0;
    const SHARE: f64 = 0.02;
    /// Correlation of an axis with its prediction that no noise makes.
    const AGAINST: f64 = -0.5;
    let noise = setup.structure.sensors()[sensor].noise();
    let noise = [noise.force, noise.torque].concat();
    // Where one of the sub-trees that the sensor is at says nothing, because something acts on it, the others' errors are laid to it alone.
    let all_rows = compared.rows[place].iter().copied().max().unwrap_or(0);
    let (mut left, mut all) = (0.0, 0.0);
    let (mut axes, mut turned) = (Vec::new(), Vec::new());
    for (axis, word) in AXES.into_iter().enumerate() {
        let channel = channel_of(place, axis);
        let pairs = compared.load[channel].iter().zip(&compared.errors[2][channel]);
        let is_told = |((l, e), rows): &((&f64, &f64), &usize)| l.is_finite() && e.is_finite() && **rows == all_rows;
        let pairs = pairs.zip(&compared.rows[place]).filter(is_told);
        let (load, error): (Vec<f64>, Vec<f64>) = pairs.map(|(pair, _)| pair).unzip();
        if load.len() < LEAST_FOLD {
            continue;
        }
        let centre = mean(&load);
        let load: Vec<f64> = load.iter().map(|x| x - centre).collect();
        let predicted: Vec<f64> = load.iter().zip(&error).map(|(l, e)| l - e).collect();
        let scale = if axis < 3 { Structure::LENGTH_SCALE } else { 1.0 };
        let [ll, ee, pp, lp] = [
            (&load, &load),
            (&error, &error),
            (&predicted, &predicted),
            (&load, &predicted),
        ]
        .map(|(a, b)| dot(a, b));
        (left, all) = (left + scale * scale * ee, all + scale * scale * ll);
        let times = (ee / load.len() as f64).sqrt() / noise[axis];
        if times > TIMES && ee > SHARE * SHARE * ll {
            axes.push(format!("{word} {times:.0}"));
            if lp < AGAINST * (ll * pp).sqrt() {
                turned.push(word);
            }
        }
    }
    if axes.is_empty() {
        return None;
    }
    let share = (left / all).sqrt();
    let hint = if turned.is_empty() {
        String::new()
    } else {
        format!(
            " {} against what is predicted: turned, or another axis.",
            turned.join(", ")
        )
    };
    Some(Finding {
        severity: Severity::Warning,
        code: "unexplained",
        subject: format!("wrench/{name}"),
        text: format!(
            "wrench/{name}: {:.0} % of what it changes by is left with the identified parameters (times the stated noise: {}).{hint} A joint's zero, sign or order, a dead encoder, an axis or the calibration of the sensor, stamps, cables or a contact that nobody declared may be wrong, or the log is of another robot; or noise_n, noise_nm state too little",
            100.0 * share,
            axes.join(", ")
        ),
    })
}

/// When something first moves by more than [`STILL`] from where it was; none if it never does, or within the first half second.
fn onset(instants: &[super::instants::Instant]) -> Option<Nanos> {
    let first = instants.first()?;
    let moved = instants.iter().find(|i| {
        i.position
            .iter()
            .zip(&first.position)
            .any(|(a, b)| (a - b).abs() > STILL)
    })?;
    ((moved.t - first.t).seconds() > 0.5).then_some(moved.t)
}

/// What is compared in a block: parameters, and the log's own unknowns with them. CAD with what is configured, CAD with what was fitted, what was identified.
fn cases<'a>(
    sets: &'a [DVector<f64>; 2],
    configured: &'a [f64],
    block: &'a Block,
) -> [(&'a DVector<f64>, &'a [f64]); 3] {
    let (fitted, own) = block.x.as_slice().split_at(block.x.nrows());
    [(&sets[0], configured), (&sets[0], fitted), (&sets[1], own)]
}

fn two_route(
    maker: &mut RowMaker<'_>,
    instants: &[super::instants::Instant],
    left: &Residuals,
    sets: &[DVector<f64>; 2],
) -> Vec<TwoRouteOutcome> {
    let setup = maker.setup();
    let layout = maker.layout().clone();
    let dofs = setup.model.dof_count();
    let configured = configured_session(setup, &layout);
    let mut series = vec![[const { Vec::new() }; 3]; dofs];
    let mut rows = Rows::new(&layout);
    for (range, block) in left.ranges.iter().zip(&left.session) {
        let cases = cases(sets, &configured, block);
        for instant in &instants[range.clone()] {
            if layout.sensors.len() < 2 || maker.make(instant, &mut rows).is_err() {
                continue;
            }
            for (dof, along) in maker.two_routes(&rows) {
                for (series, (d, session)) in series[dof].iter_mut().zip(cases) {
                    let left = |row: usize| rows.r(row) - dot(rows.a(row), d.as_slice()) - dot(rows.g(row), session);
                    series.push(along.iter().enumerate().map(|(row, weight)| weight * left(row)).sum());
                }
            }
        }
    }
    (0..dofs)
        .filter(|&dof| !series[dof][0].is_empty())
        .map(|dof| TwoRouteOutcome {
            joint: setup.model.dof_name(dof).to_owned(),
            rms_nm: three([0, 1, 2].map(|set| rms(series[dof][set].iter().copied()))),
            rms_mean_removed_nm: three([0, 1, 2].map(|set| {
                let centre = mean(&series[dof][set]);
                rms(series[dof][set].iter().map(|x| x - centre))
            })),
        })
        .collect()
}

/// Standard deviations of the log's own unknowns at its end: what the rows leave uncertain of them for known parameters, and what the parameters' own uncertainty adds.
fn session_deviations(
    maker: &mut RowMaker<'_>,
    log: &Prepared,
    instants: &[super::instants::Instant],
    identified: &Identified,
    root: &DMatrix<f64>,
) -> Vec<f64> {
    // The last of them tell it: an offset walks, and a filter that begins there with nothing known errs on the safe side.
    let piece = super::passes::Piece {
        instants: &instants[instants.len().saturating_sub(super::batch::LONG)..],
        breaks: &log.breaks,
    };
    let told = tell(maker, piece, &identified.noise);
    let moved = &told.slope * root;
    (0..told.covariance.nrows())
        .map(|i| (told.covariance[(i, i)].max(0.0) + moved.row(i).norm_squared()).sqrt())
        .collect()
}

/// Offsets of the sensors that the log has, where rows could be made of them.
fn offsets(
    setup: &Setup,
    layout: &Layout,
    log: &Prepared,
    identified: &Identified,
    left: &Residuals,
    deviations: &[f64],
) -> Vec<OffsetOutcome> {
    let (Some(first), Some(last)) = (left.session.first(), left.session.last()) else {
        return Vec::new();
    };
    let of = |place: usize, value: &dyn Fn(usize) -> f64| std::array::from_fn(|axis| value(channel_of(place, axis)));
    layout
        .sensors
        .iter()
        .enumerate()
        .filter(|(place, _)| (0..6).any(|axis| left.hears(6 * place + axis)))
        .map(|(place, &sensor)| OffsetOutcome {
            sensor: sensor_name(setup, sensor),
            start: of(place, &|channel| first.x[(channel, 1)]),
            end: of(place, &|channel| last.x[(channel, 1)]),
            deviation: of(place, &|channel| deviations[channel]),
            rate: of(place, &|channel| identified.noise.drift[channel].sqrt()),
            breaks: log.breaks.iter().filter(|b| b.sensor == sensor).map(|b| b.t).collect(),
        })
        .collect()
}

/// Friction of the joints whose torque the log has.
fn friction(setup: &Setup, layout: &Layout, left: &Residuals, deviations: &[f64]) -> Vec<FrictionOutcome> {
    let Some(last) = left.session.last() else {
        return Vec::new();
    };
    let first = 6 * layout.sensors.len();
    let value = |place: usize, k: usize| last.x[(first + FRICTION * place + k, 1)];
    layout
        .joints
        .iter()
        .enumerate()
        .filter(|(place, _)| left.hears(first + place))
        .map(|(place, &dof)| FrictionOutcome {
            joint: setup.model.dof_name(dof).to_owned(),
            coulomb_nm: value(place, 0),
            viscous: value(place, 1),
            offset_nm: value(place, 2),
            deviation: [0, 1, 2].map(|k| deviations[first + FRICTION * place + k]),
        })
        .collect()
}

/// What each F/T sensor reads, beside what everything else predicts that it should: the links on its contact-free side, and what their other sensors read.
///
/// Noise is estimated from residuals that are shared out among the sensors of a sub-tree ([`Residuals`]); a comparison of one sensor's reading must not give a part of its error to
/// another. So here all of it is laid to the one that is asked about ([`laid_to`]): of two sensors with a link between them, each is compared with the other.
pub(super) struct Compared {
    /// Per channel and instant: the reading less its fitted offset; NaN where it can not be compared.
    pub load: Vec<Vec<f64>>,
    /// The same less what is predicted: by CAD with the configured offsets, by CAD with fitted ones, by the identified parameters with fitted ones.
    pub errors: [Vec<Vec<f64>>; 3],
    /// Per sensor (place in the layout) and instant, how many rows have its reading: six of each sub-tree that it is at, unless something acts there.
    pub rows: Vec<Vec<usize>>,
}

impl Compared {
    /// `sets`: CAD, the identified parameters; `left`: of these two.
    pub(super) fn new(
        maker: &RowMaker<'_>,
        instants: &[super::instants::Instant],
        left: &Residuals,
        identified: &Identified,
        sets: &[DVector<f64>; 2],
    ) -> Self {
        let layout = maker.layout().clone();
        let configured = configured_session(maker.setup(), &layout);
        let empty = || vec![vec![f64::NAN; instants.len()]; 6 * layout.sensors.len()];
        let (mut load, mut errors) = (empty(), [empty(), empty(), empty()]);
        let variances = identified.noise.following();
        let channels = 6 * layout.sensors.len();
        let mut held = vec![vec![0; instants.len()]; layout.sensors.len()];
        let parts = parallel::map_with(
            left.ranges.len().div_ceil(TOGETHER),
            || (maker.clone(), Rows::new(&layout)),
            |(maker, rows), part| {
                let blocks = part * TOGETHER..left.ranges.len().min((part + 1) * TOGETHER);
                let mut out = Vec::new();
                for (range, block) in left.ranges[blocks.clone()].iter().zip(&left.session[blocks]) {
                    let cases = cases(sets, &configured, block);
                    let (_, own) = cases[2];
                    for instant in &instants[range.clone()] {
                        let start = out.len();
                        out.resize(start + channels, ([f64::NAN; 4], 0));
                        if channels == 0 || maker.make(instant, rows).is_err() {
                            continue;
                        }
                        let residuals = cases.map(|(d, s)| {
                            DVector::from_fn(rows.count, |row, _| {
                                rows.r(row) - dot(rows.a(row), d.as_slice()) - dot(rows.g(row), s)
                            })
                        });
                        for (place, &sensor) in layout.sensors.iter().enumerate() {
                            let Some(map) = laid_to(rows, &variances, 6 * place..6 * place + 6) else {
                                continue;
                            };
                            let has = |row: &usize| rows.g(*row)[6 * place..6 * place + 6].iter().any(|g| *g != 0.0);
                            let count = (0..rows.count).filter(has).count();
                            let reading = instant.readings[sensor];
                            let [cad, cad_fitted, identified] = residuals.each_ref().map(|residual| &map * residual);
                            for (k, value) in reading.torque.iter().chain(&reading.force).enumerate() {
                                let channel = 6 * place + k;
                                if rows.has(channel) {
                                    let values = [value - own[channel], cad[k], cad_fitted[k], identified[k]];
                                    out[start + channel] = (values, count);
                                }
                            }
                        }
                    }
                }
                out
            },
        );
        let places = left.ranges.iter().cloned().flatten();
        let each = parts.iter().flat_map(|part| part.chunks_exact(channels.max(1)));
        for (i, values) in places.zip(each) {
            for (channel, ([own, off @ ..], count)) in values.iter().enumerate() {
                load[channel][i] = *own;
                held[channel / 6][i] = held[channel / 6][i].max(*count);
                errors
                    .iter_mut()
                    .zip(off)
                    .for_each(|(errors, off)| errors[channel][i] = *off);
            }
        }
        Self {
            load,
            errors,
            rows: held,
        }
    }
}

/// The configured offsets, in the columns of the log's own unknowns.
fn configured_session(setup: &Setup, layout: &Layout) -> Vec<f64> {
    let mut configured = vec![0.0; layout.session()];
    for (place, &sensor) in layout.sensors.iter().enumerate() {
        for (axis, value) in setup.offsets[sensor].force_first().into_iter().enumerate() {
            configured[channel_of(place, axis)] = value;
        }
    }
    configured
}

/// The map from the residuals of rows (not whitened) to the noise of these channels that explains them, all other channels being taken to be exact: `V N^T (N V N^T)^-1`; none if no
/// row has any of them.
pub(super) fn laid_to(rows: &Rows, variances: &[f64], channels: std::ops::Range<usize>) -> Option<DMatrix<f64>> {
    /// Where several sub-trees disagree about the channels, the others take the rest, which must cost something.
    const OTHERS: f64 = 1e-6;
    let has = |row: &usize| rows.n(*row)[channels.clone()].iter().any(|x| *x != 0.0);
    let own: Vec<usize> = (0..rows.count).filter(has).collect();
    if own.is_empty() {
        return None;
    }
    let variance = |c: usize| variances[c] * if channels.contains(&c) { 1.0 } else { OTHERS };
    let n = DMatrix::from_fn(own.len(), variances.len(), |i, c| rows.n(own[i])[c]);
    let scaled = DMatrix::from_fn(own.len(), variances.len(), |i, c| n[(i, c)] * variance(c));
    let mut square = &scaled * n.transpose();
    let least = 1e-12 * square.diagonal().max();
    for i in 0..own.len() {
        square[(i, i)] += least;
    }
    let solved = square
        .cholesky()?
        .solve(&scaled.columns_range(channels.clone()).into_owned());
    let mut map = DMatrix::zeros(channels.len(), rows.count);
    for (i, row) in own.iter().enumerate() {
        map.set_column(*row, &solved.row(i).transpose());
    }
    Some(map)
}

/// Standard deviation of what is left of each channel at an instant: what the parameters' uncertainty and the noise of all channels that the prediction rests on make of it.
fn predicted_deviations(
    maker: &mut RowMaker<'_>,
    instant: &super::instants::Instant,
    identified: &Identified,
    root: &DMatrix<f64>,
) -> Vec<f64> {
    let layout = maker.layout().clone();
    let mut rows = Rows::new(&layout);
    let mut out = vec![f64::NAN; layout.channels()];
    if maker.make(instant, &mut rows).is_err() {
        return out;
    }
    let a = DMatrix::from_fn(rows.count, layout.unknowns(), |i, j| rows.a(i)[j]) * root;
    let noise = DMatrix::from_fn(rows.count, layout.channels(), |i, c| {
        rows.n(i)[c] * identified.noise.square[c].sqrt()
    });
    let wrenches = 6 * layout.sensors.len();
    let sensors = (0..layout.sensors.len()).map(|place| 6 * place..6 * place + 6);
    for channels in sensors.chain((wrenches..layout.channels()).map(|c| c..c + 1)) {
        let Some(map) = laid_to(&rows, &identified.noise.following(), channels.clone()) else {
            continue;
        };
        let (parameters, noise) = (&map * &a, &map * &noise);
        for (k, channel) in channels.enumerate().filter(|(_, channel)| rows.has(*channel)) {
            out[channel] = parameters.row(k).norm().hypot(noise.row(k).norm());
        }
    }
    out
}

/// Per channel, the share of its errors that are within 1.96 standard deviations, looked at here and there.
fn covered(
    maker: &mut RowMaker<'_>,
    instants: &[super::instants::Instant],
    errors: &[&[f64]],
    identified: &Identified,
    root: &DMatrix<f64>,
) -> Vec<f64> {
    let mut told = vec![(0.0, 0.0); errors.len()];
    for i in (0..instants.len()).step_by((instants.len() / 200).max(1)) {
        if errors.iter().all(|errors| !errors[i].is_finite()) {
            continue;
        }
        let deviations = predicted_deviations(maker, &instants[i], identified, root);
        for ((errors, deviation), (inside, count)) in errors.iter().zip(deviations).zip(&mut told) {
            if errors[i].is_finite() {
                *inside += f64::from(u8::from(errors[i].abs() <= 1.96 * deviation));
                *count += 1.0;
            }
        }
    }
    told.into_iter().map(|(inside, count)| inside / count).collect()
}

fn curves(
    maker: &mut RowMaker<'_>,
    instants: &[super::instants::Instant],
    times: &[f64],
    compared: &Compared,
    identified: &Identified,
    root: &DMatrix<f64>,
    torques: &[TorqueSeries],
) -> Vec<Curve> {
    let setup = maker.setup();
    let layout = maker.layout().clone();
    let wrenches = 6 * layout.sensors.len();
    let points: Vec<usize> = (0..instants.len())
        .step_by(instants.len().div_ceil(POINTS).max(1))
        .collect();
    // Uncertainty changes slowly: a tenth of the points, held between.
    let mut deviations: Vec<Vec<f64>> = Vec::new();
    for (number, &i) in points.iter().enumerate() {
        if number % 10 == 0 {
            deviations.push(predicted_deviations(maker, &instants[i], identified, root));
        }
    }
    let sigma = |channel: usize| -> Vec<f64> {
        (0..points.len())
            .map(|number| deviations[number / 10][channel])
            .collect()
    };
    let t: Vec<f64> = points.iter().map(|&i| times[i]).collect();
    let pick = |values: &dyn Fn(usize) -> f64| points.iter().map(|&i| values(i)).collect::<Vec<f64>>();
    let mut out = Vec::new();
    for (dof, errors, measured) in torques {
        let place = layout.joints.binary_search(dof).ok();
        out.push(Curve {
            name: setup.model.dof_name(*dof).to_owned(),
            unit: "Nm",
            t: t.clone(),
            measured: pick(&|i| measured[i]),
            cad_fitted: pick(&|i| measured[i] - errors[1][i]),
            identified: pick(&|i| measured[i] - errors[2][i]),
            sigma: place.map_or_else(|| vec![f64::NAN; points.len()], |place| sigma(wrenches + place)),
        });
    }
    for (place, &sensor) in layout.sensors.iter().enumerate() {
        for (axis, word) in AXES.into_iter().enumerate() {
            let channel = channel_of(place, axis);
            let load = &compared.load[channel];
            out.push(Curve {
                name: format!("{} {word}", sensor_name(setup, sensor)),
                unit: if axis < 3 { "N" } else { "Nm" },
                t: t.clone(),
                measured: pick(&|i| load[i]),
                cad_fitted: pick(&|i| load[i] - compared.errors[1][channel][i]),
                identified: pick(&|i| load[i] - compared.errors[2][channel][i]),
                sigma: sigma(channel),
            });
        }
    }
    out
}

/// Power spectra of the residuals: means over pieces of 256 instants, halves overlapping, each under a Hann window (Welch 1967).
fn spectra(setup: &Setup, layout: &Layout, places: Option<&Places>, left: &Residuals) -> Vec<Spectrum> {
    let Some(places) = places.filter(|places| places.at.len() >= SPECTRUM) else {
        return Vec::new();
    };
    let (rate, welch) = (places.rate, Welch::new());
    let density = |values: &[f64]| welch.density(&places.spread(values), rate);
    (0..layout.channels())
        .map(|channel| Spectrum {
            name: channel_name(setup, layout, channel).0,
            frequency: (1..=SPECTRUM / 2).map(|k| k as f64 * rate / SPECTRUM as f64).collect(),
            cad_fitted: density(&left.noise[0][channel]),
            identified: density(&left.noise[1][channel]),
        })
        .collect()
}

/// Power spectral densities as means over Hann windows of [`SPECTRUM`] samples that overlap by half (Welch 1967).
struct Welch {
    window: Vec<f64>,
    transform: Arc<dyn Fft<f64>>,
}

impl Welch {
    fn new() -> Self {
        let turn = std::f64::consts::PI / SPECTRUM as f64;
        Self {
            window: (0..SPECTRUM).map(|i| (turn * (i as f64 + 0.5)).sin().powi(2)).collect(),
            transform: FftPlanner::new().plan_fft_forward(SPECTRUM),
        }
    }

    /// One-sided density \[unit^2/Hz\] of a series with so many samples a second, at the multiples 1 to [`SPECTRUM`] / 2 of `rate / SPECTRUM`, without the windows in which a sample is
    /// missing; NaN if that is all of them.
    fn density(&self, series: &[f64], rate: f64) -> Vec<f64> {
        let power: f64 = self.window.iter().map(|w| w * w).sum();
        let (mut sums, mut pieces) = (vec![0.0; SPECTRUM / 2], 0.0);
        let mut values = vec![Complex::default(); SPECTRUM];
        for piece in series.windows(SPECTRUM).step_by(SPECTRUM / 2) {
            if piece.iter().any(|x| !x.is_finite()) {
                continue;
            }
            pieces += 1.0;
            for ((value, x), w) in values.iter_mut().zip(piece).zip(&self.window) {
                *value = Complex::from(x * w);
            }
            self.transform.process(&mut values);
            for (sum, value) in sums.iter_mut().zip(&values[1..]) {
                *sum += 2.0 * value.norm_sqr() / (power * rate);
            }
        }
        sums.iter().map(|sum| sum / pieces).collect()
    }
}

/// Where instants are among equally spaced ones: a filter or a spectrum must see that time passes where a log has none.
struct Places {
    at: Vec<usize>,
    /// \[Hz\].
    rate: f64,
}

impl Places {
    /// Of ascending times \[s\], spaced by about their median distance; none if there is no such distance. Of a longer gap no more is kept than shows that there is one.
    fn new(times: &[f64]) -> Option<Self> {
        let steps: Vec<f64> = times.windows(2).map(|two| two[1] - two[0]).collect();
        let mut sorted = steps.clone();
        sorted.sort_by(f64::total_cmp);
        let median = *sorted.get(sorted.len() / 2).filter(|period| **period > 0.0)?;
        // Stamps may be as coarse as a tenth of their distance: the mean of what is about one distance is finer than the median.
        let near = || steps.iter().filter(|step| (0.5..1.5).contains(&(**step / median)));
        let rate = near().count() as f64 / near().sum::<f64>();
        let longest = samples(BRIDGED, rate) + 2;
        let mut at = vec![0];
        for step in &steps {
            // From the one before, so that stamps may wander against the clock.
            let places = ((step * rate).round() as usize).clamp(1, longest);
            at.push(at[at.len() - 1] + places);
        }
        Some(Self { at, rate })
    }

    /// Values of the instants among equally spaced ones, NaN where there is no instant.
    fn spread(&self, values: &[f64]) -> Vec<f64> {
        let mut series = vec![f64::NAN; self.at.last().map_or(0, |last| last + 1)];
        for (&place, &value) in self.at.iter().zip(values) {
            series[place] = value;
        }
        series
    }

    fn low_passed(&self, values: &[f64]) -> Vec<f64> {
        let smooth = low_passed(&self.spread(values), self.rate);
        self.at.iter().map(|&place| smooth[place]).collect()
    }
}

/// So many samples are that long \[s\].
fn samples(seconds: f64, rate: f64) -> usize {
    (seconds * rate).round() as usize
}

/// A series through [`zero_phase`], where numbers are missing (NaN). Gaps of up to [`BRIDGED`] are bridged by a line; longer ones are ends, and as at the ends of the log [`EDGE`] of
/// what is there is not given. What is missing stays missing.
fn low_passed(values: &[f64], rate: f64) -> Vec<f64> {
    let samples = |seconds: f64| samples(seconds, rate);
    let there: Vec<usize> = (0..values.len()).filter(|&i| values[i].is_finite()).collect();
    let mut out = vec![f64::NAN; values.len()];
    let mut rest = there.as_slice();
    while let (Some(&first), false) = (rest.first(), rest.is_empty()) {
        let end = rest.windows(2).position(|w| w[1] - w[0] > samples(BRIDGED) + 1);
        let (run, behind) = rest.split_at(end.map_or(rest.len(), |i| i + 1));
        rest = behind;
        let last = run[run.len() - 1];
        let mut line = Vec::with_capacity(last + 1 - first);
        for pair in run.windows(2) {
            let (a, b) = (values[pair[0]], values[pair[1]]);
            let steps = (pair[1] - pair[0]) as f64;
            line.extend((0..pair[1] - pair[0]).map(|k| a + (b - a) * k as f64 / steps));
        }
        line.push(values[last]);
        let smooth = zero_phase(&line, rate);
        let low = if first > 0 { first + samples(EDGE) } else { 0 };
        let high = if last + 1 < values.len() {
            last.saturating_sub(samples(EDGE))
        } else {
            last
        };
        for &i in run.iter().filter(|i| (low..=high).contains(i)) {
            out[i] = smooth[i - first];
        }
    }
    out
}

/// Fourth-order Butterworth low pass, forwards and backwards; `rate` samples a second. The ends are continued by reflection.
fn zero_phase(values: &[f64], rate: f64) -> Vec<f64> {
    let pad = ((rate / CUT_OFF) as usize * 3).min(values.len().saturating_sub(1));
    if pad == 0 || rate < 4.0 * CUT_OFF {
        return values.to_vec();
    }
    let (first, last) = (values[0], values[values.len() - 1]);
    let mut x: Vec<f64> = (1..=pad).rev().map(|i| 2.0 * first - values[i]).collect();
    x.extend_from_slice(values);
    x.extend((1..=pad).map(|i| 2.0 * last - values[values.len() - 1 - i]));
    let k = (std::f64::consts::PI * CUT_OFF / rate).tan();
    for _ in 0..2 {
        for angle in [1.0, 3.0].map(|m| m * std::f64::consts::PI / 8.0) {
            let q = 1.0 / (2.0 * f64::cos(angle));
            let norm = 1.0 / (1.0 + k / q + k * k);
            let (b, a1, a2) = (k * k * norm, 2.0 * (k * k - 1.0) * norm, (1.0 - k / q + k * k) * norm);
            // In the steady state of its first value.
            let (mut s1, mut s2) = (x[0] * (1.0 - b), x[0] * (b - a2));
            for value in &mut x {
                let y = b * *value + s1;
                s1 = 2.0 * b * *value - a1 * y + s2;
                s2 = b * *value - a2 * y;
                *value = y;
            }
        }
        x.reverse();
    }
    x[pad..pad + values.len()].to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use std::path::Path;

    fn setup() -> Setup {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/icub_left_arm/estimator.toml");
        Setup::new(&Config::load(&file).unwrap()).unwrap()
    }

    /// A tenth is left of what each axis changes by, at so many instants.
    fn a_tenth_left(instants: usize) -> Option<Finding> {
        let setup = setup();
        let mut load: Vec<f64> = (0..400).map(|i| 100.0 * (0.3 * f64::from(i)).sin()).collect();
        load[instants..].fill(f64::NAN);
        let error = load.iter().map(|load| 0.1 * load).collect();
        let compared = Compared {
            rows: vec![vec![6; load.len()]],
            load: vec![load; 6],
            errors: [Vec::new(), Vec::new(), vec![error; 6]],
        };
        unexplained(&setup, 0, "ft", &compared, 0)
    }

    #[test]
    fn of_what_is_hardly_compared_nothing_is_said() {
        assert!(a_tenth_left(LEAST_FOLD).is_some());
        assert!(a_tenth_left(LEAST_FOLD - 1).is_none());
        assert!(a_tenth_left(0).is_none());
    }

    /// As one that is taken by itself out of the matrix finds them, column by column.
    #[test]
    fn columns_that_others_combine_to_are_found() {
        let one_by_one = |matrix: &DMatrix<f64>, column: usize| {
            let mut rest = matrix.column(column).normalize();
            let svd = matrix.clone().remove_column(column).svd(true, false);
            let (axes, sizes) = (svd.u.unwrap(), &svd.singular_values);
            for (axis, _) in axes
                .column_iter()
                .zip(sizes)
                .filter(|(_, size)| **size > 1e-10 * sizes.max())
            {
                rest.axpy(-axis.dot(&rest), &axis, 1.0);
            }
            rest.norm() < 1e-5
        };
        // Links in columns 0 to 19 of which 3 are nothing but sums and 2 are nothing, rotors in the others: each as it is, or as a change makes it.
        let random = DMatrix::from_vec(30, 26, crate::identify::normals(11, 30 * 26));
        let with = |change: &dyn Fn(&mut DMatrix<f64>)| {
            let mut matrix = random.clone();
            for column in 0..20 {
                matrix
                    .column_mut(column)
                    .scale_mut(10.0_f64.powi(column as i32 % 5 - 4));
            }
            for (sum, a, b) in [(3, 0, 7), (9, 1, 3), (12, 4, 9)] {
                let own = 2.0 * matrix.column(a) - matrix.column(b);
                matrix.set_column(sum, &own);
            }
            [5, 17]
                .into_iter()
                .for_each(|column| matrix.column_mut(column).fill(0.0));
            change(&mut matrix);
            matrix
        };
        let set = |matrix: &mut DMatrix<f64>, column: usize, own: DVector<f64>| matrix.set_column(column, &own);
        type Change<'a> = &'a dyn Fn(&mut DMatrix<f64>);
        let cases: [(Change<'_>, &[usize]); 6] = [
            (&|_| (), &[]),
            // Of links alone, and long beside them.
            (&|m| set(m, 21, 3e4 * m.column(2) + 1e5 * m.column(12)), &[21]),
            // Of links and another rotor: neither is known, nor can be.
            (&|m| set(m, 22, m.column(2) - m.column(24)), &[22, 24]),
            // Of links, as one of a pair with another is.
            (
                &|m| {
                    set(m, 20, m.column(0) * 1e3);
                    set(m, 25, m.column(23) + m.column(20));
                },
                &[20, 23, 25],
            ),
            // Nearly, and not.
            (&|m| set(m, 21, m.column(14) + 1e-7 * m.column(21)), &[21]),
            (&|m| set(m, 21, m.column(14) + 1e-3 * m.column(21)), &[]),
        ];
        for (change, expected) in cases {
            let (matrix, rotors) = (with(change), [20, 21, 22, 23, 24, 25]);
            let alone: Vec<usize> = rotors
                .into_iter()
                .filter(|&column| one_by_one(&matrix, column))
                .collect();
            assert_eq!(combinations(&matrix, &rotors), alone);
            assert_eq!(alone, expected);
        }
    }

    /// Its integral is the variance (Parseval), it is flat for white noise, and a wave stands where its frequency is.
    #[test]
    fn a_spectrum_shares_out_the_variance() {
        let rate = 100.0;
        let wave = |i: usize| 2.0 * (2.0 * std::f64::consts::PI * 12.5 * i as f64 / rate).sin();
        let mut series: Vec<f64> = crate::identify::normals(3, 50_000);
        series.iter_mut().enumerate().for_each(|(i, x)| *x += wave(i));
        series[7000] = f64::NAN;
        let density = Welch::new().density(&series, rate);
        let step = rate / SPECTRUM as f64;
        // The wave's is spread by the window over two neighbours.
        let peak = (12.5 / step) as usize - 1;
        let share: f64 = density[peak - 2..=peak + 2].iter().sum::<f64>() * step;
        assert!((share - 2.04).abs() < 0.03, "{share}");
        let rest = density[..peak - 2].iter().chain(&density[peak + 3..]);
        assert!(rest.clone().all(|x| (x / 0.02 - 1.0).abs() < 0.35), "{density:?}");
        assert!((rest.sum::<f64>() * step - 0.96).abs() < 0.05);
    }

    /// One link whose directions are known from hardly at all to a ten thousandth of the prior's spread; moved by ten standard deviations in the best known one.
    #[test]
    fn what_is_known_best_counts_first_for_significance() {
        let share: Vec<f64> = (0..10).map(|i| 10f64.powf(-0.9 * f64::from(i))).collect();
        let root = DMatrix::from_diagonal(&DVector::from_fn(10, |i, _| share[i].sqrt()));
        // With the prior's precision the unit matrix, P times its root is P.
        let shrinking = &root * &root;
        let moved = |direction: usize, deviations: f64| {
            let mut change = DVector::zeros(10);
            change[direction] = deviations * (share[direction] - share[direction].powi(2)).sqrt();
            significance(&root, &shrinking, &change)
        };
        // Nine directions count: sqrt(2 x 100) - sqrt(2 x 9 - 1).
        let expected = 200f64.sqrt() - 17f64.sqrt();
        for direction in [3, 9] {
            let found = moved(direction, 10.0);
            assert!(
                (found - expected).abs() < 1e-6 * expected,
                "{direction}: {found} {expected}"
            );
        }
        assert_eq!(moved(0, 10.0), 0.0, "the logs say nothing of it");
        assert_eq!(moved(9, 1.0), 0.0, "chance");
    }

    /// The square that a covariance's root stands for.
    fn squared(root: &DMatrix<f64>) -> DMatrix<f64> {
        root * root.transpose()
    }

    #[test]
    fn what_is_shrunk_to_cad_is_as_uncertain_as_cad() {
        let mut state = 1.0_f64;
        let mut next = || {
            state = (state * 1.7 + 0.31).fract();
            state - 0.5
        };
        // Two links that no row has together.
        let mut narrow = DMatrix::zeros(20, 20);
        for place in [0, 10] {
            let own = DMatrix::from_fn(10, 10, |_, _| 0.01 * next());
            narrow.view_mut((place, place), (10, 10)).copy_from(&own);
        }
        let spread: Vec<DMatrix<f64>> = (0..2).map(|_| DMatrix::from_fn(10, 10, |_, _| next())).collect();
        let mut cad = DMatrix::zeros(20, 20);
        for (place, spread) in spread.iter().enumerate() {
            cad.view_mut((10 * place, 10 * place), (10, 10)).copy_from(spread);
        }
        let block = |m: &DMatrix<f64>, place: usize| m.view((10 * place, 10 * place), (10, 10)).into_owned();
        let all = squared(&narrow);
        for (kept, back) in [(1.0, 0.0), (0.0, 1.0), (0.7, 0.3)] {
            let found = squared(&shrunk(&narrow, &cad, &[[kept; 10], [1.0; 10]].concat()));
            let expected = block(&all, 0) * (1.0 - back * back) + squared(&spread[0]) * (back * back);
            assert!((block(&found, 0) - expected).amax() < 1e-12, "{kept}");
            assert!(
                (block(&found, 1) - block(&all, 1)).amax() < 1e-12,
                "{kept}: the other link's"
            );
        }
    }

    /// CAD's bodies are off by the prior's spread; what was fitted with them is off by what they make of that, and by noise.
    #[test]
    fn what_is_fitted_with_cads_bodies_has_their_errors() {
        let mut state = 0.7_f64;
        let mut next = || {
            state = (state * 1.9 + 0.37).fract();
            state - 0.5
        };
        let layout = Layout {
            links: vec![2],
            further: vec![Further::RotorInertia(0), Further::RotorInertia(1)],
            precision: vec![0.5, 2.0],
            ..Layout::default()
        };
        let r = DMatrix::from_fn(12, 12, |_, _| 3.0 * next());
        let spread = DMatrix::from_fn(10, 10, |_, _| next());
        let found = squared(&cad_root(&layout, &r, std::slice::from_ref(&spread)));
        let (links, rotors) = (r.columns(0, 10).into_owned(), r.columns(10, 2).into_owned());
        let mut precision = rotors.transpose() * &rotors;
        for (place, own) in layout.precision.iter().copied().enumerate() {
            precision[(place, place)] += own;
        }
        let inverse = precision.try_inverse().expect("known");
        let slope = &inverse * rotors.transpose() * links;
        let bodies = squared(&spread);
        let close = |name: &str, found: DMatrix<f64>, expected: DMatrix<f64>| {
            assert!(
                (&found - &expected).amax() < 1e-9 * expected.amax(),
                "{name}: {found} {expected}"
            );
        };
        close("bodies", found.view((0, 0), (10, 10)).into_owned(), bodies.clone());
        close("both", found.view((10, 0), (2, 10)).into_owned(), -(&slope * &bodies));
        let own = &slope * &bodies * slope.transpose() + inverse;
        close("rotors", found.view((10, 10), (2, 2)).into_owned(), own);
    }

    #[test]
    fn weak_directions_are_told_in_the_parameters_own_units() {
        let setup = setup();
        let layout = Layout {
            links: vec![3, 5],
            ..Layout::default()
        };
        // kg, kg m and kg m^2 are uncertain by 1, 0.1 and 0.01; m and h_x of the second link together besides.
        let scale = |k: usize| [1.0, 0.1, 0.01][usize::from(k > 0) + usize::from(k > 3)];
        let plain = DMatrix::from_diagonal(&DVector::from_fn(10, |k, _| scale(k)));
        let mut mixed = plain.clone();
        mixed[(1, 0)] = 0.05;
        let mut direction = DVector::zeros(20);
        (direction[0], direction[2], direction[4]) = (1.0, -0.5, 0.05);
        let first = setup.model.link_name(3);
        assert_eq!(
            expression(&setup, &layout, &[plain.clone(), mixed.clone()], &direction),
            // m / 1 - 0.5 h_y / 0.1, and too little of I_xx.
            (format!("{first}.m - 5 {first}.h_y"), vec![layout.links[0]])
        );
        // h_x / 0.1 of what h_x is beside its share of m: (h_x - 0.05 m) / 0.1.
        let direction = DVector::from_fn(20, |k, _| f64::from(u8::from(k == 11)));
        let second = setup.model.link_name(5);
        assert_eq!(
            expression(&setup, &layout, &[plain, mixed], &direction),
            (format!("{second}.h_x - 0.05 {second}.m"), vec![layout.links[1]])
        );
    }

    /// A log with gaps, stamped to a millisecond: a wave is where it is in time, and as narrow, in spite of all that is missing.
    #[test]
    fn a_spectrum_knows_of_gaps() {
        let period = 0.0103;
        let bursts = (0..20_000).filter(|i| i % 1000 < 350);
        let times: Vec<f64> = bursts.map(|i| (1e3 * period * f64::from(i)).round() / 1e3).collect();
        let places = Places::new(&times).expect("a period");
        assert!((places.rate * period - 1.0).abs() < 1e-3, "{}", places.rate);
        let wave = |t: &f64| (std::f64::consts::TAU * 12.5 * t).sin();
        let values: Vec<f64> = times.iter().map(wave).collect();
        let density = Welch::new().density(&places.spread(&values), places.rate);
        let step = places.rate / SPECTRUM as f64;
        let peak = (12.5 / step).round() as usize - 1;
        let share: f64 = density[peak - 2..=peak + 2].iter().sum::<f64>() * step;
        assert!((share - 0.5).abs() < 0.02, "{share}");
        let all: f64 = density.iter().sum::<f64>() * step;
        assert!((all - 0.5).abs() < 0.02, "{all}");
    }

    /// A gap of days takes no more room than one of a second, and is a gap all the same.
    #[test]
    fn places_of_a_gap_of_days_are_few() {
        let times = |gap: f64| -> Vec<f64> {
            let after = |i: u32| if i < 500 { 0.0 } else { gap };
            (0..1000).map(|i| 0.01 * f64::from(i) + after(i)).collect()
        };
        let places = |gap| Places::new(&times(gap)).expect("a period");
        let days = places(1e6);
        assert!(days.at[999] < 1010, "{}", days.at[999]);
        let values: Vec<f64> = (0..1000).map(|i| (0.02 * f64::from(i)).sin()).collect();
        let (days, second) = (days.low_passed(&values), places(1.0).low_passed(&values));
        for (days, second) in days.iter().zip(&second) {
            let same = (days - second).abs() < 1e-6 || days.is_nan() && second.is_nan();
            assert!(same, "{days} {second}");
        }
        assert!(days[499].is_nan() && days[500].is_nan() && days[400].is_finite());
    }

    #[test]
    fn missing_samples_spoil_only_their_surroundings_of_a_filtered_curve() {
        let rate = 1000.0;
        let clean: Vec<f64> = (0..6000).map(|i| (6.0 * f64::from(i) / rate).sin()).collect();
        let whole = zero_phase(&clean, rate);
        let mut holed = clean.clone();
        holed[1500] = f64::NAN;
        holed[3000..3400].fill(f64::NAN);
        let found = low_passed(&holed, rate);
        let near = |i: usize, gap: std::ops::Range<usize>| i + 300 >= gap.start && i < gap.end + 300;
        for (i, (found, whole)) in found.iter().zip(&whole).enumerate() {
            if i == 1500 || near(i, 3000..3400) {
                assert!(found.is_nan(), "{i}");
            } else {
                assert!((found - whole).abs() < 2e-3, "{i}: {found} {whole}");
            }
        }
        assert_eq!(low_passed(&clean, rate), whole);
        // A log without these rows tells the same where it has any.
        let there: Vec<usize> = (0..6000).filter(|i| !(3000..3400).contains(i)).collect();
        let times: Vec<f64> = there.iter().map(|&i| i as f64 / rate).collect();
        let values: Vec<f64> = there.iter().map(|&i| holed[i]).collect();
        let closed = Places::new(&times).expect("a period").low_passed(&values);
        for (&i, value) in there.iter().zip(closed) {
            let same = (value - found[i]).abs() < 1e-5 || value.is_nan() && found[i].is_nan();
            assert!(same, "{i}: {value} {}", found[i]);
        }
        assert!(low_passed(&[f64::NAN; 10], rate).iter().all(|x| x.is_nan()));
    }
}
