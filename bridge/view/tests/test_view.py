"""proprio-view beside a simulated robot: what a client of Foxglove's protocol is told."""

import json
import math
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import pytest
from client import Client
from robot import PROPRIO, ROOT, VIEW, Robot

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from damage import DAMAGES, segments  # noqa: E402

JOINTS = [
    "l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw", "l_elbow",
    "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw",
]  # fmt: skip
OK, STALE = 0, 3


@pytest.fixture(scope="module")
def robot():
    robot = Robot()
    try:
        # The viewer first: it waits for the robot, says so once, and finds it.
        robot.viewer = robot.view("--config", robot.config / "estimator.toml", "--rate", 200)
        robot.said(robot.viewer, "waiting for a robot: ")
        with Client(robot.viewer.port) as client:
            status = client.wait("/diagnostics", 3.0).message.status
            assert {one.name: level(one) for one in status} == {
                "icub_left_arm: gateway": STALE,
                "icub_left_arm: estimator": STALE,
            }
        time.sleep(1.2)
        assert robot.viewer.log.read_text().count("waiting") == 1
        robot.simulate()
        robot.nerves = robot.gateway()
        robot.brain = robot.estimator()
        robot.said(robot.viewer, "showing icub_left_arm", 20.0)
        yield robot
        assert robot.viewer.poll() is None, robot.viewer.log.read_text()
    finally:
        robot.end()


@pytest.fixture
def client(robot):
    with Client(robot.viewer.port) as client:
        client.wait("/torques", 20.0, lambda it: all(it.valid))
        yield client


def level(status):
    byte = status.level
    return byte[0] if isinstance(byte, bytes) else byte


def seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def test_topics_and_their_types(robot):
    with Client(robot.viewer.port, ["*"]) as client:
        client.collect(1.5)
        assert client.info["name"] == "proprio-view"
        found = {topic: channel["schemaName"] for topic, channel in client.channels.items()}
    expected = {
        "/torques": "proprio_msgs/msg/Torques",
        "/contacts": "proprio_msgs/msg/Contacts",
        "/joint_states": "sensor_msgs/msg/JointState",
        "/ft/l_arm_ft_sensor": "geometry_msgs/msg/WrenchStamped",
        "/imu/chest_imu": "sensor_msgs/msg/Imu",
        "/samples/wrench/l_arm_ft_sensor": "proprio_msgs/msg/Wrench",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
        "/robot_description": "std_msgs/msg/String",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/contact_arrows": "foxglove.SceneUpdate",
    } | {f"/torque/{joint}": "proprio_msgs/msg/JointTorque" for joint in JOINTS}
    assert {topic: found.get(topic) for topic in expected} == expected


def same(number, told):
    """Whether JSON tells this number: it has null for what is not one."""
    return math.isnan(number) if told is None else number == told


def test_torques_are_those_of_echo_and_their_bands_two_deviations(robot, client):
    echo = robot.start(PROPRIO, "echo", "--torques", "--json")
    robot.said(echo, "{")
    client.subscribe("/torque/l_elbow")
    received = client.collect(2.0)
    echo.terminate()
    echo.wait()
    lines = [line for line in echo.log.read_text().splitlines() if line.endswith("}")]
    told = {line["t_ns"]: line["torques"] for line in map(json.loads, lines)}
    compared = Counter()
    for one in received:
        message = one.message
        if one.topic == "/torques" and (expected := told.get(message.acquired)):
            assert list(message.joint) == JOINTS
            for number, joint in enumerate(JOINTS):
                assert same(message.torque[number], expected[joint]["torque"])
                assert same(message.standard_deviation[number], expected[joint]["std"])
                assert message.valid[number] == expected[joint]["valid"]
        elif one.topic == "/torque/l_elbow" and (expected := told.get(message.acquired)):
            elbow = expected["l_elbow"]
            if elbow["torque"] is None:  # on a machine that has stalled
                assert math.isnan(message.torque) and not message.valid
                continue
            assert message.torque == elbow["torque"]
            assert message.lower == pytest.approx(elbow["torque"] - 2 * elbow["std"], rel=1e-12)
            assert message.upper == pytest.approx(elbow["torque"] + 2 * elbow["std"], rel=1e-12)
            assert (message.valid, message.reason, message.cause) == (True, "", "")
        else:
            continue
        compared[one.topic] += 1
    assert compared["/torques"] > 50 and compared["/torque/l_elbow"] > 50


