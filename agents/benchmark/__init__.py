"""The benchmark: rules and agents of every class, at equal price."""
