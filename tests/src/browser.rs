//! Checks reports in a headless browser with `browser/check.py`.

use std::path::Path;
use std::process::Command;

/// Opens a report in a browser, narrow and wide; does nothing if there is no browser. With
/// PROPRIO_SCREENSHOTS set, screenshots go to that folder.
///
/// # Panics
/// If the check finds a problem, with its description.
pub fn browse(report: &Path) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("browser/check.py");
    let mut command = Command::new("python3");
    command.arg(script).arg(report);
    if let Some(pictures) = std::env::var_os("PROPRIO_SCREENSHOTS") {
        let name = std::thread::current()
            .name()
            .unwrap_or("report")
            .replace("::", "_");
        command
            .arg("--screenshots")
            .arg(Path::new(&pictures).join(name));
    }
    match command.output() {
        Ok(ran) if ran.status.code() == Some(3) => println!("skipped: no browser"),
        Ok(ran) => assert!(
            ran.status.success(),
            "{}{}",
            String::from_utf8_lossy(&ran.stdout),
            String::from_utf8_lossy(&ran.stderr)
        ),
        Err(error) => println!("skipped: python3: {error}"),
    }
}
