//! What a demonstration comes to: `estimates.csv`, `summary.json` and `report.html`.
//!
//! `summary.json`, beside the counts of frames, samples, estimates and the latencies:
//!
//! | key | meaning |
//! |---|---|
//! | `torque_rms_error_nm` | of each joint, estimated less true torque, RMS \[Nm\]: from 10 s of motion on; in a run too short for that, from 1 s after the first estimate on |
//! | `valid_share` | share of the torques that were not withheld, in that same time |
//! | `identification.cad_error` | how far masses and first moments of `cad.urdf` are off, as a share of them; moments of inertia by about as much |
//! | `identification.refused` | why nothing was identified; null if something was |
//! | `identification.max_torque_std_nm` | the bound of the standard deviation beyond which a torque is withheld \[Nm\] |
//! | `identification.moving_since_s`, `.settled_since_s` | when the motion began, and 10 s later; \[s\] after the first estimate; null if the run ended before |
//! | `identification.before` | of the time in which the robot stood still (from 1 s after the first estimate on); null where nothing can be said |
//! | `identification.learning` | of the first 10 s of motion; likewise |
//! | `identification.after` | of the time from 10 s of motion on; likewise |
//! | `identification.solutions` | how many solutions were put in force |
//! | `identification.parameters_within_2_sigma` | share of the identified links' parameters whose true value is within twice the stated standard deviation of the last solution; null without one |
//! | `rate_hz` | estimates per second |
//! | `late`, `lost_estimates`, `foreign` | samples too late for their estimate; estimates that this program missed; frames received beyond those that the simulated robot sent |
//! | `simulator` | what `proprio simulate --json` says |
//!
//! Each of the three phases holds `cad` and `identified`: of each joint the RMS error \[Nm\] by the wrong URDF alone, and by what is identified on-line, numbers of withheld torques included;
//! `valid_share`; and `within_2_sigma`, the share of the torques whose error is within twice the stated standard deviation.

use super::{Args, Experiment, JointTorque, Watched};
use crate::report::plot::{Axis, Ink, Plot, Series, Shade};
use crate::report::{self, Cell, Table as ReportTable};
use anyhow::{Context, bail};
use proprio_estimator::offline::Table;
use proprio_estimator::pipeline::Estimate;
use proprio_topics::csv::{self, Value};
use proprio_topics::{Kind, Nanos, Reading};
use serde_json::json;
use std::fs::{self, File};
use std::io::{BufReader, BufWriter, Write};
use std::path::Path;

/// Errors count from this long after the first estimate.
const START: Nanos = Nanos::from_millis(1000);
/// What was learnt is judged from this long after the onset of motion.
const LEARNING: Nanos = Nanos::from_millis(10_000);
/// Stretches of a plot closer together than this are one \[s\].
const GAP: f64 = 0.05;

/// The simulator's truth: joint torques over time.
struct Truth {
    t: Vec<Nanos>,
    /// Per joint, its torque at each of `t`.
    torques: Vec<Vec<f64>>,
}

impl Truth {
    fn read(file: &Path, joints: &[String]) -> anyhow::Result<Self> {
        let mut reader = csv::Reader::new(BufReader::new(File::open(file)?))?;
        let series: Vec<Option<usize>> = joints
            .iter()
            .map(|j| {
                reader
                    .series()
                    .iter()
                    .position(|s| s.what == csv::What::Channel(Kind::Joint) && s.name == *j)
            })
            .collect();
        let mut this = Self {
            t: vec![],
            torques: vec![vec![]; joints.len()],
        };
        let mut row = csv::Row::default();
        while reader.next_row(&mut row)? {
            let Some(t) = row.t else { continue };
            this.t.push(t);
            for (torques, series) in this.torques.iter_mut().zip(&series) {
                let torque = row
                    .items
                    .iter()
                    .find(|i| Some(i.series) == *series)
                    .and_then(|i| match i.value {
                        Value::Reading(Reading::Joint(state), _) => Some(state.torque),
                        _ => None,
                    });
                torques.push(torque.unwrap_or(f64::NAN));
            }
        }
        Ok(this)
    }

