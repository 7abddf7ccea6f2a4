"""The reader beside live daemons, which are killed and started again."""

import json
import signal
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
    robot.close()
    for use in (robot.update, robot.torques, robot.who_is_missing, lambda: robot.imu("a")):
        with pytest.raises(ValueError, match="closed"):
            use()
    with pytest.raises(ValueError, match="closed"):
        robot.wait_for_estimate(10)
    with pytest.raises(ValueError, match="max_age"):
        proprio.RobotReader(ROBOT, max_age=float("nan"))
    with proprio.RobotReader(ROBOT, runtime_dir=tmp_path) as robot:
        with pytest.raises(TypeError, match="list of names"):
            robot.torques("l_elbow")
        with pytest.raises(ValueError, match="no name"):
            robot.torque("l_elbow\0x")


def test_ctrl_c_ends_a_wait(tmp_path):
    # A shell that starts the tests in the background has made them ignore Ctrl-C.
    program = """
import proprio, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
with proprio.RobotReader("nobody", runtime_dir=sys.argv[1]) as robot:
    print("waits", flush=True)
    robot.wait_for_estimate(1e9)
"""
    command = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as waiting:
        try:
            waiting.stdout.readline()
            waiting.send_signal(signal.SIGINT)
            assert b"KeyboardInterrupt" in waiting.communicate(timeout=60)[1]
        finally:
            waiting.kill()


def test_values_and_reasons(arm):
    with arm.reader() as robot:
        torque_of(robot, "l_elbow")
        names = robot.torque_names()
        assert len(names) == 7 and names[3] == "l_elbow"
        assert robot.contact_names() == ["stand", "hand"]
        channels = until("names", lambda: robot.update() or robot.channel_names())
        assert (proprio.WRENCH, "l_arm_ft_sensor") in channels

        torque = torque_of(robot, "l_elbow")
        all = robot.torques()
        assert all.names == tuple(names) and all.torque.dtype == np.float64
        assert (all.torque[3], all.standard_deviation[3]) == (
            torque.torque,
            torque.standard_deviation,
        )
        assert abs(torque.torque) < 20 and 0 < torque.standard_deviation < 5
        assert 0 <= torque.age < 0.05 and all.available[3]
        # The same instant for as long as nothing new comes; later ones afterwards.
        assert torque.acquired == all.acquired == robot.torque("l_elbow").acquired
        assert 0 < proprio.now() - torque.acquired < 60
        assert torque_of(robot, "l_elbow").acquired > torque.acquired
        # In the caller's order, with one that nobody has.
        two = robot.torques(["nobody", "l_elbow"])
        assert np.isnan(two.torque[0]) and abs(two.torque[1] - torque.torque) < 5
        assert list(two.available) == [False, True]
        assert str(robot.torque("nobody")) == "unknown name"

        until("an encoder", lambda: robot.update() or robot.joint("l_elbow"))
        imu = until("an IMU", lambda: robot.update() or robot.imu("chest_imu"))
        assert abs(np.linalg.norm(imu.proper_acceleration) - 9.81) < 2
        assert imu.orientation.shape == (4,)
        wrench = until("a wrench", lambda: robot.update() or robot.wrench("l_arm_ft_sensor"))
        assert wrench == wrench and wrench != robot.wrench("l_arm_ft_sensor")
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


def test_other_threads_run_while_one_waits(tmp_path):
    ticks, stop = [], threading.Event()

    def tick():
        while not stop.is_set():
            ticks.append(time.monotonic())
            time.sleep(0.001)

    with proprio.RobotReader("nobody", runtime_dir=tmp_path) as robot:
        thread = threading.Thread(target=tick)
        thread.start()
        # One wait of C, which Python does not interrupt.
        began = time.monotonic()
        robot.wait_for_estimate(0.09)
        ended = time.monotonic()
        stop.set()
        thread.join()
    inside = [t for t in ticks if began + 0.02 < t < ended - 0.02]
    assert len(inside) >= 2, (began, ended, len(ticks))


def test_threads_may_share_a_reader(arm):
    robot = arm.reader()
    torque_of(robot, "l_elbow")
    failures = []

    def use(number):
        try:
            for turn in range(300):
                robot.update()
                robot.torque(f"joint_{number}_{turn}")
                robot.torques(["l_elbow", f"joint_{number}_{turn}"])
        except Exception as failure:
            failures.append(failure)

    threads = [threading.Thread(target=use, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures and torque_of(robot, "l_elbow")
    waiting = threading.Thread(target=lambda: pytest.raises(ValueError, robot.wait_for_sample, 60))
    waiting.start()
    robot.close()
    waiting.join(60)
    assert not waiting.is_alive()


@pytest.mark.parametrize("name", ["estimator", "gateway"])
def test_a_killed_daemon_is_missed_and_found_again(arm, name):
    with arm.reader() as robot:
        torque_of(robot, "l_elbow")
        # Who has not been seen alive is not missed.
        until("both", lambda: robot.who_is_missing().is_nobody)
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


@pytest.mark.parametrize("page", ["python/README.md", "docs/book/src/read/python.md"])
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
