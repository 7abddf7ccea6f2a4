"""Builds the C library and the `proprio` command and puts them into the wheel.

PROPRIO_LIBRARIES names a folder that has them, instead; PROPRIO_WHEEL_PLATFORM the platform that
they are for, instead of this machine's. An editable installation gets them into src/.
"""

import os
import shutil
import subprocess
import sysconfig
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LIBRARY, PROGRAM = "libproprio.so", "proprio"


class BuildHook(BuildHookInterface):
    def initialize(self, version, build_data):
        tree = Path(self.root).resolve().parent
        if self.target_name != "wheel" or not (tree / "ffi" / "Cargo.toml").is_file():
            raise SystemExit(
                "build a wheel in a clone of Proprio, as `pip wheel ./python` does: it needs the "
                "Rust sources, which a source distribution of this folder would not have"
            )
        built = os.environ.get("PROPRIO_LIBRARIES")
        if built is None:
            packages = ["--package", "proprio-ffi", "--package", "proprio-cli"]
            build = ["cargo", "build", "--release", "--locked", *packages]
            subprocess.run(build, cwd=tree, check=True)
            built = tree / os.environ.get("CARGO_TARGET_DIR", "target") / "release"
        files = {
            LIBRARY: Path(built) / LIBRARY,
            PROGRAM: Path(built) / PROGRAM,
            "proprio.h": tree / "ffi" / "include" / "proprio.h",
            "LICENSE-APACHE": tree / "LICENSE-APACHE",
            "LICENSE-MIT": tree / "LICENSE-MIT",
        }
        # The robots of the demonstration; the command looks beside itself.
        for robot in sorted((tree / "config").iterdir()):
            if (robot / "gateway.toml").is_file():
                files[f"config/{robot.name}"] = robot
        if version == "editable":
            native = Path(self.root) / "src" / "proprio" / "native"
            shutil.rmtree(native, ignore_errors=True)
            (native / "config").mkdir(parents=True)
            for place, source in files.items():
                (native / place).symlink_to(source.resolve())
        platform = os.environ.get("PROPRIO_WHEEL_PLATFORM")
        if platform is None:
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        # Any Python 3: the library has nothing of Python in it.
        build_data["tag"] = f"py3-none-{platform}"
        if version != "editable":
            for place, source in files.items():
                build_data["force_include"][str(source.resolve())] = f"proprio/native/{place}"
