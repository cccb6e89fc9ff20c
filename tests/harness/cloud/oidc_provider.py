"""OpenID Connect providers: a real one from npm, and a fake one with configurable responses.

with start_provider([new_key()]) as provider: ...
"""

import contextlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import jwt
from cryptography.hazmat.primitives.asymmetric import rsa

from tests.harness.network.http_server import QuietHandler, serve
from tests.harness.node import start_node

FOLDER = Path(__file__).resolve().parents[1] / "identity_provider"
CLIENT_ID, CLIENT_SECRET = "telescope", "a secret of + and % and 32 letters"
REDIRECT = "http://telescope.test/api/v1/auth/oidc/callback"
_LISTENS = re.compile(r"listening at (http://127\.0\.0\.1:(\d+))\n")
_ACTION = re.compile(r'action="([^"]+)"')
_FIELD = re.compile(r'name="(\w+)" value="(\w*)"')


@dataclass(frozen=True, slots=True)
class SigningKey:
    """A signing key of a provider."""

    name: str
    private: rsa.RSAPrivateKey

    def jwk(self, *, private: bool = False) -> dict[str, Any]:
        """The public key, or the private key, as a JWK."""
        key = self.private if private else self.private.public_key()
        return {**jwt.algorithms.RSAAlgorithm.to_jwk(key, as_dict=True), "kid": self.name, "alg": "RS256", "use": "sig"}


def new_key(name: str = "one") -> SigningKey:
    """Generate a key."""
    return SigningKey(name, rsa.generate_private_key(65537, 2048))


@contextlib.contextmanager
def start_provider(keys: Sequence[SigningKey], port: int = 0, *, redirect: str = REDIRECT) -> Iterator[str]:
    """Run ``oidc-provider`` with one client and no persistent storage; yields its address."""
    client = {"client_id": CLIENT_ID, "client_secret": CLIENT_SECRET, "redirect_uris": [redirect]}
    options = {"port": port, "client": client, "keys": [key.jwk(private=True) for key in keys]}
    arguments = [str(FOLDER / "server.mjs")]
    with start_node(FOLDER, "oidc-provider", arguments, _LISTENS, line=json.dumps(options) + "\n") as (match,):
        yield match[1]


def sign_in_at_provider(address: str, name: str, browser: httpx.Client | None = None) -> httpx.URL:
    """Follow the provider's redirects and submit its forms; returns the address of the final redirect."""
    with contextlib.ExitStack() as stack:
        client = browser or stack.enter_context(httpx.Client())
        answer = client.get(address)
        for _ in range(12):
            if answer.is_redirect:
                target = answer.url.join(answer.headers["location"])
                if target.host == httpx.URL(REDIRECT).host:
                    return target
                answer = client.get(target)
                continue
            assert answer.status_code == httpx.codes.OK, answer.text
            action = _ACTION.search(answer.text)
            assert action is not None, answer.text
            fields = dict(_FIELD.findall(answer.text))
            if fields.get("prompt") == "login":
                fields |= {"login": name, "password": "any"}
            answer = client.post(answer.url.join(action[1]), data=fields)
    raise AssertionError("the provider redirects too often")


@dataclass
class FakeProvider:
    """Responses of the fake provider, which a test may change at any time, and its requests.

    Attributes:
        document: Discovery document.
        keys: Published keys.
        token: The ``id_token`` in the response of the token endpoint.
        status: Status of that response.
        forms: Received forms.
        paths: Requested paths.
    """

    document: dict[str, Any] = field(default_factory=dict)
    keys: list[Any] = field(default_factory=list)
    token: Any = None
    status: int = 200
    forms: list[str] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)
    issuer: str = ""


@contextlib.contextmanager
def start_fake_provider() -> Iterator[FakeProvider]:
    """Run a fake provider."""
    provider = FakeProvider()

    class Handler(QuietHandler):
        def handle_any(self) -> None:
            if self.command == "POST":
                provider.forms.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
                tokens = {"access_token": "x", "token_type": "Bearer", "id_token": provider.token}
                self.respond_json(tokens, provider.status)
            else:
                provider.paths.append(self.path)
                self.respond_json(
                    provider.document if self.path.startswith("/.well-known/") else {"keys": provider.keys}
                )

    with serve(Handler) as provider.issuer:
        provider.document = {
            "issuer": provider.issuer,
            "authorization_endpoint": f"{provider.issuer}/authorize",
            "token_endpoint": f"{provider.issuer}/token",
            "jwks_uri": f"{provider.issuer}/keys",
        }
        yield provider
