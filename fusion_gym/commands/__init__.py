"""The commands: search, train, evaluate, compare and more."""


def missing_extra(error: BaseException) -> str | None:
    """The line that says what to install, if the error is that a package is missing."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    missing = error.name or str(error)
    if missing.partition(".")[0] == "fusion_gym":
        return None
    return f"error: {missing} is missing: pip install 'fusion-gym[agents]'"
