"""Who finds the node and its topics, with which quality of service, and from where."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import DOMAIN, ROBOT, Subscription, until
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import InstanceState, Policy
from cyclonedds.domain import DomainParticipant
from messages import Imu, JointState, ParticipantEntitiesInfo, WrenchStamped

LISTEN = str(Path(__file__).with_name("listen.py"))


class Publications:
    """The writers that are there, by topic."""

    def __init__(self, participant):
        self.reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        self.there = {}

    def find(self):
        for one in self.reader.take(N=1000):
            if one.sample_info.instance_state == InstanceState.Alive:
                self.there[str(one.key)] = one
            else:
                self.there.pop(str(one.key), None)
        return {one.topic_name: one for one in self.there.values()}


TYPES = {
    "rt/joint_states": "sensor_msgs::msg::dds_::JointState_",
    "rt/imu/chest_imu": "sensor_msgs::msg::dds_::Imu_",
    "rt/ft/l_arm_ft_sensor": "geometry_msgs::msg::dds_::WrenchStamped_",
    "rt/contact/stand": "geometry_msgs::msg::dds_::WrenchStamped_",
    "rt/external/l_upper_arm": "geometry_msgs::msg::dds_::WrenchStamped_",
    "rt/diagnostics": "diagnostic_msgs::msg::dds_::DiagnosticArray_",
}


def test_topics_have_the_types_and_the_quality_of_ros(robot, participant):
    publications = Publications(participant)
    until("all topics", lambda: set(TYPES) <= set(publications.find()))
    found = publications.find()
    # Only what every installation of ROS knows.
    ours = {name: one for name, one in found.items() if name.startswith("rt/")}
    assert not any("proprio" in one.type_name for one in ours.values())
    for topic, kind in TYPES.items():
        assert found[topic].type_name == kind
        qos = found[topic].qos
        assert isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable)
        assert qos[Policy.Durability] == Policy.Durability.Volatile


def test_the_node_is_in_the_graph(robot, participant, subscribe):
    publications = Publications(participant)
    until("all topics", lambda: set(TYPES) <= set(publications.find()))
    graph = subscribe("ros_discovery_info", ParticipantEntitiesInfo, durable=True)

    def nodes():
        graph.take()
        return graph.messages and graph.messages[-1].node_entities_info_seq

    [node] = until("the node", nodes)
    assert (node.node_namespace, node.node_name) == ("/", "proprio_ros2")

    def agree():
        writers = {
            one.key.bytes
            for topic, one in publications.find().items()
            if topic.startswith("rt/")
        }
        [node] = nodes()
        return writers == {bytes(gid.data) for gid in node.writer_gid_seq}

    # Topics of contacts come to be with the first contact.
    until("each writer is the node's", agree, 5.0)
    assert node.reader_gid_seq == []


@pytest.mark.parametrize("reliable", [True, False])
def test_reliable_and_best_effort_readers_are_served(subscribe, reliable):
    subscription = subscribe("rt/joint_states", JointState, reliable=reliable)
    subscription.first(10.0)
    assert len(subscription.collect(1.0)) > 500


def test_a_late_reader_gets_what_comes_then(subscribe):
    time.sleep(1.0)
    began = time.time()
    subscription = subscribe("rt/imu/chest_imu", Imu)
    assert subscription.first(5.0).header.time() > began - 0.5
    assert time.time() - began < 5.0


def test_a_reader_that_hangs_stops_nobody(robot, subscribe):
    topic = "rt/ft/l_arm_ft_sensor"
    hanging = subprocess.Popen(
        [sys.executable, LISTEN, str(DOMAIN), topic, "60"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert hanging.stdout.readline() == "listening\n"
        time.sleep(1.0)
        hanging.send_signal(signal.SIGSTOP)
        subscription = subscribe(topic, WrenchStamped)
        subscription.first(10.0)
        stamps = [message.header.time() for message in subscription.collect(8.0)]
    finally:
        hanging.kill()
        hanging.wait()
    assert len(stamps) > 3000
    assert max(after - before for before, after in zip(stamps, stamps[1:])) < 0.8


def test_options_and_the_end(robot):
    """A namespace, a rate, and no acknowledgements; after SIGTERM all is gone."""
    domain = DOMAIN + 1
    robot.bridge(
        "--namespace", "left/arm", "--rate", "50", "--best-effort", name="second", domain=domain
    )
    participant = DomainParticipant(domain)
    publications = Publications(participant)
    topic = "rt/left/arm/joint_states"
    until(topic, lambda: topic in publications.find())
    qos = publications.find()[topic].qos
    assert qos[Policy.Reliability] == Policy.Reliability.BestEffort
    refused = Subscription(participant, topic, JointState)
    states = Subscription(participant, topic, JointState, reliable=False)
    states.first(10.0)
    per_second = len(states.collect(4.0)) / 4.0
    assert 40.0 < per_second < 52.0, per_second
    assert refused.take() == []
    assert robot.kill("second", signal.SIGTERM) == 0
    until("it says goodbye", lambda: not publications.find(), 5.0)


def test_the_variables_of_ros_are_obeyed(robot):
    domain = DOMAIN + 2
    variables = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    robot.bridge(name="variables", domain=None, interface=None, variables=variables)
    Subscription(DomainParticipant(domain), "rt/imu/chest_imu", Imu).first(10.0)
    assert robot.kill("variables", signal.SIGTERM) == 0


@pytest.mark.parametrize(
    "arguments, text",
    [
        (["--namespace", "a-b"], "a namespace is names"),
        (["--interface", "none0"], "there is lo (127.0.0.1)"),
        (["--domain-id", "233"], "233 is not in 0..=232"),
        (["--rate", "0"], "messages per second"),
    ],
)
def test_wrong_options_are_refused(robot, arguments, text):
    ended = subprocess.run(
        [os.environ["PROPRIO_ROS2"], *arguments],
        env=robot.environment,
        stderr=subprocess.PIPE,
        text=True,
        timeout=20,
    )
    assert ended.returncode == 2
    assert text in ended.stderr


# ------------------------------------------------------------------------------ another machine

MULTICAST = """
<CycloneDDS><Domain Id="any">
  <General><Interfaces><NetworkInterface name="{name}"/></Interfaces></General>
