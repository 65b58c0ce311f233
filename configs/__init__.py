"""The configs: one YAML for each environment and experiment."""
