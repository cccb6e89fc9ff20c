"""``export --server`` downloads a recording with the caller's key, and reports what is wrong."""

import hashlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import pytest

from device_agent import __main__ as program
from tests.harness.agent.recordings.synthetic import FIRST_SEQUENCE, Session, write_session
from tests.harness.network.http_server import QuietHandler, serve

KEY = "ts_1_abc"  # pragma: allowlist secret
SESSION = Session(periods=100, every=30)


class Server(QuietHandler):
    """A server with one session, or a blob store. The class attributes are set by each test."""

    files: ClassVar[dict[str, bytes]] = {}
    session: ClassVar[Any] = None
    requests: ClassVar[list[tuple[str, str, str | None]]] = []
    role = "server"
    cut = False

    def handle_any(self) -> None:
        self.requests.append((self.role, self.path, self.headers.get("Authorization")))
        if self.path.startswith("/api/") and self.headers.get("Authorization") != f"Bearer {KEY}":
            self.respond_json({"title": "Unauthorized", "detail": "The key has expired."}, 401)
        elif self.path == "/api/v1/devices/arm%2F1/sessions/6" and self.session is not None:
            self.respond_json(self.session)
        elif self.path in self.files:
            content = self.files[self.path]
            headers = [("content-type", "application/octet-stream")]
            if self.cut:
                self.send_response_only(200)
                self.send_header("content-length", str(len(content)))
                self.end_headers()
                self.wfile.write(content[: len(content) // 2])
                self.close_connection = True
            else:
                self.respond(200, headers, content)
        else:
            self.respond_json({"title": "Not found", "detail": "There is no such session."}, 404)


class Store(Server):
    role = "store"


@pytest.fixture
def servers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, str]]:
    """Addresses of a server and a blob store. The server stores the first segment, the blob store the others."""
    paths = write_session(tmp_path / "stored", SESSION)
    monkeypatch.setattr(Server, "files", {f"/blobs/{path.stem}?sig=1": path.read_bytes() for path in paths})
    monkeypatch.setattr(Server, "requests", [])
    with ExitStack() as stack:
        server, store = stack.enter_context(serve(Server)), stack.enter_context(serve(Store))
        urls = [f"{server if number == 0 else store}{path}" for number, path in enumerate(Server.files)]
        hashes = [hashlib.sha256(content).hexdigest() for content in Server.files.values()]
        recording = {
            "segments": [
                {"segment": number, "url": url, "sha256": sha256}
                for number, (url, sha256) in enumerate(zip(urls, hashes, strict=True))
            ],
            "overview_url": f"{store}/overview",
            "episodes": [{"start_s": 0.2, "end_s": 1.0, "outcome": "success", "label": "pick", "note": None}],
        }
        monkeypatch.setattr(Server, "session", {"epoch": 6, "recording": recording})
        yield server, store


def run(server: str, tmp_path: Path, *options: str, key: str = KEY) -> int:
    (tmp_path / "key").write_text(f"{key}\n", encoding="ascii")
    arguments = ["--server", server, "--device", "arm/1", "--session", "6", "--api-key-file", str(tmp_path / "key")]
    return program.main(["export", *arguments, "--format", "csv", "--output", str(tmp_path / "out"), *options])


def test_all_segments_are_downloaded_and_only_the_api_gets_the_key(servers: tuple[str, str], tmp_path: Path) -> None:
    assert run(servers[0], tmp_path) == 0
    lines = (tmp_path / "out" / "control.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert [int(line.split(",")[3]) - FIRST_SEQUENCE for line in lines] == list(range(10, 51))
    assert [(role, key) for role, _, key in Server.requests] == [
        ("server", f"Bearer {KEY}"),
        ("server", None),
        *[("store", None)] * 3,
    ]


def test_a_session_without_episodes_is_exported_whole(
    servers: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(Server.session["recording"], "episodes", [])
    assert run(servers[0], tmp_path) == 0
    assert len((tmp_path / "out" / "control.csv").read_text(encoding="utf-8").splitlines()) == 101


def test_a_rejected_key_is_reported_in_the_words_of_the_server(
    servers: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(servers[0], tmp_path, key="ts_2_wrong") == 1
    assert "the server rejects the request: The key has expired." in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("session", [{"epoch": 6}, {"recording": None}, {"recording": {"segments": []}}])
def test_a_session_without_a_recording_is_an_error(
    servers: tuple[str, str],
    tmp_path: Path,
    session: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(Server, "session", session)
    assert run(servers[0], tmp_path) == 1
    assert "the server has no recording of arm/1 in epoch 6" in capsys.readouterr().err


def test_an_unknown_session_is_reported(
    servers: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Server, "session", None)
    assert run(servers[0], tmp_path) == 1
    assert "There is no such session." in capsys.readouterr().err


def test_a_lost_connection_leaves_no_export(
    servers: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Store, "cut", True)
    assert run(servers[0], tmp_path) == 1
    assert "the connection was lost at segment 2 of 4; try again" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_changed_content_leaves_no_export(
    servers: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = list(Server.files)[2]
    monkeypatch.setitem(Server.files, path, Server.files[list(Server.files)[1]])
    assert run(servers[0], tmp_path) == 1
    assert "segment 3 of 4 differs from what the agent has uploaded" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("server", "message"),
    [
        ("ftp://host", "--server: 'ftp://host' is not an address like https://host"),
        ("http://127.0.0.1:1", "127.0.0.1:1 cannot be reached"),
    ],
)
def test_a_wrong_server_is_reported(
    tmp_path: Path, server: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(server, tmp_path) == 1
    assert message in capsys.readouterr().err


def test_ca_needs_https(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("http://127.0.0.1:1", tmp_path, "--ca", str(tmp_path / "ca.pem")) == 1
    assert "--ca needs an https server" in capsys.readouterr().err


@pytest.mark.parametrize(("content", "message"), [(None, "does not exist"), (" \n", "is empty"), ("ä", "be read as")])
def test_a_wrong_key_file_is_reported(
    tmp_path: Path, content: str | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "key"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    arguments = ["--server", "http://127.0.0.1:1", "--device", "arm", "--session", "6", "--api-key-file", str(path)]
    assert program.main(["export", *arguments, "--format", "csv", "--output", str(tmp_path / "out")]) == 1
    assert message in capsys.readouterr().err