</Domain></CycloneDDS>
"""


@pytest.fixture
def machine():
    """A network namespace with a cable to this one: its name, and the two ends of the cable."""
    number = os.getpid() % 10000
    name, here, there = f"proprio{number}", f"vp{number}a", f"vp{number}b"
    address = f"10.{200 + number % 50}.{number % 250}"
    commands = [
        ["ip", "netns", "add", name],
        ["ip", "link", "add", here, "type", "veth", "peer", "name", there, "netns", name],
        ["ip", "address", "add", f"{address}.1/24", "dev", here],
        ["ip", "link", "set", here, "up"],
        ["ip", "-n", name, "address", "add", f"{address}.2/24", "dev", there],
        ["ip", "-n", name, "link", "set", there, "up"],
        ["ip", "-n", name, "link", "set", "lo", "up"],
    ]
    if shutil.which("ip") is None:
        pytest.skip("no network namespace: iproute2 is not installed")
    try:
        for command in commands:
            made = subprocess.run(command, stderr=subprocess.PIPE, text=True)
            if made.returncode != 0:
                pytest.skip(f"no network namespace: {' '.join(command)}: {made.stderr.strip()}")
        yield name, here, there
    finally:
        for command in (["ip", "netns", "delete", name], ["ip", "link", "delete", here]):
            subprocess.run(command, stderr=subprocess.DEVNULL)


def heard_elsewhere(machine, domain, seconds):
    """How many messages a listener in the namespace gets."""
    name, _, there = machine
    output = subprocess.run(
        ["ip", "netns", "exec", name, sys.executable, LISTEN, str(domain),
         "rt/ft/l_arm_ft_sensor", str(seconds)],
        env=dict(os.environ, CYCLONEDDS_URI=MULTICAST.format(name=there)),
        stdout=subprocess.PIPE,
        text=True,
        timeout=seconds + 30,
        check=True,
    ).stdout
    count, *frame = output.splitlines()[-1].split()
    return int(count), frame


def test_another_machine_listens(robot, machine):
    robot.bridge(name="cable", domain=DOMAIN + 3, interface=machine[1])
    count, frame = heard_elsewhere(machine, DOMAIN + 3, 6.0)
    assert robot.kill("cable", signal.SIGTERM) == 0
    assert count > 1000 and frame == ["l_arm_ft_sensor"]


def test_the_loopback_is_this_machine_alone(robot, machine):
    robot.bridge(name="inside", domain=DOMAIN + 4, interface="lo")
    count, _ = heard_elsewhere(machine, DOMAIN + 4, 4.0)
    Subscription(DomainParticipant(DOMAIN + 4), "rt/imu/chest_imu", Imu).first(10.0)
    assert robot.kill("inside", signal.SIGTERM) == 0
    assert count == 0


def test_the_robot_may_be_named(robot):
    robot.bridge("--robot", "nobody", name="nobody", domain=DOMAIN + 5)
    until("it waits", lambda: "no robot" in robot.said("nobody"))
    assert ROBOT in robot.said("nobody")
    assert robot.kill("nobody", signal.SIGTERM) == 0
