//! `proprio excite`: the motion that lessens the deviations of torques the most, as a table, with
//! a forecast of what it is good for.

use crate::convert::OutputFile;
use crate::identifiable::{short, torque_of, unit, without};
use crate::identify::progress_bar;
use crate::names::find;
use anyhow::Context;
use proprio_dynamics::model::{Frame, Limits, Model};
use proprio_dynamics::regressor::identifiable::ParameterColumn;
use proprio_dynamics::spatial::Pose;
use proprio_estimator::config::{Base, Config, InvalidConfig};
use proprio_estimator::parameters::Parameters;
use proprio_estimator::setup::{Setup, frame};
use proprio_identification::forecast::SensorNoise;
use proprio_identification::robot::IdentificationInput;
use proprio_identification::{CovarianceRoot, Robot};
use proprio_planning::excite::{PlannedMotion, Planner, Task};
use proprio_planning::motion::{Fence, FourierSeries, JointLimits};
use proprio_planning::workspace::{RISE, measured};
use serde_json::json;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Time between two rows of the table \[s\].
const PERIOD: f64 = 0.01;

/// Shortest and longest motion \[s\].
const SECONDS: [f64; 2] = [4.0, 120.0];

/// `proprio excite`.
#[derive(clap::Args)]
pub(crate) struct ExciteArgs {
    /// estimator.toml
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// A joint whose torque matters; may be given several times [default: all]
    #[arg(long, value_name = "NAME")]
    joint: Vec<String>,
    /// A contact that is always present while the robot works, but declared absent during the
    /// motion; may be given several times
    #[arg(long, value_name = "CONTACT")]
    absent: Vec<String>,
    /// The duration of the motion [s]
    #[arg(long, value_name = "S", default_value_t = 12.0)]
    seconds: f64,
    /// Limits of a joint in place of the URDF's: JOINT=LOWER,UPPER[,VELOCITY[,ACCELERATION]], e.g.
    /// elbow=0.3,1.8,1.5,4 [rad, rad/s, rad/s^2]; may be given several times. Without an
    /// acceleration it is what reaches the velocity in 0.5 s. Equal positions: it stays there
    #[arg(long, value_name = "LIMITS")]
    limit: Vec<String>,
    /// A box that the origin of a link, or a point in its axes, does not leave, in the axes of the
    /// base link [m]: LINK[@X,Y,Z]=XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX; may be given several times
    #[arg(long, value_name = "BOX")]
    #[arg(allow_hyphen_values = true)]
    r#box: Vec<String>,
    /// The parameters.toml of an earlier identification: what matters is what it left uncertain
    #[arg(long, value_name = "FILE")]
    parameters: Option<PathBuf>,
    /// Another seed gives another motion
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// The table of the motion to write; - for standard output
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Print the forecast as JSON
    #[arg(long)]
    json: bool,
}

/// Plans a motion.
pub(crate) fn run(args: &ExciteArgs) -> anyhow::Result<()> {
    let (config, mut setup) = Setup::load(&args.config, |config| {
        // What was identified earlier counts only if it is named.
        config.parameters = None;
        config.identification.enabled = false;
    })?;
    let known = match &args.parameters {
        Some(file) => Some(applied(file, &mut setup)?),
        None => None,
    };
    let at_work = setup.robot_as_identified();
    let invalid = |problem: String| InvalidConfig {
        file: args.config.clone(),
        problem,
    };
    let robot = without(&at_work, &args.absent).map_err(invalid)?;
    let task = task(args, &config, &robot, known).map_err(invalid)?;
    let wanted = task.wanted.clone();
    let file = || args.config.display().to_string();
    let planner = Planner::new(task, &at_work).with_context(file)?;
    let bar = progress_bar();
    let plan = planner.plan(&mut |done| bar.set_position((1000.0 * done) as u64));
    bar.finish_and_clear();
    let plan = plan.with_context(file)?;
    let mut out = OutputFile::new(&args.out)?;
    let unwritable = || format!("{}: cannot be written", args.out.display());
    write(out.writer(), &plan.series, &robot).with_context(unwritable)?;
    out.finish().with_context(unwritable)?;
    report(args, &plan, &robot, &wanted)
}

