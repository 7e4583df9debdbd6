"""The score has a minimum where the barycenter's reward has its maximum (section III-D of the paper, eq. curvature).

Two expert atoms at -a and a on a line, a source between them: halfway, the cross-potential curves by
-1 + a^2 / epsilon, and rises to either side for every epsilon below a^2; the closeness to the atoms' mean falls to
either side for every epsilon. Run as ``fmpjax experiment curvature --out FOLDER``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import transport
from fmpjax.experiments.common import results
from fmpjax.experiments.common.results import Table, Verdict, number
from fmpjax.viz import panels
from fmpjax.viz.panels import Line, Panel

NAME = "curvature"
DISTANCE = 1.0  # a
EPSILONS = tuple(np.geomspace(0.05, 5.0, 21).tolist())
DRAWN = (0.1, 0.5, 1.0, 2.0)  # epsilons whose landscapes are drawn
TOLERANCE = 1e-9  # between computed and closed form
POINTS = np.linspace(-1.6, 1.6, 65)


def landscapes(distance: float, epsilons: Sequence[float], x: np.ndarray) -> dict[str, np.ndarray]:
    """Cross-potential and barycentric reward at ``x [n]``, and their curvatures halfway, in float64.

    Args:
      distance: a, of either atom from the middle.
      epsilons: entropy coefficients, ``[k]``.

    Returns:
      ``score [k, n]`` and ``barycentric [k, n]``, less their values halfway; ``score_curvature [k]`` and
      ``barycentric_curvature [k]``.
    """

    def one(epsilon):
        atoms, middle = jnp.array([[-distance], [distance]]), jnp.zeros(())
        fitted = transport.fit_score(jnp.zeros((1, 1)), atoms, epsilon=epsilon)
        # Both atoms match the middle alike: their mean is the target.
        target = transport.barycenter(fitted.match_probability(jnp.zeros((1, 1))), atoms)[0, 0]
        functions = {
            "score": lambda x: fitted.expert_extension(x[None, None])[0][0],
            "barycentric": lambda x: 2.0 * jnp.exp(-((x - target) ** 2)),
        }
        values = {name: jax.vmap(f)(jnp.asarray(x)) - f(middle) for name, f in functions.items()}
        return values | {f"{name}_curvature": jax.grad(jax.grad(f))(middle) for name, f in functions.items()}

    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jnp.asarray(epsilons)))


def closed_form(distance: float, epsilon: float) -> float:
    """Curvature of the cross-potential halfway between two atoms (eq. curvature)."""
    return -1.0 + distance**2 / epsilon


def table(record: Mapping[str, Any]) -> Table:
    """Curvatures halfway at every fourth epsilon."""
    lines = [
        [f"{row['epsilon']:.2f} a²", number(row["score_curvature"]), number(row["closed_form"]),
         number(row["barycentric_curvature"])]
        for row in record["curvatures"][::4]
    ]  # fmt: skip
    headings = ["ε", "score's curvature", "closed form", "barycentric reward's"]
    return Table("Halfway between two atoms: above zero a minimum, below it a maximum", headings, lines)


def verdicts(record: Mapping[str, Any]) -> list[Verdict]:
    """The curvature argument, by the computed figures."""
    rows = record["curvatures"]
    least = min(row["score_curvature"] for row in rows if row["epsilon"] < record["settings"]["distance"] ** 2)
    error = max(abs(row["score_curvature"] - row["closed_form"]) for row in rows)
    return [
        Verdict(
            "The middle is a minimum of the score for every ε below a²",
            f"its curvature there is {least:.3f} at least, and within {error:.0e} of the closed form",
            least > 0 and error < TOLERANCE,
        ),
        Verdict(
            "The middle is the maximum of the barycentric reward for every ε",
            f"its curvature there is {max(r['barycentric_curvature'] for r in rows):.3f} at most",
            max(r["barycentric_curvature"] for r in rows) < 0,
        ),
    ]


def figure(record: Mapping[str, Any], path: Path) -> Path:
    """Landscapes of the score and of the barycentric reward, and the score's curvature over epsilon."""
    x = record["points"]
    shades = ("#123c66", "#2a6fb0", "#7fb2ea", "#c8553d")
    scores = {
        f"score, ε = {entry['epsilon']:g} a²": Line(x, entry["score"], shade)
        for entry, shade in zip(record["landscapes"], shades, strict=True)
    }
    rows = record["curvatures"]
    epsilon = [row["epsilon"] for row in rows]
    curvature = {
        "closed form -1 + a²/ε": Line(epsilon, [row["closed_form"] for row in rows], "#5b6673"),
        "computed": Line(epsilon, [row["score_curvature"] for row in rows], "#2a6fb0", "", "o", True),
        "barycentric reward": Line(epsilon, [row["barycentric_curvature"] for row in rows], "#3a8a6b", "--"),
    }
    reward = {"barycentric reward": Line(x, record["landscapes"][0]["barycentric"], "#3a8a6b", "--")}
    return panels.draw(
        path,
        [
            Panel("score, less its value halfway", "x / a, atoms at -1 and 1", scores),
            Panel("barycentric reward, the same", "x / a, atoms at -1 and 1", reward),
            Panel("curvature halfway", "ε / a²", curvature, logarithmic=True),
        ],
        height=3.3,
    )


def main(out: Path) -> None:
    """Compare the score and the barycentric reward halfway between two atoms.

    Args:
      out: folder for curvature.json, .csv and .png.
    """
    results.check_folder(out)
    drawn, swept = landscapes(DISTANCE, DRAWN, POINTS), landscapes(DISTANCE, EPSILONS, POINTS)
    record = {
        "settings": {"distance": DISTANCE},
        "points": POINTS.tolist(),
        "landscapes": [
            {"epsilon": epsilon, "score": drawn["score"][i].tolist(), "barycentric": drawn["barycentric"][i].tolist()}
            for i, epsilon in enumerate(DRAWN)
        ],
        "curvatures": [
            {
                "epsilon": epsilon,
                "score_curvature": float(swept["score_curvature"][i]),
                "closed_form": closed_form(DISTANCE, epsilon),
                "barycentric_curvature": float(swept["barycentric_curvature"][i]),
            }
            for i, epsilon in enumerate(EPSILONS)
        ],
    }
    paths = results.save(out, NAME, record, record["curvatures"], (out,))
    paths.append(figure(record, out / f"{NAME}.png"))
    print(results.text(table(record)), end="\n\n")
    print(*verdicts(record), sep="\n")
    print(*(f"wrote {path}" for path in paths), sep="\n")


if __name__ == "__main__":
    results.entry(main)
