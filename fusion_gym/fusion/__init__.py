"""Fusion rules: how the centre joins the nodes' estimates."""
