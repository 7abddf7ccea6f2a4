//! What an outcome means, in plain words: whether to use the parameters, why, and what to do next.

use proprio_identification::{
    Both, Finding, FindingCode, LogOutcome, LogRole, Outcome, Severity, Verdict,
};
use std::collections::{BTreeMap, BTreeSet};

/// Whether the identified parameters should be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Grade {
    /// Yes.
    Accept,
    /// After a person has looked at the warnings.
    Care,
    /// No.
    Reject,
}

impl Grade {
    /// The word for programs.
    pub(crate) fn word(self) -> &'static str {
        match self {
            Self::Accept => "accept",
            Self::Care => "care",
            Self::Reject => "reject",
        }
    }

    /// The words for a person.
    pub(crate) fn headline(self) -> &'static str {
        match self {
            Self::Accept => "Accept",
            Self::Care => "Accept with care",
            Self::Reject => "Reject",
        }
    }
}

/// An outcome in plain words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Advice {
    /// Whether to use it.
    pub(crate) grade: Grade,
    /// Why: sentences that make one paragraph.
    pub(crate) why: Vec<String>,
    /// What to do next, most important first.
    pub(crate) next: Vec<String>,
}

/// Relative difference of two validation errors below which they count as equal; and the error of
/// the CAD below which there is nothing to gain: measured torques repeat to a hundredth or two.
const NOTICEABLE: f64 = 0.02;

/// Relative error above which less than half of the power of what was measured is explained: to
/// predict zero has an error of one.
const UNEXPLAINED: f64 = std::f64::consts::FRAC_1_SQRT_2;

impl Advice {
    /// What `outcome` means.
    pub(crate) fn of(outcome: &Outcome) -> Self {
        let mut this = Self {
            grade: Grade::Accept,
            why: vec![],
            next: vec![],
        };
        if let Verdict::Nothing(reason) = &outcome.verdict {
            this.grade = Grade::Reject;
            this.why
                .push(format!("Nothing was identified: {}", stop(reason)));
            this.why.push("No parameters were written.".into());
            this.look_at_findings(outcome);
            return this;
        }
        this.assess_errors(outcome);
        this.refuse_wrong_configuration(outcome);
        if outcome.verdict == Verdict::NoBetterThanCad {
            let has_errors = |log: &LogOutcome| log.predicted.relative_error.cad > NOTICEABLE;
            this.worsen(if outcome.logs.iter().any(has_errors) {
                Grade::Reject
            } else {
                Grade::Care
            });
            let why = if findings(outcome).any(|(_, f)| f.code == FindingCode::NotCrossValidated) {
                "The logs are too short for cross-validation, so the parameters keep their CAD \
                 values"
            } else {
                "In cross-validation the identified parameters predicted no better than the CAD's, \
                 so the parameters keep their CAD values"
            };
            this.why
                .push(format!("{why}; the offsets were identified."));
        } else {
            let back: Vec<&str> = outcome
                .links
                .iter()
                .filter(|link| link.seen && link.retained_fraction == 0.0)
                .map(|link| link.name.as_str())
                .collect();
            if !back.is_empty() {
                this.worsen(Grade::Care);
                this.why.push(format!(
                    "{} keep their CAD parameters: in cross-validation the identified ones were no \
                     better.",
                    back.join(", ")
                ));
            }
        }
        this.look_at_findings(outcome);
        this.assess_excitation(outcome);
        if this.grade == Grade::Reject {
            this.why.push("No parameters were written.".into());
        } else {
            if !outcome.logs.iter().any(|log| log.role == LogRole::Validate) {
                this.next.push(
                    "Record a different motion and pass it with --validate: only that shows how \
                     good the parameters are outside the training logs."
                        .into(),
                );
            }
            this.next.push(
                "To use the result, copy parameters.toml beside estimator.toml and write \
                 parameters = \"parameters.toml\" above the first [table] there; other programs \
                 load identified.urdf."
                    .into(),
            );
        }
        this
    }

    fn worsen(&mut self, grade: Grade) {
        if grade as u8 > self.grade as u8 {
            self.grade = grade;
        }
    }

