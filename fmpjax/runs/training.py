"""Training runs from their start or their checkpoints to a clean end."""

import contextlib
import signal
import time
from collections.abc import Generator, Sequence

from fmpjax import evaluate, memory, metrics, sharding
from fmpjax.errors import UserError, out_of_memory
from fmpjax.logs import Progress, check_logger, clock
from fmpjax.motion import library
from fmpjax.provenance import machine
from fmpjax.runs.clock import Clock, End
from fmpjax.runs.folder import Run
from fmpjax.runs.recorder import Recorder
from fmpjax.runs.served import Live
from fmpjax.runs.session import Session

try:
    import fcntl
except ImportError:  # on Windows, where every command says that it does not run
    fcntl = None


def train(
    *group: Run,
    resume: bool = False,
    minutes: float | None = None,
    devices: int | None = 1,
    live: Live | None = None,
    logger: str | None = None,
) -> End:
    """Train a run to the end of its budget, or of its time, or until it is told to stop; all three end cleanly.

    Several runs that differ in nothing but their seeds are trained at once, as one program, each into its own folder.
    Several devices, all of them for None, share the environments or the seeds. ``live`` shows the policies meanwhile.
    ``logger``, "wandb" or "trackio", gets the rows of the log.

    Raises:
      UserError: the runs do not belong together, too much was not finite, memory is too small, or the logger is unknown
        or not installed; what was saved stays.
    """
    check_logger(logger)
    memory.check(group[0].config, len(group), len(group[0].trainer().expert.windows))
    with enough_memory(group), held(group):
        return _train(*group, resume=resume, minutes=minutes, devices=devices, live=live, logger=logger)


def _train(
    *group: Run, resume: bool, minutes: float | None, devices: int | None, live: Live | None, logger: str | None
) -> End:
    progress = Progress(show=sharding.primary())
    config, began = group[0].config, time.monotonic()
    progress.note(
        f"run {', '.join(str(run.folder) for run in group)}: {config.method}, {config.preset}, {config.env.reset} "
        f"reset, {library.briefly(config.motion)}"
    )
    session = Session(group, resume=resume)
    if session.done >= config.iterations:
        progress.note(f"the budget of {config.transitions:,} transitions is spent: a larger --transitions continues")
        return End.BUDGET
    if session.done and sharding.primary():
        for run in group:
            run.resumed()
    if live is not None:
        live.open(session)
    session.pretrain(progress)
    compiling = _compile(session, devices, progress)
    recorders = _recorders(session, progress, logger)
    training = Clock(
        config,
        done=session.done,
        evaluated=recorders[0].evaluated,
        seconds=recorders[0].log.seconds,
        minutes=minutes,
        began=began,
        spare=compiling,
        agree=sharding.agree,
    )
    end = _loop(session, training, recorders, progress, live)
    for recorder in recorders:
        recorder.close()
    if end is not End.BUDGET:
        progress.note(f"{end.value} at {training.transitions:,} transitions; saved. Continue with --resume.")
    return end


def _loop(
    session: Session, training: Clock, recorders: Sequence[Recorder], progress: Progress, live: Live | None
) -> End:
    """Call the program until the budget or the time is spent or a signal comes, and do what is due in between.

    Several processes must come to the same calls of the devices and of each other in the same order.
    """
    with StopSignals() as stop:
        end = None
        while end is None:
            rows, took = session.advance()
            training.tick(session.done, took)
            progress.show(progress_line(training, rows), final=training.spent)
            session.check_finite()
            if live is not None:
                live.show(session)
            due = training.due(asked=stop.requested)
            # Before the evaluation, after which processes are no longer in step.
            states = session.on_host() if due.save else [None] * len(rows)
            for recorder, row, state in zip(recorders, rows, states, strict=True):
                recorder.record(training, row, state, evaluate=due.evaluate)
            training.did(due)
            end = due.end
        if not due.save:
            for recorder, state in zip(recorders, session.on_host(), strict=True):
                recorder.save(state)
    return end


