"""Execution of actions: single tasks and movement scripts."""
