"""Agents, devices, shares and invitations."""
