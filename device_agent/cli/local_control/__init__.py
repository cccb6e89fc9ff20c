"""Control of the running agent by programs of the same machine, over a Unix socket in the agent's folder."""