/// What is asked, with names resolved.
fn task<'a>(
    args: &ExciteArgs,
    config: &Config,
    robot: &'a Robot,
    known: Option<(CovarianceRoot, Vec<SensorNoise>)>,
) -> Result<Task<'a>, String> {
    if robot.structure.sensors().is_empty() {
        return Err(
            "there is no [[force_torque]], so no motion tells anything; `proprio identifiable` \
             shows where a sensor would help"
                .into(),
        );
    }
    let inputs = &config.identification.inputs;
    if !inputs.is_empty() && !inputs.contains(&IdentificationInput::Wrench) {
        return Err(
            "identification.inputs is without \"wrench\": motions are planned for F/T sensors"
                .into(),
        );
    }
    let [least, most] = SECONDS;
    if !(least..=most).contains(&args.seconds) {
        return Err(format!(
            "--seconds {}: it must be {least} to {most}",
            args.seconds
        ));
    }
    let dofs: Vec<usize> = measured(robot).collect();
    let wanted = match args.joint.as_slice() {
        [] => dofs.clone(),
        names => (names.iter())
            .map(|name| torque_of(robot, name))
            .collect::<Result<_, _>>()?,
    };
    let (known, noise) = match known {
        Some((known, noise)) => (Some(known), noise),
        None => (None, SensorNoise::stated(robot)),
    };
    let fences = args.r#box.iter().map(|text| fence(robot, config, text));
    Ok(Task {
        robot,
        limits: limits(robot, &dofs, &args.limit)?,
        fences: fences.collect::<Result<_, _>>()?,
        seconds: args.seconds,
        wanted,
        noise,
        known,
        seed: args.seed,
    })
}

/// Applies identified parameters; their covariance, and the noise that was found.
fn applied(file: &Path, setup: &mut Setup) -> anyhow::Result<(CovarianceRoot, Vec<SensorNoise>)> {
    let parameters = Parameters::load(file).with_context(|| file.display().to_string())?;
    (setup.apply(&parameters)).with_context(|| file.display().to_string())?;
    let robot = &setup.robot;
    let mut columns = Vec::new();
    for link in parameters.identified() {
        columns.extend((0..10).map(|parameter| ParameterColumn::Inertial { link, parameter }));
    }
    let mut noise = SensorNoise::stated(robot);
    let mut calibrations = Vec::new();
    for offset in parameters.offsets() {
        let Some(sensor) = robot.sensor(&offset.sensor) else {
            continue;
        };
        columns.extend((0..6).map(|component| ParameterColumn::Offset { sensor, component }));
        if let Some(found) = &offset.calibrated {
            calibrations.extend(found.kind.unknowns().map(|unknown| (sensor, unknown)));
        }
        let found = offset.noise.torque_first();
        if let Some(own) = noise.get_mut(sensor) {
            for (stated, found) in own.deviation.iter_mut().zip(found) {
                *stated = stated.max(found);
            }
            own.drift = offset.drift.torque_first();
        }
    }
    let known = CovarianceRoot {
        columns,
        calibrations,
        root: parameters.root().transpose(),
    };
    Ok((known, noise))
}

/// Numbers separated by commas.
fn numbers(text: &str) -> Option<Vec<f64>> {
    let numbers = text.split(',').map(|part| part.trim().parse::<f64>().ok());
    let numbers: Option<Vec<f64>> = numbers.collect();
    numbers.filter(|all| all.iter().all(|number| number.is_finite()))
}

/// Lower, upper, velocity, acceleration; those that are known.
type KnownLimits = [Option<f64>; 4];

