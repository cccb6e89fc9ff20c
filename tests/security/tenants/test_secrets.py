"""A full run of the product with all loggers at DEBUG: no secret appears in any log.

Each operation with a secret runs once correctly and once incorrectly. Output for one
user (the link of the ready line, the claim code of an agent) goes to the terminal and to no log.
"""

import base64
import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import httpx
import pytest
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from device_agent.protocol import topics
from function_app.ports.broker_access import Credentials
from tests.harness.browser.product import Machine, start_machine
from tests.harness.network.brokers import Client
from tests.harness.paths import ROOT

PASSWORD, WRONG, NEWER = "correct horse battery", "wrong wrong wrong wrong", "staple correct horse"
CLIENT_SECRET = "of the provider, 32 letters long"
MOVE = {"kind": "move_joints", "position_rad": {"wrist_3": 0.2}}
LOUD = '''"""Set every logger of this process to DEBUG, regardless of its configuration."""
import logging

_set, _configure = logging.Logger.setLevel, logging.basicConfig
logging.Logger.setLevel = lambda self, _level: _set(self, logging.DEBUG)
logging.basicConfig = lambda **options: _configure(**{**options, "level": logging.DEBUG})
'''
KINDS = {
    "a JSON web token": re.compile(r"eyJ[\w-]{10,}\.[\w-]{10,}\.[\w-]{40,}"),
    "an API key": re.compile(r"\bts_[a-z0-9]{6,}_[\w-]{20,}"),
    "a private key": re.compile("PRIVATE KEY"),
    "an Authorization header": re.compile(r"(?i)authorization\W{1,6}(bearer|basic)\s+[\w-]{10,}"),
}
"""Secrets that agents and programs generate; the test knows only their patterns."""


PEM = re.compile(rb"-----BEGIN PRIVATE KEY-----.*?-----END PRIVATE KEY-----", re.DOTALL)


class Run:
    """One run: the secrets in use, and output other than log files."""

    def __init__(self, machine: Machine, folder: Path) -> None:
        self.machine = machine
        self.folder = folder
        self.secrets: dict[str, str] = {}
        self.logs: dict[str, str] = {}
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def program(self, name: str, *arguments: str) -> str:
        """Run an administrator's command. Returns its output; keeps its log."""
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            cwd=ROOT,
            env=os.environ | {"TELESCOPE_HOME": str(self.machine.home), "TELESCOPE_PORT": str(self.machine.port)},
            capture_output=True,
            text=True,
            check=True,
        )
        self.logs[name] = done.stderr
        return done.stdout

    def sign_in(self, name: str) -> httpx.Client:
        """The console of an account."""
        shown = self.program(f"link of {name}", "function_app", "sign-in-link", "--account", name)
        link = shown.strip().partition("#sign-in=")[2]
        page = self.page()
        done = page.post("/auth/sign-in", json={"link": link})
        assert done.status_code == 200, done.text
        assert page.post("/auth/sign-in", json={"link": link}).status_code == 401
        self._signed_in(name, page, done.json())
        self.secrets[f"link of {name}"] = link
        return page

    def page(self) -> httpx.Client:
        return self._open.enter_context(httpx.Client(base_url=f"{self.machine.url}/api/v1", timeout=60))

    def by_password(self, name: str, password: str) -> httpx.Client | None:
        page = self.page()
        done = page.post("/auth/password", json={"name": name, "password": password})
        if done.status_code != 200:
            return None
        self._signed_in(f"{name} by password", page, done.json())
        return page

    def _signed_in(self, name: str, page: httpx.Client, answer: dict[str, Any]) -> None:
        page.headers["X-CSRF-Token"] = answer["csrf_token"]
        self.secrets[f"access token of {name}"] = answer["access_token"].rpartition(".")[2]
        self.secrets[f"CSRF token of {name}"] = answer["csrf_token"]
        self.secrets[f"cookie of {name}"] = page.cookies["telescope_session"].rpartition(".")[2]


def ok(answer: httpx.Response) -> Any:
    assert answer.is_success, f"{answer.request.method} {answer.request.url}: {answer.status_code} {answer.text}"
    return answer.json() if answer.content else None


