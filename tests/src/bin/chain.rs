//! The long set of [`proprio_tests::chain`]: a table by fault, and one by device family.
//!
//! ```text
//! chain [FIRST LAST [NAME..]]    seeds, and names of faults or families; default: 1 2, all
//! ```
//!
//! What is broken is printed, with the words that repeat it; so is a single run.

use proprio_tests::chain::{DURATION, FAMILIES, Family, Fault, Shown, run};
use proprio_tests::on_all_processors;
use std::process::ExitCode;

struct Case {
    seed: u64,
    family: Family,
    fault: (&'static str, Fault),
}

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let (first, last, words) = match words[..] {
        [first, last, ref words @ ..] => (first, last, words),
        _ => ("1", "2", &[][..]),
    };
    let seeds = first.parse().expect("a seed")..=last.parse::<u64>().expect("a seed");
    let meant = |name: &str, all: &[&str]| {
        let own: Vec<&&str> = words.iter().filter(|word| all.contains(word)).collect();
        own.is_empty() || own.iter().any(|word| **word == name)
    };
    let names: Vec<&str> = Fault::ALL.iter().map(|(name, _)| *name).collect();
    let families: Vec<&str> = FAMILIES.iter().map(|family| family.name).collect();
    for word in words {
        assert!(
            names.contains(word) || families.contains(word),
            "{word:?}: {names:?}, {families:?}"
        );
    }
    let mut cases = Vec::new();
    for seed in seeds {
        for family in FAMILIES
            .iter()
            .filter(|family| meant(family.name, &families))
        {
            for fault in Fault::ALL.iter().filter(|(name, _)| meant(name, &names)) {
                cases.push(Case {
                    seed,
                    family: *family,
                    fault: *fault,
                });
            }
        }
    }
    let shown = on_all_processors(
        &cases,
        |Case {
             seed,
             family,
             fault,
         }| {
            let one = run(*seed, *family, fault.1)?;
            if one.is_broken() || cases.len() == 1 {
                eprintln!("{seed} {seed} {:?} {:?}: {one:?}", family.name, fault.0);
            }
            Some(one)
        },
    );
    let those = |is: &dyn Fn(&Case) -> bool| -> Vec<&Shown> {
        let own = shown.iter().filter(|(case, _)| is(case));
        own.map(|(_, shown)| shown).collect()
    };
    table("fault", &names, |name| those(&|case| case.fault.0 == name));
    table("family", &families, |name| {
        those(&|case| case.family.name == name)
    });
    let broken = shown.iter().filter(|(_, shown)| shown.is_broken()).count();
    let frames: u64 = shown.iter().map(|(_, shown)| shown.frames).sum();
    println!(
        "\n{} runs, {:.0} robot-seconds, {frames} frames; broken: {broken}",
        shown.len(),
        DURATION * shown.len() as f64
    );
    ExitCode::from(u8::from(broken > 0))
}

/// A line for each name that has runs.
fn table<'a>(title: &str, names: &[&str], of: impl Fn(&str) -> Vec<&'a Shown>) {
    println!(
        "\n| {title} | runs | broken promise | readings off | missing | silent | valid before, \
         during, after | named | worst |\n|---|---|---|---|---|---|---|---|---|"
    );
    for name in names {
        let runs = of(name);
        if runs.is_empty() {
            continue;
        }
        let count = |is: &dyn Fn(&Shown) -> bool| runs.iter().filter(|s| is(s)).count();
        let mean = |of: &dyn Fn(&Shown) -> f64| {
            let all: Vec<f64> = runs
                .iter()
                .map(|s| of(s))
                .filter(|x| x.is_finite())
                .collect();
            all.iter().sum::<f64>() / all.len() as f64
        };
        let worst = runs.iter().filter_map(|s| s.outcome.worst.as_ref());
        let worst = worst.max_by(|a, b| a.share.total_cmp(&b.share));
        let worst = worst.map_or_else(String::new, |worst| {
            format!("{:.2} Nm, {:.0} deviations", worst.error, worst.deviations)
        });
        println!(
            "| {name} | {} | {} | {} | {} | {} | {:.2}, {:.2}, {:.2} | {:.2} | {worst} |",
            runs.len(),
            count(&|s| s.outcome.is_broken()),
            count(&|s| s.is_off()),
            count(&|s| !s.missing.is_empty()),
            count(&|s| !s.silent.is_empty()),
            mean(&|s| s.valid[0]),
            mean(&|s| s.valid[1]),
            mean(&|s| s.valid[2]),
            mean(&|s| s.named[1] as f64 / s.named[0] as f64),
        );
    }
}
