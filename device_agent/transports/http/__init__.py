"""The cloud's HTTP API as the agent uses it."""
