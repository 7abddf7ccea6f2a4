//! Removes the files of dead processes. Everything here runs under the domain's lock, so no live
//! process has an unfinished resource.
//!
//! iceoryx2's own cleaning handles a process that died in steady state. It hangs on an empty
//! segment, ignores a node that died before its monitor file was finished, and misses services
//! whose last user died while removing them. Therefore a sweep removes unfinished files first, then
//! lets iceoryx2 clean the dead nodes, then removes everything without a live owner.

use super::DomainError;
use super::bell::Bell;
use super::error::SHM;
use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, Config, Node, NodeState, ipc};
use iceoryx2::service::Service;
use nix::fcntl::{FcntlArg, fcntl};
use nix::libc;
use std::borrow::ToOwned;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::string::{String, ToString};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use std::vec::Vec;

/// Directory, next to iceoryx2's own, of the tags of nodes that are being cleaned.
const KEPT: &str = "kept";

/// Counts of the files that a sweep has removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SweepCounts {
    /// Dead nodes (processes).
    pub nodes: usize,
    /// Shared-memory segments: unfinished, or without a live owner.
    pub segments: usize,
    /// Services: unfinished, or without a live user.
    pub services: usize,
    /// Dead nodes that could not be removed; tried again next time.
    pub failures: usize,
    /// Live nodes, in this process and in others.
    pub alive: usize,
}

/// The paths of a domain's files.
#[derive(Debug, Clone)]
pub(super) struct DomainPaths {
    /// `<base>/<name>`.
    pub(super) root: PathBuf,
    /// `<base>/<name>.lock`.
    pub(super) lock: PathBuf,
    /// Prefix of the names of its segments and files.
    pub(super) prefix: String,
}

/// The nodes of this process: (prefix of the domain, number). Never open their files here: closing
/// any descriptor of a file frees all POSIX locks of the process on it, and by these locks other
/// processes see that this one is alive.
static OWN: Mutex<Vec<(String, u128)>> = Mutex::new(Vec::new());

pub(super) fn register(paths: &DomainPaths, node: u128) {
    OWN.lock()
        .unwrap_or_else(PoisonError::into_inner)
        .push((paths.prefix.clone(), node));
}

pub(super) fn deregister(paths: &DomainPaths, node: u128) {
    OWN.lock()
        .unwrap_or_else(PoisonError::into_inner)
        .retain(|(p, n)| (p, *n) != (&paths.prefix, node));
}

/// Whether `node` is the only one of this process in the domain.
pub(super) fn is_only(paths: &DomainPaths, node: u128) -> bool {
    OWN.lock()
        .unwrap_or_else(PoisonError::into_inner)
        .iter()
        .all(|(p, n)| *p != paths.prefix || *n == node)
}

fn is_own(paths: &DomainPaths, node: u128) -> bool {
    OWN.lock()
        .unwrap_or_else(PoisonError::into_inner)
        .iter()
        .any(|(p, n)| (p, *n) == (&paths.prefix, node))
}

/// Removes the files of dead processes; if no node is alive, all files and the directory itself.
pub(super) fn sweep(paths: &DomainPaths, config: &Config) -> Result<SweepCounts, DomainError> {
    let mut swept = SweepCounts::default();
    let nodes = paths.nodes()?;
    let (alive, dead): (Vec<u128>, Vec<u128>) = nodes
        .into_iter()
        .partition(|&n| is_own(paths, n) || monitor_holder(&paths.monitor(n)).is_some());
    swept.alive = alive.len();
    if alive.is_empty() {
        swept.nodes = dead.len();
        for (path, _) in paths.segments()? {
            swept.segments += usize::from(remove(&path));
        }
        swept.services = list(&paths.root.join("services"))?.len();
        return match fs::remove_dir_all(&paths.root) {
            Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(DomainError::Io {
                doing: "cannot remove",
                path: paths.root.clone(),
                cause,
            }),
            _ => Ok(swept),
        };
    }

    // Unfinished files belong to dead processes: a segment is created with mode 0200 and no size, a
    // service file with mode 0600.
    for (path, meta) in paths.segments()? {
        if meta.len() == 0 || meta.permissions().mode() & 0o400 == 0 {
            swept.segments += usize::from(remove(&path));
        }
    }
    for (path, meta) in list(&paths.root.join("services"))? {
        if meta.permissions().mode() & 0o200 != 0 {
            swept.services += usize::from(remove(&path));
        }
    }

    if !dead.is_empty() {
        Bell::change_all(&paths.root);
        clean_dead(paths, config, &dead, &mut swept);
    }
    remove_ownerless(paths, config, &mut swept)?;
    Ok(swept)
}

