"""What all command lines of the package share: what their help shows, and how they end."""

import contextlib
import dataclasses
import os
import select
import sys
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, Union

import tyro

from fmpjax import machine
from fmpjax.errors import UserError, out_of_memory


@dataclasses.dataclass(frozen=True)
class Group:
    """Commands under one name."""

    sentence: str  # what they are for
    commands: Mapping[str, Any]  # a class, a function, another group, or the sentence of one that is parsed elsewhere


def default(text: object) -> Any:
    """For ``Annotated``: what an option that is None means, as the help shows it."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


def parse(what: Group | Callable[..., Any], program: str, arguments: Sequence[str] | None = None) -> Any:
    """Parse a command line: an instance of the command's class, or what its function returned."""
    options: dict[str, Any] = {"prog": program, "args": arguments, "config": (tyro.conf.DisallowNone,)}
    if isinstance(what, Group):
        return tyro.cli(_union(what), description=what.sentence, **options)
    return tyro.cli(what, **options)


def _union(group: Group) -> Any:
    branches = []
    for name, command in group.commands.items():
        if isinstance(command, Group):
            branch = tyro.conf.subcommand(name, constructor=_union(command), description=command.sentence)
        elif isinstance(command, str):
            branch = tyro.conf.subcommand(name, constructor=lambda: None, description=command)
        else:
            branch = tyro.conf.subcommand(name, constructor=command)
        branches.append(Annotated[Any, branch])
    return Union[tuple(branches)]  # noqa: UP007 - of as many as there are


def program() -> str:
    """The command that this process was started as: ``fmpjax``, or ``python -m`` and an experiment."""
    # `python -m fmpjax.experiments.NAME` leaves the module's file as the program's name.
    file = Path(sys.argv[0])
    return f"python -m fmpjax.experiments.{file.stem}" if file.parent.name == "experiments" else "fmpjax"


@contextlib.contextmanager
def ending() -> Generator[None]:
    """Around a command: bad input is one sentence and exit code 2; a reader that has gone ends it in silence."""
    # The video encoder is a child process; it is started by exec at once and never touches JAX's threads.
    warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
    try:
        with _refusing():
            try:
                if sentence := machine.unsupported():
                    raise UserError(sentence)
                yield
            finally:
                # Here, since a pipe that turns out to be closed when Python exits cannot be caught.
                if sys.stdout:
                    sys.stdout.flush()
    except BrokenPipeError:
        if not _reader_gone():  # another pipe broke, such as a child process's
            raise
        null = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(null, stream.fileno())
        sys.exit(1)


def _reader_gone() -> bool:
    """Whether nobody reads the output any more: `head`, say, has read enough."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        poll.register(stream, 0)  # errors and hang-ups are always reported
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


@contextlib.contextmanager
def _refusing() -> Generator[None]:
    try:
        yield
    except UserError as error:
        _refuse(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        if out_of_memory(error):
            _refuse("out of memory: expected fewer --episodes, or a smaller env.count or evaluation_episodes")
        raise


def _refuse(sentence: str) -> NoReturn:
    print(f"fmpjax: {sentence}", file=sys.stderr)
    sys.exit(2)
