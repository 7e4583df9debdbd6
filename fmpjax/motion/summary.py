"""What the motions of a run were read as, and what is not healthy about them or does not suit the run."""

import re
from collections import Counter, defaultdict

from fmpjax import tables
from fmpjax.motion import check
from fmpjax.motion.library import MotionLibrary
from fmpjax.robots import Robot

FEW = 4  # motions that are shown one by one
SHOWN = 3  # values of a fact, at most, where there are many motions


def summary(robot: Robot, library: MotionLibrary, *, axes: str, reset: str, seconds: float) -> str:
    """Lines of text: of a few motions each one's reading and faults, of many what they share.

    ``axes``, ``reset`` and ``seconds`` are the run's, as in `check.unsuited`.
    """
    faults = [
        [
            *clip.reading.warnings,
            *check.faults(robot, clip),
            *check.unsuited(robot, clip, axes=axes, reset=reset, seconds=seconds),
        ]
        for clip in library.clips
    ]
    if len(library.clips) > FEW:
        return _of_many(library, faults)
    lines = []
    for clip, said in zip(library.clips, faults, strict=True):
        lines.append(f"motion {clip.name}, {len(clip)} samples in {clip.duration:.2f} s, was read as")
        lines.append(str(clip.reading._replace(warnings=tuple(said))))
    return "\n".join(lines)


def _of_many(library: MotionLibrary, faults: list[list[str]]) -> str:
    """Each fact with its most frequent values; one warning of each kind, and of how many motions it is true."""
    count, length = len(library.clips), sum(clip.duration for clip in library.clips)
    values: dict[str, Counter] = defaultdict(Counter)
    for clip in library.clips:
        for fact in clip.reading.facts:
            values[fact.what][fact.value, fact.why] += 1
    rows = []
    for what, found in values.items():
        for (value, why), times in found.most_common(SHOWN):
            rows.append((what, value, f"{times} motions: {why}"))
            what = ""
        if len(found) > SHOWN:
            rows.append(("", "...", f"{len(found) - SHOWN} other values"))
    lines = [f"{count} motions, {length:.0f} s in all, were read as", tables.lines("  {:<12}{:<32}{}", rows)]
    kinds: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for clip, said in zip(library.clips, faults, strict=True):
        for sentence in said:
            kinds[re.sub(r"\(.*?\)|-?\d+(\.\d+)?(e[+-]\d+)?", "", sentence)].append((clip.name, sentence))
    for found in sorted(kinds.values(), key=len, reverse=True):
        name, sentence = found[0]
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        lines.append(f"  warning: {sentence} [motion {name}{more}]")
    return "\n".join(lines)