fn clean_dead(paths: &DomainPaths, config: &Config, dead: &[u128], swept: &mut SweepCounts) {
    for &node in dead {
        keep_tags(paths, node);
    }
    let mut failed = BTreeSet::new();
    let _ = Node::<ipc::Service>::list(config, |state| {
        // For a node without details iceoryx2 would use another domain's configuration. Such a node
        // has no ports left.
        if let NodeState::Dead(view) = state
            && view.details().is_some()
        {
            let id = view.id().value();
            if dead.contains(&id)
                && view
                    .blocking_remove_stale_resources(Duration::from_millis(100))
                    .is_err()
            {
                failed.insert(id);
            }
        }
        CallbackProgression::Continue
    });
    for &node in dead {
        if failed.contains(&node) {
            swept.failures += 1;
            continue;
        }
        swept.nodes += 1;
        let _ = fs::remove_dir_all(paths.node(node));
        for suffix in ["", "_owner_lock", "_context"] {
            let mut name = paths.monitor(node).into_os_string();
            name.push(suffix);
            remove(Path::new(&name));
        }
    }
}

/// Keeps a second link to a dead node's port tags until the node is removed, and restores tags that
/// an earlier, interrupted sweep has lost.
///
/// iceoryx2 frees a port's place in its service only if it finds the port's tag, but removes the
/// tag first. If the process dies between the two, the place stays taken for ever, and a topic of
/// one writer can have no writer again.
fn keep_tags(paths: &DomainPaths, node: u128) {
    let (home, kept) = (paths.node(node), paths.kept(node));
    // Errors are ignored: the node is cleaned in any case.
    let _ = fs::create_dir_all(&kept);
    for (from, to) in [(&home, &kept), (&kept, &home)] {
        for (tag, _) in list(from).unwrap_or_default() {
            if let (Some((_, "port_tag")), Some(name)) = (paths.strip(&tag), tag.file_name()) {
                // Fails for tags that exist already, as most do.
                let _ = fs::hard_link(&tag, to.join(name));
            }
        }
    }
}

fn remove_ownerless(
    paths: &DomainPaths,
    config: &Config,
    swept: &mut SweepCounts,
) -> Result<(), DomainError> {
    let nodes = paths.nodes()?;
    for (kept, _) in list(&paths.root.join(KEPT))? {
        let node = kept.file_name().and_then(|n| number(&n.to_string_lossy()));
        if node.is_none_or(|n| !nodes.contains(&n)) {
            let _ = fs::remove_dir_all(kept);
        }
    }
    // A service is ownerless without a tag of a live node, a segment without a tag of a live port.
    let (mut services, mut ports) = (BTreeSet::new(), BTreeSet::new());
    for node in nodes {
        for (path, _) in list(&paths.node(node))? {
            match paths.strip(&path) {
                Some((name, "service_tag")) => drop(services.insert(name.to_owned())),
                Some((name, "port_tag")) => drop(name.parse::<u128>().map(|p| ports.insert(p))),
                _ => {}
            }
        }
    }
    let mut files = 0;
    for (path, _) in list(&paths.root.join("services"))? {
        if let Some((name, "service")) = paths.strip(&path) {
            if services.contains(name) {
                files += 1;
            } else {
                swept.services += usize::from(remove(&path));
            }
        }
    }
    let segments = paths.segments()?;
    let dynamic = segments
        .iter()
        .filter(|(p, _)| matches!(paths.strip_segment(p), Some((_, "dynamic"))))
        .count();
    let mut known = BTreeSet::new();
    if dynamic > files {
        let _ = ipc::Service::list(config, |details| {
            known.insert(details.static_details.unique_service_id().value());
            CallbackProgression::Continue
        });
    }
    for (path, _) in segments {
        let ownerless = match paths.strip_segment(&path) {
            Some((name, "data")) => number(name).is_some_and(|p| !ports.contains(&p)),
            Some((name, "connection")) => {
                match name.split_once('_').map(|(s, r)| (number(s), number(r))) {
                    Some((Some(sender), Some(receiver))) => {
                        !ports.contains(&sender) && !ports.contains(&receiver)
                    }
                    _ => false,
                }
            }
            // Only if every service file could be read: otherwise a service in use might look
            // unknown.
            Some((name, "dynamic")) => {
                dynamic > files
                    && known.len() == files
                    && number(name).is_some_and(|s| !known.contains(&s))
            }
            _ => false,
        };
        if ownerless {
            swept.segments += usize::from(remove(&path));
        }
    }
    Ok(())
}