    /// The torque of joint `joint` at `t`, on a straight line between two rows; NaN outside them.
    fn torque(&self, joint: usize, t: Nanos) -> f64 {
        let after = self.t.partition_point(|x| *x < t);
        let row = |i: usize| Some((*self.t.get(i)?, *self.torques.get(joint)?.get(i)?));
        match (row(after), after.checked_sub(1).and_then(row)) {
            (Some((t1, y1)), _) if t1 == t => y1,
            (Some((t1, y1)), Some((t0, y0))) => y0 + (y1 - y0) * ((t - t0).seconds() / (t1 - t0).seconds()),
            _ => f64::NAN,
        }
    }
}

/// The q-quantile of sorted numbers.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = ((sorted.len() as f64 - 1.0) * q).round().max(0.0) as usize;
    sorted.get(at).copied().unwrap_or(f64::NAN)
}

/// The share that `part` is of `whole`; NaN of nothing.
fn ratio(part: usize, whole: usize) -> f64 {
    part as f64 / whole as f64
}

/// Every estimate beside the truth and beside what the CAD makes of the same samples.
struct Compared {
    /// When the first estimate was: where the report's time begins.
    first: Nanos,
    /// When the robot began to move, and 10 s later.
    moving: Nanos,
    settled: Nanos,
    /// Per joint, per instant.
    joints: Vec<Vec<Instant>>,
}

/// One torque at one instant.
#[derive(Clone, Copy)]
struct Instant {
    t: Nanos,
    estimate: JointTorque,
    /// By the CAD alone, and what it really is \[Nm\]; NaN where unknown.
    cad: f64,
    truth: f64,
}

impl Instant {
    fn error(&self) -> f64 {
        self.estimate.torque - self.truth
    }
}

impl Compared {
    fn new(watched: &Watched, truth: &Truth, still: f64) -> anyhow::Result<Self> {
        let first = watched.estimates.first().map_or(Nanos::ZERO, |seen| seen.t);
        let began = watched.simulator["t0"].as_i64().context("when the simulation began")?;
        let moving = Nanos(began) + Nanos::from_seconds(still);
        let mut joints = vec![Vec::with_capacity(watched.estimates.len()); watched.joints.len()];
        let mut baseline = watched.baseline.iter().peekable();
        for seen in &watched.estimates {
            while baseline.next_if(|(t, _)| *t < seen.t).is_some() {}
            let cad = baseline
                .peek()
                .filter(|(t, _)| *t == seen.t)
                .map(|(_, torques)| torques);
            for ((joint, instants), estimate) in joints.iter_mut().enumerate().zip(&seen.joints) {
                instants.push(Instant {
                    t: seen.t,
                    estimate: *estimate,
                    cad: cad.and_then(|torques| torques.get(joint)).copied().unwrap_or(f64::NAN),
                    truth: truth.torque(joint, seen.t),
                });
            }
        }
        Ok(Self {
            first,
            moving,
            settled: moving + LEARNING,
            joints,
        })
    }

    /// Seconds of the report.
    fn time(&self, t: Nanos) -> f64 {
        (t - self.first).seconds()
    }

    /// What torques were worth from `from` on until before `until`; none if one joint has none that can be compared.
    fn phase(&self, from: Nanos, until: Nanos) -> Option<Phase> {
        let (mut phase, mut count, mut valid, mut within, mut known) = (Phase::default(), 0, 0, 0, 0);
        for instants in &self.joints {
            let inside = instants
                .iter()
                .filter(|i| i.t >= from && i.t < until && i.truth.is_finite());
            let (mut cad, mut identified, mut size) = (Mean::default(), Mean::default(), Mean::default());
            for instant in inside {
                count += 1;
                valid += usize::from(instant.estimate.valid == 1);
                if instant.estimate.torque.is_finite() {
                    known += 1;
                    within += usize::from(instant.error().abs() <= 2.0 * instant.estimate.standard_deviation);
                    identified.see(instant.error());
                    size.see(instant.truth);
                }
                if instant.cad.is_finite() {
                    cad.see(instant.cad - instant.truth);
                }
            }
            phase.identified.push(identified.rms()?);
            phase.cad.push(cad.rms().unwrap_or(f64::NAN));
            phase.size.push(size.rms()?);
        }
        (phase.valid_share, phase.within_2_sigma) = (ratio(valid, count), ratio(within, known));
        Some(phase)
    }
}

