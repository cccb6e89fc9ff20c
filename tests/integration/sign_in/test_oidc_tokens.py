"""Responses of a hostile OpenID Connect provider are refused."""

import asyncio
import json
import re
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs

import jwt
import pytest

from function_app.adapters.oidc.provider import HttpOidcProvider
from function_app.ports.oidc_provider import OidcError, Subject
from tests.fakes.clock import MovingClock
from tests.harness.cloud.oidc_provider import (
    CLIENT_ID,
    CLIENT_SECRET,
    REDIRECT,
    FakeProvider,
    SigningKey,
    new_key,
    start_fake_provider,
)

NONCE = "of this sign-in"
STARTED_S = int(time.time())
Change = Callable[[dict[str, Any]], object]


@pytest.fixture(scope="module")
def unpublished_key() -> SigningKey:
    """A key that the provider does not publish, with the id of a published one."""
    return new_key()


@pytest.fixture
def provider(key: SigningKey) -> Iterator[FakeProvider]:
    with start_fake_provider() as provider:
        provider.keys = [key.jwk()]
        yield provider


def client(
    provider: FakeProvider, *, secret: str = CLIENT_SECRET, clock: MovingClock | None = None
) -> HttpOidcProvider:
    return HttpOidcProvider(
        issuer=provider.issuer, client_id=CLIENT_ID, client_secret=secret, clock=clock or MovingClock()
    )


def claims(provider: FakeProvider, **changes: Any) -> dict[str, Any]:
    now = int(time.time())
    good = {"iss": provider.issuer, "sub": "anna", "aud": CLIENT_ID, "iat": now, "exp": now + 300, "nonce": NONCE}
    return {name: value for name, value in {**good, **changes}.items() if value is not None}


def signed(claim_set: dict[str, Any], key: SigningKey, **header: Any) -> str:
    return jwt.encode(claim_set, key.private, "RS256", headers={"kid": key.name, **header})


def redeem(oidc_client: HttpOidcProvider, issuer: str | None = None) -> Subject:
    return asyncio.run(oidc_client.redeem(code="c", verifier="v", nonce=NONCE, redirect=REDIRECT, issuer=issuer))


def test_a_valid_token_is_accepted(provider: FakeProvider, key: SigningKey) -> None:
    provider.token = signed(claims(provider), key)
    assert redeem(client(provider)) == Subject(provider.issuer, "anna", "anna")
    provider.token = signed(claims(provider, aud=[CLIENT_ID, "other"], azp=CLIENT_ID, name=" A\u0000nna\n"), key)
    assert redeem(client(provider), provider.issuer).name == "Anna"
    assert parse_qs(provider.forms[0]) == {
        "grant_type": ["authorization_code"], "code": ["c"], "redirect_uri": [REDIRECT], "code_verifier": ["v"],
    }  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {"nonce": "of another one"}, {"nonce": None}, {"nonce": 1},
        {"aud": "other"}, {"aud": ["other"]}, {"aud": [CLIENT_ID, "other"]}, {"aud": None},
        {"aud": [CLIENT_ID, "other"], "azp": "other"},
        {"iss": "https://evil.example"}, {"iss": None},
        {"exp": STARTED_S - 60}, {"exp": None}, {"exp": "soon"}, {"exp": float("inf")}, {"exp": float("nan")},
        {"iat": STARTED_S + 3600}, {"nbf": STARTED_S + 3600},
        {"sub": None}, {"sub": ""}, {"sub": "x" * 256},
    ],
    # Test names must not contain the current time, because all xdist workers need the same names.
    ids=lambda changes: re.sub(r"\d{10}", "another time", json.dumps(changes)),
)  # fmt: skip
def test_a_token_with_invalid_claims_is_rejected(
    provider: FakeProvider, key: SigningKey, changes: dict[str, Any]
) -> None:
    provider.token = signed(claims(provider, **changes), key)
    with pytest.raises(OidcError):
        redeem(client(provider))


