"""Research made with the library: the benchmark, the papers and the zoo."""
