//! `include/proprio.h` is what cbindgen makes of `src/`.
//! `PROPRIO_WRITE_HEADER=1 cargo test -p proprio-ffi --test header` writes it.
#![allow(missing_docs)]

use std::fs;
use std::path::Path;

#[test]
fn the_header_is_that_of_the_library() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let configuration = cbindgen::Config::from_root_or_default(folder);
    let library = cbindgen::Builder::new()
        .with_config(configuration)
        .with_src(folder.join("src/values.rs"))
        .with_src(folder.join("src/lib.rs"));
    let mut made = Vec::new();
    library.generate().expect("a header").write(&mut made);
    let made = String::from_utf8(made).expect("text");
    // "# Safety" is for those who read the Rust; C's readers find the same in the sentences.
    let made = without_safety(&made);
    let path = folder.join("include/proprio.h");
    if std::env::var_os("PROPRIO_WRITE_HEADER").is_some() {
        fs::write(&path, &made).expect("the header can be written");
    }
    let committed = fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == made,
        "include/proprio.h is old: PROPRIO_WRITE_HEADER=1 cargo test -p proprio-ffi --test header"
    );
}

/// Takes the sections "# Safety" out of the comments.
fn without_safety(header: &str) -> String {
    let mut kept = Vec::new();
    let mut is_safety = false;
    for line in header.lines() {
        is_safety |= line.trim() == "* # Safety";
        if line.trim() == "*/" && is_safety {
            is_safety = false;
            // The empty line before the section.
            kept.pop_if(|last: &mut &str| last.trim() == "*");
        }
        if !is_safety {
            kept.push(line);
        }
    }
    kept.join("\n") + "\n"
}
