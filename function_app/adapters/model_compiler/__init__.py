"""Model compiler."""
