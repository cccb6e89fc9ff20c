"""Constants that the host and the sandbox processes share. They work on every operating system."""

LIMITS, USER, LANDLOCK, SECCOMP = "limits", "user", "landlock", "seccomp"
LAYERS = (LIMITS, USER, LANDLOCK, SECCOMP)
"""Layers in the order in which a script process applies them."""
MAX_MESSAGE = 4096
"""Maximum size of a message between the host and the zygote [bytes]."""
