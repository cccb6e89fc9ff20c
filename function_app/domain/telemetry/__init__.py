"""Time series and latency histograms."""
