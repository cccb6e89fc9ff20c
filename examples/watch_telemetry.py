"""Print joint positions of a device. Usage: ``python examples/watch_telemetry.py DEVICE [--samples N]``."""

import argparse
import json
import queue

from telescope_client import connect_to_broker, find_device, topic

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("device")
parser.add_argument("--samples", type=int, default=20)
options = parser.parse_args()

device = find_device(options.device)
messages: queue.Queue[tuple[str, bytes]] = queue.Queue()
client = connect_to_broker({"purpose": "view"})
client.on_message = lambda _client, _userdata, message: messages.put((message.topic, message.payload))
# ``desc`` is retained, so the broker sends it immediately.
client.on_connect = lambda *_: client.subscribe([(topic(device, "desc"), 1), (topic(device, "tele/joints"), 0)])
client.loop_start()

joints: list[str] = []
printed = 0
while printed < options.samples:
    name, payload = messages.get(timeout=20)
    message = json.loads(payload)
    if name.endswith("/desc"):
        joints = [joint["name"] for joint in message["joints"]]
    elif joints:
        positions = zip(joints, message["position_rad"], strict=True)
        print(message["tick_ms"], " ".join(f"{joint}={position:+.3f}" for joint, position in positions))
        printed += 1
client.disconnect()
