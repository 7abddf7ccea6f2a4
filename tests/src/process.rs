//! Programs under test: found next to the test executable, run in a separate domain, and ended with
//! the test.

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_topics::Nanos;
use proprio_topics::ipc::{Domain, DomainConfig, monotonic};
use std::cell::{Cell, OnceCell};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

/// Time-out for any event; not reached if all is well.
pub const PATIENCE: Nanos = Nanos::from_millis(120_000);

/// The clock of all stamps.
#[must_use]
pub fn now() -> Nanos {
    monotonic()
}

/// Whether this is user-mode Linux, where system calls take ten times as long or more:
/// `tests/vcan/README.md`.
#[must_use]
pub fn uml() -> bool {
    static UML: OnceLock<bool> = OnceLock::new();
    *UML.get_or_init(|| {
        fs::read_to_string("/proc/cpuinfo").is_ok_and(|text| text.contains("User Mode Linux"))
    })
}

/// Waits at most `limit` until `ask` returns a value; `None` after that.
pub fn until<R>(limit: Nanos, mut ask: impl FnMut() -> Option<R>) -> Option<R> {
    let end = now() + limit;
    loop {
        if let Some(found) = ask() {
            return Some(found);
        }
        if now() > end {
            return None;
        }
        std::thread::sleep(Duration::from_millis(if uml() { 5 } else { 1 }));
    }
}

/// A folder and a shared-memory domain for one test.
pub struct Rig {
    folder: tempfile::TempDir,
    // In memory, as on a robot: on a disk, a start waits while others write.
    _shared: tempfile::TempDir,
    /// The domain of all processes started here.
    pub domain: DomainConfig,
    prefix: OnceCell<String>,
    starts: Cell<u32>,
}

impl Default for Rig {
    fn default() -> Self {
        Self::new()
    }
}

impl Rig {
    /// A new rig; its files are removed when it is dropped.
    ///
    /// # Panics
    /// If no temporary folder can be created.
    #[must_use]
    pub fn new() -> Self {
        let folder = tempfile::Builder::new()
            .prefix("proprio-")
            .tempdir()
            .expect("a temporary folder");
        let shared = tempfile::Builder::new()
            .prefix("proprio-test-")
            .tempdir_in("/dev/shm")
            .expect("a folder in shared memory");
        // Virtual buses belong to a domain by its name alone: those of tests that run at the same
        // time must not meet.
        let unique = shared.path().file_name().expect("its own name");
        let domain = DomainConfig::new(shared.path(), &unique.to_string_lossy());
        Self {
            folder,
            _shared: shared,
            domain,
            prefix: OnceCell::new(),
            starts: Cell::new(0),
        }
    }

    /// A path in the folder.
    #[must_use]
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The domain, opened by this process.
    ///
    /// # Panics
    /// If it cannot be opened.
    #[must_use]
    pub fn open(&self) -> Domain {
        let domain = Domain::open(&self.domain).expect("the test's domain");
        // The prefix of its segments is known from now on.
        let _ = self.segments();
        domain
    }

    /// The built `proprio`.
    ///
    /// # Panics
    /// If it has not been built.
    #[must_use]
    pub fn program() -> PathBuf {
        // <target>/<profile>/deps/<suite>-<hash>
        let suite = std::env::current_exe().expect("this program's own path");
        let program = suite
            .ancestors()
            .nth(2)
            .map(|folder| folder.join("proprio"))
            .expect("a target folder");
        assert!(
            program.is_file(),
            "{} is missing: cargo build --workspace --bins",
            program.display()
        );
        program
    }

