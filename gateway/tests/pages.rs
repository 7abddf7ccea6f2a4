//! The page of each driver in the book: its keys load, all of them are there, and it says where it
//! comes from.
#![allow(missing_docs, clippy::unwrap_used, clippy::panic)]

use proprio_drivers::DRIVERS;
use proprio_gateway::plan::Plan;
use std::path::Path;

fn source(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../drivers/src")
        .join(file);
    std::fs::read_to_string(&path).unwrap_or_default()
}

/// The page of a driver.
fn page(driver: &str) -> String {
    source(&format!("../../docs/book/src/devices/{driver}.md"))
}

/// Its block of keys.
fn keys(page: &str) -> &str {
    let (_, keys) = page.split_once("## Keys\n```toml\n").unwrap_or_default();
    keys.split("```").next().unwrap_or_default()
}

/// The file that the page of `dbc` reads.
const DESCRIPTION: &str = "\
BO_ 1 Encoder: 8 X
 SG_ Position : 0|16@1- (0.1,0) [0|0] \"deg\" X
 SG_ Velocity : 16|16@1- (1,0) [0|0] \"deg/s\" X
 SG_ Count : 32|8@1+ (1,0) [0|0] \"\" X
BO_ 2 Motor: 8 X
 SG_ Torque : 0|16@1- (0.1,0) [0|0] \"Nm\" X
BO_ 3 State: 8 X
 SG_ Error : 0|8@1+ (1,0) [0|0] \"\" X
 SG_ Temperature : 8|8@1+ (1,0) [0|0] \"degC\" X
BO_ 4 F: 8 X
 SG_ X : 0|16@1- (0.1,0) [0|0] \"N\" X
 SG_ Y : 16|16@1- (0.1,0) [0|0] \"N\" X
 SG_ Z : 32|16@1- (0.1,0) [0|0] \"N\" X
BO_ 5 T: 8 X
 SG_ X : 0|16@1- (0.1,0) [0|0] \"Nm\" X
 SG_ Y : 16|16@1- (0.1,0) [0|0] \"Nm\" X
 SG_ Z : 32|16@1- (0.1,0) [0|0] \"Nm\" X
";

/// The plan of one device with these keys, with a joint if it needs one.
fn plan(driver: &str, keys: &str, folder: &Path) -> Result<Plan, String> {
    // Tables of arrays belong to the device.
    let keys = keys.replace("[[", "[[bus.device.");
    let device = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
         source = {{ kind = \"virtual\", name = \"b\" }}\n[[bus.device]]\ndriver = {driver:?}\n\
         name = \"d\"\nmax_silence_ms = 2000.0\n"
    );
    let (mut address, mut joint) = ("", "");
    loop {
        let plan = Plan::parse(&format!("{device}{address}{keys}\n{joint}"), folder);
        match &plan {
            Err(problem) if problem.contains("address is missing") => address = "address = 1\n",
            Err(problem) if problem.contains("needs a joint") => {
                joint = "[[bus.device.joint]]\nname = \"j\"\n";
            }
            _ => return plan,
        }
    }
}

#[test]
fn the_keys_of_each_page_load() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("drive.dbc"), DESCRIPTION).unwrap();
    for name in ["drive.eds", "encoder.eds"] {
        let file = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/eds")
            .join(name);
        std::fs::copy(file, folder.path().join(name)).unwrap();
    }
    for driver in DRIVERS {
        let page = page(driver);
        let block = keys(&page);
        assert!(!block.is_empty(), "{driver} has a block of keys");
        assert!(
            page.contains("Sources: ") || page.contains("Source: "),
            "{driver}"
        );
        assert!(
            ["certain", "probable"]
                .iter()
                .any(|word| page.to_lowercase().contains(word)),
            "{driver} says how certain it is"
        );
        plan(driver, block, folder.path()).unwrap_or_else(|problem| panic!("{driver}: {problem}"));
        let planned = plan(driver, &format!("no_such_key = 1\n{block}"), folder.path());
        assert!(planned.unwrap_err().contains("no_such_key"), "{driver}");
    }
}

/// The fields of the structs that are read from the keys, at the place that a driver has for them.
fn fields(driver: &str) -> Vec<String> {
    let module = source(&format!("{driver}.rs"));
    let text = module + &source(&format!("{driver}/options.rs"));
    let mut fields = Vec::new();
    for part in text.split("#[derive(").skip(1) {
        let Some((head, body)) = part.split_once("pub struct ") else {
            continue;
        };
        // Only a struct that follows directly.
        if !head.contains("Deserialize") || head.contains("\npub ") || head.contains("\nimpl ") {
            continue;
        }
        let body = body.split("\n}").next().unwrap_or_default();
        let mut skipped = false;
        for line in body.lines().map(str::trim) {
            if let Some((name, _)) = line.strip_prefix("pub ").and_then(|l| l.split_once(':')) {
                if !skipped {
                    fields.push(name.to_owned());
                }
                skipped = false;
            }
            skipped |= line == "#[serde(skip)]";
        }
    }
    fields
}

#[test]
fn each_key_is_on_its_page() {
    let mut count = 0;
    for driver in DRIVERS {
        let page = page(driver);
        let block = keys(&page);
        for field in fields(driver) {
            let is_there = block.split(|c: char| !(c.is_alphanumeric() || c == '_'));
            assert!(
                is_there.into_iter().any(|word| word == field),
                "{driver}: {field}"
            );
            count += 1;
        }
    }
    assert!(count > 40, "{count}");
}

/// The book lists every driver, and so does the crate's first page.
#[test]
fn the_lists_name_each_driver() {
    let list = source("../../docs/book/src/devices/index.md");
    let library = source("../README.md");
    for driver in DRIVERS {
        assert!(
            list.contains(&format!("[`{driver}`]({driver}.md)")),
            "the book: {driver}"
        );
        assert!(
            library.contains(&format!("[`{driver}`]")),
            "README.md: {driver}"
        );
        let module = source(&format!("{driver}.rs"));
        assert!(
            module.contains(&format!("/devices/{driver}.md\")]")),
            "{driver}.rs: its page"
        );
    }
}
