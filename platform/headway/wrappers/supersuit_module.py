"""The module `supersuit`, which may be missing: see `headway.wrappers.supersuit`."""

from types import ModuleType

from headway.contracts import HeadwayError


def imported_supersuit() -> ModuleType:
    """Return the module. Raises HeadwayError that says how to install it."""
    try:
        import supersuit
    except ModuleNotFoundError as error:
        raise HeadwayError("SuperSuit is not installed: pip install --no-deps supersuit") from error
    module: ModuleType = supersuit
    return module
