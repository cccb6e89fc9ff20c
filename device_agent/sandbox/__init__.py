"""Sandbox of movement scripts: a zygote forks one confined process per script.

```
agent ── host ──(requests)── zygote ──fork── confinement, script_process, api
  └────────── the script's only socket: one line of JSON per message ────────┘
```

``host`` runs inside the agent and implements ``ports.sandbox``. All other modules run in processes without any
resource of the agent. They import the standard library, NumPy and ``pyseccomp``, and no other part of Telescope.

The server's check of uploaded models uses the layers ``privileges``, ``landlock`` and ``seccomp`` as well.
"""
