"""The contract between systems, policies and environments, and the episodes that keep it."""
