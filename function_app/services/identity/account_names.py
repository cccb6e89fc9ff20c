"""Rules for new account names: one script, and no name that looks like an existing one (Unicode UTS 39).

The tables of scripts and look-alikes come from the package ``confusable-homoglyphs``, which converts the data files of
the Unicode consortium.
"""

import hashlib
import unicodedata
from typing import Final

from function_app.domain.common.problems import Problem, invalid
from function_app.domain.common.text import label_error
from function_app.domain.identity.accounts import fold_name
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records

_PUNCTUATION: Final = frozenset(" .-_'@+")
_ANY_SCRIPT: Final = frozenset({"COMMON", "INHERITED"})
_TOGETHER: Final = (
    frozenset({"LATIN", "HAN", "HIRAGANA", "KATAKANA"}),
    frozenset({"LATIN", "HAN", "BOPOMOFO"}),
    frozenset({"LATIN", "HAN", "HANGUL"}),
)
"""Scripts that languages write together: the level "highly restrictive" of UTS 39."""
_KEY: Final = "name"
_MARK: Final = "\u200e"
"""The data files enclose right-to-left characters in marks."""


def name_error(name: str) -> str:
    """Why ``name`` is not valid for a new account, as a sentence; empty: it is valid."""
    from confusable_homoglyphs import categories  # noqa: PLC0415 (50 ms, which a cold start need not wait for)

    error = label_error(name)
    if error:
        return f"The name {error}."
    scripts = set()
    for character in name:
        if character not in _PUNCTUATION and unicodedata.category(character)[0] not in "LMN":
            return f"The name contains '{character}'. Use letters, digits, spaces and . - _ ' @ +"
        scripts.add(categories.alias(character))
    scripts -= _ANY_SCRIPT
    if len(scripts) > 1 and not any(scripts <= together for together in _TOGETHER):
        return "The name mixes letters of different alphabets. Use one alphabet."
    return ""


def skeleton(name: str) -> str:
    """The form that is equal for names that look alike, without case."""
    plain = unicodedata.normalize("NFD", unicodedata.normalize("NFKC", name))
    drawn = unicodedata.normalize("NFD", "".join(map(_prototype, plain)))
    return " ".join(drawn.casefold().split())


async def reserve_name(tables: Tables, name: str) -> None:
    """Reserve ``name`` and all names that look like it. Idempotent.

    Raises:
        Problem: ``name-taken``: another account has a name that looks like it.
    """
    hashed = hashlib.sha256(skeleton(name).encode()).hexdigest()
    row = Row(f"looks-like:{hashed}", _KEY, {"name": fold_name(name)})
    try:
        await tables.create(records.ACCOUNTS, row)
    except Conflict as conflict:
        existing = await tables.get(records.ACCOUNTS, row.partition, row.key)
        if existing is not None and existing.data["name"] != row.data["name"]:
            detail = "Another account has a name that looks like this one. Choose another name."
            raise Problem("name-taken", 409, "The name is taken", detail) from conflict


async def reserve_new_name(tables: Tables, name: str) -> None:
    """Reserve the name of a new account. Raises ``name-invalid`` or ``name-taken``."""
    error = name_error(name)
    if error:
        raise invalid(error, code="name-invalid")
    await reserve_name(tables, name)


def _prototype(character: str) -> str:
    """The characters that represent all characters that look like this one.

    The data list each look-alike of a prototype with the prototype, and each prototype with all its look-alikes.
    """
    from confusable_homoglyphs.confusables import confusables_data  # noqa: PLC0415

    similar = [str(each["c"]) for each in confusables_data.get(character, ())]
    if len(similar) != 1:
        return character
    (other,) = similar
    if len(confusables_data.get(other, ())) > 1:
        return other.replace(_MARK, "")
    return min(character, other.replace(_MARK, ""))
