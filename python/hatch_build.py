"""Builds the C library and the `proprio` command and puts them into the wheel.

PROPRIO_LIBRARIES names a folder that has them, instead; PROPRIO_WHEEL_PLATFORM the platform that
they are for, instead of this machine's.
"""

import os
import subprocess
import sysconfig
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LIBRARY, PROGRAM = "libproprio.so", "proprio"


class BuildHook(BuildHookInterface):
    def initialize(self, version, build_data):
        tree = Path(self.root).resolve().parent
        built = os.environ.get("PROPRIO_LIBRARIES")
        if built is None:
            if not (tree / "ffi" / "Cargo.toml").is_file():
                raise SystemExit("build the wheel in a clone of Proprio: it needs the Rust sources")
            packages = ["--package", "proprio-ffi", "--package", "proprio-cli"]
            build = ["cargo", "build", "--release", "--locked", *packages]
            subprocess.run(build, cwd=tree, check=True)
            built = Path(os.environ.get("CARGO_TARGET_DIR", tree / "target")) / "release"
        platform = os.environ.get("PROPRIO_WHEEL_PLATFORM")
        if platform is None:
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        # Any Python 3: the library has nothing of Python in it.
        build_data["tag"] = f"py3-none-{platform}"
        files = {
            Path(built) / LIBRARY: f"proprio/native/{LIBRARY}",
            Path(built) / PROGRAM: f"proprio/native/{PROGRAM}",
            tree / "ffi" / "include" / "proprio.h": "proprio/native/proprio.h",
        }
        # The robots of the demonstration; the command looks beside itself.
        for robot in sorted((tree / "config").iterdir()):
            if (robot / "gateway.toml").is_file():
                files[robot] = f"proprio/native/config/{robot.name}"
        include = {str(source.resolve()): place for source, place in files.items()}
        build_data["force_include"].update(include)
