"""A simulated robot, its daemons and viewers: real processes, in a domain of their own."""

import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
PROPRIO = os.environ.get("PROPRIO", TARGET / "release" / "proprio")
VIEW = os.environ.get("PROPRIO_VIEW", TARGET / "view" / "release" / "proprio-view")


class Robot:
    """The example arm; a contact of its hand is detected, not assumed."""

    def __init__(self):
        # Short, because sockets are in it.
        self.folder = Path(tempfile.mkdtemp(prefix="pv"))
        self.domain = f"view{os.getpid()}"
        self.environment = os.environ | {
            "PROPRIO_RUNTIME_DIR": str(self.folder),
            "PROPRIO_DOMAIN": self.domain,
        }
        self.config = self.folder / "arm"
        shutil.copytree(ROOT / "config" / "icub_left_arm", self.config)
        file = self.config / "estimator.toml"
        text, always = file.read_text(), 'link = "l_hand"\n'
        assert text.count(always) == 1
        file.write_text(text.replace(always, always + 'presence = "possible"\n'))
        self.running = []

    def start(self, program, *arguments):
        log = open(self.folder / f"{len(self.running)}.log", "w+")
        process = subprocess.Popen(
            [str(it) for it in (program, *arguments)],
            env=self.environment,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        process.log = Path(log.name)
        self.running.append(process)
        return process

    def run(self, program, *arguments):
        return subprocess.run(
            [str(it) for it in (program, *arguments)],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=30,
        )

    def simulate(self):
        return self.start(PROPRIO, "simulate", "--robot", self.config)

    def gateway(self):
        return self.start(PROPRIO, "gateway", "--config", self.config / "gateway.toml")

    def estimator(self):
        return self.start(PROPRIO, "estimator", "--config", self.config / "estimator.toml")

    def view(self, *arguments):
        """A viewer at a free port."""
        process = self.start(VIEW, "--port", 0, *arguments)
        address = self.said(process, "ws://")
        process.port = int(address.rsplit(":", 1)[1])
        return process

    def said(self, process, start, timeout=10.0):
        """The first line of a process that begins so."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            for line in process.log.read_text().splitlines():
                if line.startswith(start):
                    return line
            assert process.poll() is None, process.log.read_text()
            time.sleep(0.02)
        raise AssertionError(f"{start!r} is not in:\n{process.log.read_text()}")

    def end(self):
        for process in reversed(self.running):
            process.terminate()
        for process in self.running:
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        shutil.rmtree(self.folder)
