"""A client of Foxglove's WebSocket protocol, written for these tests from the protocol alone."""

import base64
import json
import struct
import time
from dataclasses import dataclass
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.sync.client import connect

MESSAGE, FETCHED = 1, 4


@dataclass
class Received:
    topic: str
    log_time: int  # [ns since 1970, UTC]
    message: Any


def decoder(channel):
    """Decodes messages by the schema that the server advertises."""
    name, text = channel["schemaName"], channel["schema"]
    if channel["encoding"] == "protobuf":
        files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(text))
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    schema = Schema(id=1, name=name, encoding="ros2msg", data=text.encode())
    return DecoderFactory().decoder_for("cdr", schema)


class Client:
    def __init__(self, port, topics=()):
        self.connection = connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None
        )
        self.channels, self.decoders, self.subscribed = {}, {}, {}
        self.info, self.wanted = None, set(topics)

    def __enter__(self):
        self.socket = self.connection.__enter__()
        assert self.socket.subprotocol == "foxglove.sdk.v1"
        return self

    def __exit__(self, *why):
        self.connection.__exit__(*why)

    def send(self, op, **fields):
        self.socket.send(json.dumps({"op": op, **fields}))

    def subscribe(self, *topics):
        self.wanted.update(topics)
        self._subscribe(self.channels.values())

    def _subscribe(self, channels):
        new = [c for c in channels if c["id"] not in self.subscribed and self._wants(c["topic"])]
        for channel in new:
            # Another number than the channel's, to find out whether they are confused.
            self.subscribed[channel["id"]] = 1000 + channel["id"]
            self.decoders[1000 + channel["id"]] = channel["topic"], decoder(channel)
        if new:
            pairs = [{"id": 1000 + c["id"], "channelId": c["id"]} for c in new]
            self.send("subscribe", subscriptions=pairs)

    def _wants(self, topic):
        return topic in self.wanted or "*" in self.wanted

    def receive(self, timeout):
        """The next message of a topic; None if none comes in time."""
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0:
            try:
                data = self.socket.recv(timeout=left)
            except TimeoutError:
                return None
            if isinstance(data, bytes):
                if data[0] == MESSAGE:
                    _, subscription, log_time = struct.unpack_from("<BIQ", data)
                    topic, decode = self.decoders[subscription]
                    return Received(topic, log_time, decode(data[13:]))
                continue
            data = json.loads(data)
            if data["op"] == "serverInfo":
                self.info = data
            elif data["op"] == "advertise":
                self.channels.update((c["topic"], c) for c in data["channels"])
                self._subscribe(data["channels"])
        return None

    def collect(self, seconds):
        """All that comes in this time."""
        end, found = time.monotonic() + seconds, []
        while (left := end - time.monotonic()) > 0:
            if (one := self.receive(left)) is not None:
                found.append(one)
        return found

    def wait(self, topic, timeout=10.0, until=lambda _: True):
        """The first message of a topic that is as wanted."""
        self.subscribe(topic)
        end, last = time.monotonic() + timeout, None
        while (left := end - time.monotonic()) > 0:
            one = self.receive(left)
            if one is not None and one.topic == topic:
                last = one
                if until(one.message):
                    return one
        raise AssertionError(f"{topic}: not in {timeout} s; the last was {last}")

    def fetch(self, uri, timeout=10.0):
        """The asset, or the server's error."""
        self.send("fetchAsset", uri=uri, requestId=7)
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0:
            data = self.socket.recv(timeout=left)
            if isinstance(data, bytes) and data[0] == FETCHED:
                _, request, status, length = struct.unpack_from("<BIBI", data)
                assert request == 7
                return data[10 + length :] if status == 0 else data[10 : 10 + length].decode()
        raise AssertionError(f"{uri}: no answer in {timeout} s")
