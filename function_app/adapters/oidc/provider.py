"""An OpenID Connect provider over HTTP: discovery, the code flow, and the signature under an ID token.

As OpenID Connect Core 1.0 (sections 3.1.2 and 3.1.3), Discovery 1.0 and RFC 9207 ask. Never a redirect is followed, and
nothing is sent anywhere but to the addresses that the provider's own document names.
"""

import base64
import hmac
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote, urlencode, urlsplit

import jwt
import msgspec

from function_app.ports.clock import Clock
from function_app.ports.oidc_provider import OidcError, Subject

if TYPE_CHECKING:
    import httpx

ALGORITHMS: Final = frozenset(
    {"RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA"}
)
"""Signatures that only the provider can make: none at all is none, and a shared secret is ours too."""
KEPT_MS: Final = 3_600_000
"""So long the provider's document and keys are kept."""
AGAIN_MS: Final = 10_000
"""A key that is not known yet has the keys fetched anew, but not more often."""
SKEW_S: Final = 30
WITHIN_S: Final = 10.0
MOST_BYTES: Final = 262_144
_LONGEST_NAME: Final = 100
_LONGEST_SUBJECT: Final = 255
"""OpenID Connect Core 1.0, section 2: ``sub`` has at most so many characters."""
_OK: Final = 200
_LOOPBACK: Final = frozenset({"127.0.0.1", "::1", "localhost"})
_ADDRESSES: Final = ("authorization_endpoint", "token_endpoint", "jwks_uri")