/// The root of a mean of squares.
#[derive(Default)]
struct Mean {
    sum: f64,
    count: u32,
}

impl Mean {
    fn see(&mut self, value: f64) {
        self.sum += value * value;
        self.count += 1;
    }

    fn rms(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.sum / f64::from(self.count)).sqrt())
    }
}

/// A part of the run.
#[derive(Default)]
struct Phase {
    /// Per joint, RMS errors and RMS torque \[Nm\].
    cad: Vec<f64>,
    identified: Vec<f64>,
    size: Vec<f64>,
    valid_share: f64,
    within_2_sigma: f64,
}

impl Phase {
    fn json(phase: Option<&Self>, names: &[String]) -> serde_json::Value {
        let Some(phase) = phase else {
            return serde_json::Value::Null;
        };
        let of = |values: &[f64]| -> serde_json::Map<_, _> {
            let named = names.iter().zip(values);
            named.map(|(name, value)| (name.clone(), json!(value))).collect()
        };
        json!({
            "cad": of(&phase.cad), "identified": of(&phase.identified),
            "valid_share": phase.valid_share, "within_2_sigma": phase.within_2_sigma,
        })
    }
}

/// Stretches in which `is` holds, close ones joined.
fn stretches(instants: impl Iterator<Item = (f64, bool)>) -> Vec<(f64, f64)> {
    let mut found: Vec<(f64, f64)> = vec![];
    let mut last = f64::NAN;
    for (t, is) in instants {
        match found.last_mut() {
            _ if !is => {}
            Some((_, until)) if t - *until < GAP => *until = t,
            // It begins where the last one that is not ended.
            _ => found.push((if last.is_nan() { t } else { last }, t)),
        }
        last = t;
    }
    found
}

/// Figure 3 of the paper: the torque of a joint, true, by the CAD, and identified with its band; and its error.
fn torque_plots(name: &str, instants: &[Instant], compared: &Compared, touched: &[(f64, f64)]) -> [Plot; 2] {
    let withheld = stretches(instants.iter().map(|i| (compared.time(i.t), i.estimate.valid != 1)));
    let plot = |title: &str, note: &str, series| Plot {
        title: title.to_owned(),
        note: note.to_owned(),
        x: Axis::new("t [s]"),
        y: Axis::new("torque [Nm]"),
        series,
        marks: vec![(compared.time(compared.moving), "onset of motion".to_owned())],
        shades: vec![(Shade::Withheld, withheld.clone()), (Shade::Touched, touched.to_vec())],
        ..Plot::default()
    };
    let line = |of: &dyn Fn(&Instant) -> f64| -> Vec<(f64, f64)> {
        instants.iter().map(|i| (compared.time(i.t), of(i))).collect()
    };
    // Where it is withheld there is no line and no band: nobody gets these numbers.
    let told = |i: &Instant, value: f64| if i.estimate.valid == 1 { value } else { f64::NAN };
    let band = |of: &dyn Fn(&Instant) -> f64| -> Vec<(f64, f64, f64)> {
        let around = instants
            .iter()
            .map(|i| (i, told(i, of(i)), 2.0 * i.estimate.standard_deviation));
        around
            .map(|(i, value, two)| (compared.time(i.t), value - two, value + two))
            .collect()
    };
    [
        plot(
            name,
            "",
            vec![
                Series::band("± 2σ", Ink::Identified, band(&|i| i.estimate.torque)),
                Series::line("CAD", Ink::Cad, line(&|i| i.cad)),
                Series::line("identified", Ink::Identified, line(&|i| told(i, i.estimate.torque))),
                Series::line("truth", Ink::Measured, line(&|i| i.truth)),
            ],
        ),
        plot(
            name,
            "error: estimated − truth",
            vec![
                Series::band("± 2σ", Ink::Identified, band(&|_| 0.0)),
                Series::line("CAD", Ink::Cad, line(&|i| i.cad - i.truth)),
                Series::line("identified", Ink::Identified, line(&|i| told(i, i.error()))),
            ],
        ),
    ]
}