def test_a_token_with_a_foreign_signature_is_rejected(
    provider: FakeProvider, key: SigningKey, unpublished_key: SigningKey
) -> None:
    claim_set = claims(provider)
    good = signed(claim_set, key)
    head, body, tail = good.split(".")
    for token in (
        signed(claim_set, unpublished_key),
        signed(claim_set, unpublished_key, kid="two"),
        signed(claim_set, unpublished_key, jwk=unpublished_key.jwk(), jku="http://127.0.0.1:1/keys"),
        jwt.encode(claim_set, "", "none", headers={"kid": key.name}),
        jwt.encode(claim_set, CLIENT_SECRET, "HS256", headers={"kid": key.name}),
        jwt.encode(claim_set, str(key.jwk()["n"]), "HS512", headers={"kid": key.name}),
        f"{head}.{body}.",
        f"{head}.{body[:-4]}AAAA.{tail}",
        f"{head}.{body}.{tail[:-8]}AAAAAAAA",
        "nonsense",
        "",
        None,
        1,
    ):
        provider.token = token
        with pytest.raises(OidcError):
            redeem(client(provider))
    provider.token = good
    assert redeem(client(provider)).id == "anna"


def test_a_key_of_another_type_or_use_is_not_used(provider: FakeProvider, key: SigningKey) -> None:
    provider.token = signed(claims(provider), key)
    for jwk in ({**key.jwk(), "use": "enc"}, {**key.jwk(), "alg": "PS256"}, {"kid": "one", "kty": "oct"}, "x",
                  {**key.jwk(), "n": "!"}, {**key.jwk(), "n": 1}, {**key.jwk(), "e": None}):  # fmt: skip
        provider.keys = [jwk]
        with pytest.raises(OidcError):
            redeem(client(provider))


def test_an_unknown_key_id_reloads_the_keys_at_a_limited_rate(
    provider: FakeProvider, key: SigningKey, unpublished_key: SigningKey
) -> None:
    clock = MovingClock()
    oidc_client = client(provider, clock=clock)
    provider.token = signed(claims(provider), key)
    redeem(oidc_client)
    provider.token = signed(claims(provider), unpublished_key, kid="two")
    for _ in range(5):
        with pytest.raises(OidcError):
            redeem(oidc_client)
    assert provider.paths.count("/keys") == 1
    clock.advance(11)
    provider.keys.append({**unpublished_key.jwk(), "kid": "two"})
    assert redeem(oidc_client).id == "anna"
    provider.keys = [{**unpublished_key.jwk(), "kid": "two"}]
    provider.token = signed(claims(provider), key)
    assert redeem(oidc_client).id == "anna", "a key must be cached for an hour"
    clock.advance(3_600)
    provider.token = signed(claims(provider, exp=int(time.time()) + 7_200), key)
    with pytest.raises(OidcError, match="does not publish"):
        redeem(oidc_client)


@pytest.mark.parametrize(
    "changes",
    [
        {"issuer": "https://evil.example"}, {"issuer": None},
        {"token_endpoint": "http://192.0.2.1/token"}, {"jwks_uri": "file:///etc/passwd"}, {"jwks_uri": None},
        {"authorization_endpoint": "javascript:alert(1)"}, {"code_challenge_methods_supported": ["plain"]},
    ],
    ids=json.dumps,
)  # fmt: skip
def test_an_invalid_discovery_document_is_rejected(provider: FakeProvider, changes: dict[str, Any]) -> None:
    provider.document |= changes
    with pytest.raises(OidcError):
        asyncio.run(client(provider).address(state="s", nonce="n", challenge="c", redirect=REDIRECT))
    assert provider.forms == []


def test_a_client_without_a_secret_sends_its_id(provider: FakeProvider, key: SigningKey) -> None:
    provider.token = signed(claims(provider), key)
    redeem(client(provider, secret=""))
    provider.document["token_endpoint_auth_methods_supported"] = ["client_secret_post"]
    redeem(client(provider))
    public, posted = (parse_qs(form) for form in provider.forms)
    assert public["client_id"] == posted["client_id"] == [CLIENT_ID]
    assert "client_secret" not in public
    assert posted["client_secret"] == [CLIENT_SECRET]


def test_an_error_status_and_a_response_that_is_too_long_are_rejected(provider: FakeProvider, key: SigningKey) -> None:
    provider.token = signed(claims(provider), key)
    provider.status = 400
    with pytest.raises(OidcError, match="returned 400"):
        redeem(client(provider))
    provider.status, provider.token = 200, "x" * 300_000
    with pytest.raises(OidcError, match="more than"):
        redeem(client(provider))