/// The limits of each joint: given ones, else those of the URDF.
fn limits(
    robot: &Robot,
    dofs: &[usize],
    given: &[String],
) -> Result<Vec<Option<JointLimits>>, String> {
    let model = &robot.model;
    let mut limits: Vec<KnownLimits> = (0..model.dof_count())
        .map(|dof| urdf_limits(model, dof))
        .collect();
    for text in given {
        let (dof, values) = given_limits(model, dofs, text)?;
        for (place, value) in limits[dof].iter_mut().zip(values) {
            *place = Some(value);
        }
    }
    let is_free = |dof: &&usize| limits[**dof].iter().take(3).any(Option::is_none);
    let free: Vec<&str> = dofs
        .iter()
        .filter(is_free)
        .map(|&dof| model.dof_name(dof))
        .collect();
    if let Some(first) = free.first() {
        return Err(format!(
            "the URDF has no limits of position and velocity for {}: give them, as --limit \
             {first}=-1,1,0.5",
            free.join(", ")
        ));
    }
    let complete = |dof: usize| {
        let [lower, upper, velocity, acceleration] = limits[dof];
        let (lower, upper, velocity) = (lower?, upper?, velocity?);
        dofs.contains(&dof).then_some(JointLimits {
            range: Limits { lower, upper },
            velocity,
            acceleration: acceleration.unwrap_or(velocity / RISE),
        })
    };
    Ok((0..model.dof_count()).map(complete).collect())
}

/// The limits of a degree of freedom in the URDF: those of its joint, and of the joints that follow
/// it.
fn urdf_limits(model: &Model, dof: usize) -> KnownLimits {
    let leader = model.dof_joint(dof).unwrap_or_default();
    let range = model.limits(leader);
    let of_leader = [
        range.map(|own| own.lower),
        range.map(|own| own.upper),
        model.velocity(leader),
        None,
    ];
    let all = model.joints().iter().enumerate();
    let followers = all.filter(|(number, own)| own.dof == Some(dof) && *number != leader);
    followers.fold(of_leader, |[lower, upper, velocity, _], (number, own)| {
        let at = |limit: f64| (limit - own.offset) / own.ratio;
        let range = model.limits(number).filter(|_| own.ratio != 0.0);
        let range = range.map(|range| (at(range.lower), at(range.upper)));
        let range = range.map(|(a, b)| (a.min(b), a.max(b)));
        let least = |a: Option<f64>, b: Option<f64>| a.into_iter().chain(b).reduce(f64::min);
        let most = |a: Option<f64>, b: Option<f64>| a.into_iter().chain(b).reduce(f64::max);
        let rate = model.velocity(number).map(|rate| rate / own.ratio.abs());
        [
            most(lower, range.map(|range| range.0)),
            least(upper, range.map(|range| range.1)),
            least(velocity, rate.filter(|rate| rate.is_finite())),
            None,
        ]
    })
}

/// The degree of freedom and the limits of `JOINT=LOWER,UPPER[,VELOCITY[,ACCELERATION]]`, which lie
/// within those of the URDF.
fn given_limits(model: &Model, dofs: &[usize], text: &str) -> Result<(usize, Vec<f64>), String> {
    let at = format!("--limit {text}");
    let usage = || format!("{at}: write JOINT=LOWER,UPPER[,VELOCITY[,ACCELERATION]]");
    let (name, values) = text.split_once('=').ok_or_else(usage)?;
    let dof = find(name, || dofs.iter().map(|&dof| (model.dof_name(dof), dof)));
    let dof =
        dof.map_err(|hint| format!("{at}: {name:?} is not a moving joint that is measured{hint}"))?;
    let joint = model.dof_joint(dof).unwrap_or_default();
    let values = numbers(values).filter(|all| (2..=4).contains(&all.len()));
    let values = values.ok_or_else(usage)?;
    let value = |at: usize| values.get(at).copied();
    let (lower, upper) = (value(0).unwrap_or(0.0), value(1).unwrap_or(0.0));
    if lower > upper || values.iter().skip(2).any(|value| *value <= 0.0) {
        return Err(format!(
            "{at}: the lower position must be at most the upper one, velocity and acceleration \
             above 0"
        ));
    }
    if let Some(inside) = model.limits(joint)
        && (lower < inside.lower || upper > inside.upper)
    {
        let Limits { lower, upper } = inside;
        return Err(format!("{at}: the URDF allows {lower} to {upper} only"));
    }
    if let (Some(most), Some(velocity)) = (model.velocity(joint), value(2))
        && velocity > most
    {
        return Err(format!("{at}: the URDF allows a velocity of {most} only"));
    }
    Ok((dof, values))
}

