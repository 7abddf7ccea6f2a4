"""A moteus controller on CAN FD: the package `moteus` reads the queries and makes the replies.

    python moteus_controller.py INTERFACE ID

Reply k has position k / 100 turns, velocity -k / 50 turns/s, torque k / 20 Nm. Signal USR1: a
fault of the motor driver (33); USR2: its end.
"""
import io
import itertools
import signal
import sys

import can
from moteus import multiplex
from moteus.protocol import Writer

INTERFACE, ID = sys.argv[1], int(sys.argv[2])
LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
fault = 0


def set_fault(code):
    global fault
    fault = code


def reply(registers, k):
    stream = io.BytesIO()
    writer = Writer(stream)
    write = {
        0x000: lambda kind: writer.write(1 if fault else 10, kind),
        0x001: lambda kind: writer.write_position(k / 100, kind),
        0x002: lambda kind: writer.write_velocity(-k / 50, kind),
        0x003: lambda kind: writer.write_torque(k / 20, kind),
        0x00D: lambda kind: writer.write_voltage(24.0, kind),
        0x00E: lambda kind: writer.write_temperature(30.0, kind),
        0x00F: lambda kind: writer.write(fault, kind),
    }
    known = [(register, kind) for register, kind in registers if register in write]
    # A combiner is for registers that follow each other.
    runs = itertools.groupby(enumerate(known), lambda item: item[1][0] - item[0])
    for _, run in runs:
        run = [item for _, item in run]
        kinds = [kind for _, kind in run]
        combiner = multiplex.WriteCombiner(writer, 0x20, run[0][0], kinds)
        for register, kind in run:
            combiner.maybe_write()
            write[register](kind)
    data = stream.getvalue()
    return data.ljust(next(n for n in LENGTHS if n >= len(data)), b"\x50")


signal.signal(signal.SIGUSR1, lambda *_: set_fault(33))
signal.signal(signal.SIGUSR2, lambda *_: set_fault(0))
bus = can.Bus(interface="socketcan", channel=INTERFACE, fd=True)
print("ready", flush=True)
count = 0
while True:
    frame = bus.recv(0.5)
    if frame is None or frame.arbitration_id & 0x7F != ID or not frame.is_fd:
        continue
    if not frame.arbitration_id & 0x8000:
        continue
    host = frame.arbitration_id >> 8 & 0x7F
    count += 1
    answer = can.Message(
        arbitration_id=ID << 8 | host,
        is_extended_id=(ID << 8 | host) > 0x7FF,
        data=reply(multiplex.QueryParser.parse(frame.data), count),
        is_fd=True,
        bitrate_switch=frame.bitrate_switch,
    )
    bus.send(answer)
