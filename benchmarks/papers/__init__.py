"""What the two papers printed, measured again with Telescope in their place."""
