"""Move one joint with streamed setpoints. Usage: ``python examples/stream_setpoints.py DEVICE JOINT POSITION_RAD``.

Takes the lease, streams authenticated setpoints that echo the newest telemetry tick, and releases the lease. The robot
stops automatically 300 ms after the last setpoint. Then it accepts only a higher ``input``. Only a person should decide
to continue, so this program ends.
"""

import hmac
import json
import queue
import sys
import time

from telescope_client import call, connect_to_broker, find_device, topic

PERIOD_S = 0.025
TIMEOUT_S = 20.0
TOLERANCE_RAD = 0.02
INPUT = 1

name, joint, position = sys.argv[1:]
target_rad = float(position)
device = find_device(name)
lease = call("POST", f"/devices/{device['id']}/lease", {})
messages: queue.Queue[tuple[str, bytes]] = queue.Queue()
watcher = connect_to_broker({"purpose": "view"})
watcher.on_message = lambda _client, _userdata, message: messages.put((message.topic, message.payload))
watcher.on_connect = lambda *_: watcher.subscribe([(topic(device, "desc"), 1), (topic(device, "tele/joints"), 0)])
watcher.loop_start()
control = connect_to_broker({"purpose": "control", "device": device["id"], "epoch": lease["epoch"]})
control.loop_start()

ctl = topic(device, f"ctl/{lease['epoch']}")


def seal(setpoint: dict[str, object]) -> str:
    """Authenticate a setpoint with the key of the lease."""
    body = json.dumps(setpoint)
    text = f"telescope/v1/setpoint\n{ctl}\n{body}"
    tag = hmac.new(bytes.fromhex(lease["setpoint_key"]), text.encode(), "sha256").hexdigest()[:32]
    return f'{{"tag":"{tag}","body":{body}}}'


joints: list[str] = []
sequence = 0
deadline_s = time.monotonic() + TIMEOUT_S
try:
    while True:
        if time.monotonic() > deadline_s:
            sys.exit(f"{joint} did not reach {target_rad} rad")
        source, payload = messages.get(timeout=TIMEOUT_S)
        message = json.loads(payload)
        if source.endswith("/desc"):
            joints = [each["name"] for each in message["joints"]]
        if source.endswith("/desc") or not joints or not messages.empty():
            continue  # only the newest telemetry: a setpoint that echoes an old tick is rejected
        if abs(message["position_rad"][joints.index(joint)] - target_rad) < TOLERANCE_RAD:
            print(f"{joint} reached {target_rad} rad; loop age {message['loop_age_ms']:.0f} ms")
            break
        ended_input = message.get("ended_input", 0)
        if message["epoch"] == lease["epoch"] and ended_input >= INPUT:
            sys.exit("setpoints arrived too late, so the robot holds; start again to continue")
        sequence += 1
        setpoint = {
            "epoch": lease["epoch"],
            "sequence": sequence,
            "echo_tick_ms": message["tick_ms"],
            "sent_ms": time.time() * 1000,
            "input": INPUT,
            "target": {"kind": "joints", "position_rad": {joint: target_rad}},
        }
        control.publish(ctl, seal(setpoint), qos=0)
        time.sleep(PERIOD_S)
finally:
    call("DELETE", f"/devices/{device['id']}/lease?epoch={lease['epoch']}")
    control.disconnect()
    watcher.disconnect()
