"""Processing of signed commands."""
