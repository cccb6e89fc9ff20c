"""The released agent works with this server, this agent with the released server, and both servers on one store."""

import contextlib
import functools
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.compatibility.release import ReleaseUnavailableError, unpack
from tests.harness.cloud.cloud import API
from tests.harness.hosts.host import Program, environment_of, start_program
from tests.harness.network.brokers import HOST, PATIENCE_S, wait_until
from tests.harness.network.ports import free_port
from tests.harness.paths import ROOT

MOVE = {"kind": "move_joints", "position_rad": {"shoulder_pan": 0.1}, "speed": 1.0}
LATER = {"of": "a newer server"}


class Versions:
    """Servers of both versions over one store, each with its own broker and worker, and one person."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self._stack = stack
        self.trees = {"current": ROOT, "released": unpack(folder / "release")}
        self.home = folder / "home"
        link = self.run("released", "function_app", "sign-in-link").partition("#sign-in=")[2]  # creates the keys
        brokers = {version: self._broker(version, folder / f"{version}.json") for version in self.trees}
        self.people = {version: self._serve(version, broker) for version, broker in brokers.items()}
        for person in self.people.values():
            wait_until(functools.partial(_answers, person), "the server")
        signed_in = self.people["released"].post("/auth/sign-in", json={"link": link}).json()
        for person in self.people.values():
            person.headers["Authorization"] = f"Bearer {signed_in['access_token']}"

    def run(self, version: str, module: str, *arguments: str) -> str:
        """The output of a command of one version."""
        command = [sys.executable, "-m", module, *arguments]
        environment = environment_of({"TELESCOPE_HOME": str(self.home), "TELESCOPE_MQTT_PORT": "1"})
        done = subprocess.run(
            command, cwd=self.trees[version], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def start_agent(self, agent: str, server: str, folder: Path) -> tuple[Program, str]:
        """A running agent of one version that is paired at a server of another; and its device."""
        home = ["--home", str(folder)]
        address = str(self.people[server].base_url.copy_with(path=""))
        options = ["--server", address, "--device", "arm=ur5", "--no-wait"]
        words = self.run(agent, "device_agent", "enroll", *home, *options).split()
        code = words[words.index("code") + 1]
        program = self._start(agent, {}, "device_agent", "run", *home)
        (device,) = self.people[server].post("/agents/claim", json={"code": code}).json()["devices"]
        return program, device["id"]

    def _broker(self, version: str, keys: Path) -> Program:
        shutil.copy(self.home / "keys" / "public.json", keys)  # each broker stores its revocations beside its keys
        ports = ["--host", HOST, "--tcp-port", "0", "--websocket-port", "0"]
        return self._start(version, {}, "infra.embedded_broker", *ports, "--keys", str(keys))

    def _serve(self, version: str, broker: Program) -> httpx.Client:
        listening = dict(part.split("=") for part in broker.read_line().split()[1:])
        port = free_port()
        variables = {"TELESCOPE_HOME": str(self.home), "TELESCOPE_PORT": str(port)}
        variables |= {"TELESCOPE_MQTT_PORT": listening["tcp"], "TELESCOPE_WEBSOCKET_PORT": listening["websocket"]}
        for program in ("serve", "work"):
            self._start(version, variables, "function_app", program)
        return self._stack.enter_context(httpx.Client(base_url=f"http://{HOST}:{port}{API}", timeout=PATIENCE_S))

    def _start(self, version: str, variables: dict[str, str], *arguments: str) -> Program:
        program = start_program(["-m", *arguments], environment_of(variables), folder=self.trees[version])
        return self._stack.enter_context(program)


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Versions]:
    with contextlib.ExitStack() as stack:
        yield Versions(tmp_path_factory.mktemp("versions"), stack)


@pytest.mark.parametrize(("agent", "server"), [("released", "current"), ("current", "released")])
def test_an_agent_of_one_version_works_with_a_server_of_another(
    versions: Versions, tmp_path: Path, agent: str, server: str
) -> None:
    program, device = versions.start_agent(agent, server, tmp_path / "agent")
    person, path = versions.people[server], f"/devices/{device}"
    wait_until(
        lambda: program.process.poll() is not None or person.get(path).json()["state"] is not None, "the agent's state"
    )
    assert program.process.poll() is None, program.stderr()
    shown = person.get(path).json()
    assert (shown["online"], shown["incompatible"]) == (True, None)
    done = person.post(f"{path}/actions", json={"request": MOVE, "wait_for": "done", "wait_ms": 20_000}).json()
    assert done["status"] == "done", done
    assert person.post(f"{path}/stop").json()["confirmed"] is True
    wait_until(lambda: not _undelivered(tmp_path / "agent"), "the delivery of all acks: confirmed, or by PUBACK")
    assert "rejected" not in program.stderr()


@pytest.mark.parametrize(("first", "second"), [("released", "current"), ("current", "released")])
def test_a_server_changes_a_row_of_another_version_and_keeps_its_unknown_fields(
    versions: Versions, first: str, second: str
) -> None:
    writer, reader = versions.people[first], versions.people[second]
    space = writer.post("/spaces", json={"name": "Lab"}).json()["id"]
    key = versions.run(first, "function_app", "api-key", "--name", first)
    with _store(versions.home) as store:
        newer = "UPDATE rows SET data = json_set(data, '$.later', json(?), '$.\"~schema\"', 9) WHERE tab = 'ApiKeys'"
        store.execute(newer, [json.dumps(LATER)])
    assert space in {each["id"] for each in reader.get("/spaces").json()["items"]}
    used = httpx.get(f"{reader.base_url}devices", headers={"Authorization": f"Bearer {key}"}, timeout=PATIENCE_S)
    assert used.status_code == 200, used.text
    with _store(versions.home) as store:
        stored = [json.loads(data) for (data,) in store.execute("SELECT data FROM rows WHERE tab = 'ApiKeys'")]
    (row,) = [row for row in stored if row["label"] == first]
    assert row["used_ms"] > 0, "the other server changed the row"
    assert (row["later"], row["~schema"]) == (LATER, 9)


@pytest.mark.parametrize(
    ("depth", "advice"), [("1", "git fetch --unshallow"), ("99999", "Set RELEASE in tests/compatibility/release.py")]
)
def test_a_clone_without_the_release_is_reported_with_the_remedy(tmp_path: Path, depth: str, advice: str) -> None:
    source, clone = tmp_path / "source", tmp_path / "clone"
    subprocess.run(["git", "init", "--quiet", str(source)], check=True)
    names = {f"GIT_{role}_{part}": "a@b.c" for role in ("AUTHOR", "COMMITTER") for part in ("NAME", "EMAIL")}
    for text in ("first", "second"):
        commit = ["git", "commit", "--quiet", "--allow-empty", "--message", text]
        subprocess.run(commit, cwd=source, check=True, env={**os.environ, **names})
    subprocess.run(["git", "clone", "--quiet", "--depth", depth, f"file://{source}", str(clone)], check=True)
    with pytest.raises(ReleaseUnavailableError, match=advice):
        unpack(tmp_path, release="0" * 40, repository=clone)


@contextlib.contextmanager
def _store(home: Path) -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(home / "tables.sqlite", isolation_level=None)) as store:
        yield store


def _undelivered(agent: Path) -> list[object]:
    with contextlib.closing(sqlite3.connect(f"file:{agent}/journal.db?mode=ro", uri=True)) as journal:
        return journal.execute("SELECT id FROM commands WHERE delivered = 0").fetchall()


def _answers(person: httpx.Client) -> bool:
    try:
        return person.get("/accounts/me").status_code == httpx.codes.UNAUTHORIZED
    except httpx.TransportError:
        return False
