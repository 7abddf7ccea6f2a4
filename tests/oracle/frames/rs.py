"""Frames of RobStride motors and CyberGears with the values that other programs read.

    pip install --no-deps robstride==0.1.0 robstride-dynamics==0.0.1 python-cybergear==0.1.2
    pip install python-can numpy tqdm
    python tests/oracle/frames/rs.py > drivers/tests/drivers/robstride.txt

Random states of motors 1 and 0x7F for host 0xFD. `robstride` reads those of an RS01 and an RS04;
robstride-dynamics must agree. python-cybergear reads those of a CyberGear, with 12.5 rad. One line
each: model, frame, position [rad], velocity [rad/s], torque [Nm], temperature, mode, faults. Then
the questions of `robstride` for parameters, and what it reads from an answer: `read`, parameter,
question, answer, value.
"""
import contextlib
import io
import math
import random
import struct
from types import SimpleNamespace

import can
from cybergear.cybergear import CyberGearMotor
from robstride.client import Client
from robstride_dynamics.bus import RobstrideBus

generator = random.Random(3)
HOST = 0xFD
FAULTS = [0, 0, 1, 2, 4, 8, 0x10, 0x20, 0x21]


def state(address):
    faults, mode = generator.choice(FAULTS), generator.choice([0, 1, 2])
    identifier = 0x02 << 24 | mode << 22 | faults << 16 | address << 8 | HOST
    data = generator.randbytes(6) + struct.pack(">H", generator.randrange(1500))
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=True), mode, faults


def show(model, message, *values):
    frame = f"{message.arbitration_id:08X}#{bytes(message.data).hex().upper()}"
    print(model, frame, *values)


def official(model, message):
    motor = SimpleNamespace(model=model, id=message.arbitration_id >> 8 & 0xFF)
    bus = SimpleNamespace(
        receive=lambda timeout: (
            message.arbitration_id >> 24 & 0x1F, message.arbitration_id >> 8 & 0xFFFF,
            message.arbitration_id & 0xFF, message.data,
        ),
        motors={"m": motor},
    )
    return RobstrideBus.receive_status_frame(bus, "m")


for model, number in (("RS01", 1), ("RS04", 4)):
    for address in (1, 0x7F, 1, 0x7F):
        message, mode, faults = state(address)
        client = Client(None, host_can_id=HOST)
        # Its modes are one bit: 2 is read apart here.
        identifier = message.arbitration_id & ~(3 << 22)
        told = SimpleNamespace(arbitration_id=identifier, data=message.data)
        read = client._parse_feedback_resp(told, address, number)
        assert sum(error.value for error in read.errors) == faults & 0x1F  # It leaves out bit 5.
        with contextlib.redirect_stdout(io.StringIO()):
            theirs = official(f"rs-0{number}", message)
        # The maker divides by 32767 and not by 32767.5.
        for ours, other in zip((read.angle, read.velocity, read.torque), theirs):
            assert math.isclose(ours, other, rel_tol=1e-3, abs_tol=5e-3), (ours, other)
        values = (read.angle, read.velocity, read.torque, read.temp)
        show(model, message, *map(repr, values), mode, faults)

for address in (1, 0x7F, 1, 0x7F):
    message, mode, faults = state(address)
    gear = SimpleNamespace(
        FEEDBACK_P_MIN=CyberGearMotor.FEEDBACK_P_MIN, FEEDBACK_P_MAX=CyberGearMotor.FEEDBACK_P_MAX,
        V_MIN=CyberGearMotor.V_MIN, V_MAX=CyberGearMotor.V_MAX,
        T_MIN=CyberGearMotor.T_MIN, T_MAX=CyberGearMotor.T_MAX,
        _uint_to_float=CyberGearMotor._uint_to_float, _feedback=SimpleNamespace(faults=None),
        _feedback_listeners=[], _fault_listeners=[], _fire_listeners=lambda *_: None,
    )
    CyberGearMotor._parse_motor_feedback_message(gear, message)
    read = gear._feedback
    assert read.mode == mode
    values = (read.position, read.velocity, read.torque, read.temperature)
    show("CyberGear", message, *map(repr, values), mode, faults)

for address in (1, 0x7F):
    for parameter, value in ((0x701B, -3.5), (0x701A, 0.75), (0x7019, 31.25)):
        sent = []
        answer = can.Message(
            arbitration_id=0x11 << 24 | address << 8 | HOST, is_extended_id=True,
            data=struct.pack("<HHf", parameter, 0, value),
        )
        bus = SimpleNamespace(send=sent.append, recv=lambda timeout: answer)
        read = Client(bus, host_can_id=HOST).read_param(address, parameter)
        question = f"{sent[0].arbitration_id:08X}#{bytes(sent[0].data).hex().upper()}"
        show(f"read {parameter:04X} {question}", answer, read)
