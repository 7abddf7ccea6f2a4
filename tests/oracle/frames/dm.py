"""Frames of Damiao motors with the values that other programs read, and the questions they send.

    pip install --no-deps damiao-motor==1.0.6 pydamiao==0.1.4
    pip install numpy python-can pyserial
    python tests/oracle/frames/dm.py > drivers/tests/drivers/damiao.txt

Random payloads of motors 3 and 0x1A. damiao-motor reads them with its own ranges, and pydamiao must
agree. One line each: model, frame, position [rad], velocity [rad/s], torque [Nm], temperatures,
state. Then the questions, as `ask` and `read`: address, register, frame; and answers, which
damiao-motor reads: `answer`, address, register, value, frame.
"""
import math
import random
import struct
from types import SimpleNamespace

from damiao_motor.core.motor import DaMiaoMotor
from pydamiao.protocol import DamiaoProtocol
from pydamiao.structs import MOTOR_LIMITS, MotorType

generator = random.Random(5)
MODELS = {"DM4310": "4310", "DM6006": "6006", "DM8006": "8006", "DM8009": "8009",
          "DM10010L": "10010L", "DM10010": "10010", "DMH3510": "H3510"}
STATES = [0, 1, 1, 1, 8, 9, 0xA, 0xB, 0xC, 0xD, 0xE]


def close(a, b):
    # pydamiao computes in single precision.
    return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-5)


def motor(model, address):
    sent = []
    bus = SimpleNamespace(send=sent.append)
    return DaMiaoMotor(address, 0x10 + address, bus, motor_type=model), sent


for model, theirs in MODELS.items():
    for address in (3, 0x1A):
        state = generator.choice(STATES)
        payload = bytes([state << 4 | address & 0xF]) + generator.randbytes(7)
        read = motor(theirs, address)[0].decode_sensor_feedback(payload)
        other = DamiaoProtocol.decode_status(payload, MOTOR_LIMITS[MotorType[model]])
        assert all(close(read[k], o) for k, o in zip(("pos", "vel", "torq"), other))
        assert (read["t_mos"], read["t_rotor"]) == DamiaoProtocol.decode_temperatures(payload)
        assert read["status_code"] == state and read["can_id"] == address & 0xF
        frame = f"{0x10 + address:03X}#{payload.hex().upper()}"
        values = [repr(read[key]) for key in ("pos", "vel", "torq", "t_mos", "t_rotor")]
        print(model, frame, *values, state)

for address in (3, 0x1A):
    asking, sent = motor("4310", address)
    asking.request_motor_feedback()
    for register in (21, 22, 23):
        asking.request_register_reading(register)
    for register, message in zip((0xCC, 21, 22, 23), sent):
        bridged = (DamiaoProtocol.encode_refresh_state(address) if register == 0xCC
                   else DamiaoProtocol.encode_read_param(address, register))
        assert bytes(message.data) in bridged
        kind = "ask" if register == 0xCC else "read"
        frame = f"{message.arbitration_id:03X}#{bytes(message.data).hex().upper()}"
        print(kind, address, register, frame)
    for register, value in ((21, 12.566), (22, 45.0), (23, 54.0)):
        payload = bytes([address, 0, 0x33, register]) + struct.pack("<f", value)
        asking.decode_register_reply(payload)
        read = asking.registers[register]
        frame = f"{0x10 + address:03X}#{payload.hex().upper()}"
        print("answer", address, register, repr(read), frame)