def people(run: Run) -> tuple[httpx.Client, httpx.Client]:
    """Sign in, set and change passwords, enter wrong ones, and start at an unreachable provider."""
    demo, bert = run.sign_in("demo"), run.sign_in("bert")
    ok(demo.put("/accounts/me/password", json={"password": PASSWORD}))
    ok(demo.put("/accounts/me/password", json={"password": NEWER, "old_password": PASSWORD}))
    assert run.by_password("demo", WRONG) is None
    again = run.by_password("demo", NEWER)
    assert again is not None
    ok(again.post("/auth/sign-out"))
    token = ok(demo.post("/auth/token"))["access_token"]
    run.secrets["next access token"] = token.rpartition(".")[2]
    forged = token[:-4] + "AAAA"
    assert run.page().get("/accounts/me", headers={"Authorization": f"Bearer {forged}"}).status_code == 401
    assert demo.get("/auth/oidc/start").status_code == 503
    run.secrets |= {"password": PASSWORD, "wrong password": WRONG, "newer password": NEWER}
    run.secrets |= {"client secret": CLIENT_SECRET, "forged token": forged.rpartition(".")[2]}
    return demo, bert


def keys_and_invitations(run: Run, demo: httpx.Client, bert: httpx.Client, device: str) -> None:
    """Create, use, misuse and revoke keys and links."""
    made = ok(demo.post("/api-keys", json={"name": "app", "role": "operator", "days": 1}))
    by_key = {"Authorization": f"Bearer {made['token']}"}
    ok(run.page().get("/devices", headers=by_key))
    ok(demo.delete(f"/api-keys/{made['api_key']['id']}"))
    assert run.page().get("/devices", headers=by_key).status_code == 401
    shown = run.program("API key", "function_app", "api-key", "--account", "demo", "--name", "other").strip()
    for name, token in (("API key", made["token"]), ("API key of the terminal", shown)):
        run.secrets[name] = token.split("_", 2)[2]
    for name in ("redeemed", "for a newcomer", "left"):
        run.secrets[f"invitation {name}"] = ok(demo.post(f"/devices/{device}/invitations", json={"role": "operator"}))[
            "secret"
        ]
    redeemed = {"secret": run.secrets["invitation redeemed"]}
    ok(bert.post("/invitations/lookup", json=redeemed))
    ok(bert.post("/invitations/redeem", json=redeemed))
    assert bert.post("/invitations/redeem", json=redeemed).status_code == 404
    newcomer = {"invitation": run.secrets["invitation for a newcomer"], "name": "carl", "password": PASSWORD}
    ok(run.page().post("/auth/accounts", json=newcomer))
    transfer = ok(demo.post(f"/agents/{device.partition('-')[0]}/transfers", json={}))
    run.secrets["transfer"] = transfer["secret"]


def control(run: Run, demo: httpx.Client, bert: httpx.Client, device: str) -> None:
    """Take control, move, publish, hand over, and connect to the broker with wrong credentials."""
    epoch = ok(demo.post(f"/devices/{device}/lease", json={"wait_ms": 20_000}))["epoch"]
    ok(demo.post(f"/devices/{device}/actions", json={"request": MOVE, "epoch": epoch}))
    given = {
        "control": ok(demo.post("/mqtt/credentials", json={"purpose": "control", "device": device, "epoch": epoch})),
        "watch": ok(demo.post("/mqtt/credentials", json={"purpose": "view"})),
        "watch of a guest": ok(bert.post("/mqtt/credentials", json={"purpose": "view"})),
    }
    for name, issued in given.items():
        run.secrets[f"MQTT password, {name}"] = issued["password"]
        right = Credentials(issued["username"], issued["password"])
        for transport, offset in (("tcp", 1), ("websockets", 2)):
            for credentials in (right, Credentials(right.username, right.password + "x")):
                client = Client(
                    issued["client_id"],
                    credentials,
                    port=run.machine.port + offset,
                    transport=transport,  # type: ignore[arg-type]
                ).open()
                assert client.connected.is_set() is (credentials is right)
                if credentials is right:
                    client.subscribe("#")
                    client.subscribe(topics.device("any", "any", "any", topics.STATE, ""))
                client.close()
    ok(demo.post(f"/devices/{device}/stop", json={"reason": "x"}))
    capture = {"stream": "camera", "length": 3, "content_type": "image/png"}
    upload = ok(demo.post(f"/devices/{device}/uploads", json=capture))
    run.secrets["upload address"] = upload["url"].rpartition("/")[2]
    httpx.put(upload["url"], headers=upload["headers"], content=b"abc")
    assert httpx.put(upload["url"] + "x", headers=upload["headers"], content=b"abc").is_client_error


def pairing(run: Run, demo: httpx.Client) -> None:
    """Claim another agent, request its credentials, unpair it, and enter a wrong code."""
    home = str(run.folder / "other")
    server = ("--server", run.machine.url, "--device", "other=ur5")
    shown = run.program("enrolment", "device_agent", "enroll", "--home", home, *server, "--no-wait").split()
    code = shown[shown.index("code") + 1]
    assert demo.post("/agents/claim", json={"code": "BCDF-GHJK"}).status_code == 404
    agent = ok(demo.post("/agents/claim", json={"code": code}))["agent"]
    assert demo.post("/agents/claim", json={"code": code}).status_code == 404
    run.logs["paired"] = run.program("pairing", "device_agent", "enroll", "--home", home, "--no-wait")
    run.logs["pinned"] = run.program("repin", "device_agent", "repin", "--home", home)
    ok(demo.delete(f"/agents/{agent}"))
    run.secrets |= {"claim code": code, "claim code without its hyphen": code.replace("-", "")}


