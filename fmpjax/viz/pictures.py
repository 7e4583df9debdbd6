"""A figure's file."""

from pathlib import Path

from matplotlib.figure import Figure

from fmpjax.errors import UserError


def saved(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG; the path.

    Raises:
      UserError: it cannot be written.
    """
    try:
        figure.savefig(path, format="png")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    return path
