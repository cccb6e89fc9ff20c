"""Models of people, climate, light and sound in a simulated room."""