def test_stamps_are_the_wall_clocks(client):
    client.subscribe("/joint_states", "/tf", "/torques", "/ft/l_arm_ft_sensor")
    stamped = Counter()
    for one in client.collect(1.0):
        wall, monotonic = time.time(), time.monotonic_ns()
        if one.topic == "/torques":
            # Of the machine's start: the instant of the measurement itself.
            assert -0.01 < 1e-9 * (monotonic - one.message.acquired) < 1.5
            continue
        headers = {
            "/tf": lambda it: [transform.header for transform in it.transforms],
        }.get(one.topic, lambda it: [it.header])(one.message)
        for header in headers:
            stamp = seconds(header.stamp)
            assert stamp == pytest.approx(1e-9 * one.log_time, abs=1e-6)
            assert -0.01 < wall - stamp < 1.5, "messages waited for a second at most"
        stamped[one.topic] += 1
    assert len(stamped) == 3 and min(stamped.values()) > 20


def test_no_topic_is_faster_than_the_rate(robot):
    # Slower than shared memory is looked into.
    viewer = robot.view("--rate", 20)
    with Client(viewer.port, ["*"]) as client:
        client.wait("/torques", 10.0)
        client.collect(0.5)
        received = client.collect(3.0)
    counts = Counter(one.topic for one in received)
    assert counts["/torques"] > 45, counts  # of 3000
    assert max(counts.values()) <= 62, counts
    times = [one.log_time for one in received if one.topic == "/torques"]
    assert times == sorted(times)


# ---------------------------------------------------------------- the model


def matrix(rotation, translation):
    return [[*row, it] for row, it in zip(rotation, translation)]


def product(a, b):
    rotation = [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    shift = [sum(a[i][k] * b[k][3] for k in range(3)) + a[i][3] for i in range(3)]
    return matrix(rotation, shift)


def about(axis, angle):
    """The rotation about an axis, by Rodrigues' formula."""
    norm = math.sqrt(sum(it * it for it in axis))
    x, y, z = (it / norm for it in axis)
    c, s, v = math.cos(angle), math.sin(angle), 1 - math.cos(angle)
    return matrix(
        [
            [c + x * x * v, x * y * v - z * s, x * z * v + y * s],
            [y * x * v + z * s, c + y * y * v, y * z * v - x * s],
            [z * x * v - y * s, z * y * v + x * s, c + z * z * v],
        ],
        [0, 0, 0],
    )


def joints_of(file):
    """Per child link of a URDF: parent, place, axis (none if fixed) and name of its joint."""
    joints = {}
    for joint in ElementTree.parse(file).getroot().iter("joint"):
        origin = joint.find("origin")
        xyz, rpy = ([float(it) for it in origin.get(key).split()] for key in ("xyz", "rpy"))
        place = matrix([[1, 0, 0], [0, 1, 0], [0, 0, 1]], xyz)
        for axis, angle in zip(([0, 0, 1], [0, 1, 0], [1, 0, 0]), reversed(rpy)):
            place = product(place, about(axis, angle))
        axis = joint.find("axis")
        axis = None if axis is None else [float(it) for it in axis.get("xyz").split()]
        child, parent = joint.find("child").get("link"), joint.find("parent").get("link")
        joints[child] = parent, place, axis, joint.get("name")
    return joints


def pose(transform):
    q, t = transform.rotation, transform.translation
    x, y, z, w = q.x, q.y, q.z, q.w
    return matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        [t.x, t.y, t.z],
    )


def apart(a, b):
    return max(abs(x - y) for rows in zip(a, b) for x, y in zip(*rows))


