//! `proprio install`: puts this program, its systemd units and a robot's configuration where they
//! belong, and starts the services. `--dry-run` prints the steps instead. What a Debian package has
//! installed stays the package's: then only the configuration is copied.

use crate::folder::{each_file, read};
use anyhow::{Context as _, bail};
use proprio_estimator::files;
use proprio_estimator::setup::Setup;
use proprio_gateway::plan::Plan;
use std::collections::BTreeSet;
use std::fmt;
use std::fs;
use std::path::{Component, Path, PathBuf};
use std::process::Command;

/// systemd finds programs without a path here and in /usr/bin.
const PROGRAM: &str = "usr/local/bin/proprio";
/// Units here hide those of the Debian package.
const UNITS: &str = "etc/systemd/system";
/// Where the Debian package puts its units.
const PACKAGED: &str = "usr/lib/systemd/system";
const CONFIG: &str = "etc/proprio";
const USER: (&str, &str) = (
    "etc/sysusers.d/proprio.conf",
    include_str!("../../config/systemd/proprio.sysusers"),
);

/// A daemon: its unit, and the file without which it can not run.
struct Service {
    unit: &'static str,
    text: &'static str,
    config: &'static str,
}

const SERVICES: [Service; 2] = [
    Service {
        unit: "proprio-gateway.service",
        text: include_str!("../../config/systemd/proprio-gateway.service"),
        config: "gateway.toml",
    },
    Service {
        unit: "proprio-estimator.service",
        text: include_str!("../../config/systemd/proprio-estimator.service"),
        config: "estimator.toml",
    },
];

/// `proprio install`.
#[derive(clap::Args)]
pub(crate) struct InstallArgs {
    /// The robot's folder: gateway.toml, estimator.toml or both, and the files that they name;
    /// default: what /etc/proprio holds already
    #[arg(long, value_name = "DIR")]
    config: Option<PathBuf>,
    /// Print the steps and change nothing
    #[arg(long)]
    dry_run: bool,
    /// Install into the image of a system below this folder; start nothing
    #[arg(long, value_name = "DIR", default_value = "/")]
    root: PathBuf,
    /// Overwrite files of /etc/proprio that differ
    #[arg(long)]
    force: bool,
}

/// What is done to the system; its text is what `--dry-run` prints.
enum InstallStep {
    /// Writes `bytes` to `to`, in one step.
    Write {
        to: PathBuf,
        bytes: Vec<u8>,
        mode: u32,
    },
    Run(Vec<String>),
}

impl fmt::Display for InstallStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Write { to, mode, .. } => write!(f, "write {} (mode {mode:o})", to.display()),
            Self::Run(words) => write!(f, "run   {}", words.join(" ")),
        }
    }
}

impl InstallStep {
    fn run(&self) -> anyhow::Result<()> {
        match self {
            Self::Write { to, bytes, mode } => {
                let write = || -> std::io::Result<()> {
                    if let Some(folder) = to.parent() {
                        fs::create_dir_all(folder)?;
                    }
                    // By renaming, because a program that runs can not be written to.
                    let mut new = files::begin(to)?;
                    std::io::Write::write_all(&mut new, bytes)?;
                    files::end(new, to, *mode)
                };
                write().with_context(|| format!("cannot write {}", to.display()))
            }
            Self::Run(words) => {
                let status = Command::new(&words[0]).args(&words[1..]).status();
                let status = status.with_context(|| format!("cannot start {}", words[0]))?;
                if !status.success() {
                    bail!("`{}` failed ({status})", words.join(" "));
                }
                Ok(())
            }
        }
    }
}

