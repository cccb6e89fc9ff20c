"""The program on a robot or a room PC: one identity, one broker connection, any number of devices."""