    /// Prediction errors: on the validation logs, if there are any.
    fn assess_errors(&mut self, outcome: &Outcome) {
        let validated = outcome.logs.iter().any(|log| log.role == LogRole::Validate);
        let role = if validated {
            LogRole::Validate
        } else {
            LogRole::Train
        };
        let mut compared = false;
        let (mut least, mut gained, mut to_gain) = (f64::INFINITY, false, false);
        for log in outcome.logs.iter().filter(|log| log.role == role) {
            let Both { cad, identified } = log.predicted.relative_error;
            if !(cad.is_finite() && identified.is_finite()) {
                if validated {
                    self.worsen(Grade::Care);
                    self.why.push(format!(
                        "{} holds no measurement that can be compared with a prediction.",
                        log.file
                    ));
                }
                continue;
            }
            compared = true;
            // Errors where something touched the robot say little about the parameters.
            if validated && !is_disturbed(log) {
                least = least.min(identified);
                to_gain |= cad > NOTICEABLE;
            }
            gained |= identified < cad;
            self.state_error(log);
            self.compare_with_cad(log);
        }
        if !compared {
            self.worsen(Grade::Care);
            self.why.push(
                "No measurement could be compared with a prediction, so the quality of the \
                 parameters is unknown."
                    .into(),
            );
        }
        if least.is_finite() && least > UNEXPLAINED {
            self.worsen(Grade::Reject);
            self.why.push(
                "An error of this size explains little of what was measured: a prediction of zero \
                 has 100 %."
                    .into(),
            );
        }
        if to_gain && !gained {
            self.worsen(Grade::Reject);
            self.why
                .push("Nothing was gained over the CAD on any of them.".into());
        }
        if !validated {
            self.why.push("No validation log was given.".into());
        }
    }

    fn state_error(&mut self, log: &LogOutcome) {
        let Both { cad, identified } = log.predicted.relative_error;
        let how = match log.role {
            LogRole::Validate => ", which was not used for training",
            LogRole::Train => "",
        };
        self.why.push(format!(
            "On {}{how}, the relative prediction error of {} is {} with the identified parameters \
             and {} with the CAD's ({}).",
            log.file,
            predicted(log),
            percent(identified),
            percent(cad),
            if !log.joints.is_empty() {
                "nothing was fitted to it"
            } else {
                "for both, only a constant offset of each F/T channel was fitted to it"
            },
        ));
    }

    /// What it means if the error of a log is not below that of the CAD.
    fn compare_with_cad(&mut self, log: &LogOutcome) {
        let Both { cad, identified } = log.predicted.relative_error;
        let is_worse = identified > cad * (1.0 + NOTICEABLE);
        let is_no_better = identified > cad * (1.0 - NOTICEABLE);
        let (grade, why, next) = match log.role {
            LogRole::Train if is_worse => {
                let why = "That is worse than the CAD.".to_owned();
                (Grade::Care, why, None)
            }
            LogRole::Validate if is_worse && is_disturbed(log) => (
                Grade::Care,
                format!(
                    "That is worse than the CAD, but {} contains undeclared contacts or loads.",
                    log.file
                ),
                Some(format!(
                    "Declare the contacts and loads of {}, or validate on a log without them.",
                    log.file
                )),
            ),
            LogRole::Validate if is_worse => (
                Grade::Reject,
                "That is worse than the CAD: the parameters are not valid outside the training \
                 motion."
                    .to_owned(),
                Some(format!(
                    "Identify from richer motion: add {} to the training logs, or record longer \
                     and faster motion.",
                    log.file
                )),
            ),
            LogRole::Validate if is_no_better => {
                let why = "That is no better than the CAD.".to_owned();
                (Grade::Care, why, None)
            }
            _ => return,
        };
        self.worsen(grade);
        self.why.push(why);
        self.next.extend(next);
    }

    /// With a wrong sign, frame or gravity in the configuration, the parameters make up for it in
    /// the training motion alone. (A log that was refused for it is not part of them.)
    fn refuse_wrong_configuration(&mut self, outcome: &Outcome) {
        let is_wrong = |(log, finding): &(Option<&LogOutcome>, &Finding)| {
            finding.severity >= Severity::Warning
                && log.is_none_or(|log| log.role == LogRole::Train && log.used > 0)
                && [
                    FindingCode::WrongSign,
                    FindingCode::WrongFrame,
                    FindingCode::WrongGravity,
                ]
                .contains(&finding.code)
        };
        if findings(outcome).any(|found| is_wrong(&found)) {
            self.worsen(Grade::Reject);
            self.why.push(
                "The configuration is wrong, see \"Findings\": parameters cannot make up for it."
                    .into(),
            );
        }
    }

