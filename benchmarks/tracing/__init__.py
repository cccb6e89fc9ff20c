"""Timestamps at each hop of a command, on one clock."""
