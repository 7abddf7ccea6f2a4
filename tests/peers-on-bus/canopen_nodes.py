"""A drive and an encoder on a CANopen bus, made of the package `canopen` alone.

    python canopen_nodes.py INTERFACE drive.dcf encoder.eds

The drive is node 5, the encoder node 9. At each SYNC, number k of this process:

    drive     position 7k counts, velocity -7k, torque 7k mod 1000, current 7k mod 500
    encoder   position 9k counts

so a reader can tell whether the values of a reading belong together. Signals: USR1 an emergency
message of the drive, USR2 its end, HUP: both nodes boot.
"""
import io
import pathlib
import signal
import sys

import canopen

INTERFACE, DRIVE, ENCODER = sys.argv[1:4]


def node(number, name):
    # canopen reads files in the system's encoding, and tells the format by the name.
    text = io.StringIO(pathlib.Path(name).read_bytes().decode("latin-1").replace("\r\n", "\n"))
    text.name = name
    objects = canopen.import_od(text, number)
    return canopen.LocalNode(number, objects)


class Nodes:
    def __init__(self):
        self.network = canopen.Network()
        self.network.connect(interface="socketcan", channel=INTERFACE)
        self.drive, self.encoder = node(5, DRIVE), node(9, ENCODER)
        self.drive.sdo[0x6041].raw = 0x0627
        self.running = {}
        self.count = 0
        for local in (self.drive, self.encoder):
            self.network.add_node(local)
        self.network.subscribe(0x80, self.sync)

    def boot(self):
        for local in (self.drive, self.encoder):
            local.nmt.state = "INITIALISING"  # sends the boot-up message
            local.nmt.state = "PRE-OPERATIONAL"  # and the heartbeat

    def sync(self, _identifier, _data, _time):
        self.count += 1
        steps = 7 * self.count
        values = {
            0x6041: 0x0627,
            0x6061: 10,
            0x6064: steps,
            0x606C: -steps,
            0x6077: steps % 1000,
            0x6078: steps % 500,
            0x2201: 99,
            0x6004: 9 * self.count,
            0x6030: 0,
            0x6503: 0,
        }
        for local in (self.drive, self.encoder):
            operational = local.nmt.state == "OPERATIONAL"
            if operational and not self.running.get(local.id):
                local.tpdo.read()  # as the host has set it up
            self.running[local.id] = operational
            if not operational:
                continue
            for pdo in local.tpdo.values():
                if pdo.enabled and pdo.map and pdo.trans_type <= 240:
                    for variable in pdo.map:
                        variable.raw = values[variable.index]
                    pdo.transmit()


nodes = Nodes()
waited = {signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP}
signal.pthread_sigmask(signal.SIG_BLOCK, waited)
nodes.boot()
print("ready", flush=True)
while True:
    match signal.sigwait(waited):
        case signal.SIGUSR1:
            nodes.drive.emcy.send(0x2310, 0x03)
        case signal.SIGUSR2:
            nodes.drive.emcy.reset()
        case signal.SIGHUP:
            nodes.boot()
