"""Real-time MuJoCo simulation of robots and rooms."""
