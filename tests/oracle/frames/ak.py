"""Frames of CubeMars AK motors in MIT and servo mode, with the values that other programs read.

    pip install --no-deps TMotorCANControl==1.2.6 epicallypowerful==1.0.7 \\
        mini-cheetah-motor-driver-socketcan==0.4.3
    pip install python-can bitstring numpy msgspec smbus2 scipy
    python tests/oracle/frames/ak.py > drivers/tests/drivers/cubemars.txt

Random payloads of motor 3. MIT mode: TMotorCANControl reads them with its own ranges, and the MIT
Mini Cheetah driver must agree; 40 is taken from the temperature byte here. Servo mode:
epicallypowerful reads them, and has pole pairs and gear ratios; the sign of the temperature is
applied here. One line each: mode, model, frame, position [rad], velocity [rad/s], torque [Nm] or
current [A], temperature, error.
"""
import math
import random
from types import SimpleNamespace

from epicallypowerful.actuation.cubemars.cubemars_v3 import _read_cubemars_message
from epicallypowerful.actuation.motor_data import MotorData
from motor_driver import canmotorlib
from TMotorCANControl.mit_can import CAN_Manager, MIT_Params

NUMBER = 3
generator = random.Random(11)


def close(a, b):
    return math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9)


for model in ["AK10-9", "AK70-10", "AK80-6", "AK80-9", "AK80-64"]:
    for length in [6, 6, 8, 8]:
        data = bytes([NUMBER]) + generator.randbytes(6) + bytes([generator.randrange(8)])
        data = data[:length]
        state = CAN_Manager.parse_MIT_message(SimpleNamespace(debug=False), data, model)
        raw = int.from_bytes(data[1:6], "big")
        ends = [MIT_Params[model][key] for key in ("P_max", "V_max", "T_max")]
        for value, end, bits, shift in zip(state, ends, (16, 12, 12), (24, 12, 0)):
            integer = raw >> shift & (1 << bits) - 1
            assert close(value, canmotorlib.uint_to_float(integer, -end, end, bits))
        celsius = "-" if state.temperature is None else state.temperature - 40
        error = "-" if state.error is None else state.error
        values = map(repr, (state.position, state.velocity, state.current))
        print("mit", model, f"000#{data.hex().upper()}", *values, celsius, error)

for model in ["AK10-9-V2.0", "AK60-6-V1.1", "AK70-10", "AK80-8", "AK80-64"]:
    motor = MotorData(motor_id=NUMBER, motor_type=model)
    for _ in range(4):
        data = generator.randbytes(5) + generator.randbytes(2) + bytes([generator.randrange(8)])
        position, erpm, current, celsius, error = _read_cubemars_message(
            SimpleNamespace(data=data)
        )
        velocity = erpm * motor.erpm_to_rpm * 2 * math.pi / 60
        celsius -= 256 if celsius > 127 else 0
        model = "-".join(model.split("-")[:2])
        frame = f"{0x2900 | NUMBER:08X}#{data.hex().upper()}"
        print("servo", model, frame, repr(position), repr(velocity), repr(current), celsius, error)
