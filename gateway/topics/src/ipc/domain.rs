//! A shared-memory domain: a directory and a name. Processes communicate only within one domain.

use super::bell::Bell;
use super::error::{SHM, transport};
use super::guard::Guard;
use super::lock::{FEW_STEPS, Lock, STEPS};
use super::memory::{self, MadeFile, OpenMappings};
use super::sweep::{self, DomainPaths, SweepCounts};
use super::{DomainError, PortError};
use iceoryx2::prelude::{
    Config, FileName, LogLevel, Node, NodeBuilder, Path as IoxPath, SemanticString, ServiceName,
    SignalHandlingMode, ipc, set_log_level_from_env_or,
};
use iceoryx2::service::Service;
use nix::unistd::{AccessFlags, access, geteuid};
use std::borrow::ToOwned;
use std::format;
use std::fs::{self, DirBuilder, File, Metadata, Permissions};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::string::String;
use std::sync::{Arc, Mutex, MutexGuard, Once, PoisonError};
use std::time::Duration;
use std::vec::Vec;

/// Directory and name of a domain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DomainConfig {
    /// The directory that holds the domains of this machine (or user, or test): absolute, at most
    /// 65 bytes.
    pub base: PathBuf,
    /// The domain's name: 1 to 32 letters, digits, `-` or `_`.
    pub name: String,
}

impl DomainConfig {
    /// A domain `name` under `base`.
    #[must_use]
    pub fn new(base: impl Into<PathBuf>, name: &str) -> Self {
        Self {
            base: base.into(),
            name: name.to_owned(),
        }
    }

    /// The domain that the environment variables name, else the default domain.
    ///
    /// Name: `PROPRIO_DOMAIN`, else `default`. Base: `PROPRIO_RUNTIME_DIR`; else `/run/proprio` if
    /// it is writable (or can be created), or if it already holds a domain of this name; else
    /// `$XDG_RUNTIME_DIR/proprio`; else `/dev/shm/proprio-<uid>`. These are in memory on most
    /// machines: in a directory on a disk, a start waits as long as the disk does.
    #[must_use]
    pub fn from_env() -> Self {
        let set = |key| std::env::var_os(key).filter(|v| !v.is_empty());
        let name = set("PROPRIO_DOMAIN").map_or_else(
            || "default".to_owned(),
            |v| v.to_string_lossy().into_owned(),
        );
        let base = set("PROPRIO_RUNTIME_DIR").map_or_else(
            || {
                let system = PathBuf::from("/run/proprio");
                let _ = DirBuilder::new().mode(0o755).create(&system);
                // If another user owns a domain of this name there, do not silently choose another
                // directory: opening it reports the owner.
                if access(&system, AccessFlags::W_OK).is_ok()
                    || system.join(format!("{name}.lock")).exists()
                {
                    return system;
                }
                match set("XDG_RUNTIME_DIR") {
                    Some(dir) => PathBuf::from(dir).join("proprio"),
                    None => PathBuf::from(format!("{SHM}/proprio-{}", geteuid())),
                }
            },
            PathBuf::from,
        );
        Self { base, name }
    }

    fn paths(&self) -> Result<DomainPaths, DomainError> {
        let legal = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if self.name.is_empty() || self.name.len() > 32 || !self.name.chars().all(legal) {
            return Err(DomainError::Name {
                name: self.name.clone(),
            });
        }
        // iceoryx2 limits paths to 255 bytes; a connection's name needs 157 of them, the domain's
        // 33.
        if !self.base.is_absolute() || self.base.to_str().is_none_or(|b| b.len() > 65) {
            return Err(DomainError::Base {
                base: self.base.clone(),
            });
        }
        let io = |doing| {
            move |cause| DomainError::Io {
                doing,
                path: self.base.clone(),
                cause,
            }
        };
        DirBuilder::new()
            .recursive(true)
            .mode(0o755)
            .create(&self.base)
            .map_err(io("cannot create directory"))?;
        let base = fs::metadata(&self.base).map_err(io("cannot examine directory"))?;
        let (root, lock) = (
            self.base.join(&self.name),
            self.base.join(format!("{}.lock", self.name)),
        );
        for path in [&root, &lock] {
            owned_by_us(path)?;
        }
        // These are writable by everybody: a directory that another user has created there is not
        // trusted.
        if ["/tmp", SHM].iter().any(|all| self.base.starts_with(all)) && base.mode() & 0o1000 == 0 {
            owned_by_us(&self.base)?;
        }
        access(&self.base, AccessFlags::W_OK | AccessFlags::X_OK)
            .map_err(|e| io("cannot write to directory")(e.into()))?;
        access(SHM, AccessFlags::W_OK | AccessFlags::X_OK)
            .map_err(|e| DomainError::NoSharedMemory { problem: e.into() })?;
        // Directories of the same path in different mount namespaces are different domains, even if
        // they share /dev/shm.
        let hash = fnv1a(&[
            root.as_os_str().as_encoded_bytes(),
            &base.dev().to_le_bytes(),
            &base.ino().to_le_bytes(),
        ]);
        Ok(DomainPaths {
            root,
            lock,
            prefix: format!("proprio_{hash:016x}_"),
        })
    }
}

