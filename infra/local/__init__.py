"""``make up``: the whole product on one machine, one supervised process per program."""
