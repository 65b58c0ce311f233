"""Every policy: rules, references that know the model, saved agents."""
