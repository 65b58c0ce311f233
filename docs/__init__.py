"""The pages, their tables and the site."""