/// Names and units of a link's ten parameters.
const PARAMETERS: [(&str, &str); 10] = [
    ("m", "kg"),
    ("h_x", "kg m"),
    ("h_y", "kg m"),
    ("h_z", "kg m"),
    ("I_xx", "kg m²"),
    ("I_xy", "kg m²"),
    ("I_xz", "kg m²"),
    ("I_yy", "kg m²"),
    ("I_yz", "kg m²"),
    ("I_zz", "kg m²"),
];
/// Of the links' parameters so many are drawn: those that the data tell most of.
const DRAWN: usize = 8;

/// One number that is identified, over the solutions.
struct Course {
    title: String,
    unit: &'static str,
    /// Instant \[s\], value, standard deviation.
    points: Vec<(f64, f64, f64)>,
    cad: f64,
    truth: f64,
}

impl Course {
    /// By what share its standard deviation has become smaller.
    fn told(&self) -> f64 {
        match (self.points.first(), self.points.last()) {
            (Some((_, _, first)), Some((_, _, last))) if *first > 0.0 => last / first,
            _ => f64::INFINITY,
        }
    }

    fn is_within_2_sigma(&self) -> bool {
        self.points
            .last()
            .is_some_and(|(_, value, deviation)| (value - self.truth).abs() <= 2.0 * deviation)
    }

    fn plot(&self, compared: &Compared) -> Plot {
        let ends = [self.points.first(), self.points.last()];
        let level = |value: f64| ends.iter().flatten().map(|(t, ..)| (*t, value)).collect();
        let band = self.points.iter().map(|(t, x, s)| (*t, x - 2.0 * s, x + 2.0 * s));
        let line = self.points.iter().map(|(t, x, _)| (*t, *x));
        let mut series = vec![Series::band("± 2σ", Ink::Identified, band.collect())];
        if self.cad.is_finite() {
            series.push(Series::line("CAD", Ink::Cad, level(self.cad)));
        }
        series.push(Series::line("truth", Ink::Measured, level(self.truth)));
        series.push(Series::line("identified", Ink::Identified, line.collect()));
        Plot {
            title: self.title.clone(),
            x: Axis::new("t [s]"),
            y: Axis::new(&format!("[{}]", self.unit)),
            series,
            marks: vec![(compared.time(compared.moving), "onset of motion".to_owned())],
            ..Plot::default()
        }
    }
}

/// The links' parameters and the sensors' offsets over the solutions.
fn courses(experiment: &Experiment, watched: &Watched, compared: &Compared) -> (Vec<Course>, Vec<Course>) {
    let (mut parameters, mut offsets) = (vec![], vec![]);
    let Some(last) = watched.learnt.last() else {
        return (parameters, offsets);
    };
    let find = |links: &[super::Link], name: &str| links.iter().find(|(n, _)| n == name).map(|(_, values)| *values);
    for (place, link) in last.links.iter().enumerate() {
        let name = link.name.as_str();
        let (Some(truth), Some(cad)) = (find(&experiment.truth, name), find(&experiment.cad, name)) else {
            continue;
        };
        for (i, ((symbol, unit), (truth, cad))) in PARAMETERS.into_iter().zip(truth.into_iter().zip(cad)).enumerate() {
            let points = watched.learnt.iter().filter_map(|learnt| {
                let link = learnt.links.get(place)?;
                Some((
                    compared.time(learnt.t),
                    *link.parameters.get(i)?,
                    *link.standard_deviation.get(i)?,
                ))
            });
            parameters.push(Course {
                title: format!("{name}: {symbol}"),
                unit,
                points: points.collect(),
                cad,
                truth,
            });
        }
    }
    for (place, offset) in last.offsets.iter().enumerate() {
        let name = offset.name.as_str();
        let Some((_, truth)) = experiment.offsets.iter().find(|(n, _)| n == name) else {
            continue;
        };
        for (i, (part, truth)) in ["fx", "fy", "fz", "tx", "ty", "tz"].into_iter().zip(truth).enumerate() {
            let points = watched.learnt.iter().filter_map(|learnt| {
                let offset = learnt.offsets.get(place)?;
                let value = offset.force.iter().chain(&offset.torque).nth(i)?;
                Some((compared.time(learnt.t), *value, *offset.standard_deviation.get(i)?))
            });
            offsets.push(Course {
                title: format!("{name}: {part}"),
                unit: if i < 3 { "N" } else { "Nm" },
                points: points.collect(),
                cad: f64::NAN,
                truth: *truth,
            });
        }
    }
    (parameters, offsets)
}

