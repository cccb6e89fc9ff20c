"""Parser of ``multipart/x-mixed-replace``, the stream of MJPEG cameras. Its memory is limited."""

from email.message import Message

_MAX_HEADER_BYTES = 8192
_DASHES = b"--"
_HEADER_ENDS = (b"\r\n\r\n", b"\n\n")


class MultipartError(Exception):
    """The stream is not valid or exceeds a limit. The message is a clause for users."""


def boundary_of(content_type: str) -> bytes:
    """The boundary of a content type.

    Some cameras include the leading dashes in the parameter, others do not, so they are removed.

    Raises:
        MultipartError: The content type has none.
    """
    message = Message()
    message["content-type"] = content_type
    boundary = message.get_param("boundary")
    if not isinstance(boundary, str) or not boundary.strip("-"):
        raise MultipartError("its stream names no boundary")
    return boundary.lstrip("-").encode("utf-8", "replace")


class MultipartParser:
    """Splits a stream into parts.

    Args:
        boundary: Boundary without leading dashes.
        max_bytes: Maximum size of one part.
    """

    def __init__(self, boundary: bytes, max_bytes: int) -> None:
        self._delimiter = _DASHES + boundary
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._searched = 0
        self._length: int | None = None
        self._in_body = False

    def feed(self, data: bytes) -> list[bytes]:
        """Parts that are complete with this data.

        Raises:
            MultipartError: The stream is not valid, or a part is too large.
        """
        self._buffer += data
        parts = []
        while (part := self._next()) is not None:
            if len(part) > self._max_bytes:
                raise self._too_large()
            if part:
                parts.append(part)
        limit = self._max_bytes + _MAX_HEADER_BYTES + len(self._delimiter)
        if len(self._buffer) > limit:
            if not self._in_body:
                raise MultipartError("it sends no part with the boundary that it names")
            raise self._too_large()
        return parts

    def _next(self) -> bytes | None:
        """The next part; empty if only a header was complete; ``None`` if more data is needed."""
        if not self._in_body:
            return self._header()
        if self._length is not None:
            if len(self._buffer) < self._length:
                return None
            return self._body(self._length)
        position = self._find(self._delimiter)
        if position < 0:
            return None
        # Dashes before the delimiter belong to a boundary that was named with some of its dashes.
        return self._body(position).rstrip(b"\r\n-")

    def _header(self) -> bytes | None:
        start = self._find(self._delimiter)
        if start < 0:
            return None
        del self._buffer[:start]
        self._searched = 0
        ends = [(self._buffer.find(end), len(end)) for end in _HEADER_ENDS]
        found = [(position, length) for position, length in ends if position >= 0]
        if not found:
            if len(self._buffer) > _MAX_HEADER_BYTES:
                raise MultipartError("the header of a part is too long")
            return None
        position, length = min(found)
        self._length = self._content_length(bytes(self._buffer[len(self._delimiter) : position]))
        del self._buffer[: position + length]
        self._in_body = True
        return b""

    def _content_length(self, header: bytes) -> int | None:
        for line in header.splitlines():
            name, _, value = line.partition(b":")
            if name.strip().lower() == b"content-length":
                digits = value.strip()
                if not digits.isdigit() or len(digits) > 12:  # noqa: PLR2004 (more digits are no size of a picture)
                    raise MultipartError("a part has an invalid length")
                return int(digits) or None
        return None

    def _body(self, length: int) -> bytes:
        part = bytes(self._buffer[:length])
        del self._buffer[:length]
        self._in_body, self._length, self._searched = False, None, 0
        return part

    def _find(self, text: bytes) -> int:
        """Position of a text; data that was searched before is not searched again."""
        position = self._buffer.find(text, self._searched)
        self._searched = 0 if position >= 0 else max(0, len(self._buffer) - len(text) + 1)
        return position

    def _too_large(self) -> MultipartError:
        size_kb = self._max_bytes // 1000
        return MultipartError(
            f"a picture has more than {size_kb} KB; choose a lower resolution or quality in the camera"
        )
