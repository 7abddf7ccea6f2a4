//! What an outcome means, in plain words: whether to use the parameters, why, and what to do next.

use proprio_estimator::identify::{Both, Finding, LogOutcome, Outcome, Role, Severity, Verdict};
use std::collections::BTreeSet;

/// Whether the identified parameters should be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Grade {
    /// Yes.
    Accept,
    /// They are sound as far as they go, but somebody should look at what is said first.
    Care,
    /// No.
    Reject,
}

impl Grade {
    /// As a word for programs.
    pub(crate) fn word(self) -> &'static str {
        match self {
            Self::Accept => "accept",
            Self::Care => "care",
            Self::Reject => "reject",
        }
    }

    /// As a word for people.
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
    /// Use it or not.
    pub(crate) grade: Grade,
    /// Why: sentences that make one paragraph.
    pub(crate) why: Vec<String>,
    /// What to do next, most important first.
    pub(crate) next: Vec<String>,
}

/// A validation error so much larger than CAD's, relatively, is worse; so much smaller is better. Between the two they are equal.
const NOTICEABLE: f64 = 0.02;

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
            this.why.push(format!("Nothing was identified: {}", stop(reason)));
            this.why
                .push("No parameters were written; those in use stay as they are.".into());
            this.look_at_findings(outcome);
            return this;
        }
        this.say_errors(outcome);
        if outcome.verdict == Verdict::NoBetterThanCad {
            this.worsen(Grade::Care);
            let why = if findings(outcome).any(|(_, f)| f.code == "not_checked") {
                "The logs are too short to hold a part of them back and see what the parameters are worth there, so these were drawn back to the CAD's"
            } else {
                "On stretches of the logs that were held back from the fit, the identified parameters did no better than the CAD's, so they were drawn back to these"
            };
            this.why.push(format!(
                "{why}: the offsets are worth having, the parameters are the CAD's."
            ));
        } else {
            let back: Vec<&str> = outcome
                .links
                .iter()
                .filter(|link| link.seen && link.kept == 0.0)
                .map(|link| link.name.as_str())
                .collect();
            if !back.is_empty() {
                this.worsen(Grade::Care);
                this.why.push(format!(
                    "Of {} the logs show no better parameters than the CAD's: these stay.",
                    back.join(", ")
                ));
            }
        }
        if outcome.consistency.feasible.is_none() {
            this.worsen(Grade::Care);
            this.why
                .push("Whether bodies exist that have what the logs say was not decided.".into());
        }
        if outcome.consistency.feasible == Some(false) {
            // The parameters given are of bodies that can exist, the nearest; so it is what they are worth elsewhere that counts, if it is known.
            this.worsen(Grade::Care);
            this.why.push(
                "Taken alone, the logs ask for bodies that can not exist; the parameters are those of the nearest that can."
                    .into(),
            );
            this.next.push(
                "Check the signs, frames and units of the sensors and the joints' zero positions, and that no contact was left undeclared."
                    .into(),
            );
        }
        this.look_at_findings(outcome);
        this.say_excitation(outcome);
        if this.grade != Grade::Reject {
            if !outcome.logs.iter().any(|log| log.role == Role::Validate) {
                this.next.push("Record another motion, unlike these, and give it with --validate: only that shows how good the parameters are where they were not fitted.".into());
            }
            this.next.push(
                "To use the result, name it in estimator.toml, parameters = \"parameters.toml\"; other programs load identified.urdf.".into(),
            );
        }
        this
    }

    fn worsen(&mut self, grade: Grade) {
        if grade as u8 > self.grade as u8 {
            self.grade = grade;
        }
    }

    /// How far predictions are off: on the logs for validation, if there are any.
    fn say_errors(&mut self, outcome: &Outcome) {
        let validated = outcome.logs.iter().any(|log| log.role == Role::Validate);
        let role = if validated { Role::Validate } else { Role::Train };
        let mut compared = false;
        for log in outcome.logs.iter().filter(|log| log.role == role) {
            let Both { cad, identified } = log.predicted.relative_error;
            if !(cad.is_finite() && identified.is_finite()) {
                if validated {
                    self.worsen(Grade::Care);
                    self.why
                        .push(format!("{} could not be compared with any prediction.", log.file));
                }
                continue;
            }
            compared = true;
            let how = if validated {
                ", which was not used for the fit"
            } else {
                ""
            };
            self.why.push(format!(
                "On {}{how}, {} predicted with the identified parameters are {} off, with the CAD's parameters {} ({}).",
                log.file,
                predicted(log),
                percent(identified),
                percent(cad),
                if log.predicted.sensors.is_empty() {
                    "nothing was fitted to it"
                } else {
                    "nothing was fitted to it but a constant offset of each F/T channel, for both alike"
                },
            ));
            if identified > cad * (1.0 + NOTICEABLE) {
                if validated {
                    self.worsen(Grade::Reject);
                    self.why.push("That is worse than the CAD: the parameters do not hold outside the motion that they were fitted to.".into());
                    self.next.push(format!(
                        "Identify from richer motion: with {} among the training logs, or longer and faster ones.",
                        log.file
                    ));
                } else {
                    self.worsen(Grade::Care);
                    self.why.push("That is worse than the CAD.".into());
                }
            } else if validated && identified > cad * (1.0 - NOTICEABLE) {
                self.worsen(Grade::Care);
                self.why.push("That is no better than the CAD.".into());
            }
        }
        if !compared {
            self.worsen(Grade::Care);
            self.why.push(
                "Nothing that was measured could be compared with what the parameters predict, so nothing shows what they are worth."
                    .into(),
            );
        }
        if !validated {
            self.why.push("No log was kept for validation.".into());
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
        // What a fit to any motion would meet again; each once, although several logs may show it.
        let mut said = BTreeSet::new();
        for finding in all().filter(|f| {
            matches!(
                f.code,
                "wrong_sign" | "wrong_frame" | "joint_zero" | "units" | "wrong_units" | "scale" | "unexplained"
            )
        }) {
            if finding.severity >= Severity::Warning && said.insert(finding.text.as_str()) {
                self.next.push(sentence(&finding.text));
            }
        }
        let total = refusals + warnings;
        let what = if total == 1 {
            "finding"
        } else {
            &format!("{total} findings")
        };
        self.next.push(format!(
            "Look at the {what} listed under \"What was found\" before relying on the result."
        ));
    }

    /// What the motion could not show.
    fn say_excitation(&mut self, outcome: &Outcome) {
        let (rank, all) = (outcome.rank, outcome.structural_rank);
        let mut parts = Vec::new();
        if rank < all {
            parts.push(format!(
                "the motion shows {rank} of the {all} combinations of parameters that could show"
            ));
        }
        if outcome.effective.is_finite() && rank > 0 {
            parts.push(format!(
                "the logs rather than the CAD decide about {:.0}",
                outcome.effective
            ));
        }
        if !parts.is_empty() {
            self.why.push(format!("{}.", capital(&parts.join("; "))));
        }
        // Links that the weakest directions are about.
        let mut links: Vec<&str> = Vec::new();
        for weak in outcome.weakest.iter().filter(|w| w.prior_share > 0.9).take(5) {
            for link in outcome.links.iter().filter(|l| weak.links.contains(&l.link)) {
                if !links.contains(&link.name.as_str()) {
                    links.push(&link.name);
                }
            }
        }
        links.truncate(4);
        if !links.is_empty() {
            self.next.push(format!(
                "The logs say least about {}: motion that turns and shakes {} about more axes, and faster, would tell more.",
                links.join(", "),
                if links.len() == 1 { "it" } else { "them" }
            ));
        }
    }
}

