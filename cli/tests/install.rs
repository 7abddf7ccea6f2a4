//! `proprio install` into an image of a system: systemd finds nothing wrong in it, and the lines
//! that it would execute work.
//!
//! That this package has a suite is also why `cargo test --workspace` builds `proprio`, which the
//! suites of other packages start.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const PROGRAM: &str = env!("CARGO_BIN_EXE_proprio");

fn robot() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/icub_left_arm")
}

fn install(arguments: &[&str], root: &Path, config: Option<&Path>) -> Output {
    let mut command = Command::new(PROGRAM);
    command.arg("install").args(arguments);
    command.arg("--root").arg(root);
    if let Some(config) = config {
        command.arg("--config").arg(config);
    }
    command.output().expect("proprio starts")
}

fn good(output: &Output) -> String {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout)
}

fn fails(output: &Output, code: i32, part: &str) {
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{error}");
    assert!(error.contains(part), "{error}");
}

/// The program `name` of systemd, if it is installed.
fn systemd(name: &str) -> Option<Command> {
    let is_there = ["/usr/bin", "/bin"]
        .iter()
        .any(|f| Path::new(f).join(name).is_file());
    is_there.then(|| Command::new(name))
}

#[test]
fn an_installed_system_is_one_that_systemd_starts() {
    if systemd("systemctl").is_none() || systemd("systemd-sysusers").is_none() {
        println!("skipped: systemd is not installed");
        return;
    }
    let image = tempfile::tempdir().expect("a folder");
    let root = image.path();
    fs::create_dir_all(root.join("etc")).expect("a folder");
    let said = good(&install(&[], root, Some(&robot())));

    // What it says it does is what is there, and nothing else of ours.
    for file in said.lines().filter_map(|line| line.strip_prefix("write ")) {
        let file = file.split(" (mode").next().expect("a path");
        assert!(Path::new(file).is_file(), "{file}");
    }
    let program = root.join("usr/local/bin/proprio");
    assert_eq!(
        fs::metadata(&program)
            .expect("the program")
            .permissions()
            .mode()
            & 0o777,
        0o755
    );
    let users = fs::read_to_string(root.join("etc/passwd")).expect("a user was made");
    assert!(
        users.lines().any(|line| line.starts_with("proprio:")),
        "{users}"
    );

    for unit in ["proprio-gateway.service", "proprio-estimator.service"] {
        let wanted = root
            .join("etc/systemd/system/multi-user.target.wants")
            .join(unit);
        assert!(wanted.is_symlink(), "{unit} does not start at boot");
        let text = fs::read_to_string(root.join("etc/systemd/system").join(unit)).expect("a unit");
        let lines = |key: &str| {
            let lines = text.lines().filter_map(|line| line.strip_prefix(key));
            lines.map(str::to_owned).collect::<Vec<_>>()
        };
        // The line as written, but in the image.
        let [start] = &lines("ExecStart=")[..] else {
            panic!("{unit}: not one ExecStart")
        };
        let words: Vec<String> = start
            .split(' ')
            .map(|word| match word.strip_prefix("/etc/") {
                Some(file) => root.join("etc").join(file).display().to_string(),
                None => word.to_owned(),
            })
            .collect();
        assert_eq!(words[0], "proprio");
        let checked = Command::new(&program)
            .args(&words[1..])
            .arg("--check")
            .output();
        good(&checked.expect("it starts"));
        for reload in lines("ExecReload=") {
            let words = reload
                .strip_prefix("proprio ")
                .expect("our program")
                .split(' ');
            good(
                &Command::new(&program)
                    .args(words)
                    .arg("--help")
                    .output()
                    .expect("it starts"),
            );
        }
    }

    // A second time: nothing of the configuration is written again.
    let said = good(&install(&[], root, Some(&robot())));
    assert!(!said.contains("gateway.toml"), "{said}");
    // What was changed on the robot stays, unless it is given up on purpose.
    let changed = root.join("etc/proprio/gateway.toml");
    let text = fs::read_to_string(&changed).expect("it is there") + "# measured\n";
    fs::write(&changed, &text).expect("it is written");
    fails(&install(&[], root, Some(&robot())), 1, "--force");
    good(&install(&[], root, None));
    assert_eq!(fs::read_to_string(&changed).expect("it is there"), text);
    good(&install(&["--force"], root, Some(&robot())));
    assert!(
        !fs::read_to_string(&changed)
            .expect("it is there")
            .ends_with("# measured\n")
    );
}