fn owned_by_us(path: &Path) -> Result<(), DomainError> {
    let user = geteuid().as_raw();
    match fs::symlink_metadata(path) {
        Ok(meta) if meta.uid() != user => Err(DomainError::ForeignOwner {
            path: path.to_path_buf(),
            owner: meta.uid(),
            user,
        }),
        _ => Ok(()),
    }
}

/// An open domain. Clones share it. This process leaves the domain when its last clone and its last
/// port are dropped; the last process that leaves removes the domain's files.
///
/// `S` is the kind of iceoryx2's ports: those of the default belong to one thread and take no lock.
#[derive(Debug)]
pub struct Domain<S: Service = ipc::Service> {
    inner: Arc<Inner<S>>,
}

impl<S: Service> Clone for Domain<S> {
    fn clone(&self) -> Self {
        let inner = Arc::clone(&self.inner);
        Self { inner }
    }
}

#[derive(Debug)]
struct Inner<S: Service> {
    config: DomainConfig,
    paths: DomainPaths,
    iceoryx: Config,
    epoch: u64,
    id: u128,
    /// Its directory, open so that no other directory can have its inode.
    folder: File,
    // `None` only during `drop`.
    node: Mutex<Option<Node<S>>>,
    guard: Guard,
    /// For how long it waits for the lock.
    steps: u32,
    /// The files that this process has made.
    made: Mutex<Vec<MadeFile>>,
    /// What it holds of a domain that was given up.
    held: Mutex<OpenMappings>,
}

impl Domain {
    /// Opens the domain, or creates it. Removes the files that dead processes have left in it.
    ///
    /// Sets iceoryx2's log level in this process to `Fatal`, unless `IOX2_LOG_LEVEL` is set.
    /// Installs a handler of SIGBUS, which replaces memory of the domain that another program has
    /// taken away, and leaves all else to the handler before it; no other signal handlers.
    ///
    /// # Errors
    /// [`DomainError`]: a bad name or directory, no shared memory, no permission, another owner, or
    /// another process that holds the lock.
    pub fn open(config: &DomainConfig) -> Result<Self, DomainError> {
        Self::create(config, STEPS)
    }

    /// Opens the domain for reading: it must exist, and nothing is created if it does not.
    ///
    /// # Errors
    /// [`DomainError::NotYet`] if no process has opened the domain; others as [`Domain::open`].
    pub fn open_existing(config: &DomainConfig) -> Result<Self, DomainError> {
        Self::existing(config)
    }

    /// Removes a domain's files if no live process uses it; returns whether it did.
    ///
    /// The last process that leaves a domain does this. Use it after killing processes, as in a
    /// test or a demonstration.
    ///
    /// # Errors
    /// As [`Domain::open`].
    pub fn remove_if_unused(config: &DomainConfig) -> Result<bool, DomainError> {
        let paths = config.paths()?;
        let lock = Lock::take(&paths.lock)?;
        let swept = sweep::sweep(&paths, &iceoryx(&paths)?)?;
        if swept.alive == 0 {
            lock.remove();
        }
        Ok(swept.alive == 0)
    }
}

impl<S: Service> Domain<S> {
    /// As [`Domain::open_existing`].
    pub(super) fn existing(config: &DomainConfig) -> Result<Self, DomainError> {
        let root = config.base.join(&config.name);
        if !root.exists() {
            return Err(DomainError::NotYet { root });
        }
        Self::create(config, STEPS)
    }

