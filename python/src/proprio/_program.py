"""The `proprio` command that the wheel holds."""

import os
import shutil
import sys
from pathlib import Path
from typing import NoReturn

NATIVE = Path(__file__).parent / "native"


def program() -> Path:
    """The path of the command: that of PROPRIO_PROGRAM, of the wheel, or one on the PATH.

    Raises FileNotFoundError if there is none.
    """
    named = os.environ.get("PROPRIO_PROGRAM")
    if named:
        return Path(named)
    own = NATIVE / "proprio"
    if own.is_file():
        return own
    found = shutil.which("proprio")
    if found is None:
        raise FileNotFoundError("there is no program proprio in this package or on the PATH")
    return Path(found)


def main() -> NoReturn:
    """Becomes the command."""
    own = str(program())
    os.execv(own, ["proprio", *sys.argv[1:]])
