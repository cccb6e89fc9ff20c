"""OpenID Connect providers for tests: a real one from npm, and one with configurable false responses.

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
    """A provider's key: private, and as it shows itself."""

    name: str
    private: rsa.RSAPrivateKey

    def shown(self, *, private: bool = False) -> dict[str, Any]:
        """As a JWK."""
        key = self.private if private else self.private.public_key()
        return {**jwt.algorithms.RSAAlgorithm.to_jwk(key, as_dict=True), "kid": self.name, "alg": "RS256", "use": "sig"}


def new_key(name: str = "one") -> SigningKey:
    """A new key."""
    return SigningKey(name, rsa.generate_private_key(65537, 2048))


@contextlib.contextmanager
def start_provider(keys: Sequence[SigningKey], port: int = 0, *, redirect: str = REDIRECT) -> Iterator[str]:
    """``oidc-provider`` with one client; yields its address. It stores nothing beyond its end."""
    client = {"client_id": CLIENT_ID, "client_secret": CLIENT_SECRET, "redirect_uris": [redirect]}
    options = {"port": port, "client": client, "keys": [key.shown(private=True) for key in keys]}
    arguments = [str(FOLDER / "server.mjs")]
    with start_node(FOLDER, "oidc-provider", arguments, _LISTENS, line=json.dumps(options) + "\n") as (found,):
        yield found[1]


def sign_in_there(address: str, name: str, browser: httpx.Client | None = None) -> httpx.URL:
    """Follow the provider's redirects and fill in its forms; where the browser is sent back to."""
    with contextlib.ExitStack() as stack:
        client = browser or stack.enter_context(httpx.Client())
        answer = client.get(address)
        for _ in range(12):
            if answer.is_redirect:
                place = answer.url.join(answer.headers["location"])
                if place.host == httpx.URL(REDIRECT).host:
                    return place
                answer = client.get(place)
                continue
            assert answer.status_code == httpx.codes.OK, answer.text
            action = _ACTION.search(answer.text)
            assert action is not None, answer.text
            fields = dict(_FIELD.findall(answer.text))
            if fields.get("prompt") == "login":
                fields |= {"login": name, "password": "any"}
            answer = client.post(answer.url.join(action[1]), data=fields)
    raise AssertionError("the provider sends one from form to form")


@dataclass
class Liar:
    """What the lying provider says: each may be changed at any time.

    Attributes:
        document: About itself; set by the server.
        keys: Shown.
        token: What stands for an ID token.
        status: Of the token endpoint's answer.
        asked: Forms that it was sent.
    """

    document: dict[str, Any] = field(default_factory=dict)
    keys: list[Any] = field(default_factory=list)
    token: Any = None
    status: int = 200
    asked: list[str] = field(default_factory=list)
    fetched: list[str] = field(default_factory=list)
    issuer: str = ""


@contextlib.contextmanager
def start_liar() -> Iterator[Liar]:
    """A provider that returns the configured documents and keys."""
    liar = Liar()

    class Handler(QuietHandler):
        def handle_any(self) -> None:
            if self.command == "POST":
                liar.asked.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
                tokens = {"access_token": "x", "token_type": "Bearer", "id_token": liar.token}
                self.respond_json(tokens, liar.status)
            else:
                liar.fetched.append(self.path)
                self.respond_json(liar.document if self.path.startswith("/.well-known/") else {"keys": liar.keys})

    with serve(Handler) as liar.issuer:
        liar.document = {
            "issuer": liar.issuer,
            "authorization_endpoint": f"{liar.issuer}/authorize",
            "token_endpoint": f"{liar.issuer}/token",
            "jwks_uri": f"{liar.issuer}/keys",
        }
        yield liar
