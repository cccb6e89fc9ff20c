"""Releases of an agent that ``install-agent.sh`` installed: update, rollback and the trial of a new release."""
