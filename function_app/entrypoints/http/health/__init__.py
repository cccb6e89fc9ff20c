"""Routes of faults, diagnostics and the health check."""