    /// As [`Domain::open`]. It and its ports wait for the domain's lock for so many `steps`.
    pub(super) fn create(config: &DomainConfig, steps: u32) -> Result<Self, DomainError> {
        static QUIET: Once = Once::new();
        QUIET.call_once(|| set_log_level_from_env_or(LogLevel::Fatal));

        let paths = config.paths()?;
        let iceoryx = iceoryx(&paths)?;
        let _lock = Lock::take_within(&paths.lock, steps)?;
        sweep::sweep(&paths, &iceoryx)?;
        let failed = |problem: String| DomainError::Transport {
            root: paths.root.clone(),
            doing: "cannot create a node",
            problem,
        };
        memory::require(memory::BESIDE)?;
        let guard = Guard::new();
        let before = memory::files(&paths)?;
        let create = || {
            NodeBuilder::new()
                .config(&iceoryx)
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<S>()
        };
        // What all nodes share is one counter, which need not go on: if the file cannot be used,
        // there will be a new one.
        let created = create().or_else(|error| match remove_counter(&paths) {
            true => create(),
            false => Err(error),
        });
        let node = created.map_err(|e| failed(transport(e)))?;
        protect_counter(&paths);
        let made = memory::commit(&paths, &before)?;
        let id = node.id().value();
        sweep::register(&paths, id);
        let folder = File::open(&paths.root).map_err(|cause| DomainError::Io {
            doing: "cannot open directory",
            path: paths.root.clone(),
            cause,
        })?;
        let inner = Inner {
            config: config.clone(),
            paths,
            iceoryx,
            epoch: fnv1a(&[&id.to_le_bytes()]).max(1),
            id,
            folder,
            node: Mutex::new(Some(node)),
            guard,
            steps,
            made: Mutex::new(made),
            held: Mutex::default(),
        };
        Ok(Self {
            inner: Arc::new(inner),
        })
    }

    /// Directory and name of this domain.
    #[must_use]
    pub fn config(&self) -> &DomainConfig {
        &self.inner.config
    }

