"""Whether path supervision makes a better reward beyond the rollout that it was fitted on (Table II).

FMP, Endpoint and Value are fitted to the windows of a standing policy and compared with references that they never saw,
also along rollout-to-expert paths (Fig. mechanism, a and b). Run as
``fmpjax experiment generalization --run STANDING --walking WALKING --out FOLDER``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmpjax.experiments.common import offline, results
from fmpjax.experiments.common.offline import GROUPS, Updates
from fmpjax.experiments.common.results import Table, Verdict, number
from fmpjax.viz import panels
from fmpjax.viz.panels import Line, Panel

NAME = "generalization"
TITLES = {"fmp": "FMP", "endpoint": "Endpoint", "value": "Value", GROUPS: "Reference groups"}
COLORS = {"fmp": "#2a6fb0", "endpoint": "#3a8a6b", "value": "#c8553d", GROUPS: "#5b6673"}
PAPER: dict[str, dict[str, float]] = {
    "fmp": {
        "held_out_error": 0.059, "held_out_cosine": 0.937, "end_correlation": 0.979,
        "walking_correlation": 0.898, "walking_cosine": 0.829, "executed_error": 0.667,
    },
    "endpoint": {
        "held_out_error": 0.069, "held_out_cosine": 0.923, "end_correlation": 0.157,
        "walking_correlation": 0.463, "walking_cosine": 0.560, "executed_error": 1.411,
    },
    "value": {
        "held_out_error": 0.094, "held_out_cosine": 0.382, "end_correlation": 0.826,
        "walking_correlation": 0.618, "walking_cosine": 0.264, "executed_error": 1.473,
    },
    GROUPS: {
        "end_correlation": 0.992, "walking_correlation": 0.994, "walking_cosine": 0.994, "executed_error": 0.296,
    },
}  # fmt: skip
COLUMNS = {
    "held_out_error": "held-out reward MAE",
    "held_out_cosine": "held-out cosine",
    "end_correlation": "correlation at the expert",
    "walking_correlation": "walking: correlation",
    "walking_cosine": "walking: cosine",
    "executed_error": "executed: RMSE/IQR",
}


def _figures(record: Mapping[str, Any], name: str) -> dict[str, float]:
    figures = record["models"][name]
    return figures | {"end_correlation": figures["path_correlation"][-1]}


def table(record: Mapping[str, Any]) -> Table:
    """Table II and the figures around it, the paper's beside ours."""
    lines = []
    for name in record["models"]:
        lines.append([TITLES[name], *(number(_figures(record, name)[key]) for key in COLUMNS)])
        lines.append([f"{TITLES[name]}, the paper's", *(number(PAPER[name].get(key)) for key in COLUMNS)])
    size = record["settings"]
    caption = (
        f"Reward generalization after {size['updates']:,} updates on {32 * size['environments']:,} windows of the "
        f"standing policy ({record['policies']['pool_speed']:.2f} m/s), against references of {size['banks']} banks"
    )
    return Table(caption, ["prior", *COLUMNS.values()], lines)


def verdicts(record: Mapping[str, Any]) -> list[Verdict]:
    """The paper's claims on generalization, by our figures."""
    fmp, endpoint, value = (_figures(record, name) for name in ("fmp", "endpoint", "value"))

    def compare(key: str) -> str:
        return f"{number(fmp[key])} against {number(endpoint[key])} (Endpoint) and {number(value[key])} (Value)"

    def least(key: str) -> bool:
        return fmp[key] < min(endpoint[key], value[key])

    def most(key: str) -> bool:
        return fmp[key] > max(endpoint[key], value[key])

    return [
        Verdict(
            "Path supervision lowers the reward's error on held-out windows",
            compare("held_out_error"), least("held_out_error"),
        ),
        Verdict(
            "Endpoint supervision makes gradients agree where values alone do not",
            f"a held-out cosine of {number(endpoint['held_out_cosine'])} against {number(value['held_out_cosine'])}",
            endpoint["held_out_cosine"] > value["held_out_cosine"],
        ),
        Verdict(
            "At the experts' end of the paths FMP's score follows the reference best",
            f"a correlation of {compare('end_correlation')}", most("end_correlation"),
        ),
        Verdict(
            "On executed walking FMP's score follows the reference best",
            f"a correlation of {compare('walking_correlation')}", most("walking_correlation"),
        ),
        Verdict(
            "On executed walking FMP's gradient follows the reference best",
            f"a cosine of {compare('walking_cosine')}", most("walking_cosine"),
        ),
        Verdict(
            "On executed histories FMP's error is the least",
            f"RMSE/IQR {compare('executed_error')}", least("executed_error"),
        ),
    ]  # fmt: skip


def figure(record: Mapping[str, Any], path: Path) -> Path:
    """Correlation, increment error and gradient cosine along the paths."""
    fractions = record["fractions"]

    def panel(title: str, key: str, theirs: str = "") -> Panel:
        lines = {
            TITLES[name]: Line(fractions, figures[key], COLORS[name], "--" if name == GROUPS else "-", "o")
            for name, figures in record["models"].items()
        }
        for name in record["models"] if theirs else ():
            lines[f"{TITLES[name]}, the paper's"] = Line([1.0], [PAPER[name][theirs]], COLORS[name], "", "D", True)
        return Panel(title, "fraction of the way to the expert", lines)

    return panels.draw(
        path,
        [
            panel("a  score's correlation with the reference", "path_correlation", "end_correlation"),
            panel("b  score increment's RMSE / IQR", "path_increment"),
            panel("gradient's cosine with the reference", "path_cosine"),
        ],
    )


def main(run: Path, walking: Path, out: Path, updates: Updates = None, smoke: bool = False, seed: int = 0) -> None:
    """Fit FMP, Endpoint and Value to a standing policy's windows, and measure them beyond these.

    Args:
      run: folder of a run whose newest policy stands.
      walking: folder of a run of the same demonstration whose best policy walks.
      out: folder for generalization.json, .csv and .png.
      updates: of each prior.
      smoke: a small test run; its figures mean nothing.
      seed: of everything random.
    """
    size = offline.size(updates, smoke)
    results.check_folder(out)
    record = offline.study(run, walking, ("fmp", "endpoint", "value"), size, seed)
    paths = results.save(out, NAME, record, offline.rows(record), (run, walking, out))
    paths.append(figure(record, out / f"{NAME}.png"))
    print(results.text(table(record)))
    print(f"\n{offline.cost(record)}\n")
    print(*verdicts(record), sep="\n")
    print(*(f"wrote {path}" for path in paths), sep="\n")


if __name__ == "__main__":
    results.entry(main)
