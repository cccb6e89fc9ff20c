"""Connections beyond this machine use TLS, and only with a server that a trusted certificate names."""

import asyncio
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol.xmpp import stream as xmpp_stream
from device_agent.protocol.xmpp.stream import Login, Stream, StreamError
from tests.harness.cloud.identity import make_certificate
from tests.harness.network.brokers import HOST
from tests.harness.network.xmpp import DOMAIN, Prosody, start_prosody

NOWHERE = "http://127.0.0.1:9/verify"


@pytest.fixture(params=[DOMAIN])
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Prosody, Path]]:
    """Prosody with a certificate of this name."""
    pem = make_certificate(tmp_path, request.param)
    options = ("--certificate", str(pem), "--key", str(tmp_path / "key.pem"))
    with start_prosody(tmp_path / "prosody", NOWHERE, more=options) as prosody:
        yield prosody, pem


@pytest.fixture(autouse=True)
def _far_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Login, "local", property(lambda _: False))


def login_error(port: int, trusted: Path | None, monkeypatch: pytest.MonkeyPatch) -> str:
    """The error of a login. No HTTP server runs, so a login that reaches the password check is rejected there."""
    if trusted is not None:
        monkeypatch.setattr(ssl, "create_default_context", _trusting(trusted))

    async def login() -> None:
        stream = Stream(Login(HOST, port, f"abc@{DOMAIN}/x", "pw"), message=_nothing, presence=_nothing)
        try:
            await stream.open()
        finally:
            await stream.close()

    with pytest.raises(StreamError) as error:
        asyncio.run(login())
    return str(error.value)


def record_sent(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, str]]:
    """Record data sent from now on, and whether it is sent under TLS."""
    sent: list[tuple[bool, str]] = []
    original = xmpp_stream._Client.send_raw

    def send_raw(self: Any, data: Any) -> None:
        sent.append((self.transport.get_extra_info("ssl_object") is not None, str(data)))
        original(self, data)

    monkeypatch.setattr(xmpp_stream._Client, "send_raw", send_raw)
    return sent


def test_with_a_trusted_certificate_the_password_is_sent_under_tls(
    server: tuple[Prosody, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    prosody, pem = server
    sent = record_sent(monkeypatch)
    assert "rejects the password" in login_error(prosody.port, pem, monkeypatch)
    (auth,) = [secure for secure, data in sent if "<auth" in data]
    assert auth is True


def test_an_untrusted_certificate_is_rejected(server: tuple[Prosody, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    assert "certificate" in login_error(server[0].port, None, monkeypatch)


@pytest.mark.parametrize("server", ["another.localhost"], indirect=True)
def test_a_trusted_certificate_of_another_name_is_refused(
    server: tuple[Prosody, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "certificate" in login_error(server[0].port, server[1], monkeypatch)


def test_no_password_is_sent_to_a_server_without_tls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = record_sent(monkeypatch)
    with start_prosody(tmp_path / "prosody", NOWHERE) as prosody:
        assert "no TLS" in login_error(prosody.port, None, monkeypatch)
    assert not any("<auth" in data for _, data in sent)


def _trusting(pem: Path) -> Any:
    original = ssl.create_default_context

    def context(*arguments: Any, **options: Any) -> ssl.SSLContext:
        trusting = original(*arguments, **options)
        trusting.load_verify_locations(pem)
        return trusting

    return context


def _nothing(_: Any) -> None:
    """A port without a listener."""
