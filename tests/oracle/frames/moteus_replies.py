"""Queries and replies of moteus controllers, written and read by the package `moteus`.

    python tests/oracle/frames/moteus_replies.py > drivers/tests/drivers/moteus.txt

Made with moteus 1.1.1. The first line is the query of `Controller(id=7)`; the others are
replies in each resolution, with what `moteus` reads from them: mode, position, velocity, torque,
voltage, temperature, fault.
"""
import io
import random

import moteus
from moteus.moteus import Writer
from moteus import multiplex

REGISTERS = [0x000, 0x001, 0x002, 0x003, 0x00D, 0x00E, 0x00F]
generator = random.Random(2)
query = moteus.Controller(id=7).make_query()
print(f"query {query.data.hex().upper()}")


def padded(data):
    size = next(size for size in (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
                if size >= len(data))
    return data + b"\x50" * (size - len(data))


for resolution in (multiplex.INT8, multiplex.INT16, multiplex.INT32, multiplex.F32):
    for absent in (False, False, False, True):
        mode, fault = generator.choice([(10, 0), (1, 35), (15, 0), (1, 38)])
        values = [
            mode,
            generator.uniform(-1.2, 1.2),
            generator.uniform(-8, 8),
            float("nan") if absent else generator.uniform(-20, 20),
            generator.uniform(12, 48),
            generator.uniform(15, 70),
            fault,
        ]
        kinds = [multiplex.INT8] + [resolution] * 3 + [multiplex.INT8] * 3
        stream = io.BytesIO()
        writer = Writer(stream)
        first = multiplex.WriteCombiner(writer, 0x20, REGISTERS[0], kinds[:4])
        second = multiplex.WriteCombiner(writer, 0x20, REGISTERS[4], kinds[4:])
        mappers = [
            lambda value, kind: writer.write_int8(value),
            writer.write_position,
            writer.write_velocity,
            writer.write_torque,
            writer.write_voltage,
            writer.write_temperature,
            lambda value, kind: writer.write_int8(value),
        ]
        combiners = [first] * 4 + [second] * 3
        for combiner, mapper, value, kind in zip(combiners, mappers, values, kinds):
            combiner.maybe_write()
            mapper(value, kind)
        data = padded(stream.getvalue())
        read = moteus.parse_registers(data).response
        print(data.hex().upper(), *(repr(float(read[register])) for register in REGISTERS))
