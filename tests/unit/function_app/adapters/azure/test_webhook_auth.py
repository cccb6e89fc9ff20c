"""Who may ask the webhook: tokens of Entra's, with a provider of our own in its place."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import jwt
import pytest

from function_app.adapters.azure.webhook_auth import AGAIN_S, EntraCallers
from function_app.ports.tables import StoreError
from tests.harness.cloud.oidc_provider import SigningKey, new_key

TENANT, APPLICATION, IDENTITY = (f"{number}1059fcc-5514-4800-b5f8-49808b9cfab6" for number in "123")


class Entra(ThreadingHTTPServer):
    """Shows its keys; a fake."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Answer)
        self.keys: list[SigningKey] = []
        self.asked: list[str] = []
        self.url = f"http://127.0.0.1:{self.server_port}"


class _Answer(BaseHTTPRequestHandler):
    server: Entra

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        body = json.dumps({"keys": [key.shown() for key in self.server.keys]}).encode()
        self.send_response_only(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def keys() -> tuple[SigningKey, SigningKey]:
    return new_key("one"), new_key("two")


@pytest.fixture
def entra(keys: tuple[SigningKey, SigningKey]) -> Iterator[Entra]:
    server = Entra()
    server.keys = [keys[0]]
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def known(entra: Entra) -> EntraCallers:
    return EntraCallers(tenant=TENANT, audience=f"api://{APPLICATION}", identity=IDENTITY, authority=entra.url)


def token(key: SigningKey, entra: Entra, *, name: str = "", **changed: Any) -> str:
    now_s = int(time.time())
    claims = {
        "iss": f"{entra.url}/{TENANT}/v2.0",
        "aud": APPLICATION,
        "oid": IDENTITY,
        "nbf": now_s - 10,
        "exp": now_s + 600,
        **changed,
    }
    claims = {name: value for name, value in claims.items() if value is not None}
    return jwt.encode(claims, key.private, "RS256", headers={"kid": name or key.name})


def test_the_namespaces_identity_is_known_by_tokens_of_both_versions(
    entra: Entra, keys: tuple[SigningKey, SigningKey]
) -> None:
    caller = known(entra)
    first = {"iss": f"https://sts.windows.net/{TENANT}/", "aud": f"api://{APPLICATION}"}
    for each in (token(keys[0], entra), token(keys[0], entra, **first)):
        assert asyncio.run(caller.knows(each))
    assert entra.asked == [f"/{TENANT}/discovery/v2.0/keys"]


@pytest.mark.parametrize(
    "changed",
    [
        {"oid": APPLICATION},
        {"oid": None},
        {"oid": [IDENTITY]},
        {"aud": "https://eventgrid.azure.net/"},
        {"aud": None},
        {"iss": f"https://sts.windows.net/{IDENTITY}/"},
        {"iss": None},
        {"exp": 1},
        {"exp": None},
        {"nbf": 4_000_000_000},
    ],
    ids=str,
)
def test_other_callers_are_rejected(entra: Entra, keys: tuple[SigningKey, SigningKey], changed: dict[str, Any]) -> None:
    assert not asyncio.run(known(entra).knows(token(keys[0], entra, **changed)))


def test_what_entra_has_not_signed_is_refused(entra: Entra, keys: tuple[SigningKey, SigningKey]) -> None:
    claims = jwt.decode(token(keys[0], entra), options={"verify_signature": False})
    unsigned = jwt.encode(claims, "", "none", headers={"kid": "one"})
    shared = jwt.encode(claims, "x" * 64, "HS256", headers={"kid": "one"})
    nameless = jwt.encode(claims, keys[0].private, "RS256")
    for each in (token(keys[1], entra, name="one"), token(keys[1], entra), unsigned, shared, nameless, "", "a.b.c"):
        assert not asyncio.run(known(entra).knows(each)), each


def test_a_new_key_is_fetched_but_not_for_everybody_who_makes_one_up(
    entra: Entra, keys: tuple[SigningKey, SigningKey]
) -> None:
    caller = known(entra)

    async def many() -> list[bool]:
        return [await caller.knows(token(keys[1], entra, name=f"made-up-{number}")) for number in range(20)]

    assert not any(asyncio.run(many()))
    assert len(entra.asked) == 1
    entra.keys = list(keys)
    caller._fetched_s -= AGAIN_S
    assert asyncio.run(caller.knows(token(keys[1], entra)))
    assert len(entra.asked) == 2


def test_without_entra_it_is_not_known(keys: tuple[SigningKey, SigningKey], entra: Entra) -> None:
    away = EntraCallers(tenant=TENANT, audience=APPLICATION, identity=IDENTITY, authority="http://127.0.0.1:1")
    with pytest.raises(StoreError, match="Entra"):
        asyncio.run(away.knows(token(keys[0], entra)))
