"""A session between a master and two nodes of the package `canopen`, as candump would log it.

    python tests/oracle/frames/canopen_session.py > drivers/tests/drivers/canopen.txt

Made with canopen 2.4.1 and python-can 4.6.1. Node 5 is a drive whose mapping and scales the master
reads, node 9 an encoder that it configures; then come SYNC and process data. One line per frame as
candump writes it, and for each reading a line with its node and its raw values.
"""
import can
import canopen
from canopen.objectdictionary import (
    INTEGER8,
    INTEGER16,
    INTEGER32,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    ODArray,
    ODRecord,
    ODVariable,
    ObjectDictionary,
)

lines = []


class Tap(can.Listener):
    def on_message_received(self, message):
        lines.append(f"{message.arbitration_id:03X}#{message.data.hex().upper()}")


def variable(name, index, sub, kind, default):
    entry = ODVariable(name, index, sub)
    entry.data_type = kind
    entry.default = entry.value = default
    return entry


def dictionary(profile, extra, mappings, node):
    entries = ObjectDictionary()
    entries.add_object(variable("Device type", 0x1000, 0, UNSIGNED32, 0x20000 | profile))
    entries.add_object(variable("Error register", 0x1001, 0, UNSIGNED8, 0))
    entries.add_object(variable("Heartbeat", 0x1017, 0, UNSIGNED16, 0))
    for number, (transmission, mapped) in enumerate(mappings):
        record = ODRecord("Communication", 0x1800 + number)
        off = 0 if mapped else 1 << 31
        cob = 0x180 + 0x100 * number + node | 1 << 30 | off
        record.add_member(variable("count", record.index, 0, UNSIGNED8, 5))
        record.add_member(variable("id", record.index, 1, UNSIGNED32, cob))
        record.add_member(variable("transmission", record.index, 2, UNSIGNED8, transmission))
        record.add_member(variable("inhibit", record.index, 3, UNSIGNED16, 0))
        record.add_member(variable("timer", record.index, 5, UNSIGNED16, 0))
        entries.add_object(record)
        record = ODRecord("Mapping", 0x1A00 + number)
        record.add_member(variable("count", record.index, 0, UNSIGNED8, len(mapped)))
        for sub in range(1, 9):
            value = mapped[sub - 1] if sub <= len(mapped) else 0
            record.add_member(variable(f"entry {sub}", record.index, sub, UNSIGNED32, value))
        entries.add_object(record)
    for entry in extra:
        entries.add_object(entry)
    return entries


encoder_units = ODArray("Encoder", 0x608F)
encoder_units.add_member(variable("count", 0x608F, 0, UNSIGNED8, 2))
encoder_units.add_member(variable("increments", 0x608F, 1, UNSIGNED32, 20000))
encoder_units.add_member(variable("turns", 0x608F, 2, UNSIGNED32, 2))
drive = dictionary(
    402,
    [
        variable("Status", 0x6041, 0, UNSIGNED16, 0x0637),
        variable("Mode", 0x6061, 0, INTEGER8, 10),
        variable("Position", 0x6064, 0, INTEGER32, 0),
        variable("Velocity", 0x606C, 0, INTEGER32, 0),
        variable("Rated current", 0x6075, 0, UNSIGNED32, 4300),
        variable("Rated torque", 0x6076, 0, UNSIGNED32, 880),
        variable("Torque", 0x6077, 0, INTEGER16, 0),
        variable("Current", 0x6078, 0, INTEGER16, 0),
        encoder_units,
    ],
    [
        (1, [0x60610008, 0x60640020, 0x60770010]),
        (1, [0x606C0020, 0x60780010]),
        (255, [0x60410010]),
        (255, []),
    ],
    5,
)
encoder = dictionary(
    406,
    [
        variable("Operating", 0x6000, 0, UNSIGNED16, 4),
        variable("Per turn", 0x6001, 0, UNSIGNED32, 3600),
        variable("Single turn", 0x6501, 0, UNSIGNED32, 65536),
        variable("Position", 0x6004, 0, UNSIGNED32, 0),
    ],
    [(255, [])],
    9,
)
masters, nodes = canopen.Network(), canopen.Network()
masters.connect(interface="virtual", channel="session")
nodes.connect(interface="virtual", channel="session")
tap = can.Notifier(can.Bus(interface="virtual", channel="session"), [Tap()], timeout=0.01)
local_drive, local_encoder = canopen.LocalNode(5, drive), canopen.LocalNode(9, encoder)
nodes.add_node(local_drive)
nodes.add_node(local_encoder)
remote_drive, remote_encoder = canopen.RemoteNode(5, drive), canopen.RemoteNode(9, encoder)
masters.add_node(remote_drive)
masters.add_node(remote_encoder)

remote_drive.sdo[0x1000].raw
remote_drive.tpdo.read()
for index, sub in [(0x608F, 1), (0x608F, 2)]:
    remote_drive.sdo[index][sub].raw
remote_drive.sdo[0x6076].raw
remote_drive.sdo[0x6075].raw
remote_encoder.nmt.state = "PRE-OPERATIONAL"
remote_encoder.sdo[0x6000].raw
remote_encoder.sdo[0x6501].raw
remote_encoder.sdo[0x6001].raw
remote_encoder.tpdo.read()
position = remote_encoder.tpdo[1]
position.clear()
position.add_variable(0x6004)
position.trans_type = 1
position.enabled = True
position.save()
masters.nmt.state = "OPERATIONAL"
local_drive.tpdo.read()
local_encoder.tpdo.read()

import random
import time

generator = random.Random(4)
truth = []
for turn in range(6):
    values = [
        generator.randint(-(1 << 31), (1 << 31) - 1),
        generator.randint(-(1 << 20), 1 << 20),
        generator.randint(-1200, 1200),
        generator.randint(-1500, 1500),
        generator.randrange(1 << 32),
    ]
    if turn == 3:
        local_drive.emcy.send(0x2310, 1, b"")
    if turn == 4:
        local_encoder.emcy.send(0x5000, 1, b"")
    if turn == 5:
        local_drive.emcy.reset()
        local_encoder.emcy.reset()
    masters.sync.transmit()
    time.sleep(0.05)
    first, second, third = (local_drive.tpdo[k] for k in (1, 2, 3))
    first["Mode"].raw, first["Position"].raw, first["Torque"].raw = 10, values[0], values[2]
    second["Velocity"].raw, second["Current"].raw = values[1], values[3]
    third["Status"].raw = 0x0637
    only = local_encoder.tpdo[1]
    only["Position"].raw = values[4]
    for pdo in (first, second, third, only):
        pdo.transmit()
        time.sleep(0.05)
    lines.append("drive " + " ".join(map(str, values[:4])))
    lines.append(f"encoder {values[4]}")
time.sleep(0.1)
tap.stop()
print("\n".join(lines))
