"""Who acts in the name of a sign-in session or an API key now: much may have changed since something was asked for."""

from dataclasses import replace
from typing import Final

from function_app.domain.identity.accounts import Identity
from function_app.domain.identity.api_keys import ApiKey, key_of
from function_app.ports.tables import Tables
from function_app.services.storage import records

API_KEY: Final = "key"
"""The key of an API key's one row."""


async def current_identity(tables: Tables, caller: Identity, now_ms: int) -> Identity | None:
    """``caller`` with what they may do now: an API key as it stands in the tables.

    Returns:
        ``None`` once the key was revoked or has run out, or somebody has ended the session. One that has only run out
        by itself still counts: what its person has begun goes on.
    """
    key_id = caller.key or key_of(caller.session)
    if not key_id:
        return None if await tables.get(records.ACCOUNTS, caller.account, signed_out_key(caller.session)) else caller
    row = await tables.get(records.API_KEYS, key_id, API_KEY)
    key = records.read(row, ApiKey) if row else None
    if key is None or key.account != caller.account or now_ms >= key.expires_ms:
        return None
    return replace(key.identity, name=caller.name)


def signed_out_key(session: str) -> str:
    """Of the row that says, in its account's partition, that somebody has ended a session."""
    return f"signed-out:{session}"
