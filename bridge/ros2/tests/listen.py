"""A subscription as a program of its own: `listen.py DOMAIN TOPIC SECONDS` prints how many wrenches
came, and the frame of the last one. It may run elsewhere, or be stopped."""

import sys
import time

import network
from cyclonedds.domain import DomainParticipant
from messages import WrenchStamped

domain, topic, seconds = int(sys.argv[1]), sys.argv[2], float(sys.argv[3])
reader = network.subscribe(DomainParticipant(domain), topic, WrenchStamped)
print("listening", flush=True)
end = time.monotonic() + seconds
count, frame = 0, ""
while time.monotonic() < end:
    for message in reader.take(N=5000):
        count, frame = count + 1, message.header.frame_id
    time.sleep(0.005)
print(count, frame, flush=True)
