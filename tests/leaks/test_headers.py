"""The headers of every answer, and logs that hold no secret."""

import logging
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization

from function_app.adapters.local.keys import FileKeys
from tests.leaks.test_routes import ask, operations
from tests.leaks.world import World, make
from tests.support.brokers import start_broker
from tests.support.cloud import API, Cloud, problem, settings

HEADERS = {
    "content-security-policy",
    "x-content-type-options",
    "referrer-policy",
    "x-frame-options",
    "cross-origin-opener-policy",
    "cross-origin-resource-policy",
    "permissions-policy",
}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("function_app.services.stop.CONFIRM_MS", 1)
        world = make(tmp_path_factory.mktemp("home"))
        with world.cloud:
            yield world


def test_every_answer_of_every_route_has_the_headers(world: World) -> None:
    """Refused and served ones alike; what holds a secret is kept by nobody."""
    for name, method, path in operations(world):
        for caller in ("nobody", "owner", "agent"):
            _, answer = ask(world, caller, name, method, path)
            missing = HEADERS - set(answer.headers)
            assert not missing, f"{name} by {caller}: {missing}"
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert "access-control-allow-origin" not in answer.headers
            assert "server" not in answer.headers
            if any(word in answer.text for word in ('"secret":"', '"access_token":"', '"token":"', '"password":"')):
                assert answer.headers.get("cache-control") == "no-store", f"{name} by {caller} may be kept"
            world.put_back()


def test_no_secret_is_in_any_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Somebody signs in, claims, shares, makes keys, moves; all of it is logged as loudly as can be."""
    caplog.set_level(logging.DEBUG)
    keys = FileKeys(tmp_path / "keys")
    private = keys.load()
    with start_broker("amqtt", tmp_path / "broker", keys=tmp_path / "keys" / "public.json") as broker:
        with Cloud(settings(tmp_path, broker)) as cloud:
            cloud.start_ingest()
            secrets = _live(cloud)
        listed = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
        said = broker.stderr()
    secrets["signing key"] = (
        private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        .decode()
        .splitlines()[1]
    )
    secrets["signing key in hex"] = private.private_bytes_raw().hex()
    assert len(secrets) > 10
    assert len(caplog.records) > 20, "nothing was logged, so nothing was seen"
    for name, secret in secrets.items():
        assert len(secret) > 7, name
        assert secret not in caplog.text, f"{name} is in the log"
        assert secret not in said, f"{name} is in the broker's log"
        assert secret not in listed, f"{name} is in a program's arguments"


def _live(cloud: Cloud) -> dict[str, str]:
    """Use every kind of secret there is, rightly and wrongly; gives all of them."""
    link = cloud.link("anna")
    page = cloud.client()
    signed = cloud.run(page.post(f"{API}/auth/sign-in", json={"link": link}))
    token = signed.json()["access_token"]
    anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
    password = "correct horse battery"
    assert anna.put("/accounts/me/password", {"password": password}).status_code == 204
    for tried in (password, "wrong wrong wrong"):
        cloud.ask("POST", f"{API}/auth/password", json={"name": "anna", "password": tried})
    cloud.ask("POST", f"{API}/auth/sign-in", json={"link": link})
    robot = cloud.robot()
    code = robot.code()
    assert anna.post("/agents/claim", {"code": code}).status_code == 200
    robot.space = robot.enrollment()["space"]
    problem(anna.post("/agents/claim", {"code": code}), 404, "claim-code-unknown")
    key = anna.post("/api-keys", {"name": "app", "role": "operator", "days": 1}).json()["token"]
    by_key = {"Authorization": f"Bearer {key}"}
    assert cloud.ask("GET", f"{API}/devices", headers=by_key).status_code == 200
    problem(cloud.ask("GET", f"{API}/devices", headers={"Authorization": f"Bearer {key}x"}), 401, "unauthorized")
    invitation = anna.post(f"/devices/{robot.device}/invitations", {"role": "viewer"}).json()["secret"]
    bert.post("/invitations/redeem", {"secret": invitation})
    bert.post("/invitations/redeem", {"secret": invitation})
    epoch = anna.take(robot.device, wait_ms=0).json()["epoch"]
    control = anna.post("/mqtt/credentials", {"purpose": "control", "device": robot.device, "epoch": epoch}).json()
    watch = anna.post("/mqtt/credentials", {"purpose": "watch"}).json()
    agent = robot.token()
    own = robot.ask("POST", "/mqtt/credentials", token=agent, json={"purpose": "agent"}).json()
    capture = {"stream": "camera", "length": 3, "content_type": "image/png"}
    address = anna.post(f"/devices/{robot.device}/uploads", capture).json()["url"]
    anna.post(f"/devices/{robot.device}/stop", {"reason": "x"})
    cloud.sweep()
    anna.delete(f"/agents/{robot.id}")
    anna.post("/auth/sign-out")
    problem(anna.get("/accounts/me"), 401, "unauthorized")
    return {
        "link": link,
        "access token": token,
        "another access token": anna.token,
        "cookie": str(page.cookies["telescope_session"]),
        "CSRF token": str(cloud.run(page.get(f"{API}/accounts/me")).json().get("csrf_token") or token),
        "password": password,
        "wrong password": "wrong wrong wrong",
        "claim code": code,
        "API key": key.split("_", 2)[2],
        "invitation": invitation,
        "control": control["password"],
        "watch": watch["password"],
        "agent's token": agent,
        "agent's credentials": own["password"],
        "upload address": address.rpartition("/")[2],
    }
