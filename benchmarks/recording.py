"""How long does a recording of an hour take to import, and how much memory?

Run ``python benchmarks/recording.py``; ``--minutes`` and ``--rate`` change the recording, which is the bundled walk on
end, written as text. Times are of the processor, so that other work on the machine does not count.
"""

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

START = time.process_time()


def write(path: Path, minutes: float, rate: float) -> None:
    """The walk on end as a text of root xyz, quaternion xyzw and joints."""
    import numpy as np

    from fmpjax import motion

    walk = motion.load("walk", rate=rate).qpos
    copies = -(-int(60 * minutes * rate) // len(walk))
    rows = np.tile(walk, (copies, 1))
    rows[:, 0] += np.repeat(np.arange(copies), len(walk)) * (walk[-1, 0] - walk[0, 0])
    rows = rows[: int(60 * minutes * rate), [0, 1, 2, 4, 5, 6, 3, *range(7, rows.shape[1])]]
    with path.open("w") as out:
        out.writelines(",".join(f"{v:.6f}" for v in row) + "\n" for row in rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=30.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / f"walk_{arguments.rate:g}hz.csv", Path(folder) / "walk.npz"
        # A process of its own, whose memory does not count.
        if os.fork() == 0:
            write(source, arguments.minutes, arguments.rate)
            os._exit(0)
        if os.wait()[1]:
            raise SystemExit("the recording could not be written")
        from fmpjax import cli

        imported = time.process_time()
        cli.main(["motion", "import", str(source), "--out", str(out)])
        end = time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"starting       {imported - START:.1f} s")
    print(f"importing      {end - imported:.1f} s")
    print(f"memory         {peak / 2**20:.2f} GiB at most")


if __name__ == "__main__":
    main()
