"""Logs of one mixed bus in every format that python-can writes, from a list of messages.

    python write.py FOLDER [SEED COUNT]

Made with python-can 4.6.1; the files beside this script are those of `python write.py .`. Without a
seed the messages are the ones below, else COUNT random ones. The program writes bus.log (candump),
bus.asc, bus.blf, stored.blf (not compressed), straddling.blf (containers of 200 bytes), bus.csv,
and bus.trc, which has only classic data frames: python-can writes no other frames there.
"""
import os
import pathlib
import random
import sys
import time

os.environ["TZ"] = "UTC"  # an ASC file has local time
time.tzset()

import can  # noqa: E402

START = 1_700_000_000_125  # [ms]; a BLF file begins at a whole millisecond


def mixed():
    """Every kind of frame, on two channels."""
    eight = bytes([0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88])
    fd = {"is_fd": True, "is_extended_id": False}
    kinds = [
        {"arbitration_id": 0x123, "data": b"\xde\xad\xbe\xef", "is_extended_id": False},
        {"arbitration_id": 0x1F334455, "data": eight, "is_rx": False},
        {"arbitration_id": 0x7FF, "is_extended_id": False},
        {"arbitration_id": 0x00000123, "data": b"LOBJ"},
        {"arbitration_id": 0x123, "is_remote_frame": True, "dlc": 0, "is_extended_id": False},
        {"arbitration_id": 0x18EBFF00, "is_remote_frame": True, "dlc": 0, "is_rx": False},
        {"arbitration_id": 0x5A1, "data": b"", **fd},
        {"arbitration_id": 0x5A2, "data": eight[:3], **fd, "error_state_indicator": True},
        {"arbitration_id": 0x5A3, "data": eight + eight[:4], **fd, "bitrate_switch": True},
        {
            "arbitration_id": 0x12345678, "data": bytes(range(64)), "is_fd": True,
            "bitrate_switch": True, "error_state_indicator": True, "is_rx": False,
        },
        {"is_error_frame": True},
        {"arbitration_id": 0x020, "data": b"Hello", "is_extended_id": False},
    ]
    messages = []
    for number, kind in enumerate(kinds + kinds[::-1]):
        # Steps of different lengths, in whole microseconds.
        micro = START * 1000 + number * number * 1_237
        messages.append(can.Message(timestamp=micro / 1e6, channel=number % 2, **kind))
    return messages


def chance(seed, count):
    """Random messages. The formats agree on these: no remote request for bytes, which python-can's
    candump log drops, and classic frames alone have extended identifiers of any length."""
    generator = random.Random(seed)
    messages, micro = [], START * 1000
    for _ in range(count):
        extended = generator.random() < 0.5
        message = {
            "timestamp": micro / 1e6,
            "channel": generator.randrange(3),
            "arbitration_id": generator.getrandbits(29 if extended else 11),
            "is_extended_id": extended,
            "is_rx": generator.random() < 0.8,
        }
        kind = generator.choice(["classic", "classic", "fd", "remote", "error"])
        if not messages:
            # python-can's TRC takes the first message that it writes for the first of all.
            kind = "classic"
        if kind == "classic":
            message["data"] = generator.randbytes(generator.randrange(9))
        elif kind == "fd":
            lengths = [*range(9), 12, 16, 20, 24, 32, 48, 64]
            message["data"] = generator.randbytes(generator.choice(lengths))
            message["is_fd"] = True
            message["bitrate_switch"] = generator.random() < 0.5
            message["error_state_indicator"] = generator.random() < 0.5
        elif kind == "remote":
            message.update(is_remote_frame=True, dlc=0)
        else:
            message = {"timestamp": message["timestamp"], "channel": message["channel"],
                       "is_error_frame": True}
        messages.append(can.Message(**message))
        micro += generator.choice([0, 1, 130, 999, 20_000, 3_000_000])
    return messages


class Trc(can.TRCWriter):
    """The same file whatever the folder: its header names the path."""

    def __init__(self, path):
        super().__init__(path)
        self.filepath = "bus.trc"


def write(folder, messages):
    writers = {
        "bus.log": can.CanutilsLogWriter,
        "bus.asc": can.ASCWriter,
        "bus.blf": can.BLFWriter,
        "stored.blf": lambda path: can.BLFWriter(path, compression_level=0),
        "straddling.blf": lambda path: can.BLFWriter(path, max_container_size=200),
        "bus.csv": can.CSVWriter,
        "bus.trc": Trc,
    }
    for name, writer in writers.items():
        with writer(str(folder / name)) as log:
            for message in messages:
                log.on_message_received(message)


if __name__ == "__main__":
    arguments = [int(argument) for argument in sys.argv[2:]]
    write(pathlib.Path(sys.argv[1]), chance(*arguments) if arguments else mixed())
