//! Estimates of a recorded log: a table of samples to a table of estimates, `proprio estimate`. It
//! uses the same [`Pipeline`] as the daemon.
//!
//! | column | meaning |
//! |---|---|
//! | `t` | the instant, as in the log |
//! | `torque/<joint>` | \[Nm\], by the parent link on the child link along the URDF axis |
//! | `torque_std/<joint>` | its standard deviation ([`crate::pipeline`]) |
//! | `contact/<name>/fx fy fz tx ty tz` | \[N, Nm\], by the environment on the link; see below |
//! | `contact/<name>/fx_std fy_std fz_std tx_std ty_std tz_std` | their standard deviations |
//! | `contact/<name>/valid`, `contact/<name>/reason` | as for a joint |
//! | `contact/<name>/detected` | 1 if F/T readings show it without a declaration, else 0 |
//! | `contact/<name>/px py pz` | where it is taken to be \[m\], in the same axes |
//! | `contact/<name>/located` | 1 if a declaration or a skin says so, 0 if it is `position_m` |
//! | `valid/<joint>` | 1 if the torque is valid, else 0: it is withheld |
//! | `reason/<joint>` | why it is not valid: a word, and the channel at fault after a colon |
//! | `residual/<link>/fx fy fz tx ty tz` | \[N, Nm\], the residual of a sub-tree; see below |
//! | `residual/<link>/significance` | its normal deviate; empty where it cannot be tested |
//! | `residual/<link>/reason` | its cause: the contact detected there, or `unexplained` |
//! | `drive/<joint>` | the torque by the drive ([`crate::drive`]), if its drive is known |
//! | `drive_std/<joint>` | its standard deviation |
//! | `disagrees/<joint>` | 1 if the two disagree, 0 if not; empty if they cannot be compared |
//!
//! Cells of a withheld torque or wrench are empty; of a torque that is `uncertain` alone, the
//! standard deviation is told.
//!
//! A contact wrench is given in the axes and at the origin of the frame that `link` names. The
//! residual of a sub-tree is the wrench that links, sensors and known contacts do not explain, at
//! the origin and in the axes of its top link, which `<link>` names. Its significance is the normal
//! deviate with the same probability, if no unknown wrench acts.

use crate::assessment::Assessor;
use crate::drive::DriveRow;
use crate::pipeline::{Estimate, Pipeline};
use crate::sample_log::{ColumnOwner, MissingChannels, check_columns, check_skins, column_owners};
use crate::setup::Setup;
use proprio_identification::online::Hypothesis;
use proprio_topics::csv::{Row, Series, SeriesKind, SeriesValue, TableReader, TableReport, Value};
use proprio_topics::{
    Agreement, ContactWrench, DriveEstimate, DriveTorque, JointTorque, Kind, NO_CAUSE, Nanos,
    Reason, Residual,
};
use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::ops::ControlFlow;

