"""What can be read from a robot's MuJoCo model, for drivers and for geometry alike."""
