"""The C library, declared by its own header."""

import os
from pathlib import Path
from typing import Any

import cffi

from ._program import NATIVE


def _declarations(header: str) -> str:
    """What cffi understands of the header: no conditions, no inclusions, nothing for C++."""
    kept = []
    is_cpp = False
    for line in header.splitlines():
        if line.startswith("#ifdef __cplusplus"):
            is_cpp = True
        elif line.startswith("#endif"):
            is_cpp = False
        elif not is_cpp and not line.startswith(("#include", "#ifndef", "#define PROPRIO_H")):
            kept.append(line)
    return "\n".join(kept)


ffi: Any = cffi.FFI()
ffi.cdef(_declarations((NATIVE / "proprio.h").read_text()))
# Another build of the library may be named, to try it.
_path = Path(os.environ.get("PROPRIO_LIBRARY", NATIVE / "libproprio.so"))
lib: Any = ffi.dlopen(str(_path))

__version__: str = ffi.string(lib.proprio_version()).decode()
