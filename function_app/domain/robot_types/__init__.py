"""Robot types and movements."""
