//! `report.html`: an outcome for a person. First the verdict and what to do, then the evidence,
//! then everything else.

mod identified;
mod prediction;
mod words;

use super::advice::{Advice, Grade, findings, percent, sentence};
use super::summary::severity;
use crate::report::{self, escape, number};
use identified::{excitation, parameters, sessions};
use prediction::{curves, logs, residuals};
use proprio_identification::{LogOutcome, Outcome, Severity, Verdict};
use words::{counted, role_words};

/// The page.
pub(crate) fn page(outcome: &Outcome, advice: &Advice) -> String {
    let mut blocks = vec![verdict(advice), key_facts(outcome)];
    blocks.extend(found(outcome));
    blocks.extend(logs(outcome));
    blocks.extend(curves(outcome));
    blocks.extend(residuals(outcome));
    if !matches!(outcome.verdict, Verdict::Nothing(_)) {
        blocks.extend(parameters(outcome));
    }
    blocks.extend(excitation(outcome));
    blocks.extend(sessions(outcome));
    blocks.push(how_to_read());
    report::page(&format!("Identification of {}", outcome.robot), &blocks)
}

fn verdict(advice: &Advice) -> String {
    let class = match advice.grade {
        Grade::Accept => "good",
        Grade::Care => "care",
        Grade::Reject => "bad",
    };
    let next = report::list(&advice.next);
    let next = if next.is_empty() {
        next
    } else {
        format!("<div><h3>What to do next</h3>{next}</div>")
    };
    format!(
        "<div class=\"verdict {class}\"><h2>{}</h2><div \
         class=\"sides\"><div>{}</div>{next}</div></div>",
        advice.grade.headline(),
        report::paragraph(&advice.why.join(" "))
    )
}

fn key_facts(outcome: &Outcome) -> String {
    if matches!(outcome.verdict, Verdict::Nothing(_)) {
        return String::new();
    }
    let mut facts = Vec::new();
    for log in &outcome.logs {
        let error = &log.predicted.relative_error;
        if error.identified.is_finite() {
            facts.push((
                format!("error on {} ({})", log.file, role_words(log.role)),
                format!("{}, CAD {}", percent(error.identified), percent(error.cad)),
            ));
        }
    }
    facts.push((
        "identifiable combinations of parameters".into(),
        format!("{} from the robot's structure", outcome.structural_rank),
    ));
    if outcome.effective.is_finite() {
        facts.push((
            "of these, determined by the logs".into(),
            format!(
                "about {:.1}; the CAD determines the others",
                outcome.effective
            ),
        ));
    }
    facts.push(("relative error of the CAD, tau".into(), number(outcome.tau)));
    if outcome.least_retained_fraction < 1.0 {
        facts.push((
            "change from CAD retained, least".into(),
            percent(outcome.least_retained_fraction),
        ));
    }
    let facts: Vec<(&str, String)> = facts
        .iter()
        .map(|(name, value)| (name.as_str(), value.clone()))
        .collect();
    report::facts(&facts)
}

fn found(outcome: &Outcome) -> Option<String> {
    let mut all: Vec<_> = findings(outcome).collect();
    all.sort_by_key(|(_, f)| std::cmp::Reverse(f.severity));
    let item = |(log, f): &(Option<&LogOutcome>, &proprio_identification::Finding)| {
        let place = log
            .map(|l| format!("<small>{}: </small>", escape(&l.file)))
            .unwrap_or_default();
        format!(
            "<li><span class=\"tag {0}\">{0}</span>{place}{1}</li>",
            severity(f.severity),
            escape(&sentence(&f.text))
        )
    };
    let list = |items: Vec<String>| format!("<ul class=\"findings\">{}</ul>", items.concat());
    let (serious, notes): (Vec<_>, Vec<_>) =
        all.iter().partition(|(_, f)| f.severity > Severity::Note);
    let mut body = Vec::new();
    if !serious.is_empty() {
        body.push(list(serious.iter().map(&item).collect()));
    }
    if !notes.is_empty() {
        body.push(report::folded(
            &counted(notes.len(), "note"),
            serious.is_empty() && notes.len() < 6,
            &[list(notes.iter().map(item).collect())],
        ));
    }
    (!body.is_empty()).then(|| report::section("Findings", &body))
}

fn how_to_read() -> String {
    report::section(
        "How to read this page",
        &[report::list([
            "CAD, offsets as configured: the inertial parameters of the URDF with the offsets of \
             estimator.toml, without friction.",
            "CAD, offsets fitted: the same parameters, with offsets (which may drift) and friction \
             fitted to the log. Identified parameters must do better than this.",
            "Identified: parameters fitted to the training logs, with offsets and friction fitted \
             to each log in the same way as for the CAD. (This holds for plots and residuals; the \
             first table under \"The logs\" fits constant offsets only.)",
            "σ: standard deviation of the prediction, from the uncertainty of the parameters and \
             the noise of the measurement. About 95 % of the measurements should lie within ± 2σ.",
            "tau: the relative error of the CAD that fits the logs best; the prior's standard \
             deviation follows it. 0: the CAD is exact; 1: it is a rough guess.",
        ])],
    )
}

