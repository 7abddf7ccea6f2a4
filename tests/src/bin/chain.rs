//! The long set of [`proprio_tests::chain`]: a table by fault, and one by device family.
//!
//! ```text
//! chain [FIRST LAST [NAME..]]    seeds, and names of faults or families; default: 1 2, all
//! chain soak SECONDS FAMILY..    one long run for each family, with all faults in turn
//! ```
//!
//! What is broken is printed, with the words that repeat it; so is a single run. The last line has
//! the memory and the descriptors that this process had after a tenth of the runs, and at its end:
//! each run opens and closes gateway, ports and estimator.

use proprio_tests::chain::{DURATION, FAMILIES, Family, Fault, Shown, run, soak};
use proprio_tests::{now, on_all_processors};
use std::process::ExitCode;
use std::sync::OnceLock;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;

struct Case {
    seed: u64,
    family: Family,
    fault: (&'static str, Fault),
}

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    if let ["soak", seconds, ref families @ ..] = words[..] {
        return soak_all(seconds.parse().expect("seconds"), families);
    }
    let (first, last, words) = match words[..] {
        [first, last, ref words @ ..] => (first, last, words),
        _ => ("1", "2", &[][..]),
    };
    let seeds = first.parse().expect("a seed")..=last.parse::<u64>().expect("a seed");
    let meant = |name: &str, all: &[&str]| {
        let named: Vec<&&str> = words.iter().filter(|word| all.contains(word)).collect();
        named.is_empty() || named.iter().any(|word| **word == name)
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
    let early = OnceLock::new();
    let done = AtomicUsize::new(0);
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
            if done.fetch_add(1, Relaxed) >= cases.len() / 10 {
                early.get_or_init(held);
            }
            Some(one)
        },
    );
    let those = |is: &dyn Fn(&Case) -> bool| -> Vec<&Shown> {
        let lines = shown.iter().filter(|(case, _)| is(case));
        lines.map(|(_, shown)| shown).collect()
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
    let [(memory, descriptors), (later, more)] = [early.into_inner().unwrap_or_default(), held()];
    println!("memory {memory} and {later} kB, descriptors {descriptors} and {more}");
    ExitCode::from(u8::from(broken > 0))
}

/// One long run for each of these families. Memory and descriptors are those of all together.
fn soak_all(seconds: f64, names: &[&str]) -> ExitCode {
    let find = |name: &&str| FAMILIES.iter().find(|family| family.name == *name);
    let families: Vec<(u64, Family)> = (1..)
        .zip(names.iter().map(|name| *find(name).expect("a family")))
        .collect();
    let shown = on_all_processors(&families, |(seed, family)| {
        let (begin, mut tenth) = (now(), 1.0);
        soak(*seed, *family, seconds, &mut |t| {
            if t >= 0.1 * tenth * seconds {
                tenth += 1.0;
                let (memory, descriptors) = held();
                println!(
                    "{}: {t:.0} s after {:.0} s, memory {memory} kB, descriptors {descriptors}",
                    family.name,
                    (now() - begin).seconds()
                );
            }
        })
    });
    let mut frames = 0;
    for ((seed, family), shown) in &shown {
        frames += shown.frames;
        println!("{} {seed}: {shown:?}", family.name);
    }
    let is_bad = |shown: &Shown| !shown.missing.is_empty() || !shown.silent.is_empty();
    let bad = shown.iter().any(|(_, shown)| is_bad(shown));
    println!("{frames} frames in {seconds} s of each robot");
    ExitCode::from(u8::from(bad))
}

/// The memory that this process holds \[kB\], and its descriptors.
fn held() -> (u64, usize) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let memory = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
    let descriptors = std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
    (memory.unwrap_or(0), descriptors)
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
