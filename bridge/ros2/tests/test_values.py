"""What is published is what `proprio echo` prints, in ROS's types, with the wall clock's stamps."""

import itertools
import math
import time

from conftest import until
from messages import Imu, JointState, WrenchStamped

JOINTS = [
    f"l_{name}"
    for name in (
        "shoulder_pitch shoulder_roll shoulder_yaw elbow wrist_prosup wrist_pitch wrist_yaw"
    ).split()
]
# Both clocks cannot be read at once [s].
SAME = 50e-6


def wall(t_ns):
    """The wall clock's time of an instant of CLOCK_MONOTONIC [s]."""
    offset = time.time_ns() - time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    return (t_ns + offset) * 1e-9


def pairs(messages, lines):
    """Messages with the lines of the same instant; at least most of the lines have one."""
    found, place = [], 0
    for line in lines:
        t = wall(line["t_ns"])
        while place < len(messages) and messages[place].header.time() < t - SAME:
            place += 1
        near = itertools.takewhile(lambda m: m.header.time() < t + SAME, messages[place:])
        # On a busy machine two samples may have come together.
        nearest = min(near, key=lambda m: abs(m.header.time() - t), default=None)
        if nearest is not None:
            found.append((nearest, line))
    assert len(found) > 0.9 * len(lines), f"{len(found)} of {len(lines)}"
    return found


def together(robot, subscription, *arguments, count):
    """What a topic and `proprio echo` say of the same instants."""
    subscription.first()
    echo = robot.echo(*arguments, count=count)
    while echo.process.poll() is None:
        subscription.collect(0.1)
    lines = echo.lines()
    subscription.collect(0.5)
    return pairs(subscription.messages, lines)


def is_same(value, printed):
    return math.isnan(value) if printed is None else value == printed


def test_efforts_are_torques(robot, subscribe):
    states = subscribe("rt/joint_states", JointState)
    until("a torque", lambda: any(not math.isnan(s.effort[0]) for s in states.take()))
    valid = 0
    for state, line in together(robot, states, "--torques", count=1000):
        assert state.header.frame_id == ""
        assert state.name == JOINTS
        assert set(line["torques"]) == set(JOINTS)
        for joint, effort in zip(state.name, state.effort):
            torque = line["torques"][joint]
            assert is_same(effort, torque["torque"]), (joint, effort, torque)
            valid += torque["valid"]
    assert valid > 3000


def test_positions_are_those_of_the_encoders(robot, subscribe):
    states = subscribe("rt/joint_states", JointState)
    states.first()
    echo = robot.echo("l_elbow", count=100)
    while echo.process.poll() is None:
        states.collect(0.1)
    values = [line["values"] for line in echo.lines() if line["kind"] == "joint"]
    readings = [(reading["position"], reading["velocity"]) for reading in values]
    states.collect(0.5)
    elbow = JOINTS.index("l_elbow")
    published = {(state.position[elbow], state.velocity[elbow]) for state in states.messages}
    assert len(set(readings)) > 10
    missing = [reading for reading in readings if reading not in published]
    assert len(missing) < 0.1 * len(readings), missing


def test_ft_is_what_the_sensor_reports(robot, subscribe):
    wrenches = subscribe("rt/ft/l_arm_ft_sensor", WrenchStamped)
    for message, line in together(robot, wrenches, "l_arm_ft_sensor", count=1000):
        assert message.header.frame_id == "l_arm_ft_sensor"
        names = ["fx", "fy", "fz", "tx", "ty", "tz"]
        assert message.wrench.values() == [line["values"][name] for name in names]


def test_imu_is_what_the_sensor_reports(robot, subscribe):
    readings = subscribe("rt/imu/chest_imu", Imu)
    for message, line in together(robot, readings, "chest_imu", count=100):
        values = line["values"]
        assert message.header.frame_id == "chest_imu"
        assert message.angular_velocity.values() == [values[name] for name in ("gx", "gy", "gz")]
        assert message.linear_acceleration.values() == [values[name] for name in ("ax", "ay", "az")]
        # This one has no orientation.
        assert values["qw"] is None
        assert message.orientation_covariance[0] == -1.0
        assert message.orientation.w == 1.0


def test_contacts_are_those_that_are_valid(robot, subscribe):
    stand = subscribe("rt/contact/stand", WrenchStamped)
    for message, line in together(robot, stand, "--contacts", count=500):
        contact = line["contacts"]["stand"]
        assert contact["valid"]
        assert message.header.frame_id == "chest"
        assert message.wrench.values() == contact["force"] + contact["torque"]


def test_an_external_wrench_is_the_push(robot, subscribe):
    """The hand is pushed with up to 10 N for 4 s of every 20 s, and the estimator detects it."""
    external = subscribe("rt/external/l_upper_arm", WrenchStamped)
    hand = subscribe("rt/contact/hand", WrenchStamped)

    def size(message):
        return math.hypot(*message.wrench.force.values())

    assert external.first().header.frame_id == "l_upper_arm"
    # A whole push, not the rest of one.
    until("no push", lambda: any(size(message) < 1.5 for message in external.take()), 20.0)
    until("a push", lambda: any(size(message) > 4.0 for message in hand.take()), 40.0)
    for _ in range(10):
        external.collect(0.5)
        hand.take()
    pushes = {str(message.header.stamp): message for message in hand.messages}
    compared = 0
    for message in external.messages:
        push = pushes.get(str(message.header.stamp))
        if push is not None and size(push) > 4.0:
            # The same force in other axes, but for what the contact leaves unexplained.
            assert abs(size(message) - size(push)) < 0.25 * size(push) + 0.5
            compared += 1
    assert compared > 10
    # On a busy machine samples come late, and single residuals are large.
    sizes = sorted(size(message) for message in external.messages)
    largest = sizes[-1 - len(sizes) // 50]
    assert 6.0 < largest < 12.0, largest
    # Without a push: the weight of the arm and the offset of 13 N are taken off.
    quiet = sorted(size(message) for message in external.messages)[len(external.messages) // 10]
    assert quiet < 1.5, quiet


def test_stamps_are_fresh(robot, subscribe):
    for topic, kind in [
        ("rt/joint_states", JointState),
        ("rt/ft/l_arm_ft_sensor", WrenchStamped),
        ("rt/imu/chest_imu", Imu),
    ]:
        subscription = subscribe(topic, kind)
        subscription.first()
        ages = []
        for _ in range(200):
            now = time.time()
            ages += [now - message.header.time() for message in subscription.take()[-1:]]
            time.sleep(0.005)
        ages.sort()
        assert len(ages) > 50
        assert ages[0] > -0.001, "a stamp of the future"
        assert ages[len(ages) // 2] < 0.05, (topic, ages[len(ages) // 2])
