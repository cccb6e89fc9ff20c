"""Emulated controllers of real robots, which speak the real protocols."""
