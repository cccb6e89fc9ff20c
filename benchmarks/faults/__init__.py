"""Parts of the suite ``faults``: what does the damage, who works meanwhile, and what came of it."""