    fn look_at_findings(&mut self, outcome: &Outcome) {
        let all = || findings(outcome).map(|(_, finding)| finding);
        let count = |severity| all().filter(|f| f.severity == severity).count();
        let (refusals, warnings) = (count(Severity::Refusal), count(Severity::Warning));
        if refusals + warnings == 0 {
            return;
        }
        self.worsen(Grade::Care);
        // Faults that every log of this robot would show; each once.
        let mut said = BTreeSet::new();
        for finding in all().filter(|f| {
            matches!(
                f.code,
                FindingCode::WrongSign
                    | FindingCode::WrongFrame
                    | FindingCode::WrongGravity
                    | FindingCode::EncoderOffset
                    | FindingCode::WrongUnits
                    | FindingCode::Scale
            )
        }) {
            if finding.severity >= Severity::Warning && said.insert(finding.text.as_str()) {
                self.next.push(sentence(&finding.text));
            }
        }
        // The same checks for every log: once per channel.
        let mut unexplained = BTreeMap::<&str, Vec<&str>>::new();
        for (log, finding) in findings(outcome) {
            if finding.code == FindingCode::Unexplained && finding.severity >= Severity::Warning {
                let logs = unexplained.entry(&finding.subject).or_default();
                logs.extend(log.map(|log| log.file.as_str()));
            }
        }
        for (channel, logs) in unexplained {
            self.next.push(format!(
                "Check {channel}: much of its changes is unexplained{}{}; \"Findings\" names \
                 possible causes.",
                if logs.is_empty() { "" } else { " in " },
                logs.join(", ")
            ));
        }
        let total = refusals + warnings;
        let what = if total == 1 {
            "finding"
        } else {
            &format!("{total} findings")
        };
        self.next
            .push(if matches!(outcome.verdict, Verdict::Nothing(_)) {
                "Correct what \"Findings\" names, then identify again.".into()
            } else {
                format!("Read the {what} under \"Findings\" before you use the result.")
            });
    }

    /// What the motion did not excite.
    fn assess_excitation(&mut self, outcome: &Outcome) {
        if outcome.effective.is_finite() && outcome.rank > 0 {
            self.why.push(format!(
                "Of {} identifiable combinations of inertial parameters the logs determine about \
                 {:.0}; the CAD determines the others.",
                outcome.structural_rank, outcome.effective
            ));
        }
        // Links in the least excited directions.
        let mut links: Vec<&str> = Vec::new();
        for weak in outcome
            .weakest
            .iter()
            .filter(|w| w.prior_share > 0.9)
            .take(5)
        {
            for link in outcome
                .links
                .iter()
                .filter(|l| weak.links.contains(&l.link))
            {
                if !links.contains(&link.name.as_str()) {
                    links.push(&link.name);
                }
            }
        }
        links.truncate(4);
        if !links.is_empty() {
            self.next.push(format!(
                "The motion excites {} least: turn and accelerate {} about more axes, and faster.",
                links.join(", "),
                if links.len() == 1 { "it" } else { "them" }
            ));
        }
    }
}

/// All findings, each with its log if it concerns one.
pub(crate) fn findings(outcome: &Outcome) -> impl Iterator<Item = (Option<&LogOutcome>, &Finding)> {
    let of_logs = outcome
        .logs
        .iter()
        .flat_map(|log| log.findings.iter().map(move |f| (Some(log), f)));
    outcome.findings.iter().map(|f| (None, f)).chain(of_logs)
}

/// Whether something touched the robot, and nobody declared it.
fn is_disturbed(log: &LogOutcome) -> bool {
    let mut findings = log.findings.iter();
    findings.any(|f| f.code == FindingCode::Disturbance)
}

/// What the relative prediction error of a log compares.
fn predicted(log: &LogOutcome) -> &'static str {
    if log.joints.is_empty() {
        "F/T readings"
    } else {
        "joint torques"
    }
}

