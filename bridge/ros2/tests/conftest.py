"""A simulated arm with its gateway, its estimator and proprio-ros2, each a process of its own.

PROPRIO and PROPRIO_ROS2 name the two programs. `bridge/ros2/test` builds them and sets both.
"""

import json
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import network
import pytest
from cyclonedds.domain import DomainParticipant
from messages import DiagnosticArray

PATIENCE = 60.0
TREE = Path(__file__).parents[3]
ROBOT = "icub_left_arm"
# Of this run, and never 0, which is everybody's. Those up to 101 keep to ports of their own.
DOMAIN = 20 + os.getpid() % 80


def until(what, ask, patience=PATIENCE):
    """Waits until `ask` gives something true, and gives that."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        found = ask()
        if found:
            return found
        time.sleep(0.005)
    raise AssertionError(what)


class Robot:
    """The processes; each can be killed and started again."""

    def __init__(self, folder):
        # A robot's name is part of a virtual bus: those of two tests must not meet.
        self.folder = Path(folder)
        keep = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
        self.environment = keep | {
            "PROPRIO_RUNTIME_DIR": str(folder),
            "PROPRIO_DOMAIN": self.folder.name,
        }
        self.config = TREE / "config" / ROBOT
        # Else a contact that is always assumed takes all that the F/T sensor feels.
        text = (self.config / "estimator.toml").read_text()
        link = 'link = "l_hand"\n'
        assert link in text
        text = text.replace(link, link + 'presence = "possible"\n')
        text = text.replace('"model.urdf"', f'"{self.config / "model.urdf"}"')
        self.estimator = self.folder / "estimator.toml"
        self.estimator.write_text(text)
        self.running = {}

    def start(self, *names):
        arguments = {
            "simulate": ["--robot", str(self.config)],
            "gateway": ["--config", str(self.config / "gateway.toml")],
            "estimator": ["--config", str(self.estimator)],
        }
        for name in names:
            self.run(name, [os.environ["PROPRIO"], name, *arguments[name]])

    def bridge(self, *arguments, name="bridge", domain=DOMAIN, interface="lo", variables=None):
        """Starts proprio-ros2; what it says is in `said(name)`."""
        program = [os.environ["PROPRIO_ROS2"], *arguments]
        if domain is not None:
            program += ["--domain-id", str(domain)]
        if interface is not None:
            program += ["--interface", interface]
        self.run(name, program, variables or {})

    def run(self, name, program, variables=None):
        with open(self.folder / f"{name}.log", "a") as log:
            self.running[name] = subprocess.Popen(
                program,
                env=self.environment | (variables or {}),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def said(self, name):
        return (self.folder / f"{name}.log").read_text()

    def kill(self, name, how=signal.SIGKILL):
        process = self.running.pop(name)
        process.send_signal(how)
        return process.wait(timeout=PATIENCE)

    def end(self):
        for name in reversed(list(self.running)):
            self.kill(name, signal.SIGTERM)

    def echo(self, *arguments, count):
        """Starts `proprio echo`; `.lines()` waits for what it prints."""
        return Echo(self, [*arguments, "--json", "--count", str(count)])


class Echo:
    def __init__(self, robot, arguments):
        # Not a pipe: it would fill while nobody reads.
        self.output = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            [os.environ["PROPRIO"], "echo", *arguments],
            env=robot.environment,
            stdout=self.output,
        )

    def lines(self):
        assert self.process.wait(timeout=PATIENCE) == 0
        self.output.seek(0)
        return [json.loads(line) for line in self.output]


def short_folder():
    return tempfile.TemporaryDirectory(prefix="r2-", dir="/dev/shm")


@pytest.fixture(scope="session")
def robot():
    """A robot that is published in DOMAIN on the loopback."""
    with short_folder() as folder:
        robot = Robot(folder)
        robot.start("simulate", "gateway", "estimator")
        robot.bridge()
        yield robot
        robot.end()


@pytest.fixture
def other_robot():
    """One of which nothing runs yet."""
    with short_folder() as folder:
        robot = Robot(folder)
        yield robot
        robot.end()


@pytest.fixture(scope="session")
def participant(robot):
    return DomainParticipant(DOMAIN)


class Subscription:
    """All messages of a topic since it was made."""

    def __init__(self, participant, topic, kind, **options):
        self.reader = network.subscribe(participant, topic, kind, **options)
        self.messages = []

    def take(self):
        """The messages that are new."""
        new = list(self.reader.take(N=10000))
        self.messages += new
        return new

    def first(self, patience=PATIENCE):
        return until("no message", self.take, patience)[0]

    def collect(self, seconds):
        """The messages of the next seconds."""
        before = len(self.messages)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.take()
            time.sleep(0.005)
        return self.messages[before:]


@pytest.fixture
def subscribe(participant):
    return lambda *arguments, **options: Subscription(participant, *arguments, **options)


class Diagnostics:
    """The newest level and text of each part of the robot."""

    def __init__(self, subscription):
        self.subscription = subscription

    def newest(self):
        self.subscription.take()
        if not self.subscription.messages:
            return {}
        statuses = self.subscription.messages[-1].status
        return {one.name.removeprefix(f"{ROBOT}: "): one for one in statuses}

    def level(self, part):
        status = self.newest().get(part)
        return None if status is None else ord(status.level) if isinstance(
            status.level, (bytes, str)
        ) else status.level


@pytest.fixture
def diagnostics(subscribe):
    return Diagnostics(subscribe("rt/diagnostics", DiagnosticArray))
