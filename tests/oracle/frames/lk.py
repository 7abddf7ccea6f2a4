"""Frames of LKMTech motors (protocol V2 of the driver `myactuator`) with the values that pylkmotor
reads, and the questions that it sends.

    pip install --no-deps pylkmotor==1.0.6
    pip install python-can
    python tests/oracle/frames/lk.py > drivers/tests/drivers/myactuator_v2.txt

Random answers of motor 3. One line each: question, answer, what it reads: temperature, current
[steps], speed [deg/s], encoder; angle [0.01 deg]; error.
"""
import random
from types import SimpleNamespace

from pylkmotor.LKMotor import LKMotor

generator = random.Random(4)


def ask(command, payload, read):
    sent = []
    motor = LKMotor("virtual", "none", 3)
    answer = SimpleNamespace(data=bytes([command]) + payload)
    motor.bus.shutdown()
    motor.bus = SimpleNamespace(send=sent.append, recv=lambda timeout: answer)
    values = read(motor)
    question = f"{sent[0].arbitration_id:03X}#{bytes(sent[0].data).hex().upper()}"
    print(question, f"143#{answer.data.hex().upper()}", *values)


for _ in range(6):
    data = bytes([generator.randrange(2, 110)]) + generator.randbytes(4)
    # pylkmotor takes the encoder for a signed number.
    data += bytes([generator.randrange(256), generator.randrange(0x80)])
    ask(0x9C, data, lambda motor: motor.read_motor_status_2())
for bits in (16, 16, 24, 24, 40, 54):
    angle = generator.randrange(-1 << bits, 1 << bits)
    data = angle.to_bytes(7, "little", signed=True)
    ask(0x92, data, lambda motor: [motor.read_multi_turn_angle()])
for error in (0, 1, 2, 8, 0x40):
    data = generator.randbytes(6) + bytes([error])
    ask(0x9A, data, lambda motor: [motor.read_motor_status_1()[4]])
