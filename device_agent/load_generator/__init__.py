"""A fleet in one process, to try a server with: thousands of agents on the wire, none of them with physics."""
