"""Cyclone DDS, an implementation of DDS that ROS 2 uses, as the other side of proprio-ros2."""

import os

LOOPBACK = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)  # read when the first participant is made

from cyclonedds.core import Policy, Qos  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from cyclonedds.util import duration  # noqa: E402


def subscribe(participant, topic, kind, reliable=True, durable=False, depth=5000):
    """A reader as a subscription of ROS 2 has: reliable and volatile, unless asked otherwise."""
    policies = [
        Policy.Reliability.Reliable(duration(seconds=1))
        if reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if durable else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        # As of ROS's types: the first version of CDR.
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    return DataReader(participant, Topic(participant, topic, kind), qos=Qos(*policies))
