"""The error of a server whose address is in use. Apart from the server, which cloud packages cannot import."""


class PortTaken(Exception):  # noqa: N818 (a message for the terminal)
    """Another program uses the address."""
