"""The current permissions of a sign-in session or API key."""

from dataclasses import replace
from typing import Final

from function_app.domain.identity.accounts import Identity
from function_app.domain.identity.api_keys import ApiKey, key_of
from function_app.ports.tables import Tables
from function_app.services.storage import records

API_KEY: Final = "key"
"""Row key of an API key."""


async def current_identity(tables: Tables, caller: Identity, now_ms: int) -> Identity | None:
    """``caller`` with current permissions; ``None`` if the key has ended or the session was signed out.

    An expired session is still valid here: its actions continue.
    """
    key_id = caller.key or key_of(caller.session)
    if not key_id:
        return None if await tables.get(records.ACCOUNTS, caller.account, signed_out_key(caller.session)) else caller
    _, key = await records.find(tables, records.API_KEYS, key_id, API_KEY, ApiKey)
    if key is None or key.account != caller.account or now_ms >= key.expires_ms:
        return None
    return replace(key.identity, name=caller.name)


def signed_out_key(session: str) -> str:
    """Row key of the marker of an ended session."""
    return f"signed-out:{session}"
