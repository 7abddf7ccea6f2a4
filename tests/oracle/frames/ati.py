"""A session of an ATI NETCANOEM sensor and the program that polls it, with the wrenches.

    python tests/oracle/frames/ati.py > drivers/tests/drivers/ati.txt

Written from the tables of ATI's manual 9610-05-1030 with struct and numpy 2. One line per frame as
candump writes it; after the frame that completes it, a line with the wrench in N and Nm. Base 3F,
counts 4448 and 2000 per pound-force and pound-force inch; the second half of a reading may come
after the first half of the next one or two.
"""
import struct

import numpy

BASE = 0x3F << 4
POUND_FORCE = 0.45359237 * 9.80665
INCH = 0.0254
generator = numpy.random.default_rng(3)
scale = numpy.array([[9.0]] * 3 + [[6.0]] * 3)
matrix = numpy.float32(scale * generator.normal(size=(6, 6)))
counts = numpy.array([4448] * 3 + [2000] * 3)
unit = numpy.array([POUND_FORCE] * 3 + [POUND_FORCE * INCH] * 3)


def frame(opcode, data=b""):
    print(f"{BASE | opcode:03X}#{data.hex().upper()}")


frame(7)
frame(7, struct.pack(">2i", 4448, 2000))
frame(8)
frame(8, struct.pack("2B", 1, 1))
# It asks for the last two rows at once.
for rows in [[0], [1], [2], [3], [4, 5]]:
    for row in rows:
        frame(2, struct.pack("B", row))
    for pair in range(3):
        for row in rows:
            frame(2 + pair, struct.pack(">2f", *matrix[row, 2 * pair : 2 * pair + 2]))
# How many readings wait for their second half, after each request.
for group in [1, 1, 2, 1, 3, 1, 1]:
    readings = generator.integers(-32000, 32000, (group, 6))
    for gauges in readings:
        frame(0)
        frame(0, struct.pack(">H3h", 0, *gauges[[0, 2, 4]]))
    for gauges in readings:
        frame(1, struct.pack(">3h", *gauges[[1, 3, 5]]))
    for gauges in readings:
        wrench = matrix.astype(float) @ gauges / counts * unit
        print("wrench", *(repr(float(value)) for value in wrench))
