"""Reference measurements and the product that every suite measures."""
