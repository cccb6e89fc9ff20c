"""A parser that a hostile model has taken over reaches nothing but its own folder."""

import asyncio
import json
import socket
from pathlib import Path

import pytest

from device_agent.protocol.manifests import robot_type as manifests
from function_app.adapters.model_compiler import compiler as module
from function_app.adapters.model_compiler.compiler import MujocoCompiler
from function_app.ports.model_compiler import CompilerMissingError
from tests.harness.paths import ROOT
from tests.integration.robot_types.lever import FILES, manifest

PAYLOAD = """
import ctypes, json, os, socket, sys
sys.path.insert(0, {root!r})
from function_app.adapters.model_compiler import worker

def write(path):
    with open(path, "w") as file:
        file.write("x")

def connect():
    socket.socket().connect(("127.0.0.1", {port}))

ATTACKS = {{
    "read the signing keys": lambda: open({secret!r}).read(),
    "list another folder": lambda: os.listdir({folder!r}),
    "read the server's environment": lambda: open(f"/proc/{{os.getppid()}}/environ", "rb").read(),
    "write outside": lambda: write({folder!r} + "/planted"),
    "write into its own folder": lambda: write("planted.xml"),
    "delete a model": lambda: os.remove("lever.xml"),
    "open a connection": connect,
    "create a local socket": lambda: socket.socketpair(),
    "start a process": lambda: os.fork() or os._exit(0),
    "signal the server": lambda: os.kill(os.getppid(), 0),
    "become root": lambda: os.setuid(0),
}}

def attack(self):
    results = {{}}
    assert open("lever.xml").read(), "its own folder must stay readable"
    for name, act in ATTACKS.items():
        try:
            act()
        except OSError:
            continue
        if name != "become root" or os.getuid() == 0:
            results[name] = "succeeded"
    return [json.dumps(results)]

worker.Check.errors = attack
{prelude}
sys.exit(worker.main())
"""


def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, prelude: str = "", port: int = 9) -> None:
    """Replace the child process by one whose parser runs the attacks."""
    keys = tmp_path / "keys"
    keys.mkdir()
    (keys / "signing.pem").write_text("secret")
    child = tmp_path / "child.py"
    names = {"root": str(ROOT), "secret": str(keys / "signing.pem"), "folder": str(keys)}
    child.write_text(PAYLOAD.format(**names, port=port, prelude=prelude))
    monkeypatch.setattr(module, "_CHILD", child)


def check(compiler: MujocoCompiler) -> tuple[str, ...]:
    files = {name: text.encode() for name, text in FILES.items()}
    return asyncio.run(compiler.check(manifests.parse(manifest()), files)).errors


def test_every_attack_of_a_taken_over_parser_is_denied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        plant(tmp_path, monkeypatch, port=server.getsockname()[1])
        (report,) = check(MujocoCompiler())
    assert json.loads(report) == {}


MISSING = {
    "landlock": "from device_agent.sandbox import landlock\nlandlock.abi = lambda: 0\n"
    "def restrict(*_): raise OSError('no Landlock')\nlandlock.restrict = restrict",
    "seccomp": "from device_agent.sandbox import seccomp\n"
    "def build(**_): raise RuntimeError('no libseccomp')\nseccomp.build = build",
}


@pytest.mark.parametrize("layer", MISSING)
def test_a_machine_without_a_layer_refuses_unless_the_operator_accepts_it(
    layer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(tmp_path, monkeypatch, prelude=MISSING[layer])
    with pytest.raises(CompilerMissingError, match=rf"cannot confine.*{layer}.*TELESCOPE_ALLOW_UNCONFINED_MODELS"):
        check(MujocoCompiler())
    with pytest.raises(CompilerMissingError, match="cannot confine"):
        asyncio.run(MujocoCompiler().require())
    (report,) = check(MujocoCompiler(allow_unconfined=True))
    assert isinstance(json.loads(report), dict), "the remaining layers are applied, and the model is checked"


def test_another_system_than_linux_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path, monkeypatch, prelude="import mujoco\nsys.platform = 'darwin'")
    with pytest.raises(CompilerMissingError, match=r"cannot confine.*Linux"):
        check(MujocoCompiler())
