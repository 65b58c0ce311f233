"""Commands of the maintainers: what makes tables and models of the documentation."""