/// All findings, with the log that each is about.
pub(crate) fn findings(outcome: &Outcome) -> impl Iterator<Item = (Option<&LogOutcome>, &Finding)> {
    let of_logs = outcome
        .logs
        .iter()
        .flat_map(|log| log.findings.iter().map(move |f| (Some(log), f)));
    outcome.findings.iter().map(|f| (None, f)).chain(of_logs)
}

/// What a log lets be compared.
fn predicted(log: &LogOutcome) -> &'static str {
    match (log.joints.is_empty(), log.sensors.is_empty()) {
        (false, true) => "joint torques",
        (true, false) => "F/T readings",
        _ => "joint torques and F/T readings",
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
    let stop = if text.ends_with(['.', '!', '?']) { "" } else { "." };
    format!("{text}{stop}")
}

/// With a capital letter and a full stop.
pub(crate) fn sentence(text: &str) -> String {
    capital(&stop(text))
}

/// With a capital letter, unless it starts with a name (which has a capital, a digit or an underscore in it).
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
    use proprio_estimator::identify::WeakDirection;

    /// Nothing to complain of.
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
            why.starts_with("On walk_2.csv, which was not used for the fit, "),
            "{why}"
        );
        assert!(why.contains("2.35 % off, with the CAD's parameters 6.40 %"), "{why}");
        assert!(advice.next.iter().any(|n| n.contains("parameters.toml")));
        assert!(
            !advice.next.iter().any(|n| n.contains("--validate")),
            "{:?}",
            advice.next
        );
    }

    #[test]
    fn what_is_worse_than_cad_where_it_was_not_fitted_is_rejected() {
        let mut outcome = good();
        outcome.logs[1].predicted.relative_error.identified = 0.07;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Reject);
        assert!(
            !advice.next.iter().any(|n| n.contains("parameters.toml")),
            "{:?}",
            advice.next
        );
        // No better is not good enough to be accepted without a word.
        outcome.logs[1].predicted.relative_error.identified = 0.064;
        assert_eq!(Advice::of(&outcome).grade, Grade::Care);
    }

    #[test]
    fn without_validation_that_is_the_next_thing_to_do() {
        let mut outcome = good();
        outcome.logs.pop();
        let advice = Advice::of(&outcome);
        assert!(
            advice.next.iter().any(|n| n.contains("--validate")),
            "{:?}",
            advice.next
        );
        assert!(advice.why.iter().any(|n| n.contains("No log was kept for validation")));
    }

    #[test]
    fn impossible_bodies_findings_and_no_gain_each_lower_the_grade() {
        let mut outcome = good();
        outcome.consistency.feasible = Some(false);
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(advice.next[0].starts_with("Check the signs"), "{advice:?}");
        assert_eq!(Advice::of(&example::outcome()).grade, Grade::Care);
        let mut outcome = good();
        outcome.verdict = Verdict::NoBetterThanCad;
        assert_eq!(Advice::of(&outcome).grade, Grade::Care);
        let mut outcome = good();
        outcome.findings.push(Finding {
            severity: Severity::Warning,
            code: "wrong_sign",
            subject: "r_leg_ft_sensor".into(),
            text: "r_leg_ft_sensor seems to be mounted the wrong way round".into(),
        });
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(
            advice
                .next
                .iter()
                .any(|n| n == "r_leg_ft_sensor seems to be mounted the wrong way round."),
            "{advice:?}"
        );
    }

    #[test]
    fn what_no_parameters_explain_wants_care() {
        let mut outcome = good();
        outcome.logs[0].findings.push(Finding {
            severity: Severity::Warning,
            code: "unexplained",
            subject: "wrench/r_leg_ft_sensor".into(),
            text: "wrench/r_leg_ft_sensor: 20 % is left".into(),
        });
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(advice.next.iter().any(|n| n.contains("20 % is left")), "{advice:?}");
    }

    #[test]
    fn what_was_compared_with_nothing_is_not_accepted() {
        let nowhere = Both {
            cad: f64::NAN,
            identified: f64::NAN,
        };
        let mut outcome = good();
        outcome.logs[1].predicted.relative_error = nowhere;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care, "the log for validation: {advice:?}");
        outcome.logs.pop();
        assert_eq!(Advice::of(&outcome).grade, Grade::Accept);
        outcome.logs[0].predicted.relative_error = nowhere;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(
            advice.why.iter().any(|n| n.starts_with("Nothing that was measured")),
            "{advice:?}"
        );
    }

    #[test]
    fn what_is_not_decided_or_partly_kept_is_said() {
        let mut outcome = good();
        outcome.consistency.feasible = None;
        assert_eq!(Advice::of(&outcome).grade, Grade::Care);
        let mut outcome = good();
        outcome.links[2].kept = 0.0;
        let advice = Advice::of(&outcome);
        assert_eq!(advice.grade, Grade::Care);
        assert!(
            advice.why.iter().any(|n| n.starts_with("Of r_ankle_1 the logs")),
            "{advice:?}"
        );
    }

    #[test]
    fn links_that_the_logs_say_least_about_are_named() {
        let mut outcome = good();
        // Of the second the logs say half.
        let weak = |link: usize, prior_share: f64| WeakDirection {
            expression: "a direction".into(),
            links: vec![outcome.links[link].link],
            relative: 1e-4,
            prior_share,
        };
        outcome.weakest = vec![weak(1, 1.0), weak(2, 0.5)];
        let (named, other) = (&outcome.links[1].name, &outcome.links[2].name);
        let next = Advice::of(&outcome).next.join(" ");
        assert!(next.contains(&format!("The logs say least about {named}:")), "{next}");
        assert!(!next.contains(other.as_str()), "{next}");
    }

    #[test]
    fn nothing_is_a_rejection_that_says_why() {
        let advice = Advice::of(&example::nothing());
        assert_eq!(advice.grade, Grade::Reject);
        assert_eq!(advice.why[0], "Nothing was identified: no joint moved in any log.");
    }

    #[test]
    fn names_keep_their_letters() {
        assert_eq!(sentence("l_hand.m is wrong"), "l_hand.m is wrong.");
        assert_eq!(sentence("no motion "), "No motion.");
        assert_eq!(sentence("Fine!"), "Fine!");
    }
}
