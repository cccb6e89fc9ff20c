"""Occupancy grid, object tracking and sensor fusion of a room."""