def _compile(session: Session, devices: int | None, progress: Progress) -> float:
    """Compile the session's program and say so; the seconds that it took."""
    physics = session.trainer.env.physics.name
    progress.note(f"{physics} physics on {machine()}; compiling, which takes a minute or so ...")
    began = time.monotonic()
    session.compile(devices)
    compiling = time.monotonic() - began
    progress.note(f"compiled in {compiling:.0f} s")
    return compiling


def _recorders(session: Session, progress: Progress, logger: str | None) -> list[Recorder]:
    """A recorder for each run, from where the session stands."""
    columns = [*session.metric_names(), *(f"eval/{name}" for name in evaluate.names(session.config))]
    several = len(session.group) > 1
    return [
        Recorder(
            run,
            session.config,
            columns,
            session.done,
            evaluate=session.evaluator,
            note=progress.note,
            label=f"seed {run.config.seed}, " if several else "",
            keep=sharding.primary(),
            logger=logger,
        )
        for run in session.group
    ]


def progress_line(training: Clock, rows: Sequence[dict[str, float]]) -> str:
    """Where a training stands, in one line: the runs' mean metrics, their speed together and the time left."""
    config = training.config
    m = {name: metrics.mean([row[name] for row in rows]) for name in rows[0]}
    losses = " ".join(
        f"{name} {m[f'fit/{name}_loss']:.2f}" for name in ("value", "endpoint", "flow") if f"fit/{name}_loss" in m
    )
    unit, letter = (1e6, "M") if config.transitions >= 1e6 else (1e3, "k")
    return (
        f"{training.transitions / unit:6.2f} of {config.transitions / unit:.2f} {letter} | "
        f"{len(rows) * training.rate:,.0f}/s, {clock(training.left)} left | "
        f"episode {m['train/episode_length']:.0f} of {m['env/cap']:.0f} steps, falls {100 * m['train/falls']:.0f} % | "
        f"speed {m['train/speed']:+.2f} m/s | reward spread {m['train/reward_spread']:.2f} | {losses}"
    )


class StopSignals:
    """Ctrl-C and SIGTERM ask a run to stop after the chunk in hand; a second Ctrl-C stops at once."""

    def __init__(self):
        self.requested = False

    def __enter__(self):
        self._before = {s: signal.signal(s, self._request) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def _request(self, number, frame):
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.requested = True
        print("\nstopping after the current call of the program, then saving ...", flush=True)

    def __exit__(self, *exception):
        for number, handler in self._before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def held(group: Sequence[Run]) -> Generator[None]:
    """Keep other processes from training in the run folders; a process that ends, however, lets go of them."""
    if fcntl is None or not sharding.primary():
        yield
        return
    with contextlib.ExitStack() as held:
        for run in group:
            try:
                lock = held.enter_context((run.folder / ".lock").open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(f"run {run.folder} is being trained by another process: wait for its end") from None
            except OSError:  # a file system that has no locks or cannot be written, which saving will say
                pass
        yield


@contextlib.contextmanager
def enough_memory(group: Sequence[Run]) -> Generator[None]:
    """Say what to change where memory runs out."""
    try:
        yield
    except Exception as error:
        if not out_of_memory(error):
            raise
        config = group[0].config
        less = f"env.count (now {config.env.count}) or prior.bank (now {config.prior.bank})"
        less += f", or --seeds (now {len(group)})" if len(group) > 1 else ""
        saved = set.intersection(*(run.checkpoints.iterations() for run in group))
        kept = ""
        if saved:
            kept = f"; the checkpoint of iteration {max(saved):,} is whole: --resume continues with more memory"
            kept += ", or with some of the seeds" if len(group) > 1 else ""
        raise UserError(f"out of memory on {machine()}: start a run with a smaller {less}{kept}") from error
