"""What commands show and write: tables, figures, progress, files."""
