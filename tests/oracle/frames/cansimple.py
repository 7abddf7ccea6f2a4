"""Frames of ODrive axes of both generations of firmware, with their values in SI units.

    pip install cantools==45.1.0 odrive-can==2.1.0 odrive==0.6.11.post1
    python tests/oracle/frames/cansimple.py > drivers/tests/drivers/odrive.txt

cantools encodes them from the maker's .dbc files (0.5.6 and 0.6.10, in odrive-can); the names of
the axis errors are those of the maker's package odrive. Node 5. One line each: firmware, frame as
candump writes it, message, values; or firmware, "error", bit, name.
"""
import math
import random
import struct
from importlib.resources import files

import cantools
from odrive.enums import AxisError, ODriveError

NODE = 5
TURN = 2 * math.pi
ENCODER = {
    "0.5": AxisError.ENCODER_FAILED | AxisError.UNKNOWN_POSITION,
    "0.6": ODriveError.MISSING_ESTIMATE | ODriveError.SPINOUT_DETECTED,
}
generator = random.Random(7)


def single(least, most):
    """A number that single precision holds."""
    return struct.unpack("f", struct.pack("f", generator.uniform(least, most)))[0]


def session(firmware, version, errors):
    path = files("odrive_can") / "dbc" / f"odrive-cansimple-{version}.dbc"
    database = cantools.database.load_file(str(path))

    def line(message, signals, *values):
        message = database.get_message_by_name(f"Axis{NODE}_{message}")
        data = message.encode(signals, scaling=False)
        print(f"{firmware} {message.frame_id:03X}#{data.hex().upper()}", *values)

    for _ in range(4):
        position, velocity = single(-500, 500), single(-90, 90)
        signals = {"Pos_Estimate": position, "Vel_Estimate": velocity}
        line("Get_Encoder_Estimates", signals, "estimates", position * TURN, velocity * TURN)
    for _ in range(3):
        wanted, measured = single(-40, 40), single(-40, 40)
        line("Get_Iq", {"Iq_Setpoint": wanted, "Iq_Measured": measured}, "current", measured)
    if firmware == "0.6":
        for _ in range(3):
            target, estimate = single(-9, 9), single(-9, 9)
            signals = {"Torque_Target": target, "Torque_Estimate": estimate}
            line("Get_Torques", signals, "torque", estimate)
            fet, motor = single(-20, 90), single(-20, 90)
            signals = {"FET_Temperature": fet, "Motor_Temperature": motor}
            line("Get_Temperature", signals, "temperature", fet, motor)
    for error in [0, *errors]:
        state = generator.choice([1, 6, 8])
        signals = {"Axis_Error": int(error), "Axis_State": state, "Trajectory_Done_Flag": 1}
        flags = [0, 0, 0]
        if firmware == "0.5":
            flags = [generator.randrange(2) for _ in flags]
            names = ["Motor_Error_Flag", "Encoder_Error_Flag", "Controller_Error_Flag"]
            signals |= dict(zip(names, flags))
        else:
            signals["Procedure_Result"] = generator.randrange(17)
        motor, encoder, controller = flags
        doubtful = int(error & ENCODER[firmware] != 0 or encoder)
        drive = int(error & ~ENCODER[firmware] != 0 or motor or controller)
        line("Heartbeat", signals, "heartbeat", int(error), state, *flags, doubtful, drive)
        if error:
            print(firmware, "error", int(error).bit_length() - 1, error.name)


session("0.5", "0.5.6", [error for error in AxisError.__members__.values() if error])
session("0.6", "0.6.10", [error for error in ODriveError if error])