/// Why a log cannot be estimated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EstimationError {
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] proprio_topics::csv::TableError),
    /// The estimates cannot be written.
    #[error("the estimates cannot be written")]
    Write(#[from] io::Error),
    /// The log lacks channels that the configuration names.
    #[error(transparent)]
    MissingChannels(#[from] MissingChannels),
}

/// Rows that are earlier than another by more are not only a little out of order.
const STEP: Nanos = Nanos::from_millis(100);

/// Counts and remarks of the estimates of a log.
#[derive(Debug, Clone, Default)]
pub struct EstimateReport {
    /// Estimates written.
    pub estimates: u64,
    /// Withheld torques in them, by reason ([`Reason::word`]).
    pub withheld: BTreeMap<&'static str, u64>,
    /// The rows that the reader skipped.
    pub log: TableReport,
    /// Samples dropped: late, stamped no later than the last one, not finite.
    pub dropped: [u64; 3],
    /// The line of the first row with a dropped sample.
    pub first_dropped: Option<u64>,
    /// The line of the first row whose clock was set back, the newest instant before, and its own.
    pub step_back: Option<(u64, Nanos, Nanos)>,
    /// Channels of the log that the configuration does not name.
    pub unused_channels: Vec<String>,
    /// What was found likelier than the configuration, and when.
    pub likelier: Vec<(Nanos, String)>,
}

/// Runs a job of on-line identification if one is due. It runs immediately, so that its solution is
/// always in time. What is likelier then than the configuration is added to `likelier`, each kind
/// with the instant when it was found, and as estimated last.
fn run_due_job(pipeline: &mut Pipeline, t: Nanos, likelier: &mut Vec<(Nanos, Hypothesis)>) {
    let Some(mut job) = pipeline.take_job() else {
        return;
    };
    job.run();
    pipeline.give_back(job);
    let components = pipeline
        .identification()
        .map(|own| &own.solution().components);
    for found in components
        .into_iter()
        .flatten()
        .filter_map(|own| own.leading)
    {
        let kind = found.without_estimate();
        match likelier
            .iter_mut()
            .find(|(_, other)| other.without_estimate() == kind)
        {
            Some((_, newest)) => *newest = found,
            None => likelier.push((t, found)),
        }
    }
}

/// Estimates for every trigger stamp of a log. They also go to `assessor`, which has read this log.
///
/// # Errors
/// [`EstimationError`]; a joint that the log lacks and the configuration does not lock is one.
pub fn estimate(
    setup: Setup,
    log: impl Read,
    out: impl Write,
    mut assessor: Option<&mut Assessor>,
) -> Result<EstimateReport, EstimationError> {
    let mut table = None;
    let mut out = Some(out);
    let (mut report, pipeline) = run_on_log(setup, log, |pipeline, is_stamped| {
        if let Some(out) = out.take() {
            table = Some(EstimateTable::new(out, pipeline.setup())?);
        }
        if let Some(table) = &mut table {
            table.write(pipeline.last_estimate(), pipeline.drives(), is_stamped)?;
        }
        if let Some(assessor) = &mut assessor {
            let t = pipeline.last_estimate().t;
            assessor.estimate(pipeline.last_estimate());
            assessor.parameters(t, pipeline);
        }
        Ok(ControlFlow::Continue(()))
    })?;
    let mut table = match (table, out) {
        (Some(table), _) => table,
        (None, Some(out)) => EstimateTable::new(out, pipeline.setup())?,
        (None, None) => return Ok(report),
    };
    table.out.flush()?;
    (report.estimates, report.withheld) = (table.rows, table.withheld);
    Ok(report)
}

/// Runs the estimator on a log. `each` is called after each estimate, and may end the run; the
/// second argument is whether the log has stamps. Returns what there is to remark on the log, and
/// the pipeline after the last estimate.
///
/// # Errors
/// As for [`estimate`]; and those of `each`.
pub fn run_on_log(
    setup: Setup,
    log: impl Read,
    mut each: impl FnMut(&mut Pipeline, bool) -> Result<ControlFlow<()>, EstimationError>,
) -> Result<(EstimateReport, Pipeline), EstimationError> {
    let mut reader = TableReader::new(log)?;
    let mut report = EstimateReport::default();
    let mut pipeline = Pipeline::new(setup);
    let owners = owners(pipeline.setup(), reader.series())?;
    let series = reader.series().iter().zip(&owners);
    let unused = series.filter(|(_, owner)| owner.is_none());
    report.unused_channels = unused.map(|(series, _)| series.name.clone()).collect();
    // Rows of a log without stamps are spaced so far that none affects the next.
    let max_silence = pipeline.setup().robot.max_silence;
    let spacing = max_silence + max_silence + Nanos(1);
    let (mut row, mut pseudo) = (Row::default(), Nanos::ZERO);
    let (mut stamped, mut newest) = (true, Nanos::MIN);
    let mut likelier = Vec::new();
    let mut make = |pipeline: &mut Pipeline, stamped: bool| -> Result<_, EstimationError> {
        while let Some(t) = pipeline.poll().map(|estimate| estimate.t) {
            if each(pipeline, stamped)?.is_break() {
                return Ok(ControlFlow::Break(()));
            }
            run_due_job(pipeline, t, &mut likelier);
        }
        Ok(ControlFlow::Continue(()))
    };
    let mut is_ended = false;
    while !is_ended && reader.next_row(&mut row)? {
        let t = row.t.unwrap_or_else(|| {
            stamped = false;
            pseudo += spacing;
            pseudo
        });
        push_row(&mut pipeline, &owners, t, &row);
        let counts = pipeline.counts();
        if report.first_dropped.is_none() && counts.late + counts.backward + counts.not_finite > 0 {
            report.first_dropped = Some(row.line);
        }
        if newest.saturating_sub(t) > STEP {
            report.step_back.get_or_insert((row.line, newest, t));
        }
        newest = newest.max(t);
        is_ended = make(&mut pipeline, stamped)?.is_break();
    }
    if !is_ended {
        pipeline.finish();
        let _ = make(&mut pipeline, stamped)?;
    }
    let robot = &pipeline.setup().robot;
    let described = likelier
        .into_iter()
        .map(|(t, found)| (t, found.describe(robot).to_string()));
    report.likelier = described.collect();
    let counts = pipeline.counts();
    report.dropped = [counts.late, counts.backward, counts.not_finite];
    report.log = reader.report().clone();
    Ok((report, pipeline))
}

/// Per series of a log, where its values go; none if the configuration has no such channel or
/// contact.
fn owners(setup: &Setup, series: &[Series]) -> Result<Vec<Option<ColumnOwner>>, MissingChannels> {
    check_columns(&setup.robot, series, |_| true)?;
    check_skins(setup, series)?;
    let mut owners = column_owners(&setup.robot, series);
    for (series, owner) in series.iter().zip(&mut owners) {
        if let SeriesKind::Channel(kind @ Kind::Skin) = series.kind {
            let channel = setup.channel(kind, &series.name);
            *owner = channel.map(ColumnOwner::Channel);
        }
    }
    Ok(owners)
}

/// Passes the samples and declarations of a row to the pipeline.
fn push_row(pipeline: &mut Pipeline, owners: &[Option<ColumnOwner>], t: Nanos, row: &Row) {
    for SeriesValue { series, value } in &row.items {
        match (owners.get(*series).copied().flatten(), value) {
            (Some(ColumnOwner::Channel(channel)), Value::Reading(reading, quality)) => {
                pipeline.push(channel, t, reading, *quality);
            }
            (Some(ColumnOwner::Contact(contact)), Value::Contact(state)) => {
                pipeline.declare(contact, t, state);
            }
            _ => {}
        }
    }
}

/// What joints and drives do in a log, by degree of freedom, as the estimator with this `setup`
/// sees it; at most one row in 10 ms, because friction and load change no faster than a joint
/// moves.
///
/// # Errors
/// As for [`run_on_log`].
pub fn drive_rows(setup: &Setup, log: impl Read) -> Result<Vec<Vec<DriveRow>>, EstimationError> {
    let mut rows: Vec<Vec<DriveRow>> = vec![Vec::new(); setup.robot.model.dof_count()];
    let mut setup = setup.clone();
    setup.drives.clear();
    setup.learns_drives = true;
    // A log has the samples that a running estimator would have to wait for.
    setup.waits = true;
    run_on_log(setup, log, |pipeline, is_stamped| {
        // Friction needs velocities, and seconds.
        if !is_stamped {
            return Ok(ControlFlow::Break(()));
        }
        for (dof, row) in pipeline.drive_rows() {
            if let Some(own) = rows.get_mut(dof)
                && own
                    .last()
                    .is_none_or(|last| row.t >= last.t + Nanos::from_millis(10))
            {
                own.push(row);
            }
        }
        Ok(ControlFlow::Continue(()))
    })?;
    Ok(rows)
}

/// Writes estimates row by row.
pub struct EstimateTable<W> {
    out: W,
    channels: Vec<String>,
    joints: usize,
    contacts: Vec<String>,
    subtrees: usize,
    /// How many drives are known.
    drives: usize,
    text: Vec<u8>,
    rows: u64,
    withheld: BTreeMap<&'static str, u64>,
}

impl<W: Write> EstimateTable<W> {
    /// Writes the header.
    ///
    /// # Errors
    /// If `out` cannot be written.
    pub fn new(mut out: W, setup: &Setup) -> io::Result<Self> {
        let joints: Vec<&str> = setup.robot.joint_names().collect();
        let contacts: Vec<&str> = setup.robot.contact_names().collect();
        let mut header = Vec::from(*b"t");
        let mut add = |part: &str, name: &str, field: &str| {
            header.push(b',');
            let start = header.len();
            header.extend_from_slice(format!("{part}/{name}{field}").as_bytes());
            quote(&mut header, start);
        };
        for part in ["torque", "torque_std"] {
            joints.iter().for_each(|joint| add(part, joint, ""));
        }
        for contact in &contacts {
            let columns = "/fx /fy /fz /tx /ty /tz /fx_std /fy_std /fz_std /tx_std /ty_std /tz_std \
                           /valid /reason /detected /px /py /pz /located";
            let columns = columns.split(' ');
            columns.for_each(|field| add("contact", contact, field));
        }
        for part in ["valid", "reason"] {
            joints.iter().for_each(|joint| add(part, joint, ""));
        }
        let subtrees: Vec<&str> = setup.robot.subtree_names().collect();
        for top in &subtrees {
            let columns = "/fx /fy /fz /tx /ty /tz /significance /reason".split(' ');
            columns.for_each(|field| add("residual", top, field));
        }
        let drives: Vec<&str> = (setup.robot.joint_names())
            .filter(|joint| setup.drives.iter().any(|drive| drive.joint == *joint))
            .collect();
        for part in ["drive", "drive_std", "disagrees"] {
            drives.iter().for_each(|joint| add(part, joint, ""));
        }
        header.push(b'\n');
        out.write_all(&header)?;
        let channels = setup.channels().map(|(_, name)| name.to_owned()).collect();
        Ok(Self {
            out,
            channels,
            joints: joints.len(),
            contacts: contacts.iter().map(|&name| name.to_owned()).collect(),
            subtrees: subtrees.len(),
            drives: drives.len(),
            text: Vec::new(),
            rows: 0,
            withheld: BTreeMap::new(),
        })
    }

    /// Writes one estimate and what the drives say of it, with its instant if the log is `stamped`.
    ///
    /// # Errors
    /// If the output cannot be written.
    pub fn write(
        &mut self,
        estimate: &Estimate,
        drives: Option<&DriveEstimate>,
        stamped: bool,
    ) -> io::Result<()> {
        let torques = estimate.torques.joints();
        let joints = || (0..self.joints).map(|i| torques.get(i).unwrap_or(&JointTorque::ABSENT));
        let (text, channels) = (&mut self.text, &self.channels);
        text.clear();
        if stamped {
            write!(text, "{}", estimate.t)?;
        }
        numbers(text, joints().map(|joint| joint.torque));
        numbers(text, joints().map(|joint| joint.standard_deviation));
        let contacts = estimate.contacts.contacts();
        for i in 0..self.contacts.len() {
            let contact = contacts.get(i).unwrap_or(&ContactWrench::ABSENT);
            write_contact(text, channels, contact);
        }
        for joint in joints() {
            flag(text, joint.valid);
            if joint.valid != 1 {
                let reason = joint.reason.get().unwrap_or_default();
                *self.withheld.entry(reason.word()).or_default() += 1;
            }
        }
        for joint in joints() {
            let why = joint.reason.get().unwrap_or_default();
            reason(text, channels, why, joint.cause);
        }
        let residuals = estimate.contacts.residuals();
        for i in 0..self.subtrees {
            let residual = residuals.get(i).unwrap_or(&Residual::ABSENT);
            write_residual(text, &self.contacts, residual);
        }
        let drives = drives.map(DriveEstimate::drives).unwrap_or_default();
        let drives = || (0..self.drives).map(|i| drives.get(i).unwrap_or(&DriveTorque::ABSENT));
        numbers(text, drives().map(|drive| drive.torque));
        numbers(text, drives().map(|drive| drive.standard_deviation));
        for drive in drives() {
            match drive.agreement.get().unwrap_or_default() {
                Agreement::Unknown => text.push(b','),
                agreement => flag(text, u32::from(agreement == Agreement::Disagrees)),
            }
        }
        text.push(b'\n');
        self.rows += 1;
        self.out.write_all(text)
    }

    /// Returns the output.
    pub fn into_inner(self) -> W {
        self.out
    }
}

/// The cells of a contact.
fn write_contact(text: &mut Vec<u8>, channels: &[String], contact: &ContactWrench) {
    let wrench = contact.force.into_iter().chain(contact.torque);
    numbers(text, wrench.chain(contact.standard_deviation));
    flag(text, contact.valid);
    let why = contact.reason.get().unwrap_or_default();
    reason(text, channels, why, contact.cause);
    flag(text, contact.detected);
    numbers(text, contact.position);
    flag(text, contact.located);
}

/// The cells of a sub-tree's residual.
fn write_residual(text: &mut Vec<u8>, contacts: &[String], residual: &Residual) {
    let wrench = residual.force.into_iter().chain(residual.torque);
    numbers(text, wrench.chain([residual.significance]));
    text.push(b',');
    let contact = contacts.get(residual.contact as usize).map(String::as_str);
    let cause = contact.or((residual.unexplained == 1).then_some("unexplained"));
    text.extend_from_slice(cause.unwrap_or_default().as_bytes());
}

/// A cell: 1 or 0.
fn flag(text: &mut Vec<u8>, value: u32) {
    text.extend_from_slice(if value == 1 { b",1" } else { b",0" });
}

/// A cell: why a value is not valid, and the channel at fault after a colon; empty if it is valid.
fn reason(text: &mut Vec<u8>, channels: &[String], reason: Reason, cause: u32) {
    text.push(b',');
    if reason == Reason::None {
        return;
    }
    let start = text.len();
    text.extend_from_slice(reason.word().as_bytes());
    if cause != NO_CAUSE
        && let Some(channel) = channels.get(cause as usize)
    {
        text.push(b':');
        text.extend_from_slice(channel.as_bytes());
        quote(text, start);
    }
}

/// Puts the last cell, which begins at `start`, in quotes if the names in it need them (RFC 4180).
fn quote(text: &mut Vec<u8>, start: usize) {
    let cell = text.get(start..).unwrap_or_default();
    if !cell.iter().any(|byte| b",\"\r\n".contains(byte)) {
        return;
    }
    let cell = text.split_off(start);
    text.push(b'"');
    for byte in cell {
        if byte == b'"' {
            text.push(byte);
        }
        text.push(byte);
    }
    text.push(b'"');
}

/// Cells: the shortest text that reads back as the same number; empty for NaN.
fn numbers(text: &mut Vec<u8>, values: impl IntoIterator<Item = f64>) {
    for value in values {
        text.push(b',');
        if !value.is_nan() {
            text.extend_from_slice(zmij::Buffer::new().format(value).as_bytes());
        }
    }
}