def rotation(run: Run) -> None:
    run.logs["rotated"] = run.program("rotation", "function_app", "rotate-keys")


def stored_secrets(run: Run) -> dict[str, str]:
    """Secrets in files of mode 0600: private keys in each encoding, and passwords of programs."""
    found = {}
    for path in [*run.machine.home.rglob("*"), *run.folder.rglob("*")]:
        if not path.is_file() or path.stat().st_mode & 0o077:
            continue
        if path.suffix == ".password":
            found[f"{path}"] = path.read_text().strip()
        content = path.read_bytes()
        for number, pem in enumerate(PEM.findall(content)):
            raw = load_pem_private_key(pem.replace(b"\\n", b"\n"), None).private_bytes_raw()  # type: ignore[union-attr]
            found[f"{path} {number} in hex"] = raw.hex()
            found[f"{path} {number} in base64"] = base64.b64encode(raw).decode().rstrip("=")
            found[f"{path} {number} in base64url"] = base64.urlsafe_b64encode(raw).decode().rstrip("=")
    return found


def use(run: Run) -> None:
    """All operations, from the first sign-in to the sign-out."""
    demo, bert = people(run)
    device = next(each["id"] for each in ok(demo.get("/devices"))["items"] if each["name"] == "ur5")
    keys_and_invitations(run, demo, bert, device)
    control(run, demo, bert, device)
    pairing(run, demo)
    rotation(run)
    run.logs["programs"] = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    for page in (demo, bert):
        ok(page.post("/auth/sign-out"))
        assert page.get("/accounts/me").status_code == 401


def whole_run(broker: str, folder: Path) -> Run:
    """Run all operations and stop the product; ``logs`` then contains all logs."""
    quiet = folder / "loud"
    quiet.mkdir()
    (quiet / "sitecustomize.py").write_text(LOUD)
    settings = {
        "PYTHONPATH": str(quiet),
        "TELESCOPE_BROKER": broker,
        "TELESCOPE_OIDC_ISSUER": "http://127.0.0.1:9",
        "TELESCOPE_OIDC_CLIENT_ID": "telescope",
        "TELESCOPE_OIDC_CLIENT_SECRET": CLIENT_SECRET,
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        with start_machine(folder / "machine") as machine:
            assert machine.process.poll() is None, "".join(machine.lines)
            with Run(machine, folder) as run:
                use(run)
            run.secrets |= stored_secrets(run)
    for path in [*(machine.home / "logs").glob("*"), *(machine.home / "trace").glob("*")]:
        run.logs[path.name] = path.read_text(errors="replace")
    shown = re.search(r"#sign-in=(\S+)", machine.ready)
    assert shown
    run.secrets["link of the ready line"] = shown[1]
    run.logs["terminal"] = "".join(line for line in machine.lines if line != machine.ready)
    return run


def leaks(run: Run) -> Iterator[str]:
    for place, text in run.logs.items():
        for name, secret in run.secrets.items():
            assert len(secret) > 7, name
            raw = secret.encode()
            for form in (secret, raw.hex(), raw.hex(" "), base64.b64encode(raw).decode().rstrip("=")):
                if form in text:
                    yield f"{name} is in {place}: {text[max(0, text.index(form) - 300) :][:400]!r}"
        for name, pattern in KINDS.items():
            found = pattern.search(text) if place != "programs" else None
            if found:
                yield f"{name} is in {place}: {text[max(0, found.start() - 300) :][:400]!r}"


@pytest.mark.timeout(300)
@pytest.mark.parametrize("broker", ["amqtt", pytest.param("mosquitto", marks=pytest.mark.long)])
def test_no_secret_is_in_any_log(broker: str, tmp_path: Path) -> None:
    run = whole_run(broker, tmp_path)
    assert {"functions.log", "worker.log", "broker.log", "agent.log", "ur5.ndjson"} <= set(run.logs)
    assert "DEBUG" in run.logs["functions.log"] + run.logs["worker.log"], "the functions did not log at DEBUG"
    assert "DEBUG" in run.logs["agent.log"], "the agent did not log at DEBUG"
    assert len(run.secrets) > 35, sorted(run.secrets)
    size = sum(map(len, run.logs.values()))
    print(f"{len(run.secrets)} secrets, {len(run.logs)} logs of {size} characters")  # noqa: T201
    assert not list(leaks(run))
