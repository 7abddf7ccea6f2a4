"""A simulated arm with its gateway and estimator, as processes of the command in the package."""

import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import proprio
import pytest

PATIENCE = 60.0
TREE = Path(__file__).parents[2]
ROBOT = "icub_left_arm"


class Arm:
    """The processes; each can be killed and started again."""

    def __init__(self, folder):
        # A robot's name is part of a virtual bus: those of two tests must not meet.
        self.runtime_dir, self.domain = str(folder), Path(folder).name
        self.environment = dict(
            os.environ, PROPRIO_RUNTIME_DIR=self.runtime_dir, PROPRIO_DOMAIN=self.domain
        )
        self.config = TREE / "config" / ROBOT
        self.running = {}
        for name in ("simulate", "gateway", "estimator"):
            self.start(name)

    def start(self, name):
        arguments = {
            "simulate": ["--robot", str(self.config)],
            "gateway": ["--config", str(self.config / "gateway.toml")],
            "estimator": ["--config", str(self.config / "estimator.toml")],
        }[name]
        self.running[name] = subprocess.Popen(
            [str(proprio.program()), name, *arguments],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )

    def kill(self, name):
        self.running[name].kill()
        self.running.pop(name).wait()

    def end(self):
        for process in reversed(list(self.running.values())):
            process.send_signal(signal.SIGTERM)
            process.wait()

    def reader(self, **options):
        return proprio.RobotReader(
            ROBOT, runtime_dir=self.runtime_dir, domain=self.domain, **options
        )


@pytest.fixture(scope="session")
def arm():
    with tempfile.TemporaryDirectory(prefix="py-", dir="/dev/shm") as folder:
        arm = Arm(folder)
        yield arm
        arm.end()


def until(what, ask):
    """Waits until `ask` gives something true, and gives that."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = ask()
        if found:
            return found
        time.sleep(0.002)
    raise AssertionError(what)
