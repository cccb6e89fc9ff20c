"""Move joints over XMPP and print where they are: ``python examples/xmpp_operator.py DEVICE JOINT=RAD …``.

It needs only the XMPP library slixmpp and an access token or API key. After the request of the XMPP password over HTTP,
everything runs over XMPP: device list, lease, setpoints and telemetry. The robot stops automatically 300 ms after the
last setpoint.
"""

import asyncio
import hmac
import itertools
import json
import os
import sys
import time
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from slixmpp import ClientXMPP
from slixmpp.xmlstream.handler import Callback
from slixmpp.xmlstream.matcher import MatchXPath
from telescope_client import call

NAMESPACE = "urn:telescope:v1"
PERIOD_S = 0.025
TIMEOUT_S = 20.0
TOLERANCE_RAD = 0.02
INPUT = 1
BAD_REQUEST = 400


class Operator(ClientXMPP):
    """An XMPP client that is registered with the cloud."""

    def __init__(self, credentials: dict[str, Any]) -> None:
        # Without TLS only on this machine.
        local = credentials["host"] in ("127.0.0.1", "localhost")
        plugins = {"feature_mechanisms": {"unencrypted_plain": local}}
        super().__init__(
            f"{credentials['jid']}/operator", credentials["password"], plugin_config=plugins, sasl_mech="PLAIN"
        )
        self.enable_direct_tls, self.enable_starttls, self.enable_plaintext = False, not local, local
        self.messages: dict[str, Any] = {}
        self.arrived = asyncio.Event()
        self._numbers = itertools.count(1)
        self._answers: dict[str, asyncio.Future[tuple[int, Any]]] = {}
        self._cloud: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._bare = credentials["cloud"]
        self.add_event_handler("session_start", lambda _: self.send_presence(ppriority=-1))
        self.add_event_handler("presence_available", self._on_presence)
        # slixmpp's event "message" is only for messages with a body.
        self.register_handler(Callback("telescope", MatchXPath("{jabber:client}message"), self._on_message))
        self.connect(credentials["host"], credentials["port"])

    async def sign_in(self) -> None:
        """Sign in with the token of the HTTP API."""
        async with asyncio.timeout(TIMEOUT_S):
            await self._cloud
        await self.ask("sign-in", {"token": os.environ["TELESCOPE_TOKEN"]})

    async def call(self, method: str, path: str, body: object = None) -> Any:
        """Call the HTTP API over XMPP."""
        text = "" if body is None else json.dumps(body)
        return await self.ask("call", {"method": method, "path": f"/api/v1{path}"}, text)

    async def ask(self, name: str, attributes: dict[str, str], text: str = "", topics: tuple[str, ...] = ()) -> Any:
        """Send a request and return the body of its answer. Exits if the request is rejected."""
        number = str(next(self._numbers))
        element = self._send(number, name, attributes, text)
        for topic in topics:
            SubElement(element, f"{{{NAMESPACE}}}topic").text = topic
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        async with asyncio.timeout(TIMEOUT_S):
            status, body = await answer
        if status >= BAD_REQUEST:
            sys.exit(f"{name} {attributes.get('path', '')}: {status} {body}")
        return body

    def publish(self, topic: str, text: str) -> None:
        """Send a message on a topic."""
        self._send("", "m", {"topic": topic}, text)

    def _send(self, number: str, name: str, attributes: dict[str, str], text: str) -> Element:
        message = self.make_message(self._cloud.result())
        if number:
            message["id"] = number
        element = SubElement(message.xml, f"{{{NAMESPACE}}}{name}", attributes)
        element.text = text or None
        # After this step of the event loop, so that the caller can add topics.
        asyncio.get_running_loop().call_soon(message.send)
        return element

    def _on_presence(self, presence: Any) -> None:
        if presence["from"].bare == self._bare and not self._cloud.done():
            self._cloud.set_result(presence["from"].full)

    def _on_message(self, message: Any) -> None:
        if message["from"].bare != self._bare:
            return
        for element in message.xml:
            if element.tag == f"{{{NAMESPACE}}}m":
                self.messages[element.get("topic").rpartition("/")[2]] = json.loads(element.text or "null")
                self.arrived.set()
            elif element.tag == f"{{{NAMESPACE}}}answer" and message["id"] in self._answers:
                body = json.loads(element.text) if element.text else None
                self._answers.pop(message["id"]).set_result((int(element.get("status")), body))


