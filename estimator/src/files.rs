//! Files that are replaced whole: whatever happens meanwhile, what is there is the old one or the new one.

use std::fs::{File, Permissions};
use std::io::{self, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use tempfile::NamedTempFile;

/// Puts `text` in the place of `file`: written beside it first, then, once that is on the disk, renamed. `mode`: who may do what with it.
///
/// # Errors
/// The system's; the old file is as it was then.
pub fn replace(file: &Path, text: &str, mode: u32) -> io::Result<()> {
    prepare(file, text, mode)?.persist(file).map_err(|error| error.error)?;
    // The rename itself is on the disk when the folder is. Not every file system can say so.
    let _ = File::open(folder(file)).and_then(|folder| folder.sync_all());
    Ok(())
}

/// The temporary file, whole and on the disk.
pub(crate) fn prepare(file: &Path, text: &str, mode: u32) -> io::Result<NamedTempFile> {
    // tempfile names its own file in the error, which means nothing to whoever named another one.
    let temporary = NamedTempFile::with_prefix_in(".proprio-", folder(file));
    let mut temporary = temporary.map_err(|error| io::Error::from(error.kind()))?;
    temporary.write_all(text.as_bytes())?;
    temporary.as_file().set_permissions(Permissions::from_mode(mode))?;
    temporary.as_file().sync_all()?;
    Ok(temporary)
}

fn folder(file: &Path) -> &Path {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}
