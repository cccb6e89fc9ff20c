"""Configuration of the agent: settings, identity, robot types and rooms."""
