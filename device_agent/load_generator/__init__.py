"""Load generator: thousands of simulated agents without physics in one process."""