    /// `proprio` with `arguments`, in this domain.
    #[must_use]
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(Self::program());
        command
            .args(arguments)
            .env("PROPRIO_DOMAIN", &self.domain.name)
            .env("PROPRIO_RUNTIME_DIR", &self.domain.base)
            .env_remove("RUST_LOG")
            .stdin(Stdio::null());
        command
    }

    /// Starts `proprio` with `arguments`.
    ///
    /// # Panics
    /// If it cannot be started.
    #[must_use]
    pub fn start(&self, arguments: &[&str]) -> Process {
        self.spawn(
            self.command(arguments),
            arguments.first().copied().unwrap_or("proprio"),
        )
    }

    /// Starts any program; its output goes to files in the folder.
    ///
    /// # Panics
    /// If it cannot be started.
    #[must_use]
    pub fn spawn(&self, mut command: Command, name: &str) -> Process {
        self.starts.set(self.starts.get() + 1);
        let output = self.path(&format!("{name}-{}.out", self.starts.get()));
        let log = self.path(&format!("{name}-{}.log", self.starts.get()));
        let file = |path: &Path| File::create(path).expect("a file in a temporary folder");
        command
            .stdin(Stdio::null())
            .stdout(file(&output))
            .stderr(file(&log));
        let child = command
            .spawn()
            .unwrap_or_else(|error| panic!("{name} cannot be started: {error}"));
        Process {
            name: name.to_owned(),
            child,
            output,
            log,
        }
    }

    /// Runs `proprio` with `arguments` until it ends; it must succeed.
    ///
    /// # Panics
    /// If it fails.
    pub fn run(&self, arguments: &[&str]) -> Output {
        let output = self
            .command(arguments)
            .output()
            .expect("proprio can be started");
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.success(),
            "proprio {}: {}: {text}",
            arguments.join(" "),
            output.status
        );
        output
    }

    /// The domain's segments in shared memory, sorted. A process must be in the domain, or must
    /// have been at an earlier call.
    ///
    /// # Panics
    /// If no process has been in the domain yet.
    #[must_use]
    pub fn segments(&self) -> Vec<String> {
        let prefix = self.prefix.get_or_init(|| {
            let nodes = self.domain.base.join(&self.domain.name).join("nodes");
            let prefix = names(&nodes).iter().find_map(|name| {
                let (prefix, _) = name.strip_suffix(".node_monitor")?.rsplit_once('_')?;
                Some(format!("{prefix}_"))
            });
            prefix.expect("a process is in the domain")
        });
        names(Path::new("/dev/shm"))
            .into_iter()
            .filter(|name| name.starts_with(prefix))
            .collect()
    }

    /// The domain's segments as soon as they stay the same for half a second: until then processes
    /// still open each other's services.
    ///
    /// # Panics
    /// If they do not settle within [`PATIENCE`].
    #[must_use]
    pub fn settled_segments(&self) -> Vec<String> {
        let (mut segments, mut since) = (Vec::new(), now());
        until(PATIENCE, || {
            let before = std::mem::replace(&mut segments, self.segments());
            if before != segments {
                since = now();
            }
            (now() - since > Nanos::from_millis(500)).then(|| segments.clone())
        })
        .expect("the segments settle")
    }

    /// The remaining files and shared-memory segments of the domain.
    #[must_use]
    pub fn leftovers(&self) -> Vec<String> {
        let mut left = self.segments();
        left.extend(names(&self.domain.base));
        left
    }

    /// Asserts that nothing is left of the domain. All processes must have left it, including this
    /// one.
    ///
    /// # Panics
    /// If something is left.
    pub fn assert_nothing_left(&self) {
        let left = self.leftovers();
        assert!(left.is_empty(), "left over: {left:?}");
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        // A failed test kills its processes; their segments would stay in shared memory.
        let _ = Domain::remove_if_unused(&self.domain);
    }
}

/// The names in a folder, sorted; none if it does not exist.
fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// A process under test. It is killed on drop if it still runs.
pub struct Process {
    name: String,
    child: Child,
    output: PathBuf,
    log: PathBuf,
}

impl Process {
    /// Its process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Its exit status, if it has ended.
    ///
    /// # Panics
    /// If the system returns an error.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child
            .try_wait()
            .expect("the status of a child process is available")
    }

    /// Asserts that it runs.
    ///
    /// # Panics
    /// If it has ended.
    pub fn assert_runs(&mut self) {
        if let Some(status) = self.ended() {
            panic!("{} has ended: {status}\n{}", self.name, self.log());
        }
    }

    /// Kills it with SIGKILL.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Sends SIGTERM and waits; it must end with success.
    ///
    /// # Panics
    /// If it does not end with success.
    pub fn end(&mut self) {
        if self.ended().is_none() {
            let id = Pid::from_raw(i32::try_from(self.child.id()).expect("a process number"));
            let _ = kill(id, Signal::SIGTERM);
        }
        self.wait();
    }

    /// Waits for its end; it must end with success.
    ///
    /// # Panics
    /// If it does not end with success within [`PATIENCE`].
    pub fn wait(&mut self) {
        let status = until(PATIENCE, || self.ended());
        let status = status.unwrap_or_else(|| panic!("{} does not end\n{}", self.name, self.log()));
        assert!(
            status.success(),
            "{} ended with {status}\n{}",
            self.name,
            self.log()
        );
    }

    /// Its standard output so far.
    #[must_use]
    pub fn output(&self) -> String {
        fs::read_to_string(&self.output).unwrap_or_default()
    }

    /// Its standard error so far.
    #[must_use]
    pub fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap_or_default()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
        if std::thread::panicking() {
            eprintln!("--- {}:\n{}", self.name, self.log());
        }
    }
}
