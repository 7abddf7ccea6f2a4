//! Atomic replacement of files: after a crash there is the old file or the new one.

use std::fs::{File, Permissions};
use std::io::{self, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// Replaces `file` by `text`: writes a file beside it, waits until that is on the disk, then
/// renames it. `mode` is its permissions.
///
/// # Errors
/// The error of the system; the old file is unchanged then.
pub fn replace(file: &Path, text: &str, mode: u32) -> io::Result<()> {
    let mut new = begin(file)?;
    new.write_all(text.as_bytes())?;
    end(new, file, mode)
}

/// Creates a file beside `file`, to be written and then put in its place by [`end`]. If it is
/// dropped before, it is deleted.
///
/// # Errors
/// The error of the system: the folder does not exist, or is not writable.
pub fn begin(file: &Path) -> io::Result<NamedTempFile> {
    // The error of tempfile names a temporary file, which is unknown to the user: keep its kind
    // alone.
    std::fs::metadata(folder(file))?;
    NamedTempFile::with_prefix_in(".proprio-", folder(file))
        .map_err(|error| io::Error::from(error.kind()))
}

/// Replaces `file` by the written file `new` of [`begin`], once that is on the disk.
///
/// # Errors
/// The error of the system; the old file is unchanged then.
pub fn end(new: NamedTempFile, file: &Path, mode: u32) -> io::Result<()> {
    new.as_file()
        .set_permissions(Permissions::from_mode(mode))?;
    new.as_file().sync_all()?;
    new.persist(file).map_err(|error| error.error)?;
    // The rename is on the disk when the folder is. Not every file system can sync a folder.
    let _ = File::open(folder(file)).and_then(|folder| folder.sync_all());
    Ok(())
}

/// Renames a file that cannot be used to `<file>.bad-<n>`, the first free name, and returns that
/// name.
///
/// # Errors
/// The error of the file system.
pub fn set_aside(file: &Path) -> io::Result<PathBuf> {
    let mut number = 1_u32;
    loop {
        let mut name = file.as_os_str().to_owned();
        name.push(format!(".bad-{number}"));
        let aside = PathBuf::from(name);
        if !aside.exists() {
            std::fs::rename(file, &aside)?;
            return Ok(aside);
        }
        number += 1;
    }
}

fn folder(file: &Path) -> &Path {
    let folder = file
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}
