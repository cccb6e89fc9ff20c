"""Objects of a simulated scene: seeded reset, and success of tasks by the state of the simulation."""
