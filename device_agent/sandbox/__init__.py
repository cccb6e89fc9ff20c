"""The jail of movement scripts: a warm parent from which every script is forked into a locked process of its own.

```
agent ── warm ──(requests)── parent ──fork── confine, script, api
  └─────── the script's only socket: a line of JSON a message ──────┘
```

``warm`` runs inside the agent and implements ``ports.jail``. All other files run in processes that hold nothing of the
agent's: they import the standard library, NumPy and ``pyseccomp``, nothing else of Telescope.
"""
