"""Parts of the suite ``soak``: load, samples of the processes, and trends."""
