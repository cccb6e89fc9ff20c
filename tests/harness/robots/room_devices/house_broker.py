"""mosquitto as the broker of a house: one process on a free port, which can be stopped and started again."""

import socket
import subprocess
from pathlib import Path
from typing import Any, Self

from function_app.ports.broker_access import Credentials
from tests.harness.network.brokers import HOST, Client, Message, wait_until
from tests.harness.network.ports import free_port

USER, PASSWORD = "telescope", "correct-horse-battery"  # pragma: allowlist secret
DEVICES = Credentials("devices", "another-secret-word")  # pragma: allowlist secret


class HouseBroker:
    """A broker with two users; a context manager that stops it.

    Args:
        folder: Folder for its files.
        tls: Certificate and key, for a TLS listener.
    """

    def __init__(self, folder: Path, tls: tuple[Path, Path] | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.password_file = folder / "password"
        self.password_file.write_text(f"{PASSWORD}\n")
        self.password_file.chmod(0o600)
        users = folder / "users"
        users.touch(0o600)
        for name, password in ((USER, PASSWORD), DEVICES):
            subprocess.run(["mosquitto_passwd", "-b", users, name, password], check=True, capture_output=True)
        self.port = free_port()
        lines = [
            f"listener {self.port} {HOST}", "allow_anonymous false", f"password_file {users}", "user root",
            "log_dest stderr", "persistence false",
        ]  # fmt: skip
        if tls is not None:
            lines += [f"certfile {tls[0]}", f"keyfile {tls[1]}"]
        self._tls = tls is not None
        self._configuration = folder / "mosquitto.conf"
        self._configuration.write_text("\n".join(lines) + "\n")
        self._log = folder / "log"
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def options(self, **more: Any) -> dict[str, Any]:
        """Option ``broker`` of a driver."""
        options = {"host": HOST, "port": self.port, "user": USER, "password_file": str(self.password_file)}
        return {**options, **more}

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(["mosquitto", "-c", self._configuration], stdout=log, stderr=log)
        wait_until(self._listens, "the broker of the house")

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(20)
            self._process = None

    def client(self, client_id: str, *, will: Message | None = None, **options: Any) -> Client:
        """A connected client with the rights of the simulated devices."""
        client = Client(client_id, DEVICES, port=self.port, will=will, **options).open()
        assert client.connected.is_set(), client.answer
        return client

    def _listens(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, self._log.read_text()
        with socket.socket() as probe:
            return probe.connect_ex((HOST, self.port)) == 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