#[cfg(test)]
mod tests {
    use super::super::example;
    use super::*;
    use proprio_identification::Curve;
    use std::path::Path;
    use std::process::Command;

    fn made(outcome: &Outcome) -> String {
        page(outcome, &Advice::of(outcome))
    }

    #[test]
    fn every_part_of_an_outcome_is_on_the_page() {
        let html = made(&example::outcome());
        for part in [
            "Identification of icub_legs",
            "Accept with care",
            "2.35 %",
            "6.40 %",
            "undeclared disturbance 1 time",
            "walk_2.csv",
            "onset of motion",
            "Excitation spectrum",
            "First moments",
            "r_lower_leg.I_xx + r_ankle_1.I_yy",
            "contact declared: right_foot",
            "Coulomb [Nm]",
            "r_leg_ft_sensor fx",
            "96.8 %",
            "nothing turned about a horizontal axis",
        ] {
            assert!(html.contains(part), "the page does not say {part:?}");
        }
        assert!(
            !html.contains("NaN") && !html.contains("inf"),
            "a number that is not one"
        );
        assert!(html.len() < 1_000_000, "{} bytes", html.len());
    }

    #[test]
    fn a_report_on_many_joints_stays_small() {
        let mut outcome = example::outcome();
        outcome.logs = vec![
            outcome.logs[0].clone(),
            outcome.logs[1].clone(),
            outcome.logs[0].clone(),
        ];
        for log in &mut outcome.logs {
            log.curves = (0..80)
                .map(|i| Curve {
                    name: format!("joint {i}"),
                    ..log.curves[0].clone()
                })
                .collect();
        }
        let html = made(&outcome);
        assert!(html.len() < 2_000_000, "{} bytes", html.len());
        assert!(html.contains("80 curves of this log are left out"));
    }

    #[test]
    fn nothing_identified_is_told_first() {
        let html = made(&example::nothing());
        let reason = html
            .find("Nothing was identified: no joint moved in any log.")
            .expect("the reason");
        assert!(html.find("<figure>").is_none_or(|figure| reason < figure));
        assert!(html.contains("record the robot moving") && !html.contains("NaN"));
    }

    /// What a real browser finds wrong with pages; nothing if none is at hand.
    fn browse(pages: &[(&str, &str)]) -> Option<String> {
        let folder = tempfile::tempdir().unwrap();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/browser/check.py");
        let mut command = Command::new("python3");
        command.arg(script);
        for (name, html) in pages {
            let file = folder.path().join(format!("{name}.html"));
            std::fs::write(&file, html).unwrap();
            command.arg(file);
        }
        // To look at them oneself.
        if let Some(pictures) = std::env::var_os("PROPRIO_SCREENSHOTS") {
            command.arg("--screenshots").arg(pictures);
        }
        let ran = match command.output() {
            Ok(ran) => ran,
            Err(error) => {
                println!("skipped: python3: {error}");
                return None;
            }
        };
        let said = String::from_utf8_lossy(&ran.stdout) + String::from_utf8_lossy(&ran.stderr);
        match ran.status.code() {
            Some(3) => {
                println!("skipped: {said}");
                None
            }
            Some(code @ (0 | 1)) => {
                assert_eq!(code == 0, said.is_empty(), "{said}");
                Some(said.into_owned())
            }
            code => panic!("{code:?}: {said}"),
        }
    }

    #[test]
    fn a_browser_shows_it_without_fault() {
        let (identified, nothing) = (made(&example::outcome()), made(&example::nothing()));
        if let Some(faults) = browse(&[("identified", &identified), ("nothing", &nothing)]) {
            assert_eq!(faults, "");
        }
    }

    #[test]
    fn a_browser_finds_what_is_wrong() {
        let faulty = report::page(
            "wrong",
            &[
                "<p style=\"width:2000px\">wide</p><p style=\"font-size:6px\">small</p>\
                 <figure></figure><img src=\"http://127.0.0.1:9/x.png\" alt=\"\">\
                 <script>console.error('broken')</script>"
                    .to_owned(),
            ],
        );
        if let Some(faults) = browse(&[("wrong", &faulty)]) {
            for fault in [
                "px wide",
                "smaller than 10 px",
                "without a caption",
                "nothing is drawn",
                "asks for http",
                "broken",
            ] {
                assert!(faults.contains(fault), "{fault} is not found: {faults}");
            }
        }
    }
}