def test_a_moving_joint_moves_its_link(robot, client):
    topic = "/samples/joint/l_elbow"
    client.subscribe("/tf", *(f"/samples/joint/{joint}" for joint in JOINTS))
    received = client.collect(4.0)
    joints = joints_of(robot.config / "model.urdf")
    samples = {joint: [] for joint in JOINTS}
    for one in received:
        if one.topic.startswith("/samples/joint/"):
            samples[one.topic.rsplit("/", 1)[1]].append((one.log_time, one.message.position))
    positions = [position for _, position in samples["l_elbow"]]
    assert max(positions) - min(positions) > 0.05, f"{topic} does not move"
    tfs = [one for one in received if one.topic == "/tf"]
    exact, links = Counter(), set()
    for one in tfs:
        by_child = {it.child_frame_id: it for it in one.message.transforms}
        assert by_child.keys() == joints.keys()
        for child, (parent, place, axis, joint) in joints.items():
            assert by_child[child].header.frame_id == parent
            found = pose(by_child[child].transform)
            if axis is None:
                assert apart(found, place) < 1e-9, child
                continue
            # The joint's samples about then: one of them is where the transform was made from.
            near = [q for t, q in samples[joint] if abs(t - one.log_time) < 30_000_000]
            errors = [apart(found, product(place, about(axis, q))) for q in near]
            assert not errors or min(errors) < 0.05, (child, errors)
            exact[child] += bool(errors) and min(errors) < 1e-9
            links.add(child)
    assert len(links) == len(JOINTS) and len(tfs) > 200
    assert min(exact.values()) > 0.5 * len(tfs), (exact, len(tfs))


def test_whoever_comes_late_gets_the_urdf(robot, client):
    text = (robot.config / "model.urdf").read_text()
    assert client.wait("/robot_description", 2.0).message.data == text
    with Client(robot.viewer.port) as second:
        assert second.wait("/robot_description", 2.0).message.data == text
        assert second.wait("/tf", 2.0).message.transforms
        # Both are served, and neither gets the other's.
        assert client.wait("/torques", 2.0) and second.wait("/torques", 2.0)
        assert all(one.topic != "/robot_description" for one in client.collect(0.5))


# ---------------------------------------------------------------- contacts


def test_a_detected_push_has_an_arrow_while_it_lasts(client):
    """The simulator pushes the hand with up to 10 N for 4 s of every 20 s."""
    client.subscribe("/contacts")
    pushed, contacts = None, {}
    end = time.monotonic() + 45
    is_over = False
    while time.monotonic() < end and not is_over:
        one = client.receive(1.0)
        if one is not None and one.topic == "/contacts":
            contacts[one.message.acquired] = one.message.contacts
            client.subscribe("/contact_arrows")
        if one is None or one.topic != "/contact_arrows":
            continue
        scene = one.message
        arrows = {entity.id: entity for entity in scene.entities}
        gone = {deletion.id for deletion in scene.deletions}
        # All is said in each message, so that a lost one does no harm.
        assert arrows.keys() | gone == {"stand", "hand"} and not arrows.keys() & gone
        if "hand" in arrows and arrows["hand"].arrows[0].shaft_length > 0.01:
            pushed = arrows["hand"], one.log_time
        is_over = pushed is not None and "hand" in gone
    assert pushed, "no arrow"
    assert is_over, "the arrow stays"
    entity, log_time = pushed
    assert entity.frame_id == "l_hand" and entity.frame_locked
    assert 0 < entity.lifetime.seconds + 1e-9 * entity.lifetime.nanos < 1
    assert entity.timestamp.seconds * 10**9 + entity.timestamp.nanos == log_time
    offset = time.time_ns() - time.monotonic_ns()
    nearest = min(contacts, key=lambda t: abs(t + offset - log_time))
    (hand,) = (it for it in contacts[nearest] if it.name == "hand")
    assert hand.valid and hand.frame == "l_hand"
    force = math.hypot(*hand.force)
    (arrow,) = entity.arrows
    # The force changes a little from one estimate to the next.
    assert arrow.shaft_length + arrow.head_length == pytest.approx(0.002 * force, rel=0.1)
    q = arrow.pose.orientation
    x = [
        1 - 2 * (q.y * q.y + q.z * q.z),
        2 * (q.x * q.y + q.w * q.z),
        2 * (q.x * q.z - q.w * q.y),
    ]
    assert sum(a * f for a, f in zip(x, hand.force)) > 0.97 * force


# ---------------------------------------------------------------- processes that end


