"""Codes of names sort as the names do, hold only what Azure takes, and fit."""

import re

from hypothesis import given, settings
from hypothesis import strategies as st

from function_app.adapters.azure import names
from tests.contract.tables.suite import HOSTILE, KEYS

TEXTS = st.text(max_size=40)
_TAKEN = re.compile(r"\A[!-~]*\Z")
_REFUSED = re.compile(r"[/\\#?%+\x00-\x20\x7f]")

EDGES = "".join(chr(first + step) for first, _, _ in names._SIGNS for step in (-1, 0, 1) if first + step >= 0)
LONG = tuple("n" * 469 + tail for tail in ("", "a", "b", "ü", "🤖", "aa", "a/", "\0"))


@settings(max_examples=500, deadline=None)
@given(one=TEXTS, other=TEXTS)
def test_a_code_says_which_name_it_is_and_sorts_as_it_does(one: str, other: str) -> None:
    codes = names.encode(one), names.encode(other)
    assert (names.decode(codes[0]), names.decode(codes[1])) == (one, other)
    assert (codes[0] < codes[1]) == (one.encode() < other.encode())
    assert codes[0].startswith(codes[1]) == one.startswith(other)
    assert all(_TAKEN.match(code) and not _REFUSED.search(code) for code in codes)


def test_characters_of_every_plane_sort_as_in_utf_8() -> None:
    points = sorted({*range(0x3000), *range(0x3000, 0x110000, 61), *map(ord, EDGES)})
    letters = [chr(point) for point in points if not 0xD800 <= point < 0xE000]
    codes = [names.encode(letter) for letter in letters]
    assert codes == sorted(set(codes))
    assert [names.decode(code) for code in codes] == letters
    assert not any(_REFUSED.search(code) for code in codes)


def test_what_telescope_names_stays_readable() -> None:
    assert names.encode("now:lease") == "now:lease"
    assert names.encode("0001763700000000:A-b_9") == "0001763700000000:A-b_9"
    assert names.encode("robots/ur5.xml") == "robots.0ur5.-xml"


@settings(max_examples=200, deadline=None)
@given(text=st.text(alphabet=st.sampled_from("a/ü🤖" + EDGES), min_size=1, max_size=512))
def test_what_is_written_fits_and_is_cut_only_where_it_must(text: str) -> None:
    for limit in (names.MAX_KEY, names.MAX_BLOB_NAME):
        code = names.encode(text)
        written = names.fit(code, limit)
        assert 0 < len(written) <= limit
        assert (written == code) == (not names.is_cut(written, limit))
        assert written.startswith(names.head(code, limit))


def test_names_that_begin_alike_are_written_differently() -> None:
    many = (*KEYS, *HOSTILE, *LONG)
    assert len({names.fit(names.encode(name), names.MAX_KEY) for name in many}) == len(set(many))


@settings(max_examples=200, deadline=None)
@given(
    found=st.lists(
        st.builds(str.__add__, st.sampled_from(("n" * 469, "n" * 468 + "m", "🤖" * 118)), st.text(max_size=3))
        | st.text(min_size=1, max_size=5),
        unique=True,
        max_size=30,
    )
)
def test_what_sorts_by_what_is_written_comes_in_the_order_of_names(found: list[str]) -> None:
    def written(name: str) -> str:
        return names.fit(names.encode(name), names.MAX_KEY)

    stored = sorted(found, key=written)
    ordered = list(names.in_order(stored, written=written, name=str, limit=names.MAX_KEY))
    assert ordered == sorted(found, key=str.encode)
