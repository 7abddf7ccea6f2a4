"""What may happen to a running robot under the programs that read it: the tests of both bridges."""

import contextlib
import shutil
from pathlib import Path


def segments(reader, is_deleted=False):
    """The files of shared memory that a process has mapped: those that are there, or are not."""
    lines = Path(f"/proc/{reader.pid}/maps").read_text().splitlines()
    ours = (line for line in lines if "/dev/shm/proprio_" in line)
    return {Path(line.split()[5]) for line in ours if line.endswith("(deleted)") == is_deleted}


def end_both(_root, _reader, daemons):
    for daemon in daemons:
        daemon.terminate()
        daemon.wait(timeout=20)


def delete_folder(root, _reader, _daemons):
    # Whoever makes it again at the same time leaves nothing to remove.
    shutil.rmtree(root, ignore_errors=True)


def delete_segments(_root, reader, _daemons):
    for path in segments(reader):
        path.unlink(missing_ok=True)


def empty_payloads(_root, reader, _daemons):
    for path in segments(reader):
        # Its owner may have removed it meanwhile.
        with contextlib.suppress(FileNotFoundError):
            if path.suffix == ".data":
                path.chmod(0o600)
                path.write_bytes(b"")


DAMAGES = [end_both, delete_folder, delete_segments, empty_payloads]
