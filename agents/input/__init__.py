"""What a user hands in: options and files, checked before anything runs."""
