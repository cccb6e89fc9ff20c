"""Two tenants in one store, callers of every role, and marked data.

Without a broker: agents poll, and their messages go directly to the ingest. After each request the tables are
restored, so that the cells of the matrix are independent.
"""

import copy
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import httpx

from device_agent.protocol import Fault, Measurements, Mode, Presence, State, codec
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, BASE, Cloud, Person, settings
from tests.harness.cloud.memory import NO_FOLDER, Memory
from tests.harness.paths import ROOT

OWNER = "Anneliese Musterfrau"
LABEL = "Kronjuwel"
MOVEMENT = "secretdance"
SOURCE = "'only for permitted accounts'"
TASK = "red_cube_in_green_tray"
TABLES_OF_REJECTIONS = {records.ATTEMPTS, records.AUDIT, records.FORGET, records.EVENTS}
"""Tables that record a rejected request. No other table may change."""

Ask = Callable[..., httpx.Response]
Rows = dict[tuple[str, str, str], str]


@dataclass
class World:
    """Callers, and the resources that they request."""

    cloud: Cloud
    callers: dict[str, Ask]
    ids: dict[str, str]
    """Path parameter → Anneliese's; ``<operation>.<parameter>`` where one operation needs another."""
    bodies: dict[str, dict[str, Any]]
    marks: set[str] = field(default_factory=set)
    """Texts that must not reach a caller without access."""
    foreign: tuple[str, ...] = ()
    """Texts in the partition keys of Anneliese's rows."""

    def rows(self) -> Rows:
        """Etag of each row."""
        partitions = self._partitions.items()
        return {(*where, key): row[0] for where, found in partitions for key, row in found.rows.items()}

    def save(self) -> None:
        self._kept = copy.deepcopy(self._partitions)

    def restore(self) -> None:
        """Restore the saved tables."""
        self._partitions.clear()
        self._partitions.update(copy.deepcopy(self._kept))

    @property
    def _partitions(self) -> dict[tuple[str, str], Any]:
        assert self.cloud.memory is not None
        return self.cloud.memory.tables._partitions


def make(memory: Memory) -> World:
    """Create the world, with a mark in each text field of Anneliese's data."""
    cloud = Cloud(settings(NO_FOLDER), memory=memory)
    for silent, name in ((cloud.functions.bus, "publish"), (cloud.functions.access, "revoke")):
        setattr(silent, name, _nothing)
    anna, other = cloud.sign_in(OWNER), cloud.sign_in(OWNER)
    people = {
        name: cloud.sign_in(name) for name in ("stranger", "viewer", "operator", "space viewer", "space operator")
    }
    robot, foreign = _paired(cloud, anna), _paired(cloud, people["stranger"])
    device, space = robot.device, robot.space
    anna.put(f"/robot-types/ur5/movements/{MOVEMENT}", {"source": SOURCE, "description": "geheim"})
    _made(anna.post("/spaces", {"name": "Speicher"}))  # an owner's only space cannot be transferred
    invitations = {
        "withdraw_device_invitation": _made(anna.post(f"/devices/{device}/invitations", {"role": "viewer"})),
        "withdraw_space_invitation": _made(anna.post(f"/spaces/{space}/invitations", {"role": "viewer"})),
        "withdraw_space_transfer": _made(anna.post(f"/spaces/{space}/transfers", {})),
        "withdraw_agent_transfer": _made(anna.post(f"/agents/{robot.id}/transfers", {})),
    }
    for name, on in (("viewer", f"devices/{device}"), ("operator", f"devices/{device}")):
        _made(anna.post(f"/{on}/shares", {"account": name, "role": name}))
    for role in ("viewer", "operator"):
        _made(anna.post(f"/spaces/{space}/shares", {"account": f"space {role}", "role": role}))
    app = {"name": "app", "days": 1}
    keys = {role: _made(anna.post("/api-keys", {**app, "role": role})) for role in ("viewer", "operator")}
    epoch = anna.take_lease(device, lease_ms=600_000, wait_ms=0).json()["epoch"]
    action = anna.start(device, epoch=epoch).json()["id"]
    request = _made(other.post(f"/devices/{device}/lease/requests", {"wait_ms": 0}))["request"]["id"]
    _publish_data(cloud, robot, epoch)
    upload = _upload(cloud, anna, device)
    _record(cloud, anna, robot, epoch)
    _made(anna.post(f"/robot-types/ur5_gripper/tasks/{TASK}/batches", _batch("geheim")))
    fault = anna.get(f"/devices/{device}/faults").json()["items"][0]["id"]
    ids = {
        "device": device,
        "agent": robot.id,
        "space": space,
        "action": action,
        "request_id": request,
        "fault": fault,
        "upload": upload,
        "epoch": str(epoch),
        "stream": "hidden",
        "preview": _preview(anna),
        "robot_type": "ur5",
        "name": MOVEMENT,
        **{f"{name}.robot_type": "ur5_gripper" for name in ("list_tasks", "get_task", "list_trials", "publish_trials")},
        "task": TASK,
        "get_robot_type_file.name": "ur5.xml",
        "get_device_robot_type_file.name": "ur5.xml",
        "account": people["viewer"].account,
        "unshare_space.account": people["space viewer"].account,
        "session": other.session,
        "key": keys["viewer"]["api_key"]["id"],
        **{f"{name}.invitation": made["id"] for name, made in invitations.items()},
    }
    world = World(
        cloud,
        callers={
            "anonymous": lambda method, path, **more: cloud.request(method, API + path, **more),
            **{name: person.request for name, person in people.items()},
            "owner": anna.request,
            **{f"{role} key": _by_key(cloud, key["token"]) for role, key in keys.items()},
            "agent": robot.request,
            "foreign agent": foreign.request,
        },
        ids=ids,
        bodies=_bodies(device, space, epoch, robot.introduction(transport="http")),
        marks={OWNER, LABEL, MOVEMENT, SOURCE, anna.account, anna.session, other.session, "geheim", "Kurzschluss"},
        foreign=(anna.account, robot.id, space),
    )
    world.marks |= {made["secret"] for made in invitations.values()} | {
        action,
        request,
        fault,
        upload,
        robot.id,
        space,
        ids["preview"],
    }
    for caller in ("viewer key", "operator key"):
        assert world.callers[caller]("GET", "/accounts/me").status_code == 200, (
            "the use of a key must be recorded once an hour"
        )
    world.save()
    return world


