"""Virtual time, simulated threads and disks, and random numbers from one seed."""
