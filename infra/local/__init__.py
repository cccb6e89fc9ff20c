"""``make up``: the whole product on one machine, one process each, watched."""
