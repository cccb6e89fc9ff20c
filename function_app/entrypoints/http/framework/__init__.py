"""What all routes share: registration, lookup, authentication, responses."""
