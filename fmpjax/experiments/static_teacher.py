"""Path supervision by sampled displacements against that by the score's own gradient (Fig. mechanism, c).

FMP is fitted with dynamic labels, which cost nothing, and with static ones, for which a second bank is solved at every
update, from the same parameters on the same points. Run as
``fmpjax experiment static_teacher --run STANDING --walking WALKING --out FOLDER``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmpjax.experiments.common import offline, results
from fmpjax.experiments.common.offline import GROUPS, Updates
from fmpjax.experiments.common.results import Table, Verdict, number
from fmpjax.viz import panels
from fmpjax.viz.panels import Line, Panel

NAME = "static_teacher"
TITLES = {"fmp": "dynamic (FMP)", "static": "static", GROUPS: "reference groups"}
COLORS = {"fmp": "#2a6fb0", "static": "#a3623a", GROUPS: "#5b6673"}
# The paper does not give the errors at 0.75 in numbers.
PAPER: dict[str, dict[str, float]] = {
    "fmp": {
        "increment_0.25": 0.284, "increment_0.5": 0.376, "increment_1": 1.053, "end_cosine": 0.744,
        "source_error": 0.065, "walking_correlation": 0.880, "seconds": 1139.0,
    },
    "static": {
        "increment_0.25": 0.416, "increment_0.5": 0.437, "increment_1": 0.523, "end_cosine": 0.934,
        "source_error": 0.065, "walking_correlation": 0.918, "seconds": 1606.0,
    },
}  # fmt: skip
COLUMNS = {
    "increment_0.25": "increment RMSE/IQR at 0.25",
    "increment_0.5": "0.50",
    "increment_0.75": "0.75",
    "increment_1": "1.00",
    "end_cosine": "cosine at the expert",
    "source_error": "source reward MAE",
    "walking_correlation": "walking: correlation",
    "seconds": "fitting, s",
}


def _figures(record: Mapping[str, Any], name: str) -> dict[str, float]:
    figures = record["models"][name]
    increments = dict(zip(record["fractions"], figures["path_increment"], strict=True))
    return figures | {f"increment_{f:g}": v for f, v in increments.items()} | {"end_cosine": figures["path_cosine"][-1]}


def table(record: Mapping[str, Any]) -> Table:
    """The comparison, the paper's figures beside ours."""

    def line(name: str, figures: Mapping[str, float]) -> list[str]:
        return [name, *(number(figures.get(key), 0 if key == "seconds" else 3) for key in COLUMNS)]

    lines = []
    for name in record["models"]:
        lines.append(line(TITLES[name], _figures(record, name)))
        if name in PAPER:
            lines.append(line(f"{TITLES[name]}, the paper's", PAPER[name]))
    return Table(
        f"Dynamic and static path supervision after {record['settings']['updates']:,} updates",
        ["supervision", *COLUMNS.values()],
        lines,
    )


def verdicts(record: Mapping[str, Any]) -> list[Verdict]:
    """The paper's claims on static supervision, by our figures."""
    dynamic, static = _figures(record, "fmp"), _figures(record, "static")

    def compare(key: str) -> str:
        return f"{number(dynamic[key])} (dynamic) against {number(static[key])} (static)"

    ratio = static["seconds"] / dynamic["seconds"]
    return [
        *(
            Verdict(
                f"Dynamic supervision has the lower increment error at {fraction}",
                compare(f"increment_{fraction:g}"),
                dynamic[f"increment_{fraction:g}"] < static[f"increment_{fraction:g}"],
            )
            for fraction in (0.25, 0.5)
        ),
        *(
            Verdict(
                f"Static supervision has the lower increment error at {fraction}",
                compare(f"increment_{fraction:g}"),
                static[f"increment_{fraction:g}"] < dynamic[f"increment_{fraction:g}"],
            )
            for fraction in (0.75, 1.0)
        ),
        Verdict(
            "Static supervision has the better gradient at the expert",
            f"a cosine of {compare('end_cosine')}",
            static["end_cosine"] > dynamic["end_cosine"],
        ),
        Verdict(
            "Dynamic supervision takes less time to fit",
            f"{number(dynamic['seconds'], 0)} s against {number(static['seconds'], 0)} s, a ratio of {ratio:.2f} (the "
            f"paper's {PAPER['static']['seconds'] / PAPER['fmp']['seconds']:.2f})",
            ratio > 1.0,
        ),
    ]


def figure(record: Mapping[str, Any], path: Path) -> Path:
    """Increment error and gradient cosine along the paths."""
    fractions = record["fractions"]

    def panel(title: str, key: str) -> Panel:
        lines = {
            TITLES[name]: Line(fractions, figures[key], COLORS[name], "--" if name == GROUPS else "-", "o")
            for name, figures in record["models"].items()
        }
        for name, figures in PAPER.items():
            if key == "path_increment":
                known = [f for f in fractions if f"increment_{f:g}" in figures]
                given = known, [figures[f"increment_{f:g}"] for f in known]
            else:
                given = [1.0], [figures["end_cosine"]]
            lines[f"{TITLES[name]}, the paper's"] = Line(*given, COLORS[name], "", "D", True)
        return Panel(title, "fraction of the way to the expert", lines)

    return panels.draw(
        path,
        [
            panel("c  score increment's RMSE / IQR", "path_increment"),
            panel("gradient's cosine with the reference", "path_cosine"),
        ],
        width=4.4,
    )


def main(run: Path, walking: Path, out: Path, updates: Updates = None, smoke: bool = False, seed: int = 0) -> None:
    """Fit FMP with dynamic and with static path supervision, and compare them.

    Args:
      run: folder of a run whose newest policy stands.
      walking: folder of a run of the same demonstration whose best policy walks.
      out: folder for static_teacher.json, .csv and .png.
      updates: of either.
      smoke: a small test run; its figures mean nothing.
      seed: of everything random.
    """
    size = offline.size(updates, smoke)
    results.check_folder(out)
    record = offline.study(run, walking, ("fmp", "static"), size, seed)
    paths = results.save(out, NAME, record, offline.rows(record), (run, walking, out))
    paths.append(figure(record, out / f"{NAME}.png"))
    print(results.text(table(record)))
    print(f"\n{offline.cost(record)}\n")
    print(*verdicts(record), sep="\n")
    print(*(f"wrote {path}" for path in paths), sep="\n")


if __name__ == "__main__":
    results.entry(main)
