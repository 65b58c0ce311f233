"""The output of commands: tables, figures, progress and files."""