class HttpOidcProvider:
    """``OidcProvider`` of one issuer, whose document is below its URL. Without a secret this is a public client."""

    def __init__(self, *, issuer: str, client_id: str, client_secret: str, clock: Clock) -> None:
        self._issuer = issuer
        self._client_id = client_id
        self._client_secret = client_secret
        self._clock = clock
        self._known: dict[str, Any] = {}
        self._known_ms = -KEPT_MS
        self._keys: list[dict[str, Any]] = []
        self._keys_ms = -KEPT_MS

    async def address(self, *, state: str, nonce: str, challenge: str, redirect: str) -> str:
        place = str((await self._provider())["authorization_endpoint"])
        asked = {
            "response_type": "code",
            "client_id": self._client_id,
            "redirect_uri": redirect,
            "scope": "openid profile",
            "state": state,
            "nonce": nonce,
            "code_challenge": challenge,
            "code_challenge_method": "S256",
        }
        return f"{place}{'&' if urlsplit(place).query else '?'}{urlencode(asked)}"

    async def redeem(self, *, code: str, verifier: str, nonce: str, redirect: str, issuer: str | None) -> Subject:
        provider = await self._provider()
        says_issuer = provider.get("authorization_response_iss_parameter_supported") is True
        if issuer != self._issuer and (issuer is not None or says_issuer):
            raise OidcError(f"the browser came back from {(issuer or '')[:200]!r}, not from {self._issuer}")
        form = {"grant_type": "authorization_code", "code": code, "redirect_uri": redirect, "code_verifier": verifier}
        headers: dict[str, str] = {}
        ways = provider.get("token_endpoint_auth_methods_supported") or ["client_secret_basic"]
        if not self._client_secret:
            form["client_id"] = self._client_id
        elif "client_secret_basic" in ways:
            headers["Authorization"] = _basic(self._client_id, self._client_secret)
        else:
            form |= {"client_id": self._client_id, "client_secret": self._client_secret}
        answered = await self._fetch("POST", str(provider["token_endpoint"]), data=form, headers=headers)
        token = answered.get("id_token")
        if not isinstance(token, str):
            raise OidcError("the provider gave no ID token")
        return self._subject(await self._verified(token), nonce)

    def _subject(self, claims: Mapping[str, Any], nonce: str) -> Subject:
        """The subject of a token whose signature is verified."""
        said = claims.get("nonce")
        if not isinstance(said, str) or not hmac.compare_digest(said.encode(), nonce.encode()):
            raise OidcError("the ID token is not of this sign-in: its nonce is another one")
        if isinstance(claims["aud"], list) and len(claims["aud"]) > 1 and claims.get("azp") != self._client_id:
            raise OidcError("the ID token was issued to another client (azp)")
        now_s = self._clock.now_ms() / 1000
        times = [claims["exp"], claims["iat"], claims.get("nbf", 0)]
        if not all(isinstance(each, int | float) and math.isfinite(each) for each in times):
            raise OidcError("the ID token's times are no numbers")
        if times[0] <= now_s - SKEW_S:
            raise OidcError("the ID token has expired")
        if max(times[1:]) > now_s + SKEW_S:
            raise OidcError("the ID token is from the future; set this machine's clock")
        subject = claims["sub"]
        if not isinstance(subject, str) or not 0 < len(subject) <= _LONGEST_SUBJECT:
            raise OidcError("the ID token has no valid subject (sub)")
        return Subject(self._issuer, subject, _name(claims) or subject[:_LONGEST_NAME])

    async def _verified(self, token: str) -> dict[str, Any]:
        try:
            header = jwt.get_unverified_header(token)
            algorithm = str(header.get("alg"))
            if algorithm not in ALGORITHMS:
                raise OidcError(f"the ID token is signed by {algorithm[:20]!r}, which proves nothing here")
            key = await self._key(header.get("kid"), algorithm)
            claims: dict[str, Any] = jwt.decode(
                token,
                key,
                algorithms=[algorithm],
                audience=self._client_id,
                issuer=self._issuer,
                options={
                    "require": ["iss", "sub", "aud", "exp", "iat"],
                    "verify_exp": False,  # by our own clock, later
                    "verify_iat": False,
                    "verify_nbf": False,
                },
            )
        except jwt.PyJWTError as error:
            raise OidcError(f"the ID token is refused: {error}") from error
        return claims

    async def _key(self, kid: object, algorithm: str) -> Any:
        """The provider's key with this id. An unknown id causes one fetch of the key set."""
        age_ms = self._clock.now_ms() - self._keys_ms
        found = self._among(kid, algorithm) if 0 <= age_ms < KEPT_MS else None
        if found is None and not 0 <= age_ms < AGAIN_MS:
            fetched = await self._fetch("GET", str((await self._provider())["jwks_uri"]))
            keys = fetched.get("keys")
            if not isinstance(keys, list):
                raise OidcError("the provider's keys are no list")
            self._keys = [key for key in keys if isinstance(key, dict)]
            self._keys_ms = self._clock.now_ms()
            found = self._among(kid, algorithm)
        if found is None:
            raise OidcError("the ID token is signed by a key that the provider does not show")
        return found

    def _among(self, kid: object, algorithm: str) -> Any:
        fitting = [
            key
            for key in self._keys
            if (kid is None or key.get("kid") == kid)
            and key.get("use", "sig") == "sig"
            and key.get("alg", algorithm) == algorithm
        ]
        # Without a name it must be clear which one is meant.
        if len(fitting) != 1:
            return None
        try:
            return jwt.PyJWK(fitting[0], algorithm).key
        except (ValueError, TypeError, KeyError) as error:
            raise OidcError(f"a key of the provider's cannot be read: {error!r}") from error

    async def _provider(self) -> dict[str, Any]:
        """The provider's document about itself."""
        if not 0 <= self._clock.now_ms() - self._known_ms < KEPT_MS:
            found = await self._fetch("GET", f"{self._issuer.rstrip('/')}/.well-known/openid-configuration")
            if found.get("issuer") != self._issuer:
                said = str(found.get("issuer"))[:200]
                raise OidcError(f"the provider calls itself {said!r}; TELESCOPE_OIDC_ISSUER has to say so too")
            for name in _ADDRESSES:
                if not _safe(found.get(name)):
                    raise OidcError(f"the provider's {name} is no https address")
            if "S256" not in (found.get("code_challenge_methods_supported") or ["S256"]):
                raise OidcError("the provider knows no PKCE with S256")
            self._known, self._known_ms = found, self._clock.now_ms()
        return self._known

    async def _fetch(
        self,
        method: str,
        address: str,
        *,
        data: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> dict[str, Any]:
        import httpx  # noqa: PLC0415 (only where it is in use)

        asked = {"Accept": "application/json", **(headers or {})}
        try:
            # A client for one call: sign-ins are rare, and a host may freeze between two of them.
            async with (
                httpx.AsyncClient(timeout=WITHIN_S, follow_redirects=False) as client,
                client.stream(method, address, data=data, headers=asked) as answer,
            ):
                body = await _read(answer, address)
        except httpx.HTTPError as error:
            raise OidcError(f"{address} cannot be used: {error or type(error).__name__}") from error
        if answer.status_code != _OK:
            raise OidcError(f"{address} answered {answer.status_code}: {body[:300].decode(errors='replace')!r}")
        try:
            found = msgspec.json.decode(body)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise OidcError(f"{address} did not answer with JSON: {error}") from error
        if not isinstance(found, dict):
            raise OidcError(f"{address} did not answer with a JSON object")
        return found


async def _read(answer: "httpx.Response", address: str) -> bytes:
    parts = b""
    async for part in answer.aiter_bytes():
        parts += part
        if len(parts) > MOST_BYTES:
            raise OidcError(f"{address} answered with more than {MOST_BYTES} bytes")
    return parts


def _basic(client_id: str, secret: str) -> str:
    """As RFC 6749, section 2.3.1: each part form-encoded before it is put together."""
    pair = f"{quote(client_id, safe='')}:{quote(secret, safe='')}"
    return f"Basic {base64.b64encode(pair.encode()).decode()}"


def _safe(address: object) -> bool:
    """Whether secrets may be sent there: over TLS, or not beyond this machine."""
    if not isinstance(address, str):
        return False
    parts = urlsplit(address)
    return bool(parts.hostname) and (
        parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in _LOOPBACK)
    )


def _name(claims: Mapping[str, Any]) -> str:
    """What people are called, of the claims that providers put it into, without what cannot be printed."""
    for claim in ("name", "preferred_username", "email"):
        said = claims.get(claim)
        if isinstance(said, str):
            shown = "".join(letter for letter in said if letter.isprintable()).strip()[:_LONGEST_NAME]
            if shown:
                return shown
    return ""
