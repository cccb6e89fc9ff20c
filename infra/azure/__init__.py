"""Event Grid namespace configuration."""
