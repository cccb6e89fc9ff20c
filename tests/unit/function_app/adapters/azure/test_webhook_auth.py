"""The webhook accepts tokens of the namespace only; a fake stands in for Microsoft Entra."""

import asyncio
import time
from collections.abc import Iterator
from http.server import ThreadingHTTPServer
from typing import Any

import jwt
import pytest

from function_app.adapters.azure.webhook_auth import MIN_REFRESH_S, EntraTokenVerifier
from function_app.ports.tables import StoreError
from tests.harness.cloud.oidc_provider import SigningKey, new_key
from tests.harness.network.http_server import QuietHandler, running

TENANT, APPLICATION, IDENTITY = (f"{number}1059fcc-5514-4800-b5f8-49808b9cfab6" for number in "123")


class Entra(ThreadingHTTPServer):
    """Publishes its keys; a fake."""

    def __init__(self, *keys: SigningKey) -> None:
        super().__init__(("127.0.0.1", 0), _Keys)
        self.keys = keys
        self.requests: list[str] = []
        self.url = f"http://127.0.0.1:{self.server_port}"


class _Keys(QuietHandler):
    server: Entra

    def handle_any(self) -> None:
        self.server.requests.append(self.path)
        self.respond_json({"keys": [key.jwk() for key in self.server.keys]})


@pytest.fixture(scope="module")
def keys() -> tuple[SigningKey, SigningKey]:
    return new_key("one"), new_key("two")


@pytest.fixture
def entra(keys: tuple[SigningKey, SigningKey]) -> Iterator[Entra]:
    entra = Entra(keys[0])
    with running(entra):
        yield entra


def verifier_of(entra: Entra) -> EntraTokenVerifier:
    return EntraTokenVerifier(tenant=TENANT, audience=f"api://{APPLICATION}", identity=IDENTITY, authority=entra.url)


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
    claims = {claim: value for claim, value in claims.items() if value is not None}
    return jwt.encode(claims, key.private, "RS256", headers={"kid": name or key.name})


def test_tokens_of_both_versions_identify_the_namespace(entra: Entra, keys: tuple[SigningKey, SigningKey]) -> None:
    verifier = verifier_of(entra)
    first = {"iss": f"https://sts.windows.net/{TENANT}/", "aud": f"api://{APPLICATION}"}
    for each in (token(keys[0], entra), token(keys[0], entra, **first)):
        assert asyncio.run(verifier.verify(each))
    assert entra.requests == [f"/{TENANT}/discovery/v2.0/keys"]


def test_other_callers_are_rejected(entra: Entra, keys: tuple[SigningKey, SigningKey]) -> None:
    verifier = verifier_of(entra)
    changes: tuple[dict[str, Any], ...] = (
        {"oid": APPLICATION},
        {"oid": [IDENTITY]},
        {"aud": "https://eventgrid.azure.net/"},
        {"iss": f"https://sts.windows.net/{IDENTITY}/"},
        {"exp": 1},
        {"nbf": 4_000_000_000},
        *({claim: None} for claim in ("oid", "aud", "iss", "exp", "nbf")),
    )
    for changed in changes:
        assert not asyncio.run(verifier.verify(token(keys[0], entra, **changed))), changed


def test_tokens_without_entras_signature_are_rejected(entra: Entra, keys: tuple[SigningKey, SigningKey]) -> None:
    claims = jwt.decode(token(keys[0], entra), options={"verify_signature": False})
    unsigned = jwt.encode(claims, "", "none", headers={"kid": "one"})
    shared = jwt.encode(claims, "x" * 64, "HS256", headers={"kid": "one"})
    nameless = jwt.encode(claims, keys[0].private, "RS256")
    for each in (token(keys[1], entra, name="one"), token(keys[1], entra), unsigned, shared, nameless, "", "a.b.c"):
        assert not asyncio.run(verifier_of(entra).verify(each)), each


def test_a_new_key_is_fetched_but_not_for_every_unknown_key_id(
    entra: Entra, keys: tuple[SigningKey, SigningKey]
) -> None:
    verifier = verifier_of(entra)

    async def many() -> list[bool]:
        return [await verifier.verify(token(keys[1], entra, name=f"made-up-{number}")) for number in range(20)]

    assert not any(asyncio.run(many()))
    assert len(entra.requests) == 1
    entra.keys = keys
    verifier._fetched_s -= MIN_REFRESH_S
    assert asyncio.run(verifier.verify(token(keys[1], entra)))
    assert len(entra.requests) == 2


def test_an_unreachable_entra_is_an_error(keys: tuple[SigningKey, SigningKey], entra: Entra) -> None:
    away = EntraTokenVerifier(tenant=TENANT, audience=APPLICATION, identity=IDENTITY, authority="http://127.0.0.1:1")
    with pytest.raises(StoreError, match="Entra"):
        asyncio.run(away.verify(token(keys[0], entra)))
