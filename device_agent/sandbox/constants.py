"""What both sides of the jail must agree on. Nothing in here needs Linux."""

LIMITS, USER, LANDLOCK, SECCOMP = "limits", "user", "landlock", "seccomp"
LAYERS = (LIMITS, USER, LANDLOCK, SECCOMP)
"""In the order in which a script's process puts them on."""
LONGEST_MESSAGE = 4096
"""Bytes of a message between the agent and the warm parent."""