async def _nothing(*_: object, **__: object) -> None:
    """Do nothing, because there is no broker."""


def _made(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code in {200, 201, 202}, answer.text
    found: dict[str, Any] = answer.json()
    return found


def _by_key(cloud: Cloud, token: str) -> Ask:
    return lambda method, path, **more: cloud.request(
        method, API + path, headers={"Authorization": f"Bearer {token}"}, **more
    )


def _paired(cloud: Cloud, owner: Person) -> Robot:
    robot = cloud.robot()
    devices = [{"name": "arm", "kind": "arm", "robot_type": "ur5", "label": LABEL if owner.name == OWNER else "x"}]
    code = robot.enroll(transport="http", devices=devices).json()["claim_code"]
    assert owner.post("/agents/claim", {"code": code}).status_code == 200
    robot.space = robot.enrollment()["space"]
    return robot


def _publish_data(cloud: Cloud, robot: Robot, epoch: int) -> None:
    """Set the device online, with a fault and a measurement."""
    at_ms = cloud.clock.now_ms()
    short = Fault(code="short", message="Kurzschluss", since_ms=1)
    state = State(device="arm", at_ms=at_ms, tick_ms=1, mode=Mode.FAULT, epoch=epoch, faults=(short,))
    measured = Measurements(at_ms=at_ms, tick_ms=1, sequence=1, values={"geheim": 1.0})
    top = f"ts/v1/{robot.space}/{robot.id}"
    published = {
        f"{top}/conn": Presence(online=True, session=1, at_ms=at_ms),
        f"{top}/arm/state": state,
        f"{top}/arm/tele/hidden": measured,
    }
    messages = [{"topic": topic, "payload": json.loads(codec.encode(message))} for topic, message in published.items()]
    answer = robot.request("POST", f"/agents/{robot.id}/messages", json={"messages": messages})
    assert answer.status_code == 200, answer.text
    assert '"rejected"' not in answer.text, answer.text


def _preview(anna: Person) -> str:
    """Upload a robot type preview, without a check. Returns its id."""
    folder = ROOT / "robots" / "ur5"
    manifest = (folder / "robot.toml").read_text().replace('type = "ur5"', 'type = "mine"')
    files = {name: (folder / name).read_text() for name in ("ur5.xml", "scene.xml")}
    return str(_made(anna.post("/robot-type-previews", {"manifest": manifest, "files": files, "wait_ms": 0}))["id"])


def _upload(cloud: Cloud, anna: Person, device: str) -> str:
    started = _made(
        anna.post(
            f"/devices/{device}/uploads",
            {"stream": "camera", "length": 3, "content_type": "image/png", "name": "geheim.png"},
        )
    )
    put = cloud.request(
        started["method"], started["url"].removeprefix(BASE), headers=started["headers"], content=b"abc"
    )
    assert put.status_code == 201, put.text
    _made(anna.post(f"/devices/{device}/uploads/{started['id']}/complete"))
    return str(started["id"])


def _segment(epoch: int) -> dict[str, Any]:
    sha256 = hashlib.sha256(b"abc").hexdigest()
    announced = {"started_ms": 1, "ended_ms": 2, "length": 3, "sha256": sha256}
    overview = {"overview_length": 3, "overview_sha256": sha256}
    return {"device": "arm", "epoch": epoch, "segment": 0, **announced, **overview}


def _record(cloud: Cloud, anna: Person, robot: Robot, epoch: int) -> None:
    """Store a recording of the session with one episode."""
    path = f"/agents/{robot.id}/recordings"
    started = _made(robot.request("POST", path, json=_segment(epoch)))
    for name in ("segment", "overview"):
        request = started[name]
        url = request["url"].removeprefix(BASE)
        put = cloud.request(request["method"], url, headers=request["headers"], content=b"abc")
        assert put.status_code == 201, put.text
    done = robot.request("POST", f"{path}/complete", json={"device": "arm", "epoch": epoch, "segment": 0})
    assert done.status_code == 204, done.text
    episodes = {"episodes": [{"start_s": 0, "end_s": 1, "label": "geheim"}]}
    path = f"/devices/{robot.device}/sessions/{epoch}/episodes"
    assert anna.request("PUT", path, json=episodes, headers={"If-Match": '"0"'}).status_code == 200


def _bodies(device: str, space: str, epoch: int, introduction: dict[str, Any]) -> dict[str, dict[str, Any]]:
    move = {"kind": "move_joints", "position_rad": {"elbow": 1.0}}
    times = {"transport": "http", "path": "device-cloud", "samples": [{"at_ms": 1, "ms": 1}]}
    capture = {"stream": "camera", "length": 3, "content_type": "image/png"}
    return {
        "sign_in": {"link": "x" * 43},
        "sign_in_by_password": {"name": OWNER, "password": "wrong wrong wrong"},
        "put_password": {"password": "correct horse battery"},
        "add_second_factor": {},
        "enable_second_factor": {"code": "000000"},
        "renew_recovery_codes": {"code": "000000"},
        "disable_second_factor": {"code": "000000"},
        "create_space": {"name": "Attic"},
        "create_api_key": {"name": "app", "role": "viewer", "days": 1},
        "enroll_agent": introduction,
        "create_account": {"name": "new", "password": "correct horse battery", "invitation": "x" * 43},
        "start_oidc_sign_in_with_invitation": {"invitation": "x" * 43},
        "certify": {"request": "x"},
        "claim_agent": {"code": "BCDF-GHJK"},
        "rename_device": {"label": "Elbow grease"},
        "set_camera_consent": {"cameras": [], "wait_ms": 0},
        "move_agent": {"space": space},
        "post_agent_messages": {"messages": [{"topic": "t", "payload": {}}]},
        "share_device": {"account": "stranger", "role": "operator"},
        "share_space": {"account": "stranger", "role": "operator"},
        "invite_to_device": {"role": "operator"},
        "invite_to_space": {"role": "operator"},
        "transfer_agent": {},
        "transfer_space": {},
        "look_up_invitation": {"secret": "x" * 43},
        "redeem_invitation": {"secret": "x" * 43},
        "take_lease": {"wait_ms": 0},
        "request_control": {"wait_ms": 0},
        "accept_control_request": {"wait_ms": 0},
        "stop_device": {"reason": "x"},
        "stop_space": {"reason": "x"},
        "stop_all": {"reason": "x"},
        "start_action": {"request": move, "epoch": epoch},
        "start_actions": {"devices": [device], "request": move},
        "add_robot_type": {"manifest": "x", "files": {}},
        "add_robot_type_preview": {"manifest": "x", "files": {}},
        "put_movement": {"source": "1"},
        "check_movement": {"source": "1"},
        "mqtt_credentials": {"purpose": "control", "device": device, "epoch": epoch},
        "xmpp_credentials": {},
        "xmpp_verify": {"username": "x", "password": "x"},
        "add_latency": times,
        "add_agent_latency": {"device": "arm", **times},
        "begin_upload": capture,
        "begin_agent_upload": {"device": "arm", **capture},
        "complete_agent_upload": {"device": "arm"},
        "begin_recording": _segment(epoch),
        "complete_recording": {"device": "arm", "epoch": epoch, "segment": 0},
        "set_episodes": {"episodes": []},
        "publish_trials": _batch("1.0"),
    }


def _batch(software: str) -> dict[str, Any]:
    digest = "0" * 64
    hashes = {"tasks_sha256": digest, "movement_sha256": digest}
    return {"first_seed": 0, "trials": 1, "successes": 1, "software": software, "type_version": 1, **hashes}


def texts(answer: httpx.Response) -> str:
    """All text of a response: headers and body."""
    return json.dumps(dict(answer.headers)) + answer.text
