"""Frames of .dbc files with random values, encoded and decoded by cantools.

    cd gateway/tests/dbc
    python ../../../tests/oracle/frames/dbc.py everything.dbc 30 > everything.txt

Made with cantools 45.1.0. One line per frame: the frame as candump writes it, its message, and the
value of each of its signals in the file's unit.
"""
import random
import sys

import cantools

file = cantools.database.load_file(sys.argv[1], strict=False)
count = int(sys.argv[2]) if len(sys.argv) > 2 else 40
only = sys.argv[3:]
generator = random.Random(1)


def raw(signal):
    """A random raw value: extreme ones, too."""
    if signal.is_float:
        return generator.choice([0.0, -1.5, generator.uniform(-1e6, 1e6), generator.gauss(0, 1)])
    least, most = (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
    if not signal.is_signed:
        least, most = 0, (1 << signal.length) - 1
    return generator.choice([least, most, generator.randint(least, most)])


def fill(message, names):
    """Values of the signals in the tree `names` of a message, a branch of each multiplexor."""
    values = {}
    for name in names:
        if isinstance(name, str):
            values[name] = raw(message.get_signal_by_name(name))
            continue
        for multiplexor, branches in name.items():
            value = generator.choice(list(branches))
            values[multiplexor] = value
            values.update(fill(message, branches[value]))
    return values


for message in file.messages:
    if only and message.name not in only or not message.signals:
        continue
    for _ in range(count):
        values = fill(message, message.signal_tree)
        data = file.encode_message(message.name, values, scaling=False)
        decoded = file.decode_message(message.name, data, decode_choices=False)
        width = 8 if message.is_extended_frame else 3
        separator = "##1" if len(data) > 8 else "#"
        text = " ".join(f"{name}={float(value)!r}" for name, value in decoded.items())
        print(f"{message.frame_id:0{width}X}{separator}{data.hex().upper()} {message.name} {text}")
