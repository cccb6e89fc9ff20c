"""Route registration and lookup, authentication, and responses."""