/// Figure 4 of the paper: what was identified, and how it came about.
fn learnt_section(parameters: &[Course], offsets: &[Course], compared: &Compared) -> String {
    let Some(course) = parameters.first().or(offsets.first()) else {
        return String::new();
    };
    let solutions = course.points.len();
    let mut best: Vec<&Course> = parameters.iter().collect();
    best.sort_by(|a, b| a.told().total_cmp(&b.told()));
    best.truncate(DRAWN);
    let mut masses = ReportTable::new(
        "Masses of the links beyond the F/T sensor [kg]. Forces tell certain sums of neighbouring links' parameters much better than each of them, which is what its standard deviation says.",
        &["link", "truth", "CAD", "identified"],
    );
    for mass in parameters.iter().step_by(PARAMETERS.len()) {
        if let Some((_, value, deviation)) = mass.points.last() {
            let name = mass.title.split(':').next().unwrap_or_default();
            masses.row(vec![
                name.into(),
                mass.truth.into(),
                mass.cad.into(),
                Cell::Uncertain(*value, *deviation),
            ]);
        }
    }
    let plots = |courses: &[&Course]| -> Vec<Plot> { courses.iter().map(|course| course.plot(compared)).collect() };
    report::section(
        "What was learnt",
        &[
            report::paragraph(&format!(
                "Inertial parameters and F/T offsets, {solutions} solutions, one a second: the parameters of which the data tell most, then the offsets of the sensors."
            )),
            report::figures(&plots(&best)),
            masses.html(),
            report::folded(
                "The sensors' offsets",
                false,
                &[report::figures(&plots(&offsets.iter().collect::<Vec<_>>()))],
            ),
        ],
    )
}

/// Puts values in the first places; how many.
fn fill<T: Copy>(places: &mut [T], values: &[T]) -> anyhow::Result<u32> {
    places.iter_mut().zip(values).for_each(|(to, from)| *to = *from);
    Ok(u32::try_from(values.len())?)
}

