//! `proprio view`, `proprio ros2`: programs of their own, with libraries that nothing else here
//! needs. They are run in the place of this one.

use anyhow::bail;
use proprio_topics::ipc::DomainConfig;
use std::ffi::OsString;
use std::io::ErrorKind;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// What is passed on.
#[derive(clap::Args)]
#[command(disable_help_flag = true)]
pub(crate) struct ProgramArgs {
    /// Its own arguments; `--help` lists them
    #[arg(
        trailing_var_arg = true,
        allow_hyphen_values = true,
        value_name = "ARGUMENTS"
    )]
    arguments: Vec<OsString>,
}

/// Becomes `proprio-<name>`: the program beside this one, or else one in the PATH.
pub(crate) fn run(name: &str, args: &ProgramArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let program = format!("proprio-{name}");
    let beside = std::env::current_exe().ok();
    let beside = beside.and_then(|own| Some(own.parent()?.join(&program)));
    let place = beside.filter(|path| path.is_file());
    let place = place.map_or(OsString::from(&program), OsString::from);
    let error = Command::new(&place)
        .args(&args.arguments)
        .env("PROPRIO_DOMAIN", &domain.name)
        .exec();
    match error.kind() {
        ErrorKind::NotFound => bail!(
            "{program} is not installed. It is a program of its own: in a clone, `cargo install \
             --path bridge/{name}` builds it; it belongs beside this one or into a folder of the \
             PATH"
        ),
        _ => bail!("{}: cannot be run: {error}", place.display()),
    }
}
