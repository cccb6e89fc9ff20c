"""Ids that contain their parts. All ids match ``[A-Za-z0-9_-]{1,64}``."""

import re
import secrets

ID = re.compile(r"\A[A-Za-z0-9_-]{1,64}\Z")
DEVICE_NAME = re.compile(r"\A[A-Za-z0-9_-]{1,32}\Z")
"""Name of a device at its agent. Action ids contain it, so the limit keeps them within 64 characters."""
AGENT_LENGTH = 10
SUFFIX_LENGTH = 20
CLAIM_ALPHABET = "BCDFGHJKLMNPQRSTVWXZ"
"""Twenty consonants: codes form no words and contain no character similar to a digit."""
CLAIM_LENGTH = 8

_BASE32 = "abcdefghijklmnopqrstuvwxyz234567"
_SORTABLE32 = "0123456789abcdefghijklmnopqrstuv"
_REVERSED = str.maketrans(_SORTABLE32, _SORTABLE32[::-1])
_TIME_LENGTH = 9
_TIME_END = 32**_TIME_LENGTH - 1


def new_id(length: int = 16) -> str:
    """A random id with 5 bits per character."""
    return "".join(secrets.choice(_BASE32) for _ in range(length))


def agent_id(key_id: str) -> str:
    """The id of the agent that owns a key: the first 50 bits of the key's hash.

    The agent's row contains the whole key, so a second key with the same 50 bits is rejected.
    """
    bits = int(key_id[:16], 16) >> 14
    return "".join(_BASE32[(bits >> shift) & 31] for shift in range(45, -5, -5))


def device_id(agent: str, name: str) -> str:
    """The id of a device behind an agent."""
    return f"{agent}-{name}"


def split_device(device: str) -> tuple[str, str] | None:
    """Agent and name of a device id, or ``None`` for an invalid id."""
    agent, dash, name = device.partition("-")
    if not dash or len(agent) != AGENT_LENGTH or not agent.isalnum() or not DEVICE_NAME.match(name):
        return None
    return (agent, name) if ID.match(agent) else None


def new_suffix(now_ms: int) -> str:
    """The last part of a command id: decreases with time, so that the newest sorts first; then 55 random bits."""
    random_length = SUFFIX_LENGTH - _TIME_LENGTH
    value = (_TIME_END - now_ms) << 5 * random_length | secrets.randbits(5 * random_length)
    text = ""
    for _ in range(SUFFIX_LENGTH):
        text = _SORTABLE32[value & 31] + text
        value >>= 5
    return text


def oldest_first(suffix: str) -> str:
    """The last part of a command id, transformed so that the oldest sorts first."""
    return suffix.translate(_REVERSED)


def command_id(device: str, now_ms: int) -> str:
    """A new id of an action or of another command to a device."""
    return f"{device}-{new_suffix(now_ms)}"


def split_command(command: str) -> tuple[str, str] | None:
    """Device id and suffix of a command id, or ``None`` for an invalid id."""
    device, dash, suffix = command.rpartition("-")
    if not dash or len(suffix) != SUFFIX_LENGTH or not suffix.isalnum() or split_device(device) is None:
        return None
    return device, suffix


def new_claim_code() -> str:
    """A random code of eight characters in base 20: 2.56·10¹⁰ codes."""
    return "".join(secrets.choice(CLAIM_ALPHABET) for _ in range(CLAIM_LENGTH))


def format_claim_code(code: str) -> str:
    """The code in the displayed format ``XXXX-XXXX``."""
    half = CLAIM_LENGTH // 2
    return f"{code[:half]}-{code[half:]}"


def parse_claim_code(text: str) -> str | None:
    """The code that a person typed, as stored, or ``None`` if it is not valid."""
    code = "".join(text.split()).replace("-", "").upper()
    if len(code) != CLAIM_LENGTH or any(letter not in CLAIM_ALPHABET for letter in code):
        return None
    return code
