"""What runs around the code: brokers, and the start of one machine. Each is a program of its own."""
