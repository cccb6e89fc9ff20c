"""What the services ask of the outside, as Protocols. Each page is its implementer's manual."""