/// The number that is the whole of `name`. Files with other names are left alone.
fn number(name: &str) -> Option<u128> {
    name.parse().ok()
}

/// The process that holds the lock of a node's monitor file; `None` if the node is dead, 0 if it
/// cannot be determined.
fn monitor_holder(path: &Path) -> Option<i32> {
    let file = match OpenOptions::new().write(true).open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return None,
        // A file that cannot be examined must not be removed.
        Err(_) => return Some(0),
    };
    #[allow(
        clippy::cast_possible_truncation,
        reason = "the constants are small; their type differs from the fields'"
    )]
    let mut query = libc::flock {
        l_type: libc::F_WRLCK as i16,
        l_whence: libc::SEEK_SET as i16,
        l_start: 0,
        l_len: 0,
        l_pid: 0,
    };
    match fcntl(&file, FcntlArg::F_GETLK(&mut query)) {
        #[allow(clippy::cast_possible_truncation, reason = "as above")]
        Ok(_) if query.l_type == libc::F_UNLCK as i16 => None,
        Ok(_) => Some(query.l_pid),
        Err(_) => Some(0),
    }
}

/// The process id of a node, 0 if it is not known; `None` if the node is dead.
pub(super) fn holder_of(paths: &DomainPaths, node: u128) -> Option<i32> {
    if is_own(paths, node) {
        return Some(i32::try_from(std::process::id()).unwrap_or(0));
    }
    monitor_holder(&paths.monitor(node))
}

/// Removes a file; returns whether this call removed it.
fn remove(path: &Path) -> bool {
    fs::remove_file(path).is_ok()
}

/// The files of a directory; none if it does not exist.
fn list(path: &Path) -> Result<Vec<(PathBuf, Metadata)>, DomainError> {
    let io = |cause| DomainError::Io {
        doing: "cannot list",
        path: path.to_path_buf(),
        cause,
    };
    let entries = match fs::read_dir(path) {
        Ok(entries) => entries,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(io(e)),
    };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.map_err(io)?.path();
        // It may have been removed meanwhile: all processes use /dev/shm.
        if let Ok(meta) = fs::symlink_metadata(&path) {
            files.push((path, meta));
        }
    }
    Ok(files)
}

impl DomainPaths {
    fn node(&self, node: u128) -> PathBuf {
        self.root.join("nodes").join(node.to_string())
    }

    fn kept(&self, node: u128) -> PathBuf {
        self.root.join(KEPT).join(node.to_string())
    }

    fn monitor(&self, node: u128) -> PathBuf {
        let mut name = self.prefix.clone();
        name.push_str(&node.to_string());
        name.push_str(".node_monitor");
        self.root.join("nodes").join(name)
    }

    /// The nodes of which any file exists.
    fn nodes(&self) -> Result<BTreeSet<u128>, DomainError> {
        let mut nodes = BTreeSet::new();
        for (path, meta) in list(&self.root.join("nodes"))? {
            let name = path
                .file_name()
                .map(|n| n.to_string_lossy().into_owned())
                .unwrap_or_default();
            let id = if meta.is_dir() {
                number(&name)
            } else {
                name.strip_prefix(&self.prefix)
                    .and_then(|n| n.split_once('.'))
                    .and_then(|(n, _)| number(n))
            };
            nodes.extend(id);
        }
        Ok(nodes)
    }

    /// The domain's shared-memory segments that belong to this user.
    pub(super) fn segments(&self) -> Result<Vec<(PathBuf, Metadata)>, DomainError> {
        let user = nix::unistd::geteuid().as_raw();
        let mut segments = list(Path::new(SHM))?;
        segments.retain(|(path, meta)| {
            let name = path.file_name().map(OsString::from).unwrap_or_default();
            meta.uid() == user && name.to_string_lossy().starts_with(&self.prefix)
        });
        Ok(segments)
    }

    /// A segment's name without prefix and type (40 hexadecimal digits and `_`), and its suffix.
    fn strip_segment<'a>(&self, path: &'a Path) -> Option<(&'a str, &'a str)> {
        let (name, suffix) = self.strip(path)?;
        let (kind, name) = name.split_once('_')?;
        (kind.len() == 40 && kind.bytes().all(|b| b.is_ascii_hexdigit())).then_some((name, suffix))
    }

    /// A file's name without prefix, and its suffix.
    fn strip<'a>(&self, path: &'a Path) -> Option<(&'a str, &'a str)> {
        path.file_name()?
            .to_str()?
            .strip_prefix(self.prefix.as_str())?
            .rsplit_once('.')
    }
}
