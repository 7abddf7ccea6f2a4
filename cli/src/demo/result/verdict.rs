//! Whether the demonstration worked: one sentence with its figures.

use super::compared::percent;

/// The share of errors within two standard deviations below which the deviations are said to be too
/// small. Of correct ones 95.4 % are expected; 90 % is what a fifth too small gives.
const COVERED: f64 = 0.9;

/// The headline of a demonstration that shows nothing.
const FAILED: &str = "It did not work";

/// The verdict of a demonstration.
pub(super) struct DemoVerdict {
    /// True: the identified parameters are better than the CAD's, and the stated deviations hold.
    /// `None`: it cannot be told.
    pub(super) worked: Option<bool>,
    pub(super) headline: &'static str,
    /// What the headline rests on: it continues the sentence.
    pub(super) figures: String,
}

/// What the verdict rests on.
pub(super) struct Findings<'a> {
    /// From when on the torques were judged, in words.
    pub(super) since: &'a str,
    /// Duration of the motion \[s\].
    pub(super) moved: f64,
    /// Whether it lasted long enough to judge the identification.
    pub(super) has_settled: bool,
    /// Why nothing can be identified.
    pub(super) refused: Option<&'a str>,
    pub(super) solutions: usize,
    pub(super) cad_error: f64,
    /// The joints that are compared: all, or those beyond the F/T sensors, and RMS errors of their
    /// torques with the CAD's and with identified parameters \[Nm\].
    pub(super) joints: usize,
    pub(super) sensors: usize,
    pub(super) is_beyond: bool,
    pub(super) cad: f64,
    pub(super) identified: f64,
    /// Number and fraction of the valid torques, and the share of these within two deviations.
    pub(super) valid: usize,
    pub(super) valid_share: f64,
    pub(super) within_2_sigma: f64,
    /// Frames lost, and readings that the simulator was too slow for.
    pub(super) lost: u64,
    pub(super) skipped: u64,
}

impl Findings<'_> {
    /// The joints that are compared, in words.
    fn place(&self) -> String {
        let beyond = match (self.is_beyond, self.sensors) {
            (true, 1) => " beyond the F/T sensor",
            (true, _) => " beyond the F/T sensors",
            (false, _) => "",
        };
        match self.joints {
            1 => format!("the joint{beyond}"),
            count => format!("the {count} joints{beyond}"),
        }
    }

    /// How many torques were valid, and how many of these within their deviations.
    fn validity(&self) -> String {
        let mut validity = format!("{} of all torques were valid", percent(self.valid_share));
        if self.valid > 0 {
            let within = percent(self.within_2_sigma);
            validity += &format!(", {within} of these within two standard deviations of the truth");
        }
        validity
    }
}

impl DemoVerdict {
    pub(super) fn of(findings: &Findings<'_>) -> Self {
        let Findings {
            since,
            moved,
            cad,
            identified,
            within_2_sigma,
            ..
        } = findings;
        let validity = findings.validity();
        let errors = format!(
            "at {} the RMS error of the torques is {identified:.3} Nm with the identified \
             parameters and {cad:.3} Nm with the CAD's, {since}",
            findings.place()
        );
        let is_better = findings.cad_error == 0.0 || identified < cad;
        let (worked, headline, mut figures) = if findings.valid == 0 && findings.has_settled {
            (
                Some(false),
                FAILED,
                format!("all torques were withheld {since}"),
            )
        } else if let Some(why) = findings.refused {
            let why = why.trim_end_matches('.');
            (
                None,
                "Nothing was identified",
                format!("{why}; {validity}, {since}"),
            )
        } else if !findings.has_settled {
            let short = format!(
                "identification is judged from 10 s of motion on, and the robot moved for \
                 {moved:.1} s (--seconds 40 is enough); {validity}, {since}"
            );
            (None, "Too short to tell", short)
        } else if findings.solutions == 0 {
            let nothing = format!("nothing was identified in {moved:.1} s of motion; {validity}");
            (Some(false), FAILED, nothing)
        } else if !is_better {
            (Some(false), FAILED, format!("{errors}; {validity}"))
        } else if *within_2_sigma < COVERED {
            let only = format!("{errors}, but the stated deviations are too small: {validity}");
            (
                Some(false),
                "It worked in part",
                format!("{only} (95 % are expected)"),
            )
        } else {
            (Some(true), "It worked", format!("{errors}; {validity}"))
        };
        figures.push('.');
        let busy = [
            (findings.lost, "frames were lost"),
            (findings.skipped, "readings were not simulated in time"),
        ];
        let busy = busy.into_iter().filter(|(count, _)| *count > 0);
        let busy: Vec<String> = busy
            .map(|(count, what)| format!("{count} {what}"))
            .collect();
        if !busy.is_empty() {
            let busy = busy.join(" and ");
            figures.push_str(&format!(" This machine was busy: {busy}."));
        }
        Self {
            worked,
            headline,
            figures,
        }
    }

