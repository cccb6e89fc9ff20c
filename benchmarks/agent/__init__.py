"""Cost of the parts of one agent."""