/// Installs.
pub(crate) fn run(args: &InstallArgs) -> anyhow::Result<()> {
    let is_image = args.root != Path::new("/");
    if !(args.dry_run || is_image || nix::unistd::geteuid().is_root()) {
        bail!("only root can install: sudo proprio install ... (--dry-run prints the steps)");
    }
    let etc = args.root.join(CONFIG);
    let from = args.config.as_deref().unwrap_or(&etc);
    let services: Vec<&Service> = SERVICES
        .iter()
        .filter(|service| from.join(service.config).is_file())
        .collect();
    if services.is_empty() {
        bail!(
            "{} has neither gateway.toml nor estimator.toml: --config DIR names a folder that has \
             (`proprio setup --out DIR` writes a gateway.toml)",
            from.display()
        );
    }
    check(from)?;

    let mut steps = Vec::new();
    let is_packaged = SERVICES
        .iter()
        .any(|service| args.root.join(PACKAGED).join(service.unit).exists());
    let in_image = |name: &str| {
        let root = is_image.then(|| format!("--root={}", args.root.display()));
        [name.to_owned()].into_iter().chain(root)
    };
    let units = || services.iter().map(|service| service.unit.to_owned());
    let words = |text: &'static str| text.split(' ').map(str::to_owned);
    if is_packaged {
        refuse_copies(&args.root)?;
    } else {
        let this_program =
            std::env::current_exe().context("cannot find this program's own file")?;
        let program = args.root.join(PROGRAM);
        if this_program != program {
            let bytes = fs::read(&this_program)
                .with_context(|| format!("cannot read {}", this_program.display()))?;
            steps.push(write(program, bytes, 0o755));
        }
        steps.push(write(args.root.join(USER.0), USER.1.into(), 0o644));
        for service in &services {
            let to = args.root.join(UNITS).join(service.unit);
            steps.push(write(to, service.text.into(), 0o644));
        }
        steps.push(InstallStep::Run(in_image("systemd-sysusers").collect()));
    }
    if let Some(folder) = &args.config {
        steps.extend(configuration(folder, &etc, args.force)?);
    }
    let enable = in_image("systemctl").chain(words("enable"));
    steps.push(InstallStep::Run(enable.chain(units()).collect()));
    if !is_image {
        steps.push(InstallStep::Run(words("systemctl daemon-reload").collect()));
        let restart = words("systemctl restart").chain(units());
        steps.push(InstallStep::Run(restart.collect()));
    }

    for step in &steps {
        print_line!("{step}");
        if !args.dry_run {
            step.run()?;
        }
    }
    Ok(())
}

/// Of an installation without a package, systemd would start the program and the units, and not
/// what the package upgrades.
fn refuse_copies(root: &Path) -> anyhow::Result<()> {
    let etc = |service: Service| Path::new(UNITS).join(service.unit);
    let copies: Vec<String> = [PathBuf::from(PROGRAM)]
        .into_iter()
        .chain(SERVICES.map(etc))
        .map(|copy| root.join(copy))
        .filter(|copy| copy.is_file())
        .map(|copy| copy.display().to_string())
        .collect();
    if !copies.is_empty() {
        bail!(
            "{} would be used instead of the package's: remove them (`sudo rm {}`)",
            copies.join(", "),
            copies.join(" ")
        );
    }
    Ok(())
}

fn write(to: PathBuf, bytes: Vec<u8>, mode: u32) -> InstallStep {
    InstallStep::Write { to, bytes, mode }
}

/// Reads the configuration in `folder` as the daemons do.
fn check(folder: &Path) -> anyhow::Result<()> {
    let [gateway, estimator] = SERVICES.map(|service| folder.join(service.config));
    if gateway.is_file() {
        Plan::load_live(&gateway)?;
    }
    if estimator.is_file() {
        Setup::load(&estimator, |_| {})?;
    }
    Ok(())
}

/// The copies of the configuration in `folder` into `etc`, with the files that it names. A file
/// that is there and differs is an error, unless by `force`: it may hold what was measured on the
/// robot.
fn configuration(folder: &Path, etc: &Path, force: bool) -> anyhow::Result<Vec<InstallStep>> {
    let mut names = BTreeSet::new();
    for config in SERVICES.map(|service| service.config) {
        let file = folder.join(config);
        if !file.is_file() {
            continue;
        }
        names.insert(PathBuf::from(config));
        each_file(&mut read(&file)?, folder, &mut |name| {
            let parts = Path::new(&*name).components();
            if Path::new(&*name).is_relative() {
                // `./x` is `x`.
                names.insert(parts.filter(|part| *part != Component::CurDir).collect());
            }
            Ok(())
        })?;
    }
    let (mut steps, mut differ) = (Vec::new(), Vec::new());
    for name in names {
        let from = folder.join(&name);
        if !name
            .components()
            .all(|part| matches!(part, Component::Normal(_)))
        {
            bail!(
                "{} lies outside {}: put it into this folder, or name it by its full path",
                from.display(),
                folder.display()
            );
        }
        let bytes = fs::read(&from).with_context(|| format!("cannot read {}", from.display()))?;
        let to = etc.join(&name);
        match fs::read(&to) {
            Ok(there) if there == bytes => continue,
            Ok(_) if !force => differ.push(to.display().to_string()),
            _ => {}
        }
        steps.push(write(to, bytes, 0o644));
    }
    if !differ.is_empty() {
        bail!(
            "{} would be overwritten by other content: nothing was installed; --force overwrites, \
             and without --config the configuration stays as it is",
            differ.join(", ")
        );
    }
    Ok(steps)
}
