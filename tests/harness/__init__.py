"""What suites share: real brokers as processes, and clients to try them with."""
