//! Puts the pages of the book into the program, for `proprio help`.
#![allow(clippy::print_stdout)] // cargo reads it

use std::fmt::Write as _;
use std::path::Path;
use std::{env, fs};

fn main() {
    let book = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/book/src");
    println!("cargo::rerun-if-changed={}", book.display());
    let summary = fs::read_to_string(book.join("SUMMARY.md")).expect("the list of pages");
    let mut pages = String::from("&[\n");
    // `- [Title](folder/page.md)`
    for line in summary.lines() {
        let Some((title, rest)) = line.split_once("](") else {
            continue;
        };
        let title = title.trim_start_matches([' ', '-', '[']);
        let path = rest.trim_end_matches(')');
        let file = book.join(path);
        let _ = writeln!(pages, "({title:?}, {path:?}, include_str!({file:?})),");
    }
    let out = env::var_os("OUT_DIR").expect("cargo names a folder");
    fs::write(Path::new(&out).join("pages.rs"), pages + "]\n").expect("the list can be written");
}
