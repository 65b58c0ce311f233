"""The commands of fusion-gym."""


def missing_extra(error: BaseException) -> str | None:
    """Return the line about the packages to install if the error is a missing package."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    missing = error.name or str(error)
    if missing.partition(".")[0] == "fusion_gym":
        return None
    return f"error: {missing} is missing: install fusion-gym with its extra 'agents'"
