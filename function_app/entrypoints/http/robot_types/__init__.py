"""Robot types."""
