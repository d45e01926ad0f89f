"""Time of the same work in local processes and on a Dask cluster of this machine, and bytes moved.

    OMP_NUM_THREADS=1 python benchmarks/cluster.py [--runs 10000] [--images 1000] [--workers 1 2 4]
        [--repeat 3]

Images are those of the example, searched for edge pairs again and again; runs are those of ``legcal
study paper``. Scheduler and workers are processes of their own over TCP on this machine, so that
the scheduler takes its time from the same cores. Both ways take turns, each in a process of its
own; the shortest times are compared, without imports. Workers keep images that they decoded in an
earlier turn. Bytes are those of results and tasks as pickled, without what TCP and Dask add.
"""

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from shutil import copytree

import numpy as np
import psutil

from legcal import load_dataset
from legcal.calibration.board import rough_placement
from legcal.calibration.ordered_dataset import order_dataset
from legcal.progress import no_progress
from legcal.simulation.paper import PaperStudy, run_study
from legcal.workers import Workers, in_turn, worker_pool

EXAMPLE = Path(__file__).parents[1] / "examples" / "hexapod"


@contextmanager
def cluster(n_workers: int, folder: Path) -> Iterator[tuple[str, list[psutil.Process]]]:
    """Give the address of a scheduler, and its process and those of its workers."""
    from distributed import Client

    file = folder / f"scheduler-{n_workers}.json"
    words = [["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-show"]]
    words += [["worker", "--nthreads", "1", "--no-nanny", "--death-timeout", "60"]] * n_workers
    with ExitStack() as stack:
        started = []
        for own in words:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *own, "--no-dashboard", "--scheduler-file", file],
                cwd=folder, stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": str(EXAMPLE.parents[1])},
            )  # fmt: skip
            stack.callback(process.wait)
            stack.callback(process.terminate)
            started.append(psutil.Process(process.pid))
        while not file.exists():
            time.sleep(0.1)
        with Client(scheduler_file=str(file)) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(n_workers)
            address = client.scheduler.address
        yield address, started


def search_images(folder: Path, n: int, workers: Workers) -> None:
    """Find the edge pairs of that many images."""
    task, rows = _search(folder)
    with worker_pool(workers) as run:
        for _ in run(task, np.resize(rows, n).tolist()):
            pass


def _search(folder: Path) -> tuple[Callable[[int], object], list[int]]:
    data = order_dataset(load_dataset(folder), in_turn, no_progress)
    task = data.photographs.search(rough_placement(data)[0]).picture
    return task, list(range(data.measurements.n_rows))


def run_paper(_folder: Path, n: int, workers: Workers) -> None:
    """Run the paper's study."""
    run_study(PaperStudy(), n, workers=workers)


WORKS = {"images": search_images, "runs": run_paper}


def _timed(*words: object) -> float:
    """Return the time of some work in a process of its own, without that of its imports [s]."""
    command = [sys.executable, __file__, "--only", *map(str, words)]
    found = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return float(found.stdout)


def _only(what: str, folder: str, n: str, workers: str) -> None:
    if not workers.isdecimal():
        import distributed  # noqa: F401
    begin = time.perf_counter()
    WORKS[what](Path(folder), int(n), int(workers) if workers.isdecimal() else workers)
    print(time.perf_counter() - begin)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--only", nargs=4, help="print the time of some work, without the rest")
    asked = parser.parse_args()
    if asked.only:
        _only(*asked.only)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = copytree(EXAMPLE, folder / "own" / "data")
        task, rows = _search(data)
        result = np.mean([len(pickle.dumps(task(row))) for row in rows[:5]])
        size = np.mean([path.stat().st_size for path in (data / "images").iterdir()])
        print(f"image: task {len(pickle.dumps(task)) / 1e3:.0f} kB, "
              f"result {result / 1e3:.1f} kB, file {size / 1e3:.0f} kB")  # fmt: skip
        print(
            f"{'work':14s} workers  local/s  cluster/s  ratio  scheduler/s  scheduler/MB  worker/MB"
        )
        for n_workers in asked.workers:
            with cluster(n_workers, folder) as (address, processes):
                for what, n in (("images", asked.images), ("runs", asked.runs)):
                    if not n:
                        continue
                    _timed(what, data, 20, address)  # libraries load
                    scheduler = processes[0]
                    busy = sum(scheduler.cpu_times()[:2])
                    times = np.array(
                        [
                            [_timed(what, data, n, k) for k in (n_workers, address)]
                            for _ in range(asked.repeat)
                        ]
                    )
                    local, there = times.min(axis=0)
                    busy = (sum(scheduler.cpu_times()[:2]) - busy) / asked.repeat
                    memory = [p.memory_info().rss / 2**20 for p in processes[:2]]
                    print(f"{n:7d} {what:6s} {n_workers:7d} {local:8.1f} {there:10.1f} "
                          f"{there / local:6.2f} {busy:12.2f} {memory[0]:13.0f} {memory[1]:10.0f}",
                          flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
