"""A fixed sequence of API requests by users and a polling robot.

It is sequential and does not wait, so two runs send the same requests in the same order.
"""

import hashlib
from typing import Any

import httpx

from device_agent.protocol import AckStatus, Fault, Measurements, Mode, RunMovement, State, topics
from tests.api.transcript import Transcript
from tests.harness.cloud.cloud import API, MOVE
from tests.harness.cloud.people import Visitor
from tests.harness.cloud.polling import PollingRobot, Site
from tests.harness.hosts import Host

PUBLIC_URL = "http://telescope.test"
"""The configured public URL of the functions."""
UNUSUAL = "grüß 🤖 \u202e'\";--\\ \u0001 %2F"
MINE = "/robot-types/ur5/movements/mine"
SOURCE = '"""Wäve 🤖."""\nrobot.home()\n'
CAPTURE = b"\x00\xff raw" * 1000


class Recorder(Site):
    """Records all requests and responses in a transcript."""

    def __init__(self, base: str) -> None:
        super().__init__(base)
        self.transcript = Transcript()
        self.paused = False

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        response = super().request(method, path, **options)
        if not self.paused:
            self.transcript.write(method, path, response)
        return response


class Conversation:
    """The request sequence. The test compares transcripts; the sequence asserts only essential results."""

    def __init__(self, host: Host, links: list[str]) -> None:
        self.host = host
        self.site = Recorder(host.url)
        self._links = links
        self.robot = PollingRobot(self.site, "arm", "leg")
        self.site.transcript.add_name(self.robot.id, "robot")
        self.site.transcript.add_name(self.robot.public, "robot's key")

    def run(self) -> list[str]:
        """Send all requests; returns the transcript."""
        try:
            self._run()
        finally:
            self.site.close()
        return self.site.transcript.lines

    def _run(self) -> None:
        self.anonymous()
        self.anna, self.again, self.bert = (self.sign_in(link) for link in self._links)
        self.claim()
        self.read()
        self.movements()
        self.lease()
        self.handover()
        self.actions()
        self.queue()
        self.batch()
        self.measure()
        self.upload()
        self.accounts()
        self.invalid_requests()
        self.unpair()

    def anonymous(self) -> None:
        """Without credentials, and with invalid ones."""
        request = self.site.request
        request("GET", f"{API}/health")
        request("GET", f"{API}/devices")
        request("GET", f"{API}/devices", headers={"Authorization": "Bearer nonsense"})
        request("POST", f"{API}/auth/sign-in", json={"link": "wrong"})
        request("POST", f"{API}/auth/sign-in", content=b"{")
        request("POST", f"{API}/auth/sign-in", content=b"\xff\xfe")
        request("POST", f"{API}/auth/sign-in", json={"link": UNUSUAL, "more": 1})
        request("POST", f"{API}/auth/sign-in", content=b" " * 1_000_001)

    def sign_in(self, link: str) -> Visitor:
        response = self.site.request("POST", f"{API}/auth/sign-in", json={"link": link})
        assert response.status_code == 200, response.text
        assert self.site.request("POST", f"{API}/auth/sign-in", json={"link": link}).status_code == 401
        person = Visitor(self.site, response.json())
        person.get("/accounts/me")
        person.get("/spaces")
        return person

    def claim(self) -> None:
        self.robot.request("GET", "/agents/enrollment", token="nonsense")
        code = self.robot.code()
        self.robot.enrollment()
        self.anna.post("/agents/claim", {"code": code, "space": "nowhere"})
        assert self.anna.post("/agents/claim", {"code": f" {code.lower()} "}).status_code == 200
        assert self.bert.post("/agents/claim", {"code": code}).status_code == 404
        self.robot.space = self.robot.enrollment()["space"]
        self.robot.enroll(software="test 2")
        self.robot._keys = self.keys()
        self.robot.open_link()

    def keys(self) -> dict[str, Any]:
        from device_agent.protocol.security import signing

        return {key["id"]: signing.public_key(key["public"]) for key in self.robot.enrollment()["keys"]}

    def read(self) -> None:
        device = self.robot.device
        for person in (self.anna, self.again, self.bert):
            person.get("/agents")
            person.get("/devices")
            for path in (
                "",
                "/lease",
                "/actions",
                "/data",
                "/events",
                "/faults",
                "/latency",
                "/uploads",
                "/diagnostics",
            ):
                response = person.get(f"/devices/{device}{path}")
                assert response.status_code == (404 if person is self.bert else 200), response.text
        for device_id in ("%F0%9F%A4%96", "..", "a%20b", "%01", "x" * 200, "aaaaaaaaaa-arm", f"{device}%20"):
            response = self.anna.get(f"/devices/{device_id}")
            assert response.status_code == 404, f"{device_id}: {response.status_code} {response.text}"

    def movements(self) -> None:
        self.anna.get("/robot-types")
        self.anna.get("/robot-types/ur5")
        self.anna.get("/robot-types/none")
        self.anna.get("/robot-types/ur5/movements", params={"limit": 1})
        assert self.anna.put(MINE, {"source": SOURCE}).status_code == 201
        assert self.anna.put(MINE, {"source": SOURCE, "description": UNUSUAL}).status_code == 422
        printable = "".join(each for each in UNUSUAL if each.isprintable())
        assert self.anna.put(MINE, {"source": SOURCE + "#", "description": printable}).status_code == 200
        self.anna.put(MINE, {"source": ""})
        self.anna.put("/robot-types/ur5/movements/a%20b", {"source": SOURCE})
        self.anna.get(MINE)
        self.anna.get(f"{MINE}/versions")
        assert self.bert.get(MINE).status_code == 404

    def lease(self) -> None:
        path = f"/devices/{self.robot.device}/lease"
        epoch = self.anna.post(path, {"wait_ms": 0}).json()["epoch"]
        self.robot.step()
        assert self.again.post(path, {"wait_ms": 0}).status_code == 409
        assert self.bert.post(path, {"wait_ms": 0}).status_code == 404
        self.again.get(path)
        self.anna.post(path, {"wait_ms": 0, "epoch": epoch, "lease_ms": 60_000})
        self.anna.post(path, {"wait_ms": 0, "epoch": epoch + 1})
        self.anna.post(path, {"lease_ms": 1})
        self.anna.request("DELETE", path, params={"epoch": epoch + 1})
        self.anna.request("DELETE", path)
        assert self.anna.request("DELETE", path, params={"epoch": epoch}).status_code == 204
        self.anna.get(path)
        self.robot.step()

    def handover(self) -> None:
        """Control requests are rejected, withdrawn and accepted; then the lease is taken over and released."""
        path = f"/devices/{self.robot.device}/lease"
        requests = f"{path}/requests"
        assert self.again.post(requests).status_code == 409
        self.anna.post(path, {"wait_ms": 0})
        body = {"wait_ms": 0, "within_ms": 60_000}
        first = self.again.post(requests, body).json()["request"]["id"]
        assert self.again.post(requests, body).status_code == 200
        assert self.anna.post(requests, body).status_code == 409
        assert self.bert.post(requests, body).status_code == 404
        self.again.post(requests, {"within_ms": 1})
        self.robot.step()
        self.anna.get(path)
        assert self.again.post(f"{requests}/{first}/accept").status_code == 403
        assert self.anna.post(f"{requests}/{first}/reject").json()["outcome"] == "rejected"
        assert self.anna.post(f"{requests}/{first}/accept", {"wait_ms": 0}).status_code == 409
        second = self.again.post(requests, body).json()["request"]["id"]
        self.again.delete(f"{requests}/{second}")
        self.again.get(f"{requests}/{second}")
        third = self.again.post(requests, body).json()["request"]["id"]
        accepted = self.anna.post(f"{requests}/{third}/accept", {"wait_ms": 0}).json()
        self.robot.step()
        assert self.again.get(path).json()["lease"]["epoch"] == accepted["epoch"]
        assert self.again.delete(f"{requests}/{third}").status_code == 409
        assert self.anna.get(f"{requests}/{first}").status_code == 404
        self.anna.post(path, {"wait_ms": 0, "epoch": accepted["epoch"] - 1})
        self.anna.post(path, {"take_over": True})
        taken = self.anna.post(path, {"wait_ms": 0, "take_over": True, "reason": UNUSUAL[:6]}).json()
        self.again.get(path)
        assert self.anna.request("DELETE", path, params={"epoch": taken["epoch"]}).status_code == 204
        self.robot.step()

    def actions(self) -> None:
        device, body = self.robot.device, {"request": MOVE}
        action = self.start(idempotency_key="a/b#c? ü".encode().hex())
        assert self.start(idempotency_key="a/b#c? ü".encode().hex()) == action
        self.anna.start(device, idempotency_key="a/b#c? ü".encode().hex(), ttl_ms=5)
        assert self.anna.start(device).status_code == 409
        self.robot.step()
        assert self.anna.action(action)["status"] == "started"
        assert self.again.post(f"/devices/{device}/actions", {**body, "epoch": 1}).status_code == 409
        assert self.bert.get(f"/actions/{action}").status_code == 404
        assert self.bert.post(f"/actions/{action}/cancel").status_code == 404
        self.robot.report(action, AckStatus.DONE, result={"text": UNUSUAL})
        assert self.anna.action(action)["result"] == {"text": UNUSUAL}
        self.robot.report(action, AckStatus.FAILED)
        assert self.anna.action(action)["status"] == "done"
        request = {"kind": "run_movement", "name": "mine", "parameters": {"note": UNUSUAL, "deep": [[{"a": 1.5}]]}}
        wave = self.start(request=request)
        self.robot.step()
        (command,) = self.robot.received(RunMovement)
        assert isinstance(command.request, RunMovement)
        assert command.request.source == SOURCE + "#"
        self.anna.post(f"/actions/{wave}/cancel")
        self.robot.step()
        self.robot.report(wave, AckStatus.CANCELLED)
        self.anna.action(wave)
        page = self.anna.get(f"/devices/{device}/actions", params={"limit": 1}).json()
        rest = self.anna.get(f"/devices/{device}/actions", params={"cursor": page["cursor"]}).json()
        assert [item["id"] for item in (*page["items"], *rest["items"])] == [wave, action]
        for invalid in ({}, {"request": {"kind": "fly"}}, {**body, "more": 1}, {**body, "wait_ms": 30_001}):
            assert self.anna.post(f"/devices/{device}/actions", invalid).status_code == 422

    def start(self, **options: Any) -> str:
        response = self.anna.start(self.robot.device, **options)
        assert response.status_code == 202, response.text
        action: str = response.json()["id"]
        return action

    def queue(self) -> None:
        first, second, third = (self.start(policy="queue") for _ in range(3))
        assert self.anna.action(third)["queue_position"] == 2
        self.anna.post(f"/actions/{second}/cancel")
        self.robot.step()
        self.robot.report(first, AckStatus.DONE)
        self.robot.step()
        assert self.anna.action(third)["status"] == "started"
        waiting = self.start(policy="queue")
        self.anna.post(f"/devices/{self.robot.device}/stop/reset")
        self.robot.step()
        self.anna.post(f"/actions/{third}/cancel")
        self.robot.report(third, AckStatus.FAILED)
        assert self.anna.action(waiting)["status"] == "cancelled"
        self.robot.step()

    def batch(self) -> None:
        body = {"devices": [*self.robot.devices, "aaaaaaaaaa-arm"], "request": MOVE}
        response = self.anna.post("/actions", body)
        assert response.status_code == 207, response.text
        self.site.paused = True  # the order of the devices is not specified
        self.robot.step()
        self.site.paused = False
        for device in self.robot.devices:
            (item,) = self.anna.get(f"/devices/{device}/actions", params={"limit": 1}).json()["items"]
            assert item["status"] == "started"
            name = device.partition("-")[2]
            self.robot.publish(self.robot.topic(topics.ACK, name), self.robot.ack(item["id"], AckStatus.DONE))

        stopped = self.anna.post(f"/devices/{self.robot.device}/stop", {"reason": UNUSUAL[:6]})
        assert (stopped.status_code, stopped.json()["confirmed"]) == (202, False)
        self.robot.step()
        (space,) = self.bert.get("/spaces").json()["items"]
        assert self.anna.post(f"/spaces/{space['id']}/stop").status_code == 404
        assert self.bert.post(f"/spaces/{space['id']}/stop").json() == {"items": []}
        assert self.bert.post("/stop", {"reason": 1}).status_code == 422
        assert self.bert.post("/stop").json() == {"items": []}

    def measure(self) -> None:
        device, robot = self.robot.device, self.robot
        now_ms = robot.cloud.clock.now_ms()
        topic = topics.device(robot.space, robot.id, "arm", topics.TELE, "health")
        for number in range(5):
            at_ms = now_ms - 1000 * number
            robot.publish(
                topic, Measurements(tick_ms=at_ms, at_ms=at_ms, sequence=number, values={"temperature_c": 40.5})
            )
        fault = Fault(code="hot", message="The elbow is hot.", since_ms=now_ms)
        robot.publish_state(State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0, faults=(fault,)))
        self.host.tick()
        self.anna.get(f"/devices/{device}/data")
        data = self.anna.get(f"/devices/{device}/data/health").json()
        assert data["fields"]["temperature_c"]["mean"] == [40.5] * 5
        self.anna.get(f"/devices/{device}/data/none")
        self.anna.get(f"/devices/{device}/data/health", params={"from": "x"})
        (fault_out,) = self.anna.get(f"/devices/{device}/faults").json()["items"]
        self.anna.post(f"/devices/{device}/faults/{fault_out['id']}/acknowledge")
        self.bert.post(f"/devices/{device}/faults/{fault_out['id']}/acknowledge")
        samples = [{"at_ms": now_ms, "ms": each} for each in (1.5, 2.5, 200.0)]
        body = {"transport": "http", "path": "device-cloud", "samples": samples}
        self.anna.post(f"/devices/{device}/latency", body)
        assert self.anna.get(f"/devices/{device}/latency").status_code == 200
        self.anna.post(f"/devices/{device}/latency", {**body, "samples": []})

    def upload(self) -> None:
        path = f"/devices/{self.robot.device}/uploads"
        digest = hashlib.sha256(CAPTURE).hexdigest()
        body = {"stream": "camera", "length": len(CAPTURE), "content_type": "image/png", "name": UNUSUAL[:6]}
        upload = self.anna.post(path, {**body, "sha256": digest}).json()
        sent = httpx.request(
            upload["method"], self.reachable(upload["url"]), content=CAPTURE, headers=upload["headers"], timeout=60
        )
        assert sent.status_code < 300, sent.text
        stored = self.anna.post(f"{path}/{upload['id']}/complete").json()
        assert (stored["length"], stored["sha256"]) == (len(CAPTURE), digest)
        capture = self.anna.get(f"{path}/{upload['id']}").json()
        assert httpx.get(self.reachable(capture["url"]), timeout=60).content == CAPTURE
        self.anna.get(path)
        assert self.bert.get(f"{path}/{upload['id']}").status_code == 404
        self.anna.delete(f"{path}/{upload['id']}")
        self.anna.get(f"{path}/{upload['id']}")

    def reachable(self, url: str) -> str:
        """The URL with the server's real address; the local blob store creates URLs with the public one."""
        return url.replace(PUBLIC_URL, self.host.url)

    def accounts(self) -> None:
        """A password, and an API key."""
        request, password = self.site.request, "grüß 🤖 correct horse"
        request("GET", f"{API}/auth/methods")
        request("GET", f"{API}/auth/oidc/start")
        self.bert.put("/accounts/me/password", {"password": "short"})
        assert self.bert.put("/accounts/me/password", {"password": password}).status_code == 204
        request("POST", f"{API}/auth/password", json={"name": "bert", "password": password + "x"})
        assert request("POST", f"{API}/auth/password", json={"name": "bert", "password": password}).status_code == 200
        created = self.anna.post("/api-keys", {"name": "Wäve 🤖", "role": "viewer", "only": [self.robot.device]})
        assert created.status_code == 201, created.text
        key = {"Authorization": f"Bearer {created.json()['token']}"}
        request("GET", f"{API}/devices", headers=key)
        request("POST", f"{API}/devices/{self.robot.device}/lease", json={}, headers=key)
        request("GET", f"{API}/agents", headers=key)
        self.anna.get("/api-keys")
        assert self.anna.delete(f"/api-keys/{created.json()['api_key']['id']}").status_code == 204
        assert request("GET", f"{API}/devices", headers=key).status_code == 401

    def invalid_requests(self) -> None:
        device = self.robot.device
        for method, path in (("PUT", f"/devices/{device}/lease"), ("PATCH", "/devices"), ("GET", "/nothing")):
            self.anna.request(method, path)
        for query in ({"cursor": UNUSUAL}, {"cursor": "x" * 2001}, {"limit": "0"}, {"limit": "1001"}, {"limit": "ü"}):
            self.anna.get("/devices", params=query)
        self.anna.post("/mqtt/credentials", {"purpose": "control", "device": device, "epoch": 1})
        self.robot.request("GET", "/devices")
        self.robot.request("GET", "/agents/aaaaaaaaaa/commands")

    def unpair(self) -> None:
        assert self.anna.delete(f"/agents/{self.robot.id}").status_code == 204
        assert self.anna.get(f"/devices/{self.robot.device}").status_code == 404
        self.anna.get("/devices")
        self.robot.request("GET", "/agents/enrollment")
        for number in range(6):
            response = self.bert.post("/agents/claim", {"code": f"BCDF-GHJ{'KLMNPQ'[number]}"})
            assert response.status_code in {404, 429}
        assert response.status_code == 429
        assert self.anna.post("/auth/sign-out").status_code == 204
        assert self.anna.get("/accounts/me").status_code == 401
        assert self.again.get("/accounts/me").status_code == 200
