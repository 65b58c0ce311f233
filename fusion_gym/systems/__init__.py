"""Plants with their sensors, filters and fusion centre: a room for each paper."""