/// Writes estimates.csv, summary.json and report.html to `out`, and tells the result. The simulator's truth is in `truth`.
pub(super) fn finish(
    args: &Args,
    experiment: &Experiment,
    out: &Path,
    watched: &Watched,
    truth: &Path,
) -> anyhow::Result<()> {
    let setup = &experiment.setup;
    let truth = Truth::read(truth, &watched.joints).context("the simulator's truth")?;
    let file = |name: &str| -> anyhow::Result<_> {
        Ok(BufWriter::new(
            File::create(out.join(name)).with_context(|| out.join(name).display().to_string())?,
        ))
    };
    let mut table = Table::new(file("estimates.csv")?, setup)?;
    for seen in &watched.estimates {
        let mut estimate = Estimate::absent(seen.t);
        let (torques, contacts) = (&mut estimate.torques, &mut estimate.contacts);
        torques.count = fill(&mut torques.joints, &seen.joints)?;
        contacts.count = fill(&mut contacts.contacts, &seen.contacts)?;
        contacts.residual_count = fill(&mut contacts.residuals, &seen.residuals)?;
        table.write(&estimate, true)?;
    }
    table.into_inner().flush()?;

    let sum = |f: fn(&proprio_topics::BusHealth) -> u64| watched.gateway.buses().iter().map(f).sum::<u64>();
    let (frames, samples) = (sum(|b| b.frames), sum(|b| b.published));
    // Bus by bus: what one has too many must not hide what another lost.
    let (mut lost, mut foreign) = (watched.estimator.lost, 0);
    for bus in watched.gateway.buses() {
        let of_simulator = watched.simulator["buses"]
            .as_array()
            .into_iter()
            .flatten()
            .find(|b| b["name"] == bus.name.as_str());
        let sent = of_simulator
            .and_then(|b| b["sent"].as_u64())
            .with_context(|| format!("the simulator's count of bus {}", bus.name))?;
        lost += sent.saturating_sub(bus.frames);
        foreign += bus.frames.saturating_sub(sent);
    }
    let compared = Compared::new(watched, &truth, args.still())?;
    let last = watched.estimates.last().map_or(Nanos::ZERO, |seen| seen.t);
    let rate = (watched.estimates.len() as f64 - 1.0) / compared.time(last);
    let mut latency: Vec<f64> = watched
        .estimates
        .iter()
        .map(|s| (s.published - s.t).seconds() * 1e6)
        .collect();
    latency.sort_by(f64::total_cmp);

    let start = compared.first + START;
    let before = compared.phase(start, compared.moving);
    let learning = compared.phase(compared.moving, compared.settled);
    let after = compared.phase(compared.settled, Nanos::MAX);
    let whole = compared.phase(start, Nanos::MAX);
    let Some(judged) = after.as_ref().or(whole.as_ref()) else {
        bail!(
            "no estimate can be compared with the truth: the motion was too short, or nothing came after its first second"
        );
    };
    let since = if after.is_some() {
        "from 10 s of motion on"
    } else {
        "from one second on"
    };
    let seconds = |t: Nanos| (t <= last).then(|| compared.time(t));
    let errors: serde_json::Map<_, _> = (watched.joints.iter().zip(&judged.identified))
        .map(|(name, error)| (name.clone(), json!(error)))
        .collect();
    let latency_us =
        json!({ "p50": quantile(&latency, 0.5), "p99": quantile(&latency, 0.99), "p999": quantile(&latency, 0.999) });
    let (parameters, offsets) = courses(experiment, watched, &compared);
    let within = parameters.iter().filter(|course| course.is_within_2_sigma()).count();
    let summary = json!({
        "robot": setup.robot, "seconds": args.seconds, "seed": args.seed,
        "frames": frames, "samples": samples, "lost": lost, "foreign": foreign, "estimates": watched.estimates.len(),
        "lost_estimates": watched.lost_estimates, "late": watched.estimator.late,
        "rate_hz": rate, "valid_share": judged.valid_share, "latency_us": latency_us, "torque_rms_error_nm": errors,
        "identification": {
            "cad_error": args.cad_error, "refused": experiment.refused, "max_torque_std_nm": experiment.most_std,
            "moving_since_s": seconds(compared.moving), "settled_since_s": seconds(compared.settled),
            "solutions": watched.learnt.len(),
            "parameters_within_2_sigma": (!parameters.is_empty()).then(|| ratio(within, parameters.len())),
            "before": Phase::json(before.as_ref(), &watched.joints),
            "learning": Phase::json(learning.as_ref(), &watched.joints),
            "after": Phase::json(after.as_ref(), &watched.joints),
        },
        "simulator": watched.simulator,
    });
    let mut text = serde_json::to_string_pretty(&summary)?;
    text.push('\n');
    fs::write(out.join("summary.json"), text)?;

    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut facts = vec![
        ("robot", setup.robot.clone()),
        (
            "motion",
            format!(
                "{} s, still for {} s of it, seed {}",
                args.seconds,
                args.still(),
                args.seed
            ),
        ),
        ("frames", format!("{frames} received, {lost} lost")),
        ("estimates", format!("{} at {rate:.1} Hz", watched.estimates.len())),
        ("torques valid", format!("{} {since}", percent(judged.valid_share))),
    ];
    if let Some(before) = &before {
        facts.push(("before motion", format!("{} valid", percent(before.valid_share))));
    }
    facts.push((
        "errors within 2σ",
        format!("{} {since}", percent(judged.within_2_sigma)),
    ));
    facts.push((
        "latency",
        format!(
            "{:.0} us median, {:.0} us at 99 %, from frame stamp to torque published",
            quantile(&latency, 0.5),
            quantile(&latency, 0.99)
        ),
    ));

    let mut rows = ReportTable::new(
        &format!("RMS errors of the torques against the simulator's truth, {since} [Nm]"),
        &["joint", "identified", "CAD", "RMS torque"],
    );
    for (i, name) in watched.joints.iter().enumerate() {
        let of = |values: &[f64]| values.get(i).copied().unwrap_or(f64::NAN);
        let (identified, cad) = (of(&judged.identified), of(&judged.cad));
        let bar = |value: f64, ink| Cell::Bar(report::number(value), value / identified.max(cad), ink);
        rows.row(vec![
            name.as_str().into(),
            bar(identified, Ink::Identified),
            bar(cad, Ink::Cad),
            of(&judged.size).into(),
        ]);
    }
    let began = watched.simulator["t0"].as_i64().map_or(compared.first, Nanos);
    let touched: Vec<(f64, f64)> = (experiment.touched.iter())
        .map(|(from, until)| {
            let at = |t: f64| compared.time(began + Nanos::from_seconds(t)).min(compared.time(last));
            (at(*from), at(*until))
        })
        .collect();
    let plots: Vec<Plot> = (watched.joints.iter().zip(&compared.joints))
        .flat_map(|(name, instants)| torque_plots(name, instants, &compared, &touched))
        .collect();
    let upstream = setup.upstream_note();
    fs::write(
        out.join("report.html"),
        report::page(
            &format!("proprio demo: {}", setup.robot),
            &[
                report::paragraph(&experiment.story(args)),
                report::facts(&facts),
                report::section(
                    "Joint torques",
                    &[rows.html(), report::paragraph(&upstream), report::figures(&plots)],
                ),
                learnt_section(&parameters, &offsets, &compared),
            ],
        ),
    )?;

    for (name, value) in &facts {
        say!("{name:<17} {value}");
    }
    say!("RMS error of the torques against the simulator's truth, {since} [Nm]: identified, and by the wrong URDF:");
    for ((joint, identified), cad) in watched.joints.iter().zip(&judged.identified).zip(&judged.cad) {
        say!("  {joint:<20} {identified:.4}  {cad:.4}");
    }
    if !upstream.is_empty() {
        say!("{upstream}");
    }
    say!(
        "{}: report.html, estimates.csv, summary.json, cad.urdf, estimator.toml and the processes' logs",
        args.out.display()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn instant(t: f64, torque: f64, valid: bool) -> Instant {
        Instant {
            t: Nanos::from_seconds(t),
            estimate: JointTorque {
                torque,
                standard_deviation: 0.5,
                valid: u32::from(valid),
                ..JointTorque::ABSENT
            },
            cad: 3.0,
            truth: 1.0,
        }
    }

    #[test]
    fn phases_are_told_apart_and_nothing_is_said_of_what_was_not() {
        // Before the motion 2 Nm off and withheld, in it right but for one of four.
        let joint = vec![
            instant(1.0, 3.0, false),
            instant(2.0, -1.0, false),
            instant(5.0, 1.0, true),
            instant(6.0, 1.0, true),
            instant(7.0, 1.0, true),
            instant(8.0, 3.0, false),
        ];
        let compared = Compared {
            first: Nanos::ZERO,
            moving: Nanos::from_seconds(4.0),
            settled: Nanos::from_seconds(14.0),
            joints: vec![joint],
        };
        let before = compared.phase(Nanos::ZERO, compared.moving).unwrap();
        assert_eq!((&before.identified[..], &before.cad[..]), (&[2.0][..], &[2.0][..]));
        assert_eq!((before.valid_share, before.within_2_sigma), (0.0, 0.0));
        let after = compared.phase(compared.moving, compared.settled).unwrap();
        assert_eq!((after.identified[0], after.cad[0], after.size[0]), (1.0, 2.0, 1.0));
        assert_eq!((after.valid_share, after.within_2_sigma), (0.75, 0.75));
        assert!(compared.phase(compared.settled, Nanos::MAX).is_none());
        assert_eq!(Phase::json(None, &[]), serde_json::Value::Null);
    }

    #[test]
    fn stretches_begin_where_the_last_good_one_was_and_close_ones_are_one() {
        let flags = [
            (0.0, false),
            (0.01, true),
            (0.02, false),
            (0.03, true),
            (0.2, false),
            (0.3, true),
        ];
        assert_eq!(stretches(flags.into_iter()), [(0.0, 0.03), (0.2, 0.3)]);
        assert_eq!(stretches([(1.0, true)].into_iter()), [(1.0, 1.0)]);
    }
}
