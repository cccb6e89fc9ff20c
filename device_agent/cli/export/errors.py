"""Error of an export."""


class ExportError(Exception):
    """The export cannot be made. The message names the file or option, and the remedy."""