/// A share in percent, with two or three digits.
pub(crate) fn percent(share: f64) -> String {
    if !share.is_finite() {
        return "–".into();
    }
    let value = share * 100.0;
    if value < 10.0 {
        format!("{value:.2} %")
    } else {
        format!("{value:.1} %")
    }
}

/// With a full stop.
fn stop(text: &str) -> String {
    let text = text.trim();
    let stop = if text.ends_with(['.', '!', '?']) {
        ""
    } else {
        "."
    };
    format!("{text}{stop}")
}

/// With a capital letter and a full stop.
pub(crate) fn sentence(text: &str) -> String {
    capital(&stop(text))
}

/// With a capital letter, unless it starts with a name (recognised by a digit, dot, slash or
/// underscore).
fn capital(text: &str) -> String {
    let first = text.split_whitespace().next().unwrap_or_default();
    if first
        .chars()
        .any(|c| c == '_' || c == '.' || c == '/' || c.is_numeric())
    {
        return text.to_owned();
    }
    let mut letters = text.chars();
    letters
        .next()
        .map_or_else(String::new, |c| c.to_uppercase().chain(letters).collect())
}

#[cfg(test)]
mod tests {
    use super::super::example;
    use super::*;
    use proprio_identification::WeakDirection;

    /// Without findings.
    fn good() -> Outcome {
        let mut outcome = example::outcome();
        outcome.logs.iter_mut().for_each(|log| log.findings.clear());
        outcome
    }

    #[test]
    fn a_validated_result_without_findings_is_accepted() {
        let advice = Advice::of(&good());
        assert_eq!(advice.grade, Grade::Accept, "{advice:?}");
        let why = advice.why.join(" ");
        assert!(
            why.starts_with("On walk_2.csv, which was not used for training, "),
            "{why}"
        );
        assert!(
            why.contains("is 2.35 % with the identified parameters and 6.40 % with the CAD's"),
            "{why}"
        );
        assert!(advice.next.iter().any(|n| n.contains("parameters.toml")));
        assert!(
            !advice.next.iter().any(|n| n.contains("--validate")),
            "{:?}",
            advice.next
        );
    }

