"""What turns docs/, the results and the docstrings into the documentation site (`make docs`)."""
