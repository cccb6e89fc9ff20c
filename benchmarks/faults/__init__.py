"""Parts of the suite ``faults``: fault injection, load during the faults, and evaluation."""
