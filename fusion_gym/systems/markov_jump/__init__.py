"""A Markov jump plant with fading, asynchronous sensors: markov_jump."""
