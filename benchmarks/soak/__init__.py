"""Parts of the suite ``soak``: the load, who looks at the processes, and what their memory says."""
