"""What may happen to a running robot under the programs that read it: the tests of both bridges."""

import shutil
from pathlib import Path


def segments(reader):
    """The files of shared memory that a process has mapped."""
    lines = Path(f"/proc/{reader.pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in lines if "/dev/shm/proprio_" in line}


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
        if path.suffix == ".data":
            path.chmod(0o600)
            path.write_bytes(b"")


DAMAGES = [end_both, delete_folder, delete_segments, empty_payloads]