    #[test]
    fn a_validation_error_above_the_cads_is_rejected() {
        let mut outcome = good();
        outcome.logs[1].predicted.relative_error.identified = 0.07;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Reject);
        assert!(
            !advice.next.iter().any(|n| n.contains("parameters.toml")),
            "{:?}",
            advice.next
        );
        // Worse where something touched the robot says nothing about the parameters.
        let training = |advice: &Advice| {
            (advice.next.iter()).any(|n| n.contains("add walk_2.csv to the training logs"))
        };
        assert!(training(&advice));
        outcome.logs[1].findings.push(Finding {
            severity: Severity::Note,
            code: FindingCode::Disturbance,
            subject: String::new(),
            text: "an undeclared contact".into(),
        });
        let advice = Advice::of(&outcome);
        assert!(!training(&advice));
        assert!(
            advice.next[0].starts_with("Declare the contacts and loads of walk_2.csv"),
            "{advice:?}"
        );
        outcome.logs[1].findings.clear();
        // Equal to the CAD is no gain, and a hundredth is not accepted without a remark.
        outcome.logs[1].predicted.relative_error.identified = 0.0645;
        assert_eq!(Advice::of(&outcome).grade, Grade::Reject);
        outcome.logs[1].predicted.relative_error.identified = 0.064;
        assert_eq!(Advice::of(&outcome).grade, Grade::Reject);
        outcome.logs[1].predicted.relative_error.identified = 0.0635;
        assert_eq!(Advice::of(&outcome).grade, Grade::Care);
        // An error of the size of what was measured is no use, however bad the CAD is.
        outcome.logs[1].predicted.relative_error = Both {
            cad: 1.1,
            identified: 0.8,
        };
        assert_eq!(Advice::of(&outcome).grade, Grade::Reject);
    }

    #[test]
    fn a_missing_validation_log_is_the_next_thing_to_do() {
        let mut outcome = good();
        outcome.logs.pop();
        let advice = Advice::of(&outcome);
        assert!(
            advice.next.iter().any(|n| n.contains("--validate")),
            "{:?}",
            advice.next
        );
        assert!(advice.why.iter().any(|n| n.contains("No validation log")));
    }

    #[test]
    fn findings_and_no_gain_each_lower_the_grade() {
        let mut outcome = good();
        outcome.verdict = Verdict::NoBetterThanCad;
        assert_eq!(Advice::of(&outcome).grade, Grade::Reject);
        // Where the CAD is right to a hundredth there is nothing to gain.
        for log in &mut outcome.logs {
            log.predicted.relative_error = Both {
                cad: 0.01,
                identified: 0.01,
            };
        }
        assert_eq!(Advice::of(&outcome).grade, Grade::Care);
        let mut outcome = good();
        outcome.findings.push(Finding {
            severity: Severity::Warning,
            code: FindingCode::WrongSign,
            subject: "r_leg_ft_sensor".into(),
            text: "r_leg_ft_sensor seems to be mounted the wrong way round".into(),
        });
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Reject);
        assert!(
            advice
                .next
                .iter()
                .any(|n| n == "r_leg_ft_sensor seems to be mounted the wrong way round."),
            "{advice:?}"
        );
    }

    #[test]
    fn an_unexplained_residual_lowers_the_grade() {
        let mut outcome = good();
        for log in &mut outcome.logs {
            log.findings.push(Finding {
                severity: Severity::Warning,
                code: FindingCode::Unexplained,
                subject: "wrench/r_leg_ft_sensor".into(),
                text: "wrench/r_leg_ft_sensor: 20 % is unexplained".into(),
            });
        }
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        // Once, with both logs.
        assert_eq!(
            advice.next[0],
            "Check wrench/r_leg_ft_sensor: much of its changes is unexplained in walk_1.csv, \
             walk_2.csv; \"Findings\" names possible causes."
        );
        assert!(advice.next[1].contains("2 findings"), "{advice:?}");
    }

    #[test]
    fn a_result_compared_with_nothing_is_not_accepted() {
        let nowhere = Both {
            cad: f64::NAN,
            identified: f64::NAN,
        };
        let mut outcome = good();
        outcome.logs[1].predicted.relative_error = nowhere;
        let advice = Advice::of(&outcome);
        assert_eq!(
            advice.grade,
            Grade::Care,
            "the log for validation: {advice:?}"
        );
        outcome.logs.pop();
        assert_eq!(Advice::of(&outcome).grade, Grade::Accept);
        outcome.logs[0].predicted.relative_error = nowhere;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(
            advice
                .why
                .iter()
                .any(|n| n.starts_with("No measurement could")),
            "{advice:?}"
        );
    }

    #[test]
    fn partial_retention_is_reported() {
        let mut outcome = good();
        outcome.links[2].retained_fraction = 0.0;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(
            advice.why.iter().any(|n| n.starts_with("r_ankle_1 keep")),
            "{advice:?}"
        );
    }

    #[test]
    fn the_least_excited_links_are_named() {
        let mut outcome = good();
        // Half of the variance of the second is the prior's.
        let weak = |link: usize, prior_share: f64| WeakDirection {
            expression: "a direction".into(),
            links: vec![outcome.links[link].link],
            relative: 1e-4,
            prior_share,
        };
        outcome.weakest = vec![weak(1, 1.0), weak(2, 0.5)];
        let (named, other) = (&outcome.links[1].name, &outcome.links[2].name);
        let next = Advice::of(&outcome).next.join(" ");
        assert!(
            next.contains(&format!("The motion excites {named} least:")),
            "{next}"
        );
        assert!(!next.contains(other.as_str()), "{next}");
    }

    #[test]
    fn nothing_is_a_rejection_that_says_why() {
        let advice = Advice::of(&example::nothing());
        assert_eq!(advice.grade, Grade::Reject);
        assert_eq!(
            advice.why[0],
            "Nothing was identified: no joint moved in any log."
        );
    }

    #[test]
    fn names_keep_their_letters() {
        assert_eq!(sentence("l_hand.m is wrong"), "l_hand.m is wrong.");
        assert_eq!(sentence("no motion "), "No motion.");
        assert_eq!(sentence("Fine!"), "Fine!");
    }
}
