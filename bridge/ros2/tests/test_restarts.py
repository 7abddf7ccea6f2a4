"""Killed daemons, a damaged domain, and a bridge that is there before all of them."""

import math
import sys
import time
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "tests"))

from conftest import DOMAIN, ROBOT, Diagnostics, Subscription, until  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from damage import DAMAGES, segments  # noqa: E402
from messages import ERROR, OK, STALE, DiagnosticArray, JointState  # noqa: E402


def torques(states):
    """Whether a joint state with torques has come."""
    return any(not any(map(math.isnan, state.effort)) for state in states.take())


def killed(robot, states, diagnostics, name):
    """Kills a daemon; within 3 s no torque is published any more, and diagnostics say so. Starts it
    again, and torques return."""
    until("torques", lambda: torques(states))
    until("all is well", lambda: diagnostics.level(name) == OK)
    robot.kill(name)
    died = time.monotonic()
    until("diagnostics", lambda: diagnostics.level(name) in (ERROR, STALE), 3.0)
    time.sleep(max(0.0, died + 3.0 - time.monotonic()))
    states.take()
    assert not torques_within(states, 1.0)
    assert "no word" in diagnostics.newest()[name].message
    robot.start(name)
    until("torques again", lambda: torques(states))
    until("all is well again", lambda: diagnostics.level(name) == OK, 5.0)


def torques_within(states, seconds):
    return any(not all(map(math.isnan, state.effort)) for state in states.collect(seconds))


def test_a_killed_estimator(robot, subscribe, diagnostics):
    killed(robot, subscribe("rt/joint_states", JointState), diagnostics, "estimator")


def test_a_killed_gateway(robot, subscribe, diagnostics):
    states = subscribe("rt/joint_states", JointState)
    killed(robot, states, diagnostics, "gateway")
    assert diagnostics.level("device l_arm_ft_sensor") == OK


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_robot(robot, subscribe, damage):
    states = subscribe("rt/joint_states", JointState)
    until("torques", lambda: torques(states))
    daemons = ("estimator", "gateway")
    running = robot.running
    damage(robot.folder / robot.folder.name, running["bridge"], [running[it] for it in daemons])
    since = time.time() + 0.3

    def is_new(state):
        stamp = state.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec > since and not any(map(math.isnan, state.effort))

    def torques_again():
        robot.start(*(it for it in daemons if running[it].poll() is not None))
        return any(map(is_new, states.take()))

    until("torques again", torques_again)
    until("the old memory", lambda: not segments(running["bridge"], is_deleted=True))
    assert running["bridge"].poll() is None and "panicked" not in robot.said("bridge")


def test_the_bridge_may_be_first(other_robot):
    robot, domain = other_robot, DOMAIN + 6
    robot.bridge(domain=domain)
    participant = DomainParticipant(domain)
    states = Subscription(participant, "rt/joint_states", JointState)
    until("it waits", lambda: "waiting" in robot.said("bridge"))
    time.sleep(2.0)
    said = robot.said("bridge").splitlines()
    assert len(said) == len(set(said)) == 1, said
    robot.start("estimator")
    time.sleep(1.0)
    robot.start("gateway", "simulate")
    until("torques", lambda: torques(states))
    diagnostics = Diagnostics(Subscription(participant, "rt/diagnostics", DiagnosticArray))
    until("all is well", lambda: diagnostics.level("gateway") == OK)
    assert f"publishing {ROBOT}" in robot.said("bridge")
