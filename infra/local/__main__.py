"""``python -m infra.local``: start the product, print one line that starts with ``ready``, run until Ctrl-C."""

import argparse
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

from device_agent.protocol.security import private_folder
from infra.local import settings
from infra.local.supervisor import StartError, SupervisedProcess

_NEEDS = ("fastapi", "uvicorn", "msgspec", "jwt", "paho", "amqtt", "mujoco", "ruckig", "requests", "numpy")
_START_TIMEOUT_S = 60.0
_ARM = ("--device", "ur5=ur5")


class LocalStack:
    """All programs of one machine.

    Args:
        config: Ports, folder and broker.
    """

    def __init__(self, config: settings.Settings) -> None:
        self._settings = config
        self._logs = config.home / "logs"
        self._agent_home = config.home / "agents" / "this-machine"
        self._children: list[SupervisedProcess] = []

    @property
    def _environment(self) -> dict[str, str]:
        return self._settings.environment()

    def start(self) -> None:
        """Start all programs.

        Raises:
            StartError: A program does not start; the caller must call ``stop``.
        """
        self._check()
        log_progress("starting")
        if self._settings.tls:
            self._prepare_certificates()
        link = self._sign_in_link()  # first: creates tables and keys, or reports invalid ones
        self._run("broker", *self._broker()).wait_for_line("ready", _START_TIMEOUT_S)
        self._run("functions", "-m", "function_app", "serve")
        self._run("worker", "-m", "function_app", "work")
        self._await_health()
        if self._settings.xmpp:
            self._run("xmpp-server", *self._prosody()).wait_for_line("ready", _START_TIMEOUT_S)
            self._run("xmpp", "-m", "function_app", "xmpp")
        self._pair(link)
        agent = ["-m", "device_agent", "run", "--home", str(self._agent_home)]
        if trace := os.environ.get("TELESCOPE_TRACE"):
            agent += ["--trace", trace]
        self._run("agent", *agent).wait_for_line("running", _START_TIMEOUT_S)
        self._await_device()
        link = self._sign_in_link()
        print(f"ready {self._settings.url}/  sign in once with {link}  {self._renderer()}".rstrip(), flush=True)

    def watch(self, stopping: threading.Event) -> None:
        """Restart programs that exit, until ``stopping`` is set.

        Raises:
            StartError: A program exits repeatedly.
        """
        while not stopping.wait(0.2):
            for child in self._children:
                child.limit_log()
                if child.exited:
                    log_progress(f"{child.name} exited and is restarted ({child.last_line()})")
                    child.restart()

    def stop(self) -> None:
        """Stop all programs, the agent first, so that robots hold before their services stop."""
        for child in reversed(self._children):
            child.stop()

    # ------------------------------------------------------------ steps

    def _check(self) -> None:
        missing = [name for name in (*_NEEDS, *(["slixmpp"] if self._settings.xmpp else [])) if not installed(name)]
        if missing:
            raise StartError(f"Python package '{missing[0]}' is missing; run `make env`")
        config = self._settings
        for port, label in (
            (config.port, "page"),
            (config.mqtt_port, "MQTT"),
            (config.websocket_port, "MQTT over WebSocket"),
            *([(config.xmpp_port, "XMPP"), (config.xmpp_websocket_port, "XMPP over WebSocket")] if config.xmpp else []),
        ):
            if port_in_use(config.host, port):
                count = "four" if config.xmpp else "two"
                raise StartError(
                    f"port {port} ({label}) is in use; set TELESCOPE_PORT (the next {count} are used, too)"
                )
        try:
            self._logs.mkdir(parents=True, exist_ok=True, mode=0o700)
            settings.save_started(config, os.environ)
            old_home = self._agent_home.with_name("ur5")  # former folder name; keeps the device ids
            if old_home.exists() and not self._agent_home.exists():
                old_home.rename(self._agent_home)
        except OSError as error:
            raise StartError(
                f"cannot create {self._logs} ({error.strerror}); set TELESCOPE_HOME to a writable folder"
            ) from error

    def _prepare_certificates(self) -> None:
        """Create certificates for this machine's address, unless others are installed; report their state."""
        config = self._settings
        option = ("--show",) if config.certificate[0].exists() else ("--address", config.host)
        state = self._run_once("-m", "infra.tls", "--home", str(config.tls_home), *option).splitlines()[0]
        log_progress(f"TLS {state}")
        if config.certificates and not (config.tls_home / "devices-ca.key").exists():
            self._run_once("-m", "infra.tls", "--home", str(config.tls_home), "--devices")

    def _broker(self) -> list[str]:
        config = self._settings
        ports = ["--host", config.host, "--tcp-port", str(config.mqtt_port)]
        ports += ["--websocket-port", str(config.websocket_port)]
        if config.tls:
            certificate, key = config.certificate
            ports += ["--certificate", str(certificate), "--certificate-key", str(key)]
        if config.certificates:
            agents = config.tls_home
            ports += ["--agents-ca", str(agents / "devices-ca.crt"), "--revoked", str(agents / "devices.crl")]
        if config.broker == "mosquitto":
            return ["-m", "infra.mosquitto", "--home", str(config.home / "mosquitto"), *ports]
        return ["-m", "infra.embedded_broker", "--keys", str(config.home / "keys" / "public.json"), *ports]

    def _prosody(self) -> list[str]:
        config = self._settings
        verify_url = f"{config.url}/api/v1/xmpp/verify"
        address = ["--home", str(config.home / "prosody"), "--host", config.host, "--port", str(config.xmpp_port)]
        address += ["--websocket-port", str(config.xmpp_websocket_port)]
        return ["-m", "infra.prosody", *address, "--domain", settings.XMPP_DOMAIN, "--verify-url", verify_url]

    def _run(self, name: str, *arguments: str) -> SupervisedProcess:
        child = SupervisedProcess(name, arguments, self._environment, self._logs)
        child.start()
        self._children.append(child)
        return child

    def _run_once(self, *arguments: str) -> str:
        """Run a program to its end; returns its output.

        Raises:
            StartError: It failed; the message is its last line.
        """
        result = subprocess.run(  # noqa: S603 (fixed commands)
            [sys.executable, *arguments],
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        if result.returncode != 0:
            lines = [line for line in (result.stderr + result.stdout).splitlines() if line.strip()]
            raise StartError(
                lines[-1] if lines else f"{' '.join(arguments[:3])} failed with exit code {result.returncode}"
            )
        return result.stdout

    def _sign_in_link(self) -> str:
        output = self._run_once("-m", "function_app", "sign-in-link", "--account", settings.ACCOUNT)
        return output.strip().splitlines()[-1]

    def _await_health(self) -> None:
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while time.monotonic() < deadline_s:
            for child in self._children:
                if child.exited:
                    raise StartError(child.last_line())
            try:
                if self._call("GET", "/health")["broker"] == "ok":
                    return
            except (OSError, ValueError, KeyError):
                pass
            time.sleep(0.1)
        raise StartError(f"the functions did not become healthy within {_START_TIMEOUT_S:.0f} s; see {self._logs}")

    def _pair(self, link: str) -> None:
        """Enrol the agent and redeem its claim code for the demo account."""
        devices = ("--room", self._settings.room) if self._settings.room else _ARM
        trust = ["--ca", str(self._settings.ca)] if self._has_private_ca else []
        output = self._run_once(
            "-m", "device_agent", "enroll", "--home", str(self._agent_home), "--server", self._settings.url,
            "--name", "This machine", *devices, "--no-wait", *trust,
        )  # fmt: skip
        fields = output.split()
        if "code" not in fields:
            return  # already paired
        try:
            signed_in = self._call("POST", "/auth/sign-in", {"link": link.partition("#sign-in=")[2]})
            self._call("POST", "/agents/claim", {"code": fields[fields.index("code") + 1]}, signed_in["access_token"])
        except (OSError, ValueError, KeyError) as error:
            raise StartError(f"cannot pair the demo robots: {error}") from error

    def _await_device(self) -> None:
        """Wait until the agent is connected to the broker."""
        agent = self._children[-1]
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while time.monotonic() < deadline_s:
            if any("link up" in line for line in agent.output_lines()):
                return
            if agent.exited:
                raise StartError(agent.last_line())
            time.sleep(0.05)
        raise StartError(f"the agent did not connect within {_START_TIMEOUT_S:.0f} s; see {agent.log}")

    def _renderer(self) -> str:
        """The agent's line about its renderer; empty without simulated devices."""
        return next((line for line in self._children[-1].output_lines() if line.startswith("renderer ")), "")

    @property
    def _has_private_ca(self) -> bool:
        """Whether the site has its own certificate authority."""
        return self._settings.tls and self._settings.ca.exists()

    def _call(self, method: str, path: str, body: dict[str, Any] | None = None, token: str = "") -> dict[str, Any]:
        request = urllib.request.Request(  # noqa: S310 (our own address)
            f"{self._settings.url}/api/v1{path}",
            data=None if body is None else json.dumps(body).encode(),
            method=method,
            headers={"Content-Type": "application/json"} | ({"Authorization": f"Bearer {token}"} if token else {}),
        )
        try:
            trusted = ssl.create_default_context(cafile=str(self._settings.ca)) if self._has_private_ca else None
            with urllib.request.urlopen(request, timeout=10, context=trusted) as response:  # noqa: S310  # nosec B310
                content: dict[str, Any] = json.load(response)
        except urllib.error.HTTPError as error:
            raise ValueError(json.load(error).get("detail", error.reason)) from error
        return content


def installed(package: str) -> bool:
    """Whether a package is installed, without importing it."""
    try:
        return importlib.util.find_spec(package) is not None
    except ImportError:
        return False


def port_in_use(host: str, port: int) -> bool:
    """Whether a port is in use."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return True
    return False


def log_progress(text: str) -> None:
    """Print one line of progress."""
    print(f"telescope: {text}", file=sys.stderr, flush=True)


def main() -> int:
    """Start, run until SIGINT or SIGTERM, stop; returns the exit code."""
    os.umask(private_folder.UMASK)
    stopping = threading.Event()

    def request_stop(_number: int, _frame: FrameType | None) -> None:
        if stopping.is_set():
            return
        stopping.set()
        log_progress("stopping")

    machine: LocalStack | None = None
    try:
        machine = LocalStack(settings.read(os.environ))
        machine.start()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, request_stop)
        machine.watch(stopping)
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
    argparse.ArgumentParser(
        prog="python -m infra.local",
        description="Run Telescope on this machine until Ctrl-C, as `make up` does.",
        epilog="Settings are environment variables; see docs/reference/configuration.md.",
    ).parse_args()
    os.chdir(Path(__file__).resolve().parents[2])
    sys.exit(main())
