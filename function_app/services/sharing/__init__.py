"""Shares, invitations and ownership transfers."""
