"""The reader beside live daemons, which are killed and started again."""

import json
import subprocess
import sys
import threading
import time

import numpy as np
import proprio
import pytest
from conftest import ROBOT, TREE, until


def torque_of(robot, joint):
    def ask():
        robot.wait_for_estimate(0.5)
        return robot.torque(joint)

    return until(f"a torque of {joint}", ask)


def test_before_anybody_is_there(tmp_path):
    with proprio.RobotReader(ROBOT, runtime_dir=str(tmp_path), domain="empty") as robot:
        began = proprio.now()
        assert not robot.wait_for_estimate(0.05)
        assert proprio.now() - began >= 0.05
        why = robot.torque("l_elbow")
        assert not why and (why.status, why.reason, str(why)) == ("never_seen", None, "never seen")
        assert robot.torque_names() == [] and robot.torques().names == ()
        missing = robot.who_is_missing()
        assert (missing.gateway, missing.is_nobody) == ("not_started", False)
        until("the reason", lambda: "no gateway or estimator" in robot.who_is_missing().text)
    assert robot.torque("l_elbow").status == "unknown"
    with pytest.raises(ValueError, match="max_age"):
        proprio.RobotReader(ROBOT, max_age=float("nan"))


def test_values_and_reasons(arm):
    with arm.reader() as robot:
        torque_of(robot, "l_elbow")
        names = robot.torque_names()
        assert len(names) == 7 and names[3] == "l_elbow"
        assert robot.contact_names() == ["stand", "hand"]
        assert (proprio.WRENCH, "l_arm_ft_sensor") in robot.channel_names()

        torque = torque_of(robot, "l_elbow")
        all = robot.torques()
        assert all.names == tuple(names) and all.torque.dtype == np.float64
        assert (all.torque[3], all.standard_deviation[3]) == (
            torque.torque,
            torque.standard_deviation,
        )
        assert abs(torque.torque) < 20 and 0 < torque.standard_deviation < 5
        assert 0 <= torque.age < 0.05 and all.available[3]
        # In the caller's order, with one that nobody has.
        two = robot.torques(["nobody", "l_elbow"])
        assert np.isnan(two.torque[0]) and two.torque[1] == torque.torque
        assert list(two.available) == [False, True]
        assert str(robot.torque("nobody")) == "unknown name"

        until("an encoder", lambda: robot.update() or robot.joint("l_elbow"))
        imu = until("an IMU", lambda: robot.update() or robot.imu("chest_imu"))
        assert abs(np.linalg.norm(imu.proper_acceleration) - 9.81) < 2
        assert imu.orientation.shape == (4,)
        wrench = until("a wrench", lambda: robot.update() or robot.wrench("l_arm_ft_sensor"))
        assert wrench.force.shape == (3,) and 0 <= wrench.age < 1
        contact = robot.contact("hand")
        assert contact or contact.reason == "absent"


def test_a_sample_is_what_the_command_echoes(arm):
    echo = subprocess.Popen(
        [str(proprio.program()), "echo", "l_arm_ft_sensor", "--json"],
        env=arm.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    with arm.reader() as robot:
        seen = set()
        end = time.monotonic() + 5
        while len(seen) < 200 and time.monotonic() < end:
            robot.wait_for_sample(0.1)
            wrench = robot.wrench("l_arm_ft_sensor")
            if wrench:
                seen.add(tuple(wrench.force) + tuple(wrench.torque))
    echo.terminate()
    echoed = set()
    for line in echo.communicate()[0].splitlines():
        values = json.loads(line)["values"]
        echoed.add(tuple(values[axis] for axis in ("fx", "fy", "fz", "tx", "ty", "tz")))
    assert len(seen & echoed) > 0.5 * len(seen) > 10


def test_other_threads_run_while_one_waits(arm):
    counted = [0]
    stop = threading.Event()

    def count():
        while not stop.is_set():
            counted[0] += 1

    with proprio.RobotReader("nobody", runtime_dir=arm.runtime_dir, domain=arm.domain) as robot:
        thread = threading.Thread(target=count)
        thread.start()
        robot.wait_for_estimate(0.3)
        before = counted[0]
        robot.wait_for_estimate(0.3)
        assert counted[0] > before
        stop.set()
        thread.join()


@pytest.mark.parametrize("name", ["estimator", "gateway"])
def test_a_killed_daemon_is_missed_and_found_again(arm, name):
    with arm.reader() as robot:
        torque_of(robot, "l_elbow")
        arm.kill(name)
        until("the loss", lambda: getattr(robot.who_is_missing(), name) == "killed")

        def stale():
            robot.update()
            torque = robot.torque("l_elbow")
            return not torque and torque.status == "stale" and torque.age > 0.05

        until("old torques", stale)
        arm.start(name)
        torque_of(robot, "l_elbow")
        until("both", lambda: robot.who_is_missing().is_nobody)


@pytest.mark.parametrize("page", ["python/README.md", "docs/reading.md"])
def test_the_pages_first_program(arm, page):
    program = (TREE / page).read_text().split("```python\n")[1].split("```")[0]
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=arm.environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert " +- " in done.stdout and "torque" in done.stdout, done.stdout
