"""``python -m infra.local``: start the product, print one line that starts with ``ready``, run until Ctrl-C."""

import importlib.util
import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import FrameType
from typing import Any

from infra.local import settings
from infra.local.supervisor import Child, StartError

_NEEDS = ("fastapi", "uvicorn", "msgspec", "jwt", "paho", "amqtt", "mujoco", "ruckig", "requests", "numpy")
_START_WITHIN_S = 60.0
_ACCOUNT = "demo"
_ARM = ("--device", "ur5=ur5")


class Machine:
    """Everything that one machine runs.

    Args:
        chosen: Ports, folder and broker.
    """

    def __init__(self, chosen: settings.Settings) -> None:
        self._chosen = chosen
        self._logs = chosen.home / "logs"
        self._agent_home = chosen.home / "agents" / "this-machine"
        self._children: list[Child] = []

    @property
    def _environment(self) -> dict[str, str]:
        return self._chosen.environment()

    def start(self) -> None:
        """Start all of it.

        Raises:
            StartError: Something does not start; what had started has been ended again.
        """
        self._check()
        say("starting")
        if self._chosen.tls:
            self._certify()
        link = self._sign_in_link()  # first of all: makes tables and keys, or says what is wrong with them
        self._run("broker", *self._broker()).await_line("ready", _START_WITHIN_S)
        self._run("functions", "-m", "function_app", "serve")
        self._run("worker", "-m", "function_app", "work")
        self._await_health()
        if self._chosen.xmpp:
            self._run("xmpp-server", *self._prosody()).await_line("ready", _START_WITHIN_S)
            self._run("xmpp", "-m", "function_app", "xmpp")
        self._pair(link)
        agent = ["-m", "device_agent", "run", "--home", str(self._agent_home)]
        if trace := os.environ.get("TELESCOPE_TRACE"):
            agent += ["--trace", trace]
        self._run("agent", *agent).await_line("running", _START_WITHIN_S)
        self._await_device()
        print(f"ready {self._chosen.url}/  sign in once with {self._sign_in_link()}", flush=True)

    def watch(self, ending: threading.Event) -> None:
        """Restart what ends by itself, until told to end.

        Raises:
            StartError: Something keeps ending.
        """
        while not ending.wait(0.2):
            for child in self._children:
                if child.ended:
                    say(f"{child.name} ended and is started again ({child.last_word()})")
                    child.restart()

    def stop(self) -> None:
        """End all of it, the agent first: robots hold before anything they depend on goes."""
        for child in reversed(self._children):
            child.stop()

    # ------------------------------------------------------------ steps

    def _check(self) -> None:
        missing = [name for name in (*_NEEDS, *(["slixmpp"] if self._chosen.xmpp else [])) if not installed(name)]
        if missing:
            raise StartError(f"Python package '{missing[0]}' is missing; run `make env`")
        chosen = self._chosen
        for port, what in (
            (chosen.port, "page"),
            (chosen.mqtt_port, "MQTT"),
            (chosen.websocket_port, "MQTT over WebSocket"),
            *([(chosen.xmpp_port, "XMPP")] if chosen.xmpp else []),
        ):
            if taken(chosen.host, port):
                more = "three" if chosen.xmpp else "two"
                raise StartError(
                    f"port {port} ({what}) is taken; set TELESCOPE_PORT to a free one (it and the next {more} are used)"
                )
        try:
            self._logs.mkdir(parents=True, exist_ok=True, mode=0o700)
            settings.remember(chosen, os.environ)
            former = self._agent_home.with_name("ur5")  # its name before there were rooms; its devices keep their ids
            if former.exists() and not self._agent_home.exists():
                former.rename(self._agent_home)
        except OSError as error:
            raise StartError(f"{self._logs} cannot be made ({error.strerror}); set TELESCOPE_HOME") from error

    def _certify(self) -> None:
        """Make certificates for this machine's own address, where nobody has put others there; or say what is wrong."""
        chosen = self._chosen
        made = ("--show",) if chosen.certificate[0].exists() else ("--address", chosen.host)
        say(f"TLS {self._once('-m', 'infra.tls', '--home', str(chosen.tls_home), *made).splitlines()[0]}")

        if chosen.certificates and not (chosen.tls_home / "devices-ca.key").exists():
            self._once("-m", "infra.tls", "--home", str(chosen.tls_home), "--devices")

    def _broker(self) -> list[str]:
        chosen = self._chosen
        ports = [
            "--host",
            chosen.host,
            "--tcp-port",
            str(chosen.mqtt_port),
            "--websocket-port",
            str(chosen.websocket_port),
        ]
        if chosen.tls:
            certificate, key = chosen.certificate
            ports += ["--certificate", str(certificate), "--certificate-key", str(key)]
        if chosen.certificates:
            agents = chosen.tls_home
            ports += ["--agents-ca", str(agents / "devices-ca.crt"), "--revoked", str(agents / "devices.crl")]
        if chosen.broker == "mosquitto":
            return ["-m", "infra.mosquitto", "--home", str(chosen.home / "mosquitto"), *ports]
        return ["-m", "infra.embedded_broker", "--keys", str(chosen.home / "keys" / "public.json"), *ports]

    def _prosody(self) -> list[str]:
        chosen = self._chosen
        verify_url = f"{chosen.url}/api/v1/xmpp/verify"
        place = ["--home", str(chosen.home / "prosody"), "--host", chosen.host, "--port", str(chosen.xmpp_port)]
        return ["-m", "infra.prosody", *place, "--domain", settings.XMPP_DOMAIN, "--verify-url", verify_url]

    def _run(self, name: str, *arguments: str) -> Child:
        child = Child(name, arguments, self._environment, self._logs)
        child.start()
        self._children.append(child)
        return child

    def _once(self, *arguments: str) -> str:
        """Run a program to its end; what it printed.

        Raises:
            StartError: It failed; the text is its last line.
        """
        done = subprocess.run(  # noqa: S603 (our own programs)
            [sys.executable, *arguments],
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        if done.returncode != 0:
            lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
            raise StartError(lines[-1] if lines else f"{' '.join(arguments[:3])} ended with {done.returncode}")
        return done.stdout

    def _sign_in_link(self) -> str:
        return self._once("-m", "function_app", "sign-in-link", "--account", _ACCOUNT).strip().splitlines()[-1]

    def _await_health(self) -> None:
        deadline_s = time.monotonic() + _START_WITHIN_S
        while time.monotonic() < deadline_s:
            for child in self._children:
                if child.ended:
                    raise StartError(child.last_word())
            try:
                if self._call("GET", "/health")["broker"] == "ok":
                    return
            except (OSError, ValueError, KeyError):
                pass
            time.sleep(0.1)
        raise StartError(f"the functions did not become healthy; see {self._logs}")

    def _pair(self, link: str) -> None:
        """Enroll the agent, and redeem its claim code for the demo account, as a person would."""
        devices = ("--room", self._chosen.room) if self._chosen.room else _ARM
        said = self._once(
            "-m", "device_agent", "enroll", "--home", str(self._agent_home), "--server", self._chosen.url,
            "--name", "This machine", *devices, "--no-wait", *(["--ca", str(self._chosen.ca)] if self._private else []),
        )  # fmt: skip
        words = said.split()
        if "code" not in words:
            return  # paired by an earlier start
        try:
            signed_in = self._call("POST", "/auth/sign-in", {"link": link.partition("#sign-in=")[2]})
            self._call("POST", "/agents/claim", {"code": words[words.index("code") + 1]}, signed_in["access_token"])
        except (OSError, ValueError, KeyError) as error:
            raise StartError(f"the demo robots could not be paired: {error}") from error

    def _await_device(self) -> None:
        """Wait until the agent's link stands: the broker then knows its presence."""
        agent = self._children[-1]
        deadline_s = time.monotonic() + _START_WITHIN_S
        while time.monotonic() < deadline_s:
            if any("link up" in line for line in agent.said()):
                return
            if agent.ended:
                raise StartError(agent.last_word())
            time.sleep(0.05)
        raise StartError(f"the agent found no link; see {agent.log}")

    @property
    def _private(self) -> bool:
        """Whether the site's certificates are of an authority of its own."""
        return self._chosen.tls and self._chosen.ca.exists()

    def _call(self, method: str, path: str, body: dict[str, Any] | None = None, token: str = "") -> dict[str, Any]:
        request = urllib.request.Request(  # noqa: S310 (our own address)
            f"{self._chosen.url}/api/v1{path}",
            data=None if body is None else json.dumps(body).encode(),
            method=method,
            headers={"Content-Type": "application/json"} | ({"Authorization": f"Bearer {token}"} if token else {}),
        )
        try:
            trusted = ssl.create_default_context(cafile=str(self._chosen.ca)) if self._private else None
            with urllib.request.urlopen(request, timeout=10, context=trusted) as answer:  # noqa: S310  # nosec B310
                found: dict[str, Any] = json.load(answer)
        except urllib.error.HTTPError as error:
            raise ValueError(json.load(error).get("detail", error.reason)) from error
        return found


def installed(package: str) -> bool:
    """Whether a package can be found, without importing it."""
    try:
        return importlib.util.find_spec(package) is not None
    except ImportError:
        return False


def taken(host: str, port: int) -> bool:
    """Whether somebody listens on a port already."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return True
    return False


def say(text: str) -> None:
    """One line of progress."""
    print(f"telescope: {text}", file=sys.stderr, flush=True)


def main() -> int:
    """Start, run until SIGINT or SIGTERM, end; returns the exit code."""
    ending = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        if ending.is_set():
            return
        ending.set()
        say("ending")

    machine: Machine | None = None
    try:
        machine = Machine(settings.read(os.environ))
        machine.start()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        machine.watch(ending)
    except (StartError, settings.SettingsError, subprocess.SubprocessError) as error:
        print(f"telescope: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        if machine is not None:
            machine.stop()
    return 0


if __name__ == "__main__":
    os.chdir(Path(__file__).resolve().parents[2])
    sys.exit(main())