    /// The whole sentence.
    pub(super) fn sentence(&self) -> String {
        format!("{}: {}", self.headline, self.figures)
    }

    /// Its class in the report's style sheet.
    pub(super) fn class(&self) -> &'static str {
        match self.worked {
            Some(true) => "good",
            Some(false) => "bad",
            None => "care",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Findings<'_> = Findings {
        since: "from 10 s of motion on",
        moved: 30.0,
        has_settled: true,
        refused: None,
        solutions: 29,
        cad_error: 0.2,
        joints: 4,
        sensors: 1,
        is_beyond: true,
        cad: 0.07,
        identified: 0.03,
        valid: 100,
        valid_share: 0.999,
        within_2_sigma: 0.98,
        lost: 0,
        skipped: 0,
    };

    #[test]
    fn a_verdict_says_what_it_rests_on() {
        assert_eq!(
            DemoVerdict::of(&GOOD).sentence(),
            "It worked: at the 4 joints beyond the F/T sensor the RMS error of the torques is \
             0.030 Nm with the identified parameters and 0.070 Nm with the CAD's, from 10 s of \
             motion on; 99.9 % of all torques were valid, 98.0 % of these within two \
             standard deviations of the truth."
        );
        for (findings, worked, words) in [
            (
                Findings { valid: 0, ..GOOD },
                Some(false),
                "all torques were withheld",
            ),
            (
                Findings {
                    refused: Some("why."),
                    ..GOOD
                },
                None,
                "identified: why; 99.9 %",
            ),
            (
                Findings {
                    has_settled: false,
                    moved: 2.2,
                    ..GOOD
                },
                None,
                "the robot moved for 2.2 s",
            ),
            (
                Findings {
                    solutions: 0,
                    ..GOOD
                },
                Some(false),
                "in 30.0 s of motion",
            ),
            (
                Findings {
                    identified: 0.08,
                    ..GOOD
                },
                Some(false),
                "It did not work: at the",
            ),
            // An exact CAD cannot be surpassed.
            (
                Findings {
                    identified: 0.08,
                    cad_error: 0.0,
                    ..GOOD
                },
                Some(true),
                "It worked: ",
            ),
            (
                Findings {
                    within_2_sigma: 0.89,
                    ..GOOD
                },
                Some(false),
                "It worked in part",
            ),
            (
                Findings {
                    is_beyond: false,
                    joints: 1,
                    ..GOOD
                },
                Some(true),
                "at the joint the",
            ),
            (
                Findings {
                    lost: 3,
                    skipped: 5,
                    ..GOOD
                },
                Some(true),
                " This machine was busy: 3 frames were lost and 5 readings were not simulated in \
                 time.",
            ),
        ] {
            let verdict = DemoVerdict::of(&findings);
            let sentence = verdict.sentence();
            assert_eq!(verdict.worked, worked, "{sentence}");
            assert!(sentence.contains(words), "{sentence}");
        }
    }
}
