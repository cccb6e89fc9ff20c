"""What the cloud does, one use case a file. Stateless: everything between two calls is in the tables."""