def seal(setpoint: dict[str, object], topic: str, key: str) -> str:
    """Authenticate a setpoint with the key of the lease."""
    body = json.dumps(setpoint)
    text = f"telescope/v1/setpoint\n{topic}\n{body}"
    tag = hmac.new(bytes.fromhex(key), text.encode(), "sha256").hexdigest()[:32]
    return f'{{"tag":"{tag}","body":{body}}}'


async def stream(operator: Operator, topic: str, lease: dict[str, Any], target_rad: dict[str, float]) -> None:
    """Stream setpoints until all joints have reached their targets."""
    sequence = 0
    async with asyncio.timeout(TIMEOUT_S):
        while True:
            await operator.arrived.wait()
            operator.arrived.clear()
            if not {"desc", "joints"} <= operator.messages.keys():
                continue
            names = [each["name"] for each in operator.messages["desc"]["joints"]]
            telemetry = operator.messages["joints"]
            position_rad = dict(zip(names, telemetry["position_rad"], strict=True))
            if all(abs(position_rad[joint] - target_rad[joint]) < TOLERANCE_RAD for joint in target_rad):
                return
            if telemetry["epoch"] == lease["epoch"] and telemetry.get("ended_input", 0) >= INPUT:
                sys.exit("setpoints arrived too late, so the robot holds; start again to continue")
            sequence += 1
            setpoint = {
                "epoch": lease["epoch"],
                "sequence": sequence,
                "echo_tick_ms": telemetry["tick_ms"],
                "sent_ms": time.time() * 1000,
                "input": INPUT,
                "target": {"kind": "joints", "position_rad": target_rad},
            }
            operator.publish(topic, seal(setpoint, topic, lease["setpoint_key"]))
            await asyncio.sleep(PERIOD_S)


def show(operator: Operator) -> None:
    """Print the angle of each joint, and position and rotation of each frame, like the page of the paper."""
    description, telemetry = operator.messages["desc"], operator.messages["joints"]
    print(f"{'joint':<16}{'rad':>8}")
    for joint, angle_rad in zip(description["joints"], telemetry["position_rad"], strict=True):
        print(f"{joint['name']:<16}{angle_rad:8.3f}")
    print(f"\n{'frame':<16}{'x y z [m]':<27}rotation w x y z")
    for name, pose in zip(description["frames"], telemetry["frames"], strict=True):
        values = [f"{value:8.3f}" for value in pose]
        print(f"{name:<16}{' '.join(values[:3])} {' '.join(values[3:])}")


async def main() -> None:
    """Move the joints and print them."""
    name, *moves = sys.argv[1:]
    target_rad = {joint: float(value) for joint, _, value in (move.partition("=") for move in moves)}
    operator = Operator(call("POST", "/xmpp/credentials", {"purpose": "view"}))
    await operator.sign_in()
    devices = (await operator.call("GET", "/devices"))["items"]
    device = next((each for each in devices if each["name"] == name), None)
    if device is None:
        sys.exit(f"no device '{name}'; available: {', '.join(each['name'] for each in devices)}")
    await operator.ask("listen", {}, topics=(f"{device['topic']}/desc", f"{device['topic']}/tele/joints"))
    lease = await operator.call("POST", f"/devices/{device['id']}/lease", {"wait_ms": 5000})
    try:
        await stream(operator, f"{device['topic']}/ctl/{lease['epoch']}", lease, target_rad)
    finally:
        await operator.call("DELETE", f"/devices/{device['id']}/lease?epoch={lease['epoch']}")
    show(operator)
    await operator.disconnect()


if __name__ == "__main__":
    asyncio.run(main())