/// Where a package has put the program, units and user are the package's: copies in /etc and
/// /usr/local would hide its upgrades.
#[test]
fn what_a_package_has_installed_is_not_copied() {
    if systemd("systemctl").is_none() {
        println!("skipped: systemd is not installed");
        return;
    }
    let image = tempfile::tempdir().expect("a folder");
    let root = image.path();
    let units = root.join("usr/lib/systemd/system");
    for folder in [&root.join("etc"), &units] {
        fs::create_dir_all(folder).expect("a folder");
    }
    let given = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/systemd");
    for unit in ["proprio-gateway.service", "proprio-estimator.service"] {
        fs::copy(given.join(unit), units.join(unit)).expect("a copy");
    }
    let copy = root.join("usr/local/bin/proprio");
    fs::create_dir_all(root.join("usr/local/bin")).expect("a folder");
    fs::write(&copy, "an older program").expect("a file");
    let refused = install(&[], root, Some(&robot()));
    fails(&refused, 1, "instead of the package's");
    assert!(!root.join("etc/proprio").exists());
    fs::remove_dir_all(root.join("usr/local")).expect("a folder");

    good(&install(&[], root, Some(&robot())));
    assert!(root.join("etc/proprio/gateway.toml").is_file());
    assert!(!root.join("usr/local").exists() && !root.join("etc/sysusers.d").exists());
    let made = root.join("etc/systemd/system");
    let wanted = made.join("multi-user.target.wants");
    assert!(wanted.join("proprio-gateway.service").is_symlink());
    assert_eq!(fs::read_dir(made).expect("a folder").count(), 1);
}

#[test]
fn systemd_finds_nothing_wrong_in_the_units() {
    let Some(mut verify) = systemd("systemd-analyze") else {
        println!("skipped: systemd is not installed");
        return;
    };
    let image = tempfile::tempdir().expect("a folder");
    let bin = image.path().join("bin");
    fs::create_dir(&bin).expect("a folder");
    let units = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/systemd");
    let mut files = Vec::new();
    for unit in ["proprio-gateway.service", "proprio-estimator.service"] {
        // The place of the program is the machine's.
        let text = fs::read_to_string(units.join(unit)).expect("a unit");
        let text = text.replace("=proprio ", &format!("={PROGRAM} "));
        let file = image.path().join(unit);
        fs::write(&file, text).expect("it is written");
        files.push(file);
    }
    let said = verify
        .arg("verify")
        .arg("--man=no")
        .args(&files)
        .output()
        .expect("it starts");
    let error = String::from_utf8_lossy(&said.stderr);
    let ours = error.lines().filter(|line| {
        line.contains("proprio")
            && !line.contains("RestartSteps")
            && !line.contains("RestartMaxDelaySec")
    });
    assert_eq!(ours.collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn nothing_is_done_by_a_dry_run_or_with_a_configuration_that_is_wrong() {
    let image = tempfile::tempdir().expect("a folder");
    let root = image.path();
    let said = good(&install(&["--dry-run"], root, Some(&robot())));
    assert!(
        said.contains("etc/systemd/system/proprio-gateway.service"),
        "{said}"
    );
    let empty = tempfile::tempdir().expect("a folder");
    fails(
        &install(&[], root, Some(empty.path())),
        1,
        "has neither gateway.toml nor",
    );
    fs::write(
        empty.path().join("gateway.toml"),
        "schema = 1\nrobots = \"x\"\n",
    )
    .expect("a file");
    fails(&install(&[], root, Some(empty.path())), 2, "robots");
    // A file that would not be there after the copy.
    let folder = empty.path().join("robot");
    fs::create_dir(&folder).expect("a folder");
    for file in ["gateway.toml", "estimator.toml", "model.urdf"] {
        fs::copy(robot().join(file), folder.join(file)).expect("a copy");
    }
    good(&install(&["--dry-run"], root, Some(&folder)));
    fs::rename(folder.join("model.urdf"), empty.path().join("model.urdf")).expect("it moves");
    let config = fs::read_to_string(folder.join("estimator.toml")).expect("it is there");
    let config = config.replace("\"model.urdf\"", "\"../model.urdf\"");
    fs::write(folder.join("estimator.toml"), config).expect("it is written");
    fails(&install(&[], root, Some(&folder)), 1, "lies outside");
    assert_eq!(fs::read_dir(root).expect("a folder").count(), 0);
}