/// A box, from `LINK@X,Y,Z=XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX`.
fn fence(robot: &Robot, config: &Config, text: &str) -> Result<Fence, String> {
    let at = format!("--box {text}");
    let usage = || format!("{at}: write LINK=XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX, or LINK@X,Y,Z=...");
    let (place, walls) = text.split_once('=').ok_or_else(usage)?;
    let (name, point) = place.split_once('@').unwrap_or((place, "0,0,0"));
    let of_link = frame(&robot.model, name).map_err(|why| format!("{at}: {why}"))?;
    let point = numbers(point).and_then(|point| <[f64; 3]>::try_from(point).ok());
    let walls = numbers(walls).and_then(|walls| <[f64; 6]>::try_from(walls).ok());
    let (Some(point), Some([x, x2, y, y2, z, z2])) = (point, walls) else {
        return Err(usage());
    };
    if x >= x2 || y >= y2 || z >= z2 {
        return Err(format!(
            "{at}: each least coordinate must be below the greatest"
        ));
    }
    let base = match &config.base {
        Base::Fixed { link, .. } | Base::Imu { link, .. } => link.as_str(),
        Base::Stance { .. } => robot.model.link_name(robot.base_link),
    };
    Ok(Fence {
        name: name.to_owned(),
        points: vec![Frame {
            pose: of_link.pose * Pose::from_xyz_rpy(point, [0.0; 3]),
            ..of_link
        }],
        base: frame(&robot.model, base)?,
        least: [x, y, z],
        greatest: [x2, y2, z2],
    })
}

/// Writes the motion as a table of samples.
fn write(mut out: impl Write, series: &FourierSeries, robot: &Robot) -> io::Result<()> {
    write!(out, "t")?;
    for dof in measured(robot) {
        let name = robot.model.dof_name(dof);
        for what in ["position", "velocity", "acceleration"] {
            write!(out, ",joint/{name}/{what}")?;
        }
    }
    writeln!(out)?;
    for t in series.instants(PERIOD) {
        let state = series.at(t);
        write!(out, "{t:.6}")?;
        for dof in measured(robot) {
            let values = [&state.position, &state.velocity, &state.acceleration];
            for value in values.map(|values| values[dof]) {
                write!(out, ",{value:.9}")?;
            }
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Prints the forecast.
fn report(
    args: &ExciteArgs,
    plan: &PlannedMotion,
    robot: &Robot,
    wanted: &[usize],
) -> anyhow::Result<()> {
    let model = &robot.model;
    let start = plan.series.at(0.0).position;
    let torques = || plan.before.iter().zip(&plan.after);
    if args.json {
        let torques = torques().map(|(before, after)| {
            json!({
                "joint": model.dof_name(before.dof),
                "unit": unit(model, before.dof),
                "wanted": wanted.contains(&before.dof),
                "before": before.torque,
                "after": after.torque,
            })
        });
        let start = measured(robot).map(|dof| (model.dof_name(dof).to_owned(), json!(start[dof])));
        let json = json!({
            "seconds": plan.series.seconds(),
            "start": start.collect::<serde_json::Map<_, _>>(),
            "torques": torques.collect::<Vec<_>>(),
        });
        print_line!("{json}");
        return Ok(());
    }
    // The table may go to standard output.
    let mut text = format!(
        "{}: {} s, which lessen the standard deviation of\n",
        args.out.display(),
        plan.series.seconds()
    );
    let mut rest = String::new();
    let width = measured(robot)
        .map(|dof| model.dof_name(dof).len())
        .max()
        .unwrap_or(0);
    for (before, after) in torques() {
        let name = model.dof_name(before.dof);
        let (Some(from), Some(to)) = (before.torque, after.torque) else {
            rest += &format!("  {name:width$}  undetermined: too many contacts\n");
            continue;
        };
        let unit = unit(model, before.dof);
        let line = format!("  {name:width$}  {} to {} {unit}\n", short(from), short(to));
        match wanted.contains(&before.dof) {
            true => text += &line,
            false => rest += &line,
        }
    }
    if !rest.is_empty() {
        text += "and, of what was not asked for, of\n";
        text += &rest;
    }
    let start = measured(robot).map(|dof| format!("{} {:.3}", model.dof_name(dof), start[dof]));
    text += &format!(
        "it starts and stops at {}\n",
        start.collect::<Vec<_>>().join(", ")
    );
    match args.out == Path::new("-") {
        true => eprint!("{text}"),
        false => print_part!("{text}"),
    }
    Ok(())
}
