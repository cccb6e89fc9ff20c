"""Codes of names sort like the names, contain only characters that Azure accepts, and respect the length limits."""

import re

from hypothesis import given, settings
from hypothesis import strategies as st

from function_app.adapters.azure import names
from tests.contract.tables.suite import HOSTILE, KEYS

TEXTS = st.text(max_size=40)
ACCEPTED = re.compile(r"(?:(?![/\\#?%+])[!-~])*")
EDGES = "".join(chr(first + step) for first, _, _ in names._RANGES for step in (-1, 0, 1) if first + step >= 0)
LONG_STARTS = ("n" * 469, "n" * 468 + "m", "🤖" * 118)


def key_of(name: str) -> str:
    return names.truncate(names.encode(name), names.MAX_KEY)


@settings(max_examples=300)
@given(one=TEXTS, other=TEXTS)
def test_a_code_is_reversible_and_sorts_as_its_name(one: str, other: str) -> None:
    codes = names.encode(one), names.encode(other)
    assert (names.decode(codes[0]), names.decode(codes[1])) == (one, other)
    assert (codes[0] < codes[1]) == (one.encode() < other.encode())
    assert codes[0].startswith(codes[1]) == one.startswith(other)
    assert all(ACCEPTED.fullmatch(code) for code in codes)


def test_characters_of_every_plane_sort_as_in_utf_8() -> None:
    points = sorted({*range(0x3000), *range(0x3000, 0x110000, 61), *map(ord, EDGES)})
    characters = [chr(point) for point in points if not 0xD800 <= point < 0xE000]
    codes = [names.encode(character) for character in characters]
    assert codes == sorted(set(codes))
    assert [names.decode(code) for code in codes] == characters
    assert all(ACCEPTED.fullmatch(code) for code in codes)


def test_names_of_telescope_stay_readable() -> None:
    assert names.encode("now:lease") == "now:lease"
    assert names.encode("0001763700000000:A-b_9") == "0001763700000000:A-b_9"
    assert names.encode("robots/ur5.xml") == "robots.0ur5.-xml"


@settings(max_examples=200)
@given(text=st.text(alphabet=st.sampled_from("a/ü🤖" + EDGES), min_size=1, max_size=512))
def test_a_key_respects_the_limit_and_is_truncated_only_if_necessary(text: str) -> None:
    code = names.encode(text)
    for limit in (names.MAX_KEY, names.MAX_BLOB_NAME):
        key = names.truncate(code, limit)
        assert 0 < len(key) <= limit
        assert (key == code) == (not names.is_truncated(key, limit))
        assert key.startswith(names.head(code, limit))


@settings(max_examples=200)
@given(
    texts=st.lists(
        st.builds(str.__add__, st.sampled_from(LONG_STARTS), st.text(max_size=3)) | st.text(min_size=1, max_size=5),
        unique=True,
        max_size=30,
    )
)
def test_keys_are_unique_and_sort_by_name(texts: list[str]) -> None:
    all_names = {*texts, *KEYS, *HOSTILE}
    stored = sorted(all_names, key=key_of)
    assert len({*map(key_of, all_names)}) == len(all_names)
    ordered = list(names.sort_by_name(stored, key=key_of, name=str, limit=names.MAX_KEY))
    assert ordered == sorted(all_names, key=str.encode)
