"""The Telescope agent: the program on a robot or a room PC, with one identity and one broker connection."""
