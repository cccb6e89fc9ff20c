"""Codes of names sort as the names do, contain only what Azure accepts, and fit."""

import re

from hypothesis import given, settings
from hypothesis import strategies as st

from function_app.adapters.azure import names
from tests.contract.tables.suite import HOSTILE, KEYS

TEXTS = st.text(max_size=40)
ACCEPTED = re.compile(r"(?:(?![/\\#?%+])[!-~])*")
EDGES = "".join(chr(first + step) for first, _, _ in names._SIGNS for step in (-1, 0, 1) if first + step >= 0)
LONG_STARTS = ("n" * 469, "n" * 468 + "m", "🤖" * 118)


def written(name: str) -> str:
    return names.fit(names.encode(name), names.MAX_KEY)


@settings(max_examples=300, deadline=None)
@given(one=TEXTS, other=TEXTS)
def test_a_code_is_reversible_and_sorts_as_its_name(one: str, other: str) -> None:
    codes = names.encode(one), names.encode(other)
    assert (names.decode(codes[0]), names.decode(codes[1])) == (one, other)
    assert (codes[0] < codes[1]) == (one.encode() < other.encode())
    assert codes[0].startswith(codes[1]) == one.startswith(other)
    assert all(ACCEPTED.fullmatch(code) for code in codes)


def test_characters_of_every_plane_sort_as_in_utf_8() -> None:
    points = sorted({*range(0x3000), *range(0x3000, 0x110000, 61), *map(ord, EDGES)})
    letters = [chr(point) for point in points if not 0xD800 <= point < 0xE000]
    codes = [names.encode(letter) for letter in letters]
    assert codes == sorted(set(codes))
    assert [names.decode(code) for code in codes] == letters
    assert all(ACCEPTED.fullmatch(code) for code in codes)


def test_names_of_telescope_stay_readable() -> None:
    assert names.encode("now:lease") == "now:lease"
    assert names.encode("0001763700000000:A-b_9") == "0001763700000000:A-b_9"
    assert names.encode("robots/ur5.xml") == "robots.0ur5.-xml"


@settings(max_examples=200, deadline=None)
@given(text=st.text(alphabet=st.sampled_from("a/ü🤖" + EDGES), min_size=1, max_size=512))
def test_a_written_name_fits_and_is_cut_only_if_necessary(text: str) -> None:
    code = names.encode(text)
    for limit in (names.MAX_KEY, names.MAX_BLOB_NAME):
        fitted = names.fit(code, limit)
        assert 0 < len(fitted) <= limit
        assert (fitted == code) == (not names.is_cut(fitted, limit))
        assert fitted.startswith(names.head(code, limit))


@settings(max_examples=200, deadline=None)
@given(
    found=st.lists(
        st.builds(str.__add__, st.sampled_from(LONG_STARTS), st.text(max_size=3)) | st.text(min_size=1, max_size=5),
        unique=True,
        max_size=30,
    )
)
def test_written_names_differ_and_are_read_in_the_order_of_names(found: list[str]) -> None:
    every = {*found, *KEYS, *HOSTILE}
    stored = sorted(every, key=written)
    assert len({*map(written, every)}) == len(every)
    ordered = list(names.in_order(stored, written=written, name=str, limit=names.MAX_KEY))
    assert ordered == sorted(every, key=str.encode)
