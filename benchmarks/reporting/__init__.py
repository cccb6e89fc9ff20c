"""Reports, the generated results page and the cost model."""
