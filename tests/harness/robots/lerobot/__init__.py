"""Emulated servo buses of robots that LeRobot drives: Feetech STS and Dynamixel X on a pseudo-terminal."""
