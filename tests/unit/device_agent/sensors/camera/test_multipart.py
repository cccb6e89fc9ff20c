"""The parser of MJPEG streams: every division into chunks gives the same parts, within its limits."""

import itertools
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.sensors.camera.multipart import MultipartError, MultipartParser, boundary_of

_MAX = 500
_parts = st.lists(st.binary(min_size=1, max_size=_MAX).filter(lambda part: b"--b" not in part), max_size=5)


def stream(parts: Sequence[bytes], *, lengths: bool) -> bytes:
    heads = [f"Content-Length: {len(part)}\r\n" if lengths else "" for part in parts]
    return b"".join(
        f"--b\r\nContent-Type: image/jpeg\r\n{head}\r\n".encode() + part + b"\r\n"
        for head, part in zip(heads, parts, strict=True)
    )


@given(_parts, st.lists(st.integers(0, 3000), max_size=8))
def test_parts_do_not_depend_on_the_chunks(parts: list[bytes], cuts: list[int]) -> None:
    content = stream(parts, lengths=True) + b"--b"
    parser = MultipartParser(b"b", _MAX)
    edges = itertools.pairwise(sorted({0, len(content), *(cut for cut in cuts if cut < len(content))}))
    assert [part for start, end in edges for part in parser.feed(content[start:end])] == parts


@given(st.lists(st.binary(min_size=1, max_size=_MAX - 2), max_size=5))
def test_parts_without_lengths_end_at_the_boundary(bodies: list[bytes]) -> None:
    parts = [body.replace(b"--b", b"") + b"\xff\xd9" for body in bodies]
    parser = MultipartParser(b"b", _MAX)
    content = stream(parts, lengths=False) + b"--b"
    assert [part for byte in content for part in parser.feed(bytes((byte,)))] == parts


@pytest.mark.parametrize("lengths", [True, False])
@pytest.mark.parametrize("size", [_MAX + 1, 2 * _MAX])
def test_a_part_above_the_limit_is_rejected_even_if_it_arrives_at_once(size: int, lengths: bool) -> None:
    parser = MultipartParser(b"b", _MAX)
    with pytest.raises(MultipartError, match="a picture has more than"):
        parser.feed(stream([bytes(size)], lengths=lengths) + b"--b")


@pytest.mark.parametrize("length", ["-1", "many", "9" * 13])
def test_an_invalid_length_is_rejected(length: str) -> None:
    with pytest.raises(MultipartError, match="a part has an invalid length"):
        MultipartParser(b"b", _MAX).feed(f"--b\r\nContent-Length: {length}\r\n\r\n".encode())


@pytest.mark.parametrize("text", ["frame", "--frame", '"--frame"', "frame; charset=x"])
def test_the_boundary_is_found_with_and_without_dashes(text: str) -> None:
    assert boundary_of(f"multipart/x-mixed-replace;boundary={text}") == b"frame"


@pytest.mark.parametrize("content_type", ["multipart/x-mixed-replace", "multipart/mixed; boundary=--", ""])
def test_a_missing_boundary_is_rejected(content_type: str) -> None:
    with pytest.raises(MultipartError, match="names no boundary"):
        boundary_of(content_type)