    /// A number that differs each time a domain is opened: the epoch for the writers of a publisher
    /// that starts now.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.inner.epoch
    }

    /// Removes the files that dead processes have left. Opening a domain or a port does this too.
    ///
    /// # Errors
    /// As [`Domain::open`].
    pub fn sweep(&self) -> Result<SweepCounts, DomainError> {
        let _lock = Lock::take(&self.inner.paths.lock)?;
        sweep::sweep(&self.inner.paths, &self.inner.iceoryx)
    }

    /// Runs `create` under the domain's lock, after a sweep. It may make files of `needed` bytes in
    /// all, which are allocated.
    pub(super) fn locked<R>(
        &self,
        needed: u64,
        create: impl FnOnce(&Node<S>) -> Result<R, PortError>,
    ) -> Result<R, PortError> {
        let paths = &self.inner.paths;
        let _lock = Lock::take_within(&paths.lock, self.inner.steps)?;
        let damaged = || DomainError::Damaged {
            root: paths.root.clone(),
        };
        if !self.is_usable() {
            return Err(damaged().into());
        }
        sweep::sweep(paths, &self.inner.iceoryx)?;
        memory::require(needed)?;
        let before = memory::files(paths)?;
        let node = self.inner.node.lock();
        let created = match &*node.unwrap_or_else(PoisonError::into_inner) {
            Some(node) => {
                let created = self.inner.guard.survive(|| create(node));
                created.ok_or_else(damaged)??
            }
            None => return Err(self.gone().into()),
        };
        self.inner.keep(memory::commit(paths, &before)?);
        Ok(created)
    }

    /// Runs `change` under the domain's lock, after a sweep; `None` if another process holds it, if
    /// the domain's directory has gone, or without memory. Never waits.
    pub(super) fn try_locked<R>(&self, change: impl FnOnce() -> R) -> Option<R> {
        let paths = &self.inner.paths;
        let _lock = Lock::try_take(&paths.lock).ok()?;
        if !self.is_usable() {
            return None;
        }
        sweep::sweep(paths, &self.inner.iceoryx).ok()?;
        memory::require(memory::BESIDE).ok()?;
        let before = memory::files(paths).ok()?;
        let changed = change();
        self.inner.keep(memory::commit(paths, &before).ok()?);
        Some(changed)
    }

    /// Drops a port under the domain's lock, so that no process sees it half removed.
    pub(super) fn drop_locked<P>(&self, port: P) {
        if !self.is_usable() {
            return std::mem::forget(port);
        }
        // If a stopped process holds the lock, drop without it: a program must be able to end.
        let _lock = Lock::take(&self.inner.paths.lock);
        self.inner.drop_unless_replaced(port);
        self.inner.made().retain(MadeFile::exists);
    }

    /// Whether everything that this process has made in the domain is as it was: nobody has
    /// deleted, replaced or shortened a file. Looks at each, so not for a data plane.
    #[must_use]
    pub fn is_intact(&self) -> bool {
        self.is_usable()
            && self.inner.made().iter().all(MadeFile::is_intact)
            && self.inner.emptied().next().is_none()
    }

    pub(super) fn guard(&self) -> &Guard {
        &self.inner.guard
    }

    /// Whether ports may still be used: the directory is there, and no memory was found damaged.
    pub(super) fn is_usable(&self) -> bool {
        self.inner.is_usable()
    }

    /// What happened to a domain that is not intact, for a person.
    #[must_use]
    pub fn damage(&self) -> String {
        format!(
            "files of the shared-memory domain {:?} ({}, /dev/shm/{}*) were deleted, replaced or \
             shortened by another program; they are made again",
            self.inner.config.name,
            self.inner.paths.root.display(),
            self.inner.paths.prefix
        )
    }

    /// Gives up a domain that is not intact: removes its directory, by which all its processes see
    /// that they must open a new one.
    pub(super) fn abandon(&self) {
        let paths = &self.inner.paths;
        let _lock = Lock::take_within(&paths.lock, FEW_STEPS);
        if self.is_there() {
            let _ = fs::remove_dir_all(&paths.root);
        }
        // Whoever opens one of these waits for its content, with the lock.
        self.inner
            .emptied()
            .for_each(|path| drop(fs::remove_file(path)));
        self.inner.hold();
    }

    /// Notes what this process holds of a domain that cannot be used any more, before it opens the
    /// one that replaces it: then it is given back with the last port.
    pub(super) fn give_up(&self) {
        if !self.is_usable() {
            self.inner.hold();
        }
    }

    /// The bell of `service`.
    pub(super) fn bell(&self, service: &ServiceName) -> Result<Bell, PortError> {
        Bell::open(&self.inner.paths.root, service.as_str())
    }

    /// Whether `service` has a bell: a writer has created it.
    pub(super) fn has_bell(&self, service: &ServiceName) -> bool {
        Bell::exists(&self.inner.paths.root, service.as_str())
    }

    /// Whether the domain's directory is still the one that was opened.
    pub(super) fn is_there(&self) -> bool {
        self.inner.is_there()
    }

    #[cfg(test)]
    pub(super) fn prefix(&self) -> &str {
        &self.inner.paths.prefix
    }

    pub(super) fn iceoryx(&self) -> &Config {
        &self.inner.iceoryx
    }

    /// The process that runs a node, 0 if it is not known; `None` if the node is dead.
    pub(super) fn process_of(&self, node: u128) -> Option<i32> {
        sweep::holder_of(&self.inner.paths, node)
    }

    fn gone(&self) -> DomainError {
        DomainError::Transport {
            root: self.inner.paths.root.clone(),
            doing: "cannot create a port",
            problem: "the domain is being closed".to_owned(),
        }
    }
}

/// The segment that counts a domain's nodes. iceoryx2 makes it writable for everybody.
fn counters(paths: &DomainPaths) -> impl Iterator<Item = PathBuf> {
    let segments = paths.segments().into_iter().flatten();
    let is_counter = |path: &PathBuf| path.extension().is_some_and(|end| end == "global_mgmt");
    segments.map(|(path, _)| path).filter(is_counter)
}

/// Removes the counter; returns whether there was one.
fn remove_counter(paths: &DomainPaths) -> bool {
    counters(paths)
        .filter(|path| fs::remove_file(path).is_ok())
        .count()
        > 0
}