def test_a_killed_estimator_is_told_and_its_torques_return(robot, client):
    def estimator(message):
        (status,) = (it for it in message.status if it.name.endswith(": estimator"))
        return level(status)

    client.wait("/diagnostics", 3.0, lambda it: estimator(it) == OK)
    robot.brain.kill()
    robot.brain.wait()
    message = client.wait("/diagnostics", 3.0, lambda it: estimator(it) == STALE).message
    levels = {status.name: level(status) for status in message.status}
    assert levels["icub_left_arm: gateway"] == OK
    assert all(one.topic != "/torques" for one in client.collect(0.5))
    robot.brain = robot.estimator()
    client.wait("/torques", 10.0, lambda it: all(it.valid))
    client.wait("/diagnostics", 3.0, lambda it: estimator(it) == OK)
    assert client.wait("/torque/l_elbow", 1.0).message.valid


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_robot_is_shown_again(robot, client, damage):
    damage(robot.folder / robot.domain, robot.viewer, [robot.brain, robot.nerves])
    since, end = time.monotonic_ns() + 300_000_000, time.monotonic() + 60
    client.subscribe("/torques")
    while time.monotonic() < end:
        if robot.brain.poll() is not None:
            robot.brain = robot.estimator()
        if robot.nerves.poll() is not None:
            robot.nerves = robot.gateway()
        one = client.receive(0.1)
        if one and one.topic == "/torques" and one.message.acquired > since:
            # What it held of the old domain is given back.
            if all(one.message.valid) and not segments(robot.viewer, is_deleted=True):
                break
    else:
        raise AssertionError("no torques any more")
    assert "panicked" not in robot.viewer.log.read_text()


def test_a_client_that_does_not_read_costs_nothing(robot):
    def resident():
        fields = open(f"/proc/{robot.viewer.pid}/status").read()
        (line,) = (line for line in fields.splitlines() if line.startswith("VmRSS"))
        return int(line.split()[1])  # [KiB]

    with Client(robot.viewer.port, ["*"]) as slow, Client(robot.viewer.port) as other:
        slow.collect(1.0)  # subscribes to everything, and reads no more
        other.wait("/torques", 3.0)
        time.sleep(4.0)
        before = resident()
        other.collect(4.0)
        assert resident() - before < 2048
        assert other.wait("/torques", 1.0)


def test_without_a_model_everything_else_is_shown(robot):
    viewer = robot.view()
    with Client(viewer.port) as client:
        client.wait("/torques", 10.0, lambda it: all(it.valid))
        assert client.wait("/contact_arrows", 2.0).message.entities
        assert not client.channels.keys() & {"/tf", "/robot_description"}
        assert client.info["capabilities"] == []


def test_meshes_come_from_their_folder_alone(robot):
    share = robot.folder / "share"
    (share / "arm" / "meshes").mkdir(parents=True)
    (share / "arm" / "meshes" / "hand.stl").write_bytes(b"solid hand")
    viewer = robot.view("--urdf", robot.config / "model.urdf", "--meshes", share)
    with Client(viewer.port) as client:
        assert client.fetch("package://arm/meshes/hand.stl") == b"solid hand"
        outside = client.fetch("package://arm/../../arm/model.urdf")
        assert outside.endswith("no folder of --meshes holds it")


# ---------------------------------------------------------------- wrong commands


def test_what_is_wrong_is_said(robot):
    taken = robot.run(VIEW, "--port", robot.viewer.port)
    assert taken.returncode == 1
    assert "another program may serve there (--port)" in taken.stderr
    missing = robot.run(VIEW, "--config", robot.folder / "nothing.toml")
    assert missing.returncode == 2 and "nothing.toml: cannot be read" in missing.stderr
    no_urdf = robot.run(VIEW, "--urdf", robot.config / "gateway.toml")
    assert no_urdf.returncode == 2 and "gateway.toml: " in no_urdf.stderr
    assert robot.run(VIEW, "--rate", "0").returncode == 2


# ---------------------------------------------------------------- the layout


def test_the_layout_shows_topics_and_fields_that_there_are(client):
    layout = json.loads((ROOT / "bridge" / "view" / "layout.json").read_text())
    panels = layout["configById"]

    def leaves(tree):
        if isinstance(tree, str):
            return [tree]
        return leaves(tree["first"]) + leaves(tree["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    shown = set()
    for name, panel in panels.items():
        shown |= set(panel.get("topics", {}))
        shown |= {panel[key] for key in ("topicToRender", "topicPath") if key in panel}
        for path in panel.get("paths", []):
            topic, *fields = path["value"].split(".")
            value = client.wait(topic, 30.0).message  # the hand's: only while it is pushed
            for field in fields:
                value = getattr(value, field)
            assert isinstance(value, float), (name, path)
    assert shown <= client.channels.keys()
    frames = {it.header.frame_id for it in client.wait("/tf").message.transforms}
    assert panels["3D!model"]["followTf"] in frames
