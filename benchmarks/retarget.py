"""How many times faster than real time is a BVH file retargeted, on one core?

Run with a file: ``python benchmarks/retarget.py FILE.bvh``, with ``--frames 300:900`` for a part. Times
are of the processor, so that other work on the machine does not count.
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from fmpjax import robots
from fmpjax.motion import bvh, formats
from fmpjax.motion.retarget import retarget


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--frames", help="first:last of the file, both included; all by default")
    parser.add_argument("--robot", default="unitree_g1")
    arguments = parser.parse_args()
    robot = robots.load(arguments.robot)
    start = time.process_time()
    source = bvh.read(arguments.file)
    read = time.process_time()
    span = formats.span(arguments.frames, len(source.values)) if arguments.frames else None
    done = retarget(source, robot, arguments.file.stem, span=span)
    end = time.process_time()
    print(f"reading        {read - start:.2f} s, {len(source.values)} frames at {source.rate:.4g} Hz")
    print(f"retargeting    {end - read:.2f} s, {len(done.clip) / (end - read):.0f} frames/s")
    print(f"               {done.clip.duration / (end - read):.1f} times faster than real time")
    print(
        f"residual       {1000 * done.residual.mean():.1f} mm on average, {1000 * done.residual.max():.1f} mm at worst"
    )


if __name__ == "__main__":
    main()
