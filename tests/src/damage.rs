//! What another program may do to the files of a running domain.

use crate::Rig;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

/// In words, and what is done.
pub type Damage = (&'static str, fn(&Rig));

/// Files are deleted. Nobody dies of it.
pub const DELETIONS: [Damage; 3] = [
    ("the folder is deleted", |rig| {
        // A process that makes it again at the same time leaves nothing to remove.
        let _ = fs::remove_dir_all(root(rig));
    }),
    ("what is in the folder is deleted", |rig| {
        delete(&below(&root(rig)));
    }),
    ("the segments are deleted", |rig| {
        delete(&segments(rig));
    }),
];

/// Files are shortened. Who writes in one may die of it.
pub const SHORTENINGS: [Damage; 7] = [
    ("payloads are emptied", |rig| {
        shorten(&segments(rig), ".data", 0);
    }),
    ("payloads are halved", |rig| {
        shorten(&segments(rig), ".data", 50);
    }),
    ("connections are emptied", |rig| {
        shorten(&segments(rig), ".connection", 0);
    }),
    ("connections are halved", |rig| {
        shorten(&segments(rig), ".connection", 50);
    }),
    ("lists of ports are emptied", |rig| {
        shorten(&segments(rig), ".dynamic", 0);
    }),
    ("bells are emptied", |rig| {
        shorten(&below(&root(rig).join("bells")), "", 0);
    }),
    ("all segments are emptied", |rig| {
        shorten(&segments(rig), "", 0);
    }),
];

fn root(rig: &Rig) -> PathBuf {
    rig.domain.base.join(&rig.domain.name)
}

fn segments(rig: &Rig) -> Vec<PathBuf> {
    let names = rig.segments().into_iter();
    names.map(|name| Path::new("/dev/shm").join(name)).collect()
}

fn delete(files: &[PathBuf]) {
    files.iter().for_each(|path| drop(fs::remove_file(path)));
}

/// Sets the length of each of these files to a part of what it was.
fn shorten(files: &[PathBuf], kind: &str, part: u64) {
    for path in files
        .iter()
        .filter(|path| path.to_string_lossy().ends_with(kind))
    {
        // Whoever makes the domain again at the same time may remove it.
        let _ = (|| {
            // Files that their owners may only read belong to the same user all the same.
            fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
            let file = fs::OpenOptions::new().write(true).open(path)?;
            file.set_len(file.metadata()?.len() * part / 100)
        })();
    }
}

fn below(folder: &Path) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            all.extend(below(&path));
        } else {
            all.push(path);
        }
    }
    all
}
