"""The commands of fusion-gym."""
