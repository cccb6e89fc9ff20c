"""Robot types, movements and their validation."""