/// Leaves the counter to its owner.
fn protect_counter(paths: &DomainPaths) {
    for path in counters(paths) {
        let _ = fs::set_permissions(path, Permissions::from_mode(0o600));
    }
}

impl<S: Service> Inner<S> {
    fn made(&self) -> MutexGuard<'_, Vec<MadeFile>> {
        self.made.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn keep(&self, made: Vec<MadeFile>) {
        self.made().extend(made);
    }

    /// The segments that another program has emptied.
    fn emptied(&self) -> impl Iterator<Item = PathBuf> {
        let segments = self.paths.segments().into_iter().flatten();
        let emptied = segments.filter(|(_, meta)| memory::is_emptied(meta));
        emptied.map(|(path, _)| path)
    }

    /// Notes what this process holds of a domain that is given up. If it has opened the domain
    /// twice, nobody knows what is whose: then that stays until the process ends.
    fn hold(&self) {
        if sweep::is_only(&self.paths, self.id) {
            let held = OpenMappings::of(&self.paths.prefix);
            *self.held.lock().unwrap_or_else(PoisonError::into_inner) = held;
        }
    }

    fn is_usable(&self) -> bool {
        self.is_there() && self.guard.is_sound()
    }

    fn is_there(&self) -> bool {
        let inode = |meta: Metadata| (meta.dev(), meta.ino());
        let now = fs::metadata(&self.paths.root).map(inode);
        let opened = self.folder.metadata().map(inode);
        now.is_ok_and(|now| opened.is_ok_and(|opened| now == opened))
    }

    /// Drops a node or port. If the domain's directory was deleted, there is nothing to remove, and
    /// iceoryx2 would remove the files of the same names in the directory that has replaced it. And
    /// it would not find its way in damaged memory.
    fn drop_unless_replaced<P>(&self, resource: P) {
        if self.is_usable() {
            drop(resource);
        } else {
            std::mem::forget(resource);
        }
    }
}

impl<S: Service> Drop for Inner<S> {
    fn drop(&mut self) {
        let lock = Lock::take(&self.paths.lock);
        let node = self
            .node
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        if !self.is_usable() {
            self.hold();
        }
        self.drop_unless_replaced(node);
        let held = std::mem::take(self.held.get_mut().unwrap_or_else(PoisonError::into_inner));
        held.release();
        sweep::deregister(&self.paths, self.id);
        if let Ok(lock) = lock
            && sweep::sweep(&self.paths, &self.iceoryx).is_ok_and(|s| s.alive == 0)
        {
            lock.remove();
        }
    }
}

/// The name of a robot's service.
pub(super) fn service_name(robot: &str, suffix: &str) -> Result<ServiceName, PortError> {
    if !crate::is_robot_name(robot) {
        return Err(PortError::Robot {
            robot: robot.to_owned(),
        });
    }
    let name = format!("{robot}/{suffix}");
    ServiceName::new(&name).map_err(|e| PortError::Transport {
        service: name,
        problem: transport(e),
    })
}

/// All settings are explicit, because iceoryx2's default reads `config/iceoryx2.toml` of the
/// consumer's working directory.
fn iceoryx(paths: &DomainPaths) -> Result<Config, DomainError> {
    let failed = |problem: String| DomainError::Transport {
        root: paths.root.clone(),
        doing: "cannot name the domain's files",
        problem,
    };
    let mut config = Config::default();
    let root = paths.root.as_os_str().as_encoded_bytes();
    config.global.prefix =
        FileName::new(paths.prefix.as_bytes()).map_err(|e| failed(transport(e)))?;
    config
        .global
        .set_root_path(&IoxPath::new(root).map_err(|e| failed(transport(e)))?);
    // Nothing is half made under the lock: what looks so is damaged, and does not get better.
    config.global.creation_timeout = Duration::from_millis(10);
    // `sweep` does all cleaning; iceoryx2's own runs without the lock.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// The 64-bit FNV-1a hash of `parts` in a row (<http://www.isthe.com/chongo/tech/comp/fnv/>), the
/// same in every build.
#[must_use]
pub fn fnv1a(parts: &[&[u8]]) -> u64 {
    parts
        .iter()
        .copied()
        .flatten()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
        })
}
